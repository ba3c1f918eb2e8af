// Requests for curves: at most one is without an answer, and of those asked for meanwhile only the newest is sent.

import { lines } from "./server.js";

/** Longest wait for the estimate of an earlier state before the newest one takes its place. */
const PATIENCE_MS = 1000;

/**
 * Curves of the newest record: first an estimate, then refined ones.
 *
 * An estimate that is under way is awaited, so that a slider that never rests still moves the curve. Its refinement
 * ends as soon as there is a newer record. An answer goes to the record that was asked for, and to no other.
 */
export class LiveCurve {
  #client = crypto.randomUUID();
  #waiting = null;
  #active = null;
  #handlers;

  /** @param {{show: Function, fail: Function}} handlers `show(record, curve)`, and `fail(record, error)`. */
  constructor(handlers) {
    this.#handlers = handlers;
  }

  /**
   * Ask for the curve of a record; an earlier one that still waits is forgotten.
   * @param {{id: number, state: object, level: string}} record Its id is higher than those of all records before.
   */
  ask(record) {
    this.#waiting = record;
    const remaining = this.#active?.isAnswered === false ? this.#active.started + PATIENCE_MS - performance.now() : 0;
    if (remaining > 0) {
      this.#active.timer ??= setTimeout(() => this.#next(), remaining);
    } else {
      this.#next();
    }
  }

  async #next() {
    this.#end();
    const record = this.#waiting;
    this.#waiting = null;
    const active = { abort: new AbortController(), started: performance.now(), isAnswered: false, timer: null };
    this.#active = active;
    try {
      const body = { ...record.state, level: record.level, sequence: record.id, client: this.#client };
      for await (const curve of lines("/api/curve", body, { signal: active.abort.signal })) {
        if (this.#active !== active || curve.sequence !== record.id) return;
        active.isAnswered = true;
        this.#handlers.show(record, curve);
        if (this.#waiting !== null) {
          this.#next(); // at once: leaving the loop waits for the end of the stream
          return;
        }
      }
    } catch (error) {
      if (this.#active !== active) return;
      active.isAnswered = true;
      this.#handlers.fail(record, error);
    }
    if (this.#active !== active) return;
    if (this.#waiting !== null) this.#next();
    else this.#end();
  }

  #end() {
    clearTimeout(this.#active?.timer);
    this.#active?.abort.abort();
    this.#active = null;
  }
}

/** Run a task for the newest argument, one at a time: arguments that come while it runs replace each other. */
export class Newest {
  #task;
  #waiting = [];
  #isRunning = false;

  /** @param {(argument: any) => Promise<void>} task It handles its own errors. */
  constructor(task) {
    this.#task = task;
  }

  async ask(argument) {
    this.#waiting = [argument];
    if (this.#isRunning) return;
    this.#isRunning = true;
    while (this.#waiting.length) await this.#task(this.#waiting.pop());
    this.#isRunning = false;
  }
}
