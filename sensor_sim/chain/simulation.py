"""Simulation of trials as they are displayed: a frame that stands for the eye's mean, or a clip of frames.

The background is even, or scenes: windows of images that pass optics and detectors as the triangle does. The
triangle lies on the same spot of a scene in each turn, and both together are displaced against the detectors.

Hogervorst et al. 2001, sections 3 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import PhotonCamera, displayed_noise, k_factor, unit_fixed_pattern
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal
from sensor_sim.chain.sampling import MAX_FIELD_DETECTORS, field_detectors, field_sampler
from sensor_sim.chain.sensor import Sensor
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import MOST_TRIALS, WarmUpFrames, check_whole, convert, distinct_numbers
from todframes.display.display import INTEGRATION_TIME_S
from todframes.stimulus import ORIENTATIONS, Orientation

if TYPE_CHECKING:
    from sensor_sim.chain.scenery import Scenery

# First element of the spawn keys of random streams.
TRIAL_STREAMS, PATTERN_STREAM = 0, 1

MOST_SCENES_HELD = 64
"""Number of turned scenes whose samples are held."""

LARGEST_SIDE_PX = 11_585
"""Largest side of square frames of two bytes a pixel that `todframes` reads: they take 256 MB."""

MotionSpeed = Annotated[float, Meta(ge=0.0, le=1e6)]
"""Motion of a clip in mrad/s."""


class Filming(NamedTuple):
    """The frames of a clip: the triangle's motion in the scene, and the frames that come before the trial. A trial
    has as many frames as the eye integrates, evenly in `INTEGRATION_TIME_S`.
    """

    motion_mrad_per_s: float = 0.0
    warm_up_frames: int = 0

    def checked(self) -> Filming:
        """Return itself; raise SettingsError if a value is out of range."""
        convert(self.motion_mrad_per_s, MotionSpeed, argument.motion_mrad_per_s)
        convert(self.warm_up_frames, WarmUpFrames, argument.warm_up_frames)
        return self

    def times_s(self, sensor: Sensor) -> FloatArray:
        """Return the time of each frame, the first at 0."""
        n_judged = sensor.frames_integrated
        return np.asarray(
            np.arange(self.warm_up_frames + n_judged, dtype=np.float64) * INTEGRATION_TIME_S / n_judged
        )

    def travel_detectors(self, sensor: Sensor) -> FloatArray:
        """Return the triangle's way in each frame from its mean place in the trial, in detectors."""
        times_s = self.times_s(sensor)
        from_middle = times_s - times_s[self.warm_up_frames :].mean()
        return np.asarray(from_middle * self.motion_mrad_per_s / sensor.pitch_mrad)


def of_single_frames(sensor: Sensor) -> Sensor:
    """Return a sensor whose displayed sample is one frame, not the mean of those that the eye integrates."""
    if sensor.photons is not None:
        return replace(sensor, photons=replace(sensor.photons, frames_integrated=1))
    return replace(sensor, noise=replace(sensor.noise, frames_integrated=1))


def single_frame_level(sensor: Sensor, level: float) -> float:
    """Return the level of the single frames whose mean has a given level; only an SNR differs."""
    if sensor.photons is not None:
        return level
    return level * k_factor(of_single_frames(sensor).noise) / k_factor(sensor.noise)


class SimulatedTrial(NamedTuple):
    """A presentation: size, level and orientation of the triangle. `key` seeds its random stream. `level` is a
    signal-to-noise ratio, or a contrast for a camera that counts photons. `background` is the number of the
    scene's window, and `turn` how it is turned; None: an even background.
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
    """Plan `trials` presentations of each size at each level, with the orientations in turn. SettingsError if a
    list is empty, a value is not a positive number or occurs twice, or there are no trials or too many.
    """
    for name, values in ((argument.size_detectors, sizes_detectors), (getattr(argument, level_name), levels)):
        for value in distinct_numbers(name, values):
            if not 1e-6 <= value <= 1e9:
                raise SettingsError(f"{name}: found {value!r}, expected a finite number > 0, from 1e-06 to 1e+09")
    check_whole(argument.trials, trials, 1, max(MOST_TRIALS // (len(sizes_detectors) * len(levels)), 1))
    return [
        SimulatedTrial((i, j, n), size, level, ORIENTATIONS[n % 4])
        for i, size in enumerate(sizes_detectors)
        for j, level in enumerate(levels)
        for n in range(trials)
    ]


def plan_on_scenes(planned: Sequence[SimulatedTrial], scenery: Scenery) -> list[SimulatedTrial]:
    """Return the same numbers of presentations of each size and level, on scenes in their turns."""
    planned_trials = []
    sizes: dict[float, dict[int, float]] = {}
    for trial in planned:
        sizes.setdefault(trial.size_detectors, {})[trial.key[1]] = trial.level
    for i, (size, levels) in enumerate(sizes.items()):
        trials = len(planned) // len(sizes) // len(levels)
        for view in scenery.plan(size, len(levels), trials):
            key = i, view.level, view.number
            planned_trials.append(
                SimulatedTrial(key, size, levels[view.level], view.orientation, view.background, view.turn)
            )
    return planned_trials


class Simulator:
    """Source of frames of one sensor for triangles of one size, √(area) in detectors, in any order. Each trial
    draws from its own random stream, so a frame depends on the seed and its trial alone. The fixed pattern is
    drawn once: the seed stands for the sensor. Without `scenery` the background is even; without `filming` a trial
    is one frame, as the eye averages it. SettingsError if the optics pass too little or too much for the field,
    its frame has more pixels than may be read, or the triangle moves too far.
    """

    def __init__(
        self,
        sensor: Sensor,
        size_detectors: float,
        *,
        seed: int,
        scenery: Scenery | None = None,
        filming: Filming | None = None,
    ) -> None:
        self.sensor = sensor
        self.size_detectors, self.scenery = size_detectors, scenery
        self._scene = lru_cache(maxsize=MOST_SCENES_HELD)(self._scene_signal)
        self.seed = seed
        self.filming = filming
        camera = resolve(sensor)
        self.field = field_detectors(camera, size_detectors)
        if filming is not None:
            farthest = float(np.abs(filming.travel_detectors(sensor)).max())
            if self.field + 2.0 * farthest > MAX_FIELD_DETECTORS:
                most = (MAX_FIELD_DETECTORS - self.field) / 2.0
                raise SettingsError(
                    f"{argument.motion_mrad_per_s}: moves the triangle by {farthest:.4g} detectors from its mean "
                    f"place, expected at most {most:g} for {size_detectors:g} detectors; take a slower motion or "
                    "fewer frames before the trial"
                )
            self.field += 2 * math.ceil(farthest)
        per_detector = sensor.display.pixels_per_detector
        side = self.field * per_detector
        if side > LARGEST_SIDE_PX:
            raise SettingsError(
                f"pixels_per_detector: found {per_detector}, for a triangle of {size_detectors:g} detectors a "
                f"frame of {side} × {side} pixels, expected at most {LARGEST_SIDE_PX} × {LARGEST_SIDE_PX}"
            )
        self.sampler = field_sampler(camera, size_detectors, self.field)
        self.matrix = axis_matrix(self.field, pixels_per_detector=per_detector, blur_px=camera.blurs_px)
        pattern_seed = np.random.SeedSequence(seed, spawn_key=(PATTERN_STREAM,))
        displayed = sensor if filming is None else of_single_frames(sensor)
        self.photons = (
            None if sensor.photons is None else PhotonCamera(resolve(displayed), self.field, seed=pattern_seed)
        )
        self.noise = displayed.noise
        self.pattern = unit_fixed_pattern((self.field,) * 2, noise=sensor.noise, seed=pattern_seed)

    def frames(self, trials: Sequence[SimulatedTrial]) -> Iterator[SimulatedFrame]:
        """Yield the trials as displayed, in their order."""
        for (x, y), samples in zip(*self.samples(trials), strict=True):
            yield self._displayed(samples, x, y)

    def _displayed(self, samples: FloatArray, x: float, y: float) -> SimulatedFrame:
        """Return samples as displayed, with the triangle at (x, y) in detectors from the field's middle."""
        display = self.sensor.display
        x_px, y_px = (display_position_px(at, n_detectors=self.field, display=display) for at in (x, y))
        signal = display_signal(samples, self.matrix)
        # It is not clipped, and may be negative if noise is strong.
        return SimulatedFrame(display.background_luminance_cd_m2 * (1.0 + display.gain * signal), x_px, y_px)

    def clip(self, trial: SimulatedTrial) -> list[SimulatedFrame]:
        """Return the frames of a trial's clip as displayed: those of warm-up, then those of the trial. The
        triangle moves evenly in a random direction, over a scene that stands still. Its mean place in the trial is
        that of a single frame.
        """
        assert self.filming is not None
        rng = self._rng(trial)
        middle = rng.uniform(-0.5, 0.5, 2)
        scene = None
        if self.scenery is not None:
            place, scene = self._scene(trial.background, trial.turn)
            middle = np.array(place)
        angle = rng.uniform(0.0, 2.0 * math.pi)
        travel = self.filming.travel_detectors(self.sensor)
        places = middle + travel[:, None] * (math.cos(angle), math.sin(angle))
        level, frames = single_frame_level(self.sensor, trial.level), []
        for x, y in places.tolist():
            (sample,) = self.sampler.samples(x, y, orientation=trial.orientation)
            if self.photons is not None:
                sample *= level
            if scene is not None:
                sample += scene
            self._add_noise(sample, level, rng)
            frames.append(self._displayed(sample, x, y))
        return frames

    def _rng(self, trial: SimulatedTrial) -> np.random.Generator:
        """Return the random stream of a trial."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(TRIAL_STREAMS, *trial.key)))

    def _add_noise(self, sample: FloatArray, level: float, rng: np.random.Generator) -> None:
        """Add the noise to samples: signals, or contrasts for a camera that counts photons."""
        if self.photons is not None:
            sample[:] = self.photons.contrast(sample, rng)
        else:
            sample += displayed_noise(self.pattern, total_sd=1.0 / level, noise=self.noise, rng=rng)

    def samples(self, trials: Sequence[SimulatedTrial], *, noise: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return the triangles' random places on the detectors, (trial, 2), and samples, (trial, field, field).
        Samples are in units of a large triangle's signal; for a camera that counts photons they are contrasts.
        """
        rngs = [self._rng(trial) for trial in trials]
        places = np.array([rng.uniform(-0.5, 0.5, 2) for rng in rngs])
        if self.scenery is not None:
            places = np.array([self._scene(trial.background, trial.turn)[0] for trial in trials])
        samples = np.empty((len(trials), self.field, self.field))
        for orientation in ORIENTATIONS:
            shown = [n for n, trial in enumerate(trials) if trial.orientation is orientation]
            if shown:
                samples[shown] = self.sampler.samples(*places[shown].T, orientation=orientation)
        for trial, rng, sample in zip(trials, rngs, samples, strict=True):
            if self.photons is not None:
                sample *= trial.level
            if self.scenery is not None:
                sample += self._scene(trial.background, trial.turn)[1]
            if noise:
                self._add_noise(sample, trial.level, rng)
        return places, samples

    def _scene_signal(self, background: int, turn: str) -> tuple[tuple[float, float], FloatArray]:
        """Return the place of a scene and its triangle on the detectors, and the scene in units of the signal.
        Where levels are signal-to-noise ratios, the display shows the scene with its own contrast at any gain.
        """
        assert self.scenery is not None
        contrast = self.scenery.contrast(
            self.size_detectors, background, turn, field=self.field, matrix=self.matrix
        )
        unit = self.sensor.display.gain if self.photons is None else 1.0
        return self.scenery.place(self.size_detectors, background, turn), contrast / unit
