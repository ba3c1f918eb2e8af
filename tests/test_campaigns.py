"""The campaigns of `tests/campaigns` run, with small numbers."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).parent / "campaigns" / "run.py"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.weekly,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]


def campaign(*arguments: str, script: str = "run.py") -> str:
    """Run a campaign to its good end; return what it prints."""
    process = subprocess.run(
        [sys.executable, RUN.with_name(script), *arguments],
        capture_output=True,
        text=True,
        timeout=600,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_mutated_files() -> None:
    out = campaign("mutations", "40", "--seed", "3")
    assert "40  in all, 0 faults" in out


def test_mutated_recordings() -> None:
    assert "40  in all, 0 faults" in campaign("media", "40", "--seed", "3")


def test_papers_of_a_camera() -> None:
    assert "50  in all, 0 faults" in campaign("cameras", "50", "--first", "190")


def test_bombs() -> None:
    assert "2 cases, 0 faults" in campaign("bombs", "--only", "ffv1")


def test_a_long_run() -> None:
    assert "kills: 1 of the client" in campaign("long-run", "1", "--frames", "160")


def test_faults() -> None:
    assert "1 cases, 0 faults" in campaign("faults", "--only", "store between runs: cut")


def test_slanted_edges() -> None:
    out = campaign("40", "--only", "gaussian 0.8, 5", script="slanted.py")
    assert "1 edges: the band holds 9" in out


@pytest.mark.parametrize(("part", "end"), [("--smooth", "; 0 ought to end otherwise"), ("--torn", "departs': ")])
def test_smooth_and_torn_edges(part: str, end: str) -> None:
    assert end in campaign("100", part, "--seed", "4", script="slanted.py")


@pytest.mark.parametrize(
    ("part", "n", "end"), [("clean", 8, "0 of 8 good datasets have a warning"), ("hostile", 30, "0 faults")]
)
def test_triangles_on_scenes(part: str, n: int, end: str) -> None:
    assert end in campaign(part, str(n), "--seed", "2", script="backdrops.py")


def test_clips() -> None:
    assert campaign("12", script="clips.py").endswith("\n12 cases, 0 faults\n")


def test_lenses() -> None:
    out = campaign("--k1=-0.04:-0.04", "--widths", "93", "--places", "0", script="lens_sweep.py")
    assert out.endswith("\n1 cases, 0 faults\n")


def test_servers() -> None:
    assert "6 cases, 0 faults" in campaign("servers", "--only", "ten gigabytes")


def test_damaged_networks() -> None:
    assert "5 cases, 0 faults" in campaign("networks", "5")


def test_decoys() -> None:
    assert re.search(
        "1 commands among [0-9]+ decoys, 0 faults", campaign("decoys", "--only", "sweep, two workers")
    )


def test_people_who_do_not_behave() -> None:
    pytest.importorskip("playwright.sync_api", reason="pages are driven by Playwright, of the dev extra")
    out = campaign("people", "1", "--only", "impatient")
    assert "1 people, answers by flag: 10 none, 5 too_fast; 0 faults" in out


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root may mount a disk")
def test_a_full_disk() -> None:
    assert "1 cases, 0 faults" in campaign("faults", "--only", "disk full, score")


def test_the_explorer() -> None:
    """48 states, requests held back: what the page says belongs to the state that it shows."""
    pytest.importorskip("playwright.sync_api")
    if not (shutil.which("chromium") or shutil.which("google-chrome")):
        pytest.skip("no Chromium is installed")
    assert "49 states" in campaign("explorer", "48")


def test_coverage_of_ratios_over_backgrounds() -> None:
    """Forty comparisons of a kind: a share of 93 to 97 % within chance."""
    assert "of 40 ratios cover" in campaign("40", "--only", "8 scenes, effects differ", script="backgrounds.py")


def test_coverage_of_intervals() -> None:
    """Two people are too few for a share of 93 to 98 %, which the status tells."""
    script = RUN.with_name("coverage.py")
    for arguments in (["2", "--redrawn", "--free", "lapse"], ["1", "--method", "quest", "--trials", "40"]):
        process = subprocess.run(
            [sys.executable, script, *arguments], capture_output=True, text=True, timeout=600, check=False
        )
        assert (process.returncode, process.stderr) == (1, ""), process.stderr
        assert f"n={arguments[0]}," in process.stdout and "covered=" in process.stdout


def test_what_commands_print_is_compared(tmp_path: Path) -> None:
    def freeze(what: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, RUN.with_name("freeze.py"), what, tmp_path, "--only", "fit counts.csv"]
        return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)

    (tmp_path / "inputs").mkdir()
    counts = tmp_path / "inputs" / "counts.csv"
    counts.write_text("level,n_correct,n_trials\n0.05,8,30\n0.1,15,30\n0.2,24,30\n0.4,29,30\n")
    assert freeze("keep").returncode == 0
    assert freeze("compare").stdout == "1 cases, 0 differ\n"
    counts.write_text(counts.read_text().replace("24", "25"))
    assert "1 cases, 1 differ" in freeze("compare").stdout
