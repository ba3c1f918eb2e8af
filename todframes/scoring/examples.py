"""Pictures of a triangle at threshold: the frame as displayed, and the observer's images of it.

The pictures are part of the result, so that a report can be made again without the frames.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.diagnosis.whole_frames import block_means
from todframes.frames.contrast import centroid_position, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.trials import Trial
from todframes.observers.interface import Observer
from todframes.results.data import Example, Thumbnail, group_of
from todframes.results.thumbnails import ExamplePatch, pictures, png, reach_px_of, srgb
from todframes.results.wording import subsample
from todframes.scoring.score import GroupFit, ScoredDataset
from todframes.scoring.trial_scores import patches_about, read_trial, retina_image
from todframes.stimulus import vertices


def examples(dataset: Dataset, scored: ScoredDataset, observer: Observer) -> tuple[Example, ...]:
    """Draw the trial nearest to threshold of up to 4 groups, and the strongest of up to 60 where there is none. On
    scenes it is one of each scene of a group, up to 8. Raises FrameError if a frame can no longer be used.
    """
    known = [group for group in scored.fits if group.fit.threshold is not None]
    pitch_mrad, drawn = dataset.display.pitch_mrad, []
    for row in [row for group in subsample(known, 4) for row in _nearest_trials(scored, group)]:
        trial, grid = scored.trials[row], observer.grid(scored.trials[row].stimulus)
        # The displacement is NaN if the trial was seen at several displacements.
        dx, dy = np.nan_to_num(scored.displacement_samples[row]).tolist()
        reach_px = reach_px_of(observer, trial.stimulus, pitch_mrad)
        patches = patches_about(dataset, trial, observer.centre, (reach_px, reach_px + 1))
        width_mrad, images = pictures(
            [ExamplePatch(*patch) for patch in patches],
            retina_image(read_trial(dataset, trial, observer, grid, [(dx, dy)]), grid, (dx, dy)),
            observer=observer,
            stimulus=trial.stimulus,
            pixel_pitch_mrad=pitch_mrad,
        )
        drawn.append(example_of(dataset, trial, float(scored.p_correct[row]), width_mrad, images))
    trials = scored.trials
    for group in subsample([group for group in scored.fits if group.fit.threshold is None], 60):
        rows = trials.indices_of_group(group.group)
        row = int(rows[np.argmax(trials.levels[rows])])
        width_mrad, whole = _whole(dataset, trials[row], observer)
        drawn.append(example_of(dataset, trials[row], float(scored.p_correct[row]), width_mrad, whole))
    return tuple(drawn)


def _whole(dataset: Dataset, trial: Trial, observer: Observer) -> tuple[float, tuple[Thumbnail]]:
    """Draw the whole frame of a trial with the outline of the expected triangle. Returns its width in mrad, too.
    Grey is proportional to luminance between black and white, which leave out 0.2 % of the pixels each. A small
    frame is enlarged by a whole factor.
    """
    pitch_mrad, largest_side_px = dataset.display.pitch_mrad, 384
    total: FloatArray | float = 0.0
    for frame in trial.frames:
        with dataset.open(frame) as file:
            header = file.header
            x, y = centroid_position(trial, header, observer.centre, pitch_mrad, frame)
            patch = read_contrast(file, dataset.display, frame)
        side = max(patch.values.shape[:2])
        block_px = math.ceil(side / largest_side_px)
        total = total + block_means(patch, block_px) / len(trial.frames)
    contrast = np.asarray(total)
    black, white = np.percentile(contrast, [0.2, 99.8]).tolist()
    white = max(white, black + 1e-3)
    grey = np.rint(255.0 * srgb(np.clip((contrast - black) / (white - black), 0.0, 1.0))).astype(np.uint8)
    enlarged = max(largest_side_px // side, 1)
    grey = grey.repeat(enlarged, axis=0).repeat(enlarged, axis=1)
    image = np.ascontiguousarray(grey[..., None].repeat(3, axis=2))
    corners = vertices(
        size=trial.stimulus.size_mrad / pitch_mrad,
        orientation=trial.orientation,
        x=x - patch.column,
        y=y - patch.row,
    )
    # OpenCV takes positions in 1/16 pixels; (0, 0) is the middle of the first pixel.
    drawn = ((corners + 0.5) * enlarged / block_px - 0.5) * 16.0
    points = np.clip(np.rint(drawn), -(2**20), 2**20).astype(np.int32)
    orange = (0, 128, 255)  # as OpenCV orders colours
    cv2.polylines(image, [points], isClosed=True, color=orange, lineType=cv2.LINE_AA, shift=4)
    return header.width * pitch_mrad, (Thumbnail("whole", png(image), white, black),)


def example_of(
    dataset: Dataset,
    trial: Trial,
    p_correct: float,
    width_mrad: float,
    drawn: tuple[Thumbnail, ...],
    condition: str | None = None,
) -> Example:
    """Return the record of a trial's pictures."""
    return Example(
        group=group_of(dataset, trial.group),
        condition=condition,
        level=dataset.experiment.level,
        strength=trial.level,
        orientation=trial.orientation.value,
        p_correct=p_correct,
        frame=trial.frames[0].path,
        n_frames=len(trial.frames),
        scene=None if trial.view is None else " ".join(filter(None, trial.view[:2])),
        width_mrad=width_mrad,
        pictures=drawn,
    )


def _nearest_trials(scored: ScoredDataset, group: GroupFit) -> list[int]:
    """Return the index of the trial nearest to threshold, or on scenes that of each scene."""
    trials = scored.trials
    names = np.array(["" if view is None else view.scene for view in trials.views])[trials.view_codes]
    members = trials.indices_of_group(group.group)
    of_scenes = [members[names[members] == name] for name in dict.fromkeys(names[members].tolist())]
    return [nearest_trial(scored, group, of_scene) for of_scene in subsample(of_scenes, 8)]


def nearest_trial(
    scored: ScoredDataset, group: GroupFit, rows: NDArray[np.intp] | None = None, *, level: float | None = None
) -> int:
    """Return the trial's index: level nearest to the threshold, or to another `level`, and of those P(correct)
    nearest to the criterion. `rows` are the indices to choose from, by default all of the group.
    """
    threshold, trials = level or group.fit.threshold, scored.trials
    assert threshold is not None
    rows = trials.indices_of_group(group.group) if rows is None else rows
    from_threshold = np.abs(np.log(trials.levels[rows] / threshold))
    from_criterion = np.abs(scored.p_correct[rows] - group.fit.p_correct)
    return int(rows[np.lexsort([from_criterion, from_threshold])[0]])
