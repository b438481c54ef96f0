// The queries of a map as they are answered: verdict, probability, who asked, and why.
import { epoch, follow, get, key, may } from "../shared/api.js";
import { Bar, Dialog, ExactMoment, Facts, Field, Head, Name, Nothing, Pill, Trouble, Verdicts } from "../shared/elements.js";
import { changeText, clock, decimal, exact, integer, metres, percent, poseText } from "../shared/formats.js";
import { blobOf, handedOver } from "../shared/frames.js";
import { mapPath } from "../shared/map_path.js";
import { Picture, Thumbnail } from "../shared/pictures.js";
import { Timings } from "../shared/answer.js";
import { useResource } from "../shared/resource.js";
import { go, href } from "../shared/router.js";
import { html, useEffect, useRef, useState } from "../shared/view.js";

const MOST = 300;
const VERDICTS = ["recognized", "ambiguous", "unknown"];

export default function Live({ map }) {
  const about = useResource((signal) => get(mapPath(map), {}, { signal }), [map]);
  const [wanted, setWanted] = useState(VERDICTS);
  const [text, setText] = useState("");
  const [pictures, setPictures] = useState(false);
  const [paused, setPaused] = useState(false);
  const [open, setOpen] = useState(null);
  const stream = useStream(map, { wanted, pictures, paused });
  const allowed = may("enrol") && about.data && about.data.keep !== "none";
  const shown = stream.items.filter((one) => matches(one, text));
  const toggle = (verdict) => setWanted((old) => (old.includes(verdict) ? old.filter((one) => one !== verdict) : [...old, verdict]));
  return html`
    <${Head} title="Live" note=${`The answers of ${map} as they are given.`}>
      <${Pill} tone=${stream.open ? "good" : "warn"}>${paused ? "paused" : stream.open ? "listening" : "connecting"}<//>
      <button type="button" aria-pressed=${paused} onClick=${() => setPaused(!paused)}>${paused ? `Go on (${integer(stream.held)} new)` : "Pause"}</button>
      <button type="button" onClick=${stream.clear}>Clear</button>
    <//>
    <div class="filters" role="search" aria-label="Filters">
      <div class="segments" role="group" aria-label="Verdicts">
        ${VERDICTS.map((one) => html`<button type="button" aria-pressed=${wanted.includes(one)} onClick=${() => toggle(one)}>${one}</button>`)}
      </div>
      <${Field} label="Who, camera, place" inline><input value=${text} onInput=${(event) => setText(event.target.value)} spellcheck=${false} /><//>
      ${allowed && html`<label class="row"><input type="checkbox" checked=${pictures} onChange=${() => setPictures(!pictures)} /> frames as thumbnails</label>`}
    </div>
    ${stream.error && html`<${Trouble} error=${stream.error} again=${stream.again} />`}
    ${shown.length === 0
      ? html`<${Nothing} title="No queries yet">Answers appear here as robots, cameras and this console ask.<//>`
      : html`
        <ol class="stream" aria-label="Answers">
          ${shown.map((one) => (one.missed === undefined ? html`<${Line} key=${one.number} map=${map} event=${one} open=${setOpen} />` : html`<${Gap} key=${one.number} missed=${one.missed} />`))}
        </ol>
      `}
    ${open && html`<${Details} map=${map} event=${open} close=${() => setOpen(null)} />`}
  `;
}

function matches({ key, camera, place, best, session, operation, missed }, text) {
  const wanted = text.trim().toLowerCase();
  return !wanted || missed !== undefined || [key, camera, place, best, session, operation].some((one) => one?.toLowerCase().includes(wanted));
}

/** The answers of a map, the newest first; while it is paused they are held back.
 *
 * After a lost connection, and with other verdicts, it goes on after the last event that was heard.  Where some are lost
 * an item says so: `missed` is how many, or null.
 */
function useStream(map, { wanted, pictures, paused }) {
  const [state, setState] = useState({ items: [], open: null, error: null, held: 0 });
  const [attempt, setAttempt] = useState(0);
  const held = useRef([]);
  const stopped = useRef(paused);
  const number = useRef(0);
  const heard = useRef({});
  stopped.current = paused;
  const subscription = JSON.stringify([map, wanted, pictures, attempt, epoch.value]); // `open` is the one that is open
  const change = (changes) => setState((old) => ({ ...old, ...(typeof changes === "function" ? changes(old) : changes) }));
  useEffect(() => {
    if (paused) return;
    const waiting = held.current.splice(0);
    change((old) => ({ items: [...waiting, ...old.items].slice(0, MOST), held: 0 }));
  }, [paused]);
  useEffect(() => {
    const controller = new AbortController();
    const onEvent = (name, event) => {
      if (name !== "query" && name !== "missed") return undefined;
      const one = { ...(name === "missed" ? { missed: event.count } : event), number: (number.current += 1) };
      if (stopped.current) {
        held.current = [one, ...held.current].slice(0, MOST);
        return change({ held: held.current.length });
      }
      return change((old) => ({ items: [one, ...old.items].slice(0, MOST) }));
    };
    const query = { kinds: "query", pictures: pictures ? "true" : "" };
    if (wanted.length < VERDICTS.length) query.verdicts = wanted.join(",");
    if (heard.current.map !== map || heard.current.key !== key.value) heard.current = { map, key: key.value, last: null };
    change({ error: null });
    if (wanted.length > 0) {
      const onState = (open) => change({ open: open ? subscription : null });
      const options = { query, onEvent, onState, signal: controller.signal, heard: heard.current };
      follow(mapPath(map, "events"), options).catch((error) => change({ error, open: null }));
    }
    return () => controller.abort();
  }, [subscription]);
  const clear = () => {
    held.current = [];
    change({ items: [], held: 0 });
  };
  return { ...state, open: state.open === subscription, clear, again: () => setAttempt((one) => one + 1) };
}

/** What stands between two answers where others may be missing. */
function Gap({ missed }) {
  const text = missed === null
    ? "Answers may be missing here: the connection was lost for long, or the service was restarted."
    : `${integer(missed)} events are missing here: they came while the connection was lost, or faster than they could be sent.`;
  return html`<li class="missed">${text}</li>`;
}

function Line({ map, event, open }) {
  const { verdict, run, probability, place, best, key, camera, session, picture, trial } = event;
  const shown = place || best;
  const others = [...(key ? [camera, session] : []), trial && "tried in a console, not counted"].filter(Boolean).join(" · ");
  return html`
    <li>
      <time datetime=${event.at} title=${exact(event.at)}>${clock(event.at)}</time>
      <span class="who">${key ? html`<strong><${Name} text=${key} /></strong>` : html`<span class="faint">${camera || session || "–"}</span>`}${others && html` <span class="small faint">${others}</span>`}</span>
      <${Verdicts} verdict=${verdict} run=${run} />
      <span class="probability"><${Bar} share=${probability ?? 0} tone=${verdict} label=${`Probability ${percent(probability)}`} /> <span class="small">${percent(probability)}</span></span>
      <span class="what">
        ${picture && html`<span class="picture"><img src=${picture} alt="The frame" /></span>`}
        ${shown && html`<${Thumbnail} map=${map} place=${shown} /><span>${place ? html`<a href=${href("maps", map, "places", place)}><${Name} text=${place} /></a>` : html`<span class="faint row">best <${Name} text=${best} /></span>`}</span>`}
      </span>
      <span class="number"><button type="button" class="small" aria-label=${`Why ${verdict}`} onClick=${() => open(event)}>Why</button></span>
    </li>
  `;
}

function asText(question) {
  return Object.entries(question || {}).map(([name, value]) => `${name} ${value}`).join(", ") || "nothing but the frame";
}

function Details({ map, event, close }) {
  const { verdict, probability, place, best, pose, score, decision, threshold, reason, picture, explanation } = event;
  const again = () => {
    handedOver.value = { file: blobOf(picture), question: event.question || {} };
    go("maps", map, "try");
  };
  return html`
    <${Dialog} title="An answer" close=${close} wide>
      <div class="spread"><p class="large"><${Verdicts} verdict=${verdict} run=${event.run} /> ${place || ""}</p><p class="large">${percent(probability, 1)}</p></div>
      <div class="pair">
        ${picture ? html`<img src=${picture} alt="The frame" />` : html`<span class="picture"><span class="faint">the frame was not sent here</span></span>`}
        ${best ? html`<${Thumbnail} map=${map} place=${best} />` : html`<span class="picture"><span class="faint">no match</span></span>`}
      </div>
      <div class="columns">
        <${Facts} rows=${[
          ["Asked", html`<${ExactMoment} at=${event.at} />`],
          ["Best match", best ? html`<a href=${href("maps", map, "places", best)}>${best}</a>` : "–"],
          ["Score", decimal(score)],
          ["Decision value", html`${decimal(decision)} <span class="faint">threshold ${decimal(threshold)}</span>`],
          reason && ["Reason", reason],
          event.change && ["View", changeText(event.change)],
          ["Pose", pose ? `${poseText(pose)} ± ${metres(pose.spread)}` : "–"],
          ["Asked by", event.key || "–"],
          event.camera && ["Camera", event.camera],
          event.session && ["Session", `${event.session}${event.frame !== null && event.frame !== undefined ? `, frame ${event.frame}` : ""}`],
          ["Asked with", event.question === null ? "longer than is told" : asText(event.question)],
          ["Operation", (event.operation || "").replaceAll("_", " ")],
          ["Request", html`<code>${event.request_id}</code>`],
        ]} />
        <${Timings} milliseconds=${event.milliseconds} />
      </div>
      ${explanation && html`<${Picture} path=${explanation.replace(/^.*?\/v1/, "")} alt="The frame beside its best match, with what connects them" />`}
      ${picture && html`<footer class="row">
        <button type="button" onClick=${again}>Ask again with this thumbnail, and explain</button>
        ${event.question === null && html`<span class="faint">without its filters, which are longer than is told</span>`}
        ${event.session && html`<span class="faint">as a single frame: its session knew the frames before it, too</span>`}
      </footer>`}
    <//>
  `;
}
