"""`compare` on cameras: from the command line and from Python, datasets and results, and tables of many."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import error_line
from msgspec.structs import replace
from scipy import ndimage

import todframes as tod
from todframes.comparison.conditions import names_of_paths
from todframes.frames.files import read_frame, write_frame
from todframes.frames.memory import memory_dataset

FAST = tod.FitSettings(resamples=80)
BACKGROUND = 50.0  # cd/m², that of the fixture


@pytest.fixture(scope="module")
def cameras(make_shared_dataset) -> tuple[Path, Path]:
    """Two datasets with the same schedule and noise of their own; the second has 1 / 1.3 of the contrast."""
    made = [make_shared_dataset(name, sizes_mrad=(1.5, 2.5), contrasts=(0.05, 0.1, 0.2, 0.4)) for name in "AB"]
    for number, (dataset, gain) in enumerate(zip(made, (1.0, 1.0 / 1.3), strict=True)):
        rng = np.random.default_rng(number)
        for row in range(len(dataset.rows)):
            values = read_frame(dataset.frame(row)).values
            values = BACKGROUND + gain * (values - BACKGROUND) + rng.normal(0.0, 0.3, values.shape)
            write_frame(dataset.frame(row), values, pixel_type="float")
    return made[0].path, made[1].path


@pytest.fixture(scope="module")
def scored(cameras) -> tuple[tod.Result, tod.Result]:
    first, second = (tod.score(camera, fit=FAST, examples=False) for camera in cameras)
    return first, second


def parts(result: tod.Result) -> list[object]:
    """Return all that a comparison says, but for names."""
    return [(one.fits, one.ratios, one.overall, one.verdict) for one in result.conditions]


def test_paths_datasets_and_results_say_the_same(cameras, scored, tmp_path) -> None:
    """The truth is 1.3. Trials of a result, in memory or in scores.csv, are those of its dataset."""
    result = tod.compare(*cameras, fit=FAST)
    a, b = result.conditions
    assert [one.fits for one in (a, b)] == [one.fits for one in scored]
    assert (a.name, b.name, b.by, b.verdict) == ("A", "B", "paired_trials", "worse")
    for ratio in (*b.ratios, b.overall):
        low, high = ratio.ratio_ci95
        # The two noises move each threshold by some per cent; a fitted curve is right to 2 %.
        assert low * 0.98 <= 1.3 <= high * 1.02
    assert result.verdict[0].startswith("B needs 1.")
    assert result.basis[0] == "B shows the same trials as A: they are compared trial by trial."
    assert [example.condition for example in result.examples] == ["A", "B"] * 2
    assert len({example.strength for example in result.examples[:2]}) == 1
    assert result.eye == tod.naked_eye(size_mrad=[1.5, 2.5]).fits
    assert {one.pixel_size for one in (a, b)} == {tod.load_dataset(cameras[0]).display.pixel_pitch_mrad}
    scored[1].save(tmp_path / "scored")
    for others in (
        (tod.load_dataset(cameras[0]), scored[1]),
        (scored[0], tmp_path / "scored"),
        (cameras[0], str(tmp_path / "scored" / "result.json")),
    ):
        assert parts(tod.compare(*others, fit=FAST, examples=False)) == parts(result)
    result.save(tmp_path / "beside")
    again = tod.load_result(tmp_path / "beside")
    assert parts(again) == parts(result) and again.to_html() == result.to_html()
    assert (tmp_path / "beside" / "tod_curve.png").is_file()


def test_a_saved_result_shows_the_frames_of_its_dataset(cameras, scored, tmp_path) -> None:
    scored[1].save(tmp_path / "B")
    fresh, saved = (tod.compare(cameras[0], other, fit=FAST) for other in (cameras[1], tmp_path / "B"))
    assert saved.examples == fresh.examples and len(fresh.examples) == 4
    both = tod.compare(*scored)
    assert [replace(one, condition="") for one in both.examples] == [
        replace(one, condition="") for one in fresh.examples
    ]
    assert both.eye == fresh.eye != ()
    (tmp_path / "B" / "scores.csv").unlink()
    assert {one.condition for one in tod.compare(scored[0], tmp_path / "B").examples} == {scored[0].name[-1]}


def test_a_result_without_trials_has_its_intervals(scored, tmp_path) -> None:
    scored[1].save(tmp_path / "scored")
    (tmp_path / "scored" / "scores.csv").unlink()
    _, other = tod.compare(scored[0], tmp_path / "scored").conditions
    assert other.by == "intervals"
    low, high = other.overall.ratio_ci95
    assert low * 0.98 <= 1.3 <= high * 1.02
    _, same = tod.compare(scored[0], scored[0]).conditions
    assert (same.overall.ratio, same.overall.ratio_ci95) == (1.0, (1.0, 1.0))


def test_algorithms_are_conditions_of_each_camera(cameras) -> None:
    result = tod.compare(*cameras, enhance="gaussian:sigma=0.6", white=200.0, fit=FAST, examples=False)
    names = [one.name for one in result.conditions]
    assert names == ["A", "A, gaussian", "B", "B, gaussian"]
    alone = tod.compare(cameras[0], enhance="gaussian:sigma=0.6", white=200.0, fit=FAST, examples=False)
    assert [one.ratio for one in alone.conditions[1].ratios] == [one.ratio for one in result.conditions[1].ratios]


def test_cameras_in_one_dataset(make_dataset) -> None:
    made = make_dataset(
        sizes_mrad=(2.0,), contrasts=(0.05, 0.1, 0.2), experiment={"group_by": ["size_mrad", "lens"]}
    )
    for number, row in enumerate(list(made.rows)):
        row["lens"] = "old" if number % 2 else "new"
    made.save()
    result = tod.compare(made.path, by="lens", fit=FAST, examples=False)
    assert [one.name for one in result.conditions] == ["dataset, lens new", "dataset, lens old"]
    with pytest.raises(tod.SettingsError, match="by: found 'lense', expected one of the columns"):
        tod.compare(made.path, by="lense", fit=FAST)


def test_slips_are_one_line(todframes, cameras, scored, tmp_path) -> None:
    tod.naked_eye(contrast=0.5).save(tmp_path / "acuity")
    tod.compare(*scored).save(tmp_path / "beside")
    (tmp_path / "sensor.toml").touch()
    for arguments, status, message in (
        ((cameras[0],), 2, "conditions: found 1, expected two or more, or one with --enhance or --by"),
        ((cameras[0], tmp_path / "BB"), 1, "BB: no such dataset or result"),
        ((cameras[0], "gaussian"), 1, "gaussian: no such dataset or result; an algorithm is given as --enhance"),
        (
            (cameras[0], tmp_path / "sensor.toml"),
            1,
            "found a TOML file, expected the folder of",
        ),
        ((cameras[0], tmp_path / "acuity"), 1, "found thresholds in size (mrad), expected contrast"),
        ((cameras[0], tmp_path / "beside"), 1, "found a result of compare, expected score, curve, naked-eye"),
    ):
        found, out, err = todframes("compare", *arguments)
        assert (found, out) == (status, "")
        assert message in err and len(err.splitlines()) == 1
    for given in (["gaussian"], abs):
        with pytest.raises(tod.SettingsError, match=r"conditions: found .*, expected a path or text"):
            tod.compare(cameras[0], given)


def test_many_datasets_have_one_table(todframes, cameras, working_folder) -> None:
    """One that fails is a row with its error, and the others stay."""
    for number, camera in enumerate(cameras):
        shutil.copytree(camera, working_folder / "all" / f"camera{number}")
    (working_folder / "all" / "empty").mkdir()
    status, out, err = todframes("score", "all/*", "-o", "out", "--set", "resamples=40")
    assert status == 1
    assert err.splitlines()[-1] == "error: 1 of 3 datasets could not be used: empty"
    with Path("out/summary.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["dataset"] for row in rows] == ["camera0"] * 2 + ["camera1"] * 2 + ["empty"]
    assert "dataset.toml: no such file" in rows[-1]["error"] and "dataset.toml" in out.replace("\n", "")
    for name in ("camera0", "camera1"):
        written = json.loads(Path(f"out/{name}/result.json").read_text(encoding="utf-8"))
        thresholds = [row["threshold"] for row in rows if row["dataset"] == name]
        assert thresholds == [str(fit["threshold"]) for fit in written["fits"]]
    page = Path("out/summary.html").read_text(encoding="utf-8")
    assert "2 of 3 datasets have a result." in page and "dataset camera1" in page and "TOD curve" in page
    status, out, err = todframes("score", "all/camera0", "all/camera1", "--json")
    assert (status, out) == (2, "") and "--json: found several datasets, expected one" in err
    asked = ("score", "all/camera0", "all/camera1", "--set", "kernel=2")
    assert error_line(todframes(*asked, "--quiet")).startswith("error: settings: ")  # once for all
    # Beside the folders of a batch stands its summary, which is no condition; results of a pattern are compared.
    status, out, _ = todframes("compare", "out/*", "--set", "resamples=40", "--quiet")
    assert status == 0 and "camera1 needs" in out


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["films/a.mp4", "films/b.mp4", "films/c.v2"], ["a", "b", "c.v2"]),
        (["films/a.mp4", "films/a.mov"], ["a.mp4", "a.mov"]),
        (["films/a.mp4", "more/a.mp4", "films/b.mp4"], ["films_a", "more_a", "films_b"]),
        (["a/b_c", "a_b/c", "z/c"], ["b_c (1)", "c (2)", "c (3)"]),
        (["films/a.mp4", "films/../films/a.mp4"], ["a.mp4 (1)", "a.mp4 (2)"]),
        (["films/../one/result.json", "two"], ["one", "two"]),
        ([".", "two"], ["here", "two"]),
    ],
)
def test_names_tell_paths_apart(paths, names, working_folder) -> None:
    for path in ("films/a.mp4", "films/a.mov", "films/b.mp4", "more/a.mp4", "one/result.json"):
        (working_folder / path).parent.mkdir(exist_ok=True)
        (working_folder / path).touch()
    (working_folder / "films" / "c.v2").mkdir()
    assert names_of_paths(paths, "_") == names


PITCH_MRAD, SIZE_PX, SIDE_PX = 0.153, 15.7, 97  # pixels are retina samples; the observer looks at 65


def laplacian(image: np.ndarray) -> list[np.ndarray]:
    """Compute four bands by the equations of Burt & Adelson, with zeros set between samples."""

    def filtered(of: np.ndarray, gain: float) -> np.ndarray:
        for axis in (0, 1):
            of = ndimage.correlate1d(of, gain * np.array([1, 4, 6, 4, 1]) / 16.0, axis, mode="mirror")
        return of

    bands = []
    for _ in range(4):
        reduced, spread = filtered(image, 1.0)[::2, ::2], np.zeros_like(image)
        spread[::2, ::2] = reduced
        bands.append(image - filtered(spread, 2.0))
        image = reduced
    return bands


def camera(blur_px: float = 0.0, gain: float = 1.0, noise: float = 0.0) -> tuple[tod.Dataset, np.ndarray]:
    """Film triangles of two contrasts in four orientations, 6 times each; also return one, of contrast 1."""
    fine = (np.arange(8 * SIDE_PX) + 0.5) / 8.0 - SIDE_PX / 2.0
    inside = np.ones((fine.size, fine.size), bool)
    for angle in np.deg2rad([90.0, 210.0, 330.0]):  # the inradius is a sixth of √3 times the side, 2 / √√3
        inside &= fine * np.cos(angle) + fine[:, None] * np.sin(angle) < SIZE_PX / 3.0**0.75
    sharp = inside.reshape(SIDE_PX, 8, SIDE_PX, 8).mean(axis=(1, 3))
    seen, rng = gain * ndimage.gaussian_filter(sharp, blur_px), np.random.default_rng(int(100 * noise) + 1)
    shown = [(name, level, turns) for level in (0.05, 0.1) for turns, name in enumerate(TURNS)] * 6
    frames = [
        BACKGROUND * (1.0 + level * np.rot90(seen, -turns) + noise * rng.normal(size=seen.shape))
        for _, level, turns in shown
    ]
    names, levels, _ = zip(*shown, strict=True)
    display = tod.Display(
        eotf="linear",
        white_luminance_cd_m2=1.0,
        pixel_pitch_mrad=PITCH_MRAD,
        background_luminance_cd_m2=BACKGROUND,
    )
    size = SIZE_PX * PITCH_MRAD
    return memory_dataset(frames, orientation=names, level=levels, size_mrad=size, display=display), sharp


TURNS = ("up", "right", "down", "left")


def test_blur_takes_the_signal_of_fine_bands() -> None:
    """Against the bands of other code, with templates made by it, and between the MTF at the ends of each band."""
    blur_px = 1.5
    (sharp, image), (blurred, _) = camera(), camera(blur_px)
    observer = tod.PyramidObserver(position_jitter_samples=0.0)
    found = tod.compare(sharp, blurred, observer=observer, fit=FAST)
    middle = slice((SIDE_PX - 65) // 2, (SIDE_PX + 65) // 2)
    expected = ndimage.gaussian_filter(image[middle, middle], 1.2)
    deviation = laplacian(expected - sum(np.rot90(expected, k) for k in range(4)) / 4.0)
    signals = np.array(
        [
            [
                (weights * band).sum()
                for weights, band in zip(deviation, laplacian(of[middle, middle]), strict=True)
            ]
            for of in (image, ndimage.gaussian_filter(image, blur_px))
        ]
    )
    reference, other = found.conditions
    n = len(reference.bands)
    assert n >= 3 and len(other.bands) == n
    # Edges are drawn on 8 × 8 places of a pixel, and exactly by the observer.
    assert [band.share for band in reference.bands] == pytest.approx(signals[0, :n] / signals[0].sum(), rel=0.01)
    assert [band.ratio for band in other.bands] == pytest.approx((signals[1] / signals[0])[:n], rel=2e-3)
    for band in other.bands[1:]:  # the first has no upper end
        cycles_per_px = band.cycles_per_mrad * PITCH_MRAD * np.array([2.0, 0.5])
        low, high = np.exp(-2.0 * (np.pi * blur_px * cycles_per_px) ** 2)
        assert low < band.ratio < high
    assert [band.cycles_per_mrad for band in other.bands[:2]] == pytest.approx([0.25 / 0.153, 0.125 / 0.153])
    assert found.verdict[-1].startswith("The signal of in memory (2) is 0.")
    assert "bands.csv" in found.data_files() and "bands.png" in [figure.file for figure in found.figures()]


@pytest.mark.parametrize(("gain", "noise"), [(0.7, 0.0), (1.0, 0.05)])
def test_gain_is_alike_in_all_bands_and_noise_in_none(gain, noise) -> None:
    _, other = tod.compare(camera()[0], camera(gain=gain, noise=noise)[0], fit=FAST).conditions
    assert len(other.bands) >= 3
    for band in other.bands:
        low, high = band.ratio_ci95 or (band.ratio, band.ratio)
        # Frames are single precision; an interval misses 1 in 5 of 100 seeds, and this is one of the others.
        assert low - 1e-5 <= gain <= high + 1e-5 < 1.3
    assert len(tod.compare(camera()[0], camera()[0], observer="csf", fit=FAST).conditions[1].bands) == 0
