"""The engine of a Dask cluster: one that runs already, or processes of this machine.

A plugin gives the work to each process, those that join later included. Each batch is waited for by a coroutine of
its own: the executor of Dask's client never hears of a batch whose worker dies while its outcome is fetched.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import re
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import CancelledError, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, TypeVar

import dask
import distributed
from distributed import Client, KilledWorker, LocalCluster, Worker, WorkerPlugin

import todframes
from todframes.base.errors import ClusterError, SettingsError, argument
from todframes.base.signals import deferred_signals
from todframes.base.user_code import in_words, searched_last
from todframes.jobs.batches import POLL_S, DeadWorkerError, PoolEngine
from todframes.jobs.start import ENVIRONMENT, environment_kept, starting_processes
from todframes.jobs.worker import Done, UnfitError, do_batch, forget, keep_libraries_to_one_thread, receive

T = TypeVar("T")

LOCAL = "local:"

CONNECT_S, WITHOUT_WORKERS_S = 10.0, 60.0
"""Time for a scheduler to answer, and then for its first worker; and time without any after which a run ends."""

CLOSE_S, CLOSE_CLIENT_S, KILL_S = 10.0, 0.5, 0.2
"""Longest time to leave a cluster in order, to end the connection to it, and for its local processes to end."""

COUNT_WORKERS_S = 1.0
"""Interval between counts of the workers."""

LOGGERS = ("distributed", "tornado", "bokeh", "asyncio")
"""Names of the loggers that are silenced, with those below them."""


@contextmanager
def cluster_engine(cluster: str) -> Iterator[ClusterEngine]:
    """Yield the engine of a cluster: `local:N`, N processes of this machine, or the address of a Dask scheduler.
    SettingsError if the text is neither of the two; ClusterError if there is no scheduler or no worker.
    """
    local = re.fullmatch(LOCAL + "([1-9][0-9]*)", cluster)
    if not local and not re.fullmatch("(tcp|tls|ws|wss)://.+:[0-9]{1,5}", cluster):
        raise SettingsError(f"{argument.cluster}: found {cluster!r}, expected local:N or tcp://HOST:PORT")
    with _without_messages(), ExitStack() as stack:
        if not local:
            _check_scheduler(cluster)
        with deferred_signals():  # what has half started cannot be closed
            address = stack.enter_context(_local_cluster(int(local[1]))) if local else cluster
            engine = ClusterEngine(cluster, stack.enter_context(_client(address)))
            stack.callback(engine.close)
        engine.wait_for_workers()
        yield engine


class ClusterEngine(PoolEngine):
    """The engine whose work is done by a Dask cluster; `cluster_engine` makes it. `n_workers` is the number of
    threads of all workers at present, `dashboard` the URL of the scheduler's page.
    """

    name, batch_s, batches_per_worker = "cluster", 2.0, 4

    def __init__(self, cluster: str, client: Client) -> None:
        super().__init__(0)
        self._cluster, self._client = cluster, client
        self._batches: set[distributed.Future] = set()
        self._last_worker_s = time.monotonic()
        with suppress(KeyError):
            self.dashboard = client.dashboard_link or None
        self._counting = self._start(self._keep_counting())

    def close(self) -> None:
        """End the count of the workers."""
        self._counting.cancel()

    def wait_for_workers(self) -> None:
        """Wait for the first worker; raise ClusterError if there is none."""
        started = time.monotonic()
        while not self.n_workers:
            if time.monotonic() - started > CONNECT_S:
                raise ClusterError(
                    f"{self._cluster}: the scheduler has no workers; start some with `dask worker {self._cluster}`"
                )
            time.sleep(POLL_S)

    @contextmanager
    def _sent(self, work: bytes) -> Iterator[Callable[[bytes], Future[Done]]]:
        # A cluster that runs already has other machines, which have their own modules.
        folders = searched_last() if self._cluster.startswith(LOCAL) else []
        key = hashlib.sha256(work).hexdigest()
        with self._explained():
            self._client.register_plugin(_Receiver(key, work, folders), name=key)
        try:
            yield lambda items: self._start(self._done(key, items))
        finally:
            wait([self._start(self._drop(key))], timeout=CLOSE_CLIENT_S)

    def _outcome(self, future: Future[Done]) -> Done:
        with self._explained():
            return future.result()

    def _check_workers(self) -> None:
        if time.monotonic() - self._last_worker_s > WITHOUT_WORKERS_S:
            raise ClusterError(
                f"{self._cluster}: all workers have been gone for {WITHOUT_WORKERS_S:g} s; start some, then give "
                "the same command again"
            )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Say in a line what is wrong with the scheduler or a worker."""
        try:
            yield
        except KilledWorker:
            raise DeadWorkerError from None
        except (CancelledError, distributed.CancelledError, OSError):
            raise ClusterError(
                f"{self._cluster}: the Dask scheduler is gone; start it, then give the same command again"
            ) from None
        except UnfitError as error:
            raise ClusterError(f"{self._cluster}: {error}") from None
        except Exception as error:  # of a worker that lacks this package, or has another version of something
            raise ClusterError(
                f"{self._cluster}: a worker cannot do the work ({in_words(error)}); is the same installed there?"
            ) from None

    def _start(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        """Start a coroutine in the thread of the client."""
        return asyncio.run_coroutine_threadsafe(coroutine, self._client.loop.asyncio_loop)

    async def _done(self, key: str, items: bytes) -> Done:
        # Not pure: Dask remembers what has failed.
        batch = self._client.submit(_do_batch, key, items, todframes.__version__, pure=False)
        self._batches.add(batch)
        try:
            done: Done = await batch
            return done
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
                self.n_workers = sum((await self._client.nthreads()).values())
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


def _do_batch(key: str, items: bytes, expected: str) -> Done:
    """Do a batch in a worker of a cluster, which has to have a version of this package."""
    try:
        if todframes.__version__ != expected:
            raise UnfitError(f"found todframes {todframes.__version__}, expected {expected}")
        keep_libraries_to_one_thread()
        return do_batch(key, items)
    except UnfitError as error:
        raise UnfitError(f"worker {distributed.get_worker().address}: {error}") from None


def _check_scheduler(address: str) -> None:
    """Raise ClusterError unless a scheduler answers. A client without one cannot be closed in order."""

    async def ask() -> None:
        async with distributed.rpc(address) as scheduler:
            await scheduler.versions()

    try:
        asyncio.run(asyncio.wait_for(ask(), CONNECT_S))
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


@contextmanager
def _client(address: str) -> Iterator[Client]:
    client = Client(address, timeout=CONNECT_S, set_as_default=False, direct_to_workers=False)
    try:
        yield client
    finally:
        with deferred_signals(), suppress(TimeoutError):  # it waits for a lost scheduler
            client.close(CLOSE_CLIENT_S)


@contextmanager
def _local_cluster(n_workers: int) -> Iterator[str]:
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
        try:
            with starting_processes():
                cluster = LocalCluster(
                    n_workers=n_workers,
                    threads_per_worker=1,
                    memory_limit=0,
                    dashboard_address="127.0.0.1:0",
                    local_directory=folder,
                    silence_logs=logging.CRITICAL,
                )
        except Exception as error:
            raise ClusterError(
                f"local:{n_workers}: the processes could not start ({in_words(error)}); a script must call "
                'this below `if __name__ == "__main__":`'
            ) from None
        try:
            yield cluster.scheduler_address
        finally:
            with deferred_signals(), suppress(OSError):
                cluster.sync(_kill, cluster)
                cluster.close(CLOSE_S)


async def _kill(cluster: LocalCluster) -> None:
    closing = (nanny.close(timeout=KILL_S) for nanny in cluster.workers.values())
    await asyncio.gather(*closing, return_exceptions=True)


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
        # Where Python ends before a process that was killed, Dask would report that it ends it.
        logging.getLogger("distributed.process").setLevel(logging.WARNING)
