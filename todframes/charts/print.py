"""Charts drawn in true millimetres, as SVG and PDF: sheets of paper, and plates with holes before a black body.

Places are in mm from the top left corner of a page, x to the right and y down.
"""

from __future__ import annotations

import html
import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import check_values, read_numbers
from todframes.base.safe_text import csv_text
from todframes.charts.design import (
    FIELD_PER_SIZE,
    N_PATCHES,
    Condition,
    Design,
    camera_content,
    grey_patches,
)
from todframes.charts.layout import (
    CHART_FILE,
    MODULES,
    Chart,
    Length,
    Markers,
    Page,
    Patch,
    Point,
    Triangle,
    write_chart,
)
from todframes.display.display import srgb_to_linear
from todframes.parameters import MarkerPlaces, Progress, counted
from todframes.stimulus import HEIGHT_PER_SIZE, SIDE_PER_SIZE, Orientation, vertices

MM_PER_INCH = 25.4
POINTS_PER_MM = 72.0 / MM_PER_INCH


@dataclass(frozen=True, slots=True)
class Area:
    """A filled polygon; `grey` is its code value, 0 to 255."""

    corners_mm: Sequence[tuple[float, float]]
    grey: int


@dataclass(frozen=True, slots=True)
class Outline:
    """A closed line in black along a polygon."""

    corners_mm: Sequence[tuple[float, float]]
    width_mm: float = 0.1


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text in black; (x, y) is its place on the base line, by `anchor` its start, middle or end."""

    x_mm: float
    y_mm: float
    text: str
    height_mm: float = 3.0
    anchor: Literal["start", "middle", "end"] = "start"


Shape = Area | Outline | Text


@dataclass(frozen=True, slots=True)
class Drawing:
    """Shapes on a page, each over the ones before."""

    width_mm: float
    height_mm: float
    shapes: tuple[Shape, ...]


def rectangle(x_mm: float, y_mm: float, width_mm: float, height_mm: float, grey: int) -> Area:
    """Return a filled rectangle with its top left corner at (x, y)."""
    right, bottom = x_mm + width_mm, y_mm + height_mm
    return Area(((x_mm, y_mm), (right, y_mm), (right, bottom), (x_mm, bottom)), grey)


def area(corners_mm: FloatArray, grey: int) -> Area:
    """Return a filled polygon; `corners_mm` has shape (n, 2)."""
    return Area([(float(x), float(y)) for x, y in corners_mm], grey)


def svg(drawing: Drawing) -> str:
    """Return a drawing as an SVG document whose size is given in mm."""
    width, height = f"{drawing.width_mm:.6g}", f"{drawing.height_mm:.6g}"
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for shape in drawing.shapes:
        match shape:
            case Text():
                attributes = f'x="{shape.x_mm:.4f}" y="{shape.y_mm:.4f}" font-size="{shape.height_mm:.4g}"'
                text = html.escape(shape.text, quote=False)
                lines.append(f'<text {attributes} text-anchor="{shape.anchor}">{text}</text>')
            case Area():
                fill = f'fill="rgb({shape.grey},{shape.grey},{shape.grey})"'
                lines.append(f'<polygon points="{_points(shape.corners_mm)}" {fill}/>')
            case Outline():
                line = f'fill="none" stroke="#000" stroke-width="{shape.width_mm:g}"'
                lines.append(f'<polygon points="{_points(shape.corners_mm)}" {line}/>')
    return "\n".join([*lines, "</svg>", ""])


def _points(corners_mm: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.5f},{y:.5f}" for x, y in corners_mm)


def pdf(drawings: Iterable[Drawing], title: str) -> bytes:
    """Return drawings as the pages of a PDF in true size; the same drawings give the same bytes."""
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    file = io.BytesIO()
    with mpl.rc_context(), PdfPages(file, metadata={"Title": title, "CreationDate": None}) as pages:
        mpl.rcdefaults()  # no settings of the user
        for drawing in drawings:
            size_inch = drawing.width_mm / MM_PER_INCH, drawing.height_mm / MM_PER_INCH
            figure = Figure(figsize=size_inch)
            axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.set(xlim=(0.0, drawing.width_mm), ylim=(drawing.height_mm, 0.0))
            axes.axis("off")
            for shape in drawing.shapes:
                match shape:
                    case Text():
                        points = shape.height_mm * POINTS_PER_MM
                        side = {"start": "left", "middle": "center", "end": "right"}[shape.anchor]
                        text = axes.text(shape.x_mm, shape.y_mm, shape.text, fontsize=points, ha=side)
                        text.set_parse_math(False)
                    case Area():
                        axes.add_patch(Polygon(shape.corners_mm, facecolor=str(shape.grey / 255.0), linewidth=0.0))
                    case Outline():
                        line = shape.width_mm * POINTS_PER_MM
                        axes.add_patch(Polygon(shape.corners_mm, fill=False, edgecolor="black", linewidth=line))
            pages.savefig(figure)
    return file.getvalue()


def write_drawings(
    folder: Path, chart: Chart, drawings: Sequence[tuple[str, Drawing]], pdf_file: str, progress: Progress | None
) -> None:
    """Write `chart.toml`, an SVG file of each drawing, and a PDF with all of them into an empty folder."""
    write_chart(folder / CHART_FILE, chart)
    for file, drawing in counted(drawings, len(drawings), progress):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(svg(drawing), encoding="utf-8")
    (folder / pdf_file).write_bytes(pdf([drawing for _, drawing in drawings], chart.name))


SPACING_PER_SIZE = 3.8
"""Distance between triangles of a sheet in sizes. The corners of one stay out of the field around the other, with
0.4 sizes to spare for the blur and the perspective of a camera."""

MARKER_SHARE = 0.08
"""Side of a marker relative to the smaller side of the sheet."""

GAP_MM = 2.0
"""Distance between the grey field and the bands above and below it."""

RULER_MM, RULER_STEP_MM, LEAST_RULER_MM = 200.0, 10.0, 50.0
"""Longest ruler, distance of its marks, and step of its length, which is also the shortest ruler."""

TICK_MM, LINE_MM = 3.0, 0.2

MOST_BESIDE = 2.0 / 3.0
"""Farthest place of the marker in the band below, on the way from the left corner to the right one."""

LETTER_MM, LETTER_WIDTH, SMALLER = 3.0, 0.55, 0.95
"""Largest height of a letter, the mean width of letters in heights, and the factor from a height to the next one
that is tried."""

LINE_SPACING = 1.3
"""Distance of lines of text in heights of a letter."""

WHITE = 255

LEAST_PRINTED_SIZE_MM = 2.0
"""Smallest √(area) on paper: the dots by which a printer makes grey would show in smaller triangles."""

PaperLength = Annotated[float, Meta(ge=10.0, le=2000.0)]

Reflectance = Annotated[float, Meta(ge=0.0, le=2.0)]

Parts = tuple[tuple[float, float], ...]
"""Parts of a band between markers, (left, width) each, in mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paper:
    """Sheets of paper, by default A3 across, and the printer's greys; `todframes.chart` describes the settings.
    Paper and black have the code values 255 and 0. Greys between are taken to follow sRGB, unless the CSV file
    `reflectances` has the columns code_value (0 to 255) and reflectance, measured on a print. With `markers`
    "borders", there is one in each of the bands above and below too; `MARKER_SHARE` gives their default side.
    """

    paper_width_mm: PaperLength = 420.0
    paper_height_mm: PaperLength = 297.0
    margin_mm: Annotated[float, Meta(ge=0.0, le=1e3)] = 10.0
    paper_reflectance: Reflectance = 0.85
    black_reflectance: Reflectance = 0.04
    reflectances: str | None = None
    background_reflectance: Reflectance = 0.3
    marker_mm: Length | None = None
    markers: MarkerPlaces = "borders"
    camera_page: bool = False

    def __post_init__(self) -> None:
        check_values(self)
        if self.black_reflectance >= self.paper_reflectance:
            raise SettingsError(
                f"black_reflectance: found {self.black_reflectance:g}, expected less than paper_reflectance "
                f"({self.paper_reflectance:g})"
            )

    def reflectance_of_code(self) -> FloatArray:
        """Return the reflectance of the code values 0 … 255, strictly rising."""
        code = np.arange(WHITE + 1.0)
        if self.reflectances is None:
            rise = self.paper_reflectance - self.black_reflectance
            return self.black_reflectance + rise * srgb_to_linear(code / WHITE)
        path = Path(self.reflectances)
        try:
            rows = read_numbers(path, ("code_value", "reflectance"))
        except DataError as error:
            raise SettingsError(str(error)) from None
        measured = np.array(rows, np.float64).reshape(-1, 2)
        if measured.shape[0] < 2 or (np.diff(measured, axis=0) <= 0.0).any():
            raise SettingsError(f"{path}: expected two rows or more, with rising code_value and reflectance")
        if measured[0, 0] != 0.0 or measured[-1, 0] != WHITE:
            raise SettingsError(f"{path}: code_value: found no row for 0 or none for {WHITE}, expected both")
        return np.asarray(np.interp(code, *measured.T))


@dataclass(frozen=True, slots=True)
class _Sheet:
    """The markers and the grey field of a sheet, and the parts of the bands above and below it."""

    markers: Markers
    band_mm: float
    left_mm: float
    top_mm: float
    width_mm: float
    height_mm: float
    above_mm: Parts
    below_mm: Parts

    @property
    def ruler_mm(self) -> float:
        """Length of the ruler, in the first part of the band below."""
        return _ruler_mm(self.below_mm[0][1])


def make_print_chart(design: Design, paper: Paper, folder: Path, progress: Progress | None) -> Chart:
    """Lay out a chart on paper, and write it into an empty folder; a sheet has triangles of one size."""
    reflectance = paper.reflectance_of_code()
    background_code = int(np.argmin(np.abs(reflectance - paper.background_reflectance)))
    background = float(reflectance[background_code])
    if background_code in (0, WHITE):
        raise SettingsError(
            f"background_reflectance: found {paper.background_reflectance:g}, which is black or paper; expected a "
            f"value between {reflectance[0]:g} and {reflectance[-1]:g}"
        )
    least = abs(float(reflectance[background_code + design.polarity]) / background - 1.0)
    largest = abs(float(reflectance[WHITE if design.polarity > 0 else 0]) / background - 1.0)
    code_of_level = _codes(design, reflectance, background_code, least, largest)
    sheet = _sheet(paper)
    order = design.order()
    sheets: list[list[tuple[Condition, float, float]]] = []
    for size_mrad in design.sizes_mrad:
        places = _places(design, size_mrad, sheet)
        ours = [condition for condition in order if condition.size_mrad == size_mrad]
        for first in range(0, len(ours), len(places)):
            some = ours[first : first + len(places)]
            sheets.append([(condition, *place) for condition, place in zip(some, places, strict=False)])
    patch_codes = [background_code, *np.linspace(0, WHITE, N_PATCHES - 1).round().astype(int).tolist()]
    patches = _patches(sheet, paper, reflectance[patch_codes].tolist())
    pages, camera = [], None
    if paper.camera_page:
        free_mm = sheet.left_mm, sheet.top_mm, sheet.width_mm, sheet.height_mm
        camera = camera_content(free_mm, reflectance, "reflectance", background_code, "sheets/00.svg")
        pages.append(camera.page)
    for page_number, content in enumerate(sheets, len(pages)):
        triangles = tuple(
            design.triangle(
                condition,
                x_mm=x_mm,
                y_mm=y_mm,
                contrast=float(reflectance[code_of_level[condition.level]]) / background - 1.0,
            )
            for condition, x_mm, y_mm in content
        )
        name = f"sheets/{page_number:02d}.svg"
        pages.append(Page(number=page_number, file=name, triangles=triangles, patches=patches))
    chart = design.chart("print", paper.paper_width_mm, paper.paper_height_mm, pages, markers=sheet.markers)
    origin = "nominal" if paper.reflectances is None else "as measured"
    drawings = []
    for page in chart.pages:
        shapes: list[Shape] = [
            rectangle(sheet.left_mm, sheet.top_mm, sheet.width_mm, sheet.height_mm, background_code)
        ]
        if page.edges and camera is not None:
            shapes += map(rectangle, *zip(*camera.patches_mm, strict=True), camera.patch_codes)
            shapes.append(area(camera.square_mm, camera.square_code))
        for triangle in page.triangles:
            corners = vertices(
                size=triangle.size_mm, orientation=triangle.orientation, x=triangle.x_mm, y=triangle.y_mm
            )
            shapes.append(area(corners, code_of_level[abs(triangle.contrast_asked or triangle.strength)]))
        shapes += _marker_shapes(chart, page)
        shapes += _patch_shapes(patches, patch_codes)
        shapes += _ruler(sheet)
        shapes += _text(chart, page, sheet, f"{least:.2g} to {largest:.2g}, {origin}")
        drawings.append((str(page.file), Drawing(chart.page_width_mm, chart.page_height_mm, tuple(shapes))))
    write_drawings(folder, chart, drawings, "chart.pdf", progress)
    return chart


def _codes(
    design: Design, reflectance: FloatArray, background_code: int, least: float, largest: float
) -> dict[float, int]:
    """Return the nearest code value of each level. Raises SettingsError if there is none of its own."""
    level_of: dict[int, float] = {}
    for level in design.levels:
        contrast = design.polarity * level
        wanted = reflectance[background_code] * (1.0 + contrast)
        code = int(np.argmin(np.abs(reflectance - wanted)))
        if level > largest * (1.0 + 1e-9) or code == background_code:
            raise SettingsError(
                f"contrasts: found {contrast:g}, expected {least:.2g} to {largest:.3g}, which the paper's greys "
                "have; change background_reflectance, or take a screen for weaker ones"
            )
        if code in level_of:
            raise SettingsError(
                f"contrasts: {level_of[code]:g} and {level:g} have the same printed grey (code value {code}); "
                f"expected contrasts at least {least:.2g} apart"
            )
        level_of[code] = level
    return {level: code for code, level in level_of.items()}


def _sheet(paper: Paper) -> _Sheet:
    width_mm, height_mm, margin_mm = paper.paper_width_mm, paper.paper_height_mm, paper.margin_mm
    marker_mm = MARKER_SHARE * min(width_mm, height_mm) if paper.marker_mm is None else paper.marker_mm
    module_mm = marker_mm / MODULES
    band_mm = (MODULES + 2) * module_mm
    inner_width_mm = width_mm - 2.0 * (margin_mm + band_mm + GAP_MM)
    field_height_mm = height_mm - 2.0 * (margin_mm + band_mm + GAP_MM)
    if inner_width_mm < LEAST_RULER_MM or field_height_mm <= 0.0:
        raise SettingsError(
            f"paper_width_mm × paper_height_mm: found {width_mm:g} × {height_mm:g}, too small for markers of "
            f"{marker_mm:g} mm and margins of {margin_mm:g} mm; expected larger paper or smaller markers"
        )
    markers = Markers.in_corners(width_mm=width_mm, height_mm=height_mm, module_mm=module_mm, margin_mm=margin_mm)
    inner_mm = margin_mm + band_mm + GAP_MM, width_mm - margin_mm - band_mm - GAP_MM
    beside_mm = band_mm / 2.0 + GAP_MM
    # The marker below stands beside the ruler, between the thirds of the sheet: as good as the middle.
    left, right = markers.top_left.x_mm, markers.top_right.x_mm
    ruler_mm = _ruler_mm(left + MOST_BESIDE * (right - left) - beside_mm - inner_mm[0])
    above: Parts = ((inner_mm[0], inner_width_mm),)
    below = above
    if paper.markers == "borders" and ruler_mm >= LEAST_RULER_MM:
        x_above_mm, x_below_mm = width_mm / 2.0, max(width_mm / 2.0, inner_mm[0] + ruler_mm + beside_mm)
        above, below = (
            ((inner_mm[0], x - beside_mm - inner_mm[0]), (x + beside_mm, inner_mm[1] - x - beside_mm))
            for x in (x_above_mm, x_below_mm)
        )
        borders = (
            Point(x_mm=x_above_mm, y_mm=markers.top_left.y_mm),
            Point(x_mm=x_below_mm, y_mm=markers.bottom_left.y_mm),
        )
        markers = replace(markers, borders=borders)
    return _Sheet(
        markers=markers,
        band_mm=band_mm,
        left_mm=margin_mm,
        top_mm=margin_mm + band_mm + GAP_MM,
        width_mm=width_mm - 2.0 * margin_mm,
        height_mm=field_height_mm,
        above_mm=above,
        below_mm=below,
    )


def _ruler_mm(room_mm: float) -> float:
    """Return the length of the longest ruler that has room; 0 if there is none."""
    return min(RULER_MM, max(0.0, math.floor(room_mm / LEAST_RULER_MM) * LEAST_RULER_MM))


def _places(design: Design, size_mrad: float, sheet: _Sheet) -> list[tuple[float, float]]:
    """Return the places for triangles of one size on a sheet, from the middle outwards; SettingsError if there is
    none."""
    size_mm = design.check_size(size_mrad, LEAST_PRINTED_SIZE_MM, "in which the printer's dots show")
    field_mm = FIELD_PER_SIZE * size_mm
    axes = []
    for start_mm, length_mm in ((sheet.top_mm, sheet.height_mm), (sheet.left_mm, sheet.width_mm)):
        if field_mm > length_mm:
            most_mrad = min(sheet.height_mm, sheet.width_mm) / FIELD_PER_SIZE / design.distance_m
            raise SettingsError(
                f"sizes_mrad: {size_mrad:g} mrad at {design.distance_m:g} m are {size_mm:.4g} mm, and with the "
                f"background that the observer needs {field_mm:.4g} mm; the paper has {length_mm:.4g} mm; "
                f"expected at most {most_mrad:.3g} mrad, larger paper or a smaller distance"
            )
        count = 1 + math.floor((length_mm - field_mm) / (SPACING_PER_SIZE * size_mm))
        ends = (field_mm / 2.0, length_mm - field_mm / 2.0) if count > 1 else (length_mm / 2.0, length_mm / 2.0)
        axes.append(start_mm + np.linspace(*ends, count))
    middle_x, middle_y = sheet.left_mm + sheet.width_mm / 2.0, sheet.top_mm + sheet.height_mm / 2.0
    places = [(float(x), float(y)) for y in axes[0] for x in axes[1]]
    return sorted(places, key=lambda place: math.hypot(place[0] - middle_x, place[1] - middle_y))


def _patches(sheet: _Sheet, paper: Paper, levels: Sequence[float]) -> tuple[Patch, ...]:
    """Return the grey patches of every sheet, from left to right, with these reflectances."""
    n_in_part, height_mm = N_PATCHES // len(sheet.above_mm), 0.7 * sheet.band_mm
    slots = [
        (left + k * width / n_in_part, paper.margin_mm, width / n_in_part, height_mm)
        for left, width in sheet.above_mm
        for k in range(n_in_part)
    ]
    return grey_patches(slots, levels, "reflectance")


def _marker_shapes(chart: Chart, page: Page) -> list[Shape]:
    assert chart.markers is not None
    side_mm = chart.markers.side_mm
    module_mm = side_mm / MODULES
    shapes: list[Shape] = []
    for bits, centre_mm in chart.drawn_markers(page):
        x_mm, y_mm = centre_mm.tolist()
        left, top = x_mm - side_mm / 2.0, y_mm - side_mm / 2.0
        shapes.append(rectangle(left, top, side_mm, side_mm, 0))
        # Runs of white modules along rows and along columns: where they only touch, programs may show a line.
        for row, start, stop in _runs(bits):
            corner = left + start * module_mm, top + row * module_mm
            shapes.append(rectangle(*corner, (stop - start) * module_mm, module_mm, WHITE))
        for column, start, stop in _runs(bits.T):
            corner = left + column * module_mm, top + start * module_mm
            shapes.append(rectangle(*corner, module_mm, (stop - start) * module_mm, WHITE))
    return shapes


def _runs(bits: NDArray[np.bool_]) -> Iterator[tuple[int, int, int]]:
    """Yield (row, start, stop) of each run of True in each row."""
    for row, values in enumerate(bits):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]])))
        for start, stop in edges.reshape(-1, 2).tolist():
            yield row, start, stop


def _patch_shapes(patches: Sequence[Patch], codes: Sequence[int]) -> list[Shape]:
    shapes: list[Shape] = []
    for patch, code in zip(patches, codes, strict=True):
        left, top = patch.x_mm - patch.width_mm / 2.0, patch.y_mm - patch.height_mm / 2.0
        grey = rectangle(left, top, patch.width_mm, patch.height_mm, code)
        shapes += [grey, Outline(grey.corners_mm)]
        shapes.append(Text(patch.x_mm, top + patch.height_mm + 3.5, str(code), 3.0, "middle"))
    return shapes


def _ruler(sheet: _Sheet) -> list[Shape]:
    """Return the ruler below the grey field; the left edge of each tick is its mark."""
    left, top = sheet.below_mm[0][0], sheet.top_mm + sheet.height_mm + GAP_MM
    ticks = range(round(sheet.ruler_mm / RULER_STEP_MM) + 1)
    return [
        rectangle(left, top + TICK_MM, sheet.ruler_mm, LINE_MM, 0),
        *(rectangle(left + k * RULER_STEP_MM, top, LINE_MM, TICK_MM, 0) for k in ticks),
    ]


def _text(chart: Chart, page: Page, sheet: _Sheet, contrasts: str) -> list[Shape]:
    """Return the text in the last part of the band below: beside the ruler, or below it."""
    sizes = (f"{triangle.size_mrad:g} mrad = {triangle.size_mm:.4g} mm" for triangle in page.triangles)
    content = next(sizes, "slanted edges and a grey wedge, to measure the camera")
    lines = [
        f"{sheet.ruler_mm:g} mm from the first to the last mark. Print at 100 %, without fitting to the page.",
        f"{chart.name}, key {chart.key}: sheet {page.number + 1} of {len(chart.pages)}, for a distance of "
        f"{chart.distance_m:g} m; {content}",
        f"Contrasts of 8-bit greys: {contrasts}. Numbers at the patches are code values; measure the patches.",
    ]
    below_mm = TICK_MM + 1.0 if len(sheet.below_mm) == 1 else 0.0
    left, width_mm = sheet.below_mm[-1]
    top = sheet.top_mm + sheet.height_mm + GAP_MM + below_mm
    letter_mm, room_mm = LETTER_MM, sheet.band_mm - below_mm - 1.0
    while True:
        wrapped = [
            part for line in lines for part in textwrap.wrap(line, int(width_mm / letter_mm / LETTER_WIDTH))
        ]
        if len(wrapped) * LINE_SPACING * letter_mm <= room_mm:
            break
        letter_mm *= SMALLER
    return [
        Text(left, top + letter_mm * (LINE_SPACING * k + 1.0), line, letter_mm) for k, line in enumerate(wrapped)
    ]


LEAST_HOLE_SIZE_MM = 1.0
"""Smallest √(area) of a hole: corners of smaller ones cannot be cut sharp enough."""

BORDER_MM = 20.0
"""Border of the drawing around the plate, for the text."""


def make_thermal_chart(design: Design, plate_mm: float | None, folder: Path, progress: Progress | None) -> Chart:
    """Lay out plates with one hole each, and write their drawings and a schedule to fill in into an empty folder.
    All settings of a plate come one after the other. In each block of a plate, the temperature differences are in
    random order. For each of them, the plate is turned to the four orientations, in random order too. Raises
    SettingsError if a hole is too small to be cut, or the plate too small for a hole.
    """
    largest_mm = design.size_mm(max(design.sizes_mrad))
    needed_mm = FIELD_PER_SIZE * largest_mm
    side_mm = math.ceil(needed_mm / 10.0) * 10.0 if plate_mm is None else plate_mm
    design.check_size(min(design.sizes_mrad), LEAST_HOLE_SIZE_MM, "whose corners cannot be cut")
    if side_mm < needed_mm:
        raise SettingsError(
            f"plate_mm: found {side_mm:g}, expected at least {needed_mm:.4g}: five sizes of the largest triangle "
            f"({largest_mm:.4g} mm), the part of the background that the observer needs"
        )
    middle_mm = side_mm / 2.0
    pages = (
        Page(
            number=number,
            triangles=(
                Triangle(
                    orientation=condition.orientation,
                    size_mrad=condition.size_mrad,
                    size_mm=design.size_mm(condition.size_mrad),
                    x_mm=middle_mm,
                    y_mm=middle_mm,
                    delta_t_k=design.polarity * condition.level,
                ),
            ),
        )
        for number, condition in enumerate(_order(design))
    )
    chart = design.chart("thermal", side_mm, side_mm, pages)
    drawings = [(f"plates/plate_{size:g}_mrad.svg", _drawing(design, size, side_mm)) for size in design.sizes_mrad]
    write_drawings(folder, chart, drawings, "plates.pdf", progress)
    (folder / "schedule.csv").write_text(_schedule(chart), encoding="utf-8")
    return chart


def _order(design: Design) -> Iterator[Condition]:
    generator = np.random.default_rng(design.seed)
    for size in generator.permutation(design.sizes_mrad):
        for _ in range(design.repeats):
            for level in generator.permutation(design.levels):
                for turn in generator.permutation(len(Orientation)):
                    yield Condition(float(size), float(level), tuple(Orientation)[turn])


def _drawing(design: Design, size_mrad: float, side_mm: float) -> Drawing:
    """Draw a plate with its hole, upright, and the lengths that it is cut by."""
    size_mm = design.size_mm(size_mrad)
    x_mm, y_mm = BORDER_MM + side_mm / 2.0, BORDER_MM + side_mm / 2.0
    hole = area(vertices(size=size_mm, orientation=Orientation.UP, x=x_mm, y=y_mm), 0)
    far = BORDER_MM + side_mm
    lines = [
        f"{design.name}: {size_mrad:g} mrad at {design.distance_m:g} m, scale 1 : 1, plate {side_mm:g} mm",
        f"Hole: equilateral, side {SIDE_PER_SIZE * size_mm:.3f} mm, height {HEIGHT_PER_SIZE * size_mm:.3f} mm, "
        f"area ({size_mm:.4g} mm)²",
        f"Centroid in the middle of the plate, {HEIGHT_PER_SIZE * size_mm / 3.0:.3f} mm from each side",
    ]
    height_mm = min(3.0, (side_mm + 2.0 * BORDER_MM - 6.0) / 0.55 / max(map(len, lines)))
    shapes: list[Shape] = [
        Outline(rectangle(BORDER_MM, BORDER_MM, side_mm, side_mm, 0).corners_mm),
        Outline(hole.corners_mm),
        *(Text(3.0, 4.0 + 1.5 * height_mm * k, line, height_mm) for k, line in enumerate(lines)),
    ]
    # Marks at the plate's edges show its middle, also when it is turned.
    for end in (BORDER_MM - 3.0, far):
        shapes += [rectangle(x_mm, end, 0.1, 3.0, 0), rectangle(end, y_mm, 3.0, 0.1, 0)]
    page_mm = side_mm + 2.0 * BORDER_MM
    return Drawing(page_mm, page_mm, tuple(shapes))


def _schedule(chart: Chart) -> str:
    """Return the table of settings as `todframes import --schedule` reads it, files and times still empty."""
    header = ["file", "start_s", "end_s", "orientation", "size_mrad", "delta_t_k", "polarity"]
    holes = [hole for page in chart.pages for hole in page.triangles]
    empty = ["", "", ""]
    rows = [[*empty, hole.orientation, hole.size_mrad, abs(hole.strength), chart.polarity] for hole in holes]
    return csv_text([header, *rows])
