"""The call `calibrate`: the internal noise, or the efficiency, with which an observer answers as people do.

Each trial is shown to the observer as the person saw it: the code values of the monitor, their dither included, at
the visual angle of its pixels. The scores of a trial are computed once; any internal noise then costs little.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, FrameError, SettingsError, argument
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.display.display import Display
from todframes.experiment.answers import DESCRIPTION_FILE, Session, TrialRow, at_eye, flagged, read_answers
from todframes.experiment.calibration import CalibratedPeople, FurtherObserver, PersonResult
from todframes.experiment.monitor import Monitor, shown_codes, shown_contrast, trial_image
from todframes.experiment.noise_fit import MOST_CERTAIN, AnswerTable, NoiseFit, fit_noise, joined, with_lapses
from todframes.experiment.session import frames_sha256, shown_dataset
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.files import FrameSource
from todframes.frames.memory import ArrayFrame
from todframes.frames.trials import FrameReference, Trial, Trials
from todframes.jobs.run import Run, opened_run
from todframes.observers.interface import Observer, Readout
from todframes.parameters import Count, Free, ObserverNames, OnError, Progress, Seed, Subjects
from todframes.psychometrics.curves import GUESS_RATE
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_counts, fit_trials
from todframes.results.data import DatasetRecord, Fit, ResultWarning, group_of, observer_names
from todframes.results.thresholds import Thresholds
from todframes.scoring.opening import described_each, loaded, of_observer
from todframes.scoring.score import check_seen, groups_of, settings_of_experiment
from todframes.scoring.trial_scores import Scoring, read_trial, score_trials, score_views, trial_viewing
from todframes.stimulus import Stimulus

NOISE, NOISE_SD, BLUR, EFFICIENCY = "internal_noise", "internal_noise_sd", "template_blur_samples", "efficiency"
"""Settings of an observer that are fitted, or that contradict a fitted one. Where there is an efficiency and no
internal noise, the noise is that of efficiency 1 times a factor, and the efficiency is its inverse square."""

DISPLACEMENTS = 1
"""Number of displacements of the retina in each of the `REPLICATES` sets that P(correct) of a trial averages."""

BLUR_FACTORS = 2.0 ** (np.arange(-4, 3) / 2.0)
"""Template blurs that are tried, over that of the observer: a quarter to twice. With more blur, next to nothing of
the templates of small triangles is left in the bands."""

NOISE_GRID_STEP = 0.25
"""Distance of the values of ln noise for which answers are computed; those between are interpolated."""

WEAKEST_D_PRIME, STRONGEST_D_PRIME = 0.05, 20.0
"""d′ of the strongest trials under the largest noise that is tried, and of the weakest trials under the
smallest."""

SURPRISING = 0.01
"""P-value below which there is a warning."""

Z_90 = 1.645
"""Half of a 90 % interval in standard errors."""


@dataclass(frozen=True, slots=True)
class SeenDataset(Dataset):
    """The main trials of a session as a dataset of the frames that the person saw: luminance over the background.
    `shown` is the dataset that the session showed; `originals` has the trial of it and the answer of each frame,
    by the frame's path here.
    """

    shown: Dataset
    monitor: Monitor
    originals: Mapping[str, tuple[Trial, TrialRow]]

    def frame_path(self, frame: FrameReference) -> Path:
        """Return the path of the frame that was shown."""
        trial, _ = self.originals[frame.path]
        return self.shown.frame_path(trial.frames[0])

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:
        """Show the frame on the monitor again; raise FrameError if it has changed or cannot be used."""
        trial, row = self.originals[frame.path]
        if verify and (found := frames_sha256(self.shown, trial)) != row.sha256:
            raise FrameError(
                self.frame_path(frame),
                f"has changed since trial {row.number} showed it: found the SHA-256 {found[:12]}…, expected "
                f"{row.sha256[:12]}…; restore it, or leave its trials out with {argument.on_error} skip",
            )
        codes = shown_codes(trial_image(self.shown, trial).contrast, self.monitor, row.dither_seed)
        luminance = (1.0 + shown_contrast(codes, self.monitor)).astype(np.float32)
        return ArrayFrame(self.frame_path(frame), luminance)


def seen_dataset(dataset: Dataset, session: Session) -> SeenDataset:
    """Return the trials that a person answered in the main phase of a session, as the person saw them. Sizes are
    those at the eye, in the group and the level too if these are the column `size_mrad`.
    """
    asked, where, experiment = session.record.dataset, session.path, dataset.experiment
    if replace(shown_dataset(dataset), path=asked.path) != asked:
        raise DataError(
            f"{where}: the answers are to another dataset, {asked.path}, or its manifest.csv, level, group_by or "
            f"pixel pitch have changed since in {dataset.path}"
        )
    rows = session.main_rows()
    if not rows:
        raise DataError(f"{where}: found no answers of the main trials, expected at least one")
    of_frame = {trial.frames[0].path: trial for trial in dataset.trials}
    ratio = session.monitor.pixel_pitch_mrad / dataset.display.pitch_mrad
    originals, trials = {}, []
    for number, row in enumerate(rows):
        trial = of_frame.get(row.frame)
        if trial is None:
            raise DataError(f"{where}, trial {row.number}: frame: found {row.frame!r}, which the dataset lacks")
        name = f"{row.frame} (trial {row.number})"
        originals[name] = trial, row
        group = zip(experiment.group_by, trial.group, strict=True)
        trials.append(
            trial._replace(
                number=number,
                name=name,
                frames=(FrameReference(name, None, None),),
                stimulus=Stimulus(trial.stimulus.size_mrad * ratio, trial.stimulus.polarity),
                level=float(at_eye(experiment.level, trial.level, ratio)),
                group=tuple(at_eye(column, value, ratio) for column, value in group),
            )
        )
    display = Display(
        eotf="linear", background_luminance_cd_m2=1.0, pixel_pitch_mrad=dataset.display.pitch_mrad * ratio
    )
    return SeenDataset(
        path=dataset.path,
        display=display,
        experiment=experiment,
        trials=Trials.of(trials),
        bad_rows=(),
        spoilt=frozenset(),
        manifest_sha256=dataset.manifest_sha256,
        max_frame_mb=dataset.max_frame_mb,
        shown=dataset,
        monitor=session.monitor,
        originals=originals,
    )


@dataclass(frozen=True, slots=True, eq=False)
class AnsweredTrials:
    """The answers of a person, (trial,), and the model's scores of the same trials, those that could be read.
    Stimuli and levels are those at the eye. `deviations` of the scores are (trial, blur, displacement, 4);
    `readouts` has, for each stimulus, the readout at each blur with an internal noise of 1.
    """

    subject: str
    trials: Trials
    is_correct: NDArray[np.bool_]
    deviations: FloatArray
    readouts: Mapping[Stimulus, Sequence[Readout]]
    skipped: tuple[Skipped, ...]

    def strengths(self) -> FloatArray:
        """Compute the largest d′ between two answers of each trial, with an internal noise of 1: (trial,)."""
        strengths = np.empty(len(self.trials))
        for rows, readouts in self._by_stimulus():
            variance = np.diagonal(readouts[0].noise_covariance)
            sd = np.sqrt(variance + variance[[1, 2, 3, 0]] - 2.0 * readouts[0].noise_covariance[0, [1]])
            strengths[rows] = np.ptp(self.deviations[rows, 0], axis=-1).mean(axis=-1) / sd.min()
        return strengths

    def table(self, ln_noise: FloatArray, blurs: FloatArray) -> AnswerTable:
        """Compute P(correct) of each trial for some internal noises, averaged over displacements."""
        logit = np.empty((len(self.trials), len(blurs), len(ln_noise)))
        turns = self.trials.quarter_turns
        for rows, readouts in self._by_stimulus():
            for blur, readout in enumerate(readouts):
                # Scores of half the size are to the decision what noise of twice the width is.
                scaled = self.deviations[rows, blur][..., None, :] / np.exp(ln_noise)[:, None]
                p = readout.answer_probabilities(scaled).mean(axis=1)
                is_right = (np.arange(4) == turns[rows, None])[:, None]
                # The sum of the wrong answers keeps the digits that 1 − P(right) has lost.
                right, wrong = ((p * which).sum(axis=-1) for which in (is_right, ~is_right))
                least = math.exp(-MOST_CERTAIN)
                logit[rows, blur] = np.log(np.maximum(right, least)) - np.log(np.maximum(wrong, least))
        return AnswerTable(ln_noise, np.log(blurs), logit)

    def _by_stimulus(self) -> list[tuple[NDArray[np.intp], Sequence[Readout]]]:
        return [(rows, self.readouts[stimulus]) for stimulus, rows in self.trials.by_stimulus()]


def answered_trials(
    dataset: Dataset,
    session: Session,
    observers: Sequence[Observer],
    *,
    skip_bad_frames: bool = False,
    seed: int = 1,
    run: Run | None = None,
) -> AnsweredTrials:
    """Show the main trials of a session to an observer, with each template blur, as the person saw them.
    `observers` are the same one with an internal noise of 1 and one template blur each, rising.
    """
    seen = seen_dataset(dataset, session)
    scorings = [Scoring(seen, observer, "expected", seed, displacements=DISPLACEMENTS) for observer in observers]
    shown_to: dict[int, FloatArray] = {}
    skipped = score_trials(
        scorings[-1],  # the widest blur needs the widest field
        seen.trials,
        partial(_show, scorings),
        kind=np.ndarray,
        collect=shown_to.__setitem__,
        skip_bad_frames=skip_bad_frames,
        run=run or Run(),
    )
    rows = np.array(sorted(shown_to), np.intp)
    trials = check_seen(dataset, seen.trials.select(rows), skipped)
    answers = session.main_rows()
    return AnsweredTrials(
        subject=session.subject,
        trials=trials,
        is_correct=np.array([answers[row].is_correct for row in rows]),
        deviations=np.array([shown_to[row] for row in rows]),
        readouts={
            stimulus: [observer.linear_readout(stimulus) for observer in observers] for stimulus in trials.stimuli
        },
        skipped=tuple(skipped),
    )


def _show(scorings: Sequence[Scoring], scoring: Scoring, trial: Trial, readout: Readout | None) -> FloatArray:
    """Compute the score deviations of a trial, (blur, displacement, 4); displacements are those of all blurs."""
    widest = trial_viewing(scoring, trial, readout)
    shown = read_trial(scoring.dataset, trial, widest.observer, widest.grid, widest.displacement_samples)
    viewings = [trial_viewing(each, trial, each.readout(trial.stimulus)) for each in scorings]
    seen = [score_views(each, trial, view, [shown])[0] for each, view in zip(scorings, viewings, strict=True)]
    return np.stack([each.deviations for each in seen])


def noise_observers(
    observer: Observer, stimulus: Stimulus, *, blur_is_free: bool
) -> tuple[list[Observer], FloatArray]:
    """Return an observer with an internal noise of 1 and each template blur that is tried, and these blurs."""
    settings = getattr(observer, "settings", None)
    names = [field.name for field in fields(settings)] if is_dataclass(settings) else []
    for name in (fitted_setting(observer), *([BLUR] * blur_is_free)):
        if name not in names:
            raise SettingsError(
                f"observer: {type(observer).__name__} has no setting {name}, which is to be fitted"
            )
    one, two = (_changed(observer, {NOISE: noise}) for noise in (1.0, 2.0))
    first, second = one.readout(stimulus), two.readout(stimulus)
    if first is None or second is None:
        raise SettingsError(
            "observer: found one that is not linear, so the probability of its answers is not known; expected a "
            "linear one, such as pyramid"
        )
    is_same = first.weights_key == second.weights_key
    if not (is_same and np.allclose(second.noise_covariance, 4.0 * first.noise_covariance, rtol=1e-9, atol=0.0)):
        raise SettingsError(
            f"observer: its weights depend on its {fitted_setting(observer).replace('_', ' ')}, which is to be "
            "fitted; expected fixed weights (informative: sample_noise_sd = 0; csf: template = matched)"
        )
    blur = float(getattr(settings, BLUR, 1.0))
    if not blur_is_free:
        return [one], np.array([blur or 1.0])
    if blur <= 0.0:
        raise SettingsError(f"{BLUR}: found {blur:g}, expected > 0 if it is free: other blurs are multiples of it")
    blurs = blur * BLUR_FACTORS
    return [_changed(one, {BLUR: each}) for each in blurs.tolist()], blurs


def fitted_setting(observer: Observer) -> str:
    """Return the name of the setting that is fitted: the efficiency of an observer without an internal noise."""
    settings = getattr(observer, "settings", None)
    return EFFICIENCY if hasattr(settings, EFFICIENCY) and not hasattr(settings, NOISE) else NOISE


def _changed(observer: Observer, changes: dict[str, Any]) -> Observer:
    """Return the observer with other settings; `internal_noise` replaces `internal_noise_sd` or `efficiency`."""
    settings = observer.settings
    if NOISE in changes and fitted_setting(observer) == EFFICIENCY:
        changes = {name: value for name, value in changes.items() if name != NOISE} | {
            EFFICIENCY: changes[NOISE] ** -2
        }
    if NOISE in changes and hasattr(settings, NOISE_SD):
        changes = {NOISE_SD: None, **changes}
    return type(observer)(replace(settings, **changes))


def noise_grid(answered: Sequence[AnsweredTrials]) -> FloatArray:
    """Return ln of the internal noises to try: from hardly any wrong answers to guesses in all trials."""
    strengths = np.concatenate([answers.strengths() for answers in answered])
    most = float(strengths.max())
    if not most > 0.0:
        raise DataError("the model sees no difference between the four triangles in any trial; look at the frames")
    weak = max(float(np.quantile(strengths, 0.1)), 1e-3 * most)
    low, high = math.log(weak / STRONGEST_D_PRIME), math.log(most / WEAKEST_D_PRIME)
    return np.linspace(low, high, math.ceil((high - low) / NOISE_GRID_STEP) + 1)


class Calibrated(NamedTuple):
    """The fits of all persons, and of all answers together with one noise for all; None for a single person. `own`
    are the persons' own thresholds, from their counts alone. `equal_noise_p_value` is that of the likelihood-ratio
    test that all persons have the pooled parameters.
    """

    persons: tuple[PersonResult, ...]
    pooled: PersonResult | None
    own: tuple[Fit, ...]
    equal_noise_p_value: float | None
    skipped: tuple[Skipped, ...]
    warnings: tuple[ResultWarning, ...]


def calibration_warnings(
    persons: Sequence[PersonResult], equal_noise_p_value: float | None, fitted: str
) -> Iterator[ResultWarning]:
    """Yield warnings about persons whom the model does not describe, and about persons who differ. `fitted` is the
    name of the setting of the observer that was fitted.
    """
    name = fitted.replace("_", " ")
    warned = partial(ResultWarning, expected=SURPRISING)
    for person in persons:
        p_value = person.deviance_p_value
        if p_value is not None and p_value < SURPRISING:
            message = (
                f"the model with one {name} does not describe these answers (deviance {person.deviance:.3g} in "
                f"{person.n_cells} cells, p = {p_value:.2g}); compare the thresholds of each group with those of "
                "the model"
            )
            yield warned(code="poor_fit", group={"subject": str(person.subject)}, message=message, found=p_value)
    if equal_noise_p_value is not None and equal_noise_p_value < SURPRISING:
        message = (
            f"the persons do not have the same {name} (p = {equal_noise_p_value:.2g}); that of all together is a "
            "mean of them, and its interval does not describe how they differ"
        )
        yield warned(code="persons_differ", group={}, message=message, found=equal_noise_p_value)


def calibrate_persons(
    dataset: Dataset,
    sessions: Sequence[Session],
    observer: Observer,
    *,
    free: Sequence[Free],
    fit_settings: FitSettings,
    seed: int,
    skip_bad_frames: bool,
    run: Run,
) -> Calibrated:
    """Fit the internal noise of an observer to the answers of each person, and to all of them together. Parameters
    and errors are those of `calibrate`. The observer's own noise is not used; the criterion of `fit_settings` is
    that of the predicted thresholds too, and their `lapse_rate` that of the model unless free; 0 without one.
    """
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    stimulus = dataset.trials[0].stimulus
    observers, blurs = noise_observers(observer, stimulus, blur_is_free="blur" in free)
    answered = [
        answered_trials(dataset, session, observers, skip_bad_frames=skip_bad_frames, seed=seed, run=run)
        for session in sessions
    ]
    ln_noise = noise_grid(answered)
    tables = [group.table(ln_noise, blurs) for group in answered]
    fixed = fit_settings.lapse_rate or 0.0
    lapse_rates = (0.0, fit_settings.lapse_rate_max) if "lapse" in free else (fixed, fixed)

    setting, own, n_fitted = fitted_setting(observer), list[Fit](), 1 + len(set(free))

    def fitted(subject: str | None, members: Sequence[int], number: int) -> PersonResult:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        table = joined([tables[k] for k in members])
        is_correct = np.concatenate([answered[k].is_correct for k in members])
        cells = cells_of([answered[k] for k in members])
        fit = fit_noise(table, is_correct, cells, lapse_rates=lapse_rates, rng=rng)
        predicted, trials = [], Trials.of(trial for k in members for trial in answered[k].trials)
        groups = groups_of(trials)
        equal: Json = {}
        if fit.noise is not None:
            p_model = with_lapses(table.at(np.log([fit.noise]), np.log([fit.blur]))[:, 0, 0], fit.lapse_rate)
            of_groups = model_difference(is_correct, p_model, [rows for _, rows in groups])
            equal = dict(zip(("model_difference", "model_difference_ci90"), of_groups, strict=True))
        if subject is not None:
            for group, rows in groups:
                levels, named = trials.levels[rows], {"subject": subject, **group_of(dataset, group)}
                right = is_correct[rows].astype(np.float64)
                alone = fit_counts(levels, right, np.ones(len(rows)), settings=fit_settings, rng=rng)
                own.append(Fit.of_counts(named, dataset.experiment.level, alone))
                model = _model_curve(table.select(rows), levels, fit, fit_settings)
                if model is not None:
                    predicted.append(Fit.of_counts(named, dataset.experiment.level, model))
        flags: Counter[str] = sum((Counter(flagged(sessions[k].rows)) for k in members), Counter())
        return PersonResult(
            subject=subject,
            status=fit.status,
            **_noise_values(fit, setting),
            n_trials=len(is_correct),
            n_correct=int(is_correct.sum()),
            n_flagged=dict(flags),
            log_likelihood=fit.log_likelihood,
            aic=2.0 * n_fitted - 2.0 * fit.log_likelihood,
            deviance=fit.deviance,
            deviance_p_value=fit.deviance_p_value,
            n_cells=fit.n_cells,
            predicted=tuple(predicted),
            **equal,
        )

    subjects = list(dict.fromkeys(answers.subject for answers in answered))
    persons = tuple(
        fitted(subject, [k for k, answers in enumerate(answered) if answers.subject == subject], number)
        for number, subject in enumerate(subjects, 1)
    )
    pooled = p_value = None
    if len(persons) > 1:
        pooled = fitted(None, range(len(answered)), 0)
        p_value = _equal_noise(persons, pooled, n_fitted)
    skipped = tuple(skipped for answers in answered for skipped in answers.skipped)
    warnings = tuple(calibration_warnings(persons, p_value, setting))
    return Calibrated(persons, pooled, tuple(own), p_value, skipped, warnings)


def _noise_values(fit: NoiseFit, setting: str) -> Json:
    """Return the values of a `PersonResult` that are fitted, as far as the answers determine the noise."""
    (low, high), is_known = fit.noise_ci95, fit.status == "ok"
    values: Json = {NOISE: fit.noise, f"{NOISE}_ci95": (low, high)}
    if setting == EFFICIENCY:
        efficiency, *ends = (None if noise is None else noise**-2 for noise in (fit.noise, high, low))
        values = {f"{NOISE}_ci95": (None, None), EFFICIENCY: efficiency, f"{EFFICIENCY}_ci95": tuple(ends)}
    if is_known:
        values |= {"lapse_rate": fit.lapse_rate, "lapse_rate_ci95": fit.lapse_rate_ci95}
        values |= {BLUR: fit.blur, f"{BLUR}_ci95": fit.blur_ci95}
    return values


def model_difference(
    is_correct: NDArray[np.bool_], p_model: FloatArray, groups: Sequence[NDArray[np.intp]]
) -> tuple[float, tuple[float, float]]:
    """Return the person's proportion correct minus the model's, and its 90 % interval, in the group that is worst.
    Model and person are equal within a margin, at a level of 5 %, if this interval lies within it: two one-sided
    tests in each group, all of which have to hold. The standard error is that of the model's probabilities.
    """
    differences = []
    for rows in groups:
        p, n = p_model[rows], len(rows)
        difference = float(np.mean(is_correct[rows] - p))
        reach = Z_90 * float(np.sqrt(np.sum(p * (1.0 - p)))) / n
        differences.append((difference, (difference - reach, difference + reach)))
    return max(differences, key=lambda item: max(-item[1][0], item[1][1]))


def _equal_noise(persons: Sequence[PersonResult], pooled: PersonResult, n_parameters: int) -> float:
    from scipy.stats import chi2

    ratio = 2.0 * (sum(person.log_likelihood for person in persons) - pooled.log_likelihood)
    return float(chi2.sf(max(ratio, 0.0), n_parameters * (len(persons) - 1)))


def cells_of(answered: Sequence[AnsweredTrials]) -> NDArray[np.intp]:
    """Return a number for each trial, the same for those of the same session, group and level."""
    keys = [
        np.column_stack([np.full(len(answers.trials), number), answers.trials.group_codes, answers.trials.levels])
        for number, answers in enumerate(answered)
    ]
    return np.unique(np.concatenate(keys), axis=0, return_inverse=True)[1].ravel()


def _model_curve(
    table: AnswerTable, levels: FloatArray, fit: NoiseFit, settings: FitSettings
) -> PsychometricFit | None:
    """Fit the observer's curve to the probabilities with the internal noise; None if it is not known. Its
    threshold is the level at which the person is right with the criterion's probability, lapses included; the
    interval has the thresholds at the ends of that of the noise.
    """
    share = fit.lapse_rate / (1.0 - GUESS_RATE)
    without_lapses = (settings.p_correct - share * GUESS_RATE) / (1.0 - share)
    if fit.noise is None or without_lapses >= 1.0:
        return None
    of_model = replace(settings, p_correct=without_lapses, guess_rate=GUESS_RATE, lapse_rate=0.0, resamples=0)

    def curve(noise: float) -> PsychometricFit:
        p = table.at(np.log([noise]), np.log([fit.blur]))[:, 0, 0]
        return fit_trials(levels, p, curve="observer", settings=of_model, rng=np.random.default_rng(0))

    low, high = (None if end is None else curve(end).threshold for end in fit.noise_ci95)
    return replace(curve(fit.noise), p_correct=settings.p_correct, threshold_ci95=(low, high))


@checked
def calibrate(
    dataset: Path | str | Dataset,
    answers: Path | str,
    *,
    observer: str | ObserverNames | Observer | Sequence[str | Observer] = "pyramid",
    free: Sequence[Free] = (),
    subjects: Subjects = (),
    include_flagged: bool = False,
    fit: FitSettings | None = None,
    rng: Seed | Rng = 1,
    on_error: OnError = "stop",
    workers: Count = 1,
    progress: Progress | None = None,
) -> Thresholds:
    """Fit the observer's internal noise, or its efficiency, to the answers of people to the frames of a dataset.

    With several observers, the first lines say which explains each person better, by AIC.

    Parameters
    ----------
    dataset : path, str or Dataset
        The folder of the dataset that was shown.

        The return value of `load_dataset` is taken as well.
    answers : path
        Folder that `todframes experiment` wrote.
    observer : str, Observer, or sequence of them
        Observers by name: pyramid, csf or others that are linear and registered; or MODULE:CLASS, a class of your
        own, whose code is run. The value of the noise or efficiency that is fitted is not used.

        Objects are taken as well. The first is that of `persons`, the others of `observers`.
    free : sequence of {"lapse", "blur"}
        Fit the rate of lapses, or the blur of the templates, too.

        The rate δ of lapses is up to `lapse_rate_max` of `fit`; the blur is the observer's
        `template_blur_samples`, from a quarter to twice its value.
    subjects : sequence of str
        A person, by the id. Default: all.
    include_flagged : bool
        Count answers within 150 ms, or while the page was hidden or had lost the focus, as well.
    fit : FitSettings, optional
        Fixed and free parameters of the persons' own curves. A fixed `lapse_rate` is that of the model too.
    rng : int, SeedSequence or Generator
        Seed of the displacements of the retina and of repeated experiments.
    on_error : {"stop", "skip"}
        At a frame that cannot be used or has changed since: end with an error, or leave its trials out and list
        them.
    workers : int
        Processes that share the work.
    progress : function of two ints, optional
        Called with the number of trials of a session that are done, and of all.

    Returns
    -------
    Result
        Result whose `persons` have the internal noise, or the efficiency, of each person and the thresholds of the
        model with it; `pooled` is for all persons together. `thresholds` are the persons' own, from their counts
        alone.

    Raises
    ------
    DataError, FrameError
        If the answers are damaged or belong to another dataset, or a frame cannot be used or has changed since.
    SettingsError
        If a setting is invalid, or the observer's noise cannot be fitted.
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from todframes.experiment.calibrate import calibrate_persons

    if isinstance(dataset, str | Path) and (Path(dataset) / DESCRIPTION_FILE).exists():
        raise SettingsError(f"dataset: {dataset} holds answers, expected calibrate(dataset, answers)")
    fit = fit or FitSettings()
    sessions = read_answers(Path(answers), include_flagged=include_flagged)
    known = {session.subject for session in sessions}
    for subject in subjects:
        if subject not in known:
            raise DataError(f"{answers}: found no subject {subject!r}, expected one of {', '.join(sorted(known))}")
    sessions = [session for session in sessions if not subjects or session.subject in subjects]
    judges, each_settings = described_each(observer, lambda: _background_of(sessions))
    data = loaded(dataset)
    skips = on_error == "skip"
    with opened_run(workers, None, None, progress) as run:
        how = partial(calibrate_persons, free=free, fit_settings=fit, seed=seed, skip_bad_frames=skips, run=run)
        each = [how(data, sessions, judge) for judge in judges]
    fitted = ("efficiency", "internal_noise", "internal_noise_sd", *(["template_blur_samples"] * ("blur" in free)))
    results = []
    for own, calibrated in zip(each_settings, each, strict=True):
        kept = {name: value for name, value in own.items() if name not in fitted}
        results.append(FurtherObserver(settings=kept, persons=calibrated.persons, pooled=calibrated.pooled))
    first, *further = results
    names = observer_names([result.settings for result in results]) if further else [""]
    return CalibratedPeople.made(
        "calibrate",
        started,
        settings=first.settings | asdict(fit) | {"free": list(free), "include_flagged": include_flagged},
        seed=seed,
        fits=each[0].own,
        persons=first.persons,
        pooled=first.pooled,
        equal_noise_p_value=each[0].equal_noise_p_value,
        dataset=DatasetRecord.of(data),
        skipped=tuple(row._asdict() for row in each[0].skipped),
        observers=tuple(further),
        warnings=tuple(
            warning
            for name, calibrated in zip(names, each, strict=True)
            for warning in of_observer(name, calibrated.warnings)
        ),
    )


def _background_of(sessions: Sequence[Session]) -> float:
    """Return the luminance of the monitors' background in cd/m²: the mean over sessions."""
    backgrounds = [session.monitor.background_luminance_cd_m2 for session in sessions]
    if None in backgrounds:
        raise SettingsError(
            "luminance_cd_m2: found background, which is not known: no photometer was read in the experiment; "
            "expected a number"
        )
    return math.fsum(luminance for luminance in backgrounds if luminance is not None) / len(backgrounds)
