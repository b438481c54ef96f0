// Where all places of a map lie: the columns of the API's plan, and what a drawing needs of them.
import { send } from "./api.js";
import { mapPath } from "./map_path.js";

const EARTH = 6_371_000;
const kept = { map: null, tag: null, plan: null };

/** The plan of a map; what was read before is kept as long as the map has the same places. */
export async function readPlan(map, signal) {
  const answer = await send("GET", mapPath(map, "plan"), { signal });
  const tag = answer.headers.get("etag");
  if (kept.map === map && kept.tag === tag) return kept.plan;
  const plan = prepared(await answer.json());
  Object.assign(kept, { map, tag, plan });
  return plan;
}

/** A plan of frames that no map has yet, with the poses that they are to get; null if none has one. */
export function planOfFrames(frames) {
  const column = (name) => frames.map(({ fields }) => fields[name] ?? null);
  const poses = Object.fromEntries(["x", "y", "latitude", "longitude", "heading"].map((name) => [name, column(name)]));
  const plan = prepared({ ...poses, ids: frames.map(({ id }) => id), sequence: frames.map(() => 0), sequences: ["new"], gaps: [] });
  return plan.posed === 0 ? null : plan;
}

/** Add to the columns: positions in metres, headings in radians from +x, traverses, gaps, and numbers by id. */
function prepared(columns) {
  const { ids } = columns;
  const count = ids.length;
  const index = new Map();
  for (let one = 0; one < count; one += 1) index.set(ids[one], one);
  const projection = projectionOf(columns);
  const { px, py, angle } = placed(columns, count, projection);
  let posed = 0;
  for (let one = 0; one < count; one += 1) posed += px[one] === px[one] ? 1 : 0; // NaN is not itself
  const plan = { ...columns, count, index, projection, px, py, angle, posed, traverses: traversesOf(columns) };
  plan.gaps = columns.gaps.map(({ before, after }) => ({ from: index.get(before), to: index.get(after) })).filter(({ from, to }) => from !== undefined && to !== undefined);
  return plan;
}

/** Positions and headings of all places; NaN where there is none. */
function placed(columns, count, projection) {
  const [px, py, angle] = [0, 1, 2].map(() => new Float64Array(count).fill(NaN));
  if (projection) {
    const { x, y, latitude, longitude, heading } = columns;
    const pose = { x: null, y: null, latitude: null, longitude: null, heading: null };
    for (let one = 0; one < count; one += 1) {
      pose.x = x ? x[one] : null;
      pose.y = y ? y[one] : null;
      pose.latitude = latitude ? latitude[one] : null;
      pose.longitude = longitude ? longitude[one] : null;
      pose.heading = heading ? heading[one] : null;
      const point = projection(pose);
      if (point === null) continue;
      px[one] = point.x;
      py[one] = point.y;
      if (point.heading !== null) angle[one] = point.heading;
    }
  }
  return { px, py, angle };
}

/** A function from a pose to a point in metres, with the one `back`; null where no place has a pose.
 *
 * A map has either metric or geographic poses as a rule; where it has both, those of the other kind are left out.
 */
function projectionOf(columns) {
  const counted = (column) => (column ? column.reduce((sum, value) => sum + (value === null ? 0 : 1), 0) : 0);
  const [metric, geographic] = [counted(columns.x), counted(columns.latitude)];
  if (metric === 0 && geographic === 0) return null;
  if (metric >= geographic) {
    const projected = (pose) => (isNumber(pose.x) ? { x: pose.x, y: pose.y, heading: radians(pose.heading) } : null);
    return Object.assign(projected, { geographic: false, back: ({ x, y }) => ({ x, y }) });
  }
  const first = columns.latitude.findIndex((value) => value !== null);
  const [latitude, longitude] = [columns.latitude[first], columns.longitude[first]];
  const [north, east] = [EARTH * (Math.PI / 180), EARTH * (Math.PI / 180) * Math.cos((latitude * Math.PI) / 180)];
  const projected = (pose) => {
    if (!isNumber(pose.latitude)) return null;
    const around = ((pose.longitude - longitude + 540) % 360) - 180;
    const heading = isNumber(pose.heading) ? radians(90 - pose.heading) : null;
    return { x: around * east, y: (pose.latitude - latitude) * north, heading };
  };
  const back = ({ x, y }) => ({ latitude: latitude + y / north, longitude: longitude + x / east });
  return Object.assign(projected, { geographic: true, back });
}

function isNumber(value) {
  return value !== null && value !== undefined;
}

function radians(degrees) {
  return isNumber(degrees) ? (degrees * Math.PI) / 180 : null;
}

/** The numbers of the places of each traverse, in order; those of none last. */
function traversesOf({ ids, sequence, sequences }) {
  const found = sequences.map((name) => ({ name, places: [] }));
  const loose = { name: null, places: [] };
  for (let one = 0; one < ids.length; one += 1) (found[sequence[one]] || loose).places.push(one);
  if (loose.places.length) found.push(loose);
  return found;
}

/** The places of the same traverse up to so many steps before and after: {id, step}. */
export function stepsAlong(plan, id, reach) {
  const number = plan.index.get(id);
  const traverse = number === undefined ? null : plan.sequences[plan.sequence[number]];
  if (!traverse) return [];
  const { places } = plan.traverses[plan.sequence[number]];
  const here = places.indexOf(number);
  const found = [];
  for (let step = -reach; step <= reach; step += 1) {
    if (places[here + step] !== undefined) found.push({ id: plan.ids[places[here + step]], step });
  }
  return found;
}

/** The places nearest by pose, without itself: {id, distance} in metres. */
export function nearestTo(plan, id, most) {
  const number = plan.index.get(id);
  if (number === undefined || Number.isNaN(plan.px[number])) return [];
  const found = [];
  for (let one = 0; one < plan.count; one += 1) {
    const [dx, dy] = [plan.px[one] - plan.px[number], plan.py[one] - plan.py[number]];
    const distance = Math.sqrt(dx * dx + dy * dy);
    if (one === number || Number.isNaN(distance)) continue;
    if (found.length === most && distance >= found.at(-1).distance) continue;
    found.push({ id: plan.ids[one], distance });
    found.sort((a, b) => a.distance - b.distance);
    found.length = Math.min(found.length, most);
  }
  return found;
}

/** Positions of a drawing without poses: each traverse is a row, each place a step along it. */
export function stripsOf(plan) {
  const x = new Float64Array(plan.count);
  const y = new Float64Array(plan.count);
  const longest = Math.max(1, ...plan.traverses.map((one) => one.places.length));
  const height = Math.max(1, Math.min(longest / 3, (longest * 0.5) / plan.traverses.length));
  plan.traverses.forEach(({ places }, row) => {
    places.forEach((number, step) => {
      x[number] = step;
      y[number] = -row * height;
    });
  });
  return { x, y, height };
}
