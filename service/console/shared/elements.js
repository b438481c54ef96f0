// The pieces that views are made of.  Everything that a user may have written is put in as text.
import { Problem } from "./api.js";
import { exact, percent, relative } from "./formats.js";
import { html, signal, useEffect, useId, useLayoutEffect, useRef, useState } from "./view.js";

// States

export function Loading({ what = "Loading" }) {
  return html`<p class="loading" role="status"><span class="spinner" aria-hidden="true"></span>${what} …</p>`;
}

export function Nothing({ title, children }) {
  return html`<div class="nothing"><strong>${title}</strong>${children && html`<p>${children}</p>`}</div>`;
}

/** What went wrong: a problem's title, detail and request id. */
export function Trouble({ error, again, close }) {
  const isProblem = error instanceof Problem;
  return html`
    <div class="trouble" role="alert">
      <div>
        <strong>${error.title || "Something went wrong"}</strong>
        <p>${error.detail || error.message}</p>
        ${isProblem && error.errors.length > 0 && html`<ul>${error.errors.map((one) => html`<li>${errorText(one)}</li>`)}</ul>`}
        ${isProblem && error.requestId && html`<p class="faint small">Request <code>${error.requestId}</code></p>`}
      </div>
      ${again && html`<button type="button" onClick=${again}>Try again</button>`}
      ${close && html`<button type="button" onClick=${close}>Close</button>`}
    </div>
  `;
}

function errorText(one) {
  if (typeof one === "string") return one;
  const where = one.parameter || (one.loc || []).join(".") || one.name || one.field;
  const what = one.detail || one.message || one.msg || JSON.stringify(one);
  return where ? `${where}: ${what}` : what;
}

// Times and figures

const now = signal(Date.now());
setInterval(() => {
  now.value = Date.now();
}, 15_000);

/** A moment relative to now, with the exact one as its title. */
export function Moment({ at }) {
  if (!at) return html`<span class="faint">–</span>`;
  return html`<time datetime=${at} title=${exact(at)}>${relative(at, Math.max(now.value, Date.now()))}</time>`;
}

/** The same with the exact moment beside it, where there is room. */
export function ExactMoment({ at }) {
  return html`<${Moment} at=${at} />${at && html` <span class="faint small">${exact(at)}</span>`}`;
}

const SIGNS = { recognized: "●", ambiguous: "◐", unknown: "○" };

export function Verdict({ verdict }) {
  return html`<span class=${`verdict ${verdict}`}><span aria-hidden="true">${SIGNS[verdict]}</span> ${verdict}</span>`;
}

/** What a frame says by itself, and what its run makes of it, which is what the robot was told; without a run the first alone. */
export function Verdicts({ verdict, run }) {
  if (!run) return html`<${Verdict} verdict=${verdict} />`;
  return html`
    <span class="verdicts">
      <span><${Verdict} verdict=${verdict} /> <span class="small faint">this frame alone</span></span>
      <span><${Verdict} verdict=${run} /> <span class="small faint">the run</span></span>
    </span>
  `;
}

const VERDICTS = ["recognized", "ambiguous", "unknown"];

/** Shares of the verdicts as a bar. */
export function VerdictMix({ counts }) {
  const total = counts ? VERDICTS.reduce((sum, name) => sum + counts[name], 0) : 0;
  if (!total) return html`<span class="faint">no answers</span>`;
  const text = VERDICTS.map((name) => `${counts[name]} ${name}`).join(", ");
  return html`
    <span class="mix" role="img" aria-label=${text} title=${text}>
      ${VERDICTS.map((name) => counts[name] > 0 && html`<span class=${name} style=${{ flexGrow: counts[name] }}></span>`)}
    </span>
    <span class="faint small">${percent(counts.recognized / total)}</span>
  `;
}

/** A bar of a share from 0 to 1. */
export function Bar({ share, label, tone = "" }) {
  const width = `${Math.min(100, Math.max(0, 100 * share))}%`;
  return html`<span class=${`bar ${tone}`} role="img" aria-label=${label}><span style=${{ width }}></span></span>`;
}

export function Progress({ done, total, label }) {
  return html`<progress class="progress" aria-label=${label} max=${total || 1} value=${total ? done : undefined}></progress>`;
}

/** Whether the service is ready, and takes writes. */
export function Ready({ service: { ready, degraded } }) {
  const [tone, word] = !ready ? ["bad", "not ready"] : degraded ? ["warn", "degraded"] : ["good", "ready"];
  return html`<${Pill} tone=${tone}>${word}<//>`;
}

/** Why the service, which answers, takes no writes. */
export function Degraded({ service }) {
  if (!service?.degraded) return null;
  return html`<p class="notice" role="alert"><strong>Writes are refused, queries are answered.</strong> ${service.degraded}</p>`;
}

export function Pill({ tone = "", title, children }) {
  return html`<span class=${`pill ${tone}`} title=${title}>${children}</span>`;
}

export function Facts({ rows }) {
  return html`
    <dl class="facts">
      ${rows.filter(Boolean).map(([name, value, title]) => html`<div><dt>${name}</dt><dd title=${title}>${value}</dd></div>`)}
    </dl>
  `;
}

const SHORT = 8;
const END = 7;
const LONGEST_END = 16;

/** A name; where there is no room its beginning gives way, for what distinguishes names is at their ends.
 *
 * among: the names beside which it stands; what they do not begin with in common stays, too.
 */
export function Name({ text, among = [] }) {
  const letters = Array.from(String(text));
  if (letters.length <= SHORT) return html`<span class="middle">${text}</span>`;
  const end = Math.min(LONGEST_END, letters.length - 1, Math.max(END, letters.length - commonStart(among)));
  return html`
    <span class="middle" title=${text}>
      <span class="hidden">${text}</span>
      <span class="start" aria-hidden="true">${letters.slice(0, -end).join("")}</span><span class="end" aria-hidden="true">${letters.slice(-end).join("")}</span>
    </span>
  `;
}

/** With how many letters all of these names begin in common; as many as there are for fewer than two. */
function commonStart(names) {
  const [first, ...others] = [...new Set(names)].map((name) => Array.from(name));
  if (others.length === 0) return Infinity;
  let count = 0;
  while (count < first.length && others.every((one) => one[count] === first[count])) count += 1;
  return count;
}

// Head of a view

export function Head({ title, note, children }) {
  useEffect(() => {
    document.title = `${title} · placerec console`;
  }, [title]);
  return html`
    <header class="head">
      <div><h1 tabindex="-1">${title}</h1>${note && html`<p class="faint">${note}</p>`}</div>
      <div class="actions">${children}</div>
    </header>
  `;
}

// Forms

export function Field({ label, hint, children, inline = false }) {
  return html`
    <label class=${inline ? "field inline" : "field"}>
      <span class="label">${label}</span>
      ${children}
      ${hint && html`<span class="hint">${hint}</span>`}
    </label>
  `;
}

/** An input that is read when it is left: what is typed stays until then, whatever value comes meanwhile. */
export function Typed({ value, change, ...more }) {
  const [text, setText] = useState(null); // null: nothing is being typed
  const left = ({ target }) => {
    setText(null);
    change(target);
  };
  return html`
    <input
      ...${more}
      value=${text ?? value}
      onInput=${(event) => setText(event.target.value)}
      onChange=${left}
      onBlur=${() => setText(null)}
      spellcheck=${false}
    />
  `;
}

/** An input of a number: change gets it with every letter, and NaN as long as what is written is none, such as "0.". */
export function NumberInput({ value, change, ...more }) {
  const [text, setText] = useState(null); // what is written, as long as it is what the value comes from
  const told = useRef(null);
  const typed = ({ target }) => {
    told.current = target.valueAsNumber;
    setText(target.value);
    change(target.valueAsNumber);
  };
  const shown = text !== null && Object.is(told.current, value) ? text : value;
  return html`<input ...${more} type="number" value=${Number.isNaN(shown) ? "" : shown} onInput=${typed} onBlur=${() => setText(null)} />`;
}

/** A dialog; it closes with Esc, unless it stays until a button in it is pressed, and gives the focus back. */
export function Dialog({ title, close, wide = false, stays = false, children }) {
  const element = useRef(null);
  const id = useId();
  useLayoutEffect(() => {
    const before = document.activeElement;
    const replaced = document.querySelector("dialog[open]"); // if this one takes the place of another, which goes
    const shown = element.current;
    shown.opener = replaced?.opener ?? before;
    shown.showModal();
    return () => {
      shown.close(); // while it is open, nothing behind it takes the focus
      const there = before?.isConnected && before !== document.body;
      (there ? before : shown.opener)?.focus?.();
    };
  }, []);
  const cancelled = (event) => {
    event.preventDefault();
    if (!stays) close();
  };
  // A browser may close a dialog in spite of that when Esc is pressed again.
  const typed = (event) => stays && event.key === "Escape" && event.preventDefault();
  return html`
    <dialog ref=${element} class=${wide ? "wide" : ""} aria-labelledby=${id} onCancel=${cancelled} onKeyDown=${typed}>
      <header><h2 id=${id}>${title}</h2>${!stays && html`<button type="button" class="quiet" aria-label="Close" onClick=${close}>✕</button>`}</header>
      <div class="body">${children}</div>
    </dialog>
  `;
}

/** A form in a dialog: it is sent once at a time, shows what went wrong, and closes when nothing did. */
export function FormDialog({ title, action, danger = false, ready = true, close, send, wide, children }) {
  const [error, setError] = useState(null);
  const [busy, setBusy] = useState(false);
  const submit = async (event) => {
    event.preventDefault();
    if (busy || !ready) return;
    setBusy(true);
    setError(null);
    try {
      await send();
      close();
    } catch (problem) {
      setError(problem);
    }
    setBusy(false);
  };
  return html`
    <${Dialog} title=${title} close=${close} wide=${wide}>
      <form onSubmit=${submit}>
        ${children}
        ${error && html`<${Trouble} error=${error} />`}
        <footer>
          <button type="button" onClick=${close}>Cancel</button>
          <button type="submit" class=${danger ? "danger" : "primary"} disabled=${!ready || busy}>${busy ? "…" : action}</button>
        </footer>
      </form>
    <//>
  `;
}

/** Ask for the name of what is going to be destroyed. */
export function ByName({ title, name, action, close, send, children }) {
  const [typed, setTyped] = useState("");
  return html`
    <${FormDialog} title=${title} action=${action} danger ready=${typed === name} close=${close} send=${send}>
      ${children}
      <${Field} label=${html`Type <code>${name}</code> to confirm`}>
        <input value=${typed} onInput=${(event) => setTyped(event.target.value)} autocomplete="off" spellcheck=${false} autofocus />
      <//>
    <//>
  `;
}

export function Copy({ text, label = "Copy" }) {
  const [done, setDone] = useState(null);
  const copy = async (event) => {
    const { parentElement: beside } = event.currentTarget; // what is outside an open dialog cannot be selected
    setDone((await written(text, beside)) ? "Copied" : "Select and copy it");
    setTimeout(() => setDone(null), 2000);
  };
  return html`<button type="button" class="small" onClick=${copy} aria-live="polite">${done || label}</button>`;
}

/** Write a text to the clipboard; over plain HTTP browsers only copy what is selected.  Whether it is there. */
async function written(text, beside) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const field = document.createElement("textarea");
    const focused = document.activeElement;
    field.value = text;
    field.className = "hidden";
    beside.append(field);
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    focused?.focus();
    return done;
  }
}

// Menus

const ROW_HEIGHT = 48; // at most

/** A button that opens a menu of what can be done with something: items are [text, function, class]. */
export function Menu({ of, items }) {
  const [button, list] = [useRef(null), useRef(null)];
  const id = useId();
  const place = () => {
    const { top, bottom, right } = button.current.getBoundingClientRect();
    const high = items.length * ROW_HEIGHT;
    const below = bottom + high < innerHeight;
    const vertical = below ? { top: `${bottom + 4}px`, bottom: "auto" } : { top: "auto", bottom: `${innerHeight - top + 4}px` };
    Object.assign(list.current.style, { ...vertical, right: `${Math.max(4, document.documentElement.clientWidth - right)}px` });
  };
  const choose = (call) => () => {
    list.current.hidePopover();
    button.current.focus(); // which a dialog that opens now gives back
    call();
  };
  return html`
    <button ref=${button} type="button" class="small" popovertarget=${id} aria-label=${`Actions for ${of}`}>⋯</button>
    <div ref=${list} id=${id} class="menu-list" popover="auto" role="group" aria-label=${`Actions for ${of}`} onBeforeToggle=${place}>
      ${items.map(([text, call, tone = ""]) => html`<button type="button" class=${`quiet ${tone}`} aria-label=${`${text} ${of}`} onClick=${choose(call)}>${text}</button>`)}
    </div>
  `;
}

// Pages of a list

/** The way to the pages before and after: `cursors` are those of the pages up to this one, `next` that of the one after. */
export function Pager({ cursors, next, show, back = "Newer", on = "Older" }) {
  if (cursors.length === 1 && !next) return null;
  return html`
    <nav class="pager" aria-label="Pages">
      <button type="button" disabled=${cursors.length === 1} onClick=${() => show(cursors.slice(0, -1))}>← ${back}</button>
      <span class="faint">page ${cursors.length}</span>
      <button type="button" disabled=${!next} onClick=${() => show([...cursors, next])}>${on} →</button>
    </nav>
  `;
}

// Messages that go by themselves

export const messages = signal([]);
let number = 0;

/** Say something at the edge of the page; undo, if given, is offered with it.
 *
 * as: what several of a kind are together, such as "labelled": they are one message, whose undo takes all of them back.
 */
export function say(text, undo, as) {
  const id = (number += 1);
  const before = as && messages.value.find((one) => one.as === as);
  const undos = [undo, ...(before?.undos || [])];
  const all = async () => {
    for (const one of undos) await one();
  };
  const message = { id, text: before ? `${undos.length} ${as}` : text, undo: undo && all, as, undos };
  messages.value = [...messages.value.filter((one) => one !== before).slice(-3), message];
  setTimeout(() => unsay(id), undo ? 12_000 : 5000);
}

export function unsay(id) {
  messages.value = messages.value.filter((one) => one.id !== id);
}

/** Say what went wrong with an action. */
export function complain(error) {
  if (error.name === "AbortError") return;
  const id = (number += 1);
  messages.value = [...messages.value.slice(-3), { id, error }];
}
