// Pictures of cameras, fetched only while somebody can see them: on the screen, in a tab that is shown. Few at a time,
// and a new one only when the camera has a new frame. The boxes drawn on a picture are those of its own frame.

import { el, svg } from "./dom.js";
import { cameraPath, request } from "./service.js";
import { stateOf, store } from "./store.js";
import { nats } from "./words.js";

const AT_ONCE = 3;
/** Between two fetches of one picture. */
const PAUSE_MS = 250;
const PAUSE_AFTER_TROUBLE_MS = 3_000;
/** Frames whose boxes are kept until a picture of them comes. */
const BOXES_MAX = 40;

const shown = new Set();
const observer = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) shown.add(target.picture);
    else shown.delete(target.picture);
  }
  fetchSome();
});

/** What is being fetched, and whether that may take long. */
const running = new Map();

/** `place/robot/camera` to a map from sequence to boxes. */
const boxesOf = new Map();

const camerasKey = (place, camera) => `${place}/${camera.robot}/${camera.camera}`;

/** Remembers where the regions of a frame are. */
export function noteBoxes(place, camera) {
  if (camera.last_sequence === null || !camera.boxes) return;
  const key = camerasKey(place, camera);
  if (!boxesOf.has(key)) boxesOf.set(key, new Map());
  const frames = boxesOf.get(key);
  frames.delete(camera.last_sequence);
  frames.set(camera.last_sequence, camera.boxes);
  if (frames.size > BOXES_MAX) frames.delete(frames.keys().next().value);
}

/** Of the frame, or of the nearest before it that is known. */
function boxesAt(key, sequence) {
  const frames = boxesOf.get(key);
  if (!frames) return [];
  let nearest = null;
  for (const known of frames.keys()) if (known <= sequence && (nearest === null || known > nearest)) nearest = known;
  return nearest === null ? [] : frames.get(nearest);
}

export const KINDS = {
  frame: { title: "sees", boxes: true },
  expected: { title: "expected" },
  surprise: { title: "surprise", scale: ["0", "60 nats or more"] },
  uncertainty: { title: "uncertainty", scale: ["0", "60 grey levels or more"] },
};

/** One kind of picture of one camera, as a figure. */
export class Picture {
  constructor(kind) {
    this.kind = kind;
    this.place = null;
    this.camera = null;
    this.sequence = null;
    /** The camera's last frame when no picture came; another is tried with the next frame. */
    this.missed = null;
    this.busy = false;
    this.after_ms = 0;
    this.canvas = el("canvas", { role: "img", "aria-label": "No picture yet", width: 320, height: 240 });
    this.boxes = svg("svg", { class: "boxes", "aria-hidden": "true", preserveAspectRatio: "none" });
    this.wait = el("p", { class: "wait" }, "waiting for a frame");
    const { title, scale } = KINDS[kind];
    this.caption = el("figcaption", {}, el("span", {}, title));
    if (scale) {
      this.caption.append(el("span", { class: "scale" }, scale[0], el("span", { class: "heat" }), scale[1]));
    }
    this.screen = el("div", { class: "screen" }, this.canvas, this.boxes, this.wait);
    this.screen.picture = this;
    this.figure = el("figure", { class: "picture" }, this.screen, this.caption);
    observer.observe(this.screen);
  }

  /** Shows another camera, or the same with what is new about it. */
  of(place, camera) {
    const other = !this.camera || camerasKey(this.place, this.camera) !== camerasKey(place, camera);
    this.place = place;
    this.camera = camera;
    if (other || camera.last_sequence === null) this.forget();
    if (camera.image) {
      const { width, height } = camera.image;
      this.screen.style.aspectRatio = `${width} / ${height}`;
    }
  }

  forget() {
    this.sequence = null;
    this.missed = null;
    this.after_ms = 0;
    this.wait.hidden = false;
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.boxes.replaceChildren();
  }

  end() {
    observer.unobserve(this.screen);
    shown.delete(this);
  }

  get due() {
    return (
      !this.busy &&
      this.camera !== null &&
      this.camera.last_sequence !== null &&
      this.camera.last_sequence !== this.sequence &&
      this.camera.last_sequence !== this.missed &&
      Date.now() >= this.after_ms
    );
  }

  async fetch() {
    this.busy = true;
    const { place, camera } = this;
    const key = camerasKey(place, camera);
    let pause = PAUSE_MS;
    try {
      const response = await request(`${cameraPath(place, camera.robot, camera.camera)}/${this.kind}.png`);
      const sequence = Number(response.headers.get("surprised-sequence") ?? camera.last_sequence);
      const bitmap = await createImageBitmap(await response.blob());
      // Another camera may be shown by now.
      if (this.camera && camerasKey(this.place, this.camera) === key) this.draw(bitmap, sequence, key);
    } catch {
      this.missed = camera.last_sequence;
      pause = PAUSE_AFTER_TROUBLE_MS;
    }
    this.busy = false;
    this.after_ms = Date.now() + pause;
  }

  draw(bitmap, sequence, key) {
    const { canvas, camera } = this;
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
      this.screen.style.aspectRatio = `${bitmap.width} / ${bitmap.height}`;
    }
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    this.sequence = sequence;
    this.wait.hidden = true;
    const boxes = KINDS[this.kind].boxes ? boxesAt(key, sequence) : [];
    const what = boxes.length
      ? `, ${boxes.length} surprising: ${boxes.map((box) => nats(box.peak_surprise)).join(", ")}`
      : "";
    canvas.setAttribute(
      "aria-label",
      `${camera.robot} ${camera.camera}: ${KINDS[this.kind].title}, frame ${sequence}${what}`,
    );
    this.drawBoxes(boxes);
  }

  drawBoxes(boxes) {
    const { width, height } = this.canvas;
    this.boxes.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.boxes.replaceChildren(
      ...boxes.flatMap((box) => {
        const place = {
          x: box.x_min,
          y: box.y_min,
          width: box.x_max - box.x_min,
          height: box.y_max - box.y_min,
          rx: 2,
        };
        // A dark line below the bright one: it is seen on anything.
        return [
          svg("rect", { ...place, class: "box-under" }),
          svg("rect", { ...place, class: "box", "data-event": box.event_id }),
        ];
      }),
    );
  }
}

/** Starts what is due, the longest waiting first. A camera that sends nothing may keep its pictures waiting for long: those
 *  take one place at most. */
export function fetchSome() {
  if (document.hidden || store.link === "gone" || store.link === "locked") return;
  // Behind an open dialog nothing is looked at.
  const dialog = document.querySelector("dialog[open]");
  const looked = (picture) => dialog === null || dialog.contains(picture.screen);
  const due = [...shown].filter((picture) => picture.due && looked(picture)).sort((a, b) => a.after_ms - b.after_ms);
  for (const picture of due) {
    const slow = stateOf(picture.camera) !== "live";
    if (running.size >= AT_ONCE) return;
    if (slow && [...running.values()].includes(true)) continue;
    running.set(picture, slow);
    picture.fetch().finally(() => {
      running.delete(picture);
      fetchSome();
    });
  }
}

document.addEventListener("visibilitychange", fetchSome);
setInterval(fetchSome, PAUSE_MS);

/** A pair of thumbnails: what was seen, and what was expected there. */
export class Thumbnails {
  constructor() {
    this.version = null;
    this.figures = ["seen", "expected"].map((kind) => {
      const image = el("img", { alt: "", loading: "lazy", decoding: "async" });
      image.addEventListener("error", () => (image.hidden = true));
      image.addEventListener("load", () => (image.hidden = false));
      return {
        kind,
        image,
        figure: el(
          "figure",
          { class: "thumb" },
          el("div", { class: "screen" }, image),
          el("figcaption", {}, el("span", {}, kind === "seen" ? "saw" : "expected")),
        ),
      };
    });
    this.nodes = this.figures.map(({ figure }) => figure);
  }

  of(event) {
    const version = `${event.picture_path}?v=${event.picture_version}`;
    if (this.version === version) return;
    this.version = version;
    for (const { kind, image } of this.figures) {
      image.src = `${event.picture_path}/${kind}.jpg?v=${event.picture_version}`;
      image.alt = kind === "seen" ? "what was seen" : "what was expected there";
    }
  }
}
