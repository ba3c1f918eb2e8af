"""The engine of several processes of this machine; joblib hands them the items."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle  # it also pickles what is defined in a script or a notebook
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor

import todframes
from todframes.base import signals
from todframes.base.errors import SettingsError, TodframesError, argument, in_command, is_in_command
from todframes.base.user_code import in_words, search_last, searched_last
from todframes.jobs.start import starting_processes
from todframes.jobs.work import Work

T = TypeVar("T")
R = TypeVar("R")

Sent = tuple[bytes, tuple[str, ...], str]
"""A pickled work, the folders of the user's modules, and the version of this package."""

END_POLL_S = 0.5
"""Interval at which a process looks whether the one that started it is still there."""


class ProcessEngine:
    """The engine of `n_workers` processes of this machine. All end with this process, however it ends."""

    dashboard: str | None = None
    name = "workers"

    def __init__(self, n_workers: int) -> None:
        self.n_workers = min(n_workers, 61) if sys.platform == "win32" else n_workers  # Windows waits for 61
        self._has_begun = False

    def close(self) -> None:
        """End the processes: a later run imports the code of the user anew."""
        if self._has_begun:
            with suppress(OSError):
                get_reusable_executor(max_workers=self.n_workers, reuse=True).shutdown(
                    wait=False, kill_workers=True
                )

    def run(self, work: Work[T, R], items: Iterable[tuple[int, T]]) -> Generator[tuple[int, R], None, None]:
        """Yield the results of numbered items with their numbers, in any order. SettingsError if the work cannot
        be pickled; TodframesError if processes cannot start, cannot do the work, or die with it.
        """
        in_flight: dict[int, T] = {}
        failure: Exception | None = None
        with (
            self._explained(work, in_flight.values),
            self._opened(self.packed(work)) as sent,
            ExitStack() as stack,
        ):

            def calls() -> Iterator[Any]:
                for number, item in items:
                    in_flight[number] = item
                    yield delayed(do_item)(sent, number, item)

            # Work that is dropped at the end is no news.
            stack.enter_context(warnings.catch_warnings(action="ignore", category=UserWarning))
            parallel = Parallel(n_jobs=self.n_workers, return_as="generator_unordered", pre_dispatch="2*n_jobs")
            with starting_processes():
                results = parallel(calls())
            self._has_begun = True
            stack.callback(_drop, results)
            for number, result, failure in results:
                if signals.unanswered:
                    raise KeyboardInterrupt
                if failure is not None:
                    break
                del in_flight[number]
                yield number, result
        if failure is not None:
            raise failure

    def packed(self, work: Work[T, R]) -> Sent:
        """Return a work as it is sent to the processes; SettingsError if it cannot be pickled."""
        try:
            packed = cloudpickle.dumps((work, is_in_command()))
        except Exception as error:
            name = getattr(argument, self.name)
            raise SettingsError(f"{name}: cannot send this to other processes ({in_words(error)})") from None
        return packed, self._folders(), todframes.__version__

    @contextmanager
    def _explained(self, work: Work[T, R], in_flight: Callable[[], Iterable[T]]) -> Iterator[None]:
        """Say in a line what is wrong with the processes."""
        try:
            yield
        except TodframesError:
            raise
        except Exception as error:
            names = [work.name(item) for item in in_flight()]
            self._explain(error, names[0] if len(names) == 1 else _span(names))
            raise

    @contextmanager
    def _opened(self, work: Sent) -> Iterator[object]:
        """Make joblib use these processes in the block, and yield what stands for the work in each call."""
        with tempfile.TemporaryDirectory(prefix="todframes-") as folder:
            path = Path(folder, "work")
            try:
                path.write_bytes(pickle.dumps(work))
            except OSError as error:
                raise TodframesError(f"{path}: cannot be written ({error.strerror})") from None
            begin = {"initializer": _end_with_parent, "initargs": (os.getpid(),)}
            with parallel_config("loky", inner_max_num_threads=1, **begin):
                yield str(path)

    def _folders(self) -> tuple[str, ...]:
        """Return the folders in which the processes look for modules of the user."""
        return tuple(searched_last())

    def _explain(self, error: Exception, where: str) -> None:
        """Raise TodframesError for an exception of the pool; `where` names the items in flight."""
        name = getattr(argument, self.name)
        if isinstance(error, BrokenProcessPool):
            raise TodframesError(
                f"{name}: a process died at {where}; it was killed, had too little memory, or a file crashed it"
            ) from None
        if isinstance(error, pickle.PicklingError):
            cause = error.__cause__ or error
            raise SettingsError(f"{name}: cannot send this to other processes ({in_words(cause)})") from None
        if isinstance(error, OSError):
            raise TodframesError(
                f"{name}: a process could not start ({error.strerror}); take fewer workers, or raise the limits "
                "of the shell (ulimit)"
            ) from None


def _drop(results: Generator[Any, None, None]) -> None:
    """End the work that is not done. loky's thread forgets all items, and fails if one comes to it meanwhile."""
    hook = threading.excepthook

    def ignore(args: threading.ExceptHookArgs) -> None:
        if args.exc_type is not KeyError or getattr(args.thread, "name", "") != "ExecutorManagerThread":
            hook(args)

    threading.excepthook = ignore
    try:
        results.close()
    finally:
        threading.excepthook = hook


def _span(names: Sequence[str]) -> str:
    return f"one of {len(names)} parts of the work, from {names[0]} to {names[-1]}" if names else "its start"


def do_item(sent: str | Sent, number: int, item: Any) -> tuple[int, Any, Exception | None]:
    """Return the number of an item and its result, or the exception in its place."""
    try:
        return number, _function(sent)(item), None
    except (Exception, SystemExit) as error:
        return number, None, _portable(error)


@lru_cache(maxsize=1)
def _function(sent: str | Sent) -> Callable[[Any], Any]:
    """Return the function of a work, made once in each process."""
    packed, folders, version = pickle.loads(Path(sent).read_bytes()) if isinstance(sent, str) else sent
    if version != todframes.__version__:
        raise TodframesError(f"a worker has todframes {todframes.__version__}, expected {version}")
    search_last(folders)
    try:
        work, is_command = cloudpickle.loads(packed)
    except Exception as error:  # of a class that is not installed here, or of a user's code
        raise TodframesError(f"workers: cannot load the work ({in_words(error)})") from None
    with in_command(is_command):
        function: Callable[[Any], Any] = in_command(is_command)(work.function())
        return function


def _portable(error: BaseException) -> Exception:
    """Return an exception that the client can unpickle; that of a defect names the place where it was raised."""
    if not isinstance(error, TodframesError):
        error.add_note("".join(["in a worker:\n", *traceback.format_tb(error.__traceback__)]).rstrip())
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:
        copy = None
    return copy if isinstance(copy, Exception) else RuntimeError(f"in a worker: {in_words(error)}")


def _end_with_parent(parent: int) -> None:
    """Leave Ctrl-C to the process that started this one, and end soon after it, however it ends, if it has not."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end() -> None:
        while os.getppid() == parent:
            time.sleep(END_POLL_S)
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
