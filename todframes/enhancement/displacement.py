"""Displacement of pictures by algorithms: where a spot that is added to a frame comes out, against where it is.

Networks that enlarge pictures often have another grid than the display. That is no harm to a person, who looks
where the triangle is, so the observer looks there, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError
from todframes.enhancement.algorithm import Enhancement
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, DecodedFrame, TrialReader
from todframes.frames.contrast import centroid_position
from todframes.frames.dataset import Dataset
from todframes.frames.trials import FrameReference, Trial, Trials
from todframes.stimulus import ORIENTATIONS, coverage

MOST_TRIALS = 8
"""Number of trials in which the displacement is measured: evenly spread."""

LEAST_PX, LEAST_ERRORS = 0.1, 5.0
"""Displacements along an axis up to these numbers of pixels, and of standard errors, are none: 0.1 pixels raise
the threshold of a triangle of 4 pixels by 3 %, and filters that follow a scene move the spot by up to 0.08."""

LEAST_LIKENESS, SURE_LIKENESS = 0.8, 0.95
"""Correlations with the spot from which a trial shows the displacement, and how it differs from others: what an
algorithm does far from the spot, as CLAHE in its tiles, is none."""

SPOT_CONTRAST, SPOT_NOISES, SPOT_PX = 0.25, 4.0, 4.0
"""The spot differs from what is behind it by this share of it, and so many standard deviations of the noise; its
size in the coarsest picture."""


class Displacement(NamedTuple):
    """The displacement of an algorithm's pictures to the right and down, in pixels of the frame, and its standard
    deviation over trials along an axis; None where the pictures do not show it.
    """

    px: tuple[float, float] | None
    scatter_px: float | None


def find_displacements(
    algorithms: Sequence[Enhancement], screen: AlgorithmDisplay, dataset: Dataset, trials: Trials
) -> list[Displacement]:
    """Find one displacement for all frames of each algorithm, of which the first is the reference. It is measured
    in trials of the lowest levels; those that cannot be used are left out.
    """
    found: dict[str, list[tuple[float, float, float]]] = {algorithm.spec: [] for algorithm in algorithms}
    screen = replace(screen, allow_clipping=True)
    plain = TrialReader(algorithms, screen)
    size_px = SPOT_PX / min(algorithm.magnification for algorithm in algorithms)
    faint = np.sort(np.argsort(trials.levels, kind="stable")[: max(len(trials) // 4, MOST_TRIALS)])
    for row in faint[np.unique(np.linspace(0, len(faint) - 1, MOST_TRIALS).round().astype(np.intp))].tolist():
        trial = trials[row]
        with suppress(DataError):  # the comparison itself reports what cannot be used
            before = {spec: pictures[-1].luminance() for spec, pictures in plain.pictures(dataset, trial)}
            reader = _SpotReader(algorithms, screen, trial, size_px)
            changes: dict[str, FloatArray] = {}
            for spec, (*_, picture) in reader.pictures(dataset, trial):
                m = picture.magnification
                rows, columns = (slice(round(m * start), round(m * stop)) for start, stop in reader.window)
                changes[spec] = (picture.luminance() - before[spec])[rows, columns]
                if changes[spec].any():
                    found[spec].append(_moved(changes[spec], changes[algorithms[0].spec], m))
    return [_displacement(np.array(found[algorithm.spec]).reshape(-1, 3)) for algorithm in algorithms]


def _displacement(moved: FloatArray) -> Displacement:
    """Return the displacement of an algorithm from those in single trials, x and y, with the spot's likeness."""
    shown, sure = (moved[moved[:, 2] >= least, :2] for least in (LEAST_LIKENESS, SURE_LIKENESS))
    n_needed = max(len(moved) / 2.0, 2.0)
    if len(shown) < n_needed:
        return Displacement(None, None)
    middle = np.median(shown, axis=0)
    # The standard error of a median of normal values, whose spread is robust, too.
    error = 1.2533 * 1.4826 * np.median(np.abs(shown - middle), axis=0) / math.sqrt(len(shown))
    x, y = np.where(np.abs(middle) > np.maximum(LEAST_PX, LEAST_ERRORS * error), middle, 0.0).tolist()
    return Displacement((x, y), float(sure.std(axis=0, ddof=1).max()) if len(sure) >= n_needed else None)


def _moved(change: FloatArray, seen: FloatArray, magnification: float) -> tuple[float, float, float]:
    """Return how far a change of a picture lies to the right of that of the frame, and below it, in pixels of the
    frame, and their correlation. It is the shift with the largest correlation.
    """
    from skimage.registration import phase_cross_correlation

    # What is interpolated, or averaged, lies where it was.
    kind = cv2.INTER_AREA if magnification < 1.0 else cv2.INTER_LINEAR
    there = cv2.resize(seen, change.shape[::-1], interpolation=kind)
    (y, x), rms, _ = phase_cross_correlation(there, change, normalization=None, upsample_factor=100)
    return -float(x) / magnification, -float(y) / magnification, math.sqrt(max(1.0 - float(rms) ** 2, 0.0))


class _SpotReader(TrialReader):
    """Reader of a trial with the same spot in all of its frames, where the triangle is in the mean. `window` has
    the rows and columns about it.
    """

    window: Sequence[tuple[int, int]]

    def __init__(
        self, algorithms: Sequence[Enhancement], screen: AlgorithmDisplay, trial: Trial, size_px: float
    ) -> None:
        super().__init__(algorithms, screen)
        self._trial, self._size_px = trial, size_px

    def decoded(self, dataset: Dataset, frame: FrameReference) -> DecodedFrame:
        """Return a frame with the spot, brighter or darker than what is behind it: where there is more room."""
        decoded, pitch_mrad, size_px = super().decoded(dataset, frame), dataset.display.pitch_mrad, self._size_px
        header, values = decoded.header, decoded.original.values.copy()
        along = centroid_position(self._trial, header, "centroid", pitch_mrad)
        x, y = (at - first for at, first in zip(along, (header.first_column, header.first_row), strict=True))
        reach = math.ceil(3.0 * size_px) + 8
        self.window = (top, bottom), (left, right) = [
            (max(round(at) - reach, 0), min(round(at) + reach + 1, side))
            for at, side in zip((y, x), values.shape, strict=False)
        ]
        near = values[top:bottom, left:right]
        behind = float(np.median(near))
        noise = 1.4826 * float(np.median(np.abs(near - behind)))
        low, high = self.screen.code_range
        amount = math.copysign(SPOT_CONTRAST * abs(behind) + SPOT_NOISES * noise, low + high - 2.0 * behind)
        ends = min(low, float(values.min())), max(high, float(values.max()))
        place: Json = {"size_px": size_px, "x_px": x - left, "y_px": y - top}
        each = [coverage(near.shape[:2], orientation=turned, **place) for turned in ORIENTATIONS]
        near += (amount * np.mean(each, axis=0)[..., None]).astype(values.dtype)
        decoded.original = replace(decoded.original, values=np.clip(values, *ends))
        return decoded
