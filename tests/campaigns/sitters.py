"""People who sit the experiment in a browser and do not behave: what they did is compared with what was saved.

Each person is of one kind and sits a session of `TRIALS` trials of the default settings, in Chromium, with its own
server. Keys, reloads, kills and the loss of the focus are real; a page that is hidden is simulated by the event
that browsers send, as Chromium without a window never hides one.
"""

from __future__ import annotations

import csv
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from browser import chromium, watched
from experiment_page import (
    KEYS,
    UNREACHABLE,
    experiment,
    free_port,
    measure_monitor,
    saved_rows,
    trial_shown,
)

FRAMES = Path(__file__).parents[2] / "sample_frames" / "naked_eye"

TRIALS = 12

SEEN_MS = 200
"""Time that a person takes who looks at the picture."""

HASTE = """new MutationObserver(([change]) => {
  if (change.target.dataset.trial % 3 === 0) {
    setTimeout(() => window.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" })), 5);
  }
}).observe(document, { attributes: true, attributeFilter: ["data-trial"], subtree: true });"""
"""Script that presses a key 5 ms after the picture of every third trial."""

HIDE = """(state) => {
  Object.defineProperty(document, "visibilityState", { value: state, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


class Sitter:
    """A person at a page, who presses keys and remembers what each answer has to be saved as.

    Attributes
    ----------
    page : playwright.sync_api.Page
    rng : numpy.random.Generator
    experimenter : Experimenter
    expected : dict
        The response and the flag of each trial that was answered, by its number.
    """

    def __init__(self, page: Any, rng: np.random.Generator, experimenter: Experimenter) -> None:
        self.page, self.rng, self.experimenter = page, rng, experimenter
        self.expected: dict[int, tuple[str, str]] = {}

    def answer(self, number: int, flag: str = "") -> str:
        """Look at the picture, and press a random arrow; return the key."""
        response = str(self.rng.choice(list(KEYS)))
        self.page.wait_for_timeout(SEEN_MS)
        self.expected[number] = response, flag
        self.page.keyboard.press(KEYS[response])
        return KEYS[response]


class Experimenter:
    """Starts the server of a session, and starts it again at the same port; use it in a `with` statement."""

    def __init__(self, answers: Path) -> None:
        self._options = (
            FRAMES,
            answers,
            "--trials",
            TRIALS,
            "--practice",
            0,
            "--subject",
            "p1",
            "--port",
            free_port(),
        )
        self._servers = ExitStack()

    def __enter__(self) -> Experimenter:
        return self

    def __exit__(self, *_: object) -> None:
        self._servers.close()

    def start(self) -> str:
        """Start the server; return the address of the page."""
        self.server = self._servers.enter_context(experiment(*self._options))
        return str(self.server.url)

    def kill(self) -> None:
        """Kill the server with SIGKILL."""
        self.server.process.kill()
        self.server.process.wait()


def attentive(who: Sitter, number: int) -> None:
    """Looks, and answers."""
    who.answer(number)


def impatient(who: Sitter, number: int) -> None:
    """Presses 5 ms after the picture in every third trial (`HASTE`), and looks in the others."""
    if number % 3:
        who.answer(number)
        number += 1
    if number % 3 == 0:  # its picture may be gone before it is seen from here
        who.expected[number] = "left", "too_fast"


def hides_the_page(who: Sitter, number: int) -> None:
    """Goes to another tab and comes back, in every fourth trial."""
    is_away = number % 4 == 0
    if is_away:
        who.page.evaluate(HIDE, "hidden")
        who.page.evaluate(HIDE, "visible")
    who.answer(number, "hidden" if is_away else "")


def loses_the_focus(who: Sitter, number: int) -> None:
    """Has another window in front for a moment, in every fourth trial."""
    is_away = number % 4 == 0
    if is_away:
        other = who.page.context.new_page()
        other.bring_to_front()
        who.page.wait_for_timeout(50)
        other.close()
        who.page.bring_to_front()
    who.answer(number, "unfocused" if is_away else "")


def presses_twice(who: Sitter, number: int) -> None:
    """Presses each key twice: the second press is for nothing, as the next picture is not there yet."""
    who.page.keyboard.press(who.answer(number))


def holds_the_key(who: Sitter, number: int) -> None:
    """Holds the key down into the next trial: what the keyboard repeats is no answer."""
    key = who.answer(number)
    who.page.keyboard.down(key)
    following = trial_shown(who.page)
    for _ in range(5):
        who.page.keyboard.down(key)  # Chromium sends it as a repeat
    if following:
        assert who.page.get_attribute("#stage", "data-trial") == str(following), "a held key answered a trial"
    who.page.keyboard.up(key)


def reloads(who: Sitter, number: int) -> None:
    """Reloads the page during every fourth trial: the same one comes again."""
    if number % 4 == 0:
        who.page.reload()
        found = trial_shown(who.page)
        assert found == number, f"trial {found} came after a reload, expected {number}"
    who.answer(number)


def loses_the_server(who: Sitter, number: int) -> None:
    """Answers while the server is dead, in every fifth trial; the experimenter starts it again."""
    if number % 5:
        who.answer(number)
        return
    who.experimenter.kill()
    who.answer(number)
    who.page.wait_for_selector("#connection:has-text('Call the experimenter')")
    who.page.goto(who.experimenter.start())


KINDS = (
    attentive,
    impatient,
    hides_the_page,
    loses_the_focus,
    presses_twice,
    holds_the_key,
    reloads,
    loses_the_server,
)


def campaign(n: int, *, seed: int, only: str = "") -> list[str]:
    """Let n people of each kind sit a session; print a line for each kind, and return the faults."""
    faults = []
    with chromium() as browser:
        for kind in KINDS:
            if only not in kind.__name__:
                continue
            flags: Counter[str] = Counter()
            found = []
            for number in range(n):
                with TemporaryDirectory() as folder:
                    answers = Path(folder) / "answers"
                    try:
                        expected = sit(browser, kind, answers, np.random.default_rng([seed, number]))
                        found += wrongs(answers, expected)
                        flags.update(flag or "none" for _, flag in expected.values())
                    except Exception as error:  # any end but the good one is a fault
                        found.append(f"{type(error).__name__}: {str(error).splitlines()[0]}")
            said = ", ".join(f"{count} {flag}" for flag, count in sorted(flags.items()))
            print(f"{kind.__name__}: {n} people, answers by flag: {said}; {len(found)} faults", flush=True)
            faults += [f"{kind.__name__}: {one}" for one in found]
    for one in faults:
        print(f"  {one}")
    return faults


def sit(
    browser: Any, kind: Callable[[Sitter, int], None], answers: Path, rng: np.random.Generator
) -> dict[int, tuple[str, str]]:
    """Sit a session; return the response and the flag that each trial has to have."""
    script = HASTE if kind is impatient else ""
    with (
        Experimenter(answers) as experimenter,
        watched(browser, experimenter.start(), expected_console=UNREACHABLE, script=script) as page,
    ):
        # As a rule Playwright has each page believe that it has the focus.
        page.context.new_cdp_session(page).send("Emulation.setFocusEmulationEnabled", {"enabled": False})
        page.click("#agree")
        measure_monitor(page)
        who = Sitter(page, rng, experimenter)
        while number := trial_shown(page):
            kind(who, number)
        return who.expected


def wrongs(answers: Path, expected: dict[int, tuple[str, str]]) -> list[str]:
    """Return what is wrong with the files: answers lost, saved twice or otherwise, and counts of others."""
    rows = saved_rows(answers)
    found = []
    saved = {int(row["trial"]): (row["response"], row["flag"]) for row in rows}
    if len(saved) != len(rows) or list(saved) != list(range(1, len(rows) + 1)):
        found.append(f"trials {[row['trial'] for row in rows]}, expected each once")
    found += [
        f"trial {number}: saved {saved.get(number)}, expected {one}"
        for number, one in expected.items()
        if saved.get(number) != one
    ]
    counted = [row for row in rows if not row["flag"]]
    n_flagged = len(rows) - len(counted)
    if len(rows) != TRIALS + min(n_flagged, TRIALS // 4):
        found.append(f"{len(rows)} trials with {n_flagged} flags, expected {TRIALS} and the flagged ones again")
    with (answers / "counts" / "subject-p1_counts.csv").open(encoding="utf-8", newline="") as file:
        n_counted = sum(int(row["n_trials"]) for row in csv.DictReader(file))
    if n_counted != len(counted):
        found.append(f"{n_counted} trials in the counts, expected {len(counted)}")
    return found
