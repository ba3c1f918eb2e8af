"""What campaigns share: their command line, small datasets, recordings and settings files."""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from todframes.frames.dataset import Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.frames.files import frame_sha256, write_frame
from todframes.stimulus import ORIENTATIONS, coverage

SAMPLES = Path(__file__).parents[2] / "sample_frames"

PITCH_MRAD = 0.25
SIZE_MRAD = 2.0
WHITE, BACKGROUND = 100.0, 50.0  # cd/m²

DISPLAY = {
    "eotf": "linear",
    "white_luminance_cd_m2": WHITE,
    "black_luminance_cd_m2": 0.0,
    "pixel_pitch_mrad": PITCH_MRAD,
    "background_luminance_cd_m2": BACKGROUND,
}

LOOK_UP_CSV = "code_value,luminance_cd_m2\n" + "".join(f"{n / 8},{WHITE * n / 8}\n" for n in range(9))

OBSERVER_TOML = """\
centre = "centroid"
retina_pitch_mrad = 0.153
position_jitter_samples = 0.5
kernel_a = 0.375
include_residual = false
band_gain = 1.0
template_blur_samples = 1.2
internal_noise = 0.5
band_noise = [2.0, 1.0, 0.5]
eye_mtf = "watson2013"
luminance_cd_m2 = "background"
age_years = 40.0
resamples = 0
p_correct = 0.75
"""

DESIGNS_CSV = "name,optics.aperture_mm,detector.pitch_mrad\nsmall,100,0.0681\nlarge,200,0.05\n"

COUNTS_CSV = "level,n_correct,n_trials,eye\n" + "".join(
    f"{level},{correct},40,{eye}\n"
    for eye in ("left", "right")
    for level, correct in ((0.05, 11), (0.1, 20), (0.2, 33), (0.4, 40))
)


def parser_of(about: str, *parts: str) -> argparse.ArgumentParser:
    """Return a parser of a campaign's part, if it has some, number of cases and seed."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if parts:
        parser.add_argument("part", choices=parts)
    parser.add_argument("n", type=int, help="number of cases")
    parser.add_argument("--seed", type=int, default=1)
    return parser


def write_dataset(
    path: Path,
    *,
    suffix: str = ".exr",
    pixel_type: str = "half",
    compression: str = "zip",
    n_channels: int = 1,
    side_px: int = 32,
    contrasts: Sequence[float] = (0.05, 0.5),
    repeats: int = 1,
    with_sha256: bool = False,
    noise: float = 0.0,
) -> list[str]:
    """Write a frame for each contrast and orientation, with `repeats` links to it; return their names."""
    (path / "frames").mkdir(parents=True)
    rng = np.random.default_rng(1)
    middle = (side_px - 1) / 2
    rows: list[dict[str, object]] = []
    for level, orientation in product(contrasts, ORIENTATIONS):
        size_px = SIZE_MRAD / PITCH_MRAD
        covered = coverage((side_px, side_px), size_px=size_px, x_px=middle, y_px=middle, orientation=orientation)
        values = BACKGROUND / WHITE * (1.0 + level * covered + noise * rng.standard_normal(covered.shape))
        stored = np.repeat(values[..., np.newaxis], n_channels, axis=2)
        names = [f"frames/c{level:.4g}_{orientation.value}_{repeat}{suffix}" for repeat in range(repeats)]
        write_frame(path / names[0], stored, pixel_type=pixel_type, compression=compression)
        for name in names[1:]:
            os.link(path / names[0], path / name)
        row = {"orientation": orientation.value, "size_mrad": SIZE_MRAD, "contrast": f"{level:.4g}"}
        row |= {"sha256": frame_sha256(path / names[0])} if with_sha256 else {}
        rows += [{"frame": name} | row for name in names]
    experiment = Experiment(level="contrast", group_by=("size_mrad",))
    write_dataset_files(path, rows, display=DISPLAY, experiment=experiment, comment="")
    return [str(row["frame"]) for row in rows]


def write_recording(path: Path, *, n_frames: int = 600, side_px: int = 200) -> None:
    """Write `frames.npy`, a recording of noise, and `schedule.csv`, which puts a triangle in its middle."""
    path.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    np.save(path / "frames.npy", rng.integers(0, 255, (n_frames, side_px, side_px), dtype=np.uint8))
    end_s, middle = n_frames / 30, side_px // 2
    (path / "schedule.csv").write_text(
        "file,start_s,end_s,orientation,size_mrad,contrast,x_px,y_px\n"
        f"frames.npy,0,{end_s:g},up,20,0.5,{middle},{middle}\n",
        encoding="utf-8",
    )


MEASURED = re.compile(
    r"cpu_s\w*|\w*elapsed\w*|date|time|\w*version\w*|started\w*|run_time_s|saves_s|seconds|from_store"
    r"|cpu_ms_per_frame"
)
"""Pattern of keys of what is measured anew in each run."""


def without_times(value: Any) -> Any:
    """Return a result as read from JSON without measured times, and without how often it was interrupted."""
    if isinstance(value, dict):
        return {key: without_times(inner) for key, inner in value.items() if not MEASURED.fullmatch(str(key))}
    return [without_times(inner) for inner in value] if isinstance(value, list) else value


def content(folder: Path) -> dict[str, Any]:
    """Return the files of a result or dataset by name, without hidden ones, times and what is in a page."""
    contents: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or ".todframes-staging" in name:
            continue
        contents[name] = b"" if name == "report.html" else path.read_bytes()
        if name in ("result.json", "import.json"):
            contents[name] = without_times(json.loads(contents[name]))
            if "files" in contents[name]:  # with checksums, also of pages with times
                contents[name]["files"] = sorted(contents[name]["files"])
        elif name == "compare.csv":
            contents[name] = without_times(list(csv.DictReader(contents[name].decode().splitlines())))
    return contents
