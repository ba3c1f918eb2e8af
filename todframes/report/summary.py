"""What a result says, in sentences: thresholds, what has none and why, which algorithm helps."""

from __future__ import annotations

from collections.abc import Sequence

from todframes._typing import Json
from todframes.report.result import Algorithm, Fit, Ratio, Result, SceneResult
from todframes.report.wording import (
    _count,
    _groups,
    group_phrase,
    interval,
    interval_phrase,
    level_name,
    listed,
    number,
    phrase,
    plain,
)

LONGEST_LIST = 6
"""Things told one by one in a sentence; more are left to the table."""


NO_THRESHOLD = {
    "never_reached": "answers stay below {criterion} at the levels shown (never reached)",
    "always_exceeded": "answers stay above {criterion} at the levels shown (always exceeded)",
    "too_few_levels": "fewer than two levels were shown (too few levels)",
}


COMPUTED = {
    "never_reached": "{criterion} is never reached, however strong the signal",
    "always_exceeded": "{criterion} is always exceeded, however weak the signal",
}
"""Where levels are not shown but computed, and none is too strong."""


def size_column(fits: Sequence[Fit]) -> str | None:
    """The one group column that is a size and has positive numbers for values."""
    names = [name for name in (fits[0].group if fits else ()) if name.startswith("size_")]
    if len(names) != 1:
        return None
    sizes = [fit.group[names[0]] for fit in fits]
    return names[0] if all(isinstance(size, float) and size > 0.0 for size in sizes) else None


def by_curve(fits: Sequence[Fit]) -> dict[str, list[Fit]]:
    """Fits that differ in size alone, in the order of size; "" is the key where there is one curve only.

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


def verdict(result: Result) -> list[str]:
    """Sentences that say what came out, the most important first; a result's own if it has any."""
    given = [result.verdict] if isinstance(result.verdict, str) else list(map(str, result.verdict))
    told = given or _told(result)
    if result.skipped:
        n = len(result.skipped)
        told.append(f"{_count(n, 'frame')} could not be used and {'is' if n == 1 else 'are'} left out.")
    return told


def _told(result: Result) -> list[str]:
    if result.command == "compare":
        return compared(result.algorithms)
    if result.command == "accuracy":
        return timed(result.scenes)
    computed = result.command in ("curve", "naked-eye")
    curves = by_curve(result.fits)
    told = [
        sentence
        for label, fits in list(curves.items())[:LONGEST_LIST]
        for sentence in _curve(label, fits, computed=computed)
    ]
    if len(curves) > LONGEST_LIST:
        told.append(f"{len(curves) - LONGEST_LIST} more are in the table.")
    return told


def _curve(label: str, fits: Sequence[Fit], *, computed: bool) -> list[str]:
    """Sentences about one TOD curve, or about a threshold that belongs to none."""
    size = size_column(fits)
    criterion = f"{100 * fits[0].p_correct:g} % correct"
    head = f"At {criterion}" + (f" with {label}" if label else "")
    known = [fit for fit in fits if fit.threshold is not None]
    told = []
    if known:
        first, last = known[0], known[-1]
        text = f"{head} the threshold {level_name(first.level)} is {_threshold(first)}"
        text += f" at {phrase(size, first.group[size])}" if size else ""
        if size and len(known) > 1:
            assert first.threshold is not None and last.threshold is not None
            change = "falling" if last.threshold < first.threshold else "rising"
            text += f", {change} to {_threshold(last)} at {phrase(size, last.group[size])}"
        told.append(text + ".")
    told += _open_questions(known, size)
    reasons = NO_THRESHOLD | (COMPUTED if computed else {})
    for status in dict.fromkeys(fit.status for fit in fits if fit.threshold is None):
        these = [fit for fit in fits if fit.threshold is None and fit.status == status]
        where = f"At {_sizes(these, size)} " if size else ""
        where += f"with {label} " if label else ""
        where = f"{where[:1].upper()}{where[1:]}there" if where else "There"
        reason = reasons.get(status, f"the status is {status}").format(criterion=criterion)
        told.append(f"{where} is no threshold: {reason}.")
    return told


def _open_questions(known: Sequence[Fit], size: str | None) -> list[str]:
    """What the levels shown leave open: thresholds outside of them, intervals without an end."""
    told = []
    for weaker, wanted in ((True, "weaker"), (False, "stronger")):
        outside = [fit for fit in known if fit.status == "extrapolated" and _below_levels(fit) == weaker]
        if outside:
            where = f" at {_sizes(outside, size)}" if size else ""
            told.append(f"The threshold{where} is extrapolated from the levels shown: show {wanted} ones.")
    half_open = [fit for fit in known if fit.threshold_ci95 is not None and None in fit.threshold_ci95]
    if half_open:
        where = f" at {_sizes(half_open, size)}" if size else ""
        told.append(f"The data leave an end of the 95 % interval{where} open.")
    return told


def _below_levels(fit: Fit) -> bool:
    assert fit.threshold is not None
    return not fit.points or fit.threshold < min(point.level for point in fit.points)


def _threshold(fit: Fit) -> str:
    """A threshold, how sure it is, and the temperature it stands for."""
    text = plain(fit.threshold) + (" mrad" if fit.level == "size_mrad" else "")
    more = [] if fit.delta_t_mk is None else [f"ΔT {plain(fit.delta_t_mk)} mK"]
    if fit.threshold_ci95 is not None:
        more.append(f"95 % interval {interval_phrase(fit.threshold_ci95)}")
    elif fit.threshold_numerical_error is not None:
        more.append(f"± {plain(fit.threshold_numerical_error, 1)} numerical error")
    return text + (f" ({', '.join(more)})" if more else "")


def compared(algorithms: Sequence[Algorithm]) -> list[str]:
    """How many algorithms help or hurt, then a sentence for each."""
    others = [one for one in algorithms if one.ratios]
    if not others:
        return ["No algorithm was compared with the reference."]
    better, worse = (
        [one for one in others if any(ratio.verdict == kind for ratio in one.ratios)]
        for kind in ("better", "worse")
    )
    same = [one for one in others if not any(ratio.verdict in ("better", "worse") for ratio in one.ratios)]
    counts = [
        (better, "lowers the threshold somewhere", "lower the threshold somewhere"),
        (worse, "raises it somewhere", "raise it somewhere"),
        (same, "shows no difference", "show no difference"),
    ]
    parts = [f"{len(these)} {one if len(these) == 1 else many}" for these, one, many in counts if these]
    return [f"Of {_count(len(others), 'algorithm')}, {listed(parts)}.", *map(_algorithm, others)]


def _algorithm(algorithm: Algorithm) -> str:
    ratios = algorithm.ratios
    parts: list[str] = []
    for kind, verb in (("better", "lowers"), ("worse", "raises")):
        these = [ratio for ratio in ratios if ratio.verdict == kind]
        if these:
            parts.append(f"{verb} {'it' if parts else 'the threshold'} {_ratios(these, ratios)}")
    rest = [ratio for ratio in ratios if ratio.verdict not in ("better", "worse")]
    if rest:
        parts.append(f"shows no difference {_ratios(rest, ratios)}")
    text = f"{algorithm.name} {listed(parts)}."
    p = [one.p_value_holm for one in ratios if one.verdict in ("better", "worse") and one.p_value_holm is not None]
    return text + (f" Corrected for all comparisons (Holm), p is {plain(max(p), 2)} at most." if p else "")


def _ratios(these: Sequence[Ratio], of_all: Sequence[Ratio]) -> str:
    """Where, and to how much of the reference's threshold."""
    if len(these) > LONGEST_LIST:
        known = [one.ratio for one in these if one.ratio is not None]
        span = f", to {plain(min(known))} to {plain(max(known))} of the reference's" if known else ""
        return f"in {len(these)} of {len(of_all)} groups{span}"
    told = []
    for one in these:
        sure = f", 95 % interval {interval_phrase(one.ratio_ci95)}" if one.ratio_ci95 is not None else ""
        ratio = f" (ratio {plain(one.ratio)}{sure})" if one.ratio is not None else ""
        told.append(f"{group_phrase(one.group)}{ratio}")
    return f"at {listed(told)}"


def timed(scenes: Sequence[SceneResult]) -> list[str]:
    """How many times less CPU the cheapest way takes than the dearest, at which error."""
    told = []
    for scene in scenes:
        parts = [
            f"{'at least ' * one.at_least}{plain(one.ratio)} times less at "
            f"{plain(100 * one.threshold_error, 1)} % error{' (extrapolated)' * one.extrapolated}"
            for one in scene.speed_ratios
            if one.ratio is not None
        ]
        if parts and len(scene.estimators) > 1:
            first, last = scene.estimators[0].title, scene.estimators[-1].title
            told.append(f"{scene.heading}: the CPU time of {last} is {listed(parts)} than that of {first}.")
    return told or [f"{_count(len(scenes), 'scene')}: error against run time."]


def _sizes(fits: Sequence[Fit], size: str | None) -> str:
    """Sizes of fits, their unit once: "1.5, 2 and 3 detectors"."""
    assert size is not None
    unit = size.removeprefix("size_")
    return f"{listed(f'{fit.group[size]:.15g}' for fit in fits)} {unit}"


NO_DIFFERENCE = "no difference shown"


REACHED = {
    "never_reached": "is never reached",
    "always_exceeded": "is always exceeded",
    "too_few_levels": "cannot be told of one level",
}
"""What becomes of the criterion where there is no threshold, by status."""


def verdict_sentences(algorithms: Sequence[Json], p_correct: float) -> list[str]:
    """A sentence or two for each algorithm, from `algorithm_objects`."""
    reference = algorithms[0]
    return [_sentence(one, reference, p_correct) for one in algorithms[1:]]


def _sentence(one: Json, reference: Json, p_correct: float) -> str:
    verdicts = [ratio["verdict"] for ratio in one["ratios"]]
    text = f"{one['name']}: {one['verdict']}"
    level = one["fits"][0]["level"]
    whole = one["overall"] or one["ratios"][0]
    if whole["ratio"] is not None:
        mean = ", in the geometric mean of all groups" if one["overall"] else ""
        sure = f"95 % interval {interval(whole['ratio_ci95'])}"
        text += f"; the threshold {level} is {number(whole['ratio'], 3)} times that without it ({sure}){mean}"
    if one["overall"] and len(set(verdicts)) > 1:
        told = [
            f"{verdict} at {_groups([r['group'] for r in one['ratios'] if r['verdict'] == verdict])}"
            for verdict in ("better", "worse", NO_DIFFERENCE)
            if verdict in verdicts
        ]
        text += f"; {'; '.join(told)}"
    sentences = [text]
    for reason, groups in _without_ratio(one, reference, p_correct).items():
        where = _groups(groups)
        sentences.append(f"At {where} {reason}" if where else reason[0].upper() + reason[1:])
    if one["disagrees"]:
        changes = {
            "psnr": f"PSNR changes by {_signed(one['psnr_change_db'], '.1f')} dB",
            "ssim": f"SSIM by {_signed(one['ssim_change'], '.3f')}",
        }
        sentences.append(
            f"The usual measures disagree: {' and '.join(changes[name] for name in one['disagrees'])}"
        )
    return ". ".join(sentences) + "."


def _without_ratio(one: Json, reference: Json, p_correct: float) -> dict[str, list[Json]]:
    """What there is to say of groups where one of the two has no threshold: phrases, and the groups of each."""
    what = f"{100 * p_correct:g} % correct"
    found: dict[str, list[Json]] = {}
    for ratio, fit, before in zip(one["ratios"], one["fits"], reference["fits"], strict=True):
        if ratio["ratio"] is None:
            after, without = (REACHED.get(either["status"], "is reached") for either in (fit, before))
            both = f"{what} {after} with it or without" if after == without else ""
            found.setdefault(both or f"{what} {after} with it and {without} without", []).append(fit["group"])
    return found


def _signed(value: float, form: str) -> str:
    return f"{value:+{form}}".replace("-", "−")
