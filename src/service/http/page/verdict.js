// The one look at 3 a.m.: which robot, what it expected, what it saw, since when. Or that all is well; or what is wrong.

import { byId, el, facts, keyed, say, set, show } from "./dom.js";
import { Thumbnails } from "./pictures.js";
import { cameraAddress, stateWords } from "./robots.js";
import { endedEvents, openEvents, placeNow, stateOf, store } from "./store.js";
import { at, clock, list, nats, span } from "./words.js";

/** Coverage below which a camera is still getting to know its place. */
const KNOWN = 0.5;
const TROUBLES_MAX = 6;

export const since = (place, event) => `${clock(event.first_ms)}, ${span(placeNow(place) - event.first_ms)}`;

export const kindWords = (event) => (event.kind === "unseen" ? "never seen before" : "not as expected");

let thumbnails = null;

/** Cameras that do not do what they should, in words. */
function troubles(cameras) {
  const wrong = cameras.filter((camera) => stateOf(camera) !== "live");
  const lines = wrong
    .slice(0, TROUBLES_MAX)
    .map((camera) => `${camera.robot} ${camera.camera}: ${stateWords(camera).words}`);
  return wrong.length > TROUBLES_MAX ? [...lines, `and ${wrong.length - TROUBLES_MAX} more`] : lines;
}

function judge(place) {
  const cameras = [...place.cameras.values()];
  const open = openEvents(place);
  const live = cameras.filter((camera) => stateOf(camera) === "live");
  const trouble = store.link === "gone" ? [] : troubles(cameras);
  const learning = live.length > 0 && live.every((camera) => camera.coverage < KNOWN);
  // What nobody has seen is everything at first.
  if (open.length && !(learning && open[0].kind === "unseen")) {
    const event = open[0];
    const who = list(event.robots);
    const sees = event.robots.length > 1 ? "see" : "sees";
    const others = open.length - 1;
    return {
      tone: event.kind === "unseen" ? "unseen" : "surprise",
      event,
      title:
        event.kind === "unseen" ? `${who} ${sees} what nobody has seen before` : `${who} ${sees} something unexpected`,
      since: `since ${since(place, event)} ago${others ? `, and ${others} more below` : ""}`,
      trouble,
    };
  }
  if (store.link === "gone") {
    return {
      tone: "trouble",
      title: "Nothing unexpected when last heard of",
      since: "What has happened since then is not known.",
      trouble: [],
    };
  }
  if (!live.length) {
    const calm = { tone: "trouble", title: "Nobody is watching", trouble };
    return { ...calm, since: "No camera sends frames. Look whether the robots run and reach the service." };
  }
  if (learning) {
    return {
      tone: "calm",
      title: "Getting to know the place",
      since: "What has not been seen before cannot surprise. Events come once most of the picture is known.",
      trouble,
    };
  }
  const last = endedEvents(place)[0];
  const watching = `${list([...new Set(live.map((camera) => camera.robot))])} ${live.length === 1 ? "watches" : "watch"}`;
  return {
    tone: trouble.length ? "trouble" : "calm",
    title: trouble.length ? "Nothing unexpected, but not everybody watches" : "All is as expected",
    since: last
      ? `${watching}. The last surprise ended at ${clock(last.ended_ms)}.`
      : `${watching}. Nothing has surprised since the service began.`,
    trouble,
  };
}

export function drawVerdict(place) {
  const verdict = judge(place);
  const { event } = verdict;
  set(byId("verdict"), "data-tone", verdict.tone);
  say(byId("verdict-title"), verdict.title);
  say(byId("verdict-since"), verdict.since);
  facts(
    byId("verdict-facts"),
    event
      ? [
          event.kind === "change" && ["Strongest", nats(event.peak_surprise)],
          ["Seen by", list(event.robots)],
          ["Last seen", clock(event.last_ms)],
          event.center && ["Where", at(event.center)],
        ]
      : [],
  );
  show(byId("verdict-facts"), Boolean(event));
  const doing = byId("verdict-do");
  const lines = verdict.trouble.map((text) => ({ key: text.split(":")[0], text }));
  const camera = event && place.cameras.get(`${event.last?.robot}/${event.last?.camera}`);
  if (camera)
    lines.push({
      key: "link",
      text: `Look through ${camera.robot} ${camera.camera}`,
      href: cameraAddress(place.name, camera),
    });
  show(doing, lines.length > 0);
  keyed(
    doing,
    lines,
    (line) => line.key,
    (line) => el(line.href ? "a" : "span", { class: line.href ? "" : "trouble" }),
    (node, line) => {
      say(node, line.text);
      set(node, "href", line.href);
    },
  );
  const pictures = byId("verdict-pictures");
  show(pictures, Boolean(event));
  if (event) {
    if (!thumbnails) {
      thumbnails = new Thumbnails();
      pictures.append(...thumbnails.nodes);
    }
    thumbnails.of(event);
  }
}
