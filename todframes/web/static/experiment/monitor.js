// The monitor, measured by the person: pixel pitch, distance, gamma, and luminances if there is a photometer.

import { exactCanvas, grey } from "./pixels.js";

const CODES = [0, 16, 32, 64, 96, 128, 160, 192, 224, 255];
const HALF_TONE_PX = 240;
const SQUARE_PX = 96;

const element = (id) => document.getElementById(id);
const shown = (number, digits) => Number(number.toPrecision(digits)).toString();

/**
 * Lead the person through the four screens, and return what they measured as `/api/monitor` wants it.
 *
 * @param {{pixel_pitch_mrad: number}} dataset
 * @param {(id: string) => void} show - shows the screen of that id.
 * @param {(measured: object) => Promise<object>} submit - rejects with the server's reason if it refuses the monitor.
 * @returns {Promise<object>} what `submit` returned.
 */
export async function measureMonitor(dataset, show, submit) {
  const measures = [measureSize, measureDistance, measureGamma, measureLuminances];
  const measured = {};
  let step = 0;
  for (;;) {
    const screen = ["size", "distance", "gamma", "photometer"][step];
    show(screen);
    const isNext = await measures[step](measured, dataset, element(screen));
    step += isNext ? 1 : -1;
    element("monitor-error").hidden = true;
    if (step < measures.length) continue;
    try {
      return await submit({
        device_pixel_ratio: window.devicePixelRatio,
        ...measured,
        screen_px: [window.screen.width, window.screen.height].map((side) => Math.round(side * window.devicePixelRatio)),
        viewport_px: [window.innerWidth, window.innerHeight].map((side) => Math.round(side * window.devicePixelRatio)),
      });
    } catch (error) {
      step -= 1;
      element("monitor-error").textContent = error.message;
      element("monitor-error").hidden = false;
    }
  }
}

/** Wait for a press of *next* (true) or *back* (false) of a screen; `listen` gets a signal that ends with it. */
function choice(screen, listen, isValid = () => true) {
  return new Promise((done) => {
    const ending = new AbortController(), { signal } = ending;
    const end = (isNext) => { ending.abort(); done(isNext); };
    screen.querySelector(".next").addEventListener("click", () => { if (isValid()) end(true); }, { signal });
    screen.querySelector(".back")?.addEventListener("click", () => end(false), { signal });
    listen(signal);
  });
}

function measureSize(measured, dataset, screen) {
  const card = element("card"), edge = element("card-edge"), object = element("object");
  let width = 0;
  const setWidth = (pixels) => {
    const largest = card.parentElement.clientWidth * window.devicePixelRatio;
    width = Math.min(Math.max(Math.round(pixels), 50), Math.floor(largest));
    const length_mm = Number(object.value);
    measured.pixel_pitch_mm = length_mm / width;
    card.style.width = `${width / window.devicePixelRatio}px`;
    card.style.aspectRatio = String(length_mm / ({ "85.6": 53.98, "53.98": 85.6 }[object.value] ?? length_mm / 4));
    for (const [name, value] of [["min", 50], ["max", Math.floor(largest)], ["now", width]]) {
      edge.setAttribute(`aria-value${name}`, value);
    }
    edge.setAttribute("aria-valuetext", `${width} pixels`);
    element("size-result").textContent = `${width} pixels: ${shown(measured.pixel_pitch_mm, 4)} mm a pixel`;
  };
  const guess = () => setWidth(measured.pixel_pitch_mm ? Number(object.value) / measured.pixel_pitch_mm
    : Number(object.value) / 25.4 * 96 * window.devicePixelRatio);
  return choice(screen, (signal) => {
    guess();
    const { pixel_pitch_mm } = measured;
    object.addEventListener("change", () => { measured.pixel_pitch_mm = pixel_pitch_mm; guess(); }, { signal });
    const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 };
    edge.addEventListener("keydown", (event) => {
      if (!(event.key in steps)) return;
      event.preventDefault();
      setWidth(width + steps[event.key]);
    }, { signal });
    card.addEventListener("pointerdown", (event) => {
      card.setPointerCapture(event.pointerId);
      edge.focus();
      event.preventDefault();
    }, { signal });
    card.addEventListener("pointermove", (event) => {
      if (!card.hasPointerCapture(event.pointerId)) return;
      setWidth((event.clientX - card.getBoundingClientRect().left) * window.devicePixelRatio);
    }, { signal });
  });
}

function measureDistance(measured, dataset, screen) {
  const field = element("distance-mm");
  const proposed = 1000 * measured.pixel_pitch_mm / dataset.pixel_pitch_mrad;
  element("distance-proposal").textContent = `The frames have their own sizes from ${shown(proposed, 3)} mm: a pixel is then ` +
    `${shown(dataset.pixel_pitch_mrad, 3)} mrad. Sit there if you can, and stay there. From elsewhere, triangles are smaller or larger, ` +
    "and the data say so.";
  // Beyond these, pixels are so much larger or smaller than the dataset's that the server refuses the monitor.
  field.min = Math.ceil(proposed / 1.99);
  field.max = Math.floor(proposed * 1.99);
  if (!measured.viewing_distance_mm) field.value = shown(proposed, 3);
  const update = () => {
    measured.viewing_distance_mm = field.valueAsNumber;
    const times = proposed / measured.viewing_distance_mm;
    element("distance-result").textContent = !field.validity.valid ? `Type the distance in millimetres, from ${field.min} to ${field.max}.`
      : Math.abs(times - 1) < 0.01 ? "Triangles have the size that the dataset says."
        : `Triangles are ${shown(times, 3)} times as large as the dataset says.`;
  };
  return choice(screen, (signal) => {
    update();
    field.addEventListener("input", update, { signal });
  }, () => field.reportValidity());
}

function measureGamma(measured, dataset, screen) {
  const canvas = element("half-tone"), slider = element("gamma-code");
  const context = exactCanvas(canvas, HALF_TONE_PX, HALF_TONE_PX, 0);
  context.fillStyle = grey(255);
  for (let row = 1; row < HALF_TONE_PX; row += 2) context.fillRect(0, row, HALF_TONE_PX, 1);
  const update = () => {
    const corner = (HALF_TONE_PX - SQUARE_PX) / 2, code = slider.valueAsNumber;
    context.fillStyle = grey(code);
    context.fillRect(corner, corner, SQUARE_PX, SQUARE_PX);
    // Half of the lines are white: half of the light between black and white, whatever black is.
    measured.gamma = Math.log(0.5) / Math.log(code / 255);
    slider.setAttribute("aria-valuetext", `${code} of 255`);
  };
  return choice(screen, (signal) => {
    update();
    slider.addEventListener("input", update, { signal });
  });
}

function measureLuminances(measured, dataset, screen) {
  const table = element("readings"), next = screen.querySelector(".next");
  const side = Math.floor(Math.min(320, document.documentElement.clientWidth / 2) * window.devicePixelRatio);
  const fill = (code) => exactCanvas(element("patch"), side, side, code);
  if (!table.childElementCount) table.append(...CODES.map(readingRow));
  const fields = [...table.querySelectorAll("input")];
  const update = () => {
    const filled = fields.filter((field) => field.value !== "");
    measured.photometer = filled.length ? filled.map((field) => [Number(field.dataset.code), field.valueAsNumber]) : null;
    next.textContent = filled.length ? "Use these" : "Go on without";
  };
  fill(128);
  return choice(screen, (signal) => {
    update();
    for (const field of fields) {
      field.addEventListener("focus", () => fill(Number(field.dataset.code)), { signal });
      field.addEventListener("input", update, { signal });
    }
  }, () => fields.every((field) => field.reportValidity()));
}

function readingRow(code) {
  const row = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
  const field = document.createElement("input");
  head.scope = "row";
  head.className = "number";
  head.textContent = code;
  Object.assign(field, { type: "number", inputMode: "decimal", min: 0, step: "any", ariaLabel: `Luminance of code ${code} in cd/m²` });
  field.dataset.code = code;
  cell.append(field);
  row.append(head, cell);
  return row;
}
