"""Latency and memory of the explorer's server, while the sliders of a page move at random.

    python tests/benchmarks/explorer_latency.py [MOVES] [SENSOR.toml]

Each move sets one slider, of all that the sensor has, farther or nearer from where it is. Time starts with the
request and ends with the line of the estimate, or of the refined curve; between moves there is a random pause, so
that some end a refinement and others come after it. The processors' time stands beside that of the clock.
"""

from __future__ import annotations

import copy
import json
import math
import random
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))

from browser import Server, serving

SENSOR = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
MOVES, REFINED_EVERY, LONGEST_PAUSE_S = 60, 6, 0.4
WIDTHS = 0.02, 0.1, 0.3
"""Standard deviations of moves, in lengths of half a slider."""


def ask(server: Server, path: str, body: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the lines of an answer."""
    url = urlsplit(server.url)
    connection = HTTPConnection(url.netloc)
    headers = {"X-Token": parse_qs(url.query)["token"][0], "Content-Type": "application/json"}
    with closing(connection):
        connection.request("POST", path, json.dumps(body), headers)
        for line in connection.getresponse():
            yield json.loads(line)


def processes(pid: int) -> list[int]:
    """Return a process and all that it has started, on Linux."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    return [pid, *(one for child in children for one in processes(int(child)))]


def memory_mb(server: Server) -> float:
    """Return the memory of all processes of a server; a page that several share counts once."""
    rollups = [
        Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii") for pid in processes(server.process.pid)
    ]
    lines = [line.split() for rollup in rollups for line in rollup.splitlines()]
    return sum(int(words[1]) for words in lines if words[0] == "Pss:") * 1024 / 1e6


def processor_s(server: Server) -> float:
    """Return the processors' time of all processes of a server."""
    seconds = 0.0
    for pid in processes(server.process.pid):
        of_process = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        seconds += (int(of_process[11]) + int(of_process[12])) / 100.0
    return seconds


def moved(state: dict[str, Any], fields: list[dict[str, Any]], chance: random.Random) -> dict[str, Any]:
    """Return a state in which one slider has moved."""
    new, field = copy.deepcopy(state), chance.choice(fields)
    table, _, name = field["key"].partition(".")
    low, high, is_log = field["min"], field["max"], field["scale"] == "log"
    if is_log:
        low, high = math.log(low), math.log(high)
    at = math.log(new[table][name]) if is_log else new[table][name]
    at = min(max(at + chance.gauss(0.0, chance.choice(WIDTHS)) * (high - low) / 2.0, low), high)
    value = math.exp(at) if is_log else at
    new[table][name] = round(value) if field["kind"] == "integer" else float(f"{value:.4g}")
    return new


def main(moves: int, sensor: Path) -> None:
    """Print medians and 95th percentiles of all moves, and the memory after each twenty."""
    chance = random.Random(1)
    with serving("sensor_sim", "explore", sensor, "--no-browser") as server:
        (start,) = ask(server, "/api/start", {})
        first = state = start["sensor"] | {"observer": start["observer"]}
        keys = {
            f"{table}.{name}" for table, values in state.items() if isinstance(values, dict) for name in values
        }
        fields = [one for one in start["fields"] if one.get("min") is not None and one["key"] in keys]
        times: dict[str, list[tuple[float, float]]] = {"estimate": [], "refined": []}
        sizes, done = None, 0
        while done <= moves:
            new = moved(state, fields, chance) if done else state
            tables = {key: value for key, value in new.items() if key != "observer"}
            body = {"sensor": tables, "observer": new["observer"], "sizes_detectors": sizes, "client": "a"}
            before, started = processor_s(server), time.perf_counter()
            with closing(ask(server, "/api/curve", body | {"sequence": time.monotonic_ns()})) as lines:
                for number, line in enumerate(lines):
                    took = time.perf_counter() - started, processor_s(server) - before
                    if number == 0 and done and "thresholds" in line:
                        times["estimate"].append(took)
                    if line.get("is_last") and done:
                        times["refined"].append(took)
                    if done % REFINED_EVERY:
                        break
            if "thresholds" in line:  # else there is no such sensor
                sizes = [one["size_detectors"] for one in line["thresholds"]]
                state, done = (new if chance.random() < 0.8 else first), done + 1
                time.sleep(chance.uniform(0.0, LONGEST_PAUSE_S))
                if done % 20 == 0:
                    print(f"{done} moves: {memory_mb(server):.0f} MB", flush=True)
    for name, values in times.items():
        for what, column in zip(("clock", "processors"), np.transpose(values), strict=True):
            print(f"{name}, {what}: median {np.median(column):.3g} s, 95 % {np.percentile(column, 95):.3g} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else MOVES, Path(sys.argv[2]) if len(sys.argv) > 2 else SENSOR)
