"""Charts filmed through lenses: where import places triangles, and what that does to thresholds; an hour.

python tests/campaigns/lenses.py [CASES]        # cases whose row has this text; all by default

Charts have markers along the borders, or in the corners alone.

The camera is that of tests/camera, which shares nothing with the package. Each case is a film of 16 pages, two
frames each, or eight with noise. The exit status is 1 if triangles are misplaced by more than 0.1 px, or if a
threshold differs by more than 1 % (2 % for k1 = -0.3) from that of frames placed by hand, without a warning or an
error.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(TESTS), str(TESTS / "camera")]

from test_filmed_charts import (  # noqa: E402
    LENS_VIEWS,
    LINEAR,
    SCORING,
    by_hand,
    imported,
    make_chart,
    misplacement_px,
    thresholds,
    through_lens,
)

import todframes as tod  # noqa: E402
from todframes.base.errors import TodframesError  # noqa: E402

AT_40_DEGREES = "at 40° in a diagonal direction"
LENS_VIEWS[AT_40_DEGREES] = (1440, 960, {"scale": 0.69, "shift_px": (577, 384)})
VIEWS = ("centred", "off axis", "in a quarter")
K1 = (-0.3, -0.1, -0.04, -0.02, -0.01, 0.1)
MOST_MISPLACED_PX = 0.1
TRUE_WARNINGS = {"residual", "few_points", "lens_stretch", "misplaced", "tilted", "zoom"}


def cases() -> Iterator[tuple[str, str, dict[str, Any], float]]:
    """Yield the name of a case, its view, its lens, and the largest relative difference of a threshold."""
    for k1 in K1:
        for view in VIEWS:
            yield f"k1 {k1:+.2f}, {view}", view, {"k": (k1,)}, 0.02 if k1 == -0.3 else 0.01
    for view in ("centred", AT_40_DEGREES):
        yield f"fisheye of 120°, {view}", view, {"fisheye_deg": 120.0}, 0.01


def main(arguments: Sequence[str]) -> int:
    """Run the cases and print a row for each. Returns the exit status."""
    asked = arguments[0] if arguments else ""
    n_faults = n_cases = 0
    print(
        "| markers | noise | lens, place | misplaced, px | stated, px | threshold / by hand | model | warnings |",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as made:
        for markers, noise in itertools.product(("borders", "corners"), (False, True)):
            of_markers = Path(made) / f"{markers}_{noise:d}"
            of_markers.mkdir()
            chart = make_chart(of_markers, sizes="4", contrasts="0.03,0.06,0.12,0.24", markers=markers)
            for number, (name, view, lens, tolerance) in enumerate(cases()):
                row = f"| {markers} | {'10 %' if noise else 'none'} | {name} |"
                if asked not in row:
                    continue
                folder = of_markers / f"case_{number}"
                folder.mkdir()
                film = through_lens(chart, view, noise=noise, **lens)
                n_cases += 1
                try:
                    done = imported(film, film.write(folder / "film.mkv"))
                except TodframesError as error:
                    print(f"{row} | | | | {str(error).split('film.mkv: ')[-1]} |", flush=True)
                    continue
                (report,) = json.loads((done.path / "import.json").read_text(encoding="utf-8"))["found"]
                away_px = misplacement_px(film, done.path)
                try:
                    (ratio,) = (
                        found / expected
                        for found, expected in zip(
                            thresholds(tod.score(done.path, **SCORING)).values(),
                            by_hand(film, done.path, LINEAR).values(),
                            strict=True,
                        )
                    )
                except AssertionError:
                    ratio = float("nan")
                codes = {code for code, _ in done.warnings} - {"clock"}
                is_right = away_px <= MOST_MISPLACED_PX and not abs(ratio - 1.0) > tolerance
                n_faults += not is_right and not codes & TRUE_WARNINGS
                model = report["lens"]["model"] if report["lens"] else "ideal"
                print(
                    f"{row} {away_px:.3f} | {report['place_error_px']:.3f} | {ratio:.4f} | {model} | "
                    f"{', '.join(sorted(codes))} |",
                    flush=True,
                )
    print(f"{n_cases} cases, {n_faults} faults")
    return int(bool(n_faults))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
