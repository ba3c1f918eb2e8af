"""Thresholds of expected decisions: their bias on exact points, and how often intervals hold the true threshold.

Exact points are means over places of the triangle and the retina, computed without trials. An experiment draws
trials from a large set of probabilities at each level; detector noise is independent between trials.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from timing import Row

from sensor_sim.chain.sensor import load_sensor
from sensor_sim.thresholds.predict import FoldedChain
from todframes.observers.decision import answer_probability
from todframes.observers.pyramid import PyramidObserver
from todframes.parameters import CurveName
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.psychometrics.threshold_search import find_crossing
from todframes.stimulus import Orientation, Stimulus, coverage

FloatArray = NDArray[np.float64]

SAMPLES = Path(__file__).parents[2] / "sample_frames"
EXPERIMENTS = 300
POOL = 20_000
"""Probabilities at each level from which the trials of experiments are drawn."""


class Scene:
    """A stimulus at many levels: the exact P(correct) and probabilities of single trials."""

    def __init__(
        self, name: str, signal: FloatArray, internal: FloatArray, external: FloatArray, is_snr: bool
    ) -> None:
        """Take score deviations, (n, 4), of one answer, and noise covariances, (4, 4) and (n, 4, 4)."""
        self.name, self.signal, self.internal, self.external, self.is_snr = (
            name,
            signal,
            internal,
            external,
            is_snr,
        )
        values, vectors = np.linalg.eigh(external)
        self.root = vectors * np.sqrt(np.clip(values, 0.0, None))[:, None, :]

    def proportion(self, level: float) -> float:
        """Compute the exact P(correct)."""
        signal, noise = (
            (self.signal, self.external / level**2) if self.is_snr else (level * self.signal, self.external)
        )
        return float(answer_probability(signal, self.internal + noise, 0, tolerance=1e-9).mean())

    def level_at(self, p_correct: float) -> float | None:
        """Find the level of a proportion correct; None if it is never reached."""
        return find_crossing(self.proportion, p_correct, bounds=(1e-4, 1e3), start=1.0, factor=2.0)[1]

    def drawn(self, level: float, rng: np.random.Generator) -> FloatArray:
        """Draw probabilities of single trials."""
        chosen = rng.integers(len(self.signal), size=POOL)
        noise = np.einsum("nij,nj->ni", self.root[chosen], rng.normal(size=(POOL, 4)))
        signal = self.signal[chosen]
        scores = signal + noise / level if self.is_snr else level * signal + noise
        return answer_probability(scores, self.internal, 0, tolerance=1e-9)


def naked_eye(size_mrad: float, external: float = 0.0) -> Scene:
    """Triangles at random places on the retina, with white noise in the frames in units of the internal noise."""
    readout = PyramidObserver().readout(Stimulus(size_mrad))
    side, rng = readout.grid.side, np.random.default_rng(1)
    signals = [
        readout.score_deviations(
            coverage(
                (side, side),
                size_px=size_mrad / readout.grid.pitch_mrad,
                x_px=side // 2 + dx,
                y_px=side // 2 + dy,
                orientation=Orientation.UP,
            )
        )
        for dx, dy in rng.uniform(-0.5, 0.5, (1000, 2))
    ]
    weights = readout.deviations.reshape(4, -1)
    white = weights @ weights.T
    white *= external**2 * np.trace(readout.noise_covariance) / np.trace(white)
    name = f"naked eye, {size_mrad:g} mrad" + (f", frame noise {external:g}" if external else "")
    covariances = np.broadcast_to(white, (len(signals), 4, 4))
    return Scene(name, np.array(signals), readout.noise_covariance, covariances, is_snr=False)


def camera(file: str, size_detectors: float) -> Scene:
    """Triangles at random places on the detectors of a sample sensor."""
    chain = FoldedChain(load_sensor(SAMPLES / f"{file}.toml"), PyramidObserver(), size_detectors)
    up = chain.phases(25, np.random.default_rng(1))[0]
    assert up.correct == 0
    external = np.repeat(up.noise, up.signal.shape[1], axis=0)
    name = f"{file}, {size_detectors:g} detectors"
    return Scene(name, up.signal.reshape(-1, 4), chain.noise_covariance, external, is_snr=True)


class Case(NamedTuple):
    """An experiment: levels from `lowest` to `highest` thresholds, and the number of trials at each."""

    scene: Callable[[], Scene]
    lowest: float
    highest: float
    n_levels: int
    n_trials: int


CASES = [
    Case(lambda: naked_eye(0.6), 0.5, 2.0, 7, 12),
    Case(lambda: naked_eye(0.6), 0.11, 2.4, 7, 12),
    Case(lambda: naked_eye(1.0), 0.35, 2.0, 5, 8),
    Case(lambda: naked_eye(1.0), 0.8, 1.3, 7, 28),
    Case(lambda: naked_eye(2.0), 0.5, 2.0, 7, 40),
    Case(lambda: naked_eye(1.0, 1.0), 0.5, 2.0, 7, 12),
    Case(lambda: naked_eye(1.0, 2.0), 0.4, 2.5, 6, 20),
    Case(lambda: camera("star_like", 4.0), 0.25, 4.0, 7, 40),
    Case(lambda: camera("star_like", 4.0), 0.25, 4.0, 7, 12),
    Case(lambda: camera("star_like", 4.0), 0.25, 2.0, 4, 40),
    Case(lambda: camera("star_like", 6.0), 0.25, 4.0, 7, 12),
    Case(lambda: camera("star_like", 10.0), 0.3, 3.0, 7, 20),
    Case(lambda: camera("staring_camera", 4.0), 0.15, 5.0, 6, 40),
    Case(lambda: camera("staring_camera", 6.0), 0.3, 4.0, 6, 24),
]

EXACT = [
    *(lambda size=size: naked_eye(size) for size in (0.6, 1.0, 2.0)),
    *(
        lambda file=file, size=size: camera(file, size)
        for file in ("star_like", "staring_camera")
        for size in (4.0, 6.0)
    ),
]


def bias(scene: Scene, curve: CurveName) -> float:
    """Return the error of the threshold in %, of exact points from 30 to 99 % correct or as far as P reaches."""
    lowest, truth = scene.level_at(0.3), scene.level_at(0.75)
    assert lowest is not None and truth is not None
    levels = np.geomspace(lowest, scene.level_at(0.99) or 4.0 * truth, 7)
    points = [scene.proportion(level) for level in levels]
    settings, rng = FitSettings(resamples=0), np.random.default_rng(0)
    threshold = fit_trials(levels, points, curve=curve, settings=settings, rng=rng).threshold
    return math.inf if threshold is None else 100.0 * (threshold / truth - 1.0)


def experiments(case: Case, curve: CurveName, seed: int) -> tuple[float, int, float]:
    """Return the share of intervals with the threshold in %, estimates on an edge, and the median width in %."""
    scene, rng = case.scene(), np.random.default_rng(seed)
    truth = scene.level_at(0.75)
    assert truth is not None
    levels = truth * np.geomspace(case.lowest, case.highest, case.n_levels)
    pool = np.array([scene.drawn(level, rng) for level in levels])
    held, on_edge, widths = 0, 0, []
    for _ in range(EXPERIMENTS):
        chosen = rng.integers(POOL, size=(case.n_levels, case.n_trials))
        p_correct = np.take_along_axis(pool, chosen, axis=1).ravel()
        level = np.repeat(levels, case.n_trials)
        fit = fit_trials(level, p_correct, curve=curve, settings=FitSettings(resamples=400), rng=rng)
        if fit.threshold is None or fit.threshold_ci95 is None:
            continue
        low, high = (bound or end for bound, end in zip(fit.threshold_ci95, (0.0, math.inf), strict=True))
        held += low <= truth <= high
        on_edge += not low < fit.threshold < high
        widths.append(100.0 * (high - low) / fit.threshold)
    return 100.0 * held / len(widths), on_edge, float(np.median(widths))


def rows() -> list[Row]:
    """Bias on exact points, and coverage, for both curves; what is asked is asked of the observer's."""
    found = []
    for make in EXACT:
        scene = make()
        asked = "±1" if scene.is_snr else "±0.2"
        found.append(Row(f"bias on exact points, %: {scene.name}", bias(scene, "observer"), asked))
        found.append(Row("   the same with Weibull's curve", bias(scene, "weibull"), "–"))
    for number, case in enumerate(CASES):
        held, on_edge, width = experiments(case, "observer", number)
        scene = case.scene()
        shape = f"{case.n_levels} levels of {case.n_trials} trials, {case.lowest:g} to {case.highest:g} thresholds"
        found.append(Row(f"intervals with the threshold, %: {scene.name}, {shape}", held, "93 to 98"))
        found.append(Row("   estimates on an edge of their interval", on_edge, "0"))
        weibull_held, _, weibull_width = experiments(case, "weibull", number)
        found.append(Row("   width of the interval, %; Weibull's curve next", width, "–"))
        found.append(Row(f"   (Weibull's holds the threshold in {weibull_held:.1f} %)", weibull_width, "–"))
    return found
