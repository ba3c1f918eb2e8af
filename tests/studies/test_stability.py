"""Every case of `todframes stability`, and that the command says when one falls short."""

from __future__ import annotations

import json
import math
import re
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from conftest import error_line

from todframes.studies.stability import cases as stability
from todframes.studies.stability.cases import ENTRY_POINT_GROUP, Case, digits_kept, find_cases, run_case, shortfall

CASES = find_cases()
PAGE = (Path(__file__).parents[2] / "docs" / "evidence" / "stability.md").read_text(encoding="utf-8")

EXACT = Case("some", "exact", 1.5, "closed form", lambda: 1.5)
SHORT = Case("some", "short", [2.0, 4.0], "closed form", lambda: [2.0, 4.0 + 4e-4], 6)

SLOW = ("1,000 display ", "SNR 1e-9 and", "NETD", "2,000 ")
"""Cases that take seconds each."""


def param(case: Case) -> Any:
    marks = [pytest.mark.slow] if case.name.startswith(SLOW) else []
    return pytest.param(case, id=f"{case.group}: {case.name}", marks=marks)


@pytest.mark.parametrize("case", [param(case) for case in CASES])
def test_case_holds(case: Case) -> None:
    assert shortfall([run_case(case)]) is None


@pytest.mark.parametrize(
    ("expected", "came", "digits"),
    [
        (1.0, 1.0, 16.0),
        (2.0, 2.0002, 4.0),
        ([1e-30, 1.0], [1.01e-30, 1.0], 2.0),
        (0.0, 1e-6, 0.0),
        (0.0, 0.0, 16.0),
        (1.0, 30.0, 0.0),
        (1.0, math.nan, 0.0),
        ([1.0, 1.0], 1.0, 0.0),
    ],
)
def test_digits_are_those_of_the_worst_number(expected, came, digits) -> None:
    assert digits_kept(expected, came) == pytest.approx(digits, abs=1e-6)


def test_warning_exception_and_too_much_time_fall_short(monkeypatch) -> None:
    def warn() -> float:
        warnings.warn("beware", RuntimeWarning, stacklevel=1)
        return 1.0

    def came(compute: Any) -> tuple[Any, bool]:
        outcome = run_case(Case("some", "loud", 1.0, "closed form", compute))
        return outcome["came"], outcome["holds"]

    assert came(warn) == ("RuntimeWarning: beware", False)
    assert came(lambda: [][0]) == ("IndexError: list index out of range", False)
    clock = iter([0.0, 13.0])
    monkeypatch.setattr(stability.time, "process_time", lambda: next(clock))
    assert came(lambda: 1.0) == ("13 s of CPU time, expected at most 12", False)


@pytest.fixture
def few_cases(monkeypatch) -> None:
    monkeypatch.setattr(stability, "find_cases", lambda: [EXACT, SHORT])


@pytest.mark.usefixtures("few_cases")
def test_command_ends_with_1_and_names_what_falls_short(todframes) -> None:
    status, out, err = todframes("stability")
    assert status == 1
    assert re.search(r"^ *short +2 … 4 \(2\) +closed form +2 … 4\.0004 \(2\) +4\.0 +6 *$", out, re.MULTILINE)
    assert err == "error: stability: 1 case falls short: some: short (found 4.0 digits, expected 6 digits)\n"
    status, page, _ = todframes("stability", "--markdown")
    assert status == 1 and "## Some" in page
    assert "| exact | 1.5 | closed form | 1.5 | 16.0 | 6 |" in page
    assert "| short | 2 … 4 (2) | closed form | 2 … 4.0004 (2) | 4.0 | 6 |" in page


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
    assert "expected one of them" in error_line(todframes("stability", "--json", "--markdown"))


def test_page_counts_the_cases_of_both_packages() -> None:
    """Cases of each part, and the least and most digits that they must keep."""
    assert {entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)} >= {"todframes", "sensor_sim"}
    rows = re.findall(r"^\| ([\w ]+) \| [^|]* \| (\d+) \| (?:(\d+) to )?(\d+) \| [^|]* \|$", PAGE, re.MULTILINE)
    expected = []
    for group in dict.fromkeys(case.group for case in CASES):
        digits = [case.digits for case in CASES if case.group == group]
        least, most = f"{min(digits):g}", f"{max(digits):g}"
        expected.append((group, str(len(digits)), "" if least == most else least, most))
    assert rows == expected
    assert f"{len(CASES)} of them" in PAGE
    assert len({case.name for case in CASES}) == len(CASES)
