"""The house keeps its floors and its names: import contracts of pyproject.toml, one meaning for a name."""

from __future__ import annotations

import ast
import os
from functools import cache
from itertools import pairwise
from pathlib import Path

from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parent.parent
SOURCES = sorted(path for package in ("todframes", "sensor_sim") for path in (ROOT / package).rglob("*.py"))


def test_every_room_imports_only_from_rooms_below_it(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    monkeypatch.setitem(os.environ, "COLUMNS", "200")
    status = lint_imports(config_filename="pyproject.toml", no_cache=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def test_no_class_name_means_two_things():
    """One name means one thing in the whole package, private names too."""
    homes: dict[str, list[str]] = {}
    for file in SOURCES:
        for node in ast.walk(parsed(file)):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(str(file))
    assert homes
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}


def test_constants_are_one_blank_line_apart_at_most():
    """Constants, with the sentences below them, are read in a block."""
    apart = []
    for file in SOURCES:
        nodes, lines = parsed(file).body, file.read_text(encoding="utf-8").splitlines()
        for before, after in pairwise(nodes[1:]):
            if isinstance(before, ast.Assign | ast.AnnAssign | ast.Expr) and isinstance(
                after, ast.Assign | ast.AnnAssign
            ):
                between = lines[before.end_lineno : after.lineno - 1]
                if any(not one + other for one, other in pairwise(between)):
                    apart.append(f"{file}:{after.lineno}")
    assert apart == []
