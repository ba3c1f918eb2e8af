"""Triangles on scenes: false alarms, and mishaps; minutes.

python tests/campaigns/backdrops.py clean 100        # good datasets: not one warning
python tests/campaigns/backdrops.py mishaps 6        # the mishaps of tests/mishaps on 6 scenes: which are found

The exit status is 1 if a good dataset has a warning, or if a mishap that is found on an even field is not found on
scenes, but for those that docs/how_to/scenes.md names.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import SAMPLES, parser_of

import sensor_sim as ss
import todframes as tod

sys.path.append(str(Path(__file__).parents[1] / "mishaps"))
import mishaps

NOT_FOUND_ON_SCENES = {"jpeg", "late_frames"}
"""Mishaps that are found on an even field alone."""

PHOTOGRAPHS = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "gravel", "moon", "rocket")


def field(rng: np.random.Generator, side: int, power: float) -> NDArray[np.float64]:
    """A random image with a spectrum of amplitude 1/f to some power; code values from 0.15 to 0.85."""
    noise = np.fft.fft2(rng.normal(size=(side, side)))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    image = np.fft.ifft2(noise / np.maximum(frequency, 1.0 / side) ** power).real
    image -= image.min()
    return 0.15 + 0.7 * image / image.max()


def backgrounds(rng: np.random.Generator, folder: Path) -> list[str]:
    """Return the backgrounds of a random dataset: photographs, fields, or a film in which noise changes."""
    kind = rng.choice(["photographs", "fields", "film"])
    if kind == "photographs":
        return ["skimage:" + ",".join(rng.choice(PHOTOGRAPHS, int(rng.integers(1, 6)), replace=False))]
    if kind == "fields":
        for number in range(int(rng.integers(1, 6))):
            image = field(rng, 256, float(rng.uniform(0.3, 2.0)))
            tod.write_frame(folder / f"field_{number}.png", image, pixel_type=rng.choice(["uint8", "uint16"]))
        return [str(folder)]
    scene = field(rng, 200, float(rng.uniform(0.5, 2.0)))
    noise = 10.0 ** rng.uniform(-3.0, -1.3)
    film = np.clip(scene + noise * rng.normal(size=(6, *scene.shape)), 0.001, 0.999)
    np.save(folder / "film.npy", np.rint(65535 * film).astype(np.uint16))
    return [str(folder / "film.npy")]


def clean(rng: np.random.Generator, folder: Path) -> tuple[str, tod.Result]:
    """Make a random dataset that is what it says; return how, and its validation."""
    images = folder / "images"
    images.mkdir()
    shown = backgrounds(rng, images)
    asked = {
        "size_mrad": sorted(rng.choice([2.0, 2.7, 3.5, 4.4], int(rng.integers(1, 3)), replace=False).tolist()),
        "contrast": np.geomspace(0.05, rng.uniform(0.2, 0.6), int(rng.integers(1, 5))).tolist(),
        "frames": int(rng.integers(1, 4)),
        "turns": int(rng.choice([8, 8, 4, 1])),
        "blur_px": float(rng.choice([0.0, rng.uniform(0.3, 2.0)])),
        "display": str(rng.choice(["reference_sdr", "reference_linear", "srgb_monitor"])),
        "rng": int(rng.integers(1000)),
    }
    if rng.random() < 0.3:
        asked |= {"polarity": -1, "contrast": [one / 6.0 for one in asked["contrast"]]}
    try:
        tod.scenes(shown, out=folder / "dataset", **asked)
    except tod.DataError as error:
        if "beyond black" not in str(error) and "found no window" not in str(error):
            raise
        return f"refused: {error}", tod.validate(SAMPLES / "naked_eye")
    return f"{shown} {asked}", tod.validate(folder / "dataset")


def simulated(rng: np.random.Generator, folder: Path) -> tuple[str, tod.Result]:
    """The same with a camera in front of the scenes."""
    images = folder / "images"
    images.mkdir()
    for number in range(int(rng.integers(1, 6))):
        tod.write_frame(images / f"field_{number}.png", field(rng, 256, float(rng.uniform(0.5, 1.5))))
    asked = {
        "size_detectors": [float(rng.choice([4.0, 6.0]))],
        "snr": np.geomspace(rng.uniform(1.0, 2.0), rng.uniform(4.0, 30.0), int(rng.integers(1, 5))).tolist(),
        "trials": 8 * int(rng.integers(3, 8)),
        "rng": int(rng.integers(1000)),
    }
    ss.simulate(SAMPLES / "staring_camera.toml", background=images, out=folder / "dataset", **asked)
    return f"simulated {asked}", tod.validate(folder / "dataset")


def clean_sets(n: int, seed: int, first: int) -> bool:
    """Print the warnings of good datasets, every fourth of them simulated; return whether there is none."""
    n_warned = 0
    for k in range(first, first + n):
        with tempfile.TemporaryDirectory() as name:
            make = simulated if k % 4 == 3 else clean
            how, result = make(np.random.default_rng([seed, k]), Path(name))
        n_warned += bool(result.warnings or result.skipped)
        for one in (*result.warnings, *result.skipped):
            print(f"{k}: {how}\n  {one}")
    print(f"{n_warned} of {n} good datasets have a warning")
    return n_warned == 0


@cache
def texture(number: int) -> NDArray[np.float64]:
    """Contrast of a scene for a mishap: 1/f, standard deviation 0.25, mean 0 in the circle of the triangle."""
    side, middle = mishaps.SIDE_PX, mishaps.MIDDLE_PX
    image = field(np.random.default_rng([9, number]), side, 1.0)
    image = np.clip(0.25 * (image - image.mean()) / image.std(), -0.8, 1.2)
    away = np.hypot(*np.meshgrid(np.arange(side) - middle, np.arange(side) - middle))
    radius = 2.0 / 3.0 * 3.0**0.25 * mishaps.SIZE_MRAD / mishaps.PITCH_MRAD
    return image - mishaps.blurred(image, mishaps.BLUR_PX)[away <= radius].mean()


def on_scenes(recording: mishaps.Recording, n: int) -> mishaps.Recording:
    """Return a recording with a texture behind its triangles, of which the manifest knows."""

    def scene(number: int) -> int:
        return (5 * number + number // 8) % n

    def drawn(shot: mishaps.Shot) -> NDArray[np.float64]:
        return recording.drawn(shot) + texture(scene(shot.number))

    def rows(found: list[dict[str, str]]) -> list[dict[str, str]]:
        numbers = (int(Path(row["frame"]).stem) for row in found)
        shown = [{"scene": f"scene {scene(number)}"} for number in numbers]
        return [row | one for row, one in zip(recording.rows(found), shown, strict=True)]

    return replace(recording, drawn=drawn, rows=rows)


def warned(recording: mishaps.Recording) -> set[str]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "dataset"
        recording.write(folder)
        recording.declare(folder, mishaps.BACKGROUNDS["number"])
        return {one.code for one in tod.validate(folder).warnings}


def mishap_sets(n: int) -> bool:
    """Print how each mishap ends on an even field and on scenes; return whether no other is missed than stated."""
    n_found, missed, alarms = 0, set(), set()
    for case in mishaps.CASES:
        even, scenes = warned(case.recording), warned(on_scenes(case.recording, n))
        print(f"{case.name:24}{', '.join(sorted(even)) or '-':60}{', '.join(sorted(scenes)) or '-'}")
        if case.control and scenes:
            alarms.add(case.name)
        n_found += bool(case.codes & even)
        if case.codes & even and not case.codes & scenes:
            missed.add(case.name)
    print(f"of {n_found} mishaps that are found on an even field, {len(missed)} are not found on scenes: {missed}")
    print(f"{len(alarms)} false alarms {alarms or ''}")
    return missed <= NOT_FOUND_ON_SCENES and not alarms


def main() -> int:
    parser = parser_of(__doc__, "clean", "mishaps")
    parser.add_argument("--first", type=int, default=0, help="number of the first case, to repeat one")
    asked = parser.parse_args()
    is_clean = asked.part == "clean"
    return int(not (clean_sets(asked.n, asked.seed, asked.first) if is_clean else mishap_sets(asked.n)))


if __name__ == "__main__":
    sys.exit(main())
