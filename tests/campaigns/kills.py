"""Kill runs again and again: after the last restart a run has the same bytes as one that nothing disturbed.

python tests/campaigns/kills.py 100                # clients, workers and schedulers of six commands; an hour
python tests/campaigns/kills.py 100 --long 20000   # one `score` of 20,000 frames; an hour

SIGKILL ends the client, a worker or the scheduler at a random moment. The same command is then given again, until
enough was killed; the last run goes to its end. A log tells which items were done: none whose result was in the
store when a run began, so that only what was in flight is done twice.
"""

from __future__ import annotations

import argparse
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
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import scenes
from logged import NO_KEY

from todframes.jobs.store import HEAD, MAGIC

LOGGED = Path(__file__).with_name("logged.py")

STORE = ".todframes-staging/store"

LONGEST_RUN_S = 600.0

Target = Literal["client", "worker", "scheduler"]

NO_CLUSTER = 2
"""Exit status of a run whose scheduler is gone."""

GONE = re.compile(r"error: tcp://\S+: (the Dask scheduler is gone|no Dask scheduler has answered|cannot talk to)")


class Command(NamedTuple):
    """A command that is killed: its name, its arguments without `-o`, and how long each item takes in addition."""

    name: str
    arguments: tuple[str, ...]
    item_s: float
    at_once: bool = True


@dataclass
class Tally:
    """What was killed, and what was found.

    Attributes
    ----------
    kills : Counter
        Number of kills by target.
    n_items, n_done : int
        Number of different items that were done, and of times that one was done.
    n_unkeyed : int
        Number of items that were done before the store was begun; they are among `n_done`.
    most_in_flight : int
        Largest number of items that a kill has cost: done, and not in the store.
    faults : list of str
    """

    name: str
    kills: Counter[Target] = field(default_factory=Counter)
    n_items: int = 0
    n_done: int = 0
    n_unkeyed: int = 0
    most_in_flight: int = 0
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def line(self) -> str:
        """Return the tally in one line."""
        kills = ", ".join(f"{count} of the {target}" for target, count in sorted(self.kills.items()))
        twice = self.n_done - self.n_unkeyed - self.n_items
        return (
            f"{self.name}: kills: {kills}; {self.n_items} items, {twice} done again "
            f"({self.most_in_flight} at most after one run), {self.n_unkeyed} before the store began; "
            f"{self.seconds:.0f} s; {len(self.faults)} faults {self.faults}"
        )


# Processes -----------------------------------------------------------------------------------------------------


class _StartedCommand:
    """A command in a process of its own, with what it says."""

    def __init__(self, process: subprocess.Popen[bytes], err: Path) -> None:
        self._err = err
        self.poll, self.wait, self.kill = process.poll, process.wait, process.kill

    @property
    def err(self) -> str:
        return self._err.read_text(encoding="utf-8", errors="replace")


class Processes:
    """Processes that are started in a session of their own, and are all gone at the end."""

    def __init__(self, log: Path, item_s: float, *, at_once: bool) -> None:
        self._environment = os.environ | ({"CAMPAIGN_AT_ONCE": "1"} if at_once else {})
        self._environment |= {
            "CAMPAIGN_LOG": str(log),
            "CAMPAIGN_ITEM_S": str(item_s),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "10s",
        }
        self._sessions: list[int] = []

    def start(self, *arguments: str, output: Path | None = None) -> subprocess.Popen[bytes]:
        """Start Python with these arguments."""
        with ExitStack() as stack:
            target = subprocess.DEVNULL if output is None else stack.enter_context(output.open("wb"))
            process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=target,
                env=self._environment,
                start_new_session=True,
            )
        self._sessions.append(process.pid)
        return process

    def command(self, arguments: Sequence[str], folder: Path) -> _StartedCommand:
        """Start a command that logs its items."""
        return _StartedCommand(self.start(str(LOGGED), *arguments, output=folder / "stderr"), folder / "stderr")

    def left(self, patience_s: float) -> list[int]:
        """Return the processes that are still there after a time, and end them."""
        deadline = time.monotonic() + patience_s
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


class Cluster:
    """A scheduler and two workers, as processes of their own; `address` is the same when they start again."""

    def __init__(self, processes: Processes, folder: Path) -> None:
        self._processes, self._folder = processes, folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self._port}"
        self._scheduler: subprocess.Popen[bytes] | None = None
        self._workers: list[subprocess.Popen[bytes]] = []

    def complete(self) -> None:
        """Start what is not running."""
        if self._scheduler is None or self._scheduler.poll() is not None:
            self._end(self._workers)
            arguments = ("--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard", "--no-show")
            self._scheduler = self._processes.start("-m", "distributed.cli.dask_scheduler", *arguments)
            self._wait()
        self._workers = [worker for worker in self._workers if worker.poll() is None]
        while len(self._workers) < 2:
            arguments = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--preload", str(LOGGED))
            arguments += ("--local-directory", str(self._folder), "--memory-limit", "0")
            self._workers.append(
                self._processes.start("-m", "distributed.cli.dask_worker", self.address, *arguments)
            )

    def kill(self, target: Target, rng: random.Random) -> None:
        """Kill a worker or the scheduler."""
        process = self._scheduler if target == "scheduler" else rng.choice(self._workers)
        assert process is not None
        process.kill()
        process.wait()

    def close(self) -> None:
        """End all."""
        self._end([*self._workers, *([self._scheduler] if self._scheduler else [])])

    def _end(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        for process in processes:
            process.kill()
            process.wait()

    def _wait(self) -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), timeout=1):
                return
            time.sleep(0.05)
        raise TimeoutError("the scheduler has not started")


# A campaign ----------------------------------------------------------------------------------------------------


def kill_repeatedly(
    command: Command,
    kills: Sequence[Target],
    folder: Path,
    *,
    moments_s: tuple[float, float],
    seed: int,
    in_flight: int,
    with_cluster: bool = False,
    at_start: float = 1.0,
) -> Tally:
    """Kill a run, or a part of the cluster that does it, again and again, and compare its end.

    A run that ends before it was killed is compared and begun anew.

    Parameters
    ----------
    kills : sequence of str
        What is killed, in this order.
    moments_s : (float, float)
        Shortest and longest time after the start, or after the last kill, in seconds; moments are uniform.
    in_flight : int
        Largest number of items that a kill may cost.
    at_start : float
        Share of the kills whose time counts from the start; that of others counts from when items are done.
    """
    folder.mkdir(parents=True)
    tally, rng = Tally(command.name), random.Random(f"{seed} {command.name}")
    started = time.monotonic()
    log, out = folder / "log", folder / "out"
    processes = Processes(log, command.item_s, at_once=command.at_once)
    undisturbed = folder / "undisturbed"
    first = Processes(folder / "log of undisturbed", 0.0, at_once=True)
    process = first.command([*command.arguments, "-o", str(undisturbed)], folder)
    if process.wait(LONGEST_RUN_S):
        raise RuntimeError(process.err)
    wanted = scenes.content(undisturbed)
    cluster = Cluster(processes, folder) if with_cluster else None
    arguments = [*command.arguments, "-o", str(out)]
    if cluster is not None:
        arguments += ["--cluster", cluster.address]
    run = _Run(tally, log, out, in_flight)
    left = list(kills)
    try:
        while True:
            if cluster is not None:
                cluster.complete()
            run.begin()
            client = processes.command(arguments, folder)
            status: int | None = None
            while left and status is None:
                if rng.random() > at_start:
                    status = run.wait_for_work(client)
                with suppress(subprocess.TimeoutExpired):
                    status = client.wait(rng.uniform(*moments_s))
                if status is None:
                    target = left.pop(0)
                    tally.kills[target] += 1
                    if target == "client":
                        client.kill()
                        status = client.wait()
                    else:
                        assert cluster is not None
                        cluster.kill(target, rng)
                        if target == "scheduler":
                            status = _wait(client)
                        else:
                            run.costs += 1
                            cluster.complete()
            if status is None:
                status = _wait(client)
            err = client.err
            run.end(status)
            if status in (-signal.SIGKILL, NO_CLUSTER) and not _is_expected(status, err):
                tally.faults.append(f"status {status}: {err[-500:]}")
            # A kill can come after the last file was put in place and the store was removed.
            was_whole = status == -signal.SIGKILL and not stored_keys(out) and scenes.content(out) == wanted
            if status == 0 or was_whole:
                if (found := scenes.content(out)) != wanted:
                    names = [name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)]
                    tally.faults.append(f"other content: {names}")
                if status == 0 and (out / ".todframes-staging").exists():
                    tally.faults.append("the staging folder is left")
                run.whole()
                if not left:
                    break
                shutil.rmtree(out)
            elif status not in (-signal.SIGKILL, NO_CLUSTER):
                tally.faults.append(f"status {status}: {err[-500:]}")
                break
            elif not _is_expected(status, err):
                break
    finally:
        if cluster is not None:
            cluster.close()
        if orphans := processes.left(60.0):
            tally.faults.append(f"{len(orphans)} processes were left")
    tally.seconds = time.monotonic() - started
    return tally


def _wait(client: _StartedCommand) -> int:
    """Wait for a client; one that takes too long is killed, with the status of a time-out."""
    try:
        return client.wait(LONGEST_RUN_S)
    except subprocess.TimeoutExpired:
        client.kill()
        client.wait()
        return 124


def _is_expected(status: int, err: str) -> bool:
    """Tell whether a client ended as it should: killed, or with a line about the cluster and a note."""
    if status == -signal.SIGKILL:
        return "Traceback" not in err
    lines = [line for line in err.splitlines() if "of the work are there" not in line]
    return (
        len(lines) in (1, 2) and GONE.match(lines[0]) is not None and all("note: " in line for line in lines[1:])
    )


class _Run:
    """The check of the log against the store, for one run after the other into a folder."""

    def __init__(self, tally: Tally, log: Path, out: Path, in_flight: int) -> None:
        self._tally, self._log, self._out, self._in_flight = tally, log, out, in_flight
        self._stored: set[str] = set()
        self._before = self._size_before = 0
        self._all: list[str] = []
        self.costs = 0

    def begin(self) -> None:
        """Look at the store before a run."""
        stored = stored_keys(self._out)
        if lost := self._stored - stored:
            self._tally.faults.append(f"{len(lost)} results have gone from the store")
        self._stored = stored
        self._before = len(self._lines())
        self._size_before = self._size
        self.costs = 0

    def wait_for_work(self, client: _StartedCommand) -> int | None:
        """Wait until an item has been done in this run; return the status of the client if it ends before."""
        while client.poll() is None and self._size == self._size_before:
            time.sleep(0.02)
        return client.poll()

    def end(self, status: int) -> None:
        """Compare what a run has done with the store."""
        done = self._lines()[self._before :]
        self._all += done
        keyed = [line for line in done if line != NO_KEY]
        if again := self._stored & set(keyed):
            self._tally.faults.append(f"{len(again)} items were done again whose results were in the store")
        twice = len(keyed) - len(set(keyed))
        lost = 0
        if status:
            is_import = any("/" in line for line in keyed)
            stored = stored_keys(self._out)
            lost = 0 if is_import else len(set(keyed) - stored)
            self.costs += 1
        self._tally.most_in_flight = max(self._tally.most_in_flight, twice + lost)
        # What was in flight for a client that was killed may be done by workers while the next one runs.
        if twice + lost > self._in_flight * (self.costs + 1):
            self._tally.faults.append(f"{twice} items done twice and {lost} lost, at {self.costs} kills")

    def whole(self) -> None:
        """Count what was done until a run was whole."""
        keyed = [line for line in self._all if line != NO_KEY]
        self._tally.n_items += len(set(keyed))
        self._tally.n_done += len(self._all)
        self._tally.n_unkeyed += len(self._all) - len(keyed)
        self._all, self._stored = [], set()

    @property
    def _size(self) -> int:
        return self._log.stat().st_size if self._log.exists() else 0

    def _lines(self) -> list[str]:
        return self._log.read_text(encoding="utf-8").splitlines() if self._log.exists() else []


def stored_keys(out: Path) -> set[str]:
    """Return the keys in a store, but for a last record that is not whole."""
    store, keys = out / STORE, set()
    content = store.read_bytes() if store.is_file() else b""
    place = len(MAGIC)
    while place + HEAD.size <= len(content):
        n_key, n_result, _ = HEAD.unpack_from(content, place)
        key, place = place + HEAD.size, place + HEAD.size + n_key + n_result
        if place <= len(content):
            keys.add(content[key : key + n_key].hex())
    return keys


# The campaigns -------------------------------------------------------------------------------------------------


def commands(folder: Path, *, n_repeats: int = 100) -> dict[str, Command]:
    """Return the commands that are killed, and write what they read."""
    scenes.write_dataset(folder / "dataset", contrasts=(0.05, 0.1, 0.2, 0.4), repeats=n_repeats, noise=0.02)
    scenes.write_recording(folder / "recording")
    dataset, sensor = str(folder / "dataset"), str(scenes.SAMPLES / "staring_camera.toml")
    settings = ("--set", "resamples=40", "--quiet")
    score = ("todframes", "score", dataset, *settings)
    compare = ("todframes", "compare", dataset, "--enhance", "gaussian:sigma=1", "--white", "100", *settings)
    simulate = ("sensor_sim", "simulate", sensor, "--size-detectors", "2,3", "--snr", "1,2,4", "--quiet")
    recording = folder / "recording"
    schedule = ("--schedule", str(recording / "schedule.csv"), "--frames-per-second", "30")
    schedule += ("--warm-up", "4", "--quiet")
    sweep = ("sensor_sim", "sweep", sensor, "--vary", "optics.aperture_mm=100:200:24", "--quiet")
    sweep += ("--size-detectors", "4,6", "--tolerance", "0.05")
    found = [
        Command("score", (*score, "--workers", "1"), 0.003),
        Command("score, 2 workers", (*score, "--workers", "2"), 0.006),
        Command("compare", compare, 0.002),
        Command("simulate", (*simulate, "--trials", str(4 * n_repeats)), 0.1),
        Command("import", ("todframes", "import", str(recording / "frames.npy"), *schedule), 0.01),
        Command("sweep", sweep, 0.1),
    ]
    return {command.name: command for command in found}


def campaign(n: int, *, seed: int, only: str = "") -> list[Tally]:
    """Kill clients, workers and schedulers, `n` in all: two fifths of them clients without a cluster.

    `only` is a part of the names of the commands to kill.
    """
    rng = random.Random(seed)
    n_local = max(1, 2 * n // 5)
    tallies = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = commands(folder)
        kinds = [kind for kind in found if only in kind]
        for number, kind in enumerate(kinds):
            share = n_local // len(kinds) + (number < n_local % len(kinds))
            if share:
                kills: list[Target] = ["client"] * share
                tallies.append(
                    kill_repeatedly(
                        found[kind],
                        kills,
                        folder / f"local {kind}",
                        moments_s=(0.3, 6.0),
                        seed=seed,
                        in_flight=160,
                    )
                )
                print(tallies[-1].line(), flush=True)
        of_cluster = [kind for kind in kinds if kind in ("score", "compare", "simulate", "sweep")]
        n_cluster = n - n_local
        targets: list[Target] = [("client", "worker", "scheduler")[number % 3] for number in range(n_cluster)]
        rng.shuffle(targets)
        for number, kind in enumerate(of_cluster):
            if share := targets[number :: len(of_cluster)]:
                command = found[kind]._replace(name=f"{kind} --cluster", item_s=3 * found[kind].item_s)
                tallies.append(
                    kill_repeatedly(
                        command,
                        share,
                        folder / f"cluster {kind}",
                        moments_s=(0.0, 6.0),
                        at_start=0.3,
                        seed=seed,
                        in_flight=100_000,
                        with_cluster=True,
                    )
                )
                print(tallies[-1].line(), flush=True)
    return tallies


def long_run(n_frames: int, n_kills: int, *, seed: int, item_s: float = 0.008) -> Tally:
    """Kill a run of many frames again and again; the frames are links to some files.

    Each frame takes `item_s` in addition, long enough for all kills to be those of one run. One kill in ten comes
    at any moment after the start, the others up to 2 s after the first frame that was scored in this run.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        contrasts = (0.03, 0.05, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4)
        n_repeats = n_frames // (4 * len(contrasts))
        scene = {"side_px": 64, "contrasts": contrasts, "noise": 0.05}
        scenes.write_dataset(folder / "dataset", repeats=n_repeats, **scene)
        arguments = ("todframes", "score", str(folder / "dataset"), "--quiet")
        command = Command(f"score of {4 * len(contrasts) * n_repeats} frames", arguments, item_s, at_once=False)
        return kill_repeatedly(
            command,
            ["client"] * n_kills,
            folder / "runs",
            moments_s=(0.0, 2.0),
            seed=seed,
            in_flight=16,
            at_start=0.1,
        )


def main() -> int:
    """Run a campaign. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("n", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the name of a command")
    parser.add_argument("--long", type=int, metavar="FRAMES", help="kill one run of so many frames")
    asked = parser.parse_args()
    if asked.long:
        tallies = [long_run(asked.long, asked.n, seed=asked.seed)]
        print(tallies[0].line())
    else:
        tallies = campaign(asked.n, seed=asked.seed, only=asked.only)
    return int(any(tally.faults for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
