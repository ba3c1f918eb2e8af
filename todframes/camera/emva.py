"""Noise of a camera as EMVA 1288 defines it: from pairs of bright and dark stacks at several exposures.

The camera is linear: a pixel counts electrons, quantum efficiency times photons and dark current, and a digital
value (DN) is the system gain K times their number. Photons arrive at random, so the variance of values over time
rises with the signal at the slope K, which needs no known light: the photon transfer method. The equations are
those of EMVA Standard 1288, release 4.0 linear. Intervals come from generalised pivotal quantities of the mean
squares of each stack (Weerahandi 1993; Hannig, Iyer & Patterson 2006), which hold for sums, differences, ratios.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple, TypeVar

import numpy as np
from msgspec import Struct, structs

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, argument
from todframes.camera.emva_xml import LEAVES, noise_table
from todframes.camera.mtf_table import Ends
from todframes.camera.noise3d import (
    DRIFT_ERRORS,
    MOST_SATURATED,
    STATIC,
    FrameSums,
    added,
    combinations,
    estimate,
    fit_drift,
    steady_part,
    straight_line,
    sum_frames,
)
from todframes.parameters import Box, Progress
from todframes.recordings.recording import Recording, RecordingWarning, with_bits

LEAST_DARK_VARIANCE = 0.24
"""Temporal dark variance in steps² below which rounding decides it. EMVA 1288 release 4.0 linear."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance of rounding in steps². A step is 1 DN, or more if the values have gaps: 12 bits in files of 16."""

LINEAR = (0.05, 0.95)
"""Parts of the saturation signal between which the linearity error is measured. EMVA 1288 release 4.0 linear."""

DRAWS = 4000
"""Number of draws of the pivotal quantities; the ends of an interval then vary by 2 % of its half-width."""

SEED = 1288
"""Seed of the draws, so that the same frames always give the same intervals."""

MISFIT_PROBABILITY = 0.01
"""Probability of a scatter about the line of photon transfer by noise alone, below which K's interval widens."""

LINES = {
    "row_noise_electrons": "tv",
    "column_noise_electrons": "th",
    "row_pattern_electrons": "v",
    "column_pattern_electrons": "h",
}
"""Keys of a SENSOR.toml for what rows and columns have in common, and the parts of the noise that they are."""

MIXED_ERRORS = 10.0
"""Least step between frames of two exposures, in standard errors of a frame's mean and in those of flicker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stack:
    """Frames of one exposure and light.

    `exposure_ms` and `photons`, the mean number of a pixel, are None if they are not known. With `is_levelled`, a
    plane is taken from the mean image: light that falls off evenly, as behind a lens, is no nonuniformity.
    """

    recording: Recording
    exposure_ms: float | None = None
    photons: float | None = None
    is_levelled: bool = False


class Variances(Struct, frozen=True, kw_only=True):
    """Mean and variances of a stack in DN and DN².

    Attributes
    ----------
    n_frames : int
    mean : float
    temporal : float
        Variance over time of a pixel, without changes of the whole frame: σ²_y of a pair of frames.
    temporal_stack : float
        The same with changes of the whole frame: σ²_y.stack.
    spatial_measured : float
        Variance of the mean image.
    spatial, row, column, pixel : float
        Spatial variance without what temporal noise leaves in the mean, and its parts. They can be below zero.
    """

    n_frames: int
    mean: float
    temporal: float
    temporal_stack: float
    spatial_measured: float
    spatial: float
    row: float
    column: float
    pixel: float


class StackNoise(Variances, frozen=True, kw_only=True, eq=False):
    """Means and variances of a stack, with what its warnings and intervals need.

    `smooth` is the part of the spatial variance that is a surface of second order across the frame, `change` that
    of the mean from the first frame to the last, 0 if noise and flicker explain it. `saturated` and `crushed` are
    shares of values that are cut off at the largest and the smallest; `step` is the least difference of values, 0
    if there is but one. `squares` and `degrees` are those of the analysis of variance, and `warnings` those of the
    recording and of frames that were left out.
    """

    name: str
    exposure_ms: float | None
    photons: float | None
    smooth: float
    change: float
    saturated: float
    crushed: float
    step: float
    squares: Mapping[str, float]
    degrees: Mapping[str, int]
    shape: tuple[int, int]
    warnings: tuple[RecordingWarning, ...]

    def lines_dn(self) -> dict[str, float]:
        """Return standard deviations of what the pixels of a row or column have in common, by SENSOR.toml's keys.

        They are those of the analysis of variance; those whose 95 % interval begins at 0 are left out.
        """
        weights = combinations(self.n_frames, *self.shape)
        parts = {key: estimate(weights[part], self.squares, self.degrees) for key, part in LINES.items()}
        return {key: part.sd for key, part in parts.items() if part.ci95[0] > 0.0}


class TransferStack(Struct, frozen=True, kw_only=True):
    """A bright stack in the photon transfer: its signal and temporal variance above the dark stack's."""

    exposure_ms: float | None
    photons: float | None
    n_frames: int
    signal_dn: float
    variance_dn2: float
    snr: float | None
    is_fitted: bool
    is_saturated: bool


class TransferPoint(TransferStack, frozen=True, kw_only=True, eq=False):
    """The same with both stacks; `is_fitted` if it counts for gain and responsivity."""

    bright: StackNoise
    dark: StackNoise

    @classmethod
    def of(cls, bright: StackNoise, dark: StackNoise) -> TransferPoint:
        """Return the point of a bright stack and the dark one of its exposure, not yet in the fit."""
        signal = bright.mean - dark.mean
        return cls(
            exposure_ms=bright.exposure_ms,
            photons=bright.photons,
            n_frames=bright.n_frames,
            signal_dn=signal,
            variance_dn2=bright.temporal - dark.temporal,
            snr=signal / math.sqrt(bright.temporal) if bright.temporal > 0 else math.inf,
            is_fitted=False,
            is_saturated=bright.saturated > MOST_SATURATED,
            bright=bright,
            dark=dark,
        )


S = TypeVar("S", StackNoise, TransferPoint)


class EmvaNumbers(Struct, frozen=True, kw_only=True):
    """Noise of a camera as EMVA 1288 defines it, the key `noise.emva1288` of the result.

    Each figure has a 95 % interval beside it, in the key with `_ci95`; None if there is none.

    Attributes
    ----------
    source : str
        Path of the descriptor, or of the first bright stack.
    bits : int or None
        Bits of a pixel.
    exposure_ms : float or None
        That of the spatial measurement.
    system_gain : float
        K in DN per electron.
    quantum_efficiency, responsivity : float or None
        Electrons per photon, and DN per photon; None without photons.
    dark_noise, dark_noise_dn : float
        Temporal noise of a dark frame in electrons, and in DN with rounding: at an exposure of 0, or at the
        shortest one with fewer than three dark exposures.
    dark_current, dark_current_from_variance : float or None
        Electrons per second, from means and from variances; None with fewer than three dark exposures.
    dsnu, prnu : float
        Dark signal nonuniformity in electrons, photo response nonuniformity in percent.
    saturation_electrons, saturation_photons : float or None
        Capacity; without a maximum of the variance that of the end of the scale, None if that is not known.
    sensitivity_threshold : float or None
        Number of photons at which the signal equals the noise.
    background_electrons : float or None
        Electrons of the background of a filmed chart in a pixel; None without one.
    background_cd_m2 : float or None
        Its luminance, if the chart states it.
    lines_electrons : dict of float
        What the pixels of a row or column have in common in the dark, by keys of a SENSOR.toml.
    rounding_variance_dn2 : float
        Variance of rounding in DN².
    snr_max, dynamic_range : float or None
    linearity_percent : (float, float) or None
        Smallest and largest deviation from the straight line.
    is_saturation_reached : bool
        The variance has a maximum within the stacks.
    bright, dark : Variances
        Stacks of the spatial measurement.
    points : tuple of TransferStack
        By increasing signal.
    """

    source: str
    bits: int | None
    exposure_ms: float | None
    system_gain: float
    system_gain_ci95: Ends | None
    quantum_efficiency: float | None = None
    quantum_efficiency_ci95: Ends | None = None
    responsivity: float | None = None
    responsivity_ci95: Ends | None = None
    dark_noise: float
    dark_noise_ci95: Ends | None
    dark_noise_dn: float
    dark_noise_dn_ci95: Ends | None
    dark_current: float | None = None
    dark_current_ci95: Ends | None = None
    dark_current_from_variance: float | None = None
    dark_current_from_variance_ci95: Ends | None = None
    dsnu: float
    dsnu_ci95: Ends | None
    prnu: float
    prnu_ci95: Ends | None
    saturation_electrons: float | None = None
    saturation_electrons_ci95: Ends | None = None
    saturation_photons: float | None = None
    saturation_photons_ci95: Ends | None = None
    sensitivity_threshold: float | None = None
    sensitivity_threshold_ci95: Ends | None = None
    background_electrons: float | None = None
    background_electrons_ci95: Ends | None = None
    background_cd_m2: float | None = None
    lines_electrons: dict[str, float] = {}
    rounding_variance_dn2: float
    snr_max: float | None = None
    dynamic_range: float | None = None
    linearity_percent: tuple[float, float] | None
    is_saturation_reached: bool
    bright: Variances
    dark: Variances
    points: tuple[TransferStack, ...]

    def noise_table(self) -> Json:
        """Return the table `[noise]` of a SENSOR.toml, with noise and pattern without those of the lines."""
        return noise_table(self.xml_values(), self.lines_electrons)

    def xml_values(self) -> dict[str, float | int | None]:
        """Return the results by the names of EMVA's XML, in its units."""
        values: dict[str, float | int | None] = {
            leaf.name: attrgetter(leaf.key)(self) for leaf in LEAVES if leaf.key
        }
        values |= {"inverse_K": 1.0 / self.system_gain, "DSNU1288_DN": self.dsnu * self.system_gain}
        if self.quantum_efficiency is not None:
            values["QE"] = 100.0 * self.quantum_efficiency
        if self.linearity_percent is not None:
            values["LE_min"], values["LE_max"] = self.linearity_percent
        for name, ratio in (("SNR_max", self.snr_max), ("DR", self.dynamic_range)):
            if ratio is not None:
                values |= {f"{name}_dB": 20.0 * math.log10(ratio), f"{name}_bit": math.log2(ratio)}
        return values


def measure_emva(
    bright: Sequence[Stack],
    dark: Sequence[Stack],
    *,
    bits: int | None = None,
    region: Box | None = None,
    source: str = "",
    background: Stack | None = None,
    progress: Progress | None = None,
) -> tuple[EmvaNumbers, tuple[RecordingWarning, ...]]:
    """Measure the noise of a camera from stacks of bright and dark frames, of two frames or more each.

    Each bright stack is compared with the dark one of its exposure, or with the only dark one. The stacks of the
    spatial measurement are those with the most frames, bright near half of saturation. `background` is the bright
    stack that shows the background of a chart. DataError if a stack has one frame, colours, another size or frames
    of two exposures; if no bright stack has a dark one; or if all bright stacks are saturated, or none is brighter
    than dark.
    """
    for what, stacks in (("bright", bright), ("dark", dark)):
        if not stacks:
            raise DataError(f"{source}: found no {what} stack, expected one or more")
    bright, dark = (
        [replace(stack, recording=with_bits(stack.recording, bits)) for stack in stacks]
        for stacks in (bright, dark)
    )
    full_scale = bright[0].recording.full_scale
    of_dark = [_measured(stack, region, None, progress) for stack in dark]
    darkest = min(stack.mean for stack in of_dark)
    of_bright = [_measured(stack, region, darkest, progress) for stack in bright]
    shapes = {stack.shape for stack in (*of_dark, *of_bright)}
    if len(shapes) > 1:
        found = " and ".join(f"{columns} x {rows}" for rows, columns in sorted(shapes))
        raise DataError(f"noise: found stacks of {found} pixels, expected one size")
    camera = _Camera(of_bright, of_dark, full_scale)
    name = None if background is None else str(background.recording.path)
    background_dn = next((point.signal_dn for point in camera.points if point.bright.name == name), None)
    spatial, gain = camera.spatial, float(camera.gain[0])
    numbers = EmvaNumbers(
        source=source,
        bits=bits,
        exposure_ms=spatial.bright.exposure_ms,
        **camera.figures(background_dn),
        lines_electrons={key: sd / gain for key, sd in spatial.dark.lines_dn().items()},
        rounding_variance_dn2=ROUNDING_VARIANCE * camera.step**2,
        linearity_percent=_linearity(camera.series, camera.most),
        is_saturation_reached=camera.saturated is not None,
        bright=spatial.bright,
        dark=spatial.dark,
        points=tuple(camera.points),
    )
    of_recordings = dict.fromkeys(warning for stack in (*of_bright, *of_dark) for warning in stack.warnings)
    return numbers, (*of_recordings, *camera.warnings(has_bits=bits is not None))


def _measured(stack: Stack, region: Box | None, darkest: float | None, progress: Progress | None) -> StackNoise:
    """Return means and variances of a stack. `darkest` is the mean of dark frames, None for a dark stack."""
    recording = stack.recording
    if recording.is_colour:
        raise DataError(f"{recording.path}: has colours, expected the raw values of one channel")
    sums = sum_frames(recording, [region], progress)[0][0]
    if sums.n < 2:
        raise DataError(
            f"{recording.path}: found 1 frame of this exposure, expected 2 or more: one cannot separate temporal "
            "noise from fixed pattern"
        )
    _check_exposure(stack, sums, darkest)
    steady = steady_part(recording, sums)
    if steady.n_frames not in (None, sums.n):
        sums = sum_frames(steady, [region], None)[0][0]
    if stack.is_levelled:
        sums.level()
    squares, degrees = sums.mean_squares()
    t, (v, h) = sums.n, sums.reference.shape
    sums_of = {name: squares[name] * degrees[name] for name in squares}
    temporal, means = _temporal(sums), sums.means()
    # EMVA 1288 release 4.0 linear: variances of the mean image, of its rows and of its columns, each with
    # its share of the other parts and of the temporal noise, are solved for the three parts.
    # Changes of the whole frame leave nothing in the pattern: their variance, in that of the stack, is left out.
    measured, left_over = (sums_of["v"] + sums_of["h"] + sums_of["vh"]) / (t * v * h), temporal / t
    of_rows, of_columns = sums_of["v"] / (t * h * v), sums_of["h"] / (t * v * h)
    row, column, pixel = np.linalg.solve(
        [[1.0, 0.0, 1.0 / h], [0.0, 1.0, 1.0 / v], [1.0, 1.0, 1.0]],
        [of_rows - left_over / h, of_columns - left_over / v, measured - left_over],
    ).tolist()
    cut = sums.ends.cut(math.sqrt(temporal))
    return StackNoise(
        name=str(recording.path),
        n_frames=t,
        exposure_ms=stack.exposure_ms,
        photons=stack.photons,
        mean=float(means.mean()),
        temporal=temporal,
        temporal_stack=temporal + sums_of["t"] / ((t - 1) * v * h),
        spatial_measured=measured,
        spatial=measured - left_over,
        row=row,
        column=column,
        pixel=pixel,
        smooth=_smooth_variance(sums.mean_image()),
        change=_change(means, math.sqrt(temporal / (v * h))),
        saturated=cut.top,
        crushed=cut.bottom,
        step=sums.ends.step,
        squares=squares,
        degrees=degrees,
        shape=(v, h),
        warnings=tuple(
            warning
            if warning in recording.warnings
            else warning._replace(message=f"{recording.path}: {warning.message}")
            for warning in steady.warnings
        ),
    )


def _temporal(sums: FrameSums) -> float:
    """Return the variance over time of a pixel, without changes of the whole frame."""
    squares, degrees = sums.mean_squares()
    total = sum(squares[name] * degrees[name] for name in ("tv", "th", "tvh"))
    return total / ((sums.n - 1) * sums.reference.size)


def _smooth_variance(image: FloatArray) -> float:
    """Return the variance of the surface of second order that is fitted to an image by least squares."""
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in image.shape), indexing="ij")
    terms = np.stack([x, y, x * x, x * y, y * y]).reshape(5, -1)
    terms -= terms.mean(axis=1, keepdims=True)
    product = terms @ (image - image.mean()).ravel()
    return float(product @ np.linalg.lstsq(terms @ terms.T, product)[0]) / image.size


def _change(means: FloatArray, error: float) -> float:
    """Return the change of the means of frames from the first to the last; 0 if noise or flicker explain it.

    `error` is the standard error of a mean by the noise of pixels. Two frames do not tell flicker from drift.
    """
    drift = fit_drift(means, [])
    change, scatter = (means[-1] - means[0], 0.0) if drift is None else (drift.change, drift.change_error)
    return float(change) if abs(change) > max(DRIFT_ERRORS * scatter, MIXED_ERRORS * error) else 0.0


def _check_exposure(stack: Stack, sums: FrameSums, darkest: float | None) -> None:
    """Refuse a stack whose frames have two exposures: sorted by their means, they fall into two groups."""
    means, n_pixels, temporal = sums.means(), sums.reference.size, _temporal(sums)
    order = np.sort(means)
    steps = np.diff(order)
    n_low = int(steps.argmax()) + 1
    groups = order[:n_low], order[n_low:]
    within = max(float(np.std(group)) for group in groups)
    signal = 0.0 if darkest is None else abs(float(np.median(means)) - darkest)
    sd = math.sqrt(temporal)
    # Lamps flicker by less than 2 % of the signal. In faint and dark frames half the noise of a pixel decides.
    least = (0.02 * signal, 0.5 * sd, MIXED_ERRORS * sd / math.sqrt(n_pixels), MIXED_ERRORS * within)
    if steps.max() > max(least):
        low, high = (float(group.mean()) for group in groups)
        raise DataError(
            f"{stack.recording.path}: frames have means about {low:.5g} ({n_low} of them) and {high:.5g} "
            f"({len(order) - n_low}), expected one exposure in a stack; give each one as a stack of its own"
        )


def _dark_of(bright: StackNoise, dark: Sequence[StackNoise]) -> StackNoise:
    """Return the dark stack of a bright one's exposure; of several, the one with the nearest number of frames."""
    alike = [stack for stack in dark if stack.exposure_ms == bright.exposure_ms]
    if not alike and len({stack.exposure_ms for stack in dark}) == 1:
        alike = list(dark)
    if not alike:
        at, *known = (
            "unknown" if stack.exposure_ms is None else f"{stack.exposure_ms:g} ms"
            for stack in (bright, *dark[:6])
        )
        raise DataError(
            f"{bright.name}: found no dark frames for its exposure ({at}), expected {', '.join(known)}"
        )
    return min(alike, key=lambda stack: abs(stack.n_frames - bright.n_frames))


def _with_common_frames(stacks: Sequence[S]) -> list[S]:
    """Return the stacks with the most common number of frames, the series, if there are three; otherwise all.

    The others are stacks of many frames for the spatial measurement, which the standard takes on its own.
    """
    ((n_frames, count),) = Counter(stack.n_frames for stack in stacks).most_common(1)
    return [stack for stack in stacks if stack.n_frames == n_frames or count < 3]


def _saturation(points: Sequence[TransferPoint]) -> int | None:
    """Return the index of the largest temporal variance, the saturation point; None if nothing is saturated.

    Behind it the variance falls, or values are at the end of the scale.
    """
    variances = [point.bright.temporal for point in points]
    most = max(variances)
    index = variances.index(most)
    # By noise alone, the variance of a pair of 64 x 64 pixels falls to 0.8 of the largest once in 10¹⁰.
    is_reached = any(point.bright.temporal < 0.8 * most or point.is_saturated for point in points[index + 1 :])
    return index if is_reached else None


class _Draws(NamedTuple):
    """Temporal and spatial variance of a stack, and its mean: each the value, then draws of its pivotal quantity.

    What is computed of such arrays is again a value with its draws, shape (1 + DRAWS,).
    """

    temporal: FloatArray
    spatial: FloatArray
    mean: FloatArray


def _drawn(stack: StackNoise, rng: np.random.Generator) -> _Draws:
    """Draw the expected mean squares that a stack may have, sums of squares over χ², and what follows."""
    t, (v, h) = stack.n_frames, stack.shape
    expected = {
        name: square * stack.degrees[name] / rng.chisquare(stack.degrees[name], DRAWS)
        for name, square in stack.squares.items()
    }
    temporal = expected["tv"] / h + expected["th"] / v + expected["tvh"] * (1.0 - 1.0 / h - 1.0 / v)
    weights = combinations(t, v, h)
    static = added([weights[name] for name in STATIC])
    spatial = sum((weight * expected[name] for name, weight in static.items()), np.zeros(DRAWS))
    # Without changes of the whole frame the mean square of frames would be that of rows and columns of a frame.
    squares = stack.squares
    of_mean = max(squares["t"], squares["tv"] + squares["th"] - squares["tvh"], squares["tvh"])
    mean = stack.mean + math.sqrt(of_mean / (t * v * h)) * rng.standard_normal(DRAWS)
    return _Draws(
        np.append(stack.temporal, temporal), np.append(stack.spatial, spatial), np.append(stack.mean, mean)
    )


def _root(variance: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(variance, 0.0))


class _Camera:
    """Photon transfer of bright and dark stacks, and the figures of EMVA 1288 that follow.

    `points` are by increasing signal, and `fitted` those that count for gain and responsivity; `series` has those
    with the most common number of frames. `most` is the signal at saturation, infinite if it is not known, and
    `saturated` the index of that point in the series, None if it is not reached. `gain` is K, the slope of
    variance against signal, both above dark, and `response` the slope of the signal against photons, None without
    photons: each a value, then draws. `misfit` and `bend` are those of the line, and `bent_dn` the signal whose
    bend the gain has. DataError if all bright stacks are saturated, or none is brighter than dark.
    """

    def __init__(
        self, of_bright: Sequence[StackNoise], of_dark: Sequence[StackNoise], full_scale: float | None
    ) -> None:
        self.of_dark = of_dark
        self.darkest = min(of_dark, key=lambda stack: (stack.exposure_ms or 0.0, -stack.n_frames))
        of_bright = sorted(of_bright, key=lambda stack: stack.mean)
        points = [TransferPoint.of(stack, _dark_of(stack, of_dark)) for stack in of_bright]
        _check_light(points)
        self.series = _with_common_frames(points)
        self.saturated = _saturation(self.series)
        if self.saturated is not None:
            self.most = self.series[self.saturated].signal_dn
        else:
            self.most = math.inf if full_scale is None else full_scale - points[0].dark.mean
        self.saturation_photons = None if self.saturated is None else self.series[self.saturated].photons
        good = [point for point in points if point.signal_dn > 0.0 and not point.is_saturated]
        # EMVA 1288 release 4.0 linear
        good = [point for point in good if point.signal_dn <= 0.7 * self.most] or good
        self.fitted = [point for point in good if point in self.series] or good
        self.points = [structs.replace(point, is_fitted=point in self.fitted) for point in points]
        self.spatial = _spatial_point(good, self.most)
        self.step = min((stack.step for stack in (*of_dark, *of_bright) if stack.step), default=0.0)
        self.rng = np.random.default_rng(SEED)
        self.drawn = {stack: _drawn(stack, self.rng) for stack in (*of_dark, *of_bright)}
        self._fit_gain()
        self.response = self._response()
        known = [stack for stack in _with_common_frames(of_dark) if stack.exposure_ms is not None]
        # EMVA 1288 release 4.0 linear: dark noise and dark current need three exposures to be held apart.
        self.dark_series = known if len({stack.exposure_ms for stack in known}) >= 3 else []
        self.dark_variance = self._dark_variance()
        self.dark_slopes = {} if self._is_rounded(self.darkest) else self._dark_slopes()

    def _fit_gain(self) -> None:
        drawn = [(self.drawn[point.bright], self.drawn[point.dark]) for point in self.fitted]
        signals = np.array([bright.mean - dark.mean for bright, dark in drawn])
        variances = np.array([bright.temporal - dark.temporal for bright, dark in drawn])
        gains = (signals * variances).sum(axis=0) / (signals**2).sum(axis=0)
        if gains[0] <= 0.0:
            raise DataError(
                f"{self.fitted[-1].bright.name}: its temporal variance is not above that of dark frames, so there "
                "is no photon transfer; expected raw values of a camera that is not saturated"
            )
        signal, errors = signals[:, 0], variances[:, 1:].std(axis=1)
        x, y = signal / errors, variances[:, 0] / errors
        rest = y - x * (x @ y) / (x @ x)
        self.misfit, self.bend = _misfit(float(rest @ rest), len(x) - 1), _bend(self.fitted, errors)
        self.bent_dn = float((signal**3).sum() / (signal**2).sum())
        self.gain: FloatArray = gains[0] + self.misfit * (gains - gains[0])

    def _response(self) -> FloatArray | None:
        if not all(point.photons for point in self.fitted):
            return None
        photons, signal = np.array([(point.photons, point.signal_dn) for point in self.fitted], np.float64).T
        n = len(photons)
        if n == 1:
            point = self.fitted[0]
            return np.asarray((self.drawn[point.bright].mean - self.drawn[point.dark].mean) / photons[0])
        slope = float(photons @ signal / (photons @ photons))
        rest = signal - slope * photons
        error = math.sqrt(float(rest @ rest) / (n - 1) / float(photons @ photons))
        return np.append(slope, slope + error * self.rng.standard_t(n - 1, DRAWS))

    def figures(self, background_dn: float | None) -> Json:
        """Return the figures that are known, with their intervals, by their names in `EmvaNumbers`.

        They are those of a straight response; the intervals hold those of the bent one as well. The signal of the
        background of a chart is None without one.
        """
        straight, bent = (self._drawn_figures(bend, background_dn) for bend in (0.0, self.bend))
        figures: Json = {}
        for name, drawn in straight.items():
            ends = np.quantile([drawn[1:], bent[name][1:]], (0.025, 0.975), axis=1)
            figures |= {name: float(drawn[0]), f"{name}_ci95": (float(ends.min()), float(ends.max()))}
        step = self.step / float(self.gain[0])
        if self._is_rounded(self.spatial.dark):  # no noise smooths the pattern
            figures["dsnu_ci95"] = max(figures["dsnu"] - 0.5 * step, 0.0), figures["dsnu"] + 0.5 * step
        if self._is_rounded(self.darkest):
            figures |= {"dark_noise": 0.4 * step, "dark_noise_ci95": (0.0, 0.4 * step)}
        if electrons := figures.get("saturation_electrons"):
            least = figures["dark_noise_dn"] / figures["system_gain"] + 0.5
            figures |= {"snr_max": math.sqrt(electrons), "dynamic_range": electrons / least}
            figures.setdefault("saturation_photons", None if self.response is None else self.saturation_photons)
        return figures

    def _drawn_figures(self, bend: float, background_dn: float | None) -> dict[str, FloatArray]:
        """Return the figures of a response with this bend (`_bend`), each a value and its draws.

        A line fitted to variances of K signal (1 + b signal) has the gain K (1 + b Σ signal³ / Σ signal²).
        """
        gain = self.gain / (1.0 + bend * self.bent_dn)
        bright, dark = self.drawn[self.spatial.bright], self.drawn[self.spatial.dark]
        prnu = _root(bright.spatial - dark.spatial) / (bright.mean - dark.mean)
        figures = {
            "system_gain": gain,
            "prnu": 100.0 * prnu / (1.0 + bend / 3.0 * self.spatial.signal_dn),
            "dsnu": _root(dark.spatial) / gain,
            "dark_noise_dn": _root(self.dark_variance),
            "dark_noise": _root(self.dark_variance - ROUNDING_VARIANCE * self.step**2) / gain,
            **{name: slopes / gain**power for name, (slopes, power) in self.dark_slopes.items()},
        }
        if background_dn is not None:
            figures["background_electrons"] = background_dn / gain
        if self.response is not None:
            efficiency = self.response / gain
            figures |= {"quantum_efficiency": efficiency, "responsivity": self.response}
            figures["sensitivity_threshold"] = (figures["dark_noise_dn"] / gain + 0.5) / efficiency
        # With photons the capacity is their number at saturation times the quantum efficiency.
        if self.saturation_photons is not None and self.response is not None:
            figures["saturation_electrons"] = self.saturation_photons * (self.response / gain)
        elif math.isfinite(self.most):
            figures["saturation_electrons"] = self.most / gain
            if self.response is not None:
                figures["saturation_photons"] = self.most / self.response
        return figures

    def _is_rounded(self, dark: StackNoise) -> bool:
        """Return whether rounding decides the noise of a dark stack (EMVA 1288 release 4.0 linear)."""
        return dark.temporal < LEAST_DARK_VARIANCE * self.step**2

    def _dark_slopes(self) -> dict[str, tuple[FloatArray, int]]:
        """Return the slopes of means and variances of dark frames over time, and the power of the gain in them."""
        if not self.dark_series:
            return {}
        seconds = np.array([stack.exposure_ms for stack in self.dark_series], np.float64) / 1e3
        slopes = {}
        for name, quantity, power in (
            ("dark_current", "mean", 1),
            ("dark_current_from_variance", "temporal", 2),
        ):
            values = np.array([getattr(stack, quantity) for stack in self.dark_series])
            slope, error, _ = straight_line(seconds, values)
            drawn = slope + error * self.rng.standard_t(len(seconds) - 2, DRAWS)
            slopes[name] = np.append(slope, drawn), power
        return slopes

    def _dark_variance(self) -> FloatArray:
        """Return the temporal dark variance at an exposure of 0, on the straight line through those of the stacks.

        Without three exposures it is that of the shortest one, with what the dark current adds.
        """
        if not self.dark_series or self._is_rounded(self.darkest):
            return self.drawn[self.darkest].temporal
        exposures = np.array([stack.exposure_ms for stack in self.dark_series], np.float64)
        variances = np.array([self.drawn[stack].temporal for stack in self.dark_series])
        errors = variances[:, 1:].std(axis=1)
        design = np.column_stack([np.ones_like(exposures), exposures]) / errors[:, np.newaxis]
        line = np.linalg.pinv(design) @ (variances / errors[:, np.newaxis])
        rest = variances[:, 0] / errors - design @ line[:, 0]
        misfit = _misfit(float(rest @ rest), len(exposures) - 2)
        return np.asarray(line[0, 0] + misfit * (line[0] - line[0, 0]))

    def warnings(self, *, has_bits: bool) -> Iterator[RecordingWarning]:
        """Yield warnings about the line of photon transfer, dark stacks, light, and saturation."""
        yield from self._of_gain()
        yield from self._of_dark()
        yield from self._of_light()
        if self.saturated is None:
            end = f"that of the end of the scale ({self.most:.5g} DN above dark)"
            where = end if math.isfinite(self.most) else "not known"
            hint = "" if has_bits else f", or give {argument.bits} if the camera has fewer bits than its files"
            yield RecordingWarning(
                "saturation_not_reached",
                f"the variance still rises at the brightest stack: saturation is {where}; add brighter stacks"
                f"{hint}",
            )

    def _of_gain(self) -> Iterator[RecordingWarning]:
        error = float(np.std(self.gain[1:])) / float(self.gain[0])
        bent = abs(1.0 / (1.0 + self.bend * self.bent_dn) - 1.0)
        # The three public reference sets have an error of 0.7 %, 0.3 % and, with an offset at faint light, 3 %.
        if self.misfit > 1.0 and error > 0.02:
            yield RecordingWarning(
                "not_linear",
                f"variances scatter {self.misfit:.2g} times as much about the line of photon transfer as noise "
                "alone: the camera is not linear, or its values are processed; the intervals are widened by as "
                "much",
            )
        elif bent > 0.05:  # a public reference set has 0.047
            yield RecordingWarning(
                "not_linear",
                f"the response is bent, and the gain {100.0 * bent:.2g} % away from that of faint light: the "
                "camera is not linear, or the stated photons are wrong; the intervals are widened by as much",
            )
        if len(self.fitted) == 1:
            yield RecordingWarning(
                "one_exposure",
                "the gain is from one bright stack: its interval has the noise, but not what a camera that is not "
                "quite linear changes; record several exposures up to saturation",
            )

    def _of_dark(self) -> Iterator[RecordingWarning]:
        crushed = max(self.of_dark, key=lambda stack: stack.crushed)
        if crushed.crushed > MOST_SATURATED:
            yield RecordingWarning(
                "saturated",
                f"{100.0 * crushed.crushed:.2g} % of the values of {crushed.name} are black, the end of the "
                "scale: dark noise, DSNU and dark current come out too small; raise the black level (offset) of "
                "the camera",
            )
        if self._is_rounded(self.darkest):
            yield RecordingWarning(
                "quantised",
                f"the temporal variance of dark frames ({self.darkest.temporal:.2g} DN²) is below "
                f"{LEAST_DARK_VARIANCE * self.step**2:g}: rounding decides it; the dark noise is an upper bound, "
                f"the DSNU uncertain by half a step ({self.step:g} DN) and the dark current not known; record "
                "with more gain or bits",
            )

    def _of_light(self) -> Iterator[RecordingWarning]:
        least = self.points[-1].signal_dn / 2.0  # fainter stacks count little
        stacks = ((stack, max(at.signal_dn, least)) for at in self.points for stack in (at.bright, at.dark))
        share, name = max((abs(stack.change) / signal, stack.name) for stack, signal in stacks)
        if share > 0.01:  # The mean of a stack is up to half of its change away from the light that was measured.
            yield RecordingWarning(
                "drift",
                f"the mean of {name} changes by {100.0 * share:.2g} % of the signal from its first frame to its "
                "last: quantum efficiency, responsivity and linearity are uncertain by half of it; warm lamp and "
                "camera up",
            )
        bright, dark = self.spatial.bright, self.spatial.dark
        whole, even = (
            100.0 * math.sqrt(max(variance, 0.0)) / self.spatial.signal_dn
            for variance in (
                bright.spatial - dark.spatial,
                bright.spatial - bright.smooth - dark.spatial + dark.smooth,
            )
        )
        # Light that falls by 3 % to the corners does that to a PRNU of 0.8 %; the public reference sets have 1.5
        # to 1.8.
        if whole > 1.2 * even:
            yield RecordingWarning(
                "uneven_light",
                f"brightness changes smoothly across the frame: the PRNU of {whole:.3g} % contains it, and is "
                f"{even:.3g} % without a surface of second order; light the sensor evenly, or choose a region",
            )


def _check_light(points: Sequence[TransferPoint]) -> None:
    """Raise DataError if all bright stacks are saturated, or none is brighter than dark."""
    faintest, brightest = points[0].bright, points[-1]
    if faintest.saturated > MOST_SATURATED:
        raise DataError(
            f"{faintest.name}: {100 * faintest.saturated:.3g} % of its values are at the end of the scale"
            + ", and all other stacks are brighter" * (len(points) > 1)
            + "; expected a stack below saturation"
        )
    if brightest.signal_dn <= 0.0 or all(point.variance_dn2 <= 0.0 for point in points):
        raise DataError(
            f"{brightest.bright.name}: its mean is {brightest.bright.mean:.4g} and that of dark frames "
            f"{brightest.dark.mean:.4g}, with no more noise; expected brighter frames; are they exchanged?"
        )


def _bend(fitted: Sequence[TransferPoint], errors: FloatArray) -> float:
    """Return the bend of the camera's response: b in variance = K signal (1 + b signal); 0 if noise explains it.

    `errors` are those of the variances. For a response of g(x) = x (1 + a x) that is nearly straight, signal over
    photons is in proportion to 1 + a signal; variance over signal, K g'² x / g, to 1 + 3 a signal; and a pattern
    over the signal, g' x / g, is 1 + a signal. With photons a comes from the means, without from the variances.
    """
    from scipy.special import stdtrit

    n = len(fitted)
    signal = np.array([point.signal_dn for point in fitted])
    # With fewer stacks, or nearer ones, scatter looks like a bend.
    if n < 4 or np.ptp(signal) < 0.2 * signal.max():
        return 0.0
    photons = [point.photons for point in fitted]
    has_photons = all(photons)
    ratio = signal / photons if has_photons else np.array([point.variance_dn2 for point in fitted]) / signal
    weights = (signal / (1.0 if has_photons else errors)) ** 2
    x = signal - weights @ signal / weights.sum()
    slope = float(weights @ (x * ratio) / (weights @ x**2))
    line = weights @ ratio / weights.sum() + slope * x
    at_zero = float(line[0] - slope * signal[0])
    scatter = math.sqrt(float(weights @ (ratio - line) ** 2) / (n - 2)) if has_photons else 1.0
    limit = float(stdtrit(n - 2 if has_photons else math.inf, 1.0 - MISFIT_PROBABILITY / 2.0))
    if at_zero <= 0.0 or abs(slope) <= limit * scatter / math.sqrt(float(weights @ x**2)):
        return 0.0
    largest = 0.5 / float(signal.max())
    return float(np.clip((3.0 if has_photons else 1.0) * slope / at_zero, -largest, largest))


def _misfit(chi2: float, n_free: int) -> float:
    """Return the factor by which values scatter more about a line than their errors explain; at least 1."""
    from scipy.special import gammaincc

    is_likely = n_free < 1 or float(gammaincc(n_free / 2.0, chi2 / 2.0)) > MISFIT_PROBABILITY
    return 1.0 if is_likely else math.sqrt(chi2 / n_free)


def _spatial_point(points: Sequence[TransferPoint], most: float) -> TransferPoint:
    """Return the point of the spatial measurement: most frames, and nearest to half of saturation."""
    n_frames = max(point.n_frames for point in points)
    middle = most / 2.0 if math.isfinite(most) else points[-1].signal_dn
    return min(
        (point for point in points if point.n_frames == n_frames), key=lambda point: abs(point.signal_dn - middle)
    )


def _linearity(points: Sequence[TransferPoint], most: float) -> tuple[float, float] | None:
    """Return the smallest and largest deviation from the line of least relative deviation, in percent."""
    used = [
        (point.photons, point.signal_dn)
        for point in points
        if point.photons and math.isfinite(most) and LINEAR[0] * most <= point.signal_dn <= LINEAR[1] * most
    ]
    if len(used) < 3:
        return None
    photons, signal = np.array(used, np.float64).T
    design = np.column_stack([np.ones_like(photons), photons])
    line = design @ np.linalg.lstsq(design / signal[:, None], np.ones_like(signal))[0]
    deviation = 100.0 * (signal - line) / line
    return float(deviation.min()), float(deviation.max())
