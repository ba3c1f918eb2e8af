"""Plan of a curve's computation: the parts of the chain that the threshold of one size needs.

`plan_curve` computes the whole chain at a few places of the triangle and bounds there the change that leaving out
each part would cause. `sensor_sim.thresholds.predict` computes the threshold with the parts that are kept.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.measured import MeasuredMtf
from sensor_sim.chain.noise import NO_LINES, LineShares, contrast_variance
from sensor_sim.chain.reconstruction import gaussian_kernel
from sensor_sim.chain.sampling import TriangleSampler, field_detectors, smallest_field
from sensor_sim.chain.transfer import band_limit_cyc_per_mrad, blur_mrad, looks_the_same_when_turned
from sensor_sim.thresholds.folding import Folding
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.observers.decision import answer_probability
from todframes.observers.interface import Observer, Readout
from todframes.observers.pyramid import PyramidObserver
from todframes.parameters import PlanName
from todframes.psychometrics.threshold_search import crossing
from todframes.scoring.error_budget import LEFT_OUT_SHARE, SAFETY, Step, decision_change, total_bound
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, bounding_box_offset

PLACES = (5, 7, 11, 17, 25, 37)
"""Numbers of places along each axis of a detector, in each replicate, tried in turn until the error is small
enough. Each takes twice the trials of the one before, so that there are few chances to stop at an error estimate
that is too small by chance. Numbers that have a divisor in common with the display's pixels per detector are left
out: P repeats with these pixels too, and such a lattice would sample all of them at the same places."""

FULL_PLACES = tuple(n for n in PLACES if n >= 17)
"""Those of a full plan, which begins with twelve times the trials of most thresholds."""

COARSE_LATTICES = 2
"""Number of lattices of a coarse plan; the stated error may then be above what was aimed at."""

ORTHANT_TOLERANCE = 1e-8
"""Error of each P(correct): in a threshold it is 1e-7 of it at most, a ten-thousandth of what is asked for."""

TRIED_AT = ((0.0, 0.0), (0.5, 0.5), (0.25, -0.375))
"""Places, in detectors from the field's middle, at which the omissions are bounded."""

FIELDS_IN_SIZES = (2.0, 2.5, 3.0)

SINGLE_TOLERANCE, SINGLE_BOUND = 1e-4, 3e-6
"""Least tolerance for which weights are folded in single precision, and what that changes of P(correct) at most:
twice the largest bound for the presets."""

LEAST_END_MTF = 1e-3
"""MTF at the end of a table below which nothing beyond it matters."""

LARGEST_SHARE = 0.6
"""Largest share of the budget that one omission may take."""

COARSE_BOUND = 3e-4
"""Change of P(correct) that `coarse_plan` may cause; over sensors at random it is below half."""

SMALL_JITTER = 0.03
"""Displacement of the retina, in detectors, that a coarse plan leaves out: the hold of a detector blurs 300 times
as much."""

Level = Literal["snr", "contrast"]
"""Quantity that is varied: the detectors' noise under a triangle of contrast 1, or, without detector noise, the
contrast of the triangle."""


class PartCache:
    """Parts of computations that several thresholds share: samplers, samples, folded weights and trials. A key
    holds all that its value depends on, so what is shared changes no number. There are up to `most_bytes` of them;
    those not used for the longest time are dropped first. `check` is called whenever a part is asked for, and
    every few milliseconds of a search; the explorer's processes let it raise an exception where a newer curve is
    wanted.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.check: Callable[[], None] = lambda: None
        self._values: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._bytes = 0

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the value of a key, made now if it is not kept. The caller must not change it."""
        self.check()
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key][0]
        value = make()
        size = KEY_BYTES + sum(part.nbytes for part in (value if isinstance(value, list) else [value]))
        if size <= self.most_bytes:
            self._values[key] = value, size
            self._bytes += size
        while self._bytes > self.most_bytes:
            self._bytes -= self._values.popitem(last=False)[1][1]
        return value


KEY_BYTES = 1000
"""Size of a key and of an object, about."""

PARTS = PartCache(256 * 2**20)
"""The parts of this process."""


def shared_sampler(camera: Camera, size_detectors: float, field: int, period: int) -> TriangleSampler:
    """Return the sampler of a triangle, which cameras that differ behind the detectors alone share."""
    sampler: TriangleSampler = PARTS.get(
        ("sampler", camera.samples_key, size_detectors, field, period),
        lambda: TriangleSampler(camera, size_detectors, field, period),
    )
    return sampler


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvePlan:
    """Choices for the computation of a sensor's threshold at one size.

    `observer` has the pyramid levels that are needed, and `sampler` the samples of the triangle in `field` ×
    `field` detectors. `dtype` is the precision of the folding. `orientations` are those that are computed: one
    stands for all where the others are the same, turned. `lines` are the shares of rows and columns in the noise,
    none for cameras that count photons, whose variances are apart.

    `places` are numbers of places along each axis of a detector, tried in turn. `steps` are the parts that are
    left out, with their bounds, and those that are kept. `repetition_bound` bounds the change of P(correct)
    because the scene repeats, with the longest period that is considered. Up to `least_jitter` detectors, the
    retina's displacement is left out. `half_width` is the number of samples on each side of the retina's middle
    one that are needed; None: all. `near_level` is the threshold at the places that were tried, with the `slope`
    dP / d ln level there; None and NaN without one.
    """

    observer: Observer
    field: int
    sampler: TriangleSampler
    dtype: DTypeLike = np.float64
    orientations: tuple[Orientation, ...] = ORIENTATIONS
    level: Level = "snr"
    lines: LineShares = NO_LINES
    places: tuple[int, ...] = PLACES
    steps: tuple[Step, ...] = ()
    repetition_bound: float = 0.0
    least_jitter: float = 0.0
    half_width: int | None = None
    near_level: float | None = None
    slope: float = math.nan

    @property
    def bound(self) -> float:
        """Bound on the change of P(correct) from all omissions and from the repetition of the scene together."""
        of_precision = SINGLE_BOUND if self.dtype == np.float32 else 0.0
        return total_bound(self.steps) + self.repetition_bound + of_precision

    def folding(self, camera: Camera, readout: Readout, size_detectors: float) -> Folding:
        """Return a `Folding` of the readout's weights onto the detectors. Three of the four score deviations are
        folded, as they add up to zero.
        """
        offsets = [centre_offset(self.observer, orientation, size_detectors) for orientation in ORIENTATIONS]
        return Folding(
            camera,
            readout.grid,
            readout.deviations,
            n=3,
            field=self.field,
            reach_detectors=0.5 + max(map(abs, np.ravel(offsets))),
            dtype=self.dtype,
            key=readout.weights_key,
        )

    def samples(self, x_detectors: FloatArray, y_detectors: FloatArray, orientation: Orientation) -> FloatArray:
        """Return the samples of triangles at these places: (places, field, field)."""
        samples: FloatArray = PARTS.get(
            ("samples", self.sampler.key, orientation, x_detectors.tobytes(), y_detectors.tobytes()),
            lambda: self.sampler.samples(x_detectors, y_detectors, orientation=orientation),
        )
        return samples

    def weights_by_row(self, folding: Folding, places_x: FloatArray, places_y: FloatArray) -> NDArray[Any]:
        """Return the folded weights as `Folding.weights_by_row` does."""
        rows: NDArray[Any] = PARTS.get(
            ("weights", folding.key, places_x.tobytes(), places_y.tobytes()),
            lambda: folding.weights_by_row(places_x, places_y),
        )
        return rows

    def all_four(self, weights: FloatArray) -> FloatArray:
        """Return the weights of all four scores, (..., 4, n), from the folded ones."""
        return np.concatenate([weights, -weights.sum(axis=-2, keepdims=True)], axis=-2)

    def noise(self, weights: FloatArray) -> FloatArray:
        """Compute the covariance of the scores, (..., 4, 4), under detector noise of standard deviation 1."""
        if self.level == "contrast":
            return np.zeros((*weights.shape[:-1], 4))
        return detector_covariance(weights, self.lines)


def plan_curve(
    camera: Camera,
    observer: Observer,
    size_detectors: float,
    *,
    name: PlanName = "needed",
    tolerance: float = 2e-3,
    p_correct: float = 0.75,
    level: Level = "snr",
) -> CurvePlan:
    """Plan the computation of a threshold. The plan "needed" leaves out the parts that the threshold does not
    need, whose omission may take half of the relative `tolerance`; "full" leaves out none. SettingsError if the
    observer is not linear, or the size or field is out of range.
    """
    if name == "full":
        full = full_plan(camera, observer.with_extra_level(), size_detectors)
        planner = _CurvePlanner(camera, size_detectors, full, p_correct, tolerance)
        return replace(full, repetition_bound=planner.repetition_bound(full))
    full = replace(full_plan(camera, observer, size_detectors), level=level, places=PLACES, steps=())
    return _CurvePlanner(camera, size_detectors, full, p_correct, tolerance).plan()


def full_plan(camera: Camera, observer: Observer, size_detectors: float) -> CurvePlan:
    """Return the plan that computes everything except exact identities. The scene repeats after two fields."""
    field = field_detectors(camera, size_detectors)
    sampler = shared_sampler(camera, size_detectors, field, 2 * field)
    detectors = field_side(camera, observer, size_detectors)
    return CurvePlan(
        observer=observer,
        field=detectors,
        sampler=sampler.cropped(detectors),
        lines=camera.lines,
        places=FULL_PLACES,
        steps=(Step("everything", True, f"as {argument.plan} full asks; the field is {detectors} detectors"),),
    )


def coarse_plan(camera: Camera, observer: Observer, size_detectors: float, *, level: Level = "snr") -> CurvePlan:
    """Return a plan that leaves out, without a test, what most plans leave out: far field and double precision."""
    shown_mrad = camera.shown_pitch_mrad
    pitch_mrad = observer.grid(Stimulus(size_detectors * shown_mrad)).pitch_mrad
    blur = 6.0 * blur_mrad(camera) / camera.pitch_mrad
    blur += 4.0 * math.hypot(*camera.blurs_px) / camera.pixels_per_detector
    full = field_detectors(camera, size_detectors)
    needed = max(math.ceil(FIELDS_IN_SIZES[0] * size_detectors + blur) + 2, smallest_field(size_detectors))
    whole = min(needed + (full - needed) % 2, full)
    sampler = shared_sampler(camera, size_detectors, whole, 2 * whole)
    field = min(whole, field_side(camera, observer, size_detectors))
    offset = max(abs(np.ravel([centre_offset(observer, turn, size_detectors) for turn in ORIENTATIONS])))
    seen = math.ceil((field / 2.0 + 0.5 + offset) * shown_mrad / pitch_mrad) + 1
    step = max(2 ** (seen.bit_length() - 3), 1)  # so that fields that differ by a detector have one readout
    half_width = math.ceil(seen / step) * step
    readout = linear_readout(camera, observer, size_detectors, half_width)
    symmetric = readout.is_symmetric and is_alike_when_turned(camera)
    lattices = [n for n in PLACES if math.gcd(n, camera.pixels_per_detector) == 1]
    return CurvePlan(
        observer=observer,
        field=field,
        sampler=sampler.cropped(field),
        dtype=np.float32,
        orientations=ORIENTATIONS[:1] if symmetric else ORIENTATIONS,
        level=level,
        lines=camera.lines,
        places=tuple(lattices[:COARSE_LATTICES]),
        repetition_bound=COARSE_BOUND,
        least_jitter=SMALL_JITTER,
        half_width=half_width,
    )


def field_side(camera: Camera, observer: Observer, size_detectors: float) -> int:
    """Return the detectors along each side that a retina of one level more may see; others weigh nothing."""
    whole, shown_mrad = field_detectors(camera, size_detectors), camera.shown_pitch_mrad
    grid = observer.grid(Stimulus(size_detectors * shown_mrad))
    blur_px = len(gaussian_kernel(math.hypot(*camera.blurs_px)))
    offsets = [centre_offset(observer, orientation, size_detectors) for orientation in ORIENTATIONS]
    seen = 2.0 * grid.side * grid.pitch_mrad / shown_mrad + blur_px / camera.pixels_per_detector
    seen += 2.0 * float(np.abs(offsets).max()) + 3.0  # the place on a detector, and a part of one at each border
    return whole - 2 * max(math.floor((whole - seen) / 2.0), 0)


def is_alike_when_turned(camera: Camera) -> bool:
    """Return whether optics, motion and noise of a sensor are the same along rows and columns."""
    variance = camera.lines if camera.photons is None else contrast_variance(camera)
    return variance.row == variance.column and looks_the_same_when_turned(camera)


def linear_readout(
    camera: Camera, observer: Observer, size_detectors: float, half_width: int | None = None
) -> Readout:
    """Return the readout for a triangle as displayed, with four deviations or with the first one, of which the
    others are turns; `half_width` is that of `CurvePlan`. SettingsError if the observer is not linear.
    """
    stimulus = Stimulus(size_detectors * camera.shown_pitch_mrad)
    if type(observer) is PyramidObserver:  # which has readouts of a part of its retina
        return observer.readout_within(stimulus, half_width)
    readout = observer.readout(stimulus)
    if readout is None:
        raise not_linear()
    return readout


def not_linear() -> SettingsError:
    """Return the error that an observer without readout causes."""
    return SettingsError("observer: it is not linear; no curve can be computed, simulate frames instead")


def centre_offset(observer: Observer, orientation: Orientation, size_detectors: float) -> FloatArray:
    """Return the vector from the triangle's centroid to the point the retina is centred on, in detectors."""
    offset = bounding_box_offset(orientation) if observer.centre == "bounding_box" else (0.0, 0.0)
    return np.array(offset) * size_detectors


def noise_covariance(weights: FloatArray) -> FloatArray:
    """Return the covariance, (..., n, n), of sums of white noise of deviation 1 with weights (..., n, m)."""
    return np.asarray(weights @ weights.swapaxes(-1, -2))


def line_covariance(weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariances from noise of deviation 1 that rows, and columns, have in common, as above."""
    side = math.isqrt(weights.shape[-1])
    square = weights.reshape(*weights.shape[:-1], side, side)
    return noise_covariance(square.sum(axis=-1)), noise_covariance(square.sum(axis=-2))


def detector_covariance(weights: FloatArray, lines: LineShares) -> FloatArray:
    """Return the covariance, as above, from detector noise of deviation 1 of which lines share some."""
    own = noise_covariance(weights)
    if lines == NO_LINES:
        return own
    rows, columns = line_covariance(weights)
    return np.asarray((1.0 - lines.row - lines.column) * own + lines.row * rows + lines.column * columns)


def signal_covariance(weights: FloatArray, samples: FloatArray) -> FloatArray:
    """Return the covariances, (places, displacements, 2, 4, 4), from noise whose variance is the signal, and its
    square, in each detector: of weights (places, 4, n) and samples (places, displacements, n).
    """
    times_signal = weights[:, None] * samples[:, :, None]
    # A detector far from the triangle may have a signal slightly below zero.
    by_signal = times_signal @ weights[:, None].swapaxes(-1, -2)
    return np.stack([by_signal, noise_covariance(times_signal)], axis=2)


class _CurvePlanner:
    """Planner that bounds the change from leaving out each part, on the whole chain at a few places."""

    def __init__(
        self, camera: Camera, size_detectors: float, full: CurvePlan, p_correct: float, tolerance: float
    ) -> None:
        self.camera, self.observer, self.size = camera, full.observer, size_detectors
        self.full = full
        self.variance = None if camera.photons is None else contrast_variance(camera)
        self.readout = linear_readout(camera, self.observer, size_detectors)
        self.weights = self._weights(self.readout)
        self.samples = self._samples(self.full.sampler)
        self.covariance = np.zeros((4, 4))
        self._find_covariance(p_correct)
        self.tolerance = tolerance
        self.budget = LEFT_OUT_SHARE * tolerance * self.slope

    def _affordable(self, bound: float) -> bool:
        """Return whether an omission fits into the budget, and subtract it from the budget if it does."""
        if bound > LARGEST_SHARE * self.budget:
            return False
        self.budget -= bound
        return True

    def _weights(self, readout: Readout) -> FloatArray:
        """Return the weights at the places that are tried, (places, 4, field²)."""
        folding = self.full.folding(self.camera, readout, self.size)
        x, y = np.add(TRIED_AT, centre_offset(self.observer, Orientation.UP, self.size)).T
        weights: FloatArray = PARTS.get(
            ("tried", folding.key, x.tobytes(), y.tobytes()), lambda: folding.weights(x, y)
        )
        return self.full.all_four(weights) * self.camera.gain

    def _samples(self, sampler: TriangleSampler) -> FloatArray:
        """Return the samples at the places that are tried, (places, field²)."""
        x, y = np.transpose(TRIED_AT)
        samples = replace(self.full, sampler=sampler).samples(x, y, Orientation.UP)
        return samples.reshape(len(TRIED_AT), -1)

    def _scores(self, weights: FloatArray, samples: FloatArray) -> FloatArray:
        return np.asarray((weights @ samples[..., None])[..., 0])

    def _noise(self, weights: FloatArray, level: float | None = None) -> FloatArray:
        """Return the covariance of the detectors' noise over the squared contrast; by default, near threshold. A
        triangle's own photons are left out.
        """
        level = self.near_level if level is None else level
        if self.variance is None:
            return self.full.noise(weights) / level**2
        rows, columns = line_covariance(weights)
        variance = self.variance
        covariance = variance.white * noise_covariance(weights) + variance.row * rows + variance.column * columns
        return covariance / level**2

    def _find_covariance(self, p_correct: float) -> None:
        """Find the covariance of the scores near threshold, the level there and the slope of P(correct)."""
        signal, noise = self._scores(self.weights, self.samples), self._noise(self.weights, 1.0)
        internal, variance = self.readout.noise_covariance, self.variance
        is_contrast = self.full.level == "contrast"
        if variance is not None:
            by_signal = signal_covariance(self.weights, self.samples[:, None])[:, 0]

        def covariance(level: float) -> FloatArray:
            if variance is None:
                return internal / level**2 if is_contrast else internal + noise / level**2
            of_triangle = variance.per_signal / level * by_signal[:, 0]
            return (internal + noise) / level**2 + of_triangle + variance.per_squared_signal * by_signal[:, 1]

        def proportion(level: float) -> float:
            return float(answer_probability(signal, covariance(level), 0, tolerance=ORTHANT_TOLERANCE).mean())

        _, threshold = crossing(proportion, p_correct, near=None, slope=math.nan)
        self.is_reached = threshold is not None
        strongest = 1.0 if is_contrast else math.inf
        self.near_level = strongest if threshold is None else threshold
        self.covariance = covariance(self.near_level)
        step = 0.05
        rise = 0.0
        if threshold is not None:
            rise = proportion(threshold * math.exp(step)) - proportion(threshold * math.exp(-step))
        self.slope = rise / (2.0 * step) if rise > 0.0 else 0.5

    def bound(self, scores: FloatArray, noise: FloatArray | None = None) -> float:
        """Return a bound on the change of P(correct) from changes of the scores and of their noise covariance."""
        change = np.zeros((1, 4, 4)) if noise is None else noise
        return SAFETY * float(decision_change(scores, self.covariance, change)[..., 0].max())

    def plan(self) -> CurvePlan:
        """Return the plan, with a decision on every part in turn."""
        beyond_table = self._beyond_table()
        plan, levels = self._levels(self.full)
        plan, field_step = self._field(plan)
        plan, period = self._period(plan)
        steps = (*levels, *self._optics(plan), *beyond_table, field_step, *period)
        if self.tolerance >= SINGLE_TOLERANCE:
            plan = replace(plan, dtype=np.float32)
        if self.readout.is_symmetric and is_alike_when_turned(self.camera):
            plan = replace(plan, orientations=ORIENTATIONS[:1])
            steps += (Step("orientations", False, "one stands for all four, which are its turns"),)
        near = (self.near_level, self.slope) if self.is_reached else (None, math.nan)
        return replace(plan, steps=steps, near_level=near[0], slope=near[1])

    def _levels_bound(self) -> float | None:
        """Bound on the change of P(correct) from further levels; None if the observer leaves none out."""
        stimulus = Stimulus(self.size * self.camera.shown_pitch_mrad)
        omitted = self.observer.omitted_bands(stimulus)
        if omitted is None:
            return None
        added = self._weights(replace(self.readout, grid=omitted.grid, deviations=omitted.deviations))
        noise = (self._noise(self.weights + added, 1.0) - self._noise(self.weights, 1.0)) / self.near_level**2
        internal = omitted.noise_covariance
        if self.full.level == "contrast" or self.variance is not None:  # as in the covariance
            internal = internal / self.near_level**2
        return self.bound(self._scores(added, self.samples), noise + internal)

    def _levels(self, plan: CurvePlan) -> tuple[CurvePlan, Sequence[Step]]:
        bound, stage, side = self._levels_bound(), self.observer.omitted_part, self.readout.grid.side
        if bound is None:
            return plan, ()
        if self._affordable(bound):
            why = f"a retina of {side} × {side} samples is wide enough for this tolerance"
            return plan, [Step(stage, False, why, bound)]
        wider = self.observer.with_extra_level()
        if wider.grid(Stimulus(self.size * self.camera.shown_pitch_mrad)) == self.readout.grid:
            return plan, [Step(stage, False, f"{side} × {side} samples are the most that a retina has", bound)]
        why = f"one level more than for {side} × {side} samples, which would change P by up to {bound:.1g}"
        return replace(plan, observer=wider), [Step(stage, True, why)]

    def _optics(self, plan: CurvePlan) -> Sequence[Step]:
        if not plan.sampler.sharp:
            return ()
        change = np.abs(_less_first(self._seen(plan)[0])).sum(axis=-1) * plan.sampler.neglected_bound
        why = "too sharp against the detectors for their frequencies to be counted"
        return [Step("optics", False, why, self.bound(change) / SAFETY)]

    def _beyond_table(self) -> Sequence[Step]:
        """Bound what may lie beyond the end of a measured MTF: it is continued there, and falls as 1/frequency."""
        optics = self.camera.optics
        if not isinstance(optics, MeasuredMtf) or optics.end_mtf < LEAST_END_MTF:
            return ()
        continued = replace(self.camera, optics=optics.continued())
        sampler = TriangleSampler(continued, self.size, self.full.field, self.full.sampler.period)
        bound = self.bound(self._scores(self.weights, self._samples(sampler) - self.samples))
        why = f"the table ends at an MTF of {optics.end_mtf:.2g}"
        return [Step("MTF beyond its table", False, why, bound)]

    def _field(self, plan: CurvePlan) -> tuple[CurvePlan, Step]:
        full, stage = plan.field, "field"
        blur = blur_mrad(self.camera) / self.camera.pitch_mrad
        for sizes in FIELDS_IN_SIZES:
            side = max(math.ceil(sizes * self.size + 6.0 * blur) + 2, smallest_field(self.size))
            side += (full - side) % 2  # so that it lies in the middle of the full one
            if side >= full:
                break
            outside = np.ones((full, full), dtype=bool)
            margin = (full - side) // 2
            outside[margin:-margin, margin:-margin] = False
            weights = self.weights * outside.ravel()
            noise = self._noise(weights)
            # The signal outside may have, at each detector, the sign of the weight that it meets.
            largest = self._scores(np.abs(_less_first(weights)), np.abs(self.samples))
            bound = self.bound(largest, noise)
            if self._affordable(bound):
                why = f"{side} × {side} of {full} × {full} detectors; the others' weights are next to nothing"
                plan = replace(plan, field=side, sampler=plan.sampler.cropped(side))
                return plan, Step(stage, False, why, bound)
        return plan, Step(stage, True, f"{full} × {full} detectors")

    def _seen(self, plan: CurvePlan) -> tuple[FloatArray, FloatArray]:
        """Return the weights and samples at the places that were tried, on the detectors of a plan."""
        full, margin = self.full.field, (self.full.field - plan.field) // 2
        middle = slice(margin, full - margin)

        def cut(images: FloatArray) -> FloatArray:
            square = images.reshape(*images.shape[:-1], full, full)[..., middle, middle]
            return square.reshape(*images.shape[:-1], -1)

        return cut(self.weights), cut(self.samples)

    def _period(self, plan: CurvePlan) -> tuple[CurvePlan, Sequence[Step]]:
        if plan.sampler.sharp:  # nothing is repeated
            return plan, ()
        period = plan.sampler.period
        sampler, change = self._shorter_period(plan)
        plan = replace(plan, repetition_bound=_beyond(change, sampler.period, period))
        if sampler.period >= 2 * plan.field and self._affordable(change):
            why = f"the scene repeats after {sampler.period} detectors, not {period}"
            return replace(plan, sampler=sampler), [Step("period", False, why, change)]
        why = f"the scene repeats after {period} detectors, which changes P by up to {plan.repetition_bound:.1g}"
        return plan, [Step("period", True, why)]

    def repetition_bound(self, plan: CurvePlan) -> float:
        """Return a bound on the change of P(correct) because the scene repeats after the plan's period."""
        if plan.sampler.sharp:
            return 0.0
        sampler, change = self._shorter_period(plan)
        return _beyond(change, sampler.period, plan.sampler.period)

    def _shorter_period(self, plan: CurvePlan) -> tuple[TriangleSampler, float]:
        """Return a sampler of a shorter period, and a bound on its change of P(correct)."""
        period = plan.sampler.period
        wave = 1.0 / (band_limit_cyc_per_mrad(self.camera.optics) * self.camera.pitch_mrad)
        shorter = 2 * plan.field if wave < 2 * plan.field < period else period // 2
        sampler = shared_sampler(self.camera, self.size, plan.field, shorter)
        weights, before = self._seen(plan)
        return sampler, self.bound(self._scores(weights, self._samples(sampler) - before))


def _less_first(weights: FloatArray) -> FloatArray:
    """Return the weights, (..., 4, n), of the score differences that decide on the first answer. Absolute values
    of the four would cancel in the differences of the scores.
    """
    return weights - weights[..., :1, :]


def _beyond(change: float, shorter: int, period: int) -> float:
    """Return a bound on the change between a period and an endless one, from that between a shorter and this one.
    The tails of the repetitions fall with the cube of the period, as those of the Airy pattern do (Watson 1944,
    section 13.75), and what they do to the scores at least as fast.
    """
    share = (shorter / period) ** 3
    return change * share / (1.0 - share)
