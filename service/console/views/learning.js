// What a map has learnt: looks by day and by the run that taught them, and the way back by run or by look.
import { all, get, may, remove, send } from "../shared/api.js";
import { complain, Head, Moment, Name, Nothing, Pill, say } from "../shared/elements.js";
import { counted, integer } from "../shared/formats.js";
import { lookPath, LookFacts, LookOrigin, LookPicture, RemoveLooks } from "../shared/looks.js";
import { mapPath } from "../shared/map_path.js";
import { CalibrationOutcome } from "../shared/outcome.js";
import { Thumbnail } from "../shared/pictures.js";
import { Shown, useResource } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

const MODES = { off: "Runs teach this map nothing.", propose: "Runs propose looks, which wait in the review.", auto: "Runs teach looks that independent evidence agrees with; all others wait in the review." };
const MOST_RUNS = 50;
const MOST_LOOKS = 12;

export default function Learning({ map, query }) {
  const about = useResource((signal) => get(mapPath(map), {}, { signal }), [map]);
  const looks = useResource((signal) => all(mapPath(map, "looks"), query.run ? { run: query.run } : {}, { signal }), [map, query.run], { every: 30_000 });
  const jobs = useResource((signal) => get("/jobs", { map, kind: "learn", limit: 100 }, { signal }), [map], { every: 30_000 });
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const changed = () => looks.reload();
  const mode = about.data?.learning.mode;
  return html`
    <${Head} title="Learning" note=${mode && MODES[mode]}>
      ${query.run && html`<button type="button" onClick=${() => restate({ run: "" })}>All runs</button>`}
      ${may("admin") && html`<a class="button" href=${href("maps", map, "review")}>Settings are in the review</a>`}
    <//>
    <${Shown} resource=${looks}>
      ${(items) => html`
        <${Summary} items=${items} jobs=${jobs.data?.items || []} />
        ${items.length === 0 && html`<${Nothing} title=${query.run ? "Nothing is left of this run" : "No place has looks"}>${query.run ? "" : "A look is added on the page of a place, in the review, or learnt from a run."}<//>`}
        ${groupsOf(items).slice(0, MOST_RUNS).map((group) => html`<${Group} key=${`${group.day} ${group.run}`} map=${map} group=${group} job=${jobOf(jobs.data, group.run)} open=${setDialog} close=${close} changed=${changed} />`)}
        ${groupsOf(items).length > MOST_RUNS && html`<p class="faint">and ${integer(groupsOf(items).length - MOST_RUNS)} more</p>`}
        <${Lessons} map=${map} jobs=${jobs.data?.items || []} />
      `}
    <//>
    ${dialog}
  `;
}

function dayOf(moment) {
  return new Date(moment).toLocaleDateString("en-CA"); // year, month and day by this machine's clock
}

function Summary({ items, jobs }) {
  const today = dayOf(Date.now());
  const learnt = items.filter((one) => one.run);
  const fresh = learnt.filter((one) => dayOf(one.created_at) === today);
  const withdrawn = jobs.filter((job) => job.ended_at && dayOf(job.ended_at) === today).reduce((sum, job) => sum + (job.result?.withdrawn || 0), 0);
  return html`
    <dl class="figures panel">
      <div><dt>looks learnt today</dt><dd>${integer(fresh.length)}</dd></div>
      <div><dt>places that they change</dt><dd>${integer(new Set(fresh.map((one) => one.place)).size)}</dd></div>
      <div><dt>runs that taught them</dt><dd>${integer(new Set(fresh.map((one) => one.run)).size)}</dd></div>
      <div><dt>withdrawn today</dt><dd>${integer(withdrawn)}</dd></div>
      <div><dt>looks in all, ${integer(learnt.length)} learnt</dt><dd>${integer(items.length)}</dd></div>
    </dl>
  `;
}

/** Looks of one day that come from one run, or from operators: the newest first. */
function groupsOf(items) {
  const groups = new Map();
  for (const look of items) {
    const name = `${dayOf(look.created_at)} ${look.run}`;
    if (!groups.has(name)) groups.set(name, { day: dayOf(look.created_at), run: look.run, looks: [] });
    groups.get(name).looks.push(look);
  }
  return [...groups.values()].reverse().sort((one, other) => other.day.localeCompare(one.day));
}

function jobOf(jobs, run) {
  return run === null ? null : jobs?.items.find((job) => job.arguments.session === run) || null;
}

function Group({ map, group, job, open, close, changed }) {
  const { day, run, looks } = group;
  const [most, setMost] = useState(MOST_LOOKS);
  const forgetRun = async () => {
    // Of the same run others may be of another day; they go as well, so they are shown, too.
    const found = await all(mapPath(map, "looks"), { run });
    open(html`
      <${RemoveLooks} map=${map} looks=${found} title=${`Undo what the run ${run} taught`} close=${close} send=${async () => {
        const told = await (await send("DELETE", mapPath(map, "looks"), { query: { run } })).json();
        say(`${counted(told.looks, "look")} of the run ${told.looks === 1 ? "was" : "were"} removed.`);
        changed();
      }} />
    `);
  };
  const forget = (look) => open(html`
    <${RemoveLooks} map=${map} looks=${[look]} title=${`Remove a look of ${look.place}`} close=${close} send=${async () => {
      await remove(lookPath(map, look.place, look.name));
      say("The look was removed.");
      changed();
    }} />
  `);
  return html`
    <section class="panel" aria-label=${run ? `The run ${run}` : `Added on ${day}`}>
      <div class="spread">
        <h2>${day === dayOf(Date.now()) ? "Today" : day}: ${run ? html`the run ${run}` : "added by operators"}</h2>
        ${run && may("enrol") && html`<button type="button" class="small danger" onClick=${() => forgetRun().catch(complain)}>Undo this run …</button>`}
      </div>
      <p class="faint">${counted(looks.length, "look")} of ${counted(new Set(looks.map((one) => one.place)).size, "place")}${job && html`, from ${counted(job.arguments.frames, "frame")} <${Moment} at=${job.created_at} />`}</p>
      <ul class="looks">
        ${looks.slice(0, most).map((look) => html`
          <li class="look" key=${`${look.place} ${look.name}`}>
            <div class="look-pair"><${Thumbnail} map=${map} place=${look.place} /><${LookPicture} map=${map} look=${look} /></div>
            <div class="stack">
              <div class="spread"><a href=${href("maps", map, "places", look.place)}><${Name} text=${look.place} /></a><${LookOrigin} look=${look} /></div>
              <${LookFacts} map=${map} look=${look} />
              ${may("enrol") && html`<div><button type="button" class="small danger" aria-label=${`Remove the look ${look.name} of ${look.place}`} onClick=${() => forget(look)}>Remove</button></div>`}
            </div>
          </li>
        `)}
      </ul>
      ${looks.length > most && html`<div><button type="button" class="small" onClick=${() => setMost(looks.length)}>Show all ${integer(looks.length)}</button></div>`}
    </section>
  `;
}

/** The latest lessons, also those from which nothing was taken. */
function Lessons({ map, jobs }) {
  if (jobs.length === 0) return null;
  return html`
    <section class="stack">
      <h2>Lessons</h2>
      <div class="table" tabindex="0" role="region" aria-label="Lessons">
        <table>
          <thead><tr><th>Run</th><th>When</th><th>State</th><th class="number">Frames</th><th class="number">Proposed</th><th class="number">Taken</th><th class="number">Withdrawn</th><th>Calibration</th><th>Why not more</th></tr></thead>
          <tbody>
            ${jobs.map((job) => html`
              <tr key=${job.id}>
                <td><a href=${href("maps", map, "learning", { run: job.arguments.session })}><${Name} text=${job.arguments.session} /></a></td>
                <td class="nowrap"><${Moment} at=${job.created_at} /></td>
                <td><${Pill} tone=${job.state === "failed" ? "bad" : ""}>${job.state}<//></td>
                <td class="number">${integer(job.arguments.frames)}</td>
                <td class="number">${integer(job.result?.proposals)}</td>
                <td class="number">${integer(job.result?.taken)}</td>
                <td class="number">${integer(job.result?.withdrawn)}</td>
                <td class="small">${job.result?.calibration && html`<${CalibrationOutcome} map=${map} told=${job.result.calibration} />`}</td>
                <td class="small long">${whyNot(job)}</td>
              </tr>
            `)}
          </tbody>
        </table>
      </div>
    </section>
  `;
}

function whyNot({ result, problem }) {
  if (problem) return problem.title;
  if (!result) return "";
  if (result.contradiction) return result.contradiction.replaceAll("-", " ");
  return Object.entries(result.refused || {}).map(([reason, count]) => `${integer(count)} ${reason.replaceAll("-", " ")}`).join(", ");
}
