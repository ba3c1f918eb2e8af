"""Thresholds of a sensor with no frame drawn: folded observer, folded display, noise as covariance.

From detector samples to scores everything is linear, so hold, blur, display and retina fold into the observer's
weights: one image on the detectors for each answer. A trial's signal is then an inner product with exact samples,
and white detector noise of standard deviation 1/SNR is the covariance of four scores. What is left is the mean over
the place of the triangle on the detectors, of the retina on the display, and over orientation: scrambled Sobol
points, in several independent scramblings that tell the error.

Hogervorst et al. 2001, sections 3 to 5 and 8.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.reconstruction import axis_matrix, display_position_px
from sensor_sim.sampling import TriangleSampler
from sensor_sim.sensor import Sensor
from todframes.decision import answer_probabilities
from todframes.errors import SettingsError
from todframes.readout import Observer, Readout, Stimulus
from todframes.retina import overlap_matrix
from todframes.stimulus import ORIENTATIONS, bounding_box_offset

FloatArray = NDArray[np.float64]

SCRAMBLINGS = 8
FIRST_POINTS, MOST_POINTS = 8, 1024
"""Of each scrambling."""
FIELD_SIZES = 4.0
"""Field of the sensor over the triangle's size; the observer's own is about as wide."""
FIELD_MARGIN_DETECTORS = 4
LEVEL_RANGE = (1e-6, 1e9)
STUDENT_95 = 2.3646
"""97.5 % point of Student's t with one degree of freedom less than there are scramblings."""


def field_detectors(sensor: Sensor, size_detectors: float) -> int:
    """Detectors along each side of the field in which a triangle is shown: four sizes and a margin."""
    optics_blur = 3.0 * sensor.optics.blur_sigma_mrad / sensor.detector.pitch_mrad
    return math.ceil(FIELD_SIZES * size_detectors + 2.0 * optics_blur) + FIELD_MARGIN_DETECTORS


def make_sampler(sensor: Sensor, size_detectors: float) -> TriangleSampler:
    """Exact samples of a triangle in the field that it is shown in, repeated so far away that none is seen.

    Raises
    ------
    SettingsError
        If the size is not a positive number, or the optics pass too little or too much for the field.
    """
    if not (math.isfinite(size_detectors) and size_detectors > 0):
        raise SettingsError(f"size_detectors: found {size_detectors!r}, expected a finite number > 0")
    field = field_detectors(sensor, size_detectors)
    return TriangleSampler(
        optics=sensor.optics,
        detector=sensor.detector,
        size_detectors=size_detectors,
        field_detectors=field,
        period_detectors=2 * field,
    )


class Phases(NamedTuple):
    """Trials drawn: what the folded observer sees of each.

    Attributes
    ----------
    signal : ndarray, shape (n, 4)
        Score deviations caused by the triangle, of amplitude 1.
    noise : ndarray, shape (n, 4, 4)
        Covariance of the scores under detector noise of standard deviation 1.
    correct : ndarray of int, shape (n,)
        The orientation shown, an index into `ORIENTATIONS`.
    """

    signal: FloatArray
    noise: FloatArray
    correct: NDArray[np.intp]


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
        self.sampler = make_sampler(sensor, size_detectors)
        self.sensor = sensor
        self.observer = observer
        self.field = field_detectors(sensor, size_detectors)
        self.size_mrad = size_detectors * sensor.display.detector_pitch_mrad
        self.size_detectors = size_detectors
        readout = observer.readout(Stimulus(self.size_mrad))
        if readout is None:
            raise SettingsError("observer: it is not linear; no curve can be computed, simulate frames instead")
        self.readout: Readout = readout
        self.hold = axis_matrix(self.field, display=sensor.display, electronics=sensor.electronics)

    def weights(self, *, x_detectors: float, y_detectors: float, dx_samples: float, dy_samples: float) -> FloatArray:
        """Deviations of the four scores per unit of signal in each detector: (4, field, field).

        Parameters
        ----------
        x_detectors, y_detectors : float
            Where the observer expects the point of the triangle that it looks at, from the field's middle.
        dx_samples, dy_samples : float
            Displacement of the retina grid.
        """
        display, grid = self.sensor.display, self.readout.grid
        along = []
        for offset, displacement in ((y_detectors, dy_samples), (x_detectors, dx_samples)):
            centre_px = display_position_px(offset, n_detectors=self.field, display=display)
            retina = overlap_matrix(
                grid,
                centre_px=centre_px + displacement * grid.pitch_mrad / display.pixel_pitch_mrad,
                pixel_pitch_mrad=display.pixel_pitch_mrad,
                first_pixel=0,
                n_pixels=self.hold.shape[0],
            )
            along.append(retina @ self.hold)
        rows, columns = along
        deviations = self.readout.deviations
        # A loop over four products so small that BLAS starts no threads for them.
        return display.gain * np.stack([rows.T @ (deviation @ columns) for deviation in deviations])

    def phases(self, points: FloatArray) -> Phases:
        """Trials at points of the unit cube, shape (n, 5): place on the detectors, displacement, orientation."""
        jitter = self.observer.position_jitter_samples
        place, displacement = points[:, :2] - 0.5, (2.0 * points[:, 2:4] - 1.0) * jitter
        correct = np.minimum((4.0 * points[:, 4]).astype(np.intp), 3)
        signal, noise = np.empty((len(points), 4)), np.empty((len(points), 4, 4))
        for orientation in ORIENTATIONS:
            these = np.flatnonzero(correct == orientation.quarter_turns)
            if not these.size:
                continue
            x, y = place[these].T
            samples = self.sampler.samples(x, y, orientation=orientation)
            to_box = bounding_box_offset(orientation) if self.observer.centre == "bounding_box" else (0.0, 0.0)
            for one, sample in zip(these, samples, strict=True):
                weights = self.weights(
                    x_detectors=place[one, 0] + to_box[0] * self.size_detectors,
                    y_detectors=place[one, 1] + to_box[1] * self.size_detectors,
                    dx_samples=displacement[one, 0],
                    dy_samples=displacement[one, 1],
                )
                flat = weights.reshape(4, -1)
                signal[one] = flat @ sample.ravel()
                noise[one] = flat @ flat.T
        return Phases(signal, noise, correct)

    def proportion_correct(self, phases: Phases, snr: float) -> FloatArray:
        """P(correct) of each trial at a signal-to-noise ratio; infinity: no detector noise. Shape (n,)."""
        covariance = self.readout.noise_covariance + phases.noise / snr**2
        answers = answer_probabilities(phases.signal, covariance)
        return np.asarray(answers[np.arange(len(answers)), phases.correct])


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
        Relative half-width of the 95 % interval that ends the refinement; at most 8 × 1024 trials are taken.
    seed : int
        Of the scramblings.

    Raises
    ------
    SettingsError
        If the tolerance is not a positive number.
    """
    from scipy.stats import qmc

    if not tolerance > 0:
        raise SettingsError(f"tolerance: found {tolerance!r}, expected a number > 0")
    streams = np.random.SeedSequence(seed).spawn(SCRAMBLINGS)
    engines = [qmc.Sobol(5, rng=np.random.default_rng(stream)) for stream in streams]
    parts = [chain.phases(engine.random(FIRST_POINTS)) for engine in engines]
    while True:
        pooled = _pool(parts)
        status, threshold = _crossing(lambda snr: float(chain.proportion_correct(pooled, snr).mean()), p_correct)  # noqa: B023
        n_phases = len(pooled.correct)
        if threshold is None:
            return PredictedThreshold(chain.size_detectors, status, None, None, n_phases, ())
        error = _error(chain, parts, threshold)
        if error <= tolerance * threshold or n_phases >= SCRAMBLINGS * MOST_POINTS:
            levels = threshold * 2.0 ** np.linspace(-1.0, 1.0, 7)
            points = tuple((snr, float(chain.proportion_correct(pooled, snr).mean())) for snr in levels.tolist())
            return PredictedThreshold(chain.size_detectors, status, threshold, error, n_phases, points)
        parts = [
            _pool([part, chain.phases(engine.random(len(part.correct)))])
            for part, engine in zip(parts, engines, strict=True)
        ]


def _pool(parts: list[Phases]) -> Phases:
    return Phases(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _error(chain: FoldedChain, parts: list[Phases], threshold: float) -> float:
    """Half-width of the 95 % interval of a threshold from the spread of P among scramblings, to first order."""
    step = 0.01
    low, high = (
        np.array([chain.proportion_correct(part, threshold * factor).mean() for part in parts])
        for factor in (1.0 - step, 1.0 + step)
    )
    slope = (high - low).mean() / (2.0 * step * threshold)
    spread = ((high + low) / 2.0).std(ddof=1) / math.sqrt(len(parts))
    return float(STUDENT_95 * spread / slope)


def _crossing(
    proportion: Callable[[float], float], p_correct: float
) -> tuple[Literal["ok", "never_reached", "always_exceeded"], float | None]:
    """Where a rising curve passes `p_correct`, on a logarithmic scale outwards from 1, by false position."""
    low = high = 0.0
    at_low = at_high = proportion(1.0) - p_correct
    while at_low > 0:
        high, at_high, low = low, at_low, low - math.log(4.0)
        if low < math.log(LEVEL_RANGE[0]):
            return "always_exceeded", None
        at_low = proportion(math.exp(low)) - p_correct
    while at_high <= 0:
        low, at_low, high = high, at_high, high + math.log(4.0)
        if high > math.log(LEVEL_RANGE[1]):
            return "never_reached", None
        at_high = proportion(math.exp(high)) - p_correct
    return "ok", math.exp(_root(lambda x: proportion(math.exp(x)) - p_correct, low, high, at_low, at_high))


def _root(
    function: Callable[[float], float], low: float, high: float, at_low: float, at_high: float
) -> float:
    """Root of a rising function between two places, to 1e-7, by the ITP-free Illinois rule (Dowell & Jarratt 1971)."""
    for _ in range(60):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        at_middle = function(middle)
        if abs(at_middle) < 1e-9 or high - low < 1e-7:
            return middle
        if at_middle > 0:
            high, at_high, at_low = middle, at_middle, at_low / 2.0
        else:
            low, at_low, at_high = middle, at_middle, at_high / 2.0
    return middle
