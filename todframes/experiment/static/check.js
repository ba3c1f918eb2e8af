// The check that the task is understood: four large triangles, each to be answered rightly in a row.

import { onArrow, pause } from "./stage.js";

const TURNS = { up: 0, right: 90, down: 180, left: 270 };
const NEXT_MS = 400;

const element = (id) => document.getElementById(id);

/** Ask for the direction of each of the four triangles, in random order, until all are answered rightly in a row. */
export async function check() {
  const triangle = element("check-triangle"), said = element("check-said");
  let left = [];
  do {
    if (!left.length) left = shuffled(Object.keys(TURNS));
    const direction = left.pop();
    triangle.dataset.direction = direction;
    triangle.style.rotate = `${TURNS[direction]}deg`;
    if (await response() === direction) {
      said.textContent = "Correct";
    } else {
      said.textContent = `That one points ${direction}: away from its flat side. Four more.`;
      left = shuffled(Object.keys(TURNS));
    }
    await pause(NEXT_MS);
  } while (left.length);
  said.textContent = "";
}

function shuffled(names) {
  return names.map((name) => [Math.random(), name]).sort(([a], [b]) => a - b).map(([, name]) => name);
}

/** Wait for an arrow, of the keyboard or of the page. */
function response() {
  return new Promise((done) => {
    const ending = new AbortController();
    onArrow(element("check"), (direction) => { ending.abort(); done(direction); }, { signal: ending.signal });
  });
}
