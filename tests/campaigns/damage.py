"""The campaign of mutated files: each frame or settings file ends in the right result or in one clear line.

Cases run in a child process, many in each, because starting takes longer than a case. A case depends on the seed
and on its number alone. If a case ends its process, or takes too long, that is what is reported of it, and another
process goes on after it.
"""

from __future__ import annotations

import faulthandler
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scenes
from mutations import FRAMES, TEXTS

LONGEST_CASE_S = 120.0

LARGEST_MB = 968
"""Limit of the memory of a case: three times the largest frame that is decoded, 256 MB, and 200 MB."""

LONGEST_LINE = 8000

SHARE_OF_FRAMES = 0.6

LIBRARIES = r"libpng (?:error|warning): |\S+: (?:Unexpected end of file|data corrupted at \S+)$"

ASIDE = re.compile(rf"{LIBRARIES}|warning: |note: |skipped: ")
"""Pattern of lines on standard error that may stand beside the one error; the first are of libraries."""

FRAMES_OF = {
    "EXR, half": {"suffix": ".exr", "pixel_type": "half"},
    "EXR, float RGB": {"suffix": ".exr", "pixel_type": "float", "n_channels": 3, "compression": "piz"},
    "EXR, not compressed": {"suffix": ".exr", "pixel_type": "half", "compression": "none"},
    "EXR, DWA": {"suffix": ".exr", "pixel_type": "half", "compression": "dwaa"},
    "PNG, 16 bits": {"suffix": ".png", "pixel_type": "uint16"},
    "PNG, RGB of 8 bits": {"suffix": ".png", "pixel_type": "uint8", "n_channels": 3},
}


class Outcome(NamedTuple):
    """How a case ended: in words, and whether that is a fault; `said` is the last line of the command."""

    number: int
    case: str
    ending: str
    is_fault: bool
    said: str
    seconds: float
    peak_mb: float


class Ran(NamedTuple):
    """The end of a command."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class TextFile:
    """A settings file that is mutated, and the commands that read it."""

    path: str
    content: str
    commands: tuple[tuple[str, ...], ...]


SETTINGS = ("--set", "resamples=0")
SCORE = ("todframes", "score", "dataset", *SETTINGS, "--quiet", "--json")
SIMULATE = ("SENSOR.toml", "--size-detectors", "2", "--snr", "2", "--trials", "1", "--quiet", "-o", "simulated")
SENSOR = ("SENSOR.toml", "--size-detectors", "4", "--tolerance", "0.1", "--quiet", "--json")

TEXT_FILES = (
    TextFile("dataset/dataset.toml", scenes.DATASET_TOML, (SCORE,)),
    TextFile("dataset/dataset.toml", scenes.LOOK_UP_TOML, (SCORE,)),
    TextFile("dataset/lut.csv", scenes.LOOK_UP_CSV, (SCORE,)),
    TextFile("dataset/manifest.csv", "", (SCORE,)),
    TextFile(
        "observer.toml",
        scenes.OBSERVER_TOML,
        ((*SCORE, "--observer-settings", "observer.toml"),),
    ),
    TextFile("counts.csv", scenes.COUNTS_CSV, (("todframes", "fit", "counts.csv", *SETTINGS, "--json"),)),
    TextFile(
        "SENSOR.toml",
        (scenes.SAMPLES / "staring_camera.toml").read_text(encoding="utf-8"),
        (
            ("sensor_sim", "mtf", "SENSOR.toml", "--json"),
            ("sensor_sim", "curve", *SENSOR),
            ("sensor_sim", "simulate", *SIMULATE),
        ),
    ),
    TextFile("designs.csv", scenes.DESIGNS_CSV, (("sensor_sim", "sweep", *SENSOR, "--design", "designs.csv"),)),
)

WEIGHTS = (5, 2, 3, 6, 4, 3, 4, 1)
"""How often each of the text files is mutated; a sweep takes as long as fifty of the others."""


# The parent ----------------------------------------------------------------------------------------------------


def run_campaign(n: int, *, seed: int, first: int = 0, script: str = __file__) -> list[Outcome]:
    """Run cases `first` to `first + n − 1` of a script of cases, and return their outcomes."""
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as folder:
        while len(outcomes) < n:
            begun = first + len(outcomes)
            log = Path(folder, "log")
            log.unlink(missing_ok=True)
            child = subprocess.run(
                [sys.executable, script, str(seed), str(begun), str(first + n), str(log)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
                cwd=folder,
            )
            lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
            found = [Outcome(*json.loads(line)) for line in lines]
            outcomes += found
            for one in found:
                if one.is_fault:
                    print(f"FAULT {one}", flush=True)
            if len(outcomes) < n and child.returncode != RENEWED:
                lost = Outcome(
                    first + len(outcomes),
                    "a case that has ended its process",
                    f"ended with {child.returncode}",
                    True,
                    child.stderr[-3000:],
                    0.0,
                    0.0,
                )
                print(f"FAULT {lost}", flush=True)
                outcomes.append(lost)
    return outcomes


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the counts of cases by their kind and ending, and what they took at most."""
    counts = Counter((one.case.partition(":")[0], one.ending) for one in outcomes)
    lines = [f"{count:7}  {kind}: {ending}" for (kind, ending), count in sorted(counts.items())]
    slowest, largest = max(outcomes, key=lambda one: one.seconds), max(outcomes, key=lambda one: one.peak_mb)
    faults = sum(one.is_fault for one in outcomes)
    lines.append(f"{len(outcomes):7}  in all, {faults} faults")
    lines.append(f"slowest {slowest.seconds:.1f} s: {slowest.number} {slowest.case}")
    lines.append(f"largest {largest.peak_mb:.0f} MB: {largest.number} {largest.case}")
    return "\n".join(lines)


# The child -----------------------------------------------------------------------------------------------------


RENEWED = 99
"""Exit status of a child that leaves the rest to another one."""

CASES_PER_CHILD = 2000


class Runner:
    """Runs commands in this process; output is caught at the file descriptors, also that of native libraries."""

    def __init__(self, folder: Path) -> None:
        from sensor_sim.cli import cli as sensor_sim
        from todframes.cli.console import run
        from todframes.cli.main import cli as todframes

        self._run, self._commands = run, {"todframes": todframes, "sensor_sim": sensor_sim}
        self._files = [(folder / name).open("w+b", buffering=0) for name in ("stdout", "stderr")]
        for number, file in zip((1, 2), self._files, strict=True):
            os.dup2(file.fileno(), number)
        for name in ("stdout", "stderr"):
            setattr(sys, name, io.TextIOWrapper(getattr(sys, name).buffer, encoding="utf-8"))

    def run(self, package: str, *arguments: str) -> Ran:
        """Run a command to its end, whatever it is."""
        for file in self._files:
            os.truncate(file.fileno(), 0)
            os.lseek(file.fileno(), 0, os.SEEK_SET)
        status = self._run(self._commands[package], list(arguments))
        sys.stdout.flush()
        sys.stderr.flush()
        out, err = (os.pread(file.fileno(), 100_000_000, 0).decode(errors="replace") for file in self._files)
        return Ran(status, out, err)


class Child:
    """The cases, in a folder of its own.

    Parameters
    ----------
    seed : int
    folder : Path
        An empty folder, the present one.
    """

    largest_mb = LARGEST_MB

    def __init__(self, seed: int, folder: Path) -> None:
        self._seed, self._folder = seed, folder
        self._frames = {}
        for name, kind in FRAMES_OF.items():
            for is_checked in (False, True):
                path = folder / f"{len(self._frames)}"
                self._frames[name, is_checked] = path, scenes.write_dataset(path, with_sha256=is_checked, **kind)
        scenes.write_dataset(folder / "dataset")
        (folder / "dataset" / "lut.csv").write_text(scenes.LOOK_UP_CSV, encoding="utf-8")
        for file in TEXT_FILES:
            if file.content and not file.path.startswith("dataset/"):
                (folder / file.path).write_text(file.content, encoding="utf-8")
        self._runner = Runner(folder)
        for command in (command for file in TEXT_FILES for command in file.commands):
            if (ran := self._runner.run(*command)).status:
                raise RuntimeError(f"{command}: {ran.err}")
        shutil.rmtree(folder / "simulated")
        self._right: dict[str, Any] = {}
        self._other_frames = [
            (path / names[3]).read_bytes() for path, names in self._frames.values()
        ] + _other_formats()
        self._other_texts = [file.content.encode() or self._manifest for file in TEXT_FILES]

    @property
    def _manifest(self) -> bytes:
        return (self._folder / self._frames["EXR, half", True][0] / "manifest.csv").read_bytes()

    def run(self, number: int) -> Outcome:
        """Run one case."""
        rng = np.random.default_rng([self._seed, number])
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # count the peak of memory anew
        faulthandler.dump_traceback_later(LONGEST_CASE_S, exit=True)
        started = time.perf_counter()
        case = "?"
        try:
            case, judged = self._case(rng)
            ending, is_fault, said = judged
        except BaseException as error:
            ending, is_fault, said = f"raised {type(error).__name__}", True, _traceback(error)
        faulthandler.cancel_dump_traceback_later()
        seconds, peak_mb = time.perf_counter() - started, _peak_mb()
        if peak_mb > self.largest_mb:
            ending, is_fault = f"took more than {self.largest_mb} MB, {ending}", True
        return Outcome(number, case, ending, is_fault, said, seconds, peak_mb)

    def _case(self, rng: np.random.Generator) -> tuple[str, tuple[str, bool, str]]:
        return self._frame(rng) if rng.random() < SHARE_OF_FRAMES else self._text(rng)

    def _frame(self, rng: np.random.Generator) -> tuple[str, tuple[str, bool, str]]:
        name = list(FRAMES_OF)[rng.integers(len(FRAMES_OF))]
        is_checked = bool(rng.random() < 0.5)
        path, frames = self._frames[name, is_checked]
        if str(path) not in self._right:
            self._right[str(path)] = _fits(self._runner.run("todframes", *_score(path)).out)
        kind = list(FRAMES)[rng.integers(len(FRAMES))]
        frame = path / frames[rng.integers(len(frames))]
        whole = frame.read_bytes()
        mutated = FRAMES[kind](whole, rng, self._other_frames)
        how = rng.random()
        case = f"frame, {name.partition(',')[0]}{' with sha256' if is_checked else ''}: {kind}"
        frame.unlink()
        frame.write_bytes(mutated)
        try:
            if how < 0.15:
                ran = self._runner.run("todframes", "validate", str(path))
                judged = _judge_validate(ran, frame, may_pass=not is_checked or mutated == whole)
            else:
                skips = ("--on-error", "skip") if how < 0.35 else ()
                ran = self._runner.run("todframes", *_score(path), *skips)
                judged = _judge_frame(
                    ran, frame, self._right[str(path)], is_same=mutated == whole, is_checked=is_checked
                )
        finally:
            frame.unlink()
            frame.write_bytes(whole)
        return case, judged

    def _text(self, rng: np.random.Generator) -> tuple[str, tuple[str, bool, str]]:
        weights = np.array(WEIGHTS) / sum(WEIGHTS)
        file = TEXT_FILES[rng.choice(len(TEXT_FILES), p=weights)]
        path = self._folder / file.path
        before = {one: one.read_bytes() for one in (path, self._folder / "dataset/dataset.toml")}
        kind = list(TEXTS)[rng.integers(len(TEXTS))]
        if path.name == "lut.csv":
            (self._folder / "dataset/dataset.toml").write_text(scenes.LOOK_UP_TOML, encoding="utf-8")
        content = file.content.encode() or before[path]
        mutated = TEXTS[kind](content, rng, self._other_texts)
        for _ in range(rng.integers(3)):  # some have several faults
            if len(mutated) > 20:
                with suppress(ValueError):  # nothing is left that this could change
                    mutated = list(TEXTS.values())[rng.integers(len(TEXTS))](mutated, rng, self._other_texts)
        path.write_bytes(mutated)
        command = file.commands[rng.integers(len(file.commands))]
        try:
            judged = _judge_text(self._runner.run(*command), is_same=mutated == content)
            simulated = self._folder / "simulated"
            if simulated.exists():
                if judged[0].startswith("refused"):
                    judged = "refused, but something was written", True, judged[2]
                shutil.rmtree(simulated)
        finally:
            for one, whole in before.items():
                one.write_bytes(whole)
        return f"{path.name}: {kind}, {command[1]}", judged


def _score(path: Path) -> tuple[str, ...]:
    return ("score", str(path), "--set", "resamples=0", "--json")


def _fits(out: str) -> Any:
    return scenes.without_times(json.loads(out)["fits"])


def _judge_frame(ran: Ran, frame: Path, right: Any, *, is_same: bool, is_checked: bool) -> tuple[str, bool, str]:
    """Return the ending, whether it is a fault, and what was said."""
    if ran.status:
        return judge_refusal(ran, str(frame))
    result = json.loads(ran.out)
    if skipped := result["skipped"]:
        is_named = [one["frame"] for one in skipped] == [f"frames/{frame.name}"]
        return "skipped and named", not is_named or is_same, str(skipped)
    if is_same or scenes.without_times(result["fits"]) == right:
        return "the same numbers", is_checked and not is_same, ran.err
    if is_checked:
        return "other numbers in spite of a checksum", True, ran.err
    if frame.suffix == ".exr" or frame.read_bytes()[:4] == b"\x76\x2f\x31\x01":
        is_told = any(one["code"] == "unverified_frames" for one in result["warnings"])
        return "other numbers, with the warning unverified_frames", not is_told, ran.err
    return "another picture, whose own checksums are right", False, ran.err


def _judge_validate(ran: Ran, frame: Path, *, may_pass: bool) -> tuple[str, bool, str]:
    errors = [line for line in ran.err.splitlines() if line.startswith("error: ")]
    if ran.status == 0:
        return "validate found no error", bool(errors) or not may_pass, ran.err
    is_told = ran.status == 1 and any(str(frame) in line for line in errors) and "Traceback" not in ran.err
    return "validate named it", not is_told, ran.err


def judge_refusal(ran: Ran, wanted: str = "") -> tuple[str, bool, str]:
    lines = [line for line in ran.err.splitlines() if not ASIDE.match(line)]
    is_clear = (
        len(lines) == 1
        and re.match(r"error: .*\w", lines[0]) is not None
        and wanted in lines[0]
        and len(lines[0]) <= LONGEST_LINE + 20
        and lines[0].isprintable()
        and not ran.out
        and ran.status in (1, 2)
        and "out of memory" not in lines[0]
    )
    return ("refused in one line" if is_clear else "refused, but not in one clear line"), not is_clear, ran.err


def _judge_text(ran: Ran, *, is_same: bool) -> tuple[str, bool, str]:
    if ran.status:
        ending, is_fault, said = judge_refusal(ran)
        return ending, is_fault or is_same, said
    others = [line for line in ran.err.splitlines() if not ASIDE.match(line)]
    if ran.out.startswith("{"):
        json.loads(ran.out, parse_constant=refuse_constant)
    return "a result", bool(others), ran.err


def refuse_constant(name: str) -> None:
    raise ValueError(f"the JSON holds {name}")


def _peak_mb() -> float:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return 0.0


def _traceback(error: BaseException) -> str:
    import traceback

    return "".join(traceback.format_exception(error))[-3000:]


def _other_formats() -> list[bytes]:
    import cv2

    picture = (np.random.default_rng(1).random((32, 32)) * 255).astype(np.uint8)
    suffixes = (".jpg", ".tiff", ".bmp", ".webp", ".pgm", ".jp2")
    found = [cv2.imencode(suffix, picture)[1].tobytes() for suffix in suffixes]
    return [*found, b"GIF89a" + bytes(100), b"PK\3\4" + bytes(100), b"%PDF-1.7\n", b"SIMPLE  =" + bytes(100)]


def main(seed: int, first: int, stop: int, log: Path, *, kind: type[Child] = Child) -> int:
    """Run cases of a kind and write their outcomes, a line each."""
    from todframes.cli.console import keep_libraries_to_one_thread

    keep_libraries_to_one_thread()
    faulthandler.enable(os.fdopen(os.dup(2), "w"))
    last = min(stop, first + CASES_PER_CHILD)
    child = kind(seed, Path.cwd())
    with log.open("w", encoding="utf-8") as file:
        for number in range(first, last):
            file.write(json.dumps(child.run(number)) + "\n")
            file.flush()
    return RENEWED if last < stop else 0


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as _folder:
        os.chdir(_folder)
        sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])))
