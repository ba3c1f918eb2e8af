"""Commands made of calls: options from the calls' descriptions, and the way from the options to a result."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import click

from todframes.base import signals
from todframes.base.errors import SettingsError, flag_of
from todframes.cli.console import (
    Interruption,
    check_strict,
    echo,
    opened_engine,
    print_result,
    prints_go_to_stderr,
    progress,
    say,
    staged,
)
from todframes.cli.options import (
    LOCATE,
    OBSERVER_OPTIONS,
    REQUIRED,
    Argument,
    Assigned,
    LocatingCommand,
    Separated,
    Value,
    expanded,
    make_observers,
    read_call,
)

LOADING = "todframes.frames.dataset:load_dataset"
"""Call that opens a dataset; its limit of memory is an option of the commands that read one."""

NO_OPTIONS = {"fit", "problem", "progress", "store", "ttp"}
"""Parameters of calls that are not options, beside those in `SUPPLIED`."""

SHOWING = {
    "explain": "Print what was kept and left out, why, and what that changes.",
    "verbose": "Also print {}.",
    "json": "Print one JSON object on standard output.",
    "quiet": "No progress and no remarks on standard error.",
    "strict": "End with status 1 if there is a warning; the output is whole all the same.",
}
"""Options that say how a result is shown, in the order of `--help`."""

GOING_ON = {
    "restart": "Begin anew, and forget what an interrupted run has finished.",
    "keep_store": "Keep finished results in OUT, for later runs that share some of them.",
}
"""Options of the commands that can continue an interrupted run."""


def resolved(name: str) -> Any:
    """Return a function or command by its name, "module:function"."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


class Command(NamedTuple):
    """A command: the call that it is made of, and what is shown of the result.

    - `call`: the call, "module:function"; `also`: another call whose parameters are options, too, which is made if
      the option `also_if` is given, or if a body says so.
    - `arguments`: parameters that stand without a name on the command line.
    - `showing`: the options of `SHOWING` that apply; `details`: what `--verbose` adds.
    - `files`: what `-o` writes into a folder; empty if the command has no such option.
    - `task`: what the bar of the progress says. `is_timed`: print the time that the command took.
    - `title`: function of the result and the given values, the title of the table of thresholds, if the result has
      one.
    - `show`: function of a result, the given values and those of the showing options that prints the result, if it
      has no tables.
    - `further`: arguments and options that are not parameters of the call; `prepare` sets the values for the call
      by them; `text` is the paragraph of `--help` about these.
    - `each`: the argument that may be given several times; the command is then run on each, or only with the
      option `each_if`, if the call itself takes several. `each_kept`, "module:function", returns what an earlier
      run has left in a folder, or None.
    - `without`: parameters of the call, or options of an observer, that the command does not have.
    - `body`: function that does all this for a command: of the given values, those of the showing
      options, and the folder for files.
    """

    call: str
    arguments: str
    showing: str
    files: str = ""
    task: str = ""
    title: Callable[[Any, dict[str, Any]], str] | None = None
    details: str = "the fitted curves, run times, and remarks on what the numbers leave out"
    is_timed: bool = True
    show: Callable[[Any, dict[str, Any], dict[str, Any]], None] | None = None
    further: tuple[click.Parameter, ...] = ()
    prepare: Callable[[dict[str, Any], dict[str, Any]], None] = lambda *_: None
    text: str = ""
    without: str = ""
    also: str = ""
    also_if: str = ""
    body: Callable[[dict[str, Any], dict[str, Any], str | None], None] | None = None
    each: str = ""
    each_if: str = ""
    each_kept: str = ""


def make_command(name: str, command: Command) -> click.Command:
    """Return the command that a table describes."""
    described = read_call(command.call)
    parameters, arguments = described.parameters, command.arguments.split()
    if command.also:
        parameters = parameters | {
            key: parameter
            for key, parameter in read_call(command.also).parameters.items()
            if key not in parameters
        }
    left_out = {*arguments, *NO_OPTIONS, *SUPPLIED, *command.without.split()}
    made: list[click.Parameter] = [_argument(parameters[name], command) for name in arguments]
    if command.files:
        made.append(click.Option(["-o", "--out"], metavar="OUT", help=f"Folder for {command.files}."))
    for parameter in parameters.values():
        if parameter.name not in left_out:
            made.append(option(parameter, parameters))
            made[-1].required &= parameter.name in described.parameters
        if parameter.name == "observer":
            made += (each for each in OBSERVER_OPTIONS if each.name not in {*parameters, *left_out})
    made += command.further
    if _opens_dataset(parameters):
        made.append(option(read_call(LOADING).parameters["max_frame_mb"], parameters))
    made += (_flag(key, text) for key, text in GOING_ON.items() if "store" in parameters)
    made += showing(command.showing, command.details)
    texts = [*described.paragraphs, command.text]
    texts += (f"{_name(parameters[name])}: {parameters[name].text}" for name in arguments)
    if command.files:
        texts.append("Without -o nothing is written.")
    kind = LocatingCommand if "locate" in parameters else click.Command
    help_text = _for_commands("\n\n".join(filter(None, texts)), parameters)
    settings = {"help_option_names": ["-h", "--help"]}  # also of a command without its group
    run = partial(_run_each if command.each else _run, command)
    return kind(name, params=made, callback=run, help=help_text, context_settings=settings)


def showing(names: str, details: str = "") -> list[click.Option]:
    """Return the options of `SHOWING` with some names; `details` says what `--verbose` adds."""
    return [_flag(key, text.format(details)) for key, text in SHOWING.items() if key in names.split()]


def _flag(name: str, text: str) -> click.Option:
    return click.Option([flag_of(name), name], is_flag=True, help=text)


class Commands(click.Group):
    """A group of commands, each made when it is asked for, those of calls from
    `table`. They raise `Interruption` at Ctrl-C; click itself would
    print an empty line.
    """

    def __init__(self, *args: Any, table: Mapping[str, Command], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._table = table

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, sorted."""
        return sorted({*super().list_commands(ctx), *self._table})

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Return a command by its name; None if there is none."""
        if name not in self.commands and name in self._table:
            self.add_command(make_command(name, self._table[name]))
        return super().get_command(ctx, name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands. Options are not made for it: those of all take as long as NumPy."""

        def listed(name: str) -> click.Command | None:
            if name not in self._table:
                return self.get_command(ctx, name)
            described = read_call(self._table[name].call)
            return click.Command(name, help=_for_commands(described.paragraphs[0], described.parameters))

        rows = [
            (name, command.get_short_help_str(200))
            for name in self.list_commands(ctx)
            if (command := listed(name))
        ]
        with formatter.section("Commands"):
            formatter.write_dl(rows)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the first argument names; an error names the nearest one."""
        name = args[0]  # click may empty the list
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError:
            if name.startswith("-"):
                raise
            near = get_close_matches(name, self.list_commands(ctx), 1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise click.UsageError(f"No such command {name!r}.{hint}", ctx) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the context names."""
        try:
            with signals.raised():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interruption from None


class Option(click.Option):
    """An option whose text states the range of its values, beside the default."""

    def get_help_extra(self, ctx: click.Context) -> Any:
        """Return what stands in brackets behind the text, without the range."""
        return {key: value for key, value in super().get_help_extra(ctx).items() if key != "range"}


def option(parameter: Argument, parameters: Mapping[str, Argument]) -> click.Option:
    """Return the option of a call's parameter; it has no value if none is given, so that the call has its own."""
    value, default, flag = parameter.value, parameter.default, flag_of(parameter.name)
    text = parameter.text
    is_off = flag.startswith("--no-")
    if default is True and not is_off:
        raise TypeError(
            f"{parameter.where}: expected an option --no-… in `errors.flag_of`, as the default is True"
        )
    if is_off:
        start, _, text = text.partition("Otherwise ")[2].partition(" ")
        text = f"{start.capitalize()} {text}"
    text = _for_commands(text, parameters)
    if value.is_repeated:
        text = f"{text.removesuffix('.')}; repeatable."
    if parameter.name == "locate":
        text += f" Without a value: {LOCATE[0]}."
    shown = _for_commands(parameter.default_text, parameters) or _default(default)
    limits = [f"default: {shown}"] if shown else []
    ends = zip((">=", ">", "<=", "<"), value.form[1:5], strict=True)
    limits += [f"x{sign}{end}" for sign, end in ends if end is not None]
    if limits:
        text += f"  [{'; '.join(limits)}]"
    names = [*(["-o"] if flag == "--out" else []), flag, parameter.name]
    if value.kind is bool:
        return click.Option(names, is_flag=True, flag_value=not is_off, default=None, help=text)
    return Option(
        names,
        type=_type(value),
        metavar=value.form.metavar or None,
        multiple=value.is_repeated,
        required=default is REQUIRED,
        help=text,
    )


def _argument(parameter: Argument, command: Command) -> click.Argument:
    value = parameter.value
    is_repeated = value.is_repeated or parameter.name == command.each
    return click.Argument(
        [parameter.name],
        type=_type(value),
        nargs=-1 if is_repeated else 1,
        required=parameter.default is REQUIRED and not command.also,
        metavar=_name(parameter).removesuffix("…") + "…" * is_repeated,
        callback=expanded if is_repeated else None,
    )


def _name(argument: Argument) -> str:
    """Return what stands for an argument in texts."""
    value = argument.value
    name = value.form.metavar or argument.name.upper()
    return f"{name.removesuffix('S')}…" if value.is_repeated else name


def _type(value: Value) -> click.ParamType:  # type: ignore[type-arg]  # click 8.2 takes none
    """Return the type of click that reads a value."""
    if value.key is not None:
        return Assigned(value)
    if value.is_list:
        return Separated(value)
    if value.choices:
        return click.Choice(value.choices)
    if value.kind is int and value.form.ge is not None:
        return click.IntRange(value.form.ge, value.form.le)
    types = {str: click.STRING, int: click.INT, float: click.FLOAT}
    return types.get(value.kind, click.Path())


def _default(default: Any) -> str:
    """Return a default as a command line writes it; an empty text for none."""
    if default is REQUIRED or isinstance(default, bool) or default in (None, ()):
        return ""
    return ",".join(map(_default, default)) if isinstance(default, tuple) else f"{default}".removesuffix(".0")


def _for_commands(text: str, parameters: Mapping[str, Argument]) -> str:
    """Return a text of a call with options in place of the names of its parameters."""
    return re.sub(r"`(\w+)`", lambda match: flag_of(match[1]) if match[1] in parameters else match[0], text)


def _opens_dataset(parameters: Mapping[str, Argument]) -> bool:
    """Return whether a call takes a dataset that is open, and not only its folder."""
    kinds = str(parameters["dataset"].annotation) if "dataset" in parameters else ""
    return re.search(r"\bDataset\b", kinds) is not None and "max_frame_mb" not in parameters


class Asked(NamedTuple):
    """A command line as it was parsed: a call with its arguments, values of options that are not the call's, those
    of the showing options, the folder for files, and whether neither progress nor remarks are shown.
    """

    call: str
    parameters: Mapping[str, Argument]
    arguments: dict[str, Any]
    further: dict[str, Any]
    shown: dict[str, bool]
    out: str | None
    quiet: bool


SUPPLIED: dict[str, Callable[[Asked], Any]] = {
    "examples": lambda asked: asked.out is not None,
    "tell": lambda asked: echo if "open_browser" in asked.parameters else None if asked.quiet else say,
    "warn": lambda _: say,
}
"""Parameters of calls that a command sets itself, with their values."""


def _run_each(command: Command, **values: Any) -> None:
    """Run a command on each of several paths; on all together without the option `each_if`, or on a single one."""
    paths = values.pop(command.each)
    is_apart = values.pop(command.each_if) if command.each_if else len(paths) > 1
    if not is_apart:
        _run(command, **values, **{command.each: paths if command.each_if else paths[0]})
        return
    from todframes.cli.batches import run_each

    out = values.pop("out", None)

    def run(path: str, folder: str | None, take: Callable[[Any], None]) -> None:
        kept = resolved(command.each_kept)(Path(folder)) if command.each_kept and folder else None
        if kept is not None:
            if not values["quiet"]:
                say(f"note: {folder}: is there already and stays as it is; remove it to make it anew")
            take(kept)
            return

        def show(result: Any, *_: object) -> None:
            take(result)
            check_strict(result.warnings, values.get("strict", False))

        _run(command._replace(show=show), **values, out=folder, **{command.each: path})

    noun = command.each.removesuffix("s")
    run_each(run, paths, out, noun=noun, as_json=values.get("json", False), quiet=values["quiet"])


def _run(command: Command, **values: Any) -> None:
    """Run a command's call with the values that were given, and show its result."""
    asked = _parse(command, values)
    if command.body:
        command.body(asked.arguments | asked.further, asked.shown, asked.out)
        return
    _complete(asked)
    _show(command, asked, _call(command, asked))


def _parse(command: Command, values: dict[str, Any]) -> Asked:
    """Return what the values of a command line ask for."""
    given = {name: value for name, value in values.items() if value is not None and value != ()}
    shown = {name: given.pop(name, False) for name in command.showing.split()}
    further = {str(option.name): given.pop(str(option.name)) for option in command.further if option.name in given}
    out = given.pop("out", None) if command.files else None
    call, parameters = _chosen(command, given)
    for name in given.keys() & parameters.keys():
        if parameters[name].value.key is not None:
            keys = [key for key, _ in given[name]]
            if twice := [key for number, key in enumerate(keys) if key in keys[:number]]:
                raise SettingsError(f"{flag_of(name)}: found {twice[0]} twice, expected each key once")
            given[name] = dict(given[name])
    command.prepare(given, further)
    return Asked(call, parameters, given, further, shown, out, shown.get("quiet", False))


def _complete(asked: Asked) -> None:
    """Replace options of observers and paths by what the call takes, and add what a command sets itself."""
    parameters, arguments = asked.parameters, asked.arguments
    if "observer" in parameters:
        several = parameters["observer"].value.is_list
        arguments.setdefault("observer", parameters["observer"].default)
        observers, fit = make_observers(arguments, fitted="fit" in parameters, several=several)
        made = {"observer": observers if several else observers[0], "fit": fit, "p_correct": fit.p_correct}
        arguments |= {name: value for name, value in made.items() if name in parameters}
    if _opens_dataset(parameters):
        from todframes.frames.dataset import load_dataset

        limit = {name: arguments.pop(name) for name in ("max_frame_mb",) if name in arguments}
        arguments["dataset"] = load_dataset(arguments["dataset"], **limit)
    arguments |= {name: value(asked) for name, value in SUPPLIED.items() if name in parameters}


def _call(command: Command, asked: Asked) -> Any:
    """Make the call, write the files of its result, and return it."""
    arguments, quiet = asked.arguments, asked.quiet
    with ExitStack() as stack:
        write = stack.enter_context(
            staged(asked.out, arguments if "store" in asked.parameters else None, quiet=quiet)
        )
        if "cluster" in asked.parameters:
            stack.enter_context(opened_engine(arguments, quiet=quiet))
        if "enhance" in asked.parameters:
            stack.enter_context(prints_go_to_stderr())
        if "progress" in asked.parameters:
            arguments["progress"] = stack.enter_context(progress(command.task, quiet=quiet))
        starred = [name for name, parameter in asked.parameters.items() if parameter.is_starred]
        positional = [value for name in starred for value in arguments.pop(name, ())]
        result = resolved(asked.call)(*positional, **arguments)
        if command.files:
            write(result.files)
    return result


def _show(command: Command, asked: Asked, result: Any) -> None:
    """Print a result as its command does."""
    given = asked.arguments | asked.further
    if command.show is not None:
        command.show(result, given, asked.shown)
        return
    title = "" if command.title is None else command.title(result, given)
    shown = {"as_json" if name == "json" else name: value for name, value in asked.shown.items()}
    print_result(result, title, out=asked.out, is_timed=command.is_timed, **shown)


def _chosen(command: Command, given: Mapping[str, Any]) -> tuple[str, Mapping[str, Argument]]:
    """Return the call that is made and its parameters; SettingsError if a value is of the other call alone."""
    parameters = read_call(command.call).parameters
    if not command.also_if:
        return command.call, parameters
    others, is_also = read_call(command.also).parameters, command.also_if in given
    chosen, name = (others, command.also) if is_also else (parameters, command.call)
    if unused := sorted(given.keys() & {*parameters, *others} - chosen.keys()):
        how = "is not used with" if is_also else "needs"
        raise SettingsError(f"{flag_of(unused[0])}: {how} {flag_of(command.also_if)}")
    return name, chosen
