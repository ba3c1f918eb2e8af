"""Extreme displays and whole chains; optics and detectors in the module beside."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sensor_sim import stability_optics_cases
from sensor_sim.noise import k_factor
from sensor_sim.planning import plan_curve
from sensor_sim.predict import FoldedChain, predict_threshold
from sensor_sim.reconstruction import axis_matrix, display_position_px, display_signal, gaussian_kernel
from sensor_sim.sensor import Electronics, Noise, Optics, Sensor, SensorDisplay
from sensor_sim.simulate import Simulator
from todframes.observer import PyramidObserver
from todframes.pyramid_settings import PyramidSettings
from todframes.retina import RetinaGrid, resample
from todframes.stability import Case, refusal

FloatArray = NDArray[np.float64]


def cases() -> list[Case]:
    """All cases of sensor_sim."""
    return [*stability_optics_cases.cases(), *display_cases(), *curve_cases()]


def display_of(
    pixels_per_detector: int, *, detector_pitch_mrad: float, blur_sigma_px: float = 0.0
) -> SensorDisplay:
    """A display whose detectors are seen under an angle, whatever the number of their pixels."""
    pixel_mm = 2000.0 * math.tan(detector_pitch_mrad / pixels_per_detector / 2000.0)
    return SensorDisplay(
        pixels_per_detector=pixels_per_detector,
        pixel_pitch_mm=pixel_mm,
        viewing_distance_mm=1000.0,
        background_luminance_cd_m2=50.0,
        blur_sigma_px=blur_sigma_px,
    )


def held(pixels_per_detector: int) -> FloatArray:
    """Retina image of three by three detectors on a display."""
    display = display_of(pixels_per_detector, detector_pitch_mrad=1.0)
    matrix = axis_matrix(3, display=display, electronics=Electronics())
    shown = display_signal(np.arange(9.0).reshape(3, 3) ** 2, matrix)
    at = display_position_px(0.3, n_detectors=3, display=display)
    grid = RetinaGrid(7, 0.21)
    return resample(shown, grid, x_px=at, y_px=at, pixel_pitch_mrad=display.pixel_pitch_mrad)


def display_cases() -> list[Case]:
    """Of noise, hold, display and retina."""
    case = partial(Case, "display")
    sigmas = np.array([1e-3, 0.3, 1.5, 1000.0])

    def variance(sigma: float) -> float:
        kernel = gaussian_kernel(sigma)
        place = np.arange(kernel.size) - kernel.size // 2
        return float(kernel @ place**2)

    def widest() -> float:
        display = display_of(1000, detector_pitch_mrad=1.0, blur_sigma_px=1000.0)
        return float(axis_matrix(21, display=display, electronics=Electronics())[10_500].sum())

    def on_an_edge() -> FloatArray:
        ramp = np.add.outer(np.arange(9.0) ** 2, np.arange(9.0) ** 3)
        return resample(ramp, RetinaGrid(3, 1.0), x_px=4.5, y_px=3.5, pixel_pitch_mrad=1.0)

    rows, columns = (np.array([(n**k + (n + 1) ** k) / 2 for n in range(m, m + 3)]) for k, m in ((2, 2), (3, 3)))
    return [
        case("blur of 1e-3 to 1,000 pixels: variance", sigmas**2, "σ²", lambda: [variance(s) for s in sigmas], 9),
        case("1,000 pixels a detector, blur of 1,000: sum of weights", 1.0, "uniform stays uniform", widest, 12),
        case(
            "1,000 pixels a detector: retina image",
            held(1),
            "law: as with one pixel a detector",
            lambda: held(1000),
            12,
        ),
        case(
            "retina samples exactly between pixels",
            np.add.outer(rows, columns),
            "closed form: means of neighbours",
            on_an_edge,
            15,
        ),
        case(
            "noise of 10⁶ frames, and of a fixed pattern 1e12 times as strong: k",
            [1000.0, 1.0 / math.sqrt(1.0 + 1e24)],
            "closed form",
            lambda: [k_factor(Noise(frames_integrated=10**6)), k_factor(Noise(fixed_pattern_ratio=1e12))],
            12,
        ),
    ]


def camera(cut_off: float = 2.0, *, blur: float = 0.0, display: SensorDisplay | None = None) -> Sensor:
    """A camera whose detectors are seen under 3 mrad; cut-off in cycles per detector."""
    return Sensor(
        optics=Optics(aperture_mm=cut_off, wavelength_um=1.0, blur_sigma_mrad=blur),
        detector=stability_optics_cases.CONTIGUOUS,
        display=display or display_of(1, detector_pitch_mrad=3.0),
    )


def proportions(sensor: Sensor, size: float, snrs: tuple[float, ...], internal_noise: float = 0.5) -> list[float]:
    """Mean P(correct) over some places and all orientations; nothing is left out."""
    observer = PyramidObserver(PyramidSettings(internal_noise=internal_noise))
    chain = FoldedChain(sensor, observer, size, plan_curve(sensor, observer, size, name="full"))
    phases = chain.phases(3, np.random.default_rng(1))
    return [chain.proportion_correct(phases, snr) for snr in snrs]


def curve_cases() -> list[Case]:
    """Of whole chains."""
    case = partial(Case, "curve")
    many = display_of(1000, detector_pitch_mrad=3.0)
    tiny = display_of(1, detector_pitch_mrad=0.153e-3)

    def ratio(sensor: Sensor, other: Sensor) -> float:
        return proportions(sensor, 5.0, (2.0,))[0] / proportions(other, 5.0, (2.0,))[0]

    def refused(sensor: Sensor, size: float, naming: str) -> str:
        return refusal(lambda: FoldedChain(sensor, PyramidObserver(), size), naming)

    return [
        case(
            "SNR 1e-9 and 1e9: P(correct)",
            [0.25, 1.0],
            "no signal: chance; internal noise 0, no noise: the largest",
            lambda: proportions(camera(), 8.0, (1e-9, 1e9), internal_noise=0.0),
            8,
        ),
        case(
            "1,000 display pixels a detector: P(correct), ratio",
            1.0,
            "law: as with one pixel a detector",
            lambda: ratio(camera(display=many), camera()),
            5,
        ),
        case(
            "1,000 display pixels a detector, blur of 1 pixel: P(correct), ratio",
            1.0,
            "law: as with none, to 1e-5",
            lambda: ratio(camera(display=replace(many, blur_sigma_px=1.0)), camera()),
            4,
        ),
        case(
            "1,000 display pixels a detector: frames",
            "refused",
            "frames of at most 256 MB",
            lambda: refusal(lambda: Simulator(camera(display=many), 5.0, seed=1), "expected at most 11585"),
        ),
        case(
            "1,000 detectors a retina sample, triangle of 30: threshold",
            "never_reached",
            "four identical templates",
            lambda: predict_threshold(FoldedChain(camera(0.5, display=tiny), PyramidObserver(), 30.0)).status,
        ),
        case(
            "1,000 detectors a retina sample, triangle of 3,000",
            "refused",
            "a field of at most 1,024 detectors",
            lambda: refused(camera(display=tiny), 3000.0, "expected at most 1024"),
        ),
        case(
            "optics blur of 1,000 detectors",
            "refused",
            "a field of at most 1,024 detectors",
            lambda: refused(camera(blur=1000.0), 5.0, "expected at most 1024"),
        ),
        case(
            "cut-off of 1e-3 Nyquist",
            "refused",
            "nothing but the mean passes",
            lambda: refused(camera(0.0005), 5.0, "optics: found a cut-off"),
        ),
        case(
            "cut-off of 2e6 and 2e9 Nyquist: P(correct), ratio",
            1.0,
            "law: the optics leave no trace",
            lambda: ratio(camera(1e6), camera(1e9)),
            5,
        ),
    ]
