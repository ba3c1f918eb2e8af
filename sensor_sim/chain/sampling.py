"""Computation of exact detector samples of triangles and of four bars.

A sample is the scene after the optics, averaged over the detector's active area; a uniform scene of 1 gives 1.
A diffraction-limited transfer function ends at its cut-off, so the samples are a finite sum: closed-form
spectrum × pre-sample MTF at the multiples of 1/period, folded onto the detector grid. Nothing is oversampled
and nothing is cut, and a new place of the triangle is one phase factor per frequency.

That sum is the scene repeated with the period. The far tails of the neighbours are an error for a single
pattern, which falls with the cube of the period.
`sensor_sim.thresholds.curve_plan` measures what it does to P(correct), which is part of the error of a threshold.

The samples of one period, times pitch², sum to the triangle's area **at every place** if the detectors are
contiguous (their MTF is 0 at multiples of the sampling frequency) or the cut-off lies below the sampling
frequency. Otherwise detectors miss what falls in between, and it holds for the mean over all places.

Lengths are in detector pitches, frequencies in cycles per detector, unless a name says otherwise.

Hogervorst et al. 2001, sections 3.1, 3.2 and 3.6.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Hashable
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.camera import Camera, CameraOptics, ModelledOptics
from sensor_sim.chain.measured import MeasuredMtf
from sensor_sim.chain.transfer import (
    band_limit_cyc_per_mrad,
    blur_mrad,
    looks_the_same_when_turned,
    pre_sample_mtf,
    sharpness_bound,
)
from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive
from todframes.four_bars import FourBars
from todframes.stimulus import HEIGHT_PER_SIZE, SIDE_PER_SIZE, Orientation, spectrum

MAX_FREQUENCIES = 2**22
"""Largest number of frequencies in one half plane, 64 MiB; beyond it the optics are sharp enough to leave out."""

MAX_NEGLECTED = 0.05
"""Largest change of a sample that leaving out the optics may cause; beyond it the field is refused."""

FREQUENCIES_AT_ONCE = 2**16
"""Number of frequencies whose spectrum is computed at once; it keeps the arrays to some megabytes."""

SAMPLED_AT_ONCE = 16
"""Number of places computed at once; partly folded spectra stay in the cache, and BLAS starts no threads."""

FIELD_SIZES, FIELD_MARGIN_DETECTORS, MAX_FIELD_DETECTORS = 4.0, 4, 1024
"""Side of a trial's field in sizes of the triangle, detectors added to it, and largest side in detectors."""


class PatternSampler(ABC):
    """Detector samples of one pattern, at any place and orientation; a subclass says which.

    The spectrum is computed once, for the upright pattern, which is its own mirror image from left to right. Where
    detectors, optics and motion look the same after a quarter turn, the other orientations are turned samples, bit
    for bit. Otherwise the optics are turned back under the upright pattern, whose samples are then turned.

    If the sum would take more than `MAX_FREQUENCIES` terms, the optics are sharp against the detector: they are
    left out, and the samples are the exact area of the pattern on each detector. `neglected_bound`
    bounds the change of a sample.

    `pattern` is all that tells it from others of its class. The scene repeats after `period_detectors`, at least
    the field of `field_detectors` along each side, and by default the field. SettingsError if it is less, or if
    the optics pass less than one cycle per period or too many.
    """

    def __init__(
        self, camera: Camera, pattern: Hashable, field_detectors: int, period_detectors: int | None = None
    ) -> None:
        period = field_detectors if period_detectors is None else period_detectors
        if period < field_detectors:
            raise SettingsError(f"period_detectors: found {period}, expected at least {field_detectors}")
        self._pattern = pattern
        self._field = self._whole_field = field_detectors
        self.period = period
        self._camera, optics, pitch_mrad = camera, camera.optics, camera.pitch_mrad
        self._width = camera.width_mrad / pitch_mrad
        self._waves: dict[int, tuple[ComplexArray, ComplexArray]] = {}
        last = band_limit_cyc_per_mrad(optics) * pitch_mrad * period
        if last < 1.0:
            raise SettingsError(
                f"{_limiting(optics)}, which passes nothing of a triangle to such detectors: {last:.2g} cycles "
                "across its field, expected at least 1"
            )
        self.sharp, self.neglected_bound = 2.0 * last * last > MAX_FREQUENCIES, 0.0
        if not self.sharp:
            self._prepare_spectrum(last)
            return
        self.neglected_bound = sharpness_bound(camera)
        if self.neglected_bound > MAX_NEGLECTED:
            most = math.sqrt(MAX_FREQUENCIES / 2.0) / period
            raise SettingsError(
                f"{_limiting(optics)}, which passes {last / period:.4g} cycles per detector, expected at most "
                f"{most:.4g} in a field of {field_detectors} detectors; take a smaller triangle"
            )

    @property
    def key(self) -> Hashable:
        """Everything that the samples depend on."""
        return (self._camera.samples_key, self._pattern, self._whole_field, self._field, self.period)

    @abstractmethod
    def _spectrum(self, frequency_x: FloatArray, frequency_y: FloatArray) -> ComplexArray:
        """Compute the Fourier transform of the upright pattern, at frequencies in cycles per detector."""

    @abstractmethod
    def _covered_area(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Compute the mean of each active area over an upright pattern: (places, field, field)."""

    @property
    def nbytes(self) -> int:
        """Size of the spectrum in bytes."""
        return 0 if self.sharp else self._unfolded.nbytes * (1 if self._is_circular else 5)

    def _prepare_spectrum(self, last: float) -> None:
        """Compute the spectrum up to `last` cycles per period: [folded x][replica in y, folded y][replica in x].
        Real samples need folded x frequencies from 0 to half of the period only, and none beyond `last`. The
        upright pattern is its own mirror image, and its spectrum at −f is conjugate to that at f, so a quarter of
        the plane is computed.
        """
        self._is_circular = looks_the_same_when_turned(self._camera)
        self._turned: dict[int, ComplexArray] = {}
        period, half, end = self.period, self.period // 2, math.floor(last) + 1
        quarter = np.zeros((end + 1, end + 1), dtype=np.complex128)  # the last row and column stay empty
        below_last = np.argwhere(np.hypot(np.arange(end)[:, None], np.arange(end)) < last)
        for part in np.array_split(below_last, len(below_last) // FREQUENCIES_AT_ONCE + 1):
            k_y, k_x = part.T
            fx, fy = k_x / period, k_y / period
            pitch, transfer = self._camera.pitch_mrad, np.ones(1)
            if self._is_circular:
                transfer = pre_sample_mtf(fx / pitch, fy / pitch, camera=self._camera).real
            quarter[k_y, k_x] = transfer * self._spectrum(fx, fy)
        n_y = math.floor((last + half) / period)
        passed = np.arange(period) - half
        self._folded_y = np.fft.ifftshift(passed[np.abs(passed) < end])
        self._folded_x = np.arange(min(half, end - 1) + 1)
        self._replicas_x = np.arange(-math.floor((last + half) / period), math.floor(last / period) + 1)
        self._replicas_y = np.arange(-n_y, n_y + 1)
        k_x = self._folded_x[:, None, None] + self._replicas_x * period
        k_y = (self._replicas_y[:, None] * period + self._folded_y).reshape(-1, 1)
        self._unfolded = quarter[np.minimum(np.abs(k_y), end), np.minimum(np.abs(k_x), end)]
        self._unfolded.imag *= np.sign(k_y)
        self._frequencies = k_x / period, k_y / period

    def _seen(self, quarter_turns: int) -> ComplexArray:
        """Return the spectrum of the upright pattern behind optics that are turned back by some quarter turns."""
        unfolded: ComplexArray = self._unfolded
        if self._is_circular:
            return unfolded
        if quarter_turns not in self._turned:
            fx, fy = (frequency / self._camera.pitch_mrad for frequency in self._frequencies)
            for _ in range(quarter_turns):
                fx, fy = -fy, fx
            transfer = pre_sample_mtf(fx, fy, camera=self._camera)
            self._turned[quarter_turns] = np.asarray(unfolded * transfer, dtype=np.complex128)
        return self._turned[quarter_turns]

    def cropped(self, field_detectors: int) -> Self:
        """Return a sampler of a field that is smaller by an even number of detectors, with the same middle and
        samples.
        """
        narrow = copy.copy(self)
        narrow._field = field_detectors
        return narrow

    def samples(self, x_detectors: ArrayLike, y_detectors: ArrayLike, *, orientation: Orientation) -> FloatArray:
        """Compute the samples, (places, field, field), of patterns with their centroids at these places, in
        detectors from the middle of the field; x to the right, y down.
        """
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x_detectors, float)), np.asarray(y_detectors, float))
        for _ in range(orientation.quarter_turns):  # the turns that make the pattern upright
            x, y = y, -x
        upright = np.empty((x.size, self._field, self._field))
        samples_of = self._covered_area
        if not self.sharp:
            samples_of = partial(self._band_limited, self._seen(orientation.quarter_turns))
        for start in range(0, x.size, SAMPLED_AT_ONCE):
            part = slice(start, start + SAMPLED_AT_ONCE)
            upright[part] = samples_of(x[part], y[part])
        return np.rot90(upright, -orientation.quarter_turns, axes=(1, 2))

    def _band_limited(self, seen: ComplexArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Sum the waves of upright patterns at these places: (places, field, field). Places are counted from the
        field's first detector, so that all replicas of a frequency are alike there. The field is a part of the
        period: products of matrices take less time than a fast Fourier transform.
        """
        turn, first = -2j * np.pi / self.period, -(self._field - 1) / 2.0
        x, y = x - first, y - first
        of_replicas_x = np.exp(-2j * np.pi * np.outer(self._replicas_x, x))
        of_replicas_y = np.exp(-2j * np.pi * np.outer(self._replicas_y, y))[:, None]
        waves_x = np.exp(turn * np.outer(self._folded_x, x))[:, None] * of_replicas_x
        waves_y = of_replicas_y * np.exp(turn * np.outer(self._folded_y, y))
        unfolded = (seen @ waves_x).reshape(-1, *waves_y.shape)
        unfolded *= waves_y
        folded = unfolded.sum(axis=1)
        on_rows, on_columns = self._on_places(self._field)
        samples = on_columns @ (on_rows @ folded).transpose(1, 0, 2)
        return np.asarray(samples.real.transpose(2, 0, 1))

    def _on_places(self, field: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the folded waves at the places of detectors, along y and, weighted, along x."""
        if field not in self._waves:
            turn, place = 2j * np.pi / self.period, np.arange(field)[:, None]
            # Each wave along x but those of its own conjugate stands for two.
            weight = np.where(2 * self._folded_x % self.period == 0, 1.0, 2.0) / self.period**2
            on_rows, on_columns = (np.exp(turn * place * folded) for folded in (self._folded_y, self._folded_x))
            self._waves[field] = on_rows, weight * on_columns
        return self._waves[field]


class TriangleSampler(PatternSampler):
    """Detector samples of triangles of one size, √(area), at any place and orientation. SettingsError if the size
    is not a positive number, or the triangle, displaced by half a detector, reaches beyond the field.
    """

    def __init__(
        self, camera: Camera, size_detectors: float, field_detectors: int, period_detectors: int | None = None
    ) -> None:
        check_positive(argument.size_detectors, size_detectors)
        smallest = smallest_field(size_detectors)
        if field_detectors < smallest:
            needed = f"at least {smallest} for a triangle of size {size_detectors:g} detectors"
            raise SettingsError(f"field_detectors: found {field_detectors}, expected {needed}")
        self._size = size_detectors
        super().__init__(camera, size_detectors, field_detectors, period_detectors)

    def _spectrum(self, frequency_x: FloatArray, frequency_y: FloatArray) -> ComplexArray:
        return spectrum(frequency_x, frequency_y, size=self._size, orientation=Orientation.UP)

    def _covered_area(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Compute the share of each active area that an upright triangle covers, exactly: (places, field, field).
        Each half of the triangle is slope·t wide at the depth t below the apex. The area beyond a column's edge,
        at u from the axis, is ∫ (slope·t − u)⁺ dt over the row, a difference of squares.
        """
        height, slope = HEIGHT_PER_SIZE * self._size, SIDE_PER_SIZE / HEIGHT_PER_SIZE / 2.0
        place = np.arange(self._field) - (self._field - 1) / 2.0
        edges = place + np.array([[-0.5], [0.5]]) * self._width
        from_apex = edges[:, None, :] - (y[:, None] - 2.0 / 3.0 * height)
        top, bottom = slope * np.clip(from_apex, 0.0, height)[..., None]
        left, right = edges[:, None, None, :] - x[:, None, None]

        def beyond(edge: FloatArray) -> FloatArray:
            u = np.maximum(edge, 0.0)
            squares = np.square(np.maximum(bottom - u, 0.0)) - np.square(np.maximum(top - u, 0.0))
            return np.asarray(squares / (2.0 * slope))

        covered = beyond(left) - beyond(right) + beyond(-right) - beyond(-left)
        return np.asarray(covered / self._width**2)


class FourBarSampler(PatternSampler):
    """Detector samples of four bars, whose widths are in detectors, upright in the orientations UP and DOWN."""

    def __init__(
        self, camera: Camera, bars: FourBars, field_detectors: int, period_detectors: int | None = None
    ) -> None:
        self._bars = bars
        super().__init__(camera, bars, field_detectors, period_detectors)

    def _spectrum(self, frequency_x: FloatArray, frequency_y: FloatArray) -> ComplexArray:
        return self._bars.spectrum(frequency_x, frequency_y)

    def _covered_area(self, x: FloatArray, y: FloatArray) -> FloatArray:
        place = np.arange(self._field) - (self._field - 1) / 2.0
        along_x, _ = self._bars.profiles(place - x[:, None], self._width)
        _, along_y = self._bars.profiles(place - y[:, None], self._width)
        return np.asarray(along_y[:, :, None] * along_x[:, None, :])


def field_detectors(camera: Camera, size_detectors: float, sizes: float = FIELD_SIZES) -> int:
    """Return the number of detectors along each side of a pattern's field: four sizes and a margin, or `sizes`.
    The observer looks at about four sizes of a triangle. SettingsError if the size is not a positive number, or
    the field is too large to compute.
    """
    check_positive(argument.size_detectors, size_detectors)
    blur = 3.0 * blur_mrad(camera) / camera.pitch_mrad
    field = sizes * size_detectors + 2.0 * blur + FIELD_MARGIN_DETECTORS
    if field > MAX_FIELD_DETECTORS:
        room = MAX_FIELD_DETECTORS - FIELD_MARGIN_DETECTORS
        if (of_blur := room - sizes * size_detectors) <= 0.0:
            found = f"found {size_detectors:g}, expected at most {room / sizes:g}"
            raise SettingsError(f"{argument.size_detectors}: {found}")
        raise SettingsError(
            f"sensor: optics, motion and air blur by {blur_mrad(camera):.4g} mrad, expected at most "
            f"{of_blur / 6.0 * camera.pitch_mrad:.4g} with detectors {camera.pitch_mrad:g} mrad apart and a "
            f"triangle of {size_detectors:g} detectors"
        )
    return math.ceil(field)


def _limiting(optics: CameraOptics) -> str:
    """Return the key of what ends the transfer of optics, and its value, for a message."""
    if isinstance(optics, ModelledOptics):
        is_blur = band_limit_cyc_per_mrad(optics) < optics.cut_off_cyc_per_mrad
        name = "blur_sigma_mrad" if is_blur else "aperture_mm"
        return f"optics.{name}: found {getattr(optics, name):g}"
    return f"optics.{'mtf' if isinstance(optics, MeasuredMtf) else 'psf'}: found {optics.file}"


def smallest_field(size_detectors: float) -> int:
    """Return the detectors along a side of the smallest field for a triangle half a detector off its middle."""
    return math.ceil(4.0 / 3.0 * HEIGHT_PER_SIZE * size_detectors + 1.0)


def field_sampler(camera: Camera, size_detectors: float, field: int | None = None) -> TriangleSampler:
    """Return a sampler of a field, by default of the size `field_detectors`; the scene repeats after two fields,
    almost unseen.
    """
    field = field_detectors(camera, size_detectors) if field is None else field
    return TriangleSampler(camera, size_detectors, field, 2 * field)


def sample_image(
    image: FloatArray,
    *,
    pixel_pitch_mrad: float,
    camera: Camera,
    field_detectors: int,
    x_detectors: float = 0.0,
    y_detectors: float = 0.0,
) -> FloatArray:
    """Compute the detector samples, (field, field), of any scene, by FFT. The scene is constant over each pixel
    and repeats with the image's sides. Its spectrum, the pixels' sinc included, is summed up to the optics'
    cut-off: exact for such a scene, at any ratio of the pitches. (x, y) is the place of the image's middle, in
    detectors from the middle of the field. SettingsError if the image is smaller than the field, or the optics
    pass too many frequencies.
    """
    check_positive("pixel_pitch_mrad", pixel_pitch_mrad)
    pixel = pixel_pitch_mrad / camera.pitch_mrad
    sides = [n * pixel for n in image.shape]
    if min(sides) < field_detectors * (1.0 - 1e-12):
        largest = f"at most the image's smaller side, {min(sides):g} detectors"
        raise SettingsError(f"field_detectors: found {field_detectors}, expected {largest}")
    highest = band_limit_cyc_per_mrad(camera.optics) * camera.pitch_mrad
    place = np.arange(field_detectors) - (field_detectors - 1) / 2.0
    from_corner = [
        (place - at + side / 2.0) / pixel for at, side in zip((y_detectors, x_detectors), sides, strict=True)
    ]
    n_frequencies = 2.0 * highest**2 * sides[0] * sides[1]
    if n_frequencies > MAX_FREQUENCIES:
        raise SettingsError(
            f"image: the optics pass {n_frequencies:.2g} spatial frequencies of it, expected at most "
            f"{MAX_FREQUENCIES:.2g}; take a smaller image"
        )
    n_y, n_x = image.shape
    k_y = np.arange(-math.floor(highest * sides[0]), math.floor(highest * sides[0]) + 1)
    k_x = np.arange(math.floor(highest * sides[1]) + 1)
    transfer = pre_sample_mtf(
        k_x / (n_x * pixel_pitch_mrad), k_y[:, None] / (n_y * pixel_pitch_mrad), camera=camera
    )
    shape_of_pixel = np.sinc(k_x / n_x) * np.sinc(k_y / n_y)[:, None] * np.where(k_x == 0, 1.0, 2.0)
    transfer = transfer * shape_of_pixel
    scene = np.fft.fft2(image)[np.ix_(k_y % n_y, k_x % n_x)] / image.size
    waves_y = np.exp(2j * np.pi / n_y * np.outer(from_corner[0] - 0.5, k_y))
    waves_x = np.exp(2j * np.pi / n_x * np.outer(from_corner[1] - 0.5, k_x))
    return np.asarray((waves_y @ (scene * transfer) @ waves_x.T).real)
