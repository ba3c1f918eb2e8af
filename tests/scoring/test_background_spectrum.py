"""Observers in clutter: the spectrum behind triangles, and thresholds in 1/f fields against brute force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import DatasetMaker

import todframes as tod
from todframes.base.errors import DataError, SettingsError
from todframes.diagnosis.locate import locate_triangles
from todframes.frames.dataset import load_dataset
from todframes.frames.files import write_frame
from todframes.frames.memory import memory_dataset
from todframes.observers.csf import CsfObserver
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.scoring.opening import background_spectrum
from todframes.stimulus import ORIENTATIONS, coverage

PITCH_MRAD, SIZE_MRAD = 0.3, 3.0
PITCH_DEG = PITCH_MRAD / 17.453293
DENSITY = (2.0 * PITCH_DEG) ** 2
"""Spectral density of the fields at 1 cycle/degree; it falls as 1/f²."""

QUICK = FitSettings(resamples=0)


def one_over_f(rng: np.random.Generator, side: int) -> np.ndarray:
    """A quarter of a periodic field of this density: (side, side)."""
    x = np.fft.fftfreq(2 * side, PITCH_DEG)
    f = np.hypot(x, x[:, None])
    f[0, 0] = np.inf
    white = rng.normal(size=(2 * side, 2 * side)) / PITCH_DEG
    return np.fft.ifft2(np.fft.fft2(white) * np.sqrt(DENSITY) / f).real[:side, :side]


@pytest.fixture(scope="module")
def clutter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cluttered(tmp_path_factory.mktemp("clutter"), n=10, side=73)


def cluttered(path: Path, *, n: int, side: int) -> Path:
    """A dataset with a triangle in front of each of n fields at each of five levels."""
    rng, rows = np.random.default_rng(4), []
    fields, middle = [one_over_f(rng, side) for _ in range(n)], side // 2
    for number in range(5 * n):
        level, scene = divmod(number, n)
        contrast, apex = (0.05, 0.1, 0.2, 0.4, 0.8)[level], ORIENTATIONS[(level + scene) % 4]
        size_px = SIZE_MRAD / PITCH_MRAD
        triangle = coverage((side, side), size_px=size_px, x_px=middle, y_px=middle, orientation=apex)
        write_frame(path / f"{number}.exr", 50.0 * (1.0 + fields[scene] + contrast * triangle), pixel_type="float")
        rows.append(f"{number}.exr,{apex.value},{SIZE_MRAD},{contrast},scene {scene}")
    (path / "manifest.csv").write_text("\n".join(["frame,orientation,size_mrad,contrast,scene", *rows]))
    (path / "dataset.toml").write_text(
        "schema = 1\n"
        '[display]\neotf = "linear"\nwhite_luminance_cd_m2 = 1.0\n'
        f"pixel_pitch_mrad = {PITCH_MRAD}\nbackground_luminance_cd_m2 = 50.0\n"
        '[experiment]\nlevel = "contrast"\ngroup_by = ["size_mrad"]\n'
    )
    return path


def brute_force(dataset: Path, *, ideal: bool) -> float:
    """The threshold by code that shares nothing with the observer: fine samples, drawn noise.

    Each pixel is held over 3 × 3 samples. The ideal template solves (σ² + A F N F A) w = A F s by steepest descent
    with conjugate directions, N being the density by which the fields were made, as held pixels display it.
    """
    data, fine = load_dataset(dataset), 3
    side = 73 * fine
    step = PITCH_DEG / fine
    place = (np.arange(side) - side // 2) * step
    aperture = np.exp(-np.add.outer(place**2, place**2) / (2.0 * 0.35**2))
    period = 2 * side
    x = np.fft.fftfreq(period, step)
    f, angle = np.hypot(x, x[:, None]), np.arctan2(x[:, None], x)
    with np.errstate(over="ignore"):
        seen = 1.0 / np.cosh((f / 4.1726) ** 0.7786) - 0.8493 / np.cosh(f / 1.3625)
    seen *= np.where(f > 3.48, 1.0 - (1.0 - np.exp(-(f - 3.48) / 13.57)) * np.sin(2.0 * angle) ** 2, 1.0)

    def through(image: np.ndarray, transfer: np.ndarray) -> np.ndarray:
        return np.fft.ifft2(np.fft.fft2(image, (period, period)) * transfer).real[:side, :side]

    size = SIZE_MRAD / 17.453293
    height = 1.3160740 * size
    points = (place[:, None] + (np.arange(8) - 3.5) / 8.0 * step).ravel()
    down, across = points[:, None] + 2.0 / 3.0 * height, np.abs(points)
    inside = (down > 0.0) & (down < height) & (across < down / np.sqrt(3.0))
    sharp = inside.reshape(side, 8, side, 8).mean(axis=(1, 3))
    noise_deg = 1.0 / (1.406 * 509.37)
    density = DENSITY / np.maximum(f, x[1]) ** 2 * (np.sinc(x * PITCH_DEG) * np.sinc(x[:, None] * PITCH_DEG)) ** 2

    def covariance(image: np.ndarray) -> np.ndarray:
        return image + aperture * through(aperture * image, density * seen**2) / noise_deg**2

    def solved(right: np.ndarray) -> np.ndarray:
        found, rest = np.zeros_like(right), right.copy()
        along, now = rest.copy(), float(np.vdot(rest, rest))
        first = now
        while now > 1e-12 * first:
            image = covariance(along)
            length = now / float(np.vdot(along, image))
            found += length * along
            rest -= length * image
            before, now = now, float(np.vdot(rest, rest))
            along = rest + now / before * along
        return found

    deviation = sharp - sum(np.rot90(sharp, k) for k in range(4)) / 4.0
    template = aperture * through(deviation, seen)
    template = solved(template) if ideal else template
    templates = np.array([np.rot90(template, -k) for k in range(4)]).reshape(4, -1)
    values, vectors = np.linalg.eigh(templates @ templates.T)
    noise = np.random.default_rng(2).normal(size=(50_000, 4)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    noise *= noise_deg / step  # white noise on a sample has the density over its area as variance
    levels, right = [], []
    for trial in data.trials:
        with data.open(trial.frames[0]) as file:
            pixels = np.concatenate([band.values[..., 0] for band in file.bands()]).astype(np.float64)
        contrast = np.kron(pixels / 50.0 - 1.0, np.ones((fine, fine)))
        scores = templates @ (aperture * through(contrast, seen)).ravel()
        drawn = np.concatenate([scores + noise, scores - noise]).argmax(axis=1)
        levels.append(trial.level)
        right.append((drawn == trial.orientation.quarter_turns).mean())
    rng = np.random.default_rng(0)
    return fit_trials(np.array(levels), np.array(right), curve="observer", settings=QUICK, rng=rng).threshold


@pytest.mark.parametrize(
    ("ideal", "tolerance"), [pytest.param(False, 0.01), pytest.param(True, 0.02, marks=pytest.mark.weekly)]
)
@pytest.mark.slow
def test_thresholds_in_clutter_are_those_of_brute_force(clutter: Path, ideal: bool, tolerance: float) -> None:
    """With the plain template, and with the one for the spectrum that is measured in the frames."""
    changes = {"template": "ideal", "external_noise_spectrum": "frames"} if ideal else {}
    found = tod.score(clutter, observer=CsfObserver(**changes), fit=QUICK, plan="full", examples=False)
    brute = brute_force(clutter, ideal=ideal)
    assert found.thresholds[0].threshold == pytest.approx(brute, rel=tolerance)


def test_the_spectrum_is_that_of_the_fields(clutter: Path) -> None:
    """A band of n resolved frequencies of 10 fields has a standard error of 1/√(10 n): 7 % with 20."""
    data = load_dataset(clutter)
    frequency, density = np.array(background_spectrum(data, data.trials, "centroid")).T
    held = np.sinc(frequency * PITCH_DEG) ** 2  # along an axis: 8 % less than along a diagonal at the end
    ratio = density / (DENSITY / frequency**2 * held)
    assert (np.diff(frequency) > 0.0).all()
    assert ratio[frequency > 5.0] == pytest.approx(np.ones((frequency > 5.0).sum()), abs=0.2)
    # The slope of 1/f² within the window's own width adds some per cent to the lowest.
    assert ratio[frequency <= 5.0] == pytest.approx(np.ones((frequency <= 5.0).sum()), abs=0.5)


def test_a_turned_set_has_the_same_spectrum_and_turned_positions() -> None:
    """Noise of rows, and the same frames transposed: triangles up are left, x is y. Sums differ by roundings."""
    rng, side = np.random.default_rng(3), 64
    apex = [ORIENTATIONS[k % 4] for k in range(24)]
    level = np.repeat([0.3, 1.0], 12)
    frames = [
        50.0 * (1.0 + contrast * coverage((side, side), size_px=8.0, x_px=31.5, y_px=31.5, orientation=one))
        + 50.0 * (0.1 * rng.normal(size=(side, side)) + 0.3 * rng.normal(size=(side, 1)))
        for contrast, one in zip(level, apex, strict=True)
    ]
    display = tod.Display(eotf="linear", background_luminance_cd_m2=50.0, pixel_pitch_mrad=0.25)
    turned = dict(zip(ORIENTATIONS, reversed(ORIENTATIONS), strict=True))  # up is left, right is down
    rows, columns = (
        memory_dataset(shown, orientation=stated, level=level, size_mrad=2.0, display=display)
        for shown, stated in ((frames, apex), ([one.T for one in frames], [turned[one] for one in apex]))
    )
    spectra = [np.array(background_spectrum(one, one.trials, "centroid")) for one in (rows, columns)]
    assert spectra[1] == pytest.approx(spectra[0], rel=1e-9)
    found = [locate_triangles(one, locate="each")[0].trials.positions_px for one in (rows, columns)]
    assert found[1][:, ::-1] == pytest.approx(found[0], abs=1e-9)


def test_white_noise_about_a_triangle_off_the_middle_of_a_large_frame() -> None:
    """σ²/2 times the area of a pixel, held over the pixel: bands of 100 waves or more of 3 trials, 6 % each."""
    rng = np.random.default_rng(3)
    triangle = coverage((300, 560), size_px=12.0, x_px=400.0, y_px=215.0, orientation=ORIENTATIONS[0])
    frames = [50.0 * (1.0 + 2.0 * triangle + 0.1 * rng.normal(size=triangle.shape)) for _ in range(6)]
    display = tod.Display(eotf="linear", background_luminance_cd_m2=50.0, pixel_pitch_mrad=0.25)
    stated = {"orientation": "up", "level": 2.0, "size_mrad": 3.0, "position": [(400.0, 215.0)] * 6}
    noisy = memory_dataset(frames, display=display, trial=[1, 1, 2, 2, 3, 3], **stated)
    frequency, density = np.array(background_spectrum(noisy, noisy.trials, "centroid")).T
    pitch_deg = 0.25 / 17.453293
    held = np.sinc(frequency * pitch_deg) ** 2  # along an axis: 8 % less than along a diagonal at the end
    assert density[-9:] == pytest.approx(0.01 / 2.0 * pitch_deg**2 * held[-9:], rel=0.2)


@pytest.mark.parametrize("spectrum", ["frame", ((1.0, 1.0), (0.5, 1.0)), ((1.0, 0.0),), ((1.0, 1.0, 1.0),), 3.0])
def test_bad_spectra(spectrum: object) -> None:
    with pytest.raises(SettingsError, match=r"^external_noise_spectrum"):
        CsfObserver(external_noise_spectrum=spectrum)


def test_frames_that_show_no_background(make_dataset: DatasetMaker) -> None:
    """Frames of 12 mrad have nothing 1.3 sizes beside a triangle of 4 mrad."""
    made = load_dataset(make_dataset(sizes_mrad=(4.0,), contrasts=(0.1, 0.2)).path)
    best = CsfObserver(template="ideal", external_noise_spectrum="frames")
    with pytest.raises(DataError, match="leaves no background to measure; expected 80 or more along each side"):
        tod.score(made, observer=best)
    with pytest.raises(SettingsError, match="found frames where there are no frames"):
        tod.naked_eye(size_mrad=3.0, observer=best)
