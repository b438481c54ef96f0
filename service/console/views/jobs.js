// Long work: what runs, what waits, what ended and with which result; running work can be cancelled.
import { caller, get, may } from "../shared/api.js";
import { Dialog, Field, Head, Moment, Nothing, Pager, Progress, Trouble, Typed } from "../shared/elements.js";
import { duration, integer } from "../shared/formats.js";
import { CancelJob, hasEnded, JobState, useJob } from "../shared/jobs.js";
import { Result } from "../shared/result.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

const STATES = ["queued", "running", "succeeded", "failed", "cancelled"];

export default function Jobs({ query }) {
  const { map = "", state = "" } = query;
  const [cursors, setCursors] = useStateOf(JSON.stringify([map, state]), [""]);
  const cursor = cursors.at(-1);
  const jobs = useResource((signal) => get("/jobs", { map, state, limit: 50, cursor }, { signal }), [map, state, cursor], { every: 3000 });
  const [open, setOpen] = useState(null);
  return html`
    <${Head} title="Jobs" note="Long work in the background, the newest first." />
    <div class="filters" role="search" aria-label="Filters">
      <${Field} label="Map"><${Typed} value=${map} change=${({ value }) => restate({ map: value.trim() })} /><//>
      <${Field} label="State">
        <select value=${state} onChange=${(event) => restate({ state: event.target.value })}>
          <option value="">all</option>${STATES.map((one) => html`<option>${one}</option>`)}
        </select>
      <//>
    </div>
    <${Shown} resource=${jobs}>
      ${({ items, next_cursor: next }) => html`
        ${items.length === 0
          ? html`<${Nothing} title="No jobs">${caller.value.maps ? "Jobs of other maps are not shown to this key." : "Calibrating, verifying, pruning, merging and importing in the background are jobs."}<//>`
          : html`<${Table} items=${items} open=${setOpen} changed=${jobs.reload} />`}
        <${Pager} cursors=${cursors} next=${next} show=${setCursors} />
      `}
    <//>
    ${open && html`<${Details} key=${open.id} job=${open} close=${() => setOpen(null)} />`}
  `;
}

function Table({ items, open, changed }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Jobs">
      <table>
        <thead><tr><th>Job</th><th>Map</th><th>State</th><th>Progress</th><th>Submitted</th><th class="number">Took</th><th><span class="hidden">Actions</span></th></tr></thead>
        <tbody>
          ${items.map((job) => html`
            <tr key=${job.id}>
              <td><button type="button" class="link" onClick=${() => open(job)}>${job.kind}</button> <code class="faint small">${job.id}</code></td>
              <td>${job.map ? html`<a href=${href("maps", job.map, "plan")}>${job.map}</a>` : "–"}</td>
              <td><${JobState} job=${job} /></td>
              <td class="progress-cell"><${Done} job=${job} /></td>
              <td class="nowrap"><${Moment} at=${job.created_at} /></td>
              <td class="number">${job.started_at && job.ended_at ? duration((new Date(job.ended_at) - new Date(job.started_at)) / 1000) : "–"}</td>
              <td class="actions-cell">${!hasEnded(job) && !job.cancelling && may("enrol") && html`<${CancelJob} job=${job} done=${changed} />`}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}

function Done({ job }) {
  const { done, total, message } = job.progress;
  if (job.state === "failed") return html`<span class="small">${job.problem?.title}</span>`;
  if (hasEnded(job)) return html`<span class="faint small">${total ? `${integer(done)} of ${integer(total)}` : ""}</span>`;
  return html`<${Progress} done=${done} total=${total} label=${`Progress of ${job.kind}`} /><span class="faint small">${total ? `${integer(done)} of ${integer(total)} ` : ""}${message}</span>`;
}

function Details({ job, close }) {
  const { job: present, error } = useJob(job);
  return html`
    <${Dialog} title=${`${present.kind} ${present.id}`} close=${close} wide>
      ${error && html`<${Trouble} error=${error} />`}
      <div class="spread"><${JobState} job=${present} /><span class="faint">attempt ${present.attempt}${present.resumable && ", goes on after a restart"}</span></div>
      <${Done} job=${present} />
      ${present.problem && html`<${Trouble} error=${{ title: present.problem.title, detail: present.problem.detail }} />`}
      <h3>Arguments</h3>
      <${Result} value=${present.arguments} />
      ${present.result && html`<h3>Result</h3><${Result} value=${present.result} />`}
    <//>
  `;
}
