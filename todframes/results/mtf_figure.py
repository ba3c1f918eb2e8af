"""Figure of an MTF: curves over frequency, bands, and the frequencies that are marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import Json
from todframes.results.figure_style import INK, label_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, kw_only=True)
class MtfLine:
    """A curve of the figure: name in the legend, values, band if it has one, and style for matplotlib's `plot`."""

    label: str
    mtf: ArrayLike
    band: tuple[ArrayLike, ArrayLike] | None = None
    style: Mapping[str, Any] = field(default_factory=lambda: {})  # noqa: PIE807 - its type is known


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
    """Draw MTFs up to a frequency, with a dotted line at each marked frequency below it.

    Parameters
    ----------
    axes : matplotlib Axes
    frequency : array_like (n,)
    lines : sequence of MtfLine
        Curves with values at these frequencies.
    end : float
        Highest frequency that is shown.
    marks : mapping of str to float
        Names of frequencies.
    xlabel, ylabel : str
    """
    places = np.asarray(frequency)
    shown = places <= end
    for line in lines:
        style: Json = {"lw": 1.3, **line.style}
        axes.plot(places[shown], np.asarray(line.mtf)[shown], label=label_text(line.label), **style)
        if line.band is not None:
            low, high = (np.asarray(one)[shown] for one in line.band)
            axes.fill_between(places[shown], low, high, color=style.get("color"), alpha=0.2, lw=0.0)
    axes.axhline(0.0, color=INK, lw=0.6)
    axes.set(xlabel=xlabel, ylabel=ylabel, xlim=(0.0, end))
    for name, place in marks.items():
        if place < end:
            axes.axvline(place, color=INK, ls=":", lw=1.0)
            axes.annotate(
                f"{name} {place:.3g}",
                (place, 1.0),
                (3, -2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                va="top",
                fontsize="small",
            )
    axes.legend(frameon=True, framealpha=1.0, edgecolor="none").set_in_layout(False)
