"""The scenes of an accuracy study in a report: tables, and what to draw."""

from __future__ import annotations

from todframes.report_tables import Table, records_table
from todframes.result import Record, Scene

Runs = dict[str, list[tuple[float, float]]]


def scene_runs(scene: Scene) -> Runs:
    """CPU time and relative error of the threshold at each budget of each estimator; both above 0."""
    runs = {
        one.title: [
            (float(point["cpu_s"]), float(point["threshold_error"]))
            for point in one.points
            if _is_positive(point.get("cpu_s")) and _is_positive(point.get("threshold_error"))
        ]
        for one in scene.estimators
    }
    return {title: pairs for title, pairs in runs.items() if pairs}


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and value > 0


def scene_tables(scene: Scene, number: int) -> list[Table]:
    """Estimators first; then what they take at some errors, all budgets, and what changing one thing does."""
    estimators: list[Record] = [
        {
            "estimator": one.title,
            "set_up_cpu_s": one.set_up_cpu_s,
            "slope": one.slope,
            "slope_standard_error": one.slope_standard_error,
        }
        for one in scene.estimators
    ]
    parts = {
        "estimators": estimators,
        "CPU time at some errors": [
            {"estimator": one.title} | at for one in scene.estimators for at in one.cpu_s_at
        ],
        "budgets": [{"estimator": one.title} | point for one in scene.estimators for point in one.points],
        "one thing changed": scene.variants,
    }
    return [
        records_table(f"{scene.heading}: {what}", f"scene_{number}_{part}.csv", rows)
        for part, (what, rows) in enumerate(parts.items(), 1)
        if rows
    ]
