"""Psychometric fits: the maximum-likelihood curve, its threshold and the interval of that.

Two curves can be fitted. `observer` is that of a linear observer's own probabilities (`observer_curve`); `weibull`
is the convention for people's answers, Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ − γ)·2^−(x/α)^β.

The threshold is the level at a raw proportion correct, for Weibull's curve x_c = α·log2((1 − δ − γ)/(1 − δ −
c))^(1/β); α itself is not the 75 % point.

The fit maximises Σ p_i ln p(x_i) + (1 − p_i) ln(1 − p(x_i)) over three parameters; β lies in 1e-2 … 1e3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import check_values, number_or_text, read_table
from todframes.parameters import CurveName
from todframes.psychometrics.bootstrap import (
    Observed,
    background_draws,
    by_level,
    crossing_of_points,
    draw_backgrounds,
    interval_of_draws,
    sets_of_backgrounds,
    threshold_interval,
)
from todframes.psychometrics.curves import (
    EXTRAPOLATION_FACTOR,
    GUESS_RATE,
    SLOPE_RANGE,
    SMALLEST_CEILING,
    CurveModel,
    CurveParameters,
    FitPoint,
    ObserverModel,
    WeibullModel,
    binomial_loglik,
)

Status = Literal[
    "ok", "between_levels", "extrapolated", "never_reached", "always_exceeded", "falling", "too_few_levels"
]
HAVE_THRESHOLD: tuple[Status, ...] = ("ok", "between_levels", "extrapolated")
MIN_RESAMPLES, MAX_RESAMPLES = 40, 100_000

COUNT_COLUMNS = ("level", "n_correct", "n_trials")

MOST_COUNTED = 2**53
"""Largest number of trials; above it, not every whole number is a floating-point number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """Parameters of the psychometric function that are fixed, ranges of those that are free, and the criterion.

    Attributes
    ----------
    guess_rate : float
        γ of Weibull's curve: proportion correct without a stimulus.
    lapse_rate : float or None
        δ of Weibull's curve; None: free in [0, lapse_rate_max].
    lapse_rate_max : float
        Largest δ if it is free.
    slope_spread : float or None
        Standard deviation of ln β of the observer's curve about 0 that a fit expects, for levels to which the
        signal is proportional: few noisy trials hardly distinguish a steep curve with a low ceiling from a
        shallow one with a high ceiling. None: no expectation.
    p_correct : float
        Criterion: raw proportion correct at threshold.
    resamples : int
        Number of bootstrap resamples, 0 for no interval; fewer than 40 would not reach into the 2.5 % tails.

    Raises
    ------
    SettingsError
        If a value is out of its range, or the criterion not between guess rate and 1 − lapse rate.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.score("sample_frames/grabbed_8bit", fit=tod.FitSettings(p_correct=0.7))
    >>> result.thresholds[0].p_correct
    0.7
    """

    guess_rate: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.25
    lapse_rate: Annotated[float, Meta(ge=0.0)] | None = None
    lapse_rate_max: Annotated[float, Meta(ge=0.0)] = 0.05
    slope_spread: Annotated[float, Meta(ge=1e-3)] | None = 0.2
    p_correct: float = 0.75
    resamples: Annotated[int, Meta(ge=0, le=MAX_RESAMPLES)] = 2000

    def __post_init__(self) -> None:
        check_values(self)
        most = 1.0 - self.guess_rate
        for name in ("lapse_rate", "lapse_rate_max"):
            if (value := getattr(self, name)) is not None and value >= most:
                raise SettingsError(f"{name}: found {value!r}, expected 0 to below 1 - guess_rate = {most:g}")
        top = 1.0 - (self.lapse_rate or 0.0)
        if not self.guess_rate < self.p_correct < top:
            raise SettingsError(
                f"p_correct: found {self.p_correct!r}, expected strictly between guess_rate = "
                f"{self.guess_rate:g} and 1 - lapse_rate = {top:g}"
            )
        if 0 < self.resamples < MIN_RESAMPLES:
            raise SettingsError(
                f"resamples: found {self.resamples}, expected 0 (no interval) or at least {MIN_RESAMPLES}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class PsychometricFit:
    """A fitted curve and its threshold, the level where the curve passes `p_correct`.

    Attributes are those of `todframes.Fit` with these names. `extrapolated` is a threshold outside of the levels
    by a factor of 2 at most, if the curve at the nearest level is at most half as far from the criterion as its
    floor or ceiling. There is no curve, and `alpha`, `beta`, `lapse_rate` and `observer_curve` are None, with
    fewer than two levels, and if it is no more likely than a flat line at the mean proportion. An end of an
    interval is None if it is infinite or more than a factor of 2 outside the levels. The interval of Weibull's
    curve covers `points_threshold`, too: that curve is a convention, which observers do not follow exactly.
    """

    curve: CurveName
    status: Status = "too_few_levels"
    threshold: float | None = None
    threshold_ci95: tuple[float | None, float | None] | None = None
    p_correct: float
    alpha: float | None = None
    beta: float | None = None
    guess_rate: float
    lapse_rate: float | None = None
    n_trials: int
    points: tuple[FitPoint, ...]
    points_threshold: float | None = None
    observer_curve: CurveParameters | None = None
    threshold_ci95_same_scenes: tuple[float | None, float | None] | None = None


def fit_trials(
    level: ArrayLike,
    p_correct: ArrayLike,
    *,
    curve: CurveName = "weibull",
    settings: FitSettings = FitSettings(),
    rng: np.random.Generator,
    backgrounds: NDArray[np.integer] | None = None,
) -> PsychometricFit:
    """Fit a curve to single trials: levels > 0, and answers of 0 or 1 or the probability in [0, 1] that the answer
    is correct, (trial,) each.

    If all answers are 0 or 1, the fit and its interval are those of `fit_counts`. The curve "observer" is that of
    a linear observer with four answers, for its own probabilities; it has the guess rate 0.25 and no lapses,
    whatever the settings of Weibull's curve. The interval resamples the trials within each level, see
    `bootstrap.redrawn`; or, if there are two or more, the `backgrounds`, by number, with all of their trials, as
    drawn from many. The fit itself is deterministic. DataError if the shapes differ, there is no trial, or a value
    is out of its range.
    """
    x, p = np.asarray(level, dtype=np.float64), np.asarray(p_correct, dtype=np.float64)
    _check_levels(x, "p_correct", p)
    _check(p, (p >= 0) & (p <= 1), "p_correct", "a number in [0, 1]")
    order = np.lexsort((p, x))
    observed = Observed.of_trials(x, p, order)
    if backgrounds is None:
        return _fit(observed, curve, settings, rng)
    _, numbers = np.unique(sets_of_backgrounds(backgrounds), return_inverse=True)
    return _fit(observed, curve, settings, rng, by_level(numbers, observed.n_trials, order))


def fit_counts(
    level: ArrayLike,
    n_correct: ArrayLike,
    n_trials: ArrayLike,
    *,
    settings: FitSettings = FitSettings(),
    rng: np.random.Generator,
) -> PsychometricFit:
    """Fit Weibull's curve to counts of right answers; rows of equal level are pooled. DataError as for
    `fit_trials`. The interval resamples each level binomially. The p of a level mixes its observed proportion, for
    its n trials, with the fitted curve, for 5 trials: levels without errors vary too, and single trials are all
    but drawn from the curve (Wichmann & Hill 2001). All p are drawn towards (1 + γ)/2 by 4 trials in the whole
    experiment (after Agresti & Coull 1998), because a curve fitted to few trials is too steep.
    """
    x, right, n = (np.asarray(values, dtype=np.float64) for values in (level, n_correct, n_trials))
    _check_levels(x, "n_correct", right)
    _check_levels(x, "n_trials", n)
    _check(n, (n >= 1) & (n == np.floor(n)) & np.isfinite(n), "n_trials", "a whole number >= 1")
    _check(right, (right >= 0) & (right == np.floor(right)), "n_correct", "a whole number >= 0")
    _check(right, right <= n, "n_correct", "at most n_trials")
    distinct, row = np.unique(x, return_inverse=True)
    total = np.bincount(row, n, len(distinct))
    p_correct = np.bincount(row, right, len(distinct)) / total
    observed = Observed(distinct, total.astype(np.int64), p_correct, None, are_probabilities=False)
    return _fit(observed, "weibull", settings, rng)


def _check_levels(level: FloatArray, name: str, values: FloatArray) -> None:
    if level.ndim != 1 or values.shape != level.shape or not level.size:
        shapes = f"level {level.shape} and {name} {values.shape}"
        raise DataError(f"found shapes {shapes}, expected one element each per row, and at least one row")
    _check(level, np.isfinite(level) & (level > 0), "level", "a finite number > 0")


def _check(values: FloatArray, valid: NDArray[np.bool_], name: str, expected: str) -> None:
    if not valid.all():
        row = int(np.argmin(valid))
        raise DataError(f"{name}, element {row}: found {values[row]:g}, expected {expected}")


def curve_model(observed: Observed, curve: CurveName, settings: FitSettings) -> CurveModel:
    """Build the model of a curve for some answers."""
    ln_level = np.log(observed.level)
    centre = float(ln_level[0] + ln_level[-1]) / 2
    z, trials = ln_level - centre, observed.n_trials.astype(np.float64)
    locations, slopes = (-600.0, 600.0), np.log(SLOPE_RANGE)
    if curve == "weibull":
        fixed = settings.lapse_rate
        lapse_rates = (0.0, settings.lapse_rate_max) if fixed is None else (fixed, fixed)
        lower, upper = np.array([locations, slopes, lapse_rates]).T
        return WeibullModel(centre, z, trials, settings.guess_rate, settings.p_correct, lower, upper)
    # Two levels determine a location and a slope, no more.
    limits = (0.0, SMALLEST_CEILING**-2.0 if len(z) > 2 else 0.0)
    lower, upper = np.array([locations, slopes, limits]).T
    model = ObserverModel(centre, z, trials, GUESS_RATE, settings.p_correct, lower, upper)
    if settings.slope_spread is None:
        return model
    theta, _ = model.fit_one(observed.p_correct, steps=20)
    right, _, _ = model.curves(theta[None], z)
    # The likelihood takes probabilities for answers of 0 and 1, and holds too little information by this factor.
    prior = observed.dispersion(right[0]) / settings.slope_spread**2
    return replace(model, slope_prior=prior, near=theta)


class _LikelyCurve(NamedTuple):
    """The most likely curve of a model; `theta` is None where a flat line is as likely."""

    model: CurveModel
    status: Status
    theta: FloatArray | None = None
    loglik: float = math.nan
    ln_threshold: float = math.nan

    @property
    def threshold(self) -> float | None:
        """Threshold, None unless the status says that there is one."""
        return self.model.level_of(self.ln_threshold) if self.status in HAVE_THRESHOLD else None

    @property
    def parameters(self) -> tuple[float, float, float]:
        """Level of the first parameter, slope, and third parameter."""
        assert self.theta is not None
        location, ln_slope, third = self.theta.tolist()
        return math.exp(min(max(self.model.centre + location, -700.0), 700.0)), math.exp(ln_slope), third


def _fit(
    observed: Observed,
    curve: CurveName,
    settings: FitSettings,
    rng: np.random.Generator,
    backgrounds: list[NDArray[np.intp]] | None = None,
) -> PsychometricFit:
    """Fit a curve to answers; `backgrounds` are those of the trials of each level."""
    columns = (observed.level, observed.n_trials, observed.p_correct)
    points = tuple(map(FitPoint, *(column.tolist() for column in columns)))
    fit = PsychometricFit(
        curve=curve,
        p_correct=settings.p_correct,
        guess_rate=settings.guess_rate,
        n_trials=int(observed.n_trials.sum()),
        points=points,
    )
    if len(points) < 2:
        return fit
    weibull = _most_likely(observed, "weibull", settings)
    best = weibull if curve == "weibull" else _most_likely(observed, curve, settings)
    fit = replace(fit, status=best.status, threshold=best.threshold)
    if weibull.theta is not None:
        alpha, beta, lapse_rate = weibull.parameters
        fit = replace(fit, alpha=alpha, beta=beta, lapse_rate=lapse_rate)
    if best.theta is None:
        return fit
    if curve == "observer":
        alpha, beta, limit = best.parameters
        fit = replace(fit, observer_curve=CurveParameters(alpha, beta, limit**-0.5 if limit else None))
    if fit.threshold is None:
        return fit
    crossing = math.inf
    if observed.shows_its_own_curve:
        crossing = float(crossing_of_points(best.model, best.theta, observed.p_correct[None])[0])
        fit = replace(fit, points_threshold=best.model.level_of(crossing) if math.isfinite(crossing) else None)
    if not settings.resamples:
        return fit
    low, high = threshold_interval(best.model, best.theta, best.loglik, observed, settings.resamples, rng)
    fit = replace(fit, threshold_ci95=best.model.interval(low, high))
    n_backgrounds = 0 if backgrounds is None else 1 + max(int(numbers.max()) for numbers in backgrounds)
    drawn = draw_backgrounds(n_backgrounds, settings.resamples, rng)
    if backgrounds is None or drawn is None:
        return fit
    draws = background_draws(best.model, best.theta, observed, backgrounds, drawn)
    is_followed = curve == "weibull" and math.isfinite(crossing)
    ends = interval_of_draws(draws, [best.ln_threshold, *([crossing] if is_followed else [])])
    return replace(fit, threshold_ci95=best.model.interval(*ends), threshold_ci95_same_scenes=fit.threshold_ci95)


def _most_likely(observed: Observed, curve: CurveName, settings: FitSettings) -> _LikelyCurve:
    model = curve_model(observed, curve, settings)
    theta, loglik = model.fit_one(observed.p_correct)
    mean = np.average(observed.p_correct, weights=observed.n_trials)
    flat = np.clip(mean, model.guess_rate, 1 - ((settings.lapse_rate or 0.0) if curve == "weibull" else 0.0))
    flat_loglik = float(binomial_loglik(mean, flat))
    without_prior = loglik - float(model.ln_prior(theta))
    if without_prior / observed.n_trials.sum() <= flat_loglik + 1e-9:
        if observed.falls_through(settings.p_correct):
            return _LikelyCurve(model, "falling")
        return _LikelyCurve(model, "always_exceeded" if mean >= settings.p_correct else "never_reached")
    ln_threshold = float(model.ln_threshold(theta[None])[0])
    return _LikelyCurve(model, _status(model, theta, ln_threshold), theta, loglik, ln_threshold)


def _status(model: CurveModel, theta: FloatArray, ln_threshold: float) -> Status:
    if model.z[0] <= ln_threshold <= model.z[-1]:
        return "between_levels" if model.is_step(theta) else "ok"
    above = ln_threshold > model.z[-1]
    end = model.z[-1] if above else model.z[0]
    nearest = float(model.curves(theta[None], np.array([end]))[0][0, 0])
    limit = model.guess_rate if above else model.ceiling(theta)
    near = abs(ln_threshold - end) <= math.log(EXTRAPOLATION_FACTOR)
    if near and abs(nearest - model.p_correct) <= abs(limit - model.p_correct) / 2:
        return "extrapolated"
    return "never_reached" if above else "always_exceeded"


def read_counts(path: Path) -> list[tuple[dict[str, float | str], NDArray[np.float64]]]:
    """Read a file of counts, by group in the order of appearance: the group's values by column name, and an array
    of shape (n, 3): level, n_correct, n_trials. DataError if the file cannot be read, a column is missing, or a
    value is not a number in its range.
    """
    header, rows = read_table(path, COUNT_COLUMNS)
    names = [name for name in header if name not in COUNT_COLUMNS]
    groups: dict[tuple[float | str, ...], list[list[float]]] = {}
    for row in rows:
        where, texts, _ = row
        level, n_correct, n_trials = values = row.numbers(COUNT_COLUMNS)
        if level <= 0:
            raise DataError(f"{where}: level: found {level:g}, expected > 0")
        if not 1 <= n_trials <= MOST_COUNTED or n_trials % 1:
            raise DataError(f"{where}: n_trials: found {n_trials:g}, expected a whole number >= 1 and <= 2^53")
        if not 0 <= n_correct <= n_trials or n_correct % 1:
            raise DataError(f"{where}: n_correct: found {n_correct:g}, expected a whole number, 0 to n_trials")
        groups.setdefault(tuple(number_or_text(texts[name]) for name in names), []).append(values)
    if not groups:
        raise DataError(f"{path}: no counts; expected rows below the header")
    return [(dict(zip(names, group, strict=True)), np.array(values)) for group, values in groups.items()]
