"""Options that several commands share, and the settings that they give."""

from __future__ import annotations

from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes.base.errors import SettingsError

if TYPE_CHECKING:
    from todframes.cli.signature import Value
    from todframes.observers.interface import Observer
    from todframes.psychometrics.fit import FitSettings


LOCATE = ("group", "each")
"""Values of `--locate`; without a value it has the first."""

SUMMARY_FILE, SUMMARY_PAGE = "summary.csv", "summary.html"
"""Table and page of a batch, beside the folders of all."""


def expanded(_: click.Context, __: click.Parameter, paths: tuple[str, ...]) -> tuple[str, ...]:
    """Return paths, with the matches in place of a pattern that a shell has left as it is, and without the summary
    of a batch, which a pattern of its folders matches, too.
    """
    found: list[str] = []
    for path in paths:
        matches = [] if Path(path).exists() else glob(path)  # noqa: PTH207
        if matches:
            from todframes.recordings.recording import natural_order

            matches = list(map(str, natural_order(map(Path, matches))))
        found += matches or [path]
    others = [path for path in found if Path(path).name not in (SUMMARY_FILE, SUMMARY_PAGE)]
    return tuple(others or found)


def parts(text: str, option: str, value: Value) -> Sequence[Any]:
    """Return the values in a text with separators between them; SettingsError if a part is not of the kind, or
    there is another number of them.
    """
    kind, form = value.kind, value.form
    try:
        values = [kind(part) for part in text.split(form.separator)]
    except ValueError:
        values = []
    if not values or value.length not in (None, len(values)):
        noun = "whole numbers" if kind is int else "numbers"
        how = "with commas between them" if value.length is None else f"as {form.metavar}"
        raise SettingsError(f"{option}: found {text!r}, expected {noun} {how}")
    return tuple(values) if value.length else values


class Assigned(click.ParamType):  # type: ignore[type-arg]  # click 8.2 takes none
    """Type of an option KEY=VALUE, which gives a pair."""

    def __init__(self, value: Value) -> None:
        self.name, self.value = value.form.metavar, value

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ARG002
        """Return the key and the value in the text."""
        assert param is not None and self.value.key is not None
        name, (key, equals, text) = param.opts[0], value.partition("=")
        try:
            if not (key.strip() and equals):
                raise ValueError
            of_list = self.value.key.is_list
            return parts(key, name, self.value.key) if of_list else key.strip(), self.value.kind(text.strip())
        except ValueError:
            raise SettingsError(f"{name}: found {value!r}, expected {self.name}") from None


class Separated(click.ParamType):  # type: ignore[type-arg]  # click 8.2 takes none
    """Type of an option that holds several values in one text."""

    def __init__(self, value: Value) -> None:
        self.name, self.value = value.form.metavar, value

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ARG002
        """Return the values in the text."""
        assert param is not None
        return parts(value, param.opts[0], self.value)


P_CORRECT = click.Option(
    ["--p-correct", "p_correct"],
    type=float,
    metavar="P",
    help="Raw proportion correct at threshold.  [default: 0.75]",
)

SETTINGS = click.Option(
    ["--set", "assignments"],
    multiple=True,
    metavar="NAME=VALUE",
    help="Any setting by name, such as kernel_a=0.4; repeatable. All are in docs/explanation/model.md and "
    "docs/explanation/observers.md.",
)

OBSERVER_OPTIONS = (
    click.Option(
        ["--internal-noise", "internal_noise"],
        type=float,
        metavar="N",
        help="Full width of each neuron's noise.  [default: 0.5]",
    ),
    P_CORRECT,
    SETTINGS,
    click.Option(
        ["--observer-settings", "observer_settings"],
        type=click.Path(),
        metavar="FILE|NAME",
        help="TOML file with settings, or a name of this package: modelfest is an eye for --observer pyramid.",
    ),
)
"""Options of each command with an observer, beside those of its call."""


class LocatingCommand(click.Command):
    """A command whose option `--locate` may be given without a value, also before the dataset."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments after `--locate` was given its default value where it has none."""
        options = args[: args.index("--")] if "--" in args else args
        bare = {
            k
            for k, option in enumerate(options)
            if option == "--locate" and not set(args[k + 1 : k + 2]) & {*LOCATE}
        }
        given = [f"--locate={LOCATE[0]}" if k in bare else option for k, option in enumerate(args)]
        return super().parse_args(ctx, given)


def make_observers(
    asked: dict[str, Any], *, fitted: bool = True, several: bool = True
) -> tuple[list[Observer], FitSettings]:
    """Return the observers and the fit settings of `OBSERVER_OPTIONS`, which are removed from `asked`. A separate
    option takes precedence over `--set`, and `--set` over the file; with several observers, a setting goes to each
    that has it. If not `fitted`, the criterion is the only setting of the fit.
    """
    from dataclasses import fields

    from todframes.base.reading import check_keys, from_table, read_toml
    from todframes.cli.console import prints_go_to_stderr
    from todframes.observers.interface import observer_named, observers_with, setting_names, settings_file
    from todframes.psychometrics.fit import FitSettings

    names, path = asked.pop("observer"), asked.pop("observer_settings", None)
    names = names.split(",") if isinstance(names, str) else names
    if len(names) > 1 and not several:
        raise SettingsError(f"observer: found {','.join(names)!r}, expected a single one here")
    of_file = {} if path is None else read_toml(settings_file(path))
    table = of_file | _set(asked, "internal_noise", "p_correct")
    with prints_go_to_stderr():
        defaults = [observer_named(name) for name in names]
    of_observers = [setting_names(default.settings_type) for default in defaults]
    of_fit = [field.name for field in fields(FitSettings) if fitted or field.name == "p_correct"]
    known = list(dict.fromkeys([*sum(of_observers, []), *of_fit]))  # noqa: RUF017 - they are few

    def made(table: dict[str, Any], where: str) -> tuple[list[Observer], FitSettings]:
        if {"internal_noise", "internal_noise_sd"} <= table.keys():
            raise SettingsError(f"{where}: found internal_noise and internal_noise_sd, expected one of them")
        for key in table:
            if key not in known and (others := observers_with(key)):
                is_noise = key == "internal_noise" and "efficiency" in known
                instead = "; its noise follows from its efficiency" if is_noise else ""
                raise SettingsError(
                    f"{where}: {key} is a setting of {', '.join(others)}; {', '.join(names)} has none{instead}"
                )
        check_keys(table, known, where)
        observers = []
        for default, setting in zip(defaults, of_observers, strict=True):
            given = {k: v for k, v in table.items() if k in setting}
            read = from_table(given, default.settings_type, where)
            observers.append(type(default)(default.settings, **{k: getattr(read, k) for k in given}))
        return observers, from_table({k: v for k, v in table.items() if k in of_fit}, FitSettings, where)

    try:
        return made(table, "settings")
    except SettingsError:
        if path is not None:
            made(of_file, str(path))  # its own mistakes have its name
        raise


def make_fit(asked: dict[str, Any]) -> FitSettings:
    """Return the fit settings of `--p-correct` and `--set`, which are removed from `asked`."""
    from todframes.base.reading import from_table
    from todframes.psychometrics.fit import FitSettings

    return from_table(_set(asked, "p_correct"), FitSettings, "settings")


def _set(asked: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return the values of `--set` and of separate options by name; separate options take precedence."""
    table = assigned(asked.pop("assignments", ()))
    return table | {name: value for name in names if (value := asked.pop(name, None)) is not None}


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Return the values of `--set NAME=VALUE` by name: TOML values, or texts if they are not TOML. SettingsError
    if an assignment has no name or no equals sign.
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
