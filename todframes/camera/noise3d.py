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
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, SettingsError
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS
from todframes.frames.ends import ValueEnds
from todframes.parameters import Box, Progress, counted
from todframes.recordings.recording import RecordedFrame, Recording, RecordingWarning, frames_integrated

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

MOST_SATURATED = 1e-3
"""Largest share of values at the ends of the scale that gives no warning."""

LEAST_STEPS = 0.41
"""Noise in steps, without that of rounding, below which rounding changes the variance, σ² + 1/12, by more than a
tenth: by up to (4 σ² + 1/π²) exp(−2π² σ²). It is a total of half a step."""

REPEATED = 0.1
"""Largest mean square of the step to a repeated frame, relative to that of the steps between other frames."""

EVENT_ERRORS, LEAST_EVENT = 6.0, 0.05
"""Scatter of the mean squares of steps from which one is a change of the pattern, and its least share of their
median."""

DRIFT_ERRORS = 5.0
"""Standard errors of a drift from which it counts."""

DRAWS, SEED = 4000, 1288
"""Number of draws behind an interval, whose ends then vary by 2 % of its half-width, and the seed: the same frames
always have the same intervals."""


class NoisePart(Struct, frozen=True, omit_defaults=True):
    """A part of the noise: standard deviation, its 95 % interval, variance, and in mK if that is known.

    An unbiased estimate of a variance can be below zero; then `sd` is 0.
    """

    sd: float
    ci95: tuple[float, float] = field(name="sd_ci95")
    variance: float
    sd_mk: float | None = None

    @classmethod
    def of(cls, drawn: FloatArray, mk_per_unit: float | None) -> NoisePart:
        """Return the part whose variance and its draws are given."""
        sd, ends = with_interval(root(drawn))
        return cls(sd, ends, float(drawn[0]), None if mk_per_unit is None else sd * mk_per_unit)


class FramePatch(NamedTuple):
    """A uniform part of the frame of known luminance, reflectance or temperature."""

    region: Box
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


class Snr(Struct, frozen=True, kw_only=True):
    """Signal-to-noise ratio of a pixel in the mean of some frames; None without noise."""

    signal: float
    frames: int
    snr: float | None


class NoiseNumbers(Struct, frozen=True, kw_only=True):
    """The key `noise` of the result.

    Attributes
    ----------
    recording, unit : str
        Path of the recording, and the unit of its values: "code", "counts", "celsius", or "relative" to white.
    n_frames, frames_per_second
        Number of frames, and their rate if it is known.
    region : tuple of int
        Part of the frame that was measured: left column, top row, width, height.
    mean : float
        Mean value.
    parts : dict of NoisePart
        The seven parts of the noise: t, v, h, tv, th, vh, tvh. Of a single frame v, h and vh, which contains tvh.
    dynamic, fixed_pattern : NoisePart or None
        tv, th and tvh together; v, h and vh together. None for a single frame.
    fixed_pattern_ratio : dict or None
        Fixed pattern divided by dynamic noise: `ratio` and `ratio_ci95`.
    drift : Drift or None
        Drift of the mean; None with fewer than three frames.
    mk_per_unit : float or None
        Temperature difference in mK for one unit of the values.
    snr : tuple of Snr
        With `--signal`: the ratio for each difference of values.
    patches, signal_transfer
        With `--patch` or `--chart`: the patches, and the straight line through their means.
    """

    recording: str
    unit: str
    n_frames: int
    frames_per_second: float | None
    region: Box
    mean: float
    parts: dict[str, NoisePart]
    dynamic: NoisePart | None
    fixed_pattern: NoisePart | None
    fixed_pattern_ratio: dict[str, Any] | None
    drift: Drift | None
    mk_per_unit: float | None
    snr: tuple[Snr, ...]
    patches: tuple[PatchNoise, ...]
    signal_transfer: Transfer | None

    def noise_table(self) -> Json:
        """Return the table `[noise]` of a SENSOR.toml for a camera with this noise.

        It has no `netd_mk` if mK are not known. DataError if there is one frame, or no noise from frame to frame.
        """
        if self.dynamic is None:
            raise DataError(
                "noise: found one frame, expected 2 or more: one cannot separate temporal noise from fixed pattern"
            )
        if self.fixed_pattern_ratio is None:
            raise DataError("noise: found none from frame to frame, expected some; are all frames the same?")
        netd_mk, fixed_ratio = self.dynamic.sd_mk, float(f"{self.fixed_pattern_ratio['ratio']:.6g}")
        return {
            "distribution": "gaussian",
            **({} if netd_mk is None else {"netd_mk": float(f"{netd_mk:.6g}")}),
            "fixed_pattern_ratio": fixed_ratio,
            "frames_integrated": frames_integrated(self.frames_per_second),
            **self._line_ratios(self.dynamic, row_noise_ratio="tv", column_noise_ratio="th", most=1.0),
            **self._line_ratios(self.dynamic, row_pattern_ratio="v", column_pattern_ratio="h", most=fixed_ratio),
        }

    def _line_ratios(self, dynamic: NoisePart, *, most: float, **names: str) -> dict[str, float]:
        """Return parts that rows and columns have in common over the dynamic noise, by keys of a SENSOR.toml.

        Those whose interval begins at 0 are left out. Together they are `most` or less.
        """
        parts = {key: self.parts[part] for key, part in names.items() if self.parts[part].ci95[0] > 0.0}
        ratios = {key: part.sd / dynamic.sd for key, part in parts.items()}
        scale = min(1.0, most / math.hypot(*ratios.values())) if ratios else 1.0
        return {key: float(f"{scale * ratio:.6g}") for key, ratio in ratios.items()}


def sum_frames(
    recording: Recording, boxes: Sequence[Box | None], progress: Progress | None
) -> tuple[list[FrameSums], list[float | None]]:
    """Return the sums over frames in each region, and the times of the frames."""
    each, times = [FrameSums(recording, box) for box in boxes], []
    for frame in counted(recording.frames(), recording.n_frames, progress):
        times.append(frame.time_s)
        for sums in each:
            sums.add(frame.values)
    return each, times


def only_frames(recording: Recording, numbers: Collection[int], *warnings: RecordingWarning) -> Recording:
    """Return the frames of a recording with these numbers, and its warnings with these added."""
    kept = frozenset(numbers)

    def read() -> Iterator[RecordedFrame]:
        every = islice(recording.frames(), max(kept) + 1)
        return (frame for number, frame in enumerate(every) if number in kept)

    return replace(recording, n_frames=len(kept), warnings=(*recording.warnings, *warnings), read=read)


def steady_part(recording: Recording, sums: FrameSums) -> Recording:
    """Return a recording without frames that repeat the one before, and the longest part without a new pattern.

    `sums` are those of all its frames. Both are warnings.
    """
    steps, numbers = np.array(sums.steps), np.arange(sums.n)
    is_new = np.append(True, ~_are_repeats(steps))
    if n_repeats := int(np.count_nonzero(~is_new)):
        found = f"{n_repeats} of {sums.n} frames repeat the frame before"
        if is_new.sum() < 2:
            message = f"{found}: no temporal noise is left; record at the camera's own frame rate"
            return replace(recording, warnings=(*recording.warnings, RecordingWarning("doubled_frames", message)))
        rate = recording.frames_per_second
        rate = None if rate is None else rate * int(is_new.sum()) / sums.n
        at_rate = "" if rate is None else f" at {rate:.4g} frames/s"
        message = f"{found} and were left out: measured are {is_new.sum()}{at_rate}"
        numbers, steps = numbers[is_new], steps[is_new[1:]]
        recording = only_frames(recording, numbers.tolist(), RecordingWarning("doubled_frames", message))
        recording = replace(recording, frames_per_second=rate)
    starts = [0, *_new_patterns(steps, sums.reference.size).tolist(), len(numbers)]
    first, end = max(pairwise(starts), key=lambda run: run[1] - run[0])
    if end - first == len(numbers):
        return recording
    after = ", ".join(str(numbers[start]) for start in starts[1:-1])
    message = (
        f"the fixed pattern changes after {after} of {sums.n} frames, as by a shutter: measured is the longest "
        f"part without a change, {end - first} frames"
    )
    return only_frames(recording, range(first, end), RecordingWarning("pattern_changes", message))


def _are_repeats(steps: FloatArray) -> NDArray[np.bool_]:
    """Return which steps lead to a frame that was delivered again, perhaps with a few values changed.

    The others are like one another: the largest step that is not alone by a factor of `REPEATED` is one of them.
    """
    order = np.sort(steps)
    alike = np.arange(1, len(order) + 1) - np.searchsorted(order, REPEATED * order, side="right")
    usual = order[alike >= max(2.0, 0.05 * len(order))]
    return np.asarray(steps <= (REPEATED * usual[-1] if len(usual) else 0.0))


def _new_patterns(steps: FloatArray, n_pixels: int) -> NDArray[np.intp]:
    """Return the frames with which a new fixed pattern begins: the step to them is larger than others.

    Two such steps in succession are of one frame that differs, which leaves no new pattern.
    """
    if not len(steps):
        return np.zeros(0, np.intp)
    usual = float(np.median(steps))
    scatter = max(float(np.median(np.abs(steps - usual))) / 0.6745, usual * math.sqrt(2.0 / n_pixels))
    is_large = steps - usual > max(EVENT_ERRORS * scatter, LEAST_EVENT * usual)
    beside = np.append(is_large[1:], False) | np.append(False, is_large[:-1])
    return np.asarray(1 + np.flatnonzero(is_large & ~beside))


def luma(values: NDArray[Any]) -> FloatArray:
    """Return the values of a frame, (rows, columns), of colours their luma (Rec. 709)."""
    return np.asarray(values.astype(np.float64) if values.ndim == 2 else values @ REC_709_LUMINANCE_WEIGHTS)


def snr_of(signal: float, parts: Mapping[str, NoisePart], n_averaged: int = 1) -> float:
    """Return a signal divided by the noise of a pixel after a number of frames are averaged.

    The dynamic part falls with the root of the number of frames, the fixed pattern does not.
    """
    variances = {name: max(part.variance, 0.0) for name, part in parts.items()}
    if "dynamic" in parts:
        total = variances["dynamic"] / n_averaged + variances["fixed_pattern"]
    else:
        total = sum(variances.values())
    return signal / math.sqrt(total) if total > 0 else math.inf


def variances_of(squares: Mapping[str, Any], n_frames: int, n_rows: int, n_columns: int) -> dict[str, Any]:
    """Return the variance of each part, a weighted sum of mean squares: unbiased, so that it can be below zero.

    The expected mean squares with T frames, V rows and H columns, σ² of the part in brackets:
    tvh: [tvh]; tv: [tvh] + H [tv]; th: [tvh] + V [th]; vh: [tvh] + T [vh];
    t: [tvh] + H [tv] + V [th] + VH [t]; v: [tvh] + H [tv] + T [vh] + TH [v]; h: [tvh] + V [th] + T [vh] + TV [h].
    They are solved from the first to the last. For one frame there are v, h and vh, which contains tvh; of two or
    more also "dynamic" and "fixed_pattern", the sums of their parts.
    """
    t, v, h, ms = n_frames, n_rows, n_columns, squares
    if t == 1:
        return {"v": (ms["v"] - ms["vh"]) / h, "h": (ms["h"] - ms["vh"]) / v, "vh": ms["vh"]}
    variances = {
        "t": (ms["t"] - ms["tv"] - ms["th"] + ms["tvh"]) / (v * h),
        "v": (ms["v"] - ms["tv"] - ms["vh"] + ms["tvh"]) / (t * h),
        "h": (ms["h"] - ms["th"] - ms["vh"] + ms["tvh"]) / (t * v),
        "tv": (ms["tv"] - ms["tvh"]) / h,
        "th": (ms["th"] - ms["tvh"]) / v,
        "vh": (ms["vh"] - ms["tvh"]) / t,
        "tvh": ms["tvh"],
    }
    dynamic = variances["tv"] + variances["th"] + variances["tvh"]
    return variances | {"dynamic": dynamic, "fixed_pattern": variances["v"] + variances["h"] + variances["vh"]}


def root(variance: FloatArray) -> FloatArray:
    """Return standard deviations; 0 for variances below zero."""
    return np.sqrt(np.maximum(variance, 0.0))


def with_interval(drawn: FloatArray) -> tuple[float, tuple[float, float]]:
    """Return the first of some values, and the 95 % interval of the others, its draws."""
    low, high = np.quantile(drawn[1:], (0.025, 0.975)).tolist()
    return float(drawn[0]), (low, high)


def fit_drift(frame_means: FloatArray, times_s: list[float | None]) -> Drift | None:
    """Fit a straight line to the means of frames by least squares; None for fewer than three frames."""
    n = len(frame_means)
    if n < 3:
        return None
    known = [time for time in times_s if time is not None]
    x = np.array(known if len(known) == n else range(n), np.float64)
    slope, error, _ = straight_line(x, frame_means)
    duration = float(x[-1] - x[0])
    return Drift(slope, error, slope * duration, error * duration)


def fit_transfer(patches: Sequence[PatchNoise]) -> Transfer:
    """Fit a straight line to the means of patches of at least two different levels by least squares."""
    x, y = np.array([(patch.level, patch.mean) for patch in patches], np.float64).T
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
    """Sums over frames that the mean squares of a region need, and counts of what makes its noise doubtful.

    Differences from the first frame are summed: the parts with t are the same in them, and their squares do not
    lose digits to a mean that is a thousand times the noise. SettingsError if the region is too small, or not
    within the frame.
    """

    def __init__(self, recording: Recording, region: Box | None) -> None:
        rows, columns = recording.shape
        left, top, width, height = self.region = region or (0, 0, columns, rows)
        if left < 0 or top < 0 or width < 2 or height < 2 or left + width > columns or top + height > rows:
            raise SettingsError(
                f"region: found {left},{top},{width},{height} (x, y, width, height), expected at least 2 x 2 "
                f"pixels within the frame of {columns} x {rows}"
            )
        self.ends = ValueEnds(*(recording.ends or ()))
        self.n = 0
        self.reference, self._sum, self._squares, self._last = (np.zeros((height, width)) for _ in range(4))
        self.frame_means: list[float] = []
        self.steps: list[float] = []
        self._of_rows = self._of_columns = 0.0
        self.is_whole = False

    def add(self, frame: NDArray[Any]) -> None:
        """Add a frame."""
        left, top, width, height = self.region
        values = frame[top : top + height, left : left + width]
        self.ends.add(values)
        self.is_whole = values.dtype.kind == "u"
        grey = luma(values)
        if self.n:
            step = (grey - self._last).ravel()
            self.steps.append(max(float(step @ step) / step.size - float(step.mean()) ** 2, 0.0))
        else:
            self.reference = grey
        self._last = grey
        difference = grey - self.reference
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
        return {name: max(square_sum, 0.0) / degrees[name] for name, square_sum in sums.items()}, degrees

    def drawn_squares(self, rng: np.random.Generator) -> dict[str, FloatArray]:
        """Return the mean squares, each followed by `DRAWS` draws of the expected one.

        Those of Gaussian parts are independent, and times degrees of freedom over expectation they are χ². What is
        computed of the draws has an interval in their quantiles: generalised pivotal quantities, which hold for
        sums, differences and ratios. Weerahandi 1993; Hannig, Iyer & Patterson 2006.
        """
        squares, degrees = self.mean_squares()
        return {
            name: square * np.append(1.0, degrees[name] / rng.chisquare(degrees[name], DRAWS))
            for name, square in squares.items()
        }

    def variances(self) -> dict[str, FloatArray]:
        """Return the variance of each part by `variances_of`, followed by its draws, which never change."""
        squares = self.drawn_squares(np.random.default_rng(SEED))
        return variances_of(squares, self.n, *self.reference.shape)


def warnings_of(sums: FrameSums, of_pixels: NoisePart, drift: Drift | None) -> Iterator[RecordingWarning]:
    """Yield what makes the noise of a region doubtful, from that of its pixels and the drift of its mean."""
    bottom, top, where = sums.ends.cut(of_pixels.sd)
    step = sums.ends.step or float(sums.is_whole)
    if sums.n == 1:
        yield RecordingWarning(
            "one_frame",
            "one frame: its temporal noise cannot be separated from its fixed pattern, and a scene that is not "
            "uniform counts as noise; record at least 2 frames, better 100",
        )
    if bottom + top > MOST_SATURATED:
        yield RecordingWarning(
            "saturated",
            f"{100 * (bottom + top):.3g} % of the values are at an end of the scale ({where}): their noise is "
            "cut; change exposure or gain, or choose a region",
        )
    if sums.n > 1 and of_pixels.sd**2 - step**2 / 12.0 < (LEAST_STEPS * step) ** 2:
        yield RecordingWarning(
            "quantised",
            f"the noise of pixels ({of_pixels.sd:.2g}) is half a step of the values ({step:.4g}) or less: "
            "rounding decides its size; record with more bits or gain",
        )
    if drift and abs(drift.change) > max(DRIFT_ERRORS * drift.change_error, of_pixels.sd / 2):
        yield RecordingWarning(
            "drift",
            f"the mean drifts by {drift.change:.3g} over the recording, against {of_pixels.sd:.3g} of noise of "
            "pixels: it is contained in t; warm the camera up, or record for a shorter time",
        )
