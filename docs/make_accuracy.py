"""Makes accuracy.md and its pictures: python docs/make_accuracy.py SECONDS [FOLDER].

Runs `todframes accuracy --time SECONDS` on all scenes. Pictures go to FOLDER/accuracy, the page to
FOLDER/accuracy.md; by default that is the folder of this script.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.report.result import load_result
from todframes.studies.accuracy.report import page

HERE = Path(__file__).parent
FRAMES = HERE.parent / "sample_frames" / "naked_eye"


def main(seconds: str, folder: Path) -> int:
    """Make page and pictures; the exit status of the command."""
    with tempfile.TemporaryDirectory() as made:
        status = run(cli, ["accuracy", "--time", seconds, "--dataset", str(FRAMES), "-o", made])
        if status:
            return status
        result = load_result(Path(made) / "accuracy.json")
        (folder / "accuracy").mkdir(parents=True, exist_ok=True)
        for picture in Path(made).glob("*.png"):
            (folder / "accuracy" / picture.name).write_bytes(picture.read_bytes())
    closing = f"\n`python docs/make_accuracy.py {seconds}` makes this page and its pictures.\n"
    (folder / "accuracy.md").write_text(page(result, folder="accuracy/") + closing, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE))
