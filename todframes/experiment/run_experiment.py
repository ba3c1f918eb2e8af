"""The call that serves the page of the experiment, and the requests by which the page goes through a session."""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from todframes.base.errors import OutputError
from todframes.base.reading import checked, read_text
from todframes.base.seeds import Rng, seed_of
from todframes.experiment.answers import NO_RESPONSE, flagged
from todframes.experiment.monitor import Calibration
from todframes.experiment.order import n_main_trials
from todframes.experiment.session import Sitting, StepError, open_sitting
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
from todframes.stimulus import Orientation
from todframes.web import check_installed

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

T = TypeVar("T")

MAX_CONSENT_MB = 1
"""Largest size of a text of consent, in units of 2**20 bytes."""


class Agreed(msgspec.Struct):
    """The answer of the person to the text of consent."""

    agreed: bool


class Answer(msgspec.Struct):
    """The answer to a trial, the time from the picture to the answer, and whether the page was hidden or unfocused
    meanwhile."""

    number: Annotated[int, Meta(ge=1, le=2**31)]
    response: Literal["up", "right", "down", "left", "none"]
    response_time_ms: Annotated[float, Meta(ge=0.0, le=1e9)]
    lost: Literal["hidden", "unfocused"] | None = None


def experiment_app(sitting: Sitting) -> Starlette:
    """Return the app of a session, to be put behind `todframes.web.server.guarded`."""
    from starlette.responses import Response
    from starlette.routing import Route

    from todframes.web.server import EmptyRequest, call, error_of, json_answer, page

    lock = threading.Lock()  # calls run in threads

    def step(path: str, kind: type[T], function: Callable[[T], object]) -> Route:
        def one_at_a_time(asked: T) -> object:
            with lock:
                return function(asked)

        return call(path, kind, one_at_a_time)

    async def stimulus(request: Request) -> Response:
        return Response(sitting.picture(request.path_params["number"]), media_type="image/png")

    def answer(asked: Answer) -> object:
        response = None if asked.response == NO_RESPONSE else Orientation(asked.response)
        return sitting.answer(asked.number, response, asked.response_time_ms, lost=asked.lost)

    app = page(
        files("todframes.experiment") / "static",
        [
            step("/api/state", EmptyRequest, lambda _: sitting.state()),
            step("/api/consent", Agreed, lambda asked: sitting.consent(asked.agreed)),
            step("/api/monitor", Calibration, sitting.calibrate),
            step("/api/trial", EmptyRequest, lambda _: sitting.trial()),
            Route("/stimulus/{number:int}.png", stimulus),
            step("/api/answer", Answer, answer),
            step("/api/continue", EmptyRequest, lambda _: sitting.go_on()),
            step("/api/stop", EmptyRequest, lambda _: sitting.stop()),
        ],
    )
    # After 507 the page repeats its request until there is room on the disk.
    for kind, status in ((StepError, 409), (OutputError, 507)):
        app.add_exception_handler(kind, lambda _, error, status=status: json_answer(error_of(error), status))
    return app


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
    settings = {
        "method": method,
        "trials": trials,
        "practice": practice,
        "practice_correct": practice_correct,
        "break_every": break_every,
        "time_limit_s": time_limit_s,
        "background": background,
        "dither": dither,
        "include_flagged": include_flagged,
        "seed": None if rng is None else seed_of(rng),
    }
    design = {name: value for name, value in settings.items() if value is not None}
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
