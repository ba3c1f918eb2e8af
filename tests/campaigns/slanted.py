"""Bias and coverage of the MTF of slanted edges, over simulated edges of known MTF; minutes.

OPENBLAS_NUM_THREADS=1 python tests/campaigns/slanted.py 300   # 300 seeds for each edge, 2 % noise
python tests/campaigns/slanted.py 100 --noise 0.005 --only gaussian
python tests/campaigns/slanted.py 60 --shared smoothed          # noise that neighbouring pixels share
python tests/campaigns/slanted.py 300 --smooth                  # smooth edges of all kinds: is one refused?
python tests/campaigns/slanted.py 300 --torn                    # torn and wavy ones: is one measured?

The edges are those of tests/camera/edges.py, of 120 x 80 pixels. docs/evidence/validation.md has the figures.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scenes import parser_of
from scipy.ndimage import convolve, gaussian_filter, uniform_filter

sys.path.insert(0, str(Path(__file__).parents[1] / "camera"))

from edges import diffraction, edge_image, gaussian, true_mtf

from todframes.base.errors import DataError
from todframes.camera.edge_mtf import FREQUENCY_CYC_PER_PIXEL, NYQUIST, EdgeMtf, measure_edge

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

LOW = 12
"""Number of frequencies, up to 0.19 cycles/pixel, whose coverage is printed apart."""


def interpolated(noise: np.ndarray) -> np.ndarray:
    """Noise of every other pixel, as in a mosaic of colours, and its means between."""
    seen = np.indices(noise.shape).sum(0) % 2 == 0
    means = convolve(noise * seen, [[0, 0.25, 0], [0.25, 0, 0.25], [0, 0.25, 0]], mode="mirror")
    return np.where(seen, noise, means)


SHARED: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "none": lambda image, noise: image + noise,
    "smoothed": lambda image, noise: image + 3.0 * uniform_filter(noise, 3),
    "blurred": lambda image, noise: image + 5.3 * gaussian_filter(noise, 1.5),
    "interpolated": lambda image, noise: image + interpolated(noise),
}
"""Cameras whose pixels share noise: a picture of an edge and independent noise."""


class Edge(NamedTuple):
    """Largest bias up to the Nyquist frequency with its standard error, and coverage over all its frequencies."""

    bias: float
    bias_error: float
    covered: float
    low_covered: float
    least_width: float


def repeated(name: str, angle_deg: float, n: int, *, noise: float, seed: int, shared: str) -> Edge:
    """Measure an edge with new noise n times, and print a line."""
    optics = OPTICS[name]
    is_level = abs((angle_deg + 90) % 180 - 90) > 45
    shape = (SHORT_PX, LONG_PX) if is_level else (LONG_PX, SHORT_PX)
    image = edge_image(shape, angle_deg, optics, low=0.2, high=0.2 + CONTRAST)
    box = (0, 0, shape[1], shape[0])
    truth = true_mtf(FREQUENCY_CYC_PER_PIXEL[1 : NYQUIST + 1], optics, angle_deg)
    fine = np.linspace(0.0, 1.0, 10_001)
    mtf50 = float(fine[np.argmax(true_mtf(fine, optics, angle_deg) < 0.5)])
    measured: list[EdgeMtf] = []
    for number in range(n):
        rng = np.random.default_rng([seed, number])
        measured.append(measure_edge(SHARED[shared](image, rng.normal(0.0, noise * CONTRAST, shape)), box))
    curves = [[one.curves[k, 1 : NYQUIST + 1] for one in measured] for k in range(3)]
    mtf, low, high = np.array(curves)
    bias, held = mtf.mean(0) - truth, (low <= truth) & (truth <= high)
    k = int(np.argmax(np.abs(bias)))
    errors = float(bias[k]), float(mtf[:, k].std() / math.sqrt(n))
    edge = Edge(*errors, float(held.mean()), float(held[:, :LOW].mean()), float((high - low).min()))
    records = [one.record for one in measured if one.record.mtf50_cyc_per_pixel is not None]
    ends = [one.mtf50_cyc_per_pixel_ci95 or (None, None) for one in records]
    mtf50_covered = np.mean([(a or 0.0) <= mtf50 <= (b or 1.0) for a, b in ends])
    noiseless = np.abs(measure_edge(image, box).mtf[1 : NYQUIST + 1] - truth).max()
    print(
        f"{f'{name}, {angle_deg:g}°':28} bias {100 * edge.bias:+.2f} ± {100 * edge.bias_error:.2f} %, "
        f"without noise {100 * noiseless:.2f} %, band holds {100 * edge.covered:.1f} %, "
        f"at low frequencies {100 * edge.low_covered:.1f} %, that of MTF50 {100 * mtf50_covered:.1f} %, "
        f"least width {edge.least_width:.1e}",
        flush=True,
    )
    return edge


NOISES = ("pixels", "by light", "rows", "columns", "dead", "shading", "8 bits", *SHARED)
"""Kinds of noise and unevenness of smooth edges."""


def smooth_edge(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return a picture of an edge that must not be refused as torn, and its name."""
    shape = (int(rng.integers(44, 130)), int(rng.integers(44, 130)))
    angle_deg = float(rng.uniform(2.0, 43.0) * rng.choice([-1, 1]) + 90 * rng.integers(4))
    optics = gaussian(rng.uniform(0.35, 2.5)) if rng.random() < 0.7 else diffraction(rng.uniform(0.4, 1.3))
    radius_px = math.inf if rng.random() < 0.5 else float(rng.uniform(3.0, 30.0)) * max(shape)
    image = edge_image(shape, angle_deg, optics, radius_px=radius_px)
    kind = str(rng.choice(NOISES))
    sd = CONTRAST * float(rng.choice([0.002, 0.01, 0.02, 0.05, 0.1]))
    noise = rng.normal(0.0, sd, shape)
    if kind == "by light":
        noise *= np.sqrt(np.maximum(image, 0.0) / 0.8)
    elif kind in ("rows", "columns"):
        noise = noise / 2 + rng.normal(0.0, sd, (shape[0], 1) if kind == "rows" else (1, shape[1]))
    elif kind == "shading":
        y, x = np.indices(shape) / max(shape)
        image *= 1.0 + 0.15 * (x - 0.5) - 0.1 * (y - 0.5) ** 2
    image = SHARED.get(kind, SHARED["none"])(image, noise)
    if kind == "dead":
        n = int(rng.integers(1, 12))
        image[rng.integers(0, shape[0], n), rng.integers(0, shape[1], n)] = rng.choice([0.0, 1.0])
    if kind == "8 bits":
        image = np.round(60.0 * image) / 60.0
    name = f"{shape[1]} x {shape[0]}, {angle_deg:.1f}°, {kind}, noise {sd / CONTRAST:g}, radius {radius_px:.0f}"
    return image, name


def torn_edge(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return a picture of an edge that is displaced by 0.5 to 8 pixels in places, and its name."""
    shape = (int(rng.integers(60, 130)), int(rng.integers(60, 130)))
    angle_deg = float(rng.uniform(2.0, 43.0) * rng.choice([-1, 1]) + 90 * rng.integers(4))
    kind = str(rng.choice(["wave", "tear", "notch", "rough", "sawtooth"]))
    height_px, length = float(rng.uniform(0.5, 8.0)), float(min(shape))
    period, phase = float(rng.uniform(6.0, length / 2.5)), float(rng.uniform())
    places = np.arange(-200.0, 200.0)
    rough = gaussian_filter(rng.normal(size=400), rng.uniform(2.0, 10.0))
    ways: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "wave": lambda s: np.sin(2 * np.pi * (s / period + phase)),
        "tear": lambda s: np.floor(s / period + phase) % 2,
        "notch": lambda s: np.abs(s - 0.3 * (phase - 0.5) * length) < max(period / 4, 4.0),
        "rough": lambda s: np.interp(s, places, rough / rough.std()),
        "sawtooth": lambda s: (s / period + phase) % 1.0,
    }
    optics = gaussian(rng.uniform(0.4, 1.5))
    image = edge_image(shape, angle_deg, optics, displaced_px=lambda s: height_px * ways[kind](s))
    noise = float(rng.choice([0.0, 0.002, 0.02, 0.05, 0.1]))
    name = f"{shape[1]} x {shape[0]}, {angle_deg:.1f}°, {kind} of {height_px:.2f} px, period {period:.1f}, "
    return image + rng.normal(0.0, noise * CONTRAST, shape), f"{name}noise {noise:g}"


def refusals(n: int, *, seed: int, are_torn: bool) -> int:
    """Measure random edges that are torn, or smooth; print and count those that ought to end otherwise."""
    ends: Counter[str] = Counter()
    n_wrong = 0
    for number in range(n):
        image, name = (torn_edge if are_torn else smooth_edge)(np.random.default_rng([seed, number]))
        try:
            end = f"MTF50 {measure_edge(image, (0, 0, image.shape[1], image.shape[0])).record.mtf50_cyc_per_pixel}"
        except DataError as error:
            end = str(error).split(": ", 1)[1]
        known = ("MTF50", "found an edge that departs", "found no edge", "noise of")
        ends[next((one for one in known if end.startswith(one)), "other")] += 1
        # Noise may leave the MTF of a smooth edge unknown; no other end is right.
        if end.startswith("MTF50") if are_torn else not end.startswith(("MTF50", "noise of")):
            n_wrong += 1
            print(f"{number}: {name}: {end}", flush=True)
    print(f"{n} {'torn' if are_torn else 'smooth'} edges: {dict(ends)}; {n_wrong} ought to end otherwise")
    return n_wrong


def main() -> int:
    """Print bias and coverage; exit status 1 beyond 1 % and four standard errors, or 90 to 98 % over all.
    With --smooth, 1 if an edge is refused; with --torn, if
    more than 2 % are measured.
    """
    parser = parser_of(__doc__)
    parser.add_argument("--noise", type=float, default=0.02, help="of a pixel, in units of the contrast")
    parser.add_argument("--only", default="", help="part of the name of an edge")
    parser.add_argument("--shared", choices=SHARED, default="none", help="how pixels share their noise")
    parser.add_argument("--smooth", action="store_true", help="random smooth edges: is one refused?")
    parser.add_argument("--torn", action="store_true", help="random edges that are not straight: is one measured?")
    asked = parser.parse_args()
    if asked.smooth or asked.torn:
        return int(refusals(asked.n, seed=asked.seed, are_torn=asked.torn) > 0.02 * asked.n * asked.torn)
    how = {"noise": asked.noise, "seed": asked.seed, "shared": asked.shared}
    edges = [one for one in product(OPTICS, ANGLES_DEG) if asked.only in "{}, {:g}°".format(*one)]
    measured = [repeated(*edge, asked.n, **how) for edge in edges]
    covered, low = (
        float(np.mean([getattr(one, name) for one in measured])) for name in ("covered", "low_covered")
    )
    print(f"{len(measured)} edges: the band holds {100 * covered:.1f} %, at low frequencies {100 * low:.1f} %")
    is_biased = any(abs(one.bias) > 0.01 + 4 * one.bias_error for one in measured)
    has_width = all(one.least_width > 1e-6 for one in measured)
    least = 0.9
    return int(is_biased or not has_width or not least <= min(covered, low) or covered > 0.98)


if __name__ == "__main__":
    sys.exit(main())
