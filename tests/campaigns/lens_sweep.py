"""Lenses from k1 = -0.35 to +0.1 in fine steps, by the page's width and place: are triangles where import says?

python tests/campaigns/lens_sweep.py [--k1 FROM:TO] [--widths 50 97] [--places 0 0.5] [--noise N] [--workers 2]
    [--minutes M]

All of it takes a day on one processor. The order is random, so that the cases of the first M minutes are a sample
of all. The camera is that of tests/camera, which shares nothing with the package. A width is that of the page
without the lens, in per cent of the frame's; a place is the part of the free margin, to the right and downwards,
by which the page lies beside the middle. `--noise` adds noise of so many per cent of white.

A case is a fault if the command fails although the frame shows all markers in the corners, each at least 25 pixels
wide, if triangles are misplaced by more than 0.1 px (with noise: and by three stated errors), or if NumPy warns.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(TESTS), str(TESTS / "camera"), str(TESTS / "importing")]

import numpy as np  # noqa: E402
from independent_camera import Chart  # noqa: E402
from test_filmed_charts import Film, filling, imported, make_chart, misplacement_px  # noqa: E402

from todframes.base.errors import TodframesError  # noqa: E402

K1, STEP = (-0.35, 0.1), 0.002
WIDTHS = range(50, 98)
PLACES = (0.0, 0.5, 0.9)
MARGIN_PX = 4.0
RIGHT_PX, MOST_MISPLACED_PX, MOST_RATIO = 0.05, 0.1, 3.0
LEAST_SIDE_PX = 25.0
SEED = 32


class Case(NamedTuple):
    """A lens, the page's width in per cent of the frame's, and its place in the free margin."""

    k1: float
    width: float
    place: float


class Outcome(NamedTuple):
    """How far triangles are misplaced, and by how much import says; or its error. NaN without a picture of all
    markers in the corners, whose shortest side is `side_px`."""

    case: Case
    side_px: float
    away_px: float = math.nan
    stated_px: float = math.nan
    codes: str = ""
    error: str = ""


def is_fault(one: Outcome, noise: float = 0.0) -> bool:
    """Return whether triangles should be found and are not, or misplaced: in noise, by more than is said."""
    said_px = MOST_RATIO * one.stated_px if noise else 0.0
    return bool(one.error and one.side_px >= LEAST_SIDE_PX) or one.away_px > max(MOST_MISPLACED_PX, said_px)


def tried(case: Case, folder: Path, noise: float) -> Outcome:
    """Film a page through a lens, import it, and compare."""
    electrons = 1e4 / noise if noise else 40_000.0
    light = {"electrons": electrons, "read_noise": electrons * noise / 100.0 if noise else 6.0}
    page = {"k": (case.k1, 0.0), "width": case.width / 100.0, "place": case.place}
    film = filling(Chart.read(folder), **page, **light)
    side_px = shortest_side_px(film)
    if not side_px:
        return Outcome(case, side_px)
    with tempfile.TemporaryDirectory() as made, warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            done = imported(film, film.write(Path(made) / "film.mkv"), integration_time_s="all")
        except (TodframesError, RuntimeWarning) as error:
            return Outcome(case, side_px, error=str(error).rsplit("film.mkv: ", maxsplit=1)[-1])
        try:
            away_px = misplacement_px(film, done.path)
        except ValueError:
            away_px = math.inf  # by more than three pixels
        (report,) = json.loads((done.path / "import.json").read_text(encoding="utf-8"))["found"]
        codes = ", ".join(sorted({code for code, _ in done.warnings} - {"clock"}))
        return Outcome(case, side_px, away_px, report["place_error_px"] or math.inf, codes)


def shortest_side_px(film: Film) -> float:
    """Return the shortest side of the markers in the corners; 0 if the frame does not show them whole, with the
    white about them."""
    content, lens = film.chart.content, film.bending
    assert lens is not None
    centres = [content["markers"][name] for name in ("top_left", "top_right", "bottom_right", "bottom_left")]
    middles_mm = np.array([[one["x_mm"], one["y_mm"]] for one in centres])[:, None, :]
    square_mm = content["markers"]["side_mm"] / 2.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners_mm = np.stack([middles_mm + square_mm, middles_mm + 9.0 / 7.0 * square_mm]).reshape(-1, 2)
    corners = corners_mm / content["screen"]["pixel_pitch_mm"] - 0.5
    seen = np.column_stack([corners, np.ones(len(corners))]) @ film.matrix.T
    ideal = seen[:, :2] / seen[:, 2:]
    radii = np.linspace(0.0, np.linalg.norm(ideal - lens.middle, axis=1).max() / lens.half_diagonal, 200)
    bent, farthest = lens.bent(ideal), np.array([lens.width, lens.height]) - 1 - MARGIN_PX
    if not (((bent > MARGIN_PX) & (bent < farthest)).all() and (np.diff(lens.radius(radii)) > 0.0).all()):
        return 0.0
    markers = bent.reshape(2, 4, 4, 2)[0]
    return float(np.linalg.norm(markers - np.roll(markers, 1, axis=1), axis=2).min())


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--k1", default="{}:{}".format(*K1))
    parser.add_argument("--widths", type=float, nargs="+", default=[*map(float, WIDTHS)])
    parser.add_argument("--places", type=float, nargs="+", default=PLACES)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf)
    asked = parser.parse_args()
    low, high = map(float, asked.k1.split(":"))
    k1s = [round(float(k1), 6) for k1 in np.arange(low, high + STEP / 2.0, STEP)]
    cases = [Case(*one) for one in product(k1s, asked.widths, asked.places)]
    random.Random(SEED).shuffle(cases)
    end_s = time.monotonic() + 60.0 * asked.minutes
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as made, ProcessPoolExecutor(asked.workers) as pool:
        make_chart(Path(made), sizes="2", contrasts="0.3", markers="borders")
        run = partial(tried, folder=Path(made) / "chart", noise=asked.noise)
        for first in range(0, len(cases), asked.workers):
            if time.monotonic() > end_s:
                break
            for one in pool.map(run, cases[first : first + asked.workers]):
                outcomes.append(one)
                if is_fault(one, asked.noise):
                    said = one.error or f"{one.away_px:.3f} px, stated {one.stated_px:.3f}; {one.codes}"
                    print(f"k1 {one.case.k1:+.3f}, {one.case.width:g} % at {one.case.place:g}: {said}", flush=True)
    placed = [one for one in outcomes if one.away_px >= 0.0]
    refused = [one for one in outcomes if one.error]
    beyond = [one for one in placed if one.away_px > max(RIGHT_PX, MOST_RATIO * one.stated_px)]
    print(f"{len(outcomes)} of {len(cases)} lenses, {len(placed) + len(refused)} with all corners in the frame:")
    right, narrow = (one.away_px <= RIGHT_PX for one in placed), (one.side_px < LEAST_SIDE_PX for one in refused)
    print(
        f"right to {RIGHT_PX} px: {sum(right)}; refused: {len(refused)}, {sum(narrow)} of them with narrow markers"
    )
    silent = sum(not one.codes for one in beyond)
    print(f"misplaced beyond three stated errors: {len(beyond)}, without a warning {silent}")
    farthest_px = max((one.away_px for one in placed), default=math.nan)
    ratio = max((one.away_px / one.stated_px for one in placed), default=math.nan)
    print(f"farthest {farthest_px:.3f} px, {ratio:.2f} of stated")
    print("warned:", dict(Counter(code for one in placed for code in one.codes.split(", ") if code)))
    n_faults = sum(is_fault(one, asked.noise) for one in outcomes)
    print(f"{len(outcomes)} cases, {n_faults} faults")
    return int(bool(n_faults))


if __name__ == "__main__":
    sys.exit(main())
