// The way through the test, screen by screen; the server says which step comes next.

import { ask, askImage, tell } from "./asking.js";
import { measureMonitor } from "./monitor.js";
import { trouble, watchPixels } from "./pixels.js";
import { adapt, clear, feedback, present, restore } from "./stage.js";

/**
 * @typedef {object} State - what the server says after each step.
 * @property {"consent"|"monitor"|"practice"|"main"|"break"|"done"} step
 * @property {string} subject
 * @property {number} done
 * @property {number} total
 */

const KEPT = "answer";

const element = (id) => document.getElementById(id);
const places = [...document.querySelectorAll("main > section"), element("stage")];

/** The screen that is wanted; the device pixel ratio of the monitor as measured, null before; and the size of a frame. */
let wanted = null;
let measured = { ratio: null, width: 0, height: 0 };
let isExact = true;
let shown = new AbortController();

/** Screens that may be of any scale. */
const FREE = [null, "consent", "declined", "done", "broken"];

/** Show the screen that is wanted, or why it cannot be shown now. */
function refresh() {
  const found = FREE.includes(wanted) ? null : trouble(measured);
  const before = places.find((place) => !place.hidden)?.id;
  const now = found ? "stopped" : wanted;
  isExact = !found;
  if (found) {
    tell(element("stopped-reason"), found.reason);
    tell(element("stopped-remedy"), found.remedy);
    shown.abort();
    shown = new AbortController();
  } else {
    document.dispatchEvent(new Event("exact"));
  }
  for (const place of places) place.hidden = place.id !== now;
  document.body.classList.toggle("staged", now === "stage");
  if (now !== before) {
    window.scrollTo(0, 0);
    element(now)?.querySelector("[data-first]")?.focus();
  }
}

function show(id) {
  wanted = id;
  refresh();
}

/** Wait for a press of one of the buttons, and return its id. */
function pressed(...buttons) {
  return new Promise((done) => {
    const ending = new AbortController();
    for (const button of buttons) {
      button.addEventListener("click", () => { ending.abort(); done(button.id); }, { signal: ending.signal });
    }
  });
}

/** Show a screen, and wait until its *next* is pressed. */
async function read(id) {
  show(id);
  await pressed(element(id).querySelector(".next"));
}

async function readPause(title, text) {
  element("pause-title").textContent = title;
  element("pause-text").textContent = text;
  await read("pause");
}

/** Send an answer; it is kept until the server has saved it, also over a reload of this page. */
async function send(state, answer) {
  sessionStorage.setItem(KEPT, JSON.stringify({ subject: state.subject, answer }));
  const next = await ask("/api/answer", answer);
  sessionStorage.removeItem(KEPT);
  return next;
}

/** Send the answer that a page before this one could not, and return the state. */
async function begin() {
  const state = await ask("/api/state");
  const kept = JSON.parse(sessionStorage.getItem(KEPT));
  if (kept?.subject === state.subject && ["practice", "main"].includes(state.step)) {
    try {
      return await send(state, kept.answer);
    } catch (error) {
      if (error.status !== 409) throw error; // its trial is not the next one
    }
  }
  sessionStorage.removeItem(KEPT);
  return state;
}

/** Show trials until the server says that something else comes. */
async function trials(state) {
  const phase = state.step;
  const title = phase === "practice" ? "Practice: " : "";
  let next = state;
  while (next.step === phase) {
    const trial = await ask("/api/trial");
    measured = { ...measured, width: trial.width, height: trial.height };
    adapt(trial.background_code);
    clear(`${title}${next.done + 1} of ${next.total}`);
    show("stage");
    const bitmap = await askImage(trial.image);
    next = await send(next, { number: trial.number, ...await answered(trial, bitmap) });
    if (typeof next.correct === "boolean") await feedback(next.correct);
  }
  return next;
}

/** Return the answer to a trial; it is shown again if the picture was not exact for a while. */
async function answered(trial, bitmap) {
  for (;;) {
    while (!isExact) await new Promise((done) => document.addEventListener("exact", done, { once: true }));
    const { signal } = shown;
    try {
      const answer = await present(trial, bitmap, signal);
      refresh();
      if (isExact) return answer;
    } catch (error) {
      if (!signal.aborted) throw error;
    }
  }
}

async function consent(state) {
  element("consent-text").replaceChildren(...state.consent_text.trim().split(/\n\s*\n/).map((text) => {
    const paragraph = document.createElement("p");
    paragraph.textContent = text;
    return paragraph;
  }));
  element("consent-subject").textContent = state.subject;
  show("consent");
  const isAgreed = await pressed(element("agree"), element("decline")) === "agree";
  const next = await ask("/api/consent", { agreed: isAgreed });
  if (isAgreed) return next;
  show("declined");
  return null;
}

async function monitor(state) {
  const next = await measureMonitor(state.dataset, show, (monitor) => ask("/api/monitor", monitor));
  measured.ratio = next.device_pixel_ratio;
  return next;
}

async function practice(state) {
  await instruct(state);
  return trials(state);
}

/** Say what to do, before the first trial. */
async function instruct(state) {
  element("pace").textContent = state.time_limit_ms === null ? "Take the time that you need."
    : `You have ${state.time_limit_ms / 1000} seconds for each.`;
  element("instructions-practice").textContent = state.step === "practice"
    ? `First come ${state.total} to practise, with triangles that are easy to see: the page says whether you are correct.`
    : `There are ${state.total} triangles.`;
  await read("instructions");
}

async function main(state, before) {
  if (before === "monitor") {
    await instruct(state);
  } else if (before === "practice") {
    await tellPracticeIsOver(state);
  } else if (before === undefined) {
    await readPause("Welcome back", `${state.done} of ${state.total} are done and saved. The next one comes when you go on.`);
  }
  return trials(state);
}

async function rest(state, before) {
  if (before === "practice") {
    await tellPracticeIsOver(state);
  } else {
    await readPause("A break", `${state.done} of ${state.total} are done. Look away from the screen and rest your eyes. Sit as far away as ` +
      "before when you go on.");
  }
  return ask("/api/continue");
}

function tellPracticeIsOver(state) {
  return readPause("That was the practice", `Now come ${state.total} triangles, most of them hard to see, and the page no longer says whether ` +
    "you are correct.");
}

async function done(state) {
  restore();
  element("done-text").textContent = `That was the last of ${state.total} triangles. The answers are in ${state.files}.`;
  element("summary").replaceChildren(...state.summary.flatMap(([label, text]) => {
    const term = document.createElement("dt"), description = document.createElement("dd");
    term.textContent = label;
    description.textContent = text;
    return [term, description];
  }));
  show("done");
  return null;
}

const steps = { consent, monitor, practice, main, break: rest, done };

async function run() {
  element("full-screen").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen(); else document.documentElement.requestFullscreen();
  });
  watchPixels(refresh);
  let state = await begin(), before;
  measured = { ratio: state.device_pixel_ratio, width: state.dataset.width_px, height: state.dataset.height_px };
  while (state !== null) {
    const { step } = state;
    state = await steps[step](state, before);
    before = step;
  }
}

run().catch((error) => {
  restore();
  element("broken-reason").textContent = error.message;
  show("broken");
  throw error;
});
