"""Frames after enhancement: each is decoded once and shown as after each of several algorithms.

A picture after an algorithm is a frame in memory, so that its background and contrast are those of any frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError, SettingsError, argument, of_frame
from todframes.base.reading import check_positive
from todframes.display.display import Display, border_values, check_background
from todframes.enhancement.algorithm import ROUNDING, Enhancement, Image
from todframes.frames.contrast import ContrastPatch, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.files import FULL_SCALE, FrameSource, read_frame
from todframes.frames.memory import ArrayFrame
from todframes.frames.surround import (
    BIWEIGHT,
    LEAST_RING_PX,
    Range,
    TrianglePlace,
    hole_radius_px,
    median,
    surround_window,
)
from todframes.frames.trials import FrameReference, Trial
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.scoring.trial_scores import Placement, TrialPatches, place_grid

BAND_BLOCKS_PER_SIZE, LEAST_BAND_BLOCK_PX = 2, 4
"""Number of square blocks along a triangle's size in which two pictures are compared, and their least side: in
larger ones single bad pixels average out, in smaller ones the edge of a frame stays apart."""


def background_factor(
    before: Callable[[slice, slice], FloatArray],
    after: Callable[[slice, slice], FloatArray],
    triangle: TrianglePlace,
    *,
    rows: Range,
    columns: Range,
    magnification: float = 1.0,
) -> float:
    """Return the factor by which a picture is brighter than another in a band around the triangle. The band is
    that of `surround_window`; in a frame that is large enough, it leaves out what lies next to the frame's edge,
    where filters act otherwise. The factor is the quotient of two means over the same blocks, without those whose
    luminances deviate from it. `before` and `after` return the luminance of rows and columns of the two pictures
    in cd/m²: `after` has `magnification` pixels, along each axis, for one of `before`, in whose pixels the
    triangle and the frame are given. Raises DataError if most of the band has no light.
    """
    block_px = max(int(triangle.size_px / BAND_BLOCKS_PER_SIZE), LEAST_BAND_BLOCK_PX)
    block_px = math.ceil(block_px / min(magnification, 1.0))
    hole = hole_radius_px(triangle.size_px)
    least = 2.0 * (hole + LEAST_RING_PX + block_px)
    inner_rows, inner_columns = (
        (first + block_px, stop - block_px) if stop - first >= least else (first, stop)
        for first, stop in (rows, columns)
    )
    window = surround_window(triangle, rows=inner_rows, columns=inner_columns)
    edges = [
        np.append(np.arange(first, max(stop - block_px, first) + 1, block_px), stop) for first, stop in window
    ]
    y, x = ((edge[1:] + edge[:-1] - 1) / 2.0 for edge in edges)
    away = np.hypot(y[:, None] - triangle.y_px, x - triangle.x_px) - hole
    around = away >= min(block_px / 2.0, float(away.max()))  # in a narrow frame, its corners
    from_first = [edge - first for edge, (first, _) in zip(edges, (rows, columns), strict=True)]
    means_before = _block_means(before, from_first, 1.0)[around]
    means_after = _block_means(after, from_first, magnification)[around]
    check_background(middle := median(means_before))
    factor = median(means_after) / middle
    for _ in range(6):
        apart = np.abs(means_after - factor * means_before)
        limit = BIWEIGHT * max(1.4826 * median(apart), 1e-9 * middle)
        weights = np.square(1.0 - np.square(np.minimum(apart, limit) / limit))
        check_background(mean := float(weights @ means_before / weights.sum()))
        factor = float(weights @ means_after / weights.sum()) / mean
    return factor


def _block_means(
    luminance: Callable[[slice, slice], FloatArray], edges: Sequence[NDArray[np.intp]], scale: float
) -> FloatArray:
    """Return the mean luminance of each block; `edges` are those of rows and of columns, in pixels / `scale`."""
    y, x = (np.floor(scale * edge + 0.5).astype(np.intp) for edge in edges)
    pixels = luminance(slice(y[0], y[-1]), slice(x[0], x[-1]))
    sums = np.add.reduceat(np.add.reduceat(pixels, x[:-1] - x[0], axis=1), y[:-1] - y[0], axis=0)
    return np.asarray(sums / (np.diff(y)[:, None] * np.diff(x)))


EVERY = slice(None)


@dataclass(frozen=True, slots=True)
class AlgorithmDisplay:
    """A display, the code value that algorithms on it see as 1, and whether their results may be clipped.

    `white` is any number > 0 with `eotf = "linear"`, else 1. Without `allow_clipping`, values that the display
    cannot show are errors.
    """

    display: Display
    white: float = 1.0
    allow_clipping: bool = False

    def __post_init__(self) -> None:
        check_positive("white", self.white)
        if self.display.eotf != "linear" and self.white != 1.0:
            raise SettingsError(f'white: found {self.white:g}, expected 1 with eotf = "{self.display.eotf}"')

    @property
    def code_range(self) -> tuple[float, float]:
        """The code values of black and white."""
        table = self.display.lut
        return (0.0, self.white) if table is None else (float(table.code_value[0]), float(table.code_value[-1]))

    @property
    def luminance_range(self) -> tuple[float, float]:
        """The luminances of black and white in cd/m²."""
        if self.display.lut is not None:
            measured = self.display.lut.luminance_cd_m2
            return float(measured.min()), float(measured.max())
        black, white = self.display.luminance(np.array(self.code_range).reshape(2, 1, 1))[:, 0]
        return float(black), float(white)

    @property
    def data_range_cd_m2(self) -> float:
        """The data range of PSNR and SSIM."""
        black, white = self.luminance_range
        return white - black


@dataclass(frozen=True, slots=True, eq=False)
class EnhancedImage:
    """The picture that a display shows of a frame after an algorithm.

    `values`, (rows, columns, channels), are code values of `display`, with `magnification` pixels for one of the
    frame along each axis. `displacement_px` is how far they lie to the right and down, in pixels of the frame.
    `n_clipped` is the number of values beyond the display's range, and `cpu_s` the algorithm's own processor time.
    `still` are pictures before and after an algorithm of clips that show how it changes the background; None:
    frame and picture.
    """

    display: Display
    values: NDArray[np.floating]
    magnification: float = 1.0
    displacement_px: tuple[float, float] = (0.0, 0.0)
    n_clipped: int = 0
    cpu_s: float = 0.0
    still: tuple[EnhancedImage, EnhancedImage] | None = None

    def luminance(self, rows: slice = EVERY, columns: slice = EVERY) -> FloatArray:
        """Compute the luminance of all pixels or of a rectangle, in cd/m², (rows, columns)."""
        return self.display.luminance(self.values[rows, columns])

    def border_luminance(self) -> float:
        """Compute the mean luminance over the outermost ring of pixels, in cd/m²."""
        return float(self.display.luminance(border_values(self.values)[None]).mean())


class DecodedFrame:
    """A frame that several algorithms work on, decoded whole."""

    def __init__(self, file: FrameSource, screen: AlgorithmDisplay) -> None:
        self.screen, self.path, self.header = screen, file.path, file.header
        self.is_integer = file.header.pixel_type in FULL_SCALE
        self.original = EnhancedImage(screen.display, file.read().values)

    @cached_property
    def code_values(self) -> Image:
        """The input of algorithms of code values, with white as 1; two-dimensional if all channels are equal."""
        values, white = self.original.values, self.screen.white
        if self.is_integer and white != 1.0:
            raise DataError(f"white: found {white:g}, expected 1 for integer code values")
        if (mean := float(values.mean())) > white:
            raise DataError(
                f"code values have a mean of {mean:g}, above white ({white:g}); say which code value is white to "
                f"the algorithms ({argument.white})"
            )
        grey = values.shape[2] == 1 or bool((values == values[..., :1]).all())
        image = np.ascontiguousarray(values[..., 0] if grey else values)
        return image if white == 1.0 else image / np.float32(white)

    @cached_property
    def relative_luminance(self) -> Image:
        """The input of algorithms of luminance: float32, (rows, columns), with black as 0 and white as 1."""
        self.code_values  # noqa: B018 - for its checks
        black, white = self.screen.luminance_range
        return ((self.original.luminance() - black) / (white - black)).astype(np.float32)

    def after(self, enhancement: Enhancement) -> EnhancedImage:
        """Return the picture that the display shows after an algorithm."""
        if enhancement.is_reference:
            return self.original
        return self.shown(*enhancement.run(self.input_of(enhancement)), enhancement)

    def input_of(self, enhancement: Enhancement) -> Image:
        """Return the image that an algorithm takes: code values, or relative luminance."""
        return self.relative_luminance if enhancement.declaration.domain == "luminance" else self.code_values

    def shown(self, image: Image, cpu_s: float, enhancement: Enhancement) -> EnhancedImage:
        """Return the picture that the display shows of what an algorithm returned for this frame."""
        of_luminance = enhancement.declaration.domain == "luminance"
        display, n_clipped = self.screen.display, 0
        if self.is_integer or display.eotf != "linear":
            low, high = (0.0, 1.0) if of_luminance else (end / self.screen.white for end in self.screen.code_range)
            image, n_clipped = self._clipped(image, low, high, enhancement)
        values: NDArray[np.floating] = image if image.ndim == 3 else image[..., None]
        if of_luminance:
            black, white = self.screen.luminance_range
            values = black + (white - black) * values.astype(np.float64)
            display = replace(
                display, eotf="linear", white_luminance_cd_m2=1.0, black_luminance_cd_m2=0.0, gamma=None, lut=None
            )
        elif self.screen.white != 1.0:
            values = values * self.screen.white
        how = enhancement.magnification, enhancement.displacement_px
        return EnhancedImage(display, values, *how, n_clipped, cpu_s)

    def _clipped(self, image: Image, low: float, high: float, enhancement: Enhancement) -> tuple[Image, int]:
        smallest, largest = float(image.min()), float(image.max())
        if low <= smallest and largest <= high:
            return image, 0
        n_outside = int(np.count_nonzero((image < low - ROUNDING) | (image > high + ROUNDING)))
        if n_outside and not self.screen.allow_clipping:
            raise DataError(
                f"{enhancement.spec}: {n_outside} of {image.size} values lie beyond {low:g} to {high:g}, from "
                f"{smallest:g} to {largest:g}; expected none, or leave to clip them ({argument.allow_clipping})"
            )
        return np.clip(image, low, high), n_outside

    def looked_at(
        self, picture: EnhancedImage, place: Placement, frame: FrameReference, *, whole: bool
    ) -> tuple[ContrastPatch, float, float, float]:
        """Return the part of a picture that a retina grid touches, or all of it, as contrast. Then come the middle
        of the undisplaced retina, x and y in pixels from the picture's first, and the factor of `_brightening`.
        A background that is given, or lies at the border, gets as much brighter as the triangle's surroundings.
        """
        m = picture.magnification
        begins, triangle = (self.header.first_column, self.header.first_row), place.triangle
        shift = picture.displacement_px
        x_px, y_px, triangle_x_px, triangle_y_px = (
            m * (at - first + moved) + (m - 1.0) / 2.0
            for at, first, moved in zip(
                (place.x_px, place.y_px, triangle.x_px, triangle.y_px), 2 * begins, 2 * shift, strict=True
            )
        )
        columns, rows = (
            None
            if whole
            else (math.floor((span[0] - first + moved) * m), math.ceil((span[1] - first + moved) * m))
            for span, first, moved in zip((place.columns, place.rows), begins, shift, strict=True)
        )
        display, edge_factor = picture.display, 1.0
        rule = display.background_luminance_cd_m2
        if picture is not self.original and rule not in ("surround", "frame_mean"):
            around, edge_factor = self._brightening(picture, triangle)
            given = frame.background_luminance_cd_m2 if isinstance(rule, str) else rule
            given = self.original.border_luminance() if rule == "border" else given
            assert given is not None  # the manifest was checked for it
            display = replace(display, background_luminance_cd_m2="column")
            frame = frame._replace(background_luminance_cd_m2=given * around)
        shown = TrianglePlace(triangle_x_px, triangle_y_px, m * triangle.size_px)
        file = ArrayFrame(self.path, picture.values)
        patch = read_contrast(file, display, frame, rows, columns, triangle=shown)
        return patch, x_px, y_px, edge_factor

    def _brightening(self, picture: EnhancedImage, triangle: TrianglePlace) -> tuple[float, float]:
        """Return the factor by which an algorithm changes the luminance around the triangle, and that by which it
        changes the outermost pixels, divided by it."""
        before, after = picture.still or (self.original, picture)
        first_row, first_column = self.header.first_row, self.header.first_column
        height, width = self.original.values.shape[:2]
        with of_frame(self.path):
            around = background_factor(
                before.luminance,
                after.luminance,
                triangle,
                rows=(first_row, first_row + height),
                columns=(first_column, first_column + width),
                magnification=picture.magnification,
            )
        ring = before.border_luminance()
        return around, after.border_luminance() / ring / around if ring > 0.0 else 1.0


MEASUREMENTS = ("squared_error", "ssim", "edge_factor", "n_clipped", "cpu_s")
"""Measurements of a frame after an algorithm. `squared_error`, in (cd/m²)², and `ssim` compare it with the frame
without noise; the others are those of `EnhancedImage` and `looked_at`."""


class TrialReader:
    """Reader of trials that applies several algorithms."""

    def __init__(self, algorithms: Sequence[Enhancement], screen: AlgorithmDisplay) -> None:
        self.algorithms = tuple(algorithms)
        self.screen = screen

    @property
    def _of_clips(self) -> list[Enhancement]:
        return [algorithm for algorithm in self.algorithms if algorithm.declaration.clip]

    def read(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid: RetinaGrid,
        displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
        *,
        whole: bool = False,
    ) -> tuple[list[TrialPatches], FloatArray]:
        """Return the trial as shown after each algorithm, and (algorithm, frame, `MEASUREMENTS`), NaN for what is
        not measured; parameters are those of `read_trial`.
        """
        placed = []
        for frame in trial.frames:
            with dataset.open(frame, verify=True) as file:
                place = place_grid(dataset, trial, frame, file, observer, grid, displacement_samples)
                placed.append((DecodedFrame(file, self.screen), place))
        after_clip: dict[str, list[EnhancedImage]] = {}
        if self._of_clips:
            after_clip = self._after_clips(dataset, trial, [decoded for decoded, _ in placed])
        parts: list[list[tuple[ContrastPatch, float, float]]] = [[] for _ in self.algorithms]
        measured = np.full((len(self.algorithms), len(trial.frames), len(MEASUREMENTS)), np.nan)
        for number, (frame, (decoded, place)) in enumerate(zip(trial.frames, placed, strict=True)):
            reference = self._reference_luminance(dataset, frame)
            with of_frame(decoded.path):
                for k, algorithm in enumerate(self.algorithms):
                    own = after_clip.get(algorithm.spec)
                    picture = decoded.after(algorithm) if own is None else own[number]
                    patch, x_px, y_px, edge_factor = decoded.looked_at(picture, place, frame, whole=whole)
                    parts[k].append((patch, x_px, y_px))
                    errors = (None, None) if reference is None else self._errors(reference, picture)
                    measured[k, number] = *errors, edge_factor, picture.n_clipped, picture.cpu_s
        shown, n_rows = [], placed[0][0].header.height
        for algorithm, of_frames in zip(self.algorithms, parts, strict=True):
            pitch_mrad = self.screen.display.pitch_mrad / algorithm.magnification
            patches, xs, ys = zip(*of_frames, strict=True)
            shown.append(TrialPatches(patches, xs, ys, pitch_mrad, n_rows))
        return shown, measured

    def pictures(self, dataset: Dataset, trial: Trial) -> Iterator[tuple[str, list[EnhancedImage]]]:
        """Yield the picture of a trial's first frame after each algorithm, of all frames after one of clips."""
        frames = trial.frames if self._of_clips else trial.frames[:1]
        decoded = [self.decoded(dataset, frame) for frame in frames]
        for algorithm in self.algorithms:
            if not algorithm.declaration.clip:
                yield algorithm.spec, [decoded[0].after(algorithm)]
        if self._of_clips:
            yield from self._after_clips(dataset, trial, decoded).items()

    def decoded(self, dataset: Dataset, frame: FrameReference) -> DecodedFrame:
        """Return a frame that all algorithms take."""
        with dataset.open(frame, verify=True) as file:
            return DecodedFrame(file, self.screen)

    def _after_clips(
        self, dataset: Dataset, trial: Trial, judged: list[DecodedFrame]
    ) -> dict[str, list[EnhancedImage]]:
        """Return the pictures of a trial's frames after each algorithm of clips, by its text."""
        check_warm_up_there(dataset, trial, self._of_clips)
        decoded = [*(self.decoded(dataset, frame) for frame in trial.warm_up), *judged]
        times_s = [frame.time_s for frame in (*trial.warm_up, *trial.frames) if frame.time_s is not None]
        frame_rate_hz = float(1.0 / np.median(np.diff(times_s))) if len(times_s) > 1 else None
        after = {}
        for algorithm in self._of_clips:
            images: list[Image] = []
            for frame in decoded[len(trial.warm_up) - algorithm.warm_up_frames :]:
                with of_frame(frame.path):
                    images.append(frame.input_of(algorithm))
                if images[-1].shape[:2] != images[0].shape[:2]:
                    raise FrameError(
                        frame.path,
                        f"has {images[-1].shape[1]} × {images[-1].shape[0]} pixels, expected "
                        f"{images[0].shape[1]} × {images[0].shape[0]} as the first frame that "
                        f"{algorithm.spec} takes with it",
                    )
            if any(image.ndim == 3 for image in images):
                images = [
                    np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3))
                    for image in images
                ]
            with of_frame(judged[0].path):
                after[algorithm.spec] = self._after_clip(np.stack(images), judged, algorithm, frame_rate_hz)
        return after

    def _after_clip(
        self, images: Image, judged: list[DecodedFrame], algorithm: Enhancement, frame_rate_hz: float | None
    ) -> list[EnhancedImage]:
        """Return the pictures of the judged frames, the last ones, after an algorithm of clips."""
        indices = np.arange(len(images) - len(judged), len(images))
        after, cpu_s = algorithm.run_clip(images, indices, frame_rate_hz)
        still: list[tuple[EnhancedImage, EnhancedImage] | None] = [None] * len(judged)
        if self.screen.display.background_luminance_cd_m2 not in ("surround", "frame_mean"):
            # Noise differs from frame to frame: how much brighter a frame gets is seen on the mean of all.
            mean = images.mean(axis=0)
            stills, _ = algorithm.run_clip(np.stack([mean] * len(images)), indices, frame_rate_hz)
            before = judged[0].shown(mean, 0.0, algorithm)
            still = [(before, judged[0].shown(image, 0.0, algorithm)) for image in stills]
        return [
            replace(frame.shown(image, cpu_s / len(judged), algorithm), still=pair)
            for frame, image, pair in zip(judged, after, still, strict=True)
        ]

    def _reference_luminance(self, dataset: Dataset, frame: FrameReference) -> FloatArray | None:
        """Return the luminance of the frame without noise; None if there is none."""
        if (path := dataset.reference_path(frame)) is None:
            return None
        with of_frame(path):
            return self.screen.display.luminance(read_frame(path, max_frame_mb=dataset.max_frame_mb).values)

    def _errors(self, reference: FloatArray, picture: EnhancedImage) -> tuple[float | None, float | None]:
        """Compute the mean squared error in (cd/m²)² and the mean structural similarity (SSIM) of a picture to the
        frame without noise; None if that has another size. SSIM, as in Wang et al. 2004, IEEE Trans. Image
        Process. 13, 600, is None for a side of fewer than 11 pixels.
        """
        if picture.values.shape[:2] != reference.shape:
            return None, None
        from skimage.metrics import structural_similarity  # its mean_squared_error loads all of scipy.stats

        luminance, data_range = picture.luminance(), self.screen.data_range_cd_m2
        error = float(np.mean(np.square(reference - luminance)))
        if min(luminance.shape) < 11:  # the side of the Gaussian window, 3.5 standard deviations of 1.5 pixels
            return error, None
        how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        ssim = structural_similarity(reference, luminance, data_range=data_range, **how)
        return error, float(ssim)


def check_warm_up_there(dataset: Dataset, trial: Trial, algorithms: Sequence[Enhancement]) -> None:
    """Raise FrameError if a trial has fewer frames of warm-up than an algorithm needs, or one is missing."""
    needy = max(algorithms, key=lambda algorithm: algorithm.warm_up_frames)
    needed, n_before, clip = needy.warm_up_frames, len(trial.warm_up), trial.frames[0].clip
    if n_before >= needed:
        references = (*trial.warm_up[n_before - needed :], *trial.frames)
        intervals_s = np.diff([frame.time_s for frame in references if frame.time_s is not None])
        if len(intervals_s) and intervals_s.max() > 1.5 * (usual_s := float(np.median(intervals_s))):
            after = references[int(np.argmax(intervals_s)) + 1]
            raise FrameError(
                dataset.frame_path(after),
                f"comes {intervals_s.max():.4g} s after the frame before it in clip {clip!r}, expected "
                f"{usual_s:.4g} s as between the others that {needy.spec} takes: frames are missing",
            )
        return
    if clip is None:
        why = "the manifest names no clip of it; expected the columns clip and time_s"
    else:
        why = (
            f"clip {clip!r} has {n_before} there; leave the first trials of a clip out ({argument.on_error} "
            "skip), or state in the column judged that they are not judged"
        )
    raise FrameError(
        dataset.frame_path(trial.frames[0]),
        f"{needy.spec} takes {needed} frames before trial {trial.name!r}, and {why}",
    )
