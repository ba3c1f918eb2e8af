"""The campaign of clips: manifests of clips and frames before trials are damaged, and algorithms do not behave.

python tests/campaigns/clips.py [N] [--seed S]     # 300 cases; three minutes

Each case ends in one of two ways: in one line that names what is wrong, or in the threshold that a literal
computation from the same manifest gives. That reads the manifest with the csv module, takes the frames that come
before each trial, averages them, and scores the averages as still frames, with each gaze.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import todframes as tod
from todframes.base.errors import TodframesError
from todframes.frames.files import read_frame, write_frame
from todframes.parameters import Gaze

BEFORE, N_JUDGED, SIDE_PX, SIZE_PX = 3, 2, 24, 5.0
LEVELS = (0.05, 0.1, 0.2, 0.4, 0.8)
GAZES: tuple[Gaze, ...] = ("tracked", "fixed")
FIT = tod.FitSettings(resamples=40)
OBSERVER = tod.PyramidObserver(position_jitter_samples=0.0)
COLUMNS = ("frame", "orientation", "size_mrad", "contrast", "x_px", "y_px", "trial", "clip", "time_s", "judged")

Row = dict[str, str]


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write clips of frames in strong noise, so that each frame matters to the threshold."""
    (folder / "frames").mkdir(parents=True)
    (folder / "dataset.toml").write_text(
        "schema = 1\n[display]\neotf = 'linear'\npixel_pitch_mrad = 0.3\nwhite_luminance_cd_m2 = 1.0\n"
        "background_luminance_cd_m2 = 0.5\n[experiment]\nlevel = 'contrast'\n"
    )
    rows = []
    for level in LEVELS:
        for turn in tod.ORIENTATIONS:
            clip = f"{level}_{turn}"
            for k in range(BEFORE + 2 * N_JUDGED):
                x = 11.0 + 0.5 * k / 4
                shape = tod.coverage((SIDE_PX,) * 2, size_px=SIZE_PX, x_px=x, y_px=11.5, orientation=turn)
                noise = 0.3 * rng.standard_normal(shape.shape)
                name = f"frames/{clip}_{k}.exr"
                write_frame(folder / name, 0.5 * (1.0 + level * shape + noise), pixel_type="float")
                trial = f"{clip}_{(k - BEFORE) // N_JUDGED}" if k >= BEFORE else ""
                values = (name, str(turn), 0.3 * SIZE_PX, level, x, 11.5, trial, clip, k / 25.0, int(k >= BEFORE))
                rows.append(dict(zip(COLUMNS, map(str, values), strict=True)))
    write(folder, rows)


def read(folder: Path) -> list[Row]:
    with (folder / "manifest.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(folder: Path, rows: Sequence[Row]) -> None:
    with (folder / "manifest.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


# What happens to a dataset


def rows_dropped(rows: list[Row], rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 4))):
        del rows[int(rng.integers(len(rows)))]


def rows_swapped(rows: list[Row], rng: np.random.Generator) -> None:
    one, other = rng.choice(len(rows), 2, replace=False)
    rows[one], rows[other] = rows[other], rows[one]


def trials_shuffled(rows: list[Row], rng: np.random.Generator) -> None:
    """Clips in another order, interleaved: each stays in the order of time."""
    clips = {name: [row for row in rows if row["clip"] == name] for name in {row["clip"]: None for row in rows}}
    rows.clear()
    while clips:
        name = list(clips)[int(rng.integers(len(clips)))]
        rows.append(clips[name].pop(0))
        if not clips[name]:
            del clips[name]


def field_changed(rows: list[Row], rng: np.random.Generator) -> None:
    column = str(rng.choice(["clip", "time_s", "judged", "trial", "x_px"]))
    other = rows[int(rng.integers(len(rows)))][column]
    rows[int(rng.integers(len(rows)))][column] = str(
        rng.choice(["", "0", "1", "-1", "nan", "inf", "1e308", "2", "soon", " 0.08 ", "\u0661", other])
    )


def all_times_changed(rows: list[Row], rng: np.random.Generator) -> None:
    factor, offset = float(rng.choice([-1.0, 0.0, 1e-300, 1e300, 2.0])), float(rng.choice([0.0, -1e9, 7.0]))
    for row in rows:
        row["time_s"] = repr(factor * float(row["time_s"]) + offset)


def nothing_judged(rows: list[Row], rng: np.random.Generator) -> None:
    for row in rows[:: int(rng.choice([1, 2]))]:
        row["judged"] = "0"


def column_missing(rows: list[Row], rng: np.random.Generator) -> None:
    column = str(rng.choice(["clip", "time_s", "judged", "trial"]))
    for row in rows:
        del row[column]


def frame_cut(folder: Path, rows: list[Row], rng: np.random.Generator) -> None:
    path = folder / rows[int(rng.integers(len(rows)))]["frame"]
    path.write_bytes(path.read_bytes()[: int(rng.integers(0, path.stat().st_size))])


def frame_gone(folder: Path, rows: list[Row], rng: np.random.Generator) -> None:
    (folder / rows[int(rng.integers(len(rows)))]["frame"]).unlink()


def frame_of_other_kind(folder: Path, rows: list[Row], rng: np.random.Generator) -> None:
    """Of another size, or in colour: three equal channels are grey, others are not."""
    path = folder / rows[int(rng.integers(len(rows)))]["frame"]
    values = read_frame(path).values[..., 0]
    changed = (
        np.pad(values, ((0, 0), (0, 3)), mode="edge"),
        np.stack([values] * 3, axis=-1),
        np.stack([values, values, 0.9 * values], axis=-1),
    )[int(rng.integers(3))]
    write_frame(path, changed, pixel_type="float")


OF_ROWS: tuple[Callable[[list[Row], np.random.Generator], None], ...] = (
    *(rows_dropped, rows_swapped, trials_shuffled, field_changed, field_changed, field_changed),
    *(all_times_changed, nothing_judged, column_missing),
)

OF_FILES: tuple[Callable[[Path, list[Row], np.random.Generator], None], ...] = (
    *(frame_cut, frame_gone, frame_of_other_kind),
)


# Algorithms


def mean(frames: np.ndarray, judged: np.ndarray) -> np.ndarray:
    return np.stack([frames[k - BEFORE : k + 1].mean(axis=0) for k in judged])


def written_into(frames: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """The same, by a function that spoils its input."""
    found = mean(frames, judged)
    frames[:] = np.nan
    return found


GOOD = (mean, written_into)

BAD: dict[str, Callable[[np.ndarray, np.ndarray], object]] = {
    "all frames": lambda frames, _: frames,
    "one frame": lambda frames, judged: frames[judged].mean(axis=0),
    "no array": lambda *_: None,
    "no frames": lambda frames, _: frames[:0],
    "integers": lambda frames, judged: frames[judged].astype(int),
    "NaN": lambda frames, judged: frames[judged] * np.nan,
    "raises": lambda *_: {}["no\nsuch key"],
    "exits": lambda *_: sys.exit("bye"),
}


def declared(function: Callable[[np.ndarray, np.ndarray], object]) -> Callable[..., object]:
    def enhance(frames, *, judged):
        return function(frames, judged)

    return tod.algorithm(clip=True, warm_up_frames=BEFORE)(enhance)


# How cases end


def literal(folder: Path, gaze: Gaze) -> float | None:
    """Return the threshold of the mean with a gaze, from the manifest and the frames alone."""
    rows = read(folder)
    in_time: dict[str, list[Row]] = {}
    for row in rows:
        in_time.setdefault(row.get("clip", "").strip(), []).append(row)
    trials: dict[str, list[Row]] = {}
    for row in rows:
        if row.get("judged", "1").strip() != "0":
            trials.setdefault(row.get("trial", "").strip() or row["frame"], []).append(row)
    stills, of_trials, places = [], [], []
    for own in trials.values():
        luminances = []
        for row in own:
            clip = in_time[row["clip"].strip()]
            at = clip.index(row)
            frames = [read_frame(folder / one["frame"]).values for one in clip[at - BEFORE : at + 1]]
            wide = [np.broadcast_to(one, (*one.shape[:2], 3)) for one in frames]
            luminances.append(np.mean(wide, axis=0) @ (0.2126, 0.7152, 0.0722))
            intervals = np.diff([float(one["time_s"]) for one in clip[at - BEFORE : at + 1]])
            assert intervals.max() < 1.51 * np.median(intervals), "a gap is taken for a clip"
        stills += luminances
        of_trials += [own[0]] * len(own)
        places += [(float(row["x_px"]), float(row["y_px"])) for row in own]
    found = tod.score_frames(
        stills,
        display=tod.Display(
            eotf="linear", white_luminance_cd_m2=1.0, background_luminance_cd_m2=0.5, pixel_pitch_mrad=0.3
        ),
        orientation=[row["orientation"] for row in of_trials],
        level=[float(row["contrast"]) for row in of_trials],
        size_mrad=[float(row["size_mrad"]) for row in of_trials],
        group={},
        position=places,
        trial=[row.get("trial", "").strip() or row["frame"] for row in of_trials],
        clip="all",
        time_s=np.arange(len(stills), dtype=float).tolist(),
        observer=OBSERVER,
        gaze=gaze,
        plan="full",
        fit=FIT,
        examples=False,
    )
    return found.fits[0].threshold


def ending(folder: Path, function: Callable[[np.ndarray, np.ndarray], object], name: str) -> tuple[str, bool]:
    """Compare with an algorithm; return in words how that ends, and whether it is a fault."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = tod.compare(
                folder,
                [declared(function)],
                observer=OBSERVER,
                gaze=GAZES,
                plan="full",
                white=2.0,
                fit=FIT,
                examples=False,
            )
    except TodframesError as error:
        line = str(error)
        is_fault = "\n" in line or len(line) > 600 or not line.strip()
        return ("one line" if not is_fault else f"unclear: {line!r}"), is_fault
    except BaseException as error:  # which the campaign looks for
        return f"{type(error).__name__}: {error}", True
    if name in BAD:
        return f"the algorithm {name!r} is accepted", True
    for gaze, algorithms in zip(GAZES, (found.algorithms, found.observers[0].algorithms), strict=True):
        try:
            threshold, expected = algorithms[1].fits[0].threshold, literal(folder, gaze)
        except AssertionError as error:
            return str(error), True
        is_known = threshold is not None and expected is not None
        is_same = threshold == expected or (is_known and abs(threshold / expected - 1.0) < 1e-4)  # 32-bit values
        if not is_same:
            return f"gaze {gaze}: threshold {threshold}, literally {expected}", True
    return "the literal threshold", False


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign and print what it has found. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("n", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args(arguments)
    tally: Counter[tuple[str, str]] = Counter()
    n_faults = 0
    with tempfile.TemporaryDirectory() as place:
        whole = Path(place, "whole")
        make(whole, np.random.default_rng(asked.seed))
        for number in range(asked.n):
            rng = np.random.default_rng([asked.seed, number])
            folder = Path(place, f"case_{number}")
            shutil.copytree(whole, folder)
            if rng.random() < 0.1:
                name = str(rng.choice(list(BAD)))
                what, function = f"algorithm: {name}", BAD[name]
            else:
                name = ""
                function, rows = GOOD[int(rng.integers(2))], read(folder)
                number_of_mishap = int(rng.integers(len(OF_ROWS) + len(OF_FILES) + 1))
                if number_of_mishap < len(OF_ROWS):
                    of_rows = OF_ROWS[number_of_mishap]
                    what = of_rows.__name__
                    of_rows(rows, rng)
                elif number_of_mishap < len(OF_ROWS) + len(OF_FILES):
                    of_files = OF_FILES[number_of_mishap - len(OF_ROWS)]
                    what = of_files.__name__
                    of_files(folder, rows, rng)
                else:
                    what = "nothing"
                write(folder, rows)
            how, is_fault = ending(folder, function, name)
            n_faults += is_fault
            tally[what, "fault" if is_fault else how] += 1
            if is_fault:
                print(f"FAULT case {number}, {what}: {how}", flush=True)
            shutil.rmtree(folder)
    for (what, how), count in sorted(tally.items()):
        print(f"{count:6}  {what}: {how}")
    print(f"{asked.n} cases, {n_faults} faults")
    return int(bool(n_faults))


if __name__ == "__main__":
    sys.exit(main())
