"""Accuracy scenes of the naked eye."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import Readout
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import triangle_on
from todframes.psychometrics.threshold_search import find_crossing
from todframes.scoring.naked_eye import CONTRAST_RANGE
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus
from todframes.studies.accuracy.measure import (
    P_CORRECT,
    Converged,
    Draw,
    FoldedDraw,
    FoldedTrials,
    MonteCarlo,
    Quadrature,
    Rule,
    StudyScene,
    ThresholdEstimate,
    Variant,
    monte_carlos,
)

STUDIED_NODES = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""Gauss–Legendre displacements along each axis."""

VARIANT_NODES = 8


@dataclass(frozen=True)
class NakedEye(StudyScene):
    """A triangle of one size seen directly; the threshold is a contrast, averaged over the retina's displacement.
    `size_mrad` is √(area). The orientations are alike by symmetry: evenly placed trials show one of them.
    """

    size_mrad: float
    converged_nodes: tuple[int, ...] = (24, 32, 48)

    def converge(self) -> Converged:
        """Average many Gauss–Legendre displacements; the bound is the difference from fewer of them.  Because
        P(correct) has kinks, the error falls with the square of their number along an axis. So the error of the
        last average is smaller than its difference from those before.
        """
        observer = PyramidObserver()
        *before, last = (self._proportion(observer, nodes) for nodes in self.converged_nodes)
        threshold = _threshold(last)
        step = 0.05
        rise = last(threshold * math.exp(step)) - last(threshold * math.exp(-step))
        bound = max(abs(_threshold(proportion) - threshold) for proportion in before)
        return Converged(threshold, bound, rise / (2.0 * step))

    def estimators(self, converged: Converged) -> tuple[MonteCarlo | Quadrature, ...]:
        """List the literal Monte Carlo, that on folded scores, expected decisions and Gauss–Legendre nodes."""

        def answers() -> Draw:
            observer, stimulus = PyramidObserver(), Stimulus(self.size_mrad)
            observer.templates(stimulus)

            def draw(n: int, rng: np.random.Generator) -> FloatArray:
                right = np.empty((n, 1))
                for trial in range(n):
                    orientation = ORIENTATIONS[rng.integers(4)]
                    x, y = rng.uniform(-1.0, 1.0, 2)
                    seen = converged.threshold * self._retina(observer, x, y, orientation)
                    right[trial] = observer.respond(seen, stimulus, rng) is orientation
                return right

            return draw

        def trials() -> FoldedDraw:
            observer = PyramidObserver()
            readout = self._readout(observer)

            def draw(n: int, rng: np.random.Generator) -> FoldedTrials:
                correct = rng.integers(4, size=n)
                places = rng.uniform(-1.0, 1.0, (n, 2))
                score = [
                    readout.score_deviations(self._retina(observer, x, y, ORIENTATIONS[k]))
                    for (x, y), k in zip(places, correct, strict=True)
                ]
                return FoldedTrials(
                    converged.threshold * np.array(score)[:, None],
                    readout.noise_covariance,
                    correct[:, None],
                    readout.answer_probabilities,
                )

            return draw

        def closed_form() -> Rule:
            observer = PyramidObserver()
            self._readout(observer)
            return lambda n, _: _estimate(self._proportion(observer, math.isqrt(n)), converged)

        trials_of = tuple(nodes**2 for nodes in STUDIED_NODES)
        label = "closed form, Gauss–Legendre nodes"
        return (*monte_carlos(answers, trials), Quadrature("closed_form", label, closed_form, trials_of, 0.3))

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """List single precision, and pyramid levels with the field that goes with them."""
        side = PyramidObserver().grid(Stimulus(self.size_mrad)).side
        levels = side.bit_length() - 3

        def variant(levels: int, dtype: type[np.floating] = np.float64) -> Variant:
            def run(_: np.random.Generator) -> ThresholdEstimate:
                observer = PyramidObserver(levels=levels)
                return _estimate(self._proportion(observer, VARIANT_NODES, dtype), converged)

            return run

        fewer = {
            f"{levels - n} levels, retina of {4 * 2 ** (levels - n) + 1}² samples": variant(levels - n)
            for n in (1, 2)
            if 4 * 2 ** (levels - n) > 6.0 + 2.0 * self.size_mrad / PyramidSettings().retina_pitch_mrad
        }
        return {
            f"float64, {levels} levels, retina of {side}² samples": variant(levels),
            "float32": variant(levels, np.float32),
            f"{levels + 1} levels, retina of {2 * side - 1}² samples": variant(levels + 1),
            **fewer,
        }

    def non_gaussian_bound(self) -> float:
        """Return the bound that the readout states."""
        return self._readout(PyramidObserver()).non_gaussian_bound

    def _readout(self, observer: PyramidObserver) -> Readout:
        return observer.linear_readout(Stimulus(self.size_mrad))

    def _retina(self, observer: PyramidObserver, x: float, y: float, orientation: Orientation) -> FloatArray:
        """Draw the triangle on the retina, displaced by shares of the largest displacement."""
        grid, jitter = observer.grid(Stimulus(self.size_mrad)), observer.position_jitter_samples
        return triangle_on(grid, self.size_mrad, orientation, x=jitter * x, y=jitter * y)

    def _proportion(
        self, observer: PyramidObserver, nodes: int, dtype: type[np.floating] = np.float64
    ) -> Callable[[float], float]:
        """Return P(correct) as a function of contrast, with so many displacements along each axis."""
        readout = self._readout(observer)
        weights = readout.deviations.reshape(4, -1).astype(dtype)
        places, shares = np.polynomial.legendre.leggauss(nodes)
        score = np.array(
            [
                weights @ self._retina(observer, x, y, Orientation.UP).astype(dtype).ravel()
                for y in places
                for x in places
            ]
        )
        share = np.outer(shares, shares).ravel() / 4.0
        return lambda contrast: float(readout.answer_probabilities(contrast * score)[:, 0] @ share)


def _threshold(proportion: Callable[[float], float]) -> float:
    _, threshold = find_crossing(proportion, P_CORRECT, bounds=CONTRAST_RANGE, start=1.0, factor=4.0)
    return math.nan if threshold is None else threshold


def _estimate(proportion: Callable[[float], float], converged: Converged) -> ThresholdEstimate:
    return ThresholdEstimate(proportion(converged.threshold), _threshold(proportion))


def small() -> NakedEye:
    """Make the scene of a triangle half as large again as at the acuity."""
    description = "The activity that the four triangles cause is 94 to 97 % alike."
    return NakedEye("naked_eye_small", "naked eye, small: 0.6 mrad", description, "contrast", 0.6)


def acuity() -> NakedEye:
    """Make the scene whose threshold contrast is 1."""
    description = "About the smallest triangle that is seen at a contrast of 1; the four are 99 % alike."
    return NakedEye("naked_eye_acuity", "naked eye, at the acuity: 0.4 mrad", description, "contrast", 0.4)


def large() -> NakedEye:
    """Make the scene in which the pyramid has more bands."""
    description = "The pyramid has two bands more than for the small ones; the displacement hardly matters."
    return NakedEye("naked_eye_large", "naked eye, large: 6 mrad", description, "contrast", 6.0)
