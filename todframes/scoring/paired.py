"""Scorings of the same trials side by side: ratios of their thresholds, and the efficiency of an observer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from todframes.base.errors import SettingsError, argument
from todframes.frames.dataset import Dataset
from todframes.psychometrics.bootstrap import draw_backgrounds, sets_of_backgrounds
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.paired_bootstrap import RatioDraws, ratio_draws, threshold_ratio
from todframes.results.data import Efficiency, group_of
from todframes.scoring.score import ScoredDataset
from todframes.scoring.seen_trials import RATIO_STREAMS
from todframes.stimulus import level_of


def paired_ratios(
    scored: Sequence[ScoredDataset], pairs: Sequence[tuple[int, int]], *, seed: int, settings: FitSettings
) -> list[list[RatioDraws]]:
    """Compare thresholds of pairs of scorings of the same trials: for each group, the ratio of each pair. All
    series of a group are drawn and fitted only once. The same scenes are drawn in all groups.
    """
    trials, groups = scored[0].trials, [fit.group for fit in scored[0].fits]
    drawn, backgrounds = None, trials.scene_numbers
    if backgrounds is not None:
        stream = np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, len(groups)))
        backgrounds = sets_of_backgrounds(backgrounds)
        drawn = draw_backgrounds(int(backgrounds.max()) + 1, settings.resamples, np.random.default_rng(stream))
    of_groups = []
    for number, group in enumerate(groups):
        rows = trials.indices_of_group(group)
        of_group = None if backgrounds is None else backgrounds[rows]
        if of_group is not None and len(np.unique(of_group)) < 2:
            of_group = None  # a single background says nothing of others
        of_groups.append(
            ratio_draws(
                trials.levels[rows],
                np.array([series.p_correct[rows] for series in scored]),
                [series.fits[number].fit for series in scored],
                pairs=pairs,
                settings=settings,
                rng=np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, number))),
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
    pairs = [(0, number) for number in range(1, len(others) + 1)]
    of_groups = paired_ratios([own, *(scored for _, scored in others)], pairs, seed=seed, settings=settings)
    records = []
    for number, (name, scored) in enumerate(others):
        for fit, draws in zip(scored.fits, of_groups, strict=True):
            ratio = threshold_ratio([draws[number]])
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
