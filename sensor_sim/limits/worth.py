"""The worth of an enhancement: the light, aperture or noise that gives a sensor the same thresholds."""

from __future__ import annotations

import math
import time
from functools import cache
from typing import TYPE_CHECKING, Any

from msgspec import Struct, structs

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.limits.varied import Crossing, SensorResult, Try, described_for, parameter_to_vary, threshold_of
from sensor_sim.thresholds.threshold import given_sizes
from todframes.base.errors import DataError
from todframes.base.reading import checked
from todframes.base.safe_text import in_utf8
from todframes.base.seeds import Rng, seed_of
from todframes.comparison.records import REACHED, Comparison
from todframes.observers.interface import Observer
from todframes.parameters import (
    LimitName,
    ObserverName,
    Progress,
    ResultFile,
    Seed,
    SensorFile,
    Tolerance,
    counted,
)
from todframes.results.data import Fit, Group, ResultWarning
from todframes.results.figures import INK, ReportFigure, add_legend, curve_style
from todframes.results.result import Result, load_result
from todframes.results.tables import EXACT, Column, Table
from todframes.results.wording import interval_phrase, level_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {"light": "the light", "noise.netd_mk": "the NETD", "noise.frames_integrated": "the frames averaged"}
"""Words for what a factor multiplies."""

FITS_WITHIN = 1.1
"""Factor by which the sensor's threshold may lie outside of the interval of the frames' without a warning."""

LEVELS = {"contrast": ("contrast", 1.0), "snr": ("snr", 1.0), "delta_t_mk": ("mk", 1.0), "delta_t_k": ("mk", 1e3)}
"""Levels of frames in the sensor's quantities: SNR, contrast or ΔT in mK, and how many of its units one is."""


class Worth(Struct, frozen=True, kw_only=True):
    """The worth of an algorithm at one size.

    Attributes
    ----------
    algorithm : str
    size_detectors : float
    status : str
        "ok", or that of the threshold without the algorithm or with it, such as "never_reached".
    ratio : float or None
        Threshold with the algorithm over that without; None if one of them is missing.
    ratio_ci95 : (float or None, float or None)
        Its interval; without a ratio its bound.
    factor : float or None
        Factor of the sensor's number that changes its threshold by the same ratio; None if there is none.
    factor_ci95 : (float or None, float or None)
        Factors for the ends of the interval of the ratio; an end is None if there is none.
    """

    algorithm: str
    size_detectors: float
    status: str = "ok"
    ratio: float | None
    ratio_ci95: tuple[float | None, float | None]
    factor: float | None
    factor_ci95: tuple[float | None, float | None]


class SensorWorth(SensorResult, frozen=True, kw_only=True):
    """The worth of the algorithms of a comparison in one number of a sensor.

    Attributes
    ----------
    parameter, unit : str
        "light" or the key of SENSOR.toml, and its unit.
    own_value : float
        The sensor's own value.
    worth : tuple of Worth
        A record for each algorithm and size.
    unchecked_level : str or None
        Level of the frames if the sensor has no threshold in it, so that the two cannot be compared.
    """

    parameter: str
    unit: str
    own_value: float
    worth: tuple[Worth, ...]
    unchecked_level: str | None = None

    @property
    def _of(self) -> str:
        return NAMES.get(self.parameter, self.parameter)

    def tables(self) -> list[Table]:
        """List the table of the factors."""
        columns = [
            Column(key="algorithm", is_name=True, wraps=True),
            Column(key="size_detectors", header="size (detectors)", digits=EXACT),
            Column(key="ratio", header="ratio of thresholds", digits=3),
            Column(key="ratio_ci95", header="95 % interval", interval="ratio", digits=3, rank=1),
            Column(key="factor", header=f"times {self._of}", digits=3),
            Column(key="factor_ci95", header="95 % interval", interval="factor", digits=3),
            Column(key="status", rank=2),
        ]
        records = [structs.asdict(worth) for worth in self.worth]
        return [Table.of(f"{self.sensor}: worth in {self._of}", "worth.csv", columns, records)]

    def findings(self) -> list[str]:
        """Return the factors in words."""
        texts = [self._sentence(worth) for worth in self.worth]
        if self.unchecked_level is not None:
            level = level_name(self.unchecked_level)
            texts.append(f"Whether the sensor took the frames cannot be checked: it has no threshold {level}.")
        return texts

    def _sentence(self, worth: Worth) -> str:
        at = f"{worth.algorithm} at {worth.size_detectors:g} detectors"
        low, high = (None if end is None else plain(end, 3) for end in worth.factor_ci95)
        if worth.ratio is None:
            bound = f"at most {high} times {self._of}" if high else f"at least {low} times {self._of}"
            why = f"because a threshold {REACHED.get(worth.status, 'is missing')}"
            return f"{at}: {bound if low or high else 'no factor'}, {why}."
        if worth.factor is None:
            return f"{at}: no factor of {self._of} changes the threshold by {plain(worth.ratio, 3)}."
        interval = f"{low or 'no limit'} to {high or 'no limit'}"
        return f"{at}: as good as {plain(worth.factor, 3)} times {self._of} ({interval})."

    def figures(self) -> list[ReportFigure]:
        """List the factors against size."""
        note = f"Above 1, the algorithm does what more of {self._of} would do. Bars are 95 % intervals."
        return [ReportFigure(f"Worth in {self._of}", note, self._draw, "worth.png")]

    def _draw(self, axes: Axes) -> None:
        names = list(dict.fromkeys(worth.algorithm for worth in self.worth))
        for number, name in enumerate(names):
            colour, marker = curve_style(number, len(names))
            shown = [worth for worth in self.worth if worth.algorithm == name and worth.factor is not None]
            axes.plot(
                [worth.size_detectors for worth in shown],
                [worth.factor or math.nan for worth in shown],
                color=colour,
                marker=marker,
                label=name,
            )
            for worth in shown:
                low, high = worth.factor_ci95
                if low is not None and high is not None:
                    axes.vlines(worth.size_detectors, low, high, color=colour)
        axes.axhline(1.0, color=INK, ls=":", lw=0.8)
        axes.set(xscale="log", yscale="log", xlabel="size (detectors)", ylabel=f"times {self._of}")
        add_legend(axes)


@checked
def worth(
    result: Result | ResultFile,
    sensor: Sensor | SensorFile,
    *,
    limit: LimitName = "light",
    observer: ObserverName | Observer = "pyramid",
    tolerance: Tolerance = 2e-3,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> SensorWorth:
    """State what the enhancements of a comparison are worth: as good as 1.3 times the light.

    Parameters
    ----------
    result : Result or path
        The comparison, result.json of `todframes compare`. Sizes are in detectors, or in mrad at the eye as the
        sensor's display shows them.
    sensor : Sensor or path
        SENSOR.toml of the camera that took the frames; `todframes noise` and `mtf` measure what it holds.
    limit : str
        Number of the sensor: light (of a camera that counts photons), aperture, netd, or any key of SENSOR.toml,
        such as noise.frames_integrated.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.
    tolerance : float
        Relative error of the sensor's thresholds to reach.
    rng : int, SeedSequence or Generator
        Seed of the places of the triangle on the detectors.
    progress : function of two ints, optional
        Called with the number of algorithms and sizes that are done, and of all.

    Returns
    -------
    todframes.Result
        `worth` has a record for each algorithm and size.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the sensor has no such number.
    DataError
        If the result is no comparison, or has no ratio.
    """
    started, seed = time.perf_counter(), seed_of(rng)
    sensor = sensor_of(sensor)
    where = "the result" if isinstance(result, Result) else in_utf8(str(result))
    loaded = result if isinstance(result, Result) else load_result(result)
    if not isinstance(loaded, Comparison):
        raise DataError(f"{where}: command: found {loaded.command!r}, expected compare")
    if not loaded.is_of_algorithms:
        raise DataError(f"{where}: found a comparison of several conditions, expected algorithms on one dataset")
    varied = parameter_to_vary(sensor, limit)
    reference, *algorithms = loaded.conditions
    rows = [
        (each.name, ratio, next((fit.status for fit in (with_it, without) if fit.status != "ok"), "ok"))
        for each in algorithms
        for ratio, without, with_it in zip(each.ratios, reference.fits, each.fits, strict=True)
    ]
    if all({ratio.ratio, ratio.ratio_above, ratio.ratio_below} == {None} for _, ratio, _ in rows):
        raise DataError(f"{where}: found no ratio of thresholds, expected at least one")
    judge, settings = described_for(observer, sensor)
    first = reference.fits[0]
    asked: dict[str, Any] = {"p_correct": first.p_correct, "tolerance": tolerance, "seed": seed}
    in_mk = sensor.noise.netd_mk is not None and sensor.level == "snr"
    varied.check_moves(judge, in_mk=in_mk)

    @cache
    def threshold_at(value: float, size_detectors: float) -> tuple[float | None, float]:
        return threshold_of(varied.sensor_at(value), judge, size_detectors, in_mk=in_mk, **asked)

    records = []
    for name, ratio, status in counted(rows, len(rows), progress):
        size = _size_detectors(ratio.group, sensor, where)
        before, _ = threshold_at(varied.own, size)
        if before is None:
            raise DataError(f"{where}: the sensor has no threshold at {size:g} detectors, expected one")

        def crossing(wanted: float, size: float = size, before: float = before) -> Crossing:
            return varied.crossing(lambda value: Try.of(value, *threshold_at(value, size), wanted * before))

        ends = ratio.ratio_ci95 or (ratio.ratio_above, ratio.ratio_below)
        found = [None if wanted is None else crossing(wanted) for wanted in (ratio.ratio, *ends)]
        factor, *factors = (None if one is None or one.value is None else one.value / varied.own for one in found)
        if any(one is not None and one.value is not None and one.is_least for one in found):
            factors.reverse()  # the threshold falls as the number grows
        records.append(
            Worth(
                algorithm=name,
                size_detectors=size,
                status=status,
                ratio=ratio.ratio,
                ratio_ci95=ends,
                factor=factor,
                factor_ci95=(factors[0], factors[1]),
            )
        )
    quantity, unit = LEVELS.get(first.level, ("", 1.0))
    is_known = quantity in ((sensor.level, "mk") if in_mk else (sensor.level,))
    warnings: list[ResultWarning] = []
    for fit in reference.fits if is_known else ():
        size = _size_detectors(fit.group, sensor, where)
        own, _ = threshold_of(sensor, judge, size, in_mk=quantity == "mk", **asked)
        warnings += [] if own is None else _mismatch(fit, own / unit)
    return SensorWorth.made(
        "worth",
        started,
        settings=settings | {"sensor": sensor_settings(sensor), "tolerance": tolerance, "limit": limit},
        seed=seed,
        warnings=warnings,
        sensor=sensor.name,
        parameter=varied.name,
        unit=varied.unit,
        own_value=varied.own,
        worth=tuple(records),
        unchecked_level=None if is_known else first.level,
    )


def _mismatch(fit: Fit, own: float) -> list[ResultWarning]:
    """Return a warning if the threshold of the sensor is not that of the frames without an algorithm."""
    if fit.threshold is None:
        return []
    low, high = fit.threshold_ci95 or (None, None)
    if (low or 0.0) / FITS_WITHIN <= own <= (high or math.inf) * FITS_WITHIN:
        return []
    of_frames, of_sensor, factor = (plain(value) for value in (fit.threshold, own, own / fit.threshold))
    message = (
        f"without an algorithm, the frames have the threshold {level_name(fit.level)} {of_frames} (95 % interval "
        f"{interval_phrase((low, high))}), and the sensor {of_sensor}, {factor} times that. The file does not "
        "describe the camera of these frames, or another observer judged them, and the worth is that in another "
        "camera. Measure the camera with todframes noise and mtf"
    )
    return [
        ResultWarning(code="sensor_mismatch", group=fit.group, message=message, found=own, expected=fit.threshold)
    ]


def _size_detectors(group: Group, sensor: Sensor, where: str) -> float:
    """Return the size of a group in detectors."""
    if "size_detectors" in group:
        return float(group["size_detectors"])
    if "size_mrad" in group:
        return given_sizes(resolve(sensor), [], [float(group["size_mrad"]) / sensor.magnification])[0]
    raise DataError(f"{where}: found groups without size_mrad or size_detectors, expected one of them")
