"""Makes the tables and the picture of machines.md: python docs/how_to/make_machines.py FOLDER.

The commands of the page are run in FOLDER, some ten minutes; those whose output is there are not run again. What
stands in the page between <!-- =NAME --> and <!-- / --> is written anew. Seeds are fixed.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

import todframes as tod
from todframes.results.wording import interval_phrase, plain

HERE = Path(__file__).parent
SETS = {"even": "even", "sky": "clouds"}
OBSERVERS, ALGORITHMS = ("pyramid", "csf", "network"), ("clahe", "unsharp")
TICKS = (0.3, 0.5, 0.7, 1.0, 1.4)


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


def ratios(folder: Path) -> dict[tuple[str, str, str, float], tuple[float | None, ...]]:
    """Ratios of thresholds and the ends of their intervals, by background, algorithm, observer and size."""
    found = {}
    for name, background in SETS.items():
        for observer in OBSERVERS:
            reference, *others = tod.load_result(folder / f"{observer}_{name}").conditions
            for algorithm, one in zip(ALGORITHMS, others, strict=True):
                for fit, ratio in zip(reference.fits, one.ratios, strict=True):
                    key = background, algorithm, observer, fit.group["size_detectors"]
                    found[key] = ratio.ratio, *(ratio.ratio_ci95 or (None, None))
    return found


def enhancement_table(folder: Path) -> str:
    """Ratios of thresholds of all observers after each algorithm, with intervals."""
    found, rows = ratios(folder), []
    for background in SETS.values():
        for size in sorted({key[-1] for key in found}):
            each = [found[background, name, observer, size] for name in ALGORITHMS for observer in OBSERVERS]
            shown = [f"{ratio:.2f} ({low:.2f}–{high:.2f})" if ratio else "–" for ratio, low, high in each]
            rows.append([background, f"{size:g}", *shown])
    header = [f"`{name}`, {observer}" for name in ALGORITHMS for observer in OBSERVERS]
    return table(["background", "size", *header], rows)


def draw(folder: Path) -> None:
    """Draw the ratios: a panel for each background and algorithm, a colour for each observer."""
    found = ratios(folder)
    figure, panels = plt.subplots(1, 4, figsize=(10.0, 3.4), sharey=True, layout="constrained")
    for panel, (background, name) in zip(panels, product(SETS.values(), ALGORITHMS), strict=True):
        panel.axhline(1.0, color="0.6", linewidth=0.8)
        for k, observer in enumerate(OBSERVERS):
            sizes = sorted(size for b, a, o, size in found if (b, a, o) == (background, name, observer))
            known = [(size, *found[background, name, observer, size]) for size in sizes]
            known = [one for one in known if None not in one]
            at, ratio, low, high = np.array(known).T
            spread = [ratio - low, high - ratio]
            panel.errorbar(at * 1.06 ** (k - 1), ratio, spread, fmt="o-", markersize=4, capsize=2, label=observer)
        panel.set_xscale("log")
        panel.set_xticks(sizes, [f"{size:g}" for size in sizes])
        panel.minorticks_off()
        panel.set_title(f"{name}, {background}", fontsize=10)
        panel.set_xlabel("size, detectors")
    panels[0].set_yscale("log")
    panels[0].set_yticks(TICKS, [f"{tick:g}" for tick in TICKS])
    panels[0].yaxis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("threshold ÷ without enhancement")
    panels[0].legend(frameon=False, fontsize=9)
    figure.savefig(HERE / "machines" / "disagree.png", dpi=110)


def main() -> None:
    """Run the commands and write the page."""
    folder, page = Path(sys.argv[1]), (HERE / "machines.md").read_text(encoding="utf-8")
    folder.mkdir(exist_ok=True)
    for command in commands(page):
        made = command[-1] if command[-2] == "-o" else command[2]
        if not (folder / made).exists():
            print(" ".join(command[1:]), flush=True)
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    for key, text in (("efficiency", efficiency_table(folder)), ("enhancements", enhancement_table(folder))):
        page = re.sub(rf"(<!-- ={key} -->\n).*?(<!-- / -->)", rf"\g<1>{text}\n\g<2>", page, flags=re.DOTALL)
    (HERE / "machines.md").write_text(page, encoding="utf-8")
    draw(folder)


if __name__ == "__main__":
    main()
