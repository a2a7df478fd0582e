// The place from above: viewpoints, robots, events; and the viewpoint that somebody asks the memory about.

import { byId, el, keyed, say, set, svg } from "./dom.js";
import { Plane } from "./geometry.js";
import { cameraAddress } from "./robots.js";
import { placePath, request } from "./service.js";
import { cameraKey, endedEvents, openEvents, placeNow, shownPlace, stateOf, store, toneOf } from "./store.js";
import { kindWords } from "./verdict.js";
import { clock, degrees, metres, percent } from "./words.js";

/** Around everything, metres, and the least that is shown. */
const MARGIN_M = 0.35;
const EXTENT_MIN_M = 1.5;
/** The extent grows in such steps, so that the map does not crawl. */
const EXTENT_STEP_M = 0.25;
const HEIGHT_PX = 400;
/** Pixels from which a press and a move is a turn. */
const DRAG_PX = 8;
/** How long an event that has ended stays on the map. */
const ENDED_SHOWN_MS = 10 * 60_000;
const MOVE_M = 0.05;
const TURN_RAD = Math.PI / 36;

const plot = byId("map");
const form = byId("prior");
const answer = byId("prior-answer");

let plane = null;
let extent = null;
/** Pixels from metres. */
let view = null;
/** Where the memory is asked: as [`Plane.stance`]; null until somebody points. */
let asked = null;
let asking = false;
let shownName = null;
let redraw = () => {};

const lensOf = (place) => [...place.cameras.values()].find((camera) => camera.intrinsics && camera.image) ?? null;

function stances(place) {
  return [...place.views, ...[...place.cameras.values()].filter((camera) => camera.pose).map((camera) => camera.pose)];
}

/** Half the angle that a camera sees, in the plane. */
const halfAngle = (camera) =>
  camera?.intrinsics ? Math.atan(camera.image.width / 2 / camera.intrinsics.fx) : Math.PI / 6;

function grow(points) {
  if (!points.length) return;
  const down = (value) => Math.floor((value - MARGIN_M) / EXTENT_STEP_M) * EXTENT_STEP_M;
  const up = (value) => Math.ceil((value + MARGIN_M) / EXTENT_STEP_M) * EXTENT_STEP_M;
  const all = {
    left: down(Math.min(...points.map((point) => point.right))),
    right: up(Math.max(...points.map((point) => point.right))),
    bottom: down(Math.min(...points.map((point) => point.top))),
    top: up(Math.max(...points.map((point) => point.top))),
  };
  extent = extent
    ? {
        left: Math.min(extent.left, all.left),
        right: Math.max(extent.right, all.right),
        bottom: Math.min(extent.bottom, all.bottom),
        top: Math.max(extent.top, all.top),
      }
    : all;
}

function fit(width, height) {
  const across = Math.max(EXTENT_MIN_M, extent.right - extent.left);
  const along = Math.max(EXTENT_MIN_M, extent.top - extent.bottom);
  const scale = Math.min(width / across, height / along);
  const middle = { right: (extent.left + extent.right) / 2, top: (extent.bottom + extent.top) / 2 };
  view = {
    scale,
    x: (right) => width / 2 + (right - middle.right) * scale,
    y: (top) => height / 2 - (top - middle.top) * scale,
    right: (x) => middle.right + (x - width / 2) / scale,
    top: (y) => middle.top - (y - height / 2) / scale,
    width,
    height,
  };
}

/** A camera as the wedge of what it sees. */
function wedge(stance, half, length) {
  const [x, y] = [view.x(stance.right), view.y(stance.top)];
  const end = (angle) => `${(x + length * Math.cos(angle)).toFixed(1)} ${(y - length * Math.sin(angle)).toFixed(1)}`;
  return `M${x.toFixed(1)} ${y.toFixed(1)}L${end(stance.heading + half)}A${length} ${length} 0 0 1 ${end(stance.heading - half)}Z`;
}

function grid() {
  const step = [0.25, 0.5, 1, 2, 5, 10, 20, 50].find((step) => step * view.scale >= 48) ?? 100;
  const nodes = [];
  for (let right = Math.ceil(view.right(0) / step) * step; right <= view.right(view.width); right += step) {
    nodes.push(svg("line", { class: "grid", x1: view.x(right), x2: view.x(right), y1: 0, y2: view.height }));
  }
  for (let top = Math.ceil(view.top(view.height) / step) * step; top <= view.top(0); top += step) {
    nodes.push(svg("line", { class: "grid", x1: 0, x2: view.width, y1: view.y(top), y2: view.y(top) }));
  }
  const [x, y] = [14, view.height - 14];
  const length = step * view.scale;
  nodes.push(svg("path", { class: "ruler", d: `M${x} ${y - 4}V${y}H${x + length}V${y - 4}` }));
  nodes.push(svg("text", { class: "tick", x: x + length / 2, y: y - 7, "text-anchor": "middle" }, `${step} m`));
  return nodes;
}

function viewpoints(place) {
  let d = "";
  for (const viewpoint of place.views) {
    const stance = plane.stance(viewpoint);
    const [x, y] = [view.x(stance.right), view.y(stance.top)];
    d += `M${x.toFixed(1)} ${y.toFixed(1)}l${(7 * Math.cos(stance.heading)).toFixed(1)} ${(-7 * Math.sin(stance.heading)).toFixed(1)}`;
  }
  return svg("path", { class: "viewpoints", d });
}

function robot(place, camera) {
  const key = cameraKey(camera);
  const tone = toneOf(place, key);
  const stance = plane.stance(camera.pose);
  const trail = (place.trails.get(key) ?? []).map((position) => plane.flat(position));
  const [x, y] = [view.x(stance.right), view.y(stance.top)];
  // The name stands behind the camera, where it does not look.
  const back = { x: x - 18 * Math.cos(stance.heading), y: y + 18 * Math.sin(stance.heading) + 4 };
  const anchor = Math.cos(stance.heading) > 0.5 ? "end" : Math.cos(stance.heading) < -0.5 ? "start" : "middle";
  return svg(
    "g",
    { class: "robot", "data-tone": tone, "data-state": stateOf(camera) },
    svg("polyline", {
      class: "trail",
      points: trail.map((point) => `${view.x(point.right).toFixed(1)},${view.y(point.top).toFixed(1)}`).join(" "),
    }),
    svg("path", { class: "wedge", d: wedge(stance, halfAngle(camera), 54) }),
    svg("circle", { cx: x, cy: y, r: 6 }),
    svg("text", { x: back.x, y: back.y, "text-anchor": anchor }, camera.robot),
  );
}

function marker(place, event) {
  const point = plane.flat(event.center);
  const [x, y] = [view.x(point.right), view.y(point.top)];
  const group = svg("g", {
    class: "mark",
    "data-open": event.open,
    "data-kind": event.kind,
    "data-pointed": store.pointed === event.id,
  });
  group.append(
    svg("circle", { class: "halo", cx: x, cy: y, r: event.open ? 13 : 7 }),
    svg("circle", { cx: x, cy: y, r: event.open ? 5 : 3 }),
  );
  if (event.open) {
    const label = svg("text", { x: x + 17, y: y + 4 }, clock(event.first_ms, false));
    if (x > view.width - 70) {
      set(label, "x", x - 17);
      set(label, "text-anchor", "end");
    }
    group.append(label);
  }
  group.append(svg("title", {}, `${kindWords(event)} since ${clock(event.first_ms)}`));
  return group;
}

function shownEvents(place) {
  const now = placeNow(place);
  const lately = endedEvents(place).filter((event) => now - event.ended_ms < ENDED_SHOWN_MS);
  return [...lately, ...openEvents(place)].filter((event) => event.center);
}

export function drawMap(place) {
  if (shownName !== place.name) {
    shownName = place.name;
    extent = asked = null;
    set(answer, "data-state", "none");
    say(byId("prior-words"), "");
  }
  const known = stances(place);
  if (!known.length) return;
  const next = Plane.of(known.map(({ orientation }) => orientation));
  if (!next.is(plane)) {
    plane = next;
    extent = null;
  }
  const events = shownEvents(place);
  grow([...known.map(({ position }) => plane.flat(position)), ...events.map((event) => plane.flat(event.center))]);
  const width = Math.max(240, plot.parentElement.clientWidth);
  fit(width, HEIGHT_PX);
  set(plot, "viewBox", `0 0 ${width} ${HEIGHT_PX}`);
  set(plot, "width", width);
  set(plot, "height", HEIGHT_PX);
  const cameras = [...place.cameras.values()].filter((camera) => camera.pose);
  const nodes = [
    ...grid(),
    viewpoints(place),
    ...cameras.map((camera) => robot(place, camera)),
    ...events.map((event) => marker(place, event)),
  ];
  if (asked) {
    const lens = halfAngle(lensOf(place));
    nodes.push(
      svg(
        "g",
        { class: "asked", "data-asking": asking },
        svg("path", { class: "wedge", d: wedge(asked, lens, 70) }),
        svg("circle", { cx: view.x(asked.right), cy: view.y(asked.top), r: 5 }),
      ),
    );
  }
  plot.replaceChildren(...nodes);
  for (const axis of ["right", "top"]) say(byId(`prior-${axis}`), plane.names[axis]);
  if (!asked) {
    const first = cameras[0] ?? place.views[0];
    write(plane.stance(first.pose ?? first));
  }
  table(place, cameras, events);
}

function table(place, cameras, events) {
  const row = (key, what, point, heading, href) => ({ key, what, href, cells: [...point.map(metres), heading] });
  const rows = [
    ...cameras.map((camera) =>
      row(
        cameraKey(camera),
        `${camera.robot} ${camera.camera}`,
        camera.pose.position,
        `${degrees(plane.stance(camera.pose).heading)}°`,
        cameraAddress(place.name, camera),
      ),
    ),
    ...events
      .reverse()
      .map((event) =>
        row(event.id, `${event.open ? kindWords(event) : "ended"}, since ${clock(event.first_ms)}`, event.center, ""),
      ),
  ];
  keyed(
    byId("map-table"),
    rows,
    ({ key }) => key,
    ({ href }) =>
      el(
        "tr",
        {},
        el("th", { scope: "row" }, href ? el("a", { href }) : el("span")),
        ...[0, 1, 2, 3].map(() => el("td")),
      ),
    (line, { what, cells }) => {
      say(line.firstElementChild.firstElementChild, what);
      cells.forEach((cell, index) => say(line.children[index + 1], cell));
    },
  );
}

const field = (name) => form.elements[name];

/** Into the fields, except the one that somebody is writing in. */
function write(stance) {
  const values = {
    right: stance.right.toFixed(2),
    top: stance.top.toFixed(2),
    height: stance.height.toFixed(2),
    heading: degrees(stance.heading),
    pitch: degrees(stance.pitch),
  };
  for (const [name, value] of Object.entries(values))
    if (document.activeElement !== field(name)) field(name).value = value;
}

function read() {
  const number = (name) => Number(field(name).value);
  return {
    right: number("right"),
    top: number("top"),
    height: number("height"),
    heading: (number("heading") * Math.PI) / 180,
    pitch: (number("pitch") * Math.PI) / 180,
  };
}

/** There, looking as the nearest viewpoint does: that is where the memory knows something. */
function standing(right, top) {
  const known = stances(shownPlace()).map((pose) => plane.stance(pose));
  const far = (stance) => Math.hypot(stance.right - right, stance.top - top);
  const nearest = known.reduce((best, stance) => (far(stance) < far(best) ? stance : best));
  return { ...nearest, right, top };
}

async function ask() {
  const place = shownPlace();
  const lens = place && lensOf(place);
  if (!lens || !asked) return;
  const [x, y, z] = plane.pose(asked).position;
  const [qx, qy, qz, qw] = plane.pose(asked).orientation;
  asking = true;
  say(byId("prior-words"), "asking");
  redraw();
  try {
    const response = await request(`${placePath(place.name)}/prior`, {
      method: "POST",
      json: {
        world_from_camera: { position: { x, y, z }, orientation: { x: qx, y: qy, z: qz, w: qw } },
        intrinsics: { ...lens.image, ...lens.intrinsics },
        planes: ["expected"],
      },
    });
    const { expected, covered } = await response.json();
    const file = Uint8Array.from(atob(expected.data), (letter) => letter.charCodeAt(0));
    const bitmap = await createImageBitmap(new Blob([file], { type: "image/png" }));
    const picture = byId("prior-picture");
    picture.width = bitmap.width;
    picture.height = bitmap.height;
    picture.parentElement.style.aspectRatio = `${bitmap.width} / ${bitmap.height}`;
    picture.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    const from = `from (${metres(asked.right)}, ${metres(asked.top)}) at ${metres(asked.height)} m, heading ${degrees(asked.heading)}°`;
    set(picture, "aria-label", `What the memory expects ${from}`);
    set(answer, "data-state", "answered");
    say(
      byId("prior-words"),
      covered > 0 ? `Expected ${from}. ${percent(covered)} of it is known.` : `Nothing is known ${from}.`,
    );
  } catch (trouble) {
    set(answer, "data-state", "refused");
    say(byId("prior-words"), `No answer: ${trouble.message}`);
  }
  asking = false;
  redraw();
}

function pointOf(event) {
  const box = plot.getBoundingClientRect();
  return [
    ((event.clientX - box.left) / box.width) * view.width,
    ((event.clientY - box.top) / box.height) * view.height,
  ];
}

export function setUp(onChange) {
  redraw = onChange;
  new ResizeObserver(redraw).observe(plot.parentElement);
  let pressed = null;
  plot.addEventListener("pointerdown", (event) => {
    if (!view || event.button !== 0) return;
    const [x, y] = pointOf(event);
    pressed = { x, y };
    plot.setPointerCapture(event.pointerId);
    asked = standing(view.right(x), view.top(y));
    write(asked);
    redraw();
  });
  plot.addEventListener("pointermove", (event) => {
    if (!pressed) return;
    const [x, y] = pointOf(event);
    if (Math.hypot(x - pressed.x, y - pressed.y) < DRAG_PX) return;
    asked.heading = Math.atan2(pressed.y - y, x - pressed.x);
    write(asked);
    redraw();
  });
  plot.addEventListener("pointerup", () => {
    if (!pressed) return;
    pressed = null;
    ask();
  });
  plot.addEventListener("pointercancel", () => (pressed = null));
  plot.addEventListener("keydown", (event) => {
    if (!view) return;
    if (event.key === "Enter") {
      asked ??= read();
      ask();
      return;
    }
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    asked ??= read();
    if (event.shiftKey) asked.heading -= TURN_RAD * (step[0] || -step[1]);
    else {
      asked.right += MOVE_M * step[0];
      asked.top += MOVE_M * step[1];
    }
    write(asked);
    redraw();
  });
  form.addEventListener("input", () => {
    asked = read();
    redraw();
  });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    asked = read();
    ask();
  });
}
