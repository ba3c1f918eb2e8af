"""The parameters that the page shows, made from the settings of a sensor: labels, units, and ranges of sliders.

Each key of a SENSOR.toml has a field; the page shows those of the keys that its sensor has. A new setting needs no
line here: its label and unit follow from its name, its slider from its unit and from the values that it takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import NoneType
from typing import Any, Literal, NamedTuple, get_args

import msgspec

from sensor_sim.chain.measured import MeasuredMtf, MeasuredPsf
from sensor_sim.chain.sensor import EXPLAINED, NOISE_MODELS, TABLES
from todframes.base.reading import kinds_of, settings_of
from todframes.display.display import LARGEST

Kind = Literal["number", "integer", "choice", "switch", "file", "sizes"]


class PageField(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=False):
    """One field of the page. `key` is table and name in SENSOR.toml, or "observer." and the name of a setting of
    the observer. The name of a "file" can be read, but not changed. `min` and `max` are the ends of the slider,
    which hold the values of real sensors, None where there is no slider; the field takes whatever SENSOR.toml
    does. On a logarithmic slider, `step` is one of the common logarithm. `optional`: SENSOR.toml may do without a
    value. A sensor shows the field if it has one of the keys of `shown_with`, or else its own key, and not that of
    `hidden_with`. `names` are other names that errors give it.
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
    shown_with: tuple[str, ...] = ()
    hidden_with: str = ""
    names: tuple[str, ...] = ()


class SliderUnit(NamedTuple):
    """A unit: its name on the page, and the ends of sliders. `above_0` are those of values that are above 0, on a
    logarithmic slider; `most` and `step` those of values that may be 0.
    """

    name: str
    above_0: tuple[float, float] | None = None
    most: float | None = None
    step: float | None = None


UNITS = {
    "photons_per_lux_s_um2": SliderUnit("/(lx·s·µm²)", (100.0, 1e5)),
    "dn_per_electron": SliderUnit("DN/e⁻", (1e-3, 10.0)),
    "electrons_per_s": SliderUnit("e⁻/s", None, 1000.0, 1.0),
    "electrons": SliderUnit("e⁻", (1e3, 1e6), 50.0, 0.1),
    "ratio": SliderUnit("", None, 2.0, 0.01),
    "percent": SliderUnit("%", None, 5.0, 0.01),
    "cd_m2": SliderUnit("cd/m²", (0.01, 1e5)),
    "waves": SliderUnit("waves", None, 2.0, 0.01),
    "mrad": SliderUnit("mrad", (0.005, 5.0), 0.5, 0.001),
    "deg": SliderUnit("deg", (0.1, 10.0), 10.0, 0.01),
    "mm": SliderUnit("mm", (2.0, 500.0)),
    "km": SliderUnit("km", (0.05, 50.0)),
    "m23": SliderUnit("m^(−2/3)"),
    "um": SliderUnit("µm", (1.0, 50.0)),
    "mk": SliderUnit("mK", (1.0, 500.0)),
    "ms": SliderUnit("ms", (0.01, 1000.0)),
    "px": SliderUnit("display px", None, 10.0, 0.05),
    "lx": SliderUnit("lx", (0.1, 1e5)),
}
"""Units by the end of a name; the longest one that fits counts."""

LOG_STEP = 0.005
"""Step of logarithmic sliders: 1.2 %."""

LINEAR_STEP = 0.01

SLIDERS: dict[str, tuple[float, float]] = {
    "turbulence.cn2_m23": (1e-17, 1e-11),
    "optics.wavelength_um": (0.4, 14.0),
    "optics.f_number": (0.5, 32.0),
    "noise.frames_integrated": (1, 64),
    "noise.bits": (4, 16),
    "display.pixels_per_detector": (1, 16),
    "display.pixel_pitch_mm": (0.005, 1.0),
    "display.viewing_distance_mm": (20.0, 3000.0),
    "display.background_luminance_cd_m2": (1.0, 1000.0),
    "display.gain": (0.01, 10.0),
    "observer.internal_noise": (0.01, 5.0),
    "observer.efficiency": (0.01, 10.0),
    "observer.luminance_cd_m2": (0.02, 300.0),
}
"""Ends of sliders that do not follow from the unit."""

LABELS = {
    "turbulence.cn2_m23": "Cn²",
    "turbulence.short_exposure_alpha": "Short exposure α",
    "optics.f_number": "f-number",
    "optics.mtf": "Measured MTF",
    "optics.psf": "Measured PSF",
    "scene.photons_per_lux_s_um2": "Photons of a lux",
    "detector.width_mrad": "Active width",
    "detector.width_um": "Active width",
    "display.blur_sigma_px": "Spot",
    "display.background_luminance_cd_m2": "Background",
    "noise.couple_netd": "NETD ∝ f-number² / area",
}
"""Labels that do not follow from the name."""

CAPITALS = ("netd", "dsnu", "prnu", "psf", "mtf")

SHOWN_WITH = {"noise.couple_netd": ("noise.netd_mk",)}
"""Keys with which a sensor shows a field, though its file leaves the key out."""

PAGE_FIELDS = (
    PageField(
        key="sizes_detectors",
        names=("size_detectors", "size_mrad"),
        group="Test",
        label="Sizes",
        unit="detectors",
        kind="sizes",
        optional=True,
        help="Sizes √area of the triangles in detectors, separated by commas. Empty: chosen for the sensor.",
    ),
    PageField(
        key="p_correct",
        group="Test",
        label="Share correct",
        min=0.3,
        max=0.98,
        step=0.01,
        help="Proportion of correct answers at the threshold; guessing gives 0.25.",
    ),
    PageField(
        key="chip_pitch_um",
        hidden_with="optics.focal_length_mm",
        group="Detector",
        label="Pitch on the chip",
        unit="µm",
        scale="log",
        min=1.0,
        max=50.0,
        step=0.005,
        help="For the f-number alone; no threshold depends on it.",
    ),
    PageField(
        key="keep_fill_factor",
        shown_with=("detector.width_mrad", "detector.width_um"),
        group="Detector",
        label="Keep fill factor",
        kind="switch",
        help="Pitch and width move together.",
    ),
)
"""Fields of what the page asks for besides sensor and observer."""

NEEDED = {
    *(f"optics.{name}" for name in ("aperture_mm", "wavelength_um", "f_number", "focal_length_mm")),
    *("optics.psf_pitch_um", "optics.psf_pitch_mrad"),
    *("detector.pitch_mrad", "detector.width_mrad", "detector.pitch_um"),
    *("scene.luminance_cd_m2", "scene.illuminance_lx", "scene.reflectance"),
}
"""Keys that a SENSOR.toml may do without, but not one that has them: it would lack what they give."""

OBSERVER_FIELDS = {
    "internal_noise": "Full width of the noise on each neuron; 0.5 in the paper.",
    "efficiency": "Squared ratio of this person's d′ to that of the average person of ModelFest.",
    "luminance_cd_m2": "Luminance of the background, to which the eye is adapted.",
}
"""Settings of observers that move on the page, those by which people differ and the light; others keep their
values."""


def sensor_fields() -> tuple[PageField, ...]:
    """Return a field for each key of a SENSOR.toml, in the order of its tables."""
    found: dict[str, PageField] = {}
    for table, kind in TABLES.items():
        for settings in (kind, *(NOISE_MODELS.values() if table == "noise" else ())):
            for field, hint in settings_of(settings):
                key = f"{table}.{field.name}"
                if key not in found:
                    found[key] = _field(key, hint, EXPLAINED.get(key, "") + ".")
    return tuple(found.values())


def observer_fields(settings_type: type) -> tuple[PageField, ...]:
    """Return a field for each setting of an observer that moves on the page."""
    return tuple(
        _field(f"observer.{field.name}", hint, OBSERVER_FIELDS[field.name])
        for field, hint in settings_of(settings_type)
        if field.name in OBSERVER_FIELDS
    )


def _field(key: str, hint: Any, text: str) -> PageField:
    """Return the field of a setting with this annotation."""
    table, _, name = key.partition(".")
    limits = list(_limits(hint))
    kinds = kinds_of(hint)
    ending = next((one for one in UNITS if name == one or name.endswith(f"_{one}")), "")
    unit = UNITS.get(ending, SliderUnit(""))
    words = name.removesuffix(ending).strip("_").removesuffix("_sigma") or name
    label = " ".join(one.upper() if one in CAPITALS else one for one in words.split("_"))
    common: dict[str, Any] = {
        "key": key,
        "group": table.capitalize(),
        "label": LABELS.get(key) or label[:1].upper() + label[1:],
        "help": text,
        "optional": NoneType in kinds and key not in NEEDED,
        "shown_with": SHOWN_WITH.get(key, ()),
    }
    if MeasuredMtf in kinds or MeasuredPsf in kinds:
        return PageField(**common, kind="file")
    if bool in kinds:
        return PageField(**common, kind="switch")
    if int not in kinds and float not in kinds:
        return PageField(**common, kind="choice", choices=tuple(one for one in kinds if isinstance(one, str)))
    is_whole = float not in kinds
    least = max((one.ge for one in limits if one.ge is not None), default=-LARGEST)
    most = min((one.le for one in limits if one.le is not None), default=LARGEST)
    slider = _slider(key, unit, float(least), float(most), is_whole=is_whole)
    return PageField(**common, unit=unit.name, kind="integer" if is_whole else "number", **slider)


def _limits(hint: Any) -> Iterator[msgspec.Meta]:
    """Yield the limits in an annotation and in those within it."""
    yield from (part for part in getattr(hint, "__metadata__", ()) if isinstance(part, msgspec.Meta))
    for part in get_args(hint):
        yield from _limits(part)


def _slider(key: str, unit: SliderUnit, least: float, most: float, *, is_whole: bool) -> dict[str, Any]:
    """Return ends, step and scale of a slider for values in a range; nothing if no ends are known."""
    is_above_0 = least > 0.0
    if key in SLIDERS:
        low, high = SLIDERS[key]
        is_log = low > 0.0 and not is_whole
    elif is_above_0 and unit.above_0 is not None:
        (low, high), is_log = unit.above_0, True
    elif not is_above_0 and unit.most is not None:
        low, high, is_log = 0.0, min(unit.most, most), False
    elif math.isfinite(most) and most <= 100.0 and least > -LARGEST:
        low, high, is_log = max(least, LINEAR_STEP) if is_above_0 else least, most, False
    else:
        return {}
    step = LOG_STEP if is_log else 1.0 if is_whole else unit.step or LINEAR_STEP
    return {"min": low, "max": high, "step": step, "scale": "log" if is_log else "linear"}
