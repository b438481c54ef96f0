// Looks of places: pictures under other conditions by which a place is found as well; added, and taken away again.
import { get, may, remove, send } from "./api.js";
import { Facts, FormDialog, Moment, Name, Pill, say, Trouble } from "./elements.js";
import { counted, decimal, integer } from "./formats.js";
import { readable } from "./frames.js";
import { mapPath } from "./map_path.js";
import { Picture } from "./pictures.js";
import { Shown, useResource } from "./resource.js";
import { href } from "./router.js";
import { html, useRef, useState } from "./view.js";

export function lookPath(map, place, look, ...parts) {
  return mapPath(map, "places", place, "looks", look, ...parts);
}

export function LookPicture({ map, look }) {
  return html`<${Picture} path=${lookPath(map, look.place, look.name, "thumbnail")} alt=${`A look of ${look.place}`} />`;
}

/** What is known of a look: where it comes from, and how often it was right. */
export function LookFacts({ map, look }) {
  const judged = look.right + look.wrong;
  return html`
    <${Facts} rows=${[
      ["From", look.run ? html`the run <a href=${href("maps", map, "learning", { run: look.run })}><${Name} text=${look.run} /></a>` : "an operator"],
      ["Added", html`<${Moment} at=${look.created_at} />`],
      look.timestamp && ["Taken", html`<${Moment} at=${look.timestamp} />`],
      look.camera && ["Camera", look.camera],
      look.run && ["Right of those certain", judged ? `${integer(look.right)} of ${integer(judged)}` : "none yet"],
      look.least_score !== null && ["Believed from a score of", decimal(look.least_score)],
    ]} />
  `;
}

export function LookOrigin({ look }) {
  if (look.wrong > look.right) return html`<${Pill} tone="warn">${integer(look.wrong)} wrong<//>`;
  return look.run ? html`<${Pill} tone="on">learnt<//>` : html`<${Pill}>added<//>`;
}

/** Take looks away, after they were shown. */
export function RemoveLooks({ map, looks, title, close, send: destroy }) {
  return html`
    <${FormDialog} title=${title} action="Remove" danger close=${close} send=${destroy}>
      <p>No later query finds ${looks.length === 1 ? "the place by it" : "a place by them"}. The places stay, with their first frames and their other looks. A removed look can only come back by its picture.</p>
      <ul class="thumbs narrow">
        ${looks.slice(0, 24).map((one) => html`<li class="thumb" key=${`${one.place} ${one.name}`}><${LookPicture} map=${map} look=${one} /><span class="name small"><${Name} text=${one.place} /></span></li>`)}
      </ul>
      ${looks.length > 24 && html`<p class="faint small">and ${integer(looks.length - 24)} more</p>`}
    <//>
  `;
}

/** The looks of one place, on its page. */
export function PlaceLooks({ map, place }) {
  const looks = useResource((signal) => get(mapPath(map, "places", place, "looks"), {}, { signal }), [map, place]);
  const [error, setError] = useState(null);
  const [busy, setBusy] = useState(false);
  const [dialog, setDialog] = useState(null);
  const input = useRef(null);
  const close = () => setDialog(null);
  const add = async (files) => {
    setBusy(true);
    setError(null);
    try {
      for (const file of files) {
        const { blob, type, url } = await readable(file);
        URL.revokeObjectURL(url);
        const answer = await send("POST", mapPath(map, "places", place, "looks"), { body: blob, headers: { "Content-Type": type } });
        say(answer.status === 201 ? `A look was added to ${place}.` : `${place} has this look already.`);
      }
    } catch (problem) {
      setError(problem);
    }
    setBusy(false);
    looks.reload();
  };
  const takeAway = (look) => setDialog(html`
    <${RemoveLooks} map=${map} looks=${[look]} title=${`Remove a look of ${place}`} close=${close} send=${async () => {
      await remove(lookPath(map, place, look.name));
      say("The look was removed.");
      looks.reload();
    }} />
  `);
  return html`
    <section class="panel" aria-label="Looks">
      <div class="spread">
        <h2>Looks</h2>
        ${may("enrol") && html`
          <button type="button" disabled=${busy} onClick=${() => input.current.click()}>${busy ? "Adding …" : "Add a look"}</button>
          <input ref=${input} class="hidden" type="file" multiple accept="image/*" aria-label="Pictures of looks" tabindex="-1" onChange=${(event) => { add([...event.target.files]); event.target.value = ""; }} />
        `}
      </div>
      <p class="faint">Other pictures by which the place is found: at night, in snow, behind a parked car.</p>
      ${error && html`<${Trouble} error=${error} close=${() => setError(null)} />`}
      <${Shown} resource=${looks}>
        ${({ items }) => items.length === 0
          ? html`<p>None: it is found by the frame with which it was enrolled.</p>`
          : html`
            <p>${counted(items.length, "look")} beside the first frame.</p>
            <ul class="looks" aria-label="Looks">
              ${items.map((look) => html`
                <li class="look" key=${look.name}>
                  <${LookPicture} map=${map} look=${look} />
                  <${LookFacts} map=${map} look=${look} />
                  ${may("enrol") && html`<button type="button" class="small danger" aria-label=${`Remove the look ${look.name}`} onClick=${() => takeAway(look)}>Remove</button>`}
                </li>
              `)}
            </ul>
          `}
      <//>
      ${dialog}
    </section>
  `;
}
