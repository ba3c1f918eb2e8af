"""Scoring against decoding alone, the pyramid against pyrtools, the start of the command, memory."""

from __future__ import annotations

import csv
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from timing import Row, best_s, cpu_ratio, paired_ratio, process

from todframes.diagnosis.inspection import inspect
from todframes.frames.dataset import load_dataset
from todframes.frames.files import frame_sha256, write_frame
from todframes.observers.pyramid import LaplacianPyramid, PyramidObserver
from todframes.scoring.score import score_dataset
from todframes.stimulus import ORIENTATIONS, coverage

SIDE, PITCH_MRAD, SIZE_MRAD = 512, 0.7, 10.0
DISTINCT = 40
SCORE = "import sys; from todframes.cli.main import main; main(['score', sys.argv[1], '--json', '--quiet'])"
CSF = SCORE.replace("'--json'", "'--observer', 'csf', '--json'")
COMPARE = (
    "import sys; from todframes.cli.main import main; main(['compare', sys.argv[1], '--enhance', 'unsharp', "
    "'--allow-clipping', '--observer', sys.argv[2], '--json', '--quiet'])"
)
SAMPLES = Path(__file__).parents[2] / "sample_frames"
DECODE = """
import sys, pathlib, OpenImageIO as oiio
for path in sorted(pathlib.Path(sys.argv[1]).glob("frames/*")):
    image = oiio.ImageInput.open(str(path))
    assert image.read_image() is not None
    image.close()
"""

VALIDATE = "import sys; from todframes.cli.main import main; main(['validate', sys.argv[1]])"
DECODE_PNG = """
import sys, pathlib, numpy
from PIL import Image
for path in sorted(pathlib.Path(sys.argv[1]).glob("frames/*")):
    assert numpy.asarray(Image.open(path)).size
"""


def measuring_share(folder: Path) -> float:
    """Processor time of measuring what the frames show, as a share of that of scoring them."""
    dataset, observer = load_dataset(folder), PyramidObserver()
    inspect(dataset, dataset.trials[:8])
    started = time.process_time()
    score_dataset(dataset, observer)
    scored = time.process_time()
    inspect(dataset, dataset.trials)
    return (time.process_time() - scored) / (scored - started)


def make_dataset(
    folder: Path, n_frames: int, suffix: str, *, side: int = SIDE, size_mrad: float = SIZE_MRAD
) -> None:
    """Noisy frames with a triangle near the middle; a few distinct ones, copied."""
    (folder / "frames").mkdir(parents=True)
    white = 100.0 if suffix == "png" else 1.0
    (folder / "dataset.toml").write_text(
        f'schema = 1\n[display]\neotf = "linear"\nwhite_luminance_cd_m2 = {white}\n'
        f"pixel_pitch_mrad = {PITCH_MRAD}\n"
        'background_luminance_cd_m2 = 50.0\n[experiment]\nlevel = "contrast"\ngroup_by = ["size_mrad"]\n',
        encoding="utf-8",
    )
    rng = np.random.default_rng(0)
    rows: list[list[object]] = []
    for number in range(n_frames):
        name = f"frames/{number:05}.{suffix}"
        if number < DISTINCT:
            orientation, contrast = ORIENTATIONS[number % 4], 0.02 + 0.01 * (number // 4 % 5)
            x, y = (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            triangle = coverage(
                (side, side), size_px=size_mrad / PITCH_MRAD, x_px=x, y_px=y, orientation=orientation
            )
            noise = 0.02 * rng.normal(size=triangle.shape)
            write_frame(folder / name, 50.0 / white * (1.0 + contrast * triangle + noise))
            rows.append([orientation.value, size_mrad, contrast, x, y])
        else:
            shutil.copyfile(folder / f"frames/{number % DISTINCT:05}.{suffix}", folder / name)
    with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "orientation", "size_mrad", "contrast", "x_px", "y_px"])
        for number in range(n_frames):
            writer.writerow([f"frames/{number:05}.{suffix}", *rows[number % DISTINCT]])


def linked(path: Path, n_trials: int, *, side: int = SIDE, size_mrad: float = SIZE_MRAD) -> Path:
    """Write a dataset of links to a few PNG files, with checksums."""
    kinds = path / "kinds"
    make_dataset(kinds, DISTINCT, "png", side=side, size_mrad=size_mrad)
    header, *rows = (kinds / "manifest.csv").read_text(encoding="utf-8").splitlines()
    (kinds / "dataset.toml").rename(path / "dataset.toml")
    checksums = [frame_sha256(kinds / row.partition(",")[0]) for row in rows]
    with (path / "manifest.csv").open("w") as manifest:
        manifest.write(f"{header},sha256\n")
        for number in range(n_trials):
            frame, _, row = rows[number % DISTINCT].partition(",")
            name = f"frames/{number // 1000:04d}/trial_{number:07d}.png"
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).hardlink_to(kinds / frame)
            manifest.write(f"{name},{row},{checksums[number % DISTINCT]}\n")
    return path


def rows() -> list[Row]:
    """All ratios of this file."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for suffix, asked in (("exr", "<= 0.6"), ("png", "<= 1.15")):
            make_dataset(folder / suffix, 1000, suffix)
            dataset = str(folder / suffix)
            ratio = paired_ratio(["-c", SCORE, dataset], ["-c", DECODE, dataset], 5)
            found.append(
                Row(f"score 1000 {suffix.upper()} frames ÷ decode them whole, whole processes", ratio, asked)
            )
            found.append(
                Row(
                    f"measuring {suffix.upper()} frames ÷ scoring them", measuring_share(folder / suffix), "<= 0.1"
                )
            )
            decode = DECODE_PNG if suffix == "png" else DECODE
            ratio = paired_ratio(["-c", VALIDATE, dataset], ["-c", decode, dataset], 3)
            found.append(
                Row(f"validate 1000 {suffix.upper()} frames ÷ decode them, whole processes", ratio, "<= 1")
            )
        make_dataset(folder / "many", 10_000, "exr")
        few, many = (process("-c", SCORE, str(folder / part)).peak_mb for part in ("exr", "many"))
        found.append(Row(f"peak memory, 10000 frames ({many:.0f} MB) ÷ 1000 frames", many / few, "<= 1.1"))
    ratio = paired_ratio(["-m", "todframes", "--help"], ["-c", "import numpy"], 15)
    found.append(Row("todframes --help ÷ import numpy, whole processes", ratio, "<= 2.5"))
    return [*found, *observer_rows(), *pyramid_rows()]


def observer_rows() -> list[Row]:
    """CPU time of `csf` over that of the pyramid; of the first two sets, csf reaches few thresholds."""
    found = []
    for name in ("naked_eye", "staring_camera", "enhancement"):
        ratio = cpu_ratio(["-c", CSF, str(SAMPLES / name)], ["-c", SCORE, str(SAMPLES / name)], 3)
        found.append(Row(f"score {name} with csf ÷ with pyramid, CPU time of whole processes", ratio, "<= 1.5"))
    both, one = (["-c", COMPARE, str(SAMPLES / "enhancement"), name] for name in ("pyramid,csf", "pyramid"))
    found.append(
        Row("compare by both ÷ by one observer, CPU time of whole processes", cpu_ratio(both, one, 3), "<= 1.3")
    )
    return found


def pyramid_rows() -> list[Row]:
    """Bands of a 257 × 257 image, the same values (÷ 2^k) from both."""
    import pyrtools

    image = np.random.default_rng(0).normal(size=(257, 257))
    pyramid = LaplacianPyramid(6)
    theirs = pyrtools.pyramids.LaplacianPyramid(image, height=7).pyr_coeffs
    for k, band in enumerate(pyramid.build(image)):
        assert np.allclose(band, theirs[(k, 0)] / 2**k, rtol=0.0, atol=1e-14)
    reference_s = best_s(lambda: pyrtools.pyramids.LaplacianPyramid(image, height=7), 200)
    ours_s = best_s(lambda: pyramid.build(image), 500)
    return [
        Row(
            f"pyramid, 257², 6 bands ({ours_s * 1e3:.2f} ms), times faster than pyrtools",
            reference_s / ours_s,
            ">= 5",
        )
    ]
