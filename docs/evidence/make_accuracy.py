"""Makes the tables of accuracy.md and its pictures: python docs/evidence/make_accuracy.py SECONDS [FOLDER].

Runs `todframes accuracy --time SECONDS` on all scenes. Pictures go to FOLDER/accuracy, the page to
FOLDER/accuracy.md; by default that is the folder of this script. What stands in accuracy.md between
<!-- =name --> and <!-- / --> is written anew.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import Result, load_result
from todframes.results.wording import plain
from todframes.scoring.error_budget import REPLICATES
from todframes.studies.accuracy.measure import Estimator, SceneResult, rounded

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
FRAMES = ROOT / "sample_frames" / "naked_eye"
SHOWN = ("accuracy_camera_external_noise.png", "accuracy_naked_eye_small.png")

NEEDS = {
    "naked_eye_small": ("of the naked eye", "`todframes naked-eye`"),
    "camera_external_noise": ("of a camera", "`sensor-sim curve SENSOR --tolerance {half_width:g}`"),
    "recorded": ("of a group of recorded frames", "`todframes score DATASET --tolerance {half_width:g}`"),
}
"""The threshold that is needed, and the command that gives it, by the name of the scene.

`--tolerance` is the half-width of a 95 % interval, two standard errors."""

ERRORS = (0.01, 0.001)


def cpu_s_at(estimator: Estimator, error: float) -> float | None:
    """Return the CPU time that an error takes."""
    return next((at.cpu_s for at in estimator.cpu_s_at if at.threshold_error == error), None)


def cost(scene: SceneResult, error: float) -> float | None:
    """Return the CPU time of the command: of the closed form, for a camera with all lattices it runs."""
    closed_form = scene.estimators[-1]
    if (cpu_s := cpu_s_at(closed_form, error)) is None or not scene.name.startswith("camera_"):
        return cpu_s
    return closed_form.set_up_cpu_s + REPLICATES * (cpu_s - closed_form.set_up_cpu_s)


def number(value: float | None) -> str:
    """Write a number with two digits."""
    if value is None:
        return "–"
    return rounded(value) if value >= 10.0 else plain(value, 2)


def table(heads: str, rows: Iterable[str]) -> str:
    """Make a table of Markdown."""
    return "\n".join([heads, re.sub(r"[^|]+", " --- ", heads), *rows])


def paragraph(text: str, bullet: str = "") -> str:
    """Break lines of a paragraph, or of an item of a list."""
    return textwrap.fill(bullet + text, 128, subsequent_indent=" " * len(bullet), break_on_hyphens=False)


def needs(scenes: Mapping[str, SceneResult]) -> str:
    """Make the table of what to do for an error, and of what it costs."""
    rows = [
        f"| {threshold} | {100 * error:g} % | {command.format(half_width=2 * error)} | "
        f"{number(cost(scenes[name], error))} | {number(cpu_s_at(scenes[name].estimators[0], error))} |"
        for name, (threshold, command) in NEEDS.items()
        for error in ERRORS
    ]
    return table("| threshold | error | do this | CPU (s) | literal Monte Carlo, CPU (s) |", rows)


def row(scene: SceneResult) -> str:
    """Make the row of a scene: its threshold, CPU times for 1 %, ratios of the closed form."""
    estimators = scene.tables()[0]
    literal, _, closed_form = estimators.records
    keys = ("CPU (s), 1 %", "ratio, 1 %", "ratio, 0.1 %")
    values = [literal.get(keys[0], "–"), *(closed_form.get(key, "–") for key in keys)]
    return " | ".join([f"| {scene.heading}", estimators.title.rpartition(": threshold ")[2], *values]) + " |"


def measured(result: Result) -> str:
    """Write how the figures were measured."""
    seconds = result.settings["seconds"]
    return paragraph(
        f"`todframes accuracy` measured all figures of this page, here with `--time {seconds:g}` (CPU seconds for "
        f"a scene) and version {result.version}. Times are those of one machine; their ratios hardly depend on it."
    )


def findings(scenes: Mapping[str, SceneResult]) -> str:
    """Write what else the scenes show."""
    times = {
        scene.heading.partition(":")[0].partition(",")[0].lower(): [
            cpu_s_at(estimator, ERRORS[0]) for estimator in scene.estimators[:2]
        ]
        for scene in scenes.values()
    }
    ratios = [f"{rounded(literal / expected)} ({name})" for name, (literal, expected) in times.items()]
    bounds = [
        f"{plain(scenes[name].p_correct_error_bound, 2)} for {what.removeprefix('of ')}"
        for name, (what, _) in NEEDS.items()
    ]
    return "\n".join(
        paragraph(text, "- ")
        for text in (
            f"Expected decisions at random phases take so many times less CPU than the literal Monte Carlo at an "
            f"error of {100 * ERRORS[0]:g} %: {', '.join(ratios)}.",
            f"That summed noise is not quite Gaussian moves P by at most {', '.join(bounds)}.",
        )
    )


def main(seconds: str, folder: Path) -> int:
    """Make tables and pictures; the exit status of the command."""
    with tempfile.TemporaryDirectory() as made:
        status = run(cli, ["accuracy", "--time", seconds, "--dataset", str(FRAMES), "-o", made])
        if status:
            return status
        result = load_result(Path(made) / "accuracy.json")
        (folder / "accuracy").mkdir(parents=True, exist_ok=True)
        for picture in SHOWN:
            (folder / "accuracy" / picture).write_bytes((Path(made) / picture).read_bytes())
    text = (HERE / "accuracy.md").read_text(encoding="utf-8")
    scenes = {scene.name: scene for scene in result.scenes}
    heads = "| scene | threshold | literal, 1 % | closed form, 1 % | times less at 1 % | at 0.1 % |"
    parts = {
        "needs": needs(scenes),
        "measured": measured(result),
        "scenes": table(heads, map(row, scenes.values())),
        "findings": findings(scenes),
    }
    for name, part in parts.items():
        pattern = rf"(<!-- ={name} -->\n).*?(<!-- / -->)"
        text = re.sub(pattern, lambda found, part=part: f"{found[1]}{part}\n{found[2]}", text, flags=re.DOTALL)
    (folder / "accuracy.md").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE))
