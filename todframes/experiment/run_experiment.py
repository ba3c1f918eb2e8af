"""The Python calls that serve a page of `todframes`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from todframes.base.reading import checked, read_text
from todframes.base.seeds import Rng, seed_of
from todframes.experiment.answers import flagged
from todframes.experiment.order import n_main_trials
from todframes.experiment.session import SessionDesign, open_sitting
from todframes.frames.dataset import Dataset, load_dataset
from todframes.parameters import (
    AnswersFolder,
    Method,
    NamedTable,
    PersonId,
    Port,
    Progress,
    Seconds,
    Seed,
    Share,
    WholeNumber,
)
from todframes.web import check_installed

MAX_CONSENT_MB = 1
"""Largest size of a text of consent, in units of 2**20 bytes."""


class SessionProgress(NamedTuple):
    """Progress of a session of an experiment.

    Attributes
    ----------
    subject : str
        Id of the person.
    n_answered, n_trials : int
        Number of answers so far, and of all trials.
    n_flagged : int
        Number of answers with a flag, such as those within 150 ms, which do not count.
    """

    subject: str
    n_answered: int
    n_trials: int
    n_flagged: int


@checked
def run_experiment(
    dataset: Path | str | Dataset,
    answers: AnswersFolder,
    *,
    subject: PersonId | None = None,
    method: Method | None = None,
    trials: WholeNumber | None = None,
    practice: WholeNumber | None = None,
    practice_correct: Share | None = None,
    break_every: WholeNumber | None = None,
    time_limit_s: Seconds | None = None,
    background: float | None = None,
    dither: bool | None = None,
    include_flagged: bool | None = None,
    rng: Seed | Rng | None = None,
    consent: NamedTable | None = None,
    contact: str | None = None,
    host: str = "127.0.0.1",
    port: Port = 0,
    open_browser: bool = True,
    tell: Callable[[str], None] = print,
    warn: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> SessionProgress:
    """Open a page in the browser on which a person says where the triangles of a dataset point.

    Each answer is on the disk before the next triangle is shown. The same command or call goes on with a session
    that is not finished. Ctrl-C ends the server.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames.

        The return value of `load_dataset` is taken as well.
    answers : path
        Folder for the answers of people; it is made if it does not exist.
    subject : str, optional
        Anonymous id of the person: letters and digits. Default: that of the only session that is not finished, or
        a random one.
    method : {"constant", "quest"}, optional
        Show the trials of the dataset in random order, or let QUEST+ choose the level. Default: constant.
    trials : int, optional
        Number of trials that count. Default: all; for quest 60 a group.
    practice : int, optional
        Trials with feedback before the test, 0 for none. Default: 8.
    practice_correct : float, optional
        Share of the practice that has to be correct; else it goes on until the last ones are. Default: 0.75.
    break_every : int, optional
        Trials between breaks, 0 for none. Default: 60.
    time_limit_s : float, optional
        Time to answer in s. Default: none.
    background : float, optional
        Luminance of the background over that of white. Default: 0.5.
    dither : bool, optional
        Show a luminance between two code values by pixels of both. Otherwise show the nearest code value.
    include_flagged : bool, optional
        Count answers within 150 ms, or while the page was hidden or had lost the focus, as all others.

        Without it, their trials are shown again later.
    rng : int, SeedSequence or Generator, optional
        Seed of the order. Default: a random one.
    consent : path, optional
        Text to which the person has to agree. Default: a text of this package.
    contact : str, optional
        Name and address for questions and withdrawal.
    host : str
        Address or name of this machine to listen at.
    port : int
        Port to listen at. 0 is a free one.
    open_browser : bool
        Open the page in the browser. Otherwise print the address only.
    tell : function of a text
        Called with the address of the page when the server listens. Nobody can open the page without this address.
    warn : function of a text, optional
        Called with a remark if other machines can reach the server.
    progress : function of two ints, optional
        Called with the number of trials whose frames are read, and of all.

    Returns
    -------
    SessionProgress
        Progress of the session.

    Raises
    ------
    DataError, FrameError
        If the dataset or a frame cannot be used, or a file of answers is damaged.
    SettingsError
        If a setting is invalid, the server cannot listen there, or Starlette or uvicorn is not installed.
    OutputError
        If the answers cannot be written, or another server is in the session.
    """
    check_installed("experiment")
    design = SessionDesign(
        method=method,
        trials=trials,
        practice=practice,
        practice_correct=practice_correct,
        break_every=break_every,
        time_limit_s=time_limit_s,
        background=background,
        dither=dither,
        include_flagged=include_flagged,
        seed=None if rng is None else seed_of(rng),
    )
    from todframes.experiment.served_page import experiment_app
    from todframes.web.server import open_listener, serve

    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    text = None if consent is None else read_text(Path(consent), most_mb=MAX_CONSENT_MB)
    with (
        open_listener(host, port) as listener,
        open_sitting(
            data, answers, subject=subject, design=design, consent_text=text, contact=contact, progress=progress
        ) as sitting,
    ):
        serve(experiment_app(sitting), listener, host=host, open_browser=open_browser, tell=tell, warn=warn)
    rows, record = sitting.rows, sitting.record
    n_answered = sum(row.phase == "main" for row in rows)
    return SessionProgress(record.subject, n_answered, n_main_trials(record, rows), sum(flagged(rows).values()))
