"""Accuracy scenes on the retina: a triangle that is seen directly, and those of recorded display frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, argument
from todframes.frames.dataset import load_dataset
from todframes.frames.trials import Trial
from todframes.observers.interface import Readout
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.psychometrics.curves import weibull
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.psychometrics.threshold_search import find_crossing
from todframes.scoring.naked_eye import CONTRAST_RANGE
from todframes.scoring.score import groups_of
from todframes.scoring.trial_scores import KRONECKER_STEPS_2D, read_trial, retina_image
from todframes.stimulus import Orientation, Stimulus
from todframes.studies.accuracy.measure import (
    P_CORRECT,
    AccuracyScene,
    Converged,
    Draw,
    Rule,
    ThresholdEstimate,
)

SLOPE_STEP = 0.05
"""Half the difference of ln(level) over which slopes are taken."""

DATASETS = (Path("sample_frames/naked_eye"), Path("sample_frames/staring_camera"))
"""Folders that are searched for recorded frames."""


class TriangleView(NamedTuple):
    """A triangle as the observer sees it, and the number of its right answer. `image` is a function that returns
    the retina image at a displacement along x and y, in shares of the largest one.
    """

    stimulus: Stimulus
    readout: Readout
    image: Callable[[float, float], FloatArray]
    correct: int

    def scores(self, displacements: FloatArray) -> FloatArray:
        """Compute score deviations, (n, 4), at displacements of shape (n, 2)."""
        return np.array([self.readout.score_deviations(self.image(x, y)) for x, y in displacements.tolist()])

    def p_correct(self, scores: FloatArray) -> FloatArray:
        """Compute the probability of the right answer at score deviations (n, 4): (n,)."""
        return self.readout.answer_probabilities(scores)[:, self.correct]


class Curve(NamedTuple):
    """P(correct) as a function of the level, and where it passes the criterion, if the status is "ok"."""

    p_correct: Callable[[float], float]
    status: str
    threshold: float | None

    def estimate(self, level: float) -> ThresholdEstimate:
        """Return P(correct) at a level, and the threshold."""
        if self.threshold is None:
            return ThresholdEstimate(math.nan, math.nan)
        return ThresholdEstimate(self.p_correct(level), self.threshold)


Place = Callable[[int, int, np.random.Generator], tuple[FloatArray, FloatArray]]
"""Function of numbers of displacements and of triangles that places displacements evenly. It returns shares of the
largest one, (triangles, n, 2), and their weights, (n,)."""


def naked_eye_small(*, size_mrad: float = 0.6, converged_nodes: Sequence[int] = (24, 32, 48)) -> AccuracyScene:
    """Make the scene of a small triangle that is seen directly. The orientations are alike by symmetry: all trials
    show one.
    """

    def views(observer: PyramidObserver) -> list[TriangleView]:
        stimulus, jitter = Stimulus(size_mrad), observer.position_jitter_samples
        grid = observer.grid(stimulus)

        def image(x: float, y: float) -> FloatArray:
            return triangle_on(grid, size_mrad, Orientation.UP, x=jitter * x, y=jitter * y)

        return [TriangleView(stimulus, observer.linear_readout(stimulus), image, Orientation.UP.quarter_turns)]

    return retina_scene(
        "naked_eye_small",
        f"naked eye, small: {size_mrad:g} mrad",
        "The activity that the four triangles cause is 94 to 97 % alike.",
        level="contrast",
        views=views,
        trial_levels=None,
        converged_nodes=converged_nodes,
        place=by_nodes,
        budgets=tuple(nodes**2 for nodes in (1, 2, 3, 4, 6, 8, 12, 16, 24)),
    )


def recorded(
    path: Path | None = None, *, every: int = 1, converged_nodes: Sequence[int] = (6, 8)
) -> AccuracyScene:
    """Make the scene of a dataset's middle group, by default of one of the sample sets in the current folder, or
    of `every` so many of its trials. All methods get the same frames, so the difference of these frames from
    others is no part of the error. DataError or SettingsError if there is no dataset, or it cannot be read.
    """
    if path is None:
        path = next((folder for folder in DATASETS if folder.is_dir()), None)
        if path is None:
            places = " or ".join(map(str, DATASETS))
            raise DataError(f"scene recorded: found no {places} here, expected a dataset ({argument.dataset})")
    dataset = load_dataset(path)
    groups = groups_of(dataset.trials)
    values, rows = groups[len(groups) // 2]
    trials = [dataset.trials[int(row)] for row in rows]
    trials = [trial for trial in trials if trial.name not in dataset.spoilt][::every]

    def views(observer: PyramidObserver) -> list[TriangleView]:
        jitter = observer.position_jitter_samples

        def view(trial: Trial) -> TriangleView:
            readout = observer.linear_readout(trial.stimulus)
            grid = observer.grid(trial.stimulus)
            shown = read_trial(dataset, trial, observer, grid, [(-jitter, -jitter), (jitter, jitter)])

            def image(x: float, y: float) -> FloatArray:
                return retina_image(shown, grid, (jitter * x, jitter * y))

            return TriangleView(trial.stimulus, readout, image, trial.orientation.quarter_turns)

        return [*map(view, trials)]

    group = zip(dataset.experiment.group_by, values, strict=True)
    label = ", ".join(f"{name} {value}" for name, value in group)
    return retina_scene(
        "recorded",
        f"recorded frames: {label}",
        f"{len(trials)} frames of {dataset.path.name} are given, their noise included. What is averaged is the "
        "displacement of the retina and the observer's own noise; the threshold is that of the fitted curve.",
        level=dataset.experiment.level,
        views=views,
        trial_levels=[trial.level for trial in trials],
        converged_nodes=converged_nodes,
        place=by_sequence,
        budgets=(1, 2, 4, 8, 16, 32, 64),
        repeats=8,
    )


def retina_scene(
    name: str,
    title: str,
    description: str,
    *,
    level: str,
    views: Callable[[PyramidObserver], list[TriangleView]],
    trial_levels: Sequence[float] | None,
    converged_nodes: Sequence[int],
    place: Place,
    budgets: tuple[int, ...],
    repeats: int = 1,
) -> AccuracyScene:
    """Make a scene on the retina, where averages are over its displacement and the observer's own noise.

    Answers in trials of `trial_levels` are fitted; with None, the contrast of one triangle is varied. The
    converged value is a mean over Gauss–Legendre displacements, so many along each axis; its bound is the
    difference from fewer of them. P(correct) has kinks, so the error falls with the square of their number, and
    that of the last mean is smaller than its difference from those before. DataError if there is no threshold.
    """

    def curve(shown: list[TriangleView], displacements: FloatArray, weights: FloatArray) -> Curve:
        scores = [view.scores(at) for view, at in zip(shown, displacements, strict=True)]
        if trial_levels is not None:
            each = [view.p_correct(of) @ weights for view, of in zip(shown, scores, strict=True)]
            return fitted(trial_levels, np.array(each))

        def p_correct(contrast: float) -> float:
            return float(shown[0].p_correct(contrast * scores[0]) @ weights)

        found = find_crossing(p_correct, P_CORRECT, bounds=CONTRAST_RANGE, start=1.0, factor=4.0)
        return Curve(p_correct, *found)

    shown = views(PyramidObserver())
    curves = [curve(shown, *by_nodes(nodes**2, len(shown))) for nodes in converged_nodes]
    p_correct, status, threshold = curves[-1]
    fewer = [each.threshold for each in curves[:-1] if each.threshold is not None]
    if threshold is None or not fewer:
        raise DataError(f"{title}: the scene has no threshold ({status}); expected one that is ok")
    rise = p_correct(threshold * math.exp(SLOPE_STEP)) - p_correct(threshold * math.exp(-SLOPE_STEP))
    bound = max(abs(each - threshold) for each in fewer)
    converged = Converged(threshold, bound, rise / (2.0 * SLOPE_STEP))
    gain = threshold if trial_levels is None else 1.0

    def literal() -> Draw:
        observer = PyramidObserver()
        shown = views(observer)
        for view in shown:
            observer.templates(view.stimulus)

        def answer(view: TriangleView, rng: np.random.Generator) -> bool:
            image = gain * view.image(*rng.uniform(-1.0, 1.0, 2).tolist())
            return observer.respond(image, view.stimulus, rng).quarter_turns == view.correct

        return lambda n, rng: np.array([[answer(view, rng) for view in shown] for _ in range(n)], np.float64)

    def expected() -> Draw:
        shown = views(PyramidObserver())

        def p_correct(view: TriangleView, displacements: FloatArray) -> FloatArray:
            return view.p_correct(gain * view.scores(displacements))

        return lambda n, rng: np.stack([p_correct(view, rng.uniform(-1.0, 1.0, (n, 2))) for view in shown], axis=1)

    def closed_form() -> Rule:
        shown = views(PyramidObserver())
        return lambda n, rng: curve(shown, *place(n, len(shown), rng)).estimate(threshold)

    def fit(outcomes: FloatArray) -> ThresholdEstimate:
        return fitted(trial_levels or (), outcomes).estimate(threshold)

    return AccuracyScene(
        name=name,
        title=title,
        description=description,
        level=level,
        converged=converged,
        p_correct_error_bound=max(view.readout.non_gaussian_bound for view in shown),
        literal=literal,
        expected=expected,
        closed_form=closed_form,
        budgets=budgets,
        repeats=repeats,
        estimate=converged.estimate if trial_levels is None else fit,
        # Fits to fewer than four answers of each frame are off by more than 1/√N.
        smallest=1 if trial_levels is None else 4,
        fewest=64 if trial_levels is None else 16,
    )


def fitted(levels: Sequence[float], p_correct: FloatArray) -> Curve:
    """Fit a psychometric function to P(correct) of trials."""
    settings, rng = FitSettings(p_correct=P_CORRECT, resamples=0), np.random.default_rng(0)
    fit = fit_trials(levels, np.clip(p_correct, 0.0, 1.0), settings=settings, rng=rng)
    parameters = {name: getattr(fit, name) for name in ("alpha", "beta", "guess_rate", "lapse_rate")}
    return Curve(lambda level: float(weibull(level, **parameters)), fit.status, fit.threshold)


def by_nodes(n: int, columns: int, _: object = None) -> tuple[FloatArray, FloatArray]:
    """Place n Gauss–Legendre displacements, √n along each axis, as a `Place`."""
    x, weights = np.polynomial.legendre.leggauss(math.isqrt(n))
    displacements = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    return np.broadcast_to(displacements, (columns, n, 2)), np.outer(weights, weights).ravel() / 4.0


def by_sequence(n: int, columns: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Place a low-discrepancy sequence, begun anywhere for each triangle, as a `Place`."""
    places = rng.random((columns, 1, 2)) + np.arange(n)[:, None] * KRONECKER_STEPS_2D
    return 2.0 * (places % 1.0) - 1.0, np.full(n, 1.0 / n)
