// Any JSON of the service, such as a job's result, laid out to be read: facts as a list, lists cut to their beginning.
import { Facts } from "./elements.js";
import { integer } from "./formats.js";
import { html } from "./view.js";

const MOST = 20;
const DEEPEST = 4;

export function Result({ value, depth = 0 }) {
  if (value === null || value === undefined) return html`<span class="faint">–</span>`;
  if (typeof value === "number") return Number.isInteger(value) ? integer(value) : String(Number(value.toPrecision(6)));
  if (typeof value !== "object") return String(value);
  if (depth >= DEEPEST) return html`<code class="small">${JSON.stringify(value).slice(0, 500)}</code>`;
  if (Array.isArray(value)) return html`<${Items} items=${value} depth=${depth} />`;
  const rows = Object.entries(value).map(([name, one]) => [name.replaceAll("_", " "), html`<${Result} value=${one} depth=${depth + 1} />`]);
  return rows.length ? html`<${Facts} rows=${rows} />` : html`<span class="faint">nothing</span>`;
}

function Items({ items, depth }) {
  if (items.length === 0) return html`<span class="faint">none</span>`;
  if (items.every((one) => typeof one !== "object" || one === null)) {
    return `${items.slice(0, MOST).join(", ")}${items.length > MOST ? ` and ${integer(items.length - MOST)} more` : ""}`;
  }
  return html`
    <ol class="stack">${items.slice(0, MOST).map((one) => html`<li><${Result} value=${one} depth=${depth + 1} /></li>`)}</ol>
    ${items.length > MOST && html`<p class="faint small">and ${integer(items.length - MOST)} more</p>`}
  `;
}
