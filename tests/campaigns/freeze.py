"""Run every command on sample data and made cases, and compare what it prints and writes with an earlier run.

    python tests/campaigns/freeze.py inputs FOLDER              # makes FOLDER/inputs once, with the version before
    python tests/campaigns/freeze.py keep FOLDER                # keeps what all cases give, in FOLDER/base
    python tests/campaigns/freeze.py compare FOLDER [--only W]  # prints the differences; status 1 if there are any

The cases stand in `freeze_cases.txt`: a line with `=` in front makes inputs; of one with `~`, which prints times,
only the words are compared. Numbers are equal to 1e-9; pictures and pages are compared by name alone.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

CASES = Path(__file__).resolve().with_name("freeze_cases.txt").read_text(encoding="utf-8").splitlines()
SAMPLES = Path(__file__).resolve().parents[2] / "sample_frames"
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])")
MEASURED = re.compile(
    r'"(cpu_s\w*|\w*elapsed\w*|memory_mb|date|time|\w*version\w*|started\w*|run_time_s|saves_s|cpu_ms_per_frame)"'
)
TEXTS = {".json", ".csv", ".toml", ".txt", ".md"}


def environment() -> dict[str, str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "COLUMNS": "100", "NO_COLOR": "1", "PYTHONPATH": ".", "TERM": "dumb"}


def run(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", line],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )


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


def without_times(value: object) -> object:
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if not MEASURED.fullmatch(f'"{k}"')}
    return [without_times(one) for one in value] if isinstance(value, list) else value


def without_measured_columns(text: str) -> str:
    rows = [one.split(",") for one in text.splitlines()]
    kept = [k for k, name in enumerate(rows[0]) if not MEASURED.fullmatch(f'"{name}"')]
    return "\n".join(",".join(row[k] for k in kept if k < len(row)) for row in rows)


def pieces(path: Path, *, words_only: bool) -> tuple[list[str], list[float]]:
    text = path.read_text(encoding="utf-8", errors="replace")
    text = re.sub(r"/tmp/\w+", "TMP", re.sub(r"^\d[\d.]* (m?s|min)$", "", text, flags=re.MULTILINE))
    if path.suffix == ".csv" and MEASURED.search(text.partition("\n")[0].replace(",", '","')):
        text = without_measured_columns(text)
    blocks = text.split("\n", 2) if path.name == "streams.txt" else ["", "", text]
    try:
        content, _, rest = blocks[2].partition("\n\n--\n") if path.name == "streams.txt" else (text, "", "")
        value = without_times(json.loads(content))
        text = "\n".join([*blocks[:2], json.dumps(value, indent=1), rest])
    except (ValueError, IndexError):
        pass
    numbers = [] if words_only else [float(one) for one in NUMBER.findall(text)]
    return re.sub(r"[ ─]+", " ", NUMBER.sub("#", text)).splitlines(), numbers


def differences(name: str, before: Path, after: Path, *, words_only: bool) -> list[str]:
    found = []
    names = {
        str(p.relative_to(root)) for root in (before / name, after / name) for p in root.rglob("*") if p.is_file()
    }
    for file in sorted(names):
        one, other = before / name / file, after / name / file
        if not (one.exists() and other.exists()):
            found.append(f"{name}/{file}: only {'before' if one.exists() else 'after'}")
            continue
        (words, numbers), (words_2, numbers_2) = (pieces(p, words_only=words_only) for p in (one, other))
        if words != words_2:
            gone, new = [w for w in words if w not in words_2], [w for w in words_2 if w not in words]
            found.append(
                f"{name}/{file}: " + " | ".join([*(f"- {w}" for w in gone[:6]), *(f"+ {w}" for w in new[:6])])
            )
        elif len(numbers) != len(numbers_2):
            found.append(f"{name}/{file}: other count of numbers")
        elif bad := [
            (a, b)
            for a, b in zip(numbers, numbers_2, strict=True)
            if not math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)
        ]:
            found.append(f"{name}/{file}: {len(bad)} numbers, first {bad[0]}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["inputs", "keep", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="run the cases whose line has this text")
    given = parser.parse_args()
    if given.what == "inputs":
        make_inputs(given.folder / "inputs")
        return
    lines = [one for one in CASES if one.strip() and one[0] not in "=#"]
    cases = [(f"{number:03}", line.lstrip("~ "), line[0] == "~") for number, line in enumerate(lines)]
    cases = [one for one in cases if given.only in one[1]]
    with tempfile.TemporaryDirectory() as text:
        kept = given.folder / "base" if given.what == "keep" else Path(text)
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda one: result_of(one[0], one[1], given.folder / "inputs", kept), cases))
        if given.what == "keep":
            print(f"{len(cases)} cases kept")
            return
        n_other = 0
        for name, line, words_only in cases:
            found = differences(name, given.folder / "base", kept, words_only=words_only)
            n_other += bool(found)
            if found:
                print(f"{name} {shlex.quote(line)}", *found, sep="\n   ")
        print(f"{len(cases)} cases, {n_other} differ")
    sys.exit(bool(n_other))


if __name__ == "__main__":
    main()
