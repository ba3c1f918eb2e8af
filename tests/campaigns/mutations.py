"""Mutations of frames and of settings files, each drawn from a random generator: bytes in, bytes out."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Sequence

import numpy as np

Rng = np.random.Generator
Mutation = Callable[[bytes, Rng, Sequence[bytes]], bytes]
"""A function of the content of a file, the random numbers and the content of other files."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

EXTREME_INTEGERS = (-(2**31), -1, 0, 1, 2, 3, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**31 - 1)


# Any file ------------------------------------------------------------------------------------------------------


def flip_bits(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Flip 1 to 16 bits."""
    values = np.frombuffer(content, np.uint8).copy()
    for place in rng.integers(len(values) * 8, size=rng.integers(1, 17)):
        values[place // 8] ^= 1 << (place % 8)
    return values.tobytes()


def truncate(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Cut the end off."""
    return content[: rng.integers(len(content))]


def fill_range(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Set a range of bytes to 0, 255 or another value; often 512 bytes long, a sector of a disk."""
    begin = int(rng.integers(len(content)))
    length = 512 if rng.random() < 0.5 else int(rng.integers(1, len(content) - begin + 1))
    value = (0, 0, 255, int(rng.integers(256)))[rng.integers(4)]
    found = content[begin : begin + length]
    return content[:begin] + bytes([value]) * len(found) + content[begin + length :]


def insert_bytes(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Insert random bytes, or remove some."""
    begin = int(rng.integers(len(content)))
    if rng.random() < 0.5:
        return content[:begin] + rng.bytes(int(rng.integers(1, 100))) + content[begin:]
    return content[:begin] + content[begin + int(rng.integers(1, 100)) :]


def splice_files(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    """Take the first part of one file and the second part of another."""
    other = others[rng.integers(len(others))]
    return content[: rng.integers(len(content))] + other[rng.integers(len(other)) :]


# Frames --------------------------------------------------------------------------------------------------------


def rename_format(_: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    """Put another file under the name: of another format, another frame, nothing or random bytes."""
    kinds = [b"", rng.bytes(int(rng.integers(1, 5000))), b"version https://git-lfs.github.com/spec/v1\n", *others]
    return kinds[rng.integers(len(kinds))]


def edit_header(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    """Edit values of the header; checksums are made right again."""
    if content.startswith(PNG_SIGNATURE):
        return _edit_png_header(content, rng)
    return _edit_exr_header(content, rng, others)


def huge_sides(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Claim a large frame; checksums are made right again."""
    sides = [int(2 ** rng.uniform(8, 31)) for _ in range(2)]
    if content.startswith(PNG_SIGNATURE):
        chunks = png_chunks(content)
        keep = rng.random() < 0.3
        width, height = struct.unpack(">II", chunks[0][1][:8])
        sides = [width, sides[1]] if keep else sides
        del height
        chunks[0] = b"IHDR", struct.pack(">II", *sides) + chunks[0][1][8:]
        return png_of(chunks)
    names = [(b"dataWindow\0box2i\0",), (b"displayWindow\0box2i\0",)]
    both = (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0")
    for name in (*names, both)[rng.integers(3)]:
        place = content.find(name)
        if place >= 0:
            place += len(name) + 4
            left, top = (0, 0) if rng.random() < 0.7 else (int(v) for v in -rng.integers(0, 2**30, 2))
            box = struct.pack("<4i", left, top, min(left + sides[0], 2**31 - 1), min(top + sides[1], 2**31 - 1))
            content = content[:place] + box + content[place + 16 :]
    return content


def splice_chunks(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    """Move, repeat, drop or replace whole chunks of a PNG, or chunks and offsets of an EXR."""
    if not content.startswith(PNG_SIGNATURE):
        return _splice_exr(content, rng, others)
    chunks = png_chunks(content)
    of_others = [one for other in others if other.startswith(PNG_SIGNATURE) for one in png_chunks(other)]
    place = int(rng.integers(len(chunks)))
    match rng.integers(5):
        case 0:
            del chunks[place]
        case 1:
            chunks.insert(int(rng.integers(len(chunks) + 1)), chunks[place])
        case 2:
            chunks[place] = of_others[rng.integers(len(of_others))]
        case 3:
            chunks.insert(place, of_others[rng.integers(len(of_others))])
        case _:
            kind, data = chunks[place]
            chunks[place] = kind, flip_bits(data, rng, ()) if data else rng.bytes(4)
    return png_of(chunks)


def png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    """Return the chunks of a PNG as (kind, data)."""
    chunks = []
    place = len(PNG_SIGNATURE)
    while place < len(content):
        (length,) = struct.unpack(">I", content[place : place + 4])
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + length]))
        place += length + 12
    return chunks


def png_of(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    """Return a PNG of chunks, with right checksums."""
    return PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def _edit_png_header(content: bytes, rng: Rng) -> bytes:
    chunks = png_chunks(content)
    header = list(struct.unpack(">IIBBBBB", chunks[0][1]))
    place = int(rng.integers(len(header)))
    most = 2**32 if place < 2 else 256
    found = (*(value % most for value in EXTREME_INTEGERS), 4, 6, 8, 16, int(rng.integers(most)))
    header[place] = found[rng.integers(len(found))]
    chunks[0] = b"IHDR", struct.pack(">IIBBBBB", *header)
    return png_of(chunks)


def _exr_attributes(content: bytes) -> tuple[list[tuple[int, int]], int]:
    """Return where the values of the attributes of an EXR begin and end, and where the offsets begin."""
    places, place = [], 8
    while content[place]:
        for _ in range(2):
            place = content.index(0, place) + 1
        (length,) = struct.unpack("<i", content[place : place + 4])
        places.append((place + 4, place + 4 + length))
        place += 4 + length
    return places, place + 1


def _edit_exr_header(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    places, end = _exr_attributes(content)
    match rng.integers(4):
        case 0:  # any byte of the header
            place = int(rng.integers(4, end))
            return content[:place] + rng.bytes(1) + content[place + 1 :]
        case 1:  # the version and its flags: tiled, deep, many parts, long names
            return content[:4] + struct.pack("<I", int(rng.integers(2**13))) + content[8:]
        case 2:  # a length
            begin, _ = places[rng.integers(len(places))]
            value = EXTREME_INTEGERS[rng.integers(len(EXTREME_INTEGERS))]
            return content[: begin - 4] + struct.pack("<i", value) + content[begin:]
    begin, stop = places[rng.integers(len(places))]
    value = bytearray(content[begin:stop])
    if len(value) >= 4:
        place = int(rng.integers(len(value) // 4)) * 4
        extreme = EXTREME_INTEGERS[rng.integers(len(EXTREME_INTEGERS))]
        value[place : place + 4] = struct.pack("<i", extreme)
    else:
        value[:] = rng.bytes(len(value))
    del others
    return content[:begin] + bytes(value) + content[stop:]


def _splice_exr(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    _, end = _exr_attributes(content)
    if rng.random() < 0.5:  # the pixels of another file under this header
        exr = [other for other in others if other[:4] == content[:4]]
        other = exr[rng.integers(len(exr))]
        return content[:end] + other[_exr_attributes(other)[1] :]
    (first,) = struct.unpack("<q", content[end : end + 8])
    n = min(max((first - end) // 8, 1), 4096)
    offsets = list(struct.unpack(f"<{n}q", content[end : end + 8 * n]))
    place = int(rng.integers(n))
    offsets[place] = (0, -1, 2**62, len(content), offsets[rng.integers(n)], first + int(rng.integers(100)))[
        rng.integers(6)
    ]
    return content[:end] + struct.pack(f"<{n}q", *offsets) + content[end + 8 * n :]


FRAMES: dict[str, Mutation] = {
    "bit flips": flip_bits,
    "truncation": truncate,
    "range of zeros or ones": fill_range,
    "bytes put in or taken out": insert_bytes,
    "header": edit_header,
    "huge sides": huge_sides,
    "chunks spliced": splice_chunks,
    "two files spliced": splice_files,
    "another format under the name": rename_format,
}

# Text ----------------------------------------------------------------------------------------------------------

EXTREME_VALUES = (
    *("nan", "inf", "-inf", "-1", "0", "-0.0", "1e308", "1e-308", "5e-324", "1e999", "1" + "0" * 30, "9" * 5000),
    *("true", '""', '"x"', "[]", "[1, 2]", "{}", "1979-05-27", "0x7fffffff", "1_000", "٣", "½", "1,5", "=1+1"),
    *("''", '"\\u0000"', '"\\u001b[31m"', "#", "100000", "1000000000", "0.001", "up", "-", "../../etc/passwd"),
)


def change_value(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Replace a number or word by an extreme or strange one."""
    words = list(re.finditer(rb"[\w.+-]+|\"[^\"\n]*\"", content))
    word = words[rng.integers(len(words))]
    value = EXTREME_VALUES[rng.integers(len(EXTREME_VALUES))].encode()
    return content[: word.start()] + value + content[word.end() :]


def scale_number(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Multiply a number by a power of ten between -12 and 12, or by -1."""
    numbers = list(re.finditer(rb"(?<![\w.])-?\d+\.?\d*(?:e-?\d+)?(?![\w.])", content))
    if not numbers:
        return change_value(content, rng, ())
    number = numbers[rng.integers(len(numbers))]
    factor = -1.0 if rng.random() < 0.1 else 10.0 ** int(rng.integers(-12, 13))
    value = f"{float(number[0]) * factor:g}".encode()
    return content[: number.start()] + value + content[number.end() :]


def change_lines(content: bytes, rng: Rng, others: Sequence[bytes]) -> bytes:
    """Drop, repeat, swap or take over lines."""
    lines = content.splitlines(keepends=True)
    place, other = (int(value) for value in rng.integers(len(lines), size=2))
    match rng.integers(4):
        case 0:
            del lines[place]
        case 1:
            lines[place:place] = [lines[other]] * int(rng.integers(1, 4))
        case 2:
            lines[place], lines[other] = lines[other], lines[place]
        case _:
            of_other = others[rng.integers(len(others))].splitlines(keepends=True)
            lines.insert(place, of_other[rng.integers(len(of_other))])
    return b"".join(lines)


def misspell(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Change a letter, or the case of a word."""
    words = list(re.finditer(rb"[A-Za-z_]{3,}", content))
    word = words[rng.integers(len(words))]
    letters = bytearray(word[0].swapcase() if rng.random() < 0.2 else word[0])
    letters[rng.integers(len(letters))] = rng.choice(list(b"abcxyz_"))
    return content[: word.start()] + bytes(letters) + content[word.end() :]


def strange_bytes(content: bytes, rng: Rng, _: Sequence[bytes]) -> bytes:
    """Put in bytes that are no UTF-8, control characters, a byte order mark, deep nesting, or another encoding."""
    place = int(rng.integers(len(content) + 1))
    found = (
        b"\xff",
        b"\0",
        b"\x1b[31m",
        b"\r",
        b"\xef\xbb\xbf",
        "\u202e".encode(),
        b"[" * 100,
        b'"',
        b"\n\n",
        b"''",
    )
    match rng.integers(4):
        case 0:
            return content.decode().encode("utf-16")
        case 1:
            return b"\xef\xbb\xbf" + content
    return content[:place] + found[rng.integers(len(found))] + content[place:]


TEXTS: dict[str, Mutation] = {
    "value": change_value,
    "number scaled": scale_number,
    "lines": change_lines,
    "spelling": misspell,
    "strange bytes": strange_bytes,
    "bit flips": flip_bits,
    "truncation": truncate,
    "two files spliced": splice_files,
    "another file under the name": rename_format,
}
