"""Results as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

Json = dict[str, Any]


def number(value: float | None, digits: int = 4) -> str:
    """A number for a person: so many significant digits, a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """An interval for a person; an open end is shown as such."""
    if bounds is None:
        return "–"
    low, high = ("?" if bound is None else number(bound) for bound in bounds)
    return f"{low} – {high}"


def threshold_table(result: Json, title: str) -> Table:
    """The thresholds of a result as a table for the terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    fits = result["fits"]
    # Text, not str: names are data, and rich would take brackets in them for markup.
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    names = list(fits[0]["group"]) if fits else []
    for name in names:
        table.add_column(Text(name), justify="right", no_wrap=True)
    level = fits[0]["level"] if fits else "level"
    numerical = any("threshold_numerical_error" in fit for fit in fits)
    warm = any("delta_t_mk" in fit for fit in fits)
    timed = any("run_time_s" in fit for fit in fits)
    displaced = any(fit.get("threshold_displacement_error") is not None for fit in fits)
    headers = [f"threshold {level}", "numerical error" if numerical else "95 % interval", "status"]
    headers += (["ΔT (mK)"] if warm else []) + ([] if numerical else ["α", "β", "δ", "trials"])
    headers += (["displacement error"] if displaced else []) + (["time (s)"] if timed else [])
    for header in headers:
        table.add_column(Text(header), justify="left" if header == "status" else "right", no_wrap=True)
    for fit in fits:
        cells = [f"{value:.15g}" if isinstance(value, float) else str(value) for value in fit["group"].values()]
        cells.append(number(fit["threshold"]))
        if numerical:
            error = fit["threshold_numerical_error"]
            cells += ["–" if error is None else f"± {error:.1g}", fit["status"]]
            cells += [number(fit["delta_t_mk"])] if warm else []
        else:
            cells += [interval(fit["threshold_ci95"]), fit["status"]]
            cells += [number(fit[name], 3) for name in ("alpha", "beta", "delta")] + [str(fit["n_trials"])]
        cells += [f"± {number(fit['threshold_displacement_error'], 2)}"] if displaced else []
        cells += [number(fit["run_time_s"], 2)] if timed else []
        table.add_row(*map(Text, cells))
    return table


def plan_table(result: Json) -> Table:
    """What was kept and left out for each threshold of a result, as a table for the terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Plan", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for header in ("group", "stage", "", "why", "bound on P", "saves (s)"):
        table.add_column(Text(header), justify="right" if header in ("bound on P", "saves (s)") else "left")
    plans = [(fit["group"], fit["plan"]) for fit in result["fits"] if "plan" in fit]
    for group, plan in plans or [({}, result["plan"])]:
        label = ", ".join(f"{name} {value}" for name, value in group.items())
        for step in plan:
            kept, bound = step["kept"], step["bound"]
            numbers = ["", ""] if kept else [number(bound, 2) if bound else "0", number(step["saves_s"], 2)]
            table.add_row(
                *map(Text, [label, step["stage"], "kept" if kept else "left out", step["why"], *numbers])
            )
            label = ""
    return table
