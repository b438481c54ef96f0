// One place, large: what is kept of it, its neighbours, and what matched it lately.
import { get, may, patch, remove } from "./api.js";
import { ByName, ExactMoment, Facts, Field, FormDialog, Head, Moment, Name, say, Verdict } from "./elements.js";
import { decimal, integer, metres, milliseconds, percent, poseText } from "./formats.js";
import { HeadingArrow } from "./heading.js";
import { PlaceLooks } from "./looks.js";
import { mapPath } from "./map_path.js";
import { Thumbnail } from "./pictures.js";
import { readPlan, nearestTo, stepsAlong } from "./plan_data.js";
import { Shown, useResource } from "./resource.js";
import { go, href } from "./router.js";
import { html, useState } from "./view.js";

export function Place({ map, id }) {
  const place = useResource((signal) => get(mapPath(map, "places", id), {}, { signal }), [map, id]);
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  return html`
    <${Head} title=${id} note=${html`a place of <a href=${href("maps", map, "places")}>${map}</a>`}>
      ${place.data && html`
        <a class="button" href=${href("maps", map, "plan", { place: id })}>On the plan</a>
        ${may("enrol") && html`
          <button type="button" onClick=${() => setDialog(html`<${Edit} map=${map} place=${place.data} close=${close} changed=${place.set} />`)}>Edit</button>
          <button type="button" class="danger" onClick=${() => setDialog(html`<${Delete} map=${map} id=${id} close=${close} />`)}>Delete</button>
        `}
      `}
    <//>
    <${Shown} resource=${place}>
      ${(data) => html`
        <div class="columns">
          <section class="panel" aria-label="Picture"><${Thumbnail} map=${map} place=${id} version=${data.updated_at} /></section>
          <section class="panel" aria-label="Facts"><${About} map=${map} place=${data} /></section>
        </div>
        <${PlaceLooks} map=${map} place=${id} />
        <${Neighbours} map=${map} place=${data} />
        <${Lately} map=${map} id=${id} />
      `}
    <//>
    ${dialog}
  `;
}

function About({ map, place }) {
  const metadata = Object.entries(place.metadata);
  return html`
    <${Facts}
      rows=${[
        ["Pose", poseText(place.pose)],
        place.pose_of && ["Pose from", html`<a href=${href("maps", map, "places", place.pose_of)}>${place.pose_of}</a>`],
        ["Traverse", place.sequence ? html`<a href=${href("maps", map, "places", { sequence: place.sequence })}>${place.sequence}</a>` : "–"],
        ["Taken", html`<${ExactMoment} at=${place.timestamp} />`],
        ["Camera", place.camera || "–"],
        ["Regions", integer(place.regions)],
        ["Picture", place.picture],
        ["Enrolled", html`<${ExactMoment} at=${place.created_at} />`],
        ["Changed", html`<${ExactMoment} at=${place.updated_at} />`],
      ]}
    />
    <h2>Metadata</h2>
    ${metadata.length === 0
      ? html`<p class="faint">none</p>`
      : html`<${Facts} rows=${metadata.map(([name, value]) => [name, typeof value === "string" ? value : html`<code>${JSON.stringify(value)}</code>`])} />`}
  `;
}

function Neighbours({ map, place }) {
  const plan = useResource((signal) => readPlan(map, signal), [map]);
  if (!plan.data) return null;
  const along = stepsAlong(plan.data, place.id, 3);
  const near = nearestTo(plan.data, place.id, 6);
  return html`
    <div class="columns">
      ${along.length > 1 && html`
        <section class="panel">
          <h2>Along the traverse</h2>
          <${Row} map=${map} present=${place.id} items=${along.map((one) => ({ id: one.id, note: one.step === 0 ? "here" : `${one.step > 0 ? "+" : "−"}${Math.abs(one.step)}` }))} />
        </section>
      `}
      ${near.length > 0 && html`
        <section class="panel">
          <h2>Nearest by pose</h2>
          <${Row} map=${map} items=${near.map((one) => ({ id: one.id, note: metres(one.distance) }))} />
        </section>
      `}
    </div>
  `;
}

function Row({ map, items, present }) {
  return html`
    <ul class="thumbs narrow">
      ${items.map(({ id, note }) => html`
        <li class=${id === present ? "thumb chosen" : "thumb"} key=${id}>
          <a href=${href("maps", map, "places", id)} aria-current=${id === present ? "true" : undefined}>
            <${Thumbnail} map=${map} place=${id} />
            <span class="under small"><span class="name"><${Name} text=${id} /></span><span class="faint nowrap">${note}</span></span>
          </a>
        </li>
      `)}
    </ul>
  `;
}

function Lately({ map, id }) {
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const [camera, setCamera] = useState("");
  const matches = useResource((signal) => get(mapPath(map, "places", id, "matches"), { limit: 50, camera }, { signal }), [map, id, camera], { every: 20_000 });
  return html`
    <section class="panel">
      <div class="spread">
        <h2>Recent matches</h2>
        ${cameras.data?.items.length > 0 && html`
          <${Field} label="Camera" inline>
            <select value=${camera} onChange=${(event) => setCamera(event.target.value)}>
              <option value="">all</option>
              ${cameras.data.items.map(({ name }) => html`<option value=${name}>${name}</option>`)}
            </select>
          <//>
        `}
      </div>
      <${Shown} resource=${matches}>
        ${({ items, best, recognized, last_at: last }) => html`
          <p class="faint">
            The best match of ${integer(best)} answers since the counting began, recognized in ${integer(recognized)}${last && html`; last <${Moment} at=${last} />`}.
          </p>
          ${items.length === 0
            ? html`<p class="faint">None in the recent answers.</p>`
            : html`<${Answers} map=${map} items=${items} />`}
        `}
      <//>
    </section>
  `;
}

function Answers({ items }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Answers">
      <table>
        <thead><tr><th>When</th><th>Verdict</th><th class="number">Probability</th><th class="number">Rank</th><th class="number">Score</th><th>Camera</th><th>Session</th><th>Asked by</th><th class="number">Took</th></tr></thead>
        <tbody>
          ${items.map((one) => html`
            <tr>
              <td class="nowrap"><${Moment} at=${one.at} /></td>
              <td><${Verdict} verdict=${one.verdict} /></td>
              <td class="number">${percent(one.probability)}</td>
              <td class="number">${one.rank}</td>
              <td class="number">${decimal(one.score)}</td>
              <td>${one.camera || "–"}</td>
              <td class="nowrap">${one.session ? html`<span title=${one.session}>${one.session.slice(0, 8)}${one.frame !== null && html` <span class="faint">frame ${integer(one.frame)}</span>`}</span>` : "–"}</td>
              <td>${one.principal || "–"}</td>
              <td class="number">${milliseconds(one.milliseconds)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}

const METRIC = ["x", "y", "z", "heading"];
const GEOGRAPHIC = ["latitude", "longitude", "z", "heading"];

function Edit({ map, place, close, changed }) {
  const pose = place.pose || {};
  const [kind, setKind] = useState(pose.latitude !== undefined ? "geographic" : place.pose ? "metric" : "none");
  const [numbers, setNumbers] = useState(Object.fromEntries([...METRIC, ...GEOGRAPHIC].map((name) => [name, pose[name] ?? ""])));
  const [sequence, setSequence] = useState(place.sequence || "");
  const [timestamp, setTimestamp] = useState(place.timestamp || "");
  const [metadata, setMetadata] = useState(JSON.stringify(place.metadata, null, 2));
  const names = { metric: METRIC, geographic: GEOGRAPHIC, none: [] }[kind];
  const save = async () => {
    const undo = undoing(place);
    await patch(mapPath(map, "places", place.id), {
      pose: kind === "none" ? null : newPose(names, numbers, pose),
      sequence: sequence || null,
      timestamp: timestamp || null,
      metadata: metadataChanges(place.metadata, metadata),
    });
    const told = await get(mapPath(map, "places", place.id));
    changed(told);
    say(`${place.id} was changed.`, async () => changed(await patch(mapPath(map, "places", place.id), undo(told))));
  };
  return html`
    <${FormDialog} title=${`Edit ${place.id}`} action="Save" close=${close} send=${save}>
      <${Field} label="Pose">
        <select value=${kind} onChange=${(event) => setKind(event.target.value)}>
          <option value="none">none</option><option value="metric">metres in the map's frame</option><option value="geographic">latitude and longitude</option>
        </select>
      <//>
      ${names.length > 0 && html`
        <div class="fields narrow">
          ${names.map((name) => html`
            <${Field} label=${name}>
              <input type="number" step="any" required=${!["z", "heading"].includes(name)} value=${numbers[name]} onInput=${(event) => setNumbers({ ...numbers, [name]: event.target.value })} />
            <//>
          `)}
        </div>
        <${HeadingArrow} heading=${numbers.heading} geographic=${kind === "geographic"} />
      `}
      <div class="fields">
        <${Field} label="Traverse"><input maxlength="128" value=${sequence} onInput=${(event) => setSequence(event.target.value)} /><//>
        <${Field} label="Taken" hint="ISO 8601, such as 2026-11-20T10:00:00Z"><input value=${timestamp} onInput=${(event) => setTimestamp(event.target.value)} /><//>
      </div>
      <${Field} label="Metadata" hint="A JSON object.">
        <textarea class="mono" rows="5" spellcheck=${false} value=${metadata} onInput=${(event) => setMetadata(event.target.value)}></textarea>
      <//>
    <//>
  `;
}

/** A patch that brings a place's fields back to what they were. */
function undoing(place) {
  return (now) => ({
    pose: place.pose && { ...cleared(now.pose), ...place.pose },
    sequence: place.sequence,
    timestamp: place.timestamp,
    metadata: { ...cleared(now.metadata), ...place.metadata },
  });
}

function cleared(fields) {
  return Object.fromEntries(Object.keys(fields || {}).map((name) => [name, null]));
}

function newPose(names, numbers, old) {
  const given = names.filter((name) => numbers[name] !== "").map((name) => [name, Number(numbers[name])]);
  return { ...cleared(old), ...Object.fromEntries(given) };
}

function metadataChanges(old, text) {
  let read;
  try {
    read = JSON.parse(text);
  } catch {
    read = null;
  }
  if (read === null || typeof read !== "object" || Array.isArray(read)) {
    throw Object.assign(new Error("Write the metadata as a JSON object."), { title: "The metadata cannot be read" });
  }
  return { ...cleared(old), ...read };
}

function Delete({ map, id, close }) {
  const send = async () => {
    await remove(mapPath(map, "places", id));
    say(`${id} was deleted.`);
    go("maps", map, "places");
  };
  return html`
    <${ByName} title=${`Delete ${id}`} name=${id} action="Delete the place" close=${close} send=${send}>
      <p>No later query finds it. This cannot be undone.</p>
    <//>
  `;
}
