"""Compute what the page shows: a curve in numbers, words and tables, its range in the field, and plots."""

from __future__ import annotations

import base64
import math
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.noise import delta_t_mk
from sensor_sim.chain.sensor import Sensor, sensor_settings
from sensor_sim.explorer.live import LiveCurve
from sensor_sim.sweeps.goals import Aim
from sensor_sim.thresholds.curve_plan import Level
from sensor_sim.thresholds.predict import PredictedThreshold
from todframes.base.errors import SettingsError, argument
from todframes.field.acquisition_range import FieldRange, acquisition_range, range_words
from todframes.psychometrics.curves import FitPoint
from todframes.psychometrics.threshold_search import ComputedThreshold, Status
from todframes.results.data import Fit
from todframes.results.figures import COLOURS, INK, MARKERS, ReportFigure, add_legend, label_text, plain_ticks
from todframes.results.thresholds import Thresholds

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
            one | {"points": point.threshold.points} for one, point in zip(thresholds, curve.points, strict=True)
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


Value = Annotated[float, Meta(gt=0.0, le=1e12)]


class ThresholdSent(msgspec.Struct):
    """A threshold of the curve that the page shows: SNR, or contrast of a camera that counts photons. `points` are
    pairs of level and proportion correct.
    """

    size_detectors: Value
    status: Status
    threshold: Value | None = None
    error: Annotated[float, Meta(ge=0.0)] | None = None
    points: Annotated[list[tuple[Value, float]], Meta(max_length=32)] = []


SentThresholds = Annotated[list[ThresholdSent], Meta(min_length=1, max_length=12)]


def check_aim(target_in_air: Aim, sensor: Sensor, p_correct: float) -> None:
    """Raise SettingsError if thresholds are not in the quantity of the target, the air is of another kind, or k is
    missing.
    """
    if sensor.photons is None and sensor.noise.netd_mk is None:
        raise SettingsError(f"{argument.target}: needs noise.netd_mk of the sensor")
    target_in_air.check(
        p_correct, quantity="delta_t_k" if sensor.photons is None else "contrast", name=sensor.name
    )


def range_from(
    target_in_air: Aim, sensor: Sensor, thresholds: list[ThresholdSent], p_correct: float
) -> FieldRange:
    """Return the range of a sensor from its thresholds. SettingsError if target and air are not of the curve's
    kind; DataError if there are fewer than two thresholds, or the target is too small for the sensor.
    """
    curve = Thresholds.made(
        "curve",
        time.perf_counter(),
        settings={"sensor": sensor_settings(sensor)},
        fits=tuple(_fit(sensor, one, p_correct) for one in thresholds),
    )
    return acquisition_range(curve, target=target_in_air.target, atmosphere=target_in_air.atmosphere)


def _fit(sensor: Sensor, sent: ThresholdSent, p_correct: float) -> Fit:
    """Return a threshold as the result of a curve has it."""
    in_mk = None
    if sent.threshold is not None and sensor.photons is None and sensor.noise.netd_mk is not None:
        in_mk = float(delta_t_mk(sent.threshold, noise=sensor.noise))
    return Fit.of_computed(
        {"size_detectors": sent.size_detectors},
        sensor.level,
        p_correct,
        ComputedThreshold(sent.status, sent.threshold, sent.error),
        points=tuple(FitPoint(level, 0, p) for level, p in sent.points),
        delta_t_mk=in_mk,
    )


def range_answer(found: FieldRange) -> dict[str, Any]:
    """Return what the page shows of a range: curves, ranges in words, and what they rest on."""
    return {
        "title": found.name,
        "axis": found.probability_name,
        "criterion": "k" if found.is_tod else "N50",
        "probabilities": list(dict.fromkeys(one.probability for one in found.numbers.ranges)),
        "curves": [
            {name: getattr(one, name) for name in ("task", "range_km", "probability", "low", "high")}
            | {"is_bound": [bound != 0.0 for bound in one.bound]}
            for one in found.numbers.probability
        ],
        "ranges": [
            {
                "task": one.task,
                "criterion": one.criterion,
                "probability": one.probability,
                "words": range_words(one, size_m=found.numbers.target.size_m, is_tod=found.is_tod),
            }
            for one in found.numbers.ranges
        ],
        "sentences": found.sentences(),
        "warnings": [one.message for one in found.warnings],
    }


Text = Annotated[str, Meta(max_length=400)]
Numbers = Annotated[list[float], Meta(max_length=64)]
Format = Literal["svg", "png"]

PAGE_COLOURS = tuple(COLOURS[place] for place in (0, 4, 1, 5, 6, 2, 3))
"""Colours of the present curve, and of the pinned ones by their numbers as in `explorer.css`."""

_TURN = threading.Lock()
"""Figures are drawn one at a time: Matplotlib's settings belong to the whole process."""


class Drawn(msgspec.Struct):
    """A curve of a plot: its number on the page, where it is, its values, and half-widths of 95 % intervals."""

    number: Annotated[int, Meta(ge=0, lt=len(PAGE_COLOURS))]
    label: Text
    x: Numbers
    y: Annotated[list[Annotated[float, Meta(gt=0.0)]], Meta(max_length=64)]
    error: Numbers


class PlotAsked(msgspec.Struct):
    """A request for the plot of threshold curves as a file. `never_reached` are the abscissae at which the present
    one has no threshold.
    """

    format: Format
    title: Text
    x_label: Text
    y_label: Text
    curves: Annotated[list[Drawn], Meta(min_length=1, max_length=8)]
    never_reached: Numbers = []


def curve_plot(asked: PlotAsked) -> dict[str, str]:
    """Return the file of a plot of curves; see `file_of`."""
    note = "Bands: 95 % intervals of the computation." + " Crosses: never reached." * bool(asked.never_reached)
    return file_of(
        ReportFigure(asked.title, note, partial(draw_curves, asked=asked), "tod_curve.png"), asked.format
    )


def file_of(picture: ReportFigure, form: Format) -> dict[str, str]:
    """Return the name of a picture's file, and its content in base64."""
    with _TURN:
        content = picture.svg() if form == "svg" else picture.png()
    name = picture.file.removesuffix("png") + form
    return {"file": name, "base64": base64.b64encode(content).decode()}


def draw_curves(axes: Axes, *, asked: PlotAsked) -> None:
    """Draw curves with their bands, and crosses on the axis where the present one is never reached."""
    for curve in asked.curves:
        colour, marker = PAGE_COLOURS[curve.number], MARKERS[curve.number]
        x, y, error = np.array(curve.x), np.array(curve.y), np.array(curve.error)
        order = np.argsort(x)
        line, width = ("--", 1.4) if curve.number else ("-", 2.2)
        label = label_text(curve.label)
        axes.plot(x[order], y[order], color=colour, marker=marker, label=label, ls=line, lw=width)
        low, high = np.maximum(y - error, y / 10.0), y + error
        axes.fill_between(x[order], low[order], high[order], color=colour, alpha=0.2, lw=0.0)
    crosses = np.array(asked.never_reached)
    axes.plot(crosses, np.zeros(len(crosses)), "x", color=INK, transform=axes.get_xaxis_transform(), clip_on=False)
    axes.set(xlabel=label_text(asked.x_label), ylabel=label_text(asked.y_label), yscale="log")
    axes.set_xlim(left=0.0)
    plain_ticks(axes.yaxis, [value for curve in asked.curves for value in curve.y])
    add_legend(axes)
