"""A dataset on disk: `dataset.toml` and `manifest.csv` to checked trials."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from todframes.display import Display, LuminanceTable
from todframes.errors import DataError, SettingsError
from todframes.readout import Stimulus
from todframes.settings import check_keys, from_table, number, number_or_text, read_text, read_toml
from todframes.stimulus import ORIENTATIONS, Orientation

SCHEMA = 1
BACKGROUND_COLUMN = "background_luminance_cd_m2"


class FrameReference(NamedTuple):
    """A frame as the manifest names it: path relative to the dataset, and what its row says of the pixels."""

    path: str
    sha256: str | None
    background_luminance_cd_m2: float | None


class Trial(NamedTuple):
    """One presentation: the frames to average, what they show and where.

    `number` is that of the first frame's row in the manifest and seeds the trial's random stream. `x_px` and
    `y_px` are where the triangle's centroid lies; None: the frame's centre. `group` has a value for each
    `group_by`.
    """

    number: int
    name: str
    frames: tuple[FrameReference, ...]
    orientation: Orientation
    stimulus: Stimulus
    level: float
    group: tuple[float | str, ...]
    x_px: float | None
    y_px: float | None


class Skipped(NamedTuple):
    """A frame, or a row of the manifest, that cannot be used, and why."""

    frame: str
    error: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What was varied: the manifest column with the stimulus strength, and those with one curve a value."""

    level: str
    group_by: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Dataset:
    """A folder of frames whose settings and manifest have been read; `bad_rows` are left out of `trials`."""

    path: Path
    display: Display
    experiment: Experiment
    trials: tuple[Trial, ...]
    bad_rows: tuple[Skipped, ...]

    def frame_path(self, frame: FrameReference) -> Path:
        """Where the frame is on disk."""
        return self.path / frame.path


def load_dataset(path: Path | str) -> Dataset:
    """Read and check `dataset.toml` and `manifest.csv`; no frame is opened.

    Raises
    ------
    SettingsError
        If `dataset.toml` has an unknown, missing or contradictory key.
    DataError
        If a file is missing or unreadable, a column is missing, or there is no frame at all. A row that is
        wrong raises nothing: it goes to `bad_rows`.
    """
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: not a folder; expected a dataset with dataset.toml and manifest.csv")
    display, experiment = _read_settings(path / "dataset.toml")
    manifest = _Manifest(path, display, experiment)
    trials = manifest.trials()
    if not trials and not manifest.bad_rows:
        raise DataError(f"{manifest.path}: no frames; expected a row a frame below the header")
    return Dataset(path, display, experiment, trials, tuple(manifest.bad_rows))


def _read_settings(path: Path) -> tuple[Display, Experiment]:
    content = read_toml(path)
    check_keys(content, ["schema", "display", "experiment"], str(path))
    if content.get("schema") != SCHEMA:
        raise SettingsError(f"{path}: schema: found {content.get('schema')!r}, expected {SCHEMA}")
    for name in ("display", "experiment"):
        if not isinstance(content.get(name), dict):
            raise SettingsError(f"{path}: table [{name}] is missing")
    table = content["display"]
    if "white_luminance_cd_m2" not in table and table.get("eotf") != "lut":
        raise SettingsError(f"{path}: [display]: white_luminance_cd_m2 is missing")
    if isinstance(table.get("lut"), str):
        table["lut"] = _read_lut(path.parent / table["lut"])
    display = from_table(table, Display, f"{path}: [display]")
    return display, from_table(content["experiment"], Experiment, f"{path}: [experiment]")


def _read_lut(path: Path) -> LuminanceTable:
    columns = ("code_value", "luminance_cd_m2")
    reader = csv.DictReader(io.StringIO(read_text(path)))
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise DataError(f"{path}: column {missing[0]} is missing")
    rows = [
        [number(row[name] or "", f"{path}, line {reader.line_num}: {name}") for name in columns] for row in reader
    ]
    code, luminance = np.array(rows, dtype=np.float64).reshape(-1, 2).T
    try:
        return LuminanceTable(code, luminance)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None


class _Manifest:
    """Reads the rows, gathers frames into trials, and keeps what is wrong with which row."""

    def __init__(self, folder: Path, display: Display, experiment: Experiment) -> None:
        self.folder = folder.resolve()
        self.path = folder / "manifest.csv"
        self.experiment = experiment
        self.needs_background = display.background_luminance_cd_m2 == "column"
        self.bad_rows: list[Skipped] = []

    def trials(self) -> tuple[Trial, ...]:
        reader = csv.DictReader(io.StringIO(read_text(self.path)), strict=True)
        trials: dict[str, Trial] = {}
        spoilt: set[str] = set()
        seen: dict[str, int] = {}
        try:
            self._check_columns(reader.fieldnames or ())
            for row_number, row in enumerate(reader):
                where = f"{self.path}, line {reader.line_num}"
                name = (row.get("trial") or row.get("frame") or "").strip()
                try:
                    trial = self._trial(row, where, seen, reader.line_num, row_number)
                    if name in trials:
                        trial = _joined(trials[name], trial, where)
                    trials[name] = trial
                except DataError as error:
                    self.bad_rows.append(Skipped((row.get("frame") or "").strip(), str(error)))
                    spoilt.add(name)
        except csv.Error as error:
            raise DataError(f"{self.path}, line {reader.line_num}: not valid CSV ({error})") from None
        # A trial that lost one of its frames would be averaged over fewer than the others.
        return tuple(trial for name, trial in trials.items() if name not in spoilt)

    def _check_columns(self, found: Any) -> None:
        needed = ["frame", "orientation", "size_mrad", self.experiment.level, *self.experiment.group_by]
        if self.needs_background:
            needed.append(BACKGROUND_COLUMN)
        for name in needed:
            if name not in found:
                raise DataError(f"{self.path}: column {name!r} is missing; found {', '.join(found) or 'none'}")
        if ("x_px" in found) != ("y_px" in found):
            raise DataError(f"{self.path}: found one of the columns x_px and y_px, expected both or none")

    def _trial(
        self, row: Mapping[str, Any], where: str, seen: dict[str, int], line: int, row_number: int
    ) -> Trial:
        if None in row or None in row.values():
            raise DataError(f"{where}: found more or fewer fields than the header has")
        frame = self._frame_path(row["frame"].strip(), where)
        if seen.setdefault(frame, line) != line:
            raise DataError(f"{where}: frame {frame} is there already, in line {seen[frame]}")
        orientation = row["orientation"].strip()
        if orientation not in ORIENTATIONS:
            raise DataError(f"{where}: orientation: found {orientation!r}, expected up, right, down or left")
        polarity = (row.get("polarity") or "1").strip()
        if polarity not in ("1", "+1", "-1"):
            raise DataError(f"{where}: polarity: found {polarity!r}, expected 1 or -1")
        place = [
            number(row[name], f"{where}: {name}") if (row.get(name) or "").strip() else None
            for name in ("x_px", "y_px")
        ]
        if place.count(None) == 1:
            raise DataError(f"{where}: found one of x_px and y_px, expected both or none")
        background = (
            number(row[BACKGROUND_COLUMN], f"{where}: {BACKGROUND_COLUMN}", positive=True)
            if self.needs_background
            else None
        )
        sha256 = (row.get("sha256") or "").strip().lower() or None
        return Trial(
            number=row_number,
            name=(row.get("trial") or "").strip() or frame,
            frames=(FrameReference(frame, sha256, background),),
            orientation=Orientation(orientation),
            stimulus=Stimulus(number(row["size_mrad"], f"{where}: size_mrad", positive=True), int(polarity)),
            level=number(row[self.experiment.level], f"{where}: {self.experiment.level}", positive=True),
            group=tuple(number_or_text(row[name]) for name in self.experiment.group_by),
            x_px=place[0],
            y_px=place[1],
        )

    def _frame_path(self, frame: str, where: str) -> str:
        if not frame or "\0" in frame:
            raise DataError(f"{where}: frame: found {frame!r}, expected a path")
        if Path(frame).is_absolute() or not (self.folder / frame).resolve().is_relative_to(self.folder):
            raise DataError(f"{where}: frame {frame} lies outside of the dataset")
        return frame


def _joined(first: Trial, other: Trial, where: str) -> Trial:
    """A trial with one frame more; everything but the frame must agree."""
    if first[3:] != other[3:]:
        names = [name for name in Trial._fields[3:] if getattr(first, name) != getattr(other, name)]
        raise DataError(f"{where}: {names[0]} is not that of the other frames of trial {first.name!r}")
    return first._replace(frames=first.frames + other.frames)
