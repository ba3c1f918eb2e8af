"""Results as JSON objects: fits, thresholds, comparisons."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from todframes import __version__
from todframes._typing import Json
from todframes.enhancement.algorithm import Enhancement, Parameter
from todframes.enhancement.compare import AlgorithmResult, Compared
from todframes.psychometrics.fit import PsychometricFit
from todframes.report.summary import NO_DIFFERENCE
from todframes.safe_text import visible_json
from todframes.scoring.score import GroupFit

SCHEMA = 1


LIBRARIES = ("numpy", "scipy", "cv2", "OpenImageIO")


def fit_object(group: Mapping[str, float | str], level: str, fit: PsychometricFit) -> Json:
    """A fit as it stands in `result.json`."""
    return {"group": dict(group), "level": level, **msgspec.to_builtins(fit)}


def scored_fit_object(group: Mapping[str, float | str], level: str, fit: GroupFit) -> Json:
    """A fit to scored trials as it stands in `result.json`."""
    return fit_object(group, level, fit.fit) | {
        "p_correct_error_bound": fit.non_gaussian_bound,
        "p_correct_left_out_bound": fit.left_out_bound,
        "threshold_displacement_error": fit.numerical_error,
        "n_displacements": fit.n_displacements,
        "run_time_s": round(fit.run_time_s, 4),
    }


def computed_threshold_object(
    group: Mapping[str, float | str],
    level: str,
    p_correct: float,
    status: str,
    threshold: float | None,
    numerical_error: float | None,
) -> Json:
    """A threshold that was computed, not fitted, as it stands in `result.json`: no trials and no curve."""
    return {
        "group": dict(group),
        "level": level,
        "status": status,
        "threshold": threshold,
        "threshold_ci95": None,
        "threshold_numerical_error": numerical_error,
        "p_correct": p_correct,
        **dict.fromkeys(("alpha", "beta", "gamma", "delta")),
        "n_trials": 0,
        "points": [],
    }


def closing_line(result: Json) -> str:
    """Run time and what the thresholds leave out; a line more where points and curve disagree by 1 % or more."""
    line = f"{result['run_time_s']:.2f} s"
    apart = [_percent_apart(fit) for fit in result["fits"]]
    if max(apart, default=0.0) >= 1.0:
        remark = f"Points and Weibull curve cross the criterion up to {max(apart):.1f} % apart (points_threshold)"
        line = f"{remark}; the intervals cover both.\n{line}"
    bound = max((fit.get("p_correct_error_bound") or 0.0 for fit in result["fits"]), default=0.0)
    if bound:
        line += f"; P(correct) within {bound:.1g}, as the summed noise is not quite Gaussian"
    return line


def _percent_apart(fit: Json) -> float:
    """How far the crossing of the points is from that of the curve."""
    points, curve = fit.get("points_threshold"), fit["threshold"]
    return 0.0 if points is None or curve is None else 100.0 * abs(points / curve - 1.0)


def result_object(
    command: str, *, settings: Json, seed: int | None, fits: Sequence[Json], run_time_s: float, **more: Any
) -> Json:
    """The object that `--json` prints and `result.json` holds."""
    return {
        "schema": SCHEMA,
        "command": command,
        "version": __version__,
        "versions": _versions(),
        "settings": settings,
        "seed": seed,
        "fits": list(fits),
        **more,
        "run_time_s": round(run_time_s, 4),
    }


def _versions() -> dict[str, str]:
    """Of Python, and of what was used and may move the last digits."""
    used = {name: sys.modules[name].__version__ for name in LIBRARIES if name in sys.modules}
    return {"python": platform.python_version(), **used}


def encode(result: Json) -> bytes:
    """Indented JSON with a final line break; what is not a number becomes null.

    Characters that a terminal would obey are escaped, which changes nothing of what the JSON says.
    """
    text = msgspec.json.format(msgspec.json.encode(result), indent=2).decode()
    return (visible_json(text) + "\n").encode()


PSNR_STEP_DB, SSIM_STEP = 0.1, 0.005
"""Changes of PSNR and SSIM that count as none."""


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
