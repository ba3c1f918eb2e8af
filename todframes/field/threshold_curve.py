"""Threshold curves of a sensor over spatial frequency: TOD, MRTD or MRC, with their errors; and tables of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.base.reading import check_columns, read_table
from todframes.field.target import Quantity
from todframes.psychometrics.bootstrap import NORMAL_95
from todframes.psychometrics.curves import weibull_level

Pattern = Literal["triangle", "bars"]

CYC_PER_MRAD_IN_CYC_PER_DEG = 0.18 / np.pi
"""Cycles/mrad in one cycle/deg: a degree is π / 0.18 mrad."""

LARGEST_PER_MRAD = 1000.0
"""Largest frequency or inverse size accepted, in mrad⁻¹; larger ones are a mistake in the input, such as rad⁻¹."""

LEAST_PER_MRAD = 0.01
"""Least value of the highest frequency or inverse size of a curve: no camera shows 100 mrad at best. A smaller
one is a mistake in the input, such as cycles/rad."""

UNREACHED = 500.0
"""ln(contrast / threshold) of what no contrast reaches: its exponential is finite, and its square too."""

LOWEST: dict[Quantity, tuple[float, float, str, str, str]] = {
    "delta_t_k": (1e-4, 10.0, " K", "are they in K, not mK?", "are they in mK?"),
    "contrast": (1e-6, 10.0, "", "are they in thousandths?", "are they in %?"),
}
"""Least and largest value of the lowest threshold of a curve, their unit, and the mistake beyond either."""

FREQUENCIES: dict[str, tuple[Pattern, float]] = {
    "frequency_cyc_per_mrad": ("bars", 1.0),
    "frequency_cyc_per_deg": ("bars", CYC_PER_MRAD_IN_CYC_PER_DEG),
    "size_mrad": ("triangle", 1.0),
}
"""Columns of a table that say where a threshold is: the pattern, and the factor to mrad."""

THRESHOLDS: dict[str, tuple[Quantity, float]] = {
    "mrtd_k": ("delta_t_k", 1.0),
    "mrtd_mk": ("delta_t_k", 1e-3),
    "delta_t_k": ("delta_t_k", 1.0),
    "delta_t_mk": ("delta_t_k", 1e-3),
    "mrc": ("contrast", 1.0),
    "contrast": ("contrast", 1.0),
}
"""Columns of a table that hold thresholds: the quantity, and the factor to K or Weber contrast."""


class Psychometric(NamedTuple):
    """Weibull functions of contrast / threshold at the points of a TOD (Hogervorst et al. 2001, eq. 3).

    All but `guess_rate` and `p_correct`, that of the thresholds, have a value a point, shape (n,). `ln_beta_sd` is
    the standard deviation of ln β, and `correlation` that of the errors of ln β and ln(threshold).
    """

    beta: FloatArray
    lapse_rate: FloatArray
    ln_beta_sd: FloatArray
    correlation: FloatArray
    guess_rate: float
    p_correct: float

    def betas(self, drawn: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw β with errors that go with those of ln(threshold), in standard deviations, shape (draws, n)."""
        apart = np.sqrt(1.0 - self.correlation**2) * rng.standard_normal(drawn.shape)
        return np.asarray(self.beta * np.exp(self.ln_beta_sd * (self.correlation * drawn + apart)))

    def ln_ratio(self, p_correct: float, beta: FloatArray) -> FloatArray:
        """Compute ln(contrast / threshold) at a proportion correct for β of shape (..., n).

        It is `UNREACHED` from the ceiling on.
        """
        asked, known = (self._halves(p, self.lapse_rate) for p in (p_correct, self.p_correct))
        with np.errstate(divide="ignore"):
            return np.minimum(np.log(asked / known) / beta, UNREACHED)

    def _halves(self, p_correct: float, lapse_rate: FloatArray) -> FloatArray:
        """Return (x/α)^β at a proportion correct: 0 at the guess rate, infinity from the ceiling on."""
        return weibull_level(p_correct, alpha=1.0, beta=1.0, guess_rate=self.guess_rate, lapse_rate=lapse_rate)

    def probability(self, ln_ratio: FloatArray, beta: FloatArray, weights: FloatArray) -> FloatArray:
        """Compute the proportion correct at ln(contrast / threshold), shape (..., m), for β of shape (..., n).

        `weights`, shape (n, m), are those of the n points at each of the m places between them.
        """
        slope, lapse = np.exp(np.log(beta) @ weights), self.lapse_rate @ weights
        halves = self._halves(self.p_correct, lapse)
        with np.errstate(over="ignore"):
            exponent = halves * np.exp(np.minimum(slope * ln_ratio, UNREACHED))
        return np.asarray((1.0 - lapse) - (1.0 - lapse - self.guess_rate) * np.exp2(-exponent))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThresholdCurve:
    """Thresholds over spatial frequency; between points ln(threshold) is linear in frequency.

    The pattern is a triangle for a TOD, or bars for MRTD and MRC. Thresholds, shape (n,), are ΔT in K, or Weber
    contrast (MRC: modulation); `per_mrad`, shape (n,), are rising frequencies in cycles/mrad, or 1 / √area in
    mrad⁻¹. `ln_sd`, shape (2, n), are the standard deviations of ln(threshold) below and above it; None if not
    known. `p_correct` is that of a TOD's thresholds. `unreached_per_mrad` is the first frequency above those of
    the curve at which no contrast suffices, if one was found. DataError for a curve that no camera has.
    """

    pattern: Pattern
    quantity: Quantity
    per_mrad: FloatArray
    threshold: FloatArray
    ln_sd: FloatArray | None = None
    psychometric: Psychometric | None = None
    p_correct: float | None = None
    unreached_per_mrad: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        n = self.per_mrad.size
        if n < 2:
            raise DataError(f"{self.name}: found thresholds at {n} sizes or frequencies, expected two or more")
        if not (np.diff(self.per_mrad) > 0.0).all() or not self.per_mrad[0] > 0.0:
            raise DataError(f"{self.name}: found a size or frequency twice, expected each once and above 0")
        article, name = ("a", "frequency") if self.pattern == "bars" else ("an", "inverse size")
        highest = self.per_mrad[-1]
        if highest > LARGEST_PER_MRAD:
            raise DataError(
                f"{self.name}: found {article} {name} of {highest:g} per mrad, expected at most "
                f"{LARGEST_PER_MRAD:g}; are the angles in rad?"
            )
        if highest < LEAST_PER_MRAD:
            raise DataError(
                f"{self.name}: found {highest:g} per mrad as the highest {name}, expected at least "
                f"{LEAST_PER_MRAD:g}; are the angles in µrad, or the frequencies in cycles/rad?"
            )
        least, most, unit, too_small, too_large = LOWEST[self.quantity]
        lowest = float(self.threshold.min())
        if not least <= lowest <= most:
            problem = (
                f"least {least:g}{unit}; {too_small}" if lowest < least else f"most {most:g}{unit}; {too_large}"
            )
            raise DataError(f"{self.name}: found {lowest:g}{unit} as the lowest threshold, expected at {problem}")

    @classmethod
    def of_sizes(
        cls, size_mrad: FloatArray, threshold: FloatArray, *, unreached_mrad: Iterable[float] = (), **others: Any
    ) -> ThresholdCurve:
        """Return a TOD from thresholds over sizes in the field, which descend; `others` are further attributes.

        `unreached_mrad` are the sizes at which no contrast sufficed; only those below all other sizes count.
        """
        per_mrad = 1.0 / size_mrad
        finer = [one for one in (1.0 / size for size in unreached_mrad) if one > max(per_mrad, default=0.0)]
        unreached = min(finer, default=None)
        return cls(
            pattern="triangle", per_mrad=per_mrad, threshold=threshold, unreached_per_mrad=unreached, **others
        )

    @property
    def is_rising(self) -> bool:
        """Whether no threshold is below that at a lower frequency."""
        return bool((np.diff(self.threshold) >= 0.0).all())

    def as_bars(self, cycles_per_size: float) -> ThresholdCurve:
        """Return a TOD as the curve of bars that are as hard: f = cycles_per_size / √area, the same thresholds."""
        unreached = self.unreached_per_mrad
        return replace(
            self,
            pattern="bars",
            per_mrad=self.per_mrad * cycles_per_size,
            psychometric=None,
            p_correct=None,
            unreached_per_mrad=None if unreached is None else unreached * cycles_per_size,
        )


def ln_sd_of_interval(threshold: ArrayLike, low: ArrayLike, high: ArrayLike) -> FloatArray:
    """Return the standard deviations of ln(threshold) below and above, shape (2, n), from 95 % intervals.

    An end that is NaN is open: its side has the error of the other side.
    """
    value = np.log(np.asarray(threshold, dtype=np.float64))
    ends = np.stack([value - np.log(low), np.log(high) - value]) / NORMAL_95
    return np.maximum(np.where(np.isnan(ends), ends[::-1], ends), 0.0)


def read_curve(path: Path) -> ThresholdCurve:
    """Return the curve in a CSV table with units in its header.

    The columns are one of `FREQUENCIES` and one of `THRESHOLDS`; `ci95_low` and `ci95_high`, in the unit of the
    thresholds, are their 95 % intervals. DataError if a column is missing, or a value is not a number > 0.
    """
    header, rows = read_table(path)
    frequency, level = (_one_column(header, known, path) for known in (FREQUENCIES, THRESHOLDS))
    pattern, to_per_mrad = FREQUENCIES[frequency]
    quantity, factor = THRESHOLDS[level]
    ends = ["ci95_low", "ci95_high"] if {"ci95_low", "ci95_high"} & set(header) else []
    check_columns(header, ends, path)
    values = np.array([row.numbers((frequency, level, *ends), positive=True) for row in rows])
    values = values.reshape(-1, 2 + len(ends))
    per_mrad = to_per_mrad / values[:, 0] if pattern == "triangle" else to_per_mrad * values[:, 0]
    order = np.argsort(per_mrad, kind="stable")
    values, per_mrad = values[order], per_mrad[order]
    for threshold, low, high in values[:, 1:] if ends else ():
        if not low <= threshold <= high:
            raise DataError(f"{path}: found the interval {low:g} to {high:g}, expected it to hold {threshold:g}")
    return ThresholdCurve(
        pattern=pattern,
        quantity=quantity,
        per_mrad=per_mrad,
        threshold=factor * values[:, 1],
        ln_sd=ln_sd_of_interval(*values[:, 1:].T) if ends else None,
        name=str(path),
    )


def _one_column(header: Sequence[str], known: Iterable[str], path: Path) -> str:
    names = [name for name in header if name in known]
    if len(names) != 1:
        listed = ", ".join(header) or "none"
        raise DataError(
            f"{path}: found {len(names)} of the columns {', '.join(known)}, expected one; the columns are {listed}"
        )
    return names[0]
