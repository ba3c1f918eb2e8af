// The state of the page: a sensor, an observer and a test. States are never changed; a change makes a new one.

import { plain } from "./numbers.js";

/**
 * @typedef {object} State
 * @property {object} sensor Tables and name, as in SENSOR.toml.
 * @property {object} observer
 * @property {number[]|null} sizes_detectors Null: those that suit the sensor, which the server chooses.
 * @property {number} p_correct
 * @property {number} chip_pitch_um Pitch of the detectors on the chip, for the f-number.
 * @property {number|null} keep_fill_factor Width divided by pitch, which is kept when one of them moves; or null.
 * @property {number|null} couple_netd NETD × (aperture × width)², which is kept when one of them moves; or null.
 */

/**
 * What the page shows: a state and what has come of it. All that the page says of a curve is said of one record.
 * @typedef {object} Asked
 * @property {number} id Number of the request for its curve, higher with each record.
 * @property {State} state
 * @property {Map<string, string|null>} unread Lines about fields whose text is no value, null while it is typed. With
 *   such a field there is no request: the state has the value that the field had before.
 * @property {string} level Quantity whose threshold is asked for.
 * @property {object|null} curve Latest answer.
 * @property {Error|null} error
 */

/** Time in which moves of one slider count as one step of undo, such as those of an arrow key held down. */
const ONE_STEP_MS = 800;
const MOST_STEPS = 200;

/** Return the value of a key: "optics.aperture_mm", "sensor.name", "observer.internal_noise" or "p_correct". */
export function valueOf(state, key) {
  return place(key).reduce((part, name) => part?.[name], state);
}

/** Return a state that differs in the value of one key. */
export function withValue(state, key, value) {
  const change = (part, [name, ...rest]) => ({ ...part, [name]: rest.length ? change(part[name], rest) : value });
  return change(state, place(key));
}

const APERTURE = "optics.aperture_mm";
const PITCH = "detector.pitch_mrad";
const WIDTH = "detector.width_mrad";
const NETD = "noise.netd_mk";
const DIGITS = 4;

/**
 * Return the state after a field has moved, with the values that follow it. A switch moves to true or false.
 *
 * The NETD follows (f-number)² / (area of a detector). The focal length is in both and cancels: what remains is
 * 1 / (aperture × angular width)².
 */
export function moved(state, key, value) {
  if (key === "keep_fill_factor") return { ...state, [key]: value ? fill(state) : null };
  if (key === "couple_netd") return { ...state, [key]: value ? netdConstant(state) : null };
  let next = withValue(state, key, value);
  const kept = next.keep_fill_factor;
  if (kept !== null && key === PITCH) next = withValue(next, WIDTH, Math.min(value, rounded(value * kept)));
  if (kept !== null && key === WIDTH) next = withValue(next, PITCH, Math.max(value, rounded(value / kept)));
  if (next.couple_netd === null) return next;
  if (key === NETD) return { ...next, couple_netd: netdConstant(next) };
  if (valueOf(next, NETD) === null || key.startsWith("noise.")) return next;
  const netd = rounded(next.couple_netd / (valueOf(next, APERTURE) * valueOf(next, WIDTH)) ** 2);
  return netd > 0 && Number.isFinite(netd) ? withValue(next, NETD, netd) : next;
}

/** Return a state with another sensor, for which the server chooses sizes; its switches stay where they are. */
export function withSensor(state, sensor) {
  const next = { ...state, sensor, sizes_detectors: null };
  return {
    ...next,
    keep_fill_factor: state.keep_fill_factor === null ? null : fill(next),
    couple_netd: state.couple_netd === null ? null : netdConstant(next),
  };
}

const rounded = (value) => Number(value.toPrecision(DIGITS));

const fill = (state) => valueOf(state, WIDTH) / valueOf(state, PITCH);

function netdConstant(state) {
  return (valueOf(state, NETD) ?? 0) * (valueOf(state, APERTURE) * valueOf(state, WIDTH)) ** 2;
}

/** Return f-number, focal length and λF/d of a state, in words. */
export function opticsInWords({ sensor, chip_pitch_um: pitch_um }) {
  const { optics, detector } = sensor;
  const focal_mm = pitch_um / detector.pitch_mrad;
  const fNumber = focal_mm / optics.aperture_mm;
  const ratio = (optics.wavelength_um * fNumber) / pitch_um;
  return `f/${plain(rounded2(fNumber))}, focal length ${plain(rounded2(focal_mm))} mm, λF/d ${plain(rounded2(ratio))}`;
}

const rounded2 = (value) => Number(value.toPrecision(value >= 100 ? 3 : 2));

function place(key) {
  const path = key.split(".");
  return path.length > 1 && !["observer", "sensor"].includes(path[0]) ? ["sensor", ...path] : path;
}

/** States that were settled, in order, and the one that is shown. */
export class History {
  #states;
  #at = 0;
  #last = { key: null, time: 0 };

  constructor(state) {
    this.#states = [state];
  }

  get state() {
    return this.#states[this.#at];
  }

  get canUndo() {
    return this.#at > 0;
  }

  get canRedo() {
    return this.#at < this.#states.length - 1;
  }

  /** Add a state after the present one. `key` names the slider that was moved, null if it was none. */
  record(state, key = null, time = performance.now()) {
    if (JSON.stringify(state) === JSON.stringify(this.state)) return;
    const isOneStep = key !== null && key === this.#last.key && time - this.#last.time < ONE_STEP_MS;
    const kept = this.#states.slice(Math.max(0, this.#at + 1 - MOST_STEPS), this.#at + (isOneStep ? 0 : 1));
    this.#states = [...kept, state];
    this.#at = kept.length;
    this.#last = { key, time };
  }

  /** Put a state in the place of an equal one that lacked what the server has chosen since. */
  complete(state, whole) {
    if (this.state === state) this.#states[this.#at] = whole;
  }

  undo() {
    return this.#move(-1);
  }

  redo() {
    return this.#move(1);
  }

  #move(by) {
    this.#last = { key: null, time: 0 };
    this.#at = Math.min(Math.max(this.#at + by, 0), this.#states.length - 1);
    return this.state;
  }
}

/** Return the part of a link that holds a state and the choice of axes: JSON in base64url. */
export function toHash(state, view) {
  const bytes = new TextEncoder().encode(JSON.stringify({ ...state, view }));
  const binary = Array.from(bytes, (byte) => String.fromCharCode(byte)).join("");
  return btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
}

/**
 * Return the state and axes of a link. Only what `fields` know is taken, over the values of `first`.
 *
 * @throws {Error} If it is not the hash of a state.
 */
export function fromHash(hash, fields, first) {
  const binary = atob(hash.replace(/^#/, "").replaceAll("-", "+").replaceAll("_", "/"));
  const found = JSON.parse(new TextDecoder().decode(Uint8Array.from(binary, (letter) => letter.charCodeAt(0))));
  if (typeof found?.sensor !== "object" || found.sensor === null) throw new Error("no sensor");
  let state = first;
  for (const { key } of fields) {
    const value = valueOf(found, key);
    if (isPlain(value)) state = withValue(state, key, value);
  }
  if (typeof found.sensor.name === "string") state = withValue(state, "sensor.name", found.sensor.name);
  return { state, view: found.view ?? {} };
}

function isPlain(value) {
  if (Array.isArray(value)) return value.every((one) => typeof one === "number");
  return value === null || ["number", "string"].includes(typeof value);
}

/** What a reload of the tab brings back: state, axes and pinned curves, unless the address has another link since. */
export class Session {
  #key;
  state = null;
  view = {};
  pins = [];

  /**
   * @param {string} version
   * @param {State} first Version and first state of the server; of others nothing is brought back.
   */
  constructor(version, first) {
    this.#key = `explorer ${version} ${JSON.stringify(first)}`;
    try {
      const { hash, state, view, pins } = JSON.parse(sessionStorage.getItem(this.#key));
      this.pins = pins;
      if (hash === location.hash) Object.assign(this, { state, view });
    } catch {
      // Nothing is kept, or the browser keeps nothing.
    }
  }

  /** @param {{state: State, view: object, pins: object[]}} shown */
  keep(shown) {
    try {
      sessionStorage.setItem(this.#key, JSON.stringify({ hash: location.hash, ...shown }));
    } catch {
      // The browser keeps nothing; the link still has the state.
    }
  }
}
