"""The geometry of a chart in a recorded frame: the homography from its millimetres to pixels, and triangles in it.

Coordinates of the chart are in millimetres from the top left corner of its page, x to the right, y down. Pixels
are those of the recorded frame, (0, 0) is the centre of the top left one, y down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.results.wording import subsample
from todframes.stimulus import ORIENTATIONS, Orientation, vertices

STEP_PX = 0.01
"""Step of a lens's numerical derivatives."""

MOST_STEPS, CONVERGED_PX = 20, 1e-6
"""Steps of Newton's method by which a lens is inverted, and the distance after which there is no further one."""


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
        focal, matrix = self.half_diagonal_px, np.diag([self.half_diagonal_px, self.half_diagonal_px, 1.0])
        matrix[:2, 2] = self.middle_px + focal * np.array(self.coefficients[2:4])
        return matrix

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

    def direction_mrad(self, place_mm: ArrayLike, *, middle_px: FloatArray, distance_m: float) -> FloatArray:
        """Return the angles at the camera, (x, y), of a place on a chart from the middle of the frame.

        A chart square to the camera's axis is assumed. The lens counts: angles are those of the ideal picture.
        """
        place = np.asarray(place_mm, np.float64)
        scale = Geometry(self.homography, 0.0).scale_px_per_mm(place)
        away = (self.ideal_px(place) - middle_px) / (scale * distance_m * 1e3)
        tangent = max(float(np.linalg.norm(away)), 1e-12)
        return np.asarray(away * (1e3 * math.atan(tangent) / tangent))


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


LADDER = (1, 2, 4, 7)
"""Numbers of coefficients of the lenses that are tried, the first ones of `COEFFICIENTS`."""

LEAST_ERROR_PX = 0.01
"""Error of a corner that remains however many frames are averaged: pixels are no points."""

MOST_PLACED = 4
"""Frames in which the error of the triangles is computed."""

MOST_STEPS, FIRST_STEP = 30, 0.05
"""Steps of a fit, and the length of the first one: a longer one may lead to a lens that shows places twice."""

STEP_PX, STEP = 0.1, 1e-4
"""Steps of numerical derivatives: of places in an ideal picture, and of the coefficients of a lens."""

PlacesTriangles = Callable[[Geometry], FloatArray]
"""Function that places the triangles of a frame: (triangle, 3), x and y and √(area) in pixels."""


class LensChoice(NamedTuple):
    """The lens of a recording, None for an ideal one, the geometries of the frames that show it, and the error of
    the triangles that it places.

    `error_px` is the standard error of a triangle's place, `size_error` that of its √(area), relative.
    """

    lens: Lens | None
    geometries: list[Geometry]
    error_px: float
    size_error: float


class _Fit(NamedTuple):
    """A lens of some coefficients, the frames seen through it, and the mean square of the distance of each corner
    from its place, averaged over the frames."""

    n_coefficients: int
    lens: Lens | None
    geometries: list[Geometry]
    mean_square_px2: float


def choose_lens(
    corners_mm: FloatArray,
    seen_px: Sequence[FloatArray],
    placed: Sequence[PlacesTriangles],
    shape: tuple[int, int],
) -> LensChoice | None:
    """Choose the lens that fits the corners of markers in frames best for its number of coefficients.

    `corners_mm` and each of `seen_px` have shape (marker, 4, 2), NaN for markers that a frame does not show.
    `placed` has a function for each frame that places its triangles; `shape` are the rows and columns of a frame.
    None if no lens fits at all. The error holds that of the choice, too: it is the mean over all lenses, with
    Akaike's weights, of the variance by a lens's own fit and of the squared distance from the chosen one (Burnham
    & Anderson 2002, section 4.3, about the chosen model in place of the mean one).
    """
    fits = []
    for n_coefficients, lens in [(0, None), *_fitted(corners_mm, seen_px, shape)]:
        try:
            geometries = seen_through(lens, corners_mm, seen_px)
        except DataError:
            continue
        left = np.nanmean(_left(geometries, corners_mm, seen_px), axis=0)
        mean_square = float(np.nanmean(left**2)) + LEAST_ERROR_PX**2
        fits.append(_Fit(n_coefficients, lens, geometries, mean_square))
    if not fits:
        return None
    n = int(np.isfinite(seen_px).any(axis=0).sum())
    free = np.array([fit.n_coefficients for fit in fits])
    likelihood = n * np.log([fit.mean_square_px2 for fit in fits])
    chosen = int((likelihood + free * math.log(n)).argmin())
    akaike = likelihood + 2.0 * free
    shares = np.exp((akaike.min() - akaike) / 2.0)
    some = subsample(list(enumerate(placed)), MOST_PLACED)
    places = np.array([np.concatenate([place(fit.geometries[k]) for k, place in some]) for fit in fits])
    variances = np.array(
        [
            np.concatenate([_variances(corners_mm, fit, k, place) for k, place in some])
            * (fit.mean_square_px2 * n / (n - 9 - fit.n_coefficients))
            for fit in fits
        ]
    )
    variance = np.einsum("k,kti->ti", shares / shares.sum(), variances + (places - places[chosen]) ** 2)
    error_px = math.sqrt(float(variance[:, :2].sum(axis=-1).mean()))
    size_error = math.sqrt(float((variance[:, 2] / places[chosen][:, 2] ** 2).mean()))
    return LensChoice(fits[chosen].lens, fits[chosen].geometries, error_px, size_error)


def seen_through(lens: Lens | None, corners_mm: FloatArray, seen_px: Sequence[FloatArray]) -> list[Geometry]:
    """Return the geometries of frames behind a lens, by the corners of the markers in each, (marker, 4, 2).

    Raises DataError if the lens shows no flat chart so.
    """
    ideal = np.asarray(seen_px)
    if lens is not None:
        ideal = lens.to_ideal(ideal.reshape(-1, 2)).reshape(ideal.shape)
    geometries = []
    for corners_px, ideal_px in zip(seen_px, ideal, strict=True):
        there = np.isfinite(corners_px)
        known = there.all(axis=(1, 2))
        geometry = replace(fit_geometry(corners_mm[known], ideal_px[known]), lens=lens)
        square = float(((geometry.to_px(corners_mm) - corners_px)[there] ** 2).sum())
        residual_px = math.sqrt(2.0 * square / (np.count_nonzero(there) - 8))
        geometries.append(replace(geometry, residual_px=residual_px))
    return geometries


def _left(geometries: Sequence[Geometry], corners_mm: FloatArray, seen_px: Sequence[FloatArray]) -> FloatArray:
    """Return how far corners lie from their places, (frame, marker, 4, 2), without what all are moved outwards.

    Blur and glare make all markers larger or smaller alike.
    """
    left = np.array([px - one.to_px(corners_mm) for one, px in zip(geometries, seen_px, strict=True)])
    outwards = _outwards(np.asarray(seen_px))
    return np.asarray(left - outwards * np.nanmean((left * outwards).sum(axis=-1)))


def _outwards(corners_px: FloatArray) -> FloatArray:
    """Return unit vectors from the middle of each marker to its corners, (…, 4, 2)."""
    away = corners_px - corners_px.mean(axis=-2, keepdims=True)
    return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))


def _fitted(
    corners_mm: FloatArray, seen_px: Sequence[FloatArray], shape: tuple[int, int]
) -> Iterator[tuple[int, Lens]]:
    """Yield lenses of more and more coefficients, with the numbers of these, as far as the corners determine them.

    Each fit begins with the result of the one before.
    """
    ideal, there = Lens.ideal(shape), np.isfinite(seen_px)

    def left(coefficients: FloatArray) -> FloatArray:
        geometries = seen_through(ideal.changed(coefficients), corners_mm, seen_px)
        return _left(geometries, corners_mm, seen_px)[there]

    def slopes(coefficients: FloatArray) -> FloatArray:
        now = left(coefficients)
        return np.stack([left(coefficients + step) - now for step in STEP * np.eye(len(coefficients))], 1) / STEP

    start = np.zeros(0)
    for n_coefficients in LADDER:
        start = np.pad(start, (0, n_coefficients - len(start)))
        try:
            start = least_squares(
                left, start, slopes, x_scale=FIRST_STEP, ftol=1e-4, xtol=1e-6, max_nfev=MOST_STEPS
            ).x
        except (DataError, np.linalg.LinAlgError):
            return
        yield n_coefficients, ideal.changed(start)


def _variances(corners_mm: FloatArray, fit: _Fit, frame: int, place: PlacesTriangles) -> FloatArray:
    """Return the variances of the places of triangles, (triangle, 3), for corners with a variance of 1 px²."""
    geometry = fit.geometries[frame]
    flat_mm = corners_mm.reshape(-1, 2)
    # Four corners, each moved by itself, span all homographies.
    box_mm = flat_mm.min(axis=0) + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * np.ptp(flat_mm, axis=0)
    box_px = geometry.ideal_px(box_mm)
    moved = [
        Geometry(fit_geometry(box_mm, box_px + one.reshape(4, 2)).homography, 0.0, geometry.lens)
        for one in STEP_PX * np.eye(8)
    ]
    if geometry.lens is not None:
        steps = STEP * np.eye(fit.n_coefficients)
        moved += [Geometry(geometry.homography, 0.0, geometry.lens.changed(one)) for one in steps]
    by_corner = [(one.to_px(flat_mm) - geometry.to_px(flat_mm)).ravel() for one in moved]
    by_place = [place(one) - place(geometry) for one in moved]
    # Corners that all move outwards move no place.
    by_corner.append(STEP_PX * _outwards(geometry.to_px(corners_mm)).ravel())
    by_place.append(np.zeros_like(by_place[0]))
    fitted = np.linalg.pinv(np.stack(by_corner, axis=-1), rcond=1e-9)
    return np.asarray(((np.stack(by_place, axis=-1) @ fitted) ** 2).sum(axis=-1))
