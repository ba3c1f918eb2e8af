"""The engine of processes: all results, errors in the client, and a process that dies costs its own item alone."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from todframes.errors import DataError
from todframes.jobs.processes import ProcessEngine
from todframes.jobs.work import Lost

pytestmark = pytest.mark.slow  # each process imports Python anew


@dataclass(frozen=True)
class Squares:
    """Squares; one number kills its process, and one is refused."""

    deadly: int | None = None
    refused: int | None = None

    def function(self) -> Callable[[int], int]:
        def square(item: int) -> int:
            if item == self.deadly:
                os.kill(os.getpid(), signal.SIGKILL)
            if item == self.refused:
                raise DataError(f"found {item}, expected another number")
            return item * item

        return square

    def lost(self, item: int) -> DataError:
        return DataError(f"{item}: its process died")


def results(work: Squares, n: int) -> dict[int, object]:
    return dict(
        pair for batch in ProcessEngine(2, items_per_task=4).run(work, enumerate(range(n))) for pair in batch
    )


@pytest.mark.parametrize("n", [0, 1, 50])
def test_all_items_have_their_results(n: int) -> None:
    assert results(Squares(), n) == {item: item * item for item in range(n)}


def test_an_item_that_kills_its_process_is_lost_alone() -> None:
    found = results(Squares(deadly=13), 50)
    lost = found.pop(13)
    assert isinstance(lost, Lost)
    assert str(lost.error) == "13: its process died"
    assert found == {item: item * item for item in range(50) if item != 13}


def test_an_exception_of_the_work_ends_the_run() -> None:
    with pytest.raises(DataError, match="found 20, expected another number"):
        results(Squares(refused=20), 50)


def test_items_are_taken_as_they_are_needed_and_dropped_at_the_end() -> None:
    taken: list[int] = []

    def items():
        for number in range(10**6):
            taken.append(number)
            yield number, number

    run = ProcessEngine(2, items_per_task=4).run(Squares(), items())
    next(run)
    run.close()
    assert len(taken) <= 8  # a task of each process
