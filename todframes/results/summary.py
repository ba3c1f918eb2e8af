"""Thresholds in sentences: those of each curve, groups without one and why, and how exact they are."""

from __future__ import annotations

from collections.abc import Sequence

from todframes.results.data import Efficiency, Fit
from todframes.results.wording import group_phrase, interval_phrase, level_name, listed, phrase, plain, unit_of

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
