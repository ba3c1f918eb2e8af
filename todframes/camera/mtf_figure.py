"""Figure of an MTF: curves over frequency, bands, and the frequencies that are marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import Json
from todframes.results.figure_style import INK, label_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
