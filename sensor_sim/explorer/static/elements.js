// Small helpers for elements. Text goes in as text, never as HTML.

/** Return the element of an id. */
export const byId = (id) => document.getElementById(id);

/** Return a new element with properties, such as `className`, and children: elements or texts. */
export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

/**
 * Fill a table.
 * @param {HTMLTableElement} table
 * @param {string} caption
 * @param {string[]} headers
 * @param {string[][]} rows The first cell of each row is its header.
 */
export function fillTable(table, caption, headers, rows) {
  const head = element("tr", {}, ...headers.map((text) => element("th", { scope: "col", className: "number" }, text)));
  const body = rows.map(([first, ...cells]) =>
    element(
      "tr",
      {},
      element("th", { scope: "row", className: "number" }, first),
      ...cells.map((text) => element("td", { className: "number" }, text)),
    ),
  );
  table.replaceChildren(
    element("caption", {}, caption),
    element("thead", {}, head),
    element("tbody", {}, ...body),
  );
}
