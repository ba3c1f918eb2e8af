"""The camera that the settings of a sensor describe: all angles in mrad, and electrons or signal-to-noise ratios.

A `Sensor` holds what was written, in the units in which it was written. `resolve` makes a `Camera` of it, on which
all computations rest: two sensors with equal cameras have equal thresholds. The electrons that light frees follow
EMVA Standard 1288, release 4.0 linear, section 2.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field, replace

import numpy as np

from sensor_sim.chain.measured import MeasuredMtf, MeasuredPsf
from sensor_sim.chain.noise import NO_LINES, LineShares, delta_t_mk, excess_kurtosis, line_shares
from sensor_sim.chain.sensor import BESIDE_DIFFRACTION, Motion, PhotonNoise, Sensor
from todframes.base.errors import SettingsError

LUMENS_PER_WATT = 683.002
"""Lumens of a watt of light of 540 THz, by the definition of the candela (SI brochure, 9th edition)."""

PHOTON_ENERGY_J_UM = 1.98644586e-19
"""Energy of a photon times its wavelength, h·c, in J·µm."""

PHOTOPIC_FIRST_UM, PHOTOPIC_STEP_UM = 0.38, 0.01
PHOTOPIC = (
    0.000039, 0.00012, 0.000396, 0.00121, 0.004, 0.0116, 0.023, 0.038, 0.06, 0.09098, 0.13902, 0.20802, 0.323,
    0.503, 0.71, 0.862, 0.954, 0.99495, 0.995, 0.952, 0.87, 0.757, 0.631, 0.503, 0.381, 0.265, 0.175, 0.107, 0.061,
    0.032, 0.017, 0.00821, 0.004102, 0.002091, 0.001047, 0.00052, 0.000249, 0.00012, 0.00006, 0.00003, 0.000015,
)  # fmt: skip
"""Luminous efficiency V(λ) every 10 nm from 380 to 780 nm: CIE 1924, as in ISO/CIE 23539:2023, table 1."""

MOST_ELECTRONS = 1e12
"""Largest number of electrons of the background and the dark current; beyond it a unit must be wrong."""


def photopic_efficiency(wavelength_um: float) -> float:
    """Return the luminous efficiency V(λ) of the eye in daylight, interpolated in its logarithm; SettingsError if
    the eye does not see the wavelength.
    """
    last_um = PHOTOPIC_FIRST_UM + PHOTOPIC_STEP_UM * (len(PHOTOPIC) - 1)
    if not PHOTOPIC_FIRST_UM <= wavelength_um <= last_um + 1e-9:
        raise SettingsError(
            f"optics.wavelength_um: found {wavelength_um:g}, which has no luminance; expected 0.38 to 0.78, or "
            "scene.photons_per_lux_s_um2"
        )
    step = (wavelength_um - PHOTOPIC_FIRST_UM) / PHOTOPIC_STEP_UM
    return float(np.exp(np.interp(step, np.arange(len(PHOTOPIC)), np.log(PHOTOPIC))))


def background_electrons(sensor: Sensor) -> float:
    """Return the mean electrons that the background's light frees in a pixel in one exposure. SettingsError if the
    light has no luminance at the wavelength, the electrons are too many, or the full well lies below the scene.
    """
    photons, scene = sensor.photons, sensor.scene
    assert photons is not None and scene is not None  # every sensor with photons has one
    electrons = scene.background_electrons
    if electrons is None:
        electrons = _electrons_of_light(sensor)
    if not electrons + photons.dark_electrons <= MOST_ELECTRONS:
        raise SettingsError(
            f"scene: the background gives {electrons:.4g} electrons in a pixel, and the dark current "
            f"{photons.dark_electrons:.4g}, expected at most {MOST_ELECTRONS:g} together; are light, exposure_ms "
            "and pitch in their units?"
        )
    if electrons + photons.dark_electrons >= photons.saturation_electrons:
        light = "" if scene.background_electrons else f" of {scene.background_cd_m2:.4g} cd/m²"
        raise SettingsError(
            f"noise.full_well_electrons: a pixel saturates at {photons.saturation_electrons:.4g} electrons, and "
            f"the background{light} gives {electrons:.4g} with "
            f"{photons.dark_electrons:.4g} of the dark current; expected fewer: a shorter exposure, a larger "
            "f-number or less light"
        )
    return electrons


def _electrons_of_light(sensor: Sensor) -> float:
    """Return the electrons of the background by lens, light and quantum efficiency. The illuminance of its image
    is π·τ·L / (4 N²), for a distant scene behind a good lens; EMVA 1288 has 4 N² + 1 in its place. A lux is that
    of the scene's photons, or of monochromatic light.
    """
    photons, optics, scene, aperture_mm = sensor.photons, sensor.optics, sensor.scene, sensor.aperture_mm
    assert photons and scene and aperture_mm and photons.quantum_efficiency and optics.focal_length_mm
    photons_per_lux_s_um2 = scene.photons_per_lux_s_um2
    if photons_per_lux_s_um2 is None:
        assert optics.wavelength_um is not None  # as all of these, checked by `Sensor`
        watt_per_um2 = 1e-12 / (LUMENS_PER_WATT * photopic_efficiency(optics.wavelength_um))
        photons_per_lux_s_um2 = watt_per_um2 * optics.wavelength_um / PHOTON_ENERGY_J_UM
    image_lx = math.pi * optics.transmission * scene.background_cd_m2 * (aperture_mm / optics.focal_length_mm) ** 2
    pitch_um = sensor.pitch_mrad * optics.focal_length_mm
    of_light = photons_per_lux_s_um2 * image_lx / 4.0 * pitch_um**2
    return float(photons.quantum_efficiency * of_light * photons.exposure_ms / 1000.0)


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
