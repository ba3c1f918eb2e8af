"""Modulation transfer functions, as plain functions of frequency.

Before sampling, frequencies are in cycles/mrad in the scene. After it they may also be in cycles per display
pixel: each width is in the reciprocal unit of its frequency.

The optics are computed in two dimensions, from the radial frequency: a product of one-dimensional curves
would not be circularly symmetric (Hogervorst et al. 2001, section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.camera import AirBlur, Camera, CameraOptics, ModelledOptics
from sensor_sim.chain.measured import MeasuredPsf
from sensor_sim.chain.sensor import Motion
from todframes.base._typing import ComplexArray, FloatArray

FRIED = 3.44
"""6.88 / 2: the structure function of the phase at the distance r₀, halved."""

Transfer = Callable[[FloatArray, FloatArray], FloatArray | ComplexArray]
"""Transfer at frequencies along x and y in cycles/mrad, which broadcast against each other."""


def diffraction_mtf(frequency_cyc_per_mrad: ArrayLike, *, wavelength_um: float, aperture_mm: float) -> FloatArray:
    """Return the modulation transfer of a diffraction-limited circular aperture, exactly 0 at and beyond the
    cut-off. With x the radial frequency over the cut-off, aperture_mm / wavelength_um cycles/mrad, and u = 2
    arccos x, it is (u − sin u) / π. Hogervorst et al. 2001, eq. 1.
    """
    x = np.abs(np.asarray(frequency_cyc_per_mrad, dtype=np.float64)) / (aperture_mm / wavelength_um)
    # arccos x = 2 arcsin √((1 − x)/2), without arccos's loss of digits at 1.
    u = np.minimum(4.0 * np.arcsin(np.sqrt(np.maximum(1.0 - x, 0.0) / 2.0)), np.pi)
    return np.asarray((u - np.sin(u)) / np.pi)


def gaussian_mtf(frequency: ArrayLike, *, sigma: float) -> FloatArray:
    """Return the modulation transfer of a Gaussian blur of standard deviation `sigma`: exp(−2π²σ²f²). It describes
    optics, electronics or display spot; `sigma` is in the reciprocal unit of the (radial) frequency. Other tools
    give a width b with the transfer exp(−πb²f²): σ = b/√(2π). Hogervorst et al. 2001, eq. 2.
    """
    return np.asarray(np.exp(-2.0 * (np.pi * sigma * np.asarray(frequency, dtype=np.float64)) ** 2))


def box_mtf(frequency: ArrayLike, *, width: float) -> FloatArray:
    """Return the transfer along one axis of a mean over `width`: sin(πwf)/(πwf), signed. It describes the active
    width of a detector, and with the pitch for `width` sample & hold. In two dimensions the transfer is exactly
    the product of the axes. Hogervorst et al. 2001, sections 3.2 and 3.4.
    """
    return np.sinc(width * np.asarray(frequency, dtype=np.float64))


DEFOCUS_NODES, DEFOCUS_FREQUENCIES = 96, 2049
"""Nodes of each part of the integral over a defocused aperture, and frequencies at which it is tabulated."""


def obscured_mtf(relative_frequency: ArrayLike, *, obscuration_ratio: float) -> FloatArray:
    """Return the modulation transfer of an annular aperture at a frequency over the cut-off. It is the area that
    two annuli of outer radius 1 have in common at the distance 2x, over that of one: the areas that the outer
    discs, the inner discs, and an outer and an inner one have in common. O'Neill, J. Opt. Soc. Am. 46 (1956) 285.
    """
    x, ratio = np.abs(np.asarray(relative_frequency, dtype=np.float64)), obscuration_ratio

    def of_disc(of_cut_off: FloatArray) -> FloatArray:
        return diffraction_mtf(of_cut_off, wavelength_um=1.0, aperture_mm=1.0)

    distance = np.clip(2.0 * x, 1.0 - ratio, 1.0 + ratio)  # one disc in the other, and discs apart
    outer = np.arccos(np.clip((distance**2 + 1.0 - ratio**2) / (2.0 * distance), -1.0, 1.0))
    inner = np.arccos(np.clip((distance**2 + ratio**2 - 1.0) / (2.0 * distance * ratio), -1.0, 1.0))
    in_common = (outer + ratio**2 * inner - distance * np.sin(outer)) / np.pi
    transfer = of_disc(x) - 2.0 * in_common + ratio**2 * of_disc(x / ratio)
    return np.asarray(np.where(x < 1.0, transfer / (1.0 - ratio**2), 0.0))


@lru_cache(maxsize=64)
def _defocused(obscuration_ratio: float, defocus_waves: float) -> Any:
    """Return the transfer of a defocused, perhaps annular aperture as a cubic spline over [0, 1]. At the frequency
    s over the cut-off, the path difference across two apertures that are displaced by ±s is 4·W·s·x, so that the
    transfer is the mean of cos(8πWsx) over what they have in common. Between the places where its height has a
    root, sin(θ) for x takes the roots away.
    """
    from scipy.interpolate import CubicSpline

    ratio = obscuration_ratio
    angle, weight = np.polynomial.legendre.leggauss(DEFOCUS_NODES)
    angle, weight = angle * np.pi / 2.0, weight * np.pi / 2.0
    frequency = np.linspace(0.0, 1.0, DEFOCUS_FREQUENCIES)
    last = 1.0 - frequency
    ends = [
        np.zeros_like(last),
        *(np.clip(radius, 0.0, last) for radius in (np.abs(frequency - ratio), frequency + ratio)),
    ]
    total = np.zeros_like(last)
    for low, high in zip(ends, [*ends[1:], last], strict=True):
        half = ((high - low) / 2.0)[:, None]
        x = (low + high)[:, None] / 2.0 + half * np.sin(angle)
        outer = np.sqrt(np.maximum(1.0 - (x + frequency[:, None]) ** 2, 0.0))
        inner = np.sqrt(np.maximum(ratio**2 - (x - frequency[:, None]) ** 2, 0.0))
        height = np.maximum(outer - np.minimum(inner, outer), 0.0)
        wave = np.cos(8.0 * np.pi * defocus_waves * frequency[:, None] * x)
        total += 4.0 * ((height * wave) * half * np.cos(angle)) @ weight
    return CubicSpline(frequency, total / (np.pi * (1.0 - ratio**2)))


def aperture_mtf(radial_frequency_cyc_per_mrad: ArrayLike, *, optics: ModelledOptics) -> FloatArray:
    """Return the transfer of the aperture: diffraction, obscuration and defocus, which may make it negative."""
    if optics.defocus_waves == 0.0 and optics.obscuration_ratio == 0.0:
        cut_off = optics.cut_off_cyc_per_mrad
        return diffraction_mtf(radial_frequency_cyc_per_mrad, wavelength_um=1.0, aperture_mm=cut_off)
    relative = np.abs(np.asarray(radial_frequency_cyc_per_mrad, dtype=np.float64)) / optics.cut_off_cyc_per_mrad
    if optics.defocus_waves == 0.0:
        return obscured_mtf(relative, obscuration_ratio=optics.obscuration_ratio)
    curve = _defocused(optics.obscuration_ratio, optics.defocus_waves)
    return np.asarray(np.where(relative < 1.0, curve(np.minimum(relative, 1.0)), 0.0))


def turbulence_mtf(frequency_cyc_per_mrad: ArrayLike, *, air: AirBlur) -> FloatArray:
    """Return the modulation transfer of turbulence: exp(−3.44 (λf/r₀)^(5/3) (1 − α (λf/D)^(1/3))), with f the
    radial frequency. α is 0 for a long exposure; a short one, whose tilt counts as no blur, has 0.5 for an
    aperture D far below √(λ · path), and 1 far above. Beyond the aperture's cut-off, α counts as at it. Fried, J.
    Opt. Soc. Am. 56 (1966) 1372; eq. 3-3 of IBSM, as pyBSM has it.
    """
    f = np.abs(np.asarray(frequency_cyc_per_mrad, dtype=np.float64))
    tilt = air.short_exposure_alpha * np.cbrt(np.minimum(f / air.aperture_cyc_per_mrad, 1.0))
    return np.asarray(np.exp(-FRIED * (f / air.coherence_cyc_per_mrad) ** (5.0 / 3.0) * (1.0 - tilt)))


def transfers_before_sampling(camera: Camera) -> dict[str, Transfer]:
    """Return every transfer between the scene and the samples by the name of its stage, in their order. A new one
    needs a setting in `sensor_sim.chain.sensor` and a line here, or in `optics_transfers`.
    """
    motion, width, stages = camera.motion, camera.width_mrad, dict[str, Transfer]()
    if (air := camera.air) is not None:
        stages["turbulence"] = lambda fx, fy: turbulence_mtf(np.hypot(fx, fy), air=air)
    stages |= optics_transfers(camera.optics)
    if motion is not None:
        stages["motion"] = lambda fx, fy: motion_mtf(fx, fy, motion=motion)
    if width > 0.0:
        stages["detector"] = lambda fx, fy: box_mtf(fx, width=width) * box_mtf(fy, width=width)
    return stages


def optics_transfers(optics: CameraOptics) -> dict[str, Transfer]:
    """Return the transfers of the optics by the names of their stages."""
    if not isinstance(optics, ModelledOptics):
        return {"measured_optics": optics.at}
    return {
        "diffraction": lambda fx, fy: aperture_mtf(np.hypot(fx, fy), optics=optics),
        "optics_blur": lambda fx, fy: gaussian_mtf(np.hypot(fx, fy), sigma=optics.blur_sigma_mrad),
    }


def pre_sample_mtf(
    frequency_x_cyc_per_mrad: ArrayLike, frequency_y_cyc_per_mrad: ArrayLike, *, camera: Camera
) -> FloatArray | ComplexArray:
    """Return the product of all transfers before sampling at frequencies that broadcast against each other, in the
    broadcast shape. It is complex for a measured PSF. Hogervorst et al. 2001, section 3.6.
    """
    return _product(transfers_before_sampling(camera), frequency_x_cyc_per_mrad, frequency_y_cyc_per_mrad)


def optics_otf(
    frequency_x_cyc_per_mrad: ArrayLike, frequency_y_cyc_per_mrad: ArrayLike, *, optics: CameraOptics
) -> FloatArray | ComplexArray:
    """Return the transfer of the optics alone, modelled or measured, as `pre_sample_mtf` does."""
    return _product(optics_transfers(optics), frequency_x_cyc_per_mrad, frequency_y_cyc_per_mrad)


def _product(transfers: dict[str, Transfer], x: ArrayLike, y: ArrayLike) -> FloatArray | ComplexArray:
    fx, fy = np.asarray(x, float), np.asarray(y, float)
    first, *others = (transfer(fx, fy) for transfer in transfers.values())
    return math.prod(others, start=first)


def looks_the_same_when_turned(camera: Camera) -> bool:
    """Return whether the transfer before sampling is the same in all directions."""
    optics, motion = camera.optics, camera.motion
    is_smeared = motion is not None and motion.smear_mrad > 0.0
    return not isinstance(optics, MeasuredPsf) and getattr(optics, "is_radial", True) and not is_smeared


def blur_mrad(camera: Camera) -> float:
    """Return the standard deviation of the blur on top of diffraction: how far light strays from its place. Of
    measured optics, those with a defocus, and turbulence (a long exposure) it is that of the Gaussian with the
    same frequency of half transfer.
    """
    motion = camera.motion or Motion()
    of_motion = motion.smear_mrad / math.sqrt(12.0), motion.jitter_sigma_mrad
    return math.hypot(optics_blur_mrad(camera.optics), *of_motion, air_blur_mrad(camera.air))


def air_blur_mrad(air: AirBlur | None) -> float:
    """Return the part of turbulence in `blur_mrad`."""
    if air is None:
        return 0.0
    return _sigma_of_half((math.log(2.0) / FRIED) ** 0.6 * air.coherence_cyc_per_mrad)


def optics_blur_mrad(optics: CameraOptics) -> float:
    """Return the part of the optics in `blur_mrad`."""
    if isinstance(optics, ModelledOptics) and optics.defocus_waves == 0.0:
        return optics.blur_sigma_mrad
    frequency, zero = np.linspace(0.0, band_limit_cyc_per_mrad(optics), BLUR_FREQUENCIES), np.zeros(1)
    along = (frequency, zero), (zero, frequency)
    transfer = np.minimum(*(np.abs(optics_otf(fx, fy, optics=optics)).ravel() for fx, fy in along))
    return _sigma_of_half(float(frequency[int(np.argmax(transfer < 0.5))]))


def _sigma_of_half(frequency: float) -> float:
    """Return the standard deviation of the Gaussian with the transfer 0.5 at a frequency."""
    return math.sqrt(math.log(2.0) / 2.0) / (math.pi * frequency)


BLUR_FREQUENCIES = 512
"""Frequencies at which the blur of measured optics is looked for."""


def band_limit_cyc_per_mrad(optics: CameraOptics) -> float:
    """Return the end of the optics' transfer: the cut-off, or a Gaussian below 1e-17."""
    if not isinstance(optics, ModelledOptics) or optics.blur_sigma_mrad == 0.0:
        return optics.cut_off_cyc_per_mrad
    return min(optics.cut_off_cyc_per_mrad, 1.42 / optics.blur_sigma_mrad)


def sharpness_bound(camera: Camera) -> float:
    """Return a bound on the change that the optics make to the mean over a square of a scene within [0, 1]. Moving
    the scene by u changes it by at most (|u_x| + |u_y|)/width, and by at most 1. The mean of that over the
    Gaussian is 2√(2/π)·σ/width. Over the Airy pattern, whose energy beyond r is J₀² + J₁² at πcr, c the cut-off,
    it is at most √2/v · (1 + 2/π·ln(1 + v)) with v = πc·width. An even motion of length s adds s/(4 width),
    turbulence (4/π) Γ(2/5) 3.44^(3/5) λ/(2π r₀ width), from the mean |u_x| of a stable law of exponent 5/3. For
    measured optics, an obscuration or defocus there is no bound, nor for a stage that is not among these.
    """
    optics, width_mrad = camera.optics, camera.width_mrad
    if not isinstance(optics, ModelledOptics) or optics.obscuration_ratio > 0.0 or optics.defocus_waves > 0.0:
        return math.inf
    if not {"turbulence", "diffraction", "optics_blur", "motion", "detector"}.issuperset(
        transfers_before_sampling(camera)
    ):
        return math.inf
    motion, air = camera.motion or Motion(), camera.air
    v = np.pi * optics.cut_off_cyc_per_mrad * width_mrad
    of_blur = math.sqrt(8.0 / math.pi) * math.hypot(optics.blur_sigma_mrad, motion.jitter_sigma_mrad) / width_mrad
    of_blur += motion.smear_mrad / 4.0 / width_mrad
    if air is not None:
        scale_mrad = FRIED**0.6 / (2.0 * math.pi * air.coherence_cyc_per_mrad)
        of_blur += 4.0 / math.pi * math.gamma(0.4) * scale_mrad / width_mrad
    return of_blur + math.sqrt(2.0) / v * (1.0 + 2.0 / math.pi * math.log1p(v))


def motion_mtf(
    frequency_x_cyc_per_mrad: ArrayLike, frequency_y_cyc_per_mrad: ArrayLike, *, motion: Motion
) -> FloatArray:
    """Return the transfer of an even motion along x and of a random one, in the broadcast shape."""
    radial = np.hypot(frequency_x_cyc_per_mrad, frequency_y_cyc_per_mrad)
    smear = box_mtf(frequency_x_cyc_per_mrad, width=motion.smear_mrad)
    return np.asarray(smear * gaussian_mtf(radial, sigma=motion.jitter_sigma_mrad))


def stages(frequency_cyc_per_mrad: ArrayLike, *, camera: Camera) -> dict[str, FloatArray]:
    """Return every stage's transfer along x, in the order of the signal chain, and the two products. The stages
    are those of `transfers_before_sampling`, and "hold", "electronics", "display". "pre_sample" is the product of
    those before "hold" and "post_sample" that of the others; the paper's post-sampling MTF leaves "hold" out.
    Hogervorst et al. 2001, section 3.
    """
    frequency = np.asarray(frequency_cyc_per_mrad, dtype=np.float64)
    along_y, cyc_per_px = np.zeros_like(frequency), frequency * camera.pitch_mrad / camera.pixels_per_detector
    before = {name: transfer(frequency, along_y) for name, transfer in transfers_before_sampling(camera).items()}
    before["pre_sample"] = pre_sample_mtf(frequency, along_y, camera=camera)
    real = {name: np.abs(values) if np.iscomplexobj(values) else values.real for name, values in before.items()}
    pre_sample = real.pop("pre_sample")
    after = {
        "hold": box_mtf(frequency, width=camera.pitch_mrad),
        "electronics": gaussian_mtf(cyc_per_px, sigma=camera.electronics_blur_px),
        "display": gaussian_mtf(cyc_per_px, sigma=camera.display_blur_px),
    }
    return {**real, **after, "pre_sample": pre_sample, "post_sample": np.asarray(math.prod(after.values()))}
