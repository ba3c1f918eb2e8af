"""The campaign of decoys: a working folder has a module for each name that may be imported, and settings of plots.

A command that runs there executes none of them, in any of its processes, and writes the bytes that it writes
elsewhere. Modules that it names as MODULE:FUNCTION or MODULE:CLASS lie beside the decoys and are found.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import NamedTuple

import scenes

LONGEST_S = 300.0

SERVED_S = 5.0
"""Time in which the processes of a server start."""

BIN = Path(sys.executable).parent

REGISTERED = "registered_decoy"
"""Module that the metadata of a package in the folder names for everything that packages may register."""

ENTRY_POINTS = """\
[todframes.observers]
pyramid = {0}:decoy
[todframes.enhancements]
clahe = {0}:decoy
[fsspec.specs]
file = {0}:decoy
[dask.sizeof]
decoy = {0}:decoy
[dask.array.backends]
numpy = {0}:decoy
[distributed.comm.backends]
tcp = {0}:decoy
[matplotlib.backend]
agg = {0}:decoy
"""

MATPLOTLIBRC = (
    "text.usetex: True\naxes.facecolor: red\nfont.size: 30\npath.sketch: 1, 100, 2\nlines.linewidth: 9\n"
)

OWN = """\
from own_helper import half
from todframes.observers.pyramid import PyramidObserver

class Mine(PyramidObserver):
    pass

def soft(image):
    return image * half() + image * half()
"""


class Case(NamedTuple):
    """A command line, with OUT for the place where it writes, and what ends a server; None for other commands."""

    name: str
    arguments: tuple[str, ...]
    ready: str | None = None


def names() -> list[str]:
    """Return the names of all modules of the standard library, of any platform, and of installed packages."""
    installed = {name for name in packages_distributions() if name.isidentifier()}
    return sorted(sys.stdlib_module_names | installed | {"sitecustomize", "usercustomize", REGISTERED})


def write_decoys(folder: Path, log: Path) -> int:
    """Write decoys that add their name to a log when they are executed. Returns the number of modules."""
    for name in names():
        (folder / f"{name}.py").write_text(
            f"with open({str(log)!r}, 'a') as log:\n    log.write({name!r} + '\\n')\nraise ImportError('decoy')\n",
            encoding="utf-8",
        )
    metadata = folder / "decoys-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: decoys\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS.format(REGISTERED), encoding="utf-8")
    (folder / "matplotlibrc").write_text(MATPLOTLIBRC, encoding="utf-8")
    return len(names())


def cases(data: Path) -> list[Case]:
    """Return a command for each way to start processes, and those that draw."""
    dataset, sensor = str(data / "dataset"), str(scenes.SAMPLES / "star_like.toml")
    score = ("todframes", "score", dataset, "-o", "OUT", "--quiet")
    compare = ("todframes", "compare", dataset, "-o", "OUT", "--quiet", "--enhance", "clahe")
    own = ("--enhance", "own:soft", "--observer", "own:Mine")
    sweep = ("sensor-sim", "sweep", sensor, "--vary", "optics.aperture_mm=100:200:4", "--size-detectors", "4,6")
    sweep += ("--tolerance", "0.05", "--quiet", "-o", "OUT")
    simulate = ("sensor-sim", "simulate", sensor, "--size-detectors", "3", "--snr", "2", "--trials", "4")
    simulate += ("--quiet", "-o", "OUT")
    chart = ("todframes", "chart", "--for", "print", "--distance-m", "4", "--sizes-mrad", "4,8", "-o", "OUT")
    return [
        Case("score, two workers", (*score, "--workers", "2")),
        Case("score, local:2", (*score, "--cluster", "local:2")),
        Case("score, own observer, two workers", (*score, "--observer", "own:Mine", "--workers", "2")),
        Case("score, own observer, local:2", (*score, "--observer", "own:Mine", "--cluster", "local:2")),
        Case("compare, two workers", (*compare, "--workers", "2")),
        Case("compare, own algorithm and observer, two workers", (*compare, *own, "--workers", "2")),
        Case("compare, own algorithm and observer, local:2", (*compare, *own, "--cluster", "local:2")),
        Case("sweep, two workers", (*sweep, "--workers", "2")),
        Case("sweep, own observer, two workers", (*sweep, "--observer", "own:Mine", "--workers", "2")),
        Case("sweep, local:2", (*sweep, "--cluster", "local:2")),
        Case("simulate, two workers", (*simulate, "--workers", "2", "--stages")),
        Case("simulate, local:2", (*simulate, "--cluster", "local:2")),
        Case("mtf", ("sensor-sim", "mtf", sensor, "-o", "OUT")),
        Case("chart", chart),
        Case("explore", ("sensor-sim", "explore", sensor, "--no-browser"), ready="http://"),
        Case("experiment", ("todframes", "experiment", dataset, "-o", "OUT", "--no-browser"), ready="http://"),
    ]


def campaign(*, only: str = "") -> tuple[int, int, list[str]]:
    """Run the cases whose name has a part. Returns the number of cases, that of decoys, and a line a fault."""
    with tempfile.TemporaryDirectory(prefix="decoys-") as name:
        data = Path(name)
        scenes.write_dataset(data / "dataset", contrasts=(0.05, 0.1, 0.3), repeats=2)
        log = data / "log"
        plain, decoys = data / "plain", data / "decoys"
        for folder in (plain, decoys):
            folder.mkdir()
            (folder / "own.py").write_text(OWN, encoding="utf-8")
            (folder / "own_helper.py").write_text("def half():\n    return 0.5\n", encoding="utf-8")
        n_decoys = write_decoys(decoys, log)
        chosen = [case for case in cases(data) if only in case.name]
        found = [fault for case in chosen for fault in _faults(case, plain, decoys, log)]
    return len(chosen), n_decoys, found


def _faults(case: Case, plain: Path, decoys: Path, log: Path) -> list[str]:
    """Run a case in both folders. Returns a line for each fault."""
    log.unlink(missing_ok=True)
    place = plain.parent / "outs" / case.name.replace(" ", "_")
    ends = [_run(case, folder, place / folder.name) for folder in (plain, decoys)]
    executed = sorted(set(log.read_text(encoding="utf-8").split())) if log.exists() else []
    faults = []
    if executed:
        faults.append(f"{case.name}: {len(executed)} decoys were executed: {' '.join(executed[:20])}")
    for folder, (status, err) in zip((plain, decoys), ends, strict=True):
        if status:
            faults.append(f"{case.name}: in {folder.name}, status {status}: {err[-300:]!r}")
    if not faults and case.ready is None and _content(place / "plain") != _content(place / "decoys"):
        faults.append(f"{case.name}: the files differ from those that are written elsewhere")
    return faults


def _content(out: Path) -> object:
    return scenes.content(out) if out.is_dir() else out.read_bytes()


def _run(case: Case, folder: Path, out: Path) -> tuple[int, str]:
    """Run a case in a folder. Returns its status and what it has printed on standard error."""
    out.parent.mkdir(parents=True, exist_ok=True)
    command = [str(BIN / case.arguments[0]), *(str(out) if one == "OUT" else one for one in case.arguments[1:])]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    with (
        tempfile.TemporaryFile() as err,
        subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=err) as process,
    ):
        assert process.stdout is not None
        if case.ready is not None:
            for line in process.stdout:
                if case.ready in line.decode():
                    break
            time.sleep(SERVED_S)
            process.send_signal(signal.SIGTERM)
        process.communicate(timeout=LONGEST_S)
        err.seek(0)
        status = process.returncode if case.ready is None or process.returncode != 130 else 0
        return status, err.read().decode(errors="replace")
