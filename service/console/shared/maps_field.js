// A choice of maps: all of them, or some by name.
import { all } from "./api.js";
import { useResource } from "./resource.js";
import { html } from "./view.js";

/** value: a list of ids, or null for all maps; among: the ids to choose from, null for all. */
export function MapsField({ value, among = null, change }) {
  const maps = useResource((signal) => all("/maps", {}, { signal }), []);
  const names = among || (maps.data || []).map((one) => one.id);
  const toggle = (name) => change(value.includes(name) ? value.filter((one) => one !== name) : [...value, name].sort());
  return html`
    <fieldset class="stack">
      <legend class="label">Maps</legend>
      ${among === null && html`
        <div class="row">
          <label class="row"><input type="radio" name="which-maps" checked=${value === null} onChange=${() => change(null)} /> all</label>
          <label class="row"><input type="radio" name="which-maps" checked=${value !== null} onChange=${() => change([])} /> only these</label>
        </div>
      `}
      ${value !== null && html`
        <div class="row choices">${names.map((name) => html`<label class="row"><input type="checkbox" checked=${value.includes(name)} onChange=${() => toggle(name)} /> ${name}</label>`)}</div>
      `}
    </fieldset>
  `;
}
