"""The call `curve`: the TOD curve of a sensor, without drawing frames, and that for a range in the field."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import structs

from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.sensor import Scene, Sensor, load_sensor, sensor_of, sensor_settings
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked, distinct_numbers
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer, observer_named, resolve_observer
from todframes.parameters import (
    Numbers,
    ObserverName,
    PlanName,
    Probability,
    Progress,
    Seed,
    SensorFile,
    Tolerance,
)
from todframes.psychometrics.curves import FitPoint
from todframes.psychometrics.fit import FitSettings
from todframes.results.advice import numerical_errors
from todframes.results.data import Fit, ResultWarning
from todframes.results.thresholds import Thresholds
from todframes.results.wording import count, listed, percent_below, plain
from todframes.scoring.error_budget import Step, plan_object

if TYPE_CHECKING:
    from sensor_sim.thresholds.threshold import Computed, Shares


ARCMIN_PER_MRAD = 180.0 * 60.0 / math.pi / 1000.0


@checked
def curve(
    sensor: Sensor | SensorFile,
    *,
    size_detectors: Numbers = (),
    size_mrad: Numbers = (),
    luminance_cd_m2: Numbers = (),
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    tolerance: Tolerance = 2e-3,
    plan: PlanName = "needed",
    rng: Seed | Rng = 1,
    examples: bool = True,
    progress: Progress | None = None,
) -> Thresholds:
    """Compute the TOD curve of a sensor, with no frame drawn.

    Thresholds are SNR, and temperature where NETD is given. Those of a camera that counts photons are contrasts.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches, without repetitions. Default: five, from the smallest one with a
        threshold on.
    size_mrad : sequence of float
        Sizes as angles at the camera in mrad, in place of `size_detectors`.
    luminance_cd_m2 : sequence of float
        For a camera that counts photons: luminances of the background in cd/m², without repetitions, with a curve
        for each. Default: the luminance of its scene.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative error of the thresholds to reach.
    plan : {"needed", "full"}
        Leave out what the sensor does not need, or nothing.
    rng : int, SeedSequence or Generator
        Seed of the places of the triangle on the detectors.
    examples : bool
        Also draw a triangle at threshold, for the page.
    progress : function of two ints, optional
        Called with the share of the work that is done, in hundredths of a threshold, and with the whole.

    Returns
    -------
    todframes.Result
        Thresholds in SNR, and in mK where the sensor's NETD is known; those of a camera that counts photons are
        contrasts.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the observer is not linear.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> result = ss.curve("sample_frames/staring_camera.toml", size_detectors=[4, 6], tolerance=0.02)
    >>> [round(one.threshold, 1) for one in result.thresholds]
    [3.2, 1.1]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from sensor_sim.thresholds.threshold import (
        Shares,
        chosen_sizes,
        given_sizes,
        shares_at,
        smallest_size,
        threshold_at,
    )

    sensor = sensor_of(sensor)
    background = sensor.display.background_luminance_cd_m2
    judge, settings = resolve_observer(observer, lambda: background)
    FitSettings(p_correct=p_correct)  # checks it
    luminances = distinct_numbers(argument.luminance_cd_m2, luminance_cd_m2) if len(luminance_cd_m2) else []
    scenes = _scenes(sensor, luminances)
    cameras = [resolve(replace(sensor, scene=scene)) for scene in scenes]
    groups: list[dict[str, float | str]] = [
        {"luminance_cd_m2": scene.background_cd_m2} if luminances and scene else {} for scene in scenes
    ]
    asked: dict[str, Any] = {"p_correct": p_correct, "seed": seed}
    smallest = cache(partial(smallest_size, observer=judge, **asked))
    sizes = given_sizes(cameras[0], size_detectors, size_mrad)
    sizes = sizes or chosen_sizes(cameras[0], judge, smallest(cameras[0]))
    todo = [
        (camera, group | {"size_detectors": size})
        for size in sizes
        for camera, group in zip(cameras, groups, strict=True)
    ]
    fits, shares, done = list[Fit](), list[Shares](), 0.0
    unreached: dict[tuple[str, Any], list[Computed]] = {}

    def advance(share: float) -> None:
        nonlocal done
        done += share
        if progress is not None:
            progress(round(100 * done), 100 * len(todo))

    for number, (camera, group) in enumerate(todo, 1):
        size = float(group["size_detectors"])
        computed = threshold_at(camera, judge, size, tolerance=tolerance, plan=plan, progress=advance, **asked)
        found = computed.found
        fits.append(_fit(computed, group, p_correct))
        shares.append(shares_at(computed.chain, "snr", found.threshold, seed))
        if found.highest is not None:
            unreached.setdefault((found.reason, group.get("luminance_cd_m2")), []).append(computed)
        advance(number - done)
    of_lights = [slice(first, None, len(cameras)) for first in range(len(cameras))]
    more: dict[str, Any] = {"limits": tuple(_what_limits(fits[part], shares[part]) for part in of_lights)}
    fits = [fit for part in of_lights for fit in fits[part]]
    if examples:
        from sensor_sim.chain.pictures import threshold_examples

        more["examples"] = threshold_examples(sensor, judge, fits, seed=seed)
    settings |= {"p_correct": p_correct, "sensor": sensor_settings(sensor), "tolerance": tolerance, "plan": plan}
    never = (_never_reached(alike, judge, smallest, light, p_correct) for (_, light), alike in unreached.items())
    warnings = (*never, *numerical_errors(fits, tolerance))
    more |= {"fits": tuple(fits), "viewing": _viewing(sensor), "warnings": warnings}
    return Thresholds.made("curve", started, settings=settings, seed=seed, **more)


def _viewing(sensor: Sensor) -> str:
    """Return the display and the frames that the eye averages in a sentence."""
    display, n_frames = sensor.display, sensor.frames_integrated
    what = "contrast of 1" if sensor.photons is not None else "triangle of any SNR"
    return (
        f"The gain shows a {what} with a contrast of {display.gain:g} on "
        f"{plain(display.background_luminance_cd_m2)} cd/m²; a detector is {plain(display.detector_pitch_mrad)} "
        f"mrad wide at the eye, which averages {count(n_frames, 'frame')}. `todframes import --display` with this "
        "SENSOR.toml shows a film so."
    )


def _what_limits(fits: Sequence[Fit], shares: Sequence[Shares]) -> str:
    """Return what limits the curve at one light in a sentence."""
    from sensor_sim.thresholds.threshold import SATURATING, WITHOUT_NOISE, what_limits

    sizes = [float(fit.group["size_detectors"]) for fit in fits]
    statuses = [fit.status for fit in fits]
    _, sentence = what_limits(sizes, shares, statuses, WITHOUT_NOISE if fits[0].level == "snr" else SATURATING)
    luminance = fits[0].group.get("luminance_cd_m2")
    return sentence if luminance is None else f"At {luminance:g} cd/m²: {sentence}"


def _fit(at_light: Computed, group: dict[str, float | str], p_correct: float) -> Fit:
    """Return the record of a threshold."""
    found, chain = at_light
    camera = chain.camera
    phases = Step("phases", True, f"{found.n_phases} trials, chosen to meet the tolerance")
    warm = None
    if found.threshold is not None and camera.mk_per_snr is not None:
        warm = found.threshold * camera.mk_per_snr
    return Fit.of_computed(
        group,
        camera.level,
        p_correct,
        found,
        points=tuple(FitPoint(level, 0, p) for level, p in found.points),
        n_phases=found.n_phases,
        p_correct_error_bound=chain.non_gaussian_bound(found.threshold),
        plan=tuple(plan_object((*chain.plan.steps, phases))),
        delta_t_mk=warm,
    )


def _never_reached(
    alike: Sequence[Computed],
    observer: Observer,
    smallest_at: Callable[[Camera], float | None],
    luminance_cd_m2: float | None,
    p_correct: float,
) -> ResultWarning:
    """Return the warning about sizes without a threshold for one reason: it, and the smallest size with one."""
    from sensor_sim.thresholds.predict import HIDDEN, SATURATING
    from sensor_sim.thresholds.threshold import computed_sizes

    chain = alike[0].chain
    camera, reason = chain.camera, alike[0].found.reason
    highest = tuple(unreached.found.highest or 0.0 for unreached in alike)
    sizes = listed(f"{unreached.chain.size_detectors:.4g}" for unreached in alike)
    largest = listed(f"{100.0 * unreached.chain.largest_sample:.2g}" for unreached in alike)
    smallest = smallest_at(camera)
    if smallest is None:
        what = f"No size up to {max(computed_sizes(camera, observer)):g} detectors is enough"
    else:
        at_camera = plain(smallest * camera.pitch_mrad)
        what = f"{smallest:g} detectors ({at_camera} mrad at the camera) are enough"
        what += "; fewer may be on a display that shows detectors at a smaller angle" * (reason == HIDDEN)
    strong = (
        f"at the contrast of {plain(chain.largest_level)}" if reason == SATURATING else "however strong the signal"
    )
    arcmin = plain(camera.shown_pitch_mrad * ARCMIN_PER_MRAD, 2)
    shares = listed(percent_below(p, p_correct) for p in highest)
    criterion = f"{100.0 * p_correct:g} % correct is never reached at {sizes} detectors"
    message = (
        f"{criterion}: {strong}, about {shares} % of the answers are correct at most. The largest sample has "
        f"{largest} % of the triangle's contrast, and a detector is {arcmin}′ wide at the eye: {reason}. {what}"
    )
    return ResultWarning(
        code="never_reached",
        group={} if luminance_cd_m2 is None else {"luminance_cd_m2": luminance_cd_m2},
        message=message,
        found=highest,
        expected=p_correct,
    )


def _scenes(sensor: Sensor, luminances_cd_m2: Sequence[float]) -> list[Scene | None]:
    """Return the lights of a camera that counts photons: its own, or some luminances; None for other sensors."""
    if sensor.scene is None:
        if luminances_cd_m2:
            needed = 'found for a sensor without [noise] model = "photon", expected none'
            raise SettingsError(f"{argument.luminance_cd_m2}: {needed}")
        return [None]
    return [sensor.scene.at(luminance) for luminance in luminances_cd_m2] or [sensor.scene]


SIZES_OF_ACUITY = (1.0, 1.05, 1.15, 1.3, 1.6, 2.0, 3.0, 5.0, 8.0)
"""Sizes of the curve, in units of the smallest one that is judged: close where the threshold rises without end."""

TOLERANCE = 0.01
"""Relative error of the thresholds."""


def field_curve(
    source: Path | str, *, p_correct: float, progress: Progress | None
) -> tuple[Thresholds, tuple[ResultWarning, ...]]:
    """Compute the thresholds of a sensor in a file from its acuity on. The last size is the largest that no signal
    suffices for, if one was found. SettingsError if no size is judged.
    """
    from sensor_sim.thresholds.threshold import acuity_detectors, computed_sizes

    sensor, judge = load_sensor(source), observer_named("pyramid")
    camera = resolve(sensor)
    found = acuity_detectors(camera, judge, p_correct=p_correct, seed=1)
    if found is None:
        raise SettingsError(f"{sensor.name}: found no size that is judged with {100.0 * p_correct:g} % correct")
    smallest, unreached = found
    most = max(computed_sizes(camera, judge))
    sizes = [float(f"{smallest * step:.4g}") for step in SIZES_OF_ACUITY if smallest * step <= most]
    asked: dict[str, Any] = {"p_correct": p_correct, "tolerance": TOLERANCE, "examples": False}
    result = curve(sensor, size_detectors=sizes, progress=progress, **asked)
    fits = result.fits
    if unreached is not None:
        group: dict[str, float | str] = {"size_detectors": unreached}
        fits += (Fit(group=group, level=camera.level, status="never_reached", p_correct=p_correct),)
    warnings = tuple(warning for warning in result.warnings if warning.code != "numerical_error")
    if camera.air is not None and (air := sensor.turbulence) is not None:
        message = f"the turbulence is that of turbulence.path_km = {air.path_km:g}, at whatever range"
        warnings += (ResultWarning(code="turbulence_path", message=message),)
    return structs.replace(result, fits=fits), warnings
