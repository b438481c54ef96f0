// Frames that the map was told to keep because their answers were in doubt: somebody says what they show.
import { get, getTagged, may, patch, post, remove, save } from "../shared/api.js";
import { complain, ExactMoment, Facts, Field, FormDialog, Head, Moment, Name, Nothing, NumberInput, Pager, Pill, say, Verdict } from "../shared/elements.js";
import { bytes, counted, decimal, integer, percent } from "../shared/formats.js";
import { HeadingArrow } from "../shared/heading.js";
import { mapPath } from "../shared/map_path.js";
import { Picture, Thumbnail } from "../shared/pictures.js";
import { Shown, useResource } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { Stretches, useStretches } from "../shared/stretches.js";
import { html, useEffect, useRef, useState } from "../shared/view.js";

const PAGE = 30;
const REGRET = 8000;
const LOOKS_EVERY = 5000;

export default function Review({ map, query }) {
  const about = useResource((signal) => getTagged(mapPath(map), {}, signal), [map]);
  const stretches = useStretches(map);
  const shown = ["labelled", "stretches"].includes(query.show) ? query.show : "waiting";
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const settings = about.data?.data.review;
  const learning = about.data?.data.learning;
  const learns = learning && (learning.mode !== "off" || learning.new_ground);
  const keep = () => setDialog(html`<${Keeping} map=${map} read=${about.data} close=${close} changed=${about.reload} />`);
  const write = async () => {
    const told = await get(mapPath(map, "review", "labels")).catch(complain);
    if (told) save(new Blob([JSON.stringify(told, null, 2)], { type: "application/json" }), `${map}-labels.json`);
  };
  return html`
    <${Head} title="Review" note=${`Frames that ${map} was not sure of.`}>
      <button type="button" onClick=${write}>Export the labels</button>
      ${may("admin") && about.data && html`<button type="button" onClick=${keep}>Stored frames</button>`}
    <//>
    <${Shown} resource=${about}>
      ${() => html`
        ${settings === null && !learns && html`<p class="notice">This map stores no frames for review now. ${may("admin") ? "Choose under Stored frames the answers whose frames it stores." : "Somebody with an admin key can turn that on."}</p>`}
        <div class="segments" role="group" aria-label="Which frames">
          <button type="button" aria-pressed=${shown === "waiting"} onClick=${() => restate({ show: "" })}>To be looked at</button>
          <button type="button" aria-pressed=${shown === "labelled"} onClick=${() => restate({ show: "labelled" })}>Labelled</button>
          <button type="button" aria-pressed=${shown === "stretches"} onClick=${() => restate({ show: "stretches" })}>New ground${stretches.data?.length > 0 && ` (${integer(stretches.data.length)})`}</button>
        </div>
        ${shown === "stretches"
          ? html`<${Stretches} map=${map} stretches=${stretches} about=${about} />`
          : html`<${Frames} key=${shown} map=${map} labelled=${shown === "labelled"} keeps=${settings !== null || learns} />`}
      `}
    <//>
    ${dialog}
  `;
}

/** The frames of a listing that stay where they are while others come: newer ones wait until they are asked for.
 *
 * Returns {items, fresh, adopt}: the frames, how many newer ones wait, and a function that shows them.
 */
function usePinned(page, place) {
  const [pinned, setPinned] = useState({ place: null, items: [] });
  const told = page.data?.items;
  const settled = pinned.place === place;
  useEffect(() => {
    if (told) setPinned((old) => ({ place, items: old.place === place ? joined(old.items, told) : told }));
  }, [told, place]);
  const items = settled ? pinned.items : told || [];
  const adopt = () => setPinned({ place, items: told });
  return { items, fresh: (told || []).filter((one) => !(one.id <= (items[0]?.id ?? 0))).length, adopt };
}

/** Frames as they are now, with older ones that moved up behind them; one that is not listed any more has no label. */
function joined(items, told) {
  const now = new Map(told.map((one) => [one.id, one]));
  const last = items.at(-1)?.id ?? 0;
  const oldest = told.length < PAGE ? 0 : told.at(-1).id;
  const left = (one) => (one.id < oldest ? one : { ...one, label: null, labelled_at: null });
  return [...items.map((one) => now.get(one.id) || left(one)), ...told.filter((one) => one.id < last)];
}

function Frames({ map, labelled, keeps }) {
  const [cursors, setCursors] = useState([""]);
  const cursor = cursors.at(-1);
  const page = useResource((signal) => get(mapPath(map, "review"), { labelled, limit: PAGE, cursor }, { signal }), [map, labelled, cursor], { every: LOOKS_EVERY });
  const pinned = usePinned(page, cursor);
  const [done, setDone] = useState(new Map());
  const [open, setOpen] = useState(null);
  const discards = useDiscards(map, setDone);
  const items = pinned.items.filter((one) => done.get(one.id) !== "gone");
  const current = items.find((one) => one.id === open) || items[0];
  const fresh = cursors.length === 1 ? pinned.fresh : 0;
  const goOn = (frame) => {
    const next = items[items.indexOf(frame) + 1];
    setOpen(next ? next.id : null);
  };
  const bringBack = (id) => {
    setDone((old) => new Map([...old].filter(([one]) => one !== id)));
    setOpen(id);
  };
  const label = async (frame, body) => {
    const told = await post(mapPath(map, "review", String(frame.id)), body);
    if (!labelled) setDone((old) => new Map(old).set(frame.id, "gone"));
    goOn(frame);
    const undo = async () => {
      await takeBack(map, frame, told).catch(complain);
      bringBack(frame.id);
      page.reload();
    };
    if (frame.label?.new) say(labelText(told.frame.label));
    else say(labelText(told.frame.label), undo, "labelled");
    page.reload();
  };
  const discard = (frame) => {
    goOn(frame);
    discards.put(frame.id, () => setOpen(frame.id));
  };
  const showFresh = () => {
    setOpen(page.data.items[0]?.id ?? null);
    pinned.adopt();
  };
  return html`
    <${Shown} resource=${page}>
      ${({ frames, bytes: size, next_cursor: next }) => html`
        <div class="row">
          <p class="faint">${counted(frames, "frame")}, ${bytes(size)}.</p>
          ${fresh > 0 && html`<button type="button" class="small" onClick=${showFresh}>Show ${fresh === PAGE ? `${PAGE} or more` : integer(fresh)} new</button>`}
        </div>
        ${items.length === 0
          ? html`<${Nothing} title=${labelled ? "No labels yet" : "Nothing to be looked at"}>${!labelled && keeps && "Frames appear here as they are answered with the chosen verdicts."}<//>`
          : html`
            <div class="review">
              <ul class="queue" aria-label="Frames">
                ${items.map((one) => html`<${Tile} key=${one.id} map=${map} frame=${one} chosen=${one === current} choose=${setOpen} />`)}
              </ul>
              ${current && html`<${Labelling} key=${current.id} map=${map} frame=${current} label=${label} discard=${discard} />`}
            </div>
          `}
        <${Pager} cursors=${cursors} next=${next} show=${setCursors} />
      `}
    <//>
  `;
}

const SAME_MOMENT = 60_000;

/** Undo a label: the one before is given again; a place or a look that came into the map with it goes. */
async function takeBack(map, frame, { frame: labelled, enrolled }) {
  const before = frame.label;
  const body = before?.place ? { place: before.place } : before?.stranger ? { stranger: true } : { clear: true };
  await post(mapPath(map, "review", String(frame.id)), body);
  const { place, look } = labelled.label;
  if (look && look !== before?.look) await remove(mapPath(map, "places", place, "looks", look));
  if (enrolled && new Date(labelled.labelled_at) - new Date(enrolled.created_at) < SAME_MOMENT) {
    await remove(mapPath(map, "places", enrolled.id));
  }
}

/** Frames to throw away: they go after a while in which it can be undone, or when the view is left. */
function useDiscards(map, setDone) {
  const waiting = useRef(new Map());
  const send = (id) => {
    clearTimeout(waiting.current.get(id));
    waiting.current.delete(id);
    post(mapPath(map, "review", String(id)), { discard: true }).catch(complain);
  };
  useEffect(() => () => [...waiting.current.keys()].forEach(send), []);
  const put = (id, cameBack) => {
    setDone((old) => new Map(old).set(id, "gone"));
    waiting.current.set(id, setTimeout(() => send(id), REGRET));
    say("The frame is thrown away.", () => {
      if (!waiting.current.has(id)) return say("It was too late: the frame is gone.");
      clearTimeout(waiting.current.get(id));
      waiting.current.delete(id);
      setDone((old) => new Map([...old].filter(([one]) => one !== id)));
      cameBack();
      return undefined;
    }, "thrown away");
  };
  return { put };
}

function labelText(label) {
  if (label?.stranger) return "Labelled: no place of this map.";
  const id = label?.place || label?.new?.id || label?.new || "";
  if (label?.look) return `Added to the looks of ${id}.`;
  return label?.new ? `Enrolled as ${id}.` : `Labelled as ${id}.`;
}

function Kept({ map, frame, alt = "The frame" }) {
  return html`<${Picture} path=${mapPath(map, "review", String(frame.id), "picture")} version=${frame.sha256} alt=${alt} />`;
}

function Tile({ map, frame, chosen, choose }) {
  return html`
    <li class=${chosen ? "thumb chosen" : "thumb"}>
      <button type="button" class="cover" aria-pressed=${chosen} aria-label=${`Frame ${frame.id}`} onClick=${() => choose(frame.id)}>
        <${Kept} map=${map} frame=${frame} alt="" />
      </button>
      <span class="under small"><${Verdict} verdict=${frame.answer.verdict} /><${Moment} at=${frame.at} /></span>
    </li>
  `;
}

function Labelling({ map, frame, label, discard }) {
  const { answer } = frame;
  const { proposal } = answer;
  const candidates = answer.matches.map((one) => one.place);
  const [against, setAgainst] = useState(proposal?.place || candidates[0] || null);
  const [busy, setBusy] = useState(false);
  const [dialog, setDialog] = useState(null);
  const send = async (body) => {
    setBusy(true);
    await label(frame, body).catch(complain);
    setBusy(false);
  };
  // The next frame takes the place of this one: the second click of a double click is not meant for it.
  const clicked = (body) => (event) => event.detail < 2 && send(body);
  useNumbers(busy || dialog !== null, (number) => candidates[number - 1] && send({ place: candidates[number - 1] }));
  return html`
    <section class="panel" aria-label="Frame to be labelled">
      <div class="spread">
        <p class="large"><${Verdict} verdict=${answer.verdict} /> <span class="faint small">${answer.probability !== null && percent(answer.probability, 1)}</span></p>
        ${frame.label && html`<${Pill} tone="on">${labelText(frame.label)}<//>`}
      </div>
      <div class="pair">
        <${Kept} map=${map} frame=${frame} />
        ${against ? html`<${Thumbnail} map=${map} place=${against} />` : html`<span class="picture"><span class="faint">no match</span></span>`}
      </div>
      ${proposal && html`
        <div class="notice stack">
          <p>A run puts this frame at <a class="name" href=${href("maps", map, "places", proposal.place)}><${Name} text=${proposal.place} /></a>. ${proposal.why}</p>
          ${!frame.label && html`<div class="row"><button type="button" class="primary narrow" disabled=${busy} onClick=${clicked({ place: proposal.place, look: true })}>Add it to the looks of <${Name} text=${proposal.place} /></button></div>`}
        </div>
      `}
      ${answer.stretch && html`<p class="notice">It is of new ground, <a href=${href("maps", map, "review", { show: "stretches" })}>which is accepted or rejected as a whole</a>.</p>`}
      <div class="spread"><h2>Which place is it?</h2><span class="faint small">The number keys choose a candidate.</span></div>
      <ol class="matches">
        ${answer.matches.map((one, number) => html`
          <li class=${one.place === against ? "thumb chosen" : "thumb"} key=${one.place}>
            <button type="button" class="cover" aria-pressed=${one.place === against} aria-label=${`Compare with ${one.place}`} onClick=${() => setAgainst(one.place)}><${Thumbnail} map=${map} place=${one.place} /></button>
            <span class="under small"><a class="name" href=${href("maps", map, "places", one.place)}><${Name} text=${one.place} among=${candidates} /></a><span>${decimal(one.score)}</span></span>
            <button type="button" class="small narrow" disabled=${busy} aria-keyshortcuts=${number + 1} onClick=${clicked({ place: one.place })}><kbd aria-hidden="true">${number + 1}</kbd> It is <${Name} text=${one.place} among=${candidates} /></button>
          </li>
        `)}
      </ol>
      <div class="row">
        <button type="button" disabled=${busy} onClick=${() => setDialog(html`<${Other} close=${() => setDialog(null)} send=${(place) => label(frame, { place })} />`)}>Another place …</button>
        <button type="button" disabled=${busy} onClick=${() => setDialog(html`<${Enrol} frame=${frame} close=${() => setDialog(null)} send=${(fields) => label(frame, { new: fields })} />`)}>Enrol it …</button>
        ${against && against !== proposal?.place && html`<button type="button" class="narrow" disabled=${busy} onClick=${clicked({ place: against, look: true })}>A further look of <${Name} text=${against} among=${candidates} /></button>`}
        <button type="button" disabled=${busy} onClick=${clicked({ stranger: true })}>No place of this map</button>
        <button type="button" class="danger" disabled=${busy} onClick=${(event) => event.detail < 2 && discard(frame)}>Throw away</button>
      </div>
      <${Facts} rows=${[
        ["Asked", html`<${ExactMoment} at=${frame.at} />`],
        answer.key && ["By", answer.key],
        ["Decision value", html`${decimal(answer.decision)} <span class="faint">threshold ${decimal(answer.threshold)}</span>`],
        answer.reason && ["Reason", answer.reason],
        answer.camera && ["Camera", answer.camera],
        answer.session && ["Session", answer.session],
        frame.labelled_at && ["Labelled", html`<${ExactMoment} at=${frame.labelled_at} /> ${frame.labelled_by && `by ${frame.labelled_by}`}`],
        ["Request", html`<code>${answer.request_id}</code>`],
      ]} />
      ${dialog}
    </section>
  `;
}

/** Call a function with the number whose key is pressed, unless somebody writes or a dialog is open. */
function useNumbers(held, call) {
  const latest = useRef(null);
  latest.current = held ? null : call;
  useEffect(() => {
    const typed = (event) => {
      if (event.repeat || event.ctrlKey || event.metaKey || event.altKey || !/^[1-9]$/.test(event.key)) return;
      if (event.target.closest("input, select, textarea, dialog")) return;
      latest.current?.(Number(event.key));
    };
    addEventListener("keydown", typed);
    return () => removeEventListener("keydown", typed);
  }, []);
}

function Other({ close, send }) {
  const [id, setId] = useState("");
  return html`
    <${FormDialog} title="Another place" action="Label" ready=${id !== ""} close=${close} send=${() => send(id.trim())}>
      <${Field} label="Id of the place"><input required value=${id} onInput=${(event) => setId(event.target.value)} autofocus autocomplete="off" spellcheck=${false} /><//>
    <//>
  `;
}

const POSE = ["x", "y", "heading", "latitude", "longitude"];

function Enrol({ frame, close, send }) {
  const [fields, setFields] = useState({ id: `review-${frame.id}`, sequence: "", ...Object.fromEntries(POSE.map((name) => [name, ""])) });
  const change = (name) => (event) => setFields({ ...fields, [name]: event.target.value });
  const enrol = () => {
    const { id, sequence } = fields;
    const pose = POSE.filter((name) => fields[name] !== "").map((name) => [name, Number(fields[name])]);
    return send({ id: id.trim(), ...(sequence && { sequence }), ...Object.fromEntries(pose) });
  };
  return html`
    <${FormDialog} title="Enrol the frame" action="Enrol" ready=${fields.id !== ""} close=${close} send=${enrol}>
      <div class="fields">
        <${Field} label="Id"><input required value=${fields.id} onInput=${change("id")} autocomplete="off" spellcheck=${false} autofocus /><//>
        <${Field} label="Traverse"><input maxlength="128" value=${fields.sequence} onInput=${change("sequence")} /><//>
      </div>
      <div class="fields narrow">${POSE.map((name) => html`<${Field} label=${name}><input type="number" step="any" value=${fields[name]} onInput=${change(name)} /><//>`)}</div>
      <${HeadingArrow} heading=${fields.heading} geographic=${fields.latitude !== ""} />
    <//>
  `;
}

const VERDICTS = ["ambiguous", "unknown", "recognized"];
const MIB = 2 ** 20;

function Keeping({ map, read, close, changed }) {
  const present = read.data.review;
  const [verdicts, setVerdicts] = useState(present?.verdicts || []);
  const [frames, setFrames] = useState(present?.most_frames ?? 500);
  const [size, setSize] = useState(present ? Math.round(present.most_bytes / MIB) : 256);
  const [mode, setMode] = useState(read.data.learning.mode);
  const [ground, setGround] = useState(read.data.learning.new_ground);
  const [calibration, setCalibration] = useState(read.data.learning.calibration);
  const toggle = (name) => setVerdicts((old) => (old.includes(name) ? old.filter((one) => one !== name) : [...old, name]));
  const keep = async () => {
    const review = verdicts.length ? { verdicts, most_frames: frames, most_bytes: size * MIB } : null;
    await patch(mapPath(map), { review, learning: { mode, new_ground: ground, calibration } }, read.tag);
    say(review ? "Such frames are stored from now on." : "No further frames are stored for their answers.");
    changed();
  };
  return html`
    <${FormDialog} title="Frames stored for review" action="Save" close=${close} send=${keep}>
      <p class="faint">Frames as they were sent, with their answers. The oldest go first. Tell those who are in the pictures.</p>
      <fieldset class="stack">
        <legend class="label">Frames that were answered</legend>
        ${VERDICTS.map((one) => html`<label class="row"><input type="checkbox" checked=${verdicts.includes(one)} onChange=${() => toggle(one)} /> ${one}</label>`)}
      </fieldset>
      <div class="fields">
        <${Field} label="What runs teach">
          <select value=${mode} onChange=${(event) => setMode(event.target.value)}>
            <option value="off">nothing</option>
            <option value="propose">looks, proposed here</option>
            <option value="auto">looks, taken where evidence agrees</option>
          </select>
        <//>
        <${Field} label="What runs and alignments say of the calibration">
          <select value=${calibration} onChange=${(event) => setCalibration(event.target.value)}>
            <option value="off">nothing</option>
            <option value="propose">it is proposed under Calibration</option>
            <option value="auto">it is stored, after runs where two agree</option>
          </select>
        <//>
        <label class="field check"><input type="checkbox" checked=${ground} onChange=${() => setGround(!ground)} /><span>Where runs leave the map and come back, propose their way as new ground</span></label>
        <${Field} label="At most, frames"><${NumberInput} min="1" step="1" value=${frames} change=${setFrames} /><//>
        <${Field} label="At most, MiB"><${NumberInput} min="1" step="1" value=${size} change=${setSize} /><//>
      </div>
    <//>
  `;
}
