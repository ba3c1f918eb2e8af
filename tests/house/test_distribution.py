"""The wheel and the source distribution: their size, what they hold, and what tools of packaging say of them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BUILT_OF = ("CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "pyproject.toml", "sensor_sim", "todframes")
MB = 1_000_000

pytestmark = pytest.mark.slow


def run(*arguments: object) -> str:
    command = [sys.executable, "-m", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
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
    assert built[".whl"].stat().st_size <= 1.1 * MB


def test_the_tools_of_packaging_find_nothing(built):
    run("twine", "check", "--strict", *built.values())
    run("check_wheel_contents", built[".whl"])
    run("validate_pyproject", ROOT / "pyproject.toml")
    run("repo_review", ROOT)


def test_pyroma_misses_an_address_alone():
    """Without that of an author, which is not public, 8 is the highest grade before an index has the package."""
    pytest.importorskip("pyroma", reason="pyroma is in the group dev")
    assert re.findall(r"(?m)^You.*", run("pyroma", "-d", "-n", "8", ROOT)) == [
        "Your package does not have author-email data."
    ]


def test_the_text_for_an_index_has_no_dead_link(built):
    with zipfile.ZipFile(built[".whl"]) as wheel:
        name = next(one for one in wheel.namelist() if one.endswith(".dist-info/METADATA"))
        text = wheel.read(name).decode()
    assert "## Try it" in text
    assert [link for link in re.findall(r"\]\(([^)]*)\)", text) if not link.startswith("https://")] == []
