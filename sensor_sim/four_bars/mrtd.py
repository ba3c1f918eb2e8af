"""The call `mrtd`: MRTD of a sensor beside its TOD, by the literature's form and the model observer, and TTP."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.chain.transfer import band_limit_cyc_per_mrad, stages
from sensor_sim.thresholds.bars import BarChain
from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, checked, distinct_numbers
from todframes.base.seeds import Rng, seed_of
from todframes.field.ttp import (
    V50_CYCLES,
    at_the_eye,
    contrast_threshold,
    cycles_of_contrast,
    eye_mtf,
    noise_bandwidth,
    noise_gain_root_hz,
)
from todframes.observers.interface import Observer, resolve_observer
from todframes.parameters import (
    Against,
    Direction,
    Numbers,
    ObserverName,
    Probability,
    Progress,
    Seed,
    SensorFile,
    SignalToNoise,
    Tolerance,
    counted,
)
from todframes.psychometrics.threshold_search import ComputedThreshold
from todframes.results.advice import missed_tolerance
from todframes.results.data import Fit, Group, Record, ResultWarning, as_read
from todframes.results.figures import COLOURS, INK, ReportFigure, add_legend, plain_ticks
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FREQUENCIES_NYQUIST = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4)
"""Frequencies of the bars, in units of Nyquist, if none are given."""

SIZES_DETECTORS = (3.0, 4.0, 5.0, 6.0, 8.0)
"""Sizes of the triangles, √area in detectors, if none are given."""

LLOYD_SNR = 2.25
"""Signal-to-noise ratio that an observer of bars needs: a usual value of the literature's form."""

EYE_TIME_S = 0.1
"""Time over which the eye integrates frames (Hogervorst et al. 2001, section 8: 100 ms)."""

LLOYD_FACTOR = math.pi**2 / 8.0
"""Inverse of the mean, over a bar, of the first harmonic of bars of amplitude 1: (4/π · 2/π)⁻¹."""

SHIFT = 0.5
"""Factor of the frequency by which MRTD and TOD approximately match (Hogervorst et al. 2001, Figure 7)."""

NODES = 400
"""Number of frequencies of the integral of TTP."""

NOTE = (
    "Frequencies of bars are divided by the Nyquist frequency; 1 / size of triangles is in detectors⁻¹. Dotted: "
    "the bars at half their frequency, as in Figure 7 of Hogervorst et al. 2001."
)


STANAG = (
    "A report by STANAG 4349 takes the column `best phase` up to the Nyquist frequency, of bars upright and lying "
    "(`--direction`). The range of STANAG 4347 takes the mean of the two (mrtd_best_phase.csv)."
)


class BarsAt(msgspec.Struct, frozen=True, kw_only=True):
    """Thresholds of bars of one frequency.

    Attributes
    ----------
    frequency_cyc_per_mrad, frequency_nyquist : float
        Frequency, also in units of the Nyquist frequency.
    lloyd_mrtd_mk : float or None
        MRTD by Lloyd's form in mK; None beyond the Nyquist frequency and without NETD.
    status, best_status : str
        "ok", or the reason why there is no threshold: as a mean over the places of the bars on the detectors, and
        at the best place.
    threshold_snr, best_threshold_snr : float or None
        Threshold as an SNR, for both; None if there is none. The `_error` of each is half its 95 % interval.
    mrtd_mk, best_mrtd_mk : float or None
        Threshold as a temperature difference in mK, for both; None without NETD. Each has its `_error` too.
    """

    frequency_cyc_per_mrad: float
    frequency_nyquist: float
    lloyd_mrtd_mk: float | None
    status: str
    threshold_snr: float | None
    threshold_snr_error: float | None
    mrtd_mk: float | None
    mrtd_mk_error: float | None
    best_status: str
    best_threshold_snr: float | None
    best_threshold_snr_error: float | None
    best_mrtd_mk: float | None
    best_mrtd_mk_error: float | None


class Ttp(msgspec.Struct, frozen=True, kw_only=True):
    """Targeting task performance (TTP) for a target that the display shows at its gain.

    Attributes
    ----------
    delta_t_k : float
        ΔT of the target.
    contrast : float
        Contrast at which the display shows it: its gain.
    cyc_per_mrad : float
        ∫ √(contrast / threshold) df; times size / range in mrad it is V.
    v50_cycles : dict of float
        V at which half of the observers do each task.
    settings : dict
        Settings of the eye, and where public codes disagree.
    """

    delta_t_k: float
    contrast: float
    cyc_per_mrad: float
    v50_cycles: dict[str, float]
    settings: Json


class SensorMrtd(Result, frozen=True, kw_only=True):
    """Thresholds of four bars, and the TOD beside them.

    Attributes
    ----------
    sensor : str
        The sensor's name.
    nyquist_cyc_per_mrad : float
        Nyquist frequency of the detectors.
    settings : dict
        Observer, bars, sensor, and the constants of Lloyd's form.
    bars : tuple of BarsAt
        A record for each frequency, in rising order.
    tod : tuple of Fit
        Thresholds of triangles.
    ttp : Ttp or None
        None without NETD.
    """

    sensor: str
    nyquist_cyc_per_mrad: float
    bars: tuple[BarsAt, ...]
    tod: tuple[Fit, ...]
    ttp: Ttp | None = None

    @property
    def name(self) -> str:
        """Return the sensor's name."""
        return self.sensor

    @property
    def _in_mk(self) -> bool:
        return self.ttp is not None

    @property
    def _keys(self) -> tuple[str, str]:
        """Keys of the thresholds in the unit shown: as a mean over places, and at the best place."""
        return ("mrtd_mk", "best_mrtd_mk") if self._in_mk else ("threshold_snr", "best_threshold_snr")

    def tables(self) -> list[Table]:
        """List the tables of the bars and of the triangles."""
        return [self._bars_table(), self._tod_table()]

    def _bars_table(self) -> Table:
        title = (
            f"{self.sensor}: four bars, {100 * self.settings['p_correct']:g} % correct of two displays; "
            f"Nyquist {self.nyquist_cyc_per_mrad:.4g} cycles/mrad"
        )
        columns = [
            Column(key="frequency_cyc_per_mrad", header="cycles/mrad", digits=4),
            Column(key="frequency_nyquist", header="Nyquist", digits=3),
        ]
        (averaged, best), unit = self._keys, "mK" if self._in_mk else "SNR"
        if self._in_mk:
            columns.append(Column(key="lloyd_mrtd_mk", header="Lloyd (mK)", digits=3))
        columns += [
            Column(key=averaged, header=f"bars ({unit})", digits=4),
            Column(key=f"{averaged}_error", header="±", digits=1, rank=1),
            Column(key=best, header=f"best phase ({unit})", digits=4),
            Column(key=f"{best}_error", header="± ", digits=1, rank=1),
            Column(key="status", rank=2, is_key=True),
        ]
        return Table.of(title, "bars.csv", columns, [msgspec.structs.asdict(bars) for bars in self.bars])

    def _tod_table(self) -> Table:
        records: list[Json] = [
            {
                "size_detectors": fit.group["size_detectors"],
                "inverse": 1.0 / float(fit.group["size_detectors"]),
                "snr": fit.threshold,
                "delta_t_mk": fit.delta_t_mk,
                "status": fit.status,
            }
            for fit in self.tod
        ]
        columns = [
            Column(key="size_detectors", header="size in detectors"),
            Column(key="inverse", header="1 / size", digits=3),
            Column(key="snr", header="SNR", digits=4),
            *([Column(key="delta_t_mk", header="TOD (mK)", digits=4)] if self._in_mk else []),
            Column(key="status", rank=1, is_key=True),
        ]
        title = f"TOD: triangles, {100 * self.settings['p_correct']:g} % correct of four orientations"
        return Table.of(title, "tod.csv", columns, records)

    def findings(self) -> list[str]:
        """Return the findings in words."""
        other = "a uniform square of their mean" if self.settings["against"] == "square" else "the background"
        key, (what, unit) = self._keys[0], ("MRTD", " mK") if self._in_mk else ("threshold SNR", "")
        known = [
            (value, bars.frequency_nyquist) for bars in self.bars if (value := getattr(bars, key)) is not None
        ]
        ends = " and ".join(
            f"{plain(value)}{unit} at {frequency:g} times the Nyquist frequency"
            for value, frequency in dict.fromkeys((known[0], known[-1]) if known else ())
        )
        texts = [f"The {what} of the bars is {ends}."] if ends else []
        unreached = [bars.frequency_nyquist for bars in self.bars if bars.status == "never_reached"]
        if unreached:
            texts.append(f"No contrast is enough from {min(unreached):g} times the Nyquist frequency on.")
        if self.ttp is not None:
            per_mrad = self.ttp.cyc_per_mrad
            sizes = ", ".join(f"{task} {v50 / per_mrad:.3g}" for task, v50 in self.ttp.v50_cycles.items())
            texts.append(
                f"TTP: a target of {self.ttp.delta_t_k:g} K, shown at contrast {self.ttp.contrast:g}, has V = "
                f"{self.ttp.cyc_per_mrad:.4g} for each mrad of its size. Half of the observers need, in mrad: "
                f"{sizes}."
            )
        return [*texts, f"The display without bars shows {other}."]

    def advice(self) -> list[str]:
        """Return which column a report of the NATO standards takes, and why Lloyd's form lies elsewhere."""
        known = [one for one in self.bars if one.lloyd_mrtd_mk is not None and one.mrtd_mk is not None]
        if not known:
            return []
        half = min(known, key=lambda one: abs(one.frequency_nyquist - 0.5))
        assert half.lloyd_mrtd_mk is not None and half.mrtd_mk is not None
        snr, p_correct = self.settings["lloyd"]["snr"], self.settings["p_correct"]
        own, same = snr_of(p_correct), NormalDist().cdf(snr / math.sqrt(2.0))
        ratio = f"{half.lloyd_mrtd_mk / half.mrtd_mk:.2g}"
        return [
            STANAG,
            f"Lloyd's MRTD is {ratio} times that of the bars at {half.frequency_nyquist:g} times the Nyquist "
            f"frequency: it asks for an SNR of {snr:g} in a bar, where {100.0 * p_correct:g} % correct of two "
            f"displays need {own:.2g} ({argument.p_correct} {same:.3f} needs the same). It leaves out the number "
            "and the length of the bars, and divides by the MTF of hold and display, which damp the noise, too.",
        ]

    def figures(self) -> list[ReportFigure]:
        """List MRTD and TOD on one axis, as in Figure 7 of the paper."""
        return [ReportFigure(f"{self.sensor}: four bars and triangles", NOTE, self._draw, "mrtd.png")]

    def _draw(self, axes: Axes) -> None:
        shown: list[float] = []

        def line(x: Sequence[float], y: Sequence[float | None], label: str, **style: Any) -> None:
            known = [(at, value) for at, value in zip(x, y, strict=True) if value is not None]
            if known:
                axes.plot(*zip(*known, strict=True), label=label, **style)
                shown.extend(other for _, other in known)

        of_nyquist = [bars.frequency_nyquist for bars in self.bars]
        averaged, best = ([getattr(bars, key) for bars in self.bars] for key in self._keys)
        inverse = [1.0 / float(fit.group["size_detectors"]) for fit in self.tod]
        tod = [fit.delta_t_mk if self._in_mk else fit.threshold for fit in self.tod]
        line(inverse, tod, "TOD", color=INK, marker="^", lw=2.0)
        line(of_nyquist, averaged, "bars, mean over phases", color=COLOURS[0], marker="o")
        line(of_nyquist, best, "bars, best phase", color=COLOURS[2], marker="s")
        line(
            [SHIFT * frequency for frequency in of_nyquist],
            averaged,
            f"bars, frequency × {SHIFT:g}",
            color=COLOURS[0],
            ls=":",
        )
        if self._in_mk:
            line(of_nyquist, [bars.lloyd_mrtd_mk for bars in self.bars], "Lloyd", color=COLOURS[4], ls="--")
        axes.axvline(1.0, color=INK, ls=":", lw=0.8)
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="frequency / Nyquist, or 1 / size (detectors⁻¹)",
            ylabel="threshold ΔT (mK)" if self._in_mk else "threshold SNR",
        )
        plain_ticks(axes.xaxis, [*of_nyquist, *inverse])
        if shown:
            plain_ticks(axes.yaxis, shown)
        add_legend(axes)

    def data_files(self) -> dict[str, bytes]:
        """Return the tables, and with NETD the MRTDs in K, which `todframes range` reads."""
        keys = {"mrtd": "mrtd_mk", "mrtd_best_phase": "best_mrtd_mk", "mrtd_lloyd": "lloyd_mrtd_mk"}
        in_k = {f"{name}.csv": self._in_k(key).encode() for name, key in keys.items()} if self._in_mk else {}
        return {**super().data_files(), **in_k}

    def _in_k(self, key: str) -> str:
        has_ends, lines = key != "lloyd_mrtd_mk", []
        for bars in self.bars:
            value, error = getattr(bars, key), getattr(bars, f"{key}_error", None)
            if value is not None:
                ends = f",{(value - error) / 1e3!r},{(value + error) / 1e3!r}" if has_ends else ""
                lines.append(f"{bars.frequency_cyc_per_mrad!r},{value / 1e3!r}{ends}")
        head = "frequency_cyc_per_mrad,mrtd_k" + ",ci95_low,ci95_high" * has_ends
        return "\n".join([head, *lines, ""])


def lloyd_mrtd_mk(frequency_cyc_per_mrad: ArrayLike, sensor: Sensor, *, snr: float) -> FloatArray:
    """Compute MRTD in mK by the literature's form: (π²/8) · SNR · NETD · (f / MTF) · √(α β / (t_e F)). α = β is
    the width of a detector and t_e F the number of frames that the eye integrates. MTF is that of all stages, the
    eye left out; where it is 0 the MRTD is infinite. Fixed pattern noise, sampling and the length of the bars have
    no part in it. Lloyd 1975, Thermal Imaging Systems, as quoted by later sources.
    """
    noise = sensor.noise
    f = np.asarray(frequency_cyc_per_mrad, dtype=np.float64)
    mtf = system_mtf(f, sensor)
    assert noise.netd_mk is not None
    with np.errstate(divide="ignore"):
        falls = f / np.maximum(mtf, 0.0)
    of_noise = LLOYD_FACTOR * snr * noise.netd_mk
    return np.asarray(of_noise * falls * sensor.width_mrad / math.sqrt(noise.frames_integrated))


def snr_of(p_correct: float) -> float:
    """Return d′ of a proportion correct of two displays: √2 Φ⁻¹(P). Green & Swets 1966."""
    return math.sqrt(2.0) * NormalDist().inv_cdf(p_correct)


def system_mtf(frequency_cyc_per_mrad: FloatArray, sensor: Sensor) -> FloatArray:
    """Return the transfer along x of all stages: optics, detector, sample & hold, electronics and display."""
    of = stages(frequency_cyc_per_mrad, camera=resolve(sensor))
    return np.asarray(of["pre_sample"] * of["post_sample"])


def bars_at(
    frequency_cyc_per_mrad: float,
    averaged: ComputedThreshold,
    best: ComputedThreshold,
    sensor: Sensor,
    *,
    lloyd_snr: float,
) -> BarsAt:
    """Return the record of one frequency."""
    camera = resolve(sensor)
    nyquists, mk_per_snr = frequency_cyc_per_mrad / camera.nyquist_cyc_per_mrad, camera.mk_per_snr
    values: dict[str, Any] = {}
    for prefix, computed in (("", averaged), ("best_", best)):
        values[f"{prefix}status"] = computed.status
        for name, snr in (("", computed.threshold), ("_error", computed.numerical_error)):
            values[f"{prefix}threshold_snr{name}"] = snr
            in_mk = None if snr is None or mk_per_snr is None else snr * mk_per_snr
            values[f"{prefix}mrtd_mk{name}"] = in_mk
    lloyd = None
    if mk_per_snr is not None and nyquists <= 1.0 + 1e-9:
        value = float(lloyd_mrtd_mk(frequency_cyc_per_mrad, sensor, snr=lloyd_snr))
        lloyd = value if math.isfinite(value) else None
    return BarsAt(
        frequency_cyc_per_mrad=frequency_cyc_per_mrad, frequency_nyquist=nyquists, lloyd_mrtd_mk=lloyd, **values
    )


def sensor_ttp(sensor: Sensor, *, delta_t_k: float, width_deg: float, eye_time_s: float) -> Ttp:
    """Compute TTP of a sensor with NETD for a target that the display shows at the contrast of its gain.
    CTF_sys(f) = CTF(f / M) / MTF(f) · √(1 + α² σ²), M being the magnification and σ² the noise in a channel of the
    eye: the density of the dynamic noise of a frame, (gain · NETD / ΔT)² · pitch² · frame time, times the
    bandwidths of channel, eye, hold and display along x and y. The frame time is `eye_time_s` over the frames
    integrated.
    """
    camera, display, noise = resolve(sensor), sensor.display, sensor.noise
    assert noise.netd_mk is not None
    end = band_limit_cyc_per_mrad(camera.optics)
    f = np.geomspace(1e-3, 1.0, NODES) * end
    luminance, scale = display.background_luminance_cd_m2, sensor.magnification
    eye = contrast_threshold(at_the_eye(f, scale), luminance_cd_m2=luminance, width_deg=width_deg)
    of = stages(f, camera=camera)
    after = np.abs(of["post_sample"]) * eye_mtf(f / scale, luminance_cd_m2=luminance)
    along_x, along_y = noise_bandwidth(f, after)
    contrast_sd = display.gain * noise.netd_mk / 1e3 / delta_t_k
    density = contrast_sd**2 * camera.pitch_mrad**2 * eye_time_s / noise.frames_integrated
    gain = noise_gain_root_hz(luminance)
    with np.errstate(divide="ignore"):
        threshold = eye / np.maximum(system_mtf(f, sensor), 0.0)
    threshold *= np.sqrt(1.0 + gain**2 * density * along_x * along_y)
    return Ttp(
        delta_t_k=delta_t_k,
        contrast=display.gain,
        cyc_per_mrad=cycles_of_contrast(f, threshold, display.gain),
        v50_cycles=V50_CYCLES,
        settings={"width_deg": width_deg, "eye_time_s": eye_time_s},
    )


@checked
def mrtd(
    sensor: Sensor | SensorFile,
    *,
    frequency_nyquist: Numbers = FREQUENCIES_NYQUIST,
    size_detectors: Numbers = SIZES_DETECTORS,
    against: Against = "square",
    direction: Direction = "upright",
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    lloyd_snr: SignalToNoise = LLOYD_SNR,
    ttp_delta_t_k: float = 2.0,
    ttp_width_deg: float = 15.0,
    tolerance: Tolerance = 2e-3,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> SensorMrtd:
    """Compute the thresholds of four bars (MRTD) for a sensor, beside its TOD, with no frame drawn.

    The model observer of the TOD judges the bars up to Nyquist and beyond: as a mean over their places on the
    detectors, and at the best place. Lloyd's form and TTP stand beside it. `todframes range` reads mrtd.csv.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor. It must not count photons.
    frequency_nyquist : sequence of float
        Frequencies of the bars in units of Nyquist, each once.
    size_detectors : sequence of float
        Sizes √(area) of the triangles in detector pitches, each once.

        Empty for no TOD.
    against : {"square", "background"}
        Display without bars: a uniform square of their mean, so that they have to be resolved, or nothing, so that
        their mean alone is enough.
    direction : {"upright", "lying"}
        Direction of the bars.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear and judge bars.
    p_correct : float
        Raw proportion correct at threshold: of two displays for bars, above 0.5; of four orientations for
        triangles.
    lloyd_snr : float
        Threshold SNR of a bar in Lloyd's form.
    ttp_delta_t_k : float
        ΔT of the target of TTP in K.
    ttp_width_deg : float
        Width of the field of TTP at the eye in degrees.
    tolerance : float
        Relative error of the thresholds to reach.
    rng : int, SeedSequence or Generator
        Seed of the places of the patterns on the detectors.
    progress : function of two ints, optional
        Called with the number of thresholds of a step that are done, and of all.

    Returns
    -------
    Result
        `bars` has a record for each frequency, `tod` for each size; `plot()` draws both.

    Raises
    ------
    SettingsError
        If a setting is invalid, the sensor counts photons, or the observer cannot judge bars.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> found = ss.mrtd("sample_frames/staring_camera.toml", frequency_nyquist=[0.8, 1.2], size_detectors=[])
    >>> [(one.frequency_nyquist, round(one.threshold_snr, 1)) for one in found.bars]
    [(0.8, 0.4), (1.2, 1.2)]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from sensor_sim.thresholds.curve import curve

    judge, settings = resolve_observer(observer)
    sensor = sensor_of(sensor)
    if not 0.5 < p_correct < 1.0:
        raise SettingsError(
            f"{argument.p_correct}: found {p_correct!r}, expected a proportion above 0.5, which guessing gives, "
            "and below 1"
        )
    positive = {"lloyd_snr": lloyd_snr, "ttp_delta_t_k": ttp_delta_t_k, "ttp_width_deg": ttp_width_deg}
    for name, value in positive.items():
        check_positive(name, value)
    of_nyquist = sorted(distinct_numbers(argument.frequency_nyquist, frequency_nyquist))
    camera = resolve(sensor)
    nyquist = camera.nyquist_cyc_per_mrad
    chains = [
        BarChain(camera, judge, frequency * nyquist, against=against, direction=direction)
        for frequency in of_nyquist
    ]
    bars: list[BarsAt] = []
    warnings: tuple[ResultWarning, ...] = ()
    for frequency, chain in counted(zip(of_nyquist, chains, strict=True), len(chains), progress):
        averaged, best = chain.averaged(p_correct, tolerance=tolerance, seed=seed), chain.best(p_correct)
        bars.append(bars_at(frequency * nyquist, averaged, best, sensor, lloyd_snr=lloyd_snr))
        group: Group = {"frequency_nyquist": frequency}
        missed = missed_tolerance(
            averaged.threshold, averaged.numerical_error, tolerance, group=group, exact="lower frequencies"
        )
        warnings += () if missed is None else (missed,)
    tod: tuple[Fit, ...] = ()
    if len(size_detectors):
        shown: dict[str, Any] = {"observer": judge, "p_correct": p_correct, "tolerance": tolerance}
        triangles = curve(
            sensor, size_detectors=size_detectors, rng=seed, examples=False, progress=progress, **shown
        )
        tod, warnings = triangles.fits, (*warnings, *triangles.warnings)
    settings |= {
        "against": against,
        "direction": direction,
        "p_correct": p_correct,
        "tolerance": tolerance,
        "lloyd": {
            "factor": LLOYD_FACTOR,
            "snr": lloyd_snr,
            "netd_mk": sensor.noise.netd_mk,
            "alpha_mrad": sensor.width_mrad,
            "beta_mrad": sensor.width_mrad,
            "frames": sensor.noise.frames_integrated,
        },
        "sensor": sensor_settings(sensor),
    }
    return SensorMrtd.made(
        "mrtd",
        started,
        seed=seed,
        warnings=warnings,
        sensor=sensor.name,
        nyquist_cyc_per_mrad=nyquist,
        settings=as_read(settings, Record),
        bars=tuple(bars),
        tod=tod,
        ttp=None
        if sensor.noise.netd_mk is None
        else sensor_ttp(
            sensor,
            delta_t_k=ttp_delta_t_k,
            width_deg=ttp_width_deg,
            eye_time_s=EYE_TIME_S,
        ),
    )
