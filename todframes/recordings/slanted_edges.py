"""Slanted edges of a recording: found in the mean of its frames or given as boxes, and measured in each colour."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS, Display
from todframes.recordings.edge_mtf import LEAST_SIDE_PX, Box, EdgeMtf, MtfBand, mean_band, measure_edge
from todframes.recordings.recording import Recording, RecordingWarning

LUMA, COLOURS = "luma", ("red", "green", "blue")
"""Names of what is measured: the weighted sum of the colours, or a grey value; and each colour."""

LEAST_LENGTH_PX = 40.0
"""Least length of an edge that is found by itself."""

END_PX = 6.0
"""Length at either end of a found edge that is left out: corners are round there."""

WIDTHS_PX = (32, 24, 18, 13)
"""Widths beside a found edge, of which the first without other edges is taken."""

MOST_EDGES = 64
"""Largest number of edges that are found by themselves: the longest."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordingMtf:
    """The MTF of a recording: of each edge and colour, and their means.

    Attributes
    ----------
    n_frames : int
        Number of frames whose mean was measured.
    edges : tuple of dict of EdgeMtf
        For each edge the MTF of each colour: "luma", and in colour "red", "green", "blue".
    means : dict of MtfBand
        Mean over the edges, by colour.
    image : ndarray (rows, columns)
        Mean of the frames as luma, or luminance where a display was given.
    warnings : tuple of RecordingWarning
    """

    n_frames: int
    edges: tuple[dict[str, EdgeMtf], ...]
    means: dict[str, MtfBand]
    image: FloatArray
    warnings: tuple[RecordingWarning, ...]


def measure_mtf(
    recording: Recording,
    *,
    boxes: Sequence[Box] = (),
    display: Display | None = None,
    progress: Callable[[int], None] | None = None,
) -> RecordingMtf:
    """Measure the MTF across slanted edges in the mean of a recording's frames.

    Parameters
    ----------
    recording : Recording
        Frames of a scene that does not move.
    boxes : sequence of (int, int, int, int)
        Left column, top row, width and height of the part of the frame about each edge. Without any, edges are
        found.
    display : Display, optional
        Display whose transfer function the values have been made for: luminance is measured then.
    progress : function of an int, optional
        Called with 1 for each frame.

    Raises
    ------
    SettingsError
        If a box is not within the frame or too small, or values without a white are to be displayed.
    DataError
        If a frame cannot be read, there is no edge, or a given one cannot be measured.
    """
    frames = _mean(recording, display, progress)
    whole = frames.colours[LUMA]
    warnings = list(recording.warnings)
    edges = []
    asked = [(box, True) for box in boxes] or [(box, False) for box in find_edges(whole)]
    problems = []
    for box, is_given in asked:
        try:
            edge = {LUMA: measure_edge(whole, box, saturated=frames.saturated)}
        except DataError as error:
            if is_given:
                raise
            problems.append(error.marked)
            continue
        for name in COLOURS if len(frames.colours) > 1 else ():
            try:
                edge[name] = measure_edge(frames.colours[name], box, saturated=frames.saturated)
            except DataError as error:
                problems.append(f"{name}: {error.marked}")
        edges.append(edge)
    if not edges:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DataError(f"{recording.path}: no edge can be measured: {problems[0]}{more}")
    warnings += [RecordingWarning("edge_left_out", f"left out: {one}") for one in problems]
    names = dict.fromkeys(name for edge in edges for name in edge)
    means = {name: mean_band([edge[name] for edge in edges if name in edge]) for name in names}
    return RecordingMtf(n_frames=frames.n, edges=tuple(edges), means=means, image=whole, warnings=tuple(warnings))


class _MeanFrame(NamedTuple):
    """Means over frames by colour, and the pixels that were at an end of their scale in any frame."""

    colours: dict[str, FloatArray]
    saturated: NDArray[np.bool_] | None
    n: int


def _mean(recording: Recording, display: Display | None, progress: Callable[[int], None] | None) -> _MeanFrame:
    white, black = recording.full_scale, recording.zero
    if display is not None and white is None:
        raise SettingsError(
            f"{argument.display}: {recording.path} has values without a white, expected code values of a picture"
        )
    n, total, saturated = 0, np.zeros(()), np.zeros(recording.shape, bool)
    for frame in recording.frames():
        values = frame.values.astype(np.float64)
        if white is not None:
            at_end = (values <= black) | (values >= white)
            saturated |= at_end if at_end.ndim == 2 else at_end.any(2)
        if display is not None and white is not None:
            code = np.clip((values - black) / (white - black), 0.0, 1.0)
            channels = code[..., np.newaxis] if code.ndim == 2 else code
            each = [display.luminance(channels[..., k : k + 1]) for k in range(channels.shape[2])]
            values = each[0] if len(each) == 1 else np.stack(each, -1)
        total = total + values
        n += 1
        if progress is not None:
            progress(1)
    if not n:
        raise DataError(f"{recording.path}: found no frame, expected at least one")
    mean = total / n
    colours = {LUMA: mean if mean.ndim == 2 else mean @ REC_709_LUMINANCE_WEIGHTS}
    if mean.ndim == 3 and np.ptp(mean, 2).any():  # grey pictures may be stored in three equal channels
        colours |= {name: mean[..., k] for k, name in enumerate(COLOURS)}
    return _MeanFrame(colours, None if white is None else saturated, n)


class _Segment(NamedTuple):
    """A straight line between two points (x, y)."""

    x1: float
    y1: float
    x2: float
    y2: float

    @property
    def length(self) -> float:
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)

    def points(self) -> FloatArray:
        """Return points at most a pixel apart, (n, 2)."""
        share = np.linspace(0.0, 1.0, int(self.length) + 2)[:, np.newaxis]
        return np.array([self.x1, self.y1]) * (1.0 - share) + np.array([self.x2, self.y2]) * share

    def distances(self, points: FloatArray) -> FloatArray:
        """Return the distances of points from the line, which goes on beyond its ends."""
        dx, dy = (self.x2 - self.x1) / self.length, (self.y2 - self.y1) / self.length
        return np.abs((points[:, 0] - self.x1) * dy - (points[:, 1] - self.y1) * dx)


def find_edges(image: FloatArray) -> list[Box]:
    """Return boxes about the straight edges of an image, the longest first.

    Lines are found by OpenCV's line segment detector: Grompone von Gioi et al. 2012, "LSD: a line segment
    detector", IPOL 2. A box leaves out the ends of its edge, and goes to the sides as far as there is no other.

    Raises
    ------
    DataError
        If there is no straight edge of at least `LEAST_LENGTH_PX`.
    """
    import cv2

    low, high = np.percentile(image, (0.5, 99.5))
    if not high > low:
        raise DataError("found no edge: all values are the same")
    grey = np.clip((image - low) / (high - low) * 255.0, 0.0, 255.0).astype(np.uint8)
    lines = cv2.createLineSegmentDetector().detect(cv2.GaussianBlur(grey, (0, 0), 1.0))[0]
    found = [] if lines is None else [_Segment(*map(float, line)) for line in lines.reshape(-1, 4)]
    found.sort(key=lambda one: -one.length)
    boxes: list[Box] = []
    taken: list[_Segment] = []
    for one in found:
        if one.length < LEAST_LENGTH_PX or len(boxes) == MOST_EDGES:
            break
        if any(_is_part(one, other) for other in taken):
            continue
        taken.append(one)
        boxes += list(_boxes(one, [other for other in found if other is not one], image.shape))[:1]
    if not boxes:
        raise DataError(
            f"found no straight edge of at least {LEAST_LENGTH_PX:g} pixels that stands alone, expected one; give "
            f"the part of the frame with the edge: {argument.boxes}"
        )
    return boxes


def _is_part(one: _Segment, other: _Segment) -> bool:
    """Return whether a line is the same edge as another: it lies on it."""
    return bool(other.distances(one.points()).max() < 6.0)


def _boxes(one: _Segment, others: Sequence[_Segment], shape: tuple[int, ...]) -> Iterator[Box]:
    """Yield the boxes about an edge without others in them, the widest first."""
    rows, columns = shape
    is_upright = abs(one.y2 - one.y1) >= abs(one.x2 - one.x1)
    share = END_PX / one.length
    inner = one.points()[[0, -1]]
    ends = inner + share * (inner[::-1] - inner)
    low, high = ends.min(0), ends.max(0)
    rest = [points for other in others if not _is_part(other, one) for points in [other.points()]]
    for width in WIDTHS_PX:
        margin = np.array([width, 0.0] if is_upright else [0.0, width])
        first = np.maximum(np.ceil(low - margin), 0).astype(int)
        last = np.minimum(np.floor(high + margin), [columns - 1, rows - 1]).astype(int)
        if (last - first + 1 < LEAST_SIDE_PX).any():
            continue
        if not any(((first <= points) & (points <= last)).all(1).any() for points in rest):
            yield int(first[0]), int(first[1]), int(last[0] - first[0] + 1), int(last[1] - first[1] + 1)
