"""The argument `rng` of calls, as in SPEC 7 of Scientific Python, and the random streams that a seed has."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument

STREAMS_AT_ONCE = 256
"""Number of streams whose first numbers are computed at a time."""

Rng = int | np.integer[Any] | np.random.SeedSequence | np.random.Generator


def seed_of(rng: object) -> int:
    """Return the seed that `rng` is or gives; a generator is advanced by one draw.

    Raises
    ------
    SettingsError
        If it gives none, or is below zero.
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


def first_uniforms(seed: int, kind: int, number: int) -> FloatArray:
    """Return the first two numbers in [0, 1) of `random_stream`, (2,), in a fifth of the time or less.

    They are computed for many streams at once, the number below 2³².
    """
    block, place = divmod(number, STREAMS_AT_ONCE)
    return np.asarray(_first_uniforms(seed, kind, block)[place])


# Algorithms and constants of NumPy's SeedSequence (after O'Neill's seed_seq_fe) and of PCG64 (PCG XSL RR 128/64,
# O'Neill 2014), whose numbers NumPy keeps from version to version.
_POOL_FACTOR, _STATE_FACTOR = (0x43B0D7E5, 0x931E8875), (0x8B51F9DD, 0x58F38DED)
_MIX_LEFT, _MIX_RIGHT = 0xCA01F9DD, 0x4973F715
_SHIFT = np.uint32(16)
_STEP = 0x2360ED051FC65DA44385DF649FCCF645
_32_BITS, _64_BITS, _128_BITS = ((1 << bits) - 1 for bits in (32, 64, 128))


@lru_cache(maxsize=4096)
def _first_uniforms(seed: int, kind: int, block: int) -> FloatArray:
    numbers = np.arange(block * STREAMS_AT_ONCE, (block + 1) * STREAMS_AT_ONCE, dtype=np.uint32)
    # The words before the number are in the pool already: four hashes were taken for each.
    n_words = max(-(-seed.bit_length() // 32), 4) + 1
    factor = _POOL_FACTOR[0] * pow(_POOL_FACTOR[1], 4 * n_words, 1 << 32) & _32_BITS
    pool = []
    for word in np.random.SeedSequence(seed, spawn_key=(kind,)).pool.tolist():
        hashed, factor = _hashed(numbers, factor, _POOL_FACTOR[1])
        mixed = np.uint32(word * _MIX_LEFT & _32_BITS) - hashed * np.uint32(_MIX_RIGHT)
        pool.append(mixed ^ mixed >> _SHIFT)
    words, factor = [], _STATE_FACTOR[0]
    for k in range(8):
        hashed, factor = _hashed(pool[k % 4], factor, _STATE_FACTOR[1])
        words.append(hashed.tolist())
    found = np.array([_two_uniforms(*of_stream) for of_stream in zip(*words, strict=True)])
    found.flags.writeable = False
    return found


def _hashed(values: NDArray[np.uint32], factor: int, next_factor: int) -> tuple[NDArray[np.uint32], int]:
    """Return the hashes of words, and the factor of the next hash."""
    following = factor * next_factor & _32_BITS
    hashed = (values ^ np.uint32(factor)) * np.uint32(following)
    return hashed ^ hashed >> _SHIFT, following


def _two_uniforms(*words: int) -> tuple[float, float]:
    """Return the first two numbers of a PCG64 that is seeded by eight words, the lower half of each pair first."""
    start_high, start_low, added_high, added_low = (
        low | high << 32 for low, high in zip(words[::2], words[1::2], strict=True)
    )
    added = ((added_high << 64 | added_low) << 1 | 1) & _128_BITS
    state = added + (start_high << 64 | start_low)
    found = []
    for n in range(3):
        state = (state * _STEP + added) & _128_BITS
        if n:  # the first step is part of seeding
            bits, turned = (state >> 64 ^ state) & _64_BITS, state >> 122
            found.append(((bits >> turned | bits << 64 - turned) & _64_BITS) >> 11)
    return found[0] * 2.0**-53, found[1] * 2.0**-53
