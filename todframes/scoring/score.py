"""The scoring of a dataset by an observer: every trial is scored, and each group gets a psychometric function."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, Experiment, Skipped
from todframes.frames.position import check_places
from todframes.frames.trials import Group, Trials
from todframes.jobs.run import Run
from todframes.observers.interface import Observer
from todframes.parameters import CurveName, Decisions, PlanName
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_trials
from todframes.scoring.error_budget import REPLICATES, Step, half_width_95
from todframes.scoring.plan import ScorePlan, plan_score
from todframes.scoring.seen_trials import FIT_STREAMS, Scoring, SeenTrial, SeenTrials, score_trial
from todframes.scoring.work import see_trials
from todframes.stimulus import level_of

S = TypeVar("S", bound=Sized)


@dataclass(frozen=True, slots=True)
class GroupFit:
    """The psychometric fit of the trials that share the values of the `group_by` columns. `non_gaussian_bound` and
    `left_out_bound` bound the errors in P(correct) from taking the summed internal noise as Gaussian, 0 for drawn
    answers, and from what the plan leaves out. `numerical_error` is the half-width of the threshold's 95 %
    interval over displacements.
    """

    group: tuple[float | str, ...]
    fit: PsychometricFit
    non_gaussian_bound: float
    left_out_bound: float
    numerical_error: float | None
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
    plan: tuple[Step, ...]


def score_dataset(
    dataset: Dataset,
    observer: Observer,
    *,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    seed: int = 1,
    fit_settings: FitSettings | None = None,
    tolerance: float | None = None,
    plan_name: PlanName = "needed",
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
    expected = decisions == "expected"
    plan = plan_score(dataset, whole, observer, name=plan_name, tolerance=tolerance or 2e-3, expected=expected)
    scoring = Scoring(dataset, plan, decisions, seed, displacements=0 if tolerance is None else 1)
    run = run or Run()

    def see(scoring: Scoring, trials: Trials, run: Run) -> tuple[SeenTrials, list[Skipped]]:
        seen = SeenTrials(trials)
        skip, collect = skip_bad_frames, seen.put
        unread = see_trials(
            scoring, trials, score_trial, kind=SeenTrial, collect=collect, skip_bad_frames=skip, run=run
        )
        return seen.usable(), unread

    seen, unread = see(scoring, whole, run)
    skipped += unread
    seen = check_seen(dataset, seen, skipped)
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    fit = partial(fit_groups, plan, seed=seed, fit_settings=fit_settings, curve=curve, expected=expected)
    decided = fit(seen)
    if tolerance is not None:
        looks = []
        for group, (_, rows) in zip(decided.fits, groups_of(seen.trials), strict=True):
            displacements = _displacements_needed(group, tolerance)
            if displacements > 1:
                closer = replace(scoring, displacements=displacements)
                more, _ = see(closer, seen.trials.select(rows), replace(run, progress=None))
                if len(more) == len(rows):  # no frame has gone meanwhile
                    looks.append(more)
        if looks:
            decided = fit(seen, looks)
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
    if group.numerical_error is None or group.fit.threshold is None:
        return 1
    ratio = group.numerical_error / (tolerance * group.fit.threshold)
    return min(math.ceil(1.1 * ratio**2), 64) if ratio > 1.0 else 1


def groups_of(trials: Trials) -> list[tuple[Group, NDArray[np.intp]]]:
    """Return the groups of trials, numbers before texts, and the indices of each group's trials."""
    return sorted(trials.by_group(), key=lambda group: [(isinstance(value, str), value) for value in group[0]])


def fit_groups(
    plan: ScorePlan,
    seen: SeenTrials,
    looks: Sequence[SeenTrials] = (),
    *,
    seed: int,
    fit_settings: FitSettings,
    curve: CurveName,
    expected: bool,
) -> ScoredDataset:
    """Compute the answers of all trials, in the order of the manifest, and fit a curve to each group. `looks` are
    groups that were seen again, with more displacements: these count. Nothing is skipped.
    """
    trials, n = seen.trials, len(seen)
    parts = [(np.searchsorted(trials.numbers, look.trials.numbers), look) for look in looks]
    rest = np.setdiff1d(np.arange(n), np.concatenate([np.zeros(0, np.intp), *(rows for rows, _ in parts)]))
    if len(rest):
        parts.insert(0, (rest, seen if not looks else seen.select(rest)))
    table = np.empty(n, _DECIDED)
    p_each, of_part = [], np.zeros(n, np.intp)
    for number, (rows, part) in enumerate(parts):
        table[rows], p_of_part = _decided(plan, part)
        p_each.append(p_of_part)
        of_part[rows] = number
    answers = table["probabilities"].argmax(axis=1)
    if not expected:
        answers = seen["answer"]
        table["p_correct"] = answers == trials.quarter_turns
        p_each, table["bound"] = [table["p_correct"][:, None]], 0.0
    fits, scenes = [], trials.scene_numbers
    for number, (group, rows) in enumerate(groups_of(trials)):
        level, p_correct = trials.levels[rows], table["p_correct"][rows]
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(FIT_STREAMS, number)))
        backgrounds = None if scenes is None else scenes[rows]
        fit = fit_trials(level, p_correct, curve=curve, settings=fit_settings, rng=rng, backgrounds=backgrounds)
        part_rows, p_of_part = parts[of_part[rows[0]]][0], p_each[of_part[rows[0]]]
        p_of_rows = p_of_part[np.searchsorted(part_rows, rows)]
        fits.append(
            GroupFit(
                group=group,
                fit=fit,
                non_gaussian_bound=float(table["bound"][rows].max()),
                left_out_bound=plan.bound(trials.select(rows).stimuli),
                numerical_error=_numerical_error(level, p_of_rows, fit, fit_settings),
                n_displacements=p_of_rows.shape[1],
                background_luminance_cd_m2=sum(table["background_luminance_cd_m2"][rows].tolist()) / len(rows),
            )
        )
    least, most = min(numbers := [p.shape[1] for p in p_each]), max(numbers)
    how_many = f"{least} of each trial"
    if least < most:
        how_many = f"{least} to {most} of each trial, as the tolerance takes"
    return ScoredDataset(
        trials=trials,
        displacement_samples=table["displacement_samples"],
        scores=table["scores"],
        probabilities=table["probabilities"],
        answers=answers.astype(np.intp),
        p_correct=table["p_correct"],
        fits=tuple(fits),
        skipped=(),
        n_negative=int(sum(part["n_negative"].sum() for _, part in parts)),
        plan=(*plan.steps, Step("displacements", True, how_many)),
    )


_DECIDED = np.dtype(
    [
        ("displacement_samples", "f8", 2),
        ("scores", "f8", 4),
        ("probabilities", "f8", 4),
        *((name, "f8") for name in ("p_correct", "bound", "background_luminance_cd_m2")),
    ]
)
"""Means over displacements, and the bound on the error of the probabilities from taking the noise as Gaussian."""


def _decided(plan: ScorePlan, seen: SeenTrials) -> tuple[NDArray[Any], FloatArray]:
    """Return a row of `_DECIDED` for each trial, and the probability of the correct answer with each displacement.
    Probabilities are NaN if answers are drawn of an observer that is not linear, and displacements if there are
    several.
    """
    displaced = seen["displacement_samples"]
    n, n_displacements, _ = displaced.shape
    table, p_each = np.zeros(n, _DECIDED), np.full((n, n_displacements), np.nan)
    table["displacement_samples"] = displaced[:, 0] if n_displacements == 1 else np.nan
    table["scores"], table["probabilities"] = seen["scores"].mean(axis=1), np.nan
    table["background_luminance_cd_m2"] = seen["background_luminance_cd_m2"]
    correct = seen.trials.quarter_turns
    for stimulus, members in seen.trials.by_stimulus():
        readout = plan.observer_of(stimulus).readout(stimulus)
        if readout is None:
            expected = seen["probabilities"][members]
            table["probabilities"][members] = expected.mean(axis=1)
            p_each[members] = np.take_along_axis(expected, correct[members, None, None], axis=2)[..., 0]
            continue
        table["bound"][members] = readout.non_gaussian_bound
        at_a_time = 4096  # the work on each takes 500 bytes a displacement
        for start in range(0, len(members), at_a_time):
            rows = members[start : start + at_a_time]
            answers = readout.answer_probabilities(seen["deviations"][rows].reshape(-1, 4))
            answers = answers.reshape(len(rows), n_displacements, 4)
            table["probabilities"][rows] = answers.mean(axis=1)
            p_each[rows] = np.take_along_axis(answers, correct[rows, None, None], axis=2)[..., 0]
    table["p_correct"] = p_each.mean(axis=1)
    return table, p_each


def _numerical_error(
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
