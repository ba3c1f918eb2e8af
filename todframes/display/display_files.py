"""Descriptions of displays: the table [display] of a dataset, the displays of this package, and files with the
same table, and `title` and `source`, where the background is the surround of the triangle unless the file says
otherwise. A SENSOR.toml describes the display of signals.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import (
    SETTINGS_SUFFIX,
    check_keys,
    from_table,
    path_inside,
    read_described,
    read_numbers,
    read_toml,
    settings_path,
    table_beside,
)
from todframes.base.safe_text import csv_text
from todframes.display.display import Display, LuminanceTable

if TYPE_CHECKING:
    from todframes.display.sensor_display import SignalDisplay

SCHEMA = 1
"""Version of the format of display files that this package reads."""

LUT_FILE = "lut.csv"
"""Name that a display's table of luminances gets in a dataset."""

SENSOR_TABLES = {"optics", "detector"}
"""Tables of a SENSOR.toml that a display's file has not."""

FOLDER = Path(__file__).with_name("displays")


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplayDescription:
    """A display with its name and the source of its numbers. `of_signals` is what a SENSOR.toml says besides."""

    display: Display
    title: str = ""
    source: str = ""
    of_signals: SignalDisplay | None = None


def find_display(
    asked: Display | Path | str, *, where: str = "display", folder: Path | None = None
) -> DisplayDescription:
    """Return the display given, that of this package with a name, or that of a file that ends with ".toml", which
    is relative to `folder`, that of a dataset, and may not leave it. SettingsError, which begins with `where`, if
    there is none, or its file cannot be read or has a wrong value.
    """
    if isinstance(asked, Display):
        return DisplayDescription(display=asked)
    if folder is None or not str(asked).endswith(SETTINGS_SUFFIX):
        return read_display(settings_path(asked, FOLDER, where))
    try:
        path_inside(os.path.realpath(folder), str(asked), f"{where}:")
    except DataError as error:
        raise SettingsError(str(error)) from None
    return read_display(folder / asked)


def read_display(path: Path) -> DisplayDescription:
    """Return the display that a TOML file describes, a display's or a SENSOR.toml; the path of its LUT is relative
    to the file's folder. SettingsError if the file cannot be read or has a wrong value.
    """
    content = read_toml(path)
    if SENSOR_TABLES & content.keys():
        from todframes.display.sensor_display import read_signal_display

        of_signals = read_signal_display(content, str(path))
        title = f"that of the sensor {content.get('name', '')}".rstrip()
        return DisplayDescription(display=of_signals.display, title=title, of_signals=of_signals)
    table, texts = read_described(path, "display", SCHEMA)
    table = {"background_luminance_cd_m2": "surround"} | table
    display = display_of_table(table, f"{path}: [display]", path.parent)
    return DisplayDescription(display=display, title=texts["title"], source=texts["source"])


def display_of_table(table: Mapping[str, Any], where: str, folder: Path) -> Display:
    """Return the display that a table [display] describes. The path of a LUT is relative to `folder` and may not
    leave it. SettingsError, which begins with `where`, if a key is unknown or missing, a value is refused, or the
    LUT cannot be read.
    """
    check_keys(table, [field.name for field in fields(Display)], where)
    table, eotf = dict(table), table.get("eotf")
    if eotf == "lut":  # luminances of a table are absolute
        table.pop("white_luminance_cd_m2", None)
        table.pop("black_luminance_cd_m2", None)
    elif "white_luminance_cd_m2" not in table:
        raise SettingsError(f"{where}: white_luminance_cd_m2 is missing")
    if "lut" in table:
        if eotf != "lut":
            raise SettingsError(f"{where}: lut: is given but not used with eotf = {eotf!r}")
        table["lut"] = _read_lut(folder, table["lut"], f"{where}: lut")
    return from_table(table, Display, where)


def table_of_display(display: Display, folder: Path) -> dict[str, object]:
    """Return a display as the table [display] of a dataset; write its LUT, if it has one, into the folder."""
    values: dict[str, object] = {field.name: getattr(display, field.name) for field in fields(display)}
    if display.lut is not None:
        columns = display.lut.code_value.tolist(), display.lut.luminance_cd_m2.tolist()
        text = csv_text([("code_value", "luminance_cd_m2"), *zip(*columns, strict=True)])
        (folder / LUT_FILE).write_text(text, encoding="utf-8")
        values |= {"white_luminance_cd_m2": None, "black_luminance_cd_m2": None, "lut": LUT_FILE}
    return values


def _read_lut(folder: Path, name: object, where: str) -> LuminanceTable:
    with table_beside(name, folder, where) as path:
        values = read_numbers(path, ("code_value", "luminance_cd_m2"))
    code, luminance = np.array(values, dtype=np.float64).reshape(-1, 2).T
    try:
        return LuminanceTable(code, luminance)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
