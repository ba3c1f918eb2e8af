"""Slanted edges of a recording: found in the mean of its frames or given as boxes, and measured in each colour."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.camera.edge_mtf import LEAST_SIDE_PX, EdgeMtf, mean_curves, measure_edge
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS, Display
from todframes.frames.ends import ValueEnds
from todframes.parameters import Box, Progress, counted
from todframes.recordings.recording import Recording, RecordingWarning

LUMA, COLOURS = "luma", ("red", "green", "blue")
"""Names of what is measured: the weighted sum of the colours, or a grey value; and each colour."""

LEAST_LENGTH_PX = 40.0
"""Least length of an edge that is found by itself."""

LEAST_PLATEAU = 0.1
"""Share of the pixels of a box with its smallest or largest value from which that end is a plateau."""

SAME_PX = 6.0
"""Largest distance beside a line of points that belong to the same edge, which may be bent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordingMtf:
    """The MTF of a recording: for each edge that of each colour, "luma" and in colour "red", "green", "blue".

    `means` are those over the edges, by colour, with the ends of their bands, shape (3, 65). `image` is the mean
    of the frames as luma, or luminance where a display was given.
    """

    n_frames: int
    edges: tuple[dict[str, EdgeMtf], ...]
    means: dict[str, FloatArray]
    image: FloatArray
    warnings: tuple[RecordingWarning, ...]


class PlacedEdge(NamedTuple):
    """An edge whose place is known: a box about it, and the width of its steps if it is a stair of a monitor's
    pixels, in pixels of the frame along the normal; 0 for a straight one."""

    box: Box
    step_px: float = 0.0


def measure_mtf(
    recording: Recording,
    *,
    edges: Sequence[PlacedEdge] = (),
    needs_all: bool = False,
    display: Display | None = None,
    progress: Progress | None = None,
) -> RecordingMtf:
    """Measure the MTF across slanted edges in the mean of a recording's frames, or of a display's luminance.

    Edges without a known place are found. Those that cannot be measured are left out, unless all are needed.
    SettingsError if a box is not within the frame or too small, or values without a white are to be displayed;
    DataError if there is no edge, or one that is needed cannot be measured.
    """
    n_frames, colours, saturated, first = _mean(recording, display, progress)
    whole = colours[LUMA]
    warnings = list(recording.warnings)
    measured: list[dict[str, EdgeMtf]] = []
    try:
        edges = edges or [PlacedEdge(box) for box in find_edges(whole)]
    except DataError as error:
        raise DataError(f"{recording.path}: {error}") from None
    problems = []
    for box, step_px in edges:
        edge: dict[str, EdgeMtf] = {}
        for name, image in colours.items():
            try:
                edge[name] = measure_edge(image, box, step_px=step_px, saturated=saturated)
            except (DataError, SettingsError) as error:
                if name == LUMA and needs_all:
                    raise type(error)(f"{recording.path}: {error}") from None
                problems.append(str(error) if name == LUMA else f"{name}: {error}")
                if name == LUMA:
                    break
        if edge:
            measured.append(edge)
            for name in [name for name in edge if name != LUMA] or [LUMA]:
                plane = first if first.ndim == 2 else first[..., COLOURS.index(name) if name in COLOURS else 0]
                warnings += _cut_off(plane, edge[name], "" if name == LUMA else f"{name}: ")
    if not measured:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DataError(f"{recording.path}: no edge can be measured: {problems[0]}{more}")
    warnings += [RecordingWarning("edge_left_out", f"left out: {problem}") for problem in problems]
    names = dict.fromkeys(name for edge in measured for name in edge)
    means = {name: mean_curves([edge[name].curves for edge in measured if name in edge]) for name in names}
    return RecordingMtf(
        n_frames=n_frames, edges=tuple(measured), means=means, image=whole, warnings=tuple(warnings)
    )


def _cut_off(first: NDArray[Any], edge: EdgeMtf, colour: str) -> Iterator[RecordingWarning]:
    """Yield a warning if an edge is cut off at a value that many pixels of its box have in the first frame, (rows,
    columns): one side is of one value, the other one has noise. Without any noise it is not found.
    """
    left, top, width, height = edge.box
    values = first[top : top + height, left : left + width]
    tally = ValueEnds()
    tally.add(values)
    ordered = np.sort(values, axis=None).astype(np.float64)
    quarter = values.size // 4  # about half of a side, with 0.6 of its noise
    noise = ordered[:quarter].std(), ordered[-quarter:].std()
    least_noise = max(0.6 * tally.step, 1e-4 * float(np.ptp(values)))
    for end, name, beyond in ((values.min(), "smallest", noise[1]), (values.max(), "largest", noise[0])):
        share = float((values == end).mean())
        if share > LEAST_PLATEAU and beyond > least_noise:
            yield RecordingWarning(
                "saturated",
                f"{colour}box {left},{top},{width},{height}: {100 * share:.0f} % of the pixels have the {name} "
                f"value, {end:.6g}, and the edge is cut off there: its MTF comes out too high; change exposure or "
                "gain",
            )


def _mean(
    recording: Recording, display: Display | None, progress: Progress | None
) -> tuple[int, dict[str, FloatArray], NDArray[np.bool_], NDArray[Any]]:
    """Return the number of frames, their means by colour, which pixels were at a known end of their scale, and the
    values of the first frame."""
    white, black = recording.full_scale, recording.zero
    if display is not None and white is None:
        raise SettingsError(
            f"{argument.display}: {recording.path} has values without a white, expected code values of a picture"
        )
    n, total, saturated, first = 0, np.zeros(()), np.zeros(recording.shape, bool), np.zeros(())
    for frame in counted(recording.frames(), recording.n_frames, progress):
        first = first if n else frame.values
        values = frame.values.astype(np.float64)
        if recording.ends is not None:
            at_end = (values <= recording.ends[0]) | (values >= recording.ends[1])
            saturated |= at_end if at_end.ndim == 2 else at_end.any(2)
        if display is not None and white is not None:
            code = np.clip((values - black) / (white - black), 0.0, 1.0)
            channels = code[..., np.newaxis] if code.ndim == 2 else code
            each = [display.luminance(channels[..., k : k + 1]) for k in range(channels.shape[2])]
            values = each[0] if len(each) == 1 else np.stack(each, -1)
        total = total + values
        n += 1
    mean = total / n
    colours = {LUMA: mean if mean.ndim == 2 else mean @ REC_709_LUMINANCE_WEIGHTS}
    if mean.ndim == 3 and np.ptp(mean, 2).any():  # grey pictures may be stored in three equal channels
        colours |= {name: mean[..., k] for k, name in enumerate(COLOURS)}
    return n, colours, saturated, first


def find_edges(image: FloatArray) -> list[Box]:
    """Return boxes about the straight edges of an image, the longest 64 at most, the longest first.

    Lines are found by OpenCV's line segment detector: Grompone von Gioi et al. 2012, "LSD: a line segment
    detector", IPOL 2. DataError if there is no straight edge of at least `LEAST_LENGTH_PX`.
    """
    import cv2

    low, high = np.percentile(image, (0.5, 99.5))
    if not high > low:
        raise DataError("found no edge: all values are the same")
    grey = np.clip((image - low) / (high - low) * 255.0, 0.0, 255.0).astype(np.uint8)
    detected = cv2.createLineSegmentDetector().detect(cv2.GaussianBlur(grey, (0, 0), 1.0))[0]
    lines = [] if detected is None else [*detected.reshape(-1, 2, 2).astype(np.float64)]
    lines.sort(key=lambda ends: -math.dist(*ends))
    points = [points_between(ends) for ends in lines]
    boxes: list[Box] = []
    taken: list[FloatArray] = []
    for ends, own in zip(lines, points, strict=True):
        if math.dist(*ends) < LEAST_LENGTH_PX or len(boxes) == 64:
            break
        # A line beside another, and not beyond its ends, is a part of the same edge.
        relations = ((other, *_coordinates(other, own)) for other in taken)
        if not any(
            beside.max() < SAME_PX and along.max() > 0.0 and along.min() < math.dist(*other)
            for other, along, beside in relations
        ):
            taken.append(ends)
            box = box_about(ends, points, image.shape)
            boxes += [] if box is None else [box]
    if not boxes:
        raise DataError(
            f"found no straight edge of at least {LEAST_LENGTH_PX:g} pixels that stands alone, expected one; give "
            f"the part of the frame with the edge: {argument.boxes}"
        )
    return boxes


def box_about(ends_px: FloatArray, points: Sequence[FloatArray], shape: tuple[int, ...]) -> Box | None:
    """Return the widest box about an edge without points of other lines in it; None if there is none.

    The ends of the edge are (x, y), shape (2, 2), the points (n, 2) a line; `shape` is that of the frame.
    """
    length = math.dist(*ends_px)
    if length < LEAST_LENGTH_PX:
        return None
    # All lines but those that go on where this one ends.
    counts, every = np.array([len(some) for some in points]), np.concatenate(points)
    farthest = np.maximum.reduceat(_coordinates(ends_px, every)[1], np.cumsum(counts) - counts)
    rest = every[np.repeat(farthest >= SAME_PX, counts)]
    across, along = np.abs(ends_px[1] - ends_px[0])
    ends = ends_px + 6.0 / length * (ends_px[::-1] - ends_px)  # corners at the ends of an edge are round
    for width in (32, 24, 18, 13):
        margin = np.array([width, 0.0] if along >= across else [0.0, width])
        first = np.maximum(np.ceil(ends.min(0) - margin), 0).astype(int)
        last = np.minimum(np.floor(ends.max(0) + margin), [shape[1] - 1, shape[0] - 1]).astype(int)
        is_free = not ((first <= rest) & (rest <= last)).all(1).any()
        if is_free and (last - first + 1 >= LEAST_SIDE_PX).all():
            return int(first[0]), int(first[1]), int(last[0] - first[0] + 1), int(last[1] - first[1] + 1)
    return None


def points_between(ends_px: FloatArray) -> FloatArray:
    """Return points of a line, (n, 2), at most a pixel apart."""
    return np.linspace(ends_px[0], ends_px[1], int(math.dist(*ends_px)) + 2)


def _coordinates(ends_px: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far points are along a line, from its first end, and beside it."""
    dx, dy = (ends_px[1] - ends_px[0]) / math.dist(*ends_px)
    x, y = (points - ends_px[0]).T
    return x * dx + y * dy, np.abs(x * dy - y * dx)
