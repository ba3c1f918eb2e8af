"""Whole datasets: what must not change the result does not, and thresholds are those of the closed form."""

from __future__ import annotations

import numpy as np
import pytest

from todframes.base.errors import SettingsError
from todframes.diagnosis.locate import locate_triangles
from todframes.frames.dataset import Experiment, load_dataset
from todframes.frames.files import read_frame, write_frame
from todframes.observers.interface import Observer
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.score import score_dataset, settings_of_experiment
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage

FAST = FitSettings(resamples=0)
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


def test_a_trial_draws_the_same_whatever_else_is_scored(make_dataset) -> None:
    made = make_dataset(repeats=2)
    whole = score(made.path, PyramidObserver(), decisions="sampled", seed=3)
    made.rows[5]["orientation"] = "?"
    made.save()
    fewer = score(made.path, PyramidObserver(), decisions="sampled", seed=3, skip_bad_frames=True)
    kept = [number for number in range(16) if number != 5]
    assert np.array_equal(fewer.displacement_samples, whole.displacement_samples[kept])
    assert np.array_equal(fewer.answers, whole.answers[kept])
    other = score(made.path, PyramidObserver(), decisions="sampled", seed=4, skip_bad_frames=True)
    assert not np.array_equal(other.displacement_samples, fewer.displacement_samples)


def test_displacements_fill_half_a_sample_either_way(make_dataset) -> None:
    displacement = score(make_dataset(repeats=6).path, PyramidObserver()).displacement_samples
    assert np.abs(displacement).max() <= 0.5
    # The largest of 96 uniform draws is below 0.45 once in 25,000 times.
    assert np.abs(displacement).max() > 0.45


def test_frames_of_a_trial_are_averaged_in_contrast(make_dataset) -> None:
    made = make_dataset(contrasts=(0.1, 0.4))
    single = score(made.path)
    for number, row in enumerate(made.rows):
        row |= {"trial": f"t{number % 4}", "contrast": "0.25"}
    made.save()
    averaged = score(made.path)
    assert np.allclose(averaged.scores, (single.scores[:4] + single.scores[4:]) / 2, rtol=0.0, atol=1e-13)


def test_polarity(make_dataset) -> None:
    made = make_dataset(contrasts=(0.25,))
    bright = score(made.path)
    for number, row in enumerate(made.rows):
        row["polarity"] = "-1"
        luminance = read_frame(made.frame(number)).values[..., 0]
        write_frame(made.frame(number), 100.0 - luminance)
    made.save()
    dark = score(made.path)
    # 50 · (1 ± 0.25 · coverage) rounded to half floats: within 2⁻¹² of 1.25 in contrast.
    assert np.allclose(dark.scores, bright.scores, rtol=1e-3, atol=1e-3)


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


def test_only_the_light_counts_not_the_file(make_dataset) -> None:
    exr = score(make_dataset("exr", contrasts=(0.25, 0.5)).path)
    png = score(make_dataset("png", contrasts=(0.25, 0.5), suffix=".png").path)
    # Half floats near 64 are 2⁻⁵ apart, 6e-4 of the background; some 60 pixels of the triangle's edge are rounded
    # independently, the inside not at all (62.5 and 75 are exact).
    assert np.allclose(exr.scores, png.scores, rtol=0.0, atol=2e-3)


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


def test_sampled_answers_are_right_as_often_as_expected(make_dataset) -> None:
    made = make_dataset(contrasts=(0.04, 0.08), repeats=40)
    expected = score(made.path, PyramidObserver())
    sampled = score(made.path, PyramidObserver(), decisions="sampled")
    assert set(np.unique(sampled.p_correct)) <= {0.0, 1.0}
    assert np.array_equal(
        sampled.p_correct == 1.0, sampled.answers == [t.orientation.quarter_turns for t in sampled.trials]
    )
    standard_error = np.sqrt((expected.p_correct * (1 - expected.p_correct)).sum())
    # Five standard errors, and the bound on what the Gaussian leaves out for each trial.
    bound = 5 * standard_error + len(expected.trials) * expected.fits[0].non_gaussian_bound
    assert abs(sampled.p_correct.sum() - expected.p_correct.sum()) < bound


class Guesser(Observer):
    def grid(self, stimulus: Stimulus):
        return STEADY.grid(stimulus)

    def respond(self, contrast: np.ndarray, stimulus: Stimulus, rng: np.random.Generator):
        del contrast, stimulus
        return ORIENTATIONS[rng.integers(4)]


def test_frames_smaller_than_the_field_go_on_as_background(make_dataset) -> None:
    """The retina grid is 10 mrad wide here; what lies off a small frame has no contrast."""
    small = score(make_dataset("small", side_px=16, sizes_mrad=(1.0,)).path)
    large = score(make_dataset("large", side_px=64, sizes_mrad=(1.0,)).path)
    assert np.allclose(small.scores, large.scores, rtol=0.0, atol=1e-12)


def test_given_position_is_used(make_dataset) -> None:
    made = make_dataset(contrasts=(0.2,))
    middle = score(made.path)
    for number, row in enumerate(made.rows):
        moved = np.roll(read_frame(made.frame(number)).values[..., 0], (3, -5), axis=(0, 1))
        write_frame(made.frame(number), moved)
        row |= {"x_px": str(23.5 - 5), "y_px": str(23.5 + 3)}
    made.save()
    assert np.allclose(score(made.path).scores, middle.scores, rtol=0.0, atol=1e-12)


def test_bounding_box_observer_looks_at_the_middle_of_the_box(make_dataset) -> None:
    """Templates and triangle coincide again: plain triangles are answered as surely as by the other observer."""
    made = make_dataset(contrasts=(0.2,), side_px=49)
    for row in made.rows:
        row |= {"x_px": "24", "y_px": "24"}  # of the centroid
    made.save()
    path = made.path
    by_box = score(path, BY_BOX)
    assert np.array_equal(by_box.answers, range(4))
    assert np.allclose(by_box.p_correct, by_box.p_correct[0], atol=2e-3)
    # Displaced towards their apexes the triangles differ more: easier to tell apart.
    assert by_box.p_correct.min() > score(path).p_correct.max()


def test_the_curve_is_the_observer_s_for_its_probabilities_only(make_dataset) -> None:
    path = make_dataset(contrasts=(0.03, 0.06, 0.12, 0.25), repeats=3).path
    names = {("expected", None): "observer", ("expected", "weibull"): "weibull", ("sampled", None): "weibull"}
    fits = {}
    for (decisions, asked), name in names.items():
        (group,) = score(path, PyramidObserver(), decisions=decisions, curve=asked).fits
        assert group.fit.curve == name
        fits[decisions, asked] = group.fit
    own, weibull = fits["expected", None], fits["expected", "weibull"]
    assert own.weibull_threshold == weibull.threshold
    assert own.threshold != weibull.threshold
    assert (own.alpha, own.beta, own.lapse_rate) == (weibull.alpha, weibull.beta, weibull.lapse_rate)
    with pytest.raises(SettingsError, match=r"curve: found 'observer' with sampled decisions, expected 'weibull'"):
        score(path, PyramidObserver(), decisions="sampled", curve="observer")
    with pytest.raises(SettingsError, match="this observer is not linear"):
        score(path, Guesser(), curve="observer")


def test_levels_of_size_give_the_acuity(make_dataset) -> None:
    by_size = {"level": "size_mrad", "group_by": []}
    made = make_dataset(sizes_mrad=(0.9, 1.2, 1.7, 2.4), contrasts=(0.1,), repeats=2, experiment=by_size)
    (fit,) = score(made.path, PyramidObserver(), tolerance=0.5).fits
    assert fit.group == () and 0.0 < fit.numerical_error <= 0.5 * fit.fit.threshold
    assert fit.fit.status == "ok"
    assert 1.2 < fit.fit.threshold < 2.4
    assert fit.fit.observer_curve.beta > 1.3  # larger triangles are clearer by more than their size
    assert [point.level for point in fit.fit.points] == [0.9, 1.2, 1.7, 2.4]


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
