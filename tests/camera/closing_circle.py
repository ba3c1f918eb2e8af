"""A camera films a chart and is modelled by what the film shows; the model's curve stands beside the film's own.

The camera and its film come from NumPy and OpenCV alone (`independent_camera`). The packages see no more than the
film, a film with the lens covered, the chart, and the exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from independent_camera import Camera, Chart, looking_at
from numpy.typing import NDArray

import sensor_sim as ss
import todframes as tod

DISTANCE_M, FRAMES_PER_SECOND, EXPOSURE_MS, BITS = 10.0, 20.0, 40.0, 12
OFFSET_DN = 60

MONITOR = {"width_px": 1280, "height_px": 720, "pixel_pitch_mm": 0.5, "eotf": "linear", "page_duration_s": 0.2}
SCALE = 0.36
"""Pixels of the camera for each pixel of the monitor."""

SHAKE_PX = 6.0
"""Largest distance, along x and y, by which the camera points elsewhere from page to page."""

DISPLAY = tod.Display(
    eotf="linear",
    white_luminance_cd_m2=100.0,
    pixel_pitch_mm=0.25,
    viewing_distance_mm=500.0,
    background_luminance_cd_m2="surround",
)


@dataclass(frozen=True, kw_only=True)
class FilmingCamera:
    """What a camera does behind its lens: photons, patterns, lines, and a converter."""

    width: int = 480
    height: int = 288
    blur_sigma_px: float = 0.6
    vignetting: float = 0.08
    electrons_at_white: float = 4_000.0
    gain_dn_per_electron: float = 0.8
    dark_noise_electrons: float = 12.0
    dsnu_electrons: float = 4.0
    prnu_percent: float = 0.8
    row_noise_electrons: float = 5.0

    def patterns(self, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Electrons added to each pixel, and its relative response."""
        shape = (self.height, self.width)
        added = self.dsnu_electrons * rng.standard_normal(shape)
        return added, 1.0 + self.prnu_percent / 100.0 * rng.standard_normal(shape)

    def expose(self, image: NDArray, patterns: tuple[NDArray, NDArray], rng: np.random.Generator) -> NDArray:
        """One frame of an image, a share of white for each pixel."""
        added, response = patterns
        electrons = rng.poisson(self.electrons_at_white * image * response) + added
        electrons = electrons + self.dark_noise_electrons * rng.standard_normal(image.shape)
        electrons += self.row_noise_electrons * rng.standard_normal((self.height, 1))
        numbers = np.rint(OFFSET_DN + self.gain_dn_per_electron * electrons)
        return np.clip(numbers, 0, 2**BITS - 1).astype(np.uint16)


def make_film(
    folder: Path,
    *,
    sizes_mrad: Sequence[float],
    contrasts: Sequence[float],
    repeats: int,
    seed: int,
    frames_per_page: int = 2,
    camera_frames: int = 60,
    camera: FilmingCamera | None = None,
) -> FilmingCamera:
    """Write chart, film.npy and dark.npy into a folder."""
    camera, rng = camera or FilmingCamera(), np.random.default_rng(seed)
    asked = {"distance_m": DISTANCE_M, "sizes_mrad": sizes_mrad, "contrasts": contrasts, "repeats": repeats}
    tod.chart("screen", out=folder / "chart", camera_page=True, rng=seed, **asked, **MONITOR)
    chart = Chart.read(folder / "chart")
    size = {"width": camera.width, "height": camera.height}
    optics = Camera(blur_sigma_px=camera.blur_sigma_px, vignetting=camera.vignetting, oversampling=5, **size)
    matrix = looking_at(chart, scale=SCALE, turn_deg=1.0, tilt_deg=1.5, **size)
    patterns = camera.patterns(rng)
    still = optics.image(chart.light(0), matrix)
    frames = [camera.expose(still, patterns, rng) for _ in range(camera_frames)]
    for page in range(1, len(chart)):
        x, y = rng.uniform(-SHAKE_PX, SHAKE_PX, 2)
        image = optics.image(chart.light(page), np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]) @ matrix)
        frames += [camera.expose(image, patterns, rng) for _ in range(frames_per_page)]
    np.save(folder / "film.npy", np.stack(frames))
    dark = np.zeros((camera.height, camera.width))
    np.save(folder / "dark.npy", np.stack([camera.expose(dark, patterns, rng) for _ in range(camera_frames)]))
    return camera


SHOWN = """[display]
pixels_per_detector = 1
pixel_pitch_mm = 0.25
viewing_distance_mm = 500.0
background_luminance_cd_m2 = 20.0
"""
"""Display of the model: that of the film, with one pixel of the camera on each pixel."""


class Closed(NamedTuple):
    """What was found: the camera of the film, the film's own curve, and that of the model on the same display."""

    camera: ss.MeasuredCamera
    film: tod.Result
    model: tod.Result
    size_detectors: dict[float, float]


def closed(folder: Path) -> Closed:
    """Go the whole way in a folder with chart, film.npy and dark.npy."""
    chart, film = folder / "chart" / "chart.toml", folder / "film.npy"
    how = {"chart": chart, "frames_per_second": FRAMES_PER_SECOND}
    camera = ss.camera(film, dark=folder / "dark.npy", exposure_ms=EXPOSURE_MS, bits=BITS, **how)
    camera.save(folder / "camera")
    sensor = folder / "camera" / "sensor.toml"
    sensor.write_text(camera.sensor_toml.partition("[display]")[0] + SHOWN, encoding="utf-8")
    value_range = (OFFSET_DN, 2**BITS - 1)
    done = tod.import_recordings(film, out=folder / "dataset", display=DISPLAY, value_range=value_range, **how)
    result = tod.score(done.path)
    sizes_mrad = [fit.group["object_size_mrad"] for fit in result.fits]
    sizes = {size_mrad: size_mrad / camera.pitch_mrad for size_mrad in sizes_mrad}
    model = ss.curve(sensor, size_detectors=list(sizes.values()), examples=False)
    return Closed(camera, result, model, sizes)
