// Numbers and times as people read them.

const two = (number) => String(number).padStart(2, "0");
const DAY_MS = 86_400_000;

/** 03:12:41, with the day where it is not today. */
export function clock(ms, seconds = true) {
  const at = new Date(ms);
  const time = `${two(at.getHours())}:${two(at.getMinutes())}${seconds ? `:${two(at.getSeconds())}` : ""}`;
  if (at.toDateString() === new Date().toDateString()) return time;
  const year = Math.abs(Date.now() - ms) > 180 * DAY_MS ? "numeric" : undefined;
  return `${at.toLocaleDateString("en-GB", { day: "numeric", month: "short", year })}, ${time}`;
}

/** How long: 4 s, 2 min, 1 h 5 min, 3 days. */
export function span(ms) {
  const seconds = Math.max(0, Math.round(ms / 1000));
  if (seconds < 60) return `${seconds} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return minutes % 60 ? `${hours} h ${minutes % 60} min` : `${hours} h`;
  return `${Math.floor(hours / 24)} days`;
}

export const count = (number, one, many = `${one}s`) =>
  `${number.toLocaleString("en-GB")} ${number === 1 ? one : many}`;

export const nats = (value) => `${value.toFixed(value < 10 ? 1 : 0)} nats`;

export const percent = (share) => `${Math.round(100 * share)} %`;

// A true minus, and no minus before what rounds to nothing.
export const metres = (value) =>
  value
    .toFixed(2)
    .replace(/^-(?!0\.00$)/, "\u2212")
    .replace(/^-/, "");

export const degrees = (radians) => Math.round((radians * 180) / Math.PI);

export const at = (point) => `${point.map(metres).join(", ")} m`;

export function bytes(number) {
  const units = ["B", "kB", "MB", "GB"];
  let unit = 0;
  while (number >= 1000 && unit < units.length - 1) {
    number /= 1000;
    unit += 1;
  }
  return `${number.toFixed(unit && number < 10 ? 1 : 0)} ${units[unit]}`;
}

export const list = (names) =>
  names.length < 2 ? names.join("") : `${names.slice(0, -1).join(", ")} and ${names.at(-1)}`;
