"""The internal noise of people: the records of a result, with their tables, sentences, figures and settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta, Struct, field

from todframes.base.reading import toml_text
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import Fit, Interval, Positive, Proportion, Record, observer_names
from todframes.results.tables import Column, Table, group_columns
from todframes.results.thresholds import Thresholds
from todframes.results.wording import count, interval_phrase, plain, threshold_heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from todframes.results.figures import ReportFigure

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
    Column(key="model_difference", in_file_only=True),
    Column(key="model_difference_ci90", interval="model_difference_ci90", in_file_only=True),
    Column(key="status", is_key=True),
)

UNDECIDED, STRONG = 2.0, 10.0
"""Differences of AIC below which the answers do not decide, and from which they are strong evidence."""

MARGIN = 0.1
"""Difference in proportion correct within which a model and a person count as equal."""

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


class PersonResult(Struct, frozen=True, kw_only=True):
    """The internal noise that explains the answers of a person, or those of several persons together.

    Attributes
    ----------
    subject : str or None
        Anonymous id of the person; None for all together.
    status : str
        "ok", or why there is no noise: "noise_free" (without noise the model would answer no worse), "at_chance"
        (the answers cannot be distinguished from guesses), "too_few_trials" (neither is).
    internal_noise : float or None
        Full width of each neuron's noise.
    internal_noise_ci95 : (float or None, float or None)
        95 % interval; an end is None if the answers leave it open.
    efficiency, efficiency_ci95
        Squared ratio of the person's d′ to that of an observer such as `csf`, in place of an internal noise; the
        interval is None for observers with an internal noise.
    lapse_rate, template_blur_samples : float or None
        Error rate δ of lapses and blur of the templates, in retina samples; fitted if they have an interval.
    n_trials, n_correct : int
        Number of main trials, and of correct answers.
    n_flagged : mapping of str to int
        Number of answers with each flag that occurs: hidden, unfocused, too_fast. They are among `n_trials` only
        with the setting `include_flagged`.
    log_likelihood : float
        Sum of the ln probabilities of the answers.
    aic : float or None
        Akaike's criterion, 2 · (fitted parameters) − 2 · log_likelihood; of two observers, that with the smaller
        one explains the same answers better.
    deviance, deviance_p_value : float
        Deviance of the proportions correct of the `n_cells` groups and levels, and the share of experiments with
        the fitted model that have as large a one.
    model_difference, model_difference_ci90 : float, (float, float), or None
        Proportion correct of the person minus that of the fitted model, in the group in which they differ most,
        and its 90 % interval. Person and model are equal if it lies within ± 0.1.
    predicted : tuple of Fit
        Thresholds of the fitted model, a record for each of the person's own in `fits`, in the same order; their
        intervals are those of the noise.
    """

    subject: Annotated[str, Meta(pattern="^[A-Za-z0-9]{1,64}$")] | None
    status: str
    internal_noise: Positive | None = None
    internal_noise_ci95: Interval
    efficiency: Positive | None = None
    efficiency_ci95: Interval | None = None
    lapse_rate: Proportion | None = None
    lapse_rate_ci95: tuple[Proportion, Proportion] | None = None
    template_blur_samples: float | None = None
    template_blur_samples_ci95: Interval | None = None
    n_trials: int
    n_correct: int
    n_flagged: dict[str, int] = field(default_factory=dict)
    log_likelihood: float
    aic: float | None = None
    deviance: float
    deviance_p_value: Proportion | None = None
    n_cells: int
    model_difference: float | None = None
    model_difference_ci90: tuple[float, float] | None = None
    predicted: tuple[Fit, ...] = ()

    @property
    def equivalence(self) -> str:
        """Return whether model and person are equal within the margin, in a sentence; empty without a noise."""
        if self.model_difference is None or self.model_difference_ci90 is None:
            return ""
        low, high = self.model_difference_ci90
        does = "equals" if low > -MARGIN and high < MARGIN else "is not shown to equal"
        worst = f"{self.model_difference:+.2f} where they differ most, 90 % interval {low:+.2f} to {high:+.2f}"
        within = f"within {MARGIN:g} of proportion correct"
        return f" In the mean over levels, the model {does} this person {within} ({worst})."


class FurtherObserver(Struct, frozen=True, kw_only=True):
    """A further observer of `calibrate`: its settings, and the noise or efficiency of the persons by it."""

    settings: Record
    persons: tuple[PersonResult, ...] = ()
    pooled: PersonResult | None = None

    @property
    def all_persons(self) -> tuple[PersonResult, ...]:
        """The persons, that of all persons together last."""
        return (*self.persons, *([] if self.pooled is None else [self.pooled]))


class CalibratedPeople(Thresholds, frozen=True, kw_only=True):
    """Internal noise, or efficiency, of people. `calibrate` gives it.

    Attributes
    ----------
    persons : tuple of PersonResult
        An object for each person.
    pooled : PersonResult or None
        With several people: all answers together.
    observers : tuple of FurtherObserver
        What the second and further observers find.
    equal_noise_p_value : float or None
        p-value of the likelihood-ratio test that all people have the same noise.
    """

    observers: tuple[FurtherObserver, ...] = ()
    persons: tuple[PersonResult, ...] = ()
    pooled: PersonResult | None = None
    equal_noise_p_value: Proportion | None = None

    has_findings_in_table: ClassVar[bool] = False

    def _each_observer(self) -> list[tuple[str, FurtherObserver]]:
        """Return what each observer finds, with its name."""
        first = FurtherObserver(settings=self.settings, persons=self.persons, pooled=self.pooled)
        each = [first, *self.observers]
        return list(zip(observer_names([calibrated.settings for calibrated in each]), each, strict=True))

    def tables(self) -> list[Table]:
        """List the observers compared, the noise of each person and the thresholds; the rest is folded."""
        return [*self._own_tables(), *self.tables_behind()]

    def _own_tables(self) -> list[Table]:
        observers = [observers_table(self._each_observer())] if self.observers else []
        first = self._each_observer()[0][1]
        return [*observers, noise_table(first.all_persons), curves_table(self.fits, self.persons)]

    def findings(self) -> list[str]:
        """Return a sentence for each person; of many persons, for the first."""
        shown = {person.subject for person in self.persons[:MOST_DESCRIBED]} | {None}
        each = [
            (name, [person for person in observer.all_persons if person.subject in shown])
            for name, observer in self._each_observer()
        ]
        several = len(each) > 1
        texts = [
            _comparison([name for name, _ in each], persons)
            for persons in zip(*(persons for _, persons in each), strict=True)
            if several
        ]
        for name, persons in each:
            texts += [f"{name}: " * several + self._sentence(person) for person in persons]
        if (more := len(self.persons) - MOST_DESCRIBED) > 0:
            text = f"{count(more, 'more person')} {'is' if more == 1 else 'are'} in the table."
            texts.insert(len(texts) - (self.pooled is not None), text)
        return texts

    def _sentence(self, person: PersonResult) -> str:
        who = TOGETHER.capitalize() if person.subject is None else f"Person {person.subject}"
        name, value, ends = "internal noise", person.internal_noise, person.internal_noise_ci95
        if person.efficiency_ci95 is not None:
            name, value, ends = "efficiency", person.efficiency, person.efficiency_ci95
        interval = interval_phrase(ends)
        if value is None:
            known = "" if interval == "open" else f" (95 % interval {interval})"
            return f"{who}: no {name}{known}: {NO_NOISE.get(person.status, person.status)}."
        text = f"{who}: {name} {plain(value)} (95 % interval {interval})"
        if person.lapse_rate_ci95 is not None:
            text += f", lapses {plain(person.lapse_rate, 2)} ({interval_phrase(person.lapse_rate_ci95, 2)})"
        if person.template_blur_samples_ci95 is not None:
            blur = interval_phrase(person.template_blur_samples_ci95)
            text += f", template blur {plain(person.template_blur_samples)} samples ({blur})"
        text += f", from {count(person.n_trials, 'trial')}"
        if person.n_flagged:
            fate = "flagged, but counted" if self.settings.get("include_flagged") else "left out"
            each = " and ".join(f"{n} {FLAGS[flag]}" for flag, n in person.n_flagged.items())
            text += f"; {count(sum(person.n_flagged.values()), 'answer')} {fate}: {each}"
        return f"{text}.{person.equivalence if person.subject is not None else ''}"

    def figures(self) -> list[ReportFigure]:
        """List people's curves and those of the models that were fitted to them."""
        from todframes.results.figures import ReportFigure, has_tod_curve, tod_note

        if not has_tod_curve(self.fits):
            return []
        note = tod_note(self.fits) + " Symbols: the person, by the counts alone; lines: the fitted model."
        draw = partial(_draw_persons, pairs=own_and_model(self.fits, self.persons))
        return [ReportFigure("Person and model", note, draw, "calibration.png")]

    def data_files(self) -> dict[str, bytes]:
        """Return the tables and the observers' settings."""
        tables = {table.file: table.csv().encode() for table in self._own_tables()}
        return {**tables, **self._settings_files(), **super().data_files()}

    def _settings_files(self) -> dict[str, bytes]:
        """Return the files of settings for `todframes score --observer-settings`, by name.

        `observer.toml` is that of the only person, or of all together; with several persons each has another.
        Those of further observers begin with the observer's name.
        """
        files: dict[str, bytes] = {}
        for number, (observer, calibrated) in enumerate(self._each_observer()):
            prefix = re.sub("[^A-Za-z0-9-]+", "-", observer).strip("-") + "_" if number else ""
            persons = {"observer.toml": calibrated.persons[0] if calibrated.pooled is None else calibrated.pooled}
            if len(calibrated.persons) > 1:
                persons |= {f"observer_{person.subject}.toml": person for person in calibrated.persons}
            for file, person in persons.items():
                if person.status == "ok":
                    files[prefix + file] = self._toml(self.settings | calibrated.settings, person).encode()
        return files

    def _toml(self, settings: Record, person: PersonResult) -> str:
        values = {name: value for name, value in settings.items() if name not in NOT_OF_OBSERVER}
        name = "internal_noise" if person.efficiency is None else "efficiency"
        values[name] = getattr(person, name)
        if person.template_blur_samples_ci95 is not None:
            values["template_blur_samples"] = person.template_blur_samples
        how = f"todframes score DATASET --observer {settings.get('observer')} --observer-settings FILE"
        return toml_text(values, comment=f"{self._sentence(person)}\n{how}")


def noise_table(persons: Sequence[PersonResult]) -> Table:
    """Make the table of internal noises, a row for each person and one for all together. Of noise and efficiency
    it has what was fitted, and so of lapses and blur.
    """
    records: list[Record] = [
        {column.key: getattr(person, column.key) for column in NOISE_COLUMNS}
        | {SUBJECT: person.subject or TOGETHER, "n_flagged": sum(person.n_flagged.values()) or None}
        for person in persons
    ]
    is_efficiency = any(person.efficiency_ci95 is not None for person in persons)
    kept, other = ("efficiency", "internal_noise") if is_efficiency else ("internal_noise", "efficiency")
    empty = [f"{other}_ci95"]
    for key in ("lapse_rate", "template_blur_samples"):
        empty += [] if any(record[f"{key}_ci95"] for record in records) else [key]
    title = "Efficiency" if is_efficiency else "Internal noise"
    records = [record | dict.fromkeys(empty) for record in records]
    table = Table.of(title, "internal_noise.csv", NOISE_COLUMNS, records)
    return table.without_empty_columns(kept, f"{kept}_ci95")


def observers_table(each_observer: Sequence[tuple[str, FurtherObserver]]) -> Table:
    """Make the table of observers, a row for each person and observer."""
    names = [name for name, _ in each_observer]
    keys = ("internal_noise", "efficiency", "aic", "deviance", "n_cells", "deviance_p_value")
    records: list[Record] = []
    for persons in zip(*(person.all_persons for _, person in each_observer), strict=True):
        least = min(map(_aic, persons))
        records += [
            {SUBJECT: person.subject or TOGETHER, "observer": name, "aic_difference": _aic(person) - least}
            | {key: getattr(person, key) for key in keys}
            for name, person in zip(names, persons, strict=True)
        ]
    as_in_noise = {column.key: column for column in NOISE_COLUMNS}
    columns = (
        as_in_noise[SUBJECT],
        Column(key="observer", is_name=True),
        *(as_in_noise[key] for key in ("internal_noise", "efficiency")),
        Column(key="aic", header="AIC", digits=5, rank=1),
        Column(key="aic_difference", header="difference", digits=2),
        *(as_in_noise[key] for key in ("deviance", "n_cells", "deviance_p_value")),
    )
    return Table.of("Which observer explains the answers better", "observers.csv", columns, records)


def _aic(person: PersonResult) -> float:
    assert person.aic is not None  # older results have one observer
    return person.aic


def _comparison(names: Sequence[str], persons: Sequence[PersonResult]) -> str:
    """Return a sentence on which observer explains a person better."""
    (best, name), (second, _), *_ = sorted(
        (_aic(person), name) for person, name in zip(persons, names, strict=True)
    )
    each = ", ".join(f"{plain(_aic(person), 5)} for {name}" for person, name in zip(persons, names, strict=True))
    who = "all together" if persons[0].subject is None else f"person {persons[0].subject}"
    if second - best < UNDECIDED:
        return f"The answers of {who} do not decide between the observers: AIC {each}."
    evidence = "strong" if second - best >= STRONG else "some"
    return (
        f"{name} explains the answers of {who} better: AIC {each}; a difference of {plain(second - best, 2)} is "
        f"{evidence} evidence."
    )


def own_and_model(fits: Sequence[Fit], persons: Sequence[PersonResult]) -> list[tuple[Fit, Fit | None]]:
    """Return each threshold of a person with that of the fitted model; None where no noise is known."""
    predicted = {tuple(fit.group.values()): fit for person in persons for fit in person.predicted}
    return [(fit, predicted.get(tuple(fit.group.values()))) for fit in fits]


def curves_table(fits: Sequence[Fit], persons: Sequence[PersonResult]) -> Table:
    """Make the table of thresholds: of each person, by the counts alone, and of the fitted model."""
    records: list[Record] = []
    for own, model in own_and_model(fits, persons):
        keys = ("threshold", "threshold_ci95", "status", "n_trials")
        record: Record = own.group | {key: getattr(own, key) for key in keys}
        if model is not None:
            record |= {"predicted": model.threshold, "predicted_ci95": model.threshold_ci95}
            if own.threshold is not None and model.threshold is not None:
                record["ratio"] = own.threshold / model.threshold
        records.append(record)
    person, *groups = group_columns(fits[0].group, ())
    columns = [
        replace(person, header="person"),
        *groups,
        Column(key="threshold", header=threshold_heading(fits[0].level), digits=3),
        Column(key="threshold_ci95", header="95 % interval", interval="threshold_ci95", digits=3, rank=2),
        Column(key="predicted", header="of the model", digits=3),
        Column(key="predicted_ci95", header="its 95 % interval", interval="predicted_ci95", digits=3, rank=2),
        Column(key="ratio", header="person ÷ model", digits=3, rank=1),
        Column(key="n_trials", header="trials", rank=4),
        Column(key="status", rank=3, is_key=True),
    ]
    title = f"Thresholds at {100 * fits[0].p_correct:g} % correct"
    return Table.of(title, "calibration.csv", columns, records)


def _draw_persons(axes: Axes, pairs: Sequence[tuple[Fit, Fit | None]]) -> None:
    """Draw the thresholds of each person against size, with intervals; lines are those of the fitted model."""
    from todframes.results.figures import MOST_CURVES, curve_style, draw_tod, within
    from todframes.results.wording import by_curve, size_column

    fits = [own for own, _ in pairs]
    size = size_column(fits)
    assert size is not None
    curves = list(by_curve([own for own in fits if own.threshold is not None]))[:MOST_CURVES]
    models = by_curve([model for _, model in pairs if model is not None and model.threshold is not None])
    for number, label in enumerate(curves):
        levels = [
            (1.0 / within(float(model.group[size])), within(model.threshold or 0.0))
            for model in models.get(label, ())
        ]
        if levels:
            axes.plot(*zip(*levels, strict=True), color=curve_style(number, len(curves)).colour, zorder=2)
    draw_tod(axes, fits, line="")
