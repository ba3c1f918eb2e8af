"""Load what a call needs: the dataset, its observers with all they ask for, and the warnings about it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast, get_args

import numpy as np
from msgspec.structs import replace as replace_struct
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, FrameError, SettingsError, argument
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import inspect, records
from todframes.display.display import Display
from todframes.frames.contrast import size_in_px
from todframes.frames.dataset import Dataset, dataset_warnings, load_dataset
from todframes.frames.trials import Trial, Trials
from todframes.observers.eye import MRAD_PER_DEG
from todframes.observers.interface import Observer, resolve_observer, settings_json
from todframes.parameters import Gaze, OnError, Progress
from todframes.results.data import DatasetRecord, ResultWarning, group_of
from todframes.scoring.trial_scores import patches_about
from todframes.stimulus import Centre

if TYPE_CHECKING:
    from todframes.parameters import Locate
    from todframes.scoring.score import ScoredDataset


def loaded(dataset: Path | str | Dataset) -> Dataset:
    """Return a dataset, read from its folder unless it is one."""
    return dataset if isinstance(dataset, Dataset) else load_dataset(dataset)


def described_each(
    observer: str | Observer | Sequence[str | Observer], find_background: Callable[[], float]
) -> tuple[list[Observer], list[Json]]:
    """Return observers, several also named as "pyramid,csf", and their settings, each by `resolve_observer`."""
    asked = observer.split(",") if isinstance(observer, str) else observer
    each = [
        resolve_observer(observer, find_background)
        for observer in (asked if isinstance(asked, Sequence) else [asked])
    ]
    if not each:
        raise SettingsError("observer: found none, expected one or several")
    return [found for found, _ in each], [settings for _, settings in each]


def gazes_of(gaze: str | Sequence[Gaze]) -> tuple[Gaze, ...]:
    """Return gazes, several also named as "tracked,fixed"."""
    asked = gaze.split(",") if isinstance(gaze, str) else list(gaze)
    if not asked or len(set(asked)) < len(asked) or not set(asked) <= set(get_args(Gaze)):
        known = get_args(Gaze)
        raise SettingsError(
            f"gaze: found {','.join(map(str, asked))!r}, expected {', '.join(known)} or {','.join(known)}"
        )
    return tuple(cast("list[Gaze]", asked))


def of_observer(name: str, warnings: Iterable[ResultWarning]) -> tuple[ResultWarning, ...]:
    """Return warnings that name the observer that they are about; as they are if it has no name."""
    if not name:
        return tuple(warnings)
    return tuple(replace_struct(warning, message=f"{name}: {warning.message}") for warning in warnings)


def _background_of(data: Dataset) -> float:
    """Return the luminance of a dataset's background in cd/m²: the mean over its groups where frames show it."""
    rule = data.display.background_luminance_cd_m2
    if not isinstance(rule, str):
        return float(rule)
    luminances = [inspection.background_luminance_cd_m2 for inspection in inspect(data, data.trials)]
    if not luminances:
        raise SettingsError("luminance_cd_m2: found background, which no frame shows; expected a number")
    return math.fsum(luminances) / len(luminances)


def in_memory(frames: Iterable[ArrayLike], display: Display | str, **shown: Any) -> Dataset:
    """Return a dataset of frames in memory; see `todframes.score_frames` for the parameters."""
    from todframes.display.display import find_display
    from todframes.frames.memory import memory_dataset

    return memory_dataset(frames, display=find_display(display).display, **shown)


class Opened(NamedTuple):
    """A dataset and the observers that look at it, each with its settings. `locate_mode` is None if triangles are
    not located. `extra_fields` are the positions for the result, and `location_warnings` gives the warnings about
    these once the dataset is scored.
    """

    data: Dataset
    observers: list[Observer]
    settings: list[Json]
    locate_mode: Locate | None
    extra_fields: Json
    location_warnings: Callable[[ScoredDataset], tuple[ResultWarning, ...]]


def opened(
    dataset: Path | str | Dataset,
    observer: str | Observer | Sequence[str | Observer],
    *,
    gaze: Gaze | None,
    locate: Locate | bool,
    on_error: OnError,
    progress: Progress | None,
) -> Opened:
    """Load a dataset, make its observers, and find its positions if asked to."""
    data = loaded(dataset)
    data = dataclasses.replace(data, gaze=gaze or data.gaze)
    observers, each_settings = described_each(observer, lambda: _background_of(data))
    locate_mode: Locate | None = "group" if locate is True else locate or None
    data, extra_fields, warnings = _located(data, observers[0], locate_mode, on_error, progress)
    known = [_knowing_dataset(*pair, data) for pair in zip(observers, each_settings, strict=True)]
    return Opened(
        data, [found for found, _ in known], [own for _, own in known], locate_mode, extra_fields, warnings
    )


def _located(
    data: Dataset, observer: Observer, locate_mode: Locate | None, on_error: OnError, progress: Progress | None
) -> tuple[Dataset, Json, Callable[[ScoredDataset], tuple[ResultWarning, ...]]]:
    if locate_mode is None:
        return data, {}, lambda _: ()
    from todframes.diagnosis.locate import locate_triangles, location_warnings

    if data.trials.has_scenes:
        raise SettingsError(
            f"{argument.locate}: the dataset has scenes, in which texture may look like a triangle; expected it "
            "without, as their places are known"
        )
    skip = on_error == "skip"
    data, locations = locate_triangles(
        data, locate=locate_mode, centre=observer.centre, skip_bad_frames=skip, progress=progress
    )
    located = tuple(
        location._asdict()
        | {"group": group_of(data, location.group), "arrangement": list(location.arrangement.mismatches)}
        for location in locations
    )

    def warnings(scored: ScoredDataset) -> tuple[ResultWarning, ...]:
        thresholds = {fit.group: fit.fit.threshold for fit in scored.fits}
        warned = location_warnings(data, locations, thresholds)
        return tuple(ResultWarning(**warning._asdict()) for warning in warned)

    return data, {"located": located}, warnings


def _knowing_dataset(observer: Observer, settings: Json, data: Dataset) -> tuple[Observer, Json]:
    """Return an observer and its settings with what it asks for: the display, or, for an ideal template, the
    spectrum of the frames.
    """
    on_display = observer.on_display(data.display, lambda: _background_of(data))
    if on_display is not observer:
        observer, settings = on_display, settings | settings_json(on_display)
    own: Any = getattr(observer, "settings", None)
    if settings.get("external_noise_spectrum") != "frames" or own.template != "ideal":
        return observer, settings
    from todframes.scoring.opening import background_spectrum

    spectrum = background_spectrum(data, data.trials, observer.centre)
    observer = type(observer)(dataclasses.replace(own, external_noise_spectrum=spectrum))
    return observer, settings | {"external_noise_spectrum": spectrum}


def inspected(
    data: Dataset, trials: Trials, centre: Centre = "centroid"
) -> tuple[DatasetRecord, tuple[ResultWarning, ...]]:
    """Return a dataset's record with what its frames show, and the warnings about them."""
    inspections = inspect(data, trials, centre=centre)
    warnings = (*dataset_warnings(data, trials), *frame_warnings(data, inspections))
    record = DatasetRecord.of(data, records(data, inspections))
    return record, tuple(ResultWarning(**warning._asdict()) for warning in warnings)


def each_once(*warnings: ResultWarning) -> tuple[ResultWarning, ...]:
    """Return the warnings without those whose code and group an earlier one has."""
    first: dict[tuple[str, tuple[tuple[str, float | str], ...]], ResultWarning] = {}
    for warning in warnings:
        first.setdefault((warning.code, tuple(warning.group.items())), warning)
    return tuple(first.values())


def background_spectrum(dataset: Dataset, trials: Trials, centre: Centre) -> tuple[tuple[float, float], ...]:
    """Measure the spectral density behind the triangles. Returns frequencies in cycles/degree, ascending, and the
    mean density over all directions, in squared contrast × squared degrees, as displayed: pixels are held over
    their area. `centre` is the point of the triangle that lies at the frame's centre where the manifest has no
    position. Raises DataError if no frame can be read, or frames end too near to the triangle.
    """
    weak = trials.select(trials.levels <= np.median(trials.levels))
    chosen = weak.select(np.unique(np.linspace(0, len(weak) - 1, 64).astype(np.intp)))
    sums: dict[int, FloatArray] = {}
    problem: FrameError | DataError | None = None
    for trial in chosen:
        try:
            frequency, density = _periodogram(dataset, trial, centre)
        except (FrameError, DataError) as error:  # scoring reports frames that cannot be read
            problem = problem or error
            continue
        bands = np.round(3 * np.log2(frequency)).astype(np.intp)  # a third of an octave
        for band in np.unique(bands).tolist():
            within = bands == band
            total = sums.setdefault(band, np.zeros(3))
            total += density[within].sum(), np.log(frequency[within]).sum(), np.count_nonzero(within)
    if not sums:
        raise problem or DataError(f"{dataset.path}: found no trial, expected some to measure the background in")
    floor = 1e-12 * max(total / n for total, _, n in sums.values())
    return tuple(
        (math.exp(ln_frequency / n), max(float(total / n), floor, 1e-300))
        for _, (total, ln_frequency, n) in sorted(sums.items())
    )


def _periodogram(dataset: Dataset, trial: Trial, centre: Centre) -> tuple[FloatArray, FloatArray]:
    """Compute radial frequencies in cycles/degree and the density at each, of the mean of a trial's frames. Those
    that the window does not resolve, and those beyond the Nyquist frequency of the axes, are left out.
    """
    images: list[FloatArray] = []
    for patch, x_px, y_px in patches_about(dataset, trial, centre, (256, 256)):
        images.append(np.concatenate([band.values for band in patch.bands()]))
        x, y = x_px - patch.column, y_px - patch.row
    contrast = np.asarray(sum(images) / len(images))
    pitch_deg = dataset.display.pitch_mrad / MRAD_PER_DEG
    height, width = contrast.shape
    across, down = np.arange(width), np.arange(height)
    window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    whole = float(np.square(window).sum())
    distance = np.hypot(across - x, down[:, None] - y) / size_in_px(trial, dataset.display.pitch_mrad)
    # The triangle's corners lie at 0.88 sizes.
    inner, outer = 1.3, 2.0
    window *= (1.0 - np.cos(np.pi * np.clip((distance - inner) / (outer - inner), 0.0, 1.0))) / 2.0
    weight = float(np.square(window).sum())
    if weight < 0.05 * whole:
        raise DataError(
            f"{trial.frames[0].path}: found {width} × {height} pixels, in which the triangle of "
            f"{trial.stimulus.size_mrad:g} mrad leaves no background to measure; expected "
            f"{math.ceil(2.5 * outer * size_in_px(trial, dataset.display.pitch_mrad))} or more along each side"
        )
    windowed = window * (contrast - (window * contrast).sum() / window.sum())
    # All signs of both frequencies: half a plane holds those of one axis twice as often as those of the other.
    density = np.abs(np.fft.fft2(windowed)) ** 2 * (pitch_deg**2 / weight)
    fx, fy = np.fft.fftfreq(width, pitch_deg), np.fft.fftfreq(height, pitch_deg)[:, None]
    density *= (np.sinc(fx * pitch_deg) * np.sinc(fy * pitch_deg)) ** 2  # pixels are held over their area
    frequency = np.hypot(fx, fy)
    resolved = 1.5 / (min(height, width) * pitch_deg)
    kept = (frequency >= resolved) & (frequency <= 0.5 / pitch_deg)
    return frequency[kept], density[kept]
