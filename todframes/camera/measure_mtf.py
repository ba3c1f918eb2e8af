"""The call `mtf`: the MTF of a camera from slanted edges in a recording, or a table of an MTF."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import SettingsError, argument
from todframes.base.safe_text import in_utf8
from todframes.parameters import Box, ChartFile, DisplayName, FrameLimit, Progress
from todframes.results.result import repeatable

if TYPE_CHECKING:
    from todframes.camera.mtf_result import Mtf
    from todframes.display.display import Display
    from todframes.parameters import PathLike
    from todframes.results.result import Result


@repeatable
def mtf(
    recording: PathLike | Sequence[PathLike] | NDArray[Any],
    *,
    boxes: Sequence[Box] = (),
    chart: ChartFile | None = None,
    display: DisplayName | Display | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> Result[Mtf]:
    """Measure the MTF across slanted edges (e-SFR, ISO 12233), with a 95 % band, or read it from a table.

    Parameters
    ----------
    recording : path, sequence of path, or ndarray
        A video, image files or a folder of them, camera raw or thermal files, or a file of a NumPy array; its
        frames are averaged. Or a table of an MTF to print, draw or convert: a CSV file, or a text file of MTF
        Mapper.

        An array is taken as well, of shape (frames, rows, columns), (rows, columns), or with 3 colours last.
    boxes : sequence of (int, int, int, int)
        Left column, top row, width and height in pixels of a part of the frame with one edge. Default: edges are
        found.
    chart : path, optional
        chart.toml of the chart that the recording shows, made with a page for the camera (`todframes chart
        --camera-page`): edges are found by its markers, in the frames of that page. What the pixels of its monitor
        take from the MTF is divided out.
    display : str or Display, optional
        Display whose transfer function the values were encoded for, such as reference_sdr: its luminance is
        measured. Default: values are proportional to light.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    progress : function of two ints, optional
        Called with the number of frames that are done, and of all, None if that is not known.

    Returns
    -------
    Result
        `mtf` has the `frequency`, and `mtf` with its 95 % band; `edges` has each edge.

    Raises
    ------
    DataError, FrameError
        If the files cannot be read, or no edge can be measured.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> import todframes as tod
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[:80, :80] - 40.0
    >>> edge = 0.2 + 0.6 * ndtr((x * np.cos(0.1) + y * np.sin(0.1)) / 0.7)  # a Gaussian blur of 0.7 pixels
    >>> found = tod.mtf(edge, boxes=[(0, 0, 80, 80)])
    >>> f"MTF50 {found.mtf.mtf50:.3f}, expected {np.sqrt(np.log(2) / 2) / np.pi / 0.7:.3f} cycles/pixel"
    'MTF50 0.268, expected 0.268 cycles/pixel'
    """
    started = time.perf_counter()
    from todframes.camera.mtf_result import mapper_result, measured_result, table_result
    from todframes.camera.mtf_table import is_table, read_mtf_mapper, read_mtf_table
    from todframes.camera.slanted_edges import PlacedEdge, measure_mtf
    from todframes.display.display_files import find_display
    from todframes.recordings.opening import one_recording, paths_of

    paths = [] if isinstance(recording, np.ndarray) else paths_of(recording)
    if len(paths) == 1 and is_table(paths[0]):
        given = {argument.boxes: boxes or None, argument.chart: chart, argument.display: display}
        for option in (name for name, value in given.items() if value is not None):
            raise SettingsError(f"{option}: {paths[0]} is a table of an MTF, expected a recording")
        name = in_utf8(str(paths[0]))
        if paths[0].suffix.lower() == ".csv":
            return table_result(read_mtf_table(paths[0], may_exceed_1=True), name, started=started)
        return mapper_result(read_mtf_mapper(paths[0]), name, started=started)
    shows, edges = one_recording(recording, "mtf", max_frame_mb=max_frame_mb), list[PlacedEdge]()
    shown = None if display is None else find_display(display).display
    if chart is not None:
        from todframes.camera.filmed_page import view_of_camera_page

        if boxes:
            raise SettingsError(f"{argument.boxes}: is given with {argument.chart}, expected one of them")
        view = view_of_camera_page(shows, Path(chart), needs_edges=True, progress=progress)
        shows, edges = view.recording, view.edges
    measured = measure_mtf(shows, boxes=boxes, edges=edges, display=shown, progress=progress)
    return measured_result(measured, in_utf8(str(shows.path)), is_light=shown is not None, started=started)
