"""The observer of oriented neurons, linear and with complex cells."""

from __future__ import annotations

import numpy as np
import pytest

from todframes.base.errors import SettingsError
from todframes.frames.dataset import load_dataset
from todframes.observers.oriented import OrientedObserver, OrientedSettings
from todframes.observers.retina import triangle_on
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.score import score_dataset
from todframes.stimulus import Stimulus


def observer(**changes: object) -> OrientedObserver:
    return OrientedObserver(OrientedSettings(**changes))


@pytest.fixture
def complex_observer() -> OrientedObserver:
    return observer(complex_cells=True)


def test_what_is_left_out_is_what_a_wider_readout_adds() -> None:
    stimulus = Stimulus(3.0)
    settings = OrientedSettings(position_jitter_samples=0.0, orientations=4)
    usual, wide = (OrientedObserver(settings, more_levels=n).readout(stimulus) for n in (0, 2))
    added = wide.noise_covariance - usual.noise_covariance
    said = OrientedObserver(settings).omitted_bands(stimulus).noise_covariance
    # The triangle on the coarser retina is blurred by one coarse sample more.
    assert np.allclose(said, added, rtol=0.0, atol=0.2 * np.abs(added).max())
    assert observer(complex_cells=True).omitted_bands(stimulus) is None


def test_complex_cells_see_neither_polarity_nor_uniform_fields(complex_observer: OrientedObserver) -> None:
    image = np.random.default_rng(0).normal(size=(65, 65))
    activity = complex_observer.activity(image)
    for band, of_negative, brighter in zip(
        activity, complex_observer.activity(-image), complex_observer.activity(image + 3.0), strict=True
    ):
        assert np.array_equal(band, of_negative)
        assert np.allclose(band, brighter, rtol=0.0, atol=1e-13)
        assert (band >= 0.0).all()


def test_complex_cells_have_no_readout(complex_observer: OrientedObserver) -> None:
    stimulus = Stimulus(1.0, -1)
    assert complex_observer.readout(stimulus) is None
    with pytest.raises(SettingsError, match="observer: it is not linear"):
        contrast_threshold(complex_observer, size_mrad=1.0)


def test_complex_cells_score_frames_by_drawn_answers(make_dataset, complex_observer: OrientedObserver) -> None:
    dataset = load_dataset(make_dataset(contrasts=(0.02, 1.0), repeats=3).path)
    with pytest.raises(SettingsError, match="decisions: found 'expected', but this observer is not linear"):
        score_dataset(dataset, complex_observer)
    scored = score_dataset(dataset, complex_observer, decisions="sampled")
    assert np.isnan(scored.probabilities).all()
    level = np.array([trial.level for trial in scored.trials])
    assert (scored.p_correct[level == 1.0] == 1.0).all()
    assert scored.p_correct[level < 1.0].mean() < 0.75
    assert scored.fits[0].p_correct_error_bound == 0.0


def test_more_neurons_than_memory_holds_are_refused() -> None:
    with pytest.raises(
        SettingsError, match=r"orientations: found 8; for a triangle of 90 mrad they are 3\.6e\+08"
    ):
        observer().grid(Stimulus(90.0))
    assert observer(orientations=2, phases="odd").grid(Stimulus(90.0)).side == 4097


def test_orientation_is_what_the_neurons_are_named_by(complex_observer: OrientedObserver) -> None:
    """The base of an upright triangle is a horizontal edge: modulated along y, 90°, which is 4 of 8."""
    grid = complex_observer.grid(Stimulus(3.0))
    finest = complex_observer.activity(triangle_on(grid, 3.0))[0][0]
    below = grid.side // 2 + round(3.0**0.25 / 3.0 * 3.0 / grid.pitch_mrad)
    assert finest[:, below, grid.side // 2].argmax() == 4
