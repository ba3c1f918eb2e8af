"""Ratios of the thresholds of conditions to those of a reference: pairing, intervals and verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.comparison.records import NO_DIFFERENCE, Ratio
from todframes.comparison.viewing import NOT_KNOWN, Viewing
from todframes.psychometrics.bootstrap import NORMAL_95
from todframes.psychometrics.fit import MAX_RESAMPLES, FitSettings
from todframes.psychometrics.paired_bootstrap import (
    RatioDraws,
    ThresholdDraws,
    ThresholdRatio,
    draws_of_interval,
    interpolated,
    ratio_draws,
    threshold_ratio,
)
from todframes.results.data import Fit, Group, Record
from todframes.results.wording import size_column
from todframes.scoring.paired import TrialSeries, paired_draws
from todframes.scoring.trial_scores import RATIO_STREAMS


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """A condition as it was measured: its thresholds and, where they are there, the trials behind them.

    `settings` are those of the observer, and those of the sensor where there is one. `source` stands for the
    condition in messages. `plain` are the trials after a plain gain of contrast, with `gains` by the number of the
    group. `fit_settings` are those of the fits to repeated experiments, `measures` further values of the record,
    by the names in `ComparedCondition`, and `viewing` says how frames are shown.
    """

    name: str
    source: str
    fits: tuple[Fit, ...]
    settings: Record = field(default_factory=dict)
    trials: TrialSeries | None = None
    fit_settings: FitSettings = field(default_factory=FitSettings)
    plain: TrialSeries | None = None
    gains: Sequence[float | None] = ()
    measures: Record = field(default_factory=dict)
    viewing: Viewing = NOT_KNOWN

    def has_same_trials(self, other: Measured) -> bool:
        """Return whether both show the same in each trial of each group, in the same order."""
        if self.trials is None or other.trials is None or self.fit_settings != other.fit_settings:
            return False
        groups, others = ([fit.group for fit in condition.fits] for condition in (self, other))
        return groups == others and self.trials.shows_same(other.trials)


class Compared(NamedTuple):
    """A condition beside the reference: the ratio in each group, and over all of them if there are several. `by`
    is a key of `records.BY`; `left_out` are groups without a counterpart, `interpolated` those between two sizes.
    """

    ratios: tuple[Ratio, ...]
    overall: Ratio | None
    by: str
    interpolated: list[Group]
    left_out: list[Group]


class Place(NamedTuple):
    """A place on a curve: between the fits with two numbers, with a share of the second."""

    left: int
    right: int
    share: float


def compare_measured(conditions: Sequence[Measured], *, seed: int, weighted: bool) -> list[Compared]:
    """Compare conditions, whose names differ, with the first. Those with the same trials as the reference are
    drawn together with it, trial by trial, others apart; without trials, thresholds are drawn from their
    intervals. A ratio over all groups is the geometric mean or, `weighted`, that with `random_effects_weights` of
    the groups that have a ratio. P-values are corrected for the number of all ratios.
    """
    reference, *others = conditions
    matched = [_matched(reference.fits, condition.fits) for condition in others]
    n_comparisons = sum(len(groups) + (len(groups) > 1) for groups, _ in matched)
    # The smallest p-value, 2 / resamples, is then half of 5 % even after Holm's correction.
    least = min(80 * n_comparisons, MAX_RESAMPLES)
    resamples = max(least, *(condition.fit_settings.resamples for condition in conditions))
    by, draws, plain = _drawn(conditions, seed, resamples)
    pooled: list[list[tuple[Sequence[int], ThresholdRatio]]] = []
    for condition, (groups, _) in zip(others, matched, strict=True):
        of_groups = [
            ratio_draws(_at(place, draws[condition.name]), _at(before, draws[reference.name]))
            for _, place, before in groups
        ]
        pools = _pools(of_groups, weighted)
        pooled.append([(rows, threshold_ratio([of_groups[k] for k in rows], weights)) for rows, weights in pools])
    corrected = iter(holm([ratio.p_value for _, ratio in chain(*pooled)]).tolist())
    compared = []
    for condition, (groups, left_out), ratios in zip(others, matched, pooled, strict=True):
        several, own, of_plain = len(groups) > 1, draws[condition.name], plain.get(condition.name)
        p_values = [next(corrected) for _ in ratios]
        verdicts = _verdicts([ratio.is_lower for _, ratio in ratios], p_values, several=several)
        with np.errstate(divide="ignore"):
            bounds = [
                _reached(condition.fits, place) / _reached(reference.fits, before)[::-1]
                for _, place, before in groups
            ]
            if several:
                bounds.append(np.exp(np.log(bounds).mean(axis=0)))
        records: list[Ratio] = []
        for (rows, ratio), p_value, verdict, low_high in zip(ratios, p_values, verdicts, bounds, strict=True):
            more = _bounds(low_high) if ratio.ratio is None else {}
            if of_plain is not None:
                beyond = [ratio_draws(own[k], of_plain[k]) for k in rows]
                more |= _beyond(beyond, [condition.gains[k] for k in rows])
            record = Ratio(
                verdict=verdict,
                group=groups[len(records)][0] if len(records) < len(groups) else {},
                ratio=ratio.ratio,
                ratio_ci95=ratio.ratio_ci95,
                p_value=ratio.p_value,
                p_value_holm=p_value,
                p_value_is_least=ratio.p_value <= 2 / (resamples + 1),
                **more,
            )
            records.append(record)
        overall = records.pop() if several else None
        between = [group for group, *places in groups if any(place.share for place in places)]
        compared.append(Compared(tuple(records), overall, by[condition.name], between, left_out))
    return compared


def _matched(
    reference: Sequence[Fit], condition: Sequence[Fit]
) -> tuple[list[tuple[Group, Place, Place]], list[Group]]:
    """Return the groups that two curves have in common, each with its place on the condition's curve and on the
    reference's, and the groups of either that the other does not have, nor sizes on both sides of it.
    """
    size = size_column(reference)
    groups = [fit.group for fit in reference]
    groups += [fit.group for fit in condition if fit.group not in groups]
    if size is not None and len(groups) > len(reference):
        groups.sort(key=lambda group: ([str(group[name]) for name in group if name != size], float(group[size])))
    found, left_out = [], []
    for group in groups:
        place, before = (_place(fits, group, size) for fits in (condition, reference))
        if place is None or before is None:
            left_out.append(group)
        else:
            found.append((group, place, before))
    return found, left_out


def _place(fits: Sequence[Fit], group: Group, size: str | None) -> Place | None:
    """Return where a group lies on a curve; between sizes, ln threshold is linear in 1 / size. None beyond."""
    for number, fit in enumerate(fits):
        if fit.group == group:
            return Place(number, number, 0.0)
    if size is None:
        return None
    per_size = {
        1.0 / float(fit.group[size]): number
        for number, fit in enumerate(fits)
        if fit.threshold is not None and {**fit.group, size: 0.0} == {**group, size: 0.0}
    }
    at = 1.0 / float(group[size])
    left, right = (
        max((x for x in per_size if x < at), default=None),
        min((x for x in per_size if x > at), default=None),
    )
    if left is None or right is None:
        return None
    return Place(per_size[left], per_size[right], (at - left) / (right - left))


def _at(place: Place, draws: Sequence[ThresholdDraws]) -> ThresholdDraws:
    if place.left == place.right:
        return draws[place.left]
    return interpolated(draws[place.left], draws[place.right], place.share)


def _drawn(
    conditions: Sequence[Measured], seed: int, resamples: int
) -> tuple[dict[str, str], dict[str, Sequence[ThresholdDraws]], dict[str, Sequence[ThresholdDraws]]]:
    """Return how each condition was drawn, by its name, its draws in each group, and those after a plain gain."""
    reference = conditions[0]
    together = [condition for condition in conditions if condition.has_same_trials(reference)]
    gained = [condition for condition in together if condition.plain is not None]
    settings = replace(reference.fit_settings, resamples=resamples)
    series = [*(condition.trials for condition in together), *(condition.plain for condition in gained)]
    answered = [trials for trials in series if trials is not None]
    columns = list(zip(*paired_draws(answered, seed=seed, settings=settings), strict=True)) if answered else []
    draws: dict[str, Sequence[ThresholdDraws]] = {
        condition.name: column for condition, column in zip(together, columns, strict=False)
    }
    plain: dict[str, Sequence[ThresholdDraws]] = {
        condition.name: column for condition, column in zip(gained, columns[len(together) :], strict=True)
    }
    by = dict.fromkeys(draws, "paired_trials")
    for number, condition in enumerate(conditions):
        if condition.name in draws:
            continue
        if number and condition.fits == reference.fits:
            by[condition.name], draws[condition.name] = "same_thresholds", draws[reference.name]
        elif condition.trials is not None:
            own = replace(condition.fit_settings, resamples=resamples)
            of_groups = paired_draws([condition.trials], seed=seed, settings=own, stream=number)
            by[condition.name], draws[condition.name] = "separate_trials", [of_group[0] for of_group in of_groups]
        else:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, 0, number)))
            by[condition.name] = "intervals"
            draws[condition.name] = [_of_fit(fit, resamples, rng) for fit in condition.fits]
    return by, draws, plain


def _of_fit(fit: Fit, resamples: int, rng: np.random.Generator) -> ThresholdDraws:
    """Draw a threshold from its interval, or its numerical error. Where a computed one is never reached or always
    exceeded, that is certain; of counts, it is not.
    """
    if fit.threshold is None:
        certain = {"never_reached": math.inf, "always_exceeded": -math.inf}
        beyond = math.nan if fit.n_trials else certain.get(fit.status, math.nan)
        return ThresholdDraws(None, None, np.full(resamples, beyond))
    interval = fit.threshold_ci95
    if interval is None and (error := fit.threshold_numerical_error) is not None:
        interval = (max(fit.threshold - error, 1e-3 * fit.threshold), fit.threshold + error)
    if interval is None and fit.n_trials:
        interval = (None, None)  # counts that were not drawn again bound nothing
    return draws_of_interval(fit.threshold, interval, resamples=resamples, rng=rng)


def _pools(groups: Sequence[RatioDraws], weighted: bool) -> list[tuple[Sequence[int], FloatArray | None]]:
    """Return the rows of each ratio and their weights: one of each group and, of several, one over all."""
    pools: list[tuple[Sequence[int], FloatArray | None]] = [([row], None) for row in range(len(groups))]
    known = [row for row, draws in enumerate(groups) if draws.ratio is not None and _spread(draws) < math.inf]
    if len(groups) > 1 and weighted and known:
        ln_ratios = np.array([math.log(groups[row].ratio or 1.0) for row in known])
        pools.append((known, random_effects_weights(ln_ratios, np.array([_spread(groups[row]) for row in known]))))
    elif len(groups) > 1:
        pools.append((range(len(groups)), None))
    return pools


def _spread(draws: RatioDraws) -> float:
    """Return the standard deviation of ln ratio, from the middle 95 % of its draws."""
    low, high = np.quantile(draws.ln_ratios, [0.025, 0.975], method="closest_observation").tolist()
    return math.inf if math.isinf(low) or math.isinf(high) else (high - low) / (2.0 * NORMAL_95)


def random_effects_weights(values: FloatArray, standard_deviations: FloatArray) -> FloatArray:
    """Compute the weights of values in a meta-analysis with random effects, of sum 1: those of their variances if
    the values agree, and alike if they differ by much more than that (DerSimonian & Laird 1986, eq. 8).
    """
    variance = np.maximum(standard_deviations, 1e-6) ** 2
    weights = 1.0 / variance
    mean = weights @ values / weights.sum()
    excess = weights @ (values - mean) ** 2 - (len(values) - 1)
    scale = weights.sum() - (weights**2).sum() / weights.sum()
    between = max(excess / scale, 0.0) if len(values) > 1 else 0.0
    weights = 1.0 / (variance + between)
    return np.asarray(weights / weights.sum())


def _verdicts(are_lower: Sequence[bool], p_values: Sequence[float], *, several: bool) -> list[str]:
    """Return the verdict of each ratio; the last is that over all of them if there are several."""
    verdicts = [
        NO_DIFFERENCE if p >= 0.05 else "better" if is_lower else "worse"
        for is_lower, p in zip(are_lower, p_values, strict=True)
    ]
    if several and {"better", "worse"} <= set(verdicts):
        verdicts[-1] = "mixed"
    elif several and verdicts[-1] == NO_DIFFERENCE:
        verdicts[-1] = next((verdict for verdict in verdicts if verdict != NO_DIFFERENCE), NO_DIFFERENCE)
    return verdicts


def _reached(fits: Sequence[Fit], place: Place) -> FloatArray:
    """Return the least and the largest level at which a threshold may be: its own, or beyond the levels shown."""
    if place.left != place.right:
        return np.array([0.0, math.inf])  # has a ratio
    fit = fits[place.left]
    if fit.threshold is not None:
        return np.array([fit.threshold, fit.threshold])
    never, exceeded = (
        fit.status == status and bool(fit.points) for status in ("never_reached", "always_exceeded")
    )
    return np.array([fit.points[-1].level if never else 0.0, fit.points[0].level if exceeded else math.inf])


def _bounds(low_high: FloatArray) -> dict[str, Any]:
    """Return fields of `Ratio`: the ends between which a ratio without an estimate lies, where they are known."""
    ends = zip(("ratio_above", "ratio_below"), low_high.tolist(), strict=True)
    return {name: end for name, end in ends if 0.0 < end < math.inf}


def _beyond(draws: Sequence[RatioDraws], gains: Sequence[float | None]) -> dict[str, Any]:
    """Return fields of `Ratio`: the comparison with a plain gain, of all groups with the mean of their gains.

    They are empty where the triangle's contrast is not positive before or after the algorithm.
    """
    known = [gain for gain in gains if gain is not None]
    if len(known) < len(gains):
        return {}
    gain = known[0] if len(known) == 1 else math.exp(math.fsum(map(math.log, known)) / len(known))
    ratio = threshold_ratio(draws)
    return {"contrast_gain": gain, "beyond_gain": ratio.ratio, "beyond_gain_ci95": ratio.ratio_ci95}


def holm(p_values: ArrayLike) -> FloatArray:
    """Correct p-values for their number, so that any wrong verdict among all is as rare as for a single test. The
    smallest times their number, the next times one less, and so on, never falling (Holm 1979).
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return corrected
