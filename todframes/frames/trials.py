"""Trials of a dataset as a table: a million take some 500 MB."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple, SupportsIndex, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.stimulus import Orientation, Stimulus

Group = tuple[float | str, ...]

BLOCK = 4096
"""Number of trials that are made from the table at a time."""


class FrameReference(NamedTuple):
    """A frame as the manifest names it: its path relative to the dataset, its checksum and its background.
    `reference` is the path of the same frame without noise; None if there is none. `clip` is the name of the
    continuous recording that the frame is from, and `time_s` its time there in seconds; None if the manifest
    states none. `motion_px` is the triangle's displacement (x, y) in this frame from its mean place in the trial's
    frames; None if it is there.
    """

    path: str
    sha256: str | None
    background_luminance_cd_m2: float | None
    reference: str | None = None
    clip: str | None = None
    time_s: float | None = None
    motion_px: tuple[float, float] | None = None


class SceneView(NamedTuple):
    """The background of a frame. Frames that agree in all three have the same pixels before triangle and noise.
    `scene` is the name of the image, `turn` how it is turned and mirrored, and `window` which part of it is shown.
    """

    scene: str
    turn: str = ""
    window: str = ""


class Trial(NamedTuple):
    """One presentation: the frames to average, their stimulus and its position.

    `number` is the number of the first frame's row in the manifest and seeds the trial's random stream. `x_px` and
    `y_px` are the position of the triangle's centroid in pixels, its mean over the frames; None: the frame's
    centre. `group` has one value for each column of `group_by`. `view` is the scene behind the triangle; None: an
    even background. `warm_up` are the frames of the same clip that come directly before the trial, in the order of
    time; see `Trials.with_warm_up`.
    """

    number: int
    name: str
    frames: tuple[FrameReference, ...]
    orientation: Orientation
    stimulus: Stimulus
    level: float
    group: Group
    x_px: float | None
    y_px: float | None
    view: SceneView | None = None
    warm_up: tuple[FrameReference, ...] = ()


_ROW = np.dtype([(name, {"number": "i8", "level": "f8"}.get(name, "O")) for name in Trial._fields])
"""Type of a row of the table: the values of a `Trial`."""


class Trials(Sequence[Trial]):
    """Trials in the order of the manifest, held as a structured array; a `Trial` is made when it is asked for. The
    table does not change. One that is pickled takes along its own trials only, and if it is no selection, the
    frames that are in no trial. Arrays that the properties return have an element for each trial.
    """

    def __init__(
        self, table: NDArray[Any], unjudged: Sequence[FrameReference] = (), source: Trials | None = None
    ) -> None:
        self._table, self._unjudged, self._source = table, unjudged, source
        self._coded: dict[str, tuple[tuple[Any, ...], NDArray[np.int32]]] = {}

    @classmethod
    def of(cls, trials: Iterable[Trial], unjudged: Sequence[FrameReference] = ()) -> Trials:
        """Return trials as a table, with the frames that are in none: the same object if they are one already."""
        return trials if isinstance(trials, Trials) else Trials(np.fromiter(trials, _ROW), unjudged)

    def __len__(self) -> int:
        return len(self._table)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Trial: ...
    @overload
    def __getitem__(self, index: slice) -> Trials: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Trial | Trials:
        return self.select(index) if isinstance(index, slice) else Trial._make(self._table[index].item())

    def __iter__(self) -> Iterator[Trial]:
        for start in range(0, len(self), BLOCK):
            block = self._table[start : start + BLOCK]
            yield from map(Trial, *(block[name].tolist() for name in Trial._fields))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trials):
            return NotImplemented
        return len(self) == len(other) and all(left == right for left, right in zip(self, other, strict=True))

    def __hash__(self) -> int:
        return hash(self.numbers.tobytes())

    def __repr__(self) -> str:
        return f"<Trials: {len(self)}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return Trials, (self._table, self._unjudged)

    def select(self, indices: ArrayLike | slice) -> Trials:
        """Return the trials at some indices, in the order of these, or those for which a mask is true."""
        if not isinstance(indices, slice):
            indices = np.asarray(indices)
            if indices.dtype != np.bool_:
                indices = indices.astype(np.intp, copy=False)
        return self._with(self._table[indices])

    def placed(self, position_px: FloatArray) -> Trials:
        """Return the same trials at other positions (x, y) in pixels, shape (n, 2); NaN: the frame's centre."""
        table = self._table.copy()
        for name, along in zip(("x_px", "y_px"), np.asarray(position_px).T, strict=True):
            table[name] = np.where(np.isnan(along), None, along)
        return self._with(table)

    def with_warm_up(self, n_frames: int) -> Trials:
        """Return the same trials with up to `n_frames` frames of warm-up each: `Trial.warm_up`. They are the
        frames that come before the trial's first frame in its clip, whether they are judged or not. A trial near
        the beginning of its clip has fewer, one without a clip none.
        """
        clips: dict[str | None, list[FrameReference]] = {}
        time_s = attrgetter("time_s")
        for frame in (*chain.from_iterable(self._whole._table["frames"]), *self.unjudged_frames):
            clips.setdefault(frame.clip, []).append(frame)
        clips[None] = []
        for frames in clips.values():
            frames.sort(key=time_s)
        table = self._table.copy()
        for row, (first, *_) in enumerate(table["frames"].tolist()):
            frames = clips[first.clip]
            end = bisect_left(frames, first.time_s, key=time_s)
            table["warm_up"][row] = tuple(frames[max(end - n_frames, 0) : end])
        return self._with(table)

    def _with(self, table: NDArray[Any]) -> Trials:
        """Return a table of some of the same trials."""
        return Trials(table, source=self._whole)

    @property
    def _whole(self) -> Trials:
        """The trials that these were selected from."""
        return self if self._source is None else self._source

    @property
    def unjudged_frames(self) -> Sequence[FrameReference]:
        """Frames that are in no trial: those that the manifest marks as not judged. Those of a selection are those
        of the trials that it was selected from.
        """
        return self._whole._unjudged

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Number of each trial."""
        return self._column("number", np.int64)

    @property
    def levels(self) -> FloatArray:
        """Stimulus strength of each trial."""
        return self._column("level", np.float64)

    @property
    def quarter_turns(self) -> NDArray[np.intp]:
        """Orientation of each trial, an index into `ORIENTATIONS`."""
        orientations, codes = self._codes("orientation")
        return np.array([orientation.quarter_turns for orientation in orientations], np.intp)[codes]

    @property
    def stimuli(self) -> tuple[Stimulus, ...]:
        """Stimuli that `stimulus_codes` count."""
        return self._codes("stimulus")[0]

    @property
    def stimulus_codes(self) -> NDArray[np.int32]:
        """Stimulus of each trial, an index into `stimuli`."""
        return self._codes("stimulus")[1]

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups that `group_codes` count."""
        return self._codes("group")[0]

    @property
    def group_codes(self) -> NDArray[np.int32]:
        """Group of each trial, an index into `groups`."""
        return self._codes("group")[1]

    @property
    def positions_px(self) -> FloatArray:
        """Position (x, y) of each trial's triangle in pixels, shape (n, 2); NaN: the frame's centre."""
        return np.stack([self._column(name, np.float64) for name in ("x_px", "y_px")], axis=1)

    @property
    def views(self) -> tuple[SceneView | None, ...]:
        """Scenes that `view_codes` count."""
        return self._codes("view")[0]

    @property
    def view_codes(self) -> NDArray[np.int32]:
        """Scene of each trial, an index into `views`."""
        return self._codes("view")[1]

    @property
    def has_scenes(self) -> bool:
        """Whether any of the trials has a scene behind its triangle."""
        return any(view is not None for view in self.views)

    @property
    def scene_numbers(self) -> NDArray[np.intp] | None:
        """Number of each trial's scene, in the order of their names; None if no trial has one."""
        names = ["" if view is None else view.scene for view in self.views]
        if not any(names):
            return None
        _, numbers = np.unique(np.array(names)[self.view_codes], return_inverse=True)
        return np.asarray(numbers, np.intp)

    @property
    def frames(self) -> Iterator[FrameReference]:
        """All frames of all trials, each trial's in the order of time."""
        return chain.from_iterable(self._table["frames"])

    @property
    def warm_up(self) -> Iterator[FrameReference]:
        """Frames of warm-up of all trials; see `with_warm_up`."""
        return chain.from_iterable(self._table["warm_up"])

    @property
    def frame_counts(self) -> NDArray[np.int64]:
        """Number of frames of each trial."""
        return np.array([len(frames) for frames in self._table["frames"].tolist()], np.int64)

    @property
    def n_frames(self) -> int:
        """Number of frames of all trials."""
        return int(self.frame_counts.sum())

    @property
    def most_motion_px(self) -> float:
        """Largest distance of a triangle from its mean place in the trial's frames; 0 if none moves."""
        frames = chain.from_iterable(self._table["frames"])
        return max((math.hypot(*frame.motion_px) for frame in frames if frame.motion_px), default=0.0)

    def names(self) -> Iterator[str]:
        """Yield the name of each trial."""
        yield from self._table["name"]

    def by_stimulus(self) -> list[tuple[Stimulus, NDArray[np.intp]]]:
        """Return each stimulus, in the order of first trials, with the indices of its trials, ascending."""
        return list(zip(self.stimuli, indices_by(self.stimulus_codes), strict=True))

    def by_group(self) -> list[tuple[Group, NDArray[np.intp]]]:
        """Return each group with the indices of its trials, as `by_stimulus` does."""
        return list(zip(self.groups, indices_by(self.group_codes), strict=True))

    def by_view(self) -> list[tuple[SceneView | None, NDArray[np.intp]]]:
        """Return each scene with the indices of its trials, as `by_stimulus` does."""
        return list(zip(self.views, indices_by(self.view_codes), strict=True))

    def indices_of_group(self, group: Group) -> NDArray[np.intp]:
        """Return the indices of the trials of a group, ascending."""
        if group not in self.groups:
            return np.zeros(0, np.intp)
        return np.flatnonzero(self.group_codes == self.groups.index(group))

    def _codes(self, name: str) -> tuple[tuple[Any, ...], NDArray[np.int32]]:
        """Return the distinct values of a column in the order of their first rows, and each row's index there."""
        if name not in self._coded:
            codes: dict[Any, int] = {}
            of_each = np.array([codes.setdefault(value, len(codes)) for value in self._table[name]], np.int32)
            of_each.flags.writeable = False
            self._coded[name] = tuple(codes), of_each
        return self._coded[name]

    def _column(self, name: str, dtype: type[Any]) -> NDArray[Any]:
        """Return a copy of a column; None becomes NaN."""
        return self._table[name].astype(dtype)


def indices_by(codes: NDArray[np.integer]) -> list[NDArray[np.intp]]:
    """Return the indices, ascending, at which each code stands; codes are in the order of their first index."""
    order = np.argsort(codes, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(codes) else []
    return sorted(parts, key=lambda part: int(part[0]))


def joined(first: Trial, other: Trial) -> tuple[Trial, FrameReference]:
    """Return a trial of one frame that joins another trial, at that one's place, and its frame with its motion. In
    a clip, the triangle may move from frame to frame: the place of `first` is that in its first frame.
    """
    (frame,) = other.frames
    if None in (first.frames[0].clip, frame.clip, first.x_px, first.y_px, other.x_px, other.y_px):
        return other, frame
    assert first.x_px is not None and first.y_px is not None and other.x_px is not None and other.y_px is not None
    moved_px = other.x_px - first.x_px, other.y_px - first.y_px
    if any(moved_px):
        frame = frame._replace(motion_px=moved_px)
    return other._replace(x_px=first.x_px, y_px=first.y_px), frame


def with_frames(trial: Trial, others: Iterable[FrameReference]) -> Trial:
    """Return a trial with other `joined` frames, at the mean of its places, from which their motion counts."""
    trial = trial._replace(frames=(*trial.frames, *others))
    moved_px = [frame.motion_px or (0.0, 0.0) for frame in trial.frames]
    if not any(map(any, moved_px)):
        return trial
    assert trial.x_px is not None and trial.y_px is not None
    x_px, y_px = (sum(along) / len(moved_px) for along in zip(*moved_px, strict=True))
    frames = (
        frame._replace(motion_px=(x - x_px, y - y_px) if (x, y) != (x_px, y_px) else None)
        for frame, (x, y) in zip(trial.frames, moved_px, strict=True)
    )
    return trial._replace(frames=tuple(frames), x_px=trial.x_px + x_px, y_px=trial.y_px + y_px)
