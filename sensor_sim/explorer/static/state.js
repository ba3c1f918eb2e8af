// The state of the page: a sensor, an observer and a test. States are never changed; a change makes a new one.

/**
 * @typedef {object} State
 * @property {object} sensor Tables and name, as in SENSOR.toml.
 * @property {object} observer
 * @property {number[]} sizes_detectors
 * @property {number} p_correct
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
  return value === null || typeof value === "number" || typeof value === "string";
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
