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
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import asdict

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.base.user_code import registered
from todframes.results.data import Positive, Record
from todframes.results.figures import INK, ReportFigure, curve_style, label_text, plain_ticks, within
from todframes.results.result import Result
from todframes.results.tables import Column, Table, records_table
from todframes.results.wording import count, level_heading, listed, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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

NOTE = (
    "* extrapolated as 1/√N. Errors are root mean squares, that of a threshold relative; ratios are how many "
    "times less CPU time than the literal Monte Carlo takes."
)


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


class Budget(Struct, frozen=True):
    """A method at one budget: trials of an estimate, estimates that errors are taken over, and CPU time of one."""

    trials: int
    repeats: int
    cpu_s: float
    p_correct_error: float
    threshold_error: float


class TimeAt(Struct, frozen=True):
    """CPU time that an error of a threshold takes; None if no budget tried has it. `extrapolated` along the
    measured 1/√N, to more trials than were drawn; `at_most` where even the smallest budget has it.
    """

    threshold_error: float
    cpu_s: float | None = None
    extrapolated: bool = False
    at_most: bool = False

    @property
    def columns(self) -> tuple[str, str]:
        """The headings of the CPU time, and of its ratio to the first method's."""
        percent = f"{100 * self.threshold_error:g} %"
        return f"CPU (s), {percent}", f"ratio, {percent}"


class Estimator(Struct, frozen=True):
    """A method to compute a threshold, and how it is shown: CPU time before the first trial, all budgets, and CPU
    times for some errors.
    """

    name: str
    label: str
    set_up_cpu_s: float
    points: tuple[Budget, ...] = ()
    cpu_s_at: tuple[TimeAt, ...] = ()

    def record(self, first: Estimator) -> Record:
        """Return the row of the table: the largest budget, and CPU times with ratios to the first method's."""
        record: Record = {"estimator": self.label, **(asdict(self.points[-1]) if self.points else {})}
        for at, base in zip(self.cpu_s_at, first.cpu_s_at, strict=False):
            if at.cpu_s is not None:
                text = rounded(at.cpu_s) if at.cpu_s >= 100.0 else plain(at.cpu_s, 2)
                ratio = None if base.cpu_s is None else rounded(base.cpu_s / at.cpu_s)
                cells = "≤ " * at.at_most + text + " *" * at.extrapolated, ratio
                record |= dict(zip(at.columns, cells, strict=True))
        return record

    @property
    def curve(self) -> list[tuple[float, float]]:
        """CPU time and relative error of the threshold at each budget, if both are above 0."""
        pairs = sorted((point.cpu_s, point.threshold_error) for point in self.points)
        return [pair for pair in pairs if min(pair) > 0]


class SceneResult(Struct, frozen=True, kw_only=True):
    """The result of `accuracy` for one scene, with the numbers of its converged value and the ways to compute the
    threshold: literal Monte Carlo, expected decisions, closed form.
    """

    name: str
    title: str
    description: str
    level: str
    threshold: Positive
    threshold_bound: float
    slope: float
    p_correct_error_bound: float
    estimators: tuple[Estimator, ...]

    @property
    def heading(self) -> str:
        """The title with a capital letter."""
        return self.title[:1].upper() + self.title[1:]

    @property
    def pairs(self) -> list[tuple[TimeAt, float, TimeAt]]:
        """Times of the first and the last method, and between them their ratio, at each error with both known."""
        times = zip(self.estimators[0].cpu_s_at, self.estimators[-1].cpu_s_at, strict=True)
        return [(first, first.cpu_s / last.cpu_s, last) for first, last in times if first.cpu_s and last.cpu_s]

    def sentences(self) -> list[str]:
        """Return what the last method costs in terms of the first, at equal error."""
        parts = [
            f"{'at least ' * last.at_most}{plain(ratio)} times less at {plain(100 * first.threshold_error, 1)} % "
            f"error{' (extrapolated)' * first.extrapolated}"
            for first, ratio, last in self.pairs
        ]
        if not parts:
            return []
        first, last = self.estimators[0].label, self.estimators[-1].label
        return [f"{self.heading}: the CPU time of {last} is {listed(parts)} than that of {first}."]

    def tables(self) -> list[Table]:
        """Make the tables: estimators, and all budgets."""
        threshold = f"{level_heading(self.level)} {plain(self.threshold, 6)} ± {plain(self.threshold_bound, 1)}"
        columns = [column for at in self.estimators[0].cpu_s_at for column in at.columns]
        estimators = Table.of(
            f"{self.heading}: threshold {threshold}",
            f"{self.name}_estimators.csv",
            [
                Column(key="estimator", is_name=True),
                Column(key="trials", rank=3),
                Column(key="cpu_s", header="CPU (s)", digits=2, rank=2),
                Column(key="p_correct_error", header="error of P", digits=2, rank=4),
                Column(key="threshold_error", header="of the threshold", digits=2, rank=2),
                *(Column(key=key, header=key, rank=key.startswith("CPU")) for key in columns),
            ],
            [estimator.record(self.estimators[0]) for estimator in self.estimators],
        )
        budgets = [
            {"estimator": estimator.label} | asdict(point)
            for estimator in self.estimators
            for point in estimator.points
        ]
        all_budgets = records_table(f"{self.heading}: budgets", f"{self.name}_budgets.csv", budgets).folded()
        return [table for table in (estimators, all_budgets) if table.records]

    def figure(self) -> ReportFigure:
        """Describe the figure of error against CPU time."""
        return ReportFigure(
            self.heading,
            f"{self.description} Error of the threshold against CPU time, a line for each way to compute it. "
            f"Grey: below the error of the converged value, where dP / d ln {self.level} is "
            f"{plain(self.slope, 2)}. That summed noise is not quite Gaussian changes P by at most "
            f"{plain(self.p_correct_error_bound, 2)}.",
            partial(draw_errors, scene=self),
            f"accuracy_{self.name}.png",
        )


class Accuracy(Result, frozen=True, kw_only=True):
    """Error of several ways to compute a threshold against their run time. `todframes accuracy` gives it.

    Attributes
    ----------
    scenes : tuple of SceneResult
        An object for each scene.
    """

    scenes: tuple[SceneResult, ...] = ()

    json_file: ClassVar[str] = "accuracy.json"
    has_findings_in_table: ClassVar[bool] = True

    def tables(self) -> list[Table]:
        """List the estimators of each scene; folded all budgets."""
        return [table for scene in self.scenes for table in scene.tables()]

    def findings(self) -> list[str]:
        """Return what the last estimator costs in terms of the first, at equal error."""
        texts = [text for scene in self.scenes for text in scene.sentences()]
        return texts or [f"{count(len(self.scenes), 'scene')}: error against run time."]

    def advice(self) -> list[str]:
        """Return how to read the tables."""
        return [NOTE]

    def figures(self) -> list[ReportFigure]:
        """List error against CPU time of each scene."""
        return [scene.figure() for scene in self.scenes if any(estimator.curve for estimator in scene.estimators)]


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
        ("expected", "expected decisions", 0.2, scene.expected),
        ("closed_form", "closed form", 0.5, scene.closed_form),
    )
    for number, (name, label, share, prepare) in enumerate(methods):
        run, fewest = (_evenly_placed, scene.budgets[0]) if name == "closed_form" else (_drawn, 1)
        key = (zlib.crc32(scene.name.encode()), number)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        prepare()(fewest, rng)  # loads what has to be loaded
        start = time.process_time()
        compute = prepare()
        set_up_s = time.process_time() - start
        points, times = run(scene, compute, set_up_s, seconds * share, rng)
        estimators.append(Estimator(name, label, set_up_s, tuple(points), tuple(times)))
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


def _drawn(
    scene: AccuracyScene, draw: Draw, set_up_s: float, seconds: float, rng: np.random.Generator
) -> tuple[list[Budget], list[TimeAt]]:
    """Draw trials for so many seconds; return the errors of their blocks of all sizes, and times of `TARGETS`."""
    drawn: list[FloatArray] = []
    n, total = scene.smallest, 0
    start = time.process_time()
    while ((spent := time.process_time() - start) < seconds and total < MOST_DRAWN_TRIALS) or total < scene.fewest:
        if total:  # so many that the time is just used up, but not more than there are already
            n = min(max(int((seconds - spent) / spent * total), 1), total)
        drawn.append(draw(n, rng))
        total += n
    each_s = (time.process_time() - start) / total
    outcomes = np.concatenate(drawn)
    points = []
    size = scene.smallest
    while (blocks := total // size) >= FEWEST_BLOCKS:
        means = outcomes[: blocks * size].reshape(blocks, size, -1).mean(axis=1)
        point = _budget(size, set_up_s + size * each_s, [scene.estimate(mean) for mean in means], scene.converged)
        if math.isfinite(point.threshold_error):
            points.append(point)
        size *= 2
    times = [time_of_draws(points, set_up_s, total, at) for at in TARGETS]
    return [point for point in points if point.threshold_error <= LARGEST_SHOWN], times


def _evenly_placed(
    scene: AccuracyScene, rule: Rule, set_up_s: float, seconds: float, rng: np.random.Generator
) -> tuple[list[Budget], list[TimeAt]]:
    """Try larger and larger budgets for so many seconds; return their errors, and times of `TARGETS`."""
    points: list[Budget] = []
    start, run_times = time.process_time(), np.zeros(0)
    for trials in scene.budgets:
        if points and time.process_time() - start + run_times.sum() * trials / points[-1].trials > seconds:
            break
        estimates, clocks = [], [time.process_time()]
        for _ in range(scene.repeats):
            estimates.append(rule(trials, rng))
            clocks.append(time.process_time())
        run_times = np.diff(clocks)
        points.append(_budget(trials, set_up_s + float(np.median(run_times)), estimates, scene.converged))
        if points[-1].threshold_error < scene.converged.bound / scene.converged.threshold:
            break  # what is left is the converged value's own error
    return points, [time_of_rule(points, at) for at in TARGETS]


def _budget(trials: int, cpu_s: float, estimates: Sequence[ThresholdEstimate], converged: Converged) -> Budget:
    p_correct, threshold = np.array(estimates).T
    errors = p_correct - P_CORRECT, np.log(threshold / converged.threshold)
    root_mean_squares = (float(np.sqrt(np.mean(error**2))) for error in errors)
    return Budget(trials, len(estimates), cpu_s, *root_mean_squares)


def rounded(value: float) -> str:
    """Return a ratio as text with two significant digits and thousands separators."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10.0 else f"{value:.2g}"


def draw_errors(axes: Axes, scene: SceneResult) -> None:
    """Draw error against CPU time for a scene of `accuracy`, both logarithmic, with a line for each estimator."""
    shown = [estimator for estimator in scene.estimators if estimator.curve]
    for number, estimator in enumerate(shown):
        line_style, (times, errors) = curve_style(number, len(shown)), zip(*estimator.curve, strict=True)
        axes.plot(
            [*map(within, times)],
            [*map(within, errors)],
            color=line_style.colour,
            marker=line_style.marker,
            label=label_text(estimator.label),
        )
    axes.set(xscale="log", yscale="log", xlabel="CPU time (s)", ylabel="relative error of the threshold")
    low, high = axes.get_xlim()
    if high < 100.0 * low:
        plain_ticks(axes.xaxis, (low, high))
    bottom = axes.get_ylim()[0]
    if (relative := scene.threshold_bound / scene.threshold) > bottom:
        axes.axhspan(bottom, relative, color=INK, alpha=0.08, lw=0.0, zorder=0)
        axes.set_ylim(bottom=bottom)
    for first, ratio, last in scene.pairs:
        text = f"{'≥ ' * last.at_most}{rounded(ratio)} times\nless CPU" + ",\nextrapolated" * first.extrapolated
        axes.axhline(first.threshold_error, color=INK, alpha=0.6, ls="--", lw=0.8, zorder=0)
        side = axes.get_yaxis_transform()
        axes.text(1.02, first.threshold_error, text, transform=side, va="center", fontsize="small")
    # Beside and below the axes no curve crosses a label.
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
