"""A trial's frames, decoded once, as they are shown after each of several algorithms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, FrameReference, Trial
from todframes.enhanced import DecodedFrame, Looked, Picture, Screen
from todframes.enhancement import Enhancement
from todframes.errors import DataError, FrameError
from todframes.frames import FrameFile, read_frame
from todframes.likeness import squared_error_and_ssim
from todframes.placing import place_grid
from todframes.readout import Observer
from todframes.retina import RetinaGrid
from todframes.viewing import Shown, check_sha256

FloatArray = NDArray[np.float64]


class Measured(NamedTuple):
    """What is measured of a frame after an algorithm.

    `squared_error`, in (cd/m²)², and `ssim` are those of the displayed luminance against the frame without noise;
    None if there is none with as many pixels. `n_clipped` values were beyond the display's range; `cpu_s` is the
    algorithm's own running time.
    """

    squared_error: float | None
    ssim: float | None
    n_clipped: int
    cpu_s: float


class EnhancedTrial(NamedTuple):
    """A trial after an algorithm, and what is measured of each of its frames."""

    shown: Shown
    measured: tuple[Measured, ...]


class TrialReader:
    """Reads trials; calling it is reading as a `Reader` does, one way an algorithm."""

    def __init__(self, algorithms: Sequence[Enhancement], screen: Screen) -> None:
        self.algorithms = tuple(algorithms)
        self.screen = screen
        self.reference_luminance = lru_cache(maxsize=16)(self._reference_luminance)

    def __call__(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid_of: Callable[[], RetinaGrid],
        displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
        *,
        whole: bool = False,
    ) -> list[Shown]:
        """What is shown after each algorithm."""
        found = self.read(dataset, trial, observer, grid_of, displacement_samples, whole=whole)
        return [one.shown for one in found]

    def read(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid_of: Callable[[], RetinaGrid],
        displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
        *,
        whole: bool = False,
    ) -> list[EnhancedTrial]:
        """What is shown after each algorithm, and measured; parameters as those of `read_trial`.

        Raises
        ------
        FrameError
            If a frame cannot be used, the triangle does not lie on it, or an algorithm fails with it.
        """
        frames, n_rows = [], []
        for frame in trial.frames:
            check_sha256(dataset, frame)
            with FrameFile(dataset.frame_path(frame)) as file:
                place = place_grid(dataset, trial, file, observer, grid_of, displacement_samples)
                decoded = DecodedFrame(file, self.screen)
            n_rows.append(file.header.height)
            looked = []
            try:
                for algorithm in self.algorithms:
                    picture = decoded.after(algorithm)
                    part = decoded.looked_at(picture, place, frame.background_luminance_cd_m2, whole=whole)
                    looked.append((part, self._measured(dataset, frame, picture)))
            except FrameError:
                raise
            except DataError as error:
                raise FrameError(file.path, str(error)) from None
            frames.append(looked)
        return [_of_trial(of_algorithm, n_rows[0]) for of_algorithm in zip(*frames, strict=True)]

    def _measured(self, dataset: Dataset, frame: FrameReference, picture: Picture) -> Measured:
        path = dataset.reference_path(frame)
        error = ssim = None
        if path is not None:
            reference = self.reference_luminance(path)
            if picture.values.shape[:2] == reference.shape:
                black, white = self.screen.luminance_range
                error, ssim = squared_error_and_ssim(picture.luminance(), reference, data_range=white - black)
        return Measured(error, ssim, picture.n_clipped, picture.cpu_s)

    def _reference_luminance(self, path: Path) -> FloatArray:
        try:
            return self.screen.display.luminance(read_frame(path).values)
        except FrameError:
            raise
        except DataError as error:
            raise FrameError(path, str(error)) from None


def _of_trial(frames: Sequence[tuple[Looked, Measured]], n_rows: int) -> EnhancedTrial:
    """One algorithm's frames as a trial."""
    looked, measured = zip(*frames, strict=True)
    patches, xs, ys, pitches = zip(*looked, strict=True)
    return EnhancedTrial(Shown(patches, xs, ys, pitches[0], n_rows), measured)
