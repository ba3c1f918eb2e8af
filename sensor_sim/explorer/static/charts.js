// The two charts: thresholds over size, and MTFs over frequency. Their colours are those of the style sheet.

import { enclosing, logTicks, plain } from "./numbers.js";

/** Widest band of an axis' labels, and the space above the highest one, in CSS pixels. */
const LABELS_PX = 56;
const LETTERS_PX = 12;

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** A chart that fills its element, follows its width and takes new colours when the scheme or the medium changes. */
class Chart {
  #host;
  #plot = null;
  #made = "";
  #data = null;
  #options = null;

  constructor(host) {
    this.#host = host;
    new ResizeObserver(() => this.#resize()).observe(host);
    for (const query of ["(prefers-color-scheme: dark)", "print"]) {
      matchMedia(query).addEventListener("change", () => this.#rebuild());
    }
  }

  /** Draw data. The chart is made anew only if `kind`, a text, differs from that of the last call. */
  draw(kind, options, data) {
    this.#options = options;
    this.#data = data;
    if (this.#plot !== null && kind === this.#made) {
      this.#plot.setData(data);
      return;
    }
    this.#made = kind;
    this.#rebuild();
  }

  #rebuild() {
    if (this.#options === null) return;
    this.#plot?.destroy();
    const { clientWidth: width, clientHeight: height } = this.#host;
    this.#plot = new uPlot({ ...this.#options(), width, height }, this.#data, this.#host);
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.#host;
    if (width && height) this.#plot?.setSize({ width, height });
  }
}

function axis(label, side, splits = {}) {
  const ink = colour("--muted");
  const thin = { stroke: colour("--line"), width: 1 };
  const isLeft = side === "left";
  return {
    label,
    labelFont: `${LETTERS_PX + 1}px system-ui, sans-serif`,
    labelSize: 22,
    font: `${LETTERS_PX}px system-ui, sans-serif`,
    size: isLeft ? LABELS_PX : 34,
    gap: 4,
    stroke: ink,
    grid: thin,
    ticks: { ...thin, size: 4 },
    values: (_, ticks) => ticks.map(plain),
    scale: isLeft ? "y" : "x",
    side: isLeft ? 3 : 2,
    ...splits,
  };
}

/** Ticks of a logarithmic axis; those of a linear one are chosen by uPlot. */
const LOG_TICKS = { splits: (plot, _, low, high) => logTicks(low, high), filter: (_, ticks) => ticks };

const COMMON = {
  legend: { show: false },
  cursor: { show: false },
  pxAlign: 0,
  padding: [14, 14, 0, 0],
};

/** Quantities of a threshold, with the keys of their errors. */
export const ERRORS = { snr: "snr_error", delta_t_mk: "delta_t_error_mk", contrast: "contrast_error" };

export const SIZES = { detectors: "size_detectors", mrad: "size_mrad" };
export const ABSCISSAE = {
  inverse: { detectors: "1 / size (1 / detectors)", mrad: "1 / size (1 / mrad)" },
  size: { detectors: "Size √area (detectors)", mrad: "Size √area (mrad)" },
};

/** Return the thresholds of one curve as they are drawn: abscissa, value with its error or null, and status. */
export function points(thresholds, view) {
  return thresholds.map((one) => {
    const size = one[SIZES[view.unit]];
    return {
      x: view.abscissa === "size" ? size : 1 / size,
      value: one[view.strength],
      error: one[ERRORS[view.strength]],
      status: one.status,
    };
  });
}

/** Return the columns of one curve, ordered by abscissa: abscissa, threshold, and the ends of its interval. */
function columns(thresholds, view) {
  const rows = points(thresholds, view).map(({ x, value, error }) => {
    const ends = value === null ? [null, null] : [Math.max(value - error, value / 10), value + error];
    return [x, value, ...ends];
  });
  rows.sort((a, b) => a[0] - b[0]);
  return [0, 1, 2, 3].map((column) => rows.map((row) => row[column]));
}

/** Curves of thresholds: pinned ones behind, the present one with its error band in front. */
export class CurveChart extends Chart {
  #drawn = { thresholds: [], pinned: [], view: null };

  /**
   * @param {object[]|null} thresholds Of the present curve.
   * @param {{number: number, thresholds: object[]}[]} pinned
   * @param {{strength: string, axis: string, abscissa: string, unit: string}} view
   */
  draw(thresholds, pinned, view) {
    this.#drawn = { thresholds: thresholds ?? [], pinned, view };
    const curves = [...pinned.map((pin) => columns(pin.thresholds, view)), columns(thresholds ?? [], view)];
    const data = curves.length > 1 ? uPlot.join(curves) : curves[0];
    const kind = JSON.stringify([view, pinned.map((pin) => pin.number)]);
    super.draw(kind, () => this.#options(pinned, view), data);
  }

  #options(pinned, view) {
    const series = [{}];
    const bands = [];
    const add = (stroke, fill, width, dash) => {
      const at = series.length;
      const points = { show: true, size: width > 2 ? 8 : 5, fill: width > 2 ? stroke : colour("--paper"), stroke };
      series.push({ stroke, width, dash, points });
      for (const _ of ["low", "high"]) series.push({ stroke: "transparent", width: 0, points: { show: false } });
      bands.push({ series: [at + 2, at + 1], fill });
    };
    for (const { number } of pinned) {
      const stroke = colour(`--pin-${number}`);
      add(stroke, `${stroke}22`, 1.4, [6, 4]);
    }
    const accent = colour("--accent");
    add(accent, `${accent}3d`, 2.2);
    return {
      ...COMMON,
      series,
      bands,
      axes: [
        axis(ABSCISSAE[view.abscissa][view.unit], "bottom"),
        axis(view.axis, "left", LOG_TICKS),
      ],
      scales: {
        x: { time: false, range: (_, low, high) => (high > 0 ? [0, 1.04 * high] : [0, 1]) },
        y: { distr: 3, range: (_, low, high) => logRange(low, high) },
      },
      hooks: { draw: [(plot) => this.#mark(plot)] },
    };
  }

  /** Mark the sizes that are never reached by crosses on the axis, and pinned curves by their numbers. */
  #mark(plot) {
    const { thresholds, pinned, view } = this.#drawn;
    const { ctx, bbox } = plot;
    const arm = 4 * devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = colour("--warning");
    ctx.lineWidth = 2 * devicePixelRatio;
    ctx.beginPath();
    for (const { x, status } of points(thresholds, view)) {
      if (status !== "never_reached") continue;
      const [at, y] = [plot.valToPos(x, "x", true), bbox.top + bbox.height];
      for (const side of [-1, 1]) {
        ctx.moveTo(at - arm, y - side * arm);
        ctx.lineTo(at + arm, y + side * arm);
      }
    }
    ctx.stroke();
    ctx.font = `600 ${LETTERS_PX * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    for (const { number, thresholds: ofPin } of pinned) {
      const first = points(ofPin, view).filter((one) => one.value !== null).sort((a, b) => a.x - b.x)[0];
      if (!first) continue;
      ctx.fillStyle = colour(`--pin-${number}`);
      ctx.fillText(String(number), plot.valToPos(first.x, "x", true) - 2 * arm, plot.valToPos(first.value, "y", true) + arm);
    }
    ctx.restore();
  }
}

/** Colours of tasks, by their names in the style sheet. */
const TASK_COLOURS = ["--accent", "--pin-1", "--pin-2", "--pin-3", "--pin-4", "--pin-5", "--pin-6"];

/** Probability of tasks against range, dotted where it is a bound, with 95 % bands. */
export class RangeChart extends Chart {
  #found = null;

  /** @param {object} found Answer of `/api/range`. */
  draw(found) {
    const curves = found.curves.slice(0, TASK_COLOURS.length);
    this.#found = { ...found, curves };
    const data = [curves[0]?.range_km ?? []];
    for (const { probability, low, high, is_bound } of curves) {
      const nothing = probability.map(() => null);
      data.push(probability.map((one, at) => (is_bound[at] ? null : one)), probability, low ?? nothing, high ?? nothing);
    }
    super.draw(JSON.stringify([found.axis, curves.map((one) => one.task)]), () => this.#options(), data);
  }

  #options() {
    const series = [{}];
    const bands = [];
    this.#found.curves.forEach((_, index) => {
      const stroke = colour(TASK_COLOURS[index]);
      const points = { show: false };
      const at = series.length;
      series.push({ stroke, width: 2.2, points }, { stroke, width: 1.2, dash: [2, 4], points });
      for (const _end of ["low", "high"]) series.push({ stroke: "transparent", width: 0, points });
      bands.push({ series: [at + 3, at + 2], fill: `${stroke}3d` });
    });
    const title = this.#found.axis;
    return {
      ...COMMON,
      series,
      bands,
      axes: [
        axis("Range (km)", "bottom"),
        axis(title[0].toUpperCase() + title.slice(1), "left"),
      ],
      scales: {
        x: { time: false, range: (_, low, high) => [0, high > 0 ? high : 1] },
        y: { range: () => [0, 1] },
      },
      // A line at each probability of which the table has the range.
      hooks: { drawClear: [(plot) => drawLines(plot, "y", this.#found.probabilities, "--muted", [6, 4])] },
    };
  }
}

/** Draw dashed lines across a plot, at places along x or y, in a colour of the style sheet. */
function drawLines(plot, scale, places, stroke, dash) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.strokeStyle = colour(stroke);
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash(dash.map((one) => one * devicePixelRatio));
  ctx.beginPath();
  for (const place of places) {
    const at = Math.round(plot.valToPos(place, scale, true)) + 0.5;
    ctx.moveTo(...(scale === "x" ? [at, bbox.top] : [bbox.left, at]));
    ctx.lineTo(...(scale === "x" ? [at, bbox.top + bbox.height] : [bbox.left + bbox.width, at]));
  }
  ctx.stroke();
  ctx.restore();
}

/** Return round ends of a logarithmic axis, so that it stands still while a curve moves a little. */
function logRange(low, high) {
  if (!(low > 0)) return [1, 10];
  const ends = enclosing(low / 1.05, high * 1.05);
  return ends[1] / ends[0] < 2 ? [ends[0] / 1.5, ends[1] * 1.5] : ends;
}

/** MTFs before and after sampling, with the Nyquist frequency. */
export class MtfChart extends Chart {
  #transfer = null;

  /** @param {object} transfer Answer of `/api/mtf`. */
  draw(transfer) {
    this.#transfer = transfer;
    const { frequency_cyc_per_mrad: frequency, presample, postsample } = transfer;
    super.draw("mtf", () => this.#options(), [frequency, presample, postsample]);
  }

  #options() {
    const ink = colour("--ink");
    return {
      ...COMMON,
      series: [
        {},
        { stroke: colour("--accent"), width: 2.2, points: { show: false } },
        { stroke: ink, width: 1.6, dash: [6, 4], points: { show: false } },
      ],
      axes: [axis("Spatial frequency (cycles/mrad)", "bottom"), axis("MTF", "left")],
      scales: {
        x: { time: false, range: () => [0, this.#transfer.end_cyc_per_mrad] },
        y: { range: (_, low) => [low < -0.005 ? Math.floor(10 * low) / 10 : 0, 1] },
      },
      hooks: {
        drawSeries: [(plot, index) => index === 2 && drawLines(plot, "x", [this.#transfer.nyquist_cyc_per_mrad], "--pin-3", [2, 3])],
      },
    };
  }
}
