"""Settings: one check by annotations, for files, options and Python."""

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import pytest
from msgspec import Meta

import todframes as tod
from sensor_sim.chain.sensor import Detector, Electronics, Motion, Noise, Optics, PhotonNoise, Scene, SensorDisplay
from todframes.base import reading
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import check_values, convert, from_table, settings_of
from todframes.charts.design import Design
from todframes.charts.layout import Chart, Edge, Markers, Page, Patch, Point, Screen, Triangle
from todframes.charts.print import Paper
from todframes.display.display import Display
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.frames.dataset import Experiment
from todframes.observers.csf import CsfSettings
from todframes.observers.hotelling import HotellingSettings
from todframes.observers.oriented import GaborPyramid, OrientedSettings
from todframes.observers.pyramid import PyramidSettings
from todframes.psychometrics.fit import FitSettings

OF_SENSORS = (Detector, Electronics, Motion, Noise, Optics, PhotonNoise, Scene, SensorDisplay)
OF_CHARTS = (Chart, Design, Edge, Markers, Page, Paper, Patch, Point, Screen, Triangle)
OF_OBSERVERS = (CsfSettings, FitSettings, GaborPyramid, HotellingSettings, OrientedSettings, PyramidSettings)
OTHERS = (Atmosphere, Display, Experiment, Target)

ALL = [
    pytest.param(kind, one.name, id=f"{kind.__name__}.{one.name}")
    for kind in (*OF_SENSORS, *OF_CHARTS, *OF_OBSERVERS, *OTHERS)
    for one in fields(kind)
]


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_no_setting_takes_an_object(kind: type[Any], name: str) -> None:
    unchecked = object.__new__(kind)
    for one in fields(kind):
        object.__setattr__(unchecked, one.name, one.default)
    object.__setattr__(unchecked, name, Strange())
    with pytest.raises(SettingsError, match=f"^{name}: found Strange, expected [a-z0-9]"):
        # These two look at values before they check them all.
        (check_values if kind in (Detector, Optics) else kind.__post_init__)(unchecked)


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_ranges_stand_where_msgspec_takes_them(kind: type[Any], name: str) -> None:
    """At a number, and not at what may be one; objects of the user it does not know."""
    hint = {field.name: hint for field, hint in settings_of(kind)}[name]
    if "Meta" in repr(hint):
        with suppress(msgspec.ValidationError):
            msgspec.json.decode(b"null", type=hint)


def test_a_list_is_no_text() -> None:
    with pytest.raises(SettingsError, match=r"^here: found \['contrast'\], expected text$"):
        convert(["contrast"], str, "here")


class Strange:
    def __repr__(self) -> str:
        return "Strange"


@dataclass(frozen=True, kw_only=True)
class Part:
    share: Annotated[float, Meta(gt=0.0, lt=1.0)]
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Whole:
    size: Annotated[float, Meta(ge=1.0)] | Literal["same", "other"] = "same"
    count: Annotated[int, Meta(ge=0, le=5)] | None = None
    ends: tuple[float, float] = (0.0, 1.0)
    parts: Annotated[tuple[Part, ...], Meta(max_length=2)] = ()
    weights: Mapping[str, float] | Literal["even"] = "even"
    is_on: bool = False

    def __post_init__(self) -> None:
        check_values(self)


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"size": "Same"}, "size: found 'Same', expected a finite number >= 1 or one of same, other; write same"),
        ({"size": "3.5"}, "size: found '3.5', expected .*; write 3.5 without quotation marks"),
        ({"size": float("inf")}, "size: found inf, expected a finite number >= 1"),
        ({"size": 10**400}, "size: found 1000*…, expected a finite number >= 1"),
        ({"count": True}, "count: found True, expected a whole number from 0 to 5"),
        ({"count": 2.0}, "count: found 2.0, expected a whole number from 0 to 5"),
        ({"ends": [1.0]}, r"ends: found \[1.0\], expected a list of 2 values"),
        ({"ends": [1.0, "2"]}, r"ends\[1\]: found '2', expected a finite number; write 2 without"),
        ({"parts": {}}, "parts: found {}, expected a list of at most 2 values"),
        ({"parts": [{"share": 0.5}, {"share": 1}]}, r"parts\[1\].share: found 1, expected a number > 0 and < 1"),
        ({"parts": [{}]}, r"parts\[0\]: share is missing"),
        ({"parts": [{"sahre": 0.5}]}, r"parts\[0\]: unknown key 'sahre'; the nearest valid one is 'share'"),
        ({"parts": 2 * [{"share": 0.5, "name": 3}]}, r"parts\[0\].name: found 3, expected text"),
        ({"weights": {"a": "b"}}, "weights.a: found 'b', expected a finite number"),
        ({"weights": "uneven"}, "weights: found 'uneven', expected a table or even"),
        ({"is_on": 1}, "is_on: found 1, expected true or false"),
        ({"isOn": True}, "unknown key 'isOn'; the nearest valid one is 'is_on'"),
    ],
)
def test_a_refused_value_is_named_with_what_is_expected(table: dict[str, Any], expected: str) -> None:
    with pytest.raises(SettingsError, match=f"^here: {expected}"):
        from_table(table, Whole, "here")
    if "isOn" not in table:
        with pytest.raises(SettingsError, match=f"^{expected}"):
            Whole(**table)


def test_values_get_the_annotated_types() -> None:
    table = {"size": 3, "ends": [1, 2], "parts": [{"share": 0.5}], "weights": {"a": 1}, "count": np.int64(2)}
    whole = Whole(size=3.0, ends=(1.0, 2.0), parts=(Part(share=0.5),), weights={"a": 1.0}, count=2)
    for made in (from_table(table, Whole, "here"), Whole(**table)):
        assert repr(made) == repr(whole)


def test_an_observer_made_in_python_is_checked() -> None:
    with pytest.raises(SettingsError, match=r"^include_residual: found 'no', expected true or false$"):
        tod.PyramidObserver(include_residual="no")


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("toml_value", ("[1, 2.5]",), [1, 2.5]),
        ("toml_value", (" a b ",), "a b"),
        ("number_or_text", (" -1e3 ",), -1000.0),
        ("number_or_text", ("1_0",), "1_0"),
        ("number_or_text", (" inf",), "inf"),
        ("number", (" 2.5 ", "a"), 2.5),
        ("check_time", ("a", -1e12), -1e12),
        ("distinct_numbers", ("a", (3, 0.5)), [3.0, 0.5]),
        ("without_schema", ({"schema": 2, "size": 3}, 2, ["size"], "a"), {"size": 3}),
        ("parse_toml", (f"a{'.a' * 16} = {2**63 - 1}\n# {'.' * 500}", "a"), None),
        ("parse_toml", (f"b = {-(2**63)}", "a"), {"b": -(2**63)}),
        ("toml_literal", ({"a": True, "b": None, "c": ["é\x7f", (1,)]},), '{a = true, c = ["é\\u007f", [1]]}'),
        (
            "toml_text",
            ({"t": {"x": 1, "y": [{"z": 2}, {}]}, "n": None, "a": "b", "l": [{"u": 1}, {"u": {"v": 2}}]},),
            'a = "b"\n\n[t]\nx = 1\ny = [\n  {z = 2},\n  {},\n]\n\n[[l]]\nu = 1\n\n[[l]]\nu = {v = 2}\n',
        ),
    ],
)  # fmt: skip
def test_values_as_files_have_them(name: str, arguments: tuple[Any, ...], expected: object) -> None:
    found = getattr(reading, name)(*arguments)
    assert expected is None or found == expected


TABLE = ["level,n", "1,2", "", '"3",4', "5", "6,x"]


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("toml_value", ("1\nb = 2",), "1\nb = 2"),
        ("number", ("1,5", "a"), "a: found '1,5', expected a finite number, with a point, not a comma"),
        ("check_time", ("a", 1.1e12), "a: found 1.1e+12 s, expected a time from -1e+12 to 1e+12 s"),
        ("check_time", ("a", math.nan), "a: found nan s, expected a time from -1e+12 to 1e+12 s"),
        ("check_whole", ("a", 4, 5, 9), "a: found 4, expected a whole number from 5 to 9"),
        ("distinct_numbers", ("a", ()), "a: found no values, expected at least one"),
        ("distinct_numbers", ("a", (1, 0.5, 1)), "a: found a value twice in 1, 0.5, 1, expected each once"),
        ("without_schema", ({"schema": 1}, 2, [], "a"), "a: schema: found 1, expected 2"),
        ("without_schema", ({"x": 1}, 2, [], "a"), "a: unknown key 'x'; the nearest valid one is 'schema'"),
        ("check_columns", (["A", "c"], ["c", "a"], "f"), "f: column 'a' is missing; found A, c; write a, not A"),
        ("check_columns", ([*"abcdefghijklmnopqrstu"], ["z"], "f"),
         "f: column 'z' is missing; found a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p, q, r, s, t and 1 more"),
        ("parse_toml", (f"# {'.' * 501}", "f"), "f: not valid TOML: line 1 has more than 500 dots"),
        ("parse_toml", (f"b.c={2**63}", "f"), "f: not valid TOML: b.c: found a whole number of more than 64 bits"),
        ("parse_toml", (f"a{'.a' * 17} = 1", "f"), "f: not valid TOML: nested more than 16 deep"),
        ("path_inside", ("/d", "a\0", "f"), "f: found 'a\\x00', expected a path"),
        ("path_inside", ("/d", "../d2/a", "f"),
         "f ../d2/a lies outside of the dataset: it is /d2/a, expected a file in /d; copy it there"),
        ("settings_path", ("Nato", reading.Path(tod.__file__).parent / "field" / "targets", "target"),
         "target: found 'Nato', expected the name of a file that ends with .toml, or one of car, "
         "drone, face, nato, nato_daylight, number_plate, person, person_daylight, r46; write nato"),
    ],
)  # fmt: skip
def test_values_that_files_must_not_have(name: str, arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises((ValueError, DataError), match=f"^{re.escape(message)}$"):
        getattr(reading, name)(*arguments)


def test_rows_of_a_csv_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\ufeff" + "\n".join(TABLE), encoding="utf-8")
    header, *rows = reading.read_csv(path, most_rows=5)
    texts = [("1", "2"), ("3", "4"), ("5",), ("6", "x")]
    named = [dict(zip(("level", "n"), row, strict=False)) for row in texts]
    assert header == (str(path), {"level": "", "n": ""}, "")
    problems = ["", "", f"{path}, line 5: found 1 fields, expected 2 as in the header", ""]
    lines = [f"{path}, line {number}" for number in (2, 4, 5, 6)]
    assert rows == list(zip(lines, named, problems, strict=True))
    assert rows[1].numbers(["n", "level"]) == [4.0, 3.0]
    with pytest.raises(DataError, match=r"line 6: n: found 'x', expected a finite number > 0$"):
        rows[3].numbers(["level", "n"], positive=True)
    for read, message in (
        (lambda: list(reading.read_csv(path, most_rows=4)), "a.csv: found more than 4 rows, expected"),
        (lambda: reading.read_numbers(path, ["level"]), "line 5: found 1 fields, expected 2 as in the header$"),
    ):
        with pytest.raises(DataError, match=message):
            read()
