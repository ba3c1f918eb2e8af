"""The pictures of a trial at threshold, against what was drawn."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from triangles import DISPLAY

from todframes.base._typing import FloatArray
from todframes.frames.contrast import ContrastPatch
from todframes.frames.dataset import load_dataset
from todframes.frames.memory import memory_dataset
from todframes.frames.trials import SceneView, Trial, Trials
from todframes.observers.interface import Observer
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import RetinaGrid
from todframes.results.data import Example, Thumbnail
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.scoring.examples import _nearest_trials, _whole, example_of, examples, nearest_trial
from todframes.scoring.score import score_dataset
from todframes.stimulus import ORIENTATIONS, Stimulus, vertices

# Code values of sRGB (IEC 61966-2-1) for linear light 1/2, 3/4 and 1.
HALF, THREE_QUARTERS, WHITE = 188, 225, 255

Drawn = Example | tuple[float, tuple[Thumbnail, ...]]


def decoded(drawn: Drawn) -> dict[str, np.ndarray]:
    """The pictures of an example by name, as integers."""
    shown = drawn.pictures if isinstance(drawn, Example) else drawn[1]
    pngs = {one.name: np.frombuffer(one.png, np.uint8) for one in shown}
    return {name: cv2.imdecode(png, cv2.IMREAD_UNCHANGED).astype(int) for name, png in pngs.items()}


def scales(drawn: Drawn) -> dict[str, float | None]:
    return {one.name: one.scale for one in (drawn.pictures if isinstance(drawn, Example) else drawn[1])}


class Watcher(PyramidObserver):
    """The paper's observer, but it sees what it is told."""

    def __init__(self, bands: Sequence[FloatArray], settings: PyramidSettings) -> None:
        super().__init__(settings)
        self.bands = bands

    def activity(self, _: FloatArray) -> tuple[FloatArray, ...]:
        return tuple(self.bands)


def watched(bands: Sequence[FloatArray], *, levels: int = 4, size_mrad: float = 1.0, **more: Any) -> Drawn:
    """Pictures with given bands; display pixels and retina samples of 0.1 mrad, nothing on the display."""
    observer = Watcher(bands, PyramidSettings(retina_pitch_mrad=0.1, levels=levels))
    side = observer.grid(Stimulus(size_mrad)).side
    changed = {"observer": observer, "stimulus": Stimulus(size_mrad)} | more
    return pictures([patch(np.zeros((99, 99)))], np.zeros((side, side)), **PLAIN | changed)


@pytest.mark.parametrize("orientation", ["up", "left"])
def test_display_shows_the_frame(make_dataset, orientation: str) -> None:
    """A triangle of contrast 0.5 on white at twice the background: grey of ¾ of the light on grey of ½."""
    made = make_dataset(contrasts=(0.3, 0.5, 0.8))
    made.rows = [row for row in made.rows if row["orientation"] == orientation]
    made.save()
    observer = PyramidObserver(PyramidSettings(internal_noise=3.0))
    dataset = load_dataset(made.path)
    scored = score_dataset(dataset, observer)
    assert [one.fit.status for one in scored.fits] == ["ok"]
    (one,) = examples(dataset, scored, observer)
    display, retina = decoded(one)["display"], decoded(one)["retina"]
    assert (one.strength, one.frame) == (0.5, made.rows[1]["frame"])
    assert (one.orientation, one.n_frames, one.group) == (orientation, 1, {"size_mrad": 2.0})
    # 1.5 sizes on each side of the middle, in pixels of 0.25 mrad.
    assert display.shape == (25, 25)
    assert one.width_mrad == 6.25
    assert (display[0, 0], display[12, 12]) == (HALF, THREE_QUARTERS)
    assert scales(one)["display"] == 1.0
    # Half floats keep 11 bits of the luminance.
    assert scales(one)["retina"] == pytest.approx(0.5, abs=1.5 * 2.0**-11)
    assert (retina[0, 0], retina.max()) == (128, 255)
    for image in (display, retina):
        # Turned so that the apex is up, three quarters of the area are in the lower half of its height.
        turned = np.rot90(image - image[0, 0], ["up", "right", "down", "left"].index(orientation))
        rows = np.trim_zeros(turned.sum(axis=1))
        assert rows[: len(rows) // 2].sum() < 0.5 * rows[len(rows) // 2 :].sum()


def scored_by_hand(scenes: Sequence[str]) -> tuple[Any, Any]:
    """Two groups of trials of levels 1, 2, 4, 4, 8 in turn, with the threshold 3 in the first."""
    level, views = (1.0, 2.0, 4.0, 4.0, 8.0), [SceneView(name) if name else None for name in scenes]
    trials = [
        Trial(n, str(n), (), ORIENTATIONS[0], Stimulus(1.0), level[n % 5], (float(n // 5),), None, None, view)
        for n, view in enumerate(views)
    ]
    p_correct = np.array([0.3, 0.5, 0.9, 0.7, 1.0, 0.4, 0.5, 0.6, 0.7, 0.8])
    group = SimpleNamespace(group=(0.0,), fit=SimpleNamespace(threshold=3.0, p_correct=0.75))
    return SimpleNamespace(trials=Trials.of(trials), p_correct=p_correct), group


def test_the_trial_nearest_to_threshold() -> None:
    """By the ratio of its level, 4/3 before 3/2, then by P(correct): 0.7 before 0.9. On scenes, of each."""
    scored, group = scored_by_hand([""] * 10)
    assert (nearest_trial(scored, group), _nearest_trials(scored, group)) == (3, [3])
    assert nearest_trial(scored, group, np.array([0, 1, 4])) == 1
    scored, group = scored_by_hand([*"abcab", *"abcab"])
    assert _nearest_trials(scored, group) == [3, 1, 2]  # scene a has trials 0 and 3, b has 1 and 4, c has 2


@pytest.mark.parametrize(
    ("shape", "at", "block", "enlarged"), [((60, 120), (40.0, 20.0), 1, 3), ((420, 800), (250.0, 300.0), 3, 1)]
)
def test_a_whole_frame_and_the_outline_of_the_expected_triangle(
    shape: tuple[int, int], at: tuple[float, float], block: int, enlarged: int
) -> None:
    """Of two frames: a step of contrast 0 to 0.5, and a spot too small to count. At most 384 pixels are drawn."""
    frames = np.full((2, *shape), 50.0)
    frames[:, :, shape[1] // 2 :] += [[[10.0]], [[40.0]]]
    frames[0, 0, 0] = 1e4
    stated = {"orientation": "right", "level": 0.5, "size_mrad": 4.0, "trial": ["a", "a"], "position": [at] * 2}
    data = memory_dataset(frames, display=DISPLAY, **stated)
    width_mrad, (drawn,) = _whole(data, data.trials[0], PyramidObserver())
    assert (width_mrad, drawn.name) == (0.25 * shape[1], "whole")
    assert (drawn.scale, drawn.black) == (pytest.approx(0.5), pytest.approx(0.0, abs=1e-9))
    image = cv2.imdecode(np.frombuffer(drawn.png, np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert image.shape == (shape[0] // block * enlarged, shape[1] // block * enlarged, 3)
    assert image[-1, 0].tolist() == [0] * 3 and image[-1, -1].tolist() == [255] * 3
    orange = np.argwhere(image[..., 2] - image[..., 0] > 60)[:, ::-1]
    corners = (vertices(size=16.0, orientation=ORIENTATIONS[1], x=at[0], y=at[1]) + 0.5) * enlarged / block - 0.5
    for found, expected in ((orange.min(axis=0), corners.min(axis=0)), (orange.max(axis=0), corners.max(axis=0))):
        assert found == pytest.approx(expected, abs=1.0)  # the width of the line
    seen = data.trials[0]._replace(view=SceneView("street", "", "left"))
    example = example_of(data, seen, 0.6, width_mrad, (drawn,), "none")
    assert (example.group, example.condition, example.level) == ({"size_mrad": 4.0}, "none", "contrast")
    assert (example.frame, example.n_frames, example.scene, example.p_correct) == ("frame 0", 2, "street", 0.6)


PLAIN: dict[str, Any] = {"observer": PyramidObserver(), "stimulus": Stimulus(1.0), "pixel_pitch_mrad": 0.1}


def patch(values: np.ndarray, row: int = 0, column: int = 0) -> ExamplePatch:
    return ExamplePatch(ContrastPatch(values, row, column, 0), 49.0, 49.0)


def test_frames_of_a_trial_are_averaged() -> None:
    """Contrasts 0.2 and 0.6 on a common display: grey of the light of 0.4."""
    shown = [patch(np.full((99, 99), contrast)) for contrast in (0.2, 0.6)]
    one = pictures(shown, np.zeros((65, 65)), **PLAIN)
    assert (decoded(one)["display"] == np.rint(255 * (1.055 * 0.7 ** (1 / 2.4) - 0.055))).all()


def test_white_is_the_brightest_or_as_told() -> None:
    values = np.zeros((99, 99))
    values[49, 49] = 3.0
    one = pictures([patch(values)], np.zeros((65, 65)), **PLAIN)
    assert scales(one)["display"] == 3.0
    # A quarter of the light: 137 of 255.
    assert (decoded(one)["display"].max(), decoded(one)["display"].min()) == (WHITE, 137)
    clipped = pictures([patch(values)], np.zeros((65, 65)), white=1.0, **PLAIN)
    assert (decoded(clipped)["display"].max(), decoded(clipped)["display"].min()) == (WHITE, HALF)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (40, 0), (0, 40), (-500, -500), (500, 500)])
def test_background_where_the_frame_ends(row: int, column: int) -> None:
    """Lit pixels from (row, column) on; the triangle is at (49, 49)."""
    one = pictures([patch(np.ones((60, 60)), row, column)], np.zeros((65, 65)), **PLAIN)
    display = decoded(one)["display"]
    reach = display.shape[0] // 2
    places = np.arange(49 - reach, 49 + reach + 1)
    lit = [(places >= first) & (places < first + 60) for first in (row, column)]
    assert (display == np.where(np.outer(*lit), WHITE, HALF)).all()


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_bands_lie_on_the_retina(step: int) -> None:
    """One lit sample of a band covers `step` samples of the retina about its own place."""
    side = 64 // step + 1
    band = np.zeros((side, side))
    up, right = 1, 1
    band[side // 2 - up, side // 2 + right] = -0.25
    one = watched([band])
    image = decoded(one)["band 0"]
    assert scales(one)["band 0"] == 0.25
    rows, columns = np.nonzero(image != 128)
    reach = image.shape[0] // 2
    # The middle of an even number of samples lies half a sample early.
    centre = 0.0 if step % 2 else -0.5
    assert (image[rows, columns] == 1).all() and len(rows) == step**2
    assert rows.mean() - reach == -up * step + centre
    assert columns.mean() - reach == right * step + centre


def test_nothing_is_averaged_away_in_a_large_band() -> None:
    """A checkerboard of ±1, reduced: its peaks stay, where a mean would be 0."""
    side = RetinaGrid(4 * 2**8 + 1, 0.1).side
    board = 1.0 - 2.0 * (np.indices((side, side)).sum(axis=0) % 2)
    one = watched([board], levels=8, size_mrad=25.0)
    image = decoded(one)["band 0"]
    assert image.shape[0] <= 96
    assert set(np.unique(image)) <= {1, 255}


def test_weakest_bands_are_left_out() -> None:
    bands = [np.full((65, 65), 1.0 / (1 + (7 * k) % 12)) for k in range(12)]
    one = watched(bands)
    strongest = sorted(range(12), key=lambda k: (7 * k) % 12)[:8]
    assert [name for name in scales(one) if name.startswith("band")] == [f"band {k}" for k in sorted(strongest)]


def test_observer_that_shows_nothing() -> None:
    class Blind(Observer):
        def grid(self, _: Stimulus) -> RetinaGrid:
            return RetinaGrid(65, 0.1)

    one = pictures([patch(np.zeros((99, 99)))], np.zeros((65, 65)), **PLAIN | {"observer": Blind()})
    assert list(decoded(one)) == ["display", "retina"]
