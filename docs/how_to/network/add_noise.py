"""Adds noise to the frames of a dataset, and keeps the frames without it for PSNR and SSIM.

python add_noise.py DATASET [SD]     # standard deviation of the noise, of white [default: 0.05]
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

import todframes as tod


def add_noise(dataset: Path, noise_sd: float, seed: int = 1) -> None:
    """Add independent Gaussian noise to all frames of a dataset."""
    rng = np.random.default_rng(seed)
    manifest = dataset / "manifest.csv"
    if not manifest.exists() or (dataset / "clean").exists():
        sys.exit(f"{dataset}: expected a dataset without a folder clean")
    with manifest.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    (dataset / "clean").mkdir()
    for row in rows:
        clean = tod.read_frame(dataset / row["frame"]).values
        row["reference_frame"] = f"clean/{Path(row['frame']).name}"
        (dataset / row["frame"]).rename(dataset / row["reference_frame"])
        noisy = clean + rng.normal(0.0, noise_sd, clean.shape)
        tod.write_frame(dataset / row["frame"], np.clip(noisy, 0.0, 1.0))
    with manifest.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    add_noise(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 0.05)
