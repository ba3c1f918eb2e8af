// The explorer: parameters on one side, the curve, the MTFs and a trial of the sensor on the other.

import { CurveChart, MtfChart, shownFrequency, STRENGTHS } from "./charts.js";
import { Controls, TEST_FIELDS } from "./controls.js";
import { byId, element, fillTable } from "./elements.js";
import { LiveCurve, Newest } from "./live.js";
import { percentAtMost, plain, withError } from "./numbers.js";
import { post } from "./server.js";
import { fromHash, History, toHash, valueOf, withValue } from "./state.js";
import { Trial } from "./trial.js";

const BUSY_DELAY_MS = 400;
const HASH_DELAY_MS = 400;
const MTF_DELAY_MS = 60;
const TRIAL_DELAY_MS = 250;
const MOST_PINS = 6;
const MOST_FILE_BYTES = 500_000;
const SHARES = { internal: "Internal noise", detector: "Detector noise", sampling: "Sampling" };
const MTF_ROWS = 13;

/** What the table has in place of a threshold, by status. */
const MISSING = { never_reached: "never reached", always_exceeded: "always exceeded" };

class Explorer {
  #fields;
  #first;
  #history;
  #state;
  #view = { strength: "snr", abscissa: "inverse", unit: "detectors" };
  #controls;
  #curve = null;
  #pins = [];
  #curveChart = new CurveChart(byId("curve-chart"));
  #mtfChart = new MtfChart(byId("mtf-chart"));
  #trial = new Trial();
  #mtfState = null;
  #refused = null;
  #timers = {};
  #live = new LiveCurve({
    show: (curve, state) => this.#showCurve(curve, state),
    fail: (error) => this.#fail(error),
  });
  #mtf = new Newest((state) => this.#showMtf(state));

  constructor(start) {
    this.#fields = [...start.fields, ...TEST_FIELDS];
    const { sensor, observer, sizes_detectors, p_correct } = start;
    this.#first = { sensor, observer, sizes_detectors, p_correct };
    this.#history = new History(this.#first);
    this.#controls = new Controls(byId("controls"), this.#fields, (...change) => this.#move(...change));
    start.presets.forEach(({ name }, index) => byId("presets").append(element("option", { value: index }, name)));
    this.#listen(start.presets);
    const message = this.#readHash();
    this.#go(this.#history.state);
    this.#tell(message);
  }

  #listen(presets) {
    const on = (id, event, action) => byId(id).addEventListener(event, action);
    on("undo", "click", () => this.#go(this.#history.undo()));
    on("redo", "click", () => this.#go(this.#history.redo()));
    on("reset", "click", () => this.#open(this.#first, "Reset to the sensor at the start."));
    on("presets", "change", ({ target }) => {
      const { name, sensor } = presets[Number(target.value)];
      target.value = "";
      this.#open({ ...this.#state, sensor }, `Preset ${name}.`);
    });
    on("name", "change", ({ target }) => this.#move("sensor.name", target.value, true));
    on("open", "click", () => byId("file").click());
    on("file", "change", ({ target }) => {
      this.#read(target.files[0]);
      target.value = "";
    });
    on("save", "click", () => this.#save());
    on("link", "click", () => {
      this.#writeHash();
      this.#copy(location.href, "Link copied.");
    });
    on("command", "click", () => this.#copyCommand());
    on("pin", "click", () => this.#pin());
    for (const input of document.querySelectorAll(".axes input")) {
      input.addEventListener("change", () => {
        this.#view = { ...this.#view, [input.name]: input.value };
        if (this.#level === (this.#curve?.level ?? this.#level)) this.#drawCurve();
        else this.#ask();
        this.#later("hash", HASH_DELAY_MS, () => this.#writeHash());
      });
    }
    addEventListener("hashchange", () => {
      const message = this.#readHash();
      this.#go(this.#history.state);
      this.#tell(message);
    });
    addEventListener("keydown", (event) => this.#shortcut(event));
    this.#listenToDrops();
  }

  #listenToDrops() {
    const hasFile = (event) => event.dataTransfer?.types.includes("Files");
    addEventListener("dragover", (event) => {
      if (!hasFile(event)) return;
      event.preventDefault();
      byId("drop").hidden = false;
    });
    addEventListener("dragleave", (event) => {
      if (event.relatedTarget === null) byId("drop").hidden = true;
    });
    addEventListener("drop", (event) => {
      byId("drop").hidden = true;
      if (!hasFile(event)) return;
      event.preventDefault();
      this.#read(event.dataTransfer.files[0]);
    });
  }

  #shortcut(event) {
    const isText = event.target.matches?.("input:not([type=range], [type=radio]), select");
    if (!(event.ctrlKey || event.metaKey) || event.altKey || isText) return;
    const key = event.key.toLowerCase();
    if (key !== "z" && key !== "y") return;
    event.preventDefault();
    this.#go(key === "y" || event.shiftKey ? this.#history.redo() : this.#history.undo());
  }

  /** A field has moved to a value, or with `undefined` stays where it is. */
  #move(key, value, isFinal, isSlider = false) {
    if (value !== undefined && JSON.stringify(value) !== JSON.stringify(valueOf(this.#state, key))) {
      this.#state = withValue(this.#state, key, value);
      this.#ask();
    }
    if (isFinal) this.#record(isSlider ? key : null);
    this.#later("hash", HASH_DELAY_MS, () => this.#writeHash());
  }

  /** The level of the chosen quantity, which is no part of the sensor: no step of undo changes it. */
  get #level() {
    return STRENGTHS[this.#view.strength].level;
  }

  #ask() {
    this.#live.ask(this.#state, this.#level);
    this.#timers.busy ??= setTimeout(() => {
      byId("status").textContent = "Computing…";
    }, BUSY_DELAY_MS);
  }

  #record(key) {
    this.#history.record(this.#state, key);
    this.#showHistory();
  }

  #showHistory() {
    byId("undo").disabled = !this.#history.canUndo;
    byId("redo").disabled = !this.#history.canRedo;
  }

  /** Go to a state that comes from elsewhere than the controls, and remember it. */
  #open(state, message) {
    this.#state = state;
    this.#record(null);
    this.#go(state);
    this.#tell(message);
  }

  #go(state) {
    this.#state = state;
    this.#controls.show(state);
    byId("name").value = state.sensor.name;
    this.#showHistory();
    this.#tell("");
    this.#ask();
    this.#later("hash", HASH_DELAY_MS, () => this.#writeHash());
  }

  #showCurve(curve, state) {
    this.#curve = { ...curve, state };
    this.#idle();
    byId("curve").classList.remove("stale");
    if (state === this.#state) this.#refuse(null, null);
    this.#drawCurve();
    this.#showLimits(curve.limits);
    const error = percentAtMost(Math.max(...relativeErrors(curve), 0) || curve.tolerance);
    const time = curve.is_last && curve.seconds >= 0.1 ? `, in ${curve.seconds.toFixed(1)} s` : "";
    byId("status").textContent = `${curve.is_last ? "Refined" : "Estimate"}: within ${error}${time}`;
    if (curve.is_last) this.#announce(`${byId("sentence").textContent} ${this.#summary()}`);
    if (state !== this.#state) return;
    if (state !== this.#mtfState) {
      this.#mtfState = state;
      this.#later("mtf", MTF_DELAY_MS, () => this.#mtf.ask(state));
    }
    if (curve.is_last) this.#later("trial", TRIAL_DELAY_MS, () => this.#trial.show(state, curve.thresholds));
  }

  #drawCurve() {
    const curve = this.#curve;
    if (curve === null) return;
    const hasTemperature = curve.state.sensor.noise.netd_mk !== null;
    const isOffered = (name) => name !== "delta_t_mk" || hasTemperature;
    const chosen = isOffered(this.#view.strength) ? this.#view.strength : "snr";
    // Until the curve of another level is there, this one stays as it is.
    const strength = STRENGTHS[chosen].level === curve.level ? chosen : curve.level;
    const view = { ...this.#view, strength };
    for (const input of document.querySelectorAll(".axes input")) {
      input.checked = input.value === { ...view, strength: chosen }[input.name];
      if (input.value !== "delta_t_mk") continue;
      input.disabled = !hasTemperature;
      input.parentElement.title = hasTemperature ? "" : "Temperatures need the NETD.";
    }
    this.#curveChart.draw(curve.thresholds, this.#pins, view);
    // Tests and benchmarks read which request is on the screen.
    Object.assign(byId("curve").dataset, { stage: curve.stage, sequence: curve.sequence });
    this.#showNumbers(Object.keys(STRENGTHS).filter((name) => isOffered(name) && STRENGTHS[name].level === curve.level));
    this.#showPins();
  }

  #showNumbers(names) {
    const strengths = names.map((name) => [name, STRENGTHS[name]]);
    const sizes = ["Size (detectors)", "Size (mrad)", "At the eye (mrad)"];
    const headers = [...sizes, ...strengths.map(([, { header }]) => header)];
    const rows = this.#curve.thresholds.map((one) => [
      plain(one.size_detectors),
      plain(one.size_mrad),
      plain(one.size_mrad_eye),
      ...strengths.map(([name, { error }]) =>
        one[name] === null ? MISSING[one.status] : withError(one[name], one[error]),
      ),
    ]);
    const stage = this.#curve.is_last ? "refined" : "estimated";
    const caption = `Thresholds, ${stage}; ± is half of the 95 % interval of the computation`;
    fillTable(byId("curve-table"), caption, headers, rows);
  }

  #showLimits(limits) {
    byId("sentence").textContent = limits.sentence;
    const present = Object.entries(SHARES).filter(([name]) => limits[name] > 0);
    const parts = present.map(([name, label]) => {
      const part = element("span", { className: name }, `${label} ${Math.round(100 * limits[name])} %`);
      part.style.flexGrow = limits[name];
      return part;
    });
    byId("shares").replaceChildren(...parts);
  }

  #summary() {
    const { level, thresholds } = this.#curve;
    const shown = thresholds.map(
      (one) => `${plain(one.size_detectors)} detectors: ${plain(one[level]) || MISSING[one.status]}`,
    );
    return `${STRENGTHS[level].axis} at ${shown.join("; ")}.`;
  }

  #fail(error) {
    byId("curve").classList.add("stale");
    const key = error.key ?? this.#fields.find((field) => error.message.startsWith(`${field.key}:`))?.key;
    // The field says of what it is; the line of a file also names the table and the key.
    const line = error.message.replace(/^.*?\w+: (?=found )/, "");
    const isShown = this.#refuse(key, line[0].toUpperCase() + line.slice(1));
    this.#idle();
    byId("status").textContent = isShown
      ? "Not possible. The curve is that of the last possible sensor."
      : error.message;
    this.#announce(error.message);
  }

  /** Show the server's line at the field of a key, and none at the field that had it before. */
  #refuse(key, line) {
    this.#controls.showError(this.#refused, null);
    this.#refused = key;
    return this.#controls.showError(key, line);
  }

  async #showMtf(state) {
    try {
      const transfer = await post("/api/mtf", { sensor: state.sensor });
      this.#mtfChart.draw(transfer);
      const { frequency_cyc_per_mrad: frequency, presample, postsample, nyquist_cyc_per_mrad: nyquist } = transfer;
      byId("nyquist").textContent = `Nyquist frequency, ${plain(nyquist)} cycles/mrad`;
      const last = frequency.findLastIndex((one) => one <= shownFrequency(transfer));
      const rows = Array.from({ length: MTF_ROWS }, (_, row) => Math.round((row * last) / (MTF_ROWS - 1)));
      fillTable(
        byId("mtf-table"),
        `Modulation transfer along x; Nyquist frequency ${plain(nyquist)} cycles/mrad`,
        ["cycles/mrad", "Before sampling", "After sampling"],
        [...new Set(rows)].map((row) => [plain(frequency[row]), presample[row].toFixed(3), postsample[row].toFixed(3)]),
      );
    } catch (error) {
      this.#tell(error.message);
    }
  }

  #pin() {
    if (this.#curve === null || this.#pins.length >= MOST_PINS) return;
    const taken = new Set(this.#pins.map((pin) => pin.number));
    const number = Array.from({ length: MOST_PINS }, (_, index) => index + 1).find((one) => !taken.has(one));
    this.#pins.push({ number, thresholds: this.#curve.thresholds, state: this.#curve.state });
    this.#drawCurve();
  }

  #showPins() {
    byId("pin").disabled = this.#pins.length >= MOST_PINS;
    const shown = JSON.stringify([this.#pins.map((pin) => pin.number), this.#curve.state]);
    if (byId("pins").dataset.shown === shown) return;
    byId("pins").dataset.shown = shown;
    const items = this.#pins.map((pin) => {
      const remove = element("button", { type: "button", className: "remove", title: "Remove" }, "×");
      remove.setAttribute("aria-label", `Remove pinned curve ${pin.number}`);
      remove.addEventListener("click", () => {
        this.#pins = this.#pins.filter((other) => other !== pin);
        this.#drawCurve();
        byId("pin").focus();
      });
      const swatch = element("span", { className: `line pin-${pin.number}` });
      return element("li", {}, swatch, element("span", {}, this.#difference(pin.state)), remove);
    });
    byId("pins").replaceChildren(...items);
  }

  /** Return how a pinned state differs from the one that is shown. */
  #difference(state) {
    const now = this.#curve.state;
    const differing = this.#fields.filter(
      ({ key }) => JSON.stringify(valueOf(state, key)) !== JSON.stringify(valueOf(now, key)),
    );
    const texts = differing.map(({ key, label, group, unit }) => {
      const value = valueOf(state, key);
      const text = value === null ? "none" : Array.isArray(value) ? value.join(", ") : value;
      return `${group.toLowerCase()}: ${label.toLowerCase()} ${text} ${unit ?? ""}`.trim();
    });
    const name = state.sensor.name === now.sensor.name ? [] : [state.sensor.name];
    if (!texts.length) return [...name, "as now"].join("; ");
    const more = texts.length > 3 ? [`and ${texts.length - 3} more`] : [];
    return [...name, ...texts.slice(0, 3), ...more].join("; ");
  }

  async #read(file) {
    if (!file) return;
    if (file.size > MOST_FILE_BYTES) {
      this.#tell(`${file.name} has ${plain(file.size / 1e6)} MB and is no SENSOR.toml; drop a smaller file.`);
      return;
    }
    try {
      const { sensor } = await post("/api/parse", { text: await file.text(), name: file.name });
      this.#open({ ...this.#state, sensor }, `${file.name} opened.`);
    } catch (error) {
      this.#tell(error.message);
    }
  }

  async #save() {
    try {
      const { text, file } = await post("/api/toml", this.#state);
      const address = URL.createObjectURL(new Blob([text], { type: "application/toml" }));
      element("a", { href: address, download: file }).click();
      setTimeout(() => URL.revokeObjectURL(address), 10_000);
    } catch (error) {
      this.#tell(error.message);
    }
  }

  async #copyCommand() {
    try {
      const { command, file } = await post("/api/toml", this.#state);
      await this.#copy(command.curve, `Command copied. It reads ${file}, which Save SENSOR.toml writes.`);
    } catch (error) {
      this.#tell(error.message);
    }
  }

  /** Copy a text, or show it where the browser does not allow that. */
  async #copy(text, message) {
    try {
      await navigator.clipboard.writeText(text);
      this.#tell(message);
    } catch {
      this.#tell(`The browser does not let the page copy. Here it is: ${text}`);
    }
  }

  /** Take the state of the link, if there is one. Returns a message about it. */
  #readHash() {
    if (location.hash.length < 2) return "";
    try {
      const { state, view } = fromHash(location.hash, this.#fields, this.#first);
      for (const input of document.querySelectorAll(".axes input")) {
        if (view[input.name] === input.value) this.#view = { ...this.#view, [input.name]: input.value };
      }
      this.#history.record(state);
      return "";
    } catch {
      return "The link is damaged: it holds no sensor. The sensor stays as it is.";
    }
  }

  #writeHash() {
    history.replaceState(null, "", `#${toHash(this.#state, this.#view)}`);
  }

  #idle() {
    clearTimeout(this.#timers.busy);
    this.#timers.busy = null;
  }

  /** Run an action after a time without another call of this name. */
  #later(name, milliseconds, action) {
    clearTimeout(this.#timers[name]);
    this.#timers[name] = setTimeout(action, milliseconds);
  }

  #tell(text) {
    byId("message").textContent = text;
  }

  #announce(text) {
    byId("announcement").textContent = text;
  }
}

function relativeErrors({ level, thresholds }) {
  return thresholds.filter((one) => one[level] > 0).map((one) => one[STRENGTHS[level].error] / one[level]);
}

try {
  new Explorer(await post("/api/start", {}));
} catch (error) {
  byId("status").textContent = "";
  byId("message").textContent = error.message;
}
