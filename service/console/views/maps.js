// All maps: how large, how searched, how they answer; made, edited, deleted, saved as files and read from them.
import { all, caller, everyMap, get, getTagged, may, patch, post, remove, upload } from "../shared/api.js";
import { ByName, Dialog, Field, FormDialog, Head, Menu, Moment, Nothing, Pill, Progress, say, Trouble, VerdictMix } from "../shared/elements.js";
import { mapNames } from "../shared/chosen_map.js";
import { bytes, counted, encoderName, integer } from "../shared/formats.js";
import { ExportAll, ExportMap } from "../shared/export_map.js";
import { JobProgress } from "../shared/jobs.js";
import { mapPath } from "../shared/map_path.js";
import { MapSettings } from "../shared/map_settings.js";
import { Shown, useResource } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { NOT_SAVED, SAVED } from "../shared/saved.js";
import { html, useState } from "../shared/view.js";

export default function Maps() {
  const maps = useResource(readMaps, [], { every: 30_000 });
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const changed = () => maps.reload();
  return html`
    <${Head} title="Maps" note=${maps.data && summary(maps.data.items)}>
      ${may("admin") && html`
        ${maps.data?.items.length > 1 && html`<button type="button" onClick=${() => setDialog(html`<${ExportAll} maps=${maps.data.items.map((one) => one.id)} close=${close} />`)}>Export all</button>`}
        <button type="button" onClick=${() => setDialog(html`<${Import} close=${close} changed=${changed} />`)}>Import</button>
        <button type="button" class="primary" onClick=${() => setDialog(html`<${Create} close=${close} changed=${changed} />`)}>Create a map</button>
      `}
    <//>
    <${Shown} resource=${maps}>
      ${({ items, quarantined }) => html`
        ${quarantined.map((one) => html`<${Damaged} damaged=${one} open=${setDialog} close=${close} changed=${changed} />`)}
        ${items.length === 0 && quarantined.length === 0 && html`<${Empty} />`}
        ${items.length > 0 && html`<${Table} items=${items} open=${setDialog} close=${close} changed=${changed} />`}
      `}
    <//>
    ${dialog}
  `;
}

async function readMaps(signal) {
  const [first, items] = [await get("/maps", { limit: 1000 }, { signal }), []];
  items.push(...first.items);
  if (first.next_cursor) items.push(...(await all("/maps", { cursor: first.next_cursor }, { signal })));
  mapNames.value = items.map((one) => one.id);
  return { items, quarantined: first.quarantined };
}

function summary(items) {
  const places = items.reduce((sum, map) => sum + map.places, 0);
  return `${counted(items.length, "map")}, ${counted(places, "place")}`;
}

function Empty() {
  return html`
    <${Nothing} title="There are no maps">
      ${may("admin") ? "Create one, or import one that was exported." : `The key ${caller.value.name} sees no map yet.`}
    <//>
  `;
}

function Table({ items, open, close, changed }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Maps">
      <table>
        <thead>
          <tr>
            <th>Map</th><th>Health</th><th>Last day</th><th class="number">Places</th><th class="number">On disk</th>
            <th>Encoder</th><th class="number">Revision</th><th>Edited</th><th><span class="hidden">Actions</span></th>
          </tr>
        </thead>
        <tbody>${items.map((map) => html`<${Row} key=${map.id} map=${map} open=${open} close=${close} changed=${changed} />`)}</tbody>
      </table>
    </div>
  `;
}

function Row({ map, open, close, changed }) {
  const { word, tone, why } = health(map);
  const { descriptors, index, database } = map.storage;
  const fresh = () => open(html`<${Edit} map=${map.id} close=${close} changed=${changed} />`);
  return html`
    <tr>
      <td>
        <a href=${href("maps", map.id, "plan")}><strong>${map.id}</strong></a>
        ${map.description && html`<div class="faint small clip" title=${map.description}>${map.description}</div>`}
      </td>
      <td><${Pill} tone=${tone} title=${why}>${word}<//></td>
      <td class="nowrap"><${VerdictMix} counts=${map.last_day} /></td>
      <td class="number">${integer(map.places)}</td>
      <td class="number" title=${`${integer(map.storage.bytes_per_place)} bytes a place`}>${bytes(descriptors + index + database)}</td>
      <td class="nowrap">
        <span title=${map.encoder}>${encoderName(map.encoder)}</span>
        <div class="faint small">${map.storage.precision}, ${map.index.tier}</div>
      </td>
      <td class="number">${map.revision}</td>
      <td class="nowrap"><${Moment} at=${map.updated_at} /></td>
      <td class="actions-cell">
        ${may("admin") && html`
          <${Menu} of=${map.id} items=${[
            ["Edit", fresh],
            ["Export", () => open(html`<${ExportMap} map=${map.id} close=${close} />`)],
            ["Delete", () => open(html`<${Delete} map=${map.id} places=${map.places} close=${close} changed=${changed} />`), "danger"],
          ]} />
        `}
      </td>
    </tr>
  `;
}

/** The health of a map in a word, and why. */
function health(map) {
  if (map.calibration === null) return { word: "no encoder", tone: "bad", why: "Its encoder is not installed." };
  if (map.places === 0) return { word: "empty", tone: "", why: "It has no places." };
  const day = map.last_day;
  const total = day ? day.recognized + day.ambiguous + day.unknown : 0;
  if (total >= 20 && day.unknown / total > 0.5) {
    return { word: "often lost", tone: "warn", why: "More than half of the answers of the last day were unknown." };
  }
  if (total >= 20 && day.ambiguous / total > 0.3) {
    return { word: "in doubt", tone: "warn", why: "Many answers of the last day were ambiguous." };
  }
  if (map.calibration.source === "encoder-default") {
    return { word: "not calibrated", tone: "", why: "It uses its encoder's thresholds." };
  }
  if (map.calibration_doubt) return { word: "badly calibrated", tone: "warn", why: map.calibration_doubt };
  const calibrated = `Calibrated by ${map.calibration.source}`;
  if (total < 20) return { word: "calibrated", tone: "", why: `${calibrated}; too few answers of the last day to say how good they are.` };
  if (day.recognized / total < 0.5) return { word: "in doubt", tone: "warn", why: `${calibrated}; less than half of the answers of the last day were recognized.` };
  return { word: "good", tone: "good", why: `${calibrated}; ${Math.round((100 * day.recognized) / total)} % of ${total} answers of the last day were recognized.` };
}

function Damaged({ damaged, open, close, changed }) {
  return html`
    <div class="trouble">
      <div><strong>${damaged.id} is damaged and out of service</strong><p>${damaged.reason}</p></div>
      ${may("admin") && html`
        <div class="actions">
          <button type="button" onClick=${() => open(html`<${Verify} map=${damaged.id} close=${close} />`)}>Verify</button>
          <button type="button" class="danger" onClick=${() => open(html`<${Delete} map=${damaged.id} close=${close} changed=${changed} />`)}>Delete</button>
        </div>
      `}
    </div>
  `;
}

function Create({ close, changed }) {
  const encoders = useResource((signal) => get("/encoders", {}, { signal }), []);
  const [fields, setFields] = useState({ id: "", encoder: "", precision: "half", keep: "thumbnail", description: "", same_place_radius: 5, same_place_height: 1.5, same_place_frames: 3, verification: true, index: "auto" });
  const change = (changes) => setFields((old) => ({ ...old, ...changes }));
  const create = async () => {
    const { encoder, ...others } = fields;
    await post("/maps", encoder ? { ...others, encoder } : others);
    say(`The map ${fields.id} was created.`);
    changed();
  };
  return html`
    <${FormDialog} title="Create a map" action="Create" ready=${fields.id !== ""} close=${close} send=${create}>
      <${Field} label="Id" hint="Small letters, digits, dot, hyphen, underscore. It cannot be changed.">
        <input required maxlength="64" pattern="[a-z0-9][a-z0-9._\\-]*" value=${fields.id} onInput=${(event) => change({ id: event.target.value })} autofocus autocomplete="off" spellcheck=${false} />
      <//>
      <div class="fields">
        <${Field} label="Encoder">
          <select value=${fields.encoder} onChange=${(event) => change({ encoder: event.target.value })}>
            <option value="">the service's default</option>
            ${(encoders.data?.items || []).filter((one) => !one.damaged).map((one) => html`<option value=${one.identity}>${one.name}</option>`)}
          </select>
        <//>
        <${Field} label="Precision">
          <select value=${fields.precision} onChange=${(event) => change({ precision: event.target.value })}>
            <option value="half">half: 16 bits a value</option>
            <option value="compressed">compressed: a quarter of that</option>
          </select>
        <//>
      </div>
      <${MapSettings} fields=${fields} change=${change} />
    <//>
  `;
}

function Edit({ map, close, changed }) {
  const resource = useResource((signal) => getTaggedMap(map, signal), [map]);
  return html`
    ${resource.data === undefined
      ? html`<${Dialog} title=${`Edit ${map}`} close=${close}><${Shown} resource=${resource}>${() => null}<//><//>`
      : html`<${EditForm} map=${map} read=${resource.data} close=${close} changed=${changed} />`}
  `;
}

function getTaggedMap(map) {
  return getTagged(mapPath(map));
}

const EDITED = ["description", "keep", "same_place_radius", "same_place_height", "same_place_frames", "verification", "alarms"];

function EditForm({ map, read, close, changed }) {
  const [fields, setFields] = useState({
    ...Object.fromEntries(EDITED.filter((name) => name in read.data).map((name) => [name, read.data[name]])),
    index: read.data.index.setting,
  });
  const save = async () => {
    await patch(mapPath(map), fields, read.tag);
    say(`The map ${map} was changed.`);
    changed();
  };
  return html`
    <${FormDialog} title=${`Edit ${map}`} action="Save" close=${close} send=${save}>
      <${MapSettings} fields=${fields} change=${(changes) => setFields((old) => ({ ...old, ...changes }))} />
    <//>
  `;
}

function Delete({ map, places, close, changed }) {
  const destroy = async () => {
    await remove(mapPath(map));
    say(`The map ${map} was deleted.`);
    changed();
  };
  return html`
    <${ByName} title=${`Delete ${map}`} name=${map} action="Delete the map" close=${close} send=${destroy}>
      <p>The map is deleted with ${places === undefined ? "everything in it" : `its ${counted(places, "place")}`}, its pictures, its calibration and its review. This cannot be undone; export it first if it may be wanted again. In an export ${SAVED}. ${NOT_SAVED}</p>
    <//>
  `;
}

function Verify({ map, close }) {
  const report = useResource((signal) => post(mapPath(map, "verify"), undefined, { signal }), [map]);
  return html`
    <${Dialog} title=${`Verify ${map}`} close=${close}>
      <${Shown} resource=${report}>
        ${(told) => html`
          <p>${told.ok ? "Nothing is damaged." : "The map is damaged."} ${integer(told.places)} places, ${bytes(told.checked_bytes)} were read.</p>
          ${told.problems.length > 0 && html`<ul class="stack">${told.problems.map((one) => html`<li class="mono small">${one}</li>`)}</ul>`}
        `}
      <//>
    <//>
  `;
}

function Import({ close, changed }) {
  const [file, setFile] = useState(null);
  const [id, setId] = useState("");
  const [state, setState] = useState({});
  const start = async (event) => {
    event.preventDefault();
    const controller = new AbortController();
    setState({ done: 0, total: file.size, controller });
    try {
      const progress = (done, total) => setState((old) => ({ ...old, done, total }));
      const job = await upload("/maps/import", file, { query: { id, background: true }, type: "application/octet-stream", progress, abort: controller.signal });
      setState({ job });
    } catch (error) {
      setState(error.name === "AbortError" ? {} : { error });
    }
  };
  const ended = (job) => {
    changed();
    if (job.state === "succeeded") {
      say(`The map ${job.map} was imported.`);
      close();
    }
  };
  const stop = () => {
    state.controller?.abort();
    close();
  };
  return html`
    <${Dialog} title="Import a map" close=${stop}>
      <form onSubmit=${start}>
        <${Field} label="File" hint="A map that this or another service exported.">
          <input type="file" accept=".tar,application/x-tar" required onChange=${(event) => setFile(event.target.files[0] || null)} />
        <//>
        <${Field} label="Id" hint=${everyMap.value ? "The one that the file states, if left out." : "One of the maps of your key."}>
          <input value=${id} maxlength="64" onInput=${(event) => setId(event.target.value)} autocomplete="off" spellcheck=${false} />
        <//>
        ${state.done !== undefined && html`
          <${Progress} done=${state.done} total=${state.total} label="Upload" />
          <p class="faint small" role="status">${bytes(state.done)} of ${bytes(state.total)} sent</p>
        `}
        ${state.job && html`<${JobProgress} job=${state.job} onEnd=${ended} what="Import" />`}
        ${state.error && html`<${Trouble} error=${state.error} />`}
        <footer>
          <button type="button" onClick=${stop}>${state.job ? "Close" : "Cancel"}</button>
          <button type="submit" class="primary" disabled=${!file || state.done !== undefined || state.job !== undefined}>Import</button>
        </footer>
      </form>
    <//>
  `;
}
