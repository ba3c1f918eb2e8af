"""How often `compare` holds the true ratio of two cameras, and finds none in the same camera twice; minutes.

python tests/campaigns/two_cameras.py 200                  # all cameras, 200 pairs of each
python tests/campaigns/two_cameras.py 200 --only "the same"
python tests/campaigns/two_cameras.py 30 --films           # of a chart, each through `import`

Frames are drawn by other code: triangles on four times the pixels, blurred, with noise, rounded to 8 bits. Each
pair is scored and compared with the same places of the triangles (paired) and with others (separate). The true
ratio is that of the thresholds of many frames, with its own interval. docs/evidence/index.md has the figures.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scenes import parser_of
from scipy.ndimage import gaussian_filter

import todframes as tod

sys.path.insert(0, str(Path(__file__).parents[1] / "camera"))
import independent_camera

FINER, SIDE_PX, PITCH_MRAD, BACKGROUND, WHITE_CD_M2 = 4, 40, 0.25, 110.0, 232.0
SIZES_MRAD, LEVELS = (2.0, 3.0), (0.04, 0.08, 0.16, 0.32)
TURNS = {"up": 0, "right": 3, "down": 2, "left": 1}
"""Quarter turns of `numpy.rot90`, against the clock, of a triangle that points up."""

DISPLAY = tod.Display(
    eotf="linear",
    white_luminance_cd_m2=WHITE_CD_M2,
    pixel_pitch_mrad=PITCH_MRAD,
    background_luminance_cd_m2=WHITE_CD_M2 * BACKGROUND / 255.0,
)
FIT = tod.FitSettings(resamples=400)


class Camera(NamedTuple):
    """Blur in px (standard deviation), noise in code values, and quality of JPEG; 0 for none."""

    blur_px: float = 1.0
    noise: float = 8.0
    jpeg: int = 0


REFERENCE = Camera()
OTHERS = {
    "the same camera": REFERENCE,
    "blur x 1.2": Camera(blur_px=1.2),
    "noise x 1.5": Camera(noise=12.0),
    "JPEG of quality 30": Camera(jpeg=30),
}


def triangle(size_px: float, turns: int, x_px: float, y_px: float) -> NDArray[np.float64]:
    """Draw an equilateral triangle with its centroid at an offset from the middle; its area is size_px²."""
    radius = size_px * math.sqrt(4.0 / (3.0 * math.sqrt(3.0)))  # of the circle through the corners
    offsets = (np.arange(SIDE_PX * FINER) + 0.5) / FINER - SIDE_PX / 2
    right, down = np.meshgrid(offsets, offsets)
    for _ in range(turns):  # seen from a triangle that points up
        x_px, y_px = -y_px, x_px
    right, down = right - x_px, down - y_px
    inside = down < radius / 2
    for sign in (-1.0, 1.0):
        inside &= sign * right * math.sqrt(3.0) / 2 - down / 2 < radius / 2
    fine = np.rot90(inside.astype(np.float64), turns)
    return fine.reshape(SIDE_PX, FINER, SIDE_PX, FINER).mean(axis=(1, 3))


def recorded(
    camera: Camera,
    repeats: int,
    order: Sequence[str],
    places: np.random.Generator,
    noise: np.random.Generator,
) -> tod.Result:
    """Record all sizes, levels and orientations at random places, and score the frames."""
    frames, columns = [], []
    for size in SIZES_MRAD:
        for level in LEVELS:
            for orientation in (*order,) * repeats:
                x_px, y_px = places.uniform(-0.5, 0.5, 2)
                contrast = level * triangle(size / PITCH_MRAD, TURNS[orientation], x_px, y_px)
                seen = gaussian_filter(BACKGROUND * (1.0 + contrast), camera.blur_px, mode="nearest")
                frame = np.clip(np.rint(seen + noise.normal(0.0, camera.noise, seen.shape)), 0, 255).astype(
                    np.uint8
                )
                if camera.jpeg:
                    coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, camera.jpeg])[1]
                    frame = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
                frames.append(frame)
                middle = (SIDE_PX - 1) / 2
                columns.append((orientation, level, size, (middle + x_px, middle + y_px)))
    orientation, level, size, position = zip(*columns, strict=True)
    return tod.score_frames(
        frames, orientation=orientation, level=level, size_mrad=size, position=position, display=DISPLAY, fit=FIT
    )


def cameras_of(names: Sequence[str], repeats: int, seed: int, number: int) -> dict[tuple[str, bool], tod.Result]:
    """Record the reference and the other cameras, each at the places of the reference, and at others."""
    found = {}
    for k, name in enumerate(["reference", *names]):
        for is_paired in (True, False)[: 1 + (k > 0)]:
            places = np.random.default_rng([seed, number, 0 if is_paired else k + 1])
            noise = np.random.default_rng([seed, number, k, is_paired, 1])
            camera = OTHERS.get(name, REFERENCE)
            order = [*TURNS] if is_paired else [*reversed(TURNS)]  # other trials, which are not paired
            found[name, is_paired] = recorded(camera, repeats, order, places, noise)
    return found


def compared(reference: tod.Result, other: tod.Result, *, is_paired: bool) -> tod.results.data.Ratio:
    """Return the ratio over all sizes; the result states how trials were compared."""
    result = tod.compare(reference, other, fit=FIT, examples=False)
    assert any("trial by trial" in text for text in result.basis) == is_paired, result.basis
    return result.conditions[1].overall


class FilmedChart:
    """Films of a chart on a monitor, by the camera of tests/camera, each from another place, and imported."""

    side: ClassVar = {"width": 400, "height": 240}
    of_films: ClassVar = {"the same camera": 0.7, "blur x 1.2": 0.84}
    """Blur in px of each camera, that of the reference being 0.7."""

    def __init__(self, folder: Path, repeats: int) -> None:
        monitor = {"width_px": 1280, "height_px": 720, "pixel_pitch_mm": 0.5, "eotf": "linear"}
        shown = {"sizes_mrad": [1.0], "contrasts": [0.06, 0.11, 0.2, 0.36], "repeats": repeats}
        tod.chart("screen", out=folder / "chart", distance_m=10.0, rng=1, **shown, **monitor)
        self.folder, self.chart = folder, independent_camera.Chart.read(folder / "chart")

    def recorded(self, name: str, seed: Sequence[int]) -> tod.Result:
        """Film all pages, import the film, and score the dataset."""
        rng, frames, blur_px = np.random.default_rng(seed), [], self.of_films.get(name, 0.7)
        camera = independent_camera.Camera(
            blur_sigma_px=blur_px, electrons_at_white=2_000.0, read_noise_electrons=12.0, bits=14, **self.side
        )
        view = independent_camera.looking_at(self.chart, scale=0.3, turn_deg=1.0, tilt_deg=1.5, **self.side)
        for page in range(len(self.chart)):
            shift = np.eye(3)
            shift[:2, 2] = rng.uniform(-4.0, 4.0, 2)
            image = camera.image(self.chart.light(page), shift @ view)
            frames += [camera.expose(image, rng) for _ in range(2)]
        np.save(self.folder / "film.npy", np.stack(frames))
        out = self.folder / "_".join(map(str, seed))
        done = tod.import_recordings(
            self.folder / "film.npy",
            chart=self.folder / "chart" / "chart.toml",
            out=out,
            display="reference_linear",
            frames_per_second=20,
            bits=14,
        )
        return tod.score(done.path, fit=FIT, examples=False)


def films(n: int, repeats: int, seed: int) -> int:
    """Print how many intervals of n pairs of films hold 1, or the mean of all ratios; exit status 1 if too few."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    with TemporaryDirectory() as folder:
        chart = FilmedChart(Path(folder), repeats)
        for number in range(1, n + 1):
            reference, *others = (
                chart.recorded(name, [seed, number, k]) for k, name in enumerate(("reference", *chart.of_films))
            )
            for name, other in zip(chart.of_films, others, strict=True):
                (ratio,) = tod.compare(reference, other, fit=FIT, examples=False).conditions[1].ratios
                low, high = ratio.ratio_ci95 or (None, None)
                found.setdefault(name, []).append((ratio.ratio or math.nan, low or 0.0, high or math.inf))
                print(name, *found[name][-1], ratio.verdict, flush=True)
    status = 0
    for name, rows in found.items():
        ratios, low, high = np.array(rows).T
        true = 1.0 if name == "the same camera" else math.exp(np.nanmean(np.log(ratios)))
        share = np.mean((low <= true) & (true <= high))
        status |= share < 0.95 - 3.0 * math.sqrt(0.95 * 0.05 / n)
        print(f"{name:20} films     true ratio {true:.3f}: {100 * share:.1f} % of {n} hold it", flush=True)
    return int(status)


def main() -> int:
    """Print the share of intervals that hold the truth; exit status 1 if one is below 95 % beyond chance."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="part of the name of a camera")
    parser.add_argument("--films", action="store_true", help="films of a chart, through import")
    parser.add_argument("--repeats", type=int, default=1, help="frames of each size, level and orientation")
    parser.add_argument("--many", type=int, default=40, help="the same for the true ratio")
    asked = parser.parse_args()
    names = [name for name in OTHERS if asked.only in name]
    if asked.films:
        return films(asked.n, asked.repeats, asked.seed)
    many = cameras_of([name for name in names if name != "the same camera"], asked.many, asked.seed, 0)
    truth = {
        name: compared(many["reference", True], one, is_paired=True)
        for (name, is_paired), one in many.items()
        if is_paired
    }
    tally: dict[tuple[str, bool], list[tuple[bool, bool, float]]] = {}
    for number in range(1, asked.n + 1):
        found = cameras_of(names, asked.repeats, asked.seed, number)
        for (name, is_paired), result in found.items():
            if name == "reference":
                continue
            ratio = compared(found["reference", True], result, is_paired=is_paired)
            true = truth[name].ratio if name in truth else 1.0
            low, high = ratio.ratio_ci95 or (None, None)
            holds = (low or 0.0) <= true <= (high or math.inf)
            width = math.log(high / low) if low and high else math.inf
            tally.setdefault((name, is_paired), []).append((holds, ratio.verdict != "no difference shown", width))
    least = 0.95 - 3.0 * math.sqrt(0.95 * 0.05 / asked.n)
    status = 0
    for (name, is_paired), rows in tally.items():
        holds, differ, width = np.array(rows, np.float64).T
        status |= holds.mean() < least
        true = (
            "{:.3f} ({:.3f} to {:.3f})".format(truth[name].ratio, *truth[name].ratio_ci95) if name in truth else 1
        )
        pairs = "paired" if is_paired else "separate"
        shares = f"{100 * holds.mean():.1f} % of {asked.n} hold it, {100 * differ.mean():.1f} % called different"
        width = f"width {100 * np.median(width):.0f} %"
        print(f"{name:20} {pairs:9} true ratio {true}: {shares}, {width}", flush=True)
    return int(status)


if __name__ == "__main__":
    raise SystemExit(main())
