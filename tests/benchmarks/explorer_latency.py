"""Latency of the explorer in a browser: from the key that moves a slider to the painted curve.

    python tests/benchmarks/explorer_latency.py [MOVES]

Chromium, without a window, presses arrow keys on sliders one after the other. Time starts with the time stamp of
the key's event and ends in the second animation frame after the curve was drawn, when the frame that shows it has
been made. Between two moves there is a random pause, so that some moves end a refinement and others come after it.
"""

from __future__ import annotations

import random
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from bench_accuracy import LOW_FILL_FACTOR, STAR_LIKE, UNDER_SAMPLED
from playwright.sync_api import sync_playwright

from sensor_sim.chain.sensor import Sensor, sensor_toml

sys.path.append(str(Path(__file__).parents[1]))

from browser import serving, wait_until, watched

if TYPE_CHECKING:
    from playwright.sync_api import Browser

MOVES = 200
MOVES_OF_ONE = 5
HIGHEST = 8
REFINED_EVERY = 10
LONGEST_PAUSE_MS = 400
SENSORS = {"star-like": STAR_LIKE, "under-sampled": UNDER_SAMPLED, "low fill factor": LOW_FILL_FACTOR}
SLIDERS = (
    "optics.aperture_mm",
    "optics.blur_sigma_mrad",
    "detector.width_mrad",
    "noise.fixed_pattern_ratio",
    "display.blur_sigma_px",
    "display.viewing_distance_mm",
    "display.gain",
    "observer.internal_noise",
)

WATCH = """
const asked = new Map();
let pressed = 0;
window.painted = [];
addEventListener("keydown", (event) => { pressed = event.timeStamp; }, true);
const send = window.fetch;
window.fetch = (path, options) => {
  if (path === "/api/curve") asked.set(String(JSON.parse(options.body).sequence), [pressed, performance.now()]);
  return send(path, options);
};
addEventListener("DOMContentLoaded", () => {
  const curve = document.querySelector("#curve");
  new MutationObserver(() => {
    const { sequence, stage } = curve.dataset;
    const times = [...asked.get(sequence), performance.now()];
    const note = () => painted.push({ sequence, stage, times: [...times, performance.now()] });
    requestAnimationFrame(() => requestAnimationFrame(note));
  }).observe(curve, { attributeFilter: ["data-sequence", "data-stage"] });
});
"""


class Latencies(NamedTuple):
    """Times of all moves in ms: until the request, from there until the curve is drawn, and from there until it is
    painted; and from a key until the refined curve is painted."""

    asking: list[float]
    answering: list[float]
    painting: list[float]
    refined: list[float]

    @property
    def estimated(self) -> np.ndarray:
        """Time from the key until the estimate is painted."""
        return np.sum([self.asking, self.answering, self.painting], axis=0)


def walk(moves: int, chance: random.Random) -> Iterator[tuple[str, int]]:
    """Yield sliders and steps of ±1: some moves of one, then some of another, and no sensor twice.

    Positions stay within `HIGHEST` steps above those of the file, so that no blur is below 0.
    """
    position, known = dict.fromkeys(SLIDERS, 0), {(0,) * len(SLIDERS)}
    key = SLIDERS[0]
    while moves:
        if chance.random() < 1.0 / MOVES_OF_ONE:
            key = chance.choice(SLIDERS)
        step = chance.choice((-1, 1))
        moved = position | {key: position[key] + step}
        if 0 <= moved[key] <= HIGHEST and (sensor := tuple(moved.values())) not in known:
            known.add(sensor)
            position = moved
            moves -= 1
            yield key, step


def measure(browser: Browser, sensor: Sensor, moves: int) -> Latencies:
    """Move sliders of a sensor and return how long the curves took."""
    chance, found = random.Random(1), Latencies([], [], [], [])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "sensor.toml")
        # A little narrower than the pitch, so that the slider of the width can move up as well.
        detector = replace(
            sensor.detector, width_mrad=min(sensor.detector.width_mrad, 0.9 * sensor.detector.pitch_mrad)
        )
        file.write_text(sensor_toml(replace(sensor, detector=detector)), encoding="utf-8")
        with (
            serving("sensor_sim", "explore", file, "--no-browser") as server,
            watched(browser, server.url, script=WATCH) as page,
        ):
            wait_until(page, "document.querySelector('#curve').dataset.stage === 'refined'")
            for move, (key, step) in enumerate(walk(moves, chance)):
                page.focus(f".field:has(#field-{key.replace('.', '-')}) input[type=range]")
                before = page.evaluate("Number(document.querySelector('#curve').dataset.sequence)")
                page.keyboard.press("ArrowRight" if step > 0 else "ArrowLeft")
                first = wait_until(page, "(before) => painted.find((one) => one.sequence > before)", before)
                pressed, requested, drawn, shown = first["times"]
                found.asking.append(requested - pressed)
                found.answering.append(drawn - requested)
                found.painting.append(shown - drawn)
                if move % REFINED_EVERY == 0:
                    last = wait_until(
                        page,
                        "(number) => painted.find((one) => one.sequence === number && one.stage === 'refined')",
                        first["sequence"],
                    )
                    found.refined.append(last["times"][3] - pressed)
                page.wait_for_timeout(chance.uniform(0, LONGEST_PAUSE_MS))
    return found


def described(values: Sequence[float] | np.ndarray) -> str:
    """Return the median and the 95th percentile of times as a text."""
    return f"{np.median(values):7.0f} {np.percentile(values, 95):7.0f}"


def main(moves: int) -> None:
    """Print a table of medians and 95th percentiles."""
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        print(f"{moves} moves; median and 95th percentile in ms; asked of an estimate 100 and 200, refined 2000")
        print(f"{'':<18}{'estimate':>15}{'ask':>16}{'answer':>16}{'paint':>16}{'refined':>16}")
        for name, sensor in SENSORS.items():
            found = measure(browser, sensor, moves)
            parts = [found.estimated, found.asking, found.answering, found.painting, found.refined]
            print(f"{name:<18}" + " ".join(described(part) for part in parts), flush=True)
        browser.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else MOVES)
