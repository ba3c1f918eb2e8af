"""The plan of a scoring: the part of the frames and of the retina that each stimulus needs.

The plan is made before a stimulus is scored. A few of its trials are read with a wide field and seen on a coarse
retina. The contribution of the outer field and of the further pyramid bands to their scores gives the bound for
all trials; it includes the noise and the uneven background of the real frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, SettingsError, argument
from todframes.frames.dataset import Dataset
from todframes.frames.position import check_place
from todframes.frames.trials import Trial, Trials
from todframes.observers.interface import PYRAMID_LEVELS, Observer, Readout
from todframes.parameters import PlanName
from todframes.results.wording import plain
from todframes.scoring.error_budget import LEFT_OUT_SHARE, SAFETY, Step, decision_change
from todframes.scoring.retina_view import Reader, Shown, read_trial, retina_image
from todframes.stimulus import ORIENTATIONS, Stimulus, bounding_box_offset

MOST_BAD = 100
"""Number of unusable frames after which the plan of a stimulus leaves nothing out."""


@dataclass(frozen=True, slots=True)
class StimulusPlan:
    """The plan for the trials of one stimulus. `half_width` is the number of retina samples used on each side of
    the middle one; None: the whole grid. `full_observer` states whether further pyramid bands are needed. `bounds`
    has the bound on the change of P(correct) by each stage that is left out. The others are the time that is saved
    and the shares of the frame's rows and of the retina that are used.
    """

    half_width: int | None = None
    full_observer: bool = False
    bounds: Mapping[str, float] = field(default_factory=dict)
    saves_s: float = field(default=0.0, repr=False)
    rows: float = field(default=1.0, repr=False)
    retina: float = field(default=1.0, repr=False)


@dataclass(frozen=True, slots=True)
class ScorePlan:
    """The plan for a dataset: that of each stimulus, whether whole frames are decoded, steps, and pixel pitch."""

    observer: Observer
    stimuli: Mapping[Stimulus, StimulusPlan]
    whole_frames: bool
    steps: tuple[Step, ...]
    pixel_pitch_mrad: float

    def observer_of(self, stimulus: Stimulus) -> Observer:
        """Return the observer for a stimulus: the given one, or its variant with an extra pyramid level."""
        if self.stimuli[stimulus].full_observer:
            return self.observer.with_extra_level()
        return self.observer

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return the readout for a stimulus, no wider than needed; None if the observer is not linear. Raises
        SettingsError if the observer has no grid for this size.
        """
        observer = self.observer_of(stimulus)
        observer.grid(stimulus)  # refuses a stimulus that is too large before its readout is made
        readout = observer.readout(stimulus)
        half_width = self.stimuli[stimulus].half_width
        return readout if readout is None or half_width is None else readout.cropped(half_width)

    def bound(self, stimuli: Iterable[Stimulus]) -> float:
        """Return the bound on the change of P(correct) by all that is left out with these stimuli."""
        return max(math.fsum(self.stimuli[stimulus].bounds.values()) for stimulus in stimuli)


def plan_score(
    dataset: Dataset,
    trials: Sequence[Trial],
    observer: Observer,
    *,
    name: PlanName = "needed",
    tolerance: float = 2e-3,
    expected: bool = True,
    read: Reader | None = None,
) -> ScorePlan:
    """Plan the part of the frames and of the retina needed for thresholds within a relative tolerance. With the
    name "full" nothing is left out, nor if answers are drawn (not `expected`): they need the observer with its
    whole grid. If `read` returns several versions of a trial, the plan covers all of them; by default trials are
    read as they are.
    """
    trials = Trials.of(trials)
    of_stimulus = dict(trials.by_stimulus())
    pitch = dataset.display.pitch_mrad
    if name == "full" or not expected or observer.knows_probabilities:
        plans = {stimulus: StimulusPlan(full_observer=name == "full") for stimulus in of_stimulus}
        if name == "full":
            why = f"as {argument.plan} full asks"
        elif not expected:
            why = "answers are drawn with noise on every neuron"
        else:
            why = "the observer gives probabilities of its answers, no weights of the retina"
        return ScorePlan(observer, plans, name == "full", (Step("everything", True, why),), pitch)
    # The slope dP / d ln level of a psychometric function at its threshold is about 0.5.
    budget = LEFT_OUT_SHARE * tolerance * 0.5 / 2.0
    plans = {}
    for stimulus, members in of_stimulus.items():
        by_level = members[np.argsort(trials.levels[members], kind="stable")]
        plans[stimulus] = _weigh(dataset, trials.select(by_level), observer, budget, read)
    return ScorePlan(observer, plans, False, _steps(list(plans.values()), observer.omitted_part), pitch)


def _weigh(
    dataset: Dataset, trials: Trials, observer: Observer, budget: float, read: Reader | None
) -> StimulusPlan:
    """Plan one stimulus from a few of its trials, which must be in the order of their level."""
    stimulus, whole = trials[0].stimulus, StimulusPlan()
    tried = _tried(trials, observer, dataset.display.pitch_mrad)
    others = range(min(len(trials), MOST_BAD + len(tried)))
    candidates = trials.select(list(dict.fromkeys((*tried, *others)))[: MOST_BAD + len(tried)])
    if not any(_has_place(dataset, trial, observer) for trial in candidates[:MOST_BAD]):
        return whole  # scoring reports the error; the readout may be huge
    try:
        missing = observer.omitted_bands(stimulus)
        widest = missing.grid if missing is not None else observer.grid(stimulus)
        # The contribution of what is left out is about linear in the displacement, so the corners of its range are
        # enough, and one of each opposite pair.
        most = observer.position_jitter_samples * observer.grid(stimulus).pitch_mrad / widest.pitch_mrad
        displaced = most * np.array([[0.0, 0.0], [1.0, 1.0], [1.0, -1.0]])[: 3 if most else 1]
        readout = observer.readout(stimulus)
    except SettingsError:
        return whole  # scoring reports the error
    started = time.perf_counter()
    shown: list[Shown] = []
    n_read = 0
    # Scoring reports frames that cannot be read; here others replace them.
    for trial in candidates:
        with suppress(FrameError):
            if read is None:
                shown.append(read_trial(dataset, trial, observer, widest, displaced))
            else:
                shown += read(dataset, trial, observer, widest, displaced)
            n_read += 1
        if n_read == len(tried):
            break
    reading_s = (time.perf_counter() - started) / len(tried)
    # Without internal noise the smallest difference may decide.
    if not shown or readout is None or not readout.noise_covariance.any():
        return whole
    images = np.array(
        [retina_image(shown_trials, widest, (dx, dy)) for shown_trials in shown for dx, dy in displaced.tolist()]
    )
    weights = readout.deviations if missing is None else missing.kept
    bounds: dict[str, float] = {}
    full = False
    if missing is not None:
        bound = _bound(readout, missing.deviations, images, missing.noise_covariance)
        full = bound > budget
        if full:
            readout = observer.with_extra_level().readout(stimulus)
            assert readout is not None
            weights = weights + missing.deviations
        else:
            bounds["omitted"] = bound
    half_width, bounds["field"] = _half_width(readout, stimulus, widest.pitch_mrad, weights, images, budget)
    kept = readout.grid.side if half_width is None else 2 * half_width + 1
    return StimulusPlan(
        half_width,
        full,
        bounds,
        saves_s=reading_s * len(trials) * (1.0 - kept * readout.grid.pitch_mrad / widest.width_mrad),
        rows=min(kept * readout.grid.pitch_mrad / dataset.display.pitch_mrad / shown[0].frame_rows, 1.0),
        retina=(kept / readout.grid.side) ** 2,
    )


def _has_place(dataset: Dataset, trial: Trial, observer: Observer) -> bool:
    """Return whether a trial's triangle lies on its first frame."""
    with suppress(FrameError):
        check_place(dataset, trial, observer.centre)
        return True
    return False


def _tried(trials: Trials, observer: Observer, pitch_mrad: float) -> list[int]:
    """Return the indices of trials at middle levels and, if positions differ, of those nearest to the frame's
    edges.
    """
    n_tried = min(max(len(trials) // 40, 1), 4)
    first = (len(trials) - n_tried) // 2
    chosen = list(range(first, first + n_tried))
    # Either all positions are known, or an unknown position is the middle of the frame.
    position = trials.positions_px
    placed = np.flatnonzero(~np.isnan(position[:, 0]))
    if len(placed):
        position = position[placed]
    else:
        placed, position = np.arange(len(trials)), np.zeros_like(position)
    if observer.centre == "bounding_box":
        offset = np.array([bounding_box_offset(orientation) for orientation in ORIENTATIONS])
        position += offset[trials.quarter_turns[placed]] * trials[0].stimulus.size_mrad / pitch_mrad
    if np.ptp(position, axis=0).any():
        outwards = [(x, y) for x in (1.0, 0.0, -1.0) for y in (1.0, 0.0, -1.0) if x or y]
        chosen += placed[np.argmax(position @ np.transpose(outwards), axis=0)].tolist()
    return list(dict.fromkeys(chosen))


def _bound(readout: Readout, weights: FloatArray, images: FloatArray, covariance_change: FloatArray) -> float:
    """Return the bound on the change of P(correct) without the scores of some weights, (4, side, side)."""
    scores = np.einsum("kyx,nyx->nk", weights, images, optimize=True)
    return SAFETY * float(decision_change(scores, readout.noise_covariance, covariance_change).max())


def _half_width(
    readout: Readout, stimulus: Stimulus, pitch_mrad: float, weights: FloatArray, images: FloatArray, budget: float
) -> tuple[int | None, float]:
    """Return the half-width of the narrowest field whose bound fits the budget, and the bound. The half-width is
    in retina samples; None: the whole grid. The contribution of the outer field is computed with the readout's
    weights on a grid of the given pitch, which may be coarse: these weights vary slowly there.
    """
    middle = weights.shape[-1] // 2
    for sizes in (1.5, 2.0, 2.5):
        half_width = math.ceil(sizes * stimulus.size_mrad / readout.grid.pitch_mrad) + 2
        if 2 * half_width + 1 >= readout.grid.side:
            break
        inner = math.floor(half_width * readout.grid.pitch_mrad / pitch_mrad)
        outer = weights.copy()
        outer[:, middle - inner : middle + inner + 1, middle - inner : middle + inner + 1] = 0.0
        bound = _bound(readout, outer, images, np.zeros((4, 4)))
        if bound <= budget:
            return half_width, bound
    return None, 0.0


def _steps(plans: Sequence[StimulusPlan], omitted: str) -> tuple[Step, ...]:
    """Summarise the plans of all stimuli: the largest bounds and the sums of the time saved. `omitted` is the name
    of what the observer's readout omits.
    """
    n_narrow = sum(plan.half_width is not None for plan in plans)
    n_thrifty, n = sum(not plan.full_observer for plan in plans), len(plans)
    levels, narrow = (max(plan.bounds.get(stage, 0.0) for plan in plans) for stage in ("omitted", "field"))
    retina = f"{plain(100.0 * float(np.mean([plan.retina for plan in plans])), 2)} % of the retina"
    rows = [100.0 * plan.rows for plan in plans]
    shares = f"{min(rows):.3g} % of" if max(rows) - min(rows) < 0.5 else f"{min(rows):.3g} to {max(rows):.3g} % of"
    saves_s = sum(plan.saves_s for plan in plans)
    less = "one level less than full" if omitted == PYRAMID_LEVELS else "left out"
    return (
        Step("frame rows", min(rows) >= 100.0, f"{shares} a frame's rows are looked at", saves_once_s=saves_s),
        Step(omitted, n_thrifty == 0, f"{less} for {n_thrifty} of {n} stimuli", levels),
        Step("field", n_narrow == 0, f"{retina} for {n_narrow} of {n} stimuli", narrow),
        Step("noise on neurons", False, "the decision's probability is computed, not drawn"),
    )
