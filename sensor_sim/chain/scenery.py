"""Scenes in front of a sensor: windows of images, their turns, and their samples by the sensor's detectors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.reconstruction import display_position_px, display_signal
from sensor_sim.chain.sampling import field_detectors, sample_image
from sensor_sim.chain.transfer import blur_mrad
from todframes.backdrops.views import (
    TURNS,
    Background,
    Layout,
    PlannedTrial,
    balanced,
    draw_backgrounds,
    local_luminance,
    open_scenes,
    plan,
    turned,
    turned_place,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.display.display import Display, SensorDisplay
from todframes.parameters import PathLike

SCENE_STREAM = 2
"""First element of the spawn keys of the random streams of scenes; those of trials and patterns have others."""

MARGIN_DETECTORS = 4
"""Detectors of a window beyond the field on each side, beside three standard deviations of the optics' blur."""

MOST_PIXELS_PER_DETECTOR = 64
"""Largest number of pixels of an image along a detector."""


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """The backgrounds of a simulation, by size of the triangle in detectors, and their turns. Their luminance is
    relative; `pixels_per_detector` are those of the images.
    """

    camera: Camera
    display: SensorDisplay
    backgrounds: dict[float, tuple[Background, ...]]
    pixels_per_detector: float
    turns: tuple[str, ...]
    seed: int

    @classmethod
    def opened(
        cls,
        camera: Camera,
        display: SensorDisplay,
        paths: PathLike | Sequence[PathLike],
        sizes_detectors: Sequence[float],
        *,
        pixels_per_detector: float,
        value_range: tuple[float, float] | None,
        turns: int,
        seed: int,
        farthest_detectors: float = 0.0,
        note: Callable[[str], None],
    ) -> Scenery:
        """Decode images and draw a window of each for each size. Pictures are taken to be sRGB; with a range,
        values are proportional to light. `farthest_detectors` is how far a triangle moves from the middle of its
        field. DataError or FrameError if an image cannot be read, or all are too small, even or saturated; some of
        these are left out.
        """
        if not 1.0 <= pixels_per_detector <= MOST_PIXELS_PER_DETECTOR:
            raise SettingsError(
                f"{argument.background_pixels}: found {pixels_per_detector:g}, expected 1 to "
                f"{MOST_PIXELS_PER_DETECTOR} pixels along a detector"
            )
        image = Display(
            eotf="srgb" if value_range is None else "linear",
            background_luminance_cd_m2="column",
            pixel_pitch_mrad=1.0,
        )
        margin = math.ceil(3.0 * blur_mrad(camera) / camera.pitch_mrad)
        layouts = []
        for size in sizes_detectors:
            side = field_detectors(camera, size)
            side += 2 * (margin + MARGIN_DETECTORS + math.ceil(farthest_detectors))
            reach = math.ceil(side * pixels_per_detector / 2.0)
            layouts.append(Layout(size * pixels_per_detector, reach))
        drawn = draw_backgrounds(
            open_scenes(paths, value_range=value_range, range_name="background_range", note=note),
            image,
            layouts,
            seed=seed,
            stream=SCENE_STREAM,
            range_name="background_range",
            note=note,
        )
        backgrounds = {size: tuple(windows) for size, windows in zip(sizes_detectors, drawn, strict=True)}
        return cls(camera, display, backgrounds, pixels_per_detector, TURNS[:turns], seed)

    def plan(self, size_detectors: float, n_levels: int, trials: int) -> list[PlannedTrial]:
        """Plan the trials of one size, level by level."""
        return plan(len(self.backgrounds[size_detectors]), self.turns, n_levels, trials)

    @property
    def balanced(self) -> int:
        """Number of trials of a size and level after which turns and orientations are balanced."""
        return balanced(len(next(iter(self.backgrounds.values()))), self.turns)

    def place(self, size_detectors: float, background: int, turn: str) -> tuple[float, float]:
        """Return the place of triangle and scene on the detectors, (x, y) from the middle of the field."""
        number = list(self.backgrounds).index(size_detectors)
        key = (SCENE_STREAM, background, number, 1)
        x, y = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key)).uniform(-0.5, 0.5, 2)
        return turned_place(float(x), float(y), turn)

    def contrast(
        self, size_detectors: float, background: int, turn: str, *, field: int, matrix: FloatArray
    ) -> FloatArray:
        """Compute the contrast of a scene at the detectors, (field, field), without triangle and noise. It refers
        to the local luminance: the mean, on the display, over the circle through the triangle's corners. `matrix`
        is that of `axis_matrix`.
        """
        camera, display = self.camera, self.display
        x, y = self.place(size_detectors, background, turn)
        samples = sample_image(
            turned(self.backgrounds[size_detectors][background].luminance_cd_m2, turn),
            pixel_pitch_mrad=camera.pitch_mrad / self.pixels_per_detector,
            camera=camera,
            field_detectors=field,
            x_detectors=x,
            y_detectors=y,
        )
        x_px, y_px = (display_position_px(at, n_detectors=field, display=display) for at in (x, y))
        size_px = size_detectors * display.pixels_per_detector
        local = local_luminance(display_signal(samples, matrix), x_px, y_px, size_px)
        return np.asarray(samples / local - 1.0)

    def largest_contrast(self) -> float:
        """Return the largest contrast of all scenes before the sensor blurs them."""
        largest = 0.0
        for size, windows in self.backgrounds.items():
            for window in windows:
                middle = (len(window.luminance_cd_m2) - 1) / 2.0
                local = local_luminance(window.luminance_cd_m2, middle, middle, size * self.pixels_per_detector)
                largest = max(largest, float(window.luminance_cd_m2.max()) / local - 1.0)
        return largest


# First element of the spawn keys of random streams.
