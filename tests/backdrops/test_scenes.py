"""Triangles on scenes: the frames hold what the manifest says, and backgrounds are shown in balance."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import error_line
from PIL import Image
from test_import import rows_of

import todframes as tod
from todframes.backdrops.views import (
    TURNS,
    Encoder,
    balanced,
    decoded_images,
    open_scenes,
    own_orientation,
    plan,
    turned,
    turned_place,
)
from todframes.display.display import Display, LuminanceTable, find_display
from todframes.stimulus import ORIENTATIONS, Orientation, coverage

PITCH_MRAD = 0.5
DISPLAY = tod.Display(
    eotf="gamma",
    gamma=2.2,
    white_luminance_cd_m2=100.0,
    black_luminance_cd_m2=0.5,
    pixel_pitch_mrad=PITCH_MRAD,
    background_luminance_cd_m2="surround",
)
FALLING = replace(DISPLAY, eotf="lut", gamma=None, lut=LuminanceTable(np.array([0.0, 1.0]), np.array([9.0, 5.0])))


def textured(side: int = 160, seed: int = 1, low: float = 0.2, high: float = 0.9) -> np.ndarray:
    """A smooth random image, code values from `low` to `high`."""
    noise = np.random.default_rng(seed).normal(size=(side, side))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    image = np.fft.ifft2(np.fft.fft2(noise) / np.maximum(frequency, 1.0 / side)).real
    image -= image.min()
    return low + (high - low) * image / image.max()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "images"
    path.mkdir()
    tod.write_frame(path / "hills.png", textured(seed=1), pixel_type="uint8")
    tod.write_frame(path / "woods.png", textured(seed=2), pixel_type="uint16")
    return path


def luminance_of(path: Path, row: dict[str, str]) -> np.ndarray:
    return DISPLAY.luminance(tod.read_frame(path / row["frame"]).values)


def test_a_frame_is_the_scene_and_a_triangle(folder: Path, tmp_path: Path) -> None:
    """Scene, local luminance and coverage are computed again, from the file and what the manifest says."""
    out = tmp_path / "out"
    made = tod.scenes(
        folder, out=out, size_mrad=[4], contrast=[0.1, 0.3], trials=16, display=DISPLAY, dim=0.5, rng=3
    )
    rows = rows_of(out)
    assert made.n_frames == len(rows) == 32
    images = {
        name: DISPLAY.luminance(tod.read_frame(folder / f"{name}.png").values) for name in ("hills", "woods")
    }
    for row in rows[::5]:
        shown = luminance_of(out, row)
        side = len(shown)
        first = [int(one) for one in row["scene_window"].split(",")]
        scene = 0.5 + 0.5 * (images[row["scene"]][first[0] :, first[1] :][:side, :side] - 0.5)
        if row["scene_turn"].startswith("m"):
            scene = np.fliplr(scene)
        for _ in range(int(row["scene_turn"][1:]) // 90):
            scene = scene.T[:, ::-1]  # clockwise
        x, y, size_px = float(row["x_px"]), float(row["y_px"]), 4.0 / PITCH_MRAD
        # The mean over the circle through the corners, by a fine grid: 2/3 of the height 3^(1/4) √area.
        fine = (np.arange(8 * side) + 0.5) / 8.0 - 0.5
        inside = np.hypot(fine[:, None] - y, fine - x) <= 2.0 / 3.0 * 3.0**0.25 * size_px
        local = np.repeat(np.repeat(scene, 8, axis=0), 8, axis=1)[inside].mean()
        stated = float(row["background_luminance_cd_m2"])
        # Shares of pixels at the circle are taken along the radius: of 150 pixels 40 are shared, to 0.1 each.
        assert stated == pytest.approx(local, rel=2e-3)
        triangle = coverage(
            shown.shape, size_px=size_px, x_px=x, y_px=y, orientation=Orientation(row["orientation"])
        )
        # A code of 16 bits is at most 2.2 · 99.5 / 65535 cd/m²; half of it is rounding.
        expected = scene + float(row["contrast"]) * stated * triangle
        assert np.abs(shown - expected).max() <= 0.51 * 2.2 * 99.5 / 65535


@pytest.mark.parametrize("turns", [8, 4, 1])
def test_backgrounds_are_shown_in_balance(turns: int) -> None:
    n, names = 3, TURNS[:turns]
    shown = [one for one in plan(n, names, 2, balanced(n, names)) if one.level == 1]

    def alike(key) -> bool:
        counts = Counter(key(one) for one in shown)
        return len(set(counts.values())) == 1

    assert alike(lambda one: (one.background, one.turn))
    assert alike(lambda one: (one.background, one.orientation))
    quarter = {turn: int(turn[1:]) // 90 for turn in names}
    relative = Counter(
        (one.background, one.turn[0], (one.orientation.quarter_turns - quarter[one.turn]) % 4) for one in shown
    )
    assert len(relative) == n * 4 * (2 if turns == 8 else 1) and len(set(relative.values())) == 1
    # A second round has each turn with the next orientation; with all of them, all pairs occur equally often.
    everything = Counter((one.background, one.turn, one.orientation) for one in plan(n, names, 1, 4 * turns * n))
    assert len(everything) == n * turns * 4 and set(everything.values()) == {1}


def test_turns_are_the_symmetries_of_the_square() -> None:
    """A marked pixel goes where its place is said to go, and the eight images differ."""
    image = np.zeros((7, 7))
    image[1, 5] = 1.0  # 2 to the right and 2 up of the middle, and 1 more up
    image[0, 5] = 2.0
    seen = set()
    for turn in TURNS:
        shown = turned(image, turn)
        for value, (x, y) in {1.0: (2.0, -2.0), 2.0: (2.0, -3.0)}.items():
            ((row, column),) = np.argwhere(shown == value)
            assert turned_place(x, y, turn) == (column - 3.0, row - 3.0)
        seen.add(shown.tobytes())
    assert len(seen) == 8
    assert np.array_equal(turned(np.array([[1, 2], [3, 4]]), "r90"), [[3, 1], [4, 2]])


def test_own_orientation_of_a_triangle_is_its_contrast() -> None:
    """Also that of a stripe, which is alike in up and down by symmetry."""
    place = {"size_px": 12.0, "x_px": 24.0, "y_px": 24.0}
    shape, c = (49, 49), 0.2
    alone = c * coverage(shape, orientation=Orientation.LEFT, **place)
    # The circle through the corners holds the triangle; relative to its mean, the contrast is c · level / mean.
    found = own_orientation(1.0 + alone, x_px=24.0, y_px=24.0, size_px=12.0)
    mean = 1.0 + c * 144.0 / (np.pi * (2.0 / 3.0 * 3.0**0.25 * 12.0) ** 2)
    # The circle's edge is shared along the radius: 1e-3 of its area.
    assert found[ORIENTATIONS.index(Orientation.LEFT)] == pytest.approx(c / mean, rel=2e-3)
    assert found.sum() == pytest.approx(0.0, abs=1e-12) and found.argmax() == 3
    stripe = np.ones(shape)
    stripe[:, 20:29] = 1.2
    up, right, down, left = own_orientation(stripe, x_px=24.0, y_px=24.0, size_px=12.0)
    assert up == pytest.approx(down, abs=1e-12) and right == pytest.approx(left, abs=1e-12)
    assert up == pytest.approx(-right, abs=1e-12) and abs(up) > 1e-3


@pytest.mark.parametrize("name", ["reference_sdr", "srgb_monitor", "tod_2001"])
def test_encoding_is_the_nearest_code_of_a_display(name: str) -> None:
    display = find_display(name).display
    encoder = Encoder(display)
    wanted = np.random.default_rng(4).uniform(encoder.black_cd_m2, encoder.white_cd_m2, 50)
    codes = np.arange(65536) / 65535.0
    of_code = display.luminance(codes.astype(np.float32).reshape(-1, 1, 1))[:, 0]
    nearest = np.abs(of_code - wanted[:, None]).min(axis=1)
    shown = display.luminance(encoder(wanted).astype(np.float32).reshape(-1, 1, 1))[:, 0]
    assert np.abs(shown - wanted) == pytest.approx(nearest, abs=1e-9 * encoder.white_cd_m2)


def test_the_same_seed_gives_the_same_dataset(folder: Path, tmp_path: Path, todframes) -> None:
    asked = [folder, "--size-mrad", "3", "--contrast", "0.2,0.4", "--trials", "4", "--seed", "5", "--turns", "1"]
    for name in ("a", "b"):
        status, out, err = todframes("scenes", *asked, "-o", tmp_path / name)
        assert status == 0 and "8 frames with 2 scenes" in out
        assert "note: 4 trials of each size and contrast are no" in err
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 3 + 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_lut_shows_code_values_as_they_are(tmp_path: Path) -> None:
    """By hand: the table is linear, 10 + 50 (code − 1/8) cd/m² from 1/8 to 7/8; beyond, it shows its ends."""
    lut = LuminanceTable(code_value=np.array([0.125, 0.875]), luminance_cd_m2=np.array([10.0, 47.5]))
    display = Display(eotf="lut", lut=lut, pixel_pitch_mrad=PITCH_MRAD, background_luminance_cd_m2="surround")
    np.save(tmp_path / "codes.npy", np.array([[0.05, 0.125, 0.235], [0.5, 0.875, 0.95]], np.float32))
    (file,) = open_scenes(tmp_path / "codes.npy", value_range=(0.0, 1.0))
    (image,) = decoded_images(file, display, frames=1)
    # Codes are 32-bit floats: 6e-8 relative of 50 cd/m².
    assert image.luminance_cd_m2 == pytest.approx(np.array([[10.0, 10.0, 15.5], [28.75, 47.5, 47.5]]), abs=1e-5)
    assert image.at_end.tolist() == [[True, True, False], [False, True, True]]


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """Images that no triangle can be placed on."""
    tod.write_frame(tmp_path / "small.png", textured(20))
    tod.write_frame(tmp_path / "white.png", np.ones((160, 160)))
    tod.write_frame(tmp_path / "even.png", np.full((160, 160), 0.5))
    tod.write_frame(tmp_path / "good.png", textured())
    tod.write_frame(tmp_path / "warm.exr", 20.0 + textured())
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "README.md").write_text("nothing here")
    return tmp_path


@pytest.mark.parametrize(("background", "changes", "message"), [
    ("small.png", {}, r"small.png: found 20 × 20 pixels, expected at least \d+ × \d+ for a triangle of 8"),
    ("white.png", {}, r"white.png: found no window .* \(100 % of the image are\), expected an image that"),
    ("even.png", {}, r"even.png: found no window .* with contrast"),
    ("text.png", {}, r"text.png: found a file that starts with b'no image', expected an image"),
    ("none", {}, r"none: found only README.md, expected images"),
    ("gone", {}, "gone: found no file"),
    ("skimage:nobody", {}, "found 'nobody', expected photographs of scikit-image: astronaut"),
    ("warm.exr", {}, "warm.exr: has values without a black and a white, expected value_range LOW:HIGH"),
    ("good.png", {"dim": 1.0, "contrast": [0.1, 4.0]}, r"strongest .* on all .*, expected at most 0\.\d+"),
    ("good.png", {"polarity": -1, "contrast": [3.0]}, r"beyond black .* on all .*, expected at most 0\.\d+"),
    ("good.png", {"contrast": [0.1, 0.1]}, "contrast: found a value twice"),
    ("good.png", {"contrast": [1e6]}, "contrast: found 1e.06, expected less than 199"),
    ("good.png", {"size_mrad": [0.2]}, "size_mrad: found 0.2 mrad, which is 0.4 pixels of 0.5 mrad"),
    ("good.png", {"windows": 400}, r"windows of .* pixels apart from each other, .* expected 400"),
    ("good.png", {"dim": 0.0}, "dim: found 0.0, expected more than 0"),
    ("good.png", {"frames": 0}, "frames: found 0, expected a whole number >= 1"),
    ("good.png", {"contrast": [0.1, 0.2], "trials": 10**8}, "trials: found 100000000, .* from 1 to 500000"),
    ("good.png", {"display": FALLING}, "its luminance does not rise with the code value, expected one that"),
])  # fmt: skip
def test_what_cannot_be_done_is_one_line(hostile: Path, background, changes, message) -> None:
    name = background if background.startswith("skimage") else hostile / background
    asked = {"size_mrad": [4.0], "contrast": [0.2], "display": DISPLAY} | changes
    with pytest.raises(tod.TodframesError, match=message) as caught:
        tod.scenes(name, out=hostile / "out", **asked)
    assert "\n" not in str(caught.value)
    assert not (hostile / "out").exists()


def test_unfit_scenes_are_left_out(hostile: Path) -> None:
    """Also those that are unfit for one size only, and films of which a frame is; what is left is shown alone."""
    tod.write_frame(hostile / "narrow.png", textured(side=60))
    names = ("small", "white", "good", "narrow", "even")
    asked = {"size_mrad": [3.0, 8.0], "contrast": [0.2], "display": DISPLAY, "trials": 8}
    made = tod.scenes([hostile / f"{name}.png" for name in names], out=hostile / "out", **asked)
    assert {row["scene"] for row in rows_of(hostile / "out")} == {"good"} and made.n_scenes == 1
    assert [Path(note.split(":")[0].removeprefix("left out ")).stem for note in made.notes] == [
        *("small", "white", "narrow", "even")
    ]
    # A triangle that is darker by 0.3 has room where the darkest pixel near it is above 0.7 of the mean.
    dark = textured(seed=5, low=0.35, high=0.9)
    dark[::7, ::7] = 0.2
    tod.write_frame(hostile / "spotted.png", dark)
    asked |= {"polarity": -1, "contrast": [0.3], "out": hostile / "darker"}
    made = tod.scenes([hostile / "good.png", hostile / "spotted.png"], **asked)
    assert re.search("left out .*spotted.png: found the strongest triangle beyond", *made.notes)
    assert made.n_frames == 16


def test_counts_without_a_range_are_remarked(tmp_path: Path) -> None:
    """16-bit counts that fill 2 % of the range would be shown as an even grey."""
    tod.write_frame(tmp_path / "counts.png", 0.04 + 0.02 * textured(), pixel_type="uint16")
    asked = {"size_mrad": [4], "contrast": [0.1], "trials": 8, "display": DISPLAY}
    (note,) = tod.scenes(tmp_path / "counts.png", out=tmp_path / "a", **asked).notes
    assert re.search(r"spread over 1\.4 % of the range .* \(value_range\)", note)  # 0.02 · (0.9 − 0.2)
    assert tod.scenes(tmp_path / "counts.png", out=tmp_path / "b", **asked, value_range=(2600, 4000)).notes == ()


def test_a_background_that_is_read_otherwise_than_it_says_is_remarked(tmp_path: Path) -> None:
    image = np.uint8(255 * textured())
    tifffile.imwrite(tmp_path / "turned.tif", image, extratags=[(274, "H", 1, 3, True)])
    Image.fromarray(image).save(tmp_path / "lossy.jpg")
    made = tod.scenes(tmp_path, out=tmp_path / "out", size_mrad=[3], contrast=[0.3], trials=4, turns=1)
    (note,) = (one for one in made.notes if "balanced" not in one)
    assert re.search(r"turned\.tif: the file states orientation 3 .*, which is not used", note)


def test_two_files_of_one_name_are_refused(folder: Path, hostile: Path) -> None:
    tod.write_frame(hostile / "hills.png", textured())
    with pytest.raises(tod.DataError, match=re.escape("hills.png: found the name hills as of")):
        tod.scenes([folder, hostile / "hills.png"], out=hostile / "out", size_mrad=[4], contrast=[0.1])


def test_frames_of_a_film_are_spread_over_it(tmp_path: Path) -> None:
    """Frames 0, 4 and 9 of ten, of which each has its number in its mean; a blurred triangle keeps its energy."""
    film = np.array([textured(seed=1) * (0.5 + 0.05 * k) for k in range(10)], np.float32)
    np.save(tmp_path / "film.npy", film)
    asked = {"size_mrad": [4], "contrast": [0.1], "frames": 3, "trials": 6, "turns": 1, "blur_px": 1.5}
    asked |= {"value_range": (0.0, 1.0), "display": DISPLAY}
    assert tod.scenes(tmp_path / "film.npy", out=tmp_path / "out", **asked).n_scenes == 1
    rows = rows_of(tmp_path / "out")
    assert {row["scene_window"].partition(":")[0] for row in rows} == {"0", "4", "9"}
    # Two orientations of one background differ by triangles alone, of equal sum: size² · contrast · local.
    first, second = rows[0], rows[3]
    assert first["scene_window"] == second["scene_window"] and first["orientation"] != second["orientation"]
    differ = luminance_of(tmp_path / "out", first) - luminance_of(tmp_path / "out", second)
    energy = 64.0 * 0.1 * float(first["background_luminance_cd_m2"])
    # Rounding to 16 bits is 1e-3 cd/m² a pixel, of which 9000 make 0.1.
    assert abs(differ.sum()) < 0.1 and np.abs(differ).sum() > 0.2 * energy


@pytest.fixture(scope="module")
def on_scenes(tmp_path_factory) -> Path:
    """A dataset of five scenes, as strong in texture as in triangles."""
    path = tmp_path_factory.mktemp("scenes")
    for seed in range(5):
        tod.write_frame(path / f"scene_{seed}.png", textured(140, seed))
    tod.scenes(
        path, out=path / "dataset", size_mrad=[4], contrast=[0.2, 0.35, 0.5], trials=40, turns=1, display=DISPLAY
    )
    return path / "dataset"


def test_what_frames_on_scenes_show_is_measured(on_scenes: Path) -> None:
    """Without texture or noise in the way: contrast, place and size are those of the triangles, to the codes."""
    (one,) = tod.validate(on_scenes).dataset.measured["stimuli"]
    # Triangles are shown by their coverage of pixels, whose blur by blocks leaves half a per cent of contrast.
    assert one["contrast_slope"] == pytest.approx(1.0, abs=0.01)
    assert one["size_ratio"] == pytest.approx(1.0, abs=0.005) and max(map(abs, one["offset_px"])) < 0.05
    assert one["ring_ratio"] == pytest.approx(1.0, abs=0.005)
    assert one["noise_contrast"] < 0.01  # the texture's standard deviation is 0.2


def test_triangles_are_not_looked_for_in_texture(on_scenes: Path, todframes) -> None:
    assert "--locate: the dataset has scenes" in error_line(todframes("score", on_scenes, "--locate"))


def test_photographs_of_a_package_are_a_scene_each(tmp_path: Path) -> None:
    tod.scenes("skimage:camera,moon", size_mrad=[3], contrast=[0.2], trials=8, out=tmp_path / "out")
    assert {row["scene"] for row in rows_of(tmp_path / "out")} == {"camera", "moon"}
