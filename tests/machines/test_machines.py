"""Networks that classify as observers: closed forms, the pixels that they get, files that are refused."""

from __future__ import annotations

import os
import pickle
import re
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import correlator, identity, node, save, searching
from onnx import TensorProto, helper
from scipy.special import softmax
from scipy.stats import multivariate_normal

import todframes as tod
from todframes import ORIENTATIONS
from todframes.base import signals
from todframes.base.errors import DataError, SettingsError
from todframes.display.display import LuminanceTable
from todframes.machines.network_observer import NetworkObserver, NetworkSettings
from todframes.observers.interface import setting_names

SIDE, SIZE_PX, GAIN = 32, 8.0, 3.0
TURNS = [one.value for one in ORIENTATIONS]


def triangles(side: int = SIDE, size_px: float = SIZE_PX) -> np.ndarray:
    """Templates of the four triangles about pixel side // 2, which a uniform picture does not excite."""
    middle = {"size_px": size_px, "x_px": side // 2, "y_px": side // 2}
    shown = np.array([tod.coverage((side, side), orientation=one, **middle) for one in ORIENTATIONS])
    return np.asarray(shown - shown.mean(axis=(1, 2), keepdims=True))


def matched(path: Path) -> Path:
    return correlator(path, triangles())


def display(eotf: str = "linear", **more: Any) -> tod.Display:
    ends = {"white_luminance_cd_m2": 100.0, "black_luminance_cd_m2": 1.0, "background_luminance_cd_m2": 30.0}
    return tod.Display(eotf=eotf, pixel_pitch_mrad=0.25, **ends | more)


def noise_frames(n: int, contrasts: tuple[float, ...], noise: float) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Draw frames of code values about 0.5 with a triangle about pixel (24, 24), noise in contrast."""
    rng, shown = np.random.default_rng(1), [(c, one) for c in contrasts for one in TURNS for _ in range(n)]
    place = {"size_px": SIZE_PX, "x_px": 24, "y_px": 24}
    frames = [
        0.5 * (1.0 + c * tod.coverage((48, 48), orientation=one, **place) + rng.normal(0.0, noise, (48, 48)))
        for c, one in shown
    ]
    level, orientation = zip(*shown, strict=True)
    more = {"orientation": orientation, "level": level, "position": (24, 24), "size_mrad": 0.25 * SIZE_PX}
    grey = {"black_luminance_cd_m2": 0.0, "background_luminance_cd_m2": 50.0}
    return frames, more | {"display": display(**grey)}


def test_a_matched_filter_is_right_as_often_as_its_gaussian_scores(tmp_path: Path) -> None:
    """The largest of four scores in white noise: a probability of a normal of three differences, by SciPy."""
    (tmp_path / "m.toml").write_text("temperature = 0\n", encoding="utf-8")
    matched(tmp_path / "m.onnx")
    n, noise, contrasts = 100, 0.1, (0.02, 0.04, 0.08)
    frames, more = noise_frames(n, contrasts, noise)
    (fit,) = tod.score_frames(frames, observer=f"onnx:{tmp_path / 'm.onnx'}", **more).thresholds
    own = np.einsum("jyx,kyx->jk", triangles(), triangles())
    differences = np.array([[1, -1, 0, 0], [1, 0, -1, 0], [1, 0, 0, -1]])
    covariance = noise**2 * differences @ own @ differences.T
    for point in fit.points:
        mean = point.level * differences @ own[0]
        expected = multivariate_normal(np.zeros(3), covariance).cdf(mean)
        # Four standard errors of 400 answers; 3 points.
        assert abs(point.p_correct - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / (4 * n))


CODES = np.linspace(0.0, 1.0, 9)
MEASURED = LuminanceTable(code_value=CODES, luminance_cd_m2=1.0 + 99.0 * CODES**2)


@pytest.mark.parametrize("side", [31, 32])
@pytest.mark.parametrize(
    ("eotf", "more"),
    [("linear", {}), ("srgb", {}), ("bt1886", {}), ("gamma", {"gamma": 2.0}), ("lut", {"lut": MEASURED})],
)
def test_a_network_gets_the_code_values_of_whole_pixels(tmp_path: Path, eotf: str, more: Any, side: int) -> None:
    """Probabilities are the softmax of what NumPy computes on the nearest part of the frame, wherever it is."""
    weights = GAIN * np.random.default_rng(2).normal(0.0, 0.1, (4, side, side))
    path, rng = correlator(tmp_path / "m.onnx", weights), np.random.default_rng(3)
    frames, places = rng.random((8, 60, 64)), rng.uniform(22.0, 38.0, (8, 2))
    shown = {"orientation": (TURNS * 2)[:8], "level": [0.1, 0.2] * 4, "size_mrad": 2.0, "position": places}
    result = tod.score_frames(frames, display=display(eotf, **more), observer=f"onnx:{path}", **shown)
    for k, (frame, (x, y)) in enumerate(zip(frames, places, strict=True)):
        left, top = (min(range(30), key=lambda first, at=at: abs(first + (side - 1) / 2 - at)) for at in (x, y))
        expected = softmax(np.einsum("kyx,yx->k", weights, frame[top : top + side, left : left + side]))
        found = [result.trials.records[k][f"p_{one}"] for one in TURNS]
        assert found == pytest.approx(expected, abs=1e-5)  # sums of 1024 32-bit numbers


@pytest.mark.parametrize(
    ("settings", "given"),
    [
        ({}, {}),
        ({"white": 255.0}, {"scale": 1 / 255}),
        ({"black": -1.0}, {"scale": 0.5}),
        ({"answers": ["left", "down", "right", "up"]}, {"order": (3, 2, 1, 0)}),
        ({}, {"last": "Softmax"}),
        ({}, {"channels": 3, "layout": "nhwc"}),
    ],
)
def test_answers_are_the_softmax_of_the_values(tmp_path: Path, settings: Any, given: Any) -> None:
    order, scale = list(given.pop("order", range(4))), given.pop("scale", 1.0)
    path = correlator(tmp_path / "m.onnx", scale * GAIN * triangles()[order], **given)
    contrast = np.zeros((35, 35))
    contrast[1:33, 1:33] = 0.4 * (triangles()[1] + 0.3 * np.random.default_rng(4).normal(size=(32, 32)))
    found = NetworkObserver.read(path, **settings)
    expected = softmax(np.einsum("kyx,yx->k", GAIN * triangles(), 0.5 * np.clip(contrast, -1, 1)[1:33, 1:33]))
    stimulus = tod.Stimulus(0.8)
    assert found.grid(stimulus).side == 35
    assert found.expected_answers(contrast, stimulus) == pytest.approx(expected, abs=1e-5)
    copy = pickle.loads(pickle.dumps(found))
    assert np.array_equal(copy.expected_answers(contrast, stimulus), found.expected_answers(contrast, stimulus))


def test_a_network_for_pictures_of_any_size_keeps_the_contract(tmp_path: Path) -> None:
    path = searching(tmp_path / "m.onnx", triangles(41, 15.0))
    assert tod.check_observer(f"onnx:{path}") == []
    with pytest.raises(SettingsError, match="is an observer in a file, expected the name of a class"):
        tod.find_observer(f"onnx:{path}")
    with pytest.raises(SettingsError, match="found 'onnx:', expected onnx:FILE"):
        tod.check_observer("onnx:")


@pytest.mark.parametrize(("gain", "efficiency"), [(1.0, 1.0), (2.0, 4.0), (0.5, 0.25)])
def test_efficiency_is_a_squared_ratio_of_thresholds(tmp_path: Path, gain: float, efficiency: float) -> None:
    """Without noise, a gain of the values divides the threshold."""
    frames, more = noise_frames(1, tuple(np.geomspace(0.02, 1.28, 13)), 0.0)
    one, other = (correlator(tmp_path / f"{k}.onnx", 0.7 * k * triangles()) for k in (gain, 1.0))
    more |= {"observer": f"onnx:{one}", "relative_to": [f"onnx:{other}", "csf"], "examples": False}
    result = tod.score_frames(frames, fit=tod.FitSettings(resamples=200), **more)
    found, of_csf = result.efficiencies
    # The curve of Gaussian scores is not that of a softmax: fits to other parts of it differ by less than 3 %.
    assert found.efficiency == pytest.approx(efficiency, rel=0.03)
    low, high = found.efficiency_ci95
    assert low <= found.efficiency <= high
    own = result.thresholds[0].threshold
    assert of_csf.efficiency == pytest.approx((of_csf.threshold / own) ** 2, rel=1e-12)
    assert result.tables()[1].title == "Efficiency"
    assert any("Its efficiency relative to csf is" in text for text in result.sentences())


def test_commands_and_workers_give_the_same_numbers(tmp_path: Path, make_dataset, todframes) -> None:
    path, data = matched(tmp_path / "m.onnx"), make_dataset().path
    printed = [
        todframes("score", data, "--observer", f"onnx:{path}", "--set", "white=4", "--json", "--workers", n)
        for n in (1, 2)
    ]
    one, two = (re.sub(r'"(version|\w+_s)": .*', "", out) for _, out, _ in printed)
    assert one == two
    assert '"white": 4.0' in one and '"observer": "onnx:m.onnx"' in one
    asked = ("--enhance", "gaussian", "--white", 100, "--observer", f"onnx:{path},pyramid")
    status, out, _ = todframes("compare", data, *asked)
    assert status == 0 and "beyond gain" not in out.partition("for pyramid")[0]


def test_what_fails_in_a_run_is_an_error(tmp_path: Path) -> None:
    observer, stimulus = NetworkObserver.read(matched(tmp_path / "m.onnx")), tod.Stimulus(0.8)
    with pytest.raises(DataError, match="fails with a picture of 32 × 32"):
        NetworkObserver(observer.settings, layout="nhwc").expected_answers(np.zeros((35, 35)), stimulus)
    root = NetworkObserver.read(correlator(tmp_path / "r.onnx", np.ones((4, 32, 32)), last="Sqrt"))
    with pytest.raises(DataError, match="expected four finite values"):
        NetworkObserver(root.settings, white=-1.0).expected_answers(np.zeros((35, 35)), stimulus)
    falling = LuminanceTable(code_value=CODES, luminance_cd_m2=100.0 - 99.0 * CODES)
    with pytest.raises(SettingsError, match="luminance_cd_m2 does not rise"):
        observer.on_display(display("lut", lut=falling), lambda: 1.0)


def test_documented_settings_are_the_settings() -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "machines.md"
    documented = re.findall(r"`(\w+)`", page.read_text(encoding="utf-8"))
    assert set(setting_names(NetworkSettings)) <= set(documented)


def undecided(path: Path) -> Path:
    """Write a classifier by four templates that draws one of the answers."""
    nodes = [node("Reshape", "x shape", "flat"), node("MatMul", "flat w", "s")]
    nodes += [node("Multinomial", "s", "r", sample_size=1, dtype=TensorProto.INT64)]
    nodes += [node("OneHot", "r depth values", "hot"), node("Identity", "hot", "y")]
    values = {"shape": np.array([1, -1]), "w": triangles().reshape(4, -1).T.astype(np.float32)}
    values |= {"depth": np.int64(4), "values": np.float32([0.0, 1.0])}
    return save(path, nodes, values, shape=(1, 1, SIDE, SIDE))


def endless(path: Path) -> Path:
    """Write a classifier that never ends with a picture whose brightest pixel is above 0.9."""
    names = {"i": TensorProto.INT64, "c": TensorProto.BOOL, "v": TensorProto.FLOAT}
    ports = [helper.make_tensor_value_info(name, kind, []) for name, kind in names.items()]
    ends = [helper.make_tensor_value_info(f"{name}2", names[name], []) for name in "cv"]
    body = helper.make_graph([node("Identity", "c", "c2"), node("Identity", "v", "v2")], "body", ports, ends)
    nodes = [node("ReduceMax", "x", "m", keepdims=0), node("Greater", "m limit", "go")]
    nodes += [helper.make_node("Loop", ["", "go", "m"], ["z"], body=body), node("Mul", "four z", "y")]
    weights = {"limit": np.float32(0.9), "four": np.zeros(4, np.float32)}
    return save(path, nodes, weights, shape=(1, 1, SIDE, SIDE))


def test_a_signal_ends_a_network_that_does_not(tmp_path: Path) -> None:
    observer, bright = NetworkObserver.read(endless(tmp_path / "m.onnx")), np.full((35, 35), 1.0)
    assert observer.expected_answers(0.0 * bright, tod.Stimulus(0.8)).tolist() == [0.25] * 4
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
    with signals.raised(), pytest.raises(KeyboardInterrupt):
        observer.expected_answers(bright, tod.Stimulus(0.8))


BAD = {
    "a picture": (identity, "", "expected 4, one for each answer"),
    "three values": (lambda path: correlator(path, triangles()[:3]), "", "expected 4, one for each answer"),
    "drawn": (undecided, "", "other values for the same picture each time"),
    "NaN": (lambda path: correlator(path, -np.ones((4, 9, 9)), last="Sqrt"), "", "values that are NaN"),
    "too small": (lambda path: correlator(path, triangles(9, 2.0)), "", "expected pictures that hold it"),
    "its channels": (matched, "channels = 3", "found 3, expected 1"),
    "answers twice": (matched, 'answers = ["up", "up", "down", "left"]', "each of up, right, down and left once"),
    "one answer": (matched, 'answers = ["up"]', "a list of 4 values"),
    "no contrast": (matched, "black = 1", "expected two values"),
    "no file": (Path.exists, "", "no such file"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(tmp_path: Path, make_dataset, todframes, case: str) -> None:
    make, text, wanted = BAD[case]
    path = tmp_path / "bad.onnx"
    make(path)
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    status, out, err = todframes("score", make_dataset().path, "--observer", f"onnx:{path}")
    assert (status != 0, out, err.count("\n")) == (True, "", 1)
    assert wanted in err


def test_an_efficiency_needs_a_signal_and_known_observers(make_dataset, todframes) -> None:
    for option, more, wanted in (
        ("csv", {}, "the nearest valid one is 'csf'"),
        ("csf", {"level": "size_mrad", "group_by": []}, "expected one of signal"),
    ):
        data = make_dataset(option, sizes_mrad=(1.5, 2.0), experiment=more)
        status, out, err = todframes("score", data.path, "--relative-to", option)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert wanted in err
