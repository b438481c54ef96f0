// The settings of a map that its owner may choose when it is made and later.
import { Field, NumberInput } from "./elements.js";
import { ALARMS } from "./fleet.js";
import { html } from "./view.js";

/** fields: the settings as the API has them; change: a function that takes some of them. */
export function MapSettings({ fields, change }) {
  return html`
    <${Field} label="Description">
      <textarea maxlength="2000" rows="2" value=${fields.description} onInput=${(event) => change({ description: event.target.value })}></textarea>
    <//>
    <div class="fields">
      <${Field} label="Kept of each frame">
        <select value=${fields.keep} onChange=${(event) => change({ keep: event.target.value })}>
          <option value="none">nothing</option>
          <option value="thumbnail">a thumbnail</option>
          <option value="image">the image</option>
        </select>
      <//>
      <${Field} label="Search">
        <select value=${fields.index} onChange=${(event) => change({ index: event.target.value })}>
          <option value="auto">as suits the size</option>
          <option value="exact">exact: every place</option>
          <option value="compact">compact: by codes</option>
        </select>
      <//>
      <${Field} label="Same place, metres">
        <${NumberInput} min="0" step="any" required value=${fields.same_place_radius} change=${(metres) => change({ same_place_radius: metres })} />
      <//>
      <${Field} label="One storey, metres up or down">
        <${NumberInput} min="0" step="any" required value=${fields.same_place_height} change=${(metres) => change({ same_place_height: metres })} />
      <//>
      <${Field} label="Same place, frames">
        <${NumberInput} min="0" step="1" required value=${fields.same_place_frames} change=${(frames) => change({ same_place_frames: frames })} />
      <//>
    </div>
    ${fields.alarms && html`<${AlarmLimits} limits=${fields.alarms} change=${(changes) => change({ alarms: { ...fields.alarms, ...changes } })} />`}
    <label class="field check">
      <input type="checkbox" checked=${fields.verification} onChange=${(event) => change({ verification: event.target.checked })} />
      <span>Keep keypoints, by which answers are verified</span>
    </label>
  `;
}

/** From which numbers on trends raise alarms; an empty field: never. */
function AlarmLimits({ limits, change }) {
  return html`
    <fieldset class="fields">
      <legend class="label">Alarm, from so many; never, if left out</legend>
      ${Object.entries(ALARMS).map(([name, label]) => html`<${Field} label=${label}><${NumberInput} min="1" step="1" value=${limits[name] ?? NaN} change=${(limit) => change({ [name]: Number.isNaN(limit) ? null : limit })} /><//>`)}
    </fieldset>
  `;
}
