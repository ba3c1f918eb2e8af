"""Results as tables for the terminal."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from todframes.safe_text import visible

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

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


def new_table(title: str, headers: Iterable[str], left: Container[int] = ()) -> Table:
    """A table for the terminal without rows yet; columns are justified to the right but for those at `left`."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=_shown(title) if title else None, title_justify="left", title_style="bold", box=SIMPLE_HEAD
    )
    for place, header in enumerate(headers):
        table.add_column(_shown(header), justify="left" if place in left else "right", no_wrap=True)
    return table


def add_row(table: Table, cells: Iterable[str]) -> None:
    """A row more."""
    table.add_row(*map(_shown, cells))


def _shown(text: str) -> Text:
    """Text as rich shows it: str, with names that are data in it, it would search for markup."""
    from rich.text import Text

    return Text(visible(text))


def threshold_table(result: Json, title: str) -> Table:
    """The thresholds of a result as a table for the terminal."""
    fits = result["fits"]
    names = list(fits[0]["group"]) if fits else []
    level = fits[0]["level"] if fits else "level"
    numerical = any("threshold_numerical_error" in fit for fit in fits)
    warm = any("delta_t_mk" in fit for fit in fits)
    timed = any("run_time_s" in fit for fit in fits)
    displaced = any(fit.get("threshold_displacement_error") is not None for fit in fits)
    headers = [*names, f"threshold {level}", "numerical error" if numerical else "95 % interval", "status"]
    headers += (["ΔT (mK)"] if warm else []) + ([] if numerical else ["α", "β", "δ", "trials"])
    headers += (["displacement error"] if displaced else []) + (["time (s)"] if timed else [])
    table = new_table(title, headers, left={len(names) + 2})
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
        add_row(table, cells)
    return table


def plan_table(result: Json) -> Table:
    """What was kept and left out for each threshold of a result, as a table for the terminal."""
    table = new_table("Plan", ("group", "stage", "", "why", "bound on P", "saves (s)"), left=range(4))
    plans = [(fit["group"], fit["plan"]) for fit in result["fits"] if "plan" in fit]
    for group, plan in plans or [({}, result["plan"])]:
        label = ", ".join(f"{name} {value}" for name, value in group.items())
        for step in plan:
            kept, bound = step["kept"], step["bound"]
            numbers = ["", ""] if kept else [number(bound, 2) if bound else "0", number(step["saves_s"], 2)]
            add_row(table, [label, step["stage"], "kept" if kept else "left out", step["why"], *numbers])
            label = ""
    return table
