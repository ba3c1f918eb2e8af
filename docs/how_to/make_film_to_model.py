"""Makes the numbers and the picture of film_to_model.md, in five minutes.

python docs/how_to/make_film_to_model.py [FOLDER]

The picture goes to FOLDER/film_to_model, text to FOLDER/film_to_model.md between <!-- =NAME --> and <!-- / -->; by
default that is the folder of this script. Seeds are fixed. Camera and film are those of tests/camera.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "tests" / "camera"))

from closing_circle import Closed, FilmingCamera, closed, make_film  # noqa: E402

SIZES_MRAD, CONTRASTS = (1.0, 1.4, 2.0), (0.06, 0.1, 0.16, 0.25, 0.4)


def figures(found: Closed, camera: FilmingCamera) -> str:
    """Return the table of what the film gives, beside the truth."""
    noise, mtf = found.camera.emva.noise.emva1288, found.camera.mtf.mtf
    frequency = np.linspace(0.01, 1.0, 1000)
    true_mtf = np.exp(-2.0 * (np.pi * frequency * camera.blur_sigma_px) ** 2) * np.sinc(frequency)
    electrons = camera.electrons_at_white * noise.background_cd_m2 / 100.0
    rows = [
        ("system gain (DN/e⁻)", "system_gain", camera.gain_dn_per_electron, 3),
        ("dark noise with its rows (e⁻)", "dark_noise",
         float(np.hypot(camera.dark_noise_electrons, camera.row_noise_electrons)), 3),
        ("DSNU (e⁻)", "dsnu", camera.dsnu_electrons, 3),
        ("PRNU (%)", "prnu", camera.prnu_percent, 3),
        ("background (e⁻)", "background_electrons", electrons, 4),
    ]  # fmt: skip
    lines = ["| | from the film | 95 % interval | the camera's own |", "|---|---|---|---|"]
    for name, key, true, digits in rows:
        value, (low, high) = getattr(noise, key), getattr(noise, f"{key}_ci95")
        lines.append(
            f"| {name} | {value:.{digits}g} | {low:.{digits}g} to {high:.{digits}g} | {true:.{digits}g} |"
        )
    low, high = mtf.mtf50_ci95
    true50 = float(np.interp(-0.5, -true_mtf, frequency))
    lines.append(f"| MTF50 (cycles/pixel) | {mtf.mtf50:.3f} | {low:.3f} to {high:.3f} | {true50:.3f} |")
    fall_off = (
        "The light at the patch of the background is some per cent less than in the middle, as it falls off."
    )
    return "\n".join([*lines, "", fall_off, ""])


def curves(found: Closed) -> str:
    """Return the table of the two curves."""
    lines = [
        "| size (mrad) | in pixels | threshold of the film | 95 % interval | of the model | numerical error |",
        "|---|---|---|---|---|---|",
    ]
    for film, model in zip(found.film.fits, found.model.fits, strict=True):
        size, (low, high) = film.group["object_size_mrad"], film.threshold_ci95
        lines.append(
            f"| {size:g} | {found.size_detectors[size]:.2f} | {film.threshold:.3f} | {low:.3f} to {high:.3f} | "
            f"{model.threshold:.3f} | ± {model.threshold_numerical_error:.3f} |"
        )
    return "\n".join([*lines, ""])


def picture(found: Closed, path: Path) -> None:
    """Draw the two curves."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    sizes = [fit.group["object_size_mrad"] for fit in found.film.fits]
    films = np.array([fit.threshold for fit in found.film.fits])
    ends = np.array([fit.threshold_ci95 for fit in found.film.fits]).T
    axes.errorbar(sizes, films, np.abs(ends - films), fmt="o", color="#0072b2", capsize=3, label="film, 95 %")
    models = [fit.threshold for fit in found.model.fits]
    axes.plot(sizes, models, "-", color="#d55e00", label="model from the film")
    axes.set(xscale="log", yscale="log", xlabel="size √area (mrad)", ylabel="threshold contrast")
    axes.set_xticks(sizes, [f"{one:g}" for one in sizes])
    axes.minorticks_off()
    ticks = [0.08, 0.1, 0.15, 0.2, 0.3]
    axes.set_yticks(ticks, [f"{one:g}" for one in ticks])
    axes.legend(frameon=False)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=110)


def write(folder: Path, parts: dict[str, str]) -> None:
    """Write the parts into the page."""
    page = folder / "film_to_model.md"
    text = page.read_text(encoding="utf-8")
    for name, content in parts.items():
        place = re.compile(rf"(<!-- ={name} -->\n).*?(<!-- / -->)", re.DOTALL)
        text, count = place.subn(lambda found, new=content: found[1] + new + found[2], text)
        if count != 1:
            raise SystemExit(f"{page}: found <!-- ={name} --> {count} times, expected once")
    page.write_text(text, encoding="utf-8")


def main() -> None:
    """Make film, model, numbers and picture."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE
    with tempfile.TemporaryDirectory() as made:
        work = Path(made)
        camera = make_film(work, sizes_mrad=SIZES_MRAD, contrasts=CONTRASTS, repeats=4, seed=21)
        found = closed(work)
        toml = (work / "camera" / "sensor.toml").read_text(encoding="utf-8")
    write(folder, {"figures": figures(found, camera), "toml": f"```toml\n{toml}```\n", "curves": curves(found)})
    picture(found, folder / "film_to_model" / "curves.png")


if __name__ == "__main__":
    main()
