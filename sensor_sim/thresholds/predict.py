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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.noise import (
    ContrastVariance,
    check_rounding,
    contrast_variance,
    largest_contrast,
    sample_cumulants,
)
from sensor_sim.thresholds.curve_plan import (
    ORTHANT_TOLERANCE,
    PARTS,
    CurvePlan,
    Level,
    centre_offset,
    line_covariance,
    linear_readout,
    plan_curve,
    signal_covariance,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import argument
from todframes.base.reading import check_positive
from todframes.observers.decision import answer_probability
from todframes.observers.interface import Observer, Readout, non_gaussian_bound
from todframes.psychometrics.threshold_search import ComputedThreshold, Status, crossing, if_known
from todframes.scoring.error_budget import REPLICATES, half_width_95
from todframes.stimulus import Orientation

KRONECKER_STEPS_4D = np.modf(1.1673039782614187 ** -np.arange(1.0, 5.0))[0].reshape(2, 2)
"""Steps of a four-dimensional low-discrepancy sequence, powers of the root of x⁵ = x + 1 (Roberts 2018); two
dimensions are counted by the rows and columns of the lattice."""

WEIGHTS_AT_ONCE = 2**17
"""Number of weights of a score, on the detectors of several places, that are multiplied with samples at once."""

SURELY_BELOW = 0.2
"""Distance of P(correct) below the criterion from which one replicate shows that this is never reached: at least
three standard errors of the share of right answers in its 50 trials or more."""

HIDDEN = "optics, detectors and display hide its direction, even without noise"
TOO_FAINT = "the observer's internal noise hides what optics, detectors and display leave of it"
SATURATING = "it would need more contrast than the pixels can show before they saturate"
"""Reasons why a triangle has no threshold."""

N_POINTS = 7
"""Number of levels about a threshold at which P(correct) is computed, if no other is asked for."""

PLACES_AT_ONCE = 1024
"""Number of places whose P(correct) is computed at once, a few milliseconds."""

STEP = 0.02
"""Distance in ln level between the two points from which the slope of P(correct) is taken."""


class Lattice(NamedTuple):
    """Places of the retina's middle on the detectors, on a square grid, and displacements of the retina there. The
    weights depend on the retina's middle alone: its place is the triangle's on the detectors plus its own
    displacement, and repeats with the detectors. So a grid covers one detector evenly, and the triangle's place is
    the difference of the two. `x` and `y` are columns and rows of the grid, in detectors from the field's middle;
    `displacement`, (places², displacements, 2), is that of the retina along x and y, in detectors, at each place,
    row after row.
    """

    x: FloatArray
    y: FloatArray
    displacement: FloatArray

    @classmethod
    def at(cls, places: int, *, shift: FloatArray, first: FloatArray, jitter: float) -> Lattice:
        """Return a lattice of places × places that is shifted as a whole, by `shift` along x and y in the distance
        of two. `first`, in [0, 1), is the start of the low-discrepancy sequence of displacements, which has both
        signs, and `jitter` the largest displacement along each axis, in detectors.
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


class SensorTrials(NamedTuple):
    """Signals and noise of the trials of one orientation, `correct`, as scores of the folded observer. `signal`,
    (places, displacements, 4), are the score deviations that a triangle of amplitude 1 causes, and `noise`,
    (places, 4, 4), is the covariance of the scores under detector noise of deviation 1. For cameras that count
    photons, `photon_covariance`, (places, displacements, 4, 4, 4), has the covariances from noise of variance 1
    that rows, and columns, have in common, and from noise whose variance is the triangle's signal, and its square.
    """

    signal: FloatArray
    noise: FloatArray
    correct: int
    photon_covariance: FloatArray | None = None

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return (
            self.signal.nbytes
            + self.noise.nbytes
            + (0 if self.photon_covariance is None else self.photon_covariance.nbytes)
        )

    def some(self, places: slice) -> SensorTrials:
        """Return the trials at some places."""
        photon_covariance = None if self.photon_covariance is None else self.photon_covariance[places]
        return SensorTrials(self.signal[places], self.noise[places], self.correct, photon_covariance)


def joined(parts: Sequence[SensorTrials]) -> SensorTrials:
    """Return the trials of several lattices and one orientation, one lattice after the other."""
    photon_covariance = [part.photon_covariance for part in parts if part.photon_covariance is not None]
    return SensorTrials(
        np.concatenate([part.signal for part in parts]),
        np.concatenate([part.noise for part in parts]),
        parts[0].correct,
        np.concatenate(photon_covariance) if photon_covariance else None,
    )


def pooled(replicates: Sequence[Sequence[SensorTrials]]) -> list[SensorTrials]:
    """Return the trials of each orientation in all replicates, one replicate after the other."""
    return list(map(joined, zip(*replicates, strict=True)))


def covariance_at(
    level: Level,
    value: float,
    internal: FloatArray,
    phases: SensorTrials,
    variance: ContrastVariance | None = None,
) -> FloatArray:
    """Return the covariance of the scores over the square of the triangle's contrast, at a value of the level. Its
    shape is (places, 1 or displacements, 4, 4). `internal` is that of the internal noise. With `variance`, of a
    sample of a camera that counts photons, the value is a contrast, whatever the level.
    """
    if variance is None:
        return internal + phases.noise[:, None] / value**2 if level == "snr" else internal / value**2
    assert phases.photon_covariance is not None
    of_term = [variance.row / value**2, variance.column / value**2, variance.per_signal / value]
    covariance = np.einsum(
        "t,...tij->...ij", np.array([*of_term, variance.per_squared_signal]), phases.photon_covariance
    )
    return np.asarray(covariance + (internal + phases.noise[:, None] * variance.white) / value**2)


class FoldedChain:
    """A sensor and a linear observer folded into weights on the detectors, for triangles of one size. The plan, by
    default that of `plan_curve`, has the parts of the computation that are left out. SettingsError if the observer
    is not linear, or the size or field is out of range.
    """

    def __init__(
        self, camera: Camera, observer: Observer, size_detectors: float, plan: CurvePlan | None = None
    ) -> None:
        self.plan = plan if plan is not None else plan_curve(camera, observer, size_detectors)
        self.rounding_error = check_rounding(camera)
        self.camera, self.observer, self.size_detectors = camera, self.plan.observer, size_detectors
        self.field = self.plan.field
        self.sampler = self.plan.sampler
        self.readout: Readout = linear_readout(camera, self.observer, size_detectors, self.plan.half_width)
        self.noise_covariance = self.readout.noise_covariance
        self.folding = self.plan.folding(camera, self.readout, size_detectors)
        self.variance = None if camera.photons is None else contrast_variance(camera)
        self._drawn: dict[tuple[int, int], list[list[SensorTrials]]] = {}
        self.orientations = self.plan.orientations

    def replicates(self, places: int, seed: int, n: int = REPLICATES) -> list[list[SensorTrials]]:
        """Return `phases` for the first replicates, from independent streams, kept for chains of other noise."""
        drawn = self._drawn.setdefault((places, seed), [])
        key = (self.plan.sampler.key, self.folding.key, self.camera.gain, self.orientations, self.jitter_detectors)
        of_noise = (self.plan.level, self.plan.lines, self.variance is not None)
        streams = np.random.SeedSequence(seed, spawn_key=(places,)).spawn(REPLICATES)
        while len(drawn) < n:
            make = partial(self.phases, places, np.random.default_rng(streams[len(drawn)]))
            drawn.append(PARTS.get(("trials", *key, *of_noise, places, seed, len(drawn)), make))
        return drawn[:n]

    @cached_property
    def jitter_detectors(self) -> float:
        """Largest displacement of the retina along each axis, in detectors."""
        per_sample = self.readout.grid.pitch_mrad / self.camera.shown_pitch_mrad
        jitter = self.observer.position_jitter_samples * per_sample
        return jitter if jitter > self.plan.least_jitter else 0.0

    def phases(self, places: int, rng: np.random.Generator) -> list[SensorTrials]:
        """Return trials of each orientation on a `Lattice` of `places` × `places`, shifted at random."""
        shift, first = rng.random(2), rng.random(2)
        lattice = Lattice.at(places, shift=shift, first=first, jitter=self.jitter_detectors)
        return [self._trials(lattice, orientation) for orientation in self.orientations]

    def _trials(self, lattice: Lattice, orientation: Orientation) -> SensorTrials:
        """Return the trials of one orientation on a lattice."""
        plan, places, n_shown = self.plan, len(lattice.y), lattice.displacement.shape[1]
        x, y = lattice.triangles
        at_once = max(WEIGHTS_AT_ONCE // (places * plan.field**2), 1)
        dx, dy = centre_offset(plan.observer, orientation, self.size_detectors)
        rows = plan.weights_by_row(self.folding, lattice.x + dx, lattice.y + dy)
        signal, noise, photon_covariance = [], [], []
        for start in range(0, places, at_once):
            some = rows[start : start + at_once]
            weights = plan.all_four(np.concatenate(some).astype(np.float64)) * self.camera.gain
            part = slice(start * places * n_shown, (start + len(some)) * places * n_shown)
            samples = plan.samples(x[part], y[part], orientation).reshape(len(weights), n_shown, -1)
            signal.append(samples @ weights.swapaxes(1, 2))
            noise.append(plan.noise(weights))
            if self.variance is not None:
                lines = np.stack(np.broadcast_arrays(*line_covariance(weights)), axis=1)[:, None]
                lines = np.broadcast_to(lines, (len(weights), n_shown, *lines.shape[2:]))
                photon_covariance.append(np.concatenate([lines, signal_covariance(weights, samples)], axis=2))
        light = np.concatenate(photon_covariance) if photon_covariance else None
        correct = orientation.quarter_turns
        return SensorTrials(np.concatenate(signal), np.concatenate(noise), correct, light)

    def decide(self, scores: FloatArray, covariance: FloatArray, correct: int) -> FloatArray:
        """Compute P(correct), (...,), for mean scores (..., 4) and their covariance."""
        return answer_probability(scores, covariance, correct, tolerance=ORTHANT_TOLERANCE)

    @property
    def largest_level(self) -> float:
        """Largest level of the sensor: a triangle of more contrast saturates its pixels, and looks the same."""
        return math.inf if self.variance is None else largest_contrast(self.camera)

    @property
    def largest_sample(self) -> float:
        """Largest sample of a triangle in the middle of the field, as a share of the triangle's contrast."""
        middle = np.zeros(1)
        return float(self.plan.samples(middle, middle, Orientation.UP).max())

    @property
    def lattices(self) -> list[int]:
        """Numbers of places along each axis of the lattices for this sensor and plan, in ascending order."""
        pixels = self.camera.pixels_per_detector
        return [n for n in self.plan.places if math.gcd(n, pixels) == 1]

    def unreached(
        self, p_correct: float, seed: int, places: int | None = None, level: Level = "snr"
    ) -> PredictedThreshold | None:
        """Return the record of a criterion that is not reached at the largest level; None if it is. One replicate,
        by default of the first lattice, is enough where P(correct) stays far below.
        """
        for n in (1, REPLICATES):
            parts = self.replicates(self.lattices[0] if places is None else places, seed, n)
            phases = pooled(parts)
            highest = self.proportion_correct(phases, self.largest_level, level=level)
            if highest <= p_correct - (SURELY_BELOW if n == 1 else 0.0):
                noiseless = self.proportion_correct(phases, math.inf, level="contrast")
                faint = TOO_FAINT if self.variance is None else SATURATING
                reason = HIDDEN if noiseless <= p_correct else faint
                n_phases = sum(part.signal[..., 0].size for part in phases)
                return PredictedThreshold(
                    "never_reached", None, None, self.size_detectors, n_phases, reason=reason, highest=highest
                )
        return None

    def non_gaussian_bound(self, level: float | None = None) -> float:
        """Return a bound on the error in P(correct) from taking all noise as Gaussian. It is of first order in the
        excess kurtosis: that of the sum of internal and detector noise is at most the larger one of its two parts,
        of which the first is that of `Readout.non_gaussian_bound`. For a camera that counts photons it includes
        their skewness and that of rounded numbers, at the contrast `level`.
        """
        if self.variance is not None:
            of_photons = self._photon_bound(1.0 if level is None else level)
            return max(self.readout.non_gaussian_bound, of_photons)
        weights = self.plan.all_four(self.folding.weights(np.zeros(1), np.zeros(1)))[0]
        squares = np.square(weights[:, None] - weights)[np.triu_indices(4, 1)]
        sums = squares.sum(axis=1, keepdims=True)  # 0 where the detectors' noise does not reach the difference
        shares = np.divide(squares, sums, out=np.zeros_like(squares), where=sums > 0.0)
        participation = np.square(shares).sum(axis=1).max()
        of_detectors = non_gaussian_bound(self.camera.excess_kurtosis * float(participation))
        return max(self.readout.non_gaussian_bound, of_detectors)

    def _photon_bound(self, contrast: float) -> float:
        """Bound the error in P(correct) because photons are counted and rounded, for a triangle in the middle. The
        Edgeworth terms of a score difference with the skewness γ are γ/6 · He₂(x) φ(x), at most 0.3990 γ/6, and
        γ²/72 · He₅(x) φ(x), at most 2.308 γ²/72; three differences decide.
        """
        middle = np.zeros(1)
        weights = self.plan.all_four(self.folding.weights(middle, middle))[0] * self.camera.gain
        signal = contrast * self.plan.samples(middle, middle, Orientation.UP).ravel()
        differences = weights[1:] - weights[0]
        to_differences = np.delete(-np.eye(4)[0] + np.eye(4), 0, axis=0)
        variance, third, fourth = sample_cumulants(self.camera, signal)
        spread = np.square(differences) @ variance
        spread += np.diag(to_differences @ self.noise_covariance @ to_differences.T)
        skewness = np.abs(differences**3 @ third) / spread**1.5
        kurtosis = np.abs(differences**4 @ fourth) / spread**2
        bound = float(np.sum(0.3990 / 6.0 * skewness + 2.308 / 72.0 * skewness**2))
        return min(bound + non_gaussian_bound(float(kurtosis.max())), 1.0)

    def proportion_correct(self, phases: Sequence[SensorTrials], value: float, *, level: Level = "snr") -> float:
        """Return the mean P(correct) over trials at a value of the level, for photons a contrast. An infinite SNR
        means no detector noise.
        """
        return float(self.proportions(phases, value, level)[0])

    def proportions(
        self, phases: Sequence[SensorTrials], value: float, level: Level, *, n_replicates: int = 1
    ) -> FloatArray:
        """Return the mean P(correct), as above, over the trials of each replicate and all orientations."""
        of_orientations = []
        for part in phases:
            p_correct = np.empty(part.signal.shape[:-1])
            for start in range(0, len(p_correct), PLACES_AT_ONCE):
                PARTS.check()
                some = slice(start, start + PLACES_AT_ONCE)
                covariance = covariance_at(level, value, self.noise_covariance, part.some(some), self.variance)
                p_correct[some] = self.decide(part.signal[some], covariance, part.correct)
            of_orientations.append(p_correct.reshape(n_replicates, -1).mean(axis=1))
        return np.asarray(np.mean(of_orientations, axis=0))


Progress = Callable[[float], None]
"""Function that is called with the share of a computation that was just done."""


class PooledThreshold(NamedTuple):
    """A threshold over several replicates; if its status is not "ok", the numbers are NaN. `threshold` is that of
    the mean P(correct) of all replicates, and `slope` dP / d ln level there; `deviations` are ln of each
    replicate's threshold over that of all.
    """

    status: Status
    threshold: float
    deviations: FloatArray
    slope: float


def find_threshold(
    of_each: Callable[[float], FloatArray],
    p_correct: float,
    *,
    most: float = math.inf,
    near: float | None = None,
    slope: float = math.nan,
) -> PooledThreshold:
    """Find the level at which the mean P(correct) of several replicates is `p_correct`. `of_each` returns
    P(correct) of each replicate at a level. The search begins `near` a level, with the slope dP / d ln level
    there; beyond `most` the threshold is never reached.
    """
    status, threshold = crossing(lambda level: float(of_each(level).mean()), p_correct, near=near, slope=slope)
    if threshold is not None and threshold > most:
        status, threshold = "never_reached", None
    if threshold is None:
        return PooledThreshold(status, math.nan, np.array([math.nan]), math.nan)
    low, high = (of_each(threshold * math.exp(way * STEP / 2.0)) for way in (-1.0, 1.0))
    slope = max(float((high - low).mean()) / STEP, 1e-12)
    middle = (low + high) / 2.0
    return PooledThreshold(status, threshold, (middle.mean() - middle) / slope, slope)


@dataclass(frozen=True, slots=True)
class PredictedThreshold(ComputedThreshold):
    """A threshold computed for a sensor. `threshold` is an SNR, or a contrast if that was varied.
    `numerical_error` is the half-width of its 95 % interval over replicates plus the bounds on the plan's
    omissions and on the change by rounding. `n_phases` is the number of trials averaged over. `points` are pairs
    of SNR and proportion correct around the threshold, and `slope` is dP / d ln level there. `reason` says why
    there is none, with the status "impossible" or "never_reached"; `highest` is then the largest proportion
    correct.
    """

    size_detectors: float = math.nan
    n_phases: int = 0
    points: tuple[tuple[float, float], ...] = ()
    slope: float | None = None
    reason: str = ""
    highest: float | None = None


def predict_threshold(
    chain: FoldedChain,
    *,
    p_correct: float = 0.75,
    tolerance: float = 2e-3,
    seed: int = 1,
    n_points: int = N_POINTS,
    level: Level = "snr",
    progress: Progress = lambda _: None,
) -> PredictedThreshold:
    """Compute a threshold, with more and more places until its error falls below the tolerance. The error is the
    relative half-width of the 95 % interval; `n_points` is the number of points of the psychometric function to
    return. `progress` is called with the share of the longest possible computation that was just done.
    """
    check_positive(argument.tolerance, tolerance)
    ladder = chain.lattices
    near, slope = chain.plan.near_level, chain.plan.slope
    # Where the plan has found no threshold at the places that it tried, there often is none.
    never = chain.unreached(p_correct, seed, ladder[0], level) if near is None else None
    if never is not None:
        return never
    for places in ladder:
        # A lattice takes time in proportion to its places, half of it for drawing.
        half = 0.5 * places**2 / sum(n**2 for n in ladder)
        for n in range(1, REPLICATES + 1):
            parts = chain.replicates(places, seed, n)
            progress(half / REPLICATES)
        phases = pooled(parts)
        n_phases = sum(part.signal[..., 0].size for part in phases)
        crossing_found = find_threshold(
            partial(chain.proportions, phases, level=level, n_replicates=REPLICATES),
            p_correct,
            most=chain.largest_level,
            near=near,
            slope=slope,
        )
        progress(half)
        if crossing_found.status != "ok":
            other = PredictedThreshold(
                crossing_found.status, size_detectors=chain.size_detectors, n_phases=n_phases
            )
            is_never = crossing_found.status == "never_reached"
            return (chain.unreached(p_correct, seed, places, level) if is_never else None) or other
        near = threshold = crossing_found.threshold
        slope = crossing_found.slope
        error, left_out = half_width_95(crossing_found.deviations), chain.plan.bound / slope
        # More trials do not reduce the error of the omissions: on a flat curve, the stated error may stay above
        # the tolerance.
        if error <= max(tolerance - left_out, tolerance / 2.0):
            break
    points: tuple[tuple[float, float], ...] = ()
    if n_points:
        levels = (threshold * 2.0 ** np.linspace(-1.0, 1.0, n_points)).tolist()
        points = tuple((value, chain.proportion_correct(parts[0], value, level=level)) for value in levels)
    error = (error + left_out + chain.rounding_error) * threshold
    size = chain.size_detectors
    return if_known(PredictedThreshold("ok", threshold, error, size, n_phases, points, slope=slope))
