"""The commands of `todframes`, and their entry point.

A command is made when it is asked for, and NumPy is imported when it runs.
"""

from __future__ import annotations

import re
import sys
import textwrap
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes import __version__
from todframes.base.errors import DataError, SettingsError, flag_of
from todframes.base.safe_text import visible
from todframes.cli.console import (
    ProblemLines,
    check_strict,
    echo,
    keep_libraries_to_one_thread,
    print_content,
    print_result,
    print_sentences,
    print_table,
    prints_go_to_stderr,
    progress,
    run,
    say,
    staged,
    terminal_width,
    warning_lines,
)
from todframes.cli.options import P_CORRECT, SETTINGS, make_fit, read_call
from todframes.cli.runner import Command, Commands, showing
from todframes.parameters import counted

if TYPE_CHECKING:
    from todframes.camera.measure_emva import Emva
    from todframes.camera.measure_noise import RecordedNoise


CHART_CALL = "todframes.charts.making:chart"

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


def _chart(given: dict[str, Any], shown: dict[str, Any], _: object) -> None:
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
    options = {name: flag_of(name) for name in read_call(CHART_CALL).parameters}
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


def _experiment(given: dict[str, Any], *_: object) -> None:
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


def _noise(given: dict[str, Any], shown: dict[str, Any], out: str | None) -> None:
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
        CHART_CALL,
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
        body=_chart,
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
        body=_experiment,
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
        body=_noise,
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


@click.group(
    cls=Commands,
    table=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="todframes")
def cli() -> None:
    """How small or faint may a triangle get before a display chain hides where it points?

    Shows the display frames (EXR, PNG) of a Triangle Orientation Discrimination test to a model observer and
    reports the thresholds. Angles are in mrad, luminance in cd/m², contrast is Weber contrast.
    """


RECORDED = "recorded"
"""Name of the scene that needs a dataset."""


@cli.command(params=[*showing("json")])
def enhancements(*, json: bool) -> None:
    """List the enhancement algorithms that are registered, with their parameters."""
    import msgspec

    from todframes import __version__
    from todframes.enhancement.finding import (
        enhancement_names,
        enhancement_record,
        enhancements_table,
        find_enhancement,
    )
    from todframes.results.data import SCHEMA

    algorithms = []
    for name in enhancement_names():
        try:
            with prints_go_to_stderr():
                algorithms.append(find_enhancement(name))
        except SettingsError as error:  # raised by an algorithm of another package
            say(f"left out: {error}")
    listed = [enhancement_record(algorithm) for algorithm in algorithms]
    if not json:
        print_table(enhancements_table(listed))
        return
    result = {"schema": SCHEMA, "command": "enhancements", "version": __version__, "enhancements": listed}
    click.echo(msgspec.json.format(msgspec.json.encode(result), indent=2))


@cli.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
@click.option("--title", default="", metavar="TEXT", help="Text below the title.  [default: name of the dataset]")
def report_command(*, result: Path, out: str | None, title: str) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.base.output import write_file
    from todframes.base.reading import read_file
    from todframes.results.data import MAX_MB
    from todframes.results.result import read_result

    try:
        read = read_result(read_file(result, most_mb=MAX_MB), str(result))
        made = read.to_html(title).encode()
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name(read.page_file)
    write_file(path, made, not_over=result)
    echo(f"written: {path}")


@cli.command(params=[*showing("json quiet")])
@click.option("--markdown", "as_markdown", is_flag=True, help="Print all cases as a page of Markdown.")
def stability(*, json: bool, as_markdown: bool, quiet: bool) -> None:
    """Try extreme inputs: the expected value and its source, the computed value, and the number of right digits.

    Ends with status 1 if a case keeps fewer digits than required.
    """
    start = time.perf_counter()
    if json and as_markdown:
        raise SettingsError("stability: found --json and --markdown, expected one of them")
    from todframes.studies.stability.cases import (
        Stability,
        find_cases,
        markdown,
        outcome_table,
        run_case,
        shortfall,
    )

    cases = find_cases()
    with progress("trying", quiet=quiet) as advance:
        outcomes = [run_case(case) for case in counted(cases, len(cases), advance)]
    if json:
        result = Stability.made("stability", start, cases=tuple(outcomes))
        click.echo(result.to_json(), nl=False)
    elif as_markdown:
        click.echo(markdown(outcomes), nl=False)
    else:
        print_table(outcome_table(outcomes))
        echo(f"{len(outcomes)} cases, {time.perf_counter() - start:.2f} s")
    if (short := shortfall(outcomes)) is not None:
        raise DataError(short)


@cli.command(params=[*showing("json quiet")])
@click.option(
    "--scene", "names", multiple=True, metavar="NAME", help="A scene by name; repeatable.  [default: all]"
)
@click.option("--dataset", type=click.Path(path_type=Path), help="Frames for the scene `recorded`.")
@click.option(
    "--time",
    "seconds",
    type=float,
    default=10.0,
    show_default=True,
    metavar="SECONDS",
    help="CPU time for the estimators of a scene. More shows smaller errors.",
)
@click.option(
    "--seed", "rng", type=click.IntRange(0), default=1, show_default=True, help="Seed of all random draws."
)
@click.option("-o", "--out", metavar="OUT", help="Folder for accuracy.json, report.html, tables and pictures.")
def accuracy(
    *,
    names: tuple[str, ...],
    dataset: Path | None,
    seconds: float,
    rng: int,
    out: str | None,
    json: bool,
    quiet: bool,
) -> None:
    """Measure error against run time of several ways to compute a threshold.

    Each scene is computed by the paper's literal Monte Carlo, by expected decisions and in closed form, with more
    and more trials, and held against a converged value. Without -o nothing is written.
    """
    start = time.perf_counter()
    from functools import partial

    from todframes.base.reading import check_positive
    from todframes.studies.accuracy.measure import Accuracy, find_scenes, measure
    from todframes.studies.accuracy.retina import recorded

    check_positive("time", seconds)
    makers = find_scenes(names)
    if dataset is not None:
        if RECORDED not in makers:
            raise SettingsError(f"--dataset: found scenes {', '.join(names)}, expected {RECORDED} among them")
        makers[RECORDED] = partial(recorded, dataset)
    with staged(out) as write:
        scenes = []
        with progress("converging", quiet=quiet) as advance:
            for name, make in counted(makers.items(), len(makers), advance):
                try:
                    scenes.append(make())
                except DataError as error:
                    if names or dataset is not None:
                        raise
                    if not quiet:
                        say(f"left out: {name}: {error}")
        with progress("measuring", quiet=quiet) as advance:
            measured = [
                measure(scene, seconds=seconds, seed=rng) for scene in counted(scenes, len(scenes), advance)
            ]
        result = Accuracy.made(
            "accuracy",
            start,
            settings={"seconds": seconds, "dataset": None if dataset is None else str(dataset)},
            seed=rng,
            scenes=tuple(measured),
        )
        write(result.files)
    print_result(result, as_json=json, out=out, quiet=quiet)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
