"""Targets of the field: their size, their contrast, and the criteria of the tasks; read from TOML files.

schema = 1
title = "Car of the patrol"
source = "measured on 4 May"
[target]
size_m = 1.8
delta_t_k = 1.5              # or contrast, or reflectance and background_reflectance
cycles = "stanag"            # or "johnson", or { recognition = 3.5 }
k = { recognition = 4.0 }    # for a TOD
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_values, from_table, read_described, settings_path

SCHEMA = 1
"""Version of the format of target files that this package reads."""

FOLDER = Path(__file__).with_name("targets")

CriterionName = Literal["stanag", "johnson"]

N50_CYCLES: dict[CriterionName, dict[str, float]] = {
    "stanag": {"detection": 1.0, "recognition": 3.0, "identification": 6.0},
    "johnson": {"detection": 1.0, "recognition": 4.0, "identification": 6.4},
}
"""Line pairs across the target with which half of the observers do each task.

"stanag": nippon.zaidan.info/seikabutsu/1998/00222, page 096. "johnson": Johnson 1958 as later sources print it.
"""

Cycles = Annotated[float, Meta(ge=0.1, le=100.0)]
"""Number of line pairs of a criterion; others are a mistake in the input."""

Divisor = Annotated[float, Meta(ge=0.1, le=100.0)]
"""Divisor k of the target's size; others are a mistake in the input."""

Quantity = Literal["delta_t_k", "contrast"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A thing to be seen in the field, and the criteria of the tasks.

    Attributes
    ----------
    size_m : float
        Characteristic size in m, 0.01 to 1000: for line pairs the critical dimension.
    delta_t_k : float or None
        Mean temperature difference to the background at the target, in K; its sign does not matter.
    delta_t_sd_k : float
        Standard deviation of the temperature on the target, added in squares.
    contrast : float or None
        Weber contrast at the target; its sign does not matter.
    reflectance, background_reflectance : float or None
        In place of `contrast`, which is then their difference divided by that of the background.
    cycles : {"stanag", "johnson"} or mapping of str to float
        N50 of each task in line pairs across `size_m`, for MRTD and MRC. Default: "stanag".
    k : mapping of str to float, or None
        For a TOD: a task can be done if a triangle of size_m / k can be judged. No public factor exists.
    cycles_per_size : float or None
        Converts a TOD to line pairs: the bar pattern that is as hard as a triangle has this number of cycles in
        the triangle's √area. None: no conversion, and a TOD needs `k`.
    search_time_s : float or None
        Time that the observer may search. None: without limit.
    view_deg, lines : float or None
        Angle of view of a camera-monitor system and its lines, for the distance of UN R46 by its pixels alone.
    title, source : str
        Name of the target, and the origin of its numbers.

    Raises
    ------
    SettingsError
        If a value is out of range, missing, or contradicts another.

    Examples
    --------
    >>> import todframes as tod
    >>> target = tod.Target(size_m=2.3, delta_t_k=2.0)
    """

    size_m: Annotated[float, Meta(ge=0.01, le=1e3)]
    delta_t_k: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None
    delta_t_sd_k: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.0
    contrast: Annotated[float, Meta(ge=-1.0, le=100.0)] | None = None
    reflectance: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    background_reflectance: Annotated[float, Meta(gt=0.0, le=1.0)] | None = None
    cycles: CriterionName | Mapping[str, Cycles] = "stanag"
    k: Mapping[str, Divisor] | None = None
    cycles_per_size: Annotated[float, Meta(ge=0.1, le=10.0)] | None = None
    search_time_s: Annotated[float, Meta(ge=0.01, le=1e5)] | None = None
    view_deg: Annotated[float, Meta(ge=0.1, le=179.0)] | None = None
    lines: Annotated[float, Meta(ge=1.0, le=1e6)] | None = None
    title: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        check_values(self)
        for name in ("cycles", "k"):
            if getattr(self, name) == {}:
                raise SettingsError(f"{name}: found no task, expected a table such as {{ recognition = 3.0 }}")
        if self.k is not None and self.cycles_per_size is not None:
            raise SettingsError("k: found it and cycles_per_size, expected one of them")
        if (self.view_deg is None) != (self.lines is None):
            missing = "view_deg" if self.view_deg is None else "lines"
            raise SettingsError(f"{missing}: is missing, expected both view_deg and lines or none")
        self._check_contrast()

    def _check_contrast(self) -> None:
        if (self.reflectance is None) != (self.background_reflectance is None):
            missing = "reflectance" if self.reflectance is None else "background_reflectance"
            raise SettingsError(f"{missing}: is missing, expected both reflectances or none")
        named = ("delta_t_k", "contrast", "reflectance")
        given = [name for name in named if getattr(self, name) is not None]
        if len(given) != 1:
            raise SettingsError(
                f"{' and '.join(given) or 'contrast'}: found {len(given)} contrasts, expected one of delta_t_k, "
                "contrast, and reflectance with background_reflectance"
            )
        if self.delta_t_sd_k and self.delta_t_k is None:
            raise SettingsError("delta_t_sd_k: is given but not used without delta_t_k")
        if not self.signal > 0.0:
            raise SettingsError(f"{given[0]}: found {getattr(self, given[0])!r}, which shows no target")

    @property
    def quantity(self) -> Quantity:
        """Quantity of `signal`: "delta_t_k" or "contrast"."""
        return "contrast" if self.delta_t_k is None else "delta_t_k"

    @property
    def signal(self) -> float:
        """Contrast at the target without sign: ΔT in K, or Weber contrast."""
        if self.delta_t_k is not None:
            return math.hypot(self.delta_t_k, self.delta_t_sd_k)
        if self.reflectance is not None and self.background_reflectance is not None:
            return abs(self.reflectance - self.background_reflectance) / self.background_reflectance
        return abs(self.contrast or 0.0)

    @property
    def r46_distance_m(self) -> float | None:
        """Distance at which UN R46 counts the target as seen, from the pixels alone; None without view and lines.

        r = size / tan(f ω / 60), ω = 60 β / (2 N) arcmin for N lines over β degrees, f = 8 (2003/97/EC, Annex I).
        """
        if self.view_deg is None or self.lines is None:
            return None
        resolution_arcmin = 60.0 * self.view_deg / (2.0 * self.lines)
        seen_deg = 8.0 * resolution_arcmin / 60.0
        return self.size_m / math.tan(math.radians(min(seen_deg, 89.0)))

    @property
    def n50_cycles(self) -> dict[str, float]:
        """N50 of each task, in line pairs across the target."""
        return N50_CYCLES[self.cycles] if isinstance(self.cycles, str) else dict(self.cycles)


def chosen_target(target: Target | Path | str, **changes: Any) -> Target:
    """Return a target, or that of a name or file, with those of the changes that are not None.

    `k` and `cycles` may be numbers, `cycles` also as a text with commas: each is the criterion of a task, which
    has the number as its name.
    """
    for name, unit in (("k", "k {}"), ("cycles", "{} line pairs")):
        value = changes.get(name)
        if isinstance(value, str) and value[:1].isdigit():
            try:
                value = [float(part) for part in value.split(",")]
            except ValueError:
                expected = "expected a name, or numbers with commas between them"
                raise SettingsError(f"{getattr(argument, name)}: found {value!r}, {expected}") from None
        if isinstance(value, int | float):
            value = [value]
        if isinstance(value, Sequence) and not isinstance(value, str):
            changes[name] = {unit.format(f"{one:g}"): float(one) for one in value}
    changes = {name: value for name, value in changes.items() if value is not None}
    return replace(find_target(target), **changes)


def find_target(asked: Target | Path | str) -> Target:
    """Return the target of this package with a name, that of a TOML file, or the one given."""
    if isinstance(asked, Target):
        return asked
    path = settings_path(asked, FOLDER, "target")
    table, texts = read_described(path, "target", SCHEMA)
    return from_table(texts | table, Target, f"{path}: [target]")
