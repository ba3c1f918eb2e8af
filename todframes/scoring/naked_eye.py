"""Thresholds of the naked eye: the triangle itself lies on the retina, without a display or frames.

The method is that of Hogervorst et al. 2001, section 7.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, checked
from todframes.observers.interface import Observer, Readout, resolve_observer
from todframes.observers.retina import triangle_on
from todframes.parameters import Numbers, ObserverName, Probability, Progress, counted
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.threshold_search import ComputedThreshold, find_crossing, if_known
from todframes.results.advice import above_contrast_1, numerical_errors
from todframes.results.data import Fit
from todframes.results.thresholds import Thresholds
from todframes.stimulus import HEIGHT_PER_SIZE, ORIENTATIONS, Stimulus

NODES = (6, 8, 12, 16, 24, 32, 48)
"""Numbers of Gauss–Legendre displacements along each axis, tried in turn until the threshold is stable."""

SPAN = 1.1
"""Ratio of the levels to the threshold between which the slope of P(correct) is taken."""

FINE_STEP = 0.25
"""Pitch of another retina, as a multiple of the observer's, whose own error is next to nothing beside it."""

STEPS, COSTLY_SIDE = (FINE_STEP, 0.5, 2.0, 2.0 / 3.0), 2049
"""Pitches of another retina, as multiples of the observer's, to find the error by its step: the first whose grid
has at most this side, which takes two seconds, or the last that the observer allows."""

CONTRAST_RANGE = (1e-12, 1e12)
"""Smallest and largest contrast in the search for a threshold; the largest also limits `contrast` arguments."""

SIZE_RANGE_SAMPLES = (1e-2, 1e3)
"""Smallest and largest size in the search for an acuity, in retina samples; larger sizes are refused."""


def proportion_correct(observer: Observer, *, size_mrad: float, contrast: float, nodes: int = 16) -> float:
    """Compute P(correct) for a triangle seen directly, averaged over orientation and displacement. `size_mrad` is
    √(area), `contrast` a Weber contrast, both > 0; `nodes` is the number of Gauss–Legendre displacements along
    each axis. Raises SettingsError if the observer is not linear, or a value is out of range.
    """
    if not 0 < contrast <= CONTRAST_RANGE[1] * 1.000001:  # the limit of the search, with room for rounding
        raise SettingsError(f"{argument.contrast}: found {contrast!r}, expected a finite number > 0, at most 1e12")
    _size_samples(observer, size_mrad)
    return _Responses.to(observer, size_mrad, nodes).proportion_correct(contrast)


def contrast_threshold(observer: Observer, *, size_mrad: float, p_correct: float = 0.75) -> ComputedThreshold:
    """Find the Weber contrast at which a triangle of a given size is answered correctly with `p_correct`.
    `size_mrad` is √(area), > 0. Errors are those of `proportion_correct`.
    """
    size_samples = _size_samples(observer, size_mrad)

    def threshold(nodes: int) -> ComputedThreshold:
        proportion = _Responses.to(observer, size_mrad, nodes).proportion_correct
        # It saturates at P without internal noise.
        return ComputedThreshold(
            *find_crossing(proportion, p_correct, bounds=CONTRAST_RANGE, start=1.0, factor=4.0, saturates=True)
        )

    def proportion_of(judge: Observer, contrast: float) -> float:
        return _Responses.to(judge, size_mrad).proportion_correct(contrast)

    # Displacements hardly change the response to triangles of hundreds of samples.
    computed = _refined(threshold, NODES if size_samples < 200.0 else (3, 4, *NODES))
    return _with_step_error(computed, observer, size_mrad, proportion_of, p_correct)


def acuity(observer: Observer, *, contrast: float = 1.0, p_correct: float = 0.75) -> ComputedThreshold:
    """Find the size, √(area) in mrad, at which a triangle of a Weber contrast is answered with `p_correct`.
    Errors are those of `proportion_correct`.
    """
    pitch = observer.grid(Stimulus(1e-6)).pitch_mrad  # of a size that every grid holds
    sizes = (SIZE_RANGE_SAMPLES[0] * pitch, SIZE_RANGE_SAMPLES[1] * pitch)

    def threshold(nodes: int) -> ComputedThreshold:
        def proportion(size_mrad: float) -> float:
            return proportion_correct(observer, size_mrad=size_mrad, contrast=contrast, nodes=nodes)

        return ComputedThreshold(
            *find_crossing(proportion, p_correct, bounds=sizes, start=4.0 * pitch, factor=4.0)
        )

    def proportion_of(judge: Observer, size_mrad: float) -> float:
        return _Responses.to(judge, size_mrad).proportion_correct(contrast)

    # Each step of this search computes a new readout and its displacements.
    computed = _refined(threshold, NODES[:-2])
    return _with_step_error(computed, observer, SPAN * (computed.threshold or 1.0), proportion_of, p_correct)


def _with_step_error(
    computed: ComputedThreshold,
    observer: Observer,
    largest_mrad: float,
    proportion: Callable[[Observer, float], float],
    p_correct: float,
) -> ComputedThreshold:
    """Add the error by the step of the retina, where it is that of a computation, to a threshold's error.
    `proportion` is P(correct) of an observer at a level, for sizes up to `largest_mrad`. On another retina it
    differs from `p_correct` at the threshold; its slope there turns the difference into one of the threshold. The
    error grows as the square of the pitch, times a factor that varies with the places of edges between samples: it
    is the difference from a retina of s times the pitch, divided by |1 - s²| (Richardson). A quarter of the pitch
    leaves almost no error. A threshold with too large an error is none.
    """
    if computed.threshold is None or observer.with_retina_step(1.0) is None:
        return if_known(computed)
    step, other = 1.0, None
    for tried in STEPS:  # the first that is not costly, or the last that the observer allows
        with suppress(SettingsError):
            judge = observer.with_retina_step(tried)
            assert judge is not None
            side = judge.grid(Stimulus(largest_mrad)).side
            step, other = tried, judge
            if side <= COSTLY_SIDE:
                break
    if other is None:
        return replace(computed, numerical_error=None)
    below, at, above = (proportion(other, factor * computed.threshold) for factor in (1.0 / SPAN, 1.0, SPAN))
    slope = (above - below) / ((SPAN - 1.0 / SPAN) * computed.threshold)
    change = abs(at - p_correct) / slope if slope > 0.0 else math.inf
    left = step**2 if step > FINE_STEP else 0.0
    return if_known(
        replace(computed, numerical_error=change / abs(1.0 - left) + (computed.numerical_error or 0.0))
    )


def _refined(threshold: Callable[[int], ComputedThreshold], nodes_to_try: Sequence[int]) -> ComputedThreshold:
    """Compute a threshold with more and more displacements until it is stable."""
    result = threshold(nodes_to_try[0])
    for nodes in nodes_to_try[1:]:
        before, result = result, threshold(nodes)
        if before.threshold is not None and result.threshold is not None:
            change = abs(result.threshold - before.threshold)
            result = replace(result, numerical_error=change)
            if change <= 2e-4 * before.threshold:
                break
        elif before.status == result.status:
            break
    return result


class _Responses(NamedTuple):
    """Scores at contrast 1, and the readout that made them. `deviations` has shape (orientation, node, 4).
    `weights` are those of the nodes.
    """

    readout: Readout
    deviations: FloatArray
    weights: FloatArray

    @classmethod
    def to(cls, observer: Observer, size_mrad: float, nodes: int = 16) -> _Responses:
        """Compute the scores for a triangle of each orientation at each node."""
        readout = observer.linear_readout(Stimulus(size_mrad))
        side, pitch = readout.grid.side, readout.grid.pitch_mrad
        jitter = observer.position_jitter_samples
        displaced, weights = np.polynomial.legendre.leggauss(nodes if jitter > 0 else 1)
        # The triangle covers a part of the grid; its apex is farthest from its centre.
        reach = 2.0 / 3.0 * HEIGHT_PER_SIZE * size_mrad / pitch + jitter
        half_width = math.ceil(min(reach + 1.0, side // 2))
        seen = readout.cropped(half_width)
        at = [{"x": jitter * dx, "y": jitter * dy} for dy in displaced for dx in displaced]
        images = [
            [triangle_on(seen.grid, size_mrad, turn, centre=observer.centre, **node) for node in at]
            for turn in ORIENTATIONS
        ]
        deviations = np.array([[seen.score_deviations(image) for image in row] for row in images])
        return cls(readout, deviations, np.outer(weights, weights).ravel() / 4.0)

    def proportion_correct(self, contrast: float) -> float:
        """Compute P(correct) at a contrast."""
        answers = self.readout.answer_probabilities(contrast * self.deviations)
        correct = np.stack([of_shown[:, k] for k, of_shown in enumerate(answers)])
        return float((correct @ self.weights).mean())


def _size_samples(observer: Observer, size_mrad: float) -> float:
    """Convert a size to retina samples; SettingsError if it is not > 0, or so large that it takes minutes."""
    check_positive(argument.size_mrad, size_mrad)
    pitch = observer.grid(Stimulus(size_mrad)).pitch_mrad
    most = SIZE_RANGE_SAMPLES[1]
    if size_mrad / pitch > most * (1.0 + 1e-9):
        raise SettingsError(
            f"{argument.size_mrad}: found {size_mrad:g}, {size_mrad / pitch:.6g} samples of the retina, expected "
            f"at most {most * pitch:g}, {most:g} samples, which take half a minute"
        )
    return size_mrad / pitch


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
