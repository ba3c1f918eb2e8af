"""Error against run time as people and programs read it: a result with its tables, sentences and figures."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

from msgspec import Struct
from msgspec.structs import asdict

from todframes.results.data import Positive, Record
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import INK, curve_style, label_text, plain_ticks, within
from todframes.results.result import Result
from todframes.results.table import Column, Table
from todframes.results.tables import records_table
from todframes.results.wording import count, level_heading, listed, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOTE = "* extrapolated as 1/√N. Errors are root mean squares, that of a threshold relative."


class Budget(Struct, frozen=True):
    """A method at one budget: trials of an estimate, estimates that the errors are taken over, time of one, and
    root mean squares of the errors, that of the threshold relative.
    """

    trials: int
    repeats: int
    cpu_s: float
    wall_s: float
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
        return f"CPU (s) at {percent}", f"times less at {percent}"


class Estimator(Struct, frozen=True):
    """A method to compute a threshold, with its CPU time and error at each budget.

    Attributes
    ----------
    name, label : str
        Name, and how it is shown.
    set_up_cpu_s : float
        CPU time before the first trial.
    points : tuple of Budget
        All budgets.
    cpu_s_at : tuple of TimeAt
        CPU times for some errors.
    """

    name: str
    label: str
    set_up_cpu_s: float
    points: tuple[Budget, ...] = ()
    cpu_s_at: tuple[TimeAt, ...] = ()

    def record(self, first: Estimator) -> Record:
        """Return the row of the table: the largest budget, CPU times for some errors, and how many times less they
        are than those of the first method.
        """
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
    """The result of `accuracy` for one scene.

    Attributes
    ----------
    name, title, description, level : str
        The scene, and the quantity of its threshold.
    threshold, threshold_bound : float
        Converged value, and the half-width of its error.
    slope : float
        dP(correct) / d ln(level) at the threshold.
    p_correct_error_bound : float
        Bound on the error of P(correct) from noise that is not Gaussian.
    estimators : tuple of Estimator
        The ways to compute the threshold: literal Monte Carlo, expected decisions, closed form.
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
                Column(key="wall_s", header="wall (s)", digits=2, rank=4),
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
