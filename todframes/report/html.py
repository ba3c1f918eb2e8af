"""A result → one HTML page that needs nothing else: words, figures, pictures, tables.

The page is made from the result alone, so the same result gives the same bytes.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import msgspec

from todframes._typing import Json
from todframes.report import figures
from todframes.report import tables as report_tables
from todframes.report.figure_style import style
from todframes.report.result import Algorithm, Example, Fit, Record, Result, Thumbnail, read_result
from todframes.report.summary import verdict
from todframes.report.svg import inline_svg
from todframes.report.tables import scene_runs, scene_tables
from todframes.report.wording import group_phrase, level_name, plain

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure


MOST_FIGURES = 12


TITLES = {
    "score": "TOD thresholds of display frames",
    "curve": "TOD curve of a sensor",
    "naked-eye": "Thresholds of the naked eye",
    "fit": "Fitted psychometric functions",
    "compare": "Enhancements compared",
    "accuracy": "Error against run time",
}


_HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
"""What HTML does not allow, and what would turn the direction of the text beside it."""


def report_html(result: Json) -> bytes:
    """The page of a result, the object that `--json` prints.

    Raises
    ------
    DataError
        If the result lacks what a report cannot do without, or a value is of the wrong kind.
    """
    return page(read_result(msgspec.json.encode(result), "result"))


def page(result: Result) -> bytes:
    """The page of a result that has been read back, in UTF-8."""
    content = {
        "title": TITLES[result.command],
        "about": _about(result),
        "warnings": [warning.message for warning in result.warnings],
        "verdict": verdict(result),
        "figures": _figures(result),
        "tables_shown": _tables(result),
        "examples": _examples(result.examples),
        "remarks": _remarks(result),
        "details": _details(result),
        "version": result.version,
    }
    return _environment().get_template("report.html.j2").render(content).encode()


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("todframes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: _shown(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(text: str) -> str:
    return _HIDDEN.sub("\ufffd", text)


def _about(result: Result) -> str:
    """What was looked at: the dataset, or the sensor by its name."""
    sensor = result.settings.get("sensor")
    name = sensor.get("name") if isinstance(sensor, dict) else None
    return str(result.dataset or name or "")


def _figures(result: Result) -> list[Json]:
    with style():
        return [
            {
                "svg": inline_svg(figure, name=f"figure-{number}", label=_shown(f"{title}. {note}")),
                "title": title,
                "note": note,
            }
            for number, (figure, title, note) in enumerate(_drawn(result)[:MOST_FIGURES], 1)
        ]


def _drawn(result: Result) -> list[tuple[Figure, str, str]]:
    """Figures with title and a note on what they show."""
    drawn = []
    if any(one.ratios for one in result.algorithms):
        note = "Below 1 the algorithm helps. Filled: a difference is shown. Lines are 95 % intervals."
        drawn.append((figures.ratio_figure(result.algorithms), "Thresholds with and without", note))
    everything = [*result.fits, *(fit for one in result.algorithms for fit in _named_fits(one))]
    if figures.has_tod_curve(everything):
        drawn.append((figures.tod_figure(everything), "TOD curve", _tod_note(everything)))
    for title, fits in [
        ("Psychometric functions", result.fits),
        *((f"Psychometric functions: {one.name}", one.fits) for one in result.algorithms),
    ]:
        seen = [fit for fit in fits if fit.points]
        if seen:
            note = f"Proportion correct against {level_name(seen[0].level)}; dashed: the criterion."
            if len(seen) > figures.MOST_CURVES:
                note += f" {figures.MOST_CURVES} of {len(seen)} curves are drawn."
            drawn.append((figures.psychometric_figure(seen), title, note))
    for scene in result.scenes:
        if runs := scene_runs(scene):
            note = "Error of the threshold against CPU time, a line for each way to compute it."
            figure = figures.error_figure(runs, x="CPU time (s)", y="relative error of the threshold")
            drawn.append((figure, scene.heading, note))
    return drawn


def _named_fits(algorithm: Algorithm) -> list[Fit]:
    """The fits of an algorithm, which is one of their groups."""
    return [
        msgspec.structs.replace(fit, group={"algorithm": algorithm.name} | fit.group) for fit in algorithm.fits
    ]


def _tod_note(fits: Sequence[Fit]) -> str:
    note = f"Threshold {level_name(fits[0].level)} at {100 * fits[0].p_correct:g} % correct against 1 / size."
    intervals = [fit.threshold_ci95 for fit in fits if fit.threshold_ci95 is not None]
    if intervals:
        open_ended = any(None in interval for interval in intervals)
        note += f" Vertical lines are 95 % intervals{', dotted where the data leave an end open' * open_ended}."
    if any(fit.status == "extrapolated" for fit in fits):
        note += " Open points are extrapolated."
    return note


def _tables(result: Result) -> list[Json]:
    """The tables under the figures; `folded` ones are opened by hand."""
    found: list[Json] = []
    if result.algorithms:
        found += [{"table": report_tables.ratios(result.algorithms), "folded": False}]
        found += [{"table": report_tables.measures(result.algorithms), "folded": False}]
    if result.fits or any(one.fits for one in result.algorithms):
        found.append({"table": report_tables.thresholds(result), "folded": bool(result.algorithms)})
    points = report_tables.points(result)
    found += [{"table": points, "folded": True}] if points is not None else []
    for number, scene in enumerate(result.scenes, 1):
        found += [{"table": one, "folded": bool(n)} for n, one in enumerate(scene_tables(scene, number))]
    return found


def _examples(examples: Sequence[Example]) -> list[Json]:
    """Examples by group, a row of pictures for each algorithm where there are several."""
    groups: dict[str, Json] = {}
    for one in examples:
        label = group_phrase(one.group)
        groups.setdefault(label, {"label": label, "rows": []})["rows"].append(
            {"algorithm": one.algorithm or "", "about": _about_example(one), "tiles": [*map(_tile, one.pictures)]}
        )
    return list(groups.values())


def _about_example(one: Example) -> str:
    parts = [
        f"apex {one.orientation}" if one.orientation else "",
        f"{level_name(one.level)} {plain(one.strength)}" if one.strength is not None else "",
        f"P(correct) {plain(one.p_correct, 2)}" if one.p_correct is not None else "",
        f"{plain(one.width_mrad)} mrad wide" if one.width_mrad is not None else "",
        f"mean of {one.n_frames} frames" if one.n_frames > 1 else "",
        one.frame or "",
    ]
    return ", ".join(part for part in parts if part)


def _tile(picture: Thumbnail) -> Json:
    scale = ""
    if picture.scale is not None and picture.name == "display":
        scale = f"white: {plain(1.0 + picture.scale)} × background"
    elif picture.scale is not None:
        scale = f"white: {plain(picture.scale, 2)}"
    names = {"display": "as displayed", "retina": "on the retina"}
    return {
        "source": "data:image/png;base64," + base64.b64encode(picture.png).decode(),
        "width": int.from_bytes(picture.png[16:20]),
        "height": int.from_bytes(picture.png[20:24]),
        "name": names.get(picture.name, picture.name),
        "scale": scale,
        "large": picture.name == "display",
    }


def _remarks(result: Result) -> list[str]:
    """Run time and error."""
    fits = [*result.fits, *(fit for one in result.algorithms for fit in one.fits)]
    told = [f"Run time {plain(result.run_time_s)} s."] if result.run_time_s is not None else []
    relative = [
        fit.threshold_numerical_error / fit.threshold
        for fit in fits
        if fit.threshold is not None and fit.threshold_numerical_error is not None
    ]
    if relative:
        told.append(f"Numerical error of the thresholds: {plain(100 * max(relative), 2)} % at most.")
    bound = max((fit.p_correct_error_bound or 0.0 for fit in fits), default=0.0)
    if bound:
        told.append(f"P(correct) is right within {plain(bound, 1)}, as the summed noise is not quite Gaussian.")
    apart = [
        100 * abs(fit.points_threshold / fit.threshold - 1)
        for fit in fits
        if fit.threshold is not None and fit.points_threshold is not None
    ]
    if max(apart, default=0.0) >= 1.0:
        told.append(
            f"The points themselves cross the criterion up to {plain(max(apart), 2)} % away from the fitted "
            "curve; the intervals cover both."
        )
    if result.negative_luminance_pixels:
        told.append(f"{result.negative_luminance_pixels} display pixels have a luminance below zero.")
    return told


def _details(result: Result) -> list[Json]:
    """How it was made, as tables to open by hand."""
    plan = result.plan + [dict(fit.group) | step for fit in result.fits for step in fit.plan]
    records: list[tuple[str, str, list[Record], bool]] = [
        ("Frames left out", "skipped.csv", result.skipped, False),
        ("Positions found", "located.csv", result.located, True),
        ("Plan: what was computed and what was left out", "plan.csv", plan, True),
    ]
    found = [
        {"table": report_tables.records_table(caption, file, rows), "folded": folded}
        for caption, file, rows, folded in records
        if rows
    ]
    return [*found, {"table": report_tables.settings(result), "folded": True}]
