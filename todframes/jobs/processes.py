"""The engine of one machine: processes, each with a pool of its own."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any

from todframes.base.errors import TodframesError, argument
from todframes.base.user_code import searched_last
from todframes.jobs import worker
from todframes.jobs.batches import ExecutorEngine, Killed
from todframes.jobs.start import starting_processes
from todframes.jobs.worker import Done, Unfit

BATCH_S = 0.5
"""Time that a batch is meant to take."""

BATCHES_PER_PROCESS = 2
"""Largest number of batches of a process: the one that it works on, and the next."""


class Processes(Executor):
    """Executor of processes of this machine, each with a pool of its own: one that dies takes only its own tasks.

    A process is started when there is a task for it, and again after it has died. Each imports the script that
    runs, so a script calls below `if __name__ == "__main__":`. All end with this process, however it ends.

    Parameters
    ----------
    n_processes : int
    """

    def __init__(self, n_processes: int) -> None:
        self._set_ups: dict[str, Callable[[], object]] = {}
        self._processes = [_Process() for _ in range(n_processes)]

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Make the process with the fewest tasks call a function.

        Raises
        ------
        TodframesError
            If a process has died as it started.
        """
        process = min(self._processes, key=lambda one: len(one.tasks))
        return process.submit(self._set_ups, partial(function, *args, **kwargs))

    def set_up(self, name: str, function: Callable[[], object]) -> None:
        """Make each process call a function once before the tasks that are submitted from now on."""
        self._set_ups[name] = function

    def tear_down(self, name: str, function: Callable[[], object]) -> None:
        """Make each process that has called the function of `set_up` call another one."""
        if self._set_ups.pop(name, None) is not None:
            for process in self._processes:
                process.tear_down(name, function)

    def check(self) -> None:
        """Raise TodframesError if a process has died as it started."""
        for process in self._processes:
            process.check()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: ARG002
        """End all processes at once."""
        for process in self._processes:
            process.end()


class _Process:
    """A process, which starts with its first task, and the tasks that it has."""

    def __init__(self) -> None:
        self.tasks: set[Future[Any]] = set()
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, set_ups: Mapping[str, Callable[[], object]], task: Callable[[], Any]) -> Future[Any]:
        """Make the process do a task, and before it the `set_ups` that it has not done."""
        while True:
            pool = self._pool or self._start()
            try:
                for name in set_ups.keys() - self._set_up:
                    pool.submit(set_ups[name])
                    self._set_up.add(name)
                future = pool.submit(task)
            except BrokenProcessPool:  # it has died
                self.check()
                self.end()
                continue
            self.tasks.add(future)
            future.add_done_callback(self.tasks.discard)
            return future

    def tear_down(self, name: str, function: Callable[[], object]) -> None:
        """Make the process call a function if it has done the set-up of this name."""
        if self._pool is not None and name in self._set_up:
            self._set_up.remove(name)
            with suppress(BrokenProcessPool):
                self._pool.submit(function)

    def check(self) -> None:
        """Raise TodframesError if the process has died as it started."""
        if self._pool is not None and self._started.done() and self._started.exception() is not None:
            raise TodframesError(
                "workers: a process could not start; a script must call this below "
                '`if __name__ == "__main__":`, and there must be memory for all'
            )

    def end(self) -> None:
        """End the process at once."""
        if self._pool is not None:
            self._child.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _start(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")  # a fork would copy the locks of threads
        self._set_up: set[str] = set()
        with starting_processes():
            others = set(multiprocessing.active_children())
            self._pool = ProcessPoolExecutor(1, context, initializer=_end_with_parent)
            self._started = self._pool.submit(os.getpid)
            self._child: BaseProcess
            (self._child,) = set(multiprocessing.active_children()) - others
        return self._pool


class ProcessEngine(ExecutorEngine):
    """The engine of processes of this machine.

    Parameters
    ----------
    n_workers : int
        Number of processes.
    """

    name, batch_s, batches_per_worker = argument.workers, BATCH_S, BATCHES_PER_PROCESS

    def __init__(self, n_workers: int) -> None:
        super().__init__(n_workers)
        self._processes = Processes(n_workers)

    def close(self) -> None:
        """End the processes."""
        self._processes.shutdown()

    def _begin(self, key: str, work: bytes) -> None:
        self._processes.set_up(key, partial(worker.receive, key, work, searched_last()))

    def _submit(self, key: str, items: bytes) -> Future[Any]:
        return self._processes.submit(worker.do_batch, key, items)

    def _outcome(self, future: Future[Any]) -> Done | Killed:
        try:
            outcome: Done | Unfit = future.result()
        except BrokenProcessPool:
            self._processes.check()
            return Killed(1)
        if isinstance(outcome, Unfit):
            raise TodframesError(f"workers: {outcome.problem}; an observer of one's own must be in a file")
        return outcome

    def _end(self, key: str) -> None:
        self._processes.tear_down(key, partial(worker.forget, key))


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
