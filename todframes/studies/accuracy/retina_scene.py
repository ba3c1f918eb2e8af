"""Accuracy scenes of triangles on the retina, seen directly or on recorded frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray, IntArray
from todframes.base.errors import DataError
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.curves import weibull
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.psychometrics.threshold_search import find_crossing
from todframes.scoring.naked_eye import CONTRAST_RANGE
from todframes.stimulus import Stimulus
from todframes.studies.accuracy.measure import (
    P_CORRECT,
    Converged,
    Draw,
    FoldedDraw,
    FoldedTrials,
    Method,
    Rule,
    StudyScene,
    ThresholdEstimate,
    Variant,
)

SLOPE_STEP = 0.05
"""Half the difference of ln(level) over which slopes are taken."""


class Views:
    """Triangles, one a column, as a linear observer sees them. `images` has a function of each triangle that
    returns its retina image at a displacement along x and y, in samples; `correct` are the right answers.
    """

    def __init__(
        self,
        observer: PyramidObserver,
        stimuli: Sequence[Stimulus],
        images: Sequence[Callable[[float, float], FloatArray]],
        correct: Sequence[int],
    ) -> None:
        self.observer, self.stimuli, self.images = observer, stimuli, images
        self.correct: IntArray = np.array(correct)
        self.readouts = [observer.linear_readout(stimulus) for stimulus in stimuli]

    def image(self, column: int, displacement: FloatArray) -> FloatArray:
        """Return a retina image, displaced by shares of the largest displacement along x and y."""
        return self.images[column](*(self.observer.position_jitter_samples * displacement).tolist())

    def score(self, displacements: FloatArray, dtype: type[np.floating] = np.float64) -> FloatArray:
        """Compute score deviations, (n, columns, 4), at displacements of shape (n, columns, 2)."""
        score = np.empty((*displacements.shape[:2], 4))
        for column, readout in enumerate(self.readouts):
            weights = readout.deviations.reshape(4, -1).astype(dtype)
            for row, displacement in enumerate(displacements[:, column]):
                score[row, column] = weights @ self.image(column, displacement).ravel().astype(dtype)
        return score

    def probabilities(self, score: FloatArray) -> FloatArray:
        """Compute the probability of each answer at score deviations, both (n, columns, 4)."""
        answers = [readout.answer_probabilities(score[:, column]) for column, readout in enumerate(self.readouts)]
        return np.stack(answers, axis=1)

    def p_correct(self, score: FloatArray) -> FloatArray:
        """Compute the probability of the right answer at score deviations, (n, columns)."""
        return np.asarray(self.probabilities(score)[:, np.arange(len(self.correct)), self.correct])


class Curve(NamedTuple):
    """P(correct) as a function of the level, and where it passes the criterion, if the status is "ok"."""

    p_correct: Callable[[float], float]
    status: str
    threshold: float | None

    def estimate(self, converged: Converged) -> ThresholdEstimate:
        """Return P(correct) at the converged threshold, and the threshold."""
        if self.threshold is None:
            return ThresholdEstimate(math.nan, math.nan)
        return ThresholdEstimate(self.p_correct(converged.threshold), self.threshold)


@dataclass(frozen=True, kw_only=True)
class RetinaScene(StudyScene):
    """Triangles on the retina: averages are over its displacement and the observer's own noise.

    `views` shows the triangles to an observer. `trial_levels` has the level of each, if they are trials whose
    answers are fitted; None: the contrast of one triangle is varied. `place` is a function of the number of
    displacements, of triangles, and a random generator, which places displacements evenly: (n, columns, 2), and
    their weights, (n,). `converged_nodes` are the numbers of Gauss–Legendre displacements along each axis of the
    converged value, the largest last. `label`, `budgets` and `repeats` are those of the closed form, and
    `variant_trials` is the budget at which it is changed.
    """

    views: Callable[[PyramidObserver], Views]
    trial_levels: tuple[float, ...] | None = None
    place: Callable[[int, int, np.random.Generator], tuple[FloatArray, FloatArray]]
    converged_nodes: tuple[int, ...]
    label: str
    budgets: tuple[int, ...]
    repeats: int = 1
    variant_trials: int

    def curve(self, views: Views, score: FloatArray, weights: FloatArray) -> Curve:
        """Find P(correct) as a function of the level from scores at displacements with weights."""
        if self.trial_levels is not None:
            return self._fitted(weights @ views.p_correct(score))

        def p_correct(contrast: float) -> float:
            return float(views.p_correct(contrast * score)[:, 0] @ weights)

        found = find_crossing(p_correct, P_CORRECT, bounds=CONTRAST_RANGE, start=1.0, factor=4.0)
        return Curve(p_correct, *found)

    def converge(self) -> Converged:
        """Average many Gauss–Legendre displacements; the bound is the difference from fewer of them. Because
        P(correct) has kinks, the error falls with the square of their number along an axis. So the error of the
        last average is smaller than its difference from those before. DataError if there is no threshold.
        """
        views = self.views(PyramidObserver())
        curves = []
        for nodes in self.converged_nodes:
            displacements, weights = by_nodes(nodes**2, len(views.stimuli))
            curves.append(self.curve(views, views.score(displacements), weights))
        p_correct, status, threshold = curves[-1]
        fewer = [curve.threshold for curve in curves[:-1] if curve.threshold is not None]
        if threshold is None or not fewer:
            raise DataError(f"{self.title}: the scene has no threshold ({status}); expected one that is ok")
        rise = p_correct(threshold * math.exp(SLOPE_STEP)) - p_correct(threshold * math.exp(-SLOPE_STEP))
        return Converged(threshold, max(abs(one - threshold) for one in fewer), rise / (2.0 * SLOPE_STEP))

    def literal(self, converged: Converged) -> Draw:
        """Set up trials with noise on each neuron."""
        views, gain = self.views(PyramidObserver()), self._gain(converged)
        for stimulus in views.stimuli:
            views.observer.templates(stimulus)

        def draw(n: int, rng: np.random.Generator) -> FloatArray:
            right = np.empty((n, len(views.stimuli)))
            for trial, column in np.ndindex(right.shape):
                image = gain * views.image(column, rng.uniform(-1.0, 1.0, 2))
                answer = views.observer.respond(image, views.stimuli[column], rng)
                right[trial, column] = answer.quarter_turns == views.correct[column]
            return right

        return draw

    def folded(self, converged: Converged) -> FoldedDraw:
        """Set up trials for the folded observer."""
        views, gain = self.views(PyramidObserver()), self._gain(converged)
        covariance = np.array([readout.noise_covariance for readout in views.readouts])

        def draw(n: int, rng: np.random.Generator) -> FoldedTrials:
            score = gain * views.score(rng.uniform(-1.0, 1.0, (n, len(views.stimuli), 2)))
            return FoldedTrials(score, covariance, views.correct, views.probabilities)

        return draw

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Estimate the threshold of one level as other scenes do; fit the answers in trials of many levels."""
        if self.trial_levels is None:
            return super().estimate(outcomes, converged)
        return self._fitted(outcomes).estimate(converged)

    def closed_forms(self, converged: Converged) -> tuple[Method, ...]:
        """Place displacements evenly."""

        def prepare() -> Rule:
            views = self.views(PyramidObserver())
            return lambda n, rng: self._evenly(views, n, rng).estimate(converged)

        return (Method("closed_form", self.label, prepare, 0.3, self.budgets, self.repeats),)

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """List single precision, and pyramid levels with the field that goes with them."""
        views = self.views(PyramidObserver())
        side = max(readout.grid.side for readout in views.readouts)
        size = max(stimulus.size_mrad for stimulus in views.stimuli) / views.observer.settings.retina_pitch_mrad
        levels = side.bit_length() - 3
        other = [levels + 1, *(levels - n for n in (1, 2) if 4 * 2 ** (levels - n) > 6.0 + 2.0 * size)]

        def variant(of_levels: int | None, dtype: type[np.floating] = np.float64) -> Variant:
            def run(rng: np.random.Generator) -> ThresholdEstimate:
                views = self.views(PyramidObserver(levels=of_levels))
                return self._evenly(views, self.variant_trials, rng, dtype).estimate(converged)

            return run

        def label(levels: int) -> str:
            return f"{levels} levels, retina of {4 * 2**levels + 1}² samples"

        single = {f"float64, {label(levels)}": variant(None), "float32": variant(None, np.float32)}
        return single | {label(number): variant(number) for number in other}

    def non_gaussian_bound(self) -> float:
        """Return the bound that the readouts state."""
        return max(readout.non_gaussian_bound for readout in self.views(PyramidObserver()).readouts)

    def _gain(self, converged: Converged) -> float:
        """Return the contrast of the images; those of trials have their own."""
        return converged.threshold if self.trial_levels is None else 1.0

    def _evenly(
        self, views: Views, n: int, rng: np.random.Generator, dtype: type[np.floating] = np.float64
    ) -> Curve:
        displacements, weights = self.place(n, len(views.stimuli), rng)
        return self.curve(views, views.score(displacements, dtype), weights)

    def _fitted(self, p_correct: FloatArray) -> Curve:
        assert self.trial_levels is not None
        settings, rng = FitSettings(p_correct=P_CORRECT, resamples=0), np.random.default_rng(0)
        fit = fit_trials(self.trial_levels, np.clip(p_correct, 0.0, 1.0), settings=settings, rng=rng)
        parameters = {name: getattr(fit, name) for name in ("alpha", "beta", "guess_rate", "lapse_rate")}
        return Curve(lambda level: float(weibull(level, **parameters)), fit.status, fit.threshold)


def by_nodes(n: int, columns: int, _: object = None) -> tuple[FloatArray, FloatArray]:
    """Return n Gauss–Legendre displacements, √n along each axis, (n, columns, 2), and their weights, (n,)."""
    x, weights = np.polynomial.legendre.leggauss(math.isqrt(n))
    displacements = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 1, 2)
    return np.broadcast_to(displacements, (n, columns, 2)), np.outer(weights, weights).ravel() / 4.0
