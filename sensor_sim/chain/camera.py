"""The camera that the settings of a sensor describe: all angles in mrad, and electrons or signal-to-noise ratios.

A `Sensor` holds what was written, in the units in which it was written. `resolve` makes a `Camera` of it, on which
all computations rest: two sensors with equal cameras have equal thresholds.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field, replace

from sensor_sim.chain.detector_noise import NO_LINES, LineShares, delta_t_mk, excess_kurtosis, line_shares
from sensor_sim.chain.light import background_electrons
from sensor_sim.chain.measured import MeasuredMtf, MeasuredPsf
from sensor_sim.chain.sensor import BESIDE_DIFFRACTION, Motion, PhotonNoise, Sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelledOptics:
    """Modelled optics: a circular aperture with an obscuration and a defocus, and a Gaussian blur on top."""

    aperture_mm: float
    wavelength_um: float
    blur_sigma_mrad: float = 0.0
    obscuration_ratio: float = 0.0
    defocus_waves: float = 0.0

    @property
    def cut_off_cyc_per_mrad(self) -> float:
        """Frequency at which the transfer ends: 1 mm / 1 µm is 1 cycle/mrad."""
        return self.aperture_mm / self.wavelength_um


CameraOptics = ModelledOptics | MeasuredMtf | MeasuredPsf


@dataclass(frozen=True, slots=True, kw_only=True)
class AirBlur:
    """Blur by turbulence: coherence length r₀ and aperture over the wavelength, in cycles/mrad, and Fried's α."""

    coherence_cyc_per_mrad: float
    aperture_cyc_per_mrad: float = math.inf
    short_exposure_alpha: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Everything that a sensor's thresholds depend on.

    `width_mrad` is the active width of a detector, 0 if the measured MTF of the optics includes it. `photons` and
    `background_electrons` are the noise and the light of a camera that counts photons; without them levels are
    signal-to-noise ratios, and `lines` are the shares of rows and columns in the noise. On the display a detector
    is `pixels_per_detector` pixels wide, `shown_pitch_mrad` at the eye. The excess kurtosis of the noise and the
    ΔT of a signal-to-noise ratio of 1, in mK, change no threshold.
    """

    optics: CameraOptics
    pitch_mrad: float
    width_mrad: float
    motion: Motion | None = None
    air: AirBlur | None = None
    photons: PhotonNoise | None = None
    background_electrons: float = 0.0
    lines: LineShares = NO_LINES
    electronics_blur_px: float = 0.0
    display_blur_px: float = 0.0
    pixels_per_detector: int
    shown_pitch_mrad: float
    gain: float = 1.0
    excess_kurtosis: float = field(default=0.0, compare=False)
    mk_per_snr: float | None = field(default=None, compare=False)

    @property
    def level(self) -> str:
        """Quantity that is the strength of a triangle: SNR, or the contrast for a camera that counts photons."""
        return "snr" if self.photons is None else "contrast"

    @property
    def samples_key(self) -> Hashable:
        """Everything that the samples of a scene depend on."""
        return self.optics, self.motion, self.air, self.pitch_mrad, self.width_mrad

    @property
    def weights_key(self) -> Hashable:
        """Everything that the weights of an observer on the detectors depend on."""
        return self.pixels_per_detector, self.shown_pitch_mrad, self.blurs_px

    @property
    def blurs_px(self) -> tuple[float, float]:
        """Standard deviations of the blurs of electronics and display, in display pixels."""
        return self.electronics_blur_px, self.display_blur_px

    @property
    def nyquist_cyc_per_mrad(self) -> float:
        """Half of the sampling frequency."""
        return 0.5 / self.pitch_mrad


def resolve(sensor: Sensor) -> Camera:
    """Return the camera that a sensor describes. SettingsError if its light has no luminance at the wavelength, or
    gives too many electrons.
    """
    written, noise, photons = sensor.optics, sensor.noise, sensor.photons
    optics: CameraOptics
    if written.mtf is not None:
        optics = replace(written.mtf, scale=sensor.frequency_scale)
    elif written.psf is not None:
        optics = replace(written.psf, scale=sensor.frequency_scale)
    else:
        assert sensor.aperture_mm is not None and written.wavelength_um is not None  # checked by `Optics`
        optics = ModelledOptics(
            aperture_mm=sensor.aperture_mm,
            wavelength_um=written.wavelength_um,
            **{name: getattr(written, name) for name in BESIDE_DIFFRACTION},
        )
    return Camera(
        optics=optics,
        pitch_mrad=sensor.pitch_mrad,
        width_mrad=0.0 if written.mtf_includes_detector else sensor.width_mrad,
        motion=None if sensor.motion == Motion() else sensor.motion,
        air=_air_blur(sensor),
        # The electrons hold what the quantum efficiency says.
        photons=None if photons is None else replace(photons, quantum_efficiency=None),
        background_electrons=0.0 if photons is None else background_electrons(sensor),
        lines=line_shares(noise) if photons is None else NO_LINES,
        electronics_blur_px=sensor.electronics.blur_sigma_px,
        display_blur_px=sensor.display.blur_sigma_px,
        pixels_per_detector=sensor.display.pixels_per_detector,
        shown_pitch_mrad=sensor.display.detector_pitch_mrad,
        gain=sensor.display.gain,
        excess_kurtosis=excess_kurtosis(noise),
        mk_per_snr=None if noise.netd_mk is None or photons else float(delta_t_mk(1.0, noise=noise)),
    )


def fried_length_mm(*, cn2_m23: float, path_km: float, wavelength_um: float) -> float:
    """Return the coherence length r₀ of a spherical wave from the scene, over a path with one Cn²: r₀ = (0.423 k²
    Cn² (3/8) L)^(−3/5), k = 2π/λ. Fried, J. Opt. Soc. Am. 56 (1966) 1372; spherical waves: Schmidt 2010, Numerical
    Simulation of Optical Wave Propagation, after Sasiela.
    """
    wave_number = 2e6 * math.pi / wavelength_um
    return float(1e3 * (0.423 * wave_number**2 * cn2_m23 * 0.375 * 1e3 * path_km) ** -0.6)


def _air_blur(sensor: Sensor) -> AirBlur | None:
    air, wavelength_um = sensor.turbulence, sensor.optics.wavelength_um
    if air is None or air.cn2_m23 == 0.0 or wavelength_um is None:
        return None
    length_mm = fried_length_mm(cn2_m23=air.cn2_m23, path_km=air.path_km, wavelength_um=wavelength_um)
    blur = AirBlur(coherence_cyc_per_mrad=length_mm / wavelength_um)
    if not air.short_exposure_alpha or sensor.aperture_mm is None:
        return blur
    aperture = sensor.aperture_mm / wavelength_um
    return replace(blur, aperture_cyc_per_mrad=aperture, short_exposure_alpha=air.short_exposure_alpha)


def resolve_without_light(sensor: Sensor) -> Camera:
    """Return the camera for computations without noise, such as its MTF: any light will do."""
    return resolve(replace(sensor, photons=None, scene=None))
