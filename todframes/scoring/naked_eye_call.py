"""The call `naked_eye`: thresholds without a display."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked
from todframes.observers.interface import Observer, resolve_observer
from todframes.parameters import Numbers, ObserverName, Probability, Progress, counted
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.threshold_search import ComputedThreshold
from todframes.results.advice import above_contrast_1, numerical_errors
from todframes.results.data import Fit
from todframes.results.thresholds import Thresholds


@checked
def naked_eye(
    *,
    size_mrad: float | Numbers | None = None,
    contrast: float | Numbers | None = None,
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    progress: Progress | None = None,
) -> Thresholds:
    """Compute thresholds of the observer without any display in between.

    Parameters
    ----------
    size_mrad : float or sequence of float
        Sizes √(area) in mrad; the threshold is a Weber contrast for each. Give either these or `contrast`.
    contrast : float or sequence of float
        Weber contrasts; the threshold is a size in mrad for each, the acuity.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.

        An object is taken as well: `PyramidObserver(internal_noise=0.25)`.
    p_correct : float
        Raw proportion correct at threshold.
    progress : function of two ints, optional
        Called with the number of thresholds that are done, and of all.

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
    judge, settings = resolve_observer(observer)
    FitSettings(p_correct=p_correct)  # checks it
    values = np.atleast_1d(np.asarray(size_mrad if contrast is None else contrast, dtype=np.float64)).tolist()
    level, given = ("contrast", "size_mrad") if contrast is None else ("size_mrad", "contrast")
    search: Callable[..., ComputedThreshold] = contrast_threshold if contrast is None else acuity
    fits = []
    for value in counted(values, len(values), progress):
        threshold = search(judge, p_correct=p_correct, **{given: value})
        fits.append(Fit.of_computed({given: value}, level, p_correct, threshold))

    def is_easier_if_smaller(fit: Fit) -> bool:
        half = 0.5 * float(fit.group["size_mrad"])
        threshold = contrast_threshold(judge, size_mrad=half, p_correct=p_correct).threshold
        return threshold is not None and fit.threshold is not None and threshold < fit.threshold

    return Thresholds.made(
        "naked-eye",
        started,
        settings=settings | {"p_correct": p_correct},
        fits=tuple(fits),
        warnings=(
            *above_contrast_1(fits, is_easier_if_smaller, settings.get("aperture_sd_deg")),
            *numerical_errors(fits, None),
        ),
    )
