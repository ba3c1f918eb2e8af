"""Kill runs again and again: after the last restart a run has the same bytes as one that nothing disturbed.

python tests/campaigns/kills.py 100                # clients, workers and schedulers of six commands; an hour
python tests/campaigns/kills.py 100 --long 20000   # one `score` of 20,000 frames; an hour

SIGKILL ends the client, a worker or the scheduler at a random moment. The same command is then given again, until
enough was killed; the last run goes to its end.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import scenes

LOGGED = str(Path(__file__).with_name("logged.py"))
STORE = ".todframes-staging/store"
LONGEST_RUN_S = 600.0
KILLED, TIMED_OUT = -signal.SIGKILL, 124
NO_CLUSTER = 2
"""Exit status of a run whose scheduler is gone."""
GONE = re.compile(r"error: tcp://\S+: (the Dask scheduler is gone|no Dask scheduler has answered|cannot talk to)")

Target = Literal["client", "worker", "scheduler"]


class Command(NamedTuple):
    """A command that is killed: its name, its arguments without `-o`, and how long each item takes in addition.

    A kill may cost `in_flight` items. Moments of kills are uniform over `moments_s`, from the start in a share
    `at_start` of the kills, and from the first item that is done in the others.
    """

    name: str
    arguments: tuple[str, ...]
    item_s: float
    in_flight: int = 160
    moments_s: tuple[float, float] = (0.3, 6.0)
    at_start: float = 1.0


@dataclass
class Tally:
    """What was killed, how many items were done, in how many turns, and what one run has lost at most."""

    name: str
    kills: Counter[Target] = field(default_factory=Counter)
    n_items: int = 0
    n_done: int = 0
    most_lost: int = 0
    faults: list[str] = field(default_factory=list)

    def line(self) -> str:
        kills = ", ".join(f"{count} of the {target}" for target, count in sorted(self.kills.items()))
        return (
            f"{self.name}: kills: {kills}; {self.n_items} items, {self.n_done - self.n_items} done again "
            f"({self.most_lost} at most after one run); {len(self.faults)} faults {self.faults}"
        )


class Processes:
    """Processes in sessions of their own, which log their items; with a cluster, a scheduler and two workers."""

    def __init__(self, folder: Path, command: Command, *, with_cluster: bool) -> None:
        self.folder, self.log, self.err = folder, folder / "log", folder / "stderr"
        self._environment = os.environ.copy()
        self._environment |= {"CAMPAIGN_LOG": str(self.log), "CAMPAIGN_ITEM_S": str(command.item_s)}
        self._environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._environment |= {"DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "10s"}
        self._sessions: list[int] = []
        self._cluster: dict[str, subprocess.Popen[bytes]] = {}
        self.port = 0
        if with_cluster:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self.port = free.getsockname()[1]

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start Python with these arguments; what it says on standard error is in `err`, if it is a client."""
        name = self.err if arguments[0] == LOGGED else Path(os.devnull)
        with name.open("wb") as err:
            streams: Any = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": err}
            command = [sys.executable, *arguments]
            process = subprocess.Popen(command, env=self._environment, start_new_session=True, **streams)
        self._sessions.append(process.pid)
        return process

    def complete(self) -> None:
        """Start what is not running of the cluster, if there is one."""
        if not self.port:
            return
        self._cluster = {name: one for name, one in self._cluster.items() if one.poll() is None}
        if "scheduler" not in self._cluster:
            self.end_cluster()
            more = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show")
            self._cluster["scheduler"] = self.start("-m", "distributed.cli.dask_scheduler", *more)
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1):
                    break
                time.sleep(0.05)
        for name in {"worker 1", "worker 2"} - self._cluster.keys():
            more = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
            more += ("--local-directory", str(self.folder), "--memory-limit", "0")
            address = f"tcp://127.0.0.1:{self.port}"
            self._cluster[name] = self.start("-m", "distributed.cli.dask_worker", address, *more)

    def kill(self, target: Target, rng: random.Random) -> None:
        process = self._cluster[target if target == "scheduler" else rng.choice(["worker 1", "worker 2"])]
        process.kill()
        process.wait()

    def end_cluster(self) -> None:
        for process in self._cluster.values():
            process.kill()
            process.wait()
        self._cluster = {}

    def left(self) -> list[int]:
        """Return the processes that are still there after a minute, and end them."""
        deadline = time.monotonic() + 60.0
        while (left := _processes_of(self._sessions)) and time.monotonic() < deadline:
            time.sleep(0.1)
        for process in left:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        return left


def _processes_of(sessions: Sequence[int]) -> list[int]:
    """Return the processes of these sessions that are no zombies."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, _, session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(session) in sessions and state != "Z":
                found.append(int(folder.name))
    return found


def _wait(client: subprocess.Popen[bytes], timeout: float = LONGEST_RUN_S) -> int:
    """Wait for a client; one that takes too long is killed, with the status of a time-out."""
    try:
        return client.wait(timeout)
    except subprocess.TimeoutExpired:
        client.kill()
        client.wait()
        return TIMED_OUT


def kill_repeatedly(command: Command, kills: Sequence[Target], folder: Path, seed: int) -> Tally:
    """Kill a run, or a part of the cluster that does it, again and again, and compare its end.

    A run that ends before it was killed is compared and begun anew.
    """
    folder.mkdir(parents=True)
    tally, rng = Tally(command.name), random.Random(f"{seed} {command.name}")
    left, out = list(kills), folder / "out"
    first = Processes(folder, command._replace(item_s=0.0), with_cluster=False)
    if _wait(first.start(LOGGED, *command.arguments, "-o", str(folder / "undisturbed"))):
        raise RuntimeError(first.err.read_text())
    first.log.unlink()
    wanted = scenes.content(folder / "undisturbed")
    processes = Processes(folder, command, with_cluster="--cluster" in command.name)
    arguments = [*command.arguments, "-o", str(out)]
    arguments += ["--cluster", f"tcp://127.0.0.1:{processes.port}"] if processes.port else []
    done: list[str] = []  # by all runs into the folder as it is
    stored: set[str] = set()
    try:
        while True:
            processes.complete()
            if lost := stored - (found := stored_keys(out)):
                tally.faults.append(f"{len(lost)} results have gone from the store")
            stored, n_before, n_killed = found, len(_lines(processes.log)), sum(tally.kills.values())
            client = processes.start(LOGGED, *arguments)
            status: int | None = None
            while left and status is None:
                if rng.random() > command.at_start:
                    while client.poll() is None and len(_lines(processes.log)) == n_before:
                        time.sleep(0.02)
                with suppress(subprocess.TimeoutExpired):
                    status = client.wait(rng.uniform(*command.moments_s))
                if status is None:
                    tally.kills[target := left.pop(0)] += 1
                    if target == "client":
                        client.kill()
                        status = client.wait()
                    else:
                        processes.kill(target, rng)
                        status = _wait(client) if target == "scheduler" else None
                        processes.complete()
            status = _wait(client) if status is None else status
            err = processes.err.read_text(encoding="utf-8", errors="replace")
            new = _lines(processes.log)[n_before:]
            done += new
            if again := stored & set(new):
                tally.faults.append(f"{len(again)} items were done again whose results were in the store")
            cost = len(set(new) - stored_keys(out)) * (status != 0)
            tally.most_lost = max(tally.most_lost, cost)
            if cost > command.in_flight * max(sum(tally.kills.values()) - n_killed, 1):
                tally.faults.append(f"a run has lost {cost} items")
            # A kill can come after the last file was put in place and the store was removed.
            is_whole = status == 0 or (not stored_keys(out) and scenes.content(out) == wanted)
            if is_whole:
                if scenes.content(out) != wanted or (status == 0 and (out / ".todframes-staging").exists()):
                    tally.faults.append("other content, or the staging folder is left")
                tally.n_items += len({*done})
                tally.n_done += len(done)
                done, stored = [], set()
                if not left:
                    break
                shutil.rmtree(out)
            elif "Traceback" in err or not (status == KILLED or (status == NO_CLUSTER and GONE.match(err))):
                tally.faults.append(f"status {status}: {err[-500:]}")
                break
    finally:
        processes.end_cluster()
        if orphans := processes.left():
            tally.faults.append(f"{len(orphans)} processes were left")
    return tally


def _lines(log: Path) -> list[str]:
    return log.read_text(encoding="utf-8").splitlines() if log.exists() else []


def stored_keys(out: Path) -> set[str]:
    """Return the identities of the finished rows, but for a last one that is not whole."""
    texts = [path.read_text(encoding="ascii") for path in (out / STORE).glob("*.rows")]
    return {line.split(" ")[0] for text in texts for line in text.splitlines(keepends=True) if line.endswith("\n")}


def commands(folder: Path) -> list[Command]:
    """Return the commands that are killed, and write what they read."""
    scenes.write_dataset(folder / "dataset", contrasts=(0.05, 0.1, 0.2, 0.4), repeats=100, noise=0.02)
    scenes.write_recording(folder / "recording")
    dataset, sensor = str(folder / "dataset"), str(scenes.SAMPLES / "staring_camera.toml")
    score = ("todframes", "score", dataset, "--set", "resamples=40", "--quiet")
    compare = ("todframes", "compare", *score[2:], "--enhance", "gaussian:sigma=1", "--white", "100")
    simulate = ("sensor_sim", "simulate", sensor, "--size-detectors", "2,3", "--snr", "1,2,4", "--trials", "400")
    recording = ("todframes", "import", str(folder / "recording" / "frames.npy"), "--frames-per-second", "30")
    recording += ("--schedule", str(folder / "recording" / "schedule.csv"), "--warm-up", "4", "--quiet")
    sweep = ("sensor_sim", "sweep", sensor, "--vary", "optics.aperture_mm=100:200:24", "--quiet")
    return [
        Command("score", (*score, "--workers", "1"), 0.003),
        Command("score, 2 workers", (*score, "--workers", "2"), 0.006, 400),
        Command("compare", compare, 0.002),
        Command("simulate", (*simulate, "--quiet"), 0.1),
        Command("import", recording, 0.01),
        Command("sweep", (*sweep, "--size-detectors", "4,6", "--tolerance", "0.05"), 0.1),
    ]


def campaign(folder: Path, n: int, seed: int, only: str) -> list[tuple[Command, list[Target]]]:
    """Return what is killed, and by which targets: two fifths are clients without a cluster."""
    local = [command for command in commands(folder) if only in command.name]
    n_local, rng = max(1, 2 * n // 5), random.Random(seed)
    plan: list[tuple[Command, list[Target]]] = [
        (one, ["client"] * (n_local // len(local) + (k < n_local % len(local)))) for k, one in enumerate(local)
    ]
    targets: list[Target] = [("client", "worker", "scheduler")[k % 3] for k in range(n - n_local)]
    rng.shuffle(targets)
    shared = [one for one in local if one.name in ("score", "compare", "simulate", "sweep")]
    for k, one in enumerate(shared):
        slow = one._replace(name=f"{one.name} --cluster", item_s=3 * one.item_s, in_flight=100_000)
        plan.append((slow._replace(moments_s=(0.0, 6.0), at_start=0.3), targets[k :: len(shared)]))
    return plan


def long_run(folder: Path, n_frames: int, n: int) -> list[tuple[Command, list[Target]]]:
    """Return a run of many frames, links to some files, that is killed within 2 s of its first item or start."""
    contrasts = (0.03, 0.05, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4)
    scenes.write_dataset(folder / "dataset", repeats=n_frames // 32, side_px=64, contrasts=contrasts, noise=0.05)
    arguments = ("todframes", "score", str(folder / "dataset"), "--quiet")
    command = Command(f"score of {n_frames} frames", arguments, 0.008, 16, (0.0, 2.0), 0.1)
    return [(command, ["client"] * n)]


def main() -> int:
    parser = scenes.parser_of(__doc__)
    parser.add_argument("--only", default="", help="part of the name of a command")
    parser.add_argument("--long", type=int, metavar="FRAMES", help="kill one run of so many frames")
    asked = parser.parse_args()
    n_faults = 0
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        planned = long_run(folder, asked.long, asked.n) if asked.long else None
        for k, (command, kills) in enumerate(planned or campaign(folder, asked.n, asked.seed, asked.only)):
            if kills:
                tally = kill_repeatedly(command, kills, folder / f"runs {k}", asked.seed)
                n_faults += len(tally.faults)
                print(tally.line(), flush=True)
    return int(n_faults > 0)


if __name__ == "__main__":
    sys.exit(main())
