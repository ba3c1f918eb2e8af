"""Obscured, defocused and measured optics, and motion: against pupils, drawn scenes and the closed forms."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.signal import fftconvolve

import sensor_sim as ss
from sensor_sim.chain.camera import Camera, ModelledOptics, resolve
from sensor_sim.chain.measured import MeasuredPsf
from sensor_sim.chain.sampling import TriangleSampler, field_detectors, sample_image
from sensor_sim.chain.sensor import sensor_toml
from sensor_sim.chain.transfer import (
    aperture_mtf,
    blur_mrad,
    looks_the_same_when_turned,
    motion_mtf,
    obscured_mtf,
    optics_otf,
    sharpness_bound,
)
from sensor_sim.chain.vary import numeric_keys
from todframes.base.errors import SettingsError
from todframes.stimulus import ORIENTATIONS, coverage

STAR_LIKE = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
CUT_OFF = 55.0
TEXT = STAR_LIKE.read_text(encoding="utf-8")
TWO_WAYS = "frequency_cyc_per_mrad,mtf_tangential,mtf_sagittal"


def sensor_file(tmp_path: Path, optics: str) -> Path:
    begin, end = TEXT.index("[optics]"), TEXT.index("[detector]")
    path = tmp_path / "sensor.toml"
    path.write_text(TEXT[:begin] + f"[optics]\naperture_mm = 220.0\nwavelength_um = 4.0\n{optics}\n" + TEXT[end:])
    return path


def write_table(
    tmp_path: Path, rows: list[tuple[float, ...]], columns: str = "frequency_cyc_per_mrad,mtf"
) -> None:
    lines = [columns, *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "mtf.csv").write_text("\n".join(lines), encoding="utf-8")


def write_psf(path: Path, values: np.ndarray) -> None:
    tifffile.imwrite(path, values.astype(np.float32))


def pupil_autocorrelation(ratio: float, waves: float, shift: float, n: int = 1200) -> float:
    """Overlap of an annular pupil of radius 1 with itself, displaced by twice `shift`, on n × n points.

    Those in one quadrant are a fourth of it: mirroring in x conjugates the product, mirroring in y keeps it.
    """
    grid = (np.arange(n // 2) + 0.5) / n * 2.0
    x, y = np.meshgrid(grid, grid)

    def pupil(at: np.ndarray) -> np.ndarray:
        square = at**2 + y**2
        return ((square <= 1.0) & (square >= ratio**2)) * np.exp(2j * np.pi * waves * square)

    overlap = (pupil(x + shift) * pupil(x - shift).conj()).sum().real * 4.0 * (2.0 / n) ** 2
    return float(overlap / (np.pi * (1.0 - ratio**2)))


def test_an_obscured_aperture_in_closed_form():
    # By hand: below (1 − ε)/2 an inner disc lies in the other's outer one, 1 − ε² − ε²·2 + …, and between
    # (1 + ε)/2 and the cut-off the inner discs do not count: the clear aperture's over 1 − ε².
    ratio, x = 0.5, np.linspace(0.76, 1.0, 20)
    clear = (2.0 / np.pi) * (np.arccos(x) - x * np.sqrt(1.0 - x**2))
    assert obscured_mtf(x, obscuration_ratio=ratio) == pytest.approx(clear / 0.75, abs=1e-12)
    x = np.linspace(0.0, 0.24, 20)
    discs = [(2.0 / np.pi) * (np.arccos(v) - v * np.sqrt(1.0 - v**2)) for v in (x, x / ratio)]
    assert obscured_mtf(x, obscuration_ratio=ratio) == pytest.approx(
        (discs[0] - 2.0 * ratio**2 + ratio**2 * discs[1]) / 0.75, abs=1e-12
    )


@pytest.mark.parametrize(("ratio", "waves"), [(0.0, 0.5), (0.0, 3.0), (0.45, 1.0)])
def test_a_defocused_aperture_is_the_autocorrelation_of_its_pupil(ratio, waves):
    optics = ModelledOptics(aperture_mm=2.0, wavelength_um=1.0, obscuration_ratio=ratio, defocus_waves=waves)
    for shift in (0.03, 0.21, 0.5, 0.8):
        assert aperture_mtf(2.0 * shift, optics=optics) == pytest.approx(
            pupil_autocorrelation(ratio, waves, shift), abs=4e-4
        )
    assert not aperture_mtf([2.0, 2.5], optics=optics).any()
    # Without defocus the integral is the closed form. Where inner discs touch rims, its height has a corner that
    # no node lies on: a part of 1/96 of the length, by 1/96 of the height.
    barely = ModelledOptics(aperture_mm=2.0, wavelength_um=1.0, obscuration_ratio=0.4, defocus_waves=1e-9)
    x, sharp = np.linspace(0.0, 1.2, 361), replace(barely, defocus_waves=0.0)
    assert aperture_mtf(2.0 * x, optics=sharp) == pytest.approx(obscured_mtf(x, obscuration_ratio=0.4), abs=1e-12)
    assert aperture_mtf(2.0 * x, optics=barely) == pytest.approx(obscured_mtf(x, obscuration_ratio=0.4), abs=1e-4)


@pytest.mark.parametrize(("unit", "per_mrad"), [("mrad", 1.0), ("mm", 10.0), ("pixel", 0.0681)])
def test_a_table_of_the_closed_form_gives_its_transfer(tmp_path, unit, per_mrad):
    """1 mrad is 0.1 mm behind 100 mm, and a pixel 0.0681 mrad."""
    frequency = np.linspace(0.0, CUT_OFF, 51)
    mtf = optics_otf(frequency, 0.0, optics=resolve(ss.load_sensor(STAR_LIKE)).optics)
    rows = list(zip((frequency * per_mrad).tolist(), mtf.tolist(), strict=True))
    write_table(tmp_path, rows, f"frequency_cyc_per_{unit},mtf")
    measured = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"\nfocal_length_mm = 100.0'))
    assert resolve(measured).optics.cut_off_cyc_per_mrad == pytest.approx(CUT_OFF, rel=1e-12)
    found = optics_otf(0.6 * frequency, 0.8 * frequency, optics=resolve(measured).optics)
    assert found == pytest.approx(mtf, abs=1e-9)
    assert 'mtf = "mtf.csv"' in sensor_toml(measured)
    if unit == "mm":
        with pytest.raises(SettingsError, match="focal_length_mm is missing: mtf in cycles/mm needs it for its"):
            ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"'))


@pytest.mark.parametrize("turn", [np.asarray, np.transpose])
def test_the_image_of_a_point_by_hand(turn):
    samples = turn(np.random.default_rng(1).random((4, 7)))
    samples = samples / samples.sum()
    psf = MeasuredPsf(file="psf.tif", shape=samples.shape, data=samples.tobytes())
    row, column = np.indices(samples.shape) - (np.array(samples.shape)[:, None, None] - 1) / 2.0
    x, y = (samples * column).sum(), (samples * row).sum()
    assert psf.centroid == pytest.approx((x, y), abs=1e-12)
    assert psf.end_otf == pytest.approx(
        max(abs((samples * np.exp(1j * np.pi * at)).sum()) for at in (row, column))
    )
    fx, fy = np.array([[0.1, 0.5, -0.5, 0.51, 0.2], [-0.5, 0.25, 0.5, 0.0, -0.51]])[..., None, None]
    waves = np.exp(-2j * np.pi * (fx * (column - x) + fy * (row - y)))
    expected = (samples * waves).sum(axis=(1, 2)) * [1, 1, 1, 0, 0]
    assert psf.at(fx[:, 0, 0], fy[:, 0, 0]) == pytest.approx(expected, abs=1e-12)
    # A wave of 3 cycles across 16 samples of 8 rows passes nothing else, to one step of 1/8; a point passes all.
    for image, limit in ((1.0 + np.cos(2.0 * np.pi * 3.0 * np.arange(16.0) / 16.0), 0.3125), ([8.0], 0.5**0.5)):
        image = turn(np.pad(np.outer(np.ones(8), image), ((0, 0), (0, 16 - len(image)))) / 128.0)
        if limit > 0.5:
            image = image * (np.indices(image.shape).sum(axis=0) == 0) * 16.0
        wave = MeasuredPsf(file="psf.tif", shape=image.shape, data=image.tobytes())
        assert wave.band_limit_cyc_per_sample == pytest.approx(limit, rel=1e-12)


def camera_with(optics, motion=None):
    return Camera(
        optics=optics,
        motion=motion,
        pitch_mrad=1.0,
        width_mrad=1.0,
        pixels_per_detector=1,
        shown_pitch_mrad=1.0,
    )


def test_the_blur_of_optics_is_that_of_their_half_transfer(tmp_path):
    optics = ModelledOptics(aperture_mm=220.0, wavelength_um=4.0, blur_sigma_mrad=0.05)
    motion = ss.Motion(smear_mrad=0.12, jitter_sigma_mrad=0.02)
    assert blur_mrad(camera_with(optics)) == 0.05
    moved = np.sqrt(0.05**2 + 0.12**2 / 12.0 + 0.02**2)
    assert blur_mrad(camera_with(optics, motion)) == pytest.approx(moved, rel=1e-12)
    frequency = np.linspace(0.0, 20.0, 81)
    gaussians = [np.exp(-2.0 * (np.pi * sigma * frequency) ** 2).tolist() for sigma in (0.05, 0.04)]
    # The wider one counts; a frequency is 1 % of that of half transfer.
    for columns in (gaussians, gaussians[::-1]):
        write_table(tmp_path, list(zip(frequency.tolist(), *columns, strict=True)), TWO_WAYS)
        measured = resolve(ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"'))).optics
        assert 0.0 <= 0.05 - blur_mrad(camera_with(measured)) < 0.0006
        assert 0.0 <= moved - blur_mrad(camera_with(measured, motion)) < 0.0006
        assert sharpness_bound(camera_with(measured)) == np.inf
        assert not looks_the_same_when_turned(camera_with(measured))
    defocused = ModelledOptics(aperture_mm=55.0, wavelength_um=1.0, defocus_waves=1.5)
    half = np.sqrt(np.log(2.0) / 2.0) / np.pi / blur_mrad(camera_with(defocused))
    # The first of 512 frequencies at which it is below a half; it falls by 0.027 from one to the next.
    assert 0.473 < pupil_autocorrelation(0.0, 1.5, half / 55.0) < 0.5
    for bad in (defocused, ModelledOptics(aperture_mm=1.0, wavelength_um=1.0, obscuration_ratio=0.2)):
        assert sharpness_bound(camera_with(bad)) == np.inf
    motions = None, ss.Motion(jitter_sigma_mrad=0.1), motion
    turned = [looks_the_same_when_turned(camera_with(optics, at)) for at in motions]
    assert turned == [True, True, False]


def samples_of(sensor: ss.Sensor, orientation, size: float = 4.0, field: int = 22) -> np.ndarray:
    sampler = TriangleSampler(resolve(sensor), size, field, 2 * field)
    return sampler.samples(0.2, -0.3, orientation=orientation)[0]


@pytest.mark.parametrize("orientation", ORIENTATIONS[:2])
def test_an_asymmetric_psf_stands_as_its_picture_does(tmp_path, orientation):
    """A scene of fine pixels convolved with the picture of the point, and averaged over detectors."""
    fine, field, size = 10, 22, 4.0
    pitch = 0.0681 / fine
    place = np.arange(-20.0, 21.0)
    blob = np.exp(-0.5 * ((place - 6.0)[None] / 2.5) ** 2) * np.exp(-0.5 * ((place + 5.0)[:, None] / 4.0) ** 2)
    psf = blob / blob.sum() + np.exp(-0.5 * (place[None] ** 2 + place[:, None] ** 2) / 4.0) / (8.0 * np.pi)
    psf /= psf.sum()
    x_at, y_at = psf.sum(axis=0) @ place, psf.sum(axis=1) @ place
    psf = np.roll(psf, (-round(y_at), -round(x_at)), axis=(0, 1))
    write_psf(tmp_path / "psf.tif", psf)
    sensor = ss.load_sensor(sensor_file(tmp_path, f'psf = "psf.tif"\npsf_pitch_mrad = {pitch!r}'))
    x_left, y_left = psf.sum(axis=0) @ place, psf.sum(axis=1) @ place
    # The package takes the rest of the shift out, so that the scene is moved back by as much here.
    shifted = coverage(
        (field * fine, field * fine),
        size_px=size * fine,
        x_px=(0.2 + field / 2.0) * fine - 0.5 - x_left,
        y_px=(-0.3 + field / 2.0) * fine - 0.5 - y_left,
        orientation=orientation,
    )
    seen = fftconvolve(shifted, psf, mode="same").reshape(field, fine, field, fine).mean(axis=(1, 3))
    found = samples_of(sensor, orientation)
    # Samples of a smooth PSF integrate as its continuous form does; fine pixels of the scene add 1/12 pixel² to
    # variances of several pixels², which changes the slope of an edge by below 1 %: 0.005 of a sample.
    assert found == pytest.approx(seen, abs=5e-3)
    assert np.abs(found - seen[::-1, ::-1]).max() > 0.05, "a PSF turned by 180° would not be seen"


def test_tangential_is_along_x_and_sagittal_along_y(tmp_path):
    frequency = np.linspace(0.0, 30.0, 31)
    rows = zip(
        frequency.tolist(), np.exp(-frequency / 4.0).tolist(), np.exp(-(frequency**2) / 90.0).tolist(), strict=True
    )
    write_table(tmp_path, list(rows), TWO_WAYS)
    optics = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"')).optics
    along_x, along_y, between = optics.mtf.at(np.array([5.0, 0.0, 3.0]), np.array([0.0, 5.0, 4.0]))
    assert along_x == pytest.approx(np.exp(-5.0 / 4.0), abs=1e-12)
    assert along_y == pytest.approx(np.exp(-25.0 / 90.0), abs=1e-12)
    assert between == pytest.approx(0.36 * along_x + 0.64 * along_y, abs=1e-12)
    origin_end_beyond = optics.mtf.at(np.array([0.0, 30.0, 30.001]), np.zeros(3))
    assert origin_end_beyond == pytest.approx([1.0, np.exp(-30.0 / 4.0), 0.0], abs=1e-12)
    assert optics.mtf.end_mtf == optics.mtf.tangential[-1]
    # Beyond its end, in steps of an eighth of it to twice, it falls as 1/frequency.
    continued, steps = optics.mtf.continued(), np.arange(9, 17) / 8.0
    assert continued.frequency == pytest.approx((*optics.mtf.frequency, *(30.0 * steps)), rel=1e-12)
    for name in ("tangential", "sagittal"):
        values = getattr(optics.mtf, name)
        assert getattr(continued, name) == pytest.approx((*values, *(values[-1] / steps)), rel=1e-12)


def test_an_mtf_with_the_detector_leaves_the_detector_out(tmp_path):
    sensor = ss.load_sensor(STAR_LIKE)
    frequency = np.linspace(0.0, 1.0 / 0.0681, 101)
    system = optics_otf(frequency, 0.0, optics=resolve(sensor).optics) * np.sinc(frequency * 0.0681)
    write_table(tmp_path, list(zip(frequency.tolist(), np.maximum(system, 0.0).tolist(), strict=True)))
    measured = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"\nmtf_includes_detector = true'))
    transfer = ss.mtf(measured).mtf
    assert "detector" not in transfer and transfer["pre_sample"] == transfer["measured_optics"]


def test_smear_is_a_mean_over_its_length():
    """A triangle that moves evenly by three detectors is the mean of triangles at 61 places."""
    sensor = ss.load_sensor(STAR_LIKE)
    length = 3.0 * sensor.pitch_mrad
    moved = replace(sensor, motion=ss.Motion(smear_mrad=length))
    sampler = TriangleSampler(resolve(sensor), 4.0, 22, 44)
    places = (np.arange(61) + 0.5) / 61.0 * 3.0 - 1.5
    for orientation in ORIENTATIONS[:2]:
        mean = sampler.samples(0.2 + places, np.full(61, -0.3), orientation=orientation).mean(axis=0)
        # The midpoint rule of 61 places over 3 detectors: h²/24 times the change of slope, below 1e-3.
        assert samples_of(moved, orientation) == pytest.approx(mean, abs=1e-3)
    jitter = motion_mtf(2.0, 0.0, motion=ss.Motion(jitter_sigma_mrad=0.1))
    assert jitter == pytest.approx(np.exp(-2.0 * (np.pi * 0.2) ** 2), rel=1e-12)


def test_a_scene_seen_by_asymmetric_optics_is_the_triangle_seen_by_them():
    moved = replace(ss.load_sensor(STAR_LIKE), motion=ss.Motion(smear_mrad=0.15))
    fine, field = 8, 22
    scene = coverage(
        (field * fine, field * fine),
        size_px=4.0 * fine,
        x_px=(0.2 + field / 2.0) * fine - 0.5,
        y_px=(-0.3 + field / 2.0) * fine - 0.5,
        orientation=ORIENTATIONS[1],
    )
    seen = sample_image(
        scene,
        pixel_pitch_mrad=0.0681 / fine,
        camera=resolve(moved),
        field_detectors=field,
    )
    assert seen == pytest.approx(samples_of(moved, ORIENTATIONS[1]), abs=2e-3)


GOOD = [(0.0, 1.0), (10.0, 0.5), (30.0, 0.0)]


def psf_with(place: tuple[int, int], total: float = 1.0) -> np.ndarray:
    psf = np.zeros((15, 15))
    psf[place[0] - 1 : place[0] + 2, place[1] - 1 : place[1] + 2] = total * np.outer([1, 2, 1], [1, 2, 1]) / 16.0
    return psf


BY_MTF, BY_PSF = 'mtf = "mtf.csv"', 'psf = "psf.tif"\npsf_pitch_mrad = 0.01'
MIDDLE = psf_with((7, 7))
WRONG_OPTICS = {
    "above 1": ([(0.0, 1.0), (10.0, 1.2), (30.0, 0.0)], BY_MTF, r"mtf 1\.2, expected 0 to 1 within its error"),
    "stops early": (GOOD[:2], BY_MTF, r"ends at 10 with an MTF of 0\.5, expected .* 0\.16 of"),
    "blur as well": (GOOD, f"{BY_MTF}\nblur_sigma_mrad = 0.1", "found mtf and blur_sigma_mrad, expect"),
    "no file": (GOOD, 'mtf = "none.csv"', r"none\.csv"),
    "no table": (GOOD, "mtf_includes_detector = true", "mtf_includes_detector: found true without mtf"),
    "outside": (GOOD, 'mtf = "../mtf.csv"', "mtf: ../mtf.csv lies outside"),
    "too fine": ([(0.0, 1.0), (3e8, 0.0)], BY_MTF, r"2\.043e\+07 cycles per detector, expected at most 34\.48 i"),
    "no unit": ([(0.0, 1.0), (1e300, 0.0)], BY_MTF, "ends at a frequency of 1e.300, expected 1e-09"),
    "no unit either": ([(0.0, 1.0), (1e-10, 0.0)], BY_MTF, "ends at a frequency of 1e-10, expected 1e-09"),
    "psf without pitch": (MIDDLE, 'psf = "psf.tif"', "psf: expected it with psf_pitch_um or psf_pitch_mrad"),
    "two pitches": (
        MIDDLE,
        f"{BY_PSF}\npsf_pitch_um = 1.0",
        "psf: expected it with psf_pitch_um or psf_pitch_mrad",
    ),
    "pitch without psf": (MIDDLE, "psf_pitch_um = 1.0", "psf: expected it with psf_pitch_um or psf_pitch_mrad"),
    "two measured": (GOOD, f"{BY_MTF}\n{BY_PSF}", "psf.tif"),
    "no focal length": (MIDDLE, 'psf = "psf.tif"\npsf_pitch_um = 1.0', "psf_pitch_um needs it for its angle"),
    "not normalised": (psf_with((7, 7), 255.0), BY_PSF, r"psf\.tif has the sum 255, expected 1"),
    "off centre": (psf_with((7, 10)), BY_PSF, r"centroid 3\.0 samples right of and 0\.0 below its middle"),
    "too coarse": (np.pad([[1.0]], 7), BY_PSF, "passes 1 at half a cycle per sample, expected at most 0.05"),
    "cut off": (np.full((15, 15), 1.0 / 225.0), BY_PSF, r"25 % of its light in the outermost samples"),
    "a film": (np.stack([MIDDLE] * 2), BY_PSF, r"psf\.tif has several images, expected one"),
    "two pixels": (np.full((2, 1), 0.5), BY_PSF, r"has the shape \(2, 1\), expected one channel of 3 to 2048"),
    "negative": (MIDDLE - 1e-3 * np.eye(15), BY_PSF, "expected none below 0"),
}


@pytest.mark.parametrize(("measured", "optics", "message"), WRONG_OPTICS.values(), ids=WRONG_OPTICS.keys())
def test_wrong_measured_optics_are_one_clear_line(tmp_path, sensor_sim, measured, optics, message):
    if isinstance(measured, list):
        write_table(tmp_path, measured)
    else:
        write_psf(tmp_path / "psf.tif", measured)
    status, out, error = sensor_sim("curve", sensor_file(tmp_path, optics), "--size-detectors", "4")
    assert status in (1, 2) and re.fullmatch(rf"error: .*{message}.*\n", error) and not out


def test_a_threshold_states_what_may_lie_beyond_its_table(tmp_path):
    """The same MTF to its end, cut at 4 %, and cut where nothing is left."""
    found = {}
    for name, last in (("whole", 40.0), ("cut", 20.0)):
        frequency = np.linspace(0.0, last, 81)
        write_table(tmp_path, list(zip(frequency.tolist(), np.exp(-0.008 * frequency**2).tolist(), strict=True)))
        sensor = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"'))
        (found[name],) = ss.curve(sensor, size_detectors=[4], tolerance=0.01, examples=False).fits
    steps = {
        name: [step for step in fit.plan if step["stage"] == "MTF beyond its table"] for name, fit in found.items()
    }
    assert not steps["whole"] and 0.0 < steps["cut"][0]["bound"] < 0.01
    error = found["cut"].threshold_numerical_error + found["whole"].threshold_numerical_error
    assert abs(found["cut"].threshold - found["whole"].threshold) < error


def test_an_mtf_is_1_at_frequency_0(tmp_path):
    write_table(tmp_path, [(0.0, 0.992), (10.0, 0.496), (30.0, 0.0)])
    measured = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"')).optics.mtf
    assert measured.tangential == pytest.approx((1.0, 0.5, 0.0), rel=1e-12)
    write_table(tmp_path, [(5.0, 1.005), (30.0, 0.0)])
    measured = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"')).optics.mtf
    assert (measured.frequency, measured.sagittal) == ((0.0, 5.0, 30.0), (1.0, 1.0, 0.0))
    # A shift of a sample, and a sum that is wrong by 0.9 %, are put right.
    write_psf(tmp_path / "psf.tif", psf_with((7, 8), 1.009)[..., None])
    point = ss.load_sensor(sensor_file(tmp_path, BY_PSF)).optics.psf
    assert point.centroid == pytest.approx((1.0, 0.0), abs=1e-6) and point.samples.sum() == pytest.approx(1.0)


def test_a_blur_that_is_too_wide_is_refused():
    # 1,020 − 4·4 detectors are left for six deviations.
    moved = replace(ss.load_sensor(STAR_LIKE), motion=ss.Motion(smear_mrad=200.0))
    with pytest.raises(SettingsError, match=r"air blur by 57\.74 mrad, expected at most 11\.4 with"):
        field_detectors(resolve(moved), 4.0)


def test_a_field_is_four_sizes_a_margin_and_three_deviations_on_each_side():
    sensor = ss.load_sensor(STAR_LIKE)
    assert field_detectors(resolve(sensor), 5.0) == int(np.ceil(20.0 + 6.0 * 0.01 / 0.0681 + 4.0)) == 25
    assert field_detectors(resolve(sensor), 5.0, 6.5) == int(np.ceil(32.5 + 6.0 * 0.01 / 0.0681 + 4.0)) == 38
    sharp = replace(sensor, optics=replace(sensor.optics, blur_sigma_mrad=0.0))
    assert field_detectors(resolve(sharp), 255.0) == 1024
    with pytest.raises(SettingsError, match=r"^size_detectors: found 255\.1, expected at most 255$"):
        field_detectors(resolve(sharp), 255.1)


def test_measured_optics_need_an_aperture_for_their_light_alone(tmp_path):
    write_table(tmp_path, GOOD)
    path = sensor_file(tmp_path, 'mtf = "mtf.csv"')
    path.write_text(re.sub(r"(aperture_mm|wavelength_um) = .*\n", "", path.read_text()))
    without = ss.load_sensor(path)
    assert ss.curve(without, size_detectors=[6], tolerance=0.1, examples=False).thresholds[0].threshold > 0.0
    camera = {"photons": ss.PhotonNoise(dark_noise_electrons=5.0, exposure_ms=10.0, quantum_efficiency=0.5)}
    for optics, missing in (({}, "aperture_mm"), ({"aperture_mm": 10.0}, "wavelength_um")):
        optics = replace(without.optics, focal_length_mm=50.0, **optics)
        with pytest.raises(SettingsError, match=f"^optics.{missing} is missing: "):
            replace(without, optics=optics, scene=ss.Scene(luminance_cd_m2=10.0), **camera)


@pytest.mark.parametrize("key", ["aperture_mm", "wavelength_um"])
def test_modelled_optics_need_aperture_and_wavelength(key):
    with pytest.raises(SettingsError, match=f"^{key} is missing$"):
        ss.Optics(**({"aperture_mm": 10.0, "wavelength_um": 1.0} | {key: None}))


@pytest.mark.parametrize("key", ["aperture_mm", "blur_sigma_mrad"])
def test_a_sweep_cannot_vary_what_a_measured_mtf_has_in_it(tmp_path, key):
    write_table(tmp_path, GOOD)
    sensor = ss.load_sensor(sensor_file(tmp_path, 'mtf = "mtf.csv"'))
    coupled = replace(sensor, noise=replace(sensor.noise, couple_netd=True))
    assert "optics.aperture_mm" in numeric_keys(coupled)  # the NETD follows it
    with pytest.raises(SettingsError, match=rf"unknown key 'optics\.{key}'"):
        ss.sweep(sensor, size_detectors=[6], vary={f"optics.{key}": [110.0, 220.0]})
