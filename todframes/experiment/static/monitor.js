// The monitor, measured by the person: pixel pitch, distance, gamma, and luminances if there is a photometer.

import { exactCanvas, grey } from "./pixels.js";

const CODES = [0, 16, 32, 64, 96, 128, 160, 192, 224, 255];
const HALF_TONE_PX = 240;
const SQUARE_PX = 96;

const element = (id) => document.getElementById(id);
const shown = (number, digits) => Number(number.toPrecision(digits)).toString();

/** Distances at which people sit at a desk. */
const DESK_MM = [300, 1500];

/** Ratio of the angles of a pixel, here and in the dataset, beyond which the server refuses the monitor. */
const MOST_TIMES = 1.99;

/**
 * Lead the person through the screens, and return what they measured as `/api/monitor` wants it.
 *
 * @param {{pixel_pitch_mrad: number}} dataset
 * @param {(id: string) => void} show - shows the screen of that id.
 * @param {(measured: object) => Promise<object>} submit - rejects with the server's reason if it refuses the monitor.
 * @returns {Promise<object>} what `submit` returned.
 */
export async function measureMonitor(dataset, show, submit) {
  const measures = { size: measureSize, distance: measureDistance, gamma: measureGamma, photometer: measureLuminances };
  const names = Object.keys(measures);
  const measured = { photometer: null }, refusal = element("monitor-error");
  let name = names[0];
  for (;;) {
    show(name);
    const pressed = await measures[name](measured, dataset, element(name));
    refusal.hidden = true;
    if (pressed !== "next" || name === "size" || name === "distance") { // a photometer is asked for with *more*
      name = names[names.indexOf(name) + (pressed === "back" ? -1 : 1)];
      continue;
    }
    try {
      return await submit({
        device_pixel_ratio: window.devicePixelRatio,
        ...measured,
        screen_px: [window.screen.width, window.screen.height].map((side) => Math.round(side * window.devicePixelRatio)),
        viewport_px: [window.innerWidth, window.innerHeight].map((side) => Math.round(side * window.devicePixelRatio)),
      });
    } catch (error) {
      refusal.textContent = error.message;
      refusal.hidden = false;
      element(name).querySelector(".choices").before(refusal);
    }
  }
}

/** Wait for a press of *next*, *back* or *more* of a screen, and return which; `listen` gets a signal that ends with it. */
function choice(screen, listen, isValid = () => true) {
  return new Promise((done) => {
    const ending = new AbortController(), { signal } = ending;
    for (const name of ["next", "back", "more"]) {
      screen.querySelector(`.${name}`)?.addEventListener("click", () => {
        if (name === "next" && !isValid()) return;
        ending.abort();
        done(name);
      }, { signal });
    }
    listen(signal);
  });
}

/** Say at once if nobody at a desk can sit where the frames have their own sizes, or near enough. */
function showReach(screen, { pixel_pitch_mm }, { pixel_pitch_mrad }) {
  const proposed = 1000 * pixel_pitch_mm / pixel_pitch_mrad, [nearest, farthest] = DESK_MM;
  const isFar = proposed / MOST_TIMES > farthest, isNear = proposed * MOST_TIMES < nearest, place = screen.querySelector(".reach");
  place.hidden = !isFar && !isNear;
  if (place.hidden) return;
  const limit = isFar ? proposed / MOST_TIMES : proposed * MOST_TIMES;
  place.textContent = `Call the experimenter: a desk does not do for these frames. Their pixels are ${shown(pixel_pitch_mrad, 3)} mrad wide, ` +
    `which those of this monitor, ${shown(pixel_pitch_mm, 3)} mm, are from ${shown(proposed, 3)} mm. The test can be done from ` +
    `${shown(limit, 3)} mm${isFar ? " or farther" : " or nearer"}. ` +
    (isFar ? "Sit that far away, or take a monitor with finer pixels, or frames whose pixels are larger at the eye."
      : "Take a monitor with larger pixels, or frames whose pixels are smaller at the eye.");
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
    showReach(screen, measured, dataset);
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
  field.min = Math.ceil(proposed / MOST_TIMES);
  field.max = Math.floor(proposed * MOST_TIMES);
  showReach(screen, measured, dataset);
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
  measured.photometer = null;
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
  const table = element("readings");
  const side = Math.floor(Math.min(320, document.documentElement.clientWidth / 2) * window.devicePixelRatio);
  const fill = (code) => exactCanvas(element("patch"), side, side, code);
  if (!table.childElementCount) table.append(...CODES.map(readingRow));
  const fields = [...table.querySelectorAll("input")];
  const update = () => {
    const filled = fields.filter((field) => field.value !== "");
    measured.photometer = filled.map((field) => [Number(field.dataset.code), field.valueAsNumber]);
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
