"""A measured MTF as tables, sentences, figures and files: of slanted edges, or read from a table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from msgspec import Struct

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError
from todframes.camera.edge_mtf import FREQUENCY_CYC_PER_PIXEL, EdgeMtf, EdgeValue
from todframes.camera.mtf_table import (
    MAPPER_PER_CYC_PER_PIXEL,
    RADIAL,
    FrequencyUnit,
    MapperEdge,
    MtfTable,
    mtf50_of,
)
from todframes.camera.slanted_edges import LUMA, RecordingMtf
from todframes.recordings.recording import RecordingWarning
from todframes.results.data import Content, ResultWarning, as_read
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import COLOURS, INK
from todframes.results.mtf_figure import MtfLine, draw_mtf
from todframes.results.result import Result
from todframes.results.table import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


UNITS: dict[FrequencyUnit, str] = {
    "cyc_per_pixel": "cycles/pixel",
    "cyc_per_mrad": "cycles/mrad",
    "cyc_per_mm": "cycles/mm",
}

NYQUIST_CYC_PER_PIXEL = 0.5

LINE_COLOURS = {"red": COLOURS[5], "green": COLOURS[2], "blue": COLOURS[0], "tangential": COLOURS[4]}
"""Colours of curves; of others they follow in the order of `COLOURS`."""

SHOWN_ROWS = 16
"""Number of frequencies that are shown, about: every eighth of the Nyquist frequency for slanted edges."""

HOW_MEASURED = (
    "Pixels are sorted by their distance from the edge into bins, whose means are a finely sampled profile; its "
    "derivative has the MTF as its Fourier transform (ISO 12233:2023). Overshoot and undershoot are those of the "
    "profile in means over a pixel, relative to the contrast."
)

MOST_LINES = 12
"""Largest number of edges that the figure shows beside their mean."""

Ends = tuple[float | None, float | None]

Curve = tuple[float, ...]


class EdgeRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An edge in one colour, as in `edges.csv`."""

    edge: int
    colour: str | None = None
    x_px: int | float | None = None
    y_px: int | float | None = None
    width_px: int | None = None
    height_px: int | None = None
    angle_deg: float | None = None
    normal_deg: float | None = None
    bend_px: float | None = None
    dark: float | None = None
    bright: float | None = None
    noise_percent: float | None = None
    mtf50_cyc_per_pixel: float | None = None
    mtf50_cyc_per_pixel_ci95: Ends | None = None
    mtf_at_nyquist: float | None = None
    mtf_at_nyquist_ci95: Ends | None = None
    overshoot: float | None = None
    overshoot_ci95: Ends | None = None
    undershoot: float | None = None
    undershoot_ci95: Ends | None = None


class MtfNumbers(Struct, frozen=True, kw_only=True):
    """The key `mtf` of the result.

    Attributes
    ----------
    source : str
        Path of the recording or table.
    unit : {"cyc_per_pixel", "cyc_per_mrad", "cyc_per_mm"}
        Unit of the frequencies.
    frequency, mtf : tuple of float
        Mean over all edges; of a table with tangential and sagittal values only, their mean.
    mtf_lower, mtf_upper : tuple of float or None
        Ends of the 95 % band of `mtf`, for the noise of the pixels.
    others : dict of tuple of float
        Further curves by name: means of "red", "green", "blue"; "tangential", "sagittal"; or "edge 1", "edge 2".
    mtf50, mtf50_ci95
        Frequency at which the MTF falls to 0.5; None if it stays above. An end is None where the band does.
    mtf_at_nyquist, mtf_at_nyquist_ci95
        MTF at 0.5 cycles/pixel; None if frequencies are not those of pixels or end before.
    n_frames : int or None
        None for a table.
    is_light : bool
        Whether values were converted to the luminance of a display.
    edges : tuple of EdgeRecord
        A record for each edge and colour, as in `edges.csv`.
    """

    source: str
    unit: FrequencyUnit
    frequency: Curve
    mtf: Curve
    mtf_lower: Curve | None = None
    mtf_upper: Curve | None = None
    others: dict[str, Curve] = {}
    mtf50: float | None
    mtf50_ci95: Ends | None
    nyquist_cyc_per_pixel: float | None
    mtf_at_nyquist: float | None
    mtf_at_nyquist_ci95: Ends | None
    n_frames: int | None = None
    is_light: bool = False
    edges: tuple[EdgeRecord, ...] = ()


class Mtf(Content, frozen=True, kw_only=True):
    """A measured MTF.

    Attributes
    ----------
    mtf : MtfNumbers
        The numbers.
    measured : RecordingMtf or None
        All that was measured, with the profiles of edges; None for a table, and for a result that was read.
    """

    mtf: MtfNumbers

    measured: ClassVar[RecordingMtf | None] = None

    @property
    def name(self) -> str:
        """Return the path of the recording or table."""
        return self.mtf.source

    def table(self) -> Table:
        """Return all frequencies, whose CSV `sensor_sim` reads."""
        found = self.mtf
        curves = {RADIAL: found.mtf, "mtf_lower": found.mtf_lower, "mtf_upper": found.mtf_upper}
        curves |= {f"mtf_{name.replace(' ', '_')}": curve for name, curve in found.others.items()}
        known = {f"frequency_{found.unit}": found.frequency} | {
            name: one for name, one in curves.items() if one is not None
        }
        records = [dict(zip(known, row, strict=True)) for row in zip(*known.values(), strict=True)]
        frequency, *names = known
        columns = [
            Column(key=frequency, header=UNITS[found.unit], decimals=4 if found.unit == "cyc_per_pixel" else None),
            *(
                Column(
                    key=name,
                    header=name.removeprefix("mtf_").replace("_", " "),
                    decimals=3,
                    rank=k * (name not in (RADIAL, "mtf_lower", "mtf_upper")),
                )
                for k, name in enumerate(names, 1)
            ),
        ]
        return Table.of(f"MTF of {path_name(found.source)}", "mtf.csv", columns, records)

    def tables(self) -> list[Table]:
        """List some frequencies, the edges, and folded all frequencies."""
        whole = self.table()
        step = max((len(whole.records) - 1) // SHOWN_ROWS, 1)
        some = replace(whole, file="", records=whole.records[::step])
        return [some, *self._edge_tables(), replace(whole, title="All frequencies").folded()]

    def _edge_tables(self) -> list[Table]:
        if not self.mtf.edges:
            return []
        headers = {
            "mtf50_cyc_per_pixel": "MTF50",
            "mtf_at_nyquist": "Nyquist",
            "angle_deg": "angle (°)",
            "noise_percent": "noise (%)",
            "bend_px": "bend (px)",
        }
        ranks = {"width_px": 3, "height_px": 3, "noise_percent": 2, "bend_px": 2, "undershoot": 1}
        ranks |= {f"{key}_ci95": 4 for key in ("mtf_at_nyquist", "overshoot", "undershoot")}
        keys = EdgeRecord.__struct_fields__
        columns = [
            Column(
                key=key,
                header="95 % interval" if key.endswith("_ci95") else headers.get(key, ""),
                digits=3,
                interval=key if key.endswith("_ci95") else "",
                in_file_only=key in ("normal_deg", "dark", "bright"),
                is_name=key == "edge",
                rank=ranks.get(key, 0),
            )
            for key in keys
        ]
        records = [{key: getattr(one, key) for key in keys} for one in self.mtf.edges]
        return [Table.of("Edges, MTF50 in cycles/pixel", "edges.csv", columns, records).without_empty_columns()]

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        found, unit = self.mtf, UNITS[self.mtf.unit]
        if found.mtf50 is None:
            texts = [f"The MTF stays above 0.5 up to {plain(found.frequency[-1])} {unit}."]
        else:
            texts = [f"MTF50 {plain(found.mtf50, 3)}{_within(found.mtf50_ci95)} {unit}."]
        if found.mtf_at_nyquist is not None:
            within = _within(found.mtf_at_nyquist_ci95)
            texts.append(
                f"MTF {plain(found.mtf_at_nyquist, 3)}{within} at the Nyquist frequency, 0.5 cycles/pixel."
            )
        if found.n_frames is not None:
            n_edges = len({one.edge for one in found.edges})
            texts.append(f"Mean of {count(n_edges, 'edge')} in {count(found.n_frames, 'frame')}.")
            texts.append(
                "Measured is the luminance of the display."
                if found.is_light
                else "The values were taken as proportional to light."
            )
        return texts

    def remarks(self) -> list[str]:
        """Return how edges are measured."""
        return [] if self.mtf.n_frames is None else [HOW_MEASURED]

    def figures(self) -> list[ReportFigure]:
        """List the MTF; of a new measurement also where the edges are, and their profiles."""
        band = "" if self.mtf.mtf_lower is None else " The band is that of 95 % for the noise of the pixels."
        found = [ReportFigure("MTF", f"Mean and single curves.{band}", self._draw, "mtf.png")]
        if self.measured is not None:
            boxes = partial(_draw_boxes, measured=self.measured)
            profiles = partial(_draw_profiles, measured=self.measured)
            note = "The box about each edge that was measured, with its number."
            found.append(ReportFigure("Edges", note, boxes, "edges.png"))
            found.append(
                ReportFigure("Edge profiles", "Means along each edge, in its colour.", profiles, "profiles.png")
            )
        return found

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the tables; and one of MTF Mapper's form for frequencies of pixels."""
        return {**super().files(), **self._mapper_file()}

    def _draw(self, axes: Axes) -> None:
        found = self.mtf
        band = None if found.mtf_lower is None or found.mtf_upper is None else (found.mtf_lower, found.mtf_upper)
        label = "mean" if any(name.startswith("edge") for name in found.others) else "MTF"
        lines = [MtfLine(label=label, mtf=found.mtf, band=band, style={"color": INK, "lw": 2.0})]
        for k, (name, curve) in enumerate(list(found.others.items())[:MOST_LINES]):
            colour = LINE_COLOURS.get(name, COLOURS[k % len(COLOURS)])
            lines.append(MtfLine(label=name, mtf=curve, style={"color": colour, "lw": 1.0}))
        draw_mtf(
            axes,
            found.frequency,
            lines,
            end=found.frequency[-1],
            marks={"Nyquist": NYQUIST_CYC_PER_PIXEL} if found.unit == "cyc_per_pixel" else {},
            xlabel=f"frequency ({UNITS[found.unit]})",
            ylabel="MTF",
        )

    def _mapper_file(self) -> dict[str, bytes]:
        """Return `edge_sfr_values.txt` with each edge, or `raw_sfr_values.txt` with the curve of a table."""
        found, measured = self.mtf, self.measured
        if found.unit != "cyc_per_pixel":
            return {}
        frequency = np.arange(MAPPER_PER_CYC_PER_PIXEL) / MAPPER_PER_CYC_PER_PIXEL
        if measured is None:
            if found.n_frames is not None or found.frequency[-1] < frequency[-1]:
                return {}
            values = np.interp(frequency, found.frequency, found.mtf, left=1.0)
            return {"raw_sfr_values.txt": _line([0.0, *values])}
        rows, columns = measured.image.shape
        lines = []
        for number, by_colour in enumerate(measured.edges, 1):
            edge = by_colour[LUMA]
            x, y = edge.centre_px
            radial_deg = math.degrees(math.atan2(y - (rows - 1) / 2, x - (columns - 1) / 2))
            lines.append(_line([number, x, y, edge.angle_deg, radial_deg, *edge.mtf[: len(frequency)]]))
        return {"edge_sfr_values.txt": b"".join(lines)}


def _within(ends: Ends | None) -> str:
    return "" if ends is None else f" ({interval_phrase(ends, 3)})"


def _line(values: Sequence[float]) -> bytes:
    return (" ".join(f"{one:.6g}" for one in values) + "\n").encode()


def _draw_profiles(axes: Axes, measured: RecordingMtf) -> None:
    for k, by_colour in enumerate(measured.edges[:MOST_LINES]):
        edge = by_colour[LUMA]
        axes.plot(edge.distance_px, edge.profile, color=COLOURS[k % len(COLOURS)], lw=1.0)
    axes.set(xlabel="distance from the edge (pixels)", ylabel="profile, 0 dark and 1 bright")


def _draw_boxes(axes: Axes, measured: RecordingMtf) -> None:
    from matplotlib.patches import Rectangle

    low, high = np.percentile(measured.image, (0.5, 99.5))
    axes.imshow(measured.image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    for k, by_colour in enumerate(measured.edges):
        left, top, width, height = by_colour[LUMA].box
        colour = COLOURS[k % len(COLOURS)]
        axes.add_patch(Rectangle((left - 0.5, top - 0.5), width, height, fill=False, edgecolor=colour, lw=1.2))
        axes.annotate(str(k + 1), (left, top), (2, -2), textcoords="offset points", va="top", color=colour)
    axes.grid(visible=False)


def _result(
    source: str,
    *,
    unit: FrequencyUnit,
    frequency: FloatArray,
    mtf: FloatArray,
    band: tuple[FloatArray, FloatArray] | None = None,
    others: Mapping[str, FloatArray],
    edges: Sequence[Json] = (),
    measured: RecordingMtf | None = None,
    is_light: bool = False,
    warnings: Sequence[RecordingWarning],
    started: float,
) -> Result[Mtf]:
    """Return the result of curves over frequency, with what follows from them."""
    has_nyquist = unit == "cyc_per_pixel" and frequency[-1] >= NYQUIST_CYC_PER_PIXEL

    def at_nyquist(curve: FloatArray) -> float | None:
        return float(np.interp(NYQUIST_CYC_PER_PIXEL, frequency, curve)) if has_nyquist else None

    numbers = {
        "source": source,
        "unit": unit,
        "frequency": frequency.tolist(),
        "mtf": mtf.tolist(),
        "mtf_lower": None if band is None else band[0].tolist(),
        "mtf_upper": None if band is None else band[1].tolist(),
        "others": {name: one.tolist() for name, one in others.items()},
        "mtf50": mtf50_of(frequency, mtf),
        "mtf50_ci95": None if band is None else [mtf50_of(frequency, end) for end in band],
        "nyquist_cyc_per_pixel": NYQUIST_CYC_PER_PIXEL if unit == "cyc_per_pixel" else None,
        "mtf_at_nyquist": at_nyquist(mtf),
        "mtf_at_nyquist_ci95": [at_nyquist(end) for end in band] if band is not None and has_nyquist else None,
        "n_frames": None if measured is None else measured.n_frames,
        "is_light": is_light,
        "edges": edges,
    }
    of_codes = [ResultWarning(code=one.code, message=one.message) for one in warnings]
    made = Result.made("mtf", started, warnings=of_codes, mtf=as_read(numbers, MtfNumbers))
    return made if measured is None else made.holding(measured=measured)


def measured_result(measured: RecordingMtf, source: str, *, is_light: bool, started: float) -> Result[Mtf]:
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
    return _result(
        source,
        unit="cyc_per_pixel",
        frequency=FREQUENCY_CYC_PER_PIXEL,
        mtf=mean.mtf,
        band=(mean.lower, mean.upper),
        others=others,
        edges=edges,
        measured=measured,
        is_light=is_light,
        warnings=measured.warnings,
        started=started,
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


def table_result(table: MtfTable, source: str, *, started: float) -> Result[Mtf]:
    """Return the result of a table that was read."""
    others = {name.removeprefix("mtf_"): one for name, one in table.curves.items() if name != RADIAL}
    mtf = table.curves.get(RADIAL)
    return _result(
        source,
        unit=table.unit,
        frequency=table.frequency,
        mtf=np.mean(list(others.values()), 0) if mtf is None else mtf,
        band=None if table.lower is None or table.upper is None else (table.lower, table.upper),
        others=others,
        warnings=_of_table(table),
        started=started,
    )


def mapper_result(edges: Sequence[MapperEdge], source: str, *, started: float) -> Result[Mtf]:
    """Return the result of the edges in a file of MTF Mapper, which all have the same number of frequencies.

    Raises
    ------
    DataError
        If they have not.
    """
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
    return _result(
        source,
        unit="cyc_per_pixel",
        frequency=frequency,
        mtf=mean,
        others={f"edge {k}": one for k, one in enumerate(curves, 1)} if len(curves) > 1 else {},
        edges=records,
        warnings=_of_table(table),
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
