"""Registered algorithms as records and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from todframes.enhancement.algorithm import Enhancement
from todframes.results.data import Record
from todframes.results.table import Column, Table


def plain_value(value: object) -> object:
    """Return a parameter's value as a JSON value, or as a text if JSON has no such value."""
    if isinstance(value, Mapping):
        return {str(name): plain_value(one) for name, one in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)


def enhancement_record(algorithm: Enhancement) -> Record:
    """Return the description of a registered algorithm, as `todframes enhancements --json` prints it."""
    return {
        "name": algorithm.name,
        "what": algorithm.what,
        "domain": algorithm.declaration.domain,
        "changes_pitch": algorithm.declaration.magnification != 1.0,
        "clip": algorithm.declaration.clip,
        "library": algorithm.declaration.library,
        "parameters": [
            {
                "name": one.name,
                "default": plain_value(one.default),
                "unit": (one.meta.extra or {}).get("unit") or None,
                "range": None if one.meta.ge is None else [one.meta.ge, one.meta.le],
                "choices": list(one.choices) or None,
                "what": one.meta.description or None,
            }
            for one in algorithm.parameters
        ],
    }


def enhancements_table(listed: Sequence[Record]) -> Table:
    """Make the table of registered algorithms, with a row for each parameter below its algorithm."""
    records: list[Record] = []
    for one in listed:
        takes = one["domain"].replace("_", " ") + "s" * (one["domain"] == "code_value") + ", clips" * one["clip"]
        records.append({"name": one["name"], "what": one["what"], "takes": takes, "from": one["library"]})
        for parameter in one["parameters"]:
            default, ends = parameter["default"], parameter["range"] or ()
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = ", ".join(map(str, parameter["choices"] or ())) or " – ".join(f"{end:g}" for end in ends)
            records.append(
                {
                    "name": f"  {parameter['name']}",
                    "what": parameter["what"],
                    "default": " ".join(filter(None, (shown, parameter["unit"]))),
                    "range": span,
                }
            )
    columns = [
        Column(key="name"),
        Column(key="what", header="what it does; what a parameter is", none="", wraps=True),
        Column(key="default", none=""),
        Column(key="range", none="", wraps=True, rank=1),
        Column(key="takes", none="", rank=2),
        Column(key="from", none="", rank=3),
    ]
    return Table.of("Enhancement algorithms", "enhancements.csv", columns, records)
