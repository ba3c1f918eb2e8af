"""Work whose finished results are kept, so that a later run does not compute them again."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from todframes.base.output import Going, store_path
from todframes.jobs.engine import open_engine
from todframes.jobs.work import ITEMS_PER_TASK, Engine, LocalEngine, Work
from todframes.parameters import Progress, counted

if TYPE_CHECKING:
    from todframes.jobs.store import Store

Item = TypeVar("Item")
Item_contra = TypeVar("Item_contra", contravariant=True)
Result = TypeVar("Result")


class StoredWork(Work[Item_contra, Result], Protocol[Item_contra, Result]):
    """Protocol of work whose results can be kept between runs.

    The key of an item stands for all that its result depends on, the bytes of the files that it reads included.
    """

    def key(self, item: Item_contra, *, is_done: bool) -> bytes | None:
        """Return the key of an item's result; None if it cannot be known, or the result is not to be kept.

        `is_done` states whether the function has just returned for this item, which may have checked its files.
        """

    def stamp(self, item: Item_contra) -> object:
        """Return properties of the item's files that change when one is written, without reading them."""

    def stamped_key(self, item: Item_contra, stamp: object) -> bytes | None:
        """Return a key that stands for the stamp in place of the bytes of files; None if that is not enough.

        With it, files that an earlier run has read need not be read again.
        """

    def encode(self, result: Result) -> bytes | None:
        """Return a result as bytes; None if it is not to be kept."""

    def decode(self, encoded: bytes) -> Result | None:
        """Return the result that `encode` made these bytes of; None if what it names is no longer there."""


@dataclass(frozen=True, slots=True)
class Run:
    """Engine of a run, the store that keeps its finished results, and the function that receives its progress."""

    engine: Engine = field(default_factory=LocalEngine)
    store: Store | None = None
    progress: Progress | None = None

    @property
    def n_from_store(self) -> int:
        """Number of results that were not computed but found in the store."""
        return 0 if self.store is None else self.store.n_used


@contextmanager
def opened_run(
    workers: int, cluster: str | Engine | None, store: Store | Path | str | None, progress: Progress | None
) -> Iterator[Run]:
    """Open the engine and the store of a run, unless they are open."""
    if isinstance(store, str | Path):
        from todframes.jobs.store import FILE, Store

        store = Store(Path(store) / FILE, str(store))
    with ExitStack() as stack:
        engine = stack.enter_context(open_engine(cluster, workers))
        if store is not None:
            store.n_used = 0
            stack.callback(store.close)
        yield Run(engine, store, progress)


@contextmanager
def continued(
    place: Callable[..., AbstractContextManager[Path]],
    name: str,
    *,
    restart: bool,
    keep: bool,
    tell: Callable[[str], None] | None,
) -> Iterator[tuple[Path, Store]]:
    """Yield the staging folder and the store of a run that goes on where an earlier one into this place ended.

    `place` is `output_folder` or `new_folder`. With `restart` nothing of an earlier run is used; with `keep` the
    store stays when the run has ended well. `tell` gets a remark about what an earlier run has finished.
    """
    from todframes.jobs.store import Store

    with (
        place(name, going=Going(restart=restart, keep=keep)) as folder,
        closing(Store(store_path(folder), name, tell)) as store,
    ):
        yield folder, store


def run_stored(
    work: StoredWork[Item, Result], items: Sequence[Item], run: Run
) -> Generator[tuple[int, Result], None, None]:
    """Yield the result of each item with its index in `items`: first those in the store, then the others as done.

    Results are kept in the store in the batches in which they come, from the first one on; OutputError if it
    cannot be written. The progress counts items.
    """
    with closing(_results(work, items, run.engine, run.store)) as results:
        yield from counted(results, len(items), run.progress)


def _results(
    work: StoredWork[Item, Result], items: Sequence[Item], engine: Engine, store: Store | None
) -> Generator[tuple[int, Result], None, None]:
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
    numbered = enumerate(items) if len(left) == len(items) else ((number, items[number]) for number in left)
    with closing(engine.run(Keyed(work), numbered)) as keyed_batches:
        for keyed_batch in keyed_batches:
            store.add(_rows(work, keyed_batch))
            for number, one in keyed_batch:
                yield number, one.result


def _decoded(work: StoredWork[Item, Result], encoded: bytes) -> Result | None:
    """Return a result of the store; None if it is no result: then another program has written it."""
    try:
        return work.decode(encoded)
    except (ValueError, msgspec.MsgspecError):
        return None


def _rows(
    work: StoredWork[Item, Result], batch: Sequence[tuple[int, KeyedResult[Result]]]
) -> list[tuple[bytes, bytes]]:
    """Return the keys and encoded results of a batch that are to be kept."""
    rows = []
    for _, one in batch:
        if one.key is not None:
            encoded = work.encode(one.result)
            if encoded is not None:
                rows.append((one.key, encoded))
                if one.stamped_key is not None:
                    rows.append((one.stamped_key, one.key))
    return rows


class KeyedResult(NamedTuple, Generic[Result]):
    """A result with its key, None if it is not to be kept, and the key by its stamp, under which `key` is kept."""

    key: bytes | None
    stamped_key: bytes | None
    result: Result


@dataclass
class Keyed(Generic[Item, Result]):
    """Work that gives each result with its key, so that keys are computed where the work is done."""

    work: StoredWork[Item, Result]

    @property
    def items_at_once(self) -> int:
        """Number of items that come back at a time from the calling thread."""
        return getattr(self.work, "items_at_once", ITEMS_PER_TASK)

    def function(self) -> Callable[[Item], KeyedResult[Result]]:
        """Return the function of an item that returns its result and key."""
        function, work = self.work.function(), self.work

        def do(item: Item) -> KeyedResult[Result]:
            stamp = work.stamp(item)
            stamped_key = work.stamped_key(item, stamp)
            result = function(item)
            key = work.key(item, is_done=True)
            # A file that was written meanwhile has another key than the bytes that were worked on.
            return KeyedResult(key if work.stamp(item) == stamp else None, stamped_key, result)

        return do

    def name(self, item: Item) -> str:
        """Return what messages call an item."""
        return self.work.name(item)


def _found(
    work: StoredWork[Item, Result], items: Sequence[Item], engine: Engine, store: Store
) -> Generator[tuple[int, Result], None, Sequence[int]]:
    """Yield the results that the store has; return the places of the other items."""

    def result_of(key: bytes) -> Result | None:
        encoded = store.get(key)
        result = None if encoded is None else _decoded(work, encoded)
        store.n_used += result is not None
        return result

    unread, left = array("q"), array("q")
    for place, item in enumerate(items):
        stamped_key = work.stamped_key(item, work.stamp(item))
        key = None if stamped_key is None else store.get(stamped_key)
        if key is None:
            unread.append(place)
        elif (result := result_of(key)) is None:
            left.append(place)
        else:
            yield place, result
    with closing(engine.run(_Keys(work), ((place, items[place]) for place in unread))) as batches:
        for batch in batches:
            for place, of_content in batch:
                result = None if of_content is None else result_of(of_content)
                if result is None:
                    left.append(place)
                else:
                    yield place, result
    return array("q", sorted(left))


@dataclass
class _Keys(Generic[Item]):
    """Work that computes the keys of items whose files have to be read for it."""

    work: StoredWork[Item, Any]

    def function(self) -> Callable[[Item], bytes | None]:
        """Return the function of an item that returns its key."""
        return partial(self.work.key, is_done=False)

    def name(self, item: Item) -> str:
        """Return what messages call an item."""
        return self.work.name(item)
