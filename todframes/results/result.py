"""The result of a command or call: its numbers, and methods that make tables, figures and files of them."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import msgspec
from msgspec import Struct

from todframes import __version__
from todframes.base.errors import DataError
from todframes.base.reading import checked, read_file
from todframes.results.data import MAX_MB, SCHEMA, Fit, Record, ResultWarning, decode, json_file
from todframes.results.wording import path_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from todframes.results.figures import ReportFigure
    from todframes.results.tables import Table


LIBRARIES = ("numpy", "scipy", "OpenImageIO", "cv2", "skimage")


class ResultType(NamedTuple):
    """The result of a command: title of its page, "module:class", and a key that it must have."""

    title: str
    path: str = "todframes.results.thresholds:Thresholds"
    key: str = "fits"

    @property
    def result_type(self) -> type[Result]:
        """The class of the result."""
        module, _, name = self.path.partition(":")
        kind: type[Result] = getattr(import_module(module), name)
        return kind


RESULT_TYPES = {
    "score": ResultType("TOD thresholds of display frames"),
    "naked-eye": ResultType("Thresholds of the naked eye"),
    "fit": ResultType("Fitted psychometric functions"),
    "curve": ResultType("TOD curve of a sensor"),
    "compare": ResultType("Conditions compared", "todframes.comparison.records:Comparison", "conditions"),
    "calibrate": ResultType(
        "Internal noise of people", "todframes.experiment.calibration:CalibratedPeople", "persons"
    ),
    "accuracy": ResultType("Error against run time", "todframes.studies.accuracy.measure:Accuracy", "scenes"),
    "noise": ResultType("Noise of a camera", "todframes.camera.measure_noise:RecordedNoise", "noise"),
    "emva": ResultType("Noise of a camera by EMVA 1288", "todframes.camera.measure_emva:Emva", "noise"),
    "mtf": ResultType("MTF of a camera", "todframes.camera.measure_mtf:Mtf", "mtf"),
    "camera": ResultType("A camera and its curve", "sensor_sim.films.measured_camera:MeasuredCamera", "neq"),
    "range": ResultType("Range in the field", "todframes.field.acquisition_range:FieldRange", "numbers"),
    "sensor-mtf": ResultType("MTF of a sensor", "sensor_sim.chain.mtf:SensorMtf", "mtf"),
    "sweep": ResultType("Designs of a sensor", "sensor_sim.sweeps.result:Sweep", "columns"),
    "mrtd": ResultType("Four bars and triangles of a sensor", "sensor_sim.four_bars.mrtd:SensorMrtd", "bars"),
    "advise": ResultType("Advice on a sensor", "sensor_sim.limits.advise:SensorAdvice", "gains"),
    "limit": ResultType("Limit of a sensor", "sensor_sim.limits.limit:SensorLimit", "limits"),
    "worth": ResultType("What enhancements are worth", "sensor_sim.limits.worth:SensorWorth", "worth"),
}
"""Results that have a page and can be read again, by command."""


class Result(Struct, frozen=True, kw_only=True, dict=True):
    """Result of a command or call, with methods that make text, figures, files and a page of it.

    All calls that measure or compute return one, each a class of its own with its numbers, and `load_result` reads
    it back. The attributes are the keys of `result.json`. Values for which JSON has no room, such as images, stand
    beside them; a result that was read has none.

    Attributes
    ----------
    schema : int
        Number of the form of the JSON, 1.
    command : str
        Command or call that made the result.
    version : str
        Version of todframes.
    versions : dict
        Versions of Python, todframes and the libraries that were used.
    seed : int or None
        Seed of the random draws.
    warnings : tuple of ResultWarning
        Facts that make the result less certain. A command also prints each, with `--json` on standard error.
    run_time_s : float or None
        Run time in s.
    date : str
        Day on which the result was made, such as "2026-11-24".
    settings : dict
        All settings, defaults included.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.score("sample_frames/naked_eye")
    >>> [(one.group["size_mrad"], round(one.threshold, 3)) for one in result.thresholds]
    [(0.6, 0.305), (0.9, 0.163), (1.4, 0.104), (2.4, 0.071)]
    """

    schema: int
    command: str
    version: str = "?"
    versions: Record = {}
    seed: int | None = None
    warnings: tuple[ResultWarning, ...] = ()
    run_time_s: float | None = None
    date: str = ""
    settings: Record = {}

    json_file: ClassVar[str] = "result.json"
    page_file: ClassVar[str] = "report.html"
    has_findings_in_table: ClassVar[bool] = False
    """Whether a terminal, which shows the tables, has no need of the findings in words."""

    @classmethod
    def made(
        cls,
        command: str,
        started: float,
        *,
        seed: int | None = None,
        warnings: Iterable[ResultWarning] = (),
        **content: Any,
    ) -> Self:
        """Return a new result of a command, with the run time since `started` and the versions of libraries."""
        used = {name: sys.modules[name].__version__ for name in LIBRARIES if name in sys.modules}
        return cls(
            schema=SCHEMA,
            command=command,
            version=__version__,
            versions={"python": platform.python_version(), "todframes": __version__, **used},
            run_time_s=round(time.perf_counter() - started, 4),
            date=time.strftime("%Y-%m-%d"),
            seed=seed,
            warnings=tuple(warnings),
            **content,
        )

    def holding(self, **values: Any) -> Self:
        """Return a copy with values for which JSON has no room."""
        copy = msgspec.structs.replace(self)
        copy.__dict__.update(values)
        return copy

    @property
    def thresholds(self) -> tuple[Fit, ...]:
        """All thresholds as `Fit` records; none where the command finds none."""
        return ()

    @property
    def title(self) -> str:
        """The title of the page."""
        return RESULT_TYPES[self.command].title if self.command in RESULT_TYPES else self.command

    @property
    def name(self) -> str:
        """Return the path or name of what was measured."""
        return ""

    def table(self) -> Table:
        """Return the main table, all of whose columns `to_csv` and `to_dataframe` have."""
        return self.tables()[0]

    def tables(self) -> list[Table]:
        """List the tables; a folded one is not printed, and closed on the page."""
        return []

    def findings(self) -> list[str]:
        """Return what was found in words, the answer first."""
        return []

    def advice(self) -> list[str]:
        """Return what a reader of the numbers must know or do, in words."""
        return []

    def sentences(self) -> list[str]:
        """Return the findings, and the advice about them."""
        return [*self.findings(), *self.advice()]

    def notes(self) -> list[str]:
        """Return remarks that a command prints beside its result, on standard error."""
        return []

    def remarks(self) -> list[str]:
        """Return sentences about how the numbers were made, and how exact they are."""
        return []

    def figures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        return []

    def data_files(self) -> dict[str, bytes]:
        """Return the content of the files besides figures, page and JSON, by name: tables as CSV, and others."""
        return {table.file: table.csv().encode() for table in self.tables() if table.file}

    def found_in(self, folder: Path) -> None:
        """Take what stands beside the JSON in its folder, when it is asked for."""

    def check(self, where: str) -> None:
        """Raise DataError, which begins with `where`, if what was read contradicts itself."""

    def __repr__(self) -> str:
        return f"<Result of {self.command}: {' '.join(self.sentences())}>"

    def _repr_html_(self) -> str:
        from todframes.results.html import notebook_page

        return notebook_page(self.sentences(), self.tables(), self.figures())

    def to_dataframe(self) -> DataFrame:
        """Return the main table as a pandas DataFrame; an interval becomes two columns.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        return self.table().to_dataframe()

    def to_csv(self) -> str:
        """Return the main table as the text of a CSV file; columns as in `to_dataframe`."""
        return self.table().csv()

    def summary(self) -> str:
        """Return the findings and warnings as sentences, a line each, as the page states them."""
        from todframes.results.wording import warning_text

        warnings = (f"warning: {warning_text(warning.group, warning.message)}" for warning in self.warnings)
        return "\n".join([*self.sentences(), *warnings])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the main figure.

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
            If there is nothing to draw.
        """
        from todframes.results.figures import drawn

        for figure in self.figures():
            return drawn(figure.draw, ax)
        raise DataError(f"plot: the result of {self.command} has nothing to draw")

    def to_json(self) -> bytes:
        """Return the result as indented JSON, the content of `result.json` but for the names of `files`."""
        return json_file(self)

    def to_html(self, name: str = "") -> str:
        """Return the result as one self-contained HTML page, the content of `report.html`.

        Parameters
        ----------
        name : str
            Text below the title. Default: the name of what was measured.
        """
        from todframes.results.html import page

        return page(self, name or path_name(self.name))

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name: tables, pictures, `report.html`, `result.json`."""
        files: dict[str, bytes] = {
            **self.data_files(),
            **{drawn.file: drawn.png() for drawn in self.figures() if drawn.file},
            self.page_file: self.to_html().encode(),
        }
        listed = msgspec.to_builtins(self) | {"files": sorted(files)}
        return files | {self.json_file: json_file(listed)}

    def save(self, folder: Path | str) -> None:
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


@checked
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
    result = read_result(read_file(path, most_mb=MAX_MB), str(path))
    result.found_in(path.parent)
    return result


def read_result(content: bytes, where: str) -> Result:
    """Return a result decoded from its JSON and checked.

    Raises
    ------
    DataError
        If it is not JSON, has another schema or is of another command, or lacks a key that its page needs. The
        message begins with `where`.
    """
    head = decode(content, where, Result)
    if head.schema != SCHEMA:
        raise DataError(f"{where}: schema: found {head.schema}, expected {SCHEMA}")
    kind = RESULT_TYPES.get(head.command)
    if kind is None:
        raise DataError(f"{where}: command: found {head.command!r}, expected one of {', '.join(RESULT_TYPES)}")
    result = decode(content, where, kind.result_type)
    if not getattr(result, kind.key):
        raise DataError(f"{where}: {kind.key}: found none, expected at least one")
    result.check(where)
    return result
