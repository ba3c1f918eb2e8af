"""Figures of a result: psychometric functions, TOD curve, ratios of thresholds, error against run time."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.psychometrics.observer_curve import observer_curve
from todframes.psychometrics.weibull import weibull
from todframes.results.calibration import SUBJECT, own_and_model, with_model_curves
from todframes.results.data import (
    Algorithm,
    ContrastResponse,
    Fit,
    Ratio,
    ResultData,
    SceneResult,
    each_observer,
)
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import (
    INK,
    PAPER,
    CurveStyle,
    add_colour_bar,
    add_legend,
    colour_scale,
    curve_style,
    label_text,
    plain_ticks,
    within,
)
from todframes.results.summary import by_curve, size_column
from todframes.results.wording import (
    FIELD_AXES,
    evenly,
    group_phrase,
    interval_phrase,
    level_heading,
    level_name,
    plain,
    quantity,
    threshold_heading,
    unit_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MOST_CURVES = 24

MOST_IN_LEGEND = 12

MOST_SIZES_NAMED = 8

MOST_MAPS = 4

FIELD_LABEL_POINTS = (3.0, 8.0)
"""Smallest and largest letters of the numbers in a map of the field, in points; as large as the places allow."""

FIELD_LABEL_EM = (8.8, 5.8)
"""Width of the numbers of a place in a map of the field, and height with the disc, in sizes of the letters."""

NO_THRESHOLD_MARKERS = {"never_reached": "x", "always_exceeded": "v"}
"""Markers of places without a threshold by status; another status has a plus sign."""


def pictures(result: ResultData) -> list[ReportFigure]:
    """List the figures of a result, the most important first."""
    if result.persons:
        return _of_persons(result)
    found = []
    if any(one.ratios for one in result.algorithms):
        note = (
            "Below 1 the algorithm helps. Filled: a difference is shown; open: none is. Lines are 95 % intervals, "
            "dotted where the data leave an end open."
        )
        for number, (observer, algorithms) in enumerate(each_observer(result)):
            title = "Thresholds with and without" + (f", for {observer}" if observer else "")
            draw, file = partial(draw_ratios, algorithms=algorithms), "" if number else "compare.png"
            found.append(ReportFigure(title, note, draw, file))
    if any(_has_contrasts(response) for one in result.algorithms for response in one.contrast_responses):
        note = (
            "Displayed contrast of the triangle after each algorithm against that before it, a line for each "
            "group; bars: two standard errors. A plain gain is parallel to the grey line, which changes nothing."
        )
        draw = partial(draw_responses, algorithms=result.algorithms)
        found.append(ReportFigure("Contrast before and after", note, draw, "contrast_response.png"))
    everything = result.thresholds
    alone = bool(result.fits)
    if has_tod_curve(everything):
        file = "tod_curve.png" if alone else ""
        found.append(ReportFigure("TOD curve", _tod_note(everything), partial(draw_tod, fits=everything), file))
    for number, (label, of_map) in enumerate(evenly(list(by_field_map(result.fits).items()), MOST_MAPS)):
        draw = partial(draw_field_map, fits=of_map)
        file = "" if number else "field_map.png"
        found.append(ReportFigure(f"Map of the field{label}", _field_note(of_map), draw, file))
    of_algorithms = ((f"Psychometric functions: {one.name}", one.fits, "") for one in result.algorithms)
    for title, fits, file in (("Psychometric functions", result.fits, "psychometric.png"), *of_algorithms):
        seen = [fit for fit in fits if fit.points]
        if seen:
            guesses = "; dotted: the guess rate" if seen[0].guess_rate is not None else ""
            note = f"Proportion correct against {level_name(seen[0].level)}; dashed: the criterion{guesses}."
            if len(seen) > MOST_CURVES:
                note += f" {MOST_CURVES} of {len(seen)} curves are drawn."
            found.append(ReportFigure(title, note, partial(draw_psychometric, fits=seen), file))
    for scene in result.scenes:
        if scene_runs(scene):
            note = (
                "Error of the threshold against CPU time, a line for each way to compute it. "
                "Grey: below the error of the converged value."
            )
            draw = partial(draw_errors, scene=scene)
            found.append(ReportFigure(scene.heading, note, draw, f"accuracy_{scene.name}.png"))
    return found


def _of_persons(result: ResultData) -> list[ReportFigure]:
    """List the figures of people's curves and those of the models that were fitted to them."""
    found = []
    if has_tod_curve(result.fits):
        note = _tod_note(result.fits) + " Symbols: the person, by the counts alone; lines: the fitted model."
        found.append(ReportFigure("Person and model", note, partial(draw_persons, result=result)))
    for one in result.persons:
        fits = with_model_curves(result, one.subject)
        if fits:
            lapses = " without lapses" if one.lapse_rate else ""
            note = f"Proportion correct against {level_name(fits[0].level)}; curves: the fitted model{lapses}."
            found.append(ReportFigure(f"Answers of {one.subject}", note, partial(draw_psychometric, fits=fits)))
    return [found[0]._replace(file="calibration.png"), *found[1:]] if found else []


def _tod_note(fits: Sequence[Fit]) -> str:
    first = fits[0]
    note = f"Threshold {level_name(first.level)} at {100 * first.p_correct:g} % correct against 1 / size."
    note += " Filled: within the levels shown; open: extrapolated." if any(fit.n_trials for fit in fits) else ""
    intervals = [fit.threshold_ci95 for fit in fits if fit.threshold_ci95 is not None]
    if intervals:
        open_ended = any(None in interval for interval in intervals)
        note += f" Vertical lines are 95 % intervals{', dotted where the data leave an end open' * open_ended}."
    return note


def by_field_map(fits: Sequence[Fit]) -> dict[str, list[Fit]]:
    """Return the fits of each map of the field, by a title: those of a chart at two or more places of the picture.

    Fits of one map differ in their places alone.
    """
    maps: dict[str, list[Fit]] = {}
    for fit in fits:
        if all(isinstance(fit.group.get(name), float) for name in FIELD_AXES):
            others = {name: value for name, value in fit.group.items() if name not in FIELD_AXES}
            maps.setdefault(f" at {group_phrase(others)}" if others else "", []).append(fit)
    return {
        label: of_map
        for label, of_map in maps.items()
        if len({_field_place(fit) for fit in of_map}) > 1 and any(fit.threshold is not None for fit in of_map)
    }


def _field_place(fit: Fit) -> tuple[float, float]:
    x, y = (float(fit.group[name]) for name in FIELD_AXES)
    return x, y


def _field_note(fits: Sequence[Fit]) -> str:
    first = fits[0]
    note = (
        f"Threshold {level_name(first.level)} at {100 * first.p_correct:g} % correct and its 95 % interval, where "
        "the chart was in the picture, with down as in the picture. The cross is the frame's middle."
    )
    if any(fit.status == "extrapolated" for fit in fits):
        note += " A dashed rim: extrapolated."
    if any(fit.threshold is None for fit in fits):
        note += " Without a disc: no threshold, and why."
    return note


def draw_field_map(axes: Axes, fits: Sequence[Fit]) -> None:
    """Draw thresholds over the field of a camera: a disc and its numbers at each place, equal angles equally long.

    At least one fit must have a threshold, and two must have different places.
    """
    places = np.array([_field_place(fit) for fit in fits])
    known = [fit.threshold for fit in fits if fit.threshold is not None]
    steps = np.abs(places[:, None] - places[None, :])
    steps = steps[steps.any(axis=2)]
    margin = 0.6 * np.linalg.norm(steps, axis=1).min()
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.set(xlabel="right of the frame's middle (mrad)", ylabel="below the frame's middle (mrad)")
    axes.plot(0.0, 0.0, "+", color=INK, markersize=12.0, alpha=0.5, zorder=1)
    # The colour bar, titles and ticks leave about 0.7 of the width and 0.75 of the height.
    page_inches = np.array([axes.figure.bbox.width, axes.figure.bbox.height]) / axes.figure.dpi
    inches_per_mrad = float((page_inches * (0.7, 0.75) / (high - low)).min())
    room = 72.0 * inches_per_mrad * (steps / FIELD_LABEL_EM).max(axis=1).min()
    points = float(np.clip(room, *FIELD_LABEL_POINTS))
    has = [fit.threshold is not None for fit in fits]
    # The scale spans the intervals, so that colours differ no more than the thresholds are known.
    ends = [end for fit in fits if fit.threshold_ci95 is not None for end in fit.threshold_ci95 if end is not None]
    drawn = axes.scatter(
        places[has, 0], places[has, 1], c=known, s=(3.0 * points) ** 2, norm=colour_scale(np.array(known + ends)),
        cmap="viridis_r", edgecolors=INK, linewidths=0.8, zorder=2,
        linestyles=["--" if fit.status == "extrapolated" else "-" for fit in fits if fit.threshold is not None],
    )  # fmt: skip
    for (x, y), fit in zip(places.tolist(), fits, strict=True):
        if fit.threshold is None:
            marker = NO_THRESHOLD_MARKERS.get(fit.status, "+")
            axes.plot(x, y, marker, color=INK, markersize=2.0 * points, zorder=2)
            text = fit.status.replace("_", " ")
        else:
            interval = "" if fit.threshold_ci95 is None else f"\n{interval_phrase(fit.threshold_ci95)}"
            text = f"{plain(fit.threshold)}{interval}"
        axes.annotate(
            text, (x, y), (0.0, -1.7 * points), textcoords="offset points", ha="center", va="top", fontsize=points
        )
    add_colour_bar(axes, drawn, threshold_heading(fits[0].level))


def has_tod_curve(fits: Sequence[Fit]) -> bool:
    """Return whether there is a column of sizes, and a threshold at two sizes at least."""
    size = size_column(fits)
    return size is not None and len({fit.group[size] for fit in fits if fit.threshold is not None}) >= 2


def draw_tod(axes: Axes, fits: Sequence[Fit]) -> None:
    """Draw the TOD curve of fits that have one: threshold against size, with intervals, and ΔT if it is known."""
    name = size_column(fits)
    assert name is not None
    size, unit = quantity(name), unit_of(name)
    curves = list(by_curve([fit for fit in fits if fit.threshold is not None]).items())[:MOST_CURVES]
    of_algorithm = _styles(dict.fromkeys(fit.group.get("algorithm") for fit in fits))
    _label_tod_axes(axes, name, fits[0].level)
    drawn = []
    for number, (label, curve) in enumerate(curves):
        line_style = curve_style(number, len(curves))
        if len(of_algorithm) > 1:
            own = of_algorithm[curve[0].group.get("algorithm")]
            line_style = own if len(curves) <= len(of_algorithm) else line_style._replace(colour=own.colour)
        drawn += _draw_tod_curve(axes, curve, name, label, line_style)
    if 1 < len(curves) <= MOST_IN_LEGEND:
        add_legend(axes)
    inverse = sorted({place.x for place in drawn})
    plain_ticks(axes.xaxis, inverse)
    plain_ticks(axes.yaxis, [place.threshold for place in drawn])
    _draw_open_ends(axes, drawn)
    top = axes.secondary_xaxis("top")
    top.set_xlabel(label_text(f"{size} ({unit})"))
    named = evenly(inverse, MOST_SIZES_NAMED)
    top.set_xticks(named, [f"{1.0 / x:g}" for x in named])
    top.minorticks_off()
    _temperature_axis(axes, drawn)


def _styles(algorithms: Collection[object]) -> dict[object, CurveStyle]:
    """Return the style of each algorithm by its name: one for all figures, with the reference and without it."""
    return {name: curve_style(number, len(algorithms)) for number, name in enumerate(algorithms)}


class _Place(NamedTuple):
    """A threshold in the figure of a TOD curve."""

    x: float
    threshold: float
    fit: Fit


def draw_persons(axes: Axes, result: ResultData) -> None:
    """Draw the thresholds of each person against size, with intervals; lines are those of the fitted model."""
    size = size_column(result.fits)
    assert size is not None
    shown = own_and_model(result)
    persons = result.persons[:MOST_CURVES]
    places: list[_Place] = []
    curves: list[tuple[float, float]] = []
    for number, one in enumerate(persons):
        line_style = curve_style(number, len(persons))
        of_person = [pair for pair in shown if pair[0].group[SUBJECT] == one.subject]
        own = [fit for fit, _ in of_person]
        places += _draw_tod_curve(axes, own, size, str(one.subject), line_style, line="")
        curve = sorted(
            (1.0 / within(float(model.group[size])), within(model.threshold))
            for _, model in of_person
            if model is not None and model.threshold is not None
        )
        if curve:
            axes.plot(*zip(*curve, strict=True), color=line_style.colour, zorder=2)
        curves += curve
    _label_tod_axes(axes, size, result.fits[0].level)
    plain_ticks(axes.xaxis, [place.x for place in places] + [x for x, _ in curves])
    plain_ticks(axes.yaxis, [place.threshold for place in places] + [threshold for _, threshold in curves])
    _draw_open_ends(axes, places)
    if 1 < len(persons) <= MOST_IN_LEGEND:
        add_legend(axes)


def _label_tod_axes(axes: Axes, name: str, level: str) -> None:
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=label_text(f"1 / {quantity(name)} ({unit_of(name)}⁻¹)"),
        ylabel=label_text(threshold_heading(level)),
    )


def _draw_tod_curve(
    axes: Axes, fits: Sequence[Fit], name: str, label: str, line_style: CurveStyle, *, line: str = "-"
) -> list[_Place]:
    places = [
        _Place(1.0 / within(float(fit.group[name])), within(fit.threshold), fit)
        for fit in fits
        if fit.threshold is not None
    ]
    style_of_points: Json = {"color": line_style.colour, "marker": line_style.marker}
    x, thresholds = [place.x for place in places], [place.threshold for place in places]
    axes.plot(x, thresholds, label=label_text(label), zorder=2, ls=line, **style_of_points)
    for place in places:
        low, high = place.fit.threshold_ci95 or (None, None)
        if low is not None or high is not None:
            ends = [within(end or place.threshold) for end in (low, high)]
            axes.plot([place.x] * 2, ends, "-_", color=line_style.colour)
        if place.fit.status == "extrapolated":
            axes.plot(place.x, place.threshold, **style_of_points, markerfacecolor=PAPER, zorder=3)
    return places


def _draw_open_ends(axes: Axes, places: Sequence[_Place]) -> None:
    """Draw dots from a threshold to the edge of the figure if the data leave that end of the interval open."""
    edges = axes.get_ylim()
    for place in places:
        for end, edge in zip(place.fit.threshold_ci95 or (), edges, strict=False):
            if end is None:
                axes.plot([place.x] * 2, [place.threshold, edge], ":", color=INK, alpha=0.6, lw=1.0, zorder=1)
    axes.set_ylim(edges)


def _temperature_axis(axes: Axes, places: Sequence[_Place]) -> None:
    """Add an axis of ΔT on the right, which is proportional to SNR by one factor for all thresholds."""
    factors = [place.fit.delta_t_mk / place.threshold for place in places if place.fit.delta_t_mk]
    if len(factors) < len(places) or min(factors) <= 0.0:
        return
    factor = float(np.median(factors))

    def to_temperature(snr: Any) -> Any:
        return snr * factor

    def to_snr(temperature: Any) -> Any:
        return temperature / factor

    right = axes.secondary_yaxis("right", functions=(to_temperature, to_snr))
    right.set_ylabel("ΔT (mK)")
    plain_ticks(right.yaxis, [place.threshold * factor for place in places])


def draw_psychometric(axes: Axes, fits: Sequence[Fit]) -> None:
    """Draw proportion correct against level: points, fitted curves, criterion and guess rate.

    At least one fit must have points; fits without points are left out.
    """
    fits = evenly([fit for fit in fits if fit.points], MOST_CURVES)
    levels = [within(point.level) for fit in fits for point in fit.points]
    for number, fit in enumerate(fits):
        _draw_psychometric_curve(axes, fit, curve_style(number, len(fits)))
    for height, line in ((fits[0].p_correct, "--"), (fits[0].guess_rate, ":")):
        if height is not None:
            axes.axhline(height, color=INK, alpha=0.6, ls=line, lw=0.8)
    axes.set(
        xscale="log",
        ylim=(0.0, 1.02),
        xlabel=label_text(level_heading(fits[0].level)),
        ylabel="proportion correct",
    )
    if levels and min(levels) < max(levels):
        plain_ticks(axes.xaxis, levels)
    if len(fits) <= MOST_IN_LEGEND:
        add_legend(axes)


def fitted_curve(fit: Fit) -> Callable[[FloatArray], FloatArray] | None:
    """Return the curve that the threshold was read from, a function of the level; None if none was fitted."""
    own = fit.observer_curve
    if own is not None:
        return partial(observer_curve, alpha=own.alpha, beta=own.beta, max_d_prime=own.max_d_prime)
    if fit.curve == "observer" or fit.alpha is None or fit.beta is None:
        return None
    return partial(
        weibull, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate or 0.0, lapse_rate=fit.lapse_rate or 0.0
    )


def _draw_psychometric_curve(axes: Axes, fit: Fit, line_style: CurveStyle) -> None:
    x = [within(point.level) for point in fit.points]
    trials = [point.n_trials for point in fit.points]
    axes.scatter(
        x,
        [point.p_correct for point in fit.points],
        s=[24.0 if len(set(trials)) == 1 else 10.0 + 34.0 * n / max(trials) for n in trials],
        color=line_style.colour,
        marker=line_style.marker,
        linewidths=0.0,
        label=label_text(group_phrase(fit.group)),
    )
    curve = fitted_curve(fit)
    if x and curve is not None:
        level = np.geomspace(min(x), max(x), 100)
        axes.plot(level, curve(level), color=line_style.colour)
    elif len(x) > 1 and not any(trials):
        axes.plot(
            x, [point.p_correct for point in fit.points], color=line_style.colour
        )  # computed, with no error to fit


def draw_ratios(axes: Axes, algorithms: Sequence[Algorithm]) -> None:
    """Draw thresholds divided by the reference's, by algorithm and group; filled if a difference is shown."""
    others = [one for one in algorithms if one.ratios][:MOST_IN_LEGEND]
    compared = [{_ratio_label(ratio): ratio for ratio in (*one.ratios, one.overall) if ratio} for one in others]
    labels = list(dict.fromkeys(label for ratios in compared for label in ratios))[:MOST_CURVES]
    styles = _styles([one.name for one in algorithms])
    axes.set_yscale("log")
    for number, (one, ratios) in enumerate(zip(others, compared, strict=True)):
        line_style, shift = styles[one.name], 0.6 * ((number + 0.5) / len(others) - 0.5)
        points: Json = {"color": line_style.colour, "marker": line_style.marker, "ls": ""}
        axes.plot([], [], label=label_text(one.name), **points)
        for place, label in enumerate(labels):
            ratio = ratios.get(label)
            if ratio is None or ratio.ratio is None:
                continue
            ends = [within(end or ratio.ratio) for end in ratio.ratio_ci95 or (None, None)]
            axes.plot(
                [place + shift] * 2,
                ends,
                ":" if None in (ratio.ratio_ci95 or ()) else "-",
                color=line_style.colour,
            )
            shown = ratio.verdict in ("better", "worse")
            face = line_style.colour if shown else PAPER
            axes.plot(place + shift, within(ratio.ratio), **points, markerfacecolor=face)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.set(ylabel="threshold ÷ that of the reference", xlim=(-0.5, max(len(labels), 1) - 0.5))
    rotation = 20 if len(labels) > 5 else 0
    axes.set_xticks(range(len(labels)), [label_text(label) for label in labels], rotation=rotation)
    axes.tick_params(axis="x", length=0)
    axes.grid(False, axis="x")
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def _has_contrasts(response: ContrastResponse) -> bool:
    """Return whether the contrast before an algorithm rises with the level: not if the level is an SNR.

    It counts as rising if it does by more than the square root of what the level does.
    """
    points = [point for point in response.points if point.before > 0.0]
    if not points:
        return False
    first, last = points[0], points[-1]
    return len(response.points) == 1 or last.before / first.before > math.sqrt(last.level / first.level)


def draw_responses(axes: Axes, algorithms: Sequence[Algorithm]) -> None:
    """Draw the displayed contrast of the triangle after each algorithm against that before it, on log axes."""
    others = [one for one in algorithms if one.contrast_responses][:MOST_IN_LEGEND]
    axes.set_xscale("log")
    axes.set_yscale("log")
    styles = _styles([one.name for one in algorithms])
    ends: list[float] = []
    for one in others:
        line_style = styles[one.name]
        style: Json = {"color": line_style.colour, "marker": line_style.marker, "ms": 4}
        axes.plot([], [], label=label_text(one.name), **style)
        for response in one.contrast_responses[:MOST_CURVES]:
            points = [point for point in response.points if point.before > 0.0 and point.after > 0.0]
            before, after = ([within(getattr(point, key)) for point in points] for key in ("before", "after"))
            errors = [2.0 * (point.gain_standard_error or 0.0) * point.before for point in points]
            axes.errorbar(before, after, yerr=errors, lw=1.0, elinewidth=0.8, **style)
            ends += before
    if ends:
        axes.plot([min(ends), max(ends)], [min(ends), max(ends)], color=INK, alpha=0.4, lw=0.8, zorder=0)
    axes.set(xlabel="displayed contrast before", ylabel="displayed contrast after")
    plain_ticks(axes.xaxis, axes.get_xlim())
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def _ratio_label(ratio: Ratio) -> str:
    return group_phrase(ratio.group) if ratio.group else "all groups"


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
    if scene.threshold and scene.threshold_bound and scene.threshold_bound / scene.threshold > bottom:
        axes.axhspan(bottom, scene.threshold_bound / scene.threshold, color=INK, alpha=0.08, lw=0.0, zorder=0)
        axes.set_ylim(bottom=bottom)
    for ratio in scene.speed_ratios:
        if ratio.ratio is not None:
            text = f"{'≥ ' * ratio.at_least}{plain(ratio.ratio, 2)} times less CPU"
            text += ", extrapolated" * ratio.extrapolated
            axes.axhline(ratio.threshold_error, color=INK, alpha=0.6, ls="--", lw=0.8, zorder=0)
            place, units = (0.02, ratio.threshold_error), ("axes fraction", "data")
            axes.annotate(
                text,
                place,
                (0, 2),
                xycoords=units,
                textcoords="offset points",
                fontsize="small",
            )
    if len(runs) <= MOST_IN_LEGEND:
        add_legend(axes)


Runs = dict[str, list[tuple[float, float]]]


def scene_runs(scene: SceneResult) -> Runs:
    """Return CPU time and relative threshold error at each budget of each estimator, if both are above 0."""
    runs = {
        one.title: [
            (float(point["cpu_s"]), float(point["threshold_error"]))
            for point in one.points
            if _is_positive(point.get("cpu_s")) and _is_positive(point.get("threshold_error"))
        ]
        for one in scene.estimators
    }
    return {title: pairs for title, pairs in runs.items() if pairs}


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and value > 0
