"""EMVA 1288: descriptors, and cameras simulated from photons up by code that shares nothing."""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from photon_camera import PhotonCamera

import todframes as tod
from todframes.base.errors import DataError
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.wording import plain

REAL = Path(__file__).parents[1] / "recordings"

CAMERA = PhotonCamera()
LEVELS = {2.0: 2_000.0, 5.0: 5_000.0, 10.0: 10_000.0, 20.0: 16_000.0}
"""Photons of a pixel by exposure in ms; all below 0.7 of the full well."""


def stacks(
    camera: PhotonCamera = CAMERA, n: int = 4, side: int = 64, seed: int = 1, **light: float
) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    patterns = camera.patterns(rng, (side, side))
    films = {
        name: [
            camera.film(rng, patterns, n, photons=on * photons, exposure_ms=ms, **light)
            for ms, photons in LEVELS.items()
        ]
        for name, on in (("bright", 1.0), ("dark", 0.0))
    }
    return {**films, "exposure_ms": [*LEVELS], "photons": [*LEVELS.values()], "bits": camera.bits}


def truth_of(camera: PhotonCamera) -> dict[str, float]:
    """Figures of a camera, by their names in a measurement."""
    return {
        "system_gain": camera.gain_dn_per_electron,
        "quantum_efficiency": camera.quantum_efficiency,
        "dark_noise": camera.dark_noise_electrons(0.0),
        "dsnu": camera.dsnu_electrons,
        "prnu": camera.prnu_percent,
    }


def test_figures_of_a_simulated_camera_are_within_their_intervals() -> None:
    """The seed is one of those where all 95 % intervals hold."""
    made = stacks()
    found = tod.emva_noise(**made)
    measured = found.noise.emva1288
    truth = truth_of(CAMERA) | {"dark_current": CAMERA.dark_current_electrons_per_s}
    for name, value in truth.items():
        low, high = getattr(measured, f"{name}_ci95")
        assert low <= value <= high, name
        assert low <= getattr(measured, name) <= high, name
        assert high - low < 0.5 * value, name  # they say something
    # No stack is saturated, so the capacity is that of 12 bits: (4095 − 30) DN.
    assert not measured.is_saturation_reached
    assert measured.saturation_electrons * measured.system_gain == pytest.approx(4095 - 30, abs=1.0)
    assert [one.code for one in found.warnings] == ["saturation_not_reached"]
    # EMVA 1288 release 4.0 linear: μ_p.min = (σ_d in e⁻ + 1/2) / η.
    least = measured.dark_noise_dn / measured.system_gain + 0.5
    assert measured.sensitivity_threshold == pytest.approx(least / measured.quantum_efficiency, rel=1e-9)
    # A bright stack without light changes nothing.
    black = made["bright"] + made["dark"][:1], made["dark"] + made["dark"][:1]
    names = ("exposure_ms", "photons")
    more = dict(zip(names, ([*made["exposure_ms"], 2.0], [*made["photons"], 1.0]), strict=True))
    again = tod.emva_noise(**made | more | dict(zip(("bright", "dark"), black, strict=True))).noise.emva1288
    assert again.system_gain == pytest.approx(measured.system_gain, rel=1e-3)


def codes_of(found: Any) -> set[str]:
    return {one.code for one in found.warnings} - {"saturation_not_reached"}


def test_a_lamp_that_flickers_leaves_the_patterns() -> None:
    """Of 4,096 pixels in 8 frames the PRNU is 0.8 % with a standard error of 0.011 %."""
    found = tod.emva_noise(**stacks(n=8, flicker=0.08))
    assert found.noise.emva1288.prnu == pytest.approx(CAMERA.prnu_percent, abs=4 * 0.011)
    assert found.noise.emva1288.dsnu == pytest.approx(CAMERA.dsnu_electrons, rel=0.1)
    assert codes_of(found) == set()


def test_a_lamp_that_drifts_within_a_stack_is_warned_of() -> None:
    found = tod.emva_noise(**stacks(n=8, drift=0.04))
    # Half of the drift is in the mean, and so in the quantum efficiency.
    assert found.noise.emva1288.quantum_efficiency == pytest.approx(0.45 * 1.02, rel=0.01)
    (warning,) = (one for one in found.warnings if one.code != "saturation_not_reached")
    share = float(re.search(r"the mean of bright\[\d\] changes by ([\d.]+) % of the signal", warning.message)[1])
    assert warning.code == "drift" and share == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("fall_off", [0.03, 0.2])
def test_light_that_falls_off_is_warned_of(fall_off: float) -> None:
    """Without the surface, the PRNU is that of the camera: 0.8 %, 0.017 % standard error with 4 frames."""
    found = tod.emva_noise(**stacks(fall_off=fall_off))
    assert found.noise.emva1288.prnu > 1.2 * CAMERA.prnu_percent
    (warning,) = (one for one in found.warnings if one.code != "saturation_not_reached")
    even = float(re.search(r"and is ([\d.]+) % without a surface", warning.message)[1])
    assert warning.code == "uneven_light" and even == pytest.approx(CAMERA.prnu_percent, abs=4 * 0.017)


@pytest.mark.parametrize("offset_dn", [0.5, 4.0])
def test_dark_frames_cut_at_black_are_warned_of(offset_dn: float) -> None:
    made = stacks(replace(CAMERA, offset_dn=offset_dn))
    share = 100.0 * max((film == 0).mean() for film in made["dark"])
    assert share > 3.0
    found = tod.emva_noise(**made)
    assert codes_of(found) == {"saturated"}
    assert found.warnings[0].message.startswith(f"{share:.2g} % of the values of dark[")


def test_a_stack_cut_off_below_the_end_of_its_file_is_saturated() -> None:
    made = stacks()
    full = np.full((4, 64, 64), 4095, np.uint16)
    assert codes_of(tod.emva_noise(**made | {"bright": [*made["bright"][:-1], full]})) == set()  # nothing repeats
    made["bright"][-1] = np.minimum(made["bright"][-1], int(np.median(made["bright"][-1])))
    found = tod.emva_noise(**made | {"bits": None}).noise.emva1288
    assert [point.is_saturated for point in found.points] == [False, False, False, True]
    low, high = found.system_gain_ci95
    assert low <= CAMERA.gain_dn_per_electron <= high


COARSE_NOISE = {"gain_dn_per_electron": 0.06, "read_noise_electrons": 2.0}
COARSE = replace(CAMERA, dsnu_electrons=4.0, dark_current_electrons_per_s=20.0, **COARSE_NOISE)


@pytest.mark.parametrize("offset_dn", [30.0, 30.25, 30.5])
def test_patterns_under_coarse_steps_are_uncertain_by_half_a_step(offset_dn: float) -> None:
    """A DSNU of 0.24 DN: rounding shows 0.2 or 0.5 DN of it, by where black lies between two steps."""
    found = tod.emva_noise(**stacks(replace(COARSE, offset_dn=offset_dn)))
    low, high = found.noise.emva1288.dsnu_ci95
    assert low <= 4.0 <= high
    assert abs(found.noise.emva1288.dsnu - 4.0) > 0.5 and found.noise.emva1288.dark_current is None
    # The bound of the standard for a dark noise that rounding hides, 0.4 DN: above the true one of 0.12.
    assert found.noise.emva1288.dark_noise == pytest.approx(0.4 / found.noise.emva1288.system_gain)
    assert codes_of(found) == {"quantised"}
    assert "the DSNU uncertain by half a step (1 DN)" in found.warnings[0].message


def test_steps_of_several_values_are_steps() -> None:
    """12 bits in the upper bits of 16: nothing in electrons changes, and the gain is 16 times as high."""
    made = stacks(COARSE)
    wide = {name: [16 * one for one in made[name]] for name in ("bright", "dark")} | {"bits": 16}
    once, again = tod.emva_noise(**made), tod.emva_noise(**made | wide)
    assert codes_of(again) == codes_of(once)
    assert again.noise.emva1288.system_gain == pytest.approx(16.0 * once.noise.emva1288.system_gain, rel=1e-12)
    for name in ("dark_noise", "dsnu", "prnu", "quantum_efficiency"):
        one, other = (
            [getattr(found.noise.emva1288, name), *getattr(found.noise.emva1288, f"{name}_ci95")]
            for found in (once, again)
        )
        assert other == pytest.approx(one, rel=1e-9), name


@pytest.mark.parametrize("has_photons", [True, False])
@pytest.mark.parametrize("bend", [0.06, -0.06])
def test_a_bent_response_is_warned_of(bend: float, has_photons: bool) -> None:
    """The gain of S electrons is in proportion to 1 − 3 b S / full well: 8 % off for all stacks, 3 % for half."""
    made = stacks(replace(CAMERA, bend=bend), n=8)
    if not has_photons:
        del made["photons"]
    found = tod.emva_noise(**made)
    assert codes_of(found) == {"not_linear"}
    change = float(re.search(r"has a gain (\S+) % from", found.warnings[0].message)[1])  # type: ignore[index]
    assert change == pytest.approx(100.0 * bend, abs=3.0)  # 0.8 % of the variance of faint stacks, three times


CASES: dict[str, tuple[PhotonCamera, dict[str, float]]] = {
    "clean": (CAMERA, {}),
    "flickers": (CAMERA, {"flicker": 0.04}),
    "coarse": (replace(CAMERA, **COARSE_NOISE), {}),
    "patterned": (replace(CAMERA, dsnu_electrons=8.0, prnu_percent=2.0), {}),
}


@pytest.mark.weekly
@pytest.mark.parametrize(("case", "n"), [*((case, 8) for case in CASES), ("clean", 2), ("patterned", 2)])
def test_intervals_hold(case: str, n: int) -> None:
    """Of 100 intervals of 95 %, 88 or fewer hold with a probability of 0.4 %."""
    camera, light = CASES[case]
    held = Counter[str]()
    for seed in range(100):
        measured = tod.emva_noise(**stacks(camera, n=n, seed=seed, **light)).noise.emva1288
        for name, truth in truth_of(camera).items():
            low, high = getattr(measured, f"{name}_ci95")
            held[name] += low <= truth <= high
    assert min(held.values()) > 88, held


def test_variances_are_those_of_the_definition() -> None:
    """By NumPy from the standard's definitions: half the squared difference of a pair, and the mean image.

    It leaves out what rows and columns of a frame share by chance, of 1 / 64 of the variance each to 1 / 4096.
    """
    made = stacks(n=2)
    measured = tod.emva_noise(**made).noise.emva1288
    variances = []
    for name in ("bright", "dark"):
        one, other = made[name][3].astype(float)  # the bright one is that nearest to half of saturation
        temporal = (one - other).var() / 2.0
        variances.append((temporal, ((one + other) / 2.0).var() - temporal / 2.0))
    (bright, of_bright), (dark, of_dark) = variances
    point = measured.points[3]
    assert point.variance_dn2 == pytest.approx(bright - dark, rel=1e-3)
    assert point.signal_dn == pytest.approx(made["bright"][3].mean() - made["dark"][3].mean(), rel=1e-12)
    assert measured.dsnu * measured.system_gain == pytest.approx(of_dark**0.5, rel=2e-3)
    assert measured.prnu == pytest.approx(100.0 * (of_bright - of_dark) ** 0.5 / point.signal_dn, rel=2e-3)


def test_saturation_is_the_largest_variance() -> None:
    camera = replace(CAMERA, full_well_electrons=6_000.0)
    rng = np.random.default_rng(2)
    patterns = camera.patterns(rng, (48, 48))
    photons = np.arange(1, 16) * 1_000.0
    bright = [camera.film(rng, patterns, 2, photons=one, exposure_ms=5.0) for one in photons]
    dark = [camera.film(rng, patterns, 2, photons=0.0, exposure_ms=5.0)]
    found = tod.emva_noise(bright=bright, dark=dark, photons=photons, bits=12)
    # 6,000 electrons are 13,333 photons; the step is 1,000, and wells fill over some of it (√6,000 is 1.3 %).
    assert found.noise.emva1288.saturation_photons in (12_000.0, 13_000.0)
    assert found.noise.emva1288.is_saturation_reached
    electrons = found.noise.emva1288.saturation_electrons
    assert electrons == pytest.approx(6_000.0, rel=0.12)
    *_, last, linearity = found.sentences()
    assert last == f"It saturates at {plain(electrons, 4)} electrons: an SNR of up to {plain(electrons**0.5)}."
    low, high = found.noise.emva1288.linearity_percent
    assert linearity == f"Linearity errors are {plain(low, 2)} to {plain(high, 2)} %."
    # Beyond 0.7 of saturation no stack counts for the gain: 0.7 · 13,000 = 9,100 photons.
    assert sum(one.is_fitted for one in found.noise.emva1288.points) in (8, 9)


def test_dark_noise_is_that_at_an_exposure_of_0_and_the_sensor_adds_the_current_once() -> None:
    """At the shortest exposure of 10 ms the dark current of 3,000 e⁻/s has more variance than reading, 4 e⁻²."""
    camera = replace(
        CAMERA, read_noise_electrons=2.0, dark_current_electrons_per_s=3_000.0, gain_dn_per_electron=0.5
    )
    rng, exposures = np.random.default_rng(4), [10.0, 20.0, 40.0, 60.0]
    patterns = camera.patterns(rng, (64, 64))
    bright, dark = (
        [camera.film(rng, patterns, 8, photons=photons, exposure_ms=ms) for ms in exposures]
        for photons in (3_000.0, 0.0)
    )
    found = tod.emva_noise(bright=bright, dark=dark, exposure_ms=exposures, bits=12)
    measured = found.noise.emva1288
    low, high = measured.dark_noise_ci95
    assert low < 2.0 < high and high - low < 0.5
    # In DN with 1/12 of rounding.
    assert measured.dark_noise_dn == pytest.approx(np.sqrt(0.25 * measured.dark_noise**2 + 1 / 12), rel=0.01)
    noise = tomllib.loads(found.sensor_toml())["noise"]
    variance = noise["dark_noise_electrons"] ** 2 + noise["dark_current_electrons_per_s"] * 0.06
    assert variance == pytest.approx(camera.dark_noise_electrons(60.0) ** 2, rel=0.03)
    # One dark exposure cannot hold both apart, and two are no line with an error.
    alone = tod.emva_noise(bright=bright, dark=dark[:1], bits=12).noise.emva1288
    assert alone.dark_noise == pytest.approx(camera.dark_noise_electrons(10.0), rel=0.03)
    two = tod.emva_noise(bright=bright[:2], dark=dark[:2], exposure_ms=exposures[:2], bits=12).noise.emva1288
    assert two.dark_current is None and measured.dark_current == pytest.approx(3_000.0, rel=0.1)


def test_stacks_that_differ_by_noise_alone_are_not_saturated() -> None:
    """In about half of the cases the brighter of two stacks of one light has the smaller variance."""
    made = stacks(n=2)
    is_less = set()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        again = CAMERA.film(rng, CAMERA.patterns(rng, (64, 64)), 2, photons=16_000.0, exposure_ms=20.0)
        bright, photons = [*made["bright"], again], [*made["photons"], 16_000.0]
        found = tod.emva_noise(bright=bright, dark=made["dark"][3:], photons=photons, bits=12)
        *_, one, other = found.noise.emva1288.points
        is_less.add(other.variance_dn2 < one.variance_dn2)
        assert not found.noise.emva1288.is_saturation_reached
    assert is_less == {True, False}


def test_signal_to_noise_is_that_of_the_model() -> None:
    """At 9,000 electrons and 100 of other variance: 9000 / √(9000 + 100 + …), by hand."""
    found = tod.emva_noise(**stacks())
    measured = found.noise.emva1288
    dark = measured.dark_noise**2 + 1 / 12 / measured.system_gain**2
    at = np.array([9_000.0])
    assert found.snr(at) == pytest.approx(9_000.0 / (9_000.0 + dark) ** 0.5, rel=1e-12)
    spatial = measured.dsnu**2 + (90.0 * measured.prnu) ** 2
    assert found.snr(at, with_spatial=True) == pytest.approx(
        9_000.0 / (9_000.0 + dark + spatial) ** 0.5, rel=1e-12
    )
    # The ends of a Poisson camera: at 9,000 photons the ideal camera has an SNR of 95.
    for one in measured.points:
        expected = found.snr(np.array([one.signal_dn / measured.system_gain]))[0]
        assert one.snr == pytest.approx(expected, rel=0.03)  # 4 frames of 4,096 pixels: 0.8 % of an SD each


def test_basler_crops_hold_what_the_other_program_found() -> None:
    """Crops of the stacks of reference set 001. One exposure does not determine the gain, so its own is given."""
    stack = {name: np.load(REAL / f"emva1288_{name}.npz")["frames"] for name in ("bright", "dark")}
    found = tod.emva_noise(bright=[stack["bright"]], dark=[stack["dark"]], bits=12)
    measured = found.noise.emva1288
    # What emva1288 1.0.2 finds in the whole set: dark noise 10.926 e⁻ · 0.28006 DN/e⁻ and √(1/12) of rounding.
    low, high = measured.dark_noise_dn_ci95
    assert low <= (10.926**2 * 0.28006**2 + 1 / 12) ** 0.5 <= high
    assert {one.code for one in found.warnings} == {"one_exposure", "saturation_not_reached"}
    assert "give bits" not in found.warnings[-1].message
    without_bits = tod.emva_noise(bright=[stack["bright"]], dark=[stack["dark"]])
    assert without_bits.warnings[-1].message.endswith("or give bits if the camera has fewer bits than its files")


def descriptor(folder: Path, made: dict[str, Any], version: str = "3.0") -> Path:
    lines = ["# a comment", f"v {version}", "n 12 64 64"]
    for name, kind in (("bright", "b"), ("dark", "d")):
        for number, (film, ms) in enumerate(zip(made[name], made["exposure_ms"], strict=True)):
            photons = f" {made['photons'][number]}" if kind == "b" else ""
            lines.append(f"{kind} {1e6 * ms}{photons}")
            for place, frame in enumerate(film):
                assert cv2.imwrite(str(folder / f"{kind}_{number}_{place}.png"), frame)
                lines.append(f"i .\\{kind}_{number}_{place}.png")
    (folder / "set.txt").write_text("\n".join(lines))
    return folder / "set.txt"


def test_a_descriptor_and_the_command_give_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = stacks(n=2)
    path, called = descriptor(tmp_path, made), tod.emva_noise(**made)

    def printed(*arguments: str) -> Any:
        assert run(cli, ["noise", *arguments, "--json"]) == 0
        return json.loads(capsys.readouterr().out)["noise"]["emva1288"] | {"source": ""}

    wanted = json.loads(called.to_json())["noise"]["emva1288"] | {"source": ""}
    assert printed("--emva", str(path)) == wanted
    path.write_text(path.read_text().replace("_0.png\ni", "_0.png"))  # two images a line
    assert printed("--emva", str(path)) == wanted
    for name, kind in (("bright", ""), ("dark", "dark_")):
        for number, film in enumerate(made[name]):
            np.save(tmp_path / f"{kind}{number}.npy", film)
    of_bright = [str(tmp_path / f"{number}.npy") for number in range(4)]
    of_dark = [part for number in range(4) for part in ("--dark", str(tmp_path / f"dark_{number}.npy"))]
    settings = ["--exposure-ms", "2,5,10,20", "--photons", "2000,5000,10000,16000", "--bits", "12"]
    assert printed(*of_bright, *of_dark, *settings) == wanted


@pytest.mark.parametrize(("plane", "efficiency"), [((0, 0), 0.2), ((0, 1), 0.45), ((1, 0), 0.45), ((1, 1), 0.3)])
def test_a_plane_of_a_mosaic_is_a_camera_of_its_own(plane: tuple[int, int], efficiency: float) -> None:
    """All values together would take the differences of the colours for a PRNU; a mean of two greens halves K."""
    rng, shape = np.random.default_rng(7), (4, 96, 128)
    sensitivity = np.tile([[0.2, 0.45], [0.45, 0.3]], (48, 64))
    dark, bright = (
        np.rint(20 + 0.5 * (rng.poisson(photons * sensitivity, shape) + rng.normal(0, 4, shape))).astype(np.uint16)
        for photons in (0, 3_000)
    )
    found = tod.emva_noise(bright=[bright], dark=[dark], photons=[3_000], plane=plane).noise.emva1288
    for name, value in {"system_gain": 0.5, "dark_noise": 4.0, "quantum_efficiency": efficiency}.items():
        # 18,400 degrees of freedom: 1.04 % of a variance, twice that in 1 of 20 seeds; 4 of them.
        assert getattr(found, name) == pytest.approx(value, rel=0.045)
    assert found.prnu < 0.5
    with pytest.raises(tod.SettingsError, match="plane: found 2,0, expected a row and a column of 0 or 1"):
        tod.emva_noise(bright=[bright], dark=[dark], plane=(2, 0))


def test_frames_of_a_stack_that_are_delivered_several_times_count_once() -> None:
    """Thrice as many frames would leave a third of their noise in the mean image, and a part of it in the DSNU."""
    made = stacks()
    wanted = tod.emva_noise(**made).noise.emva1288
    repeated = {name: [np.repeat(film, 3, axis=0) for film in made[name]] for name in ("bright", "dark")}
    found = tod.emva_noise(**made | repeated)
    assert found.noise.emva1288 == wanted
    messages = [warning.message for warning in found.warnings if warning.code == "doubled_frames"]
    assert len(messages) == 8 and messages[0].startswith("bright[0]: 8 of 12 frames repeat the frame before")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bright": lambda x: [one[:1] for one in x]}, "found 1 frame of this exposure, expected 2 or more"),
        ({"bright": lambda x: [np.concatenate([x[1], x[2]]), *x[1:]]}, r"means about .* \(2 of them\) and"),
        ({"dark": lambda x: [*x[:3], np.concatenate([x[3], x[3] + 6])]}, r"means about .* \(2 of them\)"),
        ({"bright": lambda x: [np.full_like(one, 4095) for one in x]}, r"bright\[0\]: 100 % of its values are at"),
        ({"bright": lambda x: x[:3]}, "exposure_ms: found 4 numbers for 3 bright stacks"),
        ({"dark": lambda x: x[:2]}, "found 2 dark stacks for 4 bright ones, expected one for all or one for each"),
        ({"dark": lambda x: x[:0]}, "found no dark stack, expected one or more"),
        ({"dark": lambda x: [one[:, :32] for one in x]}, "found stacks of 64 x 32 and 64 x 64 pixels, expected"),
        ({"bright": lambda x: [np.repeat(one[..., None], 3, -1) for one in x]}, "has colours, expected the raw"),
        ({"bright": lambda x: x[:0], "dark": lambda x: x[:0]}, "found neither of a descriptor and bright and"),
        ({"bits": lambda _: 40}, "bits: found 40, expected 1 to 32"),
        ({"photons": lambda x: [-x[0], *x[1:]]}, "photons: found -2000, 5000, 10000, 16000, expected numbers > 0"),
        ({"bright": lambda x: [x[0], *(one[[0, 0]] for one in x[1:])]}, "its temporal variance is not above that"),
        ({"bright": lambda x: [one // 100 for one in x]}, "expected brighter frames; are they exchanged"),
    ],
)
def test_stacks_that_cannot_be_measured(change: dict[str, Any], message: str) -> None:
    made = stacks(n=2)
    with pytest.raises((DataError, tod.SettingsError), match=message):
        tod.emva_noise(**made | {name: made_of(made[name]) for name, made_of in change.items()})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("v 3.0", "v 2.0", "line 2: found 'v 2.0', expected 'v 3' or 'v 4', 'n bits width height', 'b exposure"),
        ("n 12 64 64", "n 12 64", "line 3: found 'n 12 64', expected"),
        ("n 12 64 64", "n 40 64 64", "bits: found 40, expected 1 to 32"),
        ("b 2000000.0 2000.0", "b 2000000.0 x", "line 4: found 'b 2000000.0 x', expected"),
        ("b 2000000.0 2000.0", "b -1 2000.0", "line 4: found 'b -1 2000.0', expected"),
        ("# a comment", "b 1 1", "found no images for an exposure of 1e-06 ms, expected 2 or more"),
        ("# a comment", "i x.png", "line 1: found 'i x.png', expected .* and behind these 'i' with"),
        ("# a comment", "x 1", "line 1: found 'x 1', expected"),
        ("n 12 64 64", "", "found no line 'n bits width height'"),
        ("n 12 64 64", "n 12 32 64", "has 64 x 64 pixels, expected 32 x 64 by"),
        ("i .\\b_0_1.png", "i b_0_1.png x.png", "x.png: found no file"),
        ("# a comment", "b 1 1\ni a.npy\ni b.npy", r"exposure of 1e-06 ms: found 2 recordings .*, expected one"),
        ("# a comment", "b 1 1\ni ../x.png", "lies outside of the dataset"),
        ("d 2000000.0", "d 3000000.0", "found no dark frames for its exposure"),
    ],
)
def test_descriptors_with_mistakes(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = descriptor(tmp_path, stacks(n=2))
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.zeros((2, 64, 64), np.uint16))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((DataError, tod.SettingsError), match=message):
        tod.emva_noise(path)


def test_command_refuses_options_of_the_other_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["x.npy", "--photons", "5"], "--photons: needs --dark, the dark frames"),
        (["x.npy", "--dark", "y.npy", "--signal", "5"], "--signal: is not used with EMVA 1288"),
        ([], "noise: found no RECORDING, expected one, or --emva DESCRIPTOR"),
        (["x.npy", "--emva", "set.txt"], "noise: found both of a descriptor and bright and dark stacks"),
    ):
        assert run(cli, ["noise", *arguments]) == 2
        assert message in capsys.readouterr().err
