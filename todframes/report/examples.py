"""Pictures of a triangle at threshold: the frame as displayed, and the observer's images of it.

The pictures are part of the result, so that a report can be made again without the frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.diagnosis.whole_frames import block_means
from todframes.enhancement.compare import AlgorithmResult
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader
from todframes.frames.contrast import ContrastPatch, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.position import centroid_position, size_in_px
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import Trial
from todframes.observers.interface import Observer
from todframes.report.data import Example, Thumbnail, group_of
from todframes.report.wording import evenly
from todframes.scoring.retina_view import Shown, retina_image, view_trial
from todframes.scoring.score import GroupFit, ScoredDataset
from todframes.stimulus import Stimulus, vertices

MOST_EXAMPLES, MOST_BANDS = 4, 8

PICTURE_REACH_PER_SIZE = 1.5

LEAST_REACH_PX, LEAST_REACH_SAMPLES = 8, 12
"""Least distance from the middle of a picture to its edge, in display pixels and in retina samples; a small
triangle is shown with its surroundings."""

MOST_REACH_PX = 1000
"""Largest distance from the middle to the edge, so that a wrong pitch cannot fill the memory; of a larger triangle
only the middle is shown."""

MOST_WITHOUT = 60
"""Largest number of groups without a threshold whose strongest trial is drawn."""

WHOLE_SIDE_PX = 384
"""Largest side of the picture of a whole frame; a small frame is enlarged by a whole factor."""

OUTLINE_BGR = (0, 128, 255)
"""Colour of the expected triangle's outline: orange."""

DISPLAY_SIDE_PX, RETINA_SIDE_PX = 128, 96
"""Largest sides of pictures of the display and of the retina; larger ones are reduced by a whole factor."""


@runtime_checkable
class ShowsBands(Protocol):
    """An observer that can return its neurons' activity, as images with the same middle as the retina grid."""

    def activity(self, contrast: FloatArray) -> Sequence[FloatArray]:
        """Return the noise-free activity of all neurons for a retina image of shape (side, side)."""


class ExamplePatch(NamedTuple):
    """Part of a frame, and the position of the triangle's centroid in the frame."""

    patch: ContrastPatch
    x_px: float
    y_px: float


def examples(dataset: Dataset, scored: ScoredDataset, observer: Observer) -> tuple[Example, ...]:
    """Draw the trial nearest to threshold of up to `MOST_EXAMPLES` groups, and the strongest where there is none.

    Raises
    ------
    FrameError
        If a frame can no longer be used.
    """
    known = [one for one in scored.fits if one.fit.threshold is not None]
    found = []
    for one in evenly(known, MOST_EXAMPLES):
        place = nearest_trial(scored, one)
        trial = scored.trials[place]
        # The displacement is NaN if the trial was seen at several displacements.
        dx, dy = np.nan_to_num(scored.displacement_samples[place]).tolist()
        width_mrad, drawn = pictures(
            _shown(dataset, trial, observer),
            view_trial(dataset, trial, observer, (dx, dy)).contrast,
            observer=observer,
            stimulus=trial.stimulus,
            pixel_pitch_mrad=dataset.display.pitch_mrad,
        )
        found.append(_example(dataset, trial, float(scored.p_correct[place]), width_mrad, drawn))
    for one in evenly([one for one in scored.fits if one.fit.threshold is None], MOST_WITHOUT):
        trials = scored.trials
        places = trials.indices_of_group(one.group)
        place = int(places[np.argmax(trials.levels[places])])
        trial = scored.trials[place]
        width_mrad, drawn = _whole(dataset, trial, observer)
        found.append(_example(dataset, trial, float(scored.p_correct[place]), width_mrad, drawn))
    return tuple(found)


def _whole(dataset: Dataset, trial: Trial, observer: Observer) -> tuple[float, tuple[Thumbnail]]:
    """Draw the whole frame of a trial with the outline of the expected triangle. Returns its width in mrad, too.

    Grey is proportional to luminance between black and white, which leave out 0.2 % of the pixels each.
    """
    pitch_mrad = dataset.display.pitch_mrad
    total: FloatArray | float = 0.0
    for frame in trial.frames:
        with dataset.open(frame) as file:
            header = file.header
            x, y = centroid_position(trial, header, observer.centre, pitch_mrad)
            patch = read_contrast(file, dataset.display, frame)
        side = max(patch.values.shape[:2])
        block_px = math.ceil(side / WHOLE_SIDE_PX)
        total = total + block_means(patch, block_px) / len(trial.frames)
    contrast = np.asarray(total)
    black, white = np.percentile(contrast, [0.2, 99.8]).tolist()
    white = max(white, black + 1e-3)
    grey = np.rint(255.0 * _srgb(np.clip((contrast - black) / (white - black), 0.0, 1.0))).astype(np.uint8)
    enlarged = max(WHOLE_SIDE_PX // side, 1)
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
    cv2.polylines(image, [points], isClosed=True, color=OUTLINE_BGR, lineType=cv2.LINE_AA, shift=4)
    return header.width * pitch_mrad, (Thumbnail("whole", _png(image), white, black),)


def _example(
    dataset: Dataset,
    trial: Trial,
    p_correct: float,
    width_mrad: float,
    drawn: tuple[Thumbnail, ...],
    algorithm: str | None = None,
) -> Example:
    return Example(
        group=group_of(dataset, trial.group),
        algorithm=algorithm,
        level=dataset.experiment.level,
        strength=trial.level,
        orientation=trial.orientation.value,
        p_correct=p_correct,
        frame=trial.frames[0].path,
        n_frames=len(trial.frames),
        width_mrad=width_mrad,
        pictures=drawn,
    )


def nearest_trial(scored: ScoredDataset, one: GroupFit) -> int:
    """Return the trial's index: level nearest to threshold, and of those P(correct) nearest to the criterion."""
    threshold, criterion = one.fit.threshold, one.fit.p_correct
    assert threshold is not None
    trials = scored.trials
    places = trials.indices_of_group(one.group)
    from_threshold = np.abs(np.log(trials.levels[places] / threshold))
    from_criterion = np.abs(scored.p_correct[places] - criterion)
    return int(places[np.lexsort([from_criterion, from_threshold])[0]])


def _shown(dataset: Dataset, trial: Trial, observer: Observer) -> list[ExamplePatch]:
    """Read the part of each frame of a trial that surrounds the triangle."""
    pitch_mrad = dataset.display.pitch_mrad
    reach_px = _reach_px(observer, trial.stimulus, pitch_mrad)
    found = []
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            x, y = centroid_position(trial, file.header, observer.centre, pitch_mrad)
            rows, columns = ((round(place) - reach_px, round(place) + reach_px + 1) for place in (y, x))
            triangle = TrianglePlace(x, y, size_in_px(trial, pitch_mrad))
            patch = read_contrast(file, dataset.display, frame, rows, columns, triangle=triangle)
            found.append(ExamplePatch(patch, x, y))
    return found


def _reach_px(observer: Observer, stimulus: Stimulus, pixel_pitch_mrad: float) -> int:
    """Return the number of display pixels shown on each side of the triangle's centroid."""
    reach_mrad = max(
        PICTURE_REACH_PER_SIZE * stimulus.size_mrad,
        LEAST_REACH_PX * pixel_pitch_mrad,
        LEAST_REACH_SAMPLES * observer.grid(stimulus).pitch_mrad,
    )
    return math.ceil(min(reach_mrad / pixel_pitch_mrad, MOST_REACH_PX))


def pictures(
    shown: Sequence[ExamplePatch],
    retina: FloatArray,
    *,
    observer: Observer,
    stimulus: Stimulus,
    pixel_pitch_mrad: float,
    white: float | None = None,
) -> tuple[float, tuple[Thumbnail, ...]]:
    """Draw the triangle and its surroundings: display, retina image and bands.

    Parameters
    ----------
    shown : sequence of ExamplePatch
        Contrast of the frames of one trial; the picture is their mean, and background beyond the end of a frame.
    retina : ndarray, shape (side, side)
        Observer's input, in contrast.
    pixel_pitch_mrad : float
        Visual angle of a display pixel, in mrad.
    white : float, optional
        Contrast shown as white. Default: 1, or the largest contrast present. Black is the display's black.

    Returns
    -------
    width_mrad : float
        Visual angle that each picture spans, in mrad.
    pictures : tuple of Thumbnail
        The display's grey is sRGB for the luminance, and its `scale` is the contrast of white. In the others
        mid-grey is 0, and `scale` is the value of white.
    """
    reach_px = _reach_px(observer, stimulus, pixel_pitch_mrad)
    display = np.mean([_crop(one, reach_px) for one in shown], axis=0)
    display = _reduced(display, DISPLAY_SIDE_PX, np.mean)
    white = max(1.0, float(display.max())) if white is None else white
    light = np.clip((1.0 + display) / (1.0 + white), 0.0, 1.0)
    found = [Thumbnail("display", _png(255.0 * _srgb(light)), white)]
    width_mrad = (2 * reach_px + 1) * pixel_pitch_mrad
    reach = min(round(width_mrad / 2.0 / observer.grid(stimulus).pitch_mrad), retina.shape[0] // 2)
    found.append(_signed("retina", _reduced(_about_middle(retina, reach, 1.0), RETINA_SIDE_PX, np.mean)))
    bands = observer.activity(retina) if isinstance(observer, ShowsBands) else ()
    parts = [_about_middle(band, reach, (retina.shape[0] - 1) / max(band.shape[0] - 1, 1)) for band in bands]
    strongest = sorted(range(len(parts)), key=lambda k: -float(np.abs(parts[k]).max()))[:MOST_BANDS]
    found += [_signed(f"band {k}", _reduced(parts[k], RETINA_SIDE_PX, _peak)) for k in sorted(strongest)]
    return width_mrad, tuple(found)


def _crop(shown: ExamplePatch, reach_px: int) -> FloatArray:
    """Return the contrast within `reach_px` of the triangle's centroid, (2 reach + 1)²; 0 beyond the frame."""
    side = 2 * reach_px + 1
    top, left = (round(place) - reach_px for place in (shown.y_px, shown.x_px))
    cropped = np.zeros((side, side))
    for band in shown.patch.bands():
        contrast = band.values
        rows, columns = (
            slice(max(first - start, 0), max(min(first + n - start, side), 0))
            for first, start, n in zip((band.row, band.column), (top, left), contrast.shape, strict=True)
        )
        part = contrast[max(top - band.row, 0) :, max(left - band.column, 0) :]
        cropped[rows, columns] = part[: max(rows.stop - rows.start, 0), : columns.stop - columns.start]
    return cropped


def _about_middle(image: FloatArray, reach: int, step: float) -> FloatArray:
    """Return retina samples within `reach` of the middle, from an image sampled every `step` of them."""
    places = np.floor(np.arange(-reach, reach + 1) / step + 0.5).astype(int)
    rows, columns = (np.clip(places + n // 2, 0, n - 1) for n in image.shape)
    return np.asarray(image[np.ix_(rows, columns)], dtype=np.float64)


def _reduced(image: FloatArray, largest_side: int, summary: Callable[..., FloatArray]) -> FloatArray:
    """Return an image reduced to at most `largest_side`, one pixel a block; a rest at the end is cut off."""
    factor = math.ceil(image.shape[0] / largest_side)
    side = image.shape[0] // factor
    blocks = image[: side * factor, : side * factor].reshape(side, factor, side, factor)
    return np.asarray(summary(blocks.swapaxes(1, 2).reshape(side, side, -1), axis=2))


def _peak(blocks: FloatArray, axis: int) -> FloatArray:
    """Return the value farthest from 0 in each block; the mean of a band-pass image would be about zero."""
    place = np.expand_dims(np.abs(blocks).argmax(axis=axis), axis)
    return np.take_along_axis(blocks, place, axis).squeeze(axis)


def _signed(name: str, image: FloatArray) -> Thumbnail:
    scale = float(np.abs(image).max()) or 1.0
    return Thumbnail(name, _png(128.0 + 127.0 * image / scale), scale)


def _srgb(light: FloatArray) -> FloatArray:
    """Return code values in [0, 1] for relative luminance in [0, 1] (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _png(grey: NDArray[Any]) -> bytes:
    _, coded = cv2.imencode(".png", np.rint(grey).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return bytes(coded.tobytes())


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
                _example(dataset, trial, p_correct, *draw(one, white=white), algorithm=result.enhancement.spec)
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
