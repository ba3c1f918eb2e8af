"""The command `enhancements`."""

from __future__ import annotations

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import print_table, prints_go_to_stderr, say
from todframes.cli.runner import showing


@click.command(params=[*showing("json")])
def enhancements(*, json: bool) -> None:
    """List the enhancement algorithms that are registered, with their parameters."""
    import msgspec

    from todframes import __version__
    from todframes.enhancement.finding import enhancement_names, find_enhancement
    from todframes.enhancement.records import enhancement_record, enhancements_table
    from todframes.results.data import SCHEMA

    found = []
    for name in enhancement_names():
        try:
            with prints_go_to_stderr():
                found.append(find_enhancement(name))
        except SettingsError as error:  # raised by an algorithm of another package
            say(f"left out: {error}")
    listed = [enhancement_record(one) for one in found]
    if not json:
        print_table(enhancements_table(listed))
        return
    result = {"schema": SCHEMA, "command": "enhancements", "version": __version__, "enhancements": listed}
    click.echo(msgspec.json.format(msgspec.json.encode(result), indent=2))
