"""The parts of a chart in a recording by which its camera is measured: grey patches, and slanted edges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.camera.noise3d import FramePatch, only_frames
from todframes.camera.slanted_edges import PlacedEdge, box_about, points_between
from todframes.charts.layout import Chart, Edge, Page, Patch, page_of, read_chart
from todframes.importing.chart_source import MOST_SOLVED
from todframes.importing.geometry import Geometry, choose_lens
from todframes.importing.markers import MarkerFinder
from todframes.importing.trials import ClipFrame, clean_clips
from todframes.parameters import Box, Progress, counted
from todframes.recordings.recording import RecordedFrame, Recording, RecordingWarning
from todframes.results.wording import subsample

ENOUGH_FRAMES = 10
"""Number of frames of the camera's page in one clip after which a film is not searched for a longer one."""

MOST_STEP_PX = 0.6
"""Largest pixel of a monitor in pixels of the frame: its own MTF is then 0.86 at the Nyquist frequency, and 0.5 at
twice that."""


class CameraView(NamedTuple):
    """A page of a chart in a recording, by which the camera is measured: the frames that show it, at rest.

    Patches are upright rectangles within those of the page, with luminance in cd/m² or reflectance as their
    levels. A page of triangles has no slanted edges. `pitch_mrad` is the angle of a pixel in the middle of the
    page, at the distance that the chart is made for.
    """

    recording: Recording
    patches: list[FramePatch]
    edges: list[PlacedEdge]
    is_luminance: bool
    pitch_mrad: float

    def stacks(self, dark: Recording) -> tuple[list[Recording], list[Recording]]:
        """Return the frames of each patch, all of one size, in memory; and those of a dark film at the first one.

        DataError if the dark film has frames of another size.
        """
        if dark.shape != self.recording.shape:
            (rows, columns), (of_film, across) = dark.shape, self.recording.shape
            raise DataError(
                f"{dark.path}: has {columns} x {rows} pixels, expected {across} x {of_film} as the film"
            )
        regions = np.array([patch.region for patch in self.patches])
        width, height = regions[:, 2:].min(axis=0).tolist()
        starts = (regions[:, :2] + (regions[:, 2:] - (width, height)) // 2).tolist()
        films = _cut(self.recording, [(left, top, width, height) for left, top in starts])
        path = self.recording.path
        named = [replace(film, path=Path(f"{path}: patch {number}")) for number, film in enumerate(films, 1)]
        return named, _cut(dark, [(*starts[0], width, height)])


def view_of_camera_page(
    recording: Recording, chart: Path, *, needs_edges: bool = False, progress: Progress | None = None
) -> CameraView:
    """Find the patches and slanted edges of a chart's page for the camera, in the first clip of some length.

    Of a printed chart, or one without that page, it may be another page with patches. SettingsError if the chart
    has no markers or no such page; DataError if the recording does not show it, or the camera moves.
    """
    layout = read_chart(chart)
    if layout.markers is None:
        option = argument.boxes if needs_edges else argument.patches
        raise SettingsError(f"{chart}: a thermal chart has no markers; name its parts of the frame with {option}")
    if needs_edges and not layout.has_camera_page:
        raise SettingsError(
            f"{chart}: has no page with slanted edges, expected a chart made with {argument.camera_page}; or name "
            f"edges with {argument.boxes}"
        )
    path, shape = recording.path, recording.shape
    finder = MarkerFinder(layout.markers.all_centres_mm, layout.markers.side_mm)
    takes_patches = not needs_edges and not (layout.has_camera_page and layout.kind == "screen")
    page, numbers, corners = _longest_clip(recording, layout, finder, chart, takes_patches, progress)
    moved_px = _moved_px(corners)
    still = [k for k, moved in enumerate(moved_px) if moved <= 0.2]
    moves = f"the chart moves in {len(numbers) - len(still)} of the {len(numbers)} frames that show its page"
    if len(still) < max(2, len(numbers) // 4) and len(numbers) > 1:
        raise DataError(f"{path}: {moves}, by up to {max(moved_px):.2g} px, expected camera and chart at rest")
    some = subsample(still, MOST_SOLVED)
    choice = choose_lens(
        finder.corners_mm,
        [corners[k] for k in some],
        [lambda geometry: _places(page, geometry) for _ in some],
        shape,
    )
    if choice is None:
        raise DataError(f"{path}: found the markers of the page, but they fit no flat chart")
    geometry = choice.geometries[len(some) // 2]
    step_mm = None if layout.screen is None else layout.screen.pixel_pitch_mm
    px_per_mm = geometry.scale_px_per_mm((layout.page_width_mm / 2, layout.page_height_mm / 2))
    warnings = []
    if len(still) < len(numbers):
        warnings.append(RecordingWarning("moved", f"{path}: {moves}; they were left out"))
    return CameraView(
        recording=only_frames(recording, [numbers[k] for k in still], *warnings),
        # Each patch has a luminance or a reflectance, as its settings are checked.
        patches=[
            FramePatch(_inner(patch, geometry), patch.luminance_cd_m2 or patch.reflectance or 0.0)
            for patch in page.patches
        ],
        edges=_edges(page.edges, geometry, step_mm, shape, path) if page.edges else [],
        is_luminance=layout.screen is not None,
        pitch_mrad=1.0 / (px_per_mm * layout.distance_m),
    )


def _longest_clip(
    recording: Recording,
    chart: Chart,
    finder: MarkerFinder,
    chart_path: Path,
    takes_patches: bool,
    progress: Progress | None,
) -> tuple[Page, list[int], list[FloatArray]]:
    """Return the page of the longest clip of a page with edges, its frames' numbers and corners of markers.

    If there is none, that of a page with patches may do. The search ends with the first clip of `ENOUGH_FRAMES`.
    """
    corners: dict[int, FloatArray] = {}
    other_keys: set[int] = set()

    def frames() -> Iterator[ClipFrame]:
        for number, frame in enumerate(counted(recording.frames(), recording.n_frames, progress)):
            seen = finder.look(frame.values)
            shown = None if seen is None else page_of(seen.ids)
            if seen is None or shown is None:
                other_keys.update(set() if finder.key is None else {finder.key})
                continue
            page, key = shown
            other_keys.add(key)
            if key == chart.key and page < len(chart.pages):
                corners[number] = seen.corners_px
                yield ClipFrame(page, frame.time_s, str(number), frame.values, (), seen.modules)

    best: dict[bool, tuple[Page, list[int]]] = {}  # by whether the page has edges
    clip_number, present = None, list[int]()
    for clip, frame in clean_clips(frames(), key=chart.key, first_number=0):
        page = chart.pages[clip.page]
        has_edges = bool(page.edges)
        if clip.number != clip_number:
            wanted = best.get(chart.has_camera_page)
            if wanted is not None and len(wanted[1]) >= ENOUGH_FRAMES:
                break
            clip_number, present = clip.number, []
        if has_edges or (takes_patches and page.patches):
            present.append(int(frame.source))
            if has_edges not in best or len(present) > len(best[has_edges][1]):
                best[has_edges] = page, present
    if not best:
        keys = other_keys - {chart.key}
        other = f" (but a chart with the key {min(keys)})" if keys else ""
        kind = "slanted edges" if chart.has_camera_page else "patches"
        raise DataError(
            f"{recording.path}: found no frame of the page of {chart_path} with {kind}{other}, expected it whole "
            "and sharp in the picture, with its four markers"
        )
    page, numbers = best.get(True) or best[False]
    return page, numbers, [corners[number] for number in numbers]


def _cut(recording: Recording, regions: Sequence[Box]) -> list[Recording]:
    """Return the parts of a recording's frames as recordings in memory."""
    parts: list[list[RecordedFrame]] = [[] for _ in regions]
    for frame in recording.frames():
        for part, (left, top, width, height) in zip(parts, regions, strict=True):
            part.append(frame._replace(values=frame.values[top : top + height, left : left + width].copy()))
    return [
        replace(recording, shape=(height, width), n_frames=len(part), read=partial(iter, part))
        for part, (_, _, width, height) in zip(parts, regions, strict=True)
    ]


def _moved_px(corners: Sequence[FloatArray]) -> list[float]:
    """Return how far the markers' corners of each frame are from their median place, in their median."""
    places = np.reshape(corners, (len(corners), -1, 2))
    away = ((places - np.nanmedian(places, axis=0)) ** 2).sum(axis=-1)
    return [float(distance) for distance in np.sqrt(np.nanmedian(away, axis=1))]


def _places(page: Page, geometry: Geometry) -> FloatArray:
    """Return the places and sizes of the patches of a page, (n, 3), by which the error of a lens is judged."""
    middles = np.array([(patch.x_mm, patch.y_mm) for patch in page.patches])
    sizes = [geometry.scale_px_per_mm(middle) for middle in middles]
    return np.column_stack([geometry.to_px(middles), sizes])


def _edges(
    edges: Sequence[Edge], geometry: Geometry, step_mm: float | None, shape: tuple[int, int], path: Path
) -> list[PlacedEdge]:
    """Return the boxes about the edges of a page, and the steps of those that are stairs of a monitor's pixels.

    DataError if the pixels of the monitor are too large for the picture, or it shows too little of the edges.
    """
    placed = []
    for edge in edges:
        ends_px = geometry.to_px(edge.ends_mm)
        dx, dy = (edge.ends_mm[1] - edge.ends_mm[0]).tolist()
        across = np.array([-dy, dx]) / np.hypot(dx, dy) * edge.free_mm
        # Where the next thing is on either side, and the other edges.
        beside = [geometry.to_px(edge.ends_mm + sign * across) for sign in (1.0, -1.0)]
        others = [geometry.to_px(other.ends_mm) for other in edges if other is not edge]
        box = box_about(ends_px, [points_between(line) for line in (*others, *beside)], shape)
        step_px = 0.0
        if step_mm is not None:
            jacobian = geometry.jacobian(edge.ends_mm.mean(axis=0))
            # The stairs go along the axis of the monitor that is nearer to the normal.
            step = jacobian @ (step_mm * (np.array([1.0, 0.0]) if abs(dy) > abs(dx) else np.array([0.0, 1.0])))
            normal = np.array([-1.0, 1.0]) * (ends_px[1] - ends_px[0])[::-1]
            step_px = abs(float(step @ normal)) / float(np.linalg.norm(normal))
            if step_px > MOST_STEP_PX:
                raise DataError(
                    f"{path}: a pixel of the monitor is {step_px:.2g} px wide in the frame, expected "
                    f"{MOST_STEP_PX:g} at most: its width hides the camera's MTF; film from farther away"
                )
        if box is not None:
            placed.append(PlacedEdge(box, step_px))
    if not placed:
        raise DataError(
            f"{path}: the slanted edges are too short in the picture, expected 40 pixels and more; film the chart "
            "larger"
        )
    return placed


def _inner(patch: Patch, geometry: Geometry) -> Box:
    """Return the pixels of an upright rectangle whose corners lie in the inner part of a patch."""
    middle = np.array([patch.x_mm, patch.y_mm])
    half_mm = np.array([patch.width_mm, patch.height_mm]) / 2
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners_px = geometry.to_px(middle + signs * half_mm)
    middle_px: FloatArray = geometry.to_px(middle)
    half_px = np.abs(corners_px - middle_px).max(axis=0)
    # Where the corners of the rectangle that encloses the patch lie on it, in units of its own half sides.
    there = (signs * half_px) @ np.linalg.inv(geometry.jacobian(middle)).T / half_mm
    half_px *= 0.7 / np.abs(there).max()  # The camera may blur the rest of a patch.
    left, top = np.ceil(middle_px - half_px).astype(int)
    right, bottom = np.floor(middle_px + half_px).astype(int)
    return int(left), int(top), int(right - left + 1), int(bottom - top + 1)
