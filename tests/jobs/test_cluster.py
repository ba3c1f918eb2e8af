"""A Dask cluster as the engine: what is sent, and what happens when parts of it die."""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import test_processes

import todframes
from todframes.base.errors import ClusterError, FrameError, SettingsError, TodframesError
from todframes.jobs import batches as handing
from todframes.jobs import run as engines
from todframes.jobs import worker
from todframes.jobs.run import open_engine

if TYPE_CHECKING:
    from todframes.jobs.cluster import ClusterEngine

HAS_DASK = find_spec("distributed") is not None
if HAS_DASK:
    import cloudpickle

    from todframes.jobs import cluster

    # Workers cannot import this module.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])


def dask(test: Any) -> Any:
    """Mark a test that needs Dask; all of them start processes, or import Dask, which takes as long."""
    return pytest.mark.slow(pytest.mark.skipif(not HAS_DASK, reason="needs the extra `cluster`")(test))


@dataclass
class Squares:
    """Work that squares integers, and takes `seconds` for each; `payload` makes it large."""

    seconds: float = 0.0
    payload: bytes = b""

    def function(self) -> Callable[[int], int]:
        def square(item: int) -> int:
            time.sleep(self.seconds)
            return item**2

        return square

    def name(self, item: int) -> str:
        return f"item {item}"


@dataclass
class Calls:
    """Work whose function is given, and does anything."""

    call: Callable[[int], Any]

    def function(self) -> Callable[[int], Any]:
        return self.call

    def name(self, item: int) -> str:
        return f"item {item}"


def results_of(engine: ClusterEngine, work: Any, items: Any) -> dict[int, Any]:
    """Results by number; each number has come once."""
    pairs = [pair for batch in engine.run(work, enumerate(items)) for pair in batch]
    found = dict(pairs)
    assert len(found) == len(pairs)
    return found


def squares(n: int) -> dict[int, int]:
    return {number: number**2 for number in range(n)}


def test_asking_for_a_cluster_without_dask_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda _: None)
    message = r"^cluster: needs the package distributed.*: pip install 'todframes\[cluster\]'$"
    with pytest.raises(SettingsError, match=message), open_engine("local:2", 1):
        pass


def test_dask_is_imported_for_a_cluster_alone() -> None:
    code = "import sys, todframes.jobs.run; sys.exit(bool({'dask', 'distributed'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.fixture(scope="module")
def local() -> Iterator[ClusterEngine]:
    with open_engine("local:2", 1) as engine:
        yield engine


@pytest.mark.every_case
@dask
@pytest.mark.parametrize("n", [0, 1000])
def test_results_come_with_their_numbers(local: ClusterEngine, n: int) -> None:
    assert results_of(local, Squares(), range(n)) == squares(n)
    assert local.n_workers == 2
    assert local.dashboard is not None
    assert local.dashboard.startswith("http://127.0.0.1:")


@dask
def test_the_work_is_sent_once_to_each_process_and_never_with_items(local: ClusterEngine, tmp_path: Path) -> None:
    made = tmp_path / "made"

    @dataclass
    class Large(Squares):
        def function(self) -> Callable[[int], int]:
            with made.open("a") as file:
                file.write(f"{os.getpid()}\n")
            return super().function()

    work = Large(seconds=0.002, payload=os.urandom(4_000_000))
    stream = local._client.scheduler_comm
    before = stream.byte_count
    assert results_of(local, work, range(2000)) == squares(2000)
    processes = made.read_text().split()
    assert len(processes) == len(set(processes)) == 2
    # A pickled integer takes 3 bytes or fewer; each of some 40 batches is allowed 2 kB for its names.
    assert stream.byte_count - before < 2000 * 3 + 100 * 2000


@dask
def test_processes_are_new_and_have_one_native_thread(
    local: ClusterEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(todframes, "_of_the_parent", True, raising=False)

    def look(_: int) -> tuple[bool, set[int]]:
        import cv2
        import OpenImageIO as oiio
        import scipy.linalg  # has a BLAS of its own
        import threadpoolctl

        assert scipy.linalg.svd(np.eye(2))[1].all()
        threads = {one["num_threads"] for one in threadpoolctl.threadpool_info()}
        return hasattr(todframes, "_of_the_parent"), threads | {
            cv2.getNumThreads(),
            oiio.get_int_attribute("threads"),
        }

    found = list(results_of(local, Calls(look), range(4)).values())
    assert found == [(False, {1})] * 4


@dask
def test_libraries_that_are_loaded_already_are_kept_to_one_thread() -> None:
    """As in a worker that was started without a nanny, which sets the environment."""
    code = """
        import os
        import cv2, numpy, OpenImageIO, threadpoolctl
        from todframes.jobs.worker import keep_libraries_to_one_thread
        cv2.setNumThreads(2)
        OpenImageIO.attribute("threads", 2)
        assert any(one["num_threads"] == 2 for one in threadpoolctl.threadpool_info())
        keep_libraries_to_one_thread()
        assert all(one["num_threads"] == 1 for one in threadpoolctl.threadpool_info())
        assert cv2.getNumThreads() == OpenImageIO.get_int_attribute("threads") == 1
        """
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    lines = "\n".join(line.strip() for line in code.splitlines())
    subprocess.run([sys.executable, "-c", lines], check=True, env=environment)


@dask
def test_a_run_that_ends_while_results_are_fetched_leaves_the_cluster_as_it_was(local: ClusterEngine) -> None:
    client = local._client
    permits = client._gather_semaphore._value

    async def hold_back_results() -> None:
        for _ in range(permits):
            await client._gather_semaphore.acquire()

    async def fetch_results() -> None:
        for _ in range(permits):
            client._gather_semaphore.release()

    def items() -> Iterator[int]:
        yield from range(4)
        deadline = time.monotonic() + 10
        while client._gather_future is None and time.monotonic() < deadline:
            time.sleep(0.01)
        raise FrameError("frames/4.exr", "the file is empty")

    local._start(hold_back_results()).result()
    with pytest.raises(FrameError, match="the file is empty"):
        results_of(local, Squares(), items())
    local._start(fetch_results()).result()
    assert results_of(local, Squares(), range(10)) == squares(10)


class NotPortableError(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


@dask
def test_a_batch_that_kills_its_workers_again_and_again_is_named(local: ClusterEngine) -> None:
    def call(item: int) -> int:
        time.sleep(0.002)
        if item == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return item**2

    with pytest.raises(TodframesError, match=r"^cluster: a process died at ") as raised:
        results_of(local, Calls(call), range(12))
    first, *_, last = map(int, re.findall("item ([0-9]+)", str(raised.value)) * 2)
    assert first <= 5 <= last
    assert results_of(local, Squares(), range(10)) == squares(10)


@contextlib.contextmanager
def scheduler_process(
    *worker_options: str, connect_s: float = 60.0
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler in a process of its own that listens, and a worker if there are options for one: its address and
    process. A busy machine takes its time to start them.
    """
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    command = ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--dashboard-address", "127.0.0.1:0"]
    processes = [_dask(*command)]
    if worker_options:
        processes.append(_dask("worker", address, "--nthreads", "1", *worker_options))
    try:
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
                break
            time.sleep(0.05)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cluster, "CONNECT_S", connect_s)
            yield address, processes[0]
    finally:
        for process in processes:
            process.kill()  # a worker whose scheduler is gone does not end when it is asked to
            process.wait()


def _dask(command: str, *options: str) -> subprocess.Popen[bytes]:
    module = f"distributed.cli.dask_{command}"
    return subprocess.Popen([sys.executable, "-m", module, *options], stderr=subprocess.DEVNULL)


def kill_after(n: int, process: subprocess.Popen[bytes], items: Iterator[int]) -> Iterator[int]:
    """Items, and a kill of the process as one of them is asked for."""
    yield from itertools.islice(items, n)
    process.kill()
    yield from items


@dask
def test_a_dead_scheduler_ends_the_run_with_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with scheduler_process("--local-directory", str(tmp_path)) as (address, process):
        endless = kill_after(20, process, itertools.repeat(0))
        message = f"^{address}: the Dask scheduler is gone; start it, then give the same command again$"
        with pytest.raises(ClusterError, match=message), open_engine(address, 1) as engine:
            results_of(engine, Squares(seconds=0.01), endless)
        assert process.wait() == -signal.SIGKILL
    assert capfd.readouterr() == ("", "")


@dask
def test_a_run_without_workers_ends_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "WITHOUT_WORKERS_S", 2.0)
    options = ("--no-nanny", "--local-directory", str(tmp_path))

    def call(_: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with (
        scheduler_process(*options) as (address, _),
        pytest.raises(ClusterError, match=f"^{address}: all workers have been gone for 2 s; start some"),
        open_engine(address, 1) as engine,
    ):
        results_of(engine, Calls(call), [0])


@pytest.mark.every_case
@dask
@pytest.mark.parametrize("name", ["", "local:0", "foo", "http://h:1", "tcp://h"])
def test_what_names_no_cluster_is_one_line(name: str) -> None:
    message = rf"^cluster: found '{name}', expected local:N or tcp://HOST:PORT$"
    with pytest.raises(SettingsError, match=message), open_engine(name, 1):
        pass


@dask
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://no-such-host.invalid:8786"])
def test_no_scheduler_at_the_address_is_one_line(
    address: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    message = f"^{address}: no Dask scheduler has answered within 0.5 s; is the address right, "
    with pytest.raises(ClusterError, match=message), open_engine(address, 1):
        pass
    assert capfd.readouterr() == ("", "")


@dask
def test_something_else_at_the_address_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 10)
                    connection.close()

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(ClusterError, match=f"^{address}: "), open_engine(address, 1):
            pass
        server.shutdown(socket.SHUT_RDWR)
    thread.join()
    assert capfd.readouterr() == ("", "")


@dask
@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("sys.modules['todframes'] = None", r"a worker cannot do the work \(.*ModuleNotFoundError"),
        ("import todframes; todframes.__version__ = '0.0.7'", r"worker tcp://\S+: found todframes 0\.0\.7, ex"),
    ],
)
def test_a_worker_without_the_package_or_of_another_version_is_one_line(tmp_path: Path, code, message) -> None:
    (tmp_path / "preload.py").write_text(f"import sys; {code}\n")
    options = ("--local-directory", str(tmp_path), "--preload", str(tmp_path / "preload.py"))
    with (
        scheduler_process(*options) as (address, _),
        pytest.raises(ClusterError, match=f"^{address}: {message}"),
        open_engine(address, 1) as engine,
    ):
        results_of(engine, Squares(), [0])


@dask
def test_a_scheduler_without_workers_is_one_line() -> None:
    with scheduler_process(connect_s=4.0) as (address, _):
        message = f"^{address}: the scheduler has no workers"
        with pytest.raises(ClusterError, match=message), open_engine(address, 1):
            pass


class Instant(handing.PoolEngine):
    """A pool that does its batches at once, and says that each item took a time; it keeps the sizes of batches."""

    name, batch_s, batches_per_worker = "instant", 2.0, 1

    def __init__(self, seconds_per_item: float, most: int = 10_000) -> None:
        super().__init__(1)
        self.seconds_per_item, self.most = seconds_per_item, most
        self.sizes: list[int] = []

    @contextlib.contextmanager
    def _sent(self, work: bytes) -> Iterator[Callable[[bytes], Future[worker.Done]]]:
        function = pickle.loads(work)[0].function()

        def submit(items: bytes) -> Future[worker.Done]:
            values = pickle.loads(items)
            self.sizes.append(len(values))
            done = [function(value) for value in values[: self.most]]
            future: Future[worker.Done] = Future()
            future.set_result(worker.Done(pickle.dumps(done), len(done), len(done) * self.seconds_per_item, None))
            return future

        yield submit

    def _outcome(self, future: Future[worker.Done]) -> worker.Done:
        return future.result()


@pytest.mark.parametrize(
    ("seconds_per_item", "size"),
    [(30.0, 1), (0.5, 4), (0.02, 100), pytest.param(0.0, 10_000, marks=pytest.mark.slow)],
)
def test_batches_begin_small_and_come_to_take_two_seconds(seconds_per_item: float, size: int) -> None:
    pool = Instant(seconds_per_item)
    for _ in itertools.islice(pool.run(Squares(), enumerate(itertools.repeat(0))), 30):
        pass
    assert pool.sizes[0] == 1
    assert all(b <= 2 * a + 1 for a, b in itertools.pairwise(pool.sizes))
    # The rate is a mean of all earlier ones, each half as important as the next: 2^-30 is left of the first.
    assert pool.sizes[-1] in (size - 1, size)


def test_what_a_batch_has_not_done_is_done_later() -> None:
    pool = Instant(0.0, most=3)
    assert dict(pair for batch in pool.run(Squares(), enumerate(range(100))) for pair in batch) == squares(100)
    assert max(pool.sizes) > 3


class Unready(test_processes.Squares):
    """Work that cannot be begun."""

    def function(self) -> Callable[[int], int]:
        raise FrameError("frames/1.exr", "the file is empty")


def test_a_worker_does_batches_of_the_work_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process; a work drops the one before, and errors arrive as another process can read them."""
    for name in ("_received", "_functions"):
        monkeypatch.setattr(worker, name, {})
    works = test_processes.Squares(refused=4), Unready(), test_processes.Elsewhere()
    for number, work in enumerate(works):
        (tmp_path / str(number)).write_bytes(pickle.dumps((pickle.dumps((work, True)), [])))
    refused, unready, elsewhere = paths = [str(tmp_path / str(number)) for number in range(3)]
    for _ in range(2):
        done = worker.do_batch_of_file(refused, pickle.dumps([2, 3, 4, 5]))
        assert (pickle.loads(done.results), done.n_items, str(done.error)) == (
            [4, 9],
            2,
            "found 4, expected another number",
        )
    assert list(worker._functions) == list(worker._received) == paths[:1]
    done = worker.do_batch_of_file(unready, pickle.dumps([2]))
    assert (pickle.loads(done.results), done[1:3], str(done.error)) == (
        [],
        (0, 0.0),
        "frames/1.exr: the file is empty",
    )
    with pytest.raises(worker.UnfitError, match=r"^cannot load the work \(ModuleNotFoundError: .*'nowhere'"):
        worker.do_batch_of_file(elsewhere, pickle.dumps([2]))
    assert (list(worker._functions), list(worker._received)) == ([], paths[2:])
    worker.forget(elsewhere)
    assert worker._received == {}
    ticks = iter((0.0, 2.0, 4.0, 6.0, 6.5))
    monkeypatch.setattr(worker, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    done = worker._do(lambda item: item**2, range(100))  # ends after LONGEST_BATCH_S, 5 s
    assert (done.n_items, done.seconds, pickle.loads(done.results)) == (3, 6.5, [0, 1, 4])


def test_errors_of_a_worker_can_be_read_elsewhere() -> None:
    def unlike(item: int) -> object:
        if item == 3:
            raise NotPortableError(2, 3)
        return threading.Lock() if item == 2 else sys.exit() if item == 1 else 1 / item

    inverse, left, lock, words = (worker._do(unlike, [4, item]) for item in range(4))
    assert [done.n_items for done in (inverse, left, lock, words)] == [1, 1, 0, 1]
    (note,) = inverse.error.__notes__
    assert isinstance(inverse.error, ZeroDivisionError) and re.match(
        r'in a worker:\n  File ".*in unlike', note, re.DOTALL
    )
    assert [str(done.error).partition(": ")[0] for done in (left, words)] == ["in a worker"] * 2
    assert str(words.error) == "in a worker: NotPortableError: 2 and 3" and isinstance(lock.error, TypeError)


@dask
def test_ctrl_c_in_a_terminal_ends_all_processes_at_once_and_quietly(tmp_path: Path, monkeypatch) -> None:
    script = test_processes.GUARDED.replace("open_engine(None, 2)", 'open_engine("local:2", 1)')
    assert script != test_processes.GUARDED
    monkeypatch.setattr(test_processes, "GUARDED", script)
    test_processes.test_ctrl_c_ends_all_processes_at_once_and_quietly(tmp_path, reaches_all=True)
