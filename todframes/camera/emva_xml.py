"""Results of EMVA 1288 as XML: the names and units of the public reference set, written and read.

The form is that of the result files beside the EMVA 1288 reference data sets: sections with leaves, and in each
leaf `Value`, `Unit` and `Symbol`. Leaves that are not known are ignored.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from todframes.base._typing import Json
from todframes.base.errors import DataError
from todframes.base.reading import read_file


class Leaf(NamedTuple):
    """A quantity of a result: its section and name, unit, symbol and meaning, and its key in `EmvaNumbers`."""

    section: str
    name: str
    unit: str
    symbol: str
    meaning: str
    key: str


with Path(__file__).with_name("emva_results.csv").open(encoding="utf-8", newline="") as _file:
    LEAVES = [Leaf(*row) for row in list(csv.reader(_file))[1:]]
"""Quantities of a result, in the order of the file."""

Results = Mapping[str, float | int | None]
"""Results by the names in `LEAVES`, in their units; those that are not known are None or missing."""


def noise_table(results: Results, lines: Mapping[str, float] | None = None) -> Json:
    """Return the table `[noise]` of a SENSOR.toml with what a camera's results state, in six digits.

    `lines` are the parts of rows and columns by their keys in the table, what their pixels have in common in the
    dark, in a frame or in all: they are taken from the dark noise and from the DSNU. EMVA 1288 does not have them.
    """
    lines, noise, pattern = lines or {}, results["sigma_d"], results.get("DSNU1288")
    of_noise, of_pattern = (
        sum(sd**2 for key, sd in lines.items() if kind in key) for kind in ("noise", "pattern")
    )
    efficiency, dark_current = results.get("QE"), results.get("u_I_mean")
    known: Json = {
        "quantum_efficiency": None if efficiency is None else efficiency / 100.0,
        "system_gain_dn_per_electron": results["K"],
        "dark_noise_electrons": noise and math.sqrt(max(noise**2 - of_noise, 0.0)),
        # From the means of dark frames; noise can make it negative.
        "dark_current_electrons_per_s": None if dark_current is None else max(dark_current, 0.0),
        "dsnu_electrons": pattern and math.sqrt(max(pattern**2 - of_pattern, 0.0)),
        "prnu_percent": results.get("PRNU1288"),
        **lines,
        "full_well_electrons": results.get("u_e_sat"),
        "bits": results.get("bits"),
        "exposure_ms": results.get("exposure"),
    }
    rounded = {name: float(f"{value:.6g}") if isinstance(value, float) else value for name, value in known.items()}
    return {"model": "photon"} | {name: value for name, value in rounded.items() if value is not None}


def emva_xml(values: Results) -> bytes:
    """Return the XML file of results in UTF-8, without those that are not known."""
    root = ElementTree.Element("results")
    sections = {
        name: ElementTree.SubElement(root, name) for name in dict.fromkeys(leaf.section for leaf in LEAVES)
    }
    for section, name, unit, symbol, meaning, _ in LEAVES:
        value = "4.0" if name == "release" else values.get(name)
        if value is None:
            continue
        leaf = ElementTree.SubElement(sections[section], name)
        texts = {"Short": meaning, "Symbol": f"${symbol}$" * bool(symbol)}
        texts |= {"Value": value if isinstance(value, str) else f"{value:.10g}", "Unit": unit}
        for key, text in texts.items():
            ElementTree.SubElement(leaf, key).text = text
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def read_emva_xml(path: Path) -> Json:
    """Return the table `[noise]` of a SENSOR.toml for the camera that a file of EMVA 1288 results describes.

    DataError if the file cannot be read, is of another release or form, or has a value that no camera has.
    """
    results = _results(path)
    values = {leaf.name: _number(path, results, leaf) for leaf in LEAVES}
    if values["K"] is None and (inverse := values["inverse_K"]) is not None:
        values["K"] = 1.0 / inverse if inverse > 0.0 else math.nan
    for name in ("K", "sigma_d"):
        if values[name] is None:
            raise DataError(f"{path}: found no sensitivity/{name}, expected one; are these results of EMVA 1288?")
    if (bits := values["bits"]) is not None:
        if bits != round(bits):
            raise DataError(f"{path}: info/bits: found {bits:g}, expected a whole number")
        values["bits"] = round(bits)
    for name, most in (("K", math.inf), ("QE", 100.0), ("u_e_sat", math.inf)):
        value = values[name]
        if value is not None and not 0.0 < value <= most:
            of_percent = " up to 100 %" * (most == 100.0)
            raise DataError(f"{path}: sensitivity/{name}: found {value:g}, expected a number > 0{of_percent}")
    for name in ("sensitivity/sigma_d", "spatial/DSNU1288", "spatial/PRNU1288"):
        value = values[name.partition("/")[2]]
        if value is not None and value < 0.0:
            raise DataError(f"{path}: {name}: found {value:g}, expected a number of 0 or more")
    return noise_table(values)


def _results(path: Path) -> ElementTree.Element:
    content = read_file(path, most_mb=16)
    if b"\0" in content:  # a document type in UTF-16 would pass the next check
        raise DataError(f"{path}: has NUL bytes, as text in UTF-16 has; expected XML in UTF-8")
    if b"<!" in content.replace(b"<!--", b""):  # entities could become any amount of text
        raise DataError(f"{path}: has a document type or CDATA, expected plain XML of EMVA 1288 results")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two: of its encoding
        raise DataError(f"{path}: is no XML ({error}), expected results of EMVA 1288") from None
    if root.tag != "results":
        raise DataError(
            f"{path}: begins with <{root.tag}>, expected <results>, the form of EMVA 1288, release 3 or 4"
        )
    for name in ("release", "version", "standard"):
        text = (root.findtext(f"info/{name}/Value") or root.findtext(f"info/{name}") or "").strip()
        if text and not text.startswith(("3.", "4.")):
            raise DataError(
                f"{path}: info/{name}: found {text[:40]!r}, expected a release of EMVA 1288 from 3 to 4"
            )
    return root


def _number(path: Path, results: ElementTree.Element, wanted: Leaf) -> float | None:
    """Return the number of a leaf in its unit; None if it is not there."""
    section, name, expected, *_ = wanted
    leaf = results.find(f"{section}/{name}")
    text = None if leaf is None else leaf.findtext("Value")
    if leaf is None or text is None or not text.strip() or name == "release":
        return None
    unit = (leaf.findtext("Unit") or "").strip().strip("$").replace("\\", "")
    if unit and expected and _plain_unit(unit) != _plain_unit(expected):
        raise DataError(f"{path}: {section}/{name}: found the unit {unit[:20]!r}, expected {expected!r}")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{path}: {section}/{name}: found {text.strip()[:40]!r}, expected a number")
    return value


def _plain_unit(unit: str) -> str:
    return re.sub("[-^{} ]", "", unit).lower()
