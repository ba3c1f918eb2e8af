"""Datasets on disk: `dataset.toml` and `manifest.csv` are read into checked trials."""

from __future__ import annotations

import difflib
import os
import re
import shlex
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.base.reading import (
    check_columns,
    check_time,
    check_values,
    checked,
    convert,
    from_table,
    number,
    number_or_text,
    path_inside,
    read_csv,
    read_toml,
    spelling_hint,
    without_schema,
)
from todframes.base.safe_text import in_utf8
from todframes.display.display import Display, display_of_table, find_display
from todframes.frames.files import FrameFile, FrameSource, check_max_frame_mb, frame_sha256, has_own_checksums
from todframes.frames.trials import FrameReference, Group, SceneView, Trial, Trials, joined, with_frames
from todframes.parameters import MAX_FRAME_MB, FrameLimit, Gaze
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus

SCHEMA = 1
"""Version of the format of `dataset.toml` that this package reads."""

SETTINGS_FILE, MANIFEST_FILE = "dataset.toml", "manifest.csv"
"""Files that make a folder of frames a dataset."""

BACKGROUND_COLUMN, REFERENCE_COLUMN = "background_luminance_cd_m2", "reference_frame"
"""Names of the manifest columns with each frame's background luminance and the path of the same without noise."""

SCENE_COLUMNS = ("scene", "scene_turn", "scene_window")
"""Names of the manifest columns with the image behind the triangle, how it is turned and mirrored, and which part
of it is shown."""

CLIP_COLUMN, TIME_COLUMN, JUDGED_COLUMN = "clip", "time_s", "judged"
"""Names of the manifest columns with a frame's continuous recording, its time there, and whether it is judged."""

OPTIONAL_COLUMNS = (
    *(
        "x_px",
        "y_px",
        "polarity",
        "trial",
        "sha256",
        BACKGROUND_COLUMN,
        REFERENCE_COLUMN,
        CLIP_COLUMN,
        TIME_COLUMN,
    ),
    *(JUDGED_COLUMN, *SCENE_COLUMNS),
)
NEAR = 0.85
"""Likeness from which the name of a column is taken for a misspelt one."""

ORIENTATION_OF = {orientation.value: orientation for orientation in ORIENTATIONS}

MOST_ROWS, MOST_BAD_ROWS = 20_000_000, 100_000
"""Largest number of rows of a manifest, and of those that cannot be used: each has a message."""


class Skipped(NamedTuple):
    """A frame or a row of the manifest that cannot be used, with the reason."""

    frame: str
    error: str


WarningCode = Literal[
    "above_contrast_1", "background_mismatch", "background_uneven", "below_chance", "bit_depth",
    "channels_chosen", "coarse_codes", "contrast_mismatch", "crushed", "displacement_varies", "edge_brightness",
    "falling_answers", "flipped", "group_left_out", "levels_to_add", "lossy_compression", "metadata_ignored",
    "mirrored", "mixed_frame_sizes", "mixed_sizes", "not_proportional", "not_repeatable", "numerical_error",
    "orientation_mismatch", "polarity_mismatch", "position_offset", "position_scatter", "saturated",
    "sensor_mismatch", "size_mismatch", "size_unit", "turned", "unverified_frames",
]  # fmt: skip
"""Codes of all warnings; each is explained in docs/reference/warnings.md."""


class DatasetWarning(NamedTuple):
    """A warning about a dataset, which makes its results less certain; `warnings` in `result.json` has it. `code`
    is for programs, `message` for people. `group` has the `group_by` values of the group concerned, by column; it
    is empty if the warning concerns the whole dataset.
    """

    code: WarningCode
    group: dict[str, float | str]
    message: str
    found: float | tuple[float, float]
    expected: float | tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """The varied manifest columns: `level` is the stimulus strength, each group of `group_by` has a curve."""

    level: str
    group_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_values(self)
        for name in (self.level, *self.group_by):
            if not name.strip():
                raise SettingsError(f"level, group_by: found {name!r}, expected the name of a manifest column")
        if len(set(self.group_by)) < len(self.group_by):
            raise SettingsError(f"group_by: found {', '.join(self.group_by)}, expected each column once")
        if self.level in self.group_by:
            raise SettingsError(f"group_by: found {self.level!r}, which is the level; expected other columns")


@dataclass(frozen=True, slots=True)
class Dataset:
    """A folder of frames whose settings and manifest have been read.

    Attributes
    ----------
    path : path
        The folder.
    display : Display
    experiment : Experiment
        The level, and the columns that group trials.
    trials : Trials
        All trials, in the order of the manifest; may be given as any sequence of `Trial`.
    bad_rows : tuple of Skipped
        Rows of the manifest that are wrong, and the reasons. They are in no trial.
    spoilt : frozenset of str
        Names of trials that have lost a frame to a bad row. They are averaged over fewer frames than the others
        and must not be scored.
    manifest_sha256 : str or None
        Checksum of `manifest.csv`; None for frames in memory.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes.
    gaze : {"tracked", "fixed"}
        Where the observer looks in trials with moving triangles.
    """

    path: Path
    display: Display
    experiment: Experiment
    trials: Trials
    bad_rows: tuple[Skipped, ...]
    spoilt: frozenset[str]
    manifest_sha256: str | None
    max_frame_mb: int = field(default=MAX_FRAME_MB, kw_only=True)
    gaze: Gaze = field(default="tracked", kw_only=True)

    def __post_init__(self) -> None:
        convert(self.gaze, Gaze, "gaze")
        object.__setattr__(self, "trials", Trials.of(self.trials))

    @property
    def is_in_memory(self) -> bool:
        """True if the frames are arrays, and in no file."""
        return self.manifest_sha256 is None

    @property
    def n_frames(self) -> int:
        """Number of frames in the manifest, those in bad rows and those that are not judged included."""
        return self.trials.n_frames + len(self.trials.unjudged_frames) + len(self.bad_rows)

    def frame_path(self, frame: FrameReference) -> Path:
        """Return the path of the frame."""
        return self.path / frame.path

    def has_frame(self, frame: FrameReference) -> bool:
        """Return whether the frame's file exists."""
        # A million paths take seconds; as Path objects, half a minute.
        return os.path.exists(os.path.join(str(self.path), frame.path))  # noqa: PTH110, PTH118

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:
        """Open a frame; raise FrameError if it cannot be used.

        With `verify`, it must have the checksum that the manifest gives, if it gives one.
        """
        sha256 = frame.sha256 if verify else None
        return FrameFile(self.frame_path(frame), sha256=sha256, max_frame_mb=self.max_frame_mb)

    def reference_path(self, frame: FrameReference) -> Path | None:
        """Return the path of the same frame without noise; None if there is none."""
        return None if frame.reference is None else self.path / frame.reference


@checked
def load_dataset(path: Path | str, *, max_frame_mb: FrameLimit = MAX_FRAME_MB) -> Dataset:
    """Read and check `dataset.toml` and `manifest.csv`; no frame is opened.

    Parameters
    ----------
    path : path or str
        The dataset's folder.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types; a larger one is
        refused before it is decoded.

    Returns
    -------
    Dataset

    Raises
    ------
    SettingsError
        If `dataset.toml` is missing or unreadable, or has an unknown, missing or contradictory key; or if the
        limit is no whole number > 0.
    DataError
        If the manifest is missing or unreadable, a column is missing, or there is no frame at all. A wrong row
        raises nothing: it goes to `bad_rows`.

    Examples
    --------
    >>> import todframes as tod
    >>> data = tod.load_dataset("sample_frames/naked_eye")
    >>> len(data.trials), data.display.background_luminance_cd_m2
    (336, 22.0)
    """
    path = Path(path)
    check_max_frame_mb(max_frame_mb)
    if not os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises for a name that is too long
        if re.match("[A-Za-z][A-Za-z0-9+.-]+:/", str(path)):  # it may hold a password, which no message shows
            raise DataError(
                "dataset: found a URL, expected a folder; mount it (rclone mount, sshfs) or synchronise it "
                "(rclone sync, aws s3 sync), and give the folder"
            )
        raise DataError(f"{path}: not a folder; expected a dataset with dataset.toml and manifest.csv")
    display, experiment = _read_settings(path / SETTINGS_FILE)
    manifest = Manifest(path, display, experiment)
    trials = manifest.read()
    if not trials and not manifest.bad_rows:
        raise DataError(f"{manifest.path}: no frames; expected a row a frame below the header")
    return Dataset(
        path=path,
        display=display,
        experiment=experiment,
        trials=trials,
        bad_rows=tuple(manifest.bad_rows),
        spoilt=frozenset(manifest.spoilt),
        manifest_sha256=frame_sha256(manifest.path),
        max_frame_mb=max_frame_mb,
    )


def _read_settings(path: Path) -> tuple[Display, Experiment]:
    try:
        path_inside(os.path.realpath(path.parent), path.name, f"{path}:")
    except DataError as error:
        raise SettingsError(str(error)) from None
    content = without_schema(read_toml(path), SCHEMA, ["display", "experiment"], str(path))
    asked, experiment = content.get("display"), content.get("experiment")
    if not isinstance(experiment, dict):
        raise SettingsError(f"{path}: table [experiment] is missing")
    if experiment.pop("places", 1) != 1:
        raise SettingsError(
            f"{path}: [experiment]: found places, which this version no longer knows; remove the key: the "
            "observer then knows where the triangle is, and thresholds are lower"
        )
    if isinstance(asked, str):
        display = find_display(asked, where=f"{path}: display", folder=path.parent).display
    elif isinstance(asked, dict):
        display = display_of_table(asked, f"{path}: [display]", path.parent)
    else:
        raise SettingsError(
            f'{path}: table [display] is missing; expected it, or display = "NAME or FILE.toml" above all tables'
        )
    return display, from_table(experiment, Experiment, f"{path}: [experiment]")


def orientation_in(row: Mapping[str, str], where: str) -> Orientation:
    """Return the orientation in a row of a CSV file; `DataError` begins with `where`."""
    text = row["orientation"].strip()
    if text not in ORIENTATION_OF:
        hint = spelling_hint(text, ORIENTATIONS)
        raise DataError(f"{where}: orientation: found {text!r}, expected up, right, down or left{hint}")
    return ORIENTATION_OF[text]


def polarity_in(row: Mapping[str, str], where: str) -> int:
    """Return the polarity in a row of a CSV file, 1 if there is none; `DataError` begins with `where`."""
    text = row.get("polarity", "").strip() or "1"
    if text not in ("1", "+1", "-1"):
        raise DataError(f"{where}: polarity: found {text!r}, expected 1 or -1")
    return int(text)


def pair_in(
    row: Mapping[str, str], where: str, first: str, second: str
) -> tuple[float, float] | tuple[None, None]:
    """Return the numbers in two columns of a row, or None for both; `DataError` begins with `where`."""
    texts = row.get(first, "").strip(), row.get(second, "").strip()
    if not any(texts):
        return None, None
    if not all(texts):
        raise DataError(f"{where}: found one of {first} and {second}, expected both or none")
    return number(texts[0], f"{where}: {first}"), number(texts[1], f"{where}: {second}")


class Manifest:
    """Reader of the rows of a manifest: it checks them, and gathers frames into trials. Without a folder, frames
    are in no file, and their names are not paths. The columns `texts` hold texts, even if these look like numbers.
    """

    def __init__(
        self, folder: Path | None, display: Display, experiment: Experiment, *, texts: Set[str] = frozenset()
    ) -> None:
        self.folder = None if folder is None else os.path.realpath(folder)
        self.path = Path("in memory") if folder is None else folder / MANIFEST_FILE
        self.experiment = experiment
        self.texts = texts
        self.needs_background = display.background_luminance_cd_m2 == "column"
        self.bad_rows: list[Skipped] = []
        self.spoilt: set[str] = set()
        self.real_folders: dict[str, str] = {}
        # Equal ones are the same object, which saves memory.
        self.stimuli: dict[tuple[str, int], Stimulus] = {}
        self.groups: dict[tuple[str, ...], Group] = {}
        self.numbers: dict[str, float] = {}
        self.gathered: list[Trial] = []
        self.other_frames: dict[int, list[FrameReference]] = {}
        self.unjudged: list[FrameReference] = []
        self.index_of: dict[str, int] = {}
        # The line of each real path, so that no frame is there twice.
        self.lines: dict[str, int] = {}
        # The time of each clip's last frame, and how often a bad row has broken the clip.
        self.last_s: dict[str, float] = {}
        self.n_breaks: dict[str, int] = {}

    def read(self) -> Trials:
        """Return the trials of the file; bad rows are recorded in place of an exception."""
        assert self.folder is not None
        path_inside(self.folder, self.path.name, f"{self.path}:")
        rows = read_csv(self.path, most_rows=MOST_ROWS)
        self.check_columns(next(rows).texts)
        for number_of_row, (where, row, problem) in enumerate(rows):
            try:
                if problem:
                    raise DataError(problem)
                self.add(row, where, number_of_row)
            except DataError as error:
                if len(self.bad_rows) == MOST_BAD_ROWS:
                    raise DataError(
                        f"{self.path}: found more than {MOST_BAD_ROWS} bad rows, the last: {error}"
                    ) from None
                self.bad_rows.append(Skipped((row.get("frame") or "").strip(), str(error)))
                if name := (row.get("trial") or "").strip():
                    self.spoilt.add(name)
                if clip := (row.get(CLIP_COLUMN) or "").strip():
                    self.n_breaks[clip] = self.n_breaks.get(clip, 0) + 1
        return self.trials()

    def trials(self) -> Trials:
        """Return the trials of all rows that were added."""
        for index, others in self.other_frames.items():
            self.gathered[index] = with_frames(self.gathered[index], others)
        return Trials.of(self.gathered, self.unjudged)

    def add(self, row: Mapping[str, str], where: str, row_number: int) -> None:
        """Add the frame of a row; raise DataError, whose message begins with `where`, if the row is wrong."""
        trial, n = self._trial(row, where, row_number), len(self.gathered)
        if not self._is_judged(row, where):
            self.unjudged.append(trial.frames[0])
            return
        # Without a column of trials, no two frames have the same name.
        index = self.index_of.setdefault(trial.name, n) if "trial" in row else n
        if index == n:
            self.gathered.append(trial)
            return
        first = self.gathered[index]
        trial, frame = joined(first, trial)
        self._check_joined(first, trial, where)
        if frame.clip != (clip := first.frames[0].clip) and first.name not in self.spoilt:
            raise DataError(
                f"{where}: {CLIP_COLUMN}: found {frame.clip}, expected {clip} as in the other frames of trial "
                f"{first.name!r}"
            )
        self.other_frames.setdefault(index, []).append(frame)

    def check_columns(self, columns: Mapping[str, object]) -> None:
        """Raise DataError if a column is missing."""
        needed = ["frame", "orientation", "size_mrad", self.experiment.level, *self.experiment.group_by]
        if self.needs_background:
            needed.append(BACKGROUND_COLUMN)
        check_columns(columns, needed, self.path)
        for name in columns:
            near = difflib.get_close_matches(name.lower(), OPTIONAL_COLUMNS, 1, NEAR)
            meant = "scene" if name == "background" else near[0] if near else name
            if name not in {meant, *OPTIONAL_COLUMNS, *needed}:
                raise DataError(
                    f"{self.path}: column {name!r}: is like {meant!r} and would not be used; write {meant}, or "
                    "another name"
                )
        if ("x_px" in columns) != ("y_px" in columns):
            raise DataError(f"{self.path}: found one of the columns x_px and y_px, expected both or none")
        for name, needs in ((CLIP_COLUMN, TIME_COLUMN), (JUDGED_COLUMN, CLIP_COLUMN)):
            if name in columns and needs not in columns:
                raise DataError(f"{self.path}: found the column {name} without {needs}, expected both or none")

    def _trial(self, row: Mapping[str, str], where: str, row_number: int) -> Trial:
        frame = self._frame_path(row["frame"].strip(), where)
        orientation, polarity = orientation_in(row, where), polarity_in(row, where)
        x_px, y_px = pair_in(row, where, "x_px", "y_px")
        background = (
            self._positive(row[BACKGROUND_COLUMN], where, BACKGROUND_COLUMN) if self.needs_background else None
        )
        view = self._view(row, where)
        sha256 = (row.get("sha256") or "").strip().lower() or None
        reference = (row.get(REFERENCE_COLUMN) or "").strip() or None
        if reference is not None and self.folder is not None:
            path_inside(self.folder, reference, f"{where}: {REFERENCE_COLUMN}", self.real_folders)
        clip, time_s = self._clip(row, where)
        return Trial(
            number=row_number,
            name=(row.get("trial") or "").strip() or frame,
            frames=(FrameReference(frame, sha256, background, reference, clip, time_s),),
            orientation=orientation,
            stimulus=self._stimulus(row["size_mrad"], polarity, where),
            level=self._positive(row[self.experiment.level], where, self.experiment.level),
            group=self._group(row),
            x_px=x_px,
            y_px=y_px,
            view=view,
        )

    def _view(self, row: Mapping[str, str], where: str) -> SceneView | None:
        """Return the scene of a row; None if it has none."""
        view = SceneView(*((row.get(name) or "").strip() for name in SCENE_COLUMNS))
        if not view.scene and any(view):
            raise DataError(f"{where}: scene: found none beside a turn or a window, expected its name")
        return view if view.scene else None

    def _clip(self, row: Mapping[str, str], where: str) -> tuple[str | None, float | None]:
        """Return the clip of a row and its time there; the rows of a clip must stand in the order of time. A bad
        row breaks a clip in two: its frame is missing between those before and after it.
        """
        clip = (row.get(CLIP_COLUMN) or "").strip()
        if not clip:
            return None, None
        if not row[TIME_COLUMN].strip():
            raise DataError(f"{where}: found clip {clip!r} without {TIME_COLUMN}, expected both or none")
        time_s = check_time(f"{where}: {TIME_COLUMN}", number(row[TIME_COLUMN], f"{where}: {TIME_COLUMN}"))
        last_s = self.last_s.get(clip)
        if last_s is not None and time_s <= last_s:
            raise DataError(
                f"{where}: {TIME_COLUMN}: found {time_s:g}, expected more than {last_s:g}, the time of the frame "
                f"before it in clip {clip!r}"
            )
        self.last_s[clip] = time_s
        n_breaks = self.n_breaks.get(clip, 0)
        return f"{clip} after bad row {n_breaks}" if n_breaks else clip, time_s

    def _is_judged(self, row: Mapping[str, str], where: str) -> bool:
        """Return whether a row's frame is in a trial; otherwise it only comes before one in its clip."""
        text = (row.get(JUDGED_COLUMN) or "1").strip()
        if text not in ("0", "1"):
            raise DataError(f"{where}: {JUDGED_COLUMN}: found {text!r}, expected 1 or 0")
        if text == "0" and not row[CLIP_COLUMN].strip():
            raise DataError(f"{where}: {JUDGED_COLUMN}: found 0 without a clip, expected the clip it belongs to")
        return text == "1"

    def _frame_path(self, frame: str, where: str) -> str:
        if self.folder is None:
            return frame
        if os.sep == "/" and "\\" in frame and not os.path.lexists(os.path.join(self.folder, frame)):  # noqa: PTH118
            written = frame.replace("\\", "/")
            raise DataError(f"{where}: frame: found {frame} with backslashes, expected slashes: {written}")
        path = path_inside(self.folder, frame, f"{where}: frame", self.real_folders)
        inside = path.removeprefix(f"{self.folder}{os.sep}")
        inside = frame if inside == frame else inside  # one text in memory
        if inside in self.lines:
            raise DataError(f"{where}: frame {frame} is there already, in line {self.lines[inside]}")
        self.lines[inside] = int(where.rpartition(" ")[2])
        return frame

    def _stimulus(self, size: str, polarity: int, where: str) -> Stimulus:
        if (size, polarity) not in self.stimuli:
            self.stimuli[size, polarity] = Stimulus(self._positive(size, where, "size_mrad"), polarity)
        return self.stimuli[size, polarity]

    def _group(self, row: Mapping[str, str]) -> Group:
        names = self.experiment.group_by
        texts = tuple(row[name] for name in names)
        if texts not in self.groups:
            self.groups[texts] = tuple(
                text if name in self.texts else number_or_text(text)
                for name, text in zip(names, texts, strict=True)
            )
        return self.groups[texts]

    def _positive(self, text: str, where: str, column: str) -> float:
        if text not in self.numbers:
            self.numbers[text] = number(text, f"{where}: {column}", positive=True)
        return self.numbers[text]

    def _check_joined(self, first: Trial, other: Trial, where: str) -> None:
        """Raise DataError if two frames of a trial do not agree in everything else."""
        expected, found = (self._shown(trial) for trial in (first, other))
        for name, value in found.items():
            if value != expected[name]:
                raise DataError(
                    f"{where}: {name}: found {value}, expected {expected[name]} as in the other frames of trial "
                    f"{first.name!r}"
                )

    def _shown(self, trial: Trial) -> dict[str, object]:
        """Return the values of a trial in the manifest, by column."""
        return {
            "orientation": trial.orientation.value,
            "size_mrad": trial.stimulus.size_mrad,
            "polarity": trial.stimulus.polarity,
            self.experiment.level: trial.level,
            "x_px": trial.x_px,
            "y_px": trial.y_px,
            **dict(zip(SCENE_COLUMNS, trial.view or SceneView(""), strict=True)),
            **dict(zip(self.experiment.group_by, trial.group, strict=True)),
        }


def dataset_warnings(dataset: Dataset, trials: Trials) -> list[DatasetWarning]:
    """Return the warnings about the files of a dataset that make results from these trials less certain.
    `group_left_out` names a group of which no trial is left.

    `unverified_frames` counts the frames that have no checksum in the manifest and whose file format has none
    either: PNG files contain checksums of their own, EXR files do not. The others are those of the headers of a
    few frames: see `HeaderWarning`. Frames in memory have none. Raises FrameError if a file can no longer be read.
    """
    seen = set(trials.groups)
    left_out = [
        DatasetWarning(
            "group_left_out",
            dict(zip(dataset.experiment.group_by, group, strict=True)),
            f"its {len(indices)} trials cannot be used and are left out, so it has no row; mend their frames",
            found=0,
            expected=len(indices),
        )
        for group, indices in dataset.trials.by_group()
        if group not in seen
    ]
    if dataset.is_in_memory:
        return left_out
    unverified = sum(
        frame.sha256 is None and not has_own_checksums(dataset.frame_path(frame)) for frame in trials.frames
    )
    warnings = left_out + _header_warnings(dataset, trials)
    if not unverified:
        return warnings
    folder = in_utf8(shlex.quote(str(dataset.path)))
    message = (
        f"{unverified} of {trials.n_frames} frames are EXR without a sha256 in manifest.csv: nothing checks these "
        "files, and damage to them would change thresholds unseen; add checksums with "
        f"`todframes validate {folder} --add-sha256`"
    )
    return [*warnings, DatasetWarning("unverified_frames", {}, message, found=unverified, expected=0)]


def _header_warnings(dataset: Dataset, trials: Sequence[Trial]) -> list[DatasetWarning]:
    """Return the warnings of the headers of frames spread over the trials; `found` is the share that has them.
    Frames that cannot be read are left out: scoring reports them.
    """
    messages: dict[WarningCode, list[str]] = {}
    n_read = 0
    for index in range(0, len(trials), max(len(trials) // 16, 1)):
        frame = trials[index].frames[0]
        try:
            with dataset.open(frame) as file:
                warnings = file.header.warnings
        except FrameError:
            continue
        n_read += 1
        for code, message in warnings:
            messages.setdefault(code, []).append(f"{in_utf8(frame.path)}: {message}")
    return [
        DatasetWarning(
            code, {}, f"{alike[0]} ({len(alike)} of {n_read} frames looked at)", len(alike) / n_read, 0.0
        )
        for code, alike in messages.items()
    ]
