"""The engine of a Dask cluster: one that runs already, or processes of this machine.

A plugin gives the work to each process, those that join later included. Each batch is waited for by a coroutine of
its own: the executor of Dask's client never hears of a batch whose worker dies while its outcome is fetched.
"""

from __future__ import annotations

import asyncio
import logging
import re
import tempfile
import threading
import time
import warnings
from collections.abc import AsyncIterator, Coroutine, Iterator
from concurrent.futures import CancelledError, Future, wait
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, contextmanager, suppress
from typing import Any, TypeVar

import dask
import distributed
from distributed import Client, KilledWorker, LocalCluster, Worker, WorkerPlugin
from distributed.versions import VersionMismatchWarning

from todframes.base.errors import ClusterError, SettingsError, argument
from todframes.base.signals import held_back
from todframes.base.user_code import in_words, searched_last
from todframes.jobs import worker
from todframes.jobs.batches import POLL_S, ExecutorEngine, Killed
from todframes.jobs.start import ENVIRONMENT, environment_kept, starting_processes
from todframes.jobs.worker import Done, Unfit, Versions, forget, receive

T = TypeVar("T")

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

BATCHES_PER_THREAD = 4
"""Largest number of batches in flight for each thread of the workers."""

LOGGERS = ("distributed", "tornado", "bokeh")
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


class ClusterEngine(ExecutorEngine):
    """The engine whose work is done by a Dask cluster; `cluster_engine` makes it.

    Attributes
    ----------
    n_workers : int
        Number of threads of all workers at present.
    dashboard : str or None
        URL of the scheduler's dashboard; None if it has none.
    """

    name, batch_s, batches_per_worker = argument.cluster, BATCH_S, BATCHES_PER_THREAD

    def __init__(self, cluster: str, client: Client, background: _Background) -> None:
        super().__init__(background.result(_count_threads(client)))
        self._cluster = cluster
        self._client = client
        self._background = background
        self._batches: set[distributed.Future] = set()
        self.dashboard = _dashboard(client)
        self._last_worker_s = time.monotonic()
        background.start(self._keep_counting())

    def _begin(self, key: str, work: bytes) -> None:
        # A cluster that runs already has other machines, which have their own modules.
        folders = searched_last() if self._cluster.startswith(LOCAL) else []
        with self._scheduler_needed():
            self._background.result(self._register(_Receiver(key, work, folders)))

    def _submit(self, key: str, items: bytes) -> Future[Any]:
        return self._background.start(self._done(key, items))

    def _outcome(self, future: Future[Any]) -> Done | Killed:
        try:
            with self._scheduler_needed():
                outcome: Done | Unfit
                address, outcome = future.result()
        except KilledWorker as error:
            return Killed(error.allowed_failures + 1)
        except ClusterError:
            raise
        except Exception as error:  # of a worker that joined later and has another version of something
            raise ClusterError(f"{self._cluster}: a worker cannot do the work ({in_words(error)})") from None
        if isinstance(outcome, Unfit):
            raise ClusterError(f"{self._cluster}: worker {address}: {outcome.problem}")
        return outcome

    def _end(self, key: str) -> None:
        wait([self._background.start(self._drop(key))], timeout=CLOSE_CLIENT_S)

    def _check_workers(self) -> None:
        if time.monotonic() - self._last_worker_s > WITHOUT_WORKERS_S:
            raise ClusterError(
                f"{self._cluster}: all workers have been gone for {WITHOUT_WORKERS_S:g} s; start some, then give "
                "the same command again"
            )

    @contextmanager
    def _scheduler_needed(self) -> Iterator[None]:
        try:
            yield
        except (CancelledError, distributed.CancelledError, OSError):
            raise ClusterError(
                f"{self._cluster}: the Dask scheduler is gone; start it, then give the same command again"
            ) from None

    async def _register(self, receiver: _Receiver) -> None:
        await self._client.register_plugin(receiver, name=receiver.key)

    async def _done(self, key: str, items: bytes) -> tuple[str, Done | Unfit]:
        # Not pure: Dask remembers what has failed.
        batch = self._client.submit(_do_batch, key, items, worker.versions(), pure=False)
        self._batches.add(batch)
        try:
            outcome: tuple[str, Done | Unfit] = await batch
            return outcome
        finally:
            self._batches.discard(batch)

    async def _drop(self, key: str) -> None:
        # The coroutines end with their batches. Cancelled themselves, they would take the others along: Dask
        # fetches the outcomes of several in one task.
        await self._client.cancel(list(self._batches))
        await self._client.unregister_worker_plugin(key)

    async def _keep_counting(self) -> None:
        while True:
            with suppress(OSError):  # a lost connection shows in the batches
                self.n_workers = await _count_threads(self._client)
            if self.n_workers:
                self._last_worker_s = time.monotonic()
            await asyncio.sleep(COUNT_WORKERS_S)


class _Receiver(WorkerPlugin):  # type: ignore[misc]
    """Plugin by which each process of a cluster receives a pickled work, and forgets it at the end of the run."""

    def __init__(self, key: str, work: bytes, folders: list[str]) -> None:
        self.key, self.work, self.folders = key, work, folders

    def setup(self, worker: Worker) -> None:  # noqa: ARG002
        """Receive the work."""
        receive(self.key, self.work, self.folders)

    def teardown(self, worker: Worker) -> None:  # noqa: ARG002
        """Forget the work."""
        forget(self.key)


def _do_batch(key: str, items: bytes, expected: Versions) -> tuple[str, Done | Unfit]:
    """Do a batch in a worker of a cluster. Returns the worker's address and the outcome."""
    address = distributed.get_worker().address
    if (found := worker.versions()) != expected:
        return address, Unfit(worker.different_versions(found, expected))
    worker.keep_libraries_to_one_thread()
    return address, worker.do_batch(key, items)


class _Background:
    """An event loop in a thread of its own; interruptions are noticed while its results are waited for."""

    def __enter__(self) -> _Background:
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda *_: None)  # of connections that nobody waits for any more
        self._thread = threading.Thread(target=self._loop.run_forever, name="todframes cluster", daemon=True)
        with starting_processes():  # by this thread; it inherits what processes do from it
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
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": ENVIRONMENT,
        # Samples of the stack, a hundred each second, and nobody who looks at them.
        "distributed.worker.profile.enabled": False,
        # A process that dies is started again, without end; Dask gives one up that happens to be down after this.
        "distributed.deploy.lost-worker-timeout": "1000 days",
    }
    with environment_kept(ENVIRONMENT), dask.config.set(settings), tempfile.TemporaryDirectory() as folder:
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
    """Silence the loggers of Dask: the engine itself reports lost connections and dead processes."""
    names = {*LOGGERS, *(name for name in logging.root.manager.loggerDict if name.split(".")[0] in LOGGERS)}
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)
