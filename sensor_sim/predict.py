"""Computation of a sensor's thresholds without drawing frames: folded observer and display, noise as covariance.

The chain from detector samples to scores is linear, so hold, blur, display and retina fold into the observer's
weights: one image on the detectors for each answer. A trial's signal is then an inner product with exact
samples, and white detector noise of standard deviation 1/SNR is a covariance of the four scores. The remaining
mean, over the place of the triangle on the detectors and of the retina on the display, uses a lattice and a
low-discrepancy sequence; several independent shifts give the error.

Hogervorst et al. 2001, sections 3 to 5 and 8.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from sensor_sim.curve_plan import ORTHANT_NODES, CurvePlan, centre_offset, linear_readout, plan_curve
from sensor_sim.noise import excess_kurtosis
from sensor_sim.sensor import Sensor
from todframes._typing import FloatArray
from todframes.errors import SettingsError
from todframes.observers.decision import answer_probability
from todframes.observers.interface import Observer, Readout, non_gaussian_bound
from todframes.psychometrics.threshold_search import crossing
from todframes.stimulus import Orientation

REPLICATES = 8

PLACES = (5, 7, 11, 17, 25, 37)
"""Numbers of places along each axis of a detector, in each replicate, tried in turn until the error is small
enough. Each takes twice the trials of the one before, so that there are few chances to stop at an error estimate
that is too small by chance. Numbers that have a divisor in common with the display's pixels per detector are left
out: P repeats with these pixels too, and such a lattice would sample all of them at the same places."""

KRONECKER_STEPS = np.modf(1.1673039782614187 ** -np.arange(1.0, 5.0))[0].reshape(2, 2)
"""Steps of a four-dimensional low-discrepancy sequence, powers of the root of x⁵ = x + 1 (Roberts 2018); two
dimensions are counted by the rows and columns of the lattice."""

STANDARD_ERRORS_95 = 2.8412
"""Half-width of the stated interval in standard errors: the 98.75 % point of Student's t with one degree of
freedom less than there are replicates. Half of the interval's 5 % is reserved for error estimates that stopped
the refinement because they were small by chance."""


class Phases(NamedTuple):
    """Signals and noise of the trials of one orientation, as scores of the folded observer.

    Attributes
    ----------
    signal : ndarray, shape (places, displacements, 4)
        Score deviations caused by the triangle, of amplitude 1.
    noise : ndarray, shape (places, 4, 4)
        Covariance of the scores under detector noise of standard deviation 1.
    correct : int
        The orientation shown, an index into `ORIENTATIONS`.
    """

    signal: FloatArray
    noise: FloatArray
    correct: int


class FoldedChain:
    """A sensor and a linear observer folded into weights on the detectors, for triangles of one size.

    Parameters
    ----------
    sensor : Sensor
    observer : Observer
        Linear observer.
    size_detectors : float
        √(area) of the triangle, > 0.
    plan : CurvePlan, optional
        Parts of the computation that are left out; by default those of `plan_curve`.

    Raises
    ------
    SettingsError
        If the observer is not linear, or the size or field is out of range.
    """

    def __init__(
        self, sensor: Sensor, observer: Observer, size_detectors: float, plan: CurvePlan | None = None
    ) -> None:
        self.plan = plan if plan is not None else plan_curve(sensor, observer, size_detectors)
        self.sensor, self.observer, self.size_detectors = sensor, self.plan.observer, size_detectors
        self.field = self.plan.field
        self.sampler = self.plan.sampler
        self.readout: Readout = linear_readout(sensor, self.observer, size_detectors)
        self.noise_covariance = self.readout.noise_covariance
        self.folding = self.plan.folding(sensor, self.readout, size_detectors)
        self._drawn: dict[tuple[int, int], list[list[Phases]]] = {}
        self.orientations = self.plan.orientations
        self.drawing_s = 0.0

    def replicates(self, places: int, seed: int) -> list[list[Phases]]:
        """Return `phases` for each replicate, from independent streams, kept for chains of other noise."""
        if (places, seed) not in self._drawn:
            started = time.perf_counter()
            streams = np.random.SeedSequence(seed, spawn_key=(places,)).spawn(REPLICATES)
            self._drawn[places, seed] = [self.phases(places, np.random.default_rng(stream)) for stream in streams]
            self.drawing_s += time.perf_counter() - started
        return self._drawn[places, seed]

    def phases(self, places: int, rng: np.random.Generator) -> list[Phases]:
        """Return trials of each orientation on a grid of `places` × `places`, displaced as a whole at random.

        The retina's middle lies on this grid, because the weights depend on nothing else: its place is the
        triangle's on the detectors plus its own displacement, and repeats with the detectors. So the grid
        covers one detector evenly, the displacements are a shifted low-discrepancy sequence with both
        signs, and the triangle's place is the difference of the two.
        """
        jitter = self.observer.position_jitter_samples
        detectors_per_sample = self.readout.grid.pitch_mrad / self.sensor.display.detector_pitch_mrad
        grid = np.arange(places) / places - 0.5
        middle_x, middle_y = (grid + shift / places for shift in rng.random(2))
        row, column = np.divmod(np.arange(places**2)[:, None], places)
        evenly = (row * KRONECKER_STEPS[0] + column * KRONECKER_STEPS[1] + rng.random(2)) % 1.0
        displacement = jitter * (2.0 * evenly - 1.0)
        signs = np.array([[1, 1], [-1, -1]]) if jitter > 0 else np.zeros((1, 2))
        y, x = (m.ravel()[:, None] for m in np.meshgrid(middle_y, middle_x, indexing="ij"))
        triangle_x = x - detectors_per_sample * displacement[:, :1] * signs[:, 0]
        triangle_y = y - detectors_per_sample * displacement[:, 1:] * signs[:, 1]
        return [
            self._trials(orientation, middle_x, middle_y, triangle_x, triangle_y)
            for orientation in self.orientations
        ]

    def _trials(
        self,
        orientation: Orientation,
        middle_x: FloatArray,
        middle_y: FloatArray,
        triangle_x: FloatArray,
        triangle_y: FloatArray,
    ) -> Phases:
        dx, dy = centre_offset(self.observer, orientation, self.size_detectors)
        places, field = len(middle_x), self.field
        signal, noise = [], []
        by_row = self.plan.weights_by_row(self.folding, middle_x + dx, middle_y + dy)
        for row, weights in enumerate(by_row):
            weights = self.plan.all_four(weights) * self.sensor.display.gain
            in_row = slice(row * places, (row + 1) * places)
            at = triangle_x[in_row].ravel(), triangle_y[in_row].ravel()
            samples = self.plan.samples(*at, orientation).reshape(places, -1, field**2)
            signal.append(samples @ weights.swapaxes(1, 2))
            noise.append(self.plan.noise(weights))
        return Phases(np.concatenate(signal), np.concatenate(noise), orientation.quarter_turns)

    def non_gaussian_bound(self) -> float:
        """Return a first-order bound on the error in P(correct) from taking all noise as Gaussian.

        The bound follows from that of `Readout.non_gaussian_bound`: the excess kurtosis of the sum of internal and
        detector noise is at most the larger one of its two parts.
        """
        weights = self.plan.all_four(self.folding.weights(0.0, 0.0)[None])[0]
        squares = np.square(weights[:, None] - weights)[np.triu_indices(4, 1)]
        sums = squares.sum(axis=1, keepdims=True)  # 0 where the detectors' noise does not reach the difference
        shares = np.divide(squares, sums, out=np.zeros_like(squares), where=sums > 0.0)
        participation = np.square(shares).sum(axis=1).max()
        of_detectors = non_gaussian_bound(excess_kurtosis(self.sensor.noise) * float(participation))
        return max(self.readout.non_gaussian_bound, of_detectors)

    def proportion_correct(self, phases: list[Phases], snr: float, contrast: float = 1.0) -> float:
        """Return the mean P(correct) over trials at a signal-to-noise ratio; infinity means no detector noise.

        `contrast` is that of the triangle, in units of the contrast that the sensor's gain gives it.
        """
        return float(np.mean([self._p_correct(part, snr, contrast).mean() for part in phases]))

    def _p_correct(self, phases: Phases, snr: float, contrast: float = 1.0) -> FloatArray:
        covariance = self.noise_covariance + phases.noise[:, None] * (contrast / snr) ** 2
        return answer_probability(contrast * phases.signal, covariance, phases.correct, nodes=ORTHANT_NODES)

    def error(self, pooled: list[Phases], threshold: float) -> tuple[float, float]:
        """Return the half-width of the 95 % interval of a threshold, from the spread of P among replicates.

        Parameters
        ----------
        pooled : list of Phases
            Trials of each orientation, with all replicates concatenated.
        threshold : float
            Threshold SNR.

        Returns
        -------
        (half_width, slope)
            Half-width of the interval, and the slope dP/d ln SNR.
        """
        step = 0.01
        low, high = (
            np.mean(
                [self._p_correct(p, threshold * factor).reshape(REPLICATES, -1).mean(1) for p in pooled], axis=0
            )
            for factor in (math.exp(-step), math.exp(step))
        )
        slope = max(float((high - low).mean()) / (2.0 * step), 1e-12)
        spread = float(((high + low) / 2.0).std(ddof=1)) / math.sqrt(REPLICATES)
        return STANDARD_ERRORS_95 * spread / slope * threshold, slope


@dataclass(frozen=True, slots=True)
class PredictedThreshold:
    """A threshold computed for a sensor.

    `threshold` is a signal-to-noise ratio. `numerical_error` is the half-width of its 95 % interval over
    replicates plus the bound on the plan's omissions. `n_phases` is the number of trials averaged over.
    `points` are pairs of SNR and proportion correct around the threshold.
    """

    size_detectors: float
    status: Literal["ok", "never_reached", "always_exceeded"]
    threshold: float | None
    numerical_error: float | None
    n_phases: int
    points: tuple[tuple[float, float], ...]


def predict_threshold(
    chain: FoldedChain, *, p_correct: float = 0.75, tolerance: float = 2e-3, seed: int = 1, n_points: int = 7
) -> PredictedThreshold:
    """Compute the threshold SNR, with more and more places until its error falls below the tolerance.

    Parameters
    ----------
    chain : FoldedChain
        Folded sensor and observer, for triangles of one size.
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative half-width of the 95 % interval that ends the refinement.
    seed : int
        Seed of the replicates.
    n_points : int
        Number of points of the psychometric function to return.

    Raises
    ------
    SettingsError
        If the tolerance is not a positive number.
    """
    if not tolerance > 0:
        raise SettingsError(f"tolerance: found {tolerance!r}, expected a number > 0")
    pixels = chain.sensor.display.pixels_per_detector
    ladder = [n for n in PLACES if math.gcd(n, pixels) == 1 and n >= chain.plan.fewest_places]
    threshold: float | None = None
    slope = math.nan
    for places in ladder:
        parts = chain.replicates(places, seed)
        pooled = [_pool(list(orientation)) for orientation in zip(*parts, strict=True)]
        proportion = partial(chain.proportion_correct, pooled)
        n_phases = sum(part.signal[..., 0].size for part in pooled)
        status, threshold = crossing(proportion, p_correct, near=threshold, slope=slope)
        if threshold is None:
            return PredictedThreshold(chain.size_detectors, status, None, None, n_phases, ())
        error, slope = chain.error(pooled, threshold)
        left_out = chain.plan.bound / slope * threshold
        # More trials do not reduce the error of the omissions: on a flat curve, the stated error may stay above
        # the tolerance.
        if error <= max(tolerance * threshold - left_out, tolerance * threshold / 2.0):
            break
    assert threshold is not None
    levels = (threshold * 2.0 ** np.linspace(-1.0, 1.0, n_points)).tolist()
    points = tuple((snr, chain.proportion_correct(parts[0], snr)) for snr in levels)
    return PredictedThreshold(chain.size_detectors, status, threshold, error + left_out, n_phases, points)


def _pool(parts: list[Phases]) -> Phases:
    signal, noise = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Phases(signal, noise, parts[0].correct)
