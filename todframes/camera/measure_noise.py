"""The call `noise`: three-dimensional noise of a recording."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import argument
from todframes.base.reading import check_positive
from todframes.base.safe_text import in_utf8
from todframes.parameters import Box, ChartFile, FrameLimit, MilliKelvin, Numbers, PatchLevels, Progress, Rate
from todframes.results.result import repeatable

if TYPE_CHECKING:
    from todframes.camera.noise_result import RecordedNoise
    from todframes.parameters import PathLike
    from todframes.results.result import Result


@repeatable
def noise(
    recording: PathLike | Sequence[PathLike] | NDArray[Any],
    *,
    region: Box | None = None,
    patches: PatchLevels | Mapping[Box, float] | None = None,
    chart: ChartFile | None = None,
    signal: float | Numbers = (),
    mk_per_count: MilliKelvin | None = None,
    frames_per_second: Rate | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> Result[RecordedNoise]:
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
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    progress : function of two ints, optional
        Called with the number of frames that are done, and of all, None if that is not known.

    Returns
    -------
    Result
        `noise` has the numbers, `measured` also the images; `sensor_toml()` is for sensor_sim.

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
    >>> measured = tod.noise(frames).measured
    >>> f"{measured.dynamic.sd:.1f} from frame to frame, {measured.fixed.sd:.1f} fixed"
    '2.0 from frame to frame, 1.0 fixed'
    """
    started = time.perf_counter()
    from todframes.camera.noise3d import FramePatch, measure_noise
    from todframes.camera.noise_result import noise_result
    from todframes.recordings.opening import one_recording
    from todframes.recordings.radiometric import mk_per_count_of

    if mk_per_count is not None:
        check_positive(argument.mk_per_count, mk_per_count)
    found = one_recording(recording, "noise", frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    levels = [FramePatch(place, float(level)) for place, level in (patches or {}).items()]
    shows = found
    if chart is not None:
        from todframes.camera.filmed_page import view_of_camera_page

        view = view_of_camera_page(found, Path(chart), progress=progress)
        shows, levels = view.recording, [*levels, *view.patches]
        region = region or max((one.region for one in levels), key=lambda place: place[2] * place[3])
    measured = measure_noise(shows, region=region, patches=levels, progress=progress)
    if mk_per_count is None:
        mk_per_count = mk_per_count_of(found, measured.mean)
    signals = tuple(np.atleast_1d(np.asarray(signal, np.float64)).tolist())
    return noise_result(
        measured, in_utf8(str(found.path)), mk_per_unit=mk_per_count, signals=signals, started=started
    )
