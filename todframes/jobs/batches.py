"""Work that is handed in batches to a pool of processes.

Batches take about the same time, by the worker's own clock, and few are in flight, so that little is lost when the
run ends early. A process that dies ends the run, unless the pool itself tries again.
"""

from __future__ import annotations

import itertools
import pickle
import queue
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import TypeVar

from todframes.base.errors import SettingsError, TodframesError, argument, is_in_command
from todframes.base.signals import deferred_signals, raise_again
from todframes.base.user_code import in_words
from todframes.jobs.work import Work
from todframes.jobs.worker import Done, dumps

T = TypeVar("T")
R = TypeVar("R")

POLL_S = 0.1
"""Longest time until an interruption is noticed."""

MOST_ITEMS = 10_000
"""Largest number of items in a batch."""


class DeadWorkerError(Exception):
    """Exception of a pool for a batch whose process has died."""


class PoolEngine(ABC):
    """An `Engine` that hands batches to a pool of `n_workers`, in whose processes `do_batch` does them. Messages
    call the pool `name`. A batch is meant to take `batch_s`; at most `batches_per_worker` are in flight for each
    worker.
    """

    dashboard: str | None = None
    name: str
    batch_s: float
    batches_per_worker: int

    def __init__(self, n_workers: int) -> None:
        self.n_workers = n_workers

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[list[tuple[int, R]], None, None]:
        """Yield the results of numbered items with their numbers, in batches, in any order. SettingsError if the
        work cannot be pickled; TodframesError if workers cannot be started, cannot do the work, or die with it.
        """
        items, left = iter(items), list[Sequence[tuple[int, T]]]()
        seconds = self.batch_s  # that an item takes
        in_flight: dict[Future[Done], Sequence[tuple[int, T]]] = {}
        finished: queue.SimpleQueue[Future[Done]] = queue.SimpleQueue()
        with (
            deferred_signals() as interrupt_if_asked,
            self._sent(self._pickled((work, is_in_command()))) as submit,
        ):
            while True:
                raise_again()
                interrupt_if_asked()
                batch: Sequence[tuple[int, T]] = ()
                if len(in_flight) < self.batches_per_worker * max(self.n_workers, 1):
                    size = min(max(1, int(self.batch_s / seconds)), MOST_ITEMS)
                    batch = left.pop() if left else list(itertools.islice(items, size))
                if not (batch or in_flight):
                    return
                try:
                    if batch:
                        future = submit(self._pickled([item for _, item in batch]))
                        in_flight[future] = batch
                        future.add_done_callback(finished.put)
                    future = finished.get(block=not batch, timeout=POLL_S)
                    done = self._outcome(future)
                except queue.Empty:
                    self._check_workers()
                    continue
                except DeadWorkerError:
                    # All that waited for the process look the same.
                    items_in_flight = [
                        item for waiting in list(in_flight.values()) or [batch] for _, item in waiting
                    ]
                    where, last = work.name(items_in_flight[0]), work.name(items_in_flight[-1])
                    if len(items_in_flight) > 1:
                        where = f"one of {len(items_in_flight)} parts of the work, from {where} to {last}"
                    raise TodframesError(
                        f"{getattr(argument, self.name)}: a process died at {where}; it was killed, had too "
                        "little memory, or a file crashed it"
                    ) from None
                batch = in_flight.pop(future)
                if done.n_items:
                    seconds = (seconds + max(done.seconds / done.n_items, self.batch_s / MOST_ITEMS)) / 2
                    numbers = [number for number, _ in batch[: done.n_items]]
                    yield list(zip(numbers, pickle.loads(done.results), strict=True))
                if done.error is not None:
                    raise done.error
                if done.n_items < len(batch):
                    left.append(batch[done.n_items :])

    @abstractmethod
    def _sent(self, work: bytes) -> AbstractContextManager[Callable[[bytes], Future[Done]]]:
        """Give a pickled work to the processes for a `with` statement, and drop batches that are left at its end.
        Yields the function that submits a batch of pickled items.
        """

    @abstractmethod
    def _outcome(self, future: Future[Done]) -> Done:
        """Return the outcome of a batch. Raises DeadWorkerError, or TodframesError if there is none."""

    def _check_workers(self) -> None:  # noqa: B027 - most pools always have workers
        """Raise TodframesError if there are no workers any more."""

    def _pickled(self, value: object) -> bytes:
        try:
            return bytes(dumps(value))
        except Exception as error:
            name = getattr(argument, self.name)
            raise SettingsError(f"{name}: cannot send this to other processes ({in_words(error)})") from None
