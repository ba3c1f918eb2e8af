"""Algorithms through the observer's eyes: what must not change does not, and physics holds."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from msgspec import structs
from skimage.metrics import peak_signal_noise_ratio

import todframes as tod
from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.comparison.compare import _record
from todframes.comparison.ratios import compare_measured
from todframes.comparison.records import (
    ComparedCondition,
    Comparison,
    ContrastResponse,
    JudgedBy,
    Ratio,
    comparisons,
    frame_warnings,
    not_proportional,
)
from todframes.comparison.seen import Seen
from todframes.enhancement import builtin
from todframes.enhancement.algorithm import Enhancement
from todframes.enhancement.contrast_gain import (
    MEASURED_TRIALS,
    ContrastPoint,
    contrasts_on_scenes,
    measured_trials,
    views_to_measure,
)
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, DecodedFrame
from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.scored_algorithms import parts_of, score_algorithms
from todframes.frames.contrast import frame_problems
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, read_frame, write_frame
from todframes.frames.trials import FrameReference, SceneView, Trial, Trials
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run, open_engine
from todframes.observers.csf import CsfObserver
from todframes.observers.interface import Observer
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import Fit
from todframes.results.wording import interval_phrase
from todframes.scoring.opening import Opened
from todframes.scoring.score import ScoredDataset, fitted_curve, score_dataset
from todframes.stimulus import ORIENTATIONS, Stimulus

FAST = FitSettings(resamples=40)
OBSERVER = PyramidObserver()
STEADY = PyramidObserver(PyramidSettings(position_jitter_samples=0.0))
SCORED = ("scores", "probabilities", "p_correct", "answers", "displacement_samples")

OWN = """
import cv2
import numpy as np
from todframes.enhancement.algorithm import algorithm

def same(image):
    return image

def again(image):
    return 1.0 * image

def gain(image, by=2.0, middle=0.5):
    return (middle + by * (image.astype(np.float64) - middle))

def root(image):
    contrast = np.maximum(2.0 * image.astype(np.float64) - 1.0, 0.0)
    return 0.5 * (1.0 + 0.3 * np.sqrt(contrast))

def brighter(image, by=1.25):
    return by * image

@algorithm(magnification="factor")
def pixels_divided(image, *, factor: int = 3):
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)

@algorithm(magnification=0.5)
def pixels_joined(image):
    return image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2).mean(axis=(1, 3))

@algorithm(domain="luminance")
def light(image):
    assert image.ndim == 2
    return image

@algorithm(domain="luminance")
def half_light(image, by=0.5):
    return by * image

def box(image, beyond="mirrored", ring=None):
    kind = cv2.BORDER_CONSTANT if beyond == "black" else cv2.BORDER_REFLECT_101
    found = cv2.blur(image, (3, 3), borderType=kind)
    if ring is not None:
        found[[0, -1]] = found[:, [0, -1]] = ring
    return found

seen, drawn = [], np.random.default_rng()

def special_at_first(image):
    seen.append(1)
    return image + 0.05 * (len(seen) > 1)

def remembering(image):
    seen.append(0.5 * (image + seen[-1]) if seen else image)
    return seen[-1]

def drawing(image):
    return image + drawn.uniform(-0.05, 0.05, image.shape)

def changing(image):
    seen.append(1)
    return image * (0.9 if len(seen) > 10 else 1.0)

def not_when_large(image):
    if image.max() > 0.65:
        raise ValueError("too large")
    return image

def shape_of(image):
    assert image.ndim == 3
    return image
"""


@pytest.fixture
def kept(tmp_path):
    """A folder with an empty store, so that results are kept from the first on."""
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "results.store").touch()
    return tmp_path / "kept"


@pytest.fixture(autouse=True)
def own(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("own")
    (folder / "own_enhancements.py").write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    yield
    sys.modules.pop("own_enhancements", None)


def compare(path, *specs: str, observer=OBSERVER, white: float = 1.0, **arguments):
    dataset = load_dataset(path)
    screen = AlgorithmDisplay(dataset.display, white, arguments.pop("allow_clipping", False))
    algorithms = [find_enhancement(spec) for spec in specs]
    settings = {"fit_settings": FAST, "screen": screen} | arguments
    settings["curve"] = fitted_curve(settings.get("curve"), settings.get("decisions", "expected"))
    (results,) = score_algorithms(dataset, [observer], algorithms, **settings)
    return judged(dataset, observer, screen, results)


class Judged(NamedTuple):
    """An algorithm, its scores and its record."""

    enhancement: Enhancement
    scored: ScoredDataset
    record: ComparedCondition


def judged(dataset, observer, screen, results) -> list[Judged]:
    looks = Opened(dataset, [observer], [{}], None, {}, lambda _: ())
    measured = Seen("", looks, screen, [{}], [results]).measured(0, FAST)
    compared = [None, *compare_measured(measured, seed=1, weighted=False)]
    records = map(_record, measured, compared)
    return [
        Judged(result.enhancement, result.scored, record) for result, record in zip(results, records, strict=True)
    ]


def lit(make_dataset, background, contrasts=(0.1, 0.4)):
    """A dataset with a background, which a column gives, too."""
    display = {"background_luminance_cd_m2": background}
    changes = {number: {"background_luminance_cd_m2": "50"} for number in range(4 * len(contrasts))}
    return make_dataset(suffix=".png", contrasts=contrasts, display=display, row_changes=changes).path


def same_scores(one, other) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in SCORED)


# The reference is what `score` gives, and an algorithm that does nothing gives the same


@pytest.mark.parametrize(
    ("background", "more"),
    [
        (50.0, {"plan": "full"}),
        ("surround", {"decisions": "sampled", "seed": 3}),
        ("border", {"plan": "needed"}),
        ("frame_mean", {"plan": "full"}),
    ],
)
def test_reference_and_identity_are_what_score_gives(make_dataset, background, more) -> None:
    path = lit(make_dataset, background, (0.04, 0.1, 0.3))
    scored = score_dataset(load_dataset(path), OBSERVER, fit_settings=FAST, **more)
    for result in compare(path, "own_enhancements:same", "own_enhancements:light", "none", **more):
        # Luminance goes through 32 bits.
        if result.enhancement.name == "own_enhancements:light":
            assert np.allclose(result.scored.scores, scored.scores, rtol=0.0, atol=1e-4)
            continue
        assert same_scores(result.scored, scored)
        assert [one.fit for one in result.scored.fits] == [one.fit for one in scored.fits]
        compared = [(one.ratio, one.verdict) for one in result.record.ratios]
        assert compared == ([] if result.enhancement.is_reference else [(1.0, "no difference shown")])


def test_colour_windows_and_trials_of_several_frames(make_dataset) -> None:
    """EXR in colour, code values up to 200, frames averaged: the reference is still what `score` gives."""
    made = make_dataset(contrasts=(0.1, 0.2, 0.4), repeats=2)
    for number, row in enumerate(made.rows):
        luminance = read_frame(made.frame(number)).values
        write_frame(made.frame(number), luminance * [1.2, 1.0, 0.7])
        row["trial"] = f"t{number // 2}"
    made.save()
    scored = score_dataset(load_dataset(made.path), OBSERVER, fit_settings=FAST)
    reference, colour = compare(made.path, "own_enhancements:shape_of", white=200.0)
    assert len(scored.trials) == 12
    assert same_scores(reference.scored, scored)
    # Divided by white and multiplied again in 32 bits: 2⁻²³ of the light, and of some hundred weights of 0.1.
    assert np.allclose(colour.scored.scores, scored.scores, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("background", [50.0, "border"])
@pytest.mark.parametrize("factor", [3, 2])
def test_the_same_light_on_finer_pixels_is_seen_the_same(make_dataset, background, factor: int) -> None:
    """Pixels are uniform squares: cut in pieces they shine as before. Triangles lie off the middle here."""
    made = make_dataset(suffix=".png", contrasts=(0.1, 0.4), display={"background_luminance_cd_m2": background})
    for row in made.rows:
        row |= {"x_px": "21.3", "y_px": "26.9"}
    made.save()
    reference, finer = compare(made.path, f"own_enhancements:pixels_divided:factor={factor}")
    assert np.allclose(finer.scored.scores, reference.scored.scores, rtol=0.0, atol=1e-10)
    assert finer.enhancement.magnification == factor


def test_joining_pixels_is_seeing_a_coarser_display(make_dataset) -> None:
    """As many frames with pixels of twice the size, made beforehand."""
    fine = make_dataset("fine", suffix=".png", contrasts=(0.1, 0.4))
    coarse = make_dataset("coarse", suffix=".png", contrasts=(0.1, 0.4), display={"pixel_pitch_mrad": 0.5})
    for number in range(len(fine.rows)):
        values = read_frame(fine.frame(number)).values[..., 0]
        write_frame(coarse.frame(number), values.reshape(24, 2, 24, 2).mean(axis=(1, 3)))
    joined = compare(fine.path, "own_enhancements:pixels_joined")[1].scored
    expected = compare(coarse.path, "none")[0].scored
    # The coarse frames are rounded to 2⁻¹⁶, 3e-5 of the background.
    assert np.allclose(joined.scores, expected.scores, rtol=0.0, atol=2e-4)


def test_gain_is_as_good_as_less_internal_noise(make_dataset) -> None:
    """Contrast twice as high and twice the internal noise: the same answers, trial by trial."""
    made = make_dataset(suffix=".png", contrasts=(0.03, 0.06, 0.1))
    twice = compare(made.path, "own_enhancements:gain:by=2")[1].scored
    keen = PyramidObserver(PyramidSettings(internal_noise=0.25))
    quiet = score_dataset(load_dataset(made.path), keen, fit_settings=FAST)
    # Code values are 32-bit numbers, rounded by 3e-8 of 0.5.
    assert np.allclose(twice.p_correct, quiet.p_correct, rtol=0.0, atol=1e-5)


@pytest.mark.slow
def test_gain_of_noise_limited_frames_does_nothing(make_dataset) -> None:
    """A linear, invertible change: signal and noise are what they were to each other, so is the threshold."""
    made = make_dataset(contrasts=(0.15, 0.3, 0.6, 1.2), repeats=12)
    rng = np.random.default_rng(7)
    for number in range(len(made.rows)):  # with noise far above the observer's
        luminance = read_frame(made.frame(number)).values[..., 0]
        write_frame(made.frame(number), luminance + 50.0 * rng.normal(0.0, 0.4, luminance.shape))
    quiet = PyramidObserver(PyramidSettings(internal_noise=1e-3))
    (one,) = compare(made.path, "own_enhancements:gain:by=1.5", observer=quiet, white=100.0)[1].record.ratios
    assert one.verdict == "no difference shown"
    assert one.ratio == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("background", [50.0, "surround", "border", "frame_mean", "column"])
def test_what_brightens_everything_alike_changes_nothing(make_dataset, background) -> None:
    """Contrast refers to the background that the algorithm makes: a given one is scaled as the border is."""
    specs = ("own_enhancements:brighter:by=1.25", "own_enhancements:half_light:by=0.5")
    reference, *others = compare(lit(make_dataset, background), *specs)
    for other in others:  # 32-bit code values: rounding of 6e-8 of each
        assert np.allclose(other.scored.scores, reference.scored.scores, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("background", [50.0, "border", "column"])
def test_the_edge_of_a_frame_does_not_set_its_contrast(make_dataset, background) -> None:
    """A box filter leaves an even field as it is, whatever it takes the pixels beyond the frame as."""
    specs = [f"own_enhancements:box{kind}" for kind in ("", ":beyond='black'", ":ring=1.0")]
    results = compare(lit(make_dataset, background), *specs)
    none, mirrored, *others = found = [one.record for one in results]
    expected = pytest.approx(none.fits[0].background_luminance_cd_m2, 1e-6)
    assert [one.fits[0].background_luminance_cd_m2 for one in found] == [expected] * 4  # 32-bit code values
    for one in others:  # the ring is the same for the templates of all orientations
        assert one.ratios[0].ratio == pytest.approx(mirrored.ratios[0].ratio, rel=1e-3)
    # Of 188 pixels of the ring, 184 keep two thirds of their light, and four corners four ninths; white is 2 · 50.
    expected = [1.0, 1.0, (184 * 2 / 3 + 4 * 4 / 9) / 188, 2.0]
    assert [one.edge_factor for one in found] == pytest.approx(expected, rel=1e-4)  # 16 bits


def test_only_the_luminance_around_the_triangle_counts(make_dataset) -> None:
    """A black border has no light to compare, and needs none; a black field does."""
    made = make_dataset(contrasts=(0.2, 0.4), suffix=".png")
    values = read_frame(made.frame(0)).values[..., 0]
    values[[0, -1]] = values[:, [0, -1]] = 0.0
    write_frame(made.frame(0), values)
    assert compare(made.path, "gaussian")[1].record.edge_factor == pytest.approx(1.0, rel=1e-4)  # 16 bits
    values[:] = 0.0
    write_frame(made.frame(0), values)
    with pytest.raises(FrameError, match=r"up_0.png: background luminance is 0 cd/m², expected > 0"):
        compare(made.path, "gaussian")


def test_luminance_is_between_black_and_white(make_dataset) -> None:
    display = {"eotf": "srgb", "white_luminance_cd_m2": 120.0, "black_luminance_cd_m2": 0.5}
    made = make_dataset(suffix=".png", contrasts=(0.2,), display=display)
    screen = AlgorithmDisplay(load_dataset(made.path).display)
    with FrameFile(made.frame(0)) as file:
        decoded = DecodedFrame(file, screen)
    assert screen.luminance_range == (0.5, 120.0)
    expected = (decoded.original.luminance() - 0.5) / 119.5
    assert np.allclose(decoded.relative_luminance, expected, rtol=0.0, atol=1e-7)
    half = decoded.after(find_enhancement("own_enhancements:half_light"))
    assert np.allclose(half.luminance(), 0.5 + 119.5 * 0.5 * expected, rtol=1e-6, atol=0.0)


def test_a_measured_display_has_the_range_of_its_table(make_dataset) -> None:
    made = make_dataset(suffix=".png", contrasts=(0.2,))
    (made.path / "lut.csv").write_text("code_value,luminance_cd_m2\n0.1,2\n0.5,30\n0.9,90\n", encoding="utf-8")
    made.toml["display"] |= {"eotf": "lut", "lut": "lut.csv", "background_luminance_cd_m2": "border"}
    made.save()
    screen = AlgorithmDisplay(load_dataset(made.path).display)
    assert (screen.code_range, screen.luminance_range) == (pytest.approx((0.1, 0.9)), (2.0, 90.0))
    results = compare(made.path, "own_enhancements:gain:by=1.5", "own_enhancements:light")
    assert np.allclose(results[2].scored.scores, results[0].scored.scores, rtol=0.0, atol=1e-4)  # of 32 bits
    with pytest.raises(FrameError, match=r"values lie beyond 0.1 to 0.9"):
        compare(made.path, "own_enhancements:gain:by=9")


@pytest.mark.parametrize("eotf", ["srgb", "linear"])
def test_values_that_the_display_cannot_show(make_dataset, eotf: str) -> None:
    made = make_dataset(suffix=".png", contrasts=(0.6,), display={"eotf": eotf})
    message = r"_up_0.png: own_enhancements:gain:by=6: \d+ of 2304 values lie beyond 0 to 1, from .* to 2.3; "
    with pytest.raises(FrameError, match=message):
        compare(made.path, "own_enhancements:gain:by=6")
    clipped = compare(made.path, "own_enhancements:gain:by=6", allow_clipping=True)[1].record
    frames = [read_frame(made.frame(number)).values for number in range(4)]
    assert clipped.n_clipped == sum(np.count_nonzero(np.abs(6 * (f - 0.5)) > 0.5 + 1e-6) for f in frames)


@pytest.mark.parametrize(
    ("white", "made", "error", "message"),
    [
        (1.0, {}, FrameError, r"code values have a mean of 50.\d+, above white \(1\); say which .*white"),
        (100.0, {"suffix": ".png"}, FrameError, "white: found 100, expected 1 for integer code values"),
        (0.0, {}, SettingsError, "white: found 0.0, expected a finite number > 0"),
        (math.nan, {}, SettingsError, "white: found nan, expected a finite number > 0"),
        (2.0, {"display": {"eotf": "srgb"}, "suffix": ".png"}, SettingsError,
         'white: found 2, expected 1 with eotf = "srgb"'),
    ],
)  # fmt: skip
def test_white_that_cannot_be(make_dataset, white: float, made, error, message: str) -> None:
    with pytest.raises(error, match=message):
        compare(make_dataset(contrasts=(0.2,), **made).path, "gaussian", white=white)


def with_reference(make_dataset, error: float):
    """Frames that are brighter by a given code value everywhere than those without noise."""
    made = make_dataset(suffix=".png", contrasts=(0.1, 0.2, 0.4))
    (made.path / "clean").mkdir()
    for number, row in enumerate(made.rows):
        clean = read_frame(made.frame(number)).values
        row["reference_frame"] = f"clean/{number}.png"
        write_frame(made.path / row["reference_frame"], clean)
        write_frame(made.frame(number), clean + error)
    made.save()
    return made


def test_psnr_of_a_known_error(make_dataset) -> None:
    """A tenth of white everywhere is 20 dB, whatever the display's luminance; gone, there is no error left."""
    made = with_reference(make_dataset, 0.1)
    reference, mended, again = compare(made.path, "own_enhancements:brighter:by=1", "own_enhancements:gain:by=1.0")
    assert reference.record.psnr_db == pytest.approx(20.0, abs=1e-3)  # code values are rounded to 2⁻¹⁶
    assert (mended.record.psnr_db, again.record.psnr_db) == (pytest.approx(20.0, abs=1e-3),) * 2
    assert 0.9 < reference.record.ssim < 1.0
    exact, blurred = compare(with_reference(partial(make_dataset, "exact"), 0.0).path, "gaussian:sigma=3")
    assert (exact.record.psnr_db, exact.record.ssim) == (None, 1.0)
    assert blurred.record.psnr_db is not None and blurred.record.ssim < 1.0


def test_psnr_is_that_of_all_frames_together(make_dataset) -> None:
    made = with_reference(make_dataset, 0.05)
    clean = np.array([read_frame(made.path / row["reference_frame"]).values for row in made.rows])
    blur, screen = find_enhancement("gaussian:sigma=2"), AlgorithmDisplay(load_dataset(made.path).display)
    frames = [DecodedFrame(FrameFile(made.frame(number)), screen) for number in range(len(made.rows))]
    blurred = np.array([frame.after(blur).luminance() for frame in frames])
    expected = peak_signal_noise_ratio(100.0 * clean[..., 0].astype(np.float64), blurred, data_range=100.0)
    assert compare(made.path, "gaussian:sigma=2")[1].record.psnr_db == pytest.approx(expected, abs=1e-9)


def test_frames_without_a_reference_or_with_other_pixels_are_not_measured(make_dataset) -> None:
    made = with_reference(make_dataset, 0.1)
    for row in made.rows[1:]:
        row["reference_frame"] = ""
    made.save()
    reference, finer = compare(made.path, "bicubic")
    assert reference.record.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert (finer.record.psnr_db, finer.record.ssim) == (None, None)
    small = with_reference(partial(make_dataset, "small", sizes_mrad=(1.0,), side_px=10), 0.1)
    record = compare(small.path, "gaussian")[0].record  # too small for SSIM
    assert (record.ssim, record.psnr_db) == (None, pytest.approx(20.0, abs=1e-3))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("clean/none.png", "none.png: cannot be opened"),
        ("dataset.toml", "dataset.toml: found a file that starts"),
        ("../clean.png", r"line 4: reference_frame ../clean.png lies outside of the dataset"),
    ],
)
def test_a_reference_that_cannot_be_read(make_dataset, name: str, message: str) -> None:
    made = with_reference(make_dataset, 0.1)
    made.rows[2]["reference_frame"] = name
    made.save()
    with pytest.raises(DataError, match=message):
        compare(made.path, "gaussian")


def test_validate_looks_at_references(make_dataset) -> None:
    made = with_reference(make_dataset, 0.1)
    (made.path / made.rows[2]["reference_frame"]).write_bytes(b"")
    data = load_dataset(made.path)
    (problem,) = (str(error) for trial in data.trials for error in frame_problems(data, trial))
    assert "clean/2.png: found an empty file, expected EXR or PNG" in problem


def test_corrected_for_all_comparisons(make_dataset) -> None:
    """Each p-value times those not smaller: two algorithms, two groups and their means are six."""
    made = make_dataset(suffix=".png", sizes_mrad=(1.0, 2.0), contrasts=(0.05, 0.1, 0.2, 0.4))
    results = compare(made.path, "gaussian:sigma=2", "own_enhancements:again")
    every = [one for result in results[1:] for one in (*result.record.ratios, result.record.overall)]
    assert len(every) == 6
    smallest = min(every, key=lambda one: one.p_value)
    assert smallest.p_value_holm == pytest.approx(6 * smallest.p_value)
    # More resamples than 200, or no verdict could survive the correction: 80 for each comparison.
    assert smallest.p_value == pytest.approx(2 / 481)
    of_blur, of_again = (result.record.ratios[0].p_value_is_least for result in results[1:])
    assert (of_blur, of_again) == (True, False)


@pytest.mark.slow
def test_draws_are_common_and_do_not_depend_on_workers(make_dataset) -> None:
    made = make_dataset(suffix=".png", sizes_mrad=(1.0, 1.5), contrasts=(0.1, 0.2, 0.4), repeats=2)
    for decisions in ("expected", "sampled"):
        one = compare(made.path, "median", "unsharp", decisions=decisions)
        with open_engine(None, 2) as engine:
            three = compare(made.path, "median", "unsharp", run=Run(engine), decisions=decisions)
        for ours, theirs in zip(one, three, strict=True):
            assert same_scores(ours.scored, theirs.scored)
            assert (ours.record.ratios, ours.record.overall) == (theirs.record.ratios, theirs.record.overall)
            assert np.array_equal(ours.scored.displacement_samples, one[0].scored.displacement_samples)


class Contrarian(Observer):
    """An observer that is not linear: it looks for the brightest of four halves, with a little noise."""

    position_jitter_samples = 0.5

    def grid(self, stimulus: Stimulus):
        return STEADY.grid(stimulus)

    def respond(self, contrast: np.ndarray, stimulus: Stimulus, rng: np.random.Generator):
        del stimulus
        middle = contrast.shape[0] // 2
        halves = contrast[middle + 1 :], contrast[:, :middle], contrast[:middle], contrast[:, middle + 1 :]
        return ORIENTATIONS[int(np.argmax([half.sum() + rng.normal() for half in halves]))]


def test_an_observer_that_is_not_linear(make_dataset) -> None:
    """Its answers are drawn, with the same noise for all algorithms."""
    made = make_dataset(suffix=".png", contrasts=(0.05, 0.1, 0.2, 0.4), repeats=4)
    observer = Contrarian()
    specs = ("own_enhancements:same", "own_enhancements:gain")
    none, same, gain = compare(made.path, *specs, observer=observer, decisions="sampled")
    scored = score_dataset(load_dataset(made.path), observer, decisions="sampled", fit_settings=FAST)
    assert same_scores(none.scored, scored) and same_scores(same.scored, scored)
    assert gain.record.ratios[0].ratio < 1.0
    with pytest.raises(SettingsError, match="this observer is not linear"):
        compare(made.path, "own_enhancements:same", observer=observer)


def test_an_algorithm_that_fails_with_one_frame(make_dataset) -> None:
    made = make_dataset(suffix=".png", contrasts=(0.1, 0.2, 0.6))
    message = r"s2.0_c0.6_up_0.png: own_enhancements:not_when_large: ValueError: too large"
    with pytest.raises(FrameError, match=message):
        compare(made.path, "own_enhancements:not_when_large", "median")
    results = compare(made.path, "own_enhancements:not_when_large", "median", skip_bad_frames=True)
    for result in results:  # all algorithms have the same trials
        assert [trial.level for trial in result.scored.trials] == [0.1] * 4 + [0.2] * 4
        assert len(result.scored.skipped) == 4
    with pytest.raises(DataError, match=r"no frame can be scored; the first: .*NaN or infinite"):
        compare(made.path, "own_enhancements:brighter:by=1e39", skip_bad_frames=True, allow_clipping=True)


@pytest.mark.parametrize(
    ("enhance", "more", "message"),
    [
        (["median"], {"fit": FitSettings(resamples=0)}, "resamples: found 0, expected 40 or more"),
        (["median", "none", "median"], {}, "enhance 'median': found twice, expected once"),
        ([], {}, "conditions: found 1, expected two or more, or one with enhance or by"),
        (["median"], {"observer": []}, "observer: found none, expected one or several"),
        (3, {}, "enhance: found 3, expected text or a list or a function"),
        ([None], {}, r"enhance\[0\]: found None, expected text or a function"),
        (["median"], {"observer": [OBSERVER, CsfObserver(centre="bounding_box")]},
         "centre: found centroid, bounding_box of several observers"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_refused(make_dataset, enhance, more, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        tod.compare(make_dataset(suffix=".png", contrasts=(0.2,)).path, enhance=enhance, **more)


def test_part_of_an_exr(make_dataset) -> None:
    """A data window smaller than the frame: finer pixels lie where the coarser ones did."""
    import OpenImageIO as oiio

    made = make_dataset(contrasts=(0.3,))
    for number in range(len(made.rows)):
        values = np.ascontiguousarray(read_frame(made.frame(number)).values[5:44, 3:46])
        spec = oiio.ImageSpec(43, 39, 1, "float")
        spec.channelnames = ("Y",)
        spec.x, spec.y, spec.full_width, spec.full_height = 3, 5, 48, 48
        output = oiio.ImageOutput.create(str(made.frame(number)))
        assert output.open(str(made.frame(number)), spec)
        assert output.write_image(values)
        assert output.close()
    scored = score_dataset(load_dataset(made.path), OBSERVER, fit_settings=FAST)
    reference, finer = compare(made.path, "own_enhancements:pixels_divided", white=100.0)
    assert same_scores(reference.scored, scored)
    assert np.allclose(finer.scored.scores, scored.scores, rtol=0.0, atol=1e-5)  # 32-bit code values


@pytest.mark.parametrize(("by", "polarity"), [(0.5, 1), (2.0, 1), (2.0, -1)])
def test_a_plain_gain_does_nothing_beyond_its_gain(make_dataset, by, polarity) -> None:
    """Also where triangles are darker than their background."""
    made = make_dataset(suffix=".png", sizes_mrad=(1.5, 2.5), contrasts=(0.05, 0.08, 0.12, 0.2))
    for number, row in enumerate(made.rows if polarity < 0 else []):
        row["polarity"] = "-1"
        write_frame(made.frame(number), 1.0 - read_frame(made.frame(number)).values[..., 0])
    made.save()
    _, found = compare(made.path, f"own_enhancements:gain:by={by}")
    for one in (*found.record.ratios, found.record.overall):
        # Code values are 32-bit, and 16-bit PNG rounds contrast to 3e-5 of 0.2.
        assert one.contrast_gain == pytest.approx(by, rel=1e-3)
        assert one.beyond_gain == pytest.approx(1.0, rel=1e-3)
        # Without noise in the frames the threshold follows the gain. The levels lie elsewhere on the observer's
        # curve, which a fitted one follows within some per cent.
        assert one.ratio == pytest.approx(1.0 / by, rel=0.06)


def test_observers_together_are_each_alone(make_dataset) -> None:
    """Frames are read as wide as the widest retina needs; a sum of more zeros is the same but for rounding."""
    dataset = load_dataset(make_dataset(suffix=".png", contrasts=(0.1, 0.2, 0.4)).path)
    algorithms = [find_enhancement("own_enhancements:gain")]
    observers = [OBSERVER, CsfObserver()]
    screen = AlgorithmDisplay(dataset.display, 1.0, True)
    together = score_algorithms(dataset, observers, algorithms, fit_settings=FAST, screen=screen)
    assert len(together) == 2
    for observer, found in zip(observers, together, strict=True):
        (alone,) = score_algorithms(dataset, [observer], algorithms, fit_settings=FAST, screen=screen)
        both = (judged(dataset, observer, screen, results) for results in (found, alone))
        for one, other in zip(*both, strict=True):
            np.testing.assert_allclose(one.scored.scores, other.scored.scores, rtol=1e-9, atol=1e-12)
            assert [c.verdict for c in one.record.ratios] == [c.verdict for c in other.record.ratios]
            assert one.record.n_clipped == other.record.n_clipped


@pytest.mark.parametrize(("by", "above", "below"), [(0.05, 0.4, None), (8.0, None, 0.02)])
def test_a_threshold_beyond_the_levels_bounds_the_ratio(make_dataset, by, above, below) -> None:
    """Faded or amplified triangles have thresholds above or below all levels: their end, over the one without."""
    path = make_dataset(suffix=".png", contrasts=(0.02, 0.05, 0.1, 0.4), sizes_mrad=(2.0, 2.5)).path
    spec = f"own_enhancements:gain:by={by}"
    result = tod.compare(path, enhance=spec, fit=FAST, examples=False, allow_clipping=True)
    before, after = result.conditions
    ends = [(above or below) / fit.threshold for fit in before.fits]
    for ratio, end in zip((*after.ratios, after.overall), (*ends, math.sqrt(math.prod(ends))), strict=True):
        assert ratio.ratio is None and ratio.verdict == ("worse" if above else "better")
        bound, none = (ratio.ratio_above, ratio.ratio_below) if above else (ratio.ratio_below, ratio.ratio_above)
        assert (bound, none) == (pytest.approx(end, rel=1e-12), None)
        assert f"{'more' if above else 'less'} than {end:#.3g} times that without it" in result.verdict[0]
    table = result.tables()[0]
    header, *rows = [line.split(",") for line in table.csv().splitlines()]
    column = header.index("ratio_above" if above else "ratio_below")
    assert [bool(row[column]) for row in rows] == [False, False, True, True, True]
    assert {row[header.index("ratio")] for row in rows[:2]} == {"1.0"}


def test_disagreements_come_first() -> None:
    """Those that are better for one observer before those that are worse for one."""

    def judged(*verdicts: str) -> JudgedBy:
        ratio = Ratio(group={}, verdict="better")
        each = zip(("none", "blur", "sharpen", "same"), (None, *verdicts), strict=True)
        algorithms = tuple(
            ComparedCondition(name=name, spec=name, verdict=verdict, overall=ratio) for name, verdict in each
        )
        return JudgedBy(settings={}, conditions=algorithms)

    no = "no difference shown"
    lines = comparisons([("pyramid", judged(no, "better", no)), ("csf", judged("worse", no, no))])
    assert lines[:2] == (
        "The observers disagree about sharpen: better for pyramid, no difference shown for csf.",
        "The observers disagree about blur: no difference shown for pyramid, worse for csf.",
    )
    assert [line.split(": ")[:2] for line in lines[2:]] == [
        [who, name] for who in ("pyramid", "csf") for name in ("blur", "sharpen", "same")
    ]


def algorithm_of(
    thresholds: list[float | None], *ratios: Ratio, grouped: bool = True, **more
) -> ComparedCondition:
    """An algorithm with a threshold for each size of 1, 2, … mrad; None is never reached."""
    fits = tuple(
        Fit(
            group={"size_mrad": float(number)} if grouped else {},
            level="contrast",
            status="ok" if threshold else "never_reached",
            threshold=threshold,
            p_correct=0.75,
        )
        for number, threshold in enumerate(thresholds, 1)
    )
    ratios = tuple(structs.replace(ratio, group=fit.group) for ratio, fit in zip(ratios, fits, strict=False))
    return ComparedCondition(
        **{"name": "blur", "spec": "blur", "verdict": "better"} | more, fits=fits, ratios=ratios
    )


OF_GAINS = {"more than": (0.8, 0.99), "no more than": (0.8, 1.0), "less than": (1.1, 1.3)}


@pytest.mark.parametrize(("amount", "of_gain"), [*OF_GAINS.items(), ("no more than", (1.0, None))])
def test_the_paragraph_of_an_algorithm(amount, of_gain) -> None:
    each = (Ratio(verdict="better", ratio=0.5), Ratio(verdict="worse", ratio=1.5), Ratio(verdict="lost"))
    whole = {"ratio": 0.9, "ratio_ci95": (0.7, None), "contrast_gain": 2.0, "beyond_gain": 0.95}
    overall = Ratio(verdict="mixed", **whole, beyond_gain_ci95=of_gain)
    more = {"overall": overall, "verdict": "mixed", "disagrees": ("psnr", "ssim"), "psnr_change_db": -1.54}
    found = algorithm_of([0.1, 0.3, None], *each, **more, ssim_change=0.0101)
    (text,) = comparisons([("", JudgedBy(settings={}, conditions=(algorithm_of([0.2, 0.2, None]), found)))])
    assert text == (
        "blur: mixed; the threshold contrast is 0.900 times that without it (95 % interval from 0.700, open above)"
        ", in the geometric mean of all groups; better at 1 mrad; worse at 2 mrad. It does "
        f"{amount} its contrast gain of 2.00: the threshold is 0.950 times that of a plain gain of as much (95 % "
        f"interval {interval_phrase(of_gain)}). At 3 mrad 75 % correct is never reached with it or without. The "
        "usual measures disagree: PSNR changes by −1.5 dB and SSIM by +0.010."
    )
    likely = Ratio(verdict="no difference shown", ratio=2.12, ratio_ci95=(1.59, 3.07), p_value_holm=0.081)
    one = algorithm_of([0.3], likely, verdict=likely.verdict)
    (text,) = comparisons([("", JudgedBy(settings={}, conditions=(algorithm_of([0.2]), one)))])
    assert (
        "2.12 times that without it (95 % interval 1.59 to 3.07 of this ratio alone; p is 0.081 with all" in text
    )
    alone = algorithm_of([None], Ratio(verdict="worse", contrast_gain=2.0, beyond_gain=0.9), grouped=False)
    judged = JudgedBy(settings={}, conditions=(algorithm_of([0.2], grouped=False), alone))
    expected = "csf: blur: better. 75 % correct is never reached with it and is reached without."
    assert comparisons([("csf", judged)]) == (expected,)


@pytest.mark.parametrize(
    ("near", "errors", "is_reported"),
    [
        *(
            (11.0, (0.0, 0.0), False),
            (11.01, (0.0, 0.0), True),
            (9.0, (0.1, 0.1), False),
            (8.9, (0.1, None), True),
        ),
        *(
            (25.0, (3.0, 4.0), False),
            (25.5, (3.0, 4.0), True),
            (None, (0.0, 0.0), False),
            (-9.0, (0.1, 0.1), False),
        ),
    ],
)
def test_a_gain_that_is_another_at_the_threshold_is_reported(near, errors, is_reported) -> None:
    """10 at the highest level; a tenth of it may be missing, and three standard errors, √(3² + 4²) · 3 = 15."""
    gains = ((0.1, near, errors[0]), (0.4, 10.0, 0.0), (0.8, 10.0, errors[1]))
    points = tuple(ContrastPoint(level, level, 0.0, gain, error) for level, gain, error in gains)
    of_gain = Ratio(verdict="better", beyond_gain=0.9)
    made = algorithm_of([0.18], of_gain, contrast_responses=(ContrastResponse(points=points),))
    found = [(one.code, one.group, one.found, one.expected) for one in not_proportional([made])]
    group = {"condition": "blur", "size_mrad": 1.0}
    assert found == [("not_proportional", group, near, 10.0)] * is_reported
    for _, other in (
        ("threshold", algorithm_of([None], of_gain)),
        ("plain gain", algorithm_of([0.1], Ratio(verdict="a"))),
    ):
        assert not [*not_proportional([structs.replace(other, contrast_responses=made.contrast_responses)])]


def test_what_an_algorithm_does_to_frames_is_reported() -> None:
    each = [(None, None), (1.019, 0.0), (1.021, 0.0), (0.981, 0.0), (0.979, 0.0), (1.0, 0.054)]
    found = [*frame_warnings([ComparedCondition(name="a", edge_factor=x, repeat_difference=y) for x, y in each])]
    edge, again = "edge_brightness", "not_repeatable"
    reported = [(edge, 1.021, 1.0), (edge, 0.979, 1.0), (again, 0.054, 0.0)]
    assert [(one.code, one.found, one.expected) for one in found] == reported
    shown = ("of a frame 2.1 % brighter, as", "of a frame 2.1 % darker, as", "differ by up to 5.4 % of their mean")
    assert all(text in one.message for text, one in zip(shown, found, strict=True))


def on_scenes(make_dataset, n_scenes: int, name: str = "dataset", repeats: int = 4, **more):
    """A dataset whose repeats of each triangle are on different scenes, of which nothing is seen."""
    made = make_dataset(name, suffix=".png", contrasts=(0.02, 0.05, 0.1, 0.2), repeats=repeats, **more)
    for number, row in enumerate(made.rows):
        row["scene"] = f"scene {number % n_scenes}" if n_scenes else ""
    made.save()
    return made.path


@pytest.mark.slow
def test_scenes_change_intervals_alone(make_dataset) -> None:
    """Scores, fits and ratios are those of the same frames without a column of scenes."""
    plain, four, one = (
        compare(on_scenes(make_dataset, n, f"made{n}"), "own_enhancements:gain:by=1.2") for n in (0, 4, 1)
    )
    assert [each[1].record.n_scenes for each in (plain, four, one)] == [None, 4, 1]
    (before,), (after,) = plain[1].record.ratios, one[1].record.ratios
    gain = {"contrast_gain": None, "beyond_gain": None, "beyond_gain_ci95": None}
    # Nothing is known of other scenes.
    assert structs.replace(before, **gain) == structs.replace(after, **gain)
    # The contrast is measured in another way; 16-bit PNG rounds it to 3e-5 of 0.2.
    assert before.contrast_gain == pytest.approx(after.contrast_gain, rel=1e-3)
    without, of_scenes = (one[1].scored.fits[0].fit for one in (plain, four))
    assert of_scenes.threshold_ci95_same_scenes == without.threshold_ci95
    no_interval = {"threshold_ci95": None, "threshold_ci95_same_scenes": None}
    assert replace(without, **no_interval) == replace(of_scenes, **no_interval)
    ratio, of_four = plain[1].record.ratios[0], four[1].record.ratios[0]
    assert (of_four.ratio, of_four.ratio_ci95 == ratio.ratio_ci95) == (ratio.ratio, False)


@pytest.mark.slow
def test_scenes_that_are_groups_are_each_judged_by_their_trials(make_dataset) -> None:
    """A group of one scene is as it is without a column of scenes: its interval is that of trials."""
    found = []
    for number, n_scenes in enumerate((0, 2)):
        path = on_scenes(make_dataset, n_scenes, f"made{number}", experiment={"group_by": ["size_mrad", "eye"]})
        lines = (path / "manifest.csv").read_text(encoding="utf-8").splitlines()
        marked = [f"{line},{'eye' if k == 0 else k % 2}" for k, line in enumerate(lines)]
        (path / "manifest.csv").write_text("\n".join(marked) + "\n", encoding="utf-8")
        found.append(compare(path, "own_enhancements:gain:by=1.2")[1])
    of_trials, of_scenes = ([(one.ratio, one.ratio_ci95) for one in each.record.ratios] for each in found)
    assert len(of_trials) == 2 and of_trials == of_scenes


SPECS_OF_GAIN = ("own_enhancements:gain:by=2", "own_enhancements:root")


def test_displayed_contrast_before_and_after(make_dataset) -> None:
    """A gain has the same gain at all levels; a root of contrast has c^(1/2) / c on the triangle."""
    data = on_scenes(make_dataset, 0, repeats=2, sizes_mrad=(4.0,), side_px=96)
    none, of_gain, of_root = (one.record for one in compare(data, *SPECS_OF_GAIN))
    levels = of_gain.contrast_responses[0].points
    assert [one.level for one in levels] == [0.02, 0.05, 0.1, 0.2]
    assert [one.gain for one in levels] == pytest.approx([2.0] * 4, rel=1e-3)  # 16 bits
    assert levels[0].n_trials == 8
    levels = of_root.contrast_responses[0].points
    # Pixels that the edge crosses have less contrast before, and more gain: some 2 % of the area.
    assert [one.gain for one in levels] == pytest.approx([0.3 / math.sqrt(one.level) for one in levels], rel=0.04)
    assert (none.contrast_responses, len(of_gain.contrast_responses)) == ((), 1)
    (warning,) = not_proportional([none, of_gain, of_root])
    assert warning.group["condition"] == "own_enhancements:root"
    more, open_ = comparisons([("", JudgedBy(settings={}, conditions=(none, of_gain, of_root)))])
    assert "its contrast gain of 2" in more and "Whether it does more than amplify stays open" in open_


def test_results_in_the_store_are_those_of_the_values_of_a_partial_function() -> None:
    """They are in no text: two of them have the same name."""
    keys = [fingerprint(parts_of([find_enhancement(partial(builtin.gaussian, sigma=one))])) for one in (1.0, 2.0)]
    assert keys[0] != keys[1]


@pytest.mark.parametrize(
    ("name", "before", "is_drawn"),
    [
        ("contrast", [0.02, 0.05, 0.1, 0.2], True),
        ("contrast", [-0.001, 0.06, 0.09, 0.2], True),  # in noise
        ("contrast", [0.015, 0.033, 0.06, 0.09], True),  # a display that saturates
        ("snr", [0.11, 0.1, 0.1, 0.1], False),
        ("snr", [0.08, 0.12, 0.1, 0.1], False),  # in noise
    ],
)
def test_contrast_before_and_after_is_drawn_if_levels_are_contrasts(name, before, is_drawn) -> None:
    """As the frames show them: at all SNRs the contrast is the same, and points above each other say nothing."""
    shown = zip([0.02, 0.05, 0.1, 0.2], before, strict=True)
    points = tuple(ContrastPoint(level=level, before=one, after=2.0 * one) for level, one in shown)
    fits = (Fit(group={}, level=name, status="ok", p_correct=0.75),)
    blur = ComparedCondition(name="blur", fits=fits, contrast_responses=(ContrastResponse(points=points),))
    none = ComparedCondition(name="none", spec="none", fits=fits)
    result = Comparison.made("compare", 0.0, conditions=(none, blur))
    drawn = [one.file for one in result.figures()]
    assert ("contrast_response.png" in drawn) == is_drawn


def measured_on_scenes(kind: str, levels: list[float], n_views: int = 12) -> tuple[Trials, np.ndarray]:
    """Trials on views, whose triangles have a contrast of 0.9 c: 0.6 of it to the sides, 0.5 opposite.

    A second algorithm shows them with c² in a blurred shape. Both see 0.3 and more of the views themselves.
    """
    rng, trials, contrasts = np.random.default_rng(3), [], []
    shapes = np.array([[1.0, 0.6, 0.5, 0.6], [1.0, 0.8, 0.7, 0.8]])
    for view in range(n_views):
        of_view = 0.3 + rng.normal(0.0, 0.2, (2, 4))
        for number, level in enumerate(levels):
            turns = {"in turn": [view + number], "alike": [0], "all": range(4)}
            turns["at random"] = rng.integers(4, size=2)
            for turn in turns[kind]:
                orientation = ORIENTATIONS[turn % 4]
                seen = SceneView(f"scene {view % 4}", "r0", str(view))
                frames = (FrameReference("f", None, None),)
                place = len(trials), "t", frames, orientation, Stimulus(1.0), level, (), 0, 0
                trials.append(Trial(*place, view=seen))
                shown = np.array([0.9 * level, level**2])[:, None] * shapes
                contrasts.append(shown + np.roll(of_view, -orientation.quarter_turns, axis=1))
    return Trials.of(trials), np.array(contrasts)


@pytest.mark.parametrize("kind", ["in turn", "all", "at random"])
def test_contrast_on_scenes_is_that_of_the_triangle(kind) -> None:
    """Whatever the scenes have themselves, and whatever the shape in which an algorithm shows the triangle."""
    levels = [0.1, 0.2, 0.3, 0.5]
    found = contrasts_on_scenes(*measured_on_scenes(kind, levels), sharp_share=0.4)
    assert found.contrast == pytest.approx(np.array([[0.9 * one, one**2] for one in levels]), rel=1e-6)
    assert found.gain_error.max() < 1e-6
    assert found.n_trials.tolist() == [12 * {"all": 4, "at random": 2}.get(kind, 1)] * 4
    # One level does not show the shape: a sharp triangle's share of the opposite one, 0.4, is taken for 0.5.
    one = contrasts_on_scenes(*measured_on_scenes("all", [0.3]), sharp_share=0.4)
    assert one.contrast[0] == pytest.approx([0.27 * 0.5 / 0.6, 0.09 * 0.3 / 0.6], rel=1e-6)


def test_scenes_that_do_not_tell_the_triangle_are_not_taken_out() -> None:
    assert contrasts_on_scenes(*measured_on_scenes("alike", [0.1, 0.3]), sharp_share=0.4) is None
    trials, _ = measured_on_scenes("alike", [0.1, 0.3])
    assert views_to_measure(trials) is None


def test_displayed_contrast_on_scenes_is_that_on_an_even_field(make_dataset, tmp_path) -> None:
    """A scene that is brighter in the middle, and a filter that changes the shape of the triangle."""
    x = np.linspace(-1.0, 1.0, 48)
    for number in range(2):
        spot = 0.4 + 0.3 * np.exp(-4.0 * ((x - 0.3 * number) ** 2 + x[:, None] ** 2)) + 0.05 * np.sin(20.0 * x)
        write_frame(tmp_path / f"spot{number}.png", spot)
    shown = {"sizes_mrad": (2.0,), "contrasts": (0.05, 0.1, 0.2), "suffix": ".png"}
    even, scenes = make_dataset(**shown), make_dataset("scenes", **shown, repeats=2)
    for number, row in enumerate(scenes.rows):
        spot = read_frame(tmp_path / f"spot{number % 2}.png").values[..., 0]
        triangle = read_frame(scenes.frame(number)).values[..., 0] - 0.5  # 50 cd/m²
        write_frame(scenes.frame(number), spot + triangle)
        row |= {"scene": f"spot{number % 2}", "scene_turn": "r0", "scene_window": "0"}
    scenes.save()
    spec = "gaussian:sigma=2"
    (levels,), (on_scenes,) = (compare(one.path, spec)[1].record.contrast_responses for one in (even, scenes))
    for before, after in zip(levels.points, on_scenes.points, strict=True):
        # 16 bits are 2e-4 of the faintest contrast; the retina samples the shape, which is a per cent.
        assert after.before == pytest.approx(before.before, rel=0.01)
        assert after.gain == pytest.approx(before.gain, rel=0.01)


def test_trials_that_are_measured() -> None:
    frames = (FrameReference("f", None, None),)
    trials = Trials.of(
        Trial(number, "t", frames, ORIENTATIONS[0], Stimulus(1.0), 0.1 + number // 100, (), 0, 0)
        for number in range(200)
    )
    found = measured_trials(trials)
    assert found >= set(range(100, 200))
    assert len(found) == 100 + MEASURED_TRIALS


def test_levels_to_add_are_those_of_each_observer(make_dataset) -> None:
    """A triangle of 2 mrad: 75 % at a contrast of 0.08 for the pyramid, and at 0.22, beyond all shown, for csf."""
    path = make_dataset(contrasts=(0.04, 0.06, 0.09, 0.13)).path
    csf = CsfObserver(retina_pitch_mrad=0.2)
    together, alone = (
        [one for one in result.warnings if one.code == "levels_to_add"]
        for result in (
            tod.compare(path, enhance=["gaussian:sigma=0.5"], observer=each, fit=FAST, white=200.0, examples=False)
            for each in ([OBSERVER, csf], csf)
        )
    )
    assert [one.group["condition"] for one in together] == ["none", "gaussian"]
    assert all("add levels near" in one.message for one in together)
    assert [one.message for one in together] == [f"csf: {one.message}" for one in alone]


@pytest.mark.parametrize(
    ("name", "amount"),
    [
        ("again", None),
        # Of white, on a mean of 0.5, which the triangle raises by 0.1 · 64 / 2304.
        ("special_at_first", (0.1 / 1.003, 0.1)),
        # Half the contrast of the last triangle, of 0.4, where there is none.
        ("remembering", (0.15, 0.2)),
        # Uniform noise of ± 0.05 of white: the largest of 2304 differences is near 0.1 / 0.5.
        ("drawing", (0.17, 0.2)),
        # A tenth of the brightest pixel.
        ("changing", (0.11 / 1.003, 0.11 / 1.002)),
    ],
)
def test_an_algorithm_that_is_not_repeatable(make_dataset, kept, name, amount) -> None:
    """The warning says by how much, and no result of it is kept."""
    data = make_dataset(suffix=".png", contrasts=(0.1, 0.4)).path
    for _ in range(2):
        sys.modules.pop("own_enhancements", None)
        spec = f"own_enhancements:{name}"
        result = tod.compare(data, enhance=spec, store=kept, fit=FAST, examples=False, allow_clipping=True)
    found = [one.found for one in result.warnings if one.code == "not_repeatable"]
    assert (result.from_store, len(found)) == ((8, 0) if amount is None else (0, 1))
    assert amount is None or amount[0] <= found[0] <= amount[1]
