"""Thresholds of random cameras that count photons against light, optics and electrons by code apart.

python tests/campaigns/cameras.py 20     # five minutes

Each camera has pixels, lens, obscuration, defocus, motion, light and noise of its own; some have a table of their
MTF. The code here has the spectrum of a triangle by its edges, the MTF by the pupil's autocorrelation, and draws
electrons; it shares the observer with the packages, and nothing of the sensor. At `curve`'s threshold, P(correct)
of drawn exposures is held against that of the package at the same places: the mean over places alone is not
checked. The exit status is 1 if a threshold is off by more than 1 %, 2.5 times the standard error of the draws and
the stated bound together.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent))

from overlaps import weights_at

import sensor_sim as ss
from sensor_sim.chain.photons import contrast_variance
from sensor_sim.thresholds.curve_plan import full_plan
from sensor_sim.thresholds.predict import FoldedChain
from todframes.observers.decision import answer_probabilities
from todframes.observers.pyramid import PyramidObserver
from todframes.stimulus import ORIENTATIONS

MOST_OFF = 0.01
PLACES, DRAWS = 12, 3000
PUPIL, SHIFTS, ROWS = 400, 121, 61
WAVELENGTH_UM, PHOTONS_PER_LUX_S_UM2, FOCAL_MM = 0.555, 4000.0, 25.0

TEXT = """
schema = 1
[optics]
f_number = {f_number!r}
focal_length_mm = 25.0
wavelength_um = 0.555
transmission = {transmission!r}
{optics}
[motion]
smear_mrad = {smear!r}
jitter_sigma_mrad = {jitter!r}
[detector]
pitch_um = {pitch!r}
width_um = {width!r}
[scene]
luminance_cd_m2 = {luminance!r}
photons_per_lux_s_um2 = 4000.0
[noise]
model = "photon"
quantum_efficiency = {qe!r}
system_gain_dn_per_electron = {gain!r}
dark_noise_electrons = {dark_noise!r}
dark_current_electrons_per_s = {dark_current!r}
dsnu_electrons = {dsnu!r}
prnu_percent = {prnu!r}
bits = 16
exposure_ms = {exposure!r}
row_noise_electrons = {row!r}
[display]
pixels_per_detector = 2
pixel_pitch_mm = 0.25
viewing_distance_mm = 600.0
background_luminance_cd_m2 = 50.0
"""


class Drawn(NamedTuple):
    """A camera by its numbers, and the MTF of its aperture at frequencies over the cut-off."""

    values: dict[str, float]
    radial: NDArray[np.float64]
    text: str
    table: str


def pupil_mtf(ratio: float, waves: float) -> NDArray[np.float64]:
    """Return the autocorrelation of an annular, defocused pupil at `SHIFTS` shifts from 0 to its diameter."""
    grid = (np.arange(PUPIL) + 0.5) / PUPIL * 2.0 - 1.0
    x, y = np.meshgrid(grid, grid)

    def pupil(at: NDArray[np.float64]) -> NDArray[np.complex128]:
        square = at**2 + y**2
        return ((square <= 1.0) & (square >= ratio**2)) * np.exp(2j * np.pi * waves * square)

    found = np.array([(pupil(x + s) * pupil(x - s).conj()).sum().real for s in np.linspace(0.0, 1.0, SHIFTS)])
    return found / found[0]


def drawn(rng: np.random.Generator) -> Drawn:
    """Draw a realistic camera."""
    pitch, f_number, is_table = rng.uniform(2.5, 5.0), rng.uniform(2.8, 8.0), bool(rng.random() < 0.4)
    v = {
        "pitch": pitch, "width": pitch * rng.uniform(0.7, 1.0), "f_number": f_number,
        "transmission": rng.uniform(0.7, 1.0), "smear": pitch / FOCAL_MM * rng.uniform(0.0, 2.0),
        "jitter": pitch / FOCAL_MM * rng.uniform(0.0, 0.5), "qe": rng.uniform(0.3, 0.8),
        "gain": rng.uniform(0.3, 2.0), "dark_noise": rng.uniform(2.0, 10.0),
        "dark_current": rng.uniform(0.0, 300.0), "dsnu": rng.uniform(0.0, 3.0),
        "prnu": rng.uniform(0.0, 1.5), "exposure": rng.uniform(5.0, 30.0), "row": rng.uniform(0.0, 1.0),
        "luminance": math.exp(rng.uniform(math.log(0.5), math.log(20.0))),
    }  # fmt: skip
    v = {key: float(one) for key, one in v.items()}
    ratio, waves = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.0, 0.4))
    radial, end = pupil_mtf(ratio, waves), 1000.0 / (WAVELENGTH_UM * f_number)
    table, optics = "", f"obscuration_ratio = {ratio!r}\ndefocus_waves = {waves!r}"
    if is_table:
        radial = np.maximum(radial, 0.0)
        at = np.linspace(0.0, 1.0, ROWS)
        values = np.interp(at, np.linspace(0.0, 1.0, SHIFTS), radial)
        table = "frequency_cyc_per_mm,mtf\n" + "".join(
            f"{f!r},{m!r}\n" for f, m in zip((at * end).tolist(), values.tolist(), strict=True)
        )
        optics = 'mtf = "mtf.csv"'
    return Drawn(v, radial, TEXT.format(optics=optics, **v), table)


def triangle_spectrum(kx: NDArray, ky: NDArray, size: float, turns: int) -> NDArray[np.complex128]:
    """Transform a triangle about its centroid, apex up and turned clockwise, by the integral along its edges."""
    side = size * math.sqrt(4.0 / math.sqrt(3.0))
    height = side * math.sqrt(3.0) / 2.0
    corners = np.array([(0.0, -2 * height / 3), (side / 2, height / 3), (-side / 2, height / 3)])
    for _ in range(turns):
        corners = np.stack([-corners[:, 1], corners[:, 0]], axis=1)
    total = np.zeros(np.broadcast_shapes(kx.shape, ky.shape), dtype=np.complex128)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        ex, ey = x1 - x0, y1 - y0
        middle = kx * (x0 + x1) / 2 + ky * (y0 + y1) / 2
        total += (kx * ey - ky * ex) * np.exp(-2j * np.pi * middle) * np.sinc(kx * ex + ky * ey)
    square = kx**2 + ky**2
    found = 1j / (2 * np.pi) * total / np.where(square > 0.0, square, 1.0)
    return np.where(square > 0.0, found, size**2)


def samples(camera: Drawn, size: float, field: int, x: float, y: float, turns: int) -> NDArray[np.float64]:
    """Return the signal of each pixel, (field, field), for a triangle of contrast 1."""
    v, period = camera.values, 3 * field
    cut_off = v["pitch"] / (WAVELENGTH_UM * v["f_number"])
    k = np.arange(-math.ceil(cut_off * period), math.ceil(cut_off * period) + 1) / period
    kx, ky = k[None], k[:, None]
    to_mrad = FOCAL_MM / v["pitch"]
    radial = np.hypot(kx, ky)
    optics = np.interp(radial / cut_off, np.linspace(0.0, 1.0, SHIFTS), camera.radial, right=0.0)
    fill = v["width"] / v["pitch"]
    jitter = np.exp(-2.0 * (np.pi * v["jitter"] * to_mrad * radial) ** 2)
    seen = optics * np.sinc(fill * kx) * np.sinc(fill * ky) * np.sinc(v["smear"] * to_mrad * kx) * jitter
    seen = seen * triangle_spectrum(kx, ky, size, turns)
    place = np.arange(field) - (field - 1) / 2.0
    waves_y, waves_x = (np.exp(2j * np.pi * np.outer(place - at, k)) for at in (y, x))
    return np.asarray((waves_y @ seen @ waves_x.T).real / period**2)


def exposures(camera: Drawn, contrast: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the contrasts that `DRAWS` cameras report, (draws, pixels), from photons up."""
    v, field = camera.values, contrast.shape[0]
    lux = math.pi * v["transmission"] * v["luminance"] / (4.0 * v["f_number"] ** 2)
    mean = v["qe"] * PHOTONS_PER_LUX_S_UM2 * lux * v["pitch"] ** 2 * v["exposure"] / 1000.0
    dark, shape = v["dark_current"] * v["exposure"] / 1000.0, (DRAWS, field, field)
    response = 1.0 + v["prnu"] / 100.0 * rng.standard_normal(shape)
    electrons = rng.poisson(np.maximum(mean * (1.0 + contrast) * response, 0.0) + dark).astype(np.float64)
    electrons += math.hypot(v["dark_noise"], v["dsnu"]) * rng.standard_normal(shape)
    electrons += v["row"] * rng.standard_normal((DRAWS, field, 1))
    counted = np.rint(v["gain"] * electrons) / v["gain"]
    return ((counted - dark) / mean - 1.0).reshape(DRAWS, -1)


def compared(camera: Drawn, folder: Path, rng: np.random.Generator) -> tuple[str, bool]:
    """Return the line of a camera, and whether its threshold is right."""
    (folder / "sensor.toml").write_text(camera.text, encoding="utf-8")
    (folder / "mtf.csv").write_text(camera.table, encoding="utf-8")
    sensor, size = ss.load_sensor(folder / "sensor.toml"), float(rng.choice([3.0, 4.0, 5.0]))
    observer = PyramidObserver()
    (fit,) = ss.curve(sensor, size_detectors=[size], tolerance=0.01, examples=False).fits
    name = f"{'table' if camera.table else 'model'}, {size:g} detectors"
    if fit.threshold is None:
        return f"{name}: {fit.status}", True
    chain = FoldedChain(sensor, observer, size, full_plan(sensor, observer, size))
    readout, variance = chain.readout, contrast_variance(sensor)
    at = np.array([(math.log(one.level), one.p_correct) for one in fit.points])
    slope = float(np.interp(math.log(fit.threshold), at[:, 0], np.gradient(at[:, 1], at[:, 0])))
    differences, errors = [], []
    for n in range(PLACES):
        orientation = ORIENTATIONS[n % 4]
        x, y = rng.uniform(-0.5, 0.5, 2)
        weights = weights_at(sensor, readout, chain.field, x, y)
        signal = fit.threshold * samples(camera, size, chain.field, x, y, orientation.quarter_turns)
        scores = exposures(camera, signal, rng) @ weights.T
        right = answer_probabilities(scores, readout.noise_covariance)[:, orientation.quarter_turns]
        own = fit.threshold * chain.sampler.samples(x, y, orientation=orientation)[0].ravel()
        white = variance.white + variance.per_signal * own + variance.per_squared_signal * own**2
        rows = weights.reshape(4, chain.field, chain.field).sum(axis=2)
        covariance = readout.noise_covariance + (weights * white) @ weights.T + variance.row * rows @ rows.T
        computed = answer_probabilities((weights @ own)[None], covariance)[0, orientation.quarter_turns]
        differences.append(right.mean() - computed)
        errors.append(right.std() / math.sqrt(DRAWS))
    off, error = (float(one) / slope for one in (np.mean(differences), np.linalg.norm(errors) / PLACES))
    bound = fit.p_correct_error_bound / slope
    is_right = abs(off) <= MOST_OFF + 2.5 * error + bound
    line = f"{name}: off by {100 * off:+.2f} % ± {100 * error:.2f} %, bound {100 * bound:.2f} %"
    return ("" if is_right else "FAULT ") + line, is_right


def main() -> int:
    """Compare cameras; return 1 if a threshold is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("n", type=int, nargs="?", default=20)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    n_wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(asked.n):
            rng = np.random.default_rng([asked.seed, number])
            line, is_right = compared(drawn(rng), Path(folder), rng)
            n_wrong += not is_right
            print(f"{number}: {line}", flush=True)
    print(f"{asked.n} cameras, {n_wrong} faults")
    return int(bool(n_wrong))


if __name__ == "__main__":
    sys.exit(main())
