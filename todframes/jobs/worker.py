"""The side of a worker: a process of a cluster receives works, and does batches of their items.

A work comes once, apart from the items, and waits here under the hash of its bytes. A process that has not
received a work, because the run has just begun or the process joined later or was started again, asks for it.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cloudpickle
from distributed import get_worker

from todframes import __version__
from todframes.errors import TodframesError
from todframes.user_code import in_words, search_last

LONGEST_BATCH_S = 5.0
"""Time after which a batch ends; the items that are left come back."""


MOST_WORKS = 4
"""Number of works that a process keeps: several clients may share a cluster."""


REQUESTS = "todframes-requests"
"""Topic of the events by which workers ask for works: lists of a work's key and the worker's address."""


ANSWER_S, MOST_REQUESTS = 20.0, 3
"""Time within which a work has to come before it is asked for again, and the number of times to ask."""


THREADS_ENVIRONMENT = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
        "OPENIMAGEIO_THREADS",
    ),
    "1",
)
"""Environment in which native libraries use one thread, as the processes of a cluster share the processors."""


class Versions(NamedTuple):
    """The versions that have to be the same in the client and in a worker."""

    python: str
    todframes: str


class Unfit(NamedTuple):
    """The answer of a process that cannot do the work; `address` is that of its worker."""

    address: str
    problem: str


class Done(NamedTuple):
    """The results of the first items of a batch.

    Attributes
    ----------
    results : bytes
        The list of results, pickled.
    n_items : int
        Number of results.
    seconds : float
        Time that the items took.
    error : Exception or None
        Exception of the item after them.
    """

    results: bytes
    n_items: int
    seconds: float
    error: Exception | None


_received: OrderedDict[str, bytes] = OrderedDict()
_arrival = threading.Condition()


_functions: OrderedDict[str, Callable[[Any], Any]] = OrderedDict()
_making = threading.Lock()
"""Lock held while a function is made: once, by the first thread that needs it."""


def versions() -> Versions:
    """Return the versions of this process."""
    return Versions("{}.{}".format(*sys.version_info), __version__)


def receive(key: str, work: bytes) -> None:
    """Keep a pickled work under a key until its function is made."""
    with _arrival:
        _received[key] = work
        _drop_oldest(_received)
        _arrival.notify_all()


def do_batch(key: str, items: bytes, expected: Versions) -> Done | Unfit:
    """Do the items of a batch, a pickled list, by the work with a key.

    The batch ends at the first exception, and after `LONGEST_BATCH_S`.
    """
    address = get_worker().address
    if (found := versions()) != expected:
        return Unfit(address, different_versions(found, expected))
    try:
        function = _function(key)
    except TodframesError as error:
        return Done(pickle.dumps([]), 0, 0.0, _portable(error))
    except Exception as error:  # of a class that is not installed here, or of a user's code
        return Unfit(address, f"cannot load the work ({in_words(error)})")
    return _do(function, pickle.loads(items))


def different_versions(found: Versions, expected: Versions) -> str:
    """Return in words that versions differ."""
    ours, theirs = (f"Python {one.python} and todframes {one.todframes}" for one in (expected, found))
    return f"found {theirs}, expected {ours}"


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
            keep_libraries_to_one_thread()
            folders, work = pickle.loads(_work(key))
            search_last(folders)
            _functions[key] = pickle.loads(work).function()
            _drop_oldest(_functions)
        return _functions[key]


def _work(key: str) -> bytes:
    """Return the pickled work with a key; ask the client for it. Raises TimeoutError if it does not come."""
    worker = get_worker()
    with _arrival:
        for _ in range(MOST_REQUESTS):
            if key not in _received:
                worker.log_event(REQUESTS, [key, worker.address])
            if _arrival.wait_for(lambda: key in _received, timeout=ANSWER_S):
                return _received.pop(key)
    raise TimeoutError(f"it has not come within {MOST_REQUESTS * ANSWER_S:g} s")


def _drop_oldest(works: OrderedDict[str, Any]) -> None:
    while len(works) > MOST_WORKS:
        works.popitem(last=False)


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
        return Done(cloudpickle.dumps(results), len(results), seconds, failure)
    except Exception as error:
        return Done(pickle.dumps([]), 0, seconds, _portable(error))


def _portable(error: BaseException) -> Exception:
    """Return an exception that the client can unpickle; one that is a defect says where it was raised."""
    if not isinstance(error, TodframesError):
        error.add_note("".join(["in a worker:\n", *traceback.format_tb(error.__traceback__)]).rstrip())
    try:
        copy = pickle.loads(cloudpickle.dumps(error))
    except Exception:
        copy = None
    return copy if isinstance(copy, Exception) else RuntimeError(f"in a worker: {in_words(error)}")
