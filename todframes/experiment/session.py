"""A session of a person: the order of its trials, the steps from consent to the last answer, and its files.

The next trial follows from the seed and from the rows that are on the disk, so a session that was ended anywhere
goes on where it was.
"""

from __future__ import annotations

import hashlib
import platform
import re
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes import __version__
from todframes._typing import Json
from todframes.config import check_values
from todframes.errors import DataError, OutputError, SettingsError
from todframes.experiment.answers import (
    AnswerFile,
    Consent,
    Method,
    Phase,
    SessionRecord,
    ShownDataset,
    TrialRow,
    check_text,
    columns,
    count_file,
    data_path,
    read_records,
    read_rows,
    read_sidecar,
    sidecar_path,
    write_counts,
    write_sidecar,
)
from todframes.experiment.monitor import (
    Calibration,
    ContrastRange,
    Monitor,
    calibrated,
    check_shows,
)
from todframes.experiment.psych_ds import NAME as DESCRIPTION_NAME
from todframes.experiment.psych_ds import write_description
from todframes.experiment.stimuli import clipped, contrast_range, dithered_codes, png, trial_image
from todframes.frames.dataset import Dataset
from todframes.frames.files import frame_sha256
from todframes.frames.trials import Trial, Trials
from todframes.psychometrics.quest import QuestGrid
from todframes.recordings.dither import blue_noise
from todframes.stimulus import Orientation

CONSENT = """\
You will see a triangle on a grey field, again and again, and say where it points: up, right, down or left. Some
are easy, some cannot be seen; then guess. It takes 10 to 30 minutes, and there are breaks. You may stop at any
time by closing the page.

Your answers, the times they took and the calibration of this monitor are kept in a folder of this computer under a
random name. Nothing is sent anywhere.
"""
"""Text that people agree to unless another one is given."""


QUEST_TRIALS = 60
"""Default of the number of trials of a group that QUEST+ chooses."""


Step = Literal["consent", "monitor", "practice", "main", "break", "done"]


# First elements of the spawn keys of random streams: order of trials, order of groups, frames, practice.
ORDER, GROUPS, FRAMES, PRACTICE, DITHER = range(5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Settings of a session; None: the default, or what a session that goes on has.

    Attributes
    ----------
    method : {"constant", "quest"}, optional
        Show trials of the dataset in random order, or let QUEST+ choose the level. Default: constant.
    trials : int, optional
        Number of trials that count. Default: all of the dataset; for quest 60 a group.
    practice : int, optional
        Number of trials with feedback before. Default: 8.
    break_every : int, optional
        Number of trials between breaks, 0 for none. Default: 60.
    time_limit_s : float, optional
        Time in which to answer. Default: no limit.
    background : float, optional
        Luminance of the background over that of white. Default: 0.5.
    dither : bool, optional
        Show luminances between two code values by pixels of both. Default: yes.
    seed : int, optional
        Seed of the order. Default: a random one.
    """

    method: Method | None = None
    trials: Annotated[int | None, Meta(ge=1, le=1_000_000)] = None
    practice: Annotated[int | None, Meta(ge=0, le=1000)] = None
    break_every: Annotated[int | None, Meta(ge=0, le=1_000_000)] = None
    time_limit_s: Annotated[float | None, Meta(ge=0.1, le=3600)] = None
    background: Annotated[float | None, Meta(ge=0.01, le=0.99)] = None
    dither: bool | None = None
    seed: Annotated[int | None, Meta(ge=0, le=2**32 - 1)] = None

    def __post_init__(self) -> None:
        check_values(self)
        if self.method not in (None, *get_args(Method)):
            raise SettingsError(f"method: found {self.method!r}, expected one of {', '.join(get_args(Method))}")


class NextTrial(NamedTuple):
    """The trial that comes next: its phase, its row in the dataset's trials and the first seed of its dither."""

    phase: Phase
    row: int
    dither_seed: int


# The order of trials -------------------------------------------------------------------------------------------


class TrialOrder:
    """The order of the trials of a session, a function of its record and of the rows so far.

    Parameters
    ----------
    trials : Trials
        All trials of the dataset.
    record : SessionRecord
    """

    def __init__(self, trials: Trials, record: SessionRecord) -> None:
        self._trials, self._record = trials, record
        self._practice = practice_trials(trials, record.practice, _stream(record.seed, PRACTICE))
        self._row_of_frame = {trial.frames[0].path: row for row, trial in enumerate(trials)}
        self._main: NDArray[np.intp] | None = None
        self._grids: list[QuestGrid] = []
        if record.method == "constant":
            self._main = spread_trials(trials, record.trials, _stream(record.seed, ORDER))
        else:
            of_group = [trials.levels[trials.group_codes == code] for code in range(len(trials.groups))]
            self._grids = [QuestGrid.of_levels(levels) for levels in of_group]

    @property
    def candidates(self) -> list[int]:
        """Indices of the trials that may be shown."""
        main = range(len(self._trials)) if self._main is None else self._main.tolist()
        return sorted({*self._practice.tolist(), *main})

    def total(self, phase: Phase) -> int:
        """Return the number of trials of a phase."""
        return len(self._practice) if phase == "practice" else self._record.trials

    def check(self, file: AnswerFile) -> None:
        """Raise DataError if the dataset has fewer trials, or a row names a frame that no trial begins with."""
        if self._record.trials > len(self._trials):
            raise DataError(
                f"{sidecar_path(file.path)}: trials: found {self._record.trials}, the dataset has "
                f"{len(self._trials)}"
            )
        for line, row in enumerate(file.rows, 2):
            if row.frame not in self._row_of_frame:
                raise DataError(
                    f"{file.path}, line {line}: frame: found {row.frame!r}, which no trial begins with"
                )

    def next(self, rows: Sequence[TrialRow]) -> NextTrial | None:
        """Return the next trial after some rows; None after the last."""
        dither_seed = int(_stream(self._record.seed, DITHER, len(rows)).integers(4096))
        if len(rows) < len(self._practice):
            return NextTrial("practice", int(self._practice[len(rows)]), dither_seed)
        n_main = len(rows) - len(self._practice)
        if n_main >= self._record.trials:
            return None
        row = int(self._main[n_main]) if self._main is not None else self._adaptive(rows)
        return NextTrial("main", row, dither_seed)

    def _adaptive(self, rows: Sequence[TrialRow]) -> int:
        """Return the trial that QUEST+ chooses: of the group whose turn it is, one that was not shown yet."""
        main = rows[len(self._practice) :]
        shown = np.array([self._row_of_frame[row.frame] for row in main], np.intp)
        is_left = np.ones(len(self._trials), np.bool_)
        is_left[shown] = False
        codes, n_groups = self._trials.group_codes, len(self._trials.groups)
        # Blocks in which each group has a turn, in random order; a group without trials left loses its turn.
        block, turn = divmod(len(main), n_groups)
        turns = chain.from_iterable(
            _stream(self._record.seed, GROUPS, number).permutation(n_groups).tolist()
            for number in (block, block + 1)
        )
        code = next(one for one in list(turns)[turn:] if is_left[codes == one].any())
        grid = self._grids[code]
        levels = self._trials.levels
        answers = np.zeros((2, grid.levels.size))
        for index, row in zip(shown, main, strict=True):
            if codes[index] == code and row.response is not None:
                answers[int(row.is_correct), np.searchsorted(grid.levels, levels[index])] += 1
        entropy = grid.expected_entropy(grid.posterior(*answers))
        entropy[~np.isin(grid.levels, levels[is_left & (codes == code)])] = np.inf
        level = grid.levels[np.argmin(entropy)]
        choice = np.flatnonzero(is_left & (codes == code) & (levels == level))
        return int(_stream(self._record.seed, FRAMES, len(main)).choice(choice))


def spread_trials(trials: Trials, n_trials: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of trials in random order, spread evenly over groups, levels and orientations.

    The numbers of trials of a group, level and orientation differ by one at most, as far as the dataset has as
    many.
    """
    order = rng.permutation(len(trials))
    cells = np.stack([trials.group_codes, trials.levels, trials.quarter_turns], axis=1)[order]
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    # The first of each cell in this order, then the second of each, and so on.
    by_cell = np.argsort(cell.ravel(), kind="stable")
    first = np.flatnonzero(np.diff(cell.ravel()[by_cell], prepend=-1))
    place = np.empty(len(order), np.intp)
    place[by_cell] = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    chosen = order[np.argsort(place, kind="stable")[:n_trials]]
    return np.asarray(rng.permutation(chosen), np.intp)


def practice_trials(trials: Trials, n_trials: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of practice trials: of each group in turn, one of its highest level."""
    codes, levels = trials.group_codes, trials.levels
    highest = []
    for code in np.unique(codes):
        of_group = np.flatnonzero(codes == code)
        highest.append(of_group[levels[of_group] == levels[of_group].max()])
    return np.array([rng.choice(highest[k % len(highest)]) for k in range(n_trials)], np.intp)


def _stream(seed: int, *key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


# The session ---------------------------------------------------------------------------------------------------


class Material(NamedTuple):
    """What a session shows: the text of consent, the largest width and height of a frame, and all contrasts."""

    consent_text: str
    frame_px: tuple[int, int]
    contrasts: list[ContrastRange]


class Prepared(NamedTuple):
    """A trial that is ready to be shown: its picture, and what its row will say."""

    number: int
    phase: Phase
    trial: Trial
    picture: bytes
    width: int
    height: int
    dither_seed: int
    clipped_px: int
    sha256: str
    shown_at: str


class StepError(DataError):
    """Error for a request that does not fit the step at which the session is."""


class Sitting:
    """A session under way: its steps in order, each saved before it returns. Threads may call it side by side.

    Make it with `open_sitting`. `record` is the sidecar as it is on the disk.
    """

    def __init__(
        self, dataset: Dataset, folder: Path, record: SessionRecord, file: AnswerFile, material: Material
    ) -> None:
        self._dataset, self._folder, self._file, self._material = dataset, folder, file, material
        self.record = record
        self._order = TrialOrder(dataset.trials, record)
        self._lock = threading.Lock()
        self._prepared: Prepared | None = None
        self._is_break = False

    @property
    def rows(self) -> tuple[TrialRow, ...]:
        """The rows that are on the disk."""
        return tuple(self._file.rows)

    def state(self) -> Json:
        """Return the step of the session and what the page shows with it."""
        with self._lock:
            return self._state()

    def consent(self, is_agreed: bool) -> Json:
        """Keep a person's consent; without it the session stays where it is.

        Raises
        ------
        StepError
            If the person has agreed before.
        OutputError
            If it cannot be written.
        """
        with self._lock:
            self._expect("consent")
            if is_agreed:
                agreed = Consent(text=self._material.consent_text, agreed_at=_now())
                self._write(replace(self.record, consent=agreed))
            return self._state()

    def calibrate(self, found: Calibration) -> Json:
        """Keep the calibration of the monitor.

        Raises
        ------
        MonitorError
            If the monitor cannot show the trials as they are.
        StepError
            If the person has not agreed yet, or has answered trials.
        OutputError
            If it cannot be written.
        """
        with self._lock:
            if self.record.monitor is None or self._file.rows:
                self._expect("monitor")
            monitor = calibrated(found, background=self.record.background, dither=self.record.dither)
            check_shows(
                monitor,
                frame_px=self._material.frame_px,
                pixel_pitch_mrad=self._dataset.display.pitch_mrad,
                ranges=self._material.contrasts,
            )
            self._write(replace(self.record, monitor=monitor))
            self._prepared = None
            return self._state()

    def trial(self) -> Json:
        """Return the trial to show, the same one until it is answered.

        Raises
        ------
        StepError
            If there is none at this step.
        FrameError
            If its frames cannot be used.
        """
        with self._lock:
            prepared = self._prepare()
            return {
                "number": prepared.number,
                "phase": prepared.phase,
                "image": f"/stimulus/{prepared.number}.png",
                "width": prepared.width,
                "height": prepared.height,
                "background_code": self._monitor.background_code,
                "time_limit_ms": self.record.time_limit_ms,
            }

    def picture(self, number: int) -> bytes:
        """Return the PNG of the trial that is shown.

        Raises
        ------
        StepError
            If another trial is shown, or none.
        """
        with self._lock:
            if self._prepared is None or self._prepared.number != number:
                raise StepError(f"trial {number} is not shown; expected that of /api/trial")
            return self._prepared.picture

    def answer(self, number: int, response: Orientation | None, response_time_ms: float) -> Json:
        """Save an answer to the disk, once: a trial that has an answer keeps it.

        The trial may have been shown by a server before this one, as its order is the same.

        Raises
        ------
        StepError
            If the trial was not shown.
        OutputError
            If it cannot be written; the trial is still to be answered.
        """
        with self._lock:
            if 1 <= number <= len(self._file.rows):
                return self._answered(self._file.rows[number - 1])
            shown = self._prepare()  # that of an earlier server, if this one has not shown it
            if shown.number != number:
                raise StepError(f"trial {number} is not shown, but {shown.number}; reload the page")
            if response is None and self.record.time_limit_ms is None:
                raise StepError(
                    "response: found none, which only a time limit gives; expected up, right, down, left"
                )
            row = TrialRow(
                number=number,
                phase=shown.phase,
                frame=shown.trial.frames[0].path,
                sha256=shown.sha256,
                orientation=shown.trial.orientation,
                response=response,
                response_time_ms=response_time_ms,
                level=shown.trial.level,
                group=shown.trial.group,
                size_mrad=shown.trial.stimulus.size_mrad,
                dither_seed=shown.dither_seed,
                clipped_px=shown.clipped_px,
                shown_at=shown.shown_at,
            )
            self._file.append(row)
            self._prepared = None
            self._after(row)
            return self._answered(row)

    def go_on(self) -> Json:
        """End a break; at other steps nothing changes."""
        with self._lock:
            self._is_break = False
            return self._state()

    def close(self) -> None:
        """Write the counts of what was answered.

        Raises
        ------
        OutputError
            If they cannot be written.
        """
        with self._lock:
            self._write_counts()

    @property
    def _monitor(self) -> Monitor:
        assert self.record.monitor is not None  # the step of the session was checked
        return self.record.monitor

    def _step(self) -> tuple[Step, NextTrial | None]:
        if self.record.consent is None:
            return "consent", None
        if self.record.monitor is None:
            return "monitor", None
        following = self._order.next(self._file.rows)
        if following is None:
            return "done", None
        return ("break" if self._is_break else following.phase), following

    def _expect(self, step: Step) -> None:
        if (found := self._step()[0]) != step:
            raise StepError(f"the session is at the step {found}, expected {step}; reload the page")

    def _state(self) -> Json:
        step, following = self._step()
        rows = self._file.rows
        phase: Phase = "practice" if following is not None and following.phase == "practice" else "main"
        display, material = self._dataset.display, self._material
        return {
            "step": step,
            "subject": self.record.subject,
            "done": sum(row.phase == phase for row in rows),
            "total": self._order.total(phase),
            "consent_text": material.consent_text,
            "dataset": {
                "name": self._dataset.path.name,
                "n_frames": self._dataset.n_frames,
                "pixel_pitch_mrad": display.pitch_mrad,
                "width_px": material.frame_px[0],
                "height_px": material.frame_px[1],
                "smallest_contrast": min(one.low for one in material.contrasts),
                "largest_contrast": max(one.high for one in material.contrasts),
            },
            "device_pixel_ratio": None if self.record.monitor is None else self._monitor.device_pixel_ratio,
            "time_limit_ms": self.record.time_limit_ms,
            "feedback": phase == "practice",
            "files": str(self._folder),
            "summary": self._summary() if step == "done" else [],
        }

    def _summary(self) -> list[tuple[str, str]]:
        """Return what is told at the end: labels and texts."""
        answers = [row for row in self._file.rows if row.phase == "main"]
        return [("Correct", f"{sum(row.is_correct for row in answers)} of {len(answers)}")]

    def _answered(self, row: TrialRow) -> Json:
        return {**self._state(), "correct": row.is_correct if row.phase == "practice" else None}

    def _prepare(self) -> Prepared:
        step, following = self._step()
        if following is None or step == "break":
            raise StepError(f"the session is at the step {step}, which has no trial; reload the page")
        number = len(self._file.rows) + 1
        if self._prepared is None or self._prepared.number != number:
            trial = self._dataset.trials[following.row]
            image = trial_image(self._dataset, trial)
            codes, dither_seed = dithered_codes(trial, image, self._monitor, following.dither_seed)
            n_clipped = int(np.count_nonzero(clipped(image.contrast, self._monitor)))
            height, width = codes.shape
            sha256 = frames_sha256(self._dataset, trial)
            self._prepared = Prepared(
                number, following.phase, trial, png(codes), width, height, dither_seed, n_clipped, sha256, _now()
            )
        return self._prepared

    def _after(self, row: TrialRow) -> None:
        """Begin a break after an answer if it is time, and write the counts then and at the end."""
        n_main, every = sum(one.phase == "main" for one in self._file.rows), self.record.break_every
        following = self._order.next(self._file.rows)
        self._is_break = bool(every) and row.phase == "main" and n_main % every == 0 and following is not None
        if self._is_break or following is None:
            with suppress(OutputError):  # the answer is safe; `close` writes them again
                self._write_counts()

    def _write(self, record: SessionRecord) -> None:
        write_sidecar(sidecar_path(self._file.path), record)
        self.record = record

    def _write_counts(self) -> None:
        if self.record.monitor is not None and self._file.rows:
            write_counts(count_file(self._folder, self.record.subject), self.record, self.rows)


def frames_sha256(dataset: Dataset, trial: Trial) -> str:
    """Return the checksum of the file of a trial's frame; of several, that of the lines of their checksums."""
    each = [frame_sha256(dataset.frame_path(frame)) for frame in trial.frames]
    return each[0] if len(each) == 1 else hashlib.sha256("".join(f"{one}\n" for one in each).encode()).hexdigest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


# Opening -------------------------------------------------------------------------------------------------------


@contextmanager
def open_sitting(
    dataset: Dataset,
    folder: Path | str,
    *,
    subject: str | None = None,
    design: Design | None = None,
    consent_text: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Sitting]:
    """Begin a session, or go on with one that is not finished; its files stay locked in the block.

    Parameters
    ----------
    dataset : Dataset
    folder : path
        Folder of answers; made if it does not exist.
    subject : str, optional
        Anonymous id, letters and digits. Default: that of the only session that is not finished, or a random one.
    design : Design, optional
        Settings; those of a session that has rows cannot change.
    consent_text : str, optional
        Text that the person is to agree to.
    progress : function of an int, optional
        Called with 1 for each trial whose frames were read.

    Raises
    ------
    DataError, FrameError
        If the dataset or a frame cannot be used, or a file of answers is damaged.
    SettingsError
        If the id, the dataset or a setting does not fit the session.
    OutputError
        If the folder cannot be written, or another server is in the session.
    """
    folder, design = Path(folder), design or Design()
    shown = _shown_dataset(dataset)
    software = {"todframes": __version__, "python": platform.python_version(), "numpy": np.__version__}
    records = _records_in(folder, shown)
    if subject is None:
        subject = _unfinished_subject(folder, records) or secrets.token_hex(4)
    elif not re.fullmatch("[A-Za-z0-9]{1,64}", subject):
        raise SettingsError(f"--subject: found {subject!r}, expected letters and digits, at most 64, and no name")
    new = _new_record(dataset, shown, subject, software, design)
    _make_folders(folder, shown, software)
    with AnswerFile(data_path(folder, subject)) as file:
        file.begin(shown)
        sidecar = sidecar_path(file.path)
        record = read_sidecar(sidecar) if sidecar.exists() or file.rows else new
        differs = _difference(record, design)
        if record is new or (differs and not file.rows):
            record = new
            write_sidecar(sidecar, record)
        elif differs:
            raise SettingsError(f"--{differs}, but subject {subject} has answered trials; take another --subject")
        order = TrialOrder(dataset.trials, record)
        order.check(file)
        if order.next(file.rows) is None:
            raise SettingsError(f"--subject: {subject} has finished; leave it out, or take another one")
        text = consent_text or CONSENT if record.consent is None else record.consent.text
        sitting = Sitting(dataset, folder, record, file, _material(dataset, order.candidates, text, progress))
        try:
            yield sitting
        finally:
            sitting.close()


def _shown_dataset(dataset: Dataset) -> ShownDataset:
    """Return what a session depends on of a dataset; raise an error if people cannot be shown it."""
    if dataset.manifest_sha256 is None:
        raise SettingsError("experiment: found frames in memory, expected a dataset in a folder")
    if dataset.bad_rows:
        raise DataError(dataset.bad_rows[0].error)
    experiment = dataset.experiment
    columns(experiment.level, experiment.group_by)  # raises for names that the file of answers cannot have
    for text in chain.from_iterable(dataset.trials.groups):
        if isinstance(text, str):
            check_text(text, f"{dataset.path}: group_by")
    for trial in dataset.trials:
        check_text(trial.frames[0].path, f"{dataset.path}: frame")
    return ShownDataset(
        path=str(dataset.path),
        manifest_sha256=dataset.manifest_sha256,
        pixel_pitch_mrad=dataset.display.pitch_mrad,
        level=experiment.level,
        group_by=experiment.group_by,
    )


def _records_in(folder: Path, shown: ShownDataset) -> list[tuple[Path, SessionRecord]]:
    """Return the sessions in a folder of answers; raise an error if it holds anything else."""
    if not folder.exists():
        return []
    if not folder.is_dir():
        raise OutputError(f"{folder}: is a file, expected a folder for answers, or a new name")
    if not (folder / DESCRIPTION_NAME).exists() and any(not one.name.startswith(".") for one in folder.iterdir()):
        raise OutputError(f"{folder}: holds other files, expected a folder of answers, an empty one or a new name")
    records = read_records(folder)
    for path, record in records:
        if replace(record.dataset, path=shown.path) != shown:
            raise SettingsError(
                f"{path}: has answers to another dataset ({record.dataset.path}, or another manifest.csv or "
                "dataset.toml in it); take another folder for these"
            )
    return records


def _unfinished_subject(folder: Path, records: Sequence[tuple[Path, SessionRecord]]) -> str | None:
    """Return the subject of the only session that is not finished; None if all are."""
    unfinished = []
    for path, record in records:
        rows = read_rows(path, record.dataset) if path.exists() else ()
        if sum(row.phase == "main" for row in rows) < record.trials:
            unfinished.append(record.subject)
    if len(unfinished) > 1:
        raise SettingsError(
            f"{folder}: the sessions of {', '.join(unfinished)} are not finished; say which with --subject, or a "
            "new one"
        )
    return unfinished[0] if unfinished else None


def _make_folders(folder: Path, shown: ShownDataset, software: Mapping[str, str]) -> None:
    try:
        folder.mkdir(exist_ok=True)
        write_description(folder, shown, software)
        for name in ("data", "counts"):
            (folder / name).mkdir(exist_ok=True)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror})") from None


def _new_record(
    dataset: Dataset, shown: ShownDataset, subject: str, software: Mapping[str, str], design: Design
) -> SessionRecord:
    """Return the record of a new session, with defaults for what the design leaves open."""
    method = design.method or "constant"
    n_trials = len(dataset.trials)
    default = n_trials if method == "constant" else min(QUEST_TRIALS * len(dataset.trials.groups), n_trials)
    trials = default if design.trials is None else design.trials
    if trials > n_trials:
        raise SettingsError(f"--trials: found {trials}, expected at most {n_trials}, the trials of the dataset")
    return SessionRecord(
        subject=subject,
        started=_now(),
        software=software,
        dataset=shown,
        method=method,
        seed=secrets.randbelow(2**32) if design.seed is None else design.seed,
        trials=trials,
        practice=8 if design.practice is None else design.practice,
        break_every=60 if design.break_every is None else design.break_every,
        time_limit_ms=None if design.time_limit_s is None else 1000.0 * design.time_limit_s,
        background=0.5 if design.background is None else design.background,
        dither=True if design.dither is None else design.dither,
    )


def _difference(record: SessionRecord, design: Design) -> str | None:
    """Tell the first setting of a design that a session has otherwise; None if it has all."""
    for field in fields(design):
        asked = getattr(design, field.name)
        if field.name == "time_limit_s":
            found = None if record.time_limit_ms is None else record.time_limit_ms / 1000.0
        else:
            found = getattr(record, field.name)
        if asked is not None and asked != found:
            return f"{field.name.replace('_', '-')}: found {asked}, the session has {found}"
    return None


def _material(
    dataset: Dataset, indices: Sequence[int], consent_text: str, progress: Callable[[int], None] | None
) -> Material:
    """Read all frames that a session may show."""
    blue_noise()  # takes a quarter of a second, which the first trial shall not take
    contrasts, sides = [], [(0, 0)]
    for index in indices:
        trial = dataset.trials[index]
        image = trial_image(dataset, trial)
        contrasts.append(contrast_range(trial, image))
        sides.append(image.contrast.shape[::-1])
        if progress is not None:
            progress(1)
    width, height = (max(of_side) for of_side in zip(*sides, strict=True))
    return Material(consent_text, (width, height), contrasts)
