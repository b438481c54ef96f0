// Robots of all maps as the service knows them, what is wrong with them, and how they are shown in a row.
import { get, may } from "./api.js";
import { Name, Pill, Verdict } from "./elements.js";
import { duration, exact } from "./formats.js";
import { useResource } from "./resource.js";
import { href } from "./router.js";
import { html } from "./view.js";

/** Seconds without a frame after which nobody can say where a robot is now. */
export const SILENT_AFTER = 10;
/** Seconds for which a robot may be lost before that is an alarm. */
export const LOST_ALARM = 30;
const EVERY = 3000;

/** The fleet, read again every few seconds; each robot has `label`, and `heard` and `lost`, seconds by the service's clock. */
export function useFleet() {
  return useResource(readFleet, [], { every: EVERY });
}

async function readFleet(signal) {
  const fleet = await get("/fleet", {}, { signal });
  const now = new Date(fleet.at).getTime();
  const since = (moment) => (moment ? Math.max(0, (now - new Date(moment).getTime()) / 1000) : null);
  const told = (one, from) => {
    const heard = since(one.last_at);
    return { ...one, label: one.name || one.camera || one.session || "without a key", heard, lost: since(from), silent: heard > SILENT_AFTER };
  };
  return { ...fleet, robots: fleet.robots.map((one) => told(one, one.lost_since)), lost: fleet.lost.map((one) => told(one, one.since)) };
}

/** Robots that are lost, or were within a day: {tone, text, why, since, address}, the worst first. */
export function alarmsOf(lost) {
  const found = lost.map((one) => {
    const common = { key: `lost ${one.map} ${one.label} ${one.session} ${one.since}`, ...whereOf(one) };
    if (!one.raised) return { ...common, tone: "good", text: `${one.label} was lost`, why: endOf(one), since: one.cleared_at || one.last_at };
    if (one.silent) return { ...common, tone: "warn", text: `${one.label} was lost, and has been silent for ${duration(one.heard)}` };
    return { ...common, tone: "bad", text: `${one.label} lost for ${duration(one.lost)}` };
  });
  return found.sort((one, other) => TONES.indexOf(one.tone) - TONES.indexOf(other.tone));
}

const TONES = ["bad", "warn", "good"];

function endOf({ since, cleared_at: cleared }) {
  return cleared ? `from ${exact(since)} until it was recognized again, ${exact(cleared)}` : `since ${exact(since)}, and was not recognized before its run ended`;
}

export const ALARMS = { worse_places: "Places that get worse", changed_places: "Places that have changed", quiet_stretches: "Stretches that nobody drives any more" };

/** Alarms of maps as those of robots are: those that are raised, and those that were cleared within a day. */
export function mapAlarmsOf(alarms) {
  return alarms.map(({ map, alarm, raised, since, sentence }) => {
    const [first, ...rest] = sentence.split(/(?<=\.) /);
    const address = may("enrol") ? href("maps", map, "health") : href("maps", map, "plan");
    const told = raised ? { tone: "bad", text: first, why: rest.join(" ") } : { tone: "good", text: ALARMS[alarm], why: sentence };
    return { ...told, key: `${map} ${alarm}`, of: map, since, address };
  });
}

function whereOf({ map, place }) {
  return { address: href("maps", map, "plan", place ? { place } : {}), of: map };
}

/** Whether a robot is lost, silent, or where it should be. */
export function RobotState({ robot }) {
  if (robot.silent) return html`<${Pill}>silent for ${duration(robot.heard)}<//>`;
  if (robot.lost !== null) return html`<${Pill} tone=${robot.lost >= LOST_ALARM ? "bad" : "warn"}>lost for ${duration(robot.lost)}<//>`;
  if (robot.verdict === null) return html`<${Pill}>not known<//>`;
  return html`<${Pill} tone="good">located<//>`;
}

/** The latest verdicts, the newest last, as marks. */
function Recent({ verdicts }) {
  const counted = ["recognized", "ambiguous", "unknown"].map((name) => [name, verdicts.filter((one) => one === name).length]);
  const text = counted.filter(([, count]) => count > 0).map(([name, count]) => `${count} ${name}`).join(", ") || "no answers";
  return html`
    <span class="recent" role="img" aria-label=${`The latest answers: ${text}`} title=${text}>
      ${[...verdicts].reverse().map((one) => html`<span class=${one}></span>`)}
    </span>
  `;
}

/** Robots as a table; each has a way to the plan and to its run. */
export function RobotTable({ robots, label = "Robots" }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label=${label}>
      <table>
        <thead><tr><th>Robot</th><th>State</th><th>Verdict</th><th>Where</th><th>Recent answers</th><th class="number">Last seen</th><th><span class="hidden">Run</span></th></tr></thead>
        <tbody>
          ${robots.map((one) => html`
            <tr key=${`${one.map} ${one.session} ${one.label} ${one.camera}`} class=${one.silent ? "faint" : ""}>
              <td><strong><${Name} text=${one.label} /></strong>${one.camera && one.camera !== one.label && html` <span class="faint small">${one.camera}</span>`}</td>
              <td><${RobotState} robot=${one} />${one.contradiction_note && html` <${Pill} tone="warn" title=${one.contradiction_note}>odometry contradicted<//>`}</td>
              <td>${one.verdict ? html`<${Verdict} verdict=${one.verdict} />` : "–"}</td>
              <td class="long"><a href=${href("maps", one.map, "plan")}>${one.map}</a>${one.place && html`, ${one.lost === null && !one.silent ? "" : "last "}at <a href=${href("maps", one.map, "places", one.place)}>${one.place}</a>`}</td>
              <td><${Recent} verdicts=${one.verdicts} /></td>
              <td class="number">${one.heard < 2 ? "now" : `${duration(one.heard)} ago`}</td>
              <td class="actions-cell">${one.session && html`<a href=${href("maps", one.map, "answers", { session: one.session })} aria-label=${`Replay the run of ${one.label}`}>Replay</a>`}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}
