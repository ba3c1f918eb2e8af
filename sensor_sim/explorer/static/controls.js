// Sliders and number fields of the parameters.

import { element } from "./elements.js";
import { brief, parsed } from "./numbers.js";
import { has, valueOf } from "./state.js";

/** Pause in typing after which a number is taken, so that 150 is not first 1 and then 15. */
const PAUSE_MS = 350;

const MOST_SIZES = 12;

/** Return whether a state has a use for a field: of a sensor's keys it has those that its file has. */
export function isShown({ key, shown_with: others, hidden_with: other }, state) {
  return (others.length ? others : [key]).some((one) => has(state, one)) && !has(state, other);
}

/** The slider of a field: whole positions from 0 on, and the values at them. A logarithmic one has steps in log10. */
class Scale {
  constructor({ min, max, step, scale, kind }) {
    this.min = min;
    this.max = max;
    this.isLog = scale === "log";
    this.isWhole = kind === "integer";
    this.last = Math.round((this.isLog ? Math.log10(max / min) : max - min) / step);
  }

  value(position) {
    if (position <= 0) return this.min;
    if (position >= this.last) return this.max;
    const share = position / this.last;
    const value = this.isLog ? this.min * (this.max / this.min) ** share : this.min + share * (this.max - this.min);
    return this.isWhole ? Math.round(value) : Number(value.toPrecision(3));
  }

  position(value) {
    const share = this.isLog
      ? Math.log(value / this.min) / Math.log(this.max / this.min)
      : (value - this.min) / (this.max - this.min);
    return Math.min(Math.max(Math.round(share * this.last), 0), this.last) || 0;
  }
}

/** One parameter: its label, slider, number field and line for an error. */
class Field {
  #field;
  #scale = null;
  #slider = null;
  #error;
  #change;
  #unread;

  constructor(field, { change, unread }) {
    this.#field = field;
    this.#change = change;
    this.#unread = unread;
    const id = `field-${field.key.replaceAll(".", "-")}`;
    this.#error = element("p", { className: "error", id: `${id}-error`, hidden: true });
    const special = { choice: () => this.#choice(), switch: () => this.#switch(), file: () => element("output") };
    this.input = special[field.kind]?.() ?? this.#text();
    this.input.id = id;
    const label = element("label", { htmlFor: id, id: `${id}-label` }, field.label);
    if (field.unit) label.append(" ", element("span", { className: "unit" }, field.unit));
    label.title = field.help;
    const help = element("span", { id: `${id}-help`, className: "hidden-visually" }, field.help);
    const slider = ["number", "integer"].includes(field.kind) && field.min !== null ? [this.#range(label.id)] : [];
    this.row = element("div", { className: `field of-${field.kind}` }, label, ...slider, this.input, this.#error, help);
    this.input.setAttribute("aria-describedby", `${this.#error.id} ${help.id}`);
  }

  #choice() {
    const options = this.#field.choices.map((name) => element("option", { value: name }, name));
    const select = element("select", {}, ...options);
    select.addEventListener("change", () => this.#change(this.#field.key, select.value, true));
    return select;
  }

  #switch() {
    const input = element("input", { type: "checkbox" });
    input.addEventListener("change", () => this.#change(this.#field.key, input.checked, true));
    return input;
  }

  #text() {
    const mode = this.#field.kind === "integer" ? "numeric" : "decimal";
    const input = element("input", { type: "text", inputMode: this.#field.kind === "sizes" ? "text" : mode });
    input.autocomplete = "off";
    if (this.#field.optional) input.placeholder = this.#field.kind === "sizes" ? "chosen for the sensor" : "none";
    const read = (isFinal) => {
      let value;
      try {
        value = this.#read(input.value);
      } catch (error) {
        this.#unread(this.#field.key, error.message);
        return;
      }
      this.show(value);
      this.#change(this.#field.key, value, isFinal);
    };
    let pause = null;
    input.addEventListener("input", () => {
      clearTimeout(pause);
      this.#unread(this.#field.key, null);
      pause = setTimeout(read, PAUSE_MS, false);
    });
    input.addEventListener("change", () => {
      clearTimeout(pause);
      read(true);
    });
    input.addEventListener("blur", () => {
      try {
        this.#showText(this.#read(input.value)); // while it was edited, the text stayed as it was typed
      } catch {
        // Its line says what is wrong.
      }
    });
    return input;
  }

  #read(text) {
    if (this.#field.optional && text.trim() === "") return null;
    if (this.#field.kind === "sizes") return readSizes(text);
    const value = parsed(text);
    if (Number.isNaN(value)) throw new Error(`Found ${text.trim() ? `“${text}”` : "nothing"}, expected a number.`);
    if (!Number.isFinite(value)) throw new Error(`Found ${text}, which is too large; expected a smaller number.`);
    if (this.#field.kind === "integer" && !Number.isInteger(value)) {
      throw new Error(`Found ${text}, expected a whole number.`);
    }
    return value;
  }

  #range(labelId) {
    const scale = (this.#scale = new Scale(this.#field));
    const slider = (this.#slider = element("input", { type: "range", min: 0, max: scale.last, step: 1 }));
    slider.setAttribute("aria-labelledby", labelId);
    slider.addEventListener("input", () => {
      const value = scale.value(slider.valueAsNumber);
      this.#showText(value);
      this.#change(this.#field.key, value, false);
    });
    slider.addEventListener("change", () => this.#change(this.#field.key, undefined, true, true));
    return slider;
  }

  /** Show a value, except in a number field that is being edited and has this value already. */
  show(value) {
    if (this.#field.kind === "switch") {
      this.input.checked = Boolean(value);
      return;
    }
    this.#showText(value);
    if (this.#slider === null) return;
    this.#slider.classList.toggle("unset", value === null);
    const position = value === null ? 0 : this.#scale.position(value);
    // Several positions may stand for one value: the slider stays where the hand has put it.
    const isThere = value !== null && this.#scale.value(this.#slider.valueAsNumber) === value;
    if (!isThere) this.#slider.value = position;
  }

  #showText(value) {
    const text = value === null ? "" : Array.isArray(value) ? value.join(", ") : brief(value);
    if (!(document.activeElement === this.input && this.#has(value))) this.input.value = text;
    this.#slider?.setAttribute("aria-valuetext", value === null ? "none" : `${text} ${this.#field.unit}`.trim());
  }

  #has(value) {
    if (["choice", "file"].includes(this.#field.kind)) return this.input.value === value;
    try {
      return isSame(this.#read(this.input.value), value);
    } catch {
      return false;
    }
  }

  /** Show the field, or hide it if a state has no use for it. */
  showIf(state) {
    this.row.hidden = !isShown(this.#field, state);
  }

  /** Show the line of an error, or with null none. */
  showError(line) {
    this.#error.textContent = line ?? "";
    this.#error.hidden = line === null;
    this.input.setAttribute("aria-invalid", String(line !== null));
  }
}

const isSame = (one, other) => JSON.stringify(one) === JSON.stringify(other);

function readSizes(text) {
  const sizes = text.split(/[\s,;]+/).filter((part) => part !== "").map(parsed);
  if (!sizes.length || sizes.length > MOST_SIZES || !sizes.every((size) => size > 0 && Number.isFinite(size))) {
    throw new Error(`Expected 1 to ${MOST_SIZES} sizes above 0, such as 2, 3, 4.`);
  }
  return [...new Set(sizes)].sort((a, b) => a - b);
}

/** All parameters, in groups. */
export class Controls {
  #fields = new Map();
  #notes = new Map();
  #groups = [];

  /**
   * @param {HTMLFormElement} form
   * @param {object[]} fields Of `/api/start`.
   * @param {{change: Function, unread: Function}} handlers `change(key, value, isFinal, isSlider)` is called for each
   *   move; `isFinal` means that it was let go of, and the value is then undefined if it is the one before.
   *   `unread(key, line)` is called while the text of a field is no value: being typed (null), or wrong (a line).
   */
  constructor(form, fields, handlers) {
    form.addEventListener("submit", (event) => event.preventDefault());
    for (const [group, members] of Map.groupBy(fields, (field) => field.group)) {
      const made = members.map((field) => new Field(field, handlers));
      members.forEach((field, index) => this.#fields.set(field.key, made[index]));
      const note = element("p", { className: "note" });
      this.#notes.set(group, note);
      const rows = made.map((field) => field.row);
      const set = element("fieldset", {}, element("legend", {}, group), ...rows, note);
      this.#groups.push({ set, rows });
      form.append(set);
    }
  }

  /** Show the fields that a state has a use for, with its values; after another one, those that differ. */
  show(state, before = null) {
    for (const [key, field] of this.#fields) {
      field.showIf(state);
      const value = valueOf(state, key) ?? null;
      if (before === null || !isSame(value, valueOf(before, key) ?? null)) field.show(value);
    }
    for (const { set, rows } of this.#groups) set.hidden = rows.every((row) => row.hidden);
  }

  /** Show a note below a group. */
  note(group, text) {
    this.#notes.get(group).textContent = text;
  }

  /** Show the lines of errors at the fields of their keys, and none at the others. */
  showErrors(lines) {
    for (const [key, field] of this.#fields) field.showError(lines.get(key) ?? null);
  }
}
