"""Live curves: as good as `curve` says, whatever came before, and nothing left behind."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from test_predict import UNDER_SAMPLED

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import delta_t_mk
from sensor_sim.chain.sensor import Detector, Noise, Optics, PhotonNoise, Scene, Sensor
from sensor_sim.explorer.live import CurvePoint, LiveCurve, LiveCurves, Request, ThresholdEngine
from sensor_sim.thresholds.curve_plan import PARTS, Level, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, SensorTrials, predict_threshold
from sensor_sim.thresholds.threshold import Shares, decision_shares, shares_at
from todframes.base.errors import SettingsError, TodframesError
from todframes.observers.hotelling import HotellingObserver
from todframes.observers.interface import Observer, non_gaussian_bound
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.stimulus import ORIENTATIONS

SENSOR = replace(UNDER_SAMPLED, noise=Noise(netd_mk=30.0))
PHOTON = replace(
    SENSOR,
    optics=Optics(aperture_mm=10.0, wavelength_um=0.55, focal_length_mm=30.0),
    detector=Detector(pitch_um=6.0),
    noise=Noise(),
    photons=PhotonNoise(
        quantum_efficiency=0.5,
        dark_noise_electrons=8.0,
        exposure_ms=10.0,
        prnu_percent=1.0,
        row_noise_electrons=2.0,
        full_well_electrons=20_000.0,
    ),
    scene=Scene(luminance_cd_m2=1.0),
)
OBSERVER = PyramidObserver()
TOLERANCES = (0.03, 0.02)


def request(
    sensor: Sensor = SENSOR,
    observer: Observer = OBSERVER,
    sizes: tuple[float, ...] = (4.0,),
    tolerances: tuple[float, float] = TOLERANCES,
    level: Level = "snr",
) -> Request:
    return Request(1, resolve(sensor), pickle.dumps(observer), tuple(enumerate(sizes)), 0.75, tolerances, level)


def computed(engine: ThresholdEngine, *arguments, **more) -> list[PredictedThreshold]:
    """Estimates and refined thresholds of one size in turn."""
    return [answer.threshold for answer in engine.answers(request(*arguments, **more))]


def engine() -> ThresholdEngine:
    return ThresholdEngine()


def changed(**parts) -> Sensor:
    """Return the sensor with some values of its tables changed: optics={"aperture_mm": 90.0}."""
    return replace(SENSOR, **{name: replace(getattr(SENSOR, name), **values) for name, values in parts.items()})


MOVES = [
    changed(optics={"aperture_mm": 92.0}),
    changed(display={"blur_sigma_px": 1.3}),
    changed(display={"gain": 1.4}),
    changed(display={"viewing_distance_mm": 1600.0}),
    changed(detector={"width_mrad": 0.18}),
]


@pytest.mark.parametrize(
    ("sensor", "observer"),
    [
        (SENSOR, OBSERVER),
        (MOVES[1], OBSERVER),
        pytest.param(SENSOR, OrientedObserver(), marks=pytest.mark.slow),
        pytest.param(SENSOR, HotellingObserver(), marks=pytest.mark.slow),
    ],
)
def test_refined_is_the_curve_and_the_estimate_holds(sensor, observer):
    tolerance = 0.004 if observer is OBSERVER else 0.02
    estimated, refined = computed(engine(), sensor, observer, tolerances=(0.03, tolerance))
    plan = plan_curve(resolve(sensor), observer, 4.0, tolerance=tolerance)
    expected = predict_threshold(FoldedChain(resolve(sensor), observer, 4.0, plan), tolerance=tolerance)
    assert (refined.threshold, refined.numerical_error) == (expected.threshold, expected.numerical_error)
    assert refined.numerical_error <= tolerance * refined.threshold
    assert estimated.numerical_error <= 0.03 * estimated.threshold
    assert abs(estimated.threshold - refined.threshold) <= estimated.numerical_error


def test_contrast_is_the_snr_without_noise_that_gives_the_share():
    """At this contrast and without detector noise, the chain of `curve` gives the share of correct answers."""
    one = engine()
    _, refined = computed(one, SENSOR, tolerances=(0.03, 0.004), level="contrast")
    # More gain makes more contrast on the display, and leaves the contrast that the eye needs.
    assert computed(one, MOVES[2], tolerances=(0.03, 0.004), level="contrast") == [refined]
    chain = FoldedChain(resolve(SENSOR), OBSERVER, 4.0)
    phases = chain.phases(17, np.random.default_rng(1))
    low, high = (
        chain.proportion_correct(phases, factor * refined.threshold, level="contrast") for factor in (0.99, 1.01)
    )
    # The stated error and that of the lattice of 17² places are below half a per cent each.
    assert low < 0.75 < high
    assert shares_at(chain, "contrast", 0.5).internal > shares_at(chain, "contrast", 1.0).internal > 0.0


def test_the_bound_of_photons_is_that_of_the_cumulants_of_their_counts():
    """A Poisson number has its mean as every cumulant; n frames of E electrons are one frame of n E."""
    bounds = []
    for frames, exposure_ms in ((1, 40.0), (8, 5.0)):
        light = {"quantum_efficiency": 0.5, "exposure_ms": exposure_ms, "frames_integrated": frames}
        sensor = replace(PHOTON, photons=PhotonNoise(dark_noise_electrons=0.0, **light))
        chain, here = FoldedChain(resolve(sensor), OBSERVER, 4.0), np.zeros(1)
        bounds.append(chain.non_gaussian_bound(0.7))
    weights = chain.plan.all_four(chain.folding.weights(here, here))[0] * sensor.display.gain
    electrons = 8.0 * resolve(sensor).background_electrons
    seen = electrons * (1.0 + 0.7 * chain.plan.samples(here, here, ORIENTATIONS[0]).ravel())
    second, third, fourth = (((weights[0] - weights[1:]) / electrons) ** n @ seen for n in (2, 3, 4))
    covariance = chain.noise_covariance
    second += covariance[0, 0] + np.diag(covariance)[1:] - 2.0 * covariance[0, 1:]
    skewness = np.abs(third) / second**1.5
    expected = np.sum(0.3990 / 6.0 * skewness + 2.308 / 72.0 * skewness**2)
    expected += non_gaussian_bound(float((fourth / second**2).max()))
    assert expected > chain.readout.non_gaussian_bound
    assert bounds == [pytest.approx(expected, rel=1e-6)] * 2


def test_a_camera_that_counts_photons_has_the_thresholds_of_the_curve():
    """Also after its light has moved: the trials do not depend on it."""
    one = engine()
    for sensor in (PHOTON, replace(PHOTON, scene=Scene(luminance_cd_m2=0.3))):
        estimated, refined = computed(one, sensor)
        chain = FoldedChain(
            resolve(sensor), OBSERVER, 4.0, plan_curve(resolve(sensor), OBSERVER, 4.0, tolerance=0.02)
        )
        expected = predict_threshold(chain, tolerance=0.02)
        assert abs(refined.threshold - expected.threshold) <= 1e-4 * expected.threshold  # the same places
        assert abs(estimated.threshold - refined.threshold) <= estimated.numerical_error + refined.numerical_error


def test_what_the_threshold_does_not_depend_on_is_not_computed_again():
    one = engine()
    _, refined = computed(one)
    other = changed(noise={"netd_mk": 60.0, "frames_integrated": 9}, display={"background_luminance_cd_m2": 9.0})
    answers = list(one.answers(request(other)))
    assert [answer.is_refined for answer in answers] == [True]
    assert answers[0].threshold == refined
    assert delta_t_mk(1.0, noise=other.noise) != delta_t_mk(1.0, noise=SENSOR.noise)


def test_threshold_that_is_never_reached():
    answers = list(engine().answers(request(sizes=(1.0,))))
    assert [answer.threshold.status for answer in answers] == ["never_reached"] * 2
    assert answers[0].threshold.threshold is None
    assert answers[0].shares.detector == 0.0


class StoppedError(Exception):
    """The computation is no longer wanted."""


def test_cancelled_computations_leave_what_is_kept_right(monkeypatch):
    fresh = [computed(engine(), sensor)[-1].threshold for sensor in MOVES[:2]]
    checks_left, n_stopped = 0, 0

    def check() -> None:
        nonlocal checks_left, n_stopped
        checks_left -= 1
        if checks_left == 0:
            n_stopped += 1
            raise StoppedError

    PARTS._values.clear()
    PARTS._bytes = 0
    monkeypatch.setattr(PARTS, "check", check)
    interrupted = engine()
    for number in range(20):
        checks_left = 7 + 6 * number
        with suppress(StoppedError):
            computed(interrupted, MOVES[number % 2])
    assert n_stopped > 5
    found = [computed(interrupted, sensor)[-1].threshold for sensor in MOVES[:2]]
    assert found == pytest.approx(fresh, rel=1e-4)


def test_shares_are_those_of_drawn_decisions():
    """Against the variance of score differences of trials with their noise drawn."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4))
    internal, snr, places = root @ root.T, 1.7, 30
    signal = rng.normal([3.0, 0.0, 0.0, 0.0], size=(places, 2, 4))
    factor = rng.normal(size=(places, 4, 3))
    phases = SensorTrials(signal, factor @ factor.swapaxes(1, 2), 0)
    shares = decision_shares([phases], internal, [phases.noise.mean(axis=0) / snr**2])
    assert sum(shares) == pytest.approx(1.0, rel=1e-12)

    n = 4000
    own = rng.normal(size=(n, places, 2, 4)) @ root.T
    detectors = np.einsum("pij,npkj->npki", factor, rng.normal(size=(n, places, 2, 3))) / snr
    parts = [own, detectors, np.broadcast_to(signal, own.shape)]
    differences = [(part[..., :1] - part[..., 1:]).reshape(-1, 3) for part in parts]
    variances = np.array([difference.var(axis=0) for difference in differences])
    drawn = (variances / sum(differences).var(axis=0)).mean(axis=1)
    # 240,000 draws: a variance is known to 0.3 %, a share of about a third to 0.1 %; four of these.
    np.testing.assert_allclose(shares, drawn, atol=0.006)


def limits_of(*points: tuple[float, float | None, tuple[float, float, float]]) -> tuple[Shares, str]:
    """What limits a curve with these sizes, thresholds and shares."""
    curve = []
    for size, threshold, shares in points:
        found = PredictedThreshold("ok" if threshold else "never_reached", threshold, size_detectors=size)
        curve.append(CurvePoint(len(curve), found, Shares(*shares), True))
    return LiveCurve(tuple(curve), 0.02, 0.0, True).limits


def test_sentence_says_what_limits_and_where_nothing_is_seen():
    unseen = (2.0, None, (0.9, 0.0, 0.1))
    mean, sentence = limits_of(unseen, (4.0, 1.0, (0.25, 0.7, 0.05)), (8.0, 1.0, (0.15, 0.8, 0.05)))
    assert mean.detector == pytest.approx(0.75)
    assert sentence == (
        "Detector noise limits: 75 % of what makes answers vary at threshold (the observer's internal noise 20 %, "
        "sampling 5 %); no threshold at 2 detectors, even without detector noise."
    )
    assert limits_of(unseen)[1] == "No threshold at 2 detectors, even without detector noise."
    balanced = limits_of((2.0, 1.0, (0.4, 0.35, 0.25)))
    assert balanced[1].startswith("The observer's internal noise weighs most: 40 %")


@pytest.fixture(scope="module")
def live() -> Iterator[LiveCurves]:
    curves = LiveCurves()
    yield curves
    before = len(multiprocessing.active_children())
    curves.close()
    assert len(multiprocessing.active_children()) == before - 2


def wanted() -> bool:
    return True


@pytest.mark.slow
def test_curves_come_in_order_and_are_those_of_one_process(live):
    sizes = (2.0, 6.0, 3.0, 4.0)
    first, *between, last = live.curves(SENSOR, OBSERVER, sizes, tolerances=TOLERANCES, is_wanted=wanted)
    assert [one.is_last for one in (first, *between, last)] == [False] * (1 + len(between)) + [True]
    assert (first.tolerance, last.tolerance) == TOLERANCES
    assert first.seconds < last.seconds
    for curve in (first, last):
        assert tuple(one.size_detectors for one in curve.thresholds) == sizes
        assert curve.thresholds[0].status == "never_reached"
        assert "no threshold at 2 detectors" in curve.limits[1]
    for size, found in zip(sizes[1:], last.thresholds[1:], strict=True):
        assert found.threshold == pytest.approx(computed(engine(), sizes=(size,))[-1].threshold, rel=1e-4)
    (again,) = live.curves(SENSOR, OBSERVER, sizes, tolerances=TOLERANCES, is_wanted=wanted)
    assert again.is_last
    assert again.thresholds == last.thresholds


def test_refusals_come_through_and_a_dead_process_is_replaced(live):
    with pytest.raises(SettingsError, match="size_detectors: found -1"):
        list(live.curves(SENSOR, OBSERVER, (-1.0, 4.0), is_wanted=wanted))
    with pytest.raises(SettingsError, match="p_correct: found"):
        list(live.curves(SENSOR, OBSERVER, (4.0,), p_correct=0.2, is_wanted=wanted))
    not_linear = OrientedObserver(complex_cells=True)
    with pytest.raises(SettingsError, match="observer: it is not linear"):
        list(live.curves(SENSOR, not_linear, (4.0,), is_wanted=wanted))
    os.kill(live._workers[0]._process.pid, signal.SIGKILL)
    with pytest.raises(TodframesError, match="live curves: a process that computes has died; a script must make"):
        list(live.curves(MOVES[0], OBSERVER, (3.0, 4.0), tolerances=TOLERANCES, is_wanted=wanted))
    *_, last = live.curves(MOVES[0], OBSERVER, (3.0, 4.0), tolerances=TOLERANCES, is_wanted=wanted)
    assert [one.status for one in last.thresholds] == ["ok", "ok"]
