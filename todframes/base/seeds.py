"""The argument `rng` of calls, as in SPEC 7 of Scientific Python, and the random streams that a seed has."""

from __future__ import annotations

import numpy as np

Rng = np.random.SeedSequence | np.random.Generator


def seed_of(rng: int | Rng) -> int:
    """Return the seed that `rng` is or gives; a generator is advanced by one draw."""
    if isinstance(rng, np.random.Generator):
        return int(rng.integers(2**53))
    if isinstance(rng, np.random.SeedSequence):
        return int(rng.generate_state(1, np.uint64)[0] >> np.uint64(11))
    return rng


def random_stream(seed: int, kind: int, number: int) -> np.random.Generator:
    """Return the stream of a number, one of many of a kind that do not depend on each other."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(kind, number))))
