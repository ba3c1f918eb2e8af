"""The description of a chart, `chart.toml`: the content of each page, and its place.

Places on a page are in millimetres from its top left corner, x to the right and y down. The centre of the pixel in
column c of a monitor lies at x_mm = (c + 0.5) · pixel_pitch_mm.

The marker at corner k (see `CORNERS`) of a page has the id 4·digit + k, where 0 ≤ digit < 250. The digits are the
page's number modulo 250, the number divided by 250, again the number modulo 250, and the key of the chart. So each
marker states its corner, and a blend of two pages is noticed: it has markers of both. Markers along the borders
state their place alone, are the same on all pages, and come from another dictionary.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import (
    MAX_TOML_MB,
    check_values,
    check_whole,
    convert,
    from_table,
    read_toml,
    toml_text,
    without_schema,
)
from todframes.display.display import Display, Eotf, Luminance, LuminanceTable
from todframes.parameters import Bits, ChartKind
from todframes.stimulus import Orientation

SCHEMA = 1
"""Version of the format of `chart.toml` that this package reads and writes."""

CHART_FILE = "chart.toml"

SIZE_TOLERANCE = 1e-3
"""Largest relative difference between size_mm and size_mrad · distance_m."""

GRID_TOLERANCE = 1e-6
"""Part of a step by which a place on a grid may be off by rounding."""

LARGEST_ON_CHART = 1e6
"""Largest length in mm or m, size in mrad or ΔT in K; a larger one is a mistake."""

Length = Annotated[float, Meta(ge=1.0 / LARGEST_ON_CHART, le=LARGEST_ON_CHART)]

Place = Annotated[float, Meta(ge=0.0, le=LARGEST_ON_CHART)]

CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")
"""Names of the corners in the order of the markers, clockwise."""

DICTIONARY = "5x5_1000"
"""Name of the markers' dictionary in chart.toml; OpenCV calls it DICT_5X5_1000."""

BORDER_DICTIONARY = "aruco_original"
"""Name of the dictionary of the markers along the borders; OpenCV calls it DICT_ARUCO_ORIGINAL."""

BORDER_IDS = (27, 72, 480, 533, 617, 638, 847, 955)
"""Ids of the markers along the borders, in their order in chart.toml. In any turn they differ in five modules or
more from all markers of `DICTIONARY`, as these do from each other, and in nine from one another."""

MODULES = 7
"""Side of a marker in modules, its black border of one module included."""

N_DIGITS = 250
"""Number of values of a digit: the dictionary has 1000 markers, and there are four corners."""

MOST_PAGES = N_DIGITS**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A place on a page, in mm from its top left corner."""

    x_mm: Place
    y_mm: Place

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Markers:
    """The ArUco markers of all pages: the centres of those in the corners and along the borders. `dictionary` is
    that of the markers in the corners, `side_mm` their side with the black border. Those along the borders are in
    the order of `BORDER_IDS`; charts made before there were such markers have none.
    """

    side_mm: Length
    top_left: Point
    top_right: Point
    bottom_right: Point
    bottom_left: Point
    dictionary: Literal["5x5_1000"] = "5x5_1000"
    borders: Annotated[tuple[Point, ...], Meta(max_length=len(BORDER_IDS))] = ()

    def __post_init__(self) -> None:
        check_values(self)

    @classmethod
    def in_corners(cls, *, width_mm: float, height_mm: float, module_mm: float, margin_mm: float) -> Markers:
        """Return markers whose white borders, of one module, keep a margin to the edges of a page."""
        near = margin_mm + (1.0 + MODULES / 2.0) * module_mm
        far_x, far_y = width_mm - near, height_mm - near
        return cls(
            side_mm=MODULES * module_mm,
            top_left=Point(x_mm=near, y_mm=near),
            top_right=Point(x_mm=far_x, y_mm=near),
            bottom_right=Point(x_mm=far_x, y_mm=far_y),
            bottom_left=Point(x_mm=near, y_mm=far_y),
        )

    @property
    def centres_mm(self) -> FloatArray:
        """Centres (x, y) of those in the corners in the order of `CORNERS`, shape (4, 2)."""
        return self.all_centres_mm[: len(CORNERS)]

    @property
    def all_centres_mm(self) -> FloatArray:
        """Centres (x, y): those in the corners in the order of `CORNERS`, then along the borders, shape (n, 2)."""
        points = [*(getattr(self, corner) for corner in CORNERS), *self.borders]
        return np.array([(point.x_mm, point.y_mm) for point in points])

    def with_borders(self, *, free_mm: float, step_mm: float) -> Markers:
        """Return the markers with two more along each side of the page, at thirds between the corners. A square of
        side `free_mm` in the middle of the page stays free of them: where they would reach into it, they stand
        nearer to the corners, and a side that has no place for them has none. Distances from the corners are
        multiples of `step_mm`.
        """
        # A module of white about each, and one of background between: all edges have the same neighbours.
        reach_mm, apart_mm = (0.5 + 1.0 / MODULES) * self.side_mm, (1.0 + 3.0 / MODULES) * self.side_mm
        corners = self.centres_mm
        (left, top), (right, bottom) = corners[0].tolist(), corners[2].tolist()
        places: list[tuple[float, float]] = []
        for length, across, is_row in ((right - left, bottom - top, True), (bottom - top, right - left, False)):
            from_corner = length / 3.0
            if across / 2.0 - reach_mm < free_mm / 2.0:
                from_corner = min(from_corner, (length - free_mm) / 2.0 - reach_mm)
            from_corner = math.floor(from_corner / step_mm + GRID_TOLERANCE) * step_mm
            if apart_mm - GRID_TOLERANCE * step_mm <= from_corner <= length - from_corner - apart_mm:
                along = (from_corner, length - from_corner)
                if is_row:
                    places += [(left + x, y) for y in (top, bottom) for x in along]
                else:
                    places += [(x, top + y) for x in (left, right) for y in along]
        return replace(self, borders=tuple(Point(x_mm=x, y_mm=y) for x, y in places))

    def borders_beside(self, free_mm: float) -> tuple[int, ...]:
        """Return the numbers of the markers along the borders that a square in the middle stays free of."""
        corners, borders = np.split(self.all_centres_mm, [len(CORNERS)])
        away_mm = np.abs(borders - corners.mean(axis=0)).max(axis=1, initial=0.0)
        away_mm = away_mm - (0.5 + 1.0 / MODULES) * self.side_mm + GRID_TOLERANCE
        return tuple(np.flatnonzero(away_mm >= free_mm / 2.0).tolist())


@dataclass(frozen=True, slots=True, kw_only=True)
class Triangle:
    """A triangle on a page, its centroid at (x_mm, y_mm). `size_mrad` is √(area) as an angle at the camera,
    `size_mm` = size_mrad · distance_m that on the page. `contrast` is the Weber contrast to the background that
    the page really has, below zero if darker, and `contrast_asked` the one that was asked for, if it differs. If
    it is `dithered`, the contrast is a mean over pixels of two code values. Triangles of a thermal chart have the
    temperature difference `delta_t_k` instead, below zero if colder.
    """

    orientation: Orientation
    size_mrad: Length
    size_mm: Length
    x_mm: Place
    y_mm: Place
    contrast: Annotated[float, Meta(ge=-1.0, le=LARGEST_ON_CHART)] | None = None
    contrast_asked: Annotated[float, Meta(ge=-1.0, le=LARGEST_ON_CHART)] | None = None
    dithered: bool = False
    delta_t_k: Annotated[float, Meta(ge=-LARGEST_ON_CHART, le=LARGEST_ON_CHART)] | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if (self.contrast is None) == (self.delta_t_k is None):
            found = "none" if self.contrast is None else "both"
            raise SettingsError(f"contrast and delta_t_k: found {found}, expected one of them")
        if self.strength == 0.0:
            raise SettingsError(
                "contrast or delta_t_k: found 0, expected a triangle that differs from its background"
            )

    @property
    def strength(self) -> float:
        """Contrast or temperature difference in K, with its sign."""
        strength = self.delta_t_k if self.contrast is None else self.contrast
        assert strength is not None
        return strength


@dataclass(frozen=True, slots=True, kw_only=True)
class Patch:
    """A uniform grey rectangle on a page, to measure, with its centre and its nominal luminance or reflectance."""

    x_mm: Place
    y_mm: Place
    width_mm: Length
    height_mm: Length
    reflectance: Annotated[float, Meta(ge=0.0, le=2.0)] | None = None
    luminance_cd_m2: Annotated[float, Meta(ge=0.0, le=1e12)] | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if (self.reflectance is None) == (self.luminance_cd_m2 is None):
            found = "none" if self.reflectance is None else "both"
            raise SettingsError(f"reflectance and luminance_cd_m2: found {found}, expected one of them")


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """A straight edge between two greys on a page, to measure an MTF across; within `free_mm` is nothing else."""

    x1_mm: Place
    y1_mm: Place
    x2_mm: Place
    y2_mm: Place
    free_mm: Length

    def __post_init__(self) -> None:
        check_values(self)
        if (self.x1_mm, self.y1_mm) == (self.x2_mm, self.y2_mm):
            raise SettingsError("x2_mm, y2_mm: found x1_mm and y1_mm again, expected the other end of an edge")

    @property
    def ends_mm(self) -> FloatArray:
        """Its two ends (x, y), shape (2, 2)."""
        return np.array([[self.x1_mm, self.y1_mm], [self.x2_mm, self.y2_mm]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A page of a chart: an image on the monitor, a sheet of paper, or a setting of the plate. `file` is its path
    in the chart's folder; None for a setting of the plate. `borders` are the numbers of the markers along the
    borders that it has; None for all. A page with `edges` in place of triangles is that by which the camera is
    measured.
    """

    number: Annotated[int, Meta(ge=0, le=MOST_PAGES - 1)]
    triangles: tuple[Triangle, ...] = ()
    edges: tuple[Edge, ...] = ()
    patches: tuple[Patch, ...] = ()
    file: str | None = None
    borders: tuple[Annotated[int, Meta(ge=0, lt=len(BORDER_IDS))], ...] | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if bool(self.triangles) == bool(self.edges):
            found = "both" if self.triangles else "neither"
            raise SettingsError(f"triangles, edges: found {found}, expected one or more of either")
        if self.file is not None:
            path = PurePosixPath(self.file)
            if not path.parts or path.is_absolute() or ".." in path.parts or "\0" in self.file:
                raise SettingsError(f"file: found {self.file!r}, expected a path inside the chart's folder")


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """The monitor that shows a chart; its pixels are those of each page. `background_luminance_cd_m2` is that
    around the triangles; the other luminances are as in the [display] of a dataset. In chart.toml, `lut` has pairs
    of code value and luminance in cd/m².
    """

    width_px: Annotated[int, Meta(ge=1, le=32768)]
    height_px: Annotated[int, Meta(ge=1, le=32768)]
    pixel_pitch_mm: Length
    background_luminance_cd_m2: Luminance
    page_duration_s: Length
    eotf: Eotf = "srgb"
    white_luminance_cd_m2: Luminance = 100.0
    black_luminance_cd_m2: float = 0.0
    gamma: float | None = None
    lut: LuminanceTable | None = None
    bits: Bits = 8

    def __post_init__(self) -> None:
        check_values(self)
        _ = self.display  # checks the rest

    @property
    def display(self) -> Display:
        """The monitor as a display. Its pixels have an arbitrary angle of 1 mrad, because no eye looks at it."""
        return Display(
            eotf=self.eotf,
            white_luminance_cd_m2=self.white_luminance_cd_m2,
            black_luminance_cd_m2=self.black_luminance_cd_m2,
            gamma=self.gamma,
            lut=self.lut,
            background_luminance_cd_m2=self.background_luminance_cd_m2,
            pixel_pitch_mrad=1.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A chart: pages of one size in mm, shown to a camera at a distance.

    Attributes
    ----------
    kind : {"screen", "print", "thermal"}
    name : str
    key : int
        0 to 249; a marker of each page carries it, so that recordings of another chart are noticed.
    seed : int
        Seed of the order of the pages.
    distance_m : float
        From the camera to the page, > 0.
    page_width_mm, page_height_mm : float
    polarity : {1, -1}
        Triangles are brighter (warmer) or darker (colder) than their background.
    pages : tuple of Page
        Numbered from 0 on.
    markers : Markers or None
        None for a thermal chart.
    screen : Screen or None
        None unless the kind is "screen".

    Raises
    ------
    SettingsError
        If a value is out of range or contradicts another.
    """

    kind: ChartKind
    name: str
    distance_m: Length
    page_width_mm: Length
    page_height_mm: Length
    pages: Annotated[tuple[Page, ...], Meta(min_length=1)]
    key: Annotated[int, Meta(ge=0, le=N_DIGITS - 1)] = 0
    seed: Annotated[int, Meta(ge=0)] = 1
    polarity: Literal[1, -1] = 1
    markers: Markers | None = None
    screen: Screen | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if (self.screen is None) == (self.kind == "screen"):
            raise SettingsError(
                f'[screen]: expected it with kind = "screen", and only there; found kind = "{self.kind}"'
            )
        if (self.markers is None) != (self.kind == "thermal"):
            raise SettingsError(f'[markers]: expected it unless kind = "thermal"; found kind = "{self.kind}"')
        if self.screen is not None:
            for side in ("width", "height"):
                expected = getattr(self.screen, f"{side}_px") * self.screen.pixel_pitch_mm
                _check_equal(f"page_{side}_mm", getattr(self, f"page_{side}_mm"), expected, "the pixels give")
        for place, page in enumerate(self.pages):
            where = f"pages[{place}]"
            if page.number != place:
                raise SettingsError(f"{where}: number: found {page.number}, expected {place}")
            if self.kind == "screen" and page.file is None:
                raise SettingsError(f"{where}: file is missing")
            n_borders = 0 if self.markers is None else len(self.markers.borders)
            if any(number >= n_borders for number in page.borders or ()):
                raise SettingsError(f"{where}: borders: found {page.borders}, expected numbers below {n_borders}")
            for triangle in page.triangles:
                self._check_triangle(triangle, where)
        if not any(page.triangles for page in self.pages):
            raise SettingsError("pages: found none with triangles, expected at least one")

    def _check_triangle(self, triangle: Triangle, where: str) -> None:
        if (self.kind == "thermal") != (triangle.delta_t_k is not None):
            name = "delta_t_k" if self.kind == "thermal" else "contrast"
            raise SettingsError(f'{where}: {name} is missing with kind = "{self.kind}"')
        if triangle.strength * self.polarity < 0:
            raise SettingsError(
                f"{where}: found {triangle.strength:g}, expected the sign of polarity = {self.polarity}"
            )
        expected = triangle.size_mrad * self.distance_m
        _check_equal(f"{where}: size_mm", triangle.size_mm, expected, "size_mrad and distance_m give")

    @property
    def has_camera_page(self) -> bool:
        """Whether a page has slanted edges and a grey wedge, by which a camera is measured."""
        return any(page.edges for page in self.pages)

    @property
    def level(self) -> str:
        """Name of the stimulus strength: contrast, or delta_t_k for a thermal chart."""
        return "delta_t_k" if self.kind == "thermal" else "contrast"

    def drawn_markers(self, page: Page) -> list[tuple[NDArray[np.bool_], FloatArray]]:
        """Return the modules of each marker of a page, (7, 7), with its centre (x, y) in mm."""
        if self.markers is None:
            return []
        bits = page_markers(page.number, self.key, n_borders=len(self.markers.borders))
        numbers = range(len(self.markers.borders)) if page.borders is None else page.borders
        shown = [*range(len(CORNERS)), *(len(CORNERS) + number for number in numbers)]
        return [(bits[number], self.markers.all_centres_mm[number]) for number in shown]

    def with_key(self) -> Chart:
        """Return the chart with the key that a hash of its content gives."""
        digest = hashlib.sha256(chart_toml(replace(self, key=0)).encode()).digest()
        return replace(self, key=int.from_bytes(digest[:8]) % N_DIGITS)


def _check_equal(name: str, found: float, expected: float, origin: str) -> None:
    if not math.isclose(found, expected, rel_tol=SIZE_TOLERANCE):
        raise SettingsError(f"{name}: found {found:g}, but {origin} {expected:g}; expected equal values")


def read_chart(path: Path | str) -> Chart:
    """Read and check a `chart.toml`, given its path or that of its folder; no page is opened. Raises SettingsError
    if the file cannot be read, or has an unknown, missing or contradictory key.
    """
    path = Path(path)
    if path.is_dir():
        path = path / CHART_FILE
    content = without_schema(read_toml(path), SCHEMA, [field.name for field in fields(Chart)], str(path))
    if isinstance(screen := content.get("screen"), dict) and "lut" in screen:
        content["screen"] = screen | {"lut": _lut(screen["lut"], f"{path}: screen.lut")}
    return from_table(content, Chart, str(path))


def _lut(found: object, where: str) -> LuminanceTable:
    pairs = convert(found, tuple[tuple[float, float], ...], where)
    try:
        return LuminanceTable(*np.array(pairs, np.float64).reshape(-1, 2).T)
    except SettingsError as error:
        raise SettingsError(f"{where.removesuffix('lut')}{error}") from None


def write_chart(path: Path, chart: Chart) -> None:
    """Write a chart as `chart.toml`; `read_chart` gives the same chart, number for number. Raises SettingsError if
    the text would be longer than what is read again.
    """
    text = chart_toml(chart)
    if len(text.encode()) > MAX_TOML_MB * 2**20:
        raise SettingsError(
            f"found {len(chart.pages)} pages, whose {CHART_FILE} would be longer than {MAX_TOML_MB} MB; "
            "take fewer sizes, levels or repeats, or make several charts"
        )
    path.write_text(text, encoding="utf-8")


def chart_toml(chart: Chart) -> str:
    """Return the text of `chart.toml`; every number keeps all its digits."""
    plain = ("kind", "name", "key", "seed", "distance_m", "page_width_mm", "page_height_mm", "polarity")
    content: dict[str, Any] = {"schema": SCHEMA, **{name: getattr(chart, name) for name in plain}}
    if chart.screen is not None:
        content["screen"] = {field.name: _plain(getattr(chart.screen, field.name)) for field in fields(Screen)}
    if chart.markers is not None:
        names = ("dictionary", "side_mm", *CORNERS)
        content["markers"] = {name: _plain(getattr(chart.markers, name)) for name in names}
        content["markers"]["borders"] = [*map(_plain, chart.markers.borders)] or None
    content["pages"] = [
        {
            "number": page.number,
            "file": page.file,
            "borders": page.borders,
            "triangles": [*map(_plain, page.triangles)] or None,
            "edges": [*map(_plain, page.edges)] or None,
            "patches": [*map(_plain, page.patches)] or None,
        }
        for page in chart.pages
    ]
    return toml_text(content)


def _plain(value: Any) -> Any:
    """Return a part of a chart as plain values; fields that have their defaults are left out."""
    if isinstance(value, LuminanceTable):
        return [*zip(value.code_value.tolist(), value.luminance_cd_m2.tolist(), strict=True)]
    if not is_dataclass(value):
        return value
    shown = ((field.name, getattr(value, field.name), field.default) for field in fields(value))
    return {name: _plain(one) for name, one, default in shown if one != default}


def marker_ids(page: int, key: int) -> tuple[int, int, int, int]:
    """Return the ids of the markers of a page, 0 to 62,499, in the order of `CORNERS`; the chart's key is 0 to
    249.

    Raises SettingsError if the page or the key is out of its range.
    """
    for name, value, count in (("page", page, MOST_PAGES), ("key", key, N_DIGITS)):
        check_whole(name, value, 0, count - 1)
    low, high = page % N_DIGITS, page // N_DIGITS
    return 4 * low, 4 * high + 1, 4 * low + 2, 4 * key + 3


def page_of(ids: Sequence[int]) -> tuple[int, int] | None:
    """Return (page, key) for the ids of four markers in the order of `CORNERS`; None if no page has them."""
    if len(ids) != len(CORNERS) or any(not 0 <= id_ < 4 * N_DIGITS or id_ % 4 != k for k, id_ in enumerate(ids)):
        return None
    low, high, again, key = (id_ // 4 for id_ in ids)
    return (high * N_DIGITS + low, key) if low == again else None


def page_markers(page: int, key: int, *, n_borders: int) -> list[NDArray[np.bool_]]:
    """Return the modules of all markers of a page: those in the corners, then `n_borders` along the borders.
    Raises SettingsError if the page or the key is out of its range.
    """
    corners = [marker_bits(marker) for marker in marker_ids(page, key)]
    return corners + [marker_bits(marker, BORDER_DICTIONARY) for marker in BORDER_IDS[:n_borders]]


def marker_bits(marker: int, dictionary: str = DICTIONARY) -> NDArray[np.bool_]:
    """Return the modules of a marker, shape (7, 7), True where it is white; its border is black."""
    import cv2

    of_opencv = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary.upper()}"))
    return np.asarray(cv2.aruco.generateImageMarker(of_opencv, marker, MODULES), np.bool_)
