"""Records and tables of scored trials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.frames.dataset import Dataset
from todframes.frames.trials import Group, Trials
from todframes.results.data import Fit, group_of
from todframes.results.table import BLOCK, LongRecords, Table
from todframes.results.tables import trial_kinds
from todframes.scoring.score import GroupFit, ScoredDataset
from todframes.stimulus import ORIENTATIONS

LEAST_TRIALS = 8
"""Least number of trials whose answers are stated where there is no threshold, as far as a group has them."""


def fit_record(dataset: Dataset, fit: GroupFit, scored: ScoredDataset | None = None) -> Fit:
    """Return the record of the fit to scored trials of a group. If they are given and there is no threshold, it
    has the answers in the strongest ones, expected or drawn: rows are orientations shown, columns those answered.
    """
    answers = from_level = None
    if scored is not None and fit.fit.threshold is None:
        trials, strong = scored.trials, strongest(scored.trials, fit.group)
        drawn, expected, table = np.eye(4)[scored.answers[strong]], scored.probabilities[strong], np.zeros((4, 4))
        np.add.at(table, trials.quarter_turns[strong], np.where(np.isfinite(expected), expected, drawn))
        answers, from_level = tuple(map(tuple, table.round(4).tolist())), float(trials.levels[strong].min())
    return msgspec.structs.replace(
        Fit.of_counts(group_of(dataset, fit.group), dataset.experiment.level, fit.fit),
        answers=answers,
        answers_from_level=from_level,
        **{one.name: getattr(fit, one.name) for one in fields(fit) if one.name not in ("group", "fit")},
    )


def strongest(trials: Trials, group: Group) -> NDArray[np.intp]:
    """Return the indices of the trials of a group's highest third of levels, in the order of the trials."""
    members = trials.indices_of_group(group)
    level = trials.levels[members]
    levels, counts = np.unique(-level, return_counts=True)
    is_strong = np.arange(len(levels)) < len(levels) / 3.0
    is_taken = is_strong | (np.cumsum(counts) - counts < LEAST_TRIALS)
    return np.asarray(members[level >= -levels[is_taken][-1]])


def trials_table(dataset: Dataset, parts: Sequence[tuple[Mapping[str, str], ScoredDataset]]) -> Table:
    """Make a table of scored trials, each part with some texts in front."""
    more, first = parts[0]
    groups = [dict(zip(dataset.experiment.group_by, group, strict=True)) for group in first.trials.groups]
    kinds = trial_kinds([*more, *_block(dataset, first, slice(0))], groups)

    def blocks() -> Iterator[dict[str, list[Any]]]:
        for texts, scored in parts:
            for start in range(0, len(scored.trials), BLOCK):
                block = _block(dataset, scored, slice(start, start + BLOCK))
                yield {name: [text] * len(block["trial"]) for name, text in texts.items()} | block

    records = LongRecords(kinds, sum(len(scored.trials) for _, scored in parts), blocks)
    return Table.of("Trials", "scores.csv", list(kinds), records)


def _block(dataset: Dataset, scored: ScoredDataset, rows: slice) -> dict[str, list[Any]]:
    """Return the columns of some scored trials."""
    trials, turns = scored.trials[rows], [orientation.value for orientation in ORIENTATIONS]
    displaced = scored.displacement_samples[rows].T.tolist()
    stimuli = [trials.stimuli[k] for k in trials.stimulus_codes.tolist()]
    groups = [trials.groups[k] for k in trials.group_codes.tolist()]
    return {
        "trial": list(trials.names()),
        "n_frames": trials.frame_counts.tolist(),
        "orientation": [turns[k] for k in trials.quarter_turns.tolist()],
        "size_mrad": [stimulus.size_mrad for stimulus in stimuli],
        "polarity": [stimulus.polarity for stimulus in stimuli],
        dataset.experiment.level: trials.levels.tolist(),
        **{name: [group[k] for group in groups] for k, name in enumerate(dataset.experiment.group_by)},
        "displacement_x_samples": displaced[0],
        "displacement_y_samples": displaced[1],
        **{f"score_{turn}": scored.scores[rows, k].tolist() for k, turn in enumerate(turns)},
        **{f"p_{turn}": scored.probabilities[rows, k].tolist() for k, turn in enumerate(turns)},
        "answer": [turns[k] for k in scored.answers[rows].tolist()],
        "p_correct": scored.p_correct[rows].tolist(),
    }
