"""The results of all commands come back from JSON, and have tables, sentences, files and a page."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ndtr

import sensor_sim as ss
import todframes as tod
from sensor_sim.limits.advise import Gain, SensorAdvice
from todframes.results.result import RESULT_TYPES, Result, read_result

CAMERA = Path(__file__).parents[2] / "sample_frames" / "staring_camera.toml"

MADE: dict[str, Callable[[Path], Result]] = {}


def made(make: Callable[[Path], Result]) -> Callable[[Path], Result]:
    """Note a function that makes the result of the command of its name in a folder."""
    MADE[make.__name__.replace("_", "-")] = make
    return make


@made
def noise(folder: Path) -> Result:
    np.save(folder / "a.npy", np.random.default_rng(1).normal(100.0, 2.0, (8, 16, 16)))
    patches = {(0, 0, 4, 4): 0.0, (8, 8, 4, 4): 1.0, (4, 8, 4, 4): 2.0}
    return tod.noise(folder / "a.npy", signal=3.0, mk_per_count=10.0, frames_per_second=50.0, patches=patches)


@made
def emva(folder: Path) -> Result:
    rng = np.random.default_rng(1)
    for name, electrons in (("dark", 0.0), ("bright", 1000.0)):
        frames = 10.0 + 0.5 * (rng.poisson(electrons, (4, 32, 32)) + rng.normal(0.0, 4.0, (4, 32, 32)))
        np.save(folder / f"{name}.npy", np.round(frames).astype(np.uint16))
    return tod.emva_noise(bright=[folder / "bright.npy"], dark=[folder / "dark.npy"], bits=12)


@made
def mtf(folder: Path) -> Result:
    y, x = np.mgrid[:64, :64] - 32.0
    np.save(folder / "edge.npy", 0.2 + 0.6 * ndtr((x * np.cos(0.1) + y * np.sin(0.1)) / 0.7))
    return tod.mtf(folder / "edge.npy", boxes=[(0, 0, 64, 64)])


@made
def range(_: Path) -> Result:  # noqa: A001 - the name of the command
    sizes = [0.2, 0.4, 0.8] * 4
    levels = [factor * 0.02 / size for factor in (0.5, 1.0, 2.0, 4.0) for size in sizes[:3]]
    correct = [12] * 3 + [24] * 3 + [36] * 3 + [40] * 3
    of_sizes = tod.fit_counts(levels, correct, [40] * 12, groups={"size_mrad": sizes})
    return tod.acquisition_range(of_sizes, target="nato_daylight", atmosphere="visible_23km", k=3.0)


@made
def camera(folder: Path) -> Result:
    y, x = np.mgrid[:64, :64] - 32.0
    np.save(folder / "sharp.npy", 0.2 + 0.6 * ndtr((x * np.cos(0.1) + y * np.sin(0.1)) / 0.7))
    np.save(folder / "grey.npy", np.random.default_rng(1).normal(100.0, 20.0, (4, 64, 64)))
    return ss.camera(edge=folder / "sharp.npy", grey=folder / "grey.npy")


@made
def sensor_mtf(_: Path) -> Result:
    return ss.mtf(CAMERA)


@made
def mrtd(_: Path) -> Result:
    return ss.mrtd(CAMERA, frequency_nyquist=[0.8, 1.2], size_detectors=[6.0, 8.0], tolerance=0.1)


@made
def sweep(_: Path) -> Result:
    vary = {"optics.aperture_mm": [20.0, 220.0], "noise.netd_mk": [16.0, 32.0]}
    low = ["delta_t_mk", "optics.aperture_mm"]
    return ss.sweep(CAMERA, size_detectors=[4, 6], vary=vary, minimise=low, tolerance=0.1)


@made
def limit(_: Path) -> Result:
    return ss.limit(CAMERA, limit="netd", size_mrad=[0.5], delta_t_k=0.05, tolerance=0.1)


@made
def worth(_: Path) -> Result:
    shown = [(turn, level) for level in (0.02, 0.05, 0.1, 0.2, 0.4) for turn in tod.ORIENTATIONS]
    middle = {"size_px": 6, "x_px": 31.5, "y_px": 31.5}
    frames = [0.5 * (1 + level * tod.coverage((64, 64), orientation=turn, **middle)) for turn, level in shown]
    orientation, level = zip(*shown, strict=True)
    background = {"white_luminance_cd_m2": 100, "background_luminance_cd_m2": 50}
    display = tod.Display(eotf="linear", pixel_pitch_mrad=0.25, **background)
    what = {"orientation": orientation, "level": level, "size_mrad": 1.5, "group": {"size_detectors": [6.0] * 20}}
    compared = tod.compare_frames(frames, "gaussian:sigma=1", display=display, **what)
    return ss.worth(compared, CAMERA, limit="netd", tolerance=0.1)


@made
def advise(_: Path) -> Result:
    """Nothing is computed here, which takes long."""
    aperture = Gain(key="optics.aperture_mm", unit="mm", value=220.0, change_percent=-12.0, error_percent=0.5)
    netd = Gain(key="noise.netd_mk", unit="mK", value=16.0, change_percent=10.0, error_percent=0.0)
    sizes = {"sizes_detectors": (3.0, 4.0), "sizes_mrad": (0.2, 0.27), "size_detectors": 4.0}
    shares = {"internal": 0.2, "detector": 0.3, "sampling": 0.5, "limits": "Sampling limits it."}
    return SensorAdvice.made("advise", 0.0, sensor="camera", gains=(aperture, netd), **sizes, **shares)


@pytest.fixture(scope="module")
def result_of(tmp_path_factory, results_of_commands) -> Callable[[str], Result]:
    """Function that gives the result of a command; each is made once."""
    folder, found = tmp_path_factory.mktemp("inputs"), dict[str, Result]()

    def give(command: str) -> Result:
        if command not in found:
            if command in MADE:
                found[command] = MADE[command](folder)
            else:
                found[command] = read_result(json.dumps(results_of_commands[command]).encode(), "result")
        return found[command]

    return give


OF_RECORDINGS, LONG = ("noise", "emva", "sensor-mtf"), ("mtf", "mrtd", "sweep")

COMMANDS = [
    pytest.param(one, marks=pytest.mark.slow) if one in ("mtf", "mrtd") else one
    for one in sorted(
        set(RESULT_TYPES) - {"calibrate"}
    )  # whose result takes persons, as tests of `calibrate` have
]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_result_comes_back_from_its_json_with_its_tables_sentences_and_page(result_of, command: str) -> None:
    result = result_of(command)
    again = read_result(result.to_json(), "result.json")
    assert again == result and again.to_json() == result.to_json()
    first, *others = result.tables()
    assert [one.title for one in again.tables()] == [one.title for one in (first, *others)]
    assert not first.is_folded and len(first.records) and first.title
    sentences = result.sentences()
    assert sentences and all(one.endswith(".") for one in sentences)
    assert again.summary() == result.summary() and result.summary().splitlines()[0] == sentences[0]
    assert sentences[0] in repr(result)
    assert result.plot(Figure().subplots()).has_data()
    notebook = result._repr_html_()
    assert "<table" in notebook and "<svg" in notebook
    page = result.to_html()
    root = ElementTree.fromstring(page)
    assert page.startswith("<!DOCTYPE html>\n") and root.tag == "html" and root.get("lang") == "en"
    loads_nothing(page, root)
    has_the_answer_first_and_no_folder(page)
    can_be_read_by_those_who_do_not_see_it(root)


def values(root: ElementTree.Element, *names: str) -> list[str]:
    return [value for element in root.iter() for name, value in element.attrib.items() if name in names]


def loads_nothing(page: str, root: ElementTree.Element) -> None:
    ids = values(root, "id")
    assert len(ids) == len(set(ids))
    references = {*values(root, "aria-labelledby"), *re.findall(r"url\(#([^)]*)\)", page)}
    links = values(root, "href", "src", "data", "action")
    references |= {one[1:] for one in links if one.startswith("#")}
    assert references <= set(ids)
    assert all(one.startswith(("data:", "#")) for one in links)
    assert not {"script", "iframe", "object", "form", "base"} & {element.tag for element in root.iter()}
    assert not re.search(r"url\((?!#)|@import|https?://", page)


def has_the_answer_first_and_no_folder(page: str) -> None:
    """Whoever gets it does not learn where the data were; the JSON has the path as it was given."""
    marks = ['class="verdict"', 'class="warnings"', "<figure>", "<table", "How it was made", "<details>"]
    places = [page.index(mark) for mark in marks if mark in page]
    assert places == sorted(places)
    assert tempfile.gettempdir() + os.sep not in page and str(Path.home()) not in page


def can_be_read_by_those_who_do_not_see_it(root: ElementTree.Element) -> None:
    levels = [int(element.tag[1]) for element in root.iter() if re.fullmatch("h[1-6]", element.tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(below - above <= 1 for above, below in pairwise(levels))
    for table in root.iter("table"):
        assert table[0].tag == "caption" and "".join(table[0].itertext()).strip()
        assert all(header.get("scope") in ("col", "row") for header in table.iter("th"))
    for picture in root.iter("img"):
        assert picture.get("alt")
    for drawing in root.iter("svg"):
        assert drawing.get("role") == "img" and drawing.get("aria-label")


def test_a_page_has_its_date_and_the_title_that_is_given(todframes, tmp_path: Path) -> None:
    result = tod.fit_counts([1.0, 2.0], [20, 40], [40, 40], fit=tod.FitSettings(resamples=0))
    assert re.fullmatch("20[0-9]{2}-[01][0-9]-[0-3][0-9]", result.date)
    assert f'<p class="about">{result.date}</p>' in result.to_html()
    (tmp_path / "result.json").write_bytes(result.to_json())
    assert todframes("report", tmp_path / "result.json", "--title", "Camera 3 & lens")[0] == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f'<p class="about">Camera 3 &amp; lens, {result.date}</p>' in page


@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.parametrize(
    "command", [*OF_RECORDINGS, "range", *(pytest.param(one, marks=pytest.mark.slow) for one in LONG)]
)
def test_files_of_a_result_make_it_again(result_of, command: str, tmp_path: Path, todframes) -> None:
    result = result_of(command)
    result.save(tmp_path / "out")
    files = {one.name for one in (tmp_path / "out").iterdir()}
    assert files >= {
        result.json_file,
        result.page_file,
        *(one.file for one in result.tables() if one.file),
    }
    assert files >= {one.file for one in result.figures() if one.file}
    written = json.loads((tmp_path / "out" / result.json_file).read_bytes())["files"]
    assert {*written, result.json_file} == files
    assert tod.load_result(tmp_path / "out" / result.json_file) == result
    page = (tmp_path / "out" / result.page_file).read_text(encoding="utf-8")
    assert page == result.to_html()
    assert todframes("report", tmp_path / "out" / result.json_file)[0] == 0
    again = (tmp_path / "out" / result.page_file).read_text(encoding="utf-8")
    # Images of a recording are not in the JSON; all else is.
    assert again.partition("<figure>")[0] == page.partition("<figure>")[0]
    assert again[again.index("<table") :] == page[page.index("<table") :]
