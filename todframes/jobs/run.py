"""Work whose finished results are kept: what an earlier run has finished is not done again."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import msgspec

from todframes.errors import TodframesError
from todframes.jobs.local import ITEMS_PER_TASK
from todframes.jobs.store import Store
from todframes.jobs.work import Engine, Lost, Work
from todframes.threads import map_in_threads

Item = TypeVar("Item")
Item_contra = TypeVar("Item_contra", contravariant=True)
Result = TypeVar("Result")

LOOKED_AT_S = 0.5
"""Time after which a run is judged by its rate, in seconds."""


WORTH_S = 4.0
"""Shortest run whose results are kept as they come, in seconds."""


FOUND_AT_ONCE = 512
"""Number of items whose keys are computed before their results are looked up."""


class StoredWork(Work[Item_contra, Result], Protocol[Item_contra, Result]):
    """Protocol of work whose results can be kept between runs.

    The key of an item stands for all that its result depends on, the bytes of the files that it reads included.
    """

    def key(self, item: Item_contra, *, is_done: bool) -> bytes | None:
        """Return the key of an item's result; None if it cannot be told, or the result is not to be kept.

        `is_done` tells whether the function has just returned for this item, which may have checked its files.
        """

    def stamp(self, item: Item_contra) -> object:
        """Return what changes when a file of the item is written, without reading it."""

    def encode(self, result: Result) -> bytes | None:
        """Return a result as bytes; None if it is not to be kept."""

    def decode(self, encoded: bytes) -> Result | None:
        """Return the result that `encode` made these bytes of; None if what it names is no longer there."""


def run_stored(
    work: StoredWork[Item, Result],
    items: Sequence[Item],
    *,
    engine: Engine,
    store: Store | None = None,
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Yield the result of each item with its place in `items`: first those in the store, then the others as done.

    Results are kept in the store in the batches in which they come. A store that holds none yet is begun once the
    run turns out to take longer than `WORTH_S`.

    Parameters
    ----------
    work : StoredWork
    items : sequence
    engine : Engine
    store : Store, optional
        Without one nothing is kept.

    Raises
    ------
    OutputError
        If the store cannot be written.
    """
    left: Sequence[int] = range(len(items))
    if store is None:
        with closing(engine.run(work, enumerate(items))) as batches:
            for batch in batches:
                yield from batch
        return
    if len(store):
        left = yield from _found(work, items, engine, store)
        if len(left) < len(items):
            store.tell(
                f"{len(items) - len(left)} of {len(items)} parts of the work are there from an earlier run; "
                + ("going on with the others" if left else "nothing is left to do")
            )
    elif not engine.is_local:
        store.begin()
    keyed = Keyed(work, store.is_begun)
    started = time.perf_counter()
    n_done = 0
    numbered = enumerate(items) if len(left) == len(items) else ((number, items[number]) for number in left)
    with closing(engine.run(keyed, numbered)) as keyed_batches:
        for keyed_batch in keyed_batches:
            store.add(_rows(work, keyed_batch))
            for number, one in keyed_batch:
                yield number, one if isinstance(one, Lost) else one.result
            n_done += len(keyed_batch)
            elapsed = time.perf_counter() - started
            if not keyed.records and elapsed > max(LOOKED_AT_S, WORTH_S * n_done / len(left)):
                store.begin()
                keyed.records = True


def _decoded(work: StoredWork[Item, Result], encoded: bytes) -> Result | None:
    """Return a result of the store; None if it is no result, which only somebody else can have put there."""
    try:
        return work.decode(encoded)
    except (ValueError, msgspec.MsgspecError):
        return None


def _rows(
    work: StoredWork[Item, Result], batch: Sequence[tuple[int, KeyedResult[Result] | Lost]]
) -> list[tuple[bytes, bytes]]:
    """Return the keys and encoded results of a batch that are to be kept."""
    rows = []
    for _, one in batch:
        if not isinstance(one, Lost) and one.key is not None:
            encoded = work.encode(one.result)
            if encoded is not None:
                rows.append((one.key, encoded))
    return rows


@dataclass
class KeyedResult(Generic[Result]):
    """A result and its key; None if it is not to be kept."""

    key: bytes | None
    result: Result


@dataclass
class Keyed(Generic[Item, Result]):
    """Work that gives each result with its key, so that keys are computed where the work is done.

    `records` may be set during a run in the same process: without it no keys are computed.
    """

    work: StoredWork[Item, Result]
    records: bool

    @property
    def items_at_once(self) -> int:
        """Number of items that a thread takes at a time."""
        return getattr(self.work, "items_at_once", ITEMS_PER_TASK)

    def function(self) -> Callable[[Item], KeyedResult[Result]]:
        """Return the function of an item that returns its result and key."""
        function, work = self.work.function(), self.work

        def do(item: Item) -> KeyedResult[Result]:
            if not self.records:
                return KeyedResult(None, function(item))
            before = work.stamp(item)
            result = function(item)
            key = work.key(item, is_done=True)
            # A file that was written meanwhile has another key than the bytes that were worked on.
            return KeyedResult(key if work.stamp(item) == before else None, result)

        return do

    def lost(self, item: Item) -> TodframesError:
        """Return the error about an item whose process died with it."""
        return self.work.lost(item)


def _found(
    work: StoredWork[Item, Result], items: Sequence[Item], engine: Engine, store: Store
) -> Generator[tuple[int, Result | Lost], None, Sequence[int]]:
    """Yield the results that the store has; return the places of the other items."""

    def keys(places: range) -> list[bytes | None]:
        return [work.key(items[place], is_done=False) for place in places]

    def chunks() -> Iterator[range]:
        for start in range(0, len(items), FOUND_AT_ONCE):
            yield range(start, min(start + FOUND_AT_ONCE, len(items)))

    left = array("q")
    with closing(map_in_threads(keys, chunks(), engine.n_workers if engine.is_local else 1)) as computed:
        for places, of_chunk in zip(chunks(), computed, strict=True):
            for place, key in zip(places, of_chunk, strict=True):
                encoded = None if key is None else store.get(key)
                result = None if encoded is None else _decoded(work, encoded)
                if result is None:
                    left.append(place)
                else:
                    store.n_used += 1
                    yield place, result
    return left
