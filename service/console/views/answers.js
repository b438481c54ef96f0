// The answers that are stored: searched, saved as CSV, and the run of a session replayed on the plan.
import { get } from "../shared/api.js";
import { saveCsv } from "../shared/csv.js";
import { Dialog, ExactMoment, Facts, Field, Head, Loading, Name, Nothing, Verdict, Verdicts } from "../shared/elements.js";
import { clock, counted, decimal, exact, integer, metres, milliseconds, percent, poseText } from "../shared/formats.js";
import { mapPath } from "../shared/map_path.js";
import { Thumbnail } from "../shared/pictures.js";
import { readPlan } from "../shared/plan_data.js";
import { Shown, useResource } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { SmallPlan } from "../shared/small_plan.js";
import { html, useEffect, useMemo, useState } from "../shared/view.js";

const MOST = 500;
const SHOWN = 100;
const VERDICTS = ["recognized", "ambiguous", "unknown"];
const SPEEDS = { 1: "as it was", 5: "5 times", 20: "20 times" };
/** Milliseconds: a longer pause between two frames is cut short. */
const LONGEST_PAUSE = 2000;

export default function Answers({ map, query }) {
  const { session = "", verdict = "", camera = "", text = "", least = "", most = "" } = query;
  const answers = useResource((signal) => get(mapPath(map, "answers"), { limit: MOST, session, verdict, camera }, { signal }), [map, session, verdict, camera], { every: session ? undefined : 10_000 });
  const found = (answers.data?.items || []).filter((one) => fits(one, text, least, most));
  return html`
    <${Head} title="Answers" note=${answers.data && `${counted(answers.data.kept, "answer")} of ${map} stored, without their frames; at most ${MOST}.`}>
      <button type="button" disabled=${found.length === 0} onClick=${() => saveCsv(`${map}-answers.csv`, COLUMNS, found)}>Save as CSV</button>
      <button type="button" onClick=${answers.reload}>Refresh</button>
    <//>
    <div class="filters" role="search" aria-label="Filters">
      <${Field} label="Verdict"><select value=${verdict} onChange=${(event) => restate({ verdict: event.target.value })}><option value="">all</option>${VERDICTS.map((one) => html`<option>${one}</option>`)}</select><//>
      <${Field} label="Place, caller, camera"><input value=${text} onInput=${(event) => restate({ text: event.target.value })} spellcheck=${false} /><//>
      <${Field} label="Probability from"><input type="number" min="0" max="1" step="0.05" value=${least} onInput=${(event) => restate({ least: event.target.value })} /><//>
      <${Field} label="to"><input type="number" min="0" max="1" step="0.05" value=${most} onInput=${(event) => restate({ most: event.target.value })} /><//>
      ${camera && html`<button type="button" onClick=${() => restate({ camera: "" })}>All cameras</button>`}
      ${session && html`<button type="button" onClick=${() => restate({ session: "" })}>Leave the run</button>`}
    </div>
    <${Shown} resource=${answers}>
      ${(data) => html`
        ${session && data.items.length > 0 && html`<${Replay} key=${session} map=${map} session=${session} answers=${data.items} />`}
        ${found.length === 0
          ? html`<${Nothing} title="No answers">${data.kept === 0 ? "The map has not been asked since the service was started." : session && data.items.length === 0 ? "Those of this run are not stored any more, or do not fit." : "None fits the filters."}<//>`
          : html`<${Table} map=${map} items=${found} session=${session} />`}
      `}
    <//>
  `;
}

function fits(one, text, least, most) {
  const wanted = text.trim().toLowerCase();
  const named = [one.place, one.principal, one.camera, one.session, one.request_id, one.reason, ...one.matches.map((match) => match.place)];
  if (wanted && !named.some((part) => part?.toLowerCase().includes(wanted))) return false;
  if (least !== "" && !(one.probability >= Number(least))) return false;
  return most === "" || (one.probability !== null && one.probability <= Number(most));
}

const COLUMNS = [
  ["at", (one) => one.at], ["verdict", (one) => one.verdict], ["run", (one) => one.run], ["probability", (one) => one.probability], ["place", (one) => one.place],
  ["best", (one) => one.matches[0]?.place], ["score", (one) => one.score], ["margin", (one) => one.margin], ["decision", (one) => one.decision],
  ["threshold", (one) => one.threshold], ["reason", (one) => one.reason],
  ...["x", "y", "z", "latitude", "longitude", "heading", "spread"].map((name) => [name, (one) => one.pose?.[name]]),
  ...["camera", "session", "frame", "operation", "milliseconds", "request_id", "principal"].map((name) => [name, (one) => one[name]]),
];

function Table({ map, items, session }) {
  const [most, setMost] = useState(SHOWN);
  const [open, setOpen] = useState(null);
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Answers">
      <table>
        <thead><tr><th>When</th><th>This frame alone</th><th>The run</th><th class="number">Probability</th><th>Best match</th><th class="number">Score</th><th>Asked by</th><th>Run</th><th class="number">Took</th><th><span class="hidden">More</span></th></tr></thead>
        <tbody>
          ${items.slice(0, most).map((one) => html`
            <tr key=${`${one.request_id} ${one.at}`}>
              <td class="nowrap"><time datetime=${one.at} title=${exact(one.at)}>${clock(one.at)}</time></td>
              <td><${Verdict} verdict=${one.verdict} /></td>
              <td>${one.run ? html`<${Verdict} verdict=${one.run} />` : html`<span class="faint">–</span>`}</td>
              <td class="number">${percent(one.probability)}</td>
              <td>${one.matches.length > 0 ? html`<a href=${href("maps", map, "places", one.matches[0].place)}>${one.matches[0].place}</a>` : html`<span class="faint">${one.reason || "–"}</span>`}</td>
              <td class="number">${decimal(one.score)}</td>
              <td>${one.principal || one.camera || "–"}${one.principal && one.camera && html` <span class="faint small">${one.camera}</span>`}</td>
              <td class="nowrap">${one.session && one.session !== session ? html`<a href=${href("maps", map, "answers", { session: one.session })} aria-label=${`Replay the run ${one.session}`}>Replay</a>` : one.frame !== null ? html`frame ${integer(one.frame)}` : "–"}</td>
              <td class="number">${milliseconds(one.milliseconds)}</td>
              <td class="actions-cell"><button type="button" class="small" aria-label=${`More of the answer of ${exact(one.at)}`} onClick=${() => setOpen(one)}>More</button></td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
    ${items.length > most && html`<p><button type="button" onClick=${() => setMost(MOST)}>Show all ${integer(items.length)}</button></p>`}
    ${open && html`<${Dialog} title="An answer" wide close=${() => setOpen(null)}><${Details} map=${map} answer=${open} /><//>`}
  `;
}

function Details({ map, answer }) {
  return html`
    <${Facts} rows=${[
      ["This frame alone", html`<${Verdict} verdict=${answer.verdict} /> ${percent(answer.probability, 1)}`],
      answer.run && ["The run", html`<${Verdict} verdict=${answer.run} /> <span class="faint">as the robot was told</span>`],
      ["Asked", html`<${ExactMoment} at=${answer.at} />`],
      ["Place", answer.place || "–"],
      ["Pose", answer.pose ? `${poseText(answer.pose)} ± ${metres(answer.pose.spread)}` : "–"],
      ["Score", decimal(answer.score)],
      ["Decision value", html`${decimal(answer.decision)} <span class="faint">threshold ${decimal(answer.threshold)}</span>`],
      answer.reason && ["Reason", answer.reason],
      ["Asked by", [answer.principal, answer.client].filter(Boolean).join(", ") || "–"],
      answer.camera && ["Camera", answer.camera],
      answer.session && ["Session", `${answer.session}${answer.frame !== null ? `, frame ${answer.frame}` : ""}`],
      ["Operation", (answer.operation || "").replaceAll("_", " ")],
      ["Request", html`<code>${answer.request_id}</code>`],
    ]} />
    ${answer.matches.length > 0 && html`
      <h3>The best matches</h3>
      <ul class="thumbs narrow">
        ${answer.matches.map(({ place, score }) => html`<li class="thumb" key=${place}><a href=${href("maps", map, "places", place)}><${Thumbnail} map=${map} place=${place} /><span class="under small"><span class="name"><${Name} text=${place} /></span><span class="faint">${decimal(score)}</span></span></a></li>`)}
      </ul>
    `}
  `;
}

// The replay of a run

/** Where an answer was: its pose, else the pose of the place that it recognized. */
function pointOf(answer, plan) {
  if (answer.pose) {
    const point = plan.projection?.(answer.pose);
    if (point) return point;
  }
  const number = answer.place === null ? undefined : plan.index.get(answer.place);
  if (number === undefined || Number.isNaN(plan.px[number])) return null;
  return { x: plan.px[number], y: plan.py[number], heading: Number.isNaN(plan.angle[number]) ? null : plan.angle[number] };
}

function Replay({ map, session, answers }) {
  const plan = useResource((signal) => readPlan(map, signal), [map]);
  const run = useMemo(() => [...answers].reverse(), [answers]);
  const [step, setStep] = useState(0);
  const [playing, setPlaying] = useState(false);
  const [speed, setSpeed] = useState("5");
  const last = run.length - 1;
  useEffect(() => {
    if (!playing) return undefined;
    if (step >= last) {
      setPlaying(false);
      return undefined;
    }
    const pause = (new Date(run[step + 1].at) - new Date(run[step].at)) / Number(speed);
    const timer = setTimeout(() => setStep(step + 1), Math.min(LONGEST_PAUSE, Math.max(16, pause)));
    return () => clearTimeout(timer);
  }, [playing, step, speed, run]);
  const points = useMemo(() => (plan.data ? run.map((one) => pointOf(one, plan.data)) : []), [plan.data, run]);
  const marks = useMemo(() => marksOf(run, points, Math.min(step, last), session), [run, points, step]);
  const play = () => {
    if (!playing && step >= last) setStep(0);
    setPlaying(!playing);
  };
  const here = run[Math.min(step, last)];
  const located = points.filter(Boolean).length;
  return html`
    <section class="panel" aria-label="Replay">
      <div class="spread"><h2>The run ${session}</h2><span class="faint">${counted(run.length, "answer")} stored${plan.data?.posed > 0 && located < run.length ? `, ${integer(located)} with a place on the plan` : ""}</span></div>
      <div class="replay">
        ${plan.data === undefined ? html`<${Loading} what="Reading the plan" />` : html`<${SmallPlan} plan=${plan.data} label=${`The run on the plan of ${map}.`} marks=${marks} />`}
        <${Here} map=${map} answer=${here} number=${Math.min(step, last) + 1} of=${run.length} />
      </div>
      <${Timeline} run=${run} step=${Math.min(step, last)} />
      <div class="row">
        <button type="button" class="primary" onClick=${play}>${playing ? "Pause" : "Play"}</button>
        <label class="grow"><span class="hidden">Answer of the run</span><input type="range" min="0" max=${last} value=${Math.min(step, last)} aria-valuetext=${`${clock(here.at)}, ${here.verdict}`} onInput=${(event) => { setPlaying(false); setStep(event.target.valueAsNumber); }} /></label>
        <${Field} label="Speed" inline><select value=${speed} onChange=${(event) => setSpeed(event.target.value)}>${Object.entries(SPEEDS).map(([value, text]) => html`<option value=${value}>${text}</option>`)}</select><//>
      </div>
    </section>
  `;
}

function marksOf(run, points, step, session) {
  const before = points.slice(0, step + 1);
  const dots = before.flatMap((point, one) => (point ? [{ ...point, verdict: run[one].verdict, age: 0.3 }] : []));
  const known = before.filter(Boolean);
  const present = known.at(-1);
  if (!present) return { dots };
  const silent = points[step] === null; // where it was is not known at this answer
  const robot = { session, label: run[step].principal || run[step].camera || "", verdict: run[step].verdict, x: present.x, y: present.y, angle: present.heading, trail: known, silent };
  return { dots, robots: [robot] };
}

function Here({ map, answer, number, of }) {
  const best = answer.matches[0]?.place;
  return html`
    <div class="stack" aria-live="off">
      <div class="spread"><strong>${clock(answer.at)}</strong><span class="faint">${integer(number)} of ${integer(of)}${answer.frame !== null && html`, frame ${integer(answer.frame)}`}</span></div>
      <div class="spread"><${Verdicts} verdict=${answer.verdict} run=${answer.run} /><span>${percent(answer.probability)}</span></div>
      ${best ? html`<${Thumbnail} map=${map} place=${best} /><p><a href=${href("maps", map, "places", best)}>${best}</a> <span class="faint">best match, ${decimal(answer.score)}</span></p>` : html`<p class="faint">${answer.reason || "no match"}</p>`}
      <p class="faint small">${answer.pose ? `${poseText(answer.pose)} ± ${metres(answer.pose.spread)}` : "without a pose"}</p>
    </div>
  `;
}

function Timeline({ run, step }) {
  const counts = VERDICTS.map((name) => `${run.filter((one) => one.verdict === name).length} ${name}`).join(", ");
  return html`
    <div class="timeline" role="img" aria-label=${`The verdicts of the run: ${counts}`}>
      ${run.map((one, number) => html`<span class=${number === step ? `${one.verdict} here` : one.verdict}></span>`)}
    </div>
  `;
}
