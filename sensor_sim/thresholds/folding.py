"""Folding of weights on the retina to weights on the detectors, by the adjoint of hold, blur, display and retina.

The chain is separable. Along an axis, sample & hold and post-sample blur give each display pixel a share of a
detector, and a retina sample sees the integral of the shares over its own width. If nothing blurs, the pixels of a
detector are alike and count as one.

Hogervorst et al. 2001, sections 3.4 to 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.reconstruction import axis_matrix
from todframes.base._typing import FloatArray
from todframes.observers.retina import RetinaGrid

DETECTORS_AT_ONCE = 4
"""Number of detectors of an axis that are folded at once: a few of them show on a part of the retina only."""


class Folding:
    """Weights on a retina, (answers, side, side), to be folded onto detectors for any place of the retina. The
    first `n` are folded, turns of the first where there are fewer, onto a square of `field` × `field` detectors,
    with the precision `dtype`. Retina samples that never see the field while the retina's middle is within
    `reach_detectors` of the field's, along each axis, are dropped. If nothing blurs the display, the pixels of a
    detector count as one. `key` becomes everything that the weights depend on besides their places, from that of
    the deviations.
    """

    def __init__(
        self,
        camera: Camera,
        grid: RetinaGrid,
        deviations: FloatArray,
        *,
        n: int = 4,
        field: int,
        reach_detectors: float,
        dtype: DTypeLike = np.float64,
        key: Hashable = None,
    ) -> None:
        self.n, self.field, self.dtype = n, field, np.dtype(dtype)
        self.key = (key, camera.weights_key, n, field, reach_detectors, self.dtype)
        pitch = camera.shown_pitch_mrad
        self._is_blurred = camera.blurs_px != (0.0, 0.0)
        self.pixels = camera.pixels_per_detector if self._is_blurred else 1
        self.pixel_pitch_mrad = pitch / self.pixels
        self._camera, self._deviations = camera, deviations
        seen = 2 * math.ceil((field / 2.0 + reach_detectors) * pitch / grid.pitch_mrad) + 1
        margin = max((grid.side - seen) // 2, 0)
        self._seen = slice(margin, grid.side - margin)
        self.grid = RetinaGrid(grid.side - 2 * margin, grid.pitch_mrad)

    @cached_property
    def _seen_deviations(self) -> list[NDArray[Any]]:
        """Deviations that are folded, on the samples that see the field."""
        seen = self._deviations[: self.n, self._seen, self._seen].astype(self.dtype, copy=False)
        turned = (np.ascontiguousarray(np.rot90(seen[0], -k)) for k in range(len(seen), self.n))
        return [*seen, *turned]

    @cached_property
    def _pixel_shares(self) -> tuple[FloatArray, FloatArray]:
        """Share of each detector in each pixel of an axis, (field, pixels), and its integral up to each pixel."""
        share = np.eye(self.field)
        if self._is_blurred:
            camera = self._camera
            share = axis_matrix(
                self.field, pixels_per_detector=camera.pixels_per_detector, blur_px=camera.blurs_px
            ).T
        return share, np.pad(np.cumsum(share, axis=1), ((0, 0), (1, 0)))

    def _on_axis(self, places: FloatArray) -> Iterator[tuple[slice, slice, NDArray[Any]]]:
        """Yield what retina samples see of some detectors of an axis: the detectors, the samples, and the shares.
        The shares are (detectors · places, samples). Elsewhere they are 0.
        """
        share, integral = self._pixel_shares
        n_pixels, width = share.shape[1], self.pixel_pitch_mrad / self.grid.pitch_mrad
        edges = self.grid.side / 2.0 - (self.field / 2.0 + places) * self.pixels * width
        for start in range(0, self.field, DETECTORS_AT_ONCE):
            some = slice(start, min(start + DETECTORS_AT_ONCE, self.field))
            (touched,) = np.nonzero(share[some].any(axis=0))
            first = max(math.floor(edges.min() + touched[0] * width), 0)
            stop = min(math.ceil(edges.max() + (touched[-1] + 1) * width), self.grid.side)
            if first >= stop:
                continue
            samples = slice(first, stop)
            # Boundaries of the samples, in pixels from the first.
            place = np.clip((np.arange(first, stop + 1.0) - edges[:, None]) / width, 0.0, n_pixels)
            pixel = np.minimum(place.astype(np.intp), n_pixels - 1)
            up_to = integral[some].take(pixel, axis=1) + (place - pixel) * share[some].take(pixel, axis=1)
            yield some, samples, (width * np.diff(up_to, axis=-1)).astype(self.dtype).reshape(-1, stop - first)

    def weights_by_row(self, places_x: FloatArray, places_y: FloatArray) -> NDArray[Any]:
        """Return the weights at all places on a lattice: (places_y, places_x, n, field²), in `dtype`. Places are
        those of the retina's middle, in detectors from the field's middle.
        """
        side, field, n_x, n_y = self.grid.side, self.field, len(places_x), len(places_y)
        on_columns = np.zeros((self.n, side, field, n_x), dtype=self.dtype)
        for some, seen, shares in self._on_axis(places_x):
            for k, deviations in enumerate(self._seen_deviations):
                on_columns[k, :, some] = (deviations[:, seen] @ shares.T).reshape(side, -1, n_x)
        on_columns = on_columns.reshape(self.n, side, -1)
        folded_rows = np.zeros((self.n, field, n_y, field, n_x), dtype=self.dtype)
        for some, seen, shares in self._on_axis(places_y):
            folded_rows[:, some] = (shares @ on_columns[:, seen]).reshape(self.n, -1, n_y, field, n_x)
        return folded_rows.transpose(2, 4, 0, 1, 3).reshape(n_y, n_x, self.n, field**2)

    def weights(self, places_x: FloatArray, places_y: FloatArray) -> FloatArray:
        """Return the weights at single places: (places, n, field²)."""
        number = np.arange(len(places_x))
        return self.weights_by_row(places_x, places_y)[number, number].astype(np.float64)
