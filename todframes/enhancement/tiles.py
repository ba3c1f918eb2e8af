"""Images in tiles: a function of pictures of one size is applied to a larger image, without seams.

Tiles overlap. In an overlap, the outer quarter of each tile is left out, because a function of neighbourhoods has
the tile's border in view there; between the two quarters one tile fades into the next. So the result is that of
the whole image for a function whose pixels depend on no more than a quarter of the overlap around them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

LEFT_OUT = 0.25
"""Share of the overlap that is left out at the border of a tile."""


def in_tiles(
    function: Callable[[Picture], Picture],
    image: Picture,
    *,
    tile: tuple[int, int],
    overlap_px: int,
    scale: int = 1,
    border_px: int = 0,
) -> Picture:
    """Apply a function to an image, (rows, columns, channels) and at least as large as a tile, in tiles of one
    size.

    The function takes a picture of shape (*tile, channels) and returns one without its border, of shape (scale ·
    (tile − 2 · border_px), channels): `border_px` at each side get no output, and an input pixel gives `scale`
    output pixels along each axis. `overlap_px`, >= 0 and smaller than such a tile, is the smallest overlap of
    neighbouring tiles without their borders. The result has scale · (rows − 2 · border_px) rows, and columns
    likewise.
    """
    lengths = [length - 2 * border_px for length in image.shape[:2]]
    inner = [side - 2 * border_px for side in tile]
    axes = [list(_spans(length, side, overlap_px, scale)) for length, side in zip(lengths, inner, strict=True)]
    totals = [np.zeros(scale * length) for length in lengths]
    for spans, total in zip(axes, totals, strict=True):
        for start, weights in spans:
            total[scale * start : scale * start + len(weights)] += weights
    result: Picture | None = None
    for row, of_rows in axes[0]:
        for column, of_columns in axes[1]:
            found = function(np.ascontiguousarray(image[row : row + tile[0], column : column + tile[1]]))
            if result is None:
                result = np.zeros((*(len(total) for total in totals), found.shape[2]), np.float32)
            y, x = (slice(scale * at, scale * (at + side)) for at, side in zip((row, column), inner, strict=True))
            weights = np.outer(of_rows / totals[0][y], of_columns / totals[1][x])
            result[y, x] += found * weights[..., None].astype(np.float32)
    assert result is not None  # there is one tile at least
    return result


def _spans(length: int, side: int, overlap_px: int, scale: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the first pixel of each tile along an axis, and the weights of its output pixels."""
    step = side - overlap_px
    n_tiles = max(1, -(-(length - overlap_px) // step))
    at = (np.arange(scale * side) + 0.5) / scale
    for number in range(n_tiles):
        start = min(number * step, length - side)
        weights = np.ones(len(at))
        if number > 0:
            weights = np.minimum(weights, _fade(at, overlap_px))
        if number < n_tiles - 1:
            weights = np.minimum(weights, _fade(side - at, overlap_px))
        yield start, weights


def _fade(depth_px: NDArray[np.float64], overlap_px: int) -> NDArray[np.float64]:
    """Return weights from 0 to 1 over the middle of an overlap, by the distance from the tile's border."""
    out = LEFT_OUT * overlap_px
    return np.asarray(np.clip((depth_px - out) / max(overlap_px - 2 * out, 1e-9), 0.0, 1.0))
