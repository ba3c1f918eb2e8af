"""The stability cases of todframes: a table, after the functions that it calls.

Numbers from mpmath were computed with 50 digits; test_stability_references.py does it again. For `observer`
a retina sample is 1 mrad wide, and the triangle lies in the middle of one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from todframes.backdrops.views import TURNS, local_luminance, own_orientation, turned, turned_place
from todframes.base._typing import FloatArray
from todframes.field.acquisition import first_range
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.field.threshold_curve import ThresholdCurve
from todframes.frames.dataset import load_dataset
from todframes.frames.files import PixelType, write_frame
from todframes.observers.csf import CsfObserver, CsfSettings
from todframes.observers.decision import answer_probabilities
from todframes.observers.hotelling import HotellingObserver, HotellingSettings
from todframes.observers.interface import Observer, Readout
from todframes.observers.oriented import OrientedObserver, OrientedSettings
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.psychometrics.curves import weibull, weibull_level
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_counts, fit_trials
from todframes.scoring.naked_eye import contrast_threshold, proportion_correct
from todframes.scoring.score import ScoredDataset, score_dataset
from todframes.stimulus import Orientation, Stimulus, coverage
from todframes.studies.stability.case import MPMATH, Case, refusal

EXTREMES = 10.0 ** np.arange(-9.0, 10.0, 3.0)
"""Signal-to-noise ratios and contrasts."""

# Decision


def circulant(beside: float, opposite: float) -> FloatArray:
    """Return the overlaps of four templates of length 1 that are one, turned."""
    return np.array([np.roll([1.0, beside, opposite, beside], turns) for turns in range(4)])


TRIANGLES = circulant(math.sqrt(3.0) - 1.0, 2.0 / 3.0)
"""Overlaps of the four triangles themselves, centred on their centroids."""

HIGH_SNRS, NOISE_SDS = np.array([5.0, 15.0, 25.0, 31.0]), np.array([1e-150, 1e-9, 1e9, 1e150])

LEADS = np.array([1.0, 4.0, 8.0, 11.4])
"""Leads in standard deviations."""

EVEN_PARTS = (1e-3, 1e-6, 1e-12)
LINE = np.array([[-2.0], [-1.0], [0.0], [3.0]])

OBTUSE = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 0.0], [6.0, 0.0, 1.0], [5.0, -2.0, 1.0]])
"""Answer 1 lies between the others: its differences from two of them are negatively correlated."""

OBTUSE_SNRS = np.array([2.0, 6.0, 12.5])

ALIKE = 1.0 + 2e-6 * np.eye(4)
"""Any two have the correlation 1 − 1e-12: (4 + 4e-6) / (4 + 4e-6 + 4e-12)."""

D_PRIMES, HIGH_D_PRIMES = np.array([0.5, 1.0, 1.5, 2.0, 3.0]), np.array([5.0, 10.0, 16.2])


def pairs(even: float) -> FloatArray:
    """Return templates of a tiny triangle: up and down, right and left are opposite except for the part `even`."""
    odd = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return odd + even * np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])


def right(score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None) -> FloatArray:
    """Compute the probability of answer 0."""
    return np.asarray(answer_probabilities(score, covariance, factor=factor)[..., 0])


def wrong(score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None) -> FloatArray:
    """Compute the probability of the other answers, with the digits that 1 less answer 0 would lose."""
    return np.asarray(answer_probabilities(score, covariance, factor=factor)[..., 1:].sum(axis=-1))


def like_template(snr: ArrayLike, factor: FloatArray) -> FloatArray:
    """Return scores of an image that looks like template 0."""
    return np.asarray(np.multiply.outer(snr, factor @ factor[0]))


def with_even_parts(lead: float, probability: Callable[..., FloatArray]) -> list[float]:
    """Compute a probability for opposite pairs but for each of `EVEN_PARTS`."""
    return [float(probability(like_template(lead, pairs(even)), factor=pairs(even))) for even in EVEN_PARTS]


def normal(x: ArrayLike) -> FloatArray:
    """Compute the normal distribution function."""
    return np.array([math.erfc(-value / math.sqrt(2.0)) / 2.0 for value in np.atleast_1d(x)])


# Observer

COVARIANCES = {
    0.58: (3.444974047874514e-13, -3.32870289459945e-14, -2.779233468954624e-13),
    1.0: (1.0335936381047351e-06, -1.933601626949474e-08, -9.949216055657457e-07),
    5.0: (0.002645179309433822, -5.263682805585743e-05, -0.002539905653322107),
    20.0: (0.1238684007605063, -0.03370612141432233, -0.05645615793186163),
    50.0: (0.4028133923154534, -0.1266542638678868, -0.14950486457967974),
}
"""Covariances by size: of the upright triangle's score with itself, one beside and the opposite one."""

ERRORS = {
    0.58: ((7.3e4, 1.6319559457210677e-12), (1.18e5, 3.453645005888211e-30)),
    1.0: ((48.0, 1.840199612746278e-12), (78.0, 2.3544282021943653e-30)),
    5.0: ((1.2, 1.300207283174528e-12), (1.94, 1.8861901197495417e-30)),
    50.0: ((0.21, 2.7630937286988332e-12), (0.344, 1.3441585054562313e-30)),
}
"""Contrasts and P(error), by size."""

P_AT_A_TENTH = 0.9436321009239244
"""P(correct) of 20 samples at contrast 0.1."""


def observer(**settings: Any) -> PyramidObserver:
    """Make the default observer but for these settings, on a retina of samples of 1 mrad that keeps its place."""
    return PyramidObserver(**{"retina_pitch_mrad": 1.0, "position_jitter_samples": 0.0} | settings)


def seen(observer: PyramidObserver, size: float) -> tuple[Readout, FloatArray]:
    """Return the readout for triangles of a size in samples, and the upright one's image."""
    size_mrad = size * observer.settings.retina_pitch_mrad
    readout = observer.linear_readout(Stimulus(size_mrad))
    return readout, triangle_on(readout.grid, size_mrad, centre=observer.centre)


def probabilities(contrast: ArrayLike, size: float, **settings: Any) -> FloatArray:
    """Compute the probabilities of the four answers to the upright triangle, (contrast, 4)."""
    readout, image = seen(observer(**settings), size)
    scores = np.multiply.outer(np.asarray(contrast), readout.score_deviations(image))
    return answer_probabilities(scores, readout.noise_covariance)


def errors(contrast: ArrayLike, size: float) -> FloatArray:
    """Compute the probability of the other three answers, with its own digits."""
    return np.asarray(probabilities(contrast, size)[:, 1:].sum(axis=1))


def covariance_row(size: float) -> FloatArray:
    """Return the covariances of the score of the upright triangle with itself, one beside and the opposite one."""
    return np.asarray(observer().linear_readout(Stimulus(size)).noise_covariance[0, :3])


def template_scores(size: float, **settings: Any) -> FloatArray:
    """Compute the scores that the upright triangle's own template causes, over those of the noise covariance."""
    readout, image = seen(observer(template_blur_samples=0.0, internal_noise_sd=1.0, **settings), size)
    return np.asarray(readout.score_deviations(image) / readout.noise_covariance[0])


def naked_eye(observer: Observer, contrasts: FloatArray | Sequence[float], size_mrad: float = 2.0) -> list[float]:
    """Compute P(correct) of the naked eye at some contrasts."""
    return [proportion_correct(observer, size_mrad=size_mrad, contrast=float(c), nodes=4) for c in contrasts]


def of_noise(kind: Any, settings: Any) -> list[float]:
    """Compute P(correct) with 1e-9 and 1e9 times the internal noise and the contrast, over that with neither."""
    (usual,) = naked_eye(kind(settings), [0.1])
    noisy = [naked_eye(kind(replace(settings, internal_noise=0.5 * n)), [0.1 * n]) for n in (1e-9, 1e9)]
    return [p / usual for (p,) in noisy]


def of_efficiency() -> list[float]:
    """Compute P(correct) at efficiencies of 1e-6 and 1e6 and contrasts ∝ 1/√efficiency, over that at 1."""
    p = [naked_eye(CsfObserver(efficiency=n), [0.05 / math.sqrt(n)])[0] for n in (1e-6, 1e6, 1.0)]
    return [p[0] / p[2], p[1] / p[2]]


# Fits

LEVELS, DECADES, SINGLE_LEVELS = np.geomspace(0.5, 2.0, 7), np.geomspace(1e-6, 1e6, 7), np.geomspace(0.25, 4.0, 12)

RISING, NON_MONOTONE = (8, 9, 12, 20, 25, 29, 30), (8, 14, 9, 20, 18, 29, 27)
"""Right answers of 30 trials at each level."""

SINGLE = (0, 0, 1, 0, 0, 1, 1, 0, 1, 1, 1, 1)
PROPORTIONS = (0.3, 0.4, 0.5, 0.6, 0.75, 0.85, 0.9, 0.94)


def fit(n_correct: ArrayLike, n_trials: Any = 30, level: ArrayLike = LEVELS) -> PsychometricFit:
    """Fit counts, with an interval."""
    n = np.broadcast_to(n_trials, np.shape(level))
    return fit_counts(level, n_correct, n, settings=FitSettings(resamples=200), rng=np.random.default_rng(1))


def threshold(n_correct: ArrayLike, n_trials: Any = 30, level: ArrayLike = LEVELS) -> float:
    """Return a threshold that lies within the levels and its interval; NaN otherwise."""
    fitted = fit(n_correct, n_trials, level)
    if fitted.status != "ok" or fitted.threshold is None or fitted.threshold_ci95 is None:
        return math.nan
    low, high = fitted.threshold_ci95
    holds = (low is None or low <= fitted.threshold) and (high is None or fitted.threshold <= high)
    return fitted.threshold if holds else math.nan


def step(n_correct: Sequence[int], n_trials: int = 30) -> str:
    """Say whether a threshold lies between the third level and the fourth, where the answers change."""
    fitted = fit(n_correct, n_trials)
    low, high = fitted.threshold_ci95 or (None, None)
    if fitted.status != "between_levels" or fitted.threshold is None or low is None or high is None:
        return f"{fitted.status}, {fitted.threshold_ci95}"
    rounding = 1e-12
    spanned = low <= LEVELS[2] * (1.0 + rounding) and high >= LEVELS[3] * (1.0 - rounding)
    return "in the gap, spanned" if LEVELS[2] < fitted.threshold < LEVELS[3] and spanned else str(fitted)


def of_curve(level: ArrayLike, curve: dict[str, float]) -> list[float]:
    """Fit the probabilities of a curve themselves: threshold and δ."""
    p, settings = weibull(level, guess_rate=0.25, **curve), FitSettings(resamples=200)
    fitted = fit_trials(level, p, settings=settings, rng=np.random.default_rng(1))
    return [fitted.threshold or math.nan, fitted.lapse_rate or 0.0]


def case_of_curve(name: str, beta: float, lapse_rate: float = 0.0) -> tuple[Any, ...]:
    """Return the row of a curve whose own threshold is to be found."""
    curve = {"alpha": 3.0, "beta": beta, "lapse_rate": lapse_rate}
    level = weibull_level(PROPORTIONS, guess_rate=0.25, **curve)
    exact = float(weibull_level(0.75, guess_rate=0.25, **curve))
    source = "closed form: x_c of the paper's eq. 3"
    return f"{name}: threshold", exact, source, lambda: of_curve(level, curve)[0]


# Frames in files, from the EXR to P(correct)

SIDE_PX, CONTRAST, P_OF_PATTERN = 65, 0.25, 0.9312557277131851

PATTERN = np.rint(coverage((SIDE_PX,) * 2, size_px=5.0, x_px=32, y_px=32, orientation=Orientation.UP))
"""A triangle of whole pixels, each of them a retina sample, which half floats hold exactly."""

NOISY_PATTERN = CONTRAST * PATTERN + 4.0 * (-1.0) ** np.add.outer(np.arange(SIDE_PX), np.arange(SIDE_PX))
"""With noise that looks the same to all four orientations."""

LARGEST_FLOAT = float(np.finfo(np.float32).max)

APEX = np.zeros((SIDE_PX, SIDE_PX))
"""One pixel, in the upright triangle's apex."""
APEX[29, 32] = 1.0


def frame(background: float, *, contrast: FloatArray | float = CONTRAST * PATTERN) -> FloatArray:
    """Return the luminance of a frame, (65, 65)."""
    return background * (1.0 + np.broadcast_to(contrast, (SIDE_PX, SIDE_PX)))


def scored(
    values: FloatArray, pixel_type: PixelType = "float", *, background: float | str, white: float = 1.0
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
        return score_dataset(load_dataset(folder), observer())


def read(values: FloatArray, pixel_type: PixelType = "float", *, background: Any, white: float = 1.0) -> float:
    """Compute P(correct) of such a frame under Gaussian noise, as the expected number is."""
    scores = scored(values, pixel_type, background=background, white=white).scores[0]
    covariance = observer().linear_readout(Stimulus(5.0)).noise_covariance
    return float(answer_probabilities(scores, covariance)[Orientation.UP.quarter_turns])


# Places, ranges and scenes

SHARP, OF_SAMPLES = OrientedSettings(), HotellingSettings(presample_blur_mrad=0.5, sample_pitch_mrad=1.0)
EXTINCTIONS, SIZE_M, K = (1e-3, 1.0, 100.0), 2.3, 8.0
EVEN_SCENES = {luminance: np.full((64, 64), luminance) for luminance in (1e-12, 1e12)}


def range_km(extinction_per_km: float) -> float:
    """Compute the range of a target of 2 K whose threshold is 0.01 K times e for each 1/mrad."""
    per_mrad = np.array([0.01, 20.0])
    curve = ThresholdCurve(
        pattern="triangle",
        quantity="delta_t_k",
        per_mrad=per_mrad,
        threshold=0.01 * np.exp(per_mrad),
        p_correct=0.75,
    )
    target = Target(size_m=SIZE_M, delta_t_k=2.0, k={"seen": K})
    return first_range(curve, target, Atmosphere(extinction_per_km=extinction_per_km)).range_km or 0.0


def turned_corner() -> list[float]:
    """Look up the last of 4,096 pixels of a line after each turn."""
    line, ends = (np.arange(4096) == 4095).astype(float)[None], []
    for turn in TURNS:
        shown, (x, y) = turned(line, turn), turned_place(2047.5, 0.0, turn)
        rows, columns = shown.shape
        ends.append(float(shown[round(y + (rows - 1) / 2), round(x + (columns - 1) / 2)]))
    return ends


PLACKETT, LITERAL = MPMATH + "orthants by Plackett's identity", MPMATH + "pixel by pixel"
INDEPENDENT, LIKELIHOOD = MPMATH + "∫ φ(z − d′) Φ(z)³ dz", MPMATH + "root of the likelihood's derivatives"
ON_LINE, LARGEST = "closed form: normal probabilities of intervals", "the largest wins"
IDENTICAL, OWN_TEMPLATE = "four identical templates", "law: ⟨Lᵀt_j, c_k⟩ = ⟨t_j, t_k⟩"
FLAT, GAP = "likelihood: no curve beats a flat line", "likelihood: any step in the gap is as likely"
IN_PROPORTION, CONTRAST_LAW = "law: contrast over internal noise decides", LITERAL + "; contrast has no unit"
NOISE = "internal noise 1e-9 and 1e9, contrast in proportion: P(correct), ratio"
TAILS = normal(-LEADS)

ROWS: dict[str, list[tuple[Any, ...]]] = {
    "decision": [
        ("four triangles, SNR 1e-9 to 1e9: P(correct)",
         [0.2500000001380203, 0.25000013802033644, 0.2501380400549598, 0.40449964244458675, 1.0, 1.0, 1.0],
         PLACKETT, lambda: right(np.multiply.outer(EXTREMES, TRIANGLES[0]), TRIANGLES), 9),
        ("four triangles, SNR 1e-9: P(correct) − 1/4", 1.380203167375258e-10, PLACKETT,
         lambda: float(right(1e-9 * TRIANGLES[0], TRIANGLES)) - 0.25, 5),
        ("four triangles, SNR 5 to 31: P(error) to 1e-30",
         [0.07330579875767375, 4.055292575223019e-08, 5.660073880337489e-20, 7.693775917894176e-30],
         PLACKETT, lambda: wrong(np.multiply.outer(HIGH_SNRS, TRIANGLES[0]), TRIANGLES)),
        ("noise SD 1e-150 to 1e150, SNR 3: P(correct)", [0.7301635803834369] * 4, PLACKETT,
         lambda: [float(right(3.0 * sd * TRIANGLES[0], sd**2 * TRIANGLES)) for sd in NOISE_SDS], 9),
        ("two opposite pairs (rank 2): P(error) to 1e-30", TAILS * (2.0 - TAILS), "closed form: 1 − Φ(lead)²",
         lambda: wrong(like_template(math.sqrt(2.0) * LEADS, pairs(0.0)), pairs(0.0) @ pairs(0.0).T)),
        ("opposite pairs but for 1e-3 to 1e-12 of them, SNR 2: P(correct)",
         [0.8488869354973887, 0.8488865530847595, 0.848886553084377], PLACKETT,
         lambda: with_even_parts(2.0, right), 9),
        ("opposite pairs but for 1e-3 to 1e-12 of them, SNR 16.1: P(error)",
         [4.999374840440415e-30, 5.000027751434586e-30, 5.000027752087541e-30], PLACKETT,
         lambda: with_even_parts(16.1, wrong)),
        ("templates on a line (rank 1): all four", np.diff([0.0, *normal([-0.8, 0.1, 1.4 / 3.0]), 1.0]), ON_LINE,
         lambda: answer_probabilities([-0.3, 0.5, 0.4, -1.0], LINE @ LINE.T), 9),
        ("templates on a line (rank 1): P(error) at 1e-30", normal([-11.4, -12.0]).sum(), ON_LINE,
         lambda: float(wrong([0.0, -11.4, -12.0, -50.0], LINE[[1, 0, 2, 3]] @ LINE[[1, 0, 2, 3]].T))),
        ("negatively correlated differences: P(error) to 1e-30",
         [0.04717755001633491, 2.426531172407078e-08, 1.845132359098363e-30], PLACKETT,
         lambda: wrong(np.multiply.outer(OBTUSE_SNRS, -OBTUSE[:, 0]), OBTUSE @ OBTUSE.T)),
        ("templates 1 − 1e-12 alike: P(correct)",
         [0.3933178428150768, 0.5520314384430163, 0.7018627009324003, 0.8227929559932297, 0.9563743715605859],
         INDEPENDENT, lambda: right(2e-6 * np.multiply.outer(D_PRIMES, np.eye(4)[0]), factor=ALIKE), 9),
        ("templates 1 − 1e-12 alike: P(error) to 1e-30",
         [0.0005927685870461995, 2.3061133514624445e-12, 3.324462858005453e-30], INDEPENDENT,
         lambda: wrong(2e-6 * np.multiply.outer(HIGH_D_PRIMES, np.eye(4)[0]), factor=ALIKE)),
        ("four identical templates, variance 0 to 1e300", [0.25] * 4, "symmetry",
         lambda: [float(right(np.ones(4), np.full((4, 4), noise))) for noise in (0.0, 1e-300, 1.0, 1e300)], 15),
        ("no noise, scores 1e-300 apart: all four", [1.0, 0.0, 0.0, 0.0], LARGEST,
         lambda: answer_probabilities([1e-300, 0.0, 0.0, 0.0], np.ones((4, 4))), 15),
        ("scores of ±1e308: all four", [1.0, 0.0, 0.0, 0.0], LARGEST,
         lambda: answer_probabilities([1e308, -1e308, 0.0, 0.0], TRIANGLES), 15),
    ],
    "observer": [
        *((f"{size:g} retina samples, contrast 1e-9 to 1e9: P(correct)", [0.25] * 7, IDENTICAL,
           partial(naked_eye, observer(position_jitter_samples=0.5), EXTREMES, size), 15)
          for size in (0.01, 0.1, 0.5)),  # at 0.5699 the apex reaches the sample's edge
        ("0.5 retina samples: threshold", "never_reached", IDENTICAL,
         lambda: contrast_threshold(observer(), size_mrad=0.5).status),
        *((f"{size:g} retina samples: noise covariance", expected, LITERAL, partial(covariance_row, size), 9)
          for size, expected in COVARIANCES.items()),
        *((f"{size:g} retina samples, contrast {low:g} and {high:g}: P(error) to 1e-30", expected, LITERAL,
           partial(errors, (low, high), size))
          for size, of_size in ERRORS.items() for (low, high), expected in [zip(*of_size, strict=True)]),
        ("20 retina samples, contrast 1e-9 to 1e9: P(correct)",
         [0.2500000073141853, 0.2500073142409198, 0.25736945238061243, 1.0, 1.0, 1.0, 1.0], LITERAL,
         lambda: probabilities(EXTREMES, 20.0)[:, 0], 9),
        *((f"{size:g} retina samples: scores of its own template", [1.0] * 4, OWN_TEMPLATE,
           partial(template_scores, size), 9)
          for size in (0.58, 1.0, 10.0, 100.0, 500.0)),
        ("2,000 retina samples, levels = 10: scores of its own template", [1.0] * 4, OWN_TEMPLATE,
         partial(template_scores, 2000.0, levels=10), 9, None, 12.0),
        ("2,300 retina samples", "refused", "at most 2,276: memory",
         lambda: refusal(lambda: observer().grid(Stimulus(2300.0)), "expected at most 2276")),
        ("internal noise 0, 20 retina samples, contrast 1e-9 to 1e9: P(correct)", [1.0] * 7,
         "no noise: the largest wins", lambda: probabilities(EXTREMES, 20.0, internal_noise=0.0)[:, 0], 15),
        ("internal noise 0, 20 retina samples: threshold", "always_exceeded", "no noise: the largest wins",
         lambda: contrast_threshold(observer(internal_noise=0.0), size_mrad=20.0).status),
        ("internal noise 0, 0.5 retina samples, contrast 1e-9 to 1e9: P(correct)", [0.25] * 7, IDENTICAL,
         lambda: probabilities(EXTREMES, 0.5, internal_noise=0.0)[:, 0], 15),
        ("internal noise 1e-12 and 1e12, contrast in proportion: P(correct)", [P_AT_A_TENTH] * 2, LITERAL,
         lambda: [float(probabilities(0.1 * n, 20.0, internal_noise=0.5 * n)[0]) for n in (1e-12, 1e12)], 9),
        ("retina samples of 1e-6 and 1e6 mrad: P(correct)", [P_AT_A_TENTH] * 2, LITERAL,
         lambda: [float(probabilities(0.1, 20.0, retina_pitch_mrad=p)[0]) for p in (1e-6, 1e6)], 9),
    ],
    "fit": [
        ("all right: status", "always_exceeded", FLAT, lambda: fit([30] * 7).status),
        ("all wrong: status", "never_reached", FLAT, lambda: fit([0] * 7).status),
        ("one trial a level, all right: status", "always_exceeded", FLAT, lambda: fit([1] * 7, 1).status),
        ("one level: status", "too_few_levels", "a curve needs two", lambda: fit([20], level=[1.0]).status),
        ("falling: status", "falling", "answers fall through 75 %", lambda: fit(RISING[::-1]).status),
        ("all or nothing in turns: status", "never_reached", FLAT, lambda: fit([30, 0] * 3 + [30]).status),
        ("levels 1e-15 apart: status", "never_reached", FLAT,
         lambda: fit(RISING, level=1.0 + 1e-15 * np.arange(7)).status),
        ("perfect separation: threshold and interval", "in the gap, spanned", GAP,
         lambda: step([8, 7, 7, 30, 30, 30, 30])),
        ("perfect separation of 10⁶ trials: threshold and interval", "in the gap, spanned", GAP,
         lambda: step([250_000] * 3 + [10**6] * 4, 10**6)),
        ("one trial a level: threshold", 1.523470047599754, LIKELIHOOD,
         lambda: threshold(SINGLE, 1, SINGLE_LEVELS)),
        ("non-monotone: threshold", 1.2879063714797194, LIKELIHOOD, lambda: threshold(NON_MONOTONE)),
        ("levels over 12 decades: threshold", 18.774632957162915, LIKELIHOOD,
         lambda: threshold(RISING, level=DECADES)),
        *(case_of_curve(f"slope {slope:g}", slope) for slope in (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)),
        case_of_curve("lapse rate at its bound", 2.0, 0.05),
        ("lapse rate four times its bound: threshold and δ", [1.5453118997025495, 0.05], LIKELIHOOD,
         lambda: of_curve(LEVELS, {"alpha": 0.9, "beta": 3.0, "lapse_rate": 0.2})),
        ("10⁶ trials a level: threshold", 1.1585031036570017, LIKELIHOOD,
         lambda: threshold(np.array(RISING) * 33_333, 999_990)),
        ("perfect separation of 2⁵³ trials: threshold and interval", "in the gap, spanned", GAP,
         lambda: step([2**51] * 3 + [2**53] * 4, 2**53)),
        ("levels about 1e-300 and 1e300: thresholds", [1.1585031036570017] * 2, LIKELIHOOD,
         lambda: [threshold(RISING, level=unit * LEVELS) / unit for unit in (1e-300, 1e300)]),
    ],
    "frame": [
        ("float EXR, background 1e-6 to 1e6 cd/m²: P(correct)", [P_OF_PATTERN] * 7, CONTRAST_LAW,
         lambda: [read(frame(float(b)), background=float(b)) for b in DECADES]),
        ("half EXR, background 2⁻²⁰ to 2¹⁵ cd/m²: P(correct)", [P_OF_PATTERN] * 8, CONTRAST_LAW,
         lambda: [read(frame(2.0**n), "half", background=2.0**n) for n in range(-20, 16, 5)], 12),
        ("half EXR, code value 1 at 1e-6 to 1e6 cd/m²: P(correct)", [P_OF_PATTERN] * 7, CONTRAST_LAW,
         lambda: [read(frame(1.0), "half", background=float(b), white=float(b)) for b in DECADES], 12),
        ("half EXR of 1e6 cd/m² as they are", "refused", "half floats end at 65504",
         lambda: refusal(lambda: read(frame(1e6), "half", background=1e6), "beyond ±65504")),
        ("one pixel of 3.4e38 in the apex, background 1e-6: P(correct)", 1.0,
         "the answer whose template is largest there",
         lambda: read(frame(1e-6) + LARGEST_FLOAT * APEX, background=1e-6), 15),
        ("all pixels 3.4e38, background 1e-6, border and frame_mean: P(correct)", [0.25] * 3, "symmetry",
         lambda: [read(frame(LARGEST_FLOAT, contrast=0.0), background=b) for b in (1e-6, "border", "frame_mean")],
         9),
        ("white of 1e300 cd/m²", "refused", "at most 1e12",
         lambda: refusal(lambda: read(APEX, background=1.0, white=1e300), "white_luminance_cd_m2")),
        ("negative luminance, a checkerboard of ±4 backgrounds: P(correct)", P_OF_PATTERN, CONTRAST_LAW,
         lambda: read(frame(50.0, contrast=NOISY_PATTERN), "half", background=50.0), 12),
        ("negative luminance, that checkerboard, background border: pixels counted", 2112.0, "(65² − 1) / 2",
         lambda: float(scored(frame(50.0, contrast=NOISY_PATTERN), "half", background="border").n_negative), 15),
    ],
    "csf": [
        ("efficiency 1e-6 and 1e6, contrast ∝ 1/√efficiency: P(correct), ratio", [1.0] * 2,
         "law: d′ is proportional to contrast · √efficiency", of_efficiency, 9),
        ("contrast 1e-9 and 1e9: P(correct)", [0.25, 1.0], "chance, and the largest",
         lambda: naked_eye(CsfObserver(), (1e-9, 1e9)), 6),
        ("0.01 cd/m²", "refused", "people were measured from 0.02 on",
         lambda: refusal(lambda: CsfSettings(luminance_cd_m2=0.01), "luminance_cd_m2: found 0.01")),
    ],
    "oriented": [
        (f"oriented, {NOISE}", [1.0] * 2, IN_PROPORTION, partial(of_noise, OrientedObserver, SHARP), 9),
        ("0.5 retina samples, contrast 1e9: P(correct)", 0.25, IDENTICAL,
         lambda: naked_eye(OrientedObserver(position_jitter_samples=0.0), [1e9], 0.5 * 0.153)[0], 12),
    ],
    "informative": [
        (f"informative, {NOISE}", [1.0] * 2, IN_PROPORTION, partial(of_noise, HotellingObserver, OF_SAMPLES), 9),
    ],
    "range": [
        ("extinction 1e-3 to 100 per km: range",
         [math.log(2.0 / 0.01) / (extinction + K / SIZE_M) for extinction in EXTINCTIONS],
         "closed form: where two straight lines meet", lambda: list(map(range_km, EXTINCTIONS)), 6),
        ("extinction 1e3 per km", "refused", "at most 100: a unit is wrong",
         lambda: refusal(lambda: range_km(1e3), "extinction_per_km: found 1000")),
    ],
    "scenes": [
        ("eight turns of a line of 4,096 pixels: its end", [1.0] * 8, "law: a turn moves each pixel",
         turned_corner, 15),
        ("even scenes of 1e-12 and 1e12 cd/m²: local luminance, ratio", [1.0] * 2, "law: a mean of equals",
         lambda: [local_luminance(image, 31.5, 31.5, 12.0) / n for n, image in EVEN_SCENES.items()], 12),
        ("even scenes of 1e-12 and 1e12 cd/m²: own orientation", [0.0] * 8, "law: it has none",
         lambda: np.ravel([own_orientation(image, 31.5, 31.5, 12.0) for image in EVEN_SCENES.values()]), 12, 1.0),
    ],
}  # fmt: skip
"""The cases by group: name, expected, source, compute, digits, scale and CPU time as in `Case`."""


def cases() -> list[Case]:
    """List all cases of todframes."""
    return [Case(group, *row) for group, rows in ROWS.items() for row in rows]
