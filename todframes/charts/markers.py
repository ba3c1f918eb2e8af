"""The markers of a chart's pages, in the corners and along the borders: their ids and their drawing.

The marker at corner k (see `CORNERS`) of a page has the id 4·digit + k, where 0 ≤ digit < 250. The digits are the
page's number modulo 250, the number divided by 250, again the number modulo 250, and the key of the chart. So each
marker states its corner, and a blend of two pages is noticed: it has markers of both. Markers along the borders
state their place alone, are the same on all pages, and come from another dictionary.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from todframes.base.reading import check_whole

CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")
"""Names of the corners in the order of the markers, clockwise."""

DICTIONARY = "5x5_1000"
"""Name of the markers' dictionary in chart.toml; OpenCV calls it DICT_5X5_1000."""

BORDER_DICTIONARY = "aruco_original"
"""Name of the dictionary of the markers along the borders; OpenCV calls it DICT_ARUCO_ORIGINAL."""

BORDER_IDS = (27, 72, 480, 533, 617, 638, 847, 955)
"""Ids of the markers along the borders, in their order in chart.toml. In any turn they differ in five modules or
more from all markers of `DICTIONARY`, as these do from each other, and in nine from one another."""

MODULES = 7
"""Side of a marker in modules, its black border of one module included."""

N_DIGITS = 250
"""Number of values of a digit: the dictionary has 1000 markers, and there are four corners."""

MOST_PAGES = N_DIGITS**2


def marker_ids(page: int, key: int) -> tuple[int, int, int, int]:
    """Return the ids of the markers of a page, 0 to 62,499, in the order of `CORNERS`; the chart's key is 0 to
    249.

    Raises SettingsError if the page or the key is out of its range.
    """
    for name, value, count in (("page", page, MOST_PAGES), ("key", key, N_DIGITS)):
        check_whole(name, value, 0, count - 1)
    low, high = page % N_DIGITS, page // N_DIGITS
    return 4 * low, 4 * high + 1, 4 * low + 2, 4 * key + 3


def page_of(ids: Sequence[int]) -> tuple[int, int] | None:
    """Return (page, key) for the ids of four markers in the order of `CORNERS`; None if no page has them."""
    if len(ids) != len(CORNERS) or any(not 0 <= id_ < 4 * N_DIGITS or id_ % 4 != k for k, id_ in enumerate(ids)):
        return None
    low, high, again, key = (id_ // 4 for id_ in ids)
    return (high * N_DIGITS + low, key) if low == again else None


def page_markers(page: int, key: int, *, n_borders: int) -> list[NDArray[np.bool_]]:
    """Return the modules of all markers of a page: those in the corners, then `n_borders` along the borders.

    Raises SettingsError if the page or the key is out of its range.
    """
    corners = [marker_bits(marker) for marker in marker_ids(page, key)]
    return corners + [marker_bits(marker, BORDER_DICTIONARY) for marker in BORDER_IDS[:n_borders]]


def marker_bits(marker: int, dictionary: str = DICTIONARY) -> NDArray[np.bool_]:
    """Return the modules of a marker, shape (7, 7), True where it is white; its border is black."""
    import cv2

    of_opencv = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary.upper()}"))
    return np.asarray(cv2.aruco.generateImageMarker(of_opencv, marker, MODULES)) > 0
