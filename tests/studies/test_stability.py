"""Every case of `todframes stability`, and that the command tells when one falls short."""

from __future__ import annotations

import json
import math
import re
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import error_line

from todframes.base.errors import SettingsError
from todframes.studies.stability import case as stability
from todframes.studies.stability.case import (
    ENTRY_POINT_GROUP,
    Case,
    digits_kept,
    find_cases,
    refusal,
    run_case,
    shortfall,
)

CASES = find_cases()
PAGE = (Path(__file__).parents[2] / "docs" / "evidence" / "stability.md").read_text(encoding="utf-8")

EXACT = Case("some", "exact", 1.5, "closed form", lambda: 1.5)
SHORT = Case("some", "short", [2.0, 4.0], "closed form", lambda: [2.0, 4.0 + 4e-4], 6)

OTHER_OBSERVERS = ("csf", "oriented", "informative")

SLOW = (
    "curve: 1,000 display ",
    "curve: SNR",
    "curve: 43 mrad",
    "bars: NETD",
    "observer: 2,000 ",
    "observer: 500 ",
)
"""Cases that take seconds each."""


def param(case: Case) -> Any:
    name = f"{case.group}: {case.name}"
    return pytest.param(case, id=name, marks=[pytest.mark.slow] if name.startswith(SLOW) else [])


@pytest.mark.parametrize("case", [param(case) for case in CASES])
def test_case_holds(case: Case) -> None:
    assert shortfall([run_case(case)]) is None


def test_both_packages_offer_cases() -> None:
    assert {entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)} >= {"todframes", "sensor_sim"}
    groups = list(dict.fromkeys(case.group for case in CASES))
    of_todframes = ["decision", "observer", "fit", "frame", *OTHER_OBSERVERS, "range", "scenes"]
    assert groups == [*of_todframes, "transfer", "samples", "display", "curve", "bars"]
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize(
    ("expected", "came", "scale", "digits"),
    [
        (1.0, 1.0, None, 16.0),
        (2.0, 2.0002, None, 4.0),
        ([1e-30, 1.0], [1.01e-30, 1.0], None, 2.0),
        ([1e-30, 1.0], [1.01e-30, 1.0], 1.0, 16.0),
        (0.0, 1e-6, None, 0.0),
        (0.0, 1e-6, 1.0, 6.0),
        (0.0, 0.0, None, 16.0),
        (1.0, 30.0, None, 0.0),
        (1.0, math.nan, None, 0.0),
        ([1.0, 1.0], 1.0, None, 0.0),
    ],
)
def test_digits_are_those_of_the_worst_number(expected, came, scale, digits) -> None:
    assert digits_kept(expected, came, scale=scale) == pytest.approx(digits, abs=1e-6)


def test_warning_and_exception_are_what_came() -> None:
    def warn() -> float:
        warnings.warn("beware", RuntimeWarning, stacklevel=1)
        return 1.0

    for compute, came in (
        (warn, "RuntimeWarning: beware"),
        (lambda: [][0], "IndexError: list index out of range"),
    ):
        outcome = run_case(Case("some", "loud", 1.0, "closed form", compute))
        assert (outcome.computed, outcome.holds) == (came, False)
    assert not run_case(Case("some", "text", 1.0, "closed form", lambda: "ok")).holds
    assert not run_case(Case("some", "text", "ok", "closed form", lambda: 1.0)).holds
    assert run_case(Case("some", "text", "ok", "closed form", lambda: "ok")).holds


@pytest.mark.parametrize("expected", [1.0, "ok"])
def test_a_case_that_takes_too_long_falls_short(monkeypatch, expected) -> None:
    clock = iter([0.0, 4.0])
    monkeypatch.setattr(stability.time, "process_time", lambda: next(clock))
    outcome = run_case(Case("some", "slow", expected, "closed form", lambda: expected))
    assert (outcome.computed, outcome.holds) == ("4 s of CPU time, expected at most 3", False)


def test_refusal_is_one_line_with_the_reason() -> None:
    def refuse() -> None:
        raise SettingsError("size_mrad: found -1, expected a number > 0")

    assert refusal(refuse, "size_mrad") == "refused"
    assert refusal(refuse, "contrast") == "refused: size_mrad: found -1, expected a number > 0"
    assert refusal(lambda: None, "size_mrad") == "accepted"


@pytest.fixture
def few_cases(monkeypatch) -> None:
    monkeypatch.setattr(stability, "find_cases", lambda: [EXACT, SHORT])


@pytest.mark.usefixtures("few_cases")
def test_command_ends_with_1_and_names_what_falls_short(todframes) -> None:
    status, out, err = todframes("stability")
    assert status == 1
    assert re.search(r"^ *short +2 … 4 \(2\) +closed form +2 … 4\.0004 \(2\) +4\.0 +6 *$", out, re.MULTILINE)
    assert err == "error: stability: 1 case falls short: some: short (found 4.0 digits, expected 6)\n"


def test_command_ends_with_0_where_all_hold(monkeypatch, todframes) -> None:
    monkeypatch.setattr(stability, "find_cases", lambda: [EXACT])
    status, out, err = todframes("stability")
    assert (status, err) == (0, "") and re.search(r"^1 cases?, \d+\.\d\d s$", out, re.MULTILINE)


@pytest.mark.usefixtures("few_cases")
def test_json_is_one_object(todframes) -> None:
    status, out, _ = todframes("stability", "--json")
    result = json.loads(out)
    assert status == 1
    assert (result["schema"], result["command"]) == (1, "stability")
    assert result["run_time_s"] >= 0
    assert result["cases"] == [
        {"group": "some", "name": "exact", "expected": 1.5, "source": "closed form", "came": 1.5,
         "digits": 16.0, "digits_bound": 6.0, "holds": True},
        {"group": "some", "name": "short", "expected": [2.0, 4.0], "source": "closed form", "came": [2.0, 4.0004],
         "digits": pytest.approx(4.0, abs=1e-6), "digits_bound": 6, "holds": False},
    ]  # fmt: skip


def test_json_or_page(todframes) -> None:
    assert "expected one of them" in error_line(todframes("stability", "--json", "--markdown"))


def test_page_counts_the_cases() -> None:
    """Cases of each part, those of them that compare text, and the least and most digits that others must keep."""
    digits_column = r"(?:(\d+) to )?(\d+)"
    rows = re.findall(rf"^\| (\w+) \| [^|]* \| (\d+) \| (\d+) \| {digits_column} \| [^|]* \|$", PAGE, re.MULTILINE)
    expected = []
    for group in dict.fromkeys(case.group for case in CASES):
        members = [case for case in CASES if case.group == group]
        digits = [f"{case.digits:g}" for case in members if not isinstance(case.expected, str)]
        least, most = min(digits, key=int), max(digits, key=int)
        n_texts = len(members) - len(digits)
        expected.append((group, str(len(members)), str(n_texts), "" if least == most else least, most))
    assert rows == expected
    assert f"{len(CASES)} of them" in PAGE


@pytest.mark.usefixtures("few_cases")
def test_markdown_has_a_row_for_each_case(todframes) -> None:
    status, page, _ = todframes("stability", "--markdown")
    assert status == 1 and "## Some" in page
    assert "| exact | 1.5 | closed form | 1.5 | 16.0 | 6 |" in page
    assert "| short | 2 … 4 (2) | closed form | 2 … 4.0004 (2) | 4.0 | 6 |" in page


def test_no_case_has_an_expectation_that_is_not_a_number() -> None:
    for case in CASES:
        if not isinstance(case.expected, str):
            assert np.isfinite(np.asarray(case.expected, dtype=float)).all(), case.name
            assert case.digits > 0
