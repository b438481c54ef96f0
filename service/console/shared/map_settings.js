// The settings of a map that its owner may choose when it is made and later.
import { Field } from "./elements.js";
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
        <input type="number" min="0" step="any" required value=${fields.same_place_radius} onInput=${(event) => change({ same_place_radius: event.target.valueAsNumber })} />
      <//>
      <${Field} label="Same place, frames">
        <input type="number" min="0" step="1" required value=${fields.same_place_frames} onInput=${(event) => change({ same_place_frames: event.target.valueAsNumber })} />
      <//>
    </div>
    <label class="field check">
      <input type="checkbox" checked=${fields.verification} onChange=${(event) => change({ verification: event.target.checked })} />
      <span>Keep keypoints, by which answers are verified</span>
    </label>
  `;
}
