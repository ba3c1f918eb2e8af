"""Conversion of numbers, groups and lists to words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from todframes.stimulus import level_of

T = TypeVar("T")

SIZE_DIGITS = 4
"""Significant digits of sizes for a reader."""

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

FIELD_AXES = {"object_x_mrad": "x", "object_y_mrad": "y"}
"""Names of the places of a chart in the camera's field, by column; the unit is mrad."""

OF_UNIT = {name: (f"object {axis}", "mrad", f"{axis} ") for name, axis in FIELD_AXES.items()}
OF_UNIT["luminance_cd_m2"] = ("luminance", "cd/m²", "")
"""Words and unit of columns besides those of sizes, and what stands before a value."""


def subsample(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` of the items, evenly spaced, with the first and the last."""
    if len(items) <= most:
        return list(items)
    return [items[round(number * (len(items) - 1) / (most - 1))] for number in range(most)]


def plain(value: float | None, digits: int = 3) -> str:
    """Return a number for a reader: `digits` significant digits, an exponent only if needed; a dash for None."""
    if value is None or value == 0.0:
        return "–" if value is None else "0"
    if value < 0.0:
        return f"−{plain(-value, digits)}"
    text = f"{value:#.{digits}g}"
    if "e" not in text:
        return text.removesuffix(".")
    if 1.0 <= abs(value) < 1e6:
        return f"{float(text):.0f}"
    mantissa, _, exponent = text.partition("e")
    return f"{mantissa.removesuffix('.')} × 10{str(int(exponent)).translate(SUPERSCRIPT)}"


def percent_below(share: float, criterion: float) -> str:
    """Return a share in per cent with as many decimals as show that it is below a criterion, if it is."""
    texts = [f"{100.0 * share:.{decimals}f}" for decimals in range(16)]
    return next((text for text in texts if float(text) < 100.0 * criterion), texts[0])


def value_text(value: float | str, digits: int = 15) -> str:
    """Return a group's value as text, by default with all its digits, without zeros at the end."""
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def unit_of(name: str) -> str:
    """Return the unit in a column of sizes: "mrad" for size_mrad and object_size_mrad; "" for any other column."""
    of, is_size, unit = name.rpartition("size_")
    return unit if is_size and (not of or of.endswith("_")) else ""


def quantity(name: str) -> str:
    """Return a column of sizes in words, without its unit: "object size" for object_size_mrad."""
    return name.removesuffix(f"_{unit_of(name)}").replace("_", " ")


def _of_unit(name: str) -> tuple[str, str, str] | None:
    return (quantity(name), unit_of(name), "") if unit_of(name) else OF_UNIT.get(name)


def column_heading(name: str) -> str:
    """Return a column of groups as a heading: "object size (mrad)", "object x (mrad)"; as it is without a unit."""
    known = _of_unit(name)
    return f"{known[0]} ({known[1]})" if known else name


def phrase(name: str, value: float | str) -> str:
    """Return a column and its value in words: "0.6 mrad" for a size, "x -25 mrad" for a place, "camera left"."""
    if (known := _of_unit(name)) and isinstance(value, float):
        return f"{known[2]}{value_text(value, SIZE_DIGITS)} {known[1]}"
    return value_text(value) if name == "condition" else f"{name} {value_text(value)}"


def group_phrase(group: Mapping[str, float | str]) -> str:
    """Return a group in words; "all trials" if it has no columns."""
    return ", ".join(phrase(name, value) for name, value in group.items()) or "all trials"


def warning_text(group: Mapping[str, float | str], message: str) -> str:
    """Return a warning with the group that it concerns, if it is not the whole dataset."""
    return f"{group_phrase(group)}: {message}" if group else message


def group_phrases(groups: Sequence[Mapping[str, float | str]]) -> str:
    """Return groups in words; sizes from one column have their unit once: "1.5 and 2.5 mrad"."""
    names = list(groups[0])
    if len(names) == 1 and all(isinstance(group[names[0]], float) for group in groups):
        known = _of_unit(names[0])
        values = listed(value_text(group[names[0]], SIZE_DIGITS if known else 15) for group in groups)
        return f"{known[2]}{values} {known[1]}" if known else f"{names[0]} {values}"
    return "; ".join(map(group_phrase, groups))


def level_name(level: str) -> str:
    """Return the name of a stimulus strength for a sentence."""
    return level_of(level).name


def level_heading(level: str) -> str:
    """Return the name of a stimulus strength with its unit, for a column or an axis."""
    name, unit, *_ = level_of(level)
    return f"{name} ({unit})" if unit else name


def threshold_heading(level: str) -> str:
    """Return the heading of thresholds: "threshold contrast", or with a unit "threshold, ΔT (K)"."""
    heading = level_heading(level)
    return f"threshold, {heading}" if heading != level_name(level) else f"threshold {heading}"


def interval_phrase(bounds: tuple[float | None, float | None], digits: int = 3) -> str:
    """Return an interval in words; an open end is named as open."""
    low, high = bounds
    if low is None and high is None:
        return "open"
    if low is None or high is None:
        end = plain(high if low is None else low, digits)
        return f"open below, to {end}" if low is None else f"from {end}, open above"
    return f"{plain(low, digits)} to {plain(high, digits)}"


def path_name(text: str) -> str:
    """Return the last part of an absolute path; other texts as they are."""
    return Path(text).name if Path(text).is_absolute() else text


def listed(parts: Iterable[str]) -> str:
    """Return the parts joined with commas, and with "and" before the last."""
    *most, last = parts
    return f"{', '.join(most)} and {last}" if most else last


def count(number: int, what: str) -> str:
    """Return a number with its noun: "1 frame", "2 frames"."""
    return f"{number} {what}{'' if number == 1 else 's'}"
