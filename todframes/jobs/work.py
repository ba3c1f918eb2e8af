"""The work of a run, and the engines that do it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Protocol, TypeVar, runtime_checkable

from todframes.base import signals

Item = TypeVar("Item", contravariant=True)
Result = TypeVar("Result", covariant=True)
T = TypeVar("T")
R = TypeVar("R")


class Work(Protocol[Item, Result]):
    """A value that can be pickled and defines what is done with an item. It is sent once to each process, and the
    items go separately: large data belong in the work, or in files that it names. Errors of items that shall not
    end the run are results.
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

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[tuple[int, R], None, None]:
        """Yield the results of numbered items with their numbers, in any order. Items are asked for as
        they are needed, few ahead. An exception of the function ends the run: it is raised here, and items not
        begun are dropped, as they are if this iterator is closed.
        """
        ...


class LocalEngine:
    """Work in the calling thread, as an `Engine`; results come in the order of the items."""

    n_workers = 1
    dashboard: str | None = None

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[tuple[int, R], None, None]:
        """Yield the results of numbered items with their numbers."""
        function = work.function()
        for number, item in items:
            if signals.unanswered:
                raise KeyboardInterrupt
            yield number, function(item)
