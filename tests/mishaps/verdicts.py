"""Scores the mishaps and prints a table of how each ends: python tests/mishaps/verdicts.py [NAME …].

The exit status is 1 if one of them gets a confident wrong number, or a recording without a mishap a warning.
"""

from __future__ import annotations

import io
import json
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mishaps import BACKGROUNDS, CASES, CONTROLS, Case

from todframes.cli.console import keep_libraries_to_one_thread, run
from todframes.cli.main import cli

TOLERANCE = 0.03
"""Largest relative error of a threshold that is right."""
BAD_ENDS = ("FALSE ALARM", "WRONG", "UNCLEAR ERROR", "OTHER WARNING", "NO WARNING")
"""Verdicts that no case may have."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How the scoring of a dataset ended: with a status, a threshold and warnings, or with an error's message."""

    status: str = ""
    threshold: float | None = None
    warnings: Sequence[str] = ()
    error: str = ""

    @property
    def shown(self) -> str:
        """What a user sees first."""
        return f"{self.threshold:.4f}" if self.threshold is not None else self.status or "error:"


def score(folder: Path) -> Outcome:
    """Score a dataset with the command."""
    out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        exit_status = run(cli, ["score", str(folder), "--json", "--quiet"])
    if exit_status:
        lines = err.getvalue().splitlines()
        assert exit_status in (1, 2) and len(lines) == 1, err.getvalue()
        return Outcome(error=lines[0])
    out.seek(0)
    result = json.load(out)
    (fit,) = result["fits"]
    codes = tuple(dict.fromkeys(one["code"] for one in result["warnings"]))
    return Outcome(status=fit["status"], threshold=fit["threshold"], warnings=codes)


def outcomes(case: Case, folder: Path, rules: Sequence[str] | None = None) -> dict[str, Outcome]:
    """Record a case in a new folder and score it with each of its backgrounds, or with these."""
    case.recording.write(folder)
    found = {}
    for rule in case.rules if rules is None else rules:
        case.recording.declare(folder, BACKGROUNDS[rule])
        found[rule] = score(folder)
    return found


@cache
def right_threshold() -> float:
    """Threshold of the same camera and triangles without a mishap."""
    with tempfile.TemporaryDirectory() as folder:
        threshold = outcomes(CONTROLS[0], Path(folder) / "flat")["number"].threshold
    assert threshold is not None
    return threshold


def verdict(case: Case, outcome: Outcome) -> str:
    """Return how a case ended, in a word; in capitals if it must not end so."""
    is_right = outcome.threshold is not None and abs(outcome.threshold / right_threshold() - 1.0) <= TOLERANCE
    if case.control:
        if outcome.warnings or outcome.error:
            return "FALSE ALARM"
        return "clean" if outcome.status == "ok" and (is_right or not case.is_right) else "WRONG"
    if case.refused and re.search(case.refused, outcome.error or outcome.status):
        return "refused"
    if outcome.error:
        return "UNCLEAR ERROR"
    if case.codes.intersection(outcome.warnings):
        return "warned"
    if is_right:
        return "right"
    return "OTHER WARNING" if outcome.warnings else "NO WARNING"


def lines(cases: Sequence[Case]) -> Iterator[str]:
    """Yield the lines of a table in Markdown: the case, its end with each background, and its warnings."""
    yield f"| {' | '.join(['recording', '', *BACKGROUNDS, 'warnings'])} |"
    yield "|" + " --- |" * (len(BACKGROUNDS) + 3)
    with tempfile.TemporaryDirectory() as folder:
        for case in cases:
            found = outcomes(case, Path(folder) / case.name)
            ends = [
                f"{found[rule].shown} {verdict(case, found[rule])}" if rule in found else ""
                for rule in BACKGROUNDS
            ]
            codes = dict.fromkeys(code for one in found.values() for code in one.warnings)
            cells = [f"`{case.name}`", case.sentence, *ends, ", ".join(f"`{code}`" for code in codes)]
            yield f"| {' | '.join(cells)} |"


def main(names: Sequence[str]) -> int:
    """Print the table of the named cases, or of all. Returns the exit status."""
    keep_libraries_to_one_thread()
    print(f"The right threshold is {right_threshold():.4f}.\n")
    is_bad = False
    for line in lines([case for case in CASES if not names or case.name in names]):
        print(line, flush=True)
        is_bad |= any(end in line for end in BAD_ENDS)
    return int(is_bad)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
