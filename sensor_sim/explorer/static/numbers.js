// Numbers as text, and ticks of axes.

/** Return a number with up to four significant digits and no exponent within 1e-5 to 1e7, with a minus sign. */
export function plain(value) {
  if (value === null || value === undefined) return "";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-5 || size >= 1e7)) return withMinus(String(Number(value.toPrecision(4))));
  return withMinus(Number(value.toPrecision(4)).toLocaleString("en", { maximumFractionDigits: 20, useGrouping: false }));
}

const withMinus = (text) => text.replaceAll("-", "−");

/** Return two numbers as "low to high", with the decimals that three digits of their distance have. */
export function fromTo(low, high) {
  const decimals = Math.min(Math.max(2 - Math.floor(Math.log10(high - low || 1)), 0), 12);
  return withMinus(`${low.toFixed(decimals)} to ${high.toFixed(decimals)}`);
}

/** Return a value with as many decimals as the first digit of its error has. */
export function withError(value, error) {
  if (!(error > 0)) return plain(value);
  const decimals = Math.min(Math.max(-Math.floor(Math.log10(error)), 0), 12);
  return `${value.toFixed(decimals)} ± ${error.toFixed(decimals)}`;
}

/** Return a share as a percentage that is rounded up to one digit: 3 %, 0.2 %. */
export function percentAtMost(share) {
  const decade = 10 ** Math.floor(Math.log10(100 * share));
  return `${plain(Math.ceil((100 * share) / decade - 1e-9) * decade)} %`;
}

/** Return the number in a text with a point or a comma; NaN if there is another thing in it. */
export function parsed(text) {
  const trimmed = text.trim().replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(trimmed) ? Number(trimmed) : Number.NaN;
}

const STEPS = [1, 1.5, 2, 3, 4, 5, 6, 8];

/** Return the nearest round number at or below a positive one. */
export function roundDown(value) {
  const decade = 10 ** Math.floor(Math.log10(value) + 1e-9);
  return decade * STEPS.findLast((step) => step * decade <= value * (1 + 1e-9));
}

/** Return the nearest round number at or above a positive one. */
export function roundUp(value) {
  const decade = 10 ** Math.floor(Math.log10(value) + 1e-9);
  return decade * (STEPS.find((step) => step * decade >= value * (1 - 1e-9)) ?? 10);
}

/** Return ticks of a logarithmic axis: 1, 2 and 5 of each decade, more of them over less than a decade. */
export function logTicks(low, high) {
  const span = high / low;
  const steps = span > 200 ? [1] : span > 30 ? [1, 2, 5] : span > 5 ? [1, 2, 3, 5] : span > 2.5 ? STEPS : null;
  if (steps === null) return linearTicks(low, high);
  const ticks = [];
  for (let decade = Math.floor(Math.log10(low)) - 1; decade <= Math.log10(high) + 1; decade += 1) {
    for (const step of steps) {
      const tick = Number((step * 10 ** decade).toPrecision(3));
      if (tick >= low * 0.999 && tick <= high * 1.001) ticks.push(tick);
    }
  }
  return ticks;
}

/** Return three to seven round ticks of a linear axis. */
export function linearTicks(low, high) {
  const raw = (high - low) / 6;
  const decade = 10 ** Math.floor(Math.log10(raw));
  const step = decade * [1, 2, 5, 10].find((one) => one * decade >= raw * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: count }, (_, index) => Number(((first + index) * step).toPrecision(10)));
}
