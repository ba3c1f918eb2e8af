"""Datasets of frames in memory: nothing is read from a disk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base.errors import DataError, FrameError
from todframes.display.display import Display
from todframes.frames.contrast import row_bands
from todframes.frames.dataset import Dataset, Experiment, Manifest
from todframes.frames.files import Frame, FrameHeader, FrameSource, Range, check_finite
from todframes.frames.trials import FrameReference

OIIO_TYPES: dict[str, Any] = {
    "uint8": "uint8", "uint16": "uint16", "float16": "half", "float32": "float", "float64": "float"
}  # fmt: skip
"""Pixel type by NumPy type."""


@dataclass(frozen=True, slots=True)
class MemoryDataset(Dataset):
    """A dataset whose frames are arrays; see `memory_dataset`."""

    arrays: Mapping[str, NDArray[Any]]

    def has_frame(self, frame: FrameReference) -> bool:
        """Return whether the frame exists."""
        return frame.path in self.arrays

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:  # noqa: ARG002 - no checksums
        """Open a frame; raise FrameError if it cannot be used."""
        array = self.arrays[frame.path]
        is_long = array.dtype.kind == "f" and array.dtype != np.float16
        return ArrayFrame(self.frame_path(frame), array.astype(np.float32, copy=False) if is_long else array)


class ArrayFrame(FrameSource):
    """A frame in memory: an array of shape (rows, columns) or (rows, columns, 1 or 3). Raises FrameError if it has
    another shape, or other values than integers of 8 or 16 bits or floating-point numbers.
    """

    def __init__(self, path: Path, stored: NDArray[Any]) -> None:
        self.path = path
        if stored.ndim == 2:
            stored = stored[..., None]
        pixel_type: Any = OIIO_TYPES.get(stored.dtype.name)
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

    @property
    def stored_type(self) -> np.dtype[Any]:
        """Type of the values of `Frame.stored`, which may be floats of 64 bits, too."""
        return self._stored.dtype

    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle in bands of rows; raise FrameError if a pixel of it is NaN or infinite."""
        (top, bottom), (left, right) = self.clip(rows, columns)
        part = self._stored[top:bottom, left:right]
        check_finite(self.path, part, top, left)
        for stored in row_bands(part):
            yield Frame(stored, top, left, self.header.height, self.header.width)
            top += len(stored)


def memory_dataset(
    frames: Iterable[ArrayLike],
    *,
    orientation: Sequence[str] | str,
    level: Sequence[float] | float,
    size_mrad: Sequence[float] | float,
    display: Display,
    group: Mapping[str, float | str | Sequence[float | str]] | None = None,
    position: ArrayLike | None = None,
    polarity: Sequence[int] | int = 1,
    trial: str | Sequence[object] | None = None,
    level_name: str = "contrast",
    clip: Sequence[str | None] | str | None = None,
    time_s: float | Sequence[float] | None = None,
    judged: bool | Sequence[bool] | None = None,
) -> MemoryDataset:
    """Return a dataset of frames in memory; parameters are those of `todframes.score_frames`. Raises DataError if
    there are no frames, or an argument has the wrong number of values or a value out of range.
    """
    images = [np.asarray(frame) for frame in frames]
    if not images:
        raise DataError("frames: found none, expected at least one")
    columns: dict[str, Any] = dict({"size_mrad": size_mrad} if group is None else group)
    experiment = Experiment(level=level_name, group_by=tuple(columns))
    names = [f"frame {k}" for k in range(len(images))]
    columns |= {level_name: level, "size_mrad": size_mrad, "orientation": orientation, "polarity": polarity}
    columns |= {"frame": names, "trial": range(len(images)) if trial is None else trial}
    columns |= {name: v for name, v in (("clip", clip), ("time_s", time_s), ("judged", judged)) if v is not None}
    if position is not None:
        columns["x_px"], columns["y_px"] = np.broadcast_to(np.asarray(position, np.float64), (len(images), 2)).T
    texts = [_texts(name, values, len(images)) for name, values in columns.items()]
    named = {name for name, values in (group or {}).items() if "U" in np.asarray(values).dtype.str}
    manifest = Manifest(None, display, experiment, texts=named - {"size_mrad"})
    manifest.check_columns(columns)
    for number, row in enumerate(zip(*texts, strict=True)):
        manifest.add(dict(zip(columns, row, strict=True)), names[number], number)
    trials = manifest.trials()
    if not trials:
        raise DataError("judged: found no frame that is judged, expected at least one")
    return MemoryDataset(
        path=Path("in memory"),
        display=display,
        experiment=experiment,
        trials=trials,
        bad_rows=(),
        spoilt=frozenset(),
        manifest_sha256=None,
        arrays=dict(zip(names, images, strict=True)),
    )


def _texts(name: str, values: Any, n: int) -> list[str]:
    """Return one value a frame as in a manifest, from a single value for all frames or a sequence."""
    if isinstance(values, str) or not np.ndim(values):
        values = [values] * n
    column = values.tolist() if isinstance(values, np.ndarray) else list(values)
    if len(column) != n:
        raise DataError(f"{name}: found {len(column)} values, expected {n}, one a frame")
    return [_text(value.item() if isinstance(value, np.generic) else value) for value in column]


def _text(value: object) -> str:
    if isinstance(value, bool) or (isinstance(value, float) and value.is_integer()):
        value = int(value)
    return "" if value is None else str(value)
