"""Kinds of values that calls take: their choices and ranges, and how a command line writes them.

The module is light, so that the commands know their options before NumPy is loaded.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

T = TypeVar("T")


class Form(NamedTuple):
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

NamedFile = Annotated[Path | str, Form("NAME|FILE")]
CameraFile = Annotated[Path | str, Form("CAMERA.xml")]
ChartFile = Annotated[Path | str, Form("CHART.toml")]
DescriptorFile = Annotated[Path | str, Form("DESCRIPTOR")]
DesignFile = Annotated[Path | str, Form("DESIGNS.csv")]
SensorFile = Annotated[Path | str, Form("SENSOR.toml")]
NamedTable = Annotated[PathLike, Form("FILE")]
AnswersFolder = Annotated[Path | str, Form("ANSWERS")]
ChartFolder = Annotated[Path | str, Form("CHART")]
DatasetFolder = Annotated[Path | str, Form("DATASET")]
SampleFolder = Annotated[Path | str, Form("OUT")]
Images = Annotated[Sequence[PathLike], Form("FOLDER|FILE")]

Numbers = Annotated[Sequence[float], Form("N[,N…]", separator=",")]
Box = Annotated[tuple[int, int, int, int], Form("X,Y,W,H", separator=",")]
Limits = Annotated[tuple[float, float], Form("LOW:HIGH", separator=":")]
Columns = Annotated[Sequence[str], Form("COLUMN[,…]", separator=",")]

Count = Annotated[int, Form("N", ge=1)]
FrameCount = Annotated[int, Form("N", ge=0)]
WholeNumber = Annotated[int, Form("N")]
Port = Annotated[int, Form("PORT", ge=0, le=65535)]
Seed = Annotated[int, Form("SEED", ge=0)]
FrameLimit = Annotated[int, Form("MB", ge=1, le=2**20)]
Turns = Literal[8, 4, 1]

Probability = Annotated[float, Form("P")]
Tolerance = Annotated[float, Form("T")]
SignalToNoise = Annotated[float, Form("R")]
Seconds = Annotated[float, Form("S")]
Metres = Annotated[float, Form("M")]
Millimetres = Annotated[float, Form("MM")]
CandelaPerM2 = Annotated[float, Form("L")]
Reflectance = Annotated[float, Form("R")]
Exponent = Annotated[float, Form("G")]
Angle = Annotated[float, Form("A")]
Kelvin = Annotated[float, Form("K")]
Magnification = Annotated[float, Form(gt=0)]
WeberContrast = Annotated[float, Form("C")]
MilliKelvin = Annotated[float, Form("MK")]
Rate = Annotated[float, Form("N")]
Share = Annotated[float, Form("SHARE")]
Speed = Annotated[float, Form("MRAD_PER_S")]
BlurPx = Annotated[float, Form("SD", ge=0, le=1000)]
Dimming = Annotated[float, Form("F")]
CyclesPerSize = Annotated[float, Form("C")]
TargetFactor = Annotated[float, Form("K")]
TargetFactors = Annotated[Sequence[float], Form("K[,K…]", separator=",")]

Algorithms = Annotated[Sequence[str], Form("SPEC")]
Cluster = Annotated[str, Form("ADDRESS|local:N")]
DisplayName = Annotated[str, Form("NAME|FILE")]
ColumnName = Annotated[str, Form("COLUMN")]
LimitName = Annotated[str, Form("light|aperture|netd|range|KEY")]
Cycles = Annotated[str, Form("NAME|N[,N…]")]
GroupValues = Annotated[Mapping[str, str], Form("COLUMN=VALUE")]
ObserverName = Annotated[str, Form("NAME|MODULE:CLASS")]
ObserverNames = Annotated[Sequence[str], Form("NAME|MODULE:CLASS[,…]", separator=",")]
Duration = Annotated[str, Form("TIME")]
PatchLevels = Annotated[Mapping[Box, float], Form("X,Y,W,H=LEVEL")]
ResultFile = Annotated[Path | str, Form("RESULT.json")]
PersonId = Annotated[str, Form("ID")]
Pattern = Annotated[str, Form("PATTERN")]
Ranges = Annotated[Mapping[str, str], Form("KEY=FROM:TO:N[:log]")]
Subjects = Annotated[Sequence[str], Form("ID")]

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

Gazes = Annotated[Sequence[Gaze], Form("tracked|fixed[,…]", separator=",")]
Locate = Literal["group", "each"]
MonitorEotf = Literal["linear", "srgb", "bt1886", "gamma"]
OnError = Literal["stop", "skip"]
MarkerPlaces = Literal["borders", "corners"]
Method = Literal["constant", "quest"]
PlanName = Literal["needed", "full"]
Polarity = Literal[1, -1]
Preset = Literal["emva_basler", "boson"]

MAX_FRAME_MB = 256
"""Default of the largest frame that is decoded: all channels, in their own pixel types. One MB is 2**20 bytes."""


def counted(parts: Iterable[T], total: int | None, progress: Progress | None) -> Iterator[T]:
    """Yield the parts of some work; report after each how many are done of how many, None if that is not known."""
    for done, part in enumerate(parts, 1):
        yield part
        if progress is not None:
            progress(done, total)
