"""The campaign of planted links: whoever can write to OUT has prepared it to have strangers' files destroyed.

Each case plants something in OUT, or swaps the hidden folder for a link while the command works, and runs a
command. The strangers' files must be as before, byte for byte, and the command must end well or in one clear line.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import scenes
from faults import Ended, FaultError, Lab, expect
from forks import import_all, in_a_fork

sys.path.insert(0, str(Path(__file__).parents[1]))

from people import a_monitor, sit

from todframes.base.output import beside
from todframes.frames.dataset import load_dataset
from todframes.stimulus import ORIENTATIONS

HIDDEN = ".todframes-staging"

RESULT_NAMES = (
    *("result.json", "report.html", "scores.csv", "scores.parquet", "psychometric.png", "tod_curve.png"),
    *("compare.csv", "compare.png", "sweep.csv", "sweep.parquet", "front.png", "map.png", "by_key.png"),
    *("tod_curves.png", "mtf.csv", "mtf.png", "noise.csv", "noise.png", "sensor_noise.toml", "calibration.csv"),
    *("internal_noise.csv", "calibration.png", "calibration.svg", "observer.toml", "manifest.csv", "dataset.toml"),
)


class Plant(NamedTuple):
    """The folder of a result, the files of a stranger, and the name of the hidden folder of the run."""

    out: Path
    theirs: Path
    entry: str = HIDDEN

    @property
    def hidden(self) -> Path:
        """The hidden folder, made as a run makes it."""
        place = self.out / self.entry
        place.mkdir(mode=0o700, exist_ok=True)
        (place / "lock").touch()
        return place


def _link(place: Path, target: Path) -> None:
    place.symlink_to(target)


def _hard_link(place: Path, target: Path) -> None:
    place.hardlink_to(target)


def _pipe(place: Path, _: Path) -> None:
    os.mkfifo(place)


KINDS = {"link": _link, "hard link": _hard_link, "pipe": _pipe}


def _in_hidden(name: str, kind: str) -> Callable[[Plant], None]:
    return lambda plant: KINDS[kind](plant.hidden / name, plant.theirs / "notes.txt")


def _hidden_is_a_link(plant: Plant) -> None:
    (plant.out / plant.entry).symlink_to(plant.theirs)


def _hidden_is_a_link_to_one(plant: Plant) -> None:
    """As a run has made it, with a store and staged frames, at another place."""
    (plant.theirs / "lock").touch()
    (plant.out / plant.entry).symlink_to(plant.theirs)


def _hidden_is_somebodys(plant: Plant) -> None:
    shutil.move(plant.theirs, plant.out / plant.entry)
    plant.theirs.symlink_to(plant.out / plant.entry)


def _lock_is(kind: str) -> Callable[[Plant], None]:
    def plant_it(plant: Plant) -> None:
        (plant.out / plant.entry).mkdir(mode=0o700)
        KINDS[kind](plant.out / plant.entry / "lock", plant.theirs / "notes.txt")

    return plant_it


def _store_folder(plant: Plant) -> None:
    """A folder of another program where the store is, with links to databases."""
    (plant.hidden / "store").mkdir()
    for name in ("results.sqlite", "results.sqlite-wal", "results.sqlite-journal", "results.store"):
        (plant.hidden / "store" / name).symlink_to(plant.theirs / "notes.txt")


def _store_folder_is_a_link(plant: Plant) -> None:
    (plant.hidden / "store").symlink_to(plant.theirs)


def _staged_is_a_link(plant: Plant) -> None:
    (plant.hidden / "new").symlink_to(plant.theirs)


def _staged_frames_are_a_link(plant: Plant) -> None:
    (plant.hidden / "store").write_bytes(b"")
    (plant.hidden / "new").mkdir()
    (plant.hidden / "new" / "frames").symlink_to(plant.theirs)
    for name in ("pages", "sheets", "stages"):
        (plant.hidden / "new" / name).symlink_to(plant.theirs)


def _staged_files_are(kind: str) -> Callable[[Plant], None]:
    def plant_it(plant: Plant) -> None:
        (plant.hidden / "store").write_bytes(b"")
        (plant.hidden / "new" / "frames").mkdir(parents=True)
        for name in (*RESULT_NAMES, "chart.toml", "import.json", "play.html", "frames/s0_n0_up_0.exr"):
            KINDS[kind](plant.hidden / "new" / name, plant.theirs / "notes.txt")

    return plant_it


def _results_are(kind: str) -> Callable[[Plant], None]:
    def plant_it(plant: Plant) -> None:
        for name in RESULT_NAMES:
            (plant.out / name).unlink(missing_ok=True)
            KINDS[kind](plant.out / name, plant.theirs / "notes.txt")

    return plant_it


def _result_names_notes(plant: Plant) -> None:
    """A result that claims a command with files of the stranger's names."""
    (plant.out / "result.json").write_text('{"command": "../theirs", "files": ["notes.txt"]}', encoding="utf-8")
    (plant.out / "notes.txt").symlink_to(plant.theirs / "notes.txt")


def _list_of_moves(plant: Plant) -> None:
    """A list of what a killed run has moved names files that no run has written."""
    (plant.out / "notes.txt").hardlink_to(plant.theirs / "notes.txt")
    (plant.hidden / "new").mkdir()
    (plant.hidden / "moving").write_text('{"notes.txt": 1, "../../theirs/notes.txt": 2}', encoding="utf-8")


PLANTS: dict[str, Callable[[Plant], None]] = {
    "hidden folder is a link": _hidden_is_a_link,
    "hidden folder is a link to one with a lock": _hidden_is_a_link_to_one,
    "hidden folder is somebody's": _hidden_is_somebodys,
    **{f"lock is a {kind}": _lock_is(kind) for kind in KINDS},
    **{f"store is a {kind}": _in_hidden("store", kind) for kind in KINDS},
    "store is a folder of links": _store_folder,
    "store is a link to a folder": _store_folder_is_a_link,
    "staged folder is a link": _staged_is_a_link,
    "staged folders are links": _staged_frames_are_a_link,
    **{f"staged files are {kind}s": _staged_files_are(kind) for kind in KINDS},
    **{f"results are {kind}s": _results_are(kind) for kind in KINDS},
    "result names a stranger's file": _result_names_notes,
    "list of moves names a stranger's file": _list_of_moves,
}


def _theirs(folder: Path) -> None:
    """Write the files of a stranger, under names that runs use, too."""
    (folder / "frames").mkdir(parents=True)
    for name in ("notes.txt", "results.sqlite", "lock", "new", "store", *RESULT_NAMES):
        (folder / name).write_text(f"mine: {name}", encoding="utf-8")
    for name in ("s0_n0_up_0.exr", "s0_n1_up_0.exr"):
        (folder / "frames" / name).write_text("mine", encoding="utf-8")


def _state(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        path.relative_to(folder).as_posix(): (path.lstat().st_mode, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def commands(lab: Lab) -> dict[str, list[str]]:
    """Return the commands that write a folder, without `-o`."""
    sensor = str(scenes.SAMPLES / "staring_camera.toml")
    (lab.folder / "counts.csv").write_text(scenes.COUNTS_CSV, encoding="utf-8")
    monitor = ["--pixel-pitch-mm", "0.25", "--width-px", "640", "--height-px", "480", "--repeats", "1"]
    chart = ["--distance-m", "10", "--sizes-mrad", "1", "--contrasts", "0.2", *monitor]
    answers = in_a_fork(_answers, lab)
    return {
        **lab.commands,
        "curve": ["sensor_sim", "curve", sensor, "--size-detectors", "4", "--tolerance", "0.1"],
        "mtf": ["sensor_sim", "mtf", sensor],
        "naked-eye": ["todframes", "naked-eye", "--size-mrad", "1"],
        "noise": ["todframes", "noise", str(lab.folder / "recording" / "frames.npy")],
        "chart": ["todframes", "chart", "--for", "screen", *chart],
        "calibrate": ["todframes", "calibrate", answers, str(lab.dataset)],
    }


def _answers(lab: Lab) -> str:
    """Let a simulated person sit a session; return the folder of the answers."""
    folder, rng, dataset = lab.folder / "answers", random.Random(1), load_dataset(lab.dataset)
    sit(dataset, folder, lambda *_: rng.choice(ORIENTATIONS), a_monitor(dataset.display.pitch_mrad))
    return str(folder)


def planted(lab: Lab, command: list[str], plant: Callable[[Plant], None]) -> str:
    """Plant something before a command, and judge what is left; return how the command ended."""
    case = Plant(lab.folder / "out", lab.folder / "theirs")
    case.out.mkdir()
    _theirs(case.theirs)
    before = _state(case.theirs)
    plant(case)
    if plant is _hidden_is_a_link_to_one:
        before = _state(case.theirs)
    ended = lab.run([*command, "-o", str(case.out)])
    _judge(ended, before, case.theirs)
    if plant in (_result_names_notes, _list_of_moves):
        expect((case.out / "notes.txt").exists(), "a file of a stranger in OUT has gone")
    if not ended.status:
        last = [case.out / name for name in ("result.json", "dataset.toml", "chart.toml", "mtf.csv")]
        expect(any(one.is_file() and not one.is_symlink() for one in last), "no result was written")
    return "refused" if ended.status else "written"


IN_PLACE = {
    "manifest.csv": ["todframes", "validate", "{}", "--add-sha256"],
    "dataset.toml": ["todframes", "new", "{}", "--from", "{{size_mrad}}/c{{contrast}}_{{orientation}}_{{n}}.exr"],
    "report.html": ["todframes", "report", "{}/result.json"],
}
"""The commands that write a file into a folder that they read, by its name."""


def in_place(lab: Lab, name: str, kind: str, plant: Callable[[Plant], None] | None) -> str:
    """Let a command write a file beside others, where the file or what is hidden has been planted before."""
    case = Plant(lab.folder / "out", lab.folder / "theirs", beside(name))
    shutil.copytree(lab.dataset, case.out)
    shutil.copy(lab.folder / "result.json", case.out)
    _theirs(case.theirs)
    if name == "manifest.csv":
        shutil.copy(lab.dataset / name, case.theirs)
    if name == "dataset.toml":
        for old in ("manifest.csv", "dataset.toml"):
            (case.out / old).unlink()
        (case.out / "frames").rename(case.out / str(scenes.SIZE_MRAD))
    before = _state(case.theirs)
    if plant is None:
        (case.out / name).unlink(missing_ok=True)
        KINDS[kind](case.out / name, case.theirs / name)
    else:
        plant(case)
    ended = lab.run([part.format(case.out) for part in IN_PLACE[name]])
    _judge(ended, before, case.theirs)
    if not ended.status:
        expect((case.out / name).is_file() and not (case.out / name).is_symlink(), "nothing was written")
    return "refused" if ended.status else "written"


def _judge(ended: Ended, before: dict[str, tuple[int, bytes]], theirs: Path) -> None:
    after = _state(theirs)
    differ = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    expect(not differ, f"files of a stranger were written or removed: {differ[:4]}")
    if ended.status:
        ended.is_refused()
    expect("Traceback" not in ended.err, ended.err[-600:])


@contextmanager
def swapping(case: Plant, rng: random.Random) -> Iterator[list[int]]:
    """Swap the hidden folder for a link to the stranger's files, again and again, while a command works."""
    swaps = [0]
    over = threading.Event()

    def swap() -> None:
        hidden, away = case.out / HIDDEN, case.out.parent / "away"
        while not over.wait(rng.uniform(0.0, 0.004)):
            with suppress(OSError):
                hidden.rename(away)
                hidden.symlink_to(case.theirs)
                swaps[0] += 1
                time.sleep(rng.uniform(0.0, 0.004))
                hidden.unlink()
                away.rename(hidden)
            with suppress(OSError):
                if hidden.is_symlink():
                    hidden.unlink()
                if away.is_dir() and not hidden.exists():
                    away.rename(hidden)

    thread = threading.Thread(target=swap)
    thread.start()
    try:
        yield swaps
    finally:
        over.set()
        thread.join()


def swapped(lab: Lab, command: list[str]) -> str:
    """Swap links in during a command."""
    case = Plant(lab.folder / "out", lab.folder / "theirs")
    case.out.mkdir()
    _theirs(case.theirs)
    # What a follower of the link would find to write over: the same folders as in a hidden one.
    for name in ("lock", "new", "store"):
        (case.theirs / name).unlink()
    (case.theirs / "new" / "frames").mkdir(parents=True)
    for name in (*RESULT_NAMES, "chart.toml", "import.json"):
        (case.theirs / "new" / name).write_text("mine", encoding="utf-8")
    (case.theirs / "lock").touch()
    before = _state(case.theirs)
    process = lab.start([*command, "-o", str(case.out)], item_s=0.005)
    with swapping(case, lab.rng):
        ended = lab.end(process)
    _judge(ended, before, case.theirs)
    return "refused" if ended.status else "written"


def cases(lab: Lab) -> list[tuple[str, Callable[[], str]]]:
    """Return the cases, each with what it plants and the command."""
    found: list[tuple[str, Callable[[], str]]] = []
    for kind, command in commands(lab).items():
        found += [(f"{name}, {kind}", partial(planted, lab, command, plant)) for name, plant in PLANTS.items()]
        found += [(f"swapped during the run, {kind}", partial(swapped, lab, command))] * 3
    for file, command in IN_PLACE.items():
        kind = command[1]
        found += [(f"{file} is a {one}, {kind}", partial(in_place, lab, file, one, None)) for one in KINDS]
        found += [(f"{name}, {kind}", partial(in_place, lab, file, "", plant)) for name, plant in PLANTS.items()]
    return found


def campaign(*, seed: int, rounds: int = 1, only: str = "") -> tuple[int, list[str]]:
    """Plant everything before every command, and swap during each. Returns the number of cases and the faults."""
    n = 0
    faults: list[str] = []
    endings: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder, "lab")
        lab = Lab(place, seed, {}, n_repeats=2)
        import_all(lab.score())
        lab.run(lab.score()).is_done()
        (lab.folder / "result.json").write_bytes((lab.out / "result.json").read_bytes())
        shutil.rmtree(lab.out)
        for name, case in cases(lab) * rounds:
            if only not in name:
                continue
            n += 1
            try:
                ending = case()
            except FaultError as error:
                ending = "fault"
                faults.append(f"{name}: {error}")
                print(faults[-1], flush=True)
            endings[ending] = endings.get(ending, 0) + 1
            for left in ("out", "theirs", "away"):
                path = place / left
                if path.is_symlink():
                    path.unlink()
                shutil.rmtree(path, ignore_errors=True)
    print(re.sub(r"[{}']", "", str(endings)))
    return n, faults
