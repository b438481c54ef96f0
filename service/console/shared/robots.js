// Where robots are now: sessions and single answers of a map, as its events tell of them.
import { all, get } from "./api.js";
import { mapPath } from "./map_path.js";

const TRAIL = 80;
/** Milliseconds without a frame after which nobody can say where a robot is now. */
const SILENT_AFTER = 10_000;
const FADES_AFTER = 30_000;

export class Robots {
  /** projection: from a pose to a point on the plan. */
  constructor(projection) {
    this.projection = projection;
    this.robots = new Map();
    this.dots = [];
  }

  /** Take the sessions that are open. */
  async begin(map, signal) {
    const sessions = await all(mapPath(map, "sessions"), {}, { signal });
    for (const { id } of sessions.slice(0, 50)) {
      const told = await get(mapPath(map, "sessions", id), {}, { signal }).catch((error) => {
        if (error.status !== 404) throw error; // one that has ended since it was listed hides no other
        return {};
      });
      const { belief, key, camera, last_frame_at: at } = told;
      if (at && belief?.place?.pose) this.move({ session: id, key, camera, pose: belief.place.pose, verdict: belief.verdict, at });
    }
  }

  /** Take an event; whether it moved anything. */
  take(name, event) {
    if (name === "session") return this.takeSession(event);
    if (name !== "query" || !event.pose) return false;
    if (event.session) {
      this.move(event);
      return true;
    }
    const point = this.projection(event.pose);
    if (!point) return false;
    this.dots = [...this.dots.slice(-199), { ...point, verdict: event.verdict, at: Date.now() }];
    return true;
  }

  takeSession(event) {
    if (event.change === "ended") return this.robots.delete(event.session);
    const robot = this.robots.get(event.session);
    if (robot) Object.assign(robot, { verdict: event.verdict || robot.verdict, seen: moment(event.at) });
    else if (event.pose) this.move(event);
    return true;
  }

  /** Take a session's pose and verdict; its robot is called after its key, else after its camera or the session. */
  move({ session, key, camera, pose, verdict, at }) {
    const point = this.projection(pose);
    if (!point) return;
    const { trail = [], label } = this.robots.get(session) || {};
    const robot = { session, label: key || camera || label || session, verdict, seen: moment(at) };
    const place = { x: point.x, y: point.y, angle: point.heading, ellipse: ellipseOf(pose) };
    this.robots.set(session, { ...robot, ...place, trail: [...trail, point].slice(-TRAIL) });
  }

  /** What is to be drawn. */
  now() {
    const since = Date.now() - FADES_AFTER;
    this.dots = this.dots.filter((dot) => dot.at > since);
    const robots = [...this.robots.values()].sort((one, other) => other.seen - one.seen);
    return {
      robots: robots.map((one) => ({ ...one, silent: Date.now() - one.seen > SILENT_AFTER })),
      dots: this.dots.map((dot) => ({ ...dot, age: (Date.now() - dot.at) / FADES_AFTER })),
    };
  }
}

/** When something happened, which by this machine's clock is not later than now. */
function moment(at) {
  return Math.min(new Date(at).getTime(), Date.now());
}

/** The ellipse of two standard deviations of a pose, by its covariance or else its spread. */
function ellipseOf({ covariance, spread }) {
  if (covariance) {
    const [xx, xy, yy] = Array.isArray(covariance[0])
      ? [covariance[0][0], covariance[0][1], covariance[1][1]]
      : [covariance[0], covariance[1], covariance[7]];
    const [mean, half] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
    const turn = 0.5 * Math.atan2(2 * xy, xx - yy);
    return { major: 2 * Math.sqrt(Math.max(0, mean + half)), minor: 2 * Math.sqrt(Math.max(0, mean - half)), turn };
  }
  return spread ? { major: 2 * spread, minor: 2 * spread, turn: 0 } : null;
}
