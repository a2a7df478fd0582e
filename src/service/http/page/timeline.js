// Surprise over time: a line for each camera, the threshold, and the events below as bars from when to when.

import { byId, el, keyed, say, set, svg } from "./dom.js";
import { cameraKey, endedEvents, openEvents, placeNow, store, threshold, toneOf } from "./store.js";
import { kindWords } from "./verdict.js";
import { clock, count, nats, span } from "./words.js";

const LEFT = 54;
const RIGHT = 12;
const TOP = 12;
const CURVE = 150;
const AXIS = 24;
const LANE = 13;
const LANES_MAX = 5;
/** Nats at the top of the plot at least. */
const FULL = 20;
/** Seconds between two points that are joined. */
const GAP = 5;
const STEPS = [15, 30, 60, 120, 300, 600, 900, 1800];

let seconds = 600;
/** Where the pointer is, pixels; null beside the plot. */
let pointer = null;

export function setUp(redraw) {
  byId("history-span").addEventListener("change", (event) => {
    seconds = Number(event.target.value);
    redraw();
  });
  const plot = byId("history");
  plot.addEventListener("pointermove", (event) => {
    pointer = event.clientX - plot.getBoundingClientRect().left;
    redraw();
  });
  plot.addEventListener("pointerleave", () => {
    pointer = null;
    redraw();
  });
  new ResizeObserver(redraw).observe(plot.parentElement);
}

/** Points of a time window, thinned to one a pixel column: its maximum. */
function thinned(points, from, columns) {
  const width = seconds / columns;
  const thin = [];
  for (const { t, value } of points) {
    if (t < from) continue;
    const column = Math.floor((t - from) / width);
    const last = thin.at(-1);
    if (last && last.column === column) last.value = Math.max(last.value, value);
    else thin.push({ column, t, value });
  }
  return thin;
}

function path(points, x, y) {
  let d = "";
  let before = -Infinity;
  const gap = Math.max(GAP, (2 * seconds) / 300);
  for (const { t, value } of points) {
    d += `${t - before > gap ? "M" : "L"}${x(t).toFixed(1)} ${y(value).toFixed(1)}`;
    before = t;
  }
  return d;
}

/** The point at a time, if there is one. */
function nearest(points, t) {
  const far = (point) => Math.abs(point.t - t);
  const best = points.reduce((best, point) => (best && far(best) <= far(point) ? best : point), null);
  return best && far(best) <= Math.max(GAP, seconds / 100) ? best : null;
}

/** When something was not as expected, without overlaps; and the event that is pointed at. */
function changing(events) {
  const spans = [];
  for (const { event, from, to } of events) {
    if (event.kind !== "change") continue;
    const last = spans.at(-1);
    if (last && from <= last.to) last.to = Math.max(last.to, to);
    else spans.push({ from, to, pointed: false });
  }
  const pointed = events.find(({ event }) => event.id === store.pointed);
  return pointed ? [...spans, { ...pointed, pointed: true }] : spans;
}

/** Each event gets the first lane that is free when it begins. */
function lanes(events) {
  const ends = [];
  return events.map((event) => {
    let lane = ends.findIndex((end) => end <= event.from);
    if (lane < 0) lane = Math.min(ends.length, LANES_MAX - 1);
    ends[lane] = event.to;
    return { ...event, lane };
  });
}

export function drawTimeline(place) {
  const plot = byId("history");
  const width = Math.max(280, plot.parentElement.clientWidth);
  const now = placeNow(place) / 1000;
  const from = now - seconds;
  const x = (t) => LEFT + ((t - from) / seconds) * (width - LEFT - RIGHT);
  const series = [...place.cameras.values()].map((camera) => {
    const key = cameraKey(camera);
    const points = thinned(place.points.get(key) ?? [], from, width - LEFT - RIGHT);
    return { camera, key, points, tone: toneOf(place, key) };
  });
  const limit = threshold();
  const greatest = Math.max(FULL, ...series.flatMap(({ points }) => points.map((point) => point.value)));
  // Square roots: what is small can be told apart, what is large fits.
  const y = (value) => TOP + CURVE * (1 - Math.sqrt(Math.min(value, greatest) / greatest));

  const events = lanes(
    [...endedEvents(place), ...openEvents(place)]
      .map((event) => ({ event, from: event.first_ms / 1000, to: event.open ? now : event.ended_ms / 1000 }))
      .filter(({ to }) => to >= from)
      .sort((a, b) => a.from - b.from),
  );
  const rows = events.length ? Math.max(...events.map(({ lane }) => lane)) + 1 : 0;
  const floor = TOP + CURVE;
  const height = floor + AXIS + rows * LANE + (rows ? 6 : 0);
  set(plot, "viewBox", `0 0 ${width} ${height}`);
  set(plot, "width", width);
  set(plot, "height", height);

  const nodes = [];
  const step = STEPS.find((step) => (seconds / step) * 70 <= width - LEFT) ?? 3600;
  for (let t = Math.ceil(from / step) * step; t <= now; t += step) {
    if (x(t) < LEFT + 14) continue;
    nodes.push(svg("line", { class: "grid", x1: x(t), x2: x(t), y1: TOP, y2: floor }));
    if (x(t) < width - 22)
      nodes.push(
        svg("text", { class: "tick", x: x(t), y: floor + 16, "text-anchor": "middle" }, clock(t * 1000, step < 60)),
      );
  }
  const values = [0, ...[20, 50, 100, 200, 500, 1000].filter((value) => value <= greatest)].filter(
    (value, index, all) => value === 0 || index === all.length - 1 || y(value) - y(all[index + 1]) > 16,
  );
  for (const value of values) {
    nodes.push(
      svg("line", { class: value ? "grid" : "axis", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }),
    );
    nodes.push(svg("text", { class: "tick", x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, String(value)));
  }
  for (const { from: begin, to, pointed } of changing(events)) {
    const left = Math.max(LEFT, x(begin));
    const width = Math.max(1, x(to) - left);
    nodes.push(svg("rect", { class: "during", "data-pointed": pointed, x: left, y: TOP, width, height: CURVE }));
  }
  nodes.push(svg("line", { class: "limit", x1: LEFT, x2: width - RIGHT, y1: y(limit), y2: y(limit) }));
  nodes.push(
    svg("text", { class: "tick limit-word", x: LEFT - 8, y: y(limit) + 4, "text-anchor": "end" }, String(limit)),
  );
  for (const { points, tone } of series) {
    nodes.push(svg("path", { class: "curve", "data-tone": tone, d: path(points, x, y) }));
    const last = points.at(-1);
    if (last && now - last.t < GAP)
      nodes.push(svg("circle", { class: "tip", "data-tone": tone, cx: x(last.t), cy: y(last.value), r: 3 }));
  }
  for (const { event, from: begin, to, lane } of events) {
    const left = Math.max(LEFT, x(begin));
    const bar = svg(
      "rect",
      {
        class: "span",
        "data-kind": event.kind,
        "data-open": event.open,
        "data-pointed": store.pointed === event.id,
        x: left,
        y: floor + AXIS + lane * LANE,
        width: Math.max(4, x(to) - left),
        height: LANE - 5,
        rx: (LANE - 5) / 2,
      },
      svg(
        "title",
        {},
        `${kindWords(event)}, from ${clock(event.first_ms)}${event.open ? "" : ` to ${clock(event.ended_ms)}`}`,
      ),
    );
    nodes.push(bar);
  }
  if (rows)
    nodes.push(svg("text", { class: "tick", x: LEFT - 8, y: floor + AXIS + 7, "text-anchor": "end" }, "events"));
  const pointed =
    pointer !== null && pointer >= LEFT && pointer <= width - RIGHT
      ? from + ((pointer - LEFT) / (width - LEFT - RIGHT)) * seconds
      : null;
  if (pointed !== null) {
    nodes.push(svg("line", { class: "cursor", x1: pointer, x2: pointer, y1: TOP, y2: floor }));
    const left = pointer > width - 90;
    nodes.push(
      svg(
        "text",
        { class: "cursor-word", x: pointer + (left ? -6 : 6), y: TOP + 11, "text-anchor": left ? "end" : "start" },
        clock(pointed * 1000),
      ),
    );
  }
  plot.replaceChildren(...nodes);

  keyed(
    byId("history-legend"),
    series,
    ({ key }) => key,
    () => el("li", {}, el("span", { class: "swatch", "aria-hidden": "true" }), el("span")),
    (item, { camera, tone, points }) => {
      set(item, "data-tone", tone);
      const there = pointed === null ? null : nearest(points, pointed);
      say(item.lastElementChild, `${camera.robot} ${camera.camera}${there ? ` ${nats(there.value)}` : ""}`);
    },
  );
  const words = series.map(({ camera, points }) => {
    const most = points.reduce((most, point) => (point.value > most.value ? point : most), { value: 0, t: now });
    return `${camera.robot} ${camera.camera}: now ${nats(camera.max_surprise)}, at most ${nats(most.value)} at ${clock(most.t * 1000)}.`;
  });
  say(
    byId("history-words"),
    `The greatest surprise of each camera over the last ${span(1000 * seconds)}; above ${limit} nats it becomes a box. ${words.join(" ")} ${count(events.length, "event")} in that time.`,
  );
}
