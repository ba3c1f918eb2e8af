"""The lens of a recording, solved from the edges of markers in several frames.

Each frame has a homography of its own, as the camera may shake and the chart be moved; the lens is one for all.
The homographies are eliminated frame by frame, so that a step of Gauss and Newton solves for the lens alone. Of
several models, the one with the least Bayesian information criterion counts. The error of the triangles holds the
distance from those of the other models as well, as far as these are likely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.importing.geometry import Geometry
from todframes.importing.lens import Lens, LensModel

MOST_STEPS, CONVERGED_PX = 15, 1e-3
"""Steps of Gauss and Newton, and the largest motion of an edge after which there is no further one."""

TRIED: tuple[tuple[LensModel, int], ...] = (("polynomial", 1), ("polynomial", 7), ("fisheye", 1), ("fisheye", 5))
"""Models and numbers of coefficients, the first ones of `PARAMETERS`; each begins with the result of the one
before. More are tried only if the first one explains something, as it does for any lens: where it does not, others
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


@dataclass(frozen=True, slots=True)
class LensFit:
    """A lens, and the geometries of the frames that it was solved from.

    `shown` states which edges each frame shows, (frame, n); all else is 0 for others. `influence` has the
    pseudo-inverse of each frame's design, (9, n); `left_px` what is left of the edges' distances, (frame, n).
    `gradients` are the derivatives of the edges by the coefficients, (frame, n, free), and `scores` those that the
    homographies do not explain; `covariance` is that of the coefficients for edges with an error of 1 px.
    """

    lens: Lens | None
    free: int
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
    def criterion(self) -> float:
        """Bayesian information criterion; a coefficient counts as far as the edges determine it."""
        n_pieces = int(self.shown.any(axis=0).sum())
        n_determined = self.free - float(np.diagonal(self.covariance) @ self.weights)
        return float(n_pieces) * math.log(self.mean_square_px2) + n_determined * math.log(n_pieces)

    @property
    def residual_px(self) -> float:
        """Root mean square distance of the edges from where the fit has them, per degree of freedom."""
        n_free = int(self.shown.sum()) - 9 * len(self.left_px) - self.free
        return math.sqrt(float((self.left_px**2).sum()) / max(n_free, 1))


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # all results are checked to be finite
def solve(
    pieces: EdgePoints,
    measured: Sequence[MeasuredEdges],
    lens: Lens | None,
    free: int,
    *,
    edge_variance_px2: float = 0.0,
) -> LensFit | None:
    """Solve the homographies of frames, and the first `free` coefficients of their lens, by least squares.

    `lens` is the first estimate; None for an ideal one, which stays so. `edge_variance_px2` is the variance of an
    edge, for which coefficients are weighed against the usual ones; 0: edges alone count. None if the edges do not
    determine the coefficients, or the lens would show a place twice.
    """
    geometries = [one.start.with_lens(lens, pieces.places_mm) for one in measured]
    normals = np.array([one.normals for one in measured])
    shown = np.array([np.isfinite(one.places_px).all(axis=1) for one in measured])
    points = np.where(shown[..., None], [one.places_px for one in measured], 0.0)
    spreads = np.zeros(len(measured))
    usual = np.array(USUAL[lens.model][:free]) if lens is not None else np.zeros(0)
    weights = edge_variance_px2 / usual**2
    for _ in range(MOST_STEPS):
        at = np.array([one.to_px(pieces.places_mm) for one in geometries])
        wanted = (((points - at) * normals).sum(axis=2) - spreads[:, None]) * shown
        design = np.array([pieces.design(one, n) for one, n in zip(geometries, normals, strict=True)])
        design *= shown[..., None]
        gradients = np.zeros((*wanted.shape, free))
        if lens is not None and free:
            ideal = np.array([one.ideal_px(pieces.places_mm) for one in geometries])
            gradients = np.einsum("vni,vnij->vnj", normals, lens.gradient(ideal, free)) * shown[..., None]
        if not all(np.isfinite(one).all() for one in (wanted, design, gradients)):
            return None
        influence = np.linalg.pinv(design)
        scores = gradients - design @ (influence @ gradients)
        normal = np.einsum("vni,vnj->ij", scores, scores) + np.diag(weights)
        scale = np.sqrt(np.diagonal(normal))
        # With a larger condition number the edges do not determine the coefficients.
        if free and (not (scale > 0.0).all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12):
            return None
        covariance = np.linalg.inv(normal)
        known = weights * np.array(lens.coefficients[:free]) if lens is not None else weights
        change = covariance @ (np.einsum("vni,vn->i", scores, wanted) - known)
        # A step that is too long for a strong lens would fold its picture: it is halved until it does not.
        for _ in range(6):
            rest = wanted - gradients @ change
            moves = (influence @ rest[..., None])[..., 0]
            after = lens.changed(change) if lens is not None else None
            moved_geometries = [
                replace(one, homography=pieces.moved(one, move), lens=after)
                for one, move in zip(geometries, moves, strict=True)
            ]
            if not all(np.isfinite(one.homography).all() for one in moved_geometries):
                return None
            if after is None or all(after.shows_once(one.ideal_px(pieces.places_mm)) for one in moved_geometries):
                break
            change = change / 2.0
        else:
            return None
        moved = (design[..., :8] @ moves[:, :8, None])[..., 0] + gradients @ change
        lens, geometries = after, moved_geometries
        spreads += moves[:, 8]
        if float(np.abs(moved).max()) < CONVERGED_PX:
            left = rest - (design @ moves[..., None])[..., 0]
            fit = LensFit(lens, free, geometries, shown, left, influence, gradients, scores, covariance, weights)
            return replace(fit, geometries=[replace(one, residual_px=fit.residual_px) for one in geometries])
    return None


def first_fits(pieces: EdgePoints, measured: Sequence[MeasuredEdges], shape: tuple[int, ...]) -> list[LensFit]:
    """Return the fits of an ideal lens and of lenses of few coefficients, the best first.

    Another coefficient has to be of use.
    """
    rows, columns = shape[:2]
    fits = [solve(pieces, measured, None, 0)]
    tried: tuple[tuple[LensModel, int], ...] = (("polynomial", 1), ("polynomial", 2), ("fisheye", 1))
    for model, free in tried:
        fits.append(solve(pieces, measured, Lens.ideal(model, (rows, columns)), free))
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: fit.residual_px / USEFUL**fit.free)


Places = Callable[[Geometry], FloatArray]
"""Function that places the triangles of a frame: (triangle, 3), x and y and √(area) in pixels."""


class LensChoice(NamedTuple):
    """The lens of a recording, and the error of the triangles that it places.

    `error_px` is the standard error of a triangle's place, `size_error` that of its √(area), relative.
    """

    fit: LensFit
    error_px: float
    size_error: float


def choose_lens(
    pieces: EdgePoints, measured: Sequence[MeasuredEdges], placed: Sequence[Places], shape: tuple[int, int]
) -> LensChoice | None:
    """Choose the model of a lens that fits the edges in frames best for its number of coefficients.

    `placed` has a function for each frame that places its triangles; `shape` are the rows and columns of a frame.
    None if no model fits at all.
    """
    ladders: dict[str, list[LensFit]] = {"polynomial": [], "fisheye": []}
    ideal = solve(pieces, measured, None, 0)
    for model, free in TRIED:
        before = ladders[model][-1] if ladders[model] else None
        if before is not None and ideal is not None and before.criterion >= ideal.criterion:
            continue
        start = Lens.ideal(model, shape) if before is None or before.lens is None else before.lens
        starts = (
            measured
            if before is None
            else [one._replace(start=geometry) for one, geometry in zip(measured, before.geometries, strict=True)]
        )
        fit = None
        variance_px2 = before.edge_variance_px2 if before is not None else 0.0
        for _ in range(5):
            again = solve(pieces, starts, start, free, edge_variance_px2=variance_px2)
            if again is None:
                break
            fit = again
            # A model of fewer coefficients may leave far larger residuals than the errors of edges.
            if before is None or fit.edge_variance_px2 > 0.5 * variance_px2:
                break
            variance_px2 = fit.edge_variance_px2
        if fit is not None:
            ladders[model].append(fit)
    fits = [*([] if ideal is None else [ideal]), *ladders["polynomial"], *ladders["fisheye"]]
    if not fits:
        return None
    some = [(k, placed[k]) for k in np.unique(np.linspace(0, len(measured) - 1, 4).round().astype(int))]
    places = np.array([np.concatenate([place(one.geometries[k]) for k, place in some]) for one in fits])
    variances = np.array([_variance(pieces, one, some) for one in fits])
    # Bayesian information criterion: among models that are as likely before, this is -2 ln of the probability.
    criteria = np.array([one.criterion for one in fits])
    best = int(criteria.argmin())
    likely = np.exp((criteria[best] - criteria) / 2.0)
    likely /= likely.sum()
    apart = (places - places[best]) ** 2
    variance = np.einsum("k,kti->ti", likely, variances + apart)
    error_px = math.sqrt(float(variance[..., :2].sum(axis=-1).mean()))
    size_error = math.sqrt(float((variance[..., 2] / places[best][..., 2] ** 2).mean()))
    return LensChoice(fits[best], error_px, size_error)


def _variance(pieces: EdgePoints, fit: LensFit, placed: Sequence[tuple[int, Places]]) -> FloatArray:
    """Return the variances of the places of the triangles of all frames, (triangle, 3).

    What is left of an edge is alike in all frames if the camera stands still, so that it is an error of the edge
    and not of a frame: the residuals of a piece are summed over the frames before they are squared. The pieces of
    one edge share its black and white, so that noise moves them alike: their residuals are summed, too.
    A square is divided by the share of an edge's error that the fit leaves (HC2, MacKinnon & White 1985).
    """

    def by_edge(of_pieces: FloatArray) -> FloatArray:
        return np.asarray(of_pieces.reshape(*of_pieces.shape[:-1], -1, pieces.per_edge).sum(axis=-1))

    usual = np.array(USUAL[fit.lens.model][: fit.free]) if fit.lens is not None else np.zeros(0)
    of_knowledge = (fit.weights * np.where(np.isinf(usual), 0.0, usual)) ** 2
    of_lens = np.einsum("vni,vn->ni", fit.scores, fit.left_px) @ fit.covariance
    of_pieces = fit.scores.sum(axis=0).T
    variances = []
    for k, place in placed:
        geometry, influence, left = fit.geometries[k], fit.influence[k][:8], fit.left_px[k]
        views = [
            [replace(geometry, homography=pieces.moved(geometry, sign * one)) for one in DIFFERENCE * np.eye(8)]
            for sign in (1.0, -1.0)
        ]
        by_view = _derivative(place, *views)
        net = -by_view @ (influence @ fit.gradients[k])
        if fit.lens is not None:
            lenses = [
                [replace(geometry, lens=fit.lens.changed(sign * one)) for one in DIFFERENCE * np.eye(fit.free)]
                for sign in (1.0, -1.0)
            ]
            net += _derivative(place, *lenses)
        own = np.einsum("tij,jn->tin", by_view, influence * left)
        shared = np.einsum("tij,nj->tin", net, of_lens)
        hat = np.linalg.pinv(fit.influence[k]) @ fit.influence[k]
        hat += of_pieces.T @ fit.covariance @ of_pieces / len(fit.geometries)
        explained = np.diagonal(by_edge(by_edge(hat).T)) / pieces.per_edge
        # A fit that leaves less than 5 % of an edge's variance shows nothing of its error.
        of_edges = (by_edge(own + shared) ** 2 / np.maximum(1.0 - explained, 0.05)).sum(axis=-1)
        # An error that an edge has in all frames is not seen in what is left if the lens can follow it.
        by_piece = np.einsum("tij,jn->tin", by_view, influence) + net @ (fit.covariance @ of_pieces)
        of_edges += LEAST_ERROR_PX**2 * (by_edge(by_piece) ** 2).sum(axis=-1)
        variances.append(of_edges + (net @ fit.covariance) ** 2 @ of_knowledge)
    return np.concatenate(variances)


def _derivative(place: Places, more: Sequence[Geometry], less: Sequence[Geometry]) -> FloatArray:
    steps = [place(one) - place(other) for one, other in zip(more, less, strict=True)]
    return np.stack(steps, axis=-1) / (2.0 * DIFFERENCE)
