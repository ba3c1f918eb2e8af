// Range in the field: the probability to do a task against range, for the curve that is drawn.

import { ERRORS, RangeChart } from "./charts.js";
import { byId, element, fillTable } from "./elements.js";
import { Newest } from "./live.js";
import { plain } from "./numbers.js";
import { post } from "./server.js";

/** Time for which the range may be that of an earlier curve before it is greyed. */
const STALE_DELAY_MS = 400;

/** The second plot, with its ranges in words and as a table. */
export class RangeView {
  #chart = new RangeChart(byId("range-chart"));
  #requests = new Newest((record) => this.#fetch(record));
  #timer = null;
  /** What the ranges were asked with that are shown; null before the first. */
  body = null;

  constructor() {
    byId("range").hidden = false;
  }

  /** Show the range of a record whose curve is drawn; that of an earlier one is greyed after a while. */
  show(record) {
    this.#timer ??= setTimeout(() => byId("range").classList.add("earlier"), STALE_DELAY_MS);
    this.#requests.ask({ ...record }); // the record's curve may be another one when it is its turn
  }

  async #fetch({ id, state: { sensor, p_correct }, curve }) {
    await this.#shown(sensor, p_correct, curve);
    clearTimeout(this.#timer);
    this.#timer = null;
    byId("range").classList.remove("earlier");
    byId("range").dataset.sequence = id;
  }

  async #shown(sensor, p_correct, curve) {
    const thresholds = curve.thresholds.map(({ size_detectors, status, points, slope, ...one }) => {
      return { size_detectors, status, threshold: one[curve.level], error: one[ERRORS[curve.level]], points, slope };
    });
    const body = { sensor, p_correct, level: curve.level, thresholds };
    try {
      this.#draw(await post("/api/range", body), curve.is_last);
      this.body = body;
    } catch (failure) {
      this.#refuse(failure.message);
    }
  }

  #draw(found, isLast) {
    byId("range-error").hidden = true;
    byId("range").classList.remove("refused");
    byId("range-about").textContent = found.title;
    this.#chart.draw(found);
    const tasks = found.curves.map(({ task }, index) => pair(`task-${index}`, task));
    const isCut = found.curves.some(({ is_bound }) => is_bound.includes(true));
    byId("range-key").replaceChildren(...tasks, ...(isCut ? [pair("bound", "a bound: the curve ends there")] : []));
    const warnings = found.warnings.map((text) => `${text[0].toUpperCase()}${text.slice(1)}.`);
    byId("range-sentences").replaceChildren(
      ...[...found.sentences, ...warnings].map((text) => element("li", {}, text)),
    );
    const isDone = isLast ? "refined" : "estimated";
    fillTable(
      byId("range-table"),
      `Ranges, ${isDone}; the 95 % intervals follow from the errors of the curve`,
      ["Task", found.criterion, found.axis, "Range"],
      found.ranges.map((one) => [one.task, plain(one.criterion), plain(one.probability), one.words]),
    );
    byId("range").dataset.stage = isDone;
    byId("range-announcement").textContent = isLast ? found.sentences[0] : "";
  }

  #refuse(line) {
    byId("range-error").textContent = `No range. ${line}`;
    byId("range-error").hidden = false;
    byId("range").classList.add("refused");
    byId("range").dataset.stage = "refused";
    byId("range-announcement").textContent = "";
  }
}

/** Return a line of the plot and what it is. */
const pair = (name, text) => element("span", {}, element("span", { className: `line ${name}` }), text);
