"""Descriptor files of EMVA 1288 measurements: which images belong to which exposure and light.

A line begins with a letter: `v` version, `n` bits width height, `b` exposure in ns and photons of bright images
that follow, `d` exposure in ns of dark images that follow, `i` the path of an image. Lines with # are comments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from todframes.base.errors import DataError
from todframes.base.reading import path_inside, read_file, resolved

MAX_DESCRIPTOR_MB = 4

KNOWN_VERSIONS = ("3.", "4.")
"""Beginnings of the versions whose descriptors have this form; the form has not changed from 3.0 to 4.0."""

NS_PER_MS = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class DescribedStack:
    """Images of one exposure: bright if there are photons, the mean number of a pixel, dark if it is None."""

    exposure_ms: float
    photons: float | None
    images: list[Path] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True)
class Descriptor:
    """The content of a descriptor file; `shape` is that of the images, rows and columns."""

    bits: int
    shape: tuple[int, int]
    stacks: tuple[DescribedStack, ...]


def read_descriptor(path: Path) -> Descriptor:
    """Return the content of a descriptor file.

    Raises
    ------
    DataError
        If the file cannot be read, has another version, or a line that is not as expected.
    """
    text = read_file(path, most_mb=MAX_DESCRIPTOR_MB).decode("utf-8", errors="replace")
    folder = resolved(path.parent)
    size: tuple[int, int, int] | None = None
    stacks: list[DescribedStack] = []
    for number, line in enumerate(text.splitlines(), 1):
        kind, *rest = line.split(maxsplit=1) or ["#"]
        values, where = rest[0].strip() if rest else "", f"{path}: line {number}"
        if kind.startswith("#"):
            continue
        if kind == "v":
            if not values.startswith(KNOWN_VERSIONS):
                raise DataError(f"{where}: found version {values[:20]!r}, expected one from 3 to 4")
        elif kind == "n":
            bits, width, height = (round(one) for one in _numbers(where, line, "n bits width height", 3))
            if not (1 <= bits <= 32 and width > 0 and height > 0):
                raise DataError(f"{where}: found {values!r}, expected 1 to 32 bits, width and height > 0")
            size = bits, height, width
        elif kind == "b":
            exposure, photons = _numbers(where, line, "b exposure_ns photons", 2)
            stacks.append(DescribedStack(exposure_ms=exposure / NS_PER_MS, photons=photons))
        elif kind == "d":
            (exposure,) = _numbers(where, line, "d exposure_ns", 1)
            stacks.append(DescribedStack(exposure_ms=exposure / NS_PER_MS, photons=None))
        elif kind == "i" and stacks:
            stacks[-1].images.append(Path(str(path_inside(folder, values.replace("\\", "/"), where))))
        else:
            expected = "a line with b or d before it" if kind == "i" else "v, n, b, d, i or #"
            raise DataError(f"{where}: found {line.strip()[:40]!r}, expected {expected}")
    if size is None:
        raise DataError(
            f"{path}: found no line 'n bits width height', expected one; is it a descriptor of EMVA 1288?"
        )
    return Descriptor(bits=size[0], shape=size[1:], stacks=tuple(stacks))


def _numbers(where: str, line: str, form: str, n: int) -> list[float]:
    parts = line.split()[1:]
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != n or not all(math.isfinite(one) and one >= 0.0 for one in values):
        raise DataError(f"{where}: found {line.strip()[:40]!r}, expected {form}, numbers of 0 or more")
    return values
