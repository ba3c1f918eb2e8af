"""What a comparison says, as JSON and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from todframes.comparing import AlgorithmResult, Compared
from todframes.enhancement import Enhancement, Parameter
from todframes.report import scored_fit_object
from todframes.tables import interval, number

Json = dict[str, Any]

PSNR_STEP_DB, SSIM_STEP = 0.1, 0.005
"""Changes of PSNR and SSIM that count as none."""
NO_DIFFERENCE = "no difference shown"
REACHED = {
    "never_reached": "is never reached",
    "always_exceeded": "is always exceeded",
    "too_few_levels": "cannot be told of one level",
}
"""What becomes of the criterion where there is no threshold, by status."""


def algorithm_objects(results: Sequence[AlgorithmResult], group_by: Sequence[str], level: str) -> list[Json]:
    """The algorithms as they stand in `result.json`, the reference first."""
    reference = results[0]
    names = [one.enhancement.name for one in results]
    objects = []
    for one in results:
        algorithm = one.enhancement
        measures = {
            "psnr_db": one.psnr_db,
            "psnr_change_db": _difference(one.psnr_db, reference.psnr_db),
            "ssim": one.ssim,
            "ssim_change": _difference(one.ssim, reference.ssim),
        }
        verdict = _verdict_of_all(one)
        objects.append(
            {
                "name": algorithm.name if names.count(algorithm.name) == 1 else algorithm.spec,
                "spec": algorithm.spec,
                "what": algorithm.what,
                "library": algorithm.declaration.library,
                "domain": algorithm.declaration.domain,
                "parameters": {name: _plain_value(value) for name, value in algorithm.values.items()},
                "magnification": algorithm.magnification,
                "fits": [
                    scored_fit_object(dict(zip(group_by, fit.group, strict=True)), level, fit)
                    for fit in one.scored.fits
                ],
                "ratios": [_compared_object(compared, group_by) for compared in one.compared],
                "overall": None if one.overall is None else _compared_object(one.overall, group_by),
                "verdict": verdict,
                **measures,
                "disagrees": [] if verdict is None else _disagreeing(measures, verdict),
                "n_clipped": one.n_clipped,
                "cpu_s": round(one.cpu_s, 4),
            }
        )
    return objects


def _compared_object(compared: Compared, group_by: Sequence[str]) -> Json:
    group = {} if compared.group is None else {"group": dict(zip(group_by, compared.group, strict=True))}
    ratio = compared.ratio
    return group | {
        "ratio": ratio.ratio,
        "ratio_ci95": ratio.ratio_ci95,
        "p_value": ratio.p_value,
        "p_value_holm": compared.p_value_holm,
        "verdict": compared.verdict,
    }


def _verdict_of_all(one: AlgorithmResult) -> str | None:
    if one.overall is not None:
        return one.overall.verdict
    return one.compared[0].verdict if one.compared else None


def _difference(value: float | None, reference: float | None) -> float | None:
    return None if value is None or reference is None else value - reference


def _disagreeing(measures: Mapping[str, float | None], verdict: str) -> list[str]:
    """Which of PSNR and SSIM say something else than the observer does."""
    found = []
    for name, key, step in (("psnr", "psnr_change_db", PSNR_STEP_DB), ("ssim", "ssim_change", SSIM_STEP)):
        change = measures[key]
        if change is not None:
            opinion = NO_DIFFERENCE if abs(change) < step else "better" if change > 0 else "worse"
            found += [name] if opinion != verdict else []
    return found


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
    for phrase, groups in _without_ratio(one, reference, p_correct).items():
        where = _groups(groups)
        sentences.append(f"At {where} {phrase}" if where else phrase[0].upper() + phrase[1:])
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


def enhancement_object(algorithm: Enhancement) -> Json:
    """An algorithm as `todframes enhancements` tells of it."""
    return {
        "name": algorithm.name,
        "what": algorithm.what,
        "domain": algorithm.declaration.domain,
        "changes_pitch": algorithm.declaration.magnification != 1.0,
        "library": algorithm.declaration.library,
        "parameters": [_parameter(one) for one in algorithm.parameters],
    }


def _parameter(one: Parameter) -> Json:
    meta = one.meta
    return {
        "name": one.name,
        "default": _plain_value(one.default),
        "unit": (meta.extra or {}).get("unit") or None,
        "range": None if meta.ge is None else [meta.ge, meta.le],
        "choices": list(one.choices) or None,
        "what": meta.description or None,
    }


def _plain_value(value: object) -> object:
    """A parameter's value as JSON has it; a text where it has no such thing."""
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)
