"""Air between target and sensor: its transmission, and the contrast that is left; read from TOML files.

schema = 1
title = "Harbour in May"
source = "transmissometer"
[atmosphere]
extinction_per_km = 0.2
# or table = "air.csv"                              columns range_km, and transmission or extinction_per_km
# or visibility_km = 23.0                           daylight; sky_to_ground_ratio = 3.0
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

LEAST_THERMAL_UM = 3.0
"""Wavelength from which on contrasts are those of temperature."""


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
    return from_table(texts | table, Atmosphere, where)


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
