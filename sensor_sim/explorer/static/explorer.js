// The explorer: parameters on one side, the curve, the MTFs and a trial of the sensor on the other.

import { CurveChart, MtfChart } from "./charts.js";
import { Controls, isShown } from "./controls.js";
import { byId, element, fillTable } from "./elements.js";
import { LiveCurve, Newest } from "./live.js";
import { plain } from "./numbers.js";
import { csvOf, download, downloadPlot, plotOf } from "./files.js";
import { MOST_PINS, showPins, withPin } from "./pins.js";
import { RangeView } from "./range.js";
import { post, Watch } from "./server.js";
import { countsPhotons, fromHash, History, moved, Session, toHash, valueOf, withSensor } from "./state.js";
import { Trial } from "./trial.js";

/** Time for which a curve may be that of an earlier state before it is greyed. */
const STALE_DELAY_MS = 400;
const HASH_DELAY_MS = 400;
const MTF_DELAY_MS = 60;
const TRIAL_DELAY_MS = 250;
const MOST_FILE_BYTES = 500_000;
const SHARES = { internal: "Internal noise", detector: "Detector noise", sampling: "Sampling" };
class Explorer {
  #fields;
  #first;
  #history;
  /** The record of the state that the controls show, and the one whose curve is drawn. */
  #now = { id: 0, unread: new Map() };
  #drawn = null;
  #session;
  #view = { strength: "snr", abscissa: "inverse", unit: "detectors" };
  #controls;
  #pins = [];
  #curveChart = new CurveChart(byId("curve-chart"));
  #mtfChart = new MtfChart(byId("mtf-chart"));
  #trial = new Trial();
  /** The second plot, if the command has named a target. */
  #range = null;
  #mtfSensor = null;
  /** The file that was chosen or dropped last. */
  #file = null;
  /** The axes of what is drawn. */
  #shown = null;
  #timers = {};
  #live = new LiveCurve({
    show: (record, curve) => this.#showCurve(record, curve),
    fail: (record, error) => this.#refuse(record, error),
  });
  #moves = new Newest((record) => this.#follow(record));
  #mtf = new Newest((sensor) => this.#showMtf(sensor));
  #watch = new Watch((line) => this.#showServer(line));

  constructor(start) {
    this.#fields = start.fields;
    if (start.has_range) this.#range = new RangeView();
    const { sensor, observer, p_correct, chip_pitch_um, measured } = start;
    this.#first = withSensor({ observer, p_correct, chip_pitch_um, measured, keep_fill_factor: false }, sensor);
    this.#history = new History(this.#first);
    this.#controls = new Controls(byId("controls"), this.#fields, {
      change: (...change) => this.#move(...change),
      unread: (key, line) => this.#unread(key, line),
    });
    start.presets.forEach(({ sensor: { name } }, index) =>
      byId("presets").append(element("option", { value: index }, name)),
    );
    this.#listen(start.presets);
    this.#session = new Session(start.version, this.#first);
    this.#pins = this.#session.pins;
    const message = this.#session.state ? this.#take(this.#session) : this.#readHash();
    this.#go(this.#history.state);
    this.#tell(message);
  }

  #listen(presets) {
    const on = (id, event, action) => byId(id).addEventListener(event, action);
    on("undo", "click", () => this.#undo());
    on("redo", "click", () => this.#go(this.#history.redo()));
    on("reset", "click", () => this.#open(this.#first, "Reset to the sensor at the start."));
    on("presets", "change", ({ target }) => {
      const { sensor, chip_pitch_um } = presets[Number(target.value)];
      target.value = "";
      this.#open({ ...withSensor(this.#now.state, sensor), chip_pitch_um }, `Preset ${sensor.name}.`);
    });
    on("name", "change", ({ target }) => this.#move("sensor.name", target.value, true));
    on("open", "click", () => byId("file").click());
    on("file", "change", ({ target }) => {
      this.#read(target.files[0]);
      target.value = "";
    });
    on("save", "click", () => this.#save());
    on("link", "click", () => {
      if (!this.#isWhole()) return;
      this.#writeHash();
      this.#copy(location.href, "Link copied. It opens while this explorer runs; always, if it is started with --port.");
    });
    on("command", "click", () => this.#copyCommand());
    on("pin", "click", () => this.#pin());
    on("csv", "click", () => this.#drawn && download("tod_curve.csv", csvOf(this.#pins, this.#drawn)));
    for (const format of ["png", "svg"]) {
      on(format, "click", () => this.#drawn && this.#plot("/api/plot", plotOf(this.#comparable, this.#drawn, this.#shown, format)));
      on(`range-${format}`, "click", () => this.#range?.body && this.#plot("/api/range-plot", { ...this.#range.body, format }));
      on(`mtf-${format}`, "click", () => this.#mtfSensor && this.#plot("/api/mtf-plot", { sensor: this.#mtfSensor, format }));
    }
    for (const input of document.querySelectorAll(".axes input")) {
      input.addEventListener("change", () => {
        this.#view = { ...this.#view, [input.name]: input.value };
        if (this.#level !== this.#now.level) this.#enter(this.#now.state);
        this.#drawCurve();
        this.#keep();
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
    if (key === "y" || event.shiftKey) this.#go(this.#history.redo());
    else this.#undo();
  }

  /** Go a step back; the first one drops a text that is no value. */
  #undo() {
    this.#go(this.#now.unread.size ? this.#history.state : this.#history.undo());
  }

  /** A field has moved to a value, or with `undefined` stays where it is. */
  #move(key, value, isFinal, isSlider = false) {
    const { state, unread } = this.#now;
    const isMoved = value !== undefined && JSON.stringify(value) !== JSON.stringify(valueOf(state, key));
    if (isMoved || unread.has(key)) {
      const others = new Map([...unread].filter(([other]) => other !== key));
      const next = isMoved ? moved(state, key, value) : state;
      this.#controls.show(next, state);
      this.#enter(next, others);
    }
    if (isFinal) this.#record(isSlider ? key : null);
  }

  /** The text of a field is no value: a line says why, or with null it is being typed. */
  #unread(key, line) {
    if (this.#now.unread.get(key) === line) return;
    this.#enter(this.#now.state, new Map([...this.#now.unread, [key, line]]));
  }

  /** Level to ask for; that of a camera that counts photons is what the server says. */
  get #level() {
    return this.#view.strength === "contrast" ? "contrast" : "snr";
  }

  /** Make a state the one that the page shows, and ask for its curve. */
  #enter(state, unread = this.#now.unread) {
    this.#now = { id: this.#now.id + 1, state, unread, level: this.#level, curve: null, error: null };
    this.#moves.ask(this.#now);
    if (!unread.size) this.#live.ask(this.#now);
    this.#keep();
    this.#tell("");
    this.#showRecord();
  }

  #record(key) {
    this.#history.record(this.#now.state, key);
    this.#showHistory();
  }

  #showHistory() {
    byId("undo").disabled = !this.#history.canUndo && !this.#now.unread.size;
    byId("redo").disabled = !this.#history.canRedo;
  }

  /** Go to a state that comes from elsewhere than the controls, and remember it. */
  #open(state, message) {
    this.#history.record(state);
    this.#go(state);
    this.#tell(message);
  }

  #go(state) {
    this.#controls.show(state);
    byId("name").value = state.sensor.name;
    this.#enter(state, new Map());
  }

  #showCurve(record, curve) {
    record.curve = curve;
    if (record.state.sizes_detectors === null) {
      this.#complete(record, { sizes_detectors: curve.thresholds.map((one) => one.size_detectors) });
    }
    this.#drawn = record;
    this.#drawCurve();
    this.#showLimits(curve.limits);
    this.#range?.show(record);
    clearTimeout(this.#timers.stale);
    delete this.#timers.stale;
    byId("curve").classList.remove("stale");
    this.#showRecord();
    if (record !== this.#now) return;
    const { state } = record;
    if (state.sensor !== this.#mtfSensor) this.#later("mtf", MTF_DELAY_MS, () => this.#mtf.ask(state.sensor));
    if (curve.is_last) this.#later("trial", TRIAL_DELAY_MS, () => this.#trial.show(state, curve.thresholds));
  }

  /** Take what the server adds to the state of a record. */
  #complete(record, added) {
    const { state } = record;
    record.state = { ...state, ...added };
    this.#history.complete(state, record.state);
    if (record !== this.#now) return;
    this.#controls.show(record.state, state);
    this.#keep();
  }

  /** Get what follows the moves of a record, and its optics in words. */
  async #follow(record) {
    try {
      const { sensor, note } = await post("/api/moved", record.state);
      if (record !== this.#now) return;
      this.#controls.note("Detector", note);
      if (record.state.before) this.#complete(record, { sensor, before: null });
    } catch {
      // There is no such sensor, as the answer about its curve says.
    }
  }

  async #refuse(record, error) {
    if (error.isGone && (await this.#watch.look())) return;
    record.error = error;
    this.#showRecord();
  }

  /** Show what the present record is: computed, impossible, or neither yet; and whether what is drawn is its curve. */
  #showRecord() {
    const { id, error, curve } = this.#now;
    const isDrawn = this.#drawn === this.#now;
    const { line, lines } = this.#verdict();
    byId("status").textContent = line;
    this.#controls.showErrors(lines);
    this.#showHistory();
    const section = byId("curve");
    // Tests and benchmarks read which request is on the screen, and which one it should be.
    section.dataset.asked = id;
    section.setAttribute("aria-busy", String(!curve?.is_last && !error && !lines.size));
    if (this.#drawn !== null) byId("curve-table").caption.textContent = this.#caption();
    if (isDrawn && curve.is_last) this.#announce(`${curve.limits.sentence} ${curve.summary}`);
    else this.#announce(error || lines.size ? line : "");
    if (error || lines.size) section.classList.add("stale");
    else if (!isDrawn) this.#timers.stale ??= setTimeout(() => section.classList.add("stale"), STALE_DELAY_MS);
  }

  /** Return the line about the present record, and the lines at its fields by key. */
  #verdict() {
    const { curve, error } = this.#now;
    const lines = new Map([...this.#now.unread].filter(([, line]) => line !== null));
    if (error) {
      const name = error.key ?? /^[\w.]+(?=: )/.exec(error.message)?.[0];
      const isOf = (field) => field.key === name || field.names?.includes(name);
      const key = this.#fields.find((field) => isOf(field) && isShown(field, this.#now.state))?.key;
      // The field says of what it is; the line of a file also names the table and the key.
      const line = error.message.replace(/^.*?\w+: (?=found )/, "").replace(/^[\w.]+: /, "");
      if (key === undefined) return { line: `Not possible. ${error.message}`, lines };
      lines.set(key, line[0].toUpperCase() + line.slice(1));
    }
    if (lines.size) {
      const shown = this.#drawn === null ? "There is no curve yet." : "The curve is that of the last possible sensor.";
      return { line: `Not possible. ${shown}`, lines };
    }
    return { line: curve?.line ?? (this.#watch.line ? "Not computed" : "Computing…"), lines };
  }

  /** Return the caption of the numbers: of what sensor they are, and how good. */
  #caption() {
    const stage = this.#drawn.curve.is_last ? "refined" : "estimated";
    const whose = this.#drawn === this.#now ? "Thresholds" : "Thresholds of an earlier sensor";
    return `${whose}, ${stage}; ± is half of the 95 % interval of the computation`;
  }

  #drawCurve() {
    if (this.#drawn === null) return;
    const { curve } = this.#drawn;
    const { quantities, strengths } = curve;
    const chosen = quantities[this.#view.strength].is_offered ? this.#view.strength : strengths[0];
    // Until the curve of another level is there, this one stays as it is.
    const strength = strengths.includes(chosen) ? chosen : strengths[0];
    const view = (this.#shown = { ...this.#view, strength, axis: quantities[strength].axis });
    for (const input of document.querySelectorAll(".axes input")) {
      input.checked = input.value === { ...view, strength: chosen }[input.name];
      if (input.name !== "strength") continue;
      input.disabled = !quantities[input.value].is_offered;
      input.parentElement.title = quantities[input.value].title;
    }
    this.#curveChart.draw(curve.thresholds, this.#comparable, view);
    Object.assign(byId("curve").dataset, { stage: curve.stage, sequence: curve.sequence });
    fillTable(byId("curve-table"), this.#caption(), curve.headers, curve.rows);
    byId("never").textContent = curve.missing[view.unit];
    this.#showPins(view);
  }

  #showLimits(limits) {
    byId("sentence").textContent = limits.sentence;
    const present = Object.entries(SHARES).filter(([name]) => limits[name] > 0);
    const parts = present.map(([name]) => {
      const part = element("span", { className: name });
      part.style.flexGrow = limits[name];
      return part;
    });
    byId("shares").replaceChildren(...parts);
    const labels = present.map(([name, label]) => [
      element("span", { className: `line ${name}` }),
      `${label} ${Math.round(100 * limits[name])} % `,
    ]);
    byId("shares-key").replaceChildren(...labels.flat());
  }

  /** Show that the server is gone, or with null that it is there again; nothing else says so. */
  #showServer(line) {
    byId("server").textContent = line ?? "";
    this.#tell("");
    if (line === null) this.#enter(this.#now.state);
    else this.#showRecord();
  }

  /** Show the error of a call that is not about the curve. */
  async #fail(error) {
    if (!error.isGone || !(await this.#watch.look())) this.#tell(error.message);
  }

  async #showMtf(sensor) {
    try {
      const transfer = await post("/api/mtf", { sensor });
      this.#mtfSensor = sensor;
      this.#mtfChart.draw(transfer);
      byId("nyquist").textContent = transfer.nyquist;
      fillTable(
        byId("mtf-table"),
        `Modulation transfer along x; ${transfer.nyquist}`,
        ["cycles/mrad", "Before sampling", "After sampling"],
        transfer.rows,
      );
    } catch (error) {
      this.#fail(error);
    }
  }

  #pin() {
    if (this.#drawn !== null && this.#pins.length < MOST_PINS) this.#setPins(withPin(this.#pins, this.#drawn));
  }

  /** The pins; those of another kind of sensor have no thresholds that can be compared with the drawn ones. */
  get #comparable() {
    const isAlike = (pin) => countsPhotons(pin.state.sensor) === countsPhotons(this.#drawn.state.sensor);
    return this.#pins.map((pin) => (isAlike(pin) ? pin : { ...pin, thresholds: [] }));
  }

  #setPins(pins) {
    this.#pins = pins;
    this.#keep();
    this.#drawCurve();
  }

  #showPins(view) {
    byId("pin").disabled = this.#pins.length >= MOST_PINS;
    showPins(this.#comparable, this.#drawn, this.#fields, view, ({ number }) => {
      this.#setPins(this.#pins.filter((other) => other.number !== number));
      byId("pin").focus();
    });
  }

  /** Open a file. Of two files the later one counts, whichever answer comes first. */
  async #read(file) {
    if (!file) return;
    this.#file = file;
    if (file.size > MOST_FILE_BYTES) {
      this.#tell(`${file.name} has ${plain(file.size / 1e6)} MB and is no SENSOR.toml; drop a smaller file.`);
      return;
    }
    try {
      const { sensor } = await post("/api/parse", { text: await file.text(), name: file.name });
      if (file === this.#file) this.#open(withSensor(this.#now.state, sensor), `${file.name} opened.`);
    } catch (error) {
      if (file === this.#file) this.#fail(error);
    }
  }

  /** Return whether all fields have values; where they do not, the message says which one lacks it. */
  #isWhole() {
    const [key] = this.#now.unread.keys();
    if (key === undefined) return true;
    const { group, label } = this.#fields.find((field) => field.key === key);
    this.#tell(`${group}, ${label.toLowerCase()}: ${this.#now.unread.get(key) ?? "being typed."}`);
    return false;
  }

  async #save() {
    if (!this.#isWhole()) return;
    try {
      const { text, file, beside } = await post("/api/toml", this.#now.state);
      download(file, text);
      if (beside.length) this.#tell(`${file} saved. Copy ${beside.join(" and ")} beside it: the file names it.`);
    } catch (error) {
      this.#fail(error);
    }
  }

  async #plot(path, body) {
    try {
      await downloadPlot(path, body);
    } catch (error) {
      this.#fail(error);
    }
  }

  async #copyCommand() {
    if (!this.#isWhole()) return;
    try {
      const { command, file } = await post("/api/toml", this.#now.state);
      if (command === null) {
        this.#tell("The command has the sizes of the curve, which is still being computed.");
        return;
      }
      await this.#copy(command, `Command copied. It reads ${file}, which Save SENSOR.toml writes.`);
    } catch (error) {
      this.#fail(error);
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
      return this.#take(fromHash(location.hash, this.#fields, this.#first));
    } catch (error) {
      return error.message;
    }
  }

  #take({ state, view }) {
    for (const input of document.querySelectorAll(".axes input")) {
      if (view[input.name] === input.value) this.#view = { ...this.#view, [input.name]: input.value };
    }
    this.#history.record(state);
    return "";
  }

  /** Keep what is shown for a reload, at once; the link follows, as browsers count how often it changes. */
  #keep() {
    this.#session.keep({ state: this.#now.state, view: this.#view, pins: this.#pins });
    this.#later("hash", HASH_DELAY_MS, () => this.#writeHash());
  }

  #writeHash() {
    history.replaceState(null, "", `#${toHash(this.#now.state, this.#view)}`);
    this.#session.keep({ state: this.#now.state, view: this.#view, pins: this.#pins });
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

try {
  new Explorer(await post("/api/start", {}));
} catch (error) {
  byId("status").textContent = "";
  byId("message").textContent = error.message;
}
