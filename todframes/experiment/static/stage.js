// The stage: the whole window in the background's code value, a frame in its middle, and the answer's time.

import { exactCanvas, grey, painted } from "./pixels.js";

/** Times without anything before the mark, of the mark, and between it and the frame, which the mark would mask. */
const BLANK_MS = 150;
const MARK_MS = 300;
const GAP_MS = 150;

/** Length of the arms of the mark, and their width, in pixels of the page. */
const MARK_PX = [6, 1];

const DIRECTIONS = { ArrowUp: "up", ArrowRight: "right", ArrowDown: "down", ArrowLeft: "left" };

const element = (id) => document.getElementById(id);
const stage = element("stage"), canvas = element("stimulus"), controls = element("controls");

let blankSince = 0;
let code = null;
let ink = "";

export const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));

/** Return the luminance of a grey as sRGB has it, relative to white; for legible text alone. */
const linear = (value) => ((value / 255 + 0.055) / 1.055) ** 2.4;

/** Set the page's colours to the background of the frames, with text that is legible on it and does not glare. */
export function adapt(backgroundCode) {
  if (backgroundCode === code) return;
  code = backgroundCode;
  const light = linear(code);
  const away = light > 0.18 ? (light + 0.05) / 4.6 - 0.05 : (light + 0.05) * 4.6 - 0.05;
  ink = grey(Math.round(255 * (1.055 * Math.min(Math.max(away, 0), 1) ** (1 / 2.4) - 0.055)));
  for (const [name, value] of [["paper", grey(code)], ["raised", grey(code)], ["on-accent", grey(code)],
    ...["ink", "muted", "line", "edge", "accent"].map((one) => [one, ink])]) {
    document.documentElement.style.setProperty(`--${name}`, value);
  }
}

/** Give the page its own colours back. */
export function restore() {
  code = null;
  document.documentElement.removeAttribute("style");
}

/** Show the stage without a frame. */
export function clear(progress) {
  canvas.hidden = true;
  blankSince = performance.now();
  element("progress").textContent = progress;
}

/** Put the frame in the middle, on whole pixels of the page, and the arrows below it where there is room. */
function place() {
  const { offsetWidth: width, offsetHeight: height } = canvas;
  const isRoom = controls.offsetHeight + height <= window.innerHeight;
  document.body.classList.toggle("keys-only", !isRoom);
  const lowest = window.innerHeight - height - (isRoom ? controls.offsetHeight : 0);
  canvas.style.left = `${Math.floor((window.innerWidth - width) / 2)}px`;
  canvas.style.top = `${Math.floor(Math.min((window.innerHeight - height) / 2, lowest))}px`;
}

/** Show the mark that the eyes look at, where the middle of the frame will be, for a while. */
async function mark({ width, height }) {
  const context = exactCanvas(canvas, width, height, code), ratio = window.devicePixelRatio;
  const [arm, thick] = MARK_PX.map((side) => side * ratio), [x, y] = [width, height].map((side) => Math.floor(side / 2));
  context.fillStyle = ink;
  context.fillRect(x - arm, y, 2 * arm + thick, thick);
  context.fillRect(x, y - arm, thick, 2 * arm + thick);
  canvas.hidden = false;
  place();
  await pause(MARK_MS);
  exactCanvas(canvas, width, height, code);
  await pause(GAP_MS);
}

/**
 * Show a frame, and return the answer, its time since the frame was painted, and whether the page was hidden or lost
 * the focus in between.
 *
 * @param {{number: number, width: number, height: number, time_limit_ms: ?number}} trial
 * @param {ImageBitmap} bitmap
 * @param {AbortSignal} signal - takes the frame away; the promise then rejects.
 * @returns {Promise<{response: string, response_time_ms: number, lost: ?("hidden"|"unfocused")}>}
 */
export async function present(trial, bitmap, signal) {
  await pause(BLANK_MS - (performance.now() - blankSince));
  signal.throwIfAborted();
  await mark(trial);
  signal.throwIfAborted();
  exactCanvas(canvas, trial.width, trial.height, code).drawImage(bitmap, 0, 0);
  canvas.hidden = false;
  place();
  const begin = await painted();
  signal.throwIfAborted();
  stage.dataset.trial = trial.number;
  return new Promise((resolve, reject) => {
    const ending = new AbortController(), listening = { signal: ending.signal };
    let lost = null;
    const look = () => {
      if (document.visibilityState === "hidden") lost = "hidden";
      else if (!document.hasFocus()) lost ??= "unfocused";
    };
    look();
    document.addEventListener("visibilitychange", look, listening);
    window.addEventListener("blur", () => { lost ??= "unfocused"; }, listening);
    const end = () => {
      ending.abort();
      clearTimeout(limit);
      delete stage.dataset.trial;
      canvas.hidden = true;
      blankSince = performance.now();
    };
    const answer = (response, time) => {
      end();
      resolve({ response, response_time_ms: Math.max(time - begin, 0), lost });
    };
    const limit = trial.time_limit_ms === null ? undefined
      : setTimeout(() => answer("none", begin + trial.time_limit_ms), begin + trial.time_limit_ms - performance.now());
    onArrow(element("arrows"), answer, listening);
    window.addEventListener("resize", place, listening);
    signal.addEventListener("abort", () => { end(); reject(signal.reason); }, listening);
  });
}

/** Call a function with the direction and the time of each arrow that is pressed, of the keyboard or in a place of the page. */
export function onArrow(place, answer, listening) {
  window.addEventListener("keydown", (event) => {
    if (!(event.key in DIRECTIONS) || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey || place.closest("[hidden]")) return;
    event.preventDefault();
    if (!event.repeat) answer(DIRECTIONS[event.key], event.timeStamp);
  }, listening);
  place.addEventListener("click", (event) => {
    const { response } = event.target.dataset;
    if (response) answer(response, event.timeStamp);
  }, listening);
}

/** Say something on the stage, for as long as it takes to read. */
export async function say(text, milliseconds) {
  element("feedback").textContent = text;
  await pause(milliseconds);
  element("feedback").textContent = "";
}
