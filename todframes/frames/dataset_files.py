"""Writing of a dataset: `manifest.csv` and `dataset.toml` beside frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from todframes.base.reading import toml_text
from todframes.base.safe_text import FORMULA_STARTS, csv_text, in_utf8
from todframes.frames.dataset import MANIFEST_FILE, SCHEMA, SETTINGS_FILE, Experiment


def write_dataset_files(
    folder: Path,
    rows: Iterable[Mapping[str, object]],
    *,
    display: Mapping[str, object],
    experiment: Experiment,
    comment: str,
) -> int:
    """Make a folder of frames a dataset; return the number of rows of its manifest.

    The folder has the table of luminances that `display`, made by `table_of_display`, may name. All rows, one a
    frame, have the columns of the first, in its order. Texts are marked as by `csv_text`; a name of a frame that a
    spreadsheet would compute gets `./` and stays a name. The lines of `comment` stand above the tables.
    """
    n_rows = 0
    with (folder / MANIFEST_FILE).open("w", encoding="utf-8", newline="") as file:
        for row in rows:
            name = str(row["frame"])
            values = {**row, "frame": f"./{name}" if name.startswith(FORMULA_STARTS) else name}.values()
            file.write(in_utf8(csv_text([values] if n_rows else [row, values])))  # names may be no UTF-8
            n_rows += 1
    of_experiment: dict[str, object] = {"level": experiment.level, "group_by": list(experiment.group_by)}
    if experiment.places > 1:
        of_experiment["places"] = experiment.places
    content = {"schema": SCHEMA, "display": display, "experiment": of_experiment}
    (folder / SETTINGS_FILE).write_text(in_utf8(toml_text(content, comment=comment)), encoding="utf-8")
    return n_rows
