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
      const { done, value } = await reader.read();
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
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new ServerError("The server cannot be reached: it has ended. Start the command again.", 0, null);
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
