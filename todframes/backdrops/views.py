"""Backgrounds of triangles: square windows of images, as seen in the symmetries of the square."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.backdrops.images import SceneFile, SceneImage, decoded_images
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, argument
from todframes.display.display import Display
from todframes.frames.position import candidate_places
from todframes.frames.trials import SceneView
from todframes.stimulus import (
    ORIENTATIONS,
    Orientation,
    circle_about,
    orientation_weights,
)

TURNS = ("r0", "r90", "r180", "r270", "m0", "m90", "m180", "m270")
"""Symmetries of the square: clockwise turns, and turns after mirroring left to right."""

MOST_AT_END = 0.01
"""Largest share of the pixels of a window at black or white; near the places it is a tenth."""

LEAST_USED = 0.05
"""Share of the range from black to white that the values of a picture are spread over, at least."""

WINDOWS_TRIED = 400
"""Number of places of an image at which a window is tried."""


def turned(image: FloatArray, turn: str) -> FloatArray:
    """Return an image in one of `TURNS`: mirrored left to right if it begins with m, then turned clockwise."""
    shown = image[:, ::-1] if turn[0] == "m" else image
    return np.rot90(shown, -(int(turn[1:]) // 90))


def turned_place(x_px: float, y_px: float, turn: str) -> tuple[float, float]:
    """Return the place of a point of an image after a turn; both are counted from the image's middle."""
    x, y = (-x_px, y_px) if turn[0] == "m" else (x_px, y_px)
    for _ in range(int(turn[1:]) // 90):
        x, y = -y, x
    return x, y


def local_luminance(luminance_cd_m2: FloatArray, x_px: float, y_px: float, size_px: float) -> float:
    """Return the mean luminance, in cd/m², in the circle through the corners of a triangle, before it is added.

    Pixels at the circle count by the share of a pixel that lies within, along the radius.
    """
    shape = (luminance_cd_m2.shape[0], luminance_cd_m2.shape[1])
    return float((circle_about(shape, size_px=size_px, x_px=x_px, y_px=y_px) * luminance_cd_m2).sum())


class Layout(NamedTuple):
    """The geometry of frames with triangles of one size, in pixels.

    `reach_px` is the distance from each place to the edges that the observer needs, `step_px` that of neighbouring
    places.
    """

    size_px: float
    reach_px: int
    places: int
    step_px: float

    @property
    def side_px(self) -> int:
        """Side of the square frames."""
        return 2 * self.reach_px + 1 + math.ceil(math.isqrt(self.places - 1) * self.step_px)

    def at(self, place: int) -> tuple[float, float]:
        """Return the centroid (x, y) of a place, by its number from 1; the grid is in the middle of the frame."""
        return self._grid[place - 1]

    def nearest(self, x_px: float, y_px: float) -> int:
        """Return the number of the place that is nearest to a point."""
        return 1 + min(range(self.places), key=lambda k: math.dist(self._grid[k], (x_px, y_px)))

    @property
    def _grid(self) -> list[tuple[float, float]]:
        grid = candidate_places(0.0, 0.0, place=1, step_px=self.step_px, places=self.places)
        dx, dy = (((self.side_px - 1) - max(along)) / 2.0 for along in zip(*grid, strict=True))
        return [(x + dx, y + dy) for x, y in grid]


class Background(NamedTuple):
    """A window of an image, not turned: its luminance in cd/m², shape (side, side)."""

    scene: str
    window: str
    luminance_cd_m2: FloatArray

    def view(self, turn: str) -> SceneView:
        """Return how the manifest names this background in a turn."""
        return SceneView(self.scene, turn, self.window)


class UnfitSceneError(DataError):
    """Error for a scene of which no window can stand behind a triangle: it is too small, even or saturated."""


def draw_backgrounds(
    files: Sequence[SceneFile],
    display: Display,
    layouts: Sequence[Layout],
    rng_of: Callable[[int, int], np.random.Generator],
    *,
    windows: int = 1,
    frames: int = 1,
    room_for: Callable[[FloatArray, Layout], float] | None = None,
    range_name: str = "value_range",
    note: Callable[[str], None],
) -> list[list[Background]]:
    """Draw windows of each scene for each layout, and leave out scenes that are unfit for one of them.

    Those of each layout come from the same scenes in the same order: at most `windows` of each of at most `frames`
    frames of a film. `rng_of` returns the stream of the windows' places by the numbers of file and layout.
    `room_for` returns how many times stronger the triangles on a window could be and still be shown by the
    display; windows with less than 1 are not taken. `note` is called with a remark about each scene that is left
    out, or whose values hardly differ; `range_name` is the argument that has the values of black and white.

    Raises FrameError or DataError if a file cannot be decoded; if all scenes are unfit, the UnfitSceneError of the
    first.
    """
    of_layouts: list[list[Background]] = [[] for _ in layouts]
    first: UnfitSceneError | None = None
    for number, file in enumerate(files):
        streams = [rng_of(number, k) for k in range(len(layouts))]
        drawn: list[list[Background]] = [[] for _ in layouts]
        try:
            for image in decoded_images(file, display, frames=frames):
                names_frame = image.frame > 0 or frames > 1
                if 0.0 < image.used < LEAST_USED:
                    share = (
                        f"its values are spread over {100.0 * image.used:.2g} % of the range from black to white"
                    )
                    asked = getattr(argument, range_name)
                    remedy = f"of counts or temperatures, give the values of black and white ({asked})"
                    note(f"{image.path}: {share}; {remedy}")
                for layout, stream, found in zip(layouts, streams, drawn, strict=True):
                    found += draw_windows(
                        image, layout, windows, stream, names_frame=names_frame, room_for=room_for
                    )
        except UnfitSceneError as error:
            first = first or error
            note(f"left out {error}")
            continue
        for found, more in zip(of_layouts, drawn, strict=True):
            found += more
    if first is not None and not of_layouts[0]:
        raise first
    return of_layouts


def draw_windows(
    image: SceneImage,
    layout: Layout,
    number: int,
    rng: np.random.Generator,
    *,
    names_frame: bool,
    room_for: Callable[[FloatArray, Layout], float] | None = None,
) -> Iterator[Background]:
    """Yield windows of an image at random places where it is neither black nor white, nor without any contrast.

    With `room_for`, as in `draw_backgrounds`, the display can show the triangles on them, too. Raises
    UnfitSceneError if the image is smaller than a window, or has too few such places.
    """
    side = layout.side_px
    rows, columns = image.luminance_cd_m2.shape
    for_places = f" for {layout.places} places {layout.step_px:g} pixels apart" if layout.places > 1 else ""
    if min(rows, columns) < side:
        raise UnfitSceneError(
            f"{image.path}: found {columns} × {rows} pixels, expected at least {side} × {side} for a triangle of "
            f"{layout.size_px:.4g} pixels and what the observer sees around it{for_places}"
        )
    sums = np.zeros((rows + 1, columns + 1))
    sums[1:, 1:] = image.at_end.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    near = math.ceil(layout.size_px)
    begins, ends = layout.reach_px - near, side - layout.reach_px + near
    found: set[tuple[int, int]] = set()
    most_room: float | None = None
    for _ in range(WINDOWS_TRIED):
        row, column = int(rng.integers(rows - side + 1)), int(rng.integers(columns - side + 1))
        part = image.luminance_cd_m2[row : row + side, column : column + side]
        is_new = not any(abs(row - r) < near and abs(column - c) < near for r, c in found)
        inner = _sum(sums, row + begins, row + ends, column + begins, column + ends) / (ends - begins) ** 2
        whole = _sum(sums, row, row + side, column, column + side) / side**2
        if is_new and whole <= MOST_AT_END and inner <= MOST_AT_END / 10.0 and part.min() < part.max():
            room = 1.0 if room_for is None else room_for(part, layout)
            if room < 1.0:
                most_room = max(room, most_room or 0.0)
                continue
            found.add((row, column))
            frame = f"{image.frame}:" if names_frame else ""
            yield Background(image.scene, f"{frame}{row},{column}", part.astype(np.float32).astype(np.float64))
            if len(found) == number:
                return
    if found:
        raise UnfitSceneError(
            f"{image.path}: found {len(found)} windows of {side} × {side} pixels apart from each other, with "
            f"contrast and not at black or white, expected {number}"
        )
    if most_room is not None:
        raise UnfitSceneError(
            f"{image.path}: found the strongest triangle beyond black or white of the display on all windows of "
            f"{side} × {side} pixels, expected at most {most_room:.2g} times its contrast, or another "
            f"{argument.dim}"
        )
    share = 100.0 * float(image.at_end.mean())
    raise UnfitSceneError(
        f"{image.path}: found no window of {side} × {side} pixels with contrast and at most {100 * MOST_AT_END:g} "
        f"% of its pixels at black or white ({share:.3g} % of the image are), expected an image that is not "
        "saturated, or another range of values"
    )


def _sum(sums: FloatArray, top: int, bottom: int, left: int, right: int) -> float:
    return float(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left])


class PlannedTrial(NamedTuple):
    """A trial on a background: indices of background and level, the turn, the orientation and the number."""

    background: int
    turn: str
    level: int
    orientation: Orientation
    number: int


def plan(n_backgrounds: int, turns: Sequence[str], n_levels: int, trials: int) -> list[PlannedTrial]:
    """Plan the trials of one size: backgrounds in turn, each in all turns and, relative to it, all orientations.

    After `balanced(…)` trials of a level, each background has been shown in each turn as often as in any other,
    and with each orientation of the triangle, relative to it and on the display, as often as with any other.
    """
    planned = []
    for level in range(n_levels):
        for number in range(trials):
            background, round_ = number % n_backgrounds, number // n_backgrounds
            turn = round_ % len(turns)
            relative = turn + turn // 4 + round_ // len(turns) + level + background
            orientation = ORIENTATIONS[(turn + relative) % 4]
            planned.append(PlannedTrial(background, turns[turn], level, orientation, number))
    return planned


def balanced(n_backgrounds: int, turns: Sequence[str]) -> int:
    """Return the number of trials of a level after which `plan` is balanced."""
    return n_backgrounds * (4 if len(turns) == 1 else 8)


def own_orientation(luminance_cd_m2: FloatArray, x_px: float, y_px: float, size_px: float) -> NDArray[np.float64]:
    """Return the contrasts of the orientations that a background has by itself, in the order of `ORIENTATIONS`.

    The background's contrast is multiplied by triangles of the four orientations, each without the mean of the
    four, in units of a triangle's own product. A triangle of contrast 0.1 alone has 0.1 in its orientation. The
    sum is 0; the largest is the contrast of the triangle that would answer as the background does.
    """
    contrast = luminance_cd_m2 / local_luminance(luminance_cd_m2, x_px, y_px, size_px) - 1.0
    shape = (contrast.shape[0], contrast.shape[1])
    return np.tensordot(orientation_weights(shape, size_px=size_px, x_px=x_px, y_px=y_px), contrast, 2)
