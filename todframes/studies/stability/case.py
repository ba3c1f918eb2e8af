"""Extreme inputs and their expected results: the runner of `todframes stability`, its table and page.

The expected value comes from outside of the code under test: a closed form, a law that holds exactly, or mpmath at
50 digits. Packages name functions that make cases under the entry-point group `todframes.stability_cases`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base.user_code import registered
from todframes.results.data import Record
from todframes.results.result import Result
from todframes.results.table import Column, Table

ENTRY_POINT_GROUP = "todframes.stability_cases"

MPMATH = "mpmath, 50 digits: "
"""First word of the source of numbers that test_stability_references.py computes again."""

MOST_CPU_S = 12.0
"""CPU time within which a case must end, three times what the longest takes."""


class Stability(Result, frozen=True, kw_only=True):
    """The cases of `stability` as they stand in its JSON."""

    cases: tuple[Record, ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme input and the numbers that it must give, each to so many digits; a 0 must be exact."""

    group: str
    name: str
    expected: ArrayLike
    source: str
    compute: Callable[[], ArrayLike]
    digits: float = 6.0


class Outcome(NamedTuple):
    """Result of a case. An exception, a warning or too much CPU time comes as text, without digits."""

    case: Case
    computed: ArrayLike
    digits: float | None

    @property
    def holds(self) -> bool:
        """Whether enough digits are right."""
        return self.digits is not None and self.digits >= self.case.digits

    @property
    def record(self) -> Record:
        """The case and its result as in the JSON object."""
        case, computed, digits = self
        return {
            "group": case.group,
            "name": case.name,
            "expected": np.asarray(case.expected).tolist(),
            "source": case.source,
            "came": np.asarray(computed).tolist(),
            "digits": digits,
            "digits_bound": case.digits,
            "holds": self.holds,
        }

    @property
    def cells(self) -> Record:
        """The row of the table."""
        case, computed, digits = self
        return {
            "group": case.group,
            "case": case.name,
            "expected": shown(case.expected, case),
            "source": case.source,
            "computed": shown(computed, case),
            "digits": None if digits is None else f"{digits:.1f}",
            "required": f"{case.digits:g}",
        }


def find_cases() -> list[Case]:
    """List the cases of all installed packages, those of todframes first."""
    entries = sorted(registered(ENTRY_POINT_GROUP).values(), key=lambda entry: entry.name != "todframes")
    return [case for entry in entries for case in entry.load()()]


def run_case(case: Case) -> Outcome:
    """Compute a case. A warning, an exception or too much CPU time makes it fall short."""
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            computed = case.compute()
    except Exception as error:
        return Outcome(case, f"{type(error).__name__}: {' '.join(str(error).split())}", None)
    if (cpu_s := time.process_time() - started) > MOST_CPU_S:
        return Outcome(case, f"{cpu_s:.0f} s of CPU time, expected at most {MOST_CPU_S:g}", None)
    return Outcome(case, computed, digits_kept(case.expected, computed))


def digits_kept(expected: ArrayLike, computed: ArrayLike) -> float:
    """Count the decimal digits that the worst of some numbers has right, 0 to the 16 of double precision."""
    right, found = np.asarray(expected, dtype=np.float64), np.asarray(computed, dtype=np.float64)
    if right.shape != found.shape or not np.isfinite(found).all():
        return 0.0
    error = np.abs(found - right)
    # 0 is right exactly or not at all.
    relative = np.divide(error, np.abs(right), out=np.where(error > 0, 1.0, 0.0), where=right != 0)
    return float(np.clip(-np.log10(max(float(relative.max()), 1e-300)), 0.0, 16.0))


def shortfall(outcomes: Iterable[Outcome]) -> str | None:
    """Name the cases that fall short in one line; None if there are none."""
    short = []
    for outcome in outcomes:
        case, computed, digits = outcome
        if not outcome.holds:
            found = str(computed) if digits is None else f"{digits:.1f} digits"
            short.append(f"{case.group}: {case.name} (found {found}, expected {case.digits:g} digits)")
    if not short:
        return None
    return f"stability: {len(short)} {'cases fall' if len(short) > 1 else 'case falls'} short: {'; '.join(short)}"


def shown(value: ArrayLike, case: Case) -> str:
    """Format a text, a number, or the first and last of several numbers, without digits beyond those required."""
    if isinstance(value, str):
        return value
    numbers, digits = np.asarray(value, dtype=np.float64).ravel(), min(math.floor(case.digits), 6)
    ends = [f"{number:.{digits}g}" for number in numbers[[0, -1]]]
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
