"""Records and tables of scored trials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from todframes.frames.dataset import Dataset
from todframes.results.data import Fit, group_of
from todframes.results.table import BLOCK, LongRecords, Table
from todframes.results.tables import trial_kinds
from todframes.scoring.score import GroupFit, ScoredDataset
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    from todframes.scoring.missing_threshold import Explanation


def fit_record(dataset: Dataset, fit: GroupFit, explanation: Explanation | None = None) -> Fit:
    """Return the record of the fit to the scored trials of a group, and of why there is no threshold."""
    answers = None if explanation is None else tuple(map(tuple, explanation.answers.round(4).tolist()))
    return msgspec.structs.replace(
        Fit.of_counts(group_of(dataset, fit.group), dataset.experiment.level, fit.fit),
        p_correct_error_bound=fit.non_gaussian_bound,
        p_correct_left_out_bound=fit.left_out_bound,
        threshold_displacement_error=fit.numerical_error,
        n_displacements=fit.n_displacements,
        background_luminance_cd_m2=fit.background_luminance_cd_m2,
        run_time_s=round(fit.run_time_s, 4),
        answers=answers,
        answers_from_level=None if explanation is None else explanation.from_level,
    )


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
