"""Reading of video: luma of grey formats as stored, R'G'B' from the matrix and range that the stream declares."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, FrameError, argument
from todframes.frames.files import N_START, check_decoded_size, format_of
from todframes.recordings.recording import (
    BYTES_PER_PIXEL,
    RecordedFrame,
    Recording,
    RecordingWarning,
    check_size,
    missing_extra,
)

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

MATRICES = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
"""Weights of R' and B' in luma by number of the matrix in H.273: BT.709, BT.601 (twice), 240M, BT.2020."""

REPACKED = {
    "yuyv422": "yuv422p",
    "uyvy422": "yuv422p",
    "nv12": "yuv420p",
    "nv16": "yuv422p",
    "p010le": "yuv420p10le",
    **dict.fromkeys(("rgb24", "bgr24", "rgba", "bgra", "argb", "abgr", "rgb0", "bgr0", "0rgb", "0bgr"), "gbrp"),
}
"""Packed pixel formats and the planar ones with the same samples."""

LATE_INTERVALS = 2.0
"""Number of the longest intervals between frames by which a video may end before its declared duration."""


class PixelFormat(NamedTuple):
    """Layout of a pixel format: its family, bits of a sample, and columns and rows for one chroma sample."""

    family: str
    bits: int
    dtype: np.dtype[Any]
    per_chroma: tuple[int, int] = (1, 1)


class Levels(NamedTuple):
    """Recorded values of black and white of luma, and the range of chroma."""

    zero: float
    full_scale: float
    chroma_range: float


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the path
    """Return whether a file is a video by its first bytes."""
    return (format_of(start) or "").endswith(" video")


def pixel_format(name: str) -> PixelFormat | None:
    """Return the layout of one of FFmpeg's pixel formats; None if it is not read."""
    name = REPACKED.get(name, name)
    match = re.fullmatch(r"(gray|yuvj?|yuva|gbrp|gbrap)(\d{3}p)?(\d+)?(le|be)?", name)
    if match is None:
        return None
    family, sampling, bits, order = match.groups()
    family = {"yuvj": "yuv", "yuva": "yuv", "gbrap": "gbrp"}.get(family, family)
    if (family == "yuv") != (sampling is not None):
        return None
    per_chroma = {"444p": (1, 1), "422p": (2, 1), "420p": (2, 2), "440p": (1, 2), "411p": (4, 1), "410p": (4, 4)}
    if sampling not in (None, *per_chroma):
        return None
    n_bits = int(bits or 8)
    dtype = np.dtype("u1") if n_bits == 8 else np.dtype(">u2" if order == "be" else "<u2")
    return PixelFormat(family, n_bits, dtype, per_chroma.get(sampling or "", (1, 1)))


def open_recording(path: Path, *, frames_per_second: float | None, max_frame_mb: int) -> Recording:
    """Open a video file; its first frame is decoded, to know the pixel format, range and matrix. Raises DataError
    if PyAV is not installed, and FrameError if the file has no video, FFmpeg has no decoder for it, its frames are
    too large, its first frame cannot be decoded, or its pixel format is none of ours.
    """
    with _opened(path, max_frame_mb) as (container, stream):
        first = next(_decoded(path, container, stream, max_frame_mb), None)
        if first is None:
            raise FrameError(path, "no frame can be decoded; is the file truncated?")
        layout = pixel_format(first.format.name)
        if layout is None:
            known = "grey, Y'CbCr or R'G'B' of 8 to 16 bits"
            raise FrameError(path, f"pixel format {first.format.name}, expected {known}; convert it without loss")
        check_size(path, (first.height, first.width), max_frame_mb)
        scale, matrix = _levels_of(first, layout), _matrix(path, first, layout)
        warnings = tuple(_warnings(stream, first, layout, matrix))
        # Of a stream without times, FFmpeg only guesses a rate.
        average = None if first.pts is None or not stream.average_rate else float(stream.average_rate)
        duration_s = _duration_s(container, stream)
        n_frames = stream.frames or (round(duration_s * average) if duration_s and average else None)
    shape, to_unit = (first.height, first.width), layout.family == "yuv"
    return Recording(
        path=path,
        shape=shape,
        is_colour=layout.family != "gray",
        n_frames=n_frames,
        frames_per_second=frames_per_second or average,
        full_scale=1.0 if to_unit else scale.full_scale,
        zero=0.0 if to_unit else scale.zero,
        ends=None if to_unit else (0.0, 2.0**layout.bits - 1.0),
        warnings=warnings,
        read=lambda: _frames(path, layout, shape, matrix, frames_per_second, max_frame_mb),
    )


def _warnings(
    stream: VideoStream, first: VideoFrame, layout: PixelFormat, matrix: int
) -> Iterator[RecordingWarning]:
    """Yield warnings about a video, given its first frame and the matrix by which it is read."""
    if layout.family == "yuv" and int(first.colorspace) != matrix:
        yield RecordingWarning(
            "matrix_assumed",
            f"the video declares no colour matrix: {'BT.709' if matrix == 1 else 'BT.601'} is taken, as usual for "
            "its size; grey is not affected",
        )
    if stream.codec_context.codec.lossy:
        yield RecordingWarning(
            "lossy_compression",
            f"the codec {stream.codec_context.name} can discard faint structure and noise: triangles near the "
            "threshold are not what the camera saw, and noise comes out too low; record without loss (FFV1)",
        )
    if _levels_of(first, layout).zero and layout.bits == 8:
        yield RecordingWarning(
            "limited_range",
            "8 bits in limited range have 220 of 256 levels: a step is 0.46 % of white, not 0.39 %; record full "
            "range, or 10 bits and more",
        )
    if first.interlaced_frame:
        yield RecordingWarning(
            "interlaced",
            "frames are interlaced: odd and even rows are of different times; record progressive frames",
        )
    if first.rotation:
        yield RecordingWarning(
            "rotation_not_applied",
            f"players turn this video by {first.rotation}°: frames are read as recorded, without it",
        )


@contextmanager
def _opened(path: Path, max_frame_mb: int) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file and its first video stream, to decode in as many threads as there are processors. FFmpeg decodes
    frames already when it opens a file, so it is given the largest number of pixels before.
    """
    try:
        import av
    except ImportError:
        raise missing_extra(path, "video", "av (PyAV)") from None
    with path.open("rb") as file:
        name = (format_of(file.read(N_START)) or "").removesuffix(" video")
    options = {"max_pixels": str(max_frame_mb * 2**20 // BYTES_PER_PIXEL)}
    try:
        # The prefix keeps FFmpeg from taking a file name for an address.
        with _logged() as complaints:
            container = av.open(f"file:{path}", format=name, options=options)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FrameError(path, f"cannot be opened as video: {_reason(error)}; is the file truncated?") from None
    with container:
        if not container.streams.video:
            raise FrameError(path, "has no video stream; is the file truncated?")
        films = [one for one in container.streams.video if "attached_pic" not in str(one.disposition)]
        if len(films) > 1:
            raise FrameError(
                path, f"has {len(films)} video streams, expected one; write each to a file of its own"
            )
        stream = (films or container.streams.video)[0]
        if stream.codec_context is None:
            raise FrameError(path, "FFmpeg has no decoder for its video; convert it without loss (FFV1)")
        _check_pixels(path, complaints, max_frame_mb)
        stream.codec_context.options = options
        # Threads for whole frames would log errors about later frames, and at any time: a file closed while
        # one of them waits for Python's lock would never be closed.
        stream.thread_type = "AUTO" if stream.codec_context.codec.lossy else "SLICE"
        yield container, stream


def _decoded(
    path: Path, container: InputContainer, stream: VideoStream, max_frame_mb: int
) -> Iterator[VideoFrame]:
    """Yield the frames of a stream; FrameError with the number of good ones if one cannot be decoded."""
    import av

    number = 0
    complaints: list[Any] = []
    # FFmpeg replaces a slice of FFV1 whose checksum is wrong by that of the frame before, and no more than logs
    # it. Codecs with loss log much that is harmless.
    is_lossy = stream.codec_context.codec.lossy
    try:
        with nullcontext(complaints) if is_lossy else _logged() as complaints:
            for frame in container.decode(stream):
                if frame.is_corrupt or complaints:
                    _check_pixels(path, complaints, max_frame_mb)
                    raise FrameError(path, f"frame {number} is damaged; {_good(number)}")
                yield frame
                number += 1
    except av.FFmpegError as error:
        _check_pixels(path, complaints, max_frame_mb)
        raise FrameError(path, f"frame {number} cannot be decoded ({_reason(error)}); {_good(number)}") from None


@contextmanager
def _logged() -> Iterator[list[Any]]:
    """Yield a list to which the errors that FFmpeg logs are added, also those that repeat the one before."""
    from av import logging

    before = logging.get_level(), logging.get_skip_repeated()
    logging.set_level(logging.ERROR)
    logging.set_skip_repeated(False)
    try:
        with logging.Capture(local=False) as complaints:
            yield complaints
    finally:
        logging.set_level(before[0])
        logging.set_skip_repeated(before[1])


def _check_pixels(path: Path, complaints: Sequence[Any], max_frame_mb: int) -> None:
    """Raise FrameError if FFmpeg has refused a frame with more pixels than it was allowed."""
    for _, _, message in complaints:
        if (found := re.search(r"size (\d+)x(\d+) exceeds", message)) is not None:
            check_decoded_size(path, BYTES_PER_PIXEL * int(found[1]) * int(found[2]), max_frame_mb)


def _frames(
    path: Path,
    layout: PixelFormat,
    shape: tuple[int, int],
    matrix: int,
    frames_per_second: float | None,
    max_frame_mb: int,
) -> Iterator[RecordedFrame]:
    with _opened(path, max_frame_mb) as (container, stream):
        last_s = None
        longest_s = 1.0 / float(stream.average_rate) if stream.average_rate else 0.0
        for number, frame in enumerate(_decoded(path, container, stream, max_frame_mb)):
            if (frame.height, frame.width) != shape or pixel_format(frame.format.name) != layout:
                found = f"{frame.width} x {frame.height} pixels, {frame.format.name}"
                raise FrameError(path, f"frame {number} has {found}: not as the first; {_good(number)}")
            time_s = frame.time
            if frames_per_second is not None:
                time_s = number / frames_per_second
            elif time_s is None:
                raise DataError(
                    f"{path}: frame {number} has no time, so the frame rate may vary; give "
                    f"{argument.frames_per_second} "
                    "if it does not"
                )
            elif last_s is not None and time_s <= last_s:
                raise DataError(
                    f"{path}: frame {number} has the time {time_s:g} s, expected one after {last_s:g} s; "
                    f"give {argument.frames_per_second} if the frame rate is constant"
                )
            if last_s is not None:
                longest_s = max(longest_s, time_s - last_s)
            last_s = time_s
            yield RecordedFrame(_values(frame, layout, matrix), time_s, f"{path.name}, frame {number}")
        duration_s = _duration_s(container, stream) if frames_per_second is None else None
        if duration_s and longest_s and last_s is not None and last_s + LATE_INTERVALS * longest_s < duration_s:
            raise FrameError(
                path,
                f"is truncated: it ends at {last_s:.6g} s, expected {duration_s:.6g} s; {_good(number + 1)}; "
                "copy the file again, or cut it to its good part",
            )


def _good(n_frames: int) -> str:
    return f"{n_frames} frames before are good"


def _duration_s(container: InputContainer, stream: VideoStream) -> float | None:
    """Return the end of the stream that the file declares, in seconds; None if it declares none."""
    if stream.duration is not None and stream.time_base is not None:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    duration = container.duration
    return None if duration is None or len(container.streams) > 1 else duration / 1e6


def _levels_of(frame: VideoFrame, layout: PixelFormat) -> Levels:
    """Return the levels of a frame (Rec. ITU-R BT.601 and BT.709). Without a declared range (0), it is limited (1)
    for Y'CbCr, else full.
    """
    declared, white = int(frame.color_range), 2.0**layout.bits - 1
    by_name = "yuvj" not in frame.format.name and layout.family == "yuv"
    if declared == 1 or (declared == 0 and by_name):
        step = 2.0 ** (layout.bits - 8)
        return Levels(16 * step, 235 * step, 224 * step)
    return Levels(0.0, white, white)


def _matrix(path: Path, frame: VideoFrame, layout: PixelFormat) -> int:
    """Return the number of the matrix that a frame declares; without one, of the usual one for its size."""
    matrix = int(frame.colorspace)
    if layout.family != "yuv" or matrix in MATRICES:
        return matrix
    if matrix != 2:  # not declared
        raise FrameError(path, f"colour matrix {matrix} (Rec. H.273), expected one of {sorted(MATRICES)}")
    return 1 if frame.height >= 720 else 6  # BT.709 from HD on, else BT.601


def _values(frame: VideoFrame, layout: PixelFormat, matrix: int) -> NDArray[Any]:
    """Return the values of a frame, of the shape and type of `RecordedFrame.values`."""
    if frame.format.name in REPACKED:
        frame = frame.reformat(format=REPACKED[frame.format.name])
    if layout.family == "gray":
        return _plane(frame, 0, layout.dtype)
    planes = [_plane(frame, number, layout.dtype) for number in range(3)]
    if layout.family == "gbrp":
        return np.stack([planes[2], planes[0], planes[1]], axis=-1)
    return _rgb(planes, layout, _levels_of(frame, layout), matrix)


def _rgb(planes: Sequence[NDArray[Any]], layout: PixelFormat, scale: Levels, matrix: int) -> NDArray[np.float32]:
    """Convert planes of Y'CbCr to R'G'B' with white 1 and black 0, unclipped; (rows, columns, 3). Chroma samples
    hold over the pixels that they cover: nothing is interpolated. Rec. ITU-R BT.709-6, item 3, solved for R'G'B'.
    """
    luma, cb, cr = (plane.astype(np.float32) for plane in planes)
    (red_weight, blue_weight), (across, down) = MATRICES[matrix], layout.per_chroma
    y = (luma - np.float32(scale.zero)) / np.float32(scale.full_scale - scale.zero)
    half = np.float32(2 ** (layout.bits - 1))
    b_y, r_y = (
        (chroma - half) * np.float32(2 * (1 - weight) / scale.chroma_range)
        for chroma, weight in ((cb, blue_weight), (cr, red_weight))
    )
    green_weight = 1 - red_weight - blue_weight
    g_y = (b_y * np.float32(blue_weight) + r_y * np.float32(red_weight)) / np.float32(-green_weight)
    rgb = np.empty((*luma.shape, 3), np.float32)
    for channel, difference in enumerate((r_y, g_y, b_y)):
        held = np.repeat(np.repeat(difference, down, 0), across, 1)[: luma.shape[0], : luma.shape[1]]
        np.add(y, held, out=rgb[..., channel])
    return rgb


def _plane(frame: VideoFrame, number: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Copy a plane of a frame, without the padding at the ends of rows."""
    plane = frame.planes[number]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
    used = rows[:, : plane.width * dtype.itemsize].copy()
    return used.view(dtype).astype(dtype.newbyteorder("="), copy=False)


def _reason(error: Exception) -> str:
    return " ".join(str(getattr(error, "strerror", None) or error).split())
