"""Parts of computations that several sensors share: samplers, samples, weights and trials, each computed once.

A part is found by a key that holds all that its value depends on. So what is shared changes no number, and neither
do the order of the sensors and the memory that is allowed.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from todframes.base._typing import FloatArray

T = TypeVar("T")

OVERHEAD_BYTES = 1000
"""Size of a key and of an object, about; it is added to that of each value."""

MOST_BYTES = 512 * 2**20
"""Largest size of the parts that are shared, if no other is asked for."""


class LruCache(Generic[T]):
    """Values by key, up to a number of bytes; those not used for the longest time are dropped first. With 0 bytes
    nothing is kept. `check` is called whenever a value is asked for; it may raise an exception.
    """

    def __init__(self, most_bytes: int, check: Callable[[], None] = lambda: None) -> None:
        self._most_bytes, self._check = most_bytes, check
        self._values: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, made now if it is not kept. The caller must not change it."""
        self._check()
        if not self._most_bytes:
            return make()
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key][0]
        value = make()  # without the lock: other threads go on, and at worst make it too
        size = _size_bytes(value) + OVERHEAD_BYTES
        with self._lock:
            if key not in self._values and size <= self._most_bytes:
                self._values[key] = value, size
                self._bytes += size
            while self._bytes > self._most_bytes:
                self._bytes -= self._values.popitem(last=False)[1][1]
        return value


def _size_bytes(value: Any) -> int:
    """Return the size of an array, of a list of arrays, or of an object with the attribute `nbytes`."""
    return sum(map(_size_bytes, value)) if isinstance(value, list) else int(value.nbytes)


@dataclass(frozen=True, slots=True)
class Caches:
    """Parts that the curves of several sensors have in common: samplers of triangles, their samples at some
    places, the weights of folded readouts at some places, and the trials of replicates, scores of both.
    """

    samplers: LruCache[Any] = field(default_factory=lambda: LruCache(0))
    samples: LruCache[FloatArray] = field(default_factory=lambda: LruCache(0))
    weights: LruCache[Any] = field(default_factory=lambda: LruCache(0))
    trials: LruCache[Any] = field(default_factory=lambda: LruCache(0))

    @classmethod
    def of(cls, most_bytes: int = MOST_BYTES, check: Callable[[], None] = lambda: None) -> Caches:
        """Return a `Caches` that keeps up to so many bytes: 40 % each of samples and weights, 10 % of others.
        `check` is that of `LruCache`.
        """
        return cls(*(LruCache(most_bytes * percent // 100, check) for percent in (10, 40, 40, 10)))


NO_CACHE = Caches()
"""Nothing is kept: the computation of a single sensor."""
