"""The server's side of the explorer: its files, and the calls by which the page gets numbers."""

from __future__ import annotations

import base64
import hashlib
import pickle
import re
import shlex
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, closing
from dataclasses import asdict
from importlib.resources import files
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from starlette.applications import Starlette

from sensor_sim.chain.camera import resolve, resolve_without_light
from sensor_sim.chain.mtf import SHOWN_NYQUISTS, mtf
from sensor_sim.chain.sampling import field_detectors
from sensor_sim.chain.sensor import (
    SCHEMA,
    Detector,
    Sensor,
    load_sensor,
    preset_files,
    sensor_from,
    sensor_settings,
    sensor_toml,
)
from sensor_sim.chain.simulation import SimulatedTrial
from sensor_sim.chain.vary import pitch_and_width, with_coupled_netd
from sensor_sim.explorer.answers import (
    Format,
    PlotAsked,
    SentThresholds,
    check_aim,
    curve_line,
    curve_plot,
    file_of,
    number_text,
    optics_words,
    range_answer,
    range_from,
)
from sensor_sim.explorer.live import LiveCurves
from sensor_sim.explorer.parameters import PAGE_FIELDS, PageField, observer_fields, sensor_fields
from sensor_sim.sweeps.goals import Aim
from sensor_sim.thresholds.curve_plan import Level, not_linear
from sensor_sim.thresholds.predict import PredictedThreshold
from sensor_sim.thresholds.threshold import SIZES_CHOSEN, computed_sizes
from todframes import __version__
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys, from_table, parse_toml, toml_literal
from todframes.field.acquisition_range import FieldRange
from todframes.observers.interface import Observer, adapted, resolve_observer
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.threshold_search import LEVEL_RANGE
from todframes.results.wording import subsample
from todframes.stimulus import ORIENTATIONS, Stimulus
from todframes.web.server import EmptyRequest, call, page, stream

TRIED_AT_ONCE = 4
"""Number of sizes that are tried at a time."""

LARGEST_ERROR = 0.1
"""Relative error of an estimate above which a size hardly has a threshold: the curve begins at the next size."""

CHIP_PITCH_UM = {
    "cooled_mwir.toml": 15.0,
    "low_light.toml": 6.45,
    "uncooled_lwir.toml": 12.0,
    "visible.toml": 3.45,
}
"""Pitch of the detectors on the chip, by preset: with it the page shows the f-number."""

USUAL_CHIP_PITCH_UM = 15.0

USUAL_SIZE_MRAD = 3.0
"""Size of a triangle at the eye, for which it is tried whether an observer is linear."""

RANGE_POINTS = 7
"""Points of the psychometric function of each size, as many as those of a curve, from which a range follows."""

MOST_PICTURE_PIXELS = 2**21

MTF_ROWS = 13
"""Rows of the table of MTFs."""

ORIENTATION_STREAM = 2
"""First element of the spawn key of the orientation; the streams of the noise have others."""

Tables = dict[str, Any]
Size = Annotated[float, Meta(gt=0.0)]
Sizes = Annotated[list[Size], Meta(min_length=1, max_length=12)]


class SensorAsked(msgspec.Struct):
    """A request about a sensor, given as the tables of SENSOR.toml."""

    sensor: Tables


class TomlAsked(SensorAsked):
    """A request for the file of a sensor, and for the command that computes its curve. Without sizes, those are
    taken that suit the sensor. Numbers of the sensor that have moved since `before` take others along: the NETD if
    the two are coupled, and pitch or width with `keep_fill_factor`.
    """

    sizes_detectors: Sizes | None
    observer: Tables = {}
    p_correct: float = 0.75
    before: Tables | None = None
    keep_fill_factor: bool = False
    chip_pitch_um: Size = USUAL_CHIP_PITCH_UM


class CurveAsked(TomlAsked, kw_only=True):
    """A request for a curve; `client` is a name that a page gives itself, and `sequence` counts its requests."""

    client: Annotated[str, Meta(max_length=64)]
    sequence: int
    level: Level = "snr"


class TrialAsked(SensorAsked):
    """A request about one trial."""

    size_detectors: Size
    level: Annotated[float, Meta(ge=LEVEL_RANGE[0], le=LEVEL_RANGE[1])]
    seed: Annotated[int, Meta(ge=0)]

    def trial(self) -> SimulatedTrial:
        """Return the trial; its orientation comes from the seed."""
        chance = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(ORIENTATION_STREAM,)))
        return SimulatedTrial((0, 0, 0), self.size_detectors, self.level, ORIENTATIONS[chance.integers(4)])


class MtfPlotAsked(SensorAsked):
    """A request for the plot of a sensor's MTFs as a file."""

    format: Format


class RangeAsked(SensorAsked):
    """A request for the range of a sensor, whose thresholds the page has got."""

    thresholds: SentThresholds
    level: Level
    p_correct: float = 0.75


class RangePlotAsked(RangeAsked, kw_only=True):
    """A request for the plot of probability against range as a file."""

    format: Format


class TextAsked(msgspec.Struct):
    """A request about the text of a SENSOR.toml; `name` is that of the file."""

    text: str
    name: str = "SENSOR.toml"


class Explorer:
    """The calls of the page that compute curves, with the processes that serve them while the server runs."""

    def __init__(
        self,
        sensor: Sensor,
        observer: str | Observer = "pyramid",
        *,
        p_correct: float = FitSettings().p_correct,
        target_in_air: Aim | None = None,
    ) -> None:
        self.sensor, self.p_correct, self._aim = sensor, p_correct, target_in_air
        self._observer, settings = resolve_observer(observer)
        self._observer_name = str(settings["observer"])
        optics = sensor.optics
        # The files that a request may name: the server has read them, and reads no others.
        self._measured = {name: one for name, one in (("mtf", optics.mtf), ("psf", optics.psf)) if one is not None}
        self._latest: dict[str, int] = {}
        self._live: LiveCurves

    @asynccontextmanager
    async def running(self, _: Starlette) -> AsyncIterator[None]:
        """Keep the processes that compute for the time of a `with` statement."""
        with closing(LiveCurves()) as self._live:
            yield

    def app(self) -> Starlette:
        """Return the app of the page."""
        calls = [
            call("/api/start", EmptyRequest, lambda _: self.start()),
            stream("/api/curve", CurveAsked, self.curve),
            call("/api/moved", TomlAsked, self.state),
            call("/api/mtf", SensorAsked, lambda asked: transfer(self.made(asked))),
            call("/api/stages", TrialAsked, lambda asked: trial_pictures(asked, self.made(asked))),
            call("/api/orientation", TrialAsked, lambda asked: {"orientation": asked.trial().orientation.value}),
            call("/api/toml", TomlAsked, self.written),
            call("/api/parse", TextAsked, read),
            call("/api/plot", PlotAsked, curve_plot),
            call("/api/range", RangeAsked, lambda asked: range_answer(self.range_of(asked))),
            call("/api/range-plot", RangePlotAsked, self.range_plot),
            call("/api/mtf-plot", MtfPlotAsked, self.mtf_plot),
        ]
        return page(files("sensor_sim.explorer") / "static", calls, self.running)

    def start(self) -> dict[str, Any]:
        """Return the data with which the page begins."""
        of_observer = self._observer_fields()
        # It tells measured files of the same name apart; empty if there are none.
        measured = hashlib.sha256(repr(self._measured).encode()).hexdigest()[:16] if self._measured else ""
        return {
            "version": __version__,
            "sensor": sensor_settings(self.sensor),
            "measured": measured,
            "observer": {field.key.partition(".")[2]: value for field, value in of_observer.items()},
            "observer_name": self._observer_name,
            "p_correct": self.p_correct,
            "chip_pitch_um": USUAL_CHIP_PITCH_UM,
            "has_range": self._aim is not None,
            "fields": (*sensor_fields(), *of_observer, *PAGE_FIELDS),
            "presets": [
                {"sensor": sensor_settings(one), "chip_pitch_um": CHIP_PITCH_UM.get(file, USUAL_CHIP_PITCH_UM)}
                for file, one in presets().items()
            ],
        }

    def check(self) -> None:
        """Check that curves can be computed with the observer, and ranges for the target. SettingsError if the
        observer is not linear, cannot be adapted to the display or sent to the processes that compute, or as in
        `check_aim`.
        """
        if self._aim is not None:
            check_aim(self._aim, self.sensor, self.p_correct)
        observer = adapted(self._observer, lambda: self.sensor.display.background_luminance_cd_m2)
        if observer.readout(Stimulus(USUAL_SIZE_MRAD)) is None:
            raise not_linear()
        try:
            pickle.dumps(self._observer)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise SettingsError(
                f"observer: {self._observer_name} cannot be sent to the processes that compute ({error})"
            ) from None

    def made(self, asked: SensorAsked) -> Sensor:
        """Return the sensor of a request; see `sensor_from` for the errors."""
        return sensor_from({"schema": SCHEMA, **asked.sensor}, "SENSOR.toml", measured=self._measured)

    def moved(self, asked: TomlAsked) -> Sensor:
        """Return the sensor of a request with what follows its moves; see `made` for the errors."""
        if asked.before is None:
            return self.made(asked)
        try:
            before = self.made(SensorAsked(asked.before))
        except SettingsError:
            return self.made(asked)  # there was no sensor to follow
        tables, detector = dict(asked.sensor), asked.sensor.get("detector")
        if asked.keep_fill_factor and isinstance(detector, dict):
            tables["detector"] = detector | _with_fill_factor(before.detector, detector)
        sensor = self.made(SensorAsked(tables))
        is_moved = sensor.noise.netd_mk != before.noise.netd_mk
        return sensor if is_moved else with_coupled_netd(before, sensor)

    def state(self, asked: TomlAsked) -> dict[str, Any]:
        """Return the tables of the sensor of a request with what follows its moves, and its optics in words."""
        sensor = self.moved(asked)
        return {"sensor": sensor_settings(sensor), "note": optics_words(sensor, asked.chip_pitch_um)}

    def observed_by(self, changes: Tables) -> Observer:
        """Return the observer with some settings changed; SettingsError if there is no such setting, or a value is
        refused.
        """
        settings = self._observer.settings
        known = asdict(settings)
        check_keys(changes, known, "[observer]")
        if not changes:
            return self._observer
        observer: Observer = type(self._observer)(from_table(known | changes, type(settings), "[observer]"))
        return observer

    def written(self, asked: TomlAsked) -> dict[str, Any]:
        """Return the text of the SENSOR.toml, a name for the file, and the command that computes the same curve.
        The command is None while the sizes are not known. `beside` are the names of files that belong to it.
        """
        sensor = self.moved(asked)
        name = re.sub(r"[^\w-]+", "_", sensor.name).strip("_")[:60] or "sensor"
        file, measured = f"{name}.toml", (sensor.optics.mtf, sensor.optics.psf)
        beside = [one.file for one in measured if one is not None]
        found = {"file": file, "text": sensor_toml(sensor), "beside": beside, "command": None}
        if asked.sizes_detectors is None:
            return found
        sizes = ",".join(f"{size!r}".removesuffix(".0") for size in asked.sizes_detectors)
        curve = ["sensor-sim curve", shlex.quote(file), "--size-detectors", sizes, *self._options(asked.observer)]
        if asked.p_correct != FitSettings().p_correct:
            curve.append(f"--p-correct {asked.p_correct!r}")
        return found | {"command": " ".join(curve)}

    def range_of(self, asked: RangeAsked) -> FieldRange:
        """Return the range of a sensor from the thresholds of its curve; see `range_from` for the errors."""
        if self._aim is None:
            raise SettingsError(f"{argument.target}: is missing; the explorer was started without it")
        sensor = self.made(asked)
        if sensor.photons is None and asked.level != "snr":
            raise SettingsError("It follows from thresholds with detector noise: choose SNR or ΔT.")
        if sensor.photons is None and sensor.noise.netd_mk is None:
            raise SettingsError("It follows from thresholds in ΔT, which need the NETD.")
        return range_from(self._aim, sensor, asked.thresholds, asked.p_correct)

    def range_plot(self, asked: RangePlotAsked) -> dict[str, str]:
        """Return the file of a plot of probability against range; see `file_of`."""
        return file_of(self.range_of(asked).figures()[-1], asked.format)

    def mtf_plot(self, asked: MtfPlotAsked) -> dict[str, str]:
        """Return the file of a sensor's MTFs; see `file_of`."""
        return file_of(mtf(self.made(asked)).figures()[0], asked.format)

    def _options(self, changes: Tables) -> Iterator[str]:
        """Yield the options of a command that make the observer with some settings changed."""
        settings = self.observed_by(changes).settings
        if self._observer_name != "pyramid":
            yield f"--observer {shlex.quote(self._observer_name)}"
        usual = asdict(type(settings)())
        for key, value in asdict(settings).items():
            if value != usual[key] and value is not None:
                yield f"--set {shlex.quote(f'{key}={toml_literal(value)}')}"

    def _observer_fields(self) -> dict[PageField, float]:
        """Return the fields of the observer's settings that move on the page, with their values."""
        settings = self._observer.settings
        values = {f"observer.{name}": value for name, value in asdict(settings).items()}
        without_effect = {
            # A standard deviation of the noise stands in place of its full width.
            "observer.internal_noise": getattr(settings, "internal_noise_sd", None) is not None,
            # A pyramid without an eye sees the same in any light.
            "observer.luminance_cd_m2": getattr(settings, "eye_mtf", "") == "none",
        }
        return {
            field: values[field.key]
            for field in observer_fields(type(settings))
            if isinstance(values[field.key], float | int) and not without_effect.get(field.key, False)
        }

    def curve(self, asked: CurveAsked, is_connected: Callable[[], bool]) -> Iterator[dict[str, Any]]:
        """Return the lines of the answer for a curve, one for each `LiveCurve`; none if a newer request is known.
        SettingsError if a setting is invalid; others may only be found when the lines are computed.
        """
        self._latest[asked.client] = max(asked.sequence, self._latest.get(asked.client, asked.sequence))
        sensor = self.moved(asked)
        observer = adapted(self.observed_by(asked.observer), lambda: sensor.display.background_luminance_cd_m2)
        sizes, p_correct = asked.sizes_detectors, FitSettings(p_correct=asked.p_correct).p_correct
        if sizes is not None and len(set(sizes)) < len(sizes):
            raise SettingsError("sizes_detectors: found a value twice, expected each once")

        # A camera that counts photons has one level: contrast, with all noise.
        counts_photons = sensor.photons is not None
        level: Level = "contrast" if counts_photons else asked.level
        computed: Level = "snr" if counts_photons else asked.level

        def is_wanted() -> bool:
            return is_connected() and self._latest[asked.client] <= asked.sequence

        def lines() -> Iterator[dict[str, Any]]:
            wanted = sizes or self._sizes_of(sensor, observer, p_correct, is_wanted)
            for curve in self._live.curves(
                sensor,
                observer,
                wanted,
                p_correct=p_correct,
                level=computed,
                n_points=0 if self._aim is None else RANGE_POINTS,
                is_wanted=is_wanted,
            ):
                yield {"sequence": asked.sequence, "level": level} | curve_line(sensor, level, curve)

        return lines()

    def _sizes_of(
        self, sensor: Sensor, observer: Observer, p_correct: float, is_wanted: Callable[[], bool]
    ) -> Sequence[float]:
        """Return sizes from the smallest one that surely has a threshold; if none has, the smallest sizes. With a
        target, they begin with the largest one that has none, and the middle of the two: the range often lies
        where the curve ends. SettingsError if not even the smallest size can be computed.
        """
        known = list(computed_sizes(resolve(sensor), observer))
        for start in range(0, len(known), TRIED_AT_ONCE):
            tried = known[start : start + TRIED_AT_ONCE]
            with closing(
                self._live.curves(sensor, observer, tried, p_correct=p_correct, is_wanted=is_wanted)
            ) as found:
                estimate = next(found, None)
            if estimate is None:
                break  # no longer wanted
            for place, threshold in enumerate(estimate.thresholds, start):
                if not _is_surely_seen(threshold):
                    continue
                if self._aim is None or place == 0:
                    return known[place : place + SIZES_CHOSEN]
                unseen = known[place - 1]
                return [unseen, (unseen + known[place]) / 2.0, *known[place : place + SIZES_CHOSEN - 2]]
        return known[:SIZES_CHOSEN]


def _is_surely_seen(found: PredictedThreshold) -> bool:
    if found.threshold is None or found.numerical_error is None:
        return found.status == "always_exceeded"
    return found.numerical_error <= LARGEST_ERROR * found.threshold


def presets() -> dict[str, Sensor]:
    """Return the presets by the names of their files."""
    return {path.name: load_sensor(path) for path in preset_files().values()}


def _with_fill_factor(before: Detector, detector: Tables) -> Tables:
    """Return pitch or width of a detector, the one that has not moved, as the fill factor of before gives it."""
    unit = "mrad" if before.pitch_um is None else "um"
    (pitch, width), names = pitch_and_width(before), (f"pitch_{unit}", f"width_{unit}")
    new_pitch, new_width = (detector.get(name) for name in names)
    if not isinstance(new_pitch, float | int) or not isinstance(new_width, float | int):
        return {}
    if new_pitch != pitch and new_width == width:
        return {names[1]: new_pitch * (width / pitch)}
    return {names[0]: new_width / (width / pitch)} if new_width != width and new_pitch == pitch else {}


def transfer(sensor: Sensor) -> dict[str, Any]:
    """Return the transfer before and after sampling, as `sensor-sim mtf` computes it."""
    found = mtf(sensor)
    frequency, nyquist = found.frequency_cyc_per_mrad, found.nyquist_cyc_per_mrad
    before, after = ([round(value, 6) for value in found.mtf[f"{name}_sample"]] for name in ("pre", "post"))
    # As far as in the report, or less if nothing is there.
    end = min(SHOWN_NYQUISTS * nyquist, max(frequency[-1], 1.2 * nyquist))
    shown = subsample([one for one, value in enumerate(frequency) if value <= end], MTF_ROWS)
    return {
        "frequency_cyc_per_mrad": frequency,
        "presample": before,
        "postsample": after,
        "nyquist_cyc_per_mrad": nyquist,
        "end_cyc_per_mrad": end,
        "nyquist": f"Nyquist frequency {number_text(nyquist)} cycles/mrad",
        "rows": [[number_text(frequency[one]), f"{before[one]:.3f}", f"{after[one]:.3f}"] for one in shown],
    }


def trial_pictures(asked: TrialAsked, sensor: Sensor) -> dict[str, Any]:
    """Return one trial at each stage as pictures of 8-bit grey; the orientation is not among them. SettingsError
    if a picture would have more than `MOST_PICTURE_PIXELS`.
    """
    from sensor_sim.chain.pictures import BLACK, FINE_PIXELS_PER_DETECTOR, STAGE_TITLES, WHITE, trial_stages

    per_detector = max(FINE_PIXELS_PER_DETECTOR, sensor.display.pixels_per_detector)
    side = field_detectors(resolve_without_light(sensor), asked.size_detectors) * per_detector
    if side**2 > MOST_PICTURE_PIXELS:
        raise SettingsError(
            f"found a trial of {side} × {side} pixels, too many to show; choose a smaller triangle"
        )
    pictures = []
    for name, image in trial_stages(sensor, asked.trial(), seed=asked.seed).items():
        grey = np.rint(np.clip((image - BLACK) / (WHITE - BLACK), 0.0, 1.0) * 255.0).astype(np.uint8)
        height, width = grey.shape
        pictures.append(
            {
                "name": name,
                "caption": STAGE_TITLES[name],
                "width": width,
                "height": height,
                "pixels": base64.b64encode(grey.tobytes()).decode(),
                "range": f"{BLACK:.2f} to {WHITE:.2f} signal of a large triangle".replace("-", "−"),
            }
        )
    return {"stages": pictures}


def read(asked: TextAsked) -> dict[str, Any]:
    """Return the tables of a SENSOR.toml; see `load_sensor` for the errors."""
    return {"sensor": sensor_settings(sensor_from(parse_toml(asked.text, asked.name), asked.name))}
