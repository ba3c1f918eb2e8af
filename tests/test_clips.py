"""Clips: trials of several frames, frames of warm-up, triangles that move, and algorithms that take them."""

from __future__ import annotations

import csv
import io
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from todframes.base.errors import DataError, SettingsError
from todframes.enhancement.algorithm import algorithm, enhancement_names, find_enhancement
from todframes.frames.dataset import load_dataset
from todframes.frames.trials import Trials

CLIP_NAMES = [name for name in enhancement_names() if find_enhancement(name).declaration.clip]
COLUMNS = ("frame", "orientation", "size_mrad", "contrast", "x_px", "y_px", "trial", "clip", "time_s", "judged")


def manifest(folder: Path, rows: list[list[object]], columns: tuple[str, ...] = COLUMNS) -> Path:
    """Write a dataset whose frames need not exist."""
    (folder / "dataset.toml").write_text(
        "schema = 1\n[display]\neotf = 'linear'\npixel_pitch_mrad = 0.3\nwhite_luminance_cd_m2 = 1.0\n"
        "background_luminance_cd_m2 = 0.5\n[experiment]\nlevel = 'contrast'\n"
    )
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    (folder / "manifest.csv").write_text(text.getvalue())
    return folder


def row(
    number: int, *, trial: str = "t", clip: str = "c", time: object = None, judged: object = 1, x: float = 24.0
):
    """A row of the manifest; frame n has the time n / 10 s."""
    time = number / 10 if time is None else time
    return [f"{number}.exr", "up", 2.4, 0.5, x, 24.0, trial, clip, time, judged]


def error_of(folder: Path) -> str:
    """The only line about the bad rows of a dataset."""
    (bad,) = load_dataset(folder).bad_rows
    assert "\n" not in bad.error
    return bad.error


# The manifest


def test_frames_of_a_clip_come_before_a_trial(tmp_path: Path) -> None:
    rows = [row(0, judged=0), row(1, judged=0), row(2), row(3), row(4, trial="u"), row(0, clip="d")]
    rows[-1][0], rows[-1][6] = "d.exr", "v"
    data = load_dataset(manifest(tmp_path, rows))
    assert not data.bad_rows
    assert [[frame.path for frame in trial.frames] for trial in data.trials] == [
        ["2.exr", "3.exr"],
        ["4.exr"],
        ["d.exr"],
    ]
    assert all(not trial.warm_up for trial in data.trials)
    assert [frame.path for frame in data.trials.unjudged_frames()] == ["0.exr", "1.exr"]
    assert data.n_frames == 6
    before = [[frame.path for frame in trial.warm_up] for trial in data.trials.with_warm_up(3)]
    assert before == [["0.exr", "1.exr"], ["1.exr", "2.exr", "3.exr"], []]
    assert [frame.time_s for frame in data.trials[0].frames] == [0.2, 0.3]
    # A part of the trials takes its warm-up along to another process, and all of them also the other frames.
    part = data.trials.with_warm_up(3).select([2, 1])
    assert list(pickle.loads(pickle.dumps(part))) == list(part)
    again = pickle.loads(pickle.dumps(data.trials)).with_warm_up(1)
    assert list(again) == list(data.trials.with_warm_up(1))


def test_the_place_of_a_trial_is_the_mean_of_its_frames(tmp_path: Path) -> None:
    rows = [row(0, judged=0, x=10.0), row(1, x=20.0), row(2, x=21.0), row(3, x=25.0), row(4, trial="u", x=26.0)]
    moving, still = load_dataset(manifest(tmp_path, rows)).trials
    assert (moving.x_px, moving.y_px, still.x_px) == (22.0, 24.0, 26.0)
    assert [frame.motion_px for frame in moving.frames] == [(-2.0, 0.0), (-1.0, 0.0), (3.0, 0.0)]
    assert still.frames[0].motion_px is None
    assert list(Trials.of([moving, still])) == [moving, still]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            [row(0), row(1, time=0.0)],
            r"line 3: time_s: found 0, expected more than 0, the time of the frame before",
        ),
        ([row(0), row(1, time="")], r"line 3: found clip 'c' without time_s, expected both or none"),
        ([row(0), row(1, time="soon")], r"line 3: time_s: found 'soon', expected a finite number"),
        ([row(0), row(1, clip="d")], r"line 3: clip: found d, expected c as in the other frames of trial 't'"),
        ([row(0), row(1, judged="no")], r"line 3: judged: found 'no', expected 1 or 0"),
        ([row(0), row(1, judged=0, clip="")], r"line 3: judged: found 0 without a clip"),
        ([row(0, clip=""), row(1, clip="", x=25.0)], r"line 3: x_px: found 25.0, expected 24.0"),
    ],
)
def test_bad_rows(tmp_path: Path, rows: list[list[object]], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(error_of(manifest(tmp_path, rows)))


@pytest.mark.parametrize(
    ("left_out", "message"),
    [("time_s", "column clip without time_s"), ("clip", "column judged without clip")],
)
def test_columns_that_need_others(tmp_path: Path, left_out: str, message: str) -> None:
    kept = [place for place, name in enumerate(COLUMNS) if name != left_out]
    rows = [[one[place] for place in kept] for one in [row(0), row(1)]]
    with pytest.raises(DataError, match=message):
        load_dataset(manifest(tmp_path, rows, tuple(COLUMNS[place] for place in kept)))


def test_times_without_a_clip_mean_nothing(tmp_path: Path) -> None:
    """They are in datasets that were made before there were clips, in any order."""
    kept = [place for place, name in enumerate(COLUMNS) if name not in ("clip", "judged")]
    rows = [[one[place] for place in kept] for one in [row(0, time=3.0), row(1, time="")]]
    data = load_dataset(manifest(tmp_path, rows, tuple(COLUMNS[place] for place in kept)))
    assert not data.bad_rows
    assert data.trials[0].frames[1].time_s is None


def test_a_bad_row_breaks_its_clip(tmp_path: Path) -> None:
    """The frame is missing: a later trial must not take one of before in its place."""
    rows = [row(n, judged=0) for n in range(4)] + [row(4)]
    rows[2][3] = "strong"
    data = load_dataset(manifest(tmp_path, rows))
    assert len(data.bad_rows) == 1
    (trial,) = data.trials.with_warm_up(4)
    assert [frame.path for frame in trial.warm_up] == ["3.exr"]


# The declaration


def test_a_clip_algorithm_gets_what_it_names() -> None:
    @algorithm(clip=True, warm_up_frames="before")
    def seen(frames, *, judged, frame_rate_hz, before: int = 2, offset: float = 0.0):
        assert (frames.shape, judged.tolist(), frame_rate_hz) == ((5, 4, 6), [2, 3, 4], 25.0)
        return frames[before:] + offset

    found = replace(find_enhancement(seen), spec="seen")
    assert [one.name for one in found.parameters] == ["before", "offset"]
    assert (found.warm_up_frames, find_enhancement("gaussian").warm_up_frames) == (2, 0)
    frames = np.random.default_rng(0).random((5, 4, 6)).astype(np.float32)
    after, _ = found.run_clip(frames, np.array([2, 3, 4]), 25.0)
    assert np.array_equal(after, frames[2:])
    colour, _ = find_enhancement("temporal_mean:before=1").run_clip(
        np.stack([frames] * 3, -1), np.arange(1, 5), None
    )
    assert np.allclose(colour[..., 2], (frames[1:] + frames[:-1]) / 2.0, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"clip": True, "warm_up_frames": -1}, "warm_up_frames: found -1, expected a whole number"),
        ({"clip": True, "warm_up_frames": 2.5}, "warm_up_frames: found 2.5, expected a whole number"),
        ({"warm_up_frames": 1}, "warm_up_frames: found 1 without clip"),
    ],
)
def test_bad_declarations(declared: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        algorithm(**declared)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda frames: frames, "gave 3 frames for a trial of 2 and 1 before it, expected 2, one for each frame"),
        (lambda frames: frames[1:, :-1], r"gave shape \(2, 3, 6\) for \(3, 4, 6\), expected \(2, 4, 6\)"),
        (lambda frames: frames[1:] / 0.0, "gave 48 values that are NaN or infinite, the first at frame 0, row 0"),
        (lambda frames: frames + 1 // 0, "ZeroDivisionError"),
    ],
)
def test_wrong_results_of_clips(function, message: str) -> None:
    wrong = find_enhancement(algorithm(clip=True, warm_up_frames=1)(function))
    with pytest.raises(DataError, match=message):
        wrong.run_clip(np.ones((3, 4, 6), np.float32), np.array([1, 2]), None)


# The algorithms of the package


def shaking(noise_sd: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scene that is shifted by splines from frame to frame, the scene, and the shifts (x, y)."""
    rng = np.random.default_rng(1)
    scene = ndimage.gaussian_filter(rng.standard_normal((72, 80)), 2.0)
    scene = 0.5 + 0.08 * scene / scene.std()
    shifts = np.array([[0.0, 0.0], [0.6, -0.4], [1.5, 0.7], [2.2, 1.3], [1.2, 2.0], [0.5, 1.1]])
    frames = np.array([ndimage.shift(scene, (y, x), order=3, mode="mirror") for x, y in shifts])
    return (frames + noise_sd * rng.standard_normal(frames.shape)).astype(np.float32), scene, shifts


@pytest.mark.parametrize("name", CLIP_NAMES)
def test_contract_of_clips(name: str) -> None:
    """A uniform field stays; earlier frames alone have an effect; the input stays; no direction is preferred."""
    found = find_enhancement(name)
    n, frames = found.warm_up_frames, shaking(0.01)[0]
    clip = np.ascontiguousarray(np.concatenate([frames] * 5)[: n + 2, :40, :40])
    judged, before = np.arange(n, n + 2), clip.copy()
    after, cpu_s = found.run_clip(clip, judged, 25.0)
    m = found.magnification
    assert after.shape == (2, round(m * 40), round(m * 40))
    assert np.array_equal(clip, before)
    assert np.array_equal(found.run_clip(clip, judged, 25.0)[0], after)
    assert cpu_s >= 0.0
    turned, _ = found.run_clip(np.ascontiguousarray(np.rot90(clip, axes=(1, 2))), judged, 25.0)
    # ECC ends at a correlation known to 1e-6, that is, at a place known to some thousandths of a pixel, on a scene
    # whose slope is 0.04 a pixel.
    assert np.allclose(np.rot90(turned, -1, axes=(1, 2)), after, rtol=0.0, atol=1e-3)
    if name != "stabilize":  # which takes the mean place of the whole trial
        alone, _ = found.run_clip(clip[:-1], judged[:-1], 25.0)
        assert np.array_equal(alone[0], after[0])
    even, _ = found.run_clip(np.full((n + 2, 30, 36), 0.4, np.float32), judged, 25.0)
    assert np.allclose(even, 0.4, rtol=0.0, atol=2e-5)  # 16 bits


def test_recursive_is_a_geometric_series() -> None:
    frames = np.random.default_rng(0).random((9, 5, 6)).astype(np.float32)
    after, _ = find_enhancement("recursive:weight=0.3,before=6").run_clip(frames, np.arange(6, 9), None)
    for k, found in zip(range(6, 9), after, strict=True):
        weights = 0.3 * 0.7 ** np.arange(k + 1.0)[::-1]
        weights[0] /= 0.3  # the first frame is the start
        assert np.allclose(found, np.tensordot(weights, frames[: k + 1], 1), rtol=0.0, atol=1e-6)


def test_temporal_nlm_averages_alike_patches_alone() -> None:
    """Hundreds of patches of the same level are averaged, in all frames alike, and none across the step of 0.4."""
    rng, clean = np.random.default_rng(0), np.where(np.arange(40) < 20, 0.3, 0.7) * np.ones((40, 1))
    noisy = (clean + rng.normal(0.0, 0.01, (5, 40, 40))).astype(np.float32)
    after, _ = find_enhancement("temporal_nlm:h=0.02,before=4").run_clip(noisy, np.array([4]), None)
    assert (after[0] - clean)[:, :12].std() < 0.01 / 20
    assert np.abs(after[0] - clean).max() < 0.02
    again, _ = find_enhancement("temporal_nlm:h=0.02,before=4").run_clip(
        noisy[[3, 1, 0, 2, 4]], np.array([4]), None
    )
    assert np.allclose(again, after, rtol=0.0, atol=2 / 65535)
    noisy[:4] += 0.2  # nothing in the other frames is alike
    alone, _ = find_enhancement("temporal_nlm:h=0.02,before=4").run_clip(noisy, np.array([4]), None)
    assert np.abs(alone[0] - clean).max() < 0.02


def inner(image: np.ndarray, margin: int = 10) -> np.ndarray:
    return image[..., margin:-margin, margin:-margin]


def test_registration_finds_the_motion() -> None:
    """Frames are brought to the last one, or to the mean place; splines move the scene there by other code."""
    frames, scene, shifts = shaking()
    after, _ = find_enhancement("registered_mean:before=5").run_clip(frames, np.array([5]), None)
    before = np.abs(inner(frames.mean(axis=0) - frames[5])).max()
    assert np.abs(inner(after[0] - frames[5])).max() < 0.1 * before
    x, y = shifts.mean(axis=0)
    at_mean = ndimage.shift(scene, (y, x), order=3, mode="mirror")
    steady, _ = find_enhancement("stabilize").run_clip(frames, np.arange(6), None)
    assert np.abs(inner(steady - at_mean)).max() < 0.1 * np.abs(inner(frames - at_mean)).max()


def test_shift_and_add_is_finer() -> None:
    """A pixel of the frame is two of the result, in the same place: a spline of twice the pixels is alike."""
    frames, _, _ = shaking(0.02)
    clean = shaking()[0][5]
    finer = ndimage.zoom(clean, 2, order=3, mode="mirror", grid_mode=True)
    after, _ = find_enhancement("shift_and_add:before=5").run_clip(frames, np.array([5]), None)
    # The mean of six frames has 1/√6 of their noise; interpolation takes some more away.
    assert inner(after[0] - finer, 20).std() < 0.02 / np.sqrt(6.0)


def test_without_structure_nothing_is_moved() -> None:
    """Frames of different levels have nothing in common that ECC could find."""
    frames = np.full((3, 24, 24), 0.5, np.float32)
    after, _ = find_enhancement("registered_mean:before=2").run_clip(frames, np.array([2]), None)
    assert np.array_equal(after[0], frames[0])
