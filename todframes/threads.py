"""Work in threads: results come in order, few are computed ahead, and interruptions act only when it is safe."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from todframes.signals import held_back, raise_again

T = TypeVar("T")
R = TypeVar("R")

AHEAD_PER_WORKER = 4
"""Number of tasks that each worker may begin ahead of their turn; their results wait in memory."""

POLL_S = 0.1
"""Longest time until an interruption is noticed, in seconds."""


def map_in_threads(work: Callable[[T], R], tasks: Iterable[T], workers: int) -> Generator[R, None, None]:
    """Yield the results of tasks in their order; with one worker, tasks run in the calling thread.

    The exception of a task is raised in its turn, and tasks not yet begun are dropped, as they are by `close`.
    Ctrl-C and a request to end wait until a result is asked for: as exceptions they could be raised inside the
    pool while it holds a lock, and the clean-up would then wait for ever.
    """
    if workers == 1:
        for task in tasks:
            raise_again()
            yield work(task)
        return
    ahead: deque[Future[R]] = deque()
    with held_back() as interrupt_if_asked, ThreadPoolExecutor(workers) as pool:

        def next_result() -> R:
            future = ahead.popleft()
            raise_again()
            interrupt_if_asked()
            while not wait([future], timeout=POLL_S).done:
                interrupt_if_asked()
            return future.result()

        try:
            for task in tasks:
                ahead.append(pool.submit(work, task))
                if len(ahead) > AHEAD_PER_WORKER * workers:
                    yield next_result()
            while ahead:
                yield next_result()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
