"""A result as read back from its JSON: what a report needs of it, every key checked.

Keys that are not named here are left alone, so results of later versions can be read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from todframes.config import read_file
from todframes.errors import DataError

T = TypeVar("T")


SCHEMA = 1


MAX_MB = 64


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


CONTENT = {
    "score": "fits",
    "naked-eye": "fits",
    "fit": "fits",
    "curve": "fits",
    "compare": "algorithms",
    "accuracy": "scenes",
}
"""Commands with a report, and the key that such a result cannot do without."""


Positive = Annotated[float, Meta(gt=0)]


Proportion = Annotated[float, Meta(ge=0, le=1)]


Interval = tuple[Positive | None, Positive | None]


Group = dict[str, float | str]


Record = dict[str, Any]


Names = list[Any] | str


class FitPoint(Struct, frozen=True):
    """The proportion correct at one level; `n_trials` is 0 where it was computed."""

    level: Positive
    n_trials: int
    p_correct: Proportion


class Fit(Struct, frozen=True):
    """A threshold and the curve it was read from, one object of `fits`."""

    group: Group
    level: str
    status: str
    p_correct: Proportion
    threshold: Positive | None = None
    threshold_ci95: Interval | None = None
    threshold_numerical_error: float | None = None
    threshold_displacement_error: float | None = None
    points_threshold: Positive | None = None
    alpha: Positive | None = None
    beta: Positive | None = None
    gamma: Proportion | None = None
    delta: Proportion | None = None
    n_trials: int = 0
    points: list[FitPoint] = []
    p_correct_error_bound: float | None = None
    p_correct_left_out_bound: float | None = None
    delta_t_mk: float | None = None
    run_time_s: float | None = None
    plan: list[Record] = []


class Ratio(Struct, frozen=True):
    """An algorithm's threshold over that of the reference, in one group; without one, in all of them together."""

    verdict: str
    group: Group = {}
    ratio: Positive | None = None
    ratio_ci95: Interval | None = None
    p_value: float | None = None
    p_value_holm: float | None = None


class Algorithm(Struct, frozen=True):
    """An algorithm of `compare`; the reference has no ratios."""

    name: str
    spec: str | None = None
    parameters: Record = {}
    domain: str | None = None
    fits: list[Fit] = []
    ratios: list[Ratio] = []
    overall: Ratio | None = None
    psnr_db: float | None = None
    psnr_change_db: float | None = None
    ssim: float | None = None
    ssim_change: float | None = None
    n_clipped: int | None = None
    cpu_s: float | None = None


class Estimator(Struct, frozen=True):
    """A way to compute a threshold, and what it took and how wrong it was at each budget."""

    name: str
    label: str | None = None
    set_up_cpu_s: float | None = None
    slope: float | None = None
    slope_standard_error: float | None = None
    points: list[Record] = []
    cpu_s_at: list[Record] = []

    @property
    def title(self) -> str:
        """What it is called."""
        return self.label or self.name


class SpeedRatio(Struct, frozen=True):
    """How many times less CPU the last estimator of a scene takes than the first, at a relative error."""

    threshold_error: Positive
    ratio: Positive | None = None
    extrapolated: bool = False
    at_least: bool = False


class SceneResult(Struct, frozen=True):
    """A scene of `accuracy`."""

    name: str
    title: str | None = None
    estimators: list[Estimator] = []
    variants: list[Record] = []
    speed_ratios: list[SpeedRatio] = []

    @property
    def heading(self) -> str:
        """What it is called, with a capital letter."""
        title = self.title or self.name
        return title[:1].upper() + title[1:]


class Thumbnail(Struct, frozen=True):
    """A PNG of an example. `scale` is the value of white, and minus that of black where zero is mid-grey."""

    name: str
    png: bytes
    scale: float | None = None


class Example(Struct, frozen=True):
    """A trial near threshold: the frame as displayed and what the observer makes of it."""

    group: Group
    pictures: list[Thumbnail]
    level: str = "level"
    strength: float | None = None
    orientation: str | None = None
    p_correct: float | None = None
    frame: str | None = None
    n_frames: int = 1
    width_mrad: float | None = None
    algorithm: str | None = None


class ResultWarning(Struct, frozen=True):
    """A fact that makes the result less sure."""

    message: str
    code: str = ""


class Result(Struct, frozen=True):
    """What `result.json` holds."""

    schema: int
    command: str
    version: str = "?"
    settings: Record = {}
    seed: int | None = None
    run_time_s: float | None = None
    dataset: str | None = None
    versions: Record = {}
    fits: list[Fit] = []
    algorithms: list[Algorithm] = []
    scenes: list[SceneResult] = []
    verdict: Names = []
    examples: list[Example] = []
    plan: list[Record] = []
    skipped: list[Record] = []
    warnings: list[ResultWarning] = []
    located: list[Record] = []
    negative_luminance_pixels: int = 0


def load_result(path: Path) -> Result:
    """A result from its file; see `read_result`.

    Raises
    ------
    DataError
        If it cannot be read, or is not a result.
    """
    return read_result(read_file(path, most_mb=MAX_MB), str(path))


def read_result(content: bytes, where: str) -> Result:
    """A result from its JSON, checked.

    Parameters
    ----------
    content : bytes
        One JSON object, with or without a byte-order mark.
    where : str
        The file; every message begins with it.

    Raises
    ------
    DataError
        If it is no JSON, of another schema or of a command without a report, or lacks what a report cannot do
        without.
    """
    try:
        result = msgspec.json.decode(content.removeprefix(b"\xef\xbb\xbf"), type=Result)
    except msgspec.ValidationError as error:
        raise DataError(f"{where}: {_in_words(str(error))}") from None
    except UnicodeDecodeError:
        raise DataError(f"{where}: not UTF-8, expected a result in JSON") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(f"{where}: not a result in JSON ({error})") from None
    if result.schema != SCHEMA:
        raise DataError(f"{where}: schema: found {result.schema}, expected {SCHEMA}")
    if result.command not in CONTENT:
        raise DataError(f"{where}: command: found {result.command!r}, expected one of {', '.join(CONTENT)}")
    if not getattr(result, CONTENT[result.command]):
        raise DataError(f"{where}: {CONTENT[result.command]}: found none, expected at least one")
    _check_fits(result.fits, f"{where}: fits")
    _check_fits([fit for one in result.algorithms for fit in one.fits], f"{where}: fits of all algorithms")
    for number, example in enumerate(result.examples):
        for picture in example.pictures:
            if not picture.png.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR"):
                raise DataError(f"{where}: examples[{number}]: picture {picture.name!r} is no PNG")
    return result


def _check_fits(fits: Sequence[Fit], where: str) -> None:
    """Fits of one result stand in one table: they share level and group columns."""
    for number, fit in enumerate(fits):
        for name, found, expected in (
            ("level", fit.level, fits[0].level),
            ("group", ", ".join(fit.group), ", ".join(fits[0].group)),
        ):
            if found != expected:
                raise DataError(
                    f"{where}[{number}].{name}: found {found!r}, expected {expected!r} as in the first"
                )


def _in_words(problem: str) -> str:
    """A message of msgspec as this package puts it: where, found, expected."""
    what, _, place = problem.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    if missing := re.fullmatch(r"Object missing required field `(\w+)`", what):
        return f"{place}.{missing[1]} is missing".removeprefix(".")
    expected, _, found = what.replace("`", "").replace(" | null", "").partition(", got ")
    found = f"found {found}, " if found else ""
    return f"{place or 'the result'}: {found}{expected[0].lower()}{expected[1:]}"
