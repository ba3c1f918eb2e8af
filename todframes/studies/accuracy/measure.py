"""Error against run time: ways to compute one threshold, each given more and more work, against a converged value.

A scene is a triangle seen through something, with methods to find its threshold there: some draw independent
trials, some place them evenly. Packages name the functions that make scenes under the entry-point group
`todframes.accuracy_scenes`.

Errors are root mean squares about a converged value that carries its own bound; that of a threshold is of its
logarithm. Times are of the process, set-up included. Independent trials are drawn once, as many as the time
allows, and cut into blocks of every size, each of which is an independent estimate.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.base.user_code import registered
from todframes.studies.accuracy.report import Budget, Estimator, SceneResult, TimeAt

ENTRY_POINT_GROUP = "todframes.accuracy_scenes"

P_CORRECT = 0.75
"""Criterion of all thresholds."""

TARGETS = (0.01, 0.001)
"""Errors of a threshold at which methods are compared."""

FEWEST_BLOCKS = 4
"""Smallest number of estimates in a root mean square, which is then known to a third."""

MOST_DRAWN_TRIALS = 2**17
"""Largest number of trials drawn for a method; the estimates from their blocks of all sizes then take seconds."""

LARGEST_SHOWN = 0.5
"""Error of a threshold above which an estimate from independent trials is not shown."""


class ThresholdEstimate(NamedTuple):
    """P(correct) at the converged threshold, and the threshold; NaN where there is none."""

    p_correct: float
    threshold: float


class Converged(NamedTuple):
    """The threshold with which methods are compared. `bound` is the half-width of its own error, 95 % where that
    is random; `slope` is dP(correct) / d ln(level).
    """

    threshold: float
    bound: float
    slope: float

    def estimate(self, outcomes: FloatArray) -> ThresholdEstimate:
        """Estimate the threshold from trials of one level, the converged one, to first order with the slope there.
        No way to choose levels needs fewer trials, and none of these knows the threshold beforehand.
        """
        p_correct = float(outcomes.mean())
        return ThresholdEstimate(p_correct, self.threshold * math.exp((P_CORRECT - p_correct) / self.slope))


Draw = Callable[[int, np.random.Generator], FloatArray]
Rule = Callable[[int, np.random.Generator], ThresholdEstimate]


@dataclass(frozen=True, kw_only=True)
class AccuracyScene:
    """A threshold and three methods to compute it, each a function that sets up and returns a function of a number
    of trials and a random generator.

    Attributes
    ----------
    name, title, description, level : str
        The name is that on the command line and in file names, the level the kind of level that the threshold is.
    converged : Converged
        What the methods are compared with.
    literal, expected : callable
        The paper's Monte Carlo, with noise on each neuron of each trial; P(correct) of trials at random
        displacements. They draw independent trials and return 1 and 0 for answers, or P(correct), (n, columns). A
        column is a condition: one level, or each of many frames.
    closed_form : callable
        P(correct) of trials that are placed evenly. It returns an estimate of the threshold.
    budgets, repeats : tuple of int, int
        Numbers of evenly placed trials to try, ascending, and the number of estimates that errors are taken over,
        1 if nothing is drawn at random.
    estimate : callable
        Makes an estimate of the mean outcomes of independent trials, (columns,).
    smallest, fewest : int
        Number of trials from which on its error falls as 1/√N, and the number drawn at least.
    p_correct_error_bound : float
        Bound on the error in P(correct) of expected decisions from noise that is not Gaussian.
    """

    name: str
    title: str
    description: str
    level: str
    converged: Converged
    literal: Callable[[], Draw]
    expected: Callable[[], Draw]
    closed_form: Callable[[], Rule]
    budgets: tuple[int, ...]
    repeats: int = 1
    estimate: Callable[[FloatArray], ThresholdEstimate]
    smallest: int = 1
    fewest: int = 64
    p_correct_error_bound: float


def find_scenes(names: Sequence[str]) -> dict[str, Callable[[], AccuracyScene]]:
    """Return the functions that make the scenes of these names, or all registered scenes if no name is given;
    SettingsError if there is no scene of a name, or it cannot be imported.
    """
    entries = registered(ENTRY_POINT_GROUP)
    check_keys(names, entries, argument.scene)
    scenes = {}
    for name in names or entries:
        try:
            scenes[name] = cast("Callable[[], AccuracyScene]", entries[name].load())
        except (ImportError, AttributeError) as error:
            raise SettingsError(f"{argument.scene}: {name!r} cannot be loaded ({error})") from None
    return scenes


def measure(scene: AccuracyScene, *, seconds: float, seed: int = 1) -> SceneResult:
    """Run all methods of a scene, which share so many seconds of CPU time; the smallest budgets take what they
    take. Each scene and method has its own random stream.
    """
    estimators = []
    methods: Sequence[tuple[str, str, float, Callable[[], Any]]] = (
        ("literal", "literal Monte Carlo", 0.3, scene.literal),
        ("expected", "expected decisions, random phases", 0.2, scene.expected),
        ("closed_form", "closed form", 0.5, scene.closed_form),
    )
    for number, (name, label, share, prepare) in enumerate(methods):
        run, fewest = (_evenly_placed, scene.budgets[0]) if name == "closed_form" else (_drawn, 1)
        key = (zlib.crc32(scene.name.encode()), number)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        prepare()(fewest, rng)  # loads what has to be loaded
        start = _clock()
        compute = prepare()
        set_up = _clock() - start
        points, times = run(scene, compute, set_up, seconds * share, rng)
        estimators.append(Estimator(name, label, float(set_up[0]), tuple(points), tuple(times)))
    return SceneResult(
        name=scene.name,
        title=scene.title,
        description=scene.description,
        level=scene.level,
        threshold=scene.converged.threshold,
        threshold_bound=scene.converged.bound,
        slope=scene.converged.slope,
        p_correct_error_bound=scene.p_correct_error_bound,
        estimators=tuple(estimators),
    )


def time_of_draws(points: Sequence[Budget], set_up_cpu_s: float, drawn: int, error: float) -> TimeAt:
    """Return the CPU time for an error, extrapolated as 1/√N from the smallest blocks. These give the most
    independent estimates, and larger blocks add no information. It is extrapolated beyond the number of trials
    that were `drawn` in all.
    """
    if not points:
        return TimeAt(error)
    first = points[0]
    trials = first.trials * (first.threshold_error / error) ** 2
    each = (first.cpu_s - set_up_cpu_s) / first.trials
    return TimeAt(error, set_up_cpu_s + each * math.ceil(trials), extrapolated=trials > drawn)


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


def _clock() -> FloatArray:
    """Return the CPU and wall time, in seconds."""
    return np.array([time.process_time(), time.perf_counter()])


def _drawn(
    scene: AccuracyScene, draw: Draw, set_up: FloatArray, seconds: float, rng: np.random.Generator
) -> tuple[list[Budget], list[TimeAt]]:
    """Draw trials for so many seconds; return the errors of their blocks of all sizes, and times of `TARGETS`."""
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
        point = _budget(size, set_up + size * each, [scene.estimate(mean) for mean in means], scene.converged)
        if math.isfinite(point.threshold_error):
            points.append(point)
        size *= 2
    times = [time_of_draws(points, float(set_up[0]), total, at) for at in TARGETS]
    return [point for point in points if point.threshold_error <= LARGEST_SHOWN], times


def _evenly_placed(
    scene: AccuracyScene, rule: Rule, set_up: FloatArray, seconds: float, rng: np.random.Generator
) -> tuple[list[Budget], list[TimeAt]]:
    """Try larger and larger budgets for so many seconds; return their errors, and times of `TARGETS`."""
    points: list[Budget] = []
    start, run_times = _clock(), np.zeros((0, 2))
    for trials in scene.budgets:
        if points and (_clock() - start)[0] + run_times[:, 0].sum() * trials / points[-1].trials > seconds:
            break
        estimates, clocks = [], [_clock()]
        for _ in range(scene.repeats):
            estimates.append(rule(trials, rng))
            clocks.append(_clock())
        run_times = np.diff(clocks, axis=0)
        points.append(_budget(trials, set_up + np.median(run_times, axis=0), estimates, scene.converged))
        if points[-1].threshold_error < scene.converged.bound / scene.converged.threshold:
            break  # what is left is the converged value's own error
    return points, [time_of_rule(points, at) for at in TARGETS]


def _budget(
    trials: int, seconds: FloatArray, estimates: Sequence[ThresholdEstimate], converged: Converged
) -> Budget:
    p_correct, threshold = np.array(estimates).T
    errors = p_correct - P_CORRECT, np.log(threshold / converged.threshold)
    root_mean_squares = (float(np.sqrt(np.mean(error**2))) for error in errors)
    return Budget(trials, len(estimates), *seconds.tolist(), *root_mean_squares)
