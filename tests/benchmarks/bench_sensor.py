"""Whole curves against the import of their libraries, and frames against an oversampled FFT chain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from timing import Row, best_s, process

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.reconstruction import axis_matrix, display_signal
from sensor_sim.chain.sampling import TriangleSampler
from sensor_sim.chain.sensor import Sensor, load_sensor
from sensor_sim.chain.transfer import optics_otf
from todframes.stimulus import Orientation, coverage

SENSOR = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
SIZES = (3.5, 4.0, 5.0, 6.0, 8.0)
TOLERANCE = 0.02
CURVES = f"""
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from sensor_sim.chain.sensor import load_sensor
from todframes.observers.pyramid import PyramidObserver
sensor, observer = load_sensor({str(SENSOR)!r}), PyramidObserver()
for size in {SIZES}:
    plan = plan_curve(resolve(sensor), observer, size, tolerance={TOLERANCE})  # as the command `curve` does
    chain = FoldedChain(resolve(sensor), observer, size, plan)
    for scale in (1.0, 0.5):  # internal noise 0.5 and 0.25
        chain.noise_covariance = scale**2 * chain.noise_covariance
        predict_threshold(chain, tolerance={TOLERANCE})
"""


def oversampled_frame_s(sensor: Sensor, field: int, size: float) -> tuple[float, float]:
    """Time of a frame through FFTs of a scene at 8 pixels a detector, and the largest error of its samples."""
    fine = 8
    n, pitch = fine * field, sensor.pitch_mrad / fine
    frequency = np.fft.fftfreq(n, pitch)
    radial = np.hypot(frequency[:, None], frequency[: n // 2 + 1])
    box = np.sinc(frequency * sensor.width_mrad)
    before = (
        optics_otf(radial, np.zeros_like(radial), optics=resolve(sensor).optics) * box[:, None] * box[: n // 2 + 1]
    )
    display = sensor.display
    per_px = display.pixels_per_detector
    f_px = np.fft.fftfreq(field * per_px)
    after = np.exp(
        -2 * (np.pi * display.blur_sigma_px) ** 2 * (f_px[:, None] ** 2 + f_px[: field * per_px // 2 + 1] ** 2)
    )
    rng = np.random.default_rng(0)
    seen: list[np.ndarray] = []

    def frame(x: float = 0.2, y: float = -0.3) -> None:
        middle = (n - 1) / 2
        scene = coverage(
            (n, n), size_px=size * fine, x_px=middle + x * fine, y_px=middle + y * fine, orientation=Orientation.UP
        )
        blurred = np.fft.irfft2(np.fft.rfft2(scene) * before, s=scene.shape)
        # The middle of a detector lies between two fine pixels along each axis.
        corners = [blurred[fine // 2 - 1 + i :: fine, fine // 2 - 1 + j :: fine] for i in (0, 1) for j in (0, 1)]
        samples = sum(corners) / 4.0
        seen[:] = [samples]
        held = np.kron(samples + rng.normal(size=samples.shape), np.ones((per_px, per_px)))
        np.fft.irfft2(np.fft.rfft2(held) * after, s=held.shape)

    elapsed = best_s(frame, 50)
    exact = TriangleSampler(resolve(sensor), size, field).samples(0.2, -0.3, orientation=Orientation.UP)[0]
    return elapsed, float(np.abs(seen[0] - exact).max())


def exact_frame_s(sensor: Sensor, field: int, size: float) -> float:
    """Time of a frame by exact samples, of a batch of 32."""
    sampler = TriangleSampler(resolve(sensor), size, field)
    matrix = axis_matrix(
        field, pixels_per_detector=sensor.display.pixels_per_detector, blur_px=resolve(sensor).blurs_px
    )
    rng = np.random.default_rng(0)

    def batch() -> None:
        samples = sampler.samples(*rng.uniform(-0.5, 0.5, (2, 32)), orientation=Orientation.UP)
        for sample in samples:
            display_signal(sample + rng.normal(size=sample.shape), matrix)

    return best_s(batch, 20) / 32


def rows() -> list[Row]:
    """All ratios of this file; `todframes accuracy` compares curves with the literal Monte Carlo."""
    sensor = load_sensor(SENSOR)
    curves = process("-c", CURVES)
    imports = min(process("-c", "import numpy, scipy.optimize").wall_s for _ in range(5))
    ours = exact_frame_s(sensor, 16, 4.0)
    theirs, error = oversampled_frame_s(sensor, 16, 4.0)
    of_curve = f"curve, 5 sizes × 2 noise levels ({curves.cpu_s:.1f} s CPU), whole process ÷ its imports"
    of_frames = f"frames a second, 16 × 16 × 6 px ({1 / ours:.0f}), times the 8× oversampled FFT chain"
    return [
        Row(of_curve, curves.wall_s / imports, "<= 8"),
        Row(of_frames, theirs / ours, ">= 10"),
        Row("largest error of that chain's samples (ours: rounding)", error, "> ours"),
    ]
