"""Markers in a real photograph: found and placed as by OpenCV's own detector."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from todframes.importing.geometry import fit_geometry
from todframes.importing.lens_fit import first_fits
from todframes.importing.marker_finder import MarkerEdges, search_parameters

PHOTOGRAPH = Path(__file__).parents[1] / "recordings" / "markers" / "choriginal.jpg"
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
SQUARE_MM, SIDE_MM, MODULES = 40.0, 20.0, 8  # of the board; 6 × 6 bits have a border of one module


@pytest.fixture(scope="module")
def grey() -> NDArray[np.float32]:
    return cv2.imread(str(PHOTOGRAPH), cv2.IMREAD_GRAYSCALE).astype(np.float32)


def detected(grey: NDArray[np.float32], parameters: cv2.aruco.DetectorParameters) -> dict[int, NDArray]:
    quads, ids, _ = cv2.aruco.ArucoDetector(DICTIONARY, parameters).detectMarkers(grey.astype(np.uint8))
    return {int(one): quad[0].astype(float) for one, quad in zip(ids.ravel(), quads, strict=True)}


def refined(grey: NDArray[np.float32], method: int) -> NDArray:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = method
    found = detected(grey, parameters)
    return np.array([found[k] for k in sorted(found)])


def test_a_search_finds_all_markers_of_the_board(grey: NDArray[np.float32]) -> None:
    board = cv2.aruco.CharucoBoard((5, 7), SQUARE_MM, SIDE_MM, DICTIONARY)
    assert sorted(detected(grey, search_parameters())) == sorted(board.getIds().ravel().tolist())


def test_edges_place_markers_as_the_corners_that_opencv_refines(grey: NDArray[np.float32]) -> None:
    """OpenCV refines corners in two ways, which place markers 0.30 px apart: edges are about as near to both."""
    board = cv2.aruco.CharucoBoard((5, 7), SQUARE_MM, SIDE_MM, DICTIONARY)
    corners_mm = np.array(board.getObjPoints(), float)[..., :2]
    plain = refined(grey, cv2.aruco.CORNER_REFINE_NONE)
    contour, subpixel = (
        refined(grey, one).mean(axis=1)
        for one in (cv2.aruco.CORNER_REFINE_CONTOUR, cv2.aruco.CORNER_REFINE_SUBPIX)
    )
    edges = MarkerEdges(corners_mm, SIDE_MM / MODULES)
    found = edges.adjusted(grey, fit_geometry(corners_mm, plain), np.zeros(len(corners_mm), np.bool_))
    assert found is not None
    measured = found[1].measured(edges.pieces)
    fit = next(iter(first_fits(edges.pieces, [measured], grey.shape)), None)
    assert fit is not None and fit.residual_px < 0.3
    ours = fit.geometries[0].to_px(corners_mm).mean(axis=1)

    def apart(one: NDArray, other: NDArray) -> float:
        return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))

    assert apart(ours, contour) < apart(subpixel, contour)
    assert apart(ours, subpixel) < 1.5 * apart(subpixel, contour)
