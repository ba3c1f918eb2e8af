"""Opening of recordings: which reader a file needs, and which files make one recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from todframes.errors import DataError
from todframes.frames.files import PathLike
from todframes.recordings import images
from todframes.recordings.recording import Recording, check_rate, natural_order, still_recording


def open_recordings(
    paths: PathLike | Sequence[PathLike], *, frames_per_second: float | None = None
) -> tuple[Recording, ...]:
    """Open recordings; all image files together are one recording, as is each folder of them.

    Parameters
    ----------
    paths : path or sequence of path
        Files and folders.
    frames_per_second : float, optional
        Frame rate in place of what the files say.

    Returns
    -------
    tuple of Recording
        In the order of `paths`; a sequence of images stands where its first image stands.

    Raises
    ------
    DataError
        If there are no files, a folder is empty, or a file cannot be read.
    SettingsError
        If the frame rate is not a positive number.
    """
    check_rate(frames_per_second)
    given = (
        [Path(paths)]
        if isinstance(paths, str) or not isinstance(paths, Sequence)
        else [Path(one) for one in paths]
    )
    if not given:
        raise DataError("recordings: found no path, expected at least one")
    stills = [path for path in given if not path.is_dir()]
    found: list[Recording] = []
    for path in given:
        if path.is_dir():
            files = natural_order(one for one in path.iterdir() if one.is_file() and not one.name.startswith("."))
            if not files:
                raise DataError(f"{path}: the folder is empty, expected image files")
            found.append(_stills(files, path, frames_per_second))
        elif path == stills[0]:
            found.append(_stills(stills, None, frames_per_second))
    return tuple(found)


def _stills(paths: Sequence[Path], folder: Path | None, frames_per_second: float | None) -> Recording:
    for path in paths:
        try:
            with path.open("rb") as file:
                start = file.read(16)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from None
        if images.format_of(start) is None:
            raise DataError(f"{path}: found a file that starts with {start[:8]!r}, expected an image file")
    return still_recording(paths, images, folder=folder, frames_per_second=frames_per_second)
