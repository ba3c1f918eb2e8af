"""Thresholds of four bars (MRTD, MRC) for the same sensor and model observer as the TOD, without drawing frames.

Two displays show the same place, one with the bars and one without. The observer knows the bars: in each it
correlates the activity of its neurons with that expected for the bars, and answers the display with the larger
score. The score is one inner product with the detectors' samples, as those of the triangles are: folding, samples,
the lattice of places and the noise are the same. P(correct) at a place is then Φ(signal / √(2 variance)).

If the other display shows a uniform square with the mean of the bars, the bars have to be resolved. If it shows
the background, their mean alone is enough, and the threshold has no limit of resolution.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.sampling import MAX_FIELD_DETECTORS, FourBarSampler, field_detectors
from sensor_sim.thresholds.curve_plan import PLACES, detector_covariance
from sensor_sim.thresholds.folding import Folding
from sensor_sim.thresholds.predict import Lattice, find_threshold
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.four_bars import WIDTHS, FourBars
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.parameters import Against, Direction
from todframes.psychometrics.threshold_search import ComputedThreshold, Status, crossing
from todframes.scoring.error_budget import REPLICATES, half_width_95
from todframes.stimulus import Orientation, Stimulus

ORIENTATION: dict[Direction, Orientation] = {"upright": Orientation.UP, "lying": Orientation.RIGHT}
"""Orientation of the samples: bars have no apex, so only two of the four differ."""

PATTERN_FIELD = 2.0
"""Side of a trial's field in widths of the pattern; with twice that, thresholds change by less than 1e-6."""

HIGHEST_CYC_PER_DETECTOR = 10.0
"""Highest frequency of bars, in cycles per detector."""

WEIGHTS_AT_ONCE = 2**20
"""Number of weights on the detectors of several places that are multiplied with samples at once."""

SEARCHED, REFINED = 12, 5
"""Places along each axis of a detector among which the best is searched, and about it in each refinement."""

REFINEMENTS = 4
"""Number of refinements, each with half the distance of the one before."""

MOST_EXCHANGES = 10
"""Largest number of times that a place is exchanged for one that is better at its threshold."""


class BarScores(NamedTuple):
    """Scores that bars of amplitude 1 cause at some places, and their variances under detector noise of deviation
    1.
    """

    signal: FloatArray
    noise: FloatArray


class BarChain:
    """A sensor and an observer of four bars, folded into weights on the detectors. The frequency of the bars is
    that in the scene. SettingsError if the observer has no `detection`, so judges triangles only, the sensor
    counts photons, or the frequency is out of range.
    """

    def __init__(
        self,
        camera: Camera,
        observer: Observer,
        frequency_cyc_per_mrad: float,
        *,
        against: Against = "square",
        direction: Direction = "upright",
    ) -> None:
        if camera.photons is not None:
            raise SettingsError("sensor: found one that counts photons, expected one whose level is an SNR")
        if against == "background":
            # Levels enough for triangles, whose mean says nothing, lack up to 1 % of a threshold of the mean.
            observer = observer.with_extra_level()
        self.camera, self.observer, self.direction = camera, observer, direction
        pitch = camera.pitch_mrad
        _check_frequency(frequency_cyc_per_mrad, pitch)
        self.bars = FourBars(0.5 / (frequency_cyc_per_mrad * pitch), against)
        self.field = field_detectors(camera, self.bars.side, PATTERN_FIELD)
        shown = camera.shown_pitch_mrad
        width_mrad = self.bars.side * shown
        try:
            grid = observer.grid(Stimulus(width_mrad))
        except SettingsError:
            raise SettingsError(
                f"{argument.frequency_nyquist}: found {2.0 * frequency_cyc_per_mrad * pitch:.4g}, at which the "
                f"bars are displayed {width_mrad:.4g} mrad wide, more than the observer looks at; expected a "
                "higher frequency"
            ) from None
        self.whole_retina = grid
        self.sampler = FourBarSampler(camera, self.bars, self.field, 2 * self.field)
        half = math.ceil(width_mrad / 2.0 / grid.pitch_mrad) + 1
        upright = FourBars(self.bars.bar_width * shown, against).image(half, grid.pitch_mrad)
        self.pattern = upright if direction == "upright" else np.ascontiguousarray(upright.T)
        self.jitter_detectors = observer.position_jitter_samples * grid.pitch_mrad / shown
        reach = 0.5 + self.jitter_detectors
        seen = min(math.ceil((self.field / 2.0 + reach) * shown / grid.pitch_mrad), grid.side // 2)
        detection = observer.detection(self.pattern, width_mrad, seen)
        if detection is None:
            raise SettingsError(
                f"observer: {type(observer).__name__} with these settings judges triangles only, expected one "
                "that judges bars, such as pyramid or csf"
            )
        weights, self.noise_variance = detection
        self.folding = Folding(
            camera,
            RetinaGrid(2 * seen + 1, grid.pitch_mrad),
            weights[None],
            n=1,
            field=self.field,
            reach_detectors=reach,
        )

    def scores(self, x: FloatArray, y: FloatArray, displacement: FloatArray) -> BarScores:
        """Compute the scores, (rows · columns, displacements), of bars with the retina's middle on a lattice. x
        and y are positions of the retina's middle along each axis, in detectors from the field's middle.
        `displacement`, (rows · columns, displacements, 2), is that of the retina against the bars along x and y,
        in detectors; its first axis has the lattice row by row.
        """
        rows = max(WEIGHTS_AT_ONCE // (len(x) * self.field**2), 1)
        gain = self.camera.gain
        signal, noise = np.empty(displacement.shape[:2]), np.empty(displacement.shape[:2])
        for start in range(0, len(y), rows):
            some = y[start : start + rows]
            weights = gain * self.folding.weights_by_row(x, some).reshape(-1, self.field**2)
            part = slice(start * len(x), start * len(x) + len(weights))
            at = np.stack(np.meshgrid(x, some), axis=-1).reshape(-1, 1, 2) - displacement[part]
            samples = self.sampler.samples(*at.reshape(-1, 2).T, orientation=ORIENTATION[self.direction])
            samples = samples.reshape(*at.shape[:2], -1)
            signal[part] = (samples @ weights[..., None])[..., 0]
            noise[part] = detector_covariance(weights[:, None], self.camera.lines)[:, 0]
        return BarScores(signal, noise)

    def proportion(self, scores: BarScores, snr: float) -> FloatArray:
        """Compute P(correct) of each place at an SNR; infinity means no detector noise."""
        variance = self.noise_variance + scores.noise / snr**2
        with np.errstate(divide="ignore", invalid="ignore"):
            deviations = scores.signal / np.sqrt(2.0 * variance)
        proportions: FloatArray = ndtr(np.where(np.isnan(deviations), 0.0, deviations))
        return proportions

    def best(self, p_correct: float) -> ComputedThreshold:
        """Compute the threshold where the bars lie best on the detectors, a mean over displacements of the retina.
        The error is the change from the last refinement's neighbour, and from fewer displacements.
        """
        nodes = 2 + math.ceil(8.0 * self.jitter_detectors)
        place = self._best_place(p_correct, nodes)
        beside = place + 2.0**-REFINEMENTS / SEARCHED / 2.0
        (status, snr), *others = (
            self._at_places(self._on_places(at[:1], at[1:], n), p_correct)[:2]
            for at, n in ((place, nodes + 6), (place, nodes + 4), (beside, nodes + 4))
        )
        if snr is None:
            return ComputedThreshold(status)
        return ComputedThreshold(status, snr, sum(abs(other - snr) for _, other in others if other is not None))

    def _best_place(self, p_correct: float, nodes: int) -> FloatArray:
        """Return the place on the detectors, (x, y), at which the bars have the lowest threshold."""
        step = 1.0 / SEARCHED
        x = y = (np.arange(float(SEARCHED)) + 0.5) * step - 0.5
        best = np.zeros(2)
        for _ in range(1 + REFINEMENTS):
            row, column = divmod(self._at_places(self._on_places(x, y, nodes), p_correct)[2], len(x))
            best = np.array([x[column], y[row]])
            step /= 2.0
            around = (np.arange(float(REFINED)) - REFINED // 2) * step
            x, y = best[0] + around, best[1] + around
        return best

    def _on_places(self, x: FloatArray, y: FloatArray, nodes: int) -> tuple[BarScores, FloatArray]:
        """Return the scores of bars on a lattice of places, and the weights of the retina's displacements. The
        scores have shape (rows · columns, nodes²), the weights (nodes²,).
        """
        at, weight = np.polynomial.legendre.leggauss(nodes)
        along = self.jitter_detectors * at
        shape = (len(y), nodes, len(x), nodes)
        displacement = np.empty((*shape, 2))
        displacement[..., 0], displacement[..., 1] = along, along[:, None, None]
        scores = self.scores(
            (x[:, None] + along).ravel(), (y[:, None] + along).ravel(), displacement.reshape(-1, 1, 2)
        )
        by_place = (
            of_orientation.reshape(shape).transpose(0, 2, 1, 3).reshape(len(x) * len(y), -1)
            for of_orientation in scores
        )
        return BarScores(*by_place), np.outer(weight, weight).ravel() / 4.0

    def _at_places(
        self, on_places: tuple[BarScores, FloatArray], p_correct: float
    ) -> tuple[Status, float | None, int]:
        """Return the lowest threshold of some places, and the number of its place."""
        scores, weights = on_places
        status: Status = "never_reached"
        snr, best = None, int(np.argmax(self.proportion(scores, math.inf) @ weights))
        for _ in range(MOST_EXCHANGES):
            of_place = BarScores(scores.signal[best], scores.noise[best])

            def at_level(level: float, at_places: BarScores = of_place) -> float:
                return float(self.proportion(at_places, level) @ weights)

            status, snr = crossing(at_level, p_correct, near=None, slope=math.nan)
            better = int(np.argmax(self.proportion(scores, math.inf if snr is None else snr) @ weights))
            if better == best:
                break
            best = better
        return status, snr, best

    def averaged(self, p_correct: float, *, tolerance: float = 2e-3, seed: int = 1) -> ComputedThreshold:
        """Compute the threshold of P(correct) averaged over all places of the bars on the detectors. More places
        are taken until the relative half-width of the 95 % interval is below the tolerance.
        """
        computed = ComputedThreshold("never_reached")
        for places in PLACES:
            if math.gcd(places, self.camera.pixels_per_detector) > 1:
                continue
            parts = []
            for stream in np.random.SeedSequence(seed, spawn_key=(places,)).spawn(REPLICATES):
                rng = np.random.default_rng(stream)
                lattice = Lattice.at(
                    places, shift=rng.random(2), first=rng.random(2), jitter=self.jitter_detectors
                )
                parts.append(self.scores(lattice.x, lattice.y, lattice.displacement))
            scores = BarScores(*(np.stack(part) for part in zip(*parts, strict=True)))
            mean = find_threshold(partial(self._of_each, scores), p_correct)
            if mean.status != "ok":
                return ComputedThreshold(mean.status)
            error = half_width_95(mean.deviations)
            computed = ComputedThreshold(mean.status, mean.threshold, mean.threshold * error)
            if error <= tolerance:
                break
        return computed

    def _of_each(self, scores: BarScores, snr: float) -> FloatArray:
        """Return P(correct) of each replicate of scores, (replicates, places, displacements), at an SNR."""
        return np.asarray(self.proportion(scores, snr).mean(axis=(1, 2)))


def _check_frequency(frequency_cyc_per_mrad: float, pitch_mrad: float) -> None:
    """Raise SettingsError if the bars do not fit into the largest field, or are no bars."""
    nyquist = 2.0 * frequency_cyc_per_mrad * pitch_mrad
    lowest, highest = WIDTHS * PATTERN_FIELD / (MAX_FIELD_DETECTORS / 2.0), 2.0 * HIGHEST_CYC_PER_DETECTOR
    if not lowest <= nyquist <= highest:
        raise SettingsError(
            f"{argument.frequency_nyquist}: found {nyquist:.4g}, expected a number from {lowest:.3g} to "
            f"{highest:.3g}"
        )
