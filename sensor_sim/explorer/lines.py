"""A curve as the page shows it: numbers in all units, and the same in words and tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.sensor import Sensor
from sensor_sim.explorer.live import LiveCurve
from sensor_sim.thresholds.curve_plan import Level
from sensor_sim.thresholds.predict import PredictedThreshold

ERRORS = {"snr": "snr_error", "delta_t_mk": "delta_t_error_mk", "contrast": "contrast_error"}
"""Quantities of a threshold, and the keys of half-widths of their 95 % intervals."""

HEADERS = {"snr": "SNR", "delta_t_mk": "ΔT (mK)", "contrast": "Contrast"}

SIZE_HEADERS = {
    "size_detectors": "Size (detectors)",
    "size_mrad": "Size (mrad)",
    "size_mrad_eye": "At the eye (mrad)",
}

MISSING = ("never_reached", "always_exceeded", "too_uncertain")
"""Statuses without a threshold; the page has their words in its place."""


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with up to so many significant digits, and without an exponent."""
    return np.format_float_positional(float(f"{value:.{digits}g}"), trim="-").replace("-", "−")


def with_error(value: float, error: float | None) -> str:
    """Return a value with as many decimals as the first digit of its error has."""
    if not error:
        return number_text(value)
    decimals = min(max(-math.floor(math.log10(error)), 0), 12)
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def percent_at_most(share: float) -> str:
    """Return a share as a percentage that is rounded up to one digit: 3 %, 0.2 %."""
    decade = 10.0 ** math.floor(math.log10(100.0 * share))
    return f"{number_text(math.ceil(100.0 * share / decade - 1e-9) * decade)} %"


def optics_words(sensor: Sensor, chip_pitch_um: float) -> str:
    """Return f-number, focal length and λF/d, as far as known, in words; of lengths on the chip also the angle."""
    optics, detector = sensor.optics, sensor.detector
    focal_mm = optics.focal_length_mm or chip_pitch_um / sensor.pitch_mrad
    f_number = optics.f_number or (sensor.aperture_mm and focal_mm / sensor.aperture_mm)
    parts = (
        ("pitch {} mrad", detector.pitch_um and sensor.pitch_mrad),
        ("f/{}", f_number),
        ("focal length {} mm", focal_mm),
        ("λF/d {}", f_number and (optics.wavelength_um or 0.0) * f_number / (sensor.pitch_mrad * focal_mm)),
    )
    return ", ".join(text.format(number_text(one, 3 if one >= 100.0 else 2)) for text, one in parts if one)


def quantities_of(sensor: Sensor) -> dict[str, dict[str, Any]]:
    """Return each quantity of a threshold: the title of its axis, whether the sensor has it, and a note on it."""
    counts_photons = sensor.photons is not None
    if counts_photons:
        reason = "The thresholds of a camera that counts photons are contrasts."
        missing = {"snr": reason, "delta_t_mk": reason}
    else:
        missing = {} if sensor.noise.netd_mk is not None else {"delta_t_mk": "Temperatures need the NETD."}
    of_contrast = "At the light of the scene" if counts_photons else "On the display, without detector noise"
    axes = {name: f"Threshold {header}" for name, header in HEADERS.items()}
    axes["contrast"] = "Threshold contrast" + ", no detector noise" * (not counts_photons)
    notes = {"contrast": of_contrast} | missing
    return {
        name: {"axis": axis, "is_offered": name not in missing, "title": notes.get(name, "")}
        for name, axis in axes.items()
    }


def curve_line(sensor: Sensor, level: Level, curve: LiveCurve) -> dict[str, Any]:
    """Return the part of an answer that is of a curve; `strengths` are the quantities in which it is known."""
    known, camera = quantities_of(sensor), resolve(sensor)
    in_level = ("contrast",) if level == "contrast" else ("snr", "delta_t_mk")
    strengths = [name for name in in_level if known[name]["is_offered"]]
    thresholds = [_threshold(camera, level, one.threshold) for one in curve.points]
    errors = [one[ERRORS[level]] / one[level] for one in thresholds if one[level] and one[ERRORS[level]]]
    time = f", in {curve.seconds:.1f} s" if curve.is_last and curve.seconds >= 0.1 else ""
    heard = (
        f"{number_text(one['size_detectors'])} detectors: "
        f"{_words(one['status']) if one[level] is None else number_text(one[level])}"
        for one in thresholds
    )
    shares, sentence = curve.limits
    return {
        "stage": "refined" if curve.is_last else "estimate",
        "is_last": curve.is_last,
        "line": f"{'Refined' if curve.is_last else 'Estimate'}: within "
        f"{percent_at_most(max(errors, default=0.0) or curve.tolerance)}{time}",
        "seconds": round(curve.seconds, 4),
        "quantities": known,
        "strengths": strengths,
        "thresholds": [
            one | {"slope": point.slope, "points": point.threshold.points}
            for one, point in zip(thresholds, curve.points, strict=True)
        ],
        "missing": {unit: _missing(thresholds, unit) for unit in ("detectors", "mrad")},
        "headers": [*SIZE_HEADERS.values(), *(HEADERS[name] for name in strengths)],
        "rows": [
            [number_text(one[size]) for size in SIZE_HEADERS]
            + [
                _words(one["status"]) if one[name] is None else with_error(one[name], one[ERRORS[name]])
                for name in strengths
            ]
            for one in thresholds
        ],
        "summary": f"{known[level]['axis']} at {'; '.join(heard)}.",
        "limits": shares._asdict() | {"sentence": sentence},
    }


def _words(status: str) -> str:
    return status.replace("_", " ")


def _missing(thresholds: list[dict[str, Any]], unit: str) -> str:
    """Return which sizes have no threshold, and why."""
    texts = []
    for status in MISSING:
        sizes = [number_text(one[f"size_{unit}"]) for one in thresholds if one["status"] == status]
        mark = "× " * (status == "never_reached")  # as on the axis
        texts += [f"{mark}{_words(status).capitalize()}: {', '.join(sizes)} {unit}"] if sizes else []
    return "; ".join(texts)


def _threshold(camera: Camera, level: Level, found: PredictedThreshold) -> dict[str, Any]:
    """Return a threshold in all units of its level; errors are half-widths of 95 % intervals."""
    threshold, error = found.threshold, found.numerical_error
    values: dict[str, float | None] = {}
    for name, factor in (("contrast", 1.0), ("snr", 1.0), ("delta_t_mk", camera.mk_per_snr or 0.0)):
        is_known = (name == "contrast") == (level == "contrast") and factor > 0.0
        for key, value in ((name, threshold), (ERRORS[name], error)):
            values[key] = value * factor if is_known and value is not None else None
    return {
        "size_detectors": found.size_detectors,
        "size_mrad": found.size_detectors * camera.pitch_mrad,
        "size_mrad_eye": found.size_detectors * camera.shown_pitch_mrad,
        "status": found.status,
        **values,
    }
