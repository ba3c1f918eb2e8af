"""Runs the campaigns of this folder; exit status 1 if a case has not ended as it should.

python tests/campaigns/run.py mutations [N]        # 10,000 mutated frames and settings files; half an hour
python tests/campaigns/run.py media [N]            # 4,000 mutated recordings
python tests/campaigns/run.py cameras [N]          # some 240 hostile papers of a camera by hand, then mutated ones
python tests/campaigns/run.py bombs                # small files that claim much memory
python tests/campaigns/run.py kills [N]            # 100 kills of clients, workers and schedulers
python tests/campaigns/run.py long-run [N]         # 100 kills of one run of 20,000 frames
python tests/campaigns/run.py faults               # full disks, second runs, files that change
python tests/campaigns/run.py servers              # endless, slow, compressed, cut and moved answers
python tests/campaigns/run.py decoys               # modules and settings in the working folder
python tests/campaigns/run.py explorer [N]         # 300 states of the explorer's page, requests held back
python tests/campaigns/run.py networks [N]         # 500 damaged neural networks, and hostile settings
python tests/campaigns/run.py people [N]           # 5 people of each of 8 kinds sit the experiment in Chromium
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import camera_files
import damage
import decoys
import explorer
import faults
import kills
import media
import networks_damaged
import servers
import sitters


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign and print what it has found. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ["mutations", "media", "cameras", "bombs", "kills", "long-run", "faults"]
    names += ["decoys", "servers", "people", "explorer", "networks"]
    parser.add_argument("campaign", choices=names)
    parser.add_argument(
        "n",
        nargs="?",
        type=int,
        help="number of mutations, kills, people of a kind or states [default: 10,000, 100, 5, 300]",
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutation, to repeat a case")
    parser.add_argument("--frames", type=int, default=20_000, help="number of frames of the long run")
    parser.add_argument("--only", default="", help="part of the name of a case, command or kind of people")
    asked = parser.parse_args(arguments)
    match asked.campaign:
        case "mutations":
            outcomes = damage.run_campaign(asked.n or 10_000, seed=asked.seed, first=asked.first)
            print(damage.table(outcomes))
            return int(any(one.is_fault for one in outcomes))
        case "media" | "cameras":
            script, n = {"media": (media, 4000), "cameras": (camera_files, 1200)}[asked.campaign]
            outcomes = damage.run_campaign(
                asked.n or n, seed=asked.seed, first=asked.first, script=str(script.__file__)
            )
            print(damage.table(outcomes))
            return int(any(one.is_fault for one in outcomes))
        case "bombs":
            n, n_faults = media.bombs(asked.only)
            print(f"{n} cases, {n_faults} faults")
            return int(bool(n_faults))
        case "kills":
            tallies = kills.campaign(asked.n or 100, seed=asked.seed, only=asked.only)
            return int(any(tally.faults for tally in tallies))
        case "long-run":
            tally = kills.long_run(asked.frames, asked.n or 100, seed=asked.seed)
            print(tally.line())
            return int(bool(tally.faults))
        case "people":
            return int(bool(sitters.campaign(asked.n or 5, seed=asked.seed, only=asked.only)))
        case "decoys":
            n, n_decoys, found = decoys.campaign(only=asked.only)
            print(*found, sep="\n", end="\n" if found else "")
            print(f"{n} commands among {n_decoys} decoys, {len(found)} faults")
            return int(bool(found))
        case "explorer":
            walked = explorer.campaign(asked.n or 300, seed=asked.seed)
            print(walked.line())
            return int(bool(walked.faults))
        case "servers":
            n, found = servers.campaign(only=asked.only)
        case "networks":
            n, found = networks_damaged.campaign(asked.n or 500, seed=asked.seed, first=asked.first)
            print(*found, sep="\n", end="\n" if found else "")
        case _:
            n, found = faults.campaign(seed=asked.seed, only=asked.only)
    print(f"{n} cases, {len(found)} faults")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
