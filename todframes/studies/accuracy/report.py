"""Error against run time as people and programs read it: a result with its tables, sentences and figures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from msgspec import Struct

from todframes.results.data import Body, Positive, Record
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import INK, curve_style, label_text, within
from todframes.results.table import Column, Table
from todframes.results.tables import records_table
from todframes.results.wording import count, level_heading, listed, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOTE = "* extrapolated along the measured 1/√N. Errors are root mean squares, that of a threshold relative."


class Estimator(Struct, frozen=True, kw_only=True):
    """A method to compute a threshold, with its CPU time and error at each budget.

    Attributes
    ----------
    name, label : str
        Name, and how it is shown.
    set_up_cpu_s : float
        CPU time before the first trial.
    slope, slope_standard_error : float or None
        Slope of ln(error) against ln(CPU time).
    points : tuple of dict
        For each budget: `trials` of an estimate, `repeats` behind the errors, `cpu_s`, `wall_s`, `p_correct_error`
        and `threshold_error` (relative).
    cpu_s_at : tuple of dict
        `cpu_s` at a `threshold_error`, or None; `extrapolated`, `at_most`.
    """

    name: str
    label: str
    set_up_cpu_s: float
    slope: float | None = None
    slope_standard_error: float | None = None
    points: tuple[Record, ...] = ()
    cpu_s_at: tuple[Record, ...] = ()


class SpeedRatio(Struct, frozen=True, kw_only=True):
    """The first estimator's CPU time divided by that of the closed form, at a relative error of the threshold."""

    threshold_error: Positive
    ratio: Positive | None = None
    closed_form: str | None = None
    extrapolated: bool = False
    at_least: bool = False


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
        The ways to compute the threshold.
    variants : tuple of dict
        The closed form with something changed: `label`, `cpu_ratio`, `p_correct_change`, `threshold_change`.
    speed_ratios : tuple of SpeedRatio
        CPU time of the literal Monte Carlo over that of the fastest closed form.
    """

    name: str
    title: str
    description: str
    level: str
    threshold: Positive
    threshold_bound: float
    slope: float
    p_correct_error_bound: float
    estimators: tuple[Estimator, ...] = ()
    variants: tuple[Record, ...] = ()
    speed_ratios: tuple[SpeedRatio, ...] = ()

    @property
    def heading(self) -> str:
        """The title with a capital letter."""
        return self.title[:1].upper() + self.title[1:]


class Accuracy(Body, frozen=True, kw_only=True):
    """Error of several ways to compute a threshold against their run time. `todframes accuracy` gives it.

    Attributes
    ----------
    scenes : tuple of SceneResult
        An object for each scene.
    """

    scenes: tuple[SceneResult, ...] = ()

    json_file: ClassVar[str] = "accuracy.json"

    def tables(self) -> list[Table]:
        """List the estimators and single changes of each scene; folded all budgets."""
        return [table for scene in self.scenes for table in scene_tables(scene)]

    def sentences(self) -> list[str]:
        """Return what the last estimator costs in terms of the first, at equal error."""
        return timed(self.scenes)

    def printed(self) -> list[str]:
        """Return the legend of the tables."""
        return [NOTE]

    def figures(self) -> list[ReportFigure]:
        """List error against CPU time of each scene."""
        return [
            ReportFigure(
                scene.heading,
                f"{scene.description} Error of the threshold against CPU time, a line for each way to compute it. "
                f"Grey: below the error of the converged value, where dP / d ln {scene.level} is "
                f"{plain(scene.slope, 2)}. That summed noise is not quite Gaussian changes P by at most "
                f"{plain(scene.p_correct_error_bound, 2)}.",
                partial(draw_errors, scene=scene),
                f"accuracy_{scene.name}.png",
            )
            for scene in self.scenes
            if scene_runs(scene)
        ]


def timed(scenes: Sequence[SceneResult]) -> list[str]:
    """Return sentences that compare the CPU time of the last estimator with that of the first, at equal error."""
    texts = []
    for scene in scenes:
        parts = [
            f"{'at least ' * speed.at_least}{plain(speed.ratio)} times less at "
            f"{plain(100 * speed.threshold_error, 1)} % error{' (extrapolated)' * speed.extrapolated}"
            for speed in scene.speed_ratios
            if speed.ratio is not None
        ]
        if parts and len(scene.estimators) > 1:
            first, last = scene.estimators[0].label, scene.estimators[-1].label
            texts.append(f"{scene.heading}: the CPU time of {last} is {listed(parts)} than that of {first}.")
    return texts or [f"{count(len(scenes), 'scene')}: error against run time."]


def scene_tables(scene: SceneResult) -> list[Table]:
    """Make the tables of a scene of `accuracy`: estimators, effects of single changes, all budgets."""
    threshold = f"{level_heading(scene.level)} {plain(scene.threshold, 6)} ± {plain(scene.threshold_bound, 1)}"
    estimators = Table.of(
        f"{scene.heading}: threshold {threshold}",
        f"{scene.name}_estimators.csv",
        [
            Column(key="estimator", is_name=True),
            Column(key="trials", rank=3),
            Column(key="cpu_s", header="CPU (s)", digits=2, rank=2),
            Column(key="wall_s", header="wall (s)", digits=2, rank=4),
            Column(key="p_correct_error", header="error of P", digits=2, rank=4),
            Column(key="threshold_error", header="of the threshold", digits=2, rank=2),
            Column(key="slope", rank=3),
            *(
                Column(key=key, header=key, rank=1 if key.startswith("CPU") else 0)
                for estimator in scene.estimators[:1]
                for at in estimator.cpu_s_at
                for key in _at_names(at)
            ),
        ],
        [_estimator_record(estimator, scene.estimators[0]) for estimator in scene.estimators],
    )
    variants = Table.of(
        f"{scene.heading}: one thing changed about the closed form",
        f"{scene.name}_variants.csv",
        [
            Column(key="label", header="closed form, changed", is_name=True, wraps=True),
            Column(key="cpu_ratio", header="CPU", sign="× ", digits=3),
            Column(key="p_correct_change", header="change of P", digits=2),
            Column(key="threshold_change", header="of the threshold", digits=2),
        ],
        scene.variants,
    )
    budgets = [
        {"estimator": estimator.label} | point for estimator in scene.estimators for point in estimator.points
    ]
    listed = [estimators, *([variants] if scene.variants else [])]
    if budgets:
        listed.append(records_table(f"{scene.heading}: budgets", f"{scene.name}_budgets.csv", budgets).folded())
    return listed


def _at_names(at: Record) -> tuple[str, str]:
    """Return the headings of the columns of CPU time for an error and of its ratio to the first estimator's."""
    percent = f"{100 * at['threshold_error']:g} %"
    return f"CPU (s) at {percent}", f"times less at {percent}"


def _estimator_record(estimator: Estimator, first: Estimator) -> Record:
    """Return an estimator's row: its largest budget, the slope of its error, CPU times for some errors."""
    last = estimator.points[-1] if estimator.points else {}
    slope = None if estimator.slope is None else f"{estimator.slope:.2f}"
    if slope is not None and estimator.slope_standard_error is not None:
        slope += f" ± {estimator.slope_standard_error:.2f}"
    record: Record = {"estimator": estimator.label, **last, "slope": slope}
    bases = {at["threshold_error"]: at["cpu_s"] for at in first.cpu_s_at}
    for at in estimator.cpu_s_at:
        cpu_s, base = at["cpu_s"], bases.get(at["threshold_error"])
        time_name, ratio_name = _at_names(at)
        if cpu_s is not None:
            text = rounded(cpu_s) if cpu_s >= 100.0 else plain(cpu_s, 2)
            record[time_name] = ("≤ " if at.get("at_most") else "") + text + " *" * bool(at.get("extrapolated"))
            record[ratio_name] = None if base is None else rounded(base / cpu_s)
    return record


def rounded(value: float) -> str:
    """Return a ratio as text with two significant digits and thousands separators."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10.0 else f"{value:.2g}"


def draw_errors(axes: Axes, scene: SceneResult) -> None:
    """Draw error against CPU time for a scene of `accuracy`, both logarithmic, with a line for each estimator."""
    runs = scene_runs(scene)
    for number, (name, pairs) in enumerate(runs.items()):
        line_style, (times, errors) = curve_style(number, len(runs)), zip(*sorted(pairs), strict=True)
        axes.plot(
            [*map(within, times)],
            [*map(within, errors)],
            color=line_style.colour,
            marker=line_style.marker,
            label=label_text(name),
        )
    axes.set(xscale="log", yscale="log", xlabel="CPU time (s)", ylabel="relative error of the threshold")
    bottom = axes.get_ylim()[0]
    if (relative := scene.threshold_bound / scene.threshold) > bottom:
        axes.axhspan(bottom, relative, color=INK, alpha=0.08, lw=0.0, zorder=0)
        axes.set_ylim(bottom=bottom)
    for ratio in scene.speed_ratios:
        if ratio.ratio is not None:
            text = f"{'≥ ' * ratio.at_least}{rounded(ratio.ratio)} times\nless CPU"
            text += ",\nextrapolated" * ratio.extrapolated
            axes.axhline(ratio.threshold_error, color=INK, alpha=0.6, ls="--", lw=0.8, zorder=0)
            side = axes.get_yaxis_transform()
            axes.text(1.02, ratio.threshold_error, text, transform=side, va="center", fontsize="small")
    # Beside and below the axes no curve crosses a label.
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)


def scene_runs(scene: SceneResult) -> dict[str, list[tuple[float, float]]]:
    """Return CPU time and relative threshold error at each budget of each estimator, if both are above 0."""
    runs = {
        estimator.label: [
            (point["cpu_s"], point["threshold_error"])
            for point in estimator.points
            if point["cpu_s"] > 0 and point["threshold_error"] > 0
        ]
        for estimator in scene.estimators
    }
    return {label: pairs for label, pairs in runs.items() if pairs}
