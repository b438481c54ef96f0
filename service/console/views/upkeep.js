// Upkeep of a map: what the service does with all of it, each as a job that is followed.
import { get, post } from "../shared/api.js";
import { Field, Head, Trouble } from "../shared/elements.js";
import { encoderName } from "../shared/formats.js";
import { JobProgress } from "../shared/jobs.js";
import { ExportMap } from "../shared/export_map.js";
import { mapPath } from "../shared/map_path.js";
import { Result } from "../shared/result.js";
import { useResource, useStateOf } from "../shared/resource.js";
import { go, href } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

export default function Upkeep({ map }) {
  const about = useResource((signal) => get(mapPath(map), {}, { signal }), [map]);
  const [saving, setSaving] = useState(false);
  return html`
    <${Head} title="Upkeep" note=${`Work on all of ${map}. It answers meanwhile.`} />
    <div class="columns">
      <${Work} title="Verify" action="Verify" path=${mapPath(map, "verify")} query=${{ background: true }}>
        Reads everything that is stored and compares it with its checksums. A large map takes minutes.
      <//>
      <${Work} title="Rebuild the index" action="Rebuild" path=${mapPath(map, "rebuild")} off=${about.data?.index.tier === "exact" && "The map is searched exactly, so it has no index to rebuild."}>
        Makes the search index anew from the stored descriptors, if it is in doubt.
      <//>
      <${Work} title="Keypoints" action="Find keypoints" path=${mapPath(map, "keypoints")} off=${about.data && !about.data.verification && "The map keeps no keypoints; its settings say so."}>
        Finds those of places that have none, in the pictures that the map keeps, so that their matches are verified.
      <//>
      <${Reencode} map=${map} about=${about.data} />
      <section class="panel" aria-label="Back up">
        <h2>Back up</h2>
        <p class="faint">One file with settings, places, descriptors, pictures, looks and cameras. It is imported under <a href=${href("maps")}>Maps</a>, where all maps can be saved at once; the service saves them by itself under <a href=${href("backups")}>Backups</a>.</p>
        <div class="row"><button type="button" onClick=${() => setSaving(true)}>Export …</button></div>
        ${saving && html`<${ExportMap} map=${map} close=${() => setSaving(false)} />`}
      </section>
      <section class="panel" aria-label="Elsewhere">
        <h2>Also</h2>
        <ul class="stack prose">
          <li><a href=${href("maps", map, "traverses")}>Traverses</a>: align two of them, and undo it.</li>
          <li><a href=${href("maps", map, "health")}>Health</a>: prune places, merge another map, each after a dry run.</li>
          <li><a href=${href("maps", map, "calibration")}>Calibration</a>: what is believed, and back to the encoder's.</li>
          <li><a href=${href("maps", map, "learning")}>Learning</a>: what runs taught, and undo it.</li>
          <li><a href=${href("maps", map, "cameras")}>Cameras</a>: what of their frames is ignored.</li>
          <li><a href=${href("jobs", { map })}>Jobs</a> of this map.</li>
        </ul>
      </section>
    </div>
  `;
}

/** One kind of work: a button, the job as it goes on, and its result. */
function Work({ title, action, path, query, order, off, ready = true, onDone, children, fields }) {
  const [state, setState] = useStateOf(JSON.stringify([path, order]), {});
  const start = async () => {
    setState({ busy: true });
    try {
      setState({ job: await post(path, order, { query }) });
    } catch (error) {
      setState({ error });
    }
  };
  const ended = (job) => {
    setState((old) => ({ ...old, ended: job }));
    if (job.state === "succeeded") onDone?.(job);
  };
  const running = state.busy || (state.job && !state.ended);
  return html`
    <section class="panel" aria-label=${title}>
      <h2>${title}</h2>
      <p class="faint">${children}</p>
      ${off && html`<p>${off}</p>`}
      ${fields && html`<fieldset class="stack" disabled=${running} aria-label=${title}>${fields}</fieldset>`}
      <div class="row"><button type="button" disabled=${Boolean(off) || running || !ready} onClick=${start}>${action}</button></div>
      ${state.error && html`<${Trouble} error=${state.error} />`}
      ${state.job && html`<${JobProgress} key=${state.job.id} job=${state.job} onEnd=${ended} what=${title} />`}
      ${state.ended?.result && html`<${Result} value=${state.ended.result} />`}
    </section>
  `;
}

function Reencode({ map, about }) {
  const encoders = useResource((signal) => get("/encoders", {}, { signal }), []);
  const [to, setTo] = useState("");
  const [encoder, setEncoder] = useState("");
  const whole = about?.keep === "image";
  const fields = html`
    <div class="fields">
      <${Field} label="Id of the new map"><input maxlength="64" value=${to} onInput=${(event) => setTo(event.target.value)} autocomplete="off" spellcheck=${false} /><//>
      <${Field} label="Encoder">
        <select value=${encoder} onChange=${(event) => setEncoder(event.target.value)}>
          <option value="">the service's default</option>
          ${(encoders.data?.items || []).filter((one) => !one.damaged).map((one) => html`<option value=${one.identity}>${encoderName(one.identity)}</option>`)}
        </select>
      <//>
    </div>
  `;
  return html`
    <${Work} title="Re-encode" action="Make the new map" path=${mapPath(map, "re-encode")} order=${encoder ? { to: to.trim(), encoder } : { to: to.trim() }} ready=${to.trim() !== ""} fields=${whole && fields}
      off=${about && !whole && "The map does not keep its images, of which a new one would be made."} onDone=${() => go("maps", to.trim(), "plan")}>
      Makes a new map of the kept images, for another encoder or with the cameras' present masks. The old one stays.
    <//>
  `;
}
