"""The Python calls that serve a page of `todframes`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from todframes.base.locations import Location
from todframes.base.reading import read_text
from todframes.base.seeds import Rng, seed_of
from todframes.experiment.answers import Method, flagged
from todframes.experiment.order import n_main_trials
from todframes.experiment.session import SessionDesign, open_sitting
from todframes.frames.dataset import Dataset, load_dataset
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


def run_experiment(
    dataset: Location | str | Dataset,
    answers: Path | str,
    *,
    subject: str | None = None,
    method: Method | None = None,
    trials: int | None = None,
    practice: int | None = None,
    practice_correct: float | None = None,
    break_every: int | None = None,
    time_limit_s: float | None = None,
    background: float | None = None,
    dither: bool | None = None,
    include_flagged: bool | None = None,
    rng: Rng | None = None,
    consent: Path | str | None = None,
    contact: str | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    tell: Callable[[str], None] = print,
    warn: Callable[[str], None] | None = None,
    progress: Callable[[int], None] | None = None,
) -> SessionProgress:
    """Serve a page on which a person does the test on the frames of a dataset, as `todframes experiment` does.

    The call returns when Ctrl-C is pressed, or the process is asked to end. The same call continues a session that
    is not finished.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames, its URL, or the return value of `load_dataset`.
    answers : path
        Folder for the answers, of this and other people; made if it does not exist.
    subject : str, optional
        Anonymous id, letters and digits. Default: that of the only session that is not finished, or a random one.
    method : {"constant", "quest"}, optional
        Show trials of the dataset in random order (default), or let QUEST+ choose the level.
    trials : int, optional
        Number of trials that count. Default: all of the dataset; for quest 60 a group.
    practice, break_every : int, optional
        Number of trials with feedback before, default 8, and of trials between breaks, default 60; 0 for none.
    practice_correct : float, optional
        Share of the practice trials that has to be correct; otherwise they are repeated. Default: 0.75.
    time_limit_s : float, optional
        Time in which to answer. Default: no limit.
    background : float, optional
        Luminance of the background over that of white. Default: 0.5.
    dither : bool, optional
        Show a luminance between two code values by a mixture of pixels of both. Default: True.
    include_flagged : bool, optional
        Count answers that came within 150 ms, or while the page was hidden or had lost the focus, as all others.
        Default: False; their trials are shown again later.
    rng : int, SeedSequence or Generator, optional
        Seed of the order. Default: a random one.
    consent : path, optional
        File of the text that the person is to agree to. Default: a text of this package.
    contact : str, optional
        Name and address for questions and withdrawal, for the text of this package and the last screen.
    host, port : str, int
        Address or name of this machine to listen at; port 0 is a free one.
    open_browser : bool
        Whether to open the page in the browser.
    tell : function of a text
        Called with the address of the page when the server listens. Nobody can open the page without this address.
    warn : function of a text, optional
        Called with a remark if other machines can reach the server.
    progress : function of an int, optional
        Called with 1 for each trial whose frames were read, before the server listens.

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
    from todframes.web.experiment import experiment_app
    from todframes.web.server import Launch, serve

    launch = Launch(host=host, port=port, open_browser=open_browser)
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    text = None if consent is None else read_text(Path(consent), most_mb=MAX_CONSENT_MB)
    with open_sitting(
        data,
        answers,
        subject=subject,
        design=design,
        consent_text=text,
        contact=contact,
        progress=progress,
    ) as sitting:
        serve(experiment_app(sitting), launch, tell=tell, warn=warn)
    rows, record = sitting.rows, sitting.record
    n_answered = sum(row.phase == "main" for row in rows)
    return SessionProgress(record.subject, n_answered, n_main_trials(record, rows), sum(flagged(rows).values()))
