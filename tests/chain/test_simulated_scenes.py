"""Scenes in front of a simulated sensor: they pass it as the triangle does, and are turned with it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_photons import CAMERA as PHOTON_CAMERA
from test_scenes import textured

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import resolve
from sensor_sim.chain.reconstruction import axis_matrix, display_signal
from sensor_sim.chain.sampling import field_sampler
from sensor_sim.chain.scenery import Scenery
from sensor_sim.chain.simulation import Filming, SimulatedTrial, Simulator
from todframes.stimulus import ORIENTATIONS, Orientation

CAMERA = ss.load_sensor("sample_frames/staring_camera.toml")
SIZE, NO_NOISE = 4.0, 1e9


def test_the_largest_contrast_of_scenes_is_that_of_their_brightest_pixel() -> None:
    window = np.pad(np.full((40, 40), 10.0), ((1, 0), (1, 0)), constant_values=35.0)
    shown = SimpleNamespace(backgrounds={2.0: [SimpleNamespace(luminance_cd_m2=window)]}, pixels_per_detector=4.0)
    assert Scenery.largest_contrast(shown) == pytest.approx(2.5)


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("images")
    for seed in range(3):
        tod.write_frame(path / f"scene_{seed}.png", textured(150, seed, low=0.3))
    return path


def scenery_of(images: Path, sensor: ss.Sensor = CAMERA, **more) -> Scenery:
    common = {"pixels_per_detector": 2.0, "value_range": None, "turns": 8, "seed": 3, "note": print}
    return Scenery.opened(resolve(sensor), sensor.display, images, [SIZE], **common | more)


@pytest.fixture(scope="module")
def simulator(images: Path) -> Simulator:
    return Simulator(CAMERA, SIZE, seed=1, scenery=scenery_of(images))


def shown(simulator: Simulator, turn: str, orientation: Orientation, level: float = NO_NOISE) -> np.ndarray:
    (frame,) = simulator.frames([SimulatedTrial((0, 0, 0), SIZE, level, orientation, 1, turn)])
    return frame.luminance_cd_m2


def test_triangles_are_added_as_on_an_even_field(simulator: Simulator) -> None:
    """Two orientations on one scene differ as on an even field at the same place."""
    x, y = simulator.scenery.place(SIZE, 1, "r90")
    up, left = (
        field_sampler(resolve(CAMERA), SIZE).samples(x, y, orientation=one)[0]
        for one in (Orientation.UP, Orientation.LEFT)
    )
    display = CAMERA.display
    matrix = axis_matrix(
        simulator.field, pixels_per_detector=display.pixels_per_detector, blur_px=resolve(CAMERA).blurs_px
    )
    alone = display.background_luminance_cd_m2 * display.gain * display_signal(up - left, matrix)
    differ = shown(simulator, "r90", Orientation.UP) - shown(simulator, "r90", Orientation.LEFT)
    # The noise of an SNR of 1e9 is 50 cd/m² · 1e-9, and rounding less.
    assert np.abs(differ - alone).max() < 1e-6


def test_local_luminance_on_the_display_is_its_background(simulator: Simulator) -> None:
    """The mean over the circle through the corners, on a fine grid, without the triangle."""
    display = CAMERA.display
    (frame,) = simulator.frames([SimulatedTrial((0, 0, 0), SIZE, NO_NOISE, Orientation.UP, 1, "m0")])
    x, y = simulator.scenery.place(SIZE, 1, "m0")
    triangle = display_signal(
        field_sampler(resolve(CAMERA), SIZE).samples(x, y, orientation=Orientation.UP)[0], simulator.matrix
    )
    scene = frame.luminance_cd_m2 - display.background_luminance_cd_m2 * display.gain * triangle
    side, radius = len(scene), 2.0 / 3.0 * 3.0**0.25 * SIZE * display.pixels_per_detector
    fine = (np.arange(6 * side) + 0.5) / 6.0 - 0.5
    inside = np.hypot(fine[:, None] - frame.y_px, fine - frame.x_px) <= radius
    local = np.repeat(np.repeat(scene, 6, axis=0), 6, axis=1)[inside].mean()
    # Shares of pixels at the circle are taken along the radius: 1e-3 of the texture's contrast of 0.3.
    assert local == pytest.approx(display.background_luminance_cd_m2, rel=1e-3)
    assert scene.std() > 0.05 * display.background_luminance_cd_m2


@pytest.mark.parametrize("turn", ["r90", "r180", "r270"])
def test_a_turned_scene_with_its_triangle_is_the_frame_turned(simulator: Simulator, turn: str) -> None:
    quarters = int(turn[1:]) // 90
    upright = shown(simulator, "r0", Orientation.UP)
    found = shown(simulator, turn, ORIENTATIONS[quarters])
    # Of noise that is left, 50 cd/m² · 1e-9, and of sums in another order.
    assert np.abs(np.rot90(upright, -quarters) - found).max() < 1e-6


def test_photons_come_from_scene_and_triangle(images: Path, tmp_path: Path) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(PHOTON_CAMERA, encoding="utf-8")
    sensor = ss.load_sensor(path)
    scenery = scenery_of(images, sensor, turns=1)
    simulator = Simulator(sensor, SIZE, seed=1, scenery=scenery)
    trial = SimulatedTrial((0, 0, 0), SIZE, 0.5, Orientation.UP, 0, "r0")
    (place,), (sample,) = simulator.samples([trial], noise=False)
    scene = scenery.contrast(SIZE, 0, "r0", field=simulator.field, matrix=simulator.matrix)
    triangle = field_sampler(resolve(sensor), SIZE).samples(*place, orientation=Orientation.UP)[0]
    np.testing.assert_allclose(sample, scene + 0.5 * triangle, atol=1e-12)


@pytest.mark.parametrize(
    "more",
    [
        pytest.param([], id="frames"),
        pytest.param(["--motion", "0", "--warm-up", "1"], id="clips", marks=pytest.mark.slow),
    ],
)
def test_simulated_scenes_have_no_false_warning(images: Path, tmp_path: Path, sensor_sim, more) -> None:
    asked = ["--size-detectors", "4", "--snr", "2,8", "--trials", "24", *more]
    out = tmp_path / "out"
    camera = "sample_frames/staring_camera.toml"
    status, printed, notes = sensor_sim("simulate", camera, *asked, "--background", images, "-o", out)
    assert status == 0 and "note" not in notes
    assert re.fullmatch(r".*: \d+ frames with 3 scenes\n", printed)
    data = tod.load_dataset(out)
    assert {data.trials.views[code].scene for code in data.trials.view_codes} == {"scene_0", "scene_1", "scene_2"}
    assert len({data.trials.views[code] for code in data.trials.view_codes}) == 24
    result = tod.validate(out)
    assert result.warnings == () and result.skipped == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"background": "nowhere.png"}, "nowhere.png: found no file"),
        ({"background_pixels": 0.5}, "background_pixels: found 0.5, expected 1 to 64 pixels along a detector"),
        ({"background_pixels": 20.0}, "found 150 × 150 pixels, expected at least"),
        ({"turns": 3}, "turns: found 3, expected one of 8, 4, 1"),
        ({"background_range": (2.0, 1.0)}, "background_range: found 2:1, expected LOW:HIGH, the lower one first"),
        ({"stages": True}, "stages: found it with background, expected one of the two"),
    ],
)
def test_what_scenes_cannot_be_is_one_line(images: Path, tmp_path: Path, changes, message) -> None:
    asked = {"background": images, "size_detectors": [4.0], "snr": [4.0], "trials": 8} | changes
    with pytest.raises(tod.TodframesError, match=message):
        ss.simulate(replace(CAMERA), out=tmp_path / "out", **asked)
    assert not (tmp_path / "out").exists()


def test_a_triangle_moves_over_a_scene_that_stands(images: Path) -> None:
    """Frames of a clip without noise, each less its own triangle, are one scene."""
    filming = Filming(motion_mrad_per_s=8.0, warm_up_frames=2)
    farthest = float(np.abs(filming.travel_detectors(CAMERA)).max())
    scenery = scenery_of(images, farthest_detectors=farthest)
    simulator = Simulator(CAMERA, SIZE, seed=1, filming=filming, scenery=scenery)
    frames = simulator.clip(SimulatedTrial((0, 0, 0), SIZE, NO_NOISE, Orientation.UP, 1, "r90"))
    display, scenes = CAMERA.display, []
    for frame in frames:
        at = [
            (one + 0.5) / display.pixels_per_detector - simulator.field / 2.0 for one in (frame.x_px, frame.y_px)
        ]
        triangle = simulator.sampler.samples(*at, orientation=Orientation.UP)[0]
        alone = display.background_luminance_cd_m2 * display.gain * display_signal(triangle, simulator.matrix)
        scenes.append(frame.luminance_cd_m2 - alone)
    assert len(scenes) > 2 and np.ptp([frame.x_px for frame in frames]) > 0.1
    # Of noise that is left, 50 cd/m² · 1e-9 times the frames, and of sums in another order.
    assert np.ptp(scenes, axis=0).max() < 1e-5
