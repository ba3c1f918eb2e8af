"""The build hook of the wheel, which leaves out docstrings of internal names: 77 kB of 1.07 MB.

Docstrings of public names stay, because `help` and the commands show them. Lines keep their numbers. The source
distribution has all docstrings.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class InternalDocstrings(BuildHookInterface[Any]):
    """Put modules without docstrings of internal names into the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write these modules to a folder, and name them to the builder; an editable wheel names the originals."""
        if version == "editable":
            return
        self.folder = TemporaryDirectory()
        for package in self.build_config.packages:
            names = Path(self.root, package, "__init__.pyi").read_text(encoding="utf-8")
            public = set(re.findall(r" as (\w+)$", names, re.MULTILINE))
            for file in Path(self.root, package).rglob("*.py"):
                target = file.relative_to(self.root)
                copy = Path(self.folder.name, target)
                copy.parent.mkdir(parents=True, exist_ok=True)
                source = without_internal_docstrings(file.read_text(encoding="utf-8"), public)
                copy.write_text(source, encoding="utf-8")
                build_data["force_include"][str(copy)] = target.as_posix()

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the folder."""
        if version != "editable":
            self.folder.cleanup()


def without_internal_docstrings(source: str, public: set[str]) -> str:
    """Return a module with an empty docstring in each internal function and class."""
    lines = source.splitlines(keepends=True)
    for docstring in sorted(internal_docstrings(ast.parse(source), public), key=lambda node: -node.lineno):
        first, last = docstring.lineno - 1, (docstring.end_lineno or 0) - 1
        before, after = lines[first][: docstring.col_offset], lines[last].encode()[docstring.end_col_offset :]
        lines[first : last + 1] = [f'{before}""', *["\n"] * (last - first), after.decode()]
    return "".join(lines)


def internal_docstrings(node: ast.AST, public: set[str], *, is_public: bool = True) -> list[ast.stmt]:
    """List the docstrings of internal names in a node. A class is public if its package names it or its docstring
    has sections; a function if it has no underscore and belongs to a module or a public class.
    """
    found = []
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found += internal_docstrings(child, public, is_public=is_public)
            continue
        text, is_class = ast.get_docstring(child, clean=False), isinstance(child, ast.ClassDef)
        stays = child.name in public or "\n    ---" in (text or "")
        if not stays and text is not None and (is_class or not is_public or child.name.startswith("_")):
            found.append(child.body[0])
        found += internal_docstrings(child, public, is_public=is_class and stays)
    return found
