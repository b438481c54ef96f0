// Who changed what: the audit trail, the newest first.
import { get } from "../shared/api.js";
import { saveCsv } from "../shared/csv.js";
import { complain, Dialog, Field, Head, Moment, Nothing, Pager, say, Typed } from "../shared/elements.js";
import { integer } from "../shared/formats.js";
import { Result } from "../shared/result.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

const FILTERS = { map: "Map", key: "Key", operation: "Operation", after: "From (UTC)", before: "To (UTC)" };
const ENOUGH = 50;
const MOST_PAGES = 20;
const MOST_SAVED_PAGES = 50;

export default function Audit({ query }) {
  const filter = Object.fromEntries(Object.keys(FILTERS).filter((name) => query[name]).map((name) => [name, query[name]]));
  const present = JSON.stringify(filter);
  const [cursors, setCursors] = useStateOf(present, [""]);
  const [open, setOpen] = useState(null);
  const cursor = cursors.at(-1);
  const lines = useResource((signal) => read(filter, cursor, signal), [filter, cursor]);
  const [saving, setSaving] = useState(false);
  const keep = async () => {
    setSaving(true);
    try {
      const { items, more } = await readMany(filter);
      saveCsv("audit.csv", columnsOf(items), items);
      if (more) say(`The latest ${integer(items.length)} lines were saved; choose a shorter time for older ones.`);
    } catch (error) {
      complain(error);
    }
    setSaving(false);
  };
  const kind = (name) => (["after", "before"].includes(name) ? "datetime-local" : "text");
  return html`
    <${Head} title="Audit" note=${lines.data?.source === "memory" ? "The last lines of this process; with PLACEREC_AUDIT_FILE all of them are stored." : "Changes and refusals, with their callers."}>
      <button type="button" disabled=${saving} onClick=${keep}>${saving ? "Reading …" : "Save as CSV"}</button>
      <button type="button" onClick=${lines.reload}>Refresh</button>
    <//>
    <div class="filters" role="search" aria-label="Filters">
      ${Object.entries(FILTERS).map(([name, label]) => html`
        <${Field} label=${label}><${Typed} type=${kind(name)} step="1" value=${filter[name] || ""} change=${({ value }) => restate({ [name]: value.trim() })} /><//>
      `)}
    </div>
    <${Shown} resource=${lines}>
      ${({ items, next }) => html`
        ${items.length === 0 ? html`<${Nothing} title="No lines" />` : html`<${Table} items=${items} open=${setOpen} />`}
        <${Pager} cursors=${cursors} next=${next} show=${setCursors} />
      `}
    <//>
    ${open && html`<${Dialog} title=${open.operation || open.event} close=${() => setOpen(null)} wide><${Result} value=${open} /><//>`}
  `;
}

/** A page of lines; the service reads a bounded part of the trail at a time, which may hold few that fit. */
async function read(filter, cursor, signal) {
  const items = [];
  let next = cursor;
  let source = null;
  for (let page = 0; page < MOST_PAGES && items.length < ENOUGH; page += 1) {
    const told = await get("/audit", { ...filter, limit: 50, cursor: next }, { signal });
    items.push(...told.items);
    next = told.next_cursor;
    source = told.source;
    if (!next) break;
  }
  return { items, next, source };
}

/** The latest lines that fit, and whether there are more. */
async function readMany(filter) {
  const items = [];
  let next = "";
  for (let page = 0; page < MOST_SAVED_PAGES; page += 1) {
    const told = await get("/audit", { ...filter, limit: 1000, cursor: next });
    items.push(...told.items);
    next = told.next_cursor;
    if (!next) break;
  }
  return { items, more: Boolean(next) };
}

/** A column for each field that a line has: lines of different operations have different ones. */
function columnsOf(items) {
  const names = new Set(items.flatMap((line) => Object.keys(line)));
  return [...names].map((name) => [name, (line) => line[name]]);
}

function tone(line) {
  if (line.event === "refused") return "bad";
  return line.status !== null && line.status >= 400 ? "warn" : "";
}

function Table({ items, open }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Audit trail">
      <table>
        <thead><tr><th>When</th><th>Caller</th><th>Change</th><th>On</th><th class="number">Status</th><th>From</th><th><span class="hidden">More</span></th></tr></thead>
        <tbody>
          ${items.map((line) => html`
            <tr>
              <td class="nowrap"><${Moment} at=${line.time} /></td>
              <td>${line.principal || "–"}</td>
              <td>${line.event !== "change" && html`<span class=${`pill ${tone(line)}`}>${line.event}</span> `}${(line.operation || "").replaceAll("_", " ")}${line.change && html` <span class="faint small">${line.change}</span>`}</td>
              <td class="long">${line.map && html`<a href=${href("maps", line.map, "plan")}>${line.map}</a>`} ${line.place || line.sequence || line.camera || line.changed_key_name || ""}</td>
              <td class="number">${line.status === null || line.status === undefined ? "–" : html`<span class=${line.status >= 400 ? "pill warn" : ""}>${line.status}</span>`}</td>
              <td>${line.client || "–"}</td>
              <td class="actions-cell"><button type="button" class="small" aria-label=${`More of the line of ${line.time}`} onClick=${() => open(line)}>More</button></td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}
