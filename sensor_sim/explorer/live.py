"""Thresholds of a sensor while its parameters move: an estimate first, refined while nothing moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sensor_sim.curve_plan import plan_curve
from sensor_sim.predict import FoldedChain, PredictedThreshold, predict_threshold
from sensor_sim.sensor import Sensor
from todframes.observers.interface import Observer

TOLERANCES = (0.03, 0.002)
"""Relative errors of the estimate and of the refined thresholds."""


@dataclass(frozen=True, slots=True)
class LiveCurve:
    """Thresholds of one sensor at one tolerance.

    Attributes
    ----------
    thresholds : tuple of PredictedThreshold
        In the order of the sizes asked for.
    tolerance : float
        Relative half-width of the 95 % intervals that was aimed at; each threshold states its own.
    seconds : float
        Time since the curve was asked for.
    is_last : bool
        Whether no better curve follows.
    """

    thresholds: tuple[PredictedThreshold, ...]
    tolerance: float
    seconds: float
    is_last: bool


class LiveCurves:
    """Curves of sensors that differ in some parameters from one call to the next."""

    def curves(
        self,
        sensor: Sensor,
        observer: Observer,
        sizes_detectors: Sequence[float],
        *,
        p_correct: float = 0.75,
        tolerances: Sequence[float] = TOLERANCES,
        is_wanted: Callable[[], bool],
    ) -> Iterator[LiveCurve]:
        """Yield a curve for each tolerance, and stop as soon as no more is wanted.

        Parameters
        ----------
        sensor : Sensor
        observer : Observer
            Linear observer.
        sizes_detectors : sequence of float
            Sizes √(area) in detector pitches.
        p_correct : float
            Raw proportion correct at threshold.
        tolerances : sequence of float
            Relative errors to reach, one after the other.
        is_wanted : function of no arguments
            Asked often; when it returns False the computation ends without a further curve.

        Raises
        ------
        SettingsError
            If the observer is not linear, or a size or field is out of range.
        """
        started = time.perf_counter()
        for number, tolerance in enumerate(tolerances, 1):
            found = []
            for size in sizes_detectors:
                if not is_wanted():
                    return
                plan = plan_curve(sensor, observer, size, tolerance=tolerance, p_correct=p_correct)
                chain = FoldedChain(sensor, observer, size, plan)
                found.append(predict_threshold(chain, p_correct=p_correct, tolerance=tolerance))
            yield LiveCurve(tuple(found), tolerance, time.perf_counter() - started, number == len(tolerances))

    def close(self) -> None:
        """End what works for this object."""
