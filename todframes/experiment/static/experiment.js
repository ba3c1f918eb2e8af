// The way through the test, screen by screen; the server says which step comes next.

import { ask, askImage, tell } from "./asking.js";
import { measureMonitor } from "./monitor.js";
import { trouble, watchPixels } from "./pixels.js";
import { check } from "./check.js";
import { adapt, clear, present, restore, say } from "./stage.js";

/**
 * @typedef {object} State - what the server says after each step.
 * @property {"consent"|"monitor"|"practice"|"main"|"break"|"done"|"stopped"} step
 * @property {string} subject
 * @property {number} done
 * @property {number} total
 */

const KEPT = "answer";

/** What is said after an answer that does not count, by its flag, and for how long. */
const FLAGGED = {
  too_fast: "Too fast: look at the picture first",
  hidden: "This page was hidden: please keep it in front",
  unfocused: "Another window was in front: please keep this one there",
};
const FLAGGED_MS = 1800;
const FEEDBACK_MS = 700;

/** Length of a good break. */
const BREAK_S = 60;

/** Practice blocks without success after which the experimenter is wanted. */
const BLOCKS_ALONE = 2;

const element = (id) => document.getElementById(id);
const places = [...document.querySelectorAll("main > section"), element("stage")];

/** The screen that is wanted; the device pixel ratio of the monitor as measured, null before; and the size of a frame. */
let wanted = null;
let measured = { ratio: null, width: 0, height: 0 };
let isExact = true;
let isLeaving = false;
let shown = new AbortController();

/** Screens that may be of any scale; on these, nothing can be stopped. */
const FREE = [null, "consent", "declined", "done", "ended", "broken"];

/** Show the screen that is wanted, or why it cannot be shown now. */
function refresh() {
  const found = FREE.includes(wanted) ? null : trouble(measured);
  const before = places.find((place) => !place.hidden)?.id;
  const now = isLeaving ? "leave" : found ? "stopped" : wanted;
  isExact = !found && !isLeaving;
  if (found) {
    tell(element("stopped-reason"), found.reason);
    tell(element("stopped-remedy"), found.remedy);
  }
  if (!isExact) {
    shown.abort();
    shown = new AbortController();
  } else {
    document.dispatchEvent(new Event("exact"));
  }
  for (const place of places) place.hidden = place.id !== now;
  document.body.classList.toggle("staged", now === "stage");
  element("stop").hidden = isLeaving || FREE.includes(wanted);
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

/** Let the person leave the screen that is shown, and come back to it. */
function leave() {
  if (element("stop").hidden) return;
  isLeaving = true;
  refresh();
}

/** Return to the screen that was left; a trial is shown again. */
function stay() {
  isLeaving = false;
  refresh();
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
  let next = state;
  do {
    const trial = await ask("/api/trial");
    measured = { ...measured, width: trial.width, height: trial.height };
    adapt(trial.background_code);
    clear(progress(next));
    show("stage");
    const bitmap = await askImage(trial.image);
    next = await send(next, { number: trial.number, ...await answered(trial, bitmap) });
    if (next.flag) await say(FLAGGED[next.flag], FLAGGED_MS);
    else if (typeof next.correct === "boolean") await say(next.correct ? "Correct" : "Not correct", FEEDBACK_MS);
  } while (next.step === phase && (phase === "main" || next.done % next.total > 0)); // a block of practice ends with a pause
  return next;
}

function progress({ step, done, total, practised }) {
  const count = `${done + 1} of ${total}`;
  if (step === "main") return count;
  return `Practice: ${practised ? `${practised.n_correct} of the last ${total} correct, ${practised.n_needed} needed` : count}`;
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

async function practice(state, before) {
  if (state.practised) {
    const { n_correct, n_needed } = state.practised, isAlone = state.done < BLOCKS_ALONE * state.total;
    await readPause("A little more practice", `${n_correct} of the last ${state.total} were correct, and ${n_needed} are needed: the practice goes on ` +
      `until they are. The triangle points away from its flat side.${isAlone ? "" : " Call the experimenter before you go on."}`);
  } else if (state.done > 0) {
    await welcomeBack(state);
  } else {
    await instruct(state);
  }
  return trials(state);
}

/** Say what to do, and see whether it is understood, before the first trial. */
async function instruct(state) {
  element("pace").textContent = state.time_limit_ms === null ? "Take the time that you need."
    : `You have ${state.time_limit_ms / 1000} seconds for each.`;
  element("instructions-practice").textContent = state.step === "practice"
    ? `First come ${state.total} to practise, with triangles that are easy to see: the page says whether you are correct.`
    : `There are ${state.total} triangles.`;
  await read("instructions");
  show("check");
  await check();
}

async function main(state, before) {
  if (before === "monitor") {
    await instruct(state);
  } else if (before === "practice") {
    await tellPracticeIsOver(state);
  } else if (before === undefined) {
    await welcomeBack(state);
  }
  return trials(state);
}

function welcomeBack(state) {
  const title = state.step === "practice" ? "Welcome back to the practice" : "Welcome back";
  return readPause(title, `${state.done} of ${state.total} are done and saved. The next one comes when you go on.`);
}

async function rest(state, before) {
  if (before === "practice") {
    await tellPracticeIsOver(state);
  } else {
    const stop = timer();
    await readPause("A break", `${state.done} of ${state.total} are done. Look away from the screen and rest your eyes. Sit as far away as ` +
      "before when you go on.");
    stop();
  }
  return ask("/api/continue");
}

/** Show how long the break is; returns a function that ends this. */
function timer() {
  const place = element("pause-timer"), begin = performance.now();
  const update = () => {
    const seconds = Math.floor((performance.now() - begin) / 1000);
    place.textContent = `Your break: ${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}. ` +
      (seconds < BREAK_S ? "A minute does the eyes good." : "Go on when you like.");
  };
  update();
  place.hidden = false;
  const ticking = setInterval(update, 1000);
  return () => { clearInterval(ticking); place.hidden = true; };
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

async function stopped(state) {
  restore();
  element("ended-subject").textContent = state.subject;
  show("ended");
  return null;
}

const steps = { consent, monitor, practice, main, break: rest, done, stopped };

async function run() {
  element("full-screen").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen(); else document.documentElement.requestFullscreen();
  });
  element("stop").addEventListener("click", leave);
  window.addEventListener("keydown", (event) => { if (event.key === "Escape") leave(); });
  element("stay").addEventListener("click", stay);
  element("leave-now").addEventListener("click", async () => {
    await ask("/api/stop");
    location.reload();
  });
  watchPixels(refresh);
  let state = await begin(), before;
  for (const place of document.querySelectorAll(".contact")) place.textContent = state.contact;
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
