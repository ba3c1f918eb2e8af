"""Images that triangles are placed on: files, folders and the photographs of scikit-image, as luminance."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import spelling_hint
from todframes.display.display import Display
from todframes.parameters import PathLike
from todframes.recordings.opening import NoReaderError, open_recordings
from todframes.recordings.recording import CodeRange, Recording, code_range, files_in

PHOTOGRAPHS = (
    *("astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "coins.png", "grass.png"),
    *("gravel.png", "hubble_deep_field.jpg", "moon.png", "motorcycle_left.png", "rocket.jpg"),
)
"""Photographs that every installation of scikit-image has."""

PACKAGED = "skimage"
"""Name that stands for these photographs in place of a path; `skimage:camera,brick` for some of them."""


class SceneFile(NamedTuple):
    """A recording that scenes are taken from: its name in the manifest and the values of black and white."""

    scene: str
    recording: Recording
    scale: CodeRange


class SceneImage(NamedTuple):
    """A frame of a recording, counted from 0, as luminance of shape (rows, columns).

    `at_end` marks the pixels with a channel at black, white or an end of the display's LUT, or beyond. `used` is
    the share of the range from black to white that the values of the frame are spread over.
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
    note: Callable[[str], None] | None = None,
) -> list[SceneFile]:
    """Open the files of scenes; each image file, film or array is a scene with the name of its file.

    `paths` are files, folders, and "skimage" or "skimage:camera,brick" for photographs of scikit-image.
    `range_name` is the argument that has the recorded values of black and white, for the message of an error.
    `note` is called with a remark about files of a folder that are no recordings, and with the warnings of
    recordings.

    Raises DataError or FrameError if a file cannot be read, or a folder has no recording, and SettingsError if
    values have no black and white and no range is given.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not given:
        raise DataError("backgrounds: found no path, expected at least one")
    opened: list[Recording] = []
    for path in given:
        name = os.fspath(path)
        if name.partition(":")[0] == PACKAGED and not Path(name).exists():
            opened += [_opened(one, max_frame_mb) for one in _photographs(name)]
        elif Path(name).is_dir():
            opened += _of_folder(Path(name), max_frame_mb, note)
        else:
            opened.append(_opened(Path(name), max_frame_mb))
    files: dict[str, SceneFile] = {}
    for recording in opened:
        path, scene = recording.path, recording.path.stem
        for code, message in recording.warnings:
            if note is not None and code != "lossy_compression":  # any picture may be behind a triangle
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


def _of_folder(folder: Path, max_frame_mb: int, note: Callable[[str], None] | None) -> list[Recording]:
    """Open each recording of a folder; files of other kinds are left out."""
    found, others = [], []
    for path in files_in(folder):
        try:
            found.append(_opened(path, max_frame_mb))
        except NoReaderError:
            others.append(path.name)
    if not found:
        what = f"only {', '.join(others[:3])}" if others else "no files"
        raise DataError(f"{folder}: found {what}, expected images or other recordings")
    if others and note is not None:
        names = ", ".join(others[:3]) + (", …" if len(others) > 3 else "")
        note(f"{folder}: left out {names}, no {'recordings' if len(others) > 1 else 'recording'}")
    return found


def _opened(path: Path, max_frame_mb: int) -> Recording:
    (recording,) = open_recordings([path], max_frame_mb=max_frame_mb)
    return recording


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
    """The inverse of a display: luminance to code values of 16 bits.

    Raises SettingsError if the luminance of the display does not rise with the code value.
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
