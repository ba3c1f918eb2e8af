"""Conditions as they are given: opened, brought to common units, and checked that they can be compared."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.safe_text import in_utf8
from todframes.comparison.ratios import Measured
from todframes.comparison.viewing import Viewing
from todframes.enhancement.finding import enhancement_names
from todframes.frames.dataset import Dataset, load_dataset
from todframes.psychometrics.fit import FitSettings, PsychometricFit
from todframes.results.data import DatasetRecord, Fit, Record, group_of
from todframes.results.result import Result, load_result
from todframes.results.tables import Table
from todframes.results.thresholds import Thresholds
from todframes.results.wording import level_heading, listed, size_column, unit_of, value_text
from todframes.scoring.paired import TrialSeries
from todframes.stimulus import ORIENTATIONS, level_of

COMMANDS = ("score", "curve", "naked-eye", "fit", "calibrate")
"""Commands whose results are conditions."""

NOT_OF_OBSERVER = {
    *(field.name for field in fields(FitSettings)),
    *("decisions", "curve", "locate", "tolerance", "plan", "sensor", "white", "allow_clipping"),
    *("luminance_cd_m2", "external_noise_spectrum"),  # those of the display that is looked at
}
"""Settings of a result that conditions may have of their own."""

NAMELESS = "level"
"""Level of counts, whose quantity nobody has named."""

OF_PEOPLE = ("fit", "calibrate")
"""Commands whose thresholds are those of people, or of nobody that is known."""

Given = Path | str | Dataset | Result
"""Ways to give a condition."""


def opened_condition(given: Given, number: int, max_frame_mb: int) -> Dataset | Result:
    """Return the dataset or result that a condition is, read from its path unless it is one."""
    if isinstance(given, Path | str):
        path = Path(given)
        if not path.exists() and "://" not in str(given):  # a URL may hold a secret; a dataset refuses it
            is_algorithm = str(given) in enhancement_names() or ":" in str(given)
            hint = f"; an algorithm is given as {argument.enhance}" if is_algorithm else ""
            raise DataError(f"{given}: no such dataset or result{hint}")
        if path.suffix == ".toml":
            raise DataError(
                f"{given}: found a TOML file, expected the folder of a dataset or of a result; of a sensor, "
                "sensor-sim curve -o makes one"
            )
        is_result = path.is_file() or ((path / "result.json").is_file() and not (path / "dataset.toml").is_file())
        given = load_result(path) if is_result else load_dataset(path, max_frame_mb=max_frame_mb)
    if isinstance(given, Result) and (given.command not in COMMANDS):
        raise DataError(f"conditions[{number}]: found a result of {given.command}, expected {', '.join(COMMANDS)}")
    return given


def names_of(given: Sequence[Given], opened: Sequence[Dataset | Result]) -> list[str]:
    """Return a name for each condition: that of its folder or file, with as much before it as tells them apart."""
    paths = []
    for number, (one, condition) in enumerate(zip(given, opened, strict=True), 1):
        if not isinstance(one, Path | str):
            name = str(condition.path) if isinstance(condition, Dataset) else condition.name
            one = name or f"condition {number}"
        paths.append(one)
    return names_of_paths(paths)


def names_of_paths(paths: Sequence[Path | str], joint: str = "/") -> list[str]:
    """Return the last parts of paths, as many as tell them apart, with `joint` between; numbered if nothing does.
    A file has its suffix only if it is needed, and `result.json` the name of its folder.
    """
    full = [Path(os.path.abspath(path)) for path in paths]  # noqa: PTH100 - links keep their names
    full = [path.parent if path.name == "result.json" else path for path in full]
    for named in ([path.with_suffix("") if path.is_file() else path for path in full], full):
        for depth in range(1, max((len(path.parts) for path in named), default=0)):
            names = [in_utf8(joint.join(path.parts[1:][-depth:])) for path in named]
            if len(set(names)) == len(names):
                return names
    return [f"{path.name} ({number})" for number, path in enumerate(full, 1)]


def of_result(result: Result, name: str) -> Measured:
    """Return the condition that a result is."""
    assert isinstance(result, Thresholds)
    data = result
    known = {field.name: data.settings[field.name] for field in fields(FitSettings) if field.name in data.settings}
    settings = FitSettings(**known)
    if data.fits and not level_of(data.fits[0].level).is_signal:
        settings = replace(settings, slope_spread=None)
    of_observer = {} if result.command in OF_PEOPLE else data.settings
    trials = series_of(data) if result.command == "score" else None
    return Measured(
        name=name,
        source=name,
        fits=data.fits,
        settings=of_observer,
        trials=trials,
        fit_settings=settings,
        viewing=_viewing(data),
    )


def _viewing(data: Thresholds) -> Viewing:
    """Return how the frames of a result are shown; nothing is known of results of other kinds."""
    if data.command == "curve":
        return Viewing.of_sensor(data.settings["sensor"])
    n_trials = sum(fit.n_trials for fit in data.fits)
    if not isinstance(data.dataset, DatasetRecord) or not data.dataset.display or not n_trials:
        return Viewing()
    return viewing_of(data.dataset.display, data.fits, (data.dataset.n_frames or 0) / n_trials)


def viewing_of(display: Record, fits: Sequence[Fit], frames_per_trial: float) -> Viewing:
    """Return how the frames of a dataset are shown. Sizes in detectors are those of simulated frames."""
    is_film = size_column(fits) != "size_detectors"
    return Viewing.of_frames(display, fits[0].level, frames_per_trial, is_film=is_film)


def columns_of(table: Table | None) -> dict[str, list[Any]]:
    """Return the columns of a table of trials; empty without one."""
    if table is None:
        return {}
    return {column.key: [record[column.key] for record in table.records] for column in table.columns}


def series_of(data: Thresholds) -> TrialSeries | None:
    """Return the trials of a result; None if they were not saved, or do not name the scenes that they are on."""
    columns = columns_of(data.trials)
    if not columns or not data.fits:
        return None
    scenes = None
    if isinstance(data.dataset, DatasetRecord) and data.dataset.n_scenes is not None:
        if "scene" not in columns:
            return None
        scenes = np.unique(columns["scene"], return_inverse=True)[1]
    turns = [turn.value for turn in ORIENTATIONS]
    orientations = [turns.index(turn) for turn in columns["orientation"]]
    shown = np.column_stack([orientations, columns["polarity"], columns[data.fits[0].level]])
    groups = {name: np.array(columns[name]) for name in data.fits[0].group}
    rows = [
        np.flatnonzero(np.all([groups[name] == value for name, value in fit.group.items()], axis=0))
        if fit.group
        else np.arange(len(shown))
        for fit in data.fits
    ]
    names = [field.name for field in fields(PsychometricFit)]
    fits = [PsychometricFit(**{name: getattr(fit, name) for name in names}) for fit in data.fits]
    return TrialSeries(shown, np.array(columns["p_correct"]), rows, fits, scenes)


def check_before_scoring(given: Sequence[Dataset | Result], fit: FitSettings) -> None:
    """Raise DataError if conditions cannot be compared, as far as that is known before datasets are scored."""
    if len(given) < 2:
        return
    conditions = []
    for number, each in enumerate(given, 1):
        if isinstance(each, Result):
            name = in_utf8(str(each.name or f"condition {number}"))
            conditions.append(of_result(each, name))
        else:
            level, p_correct = each.experiment.level, fit.p_correct
            groups = [group_of(each, group) for group in each.trials.groups]
            fits = tuple(Fit(group=group, level=level, status="", p_correct=p_correct) for group in groups)
            conditions.append(Measured(name=str(number), source=str(each.path), fits=fits))
    comparable(conditions)


def split_by(condition: Measured, column: str) -> list[Measured]:
    """Return a condition for each value of a column of groups. SettingsError if there is no such column."""
    if any(column not in fit.group for fit in condition.fits) or not condition.fits:
        known = listed(condition.fits[0].group) if condition.fits and condition.fits[0].group else "none"
        raise SettingsError(
            f"{argument.by}: found {column!r}, expected one of the columns of {condition.source}: {known}"
        )
    values = list(dict.fromkeys(fit.group[column] for fit in condition.fits))
    conditions = []
    for value in values:
        numbers = [number for number, fit in enumerate(condition.fits) if fit.group[column] == value]
        chosen = _chosen(condition, numbers)
        name = f"{column} {value_text(value)}"
        conditions.append(replace(chosen, name=f"{condition.name}, {name}", source=f"{condition.source}, {name}"))
    return [_without_columns(each, [column]) for each in conditions]


def _chosen(condition: Measured, numbers: Sequence[int]) -> Measured:
    def of(trials: TrialSeries | None) -> TrialSeries | None:
        if trials is None:
            return None
        return trials._replace(rows=[trials.rows[k] for k in numbers], fits=[trials.fits[k] for k in numbers])

    return replace(
        condition,
        fits=tuple(condition.fits[k] for k in numbers),
        trials=of(condition.trials),
        plain=of(condition.plain),
        gains=[condition.gains[k] for k in numbers] if condition.gains else (),
    )


def _without_columns(condition: Measured, columns: Sequence[str]) -> Measured:
    def kept(fit: Fit) -> Fit:
        return structs.replace(fit, group={name: v for name, v in fit.group.items() if name not in columns})

    return replace(condition, fits=tuple(map(kept, condition.fits)))


def comparable(conditions: Sequence[Measured]) -> tuple[list[Measured], list[str]]:
    """Return conditions in common units and columns, and sentences about what that changed. DataError, which says
    why, if one cannot be compared with the first.
    """
    notes: list[str] = []
    for condition in conditions:
        if not condition.fits:
            raise DataError(f"{condition.source}: found no thresholds, expected one or more")
    conditions = _in_temperature(_with_units(conditions, notes), notes)
    conditions = _at_the_camera(conditions, notes)
    conditions = _without_own_columns(conditions, notes)
    reference, *others = conditions
    for condition in others:
        _check(condition, reference, notes)
    return conditions, notes


def _with_units(conditions: Sequence[Measured], notes: list[str]) -> list[Measured]:
    """Return conditions whose levels have no unit, as those of counts, with the level of the others."""
    levels = dict.fromkeys(fit.level for condition in conditions for fit in condition.fits)
    if len(levels) != 2 or NAMELESS not in levels:
        return list(conditions)
    (level,) = levels.keys() - {NAMELESS}
    named = [
        replace(condition, fits=tuple(structs.replace(fit, level=level) for fit in condition.fits))
        for condition in conditions
    ]
    without = [condition.name for condition in conditions if condition.fits[0].level == NAMELESS]
    notes.append(f"Levels of {listed(without)} have no unit; they are taken for {level_heading(level)}.")
    return named


def _in_temperature(conditions: Sequence[Measured], notes: list[str]) -> list[Measured]:
    """Return thresholds as temperatures where all are or can be: two SNR say nothing if the NETD differ. The unit
    is that of the first temperatures, whose trials then stay, or mK.
    """
    unit = next((fit.level for each in conditions for fit in each.fits if fit.level != "snr"), "delta_t_mk")
    of_unit = 1e3 * level_of(unit).factor

    def factors(fit: Fit) -> float | None:
        level = level_of(fit.level)
        if level.quantity == "delta_t_k":
            return 1e3 * level.factor / of_unit
        if fit.level != "snr" or fit.threshold is None:
            return 1.0 if fit.level == "snr" else None
        return None if fit.delta_t_mk is None else fit.delta_t_mk / fit.threshold / of_unit

    each = [[factors(fit) for fit in condition.fits] for condition in conditions]
    levels = {fit.level for condition in conditions for fit in condition.fits}
    if any(factor is None for factor in chain(*each)) or (len(levels) == 1 and levels != {"snr"}):
        return list(conditions)
    if "snr" in levels:
        notes.append("Thresholds are compared as temperature differences, SNR · NETD / k.")
    return [
        condition
        if {fit.level for fit in condition.fits} == {unit}
        else replace(
            condition,
            trials=None,
            fits=tuple(_scaled(fit, unit, factor or 1.0) for fit, factor in zip(condition.fits, own, strict=True)),
        )
        for condition, own in zip(conditions, each, strict=True)
    ]


def _scaled(fit: Fit, unit: str, factor: float) -> Fit:
    def times(value: float | None) -> float | None:
        return None if value is None else factor * value

    low, high = fit.threshold_ci95 or (None, None)
    return structs.replace(
        fit,
        level=unit,
        threshold=times(fit.threshold),
        threshold_ci95=None if fit.threshold_ci95 is None else (times(low), times(high)),
        threshold_numerical_error=times(fit.threshold_numerical_error),
        points=(),
        delta_t_mk=None,
    )


def _at_the_camera(conditions: Sequence[Measured], notes: list[str]) -> list[Measured]:
    """Return sizes in detectors as angles at the camera where detectors differ, or others have such angles."""
    sizes = [size_column(condition.fits) for condition in conditions]
    pitches = [_pitch_mrad(condition.settings.get("sensor")) for condition in conditions]
    in_detectors = [pitch for pitch, size in zip(pitches, sizes, strict=True) if size == "size_detectors"]
    if None in in_detectors or not in_detectors or len(set(zip(sizes, pitches, strict=True))) == 1:
        return list(conditions)
    if not set(sizes) <= {"size_detectors", "object_size_mrad"}:
        return list(conditions)
    notes.append("Sizes are compared as angles at the camera.")

    def turned(fit: Fit, pitch: float) -> Fit:
        known = {
            "size_detectors": ("object_size_mrad", float(f"{pitch * float(fit.group['size_detectors']):.6g}"))
        }
        group = dict(known.get(name, (name, value)) for name, value in fit.group.items())
        return structs.replace(fit, group=group)

    return [
        replace(condition, fits=tuple(turned(fit, pitch or 1.0) for fit in condition.fits))
        if size == "size_detectors"
        else condition
        for condition, size, pitch in zip(conditions, sizes, pitches, strict=True)
    ]


def _pitch_mrad(sensor: Any) -> float | None:
    """Return the pitch of the detectors of a result's sensor as an angle; None if it is not known."""
    try:
        detector = sensor["detector"]
        if "pitch_um" in detector:
            return float(detector["pitch_um"]) / float(sensor["optics"]["focal_length_mm"])
        return float(detector["pitch_mrad"])
    except (TypeError, KeyError, ValueError, ZeroDivisionError):
        return None


def pixel_of_sizes(condition: Measured) -> float | None:
    """Return the pitch of a condition's detectors or pixels in the unit of its sizes; None if it is not known."""
    viewing, size = condition.viewing, size_column(condition.fits)
    if size == "size_detectors":
        return 1.0
    if size == "object_size_mrad" and viewing.pixel_mrad is not None and viewing.magnification is not None:
        return viewing.pixel_mrad / viewing.magnification
    return viewing.pixel_mrad if size == "size_mrad" else _pitch_mrad(condition.settings.get("sensor"))


def _without_own_columns(conditions: Sequence[Measured], notes: list[str]) -> list[Measured]:
    """Return conditions without columns that have one value in each of them, but not the same in all."""
    names = dict.fromkeys(
        name for condition in conditions for name in condition.fits[0].group if not unit_of(name)
    )
    values = {
        name: [{fit.group.get(name) for fit in condition.fits} for condition in conditions] for name in names
    }
    own = [
        name
        for name, of_each in values.items()
        if all(len(distinct) == 1 for distinct in of_each) and any(distinct != of_each[0] for distinct in of_each)
    ]
    if own:
        notes.append(f"The column {listed(own)} has one value in each and does not count.")
    return [_without_columns(condition, own) for condition in conditions]


def _check(condition: Measured, reference: Measured, notes: list[str]) -> None:
    """Raise DataError unless a condition can be compared with the reference."""
    first, other = reference.fits[0], condition.fits[0]
    level, expected = (level_heading(fit.level) for fit in (other, first))
    if level != expected:
        _refuse(condition, reference, f"thresholds in {level}", expected)
    sizes = [", ".join(fit.group) or "no column of groups" for fit in (other, first)]
    if sizes[0] != sizes[1]:
        _refuse(condition, reference, sizes[0], sizes[1])
    if other.p_correct != first.p_correct:
        found, wanted = (f"{100.0 * fit.p_correct:g} % correct" for fit in (other, first))
        _refuse(condition, reference, f"thresholds at {found}", wanted)
    if condition.settings and reference.settings:
        for name in ("observer", *sorted({*condition.settings} & {*reference.settings} - {"observer"})):
            setting, other_setting = (side.settings.get(name) for side in (condition, reference))
            if name not in NOT_OF_OBSERVER and setting != other_setting:
                _refuse(condition, reference, f"{name} {setting}", f"{other_setting}")
    elif condition.settings or reference.settings:
        who = reference if condition.settings else condition
        notes.append(f"{who.name} does not say who answered: its ratio holds for the same observer.")
    curves = [{fit.curve for fit in side.fits if fit.curve} for side in (condition, reference)]
    if all(curves) and curves[0] != curves[1]:
        notes.append(
            f"Thresholds of {condition.name} are those of the {listed(sorted(curves[0]))} curve, those of "
            f"{reference.name} of the {listed(sorted(curves[1]))} curve, which differ by up to some per cent."
        )


def _refuse(condition: Measured, reference: Measured, found: str, expected: str) -> None:
    raise DataError(
        f"{condition.source} cannot be compared with {reference.source}: found {found}, expected {expected}"
    )
