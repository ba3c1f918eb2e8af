"""Algorithms: how they are named, what is refused, and one contract for all that are registered."""

from __future__ import annotations

import math
import pickle
import sys
from typing import Annotated

import numpy as np
import pytest
from scipy import ndimage

from todframes.base.errors import DataError, SettingsError
from todframes.enhancement.algorithm import Declaration, algorithm, meaning, parameter
from todframes.enhancement.finding import enhancement_names, find_enhancement

NAMES = [name for name in enhancement_names() if not find_enhancement(name).declaration.clip]
BUILT_IN = [
    *("none", "clahe", "unsharp", "gaussian", "median", "bilateral", "nlm", "tv", "wiener", "richardson_lucy"),
    *("guided", "gamma", "equalize", "bicubic", "lanczos"),
]


def picture(rows: int = 40, columns: int = 48, seed: int = 0) -> np.ndarray:
    """A step and noise within 0.2 and 0.8, float32."""
    image = np.random.default_rng(seed).uniform(0.2, 0.4, (rows, columns)).astype(np.float32)
    image[rows // 4 : rows // 2, columns // 3 :] += 0.4
    return image


def run(spec: str, image: np.ndarray) -> np.ndarray:
    return find_enhancement(spec).run(image)[0]


@pytest.mark.parametrize("name", [*sorted({*NAMES, *BUILT_IN}), "gaussian:sigma=2.5"])
def test_contract(name: str) -> None:
    """The image stays, nothing is drawn or remembered, a copy is the same, and a colour image is three images."""
    algorithm, image = find_enhancement(name), picture()
    before = image.copy()
    found, cpu_s = algorithm.run(image)
    assert found.shape == tuple(round(algorithm.magnification * side) for side in image.shape)
    assert found.dtype.kind == "f"
    assert np.isfinite(found).all()
    assert np.array_equal(image, before)
    assert cpu_s >= 0.0
    assert np.array_equal(algorithm.run(image)[0], found)
    assert pickle.loads(pickle.dumps(algorithm)) == algorithm  # as for the workers of a cluster
    channels = [picture(seed=seed) for seed in range(3)]
    colour, _ = algorithm.run(np.stack(channels, axis=-1))
    for k, channel in enumerate(channels):
        assert np.array_equal(colour[..., k], algorithm.run(channel)[0])


# As their libraries have them, TV takes differences forwards only, the fast non-local means compares patches of an
# even side, and CLAHE's tiles have their middles half a pixel off: they see a turned image not quite alike.
@pytest.mark.parametrize("name", [name for name in BUILT_IN if name not in ("tv", "nlm", "clahe")])
def test_no_direction_is_preferred(name: str) -> None:
    """Or an algorithm would help one orientation of the triangle against the others."""
    image = picture(48, 48)
    turned = run(name, np.ascontiguousarray(np.rot90(image)))
    # Sums of some thousand 32-bit numbers below 1, in another order.
    assert np.allclose(np.rot90(turned, -1), run(name, image), rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("name", [name for name in BUILT_IN if name not in ("clahe", "equalize", "gamma")])
def test_uniform_stays_as_it_is(name: str) -> None:
    """What a filter does to a uniform field is what it does to the background."""
    # As above; deconvolution feels the border by 1e-6.
    assert np.allclose(run(name, np.full((30, 36), 0.4, np.float32)), 0.4, rtol=0.0, atol=2e-5)


def test_gaussian_is_scipys() -> None:
    image = picture()
    expected = ndimage.gaussian_filter(image, 1.5, mode="mirror", radius=6)
    # Both cut at 4 standard deviations; OpenCV's table of weights has 32 bits.
    assert np.allclose(run("gaussian:sigma=1.5", image), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_median_is_that_of_the_window(radius: int) -> None:
    image, side = picture(), 2 * radius + 1
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    inner = run(f"median:radius={radius}", image)[radius:-radius, radius:-radius]
    assert np.array_equal(inner, np.median(windows, axis=(2, 3)))


def test_unsharp_adds_what_a_blur_takes_away() -> None:
    image = picture().astype(np.float64)
    blurred = ndimage.gaussian_filter(image, 2.0, mode="reflect")
    found = run("unsharp:radius=2,amount=1.5", image.astype(np.float32))
    assert np.allclose(found, image + 1.5 * (image - blurred), rtol=0.0, atol=1e-5)


def test_equalize_makes_all_values_as_frequent() -> None:
    found = np.sort(run("equalize:bins=4096", picture()), axis=None)
    # Bins of 1/4096 of the range hold one value or two of 1920.
    assert np.allclose(found, np.arange(1, found.size + 1) / found.size, rtol=0.0, atol=5 / found.size)


def test_gamma_is_a_power() -> None:
    image = picture()
    assert np.allclose(run("gamma:gamma=2", image), image.astype(np.float64) ** 2, rtol=0.0, atol=1e-7)


def test_clahe_without_limits_is_the_histogram_of_its_tile() -> None:
    """One tile and no limit: every code value's rank among all."""
    image = np.rint(255 * picture(64, 64)) / 255
    found = run("clahe:tiles=1,clip_limit=0", image.astype(np.float32))
    rank = np.searchsorted(np.sort(image, axis=None), image, side="right") / image.size
    assert np.allclose(found, rank, rtol=0.0, atol=0.51 / 255)


@pytest.mark.parametrize("name", ["bicubic", "lanczos"])
def test_interpolation_goes_on_with_a_ramp_where_its_pixels_are(name: str) -> None:
    """Pixel j of the finer image lies at (j + ½)/3 − ½ of the coarser one."""
    ramp = np.tile(np.linspace(0.2, 0.8, 31, dtype=np.float32), (20, 1))
    found = run(f"{name}:factor=3", ramp)
    expected = 0.2 + 0.02 * ((np.arange(93) + 0.5) / 3 - 0.5)
    inner = slice(15, -15)  # beyond the kernel's reach of the border
    # Keys' kernel with a = −0.75 is off a straight line by t(1 − t)(1 − 2t)/2, at most 0.049 steps between pixels,
    # Lanczos' by less. A grid half a pixel off would be 0.33 steps off.
    assert np.allclose(found[10, inner], expected[inner], rtol=0.0, atol=0.05 * 0.02)


@pytest.mark.parametrize(
    ("spec", "value", "message"),
    [
        ("clahe", 1.2, r"clahe: ValueError: code values run from 1.2 to 1.2 of white"),
        ("gamma", -0.1, r"gamma: ValueError: code values start at -0.1 of white"),
        ("richardson_lucy", -0.1, r"start at -0.1 of white, expected 0 or more"),
    ],
)
def test_values_that_an_algorithm_cannot_take(spec: str, value: float, message: str) -> None:
    with pytest.raises(DataError, match=message):
        run(spec, np.full((9, 9), value, np.float32))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("unsharpen", r"enhance 'unsharpen': .*unknown key 'unsharpen'; the nearest valid one is 'unsharp'"),
        ("unsharp:radus=2", r"enhance 'unsharp:radus=2': unknown key 'radus'; the nearest valid one is 'radius'"),
        ("unsharp:radius=wide", r"radius: found 'wide', expected a number from 0.1 to 50"),
        ("median:radius=1.5", r"radius: found 1.5, expected a whole number from 1 to 20"),
        ("clahe:bits=12", r"bits: found 12"),
        ("unsharp:radius=2,radius=3", r"found radius twice, expected it once"),
        ("unsharp:radius=", r"found 'radius=', expected parameter=value"),
        ("unsharp:radius=1\nb=2", r"found 'radius=1\\nb=2', expected parameter=value"),
        ("own_algorithms:stretchd", "unknown key 'stretchd'; the nearest valid one is 'stretched'"),
        ("own_algorithms:needs", r"parameter 'level' is missing"),
        ("own_algorithms:stretched:gain=much", r"gain: found 'much', expected a finite number"),
        ("own_algorithms:number", r"found int, expected a function of an image"),
        ("own_algorithms:nothing", r"takes no image; expected function\(image, \*\*parameters\)"),
        ("builtins:min", "its parameters cannot be read; expected a function written in Python"),
        ("no_such_module:f", r"module 'no_such_module' cannot be imported \(ModuleNotFoundError"),
    ],
)
@pytest.mark.usefixtures("own")
def test_bad_specs(spec: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        find_enhancement(spec)


def test_parameters_have_their_defaults_and_what_is_assigned() -> None:
    algorithm = find_enhancement("unsharp:amount=2.5")
    assert (algorithm.name, algorithm.spec, algorithm.what) == ("unsharp", "unsharp:amount=2.5", "Unsharp mask.")
    assert algorithm.values == {"radius": 2.0, "amount": 2.5}
    radius = algorithm.parameters[0]
    assert (radius.name, radius.default, radius.meta.ge, radius.meta.extra) == ("radius", 2.0, 0.1, {"unit": "px"})
    assert find_enhancement("clahe").parameters[2].choices == (8, 16)


OWN = """
import numpy as np

def stretched(image, gain=2, *, middle: float = 0.5, note="x", **more):
    \"\"\"Contrast about the middle.

    In a second paragraph.
    \"\"\"
    return middle + gain * (image - middle) + sum(more.values())

def needs(image, level):
    return image + level

def spoils(image):
    image[:] = 0.25
    return image

def fails(image):
    raise KeyError("no such\\nthing")

def leaves(image):
    raise SystemExit

class Sharper:
    def __call__(self, image, *, by: "float" = 1.0):
        return by * image

object_that_can_be_called = Sharper()
number = 3

def nothing():
    return 0.0

def of(value):
    def function(image):
        return value(image)
    function.__name__ = "of"
    return function

as_list = of(lambda image: image.tolist())
as_codes = of(lambda image: (255 * image).astype(np.uint8))
smaller = of(lambda image: image[1:])
undefined = of(lambda image: np.where(image > image.min(), image, np.nan))
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_algorithms.py").write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("own_algorithms", None)


@pytest.mark.usefixtures("own")
def test_own_functions() -> None:
    image = picture()
    algorithm = find_enhancement("own_algorithms:stretched")
    assert (algorithm.name, algorithm.what) == ("own_algorithms:stretched", "Contrast about the middle.")
    assert algorithm.declaration == Declaration()
    assert algorithm.values == {"gain": 2, "middle": 0.5, "note": "x"}
    assert np.allclose(algorithm.run(image)[0], 2 * image - 0.5, rtol=0.0, atol=1e-6)
    # Any number for one whose default is a whole one; other names where the function takes any.
    more = find_enhancement("own_algorithms:stretched:gain=0.5,offset=0.1")
    assert np.allclose(more.run(image)[0], 0.5 * image + 0.35, rtol=0.0, atol=1e-6)
    assert find_enhancement("own_algorithms:needs:level=0.25").run(image)[0] == pytest.approx(image + 0.25)
    assert np.array_equal(find_enhancement("own_algorithms:object_that_can_be_called").run(image)[0], image)
    before = image.copy()
    assert (run("own_algorithms:spoils", image) == 0.25).all()
    assert np.array_equal(image, before)  # a function may write into its image


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fails", r"own_algorithms:fails: KeyError: 'no such\\nthing'"),
        ("leaves", r"own_algorithms:leaves: called sys.exit, expected it to return"),
        ("as_list", r"own_algorithms:as_list: gave list, expected an array of floating-point numbers"),
        ("as_codes", r"gave values of uint8, expected an array of floating-point numbers"),
        ("smaller", r"gave shape \(39, 48\) for \(40, 48\), expected \(40, 48\) with the declared magnification"),
        ("undefined", r"gave 1 values that are NaN or infinite, the first at row"),
    ],
)
def test_own_functions_that_give_something_else(name: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        run(f"own_algorithms:{name}", picture())


@algorithm(domain="luminance", magnification="factor")
def finer(
    image,
    *,
    factor: Annotated[int, parameter(1, 4, what="how much")] = 2,
    way: Annotated[str, meaning("no")] = "a",
):
    """Each pixel several times."""
    del way
    return np.kron(image, np.ones((factor, factor), image.dtype))


def register(monkeypatch, **functions) -> None:
    """Entry points of another package."""

    class Entry:
        group = "todframes.enhancements"

        def __init__(self, name, load):
            self.name, self.value, self.load = name, f"another_package:{name}", load

    entries = [Entry(name, load) for name, load in functions.items()]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: entries)


def test_a_registered_function_with_a_declaration(monkeypatch) -> None:
    register(monkeypatch, finer=lambda: finer)
    found = find_enhancement("finer:factor=3")
    assert enhancement_names() == ["finer"]
    assert (found.declaration.domain, found.magnification) == ("luminance", 3.0)
    assert found.run(picture())[0].shape == (120, 144)
    with pytest.raises(SettingsError, match=r"factor: found 9, expected a whole number from 1 to 4"):
        find_enhancement("finer:factor=9")
    register(monkeypatch, odd=lambda: algorithm(magnification="scale")(lambda image: image))
    with pytest.raises(SettingsError, match="magnification 'scale': found None, expected a finite number > 0"):
        find_enhancement("odd")


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        *(({"magnification": one}, r"magnification: found .*, expected a finite number > 0")
          for one in (0.0, -1.0, math.nan, math.inf)),
        ({"domain": "contrast"}, "domain: found 'contrast', expected one of code_value, luminance"),
        ({"clip": True, "warm_up_frames": -1}, "warm_up_frames: found -1, expected a whole number"),
        ({"clip": True, "warm_up_frames": 2.5}, "warm_up_frames: found 2.5, expected a whole number"),
        ({"warm_up_frames": 1}, "warm_up_frames: found 1 without clip"),
    ],
)  # fmt: skip
def test_bad_declarations(declared: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        algorithm(**declared)
