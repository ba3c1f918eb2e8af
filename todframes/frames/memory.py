"""Datasets of frames in memory: nothing is read from a disk."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base.errors import DataError, FrameError
from todframes.base.reading import check_time
from todframes.base.remote import Location
from todframes.display.display import Display
from todframes.frames.dataset import Dataset, Experiment
from todframes.frames.files import Frame, FrameHeader, FrameSource, Range, clip_rectangle
from todframes.frames.trials import FrameReference, Trial, TrialsBuilder, joined
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus

OIIO_TYPES: dict[str, Any] = {"uint8": "uint8", "uint16": "uint16", "float16": "half"}
"""Pixel type by NumPy type; other floating-point arrays are held as "float", 32 bits."""


@dataclass(frozen=True, slots=True)
class MemoryDataset(Dataset):
    """A dataset whose frames are arrays; see `memory_dataset`."""

    arrays: Mapping[str, NDArray[Any]]

    def has_frame(self, frame: FrameReference) -> bool:
        """Return whether the frame exists."""
        return frame.path in self.arrays

    def content_id(self, frame: FrameReference, *, is_read: bool = False) -> str:  # noqa: ARG002
        """Return a text that changes whenever the frame's values do: the SHA-256 of its array."""
        array = self.arrays[frame.path]
        described = f"{array.dtype.str} {array.shape} ".encode()
        return hashlib.sha256(described + array.tobytes()).hexdigest()

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:  # noqa: ARG002 - no checksums
        """Open a frame; raise FrameError if it cannot be used."""
        return ArrayFrame(self.frame_path(frame), self.arrays[frame.path])


class ArrayFrame:
    """A frame in memory, as a `FrameSource`.

    Parameters
    ----------
    path : Path or RemotePath
        Name of the frame in messages.
    stored : ndarray, shape (rows, columns) or (rows, columns, 1 or 3)

    Raises
    ------
    FrameError
        If the array has another shape or holds neither integers of 8 or 16 bits nor floating-point numbers.
    """

    def __init__(self, path: Location, stored: NDArray[Any]) -> None:
        self.path = path
        if stored.dtype.kind == "f" and stored.dtype != np.float16:
            stored = stored.astype(np.float32, copy=False)
        if stored.ndim == 2:
            stored = stored[..., None]
        pixel_type: Any = "float" if stored.dtype == np.float32 else OIIO_TYPES.get(stored.dtype.name)
        if pixel_type is None or stored.ndim != 3 or stored.shape[2] not in (1, 3) or not stored.size:
            raise FrameError(
                path,
                f"found an array of {stored.dtype} and shape {stored.shape}, expected (rows, columns) or (rows, "
                "columns, 3) of uint8, uint16 or floating-point numbers",
            )
        self._stored = stored
        height, width, n_channels = stored.shape
        channels = ("Y",) if n_channels == 1 else ("R", "G", "B")
        self.header = FrameHeader(height, width, 0, 0, height, width, channels, pixel_type, {})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    @property
    def stored_type(self) -> np.dtype[Any]:
        """Type of the values of `Frame.stored`."""
        return self._stored.dtype

    def read(self, *, rows: Range | None = None, columns: Range | None = None) -> Frame:
        """Return a rectangle of the frame; raise FrameError if a pixel of it is NaN or infinite."""
        (frame,) = self.bands(rows=rows, columns=columns)
        return frame

    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle of the frame in one band; raise FrameError if a pixel of it is NaN or infinite."""
        (top, bottom), (left, right) = self.clip(rows, columns)
        part = self._stored[top:bottom, left:right]
        if part.dtype.kind == "f" and not np.isfinite(part).all():
            bad = np.argwhere(~np.isfinite(part).all(axis=2))
            where = f"row {bad[0, 0] + top}, column {bad[0, 1] + left}"
            raise FrameError(self.path, f"{len(bad)} pixels are NaN or infinite, the first at {where}")
        yield Frame(part, top, left, self.header.height, self.header.width)

    def clip(self, rows: Range | None, columns: Range | None) -> tuple[Range, Range]:
        """Return the rows and columns of a rectangle that the frame has."""
        return clip_rectangle(self.header, rows, columns)


def memory_dataset(
    frames: Iterable[ArrayLike],
    *,
    orientation: Sequence[str] | str,
    level: Sequence[float] | float,
    size_mrad: Sequence[float] | float,
    display: Display,
    group: Mapping[str, Sequence[float | str]] | None = None,
    position: ArrayLike | None = None,
    polarity: Sequence[int] | int = 1,
    trial: Sequence[object] | None = None,
    level_name: str = "contrast",
    clip: Sequence[str | None] | str | None = None,
    time_s: Sequence[float] | None = None,
    judged: Sequence[bool] | None = None,
) -> MemoryDataset:
    """Return a dataset of frames in memory; parameters are those of `todframes.score_frames`.

    Raises
    ------
    DataError
        If there are no frames, or an argument has the wrong number of values or a value out of range.
    """
    images = [np.asarray(frame) for frame in frames]
    n = len(images)
    if not n:
        raise DataError("frames: found none, expected at least one")
    orientations = _column("orientation", orientation, n)
    levels, sizes = _numbers("level", level, n), _numbers("size_mrad", size_mrad, n)
    polarities = _column("polarity", polarity, n)
    groups = {"size_mrad": sizes} if group is None else {name: _column(name, v, n) for name, v in group.items()}
    places: list[tuple[float | None, float | None]] = [(None, None)] * n
    if position is not None:
        centres = np.broadcast_to(np.asarray(position, np.float64), (n, 2))
        if not np.isfinite(centres).all():
            raise DataError("position: found NaN or infinity, expected x and y in pixels")
        places = [(x, y) for x, y in centres.tolist()]
    names = [str(one) for one in (range(n) if trial is None else _column("trial", trial, n))]
    clips, times = _clips(clip, time_s, n)
    is_judged = _column("judged", True if judged is None else judged, n)
    builder, index_of = TrialsBuilder(), dict[str, int]()
    arrays: dict[str, NDArray[Any]] = {}
    for k, image in enumerate(images):
        path = f"frame {k}"
        arrays[path] = image
        if orientations[k] not in ORIENTATIONS:
            raise DataError(f"orientation[{k}]: found {orientations[k]!r}, expected up, right, down or left")
        if polarities[k] not in (1, -1):
            raise DataError(f"polarity[{k}]: found {polarities[k]!r}, expected 1 or -1")
        made = Trial(
            number=k,
            name=names[k],
            frames=(FrameReference(path, None, None, None, clips[k], times[k]),),
            orientation=Orientation(orientations[k]),
            stimulus=Stimulus(sizes[k], int(polarities[k])),
            level=levels[k],
            group=tuple(v if isinstance(v, str) else float(v) for v in (column[k] for column in groups.values())),
            x_px=places[k][0],
            y_px=places[k][1],
        )
        if not is_judged[k]:
            builder.append_unjudged(made.frames[0])
            continue
        index = index_of.setdefault(names[k], len(builder))
        if index == len(builder):
            builder.append(made)
            continue
        first = builder[index]
        made, frame = joined(first, made)
        if made[3:] != first[3:]:
            raise DataError(f"trial {names[k]!r}: frame {k} shows another stimulus than the trial's other frames")
        builder.append_frame(index, frame)
    if not len(builder):
        raise DataError("judged: found no frame that is judged, expected at least one")
    experiment = Experiment(level=level_name, group_by=tuple(groups))
    return MemoryDataset(
        path=Path("in memory"),
        display=display,
        experiment=experiment,
        trials=builder.trials(),
        bad_rows=(),
        spoilt=frozenset(),
        manifest_sha256=None,
        arrays=arrays,
    )


def _clips(
    clip: Sequence[str | None] | str | None, time_s: Sequence[float] | None, n: int
) -> tuple[list[str | None], list[float | None]]:
    """Return the clip of each frame and its time there; the frames of a clip must stand in the order of time."""
    if clip is None:
        return [None] * n, [None] * n
    if time_s is None:
        raise DataError("clip: found it without time_s, expected both or none")
    clips: list[str | None] = _column("clip", clip, n)
    times = [float(one) for one in _column("time_s", time_s, n)]
    last_s: dict[str, float] = {}
    for k, (name, time) in enumerate(zip(clips, times, strict=True)):
        if name is not None and not time > last_s.get(name, -math.inf):
            raise DataError(
                f"time_s[{k}]: found {time:g}, expected more than that of the frame before in the clip"
            )
        if name is not None:
            last_s[name] = check_time(f"time_s[{k}]", time)
    return clips, [None if name is None else time for name, time in zip(clips, times, strict=True)]


def _column(name: str, values: Any, n: int) -> list[Any]:
    """Return one value a frame, from a single value for all frames or a sequence."""
    if isinstance(values, str) or not np.ndim(values):
        return [values] * n
    column = values.tolist() if isinstance(values, np.ndarray) else list(values)
    if len(column) != n:
        raise DataError(f"{name}: found {len(column)} values, expected {n}, one a frame")
    return column


def _numbers(name: str, values: Any, n: int) -> list[float]:
    column = [float(value) for value in _column(name, values, n)]
    for k, value in enumerate(column):
        if not (math.isfinite(value) and value > 0):
            raise DataError(f"{name}[{k}]: found {value!r}, expected a finite number > 0")
    return column
