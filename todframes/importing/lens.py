"""The lens of a recording: OpenCV's polynomial model, fitted to the corners of markers in several frames.

Each frame has a homography of its own, as the camera may shake and the chart be moved; the lens is one for all.
OpenCV's `calibrateCamera` takes a pinhole camera with a focal length in their stead, which a single plane hardly
determines: it ends 0.02 to 0.15 px from the corners where this fit is within 0.013 px. Of lenses with more and
more coefficients, the one with the least Bayesian information criterion counts. The error of the triangles holds
the distance from those of the other lenses as well, weighed by Akaike's criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.importing.geometry import Geometry, Lens, fit_geometry
from todframes.results.wording import subsample

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
