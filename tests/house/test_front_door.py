"""`import todframes as tod`: few names, nothing slow, and calls that do what the commands do."""

from __future__ import annotations

import ast
import doctest
import inspect
import json
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import click
import numpy as np
import pytest
from matplotlib.figure import Figure
from triangles import columns_of

import sensor_sim as ss
import todframes as tod
from sensor_sim.cli import cli as sensor_cli
from todframes.base.errors import flag_of
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import read_result

ROOT = Path(__file__).parents[2]
NAKED_EYE, ENHANCEMENT = ROOT / "sample_frames" / "naked_eye", ROOT / "sample_frames" / "enhancement"
CAMERA = ROOT / "sample_frames" / "staring_camera.toml"
CURVE = ["curve", CAMERA, "--size-detectors", "4", "--tolerance", "0.1"]
OF_FRAMES = {"OpenImageIO", "sqlite3", "scipy.sparse", "todframes.frames", "todframes.jobs"}
UNUSED = {"sqlite3", "matplotlib", "scipy.stats", "scipy.optimize", "rich"}
"""Modules that take long to import, and that are not needed without -o."""
MOST_FILES_RUN = 65
SLOW = pytest.mark.slow
NAMES = [(package, name) for package in (tod, ss) for name in dir(package)]


@pytest.fixture
def commanded(capsys: pytest.CaptureFixture[str]):
    """Runs a command line; gives its JSON."""

    def call(command, *arguments: object) -> dict[str, object]:
        assert run(command, [*map(str, arguments), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.fixture(scope="module")
def scored() -> tod.Result:
    return tod.score(NAKED_EYE, fit=tod.FitSettings(resamples=200))


NOT_COMPARED = ["run_time_s", "saves_s", "cpu_s", "cpu_ms_per_frame", "examples", "versions"]


def same(result: tod.Result, made: dict[str, object]) -> bool:
    """Whether a call and a command gave the same but for times and what only is drawn."""

    def timeless(value: object) -> object:
        if isinstance(value, dict):
            return {key: timeless(one) for key, one in value.items() if key not in NOT_COMPARED}
        return [timeless(one) for one in value] if isinstance(value, list) else value

    return timeless(json.loads(result.to_json())) == timeless(made)


def test_names() -> None:
    # Sixteen commands have a call, most of them a type of result; the rest are what an own observer, algorithm,
    # frame or reader is made of.
    assert 25 <= len(dir(tod)) <= 74
    assert {"score", "compare", "fit_counts", "naked_eye", "load_result", "Result"} <= set(dir(tod))
    assert {"curve", "simulate", "mtf", "load_sensor", "Sensor"} <= set(dir(ss))
    for package, name in NAMES:
        assert getattr(package, name) is not None
    assert callable(ss.simulate)


def loaded_by(code: str, *arguments: object) -> dict[str, str | None]:
    """Return the files of all modules that are loaded in a process of its own after `code`, by name."""
    files = "{name: getattr(one, '__file__', None) for name, one in sys.modules.items()}"
    code += f"; import json, sys; print('\\n' + json.dumps({files}))"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, str | None] = json.loads(done.stdout.splitlines()[-1])
    return found


def files_run(loaded: dict[str, str | None]) -> set[str]:
    """Return those of our files that hold more than a docstring, as most packages do not."""
    ours = {file for name, file in loaded.items() if re.match(r"(todframes|sensor_sim)\b", name) and file}
    return {file for file in ours if len(ast.parse(Path(file).read_text(encoding="utf-8")).body) > 1}


@pytest.mark.parametrize("package", ["todframes", "sensor_sim"])
def test_import_loads_nothing(package: str) -> None:
    loaded = loaded_by(f"import {package}; dir({package})")
    assert "numpy" not in loaded
    assert [name for name in loaded if re.match(r"(todframes|sensor_sim)\b", name)] == [package]


@pytest.mark.parametrize(
    ("group", "arguments", "unused"),
    [
        ("sensor_sim.cli", CURVE, {"matplotlib", *OF_FRAMES}),
        pytest.param("sensor_sim.cli", [*CURVE, "-o", "out"], OF_FRAMES - {"scipy.sparse"}, marks=SLOW),
        ("todframes.cli.main", ["score", "dataset", "--json"], UNUSED),
    ],
)
def test_a_command_runs_few_files(group, arguments, unused, make_dataset, tmp_path, monkeypatch) -> None:
    make_dataset(suffix=".png")
    monkeypatch.chdir(tmp_path)
    code = f"import sys; from {group} import cli; from todframes.cli.console import run; run(cli, sys.argv[1:])"
    loaded = loaded_by(code, *arguments)
    of_scipy = loaded_by("import scipy.special")  # old versions load scipy.sparse
    assert not unused & (loaded.keys() - of_scipy.keys())
    assert len(files_run(loaded)) < MOST_FILES_RUN


def marks(name: str) -> list[pytest.MarkDecorator]:
    """Mark the examples of calls that other tests make with smaller data."""
    slow = ("compare", "Result", "score", "score_frames", "validate", "mrtd", "sample", "sweep", "scenes")
    return [pytest.mark.slow] if name in slow else []


@pytest.mark.parametrize(
    ("package", "name"), [pytest.param(*one, id=one[1], marks=marks(one[1])) for one in NAMES]
)
def test_examples_of_docstrings_run(package, name: str, monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    found = getattr(package, name)
    if not (inspect.isroutine(found) or inspect.isclass(found)):
        pytest.skip("has no docstring of its own")
    assert inspect.getdoc(found)
    for test in doctest.DocTestFinder(recurse=False).find(found, name, globs={}):
        assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test).failed == 0


def test_score_is_the_command(commanded, make_dataset) -> None:
    path = make_dataset(sizes_mrad=(1.0, 2.0), contrasts=(0.02, 0.05, 0.1, 0.2), suffix=".png").path
    scored = tod.score(path, fit=tod.FitSettings(resamples=200))
    assert [one.status for one in scored.thresholds] == ["ok"] * 2
    assert same(scored, commanded(cli, "score", path, "--set", "resamples=200"))


def test_counts_by_group_are_fitted_one_by_one() -> None:
    level, right, n = [0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40] * 4
    alone = tod.fit_counts(level, right, n).fits[0]
    both = tod.fit_counts(level * 2, right * 2, n * 2, groups={"eye": ["left"] * 4 + ["right"] * 4})
    assert [one.group for one in both.thresholds] == [{"eye": "left"}, {"eye": "right"}]
    assert [one.threshold for one in both.thresholds] == [alone.threshold] * 2
    with pytest.raises(tod.DataError, match="groups: eye: found 1 values, expected 4"):
        tod.fit_counts(level, right, n, groups={"eye": ["left"]})


@pytest.mark.usefixtures("blank_pictures")
def test_result_comes_back_with_its_trials(scored, tmp_path: Path) -> None:
    scored.save(tmp_path / "out")
    names = {"result.json", "report.html", "scores.csv", "psychometric.png", "tod_curve.png"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    again = tod.load_result(tmp_path / "out")
    assert again == scored
    assert again.trials.csv() == scored.trials.csv()
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    again.save(tmp_path / "out")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_names_come_back_as_they_were(make_dataset, tmp_path) -> None:
    """Also those that a spreadsheet would compute, and those that look like numbers; so do settings."""
    names = ["=warm", "nan", "7", "1e5", "'", "\N{SNOWMAN}"]
    dataset = make_dataset(contrasts=(0.1, 0.2, 0.4), suffix=".png", experiment={"group_by": ["camera"]})
    for row in dataset.rows:
        row["camera"] = names[0]
    for row, name in zip(dataset.rows, names, strict=False):
        row["trial"] = name
    dataset.save()
    result = tod.score(dataset.path, fit=tod.FitSettings(resamples=0), examples=False, locate=True)
    assert (result.settings["curve"], result.settings["locate"]) == ("observer", "group")
    result.save(tmp_path / "out")
    again = tod.load_result(tmp_path / "out").trials
    assert list(again.records) == list(result.trials.records)
    assert set(names) <= {record["trial"] for record in again.records}


@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text[:-3],
        lambda text: text[: text.rindex("\n", 0, -1) + 1],
        lambda text: text.replace(",0.", ",zero", 1),
        lambda _: "",
    ],
    ids=["cut in a row", "cut in the last number", "without the last row", "no number", "empty"],
)
def test_a_damaged_table_of_trials_is_one_line(scored, damage, tmp_path) -> None:
    scored.save(tmp_path / "out")
    path = tmp_path / "out" / "scores.csv"
    path.write_text(damage(path.read_text()))
    with pytest.raises(tod.DataError, match=r"scores\.csv: is not the whole table of trials"):
        _ = tod.load_result(tmp_path / "out").trials


@pytest.mark.oracle
def test_dataframe(scored) -> None:
    pytest.importorskip("pandas", reason="pandas comes with the group dev")
    frame = scored.to_dataframe()
    assert frame["size_mrad"].tolist() == [0.6, 0.9, 1.4, 2.4]
    assert frame["threshold"].tolist() == [one.threshold for one in scored.thresholds]
    assert frame["threshold_ci95_high"].tolist() == [one.threshold_ci95[1] for one in scored.thresholds]
    assert len(scored.trials.to_dataframe()) == 336


def test_dataframe_without_pandas_says_what_to_do(scored, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="needs pandas, which is not installed: pip install pandas"):
        scored.to_dataframe()


def test_plots_into_ones_own_axes(scored) -> None:
    left, right = Figure().subplots(1, 2)
    assert scored.plot_tod(left) is left
    assert scored.plot_psychometric(ax=right) is right
    x, y = left.lines[0].get_data()
    assert np.allclose(1.0 / np.asarray(x), [0.6, 0.9, 1.4, 2.4])
    assert np.allclose(y, [one.threshold for one in scored.thresholds])
    assert [text.get_text() for text in right.get_legend().get_texts()] == [
        f"{size} mrad" for size in (0.6, 0.9, 1.4, 2.4)
    ]


def test_nothing_to_plot_is_said(results_of_commands) -> None:
    one_size = results_of_commands["naked-eye"] | {"fits": results_of_commands["naked-eye"]["fits"][:1]}
    result = read_result(json.dumps(one_size).encode(), "result")
    with pytest.raises(tod.DataError, match="plot_tod: found no thresholds at two or more sizes"):
        result.plot_tod()
    with pytest.raises(tod.DataError, match="plot_psychometric: found no thresholds with points"):
        result.plot_psychometric()


def test_a_result_as_a_notebook_csv_and_sentences(scored) -> None:
    shown = scored._repr_html_()
    assert shown.count("<table>") == shown.count("<svg") == 1
    assert "0.3045" in shown and "http" not in shown
    assert repr(scored).startswith("<Result of score: At 75 % correct the threshold contrast is 0.305")
    assert scored.to_csv().splitlines()[0].startswith("size_mrad,threshold,")
    assert len(scored.to_csv().splitlines()) == 5
    assert scored.summary().splitlines()[0] in repr(scored)
    assert scored.summary().count("warning: ") == len(scored.warnings)


def test_own_observer_from_a_module(working_folder: Path, commanded) -> None:
    """As by its registered name, number for number, from the folder where one is."""
    code = "from todframes.observers.pyramid import PyramidObserver\nclass Mine(PyramidObserver):\n    pass\n"
    (working_folder / "own_observers.py").write_text(code, encoding="utf-8")
    arguments = ("naked-eye", "--size-mrad", "0.7")
    mine = commanded(cli, *arguments, "--observer", "own_observers:Mine")
    usual = commanded(cli, *arguments)
    assert mine["settings"] == usual["settings"] | {"observer": "own_observers:Mine"}
    assert mine["fits"] == usual["fits"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere_at_all:Mine", "module 'nowhere_at_all' cannot be imported .ModuleNotFoundError"),
        ("math:Mine", "math: unknown key 'Mine'"),
        ("math:sqrt", "found no observer, expected a subclass of todframes.Observer"),
    ],
)
def test_observers_that_are_none(name: str, message: str) -> None:
    with pytest.raises(tod.SettingsError, match=message):
        tod.find_observer(name)


FLAG = re.compile(r"(?<![-\w`])--[a-z]")
FLAG_OR_ARGUMENT = re.compile(r"--[a-z]|\bargument\s*\.")
WHOLE_COMMAND = re.compile(r"(todframes|sensor-sim) [a-z-]+ .*--")
COMMANDS_ALONE = ("cli", "cli.py", "studies")
"""Rooms and modules that only commands use."""
NO_SENTENCES = {"base/errors.py", "results/html.py", "explorer/routes.py"}
"""Modules with a table of options, with variables of CSS, and with the parts of a command to copy."""


@cache
def nodes_in_source() -> list[tuple[str, ast.AST]]:
    """Nodes of the sources of calls that name flags or arguments, but docstrings and parts of f-strings."""
    found: list[tuple[str, ast.AST]] = []
    for package in (tod, ss):
        folder = Path(package.__file__).parent
        for path in folder.rglob("*.py"):
            below, text = path.relative_to(folder), path.read_text(encoding="utf-8")
            if below.parts[0] in COMMANDS_ALONE or below.as_posix() in NO_SENTENCES:
                continue
            if FLAG_OR_ARGUMENT.search(text):
                nodes = [*ast.walk(ast.parse(text))]
                skipped = {id(one.value) for one in nodes if isinstance(one, ast.Expr)}
                skipped |= {id(part) for one in nodes if isinstance(one, ast.JoinedStr) for part in one.values}
                found += ((str(path), one) for one in nodes if id(one) not in skipped)
    return found


def arguments_named() -> dict[str, str]:
    """The arguments that texts of calls name, with a place of each."""
    found = ((place, node) for place, node in nodes_in_source() if isinstance(node, ast.Attribute))
    return {node.attr: place for place, node in found if getattr(node.value, "id", None) == "argument"}


def test_texts_of_calls_name_arguments() -> None:
    """No text of the library names an option, and each argument that one names is that of a call."""
    for place, node in nodes_in_source():
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        texts = [one.value for one in parts if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        # Most texts have no flag, and to write all of them takes seconds.
        if any("--" in one for one in texts) and not WHOLE_COMMAND.search(text := ast.unparse(node)):
            assert not FLAG.search(text), (place, text)
    calls = [getattr(package, name) for package, name in NAMES]
    known = {name for one in calls if inspect.isfunction(one) for name in inspect.signature(one).parameters}
    known |= {"bits", "camera_page"}  # settings of `chart`
    named = arguments_named()
    assert len(named) > 20
    assert {name: place for name, place in named.items() if name not in known} == {}


def test_options_of_arguments_exist() -> None:
    """Each argument that a text names has the option of a command, which shows it in its place."""
    options: set[str] = set()
    for group in (cli, sensor_cli):
        context = click.Context(group)
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            assert command is not None
            options |= {option for parameter in command.params for option in parameter.opts}
    assert {flag_of(name) for name in arguments_named()} <= options


@pytest.mark.parametrize(
    ("call", "arguments", "command", "named", "option"),
    [
        (tod.naked_eye, {}, ["naked-eye"], "contrast", "--contrast"),
        (
            *(tod.noise, {"recording": "x.npy", "frames_per_second": -1}),
            *(["noise", "x.npy", "--frames-per-second", "-1"], "frames_per_second: found -1"),
            "--frames-per-second: found -1",
        ),
        pytest.param(
            *(tod.score, {"dataset": NAKED_EYE, "cluster": "nowhere"}),
            *(["score", str(NAKED_EYE), "--cluster", "nowhere"], "cluster: found 'nowhere'"),
            "--cluster: found 'nowhere'",
            marks=pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed"),
        ),
    ],
)
def test_an_error_names_what_its_reader_wrote(capsys, call, arguments, command, named, option) -> None:
    with pytest.raises(tod.SettingsError, match=named) as caught:
        call(**arguments)
    assert "--" not in str(caught.value)
    assert run(cli, command) == 2
    assert option in capsys.readouterr().err


def test_an_error_about_a_frame_names_the_option_too(make_dataset, capsys) -> None:
    path = make_dataset().path
    algorithm = "gaussian:sigma=1"
    with pytest.raises(tod.FrameError, match=r"above white \(1\); .* \(white\)$") as caught:
        tod.compare(path, enhance=[algorithm])
    assert caught.value.problem.endswith("(white)")
    assert run(cli, ["compare", str(path), "--enhance", algorithm]) == 1
    assert capsys.readouterr().err.rstrip().endswith("(--white)")


def test_a_warning_names_what_its_reader_wrote(make_dataset, capsys) -> None:
    path = str(make_dataset(row_changes={row: {"x_px": "26", "y_px": "23.5"} for row in range(8)}).path)
    (found,) = [one.message for one in tod.validate(path).warnings if one.code == "position_offset"]
    assert found.endswith("take them out and use locate")
    assert run(cli, ["validate", path, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["warnings"]
    assert [one["message"] for one in shown if one["code"] == "position_offset"] == [found[:-6] + "--locate"]


def test_every_command_has_a_call() -> None:
    renamed = {"fit": "fit_counts", "import": "import_recordings", "new": "new_dataset", "report": "load_result"}
    renamed |= {"enhancements": "find_enhancement", "experiment": "run_experiment", "range": "acquisition_range"}
    alone = {"accuracy", "stability"}  # studies of this package
    for package, group in ((tod, cli), (ss, sensor_cli)):
        for name in {*group.list_commands(click.Context(group))} - alone:
            call = "new_sensor" if (package, name) == (ss, "new") else renamed.get(name, name.replace("-", "_"))
            assert callable(getattr(package, call)), name


OTHERS_TYPES = {
    *("Any", "Axes", "Bands", "Callable", "Centre", "DataFrame", "Figure", "FloatArray", "Group", "Image"),
    *("Iterable", "Iterator", "Meta", "NDArray", "None", "Path", "Quantity", "Range", "Self"),
    *("Declaration", "Parameter"),  # what `algorithm` and `parameter` make
}
"""Types that public calls and methods return and that are not of these packages, or only names for such types."""


def test_types_that_calls_return_can_be_imported() -> None:
    """By calls, and by the methods and properties of public classes."""
    known = {name for _, name in NAMES} | OTHERS_TYPES
    for package, name in NAMES:
        found = getattr(package, name)
        members = [found] if inspect.isfunction(found) else []
        if inspect.isclass(found) and not issubclass(found, Exception):
            public = [one for key, one in vars(found).items() if not key.startswith("_")]
            members = [one.fget if isinstance(one, property) else getattr(one, "__func__", one) for one in public]
        for member in filter(inspect.isfunction, members):
            returned = str(inspect.signature(member).return_annotation)
            types = re.findall(r"\b[A-Z]\w+", re.sub(r"'[^']*'|\w+\.", "", returned))
            assert set(types) <= known, (name, returned)


@pytest.mark.parametrize("rng", [np.random.default_rng(5), np.random.SeedSequence(5), np.int64(5)])
def test_rng_is_a_seed_or_gives_one(rng) -> None:
    counts = [0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40] * 4
    found = tod.fit_counts(*counts, rng=rng)
    again = tod.fit_counts(*counts, rng=json.loads(found.to_json())["seed"])
    assert again.fits[0].threshold_ci95 == found.fits[0].threshold_ci95
    for bad in (-1, 0.5, "1", True, None):
        with pytest.raises(tod.SettingsError, match=r"rng: found .*, expected a whole number >= 0"):
            tod.fit_counts(*counts, rng=bad)


def test_arrays_in_place_of_files(tmp_path: Path) -> None:
    """Noise and comparisons of arrays are those of files with the same values."""
    frames = np.random.default_rng(2).normal(100.0, 2.0, (20, 16, 24)).astype(np.float32)
    np.save(tmp_path / "frames.npy", frames)
    from_file, measured = tod.noise(tmp_path / "frames.npy"), tod.noise(frames)
    assert measured.noise.dynamic.sd == from_file.noise.dynamic.sd
    assert measured.plot() is not None and "<svg" in measured._repr_html_()
    with pytest.raises(tod.DataError, match=r"found an array of shape \(4,\), expected \(frames, rows, columns\)"):
        tod.noise(np.zeros(4))
    data = tod.load_dataset(NAKED_EYE)
    data = replace(data, trials=data.trials[: len(data.trials) // 4])
    images = [tod.read_frame(data.frame_path(trial.frames[0])).stored[..., 0] for trial in data.trials]
    fit = tod.FitSettings(resamples=100)
    how = {"white": 100.0, "fit": fit, "examples": False}
    result = tod.compare_frames(images, ["gaussian:sigma=1"], **columns_of(data), **how)
    expected = tod.compare(data, enhance=["gaussian:sigma=1"], **how)
    for found, wanted in zip(result.conditions, expected.conditions, strict=True):
        assert found.verdict == wanted.verdict
        assert [one.threshold for one in found.fits] == [one.threshold for one in wanted.fits]


def test_answers_before_the_dataset_are_refused(tmp_path: Path) -> None:
    (tmp_path / "dataset_description.json").write_text("{}")
    with pytest.raises(tod.SettingsError, match=r"holds answers, expected calibrate\(dataset, answers\)"):
        tod.calibrate(tmp_path, NAKED_EYE)


def test_pages_import_no_internal_name() -> None:
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("[!_]*/*.md")]:
        found = re.findall(r"^[> .]*(?:from|import) (?:todframes|sensor_sim)\.\S+", path.read_text(), re.MULTILINE)
        assert not found, path
