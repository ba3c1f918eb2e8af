"""Options that several commands share, and the settings that they give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from todframes.base.errors import SettingsError
from todframes.base.locations import Location, location

if TYPE_CHECKING:
    from todframes.observers.interface import Observer
    from todframes.psychometrics.fit import FitSettings


LOCATE = ("group", "each")
"""Values of `--locate`; without a value it has the first."""

PASSES = {None: 1, "group": 2, "each": 3}
"""Number of times that each trial is read, by the value of `--locate`."""

F = TypeVar("F", bound=Callable[..., Any])


def numbers(text: str, option: str) -> list[float]:
    """Return the numbers in a comma-separated text.

    Raises
    ------
    SettingsError
        If a part is not a number.
    """
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise SettingsError(f"{option}: found {text!r}, expected numbers with commas between them") from None


def box(text: str, option: str) -> tuple[int, int, int, int]:
    """Return the left column, top row, width and height in a text.

    Raises
    ------
    SettingsError
        If the text is not four whole numbers.
    """
    try:
        left, top, width, height = map(int, text.split(","))
    except ValueError:
        raise SettingsError(f"{option}: found {text!r}, expected X,Y,W,H: four whole numbers of pixels") from None
    return left, top, width, height


def limits(text: str, option: str) -> tuple[float, float]:
    """Return the two numbers of a text LOW:HIGH.

    Raises
    ------
    SettingsError
        If the text is not two numbers.
    """
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise SettingsError(f"{option}: found {text!r}, expected two numbers LOW:HIGH") from None
    return low, high


class Parsed(click.ParamType):  # type: ignore[type-arg]  # click 8.2 takes none
    """Type of an option whose text is read by a function of the text and the option's name."""

    def __init__(self, form: str, read: Callable[[str, str], Any]) -> None:
        self.name, self.read = form, read

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:  # noqa: ARG002
        """Return the form of the text, for `--help`."""
        return self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ARG002
        """Return what the function reads; a default as it is."""
        assert param is not None
        return self.read(value, param.opts[0]) if isinstance(value, str) else value


NUMBERS, BOX, LIMITS = Parsed("N[,N…]", numbers), Parsed("X,Y,W,H", box), Parsed("LOW:HIGH", limits)
"""Types of options that hold several numbers."""


def options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Return one decorator that adds several options, in the order in which `--help` shows them."""

    def decorate(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


def _location(_: click.Context, __: click.Parameter, name: str) -> Location:
    return location(name)


dataset_argument = click.argument("dataset", type=click.Path(), callback=_location)

folder_argument = click.argument("dataset", type=click.Path(path_type=Path))

max_frame_option = click.option(
    "--max-frame-mb",
    type=click.IntRange(1, 2**20),
    default=256,
    show_default=True,
    metavar="MB",
    help="Refuse frames that decode to more than this, before any is decoded.",
)

dataset_out_option = click.option(
    "-o", "--out", required=True, metavar="DATASET", help="Folder of the dataset: a new or empty one."
)

display_option = click.option(
    "--display",
    default="reference_sdr",
    show_default=True,
    metavar="NAME|FILE",
    help="Display that shows the frames: reference_sdr, reference_linear, srgb_monitor, tod_2001, or a TOML file; "
    "all are in docs/displays.md.",
)

range_option = click.option(
    "--range",
    "value_range",
    type=LIMITS,
    help="Recorded values that the display shows black and white; needed for temperatures and counts.",
)

rate_option = click.option(
    "--frames-per-second", type=float, metavar="N", help="Frames in a second, in place of what the files say."
)

turns_option = click.option(
    "--turns",
    type=click.Choice([8, 4, 1]),
    default=8,
    show_default=True,
    help="Turned and mirrored versions in which each scene is shown: 4 are not mirrored, 1 is as recorded.",
)

verbose_option = click.option(
    "--verbose",
    is_flag=True,
    help="Also print the fitted curves, run times, and remarks on what the numbers leave out.",
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")

p_correct_option = click.option(
    "--p-correct", type=float, metavar="P", help="Raw proportion correct at threshold.  [default: 0.75]"
)

seed_option = click.option(
    "--seed", "rng", type=click.IntRange(0), default=1, show_default=True, help="Seed of all random draws."
)

set_option = click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="NAME=VALUE",
    help="Any setting by name, such as kernel_a=0.4; repeatable. All are in docs/model.md and docs/observers.md.",
)

observer_option = click.option(
    "--observer",
    default="pyramid",
    show_default=True,
    metavar="NAME|MODULE:CLASS",
    help="Observer: pyramid, informative, oriented, csf or another that is registered; or your own class, "
    "whose code is run.",
)

observer_settings_option = click.option(
    "--observer-settings",
    type=click.Path(path_type=Path),
    metavar="FILE|NAME",
    help="TOML file with settings, or a name of this package: modelfest is an eye for --observer pyramid.",
)

observer_options = options(
    observer_option,
    click.option(
        "--internal-noise", type=float, metavar="N", help="Full width of each neuron's noise.  [default: 0.5]"
    ),
    p_correct_option,
    set_option,
    observer_settings_option,
)


def tolerance_option(default: float | None, what: str) -> Callable[[F], F]:
    """Return the option `--tolerance`, with the default and meaning for one command."""
    return click.option(
        "--tolerance", type=float, default=default, show_default=default is not None, metavar="T", help=what
    )


places_option = click.option(
    "--places",
    type=int,
    default=1,
    show_default=True,
    metavar="M",
    help="Number of places, far apart, at which the triangle may be; with 1 its place is known.",
)

plan_option = click.option(
    "--plan",
    type=click.Choice(["needed", "full"]),
    default="needed",
    show_default=True,
    help="Leave out what the scene does not need, or nothing.",
)

explain_option = click.option(
    "--explain", is_flag=True, help="Print what was kept and left out, why, and what that changes."
)

quiet_option = click.option("--quiet", is_flag=True, help="No progress and no remarks on standard error.")

on_error_option = click.option(
    "--on-error",
    type=click.Choice(["stop", "skip"]),
    default="stop",
    show_default=True,
    help="At a frame or row that cannot be used: end, or go on and list it.",
)

workers_option = click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes that share the work."
)

scoring_options = options(
    click.option(
        "--decisions",
        type=click.Choice(["expected", "sampled"]),
        default="expected",
        show_default=True,
        help="Each frame's probability of a correct answer, or one answer drawn a trial.",
    ),
    click.option(
        "--curve",
        type=click.Choice(["observer", "weibull"]),
        help="Psychometric function of the thresholds: the observer's own, or Weibull's, as for people.  "
        "[default: observer for expected decisions, weibull for sampled ones]",
    ),
    plan_option,
    seed_option,
    click.option(
        "--locate",
        type=click.Choice(LOCATE),
        help="Find the triangle: one position for each group (also without a value), or one for each trial, for "
        "hand-held recordings. The search begins at the position in the manifest, if there is one.",
    ),
    click.option(
        "--gaze",
        default="tracked",
        show_default=True,
        metavar="tracked|fixed",
        help="Where the observer looks while a triangle moves: at its place in each frame, or at the mean place. "
        "compare takes both: tracked,fixed.",
    ),
    on_error_option,
    max_frame_option,
    workers_option,
)
"""Options of the commands that score frames, named like the parameters of the Python calls."""

restart_options = options(
    click.option("--restart", is_flag=True, help="Begin anew, and forget what an interrupted run has finished."),
    click.option(
        "--keep-store", is_flag=True, help="Keep finished results in OUT, for later runs that share some of them."
    ),
)
"""Options of the commands that can continue an interrupted run."""

run_options = options(
    click.option(
        "--cluster",
        metavar="ADDRESS|local:N",
        help="Work on a Dask cluster: the scheduler's address, or N processes of this machine.",
    ),
    restart_options,
)
"""Options of the commands that may run long."""


class ScoringCommand(click.Command):
    """A command whose option `--locate` may be given without a value, also before the dataset."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments after `--locate` was given its default value where it has none."""
        options = args[: args.index("--")] if "--" in args else args
        bare = {
            k for k, one in enumerate(options) if one == "--locate" and not set(args[k + 1 : k + 2]) & {*LOCATE}
        }
        given = [f"--locate={LOCATE[0]}" if k in bare else one for k, one in enumerate(args)]
        return super().parse_args(ctx, given)


launch_options = options(
    click.option(
        "--host", default="127.0.0.1", show_default=True, help="Address or name of this machine to listen at."
    ),
    click.option(
        "--port", type=click.IntRange(0, 65535), default=0, help="Port to listen at.  [default: a free one]"
    ),
    click.option("--no-browser", is_flag=True, help="Print the address only; open no browser."),
)
"""Options of the commands that serve a page."""

strict_option = click.option(
    "--strict", is_flag=True, help="End with status 1 if there is a warning; the output is whole all the same."
)

result_options = options(explain_option, verbose_option, json_option, quiet_option)
"""Options for the output of the commands that score frames."""


def make_observer(asked: dict[str, Any], *, fitted: bool = True) -> tuple[Observer, FitSettings]:
    """Return the observer and the fit settings of `observer_options`, which are removed from `asked`.

    A separate option takes precedence over `--set`, and `--set` over the file. If not `fitted`, the criterion is
    the only setting of the fit.

    Raises
    ------
    SettingsError
        If there is no such observer or setting, or a value is refused.
    """
    if "," in (names := asked["observer"]):
        raise SettingsError(f"observer: found {names!r}, expected a single one here")
    (observer,), fit = make_observers(asked, fitted=fitted)
    return observer, fit


def make_observers(asked: dict[str, Any], *, fitted: bool = True) -> tuple[list[Observer], FitSettings]:
    """Return the observers, separated by commas in `asked`, and the fit settings, as `make_observer` does.

    With several observers, a setting goes to each that has it.
    """
    from dataclasses import fields

    from todframes.base.reading import check_keys, from_table, read_toml
    from todframes.cli.console import prints_go_to_stderr
    from todframes.observers.interface import find_observer, observers_with, settings_file
    from todframes.psychometrics.fit import FitSettings

    where, table = "settings", {}
    names, path = asked.pop("observer").split(","), asked.pop("observer_settings")
    if path is not None:
        where, table = str(path), read_toml(settings_file(path))
    table |= _set(asked, "internal_noise", "p_correct")
    if {"internal_noise", "internal_noise_sd"} <= table.keys():
        raise SettingsError(f"{where}: found internal_noise and internal_noise_sd, expected one of them")
    with prints_go_to_stderr():
        kinds = [find_observer(name) for name in names]
    of_observers = [[field.name for field in fields(kind.settings_type)] for kind in kinds]
    of_fit = [field.name for field in fields(FitSettings) if fitted or field.name == "p_correct"]
    known = list(dict.fromkeys([*sum(of_observers, []), *of_fit]))  # noqa: RUF017 - they are few
    for key in table:
        if key not in known and (others := observers_with(key)):
            is_noise = key == "internal_noise" and "efficiency" in known
            instead = "; its noise follows from its efficiency" if is_noise else ""
            raise SettingsError(
                f"{where}: {key} is a setting of {', '.join(others)}; {', '.join(names)} has none{instead}"
            )
    check_keys(table, known, where)
    observers = [
        kind(from_table({k: v for k, v in table.items() if k in own}, kind.settings_type, where))
        for kind, own in zip(kinds, of_observers, strict=True)
    ]
    return observers, from_table({k: v for k, v in table.items() if k in of_fit}, FitSettings, where)


def make_fit(asked: dict[str, Any]) -> FitSettings:
    """Return the fit settings of `--p-correct` and `--set`, which are removed from `asked`."""
    from todframes.base.reading import from_table
    from todframes.psychometrics.fit import FitSettings

    return from_table(_set(asked, "p_correct"), FitSettings, "settings")


def _set(asked: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return the values of `--set` and of separate options by name; separate options take precedence."""
    table = assigned(asked.pop("assignments"))
    return table | {name: value for name in names if (value := asked.pop(name)) is not None}


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Return the values of `--set NAME=VALUE` by name: TOML values, or texts if they are not TOML.

    Raises
    ------
    SettingsError
        If an assignment has no name or no equals sign.
    """
    from todframes.base.reading import toml_value

    table: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise SettingsError(f"--set: found {assignment!r}, expected NAME=VALUE")
        try:
            value = toml_value(text)
        except ValueError:
            raise SettingsError(f"--set: found {assignment!r}, expected one NAME=VALUE") from None
        if isinstance(value, str) and text.lstrip().startswith("[") and text.count("[") == 1:
            raise SettingsError(f"--set: found {assignment!r}, expected a list as TOML has it: NAME=[0.5, 0.25]")
        table[name.strip()] = value
    return table
