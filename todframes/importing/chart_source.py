"""Recordings of a chart: each frame is searched for the chart, and frames that show one page become clips."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.charts.layout import CORNERS, MODULES, Chart, page_of, read_chart
from todframes.diagnosis.findings import MOST_TURN_RAD
from todframes.importing.geometry import Geometry, PlacedTriangle, choose_lens, place_triangle, seen_through
from todframes.importing.markers import MarkerFinder, Sighting
from todframes.importing.trials import (
    FIELD_PLACE,
    OBJECT_SIZE,
    Clip,
    ClipFrame,
    Correction,
    Placed,
    TriangleDescription,
    clean_clips,
    clipped,
    field_reach_px,
    frames_with_those_before,
    window_about,
)
from todframes.parameters import Progress, counted
from todframes.recordings.recording import GAP, Recording, RecordingWarning
from todframes.results.wording import subsample

SIZE_MARGIN = 1.1
"""Factor by which a window is larger than a triangle needs, so that triangles of one size have windows of one
size."""

LARGEST_ROLL_DEGREES = 30.0
"""Largest angle between a triangle and the nearest of the four orientations."""

MOST_ZOOM = 1.03
"""Ratio of the largest picture of the chart to the smallest from which curves mix magnifications."""

MOST_STRETCH = 1.05
"""Stretch from which a triangle is another one; a chart tilted by 18° has it."""

MOST_TRANSITION = 3
"""Frames in a row that a transition of two pages spoils: in more of them, something hides a marker."""

MOST_MISFIT = 0.2
"""Distance of the markers from a flat chart behind a lens, in modules, from which they are not of one chart."""

MOST_SOLVED = 8
"""Frames of a recording, from its beginning to its end, from which its lens is solved."""

FEWEST_PAGE_CHANGES = 3
"""Number of changes to the next page from which the duration of pages is measured."""


@dataclass(slots=True)
class RecordingReport:
    """The content of a recording: numbers of frames, kept or left out for each reason, and its clips.

    `n_without_markers` are frames in which the four markers were not found, or one cannot be read in more than
    `MOST_TRANSITION` frames in a row; `n_transition` those with markers or a share of two pages, `n_camera_page`
    those of a page without triangles. `n_doubled` frames equal the one before and are kept. `n_off_frame` and
    `n_cut` count triangles. `page_duration_s` is the mean time from a page to the next, None if not regular.
    `place_error_px` and `size_error`, relative, are standard errors of the triangles. `lens_unsolved`: the markers
    fit neither a lens nor none. `magnification_range` is the largest picture of the chart over the smallest.
    """

    path: str
    n_frames: int = 0
    n_without_markers: int = 0
    n_transition: int = 0
    n_other_page: int = 0
    n_rolled: int = 0
    n_camera_page: int = 0
    n_doubled: int = 0
    n_off_frame: int = 0
    n_cut: int = 0
    most_markers: int = 0
    frames_per_second: float | None = None
    page_duration_s: float | None = None
    place_error_px: float | None = None
    size_error: float | None = None
    lens: dict[str, object] | None = None
    lens_unsolved: bool = False
    magnification_range: float = 1.0
    other_keys: dict[int, int] = field(default_factory=dict)
    clips: list[dict[str, Any]] = field(default_factory=list)

    def count_unclear(self, n_frames: int) -> None:
        """Count frames in a row whose markers name no page."""
        if n_frames > MOST_TRANSITION:
            self.n_without_markers += n_frames
        else:
            self.n_transition += n_frames

    def worst(self, name: str) -> float:
        """Return the value of a clip that is farthest from 0."""
        return float(max((clip[name] for clip in self.clips), key=abs))


class ChartSource:
    """Source of clips from recordings of a chart; arguments are those of `ScheduleSource`.

    `corrections` of triangles, by their numbers, are known at the end of a recording. Raises SettingsError if the
    chart cannot be read or has no markers.
    """

    def __init__(
        self, path: Path, *, pitch_mrad: float, progress: Progress | None, warm_up_frames: int = 0
    ) -> None:
        self.path = path
        self.chart: Chart = read_chart(path)
        if self.chart.markers is None:
            raise SettingsError(
                f"{path}: a thermal chart has no markers; give {argument.schedule}, and the places found"
            )
        self.level = self.chart.level
        self.group_by = OBJECT_SIZE
        self.clips: list[Clip] = []
        self.reports: list[RecordingReport] = []
        self._markers = self.chart.markers
        self._pitch_mrad = pitch_mrad
        self._progress = progress
        self._warm_up_frames = warm_up_frames
        self.corrections: dict[int, Correction] = {}
        self._n_runs = 0
        self._n_placed = 0
        # By size on the chart: the largest size in the frame, and to where windows reach that hold it.
        self._reaches: dict[float, tuple[int, int]] = {}

    def described(self, page: int, index: int) -> TriangleDescription:
        """Return the description of a triangle of a page."""
        one = self.chart.pages[page].triangles[index]
        columns = {OBJECT_SIZE: repr(one.size_mrad), "page": page}
        return TriangleDescription(abs(one.strength), self.chart.polarity, columns)

    def frames(self, recording: Recording, number: int) -> Iterator[tuple[Clip, ClipFrame]]:  # noqa: ARG002
        """Yield the frames of a recording that show one page, each with its clip.

        Raises FrameError or DataError if a frame cannot be read.
        """
        report = RecordingReport(str(recording.path), frames_per_second=recording.frames_per_second)
        self.reports.append(report)
        finder = MarkerFinder(self._markers.all_centres_mm, self._markers.side_mm)
        film = _Film(recording, finder, report, [], [])
        clips: list[Clip] = []
        for clip, frame in clean_clips(self._looked(film), key=self.chart.key, first_number=self._n_runs + 1):
            if not clips or clip is not clips[-1]:
                clips.append(clip)
            yield clip, frame
        report.n_transition += sum(clip.n_transition for clip in clips)
        self._settle(film)
        shown = [clip for clip in clips if self.chart.pages[clip.page].triangles]
        report.n_camera_page = sum(clip.n_frames for clip in clips) - sum(clip.n_frames for clip in shown)
        report.clips = [asdict(clip) | film.runs[clip.number - self._n_runs - 1].medians() for clip in shown]
        if recording.frames_per_second is not None:
            starts = [
                (run.page, run.start_s)
                for run in film.runs
                if run.start_s is not None and self.chart.pages[run.page].triangles
            ]
            report.page_duration_s = page_duration_s(starts, 1.0 / recording.frames_per_second)
        self.clips += shown
        self._n_runs += len(film.runs)

    def _looked(self, film: _Film) -> Iterator[ClipFrame]:
        recording, finder, report = film.recording, film.finder, film.report
        last: NDArray[np.generic] | None = None
        seen: Sighting | None = None
        n_unclear = 0
        frames = frames_with_those_before(recording, self._warm_up_frames)
        for frame, before in counted(frames, recording.n_frames, self._progress):
            report.n_frames += 1
            if last is not None and np.array_equal(last, frame.values):
                report.n_doubled += 1
            else:
                seen = finder.look(frame.values)
            last = frame.values
            report.most_markers = finder.most_found
            named = None if seen is None else page_of(seen.ids)
            if seen is not None and named is None:
                n_unclear += 1
                continue
            report.count_unclear(n_unclear)
            n_unclear = 0
            page = self._page(named, finder.key, report)
            if page is None or seen is None:
                continue
            placed = self._placed(page, seen.geometry)
            if abs(max((one.roll_degrees for one in placed), key=abs, default=0.0)) > LARGEST_ROLL_DEGREES:
                report.n_rolled += 1
                continue
            if not film.runs or film.runs[-1].page != page:
                film.runs.append(_Run(page, frame.time_s))
            film.charts.append(_SeenChart(film.runs[-1], seen.geometry, seen.corners_px, self._n_placed))
            triangles = zip(self.chart.pages[page].triangles, placed, strict=True)
            parts = tuple(
                self._part(frame.values.shape, seen_there, one.size_mm, report, number)
                for number, (one, seen_there) in enumerate(triangles, self._n_placed)
            )
            self._n_placed += len(placed)
            yield ClipFrame(page, frame.time_s, frame.source, frame.values, parts, seen.modules, before)
        report.count_unclear(n_unclear)

    def _page(
        self, named: tuple[int, int] | None, searched_key: int | None, report: RecordingReport
    ) -> int | None:
        """Return the page that markers name, with a key; None, and count the frame, if it is none of the chart."""
        page, key = named or (None, searched_key)
        if key is not None and key != self.chart.key:
            report.other_keys[key] = report.other_keys.get(key, 0) + 1
        elif page is None:
            report.n_without_markers += 1
        elif page >= len(self.chart.pages):
            report.n_other_page += 1
        else:
            return page
        return None

    def _placed(self, page: int, geometry: Geometry) -> list[PlacedTriangle]:
        return [
            place_triangle(
                geometry, orientation=one.orientation, size_mm=one.size_mm, x_mm=one.x_mm, y_mm=one.y_mm
            )
            for one in self.chart.pages[page].triangles
        ]

    def _settle(self, film: _Film) -> None:
        """Solve the lens of a recording from frames of all of it, and place the triangles through it."""
        corners_mm, shape, report = film.finder.corners_mm, film.recording.shape, film.report
        if not film.charts:
            return
        some = subsample(film.charts, MOST_SOLVED)
        placed = [partial(self._places, chart.run.page) for chart in some]
        choice = choose_lens(corners_mm, [chart.corners_px for chart in some], placed, shape)
        lens = None
        if choice is None:
            report.lens_unsolved = True
        else:
            lens = choice.lens
            report.place_error_px, report.size_error = round(choice.error_px, 6), round(choice.size_error, 8)
            report.lens = None if lens is None else lens.described()
        geometries = seen_through(lens, corners_mm, [chart.corners_px for chart in film.charts])
        misfit_px = median(geometry.residual_px for geometry in geometries) / math.sqrt(2.0)  # along an axis
        scales_px_per_mm = [geometry.scale_px_per_mm(corners_mm.mean(axis=(0, 1))) for geometry in geometries]
        report.magnification_range = round(max(scales_px_per_mm) / min(scales_px_per_mm), 6)
        module_px = scales_px_per_mm[0] * self._markers.side_mm / MODULES
        if misfit_px > MOST_MISFIT * module_px:
            raise DataError(
                f"{report.path}: found the four markers, but {misfit_px:.2g} px off a flat chart behind a lens, "
                "expected less than a fifth of a module; the chart is bent, blurred by motion, or not the one of "
                f"{self.path}; without markers give {argument.schedule}"
            )
        for chart, geometry in zip(film.charts, geometries, strict=True):
            page = chart.run.page
            if lens is not None:
                pairs = zip(self._placed(page, chart.geometry), self._placed(page, geometry), strict=True)
                for number, (was, now) in enumerate(pairs, chart.number):
                    moved = now.x_px - was.x_px, now.y_px - was.y_px
                    self.corrections[number] = Correction(*moved, now.size_px)
            chart.run.measurements.append(self._measured(page, geometry, shape))

    def _places(self, page: int, geometry: Geometry) -> FloatArray:
        """Return the places of a page's triangles, and of those of another page if it has none."""
        if not self.chart.pages[page].triangles:
            page = next(one.number for one in self.chart.pages if one.triangles)
        return np.array([(one.x_px, one.y_px, one.size_px) for one in self._placed(page, geometry)])

    def _measured(self, page: int, geometry: Geometry, shape: tuple[int, int]) -> dict[str, float]:
        middle_mm = self._markers.centres_mm.mean(axis=0)
        triangles = self.chart.pages[page].triangles
        places_mm = np.array([(one.x_mm, one.y_mm) for one in triangles] or [middle_mm])
        jacobians = geometry.jacobians(places_mm)
        (a, b), (c, d) = jacobians[0].tolist()  # right and down in the frame by x and y of the chart
        scale_px_per_mm = math.sqrt(abs(a * d - b * c))
        placed = self._placed(page, geometry)
        x_px, y_px = (placed[0].x_px, placed[0].y_px) if placed else geometry.to_px(middle_mm).tolist()
        middle_px = (np.array(shape[::-1]) - 1.0) / 2.0
        distance_m = self.chart.distance_m
        x_mrad, y_mrad = geometry.direction_mrad(middle_mm, middle_px=middle_px, distance_m=distance_m).tolist()
        return {
            "residual_px": geometry.residual_px,
            "scale_px_per_mm": scale_px_per_mm,
            "turn_degrees": math.degrees(math.atan2(-b, d)),
            "mirrored": float(a * d < b * c),
            "stretch": float(np.linalg.cond(jacobians).max()),
            "roll_degrees": max((triangle.roll_degrees for triangle in placed), key=abs, default=0.0),
            "x_px": x_px,
            "y_px": y_px,
            "object_x_mrad": x_mrad,
            "object_y_mrad": y_mrad,
            "frame_mrad": math.hypot(*shape) / (scale_px_per_mm * self.chart.distance_m),
        }

    def _part(
        self,
        shape: tuple[int, ...],
        triangle: PlacedTriangle,
        size_mm: float,
        report: RecordingReport,
        number: int,
    ) -> Placed | None:
        x_px, y_px, size_px, orientation, _, corners_px = triangle
        held_px, reach_px = self._reaches.get(size_mm, (0, 0))
        if size_px > held_px or size_px * SIZE_MARGIN**2 < held_px:  # else as for all triangles of this size
            held_px = math.ceil(size_px * SIZE_MARGIN)
            reach_px = field_reach_px(held_px, self._pitch_mrad)
            self._reaches[size_mm] = held_px, reach_px
        if (corners_px < -0.5).any() or (corners_px > (shape[1] - 0.5, shape[0] - 0.5)).any():
            report.n_off_frame += 1
            return None
        whole = window_about(x_px, y_px, reach_px)
        window = clipped(whole, shape)
        report.n_cut += window != whole
        held = clipped(window_about(x_px, y_px, reach_px + 16), shape)  # so far a triangle may move within a trial
        return Placed(x_px, y_px, size_px, orientation, window, held, number)

    def field_places(self) -> dict[int, dict[str, str]]:
        """Return the columns `FIELD_PLACE` by the numbers of clips; none if the chart stays at one place."""
        groups: list[list[dict[str, Any]]] = []
        for clip in (clip for report in self.reports for clip in report.clips):
            for group in groups:
                here, there = ([each[name] for name in FIELD_PLACE] for each in (clip, group[0]))
                if math.dist(here, there) < 0.1 * clip["frame_mrad"]:
                    group.append(clip)
                    break
            else:
                groups.append([clip])
        if len(groups) < 2:
            return {}
        means = [{name: f"{fmean(clip[name] for clip in group):.5g}" for name in FIELD_PLACE} for group in groups]
        return {clip["number"]: mean for group, mean in zip(groups, means, strict=True) for clip in group}

    def why_nothing(self) -> str | None:
        """Return why there is no clip at all; None if there are some."""
        if self.clips:
            return None
        names = ", ".join(report.path for report in self.reports[:3]) + (", …" if len(self.reports) > 3 else "")
        n_frames = sum(report.n_frames for report in self.reports)
        if sum(report.n_camera_page for report in self.reports):
            return f"{names}: found the page to measure the camera alone, expected pages with triangles"
        keys = sum((Counter(report.other_keys) for report in self.reports), Counter[int]())
        most = max(report.most_markers for report in self.reports)
        if keys:
            key, n_keys = keys.most_common(1)[0]
            return (
                f"{names}: {n_keys} of {n_frames} frames show a chart with the key {key}, expected "
                f"{self.chart.key}, that of {self.path}; give the chart.toml of the chart that was recorded"
            )
        if sum(report.n_other_page for report in self.reports):
            return (
                f"{names}: found pages that {self.path} does not have, expected 0 to {len(self.chart.pages) - 1}"
            )
        if sum(report.n_rolled for report in self.reports):
            return (
                f"{names}: the chart is turned by more than {LARGEST_ROLL_DEGREES:g}° from upright and from a "
                "quarter turn, so the four orientations are not clear; turn the camera"
            )
        if most == 0:
            found = f"no marker found in {n_frames} frames"
        elif most < len(CORNERS):
            found = f"at most {most} of the 4 markers found in one of {n_frames} frames"
        else:
            found = f"found the 4 markers of no single page in {n_frames} frames"
        return (
            f"{names}: {found}, expected the four of the chart, whole and sharp in the picture, each at least 25 "
            f"pixels wide, not as a negative; without them give {argument.schedule}"
        )

    def warnings(self) -> Iterator[RecordingWarning]:
        """Yield warnings about conditions that make the places and sizes of triangles less certain."""
        if self.chart.with_key().key != self.chart.key:
            yield RecordingWarning(
                "edited_chart",
                f"{self.path}: was changed after the chart was made: places, sizes and levels are taken as it "
                "says now, not as the chart was; give the original, unless you measured the chart",
            )
        for report in self.reports:
            yield from self._warnings(report)

    def _warnings(self, report: RecordingReport) -> Iterator[RecordingWarning]:
        if not report.clips:
            why = "no marker of the chart was found" if not report.other_keys else "it shows another chart"
            why = "it shows the page to measure the camera alone" if report.n_camera_page else why
            found = [RecordingWarning("unused_recording", f"{why}, so the recording is not in the dataset")]
        else:
            found = [*self._of_clock(report), *self._of_place(report), *self._of_frames(report)]
        for code, message in found:
            yield RecordingWarning(code, f"{report.path}: {message}")

    def _of_clock(self, report: RecordingReport) -> Iterator[RecordingWarning]:
        """Yield a warning if the times of the frames contradict those of the chart."""
        screen, found_s, rate = self.chart.screen, report.page_duration_s, report.frames_per_second
        if screen is None or found_s is None or rate is None:
            return
        ratio = found_s / screen.page_duration_s
        if abs(ratio - 1.0) > 0.1:
            yield RecordingWarning(
                "clock",
                f"pages follow each other every {found_s:.3g} s by the times of the frames, but the chart shows "
                f"each for {screen.page_duration_s:.3g} s: {rate:.4g} frames/s here, {rate * ratio:.4g} by the "
                f"chart; trials average {1 / ratio:.2g} times as many frames as the eye does; give "
                f"{argument.frames_per_second} {rate * ratio:.4g} if the chart is right",
            )

    def _of_place(self, report: RecordingReport) -> Iterator[RecordingWarning]:
        """Yield warnings about triangles that the lens places wrong, or the view turns or stretches."""
        residual, error_px = report.worst("residual_px"), report.place_error_px or 0.0
        lens = "an ideal lens" if report.lens is None else f"a lens of the {report.lens['model']} model"
        if report.lens_unsolved:
            yield RecordingWarning(
                "residual",
                "the markers' edges determine neither a flat chart nor one behind a lens, so that it is not known "
                "how far triangles are placed wrong; film the chart larger, sharper and with less noise",
            )
        elif residual > 0.3:
            yield RecordingWarning(
                "residual",
                f"triangles may be placed wrong by {max(error_px, residual):.2g} px (rms), "
                f"{_rise_words(max(error_px, residual) * self._pitch_mrad)}; the markers' edges lie "
                f"{residual:.2g} px off a flat chart behind {lens}: the chart is bent, or the frames are noisy or "
                "blurred; film the chart larger, or nearer to the middle of the frame",
            )
        elif error_px > 0.1:
            n_markers = len(self._markers.all_centres_mm)
            chart = "a chart with markers along its borders," if n_markers == len(CORNERS) else "the chart"
            yield RecordingWarning(
                "few_points",
                f"the {n_markers} markers have too few points to determine the distortion: they fit {lens}, but "
                f"also others that place triangles {error_px:.2g} px (rms) elsewhere, "
                f"{_rise_words(error_px * self._pitch_mrad)}; film {chart} larger, or nearer to the middle of the "
                "frame",
            )
        if (change := report.magnification_range) > MOST_ZOOM:
            yield RecordingWarning(
                "zoom",
                f"the picture of the chart changes its size by {100 * (change - 1):.2g} %: the lens zooms, or "
                "camera and chart come nearer; curves then mix magnifications; import each part on its own",
            )
        if abs(roll := report.worst("roll_degrees")) > math.degrees(MOST_TURN_RAD):
            yield RecordingWarning(
                "rolled",
                f"triangles are turned by {abs(roll):.1f}° from their orientation, which the observer does not "
                "expect; turn the camera, or the chart",
            )
        if (stretch := report.worst("stretch")) > MOST_STRETCH:
            yield RecordingWarning(
                "tilted",
                f"triangles are stretched by {100 * (stretch - 1):.2g} %, as in a view at "
                f"{math.degrees(math.acos(1 / stretch)):.0f}° to the chart, so the observer expects "
                "others; look at it squarely, and keep it near the middle if the lens distorts",
            )

    def _of_frames(self, report: RecordingReport) -> Iterator[RecordingWarning]:
        """Yield warnings about frames and windows that were left out, or that gaps and repetitions spoil."""
        n_gaps = sum(clip["n_gaps"] for clip in report.clips)
        n_unread = report.n_without_markers + report.n_transition
        unread = f", or frames show no page clearly ({n_unread} of {report.n_frames} do not)" * bool(n_unread)
        for n_found, code, what in (
            (report.n_off_frame, "off_frame", "triangles reach beyond the frame and were left out"),
            (
                report.n_cut,
                "cut_window",
                "windows are cut by the frame's border, so the observer sees less than its field",
            ),
            (report.n_other_page, "unknown_page", f"frames show a page that {self.path} does not have"),
            (sum(report.other_keys.values()), "other_chart", "frames show another chart and were left out"),
            (report.n_rolled, "turned_too_far", "frames are turned too far and were left out"),
            (
                report.n_doubled,
                "doubled_frames",
                "frames repeat the one before bit by bit; they are kept as the display shows them, but "
                "their noise does not average out",
            ),
            (
                n_gaps,
                "dropped_frames",
                f"gaps of more than {GAP:g} frames, where frames are missing or the frame rate varies{unread}; no "
                "trial goes across them",
            ),
        ):
            if n_found:
                yield RecordingWarning(code, f"{n_found} {what}")

    def report(self) -> list[dict[str, object]]:
        """Return the findings in each recording and its clips."""
        return [asdict(report) for report in self.reports]

    def notes(self) -> Iterator[str]:
        """Yield remarks that need no action."""
        for report in self.reports:
            if not report.clips:
                continue
            first = report.clips[0]
            turn, mirrored, lens = first["turn_degrees"], bool(first["mirrored"]), ""
            if report.lens is not None:
                values = report.lens.items()
                named = ", ".join(f"{name} {value:.3g}" for name, value in values if isinstance(value, float))
                lens = f", the lens distorts ({report.lens['model']} model: {named})"
            yield (
                f"{report.path}: {report.n_frames} frames, clips: {len(report.clips)}; left out: "
                f"{report.n_transition} frames of transitions, {report.n_without_markers} without the four markers"
                + f", {report.n_camera_page} of the page to measure the camera"
                * bool(report.n_camera_page)
            )
            yield (
                f"{report.path}: {first['scale_px_per_mm']:.4g} px per mm of the chart, residual "
                f"{report.place_error_px or 0.0:.2g} px"
                + lens
                + (", mirrored" if mirrored else "")
                + (f", turned by {90 * (round(turn / 90) % 4)}°" if round(turn / 90) % 4 else "")
                + ("; orientations are those in the frames" if mirrored or round(turn / 90) % 4 else "")
            )
        pages = [page.number for page in self.chart.pages if page.triangles]
        if self.clips and (lost := sorted(set(pages) - {clip.page for clip in self.clips})):
            numbers = ", ".join(map(str, lost[:8])) + ", …" * (len(lost) > 8)
            yield f"pages with triangles that were not found: {len(lost)} of the chart's {len(pages)} ({numbers})"


class _Film(NamedTuple):
    """A recording that is searched: its report, its runs of frames of one page, and the chart in each frame."""

    recording: Recording
    finder: MarkerFinder
    report: RecordingReport
    runs: list[_Run]
    charts: list[_SeenChart]


@dataclass
class _Run:
    """A run of frames of one page, the time of its first one, and measurements in each frame, by name."""

    page: int
    start_s: float | None
    measurements: list[dict[str, float]] = field(default_factory=list)

    def medians(self) -> dict[str, float]:
        """Return the medians of the measurements, and the root mean square motion of the first triangle."""
        columns = {name: [frame[name] for frame in self.measurements] for name in self.measurements[0]}
        columns["turn_degrees"] = np.unwrap(columns["turn_degrees"], period=360.0).tolist()
        medians = {name: round(float(np.median(column)), 6) for name, column in columns.items()}
        motion = math.hypot(*(float(np.std(columns[name])) for name in ("x_px", "y_px")))
        return medians | {"motion_px": round(motion, 6)}


class _SeenChart(NamedTuple):
    """The chart in one frame, with its geometry as far as known then, and the number of its first triangle."""

    run: _Run
    geometry: Geometry
    corners_px: FloatArray
    number: int


def _rise_words(shift_mrad: float) -> str:
    """Return what misplaced triangles do to a threshold; `shift_mrad` is an angle on the display."""
    shift_arcmin = math.degrees(shift_mrad / 1e3) * 60.0
    # The largest that was measured for sharp triangles of 2 and 4 mrad, up to 0.4 arcmin.
    share = 0.4 * min(shift_arcmin, 1.0) ** 2
    return f"which raises thresholds by up to {100 * share:.2g} %" + " and more" * (shift_arcmin > 1.0)


def page_duration_s(starts: Sequence[tuple[int, float]], frame_s: float) -> float | None:
    """Return the mean time from the start of a page to that of the next in a film, in seconds, without pauses.

    `starts` are the page and the time of the first frame of each run of frames that show one page; `frame_s` is
    the interval between frames. None with fewer than `FEWEST_PAGE_CHANGES`, with less than two frames of a page
    (they may be photographs), or if a person has turned the pages.
    """
    steps_s = [after_s - s for (page, s), (after, after_s) in pairwise(starts) if after == page + 1]
    if len(steps_s) < FEWEST_PAGE_CHANGES:
        return None
    usual_s = median(steps_s)
    if usual_s < 2.0 * frame_s:
        return None
    regular_s = [one for one in steps_s if abs(one - usual_s) <= 1.5 * frame_s]
    # If more than a fifth of the intervals differ, a person has turned the pages, not a program.
    return fmean(regular_s) if len(regular_s) >= 0.8 * len(steps_s) else None
