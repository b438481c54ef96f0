// The cameras of a map: what of their frames is ignored, drawn over a frame, and their intrinsics.
import { get, may, remove, send } from "../shared/api.js";
import { ByName, Facts, Field, Head, Moment, Nothing, say, Trouble } from "../shared/elements.js";
import { counted, percent } from "../shared/formats.js";
import { readable } from "../shared/frames.js";
import { mapPath } from "../shared/map_path.js";
import { areaOf, MaskEditor } from "../shared/mask_editor.js";
import { Picture, thumbnailPath } from "../shared/pictures.js";
import { Shown, useResource } from "../shared/resource.js";
import { html, useEffect, useState } from "../shared/view.js";

export default function Cameras({ map }) {
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const [edited, setEdited] = useState(null);
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const done = () => {
    setEdited(null);
    cameras.reload();
  };
  const ask = ({ name }) => setDialog(html`
    <${ByName} title=${`Delete the camera ${name}`} name=${name} action="Delete the camera" close=${close} send=${async () => {
      await remove(mapPath(map, "cameras", name));
      say(`The camera ${name} was deleted.`);
      done();
    }}>
      <p>Frames that name it are refused from then on. Places that were enrolled with it stay.</p>
    <//>
  `);
  return html`
    <${Head} title="Cameras" note="What of a camera's frames is ignored: a bonnet, a time stamp, the robot's own arm.">
      ${may("enrol") && !edited && html`<button type="button" class="primary" onClick=${() => setEdited({ name: "", mask: null, intrinsics: null })}>Add a camera</button>`}
    <//>
    ${edited && html`<${Editor} key=${edited.name} map=${map} camera=${edited} cancel=${() => setEdited(null)} done=${done} />`}
    <${Shown} resource=${cameras}>
      ${({ items }) => items.length === 0
        ? !edited && html`<${Nothing} title="No cameras">Frames need none. One is added to leave a part of its frames out.<//>`
        : html`<div class="columns">${items.map((one) => html`<${Card} key=${one.name} map=${map} camera=${one} edit=${setEdited} ask=${ask} editing=${edited?.name === one.name} />`)}</div>`}
    <//>
    ${dialog}
  `;
}

function Card({ map, camera, edit, ask, editing }) {
  const { name, mask, intrinsics, value_range: values } = camera;
  return html`
    <section class="panel" aria-label=${`Camera ${name}`}>
      <div class="spread"><h2>${name}</h2>${may("enrol") && html`<span class="row"><button type="button" class="small" disabled=${editing} aria-label=${`Edit ${name}`} onClick=${() => edit(camera)}>Edit</button><button type="button" class="small danger" aria-label=${`Delete ${name}`} onClick=${() => ask(camera)}>Delete</button></span>`}</div>
      <${Facts} rows=${[
        ["Mask", mask ? `${counted(mask.polygons.length, "area")}, about ${percent(mask.polygons.reduce((sum, one) => sum + areaOf(one), 0))} of the frame` : "none: all of the frame counts"],
        ["Intrinsics", intrinsics ? `${intrinsics.width} × ${intrinsics.height}, f ${intrinsics.fx.toFixed(0)}, ${intrinsics.distortion_model}` : "not known"],
        ...(values ? [["Values of 16 bits", values.join(" to ")]] : []),
        ["Changed", html`<${Moment} at=${camera.updated_at} />`],
      ]} />
      ${mask && html`<${Sample} map=${map} name=${name}><${Polygons} polygons=${mask.polygons} /><//>`}
    </section>
  `;
}

/** A frame of the camera that is enrolled, else any of the map. */
function useSample(map, name) {
  return useResource(async (signal) => {
    const of = name ? (await get(mapPath(map, "places"), { camera: name, limit: 1 }, { signal })).items : [];
    return of[0] || (await get(mapPath(map, "places"), { limit: 1 }, { signal })).items[0] || null;
  }, [map, name]);
}

function Sample({ map, name, children }) {
  const place = useSample(map, name);
  if (!place.data) return null;
  return html`<div class="mask-frame"><${Picture} path=${thumbnailPath(map, place.data.id)} version=${place.data.updated_at} alt=${`A frame with the mask of ${name}`} />${children}</div>`;
}

function Polygons({ polygons }) {
  return html`<svg viewBox="0 0 1 1" preserveAspectRatio="none" aria-hidden="true" class="mask">${polygons.map((one) => html`<polygon points=${one.map((corner) => corner.join(",")).join(" ")} />`)}</svg>`;
}

function Editor({ map, camera, cancel, done }) {
  const fresh = camera.name === "";
  const [name, setName] = useState(camera.name);
  const [polygons, setPolygons] = useState(camera.mask?.polygons || []);
  const [intrinsics, setIntrinsics] = useState(camera.intrinsics ? JSON.stringify(camera.intrinsics, null, 1) : "");
  const [values, setValues] = useState((camera.value_range || []).join(" to "));
  const [frame, setFrame] = useState(null);
  const [error, setError] = useState(null);
  useEffect(() => () => frame && URL.revokeObjectURL(frame.url), [frame]);
  const sample = useSample(map, camera.name);
  const open = sample.data === undefined && !sample.error ? null : sample.data;
  const choose = (event) => {
    const [file] = event.target.files;
    if (file) readable(file).then(setFrame, setError);
  };
  const save = async (event) => {
    event.preventDefault();
    setError(null);
    try {
      const body = { mask: polygons.length ? { polygons } : null, intrinsics: read(intrinsics), value_range: values.trim() ? values.match(/\d+/g)?.map(Number) || [] : null };
      await send("PUT", mapPath(map, "cameras", name.trim()), { json: body });
      say(`The camera ${name.trim()} was saved. Its mask holds for frames from now on.`);
      done();
    } catch (problem) {
      setError(problem);
    }
  };
  const shown = frame
    ? html`<img src=${frame.url} alt="The frame under the mask" />`
    : open && html`<${Picture} path=${thumbnailPath(map, open.id)} version=${open.updated_at} alt=${`Place ${open.id} under the mask`} />`;
  return html`
    <form class="panel" aria-label=${fresh ? "New camera" : `Edit ${camera.name}`} onSubmit=${save}>
      <h2>${fresh ? "A new camera" : `The camera ${camera.name}`}</h2>
      <div class="fields">
        <${Field} label="Name" hint="Frames name it with camera=…"><input required maxlength="128" disabled=${!fresh} value=${name} onInput=${(event) => setName(event.target.value)} autocomplete="off" spellcheck=${false} /><//>
        <${Field} label="Draw over" hint="It stays in this browser. Without one, a frame of the map is shown."><input type="file" accept="image/*" onChange=${choose} /><//>
      </div>
      <${MaskEditor} polygons=${polygons} change=${setPolygons}>${shown}<//>
      <${Field} label="Intrinsics" hint="JSON with width, height, fx, fy, cx, cy, distortion_model and distortion, as ROS has them; empty if they are not known.">
        <textarea class="mono" rows="3" spellcheck=${false} value=${intrinsics} onInput=${(event) => setIntrinsics(event.target.value)}></textarea>
      <//>
      <${Field} label="Values of 16 bits" hint="Which become black and white, such as 0 to 1023 of a camera of ten bits; empty for pictures of 8 bits, and of all 16.">
        <input class="mono" spellcheck=${false} autocomplete="off" value=${values} onInput=${(event) => setValues(event.target.value)} />
      <//>
      ${error && html`<${Trouble} error=${error} />`}
      <footer><button type="button" onClick=${cancel}>Cancel</button><button type="submit" class="primary" disabled=${!name.trim()}>Save</button></footer>
    </form>
  `;
}

function read(text) {
  if (!text.trim()) return null;
  try {
    return JSON.parse(text);
  } catch {
    throw Object.assign(new Error("Write the intrinsics as a JSON object, or leave them out."), { title: "The intrinsics cannot be read" });
  }
}
