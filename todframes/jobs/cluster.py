"""The engine that has work done by a Dask cluster: one that runs already, or processes of this machine.

The client cuts the items into batches of a few seconds, keeps a few of them for each worker in flight, and takes
the results as they come, so that little is lost with a worker. A batch carries items and the hash of the work. The
work itself is sent to each process once, when the process asks for it.

A batch whose worker died is given to another one. If workers keep dying with it, its halves are tried, and so on.
An item that is left alone may still be innocent: Dask blames all batches that were given to a dead worker. Such
items are put aside, and done one at a time with nothing else in flight. One that is killed then, twice, is lost.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import logging
import os
import pickle
import queue
import re
import signal
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import AsyncIterator, Coroutine, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any, Generic, NamedTuple, TypeVar

import cloudpickle
import dask
import distributed
from distributed import Client, KilledWorker, LocalCluster
from distributed.versions import VersionMismatchWarning

from todframes.errors import ClusterError, SettingsError, argument
from todframes.jobs import worker
from todframes.jobs.start import SAFE_PATH, safe_path
from todframes.jobs.work import Lost, Work
from todframes.jobs.worker import Done
from todframes.signals import held_back, raise_again
from todframes.threads import POLL_S
from todframes.user_code import in_words, searched_last

T = TypeVar("T")
R = TypeVar("R")

LOCAL = "local:"

CONNECT_S = 10.0
"""Time within which a scheduler has to answer, and then its first worker."""


WITHOUT_WORKERS_S = 60.0
"""Time after which a run ends if all workers have gone."""


CLOSE_S = 10.0
"""Longest time to leave a cluster in order."""


CLOSE_CLIENT_S = 0.5
"""Time that the connection to the scheduler has to end in order."""


KILL_S = 0.2
"""Time that the processes of a local cluster have to end by themselves."""


COUNT_WORKERS_S = 1.0
"""Interval between counts of the workers."""


BATCH_S = 2.0
"""Time that a batch is meant to take."""


MOST_ITEMS = 10_000
"""Largest number of items in a batch."""


COLLECT_S = 1.0
"""Time after which a batch is sent with the items that there are."""


BATCHES_PER_THREAD = 4
"""Largest number of batches in flight for each thread of the workers."""


DEATHS = 2
"""Number of times that its process has to die with an item that is alone in flight before the item is lost."""


MOST_SUSPECTS = 10
"""Number of items put aside at which they are done before the rest."""


LIBRARIES = ("distributed", "tornado", "bokeh")
"""Names of the loggers that are silenced, with those below them."""


@contextmanager
def cluster_engine(cluster: str) -> Iterator[ClusterEngine]:
    """Yield the engine of a cluster: `local:N`, N processes of this machine, or the address of a Dask scheduler.

    Raises
    ------
    SettingsError
        If the text is neither of the two.
    ClusterError
        If there is no scheduler or no worker, or one of them has other versions than the client.
    """
    with _without_messages(), _Background() as background, background.entered(_connected(cluster)) as client:
        yield ClusterEngine(cluster, client, background)


class ClusterEngine:
    """The engine that has work done by a Dask cluster; `cluster_engine` makes it.

    Attributes
    ----------
    n_workers : int
        Number of threads of all workers at present.
    dashboard : str or None
        URL of the scheduler's dashboard; None if it has none.
    """

    is_local = False

    def __init__(self, cluster: str, client: Client, background: _Background) -> None:
        self._cluster = cluster
        self._client = client
        self._works = _Works(cluster, client)
        self._background = background
        self.n_workers = background.result(_count_threads(client))
        self.dashboard = _dashboard(client)
        self._last_worker_s = time.monotonic()
        background.start(self._keep_counting())

    def run(
        self, work: Work[T, R], items: Iterable[tuple[int, T]]
    ) -> Generator[list[tuple[int, R | Lost]], None, None]:
        """Yield the results of numbered items with their numbers, in batches, in any order.

        Raises
        ------
        SettingsError
            If the work cannot be pickled.
        ClusterError
            If the scheduler is gone, or no workers are left, or one of them cannot do the work.
        """
        plan = _Plan(work, items)
        # A cluster that runs already has other machines, which have their own modules.
        folders = searched_last() if self._cluster.startswith(LOCAL) else []
        key = self._works.add(pickle.dumps((folders, _pickled(work))))
        outcomes: queue.SimpleQueue[tuple[_Batch[T], Future[Done | _Killed]]] = queue.SimpleQueue()
        in_flight: set[Future[Done | _Killed]] = set()

        def start(batch: _Batch[T]) -> None:
            items = _pickled([item for _, item in batch.items])
            future = self._background.start(self._works.outcome(key, items))
            in_flight.add(future)
            future.add_done_callback(lambda future: outcomes.put((batch, future)))

        with held_back() as interrupt_if_asked:
            try:
                while True:
                    raise_again()
                    interrupt_if_asked()
                    batch = None
                    if len(in_flight) < BATCHES_PER_THREAD * max(self.n_workers, 1):
                        batch = plan.next_batch(is_idle=not in_flight)
                    if batch is not None:
                        start(batch)
                    elif not in_flight:
                        return
                    try:
                        batch, future = outcomes.get(block=batch is None, timeout=POLL_S)
                    except queue.Empty:
                        self._check_workers()
                    else:
                        in_flight.remove(future)
                        yield from plan.take(batch, future.result())
            finally:
                for future in in_flight:
                    future.cancel()

    async def _keep_counting(self) -> None:
        while True:
            with suppress(OSError):  # a lost connection shows in the batches
                self.n_workers = await _count_threads(self._client)
            if self.n_workers:
                self._last_worker_s = time.monotonic()
            await asyncio.sleep(COUNT_WORKERS_S)

    def _check_workers(self) -> None:
        if time.monotonic() - self._last_worker_s > WITHOUT_WORKERS_S:
            raise ClusterError(
                f"{self._cluster}: all workers have been gone for {WITHOUT_WORKERS_S:g} s; start some, then give "
                "the same command again"
            )


@dataclass(frozen=True, slots=True)
class _Batch(Generic[T]):
    """Items with their numbers. An item that was put aside has a batch of its own, with the deaths since then."""

    items: Sequence[tuple[int, T]]
    deaths: int | None = None


class _Killed(NamedTuple):
    """The outcome of a batch with which workers have died."""

    deaths: int


class _Plan(Generic[T, R]):
    """The batches of a run: items not begun, what is left of batches, and items put aside."""

    def __init__(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> None:
        self._work = work
        self._items = iter(items)
        self._seconds_per_item = BATCH_S
        self._waiting: deque[_Batch[T]] = deque()
        self._suspects: deque[_Batch[T]] = deque()
        self._is_alone = False

    def next_batch(self, *, is_idle: bool) -> _Batch[T] | None:
        """Return the next batch, or None if there is none now; `is_idle` says that none is in flight."""
        if self._is_alone:
            return None
        if len(self._suspects) < MOST_SUSPECTS:
            if self._waiting:
                return self._waiting.popleft()
            if items := self._collected():
                return _Batch(items)
        if self._suspects and is_idle:
            self._is_alone = True
            return self._suspects.popleft()
        return None

    def take(self, batch: _Batch[T], outcome: Done | _Killed) -> Iterator[list[tuple[int, R | Lost]]]:
        """Yield the results of a batch, if there are any, and plan what is left of it. Raises the items' error."""
        self._is_alone = False
        if isinstance(outcome, _Killed):
            yield from self._take_killed(batch, outcome.deaths)
            return
        done, left = batch.items[: outcome.n_items], batch.items[outcome.n_items :]
        if done:
            seconds = max(outcome.seconds / len(done), BATCH_S / MOST_ITEMS)
            self._seconds_per_item = (self._seconds_per_item + seconds) / 2
            numbers = [number for number, _ in done]
            yield list(zip(numbers, pickle.loads(outcome.results), strict=True))
        if outcome.error is not None:
            raise outcome.error
        if left:
            self._waiting.appendleft(_Batch(left))

    def _take_killed(self, batch: _Batch[T], deaths: int) -> Iterator[list[tuple[int, R | Lost]]]:
        half = len(batch.items) // 2
        if half:
            self._waiting += [_Batch(batch.items[:half]), _Batch(batch.items[half:])]
        elif batch.deaths is None:
            self._suspects.append(_Batch(batch.items, 0))
        elif batch.deaths + deaths < DEATHS:
            self._suspects.append(_Batch(batch.items, batch.deaths + deaths))
        else:
            yield [(number, Lost(self._work.lost(item))) for number, item in batch.items]

    def _collected(self) -> list[tuple[int, T]]:
        found = []
        started = time.monotonic()
        for item in itertools.islice(self._items, max(1, int(BATCH_S / self._seconds_per_item))):
            found.append(item)
            if time.monotonic() - started > COLLECT_S:
                break
        return found


class _Works:
    """The works of an engine, pickled, and the sending of them and of their batches."""

    def __init__(self, cluster: str, client: Client) -> None:
        self._cluster = cluster
        self._client = client
        self._works: dict[str, bytes] = {}
        self._numbers = itertools.count()
        self._sending: set[asyncio.Task[None]] = set()
        client.subscribe_topic(worker.REQUESTS, self._take_request)

    def add(self, work: bytes) -> str:
        """Add a pickled work. Returns its key."""
        key = hashlib.sha256(work).hexdigest()
        self._works[key] = work
        return key

    async def outcome(self, key: str, items: bytes) -> Done | _Killed:
        """Have a batch of pickled items done by the work with a key.

        Raises
        ------
        ClusterError
            If the scheduler is gone, or a worker cannot do the work.
        """
        # A name of its own: Dask remembers what has failed.
        name = (f"{self._client.id}-{key[:8]}", next(self._numbers))
        future = self._client.submit(worker.do_batch, key, items, worker.versions(), key=name)
        try:
            # Dask fetches the results of several futures together. If the first task that waits for them were
            # cancelled, so would be all others, for as long as the client lives.
            outcome: Done | worker.Unfit = await asyncio.shield(future)
        except KilledWorker as error:
            return _Killed(error.allowed_failures + 1)
        except (distributed.CancelledError, OSError):
            raise ClusterError(
                f"{self._cluster}: the Dask scheduler is gone; start it, then give the same command again"
            ) from None
        except Exception as error:  # of a worker that joined later and has another version of something
            raise ClusterError(f"{self._cluster}: a worker cannot do the work ({in_words(error)})") from None
        finally:
            future.release()
        if isinstance(outcome, worker.Unfit):
            raise ClusterError(f"{self._cluster}: worker {outcome.address}: {outcome.problem}")
        return outcome

    def _take_request(self, event: tuple[float, list[str]]) -> None:
        key, address = event[1]
        if key in self._works:
            task = asyncio.create_task(self._send(key, address))
            self._sending.add(task)
            task.add_done_callback(self._sending.discard)

    async def _send(self, key: str, address: str) -> None:
        await self._client.run(worker.receive, key, self._works[key], workers=[address], on_error="ignore")


def _pickled(value: object) -> bytes:
    try:
        return bytes(cloudpickle.dumps(value))
    except Exception as error:
        raise SettingsError(
            f"{argument.cluster}: cannot send this to other processes ({in_words(error)})"
        ) from None


class _Background:
    """An event loop in a thread of its own; interruptions are noticed while its results are waited for."""

    def __enter__(self) -> _Background:
        with safe_path():
            resource_tracker.ensure_running()  # it would lift the mask of the thread's signals
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda *_: None)  # of connections that nobody waits for any more
        self._thread = threading.Thread(target=self._run, name="todframes cluster", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with held_back():
            wait([self.start(_cancel_all())], timeout=CLOSE_S)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()

    def start(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        """Start a coroutine in the loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop)

    def result(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Return the result of a coroutine."""
        future = self.start(coroutine)
        with held_back() as interrupt_if_asked:
            try:
                while not wait([future], timeout=POLL_S).done:
                    interrupt_if_asked()
                return future.result()
            except BaseException:
                future.cancel()
                raise

    @contextmanager
    def entered(self, context: AbstractAsyncContextManager[T]) -> Iterator[T]:
        """Enter an asynchronous context in the loop, and leave it within `CLOSE_S`."""
        yield_ = self.result(context.__aenter__())
        try:
            yield yield_
        finally:
            with held_back():
                wait([self.start(context.__aexit__(None, None, None))], timeout=CLOSE_S)

    def _run(self) -> None:
        if hasattr(signal, "pthread_sigmask"):
            # Ctrl-C in a terminal reaches all processes; those that are started from here inherit the mask.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._loop.run_forever()


async def _cancel_all() -> None:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def _connected(cluster: str) -> AsyncIterator[Client]:
    async with AsyncExitStack() as stack:
        if local := re.fullmatch(LOCAL + "([1-9][0-9]*)", cluster):
            address = await stack.enter_async_context(_local_cluster(int(local[1])))
        elif re.fullmatch("(tcp|tls|ws|wss)://.+:[0-9]{1,5}", cluster):
            address = cluster
        else:
            raise SettingsError(f"{argument.cluster}: found {cluster!r}, expected local:N or tcp://HOST:PORT")
        client = await stack.enter_async_context(_client(address))
        await _check(client, cluster)
        yield client


@asynccontextmanager
async def _client(address: str) -> AsyncIterator[Client]:
    client = Client(address, asynchronous=True, timeout=CONNECT_S, set_as_default=False, direct_to_workers=False)
    try:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", VersionMismatchWarning)  # `_check` looks at the versions
                await client
        except OSError:
            raise ClusterError(
                f"{address}: no Dask scheduler has answered within {CONNECT_S:g} s; is the address right, and "
                "`dask scheduler` running there?"
            ) from None
        except Exception as error:
            raise ClusterError(
                f"{address}: cannot talk to what listens there ({in_words(error)}); expected a Dask scheduler of "
                f"version {distributed.__version__}"
            ) from None
        yield client
    finally:
        with suppress(TimeoutError):  # it waits for a lost scheduler
            await asyncio.wait_for(client.close(), CLOSE_CLIENT_S)


@asynccontextmanager
async def _local_cluster(n_workers: int) -> AsyncIterator[str]:
    """Start a scheduler in this process and worker processes, and yield the scheduler's address."""
    environment = worker.THREADS_ENVIRONMENT | {SAFE_PATH: "1"}
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": environment,
        # Samples of the stack, a hundred each second, and nobody who looks at them.
        "distributed.worker.profile.enabled": False,
        # A process that dies is started again, without end; Dask gives one up that happens to be down after this.
        "distributed.deploy.lost-worker-timeout": "1000 days",
    }
    with _environment_kept(environment), dask.config.set(settings), tempfile.TemporaryDirectory() as folder:
        cluster = LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            memory_limit=0,
            asynchronous=True,
            dashboard_address="127.0.0.1:0",
            local_directory=folder,
            scheduler_kwargs={"allowed_failures": 0},
            silence_logs=logging.CRITICAL,
        )
        try:
            try:
                await cluster
            except Exception as error:
                raise ClusterError(
                    f"local:{n_workers}: the processes could not start ({in_words(error)}); a script must call "
                    'this below `if __name__ == "__main__":`'
                ) from None
            yield cluster.scheduler_address
        finally:
            closing = (nanny.close(timeout=KILL_S) for nanny in cluster.workers.values())
            await asyncio.gather(*closing, return_exceptions=True)
            await cluster.close()


@contextmanager
def _environment_kept(names: Iterable[str]) -> Iterator[None]:
    """Restore variables of the environment, which Dask sets in this process before it starts another one."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


async def _check(client: Client, cluster: str) -> None:
    """Raise ClusterError unless there is a worker, and scheduler and workers have the versions of this process."""
    ours = distributed.__version__
    found = (await client.get_versions())["scheduler"]["packages"]["distributed"]
    if found != ours:
        raise ClusterError(f"{cluster}: the scheduler has distributed {found}, expected {ours} as here")
    started = time.monotonic()
    while not await _count_threads(client):
        if time.monotonic() - started > CONNECT_S:
            raise ClusterError(f"{cluster}: the scheduler has no workers; start some with `dask worker {cluster}`")
        await asyncio.sleep(POLL_S)
    expected = worker.versions()
    for address, answer in (await client.run(worker.versions, on_error="return")).items():
        if isinstance(answer, Exception):
            raise ClusterError(
                f"{cluster}: worker {address} has no todframes {expected.todframes} ({in_words(answer)}); "
                "install it there"
            )
        if answer != expected:
            raise ClusterError(f"{cluster}: worker {address}: {worker.different_versions(answer, expected)}")


def _dashboard(client: Client) -> str | None:
    try:
        return client.dashboard_link or None
    except KeyError:
        return None


async def _count_threads(client: Client) -> int:
    return sum((await client.nthreads()).values())


@contextmanager
def _without_messages() -> Iterator[None]:
    """Silence the loggers of Dask: about lost connections and dead processes, the engine says what matters."""
    names = {*LIBRARIES, *(name for name in logging.root.manager.loggerDict if name.split(".")[0] in LIBRARIES)}
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)
