"""The geometry of a chart in a recorded frame: the homography from its millimetres to pixels, and triangles in it.

Coordinates of the chart are in millimetres from the top left corner of its page, x to the right, y down. Pixels
are those of the recorded frame, (0, 0) is the centre of the top left one, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.stimulus import ORIENTATIONS, Orientation, vertices

STEP_PX = 0.01
"""Step of a lens's numerical derivatives."""

MOST_STEPS, CONVERGED_PX = 20, 1e-6
"""Steps of Newton's method by which a lens is inverted, and the distance after which there is no further one."""


class View(NamedTuple):
    """The local geometry of a chart in a frame, about a place on the chart.

    `turn_degrees` is the direction in the frame of the chart's upward direction, clockwise from up. `stretch` is
    the ratio of the largest to the smallest scale among all directions: 1 / cos φ for a far chart tilted by φ.
    """

    scale_px_per_mm: float
    turn_degrees: float
    is_mirrored: bool
    stretch: float


COEFFICIENTS = ("k1", "k2", "x", "y", "k3", "p1", "p2")
"""Names of a lens's coefficients. `x` and `y` are the principal point beside the frame's middle, in half
diagonals."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens that bends straight lines: the map from the pixels of an ideal picture to those of a frame.

    It is OpenCV's polynomial model. A single plane does not determine a camera's focal length, so half of the
    frame's diagonal stands in its stead. `middle_px` is the middle of the frame, x and y; the coefficients are in
    the order of `COEFFICIENTS`, all 0 for an ideal lens.
    """

    middle_px: tuple[float, float]
    half_diagonal_px: float
    coefficients: tuple[float, ...] = (0.0,) * len(COEFFICIENTS)

    @classmethod
    def ideal(cls, shape: tuple[int, int]) -> Lens:
        """Return a lens that bends nothing, for frames of this number of rows and columns."""
        rows, columns = shape
        return cls(((columns - 1) / 2.0, (rows - 1) / 2.0), math.hypot(rows, columns) / 2.0)

    @property
    def matrix(self) -> FloatArray:
        """OpenCV's camera matrix, whose focal length is half of the frame's diagonal."""
        _, _, x, y, *_ = self.coefficients
        focal = self.half_diagonal_px
        return np.array(
            [
                [focal, 0.0, self.middle_px[0] + x * focal],
                [0.0, focal, self.middle_px[1] + y * focal],
                [0.0, 0.0, 1.0],
            ]
        )

    def described(self) -> dict[str, object]:
        """Return the model and its coefficients by name, rounded, with the unit of length that they are in."""
        named = zip(COEFFICIENTS, self.coefficients, strict=True)
        return {"model": "polynomial", "half_diagonal_px": round(self.half_diagonal_px, 3)} | {
            name: round(value, 6) for name, value in named if value
        }

    def changed(self, change: FloatArray) -> Lens:
        """Return the lens with other first coefficients, each larger by so much."""
        coefficients = np.array(self.coefficients)
        coefficients[: len(change)] += change
        return replace(self, coefficients=tuple(coefficients.tolist()))

    def to_px(self, ideal_px: FloatArray) -> FloatArray:
        """Map pixels of the ideal picture, (…, 2), to pixels of the frame."""
        k1, k2, _, _, k3, p1, p2 = self.coefficients
        matrix, flat = self.matrix, np.reshape(ideal_px, (-1, 2))
        rays = np.column_stack([(flat - matrix[:2, 2]) / self.half_diagonal_px, np.ones(len(flat))])
        bent = np.array([k1, k2, p1, p2, k3])
        places, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, bent)
        return np.asarray(places.reshape(np.shape(ideal_px)))

    def to_ideal(self, places_px: FloatArray) -> FloatArray:
        """Map pixels of the frame, (n, 2), to pixels of the ideal picture, by Newton's method.

        Not finite, or anything, where the lens shows no such pixels.
        """
        ideal = places_px
        for _ in range(MOST_STEPS):
            away = self.to_px(ideal) - places_px
            if not np.nanmax(np.abs(away)) > CONVERGED_PX:
                break
            ideal = ideal - np.linalg.solve(self.jacobian(ideal), away[..., None])[..., 0]
        return ideal

    def jacobian(self, ideal_px: FloatArray) -> FloatArray:
        """Return the derivative of the map at pixels of the ideal picture, (n, 2): (n, 2, 2)."""
        steps = [self.to_px(ideal_px + one) - self.to_px(ideal_px - one) for one in STEP_PX * np.eye(2)]
        return np.stack(steps, axis=-1) / (2.0 * STEP_PX)


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A page of a chart as a camera sees it.

    `homography`, (3, 3), maps homogeneous chart coordinates in millimetres to pixels of an ideal picture, and
    `lens` these to pixels of the frame; None if they are the same. `residual_px` is the root mean square distance
    of the fitted points from where it puts them, per degree of freedom; 0 for four points.
    """

    homography: FloatArray
    residual_px: float
    lens: Lens | None = None

    def ideal_px(self, places_mm: ArrayLike) -> FloatArray:
        """Map places on the chart, (…, 2) in millimetres, to pixels of the ideal picture, (…, 2)."""
        places = np.asarray(places_mm, np.float64)
        mapped = places @ self.homography[:, :2].T + self.homography[:, 2]
        return np.asarray(mapped[..., :2] / mapped[..., 2:])

    def to_px(self, places_mm: ArrayLike) -> FloatArray:
        """Map places on the chart, (…, 2) in millimetres, to pixels of the frame, (…, 2)."""
        ideal = self.ideal_px(places_mm)
        return ideal if self.lens is None else self.lens.to_px(ideal)

    def jacobians(self, places_mm: FloatArray) -> FloatArray:
        """Return the derivative of the map at places on the chart, (n, 2), in pixels per millimetre: (n, 2, 2)."""
        x, y, w = self.homography @ np.column_stack([places_mm, np.ones(len(places_mm))]).T
        at = np.column_stack([x / w, y / w])
        ideal = (self.homography[:2, :2] - at[:, :, None] * self.homography[2, :2]) / w[:, None, None]
        return ideal if self.lens is None else np.asarray(self.lens.jacobian(at) @ ideal)

    def jacobian(self, place_mm: ArrayLike) -> FloatArray:
        """Return the derivative of the map at a place on the chart, in pixels per millimetre: (2, 2)."""
        return np.asarray(self.jacobians(np.asarray(place_mm, np.float64)[None])[0])

    def scale_px_per_mm(self, place_mm: ArrayLike) -> float:
        """Return the scale at a place on the chart: the root of how it maps areas, in pixels per millimetre."""
        return math.sqrt(abs(float(np.linalg.det(self.jacobian(place_mm)))))

    def view(self, place_mm: ArrayLike) -> View:
        """Return the local geometry of the chart in the frame at a place on the chart."""
        (a, b), (c, d) = self.jacobian(place_mm).tolist()
        determinant = a * d - b * c
        return View(
            scale_px_per_mm=math.sqrt(abs(determinant)),
            turn_degrees=math.degrees(math.atan2(-b, d)),
            is_mirrored=determinant < 0.0,
            stretch=float(np.linalg.cond(self.jacobian(place_mm))),
        )

    def direction_mrad(self, place_mm: ArrayLike, *, middle_px: FloatArray, distance_m: float) -> FloatArray:
        """Return the angles at the camera, (x, y), of a place on a chart from the middle of the frame.

        A chart square to the camera's axis is assumed. The lens counts: angles are those of the ideal picture.
        """
        place = np.asarray(place_mm, np.float64)
        scale = Geometry(self.homography, 0.0).scale_px_per_mm(place)
        away = (self.ideal_px(place) - middle_px) / (scale * distance_m * 1e3)
        tangent = max(float(np.linalg.norm(away)), 1e-12)
        return np.asarray(away * (1e3 * math.atan(tangent) / tangent))

    def lens_stretch(self, place_mm: ArrayLike) -> float:
        """Return the stretch by the lens alone about a place on the chart; 1 for none."""
        lens = self.lens
        return 1.0 if lens is None else float(np.linalg.cond(lens.jacobian(self.ideal_px(place_mm)[None])[0]))


def fit_geometry(places_mm: ArrayLike, places_px: ArrayLike) -> Geometry:
    """Fit the homography that maps four or more places on a chart to pixels, (n, 2) each, by least squares.

    Raises DataError if they do not determine a homography, as three of four on a line do not.
    """
    source, target = (np.asarray(places, np.float64).reshape(-1, 2) for places in (places_mm, places_px))
    # Coordinates about 1 keep the linear step well conditioned whatever the units are.
    middle, spread = source.mean(axis=0), max(float(source.std()), 1e-12)
    matrix = None
    if len(source) >= 4 and np.isfinite(target).all():
        matrix, _ = cv2.findHomography((source - middle) / spread, target, 0)
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise DataError(f"found {len(source)} places that determine no homography, expected 4 in general position")
    scaled = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, spread]]) / spread
    geometry = Geometry(matrix @ scaled, 0.0)
    free = 2 * len(source) - 8
    square = float(((geometry.to_px(source) - target) ** 2).sum())
    return Geometry(geometry.homography, math.sqrt(2.0 * square / free) if free else 0.0)


class PlacedTriangle(NamedTuple):
    """A triangle of a chart as recorded.

    `x_px` and `y_px` are the centroid of what the frame shows, `size_px` is √(area) there. `orientation` is the
    one of the four directions that is nearest to that of the apex, and `roll_degrees` the angle from it to the
    apex, clockwise. `corners_px` has shape (3, 2), apex first.
    """

    x_px: float
    y_px: float
    size_px: float
    orientation: Orientation
    roll_degrees: float
    corners_px: FloatArray


def place_triangle(
    geometry: Geometry, *, orientation: Orientation, size_mm: float, x_mm: float, y_mm: float
) -> PlacedTriangle:
    """Place a triangle of a chart, whose apex points in `orientation` there and whose size is √(area), in the
    frame.

    A homography maps a triangle to a triangle, so its corners give centroid and area exactly; the mapped centroid
    would be off by the second order of the perspective. A lens bends the sides, which are then followed in steps.
    """
    corners_mm = np.asarray(vertices(size=size_mm, orientation=orientation, x=x_mm, y=y_mm))
    steps = 1 if geometry.lens is None else 16  # A side's bulge is then known to 1/256.
    shares = np.arange(steps)[:, None, None] / steps
    outline_mm = (corners_mm + shares * (np.roll(corners_mm, -1, axis=0) - corners_mm)).swapaxes(0, 1)
    outline = geometry.to_px(outline_mm.reshape(-1, 2))
    corners = outline[::steps]
    apex_x, apex_y = corners[0].tolist()
    away = outline - corners[0]
    after = np.roll(away, -1, axis=0)
    doubled = away[:, 0] * after[:, 1] - away[:, 1] * after[:, 0]
    x, y = (corners[0] + ((away + after) * doubled[:, None]).sum(axis=0) / (3.0 * doubled.sum())).tolist()
    area = abs(float(doubled.sum())) / 2.0
    clockwise_from_up = math.degrees(math.atan2(apex_x - x, y - apex_y))
    quarters = round(clockwise_from_up / 90.0)
    return PlacedTriangle(
        x, y, math.sqrt(area), ORIENTATIONS[quarters % 4], clockwise_from_up - 90.0 * quarters, corners
    )
