"""Charts for a monitor: an image of its pixels for each page, and an HTML page that plays them."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.charts.design import (
    FIELD_PER_SIZE,
    SURROUND_PER_SIZE,
    CameraContent,
    Condition,
    Design,
    camera_content,
)
from todframes.charts.layout import CHART_FILE, MODULES, Chart, Markers, Page, Screen, Triangle, write_chart
from todframes.display.display import dithered
from todframes.parameters import MarkerPlaces, Progress, counted
from todframes.stimulus import ORIENTATIONS, coverage

LEAST_MONITOR_SIZE_PX = 8.0
"""Smallest √(area) in pixels of the monitor: a pixel, which blurs the edges, is an eighth of it."""

LEAST_STEPS = 36.0
"""Smallest number of pixels that a dithered triangle raises by a code step: fewer look like dots, not like a
triangle."""

LARGEST_ROUNDING = 0.01
"""Largest relative change of a contrast by rounding to a code value; where it is larger, pixels are dithered."""

MARKER_SHARE: dict[MarkerPlaces, float] = {"borders": 0.13, "corners": 0.15}
"""Side of a marker relative to the smaller side of the page if none is asked for. A page of 16 : 9 has room for
twelve of 13 % beside the surround of a triangle of 15 % of its height."""

CORNER_REACH_PER_SIZE = 2.0 / 3.0**0.75
"""Distance from the centroid of a triangle to its corners, in sizes."""


class DrawnTriangle(NamedTuple):
    """The code values of a triangle and some background around it, and whether they are dithered. `contrast` is
    their mean contrast over the triangle's area.
    """

    code: NDArray[np.uint16]
    contrast: float
    is_dithered: bool


def _page_codes(
    chart: Chart, screen: Screen, background_code: int, contents: Sequence[NDArray[np.uint16] | CameraContent]
) -> Iterator[NDArray[np.uint16]]:
    """Yield the code values of each page, shape (rows, columns), given a triangle or another content for each."""
    assert chart.markers is not None
    pitch_mm = screen.pixel_pitch_mm
    module = np.ones([round(chart.markers.side_mm / pitch_mm / MODULES)] * 2, np.uint16)
    for page, content in zip(chart.pages, contents, strict=True):
        codes = np.full((screen.height_px, screen.width_px), background_code, np.uint16)
        for bits, centre_mm in chart.drawn_markers(page):
            with_white = np.pad(bits, 1, constant_values=True)
            modules = np.where(with_white, 2**screen.bits - 1, 0).astype(np.uint16)
            _put(codes, np.kron(modules, module), *(centre_mm / pitch_mm))
        if isinstance(content, CameraContent):
            _put_camera(codes, content, pitch_mm)
        else:
            _put(codes, content, screen.width_px / 2.0, screen.height_px / 2.0)
        yield codes


def _put(codes: NDArray[np.uint16], patch: NDArray[np.uint16], x_edge_px: float, y_edge_px: float) -> None:
    """Write a patch into a page; its centre is given in pixels from the page's top left corner."""
    rows, columns = patch.shape
    top, left = round(y_edge_px - rows / 2.0), round(x_edge_px - columns / 2.0)
    codes[top : top + rows, left : left + columns] = patch


def _put_camera(codes: NDArray[np.uint16], camera: CameraContent, pitch_mm: float) -> None:
    """Write the wedge and the slanted square into a page; pixels whose centre is in the square belong to it."""
    for patch_mm, code in zip(camera.patches_mm, camera.patch_codes, strict=True):
        left, top, width, height = (round(length_mm / pitch_mm) for length_mm in patch_mm)
        codes[top : top + height, left : left + width] = code
    y, x = ((np.arange(n) + 0.5) * pitch_mm for n in codes.shape)
    inside = np.ones(codes.shape, bool)
    for edge in camera.page.edges:
        (x1, y1), (x2, y2) = edge.ends_mm.tolist()
        inside &= (x2 - x1) * (y[:, None] - y1) - (y2 - y1) * (x[None, :] - x1) > 0.0
    codes[inside] = camera.square_code


def make_screen_chart(
    design: Design,
    screen: Screen,
    folder: Path,
    progress: Progress | None,
    *,
    marker_mm: float | None,
    markers: MarkerPlaces,
    camera_page: bool,
) -> Chart:
    """Lay out a chart for a monitor, and write it into an empty folder; each page has one triangle in its middle.
    The background luminance of the screen is replaced by that of the nearest code value, and the side of the
    markers is rounded to whole pixels a module; `MARKER_SHARE` has the default. With `camera_page` the first page
    has slanted edges and a grey wedge. Raises SettingsError if the monitor cannot show a size or a contrast, or
    there is no place for the markers.
    """
    luminance_of_code = _luminance_of_code(screen)
    background_code = int(np.argmin(np.abs(luminance_of_code - screen.background_luminance_cd_m2)))
    if background_code in (0, luminance_of_code.size - 1):
        raise SettingsError(
            f"background_luminance_cd_m2: found {screen.background_luminance_cd_m2:g}, which is black or white; "
            f"expected a luminance between {luminance_of_code[0]:g} and {luminance_of_code[-1]:g}, such as a "
            "quarter of white"
        )
    screen = replace(screen, background_luminance_cd_m2=float(luminance_of_code[background_code]))
    pitch_mm = screen.pixel_pitch_mm
    width_mm, height_mm = screen.width_px * pitch_mm, screen.height_px * pitch_mm
    asked_mm = MARKER_SHARE[markers] * min(width_mm, height_mm) if marker_mm is None else marker_mm
    least_mm, most_mm = 2 * MODULES * pitch_mm, 0.2 * min(width_mm, height_mm)
    if not least_mm <= asked_mm <= most_mm:
        raise SettingsError(
            f"marker_mm: found {asked_mm:g}, expected {least_mm:g} (two pixels a module) to {most_mm:.3g} (a "
            "fifth of the page)"
        )
    module_mm = round(asked_mm / pitch_mm / MODULES) * pitch_mm
    laid = Markers.in_corners(width_mm=width_mm, height_mm=height_mm, module_mm=module_mm, margin_mm=module_mm)
    for size_mrad in design.sizes_mrad:
        _check_size(design, size_mrad, laid, width_mm, height_mm, pitch_mm)
    surrounds_mm = {size_mrad: SURROUND_PER_SIZE * design.size_mm(size_mrad) for size_mrad in design.sizes_mrad}
    if markers == "borders":
        laid = laid.with_borders(free_mm=min(surrounds_mm.values()), step_mm=pitch_mm)
    beside = {size_mrad: laid.borders_beside(surround_mm) for size_mrad, surround_mm in surrounds_mm.items()}
    borders = {size: some if len(some) < len(laid.borders) else None for size, some in beside.items()}
    drawn = {
        condition: _drawn(condition, design, screen, luminance_of_code, background_code)
        for condition in design.conditions
    }
    order = design.order()
    contents: list[NDArray[np.uint16] | CameraContent] = [drawn[condition].code for condition in order]
    pages = []
    if camera_page:
        reach_mm = (0.5 + 2.0 / MODULES) * laid.side_mm  # a module of white, and one of background
        (left, top), (right, bottom) = laid.centres_mm[0].tolist(), laid.centres_mm[2].tolist()
        free_mm = left + reach_mm, top + reach_mm, right - left - 2.0 * reach_mm, bottom - top - 2.0 * reach_mm
        light = luminance_of_code, "luminance_cd_m2", background_code
        camera = camera_content(free_mm, *light, "pages/0000.png", step_mm=pitch_mm)
        contents.insert(0, camera)
        pages.append(camera.page)
    digits = max(4, len(str(len(contents) - 1)))
    for number, condition in enumerate(order, len(pages)):
        triangle = _triangle(condition, design, drawn, x_mm=width_mm / 2.0, y_mm=height_mm / 2.0)
        file, shown = f"pages/{number:0{digits}d}.png", borders[condition.size_mrad]
        pages.append(Page(number=number, file=file, borders=shown, triangles=(triangle,)))
    chart = design.chart("screen", width_mm, height_mm, pages, screen=screen, markers=laid)
    codes = _page_codes(chart, screen, background_code, contents)
    _write(folder, chart, screen, codes, f"{background_code * 255 / (2**screen.bits - 1):.0f}", progress)
    return chart


def _luminance_of_code(screen: Screen) -> FloatArray:
    white = 2**screen.bits - 1
    lut = screen.lut
    if lut is not None and (lut.code_value[0], lut.code_value[-1]) != (0.0, 1.0):
        ends = f"{lut.code_value[0]:g} to {lut.code_value[-1]:g}"
        raise SettingsError(f"lut: code_value runs from {ends}, expected 0 to 1 for the pages of a chart")
    code = np.arange(white + 1.0) / white
    luminance = screen.display.luminance(code[:, np.newaxis, np.newaxis])[:, 0]
    if not (np.diff(luminance) > 0.0).all():
        name = "eotf" if lut is None else "lut"
        raise SettingsError(f"{name}: found luminances that do not rise with the code value, expected them to")
    return luminance


def _check_size(
    design: Design, size_mrad: float, markers: Markers, width_mm: float, height_mm: float, pitch_mm: float
) -> None:
    """Raise SettingsError if a triangle has too few pixels, or its surround no place on the page."""
    size_mm = design.size_mm(size_mrad)
    why = f"{size_mm / pitch_mm:.3g} pixels of the monitor, whose edges are then too coarse"
    design.check_size(size_mrad, LEAST_MONITOR_SIZE_PX * pitch_mm, why)
    half_mm = FIELD_PER_SIZE / 2.0 * size_mm
    # Half of a square that keeps clear of the page's edge, and of each marker in x or in y.
    border_mm = (0.5 + 1.0 / MODULES) * markers.side_mm
    from_middle_mm = np.abs(markers.centres_mm - [width_mm / 2.0, height_mm / 2.0]) - border_mm
    room_mm = min(width_mm / 2.0, height_mm / 2.0, float(from_middle_mm.max(axis=1).min()))
    if half_mm > room_mm:
        raise SettingsError(
            f"sizes_mrad: {size_mrad:g} mrad at {design.distance_m:g} m are {size_mm:.4g} mm, and with the "
            f"background that the observer needs {2.0 * half_mm:.4g} mm; the page has {2.0 * room_mm:.4g} mm "
            "between its edges and markers; expected at most "
            f"{2.0 * room_mm / FIELD_PER_SIZE / design.distance_m:.3g} mrad, or a smaller distance"
        )


def _drawn(
    condition: Condition, design: Design, screen: Screen, luminance_of_code: FloatArray, background_code: int
) -> DrawnTriangle:
    """Draw a triangle in code values. Raises SettingsError if the monitor cannot show its contrast."""
    background = luminance_of_code[background_code]
    contrast = design.polarity * condition.level
    wanted = background * (1.0 + contrast)
    if not luminance_of_code[0] <= wanted <= luminance_of_code[-1]:
        most = luminance_of_code[0 if contrast < 0 else -1] / background - 1.0
        raise SettingsError(
            f"contrasts: found {contrast:g}, expected {abs(most):.3g} at most, the range of the monitor with a "
            f"background of {background:.4g} cd/m²; change background_luminance_cd_m2 for more"
        )
    size_px = design.size_mm(condition.size_mrad) / screen.pixel_pitch_mm
    step = abs(luminance_of_code[background_code + design.polarity] - background)
    n_steps = condition.level * background * size_px**2 / step
    if n_steps < LEAST_STEPS:
        smallest = condition.level * LEAST_STEPS / n_steps
        raise SettingsError(
            f"contrasts: {contrast:g} at {condition.size_mrad:g} mrad would raise {n_steps:.2g} of the triangle's "
            f"{size_px**2:.0f} pixels by a code step, which are some dots and no triangle; expected a contrast of "
            f"at least {smallest:.2g}, or {argument.bits} 10 on a monitor that has them"
        )
    nearest = luminance_of_code[int(np.argmin(np.abs(luminance_of_code - wanted)))]
    is_dithered = bool(abs(nearest - wanted) > LARGEST_ROUNDING * abs(wanted - background))
    # The patch has an even number of rows if the page has, so that their middles meet.
    reach = int(np.ceil(CORNER_REACH_PER_SIZE * size_px)) + 1
    rows, columns = (2 * reach + pixels % 2 for pixels in (screen.height_px, screen.width_px))
    covered = coverage(
        (rows, columns),
        size_px=size_px,
        x_px=(columns - 1) / 2.0,
        y_px=(rows - 1) / 2.0,
        orientation=condition.orientation,
    )
    luminance = background + ((wanted if is_dithered else nearest) - background) * covered
    code = dithered(luminance, luminance_of_code)
    shown = float(np.sum(luminance_of_code[code] - background)) / (background * size_px**2)
    return DrawnTriangle(code, shown, is_dithered)


def _triangle(
    condition: Condition, design: Design, drawn: dict[Condition, DrawnTriangle], *, x_mm: float, y_mm: float
) -> Triangle:
    """Return the description of a triangle. All four orientations of a level get the mean of their contrasts.
    These differ by at most one code step of one pixel.
    """
    alike = [drawn[condition._replace(orientation=orientation)] for orientation in ORIENTATIONS]
    # The area of covered pixels is off by 1e-5, which must not make black darker than black.
    contrast = max(-1.0, float(np.mean([triangle.contrast for triangle in alike])))
    return design.triangle(condition, x_mm=x_mm, y_mm=y_mm, contrast=contrast, dithered=alike[0].is_dithered)


def _write(
    folder: Path,
    chart: Chart,
    screen: Screen,
    page_codes: Iterable[NDArray[np.uint16]],
    grey: str,
    progress: Progress | None,
) -> None:
    """Write `chart.toml`, the pages as PNG files and the player into an existing, empty folder. The PNG files have
    one channel. 8-bit code values are stored as they are; of 10 bits, code · 65535 / 1023, rounded, in 16 bits, so
    that any reader that divides by full scale gets code / 1023. Raises SettingsError if there are more pages than
    a `chart.toml` can hold.
    """
    import cv2

    write_chart(folder / CHART_FILE, chart)
    (folder / "pages").mkdir()
    settings = {
        "width_px": screen.width_px,
        "height_px": screen.height_px,
        "page_duration_s": screen.page_duration_s,
        "bits": screen.bits,
        "background": f"rgb({grey}, {grey}, {grey})",
    }
    template = resources.files("todframes.charts").joinpath("templates", "player.html")
    head, _, foot = template.read_text(encoding="utf-8").partition("{{ pages }}")
    head = head.replace("{{ settings }}", json.dumps(settings)).replace("{{ name }}", html.escape(chart.name))
    dtype, scale = (np.uint8, 1.0) if screen.bits == 8 else (np.uint16, 65535 / (2**screen.bits - 1))
    with (folder / "play.html").open("w", encoding="utf-8") as player:
        player.write(head)
        for page, codes in counted(zip(chart.pages, page_codes, strict=True), len(chart.pages), progress):
            stored: NDArray[Any] = np.rint(codes * scale).astype(dtype)
            png = cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()
            assert page.file is not None
            (folder / page.file).write_bytes(png)
            player.write(f'"{base64.b64encode(png).decode()}",\n')
        player.write(foot)
