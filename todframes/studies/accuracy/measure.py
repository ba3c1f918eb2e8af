"""Error against run time: ways to compute one threshold, each given more and more work, against a converged value.

A scene is a triangle seen through something, with ways to find its threshold there: some draw independent trials,
some place them evenly. Packages name scenes under the entry-point group `todframes.accuracy_scenes`.

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
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, IntArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.base.user_code import registered
from todframes.results.data import Record
from todframes.studies.accuracy.report import Budget, Estimator, SceneResult, SpeedRatio, TimeAt

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
"""Error of a threshold above which an estimate from independent trials is not shown."""

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
    broadcast. `probabilities` is the function from scores to the probability of each answer.
    """

    score: FloatArray
    covariance: FloatArray
    correct: IntArray
    probabilities: Callable[[FloatArray], FloatArray]


Draw = Callable[[int, np.random.Generator], FloatArray]
FoldedDraw = Callable[[int, np.random.Generator], FoldedTrials]
Rule = Callable[[int, np.random.Generator], ThresholdEstimate]
Variant = Callable[[np.random.Generator], ThresholdEstimate]


@dataclass(frozen=True, slots=True)
class Method:
    """A way to compute a threshold. `prepare` sets up and returns a function of a number of trials and a random
    generator; `share` is that of a scene's time.

    Without `budgets` the function draws independent trials and returns P(correct) of each, or 1 and 0 for answers,
    (n, columns). A column is a condition: one level, or each of many frames. With `budgets`, the numbers of trials
    to try, ascending, the trials are evenly placed, and it returns an estimate; errors are taken over `repeats` of
    them, 1 if nothing is drawn at random.
    """

    name: str
    label: str
    prepare: Callable[[], Callable[[int, np.random.Generator], Any]]
    share: float
    budgets: tuple[int, ...] = ()
    repeats: int = 1


@dataclass(frozen=True, kw_only=True)
class StudyScene:
    """Base class of the scenes that methods are tried on. `name` is that on the command line and in file names,
    `level` the kind of level that the threshold is. From `smallest` independent trials on the error falls as 1/√N,
    and `fewest` are drawn at least.
    """

    name: str
    title: str
    description: str
    level: str
    smallest: int = 1
    fewest: int = 64

    def converge(self) -> Converged:
        """Compute the threshold with far less error than any method is given time for."""
        raise NotImplementedError

    def literal(self, converged: Converged) -> Draw:
        """Set up the paper's Monte Carlo: each neuron of each trial gets noise, and the largest score answers."""
        raise NotImplementedError

    def folded(self, converged: Converged) -> FoldedDraw:
        """Set up trials for the folded observer."""
        raise NotImplementedError

    def closed_forms(self, converged: Converged) -> tuple[Method, ...]:
        """List the methods that place their trials evenly."""
        raise NotImplementedError

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """Return the closed form of one size as it is, then with single changes, by their labels."""
        raise NotImplementedError

    def non_gaussian_bound(self) -> float:
        """Bound the error in P(correct) of expected decisions from noise that is not Gaussian."""
        raise NotImplementedError

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Estimate the threshold from the mean of independent trials, (columns,): by default of one level, the
        converged one, to first order, and the slope there is taken as known. No way to choose levels needs fewer
        trials, and none of these knows the threshold beforehand.
        """
        p_correct = float(outcomes.mean())
        threshold = converged.threshold * math.exp((P_CORRECT - p_correct) / converged.slope)
        return ThresholdEstimate(p_correct, threshold)

    def methods(self, converged: Converged) -> tuple[Method, ...]:
        """List the methods: the literal Monte Carlo, those on folded scores, and the closed forms."""

        def drawn() -> Draw:
            draw = self.folded(converged)

            def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
                shown = draw(n, rng)
                # By eigenvectors, for the covariance of deviations from their mean is singular.
                values, vectors = np.linalg.eigh(shown.covariance)
                root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
                noise = (root @ rng.standard_normal((*shown.score.shape, 1)))[..., 0]
                return np.asarray((shown.score + noise).argmax(axis=-1) == shown.correct, dtype=np.float64)

            return outcomes

        def expected() -> Draw:
            draw = self.folded(converged)

            def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
                shown = draw(n, rng)
                answers = shown.probabilities(shown.score)
                correct = np.broadcast_to(shown.correct, answers.shape[:-1])[..., None]
                return np.take_along_axis(answers, correct, axis=-1)[..., 0]

            return outcomes

        return (
            Method("literal", "literal Monte Carlo", partial(self.literal, converged), 0.5),
            Method("folded", "Monte Carlo on folded scores", drawn, 0.1),
            Method("expected", "expected decisions, random phases", expected, 0.1),
            *self.closed_forms(converged),
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


def measure(scene: StudyScene, *, seconds: float, seed: int = 1) -> SceneResult:
    """Run all methods of a scene, which share so many seconds of CPU time; the converged value and the smallest
    budgets take what they take. Each scene and method has its own random stream. SettingsError if the time is
    not a positive number.
    """
    if not 0.0 < seconds < math.inf:
        raise SettingsError(f"time: found {seconds!r}, expected a finite number of seconds > 0")
    converged = scene.converge()
    methods = scene.methods(converged)
    results = []
    for number, method in enumerate(methods):
        key = (zlib.crc32(scene.name.encode()), number)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        measured = _measure_rule if method.budgets else _measure_draws
        results.append(measured(scene, method, converged, seconds * method.share, rng))
    closed_forms = [result for result, method in zip(results, methods, strict=True) if method.budgets]
    ratios = (
        speed_ratio(literal, {form.name: form.cpu_s_at[k] for form in closed_forms})
        for k, literal in enumerate(results[0].cpu_s_at)
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
    for fewer than three points. With `blocks`, each error is the root mean square over that number of independent
    estimates, and the variance of its logarithm is 1/(2·blocks). All are blocks of the same trials, and a mean
    over few blocks is part of one over many: the covariance of two is the smaller variance. Without, the scatter
    about the line gives the error.
    """
    from scipy.optimize import curve_fit

    if len(x) < 3:
        return None, None
    covariance = None if blocks is None else 0.5 / np.maximum.outer(blocks, blocks)
    line, errors = curve_fit(
        lambda x, slope, offset: slope * x + offset, x, y, sigma=covariance, absolute_sigma=blocks is not None
    )
    return float(line[0]), math.sqrt(errors[0, 0])


def time_of_draws(points: Sequence[Budget], set_up: float, drawn: int, error: float) -> TimeAt:
    """Return the CPU time for an error, extrapolated as 1/√N from the smallest blocks. These give the most
    independent estimates, and larger blocks add no information. It is extrapolated beyond the number of trials
    that were `drawn` in all.
    """
    if not points:
        return TimeAt(error)
    first = points[0]
    trials = first.trials * (first.threshold_error / error) ** 2
    each = (first.cpu_s - set_up) / first.trials
    return TimeAt(error, set_up + each * math.ceil(trials), extrapolated=trials > drawn)


def time_of_rule(points: Sequence[Budget], error: float) -> TimeAt:
    """Interpolate between the last budget whose error is larger and the next, along a line of logarithms."""
    larger = [number for number, point in enumerate(points) if point.threshold_error > error]
    if not larger:
        return TimeAt(error, points[0].cpu_s, at_most=True)
    if larger[-1] == len(points) - 1:
        return TimeAt(error)
    before, after = points[larger[-1]], points[larger[-1] + 1]
    height = math.log(before.threshold_error / max(after.threshold_error, 1e-300))
    share = math.log(before.threshold_error / error) / height
    return TimeAt(error, before.cpu_s * (after.cpu_s / before.cpu_s) ** share)


def speed_ratio(literal: TimeAt, closed_forms: Mapping[str, TimeAt]) -> SpeedRatio:
    """Compare the CPU time of one with that of the fastest of the others by name, all at the same error."""
    ratio = SpeedRatio(threshold_error=literal.threshold_error, extrapolated=literal.extrapolated)
    times = {at.cpu_s: (name, at.at_most) for name, at in closed_forms.items() if at.cpu_s is not None}
    if literal.cpu_s is None or not times:
        return ratio
    name, at_most = times[min(times)]
    return replace(ratio, ratio=literal.cpu_s / min(times), closed_form=name, at_least=at_most)


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


def _measure_draws(
    scene: StudyScene, method: Method, converged: Converged, seconds: float, rng: np.random.Generator
) -> Estimator:
    method.prepare()(1, rng)  # loads what has to be loaded
    set_up, draw = _timed(method.prepare)
    drawn: list[FloatArray] = []
    n, total = scene.smallest, 0
    start = _clock()
    while ((spent := (_clock() - start)[0]) < seconds and total < MOST_DRAWN_TRIALS) or total < scene.fewest:
        if total:  # so many that the time is just used up, but not more than there are already
            n = min(max(int((seconds - spent) / spent * total), 1), total)
        drawn.append(draw(n, rng))
        total += n
    each = (_clock() - start) / total
    outcomes = np.concatenate(drawn)
    points = []
    size = scene.smallest
    while (blocks := total // size) >= FEWEST_BLOCKS:
        means = outcomes[: blocks * size].reshape(blocks, size, -1).mean(axis=1)
        estimates = [scene.estimate(mean, converged) for mean in means]
        point = _budget(size, set_up + size * each, estimates, converged)
        if math.isfinite(point.threshold_error):
            points.append(point)
        size *= 2
    times = [time_of_draws(points, float(set_up[0]), total, at) for at in TARGETS]
    shown = [point for point in points if point.threshold_error <= LARGEST_SHOWN]
    return _result(method, set_up[0], shown, times)


def _measure_rule(
    _: StudyScene, method: Method, converged: Converged, seconds: float, rng: np.random.Generator
) -> Estimator:
    method.prepare()(method.budgets[0], rng)
    set_up, run = _timed(method.prepare)
    points: list[Budget] = []
    start, run_times = _clock(), np.zeros((0, 2))
    for trials in method.budgets:
        if points and (_clock() - start)[0] + run_times[:, 0].sum() * trials / points[-1].trials > seconds:
            break
        estimates, clocks = [], [_clock()]
        for _repeat in range(method.repeats):
            estimates.append(run(trials, rng))
            clocks.append(_clock())
        run_times = np.diff(clocks, axis=0)
        points.append(_budget(trials, set_up + np.median(run_times, axis=0), estimates, converged))
        if points[-1].threshold_error < converged.bound / converged.threshold:
            break  # what is left is the converged value's own error
    return _result(method, set_up[0], points, [time_of_rule(points, at) for at in TARGETS])


def _budget(
    trials: int, seconds: FloatArray, estimates: Sequence[ThresholdEstimate], converged: Converged
) -> Budget:
    p_correct, threshold = np.array(estimates).T
    errors = p_correct - P_CORRECT, np.log(threshold / converged.threshold)
    root_mean_squares = (float(np.sqrt(np.mean(error**2))) for error in errors)
    return Budget(trials, len(estimates), *seconds.tolist(), *root_mean_squares)


def _result(method: Method, set_up_cpu_s: float, points: Sequence[Budget], times: Sequence[TimeAt]) -> Estimator:
    """Make the record of a method; the slope is against the CPU time beyond the set-up."""
    used = [point for point in points if point.threshold_error > 0.0 and point.cpu_s > set_up_cpu_s]
    x = np.log([point.cpu_s - set_up_cpu_s for point in used])
    y = np.log([point.threshold_error for point in used])
    blocks = None if method.budgets else np.array([point.repeats for point in used])
    slope, error = fitted_slope(x, y, blocks=blocks)
    return Estimator(
        name=method.name,
        label=method.label,
        set_up_cpu_s=float(set_up_cpu_s),
        slope=slope,
        slope_standard_error=error,
        points=tuple(points),
        cpu_s_at=tuple(times),
    )


def _changes(variants: Mapping[str, Variant], seed: int) -> list[Record]:
    timed = [
        _timed(lambda variant=variant: variant(np.random.default_rng(seed)))  # type: ignore[misc]
        for variant in variants.values()
    ]
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
