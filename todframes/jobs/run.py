"""Work whose finished results are kept, so that the same command can go on where it ended."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec

from todframes.base.errors import SettingsError, argument
from todframes.base.output import StorePolicy, store_path
from todframes.jobs.rows import Rows
from todframes.jobs.work import Engine, LocalEngine, Work
from todframes.parameters import Progress

Item = TypeVar("Item")
Item_contra = TypeVar("Item_contra", contravariant=True)
Result = TypeVar("Result")


class StoredWork(Work[Item_contra, Result], Protocol[Item_contra, Result]):
    """Base class of `Work` whose results can be kept between runs."""

    def identity(self) -> bytes:
        """Return a hash of all that is the same for all items and that results depend on. TypeError if there is
        none, because code of the user is in no file: nothing is kept then."""
        ...

    def item_identity(self, item: Item_contra) -> str:
        """Return a hash of an item, and of size and time of the files that it reads."""
        ...

    def encode(self, result: Result) -> bytes | None:
        """Return a result as bytes; None if it is not to be kept."""
        return msgspec.json.encode(result)

    def decode(self, encoded: bytes) -> Result | None:
        """Return the result that `encode` made these bytes of; None if what it names is no longer there."""
        ...


@dataclass(frozen=True, slots=True)
class Run:
    """Engine of a run, the rows that keep its finished results, and the function that receives its progress."""

    engine: Engine = field(default_factory=LocalEngine)
    store: Rows | None = None
    progress: Progress | None = None

    @property
    def n_from_store(self) -> int:
        """Number of results that were not computed but taken from an earlier run."""
        return 0 if self.store is None else self.store.n_used


@contextmanager
def open_engine(cluster: str | Engine | None, workers: int) -> Iterator[Engine]:
    """Open the engine of a Dask cluster by the address of its scheduler, or one that is open already. Without a
    cluster, `workers` processes do the work. SettingsError if the text names no cluster or its package is not
    installed; ClusterError if it cannot do this work.
    """
    if cluster is not None and not isinstance(cluster, str):
        yield cluster
    elif cluster is None and workers == 1:
        yield LocalEngine()
    elif cluster is None:
        from todframes.jobs.processes import ProcessEngine

        with closing(ProcessEngine(workers)) as processes:
            yield processes
    elif find_spec("distributed") is None:
        raise SettingsError(
            f"{argument.cluster}: needs the package distributed, which is not installed: pip install "
            "'todframes[cluster]'"
        )
    else:
        from todframes.jobs.cluster import ClusterEngine

        with closing(ClusterEngine(cluster)) as engine:
            yield engine


@contextmanager
def opened_run(
    workers: int, cluster: str | Engine | None, store: Rows | Path | str | None, progress: Progress | None
) -> Iterator[Run]:
    """Open the engine and the rows of a run, unless they are open."""
    if isinstance(store, str | Path):
        store = Rows(Path(store), str(store))
    if store is not None:
        store.n_used = 0
    with open_engine(cluster, workers) as engine:
        yield Run(engine, store, progress)


@contextmanager
def resumable_output(
    place: Callable[..., AbstractContextManager[Path]],
    name: str,
    *,
    restart: bool,
    keep_store: bool,
    tell: Callable[[str], None] | None,
) -> Iterator[tuple[Path, Rows]]:
    """Yield the staging folder, of `output_folder` or `new_folder`, and the rows of a run that goes on where an
    earlier one into this place ended. With `keep_store` they stay when the run has ended well. `tell` gets a
    remark about them.
    """
    with place(name, policy=StorePolicy(restart=restart, keep=keep_store)) as folder:
        yield folder, Rows(store_path(folder), name, tell)


def run_stored(
    work: StoredWork[Item, Result], items: Sequence[Item], run: Run
) -> Generator[tuple[int, Result], None, None]:
    """Yield the result of each item with its index in `items`: first those that are kept, then the others as they
    are done. Raises OutputError if results cannot be kept. The progress counts items.
    """
    identity = None
    if run.store is not None:
        with suppress(TypeError):
            identity = work.identity()
    if run.store is None or identity is None:
        results = run.engine.run(work, enumerate(items))
    else:
        results = _kept_and_new(work, items, run.engine, run.store, identity)
    with closing(results):
        for n_done, result in enumerate(results, 1):
            yield result
            if run.progress is not None:
                run.progress(n_done, len(items))


def _kept_and_new(
    work: StoredWork[Item, Result], items: Sequence[Item], engine: Engine, store: Rows, identity: bytes
) -> Generator[tuple[int, Result], None, None]:
    with store.of_work(identity) as (kept, add):
        left: Sequence[int] = range(len(items))
        if kept:
            left = []
            for number, item in enumerate(items):
                encoded, result = kept.pop(work.item_identity(item), None), None
                with suppress(ValueError, msgspec.MsgspecError):  # another program has written it
                    result = None if encoded is None else work.decode(encoded)
                if result is None:
                    left.append(number)
                else:
                    store.n_used += 1
                    yield number, result
            if len(left) < len(items):
                store.tell(
                    f"{len(items) - len(left)} of {len(items)} parts of the work are there from an earlier run; "
                    + ("going on with the others" if left else "nothing is left to do")
                )
        begun: dict[int, str] = {}

        def numbered() -> Iterator[tuple[int, Item]]:
            for number in left:
                # Before it is read: a file that is written meanwhile has another identity than was worked on.
                begun[number] = work.item_identity(items[number])
                yield number, items[number]

        for number, result in engine.run(work, numbered()):
            identity_of_item = begun.pop(number)
            if (encoded := work.encode(result)) is not None:
                add(identity_of_item, encoded)
            yield number, result
