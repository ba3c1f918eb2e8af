"""The scoring of a dataset by an observer: every trial is scored, and each group gets a psychometric function."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.frames.contrast import check_places, skipped_frames
from todframes.frames.dataset import Dataset, Experiment, Skipped
from todframes.frames.trials import Group, Trials
from todframes.jobs.run import Run
from todframes.observers.interface import Observer
from todframes.parameters import CurveName, Decisions, PlanName
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_trials
from todframes.results.data import Fit, group_of
from todframes.results.tables import Table
from todframes.scoring.error_budget import REPLICATES, half_width_95
from todframes.scoring.trial_scores import (
    FIT_STREAMS,
    Scoring,
    TrialScore,
    TrialScores,
    score_trial,
    score_trials,
    scoring_of,
)
from todframes.stimulus import ORIENTATIONS, level_of

S = TypeVar("S", bound=Sized)


@dataclass(frozen=True, slots=True)
class GroupFit:
    """The psychometric fit of the trials that share the values of the `group_by` columns; all else has the names
    and meanings of `results.data.Fit`. `p_correct_error_bound` comes from taking the summed internal noise as
    Gaussian, and is 0 for drawn answers.
    """

    group: tuple[float | str, ...]
    fit: PsychometricFit
    p_correct_error_bound: float
    threshold_displacement_error: float | None
    n_displacements: int
    background_luminance_cd_m2: float


@dataclass(frozen=True, slots=True)
class ScoredDataset:
    """The scores of every trial that could be read, in the order of the manifest, and the fits.
    `displacement_samples`, (n, 2), are displacements of the retina along x and y; NaN if a trial had several.
    `scores` and `probabilities`, (n, 4), are noise-free inner products with the templates and the probability of
    each answer, averaged over displacements; NaN if the observer has none. `answers` are those drawn, or the most
    probable ones, indices into `ORIENTATIONS`; `p_correct` is 1 or 0 if answers were drawn.
    """

    trials: Trials
    displacement_samples: FloatArray
    scores: FloatArray
    probabilities: FloatArray
    answers: NDArray[np.intp]
    p_correct: FloatArray
    fits: tuple[GroupFit, ...]
    skipped: tuple[Skipped, ...]
    n_negative: int


def score_dataset(
    dataset: Dataset,
    observer: Observer,
    *,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    seed: int = 1,
    fit_settings: FitSettings | None = None,
    tolerance: float | None = None,
    plan: PlanName = "needed",
    skip_bad_frames: bool = False,
    run: Run | None = None,
) -> ScoredDataset:
    """Show every trial to the observer and fit a psychometric function to each group.

    The random numbers depend on the seed alone: each trial has its own random stream, whatever the order of the
    trials or the number of workers. With "sampled" decisions one answer is drawn for each trial with noise on
    every neuron, as in the paper. `tolerance` is the largest relative error of the thresholds due to the
    displacement of the retina; without it each trial is seen with one displacement. If bad frames are skipped,
    trials that cannot be read are listed; otherwise FrameError or DataError is raised. SettingsError is raised as
    by `fitted_curve` and `trial_viewing`, and for a tolerance with drawn answers.
    """
    curve = fitted_curve(curve, decisions)
    whole, skipped = usable_trials(dataset, skip_bad_frames=skip_bad_frames)
    if not skip_bad_frames:
        check_places(dataset, whole, observer.centre)
    if tolerance is not None and not (tolerance > 0.0 and decisions == "expected"):
        raise SettingsError(
            f"tolerance: found {tolerance!r} with {decisions} decisions, expected > 0 and expected"
        )
    scoring = scoring_of(dataset, observer, plan=plan, decisions=decisions, seed=seed)
    if tolerance is not None:
        scoring = replace(scoring, displacements=1)
    run = run or Run()

    def see(scoring: Scoring, trials: Trials, run: Run) -> tuple[TrialScores, list[Skipped]]:
        seen = TrialScores(trials)
        skip, collect = skip_bad_frames, seen.put
        unread = score_trials(
            scoring, trials, score_trial, kind=TrialScore, collect=collect, skip_bad_frames=skip, run=run
        )
        return seen.usable(), unread

    seen, unread = see(scoring, whole, run)
    skipped += unread
    seen = check_seen(dataset, seen, skipped)
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    fit = partial(fit_groups, scoring, fit_settings=fit_settings, curve=curve)
    decided = fit(seen)
    if tolerance is not None:
        rescored = []
        for group, (_, rows) in zip(decided.fits, groups_of(seen.trials), strict=True):
            displacements = _displacements_needed(group, tolerance)
            if displacements > 1:
                closer = replace(scoring, displacements=displacements)
                more, _ = see(closer, seen.trials.select(rows), replace(run, progress=None))
                if len(more) == len(rows):  # no frame has gone meanwhile
                    rescored.append(more)
        if rescored:
            decided = fit(seen, rescored)
    return replace(decided, skipped=tuple(skipped))


def fitted_curve(curve: CurveName | None, decisions: Decisions) -> CurveName:
    """Return the curve to fit: by default the observer's for expected decisions, Weibull's for sampled ones.
    Raises SettingsError if the observer's curve is asked for and decisions are sampled.
    """
    if decisions == "expected":
        return curve or "observer"
    if curve == "observer":
        raise SettingsError(
            "curve: found 'observer' with sampled decisions, expected 'weibull': the observer's curve is that of "
            "its probabilities, which a linear observer has with expected decisions"
        )
    return "weibull"


def settings_of_experiment(settings: FitSettings | None, experiment: Experiment) -> FitSettings:
    """Return the settings of fits, which expect no slope unless the signal is proportional to the level."""
    settings = settings or FitSettings()
    return settings if level_of(experiment.level).is_signal else replace(settings, slope_spread=None)


def usable_trials(dataset: Dataset, *, skip_bad_frames: bool) -> tuple[Trials, list[Skipped]]:
    """Return the trials whose rows are all good, and the frames that are skipped. Raises DataError if there are
    bad rows and `skip_bad_frames` is not set, or no trial is left.
    """
    if dataset.bad_rows and not skip_bad_frames:
        raise DataError(dataset.bad_rows[0].error)
    skipped, usable = list(dataset.bad_rows), dataset.trials
    if dataset.spoilt:
        is_spoilt = np.array([name in dataset.spoilt for name in usable.names()], bool)
        for trial in usable.select(is_spoilt):
            skipped += skipped_frames(dataset, trial, f"another frame of trial {trial.name} cannot be used")
        usable = usable.select(~is_spoilt)
    return check_seen(dataset, usable, skipped), skipped


def check_seen(dataset: Dataset, seen: S, skipped: Sequence[Skipped]) -> S:
    """Return the trials that were seen; raise DataError if no trial could be used."""
    if not seen:
        raise DataError(f"{dataset.path}: no frame can be scored; the first: {skipped[0].error}")
    return seen


def _displacements_needed(group: GroupFit, tolerance: float) -> int:
    """Return the number of displacements in a replicate for an error below the tolerance, if the error falls as
    1/√n."""
    if group.threshold_displacement_error is None or group.fit.threshold is None:
        return 1
    ratio = group.threshold_displacement_error / (tolerance * group.fit.threshold)
    return min(math.ceil(1.1 * ratio**2), 64) if ratio > 1.0 else 1


def groups_of(trials: Trials) -> list[tuple[Group, NDArray[np.intp]]]:
    """Return the groups of trials, numbers before texts, and the indices of each group's trials."""
    return sorted(trials.by_group(), key=lambda group: [(isinstance(value, str), value) for value in group[0]])


def fit_groups(
    scoring: Scoring,
    seen: TrialScores,
    rescored: Sequence[TrialScores] = (),
    *,
    fit_settings: FitSettings,
    curve: CurveName,
) -> ScoredDataset:
    """Compute the answers of all trials, in the order of the manifest, and fit a curve to each group. `rescored`
    are whole groups that were seen again, with more displacements: these count. Nothing is skipped.
    """
    trials, scenes = seen.trials, seen.trials.scene_numbers
    decided, fits, n_negative = _decided(scoring, seen), [], 0
    table = decided.table
    again = {part.trials[0].group: part for part in rescored}
    for number, (group, rows) in enumerate(groups_of(trials)):
        part, of_group = seen.select(rows), decided.select(rows)
        if group in again:
            part = again[group]
            of_group = _decided(scoring, part)
            table[rows] = of_group.table
        level, p_correct = trials.levels[rows], table["p_correct"][rows]
        fit = fit_trials(
            level,
            p_correct,
            curve=curve,
            settings=fit_settings,
            rng=np.random.default_rng(np.random.SeedSequence(scoring.seed, spawn_key=(FIT_STREAMS, number))),
            backgrounds=None if scenes is None else scenes[rows],
        )
        fits.append(
            GroupFit(
                group=group,
                fit=fit,
                p_correct_error_bound=float(of_group.bound.max()),
                threshold_displacement_error=_displacement_error(level, of_group.p_each, fit, fit_settings),
                n_displacements=of_group.p_each.shape[1],
                background_luminance_cd_m2=math.fsum(part["background_luminance_cd_m2"]) / len(rows),
            )
        )
        n_negative += int(part["n_negative"].sum())
    return ScoredDataset(
        trials=trials,
        displacement_samples=table["displacement_samples"],
        scores=table["scores"],
        probabilities=table["probabilities"],
        answers=table["answer"],
        p_correct=table["p_correct"],
        fits=tuple(fits),
        skipped=(),
        n_negative=n_negative,
    )


TRIAL_DTYPE = np.dtype(
    [
        ("displacement_samples", "f8", 2),
        ("scores", "f8", 4),
        ("probabilities", "f8", 4),
        ("answer", np.intp),
        ("p_correct", "f8"),
    ]
)
"""Means over displacements, and the answer that was drawn, or is the most probable one."""


class _Decided(NamedTuple):
    """A row of `TRIAL_DTYPE` for each trial, the probability of the correct answer with each displacement, (n, d),
    and the bound on its error from taking the noise as Gaussian, (n,)."""

    table: NDArray[Any]
    p_each: FloatArray
    bound: FloatArray

    def select(self, rows: NDArray[np.intp]) -> _Decided:
        return _Decided(self.table[rows], self.p_each[rows], self.bound[rows])


def _decided(scoring: Scoring, seen: TrialScores) -> _Decided:
    """Compute the answers of trials. Probabilities are NaN if answers are drawn of an observer that is not linear,
    and displacements if there are several.
    """
    displaced, correct = seen["displacement_samples"], seen.trials.quarter_turns
    n, n_displacements, _ = displaced.shape
    table, each, bound = np.zeros(n, TRIAL_DTYPE), seen["probabilities"].copy(), np.zeros(n)
    table["displacement_samples"] = displaced[:, 0] if n_displacements == 1 else np.nan
    table["scores"] = seen["scores"].mean(axis=1)
    for stimulus, members in seen.trials.by_stimulus():
        readout = scoring.observer.readout(stimulus)
        if readout is None:
            continue
        bound[members] = readout.non_gaussian_bound
        at_a_time = 4096  # the work on each takes 500 bytes a displacement
        for start in range(0, len(members), at_a_time):
            rows = members[start : start + at_a_time]
            answers = readout.answer_probabilities(seen["deviations"][rows].reshape(-1, 4))
            each[rows] = answers.reshape(len(rows), n_displacements, 4)
    table["probabilities"] = each.mean(axis=1)
    if scoring.decisions == "sampled":
        table["answer"] = seen["answer"]
        table["p_correct"] = table["answer"] == correct
        return _Decided(table, table["p_correct"][:, None], np.zeros(n))
    table["answer"] = table["probabilities"].argmax(axis=1)
    p_each = np.take_along_axis(each, correct[:, None, None], axis=2)[..., 0]
    table["p_correct"] = p_each.mean(axis=1)
    return _Decided(table, p_each, bound)


def _displacement_error(
    level: FloatArray, p_each: FloatArray, fit: PsychometricFit, fit_settings: FitSettings
) -> float | None:
    """Compute the half-width of the threshold's 95 % interval, from the spread among replicates."""
    if fit.threshold is None or p_each.shape[1] < REPLICATES:
        return None
    settings, rng = replace(fit_settings, resamples=0), np.random.default_rng(0)
    sets = p_each.reshape(len(p_each), REPLICATES, -1).mean(axis=2).T
    thresholds = [fit_trials(level, p, curve=fit.curve, settings=settings, rng=rng).threshold for p in sets]
    known = [threshold for threshold in thresholds if threshold is not None]
    return half_width_95(known) if len(known) == REPLICATES else None


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
    records = []
    for texts, scored in parts:
        columns = _columns(dataset, scored)
        rows = zip(*columns.values(), strict=True)
        records += [{**texts, **dict(zip(columns, row, strict=True))} for row in rows]
    return Table.of("Trials", "scores.csv", records[0], records)


def _columns(dataset: Dataset, scored: ScoredDataset) -> dict[str, list[Any]]:
    """Return the columns of scored trials."""
    trials, turns = scored.trials, [orientation.value for orientation in ORIENTATIONS]
    displaced = scored.displacement_samples.T.tolist()
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
        **{f"score_{turn}": scored.scores[:, k].tolist() for k, turn in enumerate(turns)},
        **{f"p_{turn}": scored.probabilities[:, k].tolist() for k, turn in enumerate(turns)},
        "answer": [turns[k] for k in scored.answers.tolist()],
        "p_correct": scored.p_correct.tolist(),
    }
