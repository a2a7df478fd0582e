// The robots of a place, a card for each camera: how it is, what it sees, and what it expected.

import { byId, el, keyed, say, set, show } from "./dom.js";
import { Picture } from "./pictures.js";
import { cameraKey, dropped, lastFrame, now, refused, refusedLately, stateOf, threshold, toneOf } from "./store.js";
import { count, nats, span } from "./words.js";

/** The address of a camera on this page. */
export const cameraAddress = (place, camera) => `#/${place}/${camera.robot}/${camera.camera}`;

/** A word for a machine, and words for a person. */
export function stateWords(camera) {
  const state = stateOf(camera);
  const frame_ms = lastFrame(camera);
  const ago = frame_ms === null ? null : span(now() - frame_ms);
  const words = {
    live: "live",
    stalled: ago === null ? "there, but no frame yet" : `no frame for ${ago}`,
    refused: "its frames are refused",
    gone: ago === null ? "gone" : `gone for ${ago}`,
    unknown: "not known",
  };
  return { state, words: words[state] };
}

/** `no_pose: the frame carries ...` as its code and its sentence. */
export function refusalOf(camera) {
  const text = camera.last_refusal;
  if (!text) return null;
  const end = text.indexOf(": ");
  return end < 0 ? { code: "", detail: text } : { code: text.slice(0, end), detail: text.slice(end + 2) };
}

const MODES = { observe: "observes only", freeze: "frozen" };

function make() {
  const card = el("li", { class: "card" });
  const link = el("a", { class: "card-link" });
  card.parts = {
    link,
    robot: el("strong"),
    camera: el("span", { class: "quiet" }),
    mode: el("span", { class: "badge" }),
    state: el(
      "p",
      { class: "state" },
      el("span", { class: "dot", "aria-hidden": "true" }),
      el("span", { class: "text" }),
    ),
    pictures: [new Picture("frame"), new Picture("expected")],
    level: el("p", { class: "level" }),
    numbers: el("p", { class: "numbers" }),
    refusal: el("p", { class: "refusal" }),
  };
  const { parts } = card;
  link.append(el("span", { class: "swatch", "aria-hidden": "true" }), parts.robot, " ", parts.camera);
  card.append(
    el("div", { class: "card-head" }, el("h3", {}, link), parts.mode, parts.state),
    el("div", { class: "pair" }, ...parts.pictures.map((picture) => picture.figure)),
    el("div", { class: "card-foot" }, parts.level, parts.numbers),
    parts.refusal,
  );
  return card;
}

function update(card, place, camera) {
  const { parts } = card;
  set(card, "data-tone", toneOf(place, cameraKey(camera)));
  set(card, "data-camera", cameraKey(camera));
  set(card, "data-sequence", camera.last_sequence);
  set(parts.link, "href", cameraAddress(place.name, camera));
  say(parts.robot, camera.robot);
  say(parts.camera, camera.camera);
  show(parts.mode, camera.mode in MODES);
  say(parts.mode, MODES[camera.mode] ?? "");
  const { state, words } = stateWords(camera);
  set(card, "data-state", state);
  set(parts.state, "data-state", state);
  say(parts.state.lastElementChild, words);
  for (const picture of parts.pictures) picture.of(place.name, camera);
  const surprising = camera.max_surprise > threshold();
  set(parts.level, "data-tone", surprising ? "surprise" : null);
  say(parts.level, camera.frames ? `surprise ${nats(camera.max_surprise)}` : "");
  const numbers = [];
  if (camera.fps !== undefined) numbers.push(`${camera.fps.toFixed(1)} fps`);
  numbers.push(`${dropped(camera).toLocaleString("en-GB")} dropped`);
  numbers.push(`${refused(camera).toLocaleString("en-GB")} refused`);
  say(parts.numbers, numbers.join(" · "));
  const refusal = refusalOf(camera);
  show(parts.refusal, refusal !== null);
  if (refusal) {
    say(parts.refusal, `Last refused: ${refusal.detail}`);
    set(parts.refusal, "title", refusal.code);
    set(parts.refusal, "data-lately", refusedLately(camera));
  }
}

export function drawRobots(place) {
  const cameras = [...place.cameras.values()];
  keyed(
    byId("cameras"),
    cameras,
    (camera) => `${place.name}/${cameraKey(camera)}`,
    make,
    (card, camera) => update(card, place, camera),
  );
  const robots = new Set(cameras.map((camera) => camera.robot)).size;
  const live = cameras.filter((camera) => stateOf(camera) === "live").length;
  const words = [count(robots, "robot")];
  if (cameras.length !== robots) words.push(count(cameras.length, "camera"));
  if (cameras.every((camera) => stateOf(camera) !== "unknown"))
    words.push(live === cameras.length ? "all live" : `${live} of ${cameras.length} live`);
  say(byId("cameras-count"), words.join(" · "));
}
