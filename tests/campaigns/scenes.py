"""Small datasets, recordings and settings files for the campaigns."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from todframes.frames.files import write_frame
from todframes.stimulus import ORIENTATIONS, coverage

SAMPLES = Path(__file__).parents[2] / "sample_frames"

PITCH_MRAD = 0.25
SIZE_MRAD = 2.0
WHITE, BACKGROUND = 100.0, 50.0  # cd/m²

DATASET_TOML = f"""\
schema = 1

[display]
eotf = "linear"
white_luminance_cd_m2 = {WHITE}
black_luminance_cd_m2 = 0.0
pixel_pitch_mrad = {PITCH_MRAD}
background_luminance_cd_m2 = {BACKGROUND}

[experiment]
level = "contrast"
group_by = ["size_mrad"]
"""

LOOK_UP_TOML = DATASET_TOML.replace('eotf = "linear"', 'eotf = "lut"\nlut = "lut.csv"')

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
    """Write a dataset: a frame for each contrast and orientation, with `repeats` links to it.

    Returns the names of the frames, in the order of the manifest's rows.
    """
    (path / "frames").mkdir(parents=True)
    (path / "dataset.toml").write_text(DATASET_TOML, encoding="utf-8")
    rng = np.random.default_rng(1)
    middle = (side_px - 1) / 2
    rows = []
    for level in contrasts:
        for orientation in ORIENTATIONS:
            place = {"x_px": middle, "y_px": middle, "orientation": orientation}
            covered = coverage((side_px, side_px), size_px=SIZE_MRAD / PITCH_MRAD, **place)
            values = BACKGROUND / WHITE * (1.0 + level * covered + noise * rng.standard_normal(covered.shape))
            name = f"c{level:.4g}_{orientation.value}"
            for repeat in range(repeats):
                frame = f"frames/{name}_{repeat}{suffix}"
                if repeat:
                    os.link(path / f"frames/{name}_0{suffix}", path / frame)
                else:
                    stored = np.repeat(values[..., np.newaxis], n_channels, axis=2)
                    write_frame(path / frame, stored, pixel_type=pixel_type, compression=compression)
                    sha256 = hashlib.sha256((path / frame).read_bytes()).hexdigest()
                row = {
                    "frame": frame,
                    "orientation": orientation.value,
                    "size_mrad": str(SIZE_MRAD),
                    "contrast": f"{level:.4g}",
                }
                rows.append(row | ({"sha256": sha256} if with_sha256 else {}))
    with (path / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return [row["frame"] for row in rows]


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


def without_times(value: Any) -> Any:
    """Return a result as read from JSON without what tells time, or how often it was interrupted."""
    if isinstance(value, dict):
        kept = {key: one for key, one in value.items() if key != "from_store" and not _tells_time(key)}
        return {key: without_times(one) for key, one in kept.items()}
    if isinstance(value, list):
        return [without_times(one) for one in value]
    return value


def _tells_time(key: str) -> bool:
    return key in ("seconds", "saves_s") or key.endswith(("run_time_s", "cpu_s", "cpu_ms_per_frame", "memory_mb"))


def content(folder: Path) -> dict[str, Any]:
    """Return the files of a result or dataset by name, without what tells time and without hidden files.

    `report.html` prints the run time, so only its presence counts.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".todframes-staging") for part in name.parts):
            found[name.as_posix()] = path.read_bytes()
    for name in {"result.json", "import.json"} & found.keys():
        found[name] = without_times(json.loads(found[name]))
    if "report.html" in found:
        found["report.html"] = b""
    if "compare.csv" in found:
        rows = list(csv.DictReader(io.StringIO(found["compare.csv"].decode())))
        found["compare.csv"] = [without_times(row) for row in rows]
    return found
