"""Advice before a curve: what limits a sensor, sizes worth asking for, its acuity, and which number buys most."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from msgspec import Struct, structs

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.chain.vary import FILL_FACTOR, NETD_HELD, numeric_keys, value_of, vary
from sensor_sim.limits.varied import (
    COUPLED,
    SensorResult,
    adapted_to,
    described_for,
    threshold_of,
)
from sensor_sim.sweeps.goals import in_words
from sensor_sim.thresholds.threshold import (
    SATURATING,
    WITHOUT_NOISE,
    acuity_detectors,
    chosen_sizes,
    given_sizes,
    shares_at,
    smallest_size,
    threshold_at,
    what_limits,
)
from todframes.base.errors import SettingsError
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer
from todframes.parameters import ObserverName, Probability, Progress, Seed, SensorFile, Tolerance, counted
from todframes.psychometrics.fit import FitSettings
from todframes.results.figures import COLOURS, INK, ReportFigure
from todframes.results.tables import Column, Table
from todframes.results.wording import listed, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MORE = 1.1
"""Factor of each number whose effect on the threshold is stated."""

LEAST_SHOWN_PERCENT = 0.05
"""Smallest change that the table shows; the figure and `gains` have all."""

NOT_FOR_SALE = ("optics.wavelength_um",)
"""Numbers that belong to the light, not to the camera."""


class Gain(Struct, frozen=True, kw_only=True):
    """The change of the threshold that a tenth more of one number of the sensor makes.

    Attributes
    ----------
    key, unit : str
        Key of SENSOR.toml and its unit.
    value : float
        The sensor's own value.
    change_percent, error_percent : float
        Change of the threshold if the value is a tenth larger, and half of its 95 % interval: above 0, the
        triangle has to be stronger.
    has_room_above : bool
        Whether a tenth more is possible; otherwise the change is that of a tenth less, turned around.
    """

    key: str
    unit: str
    value: float
    change_percent: float
    error_percent: float
    has_room_above: bool = True


class SensorAdvice(SensorResult, frozen=True, kw_only=True):
    """Advice on a sensor.

    Attributes
    ----------
    limits : str
        A sentence: what makes answers vary at threshold.
    internal, detector, sampling : float
        Shares of the observer's noise, the detectors' noise and sampling in it; their sum is 1.
    sizes_detectors, sizes_mrad : tuple of float
        Sizes worth asking for, in detectors and as angles at the camera.
    size_detectors : float
        Size for which the gains hold.
    gains : tuple of Gain
        The numbers of the sensor that change the threshold, the one that changes most first.
    holds_netd : bool
        Whether the NETD stays where aperture and detectors change.
    acuity_detectors, acuity_mrad : float or None
        Smallest size that is judged however strong the triangle, within 2 %; None if no size is.
    """

    limits: str
    internal: float
    detector: float
    sampling: float
    sizes_detectors: tuple[float, ...]
    sizes_mrad: tuple[float, ...]
    size_detectors: float
    gains: tuple[Gain, ...]
    holds_netd: bool = False
    acuity_detectors: float | None = None
    acuity_mrad: float | None = None

    def tables(self) -> list[Table]:
        """List the table of the gains."""
        columns = [
            Column(key="key", header="number", is_name=True),
            Column(key="value", digits=4),
            Column(key="unit", none=""),
            Column(key="change_percent", header="a tenth more changes the threshold by (%)", decimals=1),
            Column(key="error_percent", header="±", digits=1),
        ]
        records = [structs.asdict(gain) for gain in self.gains if abs(gain.change_percent) >= LEAST_SHOWN_PERCENT]
        title = f"{self.sensor}: what its numbers change at {self.size_detectors:g} detectors"
        return [Table.of(title, "advice.csv", columns, records)]

    def findings(self) -> list[str]:
        """Return the advice in words."""
        angles = f"{plain(self.sizes_mrad[0])} to {plain(self.sizes_mrad[-1])} mrad at the camera"
        sizes = listed(f"{size:g}" for size in self.sizes_detectors)
        texts = [self.limits, f"Sizes worth asking for: {sizes} detectors ({angles})."]
        if self.acuity_detectors is not None and self.acuity_mrad is not None:
            acuity = f"{plain(self.acuity_detectors, 3)} detectors or {plain(self.acuity_mrad, 3)} mrad"
            texts.append(f"The acuity is {acuity}: smaller triangles are not judged, however strong they are.")
        for_sale = (
            gain
            for gain in self.gains
            if gain.key not in NOT_FOR_SALE and (gain.has_room_above or gain.change_percent > 0.0)
        )
        most = next(for_sale, None)
        if most is not None and abs(most.change_percent) > most.error_percent:
            way, share = "more", 1.0 + most.change_percent / 100.0
            if share > 1.0:  # a tenth less, by a power law
                way, share = "less", (2.0 - MORE) ** (math.log(share) / math.log(MORE))
            change = plain(100.0 * (1.0 - share), 2)
            texts.append(f"A tenth {way} of {most.key} buys most: the threshold falls by about {change} %.")
        if self.settings.get("sensor", {}).get("noise", {}).get("netd_mk", math.nan) is None:
            texts.append(
                "Without noise.netd_mk thresholds are SNRs, so that the cost of the noise is not in the table."
            )
        return [*texts, NETD_HELD.format(COUPLED)] if self.holds_netd else texts

    def figures(self) -> list[ReportFigure]:
        """List the changes as bars."""
        note = "Bars to the left: a tenth more of the number lowers the threshold."
        return [ReportFigure("What a tenth more changes", note, self._draw, "advice.png")]

    def _draw(self, axes: Axes) -> None:
        shown = self.gains[::-1]
        changes, errors = [gain.change_percent for gain in shown], [gain.error_percent for gain in shown]
        axes.barh([gain.key for gain in shown], changes, xerr=errors, color=COLOURS[0])
        axes.axvline(0.0, color=INK, lw=0.8)
        axes.set(xlabel="change of the threshold (%)")


@checked
def advise(
    sensor: Sensor | SensorFile,
    *,
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    tolerance: Tolerance = 5e-3,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> SensorAdvice:
    """State what limits a sensor, which sizes are worth asking for, and which of its numbers buys most.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.
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
        Called with the number of numbers of the sensor that are done, and of all.

    Returns
    -------
    todframes.Result
        `limits` is a sentence, `gains` has a record for each number of the sensor.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the observer is not linear.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> ss.advise("sample_frames/star_like.toml", tolerance=0.05).gains[0].key
    'noise.netd_mk'
    """
    started, seed = time.perf_counter(), seed_of(rng)
    sensor = sensor_of(sensor)
    camera = resolve(sensor)
    judge, settings = described_for(observer, sensor)
    seen = adapted_to(judge, sensor)
    FitSettings(p_correct=p_correct)  # checks it
    asked: dict[str, Any] = {"p_correct": p_correct, "seed": seed}
    sizes = chosen_sizes(camera, seen, smallest_size(camera, seen, **asked))
    acuity, _ = acuity_detectors(camera, seen, **asked) or (None, None)
    asked["tolerance"] = tolerance
    thresholds = [threshold_at(camera, seen, size, n_points=0, **asked) for size in sizes]
    shares = [shares_at(threshold.chain, "snr", threshold.found.threshold) for threshold in thresholds]
    statuses = [threshold.found.status for threshold in thresholds]
    mean, sentence = what_limits(sizes, shares, statuses, WITHOUT_NOISE if sensor.photons is None else SATURATING)
    worth_asking = [size for size, status in zip(sizes, statuses, strict=True) if status == "ok"] or sizes
    middle = worth_asking[len(worth_asking) // 2]
    return SensorAdvice.made(
        "advise",
        started,
        settings=settings | {"p_correct": p_correct, "sensor": sensor_settings(sensor), "tolerance": tolerance},
        seed=seed,
        sensor=sensor.name,
        limits=sentence,
        **mean._asdict(),
        sizes_detectors=tuple(worth_asking),
        sizes_mrad=tuple(size * camera.pitch_mrad for size in worth_asking),
        size_detectors=middle,
        gains=_gains(sensor, judge, middle, progress, asked),
        holds_netd=sensor.level == "snr" and sensor.noise.netd_mk is not None and not sensor.noise.couple_netd,
        acuity_detectors=acuity,
        acuity_mrad=None if acuity is None else acuity * camera.pitch_mrad,
    )


def _gains(
    sensor: Sensor, observer: Observer, size_detectors: float, progress: Progress | None, asked: dict[str, Any]
) -> tuple[Gain, ...]:
    """Return what a tenth more of each number changes, the largest first; empty if the size has no threshold. The
    trials of all sensors have the same places, so the errors of two thresholds cancel in part; they are stated as
    if they did not.
    """
    asked = asked | {"in_mk": sensor.level == "snr" and sensor.noise.netd_mk is not None}
    before, error = threshold_of(sensor, observer, size_detectors, **asked)
    if before is None:
        return ()
    size_mrad = size_detectors * sensor.pitch_mrad
    keys = [key for key, is_whole in numeric_keys(sensor).items() if not is_whole and key != FILL_FACTOR]
    values = {key: value for key in keys if (value := value_of(sensor, key))}
    gains = []
    for key, value in counted(values.items(), len(values), progress):
        for factor in (MORE, 1.0 / MORE):  # some numbers have no room above
            try:
                changed = vary(sensor, {key: factor * value})
                at_size = given_sizes(resolve(changed), [], [size_mrad])[0]
                after, other = threshold_of(changed, observer, at_size, **asked)
            except SettingsError:
                continue
            if after is None:
                continue
            if after != before:
                change = (after / before) ** (1.0 if factor == MORE else -1.0) - 1.0
                gains.append(
                    Gain(
                        key=key,
                        unit=in_words(key)[1],
                        value=value,
                        change_percent=100.0 * change,
                        error_percent=100.0 * math.hypot(error, other),
                        has_room_above=factor == MORE,
                    )
                )
            break
    return tuple(sorted(gains, key=lambda gain: -abs(gain.change_percent)))
