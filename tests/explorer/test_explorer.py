"""The explorer's server: its parameters are those of SENSOR.toml, its numbers those of the commands."""

from __future__ import annotations

import base64
import copy
import http.client
import json
import math
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

import sensor_sim as ss
from sensor_sim.chain.noise import delta_t_mk
from sensor_sim.chain.pictures import trial_stages
from sensor_sim.chain.sensor import TABLES, Noise, sensor_from, sensor_settings, sensor_toml
from sensor_sim.chain.simulation import SimulatedTrial
from sensor_sim.chain.vary import numeric_keys
from sensor_sim.cli import cli
from sensor_sim.explorer import routes
from sensor_sim.explorer.answers import (
    Drawn,
    PlotAsked,
    ThresholdSent,
    curve_plot,
    draw_curves,
    number_text,
    percent_at_most,
    range_answer,
    range_from,
)
from sensor_sim.explorer.live import CurvePoint, LiveCurve
from sensor_sim.explorer.parameters import SLIDERS, observer_fields, sensor_fields
from sensor_sim.explorer.routes import CurveAsked, Explorer, SensorAsked, TextAsked, TomlAsked, TrialAsked
from sensor_sim.sweeps.goals import Aim
from sensor_sim.thresholds.predict import PredictedThreshold
from sensor_sim.thresholds.threshold import Shares
from todframes.base.errors import DataError, SettingsError
from todframes.cli.console import run
from todframes.field.atmosphere import Atmosphere, find_atmosphere
from todframes.field.target import Target, find_target
from todframes.observers.csf import CsfObserver, CsfSettings
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.results.figures import COLOURS
from todframes.web import server
from todframes.web.server import error_of

SAMPLES = Path(__file__).parents[2] / "sample_frames"
CAMERA = SAMPLES / "star_like.toml"
SENSOR = ss.load_sensor(CAMERA)
TABLES_SENT = sensor_settings(SENSOR)
EXPLORER = Explorer(SENSOR)
STARING = ss.load_sensor(SAMPLES / "staring_camera.toml")
SMALL = replace(STARING, display=replace(STARING.display, pixels_per_detector=2, blur_sigma_px=0.5))
"""A camera whose triangles are a few retina samples wide, which takes the least time."""
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


PHOTON = sensor_from(
    tomllib.loads(ss.new_sensor(preset="emva_basler", focal_length_mm=25, f_number=2.8, pitch_um=3.45)), "photon"
)
THERMAL = sensor_from(
    tomllib.loads(ss.new_sensor(thermal=True, netd_mk=50, pitch_um=12, f_number=1.0, focal_length_mm=35)),
    "thermal",
)
PARAMETERS = (*sensor_fields(), *observer_fields(PyramidSettings))
OBSERVERS_PARAMETERS = (*observer_fields(PyramidSettings), *observer_fields(CsfSettings))


@pytest.mark.parametrize("sensor", [SENSOR, PHOTON, THERMAL, *routes.presets().values()], ids=lambda one: one.name)
def test_every_key_of_a_sensor_has_one_field_whose_slider_holds_its_value(sensor):
    keys = Counter(one.key for one in PARAMETERS)
    assert set(keys.values()) == {1}
    assert SLIDERS.keys() <= keys.keys() | {one.key for one in OBSERVERS_PARAMETERS}
    settings = sensor_settings(sensor)
    of_sensor = {f"{table}.{key}" for table in TABLES if table in settings for key in settings[table]}
    assert of_sensor - keys.keys() <= {"noise.model"}  # it is not changed by a field
    assert numeric_keys(sensor).keys() - {"detector.fill_factor"} <= keys.keys()
    for field in sensor_fields():
        table, name = field.key.split(".")
        value = settings.get(table, {}).get(name)
        assert value is None or field.min is None or field.min <= value <= field.max, field.key


SLIDERS_BY_HAND = """\
optics.aperture_mm             | Aperture         | mm          | number  | 2.0 500.0 0.005 log
optics.blur_sigma_mrad         | Blur             | mrad        | number  | 0.0 0.5 0.001 linear
optics.f_number                | f-number         |             | number  | 0.5 32.0 0.005 log
optics.mtf                     | Measured MTF     |             | file    | optional
optics.mtf_includes_detector   | MTF includes detector |        | switch  |
turbulence.cn2_m23             | Cn²              | m^(−2/3)    | number  | 1e-17 1e-11 0.005 log
scene.photons_per_lux_s_um2    | Photons of a lux | /(lx·s·µm²) | number  | 100.0 100000.0 0.005 log optional
noise.distribution             | Distribution     |             | choice  |
noise.netd_mk                  | NETD             | mK          | number  | 1.0 500.0 0.005 log optional
noise.frames_integrated        | Frames integrated |            | integer | 1 64 1.0 linear
noise.prnu_percent             | PRNU             | %           | number  | 0.0 5.0 0.01 linear
noise.bits                     | Bits             |             | integer | 4 16 1.0 linear optional
display.pixels_per_detector    | Pixels per detector |          | integer | 1 16 1.0 linear
display.blur_sigma_px          | Spot             | display px  | number  | 0.0 10.0 0.05 linear
observer.internal_noise        | Internal noise   |             | number  | 0.01 5.0 0.005 log"""


def test_fields_have_these_labels_units_and_sliders():
    fields = {one.key: one for one in PARAMETERS}
    for line in SLIDERS_BY_HAND.splitlines():
        key, label, unit, kind, slider = (part.strip() for part in line.split("|"))
        field = fields[key]
        assert (field.label, field.unit, field.kind) == (label, unit, kind), key
        assert field.group == key.split(".")[0].capitalize()
        ends = "" if field.min is None else f"{field.min} {field.max} {field.step} {field.scale} "
        assert f"{ends}{'optional' * field.optional}".strip() == slider, key
    assert fields["noise.distribution"].choices == ("uniform", "gaussian")


def test_a_link_or_a_request_reads_no_file(tmp_path):
    """The server knows the files of its own sensor; no other name makes it read one."""
    (tmp_path / "mtf.csv").write_text("frequency_cyc_per_mrad,mtf\n0,1\n5,0.4\n10,0\n")
    text = re.sub(r"\[optics\]\n(.+\n)*", '[optics]\nmtf = "mtf.csv"\n', sensor_toml(SENSOR))
    (tmp_path / "mine.toml").write_text(text)
    sensor = ss.load_sensor(tmp_path / "mine.toml")
    explorer, tables = Explorer(sensor), sensor_settings(sensor)
    assert explorer.made(SensorAsked(tables)) == sensor
    written = explorer.written(TomlAsked(tables, None))
    assert written["beside"] == ["mtf.csv"] and written["text"] == sensor_toml(sensor)
    for name in (str(tmp_path / "mtf.csv"), "../mtf.csv", "other.csv"):
        with pytest.raises(
            SettingsError, match=r"mtf: found '.*', a file that cannot be read from here; give the"
        ):
            explorer.made(SensorAsked(tables | {"optics": tables["optics"] | {"mtf": name}}))
    with pytest.raises(SettingsError, match=r"^mine\.toml: \[optics\]: mtf: found 'mtf\.csv', a file that cannot"):
        routes.read(TextAsked(text, "mine.toml"))
    (tmp_path / "mtf.csv").write_text("frequency_cyc_per_mrad,mtf\n0,1\n5,0.3\n10,0\n")
    assert Explorer(ss.load_sensor(tmp_path / "mine.toml")).start()["measured"] != explorer.start()["measured"]


def test_a_plot_has_the_values_the_bands_and_crosses_where_nothing_is_reached():
    curves = [Drawn(2, "2: before", [0.2, 0.1], [2.0, 1.0], [0.2, 0.1]), Drawn(0, "now", [0.1], [1.5], [0.0])]
    axes = Figure().subplots()
    shown = PlotAsked("svg", "TOD curve", "1 / size", "Threshold <SNR>", curves, never_reached=[0.4])
    assert curve_plot(shown) == curve_plot(shown)  # the same bytes
    assert ElementTree.fromstring(base64.b64decode(curve_plot(shown)["base64"])).tag.endswith("svg")
    draw_curves(axes, asked=shown)
    pinned, now, crosses = axes.lines
    np.testing.assert_array_equal(pinned.get_xydata(), [[0.1, 1.0], [0.2, 2.0]])
    np.testing.assert_array_equal(now.get_xydata(), [[0.1, 1.5]])
    np.testing.assert_array_equal(crosses.get_xydata(), [[0.4, 0.0]])
    assert axes.get_xlim()[0] == 0.0 and [line.get_linewidth() for line in (pinned, now)] == [1.4, 2.2]
    vertices = axes.collections[0].get_paths()[0].vertices
    assert (vertices[:, 1].min(), vertices[:, 1].max()) == (0.9, 2.2)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["2: before", "now"]
    # A pinned curve has the colour of its number on the page, and the present one the blue of all figures.
    style = (files("sensor_sim.explorer") / "static" / "explorer.css").read_text()
    of_page = re.search(r"--pin-2: (#\w+)", style)[1]
    assert [line.get_color() for line in (pinned, now)] == [of_page, COLOURS[0]]


NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])  # on a machine that others use
@given(name=NAMES, netd_mk=st.none() | st.floats(1e-12, 1e12), aperture_mm=st.floats(1e-12, 1e12))
def test_the_file_of_a_sensor_gives_the_same_sensor(name, netd_mk, aperture_mm):
    sensor = replace(
        SENSOR,
        name=name,
        noise=replace(SENSOR.noise, netd_mk=netd_mk, distribution="gaussian"),
        optics=replace(SENSOR.optics, aperture_mm=aperture_mm),
    )
    text = sensor_toml(sensor)
    assert routes.read(TextAsked(text)) == {"sensor": sensor_settings(sensor)}
    assert EXPLORER.made(SensorAsked(sensor_settings(sensor))) == sensor


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "../../etc/passwd", "a; rm -rf ~", "$(reboot)", "", "é 波"]
)
def test_a_strange_name_is_harmless_in_files_and_commands(name):
    made = Explorer(SENSOR).written(TomlAsked(sensor_settings(replace(SENSOR, name=name)), [4.0]))
    assert re.fullmatch(r"[\w-]+\.toml", made["file"])
    program, _, file, *_ = shlex.split(made["command"])
    assert (program, file) == ("sensor-sim", made["file"])
    assert not re.search(r"[;$`&|<>]", made["command"])
    assert Explorer(SENSOR).written(TomlAsked(TABLES_SENT, None))["command"] is None  # the sizes are being chosen


def test_the_command_names_the_observer_and_its_settings():
    explorer = Explorer(SENSOR, CsfObserver(aperture_sd_deg=0.5), p_correct=0.8)
    start = explorer.start()
    assert start["observer"] == {"efficiency": 1.0, "luminance_cd_m2": 30.0} and start["p_correct"] == 0.8
    made = explorer.written(TomlAsked(TABLES_SENT, [4.0], {"efficiency": 0.5, "luminance_cd_m2": 30.0}))
    words = shlex.split(made["command"])
    assert words[words.index("--observer") + 1] == "csf"
    assert [two for one, two in pairwise(words) if one == "--set"] == ["aperture_sd_deg=0.5", "efficiency=0.5"]
    assert "--p-correct" not in words
    observed = {"observer": {"efficiency": 0.5}, "p_correct": 0.8}
    by_answers = shlex.split(explorer.written(TomlAsked(TABLES_SENT, [4.0, 5.5], **observed))["command"])
    assert by_answers[-2:] == ["--p-correct", "0.8"] and by_answers[4] == "4,5.5"
    assert explorer.observed_by({"efficiency": 0.5}).settings == CsfSettings(aperture_sd_deg=0.5, efficiency=0.5)
    given_by_sd = Explorer(SENSOR, PyramidObserver(internal_noise_sd=0.1))
    assert given_by_sd.start()["observer"] == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--observer", "oriented", "--set", "complex_cells=true"], "observer: it is not linear; no curve"),
        (["--observer", "no_such"], "observer: unknown key 'no_such'"),
        (["--observer", "pyramid,csf"], "observer: found 'pyramid,csf', expected a single one here"),
        (["--observer", "csf", "--internal-noise", "0.5"], "settings: internal_noise is a setting of "),
        (["--p-correct", "0.2"], "settings: p_correct: found 0.2"),
        (["--k", "8"], "--k: is given but not used without --target"),
        (["--target", "nato"], "--atmosphere: is missing, expected it beside --target"),
        (["--target", "nato", "--atmosphere", "lwir_23km"], "--k: is missing, and star-like is a TOD"),
        (["--target", "natto", "--atmosphere", "lwir_23km"], "target: found 'natto'"),
        (["--host", "no-such-host.invalid"], "cannot listen at --host 'no-such-host.invalid'"),
    ],
)
def test_what_cannot_be_explored_is_one_line(capsys, options, message):
    assert run(cli, ["explore", str(CAMERA), "--no-browser", *options]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"error: {message}") and err.count("\n") == 1


def test_an_observer_may_be_adapted_to_the_display():
    """Each time to that of the request: the slider of the background moves the eye too."""
    seen = faked(SENSOR, CsfObserver(luminance_cd_m2="background"))
    assert "luminance_cd_m2" not in seen.start()["observer"]
    display = TABLES_SENT["display"] | {"background_luminance_cd_m2": 3.0}
    list(seen.curve(asked(1, sensor=TABLES_SENT | {"display": display}), lambda: True))
    assert seen._live.observers[-1].settings.luminance_cd_m2 == 3.0
    command = seen.written(TomlAsked(TABLES_SENT, [4.0], {"efficiency": 1.0}))["command"]
    assert 'luminance_cd_m2="background"' in shlex.split(command)
    seen.check()


def test_an_observer_that_no_process_can_get_is_refused():
    class Local(OrientedObserver):
        pass

    with pytest.raises(SettingsError, match=r"^observer: .*Local cannot be sent to the processes that compute"):
        Explorer(SENSOR, Local()).check()


def test_a_broken_file_gives_the_line_that_the_command_gives(tmp_path):
    for text in ("schema = 1", "schema = ", CAMERA.read_text(encoding="utf-8").replace("220.0", "-1.0")):
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        with pytest.raises(SettingsError, match=r"mine\.toml: ") as by_command:
            ss.load_sensor(tmp_path / "mine.toml")
        with pytest.raises(SettingsError, match=r"^mine\.toml: ") as by_page:
            routes.read(TextAsked(text, "mine.toml"))
        assert str(by_command.value) == str(tmp_path / str(by_page.value))


def weibull_points(level: float) -> list[tuple[float, float]]:
    """Seven points of a psychometric function with 75 % correct at a level: 1 − 0.75 · 3^−(x / level)^β."""
    return [(level * x, 1.0 - 0.75 * 3.0 ** -(x**1.5)) for x in 2.0 ** np.linspace(-1.0, 1.0, 7)]


def test_the_range_of_thresholds_is_the_closed_form():
    """ΔT = a exp(b / S) with S in mrad at the camera: R = ln(ΔT/a) / (σ + b k / size) at the curve's criterion."""
    camera, (a_k, b_mrad, k) = replace(SMALL, noise=replace(SMALL.noise, netd_mk=30.0)), (0.02, 0.3, 3.0)
    mk, pitch = float(delta_t_mk(1.0, noise=camera.noise)), camera.pitch_mrad
    snr = {size: 1e3 * a_k * math.exp(b_mrad / (size * pitch)) / mk for size in (16.0, 8.0, 4.0, 2.0)}
    known = [ThresholdSent(size, "ok", value, 0.01 * value, weibull_points(value)) for size, value in snr.items()]
    target = Target(size_m=2.3, delta_t_k=0.2, k={"seen": k})
    found = range_from(Aim(target, Atmosphere(extinction_per_km=0.2)), camera, known, 0.75)
    expected = math.log(0.2 / a_k) / (0.2 + b_mrad * k / 2.3)
    (middle,) = (one for one in found.numbers.ranges if one.probability == 0.75)
    assert middle.range_km == pytest.approx(expected, rel=1e-9)
    answer = range_answer(found)
    assert answer["ranges"][1]["words"] in found.sentences()[0] and "95 % interval" in found.sentences()[0]
    (shown,) = answer["curves"]
    assert len({len(shown[name]) for name in ("probability", "low", "is_bound", "range_km")}) == 1
    assert np.interp(0.75, shown["probability"][::-1], shown["range_km"][::-1]) == pytest.approx(
        expected, rel=1e-2
    )


def test_a_range_that_is_missing_has_its_reason_in_words():
    camera = replace(SMALL, noise=replace(SMALL.noise, netd_mk=30.0))
    sizes = ((6.0, 1.0), (5.0, 1.5), (4.0, 3.0))
    known = [ThresholdSent(size, "ok", snr, 0.01 * snr, weibull_points(snr)) for size, snr in sizes]
    never, uncertain = (ThresholdSent(3.0, status) for status in ("never_reached", "too_uncertain"))
    target_in_air = Aim(replace(find_target("nato"), k={"seen": 8.0}), find_atmosphere("lwir_23km"))
    faint = target_in_air._replace(target=replace(target_in_air.target, delta_t_k=1e-3))
    for aimed, last, words in (
        (target_in_air, never, r"at least [\d.]+ km and at most [\d.]+ km; it lies between the curve"),
        (target_in_air, uncertain, r"at least [\d.]+ km; the curve ends there, and the contrast still suffices"),
        (faint, never, "no range; the contrast limits it: it stays below all thresholds, however near$"),
    ):
        found = range_answer(range_from(aimed, camera, [*known, last], 0.75))
        assert re.match(words, found["ranges"][1]["words"])
    with pytest.raises(DataError, match="found thresholds at 1 sizes or frequencies, expected two or more"):
        range_from(target_in_air, camera, [known[0], never], 0.75)
    with pytest.raises(DataError, match=r"found thresholds in snr, expected .*; netd_mk in \[noise\] gives"):
        range_from(target_in_air, replace(camera, noise=replace(camera.noise, netd_mk=None)), known, 0.75)


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"optics": {**TABLES_SENT["optics"], "aperture_mm": -1}}, "optics.aperture_mm"),
        ({"optics": {**TABLES_SENT["optics"], "aperture_mm": "<b>"}}, "optics.aperture_mm"),
        ({"detector": {"pitch_mrad": 0.1, "width_mrad": 0.2}}, "detector.width_mrad"),
        ({"display": {**TABLES_SENT["display"], "pixels_per_detector": 1.5}}, "display.pixels_per_detector"),
        ({"optics": json.loads("[" * 200 + "]" * 200)}, None),
        ({"other": 1}, None),
    ],
)
def test_the_line_about_an_impossible_sensor_names_the_key(tables, key):
    with pytest.raises(SettingsError, match=r"^SENSOR\.toml: ") as found:
        Explorer(SENSOR).made(SensorAsked({**TABLES_SENT, **tables}))
    assert error_of(found.value)["key"] == key


def test_the_transfer_is_that_of_the_command():
    found, command = routes.transfer(SENSOR), ss.mtf(SENSOR)
    assert found["frequency_cyc_per_mrad"] == command.frequency_cyc_per_mrad
    assert found["nyquist_cyc_per_mrad"] == command.nyquist_cyc_per_mrad
    for name, key in {"presample": "pre_sample", "postsample": "post_sample"}.items():
        np.testing.assert_allclose(found[name], command.mtf[key], rtol=0.0, atol=5.1e-7)  # six decimals are sent


@pytest.mark.parametrize("level", [5e-324, 9e-7, 2e9])
def test_a_level_that_simulate_refuses_is_refused(level):
    with pytest.raises(msgspec.ValidationError, match=r"Expected `float` .= 1.*`\$\.level`"):
        msgspec.convert({"sensor": TABLES_SENT, "size_detectors": 3.0, "level": level, "seed": 1}, TrialAsked)


def test_the_pictures_are_the_seven_stages_of_one_trial():
    asked = TrialAsked(TABLES_SENT, 3.0, 4.0, 7)
    orientation = asked.trial().orientation
    made = trial_stages(SENSOR, SimulatedTrial((0, 0, 0), 3.0, 4.0, orientation), seed=7)
    found = routes.trial_pictures(asked, SENSOR)
    assert [one["name"] for one in found["stages"]] == list(made)
    told = json.dumps([one | {"pixels": ""} for one in found["stages"]])
    assert len(made) == 7 and orientation.value not in told
    for one, image in zip(found["stages"], made.values(), strict=True):
        grey = np.frombuffer(base64.b64decode(one["pixels"]), np.uint8).reshape(one["height"], one["width"])
        assert one["range"] == "−1.00 to 2.00 signal of a large triangle"
        shown = -1.0 + 3.0 / 255.0 * grey
        np.testing.assert_allclose(shown, np.clip(image, -1.0, 2.0), rtol=0.0, atol=1.5 / 255.0 + 1e-9)
    with pytest.raises(SettingsError, match=r"^found a trial of \d+ × \d+ pixels, too many to show; choose"):
        routes.trial_pictures(TrialAsked(TABLES_SENT, 200.0, 4.0, 7), SENSOR)


class FakeCurves:
    """Curves that come without computing; a test sees whether they are still wanted."""

    def __init__(self) -> None:
        self.is_wanted: list[Callable[[], bool]] = []
        self.levels: list[str] = []
        self.observers: list[Any] = []

    def curves(
        self,
        *sensor_observer_sizes: Any,
        p_correct: float,
        level: str,
        n_points: int,
        is_wanted: Callable[[], bool],
    ) -> Iterator[LiveCurve]:
        assert level in ("snr", "contrast") and n_points == 0
        self.levels.append(level)
        self.observers.append(sensor_observer_sizes[1])
        self.is_wanted.append(is_wanted)
        sizes = sensor_observer_sizes[2]
        reached = PredictedThreshold("ok", 2.0, 0.04, sizes[0], 8)
        never = PredictedThreshold("never_reached", size_detectors=sizes[1], n_phases=8)
        points = [CurvePoint(n, one, Shares(0.25, 0.5, 0.25), True) for n, one in enumerate((reached, never))]
        yield LiveCurve(tuple(points), 0.03, p_correct, True)


def faked(sensor: ss.Sensor = SENSOR, *observer: Any) -> Explorer:
    made = Explorer(sensor, *observer)
    made._live = FakeCurves()
    return made


def asked(sequence: int = 1, client: str = "page", **changed: Any) -> CurveAsked:
    settings = {"sensor": TABLES_SENT, "sizes_detectors": [2.0, 4.0], "client": client, "sequence": sequence}
    return CurveAsked(**settings | changed)


class Ladder(FakeCurves):
    """Thresholds of some sizes with their relative errors, and a status of the others."""

    def __init__(self, errors: dict[float, float], status: str) -> None:
        self.errors, self.status, self.asked = errors, status, list[tuple[float, ...]]()

    def curves(self, *sensor_observer_sizes: Any, n_points: int = 0, **_: Any) -> Iterator[LiveCurve]:
        sizes = sensor_observer_sizes[2]
        self.asked.append(tuple(sizes))
        found = [
            PredictedThreshold("ok", 2.0, 2.0 * self.errors[size], size)
            if size in self.errors
            else PredictedThreshold(self.status, size_detectors=size)
            for size in sizes
        ]
        points = [CurvePoint(n, one, Shares(0.2, 0.5, 0.3), True) for n, one in enumerate(found)]
        yield LiveCurve(tuple(points), 0.03, float(n_points), True)


@pytest.mark.parametrize(
    ("errors", "status", "alone", "with_target"),
    [
        # An estimate that is off by more than a tenth hardly has a threshold.
        ({5.0: 0.11, 6.0: 0.1, 8.0: 0.01}, "never_reached", [6, 8, 10, 12, 16], [5, 5.5, 6, 8, 10]),
        ({}, "always_exceeded", [1, 1.5, 2, 2.5, 3], [1, 1.5, 2, 2.5, 3]),
        ({}, "never_reached", [1, 1.5, 2, 2.5, 3], [1, 1.5, 2, 2.5, 3]),
    ],
)
def test_chosen_sizes_begin_with_the_first_that_is_surely_seen(errors, status, alone, with_target):
    target_in_air = Aim(find_target("nato"), find_atmosphere("lwir_23km"))
    for explorer, sizes, n_points in (
        (Explorer(SENSOR), alone, 0),
        (Explorer(SENSOR, target_in_air=target_in_air), with_target, 7),
    ):
        explorer._live = Ladder(errors, status)
        (line,) = explorer.curve(asked(sizes_detectors=None), lambda: True)
        assert [one["size_detectors"] for one in line["thresholds"]] == sizes
        assert line["seconds"] == n_points
        assert all(len(one) <= routes.TRIED_AT_ONCE for one in explorer._live.asked[:-1])


def test_a_newer_request_of_the_same_page_ends_the_one_before():
    explorer, connected = faked(), True

    def start(sequence: int, client: str) -> Callable[[], bool]:
        list(explorer.curve(asked(sequence, client), lambda: connected))
        return explorer._live.is_wanted[-1]

    first, other = start(1, "page"), start(1, "other")
    assert first() and other()
    third = start(3, "page")
    late = start(2, "page")
    assert [one() for one in (first, late, third, other)] == [False, False, True, True]
    with pytest.raises(SettingsError, match=r"p_correct: found 2\.0"):
        explorer.curve(asked(4, p_correct=2.0), lambda: True)
    assert not third()
    connected = False
    assert not other()


def test_a_line_has_each_threshold_in_its_units():
    (line,) = faked().curve(asked(7), lambda: True)
    assert (line["sequence"], line["stage"], line["is_last"]) == (7, "refined", True)
    reached, never = line["thresholds"]
    # Hogervorst et al. 2001, section 8.2: σ_dyn/σ_tot = 1.7496 for ratio 0.4 and 6 frames.
    mk = 2.0 * 16.0 / 1.7496
    # Six pixels of 0.25 mm at 350 mm; the angle of a pixel is that of its tangent to 1e-7.
    units = {"snr": 2.0, "snr_error": 0.04, "delta_t_mk": mk, "delta_t_error_mk": 0.02 * mk}
    units |= {"size_detectors": 2.0, "size_mrad": 2.0 * 0.0681, "size_mrad_eye": 2.0 * 6.0 * 250.0 / 350.0}
    assert {name: reached[name] for name in units} == pytest.approx(units, rel=1e-4)
    assert never["status"] == "never_reached"
    assert [never[name] for name in ("snr", "snr_error", "delta_t_mk", "delta_t_error_mk")] == [None] * 4
    assert (reached["contrast"], reached["contrast_error"]) == (None, None)


@pytest.mark.parametrize(
    ("sensor", "level"), [(SENSOR, "contrast"), (PHOTON, "snr")], ids=lambda one: str(one)[:8]
)
def test_a_threshold_contrast_has_no_other_unit(sensor, level):
    """Nor has that of a camera that counts photons, whose chain has the noise of its detectors."""
    explorer = faked(sensor)
    (line,) = explorer.curve(asked(7, sensor=sensor_settings(sensor), level=level), lambda: True)
    assert (explorer._live.levels, line["level"]) == ([level], "contrast")
    reached, never = line["thresholds"]
    assert (reached["contrast"], reached["contrast_error"]) == (2.0, 0.04)
    assert {one[name] for one in (reached, never) for name in ("snr", "delta_t_mk", "delta_t_error_mk")} == {None}
    assert line["limits"]["detector"] == 0.5 and line["limits"]["sentence"].startswith("Detector noise limits")


@pytest.mark.parametrize(
    ("keep_fill_factor", "moves", "expected"),
    [
        # NETD ∝ 1 / (aperture · width)²: 16 mK at 220 mm and .05 mrad.
        (False, {"optics.aperture_mm": 110.0}, {"noise.netd_mk": 64.0}),
        (False, {"detector.width_mrad": 0.025}, {"noise.netd_mk": 64.0, "detector.pitch_mrad": 0.1}),
        (True, {"detector.width_mrad": 0.1}, {"noise.netd_mk": 4.0, "detector.pitch_mrad": 0.2}),
        (True, {"detector.pitch_mrad": 0.04}, {"noise.netd_mk": 100.0, "detector.width_mrad": 0.02}),
        # What has moved by itself does not follow.
        (False, {"optics.aperture_mm": 110.0, "noise.netd_mk": 20.0}, {"noise.netd_mk": 20.0}),
        (True, {"detector.pitch_mrad": 0.08, "detector.width_mrad": 0.06}, {"detector.width_mrad": 0.06}),
        # Switched off since: the moves before were coupled.
        (False, {"optics.aperture_mm": 110.0, "noise.couple_netd": False}, {"noise.netd_mk": 64.0}),
    ],
)
def test_what_follows_a_move_is_the_closed_form(keep_fill_factor, moves, expected):
    before = copy.deepcopy(TABLES_SENT)
    before["detector"] = {"pitch_mrad": 0.1, "width_mrad": 0.05}
    before["noise"]["couple_netd"] = True
    after = copy.deepcopy(before)
    for key, value in moves.items():
        table, name = key.split(".")
        after[table][name] = value
    state = EXPLORER.state(TomlAsked(after, None, before=before, keep_fill_factor=keep_fill_factor))
    for key, value in ({key: value for key, value in moves.items() if value is not False} | expected).items():
        table, name = key.split(".")
        assert state["sensor"][table][name] == pytest.approx(expected.get(key, value), rel=1e-12), key
    impossible = before | {"optics": before["optics"] | {"aperture_mm": -1.0}}
    assert EXPLORER.state(TomlAsked(before, None, before=impossible))["sensor"] == before


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        # 15 µm per .0681 mrad are 220 mm, the aperture.
        (SENSOR, "f/1, focal length 220 mm, λF/d 0.27"),
        (PHOTON, "pitch 0.14 mrad, f/2.8, focal length 25 mm, λF/d 0.45"),
    ],
    ids=lambda one: str(one)[:8],
)
def test_the_optics_are_named_in_words(sensor, words):
    assert EXPLORER.state(TomlAsked(sensor_settings(sensor), None))["note"] == words


def test_a_line_has_its_numbers_in_words():
    (line,) = faked().curve(asked(7), lambda: True)
    assert line["line"] == "Refined: within 2 %, in 0.8 s"
    assert line["headers"] == ["Size (detectors)", "Size (mrad)", "At the eye (mrad)", "SNR", "ΔT (mK)"]
    assert line["rows"] == [
        ["2", "0.1362", "8.571", "2.00 ± 0.04", "18.3 ± 0.4"],
        ["4", "0.2724", "17.14", "never reached", "never reached"],
    ]
    assert line["missing"] == {"detectors": "× Never reached: 4 detectors", "mrad": "× Never reached: 0.2724 mrad"}
    assert line["summary"] == "Threshold SNR at 2 detectors: 2; 4 detectors: never reached."
    assert [number_text(one) for one in (-0.5, 9e-6, 12345.6, 2e7)] == ["−0.5", "0.000009", "12350", "20000000"]
    assert [percent_at_most(one) for one in (0.0013, 0.03, 0.0301)] == ["0.2 %", "3 %", "4 %"]


def test_what_cannot_be_asked_is_refused_with_its_key():
    for wrong, key in (
        ({"sizes_detectors": [2.0, 2.0]}, None),
        ({"observer": {"internal_noise": -1.0}}, "observer.internal_noise"),
        ({"observer": {"noise": 1.0}}, None),
    ):
        with pytest.raises(SettingsError, match=r"found|unknown key") as found:
            faked().curve(asked(**wrong), lambda: True)
        assert error_of(found.value)["key"] == key
    with pytest.raises(SettingsError, match=r"target: needs noise\.netd_mk of the sensor"):
        ss.explore(replace(SENSOR, noise=Noise()), target="nato", atmosphere="mwir_5km", open_browser=False)


def test_a_server_that_others_can_reach_says_so(monkeypatch):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plug:
        try:
            plug.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this machine has no network")
        host = plug.getsockname()[0]
    monkeypatch.setattr(server.asyncio, "run", lambda coroutine: coroutine.close())
    said: list[str] = []
    for where in (host, "127.0.0.1"):
        ss.explore(SENSOR, host=where, open_browser=False, tell=print, warn=said.append)
    (line,) = said
    assert line.startswith(f"note: other machines can reach http://{host}:")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize("number", SIGNALS, ids=lambda one: one.name)
def test_the_server_ends_with_its_terminal(number):
    command = [sys.executable, "-m", "sensor_sim", "explore", str(CAMERA), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        found = re.fullmatch(r"http://(127\.0\.0\.1:\d+)/\?token=([\w-]{43})\n", process.stdout.readline())
        address, token = found.groups()
        connection = http.client.HTTPConnection(address, timeout=30.0)
        body = {"sensor": TABLES_SENT, "sizes_detectors": [2, 3, 4, 6, 8, 12, 16], "client": "a", "sequence": 1}
        headers = {"X-Token": token, "Content-Type": "application/json"}
        connection.request("POST", "/api/curve", json.dumps(body), headers)
        time.sleep(0.3)  # the curve is being computed
        process.send_signal(number)
        out, err = process.communicate(timeout=30.0)
        with suppress(ConnectionError, http.client.HTTPException):
            connection.getresponse().read()
        connection.close()
    assert (process.returncode, out, err) == (0, "", "")
