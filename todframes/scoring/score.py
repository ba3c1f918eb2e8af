"""The scoring of a dataset by an observer: every trial is scored, and a psychometric function fitted a group."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from todframes._typing import FloatArray
from todframes.errors import DataError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.position import check_places
from todframes.frames.trials import Trial
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import CurveName, FitSettings, PsychometricFit, fit_trials
from todframes.scoring.error_budget import PlanName, Step
from todframes.scoring.plan import ScorePlan, plan_score
from todframes.scoring.trials import (
    FIT_STREAMS,
    REPLICATES,
    Decisions,
    Scoring,
    SeenTrial,
    score_trial,
    see_trials,
)
from todframes.stimulus import Stimulus

MOST_DISPLACEMENTS = 64
"""Largest number of displacements of each trial in each replicate."""


SIGNAL_WORDS = ("contrast", "snr")
"""Words in the names of levels that the signal in a frame is proportional to."""


DEFAULT_TOLERANCE = 2e-3
"""Relative tolerance of thresholds for the plan if no tolerance is given."""


STANDARD_ERRORS_95 = 2.8412
"""Half-width of a threshold's interval in standard errors: the 98.75 % point of Student's t with `REPLICATES` − 1
degrees of freedom. Half of the allowed miss rate of 5 % covers errors that were below the tolerance by chance."""


@dataclass(frozen=True, slots=True)
class GroupFit:
    """The psychometric fit of the trials that share the values of the `group_by` columns.

    `non_gaussian_bound` bounds the error in P(correct) from taking the summed internal noise as Gaussian; 0 if
    answers were drawn with noise on every neuron. `left_out_bound` bounds the change of P(correct) by all that the
    plan leaves out. `numerical_error` is the half-width of the threshold's 95 % interval over displacements; None
    if each trial has one displacement. `background_luminance_cd_m2` is the mean over trials of the luminance that
    contrast refers to. `run_time_s` is the time for the trials and the fit, in seconds.
    """

    group: tuple[float | str, ...]
    fit: PsychometricFit
    non_gaussian_bound: float
    left_out_bound: float
    numerical_error: float | None
    n_displacements: int
    background_luminance_cd_m2: float
    run_time_s: float


@dataclass(frozen=True, slots=True)
class ScoredDataset:
    """The scores of every trial that could be read, and the fits.

    Attributes
    ----------
    trials : tuple of Trial
        Trials in the order of the manifest; the rows of the arrays have the same order.
    displacement_samples : ndarray, shape (n, 2)
        Displacement of the retina grid along x and y, in retina samples; NaN if a trial had several.
    scores, probabilities : ndarray, shape (n, 4)
        Noise-free inner products with the templates and the probability of each answer, in the order of
        `ORIENTATIONS`, averaged over displacements; NaN if the observer is not linear.
    answers : ndarray of int, shape (n,)
        Answer drawn, or the most probable answer; an index into `ORIENTATIONS`.
    p_correct : ndarray, shape (n,)
        Probability of the correct answer; 1 or 0 if answers were drawn.
    fits : tuple of GroupFit
    skipped : tuple of Skipped
    n_negative : int
        Number of display pixels with a luminance below zero, among those read.
    plan : tuple of Step
        Stages that were kept or left out.
    """

    trials: tuple[Trial, ...]
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
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> ScoredDataset:
    """Show every trial to the observer and fit a psychometric function to each group.

    The random numbers depend on the seed alone: each trial has its own random stream, whatever the order of the
    trials or the number of workers.

    Parameters
    ----------
    dataset : Dataset
    observer : Observer
    decisions : {"expected", "sampled"}
        "expected": the probability of a correct answer under the internal noise. "sampled": one answer drawn for
        each trial with noise on every neuron, as in the paper.
    curve : {"observer", "weibull"}, optional
        Psychometric function of the thresholds. Default: that of `fitted_curve`.
    seed : int
        Seed of all random streams.
    fit_settings : FitSettings, optional
        Settings of the psychometric fits.
    tolerance : float, optional
        Largest relative error of the thresholds due to the displacement of the retina: each trial is seen with as
        many displacements as this needs. Without it each trial is seen with one displacement.
    plan_name : {"needed", "full"}
        "needed": leave out stages that change thresholds far less than the tolerance. "full": leave out nothing.
    skip_bad_frames : bool
        Skip trials that cannot be read and list them, instead of raising the first error.
    workers : int
        Number of threads that read and score.
    progress : callable
        Called with the number of trials done since the last call.

    Returns
    -------
    ScoredDataset

    Raises
    ------
    FrameError, DataError
        If a row or frame is bad, unless bad frames are skipped.
    SettingsError
        If decisions are "expected" and the observer is not linear, or a tolerance or the observer's curve is asked
        for and decisions are not "expected".
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
    plan = plan_score(
        dataset, whole, observer, name=plan_name, tolerance=tolerance or DEFAULT_TOLERANCE, expected=expected
    )
    scoring = Scoring(dataset, plan, decisions, seed, displacements=0 if tolerance is None else 1)
    see = partial(see_trials, show=score_trial, skip_bad_frames=skip_bad_frames, workers=workers)
    seen, unread = see(scoring, whole, progress=progress)
    skipped += unread
    check_seen(dataset, seen, skipped)
    fit_settings = settings_of_level(fit_settings, dataset.experiment.level)
    fit = partial(fit_groups, plan, seed=seed, fit_settings=fit_settings, curve=curve, expected=expected)
    decided = fit(seen)
    if tolerance is not None:
        again = [
            one
            for group in decided.fits
            if (displacements := _displacements_needed(group, tolerance)) > 1
            for one in see(
                replace(scoring, displacements=displacements),
                [one.trial for one in seen if one.trial.group == group.group],
                progress=None,
            )[0]
        ]
        if again:
            of_number = {one.trial.number: one for one in seen + again}
            decided = fit(list(of_number.values()))
    return replace(decided, skipped=tuple(skipped))


def fitted_curve(curve: CurveName | None, decisions: Decisions) -> CurveName:
    """Return the curve to fit: by default the observer's for expected decisions, Weibull's for sampled ones.

    Raises
    ------
    SettingsError
        If the observer's curve is asked for and decisions are sampled.
    """
    if decisions == "expected":
        return curve or "observer"
    if curve == "observer":
        raise SettingsError(
            "curve: found 'observer' with sampled decisions, expected 'weibull': the observer's curve is that of "
            "its probabilities, which a linear observer has with expected decisions"
        )
    return "weibull"


def settings_of_level(settings: FitSettings | None, level: str) -> FitSettings:
    """Return the settings of fits, which expect no slope unless the signal is proportional to the level."""
    settings = settings or FitSettings()
    is_signal = any(word in level.lower() for word in SIGNAL_WORDS)
    return settings if is_signal else replace(settings, slope_spread=None)


def usable_trials(dataset: Dataset, *, skip_bad_frames: bool) -> tuple[list[Trial], list[Skipped]]:
    """Return the trials whose rows are all good, and the frames that are skipped.

    Raises
    ------
    DataError
        If there are bad rows and `skip_bad_frames` is not set, or no trial is left.
    """
    if dataset.bad_rows and not skip_bad_frames:
        raise DataError(dataset.bad_rows[0].error)
    skipped = list(dataset.bad_rows)
    for trial in dataset.trials:
        if trial.name in dataset.spoilt:
            skipped += skipped_frames(dataset, trial, f"another frame of trial {trial.name} cannot be used")
    usable = [trial for trial in dataset.trials if trial.name not in dataset.spoilt]
    check_seen(dataset, usable, skipped)
    return usable, skipped


def check_seen(dataset: Dataset, seen: Sequence[object], skipped: Sequence[Skipped]) -> None:
    """Raise DataError if no trial could be used."""
    if not seen:
        raise DataError(f"{dataset.path}: no frame can be scored; the first: {skipped[0].error}")


def _displacements_needed(group: GroupFit, tolerance: float) -> int:
    """Return the number of displacements a replicate for an error below the tolerance, if it falls as 1/√n."""
    if group.numerical_error is None or group.fit.threshold is None:
        return 1
    ratio = group.numerical_error / (tolerance * group.fit.threshold)
    return min(math.ceil(1.1 * ratio**2), MOST_DISPLACEMENTS) if ratio > 1.0 else 1


def _displacement_step(numbers: Sequence[int]) -> Step:
    least, most = min(numbers), max(numbers)
    why = f"{least} of each trial" if least == most else f"{least} to {most} of each trial, as the tolerance takes"
    return Step("displacements", True, why)


def _single(displacements: FloatArray) -> FloatArray:
    """Return the only displacement, (2,); NaN if there are several."""
    return displacements[0] if len(displacements) == 1 else np.full(2, np.nan)


def fit_groups(
    plan: ScorePlan,
    seen: Sequence[SeenTrial],
    *,
    seed: int,
    fit_settings: FitSettings,
    curve: CurveName,
    expected: bool,
) -> ScoredDataset:
    """Compute the answers of trials that were seen, and fit a curve to each group.

    Returns
    -------
    ScoredDataset
        Trials in the order of the manifest; `skipped` is empty.
    """
    seen = sorted(seen, key=lambda one: one.trial.number)
    trials = tuple(one.trial for one in seen)
    correct = np.array([trial.orientation.quarter_turns for trial in trials])
    probabilities, p_each, bounds = _decide(plan, seen, correct)
    answers = probabilities.argmax(axis=1)
    if not expected:
        answers = np.array([one.answer for one in seen])
        p_each = [np.array([float(answer == right)]) for answer, right in zip(answers, correct, strict=True)]
        bounds[:] = 0.0
    places: dict[tuple[float | str, ...], list[int]] = {}
    for place, trial in enumerate(trials):
        places.setdefault(trial.group, []).append(place)
    # Groups are sorted with numbers before texts.
    ordered = sorted(places.items(), key=lambda item: [(isinstance(v, str), v) for v in item[0]])
    fits = []
    for number, (group, members) in enumerate(ordered):
        started = time.perf_counter()
        of_group, p_of_group = [seen[k] for k in members], [p_each[k] for k in members]
        level = np.array([one.trial.level for one in of_group])
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(FIT_STREAMS, number)))
        p_correct = np.array([p.mean() for p in p_of_group])
        fit = fit_trials(level, p_correct, curve=curve, settings=fit_settings, rng=rng)
        fits.append(
            GroupFit(
                group=group,
                fit=fit,
                non_gaussian_bound=float(bounds[members].max()),
                left_out_bound=plan.bound({one.trial.stimulus for one in of_group}),
                numerical_error=_numerical_error(level, p_of_group, fit, fit_settings),
                n_displacements=max(len(p) for p in p_of_group),
                background_luminance_cd_m2=sum(one.background_luminance_cd_m2 for one in of_group) / len(of_group),
                run_time_s=sum(one.seconds for one in of_group) + time.perf_counter() - started,
            )
        )
    return ScoredDataset(
        trials=trials,
        displacement_samples=np.array([_single(one.displacement_samples) for one in seen]),
        scores=np.array([one.scores.mean(axis=0) for one in seen]),
        probabilities=probabilities,
        answers=answers.astype(np.intp),
        p_correct=np.array([p.mean() for p in p_each]),
        fits=tuple(fits),
        skipped=(),
        n_negative=sum(one.n_negative for one in seen),
        plan=(*plan.steps, _displacement_step([len(p) for p in p_each])),
    )


def _decide(
    plan: ScorePlan, seen: Sequence[SeenTrial], correct: NDArray[np.intp]
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Compute the probability of each answer, of the correct one with each displacement, and its error bound."""
    probabilities = np.full((len(seen), 4), np.nan)
    p_each: list[FloatArray] = [np.full(1, np.nan)] * len(seen)
    bounds = np.zeros(len(seen))
    places: dict[Stimulus, list[int]] = {}
    for place, one in enumerate(seen):
        places.setdefault(one.trial.stimulus, []).append(place)
    for stimulus, members in places.items():
        readout = plan.observer_of(stimulus).readout(stimulus)
        if readout is None:
            continue
        deviations = np.concatenate([seen[k].deviations for k in members])
        answers = readout.answer_probabilities(deviations)
        ends = np.cumsum([len(seen[k].deviations) for k in members])[:-1]
        for k, of_trial in zip(members, np.split(answers, ends), strict=True):
            probabilities[k], p_each[k] = of_trial.mean(axis=0), of_trial[:, correct[k]]
        bounds[members] = readout.non_gaussian_bound
    return probabilities, p_each, bounds


def _numerical_error(
    level: FloatArray, p_each: Sequence[FloatArray], fit: PsychometricFit, fit_settings: FitSettings
) -> float | None:
    """Compute the half-width of the threshold's 95 % interval, from the spread among replicates."""
    if fit.threshold is None or len(p_each[0]) < REPLICATES:
        return None
    settings, rng = replace(fit_settings, resamples=0), np.random.default_rng(0)
    sets = np.array([p.reshape(REPLICATES, -1).mean(axis=1) for p in p_each]).T
    thresholds = [fit_trials(level, p, curve=fit.curve, settings=settings, rng=rng).threshold for p in sets]
    found = [threshold for threshold in thresholds if threshold is not None]
    if len(found) < REPLICATES:
        return None
    return float(STANDARD_ERRORS_95 * np.std(found, ddof=1) / math.sqrt(REPLICATES))
