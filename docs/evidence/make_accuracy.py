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
from collections.abc import Iterable, Sequence
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import Result, load_result
from todframes.results.wording import plain
from todframes.scoring.error_budget import REPLICATES
from todframes.studies.accuracy.report import Estimator, SceneResult, rounded

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
FRAMES = ROOT / "sample_frames" / "naked_eye"
SHOWN = ("accuracy_camera_external_noise.png", "accuracy_naked_eye_small.png")

NEEDS = (
    ("naked_eye_", "of the naked eye", "`todframes naked-eye`"),
    ("camera_", "of a camera", "`sensor-sim curve SENSOR --tolerance {half_width:g}`"),
    ("recorded", "of a group of recorded frames", "`todframes score DATASET --tolerance {half_width:g}`"),
)
"""Beginning of the scenes' names, the threshold that is needed, and the command that gives it.

`--tolerance` is the half-width of a 95 % interval, two standard errors."""

ERRORS = (0.01, 0.001)


def cpu_s_at(estimator: Estimator, error: float) -> float | None:
    """Return the CPU time that an error takes."""
    return next((at.cpu_s for at in estimator.cpu_s_at if at.threshold_error == error), None)


def cost(scene: SceneResult, error: float) -> float | None:
    """Return the CPU time of the command: of the fastest closed form, for a camera with all lattices it runs."""
    costs = []
    for form in scene.estimators:
        cpu_s = cpu_s_at(form, error)
        if form.name.startswith("closed_form") and cpu_s is not None:
            set_up = form.set_up_cpu_s or 0.0
            runs = REPLICATES if scene.name.startswith("camera_") else 1
            costs.append(set_up + runs * (cpu_s - set_up))
    return min(costs, default=None)


def span(values: Iterable[float | None]) -> str:
    """Write the least and the largest of some numbers."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    low, high = (rounded(value) if value >= 10.0 else plain(value, 2) for value in (min(known), max(known)))
    return low if low == high else f"{low} to {high}"


def table(heads: str, rows: Iterable[str]) -> str:
    """Make a table of Markdown."""
    return "\n".join([heads, re.sub(r"[^|]+", " --- ", heads), *rows])


def paragraph(text: str, bullet: str = "") -> str:
    """Break lines of a paragraph, or of an item of a list."""
    return textwrap.fill(bullet + text, 128, subsequent_indent=" " * len(bullet), break_on_hyphens=False)


def needs(scenes: Sequence[SceneResult]) -> str:
    """Make the table of what to do for an error, and of what it costs."""
    rows = []
    for beginning, threshold, command in NEEDS:
        members = [scene for scene in scenes if scene.name.startswith(beginning)]
        for error in ERRORS:
            literal = span(cpu_s_at(scene.estimators[0], error) for scene in members)
            rows.append(
                f"| {threshold} | {100 * error:g} % | {command.format(half_width=2 * error)} | "
                f"{span(cost(scene, error) for scene in members)} | {literal} |"
            )
    return table("| threshold | error | do this | CPU (s) | literal Monte Carlo, CPU (s) |", rows)


def row(scene: SceneResult) -> str:
    """Make the row of a scene: its threshold, CPU times for 1 %, ratios of the best closed form."""
    estimators = scene.tables()[0]
    literal = estimators.records[0]
    closed_forms = [one for one in estimators.records if one["estimator"].startswith("closed form")]
    best = []
    for name, at in (("CPU (s)", "1 %"), ("times less", "1 %"), ("times less", "0.1 %")):
        timed = {
            float(one[f"CPU (s) at {at}"].strip("≤ *").replace(",", "")): one[f"{name} at {at}"]
            for one in closed_forms
            if one.get(f"CPU (s) at {at}")
        }
        best.append(timed[min(timed)] if timed else "–")
    threshold = estimators.title.rpartition(": threshold ")[2]
    return f"| {scene.heading} | {threshold} | {literal.get('CPU (s) at 1 %', '–')} | " + " | ".join(best) + " |"


def scene_rows(scenes: Sequence[SceneResult]) -> str:
    """Make the table of the scenes."""
    heads = "| scene | threshold | literal, 1 % | closed form, 1 % | times less at 1 % | at 0.1 % |"
    return table(heads, map(row, scenes))


def measured(result: Result) -> str:
    """Write how the figures were measured."""
    seconds = result.settings["seconds"]
    return paragraph(
        f"`todframes accuracy` measured all figures of this page, here with `--time {seconds:g}` (CPU seconds for "
        f"a scene) and version {result.version}. Times are those of one machine; their ratios hardly depend on it."
    )


def findings(scenes: Sequence[SceneResult]) -> str:
    """Write what else the scenes show."""

    def times_less(name: str) -> str:
        ratios = []
        for scene in scenes:
            cpu_s = {one.name: cpu_s_at(one, ERRORS[0]) for one in scene.estimators}
            if cpu_s.get("literal") and cpu_s.get(name):
                ratios.append(cpu_s["literal"] / cpu_s[name])
        return span(ratios)

    cameras = [scene for scene in scenes if scene.name.startswith("camera_")]
    changes = [variant for scene in cameras for variant in scene.variants if variant["label"] == "float64"]
    single = max((abs(change["threshold_change"]) for change in changes), default=0.0)
    of_cameras, of_others = (
        max((scene.p_correct_error_bound or 0.0 for scene in scenes if (scene in cameras) is wanted), default=0.0)
        for wanted in (True, False)
    )
    return "\n".join(
        paragraph(text, "- ")
        for text in (
            f"Monte Carlo on folded scores takes {times_less('folded')} times less CPU than the literal one, "
            f"expected decisions at random phases {times_less('expected')} times.",
            f"For cameras the closed form computes in float32, which moves a threshold by {single:.1g} at most.",
            f"That summed noise is not quite Gaussian moves P by at most {of_cameras:.2g} for cameras, and by "
            f"{of_others:.2g} for the naked eye and recorded frames.",
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
    parts = {
        "needs": needs(result.scenes),
        "measured": measured(result),
        "scenes": scene_rows(result.scenes),
        "findings": findings(result.scenes),
    }
    for name, part in parts.items():
        pattern = rf"(<!-- ={name} -->\n).*?(<!-- / -->)"
        text = re.sub(pattern, lambda found, part=part: f"{found[1]}{part}\n{found[2]}", text, flags=re.DOTALL)
    (folder / "accuracy.md").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE))
