// Frames to enrol: out of chosen files, dropped folders and videos, with the poses of a places.csv.
import { cellsOf } from "./csv.js";
import { counted } from "./formats.js";
import { readable } from "./frames.js";

export const BAG = /\.(mcap|bag|db3)$/i;
const LIST = "places.csv";
const NUMBERS = ["x", "y", "z", "heading", "latitude", "longitude"];
const COLUMNS = ["file", "id", ...NUMBERS, "timestamp"];
const UNCHANGED_MILLISECONDS = 1000;
const STILL = 0.012;
const SMALL = [32, 24];

export function isBag(file) {
  return BAG.test(file.name);
}

const folders = new WeakMap(); // of files that were dropped

/** All files of a drop, those in folders too. */
export async function droppedFiles(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (entries.length === 0) return [...transfer.files];
  const files = [];
  for (const entry of entries) {
    const before = files.length;
    await walk(entry, files);
    if (entry.isDirectory) for (const file of files.slice(before)) folders.set(file, entry.name);
  }
  return files;
}

/** What a traverse of these files is called unless somebody names it: as their folder or their video, else as the day. */
export function traverseOf(files) {
  const frames = files.filter((file) => !isBag(file));
  const names = new Set(frames.map((file) => folders.get(file) || file.webkitRelativePath.split("/")[0] || (file.type.startsWith("video/") ? stem(file.name) : "")));
  const [name] = names;
  return names.size === 1 && name && !/[/\\]|^\.{1,2}$/.test(name.trim()) && name.trim() !== "" ? name.trim() : new Date().toLocaleDateString("en-CA");
}

async function walk(entry, files) {
  if (entry.isFile) {
    files.push(await new Promise((resolve, reject) => entry.file(resolve, reject)));
    return;
  }
  const reader = entry.createReader();
  for (;;) {
    const found = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (found.length === 0) return;
    for (const one of found.sort((a, b) => byName(a.name, b.name))) await walk(one, files);
  }
}

function byName(one, other) {
  return one.localeCompare(other, "en", { numeric: true });
}

/** An id of a place, made of a text as the command line makes it; empty if none can be made. */
export function idOf(text) {
  const made = text.replace(/[^A-Za-z0-9._~-]+/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(0, 128);
  return /[^-]/.test(made) ? made : "";
}

/** The frames that files hold: {name, file or video and second, given or stem, fields}, and remarks on what was left out.
 *
 * given: the id that places.csv gives it; stem: of what an id is made otherwise, by `named`.
 * seconds: between two frames of a video.
 */
export async function framesOf(files, seconds) {
  const lists = files.filter((file) => file.name.toLowerCase() === LIST);
  const pictures = files.filter((file) => file.type.startsWith("image/")).sort((one, other) => byName(one.webkitRelativePath || one.name, other.webkitRelativePath || other.name));
  const videos = files.filter((file) => file.type.startsWith("video/"));
  const others = files.filter((file) => !isBag(file)).length - lists.length - pictures.length - videos.length;
  const remarks = others > 0 ? [`Left out: ${counted(others, "file")}, neither pictures nor videos.`] : [];
  if (lists.length > 1) throw failed(`There are ${lists.length} files ${LIST}; choose one folder at a time.`);
  const frames = lists.length === 1 ? await listed(lists[0], pictures, remarks) : pictures.map((file) => ({ name: file.name, file, stem: stem(file.name), fields: {} }));
  for (const video of videos) frames.push(...(await framesOfVideo(video, seconds)));
  return { frames, remarks };
}

/** The same frames with their ids: those that were given, and others made of the traverse's name and of their own. */
export function named(frames, sequence) {
  return frames.map((one) => ({ ...one, id: one.given || idOf(`${sequence && `${sequence}-`}${one.stem}`) }));
}

function stem(name) {
  return name.replace(/\.[^.]*$/, "");
}

function failed(text) {
  return Object.assign(new Error(text), { title: "These frames cannot be enrolled so" });
}

/** The frames that a places.csv lists, in its order. */
async function listed(list, pictures, remarks) {
  const [columns, ...rows] = cellsOf(await list.text());
  const unknown = columns.find((name) => !COLUMNS.includes(name));
  if (unknown !== undefined || !columns.includes("file")) throw failed(`The first line of ${LIST} must name "file" and may name ${COLUMNS.slice(1).join(", ")}.`);
  const byFile = new Map(pictures.map((file) => [file.name, file]));
  const used = new Set();
  const frames = rows.map((row, number) => {
    const cells = Object.fromEntries(columns.map((name, at) => [name, row[at] || ""]));
    const file = byFile.get(cells.file.split("/").at(-1));
    if (!file) throw failed(`${LIST}, line ${number + 2}: there is no file ${cells.file}.`);
    used.add(file);
    const fields = {};
    for (const name of NUMBERS) {
      if (!cells[name]) continue;
      if (!Number.isFinite(Number(cells[name]))) throw failed(`${LIST}, line ${number + 2}: ${name} is no number.`);
      fields[name] = Number(cells[name]);
    }
    if (cells.timestamp) fields.timestamp = cells.timestamp;
    return { name: file.name, file, given: cells.id, stem: stem(file.name), fields };
  });
  if (used.size < pictures.length) remarks.push(`Left out: ${counted(pictures.length - used.size, "picture")} that ${LIST} does not list.`);
  return frames;
}

async function opened(file) {
  const video = document.createElement("video");
  video.muted = true;
  video.preload = "auto";
  video.src = URL.createObjectURL(file);
  await new Promise((resolve, reject) => {
    video.onloadeddata = resolve;
    video.onerror = () => reject(failed(`${file.name} is not a video that the browser can read.`));
  });
  return video;
}

async function framesOfVideo(file, seconds) {
  const video = await opened(file);
  if (!Number.isFinite(video.duration)) await sought(video, 1e7); // its end is found by looking for it
  const { duration } = video;
  URL.revokeObjectURL(video.src);
  const count = Math.max(1, Math.floor(duration / seconds - 1e-9) + 1);
  return Array.from({ length: count }, (_, number) => ({
    name: `${file.name}, ${(number * seconds).toFixed(1)} s`,
    video: file,
    second: number * seconds,
    stem: `${stem(file.name)}-${String(number).padStart(5, "0")}`,
    fields: {},
  }));
}

/** Seek, and wait until the frame there can be drawn: on a busy machine `seeked` comes before it. */
function sought(video, second) {
  return new Promise((resolve, reject) => {
    const shown = new Promise((seen) => {
      if (video.requestVideoFrameCallback) video.requestVideoFrameCallback(seen);
      else seen();
    });
    const enough = () => new Promise((over) => setTimeout(over, UNCHANGED_MILLISECONDS)); // the frame may be the same as before
    video.onseeked = () => Promise.race([shown, enough()]).then(resolve);
    video.onerror = () => reject(failed("The video cannot be read."));
    video.currentTime = second;
  });
}

/** Of frames those to enrol: each `every`th, and of those with poses only such that are `metres` from the one before. */
export function thinned(frames, every, metres) {
  let last = null;
  return frames.filter((one, number) => {
    if (number % every !== 0) return false;
    const { x, y } = one.fields;
    if (!metres || x === undefined || y === undefined) return true;
    if (last !== null && Math.hypot(x - last[0], y - last[1]) < metres) return false;
    last = [x, y];
    return true;
  });
}

/** Reads frames one after the other; a frame of a video in which nothing has moved since the one before may be left out. */
export class FrameReader {
  constructor({ leaveStill }) {
    this.leaveStill = leaveStill;
    this.file = null;
    this.video = null;
    this.before = null;
  }

  /** The bytes of a frame as {blob, type}; null if it is left out. */
  async read(frame) {
    if (frame.file) {
      const { blob, type, url } = await readable(frame.file);
      URL.revokeObjectURL(url);
      return { blob, type };
    }
    if (this.file !== frame.video) {
      this.close();
      this.video = await opened(frame.video);
      this.file = frame.video;
    }
    await sought(this.video, frame.second);
    const canvas = new OffscreenCanvas(this.video.videoWidth, this.video.videoHeight);
    canvas.getContext("2d").drawImage(this.video, 0, 0);
    if (this.leaveStill && !this.moved(canvas)) return null;
    return { blob: await canvas.convertToBlob({ type: "image/jpeg", quality: 0.92 }), type: "image/jpeg" };
  }

  /** Whether a picture differs from the last one that was taken. */
  moved(canvas) {
    const small = new OffscreenCanvas(...SMALL);
    const context = small.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0, ...SMALL);
    const { data } = context.getImageData(0, 0, ...SMALL);
    let sum = 0;
    if (this.before) for (let at = 0; at < data.length; at += 1) sum += Math.abs(data[at] - this.before[at]);
    if (this.before && sum / (0.75 * data.length * 255) < STILL) return false;
    this.before = data;
    return true;
  }

  close() {
    if (this.video) URL.revokeObjectURL(this.video.src);
    this.video = null;
    this.file = null;
    this.before = null;
  }
}
