"""Extreme inputs and their expected results: cases, the number of right digits of each, and a table.  The expected
value comes from outside of the code under test: a closed form, a law that holds exactly, algebra with fractions,
or mpmath at 50 digits. Packages name functions that make cases under the entry-point group
`todframes.stability_cases`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base.errors import TodframesError
from todframes.base.user_code import registered
from todframes.results.data import Body, Record
from todframes.results.table import Column, Table

ENTRY_POINT_GROUP = "todframes.stability_cases"

MPMATH = "mpmath, 50 digits: "
"""First word of the source of numbers that test_stability_references.py computes again."""

MOST_DIGITS = 16.0
"""Digits of double precision, which exact results have."""

SHOWN_DIGITS = 12
"""Digits shown in documents; more are a matter of the machine."""

Value = str | float | ArrayLike


class Stability(Body, frozen=True, kw_only=True):
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
    short = [outcome for outcome in outcomes if not outcome.holds]
    if not short:
        return None
    cases = "; ".join(f"{outcome.case.group}: {outcome.case.name} ({_difference(outcome)})" for outcome in short)
    return f"stability: {len(short)} {'cases fall' if len(short) > 1 else 'case falls'} short: {cases}"


def _difference(outcome: Outcome) -> str:
    if outcome.digits is None:
        return f"found {shown(outcome.computed)}, expected {shown(outcome.case.expected)}"
    return f"found {outcome.digits:.1f} digits, expected {outcome.case.digits:g}"


def case_object(outcome: Outcome) -> dict[str, Any]:
    """Describe a case and its result as in the JSON object."""
    case = outcome.case
    expected, computed = (
        v if isinstance(v, str) else np.asarray(v).tolist() for v in (case.expected, outcome.computed)
    )
    return {
        "group": case.group,
        "name": case.name,
        "expected": expected,
        "source": case.source,
        "came": computed,
        "digits": outcome.digits,
        "digits_bound": None if outcome.digits is None else case.digits,
        "holds": outcome.holds,
    }


def shown(value: Value, *, digits: float = 6.0, scale: float | None = None) -> str:
    """Format a text, a number, or the first and last of several numbers, without digits beyond those asked for."""
    if isinstance(value, str):
        return value
    numbers = np.asarray(value, dtype=np.float64).ravel()
    if scale is not None:
        numbers = np.round(numbers / scale, math.floor(digits)) * scale + 0.0  # no −0
    ends = [f"{number:.{min(math.floor(digits), 6)}g}" for number in numbers[[0, -1]]]
    return ends[0] if numbers.size == 1 else f"{ends[0]} … {ends[1]} ({numbers.size})"


TABLE_HEADERS = ("case", "expected", "source", "computed", "digits", "required")


def cells(outcome: Outcome, *, documented: bool = False) -> list[str]:
    """Return the cells of a row of the table; `documented` leaves out digits that are a matter of the machine."""
    case, computed, digits, holds = outcome
    if digits is None:
        kept, bound = "equal" if holds else "different", "equal"
    else:
        exact = f"≥ {SHOWN_DIGITS}" if digits >= SHOWN_DIGITS else f"{math.floor(digits)}"
        kept, bound = exact if documented else f"{digits:.1f}", f"{case.digits:g}"
    expected, found = (shown(value, digits=case.digits, scale=case.scale) for value in (case.expected, computed))
    return [case.name, expected, case.source, found, kept, bound]


def outcome_table(outcomes: Sequence[Outcome], *, documented: bool = False) -> Table:
    """Make the table of cases and their results."""
    wide = ("expected", "source", "computed")
    columns = [
        Column(key="group", is_name=True, wraps=True, in_file_only=documented),
        *(
            Column(key=name, wraps=name in wide or name == "case", rank=2 * (name == "source"))
            for name in TABLE_HEADERS
        ),
    ]
    records = [
        {"group": outcome.case.group}
        | dict(zip(TABLE_HEADERS, cells(outcome, documented=documented), strict=True))
        for outcome in outcomes
    ]
    return Table.of("Extreme inputs", "stability.csv", columns, records)


PAGE = """\
# Stability in the extremes

`todframes stability` tries inputs from the edge of what can occur, {number} of them, and fails if one keeps
fewer digits than required or takes more CPU time than it may, three seconds for most. All take 40 s
and 2 GB; the tests run the same cases.

The expected values come from sources outside of the code under test: closed forms, laws that hold exactly, and
numbers that mpmath gave at 50 digits, which `test_stability_references.py` computes again by other methods.
*Digits* are the right decimal digits of the worst number of a case, *required* is the least number of them; from
12 on they depend on the machine. If a case has several numbers, the first and the last are shown. Warnings and
exceptions count as failures. *Refused* means: with one line that says what was found and what was expected.
"""


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Write the tables as a page of the documentation, without digits that are a matter of the machine."""
    lines = [PAGE.format(number=len(outcomes))]
    for group, members in groupby(outcomes, lambda outcome: outcome.case.group):
        table = outcome_table([*members], documented=True).markdown()
        lines += [f"## {group.capitalize()}", "", table, ""]
    return "\n".join(lines)
