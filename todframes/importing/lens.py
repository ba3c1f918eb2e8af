"""Lenses that bend straight lines: OpenCV's polynomial model and its fisheye model, about the middle of a frame.

A single plane does not determine a camera's focal length, so ideal pixels are counted in half diagonals of the
frame in place of focal lengths. OpenCV takes the same coefficients with a camera matrix whose focal length is
half of the frame's diagonal, and whose principal point is the frame's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from todframes.base._typing import FloatArray

LensModel = Literal["polynomial", "fisheye"]
"""OpenCV's models: distortion by k1–k3, p1, p2, or a picture of the rays' angles with k1 and k2."""

PARAMETERS: dict[LensModel, tuple[str, ...]] = {
    "polynomial": ("k1", "k2", "x", "y", "k3", "p1", "p2"),
    "fisheye": ("half_angle_square", "x", "y", "k1", "k2"),
}
"""Names of a model's coefficients in their order. `x` and `y` are the principal point beside the frame's middle,
in half diagonals. `half_angle_square` is the square of the angle in rad that a fisheye lens without k1 and k2
shows at half the diagonal."""

STEP = 1e-5
"""Step of numerical derivatives, in half diagonals and in units of the coefficients."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens: the map from the pixels of an ideal picture to those of a frame.

    `middle_px` is the middle of the frame, x and y; the coefficients are in the order of `PARAMETERS`, all 0 for
    an ideal lens.
    """

    model: LensModel
    middle_px: tuple[float, float]
    half_diagonal_px: float
    coefficients: tuple[float, ...]

    @classmethod
    def ideal(cls, model: LensModel, shape: tuple[int, int]) -> Lens:
        """Return a lens that bends nothing, for frames of this number of rows and columns."""
        rows, columns = shape
        middle_px = (columns - 1) / 2.0, (rows - 1) / 2.0
        return cls(model, middle_px, math.hypot(rows, columns) / 2.0, (0.0,) * len(PARAMETERS[model]))

    def described(self, n_coefficients: int) -> dict[str, object]:
        """Return the model and its first coefficients by name, rounded, with the unit of length that they are
        in."""
        named = zip(PARAMETERS[self.model][:n_coefficients], self.coefficients, strict=False)
        return {
            "model": self.model,
            "half_diagonal_px": round(self.half_diagonal_px, 3),
            **{name: round(value, 6) for name, value in named},
        }

    def to_px(self, ideal_px: FloatArray) -> FloatArray:
        """Map pixels of the ideal picture, (…, 2), to pixels of the frame."""
        places = (ideal_px - self.middle_px) / self.half_diagonal_px
        bent = _polynomial if self.model == "polynomial" else _fisheye
        return np.asarray(bent(places, self.coefficients) * self.half_diagonal_px + self.middle_px)

    def jacobian(self, ideal_px: FloatArray) -> FloatArray:
        """Return the derivative of the map at pixels of the ideal picture, (n, 2): (n, 2, 2)."""
        step_px = STEP * self.half_diagonal_px * np.eye(2)
        steps = [self.to_px(ideal_px + one) - self.to_px(ideal_px - one) for one in step_px]
        return np.stack(steps, axis=-1) / (2.0 * STEP * self.half_diagonal_px)

    def gradient(self, ideal_px: FloatArray, n_coefficients: int) -> FloatArray:
        """Return the derivative of the map with respect to its first coefficients, (n, 2, coefficient)."""
        steps = []
        for k in range(n_coefficients):
            change = np.zeros(len(self.coefficients))
            change[k] = STEP
            steps.append(self.changed(change).to_px(ideal_px) - self.changed(-change).to_px(ideal_px))
        return np.stack(steps, axis=-1) / (2.0 * STEP)

    def changed(self, change: FloatArray) -> Lens:
        """Return the lens with changed coefficients."""
        padded = np.zeros(len(self.coefficients))
        padded[: len(change)] = change
        return replace(self, coefficients=tuple((np.array(self.coefficients) + padded).tolist()))

    def shows_once(self, ideal_px: FloatArray) -> bool:
        """Report whether the frame's radius grows with that of the ideal picture out to the farthest place."""
        farthest = float(np.linalg.norm(ideal_px - self.middle_px, axis=-1).max())
        radii = np.linspace(0.0, farthest, 33)
        places = self.middle_px + radii[:, None] * np.array([1.0, 0.0])
        grown = np.diff(self.to_px(places)[:, 0])
        return bool(np.isfinite(grown).all() and (grown > 0.0).all())


def _polynomial(places: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """OpenCV 4, calib3d, "Detailed Description": radial and tangential distortion."""
    k1, k2, beside_x, beside_y, k3, p1, p2 = coefficients
    x, y = places[..., 0] - beside_x, places[..., 1] - beside_y
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            beside_x + x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            beside_y + y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _fisheye(places: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """OpenCV 4, fisheye: θ (1 + k1 θ² + k2 θ⁴) in place of tan θ, in units of the scale in the middle."""
    half_angle_square, x, y, k1, k2 = coefficients
    beside = places - (x, y)
    square = (beside * beside).sum(axis=-1)
    # tan θ is the ideal radius in units of the focal length; atan(t) / t is continued smoothly to angles below 0.
    tangent = np.sqrt(np.abs(half_angle_square) * square)
    safe = np.maximum(tangent, 1e-6)
    if half_angle_square >= 0.0:
        ratio = np.where(tangent > 1e-4, np.arctan(safe) / safe, 1.0 - tangent**2 / 3.0)
    else:
        inside = np.minimum(safe, 1.0 - 1e-9)
        ratio = np.where(tangent > 1e-4, np.arctanh(inside) / inside, 1.0 + tangent**2 / 3.0)
    angle_square = half_angle_square * square * ratio**2
    ratio = ratio * (1.0 + angle_square * (k1 + angle_square * k2))
    return np.asarray((x, y) + beside * ratio[..., None])
