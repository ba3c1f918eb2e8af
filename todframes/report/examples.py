"""What a triangle at threshold looks like: the frame as displayed, and what the observer makes of it.

The pictures go into the result itself, so that a report can be made again when the frames are gone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np

from todframes._typing import FloatArray
from todframes.enhancement.compare import AlgorithmResult
from todframes.enhancement.enhanced_frame import Screen, TrialReader
from todframes.frames.contrast import Patch, check_sha256, read_contrast
from todframes.frames.dataset import Dataset, Trial
from todframes.frames.position import centroid_position
from todframes.observers.interface import Observer
from todframes.report.data import Example, Thumbnail, group_of
from todframes.report.wording import evenly
from todframes.scoring.retina_view import Shown, retina_image, view_trial
from todframes.scoring.score import GroupFit, ScoredDataset
from todframes.stimulus import Stimulus

MOST_EXAMPLES, MOST_BANDS = 4, 8


REACH_PER_SIZE = 1.5


LEAST_REACH_PX, LEAST_REACH_SAMPLES = 8, 12
"""From the middle to the edge; a small triangle is shown with its surroundings."""


MOST_REACH_PX = 1000
"""Of a larger triangle only the middle is shown, lest a slip in a pitch fills the memory."""


DISPLAY_SIDE_PX, RETINA_SIDE_PX = 128, 96
"""Pictures have this many pixels along a side at most; larger ones are reduced by a whole factor."""


@runtime_checkable
class ShowsBands(Protocol):
    """An observer that can show what it sees, as images whose middles are the retina grid's."""

    def activity(self, contrast: FloatArray) -> Sequence[FloatArray]:
        """Noise-free activity of all neurons for a retina image of shape (side, side)."""


class FramePart(NamedTuple):
    """Part of a frame, and where in the frame the triangle's centroid lies."""

    patch: Patch
    x_px: float
    y_px: float


def examples(dataset: Dataset, scored: ScoredDataset, observer: Observer) -> tuple[Example, ...]:
    """Draw the trial nearest to threshold of each group that has one, of `MOST_EXAMPLES` groups at most.

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
        # Not a number where the trial was seen at several displacements.
        dx, dy = np.nan_to_num(scored.displacement_samples[place]).tolist()
        width_mrad, drawn = pictures(
            _shown(dataset, trial, observer),
            view_trial(dataset, trial, observer, (dx, dy)).contrast,
            observer=observer,
            stimulus=trial.stimulus,
            pixel_pitch_mrad=dataset.display.pitch_mrad,
        )
        found.append(_example(dataset, trial, float(scored.p_correct[place]), width_mrad, drawn))
    return tuple(found)


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
    """The trial: of those at the level nearest to threshold the one with P(correct) nearest to the criterion."""
    threshold, criterion = one.fit.threshold, one.fit.p_correct
    assert threshold is not None
    return min(
        (place for place, trial in enumerate(scored.trials) if trial.group == one.group),
        key=lambda place: (
            abs(math.log(scored.trials[place].level / threshold)),
            abs(scored.p_correct[place] - criterion),
        ),
    )


def _shown(dataset: Dataset, trial: Trial, observer: Observer) -> list[FramePart]:
    """The frames of a trial about the triangle."""
    pitch_mrad = dataset.display.pitch_mrad
    reach_px = _reach_px(observer, trial.stimulus, pitch_mrad)
    found = []
    for frame in trial.frames:
        check_sha256(dataset, frame)
        with dataset.open(frame) as file:
            x, y = centroid_position(trial, file.header, observer.centre, pitch_mrad)
            rows, columns = ((round(place) - reach_px, round(place) + reach_px + 1) for place in (y, x))
            found.append(FramePart(read_contrast(file, dataset.display, frame, rows, columns), x, y))
    return found


def _reach_px(observer: Observer, stimulus: Stimulus, pixel_pitch_mrad: float) -> int:
    """Display pixels shown on each side of the triangle's centroid."""
    reach_mrad = max(
        REACH_PER_SIZE * stimulus.size_mrad,
        LEAST_REACH_PX * pixel_pitch_mrad,
        LEAST_REACH_SAMPLES * observer.grid(stimulus).pitch_mrad,
    )
    return math.ceil(min(reach_mrad / pixel_pitch_mrad, MOST_REACH_PX))


def pictures(
    shown: Sequence[FramePart],
    retina: FloatArray,
    *,
    observer: Observer,
    stimulus: Stimulus,
    pixel_pitch_mrad: float,
    white: float | None = None,
) -> tuple[float, tuple[Thumbnail, ...]]:
    """Draw what surrounds the triangle: display, retina image and bands.

    Parameters
    ----------
    shown : sequence of FramePart
        Contrast of the frames of one trial; the picture is their mean, and background where a frame ends.
    retina : ndarray, shape (side, side)
        What the observer is given, in contrast.
    pixel_pitch_mrad : float
        Visual angle of a display pixel.
    white : float, optional
        Contrast shown white. Default: 1, or the largest there is. The display's black is black.

    Returns
    -------
    width_mrad : float
        Visual angle that all pictures span.
    pictures : tuple of Thumbnail
        The `scale` of the display, whose grey is sRGB for the luminance, is the contrast of white; that of the
        others the value of white where mid-grey is 0.
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


def _crop(shown: FramePart, reach_px: int) -> FloatArray:
    """Contrast within so many pixels of the triangle's centroid; 0 where there is no pixel."""
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
    """Retina samples within `reach` of the middle, from an image whose own samples are `step` of them apart."""
    places = np.floor(np.arange(-reach, reach + 1) / step + 0.5).astype(int)
    rows, columns = (np.clip(places + n // 2, 0, n - 1) for n in image.shape)
    return np.asarray(image[np.ix_(rows, columns)], dtype=np.float64)


def _reduced(image: FloatArray, largest_side: int, summary: Callable[..., FloatArray]) -> FloatArray:
    """One pixel for each block, the smallest blocks that do; what is left over at the end is cut off."""
    factor = math.ceil(image.shape[0] / largest_side)
    side = image.shape[0] // factor
    blocks = image[: side * factor, : side * factor].reshape(side, factor, side, factor)
    return np.asarray(summary(blocks.swapaxes(1, 2).reshape(side, side, -1), axis=2))


def _peak(blocks: FloatArray, axis: int) -> FloatArray:
    """The value farthest from 0: a mean over a band-pass image would be no more than its zero."""
    place = np.expand_dims(np.abs(blocks).argmax(axis=axis), axis)
    return np.take_along_axis(blocks, place, axis).squeeze(axis)


def _signed(name: str, image: FloatArray) -> Thumbnail:
    scale = float(np.abs(image).max()) or 1.0
    return Thumbnail(name, _png(128.0 + 127.0 * image / scale), scale)


def _srgb(light: FloatArray) -> FloatArray:
    """Code values in [0, 1] of relative luminance in [0, 1] (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _png(grey: FloatArray) -> bytes:
    _, coded = cv2.imencode(".png", np.rint(grey).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return bytes(coded.tobytes())


MOST_GROUPS, MOST_ALGORITHMS = 2, 6


def compare_examples(
    dataset: Dataset, results: Sequence[AlgorithmResult], observer: Observer, screen: Screen
) -> tuple[Example, ...]:
    """Draw the trial nearest to the reference's threshold in two groups, after each of six algorithms.

    All pictures of a group have one white. Raises FrameError if a frame can no longer be used.
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
            (here,) = [k for k, other in enumerate(result.scored.trials) if other.number == trial.number]
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
    """Draw what is shown after one algorithm."""
    return pictures(
        [FramePart(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
        retina_image(shown, observer.grid(stimulus), displacement_samples),
        observer=observer,
        stimulus=stimulus,
        pixel_pitch_mrad=shown.pixel_pitch_mrad,
        white=white,
    )
