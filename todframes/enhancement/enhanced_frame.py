"""Frames after enhancement: each is decoded once and shown as after each of several algorithms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError, SettingsError, argument
from todframes.base.reading import check_positive
from todframes.base.remote import Location
from todframes.display.display import Display
from todframes.enhancement.algorithm import ROUNDING, Enhancement, Image
from todframes.enhancement.image_quality import squared_error_and_ssim
from todframes.enhancement.memory_meter import MemoryMeter
from todframes.frames.contrast import (
    Background,
    ContrastPatch,
    LuminanceFound,
    check_contrast,
    displayed_contrast,
    luminance_at_triangle,
    row_bands,
)
from todframes.frames.dataset import Dataset
from todframes.frames.files import FULL_SCALE, FrameSource, read_frame
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, background_factor, surround_window
from todframes.frames.trials import FrameReference, Trial
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.scoring.retina_view import Placement, Shown, place_grid


@dataclass(frozen=True, slots=True)
class AlgorithmDisplay:
    """A display, the white of the algorithms on it, and whether their results may be clipped.

    Attributes
    ----------
    display : Display
    white : float
        Code value that algorithms see as 1: any number > 0 with `eotf = "linear"`, else 1.
    allow_clipping : bool
        Whether values that the display cannot show are set to the nearest value that it can; otherwise they are
        errors.

    Raises
    ------
    SettingsError
        If `white` is out of range.
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
        """The luminances of black and white in cd/m²; the data range of PSNR and SSIM is their difference."""
        if self.display.lut is not None:
            measured = self.display.lut.luminance_cd_m2
            return float(measured.min()), float(measured.max())
        black, white = self.display.luminance(np.array(self.code_range).reshape(2, 1, 1))[:, 0]
        return float(black), float(white)


@dataclass(frozen=True, slots=True, eq=False)
class EnhancedImage:
    """The picture that a display shows of a frame after an algorithm.

    `values` are code values, shape (rows, columns, channels), or luminance in cd/m², (rows, columns). There are
    `magnification` pixels for one of the frame along each axis. `n_clipped` is the number of values beyond the
    display's range; `cpu_s` is the algorithm's own processor time in seconds, and `memory_mb` the memory that it
    needed, None if it was not measured. `still` are pictures before and after an algorithm of clips that show how
    it changes the background; None: the frame and this picture.
    """

    screen: AlgorithmDisplay
    values: NDArray[np.floating]
    magnification: float = 1.0
    n_clipped: int = 0
    cpu_s: float = 0.0
    memory_mb: float | None = None
    still: tuple[EnhancedImage, EnhancedImage] | None = None

    def luminance(self) -> FloatArray:
        """Compute the luminance in cd/m², shape (rows, columns)."""
        return self.luminance_of(self.values)

    def luminance_of(self, values: NDArray[np.floating]) -> FloatArray:
        """Compute the luminance of a part of `values`, in cd/m²."""
        return _luminance(self.screen.display, values)

    def luminance_at(self, rows: slice, columns: slice) -> FloatArray:
        """Compute the luminance of a rectangle of pixels, in cd/m²."""
        return self.luminance_of(self.values[rows, columns])

    def border_luminance(self) -> float:
        """Compute the mean luminance over the outermost ring of pixels, in cd/m²."""
        sides = (0, slice(1, None)), (-1, slice(None, -1)), (slice(None, -1), 0), (slice(1, None), -1)
        values = self.values
        if min(values.shape[:2]) < 2:
            return float(self.luminance().mean())
        ring = np.concatenate([values[side] for side in sides])[None]
        return float(EnhancedImage(self.screen, ring).luminance().mean())


class Brightening(NamedTuple):
    """Factors by which an algorithm changes the luminance around the triangle and that of the outermost pixels."""

    around: float = 1.0
    ring: float = 1.0


class CroppedImage(NamedTuple):
    """A part of a picture, and the middle of the undisplaced retina on it, in the picture's pixels."""

    patch: ContrastPatch
    x_px: float
    y_px: float
    pixel_pitch_mrad: float
    brightening: Brightening


class DecodedFrame:
    """A frame that several algorithms work on.

    Parameters
    ----------
    file : FrameSource
        The open frame; it is decoded whole.
    screen : AlgorithmDisplay

    Raises
    ------
    FrameError
        If the frame's pixels are damaged or not finite.
    """

    def __init__(self, file: FrameSource, screen: AlgorithmDisplay) -> None:
        self.screen = screen
        frame = file.read()
        self.first_row, self.first_column = frame.first_row, frame.first_column
        self.is_integer = file.header.pixel_type in FULL_SCALE
        self.original = EnhancedImage(screen, frame.values)

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

    def after(self, enhancement: Enhancement, meter: MemoryMeter | None = None) -> EnhancedImage:
        """Return the picture that the display shows after an algorithm, whose memory may be measured.

        Raises
        ------
        DataError
            If the algorithm fails or returns values that the display cannot show.
        """
        if enhancement.is_reference:
            return self.original
        image = self.input_of(enhancement)
        run = partial(enhancement.run, image)
        (found, cpu_s), memory_mb = (run(), None) if meter is None else meter.measured(run)
        return self.shown(found, cpu_s, enhancement, memory_mb)

    def input_of(self, enhancement: Enhancement) -> Image:
        """Return the image that an algorithm takes: code values, or relative luminance."""
        return self.relative_luminance if enhancement.declaration.domain == "luminance" else self.code_values

    def shown(
        self, found: Image, cpu_s: float, enhancement: Enhancement, memory_mb: float | None = None
    ) -> EnhancedImage:
        """Return the picture that the display shows of what an algorithm returned for this frame.

        Raises
        ------
        DataError
            If the display cannot show it.
        """
        of_luminance = enhancement.declaration.domain == "luminance"
        n_clipped = 0
        if self.is_integer or self.screen.display.eotf != "linear":
            low, high = (0.0, 1.0) if of_luminance else (end / self.screen.white for end in self.screen.code_range)
            found, n_clipped = self._clipped(found, low, high, enhancement)
        if of_luminance:
            black, white = self.screen.luminance_range
            values: NDArray[np.floating] = black + (white - black) * found.astype(np.float64)
        else:
            values = found if found.ndim == 3 else found[..., None]
            values = values if self.screen.white == 1.0 else values * self.screen.white
        return EnhancedImage(self.screen, values, enhancement.magnification, n_clipped, cpu_s, memory_mb)

    def _clipped(self, found: Image, low: float, high: float, enhancement: Enhancement) -> tuple[Image, int]:
        smallest, largest = float(found.min()), float(found.max())
        if low <= smallest and largest <= high:
            return found, 0
        n_outside = int(np.count_nonzero((found < low - ROUNDING) | (found > high + ROUNDING)))
        if n_outside and not self.screen.allow_clipping:
            raise DataError(
                f"{enhancement.spec}: {n_outside} of {found.size} values lie beyond {low:g} to {high:g}, from "
                f"{smallest:g} to {largest:g}; expected none, or leave to clip them ({argument.allow_clipping})"
            )
        return np.clip(found, low, high), n_outside

    def crop(
        self,
        picture: EnhancedImage,
        place: Placement,
        given_background_cd_m2: float | None,
        *,
        whole: bool = False,
    ) -> CroppedImage:
        """Return the part of a picture that a retina grid touches, or all of it, as contrast.

        Parameters
        ----------
        picture : EnhancedImage
            The frame after an algorithm.
        place : Placement
            Position of the grid on the frame.
        given_background_cd_m2 : float or None
            Background luminance in the manifest, for the display's rule "column".
        whole : bool
            Return the whole picture.

        Raises
        ------
        DataError
            If the background is not a positive number, or contrast overflows.
        """
        rule, m = self.screen.display.background_luminance_cd_m2, picture.magnification
        y = _Axis.of(picture.values.shape[0], None if whole else place.rows, place.y_px, self.first_row, m)
        x = _Axis.of(picture.values.shape[1], None if whole else place.columns, place.x_px, self.first_column, m)
        part = picture.values[y.used, x.used]
        found = LuminanceFound()
        for values in row_bands(picture.values if rule in ("border", "frame_mean") else part):
            luminance = picture.luminance_of(values)
            found.add(luminance)
            if rule == "frame_mean":
                found.average(luminance)
        background: Background
        brightening = Brightening()
        if rule == "surround":
            background = self._surround(picture, place.triangle)
        elif rule == "frame_mean":
            background = found.sum / found.n_averaged
        else:
            given = given_background_cd_m2 if isinstance(rule, str) else rule
            given = self._border_luminance if rule == "border" else given
            assert given is not None  # the manifest was checked for it
            brightening = self._brightening(picture, place.triangle)
            background = given * brightening.around
        check_contrast(found.largest, background)
        to_contrast = partial(_contrast, self.screen.display, background)
        patch = ContrastPatch(
            part, y.first, x.first, found.n_negative, to_contrast, luminance_at_triangle(background)
        )
        pitch_mrad = self.screen.display.pitch_mrad / m
        return CroppedImage(patch.held(), x.centre_px, y.centre_px, pitch_mrad, brightening)

    def _surround(self, picture: EnhancedImage, triangle: TrianglePlace) -> Surface:
        """Fit the luminance around the triangle in a picture."""
        m = picture.magnification
        y = _Axis.of(picture.values.shape[0], None, triangle.y_px, self.first_row, m)
        x = _Axis.of(picture.values.shape[1], None, triangle.x_px, self.first_column, m)
        there = TrianglePlace(x.centre_px, y.centre_px, m * triangle.size_px)
        rows, columns = ((axis.first, axis.first + axis.used.stop) for axis in (y, x))
        window = surround_window(there, rows=rows, columns=columns)
        sums = SurroundSums(there, window)
        row = window.rows[0]
        part = picture.values[row - y.first : window.rows[1] - y.first]
        for values in row_bands(part[:, window.columns[0] - x.first : window.columns[1] - x.first]):
            sums.add(picture.luminance_of(values), row, window.columns[0])
            row += len(values)
        return sums.surface()

    @cached_property
    def _border_luminance(self) -> float:
        return self.original.border_luminance()

    def _brightening(self, picture: EnhancedImage, triangle: TrianglePlace) -> Brightening:
        """Measure how an algorithm changes the luminance of the background, which a given one follows."""
        if picture is self.original:
            return Brightening()
        before, after = picture.still or (self.original, picture)
        height, width = self.original.values.shape[:2]
        around = background_factor(
            before.luminance_at,
            after.luminance_at,
            triangle,
            rows=(self.first_row, self.first_row + height),
            columns=(self.first_column, self.first_column + width),
            magnification=picture.magnification,
        )
        ring = before.border_luminance()
        return Brightening(around, after.border_luminance() / ring if ring > 0.0 else around)


def _luminance(display: Display, values: NDArray[np.floating]) -> FloatArray:
    """Return the luminance in cd/m² of code values, (rows, columns, channels), or of values that are luminance."""
    return values.astype(np.float64) if values.ndim == 2 else display.luminance(values)


def _contrast(
    display: Display, background: Background, values: NDArray[np.floating], row: int, column: int
) -> FloatArray:
    """Compute the Weber contrast of code values or luminance, as in `_luminance`, the first at (row, column)."""
    return displayed_contrast(_luminance(display, values), background, row, column)


class _Axis(NamedTuple):
    """The pixels of a picture that are used along one axis.

    `used` counts from the picture's first pixel. `first`, the first pixel used, and `centre_px`, the middle of the
    retina, count from the start of pixel 0 of the frame.
    """

    used: slice
    first: int
    centre_px: float

    @classmethod
    def of(cls, length: int, span: tuple[int, int] | None, centre_px: float, begins: int, m: float) -> _Axis:
        """Return the pixels of a picture for a range of the frame's pixels, None for all, and a position on it.

        The picture has `length` pixels, `m` for one of the frame, and begins with the frame's pixel `begins`.
        """
        start, stop = 0, length
        if span is not None:
            start = min(max(math.floor((span[0] - begins) * m), 0), length)
            stop = min(max(math.ceil((span[1] - begins) * m), start), length)
        offset = math.floor(begins * m)
        centre_px = m * centre_px + (m - 1.0) / 2.0 - (begins * m - offset)
        return cls(slice(start, stop), offset + start, centre_px)


class FrameMeasurements(NamedTuple):
    """The measurements of a frame after an algorithm.

    `squared_error`, in (cd/m²)², and `ssim` compare the displayed luminance with the frame without noise; None if
    there is none with as many pixels. `edge_factor` is the factor by which the algorithm changes the luminance of
    the outermost pixels, divided by that around the triangle. `n_clipped` is the number of values beyond the
    display's range; `cpu_s` is the algorithm's own processor time in seconds, and `memory_mb` the memory that it
    needed, None if it was not measured.
    """

    squared_error: float | None
    ssim: float | None
    edge_factor: float
    n_clipped: int
    cpu_s: float
    memory_mb: float | None


class EnhancedTrial(NamedTuple):
    """A trial after an algorithm, and the measurements of each of its frames."""

    shown: Shown
    measured: tuple[FrameMeasurements, ...]


class _PlacedFrame(NamedTuple):
    """A decoded frame of a trial, with its path, its number of rows and the place of the retina on it."""

    reference: FrameReference
    path: Location
    n_rows: int
    place: Placement
    decoded: DecodedFrame


class TrialReader:
    """A `Reader` of trials that applies several algorithms; it returns one `Shown` for each of them.

    Without algorithms of clips, one decoded frame is held at a time; with them, those of a trial and its warm-up.
    """

    def __init__(self, algorithms: Sequence[Enhancement], screen: AlgorithmDisplay) -> None:
        self.algorithms = tuple(algorithms)
        self.screen = screen
        self._meters = {one.spec: MemoryMeter() for one in self.algorithms}
        self.reference_luminance = lru_cache(maxsize=16)(self._reference_luminance)

    def __reduce__(self) -> tuple[type, tuple[tuple[Enhancement, ...], AlgorithmDisplay]]:
        return TrialReader, (self.algorithms, self.screen)

    def __call__(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid: RetinaGrid,
        displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
        *,
        whole: bool = False,
    ) -> list[Shown]:
        """Return the trial as shown after each algorithm."""
        found = self.read(dataset, trial, observer, grid, displacement_samples, whole=whole)
        return [one.shown for one in found]

    def read(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid: RetinaGrid,
        displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
        *,
        whole: bool = False,
    ) -> list[EnhancedTrial]:
        """Return the trial as shown after each algorithm, with measurements; parameters are those of `read_trial`.

        Raises
        ------
        FrameError
            If a frame cannot be used, the triangle does not lie on it, or an algorithm fails with it.
        """
        placed: Iterable[_PlacedFrame] = self._placed(dataset, trial, observer, grid, displacement_samples)
        of_clips = [one for one in self.algorithms if one.declaration.clip]
        after_clip: dict[str, list[EnhancedImage]] = {}
        if of_clips:
            placed = list(placed)
            after_clip = self._after_clips(dataset, trial, [one.decoded for one in placed], of_clips)
        frames, n_rows = [], []
        for number, (frame, path, height, place, decoded) in enumerate(placed):
            looked = []
            try:
                for algorithm in self.algorithms:
                    own = after_clip.get(algorithm.spec)
                    picture = (
                        decoded.after(algorithm, self._meters[algorithm.spec]) if own is None else own[number]
                    )
                    part = decoded.crop(picture, place, frame.background_luminance_cd_m2, whole=whole)
                    looked.append((part, self._measured(dataset, frame, picture, part.brightening)))
            except FrameError:
                raise
            except DataError as error:
                raise FrameError(path, str(error)) from None
            frames.append(looked)
            n_rows.append(height)
        return [_of_trial(of_algorithm, n_rows[0]) for of_algorithm in zip(*frames, strict=True)]

    def pictures(self, dataset: Dataset, trial: Trial) -> Iterator[tuple[str, list[EnhancedImage]]]:
        """Yield the picture of a trial's first frame after each algorithm, and of all frames after one of clips.

        Raises
        ------
        DataError
            If a frame cannot be used, or an algorithm fails with it.
        """
        of_clips = [one for one in self.algorithms if one.declaration.clip]
        decoded = []
        for frame in trial.frames if of_clips else trial.frames[:1]:
            with dataset.open(frame, verify=True) as file:
                decoded.append(DecodedFrame(file, self.screen))
        for one in self.algorithms:
            if not one.declaration.clip:
                yield one.spec, [decoded[0].after(one, self._meters[one.spec])]
        if of_clips:
            yield from self._after_clips(dataset, trial, decoded, of_clips).items()

    def _placed(
        self,
        dataset: Dataset,
        trial: Trial,
        observer: Observer,
        grid: RetinaGrid,
        displacement_samples: Sequence[tuple[float, float]] | FloatArray,
    ) -> Iterator[_PlacedFrame]:
        """Yield the decoded frames of a trial."""
        for frame in trial.frames:
            with dataset.open(frame, verify=True) as file:
                place = place_grid(dataset, trial, frame, file, observer, grid, displacement_samples)
                decoded = DecodedFrame(file, self.screen)
            yield _PlacedFrame(frame, file.path, file.header.height, place, decoded)

    def _after_clips(
        self, dataset: Dataset, trial: Trial, judged: list[DecodedFrame], algorithms: Sequence[Enhancement]
    ) -> dict[str, list[EnhancedImage]]:
        """Return the pictures of a trial's frames after each algorithm of clips, by its text."""
        check_warm_up_there(dataset, trial, algorithms)
        decoded = []
        for frame in trial.warm_up:
            with dataset.open(frame, verify=True) as file:
                decoded.append(DecodedFrame(file, self.screen))
        decoded += judged
        references = (*trial.warm_up, *trial.frames)
        times_s = [frame.time_s for frame in references if frame.time_s is not None]
        frame_rate_hz = float(1.0 / np.median(np.diff(times_s))) if len(times_s) > 1 else None
        found = {}
        for algorithm in algorithms:
            first = len(trial.warm_up) - algorithm.warm_up_frames
            images = []
            for frame, one in zip(references[first:], decoded[first:], strict=True):
                try:
                    images.append(one.input_of(algorithm))
                except DataError as error:
                    raise FrameError(dataset.frame_path(frame), str(error)) from None
                if images[-1].shape[:2] != images[0].shape[:2]:
                    raise FrameError(
                        dataset.frame_path(frame),
                        f"has {images[-1].shape[1]} × {images[-1].shape[0]} pixels, expected "
                        f"{images[0].shape[1]} × {images[0].shape[0]} as the first frame that "
                        f"{algorithm.spec} takes with it",
                    )
            if any(image.ndim == 3 for image in images):
                images = [
                    np.broadcast_to(one if one.ndim == 3 else one[..., None], (*one.shape[:2], 3))
                    for one in images
                ]
            path = dataset.frame_path(trial.frames[0])
            try:
                found[algorithm.spec] = self._after_clip(np.stack(images), judged, algorithm, frame_rate_hz)
            except DataError as error:
                raise FrameError(path, str(error)) from None
        return found

    def _after_clip(
        self, images: Image, judged: list[DecodedFrame], algorithm: Enhancement, frame_rate_hz: float | None
    ) -> list[EnhancedImage]:
        """Return the pictures of the judged frames, the last ones, after an algorithm of clips.

        Noise differs from frame to frame, so a frame before and after an algorithm does not show how much brighter
        that makes it. A clip in which each frame is the mean of all does.
        """
        indices = np.arange(len(images) - len(judged), len(images))
        run = partial(algorithm.run_clip, images, indices, frame_rate_hz)
        (after, cpu_s), memory_mb = self._meters[algorithm.spec].measured(run)
        still: list[tuple[EnhancedImage, EnhancedImage] | None] = [None] * len(judged)
        rule = self.screen.display.background_luminance_cd_m2
        if rule in ("border", "column") or not isinstance(rule, str):
            mean = images.mean(axis=0)
            stills, _ = algorithm.run_clip(np.stack([mean] * len(images)), indices, frame_rate_hz)
            before = judged[0].shown(mean, 0.0, algorithm)
            still = [(before, judged[0].shown(one, 0.0, algorithm)) for one in stills]
        return [
            replace(one.shown(image, cpu_s / len(judged), algorithm, memory_mb), still=pair)
            for one, image, pair in zip(judged, after, still, strict=True)
        ]

    def _measured(
        self, dataset: Dataset, frame: FrameReference, picture: EnhancedImage, brightening: Brightening
    ) -> FrameMeasurements:
        path = dataset.reference_path(frame)
        error = ssim = None
        if path is not None:
            reference = self.reference_luminance(path, dataset.max_frame_mb)
            if picture.values.shape[:2] == reference.shape:
                black, white = self.screen.luminance_range
                error, ssim = squared_error_and_ssim(picture.luminance(), reference, data_range=white - black)
        edge_factor = brightening.ring / brightening.around
        return FrameMeasurements(error, ssim, edge_factor, picture.n_clipped, picture.cpu_s, picture.memory_mb)

    def _reference_luminance(self, path: Path, max_frame_mb: int) -> FloatArray:
        try:
            return self.screen.display.luminance(read_frame(path, max_frame_mb=max_frame_mb).values)
        except FrameError:
            raise
        except DataError as error:
            raise FrameError(path, str(error)) from None


LONGEST_INTERVAL = 1.5
"""Interval between frames of a clip, in the median of those taken together, from which frames are missing."""


def check_warm_up_there(dataset: Dataset, trial: Trial, algorithms: Sequence[Enhancement]) -> None:
    """Raise FrameError if a trial has fewer frames of warm-up than an algorithm needs, or one is missing."""
    needy = max(algorithms, key=lambda one: one.warm_up_frames)
    needed, found, clip = needy.warm_up_frames, len(trial.warm_up), trial.frames[0].clip
    if found >= needed:
        references = (*trial.warm_up[found - needed :], *trial.frames)
        intervals_s = np.diff([frame.time_s for frame in references if frame.time_s is not None])
        if len(intervals_s) and intervals_s.max() > LONGEST_INTERVAL * (usual_s := float(np.median(intervals_s))):
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
            f"clip {clip!r} has {found} there; leave the first trials of a clip out ({argument.on_error} skip), "
            "or state in the column judged that they are not judged"
        )
    raise FrameError(
        dataset.frame_path(trial.frames[0]),
        f"{needy.spec} takes {needed} frames before trial {trial.name!r}, and {why}",
    )


def _of_trial(frames: Sequence[tuple[CroppedImage, FrameMeasurements]], n_rows: int) -> EnhancedTrial:
    """Combine one algorithm's frames into a trial."""
    looked, measured = zip(*frames, strict=True)
    patches, xs, ys, pitches, _ = zip(*looked, strict=True)
    return EnhancedTrial(Shown(patches, xs, ys, pitches[0], n_rows), measured)
