"""Pictures of trials after each algorithm of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from todframes.enhancement.compare import AlgorithmResult
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader
from todframes.frames.dataset import Dataset
from todframes.observers.interface import Observer
from todframes.results.data import Example
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import evenly
from todframes.scoring.examples import example_of, nearest_trial
from todframes.scoring.retina_view import retina_image

MOST_GROUPS, MOST_ALGORITHMS = 2, 6


def compare_examples(
    dataset: Dataset, results: Sequence[AlgorithmResult], observer: Observer, screen: AlgorithmDisplay
) -> tuple[Example, ...]:
    """Draw the trial nearest to the reference's threshold in up to two groups, after each of up to six algorithms.

    All pictures of a group have the same white. Raises FrameError if a frame can no longer be used.
    """
    some, reference, examples = results[:MOST_ALGORITHMS], results[0].scored, []
    reader = TrialReader([result.enhancement for result in some], screen)
    for group in evenly([fit for fit in reference.fits if fit.fit.threshold is not None], MOST_GROUPS):
        row = nearest_trial(reference, group)  # all algorithms have the same trials
        trial = reference.trials[row]
        grid, displaced = observer.grid(trial.stimulus), np.nan_to_num(reference.displacement_samples[row])
        dx, dy = displaced.tolist()
        drawings = [
            partial(
                pictures,
                [ExamplePatch(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
                retina_image(shown, grid, (dx, dy)),
                observer=observer,
                stimulus=trial.stimulus,
                pixel_pitch_mrad=shown.pixel_pitch_mrad,
            )
            for shown in reader(dataset, trial, observer, grid, [(dx, dy)], whole=True)
        ]
        white = max(draw()[1][0].scale or 0.0 for draw in drawings)
        for result, draw in zip(some, drawings, strict=True):
            p_correct, spec = float(result.scored.p_correct[row]), result.enhancement.spec
            examples.append(example_of(dataset, trial, p_correct, *draw(white=white), algorithm=spec))
    return tuple(examples)
