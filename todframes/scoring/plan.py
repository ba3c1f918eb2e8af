"""The plan of a scoring: what of the frames and of the retina each stimulus needs, decided before it is scored.

A few of its trials are read wide and seen on a coarse retina. What its outer part and the further bands of the
pyramid add there tells what they would add elsewhere, noise and uneven background of the real frames included.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import cast

import numpy as np

from todframes._typing import FloatArray
from todframes.errors import FrameError, SettingsError
from todframes.frames.dataset import Dataset, Trial
from todframes.frames.position import check_place
from todframes.observers.interface import Observer, OmittedWeights, Readout, TruncatedObserver
from todframes.observers.retina import RetinaGrid
from todframes.scoring.error_budget import LEFT_OUT_SHARE, SAFETY, PlanName, Step, decision_change
from todframes.scoring.retina_view import Reader, Shown, read_as_it_is, retina_image
from todframes.stimulus import Stimulus, bounding_box_offset

HALF_FIELDS_IN_SIZES = (1.5, 2.0, 2.5)


SLOPE = 0.5
"""dP / d ln level of a psychometric function at its threshold, about."""


MOST_TRIED, ONE_TRIED_OF = 4, 40
"""Trials of each stimulus that are read wide, besides those nearest to the edges."""


MOST_BAD = 100
"""Frames that cannot be used, after which a stimulus is planned without any: nothing is left out."""


OUTWARDS = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, -1.0], [1.0, 0.0, -1.0, 1.0, -1.0, 1.0, 0.0, -1.0]])
"""Directions from the middle of a frame."""


@dataclass(frozen=True, slots=True)
class StimulusPlan:
    """How trials of one stimulus are scored.

    `half_width` is how many retina samples are looked at on each side of the middle one, None: all of the grid;
    `full_observer` whether further pyramid bands are needed; `bounds` what leaving them out changes in P(correct)
    at most, by stage.
    """

    half_width: int | None = None
    full_observer: bool = False
    bounds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ScorePlan:
    """How a dataset is scored: the plan of each stimulus, whether whole frames are decoded, and the steps."""

    observer: Observer
    stimuli: Mapping[Stimulus, StimulusPlan]
    whole_frames: bool
    steps: tuple[Step, ...]

    def observer_of(self, stimulus: Stimulus) -> Observer:
        """The observer that looks at a stimulus."""
        if self.stimuli[stimulus].full_observer:
            return cast("TruncatedObserver", self.observer).with_extra_level()
        return self.observer

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return what it looks at and how, no wider than needed; None if the observer is not linear.

        Raises
        ------
        SettingsError
            If the observer has no grid for this size.
        """
        observer = self.observer_of(stimulus)
        observer.grid(stimulus)  # refuses what is too large before its readout is made
        readout = observer.readout(stimulus)
        half_width = self.stimuli[stimulus].half_width
        return readout if readout is None or half_width is None else readout.cropped(half_width)

    def bound(self, stimuli: set[Stimulus]) -> float:
        """On the change of P(correct) by what is left out with these stimuli."""
        return max(math.fsum(self.stimuli[stimulus].bounds.values()) for stimulus in stimuli)


def plan_score(
    dataset: Dataset,
    trials: Sequence[Trial],
    observer: Observer,
    *,
    name: PlanName = "needed",
    tolerance: float = 2e-3,
    expected: bool = True,
    read: Reader = read_as_it_is,
) -> ScorePlan:
    """What is needed for thresholds within a relative tolerance; with the name "full", everything.

    Answers that are drawn come from the literal observer, which has the whole of its grid. Where `read` gives
    trials in several ways, the plan is for all of them.
    """
    of_stimulus: dict[Stimulus, list[Trial]] = {}
    for trial in trials:
        of_stimulus.setdefault(trial.stimulus, []).append(trial)
    if name == "full" or not expected:
        full = name == "full" and isinstance(observer, TruncatedObserver)
        plans = {stimulus: StimulusPlan(full_observer=full) for stimulus in of_stimulus}
        why = "as --plan full asks" if name == "full" else "answers are drawn with noise on every neuron"
        return ScorePlan(observer, plans, name == "full", (Step("everything", True, why),))
    budget = LEFT_OUT_SHARE * tolerance * SLOPE / 2.0
    weighed = {
        stimulus: _weigh(dataset, sorted(these, key=lambda trial: trial.level), observer, budget, read)
        for stimulus, these in of_stimulus.items()
    }
    return ScorePlan(observer, {s: w.plan for s, w in weighed.items()}, False, _steps(list(weighed.values())))


@dataclass(frozen=True, slots=True)
class _Weighed:
    """The plan of one stimulus, what it saves, and the shares of the frame's rows and of the retina it needs."""

    plan: StimulusPlan
    saves_s: float = 0.0
    rows: float = 1.0
    retina: float = 1.0


def _weigh(dataset: Dataset, trials: Sequence[Trial], observer: Observer, budget: float, read: Reader) -> _Weighed:
    """Plan one stimulus, whose trials are in the order of their level; some are looked at."""
    stimulus = trials[0].stimulus
    tried = _tried(trials, observer, dataset.display.pitch_mrad)
    first = islice(dict.fromkeys((*tried, *trials)), MOST_BAD)
    if not any(_has_place(dataset, trial, observer) for trial in first):
        return _Weighed(StimulusPlan())  # met again, and told, when it is scored; its readout may be huge
    try:
        missing = observer.omitted_bands(stimulus) if isinstance(observer, TruncatedObserver) else None
        widest = missing.grid if missing is not None else observer.grid(stimulus)
        displaced_mrad = _displaced_mrad(observer, stimulus)
        readout = observer.readout(stimulus)
    except SettingsError:
        return _Weighed(StimulusPlan())  # met again, and told, when it is scored
    started = time.perf_counter()
    shown: list[Shown] = []
    n_read = 0
    # Frames that cannot be read are met again, too; others take their places.
    for trial in islice(dict.fromkeys((*tried, *trials)), len(tried) + MOST_BAD):
        with suppress(FrameError):
            shown += read(dataset, trial, observer, widest, displaced_mrad / widest.pitch_mrad)
            n_read += 1
        if n_read == len(tried):
            break
    reading_s = (time.perf_counter() - started) / len(tried)
    # Without noise the least difference may decide.
    if not shown or readout is None or not readout.noise_covariance.any():
        return _Weighed(StimulusPlan())
    images = _images(shown, widest, displaced_mrad)
    weights = readout.deviations if missing is None else missing.kept
    bounds: dict[str, float] = {}
    full = False
    if missing is not None:
        bounds["pyramid levels"] = _levels_bound(readout, missing, images)
        full = bounds["pyramid levels"] > budget
        if full:
            del bounds["pyramid levels"]
            assert isinstance(observer, TruncatedObserver)
            readout = observer.with_extra_level().readout(stimulus)
            assert readout is not None
            weights = weights + missing.deviations
    half_width, bounds["field"] = _half_width(readout, stimulus, widest.pitch_mrad, weights, images, budget)
    kept = readout.grid.side if half_width is None else 2 * half_width + 1
    frame = shown[0]
    return _Weighed(
        StimulusPlan(half_width, full, bounds),
        saves_s=reading_s * len(trials) * (1.0 - kept * readout.grid.pitch_mrad / widest.width_mrad),
        rows=min(kept * readout.grid.pitch_mrad / dataset.display.pitch_mrad / frame.frame_rows, 1.0),
        retina=(kept / readout.grid.side) ** 2,
    )


def _has_place(dataset: Dataset, trial: Trial, observer: Observer) -> bool:
    """Whether a trial's triangle lies on its first frame."""
    try:
        check_place(dataset, trial, observer.centre)
    except FrameError:
        return False
    return True


def _tried(trials: Sequence[Trial], observer: Observer, pitch_mrad: float) -> list[Trial]:
    """Some in the middle of the levels, and where the retina's places differ those nearest to a frame's edges."""
    n_tried = min(max(len(trials) // ONE_TRIED_OF, 1), MOST_TRIED)
    first = (len(trials) - n_tried) // 2
    chosen = list(trials[first : first + n_tried])
    # Either all places are known, or those that are not are the frame's middle.
    placed = [trial for trial in trials if trial.x_px is not None] or trials
    place = np.array([(trial.x_px or 0.0, trial.y_px or 0.0) for trial in placed])
    if observer.centre == "bounding_box":
        offset = np.array([bounding_box_offset(trial.orientation) for trial in placed])
        place += offset * placed[0].stimulus.size_mrad / pitch_mrad
    if np.ptp(place, axis=0).any():
        chosen += [placed[k] for k in np.argmax(place @ OUTWARDS, axis=0)]
    return list(dict.fromkeys(chosen))


def _displaced_mrad(observer: Observer, stimulus: Stimulus) -> FloatArray:
    """The retina's displacements that are looked at, (n, 2): none, and where what happens to the edges is largest.

    What is left out changes about linearly with a displacement, so corners of its range are enough, and of
    opposite ones one.
    """
    most = observer.position_jitter_samples * observer.grid(stimulus).pitch_mrad
    return most * np.array([[0.0, 0.0], [1.0, 1.0], [1.0, -1.0]])[: 3 if most else 1]


def _images(shown: Sequence[Shown], grid: RetinaGrid, displaced_mrad: FloatArray) -> FloatArray:
    """Each trial on the retina at each displacement: (n, side, side)."""
    displacements = (displaced_mrad / grid.pitch_mrad).tolist()
    return np.array([retina_image(one, grid, (dx, dy)) for one in shown for dx, dy in displacements])


def _levels_bound(readout: Readout, missing: OmittedWeights, images: FloatArray) -> float:
    change = decision_change(
        _score(missing.deviations, images), readout.noise_covariance, missing.noise_covariance
    )
    return SAFETY * float(change.max())


def _half_width(
    readout: Readout,
    stimulus: Stimulus,
    pitch_mrad: float,
    weights: FloatArray,
    images: FloatArray,
    budget: float,
) -> tuple[int | None, float]:
    """The narrowest of some fields whose bound fits, and the bound.

    What a field leaves out is weighed with the readout's weights on a grid of this pitch, which may be coarse:
    they vary slowly out there.
    """
    middle = weights.shape[-1] // 2
    for sizes in HALF_FIELDS_IN_SIZES:
        half_width = math.ceil(sizes * stimulus.size_mrad / readout.grid.pitch_mrad) + 2
        if 2 * half_width + 1 >= readout.grid.side:
            break
        inner = math.floor(half_width * readout.grid.pitch_mrad / pitch_mrad)
        outer = weights.copy()
        outer[:, middle - inner : middle + inner + 1, middle - inner : middle + inner + 1] = 0.0
        change = decision_change(_score(outer, images), readout.noise_covariance, np.zeros((4, 4)))
        bound = SAFETY * float(change.max())
        if bound <= budget:
            return half_width, bound
    return None, 0.0


def _score(weights: FloatArray, images: FloatArray) -> FloatArray:
    """Four scores of each image: (n, 4)."""
    return np.asarray(np.einsum("kyx,nyx->nk", weights, images, optimize=True))


def _steps(weighed: Sequence[_Weighed]) -> tuple[Step, ...]:
    """The plans of all stimuli in a few lines: the largest bounds, the sums of what is saved."""
    n = len(weighed)
    n_narrow = sum(one.plan.half_width is not None for one in weighed)
    levels = max((one.plan.bounds.get("pyramid levels", 0.0) for one in weighed), default=0.0)
    narrow = max((one.plan.bounds.get("field", 0.0) for one in weighed), default=0.0)
    retina = f"{100.0 * float(np.mean([one.retina for one in weighed])):.2g} % of the retina"
    rows = [100.0 * one.rows for one in weighed]
    shares = f"{min(rows):.3g} % of" if max(rows) - min(rows) < 0.5 else f"{min(rows):.3g} to {max(rows):.3g} % of"
    saves_s = sum(one.saves_s for one in weighed)
    n_thrifty = n - sum(one.plan.full_observer for one in weighed)
    return (
        Step("frame rows", min(rows) >= 100.0, f"{shares} a frame's rows are looked at", saves_once_s=saves_s),
        Step("pyramid levels", n_thrifty == 0, f"one level less than full for {n_thrifty} of {n} stimuli", levels),
        Step("field", n_narrow == 0, f"{retina} for {n_narrow} of {n} stimuli", narrow),
        Step("noise on neurons", False, "the decision's probability is computed, not drawn"),
    )
