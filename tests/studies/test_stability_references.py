"""The numbers that `todframes stability` expects from mpmath, computed again at 50 digits and in other ways.

Orthants by Plackett's identity along a straight line in the correlations (the package goes along angles); the
observer with its triangle clipped pixel by pixel, and blur, pyramid and inner products in fixed-point integers of
240 bits; fits as roots of the likelihood's derivatives; optics as a closed form and a sum of waves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import mpmath
import numpy as np
import pytest
from mpmath import mpf
from numpy.typing import NDArray
from overlaps import clipped

from sensor_sim.studies.stability import BELOW_CUT_OFF
from todframes.studies.stability.cases import (
    CONTRAST,
    COVARIANCES,
    DECADES,
    ERRORS,
    EVEN_PARTS,
    EXTREMES,
    HIGH_D_PRIMES,
    HIGH_SNRS,
    LEVELS,
    MPMATH,
    OBTUSE,
    OBTUSE_SNRS,
    PATTERN,
    RISING,
    SINGLE,
    SINGLE_LEVELS,
    Case,
    digits_kept,
    find_cases,
    pairs,
)

Numbers = Sequence[mpf]
Image = NDArray[Any]

BITS = 240


@pytest.fixture(autouse=True, scope="module")
def _fifty_digits():
    with mpmath.workdps(50):
        yield


def normal(x):
    return mpmath.erfc(-x / mpmath.sqrt(2)) / 2


def orthant(b: Numbers, rho: Numbers) -> mpf:
    """P(three normals of correlations ρ01, ρ02, ρ12 are below b), all correlations growing together from 0."""
    order = [(0, 1, 2), (0, 2, 1), (1, 2, 0)]

    def slope(t):
        correlation = {frozenset(three[:2]): t * full for three, full in zip(order, rho, strict=True)}
        total = mpf(0)
        for (i, j, k), full in zip(order, rho, strict=True):
            ij, ik, jk = (correlation[frozenset(pair)] for pair in ((i, j), (i, k), (j, k)))
            left = 1 - ij**2
            density = mpmath.exp(-(b[i] ** 2 - 2 * ij * b[i] * b[j] + b[j] ** 2) / (2 * left))
            determinant = left - ik**2 - jk**2 + 2 * ij * ik * jk
            distance = b[k] * left - b[i] * (ik - ij * jk) - b[j] * (jk - ij * ik)
            third = normal(distance / mpmath.sqrt(left * determinant))
            total += full * density * third / (2 * mpmath.pi * mpmath.sqrt(left))
        return total

    return normal(b[0]) * normal(b[1]) * normal(b[2]) + mpmath.quad(slope, [0, 1])


def wins(score: Numbers, covariance: Sequence[Numbers], answer: int) -> mpf:
    others = [k for k in range(4) if k != answer]
    c = covariance

    def product(i, j):
        return c[answer][answer] - c[answer][i] - c[answer][j] + c[i][j]

    sd = {k: mpmath.sqrt(product(k, k)) for k in others}
    b = [(score[answer] - score[k]) / sd[k] for k in others]
    return orthant(b, [product(i, j) / (sd[i] * sd[j]) for i, j in ((others[m], others[n]) for m, n in
                                                                    ((0, 1), (0, 2), (1, 2)))])  # fmt: skip


def errors(score: Numbers, covariance: Sequence[Numbers]) -> mpf:
    return sum((wins(score, covariance, k) for k in (1, 2, 3)), mpf(0))


def errors_of_turned(score: Numbers, row: Numbers) -> mpf:
    """The same for templates that are one, turned: the answers beside the right one are equally likely."""
    covariance = [[row[(j - i) % 4] for j in range(4)] for i in range(4)]
    return 2 * wins(score, covariance, 1) + wins(score, covariance, 2)


def exact(rows: NDArray[np.float64]) -> list[list[mpf]]:
    return [[mpf(float(value)) for value in row] for row in rows]


def gram(rows: Sequence[Numbers]) -> list[list[mpf]]:
    return [[mpmath.fdot(a, b) for b in rows] for a in rows]


def of_triangles(snrs: Sequence[float]) -> list[mpf]:
    """P(error) of the four triangles; beyond 100 standard deviations there is none in double precision."""
    row = [mpf(1), mpmath.sqrt(3) - 1, mpf(2) / 3, mpmath.sqrt(3) - 1]
    return [errors_of_turned([mpf(float(snr)) * t for t in row], row) if snr < 100 else mpf(0) for snr in snrs]


def of_pairs() -> list[mpf]:
    rows = [gram(exact(pairs(even)))[0] for even in EVEN_PARTS]
    return [errors_of_turned([mpf(16.1) * value for value in row], row) for row in rows]


def of_obtuse() -> list[mpf]:
    rows = exact(OBTUSE)
    return [errors([-mpf(float(snr)) * row[0] for row in rows], gram(rows)) for snr in OBTUSE_SNRS]


def of_independent(d_primes: Sequence[float]) -> list[mpf]:
    def of_one(d):
        def density(z):
            q = normal(-z)
            return mpmath.npdf(z - d) * q * (3 - 3 * q + q**2)

        return mpmath.quad(density, [-30, 0, d / 2, d, d + 30])

    return [of_one(mpf(float(d))) for d in d_primes]


def fixed(x) -> int:
    return int(mpmath.nint(mpmath.ldexp(x, BITS)))


def triangle(side: int, size) -> Image:
    height, half = mpf(3) ** 0.25 * size, size / mpf(3) ** 0.25
    middle = mpf(side) / 2
    corners = [(middle, -2 * height / 3), (middle + half, height / 3), (middle - half, height / 3)]
    corners = [(x, middle + y) for x, y in corners]
    covered = np.zeros((side, side), dtype=object)
    for row in range(int(corners[0][1]), int(corners[1][1]) + 1):
        strip = clipped(clipped(corners, 1, row, 1), 1, row + 1, -1)
        for column in range(int(min(x for x, _ in strip)), int(max(x for x, _ in strip)) + 1):
            cell = clipped(clipped(strip, 0, column, 1), 0, column + 1, -1)
            ends = cell[1:] + cell[:1]
            area = sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(cell, ends, strict=True)) / 2
            covered[row, column] = fixed(area)
    return covered


def filtered(image: Image, weights: Sequence[int], shift: int) -> Image:
    """Along both axes, mirrored about the outermost samples; weights are over 2^shift."""
    radius = len(weights) // 2
    for axis in (0, 1):
        n = image.shape[axis]
        place = np.abs(np.arange(-radius, n + radius))
        wide = image.take(np.where(place < n, place, 2 * (n - 1) - place), axis)
        parts = [wide.take(np.arange(k, k + n), axis) * weight for k, weight in enumerate(weights)]
        image = np.sum(parts, axis=0) >> shift
    return image


def blurred(image: Image) -> Image:
    weights = [mpmath.exp(-mpf(k * k) / (2 * mpf(1.2) ** 2)) for k in range(-10, 11)]
    return filtered(image, [fixed(weight / sum(weights)) for weight in weights], BITS)


def laplacian(image: Image, levels: int) -> list[Image]:
    bands = []
    for _ in range(levels):
        reduced = filtered(image, (1, 4, 6, 4, 1), 4)[::2, ::2]
        spread = np.zeros(image.shape, dtype=object)
        spread[::2, ::2] = reduced
        bands.append(image - filtered(spread, (1, 4, 6, 4, 1), 3))
        image = reduced
    return bands


def inner(bands: Sequence[Image], template: Sequence[Image], turns: int) -> mpf:
    products = sum((a * np.rot90(b, -turns)).sum() for a, b in zip(bands, template, strict=True))
    return mpmath.ldexp(mpf(int(products)), -2 * BITS)


def deviations(values: Numbers) -> list[mpf]:
    same, beside, opposite = values[:3]
    mean = (same + 2 * beside + opposite) / 4
    return [same - mean, beside - mean, opposite - mean, beside - mean]


@cache
def observed(size: float, levels: int) -> tuple[list[mpf], list[mpf], list[Image]]:
    """Noise covariance of the upright triangle's score, its scores at contrast 1, and its template."""
    image = triangle(4 * 2**levels + 1, mpf(size))
    template, bands = laplacian(blurred(image), levels), laplacian(image, levels)
    covariance = [inner(template, template, k) / 48 for k in range(3)]  # (1/2)² / 12
    return deviations(covariance), deviations([inner(bands, template, k) for k in range(3)]), template


LEVELS_OF = {0.58: 4, 20.0: 5, 50.0: 6}


@cache
def of_contrasts(size: float, contrasts: tuple[float, ...]) -> list[mpf]:
    covariance, scores, _ = observed(size, LEVELS_OF[size])
    found = []
    for contrast in contrasts:
        sure = contrast * scores[0] > 100 * mpmath.sqrt(covariance[0])
        found.append(mpf(0) if sure else errors_of_turned([mpf(contrast) * s for s in scores], covariance))
    return found


@cache
def of_pattern() -> mpf:
    covariance, _, template = observed(5.0, 4)
    image = np.vectorize(lambda value: fixed(mpf(value) * CONTRAST), otypes=[object])(PATTERN)
    bands = laplacian(image, 4)
    return 1 - errors_of_turned(deviations([inner(bands, template, k) for k in range(3)]), covariance)


def likeliest(
    level: Sequence[float], right: Sequence[float], lapse_rate: float, start: tuple[float, float]
) -> mpf:
    """Threshold of the likeliest curve of a lapse rate at a bound; all others within are less likely."""
    x, y, delta = [mpf(float(v)) for v in level], [mpf(float(v)) for v in right], mpf(lapse_rate)
    span = mpf(3) / 4 - delta

    def terms(ln_alpha, ln_beta):
        for xi, yi in zip(x, y, strict=True):
            ratio = mpmath.log(xi) - ln_alpha
            hazard = mpmath.log(2) * mpmath.exp(ratio * mpmath.exp(ln_beta))
            p = 1 - delta - span * mpmath.exp(-hazard)
            yield p, (yi / p - (1 - yi) / (1 - p)), hazard, ratio

    def derivatives(ln_alpha, ln_beta):
        slopes = [(residual * hazard * mpmath.exp(-hazard), ratio)
                  for _, residual, hazard, ratio in terms(ln_alpha, ln_beta)]  # fmt: skip
        return [sum(s for s, _ in slopes), sum(s * ratio for s, ratio in slopes)]

    def loglik(probabilities):
        return sum(
            (yi * mpmath.log(p) if yi else 0) + ((1 - yi) * mpmath.log(1 - p) if yi < 1 else 0)
            for p, yi in zip(probabilities, y, strict=True)
        )

    top = mpmath.findroot(derivatives, tuple(map(mpmath.log, map(mpf, start))))
    towards_lapses = sum(-r * (1 - mpmath.exp(-h)) for _, r, h, _ in terms(*top))
    assert towards_lapses < 0 if lapse_rate == 0 else towards_lapses > 0
    reached = loglik([p for p, *_ in terms(*top)])
    for below in range(1, len(x)):
        step = [mpf("0.25")] * below + [1 - delta] * (len(x) - below)
        assert any(p == 1 and yi < 1 for p, yi in zip(step, y, strict=True)) or loglik(step) < reached
    ratio = mpmath.log(span / (mpf(1) / 4 - delta), 2)
    return mpmath.exp(top[0] + mpmath.log(ratio) / mpmath.exp(top[1]))


def of_rising(level: Sequence[float], start: tuple[float, float]) -> mpf:
    return likeliest(level, [mpf(n) / 30 for n in RISING], 0.0, start)


def of_lapses() -> list[mpf]:
    """Answers of a curve with 20 % lapses, fitted with at most 5 %."""
    right = [mpf("0.8") - mpf("0.55") * 2 ** (-((mpf(float(x)) / mpf("0.9")) ** 3)) for x in LEVELS]
    return [likeliest(LEVELS, right, 0.05, (1.2, 1.5)), mpf("0.05")]


def of_diffraction() -> list[mpf]:
    return [
        2 / mpmath.pi * (mpmath.acos(x) - x * mpmath.sqrt(1 - x**2)) for x in map(mpf, map(float, BELOW_CUT_OFF))
    ]


def of_nine_waves() -> list[mpf]:
    """Samples of a triangle of 3 detectors at (1/4, −1/2); of a period, 200 detectors, 1.5 waves pass."""
    height, period = 3 * mpf(3) ** 0.25, mpf(200)
    total = [mpf(9) / period**2] * 3
    for k_x in (-1, 0, 1):
        for k_y in (-1, 0, 1):
            k = mpmath.hypot(k_x, k_y)
            if k == 0:
                continue
            x = k / mpf("1.5")
            transfer = 2 / mpmath.pi * (mpmath.acos(x) - x * mpmath.sqrt(1 - x**2))
            transfer *= mpmath.sincpi(k_x / period) * mpmath.sincpi(k_y / period)

            def row(depth, k_x=k_x, k_y=k_y):  # the triangle is 2/√3 times as wide as its depth below the apex
                width = 2 * depth / mpmath.sqrt(3)
                return width * mpmath.sincpi(k_x * width / period) * mpmath.expjpi(
                    -2 * k_y * (depth - 2 * height / 3) / period)  # fmt: skip

            wave = transfer * mpmath.quad(row, [0, height]) / period**2
            for n, (i, j) in enumerate(((0, 0), (4, 3), (7, 7))):
                turns = (k_x * (j - mpf("3.75")) + k_y * (i - mpf("3.0"))) / period
                total[n] += mpmath.re(wave * mpmath.expjpi(2 * turns))
    return total


REFERENCES: dict[str, Callable[[], Numbers]] = {
    "four triangles, SNR 1e-9 to 1e9: P(correct)": lambda: [1 - p for p in of_triangles(EXTREMES)],
    "four triangles, SNR 5 to 31: P(error) to 1e-30": lambda: of_triangles(HIGH_SNRS),
    "noise SD 1e-150 to 1e150, SNR 3: P(correct)": lambda: [1 - of_triangles([3.0])[0]] * 4,
    "opposite pairs but for 1e-3 to 1e-12 of them, SNR 16.1: P(error)": of_pairs,
    "negatively correlated differences: P(error) to 1e-30": of_obtuse,
    "templates 1 − 1e-12 alike: P(error) to 1e-30": lambda: of_independent(HIGH_D_PRIMES),
    **{
        f"{size:g} retina samples: noise covariance": lambda size=size: observed(size, LEVELS_OF[size])[0][:3]
        for size in COVARIANCES
    },
    **{
        f"{size:g} retina samples, contrast {low:g} and {high:g}: P(error) to 1e-30": (
            lambda size=size, contrasts=(low, high): of_contrasts(size, contrasts)
        )
        for size, ((low, high), _) in ERRORS.items()
    },
    "internal noise 1e-12 and 1e12, contrast in proportion: P(correct)": lambda: (
        [1 - of_contrasts(20.0, (0.1,))[0]] * 2
    ),
    "one trial a level: threshold": lambda: [likeliest(SINGLE_LEVELS, SINGLE, 0.0, (1.2, 1.5))],
    "levels over 12 decades: threshold": lambda: [of_rising(DECADES, (4.0, 0.3))],
    "lapse rate four times its bound: threshold and δ": of_lapses,
    "10⁶ trials a level: threshold": lambda: [of_rising(LEVELS, (1.0, 3.6))],
    "levels about 1e-300 and 1e300: thresholds": lambda: [of_rising(LEVELS, (1.0, 3.6))] * 2,
    "float EXR, background 1e-6 to 1e6 cd/m²: P(correct)": lambda: [of_pattern()] * 7,
    "half EXR, background 2⁻²⁰ to 2¹⁵ cd/m²: P(correct)": lambda: [of_pattern()] * 8,
    "negative luminance, a checkerboard of ±4 backgrounds: P(correct)": lambda: [of_pattern()],
    "diffraction, half to 1e-3 below the cut-off": of_diffraction,
    "cut-off of 0.015 Nyquist: three samples": of_nine_waves,
}
FROM_MPMATH = {case.name: case for case in find_cases() if case.source.startswith(MPMATH)}


def test_every_number_from_mpmath_has_a_reference() -> None:
    assert FROM_MPMATH.keys() == REFERENCES.keys()


@pytest.mark.slow
@pytest.mark.parametrize("case", FROM_MPMATH.values(), ids=list(FROM_MPMATH))
def test_expected_numbers_are_those_of_mpmath(case: Case) -> None:
    computed = [float(value) for value in REFERENCES[case.name]()]
    # Both are rounded to double precision, 16 digits; what is subtracted to get there is exact.
    assert digits_kept(np.ravel(case.expected), computed) > 15.5
