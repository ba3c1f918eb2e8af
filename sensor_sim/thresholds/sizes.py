"""Sizes of triangles for a sensor: those asked for, as angles or in detectors, or those that suit it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.sampling import field_detectors, field_sampler
from sensor_sim.thresholds.curve_plan import coarse_plan
from sensor_sim.thresholds.predict import FoldedChain
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import distinct_numbers
from todframes.observers.interface import Observer
from todframes.stimulus import Stimulus

LADDER_DETECTORS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 24.0, 32.0)
"""Sizes from which those of a sensor are chosen: the smallest one that has a threshold, and the next ones."""

SIZES_CHOSEN = 5
"""Number of sizes that are chosen."""

ACUITY_STEP = 1.02
"""Factor between the smallest size that reaches a criterion and the next one that does not."""

CLOSE = 0.01
"""Distance of P(correct) from a criterion within which the coarse plan does not decide: 30 times its bound."""


def computed_sizes(camera: Camera, observer: Observer) -> Iterator[float]:
    """Yield the sizes of the ladder that are not too large for the sensor's field and the observer's retina."""
    for size in LADDER_DETECTORS:
        try:
            field_detectors(camera, size)
            observer.grid(Stimulus(size * camera.shown_pitch_mrad))
        except SettingsError:
            if size == LADDER_DETECTORS[0]:
                raise
            return
        yield size


def smallest_size(camera: Camera, observer: Observer, *, p_correct: float = 0.75, seed: int = 1) -> float | None:
    """Return the smallest size of the ladder at which the observer reaches a criterion; None if there is none."""
    for size in computed_sizes(camera, observer):
        if _is_reached(camera, observer, size, p_correct=p_correct, seed=seed):
            return size
    return None


def acuity_detectors(
    camera: Camera, observer: Observer, *, p_correct: float, seed: int
) -> tuple[float, float | None] | None:
    """Return the smallest size at which the observer reaches a criterion, and the largest below it, within
    `ACUITY_STEP`, at which it does not, or None if that is below the ladder. None if it reaches it at no size.
    """
    reached = smallest_size(camera, observer, p_correct=p_correct, seed=seed)
    if reached is None or reached == LADDER_DETECTORS[0]:
        return None if reached is None else (reached, None)
    unreached = LADDER_DETECTORS[LADDER_DETECTORS.index(reached) - 1]
    while reached > ACUITY_STEP * unreached:
        middle = float(f"{math.sqrt(reached * unreached):.4g}")
        if _is_reached(camera, observer, middle, p_correct=p_correct, seed=seed):
            reached = middle
        else:
            unreached = middle
    return reached, unreached


def _is_reached(camera: Camera, observer: Observer, size: float, *, p_correct: float, seed: int) -> bool:
    """Return whether a criterion is reached at a size. The coarse plan takes a small part of the time and memory
    of the exact one, and decides unless P(correct) is close to the criterion.
    """
    coarse = FoldedChain(camera, observer, size, coarse_plan(camera, observer, size))
    if coarse.unreached(p_correct - CLOSE, seed) is not None:
        return False
    if coarse.unreached(p_correct + CLOSE, seed) is None:
        return True
    return FoldedChain(camera, observer, size).unreached(p_correct, seed) is None


def chosen_sizes(camera: Camera, observer: Observer, smallest: float | None) -> list[float]:
    """Return the sizes, in detectors, that suit a sensor: its `smallest_size` and the next ones of the ladder; the
    largest ones if none has a threshold.
    """
    sizes = list(computed_sizes(camera, observer))
    return sizes[-SIZES_CHOSEN:] if smallest is None else sizes[sizes.index(smallest) :][:SIZES_CHOSEN]


def given_sizes(camera: Camera, size_detectors: Sequence[float], size_mrad: Sequence[float]) -> list[float]:
    """Return the sizes that are asked for, in detectors; empty if none are. SettingsError if angles are given too,
    a size is not a positive number or is there twice, or an angle is too large to compute.
    """
    if len(size_detectors) and len(size_mrad):
        both = f"{argument.size_detectors} and {argument.size_mrad}"
        raise SettingsError(f"found {both}, expected one of them, or none for sizes that suit the sensor")
    if len(size_mrad):
        return [_in_detectors(angle, camera) for angle in distinct_numbers(argument.size_mrad, size_mrad)]
    return distinct_numbers(argument.size_detectors, size_detectors) if len(size_detectors) else []


def _in_detectors(size_mrad: float, camera: Camera) -> float:
    size = float(f"{size_mrad / camera.pitch_mrad:.6g}")
    try:
        field_sampler(camera, size)
    except SettingsError as error:
        start = f"{argument.size_detectors}: found {size:g}, "
        if not str(error).startswith(start):
            raise
        found = f"{argument.size_mrad}: found {size_mrad:g}, {size:g} detectors, "
        raise SettingsError(found + str(error).removeprefix(start)) from None
    return size
