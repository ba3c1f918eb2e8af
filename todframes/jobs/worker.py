"""The side of a worker: a process receives works, and does batches of their items.

A work comes once, apart from the items, and waits here under the hash of its bytes.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from todframes.base.errors import TodframesError, in_command
from todframes.base.user_code import in_words, search_last
from todframes.jobs.start import THREADS_ENVIRONMENT

try:  # it comes with Dask, and also pickles what is defined in a script or a notebook
    from cloudpickle import dumps as dumps
except ImportError:
    from pickle import dumps as dumps

LONGEST_BATCH_S = 5.0
"""Time after which a batch ends; the items that are left come back."""


class UnfitError(Exception):
    """Exception of a process that cannot do the work."""


class Done(NamedTuple):
    """The results of the first `n_items` items of a batch, pickled; the seconds that they took, and the exception
    of the item after them.
    """

    results: bytes
    n_items: int
    seconds: float
    error: Exception | None


_received: dict[str, tuple[bytes, Sequence[str]]] = {}

_functions: dict[str, Callable[[Any], Any]] = {}

_making = threading.Lock()
"""Lock held while a function is made: once, by the first thread that needs it."""


def receive(key: str, work: bytes, folders: Sequence[str] = ()) -> None:
    """Keep a pickled work under a key, and the folders that are to be searched last for its modules."""
    _received[key] = work, folders


def forget(key: str) -> None:
    """Forget a work."""
    _received.pop(key, None)
    _functions.pop(key, None)


def do_batch_of_file(path: str, items: bytes) -> Done:
    """Do the items of a batch by the work of a file, which holds what `receive` takes; drop the work before."""
    if path not in _received:
        _received.clear()
        _functions.clear()
        receive(path, *pickle.loads(Path(path).read_bytes()))
    return do_batch(path, items)


def do_batch(key: str, items: bytes) -> Done:
    """Do the items of a batch, a pickled list, by the work with a key; UnfitError if the work cannot be loaded
    here. The batch ends at the first exception, and after `LONGEST_BATCH_S`.
    """
    try:
        function = _function(key)
    except TodframesError as error:
        return Done(pickle.dumps([]), 0, 0.0, _portable(error))
    except Exception as error:  # of a class that is not installed here, or of a user's code
        raise UnfitError(f"cannot load the work ({in_words(error)})") from None
    return _do(function, pickle.loads(items))


def keep_libraries_to_one_thread() -> None:
    """Limit the threads of native libraries, those that are loaded already included."""
    os.environ.update(THREADS_ENVIRONMENT)
    import threadpoolctl

    threadpoolctl.threadpool_limits(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if "OpenImageIO" in sys.modules:
        sys.modules["OpenImageIO"].attribute("threads", 1)


def _function(key: str) -> Callable[[Any], Any]:
    with _making:
        if key not in _functions:
            work, folders = _received[key]
            search_last(folders)
            loaded, is_command = pickle.loads(work)
            with in_command(is_command):
                _functions[key] = in_command(is_command)(loaded.function())
        return _functions[key]


def _do(function: Callable[[Any], Any], items: Sequence[Any]) -> Done:
    results: list[Any] = []
    failure = None
    started = time.perf_counter()
    for item in items:
        try:
            results.append(function(item))
        except (Exception, SystemExit) as error:
            failure = _portable(error)
            break
        if time.perf_counter() - started > LONGEST_BATCH_S:
            break
    seconds = time.perf_counter() - started
    try:
        return Done(dumps(results), len(results), seconds, failure)
    except Exception as error:
        return Done(pickle.dumps([]), 0, seconds, _portable(error))


def _portable(error: BaseException) -> Exception:
    """Return an exception that the client can unpickle; that of a defect names the place where it was raised."""
    if not isinstance(error, TodframesError):
        error.add_note("".join(["in a worker:\n", *traceback.format_tb(error.__traceback__)]).rstrip())
    try:
        copy = pickle.loads(dumps(error))
    except Exception:
        copy = None
    return copy if isinstance(copy, Exception) else RuntimeError(f"in a worker: {in_words(error)}")
