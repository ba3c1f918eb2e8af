"""Settings: one check by annotations, for files, options and Python."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from msgspec import Meta

import todframes as tod
from sensor_sim.chain.sensor import Detector, Electronics, Motion, Noise, Optics, PhotonNoise, Scene, SensorDisplay
from todframes.base.errors import SettingsError
from todframes.base.reading import check_values, from_table
from todframes.charts.design import Design
from todframes.charts.layout import Chart, Edge, Markers, Page, Patch, Point, Screen, Triangle
from todframes.charts.print import Paper
from todframes.charts.thermal import Plate
from todframes.display.display import Display
from todframes.experiment.session import SessionDesign
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.field.ttp import TtpSettings
from todframes.frames.dataset import Experiment
from todframes.observers.csf import CsfSettings
from todframes.observers.gabor_pyramid import GaborPyramid
from todframes.observers.hotelling import HotellingSettings
from todframes.observers.oriented import OrientedSettings
from todframes.observers.pyramid import PyramidSettings
from todframes.psychometrics.fit import FitSettings

OF_SENSORS = (Detector, Electronics, Motion, Noise, Optics, PhotonNoise, Scene, SensorDisplay)
OF_CHARTS = (Chart, Design, Edge, Markers, Page, Paper, Patch, Plate, Point, Screen, Triangle)
OF_OBSERVERS = (CsfSettings, FitSettings, GaborPyramid, HotellingSettings, OrientedSettings, PyramidSettings)
OTHERS = (Atmosphere, Display, Experiment, SessionDesign, Target, TtpSettings)

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


class Strange:
    def __repr__(self) -> str:
        return "Strange"


@dataclass(frozen=True, kw_only=True)
class Part:
    share: Annotated[float, Meta(gt=0.0, lt=1.0)]
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Whole:
    size: Annotated[float | Literal["same", "other"], Meta(ge=1.0)] = "same"
    count: Annotated[int | None, Meta(ge=0, le=5)] = None
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
