"""Simulation of trials as they are displayed.

Hogervorst et al. 2001, sections 3 and 5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sensor_sim.chain.detector_noise import displayed_noise, unit_fixed_pattern
from sensor_sim.chain.photons import PhotonCamera
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal, luminance_cd_m2
from sensor_sim.chain.sampling import field_detectors, field_sampler
from sensor_sim.chain.sensor import Sensor
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.stimulus import ORIENTATIONS, Orientation

if TYPE_CHECKING:
    from sensor_sim.chain.scenery import Scenery

# First element of the spawn keys of random streams.
TRIAL_STREAMS, PATTERN_STREAM = 0, 1

MOST_SCENES_HELD = 64
"""Number of turned scenes whose samples are held."""

LARGEST_SIDE_PX = 11_585
"""Largest side of square frames of two bytes a pixel that `todframes` reads: they take 256 MB."""


class SimulatedTrial(NamedTuple):
    """A presentation: size, level and orientation of the triangle. `key` seeds its random stream.

    `level` is a signal-to-noise ratio, or a contrast for a camera that counts photons. `background` is the number
    of the scene's window, and `turn` how it is turned; None: an even background.
    """

    key: tuple[int, int, int]
    size_detectors: float
    level: float
    orientation: Orientation
    background: int | None = None
    turn: str = ""


class SimulatedFrame(NamedTuple):
    """A trial as displayed: luminance in cd/m², and the position of the triangle's centroid on the display."""

    luminance_cd_m2: FloatArray
    x_px: float
    y_px: float


def plan_trials(
    sizes_detectors: Sequence[float], levels: Sequence[float], trials: int, level_name: str = "snr"
) -> list[SimulatedTrial]:
    """Plan `trials` presentations of each size at each level, with the orientations in turn.

    Raises
    ------
    SettingsError
        If a list is empty, a value is not a positive number or occurs twice, or there are no trials.
    """
    for name, values in (("size_detectors", sizes_detectors), (level_name, levels)):
        if not values:
            raise SettingsError(f"{name}: found no values, expected at least one")
        for value in values:
            if not 1e-6 <= value <= 1e9:
                raise SettingsError(f"{name}: found {value!r}, expected a finite number > 0, from 1e-06 to 1e+09")
        if len(set(values)) < len(values):
            raise SettingsError(f"{name}: found a value twice in {', '.join(f'{v:g}' for v in values)}")
    if trials < 1:
        raise SettingsError(f"trials: found {trials}, expected at least 1")
    return [
        SimulatedTrial((i, j, n), size, level, ORIENTATIONS[n % 4])
        for i, size in enumerate(sizes_detectors)
        for j, level in enumerate(levels)
        for n in range(trials)
    ]


def plan_on_scenes(planned: Sequence[SimulatedTrial], scenery: Scenery) -> list[SimulatedTrial]:
    """Return the same numbers of presentations of each size and level, on scenes in their turns."""
    found = []
    sizes: dict[float, dict[int, float]] = {}
    for trial in planned:
        sizes.setdefault(trial.size_detectors, {})[trial.key[1]] = trial.level
    for i, (size, levels) in enumerate(sizes.items()):
        trials = len(planned) // len(sizes) // len(levels)
        for one in scenery.plan(size, len(levels), trials):
            key = i, one.level, one.number
            found.append(SimulatedTrial(key, size, levels[one.level], one.orientation, one.background, one.turn))
    return found


class Simulator:
    """Source of frames of one sensor for triangles of one size, in any order.

    Each trial draws from its own random stream, so a frame depends on the seed and its trial alone. The fixed
    pattern is drawn once: the seed stands for the sensor.

    Parameters
    ----------
    sensor : Sensor
    size_detectors : float
        √(area) of the triangle, > 0.
    seed : int
    scenery : Scenery or None
        Scenes behind the triangles; None: an even background.

    Raises
    ------
    SettingsError
        If the optics pass too little or too much for the field, or its frame has more pixels than may be read.
    """

    def __init__(
        self, sensor: Sensor, size_detectors: float, *, seed: int, scenery: Scenery | None = None
    ) -> None:
        self.sensor = sensor
        self.size_detectors, self.scenery = size_detectors, scenery
        self._scene = lru_cache(maxsize=MOST_SCENES_HELD)(self._scene_signal)
        self.seed = seed
        self.field = field_detectors(sensor, size_detectors)
        per_detector = sensor.display.pixels_per_detector
        side = self.field * per_detector
        if side > LARGEST_SIDE_PX:
            raise SettingsError(
                f"pixels_per_detector: found {per_detector}, for a triangle of {size_detectors:g} detectors a "
                f"frame of {side} × {side} pixels, expected at most {LARGEST_SIDE_PX} × {LARGEST_SIDE_PX}"
            )
        self.sampler = field_sampler(sensor, size_detectors)
        self.matrix = axis_matrix(self.field, display=sensor.display, electronics=sensor.electronics)
        pattern_seed = np.random.SeedSequence(seed, spawn_key=(PATTERN_STREAM,))
        self.camera = PhotonCamera(sensor, self.field, seed=pattern_seed) if sensor.photons is not None else None
        self.pattern = unit_fixed_pattern((self.field,) * 2, noise=sensor.noise, seed=pattern_seed)

    def frames(self, trials: Sequence[SimulatedTrial]) -> Iterator[SimulatedFrame]:
        """Yield the trials as displayed, in their order."""
        display = self.sensor.display
        for (x, y), samples in zip(*self.samples(trials), strict=True):
            x_px, y_px = (display_position_px(at, n_detectors=self.field, display=display) for at in (x, y))
            luminance = luminance_cd_m2(display_signal(samples, self.matrix), display=display)
            yield SimulatedFrame(luminance, x_px, y_px)

    def samples(self, trials: Sequence[SimulatedTrial], *, noise: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return the triangles' random places on the detectors, (trial, 2), and samples, (trial, field, field).

        Samples are in units of a large triangle's signal; for a camera that counts photons they are contrasts.
        """
        rngs = [
            np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(TRIAL_STREAMS, *trial.key)))
            for trial in trials
        ]
        places = np.array([rng.uniform(-0.5, 0.5, 2) for rng in rngs])
        if self.scenery is not None:
            places = np.array([self._scene(one.background, one.turn)[0] for one in trials])
        samples = np.empty((len(trials), self.field, self.field))
        for orientation in ORIENTATIONS:
            shown = [n for n, trial in enumerate(trials) if trial.orientation is orientation]
            if shown:
                samples[shown] = self.sampler.samples(*places[shown].T, orientation=orientation)
        for trial, rng, sample in zip(trials, rngs, samples, strict=True):
            if self.camera is not None:
                sample *= trial.level
            if self.scenery is not None:
                sample += self._scene(trial.background, trial.turn)[1]
            if self.camera is not None:
                if noise:
                    sample[:] = self.camera.contrast(sample, rng)
            elif noise:
                sample += displayed_noise(
                    self.pattern, total_sd=1.0 / trial.level, noise=self.sensor.noise, rng=rng
                )
        return places, samples

    def _scene_signal(self, background: int, turn: str) -> tuple[tuple[float, float], FloatArray]:
        """Return the place of a scene and its triangle on the detectors, and the scene in units of the signal.

        Where levels are signal-to-noise ratios, the display shows the scene with its own contrast at any gain.
        """
        assert self.scenery is not None
        contrast = self.scenery.contrast(
            self.size_detectors, background, turn, field=self.field, matrix=self.matrix
        )
        unit = self.sensor.display.gain if self.camera is None else 1.0
        return self.scenery.place(self.size_detectors, background, turn), contrast / unit
