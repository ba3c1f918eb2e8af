"""The parts that a scoring leaves out by rule: their bound, and the time that they save."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, argument
from todframes.frames.trials import Trials
from todframes.observers.interface import PYRAMID_LEVELS, OmittedWeights, Readout
from todframes.observers.retina import RetinaGrid
from todframes.scoring.error_budget import Step, decision_change, plan_object
from todframes.scoring.trial_scores import Scoring, score_trial
from todframes.stimulus import Stimulus, coverage

TIMED_TRIALS = 3
"""Number of trials on which the time that is saved is measured."""

P_CORRECT = 0.75
"""Proportion correct of the triangle whose scores are compared, with and without what is left out."""


def explain(scoring: Scoring, trials: Trials) -> tuple[dict[str, Any], ...]:
    """Return what the scoring of some trials leaves out, at their middle stimulus, as written to `result.json`."""
    if scoring.plan == "full":
        return tuple(plan_object([Step("everything", True, f"as {argument.plan} full asks")]))
    stimuli = sorted(trials.stimuli, key=lambda stimulus: stimulus.size_mrad)
    stimulus = stimuli[len(stimuli) // 2]
    readout, rows = scoring.readout(stimulus), dict(trials.by_stimulus())[stimulus]
    timed = trials.select(rows[len(rows) // 2 :][:TIMED_TRIALS])
    seconds, whole = (_seconds(way, timed) for way in (scoring, replace(scoring, plan="full")))
    steps = [
        Step(
            "frame beyond the retina",
            False,
            f"only what the retina touches is decoded; the time is measured on {len(timed)} trials",
            saves_s=max(whole - seconds, 0.0) * len(trials),
        )
    ]
    omitted = None if scoring.decisions == "sampled" else scoring.observer.omitted_bands(stimulus)
    if readout is not None and omitted is not None:
        less = "one level less than full" if scoring.observer.omitted_part == PYRAMID_LEVELS else "left out"
        steps.append(Step(scoring.observer.omitted_part, False, less, _bound(readout, stimulus, omitted)))
    if scoring.decisions == "expected":
        steps.append(Step("noise on neurons", False, "the decision's probability is computed, not drawn"))
    return tuple(plan_object(steps))


def _seconds(scoring: Scoring, trials: Trials) -> float:
    """Return the CPU time of a trial, the least of some, in seconds; 0 if none can be used."""
    readout, times = scoring.readout(trials[0].stimulus), []
    for trial in trials:
        started = time.process_time()
        try:
            score_trial(scoring, trial, readout)
        except FrameError:  # scoring reports it
            continue
        times.append(time.process_time() - started)
    return min(times, default=0.0)


def _bound(readout: Readout, stimulus: Stimulus, omitted: OmittedWeights) -> float:
    """Return the bound on the change of P(correct) of a triangle at threshold by the omitted weights, on an even
    background."""

    def scores(weights: FloatArray, grid: RetinaGrid) -> FloatArray:
        middle = (grid.side - 1) / 2.0
        size_px = stimulus.size_mrad / grid.pitch_mrad
        shape = grid.side, grid.side
        shown = coverage(shape, orientation="up", size_px=size_px, x_px=middle, y_px=middle)
        return np.asarray(stimulus.polarity * weights.reshape(4, -1) @ shown.ravel())

    own = scores(readout.deviations, readout.grid)
    scale = math.sqrt(np.diagonal(readout.noise_covariance).max()) / np.ptp(own)
    contrasts = scale * np.geomspace(1e-2, 1e3, 501)
    p_correct = readout.answer_probabilities(contrasts[:, None] * own)[:, 0]
    change = contrasts[np.argmax(p_correct >= P_CORRECT)] * scores(omitted.deviations, omitted.grid)
    return float(decision_change(change, readout.noise_covariance, omitted.noise_covariance).max())
