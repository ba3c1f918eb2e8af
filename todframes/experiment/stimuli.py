"""The stimuli of a trial: its frames averaged in contrast, and the code values that show them on a monitor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, of_frame
from todframes.display.display import TILE, dithered
from todframes.experiment.monitor import ContrastRange, Monitor
from todframes.frames.contrast import centroid_position, check_on_frame, read_contrast, size_in_px
from todframes.frames.dataset import Dataset
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import Trial
from todframes.stimulus import coverage

MEAN_TOLERANCE = 5e-4
"""Largest error of the mean contrast over a triangle that dither may leave."""

MOST_SEEDS = 16
"""Number of places of the dither pattern that are tried."""


class TrialImage(NamedTuple):
    """The contrast of all pixels of a trial, (rows, columns), and the place of its triangle."""

    contrast: FloatArray
    triangle: TrianglePlace


def trial_image(dataset: Dataset, trial: Trial) -> TrialImage:
    """Read the frames of a trial and average them in contrast, all pixels of them. The luminance that contrast
    refers to is that of the dataset's rule at the triangle, one number a frame: a slope or a border of the
    background is shown unchanged. Pixels that a file leaves out of its frame have the contrast 0. Raises
    FrameError if a frame cannot be used, differs in size from the first of its trial, or the triangle does not lie
    on it.
    """
    display = dataset.display
    total: FloatArray | None = None
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            header = file.header
            x, y = centroid_position(trial, header, "centroid", display.pitch_mrad)
            check_on_frame(file.path, trial, header, x, y, display.pitch_mrad)
            triangle = TrianglePlace(x, y, size_in_px(trial, display.pitch_mrad))
            row, column = round(y), round(x)
            patch = read_contrast(file, display, frame, (row, row + 1), (column, column + 1), triangle=triangle)
            background = patch.background_luminance_cd_m2
            assert background is not None  # it was read from a frame
            contrast = np.zeros((header.height, header.width))
            with of_frame(file.path):
                for band in file.bands():
                    rows, columns = (
                        slice(first, first + size)
                        for first, size in zip(
                            (band.first_row, band.first_column), band.stored.shape[:2], strict=True
                        )
                    )
                    contrast[rows, columns] = display.luminance(band.values) / background - 1.0
        if total is not None and total.shape != contrast.shape:
            raise FrameError(
                file.path,
                f"has {contrast.shape[1]} × {contrast.shape[0]} pixels, expected {total.shape[1]} × "
                f"{total.shape[0]} as in the first frame of trial {trial.name}",
            )
        total = contrast if total is None else total + contrast
    assert total is not None  # a trial has a frame
    return TrialImage(total / len(trial.frames), triangle)


def contrast_range(trial: Trial, image: TrialImage) -> ContrastRange:
    """Return the range of the contrasts of a trial, for `monitor.check_shows`."""
    inside = image.contrast[_covered(trial, image) > 0.0]
    if not inside.size:
        size = trial.stimulus.size_mrad
        raise FrameError(trial.frames[0].path, f"a triangle of {size:g} mrad covers no pixel; check size_mrad")
    low, high = np.quantile(image.contrast, [0.005, 0.995]).tolist()
    return ContrastRange(trial.frames[0].path, low, high, float(inside.min()), float(inside.max()))


def _covered(trial: Trial, image: TrialImage) -> FloatArray:
    """Return the share of each pixel that the triangle of a trial covers, (rows, columns)."""
    x, y, size_px = image.triangle
    return coverage(image.contrast.shape, size_px=size_px, x_px=x, y_px=y, orientation=trial.orientation)


def dithered_codes(trial: Trial, image: TrialImage, monitor: Monitor, seed: int) -> tuple[NDArray[np.uint8], int]:
    """Return the code values that show a trial, and the seed of their dither: the next good one from `seed`. With
    a good seed the mean contrast over the triangle, each pixel weighted with the share that is covered, is right
    within `MEAN_TOLERANCE`. Most seeds are good from ten pixels of size on. If none of `MOST_SEEDS` is, as for
    triangles of a few pixels, the best one is taken.
    """
    codes = shown_codes(image.contrast, monitor, seed)
    if not monitor.dither:
        return codes, seed
    weight = _covered(trial, image)
    weight /= weight.sum()
    low, high = monitor.contrast_of_code()[[0, -1]]
    wanted = np.sum(weight * np.clip(image.contrast, low, high))
    tried = []
    for _ in range(MOST_SEEDS):
        error = abs(float(np.sum(weight * shown_contrast(codes, monitor)) - wanted))
        if error <= MEAN_TOLERANCE:
            return codes, seed
        tried.append((error, seed))
        seed += 1
        codes = shown_codes(image.contrast, monitor, seed)
    _, seed = min(tried)
    return shown_codes(image.contrast, monitor, seed), seed


def shown_codes(contrast: FloatArray, monitor: Monitor, seed: int) -> NDArray[np.uint8]:
    """Return the code values that show Weber contrast, (rows, columns), on a monitor. Contrast that the monitor
    cannot show becomes its white or black (`clipped`). With dither, the sum of the contrasts of all pixels is off
    by at most half of a code step of one pixel; `seed` is one of 4096 positions of the pattern. Without dither
    each pixel has the code nearest in luminance.
    """
    of_code = monitor.contrast_of_code()
    # The scale of relative luminance, in which 0 is black, suits the relative tolerance of `dithered`.
    luminance, of_code = np.clip(contrast, of_code[0], of_code[-1]) + 1.0, of_code + 1.0
    if not monitor.dither:
        middles = (of_code[1:] + of_code[:-1]) / 2.0
        return np.searchsorted(middles, luminance).astype(np.uint8)
    shift = divmod(seed % TILE**2, TILE)
    codes = dithered(np.roll(luminance, shift, (0, 1)), of_code)
    return np.roll(codes, [-step for step in shift], (0, 1)).astype(np.uint8)


def shown_contrast(codes: NDArray[np.uint8], monitor: Monitor) -> FloatArray:
    """Return the contrast of code values on a monitor, as the person saw it, of the shape of `codes`."""
    return monitor.contrast_of_code()[codes]


def clipped(contrast: FloatArray, monitor: Monitor) -> NDArray[np.bool_]:
    """Return which contrasts a monitor cannot show: beyond its white or black by more than half of a code step."""
    low, high = monitor.contrast_limits()
    return np.asarray((contrast < low) | (contrast > high))


def png(codes: NDArray[np.uint8]) -> bytes:
    """Return code values as a grey PNG of 8 bits without any chunk about colour: browsers show it as it is."""
    import cv2

    _, encoded = cv2.imencode(".png", codes)
    return encoded.tobytes()
