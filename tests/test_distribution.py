"""The wheel and the source distribution: their size, what they hold, and what tools of packaging say of them."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BUILT_OF = (
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "README.md",
    "hatch_build.py",
    "pyproject.toml",
    "sensor_sim",
    "todframes",
)
PACKAGES = ("todframes", "sensor_sim")
MB = 1_000_000
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)

pytestmark = pytest.mark.slow


def run(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", *map(str, arguments)], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    pytest.importorskip("build", reason="the tools of packaging are in the group dev")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in BUILT_OF:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    run("build", "--no-isolation", "-o", out, source)
    return {path.suffix: path for path in out.iterdir()}


def test_sizes(built):
    assert built[".gz"].stat().st_size <= 3 * MB
    assert built[".whl"].stat().st_size <= 1 * MB


def without_docstrings(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            node.body[0].value = ast.Constant("")
    return ast.dump(tree)


def test_the_wheel_leaves_out_docstrings_alone(built):
    with zipfile.ZipFile(built[".whl"]) as wheel:
        sources = {name: wheel.read(name).decode() for name in wheel.namelist() if name.endswith(".py")}
    assert set(sources) == {str(file.relative_to(ROOT)) for top in PACKAGES for file in (ROOT / top).rglob("*.py")}
    for name, source in sources.items():
        original = (ROOT / name).read_text(encoding="utf-8")
        assert without_docstrings(source) == without_docstrings(original), name
        assert source.count("\n") == original.count("\n"), f"{name}: lines of a traceback would be others"


def test_the_wheel_has_the_docstrings_that_python_and_commands_show(built, tmp_path):
    with zipfile.ZipFile(built[".whl"]) as wheel:
        wheel.extractall(tmp_path)
    ask = (
        "import inspect, todframes as tod, sensor_sim as ss\n"
        "for package in (tod, ss):\n"
        "    for name in package.__all__:\n"
        "        public = getattr(package, name)\n"
        "        print(package.__name__, name, inspect.getdoc(public))\n"
        "        for key, member in (vars(public).items() if inspect.isclass(public) else ()):\n"
        "            if not key.startswith('_') and inspect.isroutine(member):\n"
        "                print(name, key, inspect.getdoc(member))\n"
    )
    shown = [
        subprocess.run([sys.executable, "-c", ask], cwd=folder, capture_output=True, text=True, check=True).stdout
        for folder in (tmp_path, ROOT)
    ]
    assert "Result plot Draw the main figure." in shown[0]
    assert shown[0] == shown[1]


def test_the_tools_of_packaging_find_nothing(built):
    run("twine", "check", "--strict", *built.values())
    run("check_wheel_contents", built[".whl"])
    run("validate_pyproject", ROOT / "pyproject.toml")
    run("repo_review", ROOT)


def test_pyroma_misses_addresses_alone():
    """It misses a contact and a home page: neither has a public address yet."""
    pytest.importorskip("pyroma", reason="pyroma is in the group dev")
    text = run("pyroma", "-d", "-n", "8", ROOT)
    assert re.findall(r"Your package .* (author-email|\'url\')", text) == ["author-email", "'url'"]


def test_the_text_for_an_index_has_no_dead_link(built):
    with zipfile.ZipFile(built[".whl"]) as wheel:
        name = next(one for one in wheel.namelist() if one.endswith(".dist-info/METADATA"))
        text = wheel.read(name).decode()
    assert "## Try it" in text
    assert [link for link in re.findall(r"\]\(([^)]*)\)", text) if not link.startswith("https://")] == []
