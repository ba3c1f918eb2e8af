"""Neural networks in ONNX files: what they must not change, tiles without seams, and files that are refused."""

from __future__ import annotations

import inspect
import pickle
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from networks import (
    ANY,
    blur,
    box,
    convolution,
    denoiser,
    finer,
    halving,
    identity,
    less_noise,
    node,
    of_each_channel,
    save,
    weighted,
    with_weights_in,
)
from onnx import TensorProto
from scipy import ndimage

from todframes.base.errors import DataError, SettingsError
from todframes.enhancement import network
from todframes.enhancement.algorithm import Enhancement
from todframes.enhancement.finding import find_enhancement, plain_value
from todframes.enhancement.scored_algorithms import parts_of
from todframes.jobs.fingerprint import fingerprint


def found(path: Path, more: str = "") -> Enhancement:
    return find_enhancement(f"onnx:{path}:{more}" if more else f"onnx:{path}")


def picture(rows: int = 70, columns: int = 90, channels: int = 0, seed: int = 0) -> np.ndarray:
    shape = (rows, columns, channels) if channels else (rows, columns)
    return np.random.default_rng(seed).random(shape, np.float32)


@pytest.mark.every_case
@pytest.mark.parametrize("values", ["", "black=0,white=255", "black=-1,white=1"])
@pytest.mark.parametrize(("channels", "layout"), [(1, "nchw"), (3, "nchw"), (1, "nhwc"), (3, "nhwc")])
def test_identity_changes_no_number(tmp_path: Path, values: str, channels: int, layout: str) -> None:
    path = identity(tmp_path / "same.onnx", channels=channels, layout=layout)
    algorithm = found(path, values)
    assert algorithm.values["layout"] == layout
    for image in (picture(), picture(channels=3)):
        # Rounding of 32-bit numbers near 255 / 255, and the weights of luminance sum to 1 within that.
        assert np.abs(algorithm.run(image)[0] - image).max() <= 1e-6


def test_box_and_gaussian_are_those_of_the_package(tmp_path: Path) -> None:
    image = picture()
    path = blur(tmp_path / "box.onnx", box(5), mirrored=True)
    mean = ndimage.uniform_filter(image.astype(np.float64), 5, mode="mirror")
    assert np.abs(found(path).run(image)[0] - mean).max() < 1e-6  # sums of 25 32-bit numbers
    line = cv2.getGaussianKernel(9, 1.0).astype(np.float32)
    path = blur(tmp_path / "gaussian.onnx", line @ line.T, mirrored=True)
    ours = find_enhancement("gaussian:sigma=1").run(image)[0]
    assert np.abs(found(path).run(image)[0] - ours).max() < 1e-6


def test_grey_comes_back_from_three_channels_as_luminance_and_bgr_is_turned(tmp_path: Path) -> None:
    gains = np.array([0.5, 1.0, 2.0], np.float32)
    path = save(
        tmp_path / "m.onnx", [node("Mul", "x g", "y")], {"g": gains[:, None, None]}, shape=("n", 3, "h", "w")
    )
    image = picture()
    for order, of_channels in (("rgb", gains), ("bgr", gains[::-1])):
        algorithm = found(path, f"order={order}")
        of_grey = image * float(np.array([0.2126, 0.7152, 0.0722]) @ of_channels)
        assert np.allclose(algorithm.run(image)[0], of_grey, atol=1e-6)
        colour = picture(channels=3)
        assert np.allclose(algorithm.run(colour)[0], colour * of_channels, atol=1e-6)


@pytest.mark.parametrize("size", [("h", "w"), (48, 40)])
@pytest.mark.parametrize(("rows", "columns"), [(130, 170), (70, 48)])
def test_tiles_have_no_seams(tmp_path: Path, size, rows: int, columns: int) -> None:
    image = picture(rows, columns)
    whole = found(denoiser(tmp_path / "whole.onnx", layers=3)).run(image)[0]
    # Three convolutions of 3 × 3 look 3 pixels far: a quarter of an overlap of 12.
    path = denoiser(tmp_path / "m.onnx", layers=3, size=size)
    tile = "" if isinstance(size[0], int) else ",tile_px=48"
    for overlap_px in (12, 20):  # half a tile of 40
        tiled = found(path, f"overlap_px={overlap_px}{tile}")
        assert np.abs(tiled.run(image)[0] - whole).max() < 1e-5  # sums of 72 32-bit products, three times
    without = found(path, f"overlap_px=0{tile}")
    assert np.abs(without.run(image)[0] - whole).max() > 1e-2  # the test would see seams


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("pads", "size", "settings"),
    [
        (0, ("h", "w"), ""),  # loses 3 px at each side, as waifu2x loses 7 or 18
        (0, ("h", "w"), "tile_px=40"),
        (0, ("h", "w"), "tile_px=40,border_px=5"),
        (0, (50, 40), ""),
        (0, (40, 40), "border_px=3"),  # a square does not show its loss
        (3, ("h", "w"), "border_px=3"),  # has zeros beyond its borders
        (3, ("h", "w"), "border_px=4,tile_px=40"),
        (3, (40, 40), "border_px=3"),
    ],
)
def test_a_border_is_mirrored(tmp_path: Path, pads: int, size, settings: str) -> None:
    path = finer(tmp_path / "m.onnx", side=7, pads=pads, size=size)
    algorithm = found(path, settings)
    assert algorithm.magnification == 2.0
    assert algorithm.values["border_px"] >= 3
    for image in (picture(101, 70), picture(5, 9)):
        expected = ndimage.uniform_filter(image.astype(float), 7, mode="mirror").repeat(2, 0).repeat(2, 1)
        # 49 sums of 32 bits; tiles see the same pixels as the whole.
        assert np.abs(algorithm.run(image)[0] - expected).max() < 1e-6


@pytest.mark.parametrize(
    ("size", "settings", "message"),
    [
        (("h", "w"), "border_px=2", "border_px: found 2, but the model loses 3 px a side"),
        (("h", "w"), "tile_px=6", "border_px: found 3, expected less than half a tile of 6 px"),
        ((40, 40), "border_px=20", "border_px: found 20, expected less than half a tile of 40 px"),
        ((48, 40), "tile_px=48", "tile_px: found 48, but the model takes pictures of 48 × 40 only"),
        (("h", "w"), "scale=3", "scale: found 3, expected 2 as the model gives"),
    ],
)
def test_borders_tiles_and_scales_that_are_refused(tmp_path: Path, size, settings: str, message: str) -> None:
    path = finer(tmp_path / "m.onnx", side=7, pads=0, size=size)
    with pytest.raises(SettingsError, match=message):
        found(path, settings)


def test_a_border_is_a_whole_number_of_output_pixels(tmp_path: Path) -> None:
    weights = {"empty": np.zeros(0, np.float32), "factors": np.float32([1, 1, 1.5, 1.5])}
    path = save(tmp_path / "m.onnx", [node("Resize", "x empty factors", "y", mode="nearest")], weights)
    with pytest.raises(SettingsError, match=r"border_px: found 1, of which the model's scale of 1\.5 makes 1\.5 "):
        found(path, "multiple_px=2,border_px=1")
    assert found(path, "multiple_px=2,border_px=2").run(picture(60, 80))[0].shape == (90, 120)


def test_the_border_of_a_network_of_one_square_has_to_be_given(tmp_path: Path) -> None:
    algorithm = found(finer(tmp_path / "m.onnx", size=(40, 40), side=7, pads=0))
    assert algorithm.magnification == 68 / 40
    with pytest.raises(DataError, match=r"needs tiles, and they a whole scale, found 1\.7; if .* give border_px"):
        algorithm.run(picture(101, 70))


def test_sides_that_a_network_needs_are_given(tmp_path: Path) -> None:
    path = halving(tmp_path / "m.onnx", 3)
    with pytest.raises(DataError, match=r"fails with a picture of 65 × 66 .* 8, give that as multiple_px"):
        found(path)
    algorithm, image = found(path, "multiple_px=8"), picture(50, 71)
    given = algorithm.run(image)[0]
    padded = np.pad(image, ((0, 6), (0, 1)), mode="reflect")
    largest = padded.reshape(7, 8, 9, 8).max(axis=(1, 3))
    assert np.abs(given - (padded + np.kron(largest, np.ones((8, 8))))[:50, :71]).max() < 1e-6
    with pytest.raises(SettingsError, match="tile_px: found 100, expected a multiple of 8"):
        found(path, "multiple_px=8,tile_px=100")


@pytest.mark.parametrize("location", ["m.onnx.data", "weights/k.bin"])
def test_weights_in_a_file_beside_the_model_are_read(tmp_path: Path, location: str, monkeypatch) -> None:
    folder, image = tmp_path / "models", picture()
    (folder / location).parent.mkdir(parents=True)
    (folder / location).write_bytes(np.arange(9, dtype="<f4").tobytes())
    kernel = np.arange(9.0).reshape(3, 3)
    expected = ndimage.correlate(image.astype(np.float64), kernel, mode="constant")
    (tmp_path / "linked").symlink_to(folder)  # a user's own way to the folder
    with_weights_in(folder / "m.onnx", location)
    monkeypatch.chdir(tmp_path)
    algorithms = [found(path) for path in (folder / "m.onnx", Path("models/m.onnx"), tmp_path / "linked/m.onnx")]
    for file in (folder / location, folder / "m.onnx"):
        file.unlink()  # a copy in another process needs none
    for algorithm in (*algorithms, pickle.loads(pickle.dumps(algorithms[0]))):
        assert np.abs(algorithm.run(image)[0] - expected).max() < 2e-5  # nine products of up to 8, 32 bits


@pytest.mark.parametrize(
    "location",
    [
        *(
            "../secret.bin",
            "/secret.bin",
            "inner/../../secret.bin",
            "link.bin",
            "linked/secret.bin",
            "missing.bin",
        ),
    ],
)
def test_weights_elsewhere_are_not_read(tmp_path: Path, location: str) -> None:
    folder, secret = tmp_path / "models", tmp_path / "secret.bin"
    (folder / "inner").mkdir(parents=True)
    secret.write_bytes(np.ones(9, "<f4").tobytes())
    (folder / "link.bin").symlink_to(secret)
    (folder / "linked").symlink_to(tmp_path)
    path = with_weights_in(folder / "m.onnx", f"{tmp_path}{location}" if location.startswith("/") else location)
    with pytest.raises(
        DataError, match=r"m\.onnx: its weights in other files cannot be read, expected them"
    ) as raised:
        found(path)
    assert str(raised.value).isprintable()


def test_a_network_is_read_from_one_file_by_one_version(tmp_path: Path, monkeypatch) -> None:
    path = with_weights_in(tmp_path / "m.onnx", "k.bin")
    with pytest.raises(DataError, match="keeps values other than weights in another file, expected all in one"):
        network.read_model(path.read_bytes())
    algorithm = found(denoiser(tmp_path / "n.onnx"))
    monkeypatch.setattr(network, "runtime_version", lambda: "0.0.0")
    with pytest.raises((DataError, SettingsError), match=r"ONNX Runtime: found version 0\.0\.0, expected"):
        algorithm.run(picture())


def test_tiles_have_the_size_of_the_models(tmp_path: Path) -> None:
    path = denoiser(tmp_path / "m.onnx", size=(48, 40))
    assert found(path).values["tile_px"] is None  # no square
    for given in ("tile_px=48", ""):
        assert found(denoiser(path, size=(48, 48)), given).values["tile_px"] == 48
    assert found(denoiser(path, size=(48, "w"))).values["tile_px"] == 1024  # of the side that is free


def test_settings_lie_beside_the_model_and_the_command_overrides_them(tmp_path: Path) -> None:
    path = identity(tmp_path / "same.onnx")
    (tmp_path / "same.toml").write_text("white = 255\noverlap_px = 8\nchannels = 1\n", encoding="utf-8")
    values = find_enhancement(f"onnx:{path}:overlap_px=16").values
    assert (values["white"], values["overlap_px"], values["black"]) == (255.0, 16, 0.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wite = 255", r"same\.toml: unknown key 'wite'; the nearest valid one is 'white'"),
        ("white = '255'", r"same\.toml: white: found '255', expected .*; write 255 without"),
        ("white = 0", "black and white: found 0 for both, expected two values"),
        ("overlap_px = 600", "overlap_px: found 600, expected at most half a tile, 512"),
        ("white", "same.toml: not valid TOML"),
    ],
)
def test_settings_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = identity(tmp_path / "same.onnx")
    (tmp_path / "same.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=message):
        found(path)


def test_a_number_of_channels_that_is_not_the_models(tmp_path: Path) -> None:
    path = blur(tmp_path / "m.onnx", box(), channels=3)
    with pytest.raises(SettingsError, match="channels: found 1, expected 3 as the model says"):
        find_enhancement(f"onnx:{path}:channels=1")
    weights = {"k": of_each_channel(box(), 3)}
    free = save(tmp_path / "free.onnx", [convolution("x", "k", "y", 3)], weights, shape=("n", "c", "h", "w"))
    with pytest.raises(SettingsError, match="channels: the model does not say how many it takes"):
        find_enhancement(f"onnx:{free}")
    assert find_enhancement(f"onnx:{free}:channels=3").run(picture())[0].shape == (70, 90)


def test_results_in_the_store_are_those_of_the_bytes_of_the_model(tmp_path: Path) -> None:
    first = found(blur(tmp_path / "m.onnx", box()))
    again = found(tmp_path / "m.onnx")
    other = found(blur(tmp_path / "m.onnx", 1.001 * box()))
    (tmp_path / "m.toml").write_text("black = 0.1\n")
    beside = found(tmp_path / "m.onnx")
    keys = [fingerprint(parts_of([one])) for one in (first, again, other, beside)]
    assert keys[0] == keys[1]
    assert len(set(keys[1:])) == 3


FLOAT, HALF, INT64 = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.INT64
CONSTANT = {
    "map": (FLOAT, ANY),
    "pixel": (FLOAT, (1, 1, 1, 1)),
    "vector": (FLOAT, ("n",)),
    "number": (FLOAT, ()),
    "half": (HALF, ("n", 1)),
    "step": (INT64, (1,)),
}


@pytest.mark.parametrize("name", CONSTANT)
def test_an_input_that_is_no_picture_has_one_value(tmp_path: Path, name: str) -> None:
    path = less_noise(tmp_path / "m.onnx", *CONSTANT[name])
    image = picture(130, 170)
    algorithm = find_enhancement(f"onnx:{path}:white=255,tile_px=48,inputs.s=51")
    # 255 x − 51/2, in shares of 255; 1e-6 for 32 bits, and tiles that are faded.
    assert np.abs(algorithm.run(image)[0] - (image - 0.1)).max() < 1e-6


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
def test_a_constant_channel_lies_behind_those_of_the_picture(tmp_path: Path, layout: str) -> None:
    grey = weighted(tmp_path / "grey.onnx", [[1.0, -0.5]], layout=layout)
    image = picture()
    found = find_enhancement(f"onnx:{grey}:constant_channel=0.2").run(image)[0]
    assert np.abs(found - (image - 0.1)).max() < 1e-6
    shares = np.float32([0.1, 0.2, 0.3])
    colour = weighted(tmp_path / "colour.onnx", np.hstack([np.eye(3), -shares[:, None]]), layout=layout)
    image = picture(channels=3)
    for order, expected in (("rgb", shares), ("bgr", shares[::-1])):
        spec = f"onnx:{colour}:constant_channel=0.5,order={order}"
        assert np.abs(find_enhancement(spec).run(image)[0] - (image - 0.5 * expected)).max() < 1e-6


def test_values_of_inputs_are_a_table_beside_the_model_and_names_with_a_dot_in_the_command(tmp_path: Path) -> None:
    path = tmp_path / "m.onnx"
    others = dict.fromkeys(("s", "t"), (FLOAT, ()))
    save(path, [node("Sub", "x s", "z"), node("Sub", "z t", "y")], others=others)
    path.with_suffix(".toml").write_text("[inputs]\ns = 0.25\nt = 1\n", encoding="utf-8")
    image = picture()
    for more, level in (("", 1.25), (":inputs.s=0.5", 1.5), (":inputs.s=0.5,inputs.t=0", 0.5)):
        algorithm = find_enhancement(f"onnx:{path}{more}")
        assert np.abs(algorithm.run(image)[0] - (image - level)).max() < 1e-6
    assert plain_value(algorithm.values["inputs"]) == {"s": 0.5, "t": 0.0}
    assert np.array_equal(pickle.loads(pickle.dumps(algorithm)).run(image)[0], algorithm.run(image)[0])


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("map", "", r"the model takes x, s; expected a value for each but the picture: inputs\.s=VALUE"),
        ("map", "[inputs]\nt = 1", "the model takes x, s: unknown key 't'"),
        ("map", "[inputs]\nx = 1\ns = 1", "the model takes x, s; expected one without a value: a picture"),
        ("map", "[inputs]\ns = nan", r"m\.toml: inputs.s: found nan, expected a number from -1e\+09 to 1e\+09"),
        ("map", "constant_channel = 1\n[inputs]\ns = 1", "takes 1 channels, expected 2 or 4 with constant"),
        ("half", "[inputs]\ns = 1e6", r"inputs: s: found 1e\+06, expected a number that float16 can hold"),
        ("step", "[inputs]\ns = 0.5", "inputs: s: found 0.5, expected a number that int64 can hold"),
        ("bytes", "[inputs]\ns = 1", "s takes values of tensor\\(uint8\\), expected numbers"),
    ],
)
def test_values_of_inputs_that_are_refused(tmp_path: Path, kind: str, text: str, message: str) -> None:
    further = {"bytes": (TensorProto.UINT8, ())}
    path = less_noise(tmp_path / "m.onnx", *(CONSTANT | further)[kind])
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    with pytest.raises((DataError, SettingsError), match=message):
        find_enhancement(f"onnx:{path}")


UNREADABLE = "ONNX Runtime cannot read it"
CONV, SAME = [convolution("x", "k", "y", 3)], [node("Identity", "x", "y")]
BAD_FILES = {"text": b"not a network\n" * 20, "empty": b""}
BAD_NETWORKS = {
    "two_outputs": (
        {"nodes": [*SAME, node("Relu", "x", "z")], "outputs": ("y", "z")}, "has 2 outputs, expected one"
    ),
    "no_input": ({"nodes": SAME, "weights": {"x": np.zeros((1, 1, 8, 8), np.float32)}}, "the model takes none"),
    "four_channels": ({"nodes": SAME, "shape": ("n", 4, "h", "w")}, "takes 4 channels, expected 1 or 3; if the"),
    "bytes": (
        {"nodes": SAME, "kind": TensorProto.UINT8}, r"takes values of tensor\(uint8\), expected 32-bit numbers"
    ),
    "vector": (
        {"nodes": [node("GlobalAveragePool", "x", "m"), node("Flatten", "m", "y")]},
        "gives shape .*, expected one picture of 1 or 3 channels",
    ),
    "crops": (
        {"nodes": [convolution("x", "k", "y", 2, pads=0)], "weights": {"k": of_each_channel(box(2), 1)}},
        "expected the same proportions",
    ),
    "unknown": ({"nodes": [node("Nonsense", "x", "y")]}, UNREADABLE),
    "huge": (
        {"nodes": SAME, "shape": (1, 1, 2**20, 2**20)},
        "takes pictures of 1048576 × 1048576, expected sides of at most 4096",
    ),
    "cube": (
        {"nodes": SAME, "shape": ("n", 1, "d", "h", "w")},
        "takes pictures of shape any × 1 × any × any × any, expected .* 4 sides",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", [*BAD_FILES, "truncated", *BAD_NETWORKS])
def test_a_file_that_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.onnx"
    if name in BAD_NETWORKS:
        settings, message = BAD_NETWORKS[name]
        save(path, **settings)
    else:
        message = UNREADABLE
        path.write_bytes(BAD_FILES[name] if name in BAD_FILES else denoiser(path).read_bytes()[:300])
    with pytest.raises((DataError, SettingsError), match=message) as raised:
        found(path)
    assert "\n" not in str(raised.value)
    assert path.name in str(raised.value)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("onnx:", "expected onnx:FILE"),
        ("onnx::white=2", "no such file"),
        ("onnx:m.onnx:", "found nothing behind m.onnx:, expected parameter=value"),
        ("onnx:m.onnx:white", "found white behind m.onnx:, expected parameter=value"),
        ("onnx:other.onnx:", "other.onnx:: no such file"),
    ],
)
def test_a_network_without_a_file(spec: str, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    identity(tmp_path / "m.onnx")
    with pytest.raises((DataError, SettingsError), match=message):
        find_enhancement(spec)


@pytest.mark.parametrize("package", ["onnxruntime", "onnx"])
def test_a_package_that_is_missing_is_one_line(tmp_path: Path, package: str, monkeypatch) -> None:
    path = with_weights_in(tmp_path / "m.onnx", "m.onnx.data")
    monkeypatch.setitem(sys.modules, package, None)
    message = rf'need the package {package}, which is not installed; run: pip install "todframes\[onnx\]"$'
    with pytest.raises(SettingsError, match=message):
        found(path)


def test_the_table_of_settings_in_the_docs_has_all() -> None:
    text = (Path(__file__).parents[2] / "docs/how_to/networks.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?`) \|", text, re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    parameters = list(inspect.signature(network.Network.enhanced).parameters)
    assert names == parameters[2:]
