"""Noise of a camera by EMVA 1288 as numbers, sentences, pictures, XML and a part of a SENSOR.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from todframes.base._typing import Json
from todframes.base.errors import argument, for_reader
from todframes.base.reading import toml_text
from todframes.recordings.emva import EmvaNoise, Estimate, StackNoise
from todframes.recordings.emva_xml import emva_xml
from todframes.recordings.noise3d import MOST_SATURATED
from todframes.report.data import ResultWarning
from todframes.report.figure_style import COLOURS, INK, PAPER, add_legend, label_text, plain_ticks, style
from todframes.report.result import Plotting, Result
from todframes.report.table import Column, Table
from todframes.report.wording import count, interval_phrase, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURES = (
    ("system_gain", "system gain K", "DN/e⁻", 1.0),
    ("quantum_efficiency", "quantum efficiency", "%", 100.0),
    ("responsivity", "responsivity R", "DN/photon", 1.0),
    ("dark_noise", "dark noise", "e⁻", 1.0),
    ("dark_noise_dn", "dark noise", "DN", 1.0),
    ("dark_current", "dark current", "e⁻/s", 1.0),
    ("dark_current_from_variance", "dark current, from variances", "e⁻/s", 1.0),
    ("dsnu", "DSNU", "e⁻", 1.0),
    ("prnu", "PRNU", "%", 1.0),
    ("saturation_electrons", "saturation", "e⁻", 1.0),
    ("saturation_photons", "saturation", "photons", 1.0),
    ("sensitivity_threshold", "least detectable signal", "photons", 1.0),
    ("background_electrons", "background of the chart", "e⁻", 1.0),
)
"""Attributes of `EmvaNoise` with their names, units, and factors to these units."""

VARIANCES = (
    ("temporal_stack", "temporal"),
    ("spatial", "spatial"),
    ("row", "spatial: rows"),
    ("column", "spatial: columns"),
    ("pixel", "spatial: pixels"),
)

SNR_SPAN = (0.5, 2.0)
"""Ends of the curves of signal-to-noise ratio, relative to the fewest and the most photons."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EmvaResult(Plotting):
    """The noise of a camera by EMVA 1288, with methods that make text, figures and files of it.

    `plot` draws the signal-to-noise ratio against the ideal one.

    Attributes
    ----------
    measured : EmvaNoise
        The numbers.
    source : str
        Path of the descriptor, or of the first bright stack.
    """

    measured: EmvaNoise
    source: str
    started: float

    def __repr__(self) -> str:
        return f"<EMVA 1288 of {self.source}: {' '.join(self.sentences())}>"

    @property
    def warnings(self) -> tuple[ResultWarning, ...]:
        """Properties of the stacks that make the figures less certain, each with a code."""
        return tuple(ResultWarning(code=one.code, message=one.message) for one in self.measured.warnings)

    def table(self) -> Table:
        """Return the figures of the camera, a row for each that is known."""
        records = []
        for key, name, unit, factor in FIGURES:
            one: Estimate | None = getattr(self.measured, key)
            if one is not None:
                ends = None if one.ci95 is None else (factor * one.ci95[0], factor * one.ci95[1])
                records.append({"figure": name, "value": factor * one.value, "unit": unit, "value_ci95": ends})
        columns = [
            Column(key="figure", is_name=True),
            Column(key="value"),
            Column(key="unit"),
            Column(key="value_ci95", header="95 % interval", interval="value_ci95"),
        ]
        return Table.of(f"EMVA 1288 of {self.source}", "emva.csv", columns, records)

    def variance_table(self) -> Table:
        """Return the temporal and spatial variances of the bright and dark stacks of the spatial measurement."""
        bright, dark = self.measured.bright, self.measured.dark
        records = [
            {"variance": name, "bright": getattr(bright, key), "dark": getattr(dark, key)}
            for key, name in VARIANCES
        ]
        columns = [
            Column(key="variance", is_name=True),
            Column(key="bright", header="bright (DN²)"),
            Column(key="dark", header="dark (DN²)"),
        ]
        return Table.of(f"Variances at a mean of {plain(bright.mean, 4)} DN", "variances.csv", columns, records)

    def points_table(self) -> Table:
        """Return the points of photon transfer, a row for each bright stack, by increasing signal."""
        records = [
            {
                "exposure_ms": one.bright.exposure_ms,
                "photons": one.bright.photons,
                "n_frames": one.bright.n_frames,
                "signal_dn": one.signal,
                "variance_dn2": one.variance,
                "snr": one.snr,
                "is_fitted": one.is_fitted,
            }
            for one in self.measured.points
        ]
        headers = {
            "exposure_ms": "exposure (ms)",
            "photons": "photons",
            "n_frames": "frames",
            "signal_dn": "signal (DN)",
            "variance_dn2": "variance (DN²)",
            "snr": "SNR",
            "is_fitted": "in the fit",
        }
        columns = [Column(key=key, header=header) for key, header in headers.items()]
        return Table.of("Photon transfer", "photon_transfer.csv", columns, records).without_empty_columns()

    def more_tables(self) -> list[Table]:
        """Return the table that the command prints below the figures."""
        return [self.variance_table()]

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        found = self.measured
        n_fitted = sum(one.is_fitted for one in found.points)
        gain = f"{plain(found.system_gain.value, 4)} DN per electron{_interval(found.system_gain)}"
        stacks = f"{count(n_fitted, 'bright stack')} of {len(found.points)}"
        texts = [f"System gain {gain}, from {stacks}."]
        texts.append(
            f"A pixel has a dark noise of {plain(found.dark_noise.value)} electrons{_interval(found.dark_noise)}, "
            f"DSNU {plain(found.dsnu.value)} electrons{_interval(found.dsnu)} and PRNU {plain(found.prnu.value)} "
            f"%{_interval(found.prnu)}."
        )
        if found.saturation_electrons is not None and found.snr_max is not None:
            where = "" if found.is_saturation_reached else ", at the end of the scale"
            texts.append(
                f"It saturates at {plain(found.saturation_electrons.value, 4)} electrons{where}: an SNR of up to "
                f"{plain(found.snr_max)}."
            )
        if found.linearity_percent is not None:
            low, high = found.linearity_percent
            texts.append(f"Linearity errors are {plain(low, 2)} to {plain(high, 2)} %.")
        return texts

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml for this camera, with the model `photon`.

        With the film of a chart it has the table `[scene]` too, with the electrons of the background.
        """
        table, background = self.measured.camera().noise_table(), self.measured.background_electrons
        needs_photons = "quantum_efficiency" not in table and background is None
        hints = ["quantum_efficiency is not known: give photons"] if needs_photons else []
        hints += (
            []
            if "exposure_ms" in table
            else [for_reader(f"exposure_ms is not known: give {argument.exposure_ms}")]
        )
        if not self.measured.is_saturation_reached and "full_well_electrons" in table:
            hints.append("full_well_electrons is the end of the scale: no stack was saturated")
        tables: Json = {"noise": table}
        if background is not None:
            luminance = self.measured.background_cd_m2
            tables["scene"] = {
                "luminance_cd_m2": luminance,
                "background_electrons": float(f"{background.value:.6g}"),
            }
        return toml_text(tables, comment="\n".join(hints))

    def xml(self) -> bytes:
        """Return a result file of EMVA 1288."""
        return emva_xml(self.measured.xml_values())

    def to_json(self) -> bytes:
        """Return one JSON object of the same form as the results of other commands, with the key `noise`."""
        found = self.measured
        figures: Json = {}
        for key, _, _, _ in FIGURES:
            one: Estimate | None = getattr(found, key)
            figures[key] = None if one is None else one.value
            figures[f"{key}_ci95"] = None if one is None or one.ci95 is None else list(one.ci95)
        noise: Json = {
            "emva1288": {
                "source": self.source,
                "bits": found.bits,
                "exposure_ms": found.exposure_ms,
                **figures,
                "snr_max": found.snr_max,
                "dynamic_range": found.dynamic_range,
                "linearity_percent": found.linearity_percent,
                "is_saturation_reached": found.is_saturation_reached,
                "bright": _variances(found.bright),
                "dark": _variances(found.dark),
                "points": self.points_table().records,
            }
        }
        return Result.made("noise", self.started, noise=noise, warnings=self.warnings).to_json()

    def figure(self) -> Figure:
        """Return a figure of the photon transfer and of the signal-to-noise ratio against the ideal one."""
        from matplotlib.figure import Figure

        with style():
            figure = Figure(figsize=(9.6, 4.2), layout="constrained")
            transfer, snr = figure.subplots(1, 2)
            self._draw_transfer(transfer)
            self.draw(snr)
            figure.suptitle(label_text(Path(self.source).name), fontsize="medium")
        return figure

    def _repr_html_(self) -> str:
        from todframes.report.html import notebook_page

        return notebook_page(self.sentences(), self.table(), [(self.figure, "Photon transfer and SNR")])

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name."""
        from todframes.report.figures import figure_png

        tables = (self.table(), self.points_table(), self.variance_table())
        return {
            **{one.file: one.csv().encode() for one in tables},
            "emva.png": figure_png(self.figure()),
            "emva.xml": self.xml(),
            "sensor_noise.toml": self.sensor_toml().encode(),
            "result.json": self.to_json(),
        }

    def _draw_transfer(self, axes: Axes) -> None:
        points, gain = self.measured.points, self.measured.system_gain.value
        for is_fitted, face, label in ((True, COLOURS[0], "in the fit"), (False, PAPER, "beyond it")):
            shown = [(one.signal, one.variance) for one in points if one.is_fitted == is_fitted]
            if shown:
                axes.plot(*zip(*shown, strict=True), "o", color=COLOURS[0], mfc=face, markersize=4, label=label)
        signal = np.array([0.0, max(one.signal for one in points)])
        axes.plot(signal, gain * signal, color=COLOURS[4], label=f"K = {plain(gain, 4)} DN/e⁻", zorder=1)
        axes.set(title="Photon transfer", xlabel="signal above dark (DN)", ylabel="variance above dark (DN²)")
        axes.title.set_fontsize("medium")
        most = max(one.variance for one in points)
        axes.set_ylim(min(0.0, *(one.variance for one in points)) - 0.03 * most, 1.12 * most)
        add_legend(axes)

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set; `plot` sets that of all figures."""
        found = self.measured
        efficiency = found.quantum_efficiency
        # Without a quantum efficiency the abscissa is electrons; ideal is the camera that counts all of them.
        per_photon = 1.0 if efficiency is None else efficiency.value
        points = [one for one in found.points if one.signal > 0.0 and one.bright.saturated <= MOST_SATURATED]
        x = np.array([one.signal / found.system_gain.value / per_photon for one in points])
        light = np.geomspace(SNR_SPAN[0] * x.min(), SNR_SPAN[1] * x.max(), 200)
        axes.plot(light, np.sqrt(light), color=INK, ls=":", label="ideal: every photon counts")
        axes.plot(light, found.snr(light * per_photon), color=COLOURS[0], label="temporal noise")
        total = found.snr(light * per_photon, with_spatial=True)
        axes.plot(light, total, color=COLOURS[4], ls="--", label="with DSNU and PRNU")
        axes.plot(x, [one.snr for one in points], "o", color=COLOURS[0], markersize=4, label="measured")
        what = "electrons" if efficiency is None else "photons"
        axes.set(
            xscale="log", yscale="log", title="Signal-to-noise ratio", xlabel=f"{what} of a pixel", ylabel="SNR"
        )
        axes.title.set_fontsize("medium")
        plain_ticks(axes.yaxis, np.sqrt(light).tolist())
        add_legend(axes)


def _interval(one: Estimate) -> str:
    return "" if one.ci95 is None else f" ({interval_phrase(one.ci95)})"


def _variances(stack: StackNoise) -> Json:
    names = ("n_frames", "mean", "temporal", "temporal_stack", "spatial_measured")
    return {name: getattr(stack, name) for name in (*names, *(key for key, _ in VARIANCES[1:]))}
