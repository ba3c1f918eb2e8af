"""How often the 95 % interval of a range in the field holds the true range, over simulated measurements; minutes.

python tests/campaigns/field_ranges.py tables 300    # MRTD of an imager, each point measured with a stated error
python tests/campaigns/field_ranges.py people 300    # a TOD of people's answers, fitted by `fit_counts`

The true curves are a exp(b f), whose ranges are closed forms: nothing of the package is used for them. The exit
status is 1 if the intervals at 50 % hold less than 93 or more than 97 % of the true ranges.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scenes import parser_of

import todframes as tod
from todframes.field.acquisition import TaskRange

DELTA_T_K, SIZE_M, EXTINCTION_PER_KM = 2.0, 2.3, 0.2
A_K, B_MRAD = 0.02, 1.0
LINE_PAIRS = {"detection": 1.0, "recognition": 3.0, "identification": 6.0}
AIR = tod.Atmosphere(extinction_per_km=EXTINCTION_PER_KM)
NORMAL_95 = 1.959964

LN_SD = (0.05, 0.2)
"""Least and largest standard deviation of ln MRTD at a point: laboratories differ by 5 to 20 %."""

BETA, GUESS_RATE, LAPSE_RATE = 2.5, 0.25, 0.01
"""Weibull function of the simulated people (Hogervorst et al. 2001, eq. 3)."""

SIZES_MRAD = (2.0, 1.0, 0.6, 0.4, 0.3, 0.22, 0.18)
TRIALS = 40
"""Number of trials of a size and level, as in the paper."""

Case = tuple[float, float, float, tuple[float | None, float | None]]
"""Probability, and true range, range and interval in km."""


def true_range_km(kappa: float, ln_ratio: float = 0.0) -> float:
    """Return R of ΔT exp(−σ R) = a exp(ln_ratio + b κ R / size)."""
    return (math.log(DELTA_T_K / A_K) - ln_ratio) / (EXTINCTION_PER_KM + B_MRAD * kappa / SIZE_M)


def case(found: TaskRange, true_km: float) -> Case:
    return found.probability, true_km, found.range_km or math.nan, found.range_ci95_km or (None, None)


def of_table(rng: np.random.Generator) -> list[Case]:
    """Measure an MRTD at six frequencies with errors that the table states; return the ranges at 50 %."""
    frequency = np.array([0.3, 1.0, 2.0, 3.0, 4.0, 5.5]) * rng.uniform(0.8, 1.2)
    sd = rng.uniform(*LN_SD, frequency.size)
    measured = A_K * np.exp(B_MRAD * frequency + sd * rng.standard_normal(frequency.size))
    factor = np.exp(NORMAL_95 * sd)
    columns = zip(frequency, measured, measured / factor, measured * factor, strict=True)
    lines = [",".join(repr(float(one)) for one in row) for row in columns]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mrtd.csv"
        path.write_text("\n".join(["frequency_cyc_per_mrad,mrtd_k,ci95_low,ci95_high", *lines]))
        target = tod.Target(size_m=SIZE_M, delta_t_k=DELTA_T_K)
        found = tod.acquisition_range(path, target=target, atmosphere=AIR, rng=rng).numbers.ranges
    return [case(one, true_range_km(LINE_PAIRS[one.task])) for one in found if one.probability == 0.5]


def of_people(rng: np.random.Generator) -> list[Case]:
    """Let a person judge triangles of seven sizes at seven levels; return the ranges at 50, 75 and 90 % correct.

    The threshold of the curve is at 75 % correct; eq. 3 gives the other levels.
    """

    def halves(p_correct: float) -> float:
        return math.log2((1.0 - LAPSE_RATE - GUESS_RATE) / (1.0 - LAPSE_RATE - p_correct))

    rows = []
    for size in SIZES_MRAD:
        threshold = A_K * math.exp(B_MRAD / size)
        alpha = threshold / halves(0.75) ** (1.0 / BETA)
        for level in threshold * np.geomspace(0.4, 2.2, 7) * rng.uniform(0.9, 1.1):
            p = 1.0 - LAPSE_RATE - (1.0 - LAPSE_RATE - GUESS_RATE) * 2.0 ** -((level / alpha) ** BETA)
            rows.append((size, float(level), int(rng.binomial(TRIALS, p)), TRIALS))
    sizes, levels, right, trials = zip(*rows, strict=True)
    fitted = tod.fit_counts(levels, right, trials, groups={"object_size_mrad": sizes}, rng=rng)
    target = tod.Target(size_m=SIZE_M, delta_t_k=DELTA_T_K, k={"seen": 3.0})
    found = tod.acquisition_range(fitted, target=target, atmosphere=AIR, rng=rng).numbers.ranges
    ln_ratios = [math.log(halves(one.probability) / halves(0.75)) / BETA for one in found]
    return [case(one, true_range_km(3.0, ln_ratio)) for one, ln_ratio in zip(found, ln_ratios, strict=True)]


def coverage(measure: Callable[[np.random.Generator], list[Case]], n: int, seed: int) -> bool:
    """Print how often the intervals hold, and the bias; return whether it is as asked."""
    cases = [measure(np.random.default_rng([seed, number])) for number in range(n)]
    as_asked = True
    for of_task in zip(*cases, strict=True):
        below = sum(low is not None and true < low for _, true, _, (low, _) in of_task)
        above = sum(high is not None and true > high for _, true, _, (_, high) in of_task)
        ratios = np.log([value / true for _, true, value, _ in of_task])
        held = 100.0 * (1.0 - (below + above) / n)
        print(
            f"P {of_task[0][0]:g}, {of_task[0][1]:.4f} km: held {held:.1f} %, {below} below, {above} above; "
            f"bias {100.0 * np.nanmean(ratios):+.2f} %, SD {100.0 * np.nanstd(ratios):.2f} %, "
            f"{int(np.isnan(ratios).sum())} without a range"
        )
        as_asked &= of_task[0][0] != 0.5 or 93.0 <= held <= 97.0
    return as_asked


def main() -> int:
    asked = parser_of(__doc__, "tables", "people").parse_args()
    return int(not coverage(of_table if asked.part == "tables" else of_people, asked.n, asked.seed))


if __name__ == "__main__":
    sys.exit(main())
