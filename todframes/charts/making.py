"""Making of charts of any kind, as `todframes chart` does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

from todframes.base.errors import SettingsError
from todframes.base.output import new_folder
from todframes.base.reading import convert, from_table
from todframes.base.seeds import Rng, seed_of
from todframes.charts.design import Design
from todframes.charts.layout import CHART_FILE, Chart, ChartKind, MarkerPlaces, Screen
from todframes.charts.print import Paper, design_print_chart, write_print_chart
from todframes.charts.screen import design_screen_chart, write_screen_chart
from todframes.charts.thermal import Plate, design_thermal_chart, write_thermal_chart
from todframes.display.display import Display
from todframes.display.display_files import find_display

DEFAULT_CONTRASTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)

DEFAULT_LEVELS: dict[ChartKind, tuple[float, ...]] = {
    "screen": DEFAULT_CONTRASTS,
    "print": DEFAULT_CONTRASTS,
    "thermal": (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0),
}
"""Contrasts, or temperature differences in K, if none are asked for."""

BACKGROUND_SHARE = 0.25
"""Background of a monitor relative to white if none is asked for; contrasts reach from -1 to 3."""

SETTINGS: dict[ChartKind, set[str]] = {
    "screen": {field.name for field in fields(Screen)} | {"display", "marker_mm", "markers", "camera_page"},
    "print": {field.name for field in fields(Paper)},
    "thermal": {field.name for field in fields(Plate)},
}
"""Names of the settings of each kind."""

SCREEN_DEFAULTS = {"width_px": 1920, "height_px": 1080, "page_duration_s": 1.0, "white_luminance_cd_m2": 100.0}
"""Settings of a monitor that need not be given."""

Progress = Callable[[int], None]


def chart(
    kind: ChartKind,
    *,
    out: Path | str,
    distance_m: float,
    sizes_mrad: Iterable[float],
    contrasts: Iterable[float] | None = None,
    delta_t_k: Iterable[float] | None = None,
    repeats: int = 2,
    rng: Rng = 1,
    polarity: int = 1,
    name: str = "TOD chart",
    progress: Progress | None = None,
    **settings: Any,
) -> Chart:
    """Make a chart to record with a camera, as `todframes chart` does.

    Parameters
    ----------
    kind : {"screen", "print", "thermal"}
        A monitor, sheets of paper, or plates with holes in front of a black body.
    out : path
        Folder to make, new or empty.
    distance_m : float
        From the camera to the chart.
    sizes_mrad : iterable of float
        Sizes √(area) of the triangles as angles at the camera.
    contrasts : iterable of float, optional
        Weber contrasts of a screen or print, without sign. Default: 0.02 to 0.8.
    delta_t_k : iterable of float, optional
        Temperature differences of a thermal chart in K, without sign. Default: 0.02 to 2.
    repeats : int
        Number of times that each triangle is shown, in each of its four orientations.
    rng : int, SeedSequence or Generator
        Seed of the order.
    polarity : {1, -1}
        Triangles are brighter (warmer) or darker (colder) than their background.
    name : str
        Title of the chart.
    progress : function of an int, optional
        Called with the number of pages that were just drawn.
    **settings
        For "screen": `display`, a name or file as for a dataset; `pixel_pitch_mm`, needed unless the display has
        it; others of the table [screen] of chart.toml; `marker_mm`, `markers`, `camera_page`.
        For "print": `paper_width_mm`, `paper_height_mm`, `margin_mm`, `paper_reflectance`, `black_reflectance`,
        `reflectances`, `background_reflectance`, `marker_mm`, `markers`, `camera_page`. For "thermal": `plate_mm`.
        With `markers="borders"` (default), pages have markers along the borders too, by which `import_recordings`
        solves a lens; with "corners", in the corners alone. `camera_page=True` adds a first page with slanted
        edges and a grey wedge, from which `mtf` and `noise` measure the camera.

    Returns
    -------
    Chart
        Pages and triangles, with the contrasts that they really have.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the chart cannot show a size or a contrast.
    OutputError
        If the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> monitor = {"width_px": 640, "height_px": 480, "pixel_pitch_mm": 0.25}
    >>> place = tempfile.mkdtemp()
    >>> made = tod.chart("screen", out=place, distance_m=10, sizes_mrad=[1], contrasts=[0.2], repeats=1, **monitor)
    >>> len(made.pages), made.pages[0].triangles[0].contrast
    (4, 0.201414)
    """
    if kind not in MAKERS:
        raise SettingsError(f"kind: found {kind!r}, expected one of {', '.join(MAKERS)}")
    for setting in settings:
        others = [other for other in MAKERS if setting in SETTINGS[other] and setting not in SETTINGS[kind]]
        if others:
            raise SettingsError(
                f"{setting}: is given, but a {kind} chart has none; it is for {' and '.join(others)}"
            )
    levels, other = (delta_t_k, contrasts) if kind == "thermal" else (contrasts, delta_t_k)
    if other is not None:
        names = ("contrasts", "delta_t_k")
        given, expected = names if kind == "thermal" else names[::-1]
        raise SettingsError(f"{given}: is given, but a {kind} chart has none; expected {expected}")
    design = from_table(
        {
            "distance_m": distance_m,
            "sizes_mrad": list(sizes_mrad),
            "levels": list(DEFAULT_LEVELS[kind] if levels is None else levels),
            "repeats": repeats,
            "seed": seed_of(rng),
            "polarity": polarity,
            "name": name,
        },
        Design,
        "chart",
    )
    with new_folder(str(out), last=CHART_FILE) as folder:
        return MAKERS[kind](design, settings, folder, progress)


def _screen(design: Design, settings: Mapping[str, Any], folder: Path, progress: Progress | None) -> Chart:
    table = dict(settings)
    display = table.pop("display", None)
    if display is not None:
        table = _of_display(str(display)) | table
    table = SCREEN_DEFAULTS | table
    marker_mm = convert(table.pop("marker_mm", None), float | None, "screen: marker_mm")
    markers = convert(table.pop("markers", "borders"), MarkerPlaces, "screen: markers")
    camera_page = convert(table.pop("camera_page", False), bool, "screen: camera_page")
    white = convert(table["white_luminance_cd_m2"], float, "screen: white_luminance_cd_m2")
    assert isinstance(white, float) and isinstance(marker_mm, float | None)
    table.setdefault("background_luminance_cd_m2", BACKGROUND_SHARE * white)
    screen = from_table(table, Screen, "screen")
    made = design_screen_chart(
        design,
        screen,
        marker_mm=marker_mm,
        markers=cast("MarkerPlaces", markers),
        camera_page=cast("bool", camera_page),
    )
    write_screen_chart(folder, made, progress=progress)
    return made.chart


def _of_display(name: str) -> dict[str, Any]:
    """Return the settings of a monitor that a display of `find_display` gives."""
    display = find_display(name).display
    shared = {field.name for field in fields(Screen)} - {"background_luminance_cd_m2"}
    found = {one: getattr(display, one) for one in shared & {field.name for field in fields(Display)}}
    if display.lut is not None:
        found["white_luminance_cd_m2"] = float(display.lut.luminance_cd_m2[-1])
        found["black_luminance_cd_m2"] = float(display.lut.luminance_cd_m2[0])
    return {one: value for one, value in found.items() if value is not None}


def _print(design: Design, settings: Mapping[str, Any], folder: Path, progress: Progress | None) -> Chart:
    made = design_print_chart(design, from_table(settings, Paper, "print"))
    write_print_chart(folder, made, progress=progress)
    return made.chart


def _thermal(design: Design, settings: Mapping[str, Any], folder: Path, progress: Progress | None) -> Chart:
    made = design_thermal_chart(design, from_table(settings, Plate, "thermal"))
    write_thermal_chart(folder, made, progress=progress)
    return made.chart


MAKERS: dict[ChartKind, Callable[[Design, Mapping[str, Any], Path, Progress | None], Chart]] = {
    "screen": _screen,
    "print": _print,
    "thermal": _thermal,
}
"""Functions that write a chart into an empty folder, by kind."""
