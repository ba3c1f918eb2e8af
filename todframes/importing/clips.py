"""Clips and trials: the runs of frames in which a chart shows one page, and the parts that an observer integrates.

Frames of transitions are left out. Most have markers of two pages, or of none. If a frame holds only a small share
of the page before or after (a slow display, an exposure across the change), its markers read well. Then the
modules in which the markers of the two pages differ give the share, which is compared with that of the other
frames of the clip.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.charts.layout import marker_bits, marker_ids
from todframes.recordings.recording import GAP, TIME_TOLERANCE, RecordedFrame, Recording
from todframes.stimulus import Orientation

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
    `first_number` is that of the first clip. Frames are held back only as long as needed for the comparison, so
    memory does not grow with the clip.
    """
    clip: Clip | None = None
    held: list[ClipFrame] = []
    before: int | None = None
    known: list[FloatArray] = []
    n_seen = 0
    for frame in frames:
        if clip is None or frame.page != clip.page:
            if clip is not None:
                yield from _released(clip, held, known, before if n_seen == len(held) else None, frame.page, key)
                before = clip.page
            number = first_number if clip is None else clip.number + 1
            clip, held, known, n_seen = Clip(number, frame.page), [], [], 0
        held.append(frame)
        known = [*known, frame.modules][-REFERENCE_FRAMES:]
        n_seen += 1
        if n_seen == REFERENCE_FRAMES:
            good = _without_other(clip, held[:EDGE_FRAMES], known, before, key, is_end=False)
            yield from _counted(clip, [*good, *held[EDGE_FRAMES:-EDGE_FRAMES]])
            held = held[-EDGE_FRAMES:]
        elif n_seen > REFERENCE_FRAMES:
            yield from _counted(clip, [held.pop(0)])
    if clip is not None:
        yield from _released(clip, held, known, before if n_seen == len(held) else None, None, key)


def _released(
    clip: Clip, held: list[ClipFrame], known: list[FloatArray], before: int | None, after: int | None, key: int
) -> Iterator[tuple[Clip, ClipFrame]]:
    """Yield the last frames of a clip without those that hold a share of the page before or after."""
    early = _without_other(clip, held[:EDGE_FRAMES], known, before, key, is_end=False)
    rest = [*early, *held[EDGE_FRAMES:]]
    cut = max(len(rest) - EDGE_FRAMES, 0)
    late = _without_other(clip, rest[cut:], known, after, key, is_end=True)
    yield from _counted(clip, [*rest[:cut], *late])


def _counted(clip: Clip, frames: Iterable[ClipFrame]) -> Iterator[tuple[Clip, ClipFrame]]:
    for frame in frames:
        clip.count(frame)
        yield clip, frame


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


class TrialEnd(NamedTuple):
    """The end of a trial: whether it has the whole integration time, and whether frames are missing then."""

    is_whole: bool
    is_gap: bool


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

    def ends_before(self, time_s: float | None) -> TrialEnd | None:
        """Return how the present trial ends if it ends before a frame of this time; None if it goes on."""
        start, last = self._start_s, self._last_s
        if self.frame_s is None or time_s is None or start is None or last is None:
            return None if self.time_s is None else TrialEnd(is_whole=True, is_gap=False)
        if self.time_s is None:
            return None
        if self.frame_s > GAP * self.time_s:  # photographs: each is a trial, and no frame is missing between two
            return TrialEnd(is_whole=True, is_gap=False)
        is_slow = len(self._intervals_s) == RECENT_INTERVALS
        if time_s - last > GAP * max(self.frame_s, min(self._intervals_s) if is_slow else 0.0):
            return TrialEnd(self.is_whole, is_gap=True)
        if time_s - start >= self.time_s - (0.5 + TIME_TOLERANCE) * self._local_s(time_s - last):
            return TrialEnd(is_whole=True, is_gap=False)
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
