"""Air from pyBSM's MODTRAN tables: with a stand-in of closed form, and as an oracle with the package itself."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from todframes.base.errors import SettingsError
from todframes.field.atmosphere import find_atmosphere, modtran_table

EXTINCTION_PER_KM, HORIZON_M = 0.3, 31_000.0


@pytest.fixture
def stand_in(monkeypatch):
    """A package whose air has one extinction beyond 5 µm and none below, up to a horizon."""
    asked = []

    def load(*, altitude, ground_range, ihaze):
        asked.append((altitude, ground_range, ihaze))
        if ground_range > HORIZON_M:
            raise IndexError
        wavelength_um = np.arange(0.3, 14.005, 0.01)
        slant_km = np.hypot(altitude, ground_range) / 1000.0
        transmission = np.where(wavelength_um < 5.0, 1.0, np.exp(-EXTINCTION_PER_KM * slant_km))
        return np.stack([1e-6 * wavelength_um, transmission], axis=1)

    utils = ModuleType("pybsm.utils")
    utils.load_database_atmosphere = load
    monkeypatch.setitem(sys.modules, "pybsm", ModuleType("pybsm"))
    monkeypatch.setitem(sys.modules, "pybsm.utils", utils)
    return asked


def written(folder: Path, text: str) -> Path:
    path = folder / "air.toml"
    path.write_text(f"schema = 1\n[atmosphere]\n{text}\n")
    return path


def test_air_of_a_file_is_a_table_up_to_the_horizon(stand_in, tmp_path):
    path = written(tmp_path, "modtran_height_m = 150\nvisibility_km = 5.0\nband_um = [8.0, 12.0]")
    air = find_atmosphere(path)
    assert air.is_table and air.band_um == (8.0, 12.0)
    assert air.longest_km == pytest.approx(np.hypot(30.0, 0.15))
    assert {one[0] for one in stand_in} == {150.0} and {one[2] for one in stand_in} == {2}
    for km in (1.0, 7.3, 29.0):
        assert float(air.optical_depth(km)) == pytest.approx(EXTINCTION_PER_KM * km, rel=1e-9)


@pytest.mark.usefixtures("stand_in")
def test_thermal_bands_are_weighted_with_the_change_of_radiance():
    # Half of the band passes all: the share of dB/dT below 5 µm, by differences of Planck's law at 300 K.
    wavelength = np.arange(4.0, 6.0005, 0.01)
    planck = [wavelength**-5 / np.expm1(14387.77 / wavelength / kelvin) for kelvin in (299.999, 300.001)]
    change = planck[1] - planck[0]
    share = change[wavelength < 4.995].sum() / change.sum()
    ranges, transmissions = modtran_table(band_um=(4.0, 6.0), visibility_km=23.0, height_m=75.0)
    expected = share + (1.0 - share) * np.exp(-EXTINCTION_PER_KM * np.array(ranges))
    assert transmissions == pytest.approx(expected, rel=1e-6)
    # Reflected light counts evenly.
    (_, *_), (first, *_) = modtran_table(band_um=(2.0, 8.0), visibility_km=23.0, height_m=75.0)
    assert first == pytest.approx((300 + 301 * np.exp(-EXTINCTION_PER_KM * ranges[0])) / 601, rel=1e-3)


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize(
    ("height", "visibility", "band", "message"),
    [
        ("2", "23", "[3, 5]", "modtran_height_m: found 2, expected 75 to"),
        ("75", "10", "[3, 5]", "visibility_km: found 10, expected 23 or 5"),
        ("75", "23", "[12, 20]", "expected two rising wavelengths from 0.3"),
        ("75", "23", "[3.001, 3.004]", "narrower than the tables' steps"),
        ("'a'", "23", "[3, 5]", "modtran_height_m"),
        ("75", "23", None, "band_um: is missing, expected it beside modtran_height_m"),
    ],
)
def test_a_wrong_key_is_one_line(height, visibility, band, message, tmp_path):
    text = f"modtran_height_m = {height}\nvisibility_km = {visibility}"
    path = written(tmp_path, text if band is None else f"{text}\nband_um = {band}")
    with pytest.raises(SettingsError) as error:
        find_atmosphere(path)
    assert message in str(error.value) and str(error.value).startswith(f"{path}: [atmosphere]")


def test_a_missing_package_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pybsm", None)
    path = written(tmp_path, "modtran_height_m = 75\nvisibility_km = 23\nband_um = [3.0, 5.0]")
    with pytest.raises(SettingsError, match=r"needs the package pybsm.*pip install 'todframes\[atmosphere\]'"):
        find_atmosphere(path)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("preset", "band_um"),
    [("visible", (0.4, 0.7)), ("swir", (1.0, 1.7)), ("mwir", (3.0, 5.0)), ("lwir", (8.0, 12.0))],
)
@pytest.mark.parametrize("visibility_km", [23.0, 5.0])
def test_presets_are_those_of_the_tables(preset, band_um, visibility_km):
    pytest.importorskip("pybsm", reason="pybsm is in the extra atmosphere")
    ranges, transmissions = modtran_table(band_um=band_um, visibility_km=visibility_km, height_m=75.0)
    shipped = find_atmosphere(f"{preset}_{visibility_km:g}km")
    for km in (1.0, 5.0, 10.0, 20.0):
        place = int(np.argmin(np.abs(np.array(ranges) - km)))
        # The presets are rounded to three digits; weights and ends of the band may differ by a step.
        assert -np.log(transmissions[place]) / ranges[place] == pytest.approx(
            float(shipped.optical_depth(km)) / km, rel=0.03, abs=1e-3
        )
