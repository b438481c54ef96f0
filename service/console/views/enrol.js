// Enrol a traverse: files, a folder, a video or bags become places, in pieces that can be gone on with, on the plan as it grows.
import { get, send } from "../shared/api.js";
import { Bags, isBag } from "../shared/bags.js";
import { Field, Head, NumberInput, Progress, say, Trouble, Typed } from "../shared/elements.js";
import { counted, integer } from "../shared/formats.js";
import { mapPath } from "../shared/map_path.js";
import { readPlan } from "../shared/plan_data.js";
import { droppedFiles, FrameReader, framesOf, thinned } from "../shared/recordings.js";
import { useResource } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { SmallPlan } from "../shared/small_plan.js";
import { html, useEffect, useMemo, useRef, useState } from "../shared/view.js";

const MOST_ITEMS = 16;
const MOST_BYTES = 24 * 2 ** 20;
const MOST_TOLD = 20;

export default function Enrol({ map }) {
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const [files, setFiles] = useState([]);
  const [options, setOptions] = useState({ sequence: new Date().toLocaleDateString("en-CA"), camera: "", every: 1, metres: 0, seconds: 1, leaveStill: true });
  const [read, setRead] = useState({ frames: [], remarks: [] });
  const [error, setError] = useState(null);
  const sending = useSending(map);
  const change = (changes) => setOptions((old) => ({ ...old, ...changes }));
  const { sequence, seconds } = options;
  useEffect(() => {
    let gone = false;
    setError(null);
    framesOf(files, { prefix: sequence ? `${sequence}-` : "", seconds }).then((found) => gone || setRead(found), (problem) => gone || (setRead({ frames: [], remarks: [] }), setError(problem)));
    return () => {
      gone = true;
    };
  }, [files, sequence, seconds]);
  const chosen = useMemo(() => thinned(read.frames, Math.max(1, Math.floor(options.every) || 1), options.metres || 0), [read, options.every, options.metres]);
  const wrong = problemOf(chosen);
  const busy = sending.state === "running";
  const bags = files.filter(isBag);
  const [ofBags, setOfBags] = useState(0);
  return html`
    <${Head} title="Enrol" note=${`Frames of a traverse become places of ${map}.`} />
    <div class="columns">
      <section class="panel" aria-label="Frames"><${Source} take=${setFiles} busy=${busy} /></section>
      <section class="panel" aria-label="Options">
        <${Options} options=${options} change=${change} cameras=${cameras.data?.items || []} frames=${read.frames} files=${files} busy=${busy} />
      </section>
    </div>
    ${error && html`<${Trouble} error=${error} />`}
    ${bags.length > 0 && html`<${Bags} map=${map} files=${bags} sequence=${sequence} camera=${options.camera} enrolled=${(count) => setOfBags((old) => old + count)} />`}
    ${files.length > bags.length && html`
      <section class="panel" aria-label="To enrol">
        <${Preview} read=${read} chosen=${chosen} wrong=${wrong} />
        <div class="row">
          ${!busy && html`<button type="button" class="primary" disabled=${chosen.length === 0 || wrong !== null} onClick=${() => sending.start(chosen, options)}>${sending.state === "stopped" ? "Go on" : `Enrol ${counted(chosen.length, "frame")}`}</button>`}
          ${busy && html`<button type="button" onClick=${sending.stop}>Stop</button>`}
        </div>
        ${sending.state && html`<${Sent} map=${map} sending=${sending} sequence=${sequence} />`}
      </section>
    `}
    <${Growing} map=${map} count=${sending.stored + ofBags} />
  `;
}

/** Why these frames cannot be enrolled together; null if they can. */
function problemOf(frames) {
  const nameless = frames.find((one) => one.id === "");
  if (nameless) return `No id can be made from the name ${nameless.name}; give one in places.csv.`;
  const known = new Map();
  for (const one of frames) {
    if (known.has(one.id)) return `${known.get(one.id)} and ${one.name} would both have the id ${one.id}; give their ids in places.csv.`;
    known.set(one.id, one.name);
  }
  return null;
}

function Source({ take, busy }) {
  const [over, setOver] = useState(false);
  const [pictures, folder] = [useRef(null), useRef(null)];
  const drop = (event) => {
    setOver(false);
    if (!busy && event.dataTransfer) droppedFiles(event.dataTransfer).then(take, () => {});
  };
  const chosen = (event) => {
    take([...event.target.files]);
    event.target.value = "";
  };
  return html`
    <div class=${over ? "drop over" : "drop"} onDragOver=${(event) => { event.preventDefault(); setOver(true); }} onDragLeave=${() => setOver(false)} onDrop=${drop}>
      <p><strong>Drop pictures, a folder, a video or a bag here</strong></p>
      <div class="row">
        <button type="button" class="primary" disabled=${busy} onClick=${() => pictures.current.click()}>Choose files</button>
        <button type="button" disabled=${busy} onClick=${() => folder.current.click()}>Choose a folder</button>
      </div>
      <input ref=${pictures} class="hidden" type="file" multiple accept="image/*,video/*,.csv,.mcap,.bag,.db3" aria-label="Pictures, a video or bags" tabindex="-1" onChange=${chosen} />
      <input ref=${folder} class="hidden" type="file" webkitdirectory aria-label="A folder" tabindex="-1" onChange=${chosen} />
    </div>
    <p class="faint small">Poses, times and ids come from a file places.csv among them: its first line names file, and may name id, x, y, z, heading, latitude, longitude, timestamp. Bags of ROS (.mcap, .db3, .bag) are uploaded and read by the service. Poses in EXIF, and trajectories in files of their own, are read by the command line: <code>placerec enrol</code>.</p>
  `;
}

function Options({ options, change, cameras, frames, files, busy }) {
  const posed = frames.some((one) => one.fields.x !== undefined);
  const video = files.some((file) => file.type.startsWith("video/"));
  return html`
    <fieldset class="stack" disabled=${busy}>
      <legend class="hidden">How frames are enrolled</legend>
      <div class="fields">
        <${Field} label="Traverse" hint="Also before the ids that are made from names."><${Typed} maxlength="100" value=${options.sequence} change=${({ value }) => change({ sequence: value.trim() })} /><//>
        <${Field} label="Camera"><select value=${options.camera} onChange=${(event) => change({ camera: event.target.value })}><option value="">none named</option>${cameras.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select><//>
        <${Field} label="Of the frames, each" hint="1: all of them."><${NumberInput} min="1" step="1" value=${options.every} change=${(every) => change({ every })} /><//>
        ${posed && html`<${Field} label="Metres between two"><${NumberInput} min="0" step="0.1" value=${options.metres} change=${(between) => change({ metres: between })} /><//>`}
        ${video && html`<${Field} label="Seconds between two of a video"><${Typed} type="number" min="0.1" step="0.1" value=${options.seconds} change=${({ valueAsNumber }) => change({ seconds: Math.max(0.1, valueAsNumber || 1) })} /><//>`}
      </div>
      ${video && html`<label class="field check"><input type="checkbox" checked=${options.leaveStill} onChange=${() => change({ leaveStill: !options.leaveStill })} /><span>Leave out frames of a video in which nothing has moved</span></label>`}
    </fieldset>
  `;
}

function Preview({ read, chosen, wrong }) {
  const posed = chosen.filter((one) => one.fields.x !== undefined || one.fields.latitude !== undefined).length;
  return html`
    <h2>${counted(chosen.length, "frame")}${chosen.length < read.frames.length && html` <span class="faint">of ${integer(read.frames.length)}</span>`}</h2>
    ${chosen.length > 0 && html`<p>${chosen[0].id}${chosen.length > 1 && html` to ${chosen.at(-1).id}`}; ${posed === 0 ? "without poses" : posed === chosen.length ? "all with poses" : `${integer(posed)} with poses`}.</p>`}
    ${read.remarks.map((one) => html`<p class="notice">${one}</p>`)}
    ${wrong && html`<p class="notice" role="alert">${wrong}</p>`}
  `;
}

function Sent({ map, sending, sequence }) {
  const { state, done, total, created, replaced, same, left, refused, error } = sending;
  return html`
    <${Progress} done=${done} total=${total} label="Frames sent" />
    <p role="status">${integer(done)} of ${integer(total)}: ${integer(created)} new, ${integer(replaced)} replaced, ${integer(same)} were there${left > 0 && html`, ${integer(left)} left out as nothing had moved`}${refused.length > 0 && html`, ${integer(refused.length)} refused`}.</p>
    ${error && html`<${Trouble} error=${error} />`}
    ${refused.length > 0 && html`<ul class="stack" aria-label="Refused frames">${refused.slice(0, MOST_TOLD).map((one) => html`<li class="small"><strong>${one.name}</strong>: ${one.why}</li>`)}</ul>`}
    ${refused.length > MOST_TOLD && html`<p class="faint small">and ${integer(refused.length - MOST_TOLD)} more</p>`}
    ${state === "done" && html`<p class="row">
      <a class="button" href=${href("maps", map, "places", sequence ? { sequence } : {})}>See the places</a>
      ${sequence && html`<a class="button" href=${href("maps", map, "traverses", { query: sequence })}>Compare and align, or delete the traverse</a>`}
    </p>`}
  `;
}

/** The plan of the map, read again whenever more is stored. */
function Growing({ map, count }) {
  const plan = useResource((signal) => readPlan(map, signal), [map], { every: 60_000 });
  useEffect(() => {
    if (count > 0) plan.reload();
  }, [count]);
  if (!plan.data || plan.data.count === 0) return null;
  return html`
    <section class="panel" aria-label="The map">
      <h2>${counted(plan.data.places, "place")} in ${map}</h2>
      <${SmallPlan} plan=${plan.data} look=${plan.data.count} label=${`The plan of ${map}: ${integer(plan.data.count)} places.`} />
    </section>
  `;
}

const NOTHING_SENT = { state: null, done: 0, total: 0, stored: 0, created: 0, replaced: 0, same: 0, left: 0, refused: [], error: null };

/** Sending frames in batches, one after the other; what is stored is not sent again when it is gone on with. */
function useSending(map) {
  const [told, setTold] = useState(NOTHING_SENT);
  const run = useRef(null);
  useEffect(() => () => run.current?.abort(), []);
  const start = async (frames, options) => {
    const controller = new AbortController();
    run.current = controller;
    const reader = new FrameReader(options);
    const count = { ...NOTHING_SENT, state: "running", total: frames.length, refused: [] };
    const tell = () => setTold({ ...count, refused: [...count.refused] });
    tell();
    try {
      let batch = [];
      let size = 0;
      const flush = async () => {
        if (batch.length > 0) await sendBatch(map, batch, options, controller.signal, count);
        [batch, size] = [[], 0];
        tell();
      };
      for (const frame of frames) {
        if (controller.signal.aborted) break;
        const taken = await bytesOf(reader, frame, count);
        if (taken === null) continue;
        if (size + taken.blob.size > MOST_BYTES) await flush();
        batch.push({ frame, ...taken });
        size += taken.blob.size;
        if (batch.length >= MOST_ITEMS) await flush();
      }
      if (!controller.signal.aborted) await flush();
      count.state = controller.signal.aborted ? "stopped" : "done";
      if (count.state === "done") say(`${counted(count.created + count.replaced + count.same, "frame")} ${count.created + count.replaced + count.same === 1 ? "is" : "are"} enrolled.`);
    } catch (error) {
      count.state = "stopped";
      if (error.name !== "AbortError") count.error = error;
    }
    reader.close();
    tell();
  };
  return { ...told, start, stop: () => run.current?.abort() };
}

/** A frame's bytes; null if it is left out, or cannot be read, which is noted. */
async function bytesOf(reader, frame, count) {
  try {
    const taken = await reader.read(frame);
    if (taken === null) [count.left, count.done] = [count.left + 1, count.done + 1];
    return taken;
  } catch (error) {
    count.refused.push({ name: frame.name, why: error.message });
    count.done += 1;
    return null;
  }
}

function entryOf({ frame }, { sequence, camera }) {
  return { id: frame.id, ...frame.fields, ...(sequence && { sequence }), ...(camera && { camera }) };
}

/** Store a batch: where the browser can, digests go first, so that frames that are stored already are not sent again. */
async function sendBatch(map, batch, options, signal, count) {
  let wanted = batch;
  if (globalThis.crypto?.subtle) {
    const entries = await Promise.all(batch.map(async (one) => ({ ...entryOf(one, options), sha256: await digestOf(one.blob) })));
    const { items } = await posted(map, entries, [], signal);
    wanted = batch.filter((one, number) => !noted(one, items[number], count, true));
  }
  if (wanted.length === 0) return;
  const { items } = await posted(map, wanted.map((one, number) => ({ ...entryOf(one, options), file: `frame${number}` })), wanted, signal);
  wanted.forEach((one, number) => noted(one, items[number], count, false));
}

async function posted(map, entries, files, signal) {
  const form = new FormData();
  form.append("places", JSON.stringify(entries));
  files.forEach(({ blob }, number) => form.append(`frame${number}`, blob, `frame${number}`));
  return (await send("POST", mapPath(map, "places"), { body: form, signal })).json();
}

/** Note what became of a frame; whether that is the end of it. */
function noted({ frame }, item, count, first) {
  if (first && item.problem?.type.endsWith(":frame-needed")) return false;
  count.done += 1;
  if (item.problem) {
    count.refused.push({ name: frame.name, why: item.problem.detail || item.problem.title });
    return true;
  }
  count.stored += 1;
  if (item.change === "created") count.created += 1;
  else if (item.change === "unchanged") count.same += 1;
  else count.replaced += 1;
  return true;
}

async function digestOf(blob) {
  const bytes = new Uint8Array(await crypto.subtle.digest("SHA-256", await blob.arrayBuffer()));
  return Array.from(bytes, (one) => one.toString(16).padStart(2, "0")).join("");
}
