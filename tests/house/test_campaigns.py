"""The campaigns of `tests/campaigns` run, with small numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "campaigns"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.weekly,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]


def campaign(script: str, *arguments: object) -> tuple[int, str, str]:
    """Run a campaign; return its status and what it prints."""
    ended = subprocess.run(
        [sys.executable, FOLDER / script, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=600,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        check=False,
    )
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.parametrize(
    ("command", "end"),
    [
        ("fuzz.py 60 --seed 3", "60 cases, 0 faults"),
        ("fuzz.py 40 --seed 3 --only recording", "40 cases, 0 faults"),
        ("kills.py 1 --long 160", "kills: 1 of the client"),
        ("slanted.py 40 --only gaussian_0.8,_5", "1 edges: the band holds 9"),
        ("slanted.py 40 --only gaussian_0.8,_5 --shared interpolated", "1 edges: the band holds 9"),
        ("slanted.py 40 --only gaussian_0.8,_5 --shared smoothed", "1 edges: the band holds 9"),
        ("backdrops.py clean 8 --seed 2", "0 of 8 good datasets have a warning"),
        ("backgrounds.py 40 --only 8_scenes,_effects_differ", "of 40 ratios cover"),
        ("two_cameras.py 8 --only same", "called different"),
        ("coverage.py 400", "'covered': 0.9"),
        ("coverage.py 400 --free lapse --lapses 0.03", "'covered': 0.9"),
        ("coverage.py 400 --observer csf --noise 0.1", "'covered': 0.9"),
        ("field_ranges.py tables 300", "P 0.5, 1.6396 km: held 9"),
    ],
)
def test_a_campaign_finds_no_fault(command: str, end: str) -> None:
    status, out, err = campaign(*(word.replace("_", " ") if "," in word else word for word in command.split()))
    assert status == 0, out + err
    assert end in out


def test_what_commands_print_is_compared(tmp_path: Path) -> None:
    (tmp_path / "inputs").mkdir()
    counts = tmp_path / "inputs" / "counts.csv"
    counts.write_text("level,n_correct,n_trials\n0.05,8,30\n0.1,15,30\n0.2,24,30\n0.4,29,30\n")
    case = (tmp_path, "--only", "fit counts.csv")
    assert campaign("freeze.py", "keep", *case)[0] == 0
    assert campaign("freeze.py", "compare", *case)[1] == "1 cases, 0 differ\n"
    counts.write_text(counts.read_text().replace("24", "25"))
    assert "1 cases, 1 differ" in campaign("freeze.py", "compare", *case)[1]
