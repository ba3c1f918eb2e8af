"""Stability cases of counts and frames: psychometric fits of all kinds, luminances of twelve decades in files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.frames.dataset import load_dataset
from todframes.frames.files import PixelType, write_frame
from todframes.observers.decision import answer_probabilities
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_counts, fit_trials
from todframes.psychometrics.weibull import weibull, weibull_level
from todframes.scoring.score import ScoredDataset, score_dataset
from todframes.stimulus import Orientation, Stimulus, coverage
from todframes.studies.stability.case import MPMATH, Case, refusal

LEVELS = np.geomspace(0.5, 2.0, 7)
DECADES = np.geomspace(1e-6, 1e6, 7)
SINGLE_LEVELS = np.geomspace(0.25, 4.0, 12)

RISING = (8, 9, 12, 20, 25, 29, 30)
"""Right answers of 30 trials at each level."""

SINGLE = (0, 0, 1, 0, 0, 1, 1, 0, 1, 1, 1, 1)
NON_MONOTONE = (8, 14, 9, 20, 18, 29, 27)
SLOPES = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
PROPORTIONS = (0.3, 0.4, 0.5, 0.6, 0.75, 0.85, 0.9, 0.94)
SIDE_PX = 65
CONTRAST = 0.25

PATTERN = np.rint(coverage((SIDE_PX,) * 2, size_px=5.0, x_px=32, y_px=32, orientation=Orientation.UP))
"""A triangle of whole pixels, each of them a retina sample, which half floats hold exactly."""

P_OF_PATTERN = 0.9312557277131851

CHECKERBOARD = 4.0 * (-1.0) ** np.add.outer(np.arange(SIDE_PX), np.arange(SIDE_PX))
"""Noise that looks the same to all four orientations."""

LARGEST_FLOAT = float(np.finfo(np.float32).max)


def cases() -> list[Case]:
    """List the cases of fits and frames."""
    return [*fit_cases(), *frame_cases()]


def fit(n_correct: ArrayLike, n_trials: Any = 30, level: ArrayLike = LEVELS, **settings: Any) -> PsychometricFit:
    """Fit counts, with an interval."""
    n = np.broadcast_to(n_trials, np.shape(level))
    chosen = FitSettings(**{"resamples": 200} | settings)
    return fit_counts(level, n_correct, n, settings=chosen, rng=np.random.default_rng(1))


def threshold(*args: Any, **settings: Any) -> float:
    """Return a threshold that lies within the levels and its interval; NaN otherwise."""
    found = fit(*args, **settings)
    if found.status != "ok" or found.threshold is None or found.threshold_ci95 is None:
        return math.nan
    low, high = found.threshold_ci95
    holds = (low is None or low <= found.threshold) and (high is None or found.threshold <= high)
    return found.threshold if holds else math.nan


def step(n_correct: Sequence[int], level: FloatArray, below: int, n_trials: int = 30) -> str:
    """Say whether a threshold lies between level `below` and the next, where the answers change."""
    found = fit(n_correct, n_trials, level)
    low, high = found.threshold_ci95 or (None, None)
    if found.status != "ok" or found.threshold is None or low is None or high is None:
        return f"{found.status}, {found.threshold_ci95}"
    rounding = 1e-12
    spanned = low <= level[below] * (1.0 + rounding) and high >= level[below + 1] * (1.0 - rounding)
    return "in the gap, spanned" if level[below] < found.threshold < level[below + 1] and spanned else str(found)


def exact_threshold(slope: float, *, lapse_rate: float = 0.0) -> float:
    """Compute the closed form of `threshold_of_curve`."""
    return float(weibull_level(0.75, alpha=3.0, beta=slope, guess_rate=0.25, lapse_rate=lapse_rate))


def threshold_of_curve(slope: float, *, lapse_rate: float = 0.0) -> float:
    """Fit the probabilities of a curve themselves, and return the threshold."""
    curve = {"alpha": 3.0, "beta": slope, "guess_rate": 0.25, "lapse_rate": lapse_rate}
    level = weibull_level(PROPORTIONS, **curve)
    rng = np.random.default_rng(1)
    found = fit_trials(level, weibull(level, **curve), settings=FitSettings(resamples=200), rng=rng)
    return math.nan if found.threshold is None else found.threshold


def fit_cases() -> list[Case]:
    """List the cases of `fit_counts` and `fit_trials`."""
    case = partial(Case, "fit")
    likelihood = MPMATH + "root of the likelihood's derivatives"
    mean = "likelihood: no curve beats a flat line"
    closed = "closed form: x_c of the paper's eq. 3"

    def lapse_beyond() -> list[float]:
        p = weibull(LEVELS, alpha=0.9, beta=3.0, guess_rate=0.25, lapse_rate=0.2)
        found = fit_trials(LEVELS, p, settings=FitSettings(resamples=200), rng=np.random.default_rng(1))
        return [found.threshold or math.nan, found.lapse_rate or math.nan]

    return [
        case("all right: status", "always_exceeded", mean, lambda: fit([30] * 7).status),
        case("all wrong: status", "never_reached", mean, lambda: fit([0] * 7).status),
        case("one trial a level, all right: status", "always_exceeded", mean, lambda: fit([1] * 7, 1).status),
        case("one level: status", "too_few_levels", "a curve needs two", lambda: fit([20], level=[1.0]).status),
        case("falling: status", "never_reached", mean, lambda: fit(RISING[::-1]).status),
        case("all or nothing in turns: status", "never_reached", mean, lambda: fit([30, 0] * 3 + [30]).status),
        case("levels 1e-15 apart: status", "never_reached", mean,
             lambda: fit(RISING, level=1.0 + 1e-15 * np.arange(7)).status),
        case("perfect separation: threshold and interval", "in the gap, spanned",
             "likelihood: any step in the gap is as likely", lambda: step([8, 7, 7, 30, 30, 30, 30], LEVELS, 2)),
        case("perfect separation of 10⁶ trials: threshold and interval", "in the gap, spanned",
             "likelihood: any step in the gap is as likely",
             lambda: step([250_000] * 3 + [10**6] * 4, LEVELS, 2, 10**6)),
        case("one trial a level: threshold", 1.523470047599754, likelihood,
             lambda: threshold(SINGLE, 1, SINGLE_LEVELS)),
        case("non-monotone: threshold", 1.2879063714797194, likelihood, lambda: threshold(NON_MONOTONE)),
        case("levels over 12 decades: threshold", 18.774632957162915, likelihood,
             lambda: threshold(RISING, level=DECADES)),
        *(
            case(f"slope {slope:g}: threshold", exact_threshold(slope), closed, partial(threshold_of_curve, slope))
            for slope in SLOPES
        ),
        case("lapse rate at its bound: threshold", exact_threshold(2.0, lapse_rate=0.05), closed,
             partial(threshold_of_curve, 2.0, lapse_rate=0.05)),
        case("lapse rate four times its bound: threshold and δ", [1.5453118997025495, 0.05], likelihood,
             lapse_beyond),
        case("10⁶ trials a level: threshold", 1.1585031036570017, likelihood,
             lambda: threshold(np.array(RISING) * 33_333, 999_990)),
        case("perfect separation of 2⁵³ trials: threshold and interval", "in the gap, spanned",
             "likelihood: any step in the gap is as likely",
             lambda: step([2**51] * 3 + [2**53] * 4, LEVELS, 2, 2**53)),
        case("levels about 1e-300 and 1e300: thresholds", [1.1585031036570017] * 2, likelihood,
             lambda: [threshold(RISING, level=unit * LEVELS) / unit for unit in (1e-300, 1e300)]),
    ]  # fmt: skip


def frame(background: float, *, contrast: FloatArray | float = CONTRAST * PATTERN) -> FloatArray:
    """Return the luminance of a frame, (65, 65)."""
    return background * (1.0 + np.broadcast_to(contrast, (SIDE_PX, SIDE_PX)))


def frame_observer() -> PyramidObserver:
    """Make an observer whose retina samples are the pixels, and stay in their place."""
    return PyramidObserver(PyramidSettings(retina_pitch_mrad=1.0, position_jitter_samples=0.0))


def scored(
    values: FloatArray, pixel_type: PixelType, *, background: float | str, white: float = 1.0
) -> ScoredDataset:
    """Score a frame with an upright triangle, written to an EXR and read from there."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_frame(folder / "frame.exr", values, pixel_type=pixel_type)
        rule = repr(background) if isinstance(background, float) else f'"{background}"'
        display = f'eotf = "linear"\nwhite_luminance_cd_m2 = {white!r}\nbackground_luminance_cd_m2 = {rule}'
        (folder / "dataset.toml").write_text(
            f'schema = 1\n[display]\n{display}\npixel_pitch_mrad = 1.0\n[experiment]\nlevel = "contrast"\n'
        )
        (folder / "manifest.csv").write_text("frame,orientation,size_mrad,contrast\nframe.exr,up,5.0,0.25\n")
        return score_dataset(load_dataset(folder), frame_observer())


def frame_cases() -> list[Case]:
    """List the cases of frames in files, from the EXR to P(correct)."""
    case = partial(Case, "frame")
    law = MPMATH + "pixel by pixel; contrast has no unit"

    def right(
        values: FloatArray, pixel_type: PixelType = "float", *, background: float | str, white: float = 1.0
    ) -> float:
        # Under Gaussian noise, as the expected number is.
        found = scored(values, pixel_type, background=background, white=white)
        readout = frame_observer().readout(Stimulus(5.0))
        assert readout is not None
        covariance = readout.noise_covariance
        return float(answer_probabilities(found.scores[0], covariance)[Orientation.UP.quarter_turns])

    one_pixel = np.zeros((SIDE_PX, SIDE_PX))
    one_pixel[29, 32] = 1.0  # in the upright triangle's apex
    return [
        case("float EXR, background 1e-6 to 1e6 cd/m²: P(correct)", [P_OF_PATTERN] * 7, law,
             lambda: [right(frame(float(b)), background=float(b)) for b in DECADES]),
        case("half EXR, background 2⁻²⁰ to 2¹⁵ cd/m²: P(correct)", [P_OF_PATTERN] * 8, law,
             lambda: [right(frame(2.0**n), "half", background=2.0**n) for n in range(-20, 16, 5)], 12),
        case("half EXR, code value 1 at 1e-6 to 1e6 cd/m²: P(correct)", [P_OF_PATTERN] * 7, law,
             lambda: [right(frame(1.0), "half", background=float(b), white=float(b)) for b in DECADES], 12),
        case("half EXR of 1e6 cd/m² as they are", "refused", "half floats end at 65504",
             lambda: refusal(lambda: right(frame(1e6), "half", background=1e6), "beyond ±65504")),
        case("one pixel of 3.4e38 in the apex, background 1e-6: P(correct)", 1.0,
             "the answer whose template is largest there",
             lambda: right(frame(1e-6) + LARGEST_FLOAT * one_pixel, background=1e-6), 15),
        case(
            "all pixels 3.4e38, background 1e-6, border and frame_mean: P(correct)",
            [0.25] * 3,
            "symmetry",
            lambda: [
                right(frame(LARGEST_FLOAT, contrast=0.0), background=b) for b in (1e-6, "border", "frame_mean")
            ],
            9,
        ),
        case("white of 1e300 cd/m²", "refused", "at most 1e12",
             lambda: refusal(lambda: right(one_pixel, background=1.0, white=1e300), "white_luminance_cd_m2")),
        case("negative luminance, a checkerboard of ±4 backgrounds: P(correct)", P_OF_PATTERN, law,
             lambda: right(frame(50.0, contrast=CONTRAST * PATTERN + CHECKERBOARD), "half", background=50.0), 12),
        case(
            "negative luminance, that checkerboard, background border: pixels counted",
            2112.0,
            "(65² − 1) / 2",
            lambda: float(
                scored(
                    frame(50.0, contrast=CONTRAST * PATTERN + CHECKERBOARD), "half", background="border"
                ).n_negative
            ),
            15,
        ),
    ]  # fmt: skip
