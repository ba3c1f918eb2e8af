"""Thumbnails of a triangle: the display, the retina image and the observer's bands."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer
from todframes.results.data import Thumbnail
from todframes.stimulus import Stimulus

if TYPE_CHECKING:
    from todframes.frames.contrast import ContrastPatch

MOST_BANDS = 8

PICTURE_REACH_PER_SIZE = 1.5

LEAST_REACH_PX, LEAST_REACH_SAMPLES = 8, 12
"""Least distance from the middle of a picture to its edge, in display pixels and in retina samples; a small
triangle is shown with its surroundings."""

MOST_REACH_PX = 1000
"""Largest distance from the middle to the edge, so that a wrong pitch cannot fill the memory; of a larger triangle
only the middle is shown."""

DISPLAY_SIDE_PX, RETINA_SIDE_PX = 128, 96
"""Largest sides of pictures of the display and of the retina; larger ones are reduced by a whole factor."""


class ExamplePatch(NamedTuple):
    """Part of a frame, or the contrast of a whole one, and the position of the triangle's centroid in it."""

    patch: ContrastPatch | FloatArray
    x_px: float
    y_px: float


def reach_px_of(observer: Observer, stimulus: Stimulus, pixel_pitch_mrad: float) -> int:
    """Return the number of display pixels shown on each side of the triangle's centroid."""
    reach_mrad = max(
        PICTURE_REACH_PER_SIZE * stimulus.size_mrad,
        LEAST_REACH_PX * pixel_pitch_mrad,
        LEAST_REACH_SAMPLES * observer.grid(stimulus).pitch_mrad,
    )
    return math.ceil(min(reach_mrad / pixel_pitch_mrad, MOST_REACH_PX))


def pictures(
    shown: Sequence[ExamplePatch],
    retina: FloatArray,
    *,
    observer: Observer,
    stimulus: Stimulus,
    pixel_pitch_mrad: float,
    white: float | None = None,
) -> tuple[float, tuple[Thumbnail, ...]]:
    """Draw the triangle and its surroundings: display, retina image and bands. Return the width in mrad, too.
    `shown` are the frames of one trial; the picture is their mean, and background beyond the end of a frame.
    `retina` is the observer's input, in contrast, (side, side). The display's grey is sRGB for the luminance, from
    its black to `white`, a contrast, which is the picture's `scale`; by default 1, or the largest contrast. In the
    others mid-grey is 0, and `scale` is the value of white.
    """
    reach_px = reach_px_of(observer, stimulus, pixel_pitch_mrad)
    display = np.mean([_crop(thumbnail, reach_px) for thumbnail in shown], axis=0)
    display = _reduced(display, DISPLAY_SIDE_PX, np.mean)
    white = max(1.0, float(display.max())) if white is None else white
    light = np.clip((1.0 + display) / (1.0 + white), 0.0, 1.0)
    made = [Thumbnail("display", png(255.0 * srgb(light)), white)]
    width_mrad = (2 * reach_px + 1) * pixel_pitch_mrad
    reach = min(round(width_mrad / 2.0 / observer.grid(stimulus).pitch_mrad), retina.shape[0] // 2)
    made.append(_signed("retina", _reduced(_about_middle(retina, reach, 1.0), RETINA_SIDE_PX, np.mean)))
    bands = observer.activity(retina)
    parts = [_about_middle(band, reach, (retina.shape[0] - 1) / max(band.shape[0] - 1, 1)) for band in bands]
    strongest = sorted(range(len(parts)), key=lambda k: -float(np.abs(parts[k]).max()))[:MOST_BANDS]
    made += [_signed(f"band {k}", _reduced(parts[k], RETINA_SIDE_PX, _peak)) for k in sorted(strongest)]
    return width_mrad, tuple(made)


def _crop(shown: ExamplePatch, reach_px: int) -> FloatArray:
    """Return the contrast within `reach_px` of the triangle's centroid, (2 reach + 1)²; 0 beyond the frame."""
    side = 2 * reach_px + 1
    top, left = round(shown.y_px) - reach_px, round(shown.x_px) - reach_px
    cropped = np.zeros((side, side))
    bands = [(shown.patch, 0, 0)] if isinstance(shown.patch, np.ndarray) else shown.patch.bands()
    for contrast, row, column, *_ in bands:
        rows, columns = (
            slice(max(first - start, 0), max(min(first + n - start, side), 0))
            for first, start, n in zip((row, column), (top, left), contrast.shape, strict=True)
        )
        part = contrast[max(top - row, 0) :, max(left - column, 0) :]
        cropped[rows, columns] = part[: max(rows.stop - rows.start, 0), : columns.stop - columns.start]
    return cropped


def _about_middle(image: FloatArray, reach: int, step: float) -> FloatArray:
    """Return retina samples within `reach` of the middle, from an image sampled every `step` of them."""
    steps = np.floor(np.arange(-reach, reach + 1) / step + 0.5).astype(int)
    rows, columns = (np.clip(steps + n // 2, 0, n - 1) for n in image.shape)
    return np.asarray(image[np.ix_(rows, columns)], dtype=np.float64)


def _reduced(image: FloatArray, largest_side: int, summary: Callable[..., FloatArray]) -> FloatArray:
    """Return an image reduced to at most `largest_side`, one pixel a block; a rest at the end is cut off."""
    factor = math.ceil(image.shape[0] / largest_side)
    side = image.shape[0] // factor
    blocks = image[: side * factor, : side * factor].reshape(side, factor, side, factor)
    return np.asarray(summary(blocks.swapaxes(1, 2).reshape(side, side, -1), axis=2))


def _peak(blocks: FloatArray, axis: int) -> FloatArray:
    """Return the value farthest from 0 in each block; the mean of a band-pass image would be about zero."""
    peak = np.expand_dims(np.abs(blocks).argmax(axis=axis), axis)
    return np.take_along_axis(blocks, peak, axis).squeeze(axis)


def _signed(name: str, image: FloatArray) -> Thumbnail:
    scale = float(np.abs(image).max()) or 1.0
    return Thumbnail(name, png(128.0 + 127.0 * image / scale), scale)


def srgb(light: FloatArray) -> FloatArray:
    """Return code values in [0, 1] for relative luminance in [0, 1] (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def png(grey: NDArray[Any]) -> bytes:
    """Return grey values from 0 to 255 as a PNG."""
    _, coded = cv2.imencode(".png", np.rint(grey).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return bytes(coded.tobytes())
