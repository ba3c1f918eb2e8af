"""Counts of right answers from any experiment: a CSV file for `todframes fit`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError
from todframes.base.reading import number_or_text, read_table

COLUMNS = ("level", "n_correct", "n_trials")

MOST_TRIALS = 2**53
"""Largest number of trials; above it, not every whole number is a floating-point number."""


def read_counts(path: Path) -> list[tuple[dict[str, float | str], NDArray[np.float64]]]:
    """Read a file of counts, by group in the order of appearance: the group's values by column name, and an array
    of shape (n, 3): level, n_correct, n_trials. DataError if the file cannot be read, a column is missing, or a
    value is not a number in its range.
    """
    header, rows = read_table(path, COLUMNS)
    names = [name for name in header if name not in COLUMNS]
    groups: dict[tuple[float | str, ...], list[list[float]]] = {}
    for row in rows:
        where, texts = row
        level, n_correct, n_trials = values = row.numbers(COLUMNS)
        if level <= 0:
            raise DataError(f"{where}: level: found {level:g}, expected > 0")
        if not 1 <= n_trials <= MOST_TRIALS or n_trials % 1:
            raise DataError(f"{where}: n_trials: found {n_trials:g}, expected a whole number >= 1 and <= 2^53")
        if not 0 <= n_correct <= n_trials or n_correct % 1:
            raise DataError(f"{where}: n_correct: found {n_correct:g}, expected a whole number, 0 to n_trials")
        groups.setdefault(tuple(number_or_text(texts[name]) for name in names), []).append(values)
    if not groups:
        raise DataError(f"{path}: no counts; expected rows below the header")
    return [(dict(zip(names, group, strict=True)), np.array(values)) for group, values in groups.items()]
