"""A chart and frames of it through a known homography, for tests: exact sampling, then blur and noise."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from todframes.charts.layout import Chart, Markers, Page, Point, Screen, Triangle
from todframes.stimulus import ORIENTATIONS, vertices

ROWS, COLUMNS = 256, 320
WIDTH_MM, HEIGHT_MM, SIDE_MM, SIZE_MM = 480.0, 384.0, 70.0, 32.0
MIDDLE_MM = (WIDTH_MM / 2, HEIGHT_MM / 2)
CENTRES_MM = np.array([[60.0, 60.0], [420.0, 60.0], [420.0, 324.0], [60.0, 324.0]])
BACKGROUND = 0.5
SAMPLES = 4


def make_chart(
    contrasts: tuple[float, ...] = (0.1, 0.3), name: str = "filmed", borders: tuple[Point, ...] = ()
) -> Chart:
    pages = []
    for number, (contrast, orientation) in enumerate((c, o) for c in contrasts for o in ORIENTATIONS):
        place = {"size_mrad": 3.2, "size_mm": SIZE_MM, "x_mm": MIDDLE_MM[0], "y_mm": MIDDLE_MM[1]}
        one = Triangle(orientation=orientation, contrast=contrast, **place)
        pages.append(Page(number=number, file=f"pages/{number:04d}.png", triangles=(one,)))
    corners = [Point(x_mm=float(x), y_mm=float(y)) for x, y in CENTRES_MM]
    names = ("top_left", "top_right", "bottom_right", "bottom_left")
    return Chart(
        kind="screen",
        name=name,
        distance_m=10.0,
        page_width_mm=WIDTH_MM,
        page_height_mm=HEIGHT_MM,
        pages=tuple(pages),
        markers=Markers(side_mm=SIDE_MM, borders=borders, **dict(zip(names, corners, strict=True))),
        screen=Screen(
            width_px=1200, height_px=960, pixel_pitch_mm=0.4, background_luminance_cd_m2=50.0, page_duration_s=0.5
        ),
    ).with_key()


def camera(
    *,
    scale: float = 0.62,
    degrees: float = 1.3,
    shift: tuple[float, float] = (0.0, 0.0),
    tilt: float = 0.0,
    mirror: bool = False,
) -> np.ndarray:
    """Homography from mm to pixels: the chart's middle near the frame's; `tilt` is the change of scale per mm."""
    turn = np.radians(degrees)
    sign = -1.0 if mirror else 1.0
    to_middle = np.array([[1, 0, -MIDDLE_MM[0]], [0, 1, -MIDDLE_MM[1]], [0, 0, 1]])
    cos, sin = np.cos(turn), np.sin(turn)
    turned = np.array([[cos * sign, -sin, 0], [sin * sign, cos, 0], [0, 0, 1 / scale]])
    tilted = np.array([[1, 0, 0], [0, 1, 0], [tilt * scale, 0.3 * tilt * scale, 1.0]])
    place = np.array([[1, 0, (COLUMNS - 1) / 2 + shift[0]], [0, 1, (ROWS - 1) / 2 + shift[1]], [0, 0, 1]])
    return place @ tilted @ turned @ to_middle


class Seen(NamedTuple):
    """A finely sampled frame: the place on the page of each sample, in mm, and the page without its content."""

    x_mm: np.ndarray
    y_mm: np.ndarray
    empty: np.ndarray

    @classmethod
    def through(cls, homography: np.ndarray) -> Seen:
        y, x = ((np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5 for n in (ROWS, COLUMNS))
        to_mm = np.linalg.inv(homography)
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1) @ to_mm.T
        x_mm, y_mm = grid[..., 0] / grid[..., 2], grid[..., 1] / grid[..., 2]
        empty = np.full(x_mm.shape, 0.02)
        empty[(x_mm > 0) & (x_mm < WIDTH_MM) & (y_mm > 0) & (y_mm < HEIGHT_MM)] = BACKGROUND
        return cls(x_mm, y_mm, empty)


@lru_cache(maxsize=2)  # films show page after page through one homography
def _seen(homography: bytes) -> Seen:
    return Seen.through(np.frombuffer(homography).reshape(3, 3))


def _around(homography: np.ndarray, corners_mm: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns of fine samples among which a convex figure of the page lies."""
    x, y, w = homography @ np.column_stack([corners_mm, np.ones(len(corners_mm))]).T
    at = (np.array([y / w, x / w]) + 0.5) * SAMPLES - 0.5
    first, stop = np.floor(at.min(axis=1)).astype(int), np.ceil(at.max(axis=1)).astype(int) + 1
    return slice(max(first[0], 0), max(stop[0], 0)), slice(max(first[1], 0), max(stop[1], 0))


def filmed(chart: Chart, page: int, homography: np.ndarray, *, blur_px: float = 0.8) -> np.ndarray:
    """Luminance of a page in a frame, (ROWS, COLUMNS), white is 1: sampled finely, averaged, blurred."""
    seen = _seen(np.ascontiguousarray(homography, np.float64).tobytes())
    image = seen.empty.copy()
    square = SIDE_MM / 7 * 4.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for bits, centre in chart.drawn_markers(chart.pages[page]):
        shown = np.pad(np.where(bits, 1.0, 0.05), 1, constant_values=1.0)
        here = _around(homography, square + centre)
        column, row = (
            np.floor((at[here] - middle) / (SIDE_MM / 7) + 4.5).astype(int)
            for at, middle in zip((seen.x_mm, seen.y_mm), centre, strict=True)
        )
        inside = (column >= 0) & (column < 9) & (row >= 0) & (row < 9)
        image[here][inside] = shown[row[inside], column[inside]]
    one = chart.pages[page].triangles[0]
    corners = vertices(size=one.size_mm, orientation=one.orientation, x=one.x_mm, y=one.y_mm)
    here = _around(homography, corners)
    x_mm, y_mm = seen.x_mm[here], seen.y_mm[here]
    sides = [
        (q[0] - p[0]) * (y_mm - p[1]) - (q[1] - p[1]) * (x_mm - p[0])
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    image[here][np.all([side > 0 for side in sides], axis=0)] = BACKGROUND * (1.0 + one.contrast)
    image = image.reshape(ROWS, SAMPLES, COLUMNS, SAMPLES).mean(axis=(1, 3))
    return gaussian_filter(image, blur_px) if blur_px else image


def recorded(image: np.ndarray, noise: float = 0.0, rng: np.random.Generator | None = None) -> np.ndarray:
    """Values of 16 bits."""
    noisy = image if rng is None else image + noise * rng.standard_normal(image.shape)
    return np.rint(np.clip(noisy, 0, 1) * 65535).astype(np.uint16)
