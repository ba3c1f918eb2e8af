"""An independent camera films charts: import finds what it saw, with the thresholds of frames placed by hand."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from independent_camera import Bending, Camera, Chart, Seen, film, looking_at, write_tiffs, write_video
from numpy.typing import NDArray
from test_import import rows_of

import todframes as tod
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.importing.importing import Imported
from todframes.importing.trials import Integration

pytest.importorskip("av", reason="videos need the extra video")

DOCS = Path(__file__).parents[2] / "docs"
FPS = 25
PITCH_MRAD = 0.2909
LINEAR = tod.Display(
    eotf="linear", white_luminance_cd_m2=100.0, pixel_pitch_mrad=PITCH_MRAD, background_luminance_cd_m2="surround"
)
GAMMA = replace(LINEAR, eotf="gamma", gamma=2.2)
# Windows and whole frames have other fractions of a retina sample before their first pixel, never of a jitter.
SCORING: dict[str, Any] = {
    "observer": tod.PyramidObserver(position_jitter_samples=0.0),
    "fit": tod.FitSettings(resamples=0),
}
ONE_PERCENT = 0.01


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> Chart:
    """32 pages: two sizes, four contrasts, four orientations."""
    return make_chart(tmp_path_factory.mktemp("chart"), sizes="2,4", contrasts="0.03,0.06,0.12,0.24")


def make_chart(folder: Path, *, sizes: str, contrasts: str, markers: str = "borders") -> Chart:
    monitor = f"--width-px 960 --height-px 540 --pixel-pitch-mm 0.5 --eotf linear --markers {markers}"
    asked = f"--for screen --distance-m 10 --sizes-mrad {sizes} --contrasts {contrasts} --repeats 1 {monitor}"
    assert run(cli, ["chart", *asked.split(), "-o", str(folder / "chart"), "--quiet"]) == 0
    return Chart.read(folder / "chart")


class Film(NamedTuple):
    """A recording: frames with their page and the shift of the hand, times in frames, homography and the lens."""

    chart: Chart
    frames: list[tuple[int, tuple[float, float], NDArray]]
    times: Sequence[int]
    matrix: NDArray
    bending: Bending | None = None

    @classmethod
    def of(
        cls,
        chart: Chart,
        camera: Camera,
        *,
        frames_per_page: int = 4,
        shake_px: float = 0.0,
        pages: Sequence[int] | None = None,
        **view,
    ) -> Film:
        view = {"scale": 0.46, "tilt_deg": 2.0, **view}
        matrix = looking_at(chart, width=camera.width, height=camera.height, **view)
        frames = film(chart, camera, matrix, frames_per_page=frames_per_page, shake_px=shake_px, pages=pages)
        return cls(chart, frames, range(len(frames)), matrix, camera.bending)

    def pick(self, numbers: Sequence[int], times: Sequence[int]) -> Film:
        """The film with other frames, at other times."""
        return self._replace(frames=[self.frames[k] for k in numbers], times=times)

    def write(self, path: Path, **how) -> Path:
        write_video(path, (values for *_, values in self.frames), times=self.times, frames_per_second=FPS, **how)
        return path

    def seen(self, number: int) -> Seen:
        """The triangle as the camera saw it in a frame."""
        page, (x, y), _ = self.frames[number]
        return self.chart.triangle(page, np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]) @ self.matrix, self.bending)


def number_of(row: dict[str, str]) -> int:
    """The number of the recorded frame that a row's window comes from."""
    return int(re.search(r"(\d+)(?:\.tif)?$", row["source"])[1])


def thresholds(result: tod.Result) -> dict[float, float]:
    assert {one.status for one in result.thresholds} == {"ok"}
    return {one.group["object_size_mrad"]: one.threshold for one in result.thresholds}


def by_hand(film: Film, dataset: Path, display: tod.Display) -> dict[float, float]:
    """Thresholds of the same frames, whole and with the places that the camera knows, in the same trials."""
    rows = rows_of(dataset)
    seen = [film.seen(number_of(row)) for row in rows]
    trials = np.array([row["trial"] for row in rows])
    place, size = np.array([(one.x_px, one.y_px) for one in seen]), np.array([one.size_px for one in seen])
    for trial in np.unique(trials):
        place[trials == trial] = place[trials == trial].mean(axis=0)
        size[trials == trial] = size[trials == trial].mean()
    frames = [film.frames[number_of(row)][2] for row in rows]
    how = {"position": place, "trial": trials.tolist(), "display": display}
    return scored(frames, seen, size_mrad=(size * PITCH_MRAD).tolist(), **how)


def scored(frames: Sequence[NDArray], seen: Sequence[Seen], **how: Any) -> dict[float, float]:
    """Thresholds of frames whose triangles are as seen."""
    how |= {"orientation": [one.orientation for one in seen], "level": [one.contrast for one in seen]}
    how |= {"group": {"object_size_mrad": [one.size_mrad for one in seen]}}
    return thresholds(tod.score_frames(frames, **how, **SCORING))


def assert_found(film: Film, dataset: Path) -> None:
    """Every row names the page, the orientation and the size that the camera saw."""
    for row in rows_of(dataset):
        number = number_of(row)
        seen = film.seen(number)
        assert (int(row["page"]), row["orientation"]) == (film.frames[number][0], seen.orientation)
        # Sizes that differ by less than 0.2 % are one size in the manifest.
        assert float(row["size_mrad"]) == pytest.approx(seen.size_px * PITCH_MRAD, rel=2e-3)


def imported(film: Film, recording: Path, *, display: tod.Display = LINEAR, **how) -> Imported:
    how |= {"chart": film.chart.folder / "chart.toml", "out": recording.with_suffix(".dataset")}
    return tod.import_recordings(recording, display=display, **how)


@pytest.mark.parametrize("rate", [9.0, 10.0, 24.0, 25.0, 30000 / 1001, 30.0, 50.0, 60.0, 120.0])
@pytest.mark.parametrize("digits", [3, 6, 12])
def test_all_trials_have_the_same_number_of_frames(rate: float, digits: int) -> None:
    """Whatever digits a container has for times: as many frames as come nearest to 0.1 s."""
    integration = Integration(0.1, 1.0 / rate)
    numbers: list[int] = []
    for k in range(int(10 * rate)):
        time_s = round(k / rate, digits)
        is_first = not numbers or (end := integration.ends_before(time_s)) is not None
        if is_first and numbers:
            assert end == (True, False)
        if is_first:
            numbers.append(0)
        integration.add(time_s, first=is_first)
        numbers[-1] += 1
    (number,) = set(numbers[:-1])
    assert abs(number / rate - 0.1) <= 0.5 / rate + 1e-9


VIEWS: dict[str, tuple[Camera, dict[str, Any], str]] = {
    "straight": (Camera(), {"turn_deg": 1.0}, r"0\.9[12]\d* px per mm of the chart, residual 0\.0"),
    "perspective": (Camera(), {"tilt_deg": 10.0}, "px per mm"),
    "colour mosaic and vignetting": (Camera(mosaic=True, vignetting=0.4), {}, "px per mm"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
def test_lossless_film_has_the_thresholds_of_frames_placed_by_hand(
    name: str, chart: Chart, tmp_path: Path
) -> None:
    camera, view, note = VIEWS[name]
    made = Film.of(chart, camera, frames_per_page=2, **view)
    if camera.mosaic:
        write_tiffs(tmp_path / "film", (values for *_, values in made.frames))
        done = imported(made, tmp_path / "film", frames_per_second=FPS)
    else:
        done = imported(made, made.write(tmp_path / "film.mkv"))
    # 2 frames a page at 25 frames/s: a trial of 0.08 s, as near to 0.1 s as 0.12 s would be.
    assert (done.n_clips, done.n_trials, done.n_frames) == (32, 32, 64)
    assert [code for code, _ in done.warnings] == ["clock"]  # the chart says 1 s a page, these films have 0.08 s
    assert re.search(note, " ".join(done.notes))
    assert_found(made, done.path)
    assert thresholds(tod.score(done.path, **SCORING)) == pytest.approx(
        by_hand(made, done.path, LINEAR), rel=ONE_PERCENT
    )


def test_a_page_under_a_thumb_is_counted_as_lost(tmp_path: Path) -> None:
    """The thumb hides a part of a marker, which then names no page, as in a blend of two pages."""
    chart = make_chart(tmp_path, sizes="4", contrasts="0.3")
    made = Film.of(chart, Camera(width=320, height=180, oversampling=3), frames_per_page=4, scale=0.3)
    for page, _, values in made.frames:
        if page == 1:
            cv2.circle(values, (22, 18), 14, 9000, thickness=-1)
    done = imported(made, made.write(tmp_path / "film.mkv"), integration_time_s="all")
    notes = " ".join(done.notes)
    assert "left out: 0 frames of transitions, 4 without the four markers" in notes
    assert "pages with triangles that were not found: 1 of the chart's 4 (1)" in notes


def test_gaps_are_counted_whatever_they_come_from(tmp_path: Path) -> None:
    """Two frames are missing, and between the eighth and the ninth frame the page changes, which is no gap."""
    chart = make_chart(tmp_path, sizes="4", contrasts="0.3")
    camera = Camera(width=320, height=180, oversampling=3)
    times = [0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 14, 15, 16, 17, 18]
    made = Film.of(chart, camera, frames_per_page=8, scale=0.3, pages=[0, 1]).pick(range(16), times)
    done = imported(made, made.write(tmp_path / "film.mkv"), integration_time_s=0.2)
    (message,) = [message for code, message in done.warnings if code == "dropped_frames"]
    assert " 2 gaps of more than 1.5 frames, where frames are missing or the frame rate varies" in message


CODECS = {"FFV1": {}, "H.264, CRF 18": {"crf": "18"}, "H.264, CRF 28": {"crf": "28"}}


@pytest.mark.weekly
def test_what_a_lossy_codec_costs_is_as_the_page_says(chart: Chart, tmp_path: Path) -> None:
    """Eight bits with gamma 2.2, once without loss and twice with; the same noise in all three."""
    page = (DOCS / "evidence" / "validation.md").read_text(encoding="utf-8")
    stated = {
        name: (float(small), float(large))
        for name, small, large in re.findall(r"^\| ([^|]+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.MULTILINE)
        if name in CODECS
    }
    made = Film.of(chart, Camera(gamma=2.2, bits=8), frames_per_page=8)
    found = {}
    for number, (name, options) in enumerate(CODECS.items()):
        codec = {"codec": "libx264", "options": options} if options else {}
        done = imported(made, made.write(tmp_path / f"film_{number}.mkv", **codec), display=GAMMA)
        assert ("lossy_compression" in {code for code, _ in done.warnings}) == bool(options)
        assert_found(made, done.path)
        found[name] = tuple(thresholds(tod.score(done.path, **SCORING)).values())
    assert stated.keys() == found.keys()
    for name, (small, large) in found.items():
        # Versions of the encoder differ by some per cent.
        assert (small, large) == pytest.approx(stated[name], rel=0.1), name
        if name != "FFV1":
            assert small > 1.1 * found["FFV1"][0]
            assert large > 1.1 * found["FFV1"][1]


LENS_VIEWS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "centred": (480, 320, {}),
    "off axis": (640, 440, {"shift_px": (70, 50)}),
    "in a quarter": (960, 640, {"shift_px": (-215, -135)}),
}


def through_lens(
    chart: Chart, view: str, *, noise: bool = False, pages: Sequence[int] | None = None, **bending
) -> Film:
    """Film pages through a lens: twice, or eight times with noise of 10 % of white."""
    width, height, how = LENS_VIEWS[view]
    lens = Bending(width=width, height=height, **bending)
    electrons = 100.0 if noise else 40_000.0
    light = {"electrons_at_white": electrons, "read_noise_electrons": electrons / 10.0 if noise else 6.0}
    camera = Camera(width=width, height=height, bending=lens, oversampling=3, **light)
    return Film.of(chart, camera, frames_per_page=8 if noise else 2, pages=pages, turn_deg=0.6, **how)


def filling(
    chart: Chart,
    *,
    k: tuple[float, ...],
    width: float,
    place: float = 0.0,
    electrons: float = 40_000.0,
    read_noise: float = 6.0,
) -> Film:
    """Film the first page twice, sharply. Without the lens, it takes a share of the frame's width; it lies to the
    right of and below the middle, by a share of the free margin."""
    shape = np.array([800, 450])
    bending = Bending(width=800, height=450, k=k)
    optics = {"width": 800, "height": 450, "bending": bending, "blur_sigma_px": 0.4, "oversampling": 3}
    camera = Camera(**optics, electrons_at_white=electrons, read_noise_electrons=read_noise)
    rows, columns = chart.shape
    scale = width * shape[0] / columns
    shift = place * (shape - scale * np.array([columns, rows])) / 2.0
    view = {"scale": scale, "tilt_deg": 0.0, "turn_deg": 0.6, "shift_px": shift}
    return Film.of(chart, camera, frames_per_page=2, pages=[0], **view)


def misplacement_px(film: Film, dataset: Path) -> float:
    """Root mean square distance of the places in the manifest from those that the camera saw."""
    distances = []
    for row in rows_of(dataset):
        number = number_of(row)
        seen, whole = film.seen(number), film.frames[number][2]
        window = cv2.imread(str(dataset / row["frame"]), cv2.IMREAD_UNCHANGED)
        top, left = round(seen.y_px - float(row["y_px"])), round(seen.x_px - float(row["x_px"]))
        (place,) = [
            (left + dx, top + dy)
            for dy in range(-3, 4)
            for dx in range(-3, 4)
            if np.array_equal(whole[top + dy :, left + dx :][: window.shape[0], : window.shape[1]], window)
        ]
        distances.append((place[0] + float(row["x_px"]) - seen.x_px, place[1] + float(row["y_px"]) - seen.y_px))
    return float(np.sqrt((np.array(distances) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(("markers", "bending"), [
    ("borders", {"k": (-0.02,)}),
    ("borders", {"k": (-0.004,)}),
    pytest.param("corners", {"k": (-0.02,)}, marks=pytest.mark.slow),
    pytest.param("borders", {"fisheye_deg": 120.0}, marks=pytest.mark.slow),
])  # fmt: skip
def test_a_triangle_is_placed_through_the_lens(markers: str, bending: dict[str, Any], tmp_path: Path) -> None:
    """A barrel of 2 % and a chart beside the axis: a homography alone would misplace triangles by 0.3 px.

    One of 0.4 % is found at the end of the recording. The chart lies 70 and 50 pixels of 0.92 px/mm beside it.
    """
    chart = make_chart(tmp_path, sizes="4", contrasts="0.3", markers=markers)
    made = through_lens(chart, "off axis", pages=[0], **bending)
    done = imported(made, made.write(tmp_path / "film.mkv"), integration_time_s="all")
    assert misplacement_px(made, done.path) < (0.05 if markers == "borders" else 0.1)
    (report,) = json.loads((done.path / "import.json").read_text(encoding="utf-8"))["found"]
    if "k" not in bending:
        # Seen 20 px beside the axis of a lens that squeezes the picture outwards: by 3 %, which is not warned of.
        assert 1.03 < report["clips"][0]["stretch"] < 1.05
        return
    (clip,), seen = report["clips"], made.seen(0)
    assert report["lens"]["k1"] == pytest.approx(bending["k"][0], abs=2e-3 if markers == "borders" else 1e-2)
    names = ("x_px", "y_px", "object_x_mrad", "object_y_mrad", "frame_mrad", "turn_degrees")
    angles_mrad = [70 / 9.2, 50 / 9.2, np.hypot(640, 440) / 9.2]  # of a plane; the tilt changes them by 0.3 %
    expected = [seen.x_px, seen.y_px, *angles_mrad, 0.6]
    assert [clip[name] for name in names] == pytest.approx(expected, rel=5e-3, abs=0.1)
    assert done.warnings == ()
    assert any("the lens distorts" in note for note in done.notes)
    assert_found(made, done.path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "width", "place"), [((-0.04,), 0.93, 0.0), ((0.044,), 0.93, 0.0), ((-0.3, 0.15), 0.6, 0.9)]
)
def test_markers_are_looked_for_where_the_lens_has_them(
    k: tuple[float, ...], width: float, place: float, tmp_path: Path
) -> None:
    """On lines between the corners, markers along the borders would be half a module beside their places."""
    made = filling(make_chart(tmp_path, sizes="2", contrasts="0.3"), k=k, width=width, place=place)
    done = imported(made, made.write(tmp_path / "film.mkv"), integration_time_s="all")
    assert misplacement_px(made, done.path) < 0.05
    assert {code for code, _ in done.warnings} <= {"tilted"}


@pytest.mark.slow
def test_an_uncertain_lens_is_told_with_what_it_does_to_a_threshold(tmp_path: Path) -> None:
    chart = make_chart(tmp_path, sizes="4", contrasts="0.03,0.06,0.12,0.24", markers="corners")
    noisy = filling(chart, k=(-0.15,), width=0.5, place=0.9, electrons=50.0, read_noise=5.0)
    done = imported(noisy, noisy.write(tmp_path / "film.mkv"), integration_time_s="all")
    ((_, message),) = [one for one in done.warnings if one.code in {"few_points", "residual"}]
    shift, rise = re.search(
        r" ([\d.]+) px \(rms\).*, which raises thresholds by up to ([\d.]+) %", message
    ).groups()
    assert misplacement_px(noisy, done.path) < 3.0 * float(shift)
    sharp = Film.of(chart, Camera(blur_sigma_px=0.4), frames_per_page=2)
    seen = [sharp.seen(number) for number in range(len(sharp.frames))]

    def threshold(x_px: float) -> float:
        position = np.array([(one.x_px + x_px, one.y_px) for one in seen])
        how = {"position": position, "trial": [number // 2 for number in range(len(seen))], "display": LINEAR}
        frames = [values for *_, values in sharp.frames]
        return scored(frames, seen, size_mrad=[one.size_px * PITCH_MRAD for one in seen], **how)[4.0]

    measured = threshold(float(shift)) / threshold(0.0) - 1.0
    # Both numbers have two digits: 5 % of a shift are 10 % of its square.
    assert 0.9 * measured < float(rise) / 100.0 < 4.0 * measured


@pytest.mark.slow
@pytest.mark.parametrize(("k1", "view", "noise"), [
    (-0.1, "off axis", False),
    *(
        pytest.param(k1, view, noise, marks=pytest.mark.weekly)
        for k1, view, noise in itertools.product([-0.1, -0.01, 0.1], LENS_VIEWS, [False, True])
        if (k1, view, noise) != (-0.1, "off axis", False)
    ),
])  # fmt: skip
def test_thresholds_through_a_lens_are_those_of_frames_placed_by_hand(
    k1: float, view: str, noise: bool, tmp_path: Path
) -> None:
    chart = make_chart(tmp_path, sizes="4", contrasts="0.03,0.06,0.12,0.24")
    made = through_lens(chart, view, noise=noise, k=(k1,))
    done = imported(made, made.write(tmp_path / "film.mkv"))
    assert misplacement_px(made, done.path) < (0.1 if noise else 0.03)
    (report,) = json.loads((done.path / "import.json").read_text(encoding="utf-8"))["found"]
    if not noise:
        found, expected = thresholds(tod.score(done.path, **SCORING)), by_hand(made, done.path, LINEAR)
        assert found == pytest.approx(expected, rel=ONE_PERCENT)
    assert report["place_error_px"] < 0.1
