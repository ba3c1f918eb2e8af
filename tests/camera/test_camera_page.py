"""The page of a chart by which a camera is measured: what it shows, and the MTF and noise of a film of it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from edges import gaussian, true_mtf
from independent_camera import Bending, Camera, film, looking_at
from independent_camera import Chart as FilmedChart

import todframes as tod
from todframes.base.errors import DataError, SettingsError
from todframes.charts.design import camera_content
from todframes.charts.layout import Chart, Edge, Page, read_chart
from todframes.cli.console import run
from todframes.cli.main import cli

PITCH_MM = 0.5
MONITOR = {"width_px": 1280, "height_px": 720, "pixel_pitch_mm": PITCH_MM, "eotf": "linear"}
ASKED = {"distance_m": 10, "sizes_mrad": [4], "contrasts": [0.2], "repeats": 1}
WIDTH, HEIGHT, SCALE, SIGMA_PX = 480, 288, 0.36, 0.6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("charts") / "chart"
    tod.chart("screen", out=made, camera_page=True, **ASKED, **MONITOR)
    return made


def filmed(folder: Path, *, pages: list[int], bending: Bending | None = None, n: int = 4) -> np.ndarray:
    chart = FilmedChart.read(folder)
    camera = Camera(width=WIDTH, height=HEIGHT, blur_sigma_px=SIGMA_PX, bending=bending, oversampling=5)
    matrix = looking_at(chart, width=WIDTH, height=HEIGHT, scale=SCALE, turn_deg=1.0, tilt_deg=1.5)
    return np.stack([one for *_, one in film(chart, camera, matrix, frames_per_page=n, pages=pages)])


@pytest.fixture(scope="module")
def recording(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("films") / "film.npy"
    np.save(path, filmed(folder, pages=[0, 1, 2], n=3))
    return path


def test_the_page_comes_first_with_patches_and_square_drawn_as_it_says(folder) -> None:
    chart = read_chart(folder)
    assert [bool(page.edges) for page in chart.pages] == [True, *([False] * 4)]
    assert not chart.pages[0].triangles and len(chart.pages[0].patches) == 12
    page = chart.pages[0]
    light = cv2.imread(str(folder / page.file), -1) / 255.0 * 100.0
    for patch in page.patches:
        left, top = (patch.x_mm - patch.width_mm / 2) / PITCH_MM, (patch.y_mm - patch.height_mm / 2) / PITCH_MM
        rows = slice(round(top), round(top + patch.height_mm / PITCH_MM))
        here = light[rows, round(left) : round(left + patch.width_mm / PITCH_MM)]
        assert here.size > 1000 and np.allclose(here, patch.luminance_cd_m2, rtol=1e-5)  # six digits are written
    assert sorted(one.luminance_cd_m2 for one in page.patches)[::11] == [0.0, 100.0]
    # Corners of the square by the area and the centroid of its pixels; its sides are turned by arctan(1/8).
    corners = np.array([one.ends_mm[0] for one in page.edges]) / PITCH_MM
    side = np.linalg.norm(corners[1] - corners[0])
    x, y = corners.mean(axis=0)
    reach = round(side)
    # Three times the background of 64 of 255 codes.
    there = np.abs(light[round(y) - reach : round(y) + reach, round(x) - reach : round(x) + reach] - 75.3) < 0.1
    # Stairs with whole steps are right to a pixel a step.
    assert there.sum() == pytest.approx(side**2, rel=4 / side)
    upper = there[np.nonzero(there)[0].min() + 20 :][:48]
    runs = np.diff(np.flatnonzero(np.diff(upper.argmax(axis=1))))
    assert len(runs) > 2 and set(runs.tolist()) == {8}


# Light of 4 + 2 code. Three times 104 is 312 of 404; three times 164 is more than 0.9 of white.
@pytest.mark.parametrize(("background", "square"), [(50, 154), (80, 25)])
@pytest.mark.parametrize("area", [(7.0, 11.0, 160.0, 60.0), (0.0, 3.0, 100.0, 80.0)])
def test_square_and_wedge_fill_their_area(area, background, square) -> None:
    left, top, width, height = area
    light = 4.0 + 2.0 * np.arange(201)
    made = camera_content(area, light, "luminance_cd_m2", background, "a.png")
    assert (made.square_code, made.patch_codes) == (square, [background, *range(0, 201, 20)])
    x, y, wide, high = np.array(made.patches_mm).T
    # Patches lie side by side at the right of the square's surround, as high as the area or 45 % of its width.
    side = min(height, 0.45 * width)
    assert (wide * high).sum() == pytest.approx((width - side) * height)
    assert (x.min(), y.min()) == pytest.approx((left + side, top))
    assert ((x + wide).max(), (y + high).max()) == pytest.approx((left + width, top + height))
    assert (
        np.abs(np.diff(x) / wide[1:]).max() < 1.001 and np.abs(np.diff(y) / high[1:]).max() < 1.001
    )  # to and fro
    corners = made.square_mm
    assert np.linalg.norm(corners[0] - corners[1]) == pytest.approx(side / 2)
    assert corners.mean(axis=0) == pytest.approx((left + side / 2, top + height / 2))
    assert abs((corners[1] - corners[0])[1] / (corners[1] - corners[0])[0]) == pytest.approx(1 / 8)
    rounded = np.array(camera_content(area, light, "luminance_cd_m2", 50, "a", step_mm=0.7).patches_mm)
    np.testing.assert_allclose(rounded / 0.7, np.rint(rounded / 0.7), atol=1e-9)


def test_a_sheet_of_paper_has_edges_and_a_wedge_too(tmp_path) -> None:
    asked = {"distance_m": 10, "sizes_mrad": [1], "contrasts": [0.2, 0.8], "repeats": 1}
    chart = tod.chart("print", out=tmp_path / "chart", camera_page=True, **asked)
    assert read_chart(tmp_path / "chart") == chart
    sheet = (tmp_path / "chart" / chart.pages[0].file).read_text()
    for edge in chart.pages[0].edges:
        (x, y), _ = edge.ends_mm.tolist()
        assert f"{x:.5f},{y:.5f}" in sheet
    assert "slanted edges" in sheet
    assert len({one.reflectance for one in chart.pages[0].patches}) == 12


def test_refused_are_charts_whose_pages_lack_or_mix_something(folder) -> None:
    chart = read_chart(folder)
    camera, shown = chart.pages[:2]
    with pytest.raises(SettingsError, match=r"triangles, edges: found neither, expected one or more of either"):
        Page(number=0)
    with pytest.raises(SettingsError, match=r"triangles, edges: found both"):
        replace(shown, edges=camera.edges)
    with pytest.raises(SettingsError, match=r"x2_mm, y2_mm: found x1_mm and y1_mm again"):
        Edge(x1_mm=1.0, y1_mm=1.0, x2_mm=1.0, y2_mm=1.0, free_mm=1.0)
    with pytest.raises(SettingsError, match=r"pages: found none with triangles"):
        replace(chart, pages=(camera,))


@pytest.mark.slow
def test_import_leaves_the_page_out_and_finds_the_triangles(folder, recording, tmp_path) -> None:
    asked = {"chart": folder / "chart.toml", "frames_per_second": 20, "display": "reference_linear"}

    def rows_of(name: str) -> list[dict[str, str]]:
        with (tmp_path / name / "manifest.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    done = tod.import_recordings(recording, out=tmp_path / "dataset", **asked)
    rows = rows_of("dataset")
    assert {row["page"] for row in rows} == {"1", "2"} and done.n_clips == 2
    assert "3 of the page to measure the camera" in done.notes[0] and not done.warnings
    frames = np.load(recording)
    np.save(tmp_path / "rest.npy", frames[3:])
    tod.import_recordings(tmp_path / "rest.npy", out=tmp_path / "rest", **asked)
    # Other frames solve the lens, so places may differ by their error, some 0.01 px.
    np.save(tmp_path / "page.npy", frames[:3])
    with pytest.raises(DataError, match="found the page to measure the camera alone, expected pages with"):
        tod.import_recordings(tmp_path / "page.npy", chart=folder, out=tmp_path / "none")
    for row, other in zip(rows, rows_of("rest"), strict=True):
        assert all(row[name] == other[name] for name in ("orientation", "contrast"))
        for name in ("x_px", "y_px"):  # windows are cut at whole pixels, before the lens is known
            away_px = float(row[name]) - float(other[name])
            assert away_px == pytest.approx(round(away_px), abs=0.05)


def test_mtf_of_a_film_is_that_of_the_camera(folder, recording, capsys) -> None:
    assert run(cli, ["mtf", str(recording), "--chart", str(folder / "chart.toml"), "--quiet"]) == 0
    assert "MTF50" in capsys.readouterr().out
    found = tod.mtf(recording, chart=folder)
    assert found.measured.n_frames == 3 and len(found.mtf.edges) == 4 and not found.warnings
    frequency, mtf = np.array(found.mtf.frequency), np.array(found.mtf.mtf)
    upto = frequency <= 0.5
    true = true_mtf(frequency[upto], gaussian(SIGMA_PX), 8.1)
    # The half-width of the band is 0.005 at the Nyquist frequency.
    assert np.abs(mtf[upto] - true).max() < 0.005
    # A monitor's pixel of 0.36 px, not divided out, would lower the MTF by more.
    uncorrected = mtf[upto] * np.sinc(SCALE * frequency[upto])
    assert np.abs(uncorrected - true).max() > 0.006


def test_noise_of_a_film_is_that_of_the_page(folder, recording) -> None:
    found = tod.noise(recording, chart=folder).noise
    assert found.n_frames == 3 and len(found.patches) == 12
    # 40,000 electrons at white, 100 cd/m², and 16 bits; 6 electrons of noise in the dark.
    assert found.signal_transfer.gain == pytest.approx(655.35, rel=0.005)
    for one in found.patches[2:11]:
        electrons = 400.0 * one.level
        # Some 25 x 25 pixels in 3 frames: 2 % of the standard deviation, and the light falls off nowhere.
        assert one.dynamic.sd / 65535 * 40_000 == pytest.approx(np.sqrt(electrons + 36.0), rel=0.1)


@pytest.mark.slow
def test_a_lens_that_distorts_moves_no_edge_out_of_its_box(folder, tmp_path) -> None:
    bending = Bending(width=WIDTH, height=HEIGHT, k=(-0.08,))
    np.save(tmp_path / "bent.npy", filmed(folder, pages=[0], bending=bending, n=3))
    found = tod.mtf(tmp_path / "bent.npy", chart=folder)
    assert len(found.mtf.edges) == 4 and max(one.bend_px for one in found.mtf.edges) > 0.1
    # The camera blurs the page by 1.5 halves of a monitor's pixel before it bends it.
    sigma = np.hypot(SIGMA_PX, 0.75 * SCALE)
    frequency, mtf = np.array(found.mtf.frequency), np.array(found.mtf.mtf)
    upto = frequency <= 0.5
    assert np.abs(mtf[upto] - true_mtf(frequency[upto], gaussian(sigma), 8.0)).max() < 0.012
    noise = tod.noise(tmp_path / "bent.npy", chart=folder).noise
    assert noise.signal_transfer.nonlinearity < 0.003


def test_frames_that_move_are_left_out_and_motion_all_the_time_is_refused(folder, recording, tmp_path) -> None:
    frames = np.load(recording)[:3]
    some = np.concatenate([np.roll(frames[:1], 2, axis=2), frames])
    np.save(tmp_path / "some.npy", some)
    found = tod.mtf(tmp_path / "some.npy", chart=folder)
    assert found.measured.n_frames == 3 and [one.code for one in found.warnings] == ["moved"]
    np.save(tmp_path / "all.npy", np.concatenate([np.roll(frames[:1], k, axis=1 + k % 2) for k in range(9)]))
    with pytest.raises(DataError, match=r"the chart moves in \d of the 9 frames that show its page, by"):
        tod.mtf(tmp_path / "all.npy", chart=folder)


def test_what_is_no_film_of_the_page_is_one_line(folder, recording, tmp_path, capsys) -> None:
    frames = np.load(recording)
    np.save(tmp_path / "triangles.npy", frames[3:])
    tod.chart("screen", out=tmp_path / "without", **ASKED, **MONITOR)
    other = tod.chart("screen", out=tmp_path / "other", camera_page=True, name="other", **ASKED, **MONITOR)
    assert isinstance(other, Chart)
    table = tmp_path / "mtf.csv"
    table.write_text("frequency_cyc_per_pixel,mtf\n0,1\n0.5,0.3\n1,0\n")
    for shown, chart, problem, status in (
        ("triangles.npy", folder, "found no frame of the page of", 1),
        (recording, tmp_path / "without", "has no page with slanted edges, expected a chart made with --", 2),
        (recording, tmp_path / "other", "(but a chart with the key", 1),
        (table, folder, "--chart:", 2),
    ):
        assert run(cli, ["mtf", str(tmp_path / shown), "--chart", str(chart), "--quiet"]) == status
        message = capsys.readouterr().err
        assert problem in message and message.count("\n") == 1, message
