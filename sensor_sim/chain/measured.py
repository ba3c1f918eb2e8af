"""Measured transfer of optics: a table of the MTF, or the image of a point, as values that settings can hold."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import path_inside

LARGEST_SHIFT_SAMPLES = 1.0
"""Distance of a PSF's centroid from the middle of its image, along each axis, that is corrected silently."""

LARGEST_SUM_ERROR = 0.01
"""Distance of a PSF's sum from 1, and largest share of it in the outermost samples, which would be cut off."""

LEAST_OTF = 1e-6
"""OTF below which a PSF passes nothing."""

MAX_PSF_SIDE = 2048

LARGEST_FREQUENCY = 1e9
"""Largest end of a table in its unit; beyond it, and below 1/LARGEST_FREQUENCY, it is taken for a mistake."""

BEYOND_ENDS = 2.0
"""Frequency up to which an MTF is continued to bound what its table leaves out, in units of the table's end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredMtf:
    """The MTF of a table: 1 at frequency 0, monotone cubic between its frequencies, 0 beyond its end. `frequency`
    ascends from 0 in the `unit`. `tangential` is the MTF along x and `sagittal` that along y, the same if the
    table is radial. `file` is its name as a SENSOR.toml has it, and `scale` how many units a cycle/mrad is.
    """

    file: str
    unit: Literal["cyc_per_pixel", "cyc_per_mrad", "cyc_per_mm"]
    frequency: tuple[float, ...]
    tangential: tuple[float, ...]
    sagittal: tuple[float, ...]
    scale: float = 1.0

    @property
    def cut_off_cyc_per_mrad(self) -> float:
        """Frequency at which the table ends."""
        return self.frequency[-1] / self.scale

    @property
    def is_radial(self) -> bool:
        """Whether it is the same in all directions."""
        return self.tangential == self.sagittal

    @property
    def end_mtf(self) -> float:
        """Largest MTF at the end of the table."""
        return max(self.tangential[-1], self.sagittal[-1])

    def at(self, frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
        """Return the MTF at frequencies in cycles/mrad, weighted between the axes by cos² of the angle."""
        from scipy.interpolate import PchipInterpolator

        frequency_x, frequency_y = frequency_x * self.scale, frequency_y * self.scale
        radial = np.hypot(frequency_x, frequency_y)
        # The MTF is even: with its mirror image, the slope at frequency 0 is 0.
        mirrored = np.concatenate([-np.array(self.frequency[:0:-1]), self.frequency])

        def along(values: tuple[float, ...]) -> FloatArray:
            curve = PchipInterpolator(mirrored, np.concatenate([values[:0:-1], values]))
            return np.where(radial <= self.frequency[-1], curve(np.minimum(radial, self.frequency[-1])), 0.0)

        if self.is_radial:
            return along(self.tangential)
        share = np.square(np.asarray(frequency_x) / np.where(radial > 0.0, radial, 1.0))
        return np.asarray(share * along(self.tangential) + (1.0 - share) * along(self.sagittal))

    def continued(self) -> MeasuredMtf:
        """Return the MTF continued beyond the end of its table, where it falls as 1/frequency."""
        end = self.frequency[-1]
        factors = np.linspace(1.0, BEYOND_ENDS, 9)[1:]
        frequency, tangential, sagittal = (
            (*values, *more)
            for values, more in (
                (self.frequency, (end * factors).tolist()),
                (self.tangential, (self.tangential[-1] / factors).tolist()),
                (self.sagittal, (self.sagittal[-1] / factors).tolist()),
            )
        )
        return replace(self, frequency=frequency, tangential=tangential, sagittal=sagittal)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPsf:
    """The image of a point: samples of the point spread function, whose rows run down and columns to the right.
    `data` are the samples as 64-bit floats, row by row; their sum is 1. `file` is its name as a SENSOR.toml has
    it, and `scale` the pitch of the samples in mrad.
    """

    file: str
    shape: tuple[int, int]
    data: bytes
    scale: float = 1.0

    @property
    def cut_off_cyc_per_mrad(self) -> float:
        """Frequency beyond which the point's image has nothing."""
        return self.band_limit_cyc_per_sample / self.scale

    @property
    def samples(self) -> FloatArray:
        """The samples, (rows, columns)."""
        return np.frombuffer(self.data, dtype=np.float64).reshape(self.shape)

    @property
    def centroid(self) -> tuple[float, float]:
        """Column and row of the centroid, in samples from the middle of the image."""
        samples = self.samples
        rows, columns = (np.arange(n) - (n - 1) / 2.0 for n in self.shape)
        return float(samples.sum(axis=0) @ columns), float(samples.sum(axis=1) @ rows)

    @property
    def band_limit_cyc_per_sample(self) -> float:
        """Frequency beyond which the point's image has nothing; at most that of the corner, √½."""
        otf = np.abs(np.fft.fft2(self.samples))
        radial = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n) for n in self.shape), indexing="ij"))
        step = 1.0 / min(self.shape)
        return float(min(radial[otf > LEAST_OTF].max() + step, math.sqrt(0.5)))

    @property
    def end_otf(self) -> float:
        """Largest modulus of the OTF at half a cycle per sample along an axis, where its samples end."""
        signs = ((-1.0) ** np.arange(n) for n in self.shape)
        ends = (
            sign @ along
            for sign, along in zip(signs, (self.samples.sum(axis=1), self.samples.sum(axis=0)), strict=True)
        )
        return float(max(abs(end) for end in ends))

    def at(self, frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
        """Return the OTF, complex, at frequencies in cycles/mrad that broadcast against each other. Each of x and
        y has few different values, whose lattice is computed. Beyond ½ cycle per sample along an axis there is
        nothing.
        """
        frequency_x, frequency_y = frequency_x * self.scale, frequency_y * self.scale
        x_at, y_at = self.centroid
        rows, columns = (np.arange(n) - (n - 1) / 2.0 for n in self.shape)
        unique_x, place_x = np.unique(frequency_x, return_inverse=True)
        unique_y, place_y = np.unique(frequency_y, return_inverse=True)
        waves_x = np.exp(-2j * np.pi * np.outer(columns - x_at, unique_x))
        waves_y = np.exp(-2j * np.pi * np.outer(unique_y, rows - y_at))
        waves_x[:, np.abs(unique_x) > 0.5] = 0.0
        waves_y[np.abs(unique_y) > 0.5] = 0.0
        lattice = waves_y @ self.samples @ waves_x
        shape_x, shape_y = np.shape(frequency_x), np.shape(frequency_y)
        return np.asarray(lattice[place_y.reshape(shape_y), place_x.reshape(shape_x)])


def read_measured_mtf(file: str, folder: Path) -> MeasuredMtf:
    """Return the MTF in a table beside a SENSOR.toml. SettingsError if the table stops early or its frequencies
    are beyond all cameras; DataError if it lies in another folder or `todframes.camera.mtf_table.read_mtf_table`
    refuses it.
    """
    from todframes.camera.mtf_table import DIRECTIONS, LARGEST_END, RADIAL, read_mtf_table

    table = read_mtf_table(Path(path_inside(os.path.realpath(folder), file, "mtf:")))
    if not 1.0 / LARGEST_FREQUENCY <= table.frequency[-1] <= LARGEST_FREQUENCY:
        raise SettingsError(
            f"mtf: {file} ends at a frequency of {table.frequency[-1]:g}, expected {1.0 / LARGEST_FREQUENCY:g} to "
            f"{LARGEST_FREQUENCY:g}"
        )
    if table.stops_early:
        raise SettingsError(
            f"mtf: {file} ends at {table.frequency[-1]:g} with an MTF of {table.end_mtf:.2g}, expected at most "
            f"{LARGEST_END:g}; what is beyond may change a sample at an edge by {table.end_cost:.2g} of "
            "the triangle's signal: measure further, or add the frequency at which it is 0"
        )
    # An MTF is 1 at frequency 0 by definition; a table may have it within its error.
    curves = {
        name: values / values[0] if table.frequency[0] == 0.0 else values for name, values in table.curves.items()
    }
    tangential, sagittal = (
        tuple(np.clip(curves[name if name in curves else RADIAL], 0.0, 1.0).tolist()) for name in DIRECTIONS
    )
    frequency = tuple(table.frequency.tolist())
    if frequency[0] > 0.0:
        frequency, tangential, sagittal = (0.0, *frequency), (1.0, *tangential), (1.0, *sagittal)
    return MeasuredMtf(file=file, unit=table.unit, frequency=frequency, tangential=tangential, sagittal=sagittal)


def read_measured_psf(file: str, folder: Path) -> MeasuredPsf:
    """Return the image of a point in a file beside a SENSOR.toml, normalised to the sum of 1. SettingsError if it
    has colours or negative values, is not normalised, off centre, cut off or too coarse; DataError or FrameError
    if it lies in another folder or cannot be read.
    """
    from todframes.camera.mtf_table import LARGEST_END
    from todframes.recordings.opening import open_recordings

    recordings = open_recordings(path_inside(os.path.realpath(folder), file, "psf:"))
    frames = list(islice((frame for recording in recordings for frame in recording.frames()), 2))
    if len(frames) != 1:
        raise SettingsError(f"psf: {file} has {'several images' if frames else 'no image'}, expected one")
    values = np.asarray(frames[0].values, dtype=np.float64)
    if values.ndim == 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 2 or not 3 <= max(values.shape) <= MAX_PSF_SIDE:
        raise SettingsError(
            f"psf: {file} has the shape {values.shape}, expected one channel of 3 to {MAX_PSF_SIDE}"
        )
    total = float(values.sum())
    if not np.isfinite(values).all() or values.min() < 0.0:
        raise SettingsError(f"psf: {file} has a value of {values.min():.3g}, expected none below 0")
    if not abs(total - 1.0) <= LARGEST_SUM_ERROR:
        raise SettingsError(f"psf: {file} has the sum {total:.4g}, expected 1: divide all values by it")
    psf = MeasuredPsf(file=file, shape=values.shape, data=(values / total).tobytes())
    x, y = psf.centroid
    if max(abs(x), abs(y)) > LARGEST_SHIFT_SAMPLES:
        raise SettingsError(
            f"psf: {file} has its centroid {x:.1f} samples right of and {y:.1f} below its middle, expected at "
            f"most {LARGEST_SHIFT_SAMPLES:g}: a shift moves the triangle; crop the image around its centroid"
        )
    inner = values[1:-1, 1:-1].sum() / total
    if 1.0 - inner > LARGEST_SUM_ERROR:
        raise SettingsError(
            f"psf: {file} has {100.0 * (1.0 - inner):.2g} % of its light in the outermost samples, expected at "
            f"most {100.0 * LARGEST_SUM_ERROR:g} %: it is cut off"
        )
    if (at_end := psf.end_otf) > LARGEST_END:
        raise SettingsError(
            f"psf: {file} passes {at_end:.2g} at half a cycle per sample, expected at most {LARGEST_END:g}: its "
            "samples are too coarse for the point, and what is beyond may change a sample at an edge by "
            f"{at_end / math.pi:.2g} of the triangle's signal"
        )
    return psf
