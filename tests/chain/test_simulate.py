"""Simulated frames: the chain of stages by other means, and datasets that are whole, readable and repeatable."""

from __future__ import annotations

import csv
import errno
import math
import os
import shutil
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.ndimage import gaussian_filter
from test_bad_input import tree

from sensor_sim import cli
from sensor_sim.chain import pictures
from sensor_sim.chain.pictures import trial_stages
from sensor_sim.chain.sensor import (
    Detector,
    Electronics,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    Sensor,
    SensorDisplay,
    sensor_toml,
)
from sensor_sim.chain.simulation import SimulatedTrial, Simulator, plan_trials
from sensor_sim.frames.simulate import white_luminance_cd_m2, write_dataset
from todframes import __version__
from todframes.base.errors import FrameError, SettingsError
from todframes.cli.console import run
from todframes.frames import dataset_files
from todframes.frames import files as frame_writing
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, read_frame
from todframes.jobs.run import Run, open_engine
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import resample
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import Fit
from todframes.scoring.score import score_dataset
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus

BAD_SETTINGS = 2

DISPLAY = SensorDisplay(
    pixels_per_detector=5,
    pixel_pitch_mm=0.25,
    viewing_distance_mm=1500.0,
    background_luminance_cd_m2=40.0,
    blur_sigma_px=1.6,
    gain=0.8,
)
NOISE = Noise(fixed_pattern_ratio=0.4, frames_integrated=6)
SENSOR = Sensor(
    name="bench",
    optics=Optics(aperture_mm=100.0, wavelength_um=10.0, blur_sigma_mrad=0.05),
    detector=Detector(pitch_mrad=0.2, width_mrad=0.15),
    noise=NOISE,
    electronics=Electronics(blur_sigma_px=1.2),
    display=DISPLAY,
)
SHARP = replace(
    SENSOR,
    optics=Optics(aperture_mm=1e9, wavelength_um=1.0),
    electronics=Electronics(),
    display=replace(DISPLAY, blur_sigma_px=0.0),
)
SIZE = 3.0


def written(tmp_path: Path, name: str, sensor: Sensor = SENSOR, **options) -> Path:
    options = {"sizes": (SIZE,), "snrs": (1.0, 4.0), "trials": 4, "seed": 1} | options
    planned = plan_trials(options.pop("sizes"), options.pop("snrs"), options.pop("trials"))
    folder = tmp_path / name
    folder.mkdir()
    write_dataset(folder, sensor, planned, **options)
    return folder


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "manifest.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def pixels(path: Path) -> np.ndarray:
    return read_frame(path).values[..., 0]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_frame_is_the_held_and_blurred_samples_on_the_background():
    simulator = Simulator(SENSOR, SIZE, seed=3)
    trials = plan_trials([SIZE], [2.0], 4)
    _, noisy = simulator.samples(trials)
    for samples, frame in zip(noisy, simulator.frames(trials), strict=True):
        held = np.kron(samples, np.ones((5, 5)))
        # One blur after the other is one of σ² = 1.2² + 1.6² px²; nothing lies beyond the field.
        shown = gaussian_filter(held, 2.0, mode="constant", truncate=9.0)
        # Some hundred products of luminances below 100, each rounded to 1e-16 of itself.
        np.testing.assert_allclose(frame.luminance_cd_m2, 40.0 * (1.0 + 0.8 * shown), rtol=0.0, atol=1e-11)


def test_places_fill_one_detector_evenly():
    n = 1500
    places, _ = Simulator(SENSOR, 0.5, seed=5).samples(plan_trials([0.5], [1.0], n), noise=False)
    # Uniform in ±0.5: five standard errors of the mean and of the variance (κ = 1.8).
    assert np.abs(places).max() <= 0.5 and np.abs(places.mean(axis=0)).max() < 5 * np.sqrt(1 / 12 / n)
    assert np.abs(12 * places.var(axis=0) - 1).max() < 5 * np.sqrt(0.8 / n)


@pytest.mark.slow
@pytest.mark.parametrize("frame_format", ["exr", "png"])
def test_bytes_depend_on_the_seed_and_not_on_the_workers(tmp_path, frame_format):
    # 2 sizes × 1 SNR × 34: four tasks.
    options = {"sizes": (0.6, 1.0), "snrs": (4.0,), "trials": 34, "frame_format": frame_format}
    one = contents(written(tmp_path, "one", **options))
    assert len(one) == 70
    with open_engine(None, 2) as engine:
        assert contents(written(tmp_path, "two", **options, run=Run(engine))) == one
    other = contents(written(tmp_path, "other", **options, seed=2))
    frames = [name for name in one if name.startswith("frames/")]
    assert len({*map(one.get, frames), *map(other.get, frames)}) == 2 * len(frames)


@pytest.fixture(params=["exr", "png"])
def dataset_folder(request, tmp_path):
    return written(tmp_path, "dataset", sizes=(2.0, SIZE), frame_format=request.param)


def test_dataset_holds_the_frames_of_the_simulator(dataset_folder):
    dataset = load_dataset(dataset_folder)
    planned = plan_trials([2.0, SIZE], [1.0, 4.0], 4)
    frames = [frame for t in planned for frame in Simulator(SENSOR, t.size_detectors, seed=1).frames([t])]
    for trial, plan, frame in zip(dataset.trials, planned, frames, strict=True):
        assert (trial.level, trial.orientation) == (plan.level, plan.orientation)
        # Six decimals.
        assert (trial.x_px, trial.y_px) == pytest.approx((frame.x_px, frame.y_px), abs=5.1e-7)
        luminance = dataset.display.luminance(read_frame(dataset.frame_path(trial.frames[0])).values)
        wanted = frame.luminance_cd_m2
        if trial.frames[0].path.endswith(".png"):
            white = white_luminance_cd_m2(SENSOR, [1.0])
            wanted = np.clip(wanted, 0.0, white)
            np.testing.assert_allclose(luminance, wanted, rtol=0.0, atol=0.51 * white / 65535)
        else:
            # Half floats have 11 bits; 2^-24 is the smallest step near zero.
            np.testing.assert_allclose(luminance, wanted, rtol=2**-11, atol=2**-24)


def test_frames_tell_how_they_were_made(dataset_folder):
    for row in rows_of(dataset_folder):
        attributes = FrameFile(dataset_folder / row["frame"]).header.attributes
        made = {"sensor": "bench", "version": __version__, "seed": "1", "orientation": row["orientation"]}
        assert {key: attributes[f"sensor_sim:{key}"] for key in made} == made
        for key in ("size_detectors", "snr"):
            assert float(attributes[f"sensor_sim:{key}"]) == float(row[key])
    text = (dataset_folder / "dataset.toml").read_text(encoding="utf-8")
    for found in ("sensor-sim", __version__, "seed 1", "bench"):
        assert found in text
    assert set(tomllib.loads(text)) == {"schema", "display", "experiment"}


@pytest.mark.parametrize("name", ["", "two\nlines", 'quo"te', "[/b] $x^{", "nul\0"], ids=ascii)
def test_any_name_of_a_sensor_gives_a_readable_dataset_or_a_refusal(tmp_path, name):
    try:
        folder = written(tmp_path, "dataset", replace(SENSOR, name=name), snrs=(2.0,), trials=1)
    except SettingsError:
        return
    assert len(load_dataset(folder).trials) == 1


def test_exr_keeps_luminance_below_zero(tmp_path):
    folder = written(tmp_path, "dataset", SHARP, snrs=(0.3,))
    assert all(pixels(folder / row["frame"]).min() < -50.0 for row in rows_of(folder))
    scored = score_dataset(load_dataset(folder), PyramidObserver(), fit_settings=FitSettings(resamples=0))
    assert scored.n_negative > 0


@pytest.mark.parametrize(
    ("noise", "reach"),
    [
        (Noise(), 3.0**0.5),
        (NOISE, 3.0**0.5 * ((1 / 6) ** 0.5 + 0.4) / (1 / 6 + 0.16) ** 0.5),
        (Noise(row_noise_ratio=0.6), 3.0**0.5 * 0.8 + 4.0 * 0.6),
        (Noise(distribution="gaussian", row_noise_ratio=0.6), 4.0),
    ],
)
def test_png_white_by_hand(noise, reach):
    white = white_luminance_cd_m2(replace(SENSOR, noise=noise), [2.0, 0.5])
    assert white == pytest.approx(40.0 * (1.0 + 0.8 * (1.0 + reach / 0.5)), rel=1e-12)
    # A camera with shot noise of 100 electrons and of the signal, at a contrast of 3, and a PRNU of 2 %.
    counted = PhotonNoise(dark_noise_electrons=0.0, exposure_ms=1.0, prnu_percent=2.0)
    camera = replace(SENSOR, photons=counted, scene=Scene(background_electrons=100.0))
    variance = 1 / 100 + 3.0 / 100 + 0.02**2 * (1.0 + 3.0) ** 2
    expected = 40.0 * (1.0 + 0.8 * (3.0 + 4.0 * variance**0.5))
    assert white_luminance_cd_m2(camera, [1.0, 3.0]) == pytest.approx(expected, rel=1e-12)


GAUSSIAN = replace(SHARP, noise=Noise(distribution="gaussian"), display=replace(SHARP.display, gain=1.0))


def test_png_counts_what_it_clips(tmp_path):
    planned, white = plan_trials([SIZE], [2.576], 12), white_luminance_cd_m2(GAUSSIAN, [2.576])
    frames = Simulator(GAUSSIAN, SIZE, seed=1).frames(planned)
    luminance = np.stack([frame.luminance_cd_m2 for frame in frames])
    share = np.mean((luminance < 0.0) | (luminance > white))
    # Gaussian noise is darker than black with probability Φ(−SNR): 0.5 % at 2.576, on all but the triangle.
    assert 0.003 < share < 0.007
    done = write_dataset(tmp_path, GAUSSIAN, planned, seed=1, frame_format="png")
    assert (done.n_frames, done.clipped_share) == (12, pytest.approx(share, rel=1e-12))


def test_png_refuses_to_clip_more_than_one_in_a_hundred(tmp_path):
    # 2.3 % at 2 standard deviations.
    with pytest.raises(SettingsError, match=r"^format: 2(\.\d)? % of the PNG pixels would be clipped, .* 1 %"):
        written(tmp_path, "refused", GAUSSIAN, snrs=(2.0,), trials=12, frame_format="png")
    clipped = {"trials": 12, "frame_format": "png", "allow_clipping": True}
    folder = written(tmp_path, "allowed", GAUSSIAN, snrs=(2.0,), **clipped)
    assert min(pixels(folder / row["frame"]).min() for row in rows_of(folder)) == 0.0
    assert written(tmp_path, "exr", GAUSSIAN, snrs=(2.0,), trials=12).is_dir()


def test_plan_has_each_size_and_snr_so_many_times_and_the_orientations_in_turn():
    planned = plan_trials([2.0, 3.0], [1.0, 2.0, 4.0], 8)
    assert len(planned) == len({trial.key for trial in planned}) == 48
    counted = Counter((trial.size_detectors, trial.level, trial.orientation) for trial in planned)
    assert len(counted) == 24 and set(counted.values()) == {2}
    assert planned[37] == SimulatedTrial((1, 1, 5), 3.0, 2.0, ORIENTATIONS[1])


@pytest.mark.parametrize(
    ("sizes", "snrs", "trials", "match"),
    [
        ([], [1.0], 1, "^size_detectors: found no values"),
        ([1.0], [math.nan], 1, "^snr: found nan, expected a finite number > 0"),
        ([1.0], [1.0], 0, "^trials: found 0, expected a whole number from 1 to 1000000"),
        ([1.0, 2.0], [1.0, 3.0], 10**9, "^trials: found 1000000000, expected a whole number from 1 to 250000"),
    ],
)
def test_plan_refuses(sizes, snrs, trials, match):
    with pytest.raises(SettingsError, match=match):
        plan_trials(sizes, snrs, trials)


STAGES = [*("a_input", "b_optics", "c_detector_response", "d_samples", "e_noise", "f_hold", "g_display")]


def test_stages_follow_from_each_other():
    trial = SimulatedTrial((0, 0, 1), SIZE, 4.0, Orientation.RIGHT)
    stages = trial_stages(SENSOR, trial, seed=6)
    assert list(stages) == STAGES
    simulator = Simulator(SENSOR, SIZE, seed=6)
    field, fine = simulator.field, 8
    assert [stages[name].shape[0] for name in STAGES] == [fine * field] * 3 + [field] * 2 + [5 * field] * 2
    # No stage before the noise adds or takes light; the image repeats, so nothing leaves it either.
    for name in STAGES[:3]:
        assert stages[name].sum() / fine**2 == pytest.approx(SIZE**2, rel=1e-9)
    # Samples are the detector's response at the detectors' middles, which lie at corners of four fine pixels.
    # A mean over a fine pixel and over the four is wrong by second derivatives: 2 · (1/8)² / 24 + (1/16)² of
    # them; 1/(2σ²) of 1 at most, σ² = 0.25² + 0.75²/12 detectors² of optics and detector.
    response = stages["c_detector_response"].reshape(field, fine, field, fine)[:, 3:5, :, 3:5].mean(axis=(1, 3))
    np.testing.assert_allclose(response, stages["d_samples"], atol=(2 / 64 / 24 + 1 / 256) / 0.22)
    noise = stages["e_noise"] - stages["d_samples"]
    # Uniform parts of 0.71 and 0.70 standard deviations together, √3 each.
    assert 0.15 < noise.std() < 0.35
    assert np.abs(noise).max() < 0.25 * np.sqrt(3.0) * 1.415
    np.testing.assert_array_equal(stages["f_hold"], np.kron(stages["e_noise"], np.ones((5, 5))))
    shown = gaussian_filter(stages["f_hold"], 2.0, mode="constant", truncate=9.0)
    np.testing.assert_allclose(stages["g_display"], shown, atol=1e-12)
    ((place, *_), _) = simulator.samples([trial], noise=False)
    for name in STAGES[:3]:  # the tails of the optics, which repeat, are far from even
        for axis, at in enumerate(place):
            moment = stages[name].sum(axis=axis) @ np.arange(fine * field) / stages[name].sum()
            assert moment == pytest.approx((at + field / 2) * fine - 0.5, abs=0.01 if name == "a_input" else 0.5)


def test_stages_of_a_camera_that_counts_photons_are_in_units_of_the_signal():
    counted = PhotonNoise(dark_noise_electrons=0.0, exposure_ms=1.0)
    camera = replace(SHARP, optics=SENSOR.optics, photons=counted, scene=Scene(background_electrons=1e11))
    stages = trial_stages(camera, SimulatedTrial((0, 0, 1), 6.0, 4.0, Orientation.RIGHT), seed=6)
    assert stages["d_samples"].max() == pytest.approx(1.0, abs=0.05)
    # Noise of 3e-6 of the background.
    np.testing.assert_allclose(stages["e_noise"], stages["d_samples"], atol=3e-5)
    np.testing.assert_allclose(stages["g_display"], stages["f_hold"], atol=1e-9)


@pytest.mark.parametrize(("centre", "sixth_of_height"), [("centroid", 0.0), ("bounding_box", 3.0**0.25 / 6.0)])
def test_a_frame_at_threshold_is_seen_where_the_observer_looks(monkeypatch, centre, sixth_of_height):
    seen = []
    monkeypatch.setattr(pictures, "resample", lambda *of, **at: seen.append((*of, at)) or resample(*of, **at))
    reached = Fit(group={"size_detectors": SIZE}, level="snr", p_correct=0.75, status="ok", threshold=2.0)
    fits = [structs.replace(reached, status="never_reached", threshold=None), reached]
    (example,) = pictures.threshold_examples(SENSOR, PyramidObserver(centre=centre), fits, seed=3)
    (frame,) = Simulator(SENSOR, SIZE, seed=3).frames([SimulatedTrial((0, 0, 0), SIZE, 2.0, Orientation.UP)])
    ((contrast, grid, at),) = seen
    assert grid == PyramidObserver(centre=centre).grid(Stimulus(SIZE * DISPLAY.detector_pitch_mrad))
    np.testing.assert_array_equal(contrast, frame.luminance_cd_m2 / 40.0 - 1.0)
    assert at == {
        "x_px": pytest.approx(frame.x_px),
        "y_px": pytest.approx(frame.y_px - sixth_of_height * SIZE * 5),
        "pixel_pitch_mrad": DISPLAY.pixel_pitch_mrad,
    }
    assert (example.group, example.level) == (reached.group, "snr")
    assert (example.strength, example.orientation) == (2.0, "up")


def test_a_frame_that_is_too_large_is_refused():
    fine = replace(SENSOR, display=replace(DISPLAY, pixels_per_detector=1000))
    # 4 · 3 detectors, six deviations of a quarter of one, and 4: 18 on each side.
    with pytest.raises(
        SettingsError, match="a triangle of 3 detectors a frame of 18000 × 18000 pixels, expected at"
    ):
        Simulator(fine, SIZE, seed=1)


def test_stages_are_written_as_pictures(tmp_path):
    trial = plan_trials([SIZE], [2.0], 4)[0]
    pictures.write_stages(tmp_path / "stages", SENSOR, trial, seed=1)
    assert sorted(file.stem for file in (tmp_path / "stages").iterdir()) == [*STAGES, "stages"]
    for name, stage in trial_stages(SENSOR, trial, seed=1).items():
        grey = pixels(tmp_path / "stages" / f"{name}.png")
        # Black is −1, white 2; 8 bits.
        np.testing.assert_allclose(3.0 * grey - 1.0, np.clip(stage, -1.0, 2.0), atol=3 * 0.51 / 255)


@pytest.fixture
def simulate_command(capfd, tmp_path):
    """Runs `sensor-sim simulate`; status, standard output, lines of standard error."""
    (tmp_path / "SENSOR.toml").write_text(sensor_toml(SENSOR), encoding="utf-8")

    def call(out, *options):
        arguments = ["--size-detectors", SIZE, "--snr", "2", "--trials", "4", "-o", out, *options]
        status = run(cli.cli, ["simulate", str(tmp_path / "SENSOR.toml"), *map(str, arguments)])
        captured = capfd.readouterr()
        return status, captured.out, captured.err.splitlines()

    return call


@pytest.mark.parametrize(("module", "function"), [(frame_writing, "_write"), (dataset_files, "csv_text")])
def test_a_full_disk_leaves_what_is_finished_and_nothing_else(
    simulate_command, tmp_path, monkeypatch, module, function
):
    """At the last of some frames, and at the manifest."""
    before, folder, calls = tree(tmp_path), tmp_path / "dataset", []
    write, room = getattr(module, function), 35 if function == "_write" else 0

    def until_full(path, *rest):
        calls.append(path)
        if len(calls) > room:
            raise FrameError(path, os.strerror(errno.ENOSPC)) if room else OSError(errno.ENOSPC, "No space left")
        return write(path, *rest)

    monkeypatch.setattr(module, function, until_full)
    status, out, (error, note) = simulate_command(folder, "--trials", "40")
    assert (status, out) == (BAD_SETTINGS, "")
    assert error.startswith("error: ") and "No space left" in error and str(folder) in error
    assert note.startswith(f"note: what is finished is kept in {folder}; ")
    shutil.rmtree(folder)
    assert len(calls) > room
    assert tree(tmp_path) == before
