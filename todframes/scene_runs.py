"""The scenes of an accuracy study: its numbers as tables, and as pairs of run time and error.

A study may name its columns as it likes. A run time has `cpu` in its name, an error has `error`, and the texts of
a row name the estimator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from todframes import tables
from todframes.result import Record

SCENE_NAMES = ("name", "scene")

Runs = Mapping[str, list[tuple[float, float]]]


def scene_name(scene: Record, number: int) -> str:
    """What a scene is called."""
    return next((str(scene[key]) for key in SCENE_NAMES if scene.get(key)), f"scene {number + 1}")


def scene_tables(scene: Record, number: int) -> list[tables.Table]:
    """A table for each list of records in a scene."""
    title = scene_name(scene, number)
    return [
        tables.records_table(f"{title}: {key.replace('_', ' ')}", f"scene_{number + 1}_{place}.csv", rows)
        for place, (key, rows) in enumerate(_lists(scene), 1)
    ]


def runs_to_draw(scene: Record) -> tuple[Runs, str, str]:
    """Pairs of run time and error by estimator, and what both are called; no pairs if the scene has none."""
    for _, rows in _lists(scene):
        keys = dict.fromkeys(key for row in rows for key in row)
        times = [key for key in keys if "cpu" in key]
        errors = sorted((key for key in keys if "error" in key), key=lambda key: "threshold" not in key)
        for error in errors if times else ():
            runs = _runs(rows, times[0], error)
            if runs:
                return runs, _axis(times[0]), _axis(error)
    return {}, "", ""


def _runs(rows: list[Record], time: str, error: str) -> Runs:
    runs: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        x, y = _positive(row.get(time)), _positive(row.get(error))
        if x is not None and y is not None:
            name = ", ".join(value for value in row.values() if isinstance(value, str)) or "estimator"
            runs.setdefault(name, []).append((x, y))
    return runs


def _positive(value: Any) -> float | None:
    """The absolute value of a number that is not 0: a logarithmic axis has no other."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and value != 0
    return abs(float(value)) if good else None


def _axis(key: str) -> str:
    """A column's name with its unit in brackets."""
    return f"{key[:-2].replace('_', ' ')} (s)" if key.endswith("_s") else key.replace("_", " ")


def _lists(scene: Record) -> Iterator[tuple[str, list[Record]]]:
    """Lists of records in a scene by their key; records that hold a list stand for one a row of it."""
    for key, value in scene.items():
        rows = [row for one in _records(value) for row in _unfolded(one)]
        if rows:
            yield key, rows


def _unfolded(record: Record) -> list[Record]:
    inner = {key: _records(value) for key, value in record.items()}
    own = {key: value for key, value in record.items() if not inner[key]}
    return [own | row for rows in inner.values() for row in rows] or [own]


def _records(value: Any) -> list[Record]:
    return [one for one in value if isinstance(one, dict)] if isinstance(value, list) else []
