"""Four noisy scores as a tetrahedron: its edges are the standard deviations of their differences.

The noise is given as a covariance or, with all digits of templates that are nearly alike, as a factor of it: rows
whose inner products the covariance is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.errors import SettingsError

_Floats = NDArray[np.float64]

_ANSWERS = np.arange(4)[:, None]
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
PAIRS = ((0, 1), (0, 2), (1, 2))
"""Among three others; pair i, j has index i + j − 1, and the one left out is 2 minus that."""
_FIRST = OTHERS[:, [pair[0] for pair in PAIRS]]
_SECOND = OTHERS[:, [pair[1] for pair in PAIRS]]

_ROUNDING = 1e-10


def of_factor(factor: _Floats) -> tuple[_Floats, _Floats]:
    """Edges and angles of checked factors, shape (matrix, 4, n), as `of_covariance` gives them.

    The angle is Kahan's between two vectors, which keeps its digits however small or flat it is.
    """
    difference = factor[:, :, None, :] - factor[:, OTHERS, :]
    largest = np.abs(difference).max(axis=-1, keepdims=True, initial=0.0)
    unit = np.divide(
        difference, largest, out=np.zeros_like(difference), where=largest > 0
    )  # squares may underflow
    length = np.sqrt(np.square(unit).sum(axis=-1, keepdims=True))
    unit = np.divide(unit, length, out=unit, where=length > 0)
    a, b = (unit[:, :, [pair[side] for pair in PAIRS]] for side in (0, 1))
    apart, together = (np.sqrt(np.square(c).sum(axis=-1)) for c in (a - b, a + b))
    angle = np.where((apart == 0) & (together == 0), np.pi / 2, 2 * np.arctan2(apart, together))
    return (largest * length)[..., 0], angle


def of_covariance(covariance: _Floats, *, extended: bool = True) -> tuple[_Floats, _Floats]:
    """Edges from each score to the three others, and the angles between these, of checked covariances.

    Parameters
    ----------
    covariance : ndarray, shape (matrix, 4, 4)
    extended : bool
        Precision, for matrices that are nearly singular.

    Returns
    -------
    edge, angle : ndarray, shape (matrix, 4, 3)
        In the order of `OTHERS`, and of `PAIRS` of them.

    Notes
    -----
    The angle is Kahan's, from the three edges of a face, so that slender faces keep their digits. A rounding
    of 1e-16 in the covariance can turn it by 1e-8: hence extended precision (where the platform has it), and a
    face whose area is lost in that rounding, though its edges are not, is taken as flat.
    """
    exact: NDArray[Any] = covariance.astype(np.longdouble) if extended else covariance
    variance = np.diagonal(exact, axis1=-2, axis2=-1)
    square = (variance[:, :, None] - exact) + (variance[:, None, :] - exact)
    square = np.maximum(square, 0)
    edge = np.sqrt(square)
    a, b, c2 = edge[:, _ANSWERS, _FIRST], edge[:, _ANSWERS, _SECOND], square[:, _FIRST, _SECOND]
    a2, b2 = square[:, _ANSWERS, _FIRST], square[:, _ANSWERS, _SECOND]
    beyond_closed = np.maximum(c2 - (a - b) ** 2, 0)
    beyond_open = np.maximum((a + b) ** 2 - c2, 0)
    slender = 2 * np.arctan2(np.sqrt(beyond_closed), np.sqrt(beyond_open))
    common = (variance[:, :, None] - exact[:, _ANSWERS, _FIRST]) + (
        exact[:, _FIRST, _SECOND] - exact[:, _ANSWERS, _SECOND]
    )
    cosine = np.divide(common, a * b, out=np.ones_like(a), where=(a > 0) & (b > 0))
    angle = np.where(np.abs(cosine) < 0.7, np.arccos(np.clip(cosine, -1, 1)), slender)

    rounding = np.finfo(np.float64).eps * (variance[:, :, None] + variance[:, None, :])
    rounding_a, rounding_b = rounding[:, _ANSWERS, _FIRST], rounding[:, _ANSWERS, _SECOND]
    rounding_c = rounding[:, _FIRST, _SECOND]
    area_rounding = 2 * (  # of 16 area², to first order in the squared edges
        np.abs(b2 + c2 - a2) * rounding_a + np.abs(a2 + c2 - b2) * rounding_b + np.abs(a2 + b2 - c2) * rounding_c
    )
    edges_known = (a2 > 64 * rounding_a) & (b2 > 64 * rounding_b) & (c2 > 64 * rounding_c)
    flat = edges_known & (beyond_closed * beyond_open <= area_rounding)
    angle = np.where(flat, np.where(c2 > a2 + b2, np.pi, 0), angle)
    angle = np.where((a == 0) | (b == 0), np.pi / 2, angle)
    return edge[:, _ANSWERS, OTHERS].astype(np.float64), angle.astype(np.float64)


def checked_covariance(covariance: ArrayLike) -> _Floats:
    """A covariance of four scores, (..., 4, 4).

    Raises
    ------
    SettingsError
        For a wrong shape, a value that is not finite or a matrix that is not a covariance.
    """
    covariances = np.asarray(covariance, dtype=np.float64)
    if covariances.ndim < 2 or covariances.shape[-2:] != (4, 4):
        raise SettingsError(f"covariance has shape {covariances.shape}, expected (..., 4, 4)")
    reject(~np.isfinite(covariances), covariances, "covariance", "finite numbers")
    asymmetry = np.abs(covariances - covariances.swapaxes(-2, -1)).max(axis=(-2, -1))
    largest = np.abs(covariances).max(axis=(-2, -1))
    reject(asymmetry > _ROUNDING * largest, asymmetry, "asymmetry of covariance", "a symmetric matrix")
    covariances = (covariances + covariances.swapaxes(-2, -1)) / 2
    eigenvalues = np.linalg.eigvalsh(covariances)
    negative = eigenvalues[..., 0] < -_ROUNDING * np.abs(eigenvalues).max(axis=-1)
    reject(negative, eigenvalues[..., 0], "smallest eigenvalue of covariance", "a positive semi-definite matrix")
    return covariances


def checked_factor(factor: ArrayLike) -> _Floats:
    """A factor of such a covariance, (..., 4, n).

    Raises
    ------
    SettingsError
        For a wrong shape or a value that is not finite.
    """
    rows = np.asarray(factor, dtype=np.float64)
    if rows.ndim < 2 or rows.shape[-2] != 4:
        raise SettingsError(f"factor has shape {rows.shape}, expected (..., 4, n)")
    reject(~np.isfinite(rows), rows, "factor", "finite numbers")
    return rows


def reject(bad: NDArray[np.bool_], found: NDArray[Any], name: str, expected: str) -> None:
    """Raise SettingsError for the first of some values that is bad."""
    if bad.any():
        place = tuple(int(index) for index in np.argwhere(bad)[0])
        where = f"[{', '.join(map(str, place))}]" if place else ""
        raise SettingsError(f"{name}{where} is {found[place]:g}, expected {expected}")
