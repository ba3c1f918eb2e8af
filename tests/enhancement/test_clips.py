"""Clips: trials of several frames, frames of warm-up, triangles that move, and algorithms that take them."""

from __future__ import annotations

import csv
import io
import pickle
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.simulation import Filming, Simulator, plan_trials
from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.enhancement.algorithm import algorithm
from todframes.enhancement.builtin_clips import correlation_of_noise
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader
from todframes.enhancement.finding import enhancement_names, find_enhancement
from todframes.enhancement.scored_algorithms import score_algorithms
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, frame_sha256, write_frame
from todframes.frames.memory import memory_dataset
from todframes.frames.trials import Trials
from todframes.observers.pyramid import PyramidObserver

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


def without(folder: Path, *names: str, rows: list[list[object]]) -> Path:
    """Write a dataset without some columns."""
    kept = [place for place, name in enumerate(COLUMNS) if name not in names]
    return manifest(folder, [[one[k] for k in kept] for one in rows], tuple(COLUMNS[k] for k in kept))


def row(
    number: int, *, trial: str = "t", clip: str = "c", time: object = None, judged: object = 1, x: float = 24.0
):
    """A row of the manifest; frame n has the time n / 10 s."""
    time = number / 10 if time is None else time
    return [f"{number}.exr", "up", 2.4, 0.5, x, 36.0 - x / 2, trial, clip, time, judged]


def test_frames_of_a_clip_come_before_a_trial(tmp_path: Path) -> None:
    rows = [row(0, judged=0), row(1, judged=0), row(2), row(3), row(4, trial="u"), row(0, clip="d")]
    rows[-1][0], rows[-1][6] = "d.exr", "v"
    data = load_dataset(manifest(tmp_path, rows))
    assert not data.bad_rows
    judged = [[frame.path for frame in trial.frames] for trial in data.trials]
    assert judged == [["2.exr", "3.exr"], ["4.exr"], ["d.exr"]]
    assert all(not trial.warm_up for trial in data.trials)
    assert [frame.path for frame in data.trials.unjudged_frames] == ["0.exr", "1.exr"]
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
    assert (moving.x_px, moving.y_px, still.x_px, still.y_px) == (22.0, 25.0, 26.0, 23.0)
    assert [frame.motion_px for frame in moving.frames] == [(-2.0, 1.0), (-1.0, 0.5), (3.0, -1.5)]
    assert Trials.of([still, moving]).most_motion_px == np.hypot(3.0, 1.5)
    assert still.frames[0].motion_px is None
    assert list(Trials.of([moving, still])) == [moving, still]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([row(0), row(1, time=0.0)], r"line 3: time_s: found 0, expected more than 0, the time of the frame bef"),
        ([row(0), row(1, time="")], r"line 3: found clip 'c' without time_s, expected both or none"),
        ([row(0, time=-1e308)], r"line 2: time_s: found -1e\+308 s, expected a time from -1e\+12 to 1e\+12 s"),
        ([row(0), row(1, time="soon")], r"line 3: time_s: found 'soon', expected a finite number"),
        ([row(0), row(1, clip="d")], r"line 3: clip: found d, expected c as in the other frames of trial 't'"),
        ([row(0), row(1, judged="no")], r"line 3: judged: found 'no', expected 1 or 0"),
        ([row(0), row(1, judged=0, clip="")], r"line 3: judged: found 0 without a clip"),
        ([row(0, clip=""), row(1, clip="", x=25.0)], r"line 3: x_px: found 25.0, expected 24.0"),
    ],
)
def test_bad_rows(tmp_path: Path, rows: list[list[object]], message: str) -> None:
    (bad,) = load_dataset(manifest(tmp_path, rows)).bad_rows
    assert re.search(message, bad.error) and "\n" not in bad.error


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        ("time_s", "found the column clip without time_s, expected both or none"),
        ("clip", "found the column judged without clip, expected both or none"),
        ("y_px", "found one of the columns x_px and y_px, expected both or none"),
    ],
)
def test_columns_that_need_others(tmp_path: Path, left_out: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        load_dataset(without(tmp_path, left_out, rows=[row(0), row(1)]))


def test_a_bad_row_breaks_its_clip(tmp_path: Path) -> None:
    """The frame is missing: a later trial must not take one of before in its place."""
    rows = [row(n, judged=0) for n in range(4)] + [row(4)]
    rows[2][3] = "strong"
    data = load_dataset(manifest(tmp_path, rows))
    assert len(data.bad_rows) == 1
    (trial,) = data.trials.with_warm_up(4)
    assert [frame.path for frame in trial.warm_up] == ["3.exr"]


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
    mean, colours = find_enhancement("temporal_mean:before=1"), np.stack([frames] * 3, -1)
    colour, _ = mean.run_clip(colours, np.arange(1, 5), None)
    assert np.allclose(colour[..., 2], (frames[1:] + frames[:-1]) / 2.0, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda frames: frames, r"gave shape \(3, 4, 6\) for \(3, 4, 6\), expected \(2, 4, 6\)"),
        (lambda frames: frames[1:, :-1], r"gave shape \(2, 3, 6\) for \(3, 4, 6\), expected \(2, 4, 6\)"),
        (lambda frames: frames[1:] / 0.0, "gave 48 values that are NaN or infinite, the first at frame 0, row 0"),
        (lambda frames: frames + 1 // 0, "ZeroDivisionError"),
    ],
)
def test_wrong_results_of_clips(function, message: str) -> None:
    wrong = find_enhancement(algorithm(clip=True, warm_up_frames=1)(function))
    with pytest.raises(DataError, match=message):
        wrong.run_clip(np.ones((3, 4, 6), np.float32), np.array([1, 2]), None)


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
    nlm = find_enhancement("temporal_nlm:h=0.02,before=4")
    after, _ = nlm.run_clip(noisy, np.array([4]), None)
    assert (after[0] - clean)[:, :12].std() < 0.01 / 20
    assert np.abs(after[0] - clean).max() < 0.02
    again, _ = nlm.run_clip(noisy[[3, 1, 0, 2, 4]], np.array([4]), None)
    assert np.allclose(again, after, rtol=0.0, atol=2 / 65535)
    noisy[:4] += 0.2  # nothing in the other frames is alike
    alone, _ = nlm.run_clip(noisy, np.array([4]), None)
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


@pytest.mark.parametrize("smoothing_px", [5, 11])
def test_noise_is_not_registered(smoothing_px: int) -> None:
    """ECC ends somewhere in noise too, up to half a picture away, but nothing is alike there."""
    rng, own = np.random.default_rng(2), f"smoothing_px={smoothing_px}"
    noise = (0.5 + 0.1 * rng.standard_normal((25, 48, 48))).astype(np.float32)
    assert np.array_equal(find_enhancement(f"stabilize:{own}").run_clip(noise, np.arange(25), None)[0], noise)
    both = (f"registered_mean:before=24,motion=affine,{own}", "temporal_mean:before=24")
    one, other = (find_enhancement(spec).run_clip(noise, np.array([24]), None)[0] for spec in both)
    assert np.allclose(one, other, rtol=0.0, atol=1e-6)
    smoothed = np.array([cv2.GaussianBlur(frame, (smoothing_px,) * 2, 0) for frame in noise])
    correlations = np.corrcoef(smoothed.reshape(25, -1))[np.triu_indices(25, 1)]
    # 300 pairs: the standard deviation is known to 4 %, and the window ends at 1.8 σ or more: 5 % less.
    assert correlations.std() == pytest.approx(correlation_of_noise(48 * 48, smoothing_px), rel=0.15)


DISPLAY = tod.Display(
    eotf="linear", white_luminance_cd_m2=100.0, background_luminance_cd_m2=50.0, pixel_pitch_mrad=0.3
)
SIDE_PX, SIZE_PX = 32, 8.0
EXACT = tod.FitSettings(resamples=40)


def triangle(orientation: str, x_px: float, side_px: int = SIDE_PX) -> np.ndarray:
    place = {"x_px": x_px, "y_px": (side_px - 1) / 2}
    return tod.coverage((side_px, side_px), size_px=SIZE_PX, orientation=tod.Orientation(orientation), **place)


def clip_dataset(clips: list[tuple[str, float, list[np.ndarray]]], n_judged: int, places=None):
    """A dataset in memory of clips (orientation, level, contrasts of the frames) whose last frames are judged."""
    n = len(clips[0][2])
    each = [(one, k) for one in range(len(clips)) for k in range(n)]
    middle = (SIDE_PX - 1) / 2 if places is None else None
    return memory_dataset(
        [0.5 * (1.0 + clips[one][2][k]) for one, k in each],
        display=DISPLAY,
        orientation=[clips[one][0] for one, _ in each],
        level=[clips[one][1] for one, _ in each],
        size_mrad=SIZE_PX * 0.3,
        position=[(middle, middle) if places is None else places[k] for _, k in each],
        trial=[one for one, _ in each],
        clip=[str(one) for one, _ in each],
        time_s=[k / 50.0 for _, k in each],
        judged=[k >= n - n_judged for _, k in each],
    )


@pytest.mark.parametrize("noise", ["dynamic", "fixed"])
@pytest.mark.slow
def test_a_mean_of_n_frames_lowers_thresholds_in_dynamic_noise_by_root_n(noise: str) -> None:
    """Independent frames f of Gaussian noise: u·f with u = (1, …, 1)/√n is √n times their mean, a·f the last one.

    The reflection that swaps u and a turns f into frames as independent, whose mean and last frame have changed
    places. With both as trials, the noise of all means is that of all last frames, divided by √n: nothing is left
    to chance. Levels are in steps of √2, so that with n = 4 there is one at twice each.
    """
    n, sd, levels = 4, 0.15, 0.08 * 2.0 ** (np.arange(-7, 8) / 2)
    rng = np.random.default_rng(5)
    swap = np.full(n, 1.0 / np.sqrt(n)) - np.eye(n)[-1]
    reflect = np.eye(n) - 2.0 * np.outer(swap, swap) / (swap @ swap)
    clips = []
    for _ in range(6 if noise == "dynamic" else 1):
        frames = rng.standard_normal((n, SIDE_PX, SIDE_PX))
        if noise == "fixed":
            frames[:] = frames[0]
        for of_trial in (frames, np.tensordot(reflect, frames, 1) if noise == "dynamic" else frames[::-1]):
            for turn in tod.ORIENTATIONS:  # so that a pattern of noise alone answers one of four rightly
                shape = triangle(turn, (SIDE_PX - 1) / 2)
                clips += [(turn, c, [c * shape + sd * one for one in of_trial]) for c in levels]
    observer = PyramidObserver(internal_noise=1e-3, position_jitter_samples=0.0)
    none, mean = tod.compare(
        clip_dataset(clips, 1),
        enhance=[f"temporal_mean:before={n - 1}"],
        observer=observer,
        fit=EXACT,
        examples=False,
    ).conditions
    ratio = none.fits[0].threshold / mean.fits[0].threshold
    if noise == "fixed":
        assert ratio == pytest.approx(1.0, abs=1e-4)  # 32-bit values
    else:
        assert ratio == pytest.approx(np.sqrt(n), rel=0.01)


@pytest.mark.parametrize("gaze", ["tracked", pytest.param("fixed", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_recursive_filter_smears_what_moves(gaze: str) -> None:
    """Against frames that are filtered, shifted and averaged here: the way is a whole number of pixels a frame."""
    weight, n, n_judged, step_px, side_px = 0.3, 12, 5, 2, 72
    places = [(40.0 + step_px * (k - (n - 1)), (side_px - 1) / 2) for k in range(n)]
    levels, clips, stills = np.geomspace(0.02, 2.0, 8), [], {"none": [], "recursive": []}
    shown = [(turn, float(c)) for c in levels for turn in tod.ORIENTATIONS]
    for turn, c in shown:
        frames = [c * triangle(turn, x, side_px) for x, _ in places]
        clips.append((turn, c, frames))
        state, after = frames[0], []
        for frame in frames:
            state = (1.0 - weight) * state + weight * frame
            after.append(state)
        for name, series in (("none", frames), ("recursive", after)):
            judged = series[-n_judged:]
            if gaze == "tracked":  # shifted to the place of the middle one
                judged = [np.roll(one, step_px * (n_judged // 2 - k), axis=1) for k, one in enumerate(judged)]
            stills[name].append(0.5 * (1.0 + np.mean(judged, axis=0)))
    observer = PyramidObserver(position_jitter_samples=0.0)
    more = {"observer": observer, "fit": EXACT, "examples": False}
    spec = f"recursive:weight={weight},before={n - n_judged}"
    found = tod.compare(clip_dataset(clips, n_judged, places), enhance=[spec], gaze=gaze, **more)
    thresholds = [one.fits[0].threshold for one in found.conditions]
    turns, contrasts = zip(*shown, strict=True)
    for threshold, frames in zip(thresholds, stills.values(), strict=True):
        how = {"size_mrad": SIZE_PX * 0.3, "position": places[n - 1 - n_judged // 2], "plan": "full"} | more
        literal = tod.score_frames(frames, display=DISPLAY, orientation=turns, level=contrasts, **how).fits[0]
        assert literal.status == "ok"
        assert threshold == pytest.approx(literal.threshold, rel=0.01)
    assert thresholds[1] > 1.2 * thresholds[0]


def test_both_gazes_are_those_of_two_runs() -> None:
    """Also after an algorithm with other pixels; the frames are enhanced once."""
    enhanced = []

    @algorithm(clip=True, warm_up_frames=1, magnification=2)
    def finer_mean(frames, *, judged):
        enhanced.append(len(judged))
        return np.stack([np.kron((frames[k - 1] + frames[k]) / 2.0, np.ones((2, 2), np.float32)) for k in judged])

    places = [(15.0 + 1.25 * k, (SIDE_PX - 1) / 2) for k in range(3)]
    clips = [
        (turn, c, [c * triangle(turn, x) for x, _ in places]) for c in (0.05, 0.2, 0.8) for turn in ("up", "left")
    ]
    data, settings = clip_dataset(clips, 2, places), {"fit": EXACT, "examples": False, "plan": "full"}
    both = tod.compare(data, enhance=[finer_mean], gaze="fixed,tracked", **settings)
    n_trials = enhanced.count(2)
    fixed, tracked = (
        tod.compare(data, enhance=[finer_mean], gaze=gaze, **settings) for gaze in ("fixed", "tracked")
    )
    assert n_trials == enhanced.count(2) / 3
    thresholds = []
    for alone, of_both in ((fixed, both.conditions), (tracked, both.observers[0].conditions)):
        for one, other in zip(alone.conditions, of_both, strict=True):
            thresholds.append(one.fits[0].threshold)
            # The places of a fixed gaze are found in another way, to rounding.
            assert other.fits[0].threshold == pytest.approx(thresholds[-1], rel=1e-9)
        gains = [one[1].contrast_responses[0].points[-1].gain for one in (alone.conditions, of_both)]
        assert gains[0] == pytest.approx(gains[1], rel=1e-9)
    assert thresholds[0] > 1.02 * thresholds[2]
    moves = "Within a trial the triangle moves, by up to 0.188 mrad from its mean place; the gaze "
    follows, stays = "follows it (tracked)", "stays at that place (fixed), so that motion is blur"
    said = [one.summary().split(moves)[1].split(".\n")[0].rstrip(".") for one in (tracked, fixed, both)]
    assert said == [follows, stays, f"{follows} or {stays}"]
    assert [line.split(":")[0] for line in both.verdict[-2:]] == ["pyramid (fixed)", "pyramid (tracked)"]
    assert (both.settings["gaze"], both.observers[0].settings["gaze"]) == ("fixed", "tracked")


@pytest.mark.parametrize("gaze", ["both", "tracked,tracked", "tracked, fixed", "", ()])
def test_bad_gazes(gaze) -> None:
    data = clip_dataset([("up", 0.2, [0.2 * triangle("up", 15.5)])], 1)
    with pytest.raises(SettingsError, match=r"^gaze: found .*, expected tracked, fixed or tracked,fixed$"):
        tod.compare(data, enhance=["gaussian"], gaze=gaze)
    with pytest.raises(SettingsError, match=r"gaze: found 'tracked,fixed', expected one of tracked, fixed$"):
        tod.score(data, gaze="tracked,fixed")  # type: ignore[arg-type]


SENSOR = ss.load_sensor("sample_frames/star_like.toml")
SENSOR = replace(SENSOR, display=replace(SENSOR.display, pixels_per_detector=2, blur_sigma_px=0.7))


def simulated(out: Path, **settings: object) -> Path:
    chosen = {"size_detectors": [4.0], "snr": [0.5, 2.0, 8.0], "trials": 4} | settings
    ss.simulate(SENSOR, out=out, **chosen)
    return out


def test_a_simulated_clip_moves_and_has_the_noise_of_its_frames() -> None:
    """Six frames in 100 ms: their mean has the noise of the displayed sample, and the fixed pattern stays."""
    noise = replace(SENSOR.noise, fixed_pattern_ratio=0.4, frames_integrated=6)
    display = replace(SENSOR.display, pixels_per_detector=1, blur_sigma_px=0.0)
    sensor = replace(SENSOR, noise=noise, display=display)
    filming = Filming(motion_mrad_per_s=5.0, warm_up_frames=2)
    simulator = Simulator(sensor, 4.0, seed=3, filming=filming)
    trials, level = plan_trials([4.0], [1e-6], 30), 1e-6  # noise alone
    clips = [simulator.clip(trial) for trial in trials]
    for clip in clips:
        places = np.array([(frame.x_px, frame.y_px) for frame in clip])
        steps = np.hypot(*np.diff(places, axis=0).T)
        # A pixel is a detector here.
        assert np.allclose(steps, 5.0 * 0.1 / 6 / sensor.pitch_mrad, rtol=1e-9)
        middle = places[2:].mean(axis=0) - (simulator.field - 1) / 2
        assert np.abs(middle).max() <= 0.5
    signal = np.array([[frame.luminance_cd_m2 for frame in clip] for clip in clips])
    signal = (signal / sensor.display.background_luminance_cd_m2 - 1.0) / sensor.display.gain * level
    mean = signal[:, 2:].mean(axis=1)
    pattern = mean.mean(axis=0)
    # k = 1.7496 (Hogervorst et al. 2001, below eq. 4): the pattern has 0.4 k, a frame k of dynamic noise. Some 700
    # detectors in 30 trials of 8 frames: relative standard errors of 1/√(2 n), 0.2 % for the frames. That of the
    # pattern's 700 is 2.7 %, so its own values are compared, which the seed gives.
    k = 1.0 / np.hypot(1.0 / np.sqrt(6.0), 0.4)
    assert np.sqrt(signal.var(axis=(0, 1), ddof=1).mean()) == pytest.approx(k, rel=0.01)
    assert np.sqrt(mean.var(axis=0, ddof=1).mean()) == pytest.approx(k / np.sqrt(6.0), rel=0.03)
    assert np.allclose(pattern, 0.4 * k * simulator.pattern.own, rtol=0.0, atol=6.0 * k / np.sqrt(6 * 30))


def test_a_simulated_clip_is_a_dataset(tmp_path: Path) -> None:
    data = load_dataset(simulated(tmp_path / "data", motion_mrad_per_s=1.0, warm_up_frames=3))
    assert not data.bad_rows
    assert (len(data.trials), data.trials.n_frames, data.n_frames) == (12, 12 * 6, 12 * 9)
    for trial in data.trials.with_warm_up(4):
        assert len(trial.warm_up) == 3
        times = [frame.time_s for frame in (*trial.warm_up, *trial.frames)]
        assert np.allclose(np.diff(times), 0.1 / 6, rtol=0.0, atol=2e-6)  # six decimals
    result = tod.validate(data)
    assert (result.skipped, result.warnings) == ((), ())
    lost = data.frame_path(next(iter(data.trials.unjudged_frames)))
    lost.write_bytes(lost.read_bytes()[:-100])
    (problem,) = tod.validate(data).skipped
    assert lost.name in problem["frame"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"motion_mrad_per_s": -1.0}, "motion_mrad_per_s: found -1.0, expected a number from 0 to"),
        ({"motion_mrad_per_s": 5000.0}, "motion_mrad_per_s: moves the triangle by .* detectors from its mean"),
    ],
)
def test_bad_motions(tmp_path: Path, settings: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        simulated(tmp_path / "data", **settings)
    assert not (tmp_path / "data").exists()


def test_too_few_frames_before_a_trial(tmp_path: Path) -> None:
    """One line; and with skip, such trials are left out for all algorithms."""
    path = simulated(tmp_path / "data", warm_up_frames=2)
    with pytest.raises(FrameError, match=r"takes 16 frames before trial 's0_n0_up_0', and clip .* has 2") as found:
        tod.compare(path, enhance=["recursive"], fit=EXACT)
    assert "\n" not in str(found.value)
    text = (path / "manifest.csv").read_text().splitlines()
    at = text[0].split(",").index("judged")
    first = next(number for number, line in enumerate(text) if ",s0_n0_up_0," in line)
    fields = text[first].split(",")
    fields[at], fields[at - 3] = "1", "early"
    (path / "manifest.csv").write_text("\n".join([*text[:first], ",".join(fields), *text[first + 1 :], ""]))
    settings = {"white": 200.0, "fit": EXACT, "examples": False}
    result = tod.compare(path, enhance=["temporal_mean:before=2"], on_error="skip", **settings)
    assert [one["frame"] for one in result.skipped] == [fields[0]]
    assert [sum(fit.n_trials for fit in one.fits) for one in result.conditions] == [12, 12]
    frame = {"frames": [np.ones((9, 9))], "orientation": "up", "level": 1.0, "size_mrad": 0.6, "display": DISPLAY}
    with pytest.raises(DataError, match=r"frame 0: time_s: found 1e\+308 s, expected a time from"):
        memory_dataset(**frame, clip="c", time_s=[1e308])
    with pytest.raises(FrameError, match="the manifest names no clip of it; expected the columns clip and time_s"):
        tod.compare(memory_dataset(**frame), enhance=["temporal_mean"], fit=EXACT)


@pytest.mark.slow
def test_kept_results_depend_on_the_frames_before(tmp_path: Path) -> None:
    path = simulated(tmp_path / "data", warm_up_frames=2, motion_mrad_per_s=0.5, trials=8)
    settings = {"white": 200.0, "fit": EXACT, "examples": False, "store": tmp_path / "store"}

    def compared(spec: str = "temporal_mean:before=2", **more: object) -> tuple[int, float]:
        found = tod.compare(path, enhance=[spec], **(settings | more))
        return found.from_store, found.conditions[1].fits[0].threshold

    threshold = compared()[1]
    assert compared("temporal_mean:before=1")[0] == 0
    assert compared(gaze="fixed")[0] == 0
    assert compared() == (24, threshold)
    changed = path / "frames" / "s0_n1_right_1_001.exr"
    with FrameFile(changed) as file:
        write_frame(changed, 1.5 * file.read().values)
    text, digest = (path / "manifest.csv").read_text(), frame_sha256(changed)
    (path / "manifest.csv").write_text(re.sub(rf"({changed.name}.*,)[0-9a-f]+", rf"\g<1>{digest}", text))
    assert compared()[0] == 23  # all trials but the one that it comes before


def test_brightening_of_a_clip_is_not_its_noise() -> None:
    """A background that is a number follows what the algorithm does to brightness, not the noise of a border."""

    @algorithm(clip=True, warm_up_frames=1)
    def brighter(frames, *, judged):
        return 1.5 * frames[judged]

    rng, shape = np.random.default_rng(2), triangle("up", (SIDE_PX - 1) / 2)
    clips = [
        ("up", c, [c * shape + 0.5 * rng.standard_normal(shape.shape) for _ in range(3)]) for c in (0.1, 0.3, 1.0)
    ]
    data = clip_dataset(clips, 2)
    algorithms = [find_enhancement(one) for one in ("none", brighter, "temporal_mean:before=1")]
    reader, observer = TrialReader(algorithms, AlgorithmDisplay(DISPLAY)), PyramidObserver()
    for trial in data.trials.with_warm_up(1):
        (plain, bright, mean), _ = reader.read(data, trial, observer, observer.grid(trial.stimulus))
        for one, other in zip(plain.patches, bright.patches, strict=True):
            assert np.allclose(one.values, other.values, rtol=0.0, atol=1e-5)  # 32-bit values
        assert mean.background_luminance_cd_m2 == pytest.approx(50.0, rel=1e-6)


def test_a_gap_before_a_trial(tmp_path: Path) -> None:
    rows = [row(n, judged=int(n == 5)) for n in (0, 1, 2, 3, 5)]
    data = load_dataset(manifest(tmp_path, rows))
    with pytest.raises(FrameError, match=r"5\.exr: comes 0\.2 s after the frame before it .* expected 0\.1 s"):
        score_algorithms(
            data, [PyramidObserver()], [find_enhancement("temporal_mean:before=3")], fit_settings=EXACT
        )
    for number, side in enumerate((48, 48, 40)):
        write_frame(tmp_path / f"{number}.exr", np.full((side, side), 0.5))
    data = load_dataset(manifest(tmp_path, [row(n, judged=int(n == 2)) for n in range(3)]))
    with pytest.raises(FrameError, match=r"2\.exr: has 40 × 40 pixels, expected 48 × 48 as the first frame that"):
        score_algorithms(
            data, [PyramidObserver()], [find_enhancement("temporal_mean:before=2")], fit_settings=EXACT
        )


@pytest.mark.slow
def test_documented_smear_is_what_the_filter_does(capsys) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how_to" / "clips.md").read_text(encoding="utf-8")
    code, text = (
        re.search(rf"^```{kind} smear\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[1]
        for kind in ("python", "text")
    )
    exec(compile(code, "clips.md", "exec"), {})
    assert capsys.readouterr().out == text
