"""Pictures of a sensor's effect: one trial stage by stage, and frames at threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sensor_sim.chain.camera import resolve_without_light
from sensor_sim.chain.sampling import sample_image
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.simulation import SimulatedTrial, Simulator
from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer
from todframes.observers.retina import resample
from todframes.results.data import Example, Fit
from todframes.results.figures import label_text, save_png, style
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import subsample
from todframes.stimulus import Orientation, Stimulus, bounding_box_offset, coverage

FINE_PIXELS_PER_DETECTOR = 8

MOST_EXAMPLES, MOST_SAMPLES = 4, 4097
"""Largest number of sizes of which a frame at threshold is drawn, and of samples along a side of its retina image:
the picture of a larger one takes as long as its threshold."""


def trial_stages(sensor: Sensor, trial: SimulatedTrial, *, seed: int) -> dict[str, FloatArray]:
    """Return one trial at each stage of Figure 1 of the paper, in units of a large triangle's signal. "a_input",
    "b_optics" and "c_detector_response" lie on a scene grid of 8 pixels a detector, "d_samples" and "e_noise" have
    one pixel a detector, "f_hold" and "g_display" the display's pixels. Hogervorst et al. 2001, Figure 1.
    """
    simulator = Simulator(sensor, trial.size_detectors, seed=seed)
    ((x, y),), (samples,) = simulator.samples([trial], noise=False)
    _, (noisy,) = simulator.samples([trial])
    (frame,) = simulator.frames([trial])
    per_detector, field = sensor.display.pixels_per_detector, simulator.field
    fine, n_fine = FINE_PIXELS_PER_DETECTOR, FINE_PIXELS_PER_DETECTOR * field
    camera = resolve_without_light(sensor)
    pitch_mrad = camera.pitch_mrad / fine
    scene = coverage(
        (n_fine, n_fine),
        size_px=trial.size_detectors * fine,
        x_px=(x + field / 2.0) * fine - 0.5,
        y_px=(y + field / 2.0) * fine - 0.5,
        orientation=trial.orientation,
    )

    def seen_through(width_mrad: float) -> FloatArray:
        """Return the scene after the optics, averaged over a width at every fine pixel."""
        width_mrad *= camera.width_mrad > 0.0  # the optics may hold it
        finer = replace(camera, pitch_mrad=pitch_mrad, width_mrad=min(width_mrad, pitch_mrad))
        image = sample_image(scene, pixel_pitch_mrad=pitch_mrad, camera=finer, field_detectors=n_fine)
        if width_mrad <= pitch_mrad:
            return image
        frequency = np.fft.fftfreq(n_fine, pitch_mrad)
        box = np.sinc(frequency * width_mrad)
        half = np.fft.rfft2(image) * box[:, None] * box[: n_fine // 2 + 1]
        return np.asarray(np.fft.irfft2(half, s=image.shape))

    contrast = frame.luminance_cd_m2 / sensor.display.background_luminance_cd_m2 - 1.0
    unit = 1.0 if sensor.photons is None else trial.level
    samples, noisy = samples / unit, noisy / unit
    return {
        "a_input": scene,
        "b_optics": seen_through(pitch_mrad),
        "c_detector_response": seen_through(camera.width_mrad),
        "d_samples": samples,
        "e_noise": noisy,
        "f_hold": np.kron(noisy, np.ones((per_detector, per_detector))),
        "g_display": contrast / sensor.display.gain / unit,
    }


def threshold_examples(
    sensor: Sensor, observer: Observer, fits: Sequence[Fit], *, seed: int
) -> tuple[Example, ...]:
    """Draw a simulated frame at threshold for some sizes, as displayed and as the observer sees it."""
    pitch_mrad = sensor.display.detector_pitch_mrad
    known = [
        fit
        for fit in fits
        if fit.threshold is not None
        and observer.grid(Stimulus(float(fit.group["size_detectors"]) * pitch_mrad)).side <= MOST_SAMPLES
    ]
    return tuple(_threshold_example(sensor, observer, fit, seed) for fit in subsample(known, MOST_EXAMPLES))


def _threshold_example(sensor: Sensor, observer: Observer, fit: Fit, seed: int) -> Example:
    size, pitch_mrad = float(fit.group["size_detectors"]), sensor.display.pixel_pitch_mrad
    assert fit.threshold is not None
    trial = SimulatedTrial((0, 0, 0), size, fit.threshold, Orientation.UP)
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
    width_mrad, drawn = pictures(
        [ExamplePatch(contrast, frame.x_px, frame.y_px)],
        retina,
        observer=observer,
        stimulus=stimulus,
        pixel_pitch_mrad=pitch_mrad,
    )
    return Example(
        group=fit.group,
        level=fit.level,
        strength=trial.level,
        orientation=trial.orientation.value,
        width_mrad=width_mrad,
        pictures=drawn,
    )


BLACK, WHITE = -1.0, 2.0
"""Signals shown as black and as white in the pictures of stages, in units of a large triangle's signal."""

STAGE_TITLES = {
    "a_input": "a. scene",
    "b_optics": "b. behind the optics",
    "c_detector_response": "c. averaged over a detector",
    "d_samples": "d. sampled",
    "e_noise": "e. with noise",
    "f_hold": "f. held",
    "g_display": "g. as displayed",
}


def write_stages(folder: Path, sensor: Sensor, trial: SimulatedTrial, *, seed: int) -> None:
    """Write each stage of a trial as an 8-bit PNG, and all stages with labels as `stages.png`."""
    from matplotlib.figure import Figure

    from todframes.frames.files import write_frame

    folder.mkdir()
    shown = trial_stages(sensor, trial, seed=seed)
    for name, image in shown.items():
        grey = np.clip((image - BLACK) / (WHITE - BLACK), 0.0, 1.0)
        write_frame(folder / f"{name}.png", grey, pixel_type="uint8")
    label = "SNR" if sensor.level == "snr" else "contrast"
    what = f"size {trial.size_detectors:g} detectors, {label} {trial.level:g}, apex {trial.orientation}"
    with style():
        figure = Figure(figsize=(10.0, 5.6), layout="constrained")
        for axes, (name, image) in zip(figure.subplots(2, 4).flat, shown.items(), strict=False):
            axes.imshow(image, cmap="gray", vmin=BLACK, vmax=WHITE, interpolation="nearest")
            axes.set_title(STAGE_TITLES[name], fontsize="medium")
        for axes in figure.axes:
            axes.set_axis_off()
        figure.suptitle(f"{label_text(sensor.name)}: {what}")
        note = "Black is −1 and white is 2 times the signal of a large triangle; grey 0."
        (folder / "stages.png").write_bytes(save_png(figure, note))
