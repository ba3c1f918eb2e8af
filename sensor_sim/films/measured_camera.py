"""The call `camera`: from a film of a chart, or two stills, to MTF, noise, quanta and the predicted TOD curve.

Noise-equivalent quanta (NEQ) are sharpness and noise in one number at each frequency: NEQ(f) = (μ MTF(f))² /
NPS(f), with the mean μ above black and the power spectrum NPS of the noise. It is the number of photons by which a
camera without faults would show a pattern of this frequency in the same noise. Keelan 2016, "Imaging applications
of noise equivalent quanta", Electronic Imaging, IQSP-213; Koren 2024, "Image information metrics from slanted
edges", Electronic Imaging. The MTF is that of ISO 12233.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, structs

from sensor_sim.chain.new_sensor import DISPLAY
from sensor_sim.chain.sensor import SCHEMA, load_sensor
from sensor_sim.thresholds.curve import curve
from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import checked, toml_text
from todframes.base.safe_text import in_utf8
from todframes.camera.filmed_page import view_of_camera_page
from todframes.camera.measure_emva import Emva, emva_noise
from todframes.camera.measure_mtf import Mtf, mtf
from todframes.camera.measure_noise import RecordedNoise, noise
from todframes.camera.mtf_table import NYQUIST_CYC_PER_PIXEL
from todframes.camera.noise3d import luma
from todframes.parameters import (
    MAX_FRAME_MB,
    Angle,
    Box,
    ChartFile,
    FrameLimit,
    MilliKelvin,
    NamedTable,
    PathLike,
    Plane,
    Progress,
    Rate,
)
from todframes.psychometrics.bootstrap import NORMAL_95
from todframes.recordings.opening import one_recording, paths_of
from todframes.recordings.recording import Recording, frames_integrated
from todframes.results.figures import ReportFigure
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.thresholds import Thresholds
from todframes.results.wording import plain

FREQUENCIES_CYC_PER_PIXEL = (NYQUIST_CYC_PER_PIXEL / 4.0, NYQUIST_CYC_PER_PIXEL / 2.0)
"""Frequencies of the noise-equivalent quanta: a quarter and half of the Nyquist frequency."""

RING_CYC_PER_PIXEL = 1.0 / 32.0
"""Half the width of the ring of frequencies over which the noise power is averaged."""

TOLERANCE = 0.01
"""Relative error of the thresholds, about as large as those of a measured noise and MTF."""

PITCH_MRAD = DISPLAY.pixel_pitch_mm / DISPLAY.viewing_distance_mm * 1000.0
"""Angle of a pixel of stills, if it is not given: one arcmin, as the display shows it."""


class Quanta(Struct, frozen=True, kw_only=True):
    """Noise-equivalent quanta of a pixel at a frequency.

    Attributes
    ----------
    frequency_cyc_per_pixel, mtf : float
    noise_power : float
        Power spectrum of the noise in squared values, times a pixel: the variance of a pixel if it is white.
    neq, neq_ci95 : float, (float, float)
        Noise-equivalent quanta, with the interval by the errors of noise power and MTF.
    snr : float
        Their root: the signal-to-noise ratio of a pattern of full contrast in the area of a pixel.
    """

    frequency_cyc_per_pixel: float
    mtf: float
    noise_power: float
    neq: float
    neq_ci95: tuple[float, float]
    snr: float


class MeasuredCamera(Result, frozen=True, kw_only=True):
    """A camera by its films: MTF, noise, noise-equivalent quanta, its SENSOR.toml and the curve of that.

    Attributes
    ----------
    pitch_mrad : float
        Angle of a pixel.
    neq : tuple of Quanta
        Noise-equivalent quanta at Nyquist ÷ 4 and Nyquist ÷ 2.
    signal : float
        Mean above black of the part that was taken for them, in recorded values.
    sensor_toml : str
        The camera as a SENSOR.toml, beside mtf.csv.
    mtf : Mtf
        Result of `todframes.mtf`.
    noise : RecordedNoise or None
        Result of `todframes.noise`; None with dark frames.
    emva : Emva or None
        Result of `todframes.emva_noise`; None without dark frames.
    curve : Thresholds
        Result of `sensor_sim.curve`.
    """

    pitch_mrad: float
    neq: tuple[Quanta, ...]
    signal: float
    sensor_toml: str
    mtf: Mtf
    noise: RecordedNoise | None = None
    emva: Emva | None = None
    curve: Thresholds

    @property
    def name(self) -> str:
        """Return the path of the film, or of the still with the edge."""
        return self.mtf.name

    def _parts(self) -> list[Result]:
        return [part for part in (self.mtf, self.emva, self.noise, self.curve) if part is not None]

    def table(self) -> Table:
        """Return the noise-equivalent quanta."""
        records = [
            {"pattern": f"Nyquist ÷ {NYQUIST_CYC_PER_PIXEL / at.frequency_cyc_per_pixel:g}", **structs.asdict(at)}
            for at in self.neq
        ]
        headers = {"frequency_cyc_per_pixel": "cycles/pixel", "noise_power": "noise power", "neq": "NEQ"}
        headers |= {"mtf": "MTF", "snr": "SNR"}
        columns = [Column(key="pattern", is_name=True)]
        keys = [key for key in Quanta.__struct_fields__ if key != "neq_ci95"]
        columns += [Column(key=key, header=headers[key], digits=3) for key in keys]
        of_neq = Column(key="neq_ci95", header="95 % interval", interval="neq", digits=3)
        columns.insert(keys.index("neq") + 2, of_neq)
        return Table.of("Noise-equivalent quanta of a pixel", "neq.csv", columns, records)

    def tables(self) -> list[Table]:
        """List the noise-equivalent quanta, the thresholds and the noise, and folded the curve of the MTF."""
        of_mtf, *measured, of_curve = self._parts()
        listed = [self.table(), *(table for part in (of_curve, *measured) for table in part.tables())]
        return [*listed, *(table.folded() for table in of_mtf.tables())]

    def findings(self) -> list[str]:
        """Return the quanta in words, then the findings of curve, MTF and noise."""
        low, high = self.neq
        return [
            f"Noise-equivalent quanta of a pixel: {_with_interval(low)} at Nyquist ÷ 4 and {_with_interval(high)} "
            f"at Nyquist ÷ 2, signal-to-noise ratios of {plain(low.snr)} and {plain(high.snr)} at full contrast.",
            *(sentence for part in self._parts()[::-1] for sentence in part.findings()),
        ]

    def advice(self) -> list[str]:
        """Return what a reader of the curve must know."""
        return self.curve.advice()

    def remarks(self) -> list[str]:
        """Return what the quanta are, and the remarks of the parts."""
        return [
            "NEQ is (mean above black · MTF)² over the noise power (Keelan 2016; Koren 2024), with the MTF of ISO "
            "12233 and the noise of a frame, its fixed pattern included.",
            *(remark for part in self._parts() for remark in part.remarks()),
        ]

    def figures(self) -> list[ReportFigure]:
        """List the figures of the curve, the MTF and the noise; all but the first of each are folded."""
        *measured, of_curve = self._parts()
        drawn = [part.figures() for part in (of_curve, *measured)]
        first = [figure for figures in drawn for figure in figures[:1]]
        return [*first, *(figure._replace(is_folded=True) for figures in drawn for figure in figures[1:])]

    def data_files(self) -> dict[str, bytes]:
        """Return the tables, and the camera as a SENSOR.toml."""
        return {**super().data_files(), "sensor.toml": self.sensor_toml.encode()}


@checked
def camera(
    recording: PathLike | Sequence[PathLike] | None = None,
    *,
    chart: ChartFile | None = None,
    edge: NamedTable | None = None,
    grey: NamedTable | None = None,
    dark: NamedTable | None = None,
    exposure_ms: float | None = None,
    pitch_mrad: Angle | None = None,
    frames_per_second: Rate | None = None,
    mk_per_count: MilliKelvin | None = None,
    bits: int | None = None,
    plane: Plane | None = None,
    max_frame_mb: FrameLimit = MAX_FRAME_MB,
    progress: Progress | None = None,
) -> MeasuredCamera:
    """Measure a camera from a film of a chart, or two stills, and predict its TOD curve.

    MTF, noise, noise-equivalent quanta, a SENSOR.toml of the camera and the curve of that are on one page.

    Parameters
    ----------
    recording : path or sequence of path, optional
        Film of a chart's page for the camera.
    chart : path, optional
        chart.toml of that chart.
    edge : path, optional
        Still, or film, with slanted edges, in place of a film of a chart.
    grey : path, optional
        Still, or film, of something uniform, whose whole frame is measured. One frame does not hold noise and
        fixed pattern apart: all is then taken for noise.
    dark : path, optional
        Film with the lens covered, for the noise by EMVA 1288: contrasts and electrons in place of
        signal-to-noise ratios.
    exposure_ms : float, optional
        Exposure in ms; needed with `dark`.
    pitch_mrad : float, optional
        Angle of a pixel in mrad. Default: by the scale and distance of the chart; of stills 0.2909, one arcmin.
    frames_per_second : float, optional
        Frames in a second, in place of what the files say; the eye averages those of 0.1 s.
    mk_per_count : float, optional
        Temperature difference in mK for one count. Default: from the constants of a radiometric file.
    bits : int, optional
        Number of bits of a pixel's value. Default: from the files.
    plane : (int, int), optional
        Colour plane of a Bayer mosaic: the row and the column in each cell of 2 x 2, 0 or 1.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes.
    progress : function of two ints, optional
        Called with the share of the curve that is done, and with the whole.

    Returns
    -------
    MeasuredCamera
        `neq` and `sensor_toml`, and the results `mtf`, `noise` or `emva`, and `curve`.

    Raises
    ------
    DataError, FrameError
        If the files cannot be read, or show no edge, no chart or no light.
    SettingsError
        If neither a film of a chart nor two stills are given, or a setting is invalid.

    Examples
    --------
    A camera of 1,000 electrons and a Gaussian blur of 0.7 pixels: 1,000 MTF², 739 and 298.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import sensor_sim as ss
    >>> from scipy.special import ndtr
    >>> folder, rng = Path(tempfile.mkdtemp()), np.random.default_rng(1)
    >>> y, x = np.mgrid[:80, :80] - 40.0
    >>> share = 0.2 + 0.6 * ndtr((x * np.cos(0.1) + y * np.sin(0.1)) / 0.7)
    >>> np.save(folder / "edge.npy", np.float32(1000 * share))
    >>> np.save(folder / "grey.npy", np.float32(rng.poisson(1000, (8, 256, 256))))
    >>> found = ss.camera(edge=folder / "edge.npy", grey=folder / "grey.npy")
    >>> [round(at.neq) for at in found.neq]
    [737, 299]
    """
    started = time.perf_counter()
    how: Json = {"bits": bits, "plane": plane, "max_frame_mb": max_frame_mb}
    is_film = recording is not None and chart is not None
    if is_film == (edge is not None and grey is not None) or (recording is None) != (chart is None):
        raise SettingsError(
            f"camera: expected a film with {argument.chart}, or {argument.edge} and {argument.grey} in its place"
        )
    if (dark is None) != (exposure_ms is None):
        raise SettingsError(f"found one of {argument.dark} and {argument.exposure_ms}, expected both or none")
    source: Any = recording if is_film else grey
    sharp_source: Any = recording if is_film else edge
    film = one_recording(source, "camera", frames_per_second=frames_per_second, **how)
    region = (0, 0, film.shape[1], film.shape[0])
    if chart is not None:
        view = view_of_camera_page(film, Path(chart), needs_edges=True)
        film, region = view.recording, view.patches[0].region
        pitch_mrad = view.pitch_mrad if pitch_mrad is None else pitch_mrad
    pitch_mrad = PITCH_MRAD if pitch_mrad is None else pitch_mrad
    sharp = mtf(sharp_source, chart=chart, **how)
    noisy: RecordedNoise | Emva
    tables: Json
    if dark is not None and exposure_ms is not None:
        stacks: Json = {"bright": paths_of(source), "dark": [dark], "exposure_ms": [exposure_ms]}
        noisy = emva_noise(**stacks, chart=chart, **how)
        of_emva = noisy.noise.emva1288
        electrons = of_emva.background_electrons or of_emva.points[0].signal_dn / of_emva.system_gain
        signal = electrons * of_emva.system_gain
        scene = {"luminance_cd_m2": of_emva.background_cd_m2, "background_electrons": float(f"{electrons:.6g}")}
        averaged = {"frames_integrated": frames_integrated(film.frames_per_second)}
        tables = {"noise": of_emva.noise_table() | averaged, "scene": scene}
    else:
        given: Json = {"frames_per_second": frames_per_second, "mk_per_count": mk_per_count}
        noisy = noise(source, chart=chart, region=region, **given, **how)
        recorded, transfer = noisy.noise, noisy.noise.signal_transfer
        signal = recorded.mean - (film.zero if transfer is None else transfer.offset)
        tables = {"noise": recorded.noise_table() if recorded.dynamic else {"distribution": "gaussian"}}
    if not signal > 0.0:
        raise DataError(f"{film.path}: the mean is {-signal:.4g} below black, expected light")
    curves = [sharp.mtf.mtf, *(end for end in (sharp.mtf.mtf_lower, sharp.mtf.mtf_upper) if end is not None)]
    powers = noise_powers(film, region, FREQUENCIES_CYC_PER_PIXEL)
    text = _sensor_toml(film.path.stem, pitch_mrad, tables)
    with tempfile.TemporaryDirectory(prefix="todframes-") as folder:
        (Path(folder) / "mtf.csv").write_text(sharp.to_csv(), encoding="utf-8")
        (Path(folder) / "sensor.toml").write_text(text, encoding="utf-8")
        predicted = curve(
            load_sensor(Path(folder) / "sensor.toml"), tolerance=TOLERANCE, examples=False, progress=progress
        )
    warnings = (*sharp.warnings, *noisy.warnings, *predicted.warnings)
    return MeasuredCamera.made(
        "camera",
        started,
        seed=predicted.seed,
        warnings={warning.message: warning for warning in warnings}.values(),
        pitch_mrad=pitch_mrad,
        neq=tuple(
            quanta(
                signal,
                np.array(sharp.mtf.frequency),
                [np.array(curve) for curve in curves],
                FREQUENCIES_CYC_PER_PIXEL,
                powers,
            )
        ),
        signal=signal,
        sensor_toml=text,
        mtf=sharp,
        **{"emva" if isinstance(noisy, Emva) else "noise": noisy},
        curve=predicted,
    )


def noise_powers(recording: Recording, region: Box, frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return the noise power in an even part of the frames at some frequencies in cycles/pixel, and its error.

    It is the mean over frames and directions of the squared Fourier transform of a frame, over the number of
    pixels, without a surface of second order that the light may have. Fixed pattern counts. The standard error
    is that of the mean over the frequencies of a ring, each of which stands there twice.
    """
    left, top, width, height = region
    y, x = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in (height, width)), indexing="ij"))
    surface = np.linalg.qr(np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y]))[0]
    power, n_frames = np.zeros((height, width)), 0
    for frame in recording.frames():
        values = luma(frame.values[top : top + height, left : left + width]).ravel()
        rest = values - surface @ (surface.T @ values)
        power += np.abs(np.fft.fft2(rest.reshape(height, width))) ** 2 / values.size
        n_frames += 1
    radius = np.hypot(np.fft.fftfreq(height)[:, np.newaxis], np.fft.fftfreq(width))
    rings = [np.abs(radius - frequency) <= RING_CYC_PER_PIXEL for frequency in frequencies]
    found = [power[ring] / n_frames for ring in rings]
    return [(float(of_ring.mean()), float(of_ring.std() / math.sqrt(of_ring.size / 2))) for of_ring in found]


def quanta(
    signal: float,
    frequency: FloatArray,
    curves: Sequence[FloatArray],
    frequencies: Sequence[float],
    powers: Sequence[tuple[float, float]],
) -> list[Quanta]:
    """Return the NEQ at some frequencies from the signal above black, an MTF over frequency, and noise powers with
    their standard errors. `curves` are the MTF and, if it has a 95 % band, the ends of that.
    """
    found = []
    for at, (power, power_error) in zip(frequencies, powers, strict=True):
        mtf, *band = (float(np.interp(at, frequency, curve)) for curve in curves)
        neq = (signal * mtf) ** 2 / power if power > 0.0 else math.inf
        mtf_error = (band[1] - band[0]) / (2.0 * NORMAL_95) if band else 0.0
        relative = math.hypot(power_error / power, 2.0 * mtf_error / mtf) if power > 0.0 and mtf > 0.0 else 0.0
        factor = math.exp(NORMAL_95 * relative)
        found.append(
            Quanta(
                frequency_cyc_per_pixel=at,
                mtf=mtf,
                noise_power=power,
                neq=neq,
                neq_ci95=(neq / factor, neq * factor),
                snr=math.sqrt(neq),
            )
        )
    return found


def _with_interval(at: Quanta) -> str:
    low, high = at.neq_ci95
    return f"{plain(at.neq)} ({plain(low)} to {plain(high)})"


def _sensor_toml(name: str, pitch_mrad: float, tables: Json) -> str:
    """Return a SENSOR.toml with tables of noise and scene, for the MTF beside it, on the display of `new`."""
    pitch = float(f"{pitch_mrad:.6g}")
    display = {
        "pixels_per_detector": DISPLAY.pixels_per_detector,
        "pixel_pitch_mm": DISPLAY.pixel_pitch_mm,
        "viewing_distance_mm": DISPLAY.viewing_distance_mm,
        "background_luminance_cd_m2": DISPLAY.background_luminance_cd_m2,
    }
    content: Json = {
        "schema": SCHEMA,
        "name": in_utf8(name),
        "optics": {"mtf": "mtf.csv", "mtf_includes_detector": True},
        "detector": {"pitch_mrad": pitch, "width_mrad": pitch},
        **tables,
        "display": display,
    }
    return toml_text(content)
