"""Makes the figures and numbers of paper.md: python docs/evidence/make_paper_figures.py [FOLDER].

Pictures go to FOLDER/paper, the text to FOLDER/paper.md; by default that is the folder of this script. What stands
in paper.md between <!-- =NAME --> and <!-- / --> is written anew; the same is printed. Seeds are fixed.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from msgspec import structs
from scipy.optimize import brentq

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import (
    delta_t_mk,
    excess_kurtosis,
    k_factor,
    sample_parts,
)
from sensor_sim.chain.pictures import trial_stages
from sensor_sim.chain.sensor import Sensor, load_sensor
from sensor_sim.chain.simulation import Simulator, plan_trials
from sensor_sim.chain.transfer import diffraction_mtf, pre_sample_mtf
from sensor_sim.four_bars.mrtd import BarsAt, mrtd
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from todframes.observers.decision import answer_probability
from todframes.observers.pyramid import LaplacianPyramid, PyramidObserver, PyramidSettings
from todframes.observers.retina import resample
from todframes.parameters import CurveName
from todframes.psychometrics.curves import observer_curve, weibull
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_trials
from todframes.psychometrics.threshold_search import ComputedThreshold
from todframes.scoring.naked_eye import acuity, contrast_threshold, proportion_correct
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
STAR_LIKE = ROOT / "sample_frames" / "star_like.toml"
NOISES = (0.5, 0.25)
NAKED_EYE_SIZES_MRAD = (0.5, 0.6, 1.0, 1.5, 3.0, 6.0)
CAMERA_SIZES = (4.0, 5.0, 6.0, 8.0)
BAR_FREQUENCIES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4)
BAR_CURVES = {"mean": "mrtd_mk", "best phase": "best_mrtd_mk", "Lloyd": "lloyd_mrtd_mk"}
BAR_COLOURS = ("#3b74c4", "#5a9132", "#cc6a2c")
COMPARED_MRAD = (0.6, 1.0, 3.0)
COMPARED_DETECTORS = (4.0, 6.0)
ACUITY_DELTA_T_MK = 1000.0
"""Where the paper puts the acuity, arbitrarily."""

PLACES = 13
"""Of lattices on a detector; no divisor in common with its display pixels, 6, or the retina samples on it, 28."""
STUDENT_95_OF_LINE = 2.3646
"""97.5 % point of Student's t for nine points and a line."""

DEFAULT = PyramidSettings()
AMBIGUITIES = {
    "internal noise: SD 0.5, not full width 0.5": replace(DEFAULT, internal_noise_sd=0.5),
    "centre: bounding box, not centroid": replace(DEFAULT, centre="bounding_box"),
    "kernel: a = 0.4, not 0.375": replace(DEFAULT, kernel_a=0.4),
    "low-pass residual takes part": replace(DEFAULT, include_residual=True),
    "band gain 2, not 1": replace(DEFAULT, band_gain=2.0),
}

Values = dict[str, str]


class CameraAcuity(NamedTuple):
    """Smallest size in detectors answered right in 75 % without detector noise, and its numerical error."""

    size_detectors: float
    numerical_error: float


# What is computed.


@cache
def star_like() -> Sensor:
    """The sensor of all camera figures."""
    return load_sensor(STAR_LIKE)


@cache
def observer(settings: PyramidSettings) -> PyramidObserver:
    """One observer for all of its sizes and sensors."""
    return PyramidObserver(settings)


def with_noise(internal_noise: float) -> PyramidSettings:
    """The default observer at another internal noise."""
    return replace(DEFAULT, internal_noise=internal_noise)


@cache
def contrast(settings: PyramidSettings, size_mrad: float) -> ComputedThreshold:
    """Naked-eye threshold contrast."""
    return contrast_threshold(observer(settings), size_mrad=size_mrad)


@cache
def naked_eye_acuity(settings: PyramidSettings) -> ComputedThreshold:
    """Naked-eye acuity at a contrast of 100 %."""
    return acuity(observer(settings))


@cache
def threshold_snr(sensor: Sensor, settings: PyramidSettings, size_detectors: float) -> PredictedThreshold:
    """Threshold SNR behind a sensor."""
    return predict_threshold(FoldedChain(resolve(sensor), observer(settings), size_detectors))


@cache
def four_bars(sensor: Sensor, settings: PyramidSettings) -> list[BarsAt]:
    """Thresholds of bars behind a sensor, for frequencies around Nyquist."""
    return mrtd(sensor, frequency_nyquist=BAR_FREQUENCIES, size_detectors=(), observer=observer(settings)).bars


def of_bars(sensor: Sensor, settings: PyramidSettings) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frequency in units of Nyquist and MRTD in mK by the name of the curve."""
    found = {}
    for name, key in BAR_CURVES.items():
        known = [(one.frequency_nyquist, getattr(one, key)) for one in four_bars(sensor, settings)]
        known = [pair for pair in known if pair[1] is not None]
        found[name] = tuple(np.transpose(known))
    return found


def shift_numbers() -> Values:
    """Figure 7: the factors of the frequency at which bars are as hard as triangles."""
    sensor, settings = star_like(), with_noise(0.5)
    curves, rows, factors = of_bars(sensor, settings), [], {name: [] for name in BAR_CURVES}
    levels = []
    for size in CAMERA_SIZES:
        warm = float(delta_t_mk(threshold_snr(sensor, settings, size).threshold, noise=sensor.noise))
        row = [f"{size:g}", f"{1.0 / size:.3f}", f"{warm:.4g}"]
        frequencies, lloyd = curves["Lloyd"]
        if 2.0 / size >= frequencies[0]:
            levels.append(warm / math.exp(float(np.interp(2.0 / size, frequencies, np.log(lloyd)))))
        for name, (frequency, threshold) in curves.items():
            if not threshold[0] <= warm <= threshold[-1]:
                row.append("outside")
                continue
            # The logarithm of a threshold is nearly a straight line in frequency.
            place = float(np.interp(math.log(warm), np.log(threshold), frequency))
            factors[name].append(1.0 / size / place)
            row.append(f"{place:.2f}, × {factors[name][-1]:.2f}")
        rows.append(row)
    at_nyquist = {name: float(np.interp(1.0, *curves[name])) for name in BAR_CURVES}
    head = ["size (detectors)", "1/size", "TOD (mK)", *(f"{name}: f / Nyquist, factor" for name in BAR_CURVES)]
    return {
        "shift": table(head, rows),
        "shift_bars": f"{min(factors['mean']):.2f} to {max(factors['mean']):.2f}",
        "shift_lloyd_level": f"{min(levels):.1f} to {max(levels):.1f}",
        "shift_lloyd": f"{min(factors['Lloyd']):.2f} to {max(factors['Lloyd']):.2f}",
        "mrtd_lloyd_ratio": f"{at_nyquist['Lloyd'] / at_nyquist['mean']:.1f}",
        "mrtd_phase_ratio": f"{at_nyquist['mean'] / at_nyquist['best phase']:.2f}",
    }


@cache
def camera_acuity(sensor: Sensor, settings: PyramidSettings) -> CameraAcuity:
    """Size at which P(correct) without detector noise is 75 %.

    P rises with the size in small waves, as the template's edges pass the neurons' places, and may cross 75 % more
    than once: bisection finds a place, a straight line of P over ln size through nine sizes within 8 % of it
    the acuity, and what is left about that line its error.
    """

    @cache
    def proportion(log_size: float) -> float:
        chain = FoldedChain(resolve(sensor), observer(settings), math.exp(log_size))
        rngs = map(np.random.default_rng, np.random.SeedSequence(6).spawn(2))
        return float(np.mean([chain.proportion_correct(chain.phases(PLACES, rng), math.inf) for rng in rngs]))

    step = math.log(1.2)
    low = high = math.log(3.0)
    while proportion(low) > 0.75:
        high, low = low, low - step
    while proportion(high) <= 0.75:
        low, high = high, high + step
    while high - low > 0.02:
        middle = (low + high) / 2.0
        low, high = (middle, high) if proportion(middle) <= 0.75 else (low, middle)
    log_sizes = low + np.linspace(-0.08, 0.08, 9)
    proportions = np.array([proportion(log_size) for log_size in log_sizes.tolist()])
    slope, intercept = np.polyfit(log_sizes, proportions, 1)
    left = proportions - (slope * log_sizes + intercept)
    error = STUDENT_95_OF_LINE * math.sqrt(float(left @ left) / 7.0 / 9.0) / slope
    size = math.exp((0.75 - intercept) / slope)
    return CameraAcuity(size, float(error) * size)


def display_changed(**changes: float) -> Sensor:
    """The star-like sensor on another display."""
    return replace(star_like(), display=replace(star_like().display, **changes))


def assumed_parameters() -> dict[str, Sensor]:
    """The star-like sensor with one assumed parameter changed at a time."""
    sensor = star_like()
    return {
        "aperture 110 mm, not 220 (or wavelength 8 µm, not 4)": replace(
            sensor, optics=replace(sensor.optics, aperture_mm=110.0)
        ),
        "optics blur 0.02 mrad, not 0.01": replace(sensor, optics=replace(sensor.optics, blur_sigma_mrad=0.02)),
        "active width 0.8 pitch, not 1": replace(
            sensor, detector=replace(sensor.detector, width_mrad=0.8 * sensor.pitch_mrad)
        ),
        "electronics blur 1 px, not 0": replace(
            sensor, electronics=replace(sensor.electronics, blur_sigma_px=1.0)
        ),
        "display blur 1 px, not 2": display_changed(blur_sigma_px=1.0),
        "display blur 3 px, not 2": display_changed(blur_sigma_px=3.0),
        "display pixel pitch 0.35 mm, not 0.25": display_changed(pixel_pitch_mm=0.35),
        "display gain 0.5, not 1": display_changed(gain=0.5),
        "display gain 2, not 1": display_changed(gain=2.0),
    }


# The text's numbers.


def number(value: float | None, error: float | None = None) -> str:
    """A number, with its numerical error of one digit, or to four significant digits."""
    if value is None:
        return "none"
    if error is None:
        return f"{value:.4g}"
    if error == 0.0:
        return number(value)
    decimals = max(0, -math.floor(math.log10(error)))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def ratio(value: float | None, default: float | None) -> str:
    """A ratio to the default's threshold, or that there is no threshold."""
    return "never reached" if value is None or default is None else f"× {value / default:.3f}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, as a block of its own."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n\n"


def naked_eye_numbers() -> Values:
    """Figure 5: thresholds of both observers."""
    both = [with_noise(noise) for noise in NOISES]
    rows = []
    for size in NAKED_EYE_SIZES_MRAD:
        found = [contrast(settings, size) for settings in both]
        numbers = [number(one.threshold, one.numerical_error) for one in found]
        rows.append([f"{size:g}", *numbers, f"{found[0].threshold / found[1].threshold:.6f}"])
    acuities = [naked_eye_acuity(settings) for settings in both]
    change = acuities[0].threshold / acuities[1].threshold
    acuity_row = [number(one.threshold, one.numerical_error) for one in acuities]
    rows.append(["acuity at contrast 1 (mrad)", *acuity_row, f"{change:.3f}"])
    slopes = [
        math.log(contrast(DEFAULT, b).threshold / contrast(DEFAULT, a).threshold) / math.log(b / a)
        for a, b in pairwise(NAKED_EYE_SIZES_MRAD)
    ]
    return {
        "naked_eye": table(["size (mrad)", "noise 0.5", "noise 0.25", "ratio"], rows),
        "naked_eye_acuity_change": f"{100 * (change - 1):.1f} %",
        "naked_eye_slope_small": f"{slopes[0]:.1f}",
        "naked_eye_slope_large": f"{slopes[-1]:.2f}",
    }


def camera_numbers() -> Values:
    """Figures 6 and 7: thresholds of both observers."""
    sensor = star_like()
    both = [with_noise(noise) for noise in NOISES]
    snr_rows, delta_t_rows, ratios = [], [], []
    for size in CAMERA_SIZES:
        found = [threshold_snr(sensor, settings, size) for settings in both]
        ratios.append(found[0].threshold / found[1].threshold)
        snrs = [number(one.threshold, one.numerical_error) for one in found]
        snr_rows.append([f"{size:g}", *snrs, f"{ratios[-1]:.3f}"])
        per_snr = float(delta_t_mk(1.0, noise=sensor.noise))
        delta_ts = [number(per_snr * one.threshold, per_snr * one.numerical_error) for one in found]
        other = [f"{float(k_factor(sensor.noise) ** 2 * per_snr * one.threshold):.1f}" for one in found]
        delta_t_rows.append([f"{size:g}", f"{1.0 / size:.3f}", *delta_ts, *other])
    acuities = [camera_acuity(sensor, settings) for settings in both]
    perfect = camera_acuity(sensor, with_noise(0.0))
    change = acuities[0].size_detectors / acuities[1].size_detectors
    snr_rows.append(["acuity (detectors)", *(number(*one) for one in acuities), f"{change:.3f}"])
    head = ["size (detectors)", "1/size", "noise 0.5", "noise 0.25", "0.5, as printed", "0.25, as printed"]
    return {
        "camera": table(["size (detectors)", "SNR, noise 0.5", "SNR, noise 0.25", "ratio"], snr_rows),
        "delta_t": table(head, delta_t_rows),
        "camera_ratio_smallest": f"{ratios[0]:.2f}",
        "camera_ratio_largest": f"{ratios[-1]:.2f}",
        "camera_acuity_ratio": f"{change:.2f}",
        "camera_acuity_perfect": number(*perfect),
        "camera_limits": ", ".join(
            f"{100 * camera_proportion(sensor, DEFAULT, size, math.inf):.1f} %" for size in CAMERA_SIZES
        ),
    }


@cache
def camera_proportion(sensor: Sensor, settings: PyramidSettings, size: float, snr: float) -> float:
    """P(correct) behind a sensor, over eight shifted lattices."""
    chain, phases = camera_trials(sensor, settings, size)
    return float(np.mean([chain.proportion_correct(part, snr) for part in phases]))


@cache
def camera_trials(sensor: Sensor, settings: PyramidSettings, size: float) -> tuple[FoldedChain, list]:
    """A sensor folded for a size, and the trials of eight lattices."""
    chain = FoldedChain(resolve(sensor), observer(settings), size)
    rngs = map(np.random.default_rng, np.random.SeedSequence(4).spawn(8))
    return chain, [chain.phases(PLACES, rng) for rng in rngs]


def sensitivity_numbers() -> Values:
    """How far the thresholds move for each ambiguous default and each assumed parameter."""
    sensor = star_like()
    base = [contrast(DEFAULT, size).threshold for size in COMPARED_MRAD]
    base_acuity = naked_eye_acuity(DEFAULT).threshold
    rows = [["default", *(number(value) for value in base), number(base_acuity)]]
    for name, settings in AMBIGUITIES.items():
        moved = [contrast(settings, size).threshold for size in COMPARED_MRAD]
        ratios = [ratio(*pair) for pair in zip(moved, base, strict=True)]
        rows.append([name, *ratios, ratio(naked_eye_acuity(settings).threshold, base_acuity)])
    head = ["threshold contrast", *(f"{size:g} mrad" for size in COMPARED_MRAD), "acuity (mrad)"]
    of_observer = table(head, rows)

    base = [threshold_snr(sensor, DEFAULT, size).threshold for size in COMPARED_DETECTORS]
    base_acuity = camera_acuity(sensor, DEFAULT).size_detectors
    default_row = ["default", *(number(value) for value in base), f"{base_acuity:.2f}"]
    head = ["threshold SNR", *(f"{size:g} detectors" for size in COMPARED_DETECTORS), "acuity (detectors)"]

    def camera_table(cases: Mapping[str, tuple[Sensor, PyramidSettings]]) -> str:
        rows = [default_row]
        for name, case in cases.items():
            moved = [threshold_snr(*case, size).threshold for size in COMPARED_DETECTORS]
            ratios = [ratio(*pair) for pair in zip(moved, base, strict=True)]
            rows.append([name, *ratios, ratio(camera_acuity(*case).size_detectors, base_acuity)])
        return table(head, rows)

    return {
        "ambiguities_naked_eye": of_observer,
        "ambiguities_camera": camera_table({name: (sensor, case) for name, case in AMBIGUITIES.items()}),
        "assumed_moves": camera_table({name: (case, DEFAULT) for name, case in assumed_parameters().items()}),
    }


def levels_between(
    proportion: Callable[[float], float], bounds: tuple[float, float], near: float
) -> np.ndarray | None:
    """Nine levels, at equal ratios, from one proportion correct to another; None if that is not reached."""
    reach = math.log(32.0)

    def where(p: float) -> float:
        return brentq(lambda t: proportion(near * math.exp(t)) - p, -reach, reach, xtol=1e-6)

    if proportion(near * math.exp(reach)) <= bounds[1]:
        return None
    low, high = map(where, bounds)
    return near * np.exp(np.linspace(low, high, 9))


def curve_fit(
    proportion: Callable[[float], float],
    levels: np.ndarray,
    curve: CurveName = "weibull",
    lapse_rate_max: float = 0.05,
) -> PsychometricFit:
    """Eq. 3, or the observer's curve, through proportions that have no error."""
    points = [proportion(level) for level in levels]
    settings = FitSettings(resamples=0, lapse_rate_max=lapse_rate_max)
    return fit_trials(levels, points, curve=curve, settings=settings, rng=np.random.default_rng(0))


def fitted_curve(fit: PsychometricFit, level: np.ndarray) -> np.ndarray:
    """The curve of a fit."""
    if fit.observer_curve is not None:
        return observer_curve(level, **structs.asdict(fit.observer_curve))
    return weibull(level, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate, lapse_rate=fit.lapse_rate)


@cache
def naked_eye_proportion(level: float) -> float:
    """P(correct) of the default observer for 1 mrad."""
    return proportion_correct(observer(DEFAULT), size_mrad=1.0, contrast=level, nodes=12)


def weibull_numbers() -> Values:
    """How far a Weibull fit of computed points is from where these cross 75 %."""
    sensor = star_like()

    def camera(size: float) -> tuple[Callable[[float], float], float]:
        return lambda snr: camera_proportion(sensor, DEFAULT, size, snr), threshold_snr(
            sensor, DEFAULT, size
        ).threshold

    small, large = camera(CAMERA_SIZES[0]), camera(CAMERA_SIZES[-1])
    eye = naked_eye_proportion, contrast(DEFAULT, 1.0).threshold
    of_large, of_small = (f"camera, {size:g} detectors" for size in (CAMERA_SIZES[-1], CAMERA_SIZES[0]))
    cases = (
        ("naked eye, 1 mrad: eq. 3", *eye, "weibull", 0.05),
        ("the observer's curve", *eye, "observer", 0.05),
        (f"{of_large}: eq. 3", *large, "weibull", 0.05),
        ("the observer's curve", *large, "observer", 0.05),
        (f"{of_small}: eq. 3", *small, "weibull", 0.05),
        ("eq. 3, δ up to 0.2", *small, "weibull", 0.2),
        ("the observer's curve", *small, "observer", 0.05),
    )
    ranges = ((0.3, 0.99), (0.5, 0.98), (0.5, 0.9), (0.65, 0.85))
    rows, off_75 = [], {}
    for number, (name, proportion, near, curve, lapse_rate_max) in enumerate(cases):
        exact = brentq(lambda x, p=proportion: p(x) - 0.75, near / 2.0, near * 2.0, rtol=1e-6)
        row = [name]
        for bounds in ranges:
            levels = levels_between(proportion, bounds, near)
            if levels is None:
                row.append("not reached")
                continue
            fit = curve_fit(proportion, levels, curve, lapse_rate_max)
            off = max(abs(fitted_curve(fit, x) - proportion(x)) for x in levels)
            off_75[number, bounds] = f"{100 * abs(fit.threshold / exact - 1):.1f} %"
            row.append(f"{100 * (fit.threshold / exact - 1):+.2f} % ({100 * off:.2f})")
        rows.append(row)
    head = ["", *(f"{100 * low:g}–{100 * high:g} % correct" for low, high in ranges)]
    return {
        "weibull": table(head, rows),
        "weibull_wide": off_75[0, ranges[0]],
        "weibull_usual": off_75[0, ranges[1]],
        "weibull_ceiling": off_75[4, ranges[2]],
    }


def weights_on_detectors(chain: FoldedChain, x: float, y: float) -> np.ndarray:
    """Weights of the four score deviations on the detectors, the retina's middle at a place: (4, field²)."""
    return chain.camera.gain * chain.plan.all_four(chain.folding.weights(x, y))


SENSORS = 24


def noise_numbers() -> Values:
    """What the noise's distribution does at most, and how far a sensor's own pattern moves its threshold."""
    head = ["size (detectors)", "detectors that count", "bound on ΔP", "on threshold", "SD between sensors"]
    return {
        "noise": table(head, [noise_row(size) for size in COMPARED_DETECTORS]),
        "noise_sensors": f"{SENSORS}",
    }


def noise_row(size: float) -> list[str]:
    """The same for one size, on a grid of 5 × 5 places."""
    sensor = star_like()
    chain = FoldedChain(resolve(sensor), observer(DEFAULT), size)
    found = threshold_snr(sensor, DEFAULT, size)
    at = (np.arange(5) + 0.5) / 5.0 - 0.5
    y, x = (m.ravel() for m in np.meshgrid(at, at, indexing="ij"))
    weights = np.array([weights_on_detectors(chain, *place) for place in zip(x, y, strict=True)])
    samples = [chain.sampler.samples(x, y, orientation=one).reshape(len(x), -1) for one in ORIENTATIONS]
    signal = np.einsum("pkn,opn->opk", weights, np.array(samples))
    covariance = weights @ weights.swapaxes(1, 2)

    # The first Edgeworth term of a score difference is at most 0.5506 κ/24; three of them decide.
    squares = np.square(weights[:, :1] - weights[:, 1:])
    participation = float((np.square(squares).sum(axis=2) / squares.sum(axis=2) ** 2).mean(axis=0).max())
    bound = 3.0 * 0.5506 / 24.0 * abs(excess_kurtosis(sensor.noise)) * participation
    (low, p_low), (high, p_high) = found.points[2], found.points[4]
    slope = (p_high - p_low) / math.log(high / low)

    def threshold(pattern: np.ndarray | None) -> float:
        """Threshold of one sensor or, without a pattern, of the mean over all."""

        def excess(log_snr: float) -> float:
            parts = sample_parts(sensor.noise, total_sd=math.exp(-log_snr))
            static = 0.0 if pattern is None else parts.own_pattern * (weights @ pattern)
            drawn_anew = parts.own_noise**2 + (parts.own_pattern**2 if pattern is None else 0.0)
            noise = chain.readout.noise_covariance + drawn_anew * covariance
            right = [answer_probability(signal[k] + static, noise, k, tolerance=1e-9) for k in range(4)]
            return float(np.mean(right)) - 0.75

        middle = math.log(found.threshold)
        return math.exp(brentq(excess, middle - 1.5, middle + 2.0, xtol=1e-3))

    rngs = map(np.random.default_rng, np.random.SeedSequence(8).spawn(SENSORS))
    root_3 = math.sqrt(3.0)
    each = np.array([threshold(rng.uniform(-root_3, root_3, chain.field**2)) for rng in rngs])
    spread_of_sensors = 100 * each.std(ddof=1) / threshold(None)
    numbers = [f"{1.0 / participation:.0f}", f"{bound:.4f}", f"{100 * bound / slope:.1f} %"]
    return [f"{size:g}", *numbers, f"{spread_of_sensors:.0f} %"]


LITERAL_TRIALS = 400


def binomial_95(proportion: float) -> float:
    """Half-width of the 95 % interval of a proportion of the drawn answers."""
    return 1.96 * math.sqrt(proportion * (1.0 - proportion) / LITERAL_TRIALS)


@cache
def literal_naked_eye(contrast_level: float) -> float:
    """Proportion correct for 1 mrad as the paper gets it: noise drawn on each neuron, the largest score."""
    eye, stimulus = observer(DEFAULT), Stimulus(1.0)
    grid = eye.grid(stimulus)
    rng = np.random.default_rng([4, round(1e6 * contrast_level)])
    correct = 0
    for n in range(LITERAL_TRIALS):
        x, y = grid.side // 2 + rng.uniform(-0.5, 0.5, 2)
        shown = ORIENTATIONS[n % 4]
        image = coverage((grid.side,) * 2, size_px=1.0 / grid.pitch_mrad, x_px=x, y_px=y, orientation=shown)
        correct += eye.respond(contrast_level * image, stimulus, rng) is shown
    return correct / LITERAL_TRIALS


def literal_camera(size: float, snr: float) -> float:
    """Proportion correct of answers to drawn frames, each ten from another sensor."""
    sensor, eye = star_like(), observer(DEFAULT)
    display = sensor.display
    stimulus = Stimulus(size * display.detector_pitch_mrad)
    grid = eye.grid(stimulus)
    reach_px = 0.5 * grid.pitch_mrad / display.pixel_pitch_mrad
    rng = np.random.default_rng(5)
    correct = 0
    for seed in range(LITERAL_TRIALS // 10):
        trials = plan_trials([size], [snr], 10)
        for trial, frame in zip(trials, Simulator(sensor, size, seed=seed).frames(trials), strict=True):
            shown = frame.luminance_cd_m2 / display.background_luminance_cd_m2 - 1.0
            dx, dy = rng.uniform(-reach_px, reach_px, 2)
            pitch = display.pixel_pitch_mrad
            retina = resample(shown, grid, x_px=frame.x_px + dx, y_px=frame.y_px + dy, pixel_pitch_mrad=pitch)
            correct += eye.respond(retina, stimulus, rng) is trial.orientation
    return correct / LITERAL_TRIALS


def stage_numbers() -> Values:
    """Single figures of the paper's sections 3, 4 and 8."""
    sensor = star_like()
    cut_off = resolve(sensor).optics.cut_off_cyc_per_mrad
    nyquist = resolve(sensor).nyquist_cyc_per_mrad
    optics = {"wavelength_um": sensor.optics.wavelength_um, "aperture_mm": sensor.optics.aperture_mm}
    along_axis = float(diffraction_mtf(0.5 * cut_off / math.sqrt(2.0), **optics))
    at_nyquist = pre_sample_mtf(nyquist, 0.0, camera=resolve(sensor))
    retina = DEFAULT.retina_pitch_mrad
    size = CAMERA_SIZES[0]
    snr = threshold_snr(sensor, DEFAULT, size).threshold
    drawn = literal_camera(size, snr)
    k = k_factor(sensor.noise)
    half, half_power = ([bandwidth_octaves(band, share) for band in (1, 2, 3)] for share in (0.5, math.sqrt(0.5)))
    return {
        "retina_nyquist": f"{math.pi / 180.0 * 1000.0 / (2.0 * retina):.2f}",
        "mtf_2d": f"{float(diffraction_mtf(0.5 * cut_off, **optics)):.3f}",
        "mtf_product": f"{along_axis**2:.3f}",
        "cut_off": f"{cut_off:.3g}",
        "nyquist": f"{nyquist:.3g}",
        "mtf_at_nyquist": f"{float(at_nyquist):.2f}",
        "k": f"{k:.4f}",
        "k_squared": f"{k * k:.2f}",
        "detector_on_display": f"{sensor.display.detector_pitch_mrad:.2f}",
        "samples_per_detector": f"{sensor.display.detector_pitch_mrad / retina:.0f}",
        "literal_size": f"{size:g}",
        "literal_snr": f"{snr:.2f}",
        "literal_camera": f"{100 * drawn:.1f} ± {100 * binomial_95(drawn):.1f} %",
        "literal_trials": f"{LITERAL_TRIALS}",
        "neuron_sum": f"{max(abs(weights.sum()) for weights in map(receptive_field, range(4))):.1g}",
        "bandwidth": spread(half),
        "bandwidth_half_power": spread(half_power),
    }


RECEPTIVE_FIELD_LEVELS = 5


@cache
def receptive_field(band: int) -> np.ndarray:
    """Weights of the neuron in the middle of a band on the retina samples: the adjoint of a unit there."""
    side = 4 * 2**RECEPTIVE_FIELD_LEVELS + 1
    sides = [(side - 1) // 2**k + 1 for k in range(RECEPTIVE_FIELD_LEVELS + 1)]
    bands = [np.zeros((n, n)) for n in sides]
    bands[band][sides[band] // 2, sides[band] // 2] = 1.0
    return LaplacianPyramid(RECEPTIVE_FIELD_LEVELS, DEFAULT.kernel_a).adjoint(bands)


def bandwidth_octaves(band: int, share: float) -> float:
    """Octaves between the frequencies along x where a neuron's response is this share of its largest."""
    transfer = np.abs(np.fft.rfft(receptive_field(band).sum(axis=0), 2**14))
    passed = np.flatnonzero(transfer >= share * transfer.max())
    return math.log2(passed[-1] / passed[0])


def spread(values: Sequence[float]) -> str:
    """The smallest and the largest, or one if they look alike."""
    low, high = f"{min(values):.1f}", f"{max(values):.1f}"
    return low if low == high else f"{low} to {high}"


# The pictures.


def logarithmic(axes: Axes, x_ticks: Sequence[float], y_ticks: Sequence[float]) -> None:
    """Logarithmic axes with these plain numbers."""
    axes.set(xscale="log", yscale="log")
    for axis, ticks in ((axes.xaxis, x_ticks), (axes.yaxis, y_ticks)):
        axis.set_ticks(ticks)
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", alpha=0.3)


def figure_1() -> Figure:
    """One trial, stage by stage."""
    sensor = star_like()
    trial = plan_trials([6.0], [4.0], 1)[0]
    stages = trial_stages(sensor, trial, seed=1)
    titles = ("input", "optics", "detector response", "samples", "detector noise", "sample & hold", "display")
    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    panels = figure.subplots(2, 4, sharex=True, sharey=True).ravel()
    for axes, (name, image), title in zip(panels, stages.items(), titles, strict=False):
        half = stages["d_samples"].shape[0] / 2.0
        picture = axes.imshow(image, cmap="gray", vmin=-0.6, vmax=1.6, extent=(-half, half, half, -half))
        axes.set(xlim=(-7, 7), ylim=(7, -7), xticks=(-5, 0, 5), yticks=(-5, 0, 5))
        axes.set_title(f"{name[0]}) {title}", fontsize="medium")
    panels[0].set_ylabel("y (detectors)")
    panels[4].set_ylabel("y (detectors)")
    for axes in panels[4:7]:
        axes.set_xlabel("x (detectors)")
    panels[3].tick_params(labelbottom=True)
    panels[7].axis("off")
    scale = panels[7].inset_axes((0.05, 0.0, 0.1, 1.0))
    figure.colorbar(picture, cax=scale, label="signal (large triangle: 1)")
    return figure


def figure_2() -> Figure:
    """A neuron's receptive field."""
    figure = Figure(figsize=(8.4, 3.8), layout="constrained")
    solid = figure.add_subplot(1, 2, 1, projection="3d")
    weights = receptive_field(2)
    middle, reach = weights.shape[0] // 2, 16
    part = weights[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    place = DEFAULT.retina_pitch_mrad * np.arange(-reach, reach + 1)
    solid.plot_surface(
        *np.meshgrid(place, place), part, cmap="viridis", rcount=33, ccount=33, lw=0, antialiased=False
    )
    solid.set(xlabel="x (mrad)", ylabel="y (mrad)", title="weights of band 2")
    profile = figure.add_subplot(1, 2, 2)
    retina = DEFAULT.retina_pitch_mrad * (np.arange(weights.shape[0]) - middle)
    for band in range(4):
        section = receptive_field(band)[middle]
        style = "o-" if band == 0 else "-"
        profile.plot(retina, section / section.max(), style, ms=3, lw=1.3, color=f"C{band}", label=f"band {band}")
    profile.axhline(0.0, color="0.6", lw=0.8)
    profile.set(
        xlim=(-4, 4), xlabel="x (mrad)", ylabel="weight / largest weight", title="sections through the middle"
    )
    profile.legend(fontsize="small")
    profile.grid(alpha=0.3)
    return figure


def figure_3() -> Figure:
    """Bands of a triangle without and with internal noise."""
    eye, stimulus = observer(DEFAULT), Stimulus(4.0)
    grid = eye.grid(stimulus)
    image = coverage(
        (grid.side,) * 2,
        size_px=4.0 / grid.pitch_mrad,
        x_px=grid.side // 2,
        y_px=grid.side // 2,
        orientation=Orientation.UP,
    )
    activity = eye.activity(image)
    rng = np.random.default_rng(3)
    half_width = DEFAULT.internal_noise / 2.0
    figure = Figure(figsize=(9.2, 3.7), layout="constrained")
    panels = figure.subplots(2, len(activity), sharex=True, sharey=True)
    for k, band in enumerate(activity):
        # Each neuron is a square as wide as they are apart, its middle at the neuron's place.
        reach = grid.pitch_mrad * 2**k * band.shape[0] / 2.0
        noisy = band + rng.uniform(-half_width, half_width, band.shape)
        for row, values in enumerate((band, noisy)):
            axes = panels[row, k]
            extent = (-reach, reach, reach, -reach)
            picture = axes.imshow(values, cmap="gray", vmin=-0.5, vmax=0.5, extent=extent, interpolation="nearest")
            axes.set(xlim=(-6, 6), ylim=(6, -6), xticks=(-5, 0, 5), yticks=(-5, 0, 5))
        panels[0, k].set_title(f"band {k}", fontsize="medium")
        panels[1, k].set_xlabel("x (mrad)")
    for row, name in enumerate(("no internal noise", f"noise {DEFAULT.internal_noise:g} wide")):
        panels[row, 0].set_ylabel(f"{name}\ny (mrad)")
    figure.colorbar(picture, ax=panels, shrink=0.8, label="activity")
    return figure


def figure_4() -> Figure:
    """A psychometric function, computed and drawn, and eq. 3 through the computed points."""
    near = contrast(DEFAULT, 1.0).threshold
    levels = levels_between(naked_eye_proportion, (0.3, 0.99), near)
    assert levels is not None
    points = np.array([naked_eye_proportion(level) for level in levels])
    fit = curve_fit(naked_eye_proportion, levels)
    fine = np.geomspace(0.5 * levels[0], 1.5 * levels[-1], 200)
    figure = Figure(figsize=(6.0, 5.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    legend = f"Weibull fit: α {fit.alpha:.4f}, β {fit.beta:.3f}, δ {fit.lapse_rate:.4f}"
    upper.plot(fine, fitted_curve(fit, fine), color="C1", lw=1.4, label=legend)
    upper.plot(levels, points, "o", color="C0", label="computed")
    drawn = np.array([literal_naked_eye(level) for level in levels[1::2].tolist()])
    error = [binomial_95(proportion) for proportion in drawn]
    label = f"{LITERAL_TRIALS} drawn answers each, 95 %"
    upper.errorbar(levels[1::2] * 1.02, drawn, error, fmt="s", color="0.45", ms=4, capsize=2, lw=1, label=label)
    upper.axhline(0.75, color="0.4", ls="--", lw=0.8)
    upper.axhline(0.25, color="0.4", ls=":", lw=0.8)
    upper.set(ylim=(0.2, 1.02), ylabel="proportion correct", title="naked eye, 1 mrad, internal noise 0.5")
    upper.legend(fontsize="small", loc="lower right")
    lower.plot(levels, 100 * (points - fitted_curve(fit, levels)), "o-", color="C0", lw=1)
    lower.axhline(0.0, color="C1", lw=1.4)
    lower.set(xscale="log", xlabel="contrast", ylabel="computed − fit\n(percentage points)", ylim=(-4, 4))
    lower.set_xticks([0.01, 0.02, 0.05, 0.1, 0.2, 0.5], ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5"])
    lower.xaxis.set_minor_formatter(NullFormatter())
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    return figure


STYLES = {0.5: ("C0", "o"), 0.25: ("C3", "s")}


def figure_5() -> Figure:
    """The naked eye's TOD curve."""
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    for noise in NOISES:
        colour, marker = STYLES[noise]
        settings = with_noise(noise)
        smallest = naked_eye_acuity(settings).threshold
        sizes = np.array([*NAKED_EYE_SIZES_MRAD[::-1], smallest])
        heights = [*(contrast(settings, size).threshold for size in sizes[:-1]), 1.0]
        axes.plot(1.0 / sizes, heights, "-", color=colour, lw=1.2)
        axes.plot(1.0 / sizes[:-1], heights[:-1], marker, color=colour, label=f"internal noise {noise:g}")
        label = f"acuity {smallest:.3f} mrad"
        axes.plot(1.0 / smallest, 1.0, marker, color=colour, markerfacecolor="white", ms=8, label=label)
    logarithmic(axes, (0.2, 0.5, 1, 2, 3), (0.02, 0.05, 0.1, 0.2, 0.5, 1))
    axes.set(xlabel="1 / size (mrad⁻¹)", ylabel="threshold contrast", title="naked eye, 75 % correct")
    axes.legend(fontsize="small", loc="upper left")
    return figure


def figure_6() -> Figure:
    """The simulated camera: threshold SNR of four sizes, and the acuity."""
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    for noise in NOISES:
        colour, marker = STYLES[noise]
        settings = with_noise(noise)
        heights = [threshold_snr(star_like(), settings, size).threshold for size in CAMERA_SIZES]
        axes.plot(
            CAMERA_SIZES, heights, marker, ls="-", color=colour, lw=1.2, label=f"SNR, internal noise {noise:g}"
        )
        smallest = camera_acuity(star_like(), settings).size_detectors
        axes.axvline(
            smallest, color=colour, ls=":" if noise == 0.5 else "--", label=f"acuity {smallest:.2f} detectors"
        )
    logarithmic(axes, (2, 3, 4, 5, 6, 8), (0.7, 1, 1.5, 2, 3))
    axes.set(xlim=(2, 9), ylim=(0.6, 3.2), xlabel="size (detectors)", ylabel="threshold SNR")
    axes.set_title("simulated staring camera, 75 % correct")
    axes.legend(fontsize="small")
    return figure


def figure_7() -> Figure:
    """The same as temperature differences."""
    sensor = star_like()
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    for noise in NOISES:
        colour, marker = STYLES[noise]
        settings = with_noise(noise)
        inverse = 1.0 / np.array(CAMERA_SIZES)
        snr = np.array([threshold_snr(sensor, settings, size).threshold for size in CAMERA_SIZES])
        delta_t = delta_t_mk(snr, noise=sensor.noise)
        label = f"internal noise {noise:g}, SNR · NETD / k"
        axes.plot(inverse, delta_t, marker, ls="-", color=colour, lw=1.2, label=label)
        printed = k_factor(sensor.noise) ** 2 * delta_t
        axes.plot(
            inverse, printed, ls="--", color=colour, lw=1.0, label=f"internal noise {noise:g}, SNR · NETD · k"
        )
        smallest = camera_acuity(sensor, settings).size_detectors
        place = (1.0 / smallest, ACUITY_DELTA_T_MK)
        axes.plot(
            *place, marker, color=colour, markerfacecolor="white", ms=8, label=f"acuity {smallest:.2f} detectors"
        )
        ends = [inverse[0], 1.0 / smallest], [delta_t[0], ACUITY_DELTA_T_MK]
        axes.plot(*ends, ":", color=colour, lw=1.0)
    logarithmic(axes, (0.125, 0.2, 0.25, 0.3, 0.4), (5, 10, 20, 50, 100, 200, 500, 1000))
    axes.set(xlabel="1 / size (detectors⁻¹)", ylabel="threshold ΔT (mK)", xlim=(0.115, 0.45), ylim=(5, 1500))
    netd, k = sensor.noise.netd_mk, k_factor(sensor.noise)
    axes.set_title(f"simulated staring camera, NETD {netd:g} mK, k = {k:.4f}")
    axes.legend(fontsize="x-small", loc="upper left")
    return figure


def figure_7_bars() -> Figure:
    """TOD and four bars of the same observer, with the frequency as it is and multiplied by 0.5."""
    sensor, settings = star_like(), with_noise(0.5)
    figure = Figure(figsize=(6.0, 4.6), layout="constrained")
    axes = figure.subplots()
    inverse = 1.0 / np.array(CAMERA_SIZES)
    snr = np.array([threshold_snr(sensor, settings, size).threshold for size in CAMERA_SIZES])
    axes.plot(inverse, delta_t_mk(snr, noise=sensor.noise), "^-", color="black", lw=2.0, label="TOD")
    for (name, (frequency, threshold)), colour in zip(of_bars(sensor, settings).items(), BAR_COLOURS, strict=True):
        axes.plot(frequency, threshold, "-", marker=".", color=colour, lw=1.2, label=f"bars, {name}")
        axes.plot(0.5 * frequency, threshold, ":", color=colour, lw=1.2, label=f"bars, {name}, frequency × 0.5")
    axes.axvline(1.0, color="grey", ls="--", lw=0.8)
    logarithmic(axes, (0.125, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4), (1, 2, 5, 10, 20, 50, 100))
    axes.set(xlabel="1 / size (detectors⁻¹), or frequency / Nyquist", ylabel="threshold ΔT (mK)", ylim=(1, 200))
    axes.set_title("simulated staring camera, internal noise 0.5")
    axes.legend(fontsize="x-small", loc="upper left", ncols=2)
    return figure


FIGURES = (figure_1, figure_2, figure_3, figure_4, figure_5, figure_6, figure_7, figure_7_bars)


def filled(text: str, values: Values) -> str:
    """The text with every marked place written anew; each name in it must be computed."""
    marked = re.compile(r"(<!-- =(\w+) -->).*?(<!-- / -->)", re.DOTALL)
    if unknown := {found[2] for found in marked.finditer(text)} - set(values):
        raise SystemExit(f"paper.md: marked names are not computed: {sorted(unknown)}")
    return marked.sub(lambda found: found[1] + values[found[2]] + found[3], text)


def main(folder: Path) -> None:
    """Make all pictures and numbers."""
    values: Values = {}
    for numbers in (
        stage_numbers,
        naked_eye_numbers,
        camera_numbers,
        weibull_numbers,
        noise_numbers,
        shift_numbers,
        sensitivity_numbers,
    ):
        values |= (new := numbers())
        for name, value in new.items():
            print(f"{name}: {value}", flush=True)
    (folder / "paper").mkdir(parents=True, exist_ok=True)
    for make in FIGURES:
        # No software version among the attributes: the same figure gives the same bytes.
        make().savefig(folder / "paper" / f"{make.__name__}.png", dpi=110, metadata={"Software": None})
    text = (HERE / "paper.md").read_text(encoding="utf-8")
    (folder / "paper.md").write_text(filled(text, values), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
