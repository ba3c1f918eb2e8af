"""The command `experiment`, which serves a page on which a person does the test."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from todframes.cli.console import echo, progress, say


def experiment(given: dict[str, Any], *_: object) -> None:
    """Serve the page, and say how far the session is."""
    from todframes.experiment.run_experiment import run_experiment
    from todframes.frames.dataset import load_dataset

    limit = {name: given.pop(name) for name in ("max_frame_mb",) if name in given}
    data = load_dataset(given.pop("dataset"), **limit)
    with ExitStack() as reading:
        advance = reading.enter_context(progress("reading"))

        def tell(address: str) -> None:
            reading.close()
            echo(address)

        found = run_experiment(data, tell=tell, warn=say, progress=advance, **given)
    rest = "" if found.n_answered == found.n_trials else "; the same command goes on"
    flagged = f", {found.n_flagged} with a flag" if found.n_flagged else ""
    answered = f"{found.n_answered} of {found.n_trials} trials"
    echo(f"{given['answers']}: subject {found.subject}, {answered}{flagged}{rest}")
