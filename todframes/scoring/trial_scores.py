"""The scores of trials: frames are placed under the retina grid, resampled and shown to the observer."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, SettingsError
from todframes.base.seeds import random_stream
from todframes.frames.contrast import (
    ContrastPatch,
    centroid_position,
    check_place,
    from_centroid,
    read_contrast,
    size_in_px,
    skipped_frames,
    triangle_place,
)
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.files import FrameSource
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import FrameReference, Trial, Trials
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.interface import Observer, Readout
from todframes.observers.retina import RetinaGrid, resample
from todframes.parameters import Decisions, PlanName
from todframes.scoring.error_budget import REPLICATES
from todframes.stimulus import Centre, Stimulus


class Placement(NamedTuple):
    """The middle of an undisplaced grid on a frame, in pixels, the rows and columns that the grid touches, and the
    triangle."""

    x_px: float
    y_px: float
    rows: tuple[int, int]
    columns: tuple[int, int]
    triangle: TrianglePlace


def place_grid(
    dataset: Dataset,
    trial: Trial,
    frame: FrameReference,
    file: FrameSource,
    observer: Observer,
    grid: RetinaGrid,
    displacement_samples: Sequence[tuple[float, float]] | FloatArray,
) -> Placement:
    """Find the position of a retina grid on an open frame, and the pixels it touches at all of its displacements.
    The grid follows a triangle that moves, or stays at its mean place in the trial, as the dataset's `gaze` says.
    Raises FrameError if the triangle does not lie on the frame.
    """
    pitch, header, centre = dataset.display.pitch_mrad, file.header, observer.centre
    triangle = triangle_place(trial, frame, file, centre, pitch)
    x, y = triangle.x_px, triangle.y_px
    if dataset.gaze == "fixed":
        x, y = centroid_position(trial, header, centre, pitch)
    if centre != "centroid":
        to_centre_x, to_centre_y = from_centroid(trial, centre, pitch)
        x, y = x + to_centre_x, y + to_centre_y
    along_x, along_y = (np.asarray(displacement_samples) * grid.pitch_mrad / pitch).T
    rows, columns = grid.touched(
        (y + along_y).tolist(), (x + along_x).tolist(), pixel_pitch_mrad=pitch, shape=(header.height, header.width)
    )
    return Placement(x, y, rows, columns, triangle)


class TrialPatches(NamedTuple):
    """A trial's frames as read, each with the position of the middle of the undisplaced retina grid. `x_px` and
    `y_px` are these positions in pixels; `frame_rows` is the number of rows of the last frame.
    """

    patches: tuple[ContrastPatch, ...]
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    pixel_pitch_mrad: float
    frame_rows: int

    @property
    def n_negative(self) -> int:
        """Number of display pixels with a luminance below zero among those that were read."""
        return sum(patch.n_negative for patch in self.patches)

    @property
    def background_luminance_cd_m2(self) -> float:
        """Mean over the frames of the luminance that contrast refers to; NaN if a patch was made from contrast."""
        each = [patch.background_luminance_cd_m2 for patch in self.patches]
        return sum(math.nan if frame is None else frame for frame in each) / len(each)

    def on_pixels(self, grid: RetinaGrid, offset_samples: tuple[float, float]) -> TrialPatches:
        """Return the frames with the grid moved by an offset, then by half a pixel at most, so that samples begin
        where pixels do.
        """
        sample_px = grid.pitch_mrad / self.pixel_pitch_mrad
        to_middle = (sample_px - 1.0) / 2.0  # from the middle of a sample's first pixel
        xs, ys = (
            tuple(math.ceil(at + offset * sample_px - to_middle - 0.5) + to_middle for at in along)
            for along, offset in zip((self.x_px, self.y_px), offset_samples, strict=True)
        )
        return self._replace(x_px=xs, y_px=ys)

    def with_gaze_fixed(self, trial: Trial, frame_pitch_mrad: float) -> TrialPatches:
        """Return frames that were read with a tracked gaze as seen with a fixed one. `frame_pitch_mrad` is the
        pixel pitch of the dataset's frames, which an algorithm may have changed since.
        """
        motion_px = to_mean_place_px(trial) * (frame_pitch_mrad / self.pixel_pitch_mrad)
        xs, ys = (np.array([self.x_px, self.y_px]) + motion_px.T).tolist()
        return self._replace(x_px=tuple(xs), y_px=tuple(ys))


Reader = Callable[..., Sequence[TrialPatches]]
"""Function that reads a trial in one or several ways; its arguments are those of `read_trial`."""


def to_mean_place_px(trial: Trial) -> FloatArray:
    """Return the distances in pixels from the triangle in each frame of a trial to its mean place: (n, 2)."""
    return -np.array([frame.motion_px or (0.0, 0.0) for frame in trial.frames])


def read_trial(
    dataset: Dataset,
    trial: Trial,
    observer: Observer,
    grid: RetinaGrid,
    displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
    *,
    whole: bool = False,
) -> TrialPatches:
    """Read the part of a trial's frames that a retina grid touches at all of its displacements, or whole frames.
    `displacement_samples`, (n, 2), are displacements along x and y in retina samples. Raises FrameError if a frame
    cannot be used, or the triangle does not lie on it.
    """
    patches, places = [], []
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            place = place_grid(dataset, trial, frame, file, observer, grid, displacement_samples)
            part = (None, None) if whole else (place.rows, place.columns)
            patches.append(read_contrast(file, dataset.display, frame, *part, triangle=place.triangle))
            places.append((place.x_px, place.y_px))
            n_rows = file.header.height
    xs, ys = zip(*places, strict=True)
    return TrialPatches(tuple(patches), xs, ys, dataset.display.pitch_mrad, n_rows)


def patches_about(
    dataset: Dataset, trial: Trial, centre: Centre, reach_px: tuple[int, int]
) -> Iterator[tuple[ContrastPatch, float, float]]:
    """Yield the part of each frame of a trial about the triangle, so many pixels before and after its middle one,
    and the triangle's position (x, y)."""
    pitch_mrad, (before, after) = dataset.display.pitch_mrad, reach_px
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            x, y = centroid_position(trial, file.header, centre, pitch_mrad, frame)
            rows, columns = ((round(at) - before, round(at) + after) for at in (y, x))
            triangle = TrianglePlace(x, y, size_in_px(trial, pitch_mrad))
            yield read_contrast(file, dataset.display, frame, rows, columns, triangle=triangle), x, y


def retina_image(
    shown: TrialPatches, grid: RetinaGrid, displacement_samples: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Compute the mean contrast of a trial's frames on a retina grid, displaced along x and y: (side, side)."""
    pitch_mrad, image = shown.pixel_pitch_mrad, np.zeros((grid.side, grid.side))
    dx, dy = (d * grid.pitch_mrad / pitch_mrad for d in displacement_samples)
    for patch, x, y in zip(shown.patches, shown.x_px, shown.y_px, strict=True):
        at = {"x_px": x + dx, "y_px": y + dy, "pixel_pitch_mrad": pitch_mrad}
        for band in patch.bands():
            resample(band.values, grid, first_row=band.row, first_column=band.column, onto=image, **at)
    return image / len(shown.patches)


NO_ANSWER = -1
"""Answer of a trial for which none was drawn."""

# First elements of the spawn keys of random streams: they keep the streams of trials and fits apart.
TRIAL_STREAMS, FIT_STREAMS, DISPLACEMENT_STREAMS, RATIO_STREAMS = range(4)

KRONECKER_STEPS_2D = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of a two-dimensional low-discrepancy sequence, powers of the root of x³ = x + 1 (Roberts 2018)."""


class TrialScore(NamedTuple):
    """The observer's scores of a trial and, if drawn, its answer. `displacement_samples`, (d, 2), are
    displacements of the retina along x and y. `scores` and `deviations`, (d, 4), are noise-free inner products
    with the templates, and their deviations from their mean, computed without cancellation; NaN if the observer is
    not linear. Then `probabilities`, (d, 4), are its expected answers; NaN if it is linear or has none.
    """

    displacement_samples: FloatArray
    scores: FloatArray
    deviations: FloatArray
    probabilities: FloatArray
    answer: int
    n_negative: int
    background_luminance_cd_m2: float


class TrialScores:
    """The observer's scores of many trials with equal numbers of displacements, set in any order. `seen["scores"]`
    has the `TrialScore.scores` of each trial, and so for its other attributes.
    """

    def __init__(self, trials: Trials, table: NDArray[Any] | None = None) -> None:
        self.trials, self._table = trials, table
        self._is_seen = np.full(len(trials), table is not None)

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, name: str) -> NDArray[Any]:
        assert self._table is not None
        return np.asarray(self._table[name])

    def put(self, row: int, seen: TrialScore) -> None:
        """Set the scores of a trial; all trials have as many displacements as the first."""
        if self._table is None:
            values = [(name, np.asarray(value)) for name, value in seen._asdict().items()]
            row_type = np.dtype([(name, value.dtype, value.shape) for name, value in values])
            self._table = np.zeros(len(self.trials), row_type)
        self._table[row], self._is_seen[row] = seen, True

    def usable(self) -> TrialScores:
        """Return the trials whose scores were set, in the order of the trials."""
        return self if self._is_seen.all() else self.select(np.flatnonzero(self._is_seen))

    def select(self, rows: NDArray[np.intp]) -> TrialScores:
        """Return some of the trials, by row."""
        return TrialScores(self.trials.select(rows), None if self._table is None else self._table[rows])

    def amplified(self, gain: FloatArray) -> TrialScores:
        """Return the scores after a plain gain of contrast, one gain for each trial; scores are linear in
        contrast."""
        assert self._table is not None
        table = self._table.copy()
        for name in ("scores", "deviations"):
            scores = table[name].T
            scores *= gain
        return TrialScores(self.trials, table)


@dataclass(frozen=True, slots=True)
class Scoring:
    """The settings for the scoring of all trials of a dataset. `displacements` is the number of displacements of
    each trial in each replicate; 0: a single one, from the trial's own random stream. With the plan "full" whole
    frames are decoded and the whole grid is looked at.
    """

    dataset: Dataset
    observer: Observer
    decisions: Decisions
    seed: int
    displacements: int = 0
    plan: PlanName = "needed"

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return the readout of a stimulus; None if the observer is not linear. Raises SettingsError if the
        observer has no grid for this size.
        """
        self.observer.grid(stimulus)  # refuses a stimulus that is too large before its readout is made
        return self.observer.readout(stimulus)


def scoring_of(
    dataset: Dataset, observer: Observer, *, plan: PlanName, decisions: Decisions, seed: int
) -> Scoring:
    """Return the settings of a scoring with one displacement a trial; the plan "full" adds a level to the observer
    where it leaves one out."""
    if plan == "full":
        observer = observer.with_extra_level()
    return Scoring(dataset, observer, decisions, seed, plan=plan)


class TrialViewing(NamedTuple):
    """The observer, retina grid and displacements for a trial, the same for all ways in which it is shown.
    `displacement_samples`, (d, 2), are the displacements of the retina grid in retina samples. `readout` is None
    if the observer is not linear.
    """

    observer: Observer
    grid: RetinaGrid
    displacement_samples: FloatArray
    readout: Readout | None


def trial_viewing(scoring: Scoring, trial: Trial, readout: Readout | None) -> TrialViewing:
    """Return the observer, retina grid and displacements for a trial. Raises SettingsError if the observer is not
    linear and its answer is not drawn.
    """
    observer = scoring.observer
    if readout is None and scoring.decisions == "expected" and not observer.knows_probabilities:
        raise SettingsError("decisions: found 'expected', but this observer is not linear; expected 'sampled'")
    displaced = _displacements(scoring, trial, observer.position_jitter_samples)
    grid = observer.grid(trial.stimulus) if readout is None else readout.grid
    return TrialViewing(observer, grid, displaced, readout)


def score_views(
    scoring: Scoring, trial: Trial, viewing: TrialViewing, ways: Sequence[TrialPatches]
) -> list[TrialScore]:
    """Show a trial to the observer in each of several ways, with the same displacements and the same noise."""
    displaced, readout = viewing.displacement_samples, viewing.readout
    seen = []
    for shown in ways:
        answer = NO_ANSWER
        scores = deviations = probabilities = np.full((len(displaced), 4), np.nan)
        if (offset := viewing.observer.pixel_offset(trial.stimulus)) is not None:
            shown = shown.on_pixels(viewing.grid, offset)
        if readout is None and scoring.decisions == "expected":
            probabilities = _expected_answers(viewing, shown, trial)
        elif readout is not None:
            scores, deviations = _scores(readout, shown, displaced)
        if scoring.decisions == "sampled":
            dx, dy = displaced[0].tolist()
            image = retina_image(shown, viewing.grid, (dx, dy))
            rng = random_stream(scoring.seed, TRIAL_STREAMS, trial.number)
            rng.random(2)  # the displacement
            answer = viewing.observer.respond(image, trial.stimulus, rng).quarter_turns
        answered = (displaced, scores, deviations, probabilities, answer)
        seen.append(TrialScore(*answered, shown.n_negative, shown.background_luminance_cd_m2))
    return seen


def score_trial(scoring: Scoring, trial: Trial, readout: Readout | None) -> TrialScore:
    """Read a trial and show it to the observer. Raises FrameError if a frame cannot be used, and SettingsError as
    `trial_viewing` does.
    """
    viewing = trial_viewing(scoring, trial, readout)
    displaced = viewing.displacement_samples
    shown = read_trial(
        scoring.dataset, trial, viewing.observer, viewing.grid, displaced, whole=scoring.plan == "full"
    )
    return score_views(scoring, trial, viewing, [shown])[0]


def _displacements(scoring: Scoring, trial: Trial, jitter: float) -> FloatArray:
    if not scoring.displacements:
        return -jitter + 2.0 * jitter * random_stream(scoring.seed, TRIAL_STREAMS, trial.number).random((1, 2))
    key = (DISPLACEMENT_STREAMS, scoring.displacements, trial.number)
    shifts = np.random.default_rng(np.random.SeedSequence(scoring.seed, spawn_key=key)).random((REPLICATES, 1, 2))
    evenly = (shifts + np.arange(scoring.displacements)[:, None] * KRONECKER_STEPS_2D) % 1.0
    return np.asarray(jitter * (2.0 * evenly.reshape(-1, 2) - 1.0))


def _expected_answers(viewing: TrialViewing, shown: TrialPatches, trial: Trial) -> FloatArray:
    """Return the probabilities of the answers of an observer that is not linear, (d, 4)."""
    images = (retina_image(shown, viewing.grid, (dx, dy)) for dx, dy in viewing.displacement_samples.tolist())
    expected = [viewing.observer.expected_answers(image, trial.stimulus) for image in images]
    return np.array(expected, np.float64)


def _scores(
    readout: Readout, shown: TrialPatches, displacement_samples: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the scores with displacements of the retina, and their deviations from their mean, (d, 4) each."""
    scores, deviations = np.empty((2, len(displacement_samples), 4))
    for row, (dx, dy) in enumerate(displacement_samples.tolist()):
        contrast = retina_image(shown, readout.grid, (dx, dy))
        deviations[row] = readout.score_deviations(contrast)
        scores[row] = deviations[row] + readout.common_score(contrast)
    return scores, deviations


T = TypeVar("T")

Show = Callable[[Scoring, Trial, Readout | None], T]
"""Function that shows a trial to the observer, such as `score_trial`, from any thread; it can be pickled.

The readout is None if the observer is not linear. Raises FrameError if a frame cannot be used.
"""


@dataclass(frozen=True)
class TrialWork(StoredWork[Trial, T | FrameError], Generic[T]):
    """The showing of trials to an observer. Its results, of type `kind`, are NamedTuples of numbers, arrays of
    float64 and such tuples. `depends_on` is what results depend on besides the scoring and the frames.
    """

    scoring: Scoring
    show: Show[T]
    kind: type[T]
    depends_on: object = None

    def function(self) -> Callable[[Trial], T | FrameError]:
        """Return the function that shows a trial; a frame that cannot be used is its result."""
        scoring = self.scoring
        readout_of = lru_cache(maxsize=4)(scoring.readout)
        fitting: set[Stimulus] = set()

        def show(trial: Trial) -> T | FrameError:
            try:
                if trial.stimulus not in fitting:  # check first: a readout may be huge
                    check_place(scoring.dataset, trial, scoring.observer.centre)
                    fitting.add(trial.stimulus)
                try:
                    readout = readout_of(trial.stimulus)
                except SettingsError as error:  # an error about this row's size
                    raise FrameError(scoring.dataset.frame_path(trial.frames[0]), str(error)) from None
                return self.show(scoring, trial, readout)
            except FrameError as error:
                return error

        return show

    def name(self, item: Trial) -> str:
        """Return the path of a trial's first frame."""
        return str(self.scoring.dataset.frame_path(item.frames[0]))

    def identity(self) -> bytes:
        """Return a hash of the settings, and of the code of the parts."""
        from todframes.jobs.fingerprint import fingerprint

        scoring = self.scoring
        data, settings = scoring.dataset, (scoring.decisions, scoring.seed, scoring.displacements, scoring.plan)
        return fingerprint(data.display, data.gaze, scoring.observer, settings, self.kind, self.depends_on)

    def item_identity(self, item: Trial) -> str:
        """Return a hash of a trial's row and of its files' sizes and times."""
        folder = self.scoring.dataset.path
        frames = (*item.warm_up, *item.frames)
        paths = [path for frame in frames for path in (frame.path, frame.reference) if path is not None]
        files = [_status(os.path.join(folder, path)) for path in paths]  # noqa: PTH118 - pathlib is slow
        return hashlib.sha256(repr((item, files)).encode(errors="surrogatepass")).hexdigest()[:32]

    def encode(self, result: T | FrameError) -> bytes | None:
        """Return a result as bytes; None for a frame that cannot be used: it may be mended."""
        return None if isinstance(result, FrameError) else _ENCODER.encode(result)

    def decode(self, encoded: bytes) -> T:
        """Return the result that was encoded. Raises msgspec.MsgspecError if it is none."""
        return msgspec.msgpack.decode(encoded, type=self.kind, dec_hook=_array)


def score_trials(
    scoring: Scoring,
    trials: Trials,
    show: Show[T],
    *,
    kind: type[T],
    collect: Callable[[int, T], None],
    skip_bad_frames: bool,
    run: Run,
    depends_on: object = None,
) -> list[Skipped]:
    """Show trials to the observer; return the frames that were skipped. `show` and what follows `run` are as in
    `TrialWork`. `collect` is called with the index of each trial that was seen, in any order, and its result.
    Raises FrameError if a frame cannot be used, unless bad frames are skipped: then the trials are left out and
    their frames listed.
    """
    bare = replace(scoring, dataset=replace(scoring.dataset, trials=Trials.of(())))
    work = TrialWork(bare, show, kind, depends_on)
    # In the order of their stimuli, so that few readouts are held at a time.
    keys = np.array([(stimulus.polarity, stimulus.size_mrad) for stimulus in trials.stimuli])
    order = np.lexsort(keys[trials.stimulus_codes].T)
    if scoring.dataset.is_in_memory:
        run = replace(run, store=None)
    unusable: dict[int, FrameError] = {}
    in_order = trials.select(order)
    for number, result in run_stored(work, in_order, run):
        if isinstance(result, FrameError):
            if not skip_bad_frames:
                raise result
            unusable[number] = result
        else:
            collect(int(order[number]), result)
    return [
        skipped
        for number in sorted(unusable)
        for skipped in skipped_frames(scoring.dataset, in_order[number], unusable[number])
    ]


def _status(path: str) -> tuple[str, int, int]:
    """Return the path, size and time of a file."""
    try:
        status = os.stat(path)  # noqa: PTH116 - pathlib is slow
    except OSError:
        return path, 0, 0
    return path, status.st_size, status.st_mtime_ns


def _array(_: type, packed: tuple[Sequence[int], bytes]) -> Any:
    return np.frombuffer(packed[1], np.float64).reshape(packed[0])


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, np.ascontiguousarray(value, np.float64).tobytes()
    return value.item()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_packed)
