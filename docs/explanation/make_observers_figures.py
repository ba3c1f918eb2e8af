"""Makes the figures and tables of observers.md: python docs/explanation/make_observers_figures.py [FOLDER].

Pictures go to FOLDER/observers, the text to FOLDER/observers.md; by default that is the folder of this script.
What stands in observers.md between <!-- =NAME --> and <!-- / --> is written anew. Seeds are fixed.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import numpy as np
from matplotlib.figure import Figure

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.mtf import matched_settings
from sensor_sim.chain.sensor import Sensor, load_sensor
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from todframes.observers.csf import CsfObserver
from todframes.observers.hotelling import HotellingObserver
from todframes.observers.interface import Observer
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import Orientation, Stimulus, coverage

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
STAR_LIKE = ROOT / "sample_frames" / "star_like.toml"
BLURS_PX = (0.0, 2.0, 4.0)
SIZES = (3.0, 3.5, 4.0, 5.0, 7.0)
SAMPLE_NOISE_SNR = 1.5
NAKED_EYE_MRAD = (0.5, 1.0, 3.0, 6.0)
SHARP, MATCHED, IDEAL, ORIENTED = "pyramid", "informative", "informative, ideal", "oriented"
COLOURS = {SHARP: "#444444", MATCHED: "#0072b2", IDEAL: "#56b4e9", ORIENTED: "#d55e00"}
MARKERS = {SHARP: "o", MATCHED: "s", IDEAL: "D", ORIENTED: "^"}

Curves = dict[tuple[float, str], list[PredictedThreshold]]


def observers(sensor: Sensor) -> dict[str, Observer]:
    """The four that are compared, for one sensor and display."""
    return {
        SHARP: PyramidObserver(),
        ORIENTED: OrientedObserver(),
        MATCHED: HotellingObserver(matched_settings(sensor)),
        IDEAL: HotellingObserver(matched_settings(sensor, sample_noise_sd=sensor.display.gain / SAMPLE_NOISE_SNR)),
    }


def blurred(blur_px: float) -> Sensor:
    """The sample camera with another display spot."""
    sensor = load_sensor(STAR_LIKE)
    return replace(sensor, display=replace(sensor.display, blur_sigma_px=blur_px))


def curves() -> Curves:
    """Thresholds of every size, for every blur and observer."""
    return {
        (blur, name): [predict_threshold(FoldedChain(resolve(sensor), observer, size)) for size in SIZES]
        for blur in BLURS_PX
        for sensor in [blurred(blur)]
        for name, observer in observers(sensor).items()
    }


def curve_figure(found: Curves) -> Figure:
    """A panel for each blur: threshold SNR against size; what is never reached is at the top."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, len(BLURS_PX), sharey=True)
    top = 8.0
    for panel, blur in zip(panels, BLURS_PX, strict=True):
        for name in COLOURS:
            thresholds = [one.threshold for one in found[blur, name]]
            reached = [(s, t) for s, t in zip(SIZES, thresholds, strict=True) if t is not None]
            missed = [s for s, t in zip(SIZES, thresholds, strict=True) if t is None]
            style = {"color": COLOURS[name], "marker": MARKERS[name], "markersize": 5}
            panel.plot(*zip(*reached, strict=True), **style, linewidth=1.4, label=name)
            panel.plot(missed, [top] * len(missed), **style, linestyle="none", fillstyle="none")
        panel.set(xscale="log", yscale="log", ylim=(0.4, 10.0), title=f"display blur σ = {blur:g} pixels")
        panel.set_xlabel("√area (detectors)")
        panel.set_xticks(SIZES, [f"{size:g}" for size in SIZES])
        panel.minorticks_off()
        panel.axhline(6.3, color="#bbbbbb", linewidth=0.8)
        panel.grid(color="#eeeeee")
    panels[0].set_ylabel("threshold SNR")
    panels[0].set_yticks([0.5, 1.0, 2.0, 4.0, top], ["0.5", "1", "2", "4", "never"])
    panels[-1].legend(frameon=False, fontsize=8, loc="lower left")
    return figure


def neuron_figure() -> Figure:
    """The informative neurons of four bands, for three display blurs; the others are white."""
    blurs_mrad = (0.0, 0.3, 1.0)
    figure = Figure(figsize=(7.2, 5.4), layout="constrained")
    panels = figure.subplots(len(blurs_mrad), 5)
    stimulus = Stimulus(3.0)
    for row, blur in zip(panels, blurs_mrad, strict=True):
        observer = HotellingObserver(replace(HotellingObserver().settings, display_blur_mrad=blur))
        templates = observer.templates(stimulus)
        used, template = [np.any(band, axis=0) for band in zip(*templates, strict=True)], templates[0]
        grid = observer.grid(stimulus)
        half = grid.width_mrad / 2.0
        upright = coverage(
            (grid.side, grid.side),
            size_px=stimulus.size_mrad / grid.pitch_mrad,
            x_px=grid.side // 2,
            y_px=grid.side // 2,
            orientation=Orientation.UP,
        )
        row[0].imshow(observer.displayed(upright), cmap="gray", extent=(-half, half, half, -half))
        row[0].set_ylabel(f"blur σ = {blur:g} mrad")
        for k, panel in enumerate(row[1:]):
            largest = np.abs(template[k]).max() or 1.0
            shown = np.where(used[k], template[k] / largest, np.nan)
            panel.imshow(shown, cmap="RdBu_r", vmin=-1, vmax=1, extent=(-half, half, half, -half))
            share = np.square(template[k]).sum() / sum(np.square(band).sum() for band in template)
            panel.set_title(f"{used[k].sum()} of {used[k].size}: {100 * share:.0f} %", fontsize=8)
        for panel in row:
            panel.set(xlim=(-3.2, 3.2), ylim=(3.2, -3.2), xticks=[], yticks=[])
    panels[0][0].set_title("as displayed", fontsize=8)
    for k, panel in enumerate(panels[-1][1:]):
        panel.set_xlabel(f"band {k}")
    return figure


def texts(found: Curves) -> dict[str, str]:
    """Tables, by the name of their place in observers.md."""
    header = "| display blur | observer | " + " | ".join(f"{size:g}" for size in SIZES) + " |"
    rows = [header, "|---|---|" + "---|" * len(SIZES)]
    for (blur, name), thresholds in found.items():
        cells = ["never" if one.threshold is None else f"{one.threshold:.3g}" for one in thresholds]
        rows.append(f"| {blur:g} px | {name} | " + " | ".join(cells) + " |")
    direct = ["| observer | " + " | ".join(f"{size:g} mrad" for size in NAKED_EYE_MRAD) + " |"]
    direct.append("|---|" + "---|" * len(NAKED_EYE_MRAD))
    plain: dict[str, Observer] = {
        SHARP: PyramidObserver(),
        MATCHED: HotellingObserver(),
        ORIENTED: OrientedObserver(),
        "csf": CsfObserver(),
    }
    for name, observer in plain.items():
        cells = [f"{contrast_threshold(observer, size_mrad=size).threshold:.4g}" for size in NAKED_EYE_MRAD]
        direct.append(f"| {name} | " + " | ".join(cells) + " |")
    return {"curve": "\n".join(rows), "naked_eye": "\n".join(direct)}


def written_anew(text: str, values: Mapping[str, str]) -> str:
    """The text with each value in its place."""
    for name, value in values.items():
        place = re.compile(rf"(<!-- ={name} -->\n).*?(<!-- / -->)", re.DOTALL)
        text, count = place.subn(lambda found, v=value: f"{found[1]}{v}\n{found[2]}", text)
        if count != 1:
            raise SystemExit(f"observers.md: found <!-- ={name} --> {count} times, expected once")
    return text


def main(folder: Path) -> None:
    """Compute everything and write it."""
    pictures = folder / "observers"
    pictures.mkdir(parents=True, exist_ok=True)
    found = curves()
    for name, figure in (("curves", curve_figure(found)), ("neurons", neuron_figure())):
        figure.savefig(pictures / f"{name}.png", dpi=130, metadata={"Software": None})
    values = texts(found)
    print("\n\n".join(values.values()))
    text = (HERE / "observers.md").read_text(encoding="utf-8")
    (folder / "observers.md").write_text(written_anew(text, values), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
