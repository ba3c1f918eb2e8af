"""The markers of a chart in recorded frames: found anew in the first frame, and followed from frame to frame.

A frame is searched whole, by ArUco, only where the markers are not near their places in the frame before. From
there the homography is adjusted until the outer edges of the markers lie in the middle of the slopes from black to
white. That place does not depend on the blur, and averages the noise over the whole length of the edges.

The four markers in the corners name the page, and all have to be there. Markers along the borders add edges: one
that is hidden, or beyond the frame, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

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
from todframes.importing.lens import Lens
from todframes.importing.lens_fit import USEFUL, EdgePoints, MeasuredEdges, corner_pieces, first_fits, solve

PIECES, POINTS = 3, 6
"""Pieces of a marker's edge, and points along each piece whose profiles across the edge are averaged."""

EDGE = 0.76
"""Middle part of an edge that is measured; beside it blur brings in the corner."""

PROFILE_REACH = 0.5
"""Length of a profile on either side of an edge, in modules: to the middle of the black border, where black is
measured, and of the white around, which is as wide."""

PROFILE_STEPS = 8
"""Samples of a profile on either side of an edge."""

ALONG = ((np.arange(PIECES * POINTS) + 0.5) / (PIECES * POINTS) - 0.5) * EDGE
ACROSS = np.linspace(-PROFILE_REACH, PROFILE_REACH, 2 * PROFILE_STEPS + 1)
"""Points along an edge, from its middle in units of its length, and samples across it, in modules."""

BLURS = np.geomspace(0.02, 2.0, 100)
"""Widths of a blur in modules, standard deviations, among which that of a frame is interpolated."""

RISES = (2.0 * ndtr(PROFILE_REACH / PROFILE_STEPS / BLURS) - 1.0) / (2.0 * ndtr(PROFILE_REACH / BLURS) - 1.0)
"""Rise of an edge with each of these blurs over its two middle steps, relative to that of its profile."""

MOST_STEPS, CONVERGED_PX = 8, 0.02
"""Number of adjustments of a homography, and the motion of the edges after which there is no further one: each
leaves a small part of the motion that it corrects."""

SAMPLES, SAMPLED = 3, 0.5
"""Samples along a module's side that are averaged to its value, and the part of the side that they cover."""

MOST_WRONG_BITS = 1
"""Number of modules of a marker that may read wrong; two markers of the dictionary differ in five or more."""

NEAR, LEAST_NEAR = 0.2, 0.5
"""Distance of an edge from where it is looked for, in modules, up to which it counts for the lens while a
recording is read; and the least share of such edges, without which all count."""

CORRECTIONS, MOST_CORRECTED = 3, 0.25
"""Steps in which the shift of an edge is found that a profile with its neighbours would show as measured; and the
largest shift, in modules, that the profile is modelled for."""

NOTICED_PX = 0.1
"""Residual of the edges from which a lens is looked for while a recording is read."""


class SeenEdges(NamedTuple):
    """The edges of the markers in one frame: the geometry that they were looked for with, and how far outwards of
    it each piece lies, in pixels; NaN for markers that the frame does not show."""

    start: Geometry
    shifts_px: NDArray[np.float32]

    def measured(self, pieces: EdgePoints) -> MeasuredEdges:
        """Return the places of the edges."""
        normals, outwards = pieces.directions(self.start)
        away = (self.shifts_px * (normals * outwards).sum(axis=1))[:, None] * normals
        return MeasuredEdges(self.start, self.start.to_px(pieces.places_mm) + away, normals)


class Sighting(NamedTuple):
    """The markers of a page in one frame.

    `modules` has shape (4, 7, 7): the mean values in the modules of the markers in the corners. `ids` are the
    identities that they spell, -1 for one that is no marker; a blend of two pages spells nonsense. `edges` are
    those of all markers.
    """

    geometry: Geometry
    ids: tuple[int, ...]
    modules: FloatArray
    edges: SeenEdges


class MarkerFinder:
    """Finder of a chart's markers, by the places of their centres, (n, 2): clockwise corners, then borders.

    `most_found` is the largest number of corners with a marker in a frame; `misfit_px` is how far markers in all
    corners lie off a flat chart behind a lens, if none fits: the least of all frames, root mean square. `key` is
    that of the chart in the present frame if a search has found the marker that carries it, and two others.
    `is_inverted` is True if markers have been found in the negative of a frame alone.
    """

    def __init__(self, centres_mm: FloatArray, side_mm: float) -> None:
        import cv2

        self.most_found = 0
        self.misfit_px: float | None = None
        self.key: int | None = None
        self.is_inverted = False
        self._module_mm = side_mm / MODULES
        corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * side_mm
        self._corners_mm = centres_mm[:, None, :] + corner
        self._edges = MarkerEdges(self._corners_mm, self._module_mm)
        within = np.linspace(-0.5, 0.5, SAMPLES) * SAMPLED
        along = (np.arange(MODULES) - (MODULES - 1) / 2)[:, None] + within
        grid = np.stack(np.meshgrid(along.ravel(), along.ravel()), axis=-1) * self._module_mm
        self._samples_mm = centres_mm[:, None, None, :] + grid
        self._detector = cv2.aruco.ArucoDetector(_dictionary(len(centres_mm) - len(CORNERS)), search_parameters())
        self._last: Geometry | None = None
        self.pieces = self._edges.pieces
        self.lens: Lens | None = None
        self._recent: list[SeenEdges] = []
        self._n_seen = 0
        # Preparations of a frame for the search: how often enlarged, and whether mirrored.
        self._preparations = list(product((1, 2), (False, True)))

    def look(self, frame: NDArray[Any]) -> Sighting | None:
        """Find the markers in a frame of any number type, (rows, columns) or (rows, columns, 3).

        None if the frame does not show all four.
        """
        grey, self.key = _grey(frame), None
        seen = self._sighting(grey, self._last) if self._last is not None else None
        seen = seen or self._search(grey)
        if seen is not None:
            self._last, lens = seen.geometry, self.lens
            self._follow_lens(seen, grey.shape)
            if lens is None and self.lens is not None:
                seen = self._seen_through_lens(grey, seen)
        return seen

    def _seen_through_lens(self, grey: NDArray[np.float32], seen: Sighting) -> Sighting:
        """Measure the edges in the first frame through a lens, and estimate it, until they fit no better.

        Edges are measured well only near to where the geometry that they are looked for with has them.
        """
        for _ in range(MOST_STEPS):
            assert self._last is not None
            again = self._sighting(grey, self._last)
            if again is None or again.geometry.residual_px > 0.9 * seen.geometry.residual_px:
                break
            seen = again
            self._recent = [seen.edges]
            self.lens = self._first_lens([seen.edges], grey.shape) or self.lens
            self._last = self._through_lens(self.pieces, self._near(seen.edges))
        return seen

    def _through_lens(self, pieces: EdgePoints, measured: MeasuredEdges) -> Geometry:
        """Return the geometry of a frame behind the lens that is known."""
        fit = solve(pieces, [measured], self.lens, 0)
        return measured.start.with_lens(self.lens, pieces.places_mm) if fit is None else fit.geometries[0]

    def _follow_lens(self, seen: Sighting, shape: tuple[int, ...]) -> None:
        """Estimate the lens from the frames so far, ever more rarely, where markers do not fit without one."""
        self._n_seen += 1
        self._recent = [*self._recent, seen.edges][-8:]
        is_turn = self._n_seen & (self._n_seen - 1) == 0
        lens = self.lens or seen.geometry.lens
        if is_turn and (lens is not None or seen.geometry.residual_px > NOTICED_PX):
            self.lens = self._first_lens(self._recent, shape)
            self._last = self._through_lens(self.pieces, self._near(seen.edges))

    def _first_lens(self, recent: Sequence[SeenEdges], shape: tuple[int, ...]) -> Lens | None:
        """Estimate the lens from the edges in some frames; None if none is of use."""
        fits = first_fits(self.pieces, [self._near(edges) for edges in recent], shape)
        return fits[0].lens if fits else None

    def _near(self, edges: SeenEdges) -> MeasuredEdges:
        """Return the places of edges, without those so far from where they were looked for that a profile reaches
        little beyond them."""
        measured = edges.measured(self.pieces)
        across = np.einsum("nij,nj->ni", edges.start.jacobians(self.pieces.places_mm), self.pieces.outwards)
        is_near = np.abs(edges.shifts_px) <= NEAR * self._module_mm * np.linalg.norm(across, axis=1)
        if np.count_nonzero(is_near) < LEAST_NEAR * np.count_nonzero(np.isfinite(edges.shifts_px)):
            return measured
        return measured._replace(places_px=np.where(is_near[:, None], measured.places_px, np.nan))

    def _search(self, grey: NDArray[np.float32]) -> Sighting | None:
        """Search the whole frame, and its mirror image unless something was found the right way round before.

        Where a lens bends the chart, edges are missed beside the lines on which they are looked for. So they are
        looked for through each lens that the corners may show.
        """
        # The range of the values, without the outermost percent, in 8 bits.
        step = max(1, math.isqrt(grey.size // 50_000))
        low, high = np.percentile(grey[::step, ::step], [1.0, 99.0])
        spread = np.float32(255.0 / max(float(high - low), 1e-30))
        eight_bits = np.clip((grey - low) * spread, 0.0, 255.0).astype(np.uint8)
        for times, mirrored in self._preparations:
            corners = self._detected(eight_bits, times, mirrored)
            known = sorted(corners)
            n_corners = sum(k < len(CORNERS) for k in known)
            self.most_found = max(self.most_found, n_corners)
            if len(known) < 3:  # the places of others follow from three
                continue
            best: Sighting | None = None
            for start in self._starts(known, np.array([corners[k] for k in known]), grey.shape):
                seen = self._sighting(grey, start)
                if seen is None:
                    if n_corners == len(CORNERS):
                        away = start.to_px(self._corners_mm[known]) - np.array([corners[k] for k in known])
                        misfit = math.sqrt(float((away**2).sum(axis=-1).mean()))
                        self.misfit_px = min(misfit, self.misfit_px or math.inf)
                elif best is None or seen.geometry.residual_px < USEFUL * best.geometry.residual_px:
                    best = seen
                if best is not None and best.geometry.residual_px <= NOTICED_PX:
                    break
            if best is not None:
                self._preparations = [one for one in self._preparations if one[1] == mirrored]
                return best
        if self.most_found < 3 and not self.is_inverted:
            key = self.key
            self.is_inverted = len(self._detected(255 - eight_bits, 1, False)) >= 3
            self.key = key
        return None

    def _starts(self, known: list[int], corners_px: FloatArray, shape: tuple[int, ...]) -> Iterator[Geometry]:
        """Yield geometries that fit the corners of markers: without a lens, and with one, the best lens first."""
        try:
            plain = fit_geometry(self._corners_mm[known], corners_px)
        except DataError:
            return
        places = np.repeat(corners_px.reshape(-1, 2), 2, axis=0)
        measured = MeasuredEdges(plain, places, np.tile(np.eye(2), (corners_px[..., 0].size, 1)))
        pieces = corner_pieces(self._corners_mm[known])
        if self.lens is not None:
            yield self._through_lens(pieces, measured)
        yield plain
        if len(known) >= len(CORNERS):
            fits = first_fits(pieces, [measured], shape)
            yield from (fit.geometries[0] for fit in fits if fit.lens is not None)

    def _detected(self, image: NDArray[np.uint8], times: int, mirrored: bool) -> dict[int, FloatArray]:
        """Return the corners of the markers that ArUco finds, (4, 2) each, by the number of the marker."""
        import cv2

        prepared: NDArray[Any] = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        if times > 1:
            prepared = cv2.resize(prepared, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR)
        found, ids, _ = self._detector.detectMarkers(prepared)
        corners: dict[int, FloatArray] = {}
        key = self.key
        for quad, marker in zip(found, np.ravel(ids).tolist() if found else [], strict=True):
            places = (quad.reshape(4, 2).astype(np.float64) + 0.5) / times - 0.5
            if mirrored:
                places[:, 0] = image.shape[1] - 1 - places[:, 0]
            digit, corner = divmod(int(marker), len(CORNERS))
            if digit < N_DIGITS and corner == len(CORNERS) - 1:  # its marker carries the key
                key = digit
            corners.setdefault(corner if digit < N_DIGITS else int(marker) - len(CORNERS) * (N_DIGITS - 1), places)
        if len(corners) >= 3:
            self.key = key
        return corners

    def _sighting(self, grey: NDArray[np.float32], start: Geometry) -> Sighting | None:
        """Adjust a geometry to the edges of the markers, and read these; None if they are not there."""
        hidden = np.zeros(len(self._corners_mm), np.bool_)
        while True:
            found = self._edges.adjusted(grey, start, hidden)
            if found is None:
                return None
            geometry, edges = found
            there = np.asarray(np.isfinite(edges.shifts_px).reshape(len(hidden), -1).all(axis=1))
            modules = self._read(grey, geometry, there)
            wrong = []
            for k in (np.flatnonzero(there[len(CORNERS) :]) + len(CORNERS)).tolist():
                bits = _bits(modules[k])
                if bits is None or np.count_nonzero(bits != _border_bits()[k - len(CORNERS)]) > MOST_WRONG_BITS:
                    wrong.append(k)
            if not wrong:
                break
            hidden[wrong] = True
        ids = []
        patterns = np.concatenate([np.zeros((len(CORNERS), MODULES, MODULES), np.bool_), _border_bits()])
        for k, of_corner in enumerate(modules[: len(CORNERS)]):
            bits = _bits(of_corner)
            if bits is None:
                return None
            n_wrong = np.count_nonzero(_all_bits() != bits, axis=(1, 2))
            nearest = int(n_wrong.argmin())
            is_marker = n_wrong[nearest] <= MOST_WRONG_BITS
            ids.append(nearest if is_marker else -1)
            patterns[k] = _all_bits()[nearest] if is_marker else bits
        geometry, edges = self._edges.without_neighbours(grey, edges, patterns[: len(hidden)])
        if not self._edges.belong(geometry):
            return None
        return Sighting(geometry, tuple(ids), modules[: len(CORNERS)], edges)

    def _read(self, grey: NDArray[np.float32], geometry: Geometry, there: NDArray[np.bool_]) -> FloatArray:
        """Return the mean values in the modules of the markers, (n, 7, 7); NaN for those that are not there."""
        side = MODULES * SAMPLES
        values = _sampled(grey, geometry.to_px(self._samples_mm[there]).reshape(-1, side, 2))
        parts = values.reshape(-1, MODULES, SAMPLES, MODULES, SAMPLES)
        modules = np.full((len(there), MODULES, MODULES), np.nan)
        modules[there] = parts.mean(axis=(2, 4), dtype=np.float64)
        return modules


def _bits(modules: FloatArray) -> NDArray[np.bool_] | None:
    """Return which modules of a marker are white, (7, 7); None without contrast."""
    black = modules[_BORDER]
    white = float(np.sort(modules[~_BORDER])[-3:].mean())
    if not white - black.mean() > 3.0 * black.std():
        return None
    return np.asarray(modules > (white + black.mean()) / 2.0)


def _dictionary(n_borders: int) -> Any:
    """Return OpenCV's dictionary of the markers in the corners, followed by those along the borders."""
    import cv2

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


_BORDER = np.ones((MODULES, MODULES), np.bool_)
_BORDER[1:-1, 1:-1] = False


class MarkerEdges:
    """The outer edges of markers, which homographies are adjusted to.

    Each of a marker's four edges has `PIECES` pieces. The profile of a piece, averaged along it, is antisymmetric
    about the edge for any blur. So the integral of its difference from the middle of black and white, over equal
    distances on both sides, is zero at the edge. White that spreads (a display that glares, a non-linear camera)
    moves all edges outwards or inwards by the same amount, which is also fitted.
    """

    def __init__(self, corners_mm: FloatArray, module_mm: float) -> None:
        after = np.roll(corners_mm, -1, axis=1)
        middles = corners_mm[:, :, None] + (ALONG + 0.5)[:, None] * (after - corners_mm)[:, :, None]
        inwards = corners_mm.mean(axis=1)[:, None] - (corners_mm + after) / 2.0
        outwards = -inwards / np.linalg.norm(inwards, axis=-1, keepdims=True)
        self._module_mm = module_mm
        # (marker, edge, point along the edge, place across it, x and y)
        self._places_mm = middles[..., None, :] + (ACROSS * module_mm)[:, None] * outwards[:, :, None, None]
        self._outside_mm = middles + 1.5 * module_mm * outwards[:, :, None]  # The page beside the white border.
        pieces_mm = middles.reshape(-1, POINTS, 2).mean(axis=1)
        self.pieces = EdgePoints(
            pieces_mm,
            np.repeat(outwards.reshape(-1, 2), PIECES, axis=0),
            corners_mm.mean(axis=(0, 1)),
            float(corners_mm.std()),
            PIECES,
        )

    def adjusted(
        self, grey: NDArray[np.float32], start: Geometry, hidden: NDArray[np.bool_]
    ) -> tuple[Geometry, SeenEdges] | None:
        """Return the geometry whose edges lie in the middles of the slopes; None if there are no such edges.

        `hidden` marks the markers, (n,), that do not count.
        """
        geometry, edges = start, None
        for _ in range(MOST_STEPS):
            shifts = self._shifts_px(grey, geometry, hidden)
            if shifts is None:
                return None
            edges = SeenEdges(geometry, shifts.astype(np.float32))
            geometry, moved_px = self._moved(geometry, shifts)
            if not np.isfinite(geometry.homography).all():
                return None
            if moved_px < CONVERGED_PX:
                break
        assert edges is not None
        return (geometry, edges) if self.belong(geometry) else None

    def belong(self, geometry: Geometry) -> bool:
        """Return whether the residual of a geometry is small enough for markers of one chart."""
        module_px = geometry.scale_px_per_mm(self.pieces.middle_mm) * self._module_mm
        return geometry.residual_px <= 0.2 * module_px

    def _shifts_px(
        self, grey: NDArray[np.float32], geometry: Geometry, hidden: NDArray[np.bool_]
    ) -> FloatArray | None:
        """Measure the distance of each piece from its place in the geometry, outwards along the mapped normal.

        NaN for markers along the borders that are not there; None if one in a corner is not.
        """
        places = geometry.to_px(self._places_mm)
        height, width = grey.shape
        lowest, highest = places.min(axis=(1, 2, 3)), places.max(axis=(1, 2, 3))
        there = ~hidden & (lowest > 0.0).all(axis=1) & (highest < (width - 1, height - 1)).all(axis=1)
        if not there[: len(CORNERS)].all():
            return None
        profiles, length_px = _profiles(grey, places[there])
        black, white = _levels(profiles)
        contrast = (white - black).reshape(len(profiles), 4).min(axis=1)
        of_corners = contrast[: len(CORNERS)]
        if not (of_corners > 0.0).all():
            return None
        # The light may fall off; noise where there is no marker has no contrast.
        is_edge = contrast > 0.3 * float(np.median(of_corners))
        is_edge[: len(CORNERS)] = True
        with np.errstate(divide="ignore", invalid="ignore"):  # for markers that are not there
            shift = _shift_per_module(profiles)
        shifts = np.full((len(there), 4, PIECES), np.nan)
        shifts[there] = np.where(is_edge[:, None, None], shift * length_px, np.nan)
        return shifts.ravel()

    def without_neighbours(
        self, grey: NDArray[np.float32], edges: SeenEdges, bits: NDArray[np.bool_]
    ) -> tuple[Geometry, SeenEdges]:
        """Correct the shifts of edges for the blur of what lies a module beside them; return the geometry, too.

        Black beside a white module is less black, and white beside the grey of the page less white, so that the
        middle of the slope is not where the edge is. How much follows from the width of the blur, which the
        steepest part of the slopes shows, from the pattern of the markers, `bits`, (n, 7, 7), and from the shift
        itself. Linear interpolation blurs as well, most in the middle between pixels.
        """
        there = np.isfinite(edges.shifts_px).reshape(len(bits), -1).all(axis=1)
        places_px = edges.start.to_px(self._places_mm[there])
        profiles, length_px = _profiles(grey, places_px)
        black, white = _levels(profiles)
        outside_px = np.clip(edges.start.to_px(self._outside_mm[there]), 0.5, np.array(grey.shape[::-1]) - 1.5)
        page = _sampled(grey, outside_px).reshape(len(profiles), 4, PIECES, POINTS).mean(axis=3)[..., None]
        white_share = np.clip((page - black) / (white - black), 0.0, 1.0)
        turned = np.stack([np.rot90(bits[there], turn, axes=(1, 2))[:, 1] for turn in range(4)], axis=1)
        at = np.floor(ALONG * MODULES + MODULES / 2)
        inside = turned[..., at.astype(int)].reshape(len(profiles), 4, PIECES, POINTS).mean(axis=3)[..., None]
        middle = PROFILE_STEPS
        rise = (profiles[..., middle + 1] - profiles[..., middle - 1])[..., None] / (white - black)
        # The variance, along profiles, of the weights of linear interpolation.
        part, along = places_px % 1.0, places_px[..., [-1], :] - places_px[..., [0], :]
        interpolated_px2 = (part * (1.0 - part) * along**2).sum(axis=-1) / (along**2).sum(axis=-1)
        interpolated_px2 = interpolated_px2.reshape(*length_px.shape, POINTS, -1).mean(axis=-2)
        blur_px2 = (np.interp(-rise[..., 0], -RISES, BLURS) * length_px) ** 2 - interpolated_px2[..., middle]
        blur_px2 = np.maximum(float(np.median(blur_px2)) + interpolated_px2, 0.0)
        blur = np.clip(np.sqrt(blur_px2) / length_px[..., None], BLURS[0], BLURS[-1])
        shifts = edges.shifts_px.astype(np.float64).reshape(len(bits), 4, PIECES)
        measured = shifts[there] / length_px
        shift = np.zeros_like(measured)
        for _ in range(CORRECTIONS):
            away = ACROSS - np.clip(shift, -MOST_CORRECTED, MOST_CORRECTED)[..., None]
            modelled = ndtr(away / blur) - (1.0 - white_share) * ndtr((away - 1.0) / blur)
            modelled += inside * ndtr(-(away + 1.0) / blur)
            shift += measured - _shift_per_module(modelled)
        shifts[there] = shift * length_px
        corrected = SeenEdges(edges.start, shifts.ravel().astype(np.float32))
        geometry, _ = self._moved(edges.start, shifts.ravel())
        return geometry, corrected

    def _moved(self, geometry: Geometry, shifts_px: FloatArray) -> tuple[Geometry, float]:
        """Move a geometry's edges by the least squares of the shifts; return it and how far they moved at most."""
        normals, outwards = self.pieces.directions(geometry)
        there = np.isfinite(shifts_px)
        design = self.pieces.design(geometry, normals)[there]
        along_normals_px = (shifts_px * (normals * outwards).sum(axis=1))[there]
        solution, *_ = np.linalg.lstsq(design, along_normals_px, rcond=None)
        left = along_normals_px - design @ solution
        residual = math.sqrt(float(left @ left) / (len(left) - len(solution)))
        moved = Geometry(self.pieces.moved(geometry, solution), residual, geometry.lens)
        return moved, float(np.abs(design[:, :8] @ solution[:8]).max())


def _profiles(grey: NDArray[np.float32], places_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sample a frame across edges: profiles of the pieces, (marker, 4, piece, place), and a module in pixels
    there, (marker, 4, piece)."""
    shape = len(places_px), 4, PIECES, POINTS
    profiles = _sampled(grey, places_px).reshape(*shape, -1).mean(axis=3)
    across = np.linalg.norm(places_px[..., -1, :] - places_px[..., 0, :], axis=-1)
    return profiles, across.reshape(shape).mean(axis=3) / (2.0 * PROFILE_REACH)


def _levels(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return black and white of edges, from all pieces of each: a level is as sharp as it is long."""
    black, white = (profiles[..., [end]].mean(axis=2, keepdims=True) for end in (0, -1))
    return black, white


def _shift_per_module(profiles: FloatArray) -> FloatArray:
    """Return how far outwards an edge lies from the middle of its profile, in modules."""
    black, white = _levels(profiles)
    above = (profiles - black) / (white - black) - 0.5
    integral = above.sum(axis=-1) - (above[..., 0] + above[..., -1]) / 2.0
    return np.asarray(-integral * 2.0 * PROFILE_REACH / (2 * PROFILE_STEPS))


def search_parameters() -> Any:
    """Return the parameters of a search for small, blurred and noisy markers; later steps notice errors."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.maxErroneousBitsInBorderRate = 0.5
    parameters.errorCorrectionRate = 1.0
    return parameters


def _sampled(grey: NDArray[np.float32], places_px: FloatArray) -> FloatArray:
    """Interpolate a frame linearly at places, (…, 2), all of which lie on it.

    OpenCV's `remap` rounds places to 1/32 of a pixel.
    """
    rows_and_columns = np.moveaxis(places_px[..., ::-1], -1, 0)
    return np.asarray(ndimage.map_coordinates(grey, rows_and_columns, np.float64, order=1))


def _grey(frame: NDArray[Any]) -> NDArray[np.float32]:
    """Return a frame's values, of colours their mean, as 32-bit floats; values that are not finite become 0."""
    grey = frame if frame.ndim == 2 else frame.mean(axis=2, dtype=np.float32)
    grey = np.ascontiguousarray(grey, np.float32)
    return grey if frame.dtype.kind in "ui" or np.isfinite(grey).all() else np.nan_to_num(grey, posinf=0, neginf=0)
