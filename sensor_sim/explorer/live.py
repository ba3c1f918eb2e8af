"""Thresholds of a sensor while its parameters move: an estimate first, refined while nothing moves.

Sizes are divided among processes, which stay alive and keep what they have computed. A number in shared memory
names the request that is wanted; a process that works on another one notices within milliseconds and waits for the
next.

Thresholds are computed as `sweep` does, and parts that earlier sensors have in common with a later one are kept.
Background and NETD do not change a threshold SNR. A threshold contrast is that on the display, so the gain does
not change it either.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.sampling import field_detectors
from sensor_sim.chain.sensor import Sensor
from sensor_sim.thresholds.curve_plan import PARTS, Level, coarse_plan, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from sensor_sim.thresholds.threshold import SATURATING, SEED, WITHOUT_NOISE, Shares, shares_at, what_limits
from todframes.base.errors import TodframesError
from todframes.base.user_code import search_last, searched_last
from todframes.jobs.start import starting_processes
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings

SHARED_MB = 32
"""Largest size of the parts that are kept, in units of 2**20 bytes."""

THRESHOLDS_KEPT = 2000

TOLERANCES = (0.03, 0.002)
"""Relative errors of the estimate and of the refined thresholds."""

PROCESSES = 2

BETWEEN_S = 0.25
"""Shortest time between two updates of a curve while it is refined."""

POLL_S = 0.004
"""Longest time between two checks whether the curve is still wanted."""

END_S = 1.0
"""Time that a process has to end by itself."""

NOTHING_WANTED = 0


class Request(NamedTuple):
    """Thresholds to compute: `sizes` are places in the curve and sizes in detectors, `tolerances` the relative
    errors to reach, of coarse and refined thresholds; the others are those of `LiveCurves.curves`. The observer is
    pickled.
    """

    number: int
    camera: Camera
    observer: bytes
    sizes: tuple[tuple[int, float], ...]
    p_correct: float
    tolerances: tuple[float, float]
    level: Level = "snr"
    n_points: int = 0


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A threshold at the place `index` of the curve, and what limits it."""

    index: int
    threshold: PredictedThreshold
    shares: Shares
    is_refined: bool


class ThresholdEngine:
    """Computes thresholds, and keeps those that the next sensor may need."""

    def __init__(self) -> None:
        self._pickled, self._observer = b"", Observer()
        self._known: dict[Hashable, CurvePoint] = {}

    def answers(self, request: Request) -> Iterator[CurvePoint]:
        """Yield coarse thresholds of all sizes and then refined ones, the easiest first. A refined threshold that
        is already known is yielded at once, instead of the coarse one. SettingsError if the observer is not
        linear, or the proportion, a size or a field is out of range.
        """
        FitSettings(p_correct=request.p_correct)  # checks it
        for _, size in request.sizes:
            field_detectors(request.camera, size)  # checks it
        camera = request.camera
        if request.level == "contrast":  # there is no detector noise
            camera = replace(camera, photons=None, background_electrons=0.0, gain=1.0)
        request = request._replace(camera=camera, number=0)
        if request.observer != self._pickled:
            self._pickled, self._observer = request.observer, pickle.loads(request.observer)
        todo = []
        for index, size in request.sizes:
            refined = request._replace(sizes=((0, size),))
            point = self._known.get((refined, True)) or self._point(refined, is_refined=False)
            yield replace(point, index=index)
            if not point.is_refined:
                threshold, error = point.threshold.threshold, point.threshold.numerical_error
                todo.append((error / threshold if threshold and error else 0.0, index, refined))
        for _, index, refined in sorted(todo, key=lambda item: item[:2]):
            yield replace(self._point(refined, is_refined=True), index=index)

    def _point(self, request: Request, *, is_refined: bool) -> CurvePoint:
        """Return the threshold of the only size of a request, as it is known or computed now."""
        key = request, is_refined
        if key not in self._known:
            if len(self._known) == THRESHOLDS_KEPT:
                self._known.clear()
            self._known[key] = self._computed(request, is_refined=is_refined)
        return self._known[key]

    def _computed(self, request: Request, *, is_refined: bool) -> CurvePoint:
        """Compute a threshold and what limits it."""
        ((index, size),) = request.sizes
        camera, observer, p_correct, level = request.camera, self._observer, request.p_correct, request.level
        tolerance = request.tolerances[is_refined]
        if is_refined:
            plan = plan_curve(camera, observer, size, tolerance=tolerance, p_correct=p_correct, level=level)
        else:
            plan = coarse_plan(camera, observer, size, level=level)
        chain = FoldedChain(camera, observer, size, plan)
        found = predict_threshold(
            chain,
            p_correct=p_correct,
            tolerance=tolerance,
            seed=SEED,
            n_points=request.n_points,
            level=level,
        )
        return CurvePoint(index, found, shares_at(chain, level, found.threshold), is_refined)


class LiveCurve(NamedTuple):
    """Thresholds of one sensor, in the order of the sizes asked for, and what limits each of them. `tolerance` is
    the relative half-width of the 95 % intervals that was aimed at; each threshold states its own.
    `counts_photons`: they are contrasts at the light of the scene.
    """

    points: tuple[CurvePoint, ...]
    tolerance: float
    seconds: float
    is_last: bool
    counts_photons: bool = False

    @property
    def thresholds(self) -> list[PredictedThreshold]:
        """The thresholds alone."""
        return [one.threshold for one in self.points]

    @property
    def limits(self) -> tuple[Shares, str]:
        """Mean shares of the sizes with a threshold, or else of all, and what limits in a sentence."""
        statuses = [one.status for one in self.thresholds]
        sizes, shares = [one.size_detectors for one in self.thresholds], [one.shares for one in self.points]
        return what_limits(sizes, shares, statuses, SATURATING if self.counts_photons else WITHOUT_NOISE)


class LiveCurves:
    """Curves of sensors that differ in some parameters from one call to the next. The processes import the script
    that runs: it makes this object below `if __name__ == "__main__":`, and calls `close` in the end.
    """

    def __init__(self, n_processes: int = PROCESSES) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy the locks of threads
        self._wanted: Any = context.RawValue("q", NOTHING_WANTED)
        self._workers = [_Worker(self._wanted) for _ in range(n_processes)]
        self._turn = threading.Lock()
        self._number = NOTHING_WANTED
        self._is_closed = False

    def curves(
        self,
        sensor: Sensor,
        observer: Observer,
        sizes_detectors: Sequence[float],
        *,
        p_correct: float = 0.75,
        level: Level = "snr",
        tolerances: tuple[float, float] = TOLERANCES,
        n_points: int = 0,
        is_wanted: Callable[[], bool],
    ) -> Generator[LiveCurve, None, None]:
        """Yield an estimate, and then curves with more and more refined sizes; stop as soon as the curve is no
        longer wanted. One curve is computed at a time; another thread waits until it is done or no longer wanted.
        The level "contrast" is that of a large triangle on the display without detector noise; for a camera that
        counts photons, "snr" stands for the contrast of the scene with all noise. `tolerances` are relative errors
        to reach, of the estimate and of the refined thresholds, and `n_points` those of the psychometric function
        of each. `is_wanted` is asked every few milliseconds. SettingsError if the observer is not
        linear, or the proportion, a size or a field is out of range; TodframesError if a process dies.
        """
        started = time.perf_counter()
        while not self._turn.acquire(timeout=POLL_S):
            if self._is_closed or not is_wanted():
                return
        try:
            self._number += 1
            self._wanted.value = self._number
            sizes = [float(size) for size in sizes_detectors]
            pickled, camera = pickle.dumps(observer), resolve(sensor)
            requests = [
                Request(self._number, camera, pickled, part, p_correct, tolerances, level, n_points)
                for part in divided(sizes, len(self._workers))
            ]
            points: dict[int, CurvePoint] = {}
            next_s, counts_photons = 0.0, camera.photons is not None and level == "snr"
            for point in self._answers(requests, is_wanted):
                points[point.index] = point
                is_whole = len(points) == len(sizes)
                is_last = is_whole and all(one.is_refined for one in points.values())
                seconds = time.perf_counter() - started
                if is_last or (is_whole and seconds >= next_s):
                    in_order = tuple(points[index] for index in range(len(sizes)))
                    yield LiveCurve(in_order, tolerances[is_last], seconds, is_last, counts_photons)
                    next_s = time.perf_counter() - started + BETWEEN_S
                if is_last:
                    return
        finally:
            self._wanted.value = NOTHING_WANTED
            self._turn.release()

    def _answers(self, requests: Sequence[Request], is_wanted: Callable[[], bool]) -> Iterator[CurvePoint]:
        """Yield the answers to requests of one number, a request for each process, until none is wanted."""
        working = {}
        for worker, request in zip(self._workers, requests, strict=True):
            if request.sizes:
                worker.begin(request)
                working[worker] = request
        while working:
            ready = wait([worker.connection for worker in working], timeout=POLL_S)
            if self._is_closed or not is_wanted():
                return
            for worker in [one for one in working if one.connection in ready]:
                try:
                    number, answer = worker.connection.recv()
                except (EOFError, OSError):
                    worker.end()
                    self._workers[self._workers.index(worker)] = _Worker(self._wanted)
                    raise TodframesError(
                        "live curves: a process that computes has died; a script must make LiveCurves below "
                        '`if __name__ == "__main__":`, and a sensor may need more memory than there is'
                    ) from None
                if number != working[worker].number:
                    continue  # of a request that is no longer wanted
                if isinstance(answer, BaseException):
                    raise answer
                if answer is None:
                    del working[worker]
                else:
                    yield answer

    def close(self) -> None:
        """End the processes, and before that a computation that another thread waits for."""
        self._is_closed = True
        self._turn.acquire(timeout=END_S)  # not for ever: who asked may never ask for the next curve
        self._wanted.value = NOTHING_WANTED
        for worker in self._workers:
            worker.end()


def divided(sizes: Sequence[float], n_parts: int) -> list[tuple[tuple[int, float], ...]]:
    """Divide sizes, with their places, into parts of about the same work, the same for the same sizes."""
    parts: list[list[tuple[int, float]]] = [[] for _ in range(n_parts)]
    work = [0.0] * n_parts
    for index, size in sorted(enumerate(sizes), key=lambda item: -item[1]):
        least = work.index(min(work))
        parts[least].append((index, size))
        work[least] += 1.0 + size
    return [tuple(part) for part in parts]


class _Worker:
    """A process at the other end of a pipe. It is no executor of `todframes.jobs`, because futures lack three
    things that live curves need. A request has several answers, each shown as soon as it is there. A request under
    way is given up within milliseconds of a newer one. And a size stays with the process that has kept its parts.
    """

    def __init__(self, wanted: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, wanted), daemon=True)
        with starting_processes():
            self._process.start()
        other.close()

    def begin(self, request: Any) -> None:
        """Send a request. If the process has died, the answer is an error."""
        with suppress(OSError):
            self.connection.send((searched_last(), request))

    def end(self) -> None:
        """End the process, at once if it does not end by itself."""
        self.connection.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


class _UnwantedError(Exception):
    """The request is no longer wanted."""


def _serve(connection: Connection, wanted: Any) -> None:
    """Answer requests until the pipe is closed: (number, answer or exception), and (number, None) in the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other end deals with it
    number = NOTHING_WANTED

    def check() -> None:
        if wanted.value != number:
            raise _UnwantedError

    PARTS.check, PARTS.most_bytes = check, SHARED_MB * 2**20
    engine = ThresholdEngine()
    with suppress(EOFError, OSError):
        while True:
            folders, request = connection.recv()
            search_last(folders)
            number = request.number
            try:
                for answer in engine.answers(request):
                    connection.send((number, answer))
                connection.send((number, None))
            except _UnwantedError:
                continue
            except Exception as error:  # raised at the other end
                connection.send((number, error))
