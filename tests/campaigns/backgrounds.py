"""How often the intervals of thresholds and of their ratio cover the true ones where backgrounds differ; minutes.

python tests/campaigns/backgrounds.py 300                  # six kinds of comparison, 300 of each
python tests/campaigns/backgrounds.py 1000 --only "8 scenes"

No image is made. Each background has its own threshold and its own effect of the algorithm, both log-normal, and
each trial its own noise, which both ways of showing it share. The true ratio is that of the thresholds of the mean
curves over 20,000 backgrounds, and the true threshold is that of the first of them. docs/evidence/index.md and
docs/how_to/scenes.md have the figures.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scenes import parser_of

from todframes.psychometrics.bootstrap import draw_backgrounds
from todframes.psychometrics.curves import d_prime_of, observer_curve
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.psychometrics.paired_bootstrap import ratio_draws, threshold_draws, threshold_ratio

Array = NDArray[np.float64]

LEVELS = np.geomspace(0.4, 2.5, 7)


class Kind(NamedTuple):
    """A kind of comparison.

    `spread` and `ratio_spread` are the standard deviations over backgrounds of ln threshold and of ln ratio,
    `noise` that of a trial's ln level. With `sampled`, answers of 0 and 1 are drawn.
    """

    name: str
    scenes: int
    trials: int
    spread: float
    ratio_spread: float
    noise: float
    groups: int = 1
    sampled: bool = False


KINDS = (
    Kind("8 scenes, effects differ", 8, 4, 0.3, 0.15, 0.2),
    Kind("8 scenes, the same effect", 8, 4, 0.3, 0.0, 0.2),
    Kind("8 scenes, alike in all", 8, 4, 0.0, 0.0, 0.3),
    Kind("4 scenes, effects differ", 4, 8, 0.3, 0.15, 0.2),
    Kind("20 scenes, effects differ much", 20, 4, 0.4, 0.4, 0.2),
    Kind("8 scenes, three groups together", 8, 4, 0.3, 0.15, 0.2, groups=3),
    Kind("8 scenes, answers drawn", 8, 8, 0.3, 0.15, 0.0, sampled=True),
)

TRUE_RATIO = 0.9
SETTINGS = FitSettings(resamples=1000)


def p_correct(level: Array, ln_threshold: Array) -> Array:
    """Compute the proportion correct of an observer with this ln threshold at 75 %."""
    alpha = 1.0 / d_prime_of(0.75)
    return observer_curve(level * np.exp(-ln_threshold), alpha=alpha, beta=1.0, max_d_prime=None)


def true_values(kind: Kind, rng: np.random.Generator) -> tuple[float, float]:
    """Compute the threshold of the mean curve over very many backgrounds, and its ratio with the algorithm."""
    n, fine = 20_000, np.geomspace(0.2, 5.0, 200)
    own, effect = rng.normal(0.0, kind.spread, n), rng.normal(math.log(TRUE_RATIO), kind.ratio_spread, n)
    noise = rng.normal(0.0, kind.noise, n)
    found = []
    for ln_threshold in (own, own + effect):
        curve = np.array([p_correct(np.full(n, x), ln_threshold + noise).mean() for x in fine])
        found.append(float(np.interp(0.75, curve, np.log(fine))))
    return math.exp(found[0]), math.exp(found[1] - found[0])


Ends = tuple[float, float]


def comparison(kind: Kind, rng: np.random.Generator) -> tuple[float, Ends, Ends]:
    """Simulate a comparison; return the p-value of the ratio, and the intervals of ratio and threshold."""
    scene = np.tile(np.repeat(np.arange(kind.scenes), kind.trials), len(LEVELS))
    level = np.repeat(LEVELS, kind.scenes * kind.trials)
    own = rng.normal(0.0, kind.spread, kind.scenes)
    effect = rng.normal(math.log(TRUE_RATIO), kind.ratio_spread, kind.scenes)
    drawn = draw_backgrounds(kind.scenes, SETTINGS.resamples, rng)
    assert drawn is not None
    curve, draws = "weibull" if kind.sampled else "observer", []
    for _ in range(kind.groups):
        noise = rng.normal(0.0, kind.noise, level.size)
        series = np.array([p_correct(level, own[scene] + noise + k * effect[scene]) for k in (0, 1)])
        if kind.sampled:
            series = (rng.random(level.size) < series).astype(np.float64)
        quick = FitSettings(resamples=0)
        fits = [fit_trials(level, one, curve=curve, settings=quick, rng=rng) for one in series]
        how = {"settings": SETTINGS, "rng": rng, "backgrounds": scene}
        reference, other = threshold_draws(level, series, fits, drawn_backgrounds=drawn, **how)
        draws.append(ratio_draws(other, reference))
        alone = fit_trials(level, series[0], curve=curve, **how)
    ratio = threshold_ratio(draws)
    return ratio.p_value, ends(ratio.ratio_ci95), ends(alone.threshold_ci95)


def ends(interval: tuple[float | None, float | None] | None) -> Ends:
    """Return the ends of an interval, open ones as 0 and infinity."""
    low, high = interval or (None, None)
    return low or 0.0, math.inf if high is None else high


def main() -> int:
    """Print the coverage of each kind; exit status 1 if one is outside 93 to 97 % beyond chance."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="part of the name of a kind")
    asked = parser.parse_args()
    status = 0
    for kind in KINDS:
        if asked.only not in kind.name:
            continue
        threshold, ratio = true_values(kind, np.random.default_rng(0))
        found = [comparison(kind, np.random.default_rng([asked.seed, number])) for number in range(asked.n)]
        small = np.mean([p_value < 0.05 for p_value, *_ in found])
        width = np.median([math.log(high / low) if low else math.inf for _, (low, high), _ in found])
        error = math.sqrt(0.95 * 0.05 / asked.n)
        shares = [
            np.mean([low <= true <= high for low, high in intervals])
            for true, intervals in zip((ratio, threshold), list(zip(*found, strict=True))[1:], strict=True)
        ]
        is_good = all(0.93 - 2.0 * error <= share <= 0.97 + 2.0 * error for share in shares)
        status |= not is_good
        print(
            f"{kind.name:34} {100 * shares[0]:5.1f} % ± {100 * error:.1f} of {asked.n} ratios cover, "
            f"{100 * shares[1]:5.1f} % of thresholds, {100 * small:.0f} % differ from 1, "
            f"width {100 * width:.1f} %{'' if is_good else '  !'}",
            flush=True,
        )
    return status


if __name__ == "__main__":
    raise SystemExit(main())
