"""The description of a folder of answers, as Psych-DS 1.5 asks for it: `dataset_description.json`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec

from todframes.base._typing import Json
from todframes.base.output import write_file
from todframes.experiment.answers import ShownDataset, columns

DESCRIPTION_FILE = "dataset_description.json"

DESCRIPTIONS: Mapping[str, tuple[str, str | None]] = {
    "trial": ("Number of the trial in its session, from 1; practice trials count", None),
    "phase": ("practice: with feedback, does not count; main: without", None),
    "frame": ("Path of the trial's first frame in the dataset that was shown", None),
    "sha256": ("SHA-256 of the file of the frame; of several frames, of the lines of their checksums", None),
    "orientation": ("Where the apex of the triangle points: up, right, down or left", None),
    "response": ("What the person said; none: the time limit passed", None),
    "correct": ("1 if the response is the orientation, otherwise 0", None),
    "response_time_ms": ("Time from the picture to the response, as the browser measured it", "ms"),
    "flag": (
        "hidden, unfocused: the page was not seen, or had lost the focus, during the trial; too_fast: the "
        "response came within 150 ms; empty: none of them. Flagged answers do not count",
        None,
    ),
    "size_mrad": (
        "Square root of the triangle's area on the dataset's display; at the person's eye it is this times the "
        "monitor's pixel_pitch_mrad (sidecar) over the dataset's",
        "mrad",
    ),
    "dither_seed": ("Place of the dither pattern; with the frame and the monitor it gives each pixel", None),
    "clipped_px": ("Number of pixels that the monitor could not show", None),
    "shown_at": ("Time at which the page asked for the trial, ISO 8601, UTC", None),
}
"""Descriptions and units of the columns of a data file."""


def write_description(folder: Path, shown: ShownDataset, software: Mapping[str, str]) -> None:
    """Write the description into a folder of answers, JSON-LD with the terms of schema.org.

    Columns named by the dataset that have no description here are the level or one of the groups. Raises
    OutputError if it cannot be written.
    """
    others = {
        shown.level: ("Stimulus strength: the level of the dataset that was shown", None),
        **dict.fromkeys(shown.group_by, ("Group of the dataset that was shown: a curve each", None)),
    }
    variables = []
    for name in columns(shown.level, shown.group_by):
        text, unit = DESCRIPTIONS.get(name) or others[name]
        variables.append(
            {"@type": "PropertyValue", "name": name, "description": text} | ({"unitText": unit} if unit else {})
        )
    description: Json = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": "Answers of people in a Triangle Orientation Discrimination test",
        "description": (
            "Trials of people who said where triangles point, a file a session. The file of the same name that "
            "ends in .json has the calibration of the monitor, the text of consent and the settings. People have "
            "anonymous ids."
        ),
        "schemaVersion": "Psych-DS 1.5.0",
        "variableMeasured": variables,
        "measurementTechnique": (
            "Four-alternative forced choice (Hogervorst, Bijl & Valeton 2001) on a calibrated monitor, with "
            + ", ".join(f"{name} {version}" for name, version in software.items())
        ),
    }
    content = msgspec.json.format(msgspec.json.encode(description), indent=2)
    write_file(folder / DESCRIPTION_FILE, content + b"\n", is_private=True)
