"""Extreme optics and detectors: transfer functions and exact samples.

Detectors are 1 mrad apart and the wavelength is 1 µm, so an aperture in mm is a cut-off in cycles per detector.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sensor_sim.sampling import TriangleSampler
from sensor_sim.sensor import Detector, Optics
from sensor_sim.transfer import box_mtf, diffraction_mtf, gaussian_mtf
from todframes.stability import MPMATH, Case
from todframes.stimulus import HEIGHT_PER_SIZE, Orientation

FloatArray = NDArray[np.float64]

BELOW_CUT_OFF = 1.0 - 2.0 ** -np.array([10.0, 20.0, 30.0, 40.0, 52.0])
AT_AND_BEYOND = np.array([1.0, 1.0 + 2.0**-52, 2.0, 1e9, 1e300])
PLACES = np.array([0.0, 0.25, -0.5])
CONTIGUOUS = Detector(pitch_mrad=1.0, width_mrad=1.0)
POINTS = Detector(pitch_mrad=1.0, width_mrad=0.01)
"""Of fill factor 1e-4."""


def cases() -> list[Case]:
    """Of transfer functions and samples."""
    return [*transfer_cases(), *sample_cases()]


def transfer_cases() -> list[Case]:
    """Of modulation transfer functions."""
    case = partial(Case, "transfer")

    def diffraction(of_cut_off: FloatArray) -> FloatArray:
        return diffraction_mtf(4.0 * of_cut_off, wavelength_um=0.5, aperture_mm=2.0)

    return [
        case(
            "diffraction, 1e-3 to 2e-16 below the cut-off",
            [
                3.6628597915967845e-05,
                1.1179797194473607e-09,
                3.411803830625912e-14,
                1.0411998996283173e-18,
                3.971862410081708e-24,
            ],
            MPMATH + "2/π (arccos x − x √(1 − x²))",
            lambda: diffraction(BELOW_CUT_OFF),
            12,
        ),
        case("diffraction, at the cut-off and beyond", [0.0] * 5, "0", lambda: diffraction(AT_AND_BEYOND), 15),
        case(
            "Gaussian, blur 0 to 1,000 detectors, at Nyquist",
            [1.0, math.exp(-(math.pi**2) / 2.0), 0.0],
            "closed form: exp(−π²σ²/2)",
            lambda: [float(gaussian_mtf(0.5, sigma=sigma)) for sigma in (0.0, 1.0, 1000.0)],
            12,
        ),
        case(
            "detector, at multiples of the sampling frequency",
            [0.0] * 3,
            "closed form: sin(πk) = 0",
            lambda: box_mtf([1.0, 1e3, 1e6], width=1.0),
            12,
            1.0,
        ),
    ]


def sampler(
    cut_off: float, *, blur: float = 0.0, detector: Detector = CONTIGUOUS, period: int = 8, field: int = 8
) -> TriangleSampler:
    """Samples of a triangle of 3 detectors; cut-off and blur in cycles per detector and detectors."""
    optics = Optics(aperture_mm=cut_off, wavelength_um=1.0, blur_sigma_mrad=blur)
    return TriangleSampler(
        optics=optics, detector=detector, size_detectors=3.0, field_detectors=field, period_detectors=period
    )


def total(cut_off: float, *, blur: float = 0.0) -> FloatArray:
    """Sum of the samples of a period over the triangle's area, at three places."""
    samples = sampler(cut_off, blur=blur).samples(PLACES, PLACES[::-1], orientation=Orientation.UP)
    return np.asarray(samples.sum(axis=(1, 2)) / 9.0)


def mean_total_of_points(cut_off: float, places: int) -> float:
    """The mean of that over places evenly on a detector of fill factor 1e-4."""
    x, y = np.meshgrid(*(np.arange(places) / places,) * 2)
    samples = sampler(cut_off, detector=POINTS).samples(
        x.ravel() - 0.5, y.ravel() - 0.5, orientation=Orientation.UP
    )
    return float(samples.sum(axis=(1, 2)).mean() / 9.0)


def half_a_detector_on(cut_off: float) -> float:
    """Difference of samples half a detector this way and that way, moved by a whole one."""
    both = sampler(cut_off, period=16)
    before, after = (both.samples(at, at, orientation=Orientation.RIGHT)[0] for at in (-0.5, 0.5))
    return float(np.abs(before[:-1, :-1] - after[1:, 1:]).max())


def sample_cases() -> list[Case]:
    """Of detector samples."""
    case = partial(Case, "samples")
    area = "law: samples of a period sum to the area"
    evenly = "law: so they do on average, whatever the gaps"
    height = 3.0 * HEIGHT_PER_SIZE
    tip = 2.0 / 3.0 * height - 2.0  # of the triangle in the middle, above the detectors' edge
    return [
        *(
            case(f"cut-off {name}: sum", [1.0] * 3, area, partial(total, cut_off), 12)
            for name, cut_off in (
                ("of a fourth of Nyquist, on the second wave", 0.125),
                ("just below Nyquist", 0.5 - 2.0**-54),
                ("exactly at Nyquist", 0.5),
                ("of 20 times Nyquist", 10.0),
                ("of 2e9 times Nyquist", 1e9),
            )
        ),
        case(
            "cut-off of 0.015 Nyquist: three samples",
            [0.00043544826155055515, 0.000436647432458079, 0.00043525336509255274],
            MPMATH + "nine waves",
            lambda: sampler(0.0075, period=200).samples(0.25, -0.5, orientation=Orientation.UP)[0][
                [0, 4, 7], [0, 3, 7]
            ],
            12,
        ),
        case(
            "cut-off of 2e9 Nyquist: the tip and a detector below",
            [tip**2 / math.sqrt(12.0), 1.0],
            "closed form: areas",
            lambda: sampler(1e9).samples(0.0, 0.0, orientation=Orientation.UP)[0][[1, 4], [3, 3]],
            12,
        ),
        *(
            case(f"blur of {b:g} detectors: sum", [1.0] * 3, area, partial(total, 10.0, blur=b), 12)
            for b in (0.0, 1e-3, 3.0)
        ),
        case(
            "fill factor 1e-4, cut-off 2 cycles/detector: mean sum over 4 places",
            1.0,
            evenly,
            partial(mean_total_of_points, 2.0, 2),
            12,
        ),
        case(
            "fill factor 1e-4, cut-off 1e9 cycles/detector: mean sum over 10⁴ places",
            1.0,
            evenly,
            partial(mean_total_of_points, 1e9, 100),
            12,
        ),
        *(
            case(
                f"displaced by exactly half a detector, cut-off {name} cycles/detector: difference",
                0.0,
                "law: a whole detector on, the same samples",
                partial(half_a_detector_on, cut_off),
                12,
                1.0,
            )
            for name, cut_off in (("0.5", 0.5), ("10", 10.0), ("1e9", 1e9))
        ),
    ]
