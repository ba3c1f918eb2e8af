"""The call `emva_noise`: noise of a camera as EMVA 1288 defines it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError, argument
from todframes.parameters import Box, ChartFile, DescriptorFile, FrameLimit, Numbers, Progress
from todframes.results.result import repeatable

if TYPE_CHECKING:
    from todframes.camera.emva_result import Emva
    from todframes.parameters import PathLike
    from todframes.recordings.recording import Recording
    from todframes.results.result import Result

Stacks = Sequence["PathLike | NDArray[Any]"]


@repeatable
def emva_noise(
    descriptor: DescriptorFile | None = None,
    *,
    bright: Stacks = (),
    dark: Sequence[PathLike] | Stacks = (),
    exposure_ms: Numbers = (),
    photons: Numbers = (),
    bits: int | None = None,
    region: Box | None = None,
    chart: ChartFile | None = None,
    max_frame_mb: FrameLimit = 256,
    progress: Progress | None = None,
) -> Result[Emva]:
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
        Number of bits of a pixel's value. Default: from the files.
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
        `noise.emva1288` has the figures, most with a 95 % interval; `xml()` is a result file of EMVA 1288, and
        `sensor_toml()` is for sensor_sim.

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
    from todframes.camera.emva import Stack, measure_emva
    from todframes.camera.emva_result import emva_result

    if (descriptor is None) == (not len(bright) and not len(dark)):
        found = "neither" if descriptor is None else "both"
        raise SettingsError(f"noise: found {found} of a descriptor and bright and dark stacks, expected one")
    if bits is not None and not 1 <= bits <= 32:
        raise SettingsError(f"{argument.bits}: found {bits}, expected 1 to 32")
    if descriptor is not None:
        of_bright, of_dark, bits = _described(Path(descriptor), bits, max_frame_mb)
        name = str(descriptor)
    else:
        opened = [
            [_opened(one, f"{what}[{number}]", max_frame_mb) for number, one in enumerate(stacks)]
            for what, stacks in (("bright", bright), ("dark", dark))
        ]
        if not all(opened):
            missing = "dark" if opened[0] else "bright"
            raise SettingsError(f"noise: found no {missing} stack, expected one or more")
        if chart is not None:
            return _of_chart(
                Path(chart), *opened, exposure_ms=exposure_ms, photons=photons, bits=bits, region=region,
                started=started, progress=progress,
            )  # fmt: skip
        exposures = _of_each(exposure_ms, len(bright), argument.exposure_ms)
        lights = _of_each(photons, len(bright), argument.photons)
        if len(dark) not in (1, len(bright)):
            raise SettingsError(
                f"noise: found {len(dark)} dark stacks for {len(bright)} bright ones, expected one for all or one "
                "for each"
            )
        of_bright = [
            Stack(recording=one, exposure_ms=exposure, photons=light)
            for one, exposure, light in zip(opened[0], exposures, lights, strict=True)
        ]
        of_dark = [
            Stack(recording=one, exposure_ms=exposure) for one, exposure in zip(opened[1], exposures, strict=False)
        ]
        name = str(opened[0][0].path)
    numbers, warnings = measure_emva(of_bright, of_dark, bits=bits, region=region, source=name, progress=progress)
    return emva_result(numbers, warnings, started=started)


def _of_chart(
    chart: Path,
    bright: Sequence[Recording],
    dark: Sequence[Recording],
    *,
    exposure_ms: Sequence[float],
    photons: Sequence[float],
    bits: int | None,
    region: tuple[int, int, int, int] | None,
    started: float,
    progress: Progress | None,
) -> Result[Emva]:
    """Return the noise of a camera by the film of a chart's wedge, and a film with the lens covered."""
    from todframes.camera.emva import Stack, measure_emva
    from todframes.camera.emva_result import emva_result
    from todframes.camera.filmed_page import view_of_camera_page

    given = {argument.region: region, argument.photons: photons or None}
    for name in (one for one, value in given.items() if value is not None):
        raise SettingsError(f"{name}: is given with {argument.chart}, whose patches are measured, expected none")
    for what, stacks in (("bright", bright), ("dark", dark)):
        if len(stacks) != 1:
            raise SettingsError(
                f"noise: found {len(stacks)} {what} recordings with {argument.chart}, expected one"
            )
    exposure = _of_each(exposure_ms, 1, argument.exposure_ms)[0]
    view = view_of_camera_page(bright[0], chart, needs_edges=True, progress=progress)
    patches, covered = view.stacks(dark[0])
    levelled = [Stack(recording=one, exposure_ms=exposure, is_levelled=True) for one in patches]
    numbers, warnings = measure_emva(
        levelled,
        [Stack(recording=covered, exposure_ms=exposure)],
        bits=bits,
        source=str(bright[0].path),
        background=levelled[0],
    )
    luminance = view.patches[0].level if view.is_luminance else None
    return emva_result(structs.replace(numbers, background_cd_m2=luminance), warnings, started=started)


def _opened(stack: PathLike | NDArray[Any], name: str, max_frame_mb: int) -> Recording:
    from todframes.recordings.opening import one_recording

    found = one_recording(stack, "noise", max_frame_mb=max_frame_mb)
    return replace(found, path=Path(name)) if isinstance(stack, np.ndarray) else found


def _described(path: Path, bits: int | None, max_frame_mb: int) -> tuple[list[Any], list[Any], int]:
    """Return the bright and dark stacks of a descriptor, and the bits of a pixel."""
    from todframes.camera.emva import Stack
    from todframes.camera.emva_descriptor import read_descriptor
    from todframes.recordings.opening import open_recordings

    described = read_descriptor(path)
    stacks: tuple[list[Any], list[Any]] = ([], [])
    for one in described.stacks:
        if not one.images:
            raise DataError(
                f"{path}: found no images for an exposure of {one.exposure_ms:g} ms, expected 2 or more"
            )
        (recording,) = open_recordings(one.images, max_frame_mb=max_frame_mb)
        if recording.shape != described.shape:
            rows, columns = recording.shape
            raise DataError(
                f"{recording.path}: has {columns} x {rows} pixels, expected {described.shape[1]} x "
                f"{described.shape[0]} by {path}"
            )
        stack = Stack(recording=recording, exposure_ms=one.exposure_ms, photons=one.photons)
        stacks[one.photons is None].append(stack)
    return *stacks, described.bits if bits is None else bits


def _of_each(values: Sequence[float], n: int, name: str) -> list[float | None]:
    """Return a value for each of n stacks, or None for each if there are none."""
    if not len(values):
        return [None] * n
    if len(values) != n:
        raise SettingsError(f"{name}: found {len(values)} numbers for {n} bright stacks, expected one for each")
    if not all(np.isfinite(one) and one > 0.0 for one in values):
        raise SettingsError(f"{name}: found {', '.join(f'{one:g}' for one in values)}, expected numbers > 0")
    return [float(one) for one in values]
