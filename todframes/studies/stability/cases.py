"""The stability cases of todframes: for each kind of computation the stiffest few.

Numbers from mpmath were computed with 50 digits; test_stability_references.py does it again. For `observer`
a retina sample is 1 mrad wide, and the triangle lies in the middle of one.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.user_code import registered
from todframes.frames.dataset import load_dataset
from todframes.frames.files import PixelType, write_frame
from todframes.observers.csf import CsfObserver
from todframes.observers.decision import answer_probabilities
from todframes.observers.hotelling import HotellingObserver, HotellingSettings
from todframes.observers.interface import Observer, Readout
from todframes.observers.oriented import OrientedObserver, OrientedSettings
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.psychometrics.curves import weibull, weibull_level
from todframes.psychometrics.fit import FitSettings, fit_counts, fit_trials
from todframes.results.data import Record
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.scoring.naked_eye import proportion_correct
from todframes.scoring.score import score_dataset
from todframes.stimulus import Orientation, Stimulus, coverage

ENTRY_POINT_GROUP = "todframes.stability_cases"

MPMATH = "mpmath, 50 digits: "
"""First word of the source of numbers that test_stability_references.py computes again."""

MOST_CPU_S = 12.0
"""CPU time within which a case must end, three times what the longest takes."""


class Stability(Result, frozen=True, kw_only=True):
    """The cases of `stability` as they stand in its JSON."""

    cases: tuple[Record, ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme input and the numbers that it must give, each to so many digits; a 0 must be exact."""

    group: str
    name: str
    expected: ArrayLike
    source: str
    compute: Callable[[], ArrayLike]
    digits: float = 6.0


def find_cases() -> list[Case]:
    """List the cases of all installed packages, those of todframes first."""
    entries = sorted(registered(ENTRY_POINT_GROUP).values(), key=lambda entry: entry.name != "todframes")
    return [case for entry in entries for case in entry.load()()]


def run_case(case: Case) -> Record:
    """Compute a case: the record of the JSON object. A warning, an exception or too much CPU time makes it fall
    short; it comes as text, without digits.
    """
    started, digits = time.process_time(), None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            computed = case.compute()
    except Exception as error:
        computed = f"{type(error).__name__}: {' '.join(str(error).split())}"
    else:
        if (cpu_s := time.process_time() - started) > MOST_CPU_S:
            computed = f"{cpu_s:.0f} s of CPU time, expected at most {MOST_CPU_S:g}"
        else:
            digits = digits_kept(case.expected, computed)
    return {
        "group": case.group,
        "name": case.name,
        "expected": np.asarray(case.expected).tolist(),
        "source": case.source,
        "came": np.asarray(computed).tolist(),
        "digits": digits,
        "digits_bound": case.digits,
        "holds": digits is not None and digits >= case.digits,
    }


def digits_kept(expected: ArrayLike, computed: ArrayLike) -> float:
    """Count the decimal digits that the worst of some numbers has right, 0 to the 16 of double precision."""
    right, found = np.asarray(expected, dtype=np.float64), np.asarray(computed, dtype=np.float64)
    if right.shape != found.shape or not np.isfinite(found).all():
        return 0.0
    error = np.abs(found - right)
    # 0 is right exactly or not at all.
    relative = np.divide(error, np.abs(right), out=np.where(error > 0, 1.0, 0.0), where=right != 0)
    return float(np.clip(-np.log10(max(float(relative.max()), 1e-300)), 0.0, 16.0))


def shortfall(outcomes: Iterable[Record]) -> str | None:
    """Name the cases that fall short in one line; None if there are none."""
    short = []
    for one in outcomes:
        if not one["holds"]:
            found = one["came"] if one["digits"] is None else f"{one['digits']:.1f} digits"
            short.append(f"{one['group']}: {one['name']} (found {found}, expected {one['digits_bound']:g} digits)")
    if not short:
        return None
    return f"stability: {len(short)} {'cases fall' if len(short) > 1 else 'case falls'} short: {'; '.join(short)}"


def shown(value: ArrayLike, digits_bound: float) -> str:
    """Format a text, a number, or the first and last of several numbers, without digits beyond those required."""
    if isinstance(value, str):
        return value
    numbers, digits = np.asarray(value, dtype=np.float64).ravel(), min(math.floor(digits_bound), 6)
    ends = [f"{number:.{digits}g}" for number in numbers[[0, -1]]]
    return ends[0] if numbers.size == 1 else f"{ends[0]} … {ends[1]} ({numbers.size})"


def outcome_table(outcomes: Iterable[Record], *, has_group: bool = True) -> Table:
    """Make the table of cases and their results."""
    columns = [
        Column(key="group", is_name=True, wraps=True, in_file_only=not has_group),
        Column(key="case", wraps=True),
        Column(key="expected", wraps=True),
        Column(key="source", wraps=True, rank=2),
        Column(key="computed", wraps=True),
        Column(key="digits"),
        Column(key="required"),
    ]
    rows = [
        {
            "group": one["group"],
            "case": one["name"],
            "expected": shown(one["expected"], one["digits_bound"]),
            "source": one["source"],
            "computed": shown(one["came"], one["digits_bound"]),
            "digits": None if one["digits"] is None else f"{one['digits']:.1f}",
            "required": f"{one['digits_bound']:g}",
        }
        for one in outcomes
    ]
    return Table.of("Extreme inputs", "stability.csv", columns, rows)


def markdown(outcomes: Iterable[Record]) -> str:
    """Write the tables as a page, a section for each group."""
    lines = ["# Stability in the extremes", ""]
    for group, members in groupby(outcomes, lambda one: one["group"]):
        lines += [f"## {group.capitalize()}", "", outcome_table(members, has_group=False).markdown(), ""]
    return "\n".join(lines)


EXTREMES = 10.0 ** np.arange(-9.0, 10.0, 3.0)
"""Signal-to-noise ratios and contrasts."""

# Decision

TRIANGLES = np.array([np.roll([1.0, math.sqrt(3.0) - 1.0, 2.0 / 3.0, math.sqrt(3.0) - 1.0], k) for k in range(4)])
"""Overlaps of the four triangles themselves, centred on their centroids."""

HIGH_SNRS, NOISE_SDS = np.array([5.0, 15.0, 25.0, 31.0]), np.array([1e-150, 1e-9, 1e9, 1e150])
EVEN_PARTS = (1e-3, 1e-6, 1e-12)
LINE = np.array([[-1.0], [-2.0], [0.0], [3.0]])

OBTUSE = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 0.0], [6.0, 0.0, 1.0], [5.0, -2.0, 1.0]])
"""Answer 1 lies between the others: its differences from two of them are negatively correlated."""

OBTUSE_SNRS = np.array([2.0, 6.0, 12.5])

ALIKE = 1.0 + 2e-6 * np.eye(4)
"""Any two have the correlation 1 − 1e-12: (4 + 4e-6) / (4 + 4e-6 + 4e-12)."""

HIGH_D_PRIMES = np.array([5.0, 10.0, 16.2])


def pairs(even: float) -> FloatArray:
    """Return templates of a tiny triangle: up and down, right and left are opposite except for the part `even`."""
    odd = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return odd + even * np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])


def right(score: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Compute the probability of answer 0."""
    return np.asarray(answer_probabilities(score, covariance)[..., 0])


def wrong(score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None) -> FloatArray:
    """Compute the probability of the other answers, with the digits that 1 less answer 0 would lose."""
    return np.asarray(answer_probabilities(score, covariance, factor=factor)[..., 1:].sum(axis=-1))


# Observer

COVARIANCES = {
    0.58: (3.444974047874514e-13, -3.32870289459945e-14, -2.779233468954624e-13),
    50.0: (0.4028133923154534, -0.1266542638678868, -0.14950486457967974),
}
"""Covariances by size: of the upright triangle's score with itself, one beside and the opposite one."""

ERRORS = {
    0.58: ((7.3e4, 1.18e5), (1.6319559457210677e-12, 3.453645005888211e-30)),
    50.0: ((0.21, 0.344), (2.7630937286988332e-12, 1.3441585054562313e-30)),
}
"""Contrasts and P(error), by size."""


def observer(**settings: Any) -> PyramidObserver:
    """Make the default observer but for these settings, on a retina of samples of 1 mrad that keeps its place."""
    return PyramidObserver(**{"retina_pitch_mrad": 1.0, "position_jitter_samples": 0.0} | settings)


def seen(observer: PyramidObserver, size: float) -> tuple[Readout, FloatArray]:
    """Return the readout for triangles of a size in samples, and the upright one's image."""
    readout = observer.linear_readout(Stimulus(size))
    return readout, triangle_on(readout.grid, size, centre=observer.centre)


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


def template_scores(size: float, levels: int) -> FloatArray:
    """Compute the scores that the upright triangle's own template causes, over those of the noise covariance."""
    readout, image = seen(observer(template_blur_samples=0.0, internal_noise_sd=1.0, levels=levels), size)
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

RISING = (8, 9, 12, 20, 25, 29, 30)
"""Right answers of 30 trials at each level."""

SINGLE = (0, 0, 1, 0, 0, 1, 1, 0, 1, 1, 1, 1)
PROPORTIONS = (0.3, 0.4, 0.5, 0.6, 0.75, 0.85, 0.9, 0.94)
SLOPES = (1e-2, 1e3)


def threshold(n_correct: ArrayLike, n_trials: int = 30, level: ArrayLike = LEVELS) -> float:
    """Return the threshold of counts, NaN unless it lies within the levels."""
    settings, n = FitSettings(resamples=0), np.full(np.shape(level), n_trials)
    fitted = fit_counts(level, n_correct, n, settings=settings, rng=np.random.default_rng(1))
    return fitted.threshold if fitted.status == "ok" and fitted.threshold is not None else math.nan


def of_curve(level: ArrayLike, **curve: float) -> list[float]:
    """Fit the probabilities of a curve themselves: threshold and δ."""
    p, settings = weibull(level, guess_rate=0.25, **curve), FitSettings(resamples=0)
    fitted = fit_trials(level, p, settings=settings, rng=np.random.default_rng(1))
    return [fitted.threshold or math.nan, fitted.lapse_rate or 0.0]


def of_slope(beta: float) -> float:
    """Fit the probabilities of a curve of a slope: the threshold found over its own."""
    curve = {"alpha": 3.0, "beta": beta, "lapse_rate": 0.0}
    fitted = of_curve(weibull_level(PROPORTIONS, guess_rate=0.25, **curve), **curve)[0]
    return fitted / float(weibull_level(0.75, guess_rate=0.25, **curve))


# Frames in files, from the EXR to P(correct)

SIDE_PX, CONTRAST, P_OF_PATTERN = 65, 0.25, 0.9312557277131851

PATTERN = np.rint(coverage((SIDE_PX,) * 2, size_px=5.0, x_px=32, y_px=32, orientation=Orientation.UP))
"""A triangle of whole pixels, each of them a retina sample, which half floats hold exactly."""

CHECKERBOARD = 4.0 * (-1.0) ** np.add.outer(np.arange(SIDE_PX), np.arange(SIDE_PX))
"""Noise that looks the same to all four orientations."""


def read(background: float, pixel_type: PixelType = "float", noise: FloatArray | float = 0.0) -> float:
    """Compute P(correct) of a frame with an upright triangle, written to an EXR and scored from there, under
    Gaussian noise, as the expected number is.
    """
    luminance = background * (1.0 + CONTRAST * PATTERN + noise)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_frame(folder / "frame.exr", luminance, pixel_type=pixel_type)
        (folder / "dataset.toml").write_text(
            'schema = 1\n[display]\neotf = "linear"\nwhite_luminance_cd_m2 = 1.0\npixel_pitch_mrad = 1.0\n'
            f'background_luminance_cd_m2 = {background!r}\n[experiment]\nlevel = "contrast"\n'
        )
        (folder / "manifest.csv").write_text("frame,orientation,size_mrad,contrast\nframe.exr,up,5.0,0.25\n")
        scores = score_dataset(load_dataset(folder), observer()).scores[0]
    covariance = observer().linear_readout(Stimulus(5.0)).noise_covariance
    return float(answer_probabilities(scores, covariance)[Orientation.UP.quarter_turns])


SHARP, OF_SAMPLES = OrientedSettings(), HotellingSettings(presample_blur_mrad=0.5, sample_pitch_mrad=1.0)
PLACKETT, LITERAL = MPMATH + "orthants by Plackett's identity", MPMATH + "pixel by pixel"
LIKELIHOOD, IN_PROPORTION = MPMATH + "root of the likelihood's derivatives", "law: contrast over noise decides"
NOISE = "internal noise 1e-9 and 1e9, contrast in proportion: P(correct), ratio"

ROWS: dict[str, list[tuple[Any, ...]]] = {
    "decision": [
        ("four triangles, SNR 1e-9 to 1e9: P(correct)",
         [0.2500000001380203, 0.25000013802033644, 0.2501380400549598, 0.40449964244458675, 1.0, 1.0, 1.0],
         PLACKETT, lambda: right(np.multiply.outer(EXTREMES, TRIANGLES[0]), TRIANGLES), 9),
        ("four triangles, SNR 5 to 31: P(error) to 1e-30",
         [0.07330579875767375, 4.055292575223019e-08, 5.660073880337489e-20, 7.693775917894176e-30],
         PLACKETT, lambda: wrong(np.multiply.outer(HIGH_SNRS, TRIANGLES[0]), TRIANGLES)),
        ("noise SD 1e-150 to 1e150, SNR 3: P(correct)", [0.7301635803834369] * 4, PLACKETT,
         lambda: [float(right(3.0 * sd * TRIANGLES[0], sd**2 * TRIANGLES)) for sd in NOISE_SDS], 9),
        ("opposite pairs but for 1e-3 to 1e-12 of them, SNR 16.1: P(error)",
         [4.999374840440415e-30, 5.000027751434586e-30, 5.000027752087541e-30], PLACKETT,
         lambda: [float(wrong(16.1 * pairs(even) @ pairs(even)[0], factor=pairs(even))) for even in EVEN_PARTS]),
        ("templates on a line (rank 1): P(error) at 1e-30",
         sum(math.erfc(lead / math.sqrt(2.0)) / 2.0 for lead in (11.4, 12.0)),
         "closed form: normal probabilities of intervals",
         lambda: float(wrong([0.0, -11.4, -12.0, -50.0], LINE @ LINE.T))),
        ("negatively correlated differences: P(error) to 1e-30",
         [0.04717755001633491, 2.426531172407078e-08, 1.845132359098363e-30], PLACKETT,
         lambda: wrong(np.multiply.outer(OBTUSE_SNRS, -OBTUSE[:, 0]), OBTUSE @ OBTUSE.T)),
        ("templates 1 − 1e-12 alike: P(error) to 1e-30",
         [0.0005927685870461995, 2.3061133514624445e-12, 3.324462858005453e-30],
         MPMATH + "∫ φ(z − d′) Φ(z)³ dz",
         lambda: wrong(2e-6 * np.multiply.outer(HIGH_D_PRIMES, np.eye(4)[0]), factor=ALIKE)),
        ("scores of ±1e308: all four", [1.0, 0.0, 0.0, 0.0], "the largest wins",
         lambda: answer_probabilities([1e308, -1e308, 0.0, 0.0], TRIANGLES), 15),
    ],
    "observer": [
        ("0.01 retina samples, contrast 1e-9 to 1e9: P(correct)", [0.25] * 7, "four identical templates",
         lambda: naked_eye(observer(position_jitter_samples=0.5), EXTREMES, 0.01), 15),
        *((f"{size:g} retina samples: noise covariance", expected, LITERAL, partial(covariance_row, size), 9)
          for size, expected in COVARIANCES.items()),
        *((f"{size:g} retina samples, contrast {low:g} and {high:g}: P(error) to 1e-30", expected, LITERAL,
           partial(errors, (low, high), size)) for size, ((low, high), expected) in ERRORS.items()),
        ("2,000 retina samples, levels = 10: scores of its own template", [1.0] * 4,
         "law: ⟨Lᵀt_j, c_k⟩ = ⟨t_j, t_k⟩", lambda: template_scores(2000.0, 10), 9),
        ("internal noise 1e-12 and 1e12, contrast in proportion: P(correct)", [0.9436321009239244] * 2, LITERAL,
         lambda: [float(probabilities(0.1 * n, 20.0, internal_noise=0.5 * n)[0]) for n in (1e-12, 1e12)], 9),
    ],
    "fit": [
        ("one trial a level: threshold", 1.523470047599754, LIKELIHOOD,
         lambda: threshold(SINGLE, 1, SINGLE_LEVELS)),
        ("levels over 12 decades: threshold", 18.774632957162915, LIKELIHOOD,
         lambda: threshold(RISING, level=DECADES)),
        ("slope 1e-2 and 1e3: threshold, ratio", [1.0] * 2, "closed form: x_c of the paper's eq. 3",
         lambda: list(map(of_slope, SLOPES))),
        ("lapse rate four times its bound: threshold and δ", [1.5453118997025495, 0.05], LIKELIHOOD,
         lambda: of_curve(LEVELS, alpha=0.9, beta=3.0, lapse_rate=0.2)),
        ("10⁶ trials a level: threshold", 1.1585031036570017, LIKELIHOOD,
         lambda: threshold(np.array(RISING) * 33_333, 999_990)),
        ("levels about 1e-300 and 1e300: thresholds", [1.1585031036570017] * 2, LIKELIHOOD,
         lambda: [threshold(RISING, level=unit * LEVELS) / unit for unit in (1e-300, 1e300)]),
    ],
    "frame": [
        ("float EXR, background 1e-6 to 1e6 cd/m²: P(correct)", [P_OF_PATTERN] * 7, LITERAL,
         lambda: [read(float(background)) for background in DECADES]),
        ("half EXR, background 2⁻²⁰ to 2¹⁵ cd/m²: P(correct)", [P_OF_PATTERN] * 8, LITERAL,
         lambda: [read(2.0**n, "half") for n in range(-20, 16, 5)], 12),
        ("negative luminance, a checkerboard of ±4 backgrounds: P(correct)", P_OF_PATTERN, LITERAL,
         lambda: read(50.0, "half", CHECKERBOARD), 12),
    ],
    "other observers": [
        ("csf, efficiency 1e-6 and 1e6, contrast ∝ 1/√efficiency: P(correct), ratio", [1.0] * 2,
         "law: d′ is proportional to contrast · √efficiency", of_efficiency, 9),
        (f"oriented, {NOISE}", [1.0] * 2, IN_PROPORTION, partial(of_noise, OrientedObserver, SHARP), 9),
        (f"informative, {NOISE}", [1.0] * 2, IN_PROPORTION, partial(of_noise, HotellingObserver, OF_SAMPLES), 9),
    ],
}  # fmt: skip
"""The cases by group: name, expected, source, compute and digits as in `Case`."""


def cases() -> list[Case]:
    """List all cases of todframes."""
    return [Case(group, *row) for group, rows in ROWS.items() for row in rows]
