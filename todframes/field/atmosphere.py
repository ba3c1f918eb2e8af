"""Air between target and sensor: its transmission, and the contrast that is left; read from TOML files.

schema = 1
title = "Harbour in May"
source = "transmissometer"
[atmosphere]
extinction_per_km = 0.2
# or table = "air.csv"                              columns range_km, and transmission or extinction_per_km
# or visibility_km = 23.0                           daylight; sky_to_ground_ratio = 3.0
# or modtran_height_m = 75.0, visibility_km = 23.0 or 5.0, and band_um = [3.0, 5.0]: tables of pyBSM
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import (
    check_columns,
    check_values,
    convert,
    from_table,
    read_described,
    read_table,
    settings_path,
    table_beside,
)

SCHEMA = 1
"""Version of the format of atmosphere files that this package reads."""

FOLDER = Path(__file__).with_name("atmospheres")

Wavelength = Annotated[float, Meta(ge=0.1, le=100.0)]

HAZES = {23.0: 1, 5.0: 2}
"""MODTRAN's code of the haze by the visibility in km."""

LEAST_HEIGHT_M, MOST_HEIGHT_M = 75.0, 20_000.0
"""Heights of the sensor. The table at 2 m is not used: there the effective extinction of visible light falls from
0.174 to 0.129 per km between 2 and 5 km, at 75 m from 0.175 to 0.172. That at 32.55 m is not in the package."""

TABLED_UM = (0.3, 14.0)
"""Wavelengths of the tables, in steps of 0.01 µm."""

LEAST_THERMAL_UM, SCENE_K = 3.0, 300.0
"""Wavelength from which on contrasts are those of temperature, and temperature of the scene for its weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Atmosphere:
    """Air between target and sensor. Give one description of its extinction: a number, a table, or a visibility.

    Attributes
    ----------
    extinction_per_km : float or None
        Extinction per km at all ranges (Beer), 0.001 to 100.
    range_km, transmission : tuple of float, or None
        Table: rising ranges in km, and the transmission over each, in (0, 1], which does not rise.
    visibility_km : float or None
        Meteorological visibility: extinction 3.912 / visibility for daylight.
    sky_to_ground_ratio : float
        Radiance of the horizon's sky divided by that of the background, for daylight. The share of the contrast
        that arrives is 1 / (1 + ratio · (1/τ − 1)); with 1, the background is as bright as the sky, it is τ.
    band_um : (float, float) or None
        Wavelengths of the numbers, in µm.
    title, source : str
        Name of the air, and the origin of its numbers.

    Raises
    ------
    SettingsError
        If a value is out of range, missing, or contradicts another.

    Examples
    --------
    >>> import todframes as tod
    >>> air = tod.Atmosphere(extinction_per_km=0.2)
    """

    extinction_per_km: Annotated[float, Meta(ge=1e-3, le=100.0)] | None = None
    range_km: tuple[Annotated[float, Meta(gt=0.0, le=1000.0)], ...] | None = None  # ranges in m are beyond
    transmission: tuple[Annotated[float, Meta(gt=0.0, le=1.0)], ...] | None = None
    visibility_km: Annotated[float, Meta(ge=0.01, le=1e3)] | None = None
    sky_to_ground_ratio: Annotated[float, Meta(ge=0.01, le=1e3)] | None = None
    band_um: tuple[Wavelength, Wavelength] | None = None
    title: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        check_values(self)
        given = [n for n in ("extinction_per_km", "transmission", "visibility_km") if getattr(self, n) is not None]
        if len(given) != 1:
            raise SettingsError(
                f"{' and '.join(given) or 'extinction'}: found {len(given)} descriptions of the air, expected one "
                "of extinction_per_km, a table, and visibility_km"
            )
        if self.band_um is not None and self.band_um[0] >= self.band_um[1]:
            raise SettingsError(f"band_um: found {list(self.band_um)}, expected two rising wavelengths in µm")
        if (self.range_km is None) != (self.transmission is None):
            missing = "range_km" if self.range_km is None else "transmission"
            raise SettingsError(f"{missing}: is missing, expected range_km and transmission of a table")
        if self.range_km is not None and self.transmission is not None:
            _check_table(self.range_km, self.transmission)

    @property
    def is_table(self) -> bool:
        """Whether the extinction is a table over range."""
        return self.range_km is not None

    @property
    def is_daylight(self) -> bool:
        """Whether the numbers are for daylight only: a visibility, or a sky-to-ground ratio."""
        return self.sky_to_ground_ratio is not None or self.visibility_km is not None

    @property
    def varies_unseen(self) -> bool:
        """Whether one extinction is given for a band in which the effective extinction falls much with range."""
        # From 1 to 20 km the effective extinction falls to a fifth in 1–1.7 µm and 3–5 µm, but to 0.61 in 8–12 µm
        # and to 0.85 in 0.4–0.7 µm (MODTRAN tables of pyBSM 0.16.1).
        low, high = (0.9, 6.0)
        return not self.is_table and self.band_um is not None and low <= self.band_um[0] < self.band_um[1] <= high

    @property
    def longest_km(self) -> float:
        """Longest range of the table; infinity if there is none."""
        return math.inf if self.range_km is None else self.range_km[-1]

    @property
    def constant_per_km(self) -> float:
        """Extinction per km of air that is not a table."""
        if self.extinction_per_km is not None:
            return self.extinction_per_km
        assert self.visibility_km is not None
        return 3.912 / self.visibility_km  # −ln 0.02: a threshold contrast of 2 % (Koschmieder 1924).

    def optical_depth(self, range_km: ArrayLike) -> FloatArray:
        """Compute −ln τ at ranges >= 0 of any shape, in km.

        Between the rows of a table ln(optical depth) is linear in ln(range), as for a band of many lines whose
        depth grows with a power of range. Up to the first row the extinction is that of the first row; beyond the
        last row it is that of the last, but no range is reported there.
        """
        ranges = np.asarray(range_km, dtype=np.float64)
        if self.range_km is None or self.transmission is None:
            return self.constant_per_km * ranges
        # The logarithm of a depth is interpolated.
        known, depths = np.array(self.range_km), np.maximum(-np.log(self.transmission), 1e-9)
        inside = np.clip(ranges, known[0], known[-1])
        return np.exp(np.interp(np.log(inside), np.log(known), np.log(depths))) * (ranges / inside)

    def ln_contrast_left(self, range_km: ArrayLike) -> FloatArray:
        """Compute the logarithm of the share of the contrast that arrives, for ranges >= 0 in km, of any shape.

        It is ln τ, or −ln(1 + ratio · (1/τ − 1)) with path radiance of the sky-to-ground ratio (Duntley 1948).
        """
        depth = self.optical_depth(range_km)
        if self.sky_to_ground_ratio is None:
            return -depth
        # From 700 on the exponential is not finite.
        return -np.log1p(self.sky_to_ground_ratio * np.expm1(np.minimum(depth, 700.0)))


def _check_table(ranges: tuple[float, ...], transmission: tuple[float, ...]) -> None:
    if not ranges or not (np.diff(ranges) > 0.0).all():
        few = ", ".join(f"{one:g}" for one in ranges[:4]) + " …" * (len(ranges) > 4)
        raise SettingsError(f"range_km: found {few or 'none'}, expected rising ranges")
    if len(transmission) != len(ranges):
        raise SettingsError(f"transmission: found {len(transmission)} values, expected {len(ranges)}, one a range")
    for k in np.flatnonzero(np.diff(transmission) > 0.0)[:1].tolist():
        raise SettingsError(
            f"transmission: grows from {transmission[k]:.3g} at {ranges[k]:g} km to "
            f"{transmission[k + 1]:.3g} at {ranges[k + 1]:g} km, expected it to fall with range"
        )


def find_atmosphere(asked: Atmosphere | Path | str) -> Atmosphere:
    """Return the air of this package with a name, that of a TOML file, or the one given.

    The table of a file is relative to its folder, and lies in it.
    """
    if isinstance(asked, Atmosphere):
        return asked
    path = settings_path(asked, FOLDER, "atmosphere")
    table, texts = read_described(path, "atmosphere", SCHEMA)
    where = f"{path}: [atmosphere]"
    if "table" in table:
        table |= _read_table(path.parent, table.pop("table"), f"{where}: table")
    if isinstance(table.get("extinction_per_km"), list):
        table = _as_transmission(table, where)
    if "modtran_height_m" in table:
        table = _from_modtran(table, where)
    return from_table(texts | table, Atmosphere, where)


def _from_modtran(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Return a table of transmissions from the tables of pyBSM, by height, visibility and band."""
    names = {"modtran_height_m": float, "visibility_km": float, "band_um": tuple[float, float]}
    missing = [name for name in names if name not in table]
    if missing:
        raise SettingsError(f"{where}: {missing[0]}: is missing, expected it beside modtran_height_m")
    height, visibility, band = (convert(table[name], kind, f"{where}: {name}") for name, kind in names.items())
    try:
        ranges, transmissions = modtran_table(band_um=band, visibility_km=visibility, height_m=height)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None
    others = {key: value for key, value in table.items() if key not in ("modtran_height_m", "visibility_km")}
    return others | {"range_km": ranges, "transmission": transmissions}


def _as_transmission(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Return a table whose effective extinctions over each range are turned into transmissions."""
    column = tuple[Annotated[float, Meta(ge=0.0, le=100.0)], ...]
    names = ("extinction_per_km", "range_km")
    depths, ranges = (convert(table.get(one, []), column, f"{where}: {one}") for one in names)
    table = {key: value for key, value in table.items() if key != "extinction_per_km"}
    pairs = zip(depths, ranges, strict=False)
    return table | {"transmission": [math.exp(-extinction * range_km) for extinction, range_km in pairs]}


def _read_table(folder: Path, name: object, where: str) -> dict[str, Any]:
    """Return `range_km` and the other column of the CSV file that a TOML file names."""
    with table_beside(name, folder, where) as file:
        header, lines = read_table(file)
        column = "transmission" if "transmission" in header else "extinction_per_km"
        check_columns(header, ["range_km", column], file)
        rows = [line.numbers(["range_km", column]) for line in lines]
    rows = [row for row in rows if row[0] != 0.0]  # no air, no loss
    return {"range_km": [row[0] for row in rows], column: [row[1] for row in rows]}


def modtran_table(
    *, band_um: tuple[float, float], visibility_km: float, height_m: float
) -> tuple[list[float], list[float]]:
    """Return slant ranges in km, and transmissions of a band, which do not rise, from pyBSM's tables.

    Thermal bands are weighted with dB/dT at 300 K, others evenly. `height_m` is that of the sensor above a target
    on the ground. SettingsError if pyBSM is not installed, or a value is out of range.
    """
    if visibility_km not in HAZES:
        raise SettingsError(f"visibility_km: found {visibility_km:g}, expected 23 or 5, those of MODTRAN's tables")
    if not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
        raise SettingsError(
            f"modtran_height_m: found {height_m:g}, expected {LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g}"
        )
    if not TABLED_UM[0] <= band_um[0] < band_um[1] <= TABLED_UM[1]:
        raise SettingsError(f"band_um: found {list(band_um)}, expected two rising wavelengths from 0.3 to 14 µm")
    try:
        from pybsm.utils import load_database_atmosphere
    except ImportError as error:
        raise SettingsError(
            f"modtran_height_m: needs the package {error.name or 'pybsm'}, which is not installed: "
            "pip install 'todframes[atmosphere]'"
        ) from None
    ranges, transmissions = [], []
    for ground_km in (0.5, *range(1, 21), *range(22, 82, 2)):
        try:
            table = load_database_atmosphere(
                altitude=height_m, ground_range=1000.0 * ground_km, ihaze=HAZES[visibility_km]
            )
        except IndexError:  # beyond the horizon
            break
        ranges.append(math.hypot(ground_km, height_m / 1000.0))
        transmissions.append(_in_band(1e6 * table[:, 0], table[:, 1], band_um))
    return ranges, np.minimum.accumulate(transmissions).tolist()


def _in_band(wavelength_um: FloatArray, transmission: FloatArray, band_um: tuple[float, float]) -> float:
    """Return the mean transmission of a band."""
    low, high = band_um
    inside = (wavelength_um >= low - 1e-6) & (wavelength_um <= high + 1e-6)
    if not inside.any():
        raise SettingsError(f"band_um: found {list(band_um)}, narrower than the tables' steps of 0.01 µm")
    weight = np.ones(int(inside.sum()))
    if low >= LEAST_THERMAL_UM:
        # dB/dT ∝ exp(x) / (exp(x) − 1)² / λ⁶, x = c₂ / (λ T), c₂ = 14,387.77 µm K.
        x = 14_387.77 / (wavelength_um[inside] * SCENE_K)
        weight = np.exp(-x) / np.square(-np.expm1(-x)) / wavelength_um[inside] ** 6
    return float(np.average(transmission[inside], weights=weight))
