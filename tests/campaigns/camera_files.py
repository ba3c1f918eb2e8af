"""The campaign of a camera's papers: SENSOR.toml, MTF tables, images of a point, results of EMVA 1288, damaged.

First come enemies made by hand, each with how it has to end: in one line that names what is wrong, or in a result.
Then the files of six cameras are mutated at random, and `curve`, `mtf`, `simulate`, `new` and `noise --emva` read
them: each case ends in a result whose numbers are finite, or in one line.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import damage
import numpy as np
from media import MEDIA
from mutations import TEXTS, Rng
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from camera_texts import DISPLAY, LENS, PHOTONS, PIXELS
from test_measured_optics import write_psf

from todframes.camera.emva_xml import emva_xml

LONGEST_S = 30.0
"""Longest time of an enemy on a machine with other work; a curve of one size takes a second."""

HEAD = 'schema = 1\nname = "camera"\n'

TABLE = "frequency_cyc_per_mm,mtf\n" + "".join(
    f"{f},{math.exp(-((f / 120) ** 2)):.4f}\n" for f in range(0, 301, 10)
)

TWO_DIRECTIONS = "frequency_cyc_per_mm,mtf_tangential,mtf_sagittal\n" + "".join(
    f"{f},{math.exp(-((f / 90) ** 2)):.4f},{math.exp(-((f / 110) ** 2)):.4f}\n" for f in range(0, 301, 20)
)

LINES = "row_noise_electrons = 0.5\ncolumn_pattern_electrons = 0.5\nframes_integrated = 2\n"

MOTION = "[motion]\nsmear_mrad = 0.1\njitter_sigma_mrad = 0.05\n"

MODELLED = LENS + "obscuration_ratio = 0.3\ndefocus_waves = 0.4\ntransmission = 0.9\n" + PIXELS + MOTION
WITH_TABLE = LENS + 'mtf = "mtf.csv"\n' + PIXELS
WITH_POINT = LENS + 'psf = "psf.tif"\npsf_pitch_um = 0.8\n' + PIXELS
THERMAL = '\n[noise]\ndistribution = "gaussian"\nnetd_mk = 50.0\ncouple_netd = true\n'

SENSORS = {
    "photons": HEAD + MODELLED + PHOTONS + LINES + DISPLAY,
    "measured MTF": HEAD + WITH_TABLE + PHOTONS + LINES + DISPLAY,
    "two directions": HEAD + WITH_TABLE.replace("mtf.csv", "two.csv") + THERMAL + DISPLAY,
    "image of a point": HEAD + WITH_POINT + PHOTONS + LINES + DISPLAY,
    "electrons": HEAD
    + MODELLED
    + PHOTONS.replace("luminance_cd_m2 = 1.0", "background_electrons = 40.0")
    + LINES
    + DISPLAY,
    "thermal": HEAD + MODELLED + THERMAL + DISPLAY,
}

EMVA_VALUES = {
    "QE": 60.0, "K": 0.4, "sigma_d": 2.5, "DSNU1288": 1.2, "PRNU1288": 0.6, "u_e_sat": 9000.0, "bits": 12,
    "exposure": 20.0, "u_I_mean": 30.0,
}  # fmt: skip

NEW = (
    "sensor_sim",
    "new",
    "--emva",
    "camera.xml",
    "--focal-length-mm",
    "25",
    "--f-number",
    "2.8",
    "--pitch-um",
    "3.45",
)
CURVE = ("sensor_sim", "curve", "SENSOR.toml", "--size-detectors", "4", "--tolerance", "0.1", "--quiet", "--json")
LIGHTS = ("--luminance", "0.1,10")
MTF = ("sensor_sim", "mtf", "SENSOR.toml", "--json")
SWEEP = (
    *("sensor_sim", "sweep", "SENSOR.toml", "--size-detectors", "4", "--tolerance", "0.2", "--quiet", "--json"),
    *("--vary", "optics.focal_length_mm=20:30:2"),
)


def simulate(text: str) -> tuple[str, ...]:
    """Return the command that draws frames of a camera, at levels of its kind."""
    level = ("--contrast", "2") if "photon" in text else ("--snr", "2")
    rest = ("--size-detectors", "2", *level, "--trials", "1", "--quiet", "-o", "simulated")
    return ("sensor_sim", "simulate", "SENSOR.toml", *rest)


# Enemies -------------------------------------------------------------------------------------------------------


class Enemy(NamedTuple):
    """A file that is wrong, or looks so, and what has to be said of it; `says` None: there is a result."""

    name: str
    says: str | None
    sensor: str = SENSORS["photons"]
    files: Mapping[str, bytes | str | NDArray[np.float64] | Callable[[Path], None]] = {}
    command: tuple[str, ...] = CURVE


def changed(sensor: str, *changes: tuple[str, str]) -> str:
    """Return a SENSOR.toml with some of its text replaced."""
    text = SENSORS[sensor]
    for before, after in changes:
        if before not in text:
            raise ValueError(f"{before!r} is not in the file of {sensor}")
        text = text.replace(before, after)
    return text


def rows(*pairs: tuple[object, object], unit: str = "mm") -> str:
    """Return a table of frequencies and MTF."""
    return f"frequency_cyc_per_{unit},mtf\n" + "".join(f"{one},{other}\n" for one, other in pairs)


def blob(shape: tuple[int, int] = (33, 33), *, sigma: float = 3.0, at: tuple[float, float] = (0.0, 0.0)) -> Any:
    """Return a Gaussian image of a point with the sum 1; `at` is its place right of and below the middle."""
    y, x = (np.arange(n) - (n - 1) / 2.0 for n in shape)
    found = np.exp(-0.5 * (((x[None] - at[0]) / sigma) ** 2 + ((y[:, None] - at[1]) / sigma) ** 2))
    return found / found.sum()


def with_value(value: float) -> Any:
    """Return an image of a point with one value replaced."""
    found = blob()
    found[16, 16] = value
    return found


def link_to(target: str) -> Callable[[Path], None]:
    """Return a function that makes a link."""
    return lambda path: path.symlink_to(target)


def _values(table: str, key: str, values: Mapping[str, str | None], sensor: str = "photons") -> list[Enemy]:
    """Return an enemy for each value of a key, with what has to be said."""
    (found,) = [line for line in SENSORS[sensor].splitlines() if line.startswith(f"{key} =")] or [f"[{table}]"]
    return [
        Enemy(
            f"{table}.{key} = {value}",
            says,
            SENSORS[sensor].replace(
                found, f"{key} = {value}" if not found.startswith("[") else f"{found}\n{key} = {value}", 1
            ),
        )
        for value, says in values.items()
    ]


def hostile() -> list[Enemy]:
    """Return the enemies that are made by hand."""
    out_of_range = {
        "0.0": "{}: found 0.0",
        "-1.0": "{}: found -1.0",
        "nan": "{}: found nan",
        "inf": "{}: found inf",
    }
    found: list[Enemy] = []
    for table, key in (
        ("noise", "exposure_ms"), ("noise", "full_well_electrons"), ("noise", "system_gain_dn_per_electron"),
        ("noise", "quantum_efficiency"), ("scene", "luminance_cd_m2"), ("optics", "f_number"),
        ("optics", "focal_length_mm"), ("optics", "wavelength_um"), ("detector", "pitch_um"),
        ("optics", "transmission"),
    ):  # fmt: skip
        found += _values(table, key, {value: says.format(key) for value, says in out_of_range.items()})
    for table, key in (
        ("noise", "dark_noise_electrons"), ("noise", "dark_current_electrons_per_s"), ("noise", "dsnu_electrons"),
        ("noise", "prnu_percent"), ("noise", "row_noise_electrons"), ("motion", "smear_mrad"),
        ("motion", "jitter_sigma_mrad"), ("optics", "defocus_waves"), ("optics", "obscuration_ratio"),
    ):  # fmt: skip
        found += _values(table, key, {"-1.0": f"{key}: found -1.0", "nan": f"{key}: found nan", "0.0": None})
    bits = {"0": "bits: found 0", "64": "bits: found 64", "2.5": "bits: found 2.5", "32": None}
    found += _values("noise", "bits", bits | {"1": "full_well_electrons: a pixel saturates at 2.5 electrons"})
    found += _values("optics", "obscuration_ratio", {"1.0": "obscuration_ratio: found 1.0", "0.99": None})
    found += _values("optics", "defocus_waves", {"21": "defocus_waves: found 21", "20.0": None})
    found += _values("noise", "prnu_percent", {"101": "prnu_percent: found 101", "100": None})
    found += _values("noise", "frames_integrated", {"0": "frames_integrated: found 0"})
    # Units off by a factor of 1,000: what is beyond all cameras is refused, the rest is computed.
    found += _values("noise", "exposure_ms", {"10000.0": "a shorter exposure", "1e-2": None, "1e-9": None})
    found += _values("noise", "full_well_electrons", {"10.0": "a pixel saturates at 10 electrons", "1e12": None})
    found += _values("noise", "system_gain_dn_per_electron", {"400.0": "a pixel saturates at 10.24", "4e-4": None})
    found += _values("scene", "luminance_cd_m2", {"1000.0": "less light", "1e-3": None, "1e-12": None})
    found += _values(
        "detector", "pitch_um", {"3450.0": "pitch", "3.45e-3": "optics.defocus_waves: found 0.4, which blurs by"}
    )
    found += _values(
        "optics", "focal_length_mm", {"25000.0": "motion.jitter_sigma_mrad: found 0.05", "0.025": None}
    )
    found += _values("motion", "smear_mrad", {"100.0": "smear_mrad: found 100"})
    found += _values("motion", "jitter_sigma_mrad", {"50.0": "jitter_sigma_mrad: found 50"})
    bright = changed(
        "photons",
        ("luminance_cd_m2 = 1.0", "luminance_cd_m2 = 1e12"),
        ("exposure_ms = 10.0", "exposure_ms = 1e9"),
        ("full_well_electrons = 10000.0\n", ""),
        ("bits = 12\n", ""),
    )
    many = changed("photons", ("frames_integrated = 2", "frames_integrated = 1000000000"))
    found += [
        Enemy("more electrons than a number holds, curve", "electrons", bright),
        Enemy("more electrons than a number holds, frames", "electrons", bright, command=simulate(bright)),
        Enemy("a billion frames, curve", "frames_integrated: found 1000000000", many),
        Enemy("a billion frames, frames", "frames_integrated: found 1000000000", many, command=simulate(many)),
        Enemy(
            "a billion frames of a thermal camera as clips",
            "frames_integrated: found 1000000000",
            changed("thermal", ("netd_mk", "frames_integrated = 1000000000\nnetd_mk")),
            command=(*simulate(SENSORS["thermal"]), "--motion", "1"),
        ),
    ]
    return found + _tables() + _points() + _results() + _asked()


def _tables() -> list[Enemy]:
    """Return the enemies among tables of an MTF."""
    sensor, secret = SENSORS["measured MTF"], "root:x:0:0:secret\nfrequency,mtf\n"
    long = rows(*((f"{n / 300:.6f}", f"{math.exp(-((n / 36000) ** 2)):.6f}") for n in range(90_000)))
    tables: dict[str, tuple[str | None, str]] = {
        "above 1": ("mtf 1.2 at 50, expected at most 1", rows((0, 1), (50, 1.2), (300, 0))),
        "in percent": ("mtf 100 at frequency 0, expected 1", rows((0, 100), (50, 60), (300, 0))),
        "negative": ("line 3: found mtf -0.1, expected 0 or more", rows((0, 1), (50, -0.1), (300, 0))),
        "NaN": ("line 3: mtf: found 'nan'", rows((0, 1), (50, "nan"), (300, 0))),
        "infinite": ("line 4: frequency_cyc_per_mm: found 'inf'", rows((0, 1), (50, 0.5), ("inf", 0))),
        "back": ("line 4: found frequency 40 after 50", rows((0, 1), (50, 0.5), (40, 0.4), (300, 0))),
        "twice": ("line 4: found frequency 50 after 50", rows((0, 1), (50, 0.5), (50, 0.4), (300, 0))),
        "negative frequency": ("line 2: found frequency -1", rows((-1, 1), (50, 0.5), (300, 0))),
        "one row": ("found 1 rows, expected at least two", rows((0, 1))),
        "no row": ("found 0 rows, expected at least two", rows()),
        "empty": ("mtf.csv: column 'frequency_cyc_per_pixel' is missing", ""),
        "stops early": ("ends at 50 with an MTF of 0.5", rows((0, 1), (50, 0.5))),
        "half at 0": ("found mtf 0.5 at frequency 0, expected 1", rows((0, 0.5), (300, 0))),
        "0.992 at 0": (None, rows((0, 0.992), (50, 0.8), (300, 0))),
        "starts late": (None, rows((10, 0.9), (300, 0))),
        "comes back": (None, rows((0, 1), (50, 0.1), (100, 0.6), (300, 0))),
        "two columns of frequency": ("found columns frequency_cyc_per_mrad and frequency_cyc_per_mm",
                                     "frequency_cyc_per_mm,frequency_cyc_per_mrad,mtf\n0,0,1\n300,3,0\n"),
        "one direction": ("column 'mtf_sagittal' is missing", "frequency_cyc_per_mm,mtf_tangential\n0,1\n300,0\n"),
        "frequencies of 0 and 5e-324": ("mtf", rows((0, 1), ("5e-324", 0))),
        "frequencies to 1e300": ("mtf", rows((0, 1), ("1e300", 0))),
        "1,000 times too fine": ("mtf", rows((0, 1), (120_000, 0.4), (300_000, 0))),
        "1,000 times too coarse": ("mtf", rows((0, 1), (0.12, 0.4), (0.3, 0))),
        "frequencies a hair apart": (None, rows((0, 1), (50, 0.9), (50 + 1e-13, 0.1), (300, 0))),
        "90,000 rows": (None, long),
        "200,000 rows": ("found more than 100000 rows", rows(*((n, 0.5) for n in range(200_000)))),
        "semicolons": ("found semicolons between the columns", "frequency_cyc_per_mm;mtf\n0;1\n"),
        "zeros": ("is missing", "\0" * 100),
        "0 but at 0": (None, rows((0, 1), (10, 0), (300, 0))),
    }  # fmt: skip
    found = [Enemy(f"table: {name}", says, sensor, {"mtf.csv": text}) for name, (says, text) in tables.items()]
    named = {
        "/etc/passwd": "lies outside", "../secret.csv": "lies outside", "folder": "is a folder",
        "none.csv": "no such file", "": "found ''", "mtf.csv\\u0000": "found 'mtf.csv",
        "SENSOR.toml": "is missing", "link.csv": "lies outside", "loop.csv": "", "dangling.csv": "",
        "pipe.csv": "is a pipe",
    }  # fmt: skip
    others: dict[str, Any] = {
        "../secret.csv": secret, "folder/a.csv": rows((0, 1), (300, 0)), "link.csv": link_to("../secret.csv"),
        "loop.csv": link_to("loop.csv"), "dangling.csv": link_to("nothing.csv"), "pipe.csv": os.mkfifo,
    }  # fmt: skip
    found += [
        Enemy(f"table named {name!r}", says, sensor.replace("mtf.csv", name), others)
        for name, says in named.items()
    ]
    inside = {"lens/mtf.csv": rows((0, 1), (300, 0)), "mtf.csv": link_to("lens/mtf.csv")}
    found.append(Enemy("table: a link inside the folder", None, sensor, inside))
    return found


def _points() -> list[Enemy]:
    """Return the enemies among images of a point."""
    sensor = SENSORS["image of a point"]
    two = blob()
    two[:, :5] = two[:, 28:] = 0.0
    images: dict[str, tuple[str | None, NDArray[np.float64]]] = {
        "NaN": ("NaN or infinite", with_value(math.nan)),
        "infinite": ("NaN or infinite", with_value(math.inf)),
        "negative": ("expected none below 0", with_value(-0.01)),
        "not normalised": ("has the sum 255, expected 1", 255.0 * blob()),
        "zeros": ("has the sum 0, expected 1", 0.0 * blob()),
        "off centre": ("centroid 5.0 samples right of and -2.0 below", blob(at=(5.0, -2.0))),
        "cut off": ("of its light in the outermost samples", blob(sigma=12.0)),
        "one sample": ("has the shape", np.ones((1, 1))),
        "a row": ("of its light in the outermost samples", blob((1, 33))),
        "too coarse": ("samples", blob(sigma=0.3)),
        "a single bright sample": ("samples", blob((3, 3), sigma=0.05)),
        "even sides": (None, blob((32, 34), at=(0.5, -0.5))),
        "denormal": ("has the sum", 1e-310 * np.ones((9, 9))),
        "2,048 wide": (None, blob((2048, 2048))),
        "2,049 wide": ("has the shape (2049, 5)", blob((2049, 5), sigma=0.5)),
    }
    found = [Enemy(f"point: {name}", says, sensor, {"psf.tif": values}) for name, (says, values) in images.items()]
    pitches = {"0.8e-3": "psf", "800.0": "psf", "0.0": "psf_pitch_um: found 0.0", "nan": "psf_pitch_um: found nan"}
    found += [
        Enemy(
            f"point: pitch {pitch}",
            says,
            sensor.replace("pitch_um = 0.8", f"pitch_um = {pitch}"),
            {"psf.tif": blob()},
        )
        for pitch, says in pitches.items()
    ]
    claimed = _claiming_tiff(60_000, 60_000)
    found += [
        Enemy("point: a claim of 14 GB", "psf.tif", sensor, {"psf.tif": claimed}),
        Enemy("point: cut", "psf.tif", sensor, {"psf.tif": _tiff(blob())[:900]}),
        Enemy("point: no image", "psf.tif", sensor, {"psf.tif": b"hello"}),
        Enemy("point: empty", "an empty file", sensor, {"psf.tif": b""}),
        Enemy("point: a film", "psf", sensor, {"psf.tif": _npy(np.stack([blob(), blob()]))}),
        Enemy("point: an array without frames", "psf", sensor, {"psf.tif": _npy(np.zeros((0, 9, 9)))}),
        Enemy(
            "point: a folder of images", "psf", sensor, {"psf.tif/a.tif": blob(), "psf.tif/b.npy": _npy(blob())}
        ),
        Enemy("point: outside", "lies outside", sensor.replace("psf.tif", "../psf.tif"), {"../psf.tif": blob()}),
        Enemy("point: colours", "one channel", sensor, {"psf.tif": _tiff(np.stack([blob()] * 3, axis=-1))}),
    ]
    return found


def _results() -> list[Enemy]:
    """Return the enemies among results of EMVA 1288."""
    good = emva_xml(EMVA_VALUES).decode()

    def leaf(name: str, value: str, unit: str | None = None) -> str:
        of_leaf = re.search(rf"<{name}>.*?</{name}>", good, re.DOTALL)
        assert of_leaf is not None
        changed_leaf = re.sub(r"<Value>.*?</Value>", f"<Value>{value}</Value>", of_leaf[0])
        if unit is not None:
            changed_leaf = re.sub(r"<Unit>.*?</Unit>|<Unit ?/>", f"<Unit>{unit}</Unit>", changed_leaf)
        return good.replace(of_leaf[0], changed_leaf)

    bombs = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(9))
    texts: dict[str, tuple[str | None, str]] = {
        "good": (None, good),
        "K of 0": ("sensitivity/K: found 0", leaf("K", "0")),
        "NaN": ("sensitivity/K: found 'nan'", leaf("K", "nan")),
        "1e999": ("sensitivity/u_e_sat: found '1e999'", leaf("u_e_sat", "1e999")),
        "no full well": ("sensitivity/u_e_sat: found 0", leaf("u_e_sat", "0")),
        "bits 0": ("bits: found 0", leaf("bits", "0")),
        "bits 64": ("bits: found 64", leaf("bits", "64")),
        "bits 1e300": ("bits", leaf("bits", "1e300")),
        "bits 12.4": ("bits", leaf("bits", "12.4")),
        "exposure of 0": ("exposure", leaf("exposure", "0")),
        "exposure in ns": ("info/exposure: found the unit 'ns', expected 'ms'", leaf("exposure", "2e7", "ns")),
        "exposure of 1e20": ("exposure", leaf("exposure", "1e20")),
        "QE of 6000 %": ("sensitivity/QE: found 60, expected", leaf("QE", "6000")),
        "QE as a share": (None, leaf("QE", "0.6")),
        "negative dark noise": ("sensitivity/sigma_d: found -1", leaf("sigma_d", "-1")),
        "negative dark current": (None, leaf("u_I_mean", "-3")),
        "PRNU of 1e9 %": ("prnu_percent: found", leaf("PRNU1288", "1e9")),
        "a comma": ("found '0,4'", leaf("K", "0,4")),
        "release 5": ("found '5.0', expected a release", leaf("release", "5.0")),
        "another root": ("begins with <emva>", good.replace("results>", "emva>")),
        "an entity that grows": ("has a document type", f"<!DOCTYPE r [{bombs}]><results>&a9;</results>"),
        "an outer entity": ("has a document type",
                            '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]><results>&e;</results>'),
        "deep": ("camera.xml", "<results>" + "<a>" * 200_000),
        "deep and closed": ("camera.xml", "<results>" + "<a>" * 200_000 + "</a>" * 200_000 + "</results>"),
        "an encoding that is not known": ("is no XML", good.replace("utf-8", "utf-800000")),
        "empty": ("is no XML", ""),
        "cut": ("is no XML", good[:300]),
        "UTF-16 without its mark": ("is no XML", good.encode("utf-16-be").decode("latin-1")),
        "no result": ("found no sensitivity/K", "<results/>"),
        "a value twice": (None, good.replace("<sensitivity>", "<sensitivity><K><Value>0.5</Value></K>")),
    }  # fmt: skip
    return [
        Enemy(f"EMVA: {name}", says, files={"camera.xml": text}, command=NEW)
        for name, (says, text) in texts.items()
    ]


def _asked() -> list[Enemy]:
    """Return the enemies on the command line."""
    thermal = ("sensor_sim", "new", "--thermal", "--netd-mk", "50", "--pitch-um", "12", "--f-number", "1")
    found = [
        Enemy(f"curve --luminance {value}", says, command=(*CURVE, "--luminance", value))
        for value, says in {
            "0": "luminance", "-1": "luminance", "nan": "luminance", "1,1": "found a value twice",
            "1e12": "expected at most 1e+12 together",
            "": "luminance", "1e-12": None, "1e-12,1,10": None, "100000,1": "less light",
        }.items()
    ]  # fmt: skip
    found += [
        Enemy(f"new {option} {value}", option.removeprefix("--").replace("-", "_"),
              command=(*thermal, *(() if "focal" in option else ("--focal-length-mm", "35")), option, value))
        for option in ("--focal-length-mm", "--f-number", "--pitch-um", "--netd-mk", "--wavelength-um")
        for value in ("0", "-1", "nan", "inf", "1e300")
    ]  # fmt: skip
    basler = ("sensor_sim", "new", "--preset", "emva_basler", "--focal-length-mm", "25", "--f-number", "2.8")
    found += [
        Enemy("new --preset without pitch", "pitch_um is missing: give --pitch-um", command=basler),
        Enemy("new --luminance 0", "luminance", command=(*basler, "--pitch-um", "6", "--luminance", "0")),
        Enemy("new --exposure-ms 0", "exposure_ms", command=(*basler, "--pitch-um", "6", "--exposure-ms", "0")),
        Enemy("new --name with an escape", None, command=(*basler, "--pitch-um", "6", "--name", 'a\x1b[31m\n"b')),
        Enemy(
            "new of two kinds", "expected one of --emva, --thermal and --preset", command=(*thermal, *basler[2:])
        ),
    ]
    return found


def _tiff(values: NDArray[np.float64]) -> bytes:
    import OpenImageIO as oiio

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.tif")
        if values.ndim == 2:
            write_psf(path, values)
        else:
            file = oiio.ImageOutput.create(str(path))
            file.open(str(path), oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], "float"))
            file.write_image(np.ascontiguousarray(values, dtype=np.float32))
            file.close()
        return path.read_bytes()


def _npy(values: NDArray[np.float64]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, "a.npy"), values.astype(np.float32))
        return Path(folder, "a.npy").read_bytes()


def _claiming_tiff(width: int, height: int) -> bytes:
    """Return a TIFF whose header claims other sides than its 33."""
    import struct

    content = _tiff(blob())
    for tag, side in ((256, width), (257, height), (278, height)):
        for kind, form in ((3, "<HHIHH"), (4, "<HHII")):
            old = struct.pack(form, tag, kind, 1, 33, *((0,) if kind == 3 else ()))
            content = content.replace(old, struct.pack(form, tag, kind, 1, side, *((0,) if kind == 3 else ())))
    return content


# Cases ---------------------------------------------------------------------------------------------------------


class Child(damage.Child):
    """The cases, in a folder of its own: first the enemies, then mutations."""

    def __init__(self, seed: int, folder: Path) -> None:
        self._seed, self._parent = seed, folder
        self._folder = folder / "camera"
        self._folder.mkdir()
        os.chdir(self._folder)
        self._runner = damage.Runner(folder)
        self._enemies = hostile()
        self._point = _tiff(blob())
        self._xml = emva_xml(EMVA_VALUES)
        texts = [*SENSORS.values(), TABLE, TWO_DIRECTIONS]
        self._others = [*(one.encode() for one in texts), self._xml, self._point]
        for name in SENSORS:
            self._write(SENSORS[name])
            for command in (CURVE, MTF, simulate(SENSORS[name]), NEW, SWEEP):
                if (ran := self._runner.run(*command)).status:
                    raise RuntimeError(f"{name}, {command}: {ran.err}")

    def run(self, number: int) -> damage.Outcome:
        """Run one case."""
        self._number = number
        outcome = super().run(number)
        if outcome.case.startswith("enemy") and outcome.seconds > LONGEST_S:
            return outcome._replace(ending=f"took more than {LONGEST_S:g} s, {outcome.ending}", is_fault=True)
        return outcome

    def _case(self, rng: Rng) -> tuple[str, tuple[str, bool, str]]:
        if self._number < len(self._enemies):
            return self._enemy(self._enemies[self._number])
        return self._mutated(rng)

    def _write(self, sensor: str, files: Mapping[str, Any] = {}) -> None:
        """Write the files of a case into the emptied folder; the secret lies beside it."""
        for path in self._folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        whole = {"mtf.csv": TABLE, "two.csv": TWO_DIRECTIONS, "psf.tif": self._point, "camera.xml": self._xml}
        for name, content in ({"SENSOR.toml": sensor} | whole | dict(files)).items():
            if any(other.startswith(f"{name}/") for other in files):
                continue  # a folder takes its place
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if name.startswith("../"):
                path.unlink(missing_ok=True)
            if callable(content):
                content(path)
            elif isinstance(content, np.ndarray):
                write_psf(path, content)
            else:
                path.write_bytes(content.encode() if isinstance(content, str) else content)

    def _enemy(self, enemy: Enemy) -> tuple[str, tuple[str, bool, str]]:
        self._write(enemy.sensor, enemy.files)
        case, ran = f"enemy: {enemy.name}", self._runner.run(*enemy.command)
        if ran.status:
            ending, is_fault, said = damage.judge_refusal(ran, enemy.says or "")
            if enemy.says is None:
                return case, (f"{ending}, but has a result", True, said)
            return case, (ending, is_fault or "secret" in said.replace("secret.csv", ""), said)
        ending, is_fault, said = judge_result(ran)
        return case, (
            ending if enemy.says is None else "accepted, but is wrong",
            is_fault or enemy.says is not None,
            said,
        )

    def _mutated(self, rng: Rng) -> tuple[str, tuple[str, bool, str]]:
        name = list(SENSORS)[rng.integers(len(SENSORS))]
        text = SENSORS[name]
        commands = [CURVE, MTF, simulate(text)]
        file, content, kinds = "SENSOR.toml", text.encode(), TEXTS
        is_measured = name in ("measured MTF", "two directions", "image of a point")
        if is_measured and rng.random() < 0.7:
            file = {"measured MTF": "mtf.csv", "two directions": "two.csv"}.get(name, "psf.tif")
            whole = {"mtf.csv": TABLE.encode(), "two.csv": TWO_DIRECTIONS.encode(), "psf.tif": self._point}
            content, kinds = whole[file], MEDIA if file == "psf.tif" else TEXTS
        elif not is_measured and rng.random() < 0.3:
            file, content, commands = "camera.xml", self._xml, [NEW]
        elif "photon" in text and rng.random() < 0.2:
            commands = [(*CURVE, *LIGHTS)] if "luminance" in text.partition("[display]")[0] else commands
        kind = list(kinds)[rng.integers(len(kinds))]
        mutated = kinds[kind](content, rng, self._others)
        self._write(text, {file: mutated})
        command = commands[rng.integers(len(commands))]
        ran = self._runner.run(*command)
        case = f"{file}, {command[1]}: {kind}, {name}"
        if not ran.status:
            return case, judge_result(ran)
        ending, is_fault, said = damage.judge_refusal(ran)
        if (self._folder / "simulated").exists():
            return case, ("refused, but something was written", True, said)
        return case, (ending, is_fault or mutated == content, said)


def judge_result(ran: damage.Ran) -> tuple[str, bool, str]:
    """Return the ending of a command that has succeeded; a number that is not finite or negative is a fault."""
    is_odd = any(not damage.ASIDE.match(line) for line in ran.err.splitlines())
    if not ran.out.startswith("{"):
        return "a result", is_odd, ran.err
    result = json.loads(ran.out, parse_constant=damage.refuse_constant)
    for fit in result.get("fits", ()):
        if fit["status"] != "ok":
            continue
        numbers = fit["threshold"], fit["threshold_numerical_error"], fit["p_correct_error_bound"]
        if not (numbers[0] > 0.0 and min(numbers[1:]) >= 0.0):
            return "a threshold or error that cannot be", True, str(numbers)
    return "a result", is_odd, ran.err


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as _folder:
        os.chdir(_folder)
        sys.exit(damage.main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), kind=Child))
