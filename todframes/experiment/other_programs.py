"""Trials for other programs: a list with pictures that PsychoPy or another lab's page plays, and its answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath

from todframes.base.errors import DataError, OutputError, SettingsError, argument
from todframes.base.output import new_folder, write_file
from todframes.base.reading import TableRow, check_columns, checked, number, read_numbers, read_table
from todframes.base.safe_text import csv_text
from todframes.base.seeds import Rng, seed_of
from todframes.experiment.answers import (
    NO_RESPONSE,
    TrialRow,
    check_subject,
    columns,
    count_file,
    data_path,
    flag_of,
    flagged,
    make_folders,
    read_record,
    row_of_texts,
    sidecar_path,
    values_of_row,
    write_counts,
    write_sidecar,
)
from todframes.experiment.monitor import Calibration, calibrated, check_shows
from todframes.experiment.order import TrialOrder
from todframes.experiment.run_experiment import SessionProgress
from todframes.experiment.session import (
    frames_shown,
    make_picture,
    new_record,
    now,
    shown_dataset,
)
from todframes.frames.dataset import Dataset, load_dataset
from todframes.parameters import (
    ColumnName,
    Count,
    Exponent,
    ListFolder,
    Millimetres,
    NamedTable,
    PersonId,
    Progress,
    Seed,
    counted,
)
from todframes.stimulus import Orientation

LIST_FILE, RECORD_FILE = "trials.csv", "trials.json"
"""List of trials, and the session that they make: monitor, dataset, settings."""

SUFFIX = ".png"

OF_LIST = ("image", "correct_key", "background_code")
"""Columns of the list before those of a data file."""

OF_ANSWER = ("response", "correct", "response_time_ms", "flag", "shown_at")
"""Columns of a data file that an answer gives."""

NOTHING = ("", "--", "none", "null")
"""Texts for no answer, as PsychoPy and jsPsych write it."""

ROOM_PX = (10**6, 10**6)
"""Size of a screen that is not known."""


@checked
def export_trials(
    dataset: Path | str | Dataset,
    *,
    out: ListFolder,
    pixel_pitch_mm: Millimetres,
    viewing_distance_mm: Millimetres,
    gamma: Exponent | None = None,
    photometer: NamedTable | None = None,
    trials: Count | None = None,
    background: float | None = None,
    dither: bool | None = None,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> int:
    """Write the trials of a dataset as a list with pictures, which PsychoPy or another program shows to people.

    The pictures have the code values of the monitor that is described. The answers are read by
    `todframes import-answers`.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames.

        The return value of `load_dataset` is taken as well.
    out : path
        Folder for trials.csv, images and trials.json, which describes the monitor.
    pixel_pitch_mm : float
        Distance of two pixels of the monitor in mm.
    viewing_distance_mm : float
        Distance from the eyes to the monitor in mm.
    gamma : float, optional
        Exponent of the monitor's luminance; 1 if the program that shows the pictures linearises it.
    photometer : path, optional
        CSV file of readings in place of gamma: columns code, from 0 to 255, and luminance_cd_m2.
    trials : int, optional
        Number of trials. Default: all.
    background : float, optional
        Luminance of the background over that of white. Default: 0.5.
    dither : bool, optional
        Show a luminance between two code values by pixels of both. Otherwise show the nearest code value.
    rng : int, SeedSequence or Generator
        Seed of the order.
    progress : function of two ints, optional
        Called with the number of trials that are written, and of all.

    Returns
    -------
    int
        Number of trials.

    Raises
    ------
    DataError, FrameError
        If the dataset or a frame cannot be used.
    SettingsError
        If a setting is invalid, or the monitor cannot show the trials as they are.
    OutputError
        If the folder is not empty or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> out, monitor = tempfile.mkdtemp(), {"pixel_pitch_mm": 0.25, "viewing_distance_mm": 4000, "gamma": 2.2}
    >>> tod.export_trials("sample_frames/naked_eye", out=out, trials=3, **monitor)
    3
    """
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    settings = {"trials": trials, "background": background, "dither": dither}
    design = {name: value for name, value in settings.items() if value is not None}
    design |= {"practice": 0, "seed": seed_of(rng)}
    record = new_record(data, shown_dataset(data), "", design)
    readings = None
    if photometer is not None:
        table = read_numbers(Path(photometer), ("code", "luminance_cd_m2"))
        readings = tuple((code, cd_m2) for code, cd_m2 in table)
    measures = Calibration(
        device_pixel_ratio=1.0,
        pixel_pitch_mm=pixel_pitch_mm,
        viewing_distance_mm=viewing_distance_mm,
        gamma=gamma,
        photometer=readings,
        screen_px=ROOM_PX,
        viewport_px=ROOM_PX,
    )
    monitor = calibrated(measures, background=record.background, dither=record.dither)
    order = TrialOrder(data.trials, record)
    frame_px, contrasts = frames_shown(data, order.candidates, None)
    check_shows(monitor, frame_px=frame_px, pixel_pitch_mrad=data.display.pitch_mrad, ranges=contrasts)
    names = [name for name in columns(record.dataset.level, record.dataset.group_by) if name not in OF_ANSWER]
    if taken := set(OF_LIST) & set(names):
        raise SettingsError(
            f"group_by: found {min(taken)!r}, which is a column of the list; rename it in the manifest"
        )
    rows: list[TrialRow] = []
    lines: list[list[object]] = [[*OF_LIST, *names]]
    with new_folder(str(out), last=RECORD_FILE) as folder:
        (folder / "images").mkdir()
        for trial in counted(range(1, record.trials + 1), record.trials, progress):
            asked = order.next(rows)
            assert asked is not None  # as many are listed
            picture, image = make_picture(data, monitor, asked), f"images/{trial:05d}{SUFFIX}"
            (folder / image).write_bytes(picture.content)
            rows.append(picture.row)
            values = values_of_row(rows[-1], record.dataset)
            key = rows[-1].orientation.value
            lines.append([image, key, monitor.background_code, *(values[name] for name in names)])
        write_file(folder / LIST_FILE, csv_text(lines).encode())
        write_sidecar(folder / RECORD_FILE, replace(record, monitor=monitor))
    return record.trials


@checked
def import_answers(
    folder: ListFolder, file: NamedTable, *, subject: PersonId, response: ColumnName | None = None
) -> SessionProgress:
    """Read the answers of a person to exported trials, from the CSV file of the program that showed them.

    They are written into the folder of the trials, which then is one of answers, for `todframes calibrate`, and
    has counts for `todframes fit`. Rows with a picture in the column image, or stimulus, are trials.

    Parameters
    ----------
    folder : path
        Folder that `todframes export-trials` wrote.
    file : path
        CSV file with a row a trial, as PsychoPy or jsPsych write it.
    subject : str
        Anonymous id of the person: letters and digits.
    response : str, optional
        Column of the answers: up, right, down or left, or an arrow key. Default: response, or the only one that
        ends in .keys.

        The time is that in the column .rt of the same name in s, in response_time_ms, or in rt: in ms if the file
        is of jsPsych, otherwise in s.

    Returns
    -------
    SessionProgress
        Number of answers, and of the trials of the list.

    Raises
    ------
    DataError
        If a file cannot be read or a row is not an answer; the message names the line and the column.
    SettingsError
        If the id is not one.
    OutputError
        If the person has answers in the folder, or they cannot be written.
    """
    folder, path = Path(folder), Path(file)
    check_subject(subject)
    record = replace(read_record(folder / RECORD_FILE), subject=subject, started=now(), stopped_at=now())
    header, table = read_table(path)
    image = next((name for name in ("image", "stimulus") if name in header), "image")
    check_columns(header, [image], path)
    played = []
    for row in table:
        if row.texts[image] == image:
            raise DataError(f"{row.where}: found the columns again: a second run was appended; keep one of them")
        if row.texts[image].strip().endswith(SUFFIX):
            played.append(row)
    if not played:
        raise DataError(
            f"{path}: {image}: found no picture, expected one of {folder / LIST_FILE} in a row a trial"
        )
    if response is None:
        response = _column_of_responses(path, header, played)
    check_columns(header, [response], path)
    time, ms = _column_of_times(header, response)
    check_columns(header, [time], path)
    _, listed = read_table(folder / LIST_FILE, ("image",))
    trials = {PureWindowsPath(row.texts["image"]).name: row.texts for row in listed}
    rows = []
    for trial, row in enumerate(played, 1):
        if (shown := trials.get(PureWindowsPath(row.texts[image].strip()).name)) is None:  # of either kind of path
            raise DataError(
                f"{row.where}: {image}: found {row.texts[image]!r}, expected one of {folder / LIST_FILE}"
            )
        direction = _direction(row.texts[response], f"{row.where}: {response}")
        time_ms = None
        if direction != NO_RESPONSE:
            time_ms = ms * number(row.texts[time].strip(" []"), f"{row.where}: {time}", positive=True)
        answer = {
            "trial": str(trial),
            "phase": row.texts.get("phase") or "main",
            "response": direction,
            "correct": str(int(direction == shown["orientation"])),
            "response_time_ms": str(time_ms or 0.0),
            "flag": flag_of(time_ms) or "",
            "shown_at": "",
        }
        rows.append(row_of_texts({**shown, **answer}, record.dataset, row.where))
    data = data_path(folder, subject)
    if data.exists():
        raise OutputError(f"{data}: exists; take another {argument.subject}, or delete it")
    make_folders(folder, record.dataset, record.software)
    names = columns(record.dataset.level, record.dataset.group_by)
    each = [values_of_row(row, record.dataset) for row in rows]
    write_sidecar(sidecar_path(data), record)
    content = csv_text([names, *([values[name] for name in names] for values in each)])
    write_file(data, content.encode(), is_private=True)
    write_counts(count_file(folder, subject), record, rows)
    n_answered = sum(row.phase == "main" for row in rows)
    return SessionProgress(subject, n_answered, record.trials, sum(flagged(rows).values()))


def _column_of_responses(path: Path, header: Sequence[str], played: Sequence[TableRow]) -> str:
    """Return the only column that has responses beside images."""
    found = [
        name
        for name in header
        if (name == "response" or name.endswith(".keys")) and any(row.texts[name].strip() for row in played)
    ]
    if len(found) != 1:
        raise DataError(
            f"{path}: found {' and '.join(found) or 'no answers'} beside the images, expected one column with "
            f"answers, response or one that ends in .keys; name it by {argument.response}"
        )
    return found[0]


def _column_of_times(header: Sequence[str], response: str) -> tuple[str, float]:
    """Return the column of the response times of a column of responses, and its unit in ms."""
    of_key = response.removesuffix("keys") + "rt"
    if response.endswith(".keys") and of_key in header:
        return of_key, 1000.0
    if "response_time_ms" in header:
        return "response_time_ms", 1.0
    return "rt", 1.0 if "time_elapsed" in header else 1000.0  # jsPsych counts in ms


def _direction(text: str, where: str) -> str:
    """Return the direction of an answer, such as up for ArrowUp or ['up']."""
    word = text.strip("[]'\" ").lower().removeprefix("arrow")
    if word in NOTHING:
        return NO_RESPONSE
    if word not in list(Orientation):
        raise DataError(f"{where}: found {text!r}, expected up, right, down or left, or an arrow key")
    return word
