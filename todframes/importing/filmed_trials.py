"""The trials of an imported dataset: frames are divided into integration times, and each trial gets a window."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.importing.clips import Clip, ClipFrame, Integration, Placed, Rectangle
from todframes.importing.windows import MARGIN_PX, WrittenWindow, lies_in, suffix
from todframes.recordings.recording import CodeRange, RecordedFrame
from todframes.stimulus import Orientation

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
        write: Callable[[str, NDArray[Any], CodeRange], WrittenWindow],
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
                self._end(clip, end.is_whole)
                clip.n_gaps += end.is_gap
                self._before = {} if end.is_gap else self._before
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
