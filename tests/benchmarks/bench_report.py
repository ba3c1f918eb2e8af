"""The report of a result with ten curves: its size, and its time against that of its figures alone."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from timing import Row, best_s, process

from todframes.results import figures
from todframes.results.examples import MOST_EXAMPLES
from todframes.results.figure_style import style
from todframes.results.result import Result, read_result
from todframes.results.thumbnails import DISPLAY_SIDE_PX, MOST_BANDS, RETINA_SIDE_PX

CURVES, LEVELS = 10, 9
SAMPLE = Path(__file__).parents[2] / "sample_frames" / "naked_eye"


def ten_curves() -> dict[str, Any]:
    """A result with as many and as large pictures of examples as there can be, all of noise."""
    rng = np.random.default_rng(0)

    def picture(name: str, side: int) -> dict[str, Any]:
        _, png = cv2.imencode(".png", rng.integers(0, 256, (side, side), dtype=np.uint8))
        return {"name": name, "png": base64.b64encode(png.tobytes()).decode(), "scale": 1.0}

    fits = []
    for size in (1.0 + 0.4 * np.arange(CURVES)).tolist():
        alpha = 0.3 / size
        levels = (alpha * 2.0 ** np.linspace(-1.5, 1.5, LEVELS)).tolist()
        threshold = alpha * np.log2(3.0) ** 0.5
        points = [{"level": x, "n_trials": 40, "p_correct": 1 - 0.75 * 2 ** -((x / alpha) ** 2)} for x in levels]
        fit = {"group": {"size_mrad": size}, "level": "contrast", "status": "ok", "threshold": float(threshold)}
        fit |= {"threshold_ci95": [0.95 * float(threshold), 1.05 * float(threshold)], "p_correct": 0.75}
        fit |= {"alpha": alpha, "beta": 2.0, "gamma": 0.25, "delta": 0.0, "n_trials": 360, "points": points}
        fits.append(fit)
    pictures = [picture("display", DISPLAY_SIDE_PX), picture("retina", RETINA_SIDE_PX)]
    # Each band has half as many samples along a side as the one before, from that of the pictures on.
    pictures += [picture(f"band {k}", max(RETINA_SIDE_PX >> max(k - 1, 0), 3)) for k in range(MOST_BANDS)]
    examples = [{"group": fit["group"], "pictures": pictures} for fit in fits[:MOST_EXAMPLES]]
    settings = {f"setting_{n}": n for n in range(30)}
    return {"schema": 1, "command": "score", "settings": settings, "fits": fits, "examples": examples}


def by_matplotlib(result: Result) -> None:
    """The same two figures, built and saved as the same kind of SVG by matplotlib alone."""
    import matplotlib as mpl

    with style(), mpl.rc_context({"svg.fonttype": "none"}):
        for picture in figures.pictures(result):
            picture.figure().savefig(io.BytesIO(), format="svg")


def rows() -> list[Row]:
    """All figures of this file."""
    result = read_result(json.dumps(ten_curves()).encode(), "result")
    size_mb = len(result.to_html()) / 2**20
    ours_s = best_s(result.to_html, 10)
    theirs_s = best_s(lambda: by_matplotlib(result), 10)
    score = ("-m", "todframes", "score", str(SAMPLE))
    with TemporaryDirectory() as folder:
        with_files, without = (
            min(process(*score, *more).cpu_s for _ in range(4)) for more in (("-o", f"{folder}/out"), ())
        )
    what = f"report of {CURVES} curves"
    return [
        Row(f"{what} with {MOST_EXAMPLES} examples, MB", size_mb, "<= 1"),
        Row("files, pictures and page of the sample, CPU s beyond scoring", with_files - without, "<= 1"),
        Row(f"{what} ({ours_s:.2f} s) ÷ matplotlib's time for its figures", ours_s / theirs_s, "<= 3"),
    ]
