"""What a triangle at threshold looks like before and after algorithms, for the report of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from todframes.comparing import AlgorithmResult
from todframes.dataset import Dataset
from todframes.enhanced import Screen
from todframes.enhanced_reading import TrialReader
from todframes.examples import FramePart, nearest_trial, pictures
from todframes.readout import Observer, Stimulus
from todframes.result import evenly
from todframes.viewing import Shown, retina_image

Json = dict[str, Any]

MOST_GROUPS, MOST_ALGORITHMS = 2, 6


def compare_examples(
    dataset: Dataset, results: Sequence[AlgorithmResult], observer: Observer, screen: Screen
) -> list[Json]:
    """The trial nearest to the reference's threshold in two groups, as displayed after each of six algorithms.

    All pictures of a group have one white. Raises FrameError if a frame can no longer be used.
    """
    shown_results = results[:MOST_ALGORITHMS]
    reader = TrialReader([one.enhancement for one in shown_results], screen)
    reference = results[0].scored
    found: list[Json] = []
    for group in evenly([one for one in reference.fits if one.fit.threshold is not None], MOST_GROUPS):
        place = nearest_trial(reference, group)
        trial = reference.trials[place]
        grid_of = partial(observer.grid, trial.stimulus)
        dx, dy = np.nan_to_num(reference.displacement_samples[place]).tolist()
        after = reader(dataset, trial, observer, grid_of, [(dx, dy)], whole=True)
        draw = partial(_drawn, (dx, dy), observer, trial.stimulus)
        white = max(draw(one)["pictures"][0]["scale"] for one in after)
        for result, one in zip(shown_results, after, strict=True):
            (here,) = [k for k, other in enumerate(result.scored.trials) if other.number == trial.number]
            found.append(
                {
                    "group": dict(zip(dataset.experiment.group_by, group.group, strict=True)),
                    "algorithm": result.enhancement.spec,
                    "level": dataset.experiment.level,
                    "strength": trial.level,
                    "orientation": trial.orientation.value,
                    "p_correct": float(result.scored.p_correct[here]),
                    "frame": trial.frames[0].path,
                    "n_frames": len(trial.frames),
                }
                | draw(one, white=white)
            )
    return found


def _drawn(
    displacement_samples: tuple[float, float],
    observer: Observer,
    stimulus: Stimulus,
    shown: Shown,
    white: float | None = None,
) -> Json:
    """What is shown after one algorithm, as pictures."""
    return pictures(
        [FramePart(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
        retina_image(shown, observer.grid(stimulus), displacement_samples),
        observer=observer,
        stimulus=stimulus,
        pixel_pitch_mrad=shown.pixel_pitch_mrad,
        white=white,
    )
