"""A comparison as tables: CSV files and the terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from todframes.compare_report import value_text
from todframes.comparing import AlgorithmResult
from todframes.report import scores_csv
from todframes.safe_text import csv_text
from todframes.tables import add_row, interval, new_table, number

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
    groups = list(algorithms[0]["fits"][0]["group"])
    rows: list[list[object]] = [["algorithm", "spec", *groups, *CSV_COLUMNS]]
    of_algorithm = {one["name"]: one for one in algorithms}
    for row in ratio_rows(algorithms):
        fit, one = row.get("fit", {}), of_algorithm[row["algorithm"]]
        values = [fit.get("status"), fit.get("threshold"), *(fit.get("threshold_ci95") or (None, None))]
        values += [row.get("ratio"), *(row.get("ratio_ci95") or (None, None))]
        values += [row.get("p_value"), row.get("p_value_holm"), row.get("verdict")]
        values += [one["psnr_db"], one["ssim"], one["n_clipped"], one["cpu_s"]]
        rows.append([row["algorithm"], one["spec"], *row["group"].values(), *values])
    return csv_text(rows).encode()


def compare_scores_csv(results: Sequence[AlgorithmResult], group_by: Sequence[str], level: str) -> bytes:
    """A row for each algorithm and trial, as in the `scores.csv` of `score` with the algorithm before it."""
    table: list[list[str]] = []
    for place, one in enumerate(results):
        header, *rows = csv.reader(io.StringIO(scores_csv(one.scored, group_by, level).decode(), newline=""))
        if place == 0:
            table.append(["algorithm", *header])
        table += ([one.enhancement.spec, *row] for row in rows)
    return csv_text(table).encode()


def ratio_table(algorithms: Sequence[Json], title: str) -> Table:
    """Thresholds and their ratios as a table for the terminal."""
    groups = list(algorithms[0]["fits"][0]["group"])
    level = algorithms[0]["fits"][0]["level"]
    headers = ["algorithm", *groups, f"threshold {level}", "ratio", "95 % interval", "p (Holm)", "verdict"]
    table = new_table(title, headers, left={0, len(headers) - 1})
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
        add_row(table, cells)
    return table


def measures_table(algorithms: Sequence[Json]) -> Table:
    """PSNR and SSIM beside the observer's verdict as a table for the terminal."""
    headers = ["algorithm", "PSNR (dB)", "SSIM", "the observer says", ""]
    table = new_table("Beside the usual measures", headers, left={0, 3, 4})
    for one in algorithms:
        names = " and ".join(name.upper() for name in one["disagrees"])
        verb = "disagree" if len(one["disagrees"]) > 1 else "disagrees"
        cells = [one["name"], number(one["psnr_db"]), number(one["ssim"]), one["verdict"] or "reference"]
        add_row(table, [*cells, f"{names} {verb}" if names else ""])
    return table


def enhancements_table(algorithms: Sequence[Json]) -> Table:
    """Algorithms, each with its parameters below it, for the terminal; from what `enhancements` prints."""
    headers = ["name", "what it does; what a parameter is", "default", "range", "takes", "from"]
    table = new_table("Enhancement algorithms", headers, left={0, 1, 4, 5})
    for one in algorithms:
        add_row(
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
            add_row(table, [*cells, "", ""])
    return table
