"""Dataset × observer × algorithms → thresholds of each, and their ratios to the frames as they are.

All are given the same frames, and what they make of them is looked at with the same displacement of the retina and
the same noise on its neurons.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, FrameReference, Trial
from todframes.enhanced import DecodedFrame, Picture, Screen
from todframes.enhancement import REFERENCE, Enhancement
from todframes.enhancement_specs import find_enhancement
from todframes.errors import DataError, FrameError, SettingsError
from todframes.frames import FrameFile, read_frame
from todframes.likeness import psnr_db, squared_error_and_ssim
from todframes.pairing import RatioDraws, ThresholdRatio, holm, ratio_draws, threshold_ratio
from todframes.psychometric import MAX_RESAMPLES, FitSettings
from todframes.readout import Observer
from todframes.running import RATIO_STREAMS, run_trials, trial_draws
from todframes.scoring import Decisions, ScoredDataset, assemble, scored_view
from todframes.viewing import View, check_sha256, place_grid

FloatArray = NDArray[np.float64]
Verdict = Literal["better", "worse", "no difference shown", "mixed"]

SIGNIFICANCE = 0.05
RESAMPLES_PER_COMPARISON = 80
"""So that the smallest p-value there can be, 2 / resamples, is half of 5 % even after Holm's correction."""

# Columns behind those of `scored_view`: of the mean over a trial's frames, but for the sums at the end.
SCORED, SQUARED_ERROR, SSIM, N_CLIPPED, CPU_S = slice(0, 12), 12, 13, 14, 15


class Compared(NamedTuple):
    """A ratio of thresholds, algorithm to reference, and what it says; of one group, or of all if `group` is None.

    `p_value_holm` is corrected for the number of all ratios of the comparison, and the verdict rests on it.
    """

    group: tuple[float | str, ...] | None
    ratio: ThresholdRatio
    p_value_holm: float
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class AlgorithmResult:
    """An algorithm's scores and how they compare with the reference's.

    `compared` has one item for each group, in the order of `scored.fits`; for several groups `overall` is their
    geometric mean. Both are empty for the reference itself. `psnr_db` and `ssim` are those of the displayed
    luminance against the frames without noise, over all trials that have one; None if there are none. `n_clipped`
    values were beyond the display's range. `cpu_s` is the algorithm's own running time over all frames.
    """

    enhancement: Enhancement
    scored: ScoredDataset
    compared: tuple[Compared, ...]
    overall: Compared | None
    psnr_db: float | None
    ssim: float | None
    n_clipped: int
    cpu_s: float


def compare_dataset(
    dataset: Dataset,
    observer: Observer,
    enhancements: Sequence[Enhancement],
    *,
    decisions: Decisions = "expected",
    seed: int = 1,
    fit_settings: FitSettings | None = None,
    screen: Screen | None = None,
    skip_bad_frames: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> tuple[AlgorithmResult, ...]:
    """Show every trial to the observer as it is and after each algorithm, and compare the thresholds.

    Parameters
    ----------
    enhancements : sequence of Enhancement
        The reference, `none`, comes first in the result, whether it is among them or not.
    screen : Screen, optional
        Default: the dataset's display with a white of 1, and no clipping.

    The others are as in `score_dataset`, whose scores and fits the reference's are, number for number.

    Returns
    -------
    tuple of AlgorithmResult

    Raises
    ------
    FrameError, DataError
        The first thing wrong with a row, a frame or what an algorithm makes of it, unless such trials are skipped:
        for all algorithms alike.
    SettingsError
        If an algorithm is there twice, there are no resamples, or decisions are "expected" and the observer is not
        linear.
    """
    fit_settings = fit_settings or FitSettings()
    if not fit_settings.resamples:
        raise SettingsError("resamples: found 0, expected 40 or more: a comparison rests on them")
    algorithms = [find_enhancement(REFERENCE), *(one for one in enhancements if not one.is_reference)]
    for number, one in enumerate(algorithms):
        if one.spec in [other.spec for other in algorithms[:number]]:
            raise SettingsError(f"enhance {one.spec!r}: found twice, expected once")
    screen = screen or Screen(dataset.display)
    job = _Job(dataset, observer, tuple(algorithms), decisions, seed, screen)
    trials, table, skipped = run_trials(
        dataset, job, skip_bad_frames=skip_bad_frames, workers=workers, progress=progress
    )
    scored = [
        assemble(trials, table[:, number, SCORED], skipped, observer, decisions, seed, fit_settings)
        for number in range(len(algorithms))
    ]
    compared = _compared(scored, seed, fit_settings)
    black, white = screen.luminance_range
    results = []
    for number, (algorithm, own) in enumerate(zip(algorithms, compared, strict=True)):
        of_algorithm = table[:, number]
        results.append(
            AlgorithmResult(
                enhancement=algorithm,
                scored=scored[number],
                compared=tuple(one for one in own if one.group is not None),
                overall=next((one for one in own if one.group is None), None),
                psnr_db=psnr_db(_known_mean(of_algorithm[:, SQUARED_ERROR]), data_range=white - black),
                ssim=_number(_known_mean(of_algorithm[:, SSIM])),
                n_clipped=int(of_algorithm[:, N_CLIPPED].sum()),
                cpu_s=float(of_algorithm[:, CPU_S].sum()),
            )
        )
    return tuple(results)


class _Job:
    """Shows a trial to the observer after each algorithm: the numbers kept of it, shape (algorithm, 16)."""

    def __init__(
        self,
        dataset: Dataset,
        observer: Observer,
        algorithms: tuple[Enhancement, ...],
        decisions: Decisions,
        seed: int,
        screen: Screen,
    ) -> None:
        self.dataset = dataset
        self.observer = observer
        self.algorithms = algorithms
        self.decisions = decisions
        self.seed = seed
        self.screen = screen
        self.reference_luminance = lru_cache(maxsize=16)(self._reference_luminance)

    def __call__(self, trial: Trial) -> FloatArray:
        rng, displacement = trial_draws(self.observer, trial, self.seed)
        frames = [self._frame(trial, frame, displacement) for frame in trial.frames]
        rows = []
        for number in range(len(self.algorithms)):
            views, measures = zip(*(frame[number] for frame in frames), strict=True)
            contrast = sum((view.contrast for view in views[1:]), views[0].contrast) / len(views)
            view = View(contrast, sum(view.n_negative for view in views))
            own_rng = copy.deepcopy(rng) if self.decisions == "sampled" else rng
            row = scored_view(view, trial, self.observer, self.decisions, own_rng, displacement)
            squared_error, ssim, n_clipped, cpu_s = np.transpose(measures)
            more = _known_mean(squared_error), _known_mean(ssim), n_clipped.sum(), cpu_s.sum()
            rows.append(np.concatenate([row, more]))
        return np.array(rows)

    def _frame(
        self, trial: Trial, frame: FrameReference, displacement: tuple[float, float]
    ) -> list[tuple[View, FloatArray]]:
        """What each algorithm makes of a frame: on the retina, and what is measured of it."""
        check_sha256(self.dataset, frame)
        with FrameFile(self.dataset.frame_path(frame)) as file:
            place = place_grid(self.dataset, trial, file, self.observer, displacement)
            decoded = DecodedFrame(file, self.screen)
        found = []
        try:
            for algorithm in self.algorithms:
                picture = decoded.after(algorithm)
                looked = decoded.looked_at(picture, place, frame.background_luminance_cd_m2)
                view = View(looked.on_retina(place.grid), looked.patch.n_negative)
                measures = *self._likeness(picture, frame), picture.n_clipped, picture.cpu_s
                found.append((view, np.array(measures, dtype=np.float64)))
        except FrameError:
            raise
        except DataError as error:
            raise FrameError(file.path, str(error)) from None
        return found

    def _likeness(self, picture: Picture, frame: FrameReference) -> tuple[float, float]:
        """Squared error and SSIM against the frame without noise; NaN if there is none with as many pixels."""
        path = self.dataset.reference_path(frame)
        if path is None:
            return math.nan, math.nan
        reference = self.reference_luminance(path)
        if picture.values.shape[:2] != reference.shape:
            return math.nan, math.nan
        black, white = self.screen.luminance_range
        return squared_error_and_ssim(picture.luminance(), reference, data_range=white - black)

    def _reference_luminance(self, path: Path) -> FloatArray:
        try:
            return self.screen.display.luminance(read_frame(path).values)
        except FrameError:
            raise
        except DataError as error:
            raise FrameError(path, str(error)) from None


def _compared(scored: Sequence[ScoredDataset], seed: int, fit_settings: FitSettings) -> list[list[Compared]]:
    """Of each algorithm, the reference first: one comparison a group, and one of all if there are several."""
    trials, groups = scored[0].trials, [fit.group for fit in scored[0].fits]
    several = len(groups) > 1
    n_comparisons = (len(scored) - 1) * (len(groups) + several)
    resamples = max(fit_settings.resamples, min(RESAMPLES_PER_COMPARISON * n_comparisons, MAX_RESAMPLES))
    settings = replace(fit_settings, resamples=resamples)
    level = np.array([trial.level for trial in trials])
    p_correct = np.array([one.p_correct for one in scored])
    draws: list[list[RatioDraws]] = []
    for number, group in enumerate(groups):
        these = np.array([trial.group == group for trial in trials])
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, number)))
        fits = [one.fits[number].fit for one in scored]
        draws.append(ratio_draws(level[these], p_correct[:, these], fits, settings=settings, rng=rng))
    ratios = [
        [threshold_ratio([of_group]) for of_group in own] + ([threshold_ratio(own)] if several else [])
        for own in zip(*draws, strict=True)
    ]
    corrected = iter(holm([ratio.p_value for own in ratios for ratio in own]).tolist())
    compared: list[list[Compared]] = [[]]
    for own in ratios:
        p_values = [next(corrected) for _ in own]
        verdicts = [_verdict(ratio, p) for ratio, p in zip(own, p_values, strict=True)]
        if several and {"better", "worse"} <= set(verdicts):
            verdicts[-1] = "mixed"
        elif several and verdicts[-1] == "no difference shown":
            verdicts[-1] = next((found for found in verdicts if found != "no difference shown"), verdicts[-1])
        names = [*groups, None] if several else groups
        compared.append([Compared(*one) for one in zip(names, own, p_values, verdicts, strict=True)])
    return compared


def _verdict(ratio: ThresholdRatio, p_value: float) -> Verdict:
    if p_value >= SIGNIFICANCE:
        return "no difference shown"
    return "better" if ratio.is_lower else "worse"


def _known_mean(values: FloatArray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
