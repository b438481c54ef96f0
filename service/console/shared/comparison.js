// What a map has already of frames that are to be enrolled, before any of them is sent.
import { post } from "./api.js";
import { mapPath } from "./map_path.js";
import { FrameReader, named } from "./recordings.js";

const AT_ONCE = 4000;
const MOST_NAMES = 1000;
const digests = new WeakMap(); // of a file's frames, by their seconds

/** SHA-256 of some bytes; null where the browser has none, as over plain HTTP. */
export async function digestOf(blob) {
  if (!globalThis.crypto?.subtle) return null;
  const bytes = new Uint8Array(await crypto.subtle.digest("SHA-256", await blob.arrayBuffer()));
  return Array.from(bytes, (one) => one.toString(16).padStart(2, "0")).join("");
}

/** The digest of a frame as it is sent; undefined if it cannot be read, which is told when it is to be sent. */
async function digestOfFrame(reader, frame) {
  const file = frame.file || frame.video;
  if (!digests.has(file)) digests.set(file, new Map());
  const known = digests.get(file);
  if (!known.has(frame.second)) known.set(frame.second, await reader.read(frame).then(({ blob }) => digestOf(blob), () => undefined));
  return known.get(frame.second);
}

/** The places that would be replaced, or would get into another traverse; how many are there already; a free name. */
async function compared(map, frames, sequence, camera, signal) {
  const kinds = new Set(frames.flatMap(({ fields }) => (fields.x !== undefined ? ["metric"] : fields.latitude !== undefined ? ["geographic"] : [])));
  const coordinates = kinds.size === 1 ? [...kinds][0] : null;
  const ask = async (places) => {
    const told = { known: 0, taken: [], free: sequence };
    for (let at = 0; at < places.length; at += AT_ONCE) {
      const order = { places: places.slice(at, at + AT_ONCE), sequence: sequence || null, camera: camera || null, coordinates };
      const { known, taken, free } = await post(`${mapPath(map, "places")}:compare`, order, { signal });
      Object.assign(told, { known: told.known + known, taken: [...told.taken, ...taken], free });
    }
    return told;
  };
  const there = await ask(frames.map(({ id }) => ({ id })));
  const ids = new Set(there.taken.map((one) => one.id));
  const reader = new FrameReader({ leaveStill: false });
  const read = [];
  for (const frame of frames.filter((one) => ids.has(one.id))) {
    if (signal.aborted) break;
    const sha256 = await digestOfFrame(reader, frame);
    if (sha256 !== undefined) read.push({ id: frame.id, sha256 });
  }
  reader.close();
  return { ...(await ask(read)), free: there.free };
}

/** The first of NAME, NAME~2 and so on that no traverse of the map has. */
export async function freeName(map, name) {
  return (await post(`${mapPath(map, "places")}:compare`, { places: [{ id: "any" }], sequence: name, named: false })).free;
}

/** Frames with the ids that they get, and what the map has of them: {frames, sequence, known, taken, free, wrong}.
 *
 * A name of the traverse that somebody chose stays.  Another one is made unique, such as day-left~2, unless the map has
 * these very frames under it: then their enrolment broke off, and goes on.
 */
export async function toEnrol(map, frames, { sequence, chosen, camera }, signal) {
  const [, stem, first] = /^(.*?)(?:~(\d+))?$/.exec(sequence);
  for (let number = 0; ; number += 1) {
    const name = number === 0 ? sequence : `${stem}~${Number(first || 1) + number}`;
    const made = named(frames, name);
    const wrong = problemOf(made);
    if (wrong !== null) return { frames: made, sequence: name, known: 0, taken: [], free: name, wrong };
    const found = await compared(map, made, name, camera, signal);
    const continues = found.taken.length === 0 && (found.known > 0 || found.free === name);
    const unsure = found.taken.some((one) => one.same === null); // they may be these very frames
    if (chosen || continues || unsure || found.free === name || number === MOST_NAMES) return { ...found, frames: made, sequence: name, wrong };
  }
}

/** Why these frames cannot be enrolled together; null if they can. */
function problemOf(frames) {
  const nameless = frames.find((one) => one.id === "");
  if (nameless) return `No id can be made from the name ${nameless.name}; give one in places.csv.`;
  const known = new Map();
  for (const one of frames) {
    if (known.has(one.id)) return `${known.get(one.id)} and ${one.name} would both have the id ${one.id}; give their ids in places.csv.`;
    known.set(one.id, one.name);
  }
  return null;
}
