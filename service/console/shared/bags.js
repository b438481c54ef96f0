// Bags of ROS: uploaded in pieces, so that a broken upload goes on where it was, and enrolled by a job of the service.
import { get, post, send } from "./api.js";
import { freeName } from "./comparison.js";
import { Field, NumberInput, Progress, say, Trouble, Typed } from "./elements.js";
import { bytes, counted, integer } from "./formats.js";
import { JobProgress } from "./jobs.js";
import { mapPath } from "./map_path.js";
import { BAG, idOf } from "./recordings.js";
import { useStateOf } from "./resource.js";
import { href } from "./router.js";
import { html, useEffect, useRef, useState } from "./view.js";

const PIECE = 8 * 2 ** 20;

/** The name of a bag at the service: the same whenever the same file is chosen. */
function nameOf(file) {
  const [, kind] = BAG.exec(file.name);
  let hash = 0;
  for (const letter of `${file.name} ${file.size} ${file.lastModified}`) hash = (Math.imul(hash, 31) + letter.codePointAt(0)) >>> 0;
  const stem = file.name.replace(BAG, "").replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(0, 80) || "bag";
  return `${stem}-${hash.toString(16).padStart(8, "0")}.${kind.toLowerCase()}`;
}

/** Upload a bag from where it was left; tell gets the bytes that are there. */
async function upload(map, file, name, tell, signal) {
  const path = mapPath(map, "recordings", name);
  let { bytes: at } = await get(path, {}, { signal });
  tell(at);
  while (at < file.size) {
    const body = file.slice(at, at + PIECE);
    const answer = await send("PUT", path, { query: { offset: at }, body, headers: { "Content-Type": "application/octet-stream" }, signal });
    at = (await answer.json()).bytes;
    tell(at);
  }
}

const NO_OPTIONS = { topic: "", pose_topic: "", fixed_frame: "", moving_frame: "", every_metres: NaN, every_seconds: NaN, keep_standing: false, allow_lost_poses: false, align: false };

const MOST_APART = 1e6;

/** What the service would refuse of an order after the upload; null: nothing that is known before. */
function problemOf({ every_metres: metres, every_seconds: seconds }, sequence) {
  if ([metres, seconds].some((one) => !Number.isNaN(one) && !(one > 0 && one <= MOST_APART))) {
    return "A frame is taken every so many metres or seconds: more than 0, and at most a million.";
  }
  if (/\/|^\.\.?$/.test(sequence)) return "The name of a traverse has no slash, and is neither . nor ..";
  return null;
}

/** Bags among the chosen files: which topics and frames are taken, and each on its way into the map.
 *
 * busy: whether some are on their way, so that what is chosen stays; tell gets {running} as it grows, and {stored}.
 */
export function Bags({ map, files, sequence, camera, busy, tell }) {
  const [options, setOptions] = useState(NO_OPTIONS);
  const change = (changes) => setOptions((old) => ({ ...old, ...changes }));
  const order = {
    ...Object.fromEntries(Object.entries(options).filter(([, value]) => value !== "" && value !== false && !Number.isNaN(value))),
    ...(sequence && { sequence }),
    ...(camera && { camera }),
  };
  const wrong = problemOf(options, sequence);
  return html`
    <section class="panel" aria-label="Bags">
      <h2>${counted(files.length, "bag")}</h2>
      <fieldset class="stack" disabled=${busy}>
      <legend class="hidden">What is taken of bags</legend>
      <div class="fields">
        <${Field} label="Topic of the pictures" hint="The only one, if left out."><${Typed} maxlength="256" value=${options.topic} change=${({ value }) => change({ topic: value.trim() })} /><//>
        <${Field} label="Topic of the poses" hint="Such as /odom or /tf; without one, places have no poses."><${Typed} maxlength="256" value=${options.pose_topic} change=${({ value }) => change({ pose_topic: value.trim() })} /><//>
        ${options.pose_topic.includes("tf") && html`
          <${Field} label="Fixed frame, of /tf" hint="map or odom, if left out."><${Typed} maxlength="256" value=${options.fixed_frame} change=${({ value }) => change({ fixed_frame: value.trim() })} /><//>
          <${Field} label="Moving frame, of /tf" hint="The camera's, if left out."><${Typed} maxlength="256" value=${options.moving_frame} change=${({ value }) => change({ moving_frame: value.trim() })} /><//>
        `}
        <${Field} label="A frame every, metres"><${NumberInput} min="0" step="any" value=${options.every_metres} change=${(metres) => change({ every_metres: metres })} /><//>
        <${Field} label="A frame every, seconds"><${NumberInput} min="0" step="any" value=${options.every_seconds} change=${(seconds) => change({ every_seconds: seconds })} /><//>
      </div>
      <label class="field check"><input type="checkbox" checked=${options.keep_standing} onChange=${() => change({ keep_standing: !options.keep_standing })} /><span>Also frames in which nothing has moved</span></label>
      <label class="field check"><input type="checkbox" checked=${options.allow_lost_poses} onChange=${() => change({ allow_lost_poses: !options.allow_lost_poses })} /><span>Also a bag of which more than a tenth of the frames lose their pose</span></label>
      <label class="field check"><input type="checkbox" checked=${options.align} onChange=${() => change({ align: !options.align })} /><span>Then align the traverse with those that the map has</span></label>
      </fieldset>
      ${wrong && html`<p class="notice" role="alert">${wrong}</p>`}
      ${files.map((file) => html`<${Bag} key=${nameOf(file)} map=${map} file=${file} order=${order} wrong=${wrong} tell=${tell} />`)}
    </section>
  `;
}

const IDLE = { state: "waiting", job: null, result: null, error: null, taken: null };

/** One bag: its upload, its job, and what became of it, as long as the same is ordered. */
function Bag({ map, file, order, wrong, tell }) {
  const [sent, setSent] = useState(null); // bytes that are there; null: nothing was begun
  const [{ state, job, result, error, taken }, setState] = useStateOf(JSON.stringify(order), IDLE);
  const called = file.name.replace(BAG, ""); // unless somebody names the traverse
  const run = useRef(null);
  useEffect(() => () => run.current?.abort(), []);
  const start = async (more = {}) => {
    const controller = new AbortController();
    run.current = controller;
    setState({ ...IDLE, state: "running" });
    tell({ running: 1 });
    const name = nameOf(file);
    try {
      await upload(map, file, name, setSent, controller.signal);
      const ordered = await post(mapPath(map, "recordings", name), { sequence: called, named: order.sequence !== undefined, ...order, ...more });
      setState((old) => ({ ...old, job: ordered }));
    } catch (problem) {
      setState({ ...IDLE, state: "stopped", error: problem.name === "AbortError" ? null : problem });
      tell({ running: -1 });
    }
  };
  const onEnd = async (ended) => {
    tell({ running: -1 });
    const done = ended.state === "succeeded";
    setState((old) => ({ ...old, state: done ? "done" : "stopped", result: done ? ended.result : null }));
    if (!done) {
      if (ended.problem?.type.endsWith(":places-taken")) setState({ ...IDLE, state: "stopped", taken: { text: ended.problem.detail, free: await freeName(map, order.sequence || called) } });
      return;
    }
    const stored = ended.result.chosen - ended.result.failed.count;
    tell({ stored });
    say(`${counted(stored, "frame")} of ${file.name} ${stored === 1 ? "is" : "are"} enrolled.`);
  };
  const action = sent === null ? "Upload and enrol" : sent < file.size ? "Go on" : "Enrol again";
  return html`
    <section class="stack" aria-label=${file.name}>
      <div class="spread">
        <span><strong>${file.name}</strong> <span class="faint">${bytes(file.size)}</span></span>
        ${state === "running" && !job && html`<button type="button" onClick=${() => run.current.abort()}>Stop</button>`}
        ${(["waiting", "stopped"].includes(state) || result?.failed.count > 0) && !taken && html`<button type="button" class="primary" disabled=${wrong !== null} onClick=${() => start()}>${action}</button>`}
      </div>
      ${sent !== null && !job && !taken && state !== "done" && html`<${Progress} done=${sent} total=${file.size} label=${`${file.name}: bytes uploaded`} /><p class="faint small" role="status">${bytes(sent)} of ${bytes(file.size)} uploaded</p>`}
      ${error && html`<${Trouble} error=${error} />`}
      ${job && html`<${JobProgress} key=${job.id} job=${job} onEnd=${onEnd} what=${`Enrolling ${file.name}`} />`}
      ${taken && html`
        <div class="notice stack" role="alert">
          <p>${taken.text}</p>
          <div class="row">
            <button type="button" class="primary" onClick=${() => start({ sequence: taken.free, named: true, id_prefix: `${idOf(taken.free).slice(0, 60)}-` })}>Rename to ${taken.free}</button>
            <button type="button" class="danger" onClick=${() => start({ replace: true })}>Replace these places</button>
            <button type="button" onClick=${() => setState(IDLE)}>Cancel</button>
          </div>
        </div>
      `}
      ${result && html`<${Enrolled} map=${map} result=${result} />`}
    </section>
  `;
}

function Enrolled({ map, result }) {
  const changes = Object.entries(result.changes).map(([name, count]) => `${integer(count)} ${name}`).join(", ") || "nothing";
  return html`
    <p role="status">${integer(result.chosen)} of ${integer(result.frames)} frames were taken: ${changes}; ${integer(result.posed)} with poses${result.failed.count > 0 && html`; ${integer(result.failed.count)} refused`}.</p>
    ${result.remarks.map((one) => html`<p class="notice">${one}</p>`)}
    ${result.failed.items.length > 0 && html`<ul class="stack" aria-label="Refused frames">${result.failed.items.slice(0, 20).map((one) => html`<li class="small"><strong>${one.id}</strong>: ${one.problem.detail || one.problem.title}</li>`)}</ul>`}
    <p class="row"><a class="button" href=${href("maps", map, "places", { sequence: result.sequence })}>See the places</a><a class="button" href=${href("maps", map, "traverses", { query: result.sequence })}>Compare and align, or delete the traverse</a></p>
  `;
}
