"""Video is read exactly: grey as stored, colour by the matrix and range of the ITU's recommendations."""

from __future__ import annotations

import re
import struct
from fractions import Fraction
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import todframes as tod
from todframes.recordings import video
from todframes.recordings.opening import open_recordings

av = pytest.importorskip("av")

RNG = np.random.default_rng(5)

ROWS, COLUMNS = 48, 70
"""A width that is no whole number of the blocks that FFmpeg aligns rows to."""


def encode(path, planes_of_frames, pixel_format, *, codec="ffv1", times_ms=None, shape=(ROWS, COLUMNS), **options):
    """Encode frames, each a list of the planes of a pixel format, with PyAV; times in ms or at 25 a second."""
    header = {name: options.pop(name) for name in ("color_range", "colorspace") if name in options}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options={name: str(one) for name, one in options.items()})
        stream.height, stream.width = shape
        stream.pix_fmt = pixel_format
        time_base = Fraction(1, 25 if times_ms is None else 1000)
        stream.codec_context.time_base = time_base
        for name, value in header.items():
            setattr(stream.codec_context, name, value)
        for number, planes in enumerate(planes_of_frames):
            frame = av.VideoFrame(shape[1], shape[0], pixel_format)
            for plane, values in zip(frame.planes, planes, strict=True):
                data = np.zeros((plane.height, plane.line_size), np.uint8)
                bytes_ = np.ascontiguousarray(values).view(np.uint8).reshape(plane.height, -1)
                data[:, : bytes_.shape[1]] = bytes_
                plane.update(data.tobytes())
            frame.pts = number if times_ms is None else times_ms[number]
            frame.time_base = time_base
            for name, value in header.items():
                setattr(frame, name, value)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def grey16(n_frames, shape=(ROWS, COLUMNS)):
    return RNG.integers(0, 65536, (n_frames, *shape)).astype(np.uint16)


@pytest.mark.parametrize(
    ("pixel_format", "bits"), [("gray", 8), ("gray10le", 10), ("gray12le", 12), ("gray16le", 16)]
)
@pytest.mark.parametrize("suffix", ["mkv", "avi"])
def test_grey_video_is_bit_exact(tmp_path, pixel_format, bits, suffix):
    values = RNG.integers(0, 2**bits, (5, ROWS, COLUMNS)).astype(np.uint8 if bits == 8 else np.uint16)
    encode(tmp_path / f"a.{suffix}", [[one] for one in values], pixel_format)
    (recording,) = open_recordings(tmp_path / f"a.{suffix}")
    assert (recording.zero, recording.full_scale, recording.is_colour) == (0, 2**bits - 1, False)
    assert (recording.n_frames, recording.frames_per_second, recording.warnings) == (5, 25, ())
    for _ in range(2):  # as often as asked for
        frames = list(recording.frames())
        np.testing.assert_array_equal([one.values for one in frames], values)
        assert frames[0].values.dtype == values.dtype
    assert [one.time_s for one in frames] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    assert frames[3].source == f"a.{suffix}, frame 3"


@pytest.mark.parametrize(
    ("pixel_format", "bits"), [("gbrp", 8), ("gbrp9le", 9), ("gbrp10le", 10), ("gbrp16le", 16)]
)
def test_rgb_video_is_bit_exact(tmp_path, pixel_format, bits):
    green, blue, red = RNG.integers(0, 2**bits, (3, ROWS, COLUMNS)).astype(np.uint8 if bits == 8 else np.uint16)
    encode(tmp_path / "a.nut", [[green, blue, red]], pixel_format, codec="rawvideo" if bits == 8 else "ffv1")
    (recording,) = open_recordings(tmp_path / "a.nut")
    assert (recording.zero, recording.full_scale, recording.is_colour) == (0, 2**bits - 1, True)
    (frame,) = recording.frames()  # one frame is a whole video
    np.testing.assert_array_equal(frame.values, np.stack([red, green, blue], -1))


@pytest.mark.parametrize("letters", ["rgb", "bgr", "bgra", "argb"])
def test_packed_rgb_is_bit_exact(tmp_path, letters):
    values = RNG.integers(0, 256, (ROWS, COLUMNS, len(letters))).astype(np.uint8)
    encode(tmp_path / "a.nut", [[values]], letters if "a" in letters else f"{letters}24", codec="rawvideo")
    ((read,),) = ([one.values for one in recording.frames()] for recording in open_recordings(tmp_path / "a.nut"))
    np.testing.assert_array_equal(read, np.stack([values[..., letters.index(one)] for one in "rgb"], -1))


def ycbcr_of(rgb, *, bits, limited, weights):
    """Encode R'G'B' in [0, 1] by BT.709-6, items 3.2 to 3.4 and BT.601-7, items 2.5.1 to 2.5.4, as they stand."""
    red, green, blue = rgb
    k_r, k_g, k_b = weights
    e_y = k_r * red + k_g * green + k_b * blue
    e_cb, e_cr = (blue - e_y) / (2 * (1 - k_b)), (red - e_y) / (2 * (1 - k_r))
    if limited:
        step = 2 ** (bits - 8)
        exact = (219 * e_y + 16) * step, (224 * e_cb + 128) * step, (224 * e_cr + 128) * step
    else:
        exact = (2**bits - 1) * e_y, (2**bits - 1) * e_cb + 2 ** (bits - 1), (2**bits - 1) * e_cr + 2 ** (bits - 1)
    return [np.clip(np.rint(one), 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16) for one in exact]


BT_709, BT_601 = (0.2126, 0.7152, 0.0722), (0.299, 0.587, 0.114)


@pytest.mark.parametrize(("number", "weights"), [(1, BT_709), (5, BT_601), (6, BT_601)])
@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize(("pixel_format", "bits"), [("yuv444p", 8), ("yuv444p10le", 10), ("yuv444p16le", 16)])
def test_colour_inverts_the_encoding_of_the_itu(tmp_path, number, weights, limited, pixel_format, bits):
    rgb = RNG.random((3, ROWS, COLUMNS))
    planes = ycbcr_of(rgb, bits=bits, limited=limited, weights=weights)
    encode(tmp_path / "a.mkv", [planes], pixel_format, color_range=1 if limited else 2, colorspace=number)
    (recording,) = open_recordings(tmp_path / "a.mkv")
    assert (recording.zero, recording.full_scale) == (0, 1)
    assert [one.code for one in recording.warnings] == (["limited_range"] if limited and bits == 8 else [])
    read = next(recording.frames()).values
    assert read.dtype == np.float32
    # Half a step of Y', and half a step of chroma, or in full range a whole one where pure blue is clipped, times
    # 2 (1 − k) < 1.9. A step is 1 / (219 · 2^(bits − 8)), or 1 / (2^bits − 1) in full range. 3e-7 for the floats.
    step = 1 / (219 * 2 ** (bits - 8)) if limited else 1 / (2**bits - 1)
    np.testing.assert_allclose(read, np.moveaxis(rgb, 0, -1), rtol=0, atol=(0.5 + 1.9) * step + 3e-7)


@pytest.mark.parametrize(
    ("pixel_format", "per_chroma"), [("yuv420p", (2, 2)), ("yuv422p", (2, 1)), ("yuv411p", (4, 1))]
)
def test_grey_in_a_colour_format_is_grey_and_chroma_holds(tmp_path, pixel_format, per_chroma):
    shape = ROWS - 1, COLUMNS
    luma = RNG.integers(16, 236, shape).astype(np.uint8)
    across, down = per_chroma
    chroma = RNG.integers(16, 241, (2, -(-shape[0] // down), -(-COLUMNS // across))).astype(np.uint8)
    neutral = np.full_like(chroma[0], 128)
    planes = [[luma, neutral, neutral], [luma, *chroma]]
    encode(tmp_path / "a.nut", planes, pixel_format, codec="rawvideo", shape=shape)
    (recording,) = open_recordings(tmp_path / "a.nut")
    assert [one.code for one in recording.warnings] == ["matrix_assumed", "limited_range"]
    grey, coloured = (one.values for one in recording.frames())
    np.testing.assert_allclose(grey, np.repeat((luma[..., np.newaxis] - 16.0) / 219, 3, 2), rtol=0, atol=1e-7)
    # BT.601: R' − Y' = 1.402 (Cr − 128) / 224 at each pixel of a chroma sample.
    held = chroma[1].repeat(down, 0).repeat(across, 1)[: ROWS - 1, :COLUMNS]
    difference = coloured[..., 0] - (luma - 16.0) / 219
    np.testing.assert_allclose(difference, 1.402 * (held - 128.0) / 224, rtol=0, atol=3e-7)
    found = tod.noise(tmp_path / "a.nut")
    assert found.noise.unit == "relative" and " of white in 2 frames." in " ".join(found.sentences())


@pytest.mark.parametrize(("packed", "planar"), video.REPACKED.items())
def test_packed_formats_have_the_samples_of_planar_ones(packed, planar):
    layout = video.pixel_format(planar)
    assert video.pixel_format(packed) == layout
    frame = av.VideoFrame(64, ROWS, planar)
    for plane in frame.planes:
        samples = RNG.integers(0, 2**layout.bits, plane.height * plane.line_size // layout.dtype.itemsize)
        plane.update(samples.astype(layout.dtype).tobytes())
    there = frame.reformat(format=packed)
    np.testing.assert_array_equal(video._values(there, layout, 1), video._values(frame, layout, 1))


def test_lossy_codecs_are_warned_about(tmp_path):
    encode(tmp_path / "a.mp4", black(3), "yuv420p", codec="libx264", crf=18)
    (recording,) = open_recordings(tmp_path / "a.mp4")
    assert [one.code for one in recording.warnings] == ["matrix_assumed", "lossy_compression", "limited_range"]
    assert len(list(recording.frames())) == 3


def test_times_are_those_of_the_file(tmp_path):
    times_ms = [0, 40, 200, 210, 900]
    encode(tmp_path / "a.mkv", [[one] for one in grey16(5)], "gray16le", times_ms=times_ms)
    (recording,) = open_recordings(tmp_path / "a.mkv")
    assert [one.time_s for one in recording.frames()] == pytest.approx(np.array(times_ms) / 1000)
    (recording,) = open_recordings(tmp_path / "a.mkv", frames_per_second=10)
    assert [one.time_s for one in recording.frames()] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    encode(tmp_path / "b.mkv", [[one] for one in grey16(3)], "gray16le", times_ms=[0, 40, 40])
    with pytest.raises(tod.DataError, match=r"frame 2 has the time 0\.04 s, expected one after 0\.04 s; give"):
        list(open_recordings(tmp_path / "b.mkv")[0].frames())


def black(n_frames):
    planes = [np.full((ROWS, COLUMNS), 16, np.uint8), *[np.full((ROWS // 2, COLUMNS // 2), 128, np.uint8)] * 2]
    return [planes] * n_frames


def test_frames_without_times_are_refused_unless_a_rate_is_given(tmp_path):
    encode(tmp_path / "a.h264", black(3), "yuv420p", codec="libx264")  # a stream without a container
    (recording,) = open_recordings(tmp_path / "a.h264")
    assert recording.frames_per_second is None
    with pytest.raises(tod.DataError, match="frame 0 has no time, so the frame rate may vary; give frames_per"):
        list(recording.frames())
    (recording,) = open_recordings(tmp_path / "a.h264", frames_per_second=50)
    assert [one.time_s for one in recording.frames()] == [0, 0.02, 0.04]
    small = [[plane[::2, : plane.shape[1] // 4 * 2] for plane in black(1)[0]]]
    other = encode(tmp_path / "b.h264", small, "yuv420p", codec="libx264", shape=(ROWS // 2, 34)).read_bytes()
    (tmp_path / "a.h264").write_bytes((tmp_path / "a.h264").read_bytes() + other)
    with pytest.raises(tod.FrameError, match="frame 3 has 34 x 24 pixels, yuv420p: not as the first; 3 frames"):
        list(recording.frames())


UPRIGHT, TURNED = (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0), (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0)


def test_interlaced_and_turned_videos_are_warned_about(tmp_path):
    encode(tmp_path / "a.mp4", black(3), "yuv420p", codec="libx264", **{"x264-params": "tff=1"})
    assert "interlaced" in [one.code for one in open_recordings(tmp_path / "a.mp4")[0].warnings]
    whole = encode(tmp_path / "b.mp4", black(3), "yuv420p", codec="libx264").read_bytes()
    header, at, track = whole.partition(b"tkhd")  # ISO 14496-12, 8.3.2: a matrix of nine fixed-point numbers
    upright, turned = (struct.pack(">9i", *one, 1 << 30) for one in (UPRIGHT, TURNED))
    assert upright in track[:100]
    (tmp_path / "b.mp4").write_bytes(header + at + track.replace(upright, turned, 1))
    codes = {one.code: one.message for one in open_recordings(tmp_path / "b.mp4")[0].warnings}
    assert "turn this video by 90°" in codes["rotation_not_applied"].replace("-90", "90")


def damaged(whole, data):
    middle = len(whole) // 2
    return whole[:middle] + data + whole[middle + len(data) :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda whole: whole[: len(whole) // 2], r"b\.mkv: is truncated: it ends at .* expected .* s; \d+ frames"),
        (lambda whole: damaged(whole, RNG.bytes(400)), r"frame \d+ (is damaged|cannot be decoded).*; \d+ fram"),
        (lambda whole: damaged(whole, bytes([whole[len(whole) // 2] ^ 1])), "frame 5 is damaged; 5 frames before"),
    ],
    ids=["truncated", "damaged", "one bit"],
)
def test_a_damaged_video_tells_how_many_frames_are_good(tmp_path, damage, message):
    values = grey16(12)
    whole = encode(tmp_path / "a.mkv", [[one] for one in values], "gray16le").read_bytes()
    assert open_recordings(tmp_path / "a.mkv")[0].n_frames == 12
    (tmp_path / "b.mkv").write_bytes(damage(whole))
    logged = (av.logging.get_level(), av.logging.get_skip_repeated())
    (recording,) = open_recordings(tmp_path / "b.mkv")
    frames, good = recording.frames(), []
    with pytest.raises(tod.FrameError, match=message) as caught:
        good.extend(one.values for one in frames)
    assert int(re.search(r"(\d+) frames", str(caught.value))[1]) == len(good) > 3
    np.testing.assert_array_equal(good, values[: len(good)])
    assert (av.logging.get_level(), av.logging.get_skip_repeated()) == logged


def half_of_mp4(path):
    whole = encode(path, black(3), "yuv420p", codec="libx264").read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def without_frames(path):
    whole = encode(path, [[one] for one in grey16(2)], "gray16le").read_bytes()
    path.write_bytes(whole[: whole.index(b"\x1fC\xb6u") + 12])  # the start of a cluster of frames


def unknown_codec(path):
    codec = b"V_FFV1" if path.suffix == ".mkv" else b"FFV1"
    whole = encode(path, [[one] for one in grey16(2)], "gray16le").read_bytes()
    assert codec in whole
    path.write_bytes(whole.replace(codec, codec[:-4] + b"ZZZZ"))


def one_bit(path):
    encode(path, [[np.zeros(ROWS * 9, np.uint8)]], "monob", codec="rawvideo")


PLAYLIST = "#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/a.ts\n"


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("b.mp4", half_of_mp4, r"b\.mp4: has no video stream; is the file truncated\?"),
        ("b.mkv", without_frames, r"no frame can be decoded; is the file truncated\?"),
        ("a.mkv", unknown_codec, "FFmpeg has no decoder for its video; convert it without loss"),
        ("a.avi", unknown_codec, "FFmpeg has no decoder for its video; convert it without loss"),
        ("b.avi", one_bit, r"pixel format \w+, expected grey, Y'CbCr or R'G'B' of 8 to 16 bits"),
        ("a.m3u8", lambda path: path.write_text(PLAYLIST), "expected an image, video"),
    ],
)
def test_a_video_that_cannot_be_read_is_refused(tmp_path, name, make, message):
    make(tmp_path / name)
    with pytest.raises(tod.FrameError, match=message):
        open_recordings(tmp_path / name)


def test_names_of_pixel_formats():
    for name in ("pal8", "yuv420", "gray420p", "grayf32le", "bayer_rggb8", "xyz12le", "yuv443p", "gbrpf32le"):
        assert video.pixel_format(name) is None
    for name, expected in {
        "gray": ("gray", 8, "u1", (1, 1)),
        "gray10be": ("gray", 10, ">u2", (1, 1)),
        "yuvj420p": ("yuv", 8, "u1", (2, 2)),
        "yuva422p10le": ("yuv", 10, "<u2", (2, 1)),
        "yuv440p12be": ("yuv", 12, ">u2", (1, 2)),
        "yuv411p": ("yuv", 8, "u1", (4, 1)),
        "yuv410p": ("yuv", 8, "u1", (4, 4)),
        "gbrap16le": ("gbrp", 16, "<u2", (1, 1)),
    }.items():
        assert video.pixel_format(name) == expected


def test_a_matrix_that_is_not_declared_is_that_of_hd_from_720_rows_on():
    layout = video.pixel_format("yuv420p")
    for height, number in ((719, 6), (720, 1)):
        assert video._matrix(Path("a.mkv"), Mock(colorspace=2, height=height), layout) == number
    with pytest.raises(tod.FrameError, match=r"colour matrix 8 \(Rec\. H\.273\), expected one of \[1, 5, 6, 7, 9"):
        video._matrix(Path("a.mkv"), Mock(colorspace=8, height=720), layout)


def test_a_folder_of_videos_is_several_recordings(tmp_path):
    for name in ("clip10", "clip9"):
        encode(tmp_path / f"{name}.mkv", [[one] for one in grey16(2)], "gray16le")
    assert [one.path.name for one in open_recordings(tmp_path)] == ["clip9.mkv", "clip10.mkv"]


def test_a_file_of_two_videos_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = 16, 16, "gray"
        for stream in streams:
            container.mux([*stream.encode(av.VideoFrame(16, 16, "gray")), *stream.encode()])
    with pytest.raises(tod.FrameError, match="has 2 video streams, expected one; write each"):
        open_recordings(tmp_path / "a.mkv")


@pytest.mark.parametrize(("mean", "floor", "codes"), [(16, 0, []), (235, 0, []), (16, 16, ["saturated"])])
def test_limited_range_has_room_beyond_black_and_white(tmp_path, mean, floor, codes):
    values = np.maximum(np.rint(RNG.normal(mean, 3.0, (9, ROWS, COLUMNS))), floor).astype(np.uint8)
    chroma = [np.full((ROWS // 2, COLUMNS // 2), 128, np.uint8)] * 2
    for name, pixel_format, others in (("a.mkv", "gray", []), ("b.mkv", "yuv420p", chroma)):
        encode(tmp_path / name, [[frame, *others] for frame in values], pixel_format, color_range=1)
        found = [warning.code for warning in tod.noise(tmp_path / name).warnings]
        assert [code for code in found if code not in ("limited_range", "matrix_assumed")] == codes
