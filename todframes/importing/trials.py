"""Clips and trials: the runs of frames in which a chart shows one page, and the parts that an observer integrates.

Frames of transitions are left out. Most have markers of two pages, or of none. If a frame holds only a small share
of the page before or after (a slow display, an exposure across the change), its markers read well. Then the
modules in which the markers of the two pages differ give the share, which is compared with that of the other
frames of the clip.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain, groupby, islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, OutputError
from todframes.charts.layout import marker_bits, marker_ids
from todframes.display.display import SignalDisplay
from todframes.frames.files import frame_sha256, write_frame
from todframes.frames.surround import TrianglePlace, surround_window
from todframes.jobs.fingerprint import fingerprint
from todframes.observers.pyramid import PyramidObserver
from todframes.recordings.recording import GAP, TIME_TOLERANCE, CodeRange, RecordedFrame, Recording
from todframes.stimulus import Orientation, Stimulus

EDGE_FRAMES = 3
"""Frames at the beginning and the end of a clip that may hold a share of another page."""

REFERENCE_FRAMES = 7
"""Frames of a clip whose median share the edge frames are compared with."""

RECENT_INTERVALS = 4
"""Number of the latest intervals between frames, of which the shortest is the frame rate if it is longer than the
mean: at 15 % dropped frames at random, as many in a row are missing once in 2,000."""

Rectangle = tuple[int, int, int, int]
"""Half-open ranges of rows and columns: top, bottom, left, right."""


class Placed(NamedTuple):
    """A triangle in a recorded frame.

    `x_px` and `y_px` are its centroid in the frame, None if it is not known; `size_px` is √(area). `window` are
    the rows and columns that the observer needs; `held`, those in which the window of a trial may lie, since the
    triangle may move within it. By `number` the source knows the place, perhaps better at a recording's end.
    """

    x_px: float | None
    y_px: float | None
    size_px: float
    orientation: Orientation
    window: Rectangle
    held: Rectangle
    number: int | None = None


class ClipFrame(NamedTuple):
    """A frame that shows a page of the chart, and its values as recorded.

    `modules` are the values in the markers' modules, as in `Sighting`. `triangles` has one for each triangle of
    the page, None where it does not lie on the frame. `before` are the recorded frames that come directly before
    it, whatever they show.
    """

    page: int
    time_s: float | None
    source: str
    values: NDArray[np.generic]
    triangles: tuple[Placed | None, ...]
    modules: FloatArray
    before: tuple[RecordedFrame, ...] = ()


def frames_with_those_before(
    recording: Recording, n_frames: int
) -> Iterator[tuple[RecordedFrame, tuple[RecordedFrame, ...]]]:
    """Yield each frame of a recording with up to `n_frames` that come directly before it.

    There are fewer at the beginning, and after a gap. So many frames are held in memory.
    """
    rate, before = recording.frames_per_second, deque[RecordedFrame](maxlen=n_frames)
    for frame in recording.frames():
        if before and rate is not None and None not in (frame.time_s, last_s := before[-1].time_s):
            assert frame.time_s is not None
            assert last_s is not None
            if (frame.time_s - last_s) * rate > GAP:
                before.clear()
        yield frame, tuple(before)
        before.append(frame)


@dataclass(slots=True)
class Clip:
    """A run of frames of one page. `n_transition` counts frames left out at its ends."""

    number: int
    page: int
    n_frames: int = 0
    n_transition: int = 0
    n_gaps: int = 0
    n_trials: int = 0
    first_source: str = ""
    last_source: str = ""
    start_s: float | None = None
    end_s: float | None = None

    def count(self, frame: ClipFrame) -> None:
        """Count a frame of the clip."""
        self.n_frames += 1
        self.first_source = self.first_source or frame.source
        self.last_source = frame.source
        self.start_s = frame.time_s if self.start_s is None else self.start_s
        self.end_s = frame.time_s


def clean_clips(frames: Iterable[ClipFrame], *, key: int, first_number: int) -> Iterator[tuple[Clip, ClipFrame]]:
    """Yield the frames of each clip that show its page alone, each with its clip.

    `frames` are those of one recording that show a page of the chart with this key, in the order of time;
    `first_number` is that of the first clip. No more frames are held back than the comparison needs.
    """
    clip: Clip | None = None
    held: deque[ClipFrame] = deque()
    known: deque[FloatArray] = deque(maxlen=REFERENCE_FRAMES)
    end: tuple[int | None, Iterator[ClipFrame]] = (None, iter(()))
    for number, (page, run) in enumerate(chain(groupby(frames, lambda frame: frame.page), [end]), first_number):
        before = None
        if clip is not None:  # its last frames waited for the page after it
            for frame in _without_other(clip, [*held], [*known], page, key, is_end=True):
                clip.count(frame)
                yield clip, frame
            before = clip.page
        if page is None:
            return
        clip, first = Clip(number, page), [*islice(run, REFERENCE_FRAMES)]
        known.clear()
        known.extend(frame.modules for frame in first)
        held = deque(_without_other(clip, first[:EDGE_FRAMES], [*known], before, key, is_end=False))
        held.extend(first[EDGE_FRAMES:])
        for following in chain([None], run):
            if following is not None:
                held.append(following)
                known.append(following.modules)
            while len(held) > EDGE_FRAMES:
                clip.count(held[0])
                yield clip, held.popleft()


def _without_other(
    clip: Clip, frames: list[ClipFrame], known: list[FloatArray], other: int | None, key: int, *, is_end: bool
) -> list[ClipFrame]:
    """Return the frames whose share of another page is not above that of the clip's reference frames.

    The share grows towards the other page: a frame is left out with all that are nearer to it, or noise alone
    would make a gap in the clip.
    """
    if other is None or not frames:
        return frames
    ids, other_ids = marker_ids(clip.page, key), marker_ids(other, key)
    shares = np.array([share_of_other(one, ids, other_ids) for one in known])
    middle = float(np.median(shares))
    # 3 % of a triangle's contrast, or six median deviations, which noise alone hardly reaches.
    most = middle + max(0.03, 6.0 * float(np.median(np.abs(shares - middle))))
    bad = [k for k, frame in enumerate(frames) if share_of_other(frame.modules, ids, other_ids) > most]
    if not bad:
        return frames
    good = frames[: bad[0]] if is_end else frames[bad[-1] + 1 :]
    clip.n_transition += len(frames) - len(good)
    return good


def share_of_other(modules: FloatArray, ids: tuple[int, ...], other_ids: tuple[int, ...]) -> float:
    """Estimate the share of another page in a frame, from the modules in which the markers of the two differ.

    `modules`, (4, 7, 7), are the values in the four markers; `ids` are those of the page that the frame shows.
    Returns the largest share among the markers, which a display that changes line by line reaches at different
    times; about 0 for a clean frame. 0 if the markers are the same.
    """
    shares = [0.0]
    for values, marker, other in zip(modules, ids, other_ids, strict=True):
        bits, other_bits = marker_bits(marker), marker_bits(other)
        changed, white = bits != other_bits, bits & other_bits
        if not changed.any():
            continue
        black_level = values[~bits & ~other_bits].mean()
        white_level = values[white].mean() if white.any() else values[bits].mean()
        level = (values[changed] - black_level) / (white_level - black_level)
        shares.append(float(np.where(bits[changed], 1.0 - level, level).mean()))
    return max(shares)


class Integration:
    """The division of a clip's frames into trials of the observer's integration time; without it, of one trial.

    Each frame is shown until the next one. Where the interval between frames is far from the mean, `frame_s`, the
    latest one counts. Frames are missing where it is longer, by `GAP`, than one of the latest and the mean.
    Without a mean interval each frame is a trial if there is an integration time.
    """

    def __init__(self, time_s: float | None, frame_s: float | None) -> None:
        self.time_s = time_s
        self.frame_s = frame_s
        self._start_s: float | None = None
        self._last_s: float | None = None
        self._intervals_s: deque[float] = deque(maxlen=RECENT_INTERVALS)

    def begin_clip(self) -> None:
        """Begin another clip: the interval from the last one says nothing of the frame rate."""
        self._start_s = self._last_s = None

    def ends_before(self, time_s: float | None) -> tuple[bool, bool] | None:
        """Return None if the present trial goes on with a frame of this time; else whether the trial has the whole
        integration time, and whether frames are missing then."""
        start, last = self._start_s, self._last_s
        if self.frame_s is None or time_s is None or start is None or last is None:
            return None if self.time_s is None else (True, False)
        if self.time_s is None:
            return None
        if self.frame_s > GAP * self.time_s:  # photographs: each is a trial, and no frame is missing between two
            return True, False
        is_slow = len(self._intervals_s) == RECENT_INTERVALS
        if time_s - last > GAP * max(self.frame_s, min(self._intervals_s) if is_slow else 0.0):
            return self.is_whole, True
        if time_s - start >= self.time_s - (0.5 + TIME_TOLERANCE) * self._local_s(time_s - last):
            return True, False
        return None

    def _local_s(self, latest_s: float) -> float:
        """Return the interval between frames here: the mean one, unless the latest is another frame rate's."""
        assert self.frame_s is not None
        return self.frame_s if self.frame_s <= GAP * latest_s and latest_s <= GAP * self.frame_s else latest_s

    def add(self, time_s: float | None, *, first: bool) -> None:
        """Take a frame into the present trial, or begin one with it."""
        if time_s is not None and self._last_s is not None:
            self._intervals_s.append(time_s - self._last_s)
        self._start_s = time_s if first else self._start_s
        self._last_s = time_s

    @property
    def is_whole(self) -> bool:
        """True if the present trial covers the integration time. If the time is short, a single frame covers
        it."""
        if self.time_s is None or self.frame_s is None or self._start_s is None or self._last_s is None:
            return True
        frame_s = max(self.frame_s, self._local_s(self._intervals_s[-1]) if self._intervals_s else 0.0)
        return self._last_s - self._start_s >= self.time_s - (1.5 + TIME_TOLERANCE) * frame_s


MARGIN_PX = 2
"""Pixels of a window beyond what the observer and the background need."""

EVERYWHERE = (-(10**9), 10**9)


@lru_cache(maxsize=256)
def field_reach_px(size_px: int, pitch_mrad: float) -> int:
    """Return the distance from a triangle's centroid to the edges of the window that the observer needs.

    It holds the retina of the paper's observer with its displacement, and the ring in which the background is
    measured. A size in whole pixels, rounded up, spares the computation for each frame.
    """
    observer = PyramidObserver()
    grid = observer.grid(Stimulus(size_px * pitch_mrad))
    retina = grid.width_mrad / 2.0 + observer.position_jitter_samples * grid.pitch_mrad
    ring = surround_window(TrianglePlace(0.0, 0.0, size_px), rows=EVERYWHERE, columns=EVERYWHERE)
    return math.ceil(max(retina / pitch_mrad, ring.rows[1])) + MARGIN_PX


def window_about(x_px: float, y_px: float, reach_px: int) -> Rectangle:
    """Return the square window of pixels about a place, not clipped to the frame."""
    row, column = round(y_px), round(x_px)
    return row - reach_px, row + reach_px + 1, column - reach_px, column + reach_px + 1


def clipped(window: Rectangle, shape: Sequence[int]) -> Rectangle:
    """Return the part of a window that lies on a frame."""
    top, bottom, left, right = window
    return max(top, 0), min(bottom, shape[0]), max(left, 0), min(right, shape[1])


def lies_in(window: Rectangle, held: Rectangle) -> bool:
    """Return whether a window reaches nowhere beyond a rectangle."""
    return window[0] >= held[0] and window[1] <= held[1] and window[2] >= held[2] and window[3] <= held[3]


class WrittenWindow(NamedTuple):
    """Checksum of a written window, and its numbers of values, and of values beyond black and white."""

    sha256: str
    n_values: int
    n_beyond: int


WriteWindow = Callable[[str, NDArray[Any], CodeRange], WrittenWindow]
"""Function that writes a window of a name, with values of which some are shown black and white."""


def suffix(scale: CodeRange, dtype: np.dtype[Any]) -> str:
    """Return the end of a window's name: .png where that format holds the values as they are, else .exr."""
    is_full = dtype.kind == "u" and scale == CodeRange(0, np.iinfo(dtype).max)
    return ".png" if is_full else ".exr"


def write_window(
    path: Path, values: NDArray[Any], scale: CodeRange, *, clip: bool, of_signals: SignalDisplay | None
) -> WrittenWindow:
    """Write a window with values as recorded: 8 or 16 bits as PNG, all else as EXR of the code values.

    With `clip`, code values are clipped to [0, 1], as a display with this transfer function does. A display of
    signals has no ends, shows each value as a square of pixels, and may blur. Raises OutputError if the file
    cannot be written.
    """
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        # Noise does not compress; run lengths find what does in a fraction of the time.
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
        shown = np.ascontiguousarray(values if values.ndim == 2 else values[..., ::-1])
        content = cv2.imencode(".png", shown, options)[1].tobytes()
        try:
            path.write_bytes(content)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
        return WrittenWindow(hashlib.sha256(content).hexdigest(), values.size, 0)
    code = ((values.astype(np.float64) - scale.low) / (scale.high - scale.low)).astype(np.float32)
    if of_signals is not None:
        pixels = of_signals.of_sensor.pixels_per_detector
        code = code.repeat(pixels, axis=0).repeat(pixels, axis=1)
        if blur := of_signals.blur_sigma_px:
            code = np.asarray(cv2.GaussianBlur(code, (0, 0), blur, borderType=cv2.BORDER_REPLICATE), np.float32)
    n_beyond = 0 if of_signals is not None else int(np.count_nonzero((code < 0.0) | (code > 1.0)))
    write_frame(path, np.clip(code, 0.0, 1.0) if clip else code, pixel_type="float", compression="zips")
    return WrittenWindow(frame_sha256(path), code.size, n_beyond)


def window_writer(
    folder: Path,
    kept: Mapping[str, bytes],
    add: Callable[[str, bytes], None],
    *,
    clip: bool,
    of_signals: SignalDisplay | None = None,
) -> WriteWindow:
    """Return a function that writes windows into a folder, as `write_window` does, unless an earlier run has:
    `kept` are its rows and `add` adds one, as `Rows.of_work` yields them.
    """

    def write(name: str, values: NDArray[Any], scale: CodeRange) -> WrittenWindow:
        path, item = folder / name, fingerprint(name, values, scale, clip, of_signals).hex()
        if (row := kept.get(item)) is not None:
            with suppress(FrameError, msgspec.MsgspecError):
                written = msgspec.json.decode(row, type=WrittenWindow)
                if frame_sha256(path) == written.sha256:
                    return written
        written = write_window(path, values, scale, clip=clip, of_signals=of_signals)
        add(item, msgspec.json.encode(written))
        return written

    return write


OBJECT_SIZE = "object_size_mrad"
"""Column with the size at the camera. It groups, because the displayed size varies a little with perspective."""

SAME_SIZE = 0.005
"""Relative difference of displayed sizes below which they count as one; thresholds change by a quarter of it."""

SHAKE_PX = 0.25
"""Root mean square motion within a trial from which it is reported; it blurs like half of a pixel's width."""

FIELD_PLACE = ("object_x_mrad", "object_y_mrad")
"""Columns with the place of the chart in the camera's field, where it has been moved: they group as well."""


class TriangleDescription(NamedTuple):
    """A triangle of a page: its level, polarity, and its further columns in the manifest."""

    level: float
    polarity: int
    columns: Mapping[str, object]


class Correction(NamedTuple):
    """The place and size of a triangle as known when all frames are read: motion of the place, and √(area)."""

    right_px: float
    down_px: float
    size_px: float


class TrialFrame(NamedTuple):
    """A frame of a trial: its window's name in the dataset and as written, its source, and its time."""

    name: str
    source: str
    time_s: float | None
    written: WrittenWindow

    @property
    def rounded_s(self) -> float:
        """The time as the manifest has it; NaN if it is not known."""
        return math.nan if self.time_s is None else round(self.time_s, 6)


@dataclass(slots=True, kw_only=True)
class ImportedTrial:
    """Frames of one triangle that the observer integrates, with its places in the windows.

    `window` and `start_px` are the window and the triangle's place in the first frame. `run` is the name of the
    run of frames without a gap, of one triangle in one window. The first `n_warm_up` of `frames` are frames of
    warm-up, which only the first trial of a run has; `places_px`, `sizes_px` and `numbers` are those of the
    others. `n_before` is the number of frames in the run before the trial.
    """

    name: str
    clip: int
    run: str
    stimulus: TriangleDescription
    orientation: Orientation
    window: Rectangle
    last_window: Rectangle
    start_px: tuple[float, float]
    n_before: int = 0
    n_warm_up: int = 0
    frames: list[TrialFrame] = field(default_factory=list)
    places_px: list[tuple[float, float]] = field(default_factory=list)
    sizes_px: list[float] = field(default_factory=list)
    numbers: list[int | None] = field(default_factory=list)

    @property
    def motion_px(self) -> float:
        """Root mean square distance of the places from their mean."""
        if len(self.places_px) < 2:
            return 0.0
        places = np.array(self.places_px)
        return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))

    @property
    def is_in_time(self) -> bool:
        """Whether the times of the frames are known and rise, as those of a clip do."""
        return all(frame.rounded_s < after.rounded_s for frame, after in pairwise(self.frames))

    def correct(self, corrections: Mapping[int, Correction]) -> None:
        """Move the places, and replace the sizes, for which the source knows better ones."""
        for k, number in enumerate(self.numbers):
            if number is not None and (better := corrections.get(number)) is not None:
                x, y = self.places_px[k]
                self.places_px[k] = x + better.right_px, y + better.down_px
                self.sizes_px[k] = better.size_px

    def followed(self, placed: Placed) -> Rectangle:
        """Return the window of the first frame, moved with the triangle by whole pixels."""
        if placed.x_px is None or placed.y_px is None:
            return self.window
        right, down = round(placed.x_px - self.start_px[0]), round(placed.y_px - self.start_px[1])
        top, bottom, left, far = self.window
        return top + down, bottom + down, left + right, far + right


def merged_sizes(sizes: list[float]) -> list[float]:
    """Return sizes in which those that differ by less than `SAME_SIZE` share their mean.

    Measured sizes of equal triangles differ by 1e-4, and each size costs the observer templates of its own.
    """
    groups: list[list[float]] = []
    for size in sorted(sizes):
        if not groups or size > groups[-1][0] * (1.0 + SAME_SIZE):
            groups.append([])
        groups[-1].append(size)
    merged = {size: float(np.mean(group)) for group in groups for size in group}
    return [merged[size] for size in sizes]


class TrialDivision:
    """The division of clips into trials of the integration time, without one a trial a clip; windows are written.

    All frames of a trial have the same window of the recorded frames, as they have on the display: if the triangle
    moves there within the integration time, the eye sees it blurred, and so does the observer. If it is `steady`,
    the window follows the triangle by whole pixels instead. `is_per_level`: the scales hold for a level of 1, and
    stretch with that of the trial.

    `n_moved` counts trials left out since the triangle went farther than a window may, or off the frame, and
    `n_before` has the number of trials with each number of frames before them in their run.
    """

    def __init__(
        self,
        described: Callable[[int, int], TriangleDescription],
        integration_time_s: float | None,
        *,
        steady: bool,
        is_per_level: bool = False,
        write: WriteWindow,
    ) -> None:
        self.trials: list[ImportedTrial] = []
        self.n_moved = 0
        self.n_before: Counter[int] = Counter()
        self._described = described
        self._time_s = integration_time_s
        self._steady = steady
        self._is_per_level = is_per_level
        self._write = write
        # By triangle; None for one that was lost before the end of the present trial.
        self._open: dict[int, ImportedTrial | None] = {}
        # By triangle; the whole trial that ended with the frame before.
        self._before: dict[int, ImportedTrial] = {}

    def take(self, frames: Iterable[tuple[Clip, ClipFrame]], scale: CodeRange, frame_s: float | None) -> None:
        """Divide the frames of one recording, in the order of time, and write their windows."""
        integration = Integration(self._time_s, frame_s)
        clip: Clip | None = None
        number = 0
        for now, frame in frames:
            if clip is not now:
                self._end(clip, integration.is_whole)
                self._before = {}
                integration.begin_clip()
                clip, number = now, 0
            elif self._open and (end := integration.ends_before(frame.time_s)) is not None:
                is_whole, is_gap = end
                self._end(clip, is_whole)
                clip.n_gaps += is_gap
                self._before = {} if is_gap else self._before
            is_first = not any(self._open.values())
            number += is_first
            integration.add(frame.time_s, first=is_first)
            if is_first:
                self._open = {
                    index: self._begun(clip, frame, index, number) for index in range(len(frame.triangles))
                }
                has_times = all(before.time_s is not None for before in frame.before)
                for trial in (one for one in self._open.values() if one is not None and not one.n_before):
                    for k, before in enumerate(frame.before if has_times else ()):
                        self._add(trial, f"before_{k:03d}", before, trial.window, scale)
                    trial.n_before = trial.n_warm_up = len(frame.before) if has_times else 0
            for index, placed in enumerate(frame.triangles):
                self._take(frame, index, placed, scale)
        self._end(clip, integration.is_whole)

    def _begun(self, clip: Clip, frame: ClipFrame, index: int, number: int) -> ImportedTrial | None:
        """Begin a trial of a triangle; None if it does not lie on the frame."""
        placed = frame.triangles[index]
        if placed is None:
            return None
        which = f"_{index + 1}" if len(frame.triangles) > 1 else ""
        before, n_before, window = self._before.get(index), 0, placed.window
        # A triangle that lies between two pixels may have a window that differs by one.
        if before is not None and np.abs(np.subtract(before.last_window, window)).max() < MARGIN_PX:
            run, window = before.run, before.last_window
            n_before = before.n_before + len(before.frames) - before.n_warm_up
        else:
            run = f"clip_{clip.number:04d}{which}" + (f"_from_trial_{number:02d}" if number > 1 else "")
        return ImportedTrial(
            name=f"clip_{clip.number:04d}/trial_{number:02d}{which}",
            clip=clip.number,
            run=run,
            stimulus=self._described(frame.page, index),
            orientation=placed.orientation,
            window=window,
            last_window=window,
            start_px=(placed.x_px or 0.0, placed.y_px or 0.0),
            n_before=n_before,
        )

    def _take(self, frame: ClipFrame, index: int, placed: Placed | None, scale: CodeRange) -> None:
        """Write the window of a triangle, unless its trial has ended early or does now."""
        trial = self._open[index]
        if trial is None:
            return
        window = trial.followed(placed) if self._steady and placed is not None else trial.window
        if placed is None or not lies_in(window, placed.held):
            self.n_moved += 1
            self._open[index] = None
            return
        number = str(len(trial.frames) - trial.n_warm_up)
        self._add(trial, number, frame, window, scale)
        trial.last_window = window
        trial.sizes_px.append(placed.size_px)
        trial.numbers.append(placed.number)
        if placed.x_px is not None and placed.y_px is not None:
            trial.places_px.append((placed.x_px - window[2], placed.y_px - window[0]))

    def _add(
        self, trial: ImportedTrial, end: str, frame: RecordedFrame | ClipFrame, window: Rectangle, scale: CodeRange
    ) -> None:
        top, bottom, left, right = window
        values = frame.values[top:bottom, left:right]
        if self._is_per_level:
            scale = CodeRange(scale.low, scale.low + trial.stimulus.level * (scale.high - scale.low))
        name = f"frames/{trial.name}_{end}{suffix(scale, values.dtype)}"
        trial.frames.append(TrialFrame(name, frame.source, frame.time_s, self._write(name, values, scale)))

    def _end(self, clip: Clip | None, is_whole: bool) -> None:
        """End the present trials; keep them if they are whole."""
        self._before = {}
        for index, trial in self._open.items():
            if trial is None or clip is None or not is_whole:
                continue
            if trial.n_warm_up and not trial.is_in_time:  # without times that rise it is from no clip
                del trial.frames[: trial.n_warm_up]
                trial.n_before = trial.n_warm_up = 0
            self.n_before[trial.n_before] += 1
            self.trials.append(trial)
            self._before[index] = trial
            clip.n_trials += 1
        self._open = {}

    def rows(
        self,
        *,
        level: str,
        pitch_mrad: float,
        field_places: Mapping[int, Mapping[str, str]],
        pixels_per_value: int = 1,
    ) -> Iterator[dict[str, object]]:
        """Yield the rows of the manifest; `field_places` are further columns of each clip, and a recorded value is
        shown as a square of `pixels_per_value` by as many pixels.

        Those of a dataset with frames of warm-up have the column `judged`.
        """
        has_judged = any(trial.n_warm_up for trial in self.trials)
        sizes_px = merged_sizes([float(np.mean(trial.sizes_px)) for trial in self.trials])
        last_s: dict[str, float] = {}
        for trial, size_px in zip(self.trials, sizes_px, strict=True):
            # Times that are not known, or that a camera writes to the second, make no clip.
            first_s, end_s = trial.frames[0].rounded_s, trial.frames[-1].rounded_s
            has_clip = trial.is_in_time and last_s.get(trial.run, -math.inf) < first_s
            last_s[trial.run] = end_s if has_clip else math.inf
            x, y = "", ""
            if trial.places_px:
                shown_px = (np.mean(trial.places_px, axis=0) + 0.5) * pixels_per_value - 0.5
                x, y = (f"{at:.4f}" for at in shown_px)
            for number, frame in enumerate(trial.frames):
                is_judged = number >= trial.n_warm_up
                row: dict[str, object] = {
                    "frame": frame.name,
                    "orientation": trial.orientation.value,
                    "size_mrad": f"{size_px * pitch_mrad:.7g}",
                    level: repr(trial.stimulus.level),
                    "polarity": trial.stimulus.polarity,
                    "x_px": x,
                    "y_px": y,
                    "trial": trial.name if is_judged else "",
                    "sha256": frame.written.sha256,
                    "clip": trial.run if has_clip else "",
                    "time_s": "" if frame.time_s is None else f"{frame.time_s:.6f}",
                    **({"judged": int(is_judged)} if has_judged else {}),
                    "source": frame.source,
                }
                others = {**trial.stimulus.columns, **field_places.get(trial.clip, {})}
                yield row | {name: text for name, text in others.items() if name not in row}
