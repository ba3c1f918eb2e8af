"""The campaign of damaged and hostile neural networks: each ends in an algorithm or in one clear line.

Small networks are mutated and given to `onnx:FILE`, which tries them in a process of its own. One that is accepted
filters a frame, in another process, as a worker of a comparison does. Every sixth case is a whole network of two
inputs whose settings are mutated or hostile, or one that names a file outside its folder as its weights.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from mutations import fill_range, flip_bits, insert_bytes, truncate

sys.path.insert(0, str(Path(__file__).parents[1]))

import networks

LIMIT_S = 60.0
"""Longest time of a case; the time of a trial is limited to less."""

ONE = """
import sys
import numpy as np
from todframes.base.errors import TodframesError
from todframes.enhancement import network_probe
from todframes.enhancement.finding import find_enhancement

network_probe.TIME_LIMIT_S = 20.0
try:
    network = find_enhancement(sys.argv[1])
    print("accepted", flush=True)
    network.run(np.full((40, 50), 0.5, np.float32))
except TodframesError as error:
    message = str(error)
    assert message.isprintable(), repr(message)
    print("refused", message)
"""


def other_number(content: bytes, rng: np.random.Generator, _: object) -> bytes:
    """Replace one byte by the end of a range: most are lengths, dimensions or types."""
    place = int(rng.integers(len(content)))
    return content[:place] + bytes([int(rng.choice([0, 1, 2, 127, 128, 255]))]) + content[place + 1 :]


MUTATIONS = (flip_bits, truncate, fill_range, insert_bytes, other_number)


SETTINGS = b"white = 255\ntile_px = 48\n[inputs]\ns = 0.06\n"
"""Settings of a network with a noise level, in the form that they are mutated from."""

NAMES = ("s", "x", "t", '""', '"\\u0000"', '"s\\n"', '"' + 300 * "s" + '"', '"s.s"', "inputs", '"\\u202e"')
VALUES = (
    *("nan", "-inf", "1e300", "1e-300", "-0.0", "2147483648", "9223372036854775807", "1e9", "true", "'0.1'", "''"),
    *("[0.1]", "[]", "{}", "{s = 1}", "1979-05-27", '"\\u0007"', 2000 * "[", '"' + 9000 * "s" + '"'),
)


def hostile_settings(rng: np.random.Generator) -> bytes:
    """Return a text of settings with names and values that no network takes, or some that one does."""
    if rng.random() < 0.4:
        return MUTATIONS[int(rng.integers(len(MUTATIONS)))](SETTINGS, rng, [SETTINGS, SETTINGS])
    n_lines = int(rng.choice([1, 2, 30]))
    lines = [f"{rng.choice(NAMES) if n_lines < 3 else f's{k}'} = {rng.choice(VALUES)}" for k in range(n_lines)]
    heads = ["[inputs]", "[inputs.s]", "[[inputs]]", "", f"constant_channel = {rng.choice(VALUES)}\n[inputs]"]
    return "\n".join([rng.choice(heads), *lines]).encode()


ELSEWHERE = (
    *("../secret.bin", "link.bin", "hard.bin", "linked/secret.bin", "linked", "pipe", "inner/../../secret.bin"),
    *("/dev/zero", "/proc/self/mem", "/etc/passwd", "", ".", "./../secret.bin", "\0", 5000 * "../" + "etc/passwd"),
    *("file:///etc/passwd", "..\\secret.bin", "weights.bin\0../../secret.bin", "//etc/passwd"),
)
"""Names of files that no network may read; `plant` makes some of them."""


def plant(folder: Path) -> None:
    """Put links, a pipe and a file above a folder, which a network may name as its weights."""
    secret = folder.parent / "secret.bin"
    secret.write_bytes(np.ones(9, "<f4").tobytes())
    (folder / "inner").mkdir()
    (folder / "link.bin").symlink_to(secret)
    (folder / "linked").symlink_to(folder.parent)
    (folder / "hard.bin").hardlink_to(secret)
    os.mkfifo(folder / "pipe")


def samples(folder: Path) -> list[Path]:
    """Write the networks that are mutated."""
    (folder / "weights.bin").write_bytes(np.arange(9, dtype="<f4").tobytes())
    return [
        networks.with_weights_in(folder / "outside.onnx", "weights.bin"),
        networks.denoiser(folder / "denoiser.onnx"),
        networks.finer(folder / "finer.onnx"),
        networks.blur(folder / "box.onnx", networks.box(), channels=3, size=(48, 64)),
        networks.halving(folder / "halving.onnx"),
    ]


def campaign(n: int, *, seed: int, first: int = 0) -> tuple[int, list[str]]:
    """Mutate networks; return the number of cases, and a line for each fault.

    A process that ends with a signal after its network was accepted is counted apart: the trial has shown small
    pictures only, and what a hostile model does with a frame is not known. A traceback, a message of several lines
    and a signal before that are faults.
    """
    found, counts = [], dict.fromkeys(("accepted", "refused", "died after it was accepted"), 0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "networks"
        folder.mkdir()
        plant(folder)
        wholes = [path.read_bytes() for path in samples(folder)]
        noise_map = networks.less_noise(folder / "noise.onnx", networks.TensorProto.FLOAT, networks.ANY)
        path = folder / "damaged.onnx"
        for number in range(first, first + n):
            rng = np.random.default_rng((seed, number))
            if number % 12 == 11:
                path.with_suffix(".toml").write_bytes(b"")
                location = str(rng.choice(ELSEWHERE))
                networks.with_weights_in(path, location)
                case = f"{number}, weights in {location[:40]!r}"
            elif number % 6 == 5:
                path.write_bytes(noise_map.read_bytes())
                path.with_suffix(".toml").write_bytes(hostile_settings(rng))
                case = f"{number}, settings"
            else:
                mutate = MUTATIONS[number % len(MUTATIONS)]
                path.write_bytes(mutate(wholes[number // len(MUTATIONS) % len(wholes)], rng, wholes))
                path.with_suffix(".toml").write_bytes(b"")
                case = f"{number}, {mutate.__name__}"
            try:
                done = subprocess.run(
                    [sys.executable, "-c", ONE, f"onnx:{path}"],
                    capture_output=True,
                    timeout=LIMIT_S,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                found.append(f"{case}: took more than {LIMIT_S:g} s")
                continue
            lines = done.stdout.decode(errors="replace").splitlines()
            if number % 12 == 11 and lines[:1] == ["accepted"]:
                found.append(f"{case}: was read")
            if done.returncode < 0 and lines[:1] == ["accepted"]:
                counts["died after it was accepted"] += 1
            elif done.returncode:
                end = signal.Signals(-done.returncode).name if done.returncode < 0 else done.returncode
                last = (done.stderr.decode(errors="replace").splitlines() or [""])[-1]
                found.append(f"{case}: ended with {end}: {last}")
            else:
                counts[lines[-1].partition(" ")[0]] += 1
    print(", ".join(f"{value} {key}" for key, value in counts.items()))
    return n, found
