"""Maximum-likelihood internal noise of a person: with it, a model observer most likely answers as the person did.

The model gives the probability of a correct answer in each single trial. It depends on the internal noise σ, and
on the blur of the templates where that is free; a person may also lapse: with probability λ the answer is a guess.
The likelihood of all answers is Π p_i^c_i (1 − p_i)^(1 − c_i) with p_i = (1 − λ)·P_i(σ) + λγ. As in eq. 3 of
Hogervorst et al. 2001, δ = λ(1 − γ) is the error rate where the model would make none.

Intervals are those of the profile likelihood: all values that are not rejected by a likelihood-ratio test, with
the other parameters at their most likely values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.psychometrics.curves import CHI2_95, GUESS_RATE, binomial_loglik

NoiseStatus = Literal["ok", "noise_free", "at_chance", "too_few_trials"]

MOST_CERTAIN = 30.0 * math.log(10.0)
"""Largest |ln P(right) / P(wrong)| beyond which values count as equal: P is right to some digits down to 1e-30."""

NOISE_STEP, LAPSE_STEP = 0.1, 0.01
"""Largest distances of the values of ln noise and δ among which a maximum is searched first."""

BLUR_STEPS = 2
"""Number of values of ln blur that are searched first for each step of the table."""

REPEATED_VALUES = (41, 9, 7)
"""Numbers of values of ln noise, ln blur and δ that are fitted to repeated experiments."""

REPEATED_REACH = 1.6
"""Reach of these values from the most likely ones, in parts of the interval on that side: 3.1 standard errors."""


Interval = tuple[float | None, float | None]
"""The ends of a 95 % interval; None where the answers leave it open."""


@dataclass(frozen=True, eq=False)
class AnswerTable:
    """The model's probability of a correct answer in each trial, tabulated over internal noise and template blur.
    `ln_noise`, (g,), rises from noise that changes hardly any answer to noise that leaves guesses; `ln_blur`,
    (b,), has a single value if the blur is not free. `logit`, (trial, b, g), is ln of P(right) / P(wrong), within
    ± `MOST_CERTAIN`.
    """

    ln_noise: FloatArray
    ln_blur: FloatArray
    logit: FloatArray

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> AnswerTable:
        """Return the table of some of the trials."""
        return AnswerTable(self.ln_noise, self.ln_blur, self.logit[rows])

    def at(self, ln_noise: FloatArray, ln_blur: FloatArray | None = None) -> FloatArray:
        """Interpolate P(right) of each trial, (trial, b, g), at some noises and, if it is free, some blurs."""
        from scipy.interpolate import CubicSpline
        from scipy.special import expit

        logit = self._over_noise(ln_noise)
        if len(self.ln_blur) > 1 and ln_blur is not None:
            logit = CubicSpline(self.ln_blur, logit, axis=1)(ln_blur)
        return np.asarray(expit(np.clip(logit, -MOST_CERTAIN, MOST_CERTAIN)))

    @cached_property
    def _over_noise(self) -> Callable[[FloatArray], FloatArray]:
        from scipy.interpolate import CubicSpline

        spline: Callable[[FloatArray], FloatArray] = CubicSpline(self.ln_noise, self.logit, axis=2)
        return spline


def joined(tables: Sequence[AnswerTable]) -> AnswerTable:
    """Return the table of the trials of several tables over the same noises and blurs."""
    logit = np.concatenate([table.logit for table in tables])
    return AnswerTable(tables[0].ln_noise, tables[0].ln_blur, logit)


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """The most likely internal noise of a person, and how well it describes the answers.

    The status is `ok` if the answers determine the noise on both sides; `noise_free` if without any noise the
    model would answer no worse, as if all answers were right; `at_chance` if the answers cannot be distinguished
    from guesses; `too_few_trials` if both hold. Only `ok` has a noise; otherwise `noise_ci95` has the one end that
    is known. Noise and blur are in the units of the table, the lapse rate is δ of eq. 3; intervals are None for
    what was not free.

    `p_correct`, (trial,), includes lapses. `deviance` is twice the log-likelihood ratio of the observed
    proportions of correct answers, one a cell, to the fitted; `deviance_p_value` the share of repeated
    experiments, with answers drawn from the fitted model and fitted anew, whose deviance is as large, None if none
    were drawn.
    """

    status: NoiseStatus
    noise: float | None
    noise_ci95: Interval
    lapse_rate: float
    lapse_rate_ci95: tuple[float, float] | None
    blur: float
    blur_ci95: Interval | None
    p_correct: FloatArray
    log_likelihood: float
    deviance: float
    deviance_p_value: float | None
    n_cells: int


def fit_noise(
    table: AnswerTable,
    is_correct: NDArray[np.bool_],
    cell: NDArray[np.intp],
    *,
    lapse_rates: tuple[float, float] = (0.0, 0.0),
    resamples: int = 1000,
    rng: np.random.Generator,
) -> NoiseFit:
    """Fit the internal noise, and lapses and blur if they are free, to the answers of one or several persons.
    `cell` is the set of trials, from 0, in whose proportions the model is compared with the answers. Blur is free
    if the table has several, δ if the two `lapse_rates` differ. `resamples` is the number of repeated experiments
    for the p-value of the deviance; 0: no p-value.
    """
    search = _NoiseSearch(table, is_correct.astype(np.float64), lapse_rates)
    best, most = search.maximum()
    intervals = [search.interval(axis, best, most) for axis in range(3)]
    low, high = intervals[0]
    status: NoiseStatus = "ok"
    if low is None or high is None:
        status = "too_few_trials" if low is high else "noise_free" if low is None else "at_chance"
    p_correct = search.p_correct(best)
    deviance = float(_deviances(cell, search.is_correct[None], p_correct[None])[0])
    p_value = None
    if resamples:
        drawn = (rng.random((resamples, len(p_correct))) < p_correct).astype(np.float64)
        repeated = _deviances(cell, drawn, search.p_correct_of_experiments(drawn, best, intervals))
        # Rounding must not make two experiments with the same answers differ.
        p_value = float((1 + np.count_nonzero(repeated >= deviance - 1e-9)) / (resamples + 1))

    def exponential(interval: Interval) -> Interval:
        low, high = (None if end is None else math.exp(end) for end in interval)
        return low, high

    free = [lower < upper for lower, upper in search.bounds]
    # A lapse rate of 0 is one that a person may have, not a bound to what was tried.
    low_rate, high_rate = (
        bound if end is None else end for end, bound in zip(intervals[2], lapse_rates, strict=True)
    )
    return NoiseFit(
        status=status,
        noise=math.exp(best[0]) if status == "ok" else None,
        noise_ci95=exponential(intervals[0]),
        lapse_rate=float(best[2]),
        lapse_rate_ci95=(low_rate, high_rate) if free[2] else None,
        blur=math.exp(best[1]),
        blur_ci95=exponential(intervals[1]) if free[1] else None,
        p_correct=p_correct,
        log_likelihood=most,
        deviance=deviance,
        deviance_p_value=p_value,
        n_cells=int(cell.max()) + 1,
    )


def with_lapses(p_correct: FloatArray, lapse_rate: float) -> FloatArray:
    """Return the probability of a correct answer of an observer that errs by lapses at a rate δ."""
    share = lapse_rate / (1.0 - GUESS_RATE)
    return (1.0 - share) * p_correct + share * GUESS_RATE


class _NoiseSearch:
    """Search for the most likely parameters θ = (ln noise, ln blur, δ); those that are fixed have equal bounds."""

    def __init__(self, table: AnswerTable, is_correct: FloatArray, lapse_rates: tuple[float, float]) -> None:
        self.table = table
        self.is_correct = is_correct
        noise, blur = table.ln_noise, table.ln_blur
        self.bounds = np.array([(noise[0], noise[-1]), (blur[0], blur[-1]), lapse_rates])
        steps = np.ptp(self.bounds, axis=1) / (NOISE_STEP, 1.0, LAPSE_STEP)
        steps[1] = BLUR_STEPS * (len(blur) - 1)
        self.axes = [
            np.linspace(low, high, math.ceil(n) + 1) for (low, high), n in zip(self.bounds, steps, strict=True)
        ]
        plain = table.at(*self.axes[:2])
        each = [self._loglik(with_lapses(plain, lapse_rate)) for lapse_rate in self.axes[2].tolist()]
        self.grid = np.stack(each, axis=-1).swapaxes(0, 1)  # (noise, blur, lapse rate)

    def p_correct(self, theta: FloatArray) -> FloatArray:
        """Compute P(correct) of each trial: (trial,)."""
        return with_lapses(self.table.at(theta[:1], theta[1:2])[:, 0, 0], float(theta[2]))

    def _loglik(self, p_correct: FloatArray) -> FloatArray:
        right, wrong = _logarithms(p_correct)
        return np.tensordot(self.is_correct, right, 1) + np.tensordot(1.0 - self.is_correct, wrong, 1)

    def maximum(self, *, fixed: tuple[int, float] | None = None) -> tuple[FloatArray, float]:
        """Return the most likely parameters and their log-likelihood; one of them may be fixed, by its axis."""
        from scipy.optimize import minimize

        bounds, grid = self.bounds.copy(), self.grid
        if fixed is not None:
            axis, value = fixed
            bounds[axis] = value
            grid = np.take(grid, [np.abs(self.axes[axis] - value).argmin()], axis)
        cell = np.unravel_index(grid.argmax(), grid.shape)
        theta = np.array([values[k] for values, k in zip(self.axes, cell, strict=True)])
        theta = np.clip(theta, *bounds.T)
        free = bounds[:, 0] < bounds[:, 1]

        def loss(values: FloatArray) -> float:
            theta[free] = values
            return -float(self._loglik(self.p_correct(theta)))

        if not free.any():
            return theta, -loss(theta[free])
        top = minimize(loss, theta[free], bounds=bounds[free], method="L-BFGS-B")
        theta[free] = top.x
        return theta, -float(top.fun)

    def interval(self, axis: int, best: FloatArray, most: float) -> Interval:
        """Bound a parameter by the profile likelihood; an end is None if the likelihood stays high up to the
        limit."""
        from scipy.optimize import brentq

        values = self.axes[axis]
        # On the grid the others are not quite at their best, so values that look possible there are.
        others = tuple(other for other in range(3) if other != axis)
        is_rejected = 2.0 * (most - self.grid.max(axis=others)) > CHI2_95

        def excess(value: float) -> float:
            return 2.0 * (most - self.maximum(fixed=(axis, value))[1]) - CHI2_95

        def end(numbers: NDArray[np.intp]) -> float | None:
            """Search outwards from the best value."""
            before = float(best[axis])
            for number in numbers:
                if is_rejected[number] and excess(float(values[number])) > 0.0:
                    return float(brentq(excess, before, float(values[number]), xtol=1e-6))
                before = float(values[number])
            return None

        return (end(np.flatnonzero(values < best[axis])[::-1]), end(np.flatnonzero(values > best[axis])))

    def p_correct_of_experiments(
        self, is_correct: FloatArray, best: FloatArray, intervals: Sequence[Interval]
    ) -> FloatArray:
        """Compute P(correct) of each trial as fitted to each of many experiments: (experiment, trial)."""
        axes = []
        for value, ends, bounds, n in zip(best, intervals, self.bounds, REPEATED_VALUES, strict=True):
            low, high = (
                bound if end is None else value + REPEATED_REACH * (end - value)
                for end, bound in zip(ends, bounds, strict=True)
            )
            axes.append(np.unique(np.clip(np.linspace(low, high, n), *bounds)))
        plain = self.table.at(*axes[:2])
        p = np.stack([with_lapses(plain, lapse_rate) for lapse_rate in axes[2].tolist()], axis=-1)
        p = p.reshape(len(p), -1)
        right, wrong = _logarithms(p)
        loglik = is_correct @ (right - wrong) + wrong.sum(axis=0)
        return np.asarray(p[:, loglik.argmax(axis=1)].T)


def _logarithms(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute ln p and ln(1 − p), which stay finite."""
    least = math.exp(-MOST_CERTAIN)
    return np.log(np.maximum(p, least)), np.log(np.maximum(1.0 - p, least))


def _deviances(cell: NDArray[np.intp], is_correct: FloatArray, p_correct: FloatArray) -> FloatArray:
    """Compute the deviance of experiments; answers to trials and their P(correct) are (experiment, trial)."""
    members = np.eye(int(cell.max()) + 1)[cell]
    n_trials = members.sum(axis=0)
    shown, fitted = (each @ members / n_trials for each in (is_correct, p_correct))
    # A cell of certain answers has proportions that a rounding leaves beyond 1.
    shown, fitted = np.clip(shown, 0.0, 1.0), np.clip(fitted, 1e-300, 1.0 - 1e-16)
    excess = binomial_loglik(shown, shown) - binomial_loglik(shown, fitted)
    return np.asarray(2.0 * (excess * n_trials).sum(axis=1))
