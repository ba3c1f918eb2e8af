"""Writing of results: result folders, datasets, single files. Files that others wrote are never changed.

A run stages its files in a hidden folder inside the place that it writes to. A dataset that replaces another one,
and a single file, are staged beside it. The staging folder is made before the work, so a place that cannot be
written is found at once. A run holds a lock in it: a second run into the same place is refused, and what a killed
run has left is known by a lock that nobody holds.

A run that can go on later keeps its finished results in the staging folder, in `STORE`. When it fails or is killed
they stay there, and the next run into the same place finds them; when it ends well they are removed.

At the end, with signals held back, the files are renamed into place:

- Files of a result folder replace those of the same names one by one, `result.json` last.
- A dataset that is new gets its files under their names, `dataset.toml` last; without that it is no dataset. So
  does a chart, `chart.toml` last.
- A dataset that replaces another one is swapped with it in one step. The older one is looked at before it is
  removed; if anything has come into it meanwhile, the two are swapped back.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import msgspec

from todframes import __version__, signals
from todframes.errors import OutputError, TodframesError, argument
from todframes.signals import held_back

if sys.platform != "win32":
    import fcntl


STAGING, LOCK, STAGED, ASIDE, STORE = ".todframes-staging", "lock", "new", "old", "store"


MARK = ".todframes.json"
"""Name of the file in a dataset that lists the files this package wrote, with their SHA-256."""


LAST_OF_DATASET, LAST_OF_RESULT = "dataset.toml", "result.json"


FILES_OF_COMMAND = {
    "score": {"report.html", "scores.csv", "scores.parquet", "psychometric.png", "tod_curve.png"},
    "curve": {"report.html", "psychometric.png", "tod_curve.png"},
    "compare": {"report.html", "scores.csv", "scores.parquet", "compare.csv", "compare.png"},
    "calibrate": {
        *("report.html", "internal_noise.csv", "calibration.csv"),
        *("calibration.png", "calibration.svg", "observer.toml"),
    },
    "sweep": {
        *("report.html", "sweep.csv", "sweep.parquet"),
        *("front.png", "map.png", "by_key.png", "tod_curves.png"),
    },
}
"""Files that each command writes beside `result.json`."""


Inventory = dict[str, tuple[int, ...]]


FOLDER: tuple[int, ...] = ()


OTHER: tuple[int, ...] = (-1,)


# Flags of renameat2 (Linux) and renamex_np (macOS).
NO_REPLACE, EXCHANGE = (4, 2) if sys.platform == "darwin" else (1, 2)


AT_FDCWD = -100


class _Mark(msgspec.Struct):
    version: str
    files: dict[str, str]


class _Result(msgspec.Struct):
    command: str


@dataclass(frozen=True, slots=True)
class Going:
    """Treatment of the finished results of a run: those of an earlier one are used unless it is to `restart`, and
    they are removed when the run has ended well unless it is to `keep` them."""

    restart: bool = False
    keep: bool = False


@contextmanager
def output_folder(name: str, going: Going | None = None) -> Iterator[Path]:
    """Yield a staging folder. If the block ends without an exception, all its files move into the folder named.

    Parameters
    ----------
    going : Going, optional
        For a run that can go on later: its finished results, in `store_folder`, stay if it fails.

    Raises
    ------
    OutputError
        If the place cannot be written, or another run is writing there.
    """
    with _as_output_error(name):
        path = _place(name)
        with _made(path), _staging(path / STAGING, name, going, {STORE}):
            staged = path / STAGING / STAGED
            staged.mkdir()
            yield staged
            with held_back():
                _join(staged, path)
                signals.written.append(name)


@contextmanager
def new_folder(
    name: str, *, overwrite: bool, last: str = LAST_OF_DATASET, going: Going | None = None
) -> Iterator[Path]:
    """Yield a staging folder. If the block ends without an exception, it becomes the dataset named.

    Parameters
    ----------
    overwrite : bool
        Whether it may replace a dataset. A dataset is only replaced if it has the mark of this package and holds
        nothing but the files listed there, unchanged.
    last : str
        The file without which the folder is no dataset, or no chart; it is the last to get its name.
    going : Going, optional
        For a run that can go on later: its finished results, in `store_folder`, and the files in the staging
        folder stay if it fails. The next run finds both.

    Raises
    ------
    OutputError
        If the place cannot be written or holds something that is not to be replaced, or another run is writing
        there.
    """
    with _as_output_error(name), ExitStack() as stack:
        path = _place(name)
        stack.enter_context(_made(path))
        kept = {STORE, STAGED}
        killed = stack.enter_context(_staging(path / STAGING, name, going, kept))
        beside = _beside(path)
        if killed:
            _remove_unfinished(path, last)
        before = _inventory(path)
        if beside.is_dir() and not before:
            with _staging(beside, name):
                pass  # removes the files of a killed run
        if before:
            _check_replaceable(name, path, before, overwrite)
            stack.enter_context(_staging(beside, name, going, kept))
            _check_exchange(name, path, beside)
        staged = (beside if before else path / STAGING) / STAGED
        staged.mkdir(exist_ok=going is not None)
        try:
            yield staged
        except OutputError as error:  # name the frame as it would have been
            raise OutputError(str(error).replace(str(staged), name)) from None
        _write_mark(staged)
        with held_back():
            if before:
                _exchange(name, staged, path, before)
            else:
                _fill(name, staged, path, last)
            signals.written.append(name)


def store_folder(staged: Path) -> Path:
    """Return the folder for the finished results of the run that has this staging folder."""
    return staged.parent / STORE


def remove_others(folder: Path, names: Set[str]) -> None:
    """Remove all but some files from a staging folder: what an earlier run with other settings has left."""
    for entry in list(os.scandir(folder)):
        if entry.name not in names:
            _remove_entry(entry)


def write_file(path: Path, content: bytes, *, not_over: Path | None = None, is_private: bool = False) -> None:
    """Write a whole file or nothing. An older file of that name is replaced; its permissions are kept.

    Only its owner can read a new file that `is_private`.

    Raises
    ------
    OutputError
        If the place cannot be written, is that of `not_over`, or another run is writing there.
    """
    with _as_output_error(str(path)):
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a folder or device, expected the name of a file")
        if not_over is not None and path.exists() and path.samefile(not_over):
            raise OutputError(f"{path}: is the result itself, expected another name")
        beside = _beside(path)
        with _staging(beside, str(path)):
            write_files(beside, {STAGED: content})
            if path.exists():
                shutil.copymode(path, beside / STAGED)
            elif is_private:
                (beside / STAGED).chmod(0o600)
            with held_back():
                (beside / STAGED).replace(path)
                signals.written.append(str(path))


def write_folder(folder: Path | str, files: Mapping[str, bytes | Iterable[bytes]]) -> None:
    """Write files into a result folder, all of them or none; see `output_folder` and `write_files`.

    Raises
    ------
    OutputError
        If the place cannot be written, or another run is writing there.
    """
    with output_folder(str(folder)) as staged:
        write_files(staged, files)


def write_files(folder: Path, files: Mapping[str, bytes | Iterable[bytes]]) -> None:
    """Write files, whole or part by part, into a folder; each is flushed to disk before the next is written."""
    for name, content in files.items():
        with (folder / name).open("wb") as file:
            for part in [content] if isinstance(content, bytes) else content:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def _as_output_error(name: str) -> Iterator[None]:
    try:
        yield
    except TodframesError:  # some are errors of the system, too
        raise
    except OSError as error:
        raise OutputError(f"{name}: cannot be written ({error.strerror or error})") from None


def _place(name: str) -> Path:
    """Return the path of the folder named, with links resolved. Raises OutputError if it cannot be a folder."""
    if not name or "\0" in name:
        raise OutputError(f"found {name!r} as the folder for results, expected a name")
    if "://" in name:  # it may hold a secret
        raise OutputError("found a URL as the folder for results, expected a local folder")
    path = Path(name)
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, expected a folder or a new name")
    if path.is_symlink() and not path.exists():
        raise OutputError(f"{path}: is a link to {path.readlink()}, which does not exist")
    parent = path.absolute().parent
    if not parent.is_dir():
        raise OutputError(f"{path}: {parent} is not a folder")
    return Path(os.path.realpath(path))


@contextmanager
def _made(path: Path) -> Iterator[None]:
    """Make a folder if it does not exist, and remove it again if the block fails and the folder is empty."""
    made = False
    try:
        with held_back(), suppress(FileExistsError):
            path.mkdir()
            made = True
        yield
    except BaseException:
        if made:
            with suppress(OSError):
                path.rmdir()
        raise


# The staging folder -------------------------------------------------------------------------------------------


@contextmanager
def _staging(folder: Path, name: str, going: Going | None = None, kept: Set[str] = frozenset()) -> Iterator[bool]:
    """Make a staging folder for this run alone, empty except for the lock, and remove it at the end.

    If the run can go on later, what is `kept` may be there at the start, and stays if the run fails and has a
    store. Yields whether an earlier run had left the folder.
    """
    lock: int | None = None
    ours = False
    stays: Set[str] = frozenset()
    try:
        with held_back():
            lock, killed = _lock(folder, name)
            ours = True
            # Another command into the same place leaves the store alone.
            stays = frozenset() if going is not None and going.restart else kept if going is not None else {STORE}
            _clear(folder, stays)
        yield killed
        stays = {STORE} if going is None or going.keep else frozenset()
    except BaseException:
        stays = (kept if going is not None else {STORE}) if (folder / STORE).is_dir() else frozenset()
        raise
    finally:
        if ours:
            with held_back():
                _release(folder, lock, stays)


def _lock(folder: Path, name: str) -> tuple[int | None, bool]:
    """Make and lock a staging folder.

    Returns
    -------
    (int or None, bool)
        The open lock file, or None if the file system has no locks: then the folder is the lock; and whether a
        killed run had left the folder.
    """
    while True:
        try:
            folder.mkdir(mode=0o700)
            made = True
        except FileExistsError:
            made = False
        try:
            is_link = folder.is_symlink()
            names = set() if is_link else _names(folder)
            if is_link or (names and LOCK not in names):
                raise OutputError(f"{folder}: was not made by todframes; move it away, or take another name")
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
        except FileNotFoundError:
            continue  # its run has just ended
        try:
            if sys.platform == "win32":
                raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise OutputError(f"{name}: another run is writing there; wait for it, or take another name") from None
        except OSError:
            os.close(lock)
            if made:
                return None, False
            raise OutputError(
                f"{folder}: belongs to another run, or to one that was killed; remove it if none is under way"
            ) from None
        if _is_locked_by(lock, folder):
            return lock, LOCK in names
        os.close(lock)


def _is_locked_by(lock: int, folder: Path) -> bool:
    """Return whether the lock is still the folder's; its last owner may have removed or moved the folder."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(lock), os.lstat(folder / LOCK))
    return False


def _release(folder: Path, lock: int | None, stays: Set[str]) -> None:
    """Remove a staging folder, the lock last; if something stays, the lock file stays too, unlocked."""
    ours = lock is None or _is_locked_by(lock, folder)
    with suppress(OSError):  # the next run removes it
        if ours:
            _clear(folder, stays)
            ours = not stays & _names(folder)
            if ours:
                (folder / LOCK).unlink()
    if lock is not None:
        os.close(lock)
    with suppress(OSError):
        if ours:
            folder.rmdir()  # on NFS an open file that was removed stays until it is closed


def _clear(folder: Path, stays: Set[str]) -> None:
    """Remove the files that a run staged or swapped out; from a dataset with a mark only the files in the mark.

    What is named in `stays` stays, but never a dataset with a mark.

    Raises
    ------
    OutputError
        If a dataset that was swapped out holds other files; only a kill in the middle of the swap leaves that.
    """
    staged = folder / STAGED
    if (staged / MARK).exists():
        found = _inventory(staged)
        if foreign := _foreign(staged, found):
            raise OutputError(f"{staged}: holds {foreign[0]}, which todframes did not write; move it to safety")
        _remove_folder(staged, found)
    for entry in list(os.scandir(folder)):
        if entry.name not in {LOCK, *stays}:
            _remove_entry(entry)


def _remove_entry(entry: os.DirEntry[str]) -> None:
    if entry.is_dir(follow_symlinks=False):
        shutil.rmtree(entry)
    else:
        os.unlink(entry)  # noqa: PTH108 - an entry is no Path


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _beside(path: Path) -> Path:
    """Return the path of the staging folder beside a file or folder; its length does not depend on the name."""
    return path.parent / f"{STAGING}-{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]}"


# Result folders -----------------------------------------------------------------------------------------------


def _join(staged: Path, path: Path) -> None:
    """Move staged files into a result folder, over older ones; if one cannot be moved, put the older ones back."""
    made = _names(staged)
    for name in made:
        if (path / name).is_dir():
            raise OutputError(f"{path / name}: is a folder, expected a file or none")
    stale = _files_of_result(path) - made if LAST_OF_RESULT in made else set()
    aside = staged.with_name(ASIDE)
    aside.mkdir()
    moved = []
    try:
        for name in sorted(made | stale, key=lambda name: (name == LAST_OF_RESULT, name)):
            with suppress(OSError):  # there is none, or the file system has no links
                (aside / name).hardlink_to(path / name)
            if name in made:
                (staged / name).replace(path / name)
            else:
                (path / name).unlink(missing_ok=True)
            moved.append(name)
    except OSError:
        for name in moved:
            if (aside / name).exists():
                (aside / name).replace(path / name)
            else:
                (path / name).unlink(missing_ok=True)
        raise


def _files_of_result(path: Path) -> set[str]:
    """Return the files of the result in a folder; beside another result they would be taken for that one's."""
    with suppress(OSError, msgspec.MsgspecError):
        if (path / LAST_OF_RESULT).is_file():
            result = msgspec.json.decode((path / LAST_OF_RESULT).read_bytes(), type=_Result)
            return {name for name in FILES_OF_COMMAND.get(result.command, ()) if (path / name).is_file()}
    return set()


# Datasets -----------------------------------------------------------------------------------------------------


def _inventory(folder: Path) -> Inventory:
    """List all files and folders below a folder except its staging folder, parents before their content.

    Returns
    -------
    dict of str to tuple of int
        By relative path: (size, time in ns, inode) for files, FOLDER for folders, OTHER for the rest, also links.
    """

    def fail(error: OSError) -> None:
        raise error

    found: Inventory = {}
    for parent, folders, files in os.walk(folder, onerror=fail):
        if Path(parent) == folder and STAGING in folders:
            folders.remove(STAGING)
        for path in (Path(parent, name) for name in [*folders, *files]):
            status = path.lstat()
            if stat.S_ISREG(status.st_mode):
                kind: tuple[int, ...] = (status.st_size, status.st_mtime_ns, status.st_ino)
            else:
                kind = FOLDER if stat.S_ISDIR(status.st_mode) else OTHER
            found[path.relative_to(folder).as_posix()] = kind
    return found


def _foreign(folder: Path, found: Inventory) -> list[str]:
    """List names in a folder that are not in its mark or were changed since; all names if it has no mark."""
    try:
        if len(found.get(MARK, OTHER)) < 3:
            return list(found)
        mark = msgspec.json.decode((folder / MARK).read_bytes(), type=_Mark)
    except msgspec.MsgspecError:
        return list(found)
    parents = {str(parent) for name in mark.files for parent in PurePosixPath(name).parents}

    def is_ours(name: str) -> bool:
        if found[name] == FOLDER:
            return name in parents
        return found[name] != OTHER and name in mark.files and _sha256(folder / name) == mark.files[name]

    return [name for name in found if name != MARK and not is_ours(name)]


def _write_mark(folder: Path) -> None:
    names = sorted(name for name, kind in _inventory(folder).items() if kind != FOLDER)
    files = {name: _sha256(folder / name) for name in names}  # in an order that is that of no file system
    mark = msgspec.json.encode(_Mark(__version__, files))
    write_files(folder, {MARK: msgspec.json.format(mark, indent=1) + b"\n"})


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _remove(folder: Path, found: Inventory) -> None:
    """Remove the listed files of a dataset's folder; the mark last, and only if no other file has appeared."""
    for name in reversed(found):
        if name != MARK:
            (folder / name).rmdir() if found[name] == FOLDER else (folder / name).unlink()
    if _names(folder) <= {MARK, STAGING}:
        (folder / MARK).unlink()


def _remove_folder(folder: Path, found: Inventory) -> None:
    _remove(folder, found)
    shutil.rmtree(folder / STAGING, ignore_errors=True)
    folder.rmdir()


def _remove_unfinished(path: Path, last: str) -> None:
    """Remove files that a killed run had moved into a new folder."""
    found = _inventory(path)
    if MARK in found and last not in found and not _foreign(path, found):
        _remove(path, found)


def _check_replaceable(name: str, path: Path, found: Inventory, overwrite: bool) -> None:
    """Raise OutputError unless a folder that is not empty is a dataset that may and can be replaced."""
    if not overwrite:
        raise OutputError(
            f"{name}: is not empty; expected a new name, or {argument.overwrite}, which replaces only what "
            "todframes wrote"
        )
    if MARK not in found:
        raise OutputError(
            f"{name}: has no {MARK}, so todframes cannot tell what it wrote there and replaces nothing; expected "
            "a new name, or remove the folder yourself"
        )
    if foreign := _foreign(path, found):
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise OutputError(
            f"{name}: holds {foreign[0]}{more}, not written by todframes or changed since; expected a new name, "
            "or move that away"
        )


def _check_exchange(name: str, path: Path, beside: Path) -> None:
    """Raise OutputError unless a folder can be swapped in one step with one that is staged beside it."""
    why: str | None = None
    try:
        if Path.cwd().is_relative_to(path):
            why = "it is the present folder, or holds it"
        # The staging folder inside is locked by this run, so this removes nothing: it only finds out whether the
        # system would, which it would not where the folder is a mount point or its parent is not ours to change.
        path.rmdir()
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            why = error.strerror
    try:
        for probe in ("a", "b"):
            (beside / probe).mkdir()
        _rename(beside / "a", beside / "b", EXCHANGE)
    except OSError as error:
        why = error.strerror
    if why is not None:
        raise OutputError(f"{name}: cannot be replaced in one step ({why}); expected a new name")


def _exchange(name: str, staged: Path, path: Path, before: Inventory) -> None:
    """Swap a staged dataset with the existing one, and remove the existing one if it has not changed."""
    shutil.copymode(path, staged)
    if hasattr(os, "sync"):
        os.sync()  # or the power may fail when the older one is gone and the new one is not yet on disk
    _rename(staged, path, EXCHANGE)
    now: Inventory = {}
    with suppress(OSError):
        now = _inventory(staged)
    if now != before:
        _rename(staged, path, EXCHANGE)
        changed = [file for file in now.keys() | before.keys() if now.get(file) != before.get(file)]
        raise OutputError(
            f"{name}: {min(changed)} was put there or changed meanwhile; nothing was replaced, expected a new name"
        )
    with suppress(OSError):  # the next run removes it
        _remove_folder(staged, before)


def _fill(name: str, staged: Path, path: Path, last: str) -> None:
    """Move a staged dataset into a folder that has none; no file is replaced."""
    moved: list[str] = []
    try:
        for part in sorted(_names(staged), key=lambda part: (part != MARK, part == last)):
            try:
                _rename_to_free_name(staged / part, path / part)
            except FileExistsError:
                raise OutputError(f"{name}: {part} was put there meanwhile; expected a new name") from None
            moved.append(part)
    except OSError:
        for part in reversed(moved):
            (path / part).rename(staged / part)
        raise


def _rename_to_free_name(source: Path, target: Path) -> None:
    try:
        _rename(source, target, NO_REPLACE)
    except FileExistsError:
        raise
    except OSError:  # not on this file system
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        source.rename(target)


def _rename(source: Path, target: Path, flag: int) -> None:
    """Rename atomically without replacing a file, or swap two names; Python's `os` can do neither.

    Raises
    ------
    OSError
        If the system or file system does not support it, or the rename fails.
    """
    try:
        library = ctypes.CDLL(None, use_errno=True)
        names = os.fsencode(source), os.fsencode(target)
        if sys.platform == "darwin":
            status = library.renamex_np(*names, flag)
        else:
            status = library.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], flag)
    except (AttributeError, TypeError):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None
    if status:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
