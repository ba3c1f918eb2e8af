"""Datasets behind conditions: their thresholds, and what their frames show beside each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from scipy.special import stdtrit

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import TodframesError
from todframes.base.safe_text import in_utf8
from todframes.comparison.conditions import columns_of, series_of, viewing_of
from todframes.comparison.ratios import Measured
from todframes.comparison.records import BandSignal, ComparedCondition, ContrastResponse
from todframes.enhancement.algorithm import REFERENCE
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader
from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.scored_algorithms import ScoredAlgorithm
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.trials import Trial
from todframes.observers.interface import Observer, observer_named, setting_names
from todframes.observers.internal_noise import inner_product
from todframes.observers.pyramid import MOST_LEVELS, PyramidObserver
from todframes.observers.retina import RetinaGrid
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import DatasetRecord, Example, Fit, group_of
from todframes.results.result import Result
from todframes.results.thresholds import Thresholds
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import subsample
from todframes.scoring.examples import example_of, nearest_trial
from todframes.scoring.opening import Opened
from todframes.scoring.paired import TrialSeries
from todframes.scoring.score import GroupFit, ScoredDataset, fit_record, settings_of_experiment
from todframes.scoring.trial_scores import TrialPatches, retina_image

MOST_GROUPS, MOST_CONDITIONS = 2, 6
"""Largest numbers of groups and conditions of the examples."""

MOST_BAND_GROUPS, MOST_BAND_TRIALS = 6, 32
"""Largest number of groups, and of trials of each, that the signals of bands are measured on."""

LEAST_SHARE = 0.01
"""Least share of the reference's signal in a band that is shown."""


class Seen(NamedTuple):
    """A dataset that was scored: for each observer and gaze, with its settings, the frames as they are and after
    each algorithm. Without a name, its algorithms alone are compared.
    """

    name: str
    looks: Opened
    screen: AlgorithmDisplay
    settings: list[Json]
    results: list[list[ScoredAlgorithm]]

    def names(self) -> list[str]:
        """Return the names of its conditions."""
        algorithms = [str(each.measures.get("name", "")) for each in self.results[0]]
        return [self.name, *(f"{self.name}, {each}" for each in algorithms[1:])] if self.name else algorithms

    def measured(self, view: int, fit: FitSettings) -> list[Measured]:
        """Return its conditions for an observer and gaze."""
        data, conditions = self.looks.data, list[Measured]()
        for name, (_, scored, plain, gains, responses, measures) in zip(
            self.names(), self.results[view], strict=True
        ):
            is_changed, scenes = bool(conditions), scored.trials.scene_numbers
            points = [
                ContrastResponse(group=group_of(data, fit.group), points=responses.get(fit.group, ()))
                for fit in scored.fits
            ]
            fits = tuple(fit_record(data, fit) for fit in scored.fits)
            viewing = viewing_of(DatasetRecord.of(data).display, fits, data.trials.n_frames / len(data.trials))
            conditions.append(
                Measured(
                    name=name,
                    source=str(data.path),
                    fits=fits,
                    settings=self.settings[view],
                    viewing=viewing._replace(magnification=_magnification(data)),
                    trials=TrialSeries.of_scored(scored),
                    fit_settings=settings_of_experiment(fit, data.experiment),
                    plain=None if plain is None else TrialSeries.of_scored(plain),
                    gains=[gains.get(fit.group) for fit in scored.fits],
                    measures=(measures if is_changed or not self.name else {})
                    | ({"source": in_utf8(str(data.path))} if self.name else {})
                    | {"contrast_responses": tuple(points) if is_changed else ()}
                    | {"n_scenes": None if scenes is None else int(scenes.max()) + 1},
                )
            )
        return conditions

    def group_with(self, fit: Fit) -> GroupFit | None:
        """Return the group that a threshold is of; None if the dataset does not have it."""
        groups = ((one, group_of(self.looks.data, one.group)) for one in self.results[0][0].scored.fits)
        return next((one for one, group in groups if fit.group.items() <= group.items()), None)

    def shown(self, row: int, grid: RetinaGrid) -> tuple[Trial, tuple[float, float], list[TrialPatches]]:
        """Return a trial, the displacement of the grid in it, and its frames in each condition."""
        scored = self.results[0][0].scored  # all algorithms have the same trials
        dx, dy = np.nan_to_num(scored.displacement_samples[row]).tolist()
        reader = TrialReader([result.enhancement for result in self.results[0]], self.screen)
        observer, trial = self.looks.observers[0], scored.trials[row]
        return trial, (dx, dy), reader.read(self.looks.data, trial, observer, grid, [(dx, dy)], whole=True)[0]


def unchanged(scored: ScoredDataset) -> ScoredAlgorithm:
    """Return the frames of a dataset as they are, as a condition."""
    return ScoredAlgorithm(find_enhancement(REFERENCE), scored, None, {}, {}, {})


def _magnification(data: Dataset) -> float | None:
    """Return the visual angle of a dataset's first triangle over that at the camera; None if it is not known."""
    trial = data.trials[0]
    at_camera = group_of(data, trial.group).get("object_size_mrad")
    return trial.stimulus.size_mrad / at_camera if isinstance(at_camera, float) else None


def with_frames(name: str, seen: Seen | Result, max_frame_mb: int) -> Seen | None:
    """Return a condition with its frames. A saved result of `score` has those of its dataset; None unless they are
    there as they were, its triangles were where the manifest says, all trials were scored and saved, and the
    observer has a name.
    """
    if isinstance(seen, Seen):
        return seen
    if not isinstance(seen, Thresholds) or not isinstance(seen.dataset, DatasetRecord):
        return None
    record = seen.dataset
    if seen.command != "score" or seen.located or not record.manifest_sha256:
        return None
    try:
        data, series = load_dataset(record.path, max_frame_mb=max_frame_mb), series_of(seen)
        observer = _observer_of(seen.settings)
    except TodframesError:
        return None
    if series is None or observer is None or len(series.p_correct) != len(data.trials):
        return None
    if DatasetRecord.of(data).manifest_sha256 != record.manifest_sha256:
        return None
    columns, none = columns_of(seen.trials), np.empty((0, 4))
    displaced = [columns[f"displacement_{axis}_samples"] for axis in "xy"]
    scored = ScoredDataset(
        trials=data.trials,
        displacement_samples=np.array(displaced, np.float64).T,
        scores=none,
        probabilities=none,
        answers=np.empty(0, np.intp),
        p_correct=series.p_correct,
        fits=tuple(
            GroupFit(data.trials.groups[data.trials.group_codes[rows[0]]], fit, 0.0, None, 0, math.nan)
            for rows, fit in zip(series.rows, series.fits, strict=True)
        ),
        skipped=(),
        n_negative=0,
    )
    data = replace(data, gaze=seen.settings.get("gaze", data.gaze))
    looks = Opened(data, [observer], [seen.settings], None, {}, lambda _: ())
    screen = AlgorithmDisplay(data.display, 1.0, allow_clipping=False)
    return Seen(name, looks, screen, [seen.settings], [[unchanged(scored)]])


def _observer_of(settings: dict[str, Any]) -> Observer | None:
    """Return the observer of a result; None if its name is that of a file or class, whose code is not run."""
    name = str(settings.get("observer", ":"))
    if ":" in name:
        return None
    observer: Any = observer_named(name)
    known = {key: settings[key] for key in setting_names(observer.settings) if key in settings}
    own = {key: tuple(value) if isinstance(value, list) else value for key, value in known.items()}
    found: Observer = type(observer)(replace(observer.settings, **own))
    return found


def compare_examples(seen: Sequence[Seen], conditions: Sequence[ComparedCondition]) -> tuple[Example, ...]:
    """Draw the trial nearest to the reference's threshold in up to two groups, in each of up to six conditions: of
    other datasets, that of the nearest level and the same orientation.

    All pictures of a group have the same white. Raises FrameError if a frame can no longer be used.
    """
    examples: list[Example] = []
    for fit in subsample([fit for fit in conditions[0].fits if fit.threshold is not None], MOST_GROUPS):
        drawings, first = [], None
        for each in seen:
            data, observer, results = each.looks.data, each.looks.observers[0], each.results[0]
            scored, group = results[0].scored, each.group_with(fit)
            if group is None:
                continue
            rows, level = scored.trials.indices_of_group(group.group), fit.threshold
            if first is not None:
                alike = rows[scored.trials.quarter_turns[rows] == first.orientation.quarter_turns]
                rows, level = alike if len(alike) else rows, first.level
            row = nearest_trial(scored, group, rows, level=level)
            grid = observer.grid(scored.trials[row].stimulus)
            trial, displaced, ways = each.shown(row, grid)
            first = first or trial
            names = each.names() if each.name else [result.enhancement.spec for result in results]
            for name, result, shown in zip(names, results, ways, strict=True):
                draw = partial(
                    pictures,
                    [ExamplePatch(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
                    retina_image(shown, grid, displaced),
                    pixel_pitch_mrad=shown.pixel_pitch_mrad,
                    observer=observer,
                    stimulus=trial.stimulus,
                )
                make = partial(example_of, data, trial, float(result.scored.p_correct[row]), condition=name)
                drawings.append((draw, make))
        some = drawings[:MOST_CONDITIONS]
        white = max((draw()[1][0].scale or 0.0 for draw, _ in some), default=0.0)
        for draw, make in some:
            width_mrad, drawn = draw(white=white)
            examples.append(structs.replace(make(width_mrad=width_mrad, drawn=drawn), group=fit.group))
    return tuple(examples)


def with_bands(seen: Sequence[Seen], conditions: Sequence[ComparedCondition]) -> tuple[ComparedCondition, ...]:
    """Return the conditions with the signal in each band of the observer's pyramid. They stay as they are if it
    has none, or the frames of the reference are not there. Raises FrameError if a frame can no longer be used.

    The score of a trial's orientation over the mean of all four, per unit of level, is a sum over bands. Groups
    count alike: each is divided by the reference's whole signal in it.
    """
    signals: dict[str, dict[tuple[str, ...], FloatArray]] = {}
    for fit in subsample([fit for fit in conditions[0].fits if fit.threshold is not None], MOST_BAND_GROUPS):
        for each in seen:
            for name, size, of_trials in _band_signals(each, fit):
                signals.setdefault(name, {})[str(fit.group), size] = of_trials
    first = signals.get(conditions[0].name, {})
    settings: Any = seen[0].looks.observers[0].settings
    made = []
    for condition in conditions:
        own = signals.get(condition.name, {})
        pairs = [(of_group, first[group]) for group, of_group in own.items() if group in first]
        bands: tuple[BandSignal, ...] = ()
        if pairs:
            samples = getattr(settings, "wavelength_samples", 4.0)
            finest = 1.0 / (samples * settings.retina_pitch_mrad)
            bands = band_ratios(pairs, finest, is_paired=condition.by in (None, "paired_trials"))
        made.append(structs.replace(condition, bands=bands))
    return tuple(made)


def _band_signals(seen: Seen, fit: Fit) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield each condition's name with the size of its triangles at the eye, as text, and the signal of trials of
    a group in the bands of the observer, (n, `MOST_LEVELS` + 1), 0 in bands that it does not have.

    The trials are those of the levels next above the reference's threshold. Nothing comes of another observer.
    """
    observer, group, scored = seen.looks.observers[0], seen.group_with(fit), seen.results[0][0].scored
    if not isinstance(observer, PyramidObserver) or group is None or fit.threshold is None:
        return
    if fit.level != seen.looks.data.experiment.level:
        return
    # A random order, the same for the same trials, so that orientations differ.
    rows = np.random.default_rng(0).permutation(scored.trials.indices_of_group(group.group))
    above = np.log(scored.trials.levels[rows] / fit.threshold)
    rows = rows[np.lexsort([np.abs(above), above < 0.0])][:MOST_BAND_TRIALS]
    signals = np.zeros((len(seen.results[0]), len(rows), MOST_LEVELS + 1))
    for number, row in enumerate(rows.tolist()):
        stimulus, grid = scored.trials[row].stimulus, observer.grid(scored.trials[row].stimulus)
        trial, displaced, ways = seen.shown(row, grid)
        templates = observer.templates(stimulus)
        own = templates[trial.orientation.quarter_turns]
        for of_condition, shown in zip(signals[:, number], ways, strict=True):
            activity = observer.activity(retina_image(shown, grid, displaced))
            for k, (weights, *each) in enumerate(zip(own, *templates, strict=True)):
                of_condition[k] = inner_product(weights - sum(each) / 4.0, activity[k]) / trial.level
    for name, of_trials in zip(seen.names(), signals, strict=True):
        yield name, f"{stimulus.size_mrad:.3g}", of_trials


def band_ratios(
    pairs: Sequence[tuple[FloatArray, FloatArray]], finest: float, *, is_paired: bool
) -> tuple[BandSignal, ...]:
    """Return the signal in each band from that of a condition and of the reference in trials of some groups, (n,
    bands) each. `finest` is the frequency of the first band in cycles/mrad. Of paired trials, errors that are in
    both have no part in the error of their ratio. Bands in which the reference has no signal are left out.
    """
    scaled = [[side / before.mean(axis=0).sum() for side in (own, before)] for own, before in pairs]
    own, first = (sum(of_group[side].mean(axis=0) for of_group in scaled) / len(pairs) for side in (0, 1))
    error_before = np.sqrt(sum(_variance(before) for _, before in scaled)) / len(pairs)
    with np.errstate(invalid="ignore"):  # bands that are not there
        ratio = own / first
        variances = [
            _variance(now - ratio * before) if is_paired else _variance(now) + ratio**2 * _variance(before)
            for now, before in scaled
        ]
        error = np.sqrt(sum(variances)) / len(pairs) / first
    half = stdtrit(sum(len(before) - 1 for _, before in scaled), 0.975) * error
    bands = []
    for k in np.flatnonzero((first > LEAST_SHARE) & (first > 3.0 * error_before)).tolist():
        ends = [end if end > 0.0 else None for end in (float(ratio[k] - half[k]), float(ratio[k] + half[k]))]
        bands.append(
            BandSignal(
                cycles_per_mrad=finest / 2**k,
                share=float(own[k] / own.sum()),
                ratio=float(ratio[k]),
                ratio_ci95=(ends[0], ends[1]) if error[k] > 0.0 else None,
            )
        )
    return tuple(bands)


def _variance(values: FloatArray) -> FloatArray:
    """Return the variance of the mean over trials, (n, bands); infinite of one."""
    return values.var(axis=0, ddof=1) / len(values) if len(values) > 1 else np.full(values.shape[1], np.inf)
