"""Memory that large frames take, and what is refused before any of it is taken."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import error_line

from todframes.diagnosis.locate import locate_triangles
from todframes.frames.contrast import read_contrast
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, read_frame, write_frame
from todframes.observers.pyramid import PyramidObserver
from todframes.stimulus import ORIENTATIONS, coverage

SIDE_PX, SIZE_PX, PITCH_MRAD = 4000, 1000.0, 0.01
FILM = Path(__file__).parents[2] / "sample_frames" / "filmed_chart"
DECODED_MB = SIDE_PX**2 / 2**20
PEAK = """
import sys
from pathlib import Path
from todframes.cli.main import cli
from todframes.cli.console import keep_libraries_to_one_thread, run
keep_libraries_to_one_thread()
status = run(cli, sys.argv[1:])
(line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
print("peak", int(line.split()[1]) / 1024, file=sys.stderr)
sys.exit(status)
"""

linux = pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")


@pytest.fixture(scope="module")
def large_frames(tmp_path_factory):
    """Grey 8-bit PNG of 4000 × 4000 pixels; the observer's grid covers nearly all of each."""
    folder = tmp_path_factory.mktemp("large")
    (folder / "frames").mkdir()
    rows = ["frame,orientation,size_mrad,contrast"]
    for orientation in ORIENTATIONS:
        middle = (SIDE_PX - 1) / 2
        shape = coverage(
            (SIDE_PX, SIDE_PX), size_px=SIZE_PX, x_px=middle, y_px=middle, orientation=orientation
        ).astype(np.float32)
        write_frame(folder / f"frames/{orientation}.png", 0.5 + 0.05 * shape, pixel_type="uint8")
        rows.append(f"frames/{orientation}.png,{orientation},{SIZE_PX * PITCH_MRAD},0.1")
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")
    return folder


def settings(background: str, pitch_mrad: float = PITCH_MRAD) -> str:
    return (
        f"schema = 1\n[display]\neotf = 'linear'\nwhite_luminance_cd_m2 = 100.0\npixel_pitch_mrad = {pitch_mrad}\n"
        f"background_luminance_cd_m2 = {background}\n[experiment]\nlevel = 'contrast'\n"
    )


@pytest.mark.slow
@linux
@pytest.mark.parametrize(
    ("command", "background"),
    [("score", "'surround'"), ("validate", "50.0"), ("score --workers 2", "'surround'"),
     *(pytest.param(*case, marks=pytest.mark.weekly) for case in (
        ("score", "50.0"), ("score", "'border'"), ("score", "'frame_mean'"), ("validate", "'border'"),
        ("score --locate", "50.0")))],
)  # fmt: skip
def test_a_large_frame_takes_little_more_than_its_pixels(large_frames, command, background) -> None:
    """Three times the decoded frame for each worker, and 200 MB, the libraries among them."""
    (large_frames / "dataset.toml").write_text(settings(background))
    n_workers = 2 if "--workers 2" in command else 1
    command = [sys.executable, "-c", PEAK, *command.split(), str(large_frames)]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    peak_mb = float(found.stderr.split()[-1])
    assert peak_mb <= 3 * DECODED_MB * n_workers + 200.0


def test_bands_are_the_frame(tmp_path) -> None:
    """Chunks of 16 rows, and a first row of the data window that is none of the frame's first."""
    values = np.random.default_rng(0).uniform(0.2, 0.8, (1500, 1000)).astype(np.float32)
    write_frame(tmp_path / "a.exr", values, pixel_type="half")
    write_frame(tmp_path / "a.png", values, pixel_type="uint16")
    for name in ("a.exr", "a.png"):
        with FrameFile(tmp_path / name) as file:
            bands = list(file.bands(rows=(7, 1490), columns=(3, 990)))
        assert len(bands) > 2
        assert [band.first_row for band in bands[1:]] == [b.first_row + len(b.stored) for b in bands[:-1]]
        whole = read_frame(tmp_path / name).values[7:1490, 3:990]
        assert np.array_equal(np.concatenate([band.values for band in bands]), whole)


@pytest.mark.parametrize("background", [pytest.param("50.0", marks=pytest.mark.slow), "'border'", "'frame_mean'"])
def test_contrast_by_bands_is_that_of_the_whole(make_dataset, background) -> None:
    """More pixels than are held as contrast, against the definitions on the whole frame."""
    rule = background.strip("'")
    made = make_dataset(contrasts=(0.5,), display={"background_luminance_cd_m2": 50.0 if rule == "50.0" else rule})
    values = np.random.default_rng(0).uniform(0.2, 0.8, (1100, 1300)).astype(np.float16)
    write_frame(made.frame(0), 50.0 * values, pixel_type="half")
    dataset = load_dataset(made.path)
    frame = dataset.trials[0].frames[0]
    with FrameFile(made.frame(0)) as file:
        patch = read_contrast(file, dataset.display, frame)
        part = read_contrast(file, dataset.display, frame, (400, 700), (1000, 1200))
    luminance = read_frame(made.frame(0)).values[..., 0].astype(np.float64)
    ring = np.concatenate([luminance[0], luminance[-1], luminance[1:-1, 0], luminance[1:-1, -1]])
    expected = {"50.0": 50.0, "'border'": ring.mean(), "'frame_mean'": luminance.mean()}[background]
    assert patch.to_contrast is not None
    contrast = np.concatenate([band.values for band in patch.bands()])
    # A mean of a million numbers is right to 1e-12 of itself in any order.
    assert np.allclose(contrast, luminance / expected - 1.0, rtol=0.0, atol=1e-11)
    assert np.allclose(part.values, contrast[400:700, 1000:1200], rtol=0.0, atol=1e-15)


@pytest.mark.slow
def test_large_frames_are_located_by_blocks(large_frames) -> None:
    (large_frames / "dataset.toml").write_text(settings("50.0"))
    _, (found,) = locate_triangles(load_dataset(large_frames))
    # Without noise but that of 8 bits, which no threshold of contrast brings near to a block's hundredth.
    assert (found.x_px, found.y_px) == pytest.approx((1999.5, 1999.5), abs=0.03)


@pytest.mark.slow
def test_a_triangle_too_small_for_blocks_is_refused(tmp_path, todframes) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "dataset.toml").write_text(settings("50.0", 1.0))
    write_frame(tmp_path / "frames/a.png", np.full((4097, 4097), 0.5, np.float32), pixel_type="uint8")
    (tmp_path / "manifest.csv").write_text("frame,orientation,size_mrad,contrast\nframes/a.png,up,7.0,0.1\n")
    error = error_line(todframes("score", tmp_path, "--locate"), 1)
    assert "4097 × 4097 pixels are too many" in error and "x_px" in error


@pytest.mark.parametrize("on_error", ["stop", "skip"])
def test_what_does_not_fit_is_told_before_its_readout_is_made(
    make_dataset, todframes, monkeypatch, on_error
) -> None:
    """300 mrad on a frame of 16: its weights alone would take gigabytes."""
    made = make_dataset(contrasts=(0.5,))
    for row in made.rows:
        row["size_mrad"] = "300.0"
    made.save()

    def too_large(*_):
        raise AssertionError("a readout was made")

    monkeypatch.setattr(PyramidObserver, "make_readout", too_large)
    error = error_line(todframes("score", made.path, "--on-error", on_error), 1)
    assert "smaller than the triangle of 300 mrad" in error


def test_a_missing_file_is_told_before_frames_are_read(make_dataset, todframes, monkeypatch) -> None:
    made = make_dataset(repeats=2)
    made.frame(13).unlink()
    monkeypatch.setattr(FrameFile, "bands", lambda *_, **__: pytest.fail("pixels were read"))
    assert str(made.frame(13)) in error_line(todframes("score", made.path), 1)


def test_problems_alike_are_folded(make_dataset, todframes) -> None:
    made = make_dataset(repeats=5)
    for number in range(30):
        made.frame(number).unlink()
    made.frame(35).write_bytes(b"no frame")
    status, _, errors = todframes("validate", made.path)
    assert status == 1
    assert len(re.findall("^error: (?!.*…).*No such file", errors, re.MULTILINE)) == 10
    assert str(made.frame(35)) in errors and "… and 20 more like it" in errors
    assert "31 problems" in errors.splitlines()[-1]


def test_problems_alike_but_for_names_and_words_are_folded(make_dataset, todframes) -> None:
    made = make_dataset(repeats=6)
    for number, row in enumerate(made.rows):
        changed = {"orientation": row["orientation"].title()} if number % 2 else {"frame": f"a\\{number}.exr"}
        row |= changed
    made.save()
    status, _, errors = todframes("validate", made.path)
    assert (status, errors.count("backslashes"), errors.count("orientation: ")) == (1, 11, 11)
    assert "48 problems" in errors.splitlines()[-1]


def test_naked_eye_of_a_large_triangle_is_refused(todframes) -> None:
    """Of 1307 retina samples: it took gigabytes and did not end."""
    assert "expected at most 153" in error_line(todframes("naked-eye", "--size-mrad", "200"))
