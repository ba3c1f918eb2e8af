"""Work that is handed in batches to an executor, and the items that kill their workers.

Batches take about the same time, by the worker's own clock, and few are in flight, so that little is lost with a
worker. A batch whose worker died is tried again in halves, and so on. A single item that is left may still not be
the cause: all batches that waited for a dead worker look the same. Such items are put aside, and done one at a
time with nothing else in flight. If the worker dies again, twice, the item is lost.
"""

from __future__ import annotations

import hashlib
import itertools
import pickle
import queue
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from todframes.base.errors import SettingsError
from todframes.base.signals import held_back, raise_again
from todframes.base.user_code import in_words
from todframes.jobs.work import Lost, Work
from todframes.jobs.worker import Done, dumps

T = TypeVar("T")
R = TypeVar("R")

POLL_S = 0.1
"""Longest time until an interruption is noticed."""

MOST_ITEMS = 10_000
"""Largest number of items in a batch."""

COLLECT_S = 1.0
"""Time after which a batch is sent with the items that there are."""

DEATHS = 2
"""Number of times that its process has to die with an item that is alone in flight before the item is lost."""

MOST_SUSPECTS = 10
"""Number of items put aside at which they are done before the rest."""


class Killed(NamedTuple):
    """The outcome of a batch with which workers have died."""

    deaths: int


class ExecutorEngine(ABC):
    """An `Engine` that hands batches to the executor of a pool, in which `do_batch` does them.

    Parameters
    ----------
    n_workers : int
        Number of batches that are done at a time.

    Attributes
    ----------
    name : str
        What messages call the executor.
    batch_s : float
        Time that a batch is meant to take.
    batches_per_worker : int
        Largest number of batches in flight for each worker.
    """

    is_local = False
    dashboard: str | None = None
    name: str
    batch_s: float
    batches_per_worker: int

    def __init__(self, n_workers: int) -> None:
        self.n_workers = n_workers

    def run(
        self, work: Work[T, R], items: Iterable[tuple[int, T]]
    ) -> Generator[list[tuple[int, R | Lost]], None, None]:
        """Yield the results of numbered items with their numbers, in batches, in any order.

        Raises
        ------
        SettingsError
            If the work cannot be pickled.
        TodframesError
            If workers cannot be started, or one of them cannot do the work.
        """
        plan = BatchQueue(work, items, self.batch_s)
        pickled = self._pickled(work)
        key = hashlib.sha256(pickled).hexdigest()
        outcomes: queue.SimpleQueue[tuple[Batch[T], Future[Any]]] = queue.SimpleQueue()
        in_flight: set[Future[Any]] = set()
        with held_back() as interrupt_if_asked:
            self._begin(key, pickled)
            try:
                while True:
                    raise_again()
                    interrupt_if_asked()
                    batch = None
                    if len(in_flight) < self.batches_per_worker * max(self.n_workers, 1):
                        batch = plan.next_batch(is_idle=not in_flight)
                    if batch is not None:
                        future = self._submit(key, self._pickled([item for _, item in batch.items]))
                        in_flight.add(future)
                        future.add_done_callback(lambda future, batch=batch: outcomes.put((batch, future)))  # type: ignore[misc]
                    elif not in_flight:
                        return
                    try:
                        batch, future = outcomes.get(block=batch is None, timeout=POLL_S)
                    except queue.Empty:
                        self._check_workers()
                    else:
                        in_flight.remove(future)
                        yield from plan.take(batch, self._outcome(future))
            finally:
                self._end(key)

    @abstractmethod
    def _begin(self, key: str, work: bytes) -> None:
        """Send a pickled work under a key to each worker, including workers that join later."""

    @abstractmethod
    def _submit(self, key: str, items: bytes) -> Future[Any]:
        """Submit a batch of pickled items to an executor."""

    @abstractmethod
    def _outcome(self, future: Future[Any]) -> Done | Killed:
        """Return the outcome of a batch. Raises TodframesError if there is none."""

    @abstractmethod
    def _end(self, key: str) -> None:
        """Drop batches that have not begun, and end what `_begin` began."""

    def _check_workers(self) -> None:  # noqa: B027 - most pools always have workers
        """Raise TodframesError if there are no workers any more."""

    def _pickled(self, value: object) -> bytes:
        try:
            return bytes(dumps(value))
        except Exception as error:
            raise SettingsError(f"{self.name}: cannot send this to other processes ({in_words(error)})") from None


@dataclass(frozen=True, slots=True)
class Batch(Generic[T]):
    """Items with their numbers. An item that was put aside has a batch of its own, with the deaths since then."""

    items: Sequence[tuple[int, T]]
    deaths: int | None = None


class BatchQueue(Generic[T, R]):
    """The batches of a run: items not begun, the rest of unfinished batches, and items put aside."""

    def __init__(self, work: Work[T, R], items: Iterable[tuple[int, T]], batch_s: float) -> None:
        self._work = work
        self._items = iter(items)
        self._batch_s = self._seconds_per_item = batch_s
        self._waiting: deque[Batch[T]] = deque()
        self._suspects: deque[Batch[T]] = deque()
        self._is_alone = False

    def next_batch(self, *, is_idle: bool) -> Batch[T] | None:
        """Return the next batch, or None if there is none now; `is_idle` says that none is in flight."""
        if self._is_alone:
            return None
        if len(self._suspects) < MOST_SUSPECTS:
            if self._waiting:
                return self._waiting.popleft()
            if items := self._collected():
                return Batch(items)
        if self._suspects and is_idle:
            self._is_alone = True
            return self._suspects.popleft()
        return None

    def take(self, batch: Batch[T], outcome: Done | Killed) -> Iterator[list[tuple[int, R | Lost]]]:
        """Yield the results of a batch, if there are any, and plan the rest of it. Raises the items' error."""
        self._is_alone = False
        if isinstance(outcome, Killed):
            yield from self._take_killed(batch, outcome.deaths)
            return
        done, left = batch.items[: outcome.n_items], batch.items[outcome.n_items :]
        if done:
            seconds = max(outcome.seconds / len(done), self._batch_s / MOST_ITEMS)
            self._seconds_per_item = (self._seconds_per_item + seconds) / 2
            numbers = [number for number, _ in done]
            yield list(zip(numbers, pickle.loads(outcome.results), strict=True))
        if outcome.error is not None:
            raise outcome.error
        if left:
            self._waiting.appendleft(Batch(left))

    def _take_killed(self, batch: Batch[T], deaths: int) -> Iterator[list[tuple[int, R | Lost]]]:
        half = len(batch.items) // 2
        if half:
            self._waiting += [Batch(batch.items[:half]), Batch(batch.items[half:])]
        elif batch.deaths is None:
            self._suspects.append(Batch(batch.items, 0))
        elif batch.deaths + deaths < DEATHS:
            self._suspects.append(Batch(batch.items, batch.deaths + deaths))
        else:
            yield [(number, Lost(self._work.lost(item))) for number, item in batch.items]

    def _collected(self) -> list[tuple[int, T]]:
        found: list[tuple[int, Any]] = []
        started = time.monotonic()
        for item in itertools.islice(self._items, max(1, int(self._batch_s / self._seconds_per_item))):
            found.append(item)
            if time.monotonic() - started > COLLECT_S:
                break
        return found
