"""The campaign of the explorer's page: a random walk of a hand that does not wait for answers.

Chromium moves sliders, types values and nonsense, goes back and forth, and changes axes, while requests for curves
are held back for up to two seconds. After each move the line above the curve, the numbers, the announcement for
readers of screens and the saved file are compared with the request whose state the controls show.
"""

from __future__ import annotations

import random
import re
import shutil
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

from browser import serving, wait_until, watched

from sensor_sim import new_sensor

if TYPE_CHECKING:
    from playwright.sync_api import Download, Page, Route

CAMERA = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
LONGEST_HOLD_S = 2.0
SHARE_HELD = 0.7
REFUSED = ["status of 422", "ERR_FAILED", "ERR_ABORTED"]

RECORD = """
window.answered = {};
const ask = window.fetch;
window.fetch = async (path, options) => {
  const response = await ask(path, options);
  if (path !== "/api/curve" || !response.ok) return response;
  const body = JSON.parse(options.body);
  const of = (window.answered[body.sequence] = { body, lines: [] });
  const copy = response.clone().body.pipeThrough(new TextDecoderStream()).getReader();
  (async () => {
    let rest = "";
    for (;;) {
      const { done, value } = await copy.read();
      const whole = (rest += value ?? "").split("\\n");
      rest = whole.pop();
      of.lines.push(...whole.filter((line) => line).map((line) => JSON.parse(line)));
      if (done) return;
    }
  })().catch(() => {});
  return response;
};
"""
"""Keeps the lines of all answers, as the page gets them."""

JUDGE = """() => {
  const text = (selector) => document.querySelector(selector)?.textContent ?? "";
  const faults = [];
  const expect = (isTrue, what) => isTrue || faults.push(what);
  const curve = document.querySelector("#curve");
  const { asked, sequence, stage } = curve.dataset;
  const [status, said] = [text("#status"), text("#announcement")];
  const caption = text("#curve-table caption");
  const claimed = /^(Refined|Estimate)/.exec(status)?.[0];
  const { body, lines } = window.answered[sequence] ?? { lines: [] };
  expect(claimed || ["Computing…", "Not computed"].includes(status) || /^Not possible/.test(status), "the line");
  expect(!claimed || asked === sequence, "a claim about another state");
  expect(claimed === undefined || (claimed === "Refined") === (stage === "refined"), "the stage");
  expect(/earlier sensor/.test(caption) === (asked !== sequence), "the caption");
  const isDone = claimed === "Refined" || /^Not possible/.test(status);
  expect((curve.getAttribute("aria-busy") === "false") === isDone, "aria-busy");
  expect(lines.length, "no answer belongs to the numbers");
  const table = document.querySelector("#curve-table");
  const headers = [...table.tHead.rows[0].cells].map((cell) => cell.textContent);
  const keys = { SNR: "snr", Contrast: "contrast" };
  const column = headers.findIndex((header) => header in keys);
  const texts = (row) => [row.cells[0], row.cells[column]].map((one) => one.textContent);
  const rows = [...table.tBodies[0].rows].map(texts);
  const isShown = ({ thresholds }) =>
    thresholds.length === rows.length && thresholds.every((one, at) => {
      const value = one[keys[headers[column]]];
      if (value === null) return !rows[at][1].includes("±");
      const number = rows[at][1].split(" ± ")[0];
      const unit = 10 ** -(number.split(".")[1] ?? "").length;
      return Math.abs(number - value) <= unit * 0.5001 && Number(rows[at][0]) === one.size_detectors;
    });
  const shown = lines.filter(isShown);
  expect(shown.length, "numbers of no answer to this state");
  if (claimed === "Refined") expect(shown.some((line) => line.is_last), "refined before it was");
  if (claimed) {
    const { sensor, observer } = body;
    for (const field of document.querySelectorAll("#controls [id^=field-]:not(p, span, label, [type=checkbox])")) {
      if (field.closest("[hidden]")) continue;
      const [table, name] = field.id.slice("field-".length).split("-");
      const value = name ? { ...sensor, observer }[table][name] : body[table];
      const wanted = table === "sizes_detectors" ? lines[0].thresholds.map((one) => one.size_detectors) : value;
      const written = Array.isArray(wanted) ? wanted.join(", ") : String(wanted ?? "");
      expect(field.value === written, `${field.id}: ${field.value}, and the numbers are of ${written}`);
    }
    expect(document.querySelector("#name").value === sensor.name, "the name");
  }
  const range = document.querySelector("#range");
  if (!range.hidden && range.dataset.sequence === sequence && isDone) {
    const rows = [...(document.querySelector("#range-table").tBodies[0]?.rows ?? [])];
    const words = rows.map((row) => row.cells[3].textContent);
    const spoken = text("#range-sentences");
    const isTold = words.some((one) => spoken.includes(one)) || !document.querySelector("#range-error").hidden;
    expect(isTold, "the range in words is not that of the table");
  }
  if (/Threshold/.test(said)) {
    expect(claimed === "Refined", "announced before it was there");
    for (const [, size, number] of said.matchAll(/([\\d.]+) detectors: ([\\d.]*\\d)/g)) {
      const one = shown[0]?.thresholds.find((row) => row.size_detectors === Number(size));
      expect(Math.abs(one?.[body.level] / number - 1) < 1e-3, `announced ${number} at ${size}`);
    }
  } else {
    expect(claimed !== "Refined", "not announced");
  }
  return { faults, kind: claimed ?? status.split(/[.…]/)[0], id: asked };
}"""
"""Compares what the page shows with the recorded answers; returns the faults."""


class Tally(NamedTuple):
    """What a walk has met: states by what the line said, and the faults."""

    kinds: Counter[str]
    n_saved: int
    n_held: int
    faults: list[str]

    def line(self) -> str:
        """Return the tally in words."""
        kinds = ", ".join(f"{number} {kind}" for kind, number in self.kinds.most_common())
        others = f"{self.n_held} requests held back, {self.n_saved} files, {len(self.faults)} faults"
        return f"{self.kinds.total()} states ({kinds}), {others}"


class Walk:
    """A hand at the page."""

    def __init__(self, page: Page, seed: int) -> None:
        self.page, self.chance = page, random.Random(seed)
        self.held: list[tuple[float, Route]] = []
        self.n_held = 0
        self.clock_s = 0.0
        page.route("**/api/curve", lambda route: self._hold(route))

    def _hold(self, route: Route) -> None:
        if self.chance.random() > SHARE_HELD:
            route.continue_()
            return
        self.n_held += 1
        self.held.append((self.clock_s + self.chance.uniform(0.0, LONGEST_HOLD_S), route))

    def wait(self, seconds: float) -> None:
        """Let time pass, and requests go whose time has come."""
        end = self.clock_s + seconds
        while self.clock_s < end:
            self.page.wait_for_timeout(20)
            self.clock_s += 0.02
            due = [one for one in self.held if one[0] <= self.clock_s]
            self.held = [one for one in self.held if one not in due]
            for _, route in due:
                from playwright.sync_api import Error

                with suppress(Error):  # the page has given it up
                    route.continue_()

    def move(self) -> str:
        """Do one thing that a hand may do; return its name."""
        if self.page.locator("#controls [aria-invalid=true]").count() and self.chance.random() < 0.5:
            self.page.click("#undo" if self.page.locator("#undo").is_enabled() else "#reset")
            return "undo what is impossible"
        moves: list[Callable[[], str]] = [
            self._slide,
            self._slide,
            self._slide,
            self._type,
            self._type,
            self._click,
        ]
        return self.chance.choice(moves)()

    def _slide(self) -> str:
        slider = self.page.locator("#controls input[type=range]:visible")
        slider = slider.nth(self.chance.randrange(slider.count()))
        key = self.chance.choice(["ArrowLeft", "ArrowRight"])
        for _ in range(self.chance.choice([1, 1, 2, 5])):
            slider.press(key)
        return f"slider {slider.get_attribute('aria-labelledby')} {key}"

    def _type(self) -> str:
        shown = [one for one in TYPED if self.page.locator(f"#field-{one[0]}").is_visible()]
        name, values = self.chance.choice(shown)
        value, how = self.chance.choice(values), self.chance.choice(["Tab", "Enter", None])
        field = self.page.locator(f"#field-{name}")
        field.fill(value)
        if how is not None:
            field.press(how)
        return f"{name} = {value!r}, {how}"

    def _click(self) -> str:
        what = self.chance.choice(CLICKED)
        target = self.page.locator(what).first
        if target.count() and target.is_visible() and target.is_enabled():
            target.click()
        if self.chance.random() < 0.15:
            names = self.page.locator("#presets option").all_inner_texts()[1:]
            what = self.chance.choice(names)
            self.page.locator("#presets").select_option(label=what)
        return what

    def saved(self) -> list[str]:
        """Save; return how the file differs from the controls. The page may refuse what is impossible."""
        fields: dict[str, str] = self.page.evaluate(
            "Object.fromEntries([...document.querySelectorAll('#controls [id^=field-]:not(p, span, label)')]"
            ".filter((one) => !one.closest('[hidden]'))"
            ".map((one) => [one.id.slice('field-'.length).replace('-', '.'), one.value]))"
        )
        downloads: list[Download] = []

        def note(one: Download) -> None:
            downloads.append(one)

        self.page.on("download", note)
        self.page.evaluate("document.querySelector('#message').textContent = ''")
        self.page.click("#save")
        for _ in range(3000):
            message = self.page.locator("#message").text_content() or ""
            if downloads or (message and "saved" not in message):
                break
            self.page.wait_for_timeout(10)
        self.page.remove_listener("download", note)
        if not downloads:
            return (
                []
                if re.search("expected|is missing", message)
                else [f"nothing was saved, and the page says {message!r}"]
            )
        tables: dict[str, Any] = tomllib.loads(downloads[0].path().read_text(encoding="utf-8"))
        faults = []
        for key, text in fields.items():
            table, _, name = key.partition(".")
            if table not in tables:
                continue
            found = tables[table].get(name)
            is_same = (
                text == "" if found is None else text == found if isinstance(found, str) else float(text) == found
            )
            if not is_same:
                faults.append(f"saved {key} = {found}, and the controls show {text!r}")
        return faults


TYPED = (
    ("optics-aperture_mm", ("", "180", "1,5e2", "red", "-3", "0.5", "220")),
    ("sizes_detectors", ("", "4, 6", "3 5 8", "two", "300", "2, 2, 4")),
    ("noise-netd_mk", ("", "16", "25", "x")),
    ("detector-width_mrad", ("0.9", "0.0681", "0.05", "")),
    ("noise-frames_integrated", ("1", "6", "1.5", "7")),
    ("p_correct", ("0.7", "0.2", "0.75")),
    ("optics-f_number", ("1.4", "2.8", "0", "")),
    ("scene-luminance_cd_m2", ("0.1", "30", "1e9", "")),
    ("noise-exposure_ms", ("2", "20", "x")),
    ("noise-full_well_electrons", ("5000", "", "10")),
)
CLICKED = (
    "#undo", "#undo", "#redo", "#reset", "#pin", "#pins .remove", "#field-keep_fill_factor", "#field-couple_netd",
    "label:has([name=strength][value=contrast])", "label:has([name=strength][value=snr])",
    "label:has([name=unit][value=mrad])", "label:has([name=unit][value=detectors])",
    "label:has([name=abscissa][value=size])",
)  # fmt: skip


AIM = ((), ("--target", "r46", "--atmosphere", "visible_23km"), ("--observer", "csf"))
"""Options of each of the cameras."""


def camera(folder: Path, seed: int) -> Path:
    """Return the camera of a seed, in turn: with an SNR, counting photons, and so behind a measured MTF."""
    kind = seed % 3
    if kind == 0:
        return CAMERA
    made = folder / "camera.toml"
    text = new_sensor(preset="emva_basler", focal_length_mm=25, f_number=2.8, pitch_um=3.45)
    if kind == 2:
        text = text.replace("[optics]\n", '[optics]\nmtf = "mtf.csv"\n').replace("blur_sigma_mrad", "# blur")
        table = "frequency_cyc_per_mm,mtf\n0,1\n50,0.8\n100,0.55\n200,0.25\n300,0.1\n400,0.02\n"
        (folder / "mtf.csv").write_text(table, encoding="utf-8")
    made.write_text(text, encoding="utf-8")
    return made


def campaign(n: int, *, seed: int) -> Tally:
    """Walk through `n` states, and judge each of them at a random moment."""
    from playwright.sync_api import sync_playwright

    kinds: Counter[str] = Counter()
    faults: list[str] = []
    n_saved = 0
    chromium_path = next(path for name in ("chromium", "google-chrome") if (path := shutil.which(name)))
    with (
        tempfile.TemporaryDirectory() as folder,
        sync_playwright() as play,
        serving("sensor_sim", "explore", camera(Path(folder), seed), *AIM[seed % 3], "--no-browser") as server,
    ):
        chromium = play.chromium.launch(executable_path=chromium_path, args=["--no-sandbox"])
        with watched(chromium, server.url, expected_console=REFUSED, script=RECORD) as page:
            page.set_default_timeout(300_000)
            page.wait_for_selector("#curve[data-stage=refined]")
            page.locator("#curve summary").click()
            walk = Walk(page, seed)
            for state in range(n + 1):
                if state < n:
                    what = walk.move()
                    walk.wait(walk.chance.choice([0.0, 0.1, 0.4, 0.8, 1.5, 4.0]))
                else:
                    what = "the end"
                    walk.wait(LONGEST_HOLD_S)
                    wait_until(page, "document.querySelector('#curve').getAttribute('aria-busy') === 'false'")
                judged = page.evaluate(JUDGE)
                found: list[str] = judged["faults"]
                if walk.chance.random() < 0.2:
                    found += walk.saved()
                    n_saved += 1
                kinds[judged["kind"]] += 1
                for fault in found:
                    faults.append(fault)
                    print(f"state {state}, seed {seed}, after {what}: {fault}", flush=True)
        chromium.close()
    return Tally(kinds, n_saved, walk.n_held, faults)
