// What the page gives as files: text, plots and tables.

import { ABSCISSAE, points } from "./charts.js";
import { element } from "./elements.js";
import { post } from "./server.js";

const TYPES = { csv: "text/csv", png: "image/png", svg: "image/svg+xml", toml: "application/toml" };

/** Have the browser write a file. */
export function download(name, content) {
  const address = URL.createObjectURL(new Blob([content], { type: TYPES[name.split(".").at(-1)] }));
  element("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

/** Write a plot that the server draws. */
export async function downloadPlot(path, body) {
  const { file, base64 } = await post(path, body);
  download(file, Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)));
}

/** Return what the server draws of curves: pinned ones by their numbers, and the drawn one, whose number is 0. */
export function plotOf(pins, { curve, state }, view, format) {
  const named = [
    ...pins.map(({ number, state: { sensor }, thresholds }) => ({ number, label: `${number}: ${sensor.name}`, thresholds })),
    { number: 0, label: state.sensor.name, thresholds: curve.thresholds },
  ];
  const curves = named.map(({ number, label, thresholds }) => {
    const rows = points(thresholds, view).filter((one) => one.value !== null);
    return { number, label, x: rows.map((one) => one.x), y: rows.map((one) => one.value), error: rows.map((one) => one.error) };
  });
  const never = points(curve.thresholds, view).filter((one) => one.status === "never_reached");
  return {
    format,
    title: "TOD curve",
    x_label: ABSCISSAE[view.abscissa][view.unit],
    y_label: view.axis,
    curves,
    never_reached: never.map((one) => one.x),
  };
}

/** Return the thresholds of the drawn curve, and of those that are pinned, as CSV with all digits, without lists. */
export function csvOf(pins, { curve }) {
  const keys = Object.keys(curve.thresholds[0]).filter((key) => !Array.isArray(curve.thresholds[0][key]));
  const rows = [["now", curve.thresholds], ...pins.map((pin) => [pin.number, pin.thresholds])].flatMap(
    ([name, thresholds]) => thresholds.map((one) => [name, ...keys.map((key) => one[key] ?? "")].join(",")),
  );
  return [["curve", ...keys].join(","), ...rows, ""].join("\n");
}
