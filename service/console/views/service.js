// The service itself: is it ready, what waits, how long answers take, and how near it is to its limits.
import { get } from "../shared/api.js";
import { Bar, Facts, Head, Moment, Pill } from "../shared/elements.js";
import { bytes, duration, integer, milliseconds } from "../shared/formats.js";
import { Shown, useResource } from "../shared/resource.js";
import { Result } from "../shared/result.js";
import { html, useState } from "../shared/view.js";

export default function Service() {
  const state = useResource((signal) => get("/service", {}, { signal }), [], { every: 3000 });
  return html`
    <${Head} title="Service" note=${state.data && html`placerec ${state.data.version}, started <${Moment} at=${state.data.started_at} />`}>
      ${state.data && html`<${Pill} tone=${state.data.ready ? "good" : "bad"}>${state.data.ready ? "ready" : "not ready"}<//>`}
    <//>
    <${Shown} resource=${state}>${(data) => html`<${State} data=${data} />`}<//>
  `;
}

function State({ data }) {
  const { queue, storage, requests, jobs, sessions, maps, memory, disk, checks } = data;
  const notReady = requests.operations.find((one) => one.path === "/readyz")?.errors ?? 0; // an answer, not a failure
  const bad = Object.entries(checks).filter(([, told]) => told !== "ok");
  return html`
    ${bad.map(([name, told]) => html`<p class="notice"><strong>${name}</strong>: ${told}</p>`)}
    <dl class="figures panel">
      <${Figure} name="requests, 5 min" value=${integer(requests.count)} />
      <${Figure} name="under way" value=${integer(requests.under_way)} />
      <${Figure} name="failed (5xx)" value=${integer(requests.errors - notReady)} />
      <${Figure} name="jobs running" value=${integer(jobs.running)} />
      <${Figure} name="jobs waiting" value=${integer(jobs.queued)} />
      <${Figure} name="up" value=${duration(data.uptime_seconds)} />
    </dl>
    <div class="columns">
      <section class="panel">
        <h2>How full</h2>
        <${Level} name="Encoder's queue" value=${queue.waiting} of=${queue.limit} />
        <${Level} name="Storage threads" value=${storage.busy} of=${storage.threads} note=${storage.waiting ? `${integer(storage.waiting)} wait` : ""} />
        ${memory && html`<${Level} name="Memory of uploads" value=${memory.uploads} of=${memory.upload_limit} text=${bytes} />`}
        ${disk && html`<${Level} name="Disk" value=${disk.total - disk.free} of=${disk.total} text=${bytes} />`}
      </section>
      <section class="panel">
        <h2>Contents</h2>
        <${Facts} rows=${[
          memory && ["Memory of the process", bytes(memory.resident)],
          disk && ["Free on the disk", bytes(disk.free)],
          ["Maps", integer(maps)],
          ["Sessions", integer(sessions)],
          ["Watchers of jobs", integer(jobs.watchers)],
          ["Default encoder", data.encoder],
          ["Checks", Object.entries(checks).map(([name, told]) => `${name} ${told}`).join(", ")],
        ]} />
      </section>
    </div>
    <section class="stack"><h2>Answers of the last five minutes</h2><${Latencies} operations=${requests.operations} /></section>
    <${More} data=${data} />
  `;
}

function Figure({ name, value }) {
  return html`<div><dt>${name}</dt><dd>${value}</dd></div>`;
}

function Level({ name, value, of, note = "", text = integer }) {
  const share = of ? value / of : 0;
  const tone = share > 0.9 ? "ambiguous" : "";
  return html`
    <div>
      <div class="spread"><span>${name}</span><span class="faint">${text(value)} of ${text(of)} ${note}</span></div>
      <${Bar} share=${share} tone=${tone} label=${`${name}: ${text(value)} of ${text(of)}`} />
    </div>
  `;
}

function Latencies({ operations }) {
  if (operations.length === 0) return html`<p class="faint">No requests.</p>`;
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Latencies">
      <table>
        <thead><tr><th>Operation</th><th class="number">Count</th><th class="number">5xx</th><th class="number">p50</th><th class="number">p90</th><th class="number">p99</th><th class="number">Longest</th></tr></thead>
        <tbody>
          ${operations.map((one) => html`
            <tr>
              <td class="long small">${one.method} <code>${one.path.split(/(?=\/)/).map((part) => html`${part}<wbr />`)}</code></td>
              <td class="number">${integer(one.count)}</td>
              <td class="number">${one.errors ? html`<span class=${one.path === "/readyz" ? "" : "pill bad"}>${integer(one.errors)}</span>` : "0"}</td>
              <td class="number">${milliseconds(one.p50)}</td><td class="number">${milliseconds(one.p90)}</td><td class="number">${milliseconds(one.p99)}</td><td class="number">${milliseconds(one.max)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}

function More({ data }) {
  const [open, setOpen] = useState(null);
  const kinds = [["limits", "Limits"], data.settings && ["settings", "Settings"]].filter(Boolean);
  return html`
    <section class="panel">
      <div class="tabs" role="group" aria-label="More">
        ${kinds.map(([id, name]) => html`<button type="button" aria-pressed=${open === id} onClick=${() => setOpen(open === id ? null : id)}>${name}</button>`)}
      </div>
      ${open && html`<${Result} value=${data[open]} />`}
    </section>
  `;
}
