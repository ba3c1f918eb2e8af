// One trial, from the scene to the display. Until it is asked for, the orientation and the stages that show it are hidden.

import { byId, element, fillTable } from "./elements.js";
import { Newest } from "./live.js";
import { parsed } from "./numbers.js";
import { post } from "./server.js";
import { countsPhotons } from "./state.js";

/** Stage that is shown before the answer: the display's picture, which is all that an observer has. */
const SHOWN = "g_display";

/** The trial's form, answer and pictures. */
export class Trial {
  #state = null;
  #thresholds = [];
  #seed = 1;
  #stages = [];
  #isRevealed = false;
  #asked = null;
  #isLevelChosen = false;
  #requests = new Newest((body) => this.#fetch(body));

  constructor() {
    byId("trial-form").addEventListener("submit", (event) => event.preventDefault());
    byId("trial-size").addEventListener("change", () => this.#draw());
    byId("trial-level").addEventListener("change", () => {
      this.#isLevelChosen = true;
      this.#draw();
    });
    byId("at-threshold").addEventListener("click", () => {
      this.#isLevelChosen = false;
      this.#draw();
    });
    byId("next-trial").addEventListener("click", () => {
      this.#seed += 1;
      this.#draw();
    });
    for (const button of byId("answers").querySelectorAll("button")) {
      button.addEventListener("click", () => this.#answer(button.value));
    }
  }

  /** Draw a trial of a state, whose thresholds are known. */
  show(state, thresholds) {
    const before = this.#state;
    this.#state = state;
    this.#thresholds = thresholds;
    byId("trial-level-name").textContent = this.#level === "snr" ? "SNR" : "Contrast";
    // A number that was chosen for the other quantity means nothing.
    if (before && countsPhotons(before.sensor) !== countsPhotons(state.sensor)) this.#isLevelChosen = false;
    const sizes = state.sizes_detectors;
    if (byId("trial-size").value === "") byId("trial-size").value = sizes[Math.floor(sizes.length / 2)];
    this.#draw();
  }

  #draw() {
    if (this.#state === null) return;
    const size = parsed(byId("trial-size").value);
    if (!this.#isLevelChosen) byId("trial-level").value = String(this.#thresholdNear(size));
    const level = parsed(byId("trial-level").value);
    if (!(size > 0 && level > 0)) {
      this.#fail(new Error(`Expected a size and ${this.#level === "snr" ? "an SNR" : "a contrast"} above 0.`));
      return;
    }
    this.#requests.ask({ sensor: this.#state.sensor, size_detectors: size, level, seed: this.#seed });
  }

  /** The quantity that is the strength of a triangle. */
  get #level() {
    return countsPhotons(this.#state.sensor) ? "contrast" : "snr";
  }

  /** Return the threshold of the size that is nearest among those of the curve; 5 if none has one. */
  #thresholdNear(size) {
    const level = this.#level;
    const known = this.#thresholds.filter((one) => one[level] !== null);
    known.sort((a, b) => Math.abs(Math.log(a.size_detectors / size)) - Math.abs(Math.log(b.size_detectors / size)));
    return known.length ? Number(known[0][level].toPrecision(3)) : 5;
  }

  async #fetch(body) {
    try {
      const { stages } = await post("/api/stages", body);
      byId("trial-error").hidden = true;
      this.#stages = stages;
      this.#asked = body;
      this.#hide();
    } catch (error) {
      this.#fail(error);
    }
  }

  #fail(error) {
    byId("trial-error").textContent = error.message;
    byId("trial-error").hidden = false;
  }

  #hide() {
    this.#isRevealed = false;
    byId("verdict").textContent = "";
    for (const button of byId("answers").querySelectorAll("button")) button.disabled = false;
    this.#picture();
  }

  async #answer(guess) {
    const asked = this.#asked;
    try {
      const { orientation } = await post("/api/orientation", asked);
      if (asked !== this.#asked) return;
      const verdict = guess === "" ? "It" : guess === orientation ? "Correct: it" : "Wrong: it";
      byId("verdict").textContent = `${verdict} points ${orientation}.`;
      for (const button of byId("answers").querySelectorAll("button")) button.disabled = true;
      this.#isRevealed = true;
      this.#picture();
    } catch (error) {
      this.#fail(error);
    }
  }

  #picture() {
    const shown = this.#stages.filter((stage) => this.#isRevealed || stage.name === SHOWN);
    byId("stages").classList.toggle("alone", !this.#isRevealed);
    byId("stages").replaceChildren(...shown.map((stage) => figure(stage)));
    const rows = shown.map(({ caption, width, height, range }) => [caption, `${width} × ${height}`, range]);
    fillTable(byId("stages-table"), "Stages of the trial", ["Stage", "Pixels", "Black to white"], rows);
  }
}

function figure({ name, caption, width, height, pixels }) {
  const canvas = element("canvas", { width, height });
  canvas.dataset.stage = name;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${caption}: grey picture of ${width} × ${height} pixels`);
  const codes = Uint8Array.from(atob(pixels), (letter) => letter.charCodeAt(0));
  const image = new ImageData(width, height);
  codes.forEach((code, index) => image.data.set([code, code, code, 255], 4 * index));
  canvas.getContext("2d").putImageData(image, 0, 0);
  return element("figure", {}, canvas, element("figcaption", {}, caption));
}
