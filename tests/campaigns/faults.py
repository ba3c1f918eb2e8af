"""The campaign of faults around a run: full disks, second runs, files that change, stores that are damaged.

Every case ends in the right result or in one clear line. When its cause is gone, the same command goes on from
what was finished, and gives the bytes of a run that nothing disturbed.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import scenes
from forks import Forked, import_all, in_a_fork
from kills import STORE, records, stored_keys

LONGEST_S = 300.0

ITEM_S = 0.015
"""Time that each trial takes in addition, so that there is time to disturb the run."""

FOUND = re.compile(r"(?:([0-9]+) of [0-9]+ parts of the work|([0-9]+) windows) are there from an earlier run")

NOTES = ("note: ", "warning: ", "located: ", "dashboard: ")


class FaultError(AssertionError):
    """A case that has not ended as it should."""


def expect(is_true: object, what: str) -> None:
    """Raise FaultError unless something is true."""
    if not is_true:
        raise FaultError(what)


class Ended(NamedTuple):
    """The end of a command."""

    status: int
    err: str

    @property
    def errors(self) -> list[str]:
        """Lines on standard error but for remarks."""
        return [line for line in self.err.splitlines() if not line.startswith(NOTES) and not FOUND.match(line)]

    @property
    def n_found(self) -> int:
        """Number of items, or lists of them, that were there from an earlier run."""
        found = FOUND.search(self.err)
        return int(found[1] or found[2]) if found else 0

    def is_refused(self, *words: str) -> None:
        """Expect one clear line with these words."""
        is_clear = self.status in (1, 2) and len(self.errors) == 1 and self.errors[0].startswith("error: ")
        expect(is_clear, f"status {self.status}, {self.err[-600:]!r}; expected one line")
        expect(all(word in self.errors[0] for word in words), f"{self.errors[0]!r} without {words}")

    def is_done(self) -> None:
        """Expect that the command has done its work and said nothing else."""
        expect(
            self.status == 0 and not self.errors, f"status {self.status}, {self.err[-600:]!r}; expected a result"
        )


class Lab:
    """A folder with what the commands read.

    Attributes
    ----------
    folder : Path
        Folder of the present case.
    rng : random.Random
    """

    def __init__(
        self, folder: Path, seed: int, known: dict[object, dict[str, Any]], *, n_repeats: int = 12
    ) -> None:
        self.folder, self.rng, self._known = folder, random.Random(seed), known
        folder.mkdir()
        self.dataset = folder / "dataset"
        # In another process: OpenImageIO's threads would be missing in copies of this one.
        scene = {"contrasts": (0.05, 0.1, 0.2, 0.4), "repeats": n_repeats, "noise": 0.02, "linked": False}
        self.frames: list[str] = in_a_fork(scenes.write_dataset, self.dataset, **scene)
        self.out = folder / "out"
        self.n_repeats = n_repeats

    def score(self, out: Path | None = None, *more: str, dataset: Path | None = None) -> list[str]:
        """Return the arguments of a scoring."""
        return [*self.scored(dataset), "-o", str(out or self.out), *more]

    def scored(self, dataset: Path | None = None) -> list[str]:
        """Return the arguments of a scoring without `-o`."""
        return ["todframes", "score", str(dataset or self.dataset), "--set", "resamples=40"]

    @cached_property
    def commands(self) -> dict[str, list[str]]:
        """The arguments of all commands that go on, without `-o`."""
        scenes.write_recording(self.folder / "recording", n_frames=300, side_px=160)
        sensor, recording = str(scenes.SAMPLES / "staring_camera.toml"), self.folder / "recording"
        sizes = ["--size-detectors", "2,3", "--snr", "1,2"]
        imported = ["--schedule", str(recording / "schedule.csv"), "--frames-per-second", "30"]
        imported += ["--warm-up", "4"]
        enhanced = ["--enhance", "gaussian:sigma=1", "--white", "100", "--set", "resamples=40"]
        varied = ["--vary", "optics.aperture_mm=100:200:8", "--size-detectors", "4", "--tolerance", "0.05"]
        return {
            "score": self.scored(),
            "compare": ["todframes", "compare", str(self.dataset), *enhanced],
            "simulate": ["sensor_sim", "simulate", sensor, *sizes, "--trials", str(8 * self.n_repeats)],
            "import": ["todframes", "import", str(recording / "frames.npy"), *imported],
            "sweep": ["sensor_sim", "sweep", sensor, *varied],
        }

    def start(self, arguments: Sequence[str], *, item_s: float = 0.0, limit_bytes: int | None = None) -> Forked:
        """Start a command whose results are kept from the first on."""
        environment = {"CAMPAIGN_LOG": os.devnull, "CAMPAIGN_ITEM_S": str(item_s), "CAMPAIGN_AT_ONCE": "1"}
        return Forked(arguments, self.folder.parent, environment, limit_bytes)

    def end(self, process: Forked) -> Ended:
        """Wait for the end of a command."""
        try:
            return Ended(process.wait(LONGEST_S), process.err)
        except subprocess.TimeoutExpired:
            process.kill()
            raise FaultError(f"took more than {LONGEST_S:g} s") from None

    def run(self, arguments: Sequence[str], **how: Any) -> Ended:
        """Run a command to its end."""
        return self.end(self.start(arguments, **how))

    def undisturbed(self, arguments: Sequence[str]) -> dict[str, Any]:
        """Return what a run leaves that nothing disturbs; all cases are in one folder and have it in common."""
        files = (
            [path for path in sorted(self.dataset.rglob("*")) if path.is_file()] if self.dataset.exists() else []
        )
        key = *arguments, *((path, path.read_bytes()) for path in files)
        if key not in self._known:
            out = self.folder / "undisturbed"
            self.run([*arguments, "-o", str(out)]).is_done()
            self._known[key] = scenes.content(out)
            shutil.rmtree(out)
        return self._known[key]

    def half_done(self, arguments: Sequence[str], out: Path | None = None, *, item_s: float = ITEM_S) -> int:
        """Kill a run half-way; return the number of results in its store."""
        process = self.start(arguments, item_s=item_s)
        until_begun(process, out or self.out)
        time.sleep(self.rng.uniform(0.2, 0.8))
        process.kill()
        return len(stored_keys(out or self.out))

    def goes_on(self, arguments: Sequence[str], wanted: dict[str, Any], out: Path | None = None) -> int:
        """Run a command to its good end and compare; return how much was there from an earlier run."""
        ended = self.run(arguments)
        ended.is_done()
        expect_same(scenes.content(out or self.out), wanted)
        expect(not (out or self.out).joinpath(".todframes-staging").exists(), "the staging folder is left")
        return ended.n_found


def expect_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Expect the same files, but for the path of the dataset."""
    differ = sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))
    expect(not differ, f"other content: {differ}")


def until_begun(process: Forked, out: Path) -> None:
    """Wait until the store has results."""
    deadline = time.monotonic() + 60
    while not stored_keys(out):
        if time.monotonic() > deadline or process.poll() is not None:
            process.kill()
            raise FaultError(f"no store has been begun: {process.err[-600:]}")
        time.sleep(0.01)


@contextmanager
def small_disk(path: Path, size_kb: int) -> Iterator[Callable[[str], None]]:
    """Mount a disk of a size; yields the function that changes its options, such as `size=64m`."""
    path.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(path)], check=True)

    def change(options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(path)], check=True)

    try:
        yield change
    finally:
        subprocess.run(["umount", str(path)], check=True)


# Full disks and places that cannot be written ------------------------------------------------------------------


SIZES_KB = (16, 48, 96, 160, 256, 384, 512, 2000, 3000)


def full_disk(lab: Lab, kind: str) -> None:
    """The disk of OUT fills up at one moment or another, and is then made larger."""
    command = lab.commands[kind]
    command = lab.scored() if kind == "score" else command
    wanted = lab.undisturbed(command)
    n_full = most_found = 0
    with small_disk(lab.folder / "disk", SIZES_KB[0]) as change:
        out = lab.folder / "disk" / "out"
        for size_kb in SIZES_KB:
            change(f"size={size_kb}k")
            ended = lab.run([*command, "-o", str(out)])
            most_found = max(most_found, ended.n_found)
            if ended.status == 0:
                break
            n_full += 1
            ended.is_refused()
            left = scenes.content(out) if out.exists() else {}
            expect(not left, f"something was written to a full disk: {list(left)}")
        else:
            change("size=64m")
            ended = lab.run([*command, "-o", str(out)])
            most_found = max(most_found, ended.n_found)
        ended.is_done()
        expect_same(scenes.content(out), wanted)
        expect(n_full, "no disk was small enough")
        expect(most_found or kind in ("sweep",), "nothing that was finished was found again")


def largest_file(lab: Lab) -> None:
    """The system limits the size of files, as a quota does."""
    wanted = lab.undisturbed(lab.scored())
    lab.run(lab.score()).is_done()
    largest_bytes = max(path.stat().st_size for path in lab.out.iterdir())
    shutil.rmtree(lab.out)
    for limit_bytes in (1_000, 20_000, largest_bytes - 1):
        lab.run(lab.score(), limit_bytes=limit_bytes).is_refused()
        expect(not lab.out.exists() or not scenes.content(lab.out), "something was written")
    lab.goes_on(lab.score(), wanted)


def read_only(lab: Lab, kind: str) -> None:
    """OUT lies on a disk that cannot be written: told before the work."""
    with small_disk(lab.folder / "disk", 1000) as change:
        change("ro")
        command = lab.commands[kind]
        started = time.monotonic()
        lab.run([*command, "-o", str(lab.folder / "disk" / "out")], item_s=1.0).is_refused("Read-only file system")
        expect(time.monotonic() - started < 60.0, "only told after the work")


def read_only_dataset(lab: Lab) -> None:
    """The dataset lies on a disk that cannot be written: that is no hindrance."""
    with small_disk(lab.folder / "disk", 64_000) as change:
        moved = lab.folder / "disk" / "dataset"
        shutil.copytree(lab.dataset, moved)
        change("ro")
        wanted = lab.undisturbed(lab.scored(moved))
        expect(lab.half_done(lab.score(dataset=moved)), "nothing was stored")
        expect(lab.goes_on(lab.score(dataset=moved), wanted), "nothing was found again")


# Several runs --------------------------------------------------------------------------------------------------


def two_runs_into_one(lab: Lab, kind: str) -> None:
    """A second run into the same folder is told, and the first one is whole."""
    command = lab.commands[kind]
    wanted = lab.undisturbed(command)
    command = [*command, "-o", str(lab.out)]
    first = lab.start(command, item_s=10 * ITEM_S if kind != "score" else ITEM_S)
    until_begun(first, lab.out)
    lab.run(command).is_refused("another run is writing there")
    lab.end(first).is_done()
    expect_same(scenes.content(lab.out), wanted)


def two_runs_into_two(lab: Lab) -> None:
    """Two runs of one dataset into two folders do not disturb each other."""
    wanted = lab.undisturbed(lab.scored())
    places = lab.out, lab.folder / "other"
    runs = [lab.start(lab.score(place), item_s=ITEM_S) for place in places]
    for run, place in zip(runs, places, strict=True):
        lab.end(run).is_done()
        expect_same(scenes.content(place), wanted)


# Frames that change --------------------------------------------------------------------------------------------


def frame_changes(lab: Lab, how: str, *, is_checked: bool, when: str) -> None:
    """A frame is replaced, cut or deleted while the dataset is scored, before or after it has been seen."""
    if is_checked:
        lab.run(["todframes", "validate", str(lab.dataset), "--add-sha256"])
    command = lab.scored()
    wanted = lab.undisturbed(command)
    frame = lab.dataset / lab.frames[0 if when == "after" else -1]
    other = (lab.dataset / lab.frames[len(lab.frames) // 2]).read_bytes()
    whole = frame.read_bytes()
    run = lab.start(lab.score(None, "--keep-store"), item_s=2 * ITEM_S)
    until_begun(run, lab.out)
    if how == "deleted":
        frame.unlink()
    else:
        new = frame.with_suffix(".new")
        new.write_bytes(other if how == "replaced" else whole[: len(whole) // 2])
        new.replace(frame)
    ended = lab.end(run)
    if ended.status:
        ended.is_refused(str(frame))
    else:
        expect(
            when == "after" or (how == "replaced" and not is_checked), "a frame was changed, and nothing was said"
        )
    # The bytes that a frame has now are what counts.
    if how == "replaced" and not is_checked:
        expect_same(lab_content(lab), lab.undisturbed(command))
    frame.write_bytes(whole)
    expect(lab.goes_on(lab.score(), wanted), "nothing was found again")


def lab_content(lab: Lab) -> dict[str, Any]:
    """Run the scoring again, with what is in the store, and return what it leaves."""
    ended = lab.run(lab.score(None, "--keep-store"))
    ended.is_done()
    expect(ended.n_found, "nothing was found again")
    return scenes.content(lab.out)


def frame_skipped(lab: Lab) -> None:
    """A frame is deleted while the dataset is scored, and bad frames are skipped: it is named, and back later."""
    wanted = lab.undisturbed(lab.scored())
    frame = lab.dataset / lab.frames[-1]
    whole = frame.read_bytes()
    run = lab.start(lab.score(None, "--keep-store", "--on-error", "skip"), item_s=ITEM_S)
    until_begun(run, lab.out)
    frame.unlink()
    ended = lab.end(run)
    if ended.status:
        ended.is_refused(str(frame))
    else:
        skipped = scenes.content(lab.out)["result.json"]["skipped"]
        expect([one["frame"] for one in skipped] == [lab.frames[-1]], f"skipped {skipped}")
    frame.write_bytes(whole)
    expect(lab.goes_on(lab.score(), wanted), "nothing was found again")


def dataset_changes(lab: Lab, name: str) -> None:
    """A text file of the dataset is deleted while it is scored: the run has read it, or says so."""
    wanted = lab.undisturbed(lab.scored())
    run = lab.start(lab.score(), item_s=ITEM_S)
    until_begun(run, lab.out)
    (lab.dataset / name).rename(lab.folder / name)
    ended = lab.end(run)
    if ended.status:
        ended.is_refused(name)
    else:
        expect_same(scenes.content(lab.out), wanted)
    (lab.folder / name).rename(lab.dataset / name)
    lab.goes_on(lab.score(), wanted)


# Stores and folders between runs and during runs ---------------------------------------------------------------


def store_spoilt(lab: Lab, how: str) -> None:
    """The store is deleted, cut, overwritten or replaced between two runs."""
    wanted = lab.undisturbed(lab.scored())
    n_stored = lab.half_done(lab.score())
    store = lab.out / STORE
    content = bytearray(store.read_bytes())
    match how:
        case "deleted":
            store.unlink()
        case "cut":
            os.truncate(store, lab.rng.randrange(store.stat().st_size + 1))
        case "overwritten":
            for _ in range(20):
                place = lab.rng.randrange(len(content))
                content[place : place + 40] = lab.rng.randbytes(len(content[place : place + 40]))
            store.write_bytes(content)
        case "one bit":
            content[lab.rng.randrange(len(content))] ^= 1 << lab.rng.randrange(8)
            store.write_bytes(content)
        case "shuffled":
            store.write_bytes(with_results_moved(bytes(content)))
        case "all zeros":
            store.write_bytes(bytes(len(content)))
        case "a database":
            store.write_bytes(b"SQLite format 3\0" + bytes(100))
        case "an empty file":
            store.write_bytes(b"")
        case "a folder":
            store.unlink()
            store.mkdir()
        case "lock deleted":
            (lab.out / ".todframes-staging" / "lock").unlink()
    expect(n_stored, "nothing was stored")
    ended = lab.run(lab.score())
    if ended.status:
        ended.is_refused()
        ended = lab.run(lab.score(None, "--restart"))
        if how == "lock deleted":  # then the folder is not known to be ours
            ended.is_refused("move it away")
            shutil.rmtree(lab.out / ".todframes-staging")
            ended = lab.run(lab.score())
    ended.is_done()
    expect_same(scenes.content(lab.out), wanted)


def with_results_moved(content: bytes) -> bytes:
    """Return a store in which each result of the usual size stands under the key of another one."""
    found = [*records(content)]
    size = len(found[0].result)
    places = [one.end - size for one in found if len(one.result) == size]
    moved = bytearray(content)
    for place, other in zip(places, [*places[1:], places[0]], strict=True):
        moved[place : place + size] = content[other : other + size]
    return bytes(moved)


def store_deleted_during(lab: Lab, what: str) -> None:
    """The store, the staging folder or OUT is deleted while a run writes there."""
    wanted = lab.undisturbed(lab.scored())
    run = lab.start(lab.score(), item_s=ITEM_S)
    until_begun(run, lab.out)
    if what == "store":
        (lab.out / STORE).unlink()
    else:
        shutil.rmtree({"staging": lab.out / ".todframes-staging", "OUT": lab.out}[what])
    ended = lab.end(run)
    if ended.status:
        ended.is_refused()
    else:
        expect_same(scenes.content(lab.out), wanted)
    lab.goes_on(lab.score(), wanted)


def out_moved(lab: Lab, kind: str) -> None:
    """OUT is moved between two runs, and the second one is given its new name."""
    command = lab.commands[kind]
    wanted = lab.undisturbed(command)
    item_s = {"score": ITEM_S, "compare": ITEM_S, "sweep": 0.2}.get(kind, 0.05)
    lab.half_done([*command, "-o", str(lab.out)], item_s=item_s)
    moved = lab.folder / "moved"
    lab.out.rename(moved)
    found = lab.goes_on([*command, "-o", str(moved)], wanted, moved)
    expect(found, "nothing was found again")


def out_moved_during(lab: Lab) -> None:
    """OUT is moved while a run writes there."""
    wanted = lab.undisturbed(lab.scored())
    run = lab.start(lab.score(), item_s=ITEM_S)
    until_begun(run, lab.out)
    moved = lab.folder / "moved"
    lab.out.rename(moved)
    ended = lab.end(run)
    if ended.status:
        ended.is_refused()
    else:
        expect_same(scenes.content(lab.out), wanted)
    lab.goes_on(lab.score(moved), wanted, moved)


def dataset_moved(lab: Lab) -> None:
    """The dataset is moved between two runs: the path is no part of what a result depends on."""
    expect(lab.half_done(lab.score()), "nothing was stored")
    moved = lab.folder / "moved"
    lab.dataset.rename(moved)
    wanted = lab.undisturbed(lab.scored(moved))
    lab.run(lab.score()).is_refused(str(lab.dataset))
    expect(lab.goes_on(lab.score(dataset=moved), wanted), "nothing was found again")


def staged_frames_spoilt(lab: Lab, kind: str) -> None:
    """Frames that a killed run has written are deleted or damaged before the next run."""
    command = lab.commands[kind]
    wanted = lab.undisturbed(command)
    command = [*command, "-o", str(lab.out)]
    lab.half_done(command, item_s=0.15 if kind == "simulate" else 0.05)
    frames = [path for path in lab.out.glob(".todframes-staging/new/frames/**/*") if path.is_file()]
    expect(frames, "no frames were staged")
    frames[0].unlink()
    frames[-1].write_bytes(frames[-1].read_bytes()[:-1])
    frames[len(frames) // 2].write_bytes(b"")
    lab.goes_on(command, wanted)


CASES: dict[str, Callable[[Lab], None]] = {
    **{
        f"disk full, {kind}": partial(full_disk, kind=kind)
        for kind in ("score", "compare", "simulate", "import", "sweep")
    },
    "largest size of a file": largest_file,
    **{
        f"read-only folder, {kind}": partial(read_only, kind=kind)
        for kind in ("score", "simulate", "import", "sweep")
    },
    "read-only dataset": read_only_dataset,
    **{
        f"two runs into one folder, {kind}": partial(two_runs_into_one, kind=kind)
        for kind in ("score", "compare", "simulate", "import")
    },
    "two runs into two folders": two_runs_into_two,
    **{
        f"frame {how} {when} it was seen, {'with' if is_checked else 'without'} sha256": partial(
            frame_changes, how=how, is_checked=is_checked, when=when
        )
        for how in ("replaced", "cut", "deleted")
        for when in ("before", "after")
        for is_checked in (False, True)
    },
    "frame deleted and skipped": frame_skipped,
    **{
        f"{name} deleted during a run": partial(dataset_changes, name=name)
        for name in ("dataset.toml", "manifest.csv")
    },
    **{
        f"store between runs: {how}": partial(store_spoilt, how=how)
        for how in (
            *("deleted", "cut", "overwritten", "one bit", "shuffled", "all zeros", "a database", "an empty file"),
            *("a folder", "lock deleted"),
        )
    },
    **{
        f"{what} deleted during a run": partial(store_deleted_during, what=what)
        for what in ("store", "staging", "OUT")
    },
    **{
        f"OUT moved between runs, {kind}": partial(out_moved, kind=kind)
        for kind in ("score", "compare", "simulate", "import", "sweep")
    },
    "OUT moved during a run": out_moved_during,
    "dataset moved between runs": dataset_moved,
    **{
        f"staged frames spoilt, {kind}": partial(staged_frames_spoilt, kind=kind)
        for kind in ("simulate", "import")
    },
}


def campaign(*, seed: int, rounds: int = 1, only: str = "") -> tuple[int, list[str]]:
    """Run all cases whose name has a text, or all. Returns their number and the faults."""
    n = 0
    faults: list[str] = []
    known: dict[object, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(Path(folder, "lab"), seed, known)
        import_all(lab.score())
        shutil.rmtree(lab.folder)
        for number in range(rounds):
            for name, case in CASES.items():
                if only not in name:
                    continue
                place = Path(folder, "lab")
                n += 1
                started = time.monotonic()
                try:
                    case(Lab(place, seed + number, known))
                    ending = "as it should"
                except FaultError as error:
                    ending = f"FAULT {error}"
                    faults.append(f"{name}: {error}")
                print(f"{name}: {ending}, {time.monotonic() - started:.0f} s", flush=True)
                shutil.rmtree(place)
    return n, faults
