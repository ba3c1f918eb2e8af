"""Makes the table of machines.md: python docs/how_to/make_machines.py FOLDER.

The commands of the page are run in FOLDER, some ten minutes; those whose output is there are not run again. What
stands in the page between <!-- =efficiency --> and <!-- / --> is written anew. Seeds are fixed.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import todframes as tod
from todframes.results.wording import interval_phrase, plain

HERE = Path(__file__).parent
SETS = {"even": "even", "sky": "clouds"}


def commands(page: str) -> list[list[str]]:
    """The commands of the page, with scripts and programs by their paths."""
    (block,) = re.findall(r"^```sh machines\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    lines = [shlex.split(line) for line in block.replace("\\\n", "").splitlines()]
    found = []
    for program, *arguments in lines:
        if program == "python":
            found.append([sys.executable, str(HERE / "machines" / arguments[0]), *arguments[1:]])
        else:
            found.append([sys.executable, "-m", program.replace("-", "_"), *arguments])
    return found


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def efficiency_table(folder: Path) -> str:
    """Thresholds of the network, and its efficiency relative to the others with its interval."""
    rows = []
    for name, background in SETS.items():
        data = tod.load_result(folder / f"score_{name}")
        for fit in data.fits:
            of_group = [one for one in data.efficiencies if one.group == fit.group]
            shown = [
                f"{plain(one.efficiency)} ({interval_phrase(one.efficiency_ci95)})" if one.efficiency else "–"
                for one in of_group
            ]
            rows.append([background, f"{fit.group['size_detectors']:g}", plain(fit.threshold), *shown])
    header = ["background", "size (detectors)", "threshold contrast"]
    return table([*header, *(f"efficiency relative to `{name}`" for name in ("informative", "csf"))], rows)


def main() -> None:
    """Run the commands and write the page."""
    folder, page = Path(sys.argv[1]), (HERE / "machines.md").read_text(encoding="utf-8")
    folder.mkdir(exist_ok=True)
    for command in commands(page):
        made = command[-1] if command[-2] == "-o" else command[2]
        if not (folder / made).exists():
            print(" ".join(command[1:]), flush=True)
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    page = re.sub(
        r"(<!-- =efficiency -->\n).*?(<!-- / -->)",
        rf"\g<1>{efficiency_table(folder)}\n\g<2>",
        page,
        flags=re.DOTALL,
    )
    (HERE / "machines.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
