"""The order of the trials of a session, which follows from its seed and from the answers so far.

QUEST+ chooses the level with the least expected entropy of the posterior (Watson 2017, "QUEST+: a general
multidimensional Bayesian adaptive psychometric method", J. Vision 17(3):10). The posterior of threshold, slope and
lapse rate of Weibull's function (Hogervorst et al. 2001, eq. 3) is held on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.experiment.answers import AnswerFile, Phase, SessionRecord, TrialRow, flagged
from todframes.frames.trials import Trials
from todframes.psychometrics.curves import GUESS_RATE, weibull

BEYOND_LEVELS = 3.0
"""Factor by which the thresholds of the grid reach beyond the smallest and the largest level."""

N_ALPHA, SLOPES, N_SLOPES, LAPSE_RATES, N_LAPSE_RATES = 61, (0.5, 8.0), 9, (0.0, 0.05), 6
"""Ranges and numbers of the grid's parameters: α and β evenly in their logarithm, δ evenly."""

SMALLEST_P = 1e-300
"""Smallest probability of an answer; its logarithm is finite."""


@dataclass(frozen=True, slots=True, eq=False)
class QuestGrid:
    """A grid of psychometric functions, and the probabilities of the answers to each level under each of them.
    `levels`, (l,), rise; the parameters have shape (g,), and `p_answer`, (2, l, g), are the probabilities of a
    wrong and of a right answer.
    """

    levels: FloatArray
    alpha: FloatArray
    beta: FloatArray
    lapse_rate: FloatArray
    p_answer: FloatArray

    @classmethod
    def of_levels(cls, levels: ArrayLike) -> QuestGrid:
        """Return the grid for levels > 0; its parameters have equal prior probabilities."""
        levels = np.unique(np.asarray(levels, np.float64))
        alpha = np.geomspace(levels[0] / BEYOND_LEVELS, levels[-1] * BEYOND_LEVELS, N_ALPHA)
        each = np.meshgrid(
            alpha, np.geomspace(*SLOPES, N_SLOPES), np.linspace(*LAPSE_RATES, N_LAPSE_RATES), indexing="ij"
        )
        alpha, beta, lapse_rate = (values.ravel() for values in each)
        right = weibull(levels[:, None], alpha=alpha, beta=beta, guess_rate=GUESS_RATE, lapse_rate=lapse_rate)
        return cls(levels, alpha, beta, lapse_rate, np.maximum(np.stack([1.0 - right, right]), SMALLEST_P))

    def posterior(self, n_wrong: ArrayLike, n_right: ArrayLike) -> FloatArray:
        """Compute the posterior probabilities of the grid's functions, (…, g), from the numbers of wrong and right
        answers at each level, (…, l).
        """
        counts = [np.asarray(n, np.float64) for n in (n_wrong, n_right)]
        ln = sum(n @ np.log(p) for n, p in zip(counts, self.p_answer, strict=True))
        likelihood = np.exp(ln - np.max(ln, axis=-1, keepdims=True))
        return np.asarray(likelihood / likelihood.sum(axis=-1, keepdims=True))

    def expected_entropy(self, posterior: FloatArray) -> FloatArray:
        """Compute the entropy of the posterior that is expected after one trial at each level, in nats, (…, l).
        The posterior after answer r at level x is p(r|x, θ)·p(θ)/p(r|x), with p(r|x) = Σ p(r|x, θ)·p(θ). Its
        entropy, weighted by p(r|x), is p(r|x)·ln p(r|x) − Σ p(r|x, θ)·p(θ)·ln(p(r|x, θ)·p(θ)): products of the
        tables with vectors.
        """
        weighted = posterior * np.log(np.maximum(posterior, SMALLEST_P))
        entropy = np.zeros((*posterior.shape[:-1], self.levels.size))
        for p in self.p_answer:
            of_answer = posterior @ p.T
            entropy += of_answer * np.log(np.maximum(of_answer, SMALLEST_P))
            entropy -= posterior @ (p * np.log(p)).T + weighted @ p.T
        return entropy


# First elements of the spawn keys of random streams.
ORDER, GROUPS, FRAMES, PRACTICE, DITHER, AGAIN = range(6)

MOST_AGAIN = 0.25
"""Largest number of trials that a session shows again because their answers have flags, as a share of its trials.
So the session ends even if the person never looks."""


class NextTrial(NamedTuple):
    """The trial that comes next: its number in the session and its phase, its row in the dataset's trials and the
    first seed of its dither.
    """

    number: int
    phase: Phase
    row: int
    dither_seed: int


class Practised(NamedTuple):
    """Progress of the practice: correct answers among the last ones, a block of them, and those needed."""

    n_correct: int
    n_needed: int


class TrialOrder:
    """The order of the trials of a session, a function of its record and of the rows so far. `trials` are all of
    the dataset.
    """

    def __init__(self, trials: Trials, record: SessionRecord) -> None:
        self._trials, self._record = trials, record
        self._practice = practice_trials(trials, record.practice, _stream(record.seed, PRACTICE))
        self._row_of_frame = {trial.frames[0].path: row for row, trial in enumerate(trials)}
        self._main: list[int] | None = None
        self._grids: list[QuestGrid] = []
        if record.method == "constant":
            self._main = spread_trials(trials, record.trials, _stream(record.seed, ORDER)).tolist()
        else:
            of_group = [trials.levels[trials.group_codes == code] for code in range(len(trials.groups))]
            self._grids = [QuestGrid.of_levels(levels) for levels in of_group]

    @property
    def candidates(self) -> list[int]:
        """Indices of the trials that may be shown."""
        return sorted({*self._practice.tolist(), *(self._main or range(len(self._trials)))})

    def total(self, phase: Phase, rows: Sequence[TrialRow] = ()) -> int:
        """Return the number of trials of a block of practice, or of the main phase after some rows."""
        return len(self._practice) if phase == "practice" else n_main_trials(self._record, rows)

    def practised(self, rows: Sequence[TrialRow]) -> Practised | None:
        """Return the progress of the practice; None before the end of its first block."""
        n_block = len(self._practice)
        last = [row for row in rows if row.phase == "practice"][-n_block:]
        if n_block == 0 or len(last) < n_block:
            return None
        n_correct = sum(row.is_correct and self._counts(row) for row in last)
        return Practised(n_correct, math.ceil(self._record.practice_correct * n_block))

    def check(self, file: AnswerFile) -> None:
        """Raise DataError if a row names a frame that no trial begins with."""
        for line, row in enumerate(file.rows, 2):
            if row.frame not in self._row_of_frame:
                raise DataError(
                    f"{file.path}, line {line}: frame: found {row.frame!r}, which no trial begins with"
                )

    def next(self, rows: Sequence[TrialRow]) -> NextTrial | None:
        """Return the next trial after some rows; None after the last."""
        dither_seed = int(_stream(self._record.seed, DITHER, len(rows)).integers(4096))
        main = [row for row in rows if row.phase == "main"]
        if not main and len(self._practice):
            practised = self.practised(rows)
            if practised is None or practised.n_correct < practised.n_needed:
                block, turn = divmod(len(rows), len(self._practice))
                of_block = _stream(self._record.seed, PRACTICE, block).permutation(self._practice)
                row = int((of_block if block else self._practice)[turn])
                return NextTrial(len(rows) + 1, "practice", row, dither_seed)
        if len(main) >= n_main_trials(self._record, rows):
            return None
        row = self._adaptive(main) if self._main is None else self._constant(self._main, main)
        return NextTrial(len(rows) + 1, "main", row, dither_seed)

    def _constant(self, order: Sequence[int], main: Sequence[TrialRow]) -> int:
        """Return the next trial in the order, in which flagged trials are repeated at a random later place."""
        queue, n_trials = list(order), n_main_trials(self._record, main)
        for number, row in enumerate(main):
            if not self._counts(row) and len(queue) < n_trials:
                first = min(number + 2, len(queue))  # not at once, if another one is left
                again = _stream(self._record.seed, AGAIN, number).integers(first, len(queue), endpoint=True)
                queue.insert(int(again), queue[number])
        return queue[len(main)]

    def _counts(self, row: TrialRow) -> bool:
        return self._record.include_flagged or row.flag is None

    def _adaptive(self, rows: Sequence[TrialRow]) -> int:
        """Return the trial that QUEST+ chooses: of the group in turn, one without an answer that counts."""
        main = [row for row in rows if self._counts(row)]
        shown = np.array([self._row_of_frame[row.frame] for row in main], np.intp)
        is_left = np.ones(len(self._trials), np.bool_)
        is_left[shown] = False
        codes, n_groups = self._trials.group_codes, len(self._trials.groups)
        # Blocks in which each group has a turn, in random order; a group without trials left loses its turn.
        block, turn = divmod(len(main), n_groups)
        turns = chain.from_iterable(
            _stream(self._record.seed, GROUPS, number).permutation(n_groups).tolist()
            for number in (block, block + 1)
        )
        code = next(group for group in list(turns)[turn:] if is_left[codes == group].any())
        grid = self._grids[code]
        levels = self._trials.levels
        answers = np.zeros((2, grid.levels.size))
        for index, row in zip(shown, main, strict=True):
            if codes[index] == code and row.response is not None:
                answers[int(row.is_correct), np.searchsorted(grid.levels, levels[index])] += 1
        entropy = grid.expected_entropy(grid.posterior(*answers))
        entropy[~np.isin(grid.levels, levels[is_left & (codes == code)])] = np.inf
        level = grid.levels[np.argmin(entropy)]
        choice = np.flatnonzero(is_left & (codes == code) & (levels == level))
        return int(_stream(self._record.seed, FRAMES, len(rows)).choice(choice))


def n_main_trials(record: SessionRecord, rows: Sequence[TrialRow]) -> int:
    """Return the number of main trials of a session: those that are shown again after some rows are added."""
    if record.include_flagged:
        return record.trials
    return record.trials + min(sum(flagged(rows).values()), math.ceil(MOST_AGAIN * record.trials))


def spread_trials(trials: Trials, n_trials: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of trials in random order, spread evenly over groups, levels and orientations. The
    numbers of trials of a group, level and orientation differ by one at most, as far as the dataset has as many.
    """
    order = rng.permutation(len(trials))
    cells = np.stack([trials.group_codes, trials.levels, trials.quarter_turns], axis=1)[order]
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    # The first of each cell in this order, then the second of each, and so on.
    by_cell = np.argsort(cell.ravel(), kind="stable")
    first = np.flatnonzero(np.diff(cell.ravel()[by_cell], prepend=-1))
    turn = np.empty(len(order), np.intp)
    turn[by_cell] = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    chosen = order[np.argsort(turn, kind="stable")[:n_trials]]
    return np.asarray(rng.permutation(chosen), np.intp)


def practice_trials(trials: Trials, n_trials: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of practice trials: of each group in turn, one of its highest level."""
    codes, levels = trials.group_codes, trials.levels
    highest = []
    for code in np.unique(codes):
        of_group = np.flatnonzero(codes == code)
        highest.append(of_group[levels[of_group] == levels[of_group].max()])
    return np.array([rng.choice(highest[k % len(highest)]) for k in range(n_trials)], np.intp)


def _stream(seed: int, *key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
