"""Writing of results: result folders, datasets, single files. Files that others wrote are never changed.

A run stages its files in a hidden folder inside the place that it writes to, made before the work. It holds a lock
there, where the file system has locks: a second run is refused. A run that can go on later keeps its finished
results there, in `STORE`, when it fails or is killed. A single file is written beside its place.

At the end the files are renamed into place. Those of a result folder replace those of the same names one by one,
`result.json` last. A dataset or a chart needs a new or empty folder; without its last file, `dataset.toml` or
`chart.toml`, it is none.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Collection, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import msgspec

from todframes.base import signals
from todframes.base.errors import OutputError, TodframesError

if sys.platform != "win32":
    import fcntl

STAGING = ".todframes-staging"
LOCK, STAGED, STORE = "lock", "new", "store"
"""Names in a hidden folder: the lock, the staged files, and finished results."""

LAST_OF_DATASET, LAST_OF_RESULT = "dataset.toml", "result.json"

LARGEST_RESULT_MB = 64

WRITTEN = {".csv", ".html", ".png", ".svg", ".toml", ".txt", ".xml"}
"""Ends of the names of files beside a result."""


class _Result(msgspec.Struct):
    files: dict[str, str] = {}


@dataclass(frozen=True, slots=True)
class StorePolicy:
    """Treatment of the finished results of a run. Those of an earlier run are used unless `restart` is set, and
    they are removed when the run has ended well unless `keep` is set."""

    restart: bool = False
    keep: bool = False


@contextmanager
def output_folder(name: str, policy: StorePolicy | None = None) -> Iterator[Path]:
    """Yield a staging folder. If the block ends well, all its files move into the folder named. With `policy`, the
    results in `store_path` stay if it fails. OutputError if the place cannot be written, or another run is writing
    there.
    """
    with _as_output_error(name), _place(name) as out, _hidden(out / STAGING, name, policy, {STORE}) as hidden:
        staged = hidden / STAGED
        staged.mkdir()
        yield staged
        _join(name, staged, out)
        signals.written.append(name)


@contextmanager
def new_folder(name: str, *, last: str = LAST_OF_DATASET, policy: StorePolicy | None = None) -> Iterator[Path]:
    """Yield a staging folder. If the block ends well, its content moves into the folder named, which has to be new
    or empty; the file `last` moves last. With `policy`, the results in `store_path` and the staged files stay if
    it fails. Raises OutputError as `output_folder` does.
    """
    kept = {STORE, STAGED}
    with _as_output_error(name), _place(name) as out, _hidden(out / STAGING, name, policy, kept) as hidden:
        staged = hidden / STAGED
        if there := sorted(_names(out) - {STAGING}):
            if (staged / last).exists():  # a run was killed as it moved them
                _fill(staged, out, last)
            raise OutputError(f"{name}: is not empty, found {there[0]}; expected a new name or an empty folder")
        staged.mkdir(exist_ok=policy is not None)
        try:
            yield staged
        except OutputError as error:  # names frames as they would have been named
            raise OutputError(str(error).replace(str(staged), name)) from None
        _fill(staged, out, last)
        signals.written.append(name)


def store_path(staged: Path) -> Path:
    """Return the path of the store of finished results of the run that has this staging folder."""
    return staged.parent / STORE


def remove_others(folder: Path, names: Collection[str]) -> None:
    """Remove the files of an earlier run with other settings from a staging folder, and folders that are left
    empty. Paths in `names`, relative to the folder, stay.
    """
    for parent, _, files in os.walk(folder, topdown=False):
        for path in (Path(parent, file) for file in files):
            if path.relative_to(folder).as_posix() not in names:
                path.unlink()
        if Path(parent) != folder and not _names(Path(parent)):
            Path(parent).rmdir()


def write_file(path: Path, content: bytes, *, not_over: Path | None = None, is_private: bool = False) -> None:
    """Write a whole file or nothing. An older file of that name is replaced; its permissions are kept. Only its
    owner can read a new one that `is_private`. OutputError if it cannot be written, or is that of `not_over`.
    """
    name = str(path)
    with _as_output_error(name):
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a folder or device, expected the name of a file")
        if not_over is not None and path.exists() and path.samefile(not_over):
            raise OutputError(f"{path}: is the result itself, expected another name")
        path = path.resolve()
        # The same name for each attempt, so that the next run replaces what a killed one has left.
        new = path.with_name(f"{STAGING}-{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]}")
        try:
            write_files(path.parent, {new.name: content})
            if path.exists():
                shutil.copymode(path, new)
            elif is_private:
                new.chmod(0o600)
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)
        signals.written.append(name)


def write_folder(folder: Path | str, files: Mapping[str, bytes]) -> None:
    """Write files into a result folder, all of them or none; see `output_folder` and `write_files`."""
    with output_folder(str(folder)) as staged:
        write_files(staged, files)


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder; each is flushed to disk before the next is written."""
    for name, content in files.items():
        with (folder / name).open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())


def locked(file: int) -> bool:
    """Lock an open file until it is closed. Returns whether the file system has locks; raises BlockingIOError if
    another process has locked it.
    """
    try:
        if sys.platform == "win32":
            return False
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return False
    return True


# The place ----------------------------------------------------------------------------------------------------


@contextmanager
def _as_output_error(name: str) -> Iterator[None]:
    try:
        yield
    except TodframesError:  # some are errors of the system, too
        raise
    except OSError as error:
        raise OutputError(f"{name}: cannot be written ({error.strerror or error})") from None


@contextmanager
def _place(name: str) -> Iterator[Path]:
    """Yield the folder named; make it if there is none, and remove it again if the block fails and it is empty."""
    if not name or "\0" in name:
        raise OutputError(f"found {name!r} as the folder for results, expected a name")
    if "://" in name:  # it may hold a secret
        raise OutputError("found a URL as the folder for results, expected a local folder")
    path = Path(name).absolute()
    if path.exists() and not path.is_dir():
        raise OutputError(f"{name}: is a file, expected a folder or a new name")
    if not path.parent.is_dir():
        raise OutputError(f"{name}: {path.parent} is not a folder")
    is_new = not path.exists()
    path.mkdir(exist_ok=True)
    try:
        yield path
    except BaseException:
        if is_new:
            with suppress(OSError):
                path.rmdir()
        raise


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# The hidden folder --------------------------------------------------------------------------------------------


@contextmanager
def _hidden(
    hidden: Path, name: str, policy: StorePolicy | None = None, kept: Set[str] = frozenset()
) -> Iterator[Path]:
    """Make a hidden folder for this run alone, empty except for the lock, and remove it at the end. If the run can
    go on later, what is `kept` may be there at the start, and stays if the run fails and has a store. Another
    command into the same place leaves the store alone.
    """
    lock = _lock(hidden, name)
    stays: Set[str] = frozenset()
    try:
        _clear(hidden, {STORE} if policy is None else frozenset() if policy.restart else kept)
        yield hidden
        stays = {STORE} if policy is None or policy.keep else frozenset()
    except BaseException:
        if (hidden / STORE).exists():
            stays = {STORE} if policy is None else kept
        raise
    finally:
        with suppress(OSError):  # the next run removes what is left
            _clear(hidden, stays)
            if not stays & _names(hidden):
                if sys.platform == "win32":
                    lock.close()  # Windows removes no open file
                (hidden / LOCK).unlink()
                hidden.rmdir()
        lock.close()


def _lock(hidden: Path, name: str) -> BinaryIO:
    """Make a hidden folder, and lock it if the file system has locks. Returns the open lock file."""
    hidden.mkdir(mode=0o700, exist_ok=True)
    if _names(hidden) - {LOCK, STAGED, STORE}:
        raise OutputError(f"{hidden}: was not made by todframes; move it away, or take another name")
    lock = (hidden / LOCK).open("ab")
    try:
        locked(lock.fileno())
    except BlockingIOError:
        lock.close()
        raise OutputError(f"{name}: another run is writing there; wait for it, or take another name") from None
    return lock


def _clear(hidden: Path, stays: Set[str]) -> None:
    """Remove the files of a run from its hidden folder, except the lock and what stays."""
    for path in [path for path in hidden.iterdir() if path.name not in {LOCK, *stays}]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


# Into place ---------------------------------------------------------------------------------------------------


def _join(name: str, staged: Path, out: Path) -> None:
    """Move staged files into a result folder, over older ones, one by one."""
    made = _names(staged)
    for part in made:
        if (out / part).is_dir():
            raise OutputError(f"{Path(name) / part}: is a folder, expected a file or none")
    stale: set[str] = set()
    if LAST_OF_RESULT in made:
        stale = _files_of_result(out) - made
        _state_checksums(staged)
    new: list[str] = []
    for part in sorted(made | stale, key=lambda part: (part in (LAST_OF_RESULT, LAST_OF_DATASET), part)):
        try:
            if part in stale:
                (out / part).unlink(missing_ok=True)
            else:
                (staged / part).replace(out / part)
                new.append(part)
        except OSError as error:
            but = f", but {' and '.join(new)} {'is' if len(new) == 1 else 'are'} new" if new else ""
            raise OutputError(f"{Path(name) / part}: cannot be replaced ({error.strerror}){but}") from None


def _state_checksums(staged: Path) -> None:
    """Give each name of the `files` of a staged result the checksum of its file."""
    content = msgspec.json.decode((staged / LAST_OF_RESULT).read_bytes(), type=dict[str, msgspec.Raw])
    if "files" in content:
        listed = msgspec.json.decode(content["files"], type=list[str])
        sums = {part: _sha256(staged / part) for part in listed if part in _names(staged)}
        content["files"] = msgspec.Raw(msgspec.json.encode(sums))
        text = msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
        write_files(staged, {LAST_OF_RESULT: text})


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _files_of_result(path: Path) -> set[str]:
    """Return the files that a result names as its own, and that are as it was written with. Beside another, they
    would seem to belong to that one.
    """
    with suppress(OSError, msgspec.MsgspecError):
        file = path / LAST_OF_RESULT
        if file.is_file() and file.stat().st_size <= LARGEST_RESULT_MB * 2**20:
            listed = msgspec.json.decode(file.read_bytes(), type=_Result).files
            return {
                part
                for part in listed.keys() & _names(path)
                if Path(part).suffix in WRITTEN
                and (path / part).is_file()
                and _sha256(path / part) == listed[part]
            }
    return set()


def _fill(staged: Path, out: Path, last: str) -> None:
    """Move staged files and folders into a folder that has none of them, `last` at the end."""
    for part in sorted(_names(staged), key=lambda part: (part == last, part)):
        (staged / part).rename(out / part)
