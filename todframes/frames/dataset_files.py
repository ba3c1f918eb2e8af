"""Writing of a dataset: `manifest.csv` and `dataset.toml` beside frames, and checksums into its manifest."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from todframes.base.errors import DataError, OutputError
from todframes.base.reading import toml_text
from todframes.base.safe_text import FORMULA_STARTS, csv_text, in_utf8
from todframes.frames.dataset import MANIFEST_FILE, SCHEMA, SETTINGS_FILE, Dataset, Experiment

BYTE_ORDER_MARK = "\ufeff"


def write_dataset_files(
    folder: Path,
    rows: Iterable[Mapping[str, object]],
    *,
    display: Mapping[str, object],
    experiment: Experiment,
    comment: str,
) -> int:
    """Make a folder of frames a dataset; return the number of rows of its manifest. The folder has the table of
    luminances that `display`, made by `table_of_display`, may name. All rows, one a frame, have the columns of the
    first, in its order. Texts are marked as by `csv_text`; a name of a frame that a spreadsheet would compute gets
    `./` and stays a name. The lines of `comment` stand above the tables.
    """
    n_rows = 0
    with (folder / MANIFEST_FILE).open("w", encoding="utf-8", newline="") as file:
        for row in rows:
            name = str(row["frame"])
            values = {**row, "frame": f"./{name}" if name.startswith(FORMULA_STARTS) else name}.values()
            file.write(in_utf8(csv_text([values] if n_rows else [row, values])))  # names may be no UTF-8
            n_rows += 1
    of_experiment: dict[str, object] = {"level": experiment.level, "group_by": list(experiment.group_by)}
    content = {"schema": SCHEMA, "display": display, "experiment": of_experiment}
    (folder / SETTINGS_FILE).write_text(in_utf8(toml_text(content, comment=comment)), encoding="utf-8")
    return n_rows


def check_writable(dataset: Dataset) -> None:
    """Raise OutputError if the manifest cannot be replaced: its folder is not writable."""
    path = _manifest(dataset)
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written (its folder is not writable)")


def write_sha256(dataset: Dataset, sha256_of: Mapping[str, str]) -> None:
    """Write checksums into the empty `sha256` fields of the manifest, of each frame by its path there. The file is
    replaced whole or not at all. All other fields, the order of rows and columns and the line ends stay as they
    are. A manifest without a column `sha256` gets it as its last column. Raises DataError if the manifest has
    changed since the dataset was loaded, and OutputError if it cannot be written.
    """
    if not sha256_of:
        return
    from todframes.base.output import write_file

    path = _manifest(dataset)
    try:
        text = path.read_bytes().decode()
        content = _filled(text, sha256_of)
    except (OSError, ValueError, LookupError, csv.Error):
        raise DataError(
            f"{path}: was changed while its frames were checked, nothing was written; try again"
        ) from None
    write_file(path, content.encode())


def _manifest(dataset: Dataset) -> Path:
    """Return the path of the manifest, with symbolic links resolved."""
    return Path(os.path.realpath(dataset.path / MANIFEST_FILE))


def _filled(text: str, sha256_of: Mapping[str, str]) -> str:
    """Return a manifest's text with its empty `sha256` fields filled; LookupError if a frame has no checksum."""
    mark = BYTE_ORDER_MARK if text.startswith(BYTE_ORDER_MARK) else ""
    header, *rows = csv.reader(io.StringIO(text.removeprefix(mark), newline=""), strict=True)
    names = [name.strip() for name in header]
    if "sha256" not in names:
        for row in filter(None, [header, *rows]):  # an empty line stays empty
            row.append("")
        header[-1] = "sha256"
        names.append("sha256")
    at_frame, at_sha256 = names.index("frame"), names.index("sha256")
    for row in filter(None, rows):
        if not row[at_sha256].strip():
            row[at_sha256] = sha256_of[row[at_frame].strip()]
    filled = io.StringIO()
    writer = csv.writer(filled, lineterminator="\r\n" if text.partition("\n")[0].endswith("\r") else "\n")
    writer.writerows([header, *rows])
    return mark + filled.getvalue()
