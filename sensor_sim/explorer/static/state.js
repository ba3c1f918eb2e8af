// The state of the page: a sensor, an observer and a test. States are never changed; a change makes a new one.

/**
 * @typedef {object} State
 * @property {object} sensor Tables and name, as in SENSOR.toml.
 * @property {object} observer
 * @property {number[]|null} sizes_detectors Null: those that suit the sensor, which the server chooses.
 * @property {number} p_correct
 * @property {number} chip_pitch_um Pitch of the detectors on the chip, for the f-number of a sensor without focal length.
 * @property {string} measured Fingerprint of the measured files that the server has read; empty if there are none.
 * @property {boolean} keep_fill_factor Whether pitch and width move together.
 * @property {object|null} before Sensor before the moves whose followers the server has not sent yet.
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

/** Return whether a state's sensor has a key; its value may be null where SENSOR.toml may do without one. */
export const has = (state, key) => valueOf(state, key) !== undefined;

/** Return whether a sensor counts photons: its thresholds are contrasts at the light of its scene. */
export const countsPhotons = (sensor) => sensor.noise?.model !== undefined;

/** Return the state after a field has moved. What follows it, the server sends. */
export function moved(state, key, value) {
  const next = withValue(state, key, value);
  const isCoupled = state.keep_fill_factor || state.sensor.noise?.couple_netd;
  return isCoupled && typeof value === "number" ? { ...next, before: state.before ?? state.sensor } : next;
}

/** Return a state with another sensor, for which the server chooses sizes. */
export const withSensor = (state, sensor) => ({ ...state, sensor, sizes_detectors: null, before: null });

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
 * Return the state and axes of a link. Only what `fields` know is taken; what is no key of the sensor and missing is
 * that of `first`.
 *
 * @throws {Error} If it is not the hash of a state, or of a sensor whose measured files this server has not read.
 */
export function fromHash(hash, fields, first) {
  let found = null;
  try {
    const binary = atob(hash.replace(/^#/, "").replaceAll("-", "+").replaceAll("_", "/"));
    found = JSON.parse(new TextDecoder().decode(Uint8Array.from(binary, (letter) => letter.charCodeAt(0))));
  } catch {
    // It is no JSON in base64url.
  }
  if (typeof found?.sensor !== "object" || found.sensor === null) {
    throw new Error("The link is damaged: it holds no sensor. The sensor stays as it is.");
  }
  let state = withSensor(first, { name: first.sensor.name });
  for (const key of [...fields.map((field) => field.key), "noise.model"]) {
    const value = valueOf(found, key);
    if (isPlain(value)) state = withValue(state, key, value);
  }
  const isMeasured = has(state, "optics.mtf") || has(state, "optics.psf");
  if (isMeasured && found.measured !== first.measured) {
    throw new Error("The link is of a sensor with a measured file that this server has not read. The sensor stays as it is.");
  }
  if (typeof found.sensor.name === "string") state = withValue(state, "sensor.name", found.sensor.name);
  // An older link has a number or null.
  return { state: { ...state, keep_fill_factor: Boolean(state.keep_fill_factor) }, view: found.view ?? {} };
}

function isPlain(value) {
  if (Array.isArray(value)) return value.every((one) => typeof one === "number");
  return value === null || ["number", "string", "boolean"].includes(typeof value);
}

/** What a reload of the tab brings back: state, axes and pinned curves. A link that is opened has its own state. */
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
      // A reload may overtake the last change of the address.
      const isReload = performance.getEntriesByType("navigation")[0].type === "reload";
      if (isReload || hash === location.hash) Object.assign(this, { state, view });
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
