"""What a sensor does, to look at: its transfer functions, and one trial stage by stage."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sensor_sim.scenes import sample_image
from sensor_sim.sensor import Detector, Sensor
from sensor_sim.simulate import Simulator, Trial
from sensor_sim.transfer import stages
from todframes import __version__
from todframes.frame_writing import write_frame
from todframes.readout import Observer, Stimulus
from todframes.result import evenly
from todframes.retina import resample
from todframes.stimulus import Orientation, bounding_box_offset, coverage
from todframes.tables import add_row, new_table
from todframes.viewing import Patch

if TYPE_CHECKING:
    from rich.table import Table

FloatArray = NDArray[np.float64]
Json = dict[str, Any]

POINTS = 201
TABLE_STEP = 20
FINE_PIXELS_PER_DETECTOR = 8


def mtf_object(sensor: Sensor) -> Json:
    """Transfer of every stage along x at frequencies up to where optics or display pass nothing, as JSON."""
    cut_off, nyquist = sensor.optics.cut_off_cyc_per_mrad, sensor.detector.nyquist_cyc_per_mrad
    frequency = np.linspace(0.0, min(1.05 * cut_off, 10.0 * nyquist), POINTS)
    return {
        "schema": 1,
        "command": "mtf",
        "version": __version__,
        "sensor": sensor.name,
        "cut_off_cyc_per_mrad": cut_off,
        "nyquist_cyc_per_mrad": nyquist,
        "frequency_cyc_per_mrad": frequency.tolist(),
        "mtf": {name: values.tolist() for name, values in stages(frequency, sensor=sensor).items()},
    }


def mtf_table(result: Json) -> Table:
    """Every twentieth frequency, as a table for the terminal."""
    cut_off, nyquist = result["cut_off_cyc_per_mrad"], result["nyquist_cyc_per_mrad"]
    title = f"{result['sensor']}: MTF along x; optics' cut-off {cut_off:.4g}, Nyquist {nyquist:.4g} cycles/mrad"
    table = new_table(title, ("cycles/mrad", *result["mtf"]))
    for n in range(0, POINTS, TABLE_STEP):
        values = [f"{stage[n]:.4f}" for stage in result["mtf"].values()]
        add_row(table, [f"{result['frequency_cyc_per_mrad'][n]:.4g}", *values])
    return table


def mtf_files(result: Json) -> dict[str, bytes]:
    """All frequencies as CSV, and a picture with cut-off and Nyquist frequency marked."""
    from matplotlib.figure import Figure

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frequency_cyc_per_mrad", *result["mtf"]])
    writer.writerows(zip(result["frequency_cyc_per_mrad"], *result["mtf"].values(), strict=True))
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    for name, values in result["mtf"].items():
        product = name.endswith("_sample")
        axes.plot(
            result["frequency_cyc_per_mrad"],
            values,
            label=name.replace("_", " "),
            lw=2.2 if product else 1.0,
            ls={"hold": "--", "display": ":", "electronics": "-."}.get(name, "-"),
            color={"pre_sample": "k", "post_sample": "0.5"}.get(name),
        )
    for name, style in (("cut_off", ":"), ("nyquist", "--")):
        place = result[f"{name}_cyc_per_mrad"]
        if place <= result["frequency_cyc_per_mrad"][-1]:
            axes.axvline(place, color="C3", ls=style, lw=1.0, label=f"{name.replace('_', '-')} {place:.4g}")
    axes.axhline(0.0, color="0.7", lw=0.8)
    axes.set(xlabel="frequency in the scene (cycles/mrad)", ylabel="MTF along x", xlim=(0.0, None))
    axes.set_title(result["sensor"].replace("$", r"\$"))
    axes.legend(fontsize="small", ncols=2)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=144, metadata={"Software": None})
    return {"mtf.csv": text.getvalue().encode(), "mtf.png": picture.getvalue()}


def trial_stages(sensor: Sensor, trial: Trial, *, seed: int) -> dict[str, FloatArray]:
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
    from todframes.examples import MOST_EXAMPLES

    known = [fit for fit in fits if fit["threshold"] is not None]
    return [_threshold_example(sensor, observer, fit, seed) for fit in evenly(known, MOST_EXAMPLES)]


def _threshold_example(sensor: Sensor, observer: Observer, fit: Json, seed: int) -> Json:
    from todframes.examples import FramePart, pictures

    size, pitch_mrad = fit["group"]["size_detectors"], sensor.display.pixel_pitch_mrad
    trial = Trial((0, 0, 0), size, fit["threshold"], Orientation.UP)
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


def write_stages(folder: Path, sensor: Sensor, trial: Trial, *, seed: int) -> None:
    """Write these stages as 8-bit PNG, black at −1 and white at 2 times a large triangle's signal."""
    folder.mkdir()
    for name, image in trial_stages(sensor, trial, seed=seed).items():
        grey = np.clip((image + 1.0) / 3.0, 0.0, 1.0)
        write_frame(folder / f"{name}.png", grey, pixel_type="uint8")
