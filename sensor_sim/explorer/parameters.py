"""The parameters that the page shows: labels, units, and the ranges of their sliders."""

from __future__ import annotations

from typing import Literal

import msgspec

Kind = Literal["number", "integer", "choice"]


class PageField(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=False):
    """One field of the page.

    Attributes
    ----------
    key : str
        Table and name in SENSOR.toml, or "observer." and the name of a setting of the observer.
    group, label, help : str
    unit : str
        Empty for a pure number.
    kind : {"number", "integer", "choice"}
    min, max : float or None
        Ends of the slider, which hold the values of real sensors; the field takes whatever SENSOR.toml does.
    step : float or None
        Step of the slider; on a logarithmic one, of the common logarithm.
    scale : {"linear", "log"}
    choices : tuple of str
    optional : bool
        Whether SENSOR.toml may do without a value.
    """

    key: str
    group: str
    label: str
    help: str
    unit: str = ""
    kind: Kind = "number"
    min: float | None = None
    max: float | None = None
    step: float | None = None
    scale: Literal["linear", "log"] = "linear"
    choices: tuple[str, ...] = ()
    optional: bool = False


LOG_STEP = 0.005
"""Step of logarithmic sliders: 1.2 %."""


def _log(key: str, group: str, label: str, unit: str, low: float, high: float, help_text: str) -> PageField:
    return PageField(
        key=key, group=group, label=label, unit=unit, min=low, max=high, step=LOG_STEP, scale="log", help=help_text
    )


PARAMETERS = (
    _log("optics.aperture_mm", "Optics", "Aperture", "mm", 2.0, 500.0, "Diameter of the circular aperture."),
    _log("optics.wavelength_um", "Optics", "Wavelength", "µm", 0.4, 14.0, "Wavelength of the diffraction."),
    PageField(
        key="optics.blur_sigma_mrad",
        group="Optics",
        label="Blur",
        unit="mrad",
        min=0.0,
        max=0.5,
        step=0.001,
        help="Standard deviation of a Gaussian blur on top of the diffraction.",
    ),
    _log("detector.pitch_mrad", "Detector", "Pitch", "mrad", 0.005, 5.0, "From one detector to the next."),
    _log("detector.width_mrad", "Detector", "Active width", "mrad", 0.005, 5.0, "Pitch × √(fill factor)."),
    PageField(
        key="noise.distribution",
        group="Noise",
        label="Distribution",
        kind="choice",
        choices=("uniform", "gaussian"),
        help="Distribution of the noise of a sample; that of the paper is uniform.",
    ),
    msgspec.structs.replace(
        _log("noise.netd_mk", "Noise", "NETD", "mK", 1.0, 500.0, "Of one frame; without it there is no ΔT."),
        optional=True,
    ),
    PageField(
        key="noise.fixed_pattern_ratio",
        group="Noise",
        label="Fixed pattern",
        min=0.0,
        max=2.0,
        step=0.01,
        help="Static divided by dynamic standard deviation.",
    ),
    PageField(
        key="noise.frames_integrated",
        group="Noise",
        label="Frames integrated",
        kind="integer",
        min=1,
        max=64,
        step=1,
        help="Frames that the observer's eye averages.",
    ),
    PageField(
        key="electronics.blur_sigma_px",
        group="Electronics",
        label="Blur",
        unit="display px",
        min=0.0,
        max=10.0,
        step=0.05,
        help="Standard deviation of the electronics' Gaussian blur.",
    ),
    PageField(
        key="display.pixels_per_detector",
        group="Display",
        label="Pixels per detector",
        kind="integer",
        min=1,
        max=16,
        step=1,
        help="Display pixels along each side of a detector.",
    ),
    _log("display.pixel_pitch_mm", "Display", "Pixel pitch", "mm", 0.005, 1.0, "From one pixel to the next."),
    _log("display.viewing_distance_mm", "Display", "Viewing distance", "mm", 20.0, 3000.0, "Eye to display."),
    PageField(
        key="display.blur_sigma_px",
        group="Display",
        label="Spot",
        unit="display px",
        min=0.0,
        max=10.0,
        step=0.05,
        help="Standard deviation of the display's Gaussian spot.",
    ),
    _log(
        "display.background_luminance_cd_m2",
        "Display",
        "Background",
        "cd/m²",
        1.0,
        1000.0,
        "Luminance of no signal. Thresholds do not depend on it.",
    ),
    _log("display.gain", "Display", "Gain", "", 0.01, 10.0, "Display contrast of a large triangle."),
    _log(
        "observer.internal_noise",
        "Observer",
        "Internal noise",
        "",
        0.01,
        5.0,
        "Full width of the noise on each neuron; 0.5 in the paper.",
    ),
)
