// The way to the service: requests, the token, and the stream of server-sent events with what stands in for it. The
// stream comes back by itself; where it does not, the status is polled, and where nothing answers, the page says so.

/** What the service or the way to it has against a request. `status` 0: no answer at all. */
export class Trouble extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

const ANSWER_WITHIN_MS = 15_000;
const PROBE_WITHIN_MS = 4_000;
const POLL_EVERY_MS = 2_000;
/** Silence on the stream after which the service is asked whether it is there. */
const SILENCE_MS = 6_000;
const RETRY_MS = [1_000, 2_000, 3_000, 5_000];

export async function request(path, { method = "GET", json, within = ANSWER_WITHIN_MS } = {}) {
  const headers = {};
  if (json !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(path, {
      method,
      headers,
      body: json === undefined ? undefined : JSON.stringify(json),
      cache: "no-store",
      signal: AbortSignal.timeout(within),
    });
  } catch {
    throw new Trouble(0, "the service does not answer");
  }
  if (!response.ok) {
    const problem = await response.json().catch(() => ({}));
    throw new Trouble(response.status, problem.detail ?? `${response.status} ${response.statusText}`);
  }
  return response;
}

export const get = async (path, options) => (await request(path, options)).json();

export const placePath = (place) => `/api/v1/places/${place}`;

export const cameraPath = (place, robot, camera) => `${placePath(place)}/robots/${robot}/${camera}`;

// Kept to sign in again after a restart of the service; gone with the tab.
let token = null;

export async function signIn(given) {
  await request("/api/v1/session", { method: "POST", json: { token: given } });
  token = given;
}

/** Whether the page may see data; tries the token of before. */
async function signedIn() {
  const session = await get("/api/v1/session", { within: PROBE_WITHIN_MS });
  if (!session.required || session.signed_in) return true;
  if (token === null) return false;
  try {
    await signIn(token);
    return true;
  } catch (trouble) {
    if (trouble.status !== 401) throw trouble;
    token = null;
    return false;
  }
}

/**
 * Listens for ever. `on` is told `hello`, `state`, `event` and `reset` with what the service said, `poll` when it is time
 * to ask because the stream does not come, and `link` with `live`, `polling`, `locked` or `gone` and when to try again.
 */
export class Link {
  #on;
  #source = null;
  #heard = 0;
  #tries = 0;
  #timer = 0;

  constructor(on) {
    this.#on = on;
    setInterval(() => this.#watch(), 1_000);
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden) this.#watch();
    });
    window.addEventListener("online", () => this.now());
    this.now();
  }

  /** Tries at once. */
  now() {
    clearTimeout(this.#timer);
    this.#connect();
  }

  async #connect() {
    this.#source?.close();
    this.#source = null;
    try {
      if (!(await signedIn())) {
        this.#on.link("locked");
        return;
      }
    } catch {
      this.#gone();
      return;
    }
    this.#source?.close();
    const source = new EventSource("/events");
    this.#source = source;
    this.#heard = Date.now();
    for (const kind of ["hello", "state", "event", "reset"]) {
      source.addEventListener(kind, (message) => {
        if (source !== this.#source) return;
        this.#heard = Date.now();
        this.#tries = 0;
        if (kind === "hello") this.#on.link("live");
        this.#on[kind](message.data ? JSON.parse(message.data) : null);
      });
    }
    source.addEventListener("error", () => {
      if (source !== this.#source) return;
      source.close();
      this.#source = null;
      this.#probe();
    });
  }

  /** The stream is not there: is the service? */
  async #probe() {
    try {
      await request("/healthz", { within: PROBE_WITHIN_MS });
    } catch {
      this.#gone();
      return;
    }
    // It answers: its data can be asked for until the stream is back.
    this.#on.link("polling");
    this.#on.poll();
    this.#again(POLL_EVERY_MS);
  }

  #gone() {
    const wait = RETRY_MS[Math.min(this.#tries, RETRY_MS.length - 1)];
    this.#tries += 1;
    this.#on.link("gone", Date.now() + wait);
    this.#again(wait);
  }

  #again(wait) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#connect(), wait);
  }

  /** Where nothing changes nothing comes; that the service is there is asked for then. */
  async #watch() {
    if (!this.#source || Date.now() - this.#heard < SILENCE_MS) return;
    const source = this.#source;
    this.#heard = Date.now();
    try {
      await request("/healthz", { within: PROBE_WITHIN_MS });
      this.#on.link("live");
    } catch {
      if (source !== this.#source) return;
      source.close();
      this.#source = null;
      this.#gone();
    }
  }
}
