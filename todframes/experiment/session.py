"""A session of a person: its settings, and its steps from consent to the last answer.  The next trial follows from
the record and the rows on the disk, so a session that was interrupted at any point continues there.
"""

from __future__ import annotations

import hashlib
import platform
import secrets
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from todframes import __version__
from todframes.base._typing import Json
from todframes.base.errors import DataError, OutputError, SettingsError, argument
from todframes.display.display import blue_noise
from todframes.experiment.answers import (
    DESCRIPTION_FILE,
    AnswerFile,
    Consent,
    Phase,
    SessionRecord,
    ShownDataset,
    TrialRow,
    check_subject,
    check_text,
    columns,
    count_file,
    counted_rows,
    data_path,
    flag_of,
    flagged,
    make_folders,
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
    clipped,
    contrast_range,
    dithered_codes,
    png,
    trial_image,
)
from todframes.experiment.order import NextTrial, TrialOrder, n_main_trials
from todframes.frames.dataset import Dataset
from todframes.frames.files import frame_sha256
from todframes.frames.trials import Trial
from todframes.parameters import Progress, counted
from todframes.stimulus import ORIENTATIONS, Orientation

CONSENT = """\
You will see a triangle on a grey field, again and again, and say where it points: up, right, down or left. Some
are easy, some cannot be seen; then guess. It takes 10 to 30 minutes, and there are breaks.

Taking part is voluntary. You may stop at any time, without a reason, with the button "Stop".

Your answers, the times they took and the calibration of this monitor are kept in a folder of this computer under
an anonymous id. Nothing is sent anywhere.

You may withdraw later, too: give the id that stands below to {contact}, who then deletes all that is kept under
it. Ask there as well if you have a question.
"""
"""Text that people agree to unless another one is given; `contact` is put into it."""

CONTACT = "the person who invited you"
"""Contact of a session that names none."""

QUEST_TRIALS = 60
"""Default of the number of trials of a group that QUEST+ chooses."""

Step = Literal["consent", "monitor", "practice", "main", "break", "done", "stopped"]


class Picture(NamedTuple):
    """A trial as the monitor shows it: its row without an answer, a PNG and its size."""

    row: TrialRow
    content: bytes
    width: int
    height: int


def make_picture(dataset: Dataset, monitor: Monitor, asked: NextTrial) -> Picture:
    """Read the frames of a trial and compute the code values that show it."""
    trial = dataset.trials[asked.row]
    image = trial_image(dataset, trial)
    codes, dither_seed = dithered_codes(trial, image, monitor, asked.dither_seed)
    row = TrialRow(
        number=asked.number,
        phase=asked.phase,
        frame=trial.frames[0].path,
        sha256=frames_sha256(dataset, trial),
        orientation=trial.orientation,
        response=None,
        response_time_ms=0.0,
        level=trial.level,
        group=trial.group,
        size_mrad=trial.stimulus.size_mrad,
        dither_seed=dither_seed,
        clipped_px=int(np.count_nonzero(clipped(image.contrast, monitor))),
        shown_at="",
    )
    height, width = codes.shape
    return Picture(row, png(codes), width, height)


class StepError(DataError):
    """Error for a request that does not fit the step at which the session is."""


class Sitting:
    """A session under way: its steps in order, each saved before it returns. Make it with `open_sitting`. A call
    that does not fit the step raises StepError. `record` is the sidecar as it is on the disk; `frame_px` and
    `contrasts` are those of `frames_shown`.
    """

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        record: SessionRecord,
        file: AnswerFile,
        *,
        consent_text: str,
        contact: str,
        frame_px: tuple[int, int],
        contrasts: list[ContrastRange],
    ) -> None:
        self._dataset, self._folder, self._file, self.record = dataset, folder, file, record
        self._consent_text, self._contact = consent_text, contact
        self._frame_px, self._contrasts = frame_px, contrasts
        self._order = TrialOrder(dataset.trials, record)
        self._shown: Picture | None = None
        self._is_break = False
        # Pictures that may come next are made while the person looks: a large one takes a second.
        self._artist = ThreadPoolExecutor(1, "pictures")
        self._pictures: dict[NextTrial, Future[Picture]] = {}

    @property
    def rows(self) -> tuple[TrialRow, ...]:
        """The rows that are on the disk."""
        return tuple(self._file.rows)

    def consent(self, is_agreed: bool) -> Json:
        """Keep a person's consent; without it the session stays where it is."""
        self._expect("consent")
        if is_agreed:
            self._write(replace(self.record, consent=Consent(text=self._consent_text, agreed_at=now())))
        return self.state()

    def calibrate(self, calibration: Calibration) -> Json:
        """Keep the calibration of the monitor.

        Raises SettingsError if the monitor cannot show the trials as they are; StepError if the person has not
        agreed yet, or has answered trials; OutputError if it cannot be written.
        """
        if self.record.monitor is None or self._file.rows:
            self._expect("monitor")
        monitor = calibrated(calibration, background=self.record.background, dither=self.record.dither)
        pitch_mrad = self._dataset.display.pitch_mrad
        check_shows(monitor, frame_px=self._frame_px, pixel_pitch_mrad=pitch_mrad, ranges=self._contrasts)
        self._write(replace(self.record, monitor=monitor))
        self._shown, self._pictures = None, {}
        return self.state()

    def trial(self) -> Json:
        """Return the trial to show, the same one until it is answered."""
        picture = self._prepare()
        self._look_ahead(picture.row)
        return {
            "number": picture.row.number,
            "image": f"/stimulus/{picture.row.number}.png",
            "width": picture.width,
            "height": picture.height,
            "background_code": self._monitor.background_code,
            "time_limit_ms": self._time_limit_ms,
        }

    def picture(self, number: int) -> bytes:
        """Return the PNG of the trial that is shown; StepError if another trial is shown, or none."""
        if self._shown is None or self._shown.row.number != number:
            raise StepError(f"trial {number} is not shown; expected that of /api/trial")
        return self._shown.content

    def answer(
        self,
        number: int,
        response: Orientation | None,
        response_time_ms: float,
        *,
        lost: Literal["hidden", "unfocused"] | None = None,
    ) -> Json:
        """Save an answer to the disk, once: a trial that has an answer keeps it. The trial may have been shown by
        a server before this one, as its order is the same. `lost` says that the page was hidden, or had lost the
        focus, during the trial.
        """
        if 1 <= number <= len(self._file.rows):
            return self._answered(self._file.rows[number - 1])
        shown = self._prepare().row  # that of an earlier server, if this one has not shown it
        if shown.number != number:
            raise StepError(f"trial {number} is not shown, but {shown.number}; reload the page")
        if response is None and self.record.time_limit_s is None:
            raise StepError("response: found none, which only a time limit gives; expected up, right, down, left")
        flag = lost or flag_of(None if response is None else response_time_ms)
        row = replace(shown, response=response, response_time_ms=response_time_ms, flag=flag)
        self._file.append(row)
        self._shown = None
        n_main, every = sum(answer.phase == "main" for answer in self._file.rows), self.record.break_every
        is_done = self._order.next(self._file.rows) is None
        self._is_break = bool(every) and row.phase == "main" and n_main % every == 0 and not is_done
        if self._is_break or is_done:
            with suppress(OutputError):  # the answer is safe; `close` writes them again
                self._write_counts()
        return self._answered(row)

    def go_on(self) -> Json:
        """End a break; at other steps nothing changes."""
        self._is_break = False
        return self.state()

    def stop(self) -> Json:
        """End the session early, as the person wants it; what was answered stays."""
        if (step := self._step()[0]) in ("consent", "done"):
            raise StepError(f"the session is at the step {step}, which cannot be stopped; reload the page")
        self._write(replace(self.record, stopped_at=now()))
        return self.state()

    def close(self) -> None:
        """Write the counts of what was answered; no picture is made any more."""
        self._artist.shutdown(cancel_futures=True)
        self._write_counts()

    @property
    def _monitor(self) -> Monitor:
        assert self.record.monitor is not None  # the step of the session was checked
        return self.record.monitor

    @property
    def _time_limit_ms(self) -> float | None:
        return None if self.record.time_limit_s is None else 1000.0 * self.record.time_limit_s

    def _step(self) -> tuple[Step, NextTrial | None]:
        if self.record.consent is None:
            return "consent", None
        if self.record.stopped_at is not None:
            return "stopped", None
        if self.record.monitor is None:
            return "monitor", None
        following = self._order.next(self._file.rows)
        if following is None:
            return "done", None
        return ("break" if self._is_break else following.phase), following

    def _expect(self, step: Step) -> None:
        if (found := self._step()[0]) != step:
            raise StepError(f"the session is at the step {found}, expected {step}; reload the page")

    def state(self) -> Json:
        """Return the step of the session and what the page shows with it."""
        step, following = self._step()
        rows = self._file.rows
        phase: Phase = "practice" if following is not None and following.phase == "practice" else "main"
        practised = self._order.practised(rows)
        return {
            "step": step,
            "subject": self.record.subject,
            "done": sum(row.phase == phase for row in rows),
            "total": self._order.total(phase, rows),
            "practised": None if practised is None else practised._asdict(),
            "consent_text": self._consent_text,
            "contact": self._contact,
            "dataset": {
                "pixel_pitch_mrad": self._dataset.display.pitch_mrad,
                "width_px": self._frame_px[0],
                "height_px": self._frame_px[1],
            },
            "device_pixel_ratio": None if self.record.monitor is None else self._monitor.device_pixel_ratio,
            "time_limit_ms": self._time_limit_ms,
            "files": str(self._folder),
            "summary": self._summary() if step == "done" else [],
        }

    def _summary(self) -> list[tuple[str, str]]:
        """Return the labels and texts of the last screen."""
        answers = counted_rows(self._file.rows, include_flagged=self.record.include_flagged)
        n_flagged = sum(flagged(self._file.rows).values())
        lines = [("Correct", f"{sum(row.is_correct for row in answers)} of {len(answers)}")]
        if n_flagged and not self.record.include_flagged:
            lines.append(("Left out", f"{n_flagged}: too fast, or given while this page was not in front"))
        return lines

    def _answered(self, row: TrialRow) -> Json:
        flag = None if self.record.include_flagged else row.flag
        is_practice = row.phase == "practice" and flag is None
        return {**self.state(), "correct": row.is_correct if is_practice else None, "flag": flag}

    def _prepare(self) -> Picture:
        step, following = self._step()
        if following is None or step == "break":
            raise StepError(f"the session is at the step {step}, which has no trial; reload the page")
        if self._shown is None:
            picture = self._drawn(following).result()
            self._shown = picture._replace(row=replace(picture.row, shown_at=now()))
        return self._shown

    def _drawn(self, asked: NextTrial) -> Future[Picture]:
        """Return the picture of a trial as it is drawn, anew if a frame could not be used before."""
        drawn = self._pictures.get(asked)
        if drawn is None or (drawn.done() and drawn.exception() is not None):
            drawn = self._artist.submit(make_picture, self._dataset, self._monitor, asked)
        return drawn

    def _look_ahead(self, shown: TrialRow) -> None:
        """Begin to make the pictures of the trials that follow a right and a wrong answer."""
        wrong = next(other for other in ORIENTATIONS if other is not shown.orientation)
        each = (replace(shown, response=response) for response in (shown.orientation, wrong))
        following = [self._order.next([*self._file.rows, row]) for row in each]
        self._pictures = {asked: self._drawn(asked) for asked in following if asked is not None}

    def _write(self, record: SessionRecord) -> None:
        write_sidecar(sidecar_path(self._file.path), record)
        self.record = record

    def _write_counts(self) -> None:
        if self.record.monitor is not None and self._file.rows:
            write_counts(count_file(self._folder, self.record.subject), self.record, self.rows)


def frames_sha256(dataset: Dataset, trial: Trial) -> str:
    """Return the checksum of the file of a trial's frame; of several, that of the lines of their checksums."""
    each = [frame_sha256(dataset.frame_path(frame)) for frame in trial.frames]
    return (
        each[0]
        if len(each) == 1
        else hashlib.sha256("".join(f"{checksum}\n" for checksum in each).encode()).hexdigest()
    )


def now() -> str:
    """Return the time, ISO 8601, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@contextmanager
def open_sitting(
    dataset: Dataset,
    folder: Path | str,
    *,
    subject: str | None = None,
    design: Mapping[str, Any] | None = None,
    consent_text: str | None = None,
    contact: str | None = None,
    progress: Progress | None = None,
) -> Iterator[Sitting]:
    """Begin a session, or continue one that is not finished; its files stay locked in the block. Parameters are
    those of `run_experiment`; the settings of a session that has rows cannot change.
    """
    folder, design = Path(folder), design or {}
    shown = shown_dataset(dataset)
    records = _records_in(folder, shown)
    if subject is None:
        subject = _unfinished_subject(folder, records) or secrets.token_hex(4)
    check_subject(subject)
    new = new_record(dataset, shown, subject, design)
    make_folders(folder, shown, new.software)
    with AnswerFile(data_path(folder, subject)) as file:
        file.begin(shown)
        sidecar = sidecar_path(file.path)
        record = read_sidecar(sidecar) if sidecar.exists() or file.rows else new
        differs = _difference(record, design)
        if record is new or (differs and not file.rows):
            record = new
            write_sidecar(sidecar, record)
        elif differs:
            raise SettingsError(
                f"{differs}, but subject {subject} has answered trials; take another {argument.subject}"
            )
        elif record.stopped_at is not None:
            record = replace(record, stopped_at=None)
            write_sidecar(sidecar, record)
        order = TrialOrder(dataset.trials, record)
        order.check(file)
        if order.next(file.rows) is None:
            raise SettingsError(f"{argument.subject}: {subject} has finished; leave it out, or take another one")
        contact = contact or CONTACT
        text = record.consent.text if record.consent else consent_text or CONSENT.format(contact=contact)
        frame_px, contrasts = frames_shown(dataset, order.candidates, progress)
        sitting = Sitting(
            dataset,
            folder,
            record,
            file,
            consent_text=text,
            contact=contact,
            frame_px=frame_px,
            contrasts=contrasts,
        )
        try:
            yield sitting
        finally:
            sitting.close()


def shown_dataset(dataset: Dataset) -> ShownDataset:
    """Return the properties of a dataset that a session depends on; raise an error if the dataset cannot be
    shown."""
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
    is_other = not folder.is_dir() or any(not file.name.startswith(".") for file in folder.iterdir())
    if is_other and not (folder / DESCRIPTION_FILE).exists():
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
    """Return the subject of the only session that is neither finished nor stopped; None if all are."""
    unfinished = []
    for path, record in records:
        rows = read_rows(path, record.dataset) if path.exists() else ()
        n_main = sum(row.phase == "main" for row in rows)
        if record.stopped_at is None and n_main < n_main_trials(record, rows):
            unfinished.append(record.subject)
    if len(unfinished) > 1:
        raise SettingsError(
            f"{folder}: the sessions of {', '.join(unfinished)} are not finished; say which with "
            f"{argument.subject}, or a "
            "new one"
        )
    return unfinished[0] if unfinished else None


def new_record(dataset: Dataset, shown: ShownDataset, subject: str, design: Mapping[str, Any]) -> SessionRecord:
    """Return the record of a new session, with defaults for what the design leaves open."""
    n_trials = len(dataset.trials)
    of_quest = min(QUEST_TRIALS * len(dataset.trials.groups), n_trials)
    trials = design.get("trials", of_quest if design.get("method") == "quest" else n_trials)
    if trials > n_trials:
        raise SettingsError(
            f"{argument.trials}: found {trials}, expected at most {n_trials}, the trials of the dataset"
        )
    return SessionRecord(
        subject=subject,
        started=now(),
        software={"todframes": __version__, "python": platform.python_version(), "numpy": np.__version__},
        dataset=shown,
        **{"seed": secrets.randbelow(2**32), **design, "trials": trials},
    )


def _difference(record: SessionRecord, design: Mapping[str, Any]) -> str | None:
    """Return the first setting in which the session differs from the design, with both values; or None."""
    for name, asked in design.items():
        if asked != (found := getattr(record, name)):
            return f"{getattr(argument, name)}: found {asked}, the session has {found}"
    return None


def frames_shown(
    dataset: Dataset, indices: Sequence[int], progress: Progress | None
) -> tuple[tuple[int, int], list[ContrastRange]]:
    """Read the trials that a session may show; return the largest width and height, and all contrasts."""
    blue_noise()  # takes a quarter of a second, which the first trial shall not take
    contrasts, sides = [], [(0, 0)]
    for index in counted(indices, len(indices), progress):
        trial = dataset.trials[index]
        image = trial_image(dataset, trial)
        contrasts.append(contrast_range(trial, image))
        sides.append(image.contrast.shape[::-1])
    width, height = (max(of_side) for of_side in zip(*sides, strict=True))
    return (width, height), contrasts
