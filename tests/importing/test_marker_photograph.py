"""Markers in a real photograph: the search finds all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from todframes.importing.markers import search_parameters

PHOTOGRAPH = Path(__file__).parents[1] / "recordings" / "markers" / "choriginal.jpg"
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
SQUARE_MM, SIDE_MM = 40.0, 20.0  # of the board


@pytest.fixture(scope="module")
def grey() -> NDArray[np.float32]:
    return cv2.imread(str(PHOTOGRAPH), cv2.IMREAD_GRAYSCALE).astype(np.float32)


def detected(grey: NDArray[np.float32], parameters: cv2.aruco.DetectorParameters) -> dict[int, NDArray]:
    quads, ids, _ = cv2.aruco.ArucoDetector(DICTIONARY, parameters).detectMarkers(grey.astype(np.uint8))
    return {int(one): quad[0].astype(float) for one, quad in zip(ids.ravel(), quads, strict=True)}


def test_a_search_finds_all_markers_of_the_board(grey: NDArray[np.float32]) -> None:
    board = cv2.aruco.CharucoBoard((5, 7), SQUARE_MM, SIDE_MM, DICTIONARY)
    assert sorted(detected(grey, search_parameters())) == sorted(board.getIds().ravel().tolist())
