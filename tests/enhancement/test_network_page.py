"""The page *Does this network help?*: its commands run, and its tables are what they give."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path

import pytest

import todframes as tod
from todframes.cli.console import run
from todframes.cli.main import cli

ROOT = Path(__file__).parents[2]
HOW_TO = ROOT / "docs" / "how_to"
PAGE = (HOW_TO / "does_this_network_help.md").read_text(encoding="utf-8")

pytestmark = [pytest.mark.slow, pytest.mark.oracle]


def commands(name: str) -> list[list[str]]:
    (found,) = re.findall(rf"^```sh {name}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return [shlex.split(line) for line in found.replace("\\\n", "").splitlines()]


def rows_below(heading: str) -> dict[str, list[str]]:
    """The rows of the first table below a heading, by algorithm."""
    part = PAGE.partition(heading)[2].partition("\n\n|")[2].partition("\n\n")[0]
    cells = [[one.strip() for one in line.strip("|").split("|")] for line in part.splitlines()]
    return {row[0].strip("`"): row[1:] for row in cells[2:]}


def execute(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    program, *arguments = command
    if program == "python":
        monkeypatch.setattr(sys, "argv", arguments)
        runpy.run_path(str(HOW_TO / "network" / arguments[0]), run_name="__main__")
        return
    assert program == "todframes"
    assert run(cli, arguments) == 0


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the network and the sample frames, in which the commands run."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "sample_frames/thermal_background", "sample_frames/thermal_background")
    execute(["python", "learned_denoiser.py"], monkeypatch)
    return tmp_path


def test_from_a_model_to_a_verdict_in_three_commands(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    three = commands("three")
    assert len(three) == 3
    for command in three:
        execute(command, monkeypatch)
    result = tod.load_result(here / "verdict")
    stated = rows_below("## The verdict")
    assert [one.name for one in result.conditions] == list(stated)
    for one in result.conditions:
        psnr, ssim, ratio, interval, verdict = stated[one.name]
        # The network is learned by linear algebra, whose last digits differ between machines.
        assert one.psnr_db == pytest.approx(float(psnr), abs=0.1)
        assert one.ssim == pytest.approx(float(ssim), abs=0.01)
        assert (one.verdict or "reference") == verdict
        if one.ratios:
            low, high = map(float, interval.split(" – "))
            assert one.ratios[0].ratio == pytest.approx(float(ratio), rel=0.02)
            assert one.ratios[0].ratio_ci95 == pytest.approx((low, high), rel=0.05)


@pytest.mark.weekly
def test_on_the_noise_of_a_thermal_camera(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make, compare = commands("thermal")
    execute(make, monkeypatch)
    execute([*compare, "-o", "out"], monkeypatch)
    _, network = tod.load_result(here / "out").conditions
    ratio, interval, verdict = rows_below("## On the noise of a thermal camera")[network.name]
    low, high = map(float, interval.split(" – "))
    assert network.verdict == verdict
    assert network.psnr_db is None
    assert network.ratios[0].ratio == pytest.approx(float(ratio), rel=0.02)
    assert network.ratios[0].ratio_ci95 == pytest.approx((low, high), rel=0.05)
