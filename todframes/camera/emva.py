"""Noise of a camera as EMVA 1288 defines it: from pairs of bright and dark stacks at several exposures.

The camera is linear: a pixel counts electrons, quantum efficiency times photons and dark current, and a digital
value (DN) is the system gain K times their number. Photons arrive at random, so the variance of values over time
rises with the signal at the slope K, which needs no known light: the photon transfer method. The equations are
those of EMVA Standard 1288, release 4.0 linear. Each number is computed of the stacks and of draws of their mean
squares (`FrameSums.drawn_squares`), in whose quantiles it has its interval.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import Struct

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, argument
from todframes.camera.mtf_table import Ends
from todframes.camera.noise3d import (
    DRAWS,
    DRIFT_ERRORS,
    MOST_SATURATED,
    SEED,
    FrameSums,
    fit_drift,
    root,
    steady_part,
    sum_frames,
    variances_of,
    with_interval,
)
from todframes.parameters import Box, Progress
from todframes.recordings.recording import Recording, RecordingWarning, with_bits

LEAST_DARK_VARIANCE = 0.24
"""Temporal dark variance in steps² below which rounding decides it. EMVA 1288 release 4.0 linear."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance of rounding in steps². A step is 1 DN, or more if the values have gaps: 12 bits in files of 16."""

LINEAR = (0.05, 0.95)
"""Parts of the saturation signal between which the linearity error is measured. EMVA 1288 release 4.0 linear."""

MOST_BENT, BENT_ERRORS = 0.04, 4.0
"""Change of the gain from faint stacks to all of them that is warned of, and its least size in standard errors."""

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StackNoise:
    """Mean and variances of a stack in DN and DN², each followed by its draws, and what its warnings need.

    `temporal` is the variance over time of a pixel without changes of the whole frame, σ²_y of a pair of frames,
    and `spatial` that of the pattern, without what temporal noise leaves in the mean image. `parts` are those of
    the analysis of variance. `smooth` is the part of the spatial variance that is a surface of second order across
    the frame, `change` that of the mean from the first frame to the last, 0 if noise and flicker explain it.
    `saturated` and `crushed` are shares of values that are cut off at the largest and the smallest; `step` is the
    least difference of values, 0 if there is but one.
    """

    name: str
    exposure_ms: float | None
    photons: float | None
    n_frames: int
    shape: tuple[int, int]
    mean: FloatArray
    temporal: FloatArray
    spatial: FloatArray
    parts: dict[str, FloatArray]
    smooth: float
    change: float
    saturated: float
    crushed: float
    step: float
    warnings: tuple[RecordingWarning, ...]

    @property
    def is_rounded(self) -> bool:
        """Whether rounding decides the temporal noise (EMVA 1288 release 4.0 linear)."""
        return float(self.temporal[0]) < LEAST_DARK_VARIANCE * self.step**2


class TransferPoint(Struct, frozen=True, kw_only=True):
    """A bright stack in the photon transfer: its signal and temporal variance above the dark stack's.

    It counts for gain and responsivity if `is_fitted`.
    """

    exposure_ms: float | None
    photons: float | None
    n_frames: int
    signal_dn: float
    variance_dn2: float
    snr: float | None
    is_fitted: bool
    is_saturated: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """A bright stack and the dark one of its exposure; signal and variance above dark, each with its draws."""

    bright: StackNoise
    dark: StackNoise

    @property
    def signal(self) -> FloatArray:
        return self.bright.mean - self.dark.mean

    @property
    def variance(self) -> FloatArray:
        return self.bright.temporal - self.dark.temporal

    @property
    def signal_dn(self) -> float:
        return float(self.signal[0])

    @property
    def is_saturated(self) -> bool:
        return self.bright.saturated > MOST_SATURATED

    def point(self, *, is_fitted: bool) -> TransferPoint:
        temporal = float(self.bright.temporal[0])
        return TransferPoint(
            exposure_ms=self.bright.exposure_ms,
            photons=self.bright.photons,
            n_frames=self.bright.n_frames,
            signal_dn=self.signal_dn,
            variance_dn2=float(self.variance[0]),
            snr=self.signal_dn / math.sqrt(temporal) if temporal > 0 else math.inf,
            is_fitted=is_fitted,
            is_saturated=self.is_saturated,
        )


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
    dark_current : float or None
        Electrons per second, from means; None with fewer than three dark exposures.
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
    linearity_percent : (float, float) or None
        Smallest and largest deviation from the straight line.
    is_saturation_reached : bool
        The variance has a maximum within the stacks.
    points : tuple of TransferPoint
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
    linearity_percent: tuple[float, float] | None
    is_saturation_reached: bool
    points: tuple[TransferPoint, ...]

    def noise_table(self) -> Json:
        """Return the table `[noise]` of a SENSOR.toml, in six digits.

        What rows and columns have in common in the dark is taken from the dark noise and from the DSNU: EMVA 1288
        does not have them apart.
        """
        lines = self.lines_electrons
        of_noise, of_pattern = (
            sum(sd**2 for key, sd in lines.items() if kind in key) for kind in ("noise", "pattern")
        )
        known: Json = {
            "quantum_efficiency": self.quantum_efficiency,
            "system_gain_dn_per_electron": self.system_gain,
            "dark_noise_electrons": math.sqrt(max(self.dark_noise**2 - of_noise, 0.0)),
            # From the means of dark frames; noise can make it negative.
            "dark_current_electrons_per_s": None if self.dark_current is None else max(self.dark_current, 0.0),
            "dsnu_electrons": math.sqrt(max(self.dsnu**2 - of_pattern, 0.0)),
            "prnu_percent": self.prnu,
            **lines,
            "full_well_electrons": self.saturation_electrons,
            "bits": self.bits,
            "exposure_ms": self.exposure_ms,
        }
        rounded = {
            key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in known.items()
        }
        return {"model": "photon"} | {key: value for key, value in rounded.items() if value is not None}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Camera:
    """Stacks of a camera, and what each of them counts for.

    Pairs are by increasing signal. `series` has those with the most common number of frames, `fitted` those that
    count for gain and responsivity. `saturated` is the pair at saturation, None if it is not reached, and `most`
    the signal there, or at the end of the scale; infinite if neither is known. `dark_series` has the dark stacks
    of three exposures or more, by which dark noise and dark current are held apart; it can be empty.
    """

    pairs: list[_Pair]
    series: list[_Pair]
    fitted: list[_Pair]
    spatial: _Pair
    saturated: _Pair | None
    most: float
    of_dark: Sequence[StackNoise]
    darkest: StackNoise
    dark_series: Sequence[StackNoise]
    step: float

    @classmethod
    def of(
        cls, of_bright: Sequence[StackNoise], of_dark: Sequence[StackNoise], full_scale: float | None
    ) -> _Camera:
        """Arrange stacks. DataError if all bright ones are saturated, or none is brighter than dark."""
        of_bright = sorted(of_bright, key=lambda stack: float(stack.mean[0]))
        pairs = [_Pair(stack, _dark_of(stack, of_dark)) for stack in of_bright]
        _check_light(pairs)
        alike = _with_common_frames(of_bright)
        series = [pair for pair in pairs if pair.bright in alike]
        saturated = _saturation(series)
        if saturated is not None:
            most = saturated.signal_dn
        else:
            most = math.inf if full_scale is None else full_scale - float(pairs[0].dark.mean[0])
        good = [pair for pair in pairs if pair.signal_dn > 0.0 and not pair.is_saturated]
        good = [pair for pair in good if pair.signal_dn <= 0.7 * most] or good  # EMVA 1288 release 4.0 linear
        middle = most / 2.0 if math.isfinite(most) else pairs[-1].signal_dn
        known = [stack for stack in _with_common_frames(of_dark) if stack.exposure_ms is not None]
        return cls(
            pairs=pairs,
            series=series,
            fitted=[pair for pair in good if pair in series] or good,
            spatial=min(good, key=lambda pair: (-pair.bright.n_frames, abs(pair.signal_dn - middle))),
            saturated=saturated,
            most=most,
            of_dark=of_dark,
            darkest=min(of_dark, key=lambda stack: (stack.exposure_ms or 0.0, -stack.n_frames)),
            dark_series=known if len({stack.exposure_ms for stack in known}) >= 3 else [],
            step=min((stack.step for stack in (*of_dark, *of_bright) if stack.step), default=0.0),
        )

    def gain(self, pairs: Sequence[_Pair]) -> FloatArray:
        """Return K, the slope of variance against signal through the origin."""
        return _slope(np.array([pair.signal for pair in pairs]), np.array([pair.variance for pair in pairs]))

    def figures(self, background: Stack | None) -> dict[str, FloatArray]:
        """Return the figures that are known by their names in `EmvaNumbers`, each followed by its draws."""
        gain, bright, dark = self.gain(self.fitted), self.spatial.bright, self.spatial.dark
        if gain[0] <= 0.0:
            raise DataError(
                f"{self.fitted[-1].bright.name}: its temporal variance is not above that of dark frames, so there "
                "is no photon transfer; expected raw values of a camera that is not saturated"
            )
        dark_variance, figures = self.darkest.temporal, {"system_gain": gain}
        if self.dark_series and not self.darkest.is_rounded:
            seconds = np.array([stack.exposure_ms for stack in self.dark_series], np.float64) / 1e3
            design = np.column_stack([np.ones_like(seconds), seconds])
            means, variances = (
                np.array([getattr(stack, name) for stack in self.dark_series]) for name in ("mean", "temporal")
            )
            errors = variances[:, 1:].std(axis=1, keepdims=True)
            figures["dark_current"] = np.linalg.lstsq(design, means)[0][1] / gain
            dark_variance = np.linalg.lstsq(design / errors, variances / errors)[0][0]
        electronic = root(dark_variance - ROUNDING_VARIANCE * self.step**2)
        if self.darkest.is_rounded:  # the bound of the standard
            electronic = np.full_like(gain, 0.4 * self.step)
        figures |= {
            "dark_noise": electronic / gain,
            "dark_noise_dn": root(dark_variance),
            "dsnu": root(dark.spatial) / gain,
            "prnu": 100.0 * root(bright.spatial - dark.spatial) / self.spatial.signal,
        }
        if all(pair.bright.photons for pair in self.fitted):
            photons = np.array([[pair.bright.photons] for pair in self.fitted], np.float64)
            response = _slope(photons, np.array([pair.signal for pair in self.fitted]))
            figures |= {"responsivity": response, "quantum_efficiency": response / gain}
            figures["sensitivity_threshold"] = (figures["dark_noise_dn"] / gain + 0.5) / (response / gain)
            if math.isfinite(self.most):
                figures["saturation_photons"] = self.most / response
            if self.saturated is not None and self.saturated.bright.photons is not None:
                figures["saturation_photons"] = np.full_like(gain, self.saturated.bright.photons)
        if "saturation_photons" in figures:
            figures["saturation_electrons"] = figures["saturation_photons"] * figures["quantum_efficiency"]
        elif math.isfinite(self.most):
            figures["saturation_electrons"] = self.most / gain
        if background is not None:
            name = str(background.recording.path)
            figures["background_electrons"] = next(p.signal for p in self.pairs if p.bright.name == name) / gain
        return figures

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
        n = len(self.fitted)
        if n == 1:
            yield RecordingWarning(
                "one_exposure",
                "the gain is from one bright stack: its interval has the noise, but not what a camera that is not "
                "quite linear changes; record several exposures up to saturation",
            )
        if n < 4:  # with fewer stacks scatter looks like a bend
            return
        change = self.gain(self.fitted[: n // 2]) / self.gain(self.fitted) - 1.0
        if abs(change[0]) > max(MOST_BENT, BENT_ERRORS * float(np.std(change[1:]))):
            yield RecordingWarning(
                "not_linear",
                f"the fainter half of the stacks has a gain {100.0 * change[0]:+.2g} % from that of all: the "
                "camera is not linear, or its values are processed; gain, quantum efficiency and numbers in "
                "electrons are uncertain by as much, which their intervals do not contain",
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
        if self.darkest.is_rounded:
            yield RecordingWarning(
                "quantised",
                f"the temporal variance of dark frames ({self.darkest.temporal[0]:.2g} DN²) is below "
                f"{LEAST_DARK_VARIANCE * self.step**2:g}: rounding decides it; the dark noise is an upper bound, "
                f"the DSNU uncertain by half a step ({self.step:g} DN) and the dark current not known; record "
                "with more gain or bits",
            )

    def _of_light(self) -> Iterator[RecordingWarning]:
        least = self.pairs[-1].signal_dn / 2.0  # fainter stacks count little
        stacks = ((stack, max(at.signal_dn, least)) for at in self.pairs for stack in (at.bright, at.dark))
        share, name = max((abs(stack.change) / signal, stack.name) for stack, signal in stacks)
        if share > 0.01:  # The mean of a stack is up to half of its change away from the light that was measured.
            yield RecordingWarning(
                "drift",
                f"the mean of {name} changes by {100.0 * share:.2g} % of the signal from its first frame to its "
                "last: quantum efficiency, responsivity and linearity are uncertain by half of it; warm lamp and "
                "camera up",
            )
        bright, dark = self.spatial.bright, self.spatial.dark
        pattern, smooth = float((bright.spatial - dark.spatial)[0]), bright.smooth - dark.smooth
        whole, even = (
            100.0 * math.sqrt(max(part, 0.0)) / self.spatial.signal_dn for part in (pattern, pattern - smooth)
        )
        # Light that falls by 3 % to the corners does that to a PRNU of 0.8 %; the public reference sets have 1.5
        # to 1.8.
        if whole > 1.2 * even:
            yield RecordingWarning(
                "uneven_light",
                f"brightness changes smoothly across the frame: the PRNU of {whole:.3g} % contains it, and is "
                f"{even:.3g} % without a surface of second order; light the sensor evenly, or choose a region",
            )


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
    full_scale, rng = bright[0].recording.full_scale, np.random.default_rng(SEED)
    of_dark = [_measured(stack, region, None, rng, progress) for stack in dark]
    dark_mean = min(float(stack.mean[0]) for stack in of_dark)
    of_bright = [_measured(stack, region, dark_mean, rng, progress) for stack in bright]
    shapes = {stack.shape for stack in (*of_dark, *of_bright)}
    if len(shapes) > 1:
        found = " and ".join(f"{columns} x {rows}" for rows, columns in sorted(shapes))
        raise DataError(f"noise: found stacks of {found} pixels, expected one size")
    camera = _Camera.of(of_bright, of_dark, full_scale)
    drawn = camera.figures(background)
    figures: Json = {}
    for name, values in drawn.items():
        figures[name], figures[f"{name}_ci95"] = with_interval(values)
    gain = figures["system_gain"]
    if camera.darkest.is_rounded or camera.spatial.dark.is_rounded:  # no noise smooths the pattern
        half_step = 0.5 * camera.step / gain
        for name in ("dark_noise", "dsnu"):
            figures[f"{name}_ci95"] = max(figures[name] - half_step, 0.0), figures[name] + half_step
    numbers = EmvaNumbers(
        source=source,
        bits=bits,
        exposure_ms=camera.spatial.bright.exposure_ms,
        **figures,
        lines_electrons={
            key: sd / gain
            for key, part in LINES.items()
            for sd, (low, _) in [with_interval(root(camera.spatial.dark.parts[part]))]
            if low > 0.0
        },
        linearity_percent=_linearity(camera.series, camera.most),
        is_saturation_reached=camera.saturated is not None,
        points=tuple(pair.point(is_fitted=pair in camera.fitted) for pair in camera.pairs),
    )
    of_recordings = dict.fromkeys(warning for stack in (*of_bright, *of_dark) for warning in stack.warnings)
    return numbers, (*of_recordings, *camera.warnings(has_bits=bits is not None))


def _slope(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the slope of lines through the origin, fitted by least squares along the first axis."""
    return np.asarray((x * y).sum(axis=0) / (x**2).sum(axis=0))


def _measured(
    stack: Stack, region: Box | None, dark_mean: float | None, rng: np.random.Generator, progress: Progress | None
) -> StackNoise:
    """Return means and variances of a stack. `dark_mean` is that of dark frames, None for a dark stack."""
    recording = stack.recording
    if recording.is_colour:
        raise DataError(f"{recording.path}: has colours, expected the raw values of one channel")
    sums = sum_frames(recording, [region], progress)[0][0]
    if sums.n < 2:
        raise DataError(
            f"{recording.path}: found 1 frame of this exposure, expected 2 or more: one cannot separate temporal "
            "noise from fixed pattern"
        )
    _check_exposure(stack, sums, dark_mean)
    # Frames whose values are cut off are alike, and repeat no other.
    is_cut = sums.ends.cut(0.0).top > MOST_SATURATED
    steady = recording if is_cut else steady_part(recording, sums)
    if steady.n_frames not in (None, sums.n):
        sums = sum_frames(steady, [region], None)[0][0]
    if stack.is_levelled:
        sums.level()
    n, n_pixels, means = sums.n, sums.reference.size, sums.means()
    squares = sums.drawn_squares(rng)
    parts = variances_of(squares, n, *sums.reference.shape)
    # The variance of the mean image, as the standard has it, without what temporal noise leaves there.
    degrees = sums.mean_squares()[1]
    image = sum((squares[part] * degrees[part] for part in ("v", "h", "vh")), np.zeros(1)) / (n * n_pixels)
    noise = rng.standard_normal(DRAWS) * np.sqrt(squares["t"][1:] / (n * n_pixels))
    temporal = float(root(parts["dynamic"])[0])
    cut = sums.ends.cut(temporal)
    return StackNoise(
        name=str(recording.path),
        exposure_ms=stack.exposure_ms,
        photons=stack.photons,
        n_frames=n,
        shape=(sums.reference.shape[0], sums.reference.shape[1]),
        mean=float(means.mean()) + np.append(0.0, noise),
        temporal=parts["dynamic"],
        spatial=image - parts["dynamic"] / n,
        parts=parts,
        smooth=_smooth_variance(sums.mean_image()),
        change=_change(means, temporal / math.sqrt(n_pixels)),
        saturated=cut.top,
        crushed=cut.bottom,
        step=sums.ends.step,
        warnings=tuple(
            warning
            if warning in recording.warnings
            else warning._replace(message=f"{recording.path}: {warning.message}")
            for warning in steady.warnings
        ),
    )


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


def _check_exposure(stack: Stack, sums: FrameSums, dark_mean: float | None) -> None:
    """Refuse a stack whose frames have two exposures: sorted by their means, they fall into two groups."""
    means, n_pixels = sums.means(), sums.reference.size
    order = np.sort(means)
    steps = np.diff(order)
    n_low = int(steps.argmax()) + 1
    groups = order[:n_low], order[n_low:]
    within = max(float(np.std(group)) for group in groups)
    signal = 0.0 if dark_mean is None else abs(float(np.median(means)) - dark_mean)
    temporal = variances_of(sums.mean_squares()[0], sums.n, *sums.reference.shape)["dynamic"]
    sd = math.sqrt(max(temporal, 0.0))
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


def _with_common_frames(stacks: Sequence[StackNoise]) -> list[StackNoise]:
    """Return the stacks with the most common number of frames, the series, if there are three; otherwise all.

    The others are stacks of many frames for the spatial measurement, which the standard takes on its own.
    """
    ((n_frames, count),) = Counter(stack.n_frames for stack in stacks).most_common(1)
    return [stack for stack in stacks if stack.n_frames == n_frames or count < 3]


def _saturation(pairs: Sequence[_Pair]) -> _Pair | None:
    """Return the pair with the largest temporal variance, the saturation point; None if nothing is saturated.

    Behind it the variance falls, or values are at the end of the scale.
    """
    variances = [float(pair.bright.temporal[0]) for pair in pairs]
    most = max(variances)
    index = variances.index(most)
    # By noise alone, the variance of a pair of 64 x 64 pixels falls to 0.8 of the largest once in 10¹⁰.
    behind = zip(variances[index + 1 :], pairs[index + 1 :], strict=True)
    return pairs[index] if any(variance < 0.8 * most or pair.is_saturated for variance, pair in behind) else None


def _check_light(pairs: Sequence[_Pair]) -> None:
    """Raise DataError if all bright stacks are saturated, or none is brighter than dark."""
    faintest, brightest = pairs[0].bright, pairs[-1]
    if faintest.saturated > MOST_SATURATED:
        raise DataError(
            f"{faintest.name}: {100 * faintest.saturated:.3g} % of its values are at the end of the scale"
            + ", and all other stacks are brighter" * (len(pairs) > 1)
            + "; expected a stack below saturation"
        )
    if brightest.signal_dn <= 0.0 or all(pair.variance[0] <= 0.0 for pair in pairs):
        raise DataError(
            f"{brightest.bright.name}: its mean is {brightest.bright.mean[0]:.4g} and that of dark frames "
            f"{brightest.dark.mean[0]:.4g}, with no more noise; expected brighter frames; are they exchanged?"
        )


def _linearity(pairs: Sequence[_Pair], most: float) -> tuple[float, float] | None:
    """Return the smallest and largest deviation from the line of least relative deviation, in percent."""
    used = [
        (pair.bright.photons, pair.signal_dn)
        for pair in pairs
        if pair.bright.photons and math.isfinite(most) and LINEAR[0] * most <= pair.signal_dn <= LINEAR[1] * most
    ]
    if len(used) < 3:
        return None
    photons, signal = np.array(used, np.float64).T
    design = np.column_stack([np.ones_like(photons), photons])
    line = design @ np.linalg.lstsq(design / signal[:, None], np.ones_like(signal))[0]
    deviation = 100.0 * (signal - line) / line
    return float(deviation.min()), float(deviation.max())
