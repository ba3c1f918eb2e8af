"""Missing thresholds: answers in the strongest trials, what the frames show, pictures of whole frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
import triangles

import todframes as tod
from todframes.frames.dataset import Dataset
from todframes.results.result import read_result
from todframes.scoring.score import strongest

SIZE_PX, SIDE_PX = 8.0, 64
MIDDLE, CENTRE = (SIDE_PX - 1) / 2, (SIDE_PX + triangles.WIDER - 1) / 2  # of rows and of columns
QUICK: dict[str, Any] = {"examples": False, "fit": tod.FitSettings(resamples=0)}


def recording(
    *, place: tuple[float, float] = (CENTRE, MIDDLE), levels: Sequence[float] = (0.1, 0.2, 0.3), **mishap: Any
) -> Dataset:
    """Frames of triangles that the dataset says are upright, bright, in the middle and of `SIZE_PX`."""
    return triangles.recording(np.random.default_rng(1), place, levels=levels, repeats=3, **mishap)[0]


LEVELS = (0.1, 0.2, 0.3, 0.4)


def test_the_strongest_third_of_the_levels_and_at_least_eight_trials_are_looked_at() -> None:
    data = recording(levels=LEVELS)
    group, levels = data.trials.groups[0], data.trials.levels
    for counts, least in (((3, 3, 3, 3), 0.2), ((4, 4, 4, 4), 0.3), ((1, 1, 8, 8), 0.3), ((2, 2, 2, 1), 0.1)):
        rows = [np.flatnonzero(levels == level)[:n] for level, n in zip(LEVELS, counts, strict=True)]
        trials = data.trials.select(np.sort(np.concatenate(rows)))
        strong = strongest(trials, group)
        assert strong.tolist() == np.flatnonzero(trials.levels >= least).tolist()


@pytest.mark.parametrize("decisions", ["expected", "sampled"])
def test_answers_are_of_the_strongest_trials(decisions: str) -> None:
    mirrored = recording(shown=(0, 3, 2, 1), noise_sd=0.001)
    result = tod.score(mirrored, decisions=decisions, **QUICK)
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


@pytest.mark.parametrize(
    ("mishap", "code"), [({"shown": (2, 3, 0, 1)}, "turned"), ({"sign": -1}, "polarity_mismatch")]
)
def test_frames_say_what_is_wrong_and_no_levels_are_asked_for(mishap: dict[str, Any], code: str) -> None:
    result = tod.score(recording(levels=(0.2, 0.3), **mishap), **QUICK)
    assert result.fits[0].status == "never_reached" and result.fits[0].answers is not None
    assert code in {one.code for one in result.warnings} and "levels_to_add" not in str(result.warnings)


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
