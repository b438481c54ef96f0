// Enrol a traverse: files, a folder, a video or bags become places, in pieces that can be gone on with, on the plan as it grows.
import { get, send } from "../shared/api.js";
import { Bags } from "../shared/bags.js";
import { digestOf, toEnrol } from "../shared/comparison.js";
import { Field, Head, Loading, NumberInput, Progress, say, Trouble, Typed } from "../shared/elements.js";
import { counted, integer } from "../shared/formats.js";
import { HEADING } from "../shared/heading.js";
import { mapPath } from "../shared/map_path.js";
import { planOfFrames, readPlan } from "../shared/plan_data.js";
import { droppedFiles, FrameReader, framesOf, isBag, thinned, traverseOf } from "../shared/recordings.js";
import { useResource, useStateOf } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { SmallPlan } from "../shared/small_plan.js";
import { html, useEffect, useMemo, useRef, useState } from "../shared/view.js";

const MOST_ITEMS = 16;
const MOST_BYTES = 24 * 2 ** 20;
const MOST_TOLD = 20;

export default function Enrol({ map }) {
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const [{ batch, files }, setFiles] = useState({ batch: 0, files: [] });
  const [options, setOptions] = useState({ sequence: null, camera: "", every: 1, metres: 0, seconds: 1, leaveStill: true });
  const change = (changes) => setOptions((old) => ({ ...old, ...changes }));
  const { sequence, camera, every, metres, seconds } = options;
  const name = useMemo(() => (files.length > 0 && files.every(isBag) ? "" : traverseOf(files)), [files]); // unless somebody chose another
  const read = useResource(() => framesOf(files, seconds), [batch, seconds]);
  const frames = useMemo(() => thinned(read.data?.frames || [], Math.max(1, Math.floor(every) || 1), metres || 0), [read.data, every, metres]);
  const ready = read.data !== undefined;
  const inputs = [map, batch, seconds, every, metres, camera, sequence];
  const plan = useResource(async (signal) => (frames.length > 0 ? toEnrol(map, frames, { sequence: sequence ?? name, chosen: sequence !== null, camera }, signal) : null), [...inputs, ready]);
  const sending = useSending(map, JSON.stringify([...inputs, options.leaveStill]));
  const [ofBags, setOfBags] = useState({ running: 0, stored: 0 });
  const busy = sending.state === "running" || ofBags.running > 0;
  const bags = files.filter(isBag);
  const take = (chosen) => {
    setFiles({ batch: batch + 1, files: chosen });
    if (sending.state === "done") change({ sequence: null }); // that name is of the frames before
  };
  const error = read.error || (ready && plan.error);
  return html`
    <${Head} title="Enrol" note=${`Frames of a traverse become places of ${map}.`} />
    <div class="columns">
      <section class="panel" aria-label="Frames"><${Source} take=${take} busy=${busy} /></section>
      <section class="panel" aria-label="Options">
        <${Options} options=${options} name=${plan.data?.sequence ?? name} change=${change} cameras=${cameras.data?.items || []} frames=${read.data?.frames || []} files=${files} busy=${busy} />
      </section>
    </div>
    ${error && html`<${Trouble} error=${error} again=${read.error ? undefined : plan.reload} />`}
    ${bags.length > 0 && html`<${Bags} map=${map} files=${bags} sequence=${sequence ?? ""} camera=${camera} busy=${busy} tell=${(changes) => setOfBags((old) => ({ running: old.running + (changes.running || 0), stored: old.stored + (changes.stored || 0) }))} />`}
    ${files.length > bags.length && !error && html`
      <section class="panel" aria-label="To enrol">
        <${Preview} read=${read.data} plan=${ready ? plan.data : undefined} name=${sequence ?? name} />
        <${Press} key=${batch} inputs=${JSON.stringify(inputs)} plan=${ready ? plan.data : undefined} sending=${sending} options=${options} rename=${(free) => change({ sequence: free })} drop=${() => take([])} />
        ${sending.state && html`<${Sent} map=${map} sending=${sending} />`}
        ${ready && plan.data && html`<${Poses} plan=${plan.data} />`}
      </section>
    `}
    <${Growing} map=${map} count=${sending.stored + ofBags.stored} />
  `;
}

/** What can be done with the frames as they are shown; what is pressed before they are is done then, if nothing changes. */
function Press({ inputs, plan, sending, options, rename, drop }) {
  const [pressed, setPressed] = useStateOf(inputs, false);
  const usable = plan && plan.wrong === null && plan.taken.length === 0;
  const start = (replace) => sending.start(plan, { ...options, sequence: plan.sequence, replace });
  useEffect(() => {
    if (!pressed || plan === undefined) return;
    setPressed(false);
    if (usable) start(false);
  }, [pressed, plan]);
  if (sending.state === "running") return html`<div class="row"><button type="button" onClick=${sending.stop}>Stop</button></div>`;
  if (plan?.taken.length > 0 && !sending.replaces) return html`<${Clash} plan=${plan} rename=${rename} replace=${() => start(true)} drop=${drop} />`;
  const action = sending.state === "stopped" ? "Go on" : plan ? `Enrol ${counted(plan.frames.length, "frame")}` : "Enrol";
  const enrol = () => (plan === undefined ? setPressed(true) : start(sending.replaces));
  return html`<div class="row"><button type="button" class="primary" disabled=${pressed || plan === null || (plan !== undefined && !usable && !sending.replaces)} onClick=${enrol}>${action}</button></div>`;
}

/** Places that have these ids already, which is no matter of course: nothing is sent before somebody has chosen. */
function Clash({ plan: { taken, frames, sequence, free }, rename, replace, drop }) {
  const names = [...new Set(taken.map((one) => one.sequence))];
  const where = names.length > 1 ? `in ${names.length} traverses` : names[0] === null ? "in no traverse" : html`in the traverse <strong>${names[0]}</strong>`;
  const [others, unread] = [taken.filter((one) => one.same === false), taken.some((one) => one.same === null)];
  const otherwise = "by another camera, mask or range of values";
  const differ = others.every((one) => one.picture) ? `these pictures, but ${otherwise}` : `other pictures${others.some((one) => one.picture === null) ? `, or these ${otherwise}` : ""}`;
  const how = unread ? "; over plain HTTP the browser cannot tell whether with these pictures" : others.length === 0 ? ", with these pictures" : `, ${others.length < taken.length ? `${integer(others.length)} of them ` : ""}with ${differ}`;
  const made = frames.some((one) => !one.given); // of the traverse's name
  return html`
    <div class="notice stack" role="alert">
      <p><strong>${integer(taken.length)} of these ${counted(frames.length, "frame")}</strong> exist already ${where}${how}.${!made && " Their ids are from places.csv, where they can be changed."}${unread && " A picture that is the same stays as it is."}</p>
      <div class="row">
        ${made && free && free !== sequence && html`<button type="button" class="primary" onClick=${() => rename(free)}>Rename to ${free}</button>`}
        <button type="button" class="danger" onClick=${replace}>Replace ${counted(taken.length, "place")}</button>
        <button type="button" onClick=${drop}>Cancel</button>
      </div>
    </div>
  `;
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
    <p class="faint small">Poses, times and ids come from a file places.csv among them: its first line names file, and may name id, x, y, z, heading, latitude, longitude, timestamp. ${HEADING} Bags of ROS (.mcap, .db3, .bag) are uploaded and read by the service. Poses in EXIF, and trajectories in files of their own, are read by the command line: <code>placerec enrol</code>.</p>
  `;
}

function Options({ options, name, change, cameras, frames, files, busy }) {
  const posed = frames.some((one) => one.fields.x !== undefined);
  const video = files.some((file) => file.type.startsWith("video/"));
  return html`
    <fieldset class="stack" disabled=${busy}>
      <legend class="hidden">How frames are enrolled</legend>
      <div class="fields">
        <${Field} label="Traverse" hint=${files.some(isBag) ? "A bag is called as its file, unless a name is given here." : "Also before the ids that are made from names."}><${Typed} maxlength="100" value=${options.sequence ?? name} change=${({ value }) => change({ sequence: value.trim() })} /><//>
        <${Field} label="Camera"><select value=${options.camera} onChange=${(event) => change({ camera: event.target.value })}><option value="">none named</option>${cameras.map(({ name }) => html`<option value=${name}>${name}</option>`)}</select><//>
        <${Field} label="Of the frames, each" hint="1: all of them."><${NumberInput} min="1" step="1" value=${options.every} change=${(every) => change({ every })} /><//>
        ${posed && html`<${Field} label="Metres between two"><${NumberInput} min="0" step="0.1" value=${options.metres} change=${(between) => change({ metres: between })} /><//>`}
        ${video && html`<${Field} label="Seconds between two of a video"><${Typed} type="number" min="0.1" step="0.1" value=${options.seconds} change=${({ valueAsNumber }) => change({ seconds: Math.max(0.1, valueAsNumber || 1) })} /><//>`}
      </div>
      ${video && html`<label class="field check"><input type="checkbox" checked=${options.leaveStill} onChange=${() => change({ leaveStill: !options.leaveStill })} /><span>Leave out frames of a video in which nothing has moved</span></label>`}
    </fieldset>
  `;
}

function Preview({ read, plan, name }) {
  if (plan === undefined) return html`<${Loading} what=${read ? "Comparing with the map" : "Reading the files"} />`;
  if (plan === null) return html`<h2>0 frames</h2>${read.remarks.map((one) => html`<p class="notice">${one}</p>`)}`;
  const { frames, sequence, known, wrong } = plan;
  const posed = frames.filter((one) => one.fields.x !== undefined || one.fields.latitude !== undefined).length;
  return html`
    <h2>${counted(frames.length, "frame")}${frames.length < read.frames.length && html` <span class="faint">of ${integer(read.frames.length)}</span>`}</h2>
    <p>${frames[0].id}${frames.length > 1 && html` to ${frames.at(-1).id}`}; ${posed === 0 ? "without poses" : posed === frames.length ? "all with poses" : `${integer(posed)} with poses`}.</p>
    ${sequence !== name && html`<p class="notice">The map has a traverse ${name} already; these frames are the traverse ${sequence}.</p>`}
    ${known > 0 && html`<p>${integer(known)} of them ${known === 1 ? "is" : "are"} there already, with ${known === 1 ? "this picture" : "these pictures"}; the enrolment goes on.</p>`}
    ${read.remarks.map((one) => html`<p class="notice">${one}</p>`)}
    ${wrong && html`<p class="notice" role="alert">${wrong}</p>`}
  `;
}

/** The poses that frames are to get. */
function Poses({ plan }) {
  const drawn = useMemo(() => planOfFrames(plan.frames), [plan]);
  return drawn && html`
    <${SmallPlan} plan=${drawn} look=${plan} label=${`The poses of these frames: ${integer(drawn.posed)}.`} />
    <p class="faint small">A line at each frame points along its heading.</p>
  `;
}

function Sent({ map, sending }) {
  const { state, done, total, created, replaced, same, left, refused, error, sequence } = sending;
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

const NOTHING_SENT = { state: null, replaces: false, sequence: "", done: 0, total: 0, stored: 0, created: 0, replaced: 0, same: 0, left: 0, refused: [], error: null };

/** Sending frames in batches, one after the other; what is stored is not sent again when it is gone on with.
 *
 * inputs: of the frames; what was sent of others is not shown.
 */
function useSending(map, inputs) {
  const [told, setTold] = useStateOf(inputs, NOTHING_SENT);
  const run = useRef(null);
  useEffect(() => () => run.current?.abort(), []);
  const start = async ({ frames }, options) => {
    const controller = new AbortController();
    run.current = controller;
    const reader = new FrameReader(options);
    const count = { ...NOTHING_SENT, state: "running", replaces: options.replace, sequence: options.sequence, total: frames.length, refused: [] };
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
    const { items } = await posted(map, entries, [], options, signal);
    wanted = batch.filter((one, number) => !noted(one, items[number], count, true));
  }
  if (wanted.length === 0) return;
  const { items } = await posted(map, wanted.map((one, number) => ({ ...entryOf(one, options), file: `frame${number}` })), wanted, options, signal);
  wanted.forEach((one, number) => noted(one, items[number], count, false));
}

async function posted(map, entries, files, { replace }, signal) {
  const form = new FormData();
  form.append("places", JSON.stringify(entries));
  files.forEach(({ blob }, number) => form.append(`frame${number}`, blob, `frame${number}`));
  return (await send("POST", mapPath(map, "places"), { query: { replace }, body: form, signal })).json();
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
