"""The engine of a Dask cluster that runs already."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Generator, Iterable
from concurrent.futures import CancelledError
from contextlib import suppress
from itertools import islice
from typing import Any, TypeVar

import distributed

from todframes.base import signals
from todframes.base.errors import ClusterError, SettingsError, TodframesError, argument
from todframes.base.user_code import in_words
from todframes.jobs.processes import ProcessEngine, Sent, do_item
from todframes.jobs.work import Work

T = TypeVar("T")
R = TypeVar("R")

BATCH_S, BATCHES_PER_WORKER, MOST_ITEMS = 2.0, 4, 10_000
"""Time that a batch is meant to take, the number in flight for each worker, and its largest number of items."""

LOGGERS = ("distributed", "tornado", "asyncio")
"""Names of the loggers that are silenced, with those below them."""

CONNECT_S = 10.0
"""Time for a scheduler to answer, and then for its first worker."""


class ClusterEngine(ProcessEngine):
    """The engine whose work is done by a Dask cluster. `n_workers` is the number of threads of all its workers,
    `dashboard` the URL of the scheduler's page. SettingsError if the address is none; ClusterError if there is no
    scheduler or no worker.
    """

    name = "cluster"

    def __init__(self, address: str) -> None:
        if not re.fullmatch("(tcp|tls|ws|wss)://.+:[0-9]{1,5}", address):
            raise SettingsError(f"{argument.cluster}: found {address!r}, expected tcp://HOST:PORT")
        for name in list(logging.root.manager.loggerDict):  # what they would say, this engine says in a line
            if name.split(".")[0] in LOGGERS:
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self._address = address
        try:
            self._client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except Exception as error:
            raise ClusterError(
                f"{address}: no Dask scheduler with a worker has answered within {CONNECT_S:g} s "
                f"({in_words(error)}); is the address right, and do `dask scheduler` and `dask worker` of version "
                f"{distributed.__version__} run?"
            ) from None
        super().__init__(sum(self._client.nthreads().values()))
        with suppress(KeyError):
            self.dashboard = self._client.dashboard_link or None

    def close(self) -> None:
        """End the connection; the cluster goes on."""
        with suppress(TimeoutError):
            self._client.close(0.5)

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[tuple[int, R], None, None]:
        """Yield the results of numbered items with their numbers, in any order. Errors are those of the engine of
        processes, and ClusterError. joblib hands work to Dask, too, but waits without end for a process that died.
        """
        in_flight: dict[str, list[tuple[int, T]]] = {}
        futures, size, items = set[distributed.Future](), 1, iter(items)
        done = distributed.as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        sent = self.packed(work)  # with each batch: what is scattered is lost with the workers that have it
        try:
            while True:
                while len(in_flight) < BATCHES_PER_WORKER * self.n_workers and (
                    batch := list(islice(items, size))
                ):
                    future = self._client.submit(_do_batch, sent, batch, pure=False)
                    in_flight[future.key] = batch
                    futures.add(future)
                    done.add(future)
                if not in_flight:
                    return
                with self._explained(work, lambda: [item for batch in in_flight.values() for _, item in batch]):
                    future, outcome = next(done)
                    if future.status != "finished":
                        raise outcome if isinstance(outcome, BaseException) else outcome[1]
                if signals.unanswered:
                    raise KeyboardInterrupt
                futures.discard(future)
                batch = in_flight.pop(future.key)
                results, seconds = outcome
                size = min(max(1, int(BATCH_S * len(batch) / max(seconds, 1e-6))), 2 * size, MOST_ITEMS)
                for number, result, failure in results:
                    if failure is not None:
                        raise failure
                    yield number, result
        finally:
            self._client.cancel([*futures])

    def _folders(self) -> tuple[str, ...]:
        return ()  # other machines have their own modules

    def _explain(self, error: Exception, where: str) -> None:
        if isinstance(error, distributed.KilledWorker):
            raise TodframesError(
                f"{argument.cluster}: a process died at {where}; it was killed, had too little memory, or a file "
                "crashed it"
            ) from None
        if isinstance(error, (CancelledError, distributed.CancelledError, OSError)):
            raise ClusterError(
                f"{self._address}: the Dask scheduler is gone; start it, then give the same command again"
            ) from None
        if not isinstance(error, TodframesError):
            raise ClusterError(
                f"{self._address}: a worker cannot do the work ({in_words(error)}); is the same installed there?"
            ) from None


def _do_batch(sent: Sent, batch: list[tuple[int, Any]]) -> tuple[list[tuple[int, Any, Exception | None]], float]:
    """Return the results of a batch, and the time that it took in seconds."""
    started = time.perf_counter()
    return [do_item(sent, number, item) for number, item in batch], time.perf_counter() - started
