"""Results as people and programs read them: one JSON object, CSV, plots, a table on the terminal."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from todframes import __version__
from todframes.psychometric import PsychometricFit
from todframes.safe_text import csv_text, visible_json
from todframes.scoring import GroupFit, ScoredDataset
from todframes.stimulus import ORIENTATIONS

Json = dict[str, Any]

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


def scores_csv(scored: ScoredDataset, group_by: Sequence[str], level: str) -> bytes:
    """A row a trial: what was shown, the four scores, the probability of each answer, the answer."""
    shown = list(dict.fromkeys(["orientation", "size_mrad", "polarity", level, *group_by]))
    header = (
        ["trial", "n_frames", *shown, "displacement_x_samples", "displacement_y_samples"]
        + [f"score_{orientation}" for orientation in ORIENTATIONS]
        + [f"p_{orientation}" for orientation in ORIENTATIONS]
        + ["answer", "p_correct"]
    )
    rows: list[list[object]] = [[*header]]
    for place, trial in enumerate(scored.trials):
        values: dict[str, object] = dict(zip(group_by, trial.group, strict=True))
        values |= {
            "orientation": trial.orientation.value,
            "size_mrad": trial.stimulus.size_mrad,
            "polarity": trial.stimulus.polarity,
            level: trial.level,
        }
        numbers = [*scored.displacement_samples[place], *scored.scores[place], *scored.probabilities[place]]
        rows.append(
            [trial.name, len(trial.frames), *(values[name] for name in shown)]
            + ["" if number != number else repr(float(number)) for number in numbers]
            + [ORIENTATIONS[scored.answers[place]].value, repr(float(scored.p_correct[place]))]
        )
    return csv_text(rows).encode()
