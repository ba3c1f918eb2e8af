"""Writing of results: result folders, datasets, single files. Files that others wrote are never changed.

A run stages its files in a hidden folder inside the place that it writes to; a single file is staged beside it.
The hidden folder is made before the work, so a place that cannot be written is found at once. A run holds a lock
in it: a second run into the same place is refused, and what a killed run has left is known by a lock that nobody
holds.

A run that can go on later keeps its finished results in the hidden folder, in `STORE`. When it fails or is killed
they stay there, and the next run into the same place finds them; when it ends well they are removed.

At the end, with signals held back, the files are renamed into place:

- Files of a result folder replace those of the same names one by one, `result.json` last.
- A dataset or a chart needs a new or empty folder. Its files get their names there, `dataset.toml` or `chart.toml`
  last; without that it is none.

Whoever can write to the place may have planted links in it. No link below the place is followed: place and hidden
folder are opened once, and all files are named by these open folders (`_held`), whatever happens to their names.
The hidden folder belongs to this user alone, or it is refused, and so is one that holds names not given here.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Set
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from todframes.base import signals
from todframes.base.errors import OutputError, TodframesError
from todframes.base.signals import held_back

if sys.platform != "win32":
    import fcntl

STAGING = ".todframes-staging"
LOCK, STAGED, STORE, MOVING = "lock", "new", "store", "moving"
"""Names in a hidden folder: the lock, the staged files, finished results, and the list of what `_fill` moves."""

LAST_OF_DATASET, LAST_OF_RESULT = "dataset.toml", "result.json"

LARGEST_RESULT_MB = 64

FILES_OF_COMMAND = {
    "score": {
        *("report.html", "scores.csv", "scores.parquet"),
        *("psychometric.png", "tod_curve.png", "field_map.png"),
    },
    "compare": {"report.html", "scores.csv", "scores.parquet", "compare.csv", "compare.png"}
    | {"contrast_response.csv", "contrast_response.png"},
    "calibrate": {
        *("report.html", "internal_noise.csv", "calibration.csv"),
        *("calibration.png", "calibration.svg", "observer.toml"),
    },
    "noise": {
        *("noise.csv", "noise.png", "snr.csv", "patches.csv", "sensor_noise.toml"),
        *("emva.csv", "emva.png", "emva.xml", "photon_transfer.csv", "variances.csv"),
    },
    "range": {
        *("report.html", "ranges.csv", "probability.csv", "range_against_k.csv"),
        *("probability.png", "crossing.png", "range_against_k.png"),
    },
}
"""Files that each command of this package writes beside `result.json`."""

ENTRY_POINT_GROUP = "todframes.result_files"
"""Entry points of other packages: sets of the files that their commands write, by the name of the command."""


class _Result(msgspec.Struct):
    command: str


@dataclass(frozen=True, slots=True)
class Going:
    """Treatment of the finished results of a run. Those of an earlier run are used unless `restart` is set, and
    they are removed when the run has ended well unless `keep` is set."""

    restart: bool = False
    keep: bool = False


@contextmanager
def output_folder(name: str, going: Going | None = None) -> Iterator[Path]:
    """Yield a staging folder. If the block ends without an exception, all its files move into the folder named.

    Parameters
    ----------
    going : Going, optional
        For a run that can go on later: its finished results, in `store_path`, stay if it fails.

    Raises
    ------
    OutputError
        If the place cannot be written, or another run is writing there.
    """
    with _as_output_error(name), _place(name) as out, _hidden(out, STAGING, name, going, {STORE}) as hidden:
        staged = hidden / STAGED
        staged.mkdir()
        yield staged
        with held_back():
            _check_in_place(name, out)
            _join(name, staged, out)
            signals.written.append(name)


@contextmanager
def new_folder(name: str, *, last: str = LAST_OF_DATASET, going: Going | None = None) -> Iterator[Path]:
    """Yield a staging folder. If the block ends without an exception, its content moves into the folder named.

    Parameters
    ----------
    last : str
        The file without which the folder is no dataset, or no chart; it is the last to get its name.
    going : Going, optional
        For a run that can go on later: its finished results, in `store_path`, and the files in the staging
        folder stay if it fails. The next run finds both.

    Raises
    ------
    OutputError
        If the place cannot be written or is not empty, or another run is writing there.
    """
    kept = {STORE, STAGED}
    with _as_output_error(name), _place(name) as out, _hidden(out, STAGING, name, going, kept) as hidden:
        if found := sorted(_names(out) - {STAGING}):
            raise OutputError(f"{name}: is not empty, found {found[0]}; expected a new name or an empty folder")
        staged = hidden / STAGED
        staged.mkdir(exist_ok=going is not None)
        with _shown_as(name, staged):
            yield staged
        with held_back():
            _check_in_place(name, out)
            _fill(name, staged, out, last)
            signals.written.append(name)


def store_path(staged: Path) -> Path:
    """Return the path of the store of finished results of the run that has this staging folder."""
    return staged.parent / STORE


@contextmanager
def held(staged: Path) -> Iterator[Path]:
    """Open a staging folder from another process, or by its real path, as `new_folder` opens it.

    Raises
    ------
    OutputError
        If it is a link or belongs to somebody else.
    """
    with ExitStack() as stack:
        try:
            hidden = _held(staged.parent, stack)
        except OSError as error:
            raise OutputError(f"{staged}: cannot be written ({error.strerror})") from None
        if not _is_ours(hidden):
            raise OutputError(f"{staged.parent}: belongs to another user")
        with _shown_as(str(staged), hidden / staged.name):
            yield hidden / staged.name


def remove_others(folder: Path, names: Collection[str]) -> None:
    """Remove from a staging folder all files that an earlier run with other settings has left, except the given
    ones.

    Parameters
    ----------
    names : collection of str
        Paths relative to the folder; folders that are left empty are removed, too.
    """
    for parent, _, files in os.walk(folder, topdown=False):
        for path in (Path(parent, file) for file in files):
            if path.relative_to(folder).as_posix() not in names:
                path.unlink()
        if Path(parent) != folder and not _names(Path(parent)):
            Path(parent).rmdir()


def write_file(path: Path, content: bytes, *, not_over: Path | None = None, is_private: bool = False) -> None:
    """Write a whole file or nothing. An older file of that name is replaced; its permissions are kept.

    Only its owner can read a new file that `is_private`.

    Raises
    ------
    OutputError
        If the place cannot be written, is that of `not_over`, or another run is writing there.
    """
    name = str(path)
    with _as_output_error(name), ExitStack() as stack:
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a folder or device, expected the name of a file")
        if not_over is not None and path.exists() and path.samefile(not_over):
            raise OutputError(f"{path}: is the result itself, expected another name")
        parent = _held(Path(os.path.realpath(path.parent)), stack)
        with _hidden(parent, beside(path.name), name) as hidden:
            write_files(hidden, {STAGED: content})
            if is_private:
                (hidden / STAGED).chmod(0o600)
            with suppress(FileNotFoundError):
                status = (parent / path.name).lstat()
                if stat.S_ISREG(status.st_mode):
                    (hidden / STAGED).chmod(stat.S_IMODE(status.st_mode))
            with held_back():
                (hidden / STAGED).replace(parent / path.name)
                signals.written.append(name)


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


def locked(file: int) -> bool:
    """Lock an open file until it is closed. Returns whether the file system has locks.

    Raises
    ------
    BlockingIOError
        If another process has locked it.
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


def open_own(path: Path) -> int:
    """Open a file for reading and writing, or make it; no link is followed, and no pipe is waited for.

    Raises
    ------
    OSError
        If it cannot be opened, or is no regular file.
    """
    more = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
    file = os.open(path, os.O_RDWR | os.O_CREAT | sum(more), 0o600)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))
    return file


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
def _shown_as(name: str, staged: Path) -> Iterator[None]:
    """Name frames in messages as they would have been named."""
    real = os.path.realpath(staged)
    try:
        yield
    except OutputError as error:
        raise OutputError(error.marked.replace(str(staged), name).replace(real, name)) from None


@contextmanager
def _place(name: str) -> Iterator[Path]:
    """Open the folder named; make it if there is none, and remove it again if the block fails and it is empty.

    Links in its name are followed: it is the user's.
    """
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
    path = Path(os.path.realpath(path))
    made = False
    try:
        with held_back(), suppress(FileExistsError):
            path.mkdir()
            made = True
        with ExitStack() as stack:
            yield _held(path, stack)
    except BaseException:
        if made:
            with suppress(OSError):
                path.rmdir()
        raise


def _held(folder: Path, stack: ExitStack) -> Path:
    """Open a folder that is no link. Returns a path that leads to this folder even if its name changes.

    Where the system has no such paths (it needs Linux's /proc) it is the folder's name.
    """
    if sys.platform == "win32":
        if folder.is_symlink() or not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        return folder
    number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    stack.callback(os.close, number)
    by_number = Path(f"/proc/self/fd/{number}")
    return by_number if by_number.is_dir() else folder


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _check_in_place(name: str, out: Path) -> None:
    """Raise OutputError if the folder named is not the one that was opened."""
    if not (os.path.exists(name) and os.path.samefile(name, out)):  # noqa: PTH110, PTH121 - a name, no path
        raise OutputError(f"{name}: was moved, removed or replaced during the run; nothing was written")


# The hidden folder --------------------------------------------------------------------------------------------


def beside(file_name: str) -> str:
    """Return the name of the hidden folder beside a file; its length does not depend on the file's name."""
    return f"{STAGING}-{hashlib.sha256(os.fsencode(file_name)).hexdigest()[:16]}"


@contextmanager
def _hidden(
    parent: Path, entry: str, name: str, going: Going | None = None, kept: Set[str] = frozenset()
) -> Iterator[Path]:
    """Make a hidden folder for this run alone, empty except for the lock, and remove it at the end.

    If the run can go on later, what is `kept` may be there at the start, and stays if the run fails and has a
    store. Another command into the same place leaves the store alone.
    """
    lock: int | None = None
    hidden: Path | None = None
    stays: Set[str] = frozenset()
    with ExitStack() as stack:
        try:
            with held_back():
                hidden, lock = _lock(parent, entry, name, stack)
                stays = {STORE} if going is None else frozenset() if going.restart else kept
                if (hidden / MOVING).exists():
                    _take_back(hidden, parent)
                _clear(hidden, stays)
            yield hidden
            stays = {STORE} if going is None or going.keep else frozenset()
        except BaseException:
            is_kept = hidden is not None and (hidden / STORE).exists()
            stays = (kept if going is not None else {STORE}) if is_kept else frozenset()
            raise
        finally:
            if hidden is not None:
                with held_back():
                    _release(parent / entry, hidden, lock, stays)


def _lock(parent: Path, entry: str, name: str, stack: ExitStack) -> tuple[Path, int | None]:
    """Make, open and lock a hidden folder.

    Returns
    -------
    (Path, int or None)
        The folder, and the open lock file; None if the file system has no locks: then the folder is the lock.
    """
    place = parent / entry
    shown = Path(os.path.realpath(parent)) / entry
    theirs = OutputError(f"{shown}: was not made by todframes for this user; move it away, or take another name")
    while True:
        made = True
        try:
            place.mkdir(mode=0o700)
        except FileExistsError:
            made = False
        with ExitStack() as opened:
            try:
                hidden = _held(place, opened)
                names = _names(hidden)
                if (names and LOCK not in names) or names - {LOCK, STAGED, STORE, MOVING} or not _is_ours(hidden):
                    raise theirs
                with suppress(OSError):
                    hidden.chmod(0o700)
                lock = open_own(hidden / LOCK)
            except FileNotFoundError:
                continue  # its run has just ended
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.ENXIO):
                    raise theirs from None
                if made:
                    with suppress(OSError):
                        place.rmdir()
                raise
            opened.callback(os.close, lock)
            try:
                has_locks = locked(lock)
            except BlockingIOError:
                raise OutputError(
                    f"{name}: another run is writing there; wait for it, or take another name"
                ) from None
            if not has_locks and not made:
                raise OutputError(
                    f"{shown}: belongs to another run, or to one that was killed; remove it if none is under way"
                )
            if _is_locked_by(lock, hidden):
                stack.push(opened.pop_all())
                return hidden, lock if has_locks else None


def _is_ours(folder: Path) -> bool:
    """Return whether a folder belongs to this user."""
    if sys.platform == "win32":
        return True
    owner = folder.stat().st_uid
    if owner != os.geteuid():
        with tempfile.TemporaryFile(dir=folder) as probe:  # a network disk may give our files another owner
            if os.fstat(probe.fileno()).st_uid != owner:
                return False
    return True


def _is_locked_by(lock: int, folder: Path) -> bool:
    """Return whether the lock is still the folder's; its last owner may have removed the folder."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(lock), (folder / LOCK).lstat())
    return False


def _release(place: Path, hidden: Path, lock: int | None, stays: Set[str]) -> None:
    """Remove a hidden folder, the lock last; if something stays, the lock file stays too, unlocked."""
    with suppress(OSError):  # the next run removes it
        if lock is None or _is_locked_by(lock, hidden):
            _clear(hidden, stays)
            if not stays & _names(hidden):
                (hidden / LOCK).unlink()
                place.rmdir()


def _clear(hidden: Path, stays: Set[str]) -> None:
    """Remove the files of a run from its hidden folder, except the lock and the files that stay."""
    for entry in list(os.scandir(hidden)):
        if entry.name == LOCK:
            continue
        if entry.is_dir(follow_symlinks=False):
            if entry.name in stays:
                _keep_own_files(Path(entry))
            else:
                shutil.rmtree(entry)
        elif entry.name not in stays or not _is_own_file(entry):
            os.unlink(entry)  # noqa: PTH108 - an entry is no Path


def _keep_own_files(folder: Path) -> None:
    """Remove links, and everything else that no run has written, from a folder that an earlier run has left."""
    for entry in list(os.scandir(folder)):
        if entry.is_dir(follow_symlinks=False):
            _keep_own_files(Path(entry))
        elif not _is_own_file(entry):
            os.unlink(entry)  # noqa: PTH108 - an entry is no Path


def _is_own_file(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a regular file with no other name."""
    status = os.lstat(entry)
    return stat.S_ISREG(status.st_mode) and status.st_nlink == 1


# Into place ---------------------------------------------------------------------------------------------------


def _join(name: str, staged: Path, out: Path) -> None:
    """Move staged files into a result folder, over older ones, one by one."""
    made = _names(staged)
    for part in made:
        if (out / part).is_dir() and not (out / part).is_symlink():
            raise OutputError(f"{Path(name) / part}: is a folder, expected a file or none")
    stale = _files_of_result(out) - made if LAST_OF_RESULT in made else set()
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


def _files_of_result(path: Path) -> set[str]:
    """Return the files of the result in a folder. Beside another result, they would seem to belong to that one."""
    with suppress(OSError, msgspec.MsgspecError):
        file = path / LAST_OF_RESULT
        if stat.S_ISREG((status := file.lstat()).st_mode) and status.st_size <= LARGEST_RESULT_MB * 2**20:
            result = msgspec.json.decode(file.read_bytes(), type=_Result)
            return {one for one in _files_of_command(result.command) if (path / one).is_file()}
    return set()


def _files_of_command(command: str) -> Collection[str]:
    """Return the names of the files that a command of this or another package writes beside `result.json`."""
    if command in FILES_OF_COMMAND:
        return FILES_OF_COMMAND[command]
    from importlib.metadata import entry_points

    return {name for entry in entry_points(group=ENTRY_POINT_GROUP, name=command) for name in entry.load()}


def _fill(name: str, staged: Path, out: Path, last: str) -> None:
    """Move staged files and folders into a folder that has none of them; no file is replaced."""
    parts = sorted(_names(staged), key=lambda part: (part == last, part))
    # A run that is killed meanwhile leaves a list of what is its own, by numbers that nobody can plant.
    numbers = {part: (staged / part).lstat().st_ino for part in parts}
    write_files(staged.parent, {MOVING: msgspec.json.encode(numbers)})
    moved: list[str] = []
    try:
        for part in parts:
            if os.path.lexists(out / part):
                raise OutputError(f"{name}: {part} was put there meanwhile; expected a new name")
            (staged / part).rename(out / part)
            moved.append(part)
    except OSError:  # an OutputError is one, too
        for part in reversed(moved):
            (out / part).rename(staged / part)
        raise


def _take_back(hidden: Path, out: Path) -> None:
    """Move the files that a killed run had already moved back into the staging folder, unless it had moved all."""
    with suppress(OSError, msgspec.MsgspecError):
        numbers = msgspec.json.decode((hidden / MOVING).read_bytes(), type=dict[str, int])
        there = {entry.name for entry in os.scandir(out) if entry.inode() == numbers.get(entry.name)}
        if there != numbers.keys():
            for part in there:
                (out / part).rename(hidden / STAGED / part)
