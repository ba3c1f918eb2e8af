"""Makes people.md, its pictures, and the settings `modelfest`: python docs/evidence/make_people.py [PART ...].

Parts are modelfest, edges, limit, blur, rings and readers; default: all. The first two need an environment with
the group `people`, whose package stimupy draws their stimuli. Pictures go to the folder people, the settings of
the pyramid that ModelFest gives to todframes/observers/settings. Seeds are fixed. What stands in people.md between
<!-- =NAME --> and <!-- / --> is written anew.
"""

from __future__ import annotations

import math
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import numpy as np
from matplotlib.figure import Figure
from people_tasks import (
    activity_of,
    detection_d_prime,
    gabor,
    identification_threshold,
    intrinsic_blur,
    landolt_ring,
    people_acuity,
    resolution_limit,
    triangle_acuity,
)

from todframes.base.reading import read_numbers, read_table, read_toml, toml_literal
from todframes.experiment.calibrate import model_difference
from todframes.experiment.calibration import MARGIN
from todframes.observers.csf import GAIN_PER_DEG, WIDE_GRATING_DEG, CsfObserver, contrast_sensitivity
from todframes.observers.interface import settings_file
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver

HERE = Path(__file__).parent
MRAD_PER_DEG = np.radians(1.0) * 1000.0
COLOURS = {
    "pyramid": "#444444",
    "pyramid, modelfest": "#009e73",
    "oriented": "#d55e00",
    "csf": "#0072b2",
    "csf, ideal": "#56b4e9",
}

D_PRIME_84, D_PRIME_75 = 1.4064, 0.9539
"""√2 Φ⁻¹ of 0.84 and 0.75."""

MODELFEST_PITCH_MRAD = MRAD_PER_DEG / 120.0
HIGHEST_FREQUENCY, NOT_A_MODEL_OF = 10, (35, 43)
"""Numbers of the stimulus of 30 cycles/degree, and of the noise and the scene."""

EDGE_PX_PER_DEG, EDGE_SIDE_PX, EDGE_CD_M2 = 44.0, 176, 100.0
NOISES = {
    "none": "none",
    "white": "white",
    "pink": "pink",
    "brown": "brown",
    "NB05": "0.5",
    "NB3": "3",
    "NB9": "9",
}
EDGES, EDGE_WIDTHS_DEG = ("9", "3", "05"), (0.048, 0.15, 0.95)
"""Names of the edges, and the width over which each falls to the background on both sides."""

PEOPLE_EDGES = {
    "none": (0.00206, 0.00152, 0.00286),
    "white": (0.00672, 0.00484, 0.00586),
    "pink": (0.00683, 0.00956, 0.01939),
    "brown": (0.00200, 0.00192, 0.00407),
    "NB05": (0.00167, 0.00129, 0.00310),
    "NB3": (0.00446, 0.00624, 0.01438),
    "NB9": (0.00715, 0.00318, 0.00329),
}
"""Root-mean-square contrast at 75 % correct for each edge, six people pooled (Schmittwilken et al. 2024)."""

DRAWS = 400
"""Draws of each noise: a standard error of 0.3 dB of the threshold."""

RING_CONTRASTS, RING_CD_M2, PX_PER_GAP = (1.0, 0.3, 0.1, 0.05, 0.03), 30.0, 8

LIMITS_OF_PEOPLE, READERS = HERE / "people" / "resolution_limit.csv", HERE / "people" / "readers.csv"
ENVELOPES_DEG, LIMIT_CD_M2, D_PRIME_78 = (0.33, 0.5, 1.0), (100.0, 30.0), 1.0920

BLURS_ARCMIN = np.array([0.0, 0.4, 0.8, 1.6, 3.2])
SLOPE_OF_PEOPLE = 1.47
"""Slope of log acuity on log intrinsic blur across 15 people (McAnany et al. 2011)."""


class NoiseKnown(CsfObserver):
    """The observer csf, whose ideal template knows a measured spectrum."""

    density: tuple[np.ndarray, np.ndarray]

    def external_noise_density(self, frequency_x: np.ndarray, frequency_y: np.ndarray) -> np.ndarray:
        """Interpolate the density by radial frequency; beyond the highest that was measured there is none."""
        return np.interp(np.hypot(frequency_x, frequency_y), *self.density, right=0.0)


def db(ratio: Any) -> Any:
    """Ratio of contrasts in dB."""
    return 20.0 * np.log10(ratio)


def rms(values: Any) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


class Detected(NamedTuple):
    """A stimulus of ModelFest with a largest contrast of 1, and people's sensitivity to it in dB."""

    number: int
    contrast: np.ndarray
    people_db: float


def modelfest_stimuli() -> list[Detected]:
    """Draw the 43 stimuli, in the order of their numbers."""
    from stimupy.papers import modelfest as papers

    found = []
    for name in dir(papers):
        if not (name[0].isupper() and name[-1].isdigit() and name != "PPD2"):
            continue
        number = int("".join(filter(str.isdigit, name)))
        drawn = getattr(papers, name)()
        # Thresholds are −log10 of the contrast at the peak; grey is the middle of 0 to 1.
        contrast = 2.0 * drawn["img"] - 1.0
        contrast /= np.abs(contrast).max()
        # From the table itself: in stimupy 1.2 the noise, number 35, comes with the thresholds of the scene.
        people = np.nanmean(papers.df.iloc[:, 4 * number - 3 : 4 * number + 1].to_numpy(float))
        found.append(Detected(number, contrast, 20.0 * float(people)))
    return sorted(found)


class BandNoise(NamedTuple):
    """Internal noise of each band, with its relative standard error, and the errors of the fit in dB."""

    values: tuple[float, ...]
    errors: tuple[float, ...]
    rms_db: float
    rms_left_out_db: float


def fit_band_noise(stimuli: Sequence[Detected]) -> BandNoise:
    """Fit the noise of each band of the pyramid with an eye to the sensitivity of people.

    The squared d′ of a stimulus is the sum over bands of its energy over the noise's variance. The last error is
    that of stimuli that were left out of the fit, one at a time.
    """
    from scipy.optimize import least_squares

    observer = PyramidObserver(eye_mtf="watson2013")
    energy = np.array(
        [
            [np.vdot(band, band) for band in activity_of(observer, one.contrast, MODELFEST_PITCH_MRAD)]
            for one in stimuli
        ]
    )
    people = np.array([one.people_db for one in stimuli])

    def left(ln_noise: np.ndarray, rows: Any = slice(None)) -> np.ndarray:
        variance = observer.settings.noise_sd**2 * np.exp(2.0 * ln_noise)
        return db(np.sqrt(energy[rows] @ (1.0 / variance)) / D_PRIME_84) - people[rows]

    start = np.zeros(energy.shape[1])
    found = least_squares(left, start)
    each = range(len(stimuli))
    left_out = [left(least_squares(left, start, args=(np.delete(each, n),)).x, [n])[0] for n in each]
    variance = 2.0 * found.cost / (len(stimuli) - len(start))
    errors = np.sqrt(variance * np.diagonal(np.linalg.inv(found.jac.T @ found.jac)))
    values = tuple(float(f"{one:.4g}") for one in np.exp(found.x))
    return BandNoise(values, tuple(errors.tolist()), rms(found.fun), rms(left_out))


def settings_text(noise: BandNoise) -> str:
    """Write the settings of the pyramid with an eye as TOML."""
    errors = ", ".join(f"{100.0 * one:.0f}" for one in noise.errors)
    return (
        "# The pyramid with the optics of an eye, and the internal noise of each band that the 43 stimuli of\n"
        "# ModelFest give: docs/evidence/make_people.py fits it to the sensitivity of 16 people at 30 cd/m².\n"
        f"# Errors of the fit: {noise.rms_db:.2f} dB (root mean square), and {noise.rms_left_out_db:.2f} dB for a "
        "stimulus that was left out.\n"
        f"# Standard errors of the noises, the finest band first: {errors} %.\n"
        'eye_mtf = "watson2013"\n'
        "# Over internal_noise = 0.5; the last is that of all coarser bands.\n"
        f"band_noise = {toml_literal(noise.values)}\n"
    )


def modelfest(stimuli: Sequence[Detected], with_eye: PyramidObserver) -> dict[str, dict[int, float]]:
    """Sensitivity of each observer less that of people, in dB, by stimulus."""
    observers = {
        "pyramid": PyramidObserver(),
        "pyramid, modelfest": with_eye,
        "oriented": OrientedObserver(),
        "csf": CsfObserver(),
    }
    found: dict[str, dict[int, float]] = {name: {} for name in observers}
    for one in stimuli:
        for who, observer in observers.items():
            d_prime = detection_d_prime(observer, activity_of(observer, one.contrast, MODELFEST_PITCH_MRAD))
            found[who][one.number] = float(db(d_prime / D_PRIME_84) - one.people_db)
    return found


def edges_in_noise(with_eye: PyramidObserver) -> dict[str, dict[tuple[str, str], float]]:
    """Threshold of each observer over that of people, in dB, by noise and edge."""
    import pandas as pd

    read = pd.read_csv
    pd.read_csv = lambda _: pd.DataFrame({"noise": [], "edge": []})  # the package lacks its data
    from stimupy.papers import schmittwilken2024 as papers

    pd.read_csv = read
    pitch, draws = MRAD_PER_DEG / EDGE_PX_PER_DEG, {}
    images = {}
    for edge, width in zip(EDGES, EDGE_WIDTHS_DEG, strict=True):
        # stimupy 1.2 draws the widest for all three.
        along = (np.arange(EDGE_SIDE_PX) - (EDGE_SIDE_PX - 1) / 2.0) / EDGE_PX_PER_DEG
        profile = np.sign(along) * np.maximum(1.0 - np.abs(along) / width, 0.0)
        images[edge] = np.tile(profile[:, None] / profile.std(), EDGE_SIDE_PX)
    for noise in NOISES:
        if noise != "none":
            draw, rng = getattr(papers, f"edge3_{noise}"), np.random.default_rng(1)
            with patch.object(np.random, "default_rng", lambda rng=rng: rng):  # stimupy makes one a draw, unseeded
                draws[noise] = [draw()["noise"] / 100.0 for _ in range(DRAWS)]
            draws[noise] = [one - one.mean() for one in draws[noise]]
    found: dict[str, dict[tuple[str, str], float]] = {}
    # `oriented` takes an hour for the draws; its neurons are about as sensitive as those of `pyramid`.
    of_csf = {"retina_pitch_mrad": 0.2, "luminance_cd_m2": EDGE_CD_M2}
    at_light = PyramidObserver(with_eye.settings, luminance_cd_m2=EDGE_CD_M2)
    plain = {"csf": CsfObserver(**of_csf), "pyramid": PyramidObserver(), "pyramid, modelfest": at_light}
    for who, observer in [*plain.items(), ("csf, ideal", None)]:
        found[who] = {}
        for noise in NOISES:
            seen_by = observer
            if seen_by is None:
                seen_by = NoiseKnown(template="ideal", **of_csf)
                seen_by.density = density(draws.get(noise, []))
            noises = [activity_of(seen_by, one, pitch) for one in draws.get(noise, [])]
            for edge, people in zip(EDGES, PEOPLE_EDGES[noise], strict=True):
                d_prime = detection_d_prime(seen_by, activity_of(seen_by, images[edge], pitch), noises)
                found[who][noise, edge] = float(db(D_PRIME_75 / d_prime / people))
    return found


def density(draws: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Radial mean of the spectral density of noise: frequencies in cycles/degree, and the density at each."""
    side = EDGE_SIDE_PX
    f = np.fft.fftfreq(side, 1.0 / EDGE_PX_PER_DEG)
    if not draws:
        return f[: side // 2], np.zeros(side // 2)
    power = np.mean([np.abs(np.fft.fft2(one)) ** 2 for one in draws], axis=0) / side**2 / EDGE_PX_PER_DEG**2
    ring = np.rint(np.hypot(f, f[:, None]) / f[1]).astype(int).ravel()
    mean = np.bincount(ring, power.ravel()) / np.maximum(np.bincount(ring), 1)
    mean[0] = mean[1]  # the mean was taken off
    return f[1] * np.arange(len(mean)), mean


def rings(with_eye: PyramidObserver) -> dict[str, list[float]]:
    """Threshold of each observer over the contrast at which people identify the same ring."""
    found = {}
    for who, observer in {
        "pyramid": PyramidObserver(),
        "pyramid, modelfest": with_eye,
        "oriented": OrientedObserver(),
        "csf": CsfObserver(),
    }.items():
        found[who] = []
        for contrast in RING_CONTRASTS:
            gap_mrad = MRAD_PER_DEG / 60.0 / people_acuity(contrast=contrast, luminance_cd_m2=RING_CD_M2)
            side = 7 * PX_PER_GAP
            drawn = [landolt_ring(side, gap_px=PX_PER_GAP, quarter_turns=k) for k in range(4)]
            seen = [activity_of(observer, one, gap_mrad / PX_PER_GAP) for one in drawn]
            found[who].append(identification_threshold(observer, seen) / contrast)
    return found


def limits() -> dict[str, list[float]]:
    """Finest grating in pixels a degree that `csf` sees, for each envelope, by light and criterion."""
    return {
        f"{luminance:g} cd/m², {share} % of two intervals": [
            2.0 * resolution_limit(CsfObserver(luminance_cd_m2=luminance), sd_deg=sd, d_prime=d_prime)
            for sd in ENVELOPES_DEG
        ]
        for luminance in LIMIT_CD_M2
        for share, d_prime in ((84, D_PRIME_84), (78, D_PRIME_78))
    }


def without(errors: Mapping[int, float]) -> list[float]:
    """Errors without the noise and the scene."""
    return [value for number, value in errors.items() if number not in NOT_A_MODEL_OF]


def table(header: list[str], rows: list[list[str]]) -> str:
    """Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def drawn(figure: Figure, *, zero: float | None, legend: str = "best") -> Figure:
    """Add the line of agreement and the legend."""
    axes = figure.axes[0]
    if zero is not None:
        axes.axhline(zero, color="#999999", lw=0.8)
    axes.legend(fontsize="small", loc=legend)
    return figure


def show_modelfest() -> tuple[str, Figure]:
    """Fit the noise of the bands, and show what each observer makes of the stimuli."""
    stimuli = modelfest_stimuli()
    noise = fit_band_noise(stimuli)
    settings_file("modelfest").write_text(settings_text(noise))
    detected = modelfest(stimuli, pyramid_with_eye())
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel="stimulus of ModelFest", ylabel="model over people: sensitivity, dB")
    for who, errors in detected.items():
        axes.plot(
            sorted(errors), [errors[n] for n in sorted(errors)], "o-", ms=3, lw=1, color=COLOURS[who], label=who
        )
    text = table(
        ["observer", "RMS of 43, dB", "RMS of 41, dB", "1.1 cycles/degree, dB", "30 cycles/degree, dB"],
        [
            [
                who,
                f"{rms(list(e.values())):.2f}",
                f"{rms(without(e)):.2f}",
                f"{e[1]:+.1f}",
                f"{e[HIGHEST_FREQUENCY]:+.1f}",
            ]
            for who, e in detected.items()
        ],
    )
    return text, drawn(figure, zero=0.0, legend="upper center")


def show_edges() -> tuple[str, Figure]:
    """Show the thresholds of edges in noise."""
    noisy = edges_in_noise(pyramid_with_eye())
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel="noise, and three edges in each", ylabel="model over people: threshold, dB")
    for who, errors in noisy.items():
        place = [4 * i + j for i in range(len(NOISES)) for j in range(3)]
        axes.plot(place, [errors[n, e] for n in NOISES for e in EDGES], "o", ms=4, color=COLOURS[who], label=who)
    axes.set_xticks([4 * i + 1 for i in range(len(NOISES))], list(NOISES.values()))
    text = table(
        ["observer", "mean of 21, dB", "SD of 21, dB", "mean of no, white, pink and 9 cycles/degree, dB"],
        [
            [
                who,
                f"{np.mean(list(e.values())):+.1f}",
                f"{np.std(list(e.values()), ddof=1):.1f}",
                ", ".join(
                    f"{np.mean([e[noise, edge] for edge in EDGES]):+.1f}"
                    for noise in ("none", "white", "pink", "NB9")
                ),
            ]
            for who, e in noisy.items()
        ],
    )
    return text, drawn(figure, zero=0.0)


def show_rings() -> tuple[str, Figure]:
    """Show the thresholds of Landolt rings."""
    ringed = rings(pyramid_with_eye())
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.add_subplot(
        xlabel="contrast of the ring", ylabel="model over people: threshold", xscale="log", yscale="log"
    )
    for who, ratios in ringed.items():
        axes.plot(RING_CONTRASTS, ratios, "o-", ms=4, color=COLOURS[who], label=who)
    text = table(
        ["observer", *(f"{100.0 * c:g} %" for c in RING_CONTRASTS), "SD, dB"],
        [
            [who, *(f"{one:.2f}" for one in ratios), f"{np.std(db(ratios), ddof=1):.2f}"]
            for who, ratios in ringed.items()
        ],
    )
    return text, drawn(figure, zero=1.0)


def show_limit() -> tuple[str, Figure]:
    """Show d′ of gratings up to the finest that people see, and their limits."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.add_subplot(
        xlabel="grating, pixels/degree (twice the cycles/degree)", ylabel="d′ of two intervals", yscale="log"
    )
    pixels = np.arange(70.0, 125.0, 6.0)
    observers = {
        "pyramid": PyramidObserver(),
        "pyramid, modelfest": PyramidObserver(pyramid_with_eye().settings, luminance_cd_m2=LIMIT_CD_M2[0]),
        "csf": CsfObserver(luminance_cd_m2=LIMIT_CD_M2[0]),
    }
    for who, observer in observers.items():
        d_prime = [detection_d_prime(observer, gabor(observer, n / 2.0, sd_deg=0.5)) for n in pixels]
        axes.plot(pixels, d_prime, "o-", ms=3, lw=1, color=COLOURS[who], label=who)
        at_limit = detection_d_prime(observer, gabor(observer, 47.0, sd_deg=0.5))
        print(f"{who}: d' {at_limit:.3g} at 47 cycles/degree")
    people = np.sort([limit for degrees, limit in read_limits() if degrees == 0.0])
    axes.plot(people, np.full(len(people), D_PRIME_84), "|", ms=12, color="#d55e00", label="18 people, at 84 %")
    text = table(
        ["csf", *(f"envelope {sd:g}°" for sd in ENVELOPES_DEG)],
        [[light, *(f"{one:.1f}" for one in found)] for light, found in limits().items()],
    )
    return text, drawn(figure, zero=None, legend="center right")


def groups_of_people() -> dict[str, list[Any]]:
    """Return observers that differ as people may: in noise, in light, in the optics or in the scale of the eye."""
    csf, noises = partial(CsfObserver, retina_pitch_mrad=0.2), (0.25, 0.5, 1.0, 2.0)
    with_eye = pyramid_with_eye().settings
    frequency = np.geomspace(0.1, 60.0, 60)
    sensitivity = GAIN_PER_DEG * WIDE_GRATING_DEG * contrast_sensitivity(frequency)
    finer = [tuple(zip(k * frequency, sensitivity, strict=True)) for k in (1.0 / 3.0, 0.5, 0.7, 1.0, 1.4)]
    return {
        "pyramid: noise": [PyramidObserver(internal_noise=noise) for noise in noises],
        "pyramid: scale of the retina": [PyramidObserver(retina_pitch_mrad=0.153 * k) for k in (1.0, 2.0, 4.0)],
        "pyramid, modelfest: noise": [PyramidObserver(with_eye, internal_noise=noise) for noise in noises],
        "pyramid, eye_mtf: pupil": [
            PyramidObserver(eye_mtf="watson2013", pupil_mm=pupil) for pupil in (2.0, 3.0, 4.0, 6.0)
        ],
        "csf: efficiency": [csf(efficiency=efficiency) for efficiency in (0.25, 1.0, 4.0, 16.0)],
        "csf: light": [csf(luminance_cd_m2=light) for light in (0.3, 3.0, 30.0, 300.0)],
        "csf: scale of the sensitivity": [csf(sensitivity=table) for table in finer],
    }


def show_blur() -> tuple[str, Figure]:
    """Show unblurred acuity for triangles against intrinsic blur, of observers that differ."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.add_subplot(
        xlabel="intrinsic blur, arcmin", ylabel="acuity without blur, mrad", xscale="log", yscale="log"
    )
    rows = []
    for number, (name, observers) in enumerate(groups_of_people().items()):
        fits = []
        for observer in observers:
            mrad = MRAD_PER_DEG / 60.0 * BLURS_ARCMIN
            acuities = np.array([triangle_acuity(observer, blur_mrad=blur) for blur in mrad])
            fits.append(intrinsic_blur(BLURS_ARCMIN, acuities))
        acuity, blur = np.transpose(fits)
        slope = np.polyfit(np.log(blur), np.log(acuity), 1)[0]
        marker, colour = "osD^vPX"[number], COLOURS[name.split(":")[0].replace("eye_mtf", "modelfest")]
        axes.plot(blur, acuity, f"{marker}-", ms=5, lw=1, color=colour, label=f"{name}, slope {slope:.2f}")
        ends = (f"{min(values):.2f} to {max(values):.2f}" for values in (acuity, blur))
        rows.append([name, *ends, f"{slope:.2f}"])
    line = np.array([0.4, 3.0])
    people = f"15 people, slope {SLOPE_OF_PEOPLE}; height not known"
    axes.plot(line, 0.75 * line**SLOPE_OF_PEOPLE, "--", color="#d55e00", label=people)
    for axis, ticks in ((axes.xaxis, (0.3, 0.5, 1.0, 2.0, 3.0)), (axes.yaxis, (0.2, 0.5, 1.0, 2.0, 3.0))):
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_ticks([], minor=True)
    header = ["observer: what differs", "acuity without blur, mrad", "intrinsic blur, arcmin", "slope"]
    return table(header, rows), drawn(figure, zero=None)


class Readers(NamedTuple):
    """A condition of DLMO: P(correct) of its network, and the answers of each of four readers, right or not."""

    name: str
    p_model: float
    answers: list[np.ndarray]

    def published(self) -> tuple[float, float]:
        """Difference of readers and network, and its reach, 2.5 standard errors: readers are drawn from many."""
        means = [one.mean() for one in self.answers]
        return float(np.mean(means)) - self.p_model, 2.5 * float(np.std(means, ddof=1)) / math.sqrt(len(means))

    def ours(self, answers: np.ndarray) -> tuple[float, tuple[float, float]]:
        """Difference and 90 % interval by the test of `calibrate`."""
        return model_difference(answers, np.full(len(answers), self.p_model), [np.arange(len(answers))])


def read_conditions() -> list[Readers]:
    """Read the four conditions of DLMO, demo6/pivotal_study."""
    found: dict[str, Readers] = {}
    for row in read_table(READERS)[1]:
        n, n_correct, p_model = row.numbers(["n_answers", "n_correct", "p_model"])
        name = f"{row.texts['reconstruction']}, {row.texts['acceleration']}×"
        one = found.setdefault(name, Readers(name, p_model, []))
        one.answers.append(np.arange(int(n)) < int(n_correct))
    return list(found.values())


def show_readers() -> tuple[str, Figure]:
    """Show the difference of readers and a network, by the published test and by that of `calibrate`."""
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.add_subplot(ylabel="readers − network, proportion correct")
    rows, conditions = [], read_conditions()
    for number, condition in enumerate(conditions):
        difference, reach = condition.published()
        pooled = condition.ours(np.concatenate(condition.answers))
        each = [condition.ours(one) for one in condition.answers]
        drawn_at = [
            (-0.3, (difference, (difference - reach, difference + reach)), "#d55e00", "published, all four"),
            (-0.15, pooled, "#444444", "calibrate's, all four"),
            *((0.1 * k, one, "#0072b2", "_" * k + "calibrate's, each reader") for k, one in enumerate(each)),
        ]
        for place, (middle, ends), colour, label in drawn_at:
            axes.plot([number + place] * 2, ends, color=colour, label="_" * number + label)
            axes.plot(number + place, middle, "o", ms=4, color=colour)
        is_equal = [low > -MARGIN and high < MARGIN for _, (low, high) in (pooled, *each)]
        rows.append(
            [
                condition.name,
                f"{difference + condition.p_model:.3f}",
                f"{condition.p_model:.3f}",
                f"{difference - reach:+.3f} to {difference + reach:+.3f}: similar",
                f"{pooled[1][0]:+.3f} to {pooled[1][1]:+.3f}: {'equal' if is_equal[0] else 'not shown'}",
                f"{sum(is_equal[1:])} of {len(each)}",
            ]
        )
    for end in (-MARGIN, MARGIN):
        axes.axhline(end, color="#999999", lw=0.8, ls="--")
    axes.set_xticks(range(len(conditions)), [condition.name for condition in conditions])
    header = ["images", "four readers", "network", "published test", "ours, all four", "ours, readers shown equal"]
    return table(header, rows), drawn(figure, zero=0.0)


def read_limits() -> list[list[float]]:
    """Return eccentricity in degrees and limit in pixels a degree of each person."""
    return read_numbers(LIMITS_OF_PEOPLE, ["eccentricity_deg", "pixels_per_deg"])


def pyramid_with_eye() -> PyramidObserver:
    """Return the pyramid with the settings that ModelFest gives."""
    settings = read_toml(settings_file("modelfest"))
    return PyramidObserver(eye_mtf=settings["eye_mtf"], band_noise=tuple(settings["band_noise"]))


PARTS = {
    "modelfest": show_modelfest,
    "edges": show_edges,
    "limit": show_limit,
    "blur": show_blur,
    "rings": show_rings,
    "readers": show_readers,
}


def main(parts: Sequence[str]) -> None:
    """Compute parts of the page and write them."""
    warnings.simplefilter("ignore")
    page = HERE / "people.md"
    for name in parts or PARTS:
        value, figure = PARTS[name]()
        print(f"{name}\n{value}\n")
        figure.savefig(HERE / "people" / f"{name}.png", dpi=110, metadata={"Software": None})
        text, count = re.subn(
            rf"(<!-- ={name} -->\n).*?(<!-- / -->)",
            lambda place, v=value: f"{place[1]}{v}\n{place[2]}",
            page.read_text(encoding="utf-8"),
            flags=re.DOTALL,
        )
        if count != 1:
            raise SystemExit(f"people.md: found <!-- ={name} --> {count} times, expected once")
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
