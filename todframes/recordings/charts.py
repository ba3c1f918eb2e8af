"""Making of charts of any kind, as `todframes chart` does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from todframes.config import convert, from_table
from todframes.errors import SettingsError
from todframes.output import new_folder
from todframes.recordings.chart_design import Design
from todframes.recordings.chart_layout import CHART_FILE, Chart, ChartKind, Screen

CONTRASTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Contrasts of a chart if none are asked for."""


BACKGROUND_SHARE = 0.25
"""Background of a monitor relative to white if none is asked for; contrasts reach from -1 to 3."""


SCREEN_DEFAULTS = {"width_px": 1920, "height_px": 1080, "page_duration_s": 1.0, "white_luminance_cd_m2": 100.0}
"""Settings of a monitor that need not be given."""


Progress = Callable[[int], None]


def chart(
    kind: ChartKind,
    *,
    out: Path | str,
    distance_m: float,
    sizes_mrad: Iterable[float],
    contrasts: Iterable[float] = CONTRASTS,
    repeats: int = 2,
    seed: int = 1,
    polarity: int = 1,
    name: str = "TOD chart",
    overwrite: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Chart:
    """Make a chart to record with a camera, as `todframes chart` does.

    Parameters
    ----------
    kind : {"screen", "print", "thermal"}
        A monitor, sheets of paper, or plates with holes in front of a black body.
    out : path
        Folder to make.
    distance_m : float
        From the camera to the chart.
    sizes_mrad : iterable of float
        Sizes √(area) of the triangles as angles at the camera.
    contrasts : iterable of float
        Weber contrasts, without sign; of a thermal chart `delta_t_k`, temperature differences in K, instead.
    repeats : int
        Number of times that each triangle is shown, in each of its four orientations.
    seed : int
        Seed of the order.
    polarity : {1, -1}
        Triangles are brighter (warmer) or darker (colder) than their background.
    name : str
        Title of the chart.
    overwrite : bool
        Replace `out` if it is a chart that this function wrote.
    progress : function of an int, optional
        Called with the number of pages that were just drawn.
    **settings
        Of a monitor, fields of `Screen` (`pixel_pitch_mm` is needed) and `marker_mm`.

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
    design = from_table(
        {
            "distance_m": distance_m,
            "sizes_mrad": list(sizes_mrad),
            "levels": list(contrasts),
            "repeats": repeats,
            "seed": seed,
            "polarity": polarity,
            "name": name,
        },
        Design,
        "chart",
    )
    if kind not in MAKERS:
        raise SettingsError(f"kind: found {kind!r}, expected one of {', '.join(MAKERS)}")
    with new_folder(str(out), overwrite=overwrite, last=CHART_FILE) as folder:
        return MAKERS[kind](design, settings, folder, progress)


def _screen(design: Design, settings: Mapping[str, Any], folder: Path, progress: Progress | None) -> Chart:
    from todframes.recordings.screen_chart import design_screen_chart, write_screen_chart

    table = SCREEN_DEFAULTS | dict(settings)
    marker_mm = table.pop("marker_mm", None)
    white = convert(table["white_luminance_cd_m2"], float, "screen: white_luminance_cd_m2")
    assert isinstance(white, float)
    table.setdefault("background_luminance_cd_m2", BACKGROUND_SHARE * white)
    screen = from_table(table, Screen, "screen")
    made = design_screen_chart(design, screen, marker_mm=marker_mm)
    write_screen_chart(folder, made, progress=progress)
    return made.chart


MAKERS = {"screen": _screen}
"""Functions that write a chart into an empty folder, by kind."""
