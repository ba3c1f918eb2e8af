"""Damage files of every kind at random: each command ends in a right result or in one clear line; half an hour.

python tests/campaigns/fuzz.py 10000                     # frames, settings, tables, recordings, papers of a camera
python tests/campaigns/fuzz.py 500 --only frame          # cases whose name has this text
python tests/campaigns/fuzz.py 1 --seed 2 --first 4711   # repeat a case

A case ends well in a result of finite numbers, or in one line on standard error, with status 1 or 2 and nothing
written. A frame with a checksum has the same numbers, or is refused; an EXR without it may have other numbers with
the warning `unverified_frames`, a PNG with right checksums another picture. All else is a fault: a traceback, a
signal, more than 1800 MB, more than 120 s of CPU time. Each case runs in a process of its own, and depends on seed
and number alone.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import chdir, suppress
from importlib import import_module
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scenes
from click.testing import CliRunner

from sensor_sim.cli import cli as sensor_sim
from todframes.cli.console import run
from todframes.cli.main import cli as todframes

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), *(str(TESTS / room) for room in ("chain", "frames", "recordings"))]

COMMANDS = {"todframes": todframes, "sensor_sim": sensor_sim}
LONGEST_CASE_S, MOST_MB, LONGEST_LINE = 120, 1800, 8020
ASIDE = re.compile(
    r"libpng (?:error|warning): |\S+: (?:Unexpected end of file|data corrupted at )|warning: |note: |skipped: "
)
"""Pattern of lines on standard error that may stand beside the one error; the first are of libraries."""

Rng = np.random.Generator
Others = Sequence[bytes]


def flip_bits(content: bytes, rng: Rng, _: Others) -> bytes:
    values = np.frombuffer(content, np.uint8).copy()
    for place in rng.integers(len(values) * 8, size=rng.integers(1, 17)):
        values[place // 8] ^= 1 << (place % 8)
    return values.tobytes()


def truncate(content: bytes, rng: Rng, _: Others) -> bytes:
    return content[: rng.integers(len(content))]


def fill_range(content: bytes, rng: Rng, _: Others) -> bytes:
    """Set a range of bytes to one value; often 512 bytes long, a sector of a disk."""
    begin = int(rng.integers(len(content)))
    end = min(begin + (512 if rng.random() < 0.5 else int(rng.integers(1, 5000))), len(content))
    value = int(rng.choice([0, 255, rng.integers(256)]))
    return content[:begin] + bytes([value]) * (end - begin) + content[end:]


def insert_bytes(content: bytes, rng: Rng, _: Others) -> bytes:
    """Insert or drop some bytes."""
    begin, length = int(rng.integers(len(content))), int(rng.integers(1, 100))
    inserted, end = (rng.bytes(length), begin) if rng.random() < 0.5 else (b"", begin + length)
    return content[:begin] + inserted + content[end:]


def other_number(content: bytes, rng: Rng, _: Others) -> bytes:
    """Replace a number of one, two or four bytes near the head: most are sizes, offsets or counts."""
    n = int(rng.choice([1, 2, 4]))
    place = int(rng.integers(max(min(len(content), 4096) - n, 1)))
    value = (int(2 ** rng.uniform(0, 8 * n)) - 1).to_bytes(n, "little" if rng.random() < 0.5 else "big")
    return content[:place] + value + content[place + n :]


def splice_files(content: bytes, rng: Rng, others: Others) -> bytes:
    """Take the first part of a file and the second part of another; or all of another, of any format."""
    other = others[rng.integers(len(others))]
    if rng.random() < 0.3:
        return other
    return content[: rng.integers(len(content))] + other[rng.integers(len(other)) :]


EXTREME = (
    *("nan", "inf", "-inf", "-1", "0", "-0.0", "1e308", "1e-308", "5e-324", "1e999", "1" + "0" * 30, "9" * 5000),
    *("true", '""', '"x"', "[]", "[1, 2]", "{}", "1979-05-27", "0x7fffffff", "1_000", "٣", "½", "1,5", "=1+1"),
    *("''", '"\\u0000"', '"\\u001b[31m"', "#", "100000", "1000000000", "0.001", "up", "-", "../../etc/passwd"),
)


def change_value(content: bytes, rng: Rng, _: Others) -> bytes:
    """Replace a number or word by an extreme one, or multiply a number by a power of ten."""
    words = list(re.finditer(rb"[\w.+-]+|\"[^\"\n]*\"", content)) or [re.search(rb"", content)]
    word = words[rng.integers(len(words))]
    value = EXTREME[rng.integers(len(EXTREME))]
    if rng.random() < 0.5 and re.fullmatch(rb"-?\d+\.?\d*", word[0]):
        value = f"{float(word[0]) * rng.choice([-1.0, 10.0 ** rng.integers(-12, 13)]):g}"
    return content[: word.start()] + value.encode() + content[word.end() :]


def change_lines(content: bytes, rng: Rng, others: Others) -> bytes:
    """Drop, repeat, swap or take over lines."""
    lines, strange = content.splitlines(keepends=True), others[rng.integers(len(others))].splitlines(keepends=True)
    place, other = (int(value) for value in rng.integers(len(lines), size=2))
    ways = ([], [lines[place]] * 3, [lines[other]], [strange[0], lines[place]])
    lines[place : place + 1] = ways[rng.integers(4)]
    return b"".join(lines)


def strange_letters(content: bytes, rng: Rng, _: Others) -> bytes:
    """Misspell a word, or put in what is no UTF-8, control characters, a byte order mark or deep nesting."""
    place = int(rng.integers(len(content)))
    texts = ("\0", "\x1b[31m", "\r", "\ufeff", "\u202e", "[" * 100, '"', "\n\n", "x")
    put_in = [b"\xff", *(text.encode() for text in texts)]
    if rng.random() < 0.1:
        return content.decode(errors="replace").encode("utf-16")
    return content[:place] + put_in[rng.integers(len(put_in))] + content[place + int(rng.integers(2)) :]


BYTES = (flip_bits, truncate, fill_range, insert_bytes, other_number, splice_files)
TEXT = (change_value, change_value, change_value, change_lines, change_lines, strange_letters, *BYTES)


class Target(NamedTuple):
    """A file that is damaged, the commands that read it, and what their message has to name.

    `right` are the fits of a dataset, if the file is a frame; `is_checked` tells whether it has a checksum.
    """

    name: str
    path: Path
    commands: tuple[tuple[str, ...], ...]
    mutations: tuple[Callable[[bytes, Rng, Others], bytes], ...]
    right: Any = None
    is_checked: bool = False


QUICK = ("--set", "resamples=0", "--json", "--quiet")
CURVE = ("--size-detectors", "4", "--tolerance", "0.1", "--json", "--quiet")
KINDS: dict[str, dict[str, Any]] = {
    "EXR, half": {"pixel_type": "half"},
    "EXR, float RGB": {"pixel_type": "float", "n_channels": 3, "compression": "piz"},
    "EXR, not compressed": {"pixel_type": "half", "compression": "none"},
    "EXR, DWA": {"pixel_type": "half", "compression": "dwaa"},
    "PNG, 16 bits": {"suffix": ".png", "pixel_type": "uint16"},
    "PNG, RGB of 8 bits": {"suffix": ".png", "pixel_type": "uint8", "n_channels": 3},
}


def recordings(folder: Path) -> None:
    """Write a small recording of every kind, by PyAV, OpenImageIO, NumPy, and by hand."""
    import test_recorded_video as videos
    import test_recordings as stills

    rng = np.random.default_rng(1)
    counts = rng.integers(1, 60_000, (5, 48, 70)).astype(np.uint16)
    smooth = stills.scene(5, (48, 70))
    for name in ("ffv1.mkv", "ffv1.avi", "ffv1.nut"):
        videos.encode(folder / name, [[one] for one in counts], "gray16le")
    colour = [[(one >> 8).astype(np.uint8)] * 3 for one in counts]
    for name in ("h264.mp4", "h264.ts"):
        videos.encode(folder / name, colour, "yuv444p", codec="libx264")
    np.save(folder / "a.npy", counts)
    np.savez_compressed(folder / "deflated.npz", counts)
    for name in ("a.tif", "a.dpx", "a.jp2", "a.ppm"):
        stills.write_image(folder / name, rng.integers(0, 65536, (128, 160, 3)).astype(np.uint16))
    stills.write_image(folder / "a.jpg", rng.integers(0, 256, (128, 160, 3)).astype(np.uint8))
    (folder / "a.fff").write_bytes(stills.fff(counts[0]))
    (folder / "a.seq").write_bytes(stills.seq(*counts))
    (folder / "png.fff").write_bytes(stills.fff(smooth[0], image=stills.png(smooth[0])))
    (folder / "a.ptw").write_bytes(stills.ptw(smooth, 0.04 * np.arange(1, 6)))
    stills.dng(folder / "a.dng", rng.integers(600, 16000, (64, 96)).astype(np.uint16), black=512, white=16383)


def targets(folder: Path, only: str) -> list[Target]:
    """Write all files; return those that are damaged, and whose name has a text."""
    from camera_texts import DISPLAY, LENS, PHOTONS, PIXELS

    found = []
    for (name, kind), is_checked in product(KINDS.items(), (False, True)):
        path = folder / f"{name.replace(' ', '_')}{is_checked:d}"
        frame = path / scenes.write_dataset(path, with_sha256=is_checked, **kind)[3]
        score = ("todframes", "score", str(path), *QUICK)
        commands = (score, (*score, "--on-error", "skip"), ("todframes", "validate", str(path)))
        right = scenes.without_times(json.loads(printed(*score))["fits"])
        label = f"frame, {name}{', checked' * is_checked}"
        found.append(Target(label, frame, commands, BYTES, right, is_checked))
    samples = folder / "recordings"
    samples.mkdir()
    recordings(samples)
    (folder / "schedule.csv").write_text("orientation,size_px,contrast\nup,9,0.5\n")
    how = ("--schedule", "schedule.csv", "--range", "0:65535", "--integration-time", "all", "-o", "OUT", "--quiet")
    for path in sorted(samples.iterdir()):
        noise = ("todframes", "noise", str(path), "--json", "--quiet")
        commands = (noise, ("todframes", "import", str(path), *how))
        found.append(Target(f"recording, {path.name}", path, commands, BYTES))
    scenes.write_dataset(folder / "dataset", with_sha256=True)
    look_up = shutil.copytree(folder / "dataset", folder / "look_up")
    dataset_toml = (look_up / "dataset.toml").read_text(encoding="utf-8")
    look_up_toml = dataset_toml.replace('eotf = "linear"', 'eotf = "lut"\nlut = "lut.csv"')
    frequencies = "frequency_cyc_per_mrad,mtf\n" + "".join(f"{k},{1 - k / 10}\n" for k in range(11))
    camera = (scenes.SAMPLES / "staring_camera.toml").read_text(encoding="utf-8")
    optics = re.compile(r"(?<=\[optics\]\n).*?(?=\n\[)", re.DOTALL)
    texts = {
        "dataset/dataset.toml": None, "dataset/manifest.csv": None, "look_up/dataset.toml": look_up_toml,
        "look_up/lut.csv": scenes.LOOK_UP_CSV, "observer.toml": scenes.OBSERVER_TOML,
        "counts.csv": scenes.COUNTS_CSV, "thermal.toml": camera, "designs.csv": scenes.DESIGNS_CSV,
        "measured.toml": optics.sub('mtf = "mtf.csv"\n', camera), "mtf.csv": frequencies,
        "photons.toml": "schema = 1\n" + LENS + PIXELS + PHOTONS + DISPLAY,
    }  # fmt: skip
    (look_up / "lut.csv").write_text(scenes.LOOK_UP_CSV)
    for name, text in texts.items():
        if text is not None:
            (folder / name).write_text(text, encoding="utf-8")
    simulate = ("--size-detectors", "2", "--snr", "2", "--trials", "1", "--quiet", "-o", "OUT")
    of_sensor = lambda name: (  # noqa: E731
        *(("sensor_sim", "mtf", name, "--json"), ("sensor_sim", "curve", name, *CURVE)),
        ("sensor_sim", "simulate", name, *simulate),
    )
    readers = {
        "observer.toml": (("todframes", "score", "dataset", *QUICK, "--observer-settings", "observer.toml"),),
        "counts.csv": (("todframes", "fit", "counts.csv", "--set", "resamples=0", "--json"),),
        "designs.csv": (("sensor_sim", "sweep", "thermal.toml", *CURVE, "--design", "designs.csv"),),
        "mtf.csv": of_sensor("measured.toml")[:2],
        **{name: of_sensor(name)[:2] for name in ("measured.toml", "photons.toml")},
        "thermal.toml": of_sensor("thermal.toml"),
    }
    for name in texts:
        commands = readers.get(name, (("todframes", "score", name.partition("/")[0], *QUICK),))
        found.append(Target(f"text, {name}", folder / name, commands, TEXT))
    found = [one for one in found if only in one.name]
    for one in found:
        for command in one.commands:
            printed(*command)
            shutil.rmtree(folder / "OUT", ignore_errors=True)
    return found


def prepared(only: str) -> tuple[list[Target], list[str]]:
    """Return the targets and the modules that their commands import; in a process whose threads end with it."""
    return targets(Path.cwd(), only), list(sys.modules)


def printed(package: str, *arguments: str) -> str:
    """Run a command on whole files in this process, which imports what cases need; return its standard output."""
    return CliRunner().invoke(COMMANDS[package], arguments, catch_exceptions=False).stdout


class Ran(NamedTuple):
    """The end of a command: exit status, or minus the number of a signal; CPU time and peak of memory."""

    status: int
    out: str
    err: str
    seconds: float
    peak_mb: float


def ran(package: str, *arguments: str) -> Ran:
    """Run a command in a child process, where what native libraries print is caught as well."""
    sys.stdout.flush()
    child = os.fork()
    if not child:
        status = 99
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_CASE_S, LONGEST_CASE_S))
            signal.alarm(10 * LONGEST_CASE_S)
            for number, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
            status = run(COMMANDS[package], list(arguments))
        except BaseException:  # a fault, which is printed
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status)
    _, status, usage = os.wait4(child, 0)
    out, err = (Path(name).read_text(encoding="utf-8", errors="replace") for name in ("stdout", "stderr"))
    seconds = usage.ru_utime + usage.ru_stime
    return Ran(os.waitstatus_to_exitcode(status), out, err, seconds, usage.ru_maxrss / 1024)


def refused(name: str) -> None:
    raise ValueError(f"the JSON holds {name}")


def judged(end: Ran, target: Target, *, is_same: bool, wrote: bool) -> tuple[str, bool]:
    """Return how a command ended, and whether that is a fault."""
    if end.seconds > LONGEST_CASE_S or end.peak_mb > MOST_MB:
        return f"{end.seconds:.0f} s, {end.peak_mb:.0f} MB", True
    lines = [line for line in end.err.splitlines() if not ASIDE.match(line)]
    if end.status:
        is_clear = all(line.startswith("error: ") and line.isprintable() for line in lines)
        is_clear &= bool(lines) and "out of memory" not in end.err and max(map(len, lines)) <= LONGEST_LINE
        is_clear &= end.status in (1, 2) and (len(lines) == 1 or target.right is not None)
        is_named = target.name.startswith("text") or target.path.name in end.err
        return "refused", is_same or wrote or not (is_clear and is_named)
    if not end.out.startswith("{"):
        return "a result", bool(lines) or (target.is_checked and not is_same)
    result = json.loads(end.out, parse_constant=refused)
    if target.right is None or is_same:
        return "a result", bool(lines)
    if skipped := result["skipped"]:
        return "skipped and named", [Path(one["frame"]).name for one in skipped] != [target.path.name]
    if scenes.without_times(result["fits"]) == target.right:
        return "the same numbers", target.is_checked
    is_exr = target.path.read_bytes()[:4] == b"\x76\x2f\x31\x01" or target.path.suffix == ".exr"
    is_told = any(one["code"] == "unverified_frames" for one in result["warnings"])
    return "other numbers", target.is_checked or (is_exr and not is_told)


def main() -> int:
    """Run cases and print counts of their ends. Returns 1 if one is a fault."""
    parser = scenes.parser_of(__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    n_faults, slowest, largest = 0, 0.0, 0.0
    with tempfile.TemporaryDirectory() as made, chdir(made):
        with ProcessPoolExecutor(1, get_context("fork")) as pool:
            chosen, modules = pool.submit(prepared, asked.only).result()
        for name in modules:  # which each case would import anew
            with suppress(ImportError):
                import_module(name)
        others = [one.path.read_bytes() for one in chosen]
        others += [b"GIF89a" + bytes(100), b"PK\3\4" + bytes(100), b"%PDF\n"]
        for number in range(asked.first, asked.first + asked.n):
            rng = np.random.default_rng([asked.seed, number])
            target = chosen[rng.integers(len(chosen))]
            command = target.commands[rng.integers(len(target.commands))]
            whole = target.path.read_bytes()
            damaged = target.mutations[rng.integers(len(target.mutations))](whole, rng, others)
            target.path.write_bytes(damaged)
            end = ran(*command)
            ending, is_fault = judged(end, target, is_same=damaged == whole, wrote=Path("OUT").exists())
            target.path.write_bytes(whole)
            shutil.rmtree("OUT", ignore_errors=True)
            if is_fault:
                print(f"FAULT {number} {target.name}: {command[1]}: {ending}\n{end.err[-3000:]}", flush=True)
            counts[target.name.partition(",")[0], ending] += 1
            n_faults += is_fault
            slowest, largest = max(slowest, end.seconds), max(largest, end.peak_mb)
    print(*(f"{count:7}  {kind}: {ending}" for (kind, ending), count in sorted(counts.items())), sep="\n")
    print(f"slowest {slowest:.1f} s, largest {largest:.0f} MB")
    print(f"{asked.n} cases, {n_faults} faults")
    return int(n_faults > 0)


if __name__ == "__main__":
    sys.exit(main())
