// The server, asked until it answers: what was asked is kept and sent again while it cannot be reached.

import { ServerError, post } from "./server.js";
import { pause } from "./stage.js";

const RETRY_MS = 1000;
const UNREACHABLE = "Call the experimenter. Your answers are kept. The server does not answer: start the same command again, and open the " +
  "address that it prints.";
const UNKNOWN = "Call the experimenter. The server was started again: open the address that it printed, and the test goes on where it was.";

/** Show a text in a place that is read aloud when it changes; the place is hidden without one. */
export function tell(place, text) {
  place.hidden = text === "";
  if (place.textContent !== text) place.textContent = text;
}

/** Do something that needs the server, again and again until the server can be reached. */
async function persist(request) {
  const line = document.getElementById("connection");
  for (;;) {
    try {
      const answer = await request();
      tell(line, "");
      return answer;
    } catch (error) {
      const isKnown = error instanceof ServerError;
      if (!isKnown || (error.status !== 0 && error.status !== 403 && error.status < 500)) {
        tell(line, "");
        throw error;
      }
      tell(line, error.status === 403 ? UNKNOWN : error.status === 0 ? UNREACHABLE : error.message);
      await pause(RETRY_MS);
    }
  }
}

/** Ask the server; rejects with a ServerError where it refuses what was asked. */
export function ask(path, body = {}) {
  return persist(() => post(path, body));
}

/** Fetch an image, its code values unchanged. */
export function askImage(path) {
  return persist(async () => {
    const response = await fetch(path).catch(() => { throw new ServerError(UNREACHABLE, 0, null); });
    if (!response.ok) throw new ServerError(await response.text(), response.status, null);
    return createImageBitmap(await response.blob(), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  });
}
