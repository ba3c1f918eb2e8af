"""Two algorithms that are alike: how often they are called different, and how often the interval leaves 1 out.

Simulated experiments of the real observer with external noise in the frames: some of it is the same after both
algorithms, and some is each one's own. Their thresholds are equal; the answers in single trials are not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from timing import Row

from todframes.enhancement.compare import SIGNIFICANCE
from todframes.observers.decision import answer_probability
from todframes.observers.pyramid import PyramidObserver
from todframes.parameters import CurveName
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.psychometrics.paired_bootstrap import ThresholdRatio, ratio_draws, threshold_ratio
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import Orientation, Stimulus, coverage

FloatArray = NDArray[np.float64]

SIZE_MRAD = 1.0
EXPERIMENTS = 300


class Case(NamedTuple):
    """An experiment. Noise is in units of the internal noise, as standard deviations of score differences."""

    decisions: str
    n_trials: int
    common_noise: float
    own_noise: float
    n_levels: int = 7
    spread: float = 2.0


CASES = [
    Case(decisions, n_trials, *noise)
    for decisions in ("expected", "sampled")
    for n_trials in (4, 12, 28)
    for noise in ((1.0, 0.01), (1.0, 0.5), (0.0, 0.5))
]


class Scene:
    """Scores of triangles at places of their own, and the noise on them."""

    def __init__(self) -> None:
        observer = PyramidObserver()
        readout = observer.readout(Stimulus(SIZE_MRAD))
        side, rng = readout.grid.side, np.random.default_rng(1)
        signals = []
        for dx, dy in rng.uniform(-0.5, 0.5, (300, 2)):
            triangle = coverage(
                (side, side),
                size_px=SIZE_MRAD / readout.grid.pitch_mrad,
                x_px=side // 2 + dx,
                y_px=side // 2 + dy,
                orientation=Orientation.UP,
            )
            signals.append(readout.score_deviations(triangle))
        self.signals = np.array(signals)
        self.covariance = readout.noise_covariance
        weights = readout.deviations.reshape(4, -1)
        external = weights @ weights.T  # of white noise in the frame
        external *= np.trace(self.covariance) / np.trace(external)
        self.internal_root, self.external_root = _root(self.covariance), _root(external)
        self.threshold = contrast_threshold(observer, size_mrad=SIZE_MRAD).threshold

    def ratio(
        self, case: Case, rng: np.random.Generator, *, gain: float = 1.0, resamples: int = 2000
    ) -> ThresholdRatio:
        """Of one experiment; the second algorithm's signal is `gain` times the first's."""
        middle = self.threshold * np.sqrt(1.0 + case.common_noise**2 + case.own_noise**2)
        level = np.repeat(middle * np.geomspace(1 / case.spread, case.spread, case.n_levels), case.n_trials)
        n = len(level)
        signal = level[:, None] * self.signals[rng.integers(len(self.signals), size=n)]
        common = case.common_noise * rng.normal(size=(n, 4)) @ self.external_root.T
        internal = rng.normal(size=(n, 4)) @ self.internal_root.T
        answers = []
        for factor in (1.0, gain):
            own = case.own_noise * rng.normal(size=(n, 4)) @ self.external_root.T
            scores = factor * signal + common + own
            if case.decisions == "expected":
                answers.append(answer_probability(scores, self.covariance, 0, tolerance=1e-9))
            else:
                answers.append(((scores + internal).argmax(axis=1) == 0).astype(np.float64))
        curve: CurveName = "observer" if case.decisions == "expected" else "weibull"
        fits = [fit_trials(level, p, curve=curve, settings=FitSettings(resamples=0), rng=rng) for p in answers]
        settings = FitSettings(resamples=resamples)
        draws = ratio_draws(level, np.array(answers), fits, pairs=[(1, 0)], settings=settings, rng=rng)
        return threshold_ratio(draws)


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))


def rows() -> list[Row]:
    """For each case, both shares in %."""
    scene, found = Scene(), []
    for number, case in enumerate(CASES):
        rng = np.random.default_rng(number)
        ratios = [scene.ratio(case, rng) for _ in range(EXPERIMENTS)]
        different = sum(one.p_value < SIGNIFICANCE for one in ratios)
        known = [one.ratio_ci95 for one in ratios if one.ratio_ci95 is not None]
        outside = sum((low is not None and low > 1.0) or (high is not None and high < 1.0) for low, high in known)
        about = (
            f"{case.decisions}, {case.n_trials} trials a level, noise {case.common_noise:g} + {case.own_noise:g}"
        )
        found.append(Row(f"alike but called different, %: {about}", 100.0 * different / EXPERIMENTS, "<= 5"))
        found.append(Row("   the same, interval without 1, %", 100.0 * outside / EXPERIMENTS, "<= 5"))
    return found
