"""Sweeps: the numbers of `curve` for each design, ranges and files of designs, acuity, trade-off front, output."""

from __future__ import annotations

import csv
import json
import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from conftest import error_line

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import resolve
from sensor_sim.chain.measured import MeasuredPsf
from sensor_sim.chain.sensor import TABLES, Noise, Optics, PhotonNoise, part_of, sensor_from
from sensor_sim.chain.vary import numeric_keys, value_of, vary
from sensor_sim.sweeps.designs import (
    Base,
    Designs,
    SweepWork,
    Swept,
    grid,
    latin_hypercube,
    make_designs,
    run_sweep,
)
from sensor_sim.sweeps.goals import Aim, acuity, columns_of, front, objectives
from sensor_sim.sweeps.sweep import missed_tolerance
from sensor_sim.thresholds.curve_plan import PARTS, PartCache
from sensor_sim.thresholds.predict import PredictedThreshold
from todframes.base.errors import SettingsError
from todframes.jobs.rows import Rows
from todframes.jobs.run import Run
from todframes.observers.pyramid import PyramidObserver, PyramidSettings

CAMERA = Path(__file__).parents[2] / "sample_frames" / "staring_camera.toml"
KNOWN = Base(ss.load_sensor(CAMERA), PyramidSettings(), False).keys
ROUGH = 0.1
"""Tolerance of thresholds that are compared with each other and not with the truth."""


def small_camera() -> ss.Sensor:
    """A camera whose triangles are a few retina samples wide, which takes the least time."""
    camera = ss.load_sensor(CAMERA)
    display = replace(camera.display, pixels_per_detector=2, blur_sigma_px=0.5)
    return replace(camera, display=display)


@pytest.fixture(scope="module")
def swept():
    vary = {
        "optics.aperture_mm": [60.0, 220.0],
        "noise.netd_mk": [10.0, 40.0],
        "observer.internal_noise": [0.2, 0.5],
    }
    return ss.sweep(
        small_camera(),
        size_detectors=[4, 7],
        vary=vary,
        tolerance=ROUGH,
        minimise=["delta_t_mk", "optics.aperture_mm"],
        acuity_delta_t_mk=50.0,
    )


def test_numbers_are_those_of_the_curve(swept) -> None:
    """To the last bit, whatever designs share: every key was in use by a neighbour."""
    camera = small_camera()
    rows = list(swept.records())
    for design in (0, 3, 6):
        aperture, netd, noise = swept.values[design]
        alone = ss.curve(
            replace(
                camera,
                optics=replace(camera.optics, aperture_mm=aperture),
                noise=replace(camera.noise, netd_mk=netd),
            ),
            size_detectors=[4, 7],
            observer=tod.PyramidObserver(internal_noise=noise),
            tolerance=ROUGH,
            examples=False,
        )
        for fit, row in zip(alone.fits, rows[2 * design : 2 * design + 2], strict=True):
            assert row["design"] == design + 1
            assert row["size_detectors"] == fit.group["size_detectors"]
            assert row["threshold_snr"] == fit.threshold
            assert row["threshold_snr_error"] == fit.threshold_numerical_error
            assert row["delta_t_mk"] == fit.delta_t_mk
            assert (row["status"], row["n_phases"]) == (fit.status, fit.n_phases)


def test_thresholds_that_miss_the_tolerance_are_counted() -> None:
    exact = [PredictedThreshold("ok", 2.0, 2e-3), PredictedThreshold("never_reached")]
    assert missed_tolerance(Swept([], [exact, exact], 4), ROUGH) == ()
    (warning,) = missed_tolerance(Swept([], [exact, [PredictedThreshold("ok", 4.0, 1.2)]], 3), ROUGH)
    assert "1 threshold misses the tolerance of 10 %: the numerical error is up to 30 %" in warning.message
    assert (warning.found, warning.expected) == (pytest.approx(0.3), ROUGH)


def test_designs_that_differ_in_noise_alone_are_computed_once(swept) -> None:
    assert swept.n_computed == 8  # 2 apertures × 2 observers × 2 sizes, for 8 designs
    rows = list(swept.records())
    for one, other in zip(rows[0:4], rows[4:8], strict=True):  # NETD 10 and 40 mK
        assert one["threshold_snr"] == other["threshold_snr"]
        assert other["delta_t_mk"] == pytest.approx(4.0 * one["delta_t_mk"], rel=1e-14)


def test_memory_and_order_change_no_number(monkeypatch) -> None:
    camera = small_camera()
    base = Base(camera, PyramidSettings(), keep_fill_factor=True)
    designs = grid({"detector.pitch_mrad": [0.08, 0.1], "display.blur_sigma_px": [0.4, 0.8]}, base.keys)
    found = []
    for shared_mb, order in ((0, 1), (1, 1), (512, -1)):
        monkeypatch.setattr(PARTS, "most_bytes", shared_mb * 2**20)
        work = SweepWork(observer=PyramidObserver(), p_correct=0.75, tolerance=ROUGH, seed=1)
        turned = designs._replace(values=designs.values[::order])
        thresholds = run_sweep(base, turned, [4.0], work, Run()).thresholds
        found.append([one.threshold for (one,) in thresholds][::order])
    assert None not in found[0] and found[0] == found[1] == found[2]


@pytest.mark.slow
def test_processes_and_a_store_change_no_number(swept, tmp_path: Path) -> None:
    camera, vary = small_camera(), {"optics.aperture_mm": [60.0, 220.0], "noise.netd_mk": [10.0, 40.0]}
    store = Rows(tmp_path / "store", "OUT")
    arguments = {"size_detectors": [4, 7], "vary": vary, "tolerance": ROUGH, "store": store}
    one = ss.sweep(camera, workers=2, **arguments)
    again = ss.sweep(camera, **arguments)
    assert store.n_used == 4
    for result in (one, again):
        for name in ("threshold_snr", "threshold_snr_error"):
            assert np.array_equal(result.column(name), swept.column(name)[1::2])


def test_impossible_designs_have_a_reason_and_the_others_go_on() -> None:
    vary = {"detector.pitch_mrad": [0.05, 0.0681], "optics.blur_sigma_mrad": [0.01, 30.0]}
    result = ss.sweep(small_camera(), size_detectors=[4], vary=vary, tolerance=ROUGH)
    assert result.column("status")[:, 0].tolist() == ["impossible", "impossible", "ok", "impossible"]
    reasons = result.column("reason")[:, 0].tolist()
    assert reasons[0] == (
        "detector.width_mrad: found 0.0681, expected at most pitch_mrad (0.05); "
        "with keep_fill_factor the width follows the pitch"
    )
    assert reasons[3].startswith("sensor: optics, motion and air blur by 30 mrad, expected at most ")
    assert "3 designs cannot be made or computed" in " ".join(result.sentences())


def test_width_follows_the_pitch() -> None:
    camera = replace(ss.load_sensor(CAMERA), detector=ss.Detector(pitch_mrad=0.1, width_mrad=0.08))
    kept = Base(camera, PyramidSettings(), keep_fill_factor=True)
    free = Base(camera, PyramidSettings(), keep_fill_factor=False)
    assert kept.design({"detector.pitch_mrad": 0.05})[0].width_mrad == pytest.approx(0.04)
    assert free.design({"detector.pitch_mrad": 0.2})[0].width_mrad == 0.08
    both = free.design({"detector.pitch_mrad": 0.05, "detector.fill_factor": 0.81})[0].detector
    assert both.width_mrad == pytest.approx(0.9 * 0.05)
    assert kept.design({"detector.pitch_mrad": 0.2, "detector.width_mrad": 0.1})[0].width_mrad == 0.1
    with pytest.raises(SettingsError, match=r"detector.fill_factor: found 1.2, expected a number above 0 and at"):
        free.design({"detector.fill_factor": 1.2})
    of_sd = replace(free, observer_settings=PyramidSettings(internal_noise_sd=0.1))
    for changes, sd in (({"observer.levels": 4}, 0.1), ({"observer.internal_noise": 0.3}, None)):
        assert dict(of_sd.design(changes)[2]).get("internal_noise_sd", 0.1) == sd


def test_grid_varies_the_last_key_fastest() -> None:
    designs = grid({"optics.aperture_mm": "50:200:4", "noise.frames_integrated": "1:16:5:log"}, KNOWN)
    assert designs.values[:6].tolist() == [[50, 1], [50, 2], [50, 4], [50, 8], [50, 16], [100, 1]]
    assert len(designs.values) == 20
    logarithmic = grid({"optics.blur_sigma_mrad": "0.01:0.04:3:log"}, KNOWN)
    assert logarithmic.values[:, 0] == pytest.approx([0.01, 0.02, 0.04])
    assert len(grid({"optics.aperture_mm": "1:2:100000"}, KNOWN).values) == 100_000


def test_latin_hypercube_has_one_design_in_each_part() -> None:
    vary = {"optics.aperture_mm": "50:250", "noise.netd_mk": "1:100:log", "noise.frames_integrated": "1:4"}
    designs = latin_hypercube(vary, KNOWN, n=40, seed=3)
    parts = np.floor((designs.values[:, 0] - 50.0) / 200.0 * 40)
    assert sorted(parts) == list(range(40))
    parts = np.floor(np.log10(designs.values[:, 1]) / 2.0 * 40)
    assert sorted(parts) == list(range(40))
    assert np.unique(designs.values[:, 2], return_counts=True)[1].tolist() == [10] * 4
    assert np.array_equal(designs.values, latin_hypercube(vary, KNOWN, n=40, seed=3).values)
    assert not np.array_equal(designs.values, latin_hypercube(vary, KNOWN, n=40, seed=4).values)


VARIED = ("--vary", "noise.netd_mk=1:3:3")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "sweep: found nothing to vary"),
        (("--vary", "optics.aperture=50:200:7"), "unknown key 'optics.aperture'; the nearest valid one is 'opti"),
        (("--vary", "observer.internalnoise=0:1:3"), "the nearest valid one is 'observer.internal_noise'"),
        (("--vary", "noise.distribution=1:2:2"), "unknown key 'noise.distribution'"),
        (("--vary", "optics.aperture_mm"), "--vary: found 'optics.aperture_mm', expected KEY=FROM:TO:N"),
        (("--vary", "optics.aperture_mm=50:200"), "expected a number of values N"),
        *(
            (
                ("--vary", f"optics.aperture_mm={text}"),
                f"found '{text}', expected FROM:TO:N or FROM:TO:N:log, such as",
            )
            for text in ("5:5:3", "9:5:3", "0:5:3:log", "1:5:1", "1:5:0", "1:5:2.5", "nan:5:3", "1:2:3:4")
        ),
        (("--vary", "optics.aperture_mm=1:2:2000000"), "designs: found 2000000, expected at most 100000"),
        (("--vary", "noise.frames_integrated=1:3:7"), "some values are the same whole number"),
        ((*VARIED, *VARIED), "found noise.netd_mk twice"),
        ((*VARIED, "--minimise", "delta_t_mk", "--maximise", "delta_t_mk"), "found a column twice"),
        ((*VARIED, "--sample", "4"), "N is that of the sample"),
        ((*VARIED, "--minimise", "netd"), "minimise: unknown key 'netd'"),
        ((*VARIED, "--minimise", "acuity_mrad"), "needs an SNR or ΔT for the acuity"),
        ((*VARIED, "--acuity-snr", "-1"), "acuity_snr: found -1.0, expected a finite number"),
        ((*VARIED, "--acuity-snr", "1", "--acuity-delta-t-mk", "5"), "acuity: found an SNR and a ΔT, expected"),
        ((*VARIED, "--target", "nato"), "--atmosphere: is missing, expected it beside"),
        ((*VARIED, "--k", "3"), "k: is given but not used without"),
        ((*VARIED, "--maximise", "range_km"), "found range_km, which needs"),
        ((*VARIED, "--tolerance", "0"), "tolerance: found 0.0, expected a finite number"),
        ((*VARIED, "--observer", "oriented", "--set", "complex_cells=true"), "it is not linear"),
        (
            ("--vary", "detector.width_mrad=1:2:2", "--vary", "detector.fill_factor=0.5:1:2"),
            "found detector.fill_factor and detector.width_mrad, expected one of them",
        ),
    ],
)
def test_bad_commands_give_one_line(sensor_sim, arguments: tuple[str, ...], expected: str) -> None:
    assert expected in error_line(sensor_sim("sweep", CAMERA, "--size-detectors", "4", *arguments))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("optics.aperture_mm\n", "found no design, expected a row for each"),
        ("optics.aperture\n5\n", "unknown key 'optics.aperture'; the nearest valid one is 'optics.aperture_mm'"),
        ("optics.aperture_mm\nlarge\n", "line 2: optics.aperture_mm: found 'large', expected a finite number"),
        ("noise.frames_integrated\n2.5\n", "line 2: noise.frames_integrated: found '2.5', expected a whole"),
        ("optics.aperture_mm,noise.netd_mk\n5\n", "line 2: found 1 fields, expected 2"),
        ("name\nbest\n", "found no key"),
    ],
)
def test_bad_files_of_designs_give_one_line(sensor_sim, tmp_path: Path, content: str, expected: str) -> None:
    path = tmp_path / "designs.csv"
    path.write_text(content)
    line = error_line(sensor_sim("sweep", CAMERA, "--size-detectors", "4", "--design", path), status=1)
    assert line.startswith(f"error: {path}")
    assert expected in line


def test_acuity_of_a_power_law_is_exact() -> None:
    """Thresholds c · size⁻² meet the level l at √(c/l); a relative error e of both shifts it by e/2."""
    size, c, level = np.array([8.0, 2.0, 4.0]), 24.0, 3.0
    threshold = c / size**2
    found = acuity(size, threshold, 0.02 * threshold, ["ok"] * 3, level)
    assert found.status == "ok"
    assert found.detectors == pytest.approx(math.sqrt(c / level), rel=1e-12)
    assert found.error == pytest.approx(0.01 * found.detectors, rel=1e-12)


@pytest.mark.parametrize(
    ("threshold", "status", "expected"),
    [
        ([9.0, 8.0], ["ok", "ok"], "never_reached"),
        ([2.0, 1.0], ["ok", "ok"], "always_exceeded"),
        ([math.nan, 1.0], ["never_reached", "ok"], "too_few_sizes"),
        ([math.nan, 1.0], ["impossible", "ok"], "too_few_sizes"),
        ([9.0, math.nan], ["ok", "impossible"], "too_few_sizes"),
        ([math.nan, math.nan], ["never_reached", "never_reached"], "never_reached"),
        ([9.0, math.nan], ["ok", "always_exceeded"], "too_few_sizes"),
    ],
)
def test_acuity_is_never_extrapolated(threshold: list[float], status: list[str], expected: str) -> None:
    found = acuity(np.array([2.0, 4.0]), np.array(threshold), np.zeros(2), status, 3.0)
    assert found.status == expected
    assert math.isnan(found.detectors)


def of_netd(netd_mk: float) -> SimpleNamespace:
    return SimpleNamespace(noise=SimpleNamespace(netd_mk=netd_mk))


def test_columns_of_a_sweep_by_hand() -> None:
    """ΔT = a exp(b / S) with S in mrad at the camera; the range is ln(ΔT / a) / (extinction + b k / size)."""
    sizes, pitch, mk = (
        np.array([2.0, 16.0, 8.0, 4.0]),
        np.array([0.1, 0.2, np.nan]),
        np.array([50.0, 20.0, np.nan]),
    )
    a_mk = np.array([20.0, 22.0, np.nan])
    threshold = (a_mk / mk)[:, None] * np.exp(0.3 / (pitch[:, None] * sizes))
    n_phases = [[8] * 4, [0] + [8] * 3]
    designs = Designs(
        ("optics.aperture_mm", "noise.frames_integrated"),
        np.array([[9.0, 1], [8.0, 2], [7.0, 4]]),
        ("a", "b", "c"),
    )
    known = zip(threshold.tolist(), n_phases, strict=False)
    rows = [
        [PredictedThreshold("ok", t, 0.01 * t, n_phases=n) for t, n in zip(*row, strict=True)] for row in known
    ]
    rows.append([PredictedThreshold("impossible", reason="too wide")] * 4)
    parts = zip(pitch[:2].tolist(), mk[:2].tolist(), strict=True)
    made = [(of_netd(2.0 * snr), SimpleNamespace(pitch_mrad=mrad, mk_per_snr=snr), ()) for mrad, snr in parts]
    swept = Swept([*made, "too wide"], rows, 8)
    goals = objectives(["optics.aperture_mm"], ["range_km"], designs.keys, level="snr", needs={})
    columns = columns_of(
        designs, swept, goals, sizes=sizes, level="snr", acuity_snr=None, acuity_delta_t_mk=25.0,
        target_in_air=Aim(*WARM.values()), p_correct=0.75, couple_netd=True, whole_keys=[designs.keys[1]],
    )  # fmt: skip
    none = [None] * 4
    delta_t = (threshold[:2] * mk[:2, None]).ravel().tolist()
    # A straight line between logarithms of sizes by factors of 2 is off by some percent.
    acuity_mrad = np.repeat(0.3 / np.log(25.0 / a_mk[:2]), 4)
    km = np.repeat(np.log(200.0 / a_mk[:2]) / (0.2 + 0.3 / 4.0), 4)
    curves = {
        "range_km": km,
        "acuity_mrad": acuity_mrad,
        "acuity_detectors": acuity_mrad / np.repeat(pitch[:2], 4),
    }
    expected = {
        "design": np.repeat([1, 2, 3], 4).tolist(),
        "name": [*"aaaabbbbcccc"],
        "optics.aperture_mm": [9.0] * 4 + [8.0] * 4 + [7.0] * 4,
        "noise.frames_integrated": [1] * 4 + [2] * 4 + [4] * 4,
        "netd_mk": [100.0] * 4 + [40.0] * 4 + none,
        "size_detectors": sizes.tolist() * 3,
        "size_scene_mrad": [*(0.1 * sizes), *(0.2 * sizes), *none],
        "status": ["ok"] * 8 + ["impossible"] * 4,
        "threshold_snr": [*threshold[:2].ravel(), *none],
        "threshold_snr_error": [*(0.01 * threshold[:2]).ravel(), *none],
        "delta_t_mk": [*delta_t, *none],
        "delta_t_mk_error": [*(0.01 * np.array(delta_t)), *none],
        "range_at_least_km": [None] * 12,
        "range_status": ["ok"] * 8 + ["impossible"] * 4,
        "on_front": [True] * 8 + [False] * 4,
        "n_phases": [8] * 4 + [None] + [8] * 3 + none,
        "reason": [None] * 8 + ["too wide"] * 4,
    }
    for name, values in expected.items():
        numbers = [value for value in columns[name] if isinstance(value, float)]
        assert [value is None for value in columns[name]] == [value is None for value in values], name
        if numbers:
            assert numbers == pytest.approx([value for value in values if value is not None], rel=1e-12), name
        else:
            assert columns[name] == values, name
    for name, numbers in curves.items():
        assert columns[name] == [*(pytest.approx(number, rel=0.08) for number in numbers), *none], name
    assert columns["acuity_status"] == ["ok"] * 8 + ["impossible"] * 4
    made = [
        (sensor, SimpleNamespace(pitch_mrad=camera.pitch_mrad, mk_per_snr=None), ()) for sensor, camera, _ in made
    ]
    in_contrast = [
        [replace(one, threshold=one.threshold * mk_per_snr / 1000.0) for one in row]
        for row, mk_per_snr in zip(rows, mk[:2].tolist(), strict=False)
    ]
    in_contrast = Swept([*made, "too wide"], [*in_contrast, rows[2]], 8)
    target_in_air = Aim(replace(WARM["target"], delta_t_k=None, contrast=0.2), AIR)
    asked: dict[str, Any] = {"p_correct": 0.75, "couple_netd": False, "whole_keys": []}
    asked |= {"acuity_snr": None, "acuity_delta_t_mk": None, "sizes": sizes, "level": "contrast"}
    of_photons = columns_of(designs, in_contrast, goals, target_in_air=target_in_air, **asked)
    assert of_photons["range_km"] == columns["range_km"] and "delta_t_mk" not in of_photons
    others = {"acuity_status", "acuity_detectors_error", "acuity_mrad_error"}
    assert set(columns) == {*expected, *curves, *others}


def test_front_is_what_no_row_dominates() -> None:
    rng = np.random.default_rng(5)
    costs = rng.integers(0, 12, (200, 3)).astype(float)
    costs[::17, 1] = np.nan
    on = front(costs)
    for k, row in enumerate(costs):
        dominated = ((costs <= row).all(axis=1) & (costs < row).any(axis=1)).any()
        assert on[k] == (np.isfinite(row).all() and not dominated)
    assert 0 < on.sum() < 200


def test_kept_values_stay_within_their_bytes() -> None:
    made: list[int] = []

    def value(key: int) -> np.ndarray:
        return kept.get(key, lambda: made.append(key) or np.zeros(1000))  # 8 kB, and 1 kB for the key

    kept = PartCache(18_000)
    for key in (1, 2, 1, 3, 1, 2):
        value(key)
    assert made == [1, 2, 3, 2]  # 2 made room for 3, as 1 was used after it
    assert len(PartCache(100).get(1, lambda: np.zeros(1000))) == 1000


def test_output(swept, tmp_path: Path) -> None:
    swept.save(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        *("sweep.csv", "result.json", "report.html", "best.csv", "front.png", "map.png", "tod_curves.png")
    }
    with (tmp_path / "out" / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = json.loads((tmp_path / "out" / "result.json").read_text())["columns"]
    records = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    assert len(rows) == len(records) == 16
    for row, record, made in zip(rows, records, swept.records(), strict=True):
        assert record == made
        assert {key: value for key, value in row.items() if value} == {
            key: json.dumps(value) if not isinstance(value, str) else value
            for key, value in record.items()
            if value is not None
        }
    assert rows[0]["acuity_status"] in ("ok", "never_reached", "always_exceeded")
    assert float(rows[2]["size_scene_mrad"]) == pytest.approx(4 * 0.0681)


def test_one_key_and_one_size_have_a_line() -> None:
    designs = [{"noise.netd_mk": 10.0}, {"noise.netd_mk": 20.0}]
    result = ss.sweep(small_camera(), size_detectors=[5], design=designs, tolerance=ROUGH)
    for draw, message in (
        (result.plot_map, "plot_map: found one key that varies"),
        (result.plot_front, "plot_front: found one column"),
        (result.plot_tod, "plot_tod: found no design with thresholds at two or more sizes"),
        (result.plot_range_map, "plot_range_map: found no range, expected a target and an atmosphere, and smal"),
    ):
        with pytest.raises(tod.DataError, match=message):
            draw()


def test_the_netd_follows_aperture_and_detectors_where_it_is_coupled() -> None:
    """Half the aperture, or half the width, is a quarter of the light on a detector: four times the NETD."""
    vary = {"optics.aperture_mm": [110.0, 220.0], "detector.pitch_mrad": [0.03405, 0.0681]}
    asked: dict[str, Any] = {"size_detectors": [6], "vary": vary, "tolerance": ROUGH, "keep_fill_factor": True}
    free = ss.sweep(small_camera(), **asked)
    coupled = ss.sweep(small_camera(), **asked, couple_netd=True, minimise=["delta_t_mk", "optics.aperture_mm"])
    np.testing.assert_allclose(coupled.column("netd_mk")[:, 0], [256.0, 64.0, 64.0, 16.0], rtol=1e-12)
    np.testing.assert_array_equal(coupled.column("threshold_snr"), free.column("threshold_snr"))
    factor = coupled.column("delta_t_mk") / free.column("delta_t_mk")
    np.testing.assert_allclose(factor[:, 0], [16.0, 4.0, 4.0, 1.0], rtol=1e-12)
    assert "netd_mk" not in next(free.records())
    assert "NETD (mK)" in [one.heading for one in coupled.best().columns]
    hint = "The NETD is the same for all apertures and detectors"
    assert hint in " ".join(free.sentences()) and hint not in " ".join(coupled.sentences())
    # The front went for the narrowest detector: it is the one of lowest ΔT per aperture only without the coupling.
    best = [row["detector.pitch_mrad"] for row in coupled.records() if row["on_front"]]
    assert best == [0.0681, 0.0681]


VARIED = {
    "optics.aperture_mm": (110.0, 4.0),
    "detector.width_mrad": (0.03405, 4.0),
    "detector.fill_factor": (0.25, 4.0),
    "noise.netd_mk": (32.0, 2.0),
    "display.gain": (2.0, 1.0),
}


@pytest.mark.parametrize("keys", [(key,) for key in VARIED] + [("optics.aperture_mm", "noise.netd_mk")])
def test_what_is_varied_wins_and_the_netd_follows_the_light(keys: tuple[str, ...]) -> None:
    """NETD ∝ 1 / (aperture · width)², unless it is varied itself; and the way back leads to the same sensor."""
    coupled = replace(small_camera(), noise=replace(small_camera().noise, couple_netd=True))
    values = {key: VARIED[key][0] for key in keys}
    factor = VARIED["noise.netd_mk" if "noise.netd_mk" in keys else keys[0]][1]
    varied = vary(coupled, values)
    assert varied.noise.netd_mk == pytest.approx(16.0 * factor, rel=1e-12)
    assert all(value_of(varied, key) == pytest.approx(value, rel=1e-12) for key, value in values.items())
    assert vary(small_camera(), values).noise.netd_mk == (32.0 if "noise.netd_mk" in keys else 16.0)
    found = ss.sweep(coupled, size_detectors=[6], design=[values], tolerance=ROUGH)
    assert found.column("delta_t_mk")[0, 0] == pytest.approx(
        ss.curve(varied, size_detectors=[6], tolerance=ROUGH).thresholds[0].delta_t_mk, rel=1e-12
    )


def test_a_width_that_is_the_pitch_has_its_value() -> None:
    on_chip = cameras()["thermal in motion"]
    assert on_chip.detector.width_um is None
    assert (value_of(on_chip, "detector.width_um"), value_of(on_chip, "detector.fill_factor")) == (3.45, 1.0)
    assert value_of(vary(on_chip, {"detector.width_um": 2.0}), "detector.pitch_um") == 3.45


def test_nothing_is_said_of_the_netd_where_the_light_is_the_same_or_the_netd_varies() -> None:
    for values in (
        {"detector.pitch_mrad": [0.0681, 0.07]},
        {"optics.aperture_mm": [220.0], "noise.netd_mk": [16.0, 20.0]},
    ):
        result = ss.sweep(small_camera(), size_detectors=[6], vary=values, tolerance=ROUGH)
        assert "couple_netd" not in " ".join(result.sentences())


def cameras() -> dict[str, ss.Sensor]:
    """Sensors that together have every number of a SENSOR.toml, with two ways of light and of lengths."""
    asked: dict[str, Any] = {"focal_length_mm": 25, "f_number": 2.8, "pitch_um": 3.45}
    text = ss.new_sensor(preset="emva_basler", **asked)
    in_lux = re.sub("(?m)^luminance_cd_m2 = .*", "illuminance_lx = 300.0\nreflectance = 0.5", text)
    in_motion = ss.new_sensor(thermal=True, netd_mk=50, **asked) + "[motion]\nsmear_mrad = 0.1\n"
    in_motion = re.sub("(?m)^fixed_pattern_ratio = .*", "fixed_pattern_ratio = 0.3", in_motion)
    by_psf = MeasuredPsf(file="psf.tif", shape=(3, 3), data=np.full(9, 1 / 9).tobytes())
    made = [sensor_from(tomllib.loads(one), "") for one in (text, in_lux, in_motion)]
    optics = Optics(wavelength_um=0.55, aperture_mm=8.0, focal_length_mm=25.0, psf=by_psf, psf_pitch_um=1.0)
    with_psf = [replace(made[0], optics=optics)]
    with_psf.append(replace(made[0], optics=replace(optics, psf_pitch_um=None, psf_pitch_mrad=0.04)))
    names = ["photons", "photons in lux", "thermal in motion", "PSF on the chip", "PSF as an angle", "2001"]
    return dict(zip(names, [*made, *with_psf, small_camera()], strict=True))


def test_the_cameras_have_every_number_of_a_sensor() -> None:
    found = {key for camera in cameras().values() for key in numeric_keys(camera)}
    assert found == {
        key
        for table, kind in [*TABLES.items(), ("noise", PhotonNoise)]
        for key, hint in ((f"{table}.{name}", hint) for name, hint in get_type_hints(kind).items())
        if {int, float} & {hint, *get_args(hint)}
    } | {"detector.fill_factor"}


@pytest.mark.parametrize("name", cameras())
def test_every_number_of_a_sensor_can_be_varied(name: str, tmp_path: Path) -> None:
    """By `vary` and as a column of a file of designs; and thresholds are computed anew for all but a few."""
    camera = cameras()[name]
    base = Base(camera, None, False)
    usual = {"detector.width_um": 3.0, "detector.pitch_mrad": 0.08, "detector.fill_factor": 0.5}
    usual["scene.photons_per_lux_s_um2"] = 4000.0
    without_effect = {"display.background_luminance_cd_m2"}
    if camera.photons is None:  # a threshold in SNR does not depend on the noise
        without_effect |= {f"noise.{name}" for name in ("netd_mk", "fixed_pattern_ratio", "frames_integrated")}
    for key, is_whole in base.keys.items():
        table, _, setting = key.partition(".")
        before = getattr(getattr(camera, part_of(table, camera)), setting, None)
        if before is None and key not in usual:
            continue  # another camera has it
        value = usual.get(key) or (before + 1 if is_whole else 0.9 * before or 0.01)
        designs = make_designs(base, vary={key: [value]}, design=None, sample=None, seed=1)
        (tmp_path / "designs.csv").write_text(f"name,{key}\nbest,{value!r}\n")
        of_file = make_designs(base, vary=None, design=tmp_path / "designs.csv", sample=None, seed=1)
        assert of_file.keys == designs.keys == (key,) and of_file.values.tolist() == designs.values.tolist()
        assert (of_file.names, designs.names) == (("best",), None)
        made, *_ = base.design({key: value})
        if key != "detector.fill_factor":
            assert getattr(getattr(made, part_of(table, camera)), setting) == value
        assert (resolve(made) == resolve(camera)) == (key in without_effect), key


def test_what_electrons_or_angles_replace_changes_no_threshold() -> None:
    """The quantum efficiency and the light where electrons are given, the focal length where angles are."""
    photons = cameras()["photons"]
    counted = replace(photons, scene=ss.Scene(background_electrons=500.0, luminance_cd_m2=3.0))
    in_angles = replace(small_camera(), optics=replace(small_camera().optics, focal_length_mm=300.0))
    for camera, key, value, is_idle in (
        (counted, "noise.quantum_efficiency", 0.2, True),
        (counted, "scene.luminance_cd_m2", 5.0, True),
        (counted, "scene.background_electrons", 400.0, False),
        (counted, "optics.focal_length_mm", 30.0, False),  # the pitch is a length on the chip
        (photons, "noise.quantum_efficiency", 0.2, False),
        (in_angles, "optics.focal_length_mm", 30.0, True),
    ):
        varied, known = resolve(vary(camera, {key: value})), resolve(camera)
        assert ((varied, varied.mk_per_snr) == (known, known.mk_per_snr)) is is_idle, key
    curves = [ss.curve(one, size_detectors=[6], tolerance=ROUGH) for one in (in_angles, small_camera())]
    assert curves[0].thresholds[0].threshold == curves[1].thresholds[0].threshold


@pytest.mark.parametrize(
    ("sizes", "advice"),
    [
        ("1,6", "there is one at 6 detectors: name such a size first"),
        pytest.param("1", "take larger sizes", marks=pytest.mark.slow),
    ],
)
def test_designs_without_a_threshold_at_the_first_size_have_the_reason(sensor_sim, sizes, advice) -> None:
    arguments = ["--vary", "noise.netd_mk=10:20:2", "--size-detectors", sizes, "--tolerance", ROUGH]
    status, out, _ = sensor_sim("sweep", CAMERA, *arguments)
    assert status == 0 and "Best designs" not in out and "hide its direction, even without noise" in out
    assert f"No design has a threshold ΔT at 1 detectors, which orders designs; {advice}." in out


NETD: dict[str, Any] = {"vary": {"noise.netd_mk": [1.0]}}
NO_NETD = {"sensor": replace(small_camera(), noise=Noise()), "vary": {"optics.aperture_mm": [9.0]}}
AIR = tod.Atmosphere(extinction_per_km=0.2)
WARM = {"target": tod.Target(size_m=4.0, delta_t_k=0.2, k={"seen": 1.0}), "atmosphere": AIR}
OF_PHOTONS: dict[str, Any] = {"sensor": cameras()["photons"], "vary": {"noise.exposure_ms": [5.0]}}


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (NETD | {"size_detectors": [4, 4]}, "size_detectors: found a value twice in 4, 4"),
        ({"design": [{"optics.aperture_mm": 9.0}, {"noise.netd_mk": 9.0}]}, "design 2: found keys noise.netd_mk"),
        (NETD | {"design": [{"noise.netd_mk": 9.0}]}, "found designs and also keys to vary"),
        ({"design": "a\0.csv"}, r"'a\\x00\.csv': cannot be read \(.*embedded null"),
        (
            {"vary": {"noise.netd_mk": ["low"]}},
            r"vary\.noise\.netd_mk\[0\]: found 'low', expected a finite number",
        ),
        ({"vary": {"noise.netd_mk": [1.0, 1.0]}}, r"vary noise\.netd_mk: found a value twice"),
        (
            {"vary": {"noise.netd_mk": [1.0, math.inf]}},
            r"vary\.noise\.netd_mk\[1\]: found inf, expected a finite number",
        ),
        ({"vary": {"noise.frames_integrated": [1.5]}}, r"found \(1\.5,\), expected whole numbers"),
        (NETD | {"sample": 3}, r"found \(1\.0,\), expected FROM:TO or FROM:TO:log for a sample"),
        (NO_NETD | {"acuity_delta_t_mk": 5.0}, r"acuity_delta_t_mk: needs noise\.netd_mk of the sensor"),
        (NO_NETD | {"minimise": ["delta_t_mk"]}, r"minimise: found delta_t_mk, which needs noise\.netd_mk"),
        (NO_NETD | {"target": "nato", "atmosphere": "mwir_5km"}, r"target: needs noise\.netd_mk of the sensor"),
        (NO_NETD | {"couple_netd": True}, r"^couple_netd: needs noise\.netd_mk of the sensor$"),
        (
            {"vary": {"display.background_luminance_cd_m2": [20.0]}},
            r"^sweep: display\.background.* changes no",
        ),
        (
            NO_NETD | {"vary": {"noise.frames_integrated": [1, 2]}},
            "integrated changes no threshold of this",
        ),
        ({"design": [{"noise.netd_mk": 9.0, "display.background_luminance_cd_m2": 5.0}]}, "leave it out"),
        (NETD | {"couple_netd": True}, r"^couple_netd: found noise\.netd_mk among the keys"),
        (OF_PHOTONS | {"acuity_snr": 1.0}, "found an SNR or a ΔT for a camera that counts photons, expected none"),
        (OF_PHOTONS | WARM, "found a temperature difference, expected a contrast"),
    ],
)
def test_what_a_sweep_cannot_do_is_refused_by_the_call(asked: dict[str, Any], message: str) -> None:
    with pytest.raises(tod.TodframesError, match=message):
        ss.sweep(**{"sensor": CAMERA, "size_detectors": [4]} | asked)
