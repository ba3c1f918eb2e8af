"""Numbers, groups and lists in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from todframes.report.result import (
    Group,
    T,
)

if TYPE_CHECKING:
    pass


def number(value: float | None, digits: int = 4) -> str:
    """A number for a person: so many significant digits, a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """An interval for a person; an open end is shown as such."""
    if bounds is None:
        return "–"
    low, high = ("?" if bound is None else number(bound) for bound in bounds)
    return f"{low} – {high}"


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most so many of the items, the first and the last among them and the others evenly between."""
    if len(items) <= most:
        return list(items)
    return [items[round(place * (len(items) - 1) / (most - 1))] for place in range(most)]


SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float | None, digits: int = 3) -> str:
    """A number for a person: so many significant digits, no exponent where it can do without; a dash for None."""
    if value is None or value == 0.0:
        return "–" if value is None else "0"
    text = f"{value:#.{digits}g}"
    if "e" not in text:
        return text.removesuffix(".")
    if 1.0 <= abs(value) < 1e6:
        return f"{float(text):.0f}"
    mantissa, _, exponent = text.partition("e")
    return f"{mantissa.removesuffix('.')} × 10{str(int(exponent)).translate(SUPERSCRIPT)}"


def phrase(name: str, value: float | str) -> str:
    """A column and its value in words: "0.6 mrad" of a size, "camera left" of anything else."""
    shown = f"{value:.15g}" if isinstance(value, float) else value
    if name.startswith("size_") and isinstance(value, float):
        return f"{shown} {name.removeprefix('size_')}"
    return shown if name == "algorithm" else f"{name} {shown}"


def group_phrase(group: Group, without: str | None = None) -> str:
    """A group in words, but for one column; "all trials" if nothing is left."""
    return ", ".join(phrase(name, value) for name, value in group.items() if name != without) or "all trials"


def level_name(level: str) -> str:
    """What a stimulus strength is called in a sentence."""
    return {"snr": "SNR", "size_mrad": "size"}.get(level, level)


def interval_phrase(bounds: tuple[float | None, float | None]) -> str:
    """An interval in words; an open end is said to be open."""
    low, high = bounds
    if low is None or high is None:
        return f"from {plain(low)}, open above" if low is not None else f"open below, to {plain(high)}"
    return f"{plain(low)} to {plain(high)}"


def listed(parts: Iterable[str]) -> str:
    """Some things in words, with "and" before the last."""
    *most, last = parts
    return f"{', '.join(most)} and {last}" if most else last


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def group_label(group: Mapping[str, float | str]) -> str:
    """A group in a few words."""
    return ", ".join(
        f"{name} {value:.15g}" if isinstance(value, float) else f"{name} {value}" for name, value in group.items()
    )


def _groups(groups: Sequence[Mapping[str, float | str]]) -> str:
    """Groups in a few words: "size_mrad 1.5, 2.5"."""
    if not groups or not groups[0]:
        return ""
    if len(groups[0]) == 1:
        (name,) = groups[0]
        return f"{name} {', '.join(value_text(group[name]) for group in groups)}"
    return "; ".join(", ".join(f"{name} {value_text(value)}" for name, value in group.items()) for group in groups)


def value_text(value: float | str) -> str:
    """A group's value for a person."""
    return f"{value:.15g}" if isinstance(value, float) else value
