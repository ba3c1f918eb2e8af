"""Recordings of a chart, or with a schedule, become datasets; the camera is that of `filmed_chart`."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import filmed_chart as film
import numpy as np
import pytest
from conftest import error_line

import todframes as tod
from todframes.base.errors import DataError, SettingsError
from todframes.charts.layout import marker_bits, marker_ids, write_chart
from todframes.importing.chart_source import ChartSource, RecordingReport, page_duration_s
from todframes.importing.geometry import Geometry, PlacedTriangle, place_triangle
from todframes.importing.importing import _of_design, checked_time
from todframes.importing.trials import (
    Clip,
    ClipFrame,
    Correction,
    Placed,
    TrialDivision,
    TriangleDescription,
    WrittenWindow,
    clean_clips,
    field_reach_px,
    frames_with_those_before,
    merged_sizes,
    share_of_other,
    window_about,
    window_writer,
)
from todframes.recordings.recording import CodeRange, RecordedFrame
from todframes.stimulus import Orientation

CHART = film.make_chart()
WARM = replace(CHART.pages[0], triangles=(replace(CHART.pages[0].triangles[0], contrast=None, delta_t_k=0.5),))
THERMAL = replace(CHART, kind="thermal", screen=None, markers=None, pages=(WARM,))
RATE = 30.0
FRAMES_PER_CLIP = 6


@pytest.fixture(scope="module")
def pages() -> list[np.ndarray]:
    return [film.filmed(CHART, page.number, film.camera()) for page in CHART.pages]


@pytest.fixture
def chart(tmp_path: Path) -> Path:
    write_chart(tmp_path / "chart.toml", CHART)
    return tmp_path / "chart.toml"


def film_of(images: list[np.ndarray], noise: float = 0.02, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([film.recorded(image, noise, rng) for image in images])


def saved(folder: Path, frames: np.ndarray) -> Path:
    np.save(folder / "film.npy", frames)
    return folder / "film.npy"


def rows_of(dataset: Path) -> list[dict[str, str]]:
    with (dataset / "manifest.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def imported(
    path: Path, chart: Path, **settings
) -> tuple[tod.recordings.importing.Imported, list[dict[str, str]]]:
    default = {"display": "reference_linear", "frames_per_second": RATE, "out": path.parent / "dataset"}
    done = tod.import_recordings(path, chart=chart, **default | settings)
    return done, rows_of(done.path)


def codes(done) -> set[str]:
    return {warning.code for warning in done.warnings}


def test_a_film_becomes_a_dataset(tmp_path: Path, chart: Path, pages: list[np.ndarray]) -> None:
    frames = film_of([pages[k] for k in (0, 1, 6) for _ in range(FRAMES_PER_CLIP)])
    done, rows = imported(saved(tmp_path, frames), chart)
    assert (done.n_clips, done.n_trials, done.n_frames) == (3, 6, 18)  # 0.1 s at 30 frames/s are 3 frames
    assert done.warnings == ()
    assert [row["page"] for row in rows] == ["0"] * 6 + ["1"] * 6 + ["6"] * 6
    assert [row["orientation"] for row in rows] == ["up"] * 6 + ["right"] * 6 + ["down"] * 6
    assert {(row["contrast"], row["polarity"], row["object_size_mrad"]) for row in rows[:6]} == {
        ("0.1", "1", "3.2")
    }
    pitch_mrad = tod.load_dataset(done.path).display.pitch_mrad
    assert float(rows[0]["size_mrad"]) == pytest.approx(32.0 * 0.62 * pitch_mrad, rel=1e-3)
    assert len({row["size_mrad"] for row in rows}) == 1
    true = Geometry(film.camera(), 0.0)
    for number, row in enumerate(rows):
        window = cv2.imread(str(done.path / row["frame"]), cv2.IMREAD_UNCHANGED)
        one = place_triangle(
            true, orientation=Orientation.UP, size_mm=32.0, x_mm=film.MIDDLE_MM[0], y_mm=film.MIDDLE_MM[1]
        )
        # Where the window was cut follows from its place of the triangle; then its values are those of the frame.
        left, top = round(one.x_px - float(row["x_px"])), round(one.y_px - float(row["y_px"]))
        assert abs(left + float(row["x_px"]) - one.x_px) < 0.1
        assert abs(top + float(row["y_px"]) - one.y_px) < 0.1
        height, width = window.shape
        assert np.array_equal(window, frames[number][top : top + height, left : left + width])
        assert float(row["time_s"]) == pytest.approx(number / RATE, abs=1e-6)
    found = json.loads((done.path / "import.json").read_text(encoding="utf-8"))
    assert [clip["page"] for clip in found["found"][0]["clips"]] == [0, 1, 6]
    assert found["found"][0]["clips"][0]["scale_px_per_mm"] == pytest.approx(0.62, rel=1e-3)
    data = tod.load_dataset(done.path)
    assert not data.bad_rows
    assert [len(trial.frames) for trial in data.trials] == [3] * 6
    # Two trials of a clip follow each other in one window: the second has the frames of the first before it.
    assert [len(trial.warm_up) for trial in data.trials.with_warm_up(4)] == [0, 3] * 3


def test_frames_before_a_trial_are_those_of_the_film(tmp_path: Path, chart: Path, pages) -> None:
    """Of the page before and of the transition; fewer where the film begins."""
    frames = film_of([pages[0]] * 6 + [0.5 * pages[0] + 0.5 * pages[1]] + [pages[1]] * 7 + [pages[6]] * 3)
    done, rows = imported(saved(tmp_path, frames), chart, warm_up_frames=4)
    assert (done.n_trials, done.n_frames) == (5, 5 * 3 + 2 * 4)
    (note,) = [one for one in done.notes if "before them" in one]
    assert note.startswith("2 of 5 trials have fewer than 4 frames before them, as a recording begins there")
    assert note.endswith("leave these trials out (on_error skip)")
    numbers = [round(float(row["time_s"]) * RATE) for row in rows]
    assert numbers == [*range(6), *range(3, 13), *range(10, 17)]
    assert [row["judged"] for row in rows] == list("11111100001111110000111")
    data = tod.load_dataset(done.path)
    assert [len(trial.warm_up) for trial in data.trials.with_warm_up(5)] == [0, 3, 4, 5, 4]


CLIP: dict[str, Any] = {"number": 1, "page": 0, "n_gaps": 0, "residual_px": 0.1, "roll_degrees": 0.5}
CLIP |= {"stretch": 1.01, "frame_mrad": 50.0}


def source_of(chart: Path, *reports: dict[str, Any]) -> ChartSource:
    """A search whose reports are these changes of a flawless one, with a clip for each `clips`."""
    source = ChartSource(chart, pitch_mrad=0.3, progress=None)
    for report in reports:
        changed = (
            {"path": "f", "n_frames": 90} | report | {"clips": [CLIP | one for one in report.get("clips", [{}])]}
        )
        source.reports.append(RecordingReport(**changed))
    return source


CLOCK = {"frames_per_second": 25.0}


@pytest.mark.parametrize(("code", "passed", "reported"), [
    ("unused_recording", {"clips": [{}]}, {"clips": []}),
    ("clock", CLOCK | {"page_duration_s": 0.4501}, CLOCK | {"page_duration_s": 0.4499}),
    ("clock", CLOCK | {"page_duration_s": 0.5499}, CLOCK | {"page_duration_s": 0.5501}),
    ("residual", {"lens_unsolved": False}, {"lens_unsolved": True, "place_error_px": 9.0}),
    ("residual", {"clips": [{"residual_px": 0.3}]}, {"clips": [{"residual_px": 0.301}], "place_error_px": 0.2}),
    ("few_points", {"place_error_px": 0.1}, {"place_error_px": 0.101}),
    ("zoom", {"magnification_range": 1.029}, {"magnification_range": 1.031}),
    ("rolled", {"clips": [{}, {"roll_degrees": -1.99}]}, {"clips": [{"roll_degrees": -2.01}, {}]}),
    ("tilted", {"clips": [{"stretch": 1.05}]}, {"clips": [{"stretch": 1.051}]}),
    ("off_frame", {"n_off_frame": 0}, {"n_off_frame": 2}),
    ("doubled_frames", {"n_doubled": 0}, {"n_doubled": 2}),
    ("other_chart", {"other_keys": {}}, {"other_keys": {3: 1, 5: 1}}),
    ("dropped_frames", {"n_transition": 3}, {"clips": [{"n_gaps": 1}, {"n_gaps": 1}], "n_transition": 3}),
])  # fmt: skip
def test_a_recording_has_the_warning_of_its_report(chart: Path, code: str, passed, reported) -> None:
    assert list(source_of(chart, passed).warnings()) == []
    (found,) = source_of(chart, reported).warnings()
    assert found.code == code
    assert "f: 2 " in found.message or code not in ("off_frame", "cut_window", "other_chart", "dropped_frames")


def test_places_in_the_field_are_columns_where_the_chart_was_moved(chart: Path) -> None:
    """By more than a tenth of the frame, 5 mrad here; each group has the mean place of its clips."""
    places = [(1.0, 2.0), (6.5, 2.0), (4.9, 5.0), (1.5, -1.0), (6.5, 3.0)]
    clips = [{"number": k, "object_x_mrad": x, "object_y_mrad": y} for k, (x, y) in enumerate(places, start=4)]
    found = source_of(chart, {"clips": clips[:2]}, {"clips": clips[2:]}).field_places()
    one, other = (f"{x} {y}" for x, y in (("2.4667", "2"), ("6.5", "2.5")))
    assert {key: " ".join(of.values()) for key, of in found.items()} == {
        4: one,
        5: other,
        6: one,
        7: one,
        8: other,
    }
    assert source_of(chart, {"clips": clips[:1]}, {"clips": clips[3:4]}).field_places() == {}


def test_windows_of_a_size_are_of_one_size_where_they_lie_on_the_frame(chart: Path) -> None:
    """They hold triangles up to 10 % larger; a triangle has 16 pixels to move, within the frame."""
    source, report = source_of(chart), RecordingReport("film")
    corners = np.array([[100.0, 30.0], [90.0, 50.0], [110.0, 50.0]])
    one = PlacedTriangle(100.2, 43.6, 19.9, Orientation.UP, 0.0, corners)
    placed, reach = source._part((300, 400), one, 32.0, report, 7), field_reach_px(22, 0.3)
    right, down = (100 - reach, 100 + reach + 1), 44 + reach + 1
    assert placed[5:] == ((0, down + 16, max(right[0] - 16, 0), right[1] + 16), 7)
    assert placed[:5] == (100.2, 43.6, 19.9, Orientation.UP, (0, down, *right))
    for size, held in ((21.9, 22), (18.3, 22), (18.1, 20), (22.1, 25)):
        window = source._part((300, 400), one._replace(y_px=150.0, size_px=size), 32.0, report, 8).window
        assert window == window_about(100.2, 150.0, field_reach_px(held, 0.3))
    for shift, is_there in ((-90.5, True), (-90.6, False), (289.5, True), (289.6, False)):
        moved = one._replace(corners_px=corners + np.array([shift, 0.0]))
        assert (source._part((300, 400), moved, 32.0, report, 9) is not None) == is_there
    assert (report.n_cut, report.n_off_frame) == (3, 2)


@pytest.mark.parametrize(("durations", "expected"), [
    ([0.2] * 8, 0.2),
    ([0.2, 0.16, 0.2, 0.24, 0.2], 0.2),  # a frame late or early
    ([0.2, 0.2, 3.0, 0.2, 0.2, 0.2], 0.2),  # a pause
    ([0.5, 1.7, 0.9, 2.4, 1.1], None),  # turned by hand
    ([0.2, 0.2], None),
    ([0.05] * 8, None),  # pages as short as the frames: photographs, one of each page
])  # fmt: skip
def test_the_duration_of_pages_is_that_of_a_program(durations, expected) -> None:
    starts = list(enumerate(np.cumsum([1.0, *durations]).tolist()))
    assert page_duration_s(starts, 0.04) == (None if expected is None else pytest.approx(expected))


def test_transitions_are_left_out(tmp_path: Path, chart: Path, pages: list[np.ndarray]) -> None:
    first, second = pages[0], pages[1]
    split = np.where(np.arange(film.ROWS)[:, None] < 100, second, first)  # a display that is read line by line
    shown = [first] * 8 + [0.9 * first + 0.1 * second, 0.5 * first + 0.5 * second, split] + [second] * 8
    done, rows = imported(saved(tmp_path, film_of(shown)), chart, integration_time_s="all")
    assert [row["source"].rpartition(" ")[2] for row in rows] == [str(k) for k in [*range(8), *range(11, 19)]]
    assert any("left out: 3 frames of transitions" in note for note in done.notes)


def test_shake_is_told_and_followed(tmp_path: Path, chart: Path) -> None:
    shifts = [(0.0, 0.0), (2.0, 1.0), (-1.0, 2.0)]
    frames = film_of([film.filmed(CHART, 0, film.camera(shift=shift)) for shift in shifts])
    path = saved(tmp_path, frames)
    done, rows = imported(path, chart)
    assert codes(done) == {"shake"}
    places = np.array(shifts)
    motion = np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert f"up to {motion:.2g} px" in done.warnings[0].message
    assert len({(row["x_px"], row["y_px"]) for row in rows}) == 1


def test_frames_of_another_chart_among_the_right_ones(
    tmp_path: Path, chart: Path, pages: list[np.ndarray]
) -> None:
    other = film.filmed(film.make_chart((0.2,), name="another"), 0, film.camera())
    blank = np.full_like(pages[0], 0.5)
    done, rows = imported(saved(tmp_path, film_of([other, blank, *[pages[0]] * 3])), chart)
    assert [row["source"][-1] for row in rows] == ["2", "3", "4"]
    assert codes(done) == {"other_chart"}
    found = json.loads((done.path / "import.json").read_text(encoding="utf-8"))["found"][0]
    assert list(found["other_keys"].values()) == [1]
    assert (found["n_frames"], found["n_without_markers"], found["clips"][0]["n_frames"]) == (5, 1, 3)


@pytest.mark.parametrize(("code", "message", "n_pages", "settings", "views"), [
    ("turned_too_far", "2 frames are turned too far", 8, {}, [(0, {})] * 6 + [(0, {"degrees": 37.0})] * 2),
    ("unknown_page", "2 frames show a page that ", 1, {}, [(0, {})] * 6 + [(1, {})] * 2),
    ("moved", "1 trials were left out", 8, {}, [(0, {})] * 5 + [(0, {"shift": (50.0, 0.0)})] * 4),
    ("short_clips", "1 of 2 clips are shorter than the integration", 8, {}, [(0, {})] * 6 + [(1, {})]),
    ("slow_frames", "frames are 0.5 s apart, more", 8, {"frames_per_second": 2.0}, [(0, {}), (1, {})]),
])  # fmt: skip
def test_frames_that_are_left_out_or_alone_are_told(
    tmp_path: Path, chart: Path, code, message, n_pages, settings, views
) -> None:
    write_chart(chart, replace(CHART, pages=CHART.pages[:n_pages]))
    frames = [film.filmed(CHART, page, film.camera(scale=0.4, **view)) for page, view in views]
    done, _ = imported(saved(tmp_path, film_of(frames)), chart, **settings)
    assert message in {one.code: one.message for one in done.warnings}[code]


@pytest.mark.parametrize(("settings", "match"), [
    ({"schedule": "s.csv"}, "found both, expected one"),
    ({"chart": "thermal.toml"}, "a thermal chart has no markers; give schedule, and the places found"),
    ({"integration_time_s": "1 min"}, "expected a time > 0"),
    ({"ifov_mrad": 1.0}, "not used with a chart"),
    ({"level": "contrast"}, "level: is given but not used with a chart"),
])  # fmt: skip
def test_settings_that_are_refused(tmp_path: Path, chart: Path, settings: dict, match: str) -> None:
    path = saved(tmp_path, np.zeros((1, 8, 8), np.uint8))
    write_chart(tmp_path / "thermal.toml", THERMAL)
    with pytest.raises(SettingsError, match=match):
        imported(path, tmp_path / settings.pop("chart", chart), **settings)


def test_values_without_a_white_need_a_range(tmp_path: Path, chart: Path, pages: list[np.ndarray]) -> None:
    kelvin = np.array([280.0 + 40.0 * pages[0]], np.float32)
    path = saved(tmp_path, kelvin)
    with pytest.raises(SettingsError, match="expected value_range LOW:HIGH"):
        imported(path, chart)
    done, rows = imported(path, chart, value_range=(270.0, 330.0), integration_time_s=0.01)
    stored = tod.read_frame(done.path / rows[0]["frame"]).values[..., 0]
    true = Geometry(film.camera(), 0.0).to_px(film.MIDDLE_MM)
    left, top = (round(at - float(rows[0][name])) for name, at in zip(("x_px", "y_px"), true, strict=True))
    height, width = stored.shape
    # Kelvin in 32 bits are exact to 1.5e-5, and so are 60 K times code values of 32 bits.
    assert stored * 60.0 + 270.0 == pytest.approx(kelvin[0][top : top + height, left : left + width], abs=5e-5)


def test_a_schedule_says_what_is_shown(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 255, (12, 200, 220)).astype(np.uint8)
    path = saved(tmp_path, frames)
    (tmp_path / "s.csv").write_text(
        "file,start_s,end_s,orientation,size_mrad,contrast,x_px,y_px\n"
        "film.npy,0,0.2,left,4.0,0.2,100.25,90.5\nfilm.npy,0.2,0.4,up,4.0,0.1,100.25,90.5\n",
        encoding="utf-8",
    )
    settings = {"schedule": tmp_path / "s.csv", "display": "reference_linear", "frames_per_second": RATE}
    done = tod.import_recordings(path, out=tmp_path / "d", ifov_mrad=0.2, **settings)
    rows = rows_of(done.path)
    assert (done.n_trials, done.n_frames) == (4, 12)
    assert [row["orientation"] for row in rows] == ["left"] * 6 + ["up"] * 6
    # 4 mrad at the camera are 20 pixels, seen at 0.2909 mrad each.
    assert float(rows[0]["size_mrad"]) == pytest.approx(20 * 0.2909)
    assert rows[0]["object_size_mrad"] == "4.0"
    window = cv2.imread(str(done.path / rows[7]["frame"]), cv2.IMREAD_UNCHANGED)
    left, top = (round(at - float(rows[7][name])) for name, at in (("x_px", 100.25), ("y_px", 90.5)))
    assert (100.25 - left, 90.5 - top) == (float(rows[7]["x_px"]), float(rows[7]["y_px"]))
    assert np.array_equal(window, frames[7][top : top + window.shape[0], left : left + window.shape[1]])


@pytest.mark.parametrize(("off_px", "warned"), [(0.0, set()), (1.5, {"position_offset"})])
def test_places_of_a_schedule_are_checked_in_the_frames(tmp_path: Path, off_px: float, warned: set[str]) -> None:
    rng = np.random.default_rng(1)
    turns = [Orientation(name) for name in ("up", "right", "down", "left")] * 3
    shown = [tod.coverage((120, 130), size_px=16.0, x_px=61.3, y_px=60.2, orientation=turn) for turn in turns]
    frames = [0.4 * (1 + 0.2 * one) + 0.01 * rng.normal(size=one.shape) for one in shown]
    rows = [f"{k},{k + 1},{turn},16.0,0.2,{61.3 + off_px},60.2\n" for k, turn in enumerate(turns)]
    table = tmp_path / "s.csv"
    table.write_text("start_s,end_s,orientation,size_px,contrast,x_px,y_px\n" + "".join(rows), encoding="utf-8")
    path = saved(tmp_path, np.rint(65535 * np.array(frames)).astype(np.uint16))
    settings = {"display": "reference_linear", "frames_per_second": 1.0, "integration_time_s": "all"}
    done = tod.import_recordings(path, schedule=table, out=tmp_path / "d", **settings)
    assert codes(done) == warned


def test_a_schedule_of_images_without_places_keeps_whole_frames(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), np.full((40, 50), ord(name), np.uint8))
    (tmp_path / "s.csv").write_text(
        "file,orientation,size_mrad,snr,lens\nb.png,left,4.0,2,wide\na.png,up,4.0,1,long\n", encoding="utf-8"
    )
    done = tod.import_recordings(tmp_path / "images", schedule=tmp_path / "s.csv", level="snr", out=tmp_path / "d")
    rows = rows_of(done.path)
    assert {(row["orientation"], row["snr"], row["lens"]) for row in rows} == {
        ("left", "2.0", "wide"),
        ("up", "1.0", "long"),
    }
    assert {row["x_px"] for row in rows} == {""}
    for row in rows:
        whole = cv2.imread(str(done.path / row["frame"]), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(whole, np.full((40, 50), ord(row["source"][0]), np.uint8))
    assert 'group_by = ["size_mrad"]' in (done.path / "dataset.toml").read_text(encoding="utf-8")
    half = {"value_range": (0.0, 97.5), "out": tmp_path / "half"}
    done = tod.import_recordings(tmp_path / "images", schedule=tmp_path / "s.csv", level="snr", **half)
    (message,) = [one.message for one in done.warnings if one.code == "beyond_range"]
    assert message.startswith("50 % of the values lie beyond black and white and were clipped, as the display")


ROWS = "start_s,end_s,orientation,size_mrad,size_px,contrast,x_px,y_px\n0,0.05,left,4.0,9,0.2,{},5\n"


@pytest.mark.parametrize(("rows", "rate", "message"), [
    (ROWS.format(15), None, "the frames have no times; give frames_per_second"),
    (ROWS.format(15).replace("0,0.05", "5,6"), RATE, "no frame lies in the times of any row"),
    (ROWS.format(15) + "0.05,1,up,,9,0.2,15,5", RATE, "line 3: size_mrad: is missing, expected it in all rows or"),
    (ROWS.format(900), RATE, "line 2: found x_px 900 and y_px 5, expected a place on the frame of 40 x 40 pixels"),
    (ROWS.format(15) + "5,6,up,4.0,9,0.2,15,5", RATE, None),
])  # fmt: skip
def test_rows_of_a_schedule_and_what_is_recorded(tmp_path: Path, rows: str, rate, message: str | None) -> None:
    path, table = saved(tmp_path, np.zeros((3, 40, 40), np.uint8)), tmp_path / "s.csv"
    table.write_text(rows, encoding="utf-8")
    settings = {"schedule": table, "frames_per_second": rate, "integration_time_s": "all", "out": tmp_path / "d"}
    if message is None:
        warnings = tod.import_recordings(path, **settings).warnings
        assert {one.code for one in warnings} >= {"no_frames", "cut_window"}
        return
    with pytest.raises(DataError, match=message):
        tod.import_recordings(path, **settings)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.4])
def test_share_of_another_page_in_a_blend(share: float) -> None:
    ids, other = marker_ids(7, 3), marker_ids(8, 3)
    bits, other_bits = (np.array([marker_bits(marker) for marker in page], float) for page in (ids, other))
    levels = 200.0 + 900.0 * ((1 - share) * bits + share * other_bits)
    assert share_of_other(levels, ids, other) == pytest.approx(share)
    levels[0] = 200.0 + 900.0 * bits[0]
    assert share_of_other(levels, ids, other) == pytest.approx(share)  # the other marker has changed by then
    assert share_of_other(levels, ids, ids) == 0.0


def clip_frame(
    page: int, number: int, share: float = 0.0, other: int = 0, time_s: float | None = None
) -> ClipFrame:
    bits, other_bits = (
        np.array([marker_bits(marker) for marker in marker_ids(one, 3)], float) for one in (page, other)
    )
    window = (0, 9, 0, 9)
    placed = Placed(4.0, 4.0, 2.0, Orientation.UP, window, window)
    return ClipFrame(
        page,
        number / RATE if time_s is None else time_s,
        str(number),
        np.zeros((9, 9), np.uint8),
        (placed,),
        (1 - share) * bits + share * other_bits,
    )


@pytest.mark.parametrize("n_clean", [2, 5, 20])
def test_frames_with_a_share_of_a_neighbour_are_left_out(n_clean: int) -> None:
    numbers = iter(range(100))
    shown = [clip_frame(1, next(numbers)) for _ in range(n_clean)]
    shown += [clip_frame(1, next(numbers), 0.08, 2), clip_frame(2, next(numbers), 0.3, 1)]
    shown += [clip_frame(2, next(numbers), 0.01, 1)] + [clip_frame(2, next(numbers)) for _ in range(n_clean)]
    clean = list(clean_clips(shown, key=3, first_number=4))
    assert [frame.source for _, frame in clean] == [
        one.source for k, one in enumerate(shown) if k not in (n_clean, n_clean + 1)
    ]
    clips = list({id(clip): clip for clip, _ in clean}.values())
    assert [(clip.number, clip.page, clip.n_frames, clip.n_transition) for clip in clips] == [
        (4, 1, n_clean, 1),
        (5, 2, n_clean + 1, 1),
    ]


def division_of(
    frames: Iterable[tuple[Clip, ClipFrame]],
    time_s: float | None,
    frame_s: float | None,
    *,
    steady: bool = False,
    windows: dict[str, np.ndarray] | None = None,
) -> TrialDivision:
    def described(page: int, index: int) -> TriangleDescription:  # noqa: ARG001
        return TriangleDescription(0.1, 1, {})

    def write(name: str, values: np.ndarray, scale: CodeRange) -> WrittenWindow:  # noqa: ARG001
        if windows is not None:
            windows[name] = values
        return WrittenWindow("", values.size, 0)

    division = TrialDivision(described, time_s, steady=steady, write=write)
    division.take(frames, CodeRange(0, 255), frame_s)
    return division


def divided(frames: list[ClipFrame], time_s: float | None, frame_s: float | None) -> tuple[TrialDivision, Clip]:
    clip = Clip(1, 1)
    return division_of(((clip, frame) for frame in frames), time_s, frame_s), clip


def test_frames_before_a_gap_are_left_out() -> None:
    """Intervals of 1/30 s, then a frame is missing; also without a known rate, and without times."""

    def n_before(times_s: list[float | None], rate: float | None) -> list[int]:
        frames = [RecordedFrame(np.zeros((9, 9), np.uint8), one, "f") for one in times_s]
        recording = SimpleNamespace(frames_per_second=rate, frames=lambda: iter(frames))
        return [len(before) for _, before in frames_with_those_before(recording, 2)]

    times_s: list[float | None] = [k / RATE for k in (0, 1, 2, 3, 5, 6)]
    assert n_before(times_s, RATE) == [0, 1, 2, 2, 0, 1]
    assert n_before(times_s, None) == n_before([None] * 6, RATE) == [0, 1, 2, 2, 2, 2]


@pytest.mark.parametrize("times_s", [(0.0, 1.0, 1.0, 1.0), (1.0, 1.0, 2.0, 3.0), (None, None, None, None)])
def test_without_times_that_rise_there_are_no_frames_before(times_s) -> None:
    """They would be in no clip, as their trial may be."""
    before = tuple(RecordedFrame(np.zeros((9, 9), np.uint8), one, "f") for one in times_s[:2])
    first, second = (clip_frame(1, 0)._replace(time_s=one, before=before) for one in times_s[2:])
    division, _ = divided([first, second], None, None)
    (trial,) = division.trials
    assert (len(trial.frames), trial.n_warm_up, trial.n_before) == (2, 0, 0)
    rows = list(division.rows(level="contrast", pitch_mrad=1.0, field_places={}))
    assert [row["clip"] for row in rows] == ["clip_0001" if times_s[3] == 3.0 else ""] * 2
    assert "judged" not in rows[0]


@pytest.mark.parametrize("steady", [False, True])
def test_rows_of_trials_have_all_that_is_known_of_them(steady: bool) -> None:
    """Two trials of a run in one window, which a steady one moves by whole pixels, and one after a gap."""
    shown = [(0, 4.0, 4.0, 2.0, 0), (1, 5.0, 5.0, 2.1, 1), (2, 5.25, 5.0, 2.006, 1), (3, 4.25, 7.25, 2.0, 1)]
    values = np.arange(400, dtype=np.uint8).reshape(20, 20)
    frames = []
    for number, x, y, size, left in [*shown, (6, 9.0, 4.0, 3.0, 5), (7, 9.0, 4.0, 3.0, 5)]:
        one = Placed(x, y, size, Orientation.LEFT, (0, 9, left, 9 + left), (-9, 30, -9, 30), 10 + number)
        frames.append(clip_frame(1, number)._replace(values=values, triangles=(one,)))
    before = tuple(RecordedFrame(values, -k / RATE, f"b{k}") for k in (2, 1))
    frames[0] = frames[0]._replace(before=before)
    clip, windows = Clip(1, 1), {}
    division = division_of(((clip, one) for one in frames), 2 / RATE, 1 / RATE, steady=steady, windows=windows)
    for trial in division.trials:
        trial.correct({13: Correction(0.5, -1.0, 2.014), 99: Correction(9.0, 9.0, 9.0)})
    row, *_ = rows = list(
        division.rows(level="snr", pitch_mrad=0.5, field_places={1: {"place": "7", "frame": "no"}})
    )
    assert row == {
        "frame": "frames/clip_0001/trial_01_before_000.png", "orientation": "left", "size_mrad": "1.025",
        "snr": "0.1", "polarity": 1, "x_px": "4.0000" if steady else "4.5000",
        "y_px": "4.0000" if steady else "4.5000", "trial": "", "sha256": "",
        "clip": "clip_0001", "time_s": "-0.066667", "judged": 0, "source": "b2",
        "place": "7",
    }  # fmt: skip
    ends = ["01_before_000", "01_before_001", "01_0", "01_1", "02_0", "02_1", "03_0", "03_1"]
    assert [one["frame"] for one in rows] == [f"frames/clip_0001/trial_{end}.png" for end in ends] == [*windows]
    assert [one["judged"] for one in rows] == [0, 0] + [1] * 6
    assert [one["trial"][-8:] for one in rows] == ["", ""] + ["trial_01"] * 2 + ["trial_02"] * 2 + ["trial_03"] * 2
    assert [one["clip"] for one in rows] == ["clip_0001"] * 6 + ["clip_0001_from_trial_03"] * 2
    # The second trial begins in the window in which the first one ends; its last place is corrected.
    x, y = (4.5, 3.625) if steady else (5.0, 5.625)
    assert [(one["x_px"], one["y_px"], one["size_mrad"]) for one in rows[4::2]] == [
        (f"{x:.4f}", f"{y:.4f}", "1.005"), ("4.0000", "4.0000", "1.5"),
    ]  # fmt: skip
    tops_lefts = [(0, 0)] * 3 + ([(1, 1), (1, 1), (3, 0)] if steady else [(0, 0)] * 3) + [(0, 5)] * 2
    assert [(int(one[0, 0]) // 20, int(one[0, 0]) % 20) for one in windows.values()] == tops_lefts
    assert (clip.n_gaps, clip.n_trials, division.n_before) == (1, 3, {2: 1, 4: 1, 0: 1})
    motion_px = (0.0, np.hypot(0.25, 0.375)) if steady else (np.sqrt(0.5), np.hypot(0.25, 0.625))
    assert [trial.motion_px for trial in division.trials] == pytest.approx([*motion_px, 0.0])


@pytest.mark.parametrize(("n_frames", "time_s", "frame_s", "sizes"), [
    *((n, 0.1, 1 / RATE, sizes) for n, sizes in ((10, [3, 3, 3]), (3, [3]), (2, []))),
    *((5, 0.01, 1 / RATE, [1] * 5), (7, 0.2, 1 / RATE, [6]), (7, None, 1 / RATE, [7])),
    (4, 0.1, None, [1] * 4),
])  # fmt: skip
def test_trials_of_the_integration_time(n_frames: int, time_s: float | None, frame_s, sizes: list[int]) -> None:
    division, clip = divided([clip_frame(1, k) for k in range(n_frames)], time_s, frame_s)
    assert [len(trial.frames) for trial in division.trials] == sizes
    assert clip.n_trials == len(sizes)


def test_a_triangle_that_leaves_a_trial_is_left_out_of_it_alone() -> None:
    """The second of two triangles is off the frame, or moves beyond what is held, and is there again later."""

    def frame(number: int, second: Placed | None) -> ClipFrame:
        one = clip_frame(1, number)
        return one._replace(triangles=(*one.triangles, second))

    (there,) = clip_frame(1, 0).triangles
    moved = there._replace(held=(0, 9, 3, 12))
    shown = [there, moved, there, None, there, there, there, there, there]
    division, clip = divided([frame(*one) for one in enumerate(shown)], 0.1, 1 / RATE)
    assert [(trial.name[-10:], len(trial.frames)) for trial in division.trials] == [
        ("trial_01_1", 3),
        ("trial_02_1", 3),
        ("trial_03_1", 3),
        ("trial_03_2", 3),
    ]
    assert (division.n_moved, clip.n_trials) == (1, 4)


@pytest.mark.parametrize(("intervals_s", "sizes", "n_gaps"), [
    ([1 / 30, 1 / 20] * 15, [2] * 15, 0),  # 24 frames/s on a display of 60 Hz
    ([0.02] * 50 + [0.1] * 10, [5] * 10 + [1] * 10, 4),  # the first four could be gaps
    ([1 / 30] * 30 + [1 / 15] * 14, [3] * 10 + [1] * 14, 4),  # as at 15 frames/s throughout
    ([2.0, 3.0, 40.0, 2.0], [1] * 5, 0),  # photographs
    ([1 / 30] * 6 + [1 / 15] + [1 / 30] * 12 + [1 / 15] + [1 / 30] * 8, [3] * 9, 2),  # two frames missing
])  # fmt: skip
def test_variable_frame_rates_are_taken_as_they_are(intervals_s, sizes, n_gaps) -> None:
    times_s = np.cumsum([1.0, *intervals_s])
    frames = [clip_frame(1, k)._replace(time_s=float(time_s)) for k, time_s in enumerate(times_s)]
    division, clip = divided(frames, 0.1, float(np.mean(intervals_s)))
    assert [len(trial.frames) for trial in division.trials] == sizes
    assert clip.n_gaps == n_gaps


def test_the_time_between_two_clips_is_no_frame_rate() -> None:
    clips = [Clip(1, 1), Clip(2, 2), Clip(3, 3)]
    frames = [(clip, clip_frame(1, 30 * clip.number + k)) for clip in clips for k in (0, 1, 2, 5, 6, 7)]
    division = division_of(frames, 0.1, 1 / RATE)
    assert [clip.n_gaps for clip in clips] == [1, 1, 1]
    assert [len(trial.frames) for trial in division.trials] == [3] * 6


def test_sizes_that_hardly_differ_are_one() -> None:
    assert merged_sizes([10.0, 20.0, 10.01, 10.02, 20.2]) == pytest.approx([10.01, 20.0, 10.01, 10.01, 20.2])


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0.1 s", 0.1), ("100 ms", 0.1), ("0.2", 0.2), ("40ms", 0.04), (0.2, 0.2), ("all", None)],
)
def test_times_in_words(text: str | float, expected: float | None) -> None:
    assert checked_time(text) == (None if expected is None else pytest.approx(expected))


def test_the_command(tmp_path: Path, chart: Path, pages: list[np.ndarray], todframes) -> None:
    path, out = saved(tmp_path, film_of([pages[0]] * 3)), ("-o", tmp_path / "d")
    command = ["import", path, "--chart", chart, *out]
    status, printed, notes = todframes(*command, "--frames-per-second", "30")
    assert status == 0 and "3 frames in 1 trial from 1 clip" in printed and "note: " in notes
    message = error_line(todframes(*command, "--range", "5"))
    assert message == "error: --range: found '5', expected numbers as LOW:HIGH\n"
    for found, sources in (("neither", []), ("both", ["--chart", "a.toml", "--schedule", "none.csv"])):
        expected = f"found {found}, expected one of --chart and --schedule, which says what is shown"
        assert error_line(todframes("import", path, *sources, *out)) == f"error: import: {expected}\n"
    error_line(todframes("import", tmp_path / "none.mkv", "--chart", chart, *out), status=1)


def test_each_recording_is_a_dataset_of_its_own(todframes, chart, pages, working_folder) -> None:
    """Alike names do not meet, one that fails is a row, and what is there is not written again."""
    frames = film_of([pages[0]] * FRAMES_PER_CLIP)
    for name in ("old/film", "new/film", "new/other"):
        path = working_folder / f"{name}.npy"
        path.parent.mkdir(exist_ok=True)
        np.save(path, frames)
    asked = ("--chart", chart, "--display", "reference_linear", "--frames-per-second", "30", "-o", "out")
    status, out, err = todframes("import", "--each", "old/film.npy", "new/*", "none.npy", *asked)
    assert status == 1 and "here_none.npy failed: none.npy: found no file" in out
    assert err.splitlines()[0] == "1 of 4: old/film.npy"
    assert err.splitlines()[-1] == "error: 1 of 4 recordings could not be used: here_none.npy"
    with Path("out/summary.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = ["old_film", "new_film", "new_other"]
    assert [row["recording"] for row in rows] == [*names, "here_none.npy"]
    for name, row in zip(names, rows, strict=False):
        found = json.loads(Path(f"out/{name}/import.json").read_text(encoding="utf-8"))
        assert row["trials"] == str(found["n_trials"]) == "2" and row["status"] == "ok"
        assert row.get("warnings", "") == ", ".join(one["code"] for one in found["warnings"])
    manifest = Path("out/new_film/manifest.csv").read_bytes()
    shutil.rmtree("out/new_other")
    status, out, err = todframes("import", "--each", "old/film.npy", "new/*", *asked)
    assert status == 0 and err.count("is there already and stays as it is; remove it to make it anew") == 2
    assert Path("out/new_film/manifest.csv").read_bytes() == manifest
    with Path("out/summary.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["trials"], row["status"]) for row in rows] == [("2", "kept"), ("2", "kept"), ("2", "ok")]
    status, _, err = todframes("import", "new/*", *asked[:-1], "both")
    assert status == 0 and "note: 2 recordings are one dataset; --each makes a dataset of each" in err
    assert len(rows_of(Path("both"))) == 2 * len(rows_of(Path("out/new_film")))


@pytest.mark.parametrize("clip", [True, False])
def test_windows_are_written_once_and_count_what_lies_beyond(tmp_path: Path, clip: bool) -> None:
    values, scale = np.array([[100.0, 140.0, 180.0], [99.0, 181.0, 60.0]], np.float32), CodeRange(100.0, 180.0)
    rows: dict[str, bytes] = {}
    writer = window_writer(tmp_path, {}, rows.__setitem__, clip=clip)
    assert writer("a/0.exr", values, scale)[1:] == (6, 3)
    expected = np.array([[0.0, 0.5, 1.0], [-0.0125, 1.0125, -0.5]])
    shown = tod.read_frame(tmp_path / "a/0.exr").values[..., 0]
    assert shown == pytest.approx(np.clip(expected, 0.0, 1.0) if clip else expected)
    for k in range(63):
        written = writer(f"a/{k}.png", values.astype(np.uint8), scale)
    assert written == (hashlib.sha256((tmp_path / "a/62.png").read_bytes()).hexdigest(), 6, 0) and len(rows) == 64
    (tmp_path / "a/1.png").write_bytes(b"")
    added: dict[str, bytes] = {}
    again = window_writer(tmp_path, dict(rows), added.__setitem__, clip=clip)
    for name, change, n_written in (("a/0.png", 0, 0), ("a/1.png", 0, 1), ("a/2.png", 0, 1), ("a/3.png", 1, 2)):
        again(name, values.astype(np.uint8) + change, scale)
        assert len(added) == n_written
    assert (tmp_path / "a/1.png").read_bytes() == (tmp_path / "a/2.png").read_bytes()


@pytest.mark.parametrize(("added", "message"), [
    ([], None),
    ([("up", 22.0, "e")], "triangles of 4.0 mrad are displayed with 20 to 23.1 px"),  # by more than 15 %
    ([("up", 21.0, "e")], "contrast 0.1 at 4.0 mrad has 4 trials of up and 1 of left"),
    ([("left", 20.0, "a")], "1 of 5 trials repeat another one bit by bit"),
])  # fmt: skip
def test_trials_that_one_curve_cannot_hold_are_found(added, message: str | None) -> None:
    trials = []
    for turn, size_px, sha256 in [
        ("up", 20.0, "a"),
        ("up", 20.0, "b"),
        ("up", 20.0, "c"),
        ("left", 20.0, "d"),
        *added,
    ]:
        frames = [SimpleNamespace(written=WrittenWindow(one, 1, 0)) for one in ("warm-up", sha256)]
        stimulus = TriangleDescription(0.1, 1, {"object_size_mrad": "4.0"})
        more = {"clip": 1, "n_warm_up": 1, "sizes_px": [size_px, size_px * 1.05], "stimulus": stimulus}
        trials.append(SimpleNamespace(orientation=Orientation(turn), frames=frames, **more))
    source = SimpleNamespace(group_by="object_size_mrad", level="contrast")
    found = [warning.message for warning in _of_design(SimpleNamespace(trials=trials), source, {})]
    assert not found if message is None else found[0].startswith(message)
