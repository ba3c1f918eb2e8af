"""The paper's literal Monte Carlo behind a sensor: frames drawn, displayed and answered one by one.

Hogervorst et al. 2001, sections 3 to 5.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sensor_sim.noise import draw
from sensor_sim.reconstruction import axis_matrix, display_position_px, display_signal, luminance_cd_m2
from sensor_sim.sampling import field_detectors, field_sampler
from sensor_sim.sensor import Sensor
from todframes.observer import PyramidObserver
from todframes.readout import Stimulus
from todframes.retina import resample
from todframes.stimulus import ORIENTATIONS

FloatArray = NDArray[np.float64]

AT_ONCE = 32
"""Frames whose samples are made together, which costs less."""


def literal_answers(
    sensor: Sensor, size_detectors: float, *, snr: float, contrast: float = 1.0
) -> Callable[[int, np.random.Generator], FloatArray]:
    """What draws trials of random orientation and place, with noise on every detector and every neuron.

    Parameters
    ----------
    sensor : Sensor
        All of its noise is new in each trial, the share of the fixed pattern too.
    size_detectors : float
        √(area) of the triangle, > 0.
    snr : float
        Signal of a large triangle over the standard deviation of the detector noise; infinity: there is none.
    contrast : float
        Of the triangle, in units of what the display's gain gives it.

    Returns
    -------
    callable
        `answers(n, rng)`: 1 for a right and 0 for a wrong answer, (n, 1).

    Raises
    ------
    SettingsError
        If the size or field is out of range.
    """
    display, observer = sensor.display, PyramidObserver()
    stimulus = Stimulus(size_detectors * display.detector_pitch_mrad)
    observer.templates(stimulus)
    grid, field = observer.grid(stimulus), field_detectors(sensor, size_detectors)
    sampler = field_sampler(sensor, size_detectors)
    hold = axis_matrix(field, display=display, electronics=sensor.electronics)
    jitter_px = observer.position_jitter_samples * grid.pitch_mrad / display.pixel_pitch_mrad

    def some(n: int, rng: np.random.Generator) -> FloatArray:
        orientations = rng.integers(4, size=n)
        places = rng.uniform(-0.5, 0.5, (n, 2))
        samples = np.empty((n, field, field))
        for orientation in ORIENTATIONS:
            these = orientations == orientation.quarter_turns
            samples[these] = sampler.samples(*places[these].T, orientation=orientation)
        samples *= contrast
        samples += draw(samples.shape, sd=contrast / snr, distribution=sensor.noise.distribution, rng=rng)
        jitter = jitter_px * rng.uniform(-1.0, 1.0, (n, 2))
        right = np.empty((n, 1))
        for trial in range(n):
            x_px, y_px = (
                display_position_px(at, n_detectors=field, display=display) + by
                for at, by in zip(places[trial].tolist(), jitter[trial].tolist(), strict=True)
            )
            luminance = luminance_cd_m2(display_signal(samples[trial], hold), display=display)
            seen = resample(
                luminance / display.background_luminance_cd_m2 - 1.0,
                grid,
                x_px=x_px,
                y_px=y_px,
                pixel_pitch_mrad=display.pixel_pitch_mrad,
            )
            right[trial] = observer.respond(seen, stimulus, rng).quarter_turns == orientations[trial]
        return right

    def answers(n: int, rng: np.random.Generator) -> FloatArray:
        return np.concatenate([some(min(AT_ONCE, n - start), rng) for start in range(0, n, AT_ONCE)])

    return answers
