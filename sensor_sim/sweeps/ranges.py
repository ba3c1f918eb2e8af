"""Range in the field of each design of a sweep, from its thresholds over sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.field.acquisition import first_range
from todframes.field.atmosphere import Atmosphere, find_atmosphere
from todframes.field.target import Quantity, Target, chosen_target
from todframes.field.threshold_curve import ThresholdCurve

NAME = "the sweep"
"""Name of the curves in messages."""


class DesignRange(NamedTuple):
    """Range of a design; NaN unless `status` is "ok". `at_least_km` is a bound where the curve ends before it.

    `status` is that of `todframes.field.acquisition.TaskRange`, or "too_few_sizes" for less than two thresholds.
    """

    status: str
    range_km: float = math.nan
    at_least_km: float = math.nan


class Aim(NamedTuple):
    """The target and the air for which designs are compared."""

    target: Target
    atmosphere: Atmosphere

    def check(self, p_correct: float, *, quantity: Quantity = "delta_t_k", name: str = NAME) -> None:
        """Raise SettingsError if target or air cannot be used with a TOD in a quantity."""
        sizes = np.array([2.0, 1.0])
        first_range(
            ThresholdCurve.of_sizes(sizes, 2.0 / sizes, p_correct=p_correct, quantity=quantity, name=name), *self
        )

    def range_of(
        self,
        size_mrad: FloatArray,
        threshold: FloatArray,
        status: Sequence[str],
        p_correct: float,
        quantity: Quantity = "delta_t_k",
    ) -> DesignRange:
        """Return the range of a design from its thresholds, NaN where there is none, in any order of sizes."""
        known = np.flatnonzero(np.isfinite(threshold))
        known = known[np.argsort(-size_mrad[known])]
        own = {"p_correct": p_correct, "quantity": quantity, "name": NAME}
        unreached = [size for size, one in zip(size_mrad, status, strict=True) if one == "never_reached"]
        try:
            curve = ThresholdCurve.of_sizes(size_mrad[known], threshold[known], unreached_mrad=unreached, **own)
            found = first_range(curve, *self)
        except DataError:
            return DesignRange("too_few_sizes")
        values = (math.nan if one is None else one for one in (found.range_km, found.at_least_km))
        return DesignRange(found.status, *values)


def chosen_aim(
    target: Target | Path | str | None, atmosphere: Atmosphere | Path | str | None, k: float | None
) -> Aim | None:
    """Return the target and the air of these names or files; None if there is no target. SettingsError if one of
    them is missing or invalid.
    """
    if target is None:
        for name, value in ((argument.atmosphere, atmosphere), (argument.k, k)):
            if value is not None:
                raise SettingsError(f"{name}: is given but not used without {argument.target}")
        return None
    if atmosphere is None:
        raise SettingsError(f"{argument.atmosphere}: is missing, expected it beside {argument.target}")
    return Aim(chosen_target(target, k=k), find_atmosphere(atmosphere))
