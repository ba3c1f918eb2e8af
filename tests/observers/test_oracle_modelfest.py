"""ModelFest, 43 stimuli seen by 16 people: drawn by the package stimupy, which also holds their thresholds."""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np
import pytest
from people_tasks import activity_of, detection_d_prime

from todframes.base.reading import read_toml
from todframes.observers.csf import contrast_sensitivity, oblique_effect
from todframes.observers.interface import settings_file
from todframes.observers.pyramid import PyramidObserver

pytestmark = pytest.mark.oracle

PX_PER_DEG = 120.0
NOISE_AND_SCENE = (35, 43)


class Seen(NamedTuple):
    number: int
    contrast: np.ndarray
    sensitivity_db: float
    against_border: np.ndarray


@pytest.fixture(scope="module")
def stimuli() -> list[Seen]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        modelfest = pytest.importorskip("stimupy.papers.modelfest", reason="stimupy is in the group people")

        found = []
        for name in dir(modelfest):
            if name[0].isupper() and name[-1].isdigit() and name != "PPD2":
                drawn = getattr(modelfest, name)()
                # Thresholds are −log10 of the contrast at the peak; grey is the middle of 0 to 1.
                contrast = 2.0 * drawn["img"] - 1.0
                number = int("".join(filter(str.isdigit, name)))
                # From the table itself: in stimupy 1.2 the noise, number 35, comes with those of the scene.
                runs = modelfest.df.iloc[:, 4 * number - 3 : 4 * number + 1].to_numpy(float)
                people = 20.0 * float(np.nanmean(runs))
                img = drawn["img"]
                border = img / np.median(np.concatenate([img[0], img[-1], img[:, 0], img[:, -1]])) - 1.0
                seen = (one / np.abs(one).max() for one in (contrast, border))
                found.append(Seen(number, next(seen), people, next(seen)))
    assert sorted(one.number for one in found) == list(range(1, 44))
    return found


def errors_db(stimuli: list[Seen], *, gain: float, aperture_sd_deg: float, exponent: float) -> dict[int, float]:
    """Sensitivity of the model less that of people, by stimulus."""
    side = 2 * stimuli[0].contrast.shape[0]
    f = np.fft.fftfreq(side, 1.0 / PX_PER_DEG)
    transfer = contrast_sensitivity(np.hypot(f, f[:, None])) * oblique_effect(f, f[:, None])
    place = (np.arange(side // 2) - (side // 2 - 1) / 2.0) / PX_PER_DEG
    aperture = np.exp(-np.add.outer(place**2, place**2) / (2.0 * aperture_sd_deg**2))
    found = {}
    for one in stimuli:
        spectrum = np.fft.fft2(one.contrast, (side, side))
        seen = np.abs(aperture * np.fft.ifft2(spectrum * transfer).real[: side // 2, : side // 2])
        pooled = ((seen**exponent).sum() / PX_PER_DEG**2) ** (1.0 / exponent)
        found[one.number] = 20.0 * math.log10(gain * pooled) - one.sensitivity_db
    return found


def rms(values: dict[int, float], *, without: tuple[int, ...] = ()) -> float:
    return float(np.sqrt(np.mean([value**2 for number, value in values.items() if number not in without])))


def test_the_published_model_describes_people(stimuli: list[Seen]) -> None:
    """Watson & Ahumada 2005, pooling exponent 2.4081: they report 0.67 dB without the noise and the scene.

    The mean of the 43 thresholds of people has a standard error of 0.87 dB / √43 = 0.13 dB.
    """
    found = errors_db(stimuli, gain=373.08, aperture_sd_deg=0.6273, exponent=2.4081)
    assert abs(np.mean(list(found.values()))) < 0.13
    assert rms(found, without=NOISE_AND_SCENE) == pytest.approx(0.67, abs=0.03)
    assert rms(found) == pytest.approx(1.03, abs=0.01)


def test_grey_of_the_border_gives_the_figures_of_another_program(stimuli: list[Seen]) -> None:
    """Another program found a mean of 0.013 dB and RMS of 1.03 and 0.668 dB (43 and 41 stimuli) for the published
    model, and 1.13 and 0.90 dB for the linear one; all are rounded.

    That follows if the grey that contrasts refer to is that of the pictures' borders, which broad stimuli reach;
    people saw them on grey, so the figures here are 0.69 and 0.91 dB over the 41.
    """
    of_border = [one._replace(contrast=one.against_border) for one in stimuli]
    published = errors_db(of_border, gain=373.08, aperture_sd_deg=0.6273, exponent=2.4081)
    linear = errors_db(of_border, gain=509.37, aperture_sd_deg=0.35, exponent=2.0)
    assert rms(published) == pytest.approx(1.03, abs=0.005)
    assert rms(published, without=NOISE_AND_SCENE) == pytest.approx(0.668, abs=0.002)
    assert rms(linear) == pytest.approx(1.13, abs=0.01)
    assert rms(linear, without=NOISE_AND_SCENE) == pytest.approx(0.90, abs=0.005)
    # A hundredth of a decibel: the scene has no border of one grey.
    assert np.mean(list(published.values())) == pytest.approx(0.013, abs=0.015)


def test_the_settings_modelfest_describe_people(stimuli: list[Seen]) -> None:
    """The pyramid with an eye: the settings file says 2.01 dB, rounded. Another program found 1.9 dB, with a blur
    that was fitted too."""
    settings = read_toml(settings_file("modelfest"))
    observer = PyramidObserver(**settings | {"band_noise": tuple(settings["band_noise"])})
    found = {}
    for one in stimuli:
        seen = activity_of(observer, one.contrast, 1000.0 * math.radians(1.0) / PX_PER_DEG)
        found[one.number] = 20.0 * math.log10(detection_d_prime(observer, seen) / 1.4064) - one.sensitivity_db
    assert rms(found) < 2.015
    assert abs(np.mean(list(found.values()))) < 0.13


def test_the_linear_model_describes_people(stimuli: list[Seen]) -> None:
    """Nothing is fitted here; 1.2 and 0.95 dB are what its use asks for."""
    found = errors_db(stimuli, gain=509.37, aperture_sd_deg=0.35, exponent=2.0)
    assert rms(found) < 1.2
    assert rms(found, without=NOISE_AND_SCENE) < 0.95
