// New ground: stretches of runs that left the map and came back, each accepted or rejected as one thing.
import { get, may, patch, post, remove, send } from "./api.js";
import { complain, Facts, FormDialog, Moment, Name, Nothing, say } from "./elements.js";
import { counted, decimal, integer, metres, poseText } from "./formats.js";
import { JobProgress } from "./jobs.js";
import { mapPath } from "./map_path.js";
import { Picture } from "./pictures.js";
import { readPlan } from "./plan_data.js";
import { Shown, useResource } from "./resource.js";
import { href } from "./router.js";
import { SmallPlan } from "./small_plan.js";
import { html, useMemo, useState } from "./view.js";

const MOST_SHOWN = 12;
const LOOKS_EVERY = 30_000;

export function useStretches(map) {
  return useResource(async (signal) => (await get(mapPath(map, "review", "stretches"), {}, { signal })).items, [map], { every: LOOKS_EVERY });
}

/** All stretches that wait. */
export function Stretches({ map, stretches, about }) {
  const { data: { learning }, tag } = about.data;
  const { new_ground: proposes, rejected_ground: rejected } = learning;
  const plan = useResource((signal) => readPlan(map, signal), [map]);
  const [taken, setTaken] = useState([]); // those that were accepted here, with their jobs
  const changed = () => {
    stretches.reload();
    plan.reload();
    about.reload();
  };
  const undone = (id) => {
    say("The places are deleted, and the stretch waits again.");
    setTaken((old) => old.filter(({ stretch }) => stretch.id !== id));
    changed();
  };
  const accepted = (stretch, job) => setTaken((old) => [...old, { stretch, job }]);
  return html`
    ${taken.map((one) => html`<${Accepted} key=${one.job.id} map=${map} ...${one} changed=${changed} undone=${() => undone(one.stretch.id)} />`)}
    <${Shown} resource=${stretches}>
      ${(items) => {
        const waiting = items.filter((one) => !taken.some(({ stretch }) => stretch.id === one.id));
        return waiting.length === 0
          ? taken.length === 0 && html`<${Nothing} title="No new ground waits">${proposes ? "Where a run leaves the map and comes back to it, its way appears here." : "This map proposes none: its settings under Stored frames say so."}<//>`
          : waiting.map((one) => html`<${Stretch} key=${one.id} map=${map} plan=${plan.data} stretch=${one} accepted=${accepted} changed=${changed} />`);
      }}
    <//>
    ${rejected.length > 0 && html`<${Rejected} map=${map} rejected=${rejected} tag=${tag} changed=${changed} />`}
  `;
}

/** Ground that was rejected; what is forgotten may be proposed again. */
function Rejected({ map, rejected, tag, changed }) {
  const [busy, setBusy] = useState(false);
  const forget = async (stretch) => {
    setBusy(true);
    try {
      await patch(mapPath(map), { learning: { rejected_ground: rejected.filter((one) => one.stretch !== stretch) } }, tag);
      say("A run may propose this ground again.");
    } catch (error) {
      complain(error);
    }
    changed();
    setBusy(false);
  };
  return html`
    <section class="panel" aria-label="Rejected ground">
      <h2>Rejected <span class="faint">${integer(rejected.length)}</span></h2>
      <p class="faint">No run proposes this ground again.</p>
      <ul class="stack">
        ${rejected.map((one) => html`
          <li class="spread" key=${one.stretch}>
            <span><${Name} text=${one.stretch} among=${rejected.map((other) => other.stretch)} /> <span class="faint"><${Moment} at=${one.at} />, at ${poseText(one.poses[0])}</span></span>
            ${may("admin") && html`<button type="button" class="small" disabled=${busy} aria-label=${`Forget that ${one.stretch} was rejected`} onClick=${() => forget(one.stretch)}>Forget</button>`}
          </li>
        `)}
      </ul>
    </section>
  `;
}

/** What is said of a stretch, its way on the plan, some of its frames, and the two things to do with it. */
function Stretch({ map, plan, stretch, accepted, changed }) {
  const { frames } = stretch;
  const [busy, setBusy] = useState(false);
  const [dialog, setDialog] = useState(null);
  const [all, setAll] = useState(false);
  const title = `From ${stretch.leaves} to ${stretch.returns}`;
  const pace = all ? 1 : Math.max(1, Math.ceil(frames.length / MOST_SHOWN));
  const accept = async () => {
    setBusy(true);
    try {
      accepted(stretch, await post(mapPath(map, "review", "stretches", stretch.id)));
    } catch (error) {
      complain(error);
      setBusy(false);
    }
  };
  const reject = () => setDialog(html`
    <${FormDialog} title=${`Reject ${counted(frames.length, "frame")} of new ground`} action="Reject" danger close=${() => setDialog(null)} send=${async () => {
      await send("DELETE", mapPath(map, "review", "stretches", stretch.id));
      say("The stretch was rejected.");
      changed();
    }}>
      <p>Its frames are thrown away, which cannot be undone. No run proposes this ground again until it is taken out of <code>rejected_ground</code> of the map’s setting <code>learning</code>.</p>
    <//>
  `);
  return html`
    <section class="panel" aria-label=${title}>
      <div class="spread">
        <h2>${title}</h2>
        <span class="faint">${counted(frames.length, "frame")}, ${metres(stretch.length)}, <${Moment} at=${stretch.at} /></span>
      </div>
      <p>${stretch.why}</p>
      ${stretch.missing > 0 && html`<p class="notice">${counted(stretch.missing, "frame")} of it ${stretch.missing === 1 ? "is" : "are"} gone, or labelled as something else.</p>`}
      <div class="columns">
        <${Way} map=${map} plan=${plan} stretch=${stretch} title=${title} />
        <${Facts} rows=${[
          ["Leaves the map at", html`<a href=${href("maps", map, "places", stretch.leaves)}><${Name} text=${stretch.leaves} /></a>`],
          ["Comes back at", html`<a href=${href("maps", map, "places", stretch.returns)}><${Name} text=${stretch.returns} /></a>`],
          ["Odometry misses by", `${metres(stretch.misclosure)}, ${decimal(stretch.misclosure_heading, 1)}°`, "Between where the run left the map and where it came back"],
          ["Standard deviation", `up to ${metres(Math.max(...frames.map((one) => one.spread)))}`, "Of the position, in the middle of the stretch"],
          ["Recognized elsewhere", counted(stretch.recognized_elsewhere, "frame")],
          ["The run", html`<a href=${href("maps", map, "answers", { session: stretch.run })}><${Name} text=${stretch.run} /></a>`],
        ]} />
      </div>
      <ul class="thumbs narrow" aria-label=${`Frames ${title}`}>
        ${frames.filter((_, number) => number % pace === 0).map((one) => html`
          <li class="thumb" key=${one.frame}>
            <${Picture} path=${mapPath(map, "review", String(one.frame), "picture")} alt=${`Frame ${one.frame}`} />
            <span class="under small"><span>± ${metres(one.spread)}</span><span class="faint">${one.verdict}</span></span>
          </li>
        `)}
      </ul>
      ${pace > 1 && html`<div><button type="button" class="small" onClick=${() => setAll(true)}>Show all ${integer(frames.length)}</button></div>`}
      ${may("enrol") && html`
        <div class="row">
          <button type="button" class="primary" disabled=${busy} onClick=${accept}>Accept: ${counted(frames.length, "new place")}</button>
          <button type="button" class="danger" disabled=${busy} onClick=${reject}>Reject …</button>
        </div>
      `}
      ${dialog}
    </section>
  `;
}

/** The way of a stretch on the plan, as wide as its standard deviation. */
function Way({ map, plan, stretch, title }) {
  const marks = useMemo(() => {
    const points = plan?.projection ? stretch.frames.map((one) => ({ ...plan.projection(one.pose), spread: one.spread })) : [];
    return { ways: [points.filter((one) => one.x !== undefined)] };
  }, [plan, stretch]);
  if (!plan?.projection) return null;
  return html`<${SmallPlan} plan=${plan} marks=${marks} look=${stretch.id} label=${`${title}, on the plan of ${map}.`} />`;
}

/** A stretch that becomes places, and the way back: they are deleted, and it waits again. */
function Accepted({ map, stretch, job, changed, undone }) {
  const [ended, setEnded] = useState(null);
  const onEnd = (told) => {
    setEnded(told);
    changed();
  };
  const undo = async () => {
    try {
      await remove(mapPath(map, "sequences", stretch.id));
      for (const { frame } of stretch.frames) await post(mapPath(map, "review", String(frame)), { clear: true });
      undone();
    } catch (error) {
      complain(error);
    }
  };
  return html`
    <section class="panel" aria-label="Accepted">
      <${JobProgress} job=${job} onEnd=${onEnd} what=${`Accept the stretch from ${stretch.leaves} to ${stretch.returns}`} />
      ${ended?.state === "succeeded" && html`
        <p class="row">
          <span>${counted(ended.result.places, "place")} in the traverse <${Name} text=${stretch.id} />.</span>
          <a class="button" href=${href("maps", map, "places", { sequence: stretch.id })}>See them</a>
          <button type="button" onClick=${undo}>Undo</button>
        </p>
      `}
    </section>
  `;
}
