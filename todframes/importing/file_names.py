"""Datasets from the names of files: `frames/s{size_mrad}_c{contrast}_{orientation}_{n}.png` becomes a manifest."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from todframes.base.errors import DataError, OutputError, SettingsError, argument
from todframes.base.output import output_folder
from todframes.base.reading import checked, number
from todframes.base.safe_text import one_line, visible
from todframes.display.display import LUT_FILE, Display, find_display, table_of_display
from todframes.frames.dataset import MANIFEST_FILE, SETTINGS_FILE, Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.parameters import ColumnName, DisplayName, Pattern
from todframes.recordings.recording import natural_order
from todframes.stimulus import ORIENTATIONS

NUMBERS = ("size_mrad", "x_px", "y_px")
"""Columns of a manifest, beside the level, whose values are numbers."""

ORIENTATION_WORDS = {word: one.value for one in ORIENTATIONS for word in (one.value, one.value[0])}
"""Orientations by the words for them in names of files, in small letters."""

POLARITY_WORDS = {"1": "1", "+1": "1", "pos": "1", "-1": "-1", "neg": "-1"}
"""Polarities by the words for them in names of files, in small letters."""

_FIELD = re.compile(r"\{([^{}]*)\}|(\*)")


class FramesFound(NamedTuple):
    """The number of frames that a manifest was made of, and the names of files beside them that do not match the
    pattern."""

    n_frames: int
    unmatched: tuple[str, ...]


@checked
def new_dataset(
    dataset: Path | str,
    pattern: Pattern,
    *,
    display: Display | DisplayName = "reference_sdr",
    level: ColumnName = "contrast",
) -> FramesFound:
    """Make a folder of frames a dataset: write manifest.csv and dataset.toml from the names of its files.

    A manifest.csv or dataset.toml that is there is not replaced. Files that do not match are listed and left out.

    Parameters
    ----------
    dataset : path
        Folder that exists; the frames are in it or in folders below.
    pattern : str
        Path of the frames relative to the folder, with the columns of the manifest in braces, as in
        'frames/s{size_mrad}_c{contrast}_{orientation}_{n}.png'; * stands for any text. size_mrad is √(area) as
        displayed, in mrad at the eye, and orientation one of up, right, down, left, or its first letter. Numbers
        may be written 0.05, 0,05 or 0p05. Size, orientation and the level have to be in it; any other name becomes
        a column, and columns of a manifest keep their meaning. Neither * nor a name matches a slash.
    display : Display or str
        Display that shows the frames: reference_sdr, reference_linear, srgb_monitor, tod_2001, or a TOML file; all
        are in docs/explanation/displays.md. Its numbers are written into dataset.toml.

        A `Display` is taken as well.
    level : str
        Column with the stimulus strength.

    Returns
    -------
    FramesFound

    Raises
    ------
    SettingsError
        If the pattern lacks a column, or there is no such display.
    DataError
        If no file matches, or a value is wrong.
    OutputError
        If there is a manifest or settings already, or they cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import todframes as tod
    >>> folder = Path(tempfile.mkdtemp())
    >>> for turn in tod.ORIENTATIONS:
    ...     tod.write_frame(folder / f"s4_c0p2_{turn}.png", np.full((48, 48), 0.5))
    >>> tod.new_dataset(folder, "s{size_mrad}_c{contrast}_{orientation}.png")
    FramesFound(n_frames=4, unmatched=())
    >>> (folder / "manifest.csv").read_text().splitlines()[:2]
    ['frame,orientation,size_mrad,contrast', 's4_c0p2_down.png,down,4,0.2']
    """
    folder = Path(dataset)
    if not folder.is_dir():
        raise DataError(f"{folder}: not a folder; expected one with frames")
    group_by = () if level == "size_mrad" else ("size_mrad",)
    experiment = Experiment(level=level, group_by=group_by)
    expression = _expression(pattern, level)
    description = find_display(display)
    shown = description.display
    title = "" if isinstance(display, Display) else f"{display}: {description.title}"
    for name in (SETTINGS_FILE, MANIFEST_FILE, *([] if shown.lut is None else [LUT_FILE])):
        if (folder / name).exists():
            raise OutputError(f"{folder / name}: is there already; move it away or remove it")
    with output_folder(str(folder)) as staged:
        rows, unmatched = [], []
        for file in _files(folder, pattern):
            is_text = file.encode(errors="ignore").decode() == file
            if is_text and (found := expression.fullmatch(file)):
                rows.append({"frame": file, **_values(found.groupdict(), level, f"{folder / file}")})
            else:
                unmatched.append(file)
        if not rows:
            seen = f"such as {visible(unmatched[0])}" if unmatched else "there is none in that folder"
            raise DataError(
                f"{folder}: found no file that matches {pattern} ({seen}); expected the path of the frames, "
                "relative to the dataset"
            )
        table = table_of_display(shown, staged)
        write_dataset_files(staged, rows, display=table, experiment=experiment, comment=one_line(title))
    return FramesFound(len(rows), tuple(unmatched))


def _expression(pattern: str, level: str) -> re.Pattern[str]:
    """Return the regular expression of a pattern, with a group for each column.

    Raises SettingsError if a column is missing, is there twice, or cannot come from a name.
    """
    parts, names, end = [], [], 0
    for field in _FIELD.finditer(pattern):
        parts.append(re.escape(pattern[end : field.start()]))
        end, name = field.end(), field[1]
        if field[2]:
            parts.append("[^/]*?")
            continue
        if not name.isidentifier() or name in ("frame", "sha256", "reference_frame"):
            raise SettingsError(
                f"{argument.pattern}: found {{{name}}}, expected the name of a column, such as {{size_mrad}}"
            )
        if name in names:
            raise SettingsError(f"{argument.pattern}: found {{{name}}} twice, expected each column once")
        names.append(name)
        parts.append(f"(?P<{name}>{_expected(name, level)})")
    parts.append(re.escape(pattern[end:]))
    for name in ("orientation", "size_mrad", level):
        if name not in names:
            found = ", ".join(f"{{{one}}}" for one in names) or "no names in braces"
            hint = f"; {argument.level} names another one" if name == level != "size_mrad" else ""
            raise SettingsError(f"{argument.pattern}: {{{name}}} is missing in {pattern}; found {found}{hint}")
    return re.compile("".join(parts))


def _expected(name: str, level: str) -> str:
    """Return the regular expression of a column's values in names of files."""
    if name in (*NUMBERS, level):
        return r"[+-]?[0-9]+(?:[.,p][0-9]+)?(?:e[+-]?[0-9]+)?"
    words = {"orientation": ORIENTATION_WORDS, "polarity": POLARITY_WORDS}.get(name)
    if words is None:
        return "[^/]+?"
    return "(?i:" + "|".join(map(re.escape, sorted(words, key=len, reverse=True))) + ")"


def _values(texts: Mapping[str, str], level: str, where: str) -> dict[str, str]:
    """Return the columns of a row from the texts in a file's name, those with a meaning first."""
    values = {**{name: texts[name] for name in ("orientation", "size_mrad", level)}, **texts}
    values["orientation"] = ORIENTATION_WORDS[values["orientation"].lower()]
    if "polarity" in values:
        values["polarity"] = POLARITY_WORDS[values["polarity"].lower()]
    for name in (*NUMBERS, level):
        if name in values:
            values[name] = values[name].replace("p", ".").replace(",", ".")
            number(values[name], f"{where}: {name}", positive=name in ("size_mrad", level))
    if "trial" in values:  # numbers of trials may begin again with each stimulus
        shown = ("orientation", "size_mrad", level, "x_px", "y_px", "polarity", "trial")
        values["trial"] = " ".join(values[name] for name in dict.fromkeys(shown) if name in values)
    return values


def _files(folder: Path, pattern: str) -> list[str]:
    """Return the paths of the files that a pattern may mean, relative to the folder: numbers in their order."""
    found: set[str] = set()
    for parent, folders, files in os.walk(folder / _FIELD.split(pattern)[0].rpartition("/")[0]):
        folders[:] = [name for name in folders if not name.startswith(".")]
        inside = os.path.relpath(parent, folder)
        found |= {Path(inside, name).as_posix() for name in files if not name.startswith(".")}
    return natural_order(found - {SETTINGS_FILE, MANIFEST_FILE})
