"""What every command does alike: places that cannot be written, help, and names that are no markup."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from sensor_sim.cli import cli as sensor_sim
from todframes import __version__
from todframes.cli.console import run
from todframes.cli.main import cli as todframes

SAMPLES = Path(__file__).parents[2] / "sample_frames"
NAME = r"run [/b] [red]run $run_$x^{ 50 % {run} \frac λ"
"""Markup of rich on the terminal and of TeX in a plot."""
COMMANDS = {
    "score": "{dataset} --set resamples=0",
    "compare": "{dataset} --enhance median --set resamples=40 --white 100",
    "simulate": "{sensor} --size-detectors 3 --snr 4 --trials 4",
    "curve": "{sensor} --size-detectors 4 --tolerance 0.1",
    "mtf": "{sensor}",
}
PLACES = {
    "a file": ("taken", "file, expected a folder"),
    "below a file": ("taken/out", "not a folder"),
    "below nothing": ("missing/out", "not a folder"),
    "without a name": ("", "name"),
}


@pytest.fixture
def command(make_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd):
    """Run a command of either package on good input; status, standard output, lines of standard error."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    dataset = make_dataset(NAME, contrasts=(0.5,), experiment={"group_by": ["lens"]})
    for row in dataset.rows:
        row["lens"] = NAME
    dataset.save()
    sensor = tmp_path / "SENSOR.toml"
    text = (SAMPLES / "staring_camera.toml").read_text(encoding="utf-8")
    name = next(line for line in text.splitlines() if line.startswith("name = "))
    sensor.write_text(text.replace(name, f"name = {json.dumps(NAME)}"), encoding="utf-8")

    def call(name: str, *more: str) -> tuple[int, str, list[str]]:
        words = [word.format(dataset=dataset.path, sensor=sensor) for word in COMMANDS[name].split()]
        package = todframes if name in ("score", "compare") else sensor_sim
        capfd.readouterr()
        status = run(package, [name, *words, *more])
        out, err = capfd.readouterr()
        return status, out, [line for line in err.splitlines() if not line.startswith("warning: ")]

    return call


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_place_that_can_be_no_folder_is_refused_before_the_work(command, name: str, place: str) -> None:
    out, message = PLACES[place]
    Path("taken").write_text("mine")
    status, printed, (error,) = command(name, "-o", out)
    assert (status, printed) == (2, "")
    assert re.match(f"error: .*({message})", error), error
    assert [*map(str, Path().rglob("*"))] == ["taken"] and Path("taken").read_text() == "mine"


@pytest.mark.parametrize("name", [one for one in COMMANDS if one != "simulate"])
def test_names_are_no_markup_and_nothing_is_written_unasked(command, name: str) -> None:
    status, printed, errors = command(name)
    assert status == 0, errors
    assert NAME in printed
    assert [*Path().rglob("*")] == []


@pytest.mark.parametrize("option", ["--help", "-h"])
@pytest.mark.parametrize("package", [todframes, sensor_sim], ids=["todframes", "sensor_sim"])
def test_help_and_version(package, option: str, capsys) -> None:
    for name in ("", *package.list_commands(None)):
        assert run(package, [*([name] if name else []), option]) == 0
        assert capsys.readouterr().out.startswith("Usage:")
    assert run(package, []) == 2 and "Usage:" in "".join(capsys.readouterr())
    assert run(package, ["--version"]) == 0
    assert capsys.readouterr().out.endswith(f"version {__version__}\n")
