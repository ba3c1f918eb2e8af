"""Folding of weights on the retina to weights on the detectors, by the adjoint of hold, blur, display and retina.

The chain is separable. A place of the retina on the display is one sparse overlap matrix for each axis; the
adjoint of sample & hold and post-sample blur follows. If nothing blurs, the pixels of a detector are alike and
count as one.

Hogervorst et al. 2001, sections 3.4 to 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sensor_sim.chain.reconstruction import axis_matrix
from sensor_sim.chain.sensor import Sensor
from todframes.base._typing import FloatArray
from todframes.observers.retina import RetinaGrid, overlaps

FOLDED_AT_ONCE = 6
"""Largest number of places along an axis that are folded at once: enough to hide the cost of a call."""

VALUES_AT_ONCE = 2**20
"""Largest number of values on display pixels that are held for several places; a place alone may have more."""


def is_unblurred(sensor: Sensor) -> bool:
    """Return whether nothing blurs what the display shows, so that the pixels of a detector are alike."""
    return sensor.electronics.blur_sigma_px == 0.0 and sensor.display.blur_sigma_px == 0.0


class Folding:
    """Images of weights on a retina, to be folded onto detectors for any place of the retina.

    Parameters
    ----------
    sensor : Sensor
    grid : RetinaGrid
    images : ndarray, shape (4, side, side)
        Weights of each answer; their mean over the answers affects no decision and is subtracted.
    n : int
        Number of images that are folded.
    field : int
        Detectors along each side of the square field.
    reach_detectors : float
        Largest distance of the retina's middle from the field's middle along each axis. Retina samples that never
        see the field within that distance are dropped.
    dtype : float32 or float64
        Precision of the folding and of `weights_by_row`; `weights` are float64 in any case.
    merge_pixels : bool
        Whether pixels that must be alike count as one.
    key : hashable, optional
        Everything that the weights depend on besides their places.
    """

    def __init__(
        self,
        sensor: Sensor,
        grid: RetinaGrid,
        images: FloatArray,
        *,
        n: int = 4,
        field: int,
        reach_detectors: float,
        dtype: DTypeLike = np.float64,
        merge_pixels: bool = True,
        key: Hashable = None,
    ) -> None:
        self.n, self.field, self.dtype, self.key = n, field, np.dtype(dtype), key
        pitch = sensor.display.detector_pitch_mrad
        self.pixels = 1 if merge_pixels and is_unblurred(sensor) else sensor.display.pixels_per_detector
        self.pixel_pitch_mrad = pitch / self.pixels
        self._sensor, self._images = sensor, images
        seen = 2 * math.ceil((field / 2.0 + reach_detectors) * pitch / grid.pitch_mrad) + 1
        margin = max((grid.side - seen) // 2, 0)
        self._seen = slice(margin, grid.side - margin)
        self.grid = RetinaGrid(grid.side - 2 * margin, grid.pitch_mrad)

    @cached_property
    def hold(self) -> FloatArray | None:
        """Adjoint of sample & hold and blur along one axis; None where pixels that are alike count as one."""
        if self.pixels == 1 and is_unblurred(self._sensor):
            return None
        hold = axis_matrix(self.field, display=self._sensor.display, electronics=self._sensor.electronics)
        return hold.T.astype(self.dtype)

    @cached_property
    def _along_x_first(self) -> NDArray[Any]:
        images = self._images[:, self._seen, self._seen]
        mean = images.mean(axis=0)
        by_column = np.empty((self.grid.side, self.n, self.grid.side), dtype=self.dtype)
        for k, image in enumerate(images[: self.n]):
            np.subtract(image.T, mean.T, out=by_column[:, k], casting="same_kind")
        return by_column.reshape(self.grid.side, self.n * self.grid.side)

    def weights_by_row(self, places_x: FloatArray, places_y: FloatArray) -> list[NDArray[Any]]:
        """Return for each place along y the weights at all places along x: (places_x, n, field²), in `dtype`.

        Places are those of the retina's middle, in detectors from the field's middle.
        """
        side, field, places = self.grid.side, self.field, len(places_x)
        on_columns = np.empty((side, places, self.n, field), dtype=self.dtype)
        for start, folded in self._folded(places_x, self._along_x_first):
            at_once = slice(start, start + len(folded))
            on_columns[:, at_once] = folded.reshape(-1, field, self.n, side).transpose(3, 0, 2, 1)
        rows = []
        for _, folded in self._folded(places_y, on_columns.reshape(side, places * self.n * field)):
            of_rows = folded.reshape(-1, field, places, self.n, field).transpose(0, 2, 3, 1, 4)
            rows += list(of_rows.reshape(-1, places, self.n, field**2))
        return rows

    def weights(self, place_x: float, place_y: float) -> FloatArray:
        """Return the weights at one place: (n, field²)."""
        (row,) = self.weights_by_row(np.array([place_x]), np.array([place_y]))
        return np.asarray(row[0], dtype=np.float64)

    def _folded(self, places: FloatArray, weights: NDArray[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
        """Fold weights on retina samples along the first axis, (side, n), to detectors, some places at once.

        Yields the number of the first place, and (places, field, n).
        """
        n_pixels, width = self.field * self.pixels, self.pixel_pitch_mrad / self.grid.pitch_mrad
        n_at_once = min(max(VALUES_AT_ONCE // (n_pixels * weights.shape[1]), 1), FOLDED_AT_ONCE)
        for start in range(0, len(places), n_at_once):
            at_once = places[start : start + n_at_once]
            edges = self.grid.side / 2.0 - (self.field / 2.0 + at_once) * self.pixels * width
            retina = overlaps(edges, width, n_pixels, self.grid.side).matrix(self.grid.side, self.dtype)
            on_pixels: NDArray[Any] = np.asarray(retina @ weights).reshape(len(at_once), n_pixels, -1)
            yield start, on_pixels if self.hold is None else np.asarray(self.hold @ on_pixels)
