"""Stability cases of the other observers, of unknown places, of ranges in the field and of scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from todframes.backdrops.views import TURNS, local_luminance, own_orientation, turned, turned_place
from todframes.field.acquisition import first_range
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.field.threshold_curve import ThresholdCurve
from todframes.observers.csf import CsfObserver, CsfSettings
from todframes.observers.hotelling import HotellingObserver, HotellingSettings
from todframes.observers.interface import Observer
from todframes.observers.oriented import OrientedObserver, OrientedSettings
from todframes.observers.unknown_place import correct_at_unknown_place
from todframes.scoring.naked_eye import proportion_correct
from todframes.studies.stability.case import MPMATH, Case, refusal

PLACES, D_PRIME = (2, 100, 4000), 4.0

SHARP, OF_SAMPLES = OrientedSettings(), HotellingSettings(presample_blur_mrad=0.5, sample_pitch_mrad=1.0)

EXTINCTIONS, SIZE_M, K = (1e-3, 1.0, 100.0), 2.3, 8.0


def seen(observer: Observer, contrast: float, size_mrad: float = 2.0) -> float:
    """Compute P(correct) of the naked eye."""
    return proportion_correct(observer, size_mrad=size_mrad, contrast=contrast, nodes=4)


def at_places(places: int, d_prime: float) -> float:
    """Compute P(correct) of four independent scores a place, of which one has a mean of d′."""
    return float(correct_at_unknown_place(d_prime * np.eye(4)[0], np.eye(4), 0, empty_places=places - 1))


def range_km(extinction_per_km: float) -> float | None:
    """Compute the range of a target of 2 K whose threshold is 0.01 K times e for each 1/mrad."""
    per_mrad = np.array([0.01, 20.0])
    curve = ThresholdCurve(
        pattern="triangle",
        quantity="delta_t_k",
        per_mrad=per_mrad,
        threshold=0.01 * np.exp(per_mrad),
        p_correct=0.75,
    )
    target = Target(size_m=SIZE_M, delta_t_k=2.0, k={"seen": K})
    return first_range(curve, target, Atmosphere(extinction_per_km=extinction_per_km)).range_km


def turned_corner() -> list[float]:
    """Look up the last of 4,096 pixels of a line after each turn."""
    line = (np.arange(4096) == 4095).astype(float)[None]
    found = []
    for turn in TURNS:
        shown, (x, y) = turned(line, turn), turned_place(2047.5, 0.0, turn)
        rows, columns = shown.shape
        found.append(float(shown[round(y + (rows - 1) / 2), round(x + (columns - 1) / 2)]))
    return found


def observer_cases() -> list[Case]:
    """List the cases of `csf`, `oriented` and `informative`, and of places."""

    def ratios(*pairs: tuple[Observer, float], usual: tuple[Observer, float]) -> list[float]:
        return [seen(*pair) / seen(*usual) for pair in pairs]

    def of_noise(kind: Any, settings: Any) -> list[float]:
        pairs = [(kind(replace(settings, internal_noise=0.5 * n)), 0.1 * n) for n in (1e-9, 1e9)]
        return ratios(*pairs, usual=(kind(settings), 0.1))

    def of_efficiency() -> list[float]:
        pairs = [(CsfObserver(CsfSettings(efficiency=n)), 0.05 / math.sqrt(n)) for n in (1e-6, 1e6)]
        return ratios(*pairs, usual=(CsfObserver(), 0.05))

    in_proportion = "law: contrast over internal noise decides"
    noise = "internal noise 1e-9 and 1e9, contrast in proportion: P(correct), ratio"
    return [
        Case("csf", "efficiency 1e-6 and 1e6, contrast ∝ 1/√efficiency: P(correct), ratio", [1.0] * 2,
             "law: d′ is proportional to contrast · √efficiency", of_efficiency, 9),
        Case("csf", "contrast 1e-9 and 1e9: P(correct)", [0.25, 1.0], "chance, and the largest",
             lambda: [seen(CsfObserver(), contrast) for contrast in (1e-9, 1e9)], 6),
        Case("csf", "0.01 cd/m²", "refused", "people were measured from 0.02 on",
             lambda: refusal(lambda: CsfSettings(luminance_cd_m2=0.01), "luminance_cd_m2: found 0.01")),
        Case("oriented", f"oriented, {noise}", [1.0] * 2, in_proportion,
             partial(of_noise, OrientedObserver, SHARP), 9),
        Case("oriented", "0.5 retina samples, contrast 1e9: P(correct)", 0.25, "four identical templates",
             lambda: seen(OrientedObserver(replace(SHARP, position_jitter_samples=0.0)), 1e9, 0.5 * 0.153), 12),
        Case("informative", f"informative, {noise}", [1.0] * 2, in_proportion,
             partial(of_noise, HotellingObserver, OF_SAMPLES), 9),
        Case("places", "2, 100 and 4,000 places, no signal: P(correct)", [0.25] * 3, "symmetry",
             lambda: [at_places(places, 0.0) for places in PLACES], 9),
        Case("places", "2, 100 and 4,000 places, d′ 4: P(correct)",
             [0.9883007120705496, 0.8747375794094622, 0.6358052866839363],
             MPMATH + "the integral over the largest score",
             lambda: [at_places(n, D_PRIME) for n in PLACES], 7),
        Case("places", "4,000 places, d′ 1e3: P(correct)", 1.0, "the largest wins",
             lambda: at_places(4000, 1e3), 9),
    ]  # fmt: skip


def field_cases() -> list[Case]:
    """List the cases of ranges and scenes."""
    in_air = [math.log(2.0 / 0.01) / (extinction + K / SIZE_M) for extinction in EXTINCTIONS]
    even = {n: np.full((64, 64), n) for n in (1e-12, 1e12)}
    return [
        Case("range", "extinction 1e-3 to 100 per km: range", in_air,
             "closed form: where two straight lines meet",
             lambda: [range_km(one) or 0.0 for one in EXTINCTIONS], 6),
        Case("range", "extinction 1e3 per km", "refused", "at most 100: a unit is wrong",
             lambda: refusal(lambda: range_km(1e3), "extinction_per_km: found 1000")),
        Case("scenes", "eight turns of a line of 4,096 pixels: its end", [1.0] * 8, "law: a turn moves each pixel",
             turned_corner, 15),
        Case("scenes", "even scenes of 1e-12 and 1e12 cd/m²: local luminance, ratio", [1.0] * 2,
             "law: a mean of equals",
             lambda: [local_luminance(image, 31.5, 31.5, 12.0) / n for n, image in even.items()], 12),
        Case("scenes", "even scenes of 1e-12 and 1e12 cd/m²: own orientation", [0.0] * 8, "law: it has none",
             lambda: np.ravel([own_orientation(image, 31.5, 31.5, 12.0) for image in even.values()]), 12, 1.0),
    ]  # fmt: skip
