"""Noise of a camera by EMVA 1288 as tables, sentences, figures, XML and a part of a SENSOR.toml."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import argument
from todframes.base.reading import toml_text
from todframes.camera.emva import EmvaNumbers, Ends
from todframes.camera.emva_xml import emva_xml
from todframes.recordings.recording import RecordingWarning
from todframes.results.data import Content, ResultWarning, as_read
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import COLOURS, INK, PAPER, add_legend, plain_ticks
from todframes.results.result import Result
from todframes.results.table import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
"""Figures of a camera by key, with their names, units, and factors to these units."""

VARIANCES = (
    ("temporal_stack", "temporal"),
    ("spatial", "spatial"),
    ("row", "spatial: rows"),
    ("column", "spatial: columns"),
    ("pixel", "spatial: pixels"),
)

SNR_SPAN = (0.5, 2.0)
"""Ends of the curves of signal-to-noise ratio, relative to the fewest and the most photons."""


class EmvaKey(Struct, frozen=True, kw_only=True):
    """The key `noise` of the result."""

    emva1288: EmvaNumbers


class Emva(Content, frozen=True, kw_only=True):
    """The noise of a camera by EMVA 1288.

    Attributes
    ----------
    noise : EmvaKey
        The numbers, under the key `emva1288`.
    """

    noise: EmvaKey

    @property
    def name(self) -> str:
        """Return the path of the descriptor, or of the first bright stack."""
        return self.noise.emva1288.source

    def tables(self) -> list[Table]:
        """List the figures of the camera that are known, its variances, and folded the points."""
        found = self.noise.emva1288
        records = []
        for key, name, unit, factor in FIGURES:
            value: float | None = getattr(found, key)
            if value is not None:
                ends: Ends | None = getattr(found, f"{key}_ci95")
                scaled = None if ends is None else tuple(None if end is None else factor * end for end in ends)
                records.append({"figure": name, "value": factor * value, "unit": unit, "value_ci95": scaled})
        columns = [
            Column(key="figure", is_name=True),
            Column(key="value"),
            Column(key="unit"),
            Column(key="value_ci95", header="95 % interval", interval="value_ci95"),
        ]
        variances = [
            {"variance": name, "bright": getattr(found.bright, key), "dark": getattr(found.dark, key)}
            for key, name in VARIANCES
        ]
        of_variances = [
            Column(key="variance", is_name=True),
            Column(key="bright", header="bright (DN²)"),
            Column(key="dark", header="dark (DN²)"),
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
        points = [{key: getattr(one, key) for key in headers} for one in found.points]
        of_points = [Column(key=key, header=header) for key, header in headers.items()]
        title = f"Variances at a mean of {plain(found.bright.mean, 4)} DN"
        transfer = Table.of("Photon transfer", "photon_transfer.csv", of_points, points).without_empty_columns()
        return [
            Table.of(f"EMVA 1288 of {path_name(found.source)}", "emva.csv", columns, records),
            Table.of(title, "variances.csv", of_variances, variances),
            transfer.folded(),
        ]

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        found = self.noise.emva1288

        def known(key: str, unit: str, digits: int = 3) -> str:
            ends: Ends | None = getattr(found, f"{key}_ci95")
            interval = "" if ends is None else f" ({interval_phrase(ends)})"
            return f"{plain(getattr(found, key), digits)} {unit}{interval}"

        n_fitted = sum(one.is_fitted for one in found.points)
        stacks = f"{count(n_fitted, 'bright stack')} of {len(found.points)}"
        texts = [f"System gain {known('system_gain', 'DN per electron', 4)}, from {stacks}."]
        texts.append(
            f"A pixel has a dark noise of {known('dark_noise', 'electrons')}, DSNU {known('dsnu', 'electrons')} "
            f"and PRNU {known('prnu', '%')}."
        )
        if found.saturation_electrons is not None and found.snr_max is not None:
            where = "" if found.is_saturation_reached else ", at the end of the scale"
            texts.append(
                f"It saturates at {plain(found.saturation_electrons, 4)} electrons{where}: an SNR of up to "
                f"{plain(found.snr_max)}."
            )
        if found.linearity_percent is not None:
            low, high = found.linearity_percent
            texts.append(f"Linearity errors are {plain(low, 2)} to {plain(high, 2)} %.")
        return texts

    def figures(self) -> list[ReportFigure]:
        """List the signal-to-noise ratio against the ideal one, and the photon transfer."""
        what = "photons" if self.noise.emva1288.quantum_efficiency is not None else "electrons"
        return [
            ReportFigure("Signal-to-noise ratio", f"Of a pixel, by its {what}.", self._draw_snr, "emva.png"),
            ReportFigure(
                "Photon transfer", "Its slope is the system gain K.", self._draw_transfer, "photon_transfer.png"
            ),
        ]

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml for this camera, with the model `photon`.

        With the film of a chart it has the table `[scene]` too, with the electrons of the background.
        """
        found = self.noise.emva1288
        table, background = found.camera().noise_table(), found.background_electrons
        needs_photons = "quantum_efficiency" not in table and background is None
        hints = ["quantum_efficiency is not known: give photons"] if needs_photons else []
        hints += [] if "exposure_ms" in table else [f"exposure_ms is not known: give {argument.exposure_ms}"]
        if not found.is_saturation_reached and "full_well_electrons" in table:
            hints.append("full_well_electrons is the end of the scale: no stack was saturated")
        tables: Json = {"noise": table}
        if background is not None:
            tables["scene"] = {
                "luminance_cd_m2": found.background_cd_m2,
                "background_electrons": float(f"{background:.6g}"),
            }
        return toml_text(tables, comment="\n".join(hints))

    def xml(self) -> bytes:
        """Return a result file of EMVA 1288."""
        return emva_xml(self.noise.emva1288.xml_values())

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the tables, the result file of EMVA 1288 and a table for a sensor."""
        return {**super().files(), "emva.xml": self.xml(), "sensor_noise.toml": self.sensor_toml().encode()}

    def snr(self, electrons: FloatArray, *, with_spatial: bool = False) -> FloatArray:
        """Return the signal-to-noise ratio of a pixel by its mean number of electrons, η μ_p for μ_p photons.

        EMVA 1288 release 4.0 linear: η μ_p / √(σ_d² + σ_q² / K² + η μ_p), and with the spatial parts DSNU² and
        (PRNU η μ_p)² under the root.
        """
        found = self.noise.emva1288
        variance = found.dark_noise**2 + found.rounding_variance_dn2 / found.system_gain**2 + electrons
        if with_spatial:
            variance = variance + found.dsnu**2 + (found.prnu / 100.0 * electrons) ** 2
        return np.asarray(electrons / np.sqrt(variance))

    def _draw_transfer(self, axes: Axes) -> None:
        points, gain = self.noise.emva1288.points, self.noise.emva1288.system_gain
        for is_fitted, face, label in ((True, COLOURS[0], "in the fit"), (False, PAPER, "beyond it")):
            shown = [(one.signal_dn, one.variance_dn2) for one in points if one.is_fitted == is_fitted]
            if shown:
                axes.plot(*zip(*shown, strict=True), "o", color=COLOURS[0], mfc=face, markersize=4, label=label)
        signal = np.array([0.0, max(one.signal_dn for one in points)])
        axes.plot(signal, gain * signal, color=COLOURS[4], label=f"K = {plain(gain, 4)} DN/e⁻", zorder=1)
        axes.set(xlabel="signal above dark (DN)", ylabel="variance above dark (DN²)")
        most = max(one.variance_dn2 for one in points)
        axes.set_ylim(min(0.0, *(one.variance_dn2 for one in points)) - 0.03 * most, 1.12 * most)
        add_legend(axes)

    def _draw_snr(self, axes: Axes) -> None:
        found = self.noise.emva1288
        # Without a quantum efficiency the abscissa is electrons; ideal is the camera that counts all of them.
        per_photon = found.quantum_efficiency or 1.0
        points = [one for one in found.points if one.signal_dn > 0.0 and not one.is_saturated]
        x = np.array([one.signal_dn / found.system_gain / per_photon for one in points])
        light = np.geomspace(SNR_SPAN[0] * x.min(), SNR_SPAN[1] * x.max(), 200)
        axes.plot(light, np.sqrt(light), color=INK, ls=":", label="ideal: every photon counts")
        axes.plot(light, self.snr(light * per_photon), color=COLOURS[0], label="temporal noise")
        total = self.snr(light * per_photon, with_spatial=True)
        axes.plot(light, total, color=COLOURS[4], ls="--", label="with DSNU and PRNU")
        axes.plot(x, [one.snr or np.inf for one in points], "o", color=COLOURS[0], markersize=4, label="measured")
        what = "electrons" if found.quantum_efficiency is None else "photons"
        axes.set(xscale="log", yscale="log", xlabel=f"{what} of a pixel", ylabel="SNR")
        plain_ticks(axes.yaxis, np.sqrt(light).tolist())
        add_legend(axes)


def emva_result(numbers: EmvaNumbers, warnings: Sequence[RecordingWarning], *, started: float) -> Result[Emva]:
    """Return the result of a measurement that began at a time of `time.perf_counter`."""
    of_codes = [ResultWarning(code=one.code, message=one.message) for one in warnings]
    return Result.made("emva", started, warnings=of_codes, noise=as_read(EmvaKey(emva1288=numbers), EmvaKey))
