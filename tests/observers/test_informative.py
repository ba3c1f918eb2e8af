"""The informative observer: ideal for what the display shows, indifferent to filters that it knows."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.mtf import matched_settings
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal
from sensor_sim.chain.sampling import field_detectors, field_sampler
from sensor_sim.chain.sensor import Detector, Electronics, Optics, Sensor, SensorDisplay
from todframes.base.errors import SettingsError
from todframes.observers.hotelling import HotellingObserver, HotellingSettings
from todframes.observers.interface import Readout
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import RetinaGrid, resample, triangle_on
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import ORIENTATIONS, SIDE_PER_SIZE, Orientation, Stimulus

DISPLAYS = [
    {},
    {"display_blur_mrad": 0.2},
    {"display_blur_mrad": 1.0},
    {"sample_pitch_mrad": 0.7},
    {"sample_pitch_mrad": 0.7, "sample_width_mrad": 0.5, "display_blur_mrad": 0.3, "presample_blur_mrad": 0.2},
]
GAUSSIAN = Sensor(
    optics=Optics(aperture_mm=1e6, wavelength_um=4.0, blur_sigma_mrad=0.02),
    detector=Detector(pitch_mrad=0.07, width_mrad=0.06),
    display=SensorDisplay(
        pixels_per_detector=6, pixel_pitch_mm=0.25, viewing_distance_mm=350.0, background_luminance_cd_m2=50.0
    ),
)


def observer(**changes: object) -> HotellingObserver:
    return HotellingObserver(HotellingSettings(**changes))


def triangles(grid: RetinaGrid, size_mrad: float) -> np.ndarray:
    return np.array([triangle_on(grid, size_mrad, orientation) for orientation in ORIENTATIONS])


def scores(readout: Readout, images: np.ndarray) -> np.ndarray:
    return np.array([readout.score_deviations(image) for image in images])


def discriminability(readout: Readout, signals: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """d′ of each pair (j, k): distance of the means of score j less score k when j and when k is shown."""
    means = scores(readout, signals)
    found = []
    for j, k in permutations(range(4), 2):
        difference = np.eye(4)[j] - np.eye(4)[k]
        distance = difference @ (means[j] - means[k])
        found.append(distance / np.sqrt(difference @ covariance @ difference))
    return np.array(found)


@pytest.mark.parametrize("blur_px", [0.0, 2.0])
def test_expected_image_is_the_mean_over_the_places_on_the_detectors(blur_px: float) -> None:
    """Against simulated frames, of a sensor that is nowhere like a filter: sampled, held, shown in pixels.

    28 × 28 places, four times as many along an axis as there are retina samples on a detector. The pattern in
    which places repeat is at a zero of both hold and retina sample; of a picture with f cycles a detector they
    leave about (f/28)² together. So do the pixels in which the simulated display blurs. All is 6e-4.
    """
    sensor = replace(GAUSSIAN, display=replace(GAUSSIAN.display, blur_sigma_px=blur_px))
    size_detectors, display = 3.0, sensor.display
    observer = HotellingObserver(matched_settings(sensor, retina_pitch_mrad=display.detector_pitch_mrad / 7))
    stimulus = Stimulus(size_detectors * display.detector_pitch_mrad)
    grid = observer.grid(stimulus)
    expected = observer.displayed(triangles(grid, stimulus.size_mrad)[0])

    field = field_detectors(resolve(sensor), size_detectors)
    matrix = axis_matrix(field, pixels_per_detector=display.pixels_per_detector, blur_px=resolve(sensor).blurs_px)
    y, x = (places.ravel() for places in (np.mgrid[0:28, 0:28] + 0.5) / 28 - 0.5)
    samples = field_sampler(resolve(sensor), size_detectors).samples(x, y, orientation=Orientation.UP)
    seen = [
        resample(
            display_signal(one, matrix),
            grid,
            x_px=display_position_px(at_x, n_detectors=field, display=display),
            y_px=display_position_px(at_y, n_detectors=field, display=display),
            pixel_pitch_mrad=display.pixel_pitch_mrad,
        )
        for one, at_x, at_y in zip(samples, x, y, strict=True)
    ]
    assert np.allclose(np.mean(seen, axis=0), expected, rtol=0.0, atol=1e-3)
    # Far more than that is at stake.
    assert np.abs(triangles(grid, stimulus.size_mrad)[0] - expected).max() > 0.3


def test_optics_are_matched_at_nyquist() -> None:
    """Optics that are Gaussian already stay what they are, on the display's scale."""
    display = replace(GAUSSIAN.display, pixels_per_detector=4, viewing_distance_mm=500.0, blur_sigma_px=4.0)
    sensor = replace(
        GAUSSIAN,
        optics=Optics(aperture_mm=1e9, wavelength_um=4.0, blur_sigma_mrad=0.03),
        detector=Detector(pitch_mrad=0.1, width_mrad=0.08),
        electronics=Electronics(blur_sigma_px=3.0),
        display=display,
    )
    found = matched_settings(sensor, internal_noise=0.25)
    pitch = 4 * display.pixel_pitch_mrad
    assert found.presample_blur_mrad == pytest.approx(0.3 * pitch, rel=1e-6)
    assert found.sample_width_mrad == pytest.approx(0.8 * pitch)
    assert found.sample_pitch_mrad == pytest.approx(pitch)
    assert found.display_blur_mrad == pytest.approx(5 * display.pixel_pitch_mrad)
    assert found.internal_noise == 0.25
    diffracted = replace(sensor, optics=Optics(aperture_mm=8.0, wavelength_um=4.0))  # nothing beyond 2 cycles/mrad
    at_half = 2.0 / math.pi * (math.acos(0.5) - 0.5 * math.sqrt(0.75))  # of a circular aperture
    blur_mrad = math.sqrt(-math.log(at_half) / 2.0) / math.pi
    assert matched_settings(diffracted).presample_blur_mrad == pytest.approx(10.0 * pitch * blur_mrad, rel=1e-9)


def test_a_triangle_is_seen_as_wide_as_its_variance() -> None:
    """s²/24 of an equilateral triangle of side s, and the squares of blurs, and 1/12 of those of widths."""
    seen = observer(presample_blur_mrad=0.3, display_blur_mrad=0.4, sample_pitch_mrad=0.7, sample_width_mrad=0.5)
    variance = 0.3**2 + 0.4**2 + (0.5**2 + 0.7**2) / 12.0
    expected = math.sqrt(4.0 + 24.0 * variance / SIDE_PER_SIZE**2)
    assert seen._seen_size_mrad(Stimulus(2.0)) == pytest.approx(expected)
    assert observer(sample_pitch_mrad=0.7).settings.averaged_mrad == 0.7


@pytest.mark.every_case
@pytest.mark.parametrize("display", [{}, {"display_blur_mrad": 2.0}], ids=str)
def test_what_is_left_out_is_no_more_than_it_says(display: dict) -> None:
    """Two octaves more add next to nothing to d′², and no more than they would if all neurons were used."""
    stimulus, changes = Stimulus(7.0), {"position_jitter_samples": 0.0, **display}
    for share in (1.0, 0.99):
        settings = HotellingSettings(informative_share=share, **changes)
        usual, wide = (HotellingObserver(settings, more_levels=n).readout(stimulus) for n in (0, 2))
        added = wide.noise_covariance[0, 0] - usual.noise_covariance[0, 0]
        said = HotellingObserver(settings).omitted_bands(stimulus).noise_covariance[0, 0]
        # The triangle on the coarser retina is blurred by one coarse sample more.
        assert -1e-12 * usual.noise_covariance[0, 0] <= added <= 1.2 * said
        assert said < 1e-4 * usual.noise_covariance[0, 0]
    assert observer(sample_noise_sd=0.1).omitted_bands(stimulus) is None


def test_all_neurons_and_a_sharp_display_are_the_papers_observer() -> None:
    """What the four templates have in common cancels in the decision; the rest are the same weights."""
    for stimulus in (Stimulus(0.4), Stimulus(2.0, -1)):
        of_paper, found = PyramidObserver().readout(stimulus), observer(informative_share=1.0).readout(stimulus)
        scale = np.abs(of_paper.deviations).max()
        assert np.allclose(found.deviations, of_paper.deviations, rtol=0.0, atol=1e-13 * scale)
        assert np.allclose(found.noise_covariance, of_paper.noise_covariance, rtol=1e-12)
        assert not found.common.any()


def used_neurons(found: HotellingObserver, stimulus: Stimulus) -> np.ndarray:
    """Return which neurons have a weight in any template."""
    templates = [np.concatenate([band.ravel() for band in t]) for t in found.templates(stimulus)]
    return np.any(templates, axis=0)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_informative_neurons_are_the_fewest_with_their_share(share: float, display: dict) -> None:
    stimulus, every = Stimulus(1.0), observer(**display, informative_share=1.0)
    templates = [np.concatenate([band.ravel() for band in t]) for t in every.templates(stimulus)]
    squares = np.square(templates).sum(axis=0)
    used = used_neurons(observer(**display, informative_share=share), stimulus)
    assert squares[used].min() > squares[~used].max()
    kept = squares[used].sum() / squares.sum()
    # Neurons come in fours (eights, by the triangle's mirror symmetry), the one in the middle alone; without the
    # last of them the share is not reached.
    last = squares[used].min()
    assert share <= kept + 1e-12
    assert kept - 8 * last / squares.sum() < share
    assert used.mean() < 0.08


@pytest.mark.slow
def test_one_neuron_in_twenty_is_enough() -> None:
    """A hundredth less of the squared differences is half a hundredth less of d′."""
    for size_mrad in (1.0, 3.0):
        few = contrast_threshold(observer(), size_mrad=size_mrad).threshold
        assert few == pytest.approx(contrast_threshold(PyramidObserver(), size_mrad=size_mrad).threshold, rel=5e-3)


def dense(function: object, side: int) -> np.ndarray:
    """The matrix of a linear function of images."""
    columns = []
    for place in range(side**2):
        unit = np.zeros(side**2)
        unit[place] = 1.0
        result = function(unit.reshape(side, side))
        columns.append(np.concatenate([np.ravel(part) for part in result]))
    return np.array(columns).T


@pytest.mark.parametrize("share", [1.0, 0.95])
def test_weights_are_those_of_the_covariance_of_all_noise(share: float) -> None:
    """K⁻¹d by a direct solver, on the smallest pyramid: one band of 81 neurons."""
    display = {"levels": 1, "template_blur_samples": 0.0, "display_blur_mrad": 0.15, "informative_share": share}
    matched = observer(**display)
    found = observer(**display, sample_noise_sd=0.4, internal_noise_sd=0.1)
    stimulus = Stimulus(0.3)
    pyramid, shown = dense(found.activity, 9), dense(lambda image: [found.displayed(image)], 9)
    used = used_neurons(matched, stimulus)
    noise = pyramid @ shown
    covariance = (0.1**2 * np.eye(len(pyramid)) + 0.4**2 * noise @ noise.T)[np.ix_(used, used)]
    for template, difference in zip(found.templates(stimulus), matched.templates(stimulus), strict=True):
        weights = np.concatenate([band.ravel() for band in template])
        d = np.concatenate([band.ravel() for band in difference])
        expected = np.linalg.solve(covariance, d[used]) * (0.1**2 + 0.4**2)
        # Residual 1e-10 of d, over the smallest eigenvalue of K, which is its largest over 24.
        assert np.allclose(weights[used], expected, rtol=0.0, atol=1e-8 * np.abs(expected).max())
        assert not weights[~used].any()


class Sharpening(HotellingObserver):
    """The display also sharpens: 1 + 1.5 (1 − Gaussian), from 1 to 2.5, so nothing is lost."""

    def postsample_mtf(self, frequency_x: np.ndarray, frequency_y: np.ndarray) -> np.ndarray:
        blurred = np.exp(-2.0 * (np.pi * 0.3 * np.hypot(frequency_x, frequency_y)) ** 2)
        return super().postsample_mtf(frequency_x, frequency_y) * (1.0 + 1.5 * (1.0 - blurred))


def known_filters(**changes: object) -> list[HotellingObserver]:
    """Observers of a plain, a sharpening and a (mildly, so that it can be undone) blurring display."""
    plain = HotellingSettings(informative_share=1.0, **changes)
    blurring = replace(plain, display_blur_mrad=0.1)
    return [HotellingObserver(plain), Sharpening(plain), HotellingObserver(blurring)]


def external_covariance(observer: HotellingObserver, readout: Readout) -> np.ndarray:
    """Of the scores, under white noise of standard deviation 1 on each sample in front of the display.

    Weights go back through a mirrored filter by the filter itself, with half the weight on the outermost samples.
    """
    halves = np.ones(readout.grid.side)
    halves[[0, -1]] = 0.5
    border = np.outer(halves, halves)
    weights = np.array([border * observer.displayed(one / border) for one in readout.deviations])
    rng = np.random.default_rng(0)
    image = rng.normal(size=border.shape)
    assert np.allclose(readout.score_deviations(observer.displayed(image)), np.einsum("kij,ij->k", weights, image))
    return np.einsum("jyx,kyx->jk", weights, weights)


def test_an_invertible_filter_in_front_of_all_noise_of_the_eye_changes_no_score() -> None:
    """Noise in front of the filter, none behind it, ideal weights: noisy frame by noisy frame the same numbers.

    Then w solves L F Fᵀ Lᵀ w = L F d. The differences d have no mean, which is all that the pyramid L is blind to,
    so Fᵀ Lᵀ w = d: the scores ⟨w, L F x⟩ of a filtered image are ⟨d, x⟩, whatever F undoes.
    """
    stimulus = Stimulus(1.0)
    plain, *filtering = known_filters(internal_noise=0.0, sample_noise_sd=1.0)
    grid, rng = plain.grid(stimulus), np.random.default_rng(4)
    seen = [
        0.5 * one + rng.normal(size=one.shape) for one in triangles(grid, stimulus.size_mrad) for _ in range(5)
    ]
    expected = scores(plain.readout(stimulus), np.array(seen))
    blurred = np.array([plain.displayed(one) for one in seen])
    assert np.array_equal(scores(plain.readout(stimulus), blurred).argmax(axis=1), expected.argmax(axis=1))
    for other in filtering:
        found = scores(other.readout(stimulus), np.array([other.displayed(one) for one in seen]))
        # The solver leaves 1e-10 of d, which the blur's smallest transfer, 0.015, makes 7e-9 of the weights.
        assert np.allclose(found, expected, rtol=0.0, atol=1e-7 * np.abs(expected).max())
        assert np.array_equal(found.argmax(axis=1), expected.argmax(axis=1))


def test_such_an_observer_is_ideal_for_triangles_in_white_noise() -> None:
    """Whatever pyramid and display: d′ is that of the triangles themselves, ‖T_j − T_k‖/σ."""
    stimulus = Stimulus(1.0)
    for one in known_filters(internal_noise=0.0, sample_noise_sd=1.0, template_blur_samples=0.0):
        readout = one.readout(stimulus)
        direct = triangles(readout.grid, stimulus.size_mrad)
        shown = np.array([one.displayed(image) for image in direct])
        found = discriminability(readout, shown, external_covariance(one, readout))
        expected = [np.linalg.norm(direct[j] - direct[k]) for j, k in permutations(range(4), 2)]
        assert np.allclose(found, expected, rtol=1e-6)


def test_weights_that_are_not_found_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A display that leaves next to nothing of fine detail, and an eye without noise that would want it back."""
    monkeypatch.setattr("todframes.observers.hotelling.MOST_STEPS", 50)
    with pytest.raises(SettingsError, match=r"sample_noise_sd: found 1, whose ideal weights are not found in 50"):
        observer(internal_noise=0.0, sample_noise_sd=1.0, display_blur_mrad=1.0).readout(Stimulus(1.0))


def test_too_wide_a_blur_says_so() -> None:
    with pytest.raises(SettingsError, match=r"display: behind it, a triangle of 1 mrad is as wide as one of 644"):
        observer(display_blur_mrad=200.0).grid(Stimulus(1.0))
