"""Finding the triangle when the manifest does not tell where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import triangles
from numpy.typing import NDArray
from test_frames import write_exr

import todframes as tod
from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.diagnosis import whole_frames
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import inspect
from todframes.diagnosis.locate import (
    Peaks,
    _isotropic,
    _sure_level,
    chosen_places,
    locate_triangles,
    location_warnings,
)
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.memory import memory_dataset
from todframes.frames.trials import Trials
from todframes.stimulus import ORIENTATIONS

recording = partial(triangles.recording, side_px=48, noise_sd=0.1, blur_px=0.8, is_noise_blurred=True)
"""The noise is as blurred as the triangles."""


QUICK = {"examples": False, "fit": tod.FitSettings(resamples=0)}


def test_sizes_of_one_group_are_found_together() -> None:
    sizes = np.tile([6.0, 10.0], 16)
    how = {"levels": (0.2, 0.4), "repeats": 4, "noise_sd": 0.05, "group": {"chart": ["one"] * 32}}
    data, _ = recording(
        np.random.default_rng(7), (25.4, 33.3), size_px=sizes.__getitem__, size_mrad=(0.25 * sizes).tolist(), **how
    )
    _, (found,) = locate_triangles(data)
    assert (found.x_px, found.y_px) == pytest.approx((25.4, 33.3), abs=5.0 * found.standard_error_px)


def test_positions_in_the_manifest_are_where_the_search_begins() -> None:
    """Each frame has a position of its own, all of them wrong by the same way, and beside whole pixels."""
    rng = np.random.default_rng(8)
    data, places = recording(rng, (31.3, 30.4), side_px=64, noise_sd=0.05, shake_px=4.0)
    placed, (found,) = locate_triangles(placed_at(data, places + np.array([0.8, -1.3])))
    assert found.moved_px == pytest.approx((-0.8, 1.3), abs=5.0 * found.standard_error_px)
    errors = placed.trials.positions_px - places
    assert np.abs(errors - errors.mean(axis=0)).max() < 1e-9  # one way for all
    assert found.standard_error_px < 0.1


def test_each_position_in_the_manifest_is_where_a_search_begins() -> None:
    rng = np.random.default_rng(9)
    data, places = recording(rng, (31.3, 30.4), side_px=64, levels=(0.15, 0.3), noise_sd=0.03, shake_px=4.0)
    rough = places + rng.normal(0.0, 1.0, places.shape)
    placed, (found,) = locate_triangles(placed_at(data, rough), locate="each")
    assert (found.n_located, found.n_trials) == (16, 16)
    assert found.scatter_px == pytest.approx(1.0, abs=0.5)  # 32 numbers: 1 / √64; four of these
    assert np.abs(placed.trials.positions_px - places).max() < 0.35  # as of shaken recordings below


@pytest.mark.parametrize("locate", ["group", "each"])
def test_frames_in_which_nothing_stands_out_are_refused(locate) -> None:
    """Positions in the manifest stay instead, and no trial has one of its own."""
    data, places = recording(np.random.default_rng(10), (23.5, 23.5), levels=(1e-4, 2e-4), repeats=1)
    with pytest.raises(DataError, match="no triangle stands out in the frames of size_mrad 2"):
        locate_triangles(data, locate=locate)
    placed, (found,) = locate_triangles(placed_at(data, places), locate=locate)
    assert (found.standard_error_px, found.moved_px) == (None, (0.0, 0.0))
    assert found.n_located == (0 if locate == "each" else None)
    assert np.array_equal(placed.trials.positions_px, places)


@pytest.mark.parametrize(("size_mrad", "wanted"), [(0.1, "no triangle stands out"), (0.5, "smaller than the")])
def test_frames_of_one_pixel_are_refused(size_mrad: float, wanted: str) -> None:
    """All orientations are alike on one pixel; warnings are errors here."""
    frames, stated = np.arange(50.0, 54.0).reshape(4, 1, 1), {"level": 0.5, "display": triangles.DISPLAY}
    data = memory_dataset(frames, orientation=ORIENTATIONS, size_mrad=size_mrad, **stated)
    with pytest.raises(DataError, match=wanted):
        locate_triangles(data)


def test_frames_that_cannot_be_searched_are_refused(make_dataset, monkeypatch) -> None:
    data, places = recording(np.random.default_rng(10), (23.5, 23.5), repeats=1, spoil=lambda of, n: of * (n > 0))
    with pytest.raises(FrameError, match=r"frame 0: background luminance around the .* is 0 cd/m², expected > 0"):
        locate_triangles(placed_at(data, places), locate="each")
    places[0] = 1e4
    with pytest.raises(FrameError, match=r"frame 0: found the triangle at x_px 1e\+04, .* on the 58 × 48 pixels"):
        locate_triangles(placed_at(data, places), locate="each")
    monkeypatch.setattr(whole_frames, "MOST_BLOCKS", 2000)
    with pytest.raises(FrameError, match="58 × 48 pixels are too many to find a triangle of 8 pixels among them"):
        locate_triangles(data)
    made = make_dataset()
    part = {"x": 2, "y": 2, "full_width": 16, "full_height": 16}
    write_exr(made.frame(0), (np.full((8, 8, 1), 50.0, np.float16), ("Y",), part))
    with pytest.raises(FrameError, match="has no pixels in part of the frame; its triangle cannot be located"):
        locate_triangles(load_dataset(made.path))


def placed_at(data: Dataset, places: NDArray[np.float64]) -> Dataset:
    pairs = zip(data.trials, places.tolist(), strict=True)
    trials = Trials.of(trial._replace(x_px=x, y_px=y) for trial, (x, y) in pairs)
    return replace(data, trials=trials)


@pytest.mark.weekly
@pytest.mark.parametrize("is_noise_blurred", [True, False])
def test_interval_is_honest(is_noise_blurred: bool) -> None:
    """Blur makes noise correlated between pixels: an error for white noise is then three times too small."""
    rng = np.random.default_rng(2)
    within = []
    for k in range(240):
        middle, noise_sd = 23.5 + rng.uniform(-3.0, 3.0, 2), (0.02, 0.1)[k % 2]
        _, (found,) = locate_triangles(
            recording(rng, middle, noise_sd=noise_sd, is_noise_blurred=is_noise_blurred)[0]
        )
        misses = np.array([found.x_px, found.y_px]) - middle
        within += (np.abs(misses) < 1.96 * found.standard_error_px).tolist()
    # The share of 480 coordinates has a standard deviation of √(0.05 · 0.95 / 480) = 1 %.
    assert 0.93 <= np.mean(within) <= 0.98


@pytest.mark.parametrize(("shown", "sign", "codes"), [
    ((0, 1, 2, 3), 1, ()),
    ((0, 1, 2, 3), -1, ("polarity_mismatch",)),
    ((0, 3, 2, 1), 1, ("mirrored",)),
    ((2, 1, 0, 3), 1, ("flipped",)),
    ((1, 2, 3, 0), 1, ("turned",)),
    ((0, 3, 2, 1), -1, ("polarity_mismatch", "mirrored")),
])  # fmt: skip
def test_triangles_that_are_not_as_stated_are_found(
    shown: Sequence[int], sign: int, codes: tuple[str, ...]
) -> None:
    data, _ = recording(np.random.default_rng(3), (26.3, 12.1), noise_sd=0.05, clutter=0.3, shown=shown, sign=sign)
    placed, (found,) = locate_triangles(data)
    assert found.group == (2.0,)
    assert {(trial.x_px, trial.y_px) for trial in placed.trials} == {(found.x_px, found.y_px)}
    # Four standard errors along two axes: missed once in 8,000.
    assert np.hypot(found.x_px - 26.3, found.y_px - 12.1) < 4.0 * np.sqrt(2.0) * found.standard_error_px < 0.5
    assert found.arrangement.mismatches == codes
    warnings = frame_warnings(placed, inspect(placed, placed.trials))
    assert {(one.code, one.group["size_mrad"]) for one in warnings} == {(code, 2.0) for code in codes}
    scattered = [
        found._replace(n_trials=8, sure_level=sure_level, scatter_px=1.5) for sure_level in (0.2, 0.21, None)
    ]
    for one, n_more in zip(scattered, (0, 1, 1), strict=True):
        faint = location_warnings(placed, [one], {(2.0,): 0.2})
        assert [(one.code, one.found, one.expected) for one in faint] == [("position_scatter", 1.5, 0.0)] * n_more


HALF_A_FRAME = {"size_px": 22.0, "stated_px": 22.0, "levels": (0.3,), "noise_sd": 0.01}
MANY_SIZES = {"side_px": 128, "levels": (0.2, 0.3), "noise_sd": 0.03}


@pytest.mark.parametrize(
    ("middle_px", "shake_px", "settings"),
    [
        (31.0, 3.0, {"side_px": 64, "levels": (0.15, 0.3), "noise_sd": 0.03}),
        (23.5, 1.0, HALF_A_FRAME),
        pytest.param(63.5, 16.0, MANY_SIZES, marks=pytest.mark.slow),
    ],
    ids=["shaken", "nearly half a frame", "drift of many sizes"],
)
def test_each_trial_is_found(middle_px: float, shake_px: float, settings: dict) -> None:
    data, places = recording(np.random.default_rng(6), (middle_px, middle_px), shake_px=shake_px, **settings)
    done: list[tuple[int, int]] = []
    placed, (found,) = locate_triangles(data, locate="each", progress=lambda *of: done.append(of))
    assert found.n_located == found.n_trials == len(places)
    assert done == [(k, 2 * len(places)) for k in range(1, 2 * len(places) + 1)]
    # A standard deviation σ of 2n numbers: its error is σ / √(4n); four of these.
    assert found.scatter_px == pytest.approx(shake_px, abs=2.0 * shake_px / np.sqrt(len(places)))
    # The blurred noise has the energy of white noise of 0.03 at low frequencies, and the triangle of contrast 0.15
    # an edge of 18 px: some 0.03 / (0.15 √9) = 0.07 px along each axis; five of these.
    assert np.abs(placed.trials.positions_px - places).max() < 0.35


def test_faint_trials_have_the_position_of_the_group() -> None:
    data, _ = recording(np.random.default_rng(5), (23.5, 23.5), levels=(0.001, 0.3), noise_sd=0.03, shake_px=2.0)
    placed, (found,) = locate_triangles(data, locate="each")
    assert (found.n_located, found.n_trials) == (8, 16)
    (faint,) = np.unique(placed.trials.positions_px[placed.trials.levels == 0.001], axis=0)
    assert faint == pytest.approx((found.x_px, found.y_px))
    assert found.standard_error_px == pytest.approx(2.0 / np.sqrt(8.0), rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("noise_sd", "shake_px"), [(0.1, 3.0), pytest.param(0.03, 0.0, marks=pytest.mark.weekly)])
def test_thresholds_are_those_of_known_positions(noise_sd: float, shake_px: float) -> None:
    """9 % high if faint trials have the mean place, and low if places are chosen to favour stated orientations."""
    ratios = []
    for seed in range(4):
        data, places = held_by_hand(seed, noise_sd=noise_sd, shake_px=shake_px)
        result = tod.score(data, locate="each", **QUICK)
        assert "position_scatter" not in {one.code for one in result.warnings}
        known = tod.score(placed_at(data, places), **QUICK)
        ratios.append(result.thresholds[0].threshold / known.thresholds[0].threshold)
    # Each ratio has a standard deviation of 2.5 %, that of four 1.3 %; and the 2 % that are asked.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)


def held_by_hand(seed: int, *, noise_sd: float, shake_px: float = 3.0) -> tuple[Dataset, NDArray[np.float64]]:
    """Triangles of 9 pixels in noise that is blurred as they are, from levels that show nothing to clear ones."""
    levels = (0.03, 0.05, 0.08, 0.13, 0.2, 0.3)
    rng, middle, sizes = np.random.default_rng(seed), (31.3, 32.2), {"size_px": 9.0, "stated_px": 9.0}
    return recording(
        rng, middle, side_px=64, levels=levels, repeats=5, noise_sd=noise_sd, shake_px=shake_px, **sizes
    )


def test_locate_is_group_or_each(make_dataset) -> None:
    data = load_dataset(make_dataset().path)
    with pytest.raises(SettingsError, match="locate: found 'all', expected one of group, each"):
        locate_triangles(data, locate="all")  # type: ignore[arg-type]


def peaks_at(*rows: tuple[float, float, float, float]) -> Peaks:
    """Peaks from their x, y, variance and height."""
    columns = np.array(rows).reshape(-1, 4)
    return Peaks(columns[:, :2], columns[:, 2], columns[:, 3])


def test_places_of_trials_are_drawn_to_their_mean_by_how_well_they_are_known() -> None:
    """All variances of clear trials are equal, so that moments are those of a textbook."""
    places = np.array([[11, -16], [13, -22], [8, -19], [10, -15], [14, -20], [9, -23], [12, -18.0]])
    mean = places.mean(axis=0)
    scatter2 = places.var(axis=0, ddof=1).mean() - 0.5
    x, y = mean + np.array([3.0, -1.0])

    def height(score: float, variance: float = 0.5) -> float:
        """Height of a peak 3 to the right and 1 up from the mean whose logarithm of likelihood is a score."""
        both = scatter2 + variance
        return score + 10.0 / (2.0 * both) + np.log(both / variance)

    clear = [peaks_at((*place, 0.5, 40.0), (50.0, 0.0, 0.5, 35.0)) for place in places[:5]]
    farther = peaks_at((100.0, 80.0, 0.5, 21.0), (*places[5], 0.5, 20.0))  # the mean decides
    low = peaks_at((*places[6], 0.5, 9.1))  # clear when the mean is known
    others = [
        peaks_at((x, y, 0.5, 8.9)),  # half as high as a clear trial has to be
        peaks_at((x, y, 2.0, height(0.01, 2.0))),
        peaks_at((x, y, 0.5, height(-0.01))),
        peaks_at((x, y, 0.5, height(1.0)), (x, y, 0.5, height(1.0 + np.log(1.0 - 1.01 * np.exp(-1.0))))),
        peaks_at((x, y, 0.5, height(1.0)), (x, y, 0.5, height(1.0 + np.log(1.0 - 0.99 * np.exp(-1.0))))),
        peaks_at((x, y, 0.5, height(20.0)), (x, y, 0.5, height(20.0 - np.log(98.0)))),  # 98.99 %
        peaks_at(),
    ]
    chosen = chosen_places([*clear, farther, low, *others])
    assert (chosen.mean, chosen.scatter) == (pytest.approx(mean), pytest.approx(np.sqrt(scatter2)))
    is_own = [True] * 9 + [False, True, False, True, False]
    assert chosen.is_own.tolist() == is_own
    variance = np.where(np.arange(14) == 8, 2.0, 0.5)
    share = np.where(is_own, scatter2 / (scatter2 + variance), 0.0)[:, None]
    away = np.vstack([places - mean, np.tile((3.0, -1.0), (7, 1))])
    assert chosen.places == pytest.approx(mean + share * away)
    assert chosen.error == pytest.approx(np.sqrt(np.where(is_own, share[:, 0] * variance, scatter2)))


@pytest.mark.parametrize(
    ("n", "height", "lead", "is_known"),
    [(4, 18.0, 5.0, True), (3, 18.0, 5.0, False), (4, 17.99, 5.0, False), (4, 18.0, 4.99, False)],
)
def test_four_trials_have_to_be_clear(n: int, height: float, lead: float, is_known: bool) -> None:
    peaks = [peaks_at((k, -k, 0.5, height), (k, 90.0, 0.5, height - lead)) for k in range(n)]
    chosen = chosen_places([*peaks, peaks_at((0.0, 0.0, 0.5, 5.0))])
    assert (chosen is not None) == is_known


@pytest.mark.parametrize(("error", "expected"), [
    ((0.18, 0.09, 0.045), 0.2),
    ((0.36, 0.18, 0.045), 0.2 * np.sqrt(2.0)),  # a power of the level: half as large at its square root of 4
    ((0.08, 0.1, 0.045), 0.2 * 2.0 ** (np.log(0.1 / 0.09) / np.log(0.1 / 0.045))),
    ((0.01, 0.01, 0.01), 0.1),
    ((0.01, 0.01, 0.1), np.inf),
])  # fmt: skip
def test_levels_are_sure_from_where_positions_are_known(error: Sequence[float], expected: float) -> None:
    """Two trials a level, whose mean square counts."""
    each = np.outer(error, (0.6, np.sqrt(2.0 - 0.36))).ravel()
    assert _sure_level(np.repeat([0.1, 0.2, 0.4], 2), each) == pytest.approx(expected)


def test_a_spectrum_of_another_grid_is_that_of_its_radii() -> None:
    def radius(n: int) -> NDArray[np.float64]:
        return np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n))

    found, expected = _isotropic(1.0 + 3.0 * radius(96), 64), 1.0 + 3.0 * radius(64)
    inside = np.abs(radius(64) - 0.24) < 0.21  # rings are 0.03 wide, and the corners of the square are one
    assert found.shape == (64, 33)
    assert found[inside] == pytest.approx(expected[inside], abs=0.05)


def test_mean_frames_are_those_of_blocks_without_the_rest(monkeypatch) -> None:
    """Blocks of 3 × 3 pixels in frames of 20 × 26; one trial has two frames."""
    large = [((2048, 1024), 1e9), ((4096, 2048), 1e9), ((4096, 2048), 50.0), ((4096, 2048), 15.0)]
    assert [whole_frames._block_px(*one) for one in large] == [1, 4, 3, 1]  # a sixteenth of the size at most
    monkeypatch.setattr(whole_frames, "_block_px", lambda *_: 3)
    contrast = np.random.default_rng(1).uniform(-0.5, 0.5, (3, 20, 26))
    turns = {"orientation": ["up", "up", "left"], "trial": [0, 0, 1], "display": triangles.DISPLAY}
    data = memory_dataset(50.0 * (1.0 + contrast), level=0.1, size_mrad=2.0, **turns)
    frames = whole_frames.MeanFrames(data)
    for trial in data.trials:
        frames.add(trial)
    blocks = contrast[:, :18, :24].reshape(3, 6, 3, 8, 3).mean(axis=(2, 4))
    assert frames.of_trial(data.trials[0]) == pytest.approx(blocks[:2].mean(axis=0), abs=1e-6)
    assert frames.mean() == pytest.approx(blocks.mean(axis=0), abs=1e-6)
    assert frames.in_pixels((2.0, 5.5)) == (7.0, 17.5)
