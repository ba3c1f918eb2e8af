"""Thresholds of four bars of random sensors and frequencies: against code apart, and how often their errors hold.

python tests/campaigns/bars.py apart 40     # mean over phases and best phase against dense matrices; 5 minutes
python tests/campaigns/bars.py errors 100   # how often the stated error of the mean holds; 5 minutes

`apart` uses the brute force of `tests/test_four_bars.py`, which shares no code with the packages. The exit status
is 1 if a threshold is off by more than 1 %, or fewer than 93 % of the errors hold.
"""

from __future__ import annotations

import argparse
import math
import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from test_four_bars import COARSE, NYQUIST, SENSOR, BruteForce, threshold

from sensor_sim.thresholds.bars import BarChain
from todframes.observers.pyramid import PyramidObserver

MOST_OFF = 0.01
"""Largest difference of a threshold from that of code apart."""

LEAST_HELD = 0.93
"""Smallest share of the errors that hold."""

PLACES = 7
"""Places from 0 to half a detector along each axis, of code apart."""


def drawn_chain(rng: np.random.Generator) -> BarChain:
    """Draw a frequency from 0.4 to 1.3 times Nyquist, the display without bars, and the internal noise."""
    observer = PyramidObserver(**COARSE, internal_noise=float(rng.uniform(0.1, 0.8)))
    against = "square" if rng.random() < 0.5 else "background"
    return BarChain(SENSOR, observer, float(rng.uniform(0.4, 1.3)) * NYQUIST, against=against)


def lowest(parts: list[tuple[float, float, float]], internal: float) -> float | None:
    """Return the threshold at a place; None if no SNR is enough there."""
    try:
        return threshold(parts, internal)
    except ValueError:  # there is no root
        return None


def apart(n: int, rng: np.random.Generator) -> bool:
    """Compare thresholds with those of dense matrices; returns whether all agree."""
    worst = {"mean over phases": 0.0, "best phase": 0.0}
    for _ in range(n):
        chain = drawn_chain(rng)
        frequency = 0.5 / chain.bars.bar_width / SENSOR.detector.pitch_mrad
        brute = BruteForce(frequency, chain.bars.against, chain.whole_retina.side, chain.field)
        internal = brute.internal * (chain.observer.settings.internal_noise / 0.5) ** 2
        moved = chain.jitter_detectors * np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) / math.sqrt(3.0)
        places = np.linspace(0.0, 0.5, PLACES)
        ends = np.where((places == 0.0) | (places == 0.5), 0.5, 1.0)
        parts = [
            [(*one, ends[i] * ends[j]) for one in brute.at(x, y, moved)]
            for i, x in enumerate(places)
            for j, y in enumerate(places)
        ]
        averaged, best = chain.averaged(0.75), chain.best(0.75)
        reached = [found for found in map(partial(lowest, internal=internal), parts) if found is not None]
        if averaged.snr is None or best.snr is None:
            print(f"{frequency / NYQUIST:.3f} Nyquist against {chain.bars.against}: {averaged.status}")
            continue
        off = {
            "mean over phases": averaged.snr / threshold(np.concatenate(parts), internal) - 1.0,
            "best phase": best.snr / min(reached) - 1.0,
        }
        for name, value in off.items():
            worst[name] = max(worst[name], abs(value))
            if abs(value) > MOST_OFF:
                print(
                    f"{frequency / NYQUIST:.3f} Nyquist against {chain.bars.against}: {name} {100 * value:+.2f} %"
                )
    print(", ".join(f"{name}: at most {100 * value:.2f} % off" for name, value in worst.items()), f"in {n} cases")
    return max(worst.values()) <= MOST_OFF


def errors(n: int, rng: np.random.Generator) -> bool:
    """Count how often the stated error holds a mean from many more places; return whether often enough."""
    held = []
    while len(held) < n:
        chain = drawn_chain(rng)
        rough, exact = chain.averaged(0.75, tolerance=0.01, seed=1), chain.averaged(0.75, tolerance=1e-9, seed=2)
        if rough.snr is None or exact.snr is None or rough.numerical_error is None:
            continue
        held.append(abs(rough.snr - exact.snr) <= rough.numerical_error + (exact.numerical_error or 0.0))
    print(f"{100 * np.mean(held):.1f} % of {n} errors hold")
    return bool(np.mean(held) >= LEAST_HELD)


def main() -> int:
    """Run one campaign; return 1 if it found a fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign", choices=["apart", "errors"])
    parser.add_argument("number", type=int, nargs="?", default=40)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    run = {"apart": apart, "errors": errors}[asked.campaign]
    return 0 if run(asked.number, np.random.default_rng(asked.seed)) else 1


if __name__ == "__main__":
    sys.exit(main())
