"""A measured MTF as numbers, sentences, a picture and files: of slanted edges, or read from a table."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from todframes import __version__
from todframes.base._typing import FloatArray, Json
from todframes.recordings.edge_mtf import FREQUENCY_CYC_PER_PIXEL, EdgeMtf, EdgeValue
from todframes.recordings.mtf_table import (
    MAPPER_PER_CYC_PER_PIXEL,
    RADIAL,
    FrequencyUnit,
    MapperEdge,
    MtfTable,
    mtf50_of,
)
from todframes.recordings.recording import RecordingWarning
from todframes.recordings.slanted_edges import LUMA, RecordingMtf
from todframes.report.data import ResultWarning
from todframes.report.figure_style import COLOURS, INK, label_text, style
from todframes.report.figures import ReportFigure, figure_png
from todframes.report.html import figure_items, notebook_page, render, table_item
from todframes.report.mtf_figure import MtfLine, draw_mtf
from todframes.report.result import Plotting, Result
from todframes.report.table import Column, Table
from todframes.report.wording import interval_phrase, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


UNITS: dict[FrequencyUnit, str] = {
    "cyc_per_pixel": "cycles/pixel",
    "cyc_per_mrad": "cycles/mrad",
    "cyc_per_mm": "cycles/mm",
}

NYQUIST_CYC_PER_PIXEL = 0.5

LINE_COLOURS = {"red": COLOURS[5], "green": COLOURS[2], "blue": COLOURS[0], "tangential": COLOURS[4]}
"""Colours of curves; of others they follow in the order of `COLOURS`."""

SHOWN_ROWS = 16
"""Number of frequencies in the terminal, about: every eighth of the Nyquist frequency for slanted edges."""

HOW_MEASURED = (
    "Distances of pixels from the edge make a finely sampled profile, whose derivative has the MTF as its Fourier "
    "transform (ISO 12233:2023, with a fitted spline in place of bins). Overshoot and undershoot are those of the "
    "profile in means over a pixel, relative to the contrast."
)

BOX_KEYS = ("x_px", "y_px", "width_px", "height_px")

MOST_LINES = 12
"""Largest number of edges that the figure shows beside their mean."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MtfResult(Plotting):
    """A measured MTF, with methods that make text, figures and files of it. `plot` draws it with its 95 % band.

    Attributes
    ----------
    source : str
        Path of the recording or table.
    unit : {"cyc_per_pixel", "cyc_per_mrad", "cyc_per_mm"}
        Unit of the frequencies.
    frequency : ndarray (n,)
    mtf : ndarray (n,)
        Mean over all edges; of a table with tangential and sagittal values only, their mean.
    lower, upper : ndarray (n,) or None
        Ends of the 95 % band of `mtf`, for the noise of the pixels.
    others : dict of ndarray (n,)
        Further curves by name: means of "red", "green", "blue"; "tangential", "sagittal"; or "edge 1", "edge 2".
    edges : tuple of dict
        A record for each edge and colour, as in `edges.csv`.
    measured : RecordingMtf or None
        All that was measured, with the profiles of edges; None for a table.
    is_light : bool
        Whether values were converted to the luminance of a display.
    noted : tuple of RecordingWarning
        Facts that make the MTF less certain, from which `warnings` are made.
    """

    source: str
    unit: FrequencyUnit
    frequency: FloatArray
    mtf: FloatArray
    lower: FloatArray | None = None
    upper: FloatArray | None = None
    others: dict[str, FloatArray] = field(default_factory=dict)
    edges: tuple[Json, ...] = ()
    measured: RecordingMtf | None = None
    is_light: bool = False
    noted: tuple[RecordingWarning, ...] = ()
    started: float

    def __repr__(self) -> str:
        return f"<MTF of {self.source}: {' '.join(self.sentences())}>"

    @property
    def mtf50(self) -> float | None:
        """Frequency at which the MTF falls to 0.5; None if it stays above."""
        return mtf50_of(self.frequency, self.mtf)

    @property
    def mtf50_ci95(self) -> tuple[float | None, float | None] | None:
        """95 % interval of `mtf50`; an end is None where the band does not cross 0.5. None without a band."""
        if self.lower is None or self.upper is None:
            return None
        return mtf50_of(self.frequency, self.lower), mtf50_of(self.frequency, self.upper)

    @property
    def mtf_at_nyquist(self) -> float | None:
        """MTF at 0.5 cycles/pixel; None if frequencies are not those of pixels or end before."""
        if self.unit != "cyc_per_pixel" or self.frequency[-1] < NYQUIST_CYC_PER_PIXEL:
            return None
        return float(np.interp(NYQUIST_CYC_PER_PIXEL, self.frequency, self.mtf))

    @property
    def mtf_at_nyquist_ci95(self) -> tuple[float, float] | None:
        """95 % interval of `mtf_at_nyquist`; None without a band."""
        if self.mtf_at_nyquist is None or self.lower is None or self.upper is None:
            return None
        ends = (self.lower, self.upper)
        low, high = (float(np.interp(NYQUIST_CYC_PER_PIXEL, self.frequency, one)) for one in ends)
        return low, high

    @property
    def warnings(self) -> tuple[ResultWarning, ...]:
        """Properties of the recording or table that make the MTF less certain, each with a code."""
        return tuple(ResultWarning(code=one.code, message=one.message) for one in self.noted)

    def short_table(self) -> Table:
        """Return the table of about `SHOWN_ROWS` frequencies, as the command prints it."""
        return self.table(max((len(self.frequency) - 1) // SHOWN_ROWS, 1))

    def table(self, step: int = 1) -> Table:
        """Return the table of every `step`-th frequency, whose CSV `sensor_sim` reads."""
        names = [f"frequency_{self.unit}", RADIAL, "mtf_lower", "mtf_upper"]
        values: list[Any] = [self.frequency, self.mtf, self.lower, self.upper]
        for name, curve in self.others.items():
            names.append(f"mtf_{name.replace(' ', '_')}")
            values.append(curve)
        known = {name: one.tolist() for name, one in zip(names, values, strict=True) if one is not None}
        records = [dict(zip(known, row, strict=True)) for row in zip(*known.values(), strict=True)]
        columns = [
            Column(key=names[0], header=UNITS[self.unit], decimals=4 if self.unit == "cyc_per_pixel" else None),
            *(
                Column(key=name, header=name.removeprefix("mtf_").replace("_", " "), decimals=3, rank=k >= 4)
                for k, name in enumerate(names[1:], 1)
            ),
        ]
        columns = [one for one in columns if one.key in known]
        return Table.of(f"MTF of {self.source}", "mtf.csv", columns, records[::step])

    def edge_table(self, *, has_intervals: bool = False) -> Table | None:
        """Return a row for each edge and colour; None for a table that names no edges.

        With `has_intervals` all intervals are shown, in place of the boxes.
        """
        if not self.edges:
            return None
        headers = {"mtf50_cyc_per_pixel": "MTF50", "mtf_at_nyquist": "Nyquist", "angle_deg": "angle (°)"}
        headers |= {"noise_percent": "noise (%)", "bend_px": "bend (px)"}
        if has_intervals:
            headers |= {"mtf50_cyc_per_pixel": "MTF50 (cycles/pixel)", "mtf_at_nyquist": "MTF at Nyquist"}
            headers |= {key: f"{key} (of contrast)" for key in ("overshoot", "undershoot")}
            headers |= {f"{key}_ci95": "95 % interval" for key in ("mtf_at_nyquist", "overshoot", "undershoot")}
            not_shown = [*BOX_KEYS, "bend_px", "noise_percent"]
        else:
            not_shown = ["mtf_at_nyquist_ci95", "overshoot_ci95", "undershoot_ci95"]
        ranks = {"width_px": 3, "height_px": 3, "noise_percent": 2, "bend_px": 2, "undershoot": 1}
        keys = dict.fromkeys(key for one in self.edges for key in one)
        columns = [
            Column(
                key=key,
                header=headers.get(key, ""),
                digits=3,
                interval=key if key.endswith("_ci95") else "",
                in_file_only=key in ("normal_deg", "dark", "bright", *not_shown),
                is_name=key == "edge",
                rank=ranks.get(key, 0),
            )
            for key in keys
        ]
        columns = [
            Column(key=one.key, header="95 % interval", digits=3, interval=one.key)
            if one.key == "mtf50_cyc_per_pixel_ci95"
            else one
            for one in columns
        ]
        return Table.of("Edges", "edges.csv", columns, self.edges).without_empty_columns()

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        unit = UNITS[self.unit]
        mtf50, ends = self.mtf50, self.mtf50_ci95
        if mtf50 is None:
            found = [f"The MTF stays above 0.5 up to {plain(float(self.frequency[-1]))} {unit}."]
        else:
            within = "" if ends is None else f" ({interval_phrase(ends, 3)})"
            found = [f"MTF50 {plain(mtf50, 3)}{within} {unit}."]
        if (nyquist := self.mtf_at_nyquist) is not None:
            at_nyquist = self.mtf_at_nyquist_ci95
            within = "" if at_nyquist is None else f" ({interval_phrase(at_nyquist, 3)})"
            found.append(f"MTF {plain(nyquist, 3)}{within} at the Nyquist frequency, 0.5 cycles/pixel.")
        if self.measured is not None:
            n_edges, n = len(self.measured.edges), self.measured.n_frames
            found.append(f"Mean of {n_edges} edge{'s' * (n_edges > 1)} in {n} frame{'s' * (n > 1)}.")
            found.append(
                "Measured is the luminance of the display."
                if self.is_light
                else "The values were taken as proportional to light."
            )
        return found

    def to_json(self) -> bytes:
        """Return one JSON object of the same form as the results of other commands, with the key `mtf`."""
        ends, at_nyquist = self.mtf50_ci95, self.mtf_at_nyquist_ci95
        found: Json = {
            "source": self.source,
            f"frequency_{self.unit}": self.frequency.tolist(),
            "mtf": self.mtf.tolist(),
            "mtf_lower": None if self.lower is None else self.lower.tolist(),
            "mtf_upper": None if self.upper is None else self.upper.tolist(),
            "others": {name: one.tolist() for name, one in self.others.items()},
            f"mtf50_{self.unit}": self.mtf50,
            f"mtf50_{self.unit}_ci95": None if ends is None else list(ends),
            "nyquist_cyc_per_pixel": NYQUIST_CYC_PER_PIXEL if self.unit == "cyc_per_pixel" else None,
            "mtf_at_nyquist": self.mtf_at_nyquist,
            "mtf_at_nyquist_ci95": None if at_nyquist is None else list(at_nyquist),
            "n_frames": None if self.measured is None else self.measured.n_frames,
            "edges": list(self.edges),
        }
        return Result.made("mtf", self.started, mtf=found, warnings=self.warnings).to_json()

    def figure(self) -> Figure:
        """Return a figure of the MTF; for a recording also of the edge profiles and of where the edges are."""
        from matplotlib.figure import Figure

        with style():
            n = 1 if self.measured is None else 3
            figure = Figure(figsize=(4.8 * n, 3.6) if n > 1 else (5.6, 4.2), layout="constrained")
            axes, *more = np.atleast_1d(figure.subplots(1, n))
            self.draw(axes)
            if self.measured is not None:
                _draw_profiles(more[0], self.measured)
                _draw_places(more[1], self.measured)
            figure.suptitle(label_text(Path(self.source).name), fontsize="medium")
        return figure

    def to_html(self) -> str:
        """Return one self-contained HTML page, the content of `report.html`."""
        edges = self.edge_table(has_intervals=True)
        content: Json = {
            "title": "MTF of a camera" if self.measured is not None else "MTF from a table",
            "about": self.source,
            "warnings": [one.message for one in self.warnings],
            "verdict": self.sentences(),
            "figures": figure_items(self._pictures()),
            "tables_shown": [table_item(self.short_table() if edges is None else edges)],
            "examples": [],
            "without": [],
            "remarks": [] if self.measured is None else [HOW_MEASURED],
            "details": [table_item(self.table(), folded=True)],
            "version": __version__,
            "can_be_made_again": False,
        }
        return render(content)

    def _pictures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        band = "" if self.lower is None else " The band is that of 95 % for the noise of the pixels."
        found = [ReportFigure("MTF", f"Mean and single curves.{band}", self.draw)]
        if self.measured is not None:
            places = partial(_draw_places, measured=self.measured)
            profiles = partial(_draw_profiles, measured=self.measured)
            found.append(
                ReportFigure("Edges", "The box about each edge that was measured, with its number.", places)
            )
            found.append(ReportFigure("Edge profiles", "Means along each edge, in its colour.", profiles))
        return found

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name; one of MTF Mapper's form for frequencies of pixels."""
        edges = self.edge_table()
        return {
            "mtf.csv": self.table().csv().encode(),
            **({} if edges is None else {edges.file: edges.csv().encode()}),
            "mtf.png": figure_png(self.figure()),
            **self._mapper_file(),
            "report.html": self.to_html().encode(),
            "result.json": self.to_json(),
        }

    def _repr_html_(self) -> str:
        table = self.edge_table() or self.short_table()
        return notebook_page(self.sentences(), table, [(self.figure, "MTF")])

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set; `plot` sets that of all figures."""
        band = None if self.lower is None or self.upper is None else (self.lower, self.upper)
        is_mean = any(name.startswith("edge") for name in self.others)
        label = "mean" if is_mean else "MTF"
        lines = [MtfLine(label=label, mtf=self.mtf, band=band, style={"color": INK, "lw": 2.0})]
        for k, (name, curve) in enumerate(list(self.others.items())[:MOST_LINES]):
            colour = LINE_COLOURS.get(name, COLOURS[k % len(COLOURS)])
            lines.append(MtfLine(label=name, mtf=curve, style={"color": colour, "lw": 1.0}))
        draw_mtf(
            axes,
            self.frequency,
            lines,
            end=float(self.frequency[-1]),
            marks={"Nyquist": NYQUIST_CYC_PER_PIXEL} if self.unit == "cyc_per_pixel" else {},
            xlabel=f"frequency ({UNITS[self.unit]})",
            ylabel="MTF",
        )

    def _mapper_file(self) -> dict[str, bytes]:
        """Return `edge_sfr_values.txt` with each edge, or `raw_sfr_values.txt` with the curve of a table."""
        if self.unit != "cyc_per_pixel":
            return {}
        frequency = np.arange(MAPPER_PER_CYC_PER_PIXEL) / MAPPER_PER_CYC_PER_PIXEL
        if self.measured is None:
            if self.frequency[-1] < frequency[-1]:
                return {}
            values = np.interp(frequency, self.frequency, self.mtf, left=1.0)
            return {"raw_sfr_values.txt": _line([0.0, *values])}
        rows, columns = self.measured.image.shape
        lines = []
        for number, by_colour in enumerate(self.measured.edges, 1):
            edge = by_colour[LUMA]
            x, y = edge.centre_px
            radial_deg = math.degrees(math.atan2(y - (rows - 1) / 2, x - (columns - 1) / 2))
            lines.append(_line([number, x, y, edge.angle_deg, radial_deg, *edge.mtf[: len(frequency)]]))
        return {"edge_sfr_values.txt": b"".join(lines)}


def _line(values: Sequence[float]) -> bytes:
    return (" ".join(f"{one:.6g}" for one in values) + "\n").encode()


def _draw_profiles(axes: Axes, measured: RecordingMtf) -> None:
    for k, by_colour in enumerate(measured.edges[:MOST_LINES]):
        edge = by_colour[LUMA]
        axes.plot(edge.distance_px, edge.profile, color=COLOURS[k % len(COLOURS)], lw=1.0)
    axes.set(xlabel="distance from the edge (pixels)", ylabel="profile, 0 dark and 1 bright")
    axes.set_title("Edge profiles", fontsize="medium")


def _draw_places(axes: Axes, measured: RecordingMtf) -> None:
    from matplotlib.patches import Rectangle

    low, high = np.percentile(measured.image, (0.5, 99.5))
    axes.imshow(measured.image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    for k, by_colour in enumerate(measured.edges):
        left, top, width, height = by_colour[LUMA].box
        colour = COLOURS[k % len(COLOURS)]
        axes.add_patch(Rectangle((left - 0.5, top - 0.5), width, height, fill=False, edgecolor=colour, lw=1.2))
        axes.annotate(str(k + 1), (left, top), (2, -2), textcoords="offset points", va="top", color=colour)
    axes.set_title("Edges", fontsize="medium")
    axes.grid(visible=False)


def measured_result(
    measured: RecordingMtf, source: str, *, is_light: bool, started: float | None = None
) -> MtfResult:
    """Return the result of a measurement that began at a time of `time.perf_counter`."""
    mean = measured.means[LUMA]
    others = {name: one.mtf for name, one in measured.means.items() if name != LUMA}
    if len(measured.edges) > 1:
        others |= {f"edge {k}": one[LUMA].mtf for k, one in enumerate(measured.edges, 1)}
    edges = [
        _record(number, colour, edge)
        for number, by_colour in enumerate(measured.edges, 1)
        for colour, edge in by_colour.items()
    ]
    if len(measured.means) == 1:
        edges = [{key: value for key, value in one.items() if key != "colour"} for one in edges]
    return MtfResult(
        source=source,
        unit="cyc_per_pixel",
        frequency=FREQUENCY_CYC_PER_PIXEL,
        mtf=mean.mtf,
        lower=mean.lower,
        upper=mean.upper,
        others=others,
        edges=tuple(edges),
        measured=measured,
        is_light=is_light,
        noted=measured.warnings,
        started=time.perf_counter() if started is None else started,
    )


def _record(number: int, colour: str, edge: EdgeMtf) -> Json:
    left, top, width, height = edge.box
    values: Json = {
        "edge": number,
        "colour": colour,
        "x_px": left,
        "y_px": top,
        "width_px": width,
        "height_px": height,
        "angle_deg": edge.angle_deg,
        "normal_deg": edge.normal_deg,
        "bend_px": edge.bend_px,
        "dark": edge.dark,
        "bright": edge.bright,
        "noise_percent": 100.0 * edge.relative_noise,
    }
    estimates: dict[str, EdgeValue | None] = {
        "mtf50_cyc_per_pixel": edge.mtf50_cyc_per_pixel,
        "mtf_at_nyquist": edge.mtf_at_nyquist,
        "overshoot": edge.overshoot,
        "undershoot": edge.undershoot,
    }
    for name, one in estimates.items():
        values |= (
            {name: None, f"{name}_ci95": None} if one is None else {name: one.value, f"{name}_ci95": one.ci95}
        )
    return values


def table_result(table: MtfTable, source: str, *, started: float) -> MtfResult:
    """Return the result of a table that was read."""
    others = {name.removeprefix("mtf_"): one for name, one in table.curves.items() if name != RADIAL}
    mtf = table.curves.get(RADIAL)
    return MtfResult(
        source=source,
        unit=table.unit,
        frequency=table.frequency,
        mtf=np.mean(list(others.values()), 0) if mtf is None else mtf,
        lower=table.lower,
        upper=table.upper,
        others=others,
        noted=_of_table(table),
        started=started,
    )


def mapper_result(edges: Sequence[MapperEdge], source: str, *, started: float) -> MtfResult:
    """Return the result of the edges in a file of MTF Mapper, which all have the same number of frequencies.

    Raises
    ------
    DataError
        If they have not.
    """
    from todframes.base.errors import DataError

    lengths = sorted({len(one.table.frequency) for one in edges})
    if len(lengths) > 1:
        raise DataError(
            f"{source}: found lines with {lengths[0]} and {lengths[-1]} values, expected as many in all"
        )
    curves = [one.table.curves[RADIAL] for one in edges]
    mean = np.mean(curves, 0)
    frequency = edges[0].table.frequency
    table = MtfTable(unit="cyc_per_pixel", frequency=frequency, curves={RADIAL: mean})
    records = []
    for number, (one, curve) in enumerate(zip(edges, curves, strict=True), 1):
        place = {} if one.centre_px is None else {"x_px": one.centre_px[0], "y_px": one.centre_px[1]}
        nyquist = float(np.interp(NYQUIST_CYC_PER_PIXEL, frequency, curve))
        values = {"mtf50_cyc_per_pixel": mtf50_of(frequency, curve), "mtf_at_nyquist": nyquist}
        records.append({"edge": number, **place, "angle_deg": one.angle_deg, **values})
    return MtfResult(
        source=source,
        unit="cyc_per_pixel",
        frequency=frequency,
        mtf=mean,
        others={f"edge {k}": one for k, one in enumerate(curves, 1)} if len(curves) > 1 else {},
        edges=tuple(records),
        noted=_of_table(table),
        started=started,
    )


def _of_table(table: MtfTable) -> tuple[RecordingWarning, ...]:
    """Return warnings about a table: values above 1, and an end where the MTF is not small."""
    found = []
    highest = max(float(one.max()) for one in table.curves.values())
    if highest > 1.0:
        found.append(
            RecordingWarning(
                "mtf_above_1",
                f"the MTF rises to {highest:.3g}, which no lens or detector reaches: the picture was sharpened, "
                "or noise lifts it",
            )
        )
    if table.stops_early:
        found.append(
            RecordingWarning(
                "mtf_stops_early",
                f"the table ends at {table.frequency[-1]:.3g} {UNITS[table.unit]} with an MTF of "
                f"{table.end_mtf:.2g}: what is above is not known, and may change a sample at an edge by "
                f"{table.end_cost:.2g} of its contrast",
            )
        )
    return tuple(found)
