// The page: what the service tells goes to the store, and what the store holds is drawn, at most once a screen frame.

import { drawCamera } from "./camera.js";
import { byId, el, keyed, say, set, show } from "./dom.js";
import { drawEvents } from "./events.js";
import { drawMap, setUp as setUpMap } from "./map.js";
import { noteBoxes } from "./pictures.js";
import { drawRobots } from "./robots.js";
import { Link, get, placePath, signIn } from "./service.js";
import * as known from "./store.js";
import { store } from "./store.js";
import { drawTimeline, setUp as setUpTimeline } from "./timeline.js";
import { drawVerdict } from "./verdict.js";
import { bytes, clock, count, list, nats, span } from "./words.js";

/** Viewpoints change slowly and are many. */
const VIEWS_EVERY_MS = 5_000;
/** The slower parts of the page. */
const SLOW_MS = 500;

// ------------------------------------------------------------------------------------------------ drawing

let asked = false;
let slow_ms = 0;

function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    draw();
  });
}

/** Also the timeline and the map, which are drawn more seldom by themselves. */
function redrawAll() {
  slow_ms = 0;
  redraw();
}

function draw() {
  drawLink();
  drawPlaces();
  const place = known.shownPlace();
  // Before the first word from the service nothing is known, not even that there is nothing.
  show(byId("empty"), !place && store.told && store.link !== "locked");
  show(byId("board"), place !== null && store.link !== "locked");
  drawEmpty();
  drawTitle(place);
  if (!place || store.link === "locked") return;
  drawVerdict(place);
  drawRobots(place);
  drawCamera();
  drawEvents(place, redrawAll);
  if (Date.now() - slow_ms >= SLOW_MS) {
    slow_ms = Date.now();
    drawTimeline(place);
    drawMap(place);
  }
  drawAbout(place);
}

function drawTitle(place) {
  const open = place ? known.openEvents(place).length : 0;
  const title =
    store.link === "gone"
      ? "gone – surprised"
      : open
        ? `(${open}) ${place.name} – surprised`
        : place
          ? `${place.name} – surprised`
          : "surprised";
  if (document.title !== title) document.title = title;
  say(byId("title"), place ? `Surprise in ${place.name}` : "Surprise");
}

const LINK_WORDS = {
  connecting: "connecting",
  live: "live",
  polling: "live, asking",
  locked: "locked",
  gone: "no answer",
};

function drawLink() {
  const link = byId("link");
  set(link, "data-state", store.link);
  say(link.lastElementChild, LINK_WORDS[store.link]);
  show(byId("token"), store.link === "locked");
  const gone = store.link === "gone";
  show(byId("gone"), gone);
  set(document.body, "data-link", store.link);
  if (!gone) return;
  const heard = store.heard_ms;
  say(
    byId("gone-text"),
    heard === null
      ? "It has not answered since this page was opened."
      : `It was last heard of at ${clock(heard)}, ${span(Date.now() - heard)} ago. What is shown below is from then.`,
  );
  say(byId("gone-hint"), "See whether it still runs on its machine, or start it there:");
  say(byId("gone-command"), `surprised serve --http ${location.host}`);
  const wait = Math.max(0, Math.ceil((store.retry_ms - Date.now()) / 1000));
  say(byId("gone-retry"), wait ? `Tried again in ${wait} s, for as long as it takes.` : "Trying.");
}

function drawPlaces() {
  const names = [...store.places.keys()].sort();
  const shown = known.shownPlace()?.name;
  show(byId("places"), names.length > 0);
  keyed(
    byId("places"),
    names,
    (name) => name,
    (name) =>
      el(
        "a",
        { href: `#/${name}` },
        el("span"),
        el("span", { class: "open", "aria-hidden": "true" }),
        el("span", { class: "hidden" }),
      ),
    (link, name) => {
      const open = known.openEvents(store.places.get(name)).length;
      const [title, badge, words] = link.children;
      say(title, name);
      show(badge, open > 0);
      say(badge, String(open));
      say(words, open ? `, ${count(open, "open event")}` : "");
      set(link, "aria-current", name === shown ? "page" : null);
    },
  );
}

function drawEmpty() {
  const locators = store.info?.zenoh?.locators ?? [];
  const endpoint = locators.find((locator) => locator.includes("127.0.0.1")) ?? locators[0];
  say(byId("empty-key"), `${store.info?.root ?? "surprised"}/<place>/<robot>/<camera>/frame`);
  say(byId("empty-command"), endpoint ? `surprised simulate -e ${endpoint}` : "surprised demo");
  say(byId("empty-endpoint"), endpoint ?? "the service's router");
}

function drawAbout({ status }) {
  const parts = [`surprised ${store.version ?? ""}`, count(status.viewpoints ?? 0, "viewpoint")];
  if (status.memory_bytes_max) parts.push(`${bytes(status.memory_bytes)} of ${bytes(status.memory_bytes_max)} memory`);
  if (status.engine) parts.push(`on the ${status.engine}`);
  say(byId("about"), parts.join(" · "));
}

// ------------------------------------------------------------------------------------------------ what comes

let announced = "";

/** Read aloud when whoever listens has heard what went before. */
function announce(text) {
  if (text === announced) return;
  announced = text;
  say(byId("announce"), text);
}

const failed = (trouble) => console.warn(trouble.message);

function fetchEvents(place) {
  return get(`${placePath(place)}/events`)
    .then((reply) => known.takeEvents(place, reply), failed)
    .then(redrawAll);
}

function fetchTimeline(place) {
  return get(`${placePath(place)}/timeline`)
    .then(known.takeTimeline, failed)
    .then(redrawAll);
}

function fetchViews(place) {
  return get(`${placePath(place)}/views`)
    .then((reply) => known.takeViews(place, reply), failed)
    .then(redrawAll);
}

/** What the stream does not repeat. */
function fetchPast(place) {
  fetchEvents(place);
  fetchTimeline(place);
}

const on = {
  link(state, retry_ms = null) {
    if (state !== store.link) {
      if (state === "gone") announce("The service does not answer.");
      else if (store.link === "gone") announce("The service is back.");
    }
    store.link = state;
    store.retry_ms = retry_ms;
    if (state === "live" || state === "polling") store.heard_ms = Date.now();
    redraw();
  },
  hello(message) {
    const { updated } = known.hello(message);
    // Another version has another page.
    if (updated) location.reload();
    Promise.all([get("/api/v1/info"), get("/api/v1/places")])
      .then(([info]) => {
        store.info = info;
        // The stream says nothing where there is nothing.
        store.told = true;
      }, failed)
      .then(redraw);
    if (!message.resumed) for (const place of store.places.keys()) fetchPast(place);
    redraw();
  },
  state(message) {
    const fresh = message.places.filter(({ place }) => !store.places.has(place));
    known.takeState(message);
    for (const { place, cameras } of message.places) for (const camera of cameras) noteBoxes(place, camera);
    for (const { place } of fresh) {
      fetchPast(place);
      fetchViews(place);
    }
    redraw();
  },
  event(message) {
    const before = known.takeEvent(message);
    const who = list(message.robots);
    if (!before && message.state !== "end")
      announce(`${who}: something unexpected in ${message.place}, ${nats(message.peak_surprise)}.`);
    else if (message.state === "end" && before?.open)
      announce(`In ${message.place} all is as expected again where ${who} saw something.`);
    redraw();
  },
  reset() {
    for (const place of store.places.keys()) fetchPast(place);
  },
  async poll() {
    try {
      store.info = await get("/api/v1/info");
      const { places } = await get("/api/v1/places");
      const statuses = await Promise.all(places.map((place) => get(placePath(place))));
      on.state({ places: statuses });
      store.version ??= store.info.version;
      for (const place of places) fetchEvents(place);
    } catch (trouble) {
      failed(trouble);
    }
    redraw();
  },
};

// ------------------------------------------------------------------------------------------------ what people do

function follow() {
  const [place, robot, camera] = location.hash.replace(/^#\/?/, "").split("/");
  store.wanted.place = place || null;
  store.wanted.camera = robot && camera ? `${robot}/${camera}` : null;
  redrawAll();
}

document.addEventListener("click", async ({ target }) => {
  if (!target.matches("button.copy")) return;
  const text = target.previousElementSibling.textContent;
  try {
    await navigator.clipboard.writeText(text);
    say(target, "Copied");
  } catch {
    // Not allowed here: selected, it can be copied by hand.
    getSelection().selectAllChildren(target.previousElementSibling);
    say(target, "Selected");
  }
  setTimeout(() => say(target, "Copy"), 2_000);
});

byId("token-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const input = byId("token-input");
  try {
    await signIn(input.value);
    input.value = "";
    show(byId("token-wrong"), false);
    link.now();
  } catch (trouble) {
    say(byId("token-wrong"), trouble.status === 401 ? "That token is not the right one." : trouble.message);
    show(byId("token-wrong"), true);
    input.select();
  }
});

byId("retry").addEventListener("click", () => link.now());
window.addEventListener("hashchange", follow);

setUpTimeline(redrawAll);
setUpMap(redrawAll);
follow();
const link = new Link(on);

// Ages grow although nothing comes.
setInterval(() => {
  if (!document.hidden) redraw();
}, 500);
let map_shown = false;
new IntersectionObserver(([entry]) => (map_shown = entry.isIntersecting)).observe(byId("map"));
setInterval(() => {
  const place = known.shownPlace();
  if (place && map_shown && !document.hidden && store.link !== "gone" && store.link !== "locked")
    fetchViews(place.name);
}, VIEWS_EVERY_MS);
