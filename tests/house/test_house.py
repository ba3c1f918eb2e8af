"""The house keeps its floors and its names: import contracts of pyproject.toml, one meaning for a name."""

from __future__ import annotations

import ast
import os
from pathlib import Path

from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[2]
SOURCES = sorted(path for package in ("todframes", "sensor_sim") for path in (ROOT / package).rglob("*.py"))


def test_every_room_imports_only_from_rooms_below_it(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    monkeypatch.setitem(os.environ, "COLUMNS", "200")
    status = lint_imports(config_filename="pyproject.toml", no_cache=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_no_class_name_means_two_things():
    """One name means one thing in the whole package, private names too."""
    homes: dict[str, list[str]] = {}
    for file in SOURCES:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(str(file))
    assert homes
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}
