"""The grey patches of a chart in a recording's frames, for its signal transfer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.charts.layout import Patch, read_chart
from todframes.charts.markers import page_of
from todframes.importing.geometry import Geometry
from todframes.importing.marker_finder import MarkerFinder
from todframes.recordings.noise3d import FramePatch, Region
from todframes.recordings.recording import Recording

INNER_SHARE = 0.7
"""Part of a patch's width and height that is measured; the camera may blur the rest."""


def find_patches(recording: Recording, chart: Path) -> list[FramePatch]:
    """Find the patches of a chart in the first frame of a recording that shows one of its pages all the time.

    Parameters
    ----------
    recording : Recording
    chart : path
        `chart.toml`, or its folder.

    Returns
    -------
    list of FramePatch
        Upright rectangles within the patches, with luminance in cd/m² or reflectance as their levels.

    Raises
    ------
    SettingsError
        If the chart cannot be read, or has no markers.
    DataError
        If no page of this chart is found, or it has no patches.
    """
    layout = read_chart(chart)
    if layout.markers is None:
        raise SettingsError(
            f"{chart}: a thermal chart has no markers; name its parts of the frame with {argument.patches}"
        )
    frame = next(recording.frames(), None)
    if frame is None:
        raise DataError(f"{recording.path}: found no frame, expected at least one")
    seen = MarkerFinder(layout.markers.all_centres_mm, layout.markers.side_mm).look(frame.values)
    found = None if seen is None else page_of(seen.ids)
    if seen is None or found is None:
        raise DataError(f"{recording.path}: {frame.source}: found no page of a chart, expected its four markers")
    page, key = found
    if key != layout.key or page >= len(layout.pages):
        raise DataError(
            f"{recording.path}: {frame.source}: found page {page} of the chart with the key {key}, expected "
            f"one of the {len(layout.pages)} pages of {chart} with the key {layout.key}"
        )
    patches = layout.pages[page].patches
    if not patches:
        raise DataError(f"{chart}: page {page} has no patches; name parts of the frame with {argument.patches}")
    return [FramePatch(_inner(patch, seen.geometry), _level(patch)) for patch in patches]


def _level(patch: Patch) -> float:
    level = patch.luminance_cd_m2 if patch.reflectance is None else patch.reflectance
    assert level is not None  # as its settings are checked
    return level


def _inner(patch: Patch, geometry: Geometry) -> Region:
    """Return the pixels of an upright rectangle whose corners lie in the inner part of a patch."""
    middle = np.array([patch.x_mm, patch.y_mm])
    half_mm = np.array([patch.width_mm, patch.height_mm]) / 2
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners_px = geometry.to_px(middle + signs * half_mm)
    middle_px: FloatArray = geometry.to_px(middle)
    half_px = np.abs(corners_px - middle_px).max(axis=0)
    # Where the corners of the rectangle that encloses the patch lie on it, in units of its own half sides.
    there = (signs * half_px) @ np.linalg.inv(geometry.jacobian(middle)).T / half_mm
    half_px *= INNER_SHARE / np.abs(there).max()
    left, top = np.ceil(middle_px - half_px).astype(int)
    right, bottom = np.floor(middle_px + half_px).astype(int)
    return int(left), int(top), int(right - left + 1), int(bottom - top + 1)
