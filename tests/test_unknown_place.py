"""Decision at an unknown place: published d′, independent integration, noise drawn on scores and on neurons."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import DatasetMaker
from scipy.optimize import brentq

import todframes as tod
from todframes.base.errors import FrameError, SettingsError
from todframes.frames.dataset import load_dataset
from todframes.observers.csf import CsfObserver, CsfSettings
from todframes.observers.decision import answer_probabilities
from todframes.observers.hotelling import HotellingObserver
from todframes.observers.interface import Observer, joint_noise_covariance
from todframes.observers.internal_noise import inner_product
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.unknown_place import drawn_answers, unknown_place_probabilities
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.retina_view import read_trial, retina_image
from todframes.scoring.score import score_dataset
from todframes.stimulus import Stimulus

SMALL = Stimulus(1.0)


def correct(d_prime: float, places: int) -> float:
    score = np.zeros((2, 4))
    score[0, 1] = d_prime
    found = unknown_place_probabilities(score[: min(places, 2)], np.eye(4), empty_places=max(places - 2, 0))
    return float(found.probability[1])


def drawn(score: np.ndarray, covariance: np.ndarray, n: int, seed: int = 1) -> np.ndarray:
    """How often each orientation has the largest of all scores, (trial, 4), by `n` draws."""
    n_places = score.shape[1]
    noise = np.random.default_rng(seed).multivariate_normal(
        np.zeros(4 * n_places), covariance.reshape(4 * n_places, -1), n, method="eigh"
    )
    rows = score.reshape(len(score), -1)
    return np.array([np.bincount((row + noise).argmax(axis=1) % 4, minlength=4) / n for row in rows])


def some_scores(covariance: np.ndarray, n_places: int) -> np.ndarray:
    """Scores of three trials: a triangle pointing down at the second place, the others strewn by clutter."""
    strewn = np.random.default_rng(7).multivariate_normal(np.zeros(4), covariance / 4.0, (3, n_places))
    strewn[:, 1, 2] += np.array([0.5, 1.0, 2.0]) * math.sqrt(2.0 * (covariance[0, 0] - covariance[0, 1]))
    strewn[:, 1] += 1.5 * math.sqrt(covariance[0, 0])
    return strewn


@pytest.mark.parametrize(("places", "d_prime"), [(1, 1.682), (4, 2.285), (16, 2.819), (64, 3.286), (256, 3.701)])
def test_d_prime_at_75_per_cent(places: int, d_prime: float) -> None:
    found = brentq(lambda d: correct(d, places) - 0.75, 0.5, 6.0, xtol=1e-6)
    assert found == pytest.approx(d_prime, abs=5.1e-4)  # three decimals of the table, rounded


def test_one_place_is_a_known_place() -> None:
    readout = PyramidObserver().readout(SMALL)
    score = some_scores(readout.full_covariance, 2)[:, 1:]
    found = unknown_place_probabilities(score, readout.full_covariance)
    assert found.probability == pytest.approx(
        answer_probabilities(score[:, 0], readout.noise_covariance), abs=1e-8
    )
    assert not found.standard_error.any()


@pytest.mark.parametrize("correlation", [0.0, 0.1, 0.6])
def test_probabilities_and_answers_as_often_as_drawn(correlation: float) -> None:
    covariance, n = PyramidObserver().readout(SMALL).full_covariance, 40_000
    along = correlation ** np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    score, joint = some_scores(covariance, 4), np.einsum("mn,jk->mjnk", along, covariance)
    noise = joint if correlation else covariance
    found = unknown_place_probabilities(score, noise)
    assert (found.standard_error.max() > 0.0) == (correlation > 0.0)
    assert found.standard_error.max() < 0.0014
    error = np.sqrt(0.25 / n + found.standard_error**2)
    assert (np.abs(drawn(score, joint, n, seed=2) - found.probability) / error).max() < 3.0
    n, expected = 4000, found.probability[1]
    answers = drawn_answers(np.tile(score[1], (n, 1, 1)), noise, [np.random.default_rng(6)] * n)
    error = np.sqrt(expected * (1.0 - expected) / n + found.standard_error[1] ** 2)
    assert (np.abs(np.bincount(answers, minlength=4) / n - expected) / error).max() < 3.0


def test_without_noise_the_largest_is_answered_and_equals_share() -> None:
    score = np.array([[[0.0, 1.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.2, 0.0]]])
    found = unknown_place_probabilities(score, np.zeros((4, 4))).probability
    assert found[0] == pytest.approx([1 / 3, 2 / 3, 0.0, 0.0])


@pytest.mark.parametrize(
    ("score", "covariance", "message"),
    [
        (np.zeros(4), np.eye(4), r"score has shape \(4,\)"),
        (np.full((2, 4), np.nan), np.eye(4), "score: found a value that is not finite"),
        (np.zeros((2, 4)), np.eye(8), r"covariance has shape \(8, 8\), expected \(4, 4\) or \(2, 4, 2, 4\)"),
        (np.zeros((2, 4)), np.diag([1.0, 1.0, 1.0, 1e-6]), "expected about the same of all four"),
        (np.zeros((2, 4)), np.diag(np.r_[np.ones(4), 2.0 * np.ones(4)]).reshape(2, 4, 2, 4), "places that differ"),
        (
            np.zeros((2, 4)),
            np.kron([[1, -1.5], [-1.5, 1]], np.eye(4)).reshape(2, 4, 2, 4),
            r"value of -0\.5, exp",
        ),
    ],
)
def test_bad_scores_and_covariances(score: np.ndarray, covariance: np.ndarray, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        unknown_place_probabilities(score, covariance)


@pytest.mark.parametrize("kind", [PyramidObserver, HotellingObserver, CsfObserver])
def test_the_covariance_of_four_scores_is_that_of_their_templates(kind: type) -> None:
    observer = kind(retina_pitch_mrad=0.2)
    templates = observer.templates(SMALL)
    products = [[sum(map(inner_product, one, other)) for other in templates] for one in templates]
    expected = observer.settings.noise_sd**2 * np.array(products)
    assert observer.readout(SMALL).full_covariance == pytest.approx(expected, rel=1e-9, abs=1e-9 * expected[0, 0])


def test_places_share_noise_if_one_pyramid_sees_both() -> None:
    """Templates of both places on the neurons of a wider pyramid, where no grid ends near them."""
    observer, offset = PyramidObserver(position_jitter_samples=0.0), (1.4, 0.0)
    wide = observer.with_extra_level()
    pitch, side = wide.settings.retina_pitch_mrad, wide.grid(SMALL).side
    (upright, *_), shift = (
        wide.templates(SMALL),
        round(1.4 / pitch / 8) * 8,
    )  # 8 samples: whole steps in three bands
    moved = tuple(np.roll(band, shift // 2**level, axis=1) for level, band in enumerate(upright[:4]))
    expected = sum(map(inner_product, upright, moved)) * observer.settings.noise_sd**2
    found = observer.noise_between_places(SMALL, (shift * pitch, 0.0))[0, 0]
    assert side > 2 * shift
    # The coarsest bands move by less than a step of theirs: they hold some per cent of the product.
    assert found == pytest.approx(expected, abs=0.01 * observer.readout(SMALL).full_covariance[0, 0])
    near, far = ([(0.0, 0.0), (distance, 0.0)] for distance in (offset[0], 3.0))
    assert joint_noise_covariance(observer, observer.readout(SMALL), SMALL, near) is not None
    assert joint_noise_covariance(observer, observer.readout(SMALL), SMALL, far) is None
    with pytest.raises(SettingsError, match=r"places: found 257 at a distance of 0\.01 mrad, .*at most 256"):
        joint_noise_covariance(observer, observer.readout(SMALL), SMALL, [(0.01 * k, 0.0) for k in range(257)])


def test_each_pair_of_places_has_its_covariance() -> None:
    """Rows are scores here, columns those there; the offset points from here to there."""
    own, skew = np.eye(4), np.arange(16.0).reshape(4, 4) / 100.0

    def between(_: Stimulus, offset: tuple[float, float]) -> np.ndarray:
        return (offset[0] + 10.0 * offset[1]) * skew

    places, readout = [(0.0, 0.0), (0.3, 0.0), (0.1, 0.2)], SimpleNamespace(full_covariance=own)
    joint = joint_noise_covariance(SimpleNamespace(noise_between_places=between), readout, SMALL, places)
    for here, there in ((1, 0), (2, 0), (2, 1)):
        x, y = np.subtract(places[there], places[here])
        assert joint[here, :, there] == pytest.approx((x + 10.0 * y) * skew)
        assert joint[there, :, here] == pytest.approx(joint[here, :, there].T)
    assert all((joint[n, :, n] == own).all() for n in range(3))
    small = SimpleNamespace(noise_between_places=lambda *_: np.full((4, 4), 0.01))
    assert joint_noise_covariance(small, readout, SMALL, places) is None
    assert joint_noise_covariance(small, readout, SMALL, places[:1]) is None


def placed(
    make_dataset: DatasetMaker,
    name: str = "dataset",
    *,
    step_px: str = "12",
    x_px: str = "24",
    places: int = 4,
    contrasts: tuple[float, ...] = (0.05, 0.2),
    **changes: str,
):
    """A dataset with triangles at the first of 2 × 2 places, 12 pixels or 3 mrad apart."""
    row = {"x_px": x_px, "y_px": "24", "place": "1", "place_step_px": step_px} | changes
    return make_dataset(
        name,
        sizes_mrad=(2.0,),
        contrasts=contrasts,
        side_px=49,
        experiment={"places": places},
        row_changes=dict.fromkeys(range(8), row),
    )


def answered(observer: Observer, path, n: int) -> np.ndarray:
    """How often each trial is answered correctly, noise being drawn on every neuron at every place."""
    data, rng, found = load_dataset(path), np.random.default_rng(3), []
    for trial in data.trials.select([0, 3, 5]):
        grid = observer.grid(trial.stimulus)
        step = trial.place_step_px * data.display.pitch_mrad / grid.pitch_mrad
        offsets = [(x * step, y * step) for y in (0, 1) for x in (0, 1)]
        shown = read_trial(data, trial, observer, grid, offsets)
        images = [retina_image(shown, grid, offset) for offset in offsets]
        right = 0
        for _ in range(n):
            scores = [observer.literal_scores(image, trial.stimulus, rng) for image in images]
            right += int(np.argmax(scores)) % 4 == trial.orientation.quarter_turns
        found.append(right / n)
    return np.array(found)


@pytest.mark.parametrize("kind", [PyramidObserver, CsfObserver])
def test_a_dataset_with_places_against_noise_on_every_neuron(make_dataset: DatasetMaker, kind: type) -> None:
    made = placed(make_dataset)
    observer = kind(retina_pitch_mrad=0.2, position_jitter_samples=0.0)
    scored, n = score_dataset(load_dataset(made.path), observer), 120
    often, expected = answered(observer, made.path, n), scored.p_correct[[0, 3, 5]]
    assert 0.3 < expected[:2].mean() < 0.9
    error = np.sqrt(np.maximum(expected * (1 - expected), 0.01) / n)
    assert (np.abs(often - expected) / error).max() < 3.0


def test_more_places_need_more_contrast(make_dataset: DatasetMaker) -> None:
    made = placed(make_dataset)
    found = score_dataset(load_dataset(made.path), PyramidObserver())
    known = score_dataset(load_dataset(placed(make_dataset, name="known", places=1).path), PyramidObserver())
    assert found.scores == pytest.approx(known.scores, rel=1e-3, abs=1e-3 * np.abs(known.scores).max())
    # 1.5 sizes apart, neurons see two places.
    assert 0.0 < found.fits[0].places_error < 0.0014
    assert known.fits[0].places_error is None
    assert "any of 4 places" in found.plan[0].why


def test_drawn_answers_of_a_dataset_with_places(make_dataset: DatasetMaker) -> None:
    """Of many seeds as many answers are right as is expected, and a trial has the same noise in each way shown."""
    made = load_dataset(placed(make_dataset).path)
    observer = CsfObserver(retina_pitch_mrad=0.2)
    expected = score_dataset(made, observer).p_correct
    quick = FitSettings(resamples=0)
    drawn = [
        score_dataset(made, observer, decisions="sampled", seed=seed, fit_settings=quick) for seed in range(10)
    ]
    share = np.mean([one.p_correct for one in drawn], axis=0)
    assert set(np.unique(drawn[0].p_correct)) <= {0.0, 1.0} and np.isfinite(drawn[0].answers).all()
    error = np.sqrt(np.maximum(expected * (1.0 - expected), 0.01) / len(drawn))
    assert (np.abs(share - expected) / error).max() < 3.3  # the worst of eight
    again = score_dataset(made, observer, decisions="sampled", seed=3, fit_settings=quick)
    assert np.array_equal(again.answers, drawn[3].answers)
    result = tod.compare(made, [lambda image: image], observer=observer, decisions="sampled", rng=3, white=100.0)
    none, same = result.algorithms
    assert [point.p_correct for point in none.fits[0].points] == [
        float(again.p_correct[made.trials.levels == level].mean()) for level in (0.05, 0.2)
    ]
    assert same.fits[0].points == none.fits[0].points


def test_what_cannot_be_done_with_places(make_dataset: DatasetMaker) -> None:
    made = load_dataset(placed(make_dataset).path)
    with pytest.raises(
        SettingsError, match="observer: it is not linear, and the triangle may be at any of 4 places"
    ):
        score_dataset(made, OrientedObserver(complex_cells=True), decisions="sampled")
    off = load_dataset(placed(make_dataset, name="off", step_px="40").path)
    with pytest.raises(FrameError, match=r"a triangle at place 2 reaches from .* off the frame"):
        score_dataset(off, PyramidObserver())


def test_a_missing_threshold_at_an_unknown_place_is_explained(make_dataset: DatasetMaker) -> None:
    """By the answers alone: no place is looked for."""
    made = placed(make_dataset, contrasts=(0.3, 0.5))
    for row in made.rows:
        row["orientation"] = {"up": "down", "down": "up", "left": "right", "right": "left"}[row["orientation"]]
    made.save()
    result = tod.score(made.path, examples=False)
    assert result.thresholds[0].status == "never_reached"
    (hint,) = [one for one in result.warnings if "of the answers" in one.message]
    assert hint.code == "turned" and "turned by 180" in hint.message


def test_naked_eye_at_an_unknown_place() -> None:
    """The observer for people at one position: its threshold is where the closed decision says."""
    observer = CsfObserver(CsfSettings(retina_pitch_mrad=0.2))
    found = contrast_threshold(observer, size_mrad=3.0, places=9).threshold
    known = contrast_threshold(observer, size_mrad=3.0).threshold
    readout = observer.readout(Stimulus(3.0))
    covariance, (score, *_) = readout.full_covariance, observer.templates(Stimulus(3.0))
    signal = np.array([inner_product(one, score[0]) for (one,) in observer.templates(Stimulus(3.0))])
    scores = np.zeros((1, 9, 4))
    scores[0, 0] = found * signal
    assert found > known  # by 0.3 % only: to see that a triangle is there takes less than to see how it points
    assert unknown_place_probabilities(scores, covariance).probability[0, 0] == pytest.approx(0.75, abs=1e-3)
    assert tod.naked_eye(size_mrad=3.0, observer=observer, places=9).thresholds[0].threshold == found
    assert tod.naked_eye(size_mrad=3.0, observer=observer, places=2).settings["places"] == 2
    with pytest.raises(SettingsError, match="places: found 0, expected"):
        tod.naked_eye(size_mrad=3.0, places=0)
