"""The argument `rng` of calls, as in SPEC 7 of Scientific Python, and the random streams that a seed has."""

from __future__ import annotations

from typing import Any

import numpy as np

from todframes.base.errors import SettingsError, argument

Rng = int | np.integer[Any] | np.random.SeedSequence | np.random.Generator


def seed_of(rng: object) -> int:
    """Return the seed that `rng` is or gives; a generator is advanced by one draw. SettingsError if it gives none,
    or is below zero.
    """
    if isinstance(rng, np.random.Generator):
        return int(rng.integers(2**53))
    if isinstance(rng, np.random.SeedSequence):
        return int(rng.generate_state(1, np.uint64)[0] >> np.uint64(11))
    if isinstance(rng, int | np.integer) and not isinstance(rng, bool) and rng >= 0:
        return int(rng)
    raise SettingsError(
        f"{argument.rng}: found {rng!r}, expected a whole number >= 0, a SeedSequence or a Generator"
    )


def random_stream(seed: int, kind: int, number: int) -> np.random.Generator:
    """Return the stream of a number, one of many of a kind that do not depend on each other."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(kind, number))))
