"""A camera by its films: noise-equivalent quanta against closed forms, and a SENSOR.toml of known numbers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from closing_circle import BITS, DISTANCE_M, EXPOSURE_MS, FRAMES_PER_SECOND, MONITOR, SCALE, make_film
from edges import edge_image, gaussian, true_mtf

import sensor_sim as ss
import todframes as tod
from sensor_sim.films.measured_camera import RING_CYC_PER_PIXEL, noise_powers, quanta
from todframes.cli.console import run
from todframes.recordings.arrays import memory_recording

FREQUENCIES = (0.125, 0.25)


@pytest.fixture
def edge(tmp_path: Path) -> Path:
    np.save(tmp_path / "edge.npy", edge_image((90, 100), 6.0, gaussian(0.6), low=200.0, high=800.0))
    return tmp_path / "edge.npy"


def quanta_of(electrons: float, variance: float) -> np.ndarray:
    """NEQ of white noise, in electrons, behind the optics of `edge`."""
    return electrons**2 * true_mtf(np.array(FREQUENCIES), gaussian(0.6), 6.0) ** 2 / variance


@pytest.mark.parametrize("n_frames", [1, 8])
def test_quanta_of_photons_are_their_number_times_the_squared_mtf(
    edge: Path, tmp_path: Path, n_frames: int
) -> None:
    electrons, read_noise, gain = 900.0, 10.0, 2.5
    rng = np.random.default_rng(3)
    arrived = rng.poisson(electrons, (n_frames, 160, 160)) + rng.normal(0.0, read_noise, (n_frames, 160, 160))
    np.save(tmp_path / "grey.npy", gain * arrived)
    found = ss.camera(edge=edge, grey=tmp_path / "grey.npy", pitch_mrad=0.2, frames_per_second=40.0)
    # A ring of ± 1/32 at 0.125 cycles/pixel has 1,257 frequencies, half of them by themselves: 4 % of one frame.
    expected = quanta_of(electrons, electrons + read_noise**2)
    assert [at.neq for at in found.neq] == pytest.approx(expected, rel=4 * 0.04 / n_frames**0.5)
    assert [at.snr**2 for at in found.neq] == pytest.approx([at.neq for at in found.neq])
    assert found.signal == pytest.approx(gain * electrons, rel=0.01)
    found.save(tmp_path / "out")
    sensor = ss.load_sensor(tmp_path / "out" / "sensor.toml")
    assert (sensor.detector.pitch_mrad, sensor.noise.distribution) == (0.2, "gaussian")
    # Of one frame all is noise; of more, the frames of 0.1 s are averaged.
    assert sensor.noise.frames_integrated == (1 if n_frames == 1 else 4)
    again = tod.load_result(tmp_path / "out")
    assert again.neq == found.neq and again.sentences() == found.sentences()
    assert ("one_frame" in {warning.code for warning in found.warnings}) == (n_frames == 1)


def test_noise_power_is_the_spectrum_of_the_noise() -> None:
    """White noise through [1, 2, 1] / 4 along x has cos⁴(π f_x) of its power; falling light is none."""
    y, x = np.mgrid[:128, :192]
    noise = np.random.default_rng(4).normal(0.0, 3.0, (30, 128, 194))
    smooth = (noise[..., :-2] + 2.0 * noise[..., 1:-1] + noise[..., 2:]) / 4.0
    film = memory_recording(500.0 - 0.4 * x + 1e-3 * y * x + smooth, frames_per_second=None)
    powers = noise_powers(film, (0, 0, 192, 128), FREQUENCIES)
    f_x, f_y = np.meshgrid(np.arange(-0.3, 0.3, 1e-3), np.arange(-0.3, 0.3, 1e-3))
    rings = [np.abs(np.hypot(f_x, f_y) - f) <= RING_CYC_PER_PIXEL for f in FREQUENCIES]
    # 600 frequencies at least, and 30 frames: 0.7 %.
    expected = [9.0 * np.mean(np.cos(np.pi * f_x[ring]) ** 4) for ring in rings]
    assert [power for power, _ in powers] == pytest.approx(expected, rel=0.03)


def test_intervals_of_quanta_hold_them_and_count_both_errors() -> None:
    """Of 100 films of white noise, 95 % ± 3 · 2.2 %. Of no noise in the film, twice the relative band is left."""
    rng, held = np.random.default_rng(5), []
    for _ in range(100):
        film = memory_recording(500.0 + rng.normal(0.0, 2.0, (2, 64, 64)), frames_per_second=None)
        powers = noise_powers(film, (0, 0, 64, 64), FREQUENCIES)
        for at in quanta(500.0, np.array([0.0, 0.5]), [np.ones(2)], FREQUENCIES, powers):
            held.append(at.neq_ci95[0] <= 500.0**2 / 4.0 <= at.neq_ci95[1])
    assert 0.88 <= np.mean(held) <= 1.0
    curves = [np.full(2, mtf) for mtf in (0.5, 0.5 * np.exp(-0.01), 0.5 * np.exp(0.01))]
    (at,) = quanta(10.0, np.array([0.0, 0.5]), curves, [0.25], [(1.0, 0.0)])
    assert at.neq_ci95 == pytest.approx((25.0 * np.exp(-0.02), 25.0 * np.exp(0.02)), rel=1e-4)


def test_a_film_of_a_chart_gives_the_camera_that_filmed_it(tmp_path: Path) -> None:
    small = {"sizes_mrad": (2.0,), "contrasts": (0.2,), "repeats": 1, "frames_per_page": 1, "camera_frames": 20}
    camera = make_film(tmp_path, seed=21, **small)
    chart, film = tmp_path / "chart" / "chart.toml", tmp_path / "film.npy"
    dark = {"dark": tmp_path / "dark.npy", "exposure_ms": EXPOSURE_MS, "bits": BITS}
    found = ss.camera([film], chart=chart, frames_per_second=FRAMES_PER_SECOND, **dark)  # as the command does
    low, high = found.emva.noise.emva1288.system_gain_ci95
    assert low <= camera.gain_dn_per_electron <= high
    assert found.pitch_mrad == pytest.approx(MONITOR["pixel_pitch_mm"] / SCALE / DISTANCE_M, rel=5e-3)
    assert found.mtf.mtf.mtf50 == pytest.approx(0.281, rel=0.01)
    # Rows have a share of the noise in few frequencies, and PRNU and DSNU count: of 998 electrons some 1,230 e⁻².
    electrons = found.signal / camera.gain_dn_per_electron
    patterns = camera.dsnu_electrons**2 + (camera.prnu_percent / 100.0 * electrons) ** 2
    variance = electrons + camera.dark_noise_electrons**2 + patterns
    mtf = np.exp(-2.0 * (np.pi * camera.blur_sigma_px * np.array(FREQUENCIES)) ** 2) * np.sinc(FREQUENCIES)
    assert [at.neq for at in found.neq] == pytest.approx(electrons**2 * mtf**2 / variance, rel=0.1)
    found.save(tmp_path / "out")
    sensor = ss.load_sensor(tmp_path / "out" / "sensor.toml")
    assert sensor.photons.frames_integrated == 2 and sensor.scene.background_electrons == pytest.approx(
        electrons, rel=0.01
    )
    assert [fit.threshold for fit in found.curve.fits] == [
        fit.threshold for fit in ss.curve(sensor, tolerance=0.01, examples=False).fits
    ]
    # Without dark frames black is that of the line through the patches, and thresholds are SNR.
    other = ss.camera(film, chart=chart)
    assert other.signal == pytest.approx(found.signal, rel=0.02)
    assert [at.neq for at in other.neq] == pytest.approx([at.neq for at in found.neq], rel=0.04)
    assert {fit.level for fit in other.curve.fits} == {"snr"}


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ("edge.npy", 2, "camera: expected a film with --chart, or --edge and --grey in its place"),
        ("--edge edge.npy", 2, "camera: expected a film with --chart, or --edge and --grey in its place"),
        ("edge.npy --chart c.toml --edge edge.npy --grey edge.npy", 2, "camera: expected a film with --chart, or"),
        ("--edge edge.npy --grey edge.npy --dark edge.npy", 2, "found one of --dark and --exposure-ms, expected"),
        ("--edge edge.npy --grey below.npy", 1, "below.npy: the mean is 3 below black, expected light"),
    ],
)
def test_what_is_no_camera_is_one_line(
    edge: Path, capsys: pytest.CaptureFixture[str], options: str, status: int, message: str
) -> None:
    from sensor_sim.cli import cli

    np.save(edge.with_name("below.npy"), np.random.default_rng(1).normal(-3.0, 0.01, (40, 64, 64)))
    asked = re.sub(r"(\w+\.(npy|toml))", rf"{edge.parent}/\1", options)
    assert run(cli, ["camera", *asked.split(), "--quiet"]) == status
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1
