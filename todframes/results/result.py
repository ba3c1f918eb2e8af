"""The result of a command or call: its numbers, and methods that make tables, figures and files of them."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Self, TypeVar

import msgspec

from todframes import __version__
from todframes.base.errors import DataError
from todframes.base.reading import checked, read_file
from todframes.results.data import MAX_MB, SCHEMA, Body, Metadata, ResultWarning, decode, json_file
from todframes.results.wording import path_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from todframes.results.table import Table


LIBRARIES = ("numpy", "scipy", "OpenImageIO", "cv2", "skimage")

C = TypeVar("C", bound=Body)


class ResultType(NamedTuple):
    """The result of a command: title of its page, "module:class" of its content, a key that this must have."""

    title: str
    content: str = "todframes.results.thresholds:Thresholds"
    key: str = "fits"

    @property
    def body_type(self) -> type[Body]:
        """The class of the content."""
        module, _, name = self.content.partition(":")
        kind: type[Body] = getattr(import_module(module), name)
        return kind


RESULT_TYPES = {
    "score": ResultType("TOD thresholds of display frames"),
    "naked-eye": ResultType("Thresholds of the naked eye"),
    "fit": ResultType("Fitted psychometric functions"),
    "curve": ResultType("TOD curve of a sensor"),
    "compare": ResultType("Enhancements compared", "todframes.enhancement.comparison:Comparison", "algorithms"),
    "calibrate": ResultType(
        "Internal noise of people", "todframes.experiment.calibration:CalibratedPeople", "persons"
    ),
    "accuracy": ResultType("Error against run time", "todframes.studies.accuracy.report:Accuracy", "scenes"),
    "noise": ResultType("Noise of a camera", "todframes.camera.measure_noise:RecordedNoise", "noise"),
    "emva": ResultType("Noise of a camera by EMVA 1288", "todframes.camera.measure_emva:Emva", "noise"),
    "mtf": ResultType("MTF of a camera", "todframes.camera.measure_mtf:Mtf", "mtf"),
    "range": ResultType("Range in the field", "todframes.field.acquisition_range:FieldRange", "numbers"),
    "sensor-mtf": ResultType("MTF of a sensor", "sensor_sim.chain.mtf:SensorMtf", "mtf"),
    "sweep": ResultType("Designs of a sensor", "sensor_sim.sweeps.result:Sweep", "columns"),
    "mrtd": ResultType("Four bars and triangles of a sensor", "sensor_sim.four_bars.mrtd:SensorMrtd", "bars"),
    "advise": ResultType("Advice on a sensor", "sensor_sim.limits.advise:SensorAdvice", "gains"),
    "limit": ResultType("Limit of a sensor", "sensor_sim.limits.limit:SensorLimit", "limits"),
    "worth": ResultType("What enhancements are worth", "sensor_sim.limits.worth:SensorWorth", "worth"),
}
"""Results that have a page and can be read again, by command."""


class Result(Metadata, Generic[C], frozen=True, kw_only=True):
    """Result of a command or call, with methods that make text, figures, files and a page of it.

    All calls that measure or compute return one, and `load_result` reads it back. Attributes of `data` are those
    of the result too: `result.thresholds` is `result.data.thresholds`.

    Attributes
    ----------
    data : Body
        The numbers of the command; its fields are keys in `result.json`, among them `settings`.
    warnings : tuple of ResultWarning
        Facts that make the numbers less certain.
    command, version, seed, run_time_s
        How the numbers were made.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.score("sample_frames/naked_eye")
    >>> [(one.group["size_mrad"], round(one.threshold, 3)) for one in result.thresholds]
    [(0.6, 0.305), (0.9, 0.163), (1.4, 0.104), (2.4, 0.071)]
    """

    data: C

    @classmethod
    def made(
        cls,
        command: str,
        started: float,
        *,
        seed: int | None = None,
        warnings: Iterable[ResultWarning] = (),
        data: Body | None = None,
        **content: Any,
    ) -> Result[Any]:
        """Return a new result of a command, with the run time since `started` and the versions of libraries.

        `data` stands for `content` where the command is not one of `RESULT_TYPES`.
        """
        used = {name: sys.modules[name].__version__ for name in LIBRARIES if name in sys.modules}
        return Result(
            schema=SCHEMA,
            command=command,
            version=__version__,
            versions={"python": platform.python_version(), "todframes": __version__, **used},
            run_time_s=round(time.perf_counter() - started, 4),
            date=time.strftime("%Y-%m-%d"),
            seed=seed,
            warnings=tuple(warnings),
            data=RESULT_TYPES[command].body_type(**content) if data is None else data,
        )

    def holding(self, **values: Any) -> Self:
        """Return a copy whose `data` has values for which JSON has no room."""
        data = msgspec.structs.replace(self.data)
        data.__dict__.update(values)
        return msgspec.structs.replace(self, data=data)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.data, name)

    @property
    def title(self) -> str:
        """The title of the page."""
        return RESULT_TYPES[self.command].title if self.command in RESULT_TYPES else self.command

    def __repr__(self) -> str:
        return f"<Result of {self.command}: {' '.join(self.data.sentences())}>"

    def _repr_html_(self) -> str:
        from todframes.results.html import notebook_page

        return notebook_page(self.data.sentences(), self.data.tables(), self.data.figures())

    def table(self) -> Table:
        """Return the main table."""
        return self.data.table()

    def to_dataframe(self) -> DataFrame:
        """Return the main table as a pandas DataFrame; an interval becomes two columns.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        return self.data.table().to_dataframe()

    def to_csv(self) -> str:
        """Return the main table as the text of a CSV file; columns as in `to_dataframe`."""
        return self.data.table().csv()

    def summary(self) -> str:
        """Return the findings and warnings as sentences, a line each, as the page states them."""
        from todframes.results.wording import warning_text

        warnings = (f"warning: {warning_text(warning.group, warning.message)}" for warning in self.warnings)
        return "\n".join([*self.data.sentences(), *warnings])

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
        from todframes.results.figure import drawn

        for figure in self.data.figures():
            return drawn(figure.draw, ax)
        raise DataError(f"plot: the result of {self.command} has nothing to draw")

    def to_json(self) -> bytes:
        """Return the result as indented JSON, the content of `result.json` but for the names of `files`."""
        return json_file(self._object())

    def _object(self) -> dict[str, Any]:
        head: dict[str, Any] = msgspec.to_builtins(
            Metadata(**{name: getattr(self, name) for name in Metadata.__struct_fields__})
        )
        content: dict[str, Any] = msgspec.to_builtins(self.data)
        return head | content

    def to_html(self, name: str = "") -> str:
        """Return the result as one self-contained HTML page, the content of `report.html`.

        Parameters
        ----------
        name : str
            Text below the title. Default: the name of what was measured.
        """
        from todframes.results.html import page

        return page(self.title, name or path_name(self.data.name), self, self.data)

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the content of all files by name: tables, pictures, `report.html`, `result.json`.

        Long tables come in parts, each made when it is asked for.
        """
        files: dict[str, bytes | Iterable[bytes]] = {
            **self.data.files(),
            **{drawn.file: drawn.png() for drawn in self.data.figures() if drawn.file},
            self.data.page_file: self.to_html().encode(),
        }
        return files | {self.data.json_file: json_file(self._object() | {"files": sorted(files)})}

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
def load_result(path: Path | str) -> Result[Any]:
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
    result.data.found_in(path.parent)
    return result


def read_result(content: bytes, where: str) -> Result[Any]:
    """Return a result decoded from its JSON and checked.

    Raises
    ------
    DataError
        If it is not JSON, has another schema or is of another command, or lacks a key that its page needs. The
        message begins with `where`.
    """
    head = decode(content, where, Metadata)
    if head.schema != SCHEMA:
        raise DataError(f"{where}: schema: found {head.schema}, expected {SCHEMA}")
    kind = RESULT_TYPES.get(head.command)
    if kind is None:
        raise DataError(f"{where}: command: found {head.command!r}, expected one of {', '.join(RESULT_TYPES)}")
    data = decode(content, where, kind.body_type)
    if not getattr(data, kind.key):
        raise DataError(f"{where}: {kind.key}: found none, expected at least one")
    data.check(where)
    return Result(**msgspec.structs.asdict(head), data=data)
