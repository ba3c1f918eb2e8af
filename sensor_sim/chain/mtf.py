"""The call `mtf`: the modulation transfer of every stage of a sensor, as a record, a table and a figure."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sensor_sim.chain.camera import resolve_without_light
from sensor_sim.chain.sensor import Sensor, sensor_of
from sensor_sim.chain.transfer import optics_otf, stages
from todframes.base.reading import checked
from todframes.camera.mtf_table import MtfLine, Resolution, draw_mtf
from todframes.observers.hotelling import HotellingSettings
from todframes.parameters import SensorFile
from todframes.results.figures import COLOURS, INK, ReportFigure
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


POINTS, TABLE_STEP, NEAR_POINTS = 201, 20, 21
"""Number of frequencies, up to the one at which optics or display pass nothing, step of those in the table, and
number of those within a step of MTF10."""

SHOWN_NYQUISTS = 3.0
"""Highest frequency in the figure, in units of the Nyquist frequency."""

MTF_NOTE = (
    "Solid: before sampling; dashed: behind it. Thick: all stages before, and behind, together. Stages of the "
    "same transfer share a line."
)

# Stages before sampling are solid, those after it dashed; the two products are thick.
LINES = {
    "diffraction": (COLOURS[0], "-"),
    "optics_blur": (COLOURS[1], "-"),
    "measured_optics": (COLOURS[0], "-"),
    "motion": (COLOURS[6], "-"),
    "turbulence": (COLOURS[3], "-"),
    "detector": (COLOURS[2], "-"),
    "hold": (COLOURS[3], "--"),
    "electronics": (COLOURS[4], "--"),
    "display": (COLOURS[5], "--"),
    "pre_sample": (INK, "-"),
    "post_sample": (INK, "--"),
}


class SensorMtf(Result, frozen=True, kw_only=True):
    """Transfer of every stage of a sensor along x.

    Attributes
    ----------
    sensor : str
        The sensor's name.
    cut_off_cyc_per_mrad, nyquist_cyc_per_mrad : float
        Cut-off of the optics and Nyquist frequency of the detectors.
    frequency_cyc_per_mrad : list of float
        Frequencies in cycles/mrad, up to the one at which optics or display pass nothing.
    mtf : dict of list of float
        Transfer of each stage at these frequencies, and of all stages before and after sampling.
    mtf10_cyc_per_mrad : float or None
        Frequency at which the MTF before sampling falls to 0.1.
    resolution_limit_cyc_per_mrad : float or None
        The smaller one of MTF10 and the Nyquist frequency.
    aliased_from_cyc_per_mrad : float or None
        1 / pitch − MTF10: patterns beyond the Nyquist frequency appear from here on. None if MTF10 is not beyond.
    """

    sensor: str
    cut_off_cyc_per_mrad: float
    nyquist_cyc_per_mrad: float
    frequency_cyc_per_mrad: list[float]
    mtf: dict[str, list[float]]
    mtf10_cyc_per_mrad: float | None = None
    resolution_limit_cyc_per_mrad: float | None = None
    aliased_from_cyc_per_mrad: float | None = None

    json_file: ClassVar[str] = "mtf.json"  # so that it goes beside a curve
    page_file: ClassVar[str] = "mtf.html"

    @property
    def name(self) -> str:
        """Return the sensor's name."""
        return self.sensor

    def table(self) -> Table:
        """Return the table of all frequencies."""
        title = (
            f"{self.sensor}: MTF along x; optics' cut-off {self.cut_off_cyc_per_mrad:.4g}, "
            f"Nyquist {self.nyquist_cyc_per_mrad:.4g} cycles/mrad"
        )
        names = ["frequency_cyc_per_mrad", *self.mtf]
        values = [self.frequency_cyc_per_mrad, *self.mtf.values()]
        records = [dict(zip(names, row, strict=True)) for row in zip(*values, strict=True)]
        # A narrow terminal first drops the stages that are usually 1; the two products stay.
        ranks = {"electronics": 3, "optics_blur": 3, "hold": 2, "display": 2, "diffraction": 1, "detector": 1}
        columns = [
            Column(key=names[0], header="cycles/mrad", decimals=2),
            *(Column(key=name, header=name, decimals=4, rank=ranks.get(name, 0)) for name in self.mtf),
        ]
        return Table.of(title, "mtf.csv", columns, records)

    def tables(self) -> list[Table]:
        """List some frequencies, and folded all of them."""
        whole = self.table()
        return [
            replace(whole, file="", records=whole.records[::TABLE_STEP]),
            replace(whole, title="All frequencies").folded(),
        ]

    def findings(self) -> list[str]:
        """Return the transfer at the Nyquist frequency in words."""
        nyquist, cut_off = self.nyquist_cyc_per_mrad, self.cut_off_cyc_per_mrad
        before, behind = (
            float(np.interp(nyquist, self.frequency_cyc_per_mrad, self.mtf[name]))
            for name in ("pre_sample", "post_sample")
        )
        sentences = [
            f"At the Nyquist frequency, {plain(nyquist)} cycles/mrad, the MTF is {plain(before)} before sampling "
            f"and {plain(behind)} behind it; the optics pass nothing above {plain(cut_off)} cycles/mrad."
        ]
        resolution = Resolution(
            self.mtf10_cyc_per_mrad, self.resolution_limit_cyc_per_mrad, self.aliased_from_cyc_per_mrad
        )
        return sentences + resolution.sentences("cycles/mrad", nyquist)

    def figures(self) -> list[ReportFigure]:
        """List the transfer of all stages up to three times the Nyquist frequency."""
        return [ReportFigure(f"{self.sensor}: MTF along x", MTF_NOTE, self._draw, "mtf.png")]

    def _draw(self, axes: Axes) -> None:
        nyquist = self.nyquist_cyc_per_mrad
        alike: dict[object, list[str]] = {}
        for name, values in self.mtf.items():
            # A product of stages has its own line, also where it is that of a single stage.
            key = name if name.endswith("_sample") else tuple(np.round(values, 6))
            alike.setdefault(key, []).append(name)
        lines = []
        for names in alike.values():
            colour, line = LINES.get(names[0], (COLOURS[-1], "-"))
            style = {"color": colour, "ls": line, "lw": 2.4 if names[0].endswith("_sample") else 1.3}
            label = " and ".join(names).replace("_", " ")
            lines.append(MtfLine(label=label, mtf=self.mtf[names[0]], style=style))
        draw_mtf(
            axes,
            self.frequency_cyc_per_mrad,
            lines,
            end=SHOWN_NYQUISTS * nyquist,
            marks={"Nyquist": nyquist, "optics' cut-off": self.cut_off_cyc_per_mrad},
            xlabel="frequency in the scene (cycles/mrad)",
            ylabel="MTF along x",
        )


@checked
def mtf(sensor: Sensor | SensorFile) -> SensorMtf:
    """Compute the modulation transfer of every stage along x, before and after sampling.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.

    Returns
    -------
    Result
        `frequency_cyc_per_mrad` and `mtf`, a list for each stage; `plot()` draws them.

    Raises
    ------
    SettingsError
        If the sensor's file is invalid.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> transfer = ss.mtf("sample_frames/staring_camera.toml")
    >>> round(transfer.nyquist_cyc_per_mrad, 2), [*transfer.mtf][:2]
    (7.34, ['diffraction', 'optics_blur'])
    """
    started = time.perf_counter()
    sensor = sensor_of(sensor)
    camera = resolve_without_light(sensor)
    cut_off, nyquist = camera.optics.cut_off_cyc_per_mrad, camera.nyquist_cyc_per_mrad
    frequency = np.linspace(0.0, min(1.05 * cut_off, 10.0 * nyquist), POINTS)
    of_stages = stages(frequency, camera=camera)
    resolution = Resolution.of(frequency, of_stages["pre_sample"], nyquist)
    if resolution.mtf10 is not None:
        near = np.abs(resolution.mtf10 + frequency[1] * np.linspace(-1.0, 1.0, NEAR_POINTS))
        resolution = Resolution.of(near, stages(near, camera=camera)["pre_sample"], nyquist)
    return SensorMtf.made(
        "sensor-mtf",
        started,
        sensor=sensor.name,
        cut_off_cyc_per_mrad=cut_off,
        nyquist_cyc_per_mrad=nyquist,
        frequency_cyc_per_mrad=frequency.tolist(),
        mtf={name: values.tolist() for name, values in of_stages.items()},
        mtf10_cyc_per_mrad=resolution.mtf10,
        resolution_limit_cyc_per_mrad=resolution.limit,
        aliased_from_cyc_per_mrad=resolution.aliased_from,
    )


@checked
def matched_settings(sensor: Sensor, **others: Any) -> HotellingSettings:
    """Return the settings of the observer `informative` that describe a sensor and its display.

    The observer makes its templates from these settings. Optics are replaced by the Gaussian blur with the same
    transfer at the detectors' Nyquist frequency, or at half the optics' cut-off if that is lower.

    Parameters
    ----------
    sensor : Sensor
        The sensor to match.
    **others
        Any other settings, such as internal_noise. If `sample_noise_sd` is given, as the display's gain divided by
        a signal-to-noise ratio, the weights are ideal for that noise too.

    Returns
    -------
    HotellingSettings
        Settings for `HotellingObserver`.

    Raises
    ------
    SettingsError
        If a value is out of its range.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> import todframes as tod
    >>> sensor = ss.load_sensor("sample_frames/star_like.toml")
    >>> result = ss.curve(sensor, size_detectors=[5], observer=tod.HotellingObserver(ss.matched_settings(sensor)))
    """
    camera = resolve_without_light(sensor)
    optics = camera.optics
    as_seen = sensor.magnification
    frequency = min(camera.nyquist_cyc_per_mrad, optics.cut_off_cyc_per_mrad / 2.0)
    transfer = max(float(np.abs(optics_otf(frequency, 0.0, optics=optics))), 1e-300)
    return HotellingSettings(
        presample_blur_mrad=as_seen * math.sqrt(-math.log(transfer) / 2.0) / (math.pi * frequency),
        sample_width_mrad=as_seen * camera.width_mrad,
        sample_pitch_mrad=camera.shown_pitch_mrad,
        display_blur_mrad=sensor.display.pixel_pitch_mrad * math.hypot(*camera.blurs_px),
        **others,
    )
