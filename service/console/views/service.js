// The service itself: is it ready, what waits, how long answers take, and how near it is to its limits.
import { everyMap, get, may } from "../shared/api.js";
import { Chart } from "../shared/chart.js";
import { saveCsv } from "../shared/csv.js";
import { Bar, Degraded, Facts, Head, Moment, Ready } from "../shared/elements.js";
import { bytes, duration, integer, milliseconds } from "../shared/formats.js";
import { Shown, useResource } from "../shared/resource.js";
import { Result } from "../shared/result.js";
import { html, useMemo, useState } from "../shared/view.js";

export default function Service() {
  const state = useResource((signal) => get("/service", {}, { signal }), [], { every: 3000 });
  return html`
    <${Head} title="Service" note=${state.data && html`placerec ${state.data.version}, started <${Moment} at=${state.data.started_at} />`}>
      ${state.data && html`<${Ready} service=${state.data} />`}
    <//>
    <${Degraded} service=${state.data} />
    <${Shown} resource=${state}>${(data) => html`<${State} data=${data} />`}<//>
  `;
}

function State({ data }) {
  const { queue, storage, requests, jobs, sessions, maps, memory, disk, checks } = data;
  const notReady = requests.operations.find((one) => one.path === "/readyz")?.errors ?? 0; // an answer, not a failure
  const bad = Object.entries(checks).filter(([, told]) => told !== "ok" && told !== data.degraded);
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
    ${may("admin") && everyMap.value && html`<${History} />`}
    <section class="stack"><div><h2>Requests of the last five minutes</h2><p class="faint">without those of this console</p></div><${Latencies} operations=${requests.operations} /></section>
    <${More} data=${data} />
  `;
}

const RANGES = { 1: "1 hour", 6: "6 hours", 24: "1 day", 168: "7 days" };
const MIB = 2 ** 20;
const GIB = 2 ** 30;
const COUNTS = ["recognized", "ambiguous", "unknown"];

/** The load over time, as far as it is stored. */
function History() {
  const [hours, setHours] = useState("6");
  const history = useResource((signal) => get("/service/history", { hours }, { signal }), [hours], { every: 30_000 });
  return html`
    <section class="panel" aria-label="Over time">
      <div class="spread">
        <h2>Over time</h2>
        <div class="row">
          <div class="segments" role="group" aria-label="How far back">
            ${Object.entries(RANGES).map(([value, text]) => html`<button type="button" aria-pressed=${hours === value} onClick=${() => setHours(value)}>${text}</button>`)}
          </div>
          <button type="button" class="small" disabled=${!history.data} onClick=${() => saveHistory(history.data)}>Save as CSV</button>
        </div>
      </div>
      <${Shown} resource=${history}>${(data) => html`<${Plots} data=${data} hours=${Number(hours)} />`}<//>
    </section>
  `;
}

function saveHistory(data) {
  const names = Object.keys(data).filter((name) => name !== "step_seconds");
  saveCsv("service-history.csv", names.map((name) => [name, (row) => data[name][row]]), data.at.map((_, row) => row));
}

/** Columns on an even grid of time: what is missing, while the service did not run, is a gap. */
function gridOf(data, hours) {
  const step = data.step_seconds;
  const last = Math.floor(Date.now() / 1000 / step) * step;
  const first = last - Math.ceil((hours * 3600) / step) * step + step;
  const xs = Array.from({ length: (last - first) / step + 1 }, (_, one) => first + one * step);
  const rows = new Map(data.at.map((at, row) => [Math.round(new Date(at).getTime() / 1000), row]));
  const column = (name, by = 1) => xs.map((x) => {
    const value = rows.has(x) ? data[name][rows.get(x)] : null;
    return value === null ? null : value / by;
  });
  return { xs, column };
}

function momentOf(seconds, hours) {
  const moment = new Date(1000 * seconds);
  return hours > 24 ? moment.toLocaleDateString("en-GB", { day: "numeric", month: "short" }) : moment.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
}

function Plots({ data, hours }) {
  const minutes = data.step_seconds / 60;
  const plots = useMemo(() => {
    const { xs, column } = gridOf(data, hours);
    return {
      answers: [xs, ...COUNTS.map((name) => column(name, minutes))],
      latencies: [xs, column("p50"), column("p99")],
      memory: [xs, column("resident", MIB)],
      disk: [xs, column("disk_free", GIB)],
    };
  }, [data, hours]);
  const time = { label: "", time: true, values: (_, splits) => splits.map((one) => momentOf(one, hours)), of: hours };
  const total = COUNTS.map((name) => `${integer(data[name].reduce((sum, one) => sum + one, 0))} ${name}`).join(", ");
  const p99 = Math.max(0, ...data.p99.filter((one) => one !== null));
  return html`
    <p>${total}; ${integer(data.errors.reduce((sum, one) => sum + one, 0))} requests failed.</p>
    <div class="plots">
      <figure><${Chart} data=${plots.answers} height=${200} series=${COUNTS.map((name) => ({ label: name, tint: name }))} axes=${[time, { label: "answers a minute" }]} label=${`Answers a minute by verdict: ${total}`} /></figure>
      <figure><${Chart} data=${plots.latencies} height=${200} series=${[{ label: "half of them" }, { label: "99 of 100", tint: "ambiguous" }]} axes=${[time, { label: "milliseconds" }]} label=${`Latency of answers in milliseconds; 99 of 100 took at most ${milliseconds(p99)}`} /></figure>
      <figure><${Chart} data=${plots.memory} height=${200} series=${[{ label: "memory" }]} axes=${[time, { label: "memory, MiB" }]} label=${`Memory; now ${bytes(data.resident.at(-1))}`} /></figure>
      <figure><${Chart} data=${plots.disk} height=${200} series=${[{ label: "free" }]} axes=${[time, { label: "free on the disk, GiB" }]} label=${`Free on the disk; now ${bytes(data.disk_free.at(-1))}`} /></figure>
    </div>
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
