"""The limit of a sensor: the least light or aperture, or the largest noise, for a triangle to be judged."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from msgspec import Struct, structs

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.chain.vary import NETD_HELD
from sensor_sim.limits.varied import COUPLED, SensorResult, Try, described_for, parameter_to_vary, threshold_of
from sensor_sim.thresholds.threshold import given_sizes
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, checked, distinct_numbers
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer
from todframes.parameters import (
    Kelvin,
    LimitName,
    Numbers,
    ObserverName,
    Probability,
    Progress,
    Seed,
    SensorFile,
    Tolerance,
    WeberContrast,
    counted,
)
from todframes.psychometrics.fit import FitSettings
from todframes.results.figures import INK, ReportFigure, add_legend, curve_style, plain_ticks
from todframes.results.tables import EXACT, Column, Table
from todframes.results.wording import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LONGEST_EXPOSURE_MS = 40.0
"""Exposure that IEC 62676-5 allows for the sensitivity of a camera: 1/25 s."""


class Limit(Struct, frozen=True, kw_only=True):
    """The limit of one size.

    Attributes
    ----------
    size : float
        Size of the triangle: an angle in mrad at the camera.
    status : str
        "ok"; "never_judged" or "always_judged", whatever the value within a factor of a million.
    value, error : float or None
        The limit, and half of its 95 % interval, which follows from the errors of the thresholds; 0 for a whole
        number if they allow no other one.
    is_least : bool
        Whether larger values are judged.
    own_threshold : float or None
        Threshold at the sensor's own value, in the unit of the target; None if none is reached.
    values, thresholds : tuple of float
        All values that were tried, and their thresholds; None where none is reached.
    """

    size: float
    status: str
    value: float | None
    error: float | None
    is_least: bool
    own_threshold: float | None
    values: tuple[float, ...]
    thresholds: tuple[float | None, ...]

    @property
    def shown(self) -> int | float | None:
        """Return the limit, as an int if only whole numbers were tried."""
        whole = self.value is not None and all(value.is_integer() for value in self.values)
        return int(self.value or 0) if whole else self.value


class SensorLimit(SensorResult, frozen=True, kw_only=True):
    """The limit of a sensor in one of its parameters.

    Attributes
    ----------
    parameter, unit : str
        "light", or the key of SENSOR.toml, and its unit.
    own_value : float
        The sensor's own value.
    target, level : float, str
        Contrast, SNR or ΔT in mK that has to be judged.
    limits : tuple of Limit
        A record for each size.
    exposure_ms : float or None
        Exposure of a camera that counts photons.
    holds_netd : bool
        Whether the parameter changes the light on a detector, and the NETD stays.
    """

    parameter: str
    unit: str
    own_value: float
    target: float
    level: str
    limits: tuple[Limit, ...]
    exposure_ms: float | None = None
    holds_netd: bool = False

    @property
    def _words(self) -> str:
        named = "luminance" if self.parameter == "light" else self.parameter
        return named + (f" ({self.unit})" if self.unit else "")

    def tables(self) -> list[Table]:
        """List the table of the limits."""
        columns = [
            Column(key="size", header="size (mrad)", digits=EXACT, is_name=True),
            Column(key="value", header=self._words, digits=4),
            Column(key="error", header="±", digits=1),
            Column(key="bound"),
            Column(key="own_threshold", header="threshold as it is", digits=4, rank=1),
            Column(key="status", rank=2),
        ]
        records = [
            structs.asdict(limit)
            | {"bound": ("least" if limit.is_least else "largest") if limit.value else None}
            | {"value": limit.shown, "error": limit.error or None}
            for limit in self.limits
        ]
        title = f"{self.sensor}: {self._words} at which {self._target} is judged"
        return [Table.of(title, "limit.csv", columns, records)]

    @property
    def _target(self) -> str:
        of_level = {"contrast": "a contrast of {}", "snr": "an SNR of {}", "delta_t_mk": "a ΔT of {} mK"}
        return of_level[self.level].format(f"{self.target:g}")

    def findings(self) -> list[str]:
        """Return the limits in words."""
        texts = [self._sentence(limit) for limit in self.limits]
        if self.parameter == "light" and self.exposure_ms is not None and self.exposure_ms > LONGEST_EXPOSURE_MS:
            allowed = f"IEC 62676-5 allows {LONGEST_EXPOSURE_MS:g} ms at most"
            texts.append(f"The exposure is {self.exposure_ms:g} ms; {allowed}.")
        return [*texts, NETD_HELD.format(COUPLED)] if self.holds_netd else texts

    def _sentence(self, limit: Limit) -> str:
        what = f"{self._target} at {limit.size:g} mrad"
        what = what[0].upper() + what[1:]
        if limit.value is None:
            does = "is judged at every" if limit.status == "always_judged" else "is judged at no"
            tried = f"from {plain(limit.values[0])} to {plain(limit.values[-1])}"
            return f"{what} {does} {self._words} that was tried, {tried}."
        value = f"{limit.shown}" if isinstance(limit.shown, int) else plain(limit.value)
        value += (f" ± {plain(limit.error, 1)}" if limit.error else "") + f" {self.unit}".rstrip()
        named = "a luminance" if self.parameter == "light" else self.parameter
        return f"{what} needs {named} of at {'least' if limit.is_least else 'most'} {value}."

    def figures(self) -> list[ReportFigure]:
        """List the threshold against the parameter."""
        note = "The dashed line is what has to be judged, and a cross the limit."
        return [ReportFigure(f"Threshold against {self._words}", note, self._draw, "limit.png")]

    def _draw(self, axes: Axes) -> None:
        for number, limit in enumerate(self.limits):
            known = [(x, y) for x, y in zip(limit.values, limit.thresholds, strict=True) if y is not None]
            if known:
                colour, marker = curve_style(number, len(self.limits))
                axes.plot(
                    *zip(*known, strict=True),
                    label=f"{limit.size:g} mrad",
                    color=colour,
                    marker=marker,
                )
            if limit.value is not None:
                axes.plot(limit.value, self.target, "x", color=INK, ms=9)
        axes.axhline(self.target, color=INK, ls="--", lw=0.8)
        axes.set(xscale="log", yscale="log", xlabel=self._words, ylabel=f"threshold {self.level}")
        plain_ticks(axes.xaxis, [value for limit in self.limits for value in limit.values])
        plain_ticks(
            axes.yaxis, [value for limit in self.limits for value in limit.thresholds if value is not None]
        )
        add_legend(axes)


@checked
def limit(
    sensor: Sensor | SensorFile,
    *,
    limit: LimitName,
    size_mrad: Numbers = (),
    contrast: WeberContrast | None = None,
    delta_t_k: Kelvin | None = None,
    snr: float | None = None,
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    tolerance: Tolerance = 2e-3,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> SensorLimit:
    """Find the least light or aperture, the largest noise, at which a triangle is judged.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.
    limit : str
        Instead of the curve, the limit of one number: the least light (of a camera that counts photons) or
        aperture, or the largest NETD; or any key of SENSOR.toml, such as
        optics.blur_sigma_mrad. The value nearest to the sensor's own is found, with its error.
    size_mrad : sequence of float
        Sizes of the triangle as angles at the camera in mrad.
    contrast : float, optional
        Weber contrast that has to be judged, for a camera that counts photons. IEC 62676-5 asks for 0.3.
    delta_t_k : float, optional
        Temperature difference in K that has to be judged, for a sensor with NETD.
    snr : float, optional
        Signal-to-noise ratio that has to be judged, for a sensor that does not count photons.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative error of the thresholds to reach.
    rng : int, SeedSequence or Generator
        Seed of the places of the triangle on the detectors.
    progress : function of two ints, optional
        Called with the number of sizes that are done, and of all.

    Returns
    -------
    todframes.Result
        `limits` has a record for each size.

    Raises
    ------
    SettingsError
        If a setting is invalid, the sensor has no such number, or the target does not fit the sensor.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> camera = "sample_frames/star_like.toml"
    >>> result = ss.limit(camera, limit="netd", size_mrad=[0.4], delta_t_k=0.02, tolerance=0.02)
    >>> round(result.limits[0].value)
    33
    """
    started, seed = time.perf_counter(), seed_of(rng)
    sensor = sensor_of(sensor)
    level, target = _target(sensor, contrast, delta_t_k, snr)
    judge, settings = described_for(observer, sensor)
    FitSettings(p_correct=p_correct)  # checks it
    if not len(size_mrad):
        raise SettingsError(f"{argument.size_mrad}: found none, expected sizes, with {argument.limit} {limit}")
    asked: dict[str, Any] = {"p_correct": p_correct, "tolerance": tolerance, "seed": seed}
    asked["in_mk"] = level == "delta_t_mk"
    varied = parameter_to_vary(sensor, limit)
    holds_netd = varied.check_moves(judge, in_mk=level == "delta_t_mk")
    limits = []
    for size in counted(distinct_numbers(argument.size_mrad, size_mrad), len(size_mrad), progress):

        def at_value(value: float, size: float = size) -> Try:
            at = varied.sensor_at(value)
            detectors = given_sizes(resolve(at), [], [size])[0]
            return Try.of(value, *threshold_of(at, judge, detectors, **asked), target)

        crossing = varied.crossing(at_value)
        tried = {attempt.value: attempt.threshold for attempt in crossing.tries}
        status = "always_judged" if crossing.is_judged else "never_judged"
        found = Limit(
            size=size,
            status="ok" if crossing.value is not None else status,
            value=crossing.value,
            error=crossing.error,
            is_least=crossing.is_least,
            own_threshold=tried[varied.own],
            values=tuple(tried),
            thresholds=tuple(tried.values()),
        )
        limits.append(found)
    settings |= {"p_correct": p_correct, "sensor": sensor_settings(sensor), "tolerance": tolerance}
    return SensorLimit.made(
        "limit",
        started,
        settings=settings,
        seed=seed,
        sensor=sensor.name,
        parameter=varied.name,
        unit=varied.unit,
        own_value=varied.own,
        target=target,
        level=level,
        limits=tuple(limits),
        holds_netd=holds_netd,
        exposure_ms=None if sensor.photons is None else sensor.photons.exposure_ms,
    )


def _target(
    sensor: Sensor, contrast: float | None, delta_t_k: float | None, snr: float | None
) -> tuple[str, float]:
    """Return the level and the number that has to be judged; SettingsError if it does not fit the sensor."""
    given = {"contrast": contrast, "delta_t_k": delta_t_k, "snr": snr}
    fitting = (
        ["contrast"] if sensor.level == "contrast" else ["delta_t_k", "snr"] if sensor.noise.netd_mk else ["snr"]
    )
    targets = [name for name, value in given.items() if value is not None]
    if len(targets) != 1 or targets[0] not in fitting:
        names = [getattr(argument, name) for name in fitting]
        shown = ", ".join(getattr(argument, name) for name in targets) or "no target"
        raise SettingsError(f"limit: found {shown}, expected {' or '.join(names)}, which this sensor has")
    value = given[targets[0]] or 0.0
    check_positive(getattr(argument, targets[0]), value)
    return ("delta_t_mk", 1e3 * value) if targets[0] == "delta_t_k" else (targets[0], value)
