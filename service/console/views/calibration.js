// When answers are believed: how probable they really are, what a threshold costs, and another one to try and apply.
import { getTagged, get, may, patch, post } from "../shared/api.js";
import { Chart } from "../shared/chart.js";
import { ByName, complain, Facts, Field, FormDialog, Head, Moment, Nothing, NumberInput, Pill, say, Trouble } from "../shared/elements.js";
import { decimal, integer, percent } from "../shared/formats.js";
import { JobProgress } from "../shared/jobs.js";
import { mapPath } from "../shared/map_path.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { html, useEffect, useMemo, useState } from "../shared/view.js";

export default function Calibration({ map }) {
  const state = useResource((signal) => getTagged(mapPath(map, "calibration"), {}, signal), [map]);
  const [dialog, setDialog] = useState(null);
  const [job, setJob] = useState(null);
  const close = () => setDialog(null);
  const own = state.data !== undefined && !ofEncoder(state.data.data.calibration);
  const calibrate = () => setDialog(html`<${Order} map=${map} own=${own} tag=${state.data?.tag} started=${setJob} close=${close} />`);
  const storeIt = () => setDialog(html`<${Store} map=${map} data=${state.data.data} tag=${state.data.tag} own=${own} changed=${state.reload} close=${close} />`);
  const giveUp = () => setDialog(html`<${GiveUp} map=${map} tag=${state.data.tag} changed=${state.reload} close=${close} />`);
  const ended = (told) => {
    if (told.state === "succeeded") {
      say(told.result?.stored ? "The calibration was stored." : job.arguments.dry_run ? "The dry run is done." : "The calibration in force stays: nothing would change.");
      state.reload();
    }
  };
  return html`
    <${Head} title="Calibration" note=${`When an answer of ${map} is believed.`}>
      ${may("admin") && html`<button type="button" class="primary" disabled=${state.data === undefined} onClick=${calibrate}>Calibrate</button>`}
    <//>
    ${job && html`<section class="panel"><${JobProgress} key=${job.id} job=${job} onEnd=${ended} what=${job.arguments.dry_run ? "Dry run" : "Calibration"} /></section>`}
    <${Shown} resource=${state}>${({ data, tag }) => html`<${State} map=${map} data=${data} tag=${tag} changed=${state.reload} giveUp=${giveUp} storeIt=${storeIt} />`}<//>
    ${dialog}
  `;
}

function ofEncoder(calibration) {
  return calibration.source === "encoder-default";
}

function GiveUp({ map, tag, changed, close }) {
  const send = async () => {
    await patch(mapPath(map), { calibration: null }, tag);
    say("The encoder's calibration is in force.");
    changed();
  };
  return html`
    <${ByName} title="Back to the encoder's calibration" name=${map} action="Give up its own" close=${close} send=${send}>
      <p>The map's own threshold, margin and curve are forgotten. This cannot be undone, but the map can be calibrated again.</p>
    <//>
  `;
}

/** What undoes the change of a map that was just answered: its calibration is put back whole, unless it was changed since. */
function putBack(map, before, { revision }, changed, failed) {
  const calibration = ofEncoder(before) ? null : { restore: before };
  return () => patch(mapPath(map), { calibration }, `"${revision}"`).then(changed, failed);
}

/** Store what a dry run has found: at once, or by the map's name where it replaces a calibration of the map's own. */
function Store({ map, data, tag, own, changed, close }) {
  const send = async () => {
    const edited = await patch(mapPath(map), { calibration: { measured_at: data.measured.at } }, tag);
    say("The calibration was stored.", putBack(map, data.calibration, edited, changed, complain));
    changed();
  };
  const action = "Store the calibration";
  const text = html`<p><${Change} data=${data} /></p>`;
  if (own) return html`<${ByName} title=${action} name=${map} action=${action} close=${close} send=${send}>${text}<p>It replaces the calibration that the map has of its own.</p><//>`;
  return html`<${FormDialog} title=${action} action=${action} close=${close} send=${send}>${text}<//>`;
}

/** What would be set, and what then became of the measured queries. */
function Change({ data: { calibration, measured, now, proposed } }) {
  const found = measured.report.calibration;
  const [one, other] = [calibration.margin, found.margin].map((margin) => decimal(margin, 4));
  return html`
    Would set the threshold <strong>${decimal(calibration.threshold)} → ${decimal(found.threshold)}</strong>${one !== other && html`, the margin ${one} → ${other}`};
    recognized <strong>${integer(now?.verdicts.recognized)} → ${integer(proposed.verdicts.recognized)}</strong> of the ${integer(measured.report.measurement.trials)} measured queries,
    precision ${percent(now?.precision.value, 1)} → ${percent(proposed.precision.value, 1)}.
  `;
}

function State({ map, data, tag, changed, giveUp, storeIt }) {
  const { calibration, measured } = data;
  const proposes = data.proposed && JSON.stringify(measured.report.calibration) !== JSON.stringify(calibration);
  const worse = measured?.report.change?.worse;
  return html`
    ${proposes && html`
      <section class=${worse ? "notice spread" : "notice good spread"} aria-label="Dry run">
        <p><${Change} data=${data} /> Nothing was stored${worse ? html`, and it cannot be: ${worse}` : "."}</p>
        ${may("admin") && !worse && html`<button type="button" class="primary" onClick=${storeIt}>Store it</button>`}
      </section>
    `}
    <div class="columns">
      <section class="panel">
        <h2>In force</h2>
        <${Facts} rows=${[
          ["Source", html`<${Pill} tone=${ofEncoder(calibration) ? "" : "good"}>${calibration.source}<//>`],
          ["Threshold", decimal(calibration.threshold, 4)],
          ["Margin", decimal(calibration.margin, 4)],
          calibration.frames && ["Frames it rests on", integer(calibration.frames)],
          ["Probabilities", calibration.curve ? "by its curve" : "none: it has no curve"],
        ]} />
        ${may("admin") && !ofEncoder(calibration) && html`<div class="row"><button type="button" class="danger" onClick=${giveUp}>Back to the encoder's</button></div>`}
      </section>
      ${measured && html`<${Measured} measured=${measured} />`}
    </div>
    ${measured
      ? html`<${Threshold} map=${map} data=${data} tag=${tag} changed=${changed} /><${Curves} data=${data} />`
      : html`<${Nothing} title="Nothing was measured yet">${may("admin") ? "Calibrate the map, or try it as a dry run: then this page shows how good its probabilities are, and what another threshold would change." : "Somebody with an admin key has to calibrate the map once."}<//>`}
  `;
}

function Measured({ measured }) {
  const { report } = measured;
  const { measurement: found } = report;
  return html`
    <section class="panel">
      <div class="spread"><h2>Measured</h2><span class="faint"><${Moment} at=${measured.at} />${!report.stored && ", not stored"}</span></div>
      <${Facts} rows=${[
        ["Asked", `${report.method}: ${integer(found.frames)} frames, ${integer(found.trials)} queries`],
        ["Right best matches", `${integer(found.right)} of ${integer(found.known)} known`],
        ["Area under precision-recall", decimal(found.auc_pr)],
        ["Area under ROC", decimal(found.auc_roc)],
        ["Cross-validated precision", share(found.cross_validated.precision)],
        ["Cross-validated recall", share(found.cross_validated.recall)],
        ...changeRows(report.change),
        ["Brier score", html`${decimal(found.cross_validated.reliability.brier)} <span class="faint">base rate ${decimal(found.cross_validated.reliability.brier_of_base_rate)}</span>`],
      ]} />
      ${report.warnings.map((one) => html`<p class="notice">${one}</p>`)}
    </section>
  `;
}

/** What becomes of answers that had no part in it, of either kind. */
function changeRows(change) {
  return [["Known places", change?.known], ["Strangers", change?.strangers]].filter(([, one]) => one).map(([name, { answers, before, after }]) => [
    `${name}, held out`,
    html`probability ${decimal(before.probability)} → ${decimal(after.probability)}, error ${decimal(before.error)} → ${decimal(after.error)} <span class="faint">${integer(answers)} answers</span>`,
  ]);
}

function share({ value, low, high }) {
  if (value === null) return "–";
  return html`${percent(value, 1)} <span class="faint">${percent(low)} to ${percent(high)}</span>`;
}

/** A slider for the threshold, which says what would change before anything does. */
function Threshold({ map, data, tag, changed }) {
  const { calibration, measured } = data;
  const points = measured.report.measurement.points;
  const [least, most] = useMemo(() => rangeOf(points, calibration.threshold), [points]);
  const inForce = { threshold: calibration.threshold, margin: calibration.margin };
  const [{ threshold, margin }, choose] = useStateOf(JSON.stringify(inForce), inForce);
  const change = (changes) => choose((old) => ({ ...old, ...changes }));
  const [settled, setSettled] = useState({ threshold, margin });
  const [error, setError] = useState(null);
  useEffect(() => {
    const timer = setTimeout(() => setSettled({ threshold, margin }), 150);
    return () => clearTimeout(timer);
  }, [threshold, margin]);
  // A dry run measures anew and leaves the map's tag as it is.
  const effect = useResource((signal) => get(mapPath(map, "calibration"), settled, { signal }), [map, settled, tag, measured.at]);
  const chosen = settled.threshold === threshold && settled.margin === margin;
  const present = chosen && effect.data?.measured?.at === measured.at ? effect.data : null;
  const same = threshold === inForce.threshold && margin === inForce.margin;
  const apply = async () => {
    setError(null);
    try {
      const edited = await patch(mapPath(map), { calibration: { threshold, margin } }, tag);
      say("The threshold was applied.", putBack(map, calibration, edited, changed, setError));
      changed();
    } catch (problem) {
      setError(problem);
    }
  };
  const readAgain = () => {
    setError(null);
    changed();
  };
  return html`
    <section class="panel" aria-label="Threshold">
      <h2>Another threshold</h2>
      <div class="columns">
        <div class="stack">
          <${Field} label=${html`Threshold <strong>${decimal(threshold, 4)}</strong>`}>
            <input type="range" min=${least} max=${most} step=${(most - least) / 500} value=${threshold} onInput=${(event) => change({ threshold: event.target.valueAsNumber })} />
          <//>
          <${Field} label=${html`Margin <strong>${decimal(margin, 4)}</strong>`}>
            <input type="range" min="0" max=${Math.max(0.05, 4 * calibration.margin)} step="0.0005" value=${margin} onInput=${(event) => change({ margin: event.target.valueAsNumber })} />
          <//>
          <div class="row">
            <button type="button" disabled=${same} onClick=${() => choose(inForce)}>As it is in force</button>
            ${may("admin") && html`<button type="button" class="primary" disabled=${same} onClick=${apply}>Apply</button>`}
          </div>
          ${error && html`<${Trouble} error=${error} again=${error.slug === "revision-mismatch" ? readAgain : undefined} />`}
        </div>
        ${effect.error && html`<${Trouble} error=${effect.error} />`}
        ${present?.now && html`<${Effect} now=${present.now} then=${present.then || present.now} />`}
      </div>
    </section>
  `;
}

function rangeOf(points, present) {
  const values = [...points.map((point) => point.threshold), present].filter(Number.isFinite);
  const [least, most] = [Math.min(...values), Math.max(...values)];
  return [least, most > least ? most : least + 0.1];
}

const ROWS = [
  ["recognized", (one) => one.verdicts.recognized, integer],
  ["ambiguous", (one) => one.verdicts.ambiguous, integer],
  ["unknown", (one) => one.verdicts.unknown, integer],
  ["precision", (one) => one.precision.value, (value) => percent(value, 1)],
  ["recall", (one) => one.recall.value, (value) => percent(value, 1)],
  ["false accepts", (one) => one.false_accept_rate.value, (value) => percent(value, 1)],
];

function Effect({ now, then }) {
  return html`
    <table aria-label="Effect of the change">
      <thead><tr><th class="wrapped">On the measured frames</th><th class="number">Now</th><th class="number">Then</th><th class="number">Change</th></tr></thead>
      <tbody>
        ${ROWS.map(([name, value, written]) => {
          const [before, after] = [value(now), value(then)];
          const change = before === null || after === null ? 0 : after - before;
          return html`
            <tr>
              <td>${name}</td><td class="number">${written(before)}</td><td class="number">${written(after)}</td>
              <td class="number">${change === 0 ? html`<span class="faint">=</span>` : `${change > 0 ? "+" : "−"}${written(Math.abs(change))}`}</td>
            </tr>
          `;
        })}
      </tbody>
    </table>
  `;
}

function Curves({ data }) {
  const { report } = data.measured;
  const { points, cross_validated: held } = report.measurement;
  const byRecall = useMemo(() => curveOf(points), [points]);
  const byThreshold = useMemo(() => [points.map((one) => one.threshold), points.map((one) => one.precision), points.map((one) => one.recall)], [points]);
  const unit = [0, 1.02];
  return html`
    <div class="columns">
      <section class="panel"><h2>Reliability</h2><${Reliability} reliability=${held.reliability} /></section>
      <section class="panel">
        <h2>Precision and recall</h2>
        <${Chart} data=${byRecall} series=${[{ label: "precision" }]} axes=${[{ label: "recall" }, { label: "precision" }]} scales=${{ x: unit, y: unit }} legend=${false}
          label=${`Precision-recall curve; the area under it is ${decimal(report.measurement.auc_pr)}`} />
      </section>
      <section class="panel">
        <h2>By threshold</h2>
        <${Chart} data=${byThreshold} series=${[{ label: "precision" }, { label: "recall", tint: "recognized" }]} axes=${[{ label: "threshold" }, { label: "share" }]} scales=${{ y: unit }}
          marks=${[{ x: data.calibration.threshold, tint: "faint", label: "in force" }, ...(data.proposed ? [{ x: report.calibration.threshold, tint: "accent", label: "dry run" }] : [])]} label="Precision and recall by threshold" />
      </section>
    </div>
  `;
}

/** Points by rising recall, one a recall. */
function curveOf(points) {
  const best = new Map();
  for (const { recall, precision } of points) best.set(recall, Math.max(precision, best.get(recall) ?? 0));
  const sorted = [...best].sort((a, b) => a[0] - b[0]);
  return [sorted.map(([recall]) => recall), sorted.map(([, precision]) => precision)];
}

/** What was promised against what came of it, with the intervals, as a drawing and as a table. */
function Reliability({ reliability }) {
  const { bins, ece, brier, answers } = reliability;
  const place = (value) => 100 - 100 * value;
  return html`
    <svg class="reliability" viewBox="-12 -4 118 118" role="img" aria-label=${`Reliability diagram of ${answers} answers; expected calibration error ${decimal(ece)}`}>
      <rect x="0" y="0" width="100" height="100" class="frame" />
      ${[0.25, 0.5, 0.75].map((one) => html`<line class="grid" x1="0" x2="100" y1=${place(one)} y2=${place(one)} /><line class="grid" y1="0" y2="100" x1=${100 * one} x2=${100 * one} />`)}
      <line class="ideal" x1="0" y1="100" x2="100" y2="0" />
      ${bins.map((bin) => html`
        <line class="interval" x1=${100 * bin.probability} x2=${100 * bin.probability} y1=${place(bin.right.low)} y2=${place(bin.right.high)} />
        <circle cx=${100 * bin.probability} cy=${place(bin.right.value ?? 0)} r=${1.4 + 2.6 * Math.sqrt(bin.right.of / answers)} />
      `)}
      ${[0, 0.5, 1].map((one) => html`<text x=${100 * one} y="106" text-anchor="middle">${one}</text><text x="-3" y=${place(one) + 1.5} text-anchor="end">${one}</text>`)}
      <text x="50" y="112" text-anchor="middle">stated probability</text>
    </svg>
    <p class="faint small">Each disc: how often answers of that probability were right, with its 95 % interval; on the line they keep what they promise. Error ${decimal(ece)}, Brier score ${decimal(brier)}.</p>
  `;
}

const METHODS = { map: "all frames of the map", sequence: "one traverse against the others", labels: "frames that were labelled in the review" };
const HINTS = {
  map: "The least reliable method: each frame is compared with its neighbours.",
  labels: "They are few, and of the doubtful frames.",
};
const BESIDE = {
  encoder: "the encoder's calibration, whose curve they move",
  map: "all frames of the map",
  none: "nothing",
};

function Order({ map, own, tag, started, close }) {
  const sequences = useResource((signal) => get(mapPath(map, "sequences"), { limit: 1000 }, { signal }), [map]);
  const [fields, setFields] = useState({ method: "map", sequence: "", rule: "precision", value: 0.95, dry: true, beside: "encoder", typed: "" });
  const change = (changes) => setFields((old) => ({ ...old, ...changes }));
  const names = (sequences.data?.items || []).map((one) => one.name);
  const aimed = fields.method !== "labels" || fields.beside !== "encoder";
  const replaces = own && !fields.dry;
  const ready = (fields.method !== "sequence" || names.length > 1) && (!replaces || fields.typed === map);
  const order = async () => {
    const { method, sequence, rule, value, dry, beside } = fields;
    const target = rule === "mean_of_negatives" ? { rule } : { rule, value };
    const body = { method, dry_run: dry, background: true, ...(aimed && { target }) };
    if (method === "sequence") body.sequence = sequence || names[0];
    if (method === "labels") body.beside = beside;
    started(await post(mapPath(map, "calibrate"), body, { headers: tag && !dry ? { "If-Match": tag } : {} }));
  };
  return html`
    <${FormDialog} title=${`Calibrate ${map}`} action=${fields.dry ? "Try it" : "Calibrate"} close=${close} send=${order} ready=${ready}>
      <${Field} label="Ask" hint=${HINTS[fields.method]}>
        <select value=${fields.method} onChange=${(event) => change({ method: event.target.value })}>
          ${Object.entries(METHODS).map(([id, text]) => html`<option value=${id}>${text}</option>`)}
        </select>
      <//>
      ${fields.method === "sequence" && html`
        <${Field} label="Traverse"><select value=${fields.sequence} onChange=${(event) => change({ sequence: event.target.value })}>${names.map((one) => html`<option value=${one}>${one}</option>`)}</select><//>
      `}
      ${fields.method === "labels" && html`
        <${Field} label="They join">
          <select value=${fields.beside} onChange=${(event) => change({ beside: event.target.value })}>
            ${Object.entries(BESIDE).map(([id, text]) => html`<option value=${id}>${text}</option>`)}
          </select>
        <//>
      `}
      ${aimed && html`<div class="fields">
        <${Field} label="Target">
          <select value=${fields.rule} onChange=${(event) => change({ rule: event.target.value, value: event.target.value === "precision" ? 0.95 : 0.01 })}>
            <option value="precision">precision of recognized answers</option>
            <option value="false_accept_rate">unknown places that are recognized</option>
            <option value="mean_of_negatives">mean of unknown places</option>
          </select>
        <//>
        ${fields.rule !== "mean_of_negatives" && html`<${Field} label="Share"><${NumberInput} min="0.001" max="0.999" step="any" value=${fields.value} change=${(value) => change({ value })} /><//>`}
      </div>`}
      <label class="field check"><input type="checkbox" checked=${fields.dry} onChange=${() => change({ dry: !fields.dry })} /><span>Dry run: only measure, store nothing</span></label>
      ${replaces && html`
        <${Field} label=${html`Type <code>${map}</code> to replace the calibration that it has of its own`}>
          <input value=${fields.typed} onInput=${(event) => change({ typed: event.target.value })} autocomplete="off" spellcheck=${false} />
        <//>
      `}
    <//>
  `;
}
