"""Results of EMVA 1288 as XML: the names and units of the public reference set, written and read.

The form is that of the result files beside the EMVA 1288 reference data sets: sections with leaves, and in each
leaf `Value`, `Unit` and `Symbol`. Leaves that are not known are ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from todframes.base._typing import Json
from todframes.base.errors import DataError
from todframes.base.reading import read_file

RELEASE = "4.0"
"""Release of the standard that the written results follow."""

KNOWN_RELEASES = ("3.", "4.")
"""Beginnings of the releases whose results have these names."""

MAX_XML_MB = 16

PERCENT = "%"


class Leaf(NamedTuple):
    """A quantity of a result: its unit, symbol and meaning."""

    unit: str
    symbol: str
    short: str


LEAVES: dict[str, dict[str, Leaf]] = {
    "info": {
        "release": Leaf("", "", "Release of EMVA 1288, linear"),
        "bits": Leaf("bit", "", "Bits of a pixel"),
        "exposure": Leaf("ms", "t_exp", "Exposure time of the spatial measurement"),
    },
    "sensitivity": {
        "QE": Leaf(PERCENT, r"\eta", "Quantum efficiency"),
        "R": Leaf("DN/p", "R", "Responsivity"),
        "K": Leaf("DN/e^-", "K", "Overall system gain"),
        "inverse_K": Leaf("e^-/DN", "1/K", "Inverse of the overall system gain"),
        "sigma_y_dark": Leaf("DN", r"\sigma_{y.dark}", "Temporal dark noise (DN)"),
        "sigma_d": Leaf("e^-", r"\sigma_d", "Temporal dark noise (electrons)"),
        "u_p_min": Leaf("p", r"\mu_{p.min}", "Absolute sensitivity threshold"),
        "u_p_sat": Leaf("p", r"\mu_{p.sat}", "Saturation capacity (photons)"),
        "u_e_sat": Leaf("e^-", r"\mu_{e.sat}", "Saturation capacity (electrons)"),
        "SNR_max": Leaf("", "SNR_{max}", "Maximum signal-to-noise ratio"),
        "SNR_max_dB": Leaf("dB", "SNR_{max.dB}", "Maximum signal-to-noise ratio in dB"),
        "SNR_max_bit": Leaf("bit", "SNR_{max.bit}", "Maximum signal-to-noise ratio in bits"),
        "DR": Leaf("", "DR", "Dynamic range"),
        "DR_dB": Leaf("dB", "DR_{dB}", "Dynamic range in dB"),
        "DR_bit": Leaf("bit", "DR_{bit}", "Dynamic range in bits"),
    },
    "linearity": {
        "LE_min": Leaf(PERCENT, "LE_{min}", "Smallest linearity error"),
        "LE_max": Leaf(PERCENT, "LE_{max}", "Largest linearity error"),
    },
    "spatial": {
        "sigma_2_y_stack": Leaf("DN^2", r"\sigma^2_{y.stack}", "Temporal variance of the bright stack"),
        "sigma_2_y_stack_dark": Leaf("DN^2", r"\sigma^2_{y.stack.dark}", "Temporal variance of the dark stack"),
        "s_2_y_measured": Leaf("DN^2", "s^2_{y.measured}", "Variance of the mean of the bright stack"),
        "s_2_y_measured_dark": Leaf("DN^2", "s^2_{y.measured.dark}", "Variance of the mean of the dark stack"),
        "s_2_y": Leaf("DN^2", "s^2_y", "Spatial variance of the bright stack"),
        "s_2_y_dark": Leaf("DN^2", "s^2_{y.dark}", "Spatial variance of the dark stack"),
        "DSNU1288": Leaf("e^-", "DSNU_{1288}", "Dark signal nonuniformity"),
        "DSNU1288_DN": Leaf("DN", "DSNU_{1288.DN}", "Dark signal nonuniformity (DN)"),
        "PRNU1288": Leaf(PERCENT, "PRNU_{1288}", "Photo response nonuniformity"),
    },
    "dark_current": {
        "u_I_mean": Leaf("e^-/s", r"\mu_{I.mean}", "Dark current from means"),
        "u_I_var": Leaf("e^-/s", r"\mu_{I.var}", "Dark current from variances"),
    },
}
"""Quantities of a result by section and name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmvaCamera:
    """A camera as results of EMVA 1288 describe it; None for what they do not state.

    The quantum efficiency is in electrons per photon, from 0 to 1. The dark current is from the means of dark
    frames; 0 where noise has made it negative. The four parts of rows and columns are what their pixels have in
    common in the dark, in a frame or in all: no parts of the dark noise and of the DSNU stated here. Results of
    EMVA 1288 do not have them. The exposure is that of the spatial measurement.
    """

    quantum_efficiency: float | None = None
    system_gain_dn_per_electron: float
    dark_noise_electrons: float
    dark_current_electrons_per_s: float | None = None
    dsnu_electrons: float | None = None
    prnu_percent: float | None = None
    row_noise_electrons: float | None = None
    column_noise_electrons: float | None = None
    row_pattern_electrons: float | None = None
    column_pattern_electrons: float | None = None
    full_well_electrons: float | None = None
    bits: int | None = None
    exposure_ms: float | None = None

    def noise_table(self) -> Json:
        """Return the table `[noise]` of a SENSOR.toml, with the keys that are known, in six digits."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        return {"model": "photon"} | {
            name: float(f"{value:.6g}") if isinstance(value, float) else value for name, value in known.items()
        }


def emva_xml(values: Mapping[str, float | int | None]) -> bytes:
    """Return the XML file of results, by the names in `LEAVES` and in their units, in UTF-8.

    Those that are None or missing are left out.
    """
    root = ElementTree.Element("results")
    for section, leaves in LEAVES.items():
        parent = ElementTree.SubElement(root, section)
        for name, (unit, symbol, short) in leaves.items():
            value = RELEASE if name == "release" else values.get(name)
            if value is None:
                continue
            leaf = ElementTree.SubElement(parent, name)
            texts = {"Short": short, "Symbol": f"${symbol}$" * bool(symbol)}
            texts |= {"Value": value if isinstance(value, str) else f"{value:.10g}", "Unit": unit}
            for key, text in texts.items():
                ElementTree.SubElement(leaf, key).text = text
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def read_emva_xml(path: Path) -> EmvaCamera:
    """Return the camera that a file of EMVA 1288 results describes.

    DataError if the file cannot be read, is of another release or form, or has a value that no camera has.
    """
    results = _results(path)
    values = {name: _number(path, results, section, name) for section, names in LEAVES.items() for name in names}
    gain, dark_noise = values["K"], values["sigma_d"]
    if gain is None and (inverse := values["inverse_K"]) is not None:
        gain = 1.0 / inverse if inverse > 0.0 else math.nan
    if gain is None or dark_noise is None:
        missing = "K" if gain is None else "sigma_d"
        raise DataError(f"{path}: found no sensitivity/{missing}, expected one; are these results of EMVA 1288?")
    efficiency, bits = values["QE"], values["bits"]
    if bits is not None and bits != round(bits):
        raise DataError(f"{path}: info/bits: found {bits:g}, expected a whole number")
    camera = EmvaCamera(
        system_gain_dn_per_electron=gain,
        dark_noise_electrons=dark_noise,
        quantum_efficiency=None if efficiency is None else efficiency / 100.0,
        dark_current_electrons_per_s=None if values["u_I_mean"] is None else max(values["u_I_mean"], 0.0),
        dsnu_electrons=values["DSNU1288"],
        prnu_percent=values["PRNU1288"],
        full_well_electrons=values["u_e_sat"],
        bits=None if bits is None else round(bits),
        exposure_ms=values["exposure"],
    )
    for name, value, most in (
        ("sensitivity/K", gain, math.inf),
        ("sensitivity/QE", camera.quantum_efficiency, 1.0),
        ("sensitivity/u_e_sat", camera.full_well_electrons, math.inf),
    ):
        if value is not None and not 0.0 < value <= most:
            of_percent = " up to 100 %" * (most == 1.0)
            raise DataError(f"{path}: {name}: found {value:g}, expected a number > 0{of_percent}")
    for name in ("sensitivity/sigma_d", "spatial/DSNU1288", "spatial/PRNU1288"):
        value = values[name.partition("/")[2]]
        if value is not None and value < 0.0:
            raise DataError(f"{path}: {name}: found {value:g}, expected a number of 0 or more")
    return camera


def _results(path: Path) -> ElementTree.Element:
    content = read_file(path, most_mb=MAX_XML_MB)
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
        if text and not text.startswith(KNOWN_RELEASES):
            raise DataError(
                f"{path}: info/{name}: found {text[:40]!r}, expected a release of EMVA 1288 from 3 to 4"
            )
    return root


def _number(path: Path, results: ElementTree.Element, section: str, name: str) -> float | None:
    """Return the number of a leaf in the unit of `LEAVES`; None if it is not there."""
    leaf = results.find(f"{section}/{name}")
    text = None if leaf is None else leaf.findtext("Value")
    if leaf is None or text is None or not text.strip() or name == "release":
        return None
    unit = (leaf.findtext("Unit") or "").strip().strip("$").replace("\\", "")
    wanted = LEAVES[section][name].unit
    if unit and wanted and _plain_unit(unit) != _plain_unit(wanted):
        raise DataError(f"{path}: {section}/{name}: found the unit {unit[:20]!r}, expected {wanted!r}")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{path}: {section}/{name}: found {text.strip()[:40]!r}, expected a number")
    return value


def _plain_unit(unit: str) -> str:
    return re.sub("[-^{} ]", "", unit).lower()
