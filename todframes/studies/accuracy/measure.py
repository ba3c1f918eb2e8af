"""Error against run time: estimators of one threshold, each given more and more work, against a converged value.

A scene is a triangle seen through something, with ways to find its threshold there: some draw independent trials
(`MonteCarlo`), some place them evenly (`Quadrature`). Packages name scenes under the entry-point group
`todframes.accuracy_scenes`.

Errors are root mean squares about a converged value that carries its own bound; that of a threshold is of its
logarithm. Times are of the process, set-up included. Independent trials are drawn once, as many as the time
allows, and cut into blocks of every size, each of which is an independent estimate.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, IntArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.base.user_code import registered
from todframes.observers.decision import answer_probabilities
from todframes.results.data import Record
from todframes.studies.accuracy.report import Estimator, SceneResult, SpeedRatio

ENTRY_POINT_GROUP = "todframes.accuracy_scenes"

P_CORRECT = 0.75
"""Criterion of all thresholds."""

T = TypeVar("T")

TARGETS = (0.01, 0.001)
"""Errors of a threshold at which estimators are compared."""

FEWEST_BLOCKS = 4
"""Smallest number of estimates in a root mean square, which is then known to a third."""

MOST_DRAWN_TRIALS = 2**17
"""Largest number of trials drawn for an estimator; the estimates from their blocks of all sizes then take
seconds."""

LARGEST_SHOWN = 0.5
"""Error of a threshold above which an estimate is not shown."""

TIMED, LONG_S = 3, 0.5
"""Number of runs of a set-up or variant whose median time is taken, and the total time after which no further one
begins."""


class Converged(NamedTuple):
    """The threshold with which estimators are compared. `bound` is the half-width of its own error, 95 % where
    that is random; `slope` is dP(correct) / d ln(level).
    """

    threshold: float
    bound: float
    slope: float


class ThresholdEstimate(NamedTuple):
    """P(correct) at the converged threshold, and the threshold; NaN where there is none."""

    p_correct: float
    threshold: float


class FoldedTrials(NamedTuple):
    """Independent trials as the folded observer sees them: score deviations without noise, (n, columns, 4), the
    covariance of the noise on them, (n, columns, 4, 4), and the number of the correct answer, (n, columns), both
    broadcast. `probabilities` is the function from scores to the probability of each answer; by default under
    Gaussian noise.
    """

    score: FloatArray
    covariance: FloatArray
    correct: IntArray
    probabilities: Callable[[FloatArray], FloatArray] | None = None


Draw = Callable[[int, np.random.Generator], FloatArray]
FoldedDraw = Callable[[int, np.random.Generator], FoldedTrials]
Rule = Callable[[int, np.random.Generator], ThresholdEstimate]
Variant = Callable[[np.random.Generator], ThresholdEstimate]


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """An estimator that draws independent trials. `prepare` sets up and returns `draw(n, rng)`: P(correct) of n
    independent trials, or 1 and 0 for answers, (n, columns). A column is a condition: one level, or each of many
    frames. `share` is that of a scene's time; from `smallest` trials on the error falls as 1/√N, and `fewest` are
    drawn at least.
    """

    name: str
    label: str
    prepare: Callable[[], Draw]
    share: float
    smallest: int = 1
    fewest: int = 64


@dataclass(frozen=True, slots=True)
class Quadrature:
    """An estimator that places its trials evenly. `prepare` sets up and returns `run(n, rng)`, an estimate from n
    trials. `budgets` are the numbers of trials to try, ascending; `share` is that of a scene's time; errors are
    taken over `repeats` estimates, 1 if nothing is drawn at random.
    """

    name: str
    label: str
    prepare: Callable[[], Rule]
    budgets: tuple[int, ...]
    share: float
    repeats: int = 1


@dataclass(frozen=True)
class StudyScene:
    """Base class of the scenes that estimators are tried on. `name` is that on the command line and in file names,
    `level` the kind of level that the threshold is.
    """

    name: str
    title: str
    description: str
    level: str

    def converge(self) -> Converged:
        """Compute the threshold with far less error than any estimator is given time for."""
        raise NotImplementedError

    def estimators(self, converged: Converged) -> Sequence[MonteCarlo | Quadrature]:
        """List the estimators, the literal Monte Carlo first; a `Quadrature` is a closed form."""
        raise NotImplementedError

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """Return the closed form of one size as it is, then with single changes, by their labels."""
        raise NotImplementedError

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Estimate the threshold from the mean of independent trials, (columns,): by default of one level, the
        converged one, to first order, and the slope there is taken as known. No way to choose levels needs fewer
        trials, and none of these knows the threshold beforehand.
        """
        p_correct = float(outcomes.mean())
        threshold = converged.threshold * math.exp((P_CORRECT - p_correct) / converged.slope)
        return ThresholdEstimate(p_correct, threshold)

    def non_gaussian_bound(self) -> float:
        """Bound the error in P(correct) of expected decisions from noise that is not Gaussian."""
        raise NotImplementedError


def monte_carlos(
    answers: Callable[[], Draw], trials: Callable[[], FoldedDraw], smallest: int = 1, fewest: int = 64
) -> tuple[MonteCarlo, MonteCarlo, MonteCarlo]:
    """Make the three Monte Carlos that every linear observer has, from `prepare` of the literal one and a function
    that returns `draw(n, rng)` of `FoldedTrials`.
    """

    def drawn() -> Draw:
        draw = trials()

        def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
            shown = draw(n, rng)
            # By eigenvectors, for the covariance of deviations from their mean is singular.
            values, vectors = np.linalg.eigh(shown.covariance)
            root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
            noise = (root @ rng.standard_normal((*shown.score.shape, 1)))[..., 0]
            return np.asarray((shown.score + noise).argmax(axis=-1) == shown.correct, dtype=np.float64)

        return outcomes

    def expected() -> Draw:
        draw = trials()

        def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
            shown = draw(n, rng)
            if shown.probabilities is not None:
                answers = shown.probabilities(shown.score)
            else:
                answers = answer_probabilities(shown.score, shown.covariance)
            correct = np.broadcast_to(shown.correct, answers.shape[:-1])[..., None]
            return np.take_along_axis(answers, correct, axis=-1)[..., 0]

        return outcomes

    return (
        MonteCarlo("literal", "literal Monte Carlo", answers, 0.5, smallest, fewest),
        MonteCarlo("folded", "Monte Carlo on folded scores", drawn, 0.1, smallest, fewest),
        MonteCarlo("expected", "expected decisions, random phases", expected, 0.1, smallest, fewest),
    )


def find_scenes(names: Sequence[str]) -> dict[str, Callable[[], StudyScene]]:
    """Return the functions that make the scenes of these names, or all registered scenes if no name is given;
    SettingsError if there is no scene of a name, or it cannot be imported.
    """
    entries = registered(ENTRY_POINT_GROUP)
    check_keys(names, entries, argument.scene)
    scenes = {}
    for name in names or entries:
        try:
            scenes[name] = cast("Callable[[], StudyScene]", entries[name].load())
        except (ImportError, AttributeError) as error:
            raise SettingsError(f"{argument.scene}: {name!r} cannot be loaded ({error})") from None
    return scenes


class BudgetPoint(NamedTuple):
    """An estimator at one budget: trials, estimates that the errors are taken over, time of one, errors."""

    trials: int
    repeats: int
    cpu_s: float
    wall_s: float
    p_correct_error: float
    threshold_error: float


class TimeAt(NamedTuple):
    """CPU time that an error of a threshold takes; None if no budget tried has it. `extrapolated` along the
    measured 1/√N, to more trials than were drawn; `at_most` where even the smallest budget has it.
    """

    threshold_error: float
    cpu_s: float | None
    extrapolated: bool = False
    at_most: bool = False


def measure(scene: StudyScene, *, seconds: float, seed: int = 1) -> SceneResult:
    """Run all estimators of a scene, which share so many seconds of CPU time; the converged value and the smallest
    budgets take what they take. Each scene and estimator has its own random stream. SettingsError if the time is
    not a positive number.
    """
    if not 0.0 < seconds < math.inf:
        raise SettingsError(f"time: found {seconds!r}, expected a finite number of seconds > 0")
    converged = scene.converge()
    results, times, closed_forms = [], {}, []
    for number, estimator in enumerate(scene.estimators(converged)):
        key = (zlib.crc32(scene.name.encode()), number)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        share = seconds * estimator.share
        if isinstance(estimator, MonteCarlo):
            result, times[estimator.name] = _measure_draws(scene, estimator, converged, share, rng)
        else:
            result, times[estimator.name] = _measure_rule(estimator, converged, share, rng)
            closed_forms.append(estimator.name)
        results.append(result)
    ratios = (
        speed_ratio(literal, {name: times[name][run] for name in closed_forms})
        for run, literal in enumerate(times[results[0].name])
    )
    return SceneResult(
        name=scene.name,
        title=scene.title,
        description=scene.description,
        level=scene.level,
        threshold=converged.threshold,
        threshold_bound=converged.bound,
        slope=converged.slope,
        p_correct_error_bound=scene.non_gaussian_bound(),
        estimators=tuple(results),
        variants=tuple(_changes(scene.variants(converged), seed)),
        speed_ratios=tuple(ratios),
    )


def fitted_slope(
    x: FloatArray, y: FloatArray, *, blocks: NDArray[np.intp] | None
) -> tuple[float | None, float | None]:
    """Fit a straight line to logarithms of time and error. Returns its slope and the slope's standard error; None
    where there are too few points. With `blocks`, each error is the root mean square over that number of
    independent estimates, and the variance of its logarithm is 1/(2·blocks). All are blocks of the same trials,
    and a mean over few blocks is part of one over many: the covariance of two is the smaller variance. Without,
    the scatter about the line gives the error.
    """
    n = len(x)
    if n < 2:
        return None, None
    design = np.stack([np.ones(n), x], axis=1)
    covariance = np.eye(n) if blocks is None else 1.0 / (2.0 * np.maximum.outer(blocks, blocks))
    weighted = np.linalg.solve(covariance, design)
    inverse = np.linalg.inv(design.T @ weighted)
    line = inverse @ (weighted.T @ y)
    if blocks is None:
        if n < 3:
            return float(line[1]), None
        inverse *= float(np.sum((y - design @ line) ** 2)) / (n - 2)
    return float(line[1]), math.sqrt(inverse[1, 1])


def time_of_draws(points: Sequence[BudgetPoint], set_up: float, drawn: int, error: float) -> TimeAt:
    """Return the CPU time for an error, extrapolated as 1/√N from the smallest blocks. These give the most
    independent estimates, and larger blocks add no information. It is extrapolated beyond the number of trials
    that were `drawn` in all.
    """
    if not points:
        return TimeAt(error, None)
    first = points[0]
    trials = first.trials * (first.threshold_error / error) ** 2
    each = (first.cpu_s - set_up) / first.trials
    return TimeAt(error, set_up + each * math.ceil(trials), extrapolated=trials > drawn)


def time_of_rule(points: Sequence[BudgetPoint], error: float) -> TimeAt:
    """Interpolate between the last budget whose error is larger and the next, along a line of logarithms."""
    larger = [number for number, point in enumerate(points) if point.threshold_error > error]
    if not larger:
        return TimeAt(error, points[0].cpu_s, at_most=True)
    if larger[-1] == len(points) - 1:
        return TimeAt(error, None)
    before, after = points[larger[-1]], points[larger[-1] + 1]
    height = math.log(before.threshold_error / max(after.threshold_error, 1e-300))
    share = math.log(before.threshold_error / error) / height
    return TimeAt(error, before.cpu_s * (after.cpu_s / before.cpu_s) ** share)


def speed_ratio(literal: TimeAt, closed_forms: Mapping[str, TimeAt]) -> SpeedRatio:
    """Compare the CPU time of one with that of the fastest of the others by name, all at the same error."""
    times = {at.cpu_s: (name, at.at_most) for name, at in closed_forms.items() if at.cpu_s is not None}
    error, is_extrapolated = literal.threshold_error, literal.extrapolated
    if literal.cpu_s is None or not times:
        return SpeedRatio(threshold_error=error, extrapolated=is_extrapolated)
    name, at_most = times[min(times)]
    return SpeedRatio(
        threshold_error=error,
        ratio=literal.cpu_s / min(times),
        closed_form=name,
        extrapolated=is_extrapolated,
        at_least=at_most,
    )


def _clock() -> FloatArray:
    """Return the CPU and wall time, in seconds."""
    return np.array([time.process_time(), time.perf_counter()])


def _timed(run: Callable[[], T]) -> tuple[FloatArray, T]:
    """Return the median CPU and wall time of some runs, fewer if they are long, and the last run's result."""
    times: list[FloatArray] = []
    while len(times) < TIMED and sum(cpu_s for cpu_s, _ in times) < LONG_S:
        start = _clock()
        result = run()
        times.append(_clock() - start)
    return np.median(times, axis=0), result


def _prepared(prepare: Callable[[], Callable[..., object]], *arguments: object) -> FloatArray:
    """Measure the time of the set-up, after a first run that loads what has to be loaded."""
    prepare()(*arguments)
    return _timed(prepare)[0]


def _measure_draws(
    scene: StudyScene, estimator: MonteCarlo, converged: Converged, seconds: float, rng: np.random.Generator
) -> tuple[Estimator, list[TimeAt]]:
    set_up = _prepared(estimator.prepare, 1, rng)
    draw = estimator.prepare()
    drawn: list[FloatArray] = []
    n, total = estimator.smallest, 0
    start = _clock()
    while ((spent := (_clock() - start)[0]) < seconds and total < MOST_DRAWN_TRIALS) or total < estimator.fewest:
        if total:  # so many that the time is just used up, but not more than there are already
            n = min(max(int((seconds - spent) / spent * total), 1), total)
        drawn.append(draw(n, rng))
        total += n
    each = (_clock() - start) / total
    outcomes = np.concatenate(drawn)
    points = []
    size = estimator.smallest
    while (blocks := total // size) >= FEWEST_BLOCKS:
        means = outcomes[: blocks * size].reshape(blocks, size, -1).mean(axis=1)
        errors = _errors([scene.estimate(mean, converged) for mean in means], converged)
        if math.isfinite(errors[1]):
            cpu_s, wall_s = (set_up + size * each).tolist()
            points.append(BudgetPoint(size, blocks, cpu_s, wall_s, *errors))
        size *= 2
    times = [time_of_draws(points, float(set_up[0]), total, at) for at in TARGETS]
    shown = [point for point in points if point.threshold_error <= LARGEST_SHOWN]
    return _result(estimator, set_up[0], shown, times), times


def _measure_rule(
    estimator: Quadrature, converged: Converged, seconds: float, rng: np.random.Generator
) -> tuple[Estimator, list[TimeAt]]:
    set_up = _prepared(estimator.prepare, estimator.budgets[0], rng)
    run = estimator.prepare()
    points: list[BudgetPoint] = []
    start, run_times = _clock(), np.zeros((0, 2))
    for budget in estimator.budgets:
        if points and (_clock() - start)[0] + run_times[:, 0].sum() * budget / points[-1].trials > seconds:
            break
        estimates, clocks = [], [_clock()]
        for _ in range(estimator.repeats):
            estimates.append(run(budget, rng))
            clocks.append(_clock())
        run_times = np.diff(clocks, axis=0)
        cpu_s, wall_s = (set_up + np.median(run_times, axis=0)).tolist()
        errors = _errors(estimates, converged)
        points.append(BudgetPoint(budget, estimator.repeats, cpu_s, wall_s, *errors))
        if errors[1] < converged.bound / converged.threshold:
            break  # what is left is the converged value's own error
    times = [time_of_rule(points, at) for at in TARGETS]
    return _result(estimator, set_up[0], points, times), times


def _errors(estimates: Sequence[ThresholdEstimate], converged: Converged) -> tuple[float, float]:
    p_correct, threshold = np.array(estimates).T
    of_p = p_correct - P_CORRECT
    of_threshold = np.log(threshold / converged.threshold)
    return float(np.sqrt(np.mean(of_p**2))), float(np.sqrt(np.mean(of_threshold**2)))


def _result(
    estimator: MonteCarlo | Quadrature, set_up_cpu_s: float, points: Sequence[BudgetPoint], times: Sequence[TimeAt]
) -> Estimator:
    """Make the record of an estimator; the slope is against the CPU time beyond the set-up."""
    used = [point for point in points if point.threshold_error > 0.0 and point.cpu_s > set_up_cpu_s]
    x = np.log([point.cpu_s - set_up_cpu_s for point in used])
    y = np.log([point.threshold_error for point in used])
    blocks = np.array([point.repeats for point in used]) if isinstance(estimator, MonteCarlo) else None
    slope, error = fitted_slope(x, y, blocks=blocks)
    return Estimator(
        name=estimator.name,
        label=estimator.label,
        set_up_cpu_s=float(set_up_cpu_s),
        slope=slope,
        slope_standard_error=error,
        points=tuple(point._asdict() for point in points),
        cpu_s_at=tuple(at._asdict() for at in times),
    )


def _changes(variants: Mapping[str, Variant], seed: int) -> list[Record]:
    def run(variant: Variant) -> ThresholdEstimate:
        return variant(np.random.default_rng(np.random.SeedSequence(seed)))

    timed = [_timed(partial(run, variant)) for variant in variants.values()]
    (cpu_s, _), reference = timed[0]
    return [
        {
            "label": label,
            "cpu_ratio": float(spent / cpu_s),
            "p_correct_change": estimate.p_correct - reference.p_correct,
            "threshold_change": math.log(estimate.threshold / reference.threshold),
        }
        for label, ((spent, _), estimate) in zip(variants, timed, strict=True)
    ]
