"""The engine of processes: all results, errors in the client, and a process that dies ends the run."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from todframes.base.errors import DataError, SettingsError, TodframesError
from todframes.jobs.processes import ProcessEngine
from todframes.jobs.run import open_engine


@dataclass(frozen=True)
class Squares:
    """Squares; some numbers kill their process, and one is refused."""

    deadly: frozenset[int] = frozenset()
    refused: int | None = None

    def function(self) -> Callable[[int], int]:
        def square(item: int) -> int:
            if item in self.deadly:
                os.kill(os.getpid(), signal.SIGKILL)
            if item == self.refused:
                raise DataError(f"found {item}, expected another number")
            return item * item

        return square

    def name(self, item: object) -> str:
        return f"number {item}"


class Naps(Squares):
    """Sleep; the result is the process."""

    def function(self) -> Callable[[float], int]:
        def nap(seconds: float) -> int:
            time.sleep(seconds)
            return os.getpid()

        return nap


class Elsewhere(Squares):
    """Work of a module that other processes lack."""

    def __reduce__(self) -> tuple[Any, ...]:
        return __import__, ("nowhere",)


@pytest.fixture(scope="module")
def engine() -> Iterator[ProcessEngine]:
    with open_engine(None, 2) as opened:
        assert isinstance(opened, ProcessEngine)
        yield opened


def results(engine: ProcessEngine, work: Any, items: Iterable[Any]) -> dict[int, object]:
    """Results by number; each number has come once."""
    pairs = list(engine.run(work, enumerate(items)))
    assert len(dict(pairs)) == len(pairs)
    return dict(pairs)


@pytest.mark.parametrize("n", [0, 1000])
def test_all_items_have_their_results(engine: ProcessEngine, n: int) -> None:
    assert results(engine, Squares(), range(n)) == {item: item * item for item in range(n)}


@pytest.mark.parametrize("deadly", [0, pytest.param(999, marks=pytest.mark.slow)])
def test_a_process_that_dies_ends_the_run_with_the_name_of_the_batch(engine: ProcessEngine, deadly: int) -> None:
    """The first item too: its process has started."""
    with pytest.raises(TodframesError, match=r"^workers: a process died at ") as raised:
        results(engine, Squares(deadly=frozenset({deadly})), range(1000))
    first, *_, last = map(int, re.findall("number ([0-9]+)", str(raised.value)) * 2)
    assert min(first, last) <= deadly <= max(first, last)
    assert results(engine, Squares(), range(50)) == {item: item * item for item in range(50)}


def test_items_are_taken_as_they_are_needed_and_dropped_at_the_end(engine: ProcessEngine) -> None:
    taken = itertools.count()
    run = engine.run(Squares(), ((next(taken), 0) for _ in range(10**6)))
    next(run)
    run.close()
    assert next(taken) <= 1000  # batches grow while items take microseconds


def test_two_processes_work_at_the_same_time(engine: ProcessEngine) -> None:
    """Also where an item takes longer than the time after which the processes are looked at."""
    processes = Counter(results(engine, Naps(), [0.3, *[0.01] * 50]).values())
    assert len(processes) == 2
    assert os.getpid() not in processes


def test_what_cannot_be_sent_is_one_line(engine: ProcessEngine) -> None:
    with pytest.raises(SettingsError, match=r"^workers: cannot send this to other processes \(.*lock"):
        results(engine, Squares(), [threading.Lock()])


def test_a_work_that_cannot_be_loaded_is_one_line(engine: ProcessEngine) -> None:
    with pytest.raises(TodframesError, match=r"^workers: cannot load the work \(ModuleNotFoundError.*'nowhere'"):
        results(engine, Elsewhere(), [0])


SCRIPT = """
import os, sys, time
from todframes.base import signals
from todframes.jobs.run import open_engine

class Naps:
    def function(self):
        return time.sleep
    def name(self, item):
        return str(item)

def main():
    try:
        with signals.raised(), open_engine(None, 2) as engine:
            for _ in engine.run(Naps(), enumerate([0.1] * 10_000)):
                print("running", flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""
GUARDED = SCRIPT + "if __name__ == '__main__':\n    main()\n"


@contextmanager
def running(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A run whose processes work, in a session of its own, which is a process group, as a terminal makes it."""
    script = tmp_path / "run.py"
    script.write_text(GUARDED, encoding="utf-8")
    command = [sys.executable, str(script)]
    with subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        yield process


@pytest.mark.slow
@pytest.mark.parametrize("reaches_all", [False, True])
def test_ctrl_c_ends_all_processes_at_once_and_quietly(tmp_path: Path, reaches_all: bool) -> None:
    with running(tmp_path) as process:
        started = time.monotonic()
        (os.killpg if reaches_all else os.kill)(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=20)  # to its end: no worker holds it any more
        assert time.monotonic() - started < 3.0
        assert (out.split()[-1], err) == ("interrupted", "")


@pytest.mark.slow
def test_all_processes_end_with_a_client_that_is_killed(tmp_path: Path) -> None:
    with running(tmp_path) as process:
        process.kill()
        started = time.monotonic()
        process.communicate(timeout=20)  # until no worker holds the pipe any more
        assert time.monotonic() - started < 3.0


@pytest.mark.slow
def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.replace("[0.1] * 10_000", "[0.1] * 4") + "main()\n", encoding="utf-8")
    process = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (process.returncode, process.stdout.split(), process.stderr) == (0, ["running"] * 4, "")
