"""Makes the pictures and tables of enhancement.md: python docs/explanation/make_enhancement_figures.py [FOLDER].

The tables are what `todframes compare` finds in sample_frames/enhancement, and its picture is the command's own.
Pictures go to FOLDER/enhancement, text to FOLDER/enhancement.md between <!-- =NAME --> and <!-- / -->; by default
that is the folder of this script. Seeds are fixed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

from matplotlib.figure import Figure

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, DecodedFrame
from todframes.enhancement.finding import enhancement_names, find_enhancement
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SAMPLES = Path("sample_frames/enhancement")
SHOWN = ("median", "gaussian:sigma=2", "wiener:sigma=0.7")
RESPONSES = ("median", "clahe", "gaussian:sigma=2")
NEAR_THRESHOLD = ("frames/s2.5_d12_up_0.png", "frames/s4.0_d9_right_0.png", "frames/s6.5_d7_down_0.png")
"""Frames about where three of four answers are right without an algorithm."""


def printed(*arguments: str) -> str:
    """What a command prints on standard output."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        status = run(cli, arguments)
    if status:
        raise SystemExit(status)
    return out.getvalue()


def compare(specs: Sequence[str], *more: str) -> str:
    """What `todframes compare` prints of the sample frames."""
    return printed("compare", str(SAMPLES), *(part for spec in specs for part in ("--enhance", spec)), *more)


def all_of_them(algorithms: Sequence[dict[str, Any]]) -> str:
    """A row an algorithm, the one that helps most first."""
    lines = [
        "| algorithm | threshold ratio | 95 % interval | verdict | PSNR (dB) | SSIM |",
        "|---|---|---|---|---|---|",
    ]
    reference, *others = algorithms
    # Without a ratio, the threshold is beyond what is shown, upwards where it is worse.
    ordered = sorted(
        others, key=lambda one: one["overall"]["ratio"] or (9.0 if one["verdict"] == "worse" else 0.0)
    )
    for one in (reference, *ordered):
        ratio = one["overall"] or {}
        low_high = ratio.get("ratio_ci95") or ()
        cells = [
            f"`{one['spec']}`",
            "1" if one is reference else f"{ratio['ratio']:.2f}" if ratio["ratio"] else "–",
            " – ".join("?" if end is None else f"{end:.2f}" for end in low_high) or "–",
            one["verdict"] or "reference",
            "–" if one["psnr_db"] is None else f"{one['psnr_db']:.1f}",
            "–" if one["ssim"] is None else f"{one['ssim']:.2f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def frames_figure() -> Figure:
    """Frames near threshold as sent, as received and after each algorithm."""
    dataset = load_dataset(SAMPLES)
    screen = AlgorithmDisplay(dataset.display)
    rows = {"as sent": None, "as received": "none", **{spec: spec for spec in SHOWN}}
    figure = Figure(figsize=(1.45 * len(rows), 1.5 * len(NEAR_THRESHOLD) + 0.3), layout="constrained")
    axes = figure.subplots(len(NEAR_THRESHOLD), len(rows))
    references = {frame.path: frame.reference for trial in dataset.trials for frame in trial.frames}
    for line, name in zip(axes, NEAR_THRESHOLD, strict=True):
        for ax, (title, spec) in zip(line, rows.items(), strict=True):
            with FrameFile(SAMPLES / (references[name] if spec is None else name)) as file:
                decoded = DecodedFrame(file, screen)
            luminance = decoded.after(find_enhancement(spec or "none")).luminance()
            ax.imshow(luminance, cmap="gray", vmin=0.25 * 120.0, vmax=0.55 * 120.0, interpolation="nearest")
            ax.set_xticks([])
            ax.set_yticks([])
            if name == NEAR_THRESHOLD[0]:
                ax.set_title(title, fontsize="small")
    return figure


def main(folder: Path) -> None:
    """Make all pictures and tables."""
    os.chdir(ROOT)
    (folder / "enhancement").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as out:
        result = compare(SHOWN, "-o", out)
        shutil.copyfile(Path(out) / "compare.png", folder / "enhancement" / "compare.png")
        compare(RESPONSES, "--allow-clipping", "--quiet", "-o", out)
        shutil.copyfile(Path(out) / "contrast_response.png", folder / "enhancement" / "contrast_response.png")
        of_frames = [name for name in enhancement_names() if not find_enhancement(name).declaration.clip]
        compare(of_frames, "--allow-clipping", "--quiet", "-o", out)
        every = json.loads((Path(out) / "result.json").read_text(encoding="utf-8"))["conditions"]
    figure = frames_figure()
    figure.savefig(folder / "enhancement" / "frames.png", dpi=144, metadata={"Software": None})
    shown = "\n".join(line.rstrip() for line in result.splitlines()[:-2])
    texts = {"result": f"```text\n{shown}\n```", "every": all_of_them(every)}
    page = (HERE / "enhancement.md").read_text(encoding="utf-8")
    for name, text in texts.items():
        pattern = rf"(<!-- ={name} -->\n).*?(<!-- / -->)"
        page, found = re.subn(pattern, lambda m, text=text: f"{m[1]}{text}\n{m[2]}", page, flags=re.DOTALL)
        if found != 1:
            raise SystemExit(f"enhancement.md: found {found} places for {name}, expected 1")
    (folder / "enhancement.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute() if len(sys.argv) > 1 else HERE)
