"""Whole datasets: what must not change the result does not, and thresholds are those of the closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from todframes.base.errors import SettingsError
from todframes.diagnosis.locate import locate_triangles
from todframes.frames.dataset import Experiment, load_dataset
from todframes.frames.files import read_frame, write_frame
from todframes.frames.trials import Trial, Trials
from todframes.observers.interface import Observer, observer_named
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.score import (
    _displacement_error,
    _displacements_needed,
    groups_of,
    score_dataset,
    settings_of_experiment,
)
from todframes.scoring.trial_scores import Scoring, TrialScore, TrialScores, _displacements, score_trial
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage

FAST = FitSettings(resamples=0)
ROOT = Path(__file__).parents[2]
STEADY = PyramidObserver(PyramidSettings(position_jitter_samples=0.0))


def score(path, observer=STEADY, **arguments):
    return score_dataset(load_dataset(path), observer, fit_settings=FAST, **arguments)


def test_every_orientation_is_seen_alike(make_dataset) -> None:
    """A square frame, the triangle in its middle: four orientations are one frame turned."""
    scored = score(make_dataset(side_px=49, contrasts=(0.1,)).path)
    for turns, scores in enumerate(scored.scores):
        # Half-float frames are turned exactly, display pixels fall on the retina alike: rounding is left.
        assert np.allclose(scores, np.roll(scored.scores[0], turns), rtol=0.0, atol=1e-12)
    assert np.array_equal(scored.answers, range(4))
    assert np.allclose(scored.p_correct, scored.p_correct[0], atol=1e-10)


class Guesser(Observer):
    position_jitter_samples = 0.5

    def grid(self, stimulus: Stimulus):
        return STEADY.grid(stimulus)

    def respond(self, contrast: np.ndarray, stimulus: Stimulus, rng: np.random.Generator):
        del contrast, stimulus
        return ORIENTATIONS[rng.integers(4)]


def test_a_trial_has_a_displacement_and_an_answer_of_its_own_stream(make_dataset) -> None:
    """Whatever else is scored. It is uniform in half a sample either way; the answer's numbers come after it."""
    made = make_dataset(row_changes={2: {"orientation": "?"}})
    scored = score(made.path, Guesser(), decisions="sampled", seed=3, skip_bad_frames=True)
    for number, displacement, answer in zip(
        [0, 1, 3, 4, 5, 6, 7], scored.displacement_samples, scored.answers, strict=True
    ):
        rng = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0, number)))
        assert (displacement.tolist(), answer) == ((rng.random(2) - 0.5).tolist(), rng.integers(4))


def test_several_displacements_are_replicates_of_a_published_sequence() -> None:
    """Roberts 2018: steps of 1/φ and 1/φ² with φ = 1.32471795724, modulo the range from -j to j."""
    at: Any = SimpleNamespace(seed=3, displacements=5)
    trial: Any = SimpleNamespace(number=7)
    samples = _displacements(at, trial, 0.3)
    assert samples.shape == (8 * 5, 2) and np.abs(samples).max() <= 0.3
    steps = np.diff(samples.reshape(8, 5, 2), axis=1) / 0.6 % 1.0
    assert steps == pytest.approx(np.broadcast_to(1.32471795724475 ** -np.arange(1.0, 3.0), (8, 4, 2)), abs=1e-12)
    assert len(np.unique(samples[::5])) == 16


@pytest.mark.parametrize(
    ("error", "threshold", "needed"),
    [
        (None, 2.0, 1),
        (0.5, None, 1),
        (0.0199, 2.0, 1),
        (0.02, 2.0, 1),
        (0.0201, 2.0, 2),
        (0.04, 2.0, 5),
        (1.0, 2.0, 64),
    ],
)
def test_displacements_that_a_tolerance_takes(error: float | None, threshold: float | None, needed: int) -> None:
    """The error falls as 1/√n, with a margin of 10 % for n, at a tolerance of 1 %."""
    group: Any = SimpleNamespace(threshold_displacement_error=error, fit=SimpleNamespace(threshold=threshold))
    assert _displacements_needed(group, 0.01) == needed


def test_a_group_whose_error_is_too_large_is_seen_again(make_dataset) -> None:
    made = load_dataset(make_dataset(sizes_mrad=(2.0, 3.0), contrasts=(0.1, 0.2, 0.4), side_px=24).path)
    made = replace(made, trials=made.trials.select(np.arange(0, 24, 4)))
    observer = PyramidObserver(retina_pitch_mrad=0.5)
    once, closer = (score_dataset(made, observer, fit_settings=FAST, tolerance=t) for t in (0.5, 0.04))
    assert [[fit.n_displacements for fit in scored.fits] for scored in (once, closer)] == [[8, 8], [24, 8]]
    assert once.fits[0].threshold_displacement_error > 0.04 * once.fits[0].fit.threshold
    assert 0.0 < closer.fits[0].threshold_displacement_error <= 0.04 * closer.fits[0].fit.threshold
    assert closer.fits[1] == once.fits[1]
    assert np.array_equal(closer.p_correct[3:], once.p_correct[3:])
    assert closer.p_correct == pytest.approx(once.p_correct, abs=0.03)


def test_the_error_of_a_threshold_is_that_of_its_replicates() -> None:
    """Weibull curves of eight thresholds, each the mean of two displacements."""
    thresholds = np.array([0.98, 1.0, 1.01, 0.99, 1.02, 1.0, 0.97, 1.03])
    level = np.geomspace(0.3, 3.0, 9)
    p = 0.25 + 0.74 * -np.expm1(-((level[:, None] / thresholds) ** 2.0))
    p_each = np.stack([p + 0.01, p - 0.01], axis=2).reshape(9, 16)
    settings, rng = FitSettings(lapse_rate=0.01), np.random.default_rng(0)
    fit = fit_trials(level, p.mean(axis=1), curve="weibull", settings=FAST, rng=rng)
    crossing = thresholds * np.sqrt(np.log(0.74 / 0.24))  # where 0.25 + 0.74 (1 − exp(−x²)) is 0.75
    student = stats.t.ppf(0.9875, 7) * stats.sem(crossing)
    assert _displacement_error(level, p_each, fit, settings) == pytest.approx(student, rel=1e-3)
    assert _displacement_error(level, p_each[:, :7], fit, settings) is None
    p_each[:, :2] = 0.3  # a replicate without a threshold
    assert _displacement_error(level, p_each, fit, settings) is None


def test_groups_have_their_light_and_negative_pixels_and_stand_numbers_first(make_dataset) -> None:
    """Trials of two frames, whose backgrounds are 50, 51, 52 … cd/m²."""
    column = {"background_luminance_cd_m2": "column"}
    made = make_dataset(side_px=32, repeats=2, display=column, experiment={"group_by": ["eye"]})
    for number, row in enumerate(made.rows):
        row |= {"trial": f"t{number // 2}", "eye": ("right", "2", "left", "10")[number // 4]}
        row["background_luminance_cd_m2"] = str(50.0 + number)
    luminance = read_frame(made.frame(5)).values[..., 0]
    luminance[0, :3] = -1.0
    write_frame(made.frame(5), luminance)
    made.save()
    scored = score(made.path, plan="full")
    assert scored.n_negative == 3
    lights = [(fit.group, fit.background_luminance_cd_m2) for fit in scored.fits]
    assert lights == [((2.0,), 55.5), ((10.0,), 63.5), (("left",), 59.5), (("right",), 51.5)]


def test_scores_after_a_gain_of_contrast() -> None:
    """One gain a trial; what does not come from contrast stays. The second of three trials cannot be read."""
    trial = Trial(0, "", (), ORIENTATIONS[0], Stimulus(1.0), 0.1, (), None, None)
    seen = TrialScores(Trials.of([trial._replace(number=number) for number in range(3)]))
    by_template = np.ones((1, 4))
    for row in (2, 0):
        scores = (row * by_template, 10.0 * row * by_template, row * by_template)
        seen.put(row, TrialScore(np.ones((1, 2)), *scores, 2, 1, 50.0))
    usable = seen.usable()
    loud = usable.amplified(np.array([2.0, 5.0]))
    assert (usable.trials.numbers.tolist(), len(seen), loud.usable() is loud) == ([0, 2], 3, True)
    first = [0.0] * 4
    assert loud["scores"].tolist() == [[first], [[10.0] * 4]]
    assert loud["deviations"].tolist() == [[first], [[100.0] * 4]]
    assert all(np.array_equal(loud[name], usable[name]) for name in ("probabilities", "answer"))
    assert usable["scores"].tolist() == [[first], [[2.0] * 4]]


def test_frames_of_a_trial_are_averaged_in_contrast(make_dataset) -> None:
    made = make_dataset(contrasts=(0.1, 0.4))
    single = score(made.path)
    for number, row in enumerate(made.rows):
        row |= {"trial": f"t{number % 4}", "contrast": "0.25"}
    made.save()
    averaged = score(made.path)
    assert np.allclose(averaged.scores, (single.scores[:4] + single.scores[4:]) / 2, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("rule", ["surround", "border", "frame_mean", "column"])
def test_background_rules(make_dataset, rule: str) -> None:
    made = make_dataset(side_px=80, contrasts=(0.2,))
    known = score(made.path)
    made.toml["display"]["background_luminance_cd_m2"] = rule
    for number, row in enumerate(made.rows):
        luminance = read_frame(made.frame(number)).values[..., 0]
        factor = 2.0**number
        if rule == "frame_mean":
            luminance *= 50.0 / luminance.mean()
        if rule == "column":
            row["background_luminance_cd_m2"] = repr(50.0 * factor)
        write_frame(made.frame(number), luminance * factor, pixel_type="float")
    made.save()
    found = score(made.path)
    # The mean of an 80-pixel frame is 1.002 backgrounds; the rest is rounding to float.
    assert np.allclose(found.scores, known.scores, rtol=3e-3 if rule == "frame_mean" else 1e-6, atol=1e-6)


def test_threshold_is_the_closed_form_one(make_dataset) -> None:
    """A fine display, levels close about the threshold: the naked eye's threshold, from files."""
    size_mrad, pitch_mrad = 1.0, 0.153 / 7
    truth = contrast_threshold(PyramidObserver(), size_mrad=size_mrad).threshold
    made = make_dataset(contrasts=(), display={"pixel_pitch_mrad": pitch_mrad})
    side = 7 * 25
    for factor in (0.85, 1.0, 1.15):
        for orientation in ORIENTATIONS:
            triangle = coverage(
                (side, side), size_px=size_mrad / pitch_mrad, x_px=87.0, y_px=87.0, orientation=orientation
            )
            first = made.path / "first.exr"
            write_frame(first, 50.0 * (1.0 + factor * truth * triangle), pixel_type="float")
            for repeat in range(8):
                frame = f"frames/{factor}_{orientation}_{repeat}.exr"
                (made.path / frame).write_bytes(first.read_bytes())
                row = {"frame": frame, "orientation": orientation.value, "size_mrad": str(size_mrad)}
                made.rows.append(row | {"contrast": repr(factor * truth)})
    made.save()
    chosen = FitSettings(resamples=100)
    (fit,) = score_dataset(load_dataset(made.path), PyramidObserver(), fit_settings=chosen).fits
    assert fit.fit.status == "ok"
    low, high = fit.fit.threshold_ci95
    # 96 trials spread P by some 0.03 each, that is 0.003 in P and 0.3 % of the threshold for their mean; the
    # display's pixels are 7 to a retina sample. 1 % leaves room for three standard errors.
    assert fit.fit.threshold == pytest.approx(truth, rel=0.01)
    assert high - low < 0.02 * truth


def test_frames_smaller_than_the_field_go_on_as_background(make_dataset) -> None:
    """The retina grid is 10 mrad wide here; what lies off a small frame has no contrast."""
    small = score(make_dataset("small", side_px=16, sizes_mrad=(1.0,)).path)
    large = score(make_dataset("large", side_px=64, sizes_mrad=(1.0,)).path)
    assert np.allclose(small.scores, large.scores, rtol=0.0, atol=1e-12)


def test_the_curve_is_the_observer_s_for_its_probabilities_only(make_dataset) -> None:
    path = make_dataset(contrasts=(0.03, 0.06, 0.12, 0.25), repeats=3).path
    names = {("expected", None): "observer", ("expected", "weibull"): "weibull", ("sampled", None): "weibull"}
    fits = {}
    for (decisions, asked), name in names.items():
        (group,) = score(path, PyramidObserver(), decisions=decisions, curve=asked).fits
        assert group.fit.curve == name
        fits[decisions, asked] = group.fit
    own, weibull = fits["expected", None], fits["expected", "weibull"]
    assert own.threshold != weibull.threshold
    assert (own.alpha, own.beta, own.lapse_rate) == (weibull.alpha, weibull.beta, weibull.lapse_rate)
    with pytest.raises(SettingsError, match=r"curve: found 'observer' with sampled decisions, expected 'weibull'"):
        score(path, PyramidObserver(), decisions="sampled", curve="observer")
    with pytest.raises(SettingsError, match="this observer is not linear"):
        score(path, Guesser(), curve="observer")


def boxed(make_dataset, x_px: float, y_px: float, side_px: int = 64):
    """Triangles of all orientations whose bounding boxes have their centre in common; no positions given."""
    made = make_dataset(side_px=side_px, contrasts=(0.1, 0.2, 0.4))
    for number, row in enumerate(made.rows):
        at = {"size_px": 8.0, "x_px": x_px, "y_px": y_px, "orientation": Orientation(row["orientation"])}
        triangle = coverage((side_px, side_px), **at, centre="bounding_box")
        write_frame(made.frame(number), 50.0 * (1.0 + float(row["contrast"]) * triangle), pixel_type="float")
    return made


BY_BOX = PyramidObserver(PyramidSettings(centre="bounding_box", position_jitter_samples=0.0))


def test_bounding_boxes_are_located_as_such(make_dataset) -> None:
    made = boxed(make_dataset, 28.3, 33.8)
    data, (found,) = locate_triangles(load_dataset(made.path), centre="bounding_box")
    assert (found.x_px, found.y_px) == pytest.approx((28.3, 33.8), abs=0.02)
    scored = score_dataset(data, BY_BOX, fit_settings=FAST)
    centred = score(boxed(lambda **k: make_dataset("centred", **k), 31.5, 31.5).path, BY_BOX)
    assert np.array_equal(centred.answers, [0, 1, 2, 3] * 3)
    assert np.ptp(centred.p_correct[:4]) < 1e-9  # one frame, turned
    # The same triangles elsewhere on the pixels, of which a size has eight: that moves P by up to 0.03.
    assert np.allclose(scored.p_correct, centred.p_correct, atol=0.04)


def test_a_constant_frame_tells_nothing_even_without_noise(make_dataset) -> None:
    made = make_dataset(contrasts=(0.1,))
    for number in range(4):
        write_frame(made.frame(number), np.full((48, 48), 59.1), pixel_type="float")
    silent = PyramidObserver(PyramidSettings(internal_noise=0.0))
    assert np.allclose(score(made.path, silent).probabilities, 0.25, atol=1e-9)
    assert np.allclose(score(made.path).probabilities, 0.25, atol=1e-9)


@pytest.mark.parametrize(
    ("level", "expected"),
    [(one, 0.2) for one in ("contrast", "sent_contrast", "SNR", "delta_t_k", "delta_t_mk")]
    # A part of a name says nothing: d′ is not proportional to decibels or a logarithm.
    + [(one, None) for one in ("size_mrad", "snr_db", "log_contrast", "temperature")],
)
def test_a_slope_is_expected_of_levels_that_are_the_signal(level: str, expected: float | None) -> None:
    assert settings_of_experiment(None, Experiment(level=level)).slope_spread == expected


def test_scoring_is_one_loop_over_stimuli_and_trials() -> None:
    """The loop of the page on architecture, of the house's parts alone."""
    code = (
        (ROOT / "docs" / "reference" / "architecture.md")
        .read_text(encoding="utf-8")
        .split("```python\n")[1]
        .split("```")[0]
    )
    names: dict[str, Any] = {"Scoring": Scoring, "observer_named": observer_named, "groups_of": groups_of}
    names |= {"np": np, "load_dataset": load_dataset, "score_trial": score_trial}
    names |= {"fit_trials": fit_trials, "FitSettings": FitSettings}
    exec(code.replace("sample_frames", str(ROOT / "sample_frames")).replace("print(group,", "(group,"), names)
    scored = score_dataset(load_dataset(ROOT / "sample_frames" / "naked_eye"), PyramidObserver())
    assert names["p_correct"] == pytest.approx(scored.p_correct, rel=1e-12)
