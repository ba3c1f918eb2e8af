"""Thresholds with the tables, figures, sentences and files of them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from todframes.base.errors import DataError
from todframes.base.safe_text import without_quote
from todframes.results import tables
from todframes.results.data import PNG_SIGNATURE, DatasetRecord, ResultData, check_fits, each_observer
from todframes.results.summary import cautions, remarks, verdict
from todframes.results.table import LongRecords, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from todframes.results.figure import ReportFigure


class Thresholds(ResultData, frozen=True, kw_only=True):
    """Thresholds with the data and settings behind them.

    `todframes.score`, `compare`, `fit_counts`, `naked_eye` and `sensor_sim.curve` give them.

    Attributes
    ----------
    thresholds : tuple of Fit
        A record for each group, with `group`, `level`, `threshold`, `threshold_ci95`, `status` and the curve.
    algorithms : tuple of Algorithm
        Ratios of thresholds and verdicts of a comparison; empty for other results.
    trials : Table or None
        Scores of each trial, as in `scores.csv`.
    settings : dict
        All settings.
    skipped : tuple of dict
        Frames that could not be used, and the reasons.
    """

    @property
    def name(self) -> str:
        """Return the name of the dataset or sensor that the thresholds are about."""
        sensor = self.settings.get("sensor")
        name = sensor.get("name") if isinstance(sensor, dict) else None
        return str(self.dataset_path or name or "")

    @property
    def trials(self) -> Table | None:
        """Scores of each trial as in `scores.csv`; None if there are no trials, or they were not saved."""
        make: Callable[[], Table] | None = self.__dict__.get("make_trials")
        return None if make is None else make()

    def found_in(self, folder: Path) -> None:
        """Take the trials from `scores.csv` of the folder when they are asked for."""
        scores = folder / "scores.csv"
        if scores.is_file():
            self.__dict__["make_trials"] = lambda: _read_trials(scores, self)

    def table(self) -> Table:
        """Return the thresholds, with columns for the group, `threshold`, its interval and the other values."""
        return tables.thresholds(self)

    def tables(self) -> list[Table]:
        """List the tables of a comparison, of persons or of thresholds, and folded ones with all details."""
        from todframes.results import calibration

        found: list[Table | None] = []
        if self.persons:
            found += calibration.all_tables(self)
        else:
            if self.algorithms:
                measures = tables.measures(self.algorithms)
                found += [tables.ratios(one, observer) for observer, one in each_observer(self)]
                found += [
                    measures.without_details(),
                    replace(measures, title="Details of the algorithms").folded(),
                ]
                found.append(_folded(tables.contrast_responses(self.algorithms)))
            elif self.thresholds:
                found.append(tables.thresholds(self).without_details())
            found.append(tables.answers(self))
            if self.thresholds:
                found.append(tables.thresholds(self, "Details of the thresholds").folded())
        found.append(_folded(tables.points(self)))
        for scene in self.scenes:
            first, *others = tables.scene_tables(scene)
            found += [first, *map(_folded, others)]
        for title, file, rows in (
            ("Frames left out", "skipped.csv", self.skipped),
            ("Positions found", "located.csv", self.located),
        ):
            found += [tables.records_table(title, file, rows).folded()] if rows else []
        found += [tables.plan(self).folded()] if self.plan or any(fit.plan for fit in self.fits) else []
        found += [tables.dataset(self.dataset).folded()] if isinstance(self.dataset, DatasetRecord) else []
        return [one for one in found if one is not None]

    def sentences(self) -> list[str]:
        """Return the findings, and the cautions that a reader of them must know."""
        return [*verdict(self), *cautions(self)]

    def remarks(self) -> list[str]:
        """Return sentences about the accuracy of the numbers."""
        return remarks(self)

    def figures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        from todframes.results.figures import pictures

        return pictures(self)

    def plot_tod(self, ax: Axes | None = None) -> Axes:
        """Draw the TOD curve: threshold against 1 / size, with 95 % intervals.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes to draw into. Default: a new figure.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        DataError
            If there are no thresholds at two sizes.
        """
        from todframes.results.figure import drawn
        from todframes.results.figures import draw_tod, has_tod_curve

        if not has_tod_curve(self.thresholds):
            raise DataError("plot_tod: found no thresholds at two or more sizes, which a TOD curve needs")
        return drawn(lambda axes: draw_tod(axes, self.thresholds), ax)

    def plot_psychometric(self, ax: Axes | None = None) -> Axes:
        """Draw the psychometric functions: proportion correct against level, points and fitted curves.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes to draw into. Default: a new figure.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        DataError
            If no threshold has points.
        """
        from todframes.results.figure import drawn
        from todframes.results.figures import draw_psychometric

        if not any(fit.points for fit in self.thresholds):
            raise DataError("plot_psychometric: found no thresholds with points of a psychometric function")
        return drawn(lambda axes: draw_psychometric(axes, self.thresholds), ax)

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return trials, the tables of a comparison or calibration, and the observers' settings of the latter."""
        trials, responses = self.trials, tables.contrast_responses(self.algorithms)
        return {
            **(_calibration_files(self) if self.persons else {}),
            **({} if trials is None else _score_files(trials)),
            **({"compare.csv": tables.ratios(self.algorithms).csv().encode()} if self.algorithms else {}),
            **({} if responses is None else {"contrast_response.csv": responses.csv().encode()}),
        }

    def check(self, where: str) -> None:
        """Raise DataError unless all fits have the columns of one table, and examples are pictures."""
        check_fits(self.fits, f"{where}: fits")
        check_fits(self.thresholds[len(self.fits) :], f"{where}: fits of all algorithms")
        for number, example in enumerate(self.examples or ()):
            for picture in example.pictures:
                if not picture.png.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR"):
                    raise DataError(f"{where}: examples[{number}]: picture {picture.name!r} is no PNG")


def _folded(table: Table | None) -> Table | None:
    return None if table is None else table.folded()


def _calibration_files(data: Thresholds) -> dict[str, bytes]:
    """Return the tables of a calibration, its figure as SVG and the observers' settings."""
    from todframes.results import calibration

    tables = {one.file: one.csv().encode() for one in calibration.all_tables(data)}
    drawn = {one.file.replace(".png", ".svg"): one.svg() for one in data.figures() if one.file}
    return {**tables, **drawn, **calibration.settings_files(data)}


def _score_files(trials: Table) -> dict[str, Iterable[bytes]]:
    """Return `scores.csv` and, where pyarrow is installed, `scores.parquet` in parts."""
    from todframes.results.parquet import has_parquet, parquet_parts

    files: dict[str, Iterable[bytes]] = {"scores.csv": (part.encode() for part in trials.csv_parts())}
    if has_parquet():
        files["scores.parquet"] = parquet_parts(trials)
    return files


def _read_trials(path: Path, data: Thresholds) -> Table:
    """Return the trials of a result from their file; DataError unless it holds all of them."""
    content = path.read_bytes()
    try:
        header, *rows = csv.reader(StringIO(content.decode(), newline=""))
        if not content.endswith(b"\n") or len(rows) != sum(fit.n_trials for fit in data.thresholds):
            raise ValueError
        names = list(map(without_quote, header))
        kinds = tables.trial_kinds(names, [fit.group for fit in data.thresholds])
        values = zip(*rows, strict=True) if rows else [()] * len(names)
        columns = {
            name: [_value(text, kinds[name]) for text in of_rows]
            for name, of_rows in zip(names, values, strict=True)
        }
    except (ValueError, csv.Error):
        raise DataError(
            f"{path}: is not the whole table of trials of the result beside it; run the command again"
        ) from None
    return Table.of("Trials", path.name, kinds, LongRecords(kinds, len(rows), lambda: iter([columns])))


def _value(text: str, kind: type) -> object:
    return without_quote(text) if kind is str else kind(text) if text else None
