"""Three-dimensional noise of a recording: variances of time, rows, columns and their interactions.

Each value is a mean plus seven independent random parts: one for each frame (t), row (v) and column (h), row of
a frame (tv), column of a frame (th), pixel (vh), and pixel of a frame (tvh). D'Agostino & Webb 1991, "Three-
dimensional analysis framework and measurement methodology for imaging system noise", Proc. SPIE 1488. Their
directional averages leave remainders of the other parts. Here the variances come from the expected mean squares
of the three-way analysis of variance with random effects: Searle, Casella & McCulloch 1992, "Variance
Components", chapter 4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import toml_text
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS
from todframes.parameters import Progress, counted
from todframes.recordings.recording import INTEGRATION_TIME_S, Recording, RecordingWarning

PARTS = {
    "t": "all of a frame, from frame to frame",
    "v": "rows, fixed",
    "h": "columns, fixed",
    "tv": "rows, from frame to frame",
    "th": "columns, from frame to frame",
    "vh": "pixels, fixed",
    "tvh": "pixels, from frame to frame",
}
"""Names of the parts of the noise, and their meanings."""

DYNAMIC, STATIC = ("tv", "th", "tvh"), ("v", "h", "vh")
"""Parts of the dynamic noise of a pixel, and of the fixed pattern. Flicker of whole frames (t) is in neither."""

MOST_SATURATED = 1e-3
"""Largest share of values at the ends of the scale that gives no warning."""

DRIFT_ERRORS = 5.0
"""Standard errors of a drift from which it counts."""

Region = tuple[int, int, int, int]

Combination = Mapping[str, float]
"""Weights of mean squares, by the name of the part."""


class NoisePart(Struct, frozen=True, omit_defaults=True):
    """A part of the noise: standard deviation, its 95 % interval, variance, and in mK if that is known.

    An unbiased estimate of a variance can be below zero; then `sd` is 0.
    """

    sd: float
    ci95: tuple[float, float] = field(name="sd_ci95")
    variance: float
    sd_mk: float | None = None


class FramePatch(NamedTuple):
    """A uniform part of the frame of known luminance, reflectance or temperature."""

    region: Region
    level: float


class PatchNoise(Struct, frozen=True):
    """Mean and noise of a patch, and the ratio of its difference from the first patch to that noise."""

    level: float
    mean: float
    dynamic: NoisePart | None
    fixed: NoisePart | None
    snr: float | None


class Transfer(Struct, frozen=True):
    """The straight line through the means of patches: values for a difference of one in level, and at level zero.

    Errors are standard errors from the scatter about the line, None for two patches. `nonlinearity` is the largest
    distance from the line, relative to the range of the means; 0 if they are all the same.
    """

    gain: float
    gain_error: float | None
    offset: float
    nonlinearity: float


class Drift(Struct, frozen=True):
    """The straight line through the means of frames: its slope per second, or per frame if there are no times.

    `change` is that from the first frame to the last; errors are standard errors.
    """

    slope: float
    slope_error: float
    change: float
    change_error: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noise3D:
    """Three-dimensional noise of a recording, in units of its values: "code", "counts" or "celsius".

    `parts` have the names in `PARTS`; of a single frame only v, h and vh, and vh contains tvh. `dynamic` (tv, th,
    tvh together) and `fixed` (v, h, vh) are None for a single frame, and so is `temporal_sd`, the standard
    deviation of each pixel over the frames; `drift` is None with fewer than three, `transfer` without patches.
    """

    n_frames: int
    region: Region
    mean: float
    parts: dict[str, NoisePart]
    dynamic: NoisePart | None
    fixed: NoisePart | None
    drift: Drift | None
    frames_per_second: float | None
    mean_image: FloatArray
    temporal_sd: FloatArray | None
    frame_means: FloatArray
    unit: str
    patches: tuple[PatchNoise, ...] = ()
    transfer: Transfer | None = None
    warnings: tuple[RecordingWarning, ...] = ()

    @property
    def frames_integrated(self) -> int:
        """Number of frames that the eye averages; 1 if the frame rate is not known."""
        return max(1, round(INTEGRATION_TIME_S * (self.frames_per_second or 0.0)))

    @property
    def fixed_pattern_ratio(self) -> NoisePart:
        """Static divided by dynamic standard deviation, `variance` being its square. Errors as `sensor_toml`."""
        dynamic, fixed = self._both()
        # The ends of two independent intervals in opposite directions, added in squares on a logarithmic scale.
        ratio, (low, high) = fixed.sd / dynamic.sd, fixed.ci95
        down, up = (_log_ratio(dynamic.sd, end) for end in dynamic.ci95)
        if ratio == 0:
            return NoisePart(0.0, (0.0, high / dynamic.sd), fixed.variance / dynamic.variance)
        lower = math.exp(-math.hypot(_log_ratio(fixed.sd, low), up)) * ratio
        upper = math.exp(math.hypot(_log_ratio(fixed.sd, high), down)) * ratio
        return NoisePart(ratio, (lower, upper), ratio**2)

    def _line_ratios(self, *names: tuple[str, str], whole: float) -> dict[str, float]:
        """Return parts that rows and columns have in common over the dynamic noise, by keys of a SENSOR.toml.

        Those whose interval begins at 0 are left out. Together they are no more than the whole.
        """
        dynamic, _ = self._both()
        ratios = {key: self.parts[part].sd / dynamic.sd for key, part in names if self.parts[part].ci95[0] > 0.0}
        scale = min(1.0, whole / math.hypot(*ratios.values())) if ratios else 1.0
        return {key: float(f"{scale * ratio:.6g}") for key, ratio in ratios.items()}

    def _both(self) -> tuple[NoisePart, NoisePart]:
        """Return the dynamic noise, which is not zero, and the fixed pattern; DataError if they are not known."""
        if self.dynamic is None or self.fixed is None:
            raise DataError(
                "noise: found one frame, expected 2 or more: one cannot separate temporal noise from fixed pattern"
            )
        if self.dynamic.variance <= 0:
            raise DataError("noise: found none from frame to frame, expected some; are all frames the same?")
        return self.dynamic, self.fixed

    def snr(self, signal: float, *, frames: int = 1) -> float:
        """Return a signal divided by the noise of a pixel after a number of frames are averaged.

        The dynamic part falls with the root of the number of frames, the fixed pattern does not.
        """
        if self.dynamic is None or self.fixed is None:
            total = sum(max(one.variance, 0.0) for one in self.parts.values())
        else:
            total = max(self.dynamic.variance, 0.0) / frames + max(self.fixed.variance, 0.0)
        return signal / math.sqrt(total) if total > 0 else math.inf

    def sensor_toml(self, *, mk_per_unit: float | None = None) -> str:
        """Return the table `[noise]` of a SENSOR.toml for a camera with this noise.

        `mk_per_unit` is the temperature difference in mK for a difference of one in the values. It is not needed
        for temperatures; if it is not known, there is no `netd_mk`. DataError if there is one frame, or no noise
        from frame to frame.
        """
        dynamic, _ = self._both()
        per_unit = 1000.0 if self.unit == "celsius" else mk_per_unit
        fixed_ratio = float(f"{self.fixed_pattern_ratio.sd:.6g}")
        noise = {
            "distribution": "gaussian",
            "netd_mk": None if per_unit is None else float(f"{dynamic.sd * per_unit:.6g}"),
            "fixed_pattern_ratio": fixed_ratio,
            "frames_integrated": self.frames_integrated,
            **self._line_ratios(("row_noise_ratio", "tv"), ("column_noise_ratio", "th"), whole=1.0),
            **self._line_ratios(("row_pattern_ratio", "v"), ("column_pattern_ratio", "h"), whole=fixed_ratio),
        }
        hint = f"netd_mk is not known: give {argument.mk_per_count}"
        return toml_text({"noise": noise}, comment=hint if per_unit is None else "")


def _log_ratio(value: float, end: float) -> float:
    return abs(math.log(end / value)) if end > 0 else math.inf


def measure_noise(
    recording: Recording,
    *,
    region: Region | None = None,
    patches: Sequence[FramePatch] = (),
    progress: Progress | None = None,
) -> Noise3D:
    """Measure the three-dimensional noise of a recording of a scene that stands still, reading frames once.

    Patches of known levels give the signal transfer and a signal-to-noise ratio for each level. SettingsError for
    a region that is not within the frame or too small, and for levels of patches that are all the same.
    """
    levels = {one.level for one in patches}
    if patches and (len(levels) < 2 or not all(map(math.isfinite, levels))):
        raise SettingsError(f"patches: found levels {sorted(levels)}, expected at least two different numbers")
    regions = (region, *(patch.region for patch in patches))
    gathered = [_Gathered(checked_region(recording, one)) for one in regions]
    times: list[float | None] = []
    for frame in counted(recording.frames(), recording.n_frames, progress):
        times.append(frame.time_s)
        for one in gathered:
            one.add(frame.values, recording)
    whole, *of_patches = (one.measured(recording, times) for one in gathered)
    shown = tuple(
        PatchNoise(patch.level, one.mean, one.dynamic, one.fixed, one.snr(abs(one.mean - of_patches[0].mean)))
        for patch, one in zip(patches, of_patches, strict=True)
    )
    transfer = fit_transfer([one.level for one in shown], [one.mean for one in shown]) if shown else None
    warnings = (*recording.warnings, *_warnings(whole, gathered[0]))
    return replace(whole, patches=shown, transfer=transfer, warnings=warnings)


class _Gathered:
    """Sums over the frames of one region, and counts of properties that make its noise doubtful."""

    def __init__(self, region: Region) -> None:
        self.region = region
        self.sums: FrameSums | None = None
        self.n_saturated = self.n_doubled = 0
        self.last: NDArray[Any] | None = None

    def add(self, frame: NDArray[Any], recording: Recording) -> None:
        left, top, width, height = self.region
        values = frame[top : top + height, left : left + width]
        grey = values.astype(np.float64) if values.ndim == 2 else values @ REC_709_LUMINANCE_WEIGHTS
        self.sums = self.sums or FrameSums(grey)
        self.sums.add(grey)
        if recording.full_scale is not None:
            at_end = (values <= recording.zero) | (values >= recording.full_scale)
            self.n_saturated += int(np.count_nonzero(at_end))
        self.n_doubled += self.last is not None and np.array_equal(values, self.last)
        self.last = values

    def measured(self, recording: Recording, times: list[float | None]) -> Noise3D:
        sums = self.sums
        assert sums is not None
        squares, degrees = sums.mean_squares()
        weights = combinations(sums.n, *sums.reference.shape)
        dynamic = fixed = None
        if sums.n > 1:
            dynamic, fixed = (
                estimate(added([weights[name] for name in names]), squares, degrees) for names in (DYNAMIC, STATIC)
            )
        means = sums.means()
        return Noise3D(
            n_frames=sums.n,
            region=self.region,
            mean=float(means.mean()),
            parts={name: estimate(one, squares, degrees) for name, one in weights.items()},
            dynamic=dynamic,
            fixed=fixed,
            drift=fit_drift(means, times),
            frames_per_second=recording.frames_per_second,
            mean_image=sums.mean_image(),
            temporal_sd=sums.temporal_sd() if sums.n > 1 else None,
            frame_means=means,
            unit=recording.unit,
        )


def combinations(n_frames: int, n_rows: int, n_columns: int) -> dict[str, Combination]:
    """Return the unbiased estimate of each part's variance as a weighted sum of mean squares.

    The expected mean squares with T frames, V rows and H columns, σ² of the part in brackets:
    tvh: [tvh]; tv: [tvh] + H [tv]; th: [tvh] + V [th]; vh: [tvh] + T [vh];
    t: [tvh] + H [tv] + V [th] + VH [t]; v: [tvh] + H [tv] + T [vh] + TH [v]; h: [tvh] + V [th] + T [vh] + TV [h].
    They are solved from the first to the last. For one frame there are v, h and vh, which contains tvh.
    """
    t, v, h = n_frames, n_rows, n_columns
    if t == 1:
        return {"v": {"v": 1 / h, "vh": -1 / h}, "h": {"h": 1 / v, "vh": -1 / v}, "vh": {"vh": 1.0}}
    return {
        "t": {"t": 1 / v / h, "tv": -1 / v / h, "th": -1 / v / h, "tvh": 1 / v / h},
        "v": {"v": 1 / t / h, "tv": -1 / t / h, "vh": -1 / t / h, "tvh": 1 / t / h},
        "h": {"h": 1 / t / v, "th": -1 / t / v, "vh": -1 / t / v, "tvh": 1 / t / v},
        "tv": {"tv": 1 / h, "tvh": -1 / h},
        "th": {"th": 1 / v, "tvh": -1 / v},
        "vh": {"vh": 1 / t, "tvh": -1 / t},
        "tvh": {"tvh": 1.0},
    }


def added(weights: Sequence[Combination]) -> Combination:
    """Return the sum of combinations."""
    names = dict.fromkeys(name for one in weights for name in one)
    return {name: sum(one.get(name, 0.0) for one in weights) for name in names}


def estimate(weights: Combination, squares: Mapping[str, float], degrees: Mapping[str, int]) -> NoisePart:
    """Return the root of a weighted sum of mean squares, and its 95 % interval.

    Mean squares of Gaussian parts are independent, and times degrees of freedom over expectation they are χ². The
    interval is the modified large-sample one: exact for one mean square, and near 95 % for sums and differences.
    Graybill & Wang 1980; Burdick & Graybill 1992, "Confidence Intervals on Variance Components", section 3.2.
    """
    from scipy.special import gammaincinv

    terms, df = (np.array([of[name] for name in weights], np.float64) for of in (squares, degrees))
    terms *= list(weights.values())
    down, up = 1 - df / (2 * gammaincinv(df / 2, 0.975)), df / (2 * gammaincinv(df / 2, 0.025)) - 1
    below, above = (np.linalg.norm(terms * np.where(terms > 0, *ways)) for ways in ((down, up), (up, down)))
    variance = float(terms.sum())
    sd, low, high = (math.sqrt(max(one, 0.0)) for one in (variance, variance - below, variance + above))
    return NoisePart(sd, (low, high), variance)


def fit_drift(frame_means: FloatArray, times_s: list[float | None]) -> Drift | None:
    """Fit a straight line to the means of frames by least squares; None for fewer than three frames."""
    n = len(frame_means)
    if n < 3:
        return None
    known = [one for one in times_s if one is not None]
    x = np.array(known if len(known) == n else range(n), np.float64)
    slope, error, _ = straight_line(x, frame_means)
    duration = float(x[-1] - x[0])
    return Drift(slope, error, slope * duration, error * duration)


def fit_transfer(levels: Sequence[float], means: Sequence[float]) -> Transfer:
    """Fit a straight line to the means of patches of at least two different levels by least squares."""
    x, y = np.array(levels, np.float64), np.array(means, np.float64)
    gain, error, rest = straight_line(x, y)
    reach = float(np.ptp(y))
    nonlinearity = float(np.abs(rest).max()) / reach if reach > 0 else 0.0
    return Transfer(gain, error if len(x) > 2 else None, float(y.mean() - gain * x.mean()), nonlinearity)


def straight_line(x: FloatArray, y: FloatArray) -> tuple[float, float, FloatArray]:
    """Fit a straight line by least squares: its slope, the standard error (NaN with two points), the residuals."""
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    rest = y - y.mean() - slope * centred
    return slope, math.sqrt(float(rest @ rest) / (len(x) - 2) / spread) if len(x) > 2 else math.nan, rest


class FrameSums:
    """Sums over frames that the mean squares need.

    Differences from the first frame are summed: the parts with t are the same in them, and their squares do not
    lose digits to a mean that is a thousand times the noise.
    """

    def __init__(self, first: FloatArray) -> None:
        self.reference = first
        self.n = 0
        self.frame_means: list[float] = []
        self._sum = np.zeros_like(first)
        self._squares = np.zeros_like(first)
        self._of_rows = self._of_columns = 0.0

    def add(self, frame: FloatArray) -> None:
        """Add a frame."""
        difference = frame - self.reference
        rows, columns = difference.mean(1), difference.mean(0)
        self.frame_means.append(float(rows.mean()))
        self._of_rows += float(rows @ rows)
        self._of_columns += float(columns @ columns)
        self._sum += difference
        difference *= difference
        self._squares += difference
        self.n += 1

    def level(self) -> None:
        """Take a plane, fitted by least squares, from the mean image; its mean and the noise over time stay."""
        image, axes = self.mean_image(), np.indices(self.reference.shape, np.float64)
        for ramp in axes - axes.mean(axis=(1, 2), keepdims=True):
            self.reference = self.reference - ramp * float((ramp * image).sum() / (ramp**2).sum())

    def means(self) -> FloatArray:
        """Return the mean of each frame."""
        return np.array(self.frame_means) + float(self.reference.mean())

    def mean_image(self) -> FloatArray:
        """Return the mean of each pixel."""
        return self.reference + self._sum / self.n

    def temporal_sd(self) -> FloatArray:
        """Return the standard deviation of each pixel over time."""
        return np.sqrt(np.maximum(self._squares - self._sum**2 / self.n, 0.0) / (self.n - 1))

    def mean_squares(self) -> tuple[dict[str, float], dict[str, int]]:
        """Return the mean squares and degrees of freedom of the parts."""
        (v, h), t = self.reference.shape, self.n
        image = self.mean_image()
        rows, columns = image.mean(1), image.mean(0)
        mean = float(image.mean())
        rest = image - rows[:, np.newaxis] - columns + mean
        sums = {
            "v": t * h * float(np.sum((rows - mean) ** 2)),
            "h": t * v * float(np.sum((columns - mean) ** 2)),
            "vh": t * float(np.sum(rest**2)),
        }
        degrees = {"v": v - 1, "h": h - 1, "vh": (v - 1) * (h - 1)}
        if t > 1:
            drift = np.array(self.frame_means)
            still = self._sum / t
            still_rows, still_columns = still.mean(1), still.mean(0)
            of_frames = float(np.sum((drift - drift.mean()) ** 2))
            # Sums over frames of squared deviations from the mean over frames: of row means, column means, pixels.
            of_rows = self._of_rows - t * float(still_rows @ still_rows)
            of_columns = self._of_columns - t * float(still_columns @ still_columns)
            of_pixels = float(np.sum(self._squares - t * still**2))
            sums["t"] = v * h * of_frames
            sums["tv"] = h * of_rows - sums["t"]
            sums["th"] = v * of_columns - sums["t"]
            sums["tvh"] = of_pixels - sums["t"] - sums["tv"] - sums["th"]
            degrees |= {"t": t - 1, "tv": (t - 1) * (v - 1), "th": (t - 1) * (h - 1)}
            degrees["tvh"] = (t - 1) * (v - 1) * (h - 1)
        return {name: max(one, 0.0) / degrees[name] for name, one in sums.items()}, degrees


def checked_region(recording: Recording, region: Region | None) -> Region:
    """Return the region, or the whole frame; SettingsError if it is too small, or not within the frame."""
    rows, columns = recording.shape
    left, top, width, height = region or (0, 0, columns, rows)
    if left < 0 or top < 0 or width < 2 or height < 2 or left + width > columns or top + height > rows:
        raise SettingsError(
            f"region: found {left},{top},{width},{height} (x, y, width, height), expected at least 2 x 2 pixels "
            f"within the frame of {columns} x {rows}"
        )
    return left, top, width, height


def _warnings(noise: Noise3D, gathered: _Gathered) -> Iterator[RecordingWarning]:
    last = gathered.last
    assert last is not None
    saturated = gathered.n_saturated / (noise.n_frames * last.size)
    of_pixels = noise.parts.get("tvh")
    if noise.n_frames == 1:
        yield RecordingWarning(
            "one_frame",
            "one frame: its temporal noise cannot be separated from its fixed pattern, and a scene that is not "
            "uniform counts as noise; record at least 2 frames, better 100",
        )
    if gathered.n_doubled:
        yield RecordingWarning(
            "doubled_frames",
            f"{gathered.n_doubled} of {noise.n_frames} frames repeat the frame before: temporal noise comes out "
            "too low; record at the camera's own frame rate",
        )
    if saturated > MOST_SATURATED:
        yield RecordingWarning(
            "saturated",
            f"{100 * saturated:.2g} % of the values are at an end of the scale: their noise is cut; change "
            "exposure or gain, or choose a region",
        )
    if last.dtype.kind == "u" and of_pixels is not None and of_pixels.sd < 0.5:
        yield RecordingWarning(
            "quantised",
            f"the noise of pixels ({of_pixels.sd:.2g}) is below half a step of the recording: rounding decides "
            "its size; record with more bits or gain",
        )
    drift = noise.drift
    if drift is None or of_pixels is None:
        return
    if abs(drift.change) > max(DRIFT_ERRORS * drift.change_error, of_pixels.sd / 2):
        yield RecordingWarning(
            "drift",
            f"the mean drifts by {drift.change:.3g} over the recording, against {of_pixels.sd:.3g} of noise of "
            "pixels: it is contained in t; warm the camera up, or record for a shorter time",
        )
