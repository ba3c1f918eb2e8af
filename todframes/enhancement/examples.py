"""Pictures of trials after each algorithm of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from todframes.enhancement.compare import AlgorithmResult
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader
from todframes.frames.dataset import Dataset
from todframes.observers.interface import Observer
from todframes.results.data import Example, Thumbnail
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import evenly
from todframes.scoring.examples import example_of, nearest_trial
from todframes.scoring.retina_view import Shown, retina_image
from todframes.stimulus import Stimulus

MOST_GROUPS, MOST_ALGORITHMS = 2, 6


def compare_examples(
    dataset: Dataset, results: Sequence[AlgorithmResult], observer: Observer, screen: AlgorithmDisplay
) -> tuple[Example, ...]:
    """Draw the trial nearest to the reference's threshold in up to two groups, after each of up to six algorithms.

    All pictures of a group have the same white. Raises FrameError if a frame can no longer be used.
    """
    shown_results = results[:MOST_ALGORITHMS]
    reader = TrialReader([one.enhancement for one in shown_results], screen)
    reference = results[0].scored
    found = []
    for group in evenly([one for one in reference.fits if one.fit.threshold is not None], MOST_GROUPS):
        place = nearest_trial(reference, group)
        trial = reference.trials[place]
        dx, dy = np.nan_to_num(reference.displacement_samples[place]).tolist()
        after = reader(dataset, trial, observer, observer.grid(trial.stimulus), [(dx, dy)], whole=True)
        draw = partial(_drawn, (dx, dy), observer, trial.stimulus)
        white = max(draw(one)[1][0].scale or 0.0 for one in after)
        for result, one in zip(shown_results, after, strict=True):
            (here,) = np.flatnonzero(result.scored.trials.numbers == trial.number)
            p_correct = float(result.scored.p_correct[here])
            found.append(
                example_of(dataset, trial, p_correct, *draw(one, white=white), algorithm=result.enhancement.spec)
            )
    return tuple(found)


def _drawn(
    displacement_samples: tuple[float, float],
    observer: Observer,
    stimulus: Stimulus,
    shown: Shown,
    white: float | None = None,
) -> tuple[float, tuple[Thumbnail, ...]]:
    """Draw the display, retina image and bands after one algorithm."""
    return pictures(
        [ExamplePatch(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
        retina_image(shown, observer.grid(stimulus), displacement_samples),
        observer=observer,
        stimulus=stimulus,
        pixel_pitch_mrad=shown.pixel_pitch_mrad,
        white=white,
    )
