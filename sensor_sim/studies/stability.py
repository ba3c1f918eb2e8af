"""The stability cases of sensor_sim: extreme optics, detectors, displays and whole chains.

Lengths are in detectors of 1 mrad, frequencies in cycles per detector.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal, gaussian_kernel
from sensor_sim.chain.sampling import TriangleSampler
from sensor_sim.chain.sensor import Detector, Noise, Optics, Sensor
from sensor_sim.chain.transfer import diffraction_mtf
from sensor_sim.four_bars.mrtd import mrtd
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain
from todframes.base._typing import FloatArray
from todframes.display.display import SensorDisplay
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import RetinaGrid, resample
from todframes.stimulus import HEIGHT_PER_SIZE, Orientation
from todframes.studies.stability.cases import MPMATH, Case

BELOW_CUT_OFF = 1.0 - 2.0 ** -np.array([1.0, 4.0, 7.0, 10.0])
TESTED_PLACES = np.array([0.0, 0.25, -0.5])


def sampler(cut_off: float, *, width: float = 1.0, period: int = 8) -> TriangleSampler:
    """Make a sampler of a triangle of 3 detectors; cut-off in cycles per detector."""
    return TriangleSampler(resolve(camera(cut_off, width=width)), 3.0, 8, period)


def total(cut_off: float) -> FloatArray:
    """Sum the samples of a period, over the triangle's area, at three places."""
    samples = sampler(cut_off).samples(TESTED_PLACES, TESTED_PLACES[::-1], orientation=Orientation.UP)
    return np.asarray(samples.sum(axis=(1, 2)) / 9.0)


def mean_total_of_points(cut_off: float, places: int) -> float:
    """Average that sum over places evenly on a detector of fill factor 1e-4."""
    x, y = np.meshgrid(*(np.arange(places) / places - 0.5,) * 2)
    samples = sampler(cut_off, width=0.01).samples(x.ravel(), y.ravel(), orientation=Orientation.UP)
    return float(samples.sum(axis=(1, 2)).mean() / 9.0)


def three_samples(cut_off: float, period: int, place: tuple[float, float], at: Any) -> FloatArray:
    """Return some samples of a triangle at a place."""
    return np.asarray(sampler(cut_off, period=period).samples(*place, orientation=Orientation.UP)[0][at])


def display_of(pixels_per_detector: int, *, detector_pitch_mrad: float) -> SensorDisplay:
    """Make a display whose detectors are seen under an angle, whatever the number of their pixels."""
    pixel_mm = 2000.0 * math.tan(detector_pitch_mrad / pixels_per_detector / 2000.0)
    return SensorDisplay(
        pixels_per_detector=pixels_per_detector,
        pixel_pitch_mm=pixel_mm,
        viewing_distance_mm=1000.0,
        background_luminance_cd_m2=50.0,
    )


def held(pixels_per_detector: int) -> FloatArray:
    """Compute the retina image of three by three detectors on a display."""
    display = display_of(pixels_per_detector, detector_pitch_mrad=1.0)
    matrix = axis_matrix(3, pixels_per_detector=pixels_per_detector, blur_px=[0.0])
    shown = display_signal(np.arange(9.0).reshape(3, 3) ** 2, matrix)
    at = display_position_px(0.3, n_detectors=3, display=display)
    return resample(shown, RetinaGrid(7, 0.21), x_px=at, y_px=at, pixel_pitch_mrad=display.pixel_pitch_mrad)


def variance(sigma: float) -> float:
    """Compute the variance of the kernel of a Gaussian blur."""
    kernel = gaussian_kernel(sigma)
    return float(kernel @ (np.arange(kernel.size) - kernel.size // 2) ** 2)


def camera(cut_off: float = 2.0, *, width: float = 1.0, pixels_per_detector: int = 1) -> Sensor:
    """Make a camera whose detectors are seen under 3 mrad; cut-off in cycles per detector."""
    return Sensor(
        optics=Optics(aperture_mm=cut_off, wavelength_um=1.0),
        detector=Detector(pitch_mrad=1.0, width_mrad=width),
        display=display_of(pixels_per_detector, detector_pitch_mrad=3.0),
    )


def proportions(sensor: Sensor, size: float, snrs: tuple[float, ...], internal_noise: float = 0.5) -> list[float]:
    """Compute the mean P(correct) over some places and all orientations; nothing is left out."""
    observer = PyramidObserver(PyramidSettings(internal_noise=internal_noise))
    camera = resolve(sensor)
    chain = FoldedChain(camera, observer, size, plan_curve(camera, observer, size, name="full"))
    phases = chain.phases(3, np.random.default_rng(1))
    return [chain.proportion_correct(phases, snr) for snr in snrs]


def ratio(sensor: Sensor, other: Sensor) -> float:
    """Compute P(correct) of a sensor over that of another."""
    return proportions(sensor, 5.0, (2.0,))[0] / proportions(other, 5.0, (2.0,))[0]


def mrtd_mk(netd_mk: float) -> float:
    """Compute the MRTD at half the Nyquist frequency."""
    sensor = replace(camera(), noise=Noise(netd_mk=netd_mk))
    (bars,) = mrtd(sensor, frequency_nyquist=[0.5], size_detectors=(), tolerance=0.1).bars
    return bars.mrtd_mk or math.nan


SIGMAS = np.array([1e-3, 0.3, 1.5, 1000.0])
AREA = "law: samples of a period sum to the area"
AVERAGE = "law: samples sum to the area on average, whatever the gaps"

TIP = 2.0 * HEIGHT_PER_SIZE - 2.0
"""Height of the tip of a triangle of 3 detectors in the middle, above the detectors' edge."""

ROWS: dict[str, list[tuple[Any, ...]]] = {
    "transfer": [
        ("diffraction, half to 1e-3 below the cut-off",
         [0.39100221895577064, 0.018579753503245023, 0.0008279599119588005, 3.6628597915967845e-05],
         MPMATH + "2/π (arccos x − x √(1 − x²))",
         lambda: diffraction_mtf(4.0 * BELOW_CUT_OFF, wavelength_um=0.5, aperture_mm=2.0), 12),
    ],
    "samples": [
        *((f"cut-off {name}: sum", [1.0] * 3, AREA, partial(total, cut_off), 12)
          for name, cut_off in (("exactly at Nyquist", 0.5), ("of 2e9 times Nyquist", 1e9))),
        ("cut-off of 0.015 Nyquist: three samples",
         [0.00043544826155055515, 0.000436647432458079, 0.00043525336509255274], MPMATH + "nine waves",
         lambda: three_samples(0.0075, 200, (0.25, -0.5), ([0, 4, 7], [0, 3, 7])), 12),
        ("cut-off of 2e9 Nyquist: the tip and a detector below", [TIP**2 / math.sqrt(12.0), 1.0],
         "closed form: areas", lambda: three_samples(1e9, 8, (0.0, 0.0), ([1, 4], [3, 3])), 12),
        ("fill factor 1e-4, cut-off 1e9 cycles/detector: mean sum over 10⁴ places", 1.0, AVERAGE,
         lambda: mean_total_of_points(1e9, 100), 12),
    ],
    "display": [
        ("blur of 1e-3 to 1,000 pixels: variance", SIGMAS**2, "σ²", lambda: list(map(variance, SIGMAS)), 9),
        ("1,000 pixels a detector: retina image", held(1), "law: as with one pixel a detector",
         lambda: held(1000), 12),
    ],
    "curve": [
        ("SNR 1e-9 and 1e9: P(correct)", [0.25, 1.0], "no signal: chance; internal noise 0, no noise: the largest",
         lambda: proportions(camera(), 8.0, (1e-9, 1e9), internal_noise=0.0), 8),
        ("1,000 display pixels a detector: P(correct), ratio", 1.0, "law: as with one pixel a detector",
         lambda: ratio(camera(pixels_per_detector=1000), camera()), 5),
        ("cut-off of 2e6 and 2e9 Nyquist: P(correct), ratio", 1.0, "law: the optics leave no trace",
         lambda: ratio(camera(1e6), camera(1e9)), 5),
    ],
    "bars": [
        ("NETD of 1e-9 and 1e9 mK: MRTD, ratio", 1e18, "law: MRTD is proportional to NETD",
         lambda: mrtd_mk(1e9) / mrtd_mk(1e-9), 9),
    ],
}  # fmt: skip
"""The cases by group: name, expected, source, compute and digits as in `Case`."""


def cases() -> list[Case]:
    """List all cases of sensor_sim."""
    return [Case(group, *row) for group, rows in ROWS.items() for row in rows]
