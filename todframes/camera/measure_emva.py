"""The call `emva_noise`, noise of a camera as EMVA 1288 defines it, and its result."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import checked, path_inside, read_file, toml_text
from todframes.camera.emva import EmvaNumbers, Stack, measure_emva
from todframes.camera.mtf_table import Ends
from todframes.parameters import Box, ChartFile, DescriptorFile, FrameLimit, Numbers, PathLike, Plane, Progress
from todframes.results.data import ResultWarning, as_read
from todframes.results.figures import COLOURS, INK, PAPER, ReportFigure, add_legend, plain_ticks
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from todframes.recordings.recording import Recording

Stacks = Sequence["PathLike | NDArray[Any]"]

NS_PER_MS = 1e6

FIGURES = (
    ("system_gain", "system gain K", "DN/e⁻", 1.0),
    ("quantum_efficiency", "quantum efficiency", "%", 100.0),
    ("responsivity", "responsivity R", "DN/photon", 1.0),
    ("dark_noise", "dark noise", "e⁻", 1.0),
    ("dark_noise_dn", "dark noise", "DN", 1.0),
    ("dark_current", "dark current", "e⁻/s", 1.0),
    ("dsnu", "DSNU", "e⁻", 1.0),
    ("prnu", "PRNU", "%", 1.0),
    ("saturation_electrons", "saturation", "e⁻", 1.0),
    ("saturation_photons", "saturation", "photons", 1.0),
    ("sensitivity_threshold", "least detectable signal", "photons", 1.0),
    ("background_electrons", "background of the chart", "e⁻", 1.0),
)
"""Figures of a camera by key, with their names, units, and factors to these units."""

SNR_SPAN = (0.5, 2.0)
"""Ends of the curves of signal-to-noise ratio, relative to the fewest and the most photons."""


class EmvaKey(Struct, frozen=True, kw_only=True):
    """The key `noise` of the result."""

    emva1288: EmvaNumbers


class Emva(Result, frozen=True, kw_only=True):
    """The noise of a camera by EMVA 1288.

    Attributes
    ----------
    noise : EmvaKey
        The numbers, under the key `emva1288`.
    """

    noise: EmvaKey

    @property
    def name(self) -> str:
        """Return the path of the descriptor, or of the first bright stack."""
        return self.noise.emva1288.source

    def tables(self) -> list[Table]:
        """List the figures of the camera that are known, and folded the points."""
        numbers = self.noise.emva1288
        records = []
        for key, name, unit, factor in FIGURES:
            value: float | None = getattr(numbers, key)
            if value is not None:
                ends: Ends | None = getattr(numbers, f"{key}_ci95")
                scaled = None if ends is None else tuple(None if end is None else factor * end for end in ends)
                records.append({"figure": name, "value": factor * value, "unit": unit, "value_ci95": scaled})
        columns = [
            Column(key="figure", is_name=True),
            Column(key="value"),
            Column(key="unit"),
            Column(key="value_ci95", header="95 % interval", interval="value_ci95"),
        ]
        headers = {
            "exposure_ms": "exposure (ms)",
            "photons": "photons",
            "n_frames": "frames",
            "signal_dn": "signal (DN)",
            "variance_dn2": "variance (DN²)",
            "snr": "SNR",
            "is_fitted": "in the fit",
        }
        points = [structs.asdict(point) for point in numbers.points]
        of_points = [Column(key=key, header=header) for key, header in headers.items()]
        transfer = Table.of("Photon transfer", "photon_transfer.csv", of_points, points).without_empty_columns()
        return [
            Table.of(f"EMVA 1288 of {path_name(numbers.source)}", "emva.csv", columns, records),
            transfer.folded(),
        ]

    def findings(self) -> list[str]:
        """Return the findings in words."""
        numbers = self.noise.emva1288

        def known(key: str, unit: str, digits: int = 3) -> str:
            ends: Ends | None = getattr(numbers, f"{key}_ci95")
            interval = "" if ends is None else f" ({interval_phrase(ends)})"
            return f"{plain(getattr(numbers, key), digits)} {unit}{interval}"

        n_fitted = sum(point.is_fitted for point in numbers.points)
        stacks = f"{count(n_fitted, 'bright stack')} of {len(numbers.points)}"
        texts = [
            f"System gain {known('system_gain', 'DN per electron', 4)}, from {stacks}.",
            f"A pixel has a dark noise of {known('dark_noise', 'electrons')}, DSNU {known('dsnu', 'electrons')} "
            f"and PRNU {known('prnu', '%')}.",
        ]
        if numbers.saturation_electrons is not None:
            where = "" if numbers.is_saturation_reached else ", at the end of the scale"
            texts.append(
                f"It saturates at {plain(numbers.saturation_electrons, 4)} electrons{where}: an SNR of up to "
                f"{plain(math.sqrt(numbers.saturation_electrons))}."
            )
        if numbers.linearity_percent is not None:
            low, high = numbers.linearity_percent
            texts.append(f"Linearity errors are {plain(low, 2)} to {plain(high, 2)} %.")
        return texts

    def figures(self) -> list[ReportFigure]:
        """List the signal-to-noise ratio against the ideal one, and the photon transfer."""
        what = "photons" if self.noise.emva1288.quantum_efficiency is not None else "electrons"
        return [
            ReportFigure("Signal-to-noise ratio", f"Of a pixel, by its {what}.", self._draw_snr, "emva.png"),
            ReportFigure(
                "Photon transfer", "Its slope is the system gain K.", self._draw_transfer, "photon_transfer.png"
            ),
        ]

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml for this camera, with the model `photon`.

        With the film of a chart it has the table `[scene]` too, with the electrons of the background.
        """
        numbers = self.noise.emva1288
        table, background = numbers.noise_table(), numbers.background_electrons
        needs_photons = "quantum_efficiency" not in table and background is None
        hints = ["quantum_efficiency is not known: give photons"] if needs_photons else []
        hints += [] if "exposure_ms" in table else [f"exposure_ms is not known: give {argument.exposure_ms}"]
        if not numbers.is_saturation_reached and "full_well_electrons" in table:
            hints.append("full_well_electrons is the end of the scale: no stack was saturated")
        tables: Json = {"noise": table}
        if background is not None:
            tables["scene"] = {
                "luminance_cd_m2": numbers.background_cd_m2,
                "background_electrons": float(f"{background:.6g}"),
            }
        return toml_text(tables, comment="\n".join(hints))

    def data_files(self) -> dict[str, bytes]:
        """Return the tables, and a table for a sensor."""
        return {**super().data_files(), "sensor_noise.toml": self.sensor_toml().encode()}

    def snr(self, electrons: FloatArray, *, with_spatial: bool = False) -> FloatArray:
        """Return the signal-to-noise ratio of a pixel by its mean number of electrons, η μ_p for μ_p photons.

        EMVA 1288 release 4.0 linear: η μ_p / √(σ_d² + σ_q² / K² + η μ_p), and with the spatial parts DSNU² and
        (PRNU η μ_p)² under the root. The dark noise in DN is that with σ_q, of rounding.
        """
        numbers = self.noise.emva1288
        variance = (numbers.dark_noise_dn / numbers.system_gain) ** 2 + electrons
        if with_spatial:
            variance = variance + numbers.dsnu**2 + (numbers.prnu / 100.0 * electrons) ** 2
        return np.asarray(electrons / np.sqrt(variance))

    def _draw_transfer(self, axes: Axes) -> None:
        points, gain = self.noise.emva1288.points, self.noise.emva1288.system_gain
        for is_fitted, face, label in ((True, COLOURS[0], "in the fit"), (False, PAPER, "beyond it")):
            shown = [(point.signal_dn, point.variance_dn2) for point in points if point.is_fitted == is_fitted]
            if shown:
                axes.plot(*zip(*shown, strict=True), "o", color=COLOURS[0], mfc=face, markersize=4, label=label)
        signal = np.array([0.0, max(point.signal_dn for point in points)])
        axes.plot(signal, gain * signal, color=COLOURS[4], label=f"K = {plain(gain, 4)} DN/e⁻", zorder=1)
        axes.set(xlabel="signal above dark (DN)", ylabel="variance above dark (DN²)")
        most = max(point.variance_dn2 for point in points)
        axes.set_ylim(min(0.0, *(point.variance_dn2 for point in points)) - 0.03 * most, 1.12 * most)
        add_legend(axes)

    def _draw_snr(self, axes: Axes) -> None:
        numbers = self.noise.emva1288
        # Without a quantum efficiency the abscissa is electrons; ideal is the camera that counts all of them.
        per_photon = numbers.quantum_efficiency or 1.0
        points = [point for point in numbers.points if point.signal_dn > 0.0 and not point.is_saturated]
        x = np.array([point.signal_dn / numbers.system_gain / per_photon for point in points])
        light = np.geomspace(SNR_SPAN[0] * x.min(), SNR_SPAN[1] * x.max(), 200)
        axes.plot(light, np.sqrt(light), color=INK, ls=":", label="ideal: every photon counts")
        axes.plot(light, self.snr(light * per_photon), color=COLOURS[0], label="temporal noise")
        total = self.snr(light * per_photon, with_spatial=True)
        axes.plot(light, total, color=COLOURS[4], ls="--", label="with DSNU and PRNU")
        axes.plot(
            x, [point.snr or np.inf for point in points], "o", color=COLOURS[0], markersize=4, label="measured"
        )
        what = "electrons" if numbers.quantum_efficiency is None else "photons"
        axes.set(xscale="log", yscale="log", xlabel=f"{what} of a pixel", ylabel="SNR")
        plain_ticks(axes.yaxis, np.sqrt(light).tolist())
        add_legend(axes)


@checked
def emva_noise(
    descriptor: DescriptorFile | None = None,
    *,
    bright: Stacks = (),
    dark: Sequence[PathLike] | Stacks = (),
    exposure_ms: Numbers = (),
    photons: Numbers = (),
    bits: int | None = None,
    plane: Plane | None = None,
    region: Box | None = None,
    chart: ChartFile | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> Emva:
    """Measure the noise of a linear camera as EMVA 1288 defines it, from bright and dark frames.

    The camera must give raw values. Each stack has frames of one exposure of a uniform scene, bright or dark.

    Parameters
    ----------
    descriptor : path, optional
        Descriptor file of an EMVA 1288 measurement, which names images, exposures and photons, in place of
        recordings.
    bright : sequence of path or ndarray
        Recordings, or arrays (frames, rows, columns), of two frames or more each.
    dark : sequence of path or ndarray
        A recording of dark frames for EMVA 1288, whose bright stacks are the recordings: one for all of them, or
        one for each in the same order.

        Arrays (frames, rows, columns) of two frames or more are taken as well.
    exposure_ms : sequence of float, optional
        Exposure of each bright stack in ms, in the order of the stacks. Three or more give the dark current.
    photons : sequence of float, optional
        Mean number of photons of a pixel in each bright stack, for the quantum efficiency.
    bits : int, optional
        Number of bits of a pixel's value: 14 if the largest value is 16383, also in files of 16. Default: from the
        files.
    plane : (int, int), optional
        Colour plane of a Bayer mosaic: the row and the column in each cell of 2 x 2, 0 or 1, as 0,0 for the red of
        RGGB. Default: all values, of camera raw the first green ones.
    region : (int, int, int, int), optional
        Left column, top row, width and height in pixels. Default: the whole frame.
    chart : path, optional
        chart.toml of a chart with a page for the camera: `bright` is one film of it, and the patches of that
        page's wedge are the bright stacks. `dark` is one film with the lens covered.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    progress : function of two ints, optional
        Called with the number of frames of a stack that are done, and of all, None if that is not known.

    Returns
    -------
    Result
        `noise.emva1288` has the figures, most with a 95 % interval; `sensor_toml()` is for sensor_sim.

    Raises
    ------
    DataError, FrameError
        If a stack cannot be read or has one frame, two exposures or colours; if all bright stacks are saturated.
    SettingsError
        If a setting is invalid, or the numbers of stacks, exposures and photons differ.

    Examples
    --------
    A camera of 0.5 DN per electron, a dark noise of 4 electrons and a bright stack of 1,000 electrons.

    >>> import numpy as np
    >>> import todframes as tod
    >>> rng = np.random.default_rng(1)
    >>> dark, bright = (
    ...     np.round(10 + 0.5 * (rng.poisson(mean, (4, 96, 96)) + rng.normal(0, 4, (4, 96, 96)))).astype(np.uint16)
    ...     for mean in (0, 1000)
    ... )
    >>> found = tod.emva_noise(bright=[bright], dark=[dark], bits=12).noise.emva1288
    >>> f"{found.system_gain:.2f} DN per electron, {found.dark_noise:.1f} electrons"
    '0.50 DN per electron, 4.0 electrons'
    """
    started = time.perf_counter()
    if (descriptor is None) == (not len(bright) and not len(dark)):
        given = "neither" if descriptor is None else "both"
        raise SettingsError(f"noise: found {given} of a descriptor and bright and dark stacks, expected one")
    background = luminance = None
    if descriptor is not None:
        of_bright, of_dark, described_bits = _described(Path(descriptor), plane, max_frame_mb)
        bits, name = described_bits if bits is None else bits, str(descriptor)
    else:
        films, covered = (
            [_opened(stack, f"{what}[{number}]", plane, max_frame_mb) for number, stack in enumerate(stacks)]
            for what, stacks in (("bright", bright), ("dark", dark))
        )
        if not films or not covered:
            raise SettingsError(f"noise: found no {'dark' if films else 'bright'} stack, expected one or more")
        name, has_chart = str(films[0].path), chart is not None
        if chart is not None:
            _check_for_chart(films, covered, region, photons)
            from todframes.camera.filmed_page import view_of_camera_page

            view = view_of_camera_page(films[0], Path(chart), needs_edges=True, progress=progress)
            luminance = view.patches[0].level if view.is_luminance else None
            exposures = _of_each(exposure_ms, 1, argument.exposure_ms)
            films, covered = view.stacks(covered[0])
            exposures *= len(films)
        else:
            exposures = _of_each(exposure_ms, len(bright), argument.exposure_ms)
        lights = _of_each(photons, len(films), argument.photons)
        if len(covered) not in (1, len(films)):
            raise SettingsError(
                f"noise: found {len(dark)} dark stacks for {len(bright)} bright ones, expected one for all or one "
                "for each"
            )
        of_bright = [
            Stack(recording=film, exposure_ms=exposure, photons=light, is_levelled=has_chart)
            for film, exposure, light in zip(films, exposures, lights, strict=True)
        ]
        of_dark = [
            Stack(recording=film, exposure_ms=exposure) for film, exposure in zip(covered, exposures, strict=False)
        ]
        background = of_bright[0] if has_chart else None
        # The frames of a chart have been counted when it was searched.
        progress = None if has_chart else progress
    numbers, warnings = measure_emva(
        of_bright, of_dark, bits=bits, region=region, source=name, background=background, progress=progress
    )
    numbers = structs.replace(numbers, background_cd_m2=luminance)
    of_codes = [ResultWarning(**warning._asdict()) for warning in warnings]
    return Emva.made("emva", started, warnings=of_codes, noise=as_read(EmvaKey(emva1288=numbers), EmvaKey))


def _check_for_chart(
    films: Sequence[Recording], covered: Sequence[Recording], region: Box | None, photons: Sequence[float]
) -> None:
    """Raise SettingsError for what a chart determines, and unless there are one film of it and one dark one."""
    for name, value in ((argument.region, region), (argument.photons, photons or None)):
        if value is not None:
            raise SettingsError(
                f"{name}: is given with {argument.chart}, whose patches are measured, expected none"
            )
    for what, stacks in (("bright", films), ("dark", covered)):
        if len(stacks) != 1:
            raise SettingsError(
                f"noise: found {len(stacks)} {what} recordings with {argument.chart}, expected one"
            )


def _opened(stack: PathLike | NDArray[Any], name: str, plane: Plane | None, max_frame_mb: int) -> Recording:
    from todframes.recordings.opening import one_recording

    recording = one_recording(stack, "noise", plane=plane, max_frame_mb=max_frame_mb)
    return replace(recording, path=Path(name)) if isinstance(stack, np.ndarray) else recording


def _described(path: Path, plane: Plane | None, max_frame_mb: int) -> tuple[list[Stack], list[Stack], int]:
    """Return the bright and dark stacks of a descriptor file, and the bits of a pixel.

    It says which images belong to which exposure and light. Versions 3 and 4 of the standard have the same form.
    """
    from todframes.recordings.opening import one_recording

    folder = os.path.realpath(path.parent)
    size: list[int] = []
    described: list[tuple[float, float | None, list[Path]]] = []
    lines = read_file(path, most_mb=4).decode("utf-8", errors="replace").splitlines()
    for where, line in ((f"{path}: line {number}", line) for number, line in enumerate(lines, 1)):
        kind, values = [*line.strip().split(maxsplit=1), "#", ""][:2]
        if kind.startswith("#"):
            continue
        if kind == "i" and described:
            name = values.replace("\\", "/")
            names = [name] if (path.parent / name).exists() else name.split()  # a name may have spaces
            described[-1][2].extend(Path(str(path_inside(folder, name, where))) for name in names)
            continue
        try:
            numbers = [float(value) for value in values.split()]
        except ValueError:
            numbers = [math.nan]
        is_number = all(math.isfinite(number) and number >= 0.0 for number in numbers)
        match kind if is_number else "", numbers:
            case "v", [version] if 3.0 <= version < 5.0:
                pass
            case "n", [_, _, _]:
                size = [round(number) for number in numbers]
            case "b", [exposure_ns, photons]:
                described.append((exposure_ns / NS_PER_MS, photons, []))
            case "d", [exposure_ns]:
                described.append((exposure_ns / NS_PER_MS, None, []))
            case _:
                raise DataError(
                    f"{where}: found {line.strip()[:40]!r}, expected 'v 3' or 'v 4', 'n bits width height', 'b "
                    "exposure_ns photons', 'd exposure_ns', and behind these 'i' with the names of their images"
                )
    if not size:
        raise DataError(
            f"{path}: found no line 'n bits width height', expected one; is it a descriptor of EMVA 1288?"
        )
    bits, width, height = size
    stacks: tuple[list[Stack], list[Stack]] = ([], [])
    for exposure_ms, light, images in described:
        if not images:
            raise DataError(f"{path}: found no images for an exposure of {exposure_ms:g} ms, expected 2 or more")
        where = f"{path}: exposure of {exposure_ms:g} ms"
        recording = one_recording(images, where, plane=plane, max_frame_mb=max_frame_mb)
        per_side = 1 if plane is None else 2
        if recording.shape != (height // per_side, width // per_side):
            rows, columns = (per_side * side for side in recording.shape)
            raise DataError(
                f"{recording.path}: has {columns} x {rows} pixels, expected {width} x {height} by {path}"
            )
        stacks[light is None].append(Stack(recording=recording, exposure_ms=exposure_ms, photons=light))
    return *stacks, bits


def _of_each(values: Sequence[float], n: int, name: str) -> list[float | None]:
    """Return a value for each of n stacks, or None for each if there are none."""
    if not len(values):
        return [None] * n
    if len(values) != n:
        raise SettingsError(f"{name}: found {len(values)} numbers for {n} bright stacks, expected one for each")
    if not all(np.isfinite(value) and value > 0.0 for value in values):
        raise SettingsError(f"{name}: found {', '.join(f'{value:g}' for value in values)}, expected numbers > 0")
    return [float(value) for value in values]
