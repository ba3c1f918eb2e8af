"""Import: recordings of a chart, or with a schedule, become a dataset."""

from __future__ import annotations

import json
import math
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from todframes import __version__
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.output import LAST_OF_DATASET, new_folder, remove_others
from todframes.base.reading import WarmUpFrames, check_positive, checked, convert
from todframes.base.safe_text import in_utf8, one_line
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import SIZES_ALIKE, inspect
from todframes.display.display import Display, SignalDisplay, find_display, table_of_display
from todframes.frames.dataset import Dataset, Experiment, load_dataset
from todframes.frames.dataset_files import write_dataset_files
from todframes.importing.chart_source import ChartSource
from todframes.importing.schedule import ScheduleSource, read_schedule
from todframes.importing.trials import FIELD_PLACE, SHAKE_PX, TrialDivision, window_writer
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.rows import Rows
from todframes.jobs.run import resumable_output
from todframes.parameters import (
    MAX_FRAME_MB,
    Angle,
    ColumnName,
    DatasetFolder,
    DisplayName,
    Duration,
    FrameCount,
    FrameLimit,
    Limits,
    NamedTable,
    PathLike,
    Progress,
    Rate,
)
from todframes.recordings.opening import open_recordings
from todframes.recordings.recording import (
    GAP,
    CodeRange,
    Recording,
    RecordingWarning,
    code_range,
    natural_order,
    with_bits,
)
from todframes.results.tables import Column, Table
from todframes.results.wording import warning_text
from todframes.stimulus import level_of

CAUSES: Mapping[str, str] = {"position_scatter": "shake", "turned": "rolled"}
"""Warnings of recordings that explain what the frames of the dataset show."""

DEFAULT_LEVEL = "contrast"

REPORT_FILE = "import.json"

Source = ChartSource | ScheduleSource
"""Search for the clips in recordings: by a chart's markers, or by a schedule."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imported:
    """The dataset that an import has written, in numbers and messages.

    Attributes
    ----------
    path : Path
        The dataset.
    n_frames, n_trials, n_clips : int
        Windows in the dataset, trials, and clips that gave trials.
    notes : tuple of str
        Remarks that need no action.
    warnings : tuple of RecordingWarning
        Warnings about conditions that make results from the dataset less certain: a code, and a sentence.
    """

    path: Path
    n_frames: int
    n_trials: int
    n_clips: int
    notes: tuple[str, ...]
    warnings: tuple[RecordingWarning, ...]
    is_kept: bool = False
    """Whether an earlier run has written it."""

    def summary_table(self) -> Table:
        """Return the part of a table of several imports: a row."""
        codes = ", ".join(dict.fromkeys(warning.code for warning in self.warnings))
        row: dict[str, Any] = {"frames": self.n_frames, "trials": self.n_trials, "clips": self.n_clips}
        row |= {"status": "kept" if self.is_kept else "ok"}
        columns: list[Column | str] = [*row, Column(key="warnings", none="", wraps=True)]
        return Table.of("", "", columns, [row | {"warnings": codes or None}])


@checked
def import_recordings(
    recordings: PathLike | Sequence[PathLike] | Sequence[Recording],
    *,
    out: DatasetFolder,
    chart: NamedTable | None = None,
    schedule: NamedTable | None = None,
    display: DisplayName | Display = "reference_sdr",
    integration_time_s: Duration | float = 0.1,
    steady: bool = False,
    warm_up_frames: FrameCount = 0,
    value_range: Limits | None = None,
    bits: int | None = None,
    frames_per_second: Rate | None = None,
    max_frame_mb: FrameLimit = MAX_FRAME_MB,
    ifov_mrad: Angle | None = None,
    level: ColumnName | None = None,
    restart: bool = False,
    keep_store: bool = False,
    tell: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Imported:
    """Make a dataset from recordings that show a chart of `todframes chart`, or what a schedule says.

    The markers of the chart show which page a frame shows and where its triangles are; windows are cut about them,
    with values untouched. `todframes score` reads the dataset; import.json in it lists what was found.

    Parameters
    ----------
    recordings : path, or sequence of path or of Recording
        Videos, image files and folders of them, camera raw, thermal and NumPy files.

        The return value of `open_recordings` is taken as well.
    out : path
        Folder of the dataset, new or empty.
    chart : path, optional
        chart.toml of the recorded chart; either it or `schedule`.
    schedule : path, optional
        CSV file with what each part of the recordings shows, instead of a chart: columns file, start_s, end_s,
        orientation, size_mrad, the level; x_px, y_px if known.
    display : str or Display
        Display that shows the frames: reference_sdr, reference_linear, srgb_monitor, tod_2001, or a TOML file; all
        are in docs/explanation/displays.md. A SENSOR.toml shows them as `sensor-sim curve` does, with its gain.

        A `Display` is taken as well.
    integration_time_s : float or str
        Time in which the observer averages frames: in s, or with the unit, as in "100 ms"; or all: each clip is
        one trial. Each frame without a time is a trial by itself.
    steady : bool
        Let windows follow the triangle by whole pixels within a trial, against shake that the camera in use does
        not have.
    warm_up_frames : int
        Recorded frames before each run of trials, which are not judged: for filters of several frames.

        They are written in the window of the first frame of the run, and show what was recorded: the page before,
        its transition. So many frames are held in memory.
    value_range : (float, float), optional
        Recorded values that the display shows black and white; needed for temperatures and counts.
    bits : int, optional
        Number of bits of a pixel's value: 14 if the largest value is 16383, also in files of 16; the display shows
        that value white. Default: from the files.
    frames_per_second : float, optional
        Frames in a second, in place of what the files say.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    ifov_mrad : float, optional
        With a schedule: angle of a recorded pixel at the camera in mrad; sizes in the schedule are then angles
        there. Default: they are angles on the display.
    level : str, optional
        With a schedule: column of the stimulus strength. Default: contrast.
    restart : bool
        Begin anew, and forget what an interrupted run has finished.

        Otherwise the windows that it has written are not written again; the recordings are read again from their
        beginning, as the frames of a video follow from those before.
    keep_store : bool
        Keep the list of finished windows after the dataset is complete.
    tell : function of a text, optional
        Called with a remark if an earlier call has written some of the windows.
    progress : function of two ints, optional
        Called with the number of frames of a recording that are done, and of all, None if that is not known.

    Returns
    -------
    Imported

    Raises
    ------
    DataError, FrameError
        If a recording cannot be read, or shows nothing of the chart.
    SettingsError
        If a setting is invalid.
    OutputError
        If `out` cannot be written.
    """
    check_source(chart, schedule, level=level, ifov_mrad=ifov_mrad)
    time_s = checked_time(integration_time_s)
    convert(warm_up_frames, WarmUpFrames, argument.warm_up_frames)
    shown = find_display(display)
    of_signals, is_clipped = shown.of_signals, shown.display.eotf != "linear"
    pitch_mrad = shown.display.pitch_mrad if of_signals is None else of_signals.of_sensor.detector_pitch_mrad
    opened = open_for_import(
        recordings, schedule, level=level, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb
    )
    opened = tuple(with_bits(one, bits) for one in opened)
    reading: dict[str, Any] = {"pitch_mrad": pitch_mrad, "progress": progress, "warm_up_frames": warm_up_frames}
    if schedule is not None:
        reading |= {"ifov_mrad": ifov_mrad, "level": level or DEFAULT_LEVEL}
    source = (
        ScheduleSource(Path(schedule), opened, **reading) if schedule else ChartSource(Path(str(chart)), **reading)
    )
    of_display: Sequence[str] = ()
    if of_signals is None:
        scales = [code_range(one, value_range) for one in opened]
    else:
        scales, *of_display = signal_scales(opened, of_signals, source.level, value_range)
    with (
        resumable_output(new_folder, str(out), restart=restart, keep_store=keep_store, tell=tell) as (
            folder,
            store,
        ),
        _forgotten_at_fault(store),
        store.of_work(fingerprint(window_writer)) as (kept, add),
    ):
        if kept:
            store.tell(f"{len(kept)} windows are there from an earlier run; going on with the others")
        writer = window_writer(folder, kept, add, clip=is_clipped, of_signals=of_signals)
        is_per_level = of_signals is not None and not of_signals.is_contrast
        division = TrialDivision(source.described, time_s, steady=steady, is_per_level=is_per_level, write=writer)
        for number, (recording, scale) in enumerate(zip(opened, scales, strict=True)):
            rate = recording.frames_per_second
            division.take(source.frames(recording, number), scale, None if rate is None else 1.0 / rate)
        if not division.trials:
            raise DataError(source.why_nothing() or _why_no_trial(division, source, time_s))
        for trial in division.trials:
            trial.correct(source.corrections)
        remove_others(folder, {frame.name for trial in division.trials for frame in trial.frames})
        field_places = source.field_places()
        n_frames = write_dataset_files(
            folder,
            division.rows(
                level=source.level,
                pitch_mrad=pitch_mrad,
                field_places=field_places,
                pixels_per_value=1 if of_signals is None else of_signals.of_sensor.pixels_per_detector,
            ),
            display=table_of_display(shown.display, folder),
            experiment=Experiment(
                level=source.level, group_by=(source.group_by, *(FIELD_PLACE if field_places else ()))
            ),
            comment=f"Imported by todframes {__version__}; {REPORT_FILE} says what was found\n"
            f"Display: {one_line(shown.title)}",
        )
        warnings = (
            *(warning for recording in opened for warning in recording.warnings),
            *source.warnings(),
            *_of_trials(division, source, opened, time_s, steady=steady),
            *_of_design(division, source, field_places),
            *_of_windows(division, is_clipped=is_clipped),
        )
        dataset = load_dataset(folder, max_frame_mb=max_frame_mb)
        warnings += tuple(_of_frames(dataset, {code for code, _ in warnings}))
        imported = Imported(
            path=Path(out),
            n_frames=n_frames,
            n_trials=len(division.trials),
            n_clips=sum(clip.n_trials > 0 for clip in source.clips),
            notes=(
                *source.notes(),
                *of_display,
                *_of_warm_up(division, warm_up_frames),
            ),
            warnings=warnings,
        )
        (folder / REPORT_FILE).write_text(_report(imported, source), encoding="utf-8")
    return imported


def imported_before(folder: Path) -> Imported | None:
    """Return what an earlier import has written into a folder; None if there is no whole dataset of one."""
    try:
        report = json.loads((folder / REPORT_FILE).read_bytes())
        numbers = {name: report[name] for name in ("n_frames", "n_trials", "n_clips")}
        warnings = tuple(RecordingWarning(**warning) for warning in report["warnings"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not (folder / LAST_OF_DATASET).is_file():
        return None
    return Imported(path=folder, **numbers, notes=(), warnings=warnings, is_kept=True)


@contextmanager
def _forgotten_at_fault(store: Rows) -> Iterator[None]:
    """Forget the written windows if the recordings are at fault: the same command would end there again."""
    try:
        yield
    except DataError:
        store.forget()
        raise


def _report(imported: Imported, source: Source) -> str:
    """Return what was found, as JSON."""
    report: dict[str, Any] = {"version": __version__}
    report |= {name: getattr(imported, name) for name in ("n_frames", "n_trials", "n_clips")}
    report |= {"warnings": [warning._asdict() for warning in imported.warnings], "found": source.report()}
    return in_utf8(json.dumps(report, indent=1, ensure_ascii=False) + "\n")


def check_source(
    chart: PathLike | None,
    schedule: PathLike | None,
    *,
    level: str | None = None,
    ifov_mrad: float | None = None,
) -> None:
    """Raise SettingsError unless exactly one of both says what recordings show, or for what a chart determines."""
    if (chart is None) == (schedule is None):
        found = "neither" if chart is None else "both"
        expected = f"expected one of {argument.chart} and {argument.schedule}, which says what is shown"
        raise SettingsError(f"import: found {found}, {expected}")
    for name, value in {argument.level: level, argument.ifov_mrad: ifov_mrad}.items():
        if schedule is None and value is not None:
            raise SettingsError(f"{name}: is given but not used with a chart, which states levels and scale")
    if ifov_mrad is not None:
        check_positive(argument.ifov_mrad, ifov_mrad)


def open_for_import(
    recordings: PathLike | Sequence[PathLike] | Sequence[Recording],
    schedule: PathLike | None = None,
    *,
    level: str | None = None,
    frames_per_second: float | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
) -> tuple[Recording, ...]:
    """Open recordings; with a schedule one by one, so that a row can name an image, and folders by their files.

    Raises DataError or FrameError if a recording cannot be opened, or the schedule cannot be read.
    """
    listed = [recordings] if isinstance(recordings, str | os.PathLike) else list(recordings)
    opened = [one for one in listed if isinstance(one, Recording)]
    paths = [Path(one) for one in listed if not isinstance(one, Recording)]
    if not paths:
        return tuple(opened)
    if schedule is None:
        return (*opened, *open_recordings(paths, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb))
    rows = read_schedule(Path(schedule), level=level or DEFAULT_LEVEL)
    named = {Path(row.file).name for row in rows if row.file is not None}
    for path in paths:
        inside = natural_order(path.iterdir()) if path.is_dir() and path.resolve().name not in named else []
        for one in [file for file in inside if file.name in named] or [path]:
            opened += open_recordings([one], frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    return tuple(opened)


def checked_time(integration_time_s: float | str) -> float | None:
    """Return the integration time in seconds; None for "all"."""
    text = str(integration_time_s).strip()
    if text == "all":
        return None
    number = text.rstrip("ms ")
    try:
        time_s = float(number) * {"": 1.0, "s": 1.0, "ms": 1e-3}[text[len(number) :].strip()]
    except (ValueError, KeyError):
        time_s = math.nan
    if not (math.isfinite(time_s) and time_s > 0):
        raise SettingsError(
            f"{argument.integration_time_s}: found {integration_time_s!r}, expected a time > 0, such as 0.1 s, or "
            "all"
        )
    return time_s


def _why_no_trial(division: TrialDivision, source: Source, time_s: float | None) -> str:
    if division.n_moved:
        return "in every trial the triangle moves farther than a window may; hold the camera still"
    timed = [clip for clip in source.clips if clip.end_s is not None]
    if time_s is None or not timed:
        return "no triangle lies on the frames; expected all of the page in the picture"
    clip = max(timed, key=lambda one: (one.end_s or 0.0) - (one.start_s or 0.0))
    return (
        f"{clip.first_source}: the longest clip goes from {clip.start_s:.3f} to {clip.end_s:.3f} s "
        f"(frames: {clip.n_frames}), shorter than the integration time of {time_s:g} s; record each page longer, "
        f"or give a shorter {argument.integration_time_s}"
    )


def _of_trials(
    division: TrialDivision, source: Source, opened: Sequence[Recording], time_s: float | None, *, steady: bool
) -> Iterator[RecordingWarning]:
    """Yield warnings about parts that the division into trials left out, and about motion within trials."""
    short = [clip for clip in source.clips if clip.n_frames and not clip.n_trials]
    if short and time_s is not None:
        yield RecordingWarning(
            "short_clips",
            f"{len(short)} of {len(source.clips)} clips are shorter than the integration time of {time_s:g} s and "
            f"were left out, the first at {short[0].first_source}",
        )
    if division.n_moved:
        yield RecordingWarning(
            "moved", f"{division.n_moved} trials were left out: the triangle moves farther than a window may"
        )
    if time_s is not None:
        for recording in opened:
            if (rate := recording.frames_per_second) is None:
                yield RecordingWarning(
                    "no_times",
                    f"{recording.path}: has no times, so each frame is a trial of its own; "
                    f"{argument.frames_per_second} or a times.csv in their folder gives them",
                )
            elif (interval_s := 1.0 / rate) > GAP * time_s:
                yield RecordingWarning(
                    "slow_frames",
                    f"{recording.path}: frames are {interval_s:.3g} s apart, more than the integration time of "
                    f"{time_s:g} s, so each is a trial of its own",
                )
    moving = [trial.motion_px for trial in division.trials if trial.motion_px > SHAKE_PX]
    if moving:
        where = "within the windows, although they follow it by whole pixels" if steady else "on the display"
        still = f"; if the camera in use does not shake, take a tripod, or {argument.steady}"
        yield RecordingWarning(
            "shake",
            f"in {len(moving)} of {len(division.trials)} trials the triangle moves {where}, by up to "
            f"{max(moving):.2g} px (rms) within the integration time; the eye sees it blurred, and so does the "
            "observer" + still * (not steady),
        )


def _of_design(
    division: TrialDivision, source: Source, field_places: Mapping[int, Mapping[str, str]]
) -> Iterator[RecordingWarning]:
    """Yield warnings about trials that do not suit one curve: repeats, two magnifications, more of one
    orientation."""
    different: set[int] = set()
    sizes_px: dict[tuple[object, tuple[str, ...]], tuple[float, float]] = {}
    numbers: dict[tuple[object, float], Counter[str]] = defaultdict(Counter)
    for trial in division.trials:
        different.add(hash(tuple(frame.written.sha256 for frame in trial.frames[trial.n_warm_up :])))
        size = trial.stimulus.columns.get(source.group_by)
        place = tuple(field_places.get(trial.clip, {}).values())
        least, most = sizes_px.get((size, place), (math.inf, 0.0))
        sizes_px[size, place] = min(least, *trial.sizes_px), max(most, *trial.sizes_px)
        numbers[size, trial.stimulus.level][trial.orientation.value] += 1
    if n_repeats := len(division.trials) - len(different):
        yield RecordingWarning(
            "repeated_trials",
            f"{n_repeats} of {len(division.trials)} trials repeat another one bit by bit: they add nothing, and "
            "intervals come out too narrow; give each recording once",
        )
    (size, _), (least, most) = max(sizes_px.items(), key=lambda one: one[1][1] / one[1][0])
    if size is not None and most > SIZES_ALIKE * least:
        yield RecordingWarning(
            "sizes_differ",
            f"triangles of {size} mrad are displayed with {least:.3g} to {most:.3g} px, so their "
            "curve mixes cameras, distances or zooms; import these one by one",
        )
    for (size, level), of_orientation in numbers.items():
        (more, n_more), *_, (less, n_less) = [*of_orientation.most_common(), *of_orientation.most_common()[-1:]]
        if n_more > 3.0 * n_less:
            yield RecordingWarning(
                "uneven_orientations",
                f"{source.level} {level:g}{'' if size is None else f' at {size} mrad'} has {n_more} trials of "
                f"{more} and {n_less} of {less}, so one orientation decides; show each page equally long: aim "
                "before the recording, or cut it",
            )


def _of_frames(dataset: Dataset, said: Collection[str]) -> Iterator[RecordingWarning]:
    """Yield what `validate` warns of in the frames, while the camera still stands.

    Differences that the codes in `said` explain are left out.
    """
    for found in frame_warnings(dataset, inspect(dataset, dataset.trials)):
        if CAUSES.get(found.code) not in said:
            yield RecordingWarning(found.code, warning_text(found.group, found.message))


def _of_warm_up(division: TrialDivision, n_frames: int) -> Iterator[str]:
    """Yield the number of trials with fewer frames before them than were asked for."""
    n_short = sum(n_trials for n_before, n_trials in division.n_before.items() if n_before < n_frames)
    if n_short:
        yield (
            f"{n_short} of {len(division.trials)} trials have fewer than {n_frames} frames before them, as a "
            "recording begins there or frames are missing; to compare algorithms that need more, leave these "
            f"trials out ({argument.on_error} skip)"
        )


def _of_windows(division: TrialDivision, *, is_clipped: bool) -> Iterator[RecordingWarning]:
    written = [frame.written for trial in division.trials for frame in trial.frames]
    if n_beyond := sum(window.n_beyond for window in written):
        percent = 100 * n_beyond / sum(window.n_values for window in written)
        done = "and were clipped, as the display does" if is_clipped else "and were kept"
        yield RecordingWarning(
            "beyond_range",
            f"{percent:.3g} % of the values lie beyond black and white {done}; a wider "
            f"{argument.value_range} keeps them",
        )


MOST_FRAMES = 200
"""Largest number of frames of a recording from which its background and noise are taken."""


def film_levels(recording: Recording) -> tuple[float, list[float]]:
    """Measure the background of a recording, the median of its frames, and the noise of single frames, by the
    deviation of the difference of each frame from the last.
    """
    frames = [frame.values.astype(np.float32) for frame in islice(recording.frames(), MOST_FRAMES)]
    noises = [float(np.std(after - before)) / 2.0**0.5 for before, after in pairwise(frames)]
    background = float(np.mean([np.median(frame) for frame in frames]))
    return background, [noise for noise in noises if noise > 0.0]  # others are the same frame twice


def signal_scales(
    recordings: Sequence[Recording], shown: SignalDisplay, level: str, value_range: tuple[float, float] | None
) -> tuple[list[CodeRange], str]:
    """Return the values of each recording for signals of 0 and 1, and a sentence about them.

    A signal of 1 is the background again above the value without light, which is the lower one of `value_range` or
    that of the recording: a contrast of 1. Of other sensors it is what a level of 1 causes, by the NETD and the
    noise of the film. That is the median over pairs of frames, as a page that changes is in few of them.
    SettingsError if the levels are none of the sensor, or a setting is missing; DataError if the film does not
    show its noise or background.
    """
    meaning, gain = level_of(level), shown.of_sensor.gain
    if meaning.quantity != ("contrast" if shown.is_contrast else "delta_t_k"):
        expected = "contrasts" if shown.is_contrast else "temperature differences, such as delta_t_k"
        raise SettingsError(
            f"{argument.display}: found levels in {level}, expected {expected}, as this sensor has; with a "
            f"schedule, {argument.level} names their column"
        )
    backgrounds, noises_of = zip(*map(film_levels, recordings), strict=True)
    if shown.is_contrast:
        blacks = [code_range(recording, value_range).low for recording in recordings]
        for recording, black, background in zip(recordings, blacks, backgrounds, strict=True):
            if background <= black:
                raise DataError(
                    f"{recording.path}: the median is {background:g}, expected more than {black:g}, the value "
                    f"without light; {argument.value_range} LOW:HIGH gives another"
                )
        return [CodeRange(at, at + at - black) for at, black in zip(backgrounds, blacks, strict=True)], (
            f"display: a contrast of 1 is shown with {gain:g}; the background is {backgrounds[0]:.6g}, no light "
            f"{blacks[0]:g}"
        )
    if value_range is not None:
        raise SettingsError(
            f"{argument.value_range}: is given but not used with the display of this sensor, whose gain refers to "
            "the noise of the film"
        )
    if shown.netd_mk is None:
        raise SettingsError(
            f"{argument.display}: [noise]: netd_mk is missing, which turns the noise of the film into kelvins"
        )
    noises = [noise for noises in noises_of for noise in noises]
    if not noises:
        raise DataError(
            f"{recordings[0].path}: found no two frames that differ, expected several of a recording, whose noise "
            f"the gain of the display refers to; any other display takes {argument.value_range}"
        )
    noise = float(np.median(noises))
    per_kelvin = 1000.0 * noise / shown.netd_mk
    return [CodeRange(at, at + meaning.factor * per_kelvin) for at in backgrounds], (
        f"display: a triangle of any ΔT is shown with a contrast of {gain:g}; the background is "
        f"{backgrounds[0]:.6g}, the noise {noise:.4g}; 1 K is {per_kelvin:.4g} by the NETD of {shown.netd_mk:g} mK"
    )
