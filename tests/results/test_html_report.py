"""The report: a well-formed page that loads nothing, says what the result says, and is always the same."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from itertools import combinations, count, cycle, islice
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import error_line
from matplotlib.figure import Figure
from rich.console import Console

from todframes.base.errors import DataError
from todframes.psychometrics.curves import observer_curve
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.results.data import Fit
from todframes.results.figures import COLOURS, by_field_map, draw_field_map, draw_psychometric
from todframes.results.html import sentence_html
from todframes.results.result import Result, read_result
from todframes.results.tables import Column, Table, plan, thresholds
from todframes.results.thresholds import Thresholds
from todframes.results.wording import group_phrases, phrase, plain, quantity, threshold_heading, unit_of

NASTY = [
    "<script>alert(1)</script>",
    "</style></svg></title><img src=x onerror=alert(1)>",
    "\"'><a href='javascript:alert(1)'>",
    "]]>-->&amp;{{ 7 * 7 }}{% raw %}",
    "$\\frac{1}$ _hidden $x$",
    "two\nlines\rand\ttabs",
    "n" * 3000,
    "größe 大きさ 🔺",
    "שלום \u202eabc\u202c\u2066",
    "\x00\x07\x1b[31m\ufffe",
    "=HYPERLINK(1)",
]
HIDDEN = r"[\x00-\x08\x0b-\x1f\u202a-\u202e\u2066-\u2069\ufffe]"
SVG_TAGS = {"svg", "g", "defs", "path", "clipPath", "rect", "use", "text", "tspan"}


def encode(result: dict[str, Any]) -> bytes:
    return json.dumps(result).encode()


def report_html(result: dict[str, Any]) -> bytes:
    return read_result(encode(result), "result").to_html().encode()


def tree(content: bytes) -> ElementTree.Element:
    """The page as XML, which it is too: every element is closed, every attribute quoted."""
    return ElementTree.fromstring(content)


def words(element: ElementTree.Element) -> str:
    return " ".join("".join(element.itertext()).split())


@pytest.fixture(scope="module")
def pages(results_of_commands) -> Mapping[str, bytes]:
    """The page of each result, made when it is asked for."""

    class Pages(dict[str, bytes]):
        def __missing__(self, command: str) -> bytes:
            return self.setdefault(command, report_html(results_of_commands[command]))

    return Pages()


def verdict_of(result: dict[str, Any]) -> list[str]:
    return read_result(encode(result), "result").findings()


def tables_of(content: bytes) -> dict[str, list[dict[str, str]]]:
    links = [link for link in tree(content).iter("a") if "download" in link.attrib]
    found = {}
    for link in links:
        kind, _, text = link.attrib["href"].partition(",")
        assert kind == "data:text/csv;charset=utf-8"
        found[link.attrib["download"]] = list(csv.DictReader(io.StringIO(unquote(text), newline="")))
    return found


@pytest.mark.slow
def test_same_bytes_in_another_process(results, pages, tmp_path: Path) -> None:
    """One that orders its sets otherwise."""
    path = tmp_path / "result.json"
    path.write_bytes(encode(results["score"]))
    arguments = [sys.executable, "-m", "todframes", "report", str(path)]
    subprocess.run(arguments, check=True, capture_output=True, env=os.environ | {"PYTHONHASHSEED": "99"})
    assert (tmp_path / "report.html").read_bytes() == pages["score"]


def test_first_table_holds_what_that_of_the_terminal_holds(results, pages) -> None:
    """All else about thresholds is behind *Details*; the files of both have all values."""
    result = read_result(encode(results["score"]), "result")
    table = thresholds(result.thresholds)
    first, *_ = tree(pages["score"]).iter("table")
    heads = [words(head) for head in first.iter("th") if head.get("scope") == "col"]
    assert heads == [one.heading for one in table.columns if not (one.is_detail or one.in_file_only)]
    assert {"α", "β", "Weibull"}.isdisjoint(heads)
    folded = [words(one) for one in tree(pages["score"]).iter("summary")]
    assert folded[:2] == ["Psychometric functions", "Thresholds at 75 % correct: details"]
    assert table.without_details().csv() == table.csv()


VERDICTS = {
    "score": [  # 1 ÷ size with ±10 % at 1, 2 and 4 mrad
        "At 75 % correct the threshold contrast is 1.00 (95 % interval 0.909 to 1.10) at 1 mrad, "
        "falling to 0.250 (95 % interval 0.227 to 0.275) at 4 mrad.",
    ],
    "curve": [
        "At 75 % correct the threshold SNR is 0.250 (ΔT 5.00 mK, ± 0.0006 numerical error) at 4 detectors, "
        "falling to 0.125 (ΔT 2.50 mK, ± 0.0003 numerical error) at 8 detectors.",
        "At 2 detectors there is no threshold: 75 % correct is never reached, however strong the signal.",
    ],
    "accuracy": [
        "Camera, no noise: the CPU time of closed form is 464 times less at 1 % error (extrapolated) than that of "
        "literal."
    ],
    "fit": ["At 75 % correct with eye left the threshold level is 1.00 (95 % interval 0.909 to 1.10)."],
}


def test_verdicts(results) -> None:
    assert {command: verdict_of(results[command]) for command in VERDICTS} == VERDICTS
    advice = read_result(encode(results["score"]), "result").advice()
    assert advice[0] == "1 frame could not be used and is left out."
    results["accuracy"]["scenes"][0]["estimators"][0]["cpu_s_at"][0]["cpu_s"] = None
    assert verdict_of(results["accuracy"]) == ["1 scene: error against run time."]
    own = ["It helps.", "A little."]
    assert verdict_of(results["compare"] | {"verdict": own}) == own


def test_sentences_have_code_and_minus_signs() -> None:
    assert sentence_html("the column `a<b`, 5 %") == "the column <code>a&lt;b</code>, 5\xa0%"
    assert [plain(value) for value in (-0.02, -1.2e-7, 0.02)] == ["−0.0200", "−1.20 × 10⁻⁷", "0.0200"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"status": "extrapolated", "threshold": 0.1}, "is extrapolated from the levels shown: show weaker ones."),
        ({"status": "extrapolated", "threshold": 9.0}, "from the levels shown: show stronger ones."),
        ({"threshold_ci95": [None, 1.1]}, "The data leave an end of the 95 % interval at 1 mrad open."),
        ({"threshold": None, "status": "never_reached"}, "answers stay below 75 % correct at the levels shown"),
        ({"threshold": None, "status": "always_exceeded"}, "answers stay above 75 % correct at the levels shown"),
        ({"threshold": None, "status": "too_few_levels"}, "fewer than two levels were shown"),
        ({"threshold": None, "status": "out_of_order"}, "the status is out_of_order"),
    ],
)
def test_verdict_names_what_the_data_leave_open(results, changes, sentence: str) -> None:
    results["score"]["fits"][0] |= changes
    (found,) = [told for told in verdict_of(results["score"]) if sentence in told]
    assert "1 mrad" in found


def test_groups_without_sizes_are_told_one_by_one(results) -> None:
    many = [results["fit"]["fits"][0] | {"group": {"eye": str(number)}} for number in range(9)]
    told = verdict_of(results["fit"] | {"fits": many})
    assert len(told) == 7 and told[-1] == "3 more are in the table."


def test_tables_and_pictures_say_what_the_result_says(results, pages) -> None:
    """1 ÷ size ± 10 %, α = threshold ÷ √(log₂ 3), and so P = 1 − 3/4 · 3^(−x²) at x thresholds."""
    tables = read_result(encode(results["score"]), "result").tables()
    whole, points, _, steps, *_ = (table.markdown().splitlines() for table in tables)
    assert whole[0] == (
        "| size (mrad) | threshold contrast | 95 % interval | trials | status | from points | α | β | δ |"
    )
    assert whole[2:4] == [
        "| 1 | 1.000 | 0.9091 to 1.100 | 200 | ok | 1.050 | 0.794 | 2.00 | 0 |",
        "| 2 | 0.5000 | 0.4545 to 0.5500 | 200 | ok | 0.5250 | 0.397 | 2.00 | 0 |",
    ]
    rows = [f"| 2 | {x / 2:.15g} | 40 | {1.0 - 0.75 * 3.0 ** -(x * x):.4f} |" for x in (0.5, 0.5**0.5, 1.0)]
    assert points[0] == "| size (mrad) | contrast | trials | proportion correct |" and points[7:10] == rows
    assert steps[2] == "| optics | left out | no blur | 1.0 × 10⁻⁷ | 0.20 |"
    both = ({"stage": "a", "kept": True, "bound": 0.1, "why": "b"}, {"stage": "c", "kept": False, "bound": 0.1})
    assert plan([], both).markdown().splitlines()[2:] == ["| a | kept | b |  |", "| c | left out | – | 0.10 |"]
    curve = read_result(encode(results["curve"]), "result").tables()[0].markdown().splitlines()
    assert curve[0] == "| size (detectors) | threshold SNR | numerical error | ΔT (mK) | status |"
    assert curve[2:4] == ["| 2 | – | – | – | never reached |", "| 4 | 0.2500 | ± 0.0006 | 5.000 | ok |"]
    about = "apex up, contrast 0.500, P(correct) 0.75, 6.00 mrad wide, mean of 2 frames, frames/1.exr"
    remarks = ("Run time 1.25 s.", "P(correct) is right within 0.0003", "white: 2.00 × background", about)
    # The points cross 5 % away from the curve in every fit.
    text = words(tree(pages["score"]))
    for shown in (*remarks, "up to 5.0 % away from the fitted Weibull curve"):
        assert shown in text
    assert "Numerical error of the thresholds: 0.24 % at most." in words(tree(pages["curve"]))


NUMBERS = ("threshold", "alpha", "beta", "delta", "p_correct", "threshold_numerical_error", "delta_t_mk")


@pytest.mark.parametrize("command", ["score", "curve", "fit", "naked-eye"])
def test_thresholds_and_points_come_back_from_csv(results, pages, command: str) -> None:
    fits = results[command]["fits"]
    rows = tables_of(pages[command])["thresholds.csv"]
    assert len(rows) == len(fits)
    for row, fit in zip(rows, fits, strict=True):
        for name in NUMBERS:
            if name in row:
                assert (float(row[name]) if row[name] else None) == fit.get(name)
            else:
                assert all(other.get(name) is None for other in fits)
        assert row["status"] == fit["status"]
        for name, value in fit["group"].items():
            assert type(value)(row[name]) == value
        if "threshold_ci95_low" in row:
            assert [float(row[f"threshold_ci95_{end}"]) for end in ("low", "high")] == fit["threshold_ci95"]
    rows = tables_of(pages[command]).get("points.csv", [])
    found = [{key: float(row[key]) for key in ("level", "n_trials", "p_correct")} for row in rows]
    assert found == [point for fit in fits for point in fit.get("points", [])]
    assert found or command == "naked-eye"


def test_settings_are_all_there(results) -> None:
    results["curve"]["settings"] = {"sensor": {"name": "a", "optics": {"aperture_mm": 0.1 + 0.2}}, "levels": None}
    rows = {row["name"]: row["value"] for row in tables_of(report_html(results["curve"]))["settings.csv"]}
    assert rows["settings.sensor.optics.aperture_mm"] == "0.30000000000000004"
    assert rows["settings.levels"] == ""
    assert (rows["seed"], rows["version"], rows["run_time_s"]) == ("7", "1.2.3", "1.25")


def test_long_tables_are_cut_and_their_files_are_not(results) -> None:
    results["score"]["skipped"] = [{"frame": f"frames/{n}.exr", "error": "empty"} for n in range(500)]
    content = report_html(results["score"])
    assert len(tables_of(content)["skipped.csv"]) == 500
    (table,) = [one for one in tree(content).iter("table") if words(one[0]) == "Frames left out"]
    assert len(list(table.iter("tr"))) == 201
    assert "300 more rows are in the file." in words(tree(content))


def drawings(content: bytes) -> dict[str, ElementTree.Element]:
    found = {}
    for figure in tree(content).iter("figure"):
        drawing = figure.find("svg")
        if drawing is not None:
            found[words(figure.find("figcaption/strong")).rstrip(".")] = drawing  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize("curve", ["observer", "weibull"])
def test_drawn_curve_is_that_of_the_threshold(curve) -> None:
    level = np.geomspace(0.5, 2.0, 7)
    p_correct = observer_curve(level, alpha=0.6, beta=1.0, max_d_prime=3.0)
    fit = fit_trials(
        level, p_correct, curve=curve, settings=FitSettings(resamples=0), rng=np.random.default_rng(0)
    )
    figure = Figure()
    axes = figure.subplots()
    draw_psychometric(axes, [Fit.of_counts({}, "contrast", fit)])
    drawn = max(axes.get_lines(), key=lambda line: len(line.get_xdata()))
    # A line through 100 points of a curve that is nearly straight between them.
    assert np.interp(fit.threshold, *drawn.get_data()) == pytest.approx(0.75, abs=1e-4)


def test_figures_follow_the_page(pages) -> None:
    """Ink is the page's text, nothing is black or white, and no style sheet of a figure reaches the page."""
    for drawing in drawings(pages["compare"]).values():
        assert {element.tag for element in drawing.iter()} <= SVG_TAGS
        styles = " ".join(element.get("style", "") for element in drawing.iter())
        assert "currentColor" in styles
        assert not re.search(r"#000000|#ffffff|#1f2328|font-family", styles)


def luminance(colour: str) -> float:
    """Relative luminance as the Web Content Accessibility Guidelines 2.2 define it."""
    parts = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_colours_stand_out_on_both_pages(pages) -> None:
    """Text has a contrast of 4.5 at least, lines and points 3, as the guidelines ask."""

    def contrast(one: str, other: str) -> float:
        dark, bright = sorted((luminance(one), luminance(other)))
        return (bright + 0.05) / (dark + 0.05)

    found = re.findall(r"--(\w+): (#\w{6});", pages["score"].decode())
    names = [name for name, _ in found]
    half = len(found) // 2
    assert names[:half] == names[half:] and {"paper", "ink", "muted", "accent"} <= set(names)
    for theme in (dict(found[:half]), dict(found[half:])):
        for name in ("ink", "muted", "accent"):
            assert contrast(theme[name], theme["paper"]) >= 4.5, (name, theme)
        for colour in COLOURS:
            assert contrast(colour, theme["paper"]) >= 3.0, (colour, theme)


def test_a_map_of_the_field_has_each_place_with_its_numbers() -> None:
    """Each place has a disc and its numbers at its angles; without a threshold it has a mark and the reason."""

    def fit(x: float, y: float, size: float, **more: Any) -> Fit:
        group = {"object_size_mrad": size, "object_x_mrad": x, "object_y_mrad": y}
        return Fit(group=group, level="contrast", p_correct=0.75, n_trials=40, **more)

    fits = [
        fit(-20.0, -5.0, 1.0, status="ok", threshold=0.2, threshold_ci95=(0.18, 0.23)),
        fit(0.0, 5.0, 1.0, status="extrapolated", threshold=0.5, threshold_ci95=(0.4, None)),
        fit(20.0, -5.0, 1.0, status="never_reached", threshold=None),
        fit(-20.0, -5.0, 2.0, status="ok", threshold=0.1),
    ]
    assert list(by_field_map(fits)) == [" at 1 mrad"]  # the other size has been seen at one place only
    axes = Figure().add_subplot()
    draw_field_map(axes, by_field_map(fits)[" at 1 mrad"])
    axes.figure.draw_without_rendering()
    (discs,) = axes.collections
    assert discs.get_offsets().tolist() == [[-20.0, -5.0], [0.0, 5.0]]
    assert discs.get_array().tolist() == [0.2, 0.5]
    assert (discs.norm.vmin, discs.norm.vmax) == (0.18, 0.5)  # from the lowest end of an interval
    dashed = [dashes is not None for _, dashes in discs.get_linestyles()]
    assert dashed == [False, True]
    assert {text.get_text(): text.xy for text in axes.texts} == {
        "0.200\n0.180 to 0.230": (-20.0, -5.0),
        "0.500\nfrom 0.400, open above": (0.0, 5.0),
        "never reached": (20.0, -5.0),
    }
    marks = {(line.get_marker(), *line.get_xydata()[0]) for line in axes.lines}
    assert marks == {("+", 0.0, 0.0), ("x", 20.0, -5.0)}
    # A mrad is as long to the right as downwards, on the picture as drawn.
    origin, right, down = axes.transData.transform([(0, 0), (1, 0), (0, 1)])
    assert right[0] - origin[0] == pytest.approx(origin[1] - down[1], rel=1e-6)
    assert down[1] < origin[1]


def test_letters_of_a_map_of_the_field_shrink_with_its_places() -> None:
    """With 63 places no number lies over another, and with one place of two no map is drawn."""
    fits = [
        Fit(
            group={"object_x_mrad": 3.0 * x, "object_y_mrad": 2.0 * y}, level="contrast", p_correct=0.75,
            n_trials=40, status="ok", threshold=0.1 + 0.01 * abs(x), threshold_ci95=(0.1234, 0.5678),
        )
        for x in range(-4, 5) for y in range(-3, 4)
    ]  # fmt: skip
    (shown,) = (one for one in fitted(fits).figures() if one.file == "field_map.png")
    figure = shown.figure()
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) == 63
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    assert not by_field_map(fits[:1])


def fitted(fits: list[Fit]) -> Result:
    return Thresholds.made("fit", 0.0, fits=fits)


def with_texts(result: Any, texts: Iterator[str]) -> Any:
    """A result with texts in every place where a user's text can stand, the next one in each."""
    changed = json.loads(json.dumps(result))
    changed["dataset"] = {
        "path": next(texts),
        "display": {next(texts): next(texts)},
        "manifest_sha256": next(texts),
    }
    changed |= {"version": next(texts), "versions": {next(texts): next(texts)}}
    changed |= {"settings": {next(texts): {next(texts): next(texts)}}}
    changed["skipped"] = [{"frame": text, "error": text, next(texts): "x"} for text in NASTY]
    changed["plan"] = [{"stage": next(texts), "kept": True, "why": next(texts)}]
    changed["located"] = [{"group": {next(texts): next(texts)}, "x_px": 1.0}]
    conditions = changed.get("conditions", [])
    column, level = next(texts), next(texts)
    for fit in [*changed.get("fits", []), *(fit for one in conditions for fit in one["fits"])]:
        fit["group"] |= {column: next(texts)}
        fit["level"] = level
    for one in conditions:
        one |= {"name": one["name"] + next(texts), "spec": next(texts), "domain": next(texts)}
        one["parameters"] = {next(texts): next(texts)}
        for ratio in one.get("ratios", []):
            ratio["group"] |= {column: next(texts)}
    for number, one in enumerate(changed.get("examples", [])):
        one |= {"group": {"n": float(number)}, "frame": next(texts), "orientation": next(texts)}
        one |= {"level": next(texts), "condition": next(texts)}
        for picture in one["pictures"]:
            picture["name"] = next(texts)
    for scene in changed.get("scenes", []):
        scene |= {"name": next(texts), "title": next(texts)}
        for one in scene["estimators"]:
            one |= {"name": next(texts), "label": next(texts)}
            one["points"] = [point | {"more": next(texts)} for point in one["points"]]
    return changed


@pytest.mark.parametrize("command", ["score", "compare", "accuracy"])
@pytest.mark.slow
def test_names_are_data_never_markup(results, command: str) -> None:
    """The page has the very elements that it has with harmless names, and shows the texts."""
    results["compare"]["conditions"] = results["compare"]["conditions"][:2]
    harmless = report_html(with_texts(results[command], map(str, count())))
    for first in (0, 5):  # every place is given two of them
        content = report_html(with_texts(results[command], islice(cycle(NASTY), first, None)))
        assert elements_of(content) == elements_of(harmless)
        for drawing in tree(content).iter("svg"):
            assert {element.tag for element in drawing.iter()} <= SVG_TAGS
        # A letter that turns the text beside it stays in the files alone.
        assert not re.search("[\u202a-\u202e\u2066-\u2069]", re.sub(r'href="[^"]*"', "", content.decode()))
        cells = {"".join(cell.itertext()) for cell in tree(content).iter("td")}
        skipped = tables_of(content).get("skipped.csv", [])
        assert len(skipped) == (0 if command == "accuracy" else len(NASTY))  # which skips no frames
        for text, row in zip(NASTY, skipped, strict=False):
            assert re.sub(HIDDEN, "\ufffd", text) in cells
            # No spreadsheet must compute it.
            assert row["frame"] == row["error"] == (f"'{text}" if text.startswith("=") else text)


def elements_of(content: bytes) -> list[tuple[str, list[str]]]:
    """Elements of a page as a browser's parser meets them, with their attributes' names, figures left out."""
    elements, parser = [], HTMLParser()
    parser.handle_starttag = lambda tag, attributes: elements.append((tag, sorted(name for name, _ in attributes)))
    parser.feed(content.decode())
    drawn = {tag.lower() for tag in SVG_TAGS}
    return [one for one in elements if one[0] not in drawn]


def test_long_names_break_behind_underscores_and_numbers_never() -> None:
    name, numbers = "camera_firmware_2.1_codec_h265_quality_80", {f"number_{k}": 1234.0 for k in range(6)}
    columns = [Column(key="condition", is_name=True, wraps=True)]
    columns += [Column(key=key, header="n") for key in numbers]
    table = Table.of("", "", columns, [{"condition": name} | numbers])
    console = Console(width=80, file=io.StringIO())
    console.print(table.terminal(80))
    lines = [line.split() for line in console.file.getvalue().splitlines()[4:] if line.strip()]
    assert "".join(parts[0] for parts in lines) == name
    assert all(parts[0].endswith("_") for parts in lines[:-1])
    assert lines[0][1:] == ["1234"] * 6
    assert "camera_<wbr/>firmware_<wbr/>2.1" in table.html()


def test_psychometric_functions_are_closed_where_there_is_a_curve(pages) -> None:
    (closed,) = tree(pages["score"]).iterfind(".//details//strong")
    assert words(closed) == "Psychometric functions."
    assert not tree(pages["fit"]).findall(".//details//figure")


def test_keys_that_may_be_missing() -> None:
    """The least that a fit can be, and keys that this version does not know."""
    fit = {"group": {}, "level": "contrast", "status": "ok", "p_correct": 0.75, "threshold": 0.2, "new": [1]}
    content = report_html({"schema": 1, "command": "score", "fits": [fit], "new": {"key": 1}})
    assert "At 75 % correct the threshold contrast is 0.200." in words(tree(content))
    report_html({"schema": 1, "command": "compare", "conditions": [{"name": "none"}]})


@pytest.mark.slow
@pytest.mark.parametrize("extreme", [5e-324, 1e-200, 1e200, 1.7e308])
def test_numbers_at_the_edge_of_all_numbers(results, extreme: float) -> None:
    """They are drawn at the edge of what an axis can show; the tables have them as they are."""
    for result in (results["score"], results["compare"]["conditions"][1]):
        result["fits"][0] |= {"threshold": extreme, "threshold_ci95": [None, extreme], "alpha": extreme}
        result["fits"][1]["points"][0] |= {"level": extreme}
        result["fits"][2]["group"]["size_mrad"] = extreme
    results["compare"]["conditions"][1]["ratios"][0] |= {"ratio": extreme}
    for command in ("score", "compare"):
        tables = tables_of(report_html(results[command]))
        assert str(extreme) in {row["threshold"] for row in tables["thresholds.csv"]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, "schema: found 2, expected 1"),
        ({"schema": None}, "schema: found null, expected int"),
        ({"command": "validate"}, "command: found 'validate', expected one of score"),
        ({"fits": []}, "fits: found none, expected at least one"),
        ({"fits": "none"}, "fits: found str, expected array"),
        ({"fits": [{}]}, r"fits\[0\].group is missing"),
        ({"fits": [{"group": {"size_mrad": [1]}}]}, r"fits\[0\].group\[...\]: found array, expected float | str"),
        ({"settings": 3}, "settings: found int, expected object"),
        *(
            ({"second fit": {key: value}}, "")
            for key, value in {"threshold": -1.0, "p_correct": 1.5, "level": 3, "status": None}.items()
        ),
        ({"second fit": {"points": [{"level": 0.0}]}}, ""),
        (
            {"second fit": {"group": {"camera": "left"}}},
            r"fits\[1\].group: found 'camera', expected 'size_mrad' as in the first",
        ),
        ({"examples": [{"group": {}, "pictures": [{"name": "a", "png": "AAAA"}]}]}, "picture 'a' is no PNG"),
        ({"examples": [{"group": {}, "pictures": [{"name": "a", "png": "?"}]}]}, "base64"),
    ],
)
def test_odd_values_are_named(results, changes, message: str) -> None:
    for key, value in changes.pop("second fit", {}).items():
        results["score"]["fits"][1] |= {key: value}
        message = message or rf"fits\[1\].{key}.*expected"
    with pytest.raises(DataError, match=f"^result: .*{message}"):
        report_html(results["score"] | changes)


def test_command_writes_beside_the_result_or_elsewhere(results, pages, todframes, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(b"\xef\xbb\xbf" + encode(results["score"]))
    assert todframes("report", path) == (0, f"written: {tmp_path / 'report.html'}\n", "")
    other = tmp_path / "other.html"
    other.write_text("old", encoding="utf-8")
    assert todframes("report", path, "-o", other)[0] == 0
    assert (tmp_path / "report.html").read_bytes() == other.read_bytes() == pages["score"]
    assert {file.name for file in tmp_path.iterdir()} == {"result.json", "report.html", "other.html"}


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        (b"", "not a result in JSON"),
        (b"not JSON", "not a result in JSON"),
        (b'{"settings":' + b'{"a":' * 100_000, "not a result in JSON"),
        (b"[1]", "the result: found array, expected object"),
        (b"\xff\xfe{}", "not a result in JSON"),
        (b'{"schema": 1, "command": "\xff"}', "not UTF-8"),
        # A newer Python passes over a key that it does not know, however deep.
        (b'{"new": ' + b"[" * 3000 + b"]" * 3000 + b"}", "deep|recursion|schema is missing"),
        (b'{"schema": 1, "command": "score", "fits": ' + b"9" * 5000 + b"}", "fits"),
        (b"{}", "schema is missing"),
        (b'{"schema": 1, "command": "score", "fits": [{"threshold": 1e999}]}', r"fits\[0\]"),
    ],
)
def test_files_that_are_no_results(todframes, tmp_path: Path, content: bytes, wanted: str) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(content)
    err = error_line(todframes("report", path), status=1)
    assert err.startswith(f"error: {path}: ") and re.search(wanted, err)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("name", "wanted"), [("no.json", "no such file"), ("", "is a folder")])
def test_file_that_is_not_there(todframes, tmp_path: Path, name: str, wanted: str) -> None:
    assert wanted in error_line(todframes("report", tmp_path / name), status=1)


@pytest.mark.usefixtures("blank_pictures")
def test_places_that_cannot_be_written(results, todframes, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(encode(results["fit"]))
    for place, wanted in (
        (path, "is the result itself"),
        (tmp_path, "is a folder"),
        (tmp_path / "no" / "report.html", "No such file"),
        (path / "report.html", "Not a directory"),
        ("", "is a folder"),
    ):
        assert wanted in error_line(todframes("report", path, "-o", place))
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == encode(results["fit"])


@pytest.mark.parametrize(
    ("name", "words", "unit", "value"),
    [
        ("size_mrad", "size", "mrad", "2 mrad"),
        ("object_size_mrad", "object size", "mrad", "2 mrad"),
        ("size_detectors", "size", "detectors", "2 detectors"),
        ("oversize_mrad", "oversize mrad", "", "oversize_mrad 2"),
        ("camera", "camera", "", "camera 2"),
        ("object_x_mrad", "object x mrad", "", "x 2 mrad"),
    ],
)
def test_columns_of_sizes_in_words(name: str, words: str, unit: str, value: str) -> None:
    assert (quantity(name), unit_of(name), phrase(name, 2.0)) == (words, unit, value)
    assert group_phrases([{name: "a"}, {name: "b"}]) == f"{name} a; {name} b"


def test_headings_have_units() -> None:
    names = ("contrast", "snr", "delta_t_k", "size_mrad")
    headings = ["threshold contrast", "threshold SNR", "threshold, ΔT (K)", "threshold, size (mrad)"]
    assert [*map(threshold_heading, names)] == headings
