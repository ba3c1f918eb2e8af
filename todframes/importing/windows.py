"""The frames of an imported dataset: windows cut from recorded frames, written with their values untouched."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import FrameError, OutputError
from todframes.display.sensor_display import SignalDisplay
from todframes.frames.files import frame_sha256, write_frame
from todframes.frames.surround import TrianglePlace, surround_window
from todframes.importing.clips import Rectangle
from todframes.jobs.fingerprint import fingerprint
from todframes.observers.pyramid import PyramidObserver
from todframes.recordings.recording import CodeRange
from todframes.stimulus import Stimulus

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


class WindowWriter:
    """Function that writes the windows of a dataset into a folder, as `write_window` does, unless an earlier run
    has: `kept` are its rows and `add` adds one, as `Rows.of_work` yields them. `n_kept` windows were there.
    """

    def __init__(
        self,
        folder: Path,
        kept: dict[str, bytes],
        add: Callable[[str, bytes], None],
        *,
        clip: bool,
        of_signals: SignalDisplay | None = None,
    ) -> None:
        self._folder, self._kept, self._add, self._clip = folder, kept, add, clip
        self._of_signals = of_signals
        self.n_kept = 0

    def __call__(self, name: str, values: NDArray[Any], scale: CodeRange) -> WrittenWindow:
        """Write a window of this name in the folder; raise OutputError if it cannot be written."""
        path, item = self._folder / name, fingerprint(name, values, scale, self._clip, self._of_signals).hex()
        if (row := self._kept.get(item)) is not None:
            with suppress(FrameError, msgspec.MsgspecError):
                written = msgspec.json.decode(row, type=WrittenWindow)
                if frame_sha256(path) == written.sha256:
                    self.n_kept += 1
                    return written
        written = write_window(path, values, scale, clip=self._clip, of_signals=self._of_signals)
        self._add(item, msgspec.json.encode(written))
        return written
