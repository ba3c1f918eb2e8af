"""A Dask cluster as the engine: results, and one line when parts of it are missing or die."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from todframes.base.errors import ClusterError, SettingsError, TodframesError
from todframes.jobs import run as engines
from todframes.jobs.run import open_engine

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
class Calls:
    """Work whose function is given, and does anything."""

    call: Callable[[int], Any]

    def function(self) -> Callable[[int], Any]:
        return self.call

    def name(self, item: int) -> str:
        return f"item {item}"


def test_asking_for_a_cluster_without_dask_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda _: None)
    message = r"^cluster: needs the package distributed.*: pip install 'todframes\[cluster\]'$"
    with pytest.raises(SettingsError, match=message), open_engine("tcp://127.0.0.1:8786", 1):
        pass


def test_dask_is_imported_for_a_cluster_alone() -> None:
    code = "import sys, todframes.jobs.run; sys.exit(bool({'dask', 'distributed', 'joblib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@contextlib.contextmanager
def scheduler_process(folder: Path, *, has_worker: bool = True) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler in a process of its own that listens, and a worker: its address and process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    command = ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--dashboard-address", "127.0.0.1:0"]
    processes = [_dask(*command)]
    if has_worker:
        options = ("--nthreads", "1", "--nworkers", "2", "--local-directory", str(folder))
        processes.append(_dask("worker", address, *options))
    try:
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
                break
            time.sleep(0.05)
        yield address, processes[0]
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5.0)
            process.kill()
            process.wait()


def _dask(command: str, *options: str) -> subprocess.Popen[bytes]:
    module = f"distributed.cli.dask_{command}"
    # One death is enough: a busy machine takes long to start a worker again.
    environment = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    return subprocess.Popen([sys.executable, "-m", module, *options], stderr=subprocess.DEVNULL, env=environment)


def square(item: int) -> int:
    if item == 1005:
        os.kill(os.getpid(), signal.SIGKILL)
    return item**2


@dask
def test_a_cluster_does_the_work_and_a_dead_one_is_one_line(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 60.0)
    with scheduler_process(tmp_path) as (address, process), open_engine(address, 1) as engine:
        assert dict(engine.run(Calls(square), enumerate(range(300)))) == {n: n**2 for n in range(300)}
        assert engine.n_workers >= 1
        assert str(engine.dashboard).startswith("http://127.0.0.1:")
        with pytest.raises(TodframesError, match=r"^cluster: a process died at item 1005"):
            list(engine.run(Calls(square), enumerate([1005])))
        process.kill()
        message = f"^{address}: the Dask scheduler is gone; start it, then give the same command again$"
        with pytest.raises(ClusterError, match=message):
            list(engine.run(Calls(square), enumerate(itertools.repeat(0, 10**5))))


@pytest.mark.every_case
@dask
@pytest.mark.parametrize("name", ["", "local:2", "foo", "http://h:1", "tcp://h"])
def test_what_names_no_cluster_is_one_line(name: str) -> None:
    message = rf"^cluster: found '{name}', expected tcp://HOST:PORT$"
    with pytest.raises(SettingsError, match=message), open_engine(name, 1):
        pass


@dask
def test_no_scheduler_or_no_worker_is_one_line(monkeypatch, tmp_path: Path, capfd) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 2.0)
    with scheduler_process(tmp_path, has_worker=False) as (alone, _):
        for address in (alone, "tcp://127.0.0.1:1", "tcp://no-such-host.invalid:8786"):
            message = f"^{address}: no Dask scheduler with a worker has answered within 2 s"
            with pytest.raises(ClusterError, match=message), open_engine(address, 1):
                pass
    assert capfd.readouterr() == ("", "")
