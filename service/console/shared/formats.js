// How numbers, sizes and times are written; the same everywhere.

const NOTHING = "–";

export function integer(value) {
  return value === null || value === undefined ? NOTHING : String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

export function decimal(value, digits = 3) {
  return value === null || value === undefined ? NOTHING : value.toFixed(digits).replace("-", "−");
}

export function percent(share, digits = 0) {
  return share === null || share === undefined ? NOTHING : `${(100 * share).toFixed(digits)}\u00a0%`;
}

export function bytes(count) {
  if (count === null || count === undefined) return NOTHING;
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let value = count;
  let unit = 0;
  while (value >= 1024 && unit < units.length - 1) {
    value /= 1024;
    unit += 1;
  }
  return `${value.toFixed(value < 10 && unit > 0 ? 1 : 0)}\u00a0${units[unit]}`;
}

export function milliseconds(value) {
  if (value === null || value === undefined) return NOTHING;
  if (value >= 10_000) return `${(value / 1000).toFixed(1)} s`;
  return `${value.toFixed(value < 10 ? 1 : 0)} ms`;
}

export function metres(value) {
  if (value === null || value === undefined) return NOTHING;
  return value >= 1000 ? `${(value / 1000).toFixed(2)} km` : `${value.toFixed(value < 10 ? 2 : 1)} m`;
}

const STEPS = [
  [60, 1, "s"],
  [3600, 60, "min"],
  [86_400, 3600, "h"],
  [2_592_000, 86_400, "d"],
  [31_536_000, 2_592_000, "mo"],
  [Infinity, 31_536_000, "y"],
];

/** A duration in its largest unit. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return NOTHING;
  const size = Math.abs(seconds);
  const [, one, unit] = STEPS.find(([limit]) => size < limit);
  return `${Math.floor(size / one)} ${unit}`;
}

/** A moment as it stands to now: 5 min ago, in 2 d. */
export function relative(moment, now = Date.now()) {
  const seconds = (now - new Date(moment).getTime()) / 1000;
  if (Math.abs(seconds) < 2) return "now";
  return seconds > 0 ? `${duration(seconds)} ago` : `in ${duration(seconds)}`;
}

/** The time of day of a moment, to the second, as clocks here show it. */
export function clock(moment) {
  return new Date(moment).toLocaleTimeString("en-GB");
}

/** A moment exactly, in UTC. */
export function exact(moment) {
  return new Date(moment).toISOString().replace("T", " ").replace(/\.\d+Z$/, " UTC");
}

/** So many of something: counted(1, "frame"), counted(2, "frame"). */
export function counted(count, what, several = `${what}s`) {
  return `${integer(count)} ${count === 1 ? what : several}`;
}

/** The name of an encoder without its digest. */
export function encoderName(identity) {
  return identity.split("@")[0];
}

/** Whether a frame shows the map as it is: known, changed or new, with the probabilities of all three. */
export function changeText({ verdict, known, changed, new: fresh }) {
  return `${verdict}: known ${percent(known)}, changed ${percent(changed)}, new ${percent(fresh)}`;
}

/** Where a pose is, in one line. */
export function poseText(pose) {
  if (!pose) return NOTHING;
  const heading = pose.heading === undefined || pose.heading === null ? "" : ` · ${decimal(pose.heading, 0)}°`;
  if (pose.latitude !== undefined && pose.latitude !== null) {
    return `${decimal(pose.latitude, 6)}, ${decimal(pose.longitude, 6)}${heading}`;
  }
  const height = pose.z === undefined || pose.z === null ? "" : `, ${decimal(pose.z, 2)}`;
  return `${decimal(pose.x, 2)}, ${decimal(pose.y, 2)}${height} m${heading}`;
}
