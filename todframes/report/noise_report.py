"""The noise of a recording as numbers, sentences, a picture and a part of a SENSOR.toml."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.recordings.noise3d import PARTS, Noise3D, NoisePart
from todframes.report.data import ResultWarning
from todframes.report.figure_style import COLOURS, INK, label_text, style
from todframes.report.result import Plotting, Result
from todframes.report.table import Column, Table
from todframes.report.wording import interval_phrase, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


VALUE_UNITS = {"code": "code values", "counts": "counts", "celsius": "°C"}

SHOWN_PERCENTILES = (0.5, 99.5)
"""Percentiles of an image that are shown darkest and brightest."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseResult(Plotting):
    """The noise of a recording, with methods that make text, figures and files of it.

    `plot` draws the parts of the noise with their 95 % intervals.

    Attributes
    ----------
    measured : Noise3D
        The numbers and images.
    recording : str
        Path of the recording.
    mk_per_unit : float or None
        Temperature difference in mK for a difference of one in the values; None if it is not known.
    signals : tuple of float
        Differences of the values, of which signal-to-noise ratios are asked for.
    """

    measured: Noise3D
    recording: str
    mk_per_unit: float | None
    signals: tuple[float, ...]
    started: float

    def __repr__(self) -> str:
        return f"<Noise of {self.recording}: {' '.join(self.sentences())}>"

    @property
    def warnings(self) -> tuple[ResultWarning, ...]:
        """Properties of the recording that make its noise less certain, each with a code."""
        return tuple(ResultWarning(code=one.code, message=one.message) for one in self.measured.warnings)

    def table(self) -> Table:
        """Return the parts of the noise, a row for each, and the dynamic and fixed noise of a pixel."""
        noise = self.measured
        named = dict(noise.parts)
        meanings = dict(PARTS)
        if noise.dynamic is not None and noise.fixed is not None:
            named |= {"dynamic": noise.dynamic, "fixed pattern": noise.fixed}
            meanings |= {"dynamic": "tv, th and tvh together", "fixed pattern": "v, h and vh together"}
        else:
            meanings = {name: f"{PARTS[name]} and from frame to frame" for name in named}
        records = [
            {"part": name, "meaning": meanings[name], "sd": one.sd, "sd_ci95": one.ci95, "sd_mk": self._mk(one.sd)}
            for name, one in named.items()
        ]
        columns = [
            Column(key="part", is_name=True),
            Column(key="sd", header=f"SD ({VALUE_UNITS[noise.unit]})"),
            Column(key="sd_ci95", header="95 % interval", interval="sd_ci95"),
            Column(key="sd_mk", header="SD (mK)"),
            Column(key="meaning", rank=1, wraps=True),
        ]
        return Table.of(f"Noise of {self.recording}", "noise.csv", columns, records).without_empty_columns()

    def snr_table(self) -> Table | None:
        """Return the signal-to-noise ratios of the signals asked for; None if there are none."""
        if not self.signals:
            return None
        columns = [
            Column(key="signal"),
            Column(key="frames", header="frames averaged"),
            Column(key="snr", header="SNR"),
        ]
        return Table.of("Signal-to-noise ratio of a pixel", "snr.csv", columns, self._snr())

    def patch_table(self) -> Table | None:
        """Return the mean, noise and signal-to-noise ratio of each patch; None if there are none."""
        if not self.measured.patches:
            return None
        records = [
            {"level": one.level, "mean": one.mean, "dynamic": _sd(one.dynamic), "fixed_pattern": _sd(one.fixed)}
            | {"snr": one.snr}
            for one in self.measured.patches
        ]
        headers = {"level": "level", "mean": "mean", "dynamic": "dynamic SD", "fixed_pattern": "fixed SD"}
        columns = [Column(key=key, header=header) for key, header in headers.items()]
        columns.append(Column(key="snr", header="SNR against the first"))
        return Table.of("Patches", "patches.csv", columns, records)

    def more_tables(self) -> list[Table]:
        """Return the tables of what was asked for besides the parts."""
        return [one for one in (self.snr_table(), self.patch_table()) if one is not None]

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        noise = self.measured
        count = f"{noise.n_frames} frame{'s' * (noise.n_frames > 1)}"
        found = [f"Mean {plain(noise.mean, 5)} {VALUE_UNITS[noise.unit]} in {count}."]
        if noise.dynamic is not None and noise.fixed is not None:
            found.append(
                f"Noise of a pixel: dynamic {self._with_unit(noise.dynamic)}, "
                f"fixed pattern {self._with_unit(noise.fixed)}."
            )
        else:
            found.append(f"Spatial noise of a pixel: {self._with_unit(noise.parts['vh'])}.")
        if noise.drift is not None:
            per = "s" if noise.frames_per_second is not None else "frame"
            found.append(
                f"Drift of the mean: {plain(noise.drift.slope)} ± {plain(noise.drift.slope_error, 2)} per {per}, "
                f"{plain(noise.drift.change)} in all."
            )
        if (transfer := noise.transfer) is not None:
            error = "" if transfer.gain_error is None else f" ± {plain(transfer.gain_error, 2)}"
            per_unit = f"{plain(transfer.gain, 4)}{error} {VALUE_UNITS[noise.unit]} per unit of level"
            deviation = f"{plain(100 * transfer.nonlinearity, 2)} % of its range"
            found.append(
                f"Signal transfer: {per_unit}; patches deviate from a straight line by up to {deviation}."
            )
        return found

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml for a camera with this noise.

        Raises
        ------
        DataError
            If there is one frame, or no noise from frame to frame.
        """
        return self.measured.sensor_toml(mk_per_unit=self.mk_per_unit)

    def to_json(self) -> bytes:
        """Return one JSON object of the same form as the results of other commands, with the key `noise`."""
        noise = self.measured
        two_or_more = noise.dynamic is not None and noise.dynamic.variance > 0
        found: Json = {
            "recording": self.recording,
            "unit": noise.unit,
            "n_frames": noise.n_frames,
            "frames_per_second": noise.frames_per_second,
            "region": list(noise.region),
            "mean": noise.mean,
            "parts": {name: self._json(one) for name, one in noise.parts.items()},
            "dynamic": self._json(noise.dynamic),
            "fixed_pattern": self._json(noise.fixed),
            "fixed_pattern_ratio": self._ratio_json() if two_or_more else None,
            "drift": None if noise.drift is None else noise.drift._asdict(),
            "mk_per_unit": self.mk_per_unit,
            "snr": self._snr(),
            "patches": [
                one._asdict() | {"dynamic": self._json(one.dynamic), "fixed": self._json(one.fixed)}
                for one in noise.patches
            ],
            "signal_transfer": None if noise.transfer is None else noise.transfer._asdict(),
        }
        return Result.made("noise", self.started, noise=found, warnings=self.warnings).to_json()

    def figure(self) -> Figure:
        """Return a figure of the parts, the means of frames, the mean image and the temporal noise of pixels."""
        from matplotlib.figure import Figure

        with style():
            unit, temporal_sd = VALUE_UNITS[self.measured.unit], self.measured.temporal_sd
            n_rows = 1 if temporal_sd is None else 2
            figure = Figure(figsize=(9.6, 3.2 * n_rows), layout="constrained")
            (bars, mean), *more = figure.subplots(n_rows, 2, squeeze=False)
            self.draw(bars)
            _draw_image(mean, self.measured.mean_image, "Mean of each pixel", unit)
            if temporal_sd is not None:
                self._draw_means(more[0][0])
                _draw_image(more[0][1], temporal_sd, "SD of each pixel from frame to frame", unit)
            figure.suptitle(label_text(Path(self.recording).name), fontsize="medium")
        return figure

    def _repr_html_(self) -> str:
        from todframes.report.html import notebook_page

        return notebook_page(self.sentences(), self.table(), [(self.figure, "Noise of the recording")])

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name; without a table for a sensor if dynamic noise is not known."""
        from todframes.report.figures import figure_png

        dynamic = self.measured.dynamic
        known = dynamic is not None and dynamic.variance > 0
        return {
            "noise.csv": self.table().csv().encode(),
            **{one.file: one.csv().encode() for one in self.more_tables()},
            "noise.png": figure_png(self.figure()),
            **({"sensor_noise.toml": self.sensor_toml().encode()} if known else {}),
            "result.json": self.to_json(),
        }

    def _mk(self, sd: float) -> float | None:
        per_unit = 1000.0 if self.measured.unit == "celsius" else self.mk_per_unit
        return None if per_unit is None else sd * per_unit

    def _with_unit(self, part: NoisePart) -> str:
        text = f"{plain(part.sd)} ({interval_phrase(part.ci95, 3)}) {VALUE_UNITS[self.measured.unit]}"
        in_mk = self._mk(part.sd)
        return text if in_mk is None else f"{text} = {plain(in_mk)} mK"

    def _snr(self) -> list[Json]:
        counts = dict.fromkeys((1, self.measured.frames_integrated))
        return [
            {"signal": signal, "frames": n, "snr": self.measured.snr(signal, frames=n)}
            for signal in self.signals
            for n in counts
        ]

    def _json(self, part: NoisePart | None) -> Json | None:
        if part is None:
            return None
        values = {"sd": part.sd, "sd_ci95": list(part.ci95), "variance": part.variance}
        in_mk = self._mk(part.sd)
        return values if in_mk is None else values | {"sd_mk": in_mk}

    def _ratio_json(self) -> Json:
        ratio = self.measured.fixed_pattern_ratio
        return {"ratio": ratio.sd, "ratio_ci95": list(ratio.ci95)}

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set; `plot` sets that of all figures."""
        names = list(self.measured.parts)
        parts = [self.measured.parts[name] for name in names]
        heights = [one.sd for one in parts]
        errors = [
            [max(one.sd - one.ci95[0], 0.0) for one in parts],
            [max(min(one.ci95[1], 3 * max(heights)) - one.sd, 0.0) for one in parts],
        ]
        axes.bar(names, heights, color=COLOURS[0], width=0.6)
        axes.errorbar(names, heights, yerr=errors, fmt="none", ecolor=INK, elinewidth=1.0, capsize=3)
        axes.set(title="Parts of the noise, with 95 % intervals", ylabel=f"SD ({VALUE_UNITS[self.measured.unit]})")
        axes.title.set_fontsize("medium")

    def _draw_means(self, axes: Axes) -> None:
        noise = self.measured
        rate = noise.frames_per_second
        axes.plot(
            np.arange(noise.n_frames) / (rate or 1.0), noise.frame_means, ".", markersize=3, color=COLOURS[1]
        )
        axes.set(
            title="Mean of each frame", xlabel="time (s)" if rate else "frame", ylabel=VALUE_UNITS[noise.unit]
        )
        axes.ticklabel_format(useOffset=False)
        axes.title.set_fontsize("medium")


def _sd(part: NoisePart | None) -> float | None:
    return None if part is None else part.sd


def _draw_image(axes: Axes, image: FloatArray, title: str, unit: str) -> None:
    low, high = np.percentile(image, SHOWN_PERCENTILES)
    shown = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axes.set_title(title, fontsize="medium")
    axes.grid(visible=False)
    figure = axes.figure
    figure.colorbar(shown, ax=axes, label=unit, format="%.5g")


def noise_result(
    measured: Noise3D,
    recording: str,
    *,
    mk_per_unit: float | None = None,
    signals: tuple[float, ...] = (),
    started: float | None = None,
) -> NoiseResult:
    """Return the result of a measurement that began at a time of `time.perf_counter`."""
    return NoiseResult(
        measured=measured,
        recording=recording,
        mk_per_unit=mk_per_unit,
        signals=signals,
        started=time.perf_counter() if started is None else started,
    )
