"""The call `fit_counts`: psychometric functions of counts."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import ArrayLike

from todframes.base.errors import DataError
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.parameters import Seed
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.fit import fit_counts as fit_counts_of_one
from todframes.results.advice import levels_to_add
from todframes.results.data import Fit
from todframes.results.thresholds import Thresholds


@checked
def fit_counts(
    level: ArrayLike,
    n_correct: ArrayLike,
    n_trials: ArrayLike,
    *,
    groups: Mapping[str, Sequence[float | str]] | None = None,
    fit: FitSettings | None = None,
    rng: Seed | Rng = 1,
) -> Thresholds:
    """Fit psychometric functions to counts of correct answers.

    Parameters
    ----------
    level, n_correct, n_trials : array_like, shape (n,)
        Stimulus strength, > 0; whole numbers with 0 <= n_correct <= n_trials and n_trials >= 1.
    groups : mapping, optional
        Columns of n values each by name; rows with the same values share a curve. Default: one curve.
    fit : FitSettings, optional
        Criterion (`p_correct`), fixed and free parameters of the fits.
    rng : int, SeedSequence or Generator
        Seed of the resamples.

    Returns
    -------
    Result
        One threshold and its fitted curve for each group.

    Raises
    ------
    DataError
        If the shapes differ, there is no row, or a value is out of its range.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.fit_counts([0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40, 40, 40, 40])
    >>> result
    <Result of fit: At 75 % correct the threshold level is 0.399 (95 % interval 0.315 to 0.530).>
    """
    started, seed = time.perf_counter(), seed_of(rng)
    fit = fit or FitSettings()
    columns = []
    for name, given in {"level": level, "n_correct": n_correct, "n_trials": n_trials}.items():
        try:
            columns.append(np.asarray(given, np.float64))
        except (TypeError, ValueError):
            raise DataError(f"{name}: found {given!r:.80}, expected numbers") from None
    are_rows = {column.shape for column in columns} == {(columns[0].size,)}  # the fit refuses others
    names = {name: list(values) for name, values in (groups or {}).items()}
    for name, values in names.items():
        if len(values) != columns[0].size:
            raise DataError(f"groups: {name}: found {len(values)} values, expected {columns[0].size}, one a row")
    rows: dict[tuple[float | str, ...], list[int]] = {}
    for row in range(columns[0].size):
        key = tuple(values[row] for values in names.values())
        rows.setdefault(tuple(part if isinstance(part, str) else float(part) for part in key), []).append(row)
    fits = []
    for number, (key, of_group) in enumerate((rows or {(): []}).items()):
        own_rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        counts = [column[of_group] for column in columns] if rows and are_rows else columns
        fitted = fit_counts_of_one(*counts, settings=fit, rng=own_rng)
        fits.append(Fit.of_counts(dict(zip(names, key, strict=True)), "level", fitted))
    return Thresholds.made(
        "fit", started, settings=asdict(fit), seed=seed, fits=tuple(fits), warnings=levels_to_add(fits)
    )
