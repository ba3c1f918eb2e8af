"""The call `mtf`, the MTF of a camera from slanted edges in a recording or a table of an MTF, and its result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked
from todframes.base.safe_text import in_utf8
from todframes.camera.edge_mtf import FREQUENCY_CYC_PER_PIXEL
from todframes.camera.mtf_table import (
    BAND,
    NYQUIST_CYC_PER_PIXEL,
    RADIAL,
    UNITS,
    EdgeRecord,
    Ends,
    FrequencyUnit,
    MtfLine,
    MtfTable,
    Resolution,
    crossing_frequency,
    draw_mtf,
    read_mtf_table,
    with_ends,
)
from todframes.camera.slanted_edges import LUMA, PlacedEdge, RecordingMtf, measure_mtf
from todframes.display.display import Display
from todframes.parameters import Box, ChartFile, DisplayName, FrameLimit, PathLike, Plane, Progress
from todframes.recordings.recording import RecordingWarning
from todframes.results.data import ResultWarning, as_read
from todframes.results.figures import COLOURS, INK, ReportFigure
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


LINE_COLOURS = {"red": COLOURS[5], "green": COLOURS[2], "blue": COLOURS[0], "tangential": COLOURS[4]}
"""Colours of curves; of others they follow in the order of `COLOURS`."""

HOW_MEASURED = (
    "Pixels are sorted by their distance from the edge into bins, whose means are a finely sampled profile; its "
    "derivative has the MTF as its Fourier transform (ISO 12233:2023). Overshoot and undershoot are those of the "
    "profile in means over a pixel, relative to the contrast."
)

MOST_LINES = 12
"""Largest number of edges that the figure shows beside their mean."""

Curve = tuple[float, ...]


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
    mtf10, mtf10_ci95
        Frequency at which the MTF falls to 0.1.
    resolution_limit_cyc_per_pixel, resolution_limit_cyc_per_pixel_ci95
        The smaller one of MTF10 and the Nyquist frequency.
    effective_width_px : float or None
        Width of the frame in pixels, times twice this limit; None for a table.
    aliased_from_cyc_per_pixel : float or None
        1 − MTF10: patterns beyond the Nyquist frequency appear from here on. None if MTF10 is not beyond.
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
    mtf10: float | None = None
    mtf10_ci95: Ends | None = None
    resolution_limit_cyc_per_pixel: float | None = None
    resolution_limit_cyc_per_pixel_ci95: Ends | None = None
    effective_width_px: float | None = None
    aliased_from_cyc_per_pixel: float | None = None
    nyquist_cyc_per_pixel: float | None
    mtf_at_nyquist: float | None
    mtf_at_nyquist_ci95: Ends | None
    n_frames: int | None = None
    is_light: bool = False
    edges: tuple[EdgeRecord, ...] = ()


class Mtf(Result, frozen=True, kw_only=True):
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
        numbers = self.mtf
        decimals = 4 if numbers.unit == "cyc_per_pixel" else None
        columns = [Column(key=f"frequency_{numbers.unit}", header=UNITS[numbers.unit], decimals=decimals)]
        curves = [numbers.frequency]
        own = {RADIAL: numbers.mtf, "mtf_lower": numbers.mtf_lower, "mtf_upper": numbers.mtf_upper}
        others = {f"mtf_{name.replace(' ', '_')}": curve for name, curve in numbers.others.items()}
        for name, curve in (own | others).items():
            if curve is not None:
                header = name.removeprefix("mtf_").replace("_", " ")
                rank = len(curves) * (name not in own)
                columns.append(Column(key=name, header=header, decimals=3, rank=rank))
                curves.append(curve)
        keys = [column.key for column in columns]
        records = [dict(zip(keys, row, strict=True)) for row in zip(*curves, strict=True)]
        return Table.of(f"MTF of {path_name(numbers.source)}", "mtf.csv", columns, records)

    def tables(self) -> list[Table]:
        """List some frequencies, the edges, and folded all frequencies."""
        whole = self.table()
        step = max((len(whole.records) - 1) // 16, 1)  # Of slanted edges every eighth of the Nyquist frequency.
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
            for key in EdgeRecord.__struct_fields__
        ]
        records = [structs.asdict(edge) for edge in self.mtf.edges]
        return [Table.of("Edges, MTF50 in cycles/pixel", "edges.csv", columns, records).without_empty_columns()]

    def findings(self) -> list[str]:
        """Return the findings in words."""
        numbers, unit = self.mtf, UNITS[self.mtf.unit]
        if numbers.mtf50 is None:
            texts = [f"The MTF stays above 0.5 up to {plain(numbers.frequency[-1])} {unit}."]
        else:
            texts = [f"MTF50 {plain(numbers.mtf50, 3)}{_within(numbers.mtf50_ci95)} {unit}."]
        if numbers.mtf_at_nyquist is not None:
            within = _within(numbers.mtf_at_nyquist_ci95)
            texts.append(
                f"MTF {plain(numbers.mtf_at_nyquist, 3)}{within} at the Nyquist frequency, 0.5 cycles/pixel."
            )
        resolution = Resolution(
            numbers.mtf10, numbers.resolution_limit_cyc_per_pixel, numbers.aliased_from_cyc_per_pixel
        )
        within = _within(numbers.mtf10_ci95)
        texts += resolution.sentences(unit, NYQUIST_CYC_PER_PIXEL, within, numbers.effective_width_px)
        if numbers.n_frames is not None:
            n_edges = len({record.edge for record in numbers.edges})
            texts.append(f"Mean of {count(n_edges, 'edge')} in {count(numbers.n_frames, 'frame')}.")
            texts.append(
                "Measured is the luminance of the display."
                if numbers.is_light
                else "The values were taken as proportional to light."
            )
        return texts

    def remarks(self) -> list[str]:
        """Return how edges are measured."""
        return [] if self.mtf.n_frames is None else [HOW_MEASURED]

    def figures(self) -> list[ReportFigure]:
        """List the MTF; of a new measurement also where the edges are, and their profiles."""
        band = "" if self.mtf.mtf_lower is None else " The band is that of 95 % for the noise of the pixels."
        figures = [ReportFigure("MTF", f"Mean and single curves.{band}", self._draw, "mtf.png")]
        if self.measured is not None:
            boxes = partial(_draw_boxes, measured=self.measured)
            profiles = partial(_draw_profiles, measured=self.measured)
            note = "The box about each edge that was measured, with its number."
            figures.append(ReportFigure("Edges", note, boxes, "edges.png"))
            note = "Means along each edge, in its colour."
            figures.append(ReportFigure("Edge profiles", note, profiles, "profiles.png"))
        return figures

    def _draw(self, axes: Axes) -> None:
        numbers = self.mtf
        lower, upper = numbers.mtf_lower, numbers.mtf_upper
        band = (lower, upper) if lower and upper else None
        label = "mean" if any(name.startswith("edge") for name in numbers.others) else "MTF"
        lines = [MtfLine(label=label, mtf=numbers.mtf, band=band, style={"color": INK, "lw": 2.0})]
        for k, (name, curve) in enumerate(list(numbers.others.items())[:MOST_LINES]):
            colour = LINE_COLOURS.get(name, COLOURS[k % len(COLOURS)])
            lines.append(MtfLine(label=name, mtf=curve, style={"color": colour, "lw": 1.0}))
        draw_mtf(
            axes,
            numbers.frequency,
            lines,
            end=numbers.frequency[-1],
            marks={"Nyquist": NYQUIST_CYC_PER_PIXEL} if numbers.unit == "cyc_per_pixel" else {},
            xlabel=f"frequency ({UNITS[numbers.unit]})",
            ylabel="MTF",
        )


def _within(ends: Ends | None) -> str:
    return "" if ends is None else f" ({interval_phrase(ends, 3)})"


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


@checked
def mtf(
    recording: PathLike | Sequence[PathLike] | NDArray[Any],
    *,
    boxes: Sequence[Box] = (),
    chart: ChartFile | None = None,
    display: DisplayName | Display | None = None,
    bits: int | None = None,
    plane: Plane | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> Mtf:
    """Measure the MTF across slanted edges (e-SFR, ISO 12233), with a 95 % band, or read it from a table.

    Parameters
    ----------
    recording : path, sequence of path, or ndarray
        A video, image files or a folder of them, camera raw or thermal files, or a file of a NumPy array; its
        frames are averaged. Or a table of an MTF to print, draw or convert: a CSV file.

        An array is taken as well, of shape (frames, rows, columns), (rows, columns), or with 3 colours last.
    boxes : sequence of (int, int, int, int)
        Left column, top row, width and height in pixels of a part of the frame with one edge. Default: edges are
        found.
    chart : path, optional
        chart.toml of the chart that the recording shows, made with a page for the camera (`todframes chart
        --camera-page`): edges are found by its markers, in the frames of that page. What the pixels of its monitor
        take from the MTF is divided out.
    display : str or Display, optional
        Display whose transfer function the values were encoded for, such as reference_sdr: its luminance is
        measured. Default: values are proportional to light.
    bits : int, optional
        Number of bits of a pixel's value: 14 if the largest value is 16383, also in files of 16. Default: from the
        files.
    plane : (int, int), optional
        Colour plane of a Bayer mosaic: the row and the column in each cell of 2 x 2, 0 or 1, as 0,0 for the red of
        RGGB. Default: all values, of camera raw the first green ones.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    progress : function of two ints, optional
        Called with the number of frames that are done, and of all, None if that is not known.

    Returns
    -------
    Result
        `mtf` has the `frequency`, and `mtf` with its 95 % band; `edges` has each edge.

    Raises
    ------
    DataError, FrameError
        If the files cannot be read, or no edge can be measured.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> import todframes as tod
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[:80, :80] - 40.0
    >>> edge = 0.2 + 0.6 * ndtr((x * np.cos(0.1) + y * np.sin(0.1)) / 0.7)  # a Gaussian blur of 0.7 pixels
    >>> found = tod.mtf(edge, boxes=[(0, 0, 80, 80)])
    >>> f"MTF50 {found.mtf.mtf50:.3f}, expected {np.sqrt(np.log(2) / 2) / np.pi / 0.7:.3f} cycles/pixel"
    'MTF50 0.268, expected 0.268 cycles/pixel'
    """
    started = time.perf_counter()
    from todframes.display.display import find_display
    from todframes.recordings.opening import one_recording, paths_of

    paths = [] if isinstance(recording, np.ndarray) else paths_of(recording)
    if len(paths) == 1 and paths[0].suffix.lower() == ".csv":
        given = {"boxes": boxes or None, "chart": chart, "display": display, "bits": bits, "plane": plane}
        for option in (name for name, value in given.items() if value is not None):
            raise SettingsError(
                f"{getattr(argument, option)}: {paths[0]} is a table of an MTF, expected a recording"
            )
        table = read_mtf_table(paths[0], may_exceed_1=True)
        if RADIAL not in table.curves:
            mean_mtf = np.mean(list(table.curves.values()), 0)
            table = replace(table, curves={**table.curves, RADIAL: mean_mtf})
        return _result(table, in_utf8(str(paths[0])), warnings=_of_table(table), started=started)
    shown = one_recording(recording, "mtf", bits=bits, plane=plane, max_frame_mb=max_frame_mb)
    edges = [PlacedEdge(box) for box in boxes]
    light = None if display is None else find_display(display).display
    if chart is not None:
        from todframes.camera.filmed_page import view_of_camera_page

        if boxes:
            raise SettingsError(f"{argument.boxes}: is given with {argument.chart}, expected one of them")
        view = view_of_camera_page(shown, Path(chart), needs_edges=True, progress=progress)
        shown, edges = view.recording, view.edges
    measured = measure_mtf(shown, edges=edges, needs_all=bool(boxes), display=light, progress=progress)
    mean, *band = measured.means[LUMA]
    curves = {RADIAL: mean} | {name: curve[0] for name, curve in measured.means.items() if name != LUMA}
    if len(measured.edges) > 1:
        curves |= {f"edge {k}": by_colour[LUMA].mtf for k, by_colour in enumerate(measured.edges, 1)}
    return _result(
        MtfTable("cyc_per_pixel", FREQUENCY_CYC_PER_PIXEL, curves, band),
        in_utf8(str(shown.path)),
        edges=[
            structs.replace(edge.record, edge=number, colour=colour if len(measured.means) > 1 else None)
            for number, by_colour in enumerate(measured.edges, 1)
            for colour, edge in by_colour.items()
        ],
        measured=measured,
        is_light=light is not None,
        warnings=measured.warnings,
        started=started,
    )


def _result(
    table: MtfTable,
    source: str,
    *,
    edges: Sequence[EdgeRecord] = (),
    measured: RecordingMtf | None = None,
    is_light: bool = False,
    warnings: Sequence[RecordingWarning],
    started: float,
) -> Mtf:
    """Return the result of curves over frequency, with what follows from them."""
    frequency, mtf = table.frequency, table.curves[RADIAL]
    nyquist = NYQUIST_CYC_PER_PIXEL if table.unit == "cyc_per_pixel" else None
    has_nyquist = nyquist is not None and frequency[-1] >= nyquist
    curves = [mtf, *table.band]
    resolution, *_ = resolutions = [Resolution.of(frequency, curve, nyquist) for curve in curves]
    at_nyquist = [float(np.interp(NYQUIST_CYC_PER_PIXEL, frequency, curve)) for curve in curves]
    numbers = {
        "source": source,
        "unit": table.unit,
        "frequency": frequency,
        "mtf": mtf,
        **dict(zip(BAND, table.band, strict=bool(table.band))),
        "others": {name.removeprefix("mtf_"): curve for name, curve in table.curves.items() if name != RADIAL},
        **with_ends("mtf50", [crossing_frequency(0.5, frequency, curve) for curve in curves]),
        **with_ends("mtf10", [each.mtf10 for each in resolutions]),
        **with_ends("resolution_limit_cyc_per_pixel", [each.limit for each in resolutions]),
        "effective_width_px": None
        if measured is None or not resolution.limit
        else 2.0 * resolution.limit * measured.image.shape[1],
        "aliased_from_cyc_per_pixel": resolution.aliased_from,
        "nyquist_cyc_per_pixel": nyquist,
        **with_ends("mtf_at_nyquist", at_nyquist if has_nyquist else []),
        "n_frames": None if measured is None else measured.n_frames,
        "is_light": is_light,
        "edges": edges,
    }
    of_codes = [ResultWarning(**warning._asdict()) for warning in warnings]
    made = Mtf.made("mtf", started, warnings=of_codes, mtf=as_read(numbers, MtfNumbers))
    return made if measured is None else made.holding(measured=measured)


def _of_table(table: MtfTable) -> list[RecordingWarning]:
    """Return warnings about a table: values above 1, and an end where the MTF is not small."""
    warnings = []
    highest = max(float(curve.max()) for curve in table.curves.values())
    if highest > 1.0:
        message = (
            f"the MTF rises to {highest:.3g}, which no lens or detector reaches: the picture was sharpened, "
            "or noise lifts it"
        )
        warnings.append(RecordingWarning("mtf_above_1", message))
    if table.stops_early:
        message = (
            f"the table ends at {table.frequency[-1]:.3g} {UNITS[table.unit]} with an MTF of "
            f"{table.end_mtf:.2g}: what is above is not known, and may change a sample at an edge by "
            f"{table.end_cost:.2g} of its contrast"
        )
        warnings.append(RecordingWarning("mtf_stops_early", message))
    return warnings
