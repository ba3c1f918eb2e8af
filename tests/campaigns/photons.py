"""How often the 95 % intervals of EMVA 1288's figures hold the truth of simulated cameras; ten minutes.

python tests/campaigns/photons.py 300

Each seed draws a camera's patterns and films pairs at seven exposures, and stacks of 16 at half of saturation,
bright and dark. The exit status is 1 if the intervals of gain, dark noise, DSNU or PRNU hold less than 93 or more
than 97 % of the true values of all cameras together.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from photon_camera import PhotonCamera

import todframes as tod

CAMERAS = {
    "ccd": PhotonCamera(),
    "fine": PhotonCamera(
        quantum_efficiency=0.7, gain_dn_per_electron=1.5, read_noise_electrons=2.0, dsnu_electrons=1.0,
        dark_current_electrons_per_s=50.0, prnu_percent=1.5, full_well_electrons=2_500.0,
    ),
    "uniform": PhotonCamera(dsnu_electrons=0.5, prnu_percent=0.3),
}  # fmt: skip
EXPOSURES_MS = (2.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
FRAMES = {False: 2, True: 16}
SIDE = 96
HELD = ("system_gain", "dark_noise", "dsnu", "prnu")


def measured(camera: PhotonCamera, seed: int) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """Return the intervals of one simulated experiment, and the truth."""
    rng = np.random.default_rng([1288, seed])
    patterns = camera.patterns(rng, (SIDE, SIDE))
    # The longest exposure is at 0.65 of the full well, so all pairs are fitted.
    per_ms = 0.65 * camera.full_well_electrons / camera.quantum_efficiency / max(EXPOSURES_MS)
    asked = [(ms, False) for ms in EXPOSURES_MS] + [(20.0, True)]
    bright, dark = (
        [
            camera.film(rng, patterns, FRAMES[is_stack], photons=light * ms, exposure_ms=ms)
            for ms, is_stack in asked
        ]
        for light in (per_ms, 0.0)
    )
    found = tod.emva_noise(
        bright=bright, dark=dark, exposure_ms=[ms for ms, _ in asked], photons=[per_ms * ms for ms, _ in asked],
        bits=camera.bits,
    ).measured  # fmt: skip
    truth = {
        "system_gain": camera.gain_dn_per_electron,
        "quantum_efficiency": camera.quantum_efficiency,
        "dark_noise": camera.dark_noise_electrons(min(EXPOSURES_MS)),
        "dark_current": camera.dark_current_electrons_per_s,
        "dsnu": camera.dsnu_electrons,
        "prnu": camera.prnu_percent,
    }
    intervals = {name: getattr(found, name).ci95 for name in truth}
    return intervals, truth


def main() -> int:
    """Print how often intervals hold, and their mean half-widths."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("n", type=int, nargs="?", default=300)
    parser.add_argument("--camera", choices=CAMERAS)
    asked = parser.parse_args()
    of_all: dict[str, list[bool]] = {}
    for name, camera in CAMERAS.items():
        if asked.camera not in (None, name):
            continue
        held: dict[str, list[bool]] = {}
        widths: dict[str, list[float]] = {}
        for seed in range(asked.n):
            intervals, truth = measured(camera, seed)
            for key, (low, high) in intervals.items():
                held.setdefault(key, []).append(low <= truth[key] <= high)
                widths.setdefault(key, []).append((high - low) / 2.0 / truth[key])
        for key, cases in held.items():
            share = 100.0 * np.mean(cases)
            width = 100.0 * np.mean(widths[key])
            print(f"{name:8} {key:20} {share:5.1f} % of {len(cases)} hold; half-width {width:.2g} %")
            of_all.setdefault(key, []).extend(cases)
    is_good = True
    for key, cases in of_all.items():
        share = 100.0 * np.mean(cases)
        print(f"all      {key:20} {share:5.1f} % of {len(cases)} hold")
        is_good &= key not in HELD or 93.0 <= share <= 97.0
    print("good" if is_good else "intervals hold less or more often than they say")
    return not is_good


if __name__ == "__main__":
    sys.exit(main())
