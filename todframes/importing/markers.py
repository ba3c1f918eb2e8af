"""The markers of a chart in recorded frames, by OpenCV: ArUco finds them, and ECC aligns each with its pattern.

A frame is searched whole only where the markers are not near their places in the frame before. The alignment
(Evangelidis & Psarakis 2008) takes all pixels of a marker, so that it averages noise and depends little on blur.

The four markers in the corners name the page, and all have to be there. Markers along the borders add places: one
that is hidden, or beyond the frame, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.charts.layout import (
    BORDER_DICTIONARY,
    BORDER_IDS,
    CORNERS,
    DICTIONARY,
    MODULES,
    N_DIGITS,
    marker_bits,
    page_markers,
)
from todframes.importing.geometry import Geometry, fit_geometry

SAMPLES = 6
"""Samples along a module's side in the pattern that a marker is aligned with, and where its modules are read."""

SQUARE = np.array([[0.0, 0.0], [MODULES, 0.0], [MODULES, MODULES], [0.0, MODULES]])
IN_PATTERN = (SQUARE + 1.0) * SAMPLES - 0.5
"""The corners of a marker in modules, and in a pattern, which has a module of white around."""

BLUR_PX, USUAL_BLUR_PX = 1.0, 1.2
"""Blur of a frame before the alignment, and that of the pattern, which adds the usual blur of a camera."""

INNER_SQUARE = (SQUARE + MODULES / 2.0) / 2.0
"""The square, in modules, by whose corners a marker's place is stated: a lens bends the marker, and what a
homography misses of that is less about half-way out."""

STEPS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-5)
"""Most steps of an alignment, and the growth of the correlation after which there is no further one."""

LEAST_CORRELATION = 0.7
"""Correlation of a marker with its pattern, below which it is not there: blends of two pages have 0.8."""

MOST_WRONG_BITS = 1
"""Number of modules of a marker that may read wrong; two markers of the dictionary differ in five or more."""

MOST_BENT = 5.0
"""Distance of markers from a flat chart, in modules, that a lens may explain."""


class Sighting(NamedTuple):
    """The markers of a page in one frame, and the geometry of a flat chart without a lens.

    `modules`, (4, 7, 7), are the mean values in the modules of the markers in the corners, and `ids` what they
    spell, -1 for no marker. `corners_px`, (n, 4, 2), are the corners of the inner squares of all markers, NaN for
    those that the frame does not show.
    """

    geometry: Geometry
    ids: tuple[int, ...]
    modules: FloatArray
    corners_px: FloatArray


class MarkerFinder:
    """Finder of a chart's markers, by the places of their centres, (n, 2): clockwise corners, then borders.

    `most_found` is the largest number of corners with a marker in a frame. `key` is that of the chart in the
    present frame if a search has found the marker that carries it, and two others. `corners_mm`, (n, 4, 2), are
    the corners of the inner squares of the markers.
    """

    def __init__(self, centres_mm: FloatArray, side_mm: float) -> None:
        self.most_found = 0
        self.key: int | None = None
        self._markers_mm = centres_mm[:, None, :] + (SQUARE / MODULES - 0.5) * side_mm
        self.corners_mm = centres_mm[:, None, :] + (INNER_SQUARE / MODULES - 0.5) * side_mm
        self._detector = cv2.aruco.ArucoDetector(_dictionary(len(centres_mm) - len(CORNERS)), search_parameters())
        self._last: FloatArray | None = None
        self._patterns: list[NDArray[np.bool_]] = []
        # Preparations of a frame for the search: how often enlarged, and whether mirrored.
        self._preparations = list(product((1, 2), (False, True)))

    def look(self, frame: NDArray[Any]) -> Sighting | None:
        """Find the markers in a frame of any number type, (rows, columns) or (rows, columns, 3).

        None if the frame does not show all four.
        """
        grey, self.key = _grey(frame), None
        seen = None if self._last is None else self._aligned(grey, self._last, self._patterns)
        return seen or self._search(grey)

    def _all_px(self, quads: FloatArray) -> FloatArray:
        """Return the outlines of markers, with those that are missing where a flat chart has them."""
        there = np.isfinite(quads)
        known = there.all(axis=(1, 2))
        flat = fit_geometry(self._markers_mm[known], quads[known])
        return np.where(there, quads, flat.to_px(self._markers_mm))

    def _search(self, grey: NDArray[np.float32]) -> Sighting | None:
        """Search the whole frame, and its mirror image unless something was found the right way round before."""
        # The range of the values, without the outermost percent, in 8 bits.
        step = max(1, math.isqrt(grey.size // 50_000))
        low, high = np.percentile(grey[::step, ::step], [1.0, 99.0])
        spread = np.float32(255.0 / max(float(high - low), 1e-30))
        eight_bits = np.clip((grey - low) * spread, 0.0, 255.0).astype(np.uint8)
        for times, mirrored in self._preparations:
            quads = self._detected(eight_bits, times, mirrored)
            known = np.isfinite(quads[:, 0, 0])
            self.most_found = max(self.most_found, int(np.count_nonzero(known[: len(CORNERS)])))
            if np.count_nonzero(known) < 3:  # the places of others follow from three
                continue
            try:
                seen = self._aligned(grey, self._all_px(quads))
            except DataError:
                continue
            if seen is not None:
                self._preparations = [one for one in self._preparations if one[1] == mirrored]
                return seen
        return None

    def _detected(self, image: NDArray[np.uint8], times: int, mirrored: bool) -> FloatArray:
        """Return the outlines of the markers that ArUco finds, (n, 4, 2); NaN for others."""
        prepared: NDArray[Any] = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        if times > 1:
            prepared = cv2.resize(prepared, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR)
        found, ids, _ = self._detector.detectMarkers(prepared)
        quads = np.full(self.corners_mm.shape, np.nan)
        key = self.key
        for quad, marker in zip(found, np.ravel(ids).tolist() if found else [], strict=True):
            places = (quad.reshape(4, 2).astype(np.float64) + 0.5) / times - 0.5
            if mirrored:
                places[:, 0] = image.shape[1] - 1 - places[:, 0]
            digit, corner = divmod(int(marker), len(CORNERS))
            if digit < N_DIGITS and corner == len(CORNERS) - 1:  # its marker carries the key
                key = digit
            number = corner if digit < N_DIGITS else int(marker) - len(CORNERS) * (N_DIGITS - 1)
            if np.isnan(quads[number, 0, 0]):
                quads[number] = places
        if np.isfinite(quads[:, 0, 0]).sum() >= 3:
            self.key = key
        return quads

    def _aligned(
        self, grey: NDArray[np.float32], start_px: FloatArray, known: Sequence[NDArray[np.bool_]] = ()
    ) -> Sighting | None:
        """Align the markers with their patterns, beginning near to them, and read those in the corners.

        Where one in a corner cannot be read at first, the pattern `known` counts, or else what is there. None if
        one in a corner is not there, or all together are no chart.
        """
        quads, corners_px = np.full((2, *self.corners_mm.shape), np.nan)
        modules = np.empty((len(CORNERS), MODULES, MODULES))
        patterns: list[NDArray[np.bool_]] = []
        ids = []
        for k, quad in enumerate(start_px):
            around = _read(grey, quad)
            bits, marker = _spelled(around[2:-2, 2:-2])
            pattern: NDArray[np.bool_] | None
            if k >= len(CORNERS):
                pattern = _border_bits()[k - len(CORNERS)]
            elif marker >= 0:
                pattern = marker_bits(marker)
            else:  # between two pages, or moved
                pattern = known[k] if known else bits
            found = None if pattern is None else _align(grey, quad, _shown(pattern, around))
            read = None if found is None else _read(grey, found)[2:-2, 2:-2]
            bits, marker = (None, -1) if read is None else _spelled(read)
            if k < len(CORNERS):
                if pattern is None or found is None or bits is None:
                    return None
                quads[k], modules[k] = found, read
                patterns.append(pattern)
                ids.append(marker)
            elif bits is not None and np.count_nonzero(bits != pattern) <= MOST_WRONG_BITS:
                quads[k] = found
        there = np.isfinite(quads).all(axis=(1, 2))
        for k in np.flatnonzero(there).tolist():
            to_px = cv2.getPerspectiveTransform(SQUARE.astype(np.float32), quads[k].astype(np.float32))
            corners_px[k] = cv2.perspectiveTransform(INNER_SQUARE[None], to_px)[0]
        try:
            geometry = fit_geometry(self.corners_mm[there], corners_px[there])
        except DataError:
            return None
        side_px = math.sqrt(cv2.contourArea(quads[0].astype(np.float32)))
        if geometry.residual_px > MOST_BENT * side_px / MODULES:
            return None
        self._last, self._patterns = self._all_px(quads), patterns
        return Sighting(geometry, tuple(ids), modules, corners_px)


def _shown(bits: NDArray[np.bool_], around: FloatArray) -> NDArray[np.float32]:
    """Return a marker with a module of white around, and one as grey as the page in the frame, (11, 11)."""
    # The outermost modules are those of the page; then come the white around the marker, and its black border.
    inner = (around[k : len(around) - k, k : len(around) - k] for k in range(3))
    rings = (np.concatenate([one[0], one[-1], one[:, 0], one[:, -1]]) for one in inner)
    page, white, black = (float(np.median(ring)) for ring in rings)
    share = min(max((page - black) / (white - black), 0.0), 1.0) if white > black else 0.5
    return np.pad(np.pad(bits.astype(np.float32), 1, constant_values=1.0), 1, constant_values=share)


def _align(grey: NDArray[np.float32], quad: FloatArray, shown: NDArray[np.float32]) -> FloatArray | None:
    """Return the corners of a marker, (4, 2), that are near to others; None if it is not there."""
    module_px = math.sqrt(cv2.contourArea(quad.astype(np.float32))) / MODULES
    margin = 2.0 * module_px
    low = np.maximum(np.floor(quad.min(axis=0) - margin), 0).astype(int)
    high = np.ceil(quad.max(axis=0) + margin).astype(int) + 1
    part = grey[low[1] : high[1], low[0] : high[0]]
    if quad.min() < 0.0 or (quad > np.array(grey.shape[::-1]) - 1).any() or module_px < 1.0:
        return None
    blur = USUAL_BLUR_PX * SAMPLES / module_px
    pattern = cv2.GaussianBlur(np.kron(shown, np.ones((SAMPLES, SAMPLES), np.float32)), (0, 0), blur)
    pattern = np.ascontiguousarray(pattern[SAMPLES:-SAMPLES, SAMPLES:-SAMPLES])
    start = cv2.getPerspectiveTransform(IN_PATTERN.astype(np.float32), (quad - low).astype(np.float32))
    how: Any = (start.astype(np.float32), cv2.MOTION_HOMOGRAPHY, STEPS, None, 1)
    try:
        correlation, found = cv2.findTransformECC(pattern, cv2.GaussianBlur(part, (0, 0), BLUR_PX), *how)
    except cv2.error:  # it does not converge
        return None
    corners = cv2.perspectiveTransform(IN_PATTERN[None], found.astype(np.float64))[0] + low
    return corners if correlation > LEAST_CORRELATION and np.isfinite(corners).all() else None


def _read(grey: NDArray[np.float32], quad: FloatArray) -> FloatArray:
    """Return the mean values in the inner halves of a marker's modules and of two around them, (11, 11)."""
    n, middle = MODULES + 4, slice(SAMPLES // 4, SAMPLES - SAMPLES // 4)
    matrix = cv2.getPerspectiveTransform((IN_PATTERN + SAMPLES).astype(np.float32), quad.astype(np.float32))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    flat = cv2.warpPerspective(
        grey, matrix, (n * SAMPLES, n * SAMPLES), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    parts = flat.reshape(n, SAMPLES, n, SAMPLES)[:, middle, :, middle]
    return np.asarray(parts.mean(axis=(1, 3), dtype=np.float64))


def _spelled(modules: FloatArray) -> tuple[NDArray[np.bool_] | None, int]:
    """Return which modules of a marker are white, (7, 7), None without contrast; and its id, -1 for none."""
    is_border = np.ones((MODULES, MODULES), np.bool_)
    is_border[1:-1, 1:-1] = False
    black = modules[is_border]
    white = float(np.sort(modules[~is_border])[-3:].mean())
    if not white - black.mean() > 3.0 * black.std():
        return None, -1
    bits = np.asarray(modules > (white + black.mean()) / 2.0)
    n_wrong = np.count_nonzero(_all_bits() != bits, axis=(1, 2))
    nearest = int(n_wrong.argmin())
    return bits, nearest if n_wrong[nearest] <= MOST_WRONG_BITS else -1


def _dictionary(n_borders: int) -> Any:
    """Return OpenCV's dictionary of the markers in the corners, followed by those along the borders."""
    names = (f"DICT_{one.upper()}" for one in (DICTIONARY, BORDER_DICTIONARY))
    corners, borders = (cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)) for name in names)
    together = np.concatenate([corners.bytesList, borders.bytesList[list(BORDER_IDS[:n_borders])]])
    return cv2.aruco.Dictionary(together, corners.markerSize, corners.maxCorrectionBits)


@cache
def _border_bits() -> NDArray[np.bool_]:
    return np.array(page_markers(0, 0, n_borders=len(BORDER_IDS))[len(CORNERS) :])


@cache
def _all_bits() -> NDArray[np.bool_]:
    return np.array([marker_bits(marker) for marker in range(len(CORNERS) * N_DIGITS)])


def search_parameters() -> Any:
    """Return the parameters of a search for small, blurred and noisy markers; later steps notice errors."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.maxErroneousBitsInBorderRate = 0.5
    parameters.errorCorrectionRate = 1.0
    return parameters


def _grey(frame: NDArray[Any]) -> NDArray[np.float32]:
    """Return a frame's values, of colours their mean, as 32-bit floats; values that are not finite become 0."""
    grey = frame if frame.ndim == 2 else frame.mean(axis=2, dtype=np.float32)
    grey = np.ascontiguousarray(grey, np.float32)
    return grey if frame.dtype.kind in "ui" or np.isfinite(grey).all() else np.nan_to_num(grey, posinf=0, neginf=0)
