"""The scores of single trials: frames are shown to the observer with one or many displacements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.seeds import random_stream
from todframes.frames.dataset import Dataset
from todframes.frames.trials import Trial, Trials
from todframes.observers.interface import Observer, Readout
from todframes.observers.internal_noise import inner_product
from todframes.observers.retina import RetinaGrid
from todframes.parameters import Decisions, PlanName
from todframes.scoring.error_budget import REPLICATES
from todframes.scoring.retina_view import TrialPatches, read_trial, retina_image
from todframes.stimulus import Stimulus

NO_ANSWER = -1
"""Answer of a trial for which none was drawn."""

# First elements of the spawn keys of random streams: they keep the streams of trials and fits apart.
TRIAL_STREAMS, FIT_STREAMS, DISPLACEMENT_STREAMS, RATIO_STREAMS = range(4)

KRONECKER_STEPS_2D = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of a two-dimensional low-discrepancy sequence, powers of the root of x³ = x + 1 (Roberts 2018)."""


class TrialScore(NamedTuple):
    """The observer's scores of a trial and, if drawn, its answer. `displacement_samples`, (d, 2), are
    displacements of the retina along x and y. `scores` and `deviations`, (d, 4), are noise-free inner products
    with the templates, and their deviations from their mean, computed without cancellation; NaN if the observer is
    not linear. Then `probabilities`, (d, 4), are its expected answers; NaN if it is linear or has none.
    """

    displacement_samples: FloatArray
    scores: FloatArray
    deviations: FloatArray
    probabilities: FloatArray
    answer: int
    n_negative: int
    background_luminance_cd_m2: float


class TrialScores:
    """The observer's scores of many trials with equal numbers of displacements, set in any order. `seen["scores"]`
    has the `TrialScore.scores` of each trial, and so for its other attributes.
    """

    def __init__(self, trials: Trials, table: NDArray[Any] | None = None) -> None:
        self.trials, self._table = trials, table
        self._is_seen = np.full(len(trials), table is not None)

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, name: str) -> NDArray[Any]:
        assert self._table is not None
        return np.asarray(self._table[name])

    def put(self, row: int, seen: TrialScore) -> None:
        """Set the scores of a trial; all trials have as many displacements as the first."""
        if self._table is None:
            values = [(name, np.asarray(value)) for name, value in seen._asdict().items()]
            row_type = np.dtype([(name, value.dtype, value.shape) for name, value in values])
            self._table = np.zeros(len(self.trials), row_type)
        self._table[row], self._is_seen[row] = seen, True

    def usable(self) -> TrialScores:
        """Return the trials whose scores were set, in the order of the trials."""
        return self if self._is_seen.all() else self.select(np.flatnonzero(self._is_seen))

    def select(self, rows: NDArray[np.intp]) -> TrialScores:
        """Return some of the trials, by row."""
        return TrialScores(self.trials.select(rows), None if self._table is None else self._table[rows])

    def amplified(self, gain: FloatArray) -> TrialScores:
        """Return the scores after a plain gain of contrast, one gain for each trial; scores are linear in
        contrast."""
        assert self._table is not None
        table = self._table.copy()
        for name in ("scores", "deviations"):
            scores = table[name].T
            scores *= gain
        return TrialScores(self.trials, table)


@dataclass(frozen=True, slots=True)
class Scoring:
    """The settings for the scoring of all trials of a dataset. `displacements` is the number of displacements of
    each trial in each replicate; 0: a single one, from the trial's own random stream. With the plan "full" whole
    frames are decoded and the whole grid is looked at.
    """

    dataset: Dataset
    observer: Observer
    decisions: Decisions
    seed: int
    displacements: int = 0
    plan: PlanName = "needed"

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return the readout of a stimulus; None if the observer is not linear. Raises SettingsError if the
        observer has no grid for this size.
        """
        self.observer.grid(stimulus)  # refuses a stimulus that is too large before its readout is made
        return self.observer.readout(stimulus)


def scoring_of(
    dataset: Dataset, observer: Observer, *, plan: PlanName, decisions: Decisions, seed: int
) -> Scoring:
    """Return the settings of a scoring with one displacement a trial; the plan "full" adds a level to the observer
    where it leaves one out."""
    if plan == "full":
        observer = observer.with_extra_level()
    return Scoring(dataset, observer, decisions, seed, plan=plan)


class TrialViewing(NamedTuple):
    """The observer, retina grid and displacements for a trial, the same for all ways in which it is shown.
    `displacement_samples`, (d, 2), are the displacements of the retina grid in retina samples. `readout` is None
    if the observer is not linear.
    """

    observer: Observer
    grid: RetinaGrid
    displacement_samples: FloatArray
    readout: Readout | None


def trial_viewing(scoring: Scoring, trial: Trial, readout: Readout | None) -> TrialViewing:
    """Return the observer, retina grid and displacements for a trial. Raises SettingsError if the observer is not
    linear and its answer is not drawn.
    """
    observer = scoring.observer
    if readout is None and scoring.decisions == "expected" and not observer.knows_probabilities:
        raise SettingsError("decisions: found 'expected', but this observer is not linear; expected 'sampled'")
    displaced = _displacements(scoring, trial, observer.position_jitter_samples)
    grid = observer.grid(trial.stimulus) if readout is None else readout.grid
    return TrialViewing(observer, grid, displaced, readout)


def score_views(
    scoring: Scoring, trial: Trial, viewing: TrialViewing, ways: Sequence[TrialPatches]
) -> list[TrialScore]:
    """Show a trial to the observer in each of several ways, with the same displacements and the same noise."""
    displaced, readout = viewing.displacement_samples, viewing.readout
    seen = []
    for shown in ways:
        answer = NO_ANSWER
        scores = deviations = probabilities = np.full((len(displaced), 4), np.nan)
        if (offset := viewing.observer.pixel_offset(trial.stimulus)) is not None:
            shown = shown.on_pixels(viewing.grid, offset)
        if readout is None and scoring.decisions == "expected":
            probabilities = _expected_answers(viewing, shown, trial)
        elif readout is not None:
            scores, deviations = _scores(readout, shown, displaced)
        if scoring.decisions == "sampled":
            dx, dy = displaced[0].tolist()
            image = retina_image(shown, viewing.grid, (dx, dy))
            rng = random_stream(scoring.seed, TRIAL_STREAMS, trial.number)
            rng.random(2)  # the displacement
            answer = viewing.observer.respond(image, trial.stimulus, rng).quarter_turns
        answered = (displaced, scores, deviations, probabilities, answer)
        seen.append(TrialScore(*answered, shown.n_negative, shown.background_luminance_cd_m2))
    return seen


def score_trial(scoring: Scoring, trial: Trial, readout: Readout | None) -> TrialScore:
    """Read a trial and show it to the observer. Raises FrameError if a frame cannot be used, and SettingsError as
    `trial_viewing` does.
    """
    viewing = trial_viewing(scoring, trial, readout)
    displaced = viewing.displacement_samples
    shown = read_trial(
        scoring.dataset, trial, viewing.observer, viewing.grid, displaced, whole=scoring.plan == "full"
    )
    return score_views(scoring, trial, viewing, [shown])[0]


def _displacements(scoring: Scoring, trial: Trial, jitter: float) -> FloatArray:
    if not scoring.displacements:
        return -jitter + 2.0 * jitter * random_stream(scoring.seed, TRIAL_STREAMS, trial.number).random((1, 2))
    key = (DISPLACEMENT_STREAMS, scoring.displacements, trial.number)
    shifts = np.random.default_rng(np.random.SeedSequence(scoring.seed, spawn_key=key)).random((REPLICATES, 1, 2))
    evenly = (shifts + np.arange(scoring.displacements)[:, None] * KRONECKER_STEPS_2D) % 1.0
    return np.asarray(jitter * (2.0 * evenly.reshape(-1, 2) - 1.0))


def _expected_answers(viewing: TrialViewing, shown: TrialPatches, trial: Trial) -> FloatArray:
    """Return the probabilities of the answers of an observer that is not linear, (d, 4)."""
    images = (retina_image(shown, viewing.grid, (dx, dy)) for dx, dy in viewing.displacement_samples.tolist())
    expected = [viewing.observer.expected_answers(image, trial.stimulus) for image in images]
    return np.array(expected, np.float64)


def _scores(
    readout: Readout, shown: TrialPatches, displacement_samples: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the scores with displacements of the retina, and their deviations from their mean, (d, 4) each.
    Deviations that are rounding are 0: without noise or with huge contrast, equal scores may differ by it alone.
    """
    scores, deviations = np.empty((2, len(displacement_samples), 4))
    for row, (dx, dy) in enumerate(displacement_samples.tolist()):
        contrast = retina_image(shown, readout.grid, (dx, dy))
        of_templates = readout.score_deviations(contrast)
        rounding = 1e-13 * readout.norm * math.sqrt(inner_product(contrast, contrast))
        deviations[row] = np.where(np.abs(of_templates) < rounding, 0.0, of_templates)
        scores[row] = deviations[row] + readout.common_score(contrast)
    return scores, deviations
