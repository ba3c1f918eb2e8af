"""The result of a command or call: its numbers, and methods that make tables, figures and files of them."""

from __future__ import annotations

import csv
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import msgspec

from todframes import __version__
from todframes.report.data import SCHEMA, ResultData, decode, json_file, read_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from todframes.report.table import Table


LIBRARIES = ("numpy", "scipy", "OpenImageIO", "cv2", "skimage")


class HasDrawing(Protocol):
    """Protocol of a result that draws its main figure."""

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set."""


class HasFiles(Protocol):
    """Protocol of a result that gives the content of its files by name."""

    def files(self) -> Mapping[str, bytes | Iterable[bytes]]:
        """Return the content of all files by name, long ones in parts."""


class Saving:
    """Mixin that saves what `files` gives."""

    __slots__ = ()

    def save(self: HasFiles, folder: Path | str) -> None:
        """Write the files that the command writes with `-o`, each whole or not at all.

        Parameters
        ----------
        folder : path
            Folder, which is made if only its parent exists. Files of an earlier result are replaced.

        Raises
        ------
        OutputError
            If the place cannot be written.
        """
        from todframes.base.output import write_folder

        write_folder(folder, self.files())


class Plotting(Saving):
    """Mixin that draws the main figure of a result, and saves its files."""

    __slots__ = ()

    def plot(self: HasDrawing, ax: Axes | None = None) -> Axes:
        """Draw the main figure, which the text of the class names.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes to draw into. Default: a new figure.

        Returns
        -------
        matplotlib Axes
        """
        from todframes.report.figures import drawn

        return drawn(self.draw, ax)


class Result(ResultData, Saving, frozen=True, kw_only=True, dict=True):
    """Thresholds of a command or call, with the data and settings behind them.

    `todframes.score`, `compare`, `fit_counts`, `naked_eye` and `sensor_sim.curve` return one, and `load_result`
    reads it back. Its fields are the keys of `result.json`.

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

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.score("sample_frames/naked_eye")
    >>> [(one.group["size_mrad"], round(one.threshold, 3)) for one in result.thresholds]
    [(0.6, 0.305), (0.9, 0.163), (1.4, 0.104), (2.4, 0.071)]
    """

    @classmethod
    def made(cls, command: str, started: float, **fields: Any) -> Self:
        """Return a new result of a command, with the run time since `started` and the versions of libraries."""
        used = {name: sys.modules[name].__version__ for name in LIBRARIES if name in sys.modules}
        return cls(
            schema=SCHEMA,
            command=command,
            version=__version__,
            versions={"python": platform.python_version(), "todframes": __version__, **used},
            run_time_s=round(time.perf_counter() - started, 4),
            **fields,
        )

    def with_trials(self, make: Callable[[], Table]) -> Self:
        """Return a copy of the result with trials, whose table is made when it is asked for."""
        copy = msgspec.structs.replace(self)
        msgspec.structs.force_setattr(copy, "_make_trials", make)
        return copy

    @property
    def trials(self) -> Table | None:
        """Scores of each trial as in `scores.csv`; None if there are no trials, or they were not saved."""
        make = self.__dict__.get("_make_trials")
        return None if make is None else make()

    def __repr__(self) -> str:
        from todframes.report.summary import verdict

        return f"<Result of {self.command}: {' '.join(verdict(self))}>"

    def _repr_html_(self) -> str:
        from todframes.report.html import notebook_html

        return notebook_html(self)

    def to_dataframe(self) -> DataFrame:
        """Return the thresholds as a pandas DataFrame with a row for each.

        Columns are those of the group, `threshold`, `threshold_ci95_low`, `threshold_ci95_high` and the other
        values of each `Fit`.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        from todframes.report.tables import thresholds

        return thresholds(self).to_dataframe()

    def to_csv(self) -> str:
        """Return the thresholds as the text of a CSV file with a row for each; columns as in `to_dataframe`."""
        from todframes.report.tables import thresholds

        return thresholds(self).csv()

    def summary(self) -> str:
        """Return the findings, cautions and warnings as sentences, a line each, as the command prints them."""
        from todframes.report.summary import cautions, verdict
        from todframes.report.wording import warning_text

        warnings = (f"warning: {warning_text(one.group, one.message)}" for one in self.warnings)
        return "\n".join([*verdict(self), *cautions(self), *warnings])

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
        from todframes.base.errors import DataError
        from todframes.report.figures import draw_tod, drawn, has_tod_curve

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
        from todframes.base.errors import DataError
        from todframes.report.figures import draw_psychometric, drawn

        if not any(fit.points for fit in self.thresholds):
            raise DataError("plot_psychometric: found no thresholds with points of a psychometric function")
        return drawn(lambda axes: draw_psychometric(axes, self.thresholds), ax)

    def to_json(self) -> bytes:
        """Return the result as indented JSON, the content of `result.json`."""
        return json_file(self)

    def to_html(self) -> str:
        """Return the result as one self-contained HTML page, the content of `report.html`.

        Raises
        ------
        DataError
            If there is nothing to report.
        """
        from todframes.report.html import page

        return page(self)

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the content of all files by name: `result.json`, `report.html`, tables and pictures.

        Long tables come in parts, each made when it is asked for.
        """
        from todframes.report.figures import pictures
        from todframes.report.tables import contrast_responses, ratios

        trials, responses = self.trials, contrast_responses(self.algorithms)
        return {
            **(_calibration_files(self) if self.persons else {}),
            **({} if trials is None else _score_files(trials)),
            **({"compare.csv": ratios(self.algorithms).csv().encode()} if self.algorithms else {}),
            **({} if responses is None else {"contrast_response.csv": responses.csv().encode()}),
            **{one.file: one.png() for one in pictures(self) if one.file},
            "report.html": self.to_html().encode(),
            "result.json": self.to_json(),
        }


def _calibration_files(result: Result) -> dict[str, bytes]:
    """Return the tables of a calibration, its figure as SVG and the observers' settings."""
    from todframes.report.calibration import all_tables, settings_files
    from todframes.report.figures import pictures

    tables = {one.file: one.csv().encode() for one in all_tables(result)}
    drawn = {one.file.replace(".png", ".svg"): one.svg() for one in pictures(result) if one.file}
    return {**tables, **drawn, **settings_files(result)}


def _score_files(trials: Table) -> dict[str, Iterable[bytes]]:
    """Return `scores.csv` and, where pyarrow is installed, `scores.parquet` in parts."""
    from todframes.report.parquet import has_parquet, parquet_parts

    files: dict[str, Iterable[bytes]] = {"scores.csv": (part.encode() for part in trials.csv_parts())}
    if has_parquet():
        files["scores.parquet"] = parquet_parts(trials)
    return files


def load_result(path: Path | str) -> Result:
    """Return a result that a command or `Result.save` wrote.

    Parameters
    ----------
    path : path
        `result.json`, or its folder. Trials are read from `scores.csv` beside it when they are asked for.

    Returns
    -------
    Result

    Raises
    ------
    DataError
        If the file cannot be read, or is not a result.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> folder = tempfile.mkdtemp()
    >>> tod.fit_counts([0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40, 40, 40, 40]).save(folder)
    >>> len(tod.load_result(folder).thresholds)
    1
    """
    path = Path(path)
    if (path / "result.json").is_file():
        path /= "result.json"
    result = read_result(read_bytes(path), str(path))
    scores = path.with_name("scores.csv")
    return result.with_trials(lambda: _read_trials(scores)) if scores.is_file() else result


def read_result(content: bytes, where: str) -> Result:
    """Return a result decoded from its JSON and checked; messages begin with `where`. See `load_result`."""
    return decode(content, where, Result)


def _read_trials(path: Path) -> Table:
    from todframes.report.table import LongRecords, Table

    with path.open(encoding="utf-8", newline="") as file:
        columns = {name: list(map(_value, texts)) for name, *texts in zip(*csv.reader(file), strict=True)}
    kinds = {name: _kind(values) for name, values in columns.items()}
    n = min(map(len, columns.values()), default=0)
    return Table.of("Trials", path.name, kinds, LongRecords(kinds, n, lambda: iter([columns])))


def _kind(values: Sequence[object]) -> type:
    """Return the type of the values of a column, which may have None among them."""
    kinds = {type(value) for value in values if value is not None}
    return str if str in kinds else int if kinds == {int} else float


def _value(text: str) -> object:
    for kind in (int, float):
        try:
            if repr(kind(text)) == text:  # not the name 007, nor any other that is more than its number
                return kind(text)
        except ValueError:
            pass
    return text or None
