"""Work whose finished results are kept, so that a later run does not compute them again."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import msgspec

from todframes.base.errors import SettingsError, argument
from todframes.base.output import StorePolicy, store_path
from todframes.jobs.work import ITEMS_PER_TASK, Engine, LocalEngine, Work
from todframes.parameters import Progress, counted

if TYPE_CHECKING:
    from todframes.jobs.store import Store

Item = TypeVar("Item")
Item_contra = TypeVar("Item_contra", contravariant=True)
Result = TypeVar("Result")


class StoredWork(Work[Item_contra, Result], Protocol[Item_contra, Result]):
    """Base class of `Work` whose results can be kept between runs. The key of an item stands for all that its
    result depends on, the bytes of the files that it reads included.
    """

    def key(self, item: Item_contra, *, is_done: bool) -> bytes | None:
        """Return the key of an item's result; None if it cannot be known, or the result is not to be kept.
        `is_done` states whether the function has just returned for this item, which may have checked its files.
        """

    def stamp(self, item: Item_contra) -> object:  # noqa: ARG002
        """Return properties of the item's files that change when one is written, without reading them."""
        return None

    def stamped_key(self, item: Item_contra, stamp: object) -> bytes | None:  # noqa: ARG002
        """Return a key for the stamp in place of the bytes of files, which are not read again; None: no key."""
        return None

    def encode(self, result: Result) -> bytes | None:
        """Return a result as bytes; None if it is not to be kept."""
        return msgspec.json.encode(result)

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
def open_engine(cluster: str | Engine | None, workers: int) -> Iterator[Engine]:
    """Open the engine of a Dask cluster by the address of its scheduler, of "local:N" processes of this machine,
    or one that is open already. Without a cluster, `workers` processes do the work; with one, the calling thread.
    SettingsError if the text names no cluster or its package is not installed; ClusterError if it cannot do this
    work.
    """
    if cluster is None and workers == 1:
        yield LocalEngine()
    elif cluster is None:
        from todframes.jobs.processes import ProcessEngine

        with closing(ProcessEngine(workers)) as processes:
            yield processes
    elif not isinstance(cluster, str):
        yield cluster
    elif find_spec("distributed") is None:
        raise SettingsError(
            f"{argument.cluster}: needs the package distributed, which is not installed: pip install "
            "'todframes[cluster]'"
        )
    else:
        from todframes.jobs.cluster import cluster_engine

        with cluster_engine(cluster) as engine:
            yield engine


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
    keep_store: bool,
    tell: Callable[[str], None] | None,
) -> Iterator[tuple[Path, Store]]:
    """Yield the staging folder, of `output_folder` or `new_folder`, and the store of a run that goes on where an
    earlier one into this place ended. With `keep_store` it stays when the run has ended well. `tell` gets a remark
    about it.
    """
    from todframes.jobs.store import Store

    with (
        place(name, policy=StorePolicy(restart=restart, keep=keep_store)) as folder,
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
    if store is None:
        with closing(engine.run(work, enumerate(items))) as batches:
            for batch in batches:
                yield from batch
        return
    left: Sequence[int] = range(len(items))
    if len(store):
        left = yield from _kept(work, items, store)
        if len(left) < len(items):
            store.tell(
                f"{len(items) - len(left)} of {len(items)} parts of the work are there from an earlier run; "
                + ("going on with the others" if left else "nothing is left to do")
            )
    with closing(engine.run(Keyed(work), ((number, items[number]) for number in left))) as keyed_batches:
        for keyed_batch in keyed_batches:
            rows: list[tuple[bytes, bytes]] = []
            for _, (key, stamped_key, result) in keyed_batch:
                if key is not None and (encoded := work.encode(result)) is not None:
                    rows += [(key, encoded)] if stamped_key is None else [(key, encoded), (stamped_key, key)]
            store.add(rows)
            yield from ((number, result) for number, (_, _, result) in keyed_batch)


@dataclass
class Keyed(Generic[Item]):
    """Work that gives each result after its key and the key by its stamp. So keys are computed where the work is
    done. A result without a key is not kept.
    """

    work: StoredWork[Item, Any]

    @property
    def items_at_once(self) -> int:
        """Number of items that come back at a time from the calling thread."""
        return getattr(self.work, "items_at_once", ITEMS_PER_TASK)

    def function(self) -> Callable[[Item], tuple[bytes | None, bytes | None, Any]]:
        """Return the function of an item."""
        work = self.work
        function = work.function()

        def do(item: Item) -> tuple[bytes | None, bytes | None, Any]:
            stamp = work.stamp(item)
            stamped_key = work.stamped_key(item, stamp)
            result = function(item)
            key = work.key(item, is_done=True)
            # A file that was written meanwhile has another key than the bytes that were worked on.
            return key if work.stamp(item) == stamp else None, stamped_key, result

        return do

    def name(self, item: Item) -> str:
        """Return what messages call an item."""
        return self.work.name(item)


def _kept(
    work: StoredWork[Item, Result], items: Sequence[Item], store: Store
) -> Generator[tuple[int, Result], None, Sequence[int]]:
    """Yield the results that the store has; return the indices of the other items."""
    left = array("q")
    for number, item in enumerate(items):
        stamped_key = work.stamped_key(item, work.stamp(item))
        key = None if stamped_key is None else store.get(stamped_key)
        key = work.key(item, is_done=False) if key is None else key
        encoded, result = None if key is None else store.get(key), None
        with suppress(ValueError, msgspec.MsgspecError):  # another program has written it
            result = None if encoded is None else work.decode(encoded)
        if result is None:
            left.append(number)
        else:
            store.n_used += 1
            yield number, result
    return left
