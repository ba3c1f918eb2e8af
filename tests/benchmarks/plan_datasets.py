"""Planned against full scores of random frames: whether the stated bounds hold, and what planning saves.

    python tests/benchmarks/plan_datasets.py [N]

prints a line a dataset and a summary. Frames are of all pitches, sizes and formats, from narrower than the retina
to much wider, on uneven backgrounds, some noisy, some with something bright in a corner. P(correct) of every
single trial may differ by no more than the plan's bound, and rounding.
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from todframes.base.errors import SettingsError
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.files import write_frame
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.parameters import PlanName
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.score import ScoredDataset, score_dataset
from todframes.stimulus import ORIENTATIONS, coverage

LEVELS = (0.4, 0.7, 1.0, 1.5, 2.5)
REPEATS = 2
BACKGROUND = 50.0
ROUNDING = 1e-12


def observer_at_random(rng: np.random.Generator) -> PyramidObserver:
    """In weak to strong internal noise, with more or less certain templates."""
    return PyramidObserver(
        PyramidSettings(
            internal_noise=math.exp(rng.uniform(math.log(0.05), math.log(1.0))),
            template_blur_samples=rng.uniform(0.5, 2.0),
            centre=str(rng.choice(["centroid", "bounding_box"])),  # type: ignore[arg-type]
        )
    )


def dataset_at_random(folder: Path, observer: PyramidObserver, rng: np.random.Generator) -> Dataset:
    """One size at some contrasts about the naked eye's threshold."""
    size_mrad = math.exp(rng.uniform(math.log(0.5), math.log(12.0)))
    size_px = math.exp(rng.uniform(math.log(3.0), math.log(50.0)))
    side = math.ceil(size_px * rng.uniform(2.2, 9.0))
    suffix = str(rng.choice(["png", "exr"]))
    sharp = contrast_threshold(observer, size_mrad=size_mrad).threshold or 0.5
    noise_sd = sharp * rng.choice([0.0, math.exp(rng.uniform(math.log(0.1), math.log(3.0)))])
    y, x = np.mgrid[:side, :side] / side - 0.5
    tilt, vignetting = rng.uniform(-0.3, 0.3, 2), rng.uniform(0.0, 0.4)
    uneven = tilt[0] * x + tilt[1] * y - vignetting * (x**2 + y**2)
    corner = (np.hypot(x - 0.42, y + 0.42) < 0.06) * rng.choice([0.0, 0.5])
    polarity = float(rng.choice([1.0, -1.0]))
    # Anywhere on the frame, not necessarily the same place in each.
    room = max(side / 2.0 - 1.1 * size_px, 0.0) * rng.choice([0.0, 1.0])
    (folder / "frames").mkdir()
    rows = [["frame", "orientation", "size_mrad", "contrast", "polarity", "x_px", "y_px"]]
    for level in LEVELS:
        contrast = min(sharp * level * (1.0 + noise_sd / sharp), 0.9)
        for orientation in ORIENTATIONS:
            for repeat in range(REPEATS):
                x_px, y_px = ((side - 1) / 2.0 + rng.uniform(-room, room, 2)).tolist()
                triangle = coverage((side, side), size_px=size_px, x_px=x_px, y_px=y_px, orientation=orientation)
                seen = 1.0 + uneven + corner + polarity * contrast * triangle
                seen = np.maximum(seen + rng.normal(0.0, noise_sd, seen.shape), 0.0)
                name = f"frames/{level}_{orientation}_{repeat}.{suffix}"
                write_frame(folder / name, BACKGROUND * seen if suffix == "exr" else np.minimum(seen / 4.0, 1.0))
                told = orientation.value, size_mrad, float(contrast), int(polarity), x_px, y_px
                rows.append([name, *map(str, told)])
    with (folder / "manifest.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    (folder / "dataset.toml").write_text(
        f"""\
schema = 1
[display]
eotf = "linear"
white_luminance_cd_m2 = {1.0 if suffix == "exr" else 4.0 * BACKGROUND}
pixel_pitch_mrad = {size_mrad / size_px!r}
background_luminance_cd_m2 = {rng.choice(['"border"', str(BACKGROUND)])}
[experiment]
level = "contrast"
group_by = ["size_mrad"]
""",
        encoding="utf-8",
    )
    return load_dataset(folder)


def scored(dataset: Dataset, observer: PyramidObserver, name: PlanName) -> tuple[ScoredDataset, float]:
    """Scores with a plan of this name, and processor time in seconds."""
    observer = PyramidObserver(observer.settings)  # which remembers nothing
    started = time.process_time()
    found = score_dataset(dataset, observer, plan_name=name)
    return found, time.process_time() - started


def main(n_datasets: int) -> None:
    """Score some datasets; exit status 1 if a change of P(correct) is beyond its bound."""
    rng = np.random.default_rng(1)
    ratios, beyond = [], 0
    for number in range(n_datasets):
        with tempfile.TemporaryDirectory() as made:
            observer = observer_at_random(rng)
            dataset = dataset_at_random(Path(made), observer, rng)
            try:
                (planned, planned_s), (full, full_s) = (
                    scored(dataset, observer, name) for name in ("needed", "full")
                )
            except SettingsError as error:
                print(f"{number:4d}  {error}", flush=True)
                continue
        ratios.append(full_s / planned_s)
        change = float(np.abs(planned.p_correct - full.p_correct).max())
        (fit,), (of_full,) = planned.fits, full.fits
        bound = fit.left_out_bound + ROUNDING
        beyond += change > bound
        line = f"{number:4d}  {fit.fit.status:16s} {ratios[-1]:6.2f} ×  P {change:.1e}, bound {bound:.1e}"
        line += "  BEYOND" if change > bound else ""
        if fit.fit.threshold is not None and of_full.fit.threshold is not None:
            line += f"  threshold {abs(fit.fit.threshold / of_full.fit.threshold - 1.0):.1e}"
        print(line, flush=True)
    saved = f"full ÷ planned: median {np.median(ratios):.2f}, least {min(ratios):.2f}"
    print(f"{len(ratios)} datasets: P of a trial beyond the bound in {beyond}; {saved}")
    sys.exit(beyond > 0)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
