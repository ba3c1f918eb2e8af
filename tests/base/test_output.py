"""On disk is after a run all that it made or nothing, whatever ends it; the files of others stay as they are."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from todframes.base import signals
from todframes.base.errors import ClusterError, OutputError
from todframes.base.output import (
    STAGING,
    StorePolicy,
    new_folder,
    output_folder,
    write_file,
)

NUMBERS = [
    pytest.param(signal.SIGINT, marks=pytest.mark.slow),
    *([signal.SIGKILL] if hasattr(signal, "SIGKILL") else []),
]
CALLS = ("mkdir", "open", "rename", "replace", "unlink", "rmdir", "chmod")
"""Of `os`, each one that changes something on disk."""
NOT_REACHED, INTERRUPTED = 99, 130

forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot fork here")
# The children use neither BLAS nor anything else that has threads.
forks_with_threads = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")


def dataset(text: str, frames: str = "ab") -> dict[str, str]:
    return {f"frames/{name}.exr": text for name in frames} | {"manifest.csv": text, "dataset.toml": text}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def simulate(path: Path, files: dict[str, str]) -> None:
    with new_folder(str(path), policy=StorePolicy()) as folder:
        write(folder, files)


def score(path: Path, files: dict[str, str]) -> None:
    with output_folder(str(path)) as folder:
        write(folder, files)


def contents(path: Path) -> dict[str, str] | None:
    """Texts of all files but those in staging folders; None if there is no folder."""
    if not path.is_dir():
        return None
    files = [file for file in path.rglob("*") if file.is_file() and STAGING not in str(file.relative_to(path))]
    return {str(file.relative_to(path)): file.read_text(encoding="utf-8") for file in files}


def names(path: Path) -> set[str]:
    return {file.name for file in path.iterdir()}


def staging_folders(path: Path) -> list[Path]:
    return [*path.rglob(f"{STAGING}*")]


def tree(path: Path) -> dict[Path, object]:
    return {file: file.is_dir() or file.lstat().st_mtime_ns for file in path.rglob("*")}


def ended_at(call: int, number: int, act: Callable[[], None]) -> int:
    """Send a signal to a child process before one of its calls that change something on disk.

    Returns its exit status: 0, that of an interruption, minus the signal, or NOT_REACHED if there are fewer calls.
    """
    if not (child := os.fork()):
        status, calls = 1, 0

        def interrupting(function: Callable[..., Any]) -> Callable[..., Any]:
            def inner(*arguments: Any, **options: Any) -> Any:
                nonlocal calls
                calls += 1
                if calls == call:
                    os.kill(os.getpid(), number)
                return function(*arguments, **options)

            return inner

        try:
            for name in CALLS:
                setattr(os, name, interrupting(getattr(os, name)))
            with signals.raised():
                act()
            status = 0 if calls >= call else NOT_REACHED
        except KeyboardInterrupt:
            status = INTERRUPTED
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def endings(
    tmp_path: Path, number: int, prepare: Callable[[Path], None], act: Callable[[Path], None]
) -> Iterator[Path]:
    """Places in which a run was ended by a signal before each of its calls."""
    for call in range(1, 1000):
        path = tmp_path / str(call) / "out"
        path.parent.mkdir()
        prepare(path)
        status = ended_at(call, number, lambda path=path: act(path))  # type: ignore[misc]
        if status == NOT_REACHED:
            assert call > 3
            return
        assert status == (INTERRUPTED if number == signal.SIGINT else -number)
        yield path
    raise AssertionError("the run has no end")


OLD, NEW, NEXT = dataset("old", "abc"), dataset("new"), dataset("next")


@forks
@forks_with_threads
@pytest.mark.parametrize("number", NUMBERS)
def test_a_folder_with_dataset_toml_holds_the_whole_dataset(tmp_path: Path, number: int) -> None:
    seen = []
    for path in endings(tmp_path, number, lambda _: None, lambda path: simulate(path, NEW)):
        found = contents(path) or {}
        seen.append("dataset.toml" in found)
        if found:
            assert found == NEW or not seen[-1]
            with pytest.raises(OutputError, match=r"is not empty, found .*; expected a new name"):
                simulate(path, NEXT)
        else:
            simulate(path, NEXT)
            assert contents(path) == NEXT
        assert staging_folders(path.parent) == []
    assert set(seen) == {False, True}


@forks
@forks_with_threads
@pytest.mark.parametrize("number", NUMBERS)
def test_results_are_replaced_and_result_json_last(tmp_path: Path, number: int) -> None:
    old = dict.fromkeys(("notes.txt", "scores.csv", "psychometric.png"), "old")
    old["result.json"] = '{"files": ["psychometric.png", "scores.csv"], "seed": 1}'
    made = dict.fromkeys(("report.html", "scores.csv"), "new") | {"result.json": '{"command": "score"}'}
    seen = []
    for path in endings(tmp_path, number, lambda path: score(path, old), lambda path: score(path, made)):
        found = contents(path)
        assert found is not None and found["notes.txt"] == "old"
        seen.append(found["result.json"] == made["result.json"])
        if seen[-1]:
            assert found == {"notes.txt": "old"} | made
        score(path, {"scores.csv": "next"})
        assert contents(path) == found | {"scores.csv": "next"}
        assert staging_folders(path.parent) == []
    assert set(seen) == {False, True}


@forks
@forks_with_threads
@pytest.mark.parametrize("number", NUMBERS)
def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path, number: int) -> None:
    seen = []
    for path in endings(
        tmp_path,
        number,
        lambda path: path.write_text("old", encoding="utf-8") and None,
        lambda path: write_file(path, b"new", not_over=tmp_path),
    ):
        seen.append(path.read_text(encoding="utf-8"))
        write_file(path, b"next", not_over=tmp_path)
        assert names(path.parent) == {"out"}
    assert set(seen) == {"old", "new"}


def test_a_result_takes_only_its_own_files_with_it(tmp_path: Path) -> None:
    """Those that it names, and none outside of its folder."""
    path = tmp_path / "out"
    write(tmp_path, {"mine.csv": "mine"})
    names_some = '{"files": ["psychometric.png", "../mine.csv", "gone.csv", ""]}'
    score(path, {"compare.csv": "mine", "psychometric.png": "old", "result.json": names_some})
    score(path, {"result.json": "{}"})
    assert contents(path) == {"compare.csv": "mine", "result.json": "{}"}
    assert (tmp_path / "mine.csv").read_text() == "mine"
    stranger = tmp_path / "stranger"
    theirs = {"notes.txt": "mine", "data.csv": "mine", "empty.csv": "mine"}
    sums = [
        '["notes.txt", "data.csv"]',
        f'{{"notes.txt": "", "data.csv": "{hashlib.sha256(b"its").hexdigest()}"}}',
    ]
    for listed in sums:
        write(stranger, theirs | {"result.json": f'{{"files": {listed}}}'})
        score(stranger, {"result.json": "{}"})
        assert contents(stranger) == theirs | {"result.json": "{}"}
    other = tmp_path / "other"
    write(tmp_path, {"other/psychometric.png": "mine", "other/result.json": "mine"})
    score(other, {"result.json": "{}"})
    assert contents(other) == {"psychometric.png": "mine", "result.json": "{}"}


def test_a_result_that_cannot_be_replaced_says_what_is_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, where a file that is open elsewhere cannot be."""
    path = tmp_path / "out"
    old = '{"files": ["report.html", "tod_curve.png"]}'
    score(path, {"report.html": "old", "result.json": old, "tod_curve.png": "old"})

    def replace(source: str, target: Path) -> None:
        if target.name == "result.json":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        os_replace(source, target)

    os_replace = os.replace
    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(
        OutputError,
        match=r"result.json: cannot be replaced \(Permission denied\), but report.html and scores.csv are new",
    ):
        score(path, {"report.html": "new", "result.json": "{}", "scores.csv": "new"})
    found = contents(path)
    assert found is not None and {*json.loads(found.pop("result.json"))["files"]} == {
        "report.html",
        "tod_curve.png",
    }
    assert found == {"report.html": "new", "scores.csv": "new"}


def test_a_cluster_that_is_gone_is_no_place_that_cannot_be_written(tmp_path: Path) -> None:
    """Both are errors of the operating system."""
    with pytest.raises(ClusterError, match=r"^the scheduler is gone$"), output_folder(str(tmp_path / "out")):
        raise ClusterError("the scheduler is gone")


def test_no_device_is_replaced_by_a_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder or device"):
        write_file(Path(os.devnull), b"new", not_over=tmp_path)
    assert not Path(os.devnull).is_file()


def test_a_staging_folder_of_somebody_else(tmp_path: Path) -> None:
    path = tmp_path / "out"
    write(tmp_path, {"out/notes.txt": "mine"})
    path.rename(tmp_path / STAGING)
    path.mkdir()
    (tmp_path / STAGING).rename(path / STAGING)
    before = tree(tmp_path)
    for act in (lambda: score(path, {"a": "new"}), lambda: simulate(path, NEW)):
        with pytest.raises(OutputError, match="was not made by todframes"):
            act()
    assert tree(tmp_path) == before


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    folder.chmod(0o555)
    try:
        yield
    finally:
        folder.chmod(0o755)


def as_somebody(act: Callable[[], None]) -> str:
    """Act in a child process whose user is not root; what went wrong, or nothing."""
    reading, writing = os.pipe()
    if not (child := os.fork()):
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(65534)
                os.setuid(65534)
            act()
        except BaseException as error:
            os.write(writing, str(error).encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, encoding="utf-8") as message:
        said = message.read()
    os.waitpid(child, 0)
    return said


@forks
@forks_with_threads
def test_a_writable_folder_in_a_parent_that_is_not() -> None:
    """Results and new datasets are written."""
    with tempfile.TemporaryDirectory() as name:
        parent = Path(name).resolve()
        parent.chmod(0o755)
        for folder in ("results", "dataset"):
            (parent / folder).mkdir()
            (parent / folder).chmod(0o777)
        with read_only(parent):
            assert as_somebody(lambda: score(parent / "results", {"result.json": "{}"})) == ""
            assert as_somebody(lambda: simulate(parent / "dataset", OLD)) == ""
        assert contents(parent / "results") == {"result.json": "{}"}
        assert contents(parent / "dataset") == OLD
        assert staging_folders(parent) == []


@forks
@forks_with_threads
def test_a_place_that_cannot_be_written_is_found_before_the_work() -> None:
    with tempfile.TemporaryDirectory() as name:
        parent = Path(name).resolve()
        (parent / "out").mkdir()
        parent.chmod(0o755)

        def begin(path: Path, place: Callable[..., Any]) -> None:
            with place(str(path)):
                raise AssertionError("the work has begun")

        for path in (parent / "out", parent / "new"):
            with read_only(parent), read_only(parent / "out"):
                for place in (output_folder, new_folder):
                    said = as_somebody(lambda: begin(path, place))  # noqa: B023 - called at once
                    assert said == f"{path}: cannot be written (Permission denied)"
        assert contents(parent) == {}


@pytest.mark.parametrize("second", ["results", "dataset"])
@pytest.mark.parametrize("first", ["results", "dataset"])
def test_the_second_run_into_a_folder_is_refused_at_once(tmp_path: Path, first: str, second: str) -> None:
    path = tmp_path / "out"

    def begin(kind: str) -> Any:
        return output_folder(str(path)) if kind == "results" else new_folder(str(path))

    with begin(first) as folder:
        with pytest.raises(OutputError, match="another run is writing there"), begin(second):
            raise AssertionError("the second run has begun")
        write(folder, NEW)
    assert contents(path) == NEW
    assert staging_folders(tmp_path) == []


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal")
def test_a_signal_that_is_ignored_stays_so() -> None:
    """As nohup asks for."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.raised():
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("package", ["todframes", "sensor_sim"])
@pytest.mark.parametrize("module", ["todframes.base.signals", "click", "todframes.cli.console", "{package}.cli"])
def test_ctrl_c_during_the_first_imports(package: str, module: str) -> None:
    """One line and no traceback, from the first module on that a command imports."""
    module = module.format(package=package)
    interrupting = f"""
import runpy, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
sys.argv = [{package!r}, "--version"]
runpy.run_module({package!r}, run_name="__main__")
"""
    done = subprocess.run(
        [sys.executable, "-c", interrupting], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout) == (INTERRUPTED, "")
    assert done.stderr == "error: interrupted, nothing was written\n"
