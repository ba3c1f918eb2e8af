"""The engine of one process: work in threads."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from itertools import islice

from todframes.jobs.work import Item, Lost, Result, Work
from todframes.threads import map_in_threads

ITEMS_PER_TASK = 16
"""Number of items that a thread takes at a time, of work that does not say `items_at_once`."""


class LocalEngine:
    """Work in threads of this process, as an `Engine`; results come in the order of the items.

    Threads, not processes: decoding releases the interpreter lock, and no worker can die with its results.

    Parameters
    ----------
    n_workers : int
        Number of threads; with one, all work is done in the calling thread.
    """

    is_local = True
    dashboard: str | None = None

    def __init__(self, n_workers: int = 1) -> None:
        self.n_workers = n_workers

    def run(
        self, work: Work[Item, Result], items: Iterable[tuple[int, Item]]
    ) -> Generator[list[tuple[int, Result | Lost]], None, None]:
        """Yield lists of items that are finished, as (number, result)."""
        function = work.function()

        def do(task: list[tuple[int, Item]]) -> list[tuple[int, Result | Lost]]:
            return [(number, function(item)) for number, item in task]

        tasks = _tasks(items, getattr(work, "items_at_once", ITEMS_PER_TASK))
        with closing(map_in_threads(do, tasks, self.n_workers)) as finished:
            yield from finished


def _tasks(items: Iterable[tuple[int, Item]], n: int) -> Iterator[list[tuple[int, Item]]]:
    items = iter(items)
    while task := list(islice(items, n)):
        yield task
