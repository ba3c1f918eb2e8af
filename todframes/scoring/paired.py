"""Scorings of the same trials side by side: ratios of their thresholds, and the efficiency of an observer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.frames.dataset import Dataset
from todframes.psychometrics.bootstrap import draw_backgrounds, sets_of_backgrounds
from todframes.psychometrics.fit import FitSettings, PsychometricFit
from todframes.psychometrics.paired_bootstrap import ThresholdDraws, ratio_draws, threshold_draws, threshold_ratio
from todframes.results.data import Efficiency, group_of
from todframes.scoring.score import ScoredDataset
from todframes.scoring.trial_scores import RATIO_STREAMS
from todframes.stimulus import level_of


class TrialSeries(NamedTuple):
    """Trials and the proportion correct of each, (n,), with the rows and the fit of each group. `shown` is what
    they show, (n, 3): orientation, polarity and level. `scenes` are the numbers of the scenes behind them.
    """

    shown: FloatArray
    p_correct: FloatArray
    rows: Sequence[NDArray[np.intp]]
    fits: Sequence[PsychometricFit]
    scenes: NDArray[np.intp] | None

    @classmethod
    def of_scored(cls, scored: ScoredDataset) -> TrialSeries:
        """Return the trials of a scoring."""
        trials = scored.trials
        polarities = np.array([stimulus.polarity for stimulus in trials.stimuli])[trials.stimulus_codes]
        shown = np.column_stack([trials.quarter_turns, polarities, trials.levels])
        rows = [trials.indices_of_group(fit.group) for fit in scored.fits]
        return cls(shown, scored.p_correct, rows, [fit.fit for fit in scored.fits], trials.scene_numbers)

    def shows_same(self, other: TrialSeries) -> bool:
        """Return whether both show the same in each trial of each group, in the same order."""
        return np.array_equal(self.scenes, other.scenes) and all(  # type: ignore[arg-type]  # None equals None
            np.array_equal(self.shown[rows], other.shown[of_other])
            for rows, of_other in zip(self.rows, other.rows, strict=True)
        )


def paired_draws(
    series: Sequence[TrialSeries], *, seed: int, settings: FitSettings, stream: int = 0
) -> list[list[ThresholdDraws]]:
    """Repeat the experiment of several series of answers to the same trials: for each group, the draws of each
    series. All series of a group are drawn and fitted together, and the same scenes are drawn in all groups.
    Another `stream` gives draws that know nothing of these.
    """
    first = series[0]
    drawn, backgrounds, key = None, first.scenes, (stream,) * bool(stream)
    if backgrounds is not None:
        of_scenes = np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, len(first.rows), *key))
        backgrounds = sets_of_backgrounds(backgrounds)
        drawn = draw_backgrounds(int(backgrounds.max()) + 1, settings.resamples, np.random.default_rng(of_scenes))
    of_groups = []
    for number, rows in enumerate(first.rows):
        of_group = None if backgrounds is None else backgrounds[rows]
        if of_group is not None and len(np.unique(of_group)) < 2:
            of_group = None  # a single background says nothing of others
        of_groups.append(
            threshold_draws(
                first.shown[rows, 2],
                np.array([answered.p_correct[answered.rows[number]] for answered in series]),
                [answered.fits[number] for answered in series],
                settings=settings,
                rng=np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, number, *key))),
                backgrounds=of_group,
                drawn_backgrounds=drawn,
            )
        )
    return of_groups


def efficiencies(
    dataset: Dataset,
    own: ScoredDataset,
    others: Sequence[tuple[str, ScoredDataset]],
    *,
    seed: int,
    fit_settings: FitSettings,
) -> tuple[Efficiency, ...]:
    """Return the efficiency of an observer relative to others by their names, in each group: the ratio of the
    signal energies at threshold, (their threshold ÷ its threshold)². Tanner & Birdsall 1958. SettingsError if the
    level is no signal, or an observer can use other trials.
    """
    level = dataset.experiment.level
    if not level_of(level).is_signal:
        raise SettingsError(
            f"{argument.relative_to}: found the level {level}, expected one of signal, as contrast"
        )
    for name, scored in others:
        if not np.array_equal(scored.trials.numbers, own.trials.numbers):
            raise SettingsError(
                f"{argument.relative_to}: {name} can use {len(scored.trials)} trials and the observer "
                f"{len(own.trials)}, expected the same ones"
            )
    settings = replace(fit_settings, resamples=max(fit_settings.resamples, 1))
    answered = [TrialSeries.of_scored(scored) for scored in (own, *(scored for _, scored in others))]
    of_groups = paired_draws(answered, seed=seed, settings=settings)
    records = []
    for number, (name, scored) in enumerate(others, 1):
        for fit, draws in zip(scored.fits, of_groups, strict=True):
            ratio = threshold_ratio([ratio_draws(draws[0], draws[number])])
            ends = (None, None) if ratio.ratio_ci95 is None else ratio.ratio_ci95
            high, low = (None if end is None else end**-2.0 for end in ends)
            records.append(
                Efficiency(
                    relative_to=name,
                    group=group_of(dataset, fit.group),
                    threshold=fit.fit.threshold,
                    efficiency=None if ratio.ratio is None else ratio.ratio**-2.0,
                    efficiency_ci95=None if ratio.ratio is None or not fit_settings.resamples else (low, high),
                )
            )
    return tuple(records)
