// What the page knows: places, cameras, events, and surprise over time, as the service told it. No document here.

/** Seconds of surprise that are kept of a camera; the service itself gives 15 minutes. */
const POINTS_MAX = 3_600;
const ENDED_MAX = 256;
const TRAIL_MAX = 60;
const TRAIL_STEP_M = 0.03;
/** A live camera that sent nothing for so long is worth a word. */
export const STALLED_MS = 5_000;
const REFUSED_LATELY_MS = 60_000;

export const store = {
  link: "connecting",
  /** When the service was last heard of, and when it is tried again; this machine's clock. */
  heard_ms: null,
  retry_ms: null,
  boot: null,
  version: null,
  /** Something was told about the places, be it that there are none. */
  told: false,
  info: null,
  /** Name to what is known of it. */
  places: new Map(),
  /** What was asked for: the names of a place and of the camera that is open. */
  wanted: { place: null, camera: null },
  /** The event that is pointed at. */
  pointed: null,
  /** Service's clock less this machine's. */
  ahead_ms: 0,
};

export const cameraKey = (camera) => `${camera.robot}/${camera.camera}`;

export const now = () => Date.now() + store.ahead_ms;

function placeOf(name) {
  let place = store.places.get(name);
  if (!place) {
    place = {
      name,
      cameras: new Map(),
      events: new Map(),
      points: new Map(),
      trails: new Map(),
      views: [],
      status: {},
    };
    store.places.set(name, place);
  }
  return place;
}

/** A new connection. True if the service is another one than before: nothing of what it told is true any more. */
export function hello({ boot, version, now_ms }) {
  const restarted = store.boot !== null && store.boot !== boot;
  const updated = store.version !== null && store.version !== version;
  store.boot = boot;
  store.version = version;
  store.ahead_ms = now_ms - Date.now();
  if (restarted) {
    store.places.clear();
    store.told = false;
  }
  return { restarted, updated };
}

export function takeState({ now_ms, places }) {
  if (now_ms) store.ahead_ms = now_ms - Date.now();
  store.heard_ms = Date.now();
  store.told = true;
  for (const place of places) takePlace(place);
}

export function takePlace({ cameras, place: name, ...status }) {
  const place = placeOf(name);
  place.status = status;
  for (const camera of cameras) {
    const key = cameraKey(camera);
    const before = place.cameras.get(key);
    const grew = before && refused(camera) > refused(before);
    camera.refused_grew_ms = grew ? now() : (before?.refused_grew_ms ?? null);
    place.cameras.set(key, camera);
    if (camera.last_stamp_ns === null) continue;
    const stamp_ms = camera.last_stamp_ns / 1e6;
    addPoint(place, key, Math.floor(stamp_ms / 1000), camera.max_surprise_since ?? camera.max_surprise);
    if (camera.pose) addToTrail(place, key, camera.pose.position);
  }
  // In order of their names, whatever order they were told in.
  place.cameras = new Map([...place.cameras].sort(([a], [b]) => a.localeCompare(b, "en", { numeric: true })));
}

function pointsOf(place, key) {
  if (!place.points.has(key)) place.points.set(key, []);
  return place.points.get(key);
}

function addPoint(place, key, t, value) {
  const points = pointsOf(place, key);
  const last = points.at(-1);
  if (last && last.t === t) last.value = Math.max(last.value, value);
  else if (!last || last.t < t) {
    points.push({ t, value });
    if (points.length > POINTS_MAX) points.shift();
  } else if (last.t - t > 10) {
    // The robot's clock was set back.
    place.points.set(key, [{ t, value }]);
  }
}

/** What the service remembers, and after it what came since. */
export function takeTimeline({ place: name, cameras }) {
  const place = placeOf(name);
  for (const camera of cameras) {
    const key = cameraKey(camera);
    const told = camera.points.map((point) => ({ t: point.t, value: point.max_surprise }));
    const end = told.at(-1)?.t ?? -Infinity;
    const start = told[0]?.t ?? Infinity;
    const held = pointsOf(place, key);
    const before = held.filter((point) => point.t < start);
    const after = held.filter((point) => point.t > end);
    place.points.set(key, [...before, ...told, ...after].slice(-POINTS_MAX));
  }
}

function addToTrail(place, key, position) {
  if (!place.trails.has(key)) place.trails.set(key, []);
  const trail = place.trails.get(key);
  const last = trail.at(-1);
  if (last && Math.hypot(...position.map((x, axis) => x - last[axis])) < TRAIL_STEP_M) return;
  trail.push(position);
  if (trail.length > TRAIL_MAX) trail.shift();
}

const vector = (v) => (v ? [v.x ?? 0, v.y ?? 0, v.z ?? 0] : null);

/** Of the service's message; times in ms of the robots' clocks. */
function asEvent(message) {
  const ended = message.state === "end";
  return {
    ...message,
    open: !ended,
    first_ms: Date.parse(message.first_seen),
    last_ms: Date.parse(message.last_seen),
    ended_ms: ended ? Date.parse(message.ended ?? message.last_seen) : null,
    center: vector(message.center_in_world),
    picture_path: `/api/v1/places/${message.place}/events/${message.id}`,
    picture_version: message.peak?.sequence ?? "0",
  };
}

/** What was known about the event before, or undefined. */
export function takeEvent(message) {
  const place = placeOf(message.place);
  const before = place.events.get(message.id);
  place.events.set(message.id, asEvent(message));
  const ended = [...place.events.values()].filter((event) => !event.open);
  if (ended.length > ENDED_MAX) place.events.delete(ended.sort((a, b) => a.ended_ms - b.ended_ms)[0].id);
  return before;
}

export function takeEvents(name, { events }) {
  placeOf(name).events = new Map(events.map((message) => [message.id, asEvent(message)]));
}

export function takeViews(name, { views }) {
  placeOf(name).views = views.map((view) => ({
    id: view.id,
    position: vector(view.world_from_camera.position) ?? [0, 0, 0],
    orientation: ["x", "y", "z", "w"].map((axis) => view.world_from_camera.orientation?.[axis] ?? 0),
  }));
}

/** The place that is shown. */
export function shownPlace() {
  const named = store.places.get(store.wanted.place);
  if (named) return named;
  return [...store.places.values()].sort((a, b) => b.cameras.size - a.cameras.size)[0] ?? null;
}

/** Of the camera that is open, if it is known. */
export function openCamera() {
  return store.wanted.camera === null ? null : (shownPlace()?.cameras.get(store.wanted.camera) ?? null);
}

export const lastFrame = (camera) => camera.last_frame_ms ?? null;

/** What the robots' clocks say now; a recording's are years behind. */
export function placeNow(place) {
  let latest = null;
  for (const camera of place.cameras.values()) {
    if (camera.last_stamp_ns === null) continue;
    const frame_ms = lastFrame(camera) ?? now();
    latest = Math.max(latest ?? -Infinity, camera.last_stamp_ns / 1e6 + Math.max(0, now() - frame_ms));
  }
  return latest ?? now();
}

/** `live`, `stalled` (there, but no frames), `refused` (frames, but none is taken), `gone`, or `unknown`. */
export function stateOf(camera) {
  if (store.link === "gone") return "unknown";
  const frame_ms = lastFrame(camera);
  const quiet = frame_ms === null || now() - frame_ms > STALLED_MS;
  if (!camera.live) return quiet ? "gone" : "live";
  if (!quiet) return "live";
  return camera.refused_grew_ms && now() - camera.refused_grew_ms < STALLED_MS ? "refused" : "stalled";
}

/** Whether a frame was refused lately. */
export const refusedLately = (camera) =>
  camera.refused_grew_ms !== null && now() - camera.refused_grew_ms < REFUSED_LATELY_MS;

export const dropped = (camera) => (camera.frames_replaced ?? 0) + (camera.frames_lost ?? 0);

export const refused = (camera) => Object.values(camera.refused ?? {}).reduce((sum, count) => sum + count, 0);

/** Open ones, the newest first; what looks different before what nobody has seen. */
export function openEvents(place) {
  const open = [...place.events.values()].filter((event) => event.open);
  const rank = (event) => (event.kind === "change" ? 0 : 1);
  return open.sort((a, b) => rank(a) - rank(b) || b.first_ms - a.first_ms);
}

export const endedEvents = (place) =>
  [...place.events.values()].filter((event) => !event.open).sort((a, b) => b.ended_ms - a.ended_ms);

/** Which of the tones for cameras, counted over the place. */
export const toneOf = (place, key) => [...place.cameras.keys()].indexOf(key) % 6;

export const threshold = () => store.info?.settings?.surprise_threshold ?? 6;
