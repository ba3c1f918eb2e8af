"""Results as people and programs read them: one JSON object, CSV, plots, a table on the terminal."""

from __future__ import annotations

import csv
import io
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from todframes import __version__
from todframes.errors import OutputError
from todframes.psychometric import PsychometricFit, weibull
from todframes.scoring import ScoredDataset
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

Json = dict[str, Any]

SCHEMA = 1


def fit_object(group: Mapping[str, float | str], level: str, fit: PsychometricFit) -> Json:
    """A fit as it stands in `result.json`."""
    return {"group": dict(group), "level": level, **msgspec.to_builtins(fit)}


def result_object(
    command: str, *, settings: Json, seed: int | None, fits: Sequence[Json], run_time_s: float, **more: Any
) -> Json:
    """The object that `--json` prints and `result.json` holds."""
    return {
        "schema": SCHEMA,
        "command": command,
        "version": __version__,
        "settings": settings,
        "seed": seed,
        "fits": list(fits),
        **more,
        "run_time_s": round(run_time_s, 4),
    }


def encode(result: Json) -> bytes:
    """Indented JSON with a final line break; what is not a number becomes null."""
    return msgspec.json.format(msgspec.json.encode(result), indent=2) + b"\n"


def scores_csv(scored: ScoredDataset, group_by: Sequence[str], level: str) -> bytes:
    """A row a trial: what was shown, the four scores, the probability of each answer, the answer."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    shown = list(dict.fromkeys(["orientation", "size_mrad", "polarity", level, *group_by]))
    writer.writerow(
        ["trial", "n_frames", *shown, "displacement_x_samples", "displacement_y_samples"]
        + [f"score_{orientation}" for orientation in ORIENTATIONS]
        + [f"p_{orientation}" for orientation in ORIENTATIONS]
        + ["answer", "p_correct"]
    )
    for place, trial in enumerate(scored.trials):
        values: dict[str, object] = dict(zip(group_by, trial.group, strict=True))
        values |= {
            "orientation": trial.orientation.value,
            "size_mrad": trial.stimulus.size_mrad,
            "polarity": trial.stimulus.polarity,
            level: trial.level,
        }
        numbers = [*scored.displacement_samples[place], *scored.scores[place], *scored.probabilities[place]]
        writer.writerow(
            [trial.name, len(trial.frames), *(values[name] for name in shown)]
            + ["" if number != number else repr(float(number)) for number in numbers]
            + [ORIENTATIONS[scored.answers[place]].value, repr(float(scored.p_correct[place]))]
        )
    return text.getvalue().encode()


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` whose files move into it, all of them, if the block ends well.

    Made at once, so that a place that cannot be written is found before the work and not after it.

    Raises
    ------
    OutputError
        If the place cannot be written.
    """
    staging: Path | None = None
    try:
        try:
            if path.exists() and not path.is_dir():
                raise OutputError(f"{path}: is a file, expected a folder or a new name")
            if path.is_dir() and not os.access(path, os.W_OK | os.X_OK):
                raise OutputError(f"{path}: the folder is not writable")
            parent = path.absolute().parent
            if not parent.is_dir():
                raise OutputError(f"{path}: {parent} is not a folder")
            staging = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=parent))
            yield staging
            path.mkdir(exist_ok=True)
            for file in sorted(staging.iterdir()):
                file.replace(path / file.name)
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        if staging is not None:
            shutil.rmtree(staging, ignore_errors=True)


def group_label(group: Mapping[str, float | str]) -> str:
    """A group in a few words."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in group.items()
    )


def number(value: float | None, digits: int = 4) -> str:
    """A number for a person: so many significant digits, a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}g}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """An interval for a person; an open end is shown as such."""
    if bounds is None:
        return "–"
    low, high = ("?" if bound is None else number(bound) for bound in bounds)
    return f"{low} – {high}"


def threshold_table(result: Json, title: str) -> Table:
    """The thresholds of a result as a table for the terminal."""
    from rich.table import Table

    fits = result["fits"]
    table = Table(title=title, title_justify="left", title_style="bold")
    names = list(fits[0]["group"]) if fits else []
    for name in names:
        table.add_column(name, justify="right")
    level = fits[0]["level"] if fits else "level"
    numerical = any("threshold_numerical_error" in fit for fit in fits)
    headers = [f"threshold {level}", "numerical error" if numerical else "95 % interval", "status"]
    if not numerical:
        headers += ["α", "β", "δ", "trials"]
    for header in headers:
        table.add_column(header, justify="left" if header == "status" else "right")
    for fit in fits:
        cells = [number(value) if isinstance(value, float) else str(value) for value in fit["group"].values()]
        cells.append(number(fit["threshold"]))
        if numerical:
            error = fit["threshold_numerical_error"]
            cells += ["–" if error is None else f"± {error:.1g}", fit["status"]]
        else:
            cells += [interval(fit["threshold_ci95"]), fit["status"]]
            cells += [number(fit[name], 3) for name in ("alpha", "beta", "delta")] + [str(fit["n_trials"])]
        table.add_row(*cells)
    return table


def plots(result: Json) -> dict[str, bytes]:
    """PNG pictures of a result by file name: the psychometric functions, and the TOD curve if there is one."""
    from matplotlib import use

    use("agg")
    pictures = {"psychometric.png": _png(_psychometric_figure(result["fits"]))}
    sizes = _size_column(result["fits"])
    if sizes is not None:
        pictures["tod_curve.png"] = _png(_tod_figure(result["fits"], sizes))
    return pictures


def _size_column(fits: Sequence[Json]) -> str | None:
    """The one group column that is a size, if it has at least two values with a threshold."""
    names = [name for name in (fits[0]["group"] if fits else {}) if name.startswith("size_")]
    if len(names) != 1 or len(fits[0]["group"]) != 1:
        return None
    known = [fit for fit in fits if fit["threshold"] is not None and isinstance(fit["group"][names[0]], float)]
    return names[0] if len(known) >= 2 else None


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=144, metadata={"Software": None})
    return buffer.getvalue()


def _figure() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(True, which="both", alpha=0.25)
    return figure, axes


def _tod_figure(fits: Sequence[Json], size_name: str) -> Figure:
    figure, axes = _figure()
    unit = size_name.removeprefix("size_")
    known = [fit for fit in fits if fit["threshold"] is not None]
    inverse = [1.0 / fit["group"][size_name] for fit in known]
    threshold = [fit["threshold"] for fit in known]
    axes.plot(inverse, threshold, "-", color="C0", lw=1.2, zorder=1)
    for fit, x in zip(known, inverse, strict=True):
        low, high = (fit.get("threshold_ci95") or (None, None))[:2]
        if low is not None and high is not None:
            axes.plot([x, x], [low, high], "-_", color="C0", lw=1.2)
        face = "C0" if fit["status"] == "ok" else "white"
        axes.plot(x, fit["threshold"], "o", color="C0", markerfacecolor=face)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=f"1 / size ({unit}⁻¹)",
        ylabel=f"threshold {fits[0]['level']}",
        title=f"TOD curve ({100 * fits[0]['p_correct']:g} % correct)",
    )
    _plain_ticks(axes, inverse, threshold)
    top = axes.secondary_xaxis("top", functions=(_inverse, _inverse))
    top.set_xlabel(f"size ({unit})")
    top.set_xticks([1.0 / x for x in inverse], [f"{1.0 / x:g}" for x in inverse])
    top.minorticks_off()
    return figure


def _inverse(x: np.ndarray) -> np.ndarray:
    import numpy as np

    return 1.0 / np.maximum(x, 1e-300)


def _plain_ticks(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Plain numbers at 1, 2, 5 of each decade while there are few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, values in ((axes.xaxis, x), (axes.yaxis, y)):
        if max(values) / min(values) < 1e4:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())


def _psychometric_figure(fits: Sequence[Json]) -> Figure:
    import matplotlib as mpl
    import numpy as np

    figure, axes = _figure()
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, max(len(fits), 2)))
    levels = [point["level"] for fit in fits for point in fit["points"]]
    for fit, colour in zip(fits, colours, strict=False):
        x = [point["level"] for point in fit["points"]]
        trials = [point["n_trials"] for point in fit["points"]]
        axes.scatter(
            x,
            [point["p_correct"] for point in fit["points"]],
            s=[18.0 if len(set(trials)) == 1 else 8.0 + 30.0 * n / max(trials) for n in trials],
            color=colour,
            label=group_label(fit["group"]) or "all trials",
        )
        if fit["alpha"] is not None:
            curve = np.geomspace(min(x), max(x), 200)
            parameters = {name: fit[name] for name in ("alpha", "beta")}
            p = weibull(curve, **parameters, guess_rate=fit["gamma"], lapse_rate=fit["delta"])
            axes.plot(curve, p, color=colour, lw=1.2)
    for height, style in ((fits[0]["p_correct"], "--"), (fits[0]["gamma"], ":")):
        axes.axhline(height, color="0.4", ls=style, lw=0.8)
    axes.set(
        xscale="log",
        ylim=(0.0, 1.02),
        xlabel=fits[0]["level"],
        ylabel="proportion correct",
        title="Psychometric functions",
    )
    if min(levels) < max(levels):
        _plain_ticks(axes, levels, [1.0, 1e9])
    if len(fits) <= 12:
        axes.legend(fontsize="small")
    return figure


def write_all(folder: Path, files: Iterable[tuple[str, bytes]]) -> None:
    """Write files into a folder, each on disk before the next."""
    for name, content in files:
        with (folder / name).open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
