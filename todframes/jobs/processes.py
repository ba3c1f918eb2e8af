"""The engine of one machine: a pool of processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from todframes.base.errors import TodframesError, argument
from todframes.base.user_code import searched_last
from todframes.jobs.batches import DeadWorkerError, PoolEngine
from todframes.jobs.start import starting_processes
from todframes.jobs.worker import Done, UnfitError, do_batch_of_file


class ProcessEngine(PoolEngine):
    """The engine of processes of this machine, which start with the first batches. Each process imports the script
    that runs, so a script calls below `if __name__ == "__main__":`. All end with this process, however it ends.
    """

    name, batch_s, batches_per_worker = "workers", 0.5, 2

    def __init__(self, n_workers: int) -> None:
        super().__init__(min(n_workers, 61) if sys.platform == "win32" else n_workers)  # Windows waits for 61
        self._pool: ProcessPoolExecutor | None = None
        self._processes: set[BaseProcess] = set()

    def close(self) -> None:
        """End the processes at once."""
        if self._pool is not None:
            for process in self._processes:
                process.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
            self._processes.clear()

    @contextmanager
    def _sent(self, work: bytes) -> Iterator[Callable[[bytes], Future[Done]]]:
        in_flight: set[Future[Done]] = set()
        with tempfile.TemporaryDirectory(prefix="todframes-") as folder:
            path = Path(folder, "work")
            try:
                path.write_bytes(pickle.dumps((work, searched_last())))
            except OSError as error:
                raise TodframesError(f"{path}: cannot be written ({error.strerror})") from None

            def submit(items: bytes) -> Future[Done]:
                future = self._submit(partial(do_batch_of_file, str(path), items))
                in_flight.add(future)
                future.add_done_callback(in_flight.discard)
                return future

            try:
                yield submit
            finally:
                if in_flight:  # nobody waits for their results, and they may write files
                    self.close()

    def _submit(self, task: Callable[[], Any]) -> Future[Any]:
        """Submit a task; the pool and its processes start with their tasks."""
        try:
            with starting_processes():
                others = set(multiprocessing.active_children())
                if self._pool is None:
                    context = multiprocessing.get_context("spawn")  # a fork would copy the locks of threads
                    self._pool = ProcessPoolExecutor(self.n_workers, context, initializer=_end_with_parent)
                    self._first = self._pool.submit(os.getpid)
                future = self._pool.submit(task)
                self._processes |= set(multiprocessing.active_children()) - others
        except BrokenProcessPool:
            raise self._broken() from None
        except OSError as error:
            raise TodframesError(
                f"{argument.workers}: a process could not start ({error.strerror}); take fewer workers, or "
                "raise the limits of the shell (ulimit)"
            ) from None
        return future

    def _check_workers(self) -> None:
        """Raise TodframesError if the thread of the pool that brings results has ended: none would ever come."""
        manager = getattr(self._pool, "_executor_manager_thread", None)
        if manager is not None and not manager.is_alive():
            raise TodframesError(
                f"{argument.workers}: a thread could not start; take fewer workers, or raise the limits "
                "of the shell (ulimit)"
            )

    def _outcome(self, future: Future[Done]) -> Done:
        try:
            return future.result()
        except BrokenProcessPool:
            raise self._broken() from None
        except UnfitError as error:
            raise TodframesError(
                f"{argument.workers}: {error}; an observer of one's own must be in a file"
            ) from None

    def _broken(self) -> Exception:
        """Return the error for a process of the pool that has died, at its start or later."""
        has_started = self._first.exception() is None
        self.close()
        if has_started:
            return DeadWorkerError()
        return TodframesError(
            f"{argument.workers}: a process could not start; a script must call this below "
            '`if __name__ == "__main__":`, and there must be memory for all'
        )


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
