"""The noise of a recording as tables, sentences, figures and a part of a SENSOR.toml."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from msgspec import Struct

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError
from todframes.camera.noise3d import PARTS, Noise3D, NoisePart
from todframes.results.data import Content, ResultWarning, as_read
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import COLOURS, INK
from todframes.results.result import Result
from todframes.results.table import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


VALUE_UNITS = {"code": "code values", "counts": "counts", "celsius": "°C"}

SHOWN_PERCENTILES = (0.5, 99.5)
"""Percentiles of an image that are shown darkest and brightest."""

COMBINED = {"dynamic": "tv, th and tvh together", "fixed pattern": "v, h and vh together"}


class Part(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A part of the noise: standard deviation, its 95 % interval, and in mK if that is known."""

    sd: float
    sd_ci95: tuple[float | None, float | None]
    variance: float
    sd_mk: float | None = None


class Line(Struct, frozen=True, kw_only=True):
    """Drift of the mean per second, or per frame if there are no times."""

    slope: float
    slope_error: float | None
    change: float
    change_error: float | None


class Snr(Struct, frozen=True, kw_only=True):
    """Signal-to-noise ratio of a pixel in the mean of some frames; None without noise."""

    signal: float
    frames: int
    snr: float | None


class MeasuredPatch(Struct, frozen=True, kw_only=True):
    """A patch, and the ratio of its difference from the first one to its noise."""

    level: float
    mean: float
    dynamic: Part | None
    fixed: Part | None
    snr: float | None


class SignalTransfer(Struct, frozen=True, kw_only=True):
    """The straight line through the means of patches; see `todframes.camera.noise3d.Transfer`."""

    gain: float
    gain_error: float | None
    offset: float
    nonlinearity: float


class NoiseNumbers(Struct, frozen=True, kw_only=True):
    """The key `noise` of the result.

    Attributes
    ----------
    recording, unit : str
        Path of the recording, and the unit of its values: "code", "counts" or "celsius".
    n_frames, frames_per_second
        Number of frames, and their rate if it is known.
    region : tuple of int
        Part of the frame that was measured: left column, top row, width, height.
    mean : float
        Mean value.
    parts : dict of Part
        The seven parts of the noise: t, v, h, tv, th, vh, tvh.
    dynamic, fixed_pattern : Part or None
        tv, th and tvh together; v, h and vh together.
    fixed_pattern_ratio : dict or None
        Fixed pattern divided by dynamic noise: `ratio` and `ratio_ci95`.
    drift : Line or None
        Drift of the mean.
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
    region: tuple[int, int, int, int]
    mean: float
    parts: dict[str, Part]
    dynamic: Part | None
    fixed_pattern: Part | None
    fixed_pattern_ratio: dict[str, Any] | None
    drift: Line | None
    mk_per_unit: float | None
    snr: tuple[Snr, ...]
    patches: tuple[MeasuredPatch, ...]
    signal_transfer: SignalTransfer | None


class RecordedNoise(Content, frozen=True, kw_only=True):
    """The noise of a recording.

    Attributes
    ----------
    noise : NoiseNumbers
        The numbers.
    measured : Noise3D or None
        The measurement with its images; None for a result that was read.
    """

    noise: NoiseNumbers

    measured: ClassVar[Noise3D | None] = None

    @property
    def name(self) -> str:
        """Return the path of the recording."""
        return self.noise.recording

    def tables(self) -> list[Table]:
        """List the parts of the noise, then the signal-to-noise ratios and the patches that were asked for."""
        noise, title = self.noise, f"Noise of {path_name(self.noise.recording)}"
        named, meanings = dict(noise.parts), PARTS | COMBINED
        if noise.dynamic is not None and noise.fixed_pattern is not None:
            named |= {"dynamic": noise.dynamic, "fixed pattern": noise.fixed_pattern}
        else:
            meanings = {name: f"{PARTS[name]} and from frame to frame" for name in named}
        records = [
            {"part": name, "meaning": meanings[name], "sd": one.sd, "sd_ci95": one.sd_ci95, "sd_mk": one.sd_mk}
            for name, one in named.items()
        ]
        columns = [
            Column(key="part", is_name=True),
            Column(key="sd", header=f"SD ({VALUE_UNITS[noise.unit]})"),
            Column(key="sd_ci95", header="95 % interval", interval="sd_ci95"),
            Column(key="sd_mk", header="SD (mK)"),
            Column(key="meaning", rank=1, wraps=True),
        ]
        found = [Table.of(title, "noise.csv", columns, records).without_empty_columns()]
        if noise.snr:
            of_snr = [{"signal": one.signal, "frames": one.frames, "snr": one.snr} for one in noise.snr]
            columns = [Column(key="signal"), Column(key="frames", header="frames averaged")]
            columns.append(Column(key="snr", header="SNR"))
            found.append(Table.of("Signal-to-noise ratio of a pixel", "snr.csv", columns, of_snr))
        if noise.patches:
            of_patches = [
                {"level": one.level, "mean": one.mean, "dynamic": _sd(one.dynamic)}
                | {"fixed_pattern": _sd(one.fixed), "snr": one.snr}
                for one in noise.patches
            ]
            columns = [Column(key="level"), Column(key="mean"), Column(key="dynamic", header="dynamic SD")]
            columns.append(Column(key="fixed_pattern", header="fixed SD"))
            columns.append(Column(key="snr", header="SNR against the first"))
            found.append(Table.of("Patches", "patches.csv", columns, of_patches))
        return found

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        noise, unit = self.noise, VALUE_UNITS[self.noise.unit]
        if noise.dynamic is not None and noise.fixed_pattern is not None:
            dynamic, fixed = map(self._with_unit, (noise.dynamic, noise.fixed_pattern))
            found = [f"Noise of a pixel: dynamic {dynamic}, fixed pattern {fixed}."]
        else:
            found = [f"Spatial noise of a pixel: {self._with_unit(noise.parts['vh'])}."]
        found.append(f"Mean {plain(noise.mean, 5)} {unit} in {count(noise.n_frames, 'frame')}.")
        if noise.drift is not None:
            per = "s" if noise.frames_per_second is not None else "frame"
            found.append(
                f"Drift of the mean: {plain(noise.drift.slope)} ± {plain(noise.drift.slope_error, 2)} per {per}, "
                f"{plain(noise.drift.change)} in all."
            )
        if (transfer := noise.signal_transfer) is not None:
            error = "" if transfer.gain_error is None else f" ± {plain(transfer.gain_error, 2)}"
            found.append(
                f"Signal transfer: {plain(transfer.gain, 4)}{error} {unit} per unit of level; patches deviate "
                f"from a straight line by up to {plain(100 * transfer.nonlinearity, 2)} % of its range."
            )
        return found

    def figures(self) -> list[ReportFigure]:
        """List the parts; of a new measurement also means of frames, mean image and temporal noise of pixels."""
        found = [ReportFigure("Parts of the noise", "With 95 % intervals.", self._draw_parts, "noise.png")]
        if (measured := self.measured) is None:
            return found
        unit = VALUE_UNITS[measured.unit]
        images = {"mean": ("Mean of each pixel", measured.mean_image)}
        if measured.temporal_sd is not None:
            images["temporal_sd"] = ("SD of each pixel from frame to frame", measured.temporal_sd)
            draw = partial(_draw_means, measured=measured)
            found.append(ReportFigure("Mean of each frame", "", draw, "frame_means.png"))
        for file, (title, image) in images.items():
            found.append(ReportFigure(title, "", partial(_draw_image, image=image, unit=unit), f"{file}.png"))
        return found

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml for a camera with this noise.

        Raises
        ------
        DataError
            If there is one frame, no noise from frame to frame, or the result was read from a file.
        """
        if self.measured is None:
            raise DataError("noise: the result was read from a file, whose folder has sensor_noise.toml")
        return self.measured.sensor_toml(mk_per_unit=self.noise.mk_per_unit)

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the tables, and a table for a sensor if dynamic noise is known."""
        dynamic = None if self.measured is None else self.measured.dynamic
        known = dynamic is not None and dynamic.variance > 0
        return {**super().files(), **({"sensor_noise.toml": self.sensor_toml().encode()} if known else {})}

    def _with_unit(self, part: Part) -> str:
        text = f"{plain(part.sd)} ({interval_phrase(part.sd_ci95, 3)}) {VALUE_UNITS[self.noise.unit]}"
        return text if part.sd_mk is None else f"{text} = {plain(part.sd_mk)} mK"

    def _draw_parts(self, axes: Axes) -> None:
        names, parts = list(self.noise.parts), list(self.noise.parts.values())
        most = 3 * max(one.sd for one in parts)
        ends = [(one.sd_ci95[0] or 0.0, most if one.sd_ci95[1] is None else one.sd_ci95[1]) for one in parts]
        errors = [
            [max(one.sd - low, 0.0) for one, (low, _) in zip(parts, ends, strict=True)],
            [max(min(high, most) - one.sd, 0.0) for one, (_, high) in zip(parts, ends, strict=True)],
        ]
        axes.bar(names, [one.sd for one in parts], color=COLOURS[0], width=0.6)
        axes.errorbar(
            names, [one.sd for one in parts], yerr=errors, fmt="none", ecolor=INK, elinewidth=1.0, capsize=3
        )
        axes.set(ylabel=f"SD ({VALUE_UNITS[self.noise.unit]})")


def _sd(part: Part | None) -> float | None:
    return None if part is None else part.sd


def _draw_means(axes: Axes, measured: Noise3D) -> None:
    rate = measured.frames_per_second
    times = np.arange(measured.n_frames) / (rate or 1.0)
    axes.plot(times, measured.frame_means, ".", markersize=3, color=COLOURS[1])
    axes.set(xlabel="time (s)" if rate else "frame", ylabel=VALUE_UNITS[measured.unit])
    axes.ticklabel_format(useOffset=False)


def _draw_image(axes: Axes, image: FloatArray, unit: str) -> None:
    low, high = np.percentile(image, SHOWN_PERCENTILES)
    shown = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axes.grid(visible=False)
    axes.figure.colorbar(shown, ax=axes, label=unit, format="%.5g")


def noise_result(
    measured: Noise3D, recording: str, *, started: float, mk_per_unit: float | None, signals: tuple[float, ...]
) -> Result[RecordedNoise]:
    """Return the result of a measurement that began at a time of `time.perf_counter`.

    `mk_per_unit` is the temperature difference in mK for a difference of one in the values, if it is known;
    `signals` are differences whose signal-to-noise ratios are asked for.
    """
    per_unit = 1000.0 if measured.unit == "celsius" else mk_per_unit

    def part(one: NoisePart | None) -> Json | None:
        if one is None:
            return None
        in_mk = {} if per_unit is None else {"sd_mk": one.sd * per_unit}
        return {"sd": one.sd, "sd_ci95": one.ci95, "variance": one.variance} | in_mk

    ratio = None
    if measured.dynamic is not None and measured.dynamic.variance > 0:
        ratio = measured.fixed_pattern_ratio
    noise = {
        "recording": recording,
        "unit": measured.unit,
        "n_frames": measured.n_frames,
        "frames_per_second": measured.frames_per_second,
        "region": measured.region,
        "mean": measured.mean,
        "parts": {name: part(one) for name, one in measured.parts.items()},
        "dynamic": part(measured.dynamic),
        "fixed_pattern": part(measured.fixed),
        "fixed_pattern_ratio": None if ratio is None else {"ratio": ratio.sd, "ratio_ci95": ratio.ci95},
        "drift": None if measured.drift is None else measured.drift._asdict(),
        "mk_per_unit": mk_per_unit,
        "snr": [
            {"signal": signal, "frames": n, "snr": measured.snr(signal, frames=n)}
            for signal in signals
            for n in dict.fromkeys((1, measured.frames_integrated))
        ],
        "patches": [
            one._asdict() | {"dynamic": part(one.dynamic), "fixed": part(one.fixed)} for one in measured.patches
        ],
        "signal_transfer": None if measured.transfer is None else measured.transfer._asdict(),
    }
    warnings = [ResultWarning(code=one.code, message=one.message) for one in measured.warnings]
    made = Result.made("noise", started, warnings=warnings, noise=as_read(noise, NoiseNumbers))
    return made.holding(measured=measured)
