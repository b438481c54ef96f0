// The home page: what goes wrong, where robots are, how many answers they get, and what waits for a person.
import { all, everyMap, get, may } from "../shared/api.js";
import { mapNames } from "../shared/chosen_map.js";
import { Degraded, Head, Moment, Nothing, Pill, Ready, VerdictMix } from "../shared/elements.js";
import { alarmsOf, LOST_ALARM, mapAlarmsOf, RobotTable, useFleet } from "../shared/fleet.js";
import { bytes, integer, percent } from "../shared/formats.js";
import { mapPath } from "../shared/map_path.js";
import { Shown, useResource } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { html } from "../shared/view.js";

const VERDICTS = ["recognized", "ambiguous", "unknown"];
const HOURS = 24;
const MOST_ROBOTS = 8;
const MOST_BACKLOGS = 20;
const MOST_FRAMES = 200;
const FULL = 0.9;
const LATE = 900_000;

export default function Home() {
  const fleet = useFleet();
  const maps = useResource(readMaps, [], { every: 30_000 });
  const service = useResource((signal) => get("/service", {}, { signal }), [], { every: 15_000 });
  const backups = useResource((signal) => (may("admin") && everyMap.value ? get("/backups", {}, { signal }) : Promise.resolve(null)), [], { every: 60_000 });
  return html`
    <${Head} title="Home" note=${maps.data && `${integer(maps.data.items.length)} ${maps.data.items.length === 1 ? "map" : "maps"}`}>
      ${service.data && html`<a href=${href("service")}><${Ready} service=${service.data} /></a>`}
    <//>
    <${Degraded} service=${service.data} />
    <${Shown} resource=${fleet}>${(data) => html`
      <${Alarms} found=${[...troubles(maps.data, service.data), ...backupTroubles(backups.data), ...alarmsOf(data.lost), ...mapAlarmsOf(data.alarms)]} />
      <${Today} fleet=${data} backlogs=${maps.data?.backlogs} />
      <section class="stack">
        <div class="spread"><h2>Robots</h2>${data.robots.length > MOST_ROBOTS && html`<a href=${href("robots")}>All ${integer(data.robots.length)}</a>`}</div>
        ${data.robots.length === 0
          ? html`<${Nothing} title="No robot has asked">They appear here with their first frame.<//>`
          : html`<${RobotTable} robots=${data.robots.slice(0, MOST_ROBOTS)} />`}
      </section>
      ${maps.data && html`<section class="stack"><h2>Maps</h2><${Maps} maps=${maps.data} fleet=${data} /></section>`}
    `}<//>
  `;
}

/** The maps, and the frames that wait for review in those that store some. */
async function readMaps(signal) {
  const first = await get("/maps", { limit: 1000 }, { signal });
  const items = [...first.items];
  if (first.next_cursor) items.push(...(await all("/maps", { cursor: first.next_cursor }, { signal })));
  mapNames.value = items.map((one) => one.id);
  const backlogs = {};
  const reviewed = may("enrol") ? items.filter((one) => one.review || one.learning.mode !== "off" || one.learning.new_ground).slice(0, MOST_BACKLOGS) : [];
  await Promise.all(reviewed.map(async ({ id }) => {
    const page = await get(mapPath(id, "review"), { labelled: false, limit: MOST_FRAMES }, { signal });
    backlogs[id] = { count: page.items.length, more: page.next_cursor !== null };
  }));
  return { items, quarantined: first.quarantined, backlogs };
}

/** What is wrong with the service and with maps. */
function troubles(maps, service) {
  const found = [];
  for (const { id, reason } of maps?.quarantined || []) found.push({ tone: "bad", text: `${id} is damaged and out of service`, why: reason, address: href("maps") });
  for (const [name, told] of Object.entries(service?.checks || {})) {
    if (told !== "ok" && told !== service.degraded) found.push({ tone: "bad", text: `${name}: ${told}`, address: href("service") });
  }
  const disk = service?.disk;
  if (disk && 1 - disk.free / disk.total > FULL) found.push({ tone: "warn", text: `The disk is ${percent(1 - disk.free / disk.total)} full`, why: `${bytes(disk.free)} are free`, address: href("service") });
  for (const { id, last_day: day } of maps?.items || []) {
    const total = day ? sum(day) : 0;
    if (total >= 20 && day.unknown / total > 0.5) found.push({ tone: "warn", text: `${id}: ${percent(day.unknown / total)} of the answers of the last day were unknown`, address: may("enrol") ? href("maps", id, "health") : href("maps", id, "live") });
  }
  return found;
}

/** What is wrong with backups: the latest one failed, or the next one is overdue. */
function backupTroubles(backups) {
  if (!backups?.enabled) return [];
  const address = href("backups");
  if (backups.problem) return [{ tone: "bad", text: "The latest backup failed", why: backups.problem, address }];
  const late = backups.next_at && backups.running === null ? Date.now() - new Date(backups.next_at) : 0;
  return late > LATE ? [{ tone: "bad", text: "A backup is overdue", why: "None was begun when it was due.", since: backups.next_at, address }] : [];
}

const KINDS = { bad: "alarm", warn: "notice", good: "cleared" };

function Alarms({ found }) {
  const present = found.filter((one) => one.tone !== "good");
  return html`
    <section class=${present.length ? "panel alarms" : "panel"} aria-label="Alarms" aria-live="polite">
      <h2>Alarms</h2>
      ${present.length === 0 && html`<p class="faint">None: no robot has been lost for ${LOST_ALARM} s, and nothing is out of service.</p>`}
      ${found.length > 0 && html`
        <ul class="stack">
          ${[...present, ...found.filter((one) => one.tone === "good")].map((one) => html`<li class="row" key=${one.key || one.text.replace(/\d+/g, "")}><${Pill} tone=${one.tone}>${KINDS[one.tone]}<//> <a href=${one.address}>${one.text}</a>${one.of && html` <span class="faint">in ${one.of}</span>`}${one.why && html` <span class="faint small">${one.why}</span>`}${one.since && html` <span class="faint small nowrap"><${Moment} at=${one.since} /></span>`}</li>`)}
        </ul>
      `}
    </section>
  `;
}

function sum(counts) {
  return VERDICTS.reduce((total, name) => total + counts[name], 0);
}

/** Counts of the verdicts of all maps in each of the last hours, the oldest first. */
function byHour(fleet) {
  const last = Math.floor(new Date(fleet.at).getTime() / 3_600_000);
  const hours = Array.from({ length: HOURS }, (_, one) => ({ hour: last - HOURS + 1 + one, recognized: 0, ambiguous: 0, unknown: 0 }));
  for (const map of fleet.maps) {
    for (const counts of map.hours) {
      const found = hours[new Date(counts.hour).getTime() / 3_600_000 - hours[0].hour];
      if (found) for (const name of VERDICTS) found[name] += counts[name];
    }
  }
  return hours;
}

function Today({ fleet, backlogs }) {
  const hours = byHour(fleet);
  const day = hours.reduce((total, one) => total + sum(one), 0);
  const recognized = hours.reduce((total, one) => total + one.recognized, 0);
  const waiting = Object.values(backlogs || {});
  const frames = waiting.reduce((total, one) => total + one.count, 0);
  return html`
    <section class="panel" aria-label="The last day">
      <dl class="figures">
        <div><dt>robots heard now</dt><dd>${integer(fleet.robots.filter((one) => !one.silent).length)}</dd></div>
        <div><dt>answers this hour</dt><dd>${integer(sum(hours.at(-1)))}</dd></div>
        <div><dt>answers, 24 hours</dt><dd>${integer(day)}</dd></div>
        <div><dt>of them recognized</dt><dd>${day ? percent(recognized / day) : "–"}</dd></div>
        ${may("enrol") && html`<div><dt>frames wait for review</dt><dd>${backlogs ? `${integer(frames)}${waiting.some((one) => one.more) ? "+" : ""}` : "–"}</dd></div>`}
      </dl>
      <${Hours} hours=${hours} />
    </section>
  `;
}

function Hours({ hours }) {
  const most = Math.max(1, ...hours.map(sum));
  const clock = ({ hour }) => new Date(3_600_000 * hour).toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  const told = hours.filter((one) => sum(one) > 0).map((one) => `${clock(one)}: ${sum(one)}`).join(", ") || "none";
  return html`
    <div class="stack">
      <div class="hours" role="img" aria-label=${`Answers in each of the last ${HOURS} hours: ${told}`}>
        ${hours.map((one) => html`
          <span class="hour" title=${`${clock(one)}: ${VERDICTS.map((name) => `${one[name]} ${name}`).join(", ")}`}>
            ${[...VERDICTS].reverse().map((name) => one[name] > 0 && html`<span class=${name} style=${{ height: `${(100 * one[name]) / most}%` }}></span>`)}
          </span>
        `)}
      </div>
      <p class="spread faint small"><span>${clock(hours[0])}</span><span>answers by hour; at most ${integer(most)}</span><span>${clock(hours.at(-1))}</span></p>
    </div>
  `;
}

function Maps({ maps, fleet }) {
  const asked = new Map(fleet.maps.map((one) => [one.map, one]));
  const heard = (id) => fleet.robots.filter((one) => one.map === id && !one.silent).length;
  const present = Math.floor(new Date(fleet.at).getTime() / 3_600_000) * 3_600_000;
  const now = (id) => asked.get(id)?.hours.find((one) => new Date(one.hour).getTime() === present);
  const items = [...maps.items].sort((one, other) => heard(other.id) - heard(one.id) || dayOf(other) - dayOf(one)).slice(0, 20);
  if (items.length === 0) return html`<${Nothing} title="There are no maps" />`;
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Maps">
      <table>
        <thead><tr><th>Map</th><th class="number">Robots now</th><th class="number">Answers this hour</th><th>Last day</th>${may("enrol") && html`<th class="number">To review</th>`}<th class="number">Places</th></tr></thead>
        <tbody>
          ${items.map((map) => html`
            <tr key=${map.id}>
              <td><a href=${href("maps", map.id, "plan")}><strong>${map.id}</strong></a></td>
              <td class="number">${integer(heard(map.id))}</td>
              <td class="number">${integer(now(map.id) ? sum(now(map.id)) : 0)}</td>
              <td class="nowrap"><${VerdictMix} counts=${map.last_day} /></td>
              ${may("enrol") && html`<td class="number">${backlogText(maps.backlogs[map.id], map.id)}</td>`}
              <td class="number">${integer(map.places)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
    ${maps.items.length > items.length && html`<p><a href=${href("maps")}>All ${integer(maps.items.length)} maps</a></p>`}
  `;
}

function dayOf({ last_day: day }) {
  return day ? sum(day) : 0;
}

function backlogText(backlog, id) {
  if (!backlog) return html`<span class="faint">–</span>`;
  return html`<a href=${href("maps", id, "review")}>${integer(backlog.count)}${backlog.more && "+"}</a>`;
}
