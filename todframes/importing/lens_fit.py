"""The lens of a recording, solved from the edges of markers in several frames.

Each frame has a homography of its own, as the camera may shake and the chart be moved; the lens is one for all.
The homographies are eliminated frame by frame, so that a step of Gauss and Newton solves for the lens alone. Of
several models, the one with the least Bayesian information criterion counts. The error of the triangles holds the
distance from those of the other models as well, weighed by Akaike's criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.importing.geometry import Geometry
from todframes.importing.lens import Lens, LensModel
from todframes.results.wording import subsample

MOST_STEPS, CONVERGED_PX = 15, 1e-3
"""Steps of Gauss and Newton, and the largest motion of an edge after which there is no further one."""

TRIED: dict[LensModel, tuple[int, ...]] = {"polynomial": (1, 4, 7), "fisheye": (1, 5)}
"""Models and numbers of coefficients, the first ones of `PARAMETERS`; each begins with the result of the one
before. More count only if the first one explains something, as it does for any lens: where it does not, others
would follow what shifts edges in another way, such as a colour mosaic."""

USUAL: dict[LensModel, tuple[float, ...]] = {
    "polynomial": (math.inf, 0.1, 0.02, 0.02, 0.05, 0.002, 0.002),
    "fisheye": (math.inf, 0.02, 0.02, 0.05, 0.02),
}
"""Standard deviations of the coefficients among lenses, in the order of `PARAMETERS`: edges that do not
determine a coefficient leave it near 0."""

LEAST_ERROR_PX = 0.01
"""Error of an edge that remains however many frames are averaged: pixels are no points."""

USEFUL = 0.9
"""Residual with another coefficient relative to that without, below which it is used while a recording is read."""

MOST_PLACED = 4
"""Frames in which the error of the triangles is computed."""

DIFFERENCE = 1e-4
"""Step of numerical derivatives of a triangle's place: of coefficients, and of the chart's map in parts of
itself."""


class EdgePoints(NamedTuple):
    """Pieces of edges on a chart: middles and unit vectors outwards, (n, 2), in millimetres; 0 for a point.

    `middle_mm` and `spread_mm` are those of all, for coordinates about 1. `per_edge` pieces in a row are of one
    edge.
    """

    places_mm: FloatArray
    outwards: FloatArray
    middle_mm: FloatArray
    spread_mm: float
    per_edge: int = 1

    @property
    def to_one(self) -> FloatArray:
        """Matrix that maps millimetres to coordinates about 1."""
        x, y = self.middle_mm.tolist()
        return np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, self.spread_mm]]) / self.spread_mm

    def directions(self, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
        """Return unit normals of the edges in the frame, pointing outwards, and what outwards is mapped to."""
        jacobians = geometry.jacobians(self.places_mm)
        quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
        normals = np.einsum("nij,nj->ni", jacobians, self.outwards @ quarter) @ quarter
        outwards = np.einsum("nij,nj->ni", jacobians, self.outwards)
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        normals *= np.sign((normals * outwards).sum(axis=1))[:, None] / np.linalg.norm(normals, axis=1)[:, None]
        return normals, outwards

    def design(self, geometry: Geometry, normals: FloatArray) -> FloatArray:
        """Return the derivative of the edges' places along normals, (n, 9): by the homography, and 1 for edges.

        A change of the homography comes after the map to coordinates about 1: ξ' = (I + E) ξ with E[2, 2] = 0. The
        last column is a spread of white, which moves all edges outwards alike.
        """
        u, v = ((self.places_mm - self.middle_mm) / self.spread_mm).T
        at = geometry.ideal_px(self.places_mm)
        one, none = np.ones_like(u), np.zeros_like(u)
        base = self._base(geometry)
        depth = base[2] @ np.array([u, v, one])
        along = normals
        if geometry.lens is not None:
            along = np.einsum("ni,nij->nj", normals, geometry.lens.jacobian(at))
        columns_x = [u, v, one, none, none, none, -u * at[:, 0], -v * at[:, 0]]
        columns_y = [none, none, none, u, v, one, -u * at[:, 1], -v * at[:, 1]]
        design = (along[:, 0] * np.array(columns_x) + along[:, 1] * np.array(columns_y)) / depth
        return np.column_stack([design.T, (self.outwards**2).sum(axis=1)])

    def moved(self, geometry: Geometry, change: FloatArray) -> FloatArray:
        """Return the homography after a change of the parameters of `design`."""
        return np.asarray((self._base(geometry) + np.append(change[:8], 0.0).reshape(3, 3)) @ self.to_one)

    def _base(self, geometry: Geometry) -> FloatArray:
        base = geometry.homography @ np.linalg.inv(self.to_one)
        with np.errstate(divide="ignore", invalid="ignore"):  # callers check that it is finite
            return np.asarray(base / base[2, 2])


class MeasuredEdges(NamedTuple):
    """Edges as measured in a frame: places, (n, 2) in pixels, which count along unit normals, (n, 2).

    Places of edges that the frame does not show are NaN.
    """

    start: Geometry
    places_px: FloatArray
    normals: FloatArray


def corner_pieces(corners_mm: FloatArray) -> EdgePoints:
    """Return the corners of markers, (marker, 4, 2), each of them twice: to be measured along x and along y."""
    places = np.repeat(corners_mm.reshape(-1, 2), 2, axis=0)
    return EdgePoints(places, np.zeros_like(places), places.mean(axis=0), float(places.std()))


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens, and the geometries of the frames that it was solved from.

    `shown` states which edges each frame shows, (frame, n); all else is 0 for others. `influence` has the
    pseudo-inverse of each frame's design, (9, n); `left_px` what is left of the edges' distances, (frame, n).
    `gradients` are the derivatives of the edges by the coefficients, (frame, n, coefficient), and `scores` those
    that the homographies do not explain; `covariance` is that of the coefficients for edges with an error of 1 px.
    `weights` are those of what is usual among lenses, see `solve`.
    """

    lens: Lens | None
    n_coefficients: int
    geometries: list[Geometry]
    shown: NDArray[np.bool_]
    left_px: FloatArray
    influence: FloatArray
    gradients: FloatArray
    scores: FloatArray
    covariance: FloatArray
    weights: FloatArray

    @property
    def mean_square_px2(self) -> float:
        """Mean square of the edges' mean distances over the frames, with the error that edges always have."""
        n_frames = self.shown.sum(axis=0)
        means = self.left_px.sum(axis=0)[n_frames > 0] / n_frames[n_frames > 0]
        return float((means**2).mean()) + LEAST_ERROR_PX**2

    @property
    def edge_variance_px2(self) -> float:
        """Variance of an edge in one frame that would explain the edges' mean distances over the frames."""
        return len(self.left_px) * self.mean_square_px2

    @property
    def _n_pieces(self) -> int:
        return int(self.shown.any(axis=0).sum())

    @property
    def _n_determined(self) -> float:
        """Number of coefficients, each as far as the edges determine it."""
        return self.n_coefficients - float(np.diagonal(self.covariance) @ self.weights)

    @property
    def bayesian_criterion(self) -> float:
        """Bayesian information criterion: among models that are as likely before, -2 ln of the probability."""
        return self._n_pieces * math.log(self.mean_square_px2) + self._n_determined * math.log(self._n_pieces)

    @property
    def akaike_criterion(self) -> float:
        """Akaike's information criterion; Burnham & Anderson 2002, section 2.3."""
        return self._n_pieces * math.log(self.mean_square_px2) + 2.0 * self._n_determined

    @property
    def residual_px(self) -> float:
        """Root mean square distance of the edges from where the fit has them, per degree of freedom."""
        n_free = int(self.shown.sum()) - 9 * len(self.left_px) - self.n_coefficients
        return math.sqrt(float((self.left_px**2).sum()) / max(n_free, 1))


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # all results are checked to be finite
def solve(
    pieces: EdgePoints,
    measured: Sequence[MeasuredEdges],
    lens: Lens | None,
    n_coefficients: int,
    *,
    edge_variance_px2: float = 0.0,
) -> LensFit | None:
    """Solve the homographies of frames, and the first coefficients of their lens, by least squares.

    `lens` is the first estimate; None for an ideal one, which stays so. `edge_variance_px2` is the variance of an
    edge, for which coefficients are weighed against the usual ones; 0: edges alone count. None if the edges do not
    determine the coefficients, or the lens would show a place twice.
    """
    geometries = [edges.start.with_lens(lens, pieces.places_mm) for edges in measured]
    normals = np.array([edges.normals for edges in measured])
    shown = np.array([np.isfinite(edges.places_px).all(axis=1) for edges in measured])
    points = np.where(shown[..., None], [edges.places_px for edges in measured], 0.0)
    spreads = np.zeros(len(measured))
    weights = edge_variance_px2 / _usual(lens, n_coefficients) ** 2
    for _ in range(MOST_STEPS):
        at = np.array([geometry.to_px(pieces.places_mm) for geometry in geometries])
        distances = (((points - at) * normals).sum(axis=2) - spreads[:, None]) * shown
        design = np.array([pieces.design(*view) for view in zip(geometries, normals, strict=True)])
        design *= shown[..., None]
        gradients = np.zeros((*distances.shape, n_coefficients))
        if lens is not None and n_coefficients:
            ideal = np.array([geometry.ideal_px(pieces.places_mm) for geometry in geometries])
            by_coefficient = lens.gradient(ideal, n_coefficients)
            gradients = np.einsum("vni,vnij->vnj", normals, by_coefficient) * shown[..., None]
        if not all(np.isfinite(numbers).all() for numbers in (distances, design, gradients)):
            return None
        influence = np.linalg.pinv(design)
        scores = gradients - design @ (influence @ gradients)
        normal = np.einsum("vni,vnj->ij", scores, scores) + np.diag(weights)
        scale = np.sqrt(np.diagonal(normal))
        # With a larger condition number the edges do not determine the coefficients.
        if n_coefficients and (not (scale > 0.0).all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12):
            return None
        covariance = np.linalg.inv(normal)
        beyond_usual = weights * np.array(lens.coefficients[:n_coefficients]) if lens is not None else weights
        change = covariance @ (np.einsum("vni,vn->i", scores, distances) - beyond_usual)
        # A step that is too long for a strong lens would fold its picture: it is halved until it does not.
        for _ in range(6):
            rest = distances - gradients @ change
            moves = (influence @ rest[..., None])[..., 0]
            changed_lens = lens.changed(change) if lens is not None else None
            moved_geometries = [
                replace(geometry, homography=pieces.moved(geometry, move), lens=changed_lens)
                for geometry, move in zip(geometries, moves, strict=True)
            ]
            if not all(np.isfinite(geometry.homography).all() for geometry in moved_geometries):
                return None
            if changed_lens is None or all(
                changed_lens.shows_once(geometry.ideal_px(pieces.places_mm)) for geometry in moved_geometries
            ):
                break
            change = change / 2.0
        else:
            return None
        moved_px = (design[..., :8] @ moves[:, :8, None])[..., 0] + gradients @ change
        lens, geometries = changed_lens, moved_geometries
        spreads += moves[:, 8]
        if float(np.abs(moved_px).max()) < CONVERGED_PX:
            left = rest - (design @ moves[..., None])[..., 0]
            parts = shown, left, influence, gradients, scores, covariance, weights
            fit = LensFit(lens, n_coefficients, geometries, *parts)
            return replace(fit, geometries=[replace(one, residual_px=fit.residual_px) for one in geometries])
    return None


def _usual(lens: Lens | None, n_coefficients: int) -> FloatArray:
    """Return the standard deviations of the first coefficients among lenses."""
    return np.array(USUAL[lens.model][:n_coefficients]) if lens is not None else np.zeros(0)


def first_fits(pieces: EdgePoints, measured: Sequence[MeasuredEdges], shape: tuple[int, ...]) -> list[LensFit]:
    """Return the fits of an ideal lens and of lenses of few coefficients, the best first.

    Another coefficient has to be of use.
    """
    rows, columns = shape[:2]
    fits = [solve(pieces, measured, None, 0)]
    tried: tuple[tuple[LensModel, int], ...] = (("polynomial", 1), ("polynomial", 2), ("fisheye", 1))
    for model, n_coefficients in tried:
        fits.append(solve(pieces, measured, Lens.ideal(model, (rows, columns)), n_coefficients))
    found = [fit for fit in fits if fit is not None]
    return sorted(found, key=lambda fit: fit.residual_px / USEFUL**fit.n_coefficients)


PlacesTriangles = Callable[[Geometry], FloatArray]
"""Function that places the triangles of a frame: (triangle, 3), x and y and √(area) in pixels."""


class LensChoice(NamedTuple):
    """The lens of a recording, and the error of the triangles that it places.

    `error_px` is the standard error of a triangle's place, `size_error` that of its √(area), relative.
    """

    fit: LensFit
    error_px: float
    size_error: float


def choose_lens(
    pieces: EdgePoints,
    measured: Sequence[MeasuredEdges],
    placed: Sequence[PlacesTriangles],
    shape: tuple[int, int],
) -> LensChoice | None:
    """Choose the model of a lens that fits the edges in frames best for its number of coefficients.

    `placed` has a function for each frame that places its triangles; `shape` are the rows and columns of a frame.
    None if no model fits at all. The error holds that of the choice, too: it is the mean over all models, with
    Akaike's weights, of a model's own variance and of its squared distance from the chosen one (Burnham & Anderson
    2002, section 4.3, about the chosen model in place of the mean one).
    """
    ideal = solve(pieces, measured, None, 0)
    fits = [] if ideal is None else [ideal]
    candidates = list(fits)
    for model, numbers in TRIED.items():
        ladder = _ladder(pieces, measured, Lens.ideal(model, shape), numbers)
        fits += ladder
        explains = ladder and (ideal is None or ladder[0].bayesian_criterion < ideal.bayesian_criterion)
        candidates += ladder if explains else ladder[:1]
    if not fits:
        return None
    chosen = min(candidates, key=lambda fit: fit.bayesian_criterion)
    some = subsample(list(enumerate(placed)), MOST_PLACED)
    places = np.array([np.concatenate([place(fit.geometries[k]) for k, place in some]) for fit in fits])
    variances = np.array([_variances(pieces, fit, some) for fit in fits])
    of_chosen = places[fits.index(chosen)]
    akaike = np.array([fit.akaike_criterion for fit in fits])
    shares = np.exp((akaike.min() - akaike) / 2.0)
    shares /= shares.sum()
    variance = np.einsum("k,kti->ti", shares, variances + (places - of_chosen) ** 2)
    error_px = math.sqrt(float(variance[:, :2].sum(axis=-1).mean()))
    size_error = math.sqrt(float((variance[:, 2] / of_chosen[:, 2] ** 2).mean()))
    return LensChoice(chosen, error_px, size_error)


def _ladder(
    pieces: EdgePoints, measured: Sequence[MeasuredEdges], lens: Lens, numbers: Sequence[int]
) -> list[LensFit]:
    """Return the fits of a model with more and more coefficients, each beginning with the one before."""
    fits: list[LensFit] = []
    for n_coefficients in numbers:
        if not fits:
            fit = solve(pieces, measured, lens, n_coefficients)
        else:
            before = fits[-1]
            starts = zip(measured, before.geometries, strict=True)
            started = [edges._replace(start=geometry) for edges, geometry in starts]
            fit, variance_px2 = None, before.edge_variance_px2
            for _ in range(5):
                again = solve(pieces, started, before.lens, n_coefficients, edge_variance_px2=variance_px2)
                fit = again or fit
                # A model of fewer coefficients may leave far larger residuals than the errors of edges.
                if again is None or again.edge_variance_px2 > 0.5 * variance_px2:
                    break
                variance_px2 = again.edge_variance_px2
        fits += [] if fit is None else [fit]
    return fits


def _variances(pieces: EdgePoints, fit: LensFit, placed: Sequence[tuple[int, PlacesTriangles]]) -> FloatArray:
    """Return the variances of the places of the triangles of all frames, (triangle, 3).

    What is left of an edge is alike in all frames if the camera stands still, so that it is an error of the edge
    and not of a frame: the residuals of a piece are summed over the frames before they are squared. The pieces of
    one edge share its black and white, so that noise moves them alike: their residuals are summed, too.
    A square is divided by the share of an edge's error that the fit leaves (HC2, MacKinnon & White 1985).
    """

    def by_edge(of_pieces: FloatArray) -> FloatArray:
        return np.asarray(of_pieces.reshape(*of_pieces.shape[:-1], -1, pieces.per_edge).sum(axis=-1))

    usual = _usual(fit.lens, fit.n_coefficients)
    variances_of_usual = (fit.weights * np.where(np.isinf(usual), 0.0, usual)) ** 2
    scores_of_pieces = fit.scores.sum(axis=0)
    left_in_coefficients = np.einsum("vni,vn->ni", fit.scores, fit.left_px) @ fit.covariance
    explained_by_lens = scores_of_pieces @ fit.covariance @ scores_of_pieces.T / len(fit.geometries)
    variances = []
    for k, place in placed:
        geometry, gradients = fit.geometries[k], fit.gradients[k]
        influence = fit.influence[k][:8]
        explained_by_homography = np.linalg.pinv(fit.influence[k]) @ fit.influence[k]
        by_homography = _derivative(place, partial(_with_homography, pieces, geometry), 8)
        # The homography follows each change of the lens.
        by_lens = -by_homography @ (influence @ gradients)
        if fit.lens is not None:
            by_lens += _derivative(place, partial(_with_changed_lens, geometry, fit.lens), fit.n_coefficients)
        left_in_places = np.einsum("tij,jn->tin", by_homography, influence * fit.left_px[k])
        left_in_places += np.einsum("tij,nj->tin", by_lens, left_in_coefficients)
        explained = by_edge(by_edge(explained_by_homography + explained_by_lens).T).diagonal() / pieces.per_edge
        # A fit that leaves less than 5 % of an edge's variance shows nothing of its error.
        of_edges = (by_edge(left_in_places) ** 2 / np.maximum(1.0 - explained, 0.05)).sum(axis=-1)
        # An error that an edge has in all frames is not seen in what is left if the lens can follow it.
        by_piece = by_homography @ influence + by_lens @ (fit.covariance @ scores_of_pieces.T)
        of_edges += LEAST_ERROR_PX**2 * (by_edge(by_piece) ** 2).sum(axis=-1)
        variances.append(of_edges + (by_lens @ fit.covariance) ** 2 @ variances_of_usual)
    return np.concatenate(variances)


def _with_homography(pieces: EdgePoints, geometry: Geometry, change: FloatArray) -> Geometry:
    return replace(geometry, homography=pieces.moved(geometry, change))


def _with_changed_lens(geometry: Geometry, lens: Lens, change: FloatArray) -> Geometry:
    return replace(geometry, lens=lens.changed(change))


def _derivative(place: PlacesTriangles, changed: Callable[[FloatArray], Geometry], n: int) -> FloatArray:
    """Return the derivative of the triangles' places by the n numbers of a change, (triangle, 3, n)."""
    steps = [place(changed(step)) - place(changed(-step)) for step in DIFFERENCE * np.eye(n)]
    return np.stack(steps, axis=-1) / (2.0 * DIFFERENCE)
