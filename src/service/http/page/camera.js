// One camera, opened: what it sees, what it expected, its surprise and the uncertainty; what it does to the memory.

import { byId, facts, say, set, show } from "./dom.js";
import { KINDS, Picture } from "./pictures.js";
import { refusalOf, stateWords } from "./robots.js";
import { cameraPath, request } from "./service.js";
import { cameraKey, lastFrame, now, openCamera, shownPlace, threshold, toneOf } from "./store.js";
import { at, nats, percent, span } from "./words.js";

const MODE_WORDS = {
  learn: "Its frames are compared with the memory and become part of it.",
  observe: "Its frames are compared with the memory; nothing is written.",
  freeze: "Its frames are compared and leave nothing behind: the same picture is judged the same for ever.",
};

const dialog = byId("camera");
const pictures = Object.keys(KINDS).map((kind) => new Picture(kind));
byId("camera-pictures").append(...pictures.map((picture) => picture.figure));

/** The mode that was asked for and is not confirmed yet, or what was said against it. */
let asked = null;
let objection = null;
let opener = null;

export function close() {
  location.hash = `#/${shownPlace()?.name ?? ""}`;
}

byId("camera-close").addEventListener("click", close);
dialog.addEventListener("cancel", (event) => {
  event.preventDefault();
  close();
});
// A click beside the dialog.
dialog.addEventListener("click", (event) => {
  if (event.target === dialog) close();
});

byId("mode").addEventListener("change", (event) => {
  const isUnderWay = asked !== null;
  asked = event.target.value;
  objection = null;
  drawCamera();
  if (!isUnderWay) setMode();
});

/** One request after the other: the last choice is the last that the service hears. */
async function setMode() {
  const place = shownPlace();
  const camera = openCamera();
  while (camera && asked !== null) {
    const mode = asked;
    try {
      await request(`${cameraPath(place.name, camera.robot, camera.camera)}/mode`, { method: "PUT", json: { mode } });
      camera.mode = mode;
    } catch (trouble) {
      objection = trouble.message;
    }
    if (asked === mode) asked = null;
  }
  asked = null;
  drawCamera();
}

function drawMode(camera) {
  const known = camera.mode !== undefined;
  show(byId("mode"), known);
  if (!known) return;
  const mode = asked ?? camera.mode;
  for (const input of byId("mode").elements.mode) input.checked = input.value === mode;
  set(byId("mode-words"), "data-tone", objection ? "bad" : null);
  say(byId("mode-words"), objection ?? MODE_WORDS[mode] ?? "");
}

export function drawCamera() {
  const place = shownPlace();
  const camera = openCamera();
  if (!camera) {
    if (dialog.open) {
      dialog.close();
      for (const picture of pictures) picture.camera = null;
      asked = objection = null;
      opener?.focus();
    }
    return;
  }
  const key = cameraKey(camera);
  set(dialog, "data-tone", toneOf(place, key));
  say(byId("camera-title"), `${camera.robot} ${camera.camera}`);
  const { state, words } = stateWords(camera);
  set(byId("camera-state"), "data-state", state);
  say(
    byId("camera-state"),
    state === "live" && camera.fps !== undefined ? `live, ${camera.fps.toFixed(1)} fps` : words,
  );
  for (const picture of pictures) picture.of(place.name, camera);
  drawMode(camera);
  const refusal = refusalOf(camera);
  const reasons = Object.entries(camera.refused ?? {}).map(([code, count]) => `${code} ${count}`);
  const frame_ms = lastFrame(camera);
  facts(byId("camera-facts"), [
    [
      "Surprise",
      `${nats(camera.max_surprise)}; ${threshold()} make a box`,
      camera.max_surprise > threshold() ? "surprise" : null,
    ],
    ["Known", `${percent(camera.coverage)} of the picture`],
    frame_ms !== null && ["Last frame", `${span(now() - frame_ms)} ago, number ${camera.last_sequence}`],
    ["Frames", `${camera.frames.toLocaleString("en-GB")}, each ${Math.round(1000 * camera.processing_seconds)} ms`],
    ["Dropped", `${camera.frames_replaced ?? 0} replaced by newer ones, ${camera.frames_lost} lost on the way`],
    ["Refused", reasons.length ? reasons.join(", ") : "none"],
    refusal && ["Last refused", refusal.detail, "bad"],
    camera.pose && ["Position", at(camera.pose.position)],
  ]);
  if (!dialog.open) {
    opener = document.activeElement;
    dialog.showModal();
  }
}
