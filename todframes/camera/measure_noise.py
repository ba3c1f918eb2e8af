"""The call `noise`, three-dimensional noise of a recording, and its result."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, checked, toml_text
from todframes.base.safe_text import in_utf8
from todframes.camera.noise3d import (
    PARTS,
    FramePatch,
    NoiseNumbers,
    NoisePart,
    PatchNoise,
    Snr,
    fit_drift,
    fit_transfer,
    root,
    snr_of,
    steady_part,
    sum_frames,
    warnings_of,
    with_interval,
)
from todframes.parameters import (
    Box,
    ChartFile,
    FrameLimit,
    MilliKelvin,
    Numbers,
    PatchLevels,
    PathLike,
    Plane,
    Progress,
    Rate,
)
from todframes.recordings.radiometric import mk_per_count_of
from todframes.recordings.recording import frames_integrated
from todframes.results.data import ResultWarning, as_read
from todframes.results.figures import COLOURS, INK, ReportFigure
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import count, interval_phrase, path_name, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes


VALUE_UNITS = {"code": "code values", "relative": "of white", "counts": "counts", "celsius": "°C"}

COMBINED = {"dynamic": "tv, th and tvh together", "fixed pattern": "v, h and vh together"}


class NoiseImages(NamedTuple):
    """Mean and, of two frames or more, standard deviation of each pixel over the frames; means of the frames."""

    mean: FloatArray
    temporal_sd: FloatArray | None
    frame_means: FloatArray


class RecordedNoise(Result, frozen=True, kw_only=True):
    """The noise of a recording.

    Attributes
    ----------
    noise : NoiseNumbers
        The numbers.
    images : NoiseImages or None
        Mean and standard deviation of each pixel, and the means of the frames; None for a result that was read.
    """

    noise: NoiseNumbers

    images: ClassVar[NoiseImages | None] = None

    @property
    def name(self) -> str:
        """Return the path of the recording."""
        return self.noise.recording

    def tables(self) -> list[Table]:
        """List the parts of the noise, then the signal-to-noise ratios and the patches that were asked for."""
        noise, title = self.noise, f"Noise of {path_name(self.noise.recording)}"
        named, meanings = dict(noise.parts), PARTS | COMBINED
        if noise.dynamic is not None and noise.fixed_pattern is not None:
            named |= {"dynamic": noise.dynamic, "fixed pattern": noise.fixed_pattern}
        else:
            meanings = {name: f"{PARTS[name]} and from frame to frame" for name in named}
        records = [
            {"part": name, "meaning": meanings[name], "sd": part.sd, "sd_ci95": part.ci95, "sd_mk": part.sd_mk}
            for name, part in named.items()
        ]
        columns = [
            Column(key="part", is_name=True),
            Column(key="sd", header=f"SD ({VALUE_UNITS[noise.unit]})"),
            Column(key="sd_ci95", header="95 % interval", interval="sd_ci95"),
            Column(key="sd_mk", header="SD (mK)"),
            Column(key="meaning", rank=1, wraps=True),
        ]
        tables = [Table.of(title, "noise.csv", columns, records).without_empty_columns()]
        if noise.snr:
            ratios = [structs.asdict(ratio) for ratio in noise.snr]
            columns = [Column(key="signal"), Column(key="frames", header="frames averaged")]
            columns.append(Column(key="snr", header="SNR"))
            tables.append(Table.of("Signal-to-noise ratio of a pixel", "snr.csv", columns, ratios))
        if noise.patches:
            patches: list[Json] = [
                {"level": patch.level, "mean": patch.mean, "snr": patch.snr}
                | {"dynamic": patch.dynamic and patch.dynamic.sd, "fixed_pattern": patch.fixed and patch.fixed.sd}
                for patch in noise.patches
            ]
            headers = {"dynamic": "dynamic SD", "fixed_pattern": "fixed SD", "snr": "SNR against the first"}
            columns = [Column(key=key, header=headers.get(key, "")) for key in ("level", "mean", *headers)]
            tables.append(Table.of("Patches", "patches.csv", columns, patches))
        return tables

    def findings(self) -> list[str]:
        """Return the findings in words."""
        noise, unit = self.noise, VALUE_UNITS[self.noise.unit]
        if noise.dynamic is not None and noise.fixed_pattern is not None:
            dynamic, fixed = map(self._with_unit, (noise.dynamic, noise.fixed_pattern))
            texts = [f"Noise of a pixel: dynamic {dynamic}, fixed pattern {fixed}."]
        else:
            texts = [f"Spatial noise of a pixel: {self._with_unit(noise.parts['vh'])}."]
        texts.append(f"Mean {plain(noise.mean, 5)} {unit} in {count(noise.n_frames, 'frame')}.")
        if noise.drift is not None:
            per = "s" if noise.frames_per_second is not None else "frame"
            texts.append(
                f"Drift of the mean: {plain(noise.drift.slope)} ± {plain(noise.drift.slope_error, 2)} per {per}, "
                f"{plain(noise.drift.change)} in all."
            )
        if (transfer := noise.signal_transfer) is not None:
            error = "" if transfer.gain_error is None else f" ± {plain(transfer.gain_error, 2)}"
            texts.append(
                f"Signal transfer: {plain(transfer.gain, 4)}{error} {unit} per unit of level; patches deviate "
                f"from a straight line by up to {plain(100 * transfer.nonlinearity, 2)} % of its range."
            )
        return texts

    def figures(self) -> list[ReportFigure]:
        """List the parts; of a new measurement also means of frames, mean image and temporal noise of pixels."""
        figures = [ReportFigure("Parts of the noise", "With 95 % intervals.", self._draw_parts, "noise.png")]
        if (images := self.images) is None:
            return figures
        draw = partial(_draw_image, image=images.mean, unit=VALUE_UNITS[self.noise.unit])
        of_mean = ReportFigure("Mean of each pixel", "", draw, "mean.png")
        if images.temporal_sd is None:
            return [*figures, of_mean]
        of_frames = partial(self._draw_means, means=images.frame_means)
        of_sd = partial(draw, image=images.temporal_sd)
        return [
            *figures,
            ReportFigure("Mean of each frame", "", of_frames, "frame_means.png"),
            of_mean,
            ReportFigure("SD of each pixel from frame to frame", "", of_sd, "temporal_sd.png"),
        ]

    def sensor_toml(self) -> str:
        """Return the table `[noise]` of a SENSOR.toml, with a hint if mK are not known.

        Raises
        ------
        DataError
            If there is one frame, or no noise from frame to frame.
        """
        table = self.noise.noise_table()
        hint = "" if "netd_mk" in table else f"netd_mk is not known: give {argument.mk_per_count}"
        return toml_text({"noise": table}, comment=hint)

    def data_files(self) -> dict[str, bytes]:
        """Return the tables, and a table for a sensor if dynamic noise is known."""
        known = self.noise.fixed_pattern_ratio is not None
        return {**super().data_files(), **({"sensor_noise.toml": self.sensor_toml().encode()} if known else {})}

    def _with_unit(self, part: NoisePart) -> str:
        text = f"{plain(part.sd)} ({interval_phrase(part.ci95, 3)}) {VALUE_UNITS[self.noise.unit]}"
        return text if part.sd_mk is None else f"{text} = {plain(part.sd_mk)} mK"

    def _draw_parts(self, axes: Axes) -> None:
        names, parts = list(self.noise.parts), self.noise.parts.values()
        sd, ends = np.array([part.sd for part in parts]), np.array([part.ci95 for part in parts])
        errors = np.maximum([sd - ends[:, 0], np.minimum(ends[:, 1], 3 * sd.max()) - sd], 0.0)
        axes.bar(names, sd, color=COLOURS[0], width=0.6)
        axes.errorbar(names, sd, yerr=errors, fmt="none", ecolor=INK, elinewidth=1.0, capsize=3)
        axes.set(ylabel=f"SD ({VALUE_UNITS[self.noise.unit]})")

    def _draw_means(self, axes: Axes, means: FloatArray) -> None:
        rate = self.noise.frames_per_second
        axes.plot(np.arange(len(means)) / (rate or 1.0), means, ".", markersize=3, color=COLOURS[1])
        axes.set(xlabel="time (s)" if rate else "frame", ylabel=VALUE_UNITS[self.noise.unit])
        axes.ticklabel_format(useOffset=False)


def _draw_image(axes: Axes, image: FloatArray, unit: str) -> None:
    low, high = np.percentile(image, (0.5, 99.5))
    shown = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axes.grid(visible=False)
    axes.figure.colorbar(shown, ax=axes, label=unit, format="%.5g")


@checked
def noise(
    recording: PathLike | Sequence[PathLike] | NDArray[Any],
    *,
    region: Box | None = None,
    patches: PatchLevels | Mapping[Box, float] | None = None,
    chart: ChartFile | None = None,
    signal: float | Numbers = (),
    mk_per_count: MilliKelvin | None = None,
    frames_per_second: Rate | None = None,
    bits: int | None = None,
    plane: Plane | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> RecordedNoise:
    """Measure the noise of a recording of a uniform scene that does not move.

    The noise is that of time, rows and columns (D'Agostino & Webb 1991), each part with a 95 % interval. Anything
    that is not uniform counts as fixed pattern.

    Parameters
    ----------
    recording : path, sequence of path, or ndarray
        A video, image files or a folder of them, camera raw or thermal files, or a file of a NumPy array.

        An array is taken as well, of shape (frames, rows, columns), or (frames, rows, columns, 3) in colour.
    region : (int, int, int, int), optional
        Left column, top row, width and height in pixels. Default: the whole frame, or the largest patch of the
        chart.
    patches : mapping, optional
        A uniform part of the frame and its luminance, reflectance or temperature, for the signal transfer and a
        signal-to-noise ratio at each level.
    chart : path, optional
        chart.toml of the chart that the recording shows: its patches are found by its markers. If the chart has a
        page for the camera, the frames that show it are measured.
    signal : float or sequence of float
        Differences of the values, whose signal-to-noise ratios are given.
    mk_per_count : float, optional
        Temperature difference in mK for one count. Default: from the constants of a radiometric file, at the mean
        of the recording.
    frames_per_second : float, optional
        Frames in a second, in place of what the files say.
    bits : int, optional
        Number of bits of a pixel's value: 14 if the largest value is 16383, also in files of 16. Default: from the
        files.
    plane : (int, int), optional
        Colour plane of a Bayer mosaic: the row and the column in each cell of 2 x 2, 0 or 1, as 0,0 for the red of
        RGGB. Default: all values, of camera raw the first green ones.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    progress : function of two ints, optional
        Called with the number of frames that are done, and of all, None if that is not known.

    Returns
    -------
    Result
        `noise` has the numbers, `images` those of pixels; `sensor_toml()` is for sensor_sim.

    Raises
    ------
    DataError, FrameError
        If the files cannot be read, or are several recordings.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> import todframes as tod
    >>> rng = np.random.default_rng(1)
    >>> frames = 100 + rng.normal(0, 1, (64, 64)) + rng.normal(0, 2, (50, 64, 64))
    >>> found = tod.noise(frames).noise
    >>> f"{found.dynamic.sd:.1f} from frame to frame, {found.fixed_pattern.sd:.1f} fixed"
    '2.0 from frame to frame, 1.0 fixed'
    """
    started = time.perf_counter()
    from todframes.recordings.opening import one_recording

    if mk_per_count is not None:
        check_positive(argument.mk_per_count, mk_per_count)
    shown = one_recording(
        recording,
        "noise",
        frames_per_second=frames_per_second,
        bits=bits,
        plane=plane,
        max_frame_mb=max_frame_mb,
    )
    levels = [FramePatch(patch, float(level)) for patch, level in (patches or {}).items()]
    if chart is not None:
        from todframes.camera.filmed_page import view_of_camera_page

        view = view_of_camera_page(shown, Path(chart), progress=progress)
        shown, levels = view.recording, [*levels, *view.patches]
        region = region or max((patch.region for patch in levels), key=lambda box: box[2] * box[3])
    distinct = {patch.level for patch in levels}
    if levels and (len(distinct) < 2 or not all(map(math.isfinite, distinct))):
        raise SettingsError(f"patches: found levels {sorted(distinct)}, expected at least two different numbers")
    boxes = [region, *(patch.region for patch in levels)]
    (whole, *of_patches), times = sum_frames(shown, boxes, progress)
    steady = steady_part(shown, whole)
    if steady.n_frames not in (None, whole.n):
        (whole, *of_patches), times = sum_frames(steady, boxes, None)
    mean = float(whole.means().mean())
    if mk_per_count is None:
        mk_per_count = mk_per_count_of(steady, mean)
    per_unit = 1000.0 if steady.unit == "celsius" else mk_per_count
    variances = whole.variances()
    parts = {name: NoisePart.of(drawn, per_unit) for name, drawn in variances.items()}
    patch_noises: list[PatchNoise] = []
    for patch, sums in zip(levels, of_patches, strict=True):
        own = {name: NoisePart.of(drawn, per_unit) for name, drawn in sums.variances().items()}
        level = float(sums.means().mean())
        snr = snr_of(abs(level - (patch_noises[0].mean if patch_noises else level)), own)
        patch_noises.append(PatchNoise(patch.level, level, own.get("dynamic"), own.get("fixed_pattern"), snr))
    snrs = [
        Snr(signal=each, frames=n, snr=snr_of(each, parts, n))
        for each in np.atleast_1d(np.asarray(signal, np.float64)).tolist()
        for n in dict.fromkeys((1, frames_integrated(steady.frames_per_second)))
    ]
    dynamic, fixed = parts.pop("dynamic", None), parts.pop("fixed_pattern", None)
    ratio = None
    if dynamic is not None and dynamic.sd > 0.0:
        sd, ends = with_interval(root(variances["fixed_pattern"] / variances["dynamic"]))
        ratio = {"ratio": sd, "ratio_ci95": ends}
    drift = fit_drift(whole.means(), times)
    numbers = NoiseNumbers(
        recording=in_utf8(str(steady.path)),
        unit="relative" if steady.full_scale == 1.0 else steady.unit,
        n_frames=whole.n,
        frames_per_second=steady.frames_per_second,
        region=whole.region,
        mean=mean,
        parts=parts,
        dynamic=dynamic,
        fixed_pattern=fixed,
        fixed_pattern_ratio=ratio,
        drift=drift,
        mk_per_unit=mk_per_count,
        snr=tuple(snrs),
        patches=tuple(patch_noises),
        signal_transfer=fit_transfer(patch_noises) if patch_noises else None,
    )
    warnings = [*steady.warnings, *warnings_of(whole, parts.get("tvh", parts["vh"]), drift)]
    of_codes = [ResultWarning(**warning._asdict()) for warning in warnings]
    made = RecordedNoise.made("noise", started, warnings=of_codes, noise=as_read(numbers, NoiseNumbers))
    return made.holding(
        images=NoiseImages(whole.mean_image(), whole.temporal_sd() if whole.n > 1 else None, whole.means())
    )
