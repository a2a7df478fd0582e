// The list of events: what is open first, then what has ended; each with its pictures, since when, and who saw it.

import { byId, el, facts, keyed, say, set, show } from "./dom.js";
import { Thumbnails } from "./pictures.js";
import { endedEvents, openEvents, store } from "./store.js";
import { kindWords, since } from "./verdict.js";
import { at, clock, count, list, nats, span } from "./words.js";

/** Ended ones that are listed; the service knows more. */
const ENDED_SHOWN = 30;

const END_REASONS = {
  seen_again: "as expected again",
  no_room: "given up: too many at once",
};

function make(redraw) {
  const item = el("li", { class: "event" });
  item.parts = {
    thumbnails: new Thumbnails(),
    title: el("h3"),
    when: el("p", { class: "when" }),
    facts: el("dl", { class: "facts" }),
  };
  const { parts } = item;
  item.append(
    el("div", { class: "thumbs" }, ...parts.thumbnails.nodes),
    el("div", { class: "event-words" }, parts.title, parts.when, parts.facts),
  );
  const point = (id) => {
    store.pointed = id;
    redraw();
  };
  item.addEventListener("pointerenter", () => point(item.dataset.id));
  item.addEventListener("pointerleave", () => point(null));
  return item;
}

function update(item, place, event) {
  const { parts } = item;
  item.dataset.id = event.id;
  set(item, "data-open", event.open);
  set(item, "data-kind", event.kind);
  parts.thumbnails.of(event);
  say(parts.title, event.open ? kindWords(event) : (END_REASONS[event.end_reason] ?? "over"));
  say(
    parts.when,
    event.open
      ? `since ${since(place, event)}`
      : `${clock(event.first_ms)}, for ${span(event.ended_ms - event.first_ms)}`,
  );
  facts(parts.facts, [
    ["Seen by", `${list(event.robots)}, ${count(event.sightings, "time")}`],
    event.kind === "change" && ["Strongest", nats(event.peak_surprise)],
    event.center && ["Where", at(event.center)],
  ]);
}

export function drawEvents(place, redraw) {
  const open = openEvents(place);
  const ended = endedEvents(place);
  keyed(
    byId("events"),
    [...open, ...ended.slice(0, ENDED_SHOWN)],
    (event) => event.id,
    () => make(redraw),
    (item, event) => update(item, place, event),
  );
  say(byId("events-count"), `${open.length} open · ${ended.length} ended`);
  const none = open.length + ended.length === 0;
  show(byId("events-none"), none);
  say(byId("events-none"), none ? "None yet. Something that looks different in several frames becomes one." : "");
}
