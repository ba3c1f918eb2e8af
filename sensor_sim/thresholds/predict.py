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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.chain.detector_noise import excess_kurtosis
from sensor_sim.chain.sensor import Sensor
from sensor_sim.thresholds.curve_plan import (
    ORTHANT_TOLERANCE,
    CurvePlan,
    centre_offset,
    linear_readout,
    plan_curve,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.observers.decision import answer_probability
from todframes.observers.interface import Observer, Readout, non_gaussian_bound
from todframes.psychometrics.replicates import REPLICATES, half_width_95
from todframes.psychometrics.threshold_search import ComputedThreshold, Status, crossing
from todframes.stimulus import Orientation

PLACES = (5, 7, 11, 17, 25, 37)
"""Numbers of places along each axis of a detector, in each replicate, tried in turn until the error is small
enough. Each takes twice the trials of the one before, so that there are few chances to stop at an error estimate
that is too small by chance. Numbers that have a divisor in common with the display's pixels per detector are left
out: P repeats with these pixels too, and such a lattice would sample all of them at the same places."""

KRONECKER_STEPS_4D = np.modf(1.1673039782614187 ** -np.arange(1.0, 5.0))[0].reshape(2, 2)
"""Steps of a four-dimensional low-discrepancy sequence, powers of the root of x⁵ = x + 1 (Roberts 2018); two
dimensions are counted by the rows and columns of the lattice."""

WEIGHTS_AT_ONCE = 2**17
"""Number of weights of a score, on the detectors of several places, that are multiplied with samples at once."""

PLACES_AT_ONCE = 1024
"""Number of places whose P(correct) is computed at once, a few milliseconds."""

STEP = 0.02
"""Distance in ln level between the two points from which the slope of P(correct) is taken."""

Level = Literal["snr", "contrast"]
"""Quantity that is varied: the detectors' noise under a triangle of contrast 1, or, without detector noise, the
contrast of the triangle."""


class Lattice(NamedTuple):
    """Places of the retina's middle on the detectors, on a square grid, and displacements of the retina there.

    The weights depend on the retina's middle alone: its place is the triangle's on the detectors plus its own
    displacement, and repeats with the detectors. So a grid covers one detector evenly, and the triangle's place is
    the difference of the two.

    Attributes
    ----------
    x, y : ndarray, shape (places,)
        Columns and rows of the grid, in detectors from the field's middle.
    displacement : ndarray, shape (places², displacements, 2)
        Displacements of the retina along x and y, in detectors, at each place, row after row.
    """

    x: FloatArray
    y: FloatArray
    displacement: FloatArray

    @classmethod
    def at(cls, places: int, *, shift: FloatArray, first: FloatArray, jitter: float) -> Lattice:
        """Return a lattice that is shifted as a whole.

        Parameters
        ----------
        places : int
            Places along each axis.
        shift : ndarray, shape (2,)
            Shift along x and y, in the distance of two places.
        first : ndarray, shape (2,)
            Start of the low-discrepancy sequence of displacements, in [0, 1).
        jitter : float
            Largest displacement of the retina along each axis, in detectors. The sequence has both signs.
        """
        grid = np.arange(places) / places - 0.5
        x, y = (grid + along / places for along in shift)
        row, column = np.divmod(np.arange(places**2)[:, None], places)
        evenly = (row * KRONECKER_STEPS_4D[0] + column * KRONECKER_STEPS_4D[1] + first) % 1.0
        signs = np.array([[1.0], [-1.0]]) if jitter > 0.0 else np.zeros((1, 1))
        return cls(x, y, jitter * (2.0 * evenly[:, None] - 1.0) * signs)

    @property
    def triangles(self) -> FloatArray:
        """Places of the triangle at each place and displacement, (2, places² · displacements): x and y."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        middle = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
        return np.ascontiguousarray((middle - self.displacement).reshape(-1, 2).T)


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


def phases_on(
    lattice: Lattice,
    plan: CurvePlan,
    orientations: Sequence[Orientation],
    *,
    size_detectors: float,
    gain: float,
    weights_by_row: Callable[[FloatArray, FloatArray], NDArray[Any]],
) -> list[Phases]:
    """Return the trials of each orientation on a lattice.

    Parameters
    ----------
    lattice : Lattice
    plan : CurvePlan
    orientations : sequence of Orientation
    size_detectors : float
        √(area) of the triangle.
    gain : float
        Display contrast per unit of signal.
    weights_by_row : function of (places_x, places_y)
        Returns the folded weights as `Folding.weights_by_row` does.
    """
    places, n_shown = len(lattice.x), lattice.displacement.shape[1]
    x, y = lattice.triangles
    found = []
    for orientation in orientations:
        dx, dy = centre_offset(plan.observer, orientation, size_detectors)
        rows = weights_by_row(lattice.x + dx, lattice.y + dy)
        at_once = max(WEIGHTS_AT_ONCE // (places * plan.field**2), 1)
        signal, noise = [], []
        for start in range(0, places, at_once):
            some = rows[start : start + at_once]
            weights = plan.all_four(np.concatenate(some).astype(np.float64)) * gain
            part = slice(start * places * n_shown, (start + len(some)) * places * n_shown)
            samples = plan.samples(x[part], y[part], orientation).reshape(len(weights), n_shown, -1)
            signal.append(samples @ weights.swapaxes(1, 2))
            noise.append(plan.noise(weights))
        found.append(Phases(np.concatenate(signal), np.concatenate(noise), orientation.quarter_turns))
    return found


def pooled(replicates: Sequence[Sequence[Phases]]) -> list[Phases]:
    """Return the trials of each orientation in all replicates, one replicate after the other."""
    return [
        Phases(
            np.concatenate([part.signal for part in parts]),
            np.concatenate([part.noise for part in parts]),
            parts[0].correct,
        )
        for parts in zip(*replicates, strict=True)
    ]


def covariance_at(level: Level, value: float, internal: FloatArray, detector: FloatArray) -> FloatArray:
    """Return the covariance of the scores over the square of the triangle's contrast, at a value of the level.

    Parameters
    ----------
    level : {"snr", "contrast"}
    value : float
    internal : ndarray, shape (4, 4)
        Covariance from the internal noise.
    detector : ndarray, shape (..., 4, 4)
        Covariance from detector noise of standard deviation 1.
    """
    return internal + detector / value**2 if level == "snr" else internal / value**2


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

    @cached_property
    def jitter_detectors(self) -> float:
        """Largest displacement of the retina along each axis, in detectors."""
        per_sample = self.readout.grid.pitch_mrad / self.sensor.display.detector_pitch_mrad
        return self.observer.position_jitter_samples * per_sample

    def phases(self, places: int, rng: np.random.Generator) -> list[Phases]:
        """Return trials of each orientation on a `Lattice` of `places` × `places`, shifted at random."""
        shift, first = rng.random(2), rng.random(2)
        return phases_on(
            Lattice.at(places, shift=shift, first=first, jitter=self.jitter_detectors),
            self.plan,
            self.orientations,
            size_detectors=self.size_detectors,
            gain=self.sensor.display.gain,
            weights_by_row=partial(self.plan.weights_by_row, self.folding),
        )

    def non_gaussian_bound(self) -> float:
        """Return a first-order bound on the error in P(correct) from taking all noise as Gaussian.

        The bound follows from that of `Readout.non_gaussian_bound`: the excess kurtosis of the sum of internal and
        detector noise is at most the larger one of its two parts.
        """
        weights = self.plan.all_four(self.folding.weights(np.zeros(1), np.zeros(1)))[0]
        squares = np.square(weights[:, None] - weights)[np.triu_indices(4, 1)]
        sums = squares.sum(axis=1, keepdims=True)  # 0 where the detectors' noise does not reach the difference
        shares = np.divide(squares, sums, out=np.zeros_like(squares), where=sums > 0.0)
        participation = np.square(shares).sum(axis=1).max()
        of_detectors = non_gaussian_bound(excess_kurtosis(self.sensor.noise) * float(participation))
        return max(self.readout.non_gaussian_bound, of_detectors)

    def proportion_correct(self, phases: Sequence[Phases], snr: float, contrast: float = 1.0) -> float:
        """Return the mean P(correct) over trials at a signal-to-noise ratio; infinity means no detector noise.

        `contrast` is that of the triangle, in units of the contrast that the sensor's gain gives it.
        """
        return float(self.proportions_correct(phases, [snr], contrast)[0])

    def proportions_correct(
        self, phases: Sequence[Phases], snrs: Sequence[float], contrast: float = 1.0
    ) -> FloatArray:
        """Return `proportion_correct` at each of several signal-to-noise ratios."""
        internal, snr = self.noise_covariance / contrast**2, np.reshape(snrs, (-1, 1, 1, 1, 1))
        of_orientations = []
        for part in phases:
            covariance = internal + part.noise[:, None] / snr**2
            p_correct = answer_probability(part.signal, covariance, part.correct, tolerance=ORTHANT_TOLERANCE)
            of_orientations.append(p_correct.mean(axis=(1, 2)))
        return np.asarray(np.mean(of_orientations, axis=0))


def _each_proportion(
    phases: Sequence[Phases],
    covariance: Callable[[FloatArray], FloatArray],
    n_replicates: int,
    *,
    tolerance: float = ORTHANT_TOLERANCE,
    check: Callable[[], None] = lambda: None,
) -> FloatArray:
    """Return the mean P(correct) over the trials of each replicate and all orientations: (replicates,).

    Parameters
    ----------
    phases : sequence of Phases
        Trials of each orientation, as of `pooled`.
    covariance : function of an ndarray, shape (..., 4, 4)
        Returns the covariance of the scores for that from detector noise of standard deviation 1.
    n_replicates : int
    tolerance : float
        Error of each P(correct).
    check : function of no arguments
        Called every few milliseconds; it may raise an exception.
    """
    of_orientations = []
    for part in phases:
        p_correct = np.empty(part.signal.shape[:-1])
        for start in range(0, len(p_correct), PLACES_AT_ONCE):
            check()
            some = slice(start, start + PLACES_AT_ONCE)
            noise = covariance(part.noise[some, None])
            p_correct[some] = answer_probability(part.signal[some], noise, part.correct, tolerance=tolerance)
        of_orientations.append(p_correct.reshape(n_replicates, -1).mean(axis=1))
    return np.asarray(np.mean(of_orientations, axis=0))


class PooledThreshold(NamedTuple):
    """A threshold over several replicates.

    Attributes
    ----------
    status : str
        As of `PredictedThreshold`; if it is not "ok", the others are NaN.
    threshold : float
        Of the mean P(correct) of all replicates.
    deviations : ndarray, shape (replicates,)
        ln of each replicate's threshold over that of all.
    slope : float
        dP / d ln level at the threshold.
    """

    status: Status
    threshold: float
    deviations: FloatArray
    slope: float


def find_threshold(
    phases: Sequence[Phases],
    internal: FloatArray,
    p_correct: float,
    *,
    n_replicates: int,
    level: Level = "snr",
    near: float | None = None,
    slope: float = math.nan,
    tolerance: float = ORTHANT_TOLERANCE,
    check: Callable[[], None] = lambda: None,
) -> PooledThreshold:
    """Find the threshold of trials, and what it would be with each replicate alone.

    Parameters
    ----------
    phases : sequence of Phases
        Trials of each orientation, as of `pooled`.
    internal : ndarray, shape (4, 4)
        Covariance of the internal noise on the scores.
    p_correct : float
        Raw proportion correct at threshold.
    n_replicates : int
    level : {"snr", "contrast"}
    near, slope : float
        A threshold that may be near, to begin with, and the slope dP / d ln level there.
    tolerance : float
        Error of each P(correct).
    check : function of no arguments
        Called every few milliseconds; it may raise an exception.
    """

    def of_each(value: float) -> FloatArray:
        covariance = partial(covariance_at, level, value, internal)
        return _each_proportion(phases, covariance, n_replicates, tolerance=tolerance, check=check)

    status, threshold = crossing(lambda value: float(of_each(value).mean()), p_correct, near=near, slope=slope)
    if threshold is None:
        return PooledThreshold(status, math.nan, np.full(n_replicates, math.nan), math.nan)
    low, high = (of_each(threshold * math.exp(way * STEP / 2.0)) for way in (-1.0, 1.0))
    slope = max(float((high - low).mean()) / STEP, 1e-12)
    middle = (low + high) / 2.0
    return PooledThreshold(status, threshold, (middle.mean() - middle) / slope, slope)


@dataclass(frozen=True, slots=True)
class PredictedThreshold(ComputedThreshold):
    """A threshold computed for a sensor.

    `threshold` is an SNR, or a contrast if that was varied. `numerical_error` is the half-width of
    its 95 % interval over replicates plus the bound on the plan's omissions. `n_phases` is the number of trials
    averaged over. `points` are pairs of SNR and proportion correct around the threshold. `reason` says why a
    threshold cannot be computed, with the status "impossible".
    """

    size_detectors: float = math.nan
    n_phases: int = 0
    points: tuple[tuple[float, float], ...] = ()
    reason: str = ""


def predict_threshold(
    chain: FoldedChain,
    *,
    p_correct: float = 0.75,
    tolerance: float = 2e-3,
    seed: int = 1,
    n_points: int = 7,
    level: Level = "snr",
    near: float | None = None,
    slope: float = math.nan,
    check: Callable[[], None] = lambda: None,
) -> PredictedThreshold:
    """Compute a threshold, with more and more places until its error falls below the tolerance.

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
    level : {"snr", "contrast"}
        Quantity whose threshold is computed.
    near, slope : float
        A threshold that may be near, and the slope dP / d ln level there; by default those that the plan found.
    check : function of no arguments
        Called every few milliseconds; it may raise an exception.

    Raises
    ------
    SettingsError
        If the tolerance is not a positive number.
    """
    if not tolerance > 0:
        raise SettingsError(f"tolerance: found {tolerance!r}, expected a number > 0")
    pixels = chain.sensor.display.pixels_per_detector
    ladder = [n for n in PLACES if math.gcd(n, pixels) == 1 and n >= chain.plan.fewest_places]
    if near is None and level == "snr":
        near, slope = chain.plan.near_snr, chain.plan.slope
    for places in ladder:
        parts = chain.replicates(places, seed)
        phases = pooled(parts)
        n_phases = sum(part.signal[..., 0].size for part in phases)
        found = find_threshold(
            phases,
            chain.noise_covariance,
            p_correct,
            n_replicates=REPLICATES,
            level=level,
            near=near,
            slope=slope,
            check=check,
        )
        if found.status != "ok":
            return PredictedThreshold(found.status, size_detectors=chain.size_detectors, n_phases=n_phases)
        near, slope = found.threshold, found.slope
        error, left_out = half_width_95(found.deviations), chain.plan.bound / found.slope
        # More trials do not reduce the error of the omissions: on a flat curve, the stated error may stay above
        # the tolerance.
        if error <= max(tolerance - left_out, tolerance / 2.0):
            break
    threshold = found.threshold
    points: tuple[tuple[float, float], ...] = ()
    if n_points:
        levels = (threshold * 2.0 ** np.linspace(-1.0, 1.0, n_points)).tolist()
        points = tuple(zip(levels, chain.proportions_correct(parts[0], levels).tolist(), strict=True))
    error = (error + left_out) * threshold
    return PredictedThreshold(found.status, threshold, error, chain.size_detectors, n_phases, points)
