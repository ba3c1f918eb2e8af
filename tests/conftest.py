"""Fixtures that several test files use."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import pytest

from todframes.frame_writing import write_frame
from todframes.stimulus import ORIENTATIONS, coverage

PITCH_MRAD = 0.25
WHITE, BACKGROUND = 100.0, 50.0  # cd/m²


@dataclass
class DatasetFolder:
    """A dataset on disk and what its two text files hold; change that, then `save`.

    `toml` has a dict for each table. `rows` holds the manifest, a dict of texts a row, whose keys are the columns.
    """

    path: Path
    toml: dict[str, Any]
    rows: list[dict[str, str]]

    def frame(self, row: int) -> Path:
        """The file of a row's frame."""
        return self.path / self.rows[row]["frame"]

    @property
    def settings_file(self) -> Path:
        return self.path / "dataset.toml"

    @property
    def manifest_file(self) -> Path:
        return self.path / "manifest.csv"

    def save(self) -> None:
        """Write `dataset.toml` and `manifest.csv` again."""
        self.settings_file.write_text(_toml_text(self.toml), encoding="utf-8")
        text = io.StringIO()
        columns = dict.fromkeys(name for row in self.rows for name in row)
        writer = csv.DictWriter(text, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        self.manifest_file.write_text(text.getvalue(), encoding="utf-8")


class DatasetMaker(Protocol):
    """What `make_dataset` gives."""

    def __call__(
        self,
        name: str = "dataset",
        *,
        suffix: str = ".exr",
        sizes_mrad: Sequence[float] = (2.0,),
        contrasts: Sequence[float] = (0.05, 0.5),
        repeats: int = 1,
        side_px: int = 48,
        display: Mapping[str, Any] | None = None,
        experiment: Mapping[str, Any] | None = None,
        row_changes: Mapping[int, Mapping[str, str]] | None = None,
    ) -> DatasetFolder: ...


@pytest.fixture
def make_dataset(tmp_path: Path) -> DatasetMaker:
    """Factory of small valid datasets in `tmp_path`, which the arguments can make invalid.

    A frame for each size, contrast and orientation, the triangle in the middle of `side_px` × `side_px` pixels of
    0.25 mrad: half EXR in cd/m², or 16-bit PNG with `suffix=".png"`. Rows are in the order of the loops: size,
    contrast, orientation (up, right, down, left), repeat.

    `display` and `experiment` replace keys of these tables of `dataset.toml`, or add some; None takes a key away.
    `row_changes` does the same to fields of the manifest's rows, by row number from 0; text only.
    """

    def make(
        name: str = "dataset",
        *,
        suffix: str = ".exr",
        sizes_mrad: Sequence[float] = (2.0,),
        contrasts: Sequence[float] = (0.05, 0.5),
        repeats: int = 1,
        side_px: int = 48,
        display: Mapping[str, Any] | None = None,
        experiment: Mapping[str, Any] | None = None,
        row_changes: Mapping[int, Mapping[str, str]] | None = None,
    ) -> DatasetFolder:
        path = tmp_path / name
        (path / "frames").mkdir(parents=True)
        full_scale = WHITE if suffix == ".png" else 1.0
        rows = []
        for size_mrad in sizes_mrad:
            for contrast in contrasts:
                for orientation in ORIENTATIONS:
                    middle = (side_px - 1) / 2
                    triangle = coverage(
                        (side_px, side_px),
                        size_px=size_mrad / PITCH_MRAD,
                        x_px=middle,
                        y_px=middle,
                        orientation=orientation,
                    )
                    for repeat in range(repeats):
                        frame = f"frames/s{size_mrad}_c{contrast}_{orientation}_{repeat}{suffix}"
                        write_frame(path / frame, BACKGROUND / full_scale * (1.0 + contrast * triangle))
                        rows.append(
                            {
                                "frame": frame,
                                "orientation": orientation.value,
                                "size_mrad": str(size_mrad),
                                "contrast": str(contrast),
                            }
                        )
        for number, changes in (row_changes or {}).items():
            rows[number] |= changes
        tables: dict[str, dict[str, Any]] = {
            "display": {
                "eotf": "linear",
                "white_luminance_cd_m2": full_scale,
                "pixel_pitch_mrad": PITCH_MRAD,
                "background_luminance_cd_m2": BACKGROUND,
            },
            "experiment": {"level": "contrast", "group_by": ["size_mrad"]},
        }
        for table, changed in (("display", display), ("experiment", experiment)):
            tables[table] = {k: v for k, v in (tables[table] | dict(changed or {})).items() if v is not None}
        dataset = DatasetFolder(path, {"schema": 1, **tables}, rows)
        dataset.save()
        return dataset

    return make


def _toml_text(content: Mapping[str, Any]) -> str:
    """TOML of numbers, texts, and lists of them, in tables one deep."""
    tables = {name: value for name, value in content.items() if isinstance(value, dict)}
    lines = [f"{name} = {_toml_value(value)}" for name, value in content.items() if name not in tables]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    # JSON's texts, lists, true and false are TOML's too; NaN and infinity are not.
    return repr(value) if isinstance(value, float) else json.dumps(value)
