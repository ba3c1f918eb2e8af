"""Summary of a result in sentences: thresholds, groups without one and why, algorithms that help."""

from __future__ import annotations

from collections.abc import Sequence

from todframes.results.advice import not_proportional
from todframes.results.data import (
    NO_DIFFERENCE,
    Algorithm,
    ComparedObserver,
    DatasetRecord,
    Fit,
    Group,
    Ratio,
    Record,
    ResultData,
    SceneResult,
    observer_names,
)
from todframes.results.wording import (
    count,
    group_phrase,
    group_phrases,
    interval_phrase,
    level_name,
    listed,
    phrase,
    plain,
    unit_of,
    unknown_place,
)

MOST_DESCRIBED_CURVES = 6
"""Largest number of curves that are described one by one; if there are more, the table shows them."""

NO_THRESHOLD = {
    "never_reached": "answers stay below {criterion} at the levels shown (never reached)",
    "always_exceeded": "answers stay above {criterion} at the levels shown (always exceeded)",
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


def verdict(result: ResultData) -> list[str]:
    """Return the main findings, the most important first; sentences stored in the result take precedence."""
    given = [result.verdict] if isinstance(result.verdict, str) else list(map(str, result.verdict))
    texts = given or _sentences_of(result)
    if result.skipped:
        n = len(result.skipped)
        texts.append(f"{count(n, 'frame')} could not be used and {'is' if n == 1 else 'are'} left out.")
    return texts


def _sentences_of(result: ResultData) -> list[str]:
    if result.scenes:
        return timed(result.scenes)
    if result.persons:
        from todframes.results.calibration import sentences

        return sentences(result)
    computed = not any(fit.n_trials for fit in result.thresholds)
    curves = by_curve(result.thresholds)
    texts = [
        sentence
        for label, fits in list(curves.items())[:MOST_DESCRIBED_CURVES]
        for sentence in _curve(label, fits, computed=computed)
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
    """Return sentences about thresholds outside the levels shown, and intervals with an open end."""
    texts = []
    for weaker, wanted in ((True, "weaker"), (False, "stronger")):
        outside = [fit for fit in known if fit.status == "extrapolated" and _below_levels(fit) == weaker]
        if outside:
            where = f" at {_sizes(outside, size)}" if size else ""
            texts.append(f"The threshold{where} is extrapolated from the levels shown: show {wanted} ones.")
    half_open = [fit for fit in known if fit.threshold_ci95 is not None and None in fit.threshold_ci95]
    if half_open:
        where = f" at {_sizes(half_open, size)}" if size else ""
        texts.append(f"The data leave an end of the 95 % interval{where} open.")
    return texts


def _below_levels(fit: Fit) -> bool:
    assert fit.threshold is not None
    return not fit.points or fit.threshold < min(point.level for point in fit.points)


def _threshold(fit: Fit) -> str:
    """Return a threshold in words, with its interval or error, and its temperature difference if known."""
    text = plain(fit.threshold) + (" mrad" if fit.level == "size_mrad" else "")
    more = [] if fit.delta_t_mk is None else [f"ΔT {plain(fit.delta_t_mk)} mK"]
    if fit.threshold_ci95 is not None:
        more.append(f"95 % interval {interval_phrase(fit.threshold_ci95)}")
    elif fit.threshold_numerical_error is not None:
        more.append(f"± {plain(fit.threshold_numerical_error, 1)} numerical error")
    return text + (f" ({', '.join(more)})" if more else "")


def timed(scenes: Sequence[SceneResult]) -> list[str]:
    """Return sentences that compare the CPU time of the last estimator with that of the first, at equal error."""
    texts = []
    for scene in scenes:
        parts = [
            f"{'at least ' * one.at_least}{plain(one.ratio)} times less at "
            f"{plain(100 * one.threshold_error, 1)} % error{' (extrapolated)' * one.extrapolated}"
            for one in scene.speed_ratios
            if one.ratio is not None
        ]
        if parts and len(scene.estimators) > 1:
            first, last = scene.estimators[0].title, scene.estimators[-1].title
            texts.append(f"{scene.heading}: the CPU time of {last} is {listed(parts)} than that of {first}.")
    return texts or [f"{count(len(scenes), 'scene')}: error against run time."]


def _sizes(fits: Sequence[Fit], size: str | None) -> str:
    """Return the sizes of fits in words, with their unit once: "1.5, 2 and 3 detectors"."""
    assert size is not None
    return f"{listed(f'{fit.group[size]:.15g}' for fit in fits)} {unit_of(size)}"


REACHED = {
    "never_reached": "is never reached",
    "always_exceeded": "is always exceeded",
    "too_few_levels": "cannot be found from one level",
}
"""Phrases about the criterion if there is no threshold, by status."""


def comparison(algorithms: Sequence[Algorithm]) -> tuple[str, ...]:
    """Return a paragraph for each algorithm except the first, the reference: whether it helps and by how much."""
    return tuple(_paragraph(one, algorithms[0]) for one in algorithms[1:])


def comparisons(
    settings: Record, algorithms: Sequence[Algorithm], others: Sequence[ComparedObserver]
) -> tuple[str, ...]:
    """Return a sentence for each algorithm on which observers disagree, then the paragraphs of each observer.

    Parameters
    ----------
    settings : mapping
        Settings of the observer of `algorithms`.
    others : sequence of ComparedObserver
        Further observers, with the same algorithms in the same order.
    """
    names = observer_names(settings, others)
    of_observer = dict(zip(names, [algorithms, *(one.algorithms for one in others)], strict=True))
    disagreements = []
    for number, one in enumerate(algorithms[1:], 1):
        found = {name: of_each[number].verdict for name, of_each in of_observer.items()}
        if len(set(found.values())) > 1:
            each = ", ".join(f"{verdict} for {name}" for name, verdict in found.items())
            disagreements.append(
                ("better" not in found.values(), f"The observers disagree about {one.name}: {each}.")
            )
    paragraphs = [f"{name}: {text}" for name, of_each in of_observer.items() for text in comparison(of_each)]
    return (*(text for _, text in sorted(disagreements, key=lambda one: one[0])), *paragraphs)


def _paragraph(one: Algorithm, reference: Algorithm) -> str:
    verdicts = [ratio.verdict for ratio in one.ratios]
    text = f"{one.name}: {one.verdict}"
    whole = one.overall or one.ratios[0]
    if whole.ratio is not None:
        mean = ", in the geometric mean of all groups" if one.overall else ""
        sure = f"95 % interval {interval_phrase(whole.ratio_ci95 or (None, None))}"
        level = level_name(one.fits[0].level)
        text += f"; the threshold {level} is {plain(whole.ratio)} times that without it ({sure}){mean}"
    if one.overall and len(set(verdicts)) > 1:
        texts = [
            f"{verdict} at {group_phrases([ratio.group for ratio in one.ratios if ratio.verdict == verdict])}"
            for verdict in ("better", "worse", NO_DIFFERENCE)
            if verdict in verdicts
        ]
        text += f"; {'; '.join(texts)}"
    sentences = [text, *_beyond_gain(one, whole)]
    for reason, groups in _without_ratio(one, reference).items():
        where = f"At {group_phrases(groups)} " if groups[0] else ""
        sentences.append(f"{where}{reason}" if where else reason[0].upper() + reason[1:])
    if one.disagrees:
        changes = {
            "psnr": f"PSNR changes by {_signed(one.psnr_change_db, '.1f')} dB",
            "ssim": f"SSIM by {_signed(one.ssim_change, '.3f')}",
        }
        sentences.append(f"The usual measures disagree: {' and '.join(changes[name] for name in one.disagrees)}")
    return ". ".join(sentences) + "."


def _beyond_gain(one: Algorithm, ratio: Ratio) -> list[str]:
    """Return a sentence on an algorithm that helps: whether it does more than a plain gain of the same amount.

    Where its gain is another near the threshold, no plain gain is of the same amount.
    """
    if ratio.verdict not in ("better", "mixed") or ratio.beyond_gain is None or ratio.beyond_gain_ci95 is None:
        return []
    if not_proportional([one]):
        return [
            "Whether it does more than amplify stays open: its contrast gain near the threshold is not that at "
            "the highest level"
        ]
    low, high = ratio.beyond_gain_ci95
    if high is not None and high < 1.0:
        amount = "more than"
    else:
        amount = "less than" if low is not None and low > 1.0 else "no more than"
    return [
        f"It does {amount} its contrast gain of {plain(ratio.contrast_gain)}: the threshold is "
        f"{plain(ratio.beyond_gain)} times that of a plain gain of as much (95 % interval "
        f"{interval_phrase(ratio.beyond_gain_ci95)})"
    ]


def _without_ratio(one: Algorithm, reference: Algorithm) -> dict[str, list[Group]]:
    """Return the reasons why groups have no ratio: phrases, and the groups for which each is true."""
    found: dict[str, list[Group]] = {}
    for ratio, fit, before in zip(one.ratios, one.fits, reference.fits, strict=True):
        if ratio.ratio is None:
            what = f"{100 * fit.p_correct:g} % correct"
            after, without = (REACHED.get(either.status, "is reached") for either in (fit, before))
            both = f"{what} {after} with it or without" if after == without else ""
            found.setdefault(both or f"{what} {after} with it and {without} without", []).append(fit.group)
    return found


def _signed(value: float | None, form: str) -> str:
    return f"{value or 0.0:+{form}}".replace("-", "−")


def remarks(result: ResultData) -> list[str]:
    """Return sentences about the accuracy of a result's numbers."""
    texts = []
    fits = result.thresholds
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
    if any(fit.delta_t_as_printed_mk is not None for fit in fits):
        texts.append(
            "ΔT is SNR · NETD / k, as the noise of a displayed sample is NETD / k; eq. 4 of the paper as printed "
            "multiplies by k instead, which gives k² times this ΔT."
        )
    if result.negative_luminance_pixels:
        texts.append(
            f"{result.negative_luminance_pixels} display pixels have a luminance below zero, as noise in linear "
            "frames may have; they were scored as they are."
        )
    return texts


GAZES = {"tracked": "follows it (tracked)", "fixed": "stays at that place (fixed), so that motion is blur"}
"""Phrases about each gaze, where triangles move."""


def cautions(result: ResultData) -> list[str]:
    """Return the cautions that a reader of the thresholds must know."""
    texts = []
    of_each = [one for one in result.located or () if one.get("n_located") is not None]
    if of_each:
        n_located, n_trials = (sum(one[key] for one in of_each) for key in ("n_located", "n_trials"))
        text = f"{n_located} of {n_trials} trials were located one by one"
        faint = [one for one in of_each if one["n_located"] < one["n_trials"]]
        where = f" (at {group_phrases([one['group'] for one in faint])})" if faint and faint[0]["group"] else ""
        rest = f"; the others{where} are too faint and have the position of their group" if faint else ""
        texts.append(f"{text}{rest}.")
    data = result.dataset if isinstance(result.dataset, DatasetRecord) else None
    places = result.settings.get("places") if data is None else data.experiment.get("places")
    if places is not None:
        texts.append(unknown_place(places))
    if data is not None and data.motion_mrad is not None:
        gazes = {one.get("gaze") for one in (result.settings, *(other.settings for other in result.observers))}
        looks = [look for gaze, look in GAZES.items() if gaze in gazes]
        texts.append(
            f"Within a trial the triangle moves, by up to {plain(data.motion_mrad, 3)} mrad from its mean place; "
            f"the gaze {' or '.join(looks)}."
        )
    if data is not None and data.n_scenes is not None and result.thresholds:
        what = "Intervals and verdicts" if result.algorithms else "Intervals"
        if "scene" in data.experiment.get("group_by", ()) and data.n_scenes > 1:
            texts.append(f"{what} of a scene hold for it, and nothing is known of others.")
        elif data.n_scenes == 1:
            texts.append(
                f"All trials are on one scene: {what.lower()} hold for it, and nothing is known of others."
            )
        else:
            texts.append(
                f"{what} take the {data.n_scenes} scenes as drawn from many and hold for others like them."
            )
    apart = [
        100 * abs(fit.points_threshold / fit.threshold - 1)
        for fit in result.thresholds
        if fit.curve != "observer" and fit.threshold is not None and fit.points_threshold is not None
    ]
    if max(apart, default=0.0) >= 1.0:
        texts.append(
            f"The points themselves cross the criterion up to {plain(max(apart), 2)} % away from the fitted "
            "Weibull curve; the intervals cover both."
        )
    return texts
