"""Extreme inputs and their expected results: cases, the number of right digits of each, and a table.  The expected
value comes from outside of the code under test: a closed form, a law that holds exactly, algebra with fractions,
or mpmath at 50 digits. Packages name functions that make cases under the entry-point group
`todframes.stability_cases`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base.errors import TodframesError
from todframes.base.user_code import registered
from todframes.results.data import Record
from todframes.results.result import Result
from todframes.results.table import Column, Table

ENTRY_POINT_GROUP = "todframes.stability_cases"

MPMATH = "mpmath, 50 digits: "
"""First word of the source of numbers that test_stability_references.py computes again."""

MOST_DIGITS = 16.0
"""Digits of double precision, which exact results have."""

Value = str | float | ArrayLike


class Stability(Result, frozen=True, kw_only=True):
    """The cases of `stability` as they stand in its JSON."""

    cases: tuple[Record, ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme input and the result that it must have: a text as it stands, each number to so many digits.
    `scale` is the unit of errors; None: each number itself, so that a 0 must be exact. `cpu_s` is the CPU time
    within which the case must end, three times what it takes or more.
    """

    group: str
    name: str
    expected: Value
    source: str
    compute: Callable[[], Value]
    digits: float = 6.0
    scale: float | None = None
    cpu_s: float = 3.0


class Outcome(NamedTuple):
    """Result of a case; an exception or a warning comes as text. `digits` is None where text is compared."""

    case: Case
    computed: Value
    digits: float | None
    holds: bool

    @property
    def record(self) -> Record:
        """The case and its result as in the JSON object."""
        case, computed, digits, holds = self
        return {
            "group": case.group,
            "name": case.name,
            "expected": case.expected if isinstance(case.expected, str) else np.asarray(case.expected).tolist(),
            "source": case.source,
            "came": computed if isinstance(computed, str) else np.asarray(computed).tolist(),
            "digits": digits,
            "digits_bound": None if digits is None else case.digits,
            "holds": holds,
        }

    @property
    def cells(self) -> Record:
        """The row of the table."""
        case, computed, digits, holds = self
        return {
            "group": case.group,
            "case": case.name,
            "expected": shown(case.expected, case),
            "source": case.source,
            "computed": shown(computed, case),
            "digits": ("equal" if holds else "different") if digits is None else f"{digits:.1f}",
            "required": "equal" if digits is None else f"{case.digits:g}",
        }

    @property
    def difference(self) -> str:
        """The case, and what was found in place of what."""
        case, computed, digits, _ = self
        found, expected = f"{shown(computed, case)}", f"{shown(case.expected, case)}"
        if digits is not None:
            found, expected = f"{digits:.1f} digits", f"{case.digits:g}"
        return f"{case.group}: {case.name} (found {found}, expected {expected})"


def find_cases() -> list[Case]:
    """List the cases of all installed packages, those of todframes first."""
    entries = sorted(registered(ENTRY_POINT_GROUP).values(), key=lambda entry: entry.name != "todframes")
    return [case for entry in entries for case in entry.load()()]


def run_case(case: Case) -> Outcome:
    """Compute a case. A warning, an exception and too much CPU time are its result; it falls short."""
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            computed = case.compute()
    except Exception as error:
        computed = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if (cpu_s := time.process_time() - started) > case.cpu_s:
        computed = f"{cpu_s:.0f} s of CPU time, expected at most {case.cpu_s:g}"
    if isinstance(case.expected, str) or isinstance(computed, str):
        return Outcome(case, computed, None, isinstance(computed, str) and computed == case.expected)
    digits = digits_kept(case.expected, computed, scale=case.scale)
    return Outcome(case, computed, digits, digits >= case.digits)


def digits_kept(expected: ArrayLike, computed: ArrayLike, *, scale: float | None = None) -> float:
    """Count the decimal digits that the worst of some numbers has right, 0 to 16; errors are in units of `scale`,
    or of each number expected.
    """
    right, found = np.asarray(expected, dtype=np.float64), np.asarray(computed, dtype=np.float64)
    if right.shape != found.shape or not np.isfinite(found).all():
        return 0.0
    error = np.abs(found - right)
    unit = np.abs(right) if scale is None else np.full_like(right, scale)
    # 0 is right exactly or not at all.
    relative = np.divide(error, unit, out=np.where(error > 0, 1.0, 0.0), where=unit > 0)
    return float(np.clip(-np.log10(max(float(relative.max()), 1e-300)), 0.0, MOST_DIGITS))


def refusal(call: Callable[[], Any], naming: str) -> str:
    """Return "refused" if a call is refused in one line that contains `naming`, otherwise the result of the
    call."""
    try:
        call()
    except TodframesError as error:
        message = str(error)
        return "refused" if naming in message and "\n" not in message else f"refused: {message}"
    return "accepted"


def shortfall(outcomes: Iterable[Outcome]) -> str | None:
    """Name the cases that fall short in one line; None if there are none."""
    short = [outcome.difference for outcome in outcomes if not outcome.holds]
    if not short:
        return None
    return f"stability: {len(short)} {'cases fall' if len(short) > 1 else 'case falls'} short: {'; '.join(short)}"


def shown(value: Value, case: Case) -> str:
    """Format a text, a number, or the first and last of several numbers, without digits beyond those required."""
    if isinstance(value, str):
        return value
    digits, numbers = math.floor(case.digits), np.asarray(value, dtype=np.float64).ravel()
    if case.scale is not None:
        numbers = np.round(numbers / case.scale, digits) * case.scale + 0.0  # no −0
    ends = [f"{number:.{min(digits, 6)}g}" for number in numbers[[0, -1]]]
    return ends[0] if numbers.size == 1 else f"{ends[0]} … {ends[1]} ({numbers.size})"


def outcome_table(outcomes: Iterable[Outcome], *, has_group: bool = True) -> Table:
    """Make the table of cases and their results."""
    columns = [
        Column(key="group", is_name=True, wraps=True, in_file_only=not has_group),
        Column(key="case", wraps=True),
        Column(key="expected", wraps=True),
        Column(key="source", wraps=True, rank=2),
        Column(key="computed", wraps=True),
        Column(key="digits"),
        Column(key="required"),
    ]
    return Table.of("Extreme inputs", "stability.csv", columns, [outcome.cells for outcome in outcomes])


def markdown(outcomes: Iterable[Outcome]) -> str:
    """Write the tables as a page, a section for each group."""
    lines = ["# Stability in the extremes", ""]
    for group, members in groupby(outcomes, lambda outcome: outcome.case.group):
        lines += [f"## {group.capitalize()}", "", outcome_table(members, has_group=False).markdown(), ""]
    return "\n".join(lines)
