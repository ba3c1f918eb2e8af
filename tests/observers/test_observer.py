"""The observer: folded against literal, symmetry, and the published naked-eye figures."""

from __future__ import annotations

import dataclasses
import pickle
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import SettingsError
from todframes.observers.interface import ENTRY_POINT_GROUP, Observer, find_observer, observers_with
from todframes.observers.pyramid import LaplacianPyramid, PyramidObserver, PyramidSettings
from todframes.observers.retina import RetinaGrid
from todframes.scoring.naked_eye import acuity, contrast_threshold, proportion_correct
from todframes.stimulus import Orientation, Stimulus
from todframes.studies.accuracy.measure import find_scenes


def registered() -> list[str]:
    return sorted({entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)})


PYRAMID_VARIANTS = [
    {},
    {"kernel_a": 0.4},
    {"include_residual": True},
    {"band_gain": 2.0},
    {"centre": "bounding_box"},
    {"template_blur_samples": 0.0},
    {"levels": 5, "internal_noise_sd": 0.3},
]
VARIANTS = [
    *(("pyramid", variant) for variant in PYRAMID_VARIANTS),
    *(("informative", variant) for variant in PYRAMID_VARIANTS[:4]),
    ("informative", {"informative_share": 1.0, "display_blur_mrad": 0.4}),
    ("informative", {"informative_share": 0.8, "sample_pitch_mrad": 0.7, "sample_noise_sd": 0.2}),
    *(("oriented", variant) for variant in PYRAMID_VARIANTS[:5]),
    ("oriented", {"phases": "odd", "orientations": 6, "wavelength_samples": 3.0}),
    ("oriented", {"phases": "even", "elongation": 2.0, "bandwidth_octaves": 1.5, "include_residual": True}),
    ("csf", {}),
    ("csf", {"retina_pitch_mrad": 0.17, "centre": "bounding_box", "aperture_sd_deg": 0.6, "efficiency": 3.0}),
    (
        "csf",
        {
            "retina_pitch_mrad": 0.2,
            "template": "ideal",
            "external_noise_deg": 0.003,
            "external_noise_exponent": 1.0,
        },
    ),
]
EYE = {"eye_mtf": "watson2013", "band_noise": (13.0, 1.0, 0.3, 0.2, 0.1), "pupil_mm": 5.0}
VARIANTS += [(name, EYE) for name in ("pyramid", "informative", "oriented")]
VARIANTS += [
    ("pyramid", EYE | {"include_residual": True, "kernel_a": 0.4}),
    ("informative", EYE | {"sample_pitch_mrad": 0.7, "sample_noise_sd": 0.2}),
    ("csf", {"retina_pitch_mrad": 0.2, "luminance_cd_m2": 3.0, "age_years": 70.0}),
]
NOT_LINEAR = [("oriented", {"complex_cells": True, "orientations": 4})]


def make(name: str, changes: dict[str, Any]) -> Observer:
    kind = find_observer(name)
    return kind(kind.settings_type(**changes))


@pytest.fixture(scope="module")
def observer() -> PyramidObserver:
    return PyramidObserver()


# The contract: `check_observer` tests the observers of this package, and reports each fault of others.


CHEAPER = {"oriented": {"orientations": 2}}


@pytest.mark.parametrize(
    ("name", "changes"), [*((name, CHEAPER.get(name, {})) for name in registered()), *NOT_LINEAR], ids=str
)
def test_the_contract(name: str, changes: dict[str, Any]) -> None:
    assert tod.check_observer(make(name, changes)) == []


@dataclasses.dataclass
class Loose:
    centre: str = "apex"


class Bare(tod.Observer):
    """What an observer needs: a grid and answers, here those of the pyramid."""

    paper = PyramidObserver(position_jitter_samples=0.0)

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        return self.paper.grid(stimulus)

    def respond(self, contrast: np.ndarray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        return self.paper.respond(contrast, stimulus, rng)


FAULTY: list[type[tod.Observer]] = []


def rebuilt(number: int) -> tod.Observer:
    return FAULTY[number]()


def faulty(**members: Any) -> type[tod.Observer]:
    """Return a class whose objects can be pickled."""
    number = len(FAULTY)
    FAULTY.append(type("Faulty", (Bare,), {"__reduce__": lambda _: (rebuilt, (number,))} | members))
    return FAULTY[-1]


def with_readout(**changes: Any) -> type[tod.Observer]:
    """An observer whose readout has some attributes computed from those of the pyramid's."""

    def make_readout(self: Bare, stimulus: Stimulus) -> tod.Readout:
        readout = self.paper.readout(stimulus)
        return dataclasses.replace(
            readout, **{name: change(getattr(readout, name)) for name, change in changes.items()}
        )

    return faulty(make_readout=make_readout)


class Forgetful(Bare):
    def __init__(self, settings: Any = None) -> None:
        super().__init__(settings)
        self.turns = 1

    def respond(self, contrast: np.ndarray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        return super().respond(np.rot90(contrast, self.turns - 1).copy(), stimulus, rng)

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"turns": 2}


FREE_RNG = np.random.default_rng(0)
CHANGEABLE = [
    "settings_type Loose can be changed, expected @dataclass(frozen=True).",
    "centre is 'apex', expected 'centroid' or 'bounding_box'.",
]
NO_SUM, NO_ROWS = (
    "The four images of deviations do not sum to 0: subtract their mean.",
    "The rows of noise_covariance do not sum to 0: compute it from deviations alone.",
)
NOT_TURNED = "An image turned clockwise by {}° has other scores than the image, turned."
NO_POLARITY = "A darker triangle on the negative image has other scores: multiply templates by stimulus.polarity."
NOT_SURER = "More contrast of a triangle that points up does not make its answer surer."
OTHERS_DRAWN = (
    "respond draws other answers than the readout expects: 0 up, 0 right, 0 down, 150 left, expected about "
)
NARROW = "grid is 1.71 mrad wide for a triangle of {} mrad, whose apex needs more than {}."


@pytest.mark.parametrize(
    ("observer", "sentences"),
    [
        (PyramidSettings(), ["PyramidSettings is no subclass of todframes.Observer."]),
        (int, ["int is no subclass of todframes.Observer."]),
        (type("Needy", (Bare,), {"__init__": lambda _: 1 / 0}), ["An object with the default settings cannot be "
         "made: TypeError: <lambda>() takes 1 positional argument but 2 were given."]),
        (faulty(settings_type=int), ["settings_type is <class 'int'>, expected a dataclass."]),
        (faulty(settings_type=Loose), CHANGEABLE),
        *((faulty(position_jitter_samples=n), [f"position_jitter_samples is {n}, expected a number >= 0."])
          for n in (-1.0, np.inf)),
        (faulty(grid=lambda *_: 9), ["grid returns int, expected a RetinaGrid."] * 3),
        (faulty(grid=lambda *_: RetinaGrid(9, 0.19)), [NARROW.format(1, 1.755), NARROW.format(20, 35.1)]),
        (tod.Observer(), ["The check of grid ended with NotImplementedError."]),
        (faulty(respond=lambda *_: "up"), ["respond returns 'up', expected one of ORIENTATIONS."]),
        (
            faulty(respond=lambda self, image, stimulus, rng: self.paper.respond(-image, stimulus, rng)),
            [f"respond answers {answer} to a plain triangle, {kind} than the background, that points {shown}."
             for kind in ("brighter", "darker")
             for shown, answer in (("up", "down"), ("right", "left"), ("down", "up"), ("left", "right"))],
        ),
        (
            faulty(respond=lambda self, image, stimulus, _: self.paper.respond(image, stimulus, FREE_RNG)),
            ["respond draws other answers with the same generator: take all random numbers from rng.",
             "A pickled copy draws other answers: keep everything that these depend on in attributes."],
        ),
        (faulty(respond=lambda *_: 1 / 0), [f"The check of {check} ended with ZeroDivisionError: division by zero."
         for check in ("answers", "copy")]),
        (Forgetful(), ["A pickled copy draws other answers: keep everything that these depend on in attributes."]),
        (faulty(make_readout=lambda self, stimulus: self.paper.readout(stimulus), __reduce__=lambda _: (Bare, ())),
         ["A pickled copy has a readout where the observer has none, or none where it has one."]),
        (faulty(make_readout=lambda *_: 3), ["readout returns int, expected a Readout or None."]),
        (with_readout(deviations=lambda d: d[:3]), ["The readout has deviations of shape (3, 65, 65) and a "
         "noise_covariance of shape (4, 4), expected (4, 65, 65) and (4, 4)."]),
        (with_readout(deviations=lambda d: d + 1e-3), [NO_SUM, NO_POLARITY]),
        (with_readout(noise_covariance=np.triu), ["noise_covariance is not symmetric.", NO_ROWS,
         "The check of readout ended with SettingsError: asymmetry of covariance is 0.00764036, expected a "
         "symmetric matrix."]),
        (with_readout(noise_covariance=lambda c: -c), ["noise_covariance has a negative eigenvalue: it is no "
         "covariance.", "The check of readout ended with SettingsError: smallest eigenvalue of covariance is "
         "-0.0162137, expected a positive semi-definite matrix."]),
        (with_readout(noise_covariance=lambda c: c + c[0, 0]), [NO_ROWS]),
        (with_readout(deviations=lambda d: d[[1, 0, 2, 3]]),
         [*(NOT_TURNED.format(turn) for turn in (90, 180, 270)), NOT_SURER]),
        (
            with_readout(deviations=lambda d: d + 0.01 * np.array([1.0, -1.0, 1.0, -1.0])[:, None, None]),
            [*(NOT_TURNED.format(turn) for turn in (90, 270)),
             "A uniform field is no guess: its four answers have different probabilities.", NO_POLARITY,
             OTHERS_DRAWN + "11 up, 0 right, 11 down, 127 left."],
        ),
        (with_readout(deviations=np.abs),
         [NO_SUM, NO_POLARITY, OTHERS_DRAWN + "5 up, 34 right, 5 down, 106 left."]),
        (with_readout(deviations=np.negative), [NOT_SURER]),
        (with_readout(noise_covariance=lambda c: 9.0 * c), [OTHERS_DRAWN + "10 up, 4 right, 10 down, 126 left."]),
    ],
)  # fmt: skip
def test_a_fault_has_a_sentence(observer: Any, sentences: list[str]) -> None:
    assert tod.check_observer(observer) == sentences


def test_what_an_observer_need_not_do() -> None:
    """A grid and answers are enough; the other abilities are missing, and say so."""
    observer, stimulus = Bare(), Stimulus(1.0)
    assert tod.check_observer(observer) == []
    assert (observer.centre, observer.position_jitter_samples) == ("centroid", 0.0)
    assert observer.with_extra_level() is observer
    assert observer.activity(np.zeros((9, 9))) == ()
    assert observer.readout(stimulus) is observer.omitted_bands(stimulus) is None
    assert observer.with_retina_step(0.5) is None
    assert observer.detection(np.ones((3, 3)), 1.0, 9) is None
    with pytest.raises(SettingsError, match="it is not linear; the probability of its answers cannot be computed"):
        observer.linear_readout(stimulus)


def test_the_last_two_readouts_are_kept_and_not_pickled() -> None:
    observer = PyramidObserver()
    first = observer.readout(Stimulus(0.3))
    assert observer.readout(Stimulus(0.3)) is first
    assert pickle.loads(pickle.dumps(observer)).readout(Stimulus(0.3)) is not first
    second = observer.readout(Stimulus(0.4))
    assert (observer.readout(Stimulus(0.3)), observer.readout(Stimulus(0.4))) == (first, second)
    observer.readout(Stimulus(0.5))
    assert observer.readout(Stimulus(0.4)) is second
    assert observer.readout(Stimulus(0.3)) is not first


# The observers of this package: their folded path is their literal one.


@pytest.mark.parametrize(("name", "variant"), VARIANTS, ids=str)
@pytest.mark.parametrize("size_mrad", [0.3, 2.0])
def test_folded_scores_are_the_literal_ones(name: str, variant: dict, size_mrad: float) -> None:
    observer = make(name, variant)
    stimulus = Stimulus(size_mrad, -1)
    readout = observer.readout(stimulus)
    image = np.random.default_rng(0).normal(size=(readout.grid.side,) * 2)
    literal = observer.literal_scores(image, stimulus)
    # Sums of some 1e4 products rounded to 1e-16 of unit-variance neurons.
    assert np.allclose(readout.scores(image), literal, rtol=0.0, atol=1e-10 * max(1.0, np.abs(literal).max()))
    assert np.allclose(readout.score_deviations(image), literal - literal.mean(), rtol=0.0, atol=1e-10)


def test_levels_and_field_follow_from_the_size() -> None:
    """The smallest power of two, 16 or more, from 0.9 sizes on."""
    samples = {1.0: 65, 17.7: 65, 17.8: 129, 35.5: 129, 35.6: 257}
    pitch = PyramidSettings().retina_pitch_mrad
    sides = {size: PyramidObserver().grid(Stimulus(size * pitch)).side for size in samples}
    assert sides == samples
    assert PyramidObserver().with_extra_level().grid(Stimulus(pitch)).side == 129
    assert PyramidObserver(band_noise=(1.0,) * 6).grid(Stimulus(pitch)).side == 257
    # The apex, 0.87738 sizes from the middle, with half a sample of displacement and 2.4 of blur, within 32.5.
    assert PyramidObserver(levels=4).grid(Stimulus(33.7 * pitch)).side == 65
    with pytest.raises(SettingsError, match=r"levels: found 4, a grid of 65 retina samples; .* needs 65"):
        PyramidObserver(levels=4).grid(Stimulus(33.8 * pitch))
    # REDUCE blurs by 2.5 − 4 a squared samples each time: 1 + 4 after two.
    coarse = PyramidObserver(band_noise=(1.0, 2.0, 3.0))._coarser(2)
    assert (coarse.retina_pitch_mrad, coarse.position_jitter_samples) == (4.0 * pitch, 0.0)
    assert coarse.template_blur_samples == pytest.approx((1.2**2 + 5.0) ** 0.5 / 4.0)
    assert coarse.band_noise == (3.0,) == PyramidObserver(band_noise=(1.0, 3.0))._coarser(2).band_noise


def test_a_readout_knows_its_symmetry_and_its_bounds() -> None:
    readout = PyramidObserver().readout(Stimulus(1.0))
    turned, skew = readout.deviations[[1, 2, 3, 0]], np.diag([1.0, 2.0, 1.0, 1.0])
    others = [dataclasses.replace(readout, **{name: value}) for name, value in
              (("deviations", turned), ("noise_covariance", skew), ("noise_covariance", np.eye(4)))]  # fmt: skip
    assert [each.is_symmetric for each in (readout, *others)] == [True, True, False, True]
    assert others[0].weights_key != readout.weights_key == others[2].weights_key
    first = dataclasses.replace(readout, excess_kurtosis=-0.01, find_fourth_cumulants=None)
    assert first.non_gaussian_bound == pytest.approx(3.0 * 0.5506 / 24.0 * 0.01)
    second = dataclasses.replace(first, find_fourth_cumulants=lambda: None)
    assert second.non_gaussian_bound == pytest.approx(20.0 * first.non_gaussian_bound**2)


def flat_templates(observer: PyramidObserver, stimulus: Stimulus) -> np.ndarray:
    return np.array([np.concatenate([band.ravel() for band in t]) for t in observer.templates(stimulus)])


@pytest.mark.parametrize("variant", [*PYRAMID_VARIANTS, {"include_residual": True, "levels": 7}], ids=str)
@pytest.mark.parametrize("size_mrad", [0.3, 1.0, 3.3, 9.0])
def test_readout_about_the_triangle_is_that_of_whole_bands(variant: dict, size_mrad: float) -> None:
    """The literal templates, through the adjoint of the whole pyramid."""
    if (variant, size_mrad) == (PYRAMID_VARIANTS[-1], 9.0):
        pytest.skip("does not fit")
    observer, stimulus = PyramidObserver(**variant), Stimulus(size_mrad)
    settings, grid = observer.settings, observer.grid(stimulus)
    templates = observer.templates(stimulus)
    means = [np.mean(bands, axis=0) for bands in zip(*templates, strict=True)]
    upright = [band - mean for band, mean in zip(templates[0], means, strict=True)]
    levels = len(upright) - settings.include_residual
    weights = [settings.band_gain**k * band for k, band in enumerate(upright)]
    if not settings.include_residual:
        weights.append(np.zeros((5, 5)))
    whole = LaplacianPyramid(levels, settings.kernel_a).adjoint(weights)
    largest, half = np.abs(whole).max(), grid.side // 2
    covariance = observer.readout(stimulus).noise_covariance
    # Sums of a hundred products at each of ten levels: a thousand roundings at most, of templates 97 % alike.
    np.testing.assert_allclose(observer.readout(stimulus).deviations[0], whole, rtol=0.0, atol=1e-12 * largest)
    for half_width in (half, min(int(1.3 * size_mrad / grid.pitch_mrad) + 8, half), 10):
        within = observer.readout_within(stimulus, half_width)
        inner, readout = slice(half - half_width, half + half_width + 1), observer.readout(stimulus)
        np.testing.assert_array_equal(readout.cropped(half_width).deviations, readout.deviations[:, inner, inner])
        assert readout.cropped(half_width).grid == RetinaGrid(2 * half_width + 1, grid.pitch_mrad)
        assert (len(within.deviations), within.excess_kurtosis, within.fourth_cumulants) == (1, 0.0, None)
        np.testing.assert_allclose(within.deviations[0], whole[inner, inner], rtol=0.0, atol=2e-4 * largest)
        np.testing.assert_allclose(within.noise_covariance, covariance, rtol=0.0, atol=2e-4 * covariance[0, 0])


@pytest.mark.parametrize(("name", "variant"), VARIANTS, ids=str)
def test_noise_covariance_is_that_of_noise_through_the_literal_path(name: str, variant: dict) -> None:
    """⟨t_j, t_k⟩ of the templates' deviations, from the bands themselves."""
    observer = make(name, variant)
    templates = flat_templates(observer, Stimulus(0.8))
    deviations = templates - np.mean(templates, axis=0)
    expected = observer.settings.noise_sd**2 * deviations @ deviations.T
    readout, differences = observer.readout(Stimulus(0.8)), templates[0] - templates[1:]
    assert np.allclose(readout.noise_covariance, expected, rtol=0.0, atol=1e-12 * expected.max())
    share = ((differences**4).sum(axis=1) / (differences**2).sum(axis=1) ** 2).max()
    assert readout.excess_kurtosis == pytest.approx(observer.noise_excess_kurtosis * share, rel=1e-9)


@pytest.mark.parametrize(("name", "variant"), [*VARIANTS, *NOT_LINEAR], ids=str)
def test_a_turned_image_has_the_turned_activity(name: str, variant: dict) -> None:
    observer = make(name, variant)
    image = np.random.default_rng(0).normal(size=(observer.grid(Stimulus(1.0)).side,) * 2)
    activity = observer.activity(image)
    for turns in range(1, 4):
        of_turned = observer.activity(np.rot90(image, -turns).copy())
        for band, turned in zip(of_turned, observer.turned(activity, turns), strict=True):
            assert np.allclose(band, turned, rtol=0.0, atol=1e-13 * np.abs(band).max())


@pytest.mark.parametrize("size_samples", [0.01, 0.3, 0.5698])
@pytest.mark.parametrize("polarity", [1, -1])
def test_a_triangle_within_one_sample_looks_the_same_to_all_templates(size_samples: float, polarity: int) -> None:
    """Exactly: rounding of what all four have in common must not be taken for a difference."""
    observer = PyramidObserver(PyramidSettings(retina_pitch_mrad=1.0))
    readout = observer.readout(Stimulus(size_samples, polarity))
    assert not readout.deviations.any() and not readout.noise_covariance.any()
    assert readout.common.any()


@pytest.mark.slow
def test_more_bands_and_a_wider_field_change_nothing_that_matters() -> None:
    """What PyramidObserver.grid leaves out, against two octaves more, at the worst sizes for its rule."""
    for samples in (2.0, 17.5, 35.0):
        size = samples * 0.153
        chosen = PyramidObserver().grid(Stimulus(size)).side
        wide = PyramidSettings(levels=(chosen - 1).bit_length() - 1)
        few = contrast_threshold(PyramidObserver(), size_mrad=size).threshold
        many = contrast_threshold(PyramidObserver(wide), size_mrad=size).threshold
        assert few == pytest.approx(many, rel=1e-5)


def test_literal_noise_is_on_every_neuron(observer: PyramidObserver) -> None:
    """Scores with noise less scores without are the templates' inner products with the same uniform draws."""
    stimulus, half_width = Stimulus(1.0), observer.settings.internal_noise / 2.0
    side = observer.grid(stimulus).side
    seen = np.random.default_rng(0).normal(size=(side, side))
    noisy = observer.literal_scores(seen, stimulus, np.random.default_rng(3))
    templates = flat_templates(observer, stimulus)
    noise = np.random.default_rng(3).uniform(-half_width, half_width, templates.shape[1])
    assert np.allclose(noisy - observer.literal_scores(seen, stimulus), templates @ noise, rtol=0.0, atol=1e-12)


def test_naked_eye_at_one_mrad() -> None:
    """0.1462 at internal noise 0.5 by brute force in independent code; asked for within 0.5 %."""
    found = contrast_threshold(PyramidObserver(), size_mrad=1.0)
    assert found.status == "ok"
    assert found.threshold == pytest.approx(0.1462, rel=0.005)
    assert found.numerical_error < 0.001 * found.threshold


def test_acuity_inverts_the_contrast_threshold() -> None:
    observer = PyramidObserver()
    contrast = contrast_threshold(observer, size_mrad=0.7).threshold
    assert acuity(observer, contrast=contrast).threshold == pytest.approx(0.7, rel=1e-3)


def test_criterion_is_met_at_the_threshold() -> None:
    found = contrast_threshold(PyramidObserver(), size_mrad=1.0, p_correct=0.9)
    at = proportion_correct(PyramidObserver(), size_mrad=1.0, contrast=found.threshold, nodes=32)
    assert at == pytest.approx(0.9, abs=5e-4)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("pyramid", {"centre": "apex"}, "centre: found 'apex'"),
        ("pyramid", {"retina_pitch_mrad": 0.0}, "retina_pitch_mrad: found 0.0, expected a number from 1e-06"),
        ("pyramid", {"band_noise": (1.0, 0.0)}, r"band_noise\[1\]: found 0\.0, expected a number from 0\.001"),
        ("pyramid", {"band_noise": (1.0,) * 12}, "band_noise: found .*, expected a list of at most 11 values"),
        ("pyramid", {"include_residual": "no"}, "include_residual: found 'no', expected true or false"),
        ("pyramid", {"age_years": 10.0}, "age_years: found 10.0, expected a number from 20 to 83"),
        ("pyramid", {"pupil_mm": 0.1}, r"pupil_mm: found 0\.1, expected a number from 1\.5 to 8"),
        ("informative", {"informative_share": 0.0}, "informative_share: found 0.0, expected a number from 0.001"),
        ("oriented", {"orientations": 7}, "orientations: found 7, expected an even number"),
        ("oriented", {"wavelength_samples": 2.0}, r"wavelength_samples: found 2\.0, expected a number from 2\.5"),
        ("oriented", {"complex_cells": True, "phases": "odd"}, "phases: found 'odd' with complex_cells, expected"),
        ("csf", {"retina_pitch_mrad": 0.4}, r"found 0\.4, whose Nyquist frequency is 21\.8 cycles/deg"),
        ("csf", {"efficency": 2.0}, "unknown key 'efficency'; the nearest valid one is 'efficiency'"),
    ],
)
def test_bad_settings(name: str, changes: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        find_observer(name)(**changes)


def test_what_is_registered_and_cannot_be_loaded_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = EntryPoint("lost", "no_such_module:Lost", ENTRY_POINT_GROUP)
    known = EntryPoint("known", "todframes.observers.csf:CsfObserver", ENTRY_POINT_GROUP)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: [known, lost])
    assert observers_with("efficiency") == ["known"]
    for find in (find_observer, lambda name: find_scenes([name])):
        with pytest.raises(SettingsError, match=r"'lost' cannot be loaded \(No module named 'no_such_module'\)"):
            find("lost")


def test_too_large_a_triangle_says_so() -> None:
    with pytest.raises(SettingsError, match=r"^size_mrad: found 1000 mrad at the eye, expected at most 348\.2"):
        PyramidObserver().grid(Stimulus(1000.0))


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan])
def test_naked_eye_bad_size(size: float) -> None:
    with pytest.raises(SettingsError, match="size_mrad: found"):
        contrast_threshold(PyramidObserver(), size_mrad=size)
