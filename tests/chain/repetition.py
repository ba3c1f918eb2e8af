"""Bounds on what the repetition of a scene changes, which the computed samples are held against."""

from __future__ import annotations

import math

import numpy as np

from sensor_sim.chain.camera import ModelledOptics
from sensor_sim.chain.sampling import TriangleSampler
from todframes.stimulus import HEIGHT_PER_SIZE


def wrap_around_bound(sampler: TriangleSampler) -> float:
    """Return a bound on the difference of a sample from that of a single triangle near the middle.

    It holds within half a detector, and falls with the cube of the period. It is 0 if the optics are left out,
    because nothing is repeated then.
    """
    if sampler.sharp:
        return 0.0
    pitch = sampler._camera.pitch_mrad
    return repetition_bound(
        sampler._camera.optics,
        area_mrad2=(sampler._size * pitch) ** 2,
        reach_mrad=2.0 / 3.0 * HEIGHT_PER_SIZE * sampler._size * pitch + sampler._camera.width_mrad,
        field_mrad=sampler._whole_field * pitch,
        period_mrad=sampler.period * pitch,
    )


def repetition_bound(
    optics: ModelledOptics, *, area_mrad2: float, reach_mrad: float, field_mrad: float, period_mrad: float
) -> float:
    """Return a bound on the change that repeating a scene within [0, 1] makes to its image after the optics.

    By J₁(v)² <= 2/(πv)·(1 + 3/(8v²)) (Watson 1944, section 13.75) the Airy pattern at distance r is below
    2/(π³cr³)·(1 + 3/(8(πcr)²)), c the cut-off. A repetition, moved nearer by its reach and seven standard
    deviations of the Gaussian, adds at most its area times that.

    `area_mrad2` is that of the repeated part of the scene, `reach_mrad` the distance from the scene's place to its
    end plus the detector's width. The bound holds in a square of side `field_mrad` around that place.
    """
    cut_off = optics.cut_off_cyc_per_mrad
    repetition = np.abs(np.arange(-8, 9))
    gap = np.maximum(repetition * period_mrad - field_mrad / 2.0, 0.0)
    distance = np.hypot(gap[:, None], gap)[np.maximum.outer(repetition, repetition) > 0]
    distance -= reach_mrad + 7.0 * optics.blur_sigma_mrad
    nearest = float(distance.min())
    if nearest <= 0.0:
        return 1.0
    # Rings m > 8 of 8 m repetitions each, at (m − 1) periods or more: Σ 8 m / (m − 1)³ < 1.3.
    lattice_sum = float((1.0 / distance**3).sum()) + 1.3 / period_mrad**3
    tail = 2.0 / (math.pi**3 * cut_off) * (1.0 + 0.375 / (math.pi * cut_off * nearest) ** 2)
    beyond_seven_sigma = 3e-11 if optics.blur_sigma_mrad > 0.0 else 0.0
    return min(1.0, area_mrad2 * tail * lattice_sum + beyond_seven_sigma)
