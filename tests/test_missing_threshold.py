"""Explanations of missing thresholds: answers, hints at what would make them right, pictures of whole frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import triangles

import todframes as tod
from todframes.frames.dataset import Dataset
from todframes.results.data import ResultWarning
from todframes.results.result import read_result
from todframes.scoring import missing_threshold

SIZE_PX, SIDE_PX = 8.0, 64
MIDDLE, CENTRE = (SIDE_PX - 1) / 2, (SIDE_PX + triangles.WIDER - 1) / 2  # of rows and of columns
QUICK: dict[str, Any] = {"examples": False, "fit": tod.FitSettings(resamples=0)}


def recording(
    *, place: tuple[float, float] = (CENTRE, MIDDLE), levels: Sequence[float] = (0.1, 0.2, 0.3), **mishap: Any
) -> Dataset:
    """Frames of triangles that the dataset says are upright, bright, in the middle and of `SIZE_PX`."""
    return triangles.recording(np.random.default_rng(1), place, levels=levels, repeats=3, **mishap)[0]


def hints(result: tod.Result) -> list[ResultWarning]:
    """The warnings about what would make answers right; others come from the frames and the levels."""
    return [one for one in result.warnings if "would be right if" in one.message]


@pytest.mark.parametrize(
    ("mishap", "codes", "wanted"),
    [
        ({"shown": (0, 3, 2, 1)}, ["mirrored"], "if left and right were swapped. Is the camera mirrored?"),
        ({"shown": (2, 3, 0, 1)}, ["turned"], "turned by 180°. Is the camera upside down?"),
        ({"shown": (1, 2, 3, 0)}, ["turned"], "turned clockwise by 90°"),
        ({"sign": -1}, ["polarity_mismatch"], "polarity were -1. Are the triangles darker than the background?"),
        ({"sign": -1, "shown": (0, 3, 2, 1)}, ["polarity_mismatch", "mirrored"], "polarity were -1 and if left"),
    ],
)
def test_hint_names_what_the_answers_show(mishap: dict[str, Any], codes: list[str], wanted: str) -> None:
    result = tod.score(recording(levels=(0.2, 0.3), **mishap), **QUICK)
    assert result.fits[0].status == "never_reached"
    assert [one.code for one in hints(result)] == codes
    for warning in hints(result):
        assert wanted in warning.message
        assert warning.group == {"size_mrad": 2.0}


@pytest.mark.parametrize(
    ("mishap", "code", "wanted"),
    [
        ({"place": (44.0, 20.0)}, "position_offset", r"centroid were at x_px 4[34]\.?\d*, y_px (19|20)"),
        (
            {"size_px": SIZE_PX / 2.0, "levels": (0.3, 0.6, 1.2)},
            "size_mismatch",
            r"0\.(49|5)\d* times the size .* Is it the root of the area",
        ),
    ],
)
def test_hint_names_what_another_look_shows(mishap: dict[str, Any], code: str, wanted: str) -> None:
    result = tod.score(recording(**mishap), **QUICK)
    assert result.fits[0].status == "never_reached"
    (warning,) = hints(result)
    assert warning.code == code
    assert re.search(wanted, warning.message)


def test_hint_at_a_camera_held_by_hand() -> None:
    """Triangles jump by a third of their size, so that few are where their mean is."""
    steps = np.random.default_rng(2).choice([-3.0, 0.0, 3.0], (36, 2))
    result = tod.score(recording(steps=steps, levels=(0.3, 0.4, 0.5)), **QUICK)
    (warning,) = hints(result)
    assert warning.code == "position_scatter"
    # The square of a step is 6 on average, with a standard deviation of √18. The 12 strongest trials are seen,
    # with 24 steps: 6 ± 0.87. Four of these.
    assert 6.0 - 3.5 < warning.found**2 < 6.0 + 3.5


@pytest.mark.parametrize(("step", "which"), [(1, "after"), (-1, "before")])
def test_hint_at_rows_out_of_step(step: int, which: str) -> None:
    data = recording()
    turns = np.random.default_rng(3).permutation(len(data.trials))
    shown = [data.trials[k].orientation for k in np.roll(turns, step)]
    late = tuple(
        data.trials[k]._replace(number=number, orientation=shown[number]) for number, k in enumerate(turns)
    )
    (warning,) = hints(tod.score(replace(data, trials=late), **QUICK))
    assert (warning.code, warning.found, warning.expected) == ("orientation_mismatch", which, "its own")
    assert f"had the orientation of the one {which} it. Are frames and rows out of step?" in warning.message


def test_a_ratio_of_sizes_is_that_of_a_mistaken_unit() -> None:
    """A degree is 17.453 mrad, a minute of arc 0.2909 mrad; 15 % more or less is taken for the same."""
    for unit, question in (
        (1.0, ""),
        (17.453, "Is size_mrad in degrees?"),
        (0.2909, "Is size_mrad in arcmin?"),
        (0.0573, "Is the pixel pitch in degrees?"),
        (3.438, "Is the pixel pitch in arcmin?"),
    ):
        for factor in (1.0 / 1.14, 1.0, 1.14):
            assert missing_threshold._named_size(factor * unit) == (pytest.approx(unit, rel=2e-4), question)
    for ratio in (1.16, 1.0 / 1.16):
        assert missing_threshold._named_size(ratio)[0] == ratio


LEVELS = (0.1, 0.2, 0.3, 0.4)


def test_the_strongest_third_of_the_levels_and_at_least_eight_trials_are_looked_at() -> None:
    data = recording(levels=LEVELS)
    group, levels = data.trials.groups[0], data.trials.levels
    for counts, least in (((3, 3, 3, 3), 0.2), ((4, 4, 4, 4), 0.3), ((1, 1, 8, 8), 0.3), ((2, 2, 2, 1), 0.1)):
        rows = [np.flatnonzero(levels == level)[:n] for level, n in zip(LEVELS, counts, strict=True)]
        trials = data.trials.select(np.sort(np.concatenate(rows)))
        strong = missing_threshold._strongest(trials, group)
        assert strong.tolist() == np.flatnonzero(trials.levels >= least).tolist()
        assert missing_threshold._strongest_and_others(trials, strong) == trials  # there are fewer than 32
    strong = missing_threshold._strongest(data.trials, group)
    more = missing_threshold._strongest_and_others(data.trials, strong)
    assert len(strong) == 24 and more.levels.tolist() == [0.2] * 8 + [0.3] * 12 + [0.4] * 12


@pytest.mark.parametrize("honest", [{"levels": (0.001, 0.002, 0.004)}, {"blur_px": 8.0}], ids=str)
def test_no_hint_without_a_mistake(honest: dict[str, Any]) -> None:
    result = tod.score(recording(**honest), **QUICK)
    assert hints(result) == []
    (fit,) = result.fits
    assert (fit.answers is None) == (fit.threshold is not None)


def test_a_hint_is_much_better_than_now_and_no_chance_result() -> None:
    """By hand: the divergence from guessing is ln 4 of all right answers and ln(3) / 2 of three quarters; that of
    all trials has to be ln 10⁴."""
    for share, now, trials, works in (
        *((1.0, 0.25, n, n > 6) for n in (6, 7)),
        *((0.75, 0.5, n, n > 16) for n in (16, 17)),
        *((share, 0.6, 999, share > 0.8) for share in (0.79, 0.81)),
        (0.74, 0.5, 999, False),
    ):
        search: Any = SimpleNamespace(_right=lambda _, now=now: now, trials=range(trials), answers=np.zeros(0))
        assert missing_threshold._MistakeSearch._works(search, share) is works


@pytest.mark.parametrize("decisions", ["expected", "sampled"])
def test_answers_are_of_the_strongest_trials(decisions: str) -> None:
    mirrored = recording(shown=(0, 3, 2, 1), noise_sd=0.001)
    result = tod.score(mirrored, decisions=decisions, **QUICK)
    assert [one.code for one in hints(result)] == ["mirrored"]
    (fit,) = result.fits
    table = np.array(fit.answers)
    (shown,) = [one.records for one in result.tables() if one.file == "answers.csv"]
    assert [one["shown"] for one in shown] == ["up", "right", "down", "left"]
    assert {(one["from_level"], one["n_answers"]) for one in shown} == {(0.3, 3)}
    assert [one["answered_left"] for one in shown] == pytest.approx(table[:, 3] / 0.03, abs=0.01)
    # Three trials of each orientation; numbers are rounded to four digits.
    assert table.sum(axis=1) == pytest.approx([3.0] * 4, abs=4e-4)
    # Mirrored: for "right" the frames show "left".
    assert table.argmax(axis=1).tolist() == [0, 3, 2, 1]
    assert read_result(result.to_json(), "result.json").fits[0].answers == fit.answers


@pytest.fixture
def searches(monkeypatch) -> list[int]:
    searches = []

    def search(data, **_settings):
        searches.append(len(data.trials))
        raise tod.DataError("nothing stands out")

    monkeypatch.setattr(missing_threshold, "locate_triangles", search)
    return searches


def test_frames_are_not_searched_again_if_a_threshold_is_extrapolated(searches: list[int]) -> None:
    """The measurements of the frames tell a wrong place or size; searching takes longer than scoring."""
    weak = recording(levels=(0.05, 0.06, 0.08))
    assert tod.score(weak, **QUICK).fits[0].status == "extrapolated"
    assert not searches


@pytest.mark.parametrize("away", [0, 6], ids="{} away".format)
def test_frames_are_searched_again_unless_they_show_the_triangles_as_stated(
    away: int, searches: list[int]
) -> None:
    """An observer of much noise finds no threshold, and nothing is wrong. If 6 of the 12 strongest trials show
    their triangles 20 pixels away, the mean of all still has the stated place and size."""
    steps = np.zeros((36, 2))
    steps[24 : 24 + 2 * away : 2] = 20.0
    result = tod.score(recording(steps=steps), observer=tod.PyramidObserver(internal_noise=50.0), **QUICK)
    assert result.fits[0].status == "never_reached"
    assert hints(result) == []
    assert searches == [12, 12] * (away > 0)


def test_of_many_strong_trials_some_of_each_orientation_are_looked_at_again(searches: list[int]) -> None:
    """36 are of the highest level. Every second one would be of two orientations only: each third is taken."""
    data = recording(place=(44.0, 20.0), levels=(0.1, 0.2, 0.3, 0.3, 0.3))
    (fit,) = tod.score(data, **QUICK).fits
    assert searches == [12, 12]
    assert (np.sum(fit.answers), fit.answers_from_level) == (pytest.approx(36.0, abs=1e-3), 0.3)


@pytest.mark.usefixtures("blank_pictures")
def test_page_shows_the_strongest_trial_whole() -> None:
    result = tod.score(recording(place=(44.0, 20.0), levels=(0.3, 0.1)), fit=tod.FitSettings(resamples=0))
    assert result.fits[0].status == "never_reached"
    (example,) = result.examples
    assert example.strength == 0.3
    (picture,) = example.pictures
    image = cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_COLOR).astype(int)
    enlarged = len(image) // SIDE_PX  # the triangle is where it is, and white
    assert image[int(20.5 * enlarged), int(44.5 * enlarged)].min() > 200
    page = result.to_html()
    assert "Without a threshold" in page
    assert "At threshold" not in page
    assert "Answers by orientation shown" in page
