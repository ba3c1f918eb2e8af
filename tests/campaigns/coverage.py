"""How often the interval of the internal noise covers the true one, over simulated people; seconds to minutes.

python tests/campaigns/coverage.py 1000 --free lapse     # also: --method quest, --lapses 0.02, --trials 120

The frames of one session are shown once, and each person answers some of them with the probabilities of the model.
docs/evidence/validation.md has the figures.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "experiment"))

from people import a_monitor, sit
from scenes import SAMPLES, parser_of

from todframes import find_observer
from todframes.experiment.answers import read_answers
from todframes.experiment.calibrate import answered_trials, cells_of, noise_grid, noise_observers
from todframes.experiment.noise_fit import NoiseFit, fit_noise, with_lapses
from todframes.experiment.order import TrialOrder
from todframes.frames.dataset import load_dataset
from todframes.observers.interface import Observer
from todframes.parameters import Method
from todframes.stimulus import ORIENTATIONS, Orientation


def summary(fits: Sequence[NoiseFit], noise: float) -> dict[str, object]:
    """Return coverage and bias over some people; `bias` is the mean of ln σ̂/σ of those with an estimate."""
    ends = [(one.noise_ci95[0] or 0.0, one.noise_ci95[1] or math.inf) for one in fits]
    below, above = sum(noise < low for low, _ in ends), sum(noise > high for _, high in ends)
    ratios = np.log([one.noise / noise for one in fits if one.noise is not None])
    p_values = [one.deviance_p_value for one in fits if one.deviance_p_value is not None]
    of_people = {"n": len(fits), "covered": 1.0 - (below + above) / len(fits), "below": below, "above": above}
    of_bias = {"bias": float(ratios.mean()), "bias_error": float(ratios.std() / math.sqrt(len(ratios)))}
    of_bias |= {"spread": float(ratios.std()), "statuses": dict(Counter(one.status for one in fits))}
    return of_people | of_bias | {"small_p": float(np.mean(np.array(p_values) <= 0.05)) if p_values else math.nan}


def redrawn(
    n: int, *, observer: Observer, noise: float, lapses: float, free: bool, method: Method, trials: int, seed: int
) -> Iterator[NoiseFit]:
    """Yield the fit of each person who answers frames of one session, in an order of their own."""
    dataset = load_dataset(SAMPLES / "naked_eye")
    with TemporaryDirectory() as folder:
        sit(dataset, Path(folder), lambda *_: Orientation.UP, a_monitor(dataset.display.pitch_mrad))
        (session,) = read_answers(folder)
    observers, blurs = noise_observers(observer, dataset.trials[0].stimulus, blur_is_free=False)
    answered = answered_trials(dataset, session, observers)
    table = answered.table(noise_grid([answered]), blurs)
    # A lapse is a guess with probability λ, and δ = λ (1 − γ).
    p_correct = with_lapses(table.at(np.log([noise]))[:, 0, 0], 0.75 * lapses)
    cells = cells_of([answered])
    shown = {row.frame: (place, row) for place, row in enumerate(session.main_rows())}
    frames = [trial.frames[0].path for trial in dataset.trials]
    for number in range(n):
        rng = np.random.default_rng([seed, number])
        record = replace(session.record, method=method, trials=trials, seed=number)
        order, rows, places = TrialOrder(dataset.trials, record), [], []
        while (following := order.next(rows)) is not None:
            place, row = shown[frames[following.row]]
            wrong = next(one for one in ORIENTATIONS if one is not row.orientation)
            response = row.orientation if rng.random() < p_correct[place] else wrong
            rows.append(replace(row, number=len(rows) + 1, response=response))
            places.append(place)
        is_correct = np.array([row.is_correct for row in rows])
        cell = np.unique(cells[places], return_inverse=True)[1]
        rates, resamples = (0.0, 0.05 if free else 0.0), 0 if free else 200
        answers = table.select(np.array(places))
        yield fit_noise(answers, is_correct, cell, lapse_rates=rates, resamples=resamples, rng=rng)


def main() -> int:
    """Print coverage and bias; exit status 1 where they are beyond 93 to 98 %, and 2 %."""
    parser = parser_of(__doc__)
    parser.add_argument("--method", choices=["constant", "quest"], default="constant")
    parser.add_argument("--observer", choices=["pyramid", "csf"], default="pyramid")
    parser.add_argument("--noise", type=float, default=0.35, help="0.1 of csf, an efficiency of 100")
    parser.add_argument("--lapses", type=float, default=0.0, help="probability of a guess")
    parser.add_argument("--free", choices=["lapse"])
    parser.add_argument("--trials", type=int, default=240)
    asked = vars(parser.parse_args())
    n, noise = asked.pop("n"), asked["noise"]
    asked["free"] = asked["free"] is not None
    asked["observer"] = find_observer(asked["observer"])()
    found = summary(list(redrawn(n, **asked)), noise)
    print(found)
    return int(not (0.93 <= found["covered"] <= 0.98 and abs(found["bias"]) <= 0.02))


if __name__ == "__main__":
    sys.exit(main())
