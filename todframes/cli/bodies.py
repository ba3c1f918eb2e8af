"""The way from options to output of the commands that have their own: `chart`, `experiment` and `noise`."""

from __future__ import annotations

import re
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from todframes.base.errors import SettingsError, flag_of
from todframes.cli.console import (
    echo,
    print_content,
    print_result,
    print_sentences,
    print_table,
    progress,
    say,
    staged,
)
from todframes.cli.signature import read_call

if TYPE_CHECKING:
    from todframes.camera.measure_emva import Emva
    from todframes.camera.measure_noise import RecordedNoise

CALL = "todframes.charts.making:chart"

PAPER_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}
"""Width and height of sheets across (ISO 216)."""

OF_EMVA = {"exposure_ms", "photons"}
OF_OTHERS = {"patches", "signal", "mk_per_count", "frames_per_second"}
"""Options of one kind of measurement."""


def chart(given: dict[str, Any], shown: dict[str, Any], _: object) -> None:
    """Make the chart, and show what it has."""
    from todframes.charts import making as charts
    from todframes.charts.making import chart_remarks, chart_table

    if "paper" in given:
        given["paper_width_mm"], given["paper_height_mm"] = _paper_mm(given.pop("paper"))
    with progress("drawing", quiet=shown["quiet"]) as advance:
        try:
            made = charts.chart(**given, progress=advance)
        except SettingsError as error:
            raise SettingsError(_with_options(str(error))) from None
    print_table(chart_table(made))
    print_sentences(chart_remarks(made))
    echo(f"written: {given['out']}")


def _with_options(message: str) -> str:
    """Return a message about settings with the options of this command in place of their names in Python."""
    options = {name: flag_of(name) for name in read_call(CALL).parameters}
    options |= dict.fromkeys(("paper_width_mm", "paper_height_mm"), "--paper")
    subject, is_one, rest = re.sub(r"^(chart|screen|print|thermal): ", "", message).partition(":")
    named = {name: option for name, option in options.items() if "_" in name or name == "contrasts"}
    text = options.get(subject, subject) + is_one + rest
    return re.sub(rf"(?<![-\w])({'|'.join(named)})\b", lambda match: named[match[1]], text)


def _paper_mm(paper: str) -> tuple[float, float]:
    """Return width and height of a sheet, by name or as two numbers."""
    if paper.upper() in PAPER_MM:
        return PAPER_MM[paper.upper()]
    names = ", ".join(PAPER_MM)
    try:
        width_mm, height_mm = map(float, paper.split(","))
    except ValueError:
        raise SettingsError(f"--paper: found {paper!r}, expected {names}, or WIDTH,HEIGHT in mm") from None
    return width_mm, height_mm


def experiment(given: dict[str, Any], *_: object) -> None:
    """Serve the page, and say how far the session is."""
    from todframes.experiment.run_experiment import run_experiment
    from todframes.frames.dataset import load_dataset

    limit = {name: given.pop(name) for name in ("max_frame_mb",) if name in given}
    data = load_dataset(given.pop("dataset"), **limit)
    with ExitStack() as reading:
        advance = reading.enter_context(progress("reading"))

        def tell(address: str) -> None:
            reading.close()
            echo(address)

        result = run_experiment(data, tell=tell, warn=say, progress=advance, **given)
    rest = "" if result.n_answered == result.n_trials else "; the same command goes on"
    flagged = f", {result.n_flagged} with a flag" if result.n_flagged else ""
    answered = f"{result.n_answered} of {result.n_trials} trials"
    echo(f"{given['answers']}: subject {result.subject}, {answered}{flagged}{rest}")


def noise(given: dict[str, Any], shown: dict[str, Any], out: str | None) -> None:
    """Measure the noise of recordings, and show it."""
    as_sensor, as_json = given.pop("sensor", False), shown.pop("json")
    if as_sensor and as_json:
        raise SettingsError("noise: found --sensor and --json, expected one of them")
    is_emva = bool({"descriptor", "dark"} & given.keys())
    for name in sorted(given.keys() & (OF_OTHERS if is_emva else OF_EMVA)):
        other = "is not used with EMVA 1288" if is_emva else "needs --dark, the dark frames"
        raise SettingsError(f"{flag_of(name)}: {other}")
    if "recording" not in given and not is_emva:
        raise SettingsError("noise: found no RECORDING, expected one, or --emva DESCRIPTOR")
    import todframes as tod

    with staged(out) as write:
        with progress("reading", quiet=shown["quiet"]) as advance:
            if is_emva:
                bright = given.pop("recording", ())
                result: RecordedNoise | Emva = tod.emva_noise(bright=bright, progress=advance, **given)
            else:
                result = tod.noise(given.pop("recording"), progress=advance, **given)
        table = result.sensor_toml() if as_sensor else None
        write(result.files)
    if table is not None:
        print_content(table, result.warnings, **shown)
        return
    print_result(result, as_json=as_json, out=out, is_timed=False, **shown)
