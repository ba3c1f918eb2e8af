"""Monitors that show trials to people, and the code values that show the frames of a trial."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, SettingsError, of_frame
from todframes.base.reading import Positive, check_values
from todframes.display.display import TILE, dithered
from todframes.frames.contrast import centroid_position, check_on_frame, read_contrast, size_in_px
from todframes.frames.dataset import Dataset
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import Trial
from todframes.stimulus import coverage

N_CODES = 256
"""Number of code values of a monitor: 8 bits a channel."""

READING_EXPONENT = 2.2
"""Exponent of the scale in which luminance is interpolated between readings: there it is almost straight."""

LARGEST_CD_M2, SMALLEST_RISE_CD_M2 = 1e5, 1e-6
"""Largest luminance of a monitor, and smallest difference of two readings that a photometer resolves."""

PITCH_RATIOS = (0.5, 2.0)
"""Range of the visual angle of a pixel over that of the dataset's display; beyond it the test would not be the
same."""

RANGES = {"pixel_pitch_mm": (0.02, 2.0), "viewing_distance_mm": (50.0, 50_000.0)}
"""Pixel pitches of real monitors, and viewing distances of people; other values are mistakes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Measures of a monitor, as a person made them at the page. All pixels are those of the device. Readings of a
    photometer, pairs of code value and luminance in cd/m², count if they are given; else the exponent `gamma`.
    `device_pixel_ratio` is in device pixels per pixel of the page.
    """

    device_pixel_ratio: float
    pixel_pitch_mm: float
    viewing_distance_mm: float
    gamma: float | None = None
    photometer: tuple[tuple[float, float], ...] | None = None
    screen_px: tuple[int, int]
    viewport_px: tuple[int, int]


class ContrastRange(NamedTuple):
    """The contrasts of a trial: of its triangle's area, and those between which 99 % of its pixels lie."""

    frame: str
    low: float
    high: float
    triangle_low: float
    triangle_high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Monitor:
    """A monitor with the distance of the person; the sidecar of the answers holds it. `background_code` is the
    code value of the page, and of contrast 0. Its luminance and that of code 0 are over that of white, and
    `background_luminance_cd_m2` is None if no photometer was read. `gamma` is the exponent from the half-tone
    match; `lut` has the readings of a photometer in place of it: code value, 0 to 255, and luminance in cd/m².
    With `dither`, luminances between two codes are shown by pixels of both. Sizes of screen and page are in device
    pixels.
    """

    pixel_pitch_mm: Positive
    viewing_distance_mm: Positive
    pixel_pitch_mrad: Positive
    background_code: Annotated[int, Meta(ge=1, le=N_CODES - 1)]
    background_relative: float
    background_luminance_cd_m2: float | None = None
    gamma: float | None = None
    lut: tuple[tuple[float, float], ...] | None = None
    black_relative: float = 0.0
    bits: Literal[8] = 8
    dither: bool = True
    device_pixel_ratio: float = 1.0
    screen_px: tuple[int, int] = (0, 0)
    viewport_px: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        check_values(self)
        self.luminance_of_code()  # raises for a monitor that is none

    def luminance_of_code(self) -> FloatArray:
        """Return the luminance of the code values 0 to 255 over that of white, rising: shape (256,)."""
        if self.lut is not None and self.gamma is None:
            return luminance_of_readings(self.lut)
        if self.gamma is not None and self.lut is None:
            return luminance_of_gamma(self.gamma)
        raise SettingsError("gamma, lut: found both or none of them, expected one")

    def contrast_of_code(self) -> FloatArray:
        """Return the Weber contrast of the code values 0 to 255 against the background, rising: shape (256,)."""
        luminance = self.luminance_of_code()
        return np.asarray(luminance / luminance[self.background_code] - 1.0)

    def contrast_limits(self) -> tuple[float, float]:
        """Return the contrasts half of a code step beyond black and white; those between can be shown."""
        of_code = self.contrast_of_code()
        return float(1.5 * of_code[0] - 0.5 * of_code[1]), float(1.5 * of_code[-1] - 0.5 * of_code[-2])


def luminance_of_gamma(gamma: float) -> FloatArray:
    """Return (code / 255)^gamma for the code values 0 to 255."""
    if not 1.0 <= gamma <= 4.0:
        raise SettingsError(f"gamma: found {gamma!r}, expected 1 to 4; match the half-tone again")
    return np.asarray((np.arange(N_CODES) / (N_CODES - 1)) ** gamma)


def luminance_of_readings(lut: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return the luminance of the code values 0 to 255 over that of white, from readings of a photometer. Between
    readings, luminance^(1/2.2) is interpolated linearly; readings are met exactly.
    """
    codes, cd_m2 = np.array(sorted(lut), np.float64).reshape(-1, 2).T
    is_rising = (np.diff(codes) > 0).all() and (np.diff(cd_m2) > SMALLEST_RISE_CD_M2).all()
    is_whole = codes.size >= 4 and codes[0] == 0 and codes[-1] == N_CODES - 1
    if not (is_whole and is_rising and cd_m2[0] >= 0.0 and cd_m2[-1] <= LARGEST_CD_M2):
        read = ", ".join(f"{code:g}: {luminance:g}" for code, luminance in zip(codes, cd_m2, strict=True))
        raise SettingsError(
            f"lut: found the readings {read} cd/m², expected at least 4 codes, with 0 and {N_CODES - 1}, of at "
            f"most {LARGEST_CD_M2:g} cd/m², and luminance to rise with the code; read them again"
        )
    root = np.interp(np.arange(N_CODES), codes, cd_m2 ** (1.0 / READING_EXPONENT))
    return np.asarray((root / root[-1]) ** READING_EXPONENT)


def viewing_distance_mm(*, pixel_pitch_mm: float, pixel_pitch_mrad: float) -> float:
    """Return the distance from which a pixel has a visual angle; 2 atan(pitch / 2 distance)."""
    return pixel_pitch_mm / (2.0 * math.tan(pixel_pitch_mrad / 2000.0))


def calibrated(calibration: Calibration, *, background: float, dither: bool) -> Monitor:
    """Make the monitor of a person's measures. `background` is the largest luminance of the background over that
    of white: it becomes that of the next code below.
    """
    if calibration.device_pixel_ratio not in (1.0, 2.0, 3.0, 4.0):
        raise SettingsError(
            f"a pixel of the page is {calibration.device_pixel_ratio:.4g} pixels of the monitor, so the browser "
            "would resample the frames; set the zoom of the page to 100 % (Ctrl and 0), and the scale of the "
            "display to a whole number",
        )
    pitch, readings = calibration.pixel_pitch_mm, calibration.photometer
    for name, (low, high) in RANGES.items():
        if not low <= (value := getattr(calibration, name)) <= high:
            raise SettingsError(f"{name}: found {value:.4g} mm, expected {low:g} to {high:g} mm; measure again")
    gamma = None if readings else calibration.gamma
    if readings:
        luminance = luminance_of_readings(readings)
    elif gamma is not None:
        luminance = luminance_of_gamma(gamma)
    else:
        raise SettingsError("gamma, photometer: found none of them, expected one")
    background_code = int(np.searchsorted(luminance, background * (1.0 + 1e-9), side="right")) - 1
    if not 0 < background_code < N_CODES - 1:
        raise SettingsError(
            f"the background of {background:g} × white is not between the monitor's black ({luminance[0]:.2g} × "
            "white) and white; take another background",
        )
    relative = float(luminance[background_code])
    white_cd_m2 = max(cd_m2 for _, cd_m2 in readings) if readings else None
    return Monitor(
        pixel_pitch_mm=pitch,
        viewing_distance_mm=calibration.viewing_distance_mm,
        pixel_pitch_mrad=2000.0 * math.atan(pitch / calibration.viewing_distance_mm / 2.0),  # seen straight on
        background_code=background_code,
        background_relative=relative,
        background_luminance_cd_m2=None if white_cd_m2 is None else relative * white_cd_m2,
        gamma=gamma,
        lut=tuple(sorted(readings)) if readings else None,
        black_relative=float(luminance[0]),
        dither=dither,
        device_pixel_ratio=calibration.device_pixel_ratio,
        screen_px=calibration.screen_px,
        viewport_px=calibration.viewport_px,
    )


def check_shows(
    monitor: Monitor, *, frame_px: tuple[int, int], pixel_pitch_mrad: float, ranges: list[ContrastRange]
) -> None:
    """Raise SettingsError if a monitor cannot show trials: if the page has no room for `frame_px`, the largest
    width and height of a frame; if pixels are much larger or smaller at the eye than those of the dataset's
    display; or if a contrast of a triangle, or more than 1 % of the pixels of a trial, is beyond the monitor's
    range. `ranges` has the contrasts of each trial.
    """
    if any(frame > page for frame, page in zip(frame_px, monitor.viewport_px, strict=True)):
        raise SettingsError(
            "a frame has {} × {} pixels, the page has room for {} × {}; show the page on the full screen (F11), "
            "or take a larger monitor".format(*frame_px, *monitor.viewport_px),
        )
    ratio = monitor.pixel_pitch_mrad / pixel_pitch_mrad
    if not PITCH_RATIOS[0] <= ratio <= PITCH_RATIOS[1]:
        distance = viewing_distance_mm(pixel_pitch_mm=monitor.pixel_pitch_mm, pixel_pitch_mrad=pixel_pitch_mrad)
        raise SettingsError(
            f"a pixel has {monitor.pixel_pitch_mrad:.4g} mrad at the eye, {ratio:.3g} times that of the dataset "
            f"({pixel_pitch_mrad:.4g} mrad), expected {PITCH_RATIOS[0]:g} to {PITCH_RATIOS[1]:g} times; sit "
            f"{distance:.0f} mm from the screen",
        )
    of_code, (black, white) = monitor.contrast_of_code(), monitor.contrast_limits()
    for trial in ranges:
        low, high = min(trial.low, trial.triangle_low), max(trial.high, trial.triangle_high)
        shown = f"it shows {of_code[0]:.3g} to {of_code[-1]:.3g}"
        if low < black:
            raise SettingsError(
                f"the monitor cannot show the contrast {low:.3g} of {trial.frame}: {shown}; take frames with less "
                "contrast or noise",
            )
        if high > white:
            proposed = 0.99 / (1.0 + high)  # two digits, less 1 % for the step of the background
            digit = 10.0 ** (math.floor(math.log10(proposed)) - 1)
            raise SettingsError(
                f"the monitor cannot show the contrast {high:.3g} of {trial.frame}: {shown} on this background; "
                f"take a background of {math.floor(proposed / digit) * digit:.2g}",
            )
        step = of_code[monitor.background_code + 1] / 2.0
        if not monitor.dither and max(-low, high) < step:
            raise SettingsError(
                f"the contrast {max(-low, high):.2g} of {trial.frame} is below half of a code step, {step:.2g}: "
                "it would not be seen at all without dither",
            )


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
    background is shown unchanged. Pixels that a file leaves out of its frame have the contrast 0.
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
