"""The work of a run, and the engines that do it."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from itertools import islice
from typing import Protocol, TypeVar, runtime_checkable

from todframes.base.signals import raise_again

Item = TypeVar("Item", contravariant=True)
Result = TypeVar("Result", covariant=True)
T = TypeVar("T")
R = TypeVar("R")

ITEMS_PER_TASK = 16
"""Number of items that are done at a time if the work has no `items_at_once`."""
LONGEST_TASK_S = 0.5
"""Time after which the calling thread gives what is finished, to be shown and kept."""


class Work(Protocol[Item, Result]):
    """A value that can be pickled and defines what is done with an item. It is sent once to each process, and the
    items go separately: large data belong in the work, or in files that it names. Errors of items that shall not
    end the run are results. With an attribute `items_at_once`, so many come back at a time from the calling
    thread.
    """

    def function(self) -> Callable[[Item], Result]:
        """Return the function of an item; it is made once in each process and called from any thread."""
        ...

    def name(self, item: Item) -> str:
        """Return what messages call an item."""
        ...


@runtime_checkable
class Engine(Protocol):
    """Protocol of objects that do the work of a run: in the calling thread, or in `n_workers` processes.
    `dashboard` is the address of a page that shows the work; None if there is none.
    """

    n_workers: int
    dashboard: str | None

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[list[tuple[int, R]], None, None]:
        """Yield the results of numbered items with their numbers, in batches, in any order. Items are asked for as
        they are needed, few ahead. An exception of the function ends the run: it is raised here, and items not
        begun are dropped, as they are by `close`.
        """
        ...


class LocalEngine:
    """Work in the calling thread, as an `Engine`; results come in the order of the items."""

    n_workers = 1
    dashboard: str | None = None

    def run(
        self, work: Work[Item, Result], items: Iterable[tuple[int, Item]]
    ) -> Generator[list[tuple[int, Result]], None, None]:
        """Yield lists of items that are finished, as (number, result)."""
        function = work.function()
        items, n = iter(items), getattr(work, "items_at_once", ITEMS_PER_TASK)
        while True:
            raise_again()
            finished: list[tuple[int, Result]] = []
            started = time.perf_counter()
            for number, item in islice(items, n):
                finished.append((number, function(item)))
                if time.perf_counter() - started > LONGEST_TASK_S:
                    break
            if not finished:
                return
            yield finished
