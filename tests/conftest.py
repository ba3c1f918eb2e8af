"""Fixtures that several test files use."""

from __future__ import annotations

import base64
import copy
import csv
import gc
import io
import json
import math
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from markupsafe import Markup

from todframes.cli.console import keep_libraries_to_one_thread

keep_libraries_to_one_thread()  # as the commands do, and before NumPy is imported: workers share the processors
gc.disable()  # until all tests are collected: none of what is made till then is garbage

from todframes.frames.files import write_frame  # noqa: E402
from todframes.stimulus import ORIENTATIONS, Orientation, coverage  # noqa: E402

pytest_plugins = ["browser"]

PITCH_MRAD = 0.25
WHITE, BACKGROUND = 100.0, 50.0  # cd/m²
# A grey PNG of one pixel, in base64.
ONE_PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNoAAAAggCBd81ytgAAAABJRU5ErkJggg=="


def pytest_addoption(parser: pytest.Parser) -> None:
    """Offer a shorter run that still calls every test function."""
    help_text = "Run the first of every N cases of each test function that is not marked every_case."
    parser.addoption("--one-of", type=int, default=1, metavar="N", help=help_text)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark what is run weekly as slow, too: the fast tests are those that are not slow."""
    if item.get_closest_marker("weekly") is not None:
        item.add_marker("slow")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect cases as `--one-of` asks, of those that the marks asked for have left."""
    n, found = config.getoption("--one-of"), Counter[str]()
    chosen: dict[bool, list[pytest.Item]] = {True: [], False: []}
    for item in items:
        function = item.nodeid.partition("[")[0]
        chosen[found[function] % n == 0 or item.get_closest_marker("every_case") is not None].append(item)
        found[function] += 1
    if chosen[False]:
        config.hook.pytest_deselected(items=chosen[False])
        items[:] = chosen[True]


def pytest_configure() -> None:
    """Let Ctrl-C interrupt, for the tests of it: a job in the background of a shell script ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Exempt modules and tests from garbage collection: passes over all of them take their time."""
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)
    gc.enable()


def pytest_unconfigure() -> None:
    """Leave them to the collection at the end, or OpenImageIO takes them for leaks."""
    gc.unfreeze()


@pytest.fixture(autouse=True)
def _no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables are as wide as they need to be, whatever the width of the terminal that the tests run in."""
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty working folder, whose modules a test may name; they are forgotten at the end."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    modules, finders = set(sys.modules), set(map(id, sys.meta_path))
    yield folder
    sys.meta_path[:] = [one for one in sys.meta_path if id(one) in finders or not hasattr(one, "folder")]
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(folder)):
            del sys.modules[name]


@pytest.fixture(autouse=True)
def _no_waiting_for_disks(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test takes away the power, and one `os.sync` waits for what all programs have written."""
    monkeypatch.setattr(os, "sync", lambda: None, raising=False)
    monkeypatch.setattr(os, "fsync", lambda _: None)


Command = Callable[..., tuple[int, str, str]]
"""Function that runs a command, no terminal at its end; gives exit status, standard output and standard error."""


def _command(program: Any, capsys: pytest.CaptureFixture[str]) -> Command:
    from todframes.cli.console import run

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = run(program, [str(argument) for argument in arguments])
        return status, *capsys.readouterr()

    return call


@pytest.fixture
def todframes(capsys: pytest.CaptureFixture[str]) -> Command:
    from todframes.cli.main import cli

    return _command(cli, capsys)


@pytest.fixture
def sensor_sim(capsys: pytest.CaptureFixture[str]) -> Command:
    from sensor_sim.cli import cli

    return _command(cli, capsys)


def error_line(ended: tuple[int, str, str], status: int = 2) -> str:
    """Return the line of an error, which is all that a command has printed."""
    found, out, err = ended
    assert (found, out, err.count("\n")) == (status, "", 1), err
    return err


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of results are not drawn, which is half of what a short command does; each file and page is written.

    For tests of other things. What figures show is tested in test_html_report.py and beside each command.
    """
    png = base64.b64decode(ONE_PIXEL)
    monkeypatch.setattr("todframes.results.figures.ReportFigure.figure", lambda _: None)
    monkeypatch.setattr("todframes.results.figures.ReportFigure.png", lambda _: png)
    monkeypatch.setattr("todframes.results.figures.ReportFigure.svg", lambda _: b"<svg></svg>")
    monkeypatch.setattr("todframes.results.html.inline_svg", lambda *_, **__: Markup("<svg></svg>"))


@dataclass
class DatasetFolder:
    """A dataset on disk and what its two text files hold; change that, then `save`.

    `toml` has a dict for each table. `rows` holds the manifest, a dict of texts a row, whose keys are the columns.
    """

    path: Path
    toml: dict[str, Any]
    rows: list[dict[str, str]]

    def frame(self, row: int) -> Path:
        """The file of a row's frame."""
        return self.path / self.rows[row]["frame"]

    @property
    def settings_file(self) -> Path:
        return self.path / "dataset.toml"

    @property
    def manifest_file(self) -> Path:
        return self.path / "manifest.csv"

    def save(self) -> None:
        """Write `dataset.toml` and `manifest.csv` again."""
        self.settings_file.write_text(_toml_text(self.toml), encoding="utf-8")
        text = io.StringIO()
        columns = dict.fromkeys(name for row in self.rows for name in row)
        writer = csv.DictWriter(text, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        self.manifest_file.write_text(text.getvalue(), encoding="utf-8")


DatasetMaker = Callable[..., DatasetFolder]
"""`dataset_in` a folder that is chosen."""


@pytest.fixture
def make_dataset(tmp_path: Path) -> DatasetMaker:
    """`dataset_in` the folder of a test."""
    return partial(dataset_in, tmp_path)


@pytest.fixture(scope="module")
def make_shared_dataset(tmp_path_factory: pytest.TempPathFactory) -> DatasetMaker:
    """`dataset_in` a folder of all tests of a file, which change nothing in it."""
    return partial(dataset_in, tmp_path_factory.mktemp("shared"))


def dataset_in(
    folder: Path,
    name: str = "dataset",
    *,
    suffix: str = ".exr",
    sizes_mrad: Sequence[float] = (2.0,),
    contrasts: Sequence[float] = (0.05, 0.5),
    repeats: int = 1,
    side_px: int = 48,
    display: Mapping[str, Any] | None = None,
    experiment: Mapping[str, Any] | None = None,
    row_changes: Mapping[int, Mapping[str, str]] | None = None,
) -> DatasetFolder:
    """Write a small valid dataset into a folder; the arguments can make it invalid.

    A frame for each size, contrast and orientation, the triangle in the middle of `side_px` × `side_px` pixels of
    0.25 mrad: half EXR in cd/m², or 16-bit PNG with `suffix=".png"`. Rows are in the order of the loops: size,
    contrast, orientation (up, right, down, left), repeat.

    `display` and `experiment` replace keys of these tables of `dataset.toml`, or add some; None takes a key away.
    `row_changes` does the same to fields of the manifest's rows, by row number from 0; text only.
    """
    path = folder / name
    (path / "frames").mkdir(parents=True)
    rows = []
    for size_mrad in sizes_mrad:
        for contrast in contrasts:
            for orientation in ORIENTATIONS:
                content = _frame(suffix, size_mrad, contrast, orientation, side_px)
                for repeat in range(repeats):
                    frame = f"frames/s{size_mrad}_c{contrast}_{orientation}_{repeat}{suffix}"
                    (path / frame).write_bytes(content)
                    row = {"frame": frame, "orientation": orientation.value, "size_mrad": str(size_mrad)}
                    rows.append(row | {"contrast": str(contrast)})
    for number, changes in (row_changes or {}).items():
        rows[number] |= changes
    tables: dict[str, dict[str, Any]] = {
        "display": {
            "eotf": "linear",
            "white_luminance_cd_m2": _full_scale(suffix),
            "pixel_pitch_mrad": PITCH_MRAD,
            "background_luminance_cd_m2": BACKGROUND,
        },
        "experiment": {"level": "contrast", "group_by": ["size_mrad"]},
    }
    for table, changed in (("display", display), ("experiment", experiment)):
        tables[table] = {k: v for k, v in (tables[table] | dict(changed or {})).items() if v is not None}
    dataset = DatasetFolder(path, {"schema": 1, **tables}, rows)
    dataset.save()
    return dataset


@cache
def _frame(suffix: str, size_mrad: float, contrast: float, orientation: Orientation, side_px: int) -> bytes:
    """The file of a frame of `make_dataset`: hundreds of tests want the same ones."""
    middle = (side_px - 1) / 2
    size_px = size_mrad / PITCH_MRAD
    triangle = coverage((side_px, side_px), size_px=size_px, x_px=middle, y_px=middle, orientation=orientation)
    with TemporaryDirectory() as folder:
        path = Path(folder, f"frame{suffix}")
        write_frame(path, BACKGROUND / _full_scale(suffix) * (1.0 + contrast * triangle))
        return path.read_bytes()


def _full_scale(suffix: str) -> float:
    """Luminance of code value 1."""
    return WHITE if suffix == ".png" else 1.0


def _toml_text(content: Mapping[str, Any]) -> str:
    """TOML of numbers, texts, and lists of them, in tables one deep."""
    tables = {name: value for name, value in content.items() if isinstance(value, dict)}
    lines = [f"{name} = {_toml_value(value)}" for name, value in content.items() if name not in tables]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    # JSON's texts, lists, true and false are TOML's too; NaN and infinity are not.
    return repr(value) if isinstance(value, float) else json.dumps(value)


def fits_on_curves(
    sizes: Sequence[float], *, name: str = "size_mrad", level: str = "contrast", factor: float = 1.0, **more: Any
) -> list[dict[str, Any]]:
    """Fits as in `result.json`, threshold `factor` ÷ size, their points on Weibull curves with β = 2."""
    fits = []
    for size in sizes:
        threshold = factor / size
        alpha = threshold / math.sqrt(math.log2(3.0))
        levels = [threshold * 2.0**k for k in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        fit = {"group": {name: size}, "level": level, "status": "ok", "p_correct": 0.75, "threshold": threshold}
        fit |= {"threshold_ci95": [threshold / 1.1, threshold * 1.1], "points_threshold": 1.05 * threshold}
        fit |= {"alpha": alpha, "beta": 2.0, "gamma": 0.25, "delta": 0.0, "n_trials": 200}
        fit["points"] = [
            {"level": x, "n_trials": 40, "p_correct": 1.0 - 0.75 * 2.0 ** -((x / alpha) ** 2.0)} for x in levels
        ]
        fits.append(fit | {"p_correct_error_bound": 3e-4} | more)
    return fits


@pytest.fixture(scope="session")
def results_of_commands() -> dict[str, dict[str, Any]]:
    """A result of each command that has a report, as read from its JSON; not to be changed."""
    common = {"schema": 1, "version": "1.2.3", "settings": {"internal_noise": 0.5, "levels": None}, "seed": 7}
    common["run_time_s"] = 1.25
    fits = fits_on_curves((1.0, 2.0, 4.0))
    computed = fits_on_curves((4.0, 8.0), name="size_detectors", level="snr", threshold_ci95=None, n_trials=0)
    for fit in computed:
        fit |= {"threshold_numerical_error": 2.4e-3 * fit["threshold"], "delta_t_mk": 20.0 * fit["threshold"]}
        fit |= dict.fromkeys(("alpha", "beta", "gamma", "delta", "points_threshold"))
        fit["points"] = [point | {"n_trials": 0} for point in fit["points"]]
    none = {"status": "never_reached", "threshold": None, "threshold_numerical_error": None, "delta_t_mk": None}
    never = computed[0] | none | {"group": {"size_detectors": 2.0}, "points": []}
    example = {"group": {"size_mrad": 2.0}, "level": "contrast", "strength": 0.5, "orientation": "up"}
    example |= {"p_correct": 0.75, "frame": "frames/1.exr", "n_frames": 2, "width_mrad": 6.0}
    example["pictures"] = [
        {"name": name, "png": ONE_PIXEL, "scale": 1.0} for name in ("display", "retina", "band 0")
    ]
    verdicts = {0.8: "better", 1.0: "no difference shown", 1.25: "worse"}
    algorithms = [{"name": "none", "spec": "none", "parameters": {}, "domain": "code values", "fits": fits}]
    for name, ratios in (("clahe", (0.8, 1.0, 1.25)), ("blur", (1.25, 1.25, 1.25)), ("median", (1.0, 1.0, 1.0))):
        p_values = {"p_value": 0.001, "p_value_holm": 0.009}
        of_name = [
            {"group": fit["group"], "ratio": ratio, "ratio_ci95": [ratio / 1.1, ratio * 1.1]}
            | {"verdict": verdicts[ratio], **p_values}
            for fit, ratio in zip(fits, ratios, strict=True)
        ]
        more = {"parameters": {"radius": 2}, "psnr_db": 31.5, "ssim": 0.9, "cpu_s": 0.5}
        more["overall"] = {"ratio": 1.1, "ratio_ci95": [1.05, 1.15], "p_value_holm": 0.01, "verdict": "worse"}
        algorithms.append(algorithms[0] | {"name": name, "spec": name, "ratios": of_name} | more)
    estimators = [
        {
            "name": name,
            "label": name.replace("_", " "),
            "set_up_cpu_s": 0.25,
            "points": [
                {"trials": n, "repeats": 4, "cpu_s": 1e-3 * n}
                | {"p_correct_error": 0.5 * n**slope, "threshold_error": n**slope}
                for n in (1, 10, 100)
            ],
            "cpu_s_at": [{"threshold_error": 0.01, "cpu_s": 1e-3 * 0.01 ** (1 / slope), "extrapolated": True}],
        }
        for name, slope in (("literal", -0.5), ("closed_form", -1.5))
    ]
    scene = {"name": "camera", "title": "camera, no noise", "description": "", "level": "level", "slope": 0.4}
    scene |= {"estimators": estimators, "threshold": 0.5, "threshold_bound": 0.0, "p_correct_error_bound": 0.0}
    own = [fit | {"group": {"subject": name} | fit["group"]} for name in ("m1", "p2") for fit in fits]
    persons = [
        {"subject": name, "status": status, "internal_noise": noise, "internal_noise_ci95": interval}
        | {"n_trials": 240, "n_correct": 200, "log_likelihood": -100.0, "deviance": 20.0, "n_cells": 21}
        | {"deviance_p_value": 0.4, "predicted": predicted}
        for name, status, noise, interval, predicted in (
            ("m1", "ok", 0.5, [0.4, 0.6], own[: len(fits)]),
            ("p2", "noise_free", None, [None, 0.1], []),
        )
    ]
    plan = [{"stage": "optics", "kept": False, "why": "no blur", "bound": 1e-7, "saves_s": 0.2}]
    dataset = {"path": "my_camera", "display": {"eotf": "srgb", "pixel_pitch_mrad": 0.42}, "n_frames": 280}
    skipped = [{"frame": "frames/9.exr", "error": "frames/9.exr: the file is empty"}]
    return {
        "score": common
        | {"command": "score", "dataset": dataset, "fits": fits, "examples": [example]}
        | {"plan": plan, "skipped": skipped},
        "curve": common | {"command": "curve", "fits": [never, *computed]},
        "naked-eye": common | {"command": "naked-eye", "fits": [fit | {"points": []} for fit in computed]},
        "fit": common | {"command": "fit", "fits": [fits[0] | {"group": {"eye": "left"}, "level": "level"}]},
        "compare": common
        | {"command": "compare", "dataset": dataset, "conditions": algorithms}
        | {"examples": [example | {"condition": name} for name in ("none", "clahe")]},
        "accuracy": common | {"command": "accuracy", "scenes": [scene]},
        "calibrate": common
        | {"command": "calibrate", "dataset": dataset, "fits": own, "persons": persons}
        | {"equal_noise_p_value": 0.03, "pooled": persons[0] | {"subject": None, "predicted": []}},
    }


@pytest.fixture
def results(results_of_commands: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The same, to be changed."""
    return copy.deepcopy(results_of_commands)
