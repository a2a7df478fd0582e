// Small help with the document: make nodes, change only what differs, keep lists by key.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) set(node, name, value);
  node.append(...children.filter((child) => child != null));
  return node;
}

/** Sets an attribute; null, undefined and false remove it. */
export function set(node, name, value) {
  if (value == null || value === false) node.removeAttribute(name);
  else if (node.getAttribute(name) !== String(value)) node.setAttribute(name, value === true ? "" : value);
}

export const el = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);

export const svg = (tag, attributes = {}, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);

export const byId = (id) => document.getElementById(id);

/** Text that is already there is left alone: nothing is drawn or read aloud again. */
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function show(node, shown) {
  if (node.hidden === shown) node.hidden = !shown;
}

/** Makes the children of `container` those of `items`, by key and in order; what stays keeps its node and its focus. */
export function keyed(container, items, key, make, update) {
  const old = new Map([...container.children].map((child) => [child.dataset.key, child]));
  let before = container.firstElementChild;
  for (const item of items) {
    const name = String(key(item));
    let child = old.get(name);
    if (child) old.delete(name);
    else {
      child = make(item);
      child.dataset.key = name;
    }
    if (child === before) before = before.nextElementSibling;
    else container.insertBefore(child, before);
    update(child, item);
  }
  for (const child of old.values()) child.remove();
}

/** Pairs of a term and its text as the rows of a `dl`. A tone makes a row stand out. */
export function facts(list, rows) {
  keyed(
    list,
    rows.filter((row) => row),
    ([term]) => term,
    ([term]) => el("div", {}, el("dt", {}, term), el("dd")),
    (row, [, text, tone]) => {
      say(row.lastElementChild, text);
      set(row, "data-tone", tone);
    },
  );
}
