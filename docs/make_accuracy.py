"""Makes the table of accuracy.md and its pictures: python docs/make_accuracy.py SECONDS [FOLDER].

Runs `todframes accuracy --time SECONDS` on all scenes. Pictures go to FOLDER/accuracy, the page to
FOLDER/accuracy.md; by default that is the folder of this script. What stands in accuracy.md between
<!-- =scenes --> and <!-- / --> is written anew.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import load_result
from todframes.studies.accuracy.report import SceneResult, scene_tables

HERE = Path(__file__).parent
FRAMES = HERE.parent / "sample_frames" / "naked_eye"
SHOWN = ("accuracy_camera_external_noise.png", "accuracy_naked_eye_small.png")


def row(scene: SceneResult) -> str:
    """Make the row of a scene: its threshold, CPU times for 1 %, ratios of the best closed form."""
    estimators = scene_tables(scene)[0]
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
    return f"| {scene.heading} | {threshold} | {literal['CPU (s) at 1 %']} | " + " | ".join(best) + " |"


def main(seconds: str, folder: Path) -> int:
    """Make table and pictures; the exit status of the command."""
    with tempfile.TemporaryDirectory() as made:
        status = run(cli, ["accuracy", "--time", seconds, "--dataset", str(FRAMES), "-o", made])
        if status:
            return status
        result = load_result(Path(made) / "accuracy.json")
        (folder / "accuracy").mkdir(parents=True, exist_ok=True)
        for picture in SHOWN:
            (folder / "accuracy" / picture).write_bytes((Path(made) / picture).read_bytes())
    text = (HERE / "accuracy.md").read_text(encoding="utf-8")
    head, mark, rest = text.partition("<!-- =scenes -->\n")
    heads, tail = rest[: rest.index("| --- |")], rest[rest.index("<!-- / -->") :]
    rule = re.sub(r"[^|\n]+", " --- ", heads)
    rows = "\n".join(row(scene) for scene in result.scenes)
    (folder / "accuracy.md").write_text(f"{head}{mark}{heads}{rule}{rows}\n{tail}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE))
