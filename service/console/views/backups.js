// Backups of all maps: when the next one is made, what there is, and one at once.
import { get, post, send } from "../shared/api.js";
import { ExactMoment, Facts, Field, FormDialog, Head, Nothing, NumberInput, Pill, say, Trouble } from "../shared/elements.js";
import { bytes, counted, integer } from "../shared/formats.js";
import { NOT_SAVED, SAVED } from "../shared/saved.js";
import { JobProgress } from "../shared/jobs.js";
import { Shown, useResource } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

const PACES = [[1, "every hour"], [6, "every 6 hours"], [12, "every 12 hours"], [24, "every day"], [168, "every week"]];

function paceText(hours) {
  if (hours === null) return "only by request";
  return PACES.find(([one]) => one === hours)?.[1] ?? `every ${hours} h`;
}

export default function Backups() {
  const told = useResource((signal) => get("/backups", {}, { signal }), [], { every: 10_000 });
  const [job, setJob] = useState(null);
  const [error, setError] = useState(null);
  const [dialog, setDialog] = useState(null);
  const data = told.data;
  const begin = async () => {
    setError(null);
    try {
      setJob(await post("/backups"));
      told.reload();
    } catch (problem) {
      setError(problem);
    }
  };
  const change = () => setDialog(html`<${Schedule} schedule=${data.schedule} close=${() => setDialog(null)} changed=${told.set} />`);
  return html`
    <${Head} title="Backups" note="All maps, saved by the service itself, which answers meanwhile.">
      ${data?.enabled && html`
        <button type="button" onClick=${change}>Change the schedule</button>
        <button type="button" class="primary" disabled=${data.running !== null} onClick=${begin}>Back up now</button>
      `}
    <//>
    ${error && html`<${Trouble} error=${error} close=${() => setError(null)} />`}
    <${Shown} resource=${told}>
      ${({ enabled, schedule, next_at: next, problem, running, items }) => !enabled
        ? html`<${Nothing} title="There is no folder for backups">Whoever runs the service names one with PLACEREC_BACKUP_DIR, on another disk than the maps. Until then, maps are exported one by one under <a href=${href("maps")}>Maps</a>.<//>`
        : html`
          ${problem && html`<section class="panel alarms" aria-label="The latest backup failed"><p><${Pill} tone="bad">failed<//> The latest backup: ${problem}</p></section>`}
          <section class="panel" aria-label="Schedule">
            <${Facts} rows=${[
              ["Made", paceText(schedule.hours)],
              ["Kept", `the latest ${integer(schedule.keep)}`],
              ["The next one", running !== null ? html`<a href=${href("jobs")}>now</a>` : next === null ? (schedule.hours === null ? "when somebody asks for it" : "when there is a map") : new Date(next) <= new Date() ? "in a moment" : html`<${ExactMoment} at=${next} />`],
              ["The latest one", items.length === 0 ? "there is none yet" : html`<${ExactMoment} at=${items[0].at} />`],
            ]} />
            ${job && html`<${JobProgress} key=${job.id} job=${job} what="Backup" onEnd=${told.reload} />`}
          </section>
          ${items.length === 0
            ? html`<${Nothing} title="No backup yet" />`
            : html`
              <${Table} items=${items} />
              <p class="faint small">Each is a folder beside the service, which <code>placerec backup verify</code> and <code>placerec backup restore</code> read. A map that has not changed takes no room again. Of each map ${SAVED}. ${NOT_SAVED}</p>
            `}
        `}
    <//>
    ${dialog}
  `;
}

function Table({ items }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Backups">
      <table>
        <thead><tr><th>Begun</th><th>Folder</th><th class="number">Maps</th><th class="number">Places and looks</th><th class="number">Size</th></tr></thead>
        <tbody>
          ${items.map((one) => html`
            <tr key=${one.id}>
              <td class="nowrap"><${ExactMoment} at=${one.at} /></td>
              <td><code>${one.id}</code></td>
              <td class="number">${integer(one.maps)}</td>
              <td class="number">${integer(one.places)}</td>
              <td class="number">${bytes(one.bytes)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}

function Schedule({ schedule, close, changed }) {
  const [hours, setHours] = useState(schedule.hours);
  const [keep, setKeep] = useState(schedule.keep);
  const paces = hours === null || PACES.some(([one]) => one === hours) ? PACES : [[hours, paceText(hours)], ...PACES];
  const save = async () => {
    changed(await (await send("PUT", "/backups/schedule", { json: { hours, keep } })).json());
    say(hours === null ? "Backups are made only by request now." : `A backup is made ${paceText(hours)}, and ${counted(keep, "is", "are")} kept.`);
  };
  return html`
    <${FormDialog} title="Schedule of backups" action="Save" close=${close} send=${save}>
      <div class="fields">
        <${Field} label="All maps are saved">
          <select value=${hours ?? ""} onChange=${({ target }) => setHours(target.value === "" ? null : Number(target.value))}>
            ${paces.map(([one, text]) => html`<option value=${one}>${text}</option>`)}
            <option value="">only by request</option>
          </select>
        <//>
        <${Field} label="Kept" hint="The oldest ones above that are deleted."><${NumberInput} min="1" max="1000" step="1" required value=${keep} change=${setKeep} /><//>
      </div>
    <//>
  `;
}
