"""Makes table and picture of machines_and_eyes.md: python docs/explanation/make_machines_and_eyes.py FOLDER.

FOLDER is that of docs/how_to/make_machines.py, with the frames and the network. The commands of the page are run
there; those whose output is there are not run again. What stands in the page between <!-- =ratios --> and
<!-- / --> is written anew. Seeds are fixed.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import todframes as tod
from todframes.results.wording import interval_phrase, plain

HERE = Path(__file__).parent
SETS = {"even": "even", "sky": "clouds"}
ALGORITHMS = ("clahe", "unsharp")
COLOURS = {"pyramid": "#444444", "csf": "#0072b2", "network": "#d55e00"}


def run(page: str, folder: Path) -> None:
    """Run the commands of the page whose output is not there."""
    (block,) = re.findall(r"^```sh machines_and_eyes\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    for line in block.replace("\\\n", "").splitlines():
        program, *arguments = shlex.split(line)
        if not (folder / arguments[-1]).exists():
            subprocess.run([sys.executable, "-m", program, *arguments], cwd=folder, check=True)


def conditions_of(result: Any) -> dict[str, Any]:
    """Conditions of each observer, the reference first."""
    each = (result.conditions, *(further.conditions for further in result.observers))
    return dict(zip(COLOURS, each, strict=True))


def text_of(ratio: Any) -> str:
    """A ratio with its interval, and its verdict."""
    if ratio.ratio is None:
        return ratio.verdict
    return f"{plain(ratio.ratio)} ({interval_phrase(ratio.ratio_ci95)}): {ratio.verdict}"


def make(folder: Path) -> tuple[str, Figure]:
    """Table and picture of the results in a folder."""
    header = ["background", "size (detectors)", "algorithm", *(f"`{name}`" for name in COLOURS)]
    lines = [header, ["---"] * len(header)]
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    panels = figure.subplots(len(SETS), len(ALGORITHMS), sharex=True, sharey=True)
    for row, (name, background) in zip(panels, SETS.items(), strict=True):
        by_observer = conditions_of(tod.load_result(folder / f"eyes_{name}"))
        for number, (axes, algorithm) in enumerate(zip(row, ALGORITHMS, strict=True), 1):
            ratios = {who: conditions[number].ratios for who, conditions in by_observer.items()}
            for place, (who, each) in enumerate(ratios.items()):
                known = [(one.group["size_detectors"], one) for one in each if one.ratio is not None]
                size = [1.06 ** (place - 1) * at for at, _ in known]
                axes.plot(size, [one.ratio for _, one in known], "o-", ms=4, lw=1, color=COLOURS[who], label=who)
                for at, (_, one) in zip(size, known, strict=True):
                    axes.plot([at, at], [end or one.ratio for end in one.ratio_ci95], color=COLOURS[who])
            axes.axhline(1.0, color="#999999", lw=0.8)
            axes.set(xscale="log", yscale="log", title=f"{algorithm}, {background}")
            for axis, ticks in ((axes.xaxis, (4, 8, 16)), (axes.yaxis, (0.3, 0.5, 0.7, 1.0, 1.5))):
                axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
                axis.set_ticks([], minor=True)
            for group in zip(*ratios.values(), strict=True):
                at = f"{group[0].group['size_detectors']:g}"
                lines.append([background, at, f"`{algorithm}`", *map(text_of, group)])
    panels[0, 0].legend(fontsize="small")
    figure.supxlabel("size, detectors", fontsize="medium")
    figure.supylabel("threshold after over before", fontsize="medium")
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines), figure


def main() -> None:
    """Run the commands and write page and picture."""
    folder, path = Path(sys.argv[1]), HERE / "machines_and_eyes.md"
    page = path.read_text(encoding="utf-8")
    run(page, folder)
    text, figure = make(folder)
    figure.savefig(HERE / "observers" / "machines_and_eyes.png", dpi=110, metadata={"Software": None})
    page = re.sub(r"(<!-- =ratios -->\n).*?(<!-- / -->)", rf"\g<1>{text}\n\g<2>", page, flags=re.DOTALL)
    path.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
