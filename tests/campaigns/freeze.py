"""Run every command on sample data and made cases, and compare what it prints and writes with an earlier run.

    python tests/campaigns/freeze.py inputs FOLDER              # makes FOLDER/inputs once, with the version before
    python tests/campaigns/freeze.py keep FOLDER                # keeps what all cases give, in FOLDER/base
    python tests/campaigns/freeze.py compare FOLDER [--only W]  # prints the differences; status 1 if there are any
    python tests/campaigns/freeze.py compare FOLDER --kept FOLDER   # with what `keep` has kept there

The cases stand in `freeze_cases.txt`: a line with `=` in front makes inputs; of one with `~`, which prints times,
only the words are compared. Values of JSON are compared key by key, cells of CSV by column; numbers are equal to
1e-9. Pictures and pages are compared by name alone.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path

from scenes import SAMPLES, without_times

CASES = Path(__file__).resolve().with_name("freeze_cases.txt").read_text(encoding="utf-8").splitlines()
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])")
TEXTS = {".json", ".csv", ".toml", ".txt", ".md"}


def run(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    plain = {"PATH": path, "COLUMNS": "100", "NO_COLOR": "1", "PYTHONPATH": ".", "TERM": "dumb"}
    how = {"cwd": folder, "env": os.environ | plain, "capture_output": True, "text": True, "timeout": 900}
    return subprocess.run(["bash", "-c", line], check=False, **how)


def make_inputs(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "sample_frames").symlink_to(SAMPLES.resolve())
    for line in (one[1:].strip() for one in CASES if one.startswith("=")):
        done = run(line, folder)
        print(done.returncode, line)
        if done.returncode:
            sys.exit(done.stderr[-500:])


def result_of(name: str, line: str, inputs: Path, kept: Path) -> None:
    """Run a case among links to the inputs, and keep status, streams and texts in a folder."""
    with tempfile.TemporaryDirectory() as text:
        work = Path(text)
        for one in inputs.iterdir():
            (work / one.name).symlink_to(one.resolve())
        done = run(line, work)
        out = kept / name
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        (out / "streams.txt").write_text(f"$ {line}\nstatus {done.returncode}\n{done.stdout}\n--\n{done.stderr}")
        made = sorted(p for root in work.glob("OUT*") for p in ([root] if root.is_file() else root.rglob("*")))
        (out / "files.txt").write_text("\n".join(str(p.relative_to(work)) for p in made if p.is_file()))
        for path in made:
            if path.is_file() and path.suffix in TEXTS and path.stat().st_size < 2_000_000:
                to = out / path.relative_to(work)
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, to)


def values_of(path: Path, *, words_only: bool) -> dict[str, object]:
    """Return what a file states: values of JSON by their keys, cells of CSV by row and column, words by line."""
    temporary = re.escape(tempfile.gettempdir() + os.sep) + r"\w+"
    text = re.sub(temporary, "TMP", path.read_text(encoding="utf-8", errors="replace"))
    found: dict[str, object] = {}
    if path.name == "streams.txt":
        found["status"] = text.split("\n", 2)[1]
        shown, _, remarks = text.split("\n", 2)[2].rpartition("\n--\n")
        add_text(found, remarks, words_only=words_only)
        text = shown
    if path.suffix == ".csv":
        add(found, without_times(list(csv.DictReader(text.splitlines()))), "row")
        return found
    try:
        add(found, without_times(json.loads(text)), "")
    except ValueError:
        add_text(found, text, words_only=words_only)
    return found


def add(found: dict[str, object], value: object, key: str) -> None:
    """Add a value of JSON, or those in it."""
    if isinstance(value, dict):
        for name, inner in value.items():
            add(found, inner, f"{key}.{name}")
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            add(found, inner, f"{key}[{number}]")
    else:
        found[key] = value


def add_text(found: dict[str, object], text: str, *, words_only: bool) -> None:
    """Add the lines of a text by their words, and the numbers between these; the same line may come again."""
    for line in text.splitlines():
        words = re.sub(r"[ ─]+", " ", NUMBER.sub("#", line))
        numbers = [] if words_only or re.fullmatch("#? ?(m?s|min|h)?", words) else NUMBER.findall(line)
        key = next(key for k in count() if (key := f"{words} ({k})") not in found)
        found[key] = None
        found |= {f"{key}, number {k}": number for k, number in enumerate(numbers)}


def is_same(one: object, other: object) -> bool:
    """Return whether two values are equal, numbers to 1e-9."""
    try:
        return one == other or math.isclose(float(one), float(other), rel_tol=1e-9, abs_tol=1e-12)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False


def differences(name: str, before: Path, after: Path, *, words_only: bool) -> Iterator[str]:
    """Yield what is gone, new and other in the files of a case, a line for each kind and key."""
    roots = before / name, after / name
    for file in sorted({str(p.relative_to(root)) for root in roots for p in root.rglob("*") if p.is_file()}):
        if not all((root / file).exists() for root in roots):
            yield f"{file}: only {'before' if (roots[0] / file).exists() else 'after'}"
            continue
        one, other = (values_of(root / file, words_only=words_only) for root in roots)
        found: dict[str, list[str]] = {}
        for key in dict.fromkeys([*one, *other]):
            if key in one and key in other and is_same(one[key], other[key]):
                continue
            kind = "gone" if key not in other else "new" if key not in one else "other"
            shown = f"{one.get(key, '')} -> {other.get(key, '')}" if kind == "other" else ""
            found.setdefault(re.sub(r"\[\d+\]", "[]", f"{kind} {key}"), []).append(shown)
        yield from (f"{file}: {key} {all_of[0][:160]} ({len(all_of)})" for key, all_of in found.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["inputs", "keep", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="run the cases whose line has this text")
    parser.add_argument("--kept", type=Path, help="folder of another `keep` in place of a new run")
    given = parser.parse_args()
    if given.what == "inputs":
        make_inputs(given.folder / "inputs")
        return
    lines = [one for one in CASES if one.strip() and one[0] not in "=#"]
    cases = [(f"{number:03}", line.lstrip("~ "), line[0] == "~") for number, line in enumerate(lines)]
    cases = [one for one in cases if given.only in one[1]]
    with tempfile.TemporaryDirectory() as text:
        kept = given.folder / "base" if given.what == "keep" else Path(text)
        if given.kept is not None:
            kept = given.kept / "base"
        else:
            with ThreadPoolExecutor(2) as pool:
                list(pool.map(lambda one: result_of(one[0], one[1], given.folder / "inputs", kept), cases))
        if given.what == "keep":
            print(f"{len(cases)} cases kept")
            return
        n_other = 0
        for name, line, words_only in cases:
            found = list(differences(name, given.folder / "base", kept, words_only=words_only))
            n_other += bool(found)
            if found:
                print(f"{name} {shlex.quote(line)}", *found, sep="\n   ")
        print(f"{len(cases)} cases, {n_other} differ")
    sys.exit(bool(n_other))


if __name__ == "__main__":
    main()
