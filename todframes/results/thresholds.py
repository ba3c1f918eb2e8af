"""Thresholds with the tables, figures, sentences and files of them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from todframes.base.errors import DataError
from todframes.base.safe_text import without_quote
from todframes.results import tables, wording
from todframes.results.data import PNG_SIGNATURE, DatasetRecord, Efficiency, Example, Fit, Record
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import count, group_phrase, group_phrases, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from todframes.results.figures import CurveStyle, ReportFigure

GAZES = {"tracked": "follows it (tracked)", "fixed": "stays at that place (fixed), so that motion is blur"}
"""Phrases about each gaze, where triangles move."""

MOST_ANSWERS = 12
"""Largest number of rows of the table of answers that a terminal shows unless it is asked for details."""


class Thresholds(Result, frozen=True, kw_only=True):
    """Thresholds with the data and settings behind them.

    `todframes.score`, `fit_counts`, `naked_eye` and `sensor_sim.curve` give them; `compare` and `calibrate` add to
    them.

    Attributes
    ----------
    fits : tuple of Fit
        A threshold for each group; empty for `compare`. Of `calibrate`, each person's own thresholds, with
        `subject` in their group.
    thresholds : tuple of Fit
        All thresholds; in a comparison, `group` has the key "condition" too.
    trials : Table or None
        Scores of each trial, as in `scores.csv`.
    plan : tuple of dict
        What was kept and left out: `stage`, `kept`, `why`, `bound` on P(correct), of `score` also `saves_s`.
    dataset : DatasetRecord, str or None
        Dataset of `score`, `compare` and `calibrate`; results of earlier versions have the folder alone.
    skipped : tuple of dict
        Frames or trials that were left out, and why.
    negative_luminance_pixels : int or None
        Number of pixels of the display with a luminance below zero.
    located : tuple of dict or None
        With `--locate`, an object for each group: `x_px`, `y_px`, `standard_error_px`, `moved_px` (displacement
        from the positions of the manifest, which stay if the standard error is None), and `arrangement`: those of
        the codes `polarity_mismatch`, `mirrored`, `flipped` and `turned` that apply. With `each`, `n_located` of
        `n_trials` trials have a position of their own, with the standard deviation `scatter_px`; from `sure_level`
        on, single positions are known to 0.09 mrad.
    examples : tuple of Example or None
        With `-o`: pictures of trials near threshold.
    efficiencies : tuple of Efficiency or None
        With `--relative-to`: the efficiency relative to each other observer in each group.
    limits : tuple of str
        Of `sensor-sim curve`: what makes answers vary at threshold, a sentence for each light.
    viewing : str or None
        Of `sensor-sim curve`: the display and the frames that the eye averages, in a sentence.
    from_store : int or None
        Number of results that an earlier, interrupted run had computed.
    """

    fits: tuple[Fit, ...] = ()
    plan: tuple[Record, ...] = ()
    dataset: DatasetRecord | str | None = None
    skipped: tuple[Record, ...] = ()
    negative_luminance_pixels: int | None = None
    located: tuple[Record, ...] | None = None
    examples: tuple[Example, ...] | None = None
    efficiencies: tuple[Efficiency, ...] | None = None
    limits: tuple[str, ...] = ()
    viewing: str | None = None
    from_store: int | None = None

    def summary_table(self) -> Table:
        """Return the part of a table of several results: a row for each threshold."""
        groups = dict.fromkeys(name for fit in self.thresholds for name in fit.group)
        shown = [column for column in tables.THRESHOLD_COLUMNS if column.in_summary]
        columns = [*tables.group_columns(groups), Column(key="level", rank=2), Column(key="threshold"), *shown]
        columns.append(Column(key="n_warnings", header="warnings", none="", rank=1))
        rows = [
            {"level": fit.level, "n_warnings": len(self.warnings)}
            | tables.group_record(fit.group)
            | {name: getattr(fit, name) for name in ("threshold", *(column.key for column in shown))}
            for fit in self.thresholds
        ]
        return Table.of("", "", columns, rows)

    has_findings_in_table: ClassVar[bool] = True
    make_trials: ClassVar[Callable[..., Table] | None] = None
    inference: ClassVar[str] = "Intervals"
    """Conclusions that hold for the scenes that were shown."""

    @property
    def dataset_path(self) -> str | None:
        """The dataset's folder; results of earlier versions have nothing else about it."""
        return self.dataset.path if isinstance(self.dataset, DatasetRecord) else self.dataset

    @property
    def name(self) -> str:
        """Return the name of the dataset or sensor that the thresholds are about."""
        sensor = self.settings.get("sensor")
        name = sensor.get("name") if isinstance(sensor, dict) else None
        return str(self.dataset_path or name or "")

    @property
    def thresholds(self) -> tuple[Fit, ...]:
        """All thresholds as `Fit` records."""
        return self.fits

    @property
    def trials(self) -> Table | None:
        """Scores of each trial as in `scores.csv`; None if there are no trials, or they were not saved."""
        return None if self.make_trials is None else self.make_trials()

    def found_in(self, folder: Path) -> None:
        """Take the trials from `scores.csv` of the folder when they are asked for."""
        scores = folder / "scores.csv"
        if scores.is_file():
            self.__dict__["make_trials"] = lambda: _read_trials(scores, self)

    def _each_settings(self) -> Sequence[Record]:
        """List the settings of each observer."""
        return [self.settings]

    def _curve_styles(self) -> Mapping[object, CurveStyle]:
        """Return the style of the curves of each condition, by its name; empty without a comparison."""
        return {}

    def table(self) -> Table:
        """Return the thresholds, with columns for the group, `threshold`, its interval and the other values."""
        return tables.thresholds(self.thresholds)

    def tables(self) -> list[Table]:
        """List the thresholds, the answers of groups without one, and folded tables of what is behind them."""
        listed = [self.table()] if self.thresholds else []
        listed += [tables.efficiencies(self.efficiencies)] if self.efficiencies else []
        if (answers := tables.answers(self.fits)) is not None:
            listed.append(answers.extra() if len(answers.records) > MOST_ANSWERS else answers)
        return [*listed, *self.tables_behind()]

    def tables_behind(self) -> list[Table]:
        """List the folded tables: points of the curves, frames left out, positions, plan and dataset."""
        points = tables.points(self.thresholds)
        listed = [] if points is None else [points]
        for title, file, rows in (
            ("Frames left out", "skipped.csv", self.skipped),
            ("Positions found", "located.csv", self.located),
        ):
            listed += [tables.records_table(title, file, rows)] if rows else []
        listed += [self.plan_table()] if self.plan or any(fit.plan for fit in self.fits) else []
        listed += [tables.dataset(self.dataset)] if isinstance(self.dataset, DatasetRecord) else []
        return [table.folded() for table in listed]

    def plan_table(self) -> Table:
        """Return the table of what was kept and left out."""
        return tables.plan(self.fits, self.plan)

    def findings(self) -> list[str]:
        """Return what was found in words, the answer first."""
        return [*wording.findings(self.thresholds), *wording.efficiencies(self.efficiencies or ())]

    def advice(self) -> list[str]:
        """Return the number of frames left out, and what else a reader of the thresholds must know."""
        n = len(self.skipped)
        texts = [f"{count(n, 'frame')} could not be used and {'is' if n == 1 else 'are'} left out."] if n else []
        texts += [*self.limits, *([] if self.viewing is None else [self.viewing])]
        if self.limits:
            texts.append("`sensor-sim advise` states which number of the sensor buys most.")
        of_each = [located for located in self.located or () if located.get("n_located") is not None]
        if of_each:
            n_located, n_trials = (sum(located[key] for located in of_each) for key in ("n_located", "n_trials"))
            faint = [located["group"] for located in of_each if located["n_located"] < located["n_trials"]]
            where = f" (at {group_phrases(faint)})" if faint and faint[0] else ""
            rest = f"; the others{where} are too faint and have the position of their group" if faint else ""
            texts.append(f"{n_located} of {n_trials} trials were located one by one{rest}.")
        data = self.dataset if isinstance(self.dataset, DatasetRecord) else None
        if data is not None and data.motion_mrad is not None:
            gazes = {settings.get("gaze") for settings in self._each_settings()}
            looks = " or ".join(look for gaze, look in GAZES.items() if gaze in gazes)
            texts.append(
                f"Within a trial the triangle moves, by up to {plain(data.motion_mrad)} mrad from its mean place; "
                f"the gaze {looks}."
            )
        if data is not None and data.n_scenes is not None and self.thresholds:
            if "scene" in data.experiment.get("group_by", ()) and data.n_scenes > 1:
                texts.append(f"{self.inference} of a scene hold for it, and nothing is known of others.")
            elif data.n_scenes == 1:
                what = self.inference.lower()
                texts.append(f"All trials are on one scene: {what} hold for it, and nothing is known of others.")
            else:
                texts.append(
                    f"{self.inference} take the {data.n_scenes} scenes as drawn from many and hold for others "
                    "like them."
                )
        apart = [
            100 * abs(fit.points_threshold / fit.threshold - 1)
            for fit in self.thresholds
            if fit.curve != "observer" and fit.threshold is not None and fit.points_threshold is not None
        ]
        if max(apart, default=0.0) >= 1.0:
            texts.append(
                f"The points themselves cross the criterion up to {plain(max(apart), 2)} % away from the fitted "
                "Weibull curve; the intervals cover both."
            )
        return texts

    def notes(self) -> list[str]:
        """Return remarks on the frames: where triangles were found, what was skipped, what is not physical."""
        remarks = [
            f"located: {group_phrase(located['group'])}: {_where(located)}" for located in self.located or ()
        ]
        remarks += [f"skipped: {skipped['error']}" for skipped in self.skipped]
        return [*remarks, *(f"note: {text}" for text in self._negative() if self.fits)]

    def _negative(self) -> list[str]:
        n = self.negative_luminance_pixels
        text = "display pixels have a luminance below zero, as noise in linear frames may have; they are scored as"
        return [f"{n} {text} they are"] if n else []

    def remarks(self) -> list[str]:
        """Return sentences about the accuracy of the numbers."""
        return [*wording.remarks(self.thresholds), *(f"{text}." for text in self._negative())]

    def figures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        from todframes.results.figures import pictures

        return pictures(self.fits)

    def plot_tod(self, ax: Axes | None = None) -> Axes:
        """Draw the TOD curve, threshold against 1 / size with 95 % intervals, into axes as `plot` does. DataError
        if there are no thresholds at two sizes.
        """
        from todframes.results.figures import draw_tod, drawn, has_tod_curve

        if not has_tod_curve(self.thresholds):
            raise DataError("plot_tod: found no thresholds at two or more sizes, which a TOD curve needs")
        return drawn(lambda axes: draw_tod(axes, self.thresholds, self._curve_styles()), ax)

    def plot_psychometric(self, ax: Axes | None = None) -> Axes:
        """Draw the psychometric functions, proportion correct against level with fitted curves, into axes as
        `plot` does. DataError if no threshold has points.
        """
        from todframes.results.figures import draw_psychometric, drawn

        if not any(fit.points for fit in self.thresholds):
            raise DataError("plot_psychometric: found no thresholds with points of a psychometric function")
        return drawn(lambda axes: draw_psychometric(axes, self.thresholds, self._curve_styles()), ax)

    def data_files(self) -> dict[str, bytes]:
        """Return the trials, `scores.csv`."""
        trials = self.trials
        return {} if trials is None else {"scores.csv": trials.csv().encode()}

    def check(self, where: str) -> None:
        """Raise DataError unless all fits have the columns of one table, and examples are pictures."""
        check_fits(self.fits, f"{where}: fits")
        for number, example in enumerate(self.examples or ()):
            for picture in example.pictures:
                if not picture.png.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR"):
                    raise DataError(f"{where}: examples[{number}]: picture {picture.name!r} is no PNG")


def check_fits(fits: Sequence[Fit], where: str) -> None:
    """Raise DataError unless all fits have the same level and group columns, as one table needs."""
    for number, fit in enumerate(fits):
        for name, found, expected in (
            ("level", fit.level, fits[0].level),
            ("group", ", ".join(fit.group), ", ".join(fits[0].group)),
        ):
            if found != expected:
                raise DataError(
                    f"{where}[{number}].{name}: found {found!r}, expected {expected!r} as in the first"
                )


def _where(position: Record) -> str:
    """Return where the triangles of a group were found, as a phrase."""
    error_px, moved_px = position["standard_error_px"], position["moved_px"]
    if error_px is None:
        return "no triangle stands out near the manifest's positions, which stay"
    if moved_px is not None:
        where = f"{moved_px[0]:+.2f} in x, {moved_px[1]:+.2f} in y from the manifest's positions"
    else:
        where = f"x_px {position['x_px']:.2f}, y_px {position['y_px']:.2f}"
    return f"{where} (± {error_px:.1g} px)"


def _read_trials(path: Path, data: Thresholds) -> Table:
    """Return the trials of a result from their file; DataError unless it holds all of them."""
    content = path.read_bytes()
    try:
        header, *rows = csv.reader(StringIO(content.decode(), newline=""))
        if not content.endswith(b"\n") or len(rows) != sum(fit.n_trials for fit in data.thresholds):
            raise ValueError
        names = list(map(without_quote, header))
        kinds = tables.trial_kinds(names, [fit.group for fit in data.thresholds])
        records = [
            {name: _value(text, kinds[name]) for name, text in zip(names, row, strict=True)} for row in rows
        ]
    except (ValueError, csv.Error):
        raise DataError(
            f"{path}: is not the whole table of trials of the result beside it; run the command again"
        ) from None
    return Table.of("Trials", path.name, kinds, records)


def _value(text: str, kind: type) -> object:
    return without_quote(text) if kind is str else kind(text) if text else None
