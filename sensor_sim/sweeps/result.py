"""The result of a sweep, with its figures and files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_sim.sweeps.figures import draw_curves, draw_front, draw_map, draw_range_map, page, pictures
from sensor_sim.sweeps.tables import SweepData
from todframes.base.output import write_folder
from todframes.results.figure import drawn
from todframes.results.parquet import has_parquet, parquet_parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SweepResult(SweepData):
    """Thresholds of many designs of a sensor, with methods that make tables, figures and files of them.

    `records()` yields a dictionary for each design and size; `table()` and `to_dataframe()` have the same rows.
    `sentences()` states the findings, and `save(folder)` writes all files.

    The attributes are those of `SweepData`, among them `swept`, the numbers as arrays, `settings` and `seed`.
    """

    def plot_tod(self, ax: Axes | None = None) -> Axes:
        """Draw the TOD curves of the designs, coloured by the first varied key; returns the axes."""
        return drawn(lambda axes: draw_curves(axes, self), ax)

    def plot_map(self, size: int = 0, ax: Axes | None = None) -> Axes:
        """Draw the thresholds over the first two varied keys, at one size by its place; returns the axes."""
        return drawn(lambda axes: draw_map(axes, self, size), ax)

    def plot_range_map(self, ax: Axes | None = None) -> Axes:
        """Draw the range over the first two varied keys; returns the axes."""
        return drawn(lambda axes: draw_range_map(axes, self), ax)

    def plot_front(self, size: int = 0, ax: Axes | None = None) -> Axes:
        """Draw all designs over the first two objectives, and their trade-off front; returns the axes."""
        return drawn(lambda axes: draw_front(axes, self, size), ax)

    def save(self, folder: Path | str) -> None:
        """Write the files that the command writes with `-o`; see `todframes.Result.save`."""
        write_folder(folder, self.files())

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the content of all files by name, tables in parts; `sweep.parquet` needs pyarrow."""
        table = self.table()
        return {
            "sweep.csv": (part.encode() for part in table.csv_parts()),
            **({"sweep.parquet": parquet_parts(table)} if has_parquet() else {}),
            **{one.file: one.png() for one in pictures(self) if one.file},
            "report.html": page(self).encode(),
            "result.json": self.to_json(),
        }
