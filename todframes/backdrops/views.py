"""Backgrounds of triangles: windows of files, films and photographs, in the symmetries of the square."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import spelling_hint
from todframes.display.display import Display
from todframes.frames.trials import SceneView
from todframes.parameters import PathLike
from todframes.recordings.opening import NoReaderError, open_recordings
from todframes.recordings.recording import CodeRange, Recording, code_range, files_in
from todframes.stimulus import ORIENTATIONS, Orientation, circle_about, orientation_weights

PHOTOGRAPHS = (
    *("astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "coins.png", "grass.png"),
    *("gravel.png", "hubble_deep_field.jpg", "moon.png", "motorcycle_left.png", "rocket.jpg"),
)
"""Photographs that every installation of scikit-image has."""

PACKAGED = "skimage"
"""Name that stands for these photographs in place of a path; `skimage:camera,brick` for some of them."""

TURNS = ("r0", "r90", "r180", "r270", "m0", "m90", "m180", "m270")
"""Symmetries of the square: clockwise turns, and turns after mirroring left to right."""

MOST_AT_END = 0.01
"""Largest share of the pixels of a window at black or white; near the places it is a tenth."""

LEAST_USED = 0.05
"""Share of the range from black to white that the values of a picture are spread over, at least."""

WINDOWS_TRIED = 400
"""Number of places of an image at which a window is tried."""


class SceneFile(NamedTuple):
    """A recording that scenes are taken from: its name in the manifest and the values of black and white."""

    scene: str
    recording: Recording
    scale: CodeRange


class SceneImage(NamedTuple):
    """A frame of a recording, counted from 0, as luminance of shape (rows, columns). `at_end` marks the pixels
    with a channel at black, white or an end of the display's LUT, or beyond. `used` is the share of the range from
    black to white that the values of the frame are spread over.
    """

    scene: str
    path: str
    frame: int
    luminance_cd_m2: FloatArray
    at_end: NDArray[np.bool_]
    used: float


def open_scenes(
    paths: PathLike | Sequence[PathLike],
    *,
    value_range: tuple[float, float] | None = None,
    range_name: str = "value_range",
    max_frame_mb: int = 256,
    note: Callable[[str], None] = lambda _: None,
) -> list[SceneFile]:
    """Open the files of scenes; each image file, film or array is a scene with the name of its file. `paths` are
    files, folders, and "skimage" or "skimage:camera,brick" for photographs of scikit-image. `note` is called with
    remarks about files that are no recordings, and warnings of recordings. SettingsError, which names the argument
    `range_name`, if values have no black and white and no range is given.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not given:
        raise DataError("backgrounds: found no path, expected at least one")
    opened: list[Recording] = []
    for path in given:
        name = os.fspath(path)
        if name.partition(":")[0] == PACKAGED and not Path(name).exists():
            for photograph in _photographs(name):
                opened += open_recordings([photograph], max_frame_mb=max_frame_mb)
        elif Path(name).is_dir():
            opened += _of_folder(Path(name), max_frame_mb, note)
        else:
            opened += open_recordings([Path(name)], max_frame_mb=max_frame_mb)
    files: dict[str, SceneFile] = {}
    for recording in opened:
        path, scene = recording.path, recording.path.stem
        for code, message in recording.warnings:
            if code != "lossy_compression":  # any picture may be behind a triangle
                note(f"{path}: {message}")
        if scene in files:
            raise DataError(
                f"{path}: found the name {scene} as of {files[scene].recording.path}, expected a name of its own, "
                "which the manifest has as scene"
            )
        files[scene] = SceneFile(scene, recording, code_range(recording, value_range, range_name))
    return list(files.values())


def _photographs(name: str) -> list[Path]:
    spec = find_spec("skimage")
    assert spec is not None and spec.origin is not None  # scikit-image is a dependency
    known = {Path(file).stem: Path(spec.origin).parent / "data" / file for file in PHOTOGRAPHS}
    wanted = [text.strip() for text in name.partition(":")[2].split(",")] if ":" in name else list(known)
    for photograph in wanted:
        if photograph not in known:
            raise DataError(
                f"{name}: found {photograph!r}, expected photographs of scikit-image: {', '.join(known)}"
                f"{spelling_hint(photograph, known)}"
            )
    return [known[photograph] for photograph in wanted]


def _of_folder(folder: Path, max_frame_mb: int, note: Callable[[str], None]) -> list[Recording]:
    """Open each recording of a folder; files of other kinds are left out."""
    found: list[Recording] = []
    others: list[str] = []
    for path in files_in(folder):
        try:
            found += open_recordings([path], max_frame_mb=max_frame_mb)
        except NoReaderError:
            others.append(path.name)
    if not found:
        what = f"only {', '.join(others[:3])}" if others else "no files"
        raise DataError(f"{folder}: found {what}, expected images or other recordings")
    if others:
        names = ", ".join(others[:3]) + (", …" if len(others) > 3 else "")
        note(f"{folder}: left out {names}, no {'recordings' if len(others) > 1 else 'recording'}")
    return found


def decoded_images(file: SceneFile, display: Display, *, frames: int) -> Iterator[SceneImage]:
    """Yield frames of a scene, so many at most, spread evenly over its recording, as luminance on a display.
    Recorded values beyond black and white, or beyond the ends of the display's LUT, are shown as these.
    """
    recording, (low, high) = file.recording, (file.scale.low, file.scale.high)
    total = recording.n_frames or sum(1 for _ in recording.frames())
    # A LUT gives luminance of absolute code values: it may begin above 0 and end below 1.
    ends = (0.0, 1.0) if display.lut is None else (display.lut.code_value[0], display.lut.code_value[-1])
    wanted = set(np.linspace(0, total - 1, min(frames, total)).round().astype(int).tolist())
    for number, recorded in enumerate(recording.frames()):
        if number in wanted:
            code = (np.atleast_3d(recorded.values).astype(np.float64) - low) / (high - low)
            at_end = np.any((code <= ends[0]) | (code >= ends[1]), axis=2)
            luminance = display.luminance(np.clip(code, *ends))
            yield SceneImage(file.scene, str(recording.path), number, luminance, at_end, float(np.ptp(code)))
        if number >= max(wanted):
            return


class Encoder:
    """The inverse of a display: luminance to code values of 16 bits. Raises SettingsError if the luminance of the
    display does not rise with the code value.
    """

    def __init__(self, display: Display) -> None:
        codes = np.arange(65536) / 65535.0
        if display.lut is not None:
            codes = codes[(codes >= display.lut.code_value[0]) & (codes <= display.lut.code_value[-1])]
        luminance = display.luminance(codes.astype(np.float32).reshape(-1, 1, 1))[:, 0]
        if not (np.diff(luminance) >= 0.0).all():
            raise SettingsError("display: its luminance does not rise with the code value, expected one that does")
        self.black_cd_m2, self.white_cd_m2 = float(luminance[0]), float(luminance[-1])
        self._codes, self._middles = codes, (luminance[1:] + luminance[:-1]) / 2.0

    def __call__(self, luminance_cd_m2: FloatArray) -> FloatArray:
        """Return the code values nearest in luminance, of the same shape."""
        return np.asarray(self._codes[np.searchsorted(self._middles, luminance_cd_m2)])


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
    """The geometry of frames with triangles of one size, in pixels. `reach_px` is the distance from the middle of
    the frame to the edges that the observer needs.
    """

    size_px: float
    reach_px: int

    @property
    def side_px(self) -> int:
        """Side of the square frames."""
        return 2 * self.reach_px + 1


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
    *,
    seed: int,
    stream: int,
    windows: int = 1,
    frames: int = 1,
    room_for: Callable[[FloatArray, Layout], float] | None = None,
    range_name: str = "value_range",
    note: Callable[[str], None],
) -> list[list[Background]]:
    """Draw windows of each scene for each layout, and leave out scenes that are unfit for one of them. Those of
    each layout come from the same scenes in the same order: at most `windows` of each of at most `frames` frames
    of a film; their places are drawn from streams with spawn keys of `stream` and the numbers of file and layout.
    `room_for` returns how many times stronger the triangles on a window could be and still be shown by the
    display; windows with less than 1 are not taken. `note` is called with a remark about each scene that is left
    out, or whose values hardly differ. If all scenes are unfit, the UnfitSceneError of the first is raised.
    """
    of_layouts: list[list[Background]] = [[] for _ in layouts]
    first: UnfitSceneError | None = None
    for number, file in enumerate(files):
        keys = [(stream, number, k) for k in range(len(layouts))]
        streams = [np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)) for key in keys]
        drawn: list[list[Background]] = [[] for _ in layouts]
        try:
            for image in decoded_images(file, display, frames=frames):
                names_frame = image.frame > 0 or frames > 1
                if 0.0 < image.used < LEAST_USED:
                    note(
                        f"{image.path}: its values are spread over {100.0 * image.used:.2g} % of the range from "
                        "black to white; of counts or temperatures, give the values of black and white "
                        f"({getattr(argument, range_name)})"
                    )
                for layout, rng, found in zip(layouts, streams, drawn, strict=True):
                    found += draw_windows(image, layout, windows, rng, names_frame=names_frame, room_for=room_for)
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
    """Yield windows of an image at random places where it is neither black nor white, nor without any contrast,
    and has `room_for` the triangles. UnfitSceneError if the image is smaller than a window, or has too few such
    places.
    """
    side = layout.side_px
    rows, columns = image.luminance_cd_m2.shape
    if min(rows, columns) < side:
        raise UnfitSceneError(
            f"{image.path}: found {columns} × {rows} pixels, expected at least {side} × {side} for a triangle of "
            f"{layout.size_px:.4g} pixels and what the observer sees around it"
        )
    near = math.ceil(layout.size_px)
    inside = slice(layout.reach_px - near, side - layout.reach_px + near)
    found: set[tuple[int, int]] = set()
    most_room: float | None = None
    for _ in range(WINDOWS_TRIED):
        row, column = int(rng.integers(rows - side + 1)), int(rng.integers(columns - side + 1))
        window = np.s_[row : row + side, column : column + side]
        part, at_end = image.luminance_cd_m2[window], image.at_end[window]
        is_new = not any(abs(row - r) < near and abs(column - c) < near for r, c in found)
        is_exposed = at_end.mean() <= MOST_AT_END and at_end[inside, inside].mean() <= MOST_AT_END / 10.0
        if is_new and is_exposed and part.min() < part.max():
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
