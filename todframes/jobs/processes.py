"""The engine of one machine for work that holds the interpreter lock: processes, each at the end of a pipe."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection, wait
from typing import Any

from todframes.errors import TodframesError
from todframes.jobs.start import safe_path
from todframes.jobs.work import Item, Lost, Result, Work
from todframes.signals import held_back
from todframes.threads import POLL_S
from todframes.user_code import search_last, searched_last

ITEMS_PER_TASK = 8
"""Number of items that a process takes at a time."""

END_S = 1.0
"""Time that a process has to end by itself, in seconds."""


class ProcessEngine:
    """Work in new processes of this machine, as an `Engine`; results come in any order.

    It is for work in Python itself and on small arrays, which threads do not speed up. Each process imports the
    script that runs, so a script calls below `if __name__ == "__main__":`.

    Parameters
    ----------
    n_workers : int
        Number of processes.
    items_per_task : int
        Number of items that a process takes at a time; neighbours may share parts of their computation.
    """

    is_local = False
    dashboard: str | None = None

    def __init__(self, n_workers: int, *, items_per_task: int = ITEMS_PER_TASK) -> None:
        self.n_workers = n_workers
        self.items_per_task = items_per_task

    def run(
        self, work: Work[Item, Result], items: Iterable[tuple[int, Item]]
    ) -> Generator[list[tuple[int, Result | Lost]], None, None]:
        """Yield lists of items that are finished, as (number, result).

        If a process dies, its items are tried again one at a time. An item whose process dies again is lost.

        Raises
        ------
        TodframesError
            If processes cannot be started.
        """
        tasks = self._tasks(items)
        suspects: deque[list[tuple[int, Item]]] = deque()
        tried: set[int] = set()
        workers: list[_Worker] = []
        with held_back() as interrupt_if_asked:
            try:
                workers += [_Worker(work) for _ in range(self.n_workers)]
                while True:
                    for worker in workers:
                        if not worker.task:
                            worker.begin(suspects.popleft() if suspects else next(tasks, []))
                    busy = {worker.connection: worker for worker in workers if worker.task}
                    if not busy:
                        return
                    ready = wait(list(busy), timeout=POLL_S)
                    interrupt_if_asked()
                    for worker in [busy[connection] for connection in ready]:  # type: ignore[index]
                        if not worker.is_started:
                            worker.start()
                            continue
                        task, answer = worker.finished()
                        if answer is not None:
                            yield answer
                            continue
                        worker.end()
                        workers[workers.index(worker)] = _Worker(work)
                        number, item = task[0]
                        if number in tried:
                            yield [(number, Lost(work.lost(item)))]
                        else:
                            tried.update(number for number, _ in task)
                            suspects.extend([one] for one in task)
            finally:
                for worker in workers:
                    worker.end()

    def _tasks(self, items: Iterable[tuple[int, Item]]) -> Iterator[list[tuple[int, Item]]]:
        items = iter(items)
        while task := list(islice(items, self.items_per_task)):
            yield task


class _Worker:
    """A process, and the items that it works on."""

    def __init__(self, work: Work[Any, Any]) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy the locks of threads
        self.connection, other = context.Pipe()
        self.task: list[tuple[int, Any]] = []
        self.is_started = False
        arguments = (other, searched_last(), pickle.dumps(work))
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with safe_path():
            self._process.start()
        other.close()

    def start(self) -> None:
        """Take note that the process has started.

        Raises
        ------
        TodframesError
            If it has died instead.
        """
        try:
            self.is_started = self.connection.recv()
        except (EOFError, OSError):
            raise TodframesError(
                "workers: a process could not start; a script must call this below "
                '`if __name__ == "__main__":`, and an observer of one\'s own must be in a file'
            ) from None

    def begin(self, task: list[tuple[int, Any]]) -> None:
        """Give the process items; none if the list is empty."""
        self.task = task
        if task:
            with suppress(OSError):  # if it has died, `finished` tells
                self.connection.send(task)

    def finished(self) -> tuple[list[tuple[int, Any]], list[tuple[int, Any]] | None]:
        """Return the items of the process and their results; None if it has died.

        An exception of the work is raised here.
        """
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            return self.task, None
        if isinstance(answer, BaseException):
            raise answer
        task, self.task = self.task, []
        return task, answer

    def end(self) -> None:
        """End the process, at once if it works."""
        if self.task:
            self._process.terminate()
        self.connection.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


def _serve(connection: Connection, folders: Sequence[str], work: bytes) -> None:
    """Do the tasks that come through a pipe until it is closed; the other end deals with Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    search_last(folders)
    function = pickle.loads(work).function()
    connection.send(True)
    with suppress(EOFError, OSError):  # the other end is closed
        while True:
            task = connection.recv()
            try:
                answer: object = [(number, function(item)) for number, item in task]
            except Exception as error:  # it is raised at the other end
                answer = error
            connection.send(answer)
