"""Numbers, groups and lists in words, and thresholds in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from todframes.stimulus import level_of

if TYPE_CHECKING:
    from todframes.results.data import Efficiency, Fit


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


MOST_DESCRIBED_CURVES = 6
"""Largest number of curves that are described one by one; if there are more, the table shows them."""

NO_THRESHOLD = {
    "never_reached": "answers stay below {criterion} at the levels shown (never reached)",
    "always_exceeded": "answers stay above {criterion} at the levels shown (always exceeded)",
    "falling": "answers get worse as the level grows, and fall below {criterion} (falling)",
    "too_few_levels": "fewer than two levels were shown (too few levels)",
}

COMPUTED = {
    "never_reached": "{criterion} is never reached, however strong the signal",
    "always_exceeded": "{criterion} is always exceeded, however weak the signal",
    "too_uncertain": "its numerical error is too large (too uncertain)",
}
"""Reasons for a missing threshold, by status, if levels are computed without limit instead of shown."""


def size_column(fits: Sequence[Fit]) -> str | None:
    """Return the only group column that is a size, if its values are positive numbers; otherwise None."""
    names = [name for name in (fits[0].group if fits else ()) if unit_of(name)]
    if len(names) != 1:
        return None
    sizes = [fit.group[names[0]] for fit in fits]
    return names[0] if all(isinstance(size, float) and size > 0.0 for size in sizes) else None


def by_curve(fits: Sequence[Fit]) -> dict[str, list[Fit]]:
    """Return the fits of each curve, which differ in size alone, sorted by size; "" is the key of a single curve.
    Without a column of sizes each fit is a curve of its own.
    """
    size = size_column(fits)
    curves: dict[str, list[Fit]] = {}
    for fit in fits:
        others = {name: value for name, value in fit.group.items() if name != size}
        curves.setdefault(group_phrase(others) if others else "", []).append(fit)
    if size is not None:
        for curve in curves.values():
            curve.sort(key=lambda fit: float(fit.group[size]))
    return curves


def findings(fits: Sequence[Fit]) -> list[str]:
    """Return sentences about thresholds: those of each curve, or that there is none and why."""
    computed = not any(fit.n_trials for fit in fits)
    curves = by_curve(fits)
    texts = [
        sentence
        for label, of_curve in list(curves.items())[:MOST_DESCRIBED_CURVES]
        for sentence in _curve(label, of_curve, computed=computed)
    ]
    if len(curves) > MOST_DESCRIBED_CURVES:
        texts.append(f"{len(curves) - MOST_DESCRIBED_CURVES} more are in the table.")
    return texts


def _curve(label: str, fits: Sequence[Fit], *, computed: bool) -> list[str]:
    """Return sentences about one TOD curve, or about a threshold that belongs to no curve."""
    size = size_column(fits)
    criterion = f"{100 * fits[0].p_correct:g} % correct"
    head = f"At {criterion}" + (f" with {label}" if label else "")
    known = [fit for fit in fits if fit.threshold is not None]
    texts = []
    if known:
        first, last = known[0], known[-1]
        text = f"{head} the threshold {level_name(first.level)} is {_threshold(first)}"
        text += f" at {phrase(size, first.group[size])}" if size else ""
        if size and len(known) > 1:
            assert first.threshold is not None and last.threshold is not None
            change = "falling" if last.threshold < first.threshold else "rising"
            text += f", {change} to {_threshold(last)} at {phrase(size, last.group[size])}"
        texts.append(text + ".")
    texts += _open_questions(known, size)
    reasons = NO_THRESHOLD | (COMPUTED if computed else {})
    for status in dict.fromkeys(fit.status for fit in fits if fit.threshold is None):
        these = [fit for fit in fits if fit.threshold is None and fit.status == status]
        where = f"At {_sizes(these, size)} " if size else ""
        where += f"with {label} " if label else ""
        where = f"{where[:1].upper()}{where[1:]}there" if where else "There"
        reason = reasons.get(status, f"the status is {status}").format(criterion=criterion)
        texts.append(f"{where} is no threshold: {reason}.")
    return texts


def _open_questions(known: Sequence[Fit], size: str | None) -> list[str]:
    """Return sentences about thresholds that the levels shown leave open, and intervals with an open end."""
    texts = []
    steps = [fit for fit in known if fit.status == "between_levels"]
    if steps:
        where = f" at {_sizes(steps, size)}" if size else ""
        texts.append(f"The data bound the threshold{where} between two levels only: show levels in between.")
    for weaker, wanted in ((True, "weaker"), (False, "stronger")):
        outside = [
            fit
            for fit in known
            if fit.status == "extrapolated"
            and all((fit.threshold or 0.0) < point.level for point in fit.points) == weaker
        ]
        if outside:
            where = f" at {_sizes(outside, size)}" if size else ""
            texts.append(f"The threshold{where} is extrapolated from the levels shown: show {wanted} ones.")
    half_open = [fit for fit in known if fit.threshold_ci95 is not None and None in fit.threshold_ci95]
    if half_open:
        where = f" at {_sizes(half_open, size)}" if size else ""
        texts.append(f"The data leave an end of the 95 % interval{where} open.")
    return texts


def _threshold(fit: Fit) -> str:
    """Return a threshold in words, with its interval or error, and its temperature difference if known."""
    text = plain(fit.threshold) + (" mrad" if fit.level == "size_mrad" else "")
    more = [] if fit.delta_t_mk is None else [f"ΔT {plain(fit.delta_t_mk)} mK"]
    if fit.threshold_ci95 is not None:
        more.append(f"95 % interval {interval_phrase(fit.threshold_ci95)}")
    elif fit.threshold_numerical_error is not None:
        more.append(f"± {plain(fit.threshold_numerical_error, 1)} numerical error")
    return text + (f" ({', '.join(more)})" if more else "")


def _sizes(fits: Sequence[Fit], size: str | None) -> str:
    """Return the sizes of fits in words, with their unit once: "1.5, 2 and 3 detectors"."""
    assert size is not None
    return f"{listed(f'{fit.group[size]:.15g}' for fit in fits)} {unit_of(size)}"


def efficiencies(of_pairs: Sequence[Efficiency]) -> list[str]:
    """Return a sentence about the efficiency relative to each other observer, in the order of groups."""
    texts = []
    for name in dict.fromkeys(pair.relative_to for pair in of_pairs):
        known = [plain(pair.efficiency) for pair in of_pairs if pair.relative_to == name and pair.efficiency]
        texts += [f"Its efficiency relative to {name} is {listed(known)}."] if known else []
    return texts


def remarks(fits: Sequence[Fit]) -> list[str]:
    """Return sentences about the accuracy of thresholds."""
    texts = []
    relative = [
        fit.threshold_numerical_error / fit.threshold
        for fit in fits
        if fit.threshold is not None and fit.threshold_numerical_error is not None
    ]
    if relative:
        texts.append(f"Numerical error of the thresholds: {plain(100 * max(relative), 2)} % at most.")
    bound = max((fit.p_correct_error_bound or 0.0 for fit in fits), default=0.0)
    if bound:
        texts.append(f"P(correct) is right within {plain(bound, 1)}, as the summed noise is not quite Gaussian.")
    return texts
