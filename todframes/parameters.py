"""Kinds of values that calls take: their choices and ranges, and how a command line writes them.

The module is light, so that the commands know their options before NumPy is loaded.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

T = TypeVar("T")


class CliFormat(NamedTuple):
    """Form of a value on a command line.

    `metavar` stands for the value in `--help`. A number is >= `ge`, > `gt`, <= `le` and < `lt`. The values of a
    sequence stand in one text with `separator` between them; without one, the option is repeated.
    """

    metavar: str = ""
    ge: int | None = None
    gt: int | None = None
    le: int | None = None
    lt: int | None = None
    separator: str = ""


PathLike = str | os.PathLike[str]

Progress = Callable[[int, int | None], None]
"""Called with the number of parts of a step that are done, and of all; None if that is not known."""

NamedFile = Annotated[Path | str, CliFormat("NAME|FILE")]
CameraFile = Annotated[Path | str, CliFormat("RESULT")]
ChartFile = Annotated[Path | str, CliFormat("CHART.toml")]
DescriptorFile = Annotated[Path | str, CliFormat("DESCRIPTOR")]
DesignFile = Annotated[Path | str, CliFormat("DESIGNS.csv")]
SensorFile = Annotated[Path | str, CliFormat("SENSOR.toml|PRESET")]
PybsmFile = Annotated[Path | str, CliFormat("PYBSM.json")]
NamedTable = Annotated[PathLike, CliFormat("FILE")]
ListFolder = Annotated[Path | str, CliFormat("LIST")]
AnswersFolder = Annotated[Path | str, CliFormat("ANSWERS")]
ChartFolder = Annotated[Path | str, CliFormat("CHART")]
ConditionPath = Annotated[Path | str, CliFormat("DATASET|RESULT")]
DatasetFolder = Annotated[Path | str, CliFormat("DATASET")]
SampleFolder = Annotated[Path | str, CliFormat("OUT")]
Images = Annotated[Sequence[PathLike], CliFormat("FOLDER|FILE")]

Numbers = Annotated[Sequence[float], CliFormat("N[,N…]", separator=",")]
Box = Annotated[tuple[int, int, int, int], CliFormat("X,Y,W,H", separator=",")]
Plane = Annotated[tuple[int, int], CliFormat("ROW,COLUMN", separator=",")]
Limits = Annotated[tuple[float, float], CliFormat("LOW:HIGH", separator=":")]
Columns = Annotated[Sequence[str], CliFormat("COLUMN[,…]", separator=",")]

Count = Annotated[int, CliFormat("N", ge=1)]
FrameCount = Annotated[int, CliFormat("N", ge=0)]
WholeNumber = Annotated[int, CliFormat("N")]
Port = Annotated[int, CliFormat("PORT", ge=0, le=65535)]
Seed = Annotated[int, CliFormat("SEED", ge=0)]
FrameLimit = Annotated[int, CliFormat("MB", ge=1, le=2**20)]
Turns = Literal[8, 4, 1]

Probability = Annotated[float, CliFormat("P")]
Tolerance = Annotated[float, CliFormat("T")]
SignalToNoise = Annotated[float, CliFormat("R")]
Seconds = Annotated[float, CliFormat("S")]
Distances = Annotated[Sequence[float], CliFormat("M[,M…]", separator=",")]
Metres = Annotated[float, CliFormat("M")]
Millimetres = Annotated[float, CliFormat("MM")]
CandelaPerM2 = Annotated[float, CliFormat("L")]
Reflectance = Annotated[float, CliFormat("R")]
Exponent = Annotated[float, CliFormat("G")]
Angle = Annotated[float, CliFormat("A")]
Kelvin = Annotated[float, CliFormat("K")]
Magnification = Annotated[float, CliFormat(gt=0)]
WeberContrast = Annotated[float, CliFormat("C")]
MilliKelvin = Annotated[float, CliFormat("MK")]
Rate = Annotated[float, CliFormat("N")]
Share = Annotated[float, CliFormat("SHARE")]
Speed = Annotated[float, CliFormat("MRAD_PER_S")]
BlurPx = Annotated[float, CliFormat("SD", ge=0, le=1000)]
Dimming = Annotated[float, CliFormat("F")]
CyclesPerSize = Annotated[float, CliFormat("C")]
TargetFactor = Annotated[float, CliFormat("K")]
TargetFactors = Annotated[Sequence[float], CliFormat("K[,K…]", separator=",")]

Algorithms = Annotated[Sequence[str], CliFormat("SPEC")]
Cluster = Annotated[str, CliFormat("ADDRESS")]
DisplayName = Annotated[Path | str, CliFormat("NAME|FILE")]
ColumnName = Annotated[str, CliFormat("COLUMN")]
LimitName = Annotated[str, CliFormat("light|aperture|netd|KEY")]
Cycles = Annotated[str, CliFormat("NAME|N[,N…]")]
GroupValues = Annotated[Mapping[str, str], CliFormat("COLUMN=VALUE")]
ObserverName = Annotated[str, CliFormat("NAME|MODULE:CLASS")]
ObserverNames = Annotated[Sequence[str], CliFormat("NAME|MODULE:CLASS[,…]", separator=",")]
Duration = Annotated[str, CliFormat("TIME")]
PatchLevels = Annotated[Mapping[Box, float], CliFormat("X,Y,W,H=LEVEL")]
ResultFile = Annotated[Path | str, CliFormat("RESULT.json")]
PersonId = Annotated[str, CliFormat("ID")]
Pattern = Annotated[str, CliFormat("PATTERN")]
Ranges = Annotated[Mapping[str, str], CliFormat("KEY=FROM:TO:N[:log]")]
Subjects = Annotated[Sequence[str], CliFormat("ID")]

Against = Literal["square", "background"]
Bits = Literal[8, 10]
ChartKind = Literal["screen", "print", "thermal"]
CurveName = Literal["observer", "weibull"]
Decisions = Literal["expected", "sampled"]
Direction = Literal["upright", "lying"]
FrameFormat = Literal["exr", "png"]
Free = Literal["lapse", "blur"]
Gaze = Literal["tracked", "fixed"]
"""Direction of the observer's gaze: it follows a triangle that moves, or stays at its mean place in the trial."""

Gazes = Annotated[Sequence[Gaze], CliFormat("tracked|fixed[,…]", separator=",")]
Locate = Literal["group", "each"]
MonitorEotf = Literal["linear", "srgb", "bt1886", "gamma"]
OnError = Literal["stop", "skip"]
MarkerPlaces = Literal["borders", "corners"]
Method = Literal["constant", "quest"]
PlanName = Literal["needed", "full"]
Polarity = Literal[1, -1]
Preset = Literal[
    "emva_basler", "boson", "cooled_mwir", "low_light", "star_like", "staring_camera", "uncooled_lwir", "visible"
]

MAX_FRAME_MB = 256
"""Default of the largest frame that is decoded: all channels, in their own pixel types. One MB is 2**20 bytes."""


def counted(parts: Iterable[T], total: int | None, progress: Progress | None) -> Iterator[T]:
    """Yield the parts of some work; report after each how many are done of how many, None if that is not known."""
    for done, part in enumerate(parts, 1):
        yield part
        if progress is not None:
            progress(done, total)
