"""The internal noise of people as tables, sentences, a figure and settings of an observer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields

import msgspec

from todframes.base.reading import toml_text
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import ComparedObserver, Fit, PersonResult, Record, ResultData, observer_names
from todframes.results.table import EXACT, Column, Table
from todframes.results.wording import (
    column_heading,
    count,
    interval_phrase,
    plain,
    threshold_heading,
)

SUBJECT = "subject"
"""Column of the groups of `fits` that names the person."""

TOGETHER = "all together"

NOISE_COLUMNS = (
    Column(key=SUBJECT, header="person", is_name=True),
    Column(key="internal_noise", header="internal noise", digits=3),
    Column(key="internal_noise_ci95", header="95 % interval", interval="internal_noise_ci95", digits=3),
    Column(key="efficiency", digits=3),
    Column(key="efficiency_ci95", header="its 95 % interval", interval="efficiency_ci95", digits=3),
    Column(key="lapse_rate", header="lapses δ", digits=2, rank=3),
    Column(key="lapse_rate_ci95", interval="lapse_rate_ci95", in_file_only=True),
    Column(key="template_blur_samples", header="template blur", digits=3, rank=3),
    Column(key="template_blur_samples_ci95", interval="template_blur_samples_ci95", in_file_only=True),
    Column(key="n_trials", header="trials", rank=1),
    Column(key="n_correct", header="correct", rank=4),
    Column(key="n_flagged", header="flagged", rank=3),
    Column(key="log_likelihood", in_file_only=True),
    Column(key="aic", header="AIC", digits=5, rank=3),
    Column(key="deviance", digits=3, rank=2),
    Column(key="n_cells", header="cells", rank=2),
    Column(key="deviance_p_value", header="p", digits=2),
    Column(key="status"),
)

UNDECIDED, STRONG = 2.0, 10.0
"""Differences of AIC below which the answers do not decide, and from which they are strong evidence."""

MOST_DESCRIBED = 6
"""Largest number of persons that are described one by one; if there are more, the table shows them."""

FLAGS = {
    "hidden": "while the page was hidden",
    "unfocused": "while the page had lost the focus",
    "too_fast": "faster than 150 ms",
}
"""Words for the flags of answers."""

NO_NOISE = {
    "noise_free": "without any noise the model would answer no worse; show weaker or smaller triangles",
    "at_chance": "the answers cannot be distinguished from guesses; show stronger or larger triangles",
    "too_few_trials": "the answers are too few",
}
"""Reasons for a missing noise, by status."""

NOT_OF_OBSERVER = {
    "observer",
    "free",
    "include_flagged",
    "efficiency",
    "internal_noise",
    "internal_noise_sd",
    *(f.name for f in fields(FitSettings)),
}
"""Settings of a calibration that do not go into the settings of an observer."""


def all_persons(result: ResultData | ComparedObserver) -> tuple[PersonResult, ...]:
    """Return the persons of a result, that of all persons together last."""
    return (*result.persons, *([] if result.pooled is None else [result.pooled]))


def all_tables(result: ResultData) -> list[Table]:
    """Make all tables of a calibration, in their order; those of thresholds are by the first observer."""
    compared = observers_table(result)
    return [*([] if compared is None else [compared]), noise_table(result), curves_table(result)]


def noise_table(result: ResultData) -> Table:
    """Make the table of internal noises, a row for each person and one for all together."""
    names = [one.key for one in NOISE_COLUMNS]
    records = [
        {name: getattr(one, name) for name in names} | {SUBJECT: one.subject or TOGETHER}
        for one in all_persons(result)
    ]
    for record in records:
        record["n_flagged"] = sum(record["n_flagged"].values()) or None
    for key in ("lapse_rate", "template_blur_samples"):
        if not any(record[f"{key}_ci95"] for record in records):  # it was not fitted
            for record in records:
                record[key] = None
    is_efficiency = any(record["efficiency_ci95"] is not None for record in records)
    kept = "efficiency" if is_efficiency else "internal_noise"
    other = "internal_noise_ci95" if is_efficiency else "efficiency_ci95"
    for record in records:
        record[other] = None
    title = "Efficiency" if is_efficiency else "Internal noise"
    return Table.of(title, "internal_noise.csv", NOISE_COLUMNS, records).without_empty_columns(
        kept, f"{kept}_ci95"
    )


def observers_table(result: ResultData) -> Table | None:
    """Make the table of observers, a row for each person and observer; None with a single observer."""
    if not result.observers:
        return None
    records: list[Record] = []
    for persons in zip(*by_observer(result).values(), strict=True):
        least = min(_aic(one) for one in persons)
        for name, one in zip(by_observer(result), persons, strict=True):
            records.append(
                {
                    SUBJECT: one.subject or TOGETHER,
                    "observer": name,
                    "internal_noise": one.internal_noise,
                    "efficiency": one.efficiency,
                    "aic": one.aic,
                    "aic_difference": _aic(one) - least,
                    "deviance": one.deviance,
                    "n_cells": one.n_cells,
                    "deviance_p_value": one.deviance_p_value,
                }
            )
    columns = (
        Column(key=SUBJECT, header="person", is_name=True),
        Column(key="observer", is_name=True),
        Column(key="internal_noise", header="internal noise", digits=3),
        Column(key="efficiency", digits=3),
        Column(key="aic", header="AIC", digits=5, rank=1),
        Column(key="aic_difference", header="difference", digits=2),
        Column(key="deviance", digits=3, rank=2),
        Column(key="n_cells", header="cells", rank=2),
        Column(key="deviance_p_value", header="p", digits=2),
    )
    return Table.of("Which observer explains the answers better", "observers.csv", columns, records)


def by_observer(result: ResultData) -> dict[str, tuple[PersonResult, ...]]:
    """Return the persons of each observer by its name, that of all persons together last."""
    names = observer_names(result.settings, result.observers)
    return dict(zip(names, [all_persons(result), *map(all_persons, result.observers)], strict=True))


def _aic(one: PersonResult) -> float:
    assert one.aic is not None  # older results have one observer
    return one.aic


def _comparison(names: Sequence[str], persons: Sequence[PersonResult]) -> str:
    """Return a sentence on which observer explains a person better."""
    (best, name), (second, _), *_ = sorted((_aic(one), name) for one, name in zip(persons, names, strict=True))
    each = ", ".join(f"{plain(_aic(one), 5)} for {name}" for one, name in zip(persons, names, strict=True))
    who = "all together" if persons[0].subject is None else f"person {_printable(persons[0].subject)}"
    if second - best < UNDECIDED:
        return f"The answers of {who} do not decide between the observers: AIC {each}."
    evidence = "strong" if second - best >= STRONG else "some"
    return (
        f"{name} explains the answers of {who} better: AIC {each}; a difference of {plain(second - best, 2)} is "
        f"{evidence} evidence."
    )


def own_and_model(result: ResultData) -> list[tuple[Fit, Fit | None]]:
    """Return each threshold of a person with that of the fitted model; None where no noise is known."""
    predicted = {_key(fit): fit for one in result.persons for fit in one.predicted}
    return [(fit, predicted.get(_key(fit))) for fit in result.fits]


def _key(fit: Fit) -> tuple[float | str, ...]:
    return tuple(fit.group.values())


def curves_table(result: ResultData) -> Table:
    """Make the table of thresholds: of each person, by the counts alone, and of the fitted model."""
    records: list[Record] = []
    for own, model in own_and_model(result):
        record: Record = dict(own.group)
        record |= {"threshold": own.threshold, "threshold_ci95": own.threshold_ci95, "status": own.status}
        record |= {"n_trials": own.n_trials, "predicted": None, "predicted_ci95": None, "ratio": None}
        if model is not None:
            record |= {"predicted": model.threshold, "predicted_ci95": model.threshold_ci95}
            if own.threshold is not None and model.threshold is not None:
                record["ratio"] = own.threshold / model.threshold
        records.append(record)
    first = result.fits[0]
    columns = [
        Column(
            key=name,
            header="person" if name == SUBJECT else column_heading(name),
            digits=EXACT,
            is_name=True,
        )
        for name in first.group
    ]
    columns += [
        Column(key="threshold", header=threshold_heading(first.level), digits=3),
        Column(key="threshold_ci95", header="95 % interval", interval="threshold_ci95", digits=3, rank=2),
        Column(key="predicted", header="of the model", digits=3),
        Column(key="predicted_ci95", header="its 95 % interval", interval="predicted_ci95", digits=3, rank=2),
        Column(key="ratio", header="person ÷ model", digits=3, rank=1),
        Column(key="n_trials", header="trials", rank=4),
        Column(key="status", rank=3),
    ]
    title = f"Thresholds at {100 * first.p_correct:g} % correct"
    return Table.of(title, "calibration.csv", columns, records)


def sentences(result: ResultData) -> list[str]:
    """Return the findings in words, a sentence for each person; of many persons, for the first."""
    shown = [*result.persons[:MOST_DESCRIBED], *([] if result.pooled is None else [result.pooled])]
    of_each = by_observer(result)
    several = [
        [one for one in persons if one.subject in {other.subject for other in shown}]
        for persons in of_each.values()
    ]
    texts = [_comparison(list(of_each), persons) for persons in zip(*several, strict=True) if len(persons) > 1]
    for name, persons in zip(of_each, several, strict=True):
        head = f"{name}: " if len(several) > 1 else ""
        texts += [head + _sentence(result, one) for one in persons]
    if (more := len(result.persons) - MOST_DESCRIBED) > 0:
        text = f"{count(more, 'more person')} {'is' if more == 1 else 'are'} in the table."
        texts.insert(len(texts) - (result.pooled is not None), text)
    return texts


def _sentence(result: ResultData, one: PersonResult) -> str:
    who = TOGETHER.capitalize() if one.subject is None else f"Person {_printable(one.subject)}"
    name, value, ends = "internal noise", one.internal_noise, one.internal_noise_ci95
    if one.efficiency_ci95 is not None:
        name, value, ends = "efficiency", one.efficiency, one.efficiency_ci95
    interval = interval_phrase(ends)
    if value is None:
        known = "" if interval == "open" else f" (95 % interval {interval})"
        return f"{who}: no {name}{known}: {NO_NOISE.get(one.status, one.status)}."
    text = f"{who}: {name} {plain(value)} (95 % interval {interval})"
    if one.lapse_rate_ci95 is not None:
        text += f", lapses {plain(one.lapse_rate, 2)} ({interval_phrase(one.lapse_rate_ci95, 2)})"
    if one.template_blur_samples_ci95 is not None:
        blur = interval_phrase(one.template_blur_samples_ci95)
        text += f", template blur {plain(one.template_blur_samples)} samples ({blur})"
    text += f", from {count(one.n_trials, 'trial')}"
    if one.n_flagged:
        fate = "flagged, but counted" if result.settings.get("include_flagged") else "left out"
        each = " and ".join(f"{n} {FLAGS[flag]}" for flag, n in one.n_flagged.items())
        text += f"; {count(sum(one.n_flagged.values()), 'answer')} {fate}: {each}"
    return f"{text}."


def _printable(subject: str) -> str:
    """Return an id that may stand in a comment of one line."""
    return "".join(letter if letter.isprintable() else "?" for letter in subject)


def with_model_curves(result: ResultData, subject: str | None) -> list[Fit]:
    """Return the points of a person, each group with the curve of the fitted model."""
    return [
        msgspec.structs.replace(
            own,
            group={name: value for name, value in own.group.items() if name != SUBJECT},
            curve="observer",
            observer_curve=None if model is None else model.observer_curve,
        )
        for own, model in own_and_model(result)
        if own.group[SUBJECT] == subject and own.points
    ]


def settings_files(result: ResultData) -> dict[str, bytes]:
    """Return the files of settings for `todframes score --observer-settings`, by name.

    `observer.toml` is that of the only person, or of all together; with several persons each has another. Those of
    further observers begin with the observer's name.
    """
    found = _settings_files(result)
    for name, one in zip(observer_names(result.settings, result.observers)[1:], result.observers, strict=True):
        view = msgspec.structs.replace(
            result, settings=result.settings | one.settings, persons=one.persons, pooled=one.pooled
        )
        prefix = re.sub("[^A-Za-z0-9-]+", "-", name).strip("-")
        found |= {f"{prefix}_{file}": content for file, content in _settings_files(view).items()}
    return found


def _settings_files(result: ResultData) -> dict[str, bytes]:
    common = result.persons[0] if result.pooled is None else result.pooled
    names = {"observer.toml": common}
    for one in result.persons if len(result.persons) > 1 else ():
        name = re.sub("[^A-Za-z0-9-]", "-", str(one.subject))
        while f"observer_{name}.toml" in names:
            name += "-"
        names[f"observer_{name}.toml"] = one
    return {name: _toml(result, one).encode() for name, one in names.items() if one.status == "ok"}


def _toml(result: ResultData, one: PersonResult) -> str:
    values = {name: value for name, value in result.settings.items() if name not in NOT_OF_OBSERVER}
    if one.efficiency is not None:
        values["efficiency"] = one.efficiency
    else:
        values["internal_noise"] = one.internal_noise
    if one.template_blur_samples_ci95 is not None:
        values["template_blur_samples"] = one.template_blur_samples
    how = f"todframes score DATASET --observer {result.settings.get('observer')} --observer-settings FILE"
    return toml_text(values, comment=f"{_sentence(result, one)}\n{how}")
