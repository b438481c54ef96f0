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

/** Add to the columns: positions in metres, headings in radians from +x, successors, gaps, and numbers by id. */
function prepared(columns) {
  const count = columns.ids.length;
  const index = new Map(columns.ids.map((id, number) => [id, number]));
  const projection = projectionOf(columns);
  const x = new Float64Array(count).fill(NaN);
  const y = new Float64Array(count).fill(NaN);
  const heading = new Float64Array(count).fill(NaN);
  for (let one = 0; one < count; one += 1) {
    const point = projection?.(poseAt(columns, one));
    if (!point) continue;
    x[one] = point.x;
    y[one] = point.y;
    if (point.heading !== null) heading[one] = point.heading;
  }
  const traverses = traversesOf(columns);
  const plan = { ...columns, count, index, projection, px: x, py: y, angle: heading, traverses };
  plan.posed = x.reduce((sum, value) => sum + (Number.isNaN(value) ? 0 : 1), 0);
  plan.gaps = gapsOf(plan);
  return plan;
}

function poseAt(columns, one) {
  const value = (name) => (columns[name] ? columns[name][one] : null);
  return { x: value("x"), y: value("y"), latitude: value("latitude"), longitude: value("longitude"), heading: value("heading") };
}

/** A function from a pose to a point in metres; null where no place has a pose.
 *
 * A map has either metric or geographic poses as a rule; where it has both, those of the other kind are left out.
 */
function projectionOf(columns) {
  const first = columns.latitude?.findIndex((value) => value !== null) ?? -1;
  const metric = columns.x?.filter((value) => value !== null).length ?? 0;
  const geographic = columns.latitude?.filter((value) => value !== null).length ?? 0;
  if (metric === 0 && geographic === 0) return null;
  if (metric >= geographic) {
    return (pose) => (isNumber(pose.x) ? { x: pose.x, y: pose.y, heading: radians(pose.heading) } : null);
  }
  const [latitude, longitude] = [columns.latitude[first], columns.longitude[first]];
  const [north, east] = [EARTH * (Math.PI / 180), EARTH * (Math.PI / 180) * Math.cos((latitude * Math.PI) / 180)];
  return (pose) => {
    if (!isNumber(pose.latitude)) return null;
    const around = ((pose.longitude - longitude + 540) % 360) - 180;
    const heading = isNumber(pose.heading) ? radians(90 - pose.heading) : null;
    return { x: around * east, y: (pose.latitude - latitude) * north, heading };
  };
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

const GAP = 4;
const MOST_GAPS = 500;

/** Steps of a traverse that are several times longer than its usual one. */
function gapsOf({ traverses, px, py }) {
  const found = [];
  for (const { name, places } of traverses) {
    if (name === null || places.length < 5) continue;
    const steps = [];
    for (let one = 1; one < places.length; one += 1) {
      const length = Math.hypot(px[places[one]] - px[places[one - 1]], py[places[one]] - py[places[one - 1]]);
      if (!Number.isNaN(length)) steps.push({ from: places[one - 1], to: places[one], length });
    }
    const median = steps.map((step) => step.length).sort((a, b) => a - b)[Math.floor(steps.length / 2)];
    if (median > 0) found.push(...steps.filter((step) => step.length > GAP * median));
  }
  return found.sort((a, b) => b.length - a.length).slice(0, MOST_GAPS);
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
    const distance = Math.hypot(plan.px[one] - plan.px[number], plan.py[one] - plan.py[number]);
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
