// Pinned curves: their numbers, how they differ from the drawn one, and their ratios to it.

import { SIZES } from "./charts.js";
import { byId, element } from "./elements.js";
import { brief, plain } from "./numbers.js";
import { valueOf } from "./state.js";

export const MOST_PINS = 6;

/** Return the pins with one more, which has the lowest free number. */
export function withPin(pins, { curve, state }) {
  const taken = new Set(pins.map((pin) => pin.number));
  const number = Array.from({ length: MOST_PINS }, (_, index) => index + 1).find((one) => !taken.has(one));
  return [...pins, { number, thresholds: curve.thresholds, state }].sort((a, b) => a.number - b.number);
}

/**
 * Show the list of pins.
 * @param {object[]} pins
 * @param {{curve: object, state: object}} drawn
 * @param {object[]} fields
 * @param {object} view
 * @param {(pin: object) => void} remove
 */
export function showPins(pins, drawn, fields, view, remove) {
  const items = pins.map((pin) => {
    const button = element("button", { type: "button", className: "remove", title: "Remove" }, "×");
    button.setAttribute("aria-label", `Remove pinned curve ${pin.number}`);
    button.addEventListener("click", () => remove(pin));
    const swatch = element("span", { className: `line pin-${pin.number}` });
    const text = `${pin.number} — ${difference(pin.state, drawn.state, fields)}; ${ratio(pin, drawn, view)}`;
    return element("li", {}, swatch, element("span", {}, text), button);
  });
  byId("pins").replaceChildren(...items);
}

/** Return how a state differs from the one that is drawn. */
export function difference(state, now, fields) {
  const differing = fields.filter(
    ({ key, kind }) => kind !== "switch" && JSON.stringify(valueOf(state, key)) !== JSON.stringify(valueOf(now, key)),
  );
  const texts = differing.map(({ key, label, group, unit }) => {
    const value = valueOf(state, key);
    const text = (value ?? null) === null ? "none" : Array.isArray(value) ? value.join(", ") : brief(value);
    return `${group.toLowerCase()}: ${label.toLowerCase()} ${text} ${unit ?? ""}`.trim();
  });
  const name = state.sensor.name === now.sensor.name ? [] : [state.sensor.name];
  if (!texts.length) return [...name, "as now"].join("; ");
  const more = texts.length > 3 ? [`and ${texts.length - 3} more`] : [];
  return [...name, ...texts.slice(0, 3), ...more].join("; ");
}

/** Return the ratio of pinned to drawn thresholds in words: its mean over the sizes of both, and its range. */
export function ratio(pin, { curve }, { strength, unit }) {
  const size = SIZES[unit];
  const found = curve.thresholds
    .filter((one) => one[strength] !== null)
    .map((one) => interpolated(pin.thresholds, size, strength, one[size]) / one[strength])
    .filter((one) => one > 0);
  if (!found.length) return "no size in common";
  const mean = Math.exp(found.reduce((sum, one) => sum + Math.log(one), 0) / found.length);
  const [text, low, high] = [mean, Math.min(...found), Math.max(...found)].map((one) => plain(Number(one.toPrecision(3))));
  return `thresholds ${text} × those now${low === high ? "" : ` (${low} to ${high})`}`;
}

/** Return the threshold at a size, on straight lines through logarithms; NaN beyond the sizes with a threshold. */
function interpolated(thresholds, size, strength, at) {
  const rows = thresholds.filter((one) => one[strength] !== null).map((one) => [Math.log(one[size]), Math.log(one[strength])]);
  rows.sort((a, b) => a[0] - b[0]);
  const x = Math.log(at);
  const exact = rows.find((row) => Math.abs(row[0] - x) < 1e-9);
  if (exact) return Math.exp(exact[1]);
  const above = rows.findIndex((row) => row[0] > x);
  if (above < 1) return Number.NaN;
  const [[x0, y0], [x1, y1]] = [rows[above - 1], rows[above]];
  return Math.exp(y0 + ((x - x0) / (x1 - x0)) * (y1 - y0));
}
