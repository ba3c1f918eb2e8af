// Device pixels: whether the browser shows each pixel as it is, and canvases whose pixels are the monitor's.

/** Interval at which it is looked whether frames can be shown pixel by pixel. */
const LOOK_MS = 250;

/**
 * Return why frames cannot be shown pixel by pixel and what to do, or null if they can.
 *
 * @param {{ratio: ?number, width: number, height: number}} asked - the device pixel ratio that the monitor was measured
 *   with, if it was, and the size of a frame in device pixels.
 * @returns {?{reason: string, remedy: string}}
 */
export function trouble({ ratio, width, height }) {
  const now = window.devicePixelRatio;
  const reset = "Set the browser's zoom to 100 % (Ctrl and 0; on a Mac ⌘ and 0), and the system's scaling of the display to 100 % or 200 %.";
  if (!Number.isInteger(now)) {
    return {
      reason: `A pixel of this page takes ${Number(now.toFixed(3))} pixels of the monitor, so the browser would resample the frames.`,
      remedy: reset,
    };
  }
  if (Math.abs((window.visualViewport?.scale ?? 1) - 1) > 1e-3) {
    return { reason: "The page is magnified, so the browser would resample the frames.", remedy: "Pinch it back to its own size." };
  }
  if (ratio !== null && now !== ratio) {
    return {
      reason: `A pixel of this page took ${ratio} ${ratio === 1 ? "pixel" : "pixels"} of the monitor when you measured it, and takes ${now} now. Sizes would be others.`,
      remedy: "Set the browser's zoom back, and bring the window back to the monitor that you measured.",
    };
  }
  const room = [window.innerWidth * now, window.innerHeight * now];
  if (width > room[0] || height > room[1]) {
    return {
      reason: `A frame has ${width} × ${height} pixels, and this window has room for ${room[0]} × ${room[1]}.`,
      remedy: "Make the window larger, or show the browser full-screen (F11; on a Mac Ctrl, ⌘ and F).",
    };
  }
  return null;
}

/** Call a function when the window has changed, and again and again: not every zoom or monitor has an event. */
export function watchPixels(look) {
  window.addEventListener("resize", look);
  window.visualViewport?.addEventListener("resize", look);
  setInterval(look, LOOK_MS);
}

/**
 * Give a canvas a size in device pixels, and return its context. Code values are drawn as they are: without
 * transparency or smoothing, in the colour space of the page. The canvas is of one code value, and as much larger as
 * it takes to have whole pixels of the page, which browsers put on whole device pixels.
 */
export function exactCanvas(canvas, width, height, code) {
  const ratio = window.devicePixelRatio;
  for (const [name, side] of [["width", width], ["height", height]]) {
    const pagePixels = Math.ceil(side / ratio);
    canvas[name] = pagePixels * ratio;
    canvas.style[name] = `${pagePixels}px`;
  }
  const context = canvas.getContext("2d", { alpha: false, colorSpace: "srgb" });
  context.imageSmoothingEnabled = false;
  context.fillStyle = grey(code);
  context.fillRect(0, 0, canvas.width, canvas.height);
  return context;
}

/** Return a code value, 0 to 255, as a grey of CSS. */
export function grey(code) {
  return `rgb(${code}, ${code}, ${code})`;
}

/** Wait until what was drawn before is on the screen, and return that time as `performance.now()` counts. */
export function painted() {
  return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
}
