"""Figure and tables of an MTF: CSV with frequencies in pixels, mrad or mm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError
from todframes.base.reading import check_columns, read_table
from todframes.results.figures import INK, label_text
from todframes.results.wording import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FrequencyUnit = Literal["cyc_per_pixel", "cyc_per_mrad", "cyc_per_mm"]

UNITS: dict[FrequencyUnit, str] = {unit: unit.replace("cyc_per_", "cycles/") for unit in get_args(FrequencyUnit)}

FREQUENCIES = {f"frequency_{unit}": unit for unit in UNITS}
"""Columns of the frequency, of which a table has one, and their units."""

RADIAL, DIRECTIONS = "mtf", ("mtf_tangential", "mtf_sagittal")
"""Columns of the MTF: a table has the first, or both others, or all."""

BAND = ("mtf_lower", "mtf_upper")
"""Columns of the ends of the 95 % band of `RADIAL`, which a table may have."""

LARGEST_END = 0.05
"""MTF at the last frequency above which a table stops early: what follows may be a visible part of an edge."""

NYQUIST_CYC_PER_PIXEL = 0.5

LIMITING_MTF = 0.1
"""MTF at the limit of resolution, as in ISO 12233 and ISO 16505."""

Ends = tuple[float | None, float | None]
"""Ends of a 95 % interval; None where the data do not give one."""


@dataclass(frozen=True, slots=True, eq=False)
class MtfTable:
    """An MTF at two or more ascending frequencies >= 0, shape (n,).

    The curves by column are "mtf", or "mtf_tangential" and "mtf_sagittal", or all three; or those of edges by
    their names. None is negative. `band` has the lower and the upper end of the 95 % band of "mtf", if it has one.
    """

    unit: FrequencyUnit
    frequency: FloatArray
    curves: dict[str, FloatArray]
    band: Sequence[FloatArray] = ()

    @property
    def end_mtf(self) -> float:
        """The largest MTF at the last frequency."""
        return max(float(curve[-1]) for curve in self.curves.values())

    @property
    def stops_early(self) -> bool:
        """Whether the MTF at the last frequency is above `LARGEST_END`: what follows is not known."""
        return self.end_mtf > LARGEST_END

    @property
    def end_cost(self) -> float:
        """Largest change of a sample at an edge, relative to its contrast, by what follows the last frequency f.

        Behind an edge that is ∫ MTF/(πf) df at most; it falls as 1/f if a detector's does.
        """
        return self.end_mtf / math.pi


def crossing_frequency(value: float, frequency: FloatArray, mtf: FloatArray) -> float | None:
    """Return the first frequency at which an MTF falls to a value, between its own; None if it stays above."""
    below = np.flatnonzero(mtf < value)
    if not len(below) or below[0] == 0:
        return None
    k = int(below[0])
    share = (mtf[k - 1] - value) / (mtf[k - 1] - mtf[k])
    return float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))


def with_ends(name: str, values: Sequence[float | None]) -> Json:
    """Return a value of an MTF and, in the key with `_ci95`, those of the ends of its band, None without them."""
    first, *ends = values or [None]
    return {name: first, f"{name}_ci95": ends or None}


class Resolution(NamedTuple):
    """Limit of resolution of an MTF before sampling, in the unit of its frequencies; None where it is not known.

    `mtf10` is the frequency at which the MTF falls to 0.1, `limit` the smaller one of it and Nyquist. A pattern
    beyond Nyquist appears at the sampling frequency less its own: down to `aliased_from`, None if there is none.

    Imatest 2017, "Measuring MTF with wedges: pitfalls and best practices", for ISO 16505: the third limit there,
    the onset of aliasing, is where fewer bars of a wedge are counted. Patterns below Nyquist keep their frequency.
    """

    mtf10: float | None
    limit: float | None
    aliased_from: float | None

    @classmethod
    def of(cls, frequency: FloatArray, mtf: FloatArray, nyquist: float | None) -> Resolution:
        """Return the resolution of an MTF; without a Nyquist frequency it has MTF10 alone."""
        mtf10 = crossing_frequency(LIMITING_MTF, frequency, mtf)
        if mtf10 is None or nyquist is None:
            return cls(mtf10, nyquist if nyquist is not None and frequency[-1] >= nyquist else None, None)
        return cls(mtf10, min(mtf10, nyquist), max(2.0 * nyquist - mtf10, 0.0) if mtf10 > nyquist else None)

    def sentences(self, unit: str, nyquist: float, within: str = "", across_px: float | None = None) -> list[str]:
        """Return MTF10 `within` its interval, the limit of resolution, and effective pixels, in words."""
        texts = []
        if self.mtf10 is not None:
            texts.append(f"MTF10 {plain(self.mtf10, 3)}{within} {unit}.")
        if self.aliased_from is not None:
            texts.append(f"Patterns beyond Nyquist are aliased, down to {plain(self.aliased_from, 3)} {unit}.")
        if self.limit is not None:
            share, name = self.limit / nyquist, "MTF10" if self.limit == self.mtf10 else "Nyquist"
            across = f", the {across_px / share:.0f} across the frame {across_px:.0f}" if across_px else ""
            texts.append(
                f"{name} limits the resolution: 100 pixels are {plain(100 * share, 3)} effective{across}."
            )
        return texts


class EdgeRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An edge in one colour, as in `edges.csv`.

    `normal_deg` is the direction in which the MTF is measured, from dark to bright: 0 is right, 90 is down.
    `bend_px` is the largest distance of the edge from a straight line, `dark` and `bright` the levels beside it,
    and the noise that of a pixel in percent of the contrast. Overshoot and undershoot say how far the profile,
    averaged over one pixel, goes beyond both levels, relative to the contrast; 0 where it stays between them.
    """

    edge: int
    colour: str | None = None
    x_px: int
    y_px: int
    width_px: int
    height_px: int
    angle_deg: float
    normal_deg: float
    bend_px: float
    dark: float
    bright: float
    noise_percent: float
    mtf50_cyc_per_pixel: float | None = None
    mtf50_cyc_per_pixel_ci95: Ends | None = None
    mtf_at_nyquist: float
    mtf_at_nyquist_ci95: Ends
    overshoot: float
    overshoot_ci95: Ends
    undershoot: float
    undershoot_ci95: Ends


def read_mtf_table(path: Path, *, may_exceed_1: bool = False) -> MtfTable:
    """Return the MTF in a CSV file.

    The file has one column of `FREQUENCIES`, and `mtf`, or `mtf_tangential` and `mtf_sagittal`; `mtf` may have its
    95 % band in `mtf_lower` and `mtf_upper`. With `may_exceed_1` an MTF above 1 is accepted, as that of a camera
    which sharpens. DataError, which names the line, if a column is missing, frequencies do not ascend, or an MTF
    is negative, above 1 by more than its error, or not 1 at frequency 0.
    """
    header, rows = read_table(path)
    if len(given := [name for name in FREQUENCIES if name in header]) > 1:
        raise DataError(f"{path}: found columns {' and '.join(given)}, expected one of them")
    (frequency_name,) = given or [next(iter(FREQUENCIES))]
    needed = [RADIAL] if RADIAL in header or not set(DIRECTIONS) & set(header) else []
    needed += DIRECTIONS if set(DIRECTIONS) & set(header) else []
    needed += BAND if set(BAND) & set(header) and RADIAL in header else []
    check_columns(header, [frequency_name], path)
    check_columns(header, needed, path)
    lines = [(f"{row.where}:", row.numbers((frequency_name, *needed))) for row in rows]
    if len(lines) < 2:
        raise DataError(f"{path}: found {len(lines)} rows, expected at least two frequencies")
    frequency, *columns = np.array([values for _, values in lines]).T
    curves = dict(zip(needed, columns, strict=True))
    band = [curves.pop(name) for name in BAND if name in curves]
    table = MtfTable(FREQUENCIES[frequency_name], frequency, curves, band)
    _check(table, [where for where, _ in lines], may_exceed_1=may_exceed_1)
    return table


def _check(table: MtfTable, lines: Sequence[str], *, may_exceed_1: bool) -> None:
    """Raise DataError for values that no MTF has; `lines` begin the messages, one for each frequency."""
    frequency = table.frequency
    is_bad = (np.diff(frequency, prepend=-1.0) <= 0.0) | (frequency < 0.0)
    rules = [(is_bad, "frequency", frequency, "ascending ones of 0 or more")]
    for name, values in table.curves.items():
        error = np.full_like(values, 0.01)  # Without a band: that of a printed curve read to two decimals.
        if name == RADIAL and table.band:
            low, high = table.band
            rules.append(((values < low) | (values > high), name, values, "mtf_lower <= mtf <= mtf_upper"))
            error = np.maximum(error, values - low)
        is_bad = (frequency == 0.0) & (np.abs(values - 1.0) > error)
        rules.append((is_bad, name, values, "1 at frequency 0: divide all values by it"))
        is_bad = (values < 0.0) | (values > (math.inf if may_exceed_1 else 1.0 + error))
        expected = "0 to 1 within its error: a lens or detector has no more; was the picture sharpened?"
        rules.append((is_bad, name, values, expected))
    for is_bad, name, values, expected in rules:
        if is_bad.any():
            k = int(is_bad.argmax())
            raise DataError(f"{lines[k]} found {name} {values[k]:g}, expected {expected}")


class MtfLine(NamedTuple):
    """A curve of the figure: name in the legend, values, style for matplotlib's `plot`, band if it has one."""

    label: str
    mtf: ArrayLike
    style: Json
    band: tuple[ArrayLike, ArrayLike] | None = None


def draw_mtf(
    axes: Axes,
    frequency: ArrayLike,
    lines: Sequence[MtfLine],
    *,
    end: float,
    marks: Mapping[str, float],
    xlabel: str,
    ylabel: str,
) -> None:
    """Draw MTFs over (n,) frequencies up to `end`, with a dotted line at each marked frequency, by its name."""
    frequencies = np.asarray(frequency)
    shown = frequencies <= end
    for line in lines:
        style: Json = {"lw": 1.3, **line.style}
        axes.plot(frequencies[shown], np.asarray(line.mtf)[shown], label=label_text(line.label), **style)
        if line.band is not None:
            low, high = (np.asarray(edge)[shown] for edge in line.band)
            axes.fill_between(frequencies[shown], low, high, color=style.get("color"), alpha=0.2, lw=0.0)
    axes.axhline(0.0, color=INK, lw=0.6)
    axes.set(xlabel=xlabel, ylabel=ylabel, xlim=(0.0, end))
    for name, marked in marks.items():
        if marked < end:
            axes.axvline(marked, color=INK, ls=":", lw=1.0)
            axes.annotate(
                f"{name} {marked:.3g}",
                (marked, 1.0),
                (3, -2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                va="top",
                fontsize="small",
            )
    axes.legend(frameon=True, framealpha=1.0, edgecolor="none").set_in_layout(False)
