// Calls of the server that this page came from. Bodies and answers are JSON.

/** The server's line about a request that it refused; `key` names the setting, such as "optics.aperture_mm". */
export class ServerError extends Error {
  /** @param {string} line @param {number} status @param {string|null} key */
  constructor(line, status, key) {
    super(line);
    this.name = "ServerError";
    this.status = status;
    this.key = key;
  }

  /** Whether the server does not answer this page at all: it has ended, or another one is in its place. */
  get isGone() {
    return this.status === 0 || this.status === 403;
  }
}

const GONE = "The server cannot be reached: it has ended. Start the command again.";
const WATCH_MS = 2000;

/** Asks the server every two seconds whether it is there, and reports when that changes. */
export class Watch {
  /** @type {string|null} Line that says that the server has gone, null while it is there. */
  line = null;
  #changed;

  /** @param {(line: string|null) => void} changed Called with a line when the server has gone, with null when it is back. */
  constructor(changed) {
    this.#changed = changed;
    setInterval(() => this.look(), WATCH_MS);
    document.addEventListener("visibilitychange", () => document.hidden || this.look());
  }

  /** Ask now. Returns the line, or null. */
  async look() {
    let line = null;
    try {
      const { status } = await fetch("/", { method: "HEAD" });
      if (status === 403) line = "This page belongs to a server that has ended. Open the address that the new one has printed.";
    } catch {
      line = "The server has ended. Start the command again, and open the address that it prints.";
    }
    if (line !== this.line) {
      this.line = line;
      this.#changed(line);
    }
    return line;
  }
}

/**
 * Send a body and return the answer.
 * @param {string} path
 * @param {object} body
 * @param {{signal?: AbortSignal}} [options]
 * @returns {Promise<any>}
 * @throws {ServerError} If the server refuses it, or cannot be reached (status 0).
 */
export async function post(path, body, options = {}) {
  return (await send(path, body, options)).json();
}

/**
 * Send a body and yield the lines of the answer as they come.
 * @param {string} path
 * @param {object} body
 * @param {{signal?: AbortSignal}} [options]
 * @returns {AsyncGenerator<any, void, void>}
 * @throws {ServerError} If the server refuses it, cannot be reached, or sends a line with an `error`.
 */
export async function* lines(path, body, options = {}) {
  const reader = (await send(path, body, options)).body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { done, value } = await reader.read().catch(unreachable);
      rest += value ?? "";
      const whole = rest.split("\n");
      rest = whole.pop() ?? "";
      for (const line of whole) {
        const one = JSON.parse(line);
        if (one.error) throw new ServerError(one.error, 422, one.key ?? null);
        yield one;
      }
      if (done) return;
    }
  } finally {
    await reader.cancel();
  }
}

async function send(path, body, { signal }) {
  let response;
  try {
    response = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
      signal,
    });
  } catch (error) {
    unreachable(error);
  }
  if (response.ok) return response;
  const text = await response.text();
  let found = { error: text.trim() || `The server answered with status ${response.status}.`, key: null };
  try {
    found = { ...found, ...JSON.parse(text) };
  } catch {
    // Not JSON: the text is the line.
  }
  throw new ServerError(found.error, response.status, found.key);
}

function unreachable(error) {
  if (error instanceof DOMException && error.name === "AbortError") throw error;
  throw new ServerError(GONE, 0, null);
}
