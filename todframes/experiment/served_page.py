"""The server's side of the experiment: its files, and the calls by which the page goes through a session."""

from __future__ import annotations

from functools import partial
from importlib.resources import files
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from todframes.base.errors import OutputError
from todframes.experiment.answers import NO_RESPONSE
from todframes.experiment.monitor import Calibration
from todframes.experiment.session import Sitting, StepError
from todframes.stimulus import Orientation
from todframes.web.pages import EmptyRequest, call, error_of, json_answer, page

STATUS = {StepError: 409, OutputError: 507}
"""HTTP status for kinds of errors; after 507 the page repeats its request until there is room on the disk."""


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

    async def stimulus(request: Request) -> Response:
        picture = await run_in_threadpool(sitting.picture, request.path_params["number"])
        return Response(picture, media_type="image/png")

    def answer(asked: Answer) -> object:
        response = None if asked.response == NO_RESPONSE else Orientation(asked.response)
        return sitting.answer(asked.number, response, asked.response_time_ms, lost=asked.lost)

    app = page(
        files("todframes.experiment") / "static",
        [
            call("/api/state", EmptyRequest, lambda _: sitting.state()),
            call("/api/consent", Agreed, lambda asked: sitting.consent(asked.agreed)),
            call("/api/monitor", Calibration, sitting.calibrate),
            call("/api/trial", EmptyRequest, lambda _: sitting.trial()),
            Route("/stimulus/{number:int}.png", stimulus),
            call("/api/answer", Answer, answer),
            call("/api/continue", EmptyRequest, lambda _: sitting.go_on()),
            call("/api/stop", EmptyRequest, lambda _: sitting.stop()),
        ],
    )
    for kind, status in STATUS.items():
        app.add_exception_handler(kind, partial(_refused, status))
    return app


def _refused(status: int, _: Request, error: Exception) -> Response:
    return json_answer(error_of(error), status)
