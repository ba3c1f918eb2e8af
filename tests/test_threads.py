"""Work in threads: order, errors, and interruptions that strike nowhere but between results."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from todframes import signals
from todframes.threads import AHEAD_PER_WORKER, map_in_threads


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    """Neither a thread nor a handler of a signal."""
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    n_threads = threading.active_count()
    yield
    assert threading.active_count() == n_threads
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def interrupting(at: int, stop: signal.Signals = signal.SIGINT) -> Iterator[int]:
    """Numbers, and a signal as one of them is asked for: while the pool is being filled."""
    for number in range(10_000):
        if number == at:
            signal.raise_signal(stop)
        yield number


@pytest.mark.parametrize("workers", [1, 2, 7])
@pytest.mark.parametrize("n", [0, 1, 100])
def test_results_are_in_order(workers: int, n: int) -> None:
    def work(task: int) -> int:
        time.sleep(1e-4 * (task % 3))
        return task**2

    assert list(map_in_threads(work, range(n), workers)) == [task**2 for task in range(n)]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_interruption_that_a_library_drops_ends_the_work(workers: int) -> None:
    def dropped_and_worked() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        next(map_in_threads(abs, range(10_000), workers))

    with pytest.raises(KeyboardInterrupt, match=r"^$"), signals.raised():
        dropped_and_worked()


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_comes_in_its_turn_and_ends_the_work(workers: int) -> None:
    begun = []

    def work(task: int) -> int:
        begun.append(task)
        if task == 5:
            raise ValueError(task)
        return task

    got = []
    with pytest.raises(ValueError, match="5"):
        got.extend(map_in_threads(work, range(1000), workers))
    assert got == [0, 1, 2, 3, 4]
    assert max(begun) <= 5 + (AHEAD_PER_WORKER + 1) * workers


def test_few_results_are_ahead_of_the_one_taken() -> None:
    asked = iter(range(1000))
    results = map_in_threads(lambda task: task, asked, 2)
    assert next(results) == 0
    assert next(asked) <= 2 * AHEAD_PER_WORKER + 1
    results.close()


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("at", [0, 3, 200])
def test_interruption_while_tasks_are_handed_over(workers: int, at: int) -> None:
    got: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        got.extend(map_in_threads(lambda task: task, interrupting(at), workers))
    assert len(got) <= at


def test_interruption_while_a_result_is_waited_for() -> None:
    timer = threading.Timer(0.2, signal.raise_signal, (signal.SIGINT,))
    timer.start()
    release = threading.Event()

    def work(task: int) -> int:
        release.wait(3.0)
        return task

    # Tasks under way end by themselves.
    threading.Timer(0.5, release.set).start()
    with pytest.raises(KeyboardInterrupt):
        list(map_in_threads(work, range(100), 2))
    time.sleep(0.1)


def test_other_handlers_are_called_in_their_turn() -> None:
    called: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: called.append(number))
    try:
        results = map_in_threads(lambda task: task, interrupting(4, signal.SIGTERM), 2)
        assert next(results) == 0
        assert called == [signal.SIGTERM]
        results.close()
    finally:
        signal.signal(signal.SIGTERM, before)


def test_in_another_thread_signals_are_left_alone() -> None:
    found: list[int] = []
    running = threading.Thread(target=lambda: found.extend(map_in_threads(lambda task: task, range(50), 2)))
    running.start()
    running.join()
    assert found == list(range(50))


@pytest.mark.parametrize("end", [lambda results: results.close(), lambda results: results.throw(ValueError)])
def test_left_early(end: Callable[[Iterator[int]], None]) -> None:
    results = map_in_threads(lambda task: task, range(1000), 3)
    assert next(results) == 0
    with contextlib.suppress(ValueError):
        end(results)
