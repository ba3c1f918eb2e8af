"""The call `naked_eye`: thresholds without a display."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from todframes.base.errors import SettingsError, argument
from todframes.calls.shared import (
    Progress,
)
from todframes.observers.interface import Observer, described
from todframes.psychometrics.fit import FitSettings
from todframes.report.advice import above_contrast_1
from todframes.report.data import (
    Fit,
)
from todframes.report.result import Result


def naked_eye(
    *,
    size_mrad: float | Sequence[float] | None = None,
    contrast: float | Sequence[float] | None = None,
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    places: int = 1,
    progress: Progress | None = None,
) -> Result:
    """Compute thresholds of the observer without any display in between, as `todframes naked-eye` does.

    Parameters
    ----------
    size_mrad : float or sequence of float
        Sizes √(area) in mrad; the threshold is a Weber contrast for each. Give either this or `contrast`.
    contrast : float or sequence of float
        Weber contrasts; the threshold is a size in mrad for each, the acuity.
    observer : str or Observer
        Observer as in `score`; it must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    places : int
        Number of places, far apart, at which the triangle may be; 1: its place is known.
    progress : function of an int, optional
        Called with the number of thresholds that were just found.

    Returns
    -------
    Result
        One threshold for each size or contrast, and a warning for each contrast above 1.

    Raises
    ------
    SettingsError
        If both or none are given, the observer is not linear, or a value is out of its range.

    Examples
    --------
    >>> import todframes as tod
    >>> (one,) = tod.naked_eye(size_mrad=1.0).thresholds
    >>> f"{one.threshold:.3f} ± {one.threshold_numerical_error:.0e}"
    '0.146 ± 2e-05'
    """
    started = time.perf_counter()
    from todframes.scoring.naked_eye import acuity, contrast_threshold

    if (contrast is None) == (size_mrad is None):
        raise SettingsError(f"expected one of {argument.contrast} and {argument.size_mrad}")
    judge, settings = described(observer)
    FitSettings(p_correct=p_correct)  # checks it
    values = np.atleast_1d(np.asarray(size_mrad if contrast is None else contrast, dtype=np.float64)).tolist()
    level, given = ("contrast", "size_mrad") if contrast is None else ("size_mrad", "contrast")
    fits = []
    for value in values:
        if contrast is None:
            found = contrast_threshold(judge, size_mrad=value, p_correct=p_correct, places=places)
        else:
            found = acuity(judge, contrast=value, p_correct=p_correct, places=places)
        fits.append(Fit.of_computed({given: value}, level, p_correct, found))
        if progress is not None:
            progress(1)

    def is_easier_if_smaller(fit: Fit) -> bool:
        half = 0.5 * float(fit.group["size_mrad"])
        threshold = contrast_threshold(judge, size_mrad=half, p_correct=p_correct, places=places).threshold
        return threshold is not None and fit.threshold is not None and threshold < fit.threshold

    return Result.made(
        "naked-eye",
        started,
        settings=settings | {"p_correct": p_correct} | ({"places": places} if places > 1 else {}),
        fits=tuple(fits),
        warnings=above_contrast_1(fits, is_easier_if_smaller),
    )
