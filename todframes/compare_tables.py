"""A comparison as tables: CSV files and the terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from todframes.compare_report import value_text
from todframes.comparing import AlgorithmResult
from todframes.report import scores_csv
from todframes.tables import interval, number

if TYPE_CHECKING:
    from rich.table import Table

Json = dict[str, Any]

CSV_COLUMNS = (
    *("status", "threshold", "threshold_low", "threshold_high", "ratio", "ratio_low", "ratio_high", "p_value"),
    *("p_value_holm", "verdict", "psnr_db", "ssim", "n_clipped", "cpu_s"),
)


def ratio_rows(algorithms: Sequence[Json]) -> list[Json]:
    """A row for each algorithm and group, and for each algorithm's groups together if there are several."""
    rows = []
    for one in algorithms:
        ratios = one["ratios"] or [{}] * len(one["fits"])
        for fit, ratio in zip(one["fits"], ratios, strict=True):
            rows.append({"algorithm": one["name"], "group": fit["group"], "fit": fit, **ratio})
        if one["overall"]:
            rows.append(
                {
                    "algorithm": one["name"],
                    "group": dict.fromkeys(one["fits"][0]["group"], "all"),
                    **one["overall"],
                }
            )
    return rows


def compare_csv(algorithms: Sequence[Json]) -> bytes:
    """A row for each algorithm and group: threshold, ratio, verdict, and the usual measures."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    groups = list(algorithms[0]["fits"][0]["group"])
    writer.writerow(["algorithm", "spec", *groups, *CSV_COLUMNS])
    of_algorithm = {one["name"]: one for one in algorithms}
    for row in ratio_rows(algorithms):
        fit, one = row.get("fit", {}), of_algorithm[row["algorithm"]]
        values = [fit.get("status"), fit.get("threshold"), *(fit.get("threshold_ci95") or (None, None))]
        values += [row.get("ratio"), *(row.get("ratio_ci95") or (None, None))]
        values += [row.get("p_value"), row.get("p_value_holm"), row.get("verdict")]
        values += [one["psnr_db"], one["ssim"], one["n_clipped"], one["cpu_s"]]
        writer.writerow(
            [row["algorithm"], one["spec"], *row["group"].values()] + ["" if v is None else v for v in values]
        )
    return text.getvalue().encode()


def compare_scores_csv(results: Sequence[AlgorithmResult], group_by: Sequence[str], level: str) -> bytes:
    """A row for each algorithm and trial, as in the `scores.csv` of `score` with the algorithm before it."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for place, one in enumerate(results):
        header, *rows = csv.reader(io.StringIO(scores_csv(one.scored, group_by, level).decode(), newline=""))
        if place == 0:
            writer.writerow(["algorithm", *header])
        writer.writerows([one.enhancement.spec, *row] for row in rows)
    return text.getvalue().encode()


def ratio_table(algorithms: Sequence[Json], title: str) -> Table:
    """Thresholds and their ratios as a table for the terminal."""
    groups = list(algorithms[0]["fits"][0]["group"])
    level = algorithms[0]["fits"][0]["level"]
    table = _table(
        title, ["algorithm"], [*groups, f"threshold {level}", "ratio", "95 % interval", "p (Holm)"], ["verdict"]
    )
    last = None
    for row in ratio_rows(algorithms):
        fit = row.get("fit")
        threshold = (
            "" if fit is None else number(fit["threshold"]) if fit["threshold"] is not None else fit["status"]
        )
        cells = [
            row["algorithm"] if row["algorithm"] != last else "",
            *map(value_text, row["group"].values()),
            threshold,
        ]
        p_value = row.get("p_value_holm")
        if "ratio" in row:
            cells += [number(row["ratio"]), interval(row["ratio_ci95"]), f"{p_value:.2g}", row["verdict"]]
        else:
            cells += ["1", "", "", "reference"]
        last = row["algorithm"]
        _add(table, cells)
    return table


def measures_table(algorithms: Sequence[Json]) -> Table:
    """PSNR and SSIM beside the observer's verdict as a table for the terminal."""
    table = _table("Beside the usual measures", ["algorithm"], ["PSNR (dB)", "SSIM"], ["the observer says", ""])
    for one in algorithms:
        names = " and ".join(name.upper() for name in one["disagrees"])
        verb = "disagree" if len(one["disagrees"]) > 1 else "disagrees"
        cells = [one["name"], number(one["psnr_db"]), number(one["ssim"]), one["verdict"] or "reference"]
        _add(table, [*cells, f"{names} {verb}" if names else ""])
    return table


def _table(title: str, names: Sequence[str], numbers: Sequence[str], words: Sequence[str]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    # Text, not str: names are data, and rich would take brackets in them for markup.
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for headers, side in ((names, "left"), (numbers, "right"), (words, "left")):
        for header in headers:
            table.add_column(Text(header), justify="left" if side == "left" else "right", no_wrap=True)
    return table


def _add(table: Table, cells: Sequence[str]) -> None:
    from rich.text import Text

    table.add_row(*map(Text, cells))


def enhancements_table(algorithms: Sequence[Json]) -> Table:
    """Algorithms, each with its parameters below it, for the terminal; from what `enhancements` prints."""
    headers = ["name", "what it does; what a parameter is"], ["default", "range"], ["takes", "from"]
    table = _table("Enhancement algorithms", *headers)
    for one in algorithms:
        _add(
            table,
            [
                one["name"],
                one["what"],
                "",
                "",
                one["domain"].replace("_", " ") + "s" * (one["domain"] == "code_value"),
                one["library"],
            ],
        )
        for parameter in one["parameters"]:
            default, unit = parameter["default"], parameter["unit"]
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = parameter["choices"] or [f"{end:g}" for end in parameter["range"] or ()]
            joined = (", " if parameter["choices"] else " – ").join(map(str, span))
            cells = [
                f"  {parameter['name']}",
                parameter["what"] or "",
                shown + (f" {unit}" if unit else ""),
                joined,
            ]
            _add(table, [*cells, "", ""])
    return table
