"""Frames whose pixels about the triangle stay in memory once decoded, for those who look at them again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.contrast import row_bands
from todframes.frames.dataset import Dataset
from todframes.frames.files import Frame, FrameSource, Range
from todframes.frames.position import centroid_position, size_in_px
from todframes.frames.surround import TrianglePlace, Window, surround_window
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import Centre

MOST_HELD_MB = 64
"""Largest memory for the pixels of all frames of a dataset that are held, in 2**20 bytes."""


@dataclass(frozen=True, slots=True)
class HoldingDataset(Dataset):
    """A dataset that decodes some of its frames once, for use in one process. `held` has these frames by their
    paths: the trial until pixels are decoded, the frame with these from then on. `centre` is as in
    `centroid_position`.
    """

    held: dict[str, Trial | HeldFrame]
    centre: Centre

    @classmethod
    def of(cls, dataset: Dataset, trials: Iterable[Trial], centre: Centre) -> Dataset:
        """Return a dataset that holds the frames of some trials; the dataset itself if it is in memory."""
        if dataset.is_in_memory:
            return dataset
        values = {part.name: getattr(dataset, part.name) for part in fields(Dataset)}
        held: dict[str, Trial | HeldFrame] = {frame.path: trial for trial in trials for frame in trial.frames}
        return cls(**values, held=held, centre=centre)

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:
        """Open a frame; raise FrameError if it cannot be used."""
        held = self.held.get(frame.path)
        if isinstance(held, HeldFrame):
            return held
        # Dataclasses with slots have no zero-argument super() in Python 3.11.
        file = Dataset.open(self, frame, verify=verify)
        if held is None:
            return file
        x, y = centroid_position(held, file.header, self.centre, self.display.pitch_mrad, frame)
        triangle = TrianglePlace(x, y, size_in_px(held, self.display.pitch_mrad))
        rows, columns = file.clip(None, None)
        window = surround_window(triangle, rows=rows, columns=columns)
        return HeldFrame(self, frame, file, window)


class HeldFrame(FrameSource):
    """An open frame of a dataset, which keeps the pixels of the first rectangle that is asked for, and of a
    `window`. For other pixels it opens the file again.
    """

    def __init__(self, dataset: HoldingDataset, frame: FrameReference, file: FrameSource, window: Window) -> None:
        self.path, self.header = file.path, file.header
        self._dataset, self._frame, self._window = dataset, frame, window
        self._file: FrameSource | None = file
        self._kept: Frame | None = None

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            self._file.__exit__(*error)
        self._file = None

    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle in bands of rows; errors are those of the file."""
        asked = Window(*self.clip(rows, columns))
        if self._kept is None:
            self._keep(asked)
        if self._kept is None or (part := _part(self._kept, asked)) is None:
            with self._file or Dataset.open(self._dataset, self._frame) as self._file:
                yield from self._file.bands(rows=rows, columns=columns)
            return
        top = asked.rows[0]
        for stored in row_bands(part):
            yield Frame(stored, top, asked.columns[0], self.header.height, self.header.width)
            top += len(stored)

    def _keep(self, asked: Window) -> None:
        """Decode a rectangle and the window, unless they are too large, or damaged where nobody has asked."""
        (top, bottom), (left, right) = (
            (min(first, low), max(stop, high))
            for (first, stop), (low, high) in zip(asked, self._window, strict=True)
        )
        n_bytes = (bottom - top) * (right - left) * len(self.header.channels) * self.stored_type.itemsize
        if self._file is not None and n_bytes * len(self._dataset.held) <= MOST_HELD_MB * 2**20:
            with suppress(FrameError):
                self._kept = self._file.read(rows=(top, bottom), columns=(left, right))
                self._dataset.held[self._frame.path] = self


def _part(kept: Frame, asked: Window) -> NDArray[Any] | None:
    """Return the pixels of a rectangle among those that were kept; None if some were not."""
    (top, bottom), (left, right) = (
        (first - begin, stop - begin)
        for (first, stop), begin in zip(asked, (kept.first_row, kept.first_column), strict=True)
    )
    n_rows, n_columns, _ = kept.stored.shape
    if min(top, left) < 0 or bottom > n_rows or right > n_columns:
        return None
    return kept.stored[top:bottom, left:right]
