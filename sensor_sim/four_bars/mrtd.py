"""The call `mrtd`: thresholds of four bars for a sensor, beside its TOD."""

from __future__ import annotations

import time
from typing import Any

from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.four_bars.mrtd_result import LLOYD_FACTOR, BarsAt, SensorMrtd, bars_at, sensor_ttp
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, convert
from todframes.base.seeds import Rng, seed_of
from todframes.field.ttp import TtpSettings
from todframes.observers.interface import Observer, described
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
from todframes.results.advice import missed_tolerance
from todframes.results.data import Fit, Group, Record, ResultWarning, as_read
from todframes.results.result import Result, repeatable

FREQUENCIES_NYQUIST = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4)
"""Frequencies of the bars, in units of Nyquist, if none are given."""

SIZES_DETECTORS = (3.0, 4.0, 5.0, 6.0, 8.0)
"""Sizes of the triangles, √area in detectors, if none are given."""

LLOYD_SNR = 2.25
"""Signal-to-noise ratio that an observer of bars needs: a usual value of the literature's form."""

EYE_TIME_S = 0.1
"""Time over which the eye integrates frames (Hogervorst et al. 2001, section 8: 100 ms)."""


@repeatable
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
    ttp: TtpSettings | None = None,
    tolerance: Tolerance = 2e-3,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> Result[SensorMrtd]:
    """Compute the thresholds of four bars (MRTD) for a sensor, beside its TOD, with no frame drawn.

    The model observer of the TOD judges the bars up to Nyquist and beyond: as a mean over their places on the
    detectors, and at the best place. Lloyd's form and TTP stand beside it. `todframes range` reads mrtd.csv.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor. It must not count photons.

        A `Sensor` is taken as well.
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

        An object is taken as well.
    p_correct : float
        Raw proportion correct at threshold: of two displays for bars, above 0.5; of four orientations for
        triangles.
    lloyd_snr : float
        Threshold SNR of a bar in Lloyd's form.
    ttp_delta_t_k : float
        ΔT of the target of TTP in K.
    ttp_width_deg : float
        Width of the field of TTP at the eye in degrees.
    ttp : TtpSettings, optional
        Choices where public codes of TTP disagree.
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
    from sensor_sim.thresholds.bars import BarChain
    from sensor_sim.thresholds.curve import curve
    from todframes.parameters import Direction

    judge, settings = described(observer)
    sensor = sensor_of(sensor)
    if not 0.5 < p_correct < 1.0:
        raise SettingsError(
            f"{argument.p_correct}: found {p_correct!r}, expected a proportion above 0.5, which guessing gives, "
            "and below 1"
        )
    convert(direction, Direction, argument.direction)
    for name, value in (
        ("lloyd_snr", lloyd_snr),
        ("ttp_delta_t_k", ttp_delta_t_k),
        ("ttp_width_deg", ttp_width_deg),
    ):
        check_positive(name, value)
    check_positive(argument.tolerance, tolerance)
    of_nyquist = sorted(float(one) for one in frequency_nyquist)
    if not of_nyquist or len(set(of_nyquist)) < len(of_nyquist):
        listed = ", ".join(f"{one:g}" for one in of_nyquist) or "none"
        raise SettingsError(
            f"{argument.frequency_nyquist}: found {listed}, expected one frequency or more, each once"
        )
    nyquist = sensor.detector.nyquist_cyc_per_mrad
    chains = [BarChain(sensor, judge, one * nyquist, against=against, direction=direction) for one in of_nyquist]
    bars: list[BarsAt] = []
    warnings: tuple[ResultWarning, ...] = ()
    for one, chain in counted(zip(of_nyquist, chains, strict=True), len(chains), progress):
        averaged, best = chain.averaged(p_correct, tolerance=tolerance, seed=seed), chain.best(p_correct)
        bars.append(bars_at(one * nyquist, averaged, best, sensor, lloyd_snr=lloyd_snr))
        group: Group = {"frequency_nyquist": one}
        missed = missed_tolerance(
            averaged.snr, averaged.numerical_error, tolerance, group=group, exact="lower frequencies"
        )
        warnings += () if missed is None else (missed,)
    tod: tuple[Fit, ...] = ()
    if len(size_detectors):
        shown: dict[str, Any] = {"observer": judge, "p_correct": p_correct, "tolerance": tolerance}
        triangles = curve(
            sensor, size_detectors=size_detectors, rng=seed, examples=False, progress=progress, **shown
        )
        tod, warnings = triangles.fits, (*warnings, *triangles.warnings)
    noise = sensor.noise
    settings |= {
        "against": against,
        "direction": direction,
        "p_correct": p_correct,
        "tolerance": tolerance,
        "lloyd": {
            "factor": LLOYD_FACTOR,
            "snr": lloyd_snr,
            "netd_mk": noise.netd_mk,
            "alpha_mrad": sensor.detector.width_mrad,
            "beta_mrad": sensor.detector.width_mrad,
            "frames": noise.frames_integrated,
        },
        "sensor": sensor_settings(sensor),
    }
    return Result.made(
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
        if noise.netd_mk is None
        else sensor_ttp(
            sensor,
            delta_t_k=ttp_delta_t_k,
            width_deg=ttp_width_deg,
            eye_time_s=EYE_TIME_S,
            settings=ttp or TtpSettings(),
        ),
    )
