"""The commands of `todframes` that are made of calls."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click

from todframes.base.errors import DataError
from todframes.base.safe_text import visible
from todframes.cli.console import (
    ProblemLines,
    check_strict,
    echo,
    print_sentences,
    say,
    terminal_width,
    warning_lines,
)
from todframes.cli.options import P_CORRECT, SETTINGS, make_fit
from todframes.cli.runner import Command

EACH = (
    "each has its own folder in the folder of -o, beside a table and a page of all, summary.csv and summary.html. "
    "One that fails is a row with its error; the status is then 1."
)
"""End of the sentence of `--help` on several paths: it states where each result goes, and what a failure does."""

FILES_SHOWN = 3
"""Number of files that do not match whose names `new` prints."""


def _scored(result: Any, given: dict[str, Any]) -> str:
    return f"{given['dataset'].path}: {sum(one.n_trials for one in result.fits)} trials"


def _compared(result: Any, _: dict[str, Any]) -> str:
    """Return the dataset of algorithms, or the verdicts on several cameras."""
    if result.is_of_algorithms:
        return f"{result.name}: {sum(one.n_trials for one in result.conditions[0].fits)} trials"
    return "\n".join(textwrap.fill(visible(verdict), terminal_width()) for verdict in result.verdict)


def _show_new(result: Any, given: dict[str, Any], _: dict[str, Any]) -> None:
    from todframes.results.wording import count

    folder, unmatched = Path(given["dataset"]), result.unmatched
    if unmatched:
        names = ", ".join(unmatched[:FILES_SHOWN]) + (", …" if len(unmatched) > FILES_SHOWN else "")
        say(f"note: {count(len(unmatched), 'file')} beside the frames without a match, left out: {names}")
    echo(f"written: {folder / 'dataset.toml'}, and {folder / 'manifest.csv'}: {count(result.n_frames, 'frame')}")
    display = given.get("display", "reference_sdr")
    echo(f"The display is {display}. Check frames, sizes and display: todframes validate {folder}")


def _show_samples(made: dict[str, int], given: dict[str, Any], _: dict[str, Any]) -> None:
    from todframes.results.wording import count

    for name, n_frames in made.items():
        echo(f"written: {Path(given['out']) / name}: {count(n_frames, 'frame')}")
    if not given.get("exact"):
        echo(f"Try: todframes score {Path(given['out']) / 'naked_eye'}")


def _make_darker(given: dict[str, Any], further: dict[str, Any]) -> None:
    if further.get("darker"):
        given["polarity"] = -1


def _show_scenes(made: Any, given: dict[str, Any], shown: dict[str, Any]) -> None:
    from todframes.backdrops.making import ROUNDING
    from todframes.results.wording import count

    def measured(contrast: float) -> str:
        return f"{contrast:.2g}" if contrast > ROUNDING else "0"

    if not shown["quiet"]:
        for note in made.notes:
            say(f"note: {note}")
    sentences = [
        f"{given['out']}: {count(made.n_frames, 'frame')} with {count(made.n_scenes, 'scene')}, {made.trials} of "
        "each size and contrast",
        "Orientation of the backgrounds by themselves: that of a triangle of contrast "
        f"{measured(made.own_orientation)}; after turning {measured(made.own_orientation_left)} (each in "
        "scenes.csv)",
    ]
    if made.dimmed < 1.0:
        sentences.insert(1, f"Scenes are dimmed to {100.0 * made.dimmed:.3g} % of their luminance.")
    print_sentences(sentences)


def _read_counts(given: dict[str, Any], further: dict[str, Any]) -> None:
    """Set the columns of the counts, and the settings of the fit."""
    given["fit"] = make_fit(further)
    import numpy as np

    from todframes.psychometrics.fit import read_counts

    curves = read_counts(Path(further["counts"]))
    columns = np.concatenate([rows for _, rows in curves]).T
    given |= dict(zip(("level", "n_correct", "n_trials"), columns, strict=True))
    given["groups"] = {name: [group[name] for group, rows in curves for _ in rows] for name in curves[0][0]}


def _open_recordings(given: dict[str, Any], _: dict[str, Any]) -> None:
    from todframes.importing.importing import check_source, open_for_import

    check_source(given.get("chart"), given.get("schedule"))
    read = ("level", "frames_per_second", "max_frame_mb")
    how = {name: given[name] for name in read if name in given}
    given["recordings"] = open_for_import(given["recordings"], given.get("schedule"), **how)


def _show_imported(done: Any, given: dict[str, Any], shown: dict[str, Any]) -> None:
    from todframes.results.data import ResultWarning
    from todframes.results.wording import count

    if not shown["quiet"]:
        for note in done.notes:
            say(f"note: {note}")
        if "chart" in given and len(given["recordings"]) > 1:
            say(f"note: {len(given['recordings'])} recordings are one dataset; --each makes a dataset of each")
        for line in warning_lines([ResultWarning(**warning._asdict()) for warning in done.warnings]):
            say(line)
    trials = f"{count(done.n_trials, 'trial')} from {count(done.n_clips, 'clip')}"
    print_sentences([f"{given['out']}: {done.n_frames} frames in {trials}"])


def _show_exported(n_trials: int, given: dict[str, Any], _: dict[str, Any]) -> None:
    echo(f"written: {Path(given['out']) / 'trials.csv'}: {n_trials} trials, with a picture each")


def _show_answers(found: Any, given: dict[str, Any], _: dict[str, Any]) -> None:
    flagged = f", {found.n_flagged} with a flag" if found.n_flagged else ""
    answered = f"{found.n_answered} answers to {found.n_trials} trials"
    echo(f"{given['folder']}: subject {found.subject}, {answered}{flagged}")


def _list_problems(given: dict[str, Any], further: dict[str, Any]) -> None:
    further["problems"] = ProblemLines()
    given["problem"] = further["problems"].add


def _show_validated(result: Any, given: dict[str, Any], shown: dict[str, Any]) -> None:
    """Print the number of problems, or what was found to be good."""
    from todframes.results.wording import count

    data, problems = given["dataset"], given["problems"]
    problems.close()
    for line in warning_lines(result.warnings):
        say(line)
    if shown["json"]:
        click.echo(result.to_json(), nl=False)
    if problems.count:
        raise DataError(f"{data.path}: {count(problems.count, 'problem')} found")
    if not shown["json"]:
        warnings, n_others = len(result.warnings), len(data.trials.unjudged_frames)
        verdict = f"all readable; {count(warnings, 'warning')}" if warnings else "all good"
        others = f" and {count(n_others, 'other')} in their clips" if n_others else ""
        echo(f"{data.path}: {data.n_frames - n_others} frames in {len(data.trials)} trials{others}, {verdict}")
        if "add_sha256" in given:
            frames = [frame for trial in data.trials for frame in trial.frames]
            n_missing = sum(frame.sha256 is None for frame in (*frames, *data.trials.unjudged_frames))
            had = f"{data.n_frames - n_missing} had one, and agree"
            echo(f"{data.path / 'manifest.csv'}: sha256 of {n_missing} frames added; {had}")
    check_strict(result.warnings, shown["strict"])


COMMANDS = {
    "calibrate": Command(
        "todframes.experiment.calibrate:calibrate",
        arguments="answers dataset",
        showing="json quiet strict",
        files="result.json, report.html, tables, a figure and observer.toml, the settings for score",
        task="scoring",
        without="internal_noise",
    ),
    "chart": Command(
        "todframes.charts.making:chart",
        arguments="",
        showing="quiet",
        further=(
            click.Option(
                ["--paper"],
                metavar="A4|A3|…|W,H",
                help="Print: size of a sheet in landscape format: A4 to A0, or width and height in mm.  "
                "[default: A3]",
            ),
        ),
        without="lut paper_width_mm paper_height_mm",
        body="todframes.cli.bodies:chart",
    ),
    "compare": Command(
        "todframes.comparison.compare:compare",
        arguments="conditions",
        showing="explain verbose json quiet strict",
        files="result.json, report.html, compare.csv, scores.csv, contrast_response.csv, bands.csv and pictures",
        task="comparing",
        title=_compared,
    ),
    "experiment": Command(
        "todframes.experiment.run_experiment:run_experiment",
        arguments="dataset",
        showing="",
        body="todframes.cli.bodies:experiment",
    ),
    "export-trials": Command(
        "todframes.experiment.other_programs:export_trials",
        arguments="dataset",
        showing="quiet",
        task="drawing",
        show=_show_exported,
    ),
    "fit": Command(
        "todframes.scoring.fit_call:fit_counts",
        arguments="",
        showing="verbose json",
        files="result.json, report.html, thresholds and their curves",
        title=lambda _, given: given["counts"],
        further=(click.Argument(["counts"], type=click.Path()), P_CORRECT, SETTINGS),
        prepare=_read_counts,
        text="COUNTS: CSV file with columns level, n_correct and n_trials; any other column names groups, with "
        "one curve each. Settings (--set) are guess_rate, lapse_rate, lapse_rate_max, p_correct and resamples.",
        without="level n_correct n_trials groups",
    ),
    "import": Command(
        "todframes.importing.importing:import_recordings",
        arguments="recordings",
        showing="quiet",
        task="importing",
        show=_show_imported,
        prepare=_open_recordings,
        further=(
            click.Option(["--each"], is_flag=True, help="Make a dataset of each RECORDING, in its folder of OUT."),
        ),
        each="recordings",
        each_if="each",
        each_kept="todframes.importing.importing:imported_before",
        text=f"Several recordings, or a pattern as 'films/*.mp4', are parts of one dataset. With --each, {EACH}",
    ),
    "import-answers": Command(
        "todframes.experiment.other_programs:import_answers",
        arguments="folder file",
        showing="",
        show=_show_answers,
    ),
    "mtf": Command(
        "todframes.camera.measure_mtf:mtf",
        arguments="recording",
        showing="json quiet strict",
        files="report.html, result.json, mtf.csv, edges.csv and pictures",
        task="reading",
        is_timed=False,
    ),
    "naked-eye": Command(
        "todframes.scoring.naked_eye:naked_eye",
        arguments="",
        showing="verbose json quiet",
        files="result.json, report.html and tod_curve.png",
        task="computing",
        title=lambda *_: "Naked eye",
    ),
    "new": Command("todframes.importing.file_names:new_dataset", arguments="dataset", showing="", show=_show_new),
    "noise": Command(
        "todframes.camera.measure_noise:noise",
        arguments="recording",
        showing="json quiet strict",
        files="result.json, report.html, tables, pictures and sensor_noise.toml",
        further=(
            click.Option(
                ["--sensor"], is_flag=True, help="Print the table [noise] of a SENSOR.toml and nothing else."
            ),
        ),
        text="With --dark or --emva it is that of EMVA 1288: gain, dark noise, nonuniformities and saturation of "
        "a linear camera, from bright and dark frames.",
        without="bright",
        also="todframes.camera.measure_emva:emva_noise",
        body="todframes.cli.bodies:noise",
    ),
    "range": Command(
        "todframes.field.acquisition_range:acquisition_range",
        arguments="result",
        showing="verbose json quiet strict",
        task="computing",
        files="result.json, report.html, ranges.csv, probability.csv and plots",
        each="result",
        text=f"With several, or a pattern as 'cameras/*.toml', {EACH}",
        details="what a tenth more of each factor gains, and the range against k",
    ),
    "sample": Command("todframes.frames.samples:sample", arguments="out", showing="", show=_show_samples),
    "scenes": Command(
        "todframes.backdrops.making:scenes",
        arguments="backgrounds",
        showing="quiet",
        task="drawing",
        show=_show_scenes,
        further=(click.Option(["--darker"], is_flag=True, help="Triangles darker than the scene."),),
        prepare=_make_darker,
        without="polarity",
    ),
    "score": Command(
        "todframes.scoring.score_call:score",
        arguments="dataset",
        showing="explain verbose json quiet strict",
        files="result.json, report.html, scores.csv and plots",
        task="scoring",
        title=_scored,
        each="dataset",
        text=f"With several datasets, or a pattern as 'cameras/*', {EACH}",
    ),
    "validate": Command(
        "todframes.scoring.validate_call:validate",
        arguments="dataset",
        showing="json strict",
        task="checking",
        show=_show_validated,
        prepare=_list_problems,
    ),
}
"""Commands by name."""
