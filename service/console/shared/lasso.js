// Places caught with the lasso: compared, deleted, and what was learnt there, or waits to be learnt.
import { all, may, post, remove } from "./api.js";
import { Dialog, Name, say, Trouble } from "./elements.js";
import { counted, integer } from "./formats.js";
import { DeletePlaces } from "./delete_places.js";
import { lookPath, LookPicture, RemoveLooks } from "./looks.js";
import { mapPath } from "./map_path.js";
import { Picture, Thumbnail } from "./pictures.js";
import { Shown, useResource } from "./resource.js";
import { href } from "./router.js";
import { html, useState } from "./view.js";

const MOST_SHOWN = 24;

/** What the lasso caught: compared with one another, taught, or deleted. */
export function Caught({ map, plan, numbers, drop, changed }) {
  const [dialog, setDialog] = useState(null);
  const traverses = [...new Set(numbers.map((one) => plan.sequence[one]))].filter((one) => one >= 0).map((one) => plan.sequences[one]);
  const ids = numbers.map((one) => plan.ids[one]);
  const close = () => setDialog(null);
  const done = () => {
    drop();
    changed();
  };
  const destroy = () => setDialog(html`<${DeletePlaces} map=${map} order=${{ ids }} close=${close} done=${done} />`);
  const learn = () => setDialog(html`<${Learnt} map=${map} ids=${ids} close=${close} />`);
  return html`
    <section class="panel" aria-label="Within the lasso">
      <div class="spread"><h2>${counted(numbers.length, "place")}</h2><button type="button" class="quiet" aria-label="Drop the lasso" onClick=${drop}>✕</button></div>
      <ul class="thumbs narrow">${ids.slice(0, 6).map((id) => html`<li class="thumb" key=${id}><a href=${href("maps", map, "places", id)}><${Thumbnail} map=${map} place=${id} /><span class="name small"><${Name} text=${id} /></span></a></li>`)}</ul>
      ${numbers.length > 6 && html`<p class="faint small">and ${integer(numbers.length - 6)} more, of ${counted(traverses.length, "traverse")}</p>`}
      <div class="row">
        ${traverses.length > 1 && html`<a class="button wraps" href=${href("maps", map, "traverses", { query: traverses[1], reference: traverses[0] })}>Compare ${traverses[1]} with ${traverses[0]}</a>`}
        ${may("enrol") && html`
          <button type="button" onClick=${learn}>Learning …</button>
          <button type="button" class="danger" onClick=${destroy}>Delete …</button>
        `}
      </div>
      ${dialog}
    </section>
  `;
}

/** Looks of some places, and frames that runs propose as looks of them. */
async function readLearning(map, ids, signal) {
  const wanted = new Set(ids);
  const [looks, frames] = await Promise.all([
    all(mapPath(map, "looks"), {}, { signal }),
    all(mapPath(map, "review"), { labelled: false, limit: 200 }, { signal }),
  ]);
  return { looks: looks.filter((one) => wanted.has(one.place)), proposed: frames.filter((one) => wanted.has(one.answer.proposal?.place)) };
}

/** What was learnt at some places, which can be undone, and what waits to be learnt there. */
function Learnt({ map, ids, close }) {
  const told = useResource((signal) => readLearning(map, ids, signal), [map, ids]);
  const [step, setStep] = useState({ done: 0, of: 0 });
  const [removing, setRemoving] = useState(false);
  const [error, setError] = useState(null);
  const busy = step.of > 0;
  /** Do something with each of a list, one after the other; what was done stays if one fails. */
  const each = async (items, work) => {
    setError(null);
    try {
      for (const [number, one] of items.entries()) {
        setStep({ done: number, of: items.length });
        await work(one);
      }
      return true;
    } catch (problem) {
      setError(problem);
      return false;
    } finally {
      setStep({ done: 0, of: 0 });
      told.reload();
    }
  };
  const take = async (frames) => {
    const whole = await each(frames, (one) => post(mapPath(map, "review", String(one.id)), { place: one.answer.proposal.place, look: true }));
    if (whole) say(`${counted(frames.length, "look")} ${frames.length === 1 ? "was" : "were"} learnt.`);
  };
  const learnt = (told.data?.looks || []).filter((one) => one.run);
  if (removing) {
    return html`
      <${RemoveLooks} map=${map} looks=${learnt} title=${`Undo what was learnt at ${counted(ids.length, "place")}`} close=${() => setRemoving(false)} send=${async () => {
        for (const one of learnt) await remove(lookPath(map, one.place, one.name));
        say(`${counted(learnt.length, "look")} ${learnt.length === 1 ? "was" : "were"} removed.`);
        told.reload();
      }} />
    `;
  }
  return html`
    <${Dialog} title=${`Learning at ${counted(ids.length, "place")}`} close=${close} wide>
      ${error && html`<${Trouble} error=${error} close=${() => setError(null)} />`}
      <${Shown} resource=${told}>
        ${({ looks, proposed }) => html`
          <section class="stack" aria-label="Proposed">
            <h3>Proposed by runs <span class="faint">${integer(proposed.length)}</span></h3>
            ${proposed.length === 0
              ? html`<p class="faint">No run proposes a look here. A look of your own is added on the page of a place.</p>`
              : html`
                <ul class="thumbs narrow">${proposed.slice(0, MOST_SHOWN).map((one) => html`<li class="thumb" key=${one.id}><${Picture} path=${mapPath(map, "review", String(one.id), "picture")} version=${one.sha256} alt=${`Proposed for ${one.answer.proposal.place}`} /><span class="name small"><${Name} text=${one.answer.proposal.place} /></span></li>`)}</ul>
                <${More} of=${proposed} />
                <div class="row">
                  <button type="button" class="primary" disabled=${busy} onClick=${() => take(proposed)}>${busy ? `${step.done} of ${step.of} …` : `Learn ${counted(proposed.length, "look")}`}</button>
                  <a class="button" href=${href("maps", map, "review")}>Look at each in the review</a>
                </div>
              `}
          </section>
          <section class="stack" aria-label="Looks">
            <h3>Looks <span class="faint">${integer(looks.length)}, ${integer(learnt.length)} learnt</span></h3>
            ${looks.length > 0 && html`
              <ul class="thumbs narrow">${looks.slice(0, MOST_SHOWN).map((one) => html`<li class="thumb" key=${`${one.place} ${one.name}`}><a href=${href("maps", map, "places", one.place)}><${LookPicture} map=${map} look=${one} /><span class="under small"><${Name} text=${one.place} /><span class="faint">${one.run ? "learnt" : "added"}</span></span></a></li>`)}</ul>
              <${More} of=${looks} />
            `}
            ${learnt.length > 0 && html`<div class="row"><button type="button" class="danger" disabled=${busy} onClick=${() => setRemoving(true)}>Undo what was learnt here …</button></div>`}
          </section>
        `}
      <//>
    <//>
  `;
}

function More({ of }) {
  return of.length > MOST_SHOWN && html`<p class="faint small">and ${integer(of.length - MOST_SHOWN)} more</p>`;
}
