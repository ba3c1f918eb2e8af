"""Pictures of a result as PNG: psychometric functions and the TOD curve."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from todframes.figure_style import style
from todframes.figures import has_tod_curve, psychometric_figure, tod_figure
from todframes.result import read_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Json = dict[str, Any]


def group_label(group: Mapping[str, float | str]) -> str:
    """A group in a few words."""
    return ", ".join(
        f"{name} {value:.15g}" if isinstance(value, float) else f"{name} {value}" for name, value in group.items()
    )


def plots(result: Json) -> dict[str, bytes]:
    """PNG pictures of a result by file name: the psychometric functions, and the TOD curve if there is one."""
    fits = read_result(msgspec.json.encode(result), "result").fits
    with style():
        pictures = {"psychometric.png": _png(psychometric_figure(fits), "Psychometric functions")}
        if has_tod_curve(fits):
            pictures["tod_curve.png"] = _png(
                tod_figure(fits), f"TOD curve ({100 * fits[0].p_correct:g} % correct)"
            )
    return pictures


def _png(figure: Figure, title: str) -> bytes:
    figure.axes[0].set_title(title)
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=160, metadata={"Software": None})
    return buffer.getvalue()
