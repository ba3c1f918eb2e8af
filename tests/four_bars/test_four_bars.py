"""Four bars for the model observer: the pattern, the folded scores against code apart, and the literal model."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from statistics import NormalDist

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal
from sensor_sim.chain.sensor import Detector, Noise, Optics, Sensor, SensorDisplay
from sensor_sim.thresholds.bars import BarChain, BarScores
from todframes.base.errors import SettingsError
from todframes.four_bars import FourBars
from todframes.observers.csf import CsfObserver
from todframes.observers.internal_noise import inner_product
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import resample
from todframes.stimulus import Orientation

SENSOR = Sensor(
    optics=Optics(aperture_mm=100.0, wavelength_um=10.0, blur_sigma_mrad=0.02),
    detector=Detector(pitch_mrad=0.1, width_mrad=0.09),
    display=SensorDisplay(
        pixels_per_detector=4,
        pixel_pitch_mm=0.3,
        viewing_distance_mm=400.0,
        background_luminance_cd_m2=50.0,
        blur_sigma_px=1.0,
    ),
    noise=Noise(netd_mk=20.0),
)
NYQUIST = 0.5 / SENSOR.pitch_mrad
COARSE = {"retina_pitch_mrad": 0.6, "template_blur_samples": 1.0}


@pytest.mark.parametrize("against", ["background", "square"])
def test_spectrum_is_the_transform_of_the_drawn_pattern(against):
    bars, n, pitch = FourBars(1.35, against), 120, 0.05  # edges of the bars are edges of pixels
    image, at = bars.image(n, pitch), np.arange(-n, n + 1) * pitch
    for fx, fy in ((0.0, 0.0), (0.4, 0.0), (0.3, 0.1), (-0.55, 0.25)):
        summed = np.exp(-2j * np.pi * fy * at) @ image @ np.exp(-2j * np.pi * fx * at) * pitch**2
        of_pixels = summed * np.sinc(fx * pitch) * np.sinc(fy * pitch)
        assert abs(of_pixels - bars.spectrum(fx, fy)) < 1e-12 * bars.side**2


def test_bars_and_spaces_have_the_mean_of_the_square():
    image = FourBars(2.0, "square").image(9, 1.0)
    assert abs(image.sum()) < 1e-12
    plain = FourBars(2.0, "background").image(9, 1.0)
    assert plain.sum() == pytest.approx(4 * 2.0 * 14.0)
    assert np.array_equal(np.unique(plain.max(axis=0).round(12)), [0.0, 0.5, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"bar_width": 0.0}, "bar_width: found 0.0"), ({"against": "grey"}, "against: found 'grey', expected o")],
)
def test_impossible_bars_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        FourBars(**{"bar_width": 1.0, **changes})


# Code apart: the chain as dense matrices, drawn in steps of 1/200 of a detector, with no module of the package.


@cache
def reduce_matrix(n):
    """REDUCE with [1 4 6 4 1]/16 and mirrored borders."""
    found = np.zeros(((n + 1) // 2, n))
    for row in range(len(found)):
        for step, weight in zip(range(-2, 3), np.array([1, 4, 6, 4, 1]) / 16, strict=True):
            at = abs(2 * row + step)
            found[row, at if at < n else 2 * (n - 1) - at] += weight
    return found


@cache
def expand_matrix(n):
    """EXPAND from (n + 1) // 2 to n samples."""
    spread = np.zeros((n, (n + 1) // 2))
    spread[::2] = np.eye((n + 1) // 2)
    blur = np.zeros((n, n))
    for row in range(n):
        for step, weight in zip(range(-2, 3), np.array([1, 4, 6, 4, 1]) / 8, strict=True):
            at = abs(row + step)
            blur[row, at if at < n else 2 * (n - 1) - at] += weight
    return blur @ spread


def bands_of(along_y, along_x, middle):
    """Bands of A·M·Bᵀ for each level, by dense matrices."""
    found, left, right = [], along_y, along_x
    n = len(left)
    while n > 5:
        down, up = reduce_matrix(n), expand_matrix(n)
        coarse = down @ left, down @ right
        found.append(left @ middle @ right.T - up @ coarse[0] @ middle @ coarse[1].T @ up.T)
        left, right = coarse
        n = len(left)
    return found


class BruteForce:
    """The same display, retina and observer by dense matrices; scene and optics drawn finely."""

    def __init__(self, frequency, against, side, field, fine=200):
        self.bar, self.fine, self.side = 0.5 / (frequency * 0.1), fine, side
        self.field = field
        self.pixel_mrad = 2000 * math.atan(0.3 / 800)
        self.level = 4 / 7 if against == "square" else 0.0
        shown = self.bar * 4 * self.pixel_mrad / 0.6
        at = np.arange(side) - side // 2
        along_x, along_y = self.profile(at, 1.0, shown)
        kernel = np.exp(-(np.arange(-8, 9) ** 2) / 2.0)
        kernel /= kernel.sum()
        blurred = (np.convolve(one, kernel, "same")[:, None] for one in (along_y, along_x))
        self.template = bands_of(*blurred, np.ones((1, 1)))

    def profile(self, at, width, bar):
        """Mean of the pattern over intervals, by clipped ends."""

        def of(low, high):
            return np.clip(np.minimum(at + width / 2, high) - np.maximum(at - width / 2, low), 0, None) / width

        square = of(-3.5 * bar, 3.5 * bar)
        bars = sum(of((k - 0.5) * bar, (k + 0.5) * bar) for k in (-3, -1, 1, 3))
        return bars - self.level * square, square

    def samples(self, x, y):
        """Samples from the waves of a pattern that is drawn finely and repeats after three fields."""
        period = 3 * self.field
        n = period * self.fine
        fine = (np.arange(n) + 0.5) / self.fine - period / 2
        waves = np.arange(-period, period + 1)  # up to the cut-off of the optics, 1 cycle per detector
        f = waves / period

        def transform(profile):
            # The drawn pixels blur by their own width, which is taken out again.
            return np.fft.fft(profile)[waves] / n * np.exp(-2j * np.pi * f * fine[0]) / np.sinc(f / self.fine)

        along_x = transform(self.profile(fine - x, 1 / self.fine, self.bar)[0])
        along_y = transform(self.profile(fine - y, 1 / self.fine, self.bar)[1])
        radial = np.hypot(f[:, None], f) / 0.1
        ratio = np.minimum(radial / 10.0, 1.0)
        optics = 2 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1 - ratio**2))
        optics *= np.exp(-2 * (np.pi * 0.02 * radial) ** 2)
        active = np.sinc(0.9 * f)
        at = np.exp(2j * np.pi * np.outer(np.arange(self.field) - (self.field - 1) / 2, f))
        return ((at * (along_y * active)) @ optics @ (at * (along_x * active)).T).real

    def onto_retina(self, middle):
        """Retina samples of each detector: hold, Gaussian of one pixel, overlap of areas."""
        n = 4 * self.field
        held = np.repeat(np.eye(self.field), 4, axis=0)
        kernel = np.exp(-(np.arange(-9, 10) ** 2) / 2 / 1.0)
        blurred = np.array([np.convolve(one, kernel / kernel.sum())[9:-9] for one in held.T]).T
        width = self.pixel_mrad / 0.6
        left = (np.arange(n) - 4 * (self.field / 2 + middle)) * width
        edge = np.arange(self.side) - self.side // 2 - 0.5
        overlap = np.minimum(edge[:, None] + 1, left + width) - np.maximum(edge[:, None], left)
        return np.clip(overlap, 0, None) @ blurred

    def weights(self, x, y):
        """Weight of every detector in the score of a retina at this place."""
        found, left, right, n = 0.0, self.onto_retina(y), self.onto_retina(x), self.side
        for band in self.template:
            down, up = reduce_matrix(n), expand_matrix(n)
            coarse = down @ left, down @ right
            found = found + left.T @ band @ right - (up @ coarse[0]).T @ band @ (up @ coarse[1])
            left, right = coarse
            n = len(left)
        return found

    def at(self, x, y, moved=((0.0, 0.0),)):
        """Scores of bars at a place for each displacement of the retina, and variances per squared noise."""
        seen, weights = self.samples(x, y), [self.weights(x + dx, y + dy) for dx, dy in moved]
        return np.array([((one * seen).sum(), np.square(one).sum()) for one in weights])

    @property
    def internal(self):
        return 0.5**2 / 12 * sum(float(np.square(band).sum()) for band in self.template)


@pytest.mark.parametrize("against", ["square", "background"])
@pytest.mark.parametrize("nyquists", [0.8, 1.2])
def test_scores_and_noise_are_those_of_code_apart(nyquists, against):
    chain = BarChain(resolve(SENSOR), PyramidObserver(**COARSE), nyquists * NYQUIST, against=against)
    brute = BruteForce(nyquists * NYQUIST, against, chain.whole_retina.side, chain.field)
    for x, y in ((0.0, 0.0), (-0.41, 0.13)):
        scores = chain.scores(np.array([x]), np.array([y]), np.zeros((1, 1, 2)))
        ((signal, noise),) = brute.at(x, y)
        # Drawing in steps of 1/200 detector is off by (f/200)² of the first waves that alias: 3e-5.
        assert scores.signal[0, 0] == pytest.approx(signal, rel=3e-5)
        assert scores.noise[0, 0] == pytest.approx(noise, rel=1e-6)  # OpenCV's kernel of the template has 1e-7
    assert chain.noise_variance == pytest.approx(brute.internal, rel=1e-9)


def test_noise_of_lines_is_that_of_code_apart():
    noise = replace(SENSOR.noise, row_noise_ratio=0.6, column_noise_ratio=0.3)
    lines = BarChain(resolve(replace(SENSOR, noise=noise)), PyramidObserver(**COARSE), 0.9 * NYQUIST)
    scores = lines.scores(np.array([0.2]), np.array([-0.1]), np.zeros((1, 1, 2)))
    weights = BruteForce(0.9 * NYQUIST, "square", lines.whole_retina.side, lines.field).weights(0.2, -0.1)
    # What a row has in common meets the sum of its weights.
    rows, columns = (np.square(weights.sum(axis=axis)).sum() for axis in (1, 0))
    expected = (1 - 0.36 - 0.09) * np.square(weights).sum() + 0.36 * rows + 0.09 * columns
    assert scores.noise[0, 0] == pytest.approx(expected, rel=1e-6)


# The definition: the display drawn, and every neuron.


def threshold(parts, internal):
    """SNR at which the mean of Φ(signal / √(2 variance)), with weights in the last column, is 75 %."""
    signal, noise, weight = np.transpose(parts)

    def excess(log_snr):
        variance = internal + noise / math.exp(2 * log_snr)
        return np.average(norm.cdf(signal / np.sqrt(2 * variance)), weights=weight) - 0.75

    return math.exp(brentq(excess, -6, 6))


@pytest.mark.every_case
@pytest.mark.parametrize(
    ("nyquists", "against"), [(0.6, "square"), (0.75, "background"), (0.9, "square"), (1.2, "square")]
)
def test_thresholds_over_phases_are_those_of_code_apart(nyquists, against):
    chain = BarChain(resolve(SENSOR), PyramidObserver(**COARSE), nyquists * NYQUIST, against=against)
    brute = BruteForce(nyquists * NYQUIST, against, chain.whole_retina.side, chain.field)
    # The bars are their own mirror images: a quarter of a detector's places is enough.
    moved = chain.jitter_detectors * np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) / math.sqrt(3.0)
    places, ends = np.linspace(0.0, 0.5, 5), np.array([0.5, 1.0, 1.0, 1.0, 0.5])
    parts = {
        (x, y): [(*one, ends[i] * ends[j]) for one in brute.at(x, y, moved)]
        for i, x in enumerate(places)
        for j, y in enumerate(places)
    }
    averaged, best = chain.averaged(0.75), chain.best(0.75)
    expected = threshold(np.concatenate([*parts.values()]), brute.internal)
    assert averaged.threshold == pytest.approx(expected, rel=5e-3)
    lowest = min(threshold(one, brute.internal) for one in parts.values())
    assert best.threshold == pytest.approx(lowest, rel=5e-3)
    assert best.threshold <= lowest * 1.001
    assert averaged.numerical_error <= 2e-3 * averaged.threshold
    assert best.numerical_error <= 2e-3 * best.threshold


@pytest.mark.parametrize(
    "observer",
    [
        PyramidObserver(**COARSE),
        PyramidObserver(**COARSE, kernel_a=0.4, include_residual=True, band_gain=1.5),
        OrientedObserver(**COARSE),
        CsfObserver(retina_pitch_mrad=0.2, aperture_sd_deg=0.2),
    ],
    ids=lambda one: type(one).__name__,
)
@pytest.mark.parametrize("direction", ["upright", "lying"])
def test_folded_scores_are_the_literal_ones(observer, direction):
    chain = BarChain(resolve(SENSOR), observer, 1.1 * NYQUIST, direction=direction)
    place, moved = np.array([0.2, -0.3]), np.array([0.03, 0.05])
    middle = place + moved
    scores = chain.scores(middle[:1], middle[1:], moved.reshape(1, 1, 2))
    orientation = {"upright": "up", "lying": "right"}[direction]
    samples = chain.sampler.samples(*place, orientation=Orientation(orientation))[0]
    literal = literal_score(chain, samples, middle)
    assert scores.signal[0, 0] == pytest.approx(literal, rel=1e-9)


def literal_score(chain: BarChain, samples: np.ndarray, middle: np.ndarray) -> float:
    """The score of detector samples as displayed to a retina with this middle."""
    display = SENSOR.display
    blurs = SENSOR.electronics.blur_sigma_px, display.blur_sigma_px
    matrix = axis_matrix(chain.field, pixels_per_detector=display.pixels_per_detector, blur_px=blurs)
    x_px, y_px = (display_position_px(at, n_detectors=chain.field, display=display) for at in middle)
    shown = display.gain * display_signal(samples, matrix)
    pitch = display.pixel_pitch_mrad
    seen = resample(shown, chain.whole_retina, x_px=x_px, y_px=y_px, pixel_pitch_mrad=pitch)
    template = chain.observer.pattern_template(chain.pattern, len(seen))
    return sum(map(inner_product, template, chain.observer.activity(seen)))


def test_proportion_correct_is_that_of_two_displays():
    chain = BarChain(resolve(SENSOR), PyramidObserver(**COARSE, internal_noise=0.0), 0.9 * NYQUIST)
    scores = BarScores(np.array([3.0]), np.array([4.0]))
    assert chain.proportion(scores, 2.0)[0] == pytest.approx(NormalDist().cdf(3.0 * 2.0 / math.sqrt(2 * 4.0)))
    assert chain.proportion(scores, math.inf)[0] == 1.0
    assert chain.proportion(BarScores(np.zeros(1), np.ones(1)), math.inf)[0] == pytest.approx(0.5)


@pytest.mark.parametrize("against", ["square", "background"])
def test_beyond_the_optics_cut_off_only_the_mean_is_seen(against):
    # 10 cycles/mrad; what is left of the bars is the edge of the square.
    chain = BarChain(resolve(SENSOR), PyramidObserver(**COARSE), 15.0, against=against)
    assert chain.whole_retina.side == (65 if against == "square" else 129)  # the mean is seen by a level more
    assert chain.averaged(0.75, tolerance=0.05).status == ("never_reached" if against == "square" else "ok")
