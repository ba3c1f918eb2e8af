"""Stability cases of sensor_sim: extreme optics, detectors, displays and whole chains.

Lengths are in detectors of 1 mrad, frequencies in cycles per detector.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.detector_noise import k_factor
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal, gaussian_kernel
from sensor_sim.chain.sampling import TriangleSampler
from sensor_sim.chain.sensor import Detector, Noise, Optics, Sensor, SensorDisplay
from sensor_sim.chain.simulation import Simulator
from sensor_sim.chain.transfer import box_mtf, diffraction_mtf, gaussian_mtf
from sensor_sim.four_bars.mrtd import mrtd
from sensor_sim.thresholds.curve import curve
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from todframes.base._typing import FloatArray
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import RetinaGrid, resample
from todframes.stimulus import HEIGHT_PER_SIZE, Orientation
from todframes.studies.stability.case import MPMATH, Case, refusal

BELOW_CUT_OFF = 1.0 - 2.0 ** -np.array([10.0, 20.0, 30.0, 40.0, 52.0])
AT_AND_BEYOND = np.array([1.0, 1.0 + 2.0**-52, 2.0, 1e9, 1e300])
TESTED_PLACES = np.array([0.0, 0.25, -0.5])
CONTIGUOUS = Detector(pitch_mrad=1.0, width_mrad=1.0)

POINT_DETECTORS = Detector(pitch_mrad=1.0, width_mrad=0.01)
"""Detectors of fill factor 1e-4."""


def diffraction(of_cut_off: FloatArray) -> FloatArray:
    """Compute the MTF of an aperture at frequencies in units of its cut-off."""
    return diffraction_mtf(4.0 * of_cut_off, wavelength_um=0.5, aperture_mm=2.0)


def sampler(
    cut_off: float, *, blur: float = 0.0, detector: Detector = CONTIGUOUS, period: int = 8, field: int = 8
) -> TriangleSampler:
    """Make a sampler of a triangle of 3 detectors; cut-off and blur in cycles per detector and detectors."""
    optics = Optics(aperture_mm=cut_off, wavelength_um=1.0, blur_sigma_mrad=blur)
    sensor = Sensor(optics=optics, detector=detector, display=display_of(1, detector_pitch_mrad=1.0))
    return TriangleSampler(resolve(sensor), 3.0, field, period)


def total(cut_off: float, *, blur: float = 0.0) -> FloatArray:
    """Sum the samples of a period, over the triangle's area, at three places."""
    samples = sampler(cut_off, blur=blur).samples(TESTED_PLACES, TESTED_PLACES[::-1], orientation=Orientation.UP)
    return np.asarray(samples.sum(axis=(1, 2)) / 9.0)


def mean_total_of_points(cut_off: float, places: int) -> float:
    """Average that sum over places evenly on a detector of fill factor 1e-4."""
    x, y = np.meshgrid(*(np.arange(places) / places,) * 2)
    samples = sampler(cut_off, detector=POINT_DETECTORS).samples(
        x.ravel() - 0.5, y.ravel() - 0.5, orientation=Orientation.UP
    )
    return float(samples.sum(axis=(1, 2)).mean() / 9.0)


def half_a_detector_on(cut_off: float) -> float:
    """Compare samples half a detector this way and that way, moved by a whole one."""
    both = sampler(cut_off, period=16)
    before, after = (both.samples(at, at, orientation=Orientation.RIGHT)[0] for at in (-0.5, 0.5))
    return float(np.abs(before[:-1, :-1] - after[1:, 1:]).max())


def display_of(
    pixels_per_detector: int, *, detector_pitch_mrad: float, blur_sigma_px: float = 0.0
) -> SensorDisplay:
    """Make a display whose detectors are seen under an angle, whatever the number of their pixels."""
    pixel_mm = 2000.0 * math.tan(detector_pitch_mrad / pixels_per_detector / 2000.0)
    return SensorDisplay(
        pixels_per_detector=pixels_per_detector,
        pixel_pitch_mm=pixel_mm,
        viewing_distance_mm=1000.0,
        background_luminance_cd_m2=50.0,
        blur_sigma_px=blur_sigma_px,
    )


def held(pixels_per_detector: int) -> FloatArray:
    """Compute the retina image of three by three detectors on a display."""
    display = display_of(pixels_per_detector, detector_pitch_mrad=1.0)
    matrix = axis_matrix(3, pixels_per_detector=pixels_per_detector, blur_px=[0.0])
    shown = display_signal(np.arange(9.0).reshape(3, 3) ** 2, matrix)
    at = display_position_px(0.3, n_detectors=3, display=display)
    grid = RetinaGrid(7, 0.21)
    return resample(shown, grid, x_px=at, y_px=at, pixel_pitch_mrad=display.pixel_pitch_mrad)


def variance(sigma: float) -> float:
    """Compute the variance of the kernel of a Gaussian blur."""
    kernel = gaussian_kernel(sigma)
    return float(kernel @ (np.arange(kernel.size) - kernel.size // 2) ** 2)


def widest() -> float:
    """Sum the weights of a display pixel with 1,000 pixels a detector and a blur of as many."""
    return float(axis_matrix(21, pixels_per_detector=1000, blur_px=[1000.0])[10_500].sum())


def on_an_edge() -> FloatArray:
    """Compute retina samples exactly between pixels of a ramp."""
    ramp = np.add.outer(np.arange(9.0) ** 2, np.arange(9.0) ** 3)
    return resample(ramp, RetinaGrid(3, 1.0), x_px=4.5, y_px=3.5, pixel_pitch_mrad=1.0)


def camera(cut_off: float = 2.0, *, blur: float = 0.0, display: SensorDisplay | None = None) -> Sensor:
    """Make a camera whose detectors are seen under 3 mrad; cut-off in cycles per detector."""
    return Sensor(
        optics=Optics(aperture_mm=cut_off, wavelength_um=1.0, blur_sigma_mrad=blur),
        detector=CONTIGUOUS,
        display=display or display_of(1, detector_pitch_mrad=3.0),
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


def status(sensor: Sensor, size: float) -> str:
    """Return the status of a threshold."""
    return predict_threshold(FoldedChain(resolve(sensor), PyramidObserver(), size)).status


def refused(sensor: Sensor, size: float, naming: str) -> str:
    """Say whether the chain of a sensor is refused."""
    return refusal(lambda: FoldedChain(resolve(sensor), PyramidObserver(), size), naming)


def one_detector(detector_pitch_mrad: float) -> str:
    """Return the status of a triangle of one detector; its warning needs the smallest size with a threshold."""
    display = display_of(60, detector_pitch_mrad=detector_pitch_mrad, blur_sigma_px=2.0)
    return str(curve(camera(display=display), size_detectors=[1.0]).fits[0].status)


def mrtd_mk(netd_mk: float) -> float:
    """Compute the MRTD at half the Nyquist frequency."""
    sensor = replace(camera(), noise=Noise(netd_mk=netd_mk))
    (bars,) = mrtd(sensor, frequency_nyquist=[0.5], size_detectors=(), tolerance=0.1).bars
    return bars.mrtd_mk or math.nan


def bars_refused(frequency_nyquist: float) -> str:
    """Say whether bars of a frequency are refused."""
    expected = "expected a number from 0.0273 to 20"
    return refusal(lambda: mrtd(camera(), frequency_nyquist=[frequency_nyquist]), expected)


SIGMAS = np.array([1e-3, 0.3, 1.5, 1000.0])
AREA = "law: samples of a period sum to the area"
AVERAGE = "law: so they do on average, whatever the gaps"
FIELD = "a field of at most 1,024 detectors"

TIP = 2.0 * HEIGHT_PER_SIZE - 2.0
"""Height of the tip of a triangle of 3 detectors in the middle, above the detectors' edge."""

BETWEEN = [np.array([(n**k + (n + 1) ** k) / 2 for n in range(m, m + 3)]) for k, m in ((2, 2), (3, 3))]
MANY, TINY = display_of(1000, detector_pitch_mrad=3.0), display_of(1, detector_pitch_mrad=0.153e-3)

ROWS: dict[str, list[tuple[Any, ...]]] = {
    "transfer": [
        ("diffraction, 1e-3 to 2e-16 below the cut-off",
         [3.6628597915967845e-05, 1.1179797194473607e-09, 3.411803830625912e-14, 1.0411998996283173e-18,
          3.971862410081708e-24],
         MPMATH + "2/π (arccos x − x √(1 − x²))", lambda: diffraction(BELOW_CUT_OFF), 12),
        ("diffraction, at the cut-off and beyond", [0.0] * 5, "0", lambda: diffraction(AT_AND_BEYOND), 15),
        ("Gaussian, blur 0 to 1,000 detectors, at Nyquist", [1.0, math.exp(-(math.pi**2) / 2.0), 0.0],
         "closed form: exp(−π²σ²/2)",
         lambda: [float(gaussian_mtf(0.5, sigma=sigma)) for sigma in (0.0, 1.0, 1000.0)], 12),
        ("detector, at multiples of the sampling frequency", [0.0] * 3, "closed form: sin(πk) = 0",
         lambda: box_mtf([1.0, 1e3, 1e6], width=1.0), 12, 1.0),
    ],
    "samples": [
        *((f"cut-off {name}: sum", [1.0] * 3, AREA, partial(total, cut_off), 12)
          for name, cut_off in (
              ("of a fourth of Nyquist, on the second wave", 0.125),
              ("just below Nyquist", 0.5 - 2.0**-54),
              ("exactly at Nyquist", 0.5),
              ("of 20 times Nyquist", 10.0),
              ("of 2e9 times Nyquist", 1e9),
          )),
        ("cut-off of 0.015 Nyquist: three samples",
         [0.00043544826155055515, 0.000436647432458079, 0.00043525336509255274], MPMATH + "nine waves",
         lambda: sampler(0.0075, period=200).samples(0.25, -0.5, orientation=Orientation.UP)[0][
             [0, 4, 7], [0, 3, 7]], 12),
        ("cut-off of 2e9 Nyquist: the tip and a detector below", [TIP**2 / math.sqrt(12.0), 1.0],
         "closed form: areas",
         lambda: sampler(1e9).samples(0.0, 0.0, orientation=Orientation.UP)[0][[1, 4], [3, 3]], 12),
        *((f"blur of {b:g} detectors: sum", [1.0] * 3, AREA, partial(total, 10.0, blur=b), 12)
          for b in (0.0, 1e-3, 3.0)),
        ("fill factor 1e-4, cut-off 2 cycles/detector: mean sum over 4 places", 1.0, AVERAGE,
         partial(mean_total_of_points, 2.0, 2), 12),
        ("fill factor 1e-4, cut-off 1e9 cycles/detector: mean sum over 10⁴ places", 1.0, AVERAGE,
         partial(mean_total_of_points, 1e9, 100), 12),
        *((f"displaced by exactly half a detector, cut-off {name} cycles/detector: difference", 0.0,
           "law: a whole detector on, the same samples", partial(half_a_detector_on, float(name)), 12, 1.0)
          for name in ("0.5", "10", "1e9")),
    ],
    "display": [
        ("blur of 1e-3 to 1,000 pixels: variance", SIGMAS**2, "σ²", lambda: list(map(variance, SIGMAS)), 9),
        ("1,000 pixels a detector, blur of 1,000: sum of weights", 1.0, "uniform stays uniform", widest, 12),
        ("1,000 pixels a detector: retina image", held(1), "law: as with one pixel a detector",
         lambda: held(1000), 12),
        ("retina samples exactly between pixels", np.add.outer(*BETWEEN), "closed form: means of neighbours",
         on_an_edge, 15),
        ("noise of 10⁴ frames, and of a fixed pattern 1e12 times as strong: k",
         [100.0, 1.0 / math.sqrt(1.0 + 1e24)], "closed form",
         lambda: [k_factor(Noise(frames_integrated=10**4)), k_factor(Noise(fixed_pattern_ratio=1e12))], 12),
    ],
    "curve": [
        ("SNR 1e-9 and 1e9: P(correct)", [0.25, 1.0], "no signal: chance; internal noise 0, no noise: the largest",
         lambda: proportions(camera(), 8.0, (1e-9, 1e9), internal_noise=0.0), 8),
        ("1,000 display pixels a detector: P(correct), ratio", 1.0, "law: as with one pixel a detector",
         lambda: ratio(camera(display=MANY), camera()), 5),
        ("1,000 display pixels a detector, blur of 1 pixel: P(correct), ratio", 1.0, "law: as with none, to 1e-5",
         lambda: ratio(camera(display=replace(MANY, blur_sigma_px=1.0)), camera()), 4),
        ("1,000 display pixels a detector: frames", "refused", "frames of at most 256 MB",
         lambda: refusal(lambda: Simulator(camera(display=MANY), 5.0, seed=1), "expected at most 11585")),
        ("1,000 detectors a retina sample, triangle of 30: threshold", "never_reached", "four identical templates",
         lambda: status(camera(0.5, display=TINY), 30.0)),
        ("1,000 detectors a retina sample, triangle of 3,000", "refused", FIELD,
         lambda: refused(camera(display=TINY), 3000.0, "found 3000, expected at most")),
        ("optics blur of 1,000 detectors", "refused", FIELD,
         lambda: refused(camera(blur=1000.0), 5.0, "optics.blur_sigma_mrad: found 1000, expected at most")),
        ("optics blur of 100 detectors, triangle of 20: threshold", "never_reached", "a spot points nowhere",
         lambda: status(camera(blur=100.0), 20.0)),
        ("cut-off of 1e-3 Nyquist", "refused", "nothing but the mean passes",
         lambda: refused(camera(0.0005), 5.0, "optics.aperture_mm: found 0.0005, which passes nothing")),
        ("43 mrad a detector at the eye, 60 display pixels: threshold of one detector", "never_reached",
         "a detector points nowhere", lambda: one_detector(43.0), 6, None, 40.0),
        ("430 mrad a detector at the eye, 60 display pixels", "refused", "a retina of 8193 × 8193 samples",
         lambda: refusal(lambda: one_detector(430.0), "size_mrad: found 430 mrad at the eye, expected at most")),
        ("cut-off of 2e6 and 2e9 Nyquist: P(correct), ratio", 1.0, "law: the optics leave no trace",
         lambda: ratio(camera(1e6), camera(1e9)), 5),
    ],
    "bars": [
        ("NETD of 1e-9 and 1e9 mK: MRTD, ratio", 1e18, "law: MRTD is proportional to NETD",
         lambda: mrtd_mk(1e9) / mrtd_mk(1e-9), 9),
        ("bars of 1e-6 and 1e6 Nyquist", "refused, refused", FIELD,
         lambda: ", ".join(map(bars_refused, (1e-6, 1e6)))),
    ],
}  # fmt: skip
"""The cases by group: name, expected, source, compute, digits and scale as in `Case`."""


def cases() -> list[Case]:
    """List all cases of sensor_sim."""
    return [Case(group, *row) for group, rows in ROWS.items() for row in rows]
