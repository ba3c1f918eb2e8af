"""Thresholds of a sensor with no frame drawn: folded observer, folded display, noise as covariance.

From detector samples to scores everything is linear, so hold, blur, display and retina fold into the observer's
weights: one image on the detectors for each answer. A trial's signal is then an inner product with exact
samples, and white detector noise of standard deviation 1/SNR is the covariance of four scores. What is left is
the mean over the place of the triangle on the detectors and of the retina on the display: a lattice and a
low-discrepancy sequence, in several independent shifts that tell the error.

Hogervorst et al. 2001, sections 3 to 5 and 8.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.crossing import crossing
from sensor_sim.noise import excess_kurtosis
from sensor_sim.reconstruction import axis_matrix, display_position_px
from sensor_sim.sampling import field_detectors, field_sampler
from sensor_sim.sensor import Sensor
from todframes.decision import answer_probability
from todframes.errors import SettingsError
from todframes.readout import Observer, Readout, Stimulus, non_gaussian_bound
from todframes.retina import overlap_matrix
from todframes.stimulus import ORIENTATIONS, Orientation, bounding_box_offset

if TYPE_CHECKING:
    from scipy.sparse import csr_array

FloatArray = NDArray[np.float64]

SCRAMBLINGS = 8
PLACES = (5, 7, 9, 11, 13, 17, 25, 37)
"""Along each axis of a detector, in each scrambling: more and more, until the error is small enough. Numbers that
have a divisor in common with the display's pixels per detector are left out: P repeats with these pixels too, and
such a lattice would see them all alike."""
KRONECKER_STEPS = np.modf(1.1673039782614187 ** -np.arange(1.0, 5.0))[0].reshape(2, 2)
"""Powers of the root of x⁵ = x + 1: a four-dimensional low-discrepancy sequence, two of them counted by rows and
columns of the lattice (Roberts 2018)."""
ORTHANT_NODES = 24
"""Enough for 1e-14 where the four templates differ as those of the triangles do."""
STUDENT_95 = 2.3646
"""97.5 % point of Student's t with one degree of freedom less than there are scramblings."""


class Phases(NamedTuple):
    """Trials: what the folded observer sees of each, for one orientation.

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
        A linear one.
    size_detectors : float
        √(area) of the triangle, > 0.

    Raises
    ------
    SettingsError
        If the observer is not linear, or the size or field is out of range.
    """

    def __init__(self, sensor: Sensor, observer: Observer, size_detectors: float) -> None:
        self.field = field_detectors(sensor, size_detectors)
        self.sampler = field_sampler(sensor, size_detectors)
        self.sensor = sensor
        self.observer = observer
        self.size_detectors = size_detectors
        readout = observer.readout(Stimulus(size_detectors * sensor.display.detector_pitch_mrad))
        if readout is None:
            raise SettingsError("observer: it is not linear; no curve can be computed, simulate frames instead")
        self.readout: Readout = readout
        self.hold = axis_matrix(self.field, display=sensor.display, electronics=sensor.electronics)
        self.noise_covariance = readout.noise_covariance
        side = readout.grid.side
        # Folding in single precision costs half, and its 1e-7 of a weight moves no threshold by as much.
        by_column = np.ascontiguousarray(readout.deviations.transpose(2, 0, 1), dtype=np.float32)
        self._along_x_first = by_column.reshape(side, 4 * side)
        self._drawn: dict[tuple[int, int], list[list[Phases]]] = {}
        # Square detectors and a symmetric observer look the same to all orientations.
        self.orientations = ORIENTATIONS[:1] if _is_symmetric(readout) else ORIENTATIONS

    def _retina(self, place: float) -> csr_array:
        """Share of each retina sample on each display pixel along an axis; its middle at a place in detectors."""
        display = self.sensor.display
        return overlap_matrix(
            self.readout.grid,
            centre_px=display_position_px(place, n_detectors=self.field, display=display),
            pixel_pitch_mrad=display.pixel_pitch_mrad,
            first_pixel=0,
            n_pixels=self.hold.shape[0],
        )

    def with_internal_noise(self, scale: float) -> FoldedChain:
        """The same with the standard deviation of the internal noise scaled; all that was computed is shared."""
        other = copy.copy(self)
        other.noise_covariance = scale**2 * self.noise_covariance
        return other

    def scramblings(self, places: int, seed: int) -> list[list[Phases]]:
        """Independent `phases`, as many as there are scramblings; kept, for other noise asks for the same."""
        if (places, seed) not in self._drawn:
            streams = np.random.SeedSequence(seed, spawn_key=(places,)).spawn(SCRAMBLINGS)
            self._drawn[places, seed] = [self.phases(places, np.random.default_rng(one)) for one in streams]
        return self._drawn[places, seed]

    def phases(self, places: int, rng: np.random.Generator) -> list[Phases]:
        """Trials of each orientation on a grid of `places` × `places`, displaced as a whole at random.

        What is on this grid is the retina's middle, for the weights depend on nothing else: its place is the
        triangle's on the detectors plus its own displacement, and repeats with the detectors. So the grid
        covers one detector evenly, the displacements are a shifted low-discrepancy sequence with both
        signs, and the triangle lies where both put it.
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
        dx, dy = bounding_box_offset(orientation) if self.observer.centre == "bounding_box" else (0.0, 0.0)
        field, side = self.field, self.readout.grid.side
        # From the retina to the display by sparse overlap, then to the detectors: first along x, then along y.
        on_columns = np.stack([self._fold(x + dx * self.size_detectors, self._along_x_first) for x in middle_x])
        on_columns = on_columns.reshape(places := len(middle_x), field, 4, side).transpose(3, 0, 2, 1)
        on_columns = np.ascontiguousarray(on_columns).reshape(side, places * 4 * field)
        signal, noise = [], []
        for row, y in enumerate(middle_y):
            folded = self._fold(y + dy * self.size_detectors, on_columns).reshape(field, places, 4, field)
            weights = folded.transpose(1, 2, 0, 3).reshape(places, 4, field**2).astype(np.float64)
            weights *= self.sensor.display.gain
            these = slice(row * places, (row + 1) * places)
            samples = self.sampler.samples(
                triangle_x[these].ravel(), triangle_y[these].ravel(), orientation=orientation
            ).reshape(places, -1, field**2)
            signal.append(samples @ weights.swapaxes(1, 2))
            noise.append(weights @ weights.swapaxes(1, 2))
        return Phases(np.concatenate(signal), np.concatenate(noise), orientation.quarter_turns)

    def _fold(self, place: float, weights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Weights on retina samples along the first axis, (side, n), to weights on detectors, (field, n)."""
        on_pixels = self._retina(place).astype(np.float32).T @ weights
        return np.asarray(self.hold.T.astype(np.float32) @ on_pixels)

    def non_gaussian_bound(self) -> float:
        """Bound on the error in P(correct) from taking internal and detector noise as Gaussian, to first order.

        As for the internal noise alone (`Readout.non_gaussian_bound`): the sum's excess kurtosis is at most the
        larger one of its two parts.
        """
        columns = self._fold(0.0, self._along_x_first).reshape(self.field, 4, -1).transpose(2, 1, 0)
        weights = self._fold(0.0, np.ascontiguousarray(columns).reshape(len(columns), -1))
        weights = weights.reshape(self.field, 4, self.field).transpose(1, 0, 2).reshape(4, -1).astype(np.float64)
        squares = np.square(weights[:, None] - weights)[np.triu_indices(4, 1)]
        participation = (np.square(squares).sum(axis=1) / np.square(squares.sum(axis=1))).max()
        of_detectors = non_gaussian_bound(excess_kurtosis(self.sensor.noise) * float(participation))
        return max(self.readout.non_gaussian_bound, of_detectors)

    def proportion_correct(self, phases: list[Phases], snr: float) -> float:
        """Mean P(correct) over trials at a signal-to-noise ratio; infinity: no detector noise."""
        means = []
        for part in phases:
            covariance = self.noise_covariance + part.noise[:, None] / snr**2
            means.append(answer_probability(part.signal, covariance, part.correct, nodes=ORTHANT_NODES).mean())
        return float(np.mean(means))


def _is_symmetric(readout: Readout) -> bool:
    """Whether the four scores are one and the same, turned, to the last bit."""
    first, covariance = readout.deviations[0], readout.noise_covariance
    return all(
        np.array_equal(readout.deviations[k], np.rot90(first, -k))
        and np.allclose(np.roll(covariance[0], k), covariance[k], rtol=1e-12)
        for k in range(1, 4)
    )


@dataclass(frozen=True, slots=True)
class PredictedThreshold:
    """A threshold computed for a sensor.

    `threshold` is a signal-to-noise ratio; `numerical_error` the half-width of its 95 % interval over scramblings;
    `n_phases` the trials it is a mean over; `points` pairs of SNR and proportion correct about it.
    """

    size_detectors: float
    status: Literal["ok", "never_reached", "always_exceeded"]
    threshold: float | None
    numerical_error: float | None
    n_phases: int
    points: tuple[tuple[float, float], ...]


def predict_threshold(
    chain: FoldedChain, *, p_correct: float = 0.75, tolerance: float = 2e-3, seed: int = 1
) -> PredictedThreshold:
    """Threshold SNR, with as many places as its error needs to fall below `tolerance` times the threshold.

    Parameters
    ----------
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative half-width of the 95 % interval that ends the refinement.
    seed : int
        Of the scramblings.

    Raises
    ------
    SettingsError
        If the tolerance is not a positive number.
    """
    if not tolerance > 0:
        raise SettingsError(f"tolerance: found {tolerance!r}, expected a number > 0")
    pixels = chain.sensor.display.pixels_per_detector
    ladder = [places for places in PLACES if math.gcd(places, pixels) == 1]
    threshold: float | None = None
    slope = math.nan
    for places in ladder:
        parts = chain.scramblings(places, seed)
        pooled = [_pool(list(same)) for same in zip(*parts, strict=True)]
        proportion = partial(chain.proportion_correct, pooled)
        n_phases = sum(part.signal[..., 0].size for part in pooled)
        status, threshold = crossing(proportion, p_correct, near=threshold, slope=slope)
        if threshold is None:
            return PredictedThreshold(chain.size_detectors, status, None, None, n_phases, ())
        error, slope = _error(chain, parts, threshold)
        if error <= tolerance * threshold:
            break
    assert threshold is not None
    levels = (threshold * 2.0 ** np.linspace(-1.0, 1.0, 7)).tolist()
    points = tuple((snr, chain.proportion_correct(parts[0], snr)) for snr in levels)
    return PredictedThreshold(chain.size_detectors, status, threshold, error, n_phases, points)


def _pool(parts: list[Phases]) -> Phases:
    signal, noise = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Phases(signal, noise, parts[0].correct)


def _error(chain: FoldedChain, parts: list[list[Phases]], threshold: float) -> tuple[float, float]:
    """Half-width of the 95 % interval of a threshold from the spread of P among scramblings, and dP/d ln SNR."""
    step = 0.01
    low, high = (
        np.array([chain.proportion_correct(part, threshold * factor) for part in parts])
        for factor in (math.exp(-step), math.exp(step))
    )
    slope = max(float((high - low).mean()) / (2.0 * step), 1e-12)
    spread = float(((high + low) / 2.0).std(ddof=1)) / math.sqrt(len(parts))
    return STUDENT_95 * spread / slope * threshold, slope
