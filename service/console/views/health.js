// The health of a map: what never matches, what matches everything, where to drive again; pruning and merging with
// what they would cost.
import { all, get, may, post } from "../shared/api.js";
import { Chart } from "../shared/chart.js";
import { ByName, Facts, Field, Head, Loading, Moment, Name, Pill, Trouble, VerdictMix } from "../shared/elements.js";
import { ALARMS } from "../shared/fleet.js";
import { counted, decimal, integer, metres, percent } from "../shared/formats.js";
import { JobProgress } from "../shared/jobs.js";
import { mapPath } from "../shared/map_path.js";
import { Thumbnail } from "../shared/pictures.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href } from "../shared/router.js";
import { html, useMemo, useState } from "../shared/view.js";

export default function Health({ map }) {
  const report = useResource((signal) => get(mapPath(map, "health"), {}, { signal }), [map]);
  return html`
    <${Head} title="Health" note=${`How ${map} serves, judged by its own frames and by its answers.`}>
      <button type="button" disabled=${report.loading} onClick=${report.reload}>Examine again</button>
    <//>
    ${report.loading && html`<${Loading} what="Comparing the map's frames with one another" />`}
    ${(report.data || report.error) && html`<${Shown} resource=${report}>${(data) => html`<${Report} map=${map} data=${data} />`}<//>`}
    ${may("admin") && html`<div class="columns"><${Prune} map=${map} /><${Merge} map=${map} /></div>`}
  `;
}

function Report({ map, data }) {
  const { answers, never_matched: silent, aliasing, gaps, gap_count: gapCount, gap_counts: byMeasure, retraverse, complete } = data;
  return html`
    ${!complete && html`<p class="notice">The map is large: a sample of ${integer(aliasing.examined)} of its ${integer(aliasing.of)} places was examined in the time there was.</p>`}
    ${data.calibration_doubt && html`<p class="notice">The map's own calibration is not to be trusted. ${data.calibration_doubt} <a href=${href("maps", map, "calibration")}>Calibrate it again, or go back to the encoder's</a></p>`}
    ${data.shared_routes.map((one) => html`<${OneRoute} map=${map} route=${one} />`)}
    <${Trends} map=${map} trends=${data.trends} />
    <div class="columns">
      <section class="panel">
        <h2>Answers</h2>
        <p><${VerdictMix} counts=${answers} /> of ${integer(answers.queries)} queries${answers.since && html` since <${Moment} at=${answers.since} />`}</p>
        <${Drift} answers=${answers} />
      </section>
      <section class="panel">
        <h2>Never matched</h2>
        <${Silent} map=${map} silent=${silent} places=${data.places} />
      </section>
    </div>
    <div class="columns">
      <section class="panel">
        <h2>Match everything</h2>
        <p class="faint">Places that are among the most alike of unusually many others, such as a bare wall.</p>
        <${Hubs} map=${map} items=${aliasing.hubs} count=${aliasing.hub_count} unit="times, expected" />
        ${aliasing.unsure.length > 0 && html`<h3>Often the best match of what was not recognized</h3><${Hubs} map=${map} items=${aliasing.unsure} count=${aliasing.unsure_count} unit="times, expected" />`}
      </section>
      <section class="panel">
        <h2>Look like other places <span class="faint">${integer(aliasing.alias_count)}</span></h2>
        <${Aliases} map=${map} items=${aliasing.aliases} count=${aliasing.alias_count} />
      </section>
    </div>
    <div class="columns">
      <section class="panel"><h2>Where to drive again</h2><${Stretches} map=${map} items=${retraverse} count=${data.retraverse_count} /></section>
      <section class="panel"><h2>Gaps <span class="faint">${integer(gapCount)}</span></h2><${Gaps} map=${map} items=${gaps} count=${gapCount} byMeasure=${byMeasure} /></section>
    </div>
  `;
}

const TRENDS = [
  ["worse_places", "worse", "worse_count", (one) => one.place],
  ["changed_places", "changed", "changed_count", (one) => one.place],
  ["quiet_stretches", "quiet", "quiet_count", (one) => one.first],
];

/** What has changed of places over time, with what to do about it; where it raised an alarm, since when. */
function Trends({ map, trends }) {
  const some = TRENDS.filter(([alarm, list]) => trends[list].length > 0 || trends.alarms.some((one) => one.alarm === alarm));
  return some.map(([alarm, list, count, placeOf]) => {
    const raised = trends.alarms.find((one) => one.alarm === alarm);
    return html`
      <section class=${raised ? "panel alarms" : "panel"} aria-label=${ALARMS[alarm]}>
        <div class="spread"><h2>${ALARMS[alarm]} <span class="faint">${integer(trends[count])}</span></h2>${raised && html`<span><${Pill} tone="bad">alarm<//> <${Moment} at=${raised.since} /></span>`}</div>
        ${trends.advice[alarm] && html`<p>${trends.advice[alarm]}</p>`}
        <ul class="stack">${trends[list].slice(0, 8).map((one) => html`<li class="small" key=${placeOf(one)}><a href=${href("maps", map, "places", placeOf(one))}><${Name} text=${placeOf(one)} /></a> <span class="faint">${one.sentence}</span></li>`)}</ul>
        <${More} shown=${Math.min(8, trends[list].length)} count=${trends[count]} />
      </section>
    `;
  });
}

function Drift({ answers }) {
  const weeks = answers.weeks.filter((week) => week.queries > 0);
  const data = useMemo(() => [weeks.map((week) => new Date(week.monday).getTime() / 1000), weeks.map((week) => week.unknown_rate), weeks.map((week) => week.mean_score)], [answers]);
  const trends = [["unknown answers", answers.unknown_trend, (one) => percent(one, 1)], ["scores", answers.score_trend, (one) => decimal(one, 4)]];
  return html`
    ${weeks.length > 1
      ? html`<${Chart} data=${data} height=${200} series=${[{ label: "share of unknown", tint: "ambiguous" }, { label: "mean score" }]} axes=${[{ label: "week", time: true }, { label: "" }]} scales=${{ y: [0, 1] }} label="Share of unknown answers and mean score by week" />`
      : html`<p class="faint">Drift is shown once there are two weeks of answers.</p>`}
    ${trends.map(([name, trend, written]) => trend && html`
      <p>${name}: ${trend.per_week > 0 ? "+" : ""}${written(trend.per_week)} a week ${trend.significant ? html`<${Pill} tone="warn">drifting<//>` : html`<span class="faint">within chance</span>`}</p>
    `)}
  `;
}

/** Traverses that show the same, one frame after the other, are no look-alikes: they are to be aligned. */
function OneRoute({ map, route: { sequence, other, frames } }) {
  return html`
    <section class="notice spread" aria-label="One route">
      <p><strong>${sequence}</strong> and <strong>${other}</strong> seem to be one route: ${integer(frames)} of their frames look like the other's, in the same order. As long as they are not aligned, answers there are ambiguous.</p>
      <a class="button" href=${href("maps", map, "traverses", { query: sequence, reference: other })}>Compare and align them</a>
    </section>
  `;
}

/** How many more there are than are shown. */
function More({ shown, count }) {
  return count > shown && html`<p class="faint small">and ${integer(count - shown)} more</p>`;
}

function PlaceLinks({ map, ids, count, most = 8 }) {
  return html`
    <ul class="thumbs narrow">
      ${ids.slice(0, most).map((id) => html`<li class="thumb" key=${id}><a href=${href("maps", map, "places", id)}><${Thumbnail} map=${map} place=${id} /><span class="name small"><${Name} text=${id} /></span></a></li>`)}
    </ul>
    <${More} shown=${Math.min(most, ids.length)} count=${count} />
  `;
}

function Silent({ map, silent, places }) {
  if (!silent) return html`<p class="faint">The map has not been queried yet.</p>`;
  return html`
    <p>${integer(silent.count)} of ${integer(places)} places were never the best match; ${integer(Math.round(silent.by_chance))} would be by chance.</p>
    ${silent.enough
      ? html`<${PlaceLinks} map=${map} ids=${silent.places} count=${silent.count} />`
      : html`<p class="faint">That says nothing yet: after ${counted(silent.queries, "query", "queries")}, of ${integer(silent.wanted)} that it takes.</p>`}
  `;
}

function Hubs({ map, items, count, unit }) {
  if (items.length === 0) return html`<p>None.</p>`;
  return html`
    <ul class="thumbs narrow">
      ${items.slice(0, 8).map((one) => html`
        <li class="thumb" key=${one.place}><a href=${href("maps", map, "places", one.place)}><${Thumbnail} map=${map} place=${one.place} /><span class="name small"><${Name} text=${one.place} /></span></a>
        <span class="faint small">${integer(one.count)} ${unit} ${decimal(one.expected, 1)}</span></li>
      `)}
    </ul>
    <${More} shown=${Math.min(8, items.length)} count=${count} />
  `;
}

function Aliases({ map, items, count }) {
  if (items.length === 0) return html`<p>None.</p>`;
  return html`
    <ul class="aliases">
      ${items.slice(0, 6).map((one) => html`
        <li class="alias">
          <a href=${href("maps", map, "places", one.place)}><${Thumbnail} map=${map} place=${one.place} /><span class="small"><${Name} text=${one.place} among=${[one.place, one.other]} /></span></a>
          <a href=${href("maps", map, "places", one.other)}><${Thumbnail} map=${map} place=${one.other} /><span class="small"><${Name} text=${one.other} among=${[one.place, one.other]} /></span></a>
          <span class="small">${decimal(one.score)} <span class="faint">own ${decimal(one.own)}</span></span>
        </li>
      `)}
    </ul>
    <${More} shown=${Math.min(6, items.length)} count=${count} />
  `;
}

function Stretches({ map, items, count }) {
  if (items.length === 0) return html`<p>Nowhere: no stretch is weak.</p>`;
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Stretches">
      <table>
        <thead><tr><th>Traverse</th><th>From</th><th>To</th><th>Why</th><th class="number">Weight</th></tr></thead>
        <tbody>
          ${items.slice(0, 20).map((one) => html`
            <tr>
              <td>${one.sequence}</td>
              <td><a href=${href("maps", map, "plan", { place: one.first })}>${one.first}</a></td>
              <td><a href=${href("maps", map, "plan", { place: one.last })}>${one.last}</a></td>
              <td class="small">${one.reasons.map((reason) => reason.replaceAll("-", " ")).join(", ")}</td>
              <td class="number">${decimal(one.weight, 1)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
    <${More} shown=${Math.min(20, items.length)} count=${count} />
  `;
}

const MEASURES = { distance: metres, time: (value) => `${decimal(value, 1)} s`, similarity: (value) => decimal(value) };

function Gaps({ map, items, count, byMeasure }) {
  if (items.length === 0) return html`<p>None.</p>`;
  return html`
    <p class="faint">${integer(byMeasure.distance)} in metres, which the plan draws; ${integer(byMeasure.time)} in seconds; ${integer(byMeasure.similarity)} where frames look unlike.</p>
    <div class="table" tabindex="0" role="region" aria-label="Gaps">
      <table>
        <thead><tr><th>Between</th><th>Measure</th><th class="number">Step</th><th class="number">Usual</th><th class="number">Times</th></tr></thead>
        <tbody>
          ${items.slice(0, 20).map((one) => html`
            <tr>
              <td><a href=${href("maps", map, "plan", { place: one.before })}>${one.before}</a> and ${one.after}</td>
              <td>${one.measure}</td>
              <td class="number">${(MEASURES[one.measure] || decimal)(one.value)}</td>
              <td class="number">${(MEASURES[one.measure] || decimal)(one.median)}</td>
              <td class="number">${decimal(one.severity, 1)}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
    <${More} shown=${Math.min(20, items.length)} count=${count} />
  `;
}

// Pruning and merging: a dry run first, whose report says what it would cost; then the same for good

const UNTRIED = { dry: true, running: false, job: null, report: null, error: null };

/** A trial of what is ordered, and then the work itself: as soon as something else is ordered, nothing is known of it. */
function useTrial(path, order) {
  const [state, setState] = useStateOf(JSON.stringify([path, order]), UNTRIED);
  const start = async (dry) => {
    setState({ ...UNTRIED, dry, running: true });
    try {
      const job = await post(path, { ...order, dry_run: dry });
      setState((old) => ({ ...old, job }));
    } catch (error) {
      setState({ ...UNTRIED, dry, error });
    }
  };
  const ended = (job) => setState((old) => ({ ...old, running: false, report: job.state === "succeeded" ? job.result : null }));
  return { ...state, preview: () => start(true), apply: () => start(false), ended };
}

function Prune({ map }) {
  const [loss, setLoss] = useState(1);
  const [dialog, setDialog] = useState(null);
  const trial = useTrial(mapPath(map, "prune"), { max_recall_loss: loss / 100 });
  const { report, job, dry } = trial;
  const removed = report?.removed ?? 0;
  return html`
    <section class="panel" aria-label="Prune">
      <h2>Prune</h2>
      <p class="faint">Deletes places whose neighbours can stand in for them.</p>
      <${Field} label=${html`Recall that may be lost: <strong>${decimal(loss, 1)} %</strong>`}>
        <input type="range" min="0" max="10" step="0.5" disabled=${trial.running} value=${loss} onInput=${(event) => setLoss(event.target.valueAsNumber)} />
      <//>
      <div class="row"><button type="button" disabled=${trial.running} onClick=${trial.preview}>Preview the loss</button></div>
      ${trial.error && html`<${Trouble} error=${trial.error} />`}
      ${job && html`<${JobProgress} key=${job.id} job=${job} onEnd=${trial.ended} what=${dry ? "Dry run" : "Pruning"} />`}
      ${report && html`
        <${Facts} rows=${[
          [dry ? "Would go" : "Gone", `${integer(removed)} of ${integer(report.places)} places`],
          ["Recall before", shareText(report.recall_before)],
          ["Recall after", shareText(report.recall_after)],
          ["Measured on", `${report.measured_on}, ${integer(report.queries)} queries`],
        ]} />
        ${removed > 0 && dry && html`<div class="row"><button type="button" class="danger" onClick=${() => setDialog(true)}>Delete ${integer(removed)} places</button></div>`}
      `}
      ${dialog && report && html`<${ByName} title=${`Prune ${map}`} name=${map} action="Delete the places" close=${() => setDialog(null)} send=${trial.apply}>
        <p>${integer(removed)} places go, with their pictures. This cannot be undone; export the map first if they may be wanted again.</p>
      <//>`}
    </section>
  `;
}

function shareText({ value, low, high }) {
  return html`${percent(value, 1)} <span class="faint">${percent(low)} to ${percent(high)}</span>`;
}

function Merge({ map }) {
  const maps = useResource((signal) => all("/maps", {}, { signal }), [map]);
  const [from, setFrom] = useState("");
  const [conflict, setConflict] = useState("refuse");
  const [dialog, setDialog] = useState(null);
  const trial = useTrial(mapPath(map, "merge"), { from, on_conflict: conflict });
  const { report, job, dry } = trial;
  const own = maps.data?.find((one) => one.id === map);
  const others = (maps.data || []).filter((one) => one.id !== map && one.encoder === own?.encoder);
  return html`
    <section class="panel" aria-label="Merge">
      <h2>Merge</h2>
      <p class="faint">Copies the places of another map of the same encoder into this one; the other stays as it is.</p>
      ${others.length === 0 ? html`<p>There is no other map of this encoder.</p>` : html`
        <fieldset class="fields" disabled=${trial.running} aria-label="What is merged">
          <${Field} label="From"><select value=${from} onChange=${(event) => setFrom(event.target.value)}><option value="">choose …</option>${others.map((one) => html`<option value=${one.id}>${one.id} (${integer(one.places)})</option>`)}</select><//>
          <${Field} label="Where names conflict"><select value=${conflict} onChange=${(event) => setConflict(event.target.value)}><option value="refuse">refuse</option><option value="rename">rename what comes</option><option value="skip">skip it</option></select><//>
        </fieldset>
        <div class="row"><button type="button" disabled=${!from || trial.running} onClick=${trial.preview}>Preview the merge</button></div>
      `}
      ${trial.error && html`<${Trouble} error=${trial.error} />`}
      ${job && html`<${JobProgress} key=${job.id} job=${job} onEnd=${trial.ended} what=${dry ? "Dry run" : "Merging"} />`}
      ${report && html`
        <p role="status">${mergeText(report, dry, from)}</p>
        ${report.coming > 0 && dry && report.conflicts.length === 0 && html`<div class="row"><button type="button" class="primary" onClick=${() => setDialog(true)}>Copy ${counted(report.coming, "place")}</button></div>`}
        <${Facts} rows=${[
          ["Skipped", integer(report.skipped.count)],
          report.conflicts.length > 0 && ["Conflicts", html`<ul>${report.conflicts.map((one) => html`<li>${one}</li>`)}</ul>`],
          ...(report.overlap ? overlapRows(report.overlap) : []),
        ]} />
      `}
      ${dialog && report && html`<${ByName} title=${`Merge into ${map}`} name=${map} action="Copy the places" close=${() => setDialog(null)} send=${trial.apply}>
        <p>${counted(report.coming, "place")} of ${from} come into ${map}.</p>
      <//>`}
    </section>
  `;
}

/** How much of the ground both maps have, by places of the other one that were asked here. */
function overlapRows({ examined, recognized, metres_apart: apart, pairs }) {
  return [
    ["Recognized here", `${integer(recognized)} of ${counted(examined, "place")} that were examined`],
    Number.isFinite(apart) && ["Their poses differ by", metres(apart)],
    pairs?.length > 0 && ["The most alike", html`<ul>${pairs.slice(0, 8).map((one) => html`<li>${one.place} and ${one.match} <span class="faint">${decimal(one.score)}</span></li>`)}</ul>`],
  ];
}

/** What a merge would bring, or has brought, in a sentence. */
function mergeText({ coming, known, conflicts, skipped }, dry, from) {
  const of = html`<strong>${from}</strong>`;
  const there = `${integer(known)} ${known === 1 ? "was" : "were"} there already`;
  if (!dry) return html`${counted(coming, "place")} of ${of} came; ${there}.`;
  if (conflicts.length > 0) return html`Nothing of ${of} can be copied as long as there are conflicts.`;
  const all = coming + known + skipped.count;
  const share = known === 0 ? `None of ${counted(all, "place")}` : known === all ? `All ${counted(all, "place")}` : `${integer(known)} of ${counted(all, "place")}`;
  return html`${share} of ${of} ${known < 2 ? "is" : "are"} there already; ${coming === 0 ? "nothing would come" : `${integer(coming)} would come`}.`;
}
