// Numbers as text, and ticks of axes.

/** Return a number with up to four significant digits and no exponent within 1e-5 to 1e7, with a minus sign. */
export function plain(value) {
  if (value === null || value === undefined) return "";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-5 || size >= 1e7)) return withMinus(String(Number(value.toPrecision(4))));
  return withMinus(Number(value.toPrecision(4)).toLocaleString("en", { maximumFractionDigits: 20, useGrouping: false }));
}

/** Return a number with at most the digits that a field has room for; it keeps all of them. */
export const brief = (value) => String(typeof value === "number" ? Number(value.toPrecision(6)) : value);

const withMinus = (text) => text.replaceAll("-", "−");

/** Return the number in a text with a point or a comma; NaN if there is another thing in it. */
export function parsed(text) {
  const trimmed = text.trim().replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(trimmed) ? Number(trimmed) : Number.NaN;
}

const STEPS = [1, 1.5, 2, 3, 4, 5, 6, 8];
const LADDER = Array.from({ length: 26 }, (_, decade) => STEPS.map((step) => Number(`${step}e${decade - 13}`))).flat();

/** Return the nearest round numbers below a positive one and above another. */
export function enclosing(low, high) {
  return [LADDER.findLast((one) => one <= low) ?? LADDER.at(0), LADDER.find((one) => one >= high) ?? LADDER.at(-1)];
}

/** Return ticks of a logarithmic axis: 1, 2 and 5 of each decade, more of them over less than a decade. */
export function logTicks(low, high) {
  const span = high / low;
  const steps = span > 200 ? [1] : span > 30 ? [1, 2, 5] : span > 5 ? [1, 2, 3, 5] : STEPS;
  return LADDER.filter((one, at) => steps.includes(STEPS[at % STEPS.length]) && one >= low * 0.999 && one <= high * 1.001);
}
