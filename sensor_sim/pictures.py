"""What a sensor does, to look at: its transfer functions, and one trial stage by stage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sensor_sim.sampling import sample_image
from sensor_sim.sensor import Detector, Sensor
from sensor_sim.simulate import SimulatedTrial, Simulator
from todframes._typing import FloatArray, Json
from todframes.frames.contrast import Patch
from todframes.frames.files import write_frame
from todframes.observers.interface import Observer
from todframes.observers.retina import resample
from todframes.report.wording import evenly
from todframes.stimulus import Orientation, Stimulus, bounding_box_offset, coverage

if TYPE_CHECKING:
    pass


FINE_PIXELS_PER_DETECTOR = 8


def trial_stages(sensor: Sensor, trial: SimulatedTrial, *, seed: int) -> dict[str, FloatArray]:
    """One trial at each stage of Figure 1 of the paper, as signal (a large triangle is 1).

    Returns
    -------
    dict of ndarray
        "a_input", "b_optics" and "c_detector_response" on a scene grid of 8 pixels a detector; "d_samples" and
        "e_noise" one pixel a detector; "f_hold" and "g_display" on the display's pixels.

    Hogervorst et al. 2001, Figure 1.
    """
    simulator = Simulator(sensor, trial.size_detectors, seed=seed)
    ((x, y),), (samples,) = simulator.samples([trial], noise=False)
    _, (noisy,) = simulator.samples([trial])
    (frame,) = simulator.frames([trial])
    per_detector, field = sensor.display.pixels_per_detector, simulator.field
    fine, n_fine = FINE_PIXELS_PER_DETECTOR, FINE_PIXELS_PER_DETECTOR * field
    pitch_mrad = sensor.detector.pitch_mrad / fine
    scene = coverage(
        (n_fine, n_fine),
        size_px=trial.size_detectors * fine,
        x_px=(x + field / 2.0) * fine - 0.5,
        y_px=(y + field / 2.0) * fine - 0.5,
        orientation=trial.orientation,
    )

    def seen_through(width_mrad: float) -> FloatArray:
        """The scene behind the optics, averaged over a width at every fine pixel."""
        detector = Detector(pitch_mrad=pitch_mrad, width_mrad=min(width_mrad, pitch_mrad))
        image = sample_image(
            scene, pixel_pitch_mrad=pitch_mrad, optics=sensor.optics, detector=detector, field_detectors=n_fine
        )
        if width_mrad <= pitch_mrad:
            return image
        frequency = np.fft.fftfreq(n_fine, pitch_mrad)
        box = np.sinc(frequency * width_mrad)
        half = np.fft.rfft2(image) * box[:, None] * box[: n_fine // 2 + 1]
        return np.asarray(np.fft.irfft2(half, s=image.shape))

    contrast = frame.luminance_cd_m2 / sensor.display.background_luminance_cd_m2 - 1.0
    return {
        "a_input": scene,
        "b_optics": seen_through(pitch_mrad),
        "c_detector_response": seen_through(sensor.detector.width_mrad),
        "d_samples": samples,
        "e_noise": noisy,
        "f_hold": np.kron(noisy, np.ones((per_detector, per_detector))),
        "g_display": contrast / sensor.display.gain,
    }


def threshold_examples(sensor: Sensor, observer: Observer, fits: Sequence[Json], *, seed: int) -> list[Json]:
    """A simulated frame at threshold, as displayed and as the observer sees it, of sizes that have a threshold.

    Parameters
    ----------
    fits : sequence of dict
        As in `result.json`, with levels in SNR and grouped by size_detectors.
    """
    from todframes.report.examples import MOST_EXAMPLES

    known = [fit for fit in fits if fit["threshold"] is not None]
    return [_threshold_example(sensor, observer, fit, seed) for fit in evenly(known, MOST_EXAMPLES)]


def _threshold_example(sensor: Sensor, observer: Observer, fit: Json, seed: int) -> Json:
    from todframes.report.examples import FramePart, pictures

    size, pitch_mrad = fit["group"]["size_detectors"], sensor.display.pixel_pitch_mrad
    trial = SimulatedTrial((0, 0, 0), size, fit["threshold"], Orientation.UP)
    (frame,) = Simulator(sensor, size, seed=seed).frames([trial])
    contrast = frame.luminance_cd_m2 / sensor.display.background_luminance_cd_m2 - 1.0
    stimulus = Stimulus(size * sensor.display.detector_pitch_mrad)
    dx, dy = bounding_box_offset(trial.orientation) if observer.centre == "bounding_box" else (0.0, 0.0)
    size_px = size * sensor.display.pixels_per_detector
    retina = resample(
        contrast,
        observer.grid(stimulus),
        x_px=frame.x_px + dx * size_px,
        y_px=frame.y_px + dy * size_px,
        pixel_pitch_mrad=pitch_mrad,
    )
    return {
        "group": fit["group"],
        "level": fit["level"],
        "strength": trial.snr,
        "orientation": trial.orientation.value,
        **pictures(
            [FramePart(Patch(contrast, 0, 0, 0), frame.x_px, frame.y_px)],
            retina,
            observer=observer,
            stimulus=stimulus,
            pixel_pitch_mrad=pitch_mrad,
        ),
    }


def write_stages(folder: Path, sensor: Sensor, trial: SimulatedTrial, *, seed: int) -> None:
    """Write these stages as 8-bit PNG, black at −1 and white at 2 times a large triangle's signal."""
    folder.mkdir()
    for name, image in trial_stages(sensor, trial, seed=seed).items():
        grey = np.clip((image + 1.0) / 3.0, 0.0, 1.0)
        write_frame(folder / f"{name}.png", grey, pixel_type="uint8")
