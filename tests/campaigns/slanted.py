"""Bias and coverage of the MTF of slanted edges, over simulated edges of known MTF; minutes.

OPENBLAS_NUM_THREADS=1 python tests/campaigns/slanted.py 300   # 300 seeds for each edge, 2 % noise
python tests/campaigns/slanted.py 100 --noise 0.005 --only gaussian

The edges are those of tests/edges.py, of 120 x 80 pixels. docs/camera_mtf.md has the figures.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from edges import diffraction, edge_image, gaussian, true_mtf

from todframes.recordings.edge_mtf import FREQUENCY_CYC_PER_PIXEL, NYQUIST, EdgeMtf, measure_edge

OPTICS = {
    "gaussian 0.5": gaussian(0.5),
    "gaussian 0.8": gaussian(0.8),
    "diffraction 1.0": diffraction(1.0),
    "diffraction 0.6": diffraction(0.6),
}

ANGLES_DEG = (2.0, 5.0, 95.0, -12.0, 25.0, 44.0)
"""Directions of the normal: nearly upright, nearly level, and nearly diagonal edges, and between."""

LONG_PX, SHORT_PX = 120, 80

CONTRAST = 0.6


class Edges(NamedTuple):
    """Largest bias up to the Nyquist frequency with its standard error, and coverage over all its frequencies."""

    name: str
    bias: float
    bias_error: float
    covered: float
    mtf50_covered: float
    noiseless: float

    def line(self) -> str:
        return (
            f"{self.name:28} bias {100 * self.bias:+.2f} ± {100 * self.bias_error:.2f} %, without noise "
            f"{100 * self.noiseless:.2f} %, band holds {100 * self.covered:.1f} %, "
            f"that of MTF50 {100 * self.mtf50_covered:.1f} %"
        )


def repeated(name: str, angle_deg: float, n: int, *, noise: float, seed: int) -> Edges:
    """Measure an edge with new noise n times."""
    optics = OPTICS[name]
    is_level = abs((angle_deg + 90) % 180 - 90) > 45
    shape = (SHORT_PX, LONG_PX) if is_level else (LONG_PX, SHORT_PX)
    image = edge_image(shape, angle_deg, optics, low=0.2, high=0.2 + CONTRAST)
    box = (0, 0, shape[1], shape[0])
    f = FREQUENCY_CYC_PER_PIXEL[1 : NYQUIST + 1]
    truth = true_mtf(f, optics, angle_deg)
    fine = np.linspace(0.0, 1.0, 10_001)
    mtf50 = float(fine[np.argmax(true_mtf(fine, optics, angle_deg) < 0.5)])
    found: list[EdgeMtf] = []
    for number in range(n):
        rng = np.random.default_rng([seed, number])
        found.append(measure_edge(image + rng.normal(0.0, noise * CONTRAST, shape), box))
    mtf, low, high = (
        np.array([getattr(one, end)[1 : NYQUIST + 1] for one in found]) for end in ("mtf", "lower", "upper")
    )
    bias = mtf.mean(0) - truth
    k = int(np.argmax(np.abs(bias)))
    ends = [one.mtf50_cyc_per_pixel.ci95 for one in found if one.mtf50_cyc_per_pixel is not None]
    return Edges(
        name=f"{name}, {angle_deg:g}°",
        bias=float(bias[k]),
        bias_error=float(mtf[:, k].std() / math.sqrt(n)),
        covered=float(((low <= truth) & (truth <= high)).mean()),
        mtf50_covered=float(np.mean([(a or 0.0) <= mtf50 <= (b or 1.0) for a, b in ends])),
        noiseless=float(np.abs(measure_edge(image, box).mtf[1 : NYQUIST + 1] - truth).max()),
    )


def campaign(n: int, *, noise: float, seed: int, only: str = "") -> list[Edges]:
    """Measure all edges and print a line for each."""
    found = []
    for name in OPTICS:
        for angle_deg in ANGLES_DEG:
            if only in f"{name}, {angle_deg:g}°":
                found.append(repeated(name, angle_deg, n, noise=noise, seed=seed))
                print(found[-1].line(), flush=True)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print bias and coverage; exit status 1 beyond 0.5 % and four standard errors, or 93 to 97 % over all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("n", type=int, help="number of seeds")
    parser.add_argument("--noise", type=float, default=0.02, help="of a pixel, in units of the contrast")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the name of an edge")
    asked = parser.parse_args(arguments)
    found = campaign(asked.n, noise=asked.noise, seed=asked.seed, only=asked.only)
    covered = float(np.mean([one.covered for one in found]))
    print(f"{len(found)} edges: the band holds {100 * covered:.1f} %")
    is_biased = any(abs(one.bias) > 0.005 + 4 * one.bias_error for one in found)
    return int(is_biased or not 0.93 <= covered <= 0.97)


if __name__ == "__main__":
    sys.exit(main())
