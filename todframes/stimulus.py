"""Equilateral triangles, the test pattern: their strength, exact pixel coverage and closed-form spectrum.

Image coordinates: x to the right, y down, pixel centres at whole numbers, so pixel 0 reaches from -0.5 to 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import Positive, checked

Centre = Literal["centroid", "bounding_box"]

HEIGHT_PER_SIZE = 3.0**0.25
"""Height of an equilateral triangle of unit area: area = height² / √3."""

SIDE_PER_SIZE = 2.0 / 3.0**0.25
"""Side of an equilateral triangle of unit area."""


class Orientation(StrEnum):
    """Direction of the apex on the display; members are in clockwise order, as are all scores and answers.

    Examples
    --------
    >>> import todframes as tod
    >>> [each.value for each in tod.Orientation]
    ['up', 'right', 'down', 'left']
    """

    UP = "up"
    RIGHT = "right"
    DOWN = "down"
    LEFT = "left"

    @property
    def quarter_turns(self) -> int:
        """Clockwise quarter turns that carry the upright triangle into this one."""
        return ORIENTATIONS.index(self)

    @classmethod
    def _missing_(cls, value: object) -> Orientation:
        raise SettingsError(f"orientation: found {value!r}, expected {', '.join(cls)}")


ORIENTATIONS = tuple(Orientation)


@dataclass(frozen=True, slots=True)
class Stimulus:
    """Properties of a trial's triangle that the observer knows beforehand: all except the orientation.

    Attributes
    ----------
    size_mrad : float
        √(area) as displayed, in mrad at the eye.
    polarity : {1, -1}
        Brighter or darker than the background.

    Examples
    --------
    >>> import todframes as tod
    >>> readout = tod.PyramidObserver().readout(tod.Stimulus(size_mrad=2.4))
    >>> len(readout.deviations)
    4
    """

    size_mrad: float
    polarity: int = 1


class Level(NamedTuple):
    """The meaning of a level: its name and unit in sentences and headings, and whether the signal in a frame is
    proportional to it. `quantity` is what it measures in the field, None: nothing, and `factor` leads from the
    level to it; a contrast is also that of the displayed triangle.
    """

    name: str
    unit: str = ""
    is_signal: bool = True
    quantity: Literal["contrast", "delta_t_k"] | None = None
    factor: float = 1.0


LEVELS = {
    "contrast": Level("contrast", quantity="contrast"),
    "weber_contrast": Level("weber_contrast", quantity="contrast"),
    "sent_contrast": Level("sent_contrast"),
    "snr": Level("SNR"),
    "delta_t_k": Level("ΔT", "K", quantity="delta_t_k"),
    "delta_t_mk": Level("ΔT", "mK", quantity="delta_t_k", factor=1e-3),
    "size_mrad": Level("size", "mrad", is_signal=False),
}
"""Levels by the name of their column, in any case."""


def level_of(column: str) -> Level:
    """Return the meaning of the level in a column; of one with another name, only the name is known."""
    return LEVELS.get(column.strip().lower(), Level(column, is_signal=False))


def bounding_box_offset(orientation: Orientation) -> tuple[float, float]:
    """Return the vector from the centroid to the centre of the bounding box, in units of the size, as (x, y). The
    bounding box is centred at half the height, the centroid lies at a third of it, so the offset is a sixth of the
    height towards the apex.
    """
    sixth = HEIGHT_PER_SIZE / 6.0
    return ((0.0, -sixth), (sixth, 0.0), (0.0, sixth), (-sixth, 0.0))[orientation.quarter_turns]


def vertices(
    *, size: float, orientation: Orientation, x: float = 0.0, y: float = 0.0, centre: Centre = "centroid"
) -> FloatArray:
    """Return the corners (x, y) of a triangle, (3, 2), apex first; `size` is √(area), and (x, y) the place of its
    `centre`, in one unit.
    """
    height, half_side = HEIGHT_PER_SIZE * size, SIDE_PER_SIZE * size / 2.0
    below_apex = 2.0 / 3.0 * height if centre == "centroid" else height / 2.0
    corners = np.array([[0.0, -below_apex], [half_side, height - below_apex], [-half_side, height - below_apex]])
    for _ in range(orientation.quarter_turns):
        corners = np.column_stack([-corners[:, 1], corners[:, 0]])
    return np.asarray(corners + np.array([x, y]))


CIRCLE_PER_SIZE = 2.0 / 3.0 * HEIGHT_PER_SIZE
"""Radius of the circle through the corners of a triangle, over its size."""


def circle_about(shape: tuple[int, int], *, size_px: float, x_px: float, y_px: float) -> FloatArray:
    """Return weights of sum 1 of the pixels in the circle through the corners of a triangle. `x_px` and `y_px` are
    its centroid. Pixels at the circle count by the share of a pixel that lies within, along the radius.
    """
    rows, columns = shape
    away = np.hypot(np.arange(rows)[:, None] - y_px, np.arange(columns) - x_px)
    share = np.clip(CIRCLE_PER_SIZE * size_px + 0.5 - away, 0.0, 1.0)
    return np.asarray(share / share.sum())


def orientation_weights(shape: tuple[int, int], *, size_px: float, x_px: float, y_px: float) -> FloatArray:
    """Return weights whose products with an image measure its orientation, (4, rows, columns). They are triangles
    of the four orientations, each without the mean of the four, in units of a triangle's own product: a triangle
    of contrast 0.1 alone has 0.1 in its orientation. Within a pixel all triangles are alike, and the weights are
    0.
    """
    images = [
        coverage(shape, size_px=size_px, x_px=x_px, y_px=y_px, orientation=orientation)
        for orientation in ORIENTATIONS
    ]
    triangles = np.array(images)
    differences = triangles - triangles.mean(axis=0)
    energy = float(np.square(differences).sum()) / 4.0
    return differences / energy if energy > 1e-12 else np.zeros_like(differences)


@checked
def coverage(
    shape: tuple[int, int],
    *,
    size_px: Positive,
    x_px: float,
    y_px: float,
    orientation: Orientation | str,
    centre: Centre = "centroid",
) -> FloatArray:
    """Compute the exact fraction of each pixel's area that a triangle covers.

    Every edge is cut where it crosses a pixel boundary; each piece then lies in one pixel and adds its
    signed area there and its height to all pixels on its right (Green's theorem). The other orientations
    are the upright triangle on the turned grid, so a quarter turn of the pattern is one of the array,
    bit for bit on a grid that the turn maps onto itself.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the grid; the triangle may reach beyond it.
    size_px : float
        √(area) in pixels, > 0.
    x_px, y_px : float
        Place of the triangle's `centre` on the grid, in pixels.
    orientation : Orientation or str
        Direction of the apex: "up", "right", "down" or "left".
    centre : {"centroid", "bounding_box"}
        Point of the triangle that lies at (x_px, y_px).

    Returns
    -------
    ndarray, shape `shape`, in [0, 1]

    Raises
    ------
    SettingsError
        If the size is not a positive number, or the orientation or `centre` is unknown.

    Examples
    --------
    >>> import todframes as tod
    >>> pixels = tod.coverage((32, 32), size_px=6.0, x_px=15.5, y_px=15.5, orientation="up")
    >>> round(float(pixels.sum()), 9)
    36.0
    """
    return coverage_of(shape, Orientation(orientation), size_px=size_px, x_px=x_px, y_px=y_px, centre=centre)


def coverage_of(
    shape: tuple[int, int],
    orientation: Orientation,
    *,
    size_px: float,
    x_px: float,
    y_px: float,
    centre: Centre = "centroid",
) -> FloatArray:
    """Compute `coverage`; nothing is checked."""
    n_rows, n_columns = shape
    quarter_turns = orientation.quarter_turns
    for _ in range(quarter_turns):
        x_px, y_px = y_px, n_columns - 1 - x_px
        n_rows, n_columns = n_columns, n_rows
    upright = np.zeros((n_rows, n_columns))
    corners = vertices(size=size_px, orientation=Orientation.UP, centre=centre)
    first_column = _clamped_floor(x_px + corners[:, 0].min() + 0.5, n_columns)
    end_column = _clamped_floor(x_px + corners[:, 0].max() + 1.5, n_columns)
    first_row = _clamped_floor(y_px + corners[:, 1].min() + 0.5, n_rows)
    end_row = _clamped_floor(y_px + corners[:, 1].max() + 1.5, n_rows)
    if end_column > first_column and end_row > first_row:
        corners += ((x_px - first_column) + 0.5, (y_px - first_row) + 0.5)
        box = (end_row - first_row, end_column - first_column)
        upright[first_row:end_row, first_column:end_column] = _Pieces.of(corners[None], box).coverage()[0]
    return np.rot90(upright, -quarter_turns)


def _clamped_floor(value: float, stop: int) -> int:
    return int(np.floor(min(max(value, 0.0), float(stop))))


def moving_coverage(corners: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Compute the coverage of pixels by triangles, and its changes by x, by y and by the entries xx, xy, yx and yy
    of a map about (0, 0): (…, 7, rows, columns). Corners (x, y), (…, 3, 2), are clockwise as seen on the frame. An
    edge that moves by v covers v·n more of each pixel for each length of it there, n its outward normal. Along a
    piece of an edge within one pixel an affine motion is linear, so its value at the middle is its mean.
    """
    each = corners.reshape(-1, *corners.shape[-2:])
    total = np.zeros((len(each), 7, *shape))
    first, stop = _touched_box(each, shape)
    columns, rows = stop - first
    if columns > 0 and rows > 0:
        box = total[:, :, first[1] : stop[1], first[0] : stop[0]]
        pieces = _Pieces.of(each - first + 0.5, (rows, columns))
        box[:, 0] = pieces.coverage()
        at = np.floor(pieces.middle).astype(np.intp)
        inside = ((at >= 0) & (at < (columns, rows))).all(axis=-1)
        pixel = (at @ (1, columns) + rows * columns * np.arange(len(each))[:, None, None])[inside]
        x, y = (pieces.middle[inside] + first - 0.5).T
        down, right = pieces.length[inside].T * [[-1.0], [1.0]]
        for number, moment in enumerate((right, down, right * x, right * y, down * x, down * y), 1):
            summed = np.bincount(pixel, moment, len(each) * rows * columns)
            box[:, number] = summed.reshape(len(each), rows, columns)
    return total.reshape(*corners.shape[:-2], 7, *shape)


def triangle_coverage(corners: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Compute the exact fraction of each pixel's area that triangles cover, (…, rows, columns): the first of
    `moving_coverage`.
    """
    each = corners.reshape(-1, *corners.shape[-2:])
    area = np.zeros((len(each), *shape))
    first, stop = _touched_box(each, shape)
    if (stop > first).all():
        columns, rows = stop - first
        area[:, first[1] : stop[1], first[0] : stop[0]] = _Pieces.of(
            each - first + 0.5, (rows, columns)
        ).coverage()
    return area.reshape(*corners.shape[:-2], *shape)


def _touched_box(corners: FloatArray, shape: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first column and row of the pixels that polygons may touch, and those after the last."""
    first = np.maximum(np.floor(corners.min(axis=(0, 1)) + 0.5), 0.0)
    stop = np.minimum(np.floor(corners.max(axis=(0, 1)) + 1.5), shape[::-1])
    return first.astype(np.intp), stop.astype(np.intp)


class _Pieces(NamedTuple):
    """The edges of clockwise polygons, cut where they cross the boundaries of the pixels [j, j + 1] × [i, i + 1]
    of a box: the `middle` of each piece and its `length` along x and y, (polygon, edge, piece, 2).
    """

    middle: FloatArray
    length: FloatArray
    box: tuple[int, int]

    @classmethod
    def of(cls, corners: FloatArray, box: tuple[int, int]) -> _Pieces:
        """Cut the edges of polygons with these corners (x, y), (polygon, corner, 2)."""
        start = corners[:, :, None]
        along = np.roll(corners, -1, axis=1)[:, :, None] - start
        boundaries = np.arange(box[1] + 1.0), np.arange(box[0] + 1.0)
        cuts = [np.broadcast_to([0.0, 1.0], (*corners.shape[:2], 2))]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            cuts += [(boundaries[axis] - start[..., axis]) / along[..., axis] for axis in (0, 1)]
        t = np.concatenate(cuts, axis=-1)
        np.fmax(t, 0.0, out=t)  # an edge on a boundary is not cut by it, which is 0/0
        np.minimum(t, 1.0, out=t).sort()
        middle = np.asarray(start + ((t[..., 1:] + t[..., :-1]) / 2.0)[..., None] * along)
        return cls(middle, np.asarray(np.diff(t)[..., None] * along), box)

    def coverage(self) -> FloatArray:
        """Compute the coverage of the pixels by each polygon, (polygon, rows, columns)."""
        n_rows, n_columns = self.box
        # The extra column takes the part right of the box; the sum along a row never reads it.
        width, fall = n_columns + 2, self.length[..., 1]
        row = np.floor(self.middle[..., 1])
        inside = (row >= 0.0) & (row < n_rows) & (fall != 0.0)
        fall, x = fall[inside], _clipped(self.middle[..., 0][inside], float(n_columns))
        column = x.astype(np.intp)
        left_share = x - column
        polygon = np.broadcast_to(np.arange(len(row))[:, None, None], row.shape)[inside]
        pixel = (polygon * n_rows + row[inside].astype(np.intp)) * width + column
        steps = np.bincount(pixel, fall * (1.0 - left_share), len(row) * n_rows * width)
        steps += np.bincount(pixel + 1, fall * left_share, steps.size)
        # The area right of the falling (right-hand) edge was counted positive, that of the others negative.
        steps = steps.reshape(-1, n_rows, width)[..., :n_columns]
        return _clipped(np.asarray(0.0 - np.cumsum(steps, axis=-1)), 1.0)


def _clipped(values: FloatArray, most: float) -> FloatArray:
    """Limit values to [0, most], in place: a third of the time of `np.clip` where they are few."""
    np.maximum(values, 0.0, out=values)
    return np.asarray(np.minimum(values, most, out=values))


def spectrum(
    frequency_x: ArrayLike,
    frequency_y: ArrayLike,
    *,
    size: float,
    orientation: Orientation,
    x: float = 0.0,
    y: float = 0.0,
    centre: Centre = "centroid",
) -> ComplexArray:
    """Compute the Fourier transform ∬ exp(−2πi (f_x x + f_y y)) dx dy over the triangle, in closed form: complex,
    size² at frequency zero. Frequencies, in cycles per unit of `size`, broadcast; (x, y) is the place of the
    triangle's `centre`. By the Hermite–Genocchi formula the integral of an exponential over a triangle is twice
    its area times the second divided difference of exp at z_j = −2πi f·v_j, v_j the corners.
    """
    fx, fy = np.broadcast_arrays(np.asarray(frequency_x, float), np.asarray(frequency_y, float))
    corners = vertices(size=size, orientation=orientation)
    phases = (-2.0 * np.pi * (fx * corner_x + fy * corner_y) for corner_x, corner_y in corners)
    at_centroid = 2.0 * size**2 * _second_divided_difference_of_exp(*phases)
    if centre == "bounding_box":
        dx, dy = bounding_box_offset(orientation)
        x, y = x - dx * size, y - dy * size
    return np.asarray(at_centroid * np.exp(-2j * np.pi * (fx * x + fy * y)))


def _second_divided_difference_of_exp(p: FloatArray, q: FloatArray, r: FloatArray) -> ComplexArray:
    """Compute exp[i p, i q, i r] for real phases, to a relative error of about 1e-15 of its bound 1/2."""
    lower, upper = np.minimum(p, q), np.maximum(p, q)
    # Phases are sorted in ascending order, so that the widest pair is in the denominator.
    a, b, c = np.minimum(lower, r), np.maximum(lower, np.minimum(upper, r)), np.maximum(upper, r)
    wide = c - a > 1.0
    differences = np.empty(wide.shape, dtype=np.complex128)
    narrow = ~wide
    differences[narrow] = _by_series(a[narrow], b[narrow], c[narrow])
    a, b, c = a[wide], b[wide], c[wide]
    rise = _first_divided_difference_of_exp(b, c) - _first_divided_difference_of_exp(a, b)
    differences[wide] = rise / (1j * (c - a))
    return differences


def _by_series(a: FloatArray, b: FloatArray, c: FloatArray) -> ComplexArray:
    """Compute exp[i a, i b, i c] for c − a ≤ 1: Taylor about the middle, sum of h_n / (n + 2)!. h_n are complete
    homogeneous polynomials. |z| ≤ 1/2, so h_n ≤ (n + 1)(n + 2)/2 · 2^-n and 16 terms leave less than 1e-17.
    """
    middle = (a + c) / 2.0
    z = [1j * (p - middle) for p in (a, b, c)]
    h1 = h2 = h3 = np.ones_like(z[0])
    series = h3 / 2.0
    factorial = 2.0
    for n in range(1, 17):
        h1 = h1 * z[0]
        h2 = h1 + h2 * z[1]
        h3 = h2 + h3 * z[2]
        factorial *= n + 2
        series = series + h3 / factorial
    return np.asarray(series * np.exp(1j * middle))


def _first_divided_difference_of_exp(a: FloatArray, b: FloatArray) -> ComplexArray:
    return np.asarray(np.exp(0.5j * (a + b)) * np.sinc((b - a) / (2.0 * np.pi)))
