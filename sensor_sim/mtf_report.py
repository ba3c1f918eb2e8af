"""Transfer functions of a sensor as a record, a table and a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.transfer import band_limit_cyc_per_mrad, stages
from todframes import __version__
from todframes.report.data import json_file
from todframes.report.figure_style import COLOURS, INK
from todframes.report.figures import ReportFigure
from todframes.report.mtf_figure import MtfLine, draw_mtf
from todframes.report.result import Plotting
from todframes.report.table import Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes


POINTS = 201

TABLE_STEP = 20

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
    "detector": (COLOURS[2], "-"),
    "hold": (COLOURS[3], "--"),
    "electronics": (COLOURS[4], "--"),
    "display": (COLOURS[5], "--"),
    "pre_sample": (INK, "-"),
    "post_sample": (INK, "--"),
}


class SensorMtf(msgspec.Struct, Plotting, frozen=True, kw_only=True):
    """Transfer of every stage of a sensor along x; its fields are the keys of the command's JSON.

    `plot` draws the transfer of all stages up to three times the Nyquist frequency.

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
    """

    schema: int = 1
    command: str = "mtf"
    version: str = __version__
    sensor: str
    cut_off_cyc_per_mrad: float
    nyquist_cyc_per_mrad: float
    frequency_cyc_per_mrad: list[float]
    mtf: dict[str, list[float]]

    def to_json(self) -> bytes:
        """Return the record as indented JSON."""
        return json_file(self)

    def table(self, step: int = 1) -> Table:
        """Return the table of every `step`-th frequency."""
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
        return Table.of(title, "mtf.csv", columns, records[::step])

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set; `plot` sets that of all figures."""
        nyquist = self.nyquist_cyc_per_mrad
        alike: dict[object, list[str]] = {}
        for name, values in self.mtf.items():
            # A product of stages has its own line, also where it is that of a single stage.
            key = name if name.endswith("_sample") else tuple(np.round(values, 6))
            alike.setdefault(key, []).append(name)
        lines = []
        for names in alike.values():
            colour, line = LINES[names[0]]
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

    def files(self) -> dict[str, bytes]:
        """Return the content of `mtf.csv` and `mtf.png`, by name."""
        picture = ReportFigure(self.sensor, MTF_NOTE, self.draw, "mtf.png")
        return {"mtf.csv": self.table().csv().encode(), picture.file: picture.png()}


def sensor_mtf(sensor: Sensor) -> SensorMtf:
    """Compute the transfer of every stage along x, up to the frequency at which optics or display pass nothing."""
    optics = sensor.optics
    cut_off = optics.cut_off_cyc_per_mrad if optics.is_modelled else band_limit_cyc_per_mrad(optics)
    nyquist = sensor.detector.nyquist_cyc_per_mrad
    frequency = np.linspace(0.0, min(1.05 * cut_off, 10.0 * nyquist), POINTS)
    return SensorMtf(
        sensor=sensor.name,
        cut_off_cyc_per_mrad=cut_off,
        nyquist_cyc_per_mrad=nyquist,
        frequency_cyc_per_mrad=frequency.tolist(),
        mtf={name: values.tolist() for name, values in stages(frequency, sensor=sensor).items()},
    )
