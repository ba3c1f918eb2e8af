"""The engine of one worker: the calling thread."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from itertools import islice

from todframes.base.signals import raise_again
from todframes.jobs.work import Item, Lost, Result, Work

ITEMS_PER_TASK = 16
"""Number of items that are done at a time, of work that does not say `items_at_once`."""


class LocalEngine:
    """Work in the calling thread, as an `Engine`; results come in the order of the items."""

    n_workers = 1
    is_local = True
    dashboard: str | None = None

    def run(
        self, work: Work[Item, Result], items: Iterable[tuple[int, Item]]
    ) -> Generator[list[tuple[int, Result | Lost]], None, None]:
        """Yield lists of items that are finished, as (number, result)."""
        function = work.function()
        items, n = iter(items), getattr(work, "items_at_once", ITEMS_PER_TASK)
        while task := list(islice(items, n)):
            raise_again()
            yield [(number, function(item)) for number, item in task]
