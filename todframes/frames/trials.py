"""Trials of a dataset as columns: a million take some 150 MB, where as many objects would take a gigabyte."""

from __future__ import annotations

from array import array
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Generic, NamedTuple, SupportsIndex, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus

V = TypeVar("V", bound=Hashable)

Group = tuple[float | str, ...]

UNJUDGED = -1
"""Index of the trial of frames that are in none."""

BLOCK = 4096
"""Number of trials that are made from the columns at a time."""


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
    even background. `place` is the number, from 1, of the triangle's place among those of its experiment, and
    `place_step_px` the distance of neighbouring places; None: the place is known. `warm_up` are the frames of the
    same clip that come directly before the trial, in the order of time; see `Trials.with_warm_up`.
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
    place: int | None = None
    place_step_px: float | None = None
    warm_up: tuple[FrameReference, ...] = ()


class Trials(Sequence[Trial]):
    """Trials in the order of the manifest, held as columns; a `Trial` is made when it is asked for.

    The columns do not change. A selection shares the columns of the trials that it was selected from; one that is
    pickled takes along its own trials only.

    `Trials.of` makes one of any trials. Arrays that the properties return have an element for each trial.
    """

    __slots__ = ("_columns", "_rows")

    def __init__(self, columns: _TrialColumns, rows: NDArray[np.intp]) -> None:
        self._columns = columns
        self._rows = rows

    @classmethod
    def of(cls, trials: Iterable[Trial]) -> Trials:
        """Return trials as columns: the same object if they are columns already."""
        if isinstance(trials, Trials):
            return trials
        builder = TrialsBuilder()
        for trial in trials:
            builder.append(trial)
        return builder.trials()

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Trial: ...
    @overload
    def __getitem__(self, index: slice) -> Trials: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Trial | Trials:
        if isinstance(index, slice):
            return self.select(index)
        (trial,) = self._columns.made(self._rows[np.array([index], np.intp)])
        return trial

    def __iter__(self) -> Iterator[Trial]:
        for start in range(0, len(self), BLOCK):
            yield from self._columns.made(self._rows[start : start + BLOCK])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trials):
            return NotImplemented
        return len(self) == len(other) and all(one == two for one, two in zip(self, other, strict=True))

    def __hash__(self) -> int:
        return hash(self.numbers.tobytes())

    def __repr__(self) -> str:
        return f"<Trials: {len(self)}>"

    def __reduce__(self) -> tuple[Any, ...]:
        columns, rows = self._columns, np.arange(len(self))
        if not np.array_equal(self._rows, np.arange(len(columns.number))):
            columns = columns.taken(self._rows)
        return Trials, (columns, rows)

    def select(self, indices: ArrayLike | slice) -> Trials:
        """Return the trials at some indices, in the order of these, or those for which a mask is true."""
        if not isinstance(indices, slice):
            indices = np.asarray(indices)
            if indices.dtype != np.bool_:
                indices = indices.astype(np.intp, copy=False)
        return Trials(self._columns, self._rows[indices])

    def placed(self, position_px: FloatArray) -> Trials:
        """Return the same trials at other positions (x, y) in pixels, shape (n, 2); NaN: the frame's centre."""
        moved = np.full((len(self._columns.number), 2), np.nan)
        moved[self._rows] = position_px
        return Trials(replace(self._columns, position_px=moved), self._rows)

    def with_warm_up(self, n_frames: int) -> Trials:
        """Return the same trials with up to `n_frames` frames of warm-up each: `Trial.warm_up`.

        They are the frames that come before the trial's first frame in its clip, whether they are judged or not. A
        trial near the beginning of its clip has fewer, one without a clip none. `Trials.of` does not take them
        over from single trials.
        """
        return Trials(replace(self._columns, warm_up=self._columns.found_warm_up(n_frames)), self._rows)

    def unjudged_frames(self) -> Iterator[FrameReference]:
        """Yield the frames that are in no trial: those that the manifest marks as not judged.

        Those of a selection are those of the trials that it was selected from.
        """
        frames, first = self._columns.frames, int(self._columns.first_frame[-1])
        for start in range(first, len(frames), BLOCK):
            yield from frames.made(np.arange(start, min(start + BLOCK, len(frames))))

    @property
    def n_unjudged_frames(self) -> int:
        """Number of frames that are in no trial."""
        return len(self._columns.frames) - int(self._columns.first_frame[-1])

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Number of each trial."""
        return self._columns.number[self._rows]

    @property
    def levels(self) -> FloatArray:
        """Stimulus strength of each trial."""
        return self._columns.level[self._rows]

    @property
    def quarter_turns(self) -> NDArray[np.intp]:
        """Orientation of each trial, an index into `ORIENTATIONS`."""
        return self._columns.orientation[self._rows].astype(np.intp)

    @property
    def stimuli(self) -> tuple[Stimulus, ...]:
        """Stimuli that `stimulus_codes` count; a selection may lack some of them."""
        return self._columns.stimuli

    @property
    def stimulus_codes(self) -> NDArray[np.int32]:
        """Stimulus of each trial, an index into `stimuli`."""
        return self._columns.stimulus[self._rows]

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups that `group_codes` count; a selection may lack some of them."""
        return self._columns.groups

    @property
    def group_codes(self) -> NDArray[np.int32]:
        """Group of each trial, an index into `groups`."""
        return self._columns.group[self._rows]

    @property
    def positions_px(self) -> FloatArray:
        """Position (x, y) of each trial's triangle in pixels, shape (n, 2); NaN: the frame's centre."""
        position_px = self._columns.position_px
        return np.full((len(self), 2), np.nan) if position_px is None else position_px[self._rows]

    @property
    def views(self) -> tuple[SceneView | None, ...]:
        """Scenes that `view_codes` count; a selection may lack some of them."""
        return tuple(one.view for one in self._columns.backdrops)

    @property
    def view_codes(self) -> NDArray[np.int32]:
        """Scene of each trial, an index into `views`."""
        return self._columns.backdrop[self._rows]

    @property
    def has_scenes(self) -> bool:
        """Whether any of the trials has a scene behind its triangle."""
        return any(self.views[code] is not None for code in np.unique(self.view_codes).tolist())

    @property
    def scene_numbers(self) -> NDArray[np.intp] | None:
        """Number of each trial's scene, in the order of their names; None if no trial has one."""
        names = ["" if view is None else view.scene for view in self.views]
        if not any(names):
            return None
        _, numbers = np.unique(np.array(names)[self.view_codes], return_inverse=True)
        return np.asarray(numbers, np.intp)

    @property
    def places(self) -> NDArray[np.int32]:
        """Number of each trial's place; 0 where it is known."""
        return np.array([one.place or 0 for one in self._columns.backdrops], np.int32)[self.view_codes]

    @property
    def place_steps_px(self) -> FloatArray:
        """Distance of neighbouring places of each trial in pixels; NaN where the place is known."""
        steps = [np.nan if one.step_px is None else one.step_px for one in self._columns.backdrops]
        return np.array(steps)[self.view_codes]

    @property
    def frame_counts(self) -> NDArray[np.int64]:
        """Number of frames of each trial."""
        return np.asarray(np.diff(self._columns.first_frame)[self._rows])

    @property
    def n_frames(self) -> int:
        """Number of frames of all trials."""
        return int(self.frame_counts.sum())

    @property
    def most_motion_px(self) -> float:
        """Largest distance of a triangle from its mean place in the trial's frames; 0 if none moves."""
        return self._columns.most_motion_px(self._rows)

    def names(self) -> Iterator[str]:
        """Yield the name of each trial."""
        for start in range(0, len(self), BLOCK):
            yield from self._columns.names(self._rows[start : start + BLOCK])

    def indices_of_group(self, group: Group) -> NDArray[np.intp]:
        """Return the indices of the trials of a group, ascending."""
        if group not in self.groups:
            return np.zeros(0, np.intp)
        return np.flatnonzero(self.group_codes == self.groups.index(group))


def indices_by(codes: NDArray[np.integer]) -> list[NDArray[np.intp]]:
    """Return the indices, ascending, at which each code stands; codes are in the order of their first index."""
    order = np.argsort(codes, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(codes) else []
    return sorted(parts, key=lambda part: int(part[0]))


def joined(first: Trial, clip: str | None, other: Trial) -> tuple[Trial, FrameReference]:
    """Return a trial of one frame that joins another trial, at that one's place, and its frame with its motion.

    In a clip, the triangle may move from frame to frame: the place of `first` is that in its first frame.
    """
    (frame,) = other.frames
    if None in (clip, frame.clip, first.x_px, first.y_px, other.x_px, other.y_px):
        return other, frame
    assert first.x_px is not None and first.y_px is not None and other.x_px is not None and other.y_px is not None
    moved_px = other.x_px - first.x_px, other.y_px - first.y_px
    if any(moved_px):
        frame = frame._replace(motion_px=moved_px)
    return other._replace(x_px=first.x_px, y_px=first.y_px), frame


# Columns -------------------------------------------------------------------------------------------------------


class TrialsBuilder:
    """Columns that grow by a trial, or by a frame of a trial, at a time."""

    def __init__(self) -> None:
        self._number, self._orientation, self._level = array("q"), array("b"), array("d")
        self._stimulus, self._group, self._position_px = array("i"), array("i"), array("d")
        self._first_frame, self._trial_of_frame, self._background = array("i"), array("i"), array("d")
        self._name, self._path, self._sha256, self._reference = (_Texts() for _ in range(4))
        self._stimuli, self._groups = _Codes[Stimulus](), _Codes[Group]()
        self._backdrop, self._backdrops = array("i"), _Codes[_Backdrop]()
        self._clip, self._time_s, self._motion_px = array("i"), array("d"), array("d")
        self._clips = _Codes[str]()

    def __len__(self) -> int:
        return len(self._number)

    @property
    def n_frames(self) -> int:
        """Number of frames of all trials."""
        return len(self._trial_of_frame)

    def append(self, trial: Trial) -> None:
        """Add a trial with its frames."""
        number, name, frames, orientation, stimulus, level, group, x_px, y_px, view, place, step_px, _ = trial
        index = len(self._number)
        self._name.append(b"" if name == frames[0].path else _encoded(f"={name}"))
        self._number.append(number)
        self._orientation.append(ORIENTATIONS.index(orientation))
        self._stimulus.append(self._stimuli.code(stimulus))
        self._level.append(level)
        self._group.append(self._groups.code(group))
        self._position_px.append(np.nan if x_px is None else x_px)
        self._position_px.append(np.nan if y_px is None else y_px)
        self._backdrop.append(self._backdrops.code(_Backdrop(view, place, step_px)))
        self._first_frame.append(len(self._trial_of_frame))
        for frame in frames:
            self.append_frame(index, frame)

    def append_frame(self, index: int, frame: FrameReference) -> None:
        """Add a frame to the trial at an index."""
        path, sha256, background_cd_m2, reference, clip, time_s, motion_px = frame
        self._trial_of_frame.append(index)
        if self._clip or (clip, time_s, motion_px) != (None, None, None):
            self._append_clip(clip, time_s, motion_px)
        self._path.append(_encoded(path))
        self._sha256.append(b"" if sha256 is None else _packed_sha256(sha256))
        self._background.append(np.nan if background_cd_m2 is None else background_cd_m2)
        self._reference.append(b"" if reference is None else _encoded(reference))

    def append_unjudged(self, frame: FrameReference) -> None:
        """Add a frame that is in no trial."""
        self.append_frame(UNJUDGED, frame)

    def _clip_columns(self, trial_of_frame: NDArray[np.int32]) -> tuple[_Clips | None, FloatArray | None]:
        """Return the columns of clips and the mean displacement of each trial, (n, 2); None if there are none."""
        if not self._clip:
            return None, None
        motion_px, middle_px = _column(self._motion_px, np.float64).reshape(-1, 2), None
        if motion_px.any():
            judged = trial_of_frame != UNJUDGED
            of_trial = trial_of_frame[judged]
            n_frames = np.bincount(of_trial, minlength=len(self))
            sums = [np.bincount(of_trial, along[judged], minlength=len(self)) for along in motion_px.T]
            middle_px = np.stack(sums, axis=1) / n_frames[:, None]
            motion_px = motion_px - np.where(judged[:, None], middle_px[trial_of_frame], motion_px)
        return _Clips(
            names=_Texts(map(_encoded, self._clips.values)),
            code=_column(self._clip, np.int32),
            time_s=_column(self._time_s, np.float64),
            motion_px=motion_px if motion_px.any() else None,
        ), middle_px

    def _append_clip(self, clip: str | None, time_s: float | None, motion_px: tuple[float, float] | None) -> None:
        """Add a frame's clip; the frames before the first one that has a clip get none."""
        missing = len(self._trial_of_frame) - 1 - len(self._clip)
        self._clip.extend([-1] * missing)
        self._time_s.extend([np.nan] * missing)
        self._motion_px.extend([0.0] * (2 * missing))
        self._clip.append(-1 if clip is None else self._clips.code(clip))
        self._time_s.append(np.nan if time_s is None else time_s)
        self._motion_px.extend(motion_px or (0.0, 0.0))

    def path(self, frame: int) -> str:
        """Return the path of a frame, by its number in the order in which frames were added."""
        return _decoded(self._path[frame])

    def name(self, index: int) -> str:
        """Return the name of the trial at an index."""
        return _decoded(self._name[index])[1:] if self._name[index] else self.path(self._first_frame[index])

    def clip(self, index: int) -> str | None:
        """Return the clip of the first frame of the trial at an index."""
        first = self._first_frame[index]
        code = self._clip[first] if first < len(self._clip) else -1
        return None if code < 0 else self._clips.values[code]

    def without_frames(self, index: int) -> Trial:
        """Return the trial at an index, without its frames."""
        x_px, y_px = self._position_px[2 * index : 2 * index + 2]
        return Trial(
            self._number[index],
            self.name(index),
            (),
            ORIENTATIONS[self._orientation[index]],
            self._stimuli.values[self._stimulus[index]],
            self._level[index],
            self._groups.values[self._group[index]],
            _or_none(x_px),
            _or_none(y_px),
            *self._backdrops.values[self._backdrop[index]],
        )

    def trials(self) -> Trials:
        """Return the trials; no more can be added afterwards."""
        trial_of_frame = _column(self._trial_of_frame, np.int32)
        position_px = _unless_missing(_column(self._position_px, np.float64).reshape(-1, 2))
        clips, middle_px = self._clip_columns(trial_of_frame)
        if middle_px is not None and position_px is not None:
            position_px = position_px + middle_px
        frames = _Frames(
            path=self._path,
            sha256=self._sha256.or_none(),
            background_cd_m2=_unless_missing(_column(self._background, np.float64)),
            reference=self._reference.or_none(),
            clips=clips,
        )
        is_judged = trial_of_frame != UNJUDGED
        order = np.where(is_judged, trial_of_frame, len(self))
        if np.any(np.diff(order) < 0):  # the frames of a trial are to follow each other, the unjudged ones all
            frames = frames.taken(np.argsort(order, kind="stable"))
        n_frames = np.bincount(trial_of_frame[is_judged], minlength=len(self))
        columns = _TrialColumns(
            number=_column(self._number, np.int64),
            name=self._name.or_none(),
            first_frame=np.concatenate([[0], np.cumsum(n_frames)]),
            frames=frames,
            orientation=_column(self._orientation, np.int8),
            stimulus=_column(self._stimulus, np.int32),
            level=_column(self._level, np.float64),
            group=_column(self._group, np.int32),
            position_px=position_px,
            backdrop=_column(self._backdrop, np.int32),
            stimuli=tuple(self._stimuli.values),
            groups=tuple(self._groups.values),
            backdrops=tuple(self._backdrops.values),
        )
        return Trials(columns, np.arange(len(self)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Frames:
    """Columns of frames; those in which all values are missing are None."""

    path: _Texts
    sha256: _Texts | None
    background_cd_m2: FloatArray | None
    reference: _Texts | None
    clips: _Clips | None

    def __len__(self) -> int:
        return len(self.path)

    def made(self, rows: NDArray[np.intp]) -> list[FrameReference]:
        """Return the frames in some rows."""
        none = [None] * len(rows)
        sha256 = none if self.sha256 is None else map(_unpacked_sha256, self.sha256.at(rows))
        background = none if self.background_cd_m2 is None else map(_or_none, self.background_cd_m2[rows].tolist())
        reference = none if self.reference is None else (_decoded(one) or None for one in self.reference.at(rows))
        columns = map(_decoded, self.path.at(rows)), sha256, background, reference
        return list(map(FrameReference, *columns, *(() if self.clips is None else self.clips.made(rows))))

    def taken(self, rows: NDArray[np.intp]) -> _Frames:
        """Return the columns of some rows alone."""
        return _Frames(
            path=self.path.taken(rows),
            sha256=None if self.sha256 is None else self.sha256.taken(rows),
            background_cd_m2=None if self.background_cd_m2 is None else self.background_cd_m2[rows],
            reference=None if self.reference is None else self.reference.taken(rows),
            clips=None if self.clips is None else self.clips.taken(rows),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Clips:
    """Columns of frames: index into the clips' `names` or -1, time, and displacement, (n, 2) or None."""

    names: _Texts
    code: NDArray[np.int32]
    time_s: FloatArray
    motion_px: FloatArray | None

    def made(self, rows: NDArray[np.intp]) -> tuple[list[str | None], list[float | None], Sequence[Any]]:
        """Return the clips, times and displacements of the frames in some rows."""
        codes = self.code[rows].tolist()
        names = [None if code < 0 else _decoded(self.names[code]) for code in codes]
        times = [_or_none(time_s) for time_s in self.time_s[rows].tolist()]
        if self.motion_px is None:
            return names, times, [None] * len(codes)
        return names, times, [(x, y) if x or y else None for x, y in self.motion_px[rows].tolist()]

    def taken(self, rows: NDArray[np.intp]) -> _Clips:
        """Return the columns of some rows alone."""
        codes, code = np.unique(self.code[rows], return_inverse=True)
        named = codes >= 0
        return _Clips(
            names=self.names.taken(codes[named].astype(np.intp)),
            code=(code - np.count_nonzero(~named)).astype(np.int32),
            time_s=self.time_s[rows],
            motion_px=None if self.motion_px is None else self.motion_px[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _TrialColumns:
    """Columns of trials.

    Attributes
    ----------
    number, orientation, stimulus, level, group, backdrop : ndarray, shape (n,)
        The number; an index into `ORIENTATIONS`; one into `stimuli`; the level; one into `groups`; one into
        `backdrops`.
    name : _Texts or None
        Names after a "=", and nothing where the name is the path of the first frame; None: nowhere another one.
    first_frame : ndarray, shape (n + 1,)
        Row in `frames` of each trial's first frame, which its other frames follow.
    position_px : ndarray, shape (n, 2), or None
        Position (x, y); NaN where it is not stated. None: nowhere stated.
    warm_up : ndarray, shape (n, k), or None
        Rows in `frames` of each trial's warm-up in the order of time, -1 in front where there are fewer than k.
    """

    number: NDArray[np.int64]
    name: _Texts | None
    first_frame: NDArray[np.int64]
    frames: _Frames
    orientation: NDArray[np.int8]
    stimulus: NDArray[np.int32]
    level: FloatArray
    group: NDArray[np.int32]
    position_px: FloatArray | None
    backdrop: NDArray[np.int32]
    stimuli: tuple[Stimulus, ...]
    groups: tuple[Group, ...]
    backdrops: tuple[_Backdrop, ...]
    warm_up: NDArray[np.int32] | None = None

    def found_warm_up(self, n_frames: int) -> NDArray[np.int32] | None:
        """Find the rows of the frames that come before each trial in its clip: the attribute `warm_up`."""
        clips = self.frames.clips
        if clips is None or not n_frames or not len(self.number):
            return None
        in_time = np.lexsort((clips.time_s, clips.code))
        place = np.empty(len(in_time), np.int32)
        place[in_time] = np.arange(len(in_time), dtype=np.int32)
        first = self.first_frame[:-1]
        before = place[first][:, None] + np.arange(-n_frames, 0, dtype=np.int32)
        found = in_time[np.maximum(before, 0)].astype(np.int32)
        code = clips.code[first][:, None]
        is_there = (before >= 0) & (clips.code[found] == code) & (code >= 0)
        return np.where(is_there, found, np.int32(-1))

    def made(self, rows: NDArray[np.intp]) -> Iterator[Trial]:
        """Yield the trials in some rows."""
        frames = self.frames.made(self._rows_of_frames(rows))
        ends = np.cumsum(self.first_frame[rows + 1] - self.first_frame[rows]).tolist()
        of_trials = [tuple(frames[start:end]) for start, end in zip([0, *ends], ends, strict=False)]
        places = [(None, None)] * len(rows) if self.position_px is None else self.position_px[rows].tolist()
        before = [()] * len(rows) if self.warm_up is None else self._made_warm_up(self.warm_up[rows])
        for number, name, own, turns, stimulus, level, group, (x_px, y_px), backdrop, warm_up in zip(
            self.number[rows].tolist(),
            self.names(rows),
            of_trials,
            self.orientation[rows].tolist(),
            self.stimulus[rows].tolist(),
            self.level[rows].tolist(),
            self.group[rows].tolist(),
            places,
            self.backdrop[rows].tolist(),
            before,
            strict=True,
        ):
            yield Trial(
                number,
                name,
                own,
                ORIENTATIONS[turns],
                self.stimuli[stimulus],
                level,
                self.groups[group],
                _or_none(x_px),
                _or_none(y_px),
                *(*self.backdrops[backdrop], warm_up),
            )

    def _made_warm_up(self, rows: NDArray[np.int32]) -> list[tuple[FrameReference, ...]]:
        """Return the frames of warm-up of some trials, given their rows."""
        is_there = rows >= 0
        frames = iter(self.frames.made(rows[is_there].astype(np.intp)))
        return [tuple(islice(frames, n)) for n in np.count_nonzero(is_there, axis=1).tolist()]

    def names(self, rows: NDArray[np.intp]) -> list[str]:
        """Return the names of the trials in some rows."""
        names = list(map(_decoded, self.frames.path.at(self.first_frame[rows])))
        if self.name is None:
            return names
        own = map(_decoded, self.name.at(rows))
        return [one[1:] if one else path for one, path in zip(own, names, strict=True)]

    def taken(self, rows: NDArray[np.intp]) -> _TrialColumns:
        """Return the columns of some rows alone."""
        n_frames = self.first_frame[rows + 1] - self.first_frame[rows]
        stimuli, stimulus = np.unique(self.stimulus[rows], return_inverse=True)
        groups, group = np.unique(self.group[rows], return_inverse=True)
        backdrops, backdrop = np.unique(self.backdrop[rows], return_inverse=True)
        of_trials, warm_up = self._rows_of_frames(rows), None
        if self.warm_up is not None:
            before, place = np.unique(self.warm_up[rows], return_inverse=True)
            before, n_missing = before[before >= 0], np.count_nonzero(before < 0)
            place = place.reshape(len(rows), -1) - n_missing
            warm_up = np.where(place < 0, -1, len(of_trials) + place).astype(np.int32)
            of_trials = np.concatenate([of_trials, before])
        return _TrialColumns(
            number=self.number[rows],
            name=None if self.name is None else self.name.taken(rows),
            first_frame=np.concatenate([[0], np.cumsum(n_frames)]),
            frames=self.frames.taken(of_trials),
            orientation=self.orientation[rows],
            stimulus=stimulus.astype(np.int32),
            level=self.level[rows],
            group=group.astype(np.int32),
            position_px=None if self.position_px is None else self.position_px[rows],
            backdrop=backdrop.astype(np.int32),
            stimuli=tuple(self.stimuli[k] for k in stimuli.tolist()),
            groups=tuple(self.groups[k] for k in groups.tolist()),
            backdrops=tuple(self.backdrops[k] for k in backdrops.tolist()),
            warm_up=warm_up,
        )

    def most_motion_px(self, rows: NDArray[np.intp]) -> float:
        """Return the largest displacement of the frames of some trials in pixels."""
        clips = self.frames.clips
        if clips is None or clips.motion_px is None:
            return 0.0
        return float(np.hypot(*clips.motion_px[self._rows_of_frames(rows)].T).max(initial=0.0))

    def _rows_of_frames(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the rows in `frames` of the frames of some trials, one trial after the other."""
        first = self.first_frame[rows]
        n_frames = self.first_frame[rows + 1] - first
        return np.repeat(first - np.cumsum(n_frames) + n_frames, n_frames) + np.arange(n_frames.sum())


class _Backdrop(NamedTuple):
    """What lies behind a triangle and where it may be: values of a `Trial`."""

    view: SceneView | None = None
    place: int | None = None
    step_px: float | None = None


class _Codes(Generic[V]):
    """Distinct values, numbered in the order in which they appear."""

    def __init__(self) -> None:
        self.values: list[V] = []
        self._codes: dict[V, int] = {}

    def code(self, value: V) -> int:
        """Return the number of a value; a new value gets the next number."""
        code = self._codes.get(value)
        if code is None:
            code = self._codes[value] = len(self.values)
            self.values.append(value)
        return code


class _Texts:
    """Byte strings in one buffer, each followed by the next."""

    # A path and a checksum take 74 bytes, in arrays of NumPy's StringDType 138, and 257 while these are made.

    __slots__ = ("_content", "_ends")

    def __init__(self, parts: Iterable[bytes | bytearray] = ()) -> None:
        self._content, self._ends = bytearray(), array("q", [0])
        for part in parts:
            self.append(part)

    def append(self, part: bytes | bytearray) -> None:
        self._content += part
        self._ends.append(len(self._content))

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, index: int) -> bytearray:
        return self._content[self._ends[index] : self._ends[index + 1]]

    def at(self, indices: NDArray[np.intp]) -> list[bytearray]:
        """Return the strings at some indices."""
        ends, content = _column(self._ends, np.int64), self._content
        bounds = zip(ends[indices].tolist(), ends[indices + 1].tolist(), strict=True)
        return [content[start:end] for start, end in bounds]

    def taken(self, indices: NDArray[np.intp]) -> _Texts:
        """Return the strings at some indices alone, in a buffer of their own."""
        return _Texts(self.at(indices))

    def or_none(self) -> _Texts | None:
        """Return the strings, or None if all are empty."""
        return self if self._content else None


def _column(values: array[Any], dtype: type[Any]) -> NDArray[Any]:
    """Return an array that shares the memory of a Python array and cannot be written."""
    column = np.frombuffer(values, dtype)
    column.flags.writeable = False
    return column


def _unless_missing(column: FloatArray) -> FloatArray | None:
    """Return a column, or None if all its values are missing: NaN."""
    return None if np.isnan(column).all() else column


def _or_none(value: float | None) -> float | None:
    """Return a number, None for NaN."""
    return None if value is None or value != value else value


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _decoded(text: bytearray) -> str:
    return text.decode("utf-8", "surrogatepass")


NO_SHA256 = bytes(33)
"""Bytes in front of a text that is given as a checksum but is none: no checksum is as long."""


def _packed_sha256(text: str) -> bytes:
    """Return the 32 bytes of a checksum."""
    try:
        packed = bytes.fromhex(text)
    except ValueError:
        packed = b""
    return packed if len(packed) == 32 and packed.hex() == text else NO_SHA256 + _encoded(text)


def _unpacked_sha256(packed: bytearray) -> str | None:
    """Return the text of a packed checksum."""
    if len(packed) > 32:
        return _decoded(packed[len(NO_SHA256) :])
    return packed.hex() or None
