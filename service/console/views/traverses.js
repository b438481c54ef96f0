// The traverses of a map, and two of them compared: how alike all their frames look, the path that alignment finds, and
// the truth where poses give it.
import { get, may, post, remove, send } from "../shared/api.js";
import { ByName, Facts, Field, FormDialog, Head, Loading, Moment, Nothing, Pill, say, Trouble } from "../shared/elements.js";
import { decimal, integer, milliseconds } from "../shared/formats.js";
import { JobProgress } from "../shared/jobs.js";
import { mapPath } from "../shared/map_path.js";
import { Matrix } from "../shared/matrix.js";
import { CalibrationOutcome } from "../shared/outcome.js";
import { Thumbnail } from "../shared/pictures.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useState } from "../shared/view.js";

export default function Traverses({ map, query }) {
  const traverses = useResource((signal) => get(mapPath(map, "sequences"), { limit: 1000 }, { signal }), [map]);
  return html`
    <${Head} title="Traverses" note=${`The traverses of ${map}, and how two of them fit.`} />
    <${Shown} resource=${traverses}>
      ${({ items }) => items.length === 0
        ? html`<${Nothing} title="No traverses">Places with a traverse appear here once they are enrolled.<//>`
        : html`
          <${Table} map=${map} items=${items} changed=${traverses.reload} />
          ${items.length > 1 && html`<${Compare} map=${map} items=${items} query=${query} />`}
        `}
    <//>
  `;
}

function Table({ map, items, changed }) {
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const destroy = (name) => async () => {
    await remove(mapPath(map, "sequences", name));
    say(`The traverse ${name} was deleted.`);
    changed();
  };
  const ask = (one) => setDialog(html`
    <${ByName} title=${`Delete ${one.name}`} name=${one.name} action="Delete the traverse" close=${close} send=${destroy(one.name)}>
      <p>Its ${integer(one.places)} places go at once. This cannot be undone.</p>
    <//>
  `);
  return html`
    <div class="table limited" tabindex="0" role="region" aria-label="Traverses">
      <table>
        <thead><tr><th>Traverse</th><th class="number">Places</th><th>First frame</th><th>Last frame</th><th><span class="hidden">Actions</span></th></tr></thead>
        <tbody>
          ${items.map((one) => html`
            <tr key=${one.name}>
              <td class="long"><a href=${href("maps", map, "places", { sequence: one.name })}>${one.name}</a></td>
              <td class="number">${integer(one.places)}</td>
              <td><${Moment} at=${one.first_at} /></td>
              <td><${Moment} at=${one.last_at} /></td>
              <td class="actions-cell">${may("enrol") && html`<button type="button" class="small danger" aria-label=${`Delete ${one.name}`} onClick=${() => ask(one)}>Delete</button>`}</td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
    ${dialog}
  `;
}

function Compare({ map, items, query }) {
  const names = items.map((one) => one.name);
  const asked = names.includes(query.query) ? query.query : names[1];
  const reference = names.includes(query.reference) ? query.reference : names.find((name) => name !== asked);
  const [job, setJob] = useStateOf(JSON.stringify([map, asked, reference]), null);
  const scores = useResource((signal) => readScores(map, asked, reference, signal), [map, asked, reference]);
  const there = scores.data !== undefined;
  const compared = useResource(async (signal) => (there ? get(mapPath(map, "similarity"), { query: asked, reference }, { signal }) : null), [map, asked, reference, there]);
  const choice = (name, value) => html`
    <select value=${value} onChange=${(event) => restate({ query: asked, reference, [name]: event.target.value })}>
      ${names.map((one) => html`<option value=${one}>${one}</option>`)}
    </select>
  `;
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const submit = (order) => post(mapPath(map, "align"), { sequence: asked, ...order }).then(setJob, (error) => setJob({ error }));
  const undo = (sequence = asked) => submit({ sequence, with: [] });
  const ask = () => setDialog(html`<${Align} names=${[asked, reference]} close=${close} send=${(poses) => submit({ with: [reference], poses })} />`);
  const askBack = () => setDialog(html`<${Undo} name=${asked} close=${close} send=${() => undo()} />`);
  return html`
    <section class="stack" aria-label="Comparison">
      <div class="filters">
        <${Field} label="Frames of">${choice("query", asked)}<//>
        <${Field} label="against">${choice("reference", reference)}<//>
        ${compared.data && html`<${Pill} tone=${compared.data.aligned ? "good" : ""}>${compared.data.aligned ? "aligned" : "not aligned"}<//>`}
        ${may("enrol") && html`
          <button type="button" onClick=${() => submit({ with: [reference], dry_run: true })}>Preview alignment</button>
          <button type="button" onClick=${ask}>Align …</button>
          ${compared.data?.aligned && html`<button type="button" onClick=${askBack}>Undo the alignment …</button>`}
        `}
      </div>
      ${job?.error && html`<${Trouble} error=${job.error} />`}
      ${job?.id && html`<section class="panel"><${Alignment} key=${job.id} job=${job} changed=${compared.reload} undo=${undo} /></section>`}
      ${scores.loading && html`<${Loading} what="Comparing all frames" />`}
      ${there && compared.loading && html`<${Loading} what="Looking for a path" />`}
      ${scores.error && html`<${Trouble} error=${scores.error} again=${scores.reload} />`}
      ${compared.error && html`<${Trouble} error=${compared.error} again=${compared.reload} />`}
      ${there && html`<${Comparison} key=${`${asked}/${reference}`} map=${map} data=${{ ...scores.data, ...compared.data }} />`}
      ${dialog}
    </section>
  `;
}

/** Before frames become the same places: what that changes. */
function Align({ names: [name, other], close, send }) {
  const [poses, setPoses] = useState(true);
  return html`
    <${FormDialog} title=${`Align ${name} with ${other}`} action="Align" close=${close} send=${() => send(poses)}>
      <p>Frames of both that show the same become one place: for verdicts, sessions, calibration, health and pruning. What an earlier alignment of them stored gives way. It can be undone here.</p>
      <label class="field check"><input type="checkbox" checked=${poses} onChange=${() => setPoses(!poses)} /><span>Frames without a pose get that of their counterpart</span></label>
    <//>
  `;
}

function Undo({ name, close, send }) {
  return html`
    <${FormDialog} title=${`Undo the alignment of ${name}`} action="Undo the alignment" close=${close} send=${send}>
      <p>Its frames are places of their own again, whichever traverses it was aligned with, and poses that were handed over are taken back.</p>
    <//>
  `;
}

/** The scores as bytes, to be drawn while the path is looked for; without it, as far as it is known yet. */
async function readScores(map, query, reference, signal) {
  const headers = { Accept: "application/octet-stream" };
  const answer = await send("GET", mapPath(map, "similarity"), { query: { query, reference }, headers, signal });
  const [rows, columns, low, high] = ["x-rows", "x-columns", "x-low", "x-high"].map((name) => Number(answer.headers.get(name)));
  return {
    bytes: new Uint8Array(await answer.arrayBuffer()),
    rows,
    columns,
    scale: { low, high },
    query: { sequence: query, places: null },
    reference: { sequence: reference, places: null },
    stretches: [],
    truth: null,
    counterparts: null,
    milliseconds: null,
  };
}

function Alignment({ job, changed, undo }) {
  const [result, setResult] = useState(null);
  const ended = (told) => {
    setResult(told.result);
    if (told.state !== "succeeded" || !told.result?.stored) return;
    changed();
    if (!back) say(`${told.result.sequence} was aligned.`, () => undo(told.result.sequence));
  };
  const back = job.arguments.with?.length === 0;
  const what = back ? "Undoing the alignment" : job.arguments.dry_run ? "Alignment, a dry run" : "Alignment";
  return html`
    <${JobProgress} job=${job} onEnd=${ended} what=${what} />
    ${result && html`<${Facts} rows=${[
      !back && ["Frames with a counterpart", `${integer(result.paired)} of ${integer(result.frames)}`],
      !back && ["Poses handed over", integer(result.poses_handed_over)],
      result.poses_taken_back > 0 && ["Poses taken back", integer(result.poses_taken_back)],
      ["Stored", result.stored ? "yes" : "no, a dry run"],
      result.calibration && ["Calibration", html`<${CalibrationOutcome} map=${job.map} told=${result.calibration} />`],
    ]} />`}
  `;
}

const LAYERS = { path: "path found", truth: "truth by poses", counterparts: "as aligned" };

function Comparison({ map, data }) {
  const there = Object.keys(LAYERS).filter((name) => (name === "path" ? data.stretches.length > 0 : data[name] !== null));
  const [layers, setLayers] = useState(["path", "truth"]);
  const [pair, setPair] = useState(null);
  const toggle = (name) => setLayers((old) => (old.includes(name) ? old.filter((one) => one !== name) : [...old, name]));
  const [row, column] = pair || bestPair(data);
  return html`
    <div class="plan">
      <div class="stack">
        <${Matrix} data=${data} layers=${layers} chosen=${[row, column]} choose=${setPair} />
        <div class="row">
          ${there.map((name) => html`<label class=${`row layer ${name}`}><input type="checkbox" checked=${layers.includes(name)} onChange=${() => toggle(name)} /><span class="swatch"></span> ${LAYERS[name]}</label>`)}
        </div>
      </div>
      <div class="stack">
        <section class="panel" aria-label="Pair">
          ${data.query.places && html`<${Frame} map=${map} id=${data.query.places[row]} note=${`frame ${integer(row + 1)} of ${data.query.sequence}`} />`}
          ${data.reference.places && html`<${Frame} map=${map} id=${data.reference.places[column]} note=${`frame ${integer(column + 1)} of ${data.reference.sequence}`} />`}
          <${Facts} rows=${[
            ["Score", decimal(scoreAt(data, row, column))],
            data.truth && ["Truth", data.truth[row] === null ? "no place near" : `frame ${integer(data.truth[row] + 1)}`],
            data.counterparts && ["Counterpart", data.counterparts[row] === null ? "none" : `frame ${integer(data.counterparts[row] + 1)}`],
          ]} />
        </section>
        <section class="panel">
          <${Facts} rows=${[
            ["Size", `${integer(data.rows)} × ${integer(data.columns)}`],
            ["Scores", `${decimal(data.scale.low)} to ${decimal(data.scale.high)}`],
            ["Stretches found", integer(data.stretches.length)],
            data.truth && ["On the truth", truthText(data)],
            data.milliseconds && !data.truth && ["Truth", "none: their frames have no poses of their own"],
            data.milliseconds && ["Took", milliseconds(data.milliseconds.total)],
          ]} />
        </section>
      </div>
    </div>
  `;
}

function Frame({ map, id, note }) {
  return html`
    <div>
      <${Thumbnail} map=${map} place=${id} />
      <div class="spread small"><a href=${href("maps", map, "places", id)}>${id}</a><span class="faint">${note}</span></div>
    </div>
  `;
}

function scoreAt({ bytes, columns, scale }, row, column) {
  return scale.low + (bytes[row * columns + column] / 255) * (scale.high - scale.low);
}

function bestPair({ stretches, rows, columns }) {
  const [first] = stretches;
  if (!first) return [Math.floor(rows / 2), Math.floor(columns / 2)];
  const middle = Math.floor(first.query.length / 2);
  return [first.query[middle], first.reference[middle]];
}

/** How many frames of the path lie where poses say. */
function truthText({ stretches, truth }) {
  let [right, all] = [0, 0];
  for (const { query, reference } of stretches) {
    query.forEach((row, one) => {
      if (truth[row] === null) return;
      all += 1;
      right += Math.abs(truth[row] - reference[one]) <= 3;
    });
  }
  return `${integer(right)} of ${integer(all)} within 3 frames`;
}
