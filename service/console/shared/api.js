// The one way to the service: its API, with the key that the user typed.  The key is kept by the open tabs only, travels
// in a header, and never in an address.
import { Tabs } from "./tabs.js";
import { computed, signal } from "./view.js";

/** The service, under whatever path a proxy publishes it. */
export const ROOT = new URL("../../../", import.meta.url);

const KEY = "placerec.key";
const AT_ONCE = 6;
const ATTEMPTS = 4;
/** Milliseconds: the service sends a comment every three seconds, so a stream that is silent for so long is lost. */
const SILENCE = 8000;

/** A refusal by the service (RFC 9457). */
export class Problem extends Error {
  constructor(status, told, requestId, retryAfter) {
    super(told.detail || told.title || `The service answered ${status}.`);
    this.status = status;
    this.title = told.title || "The request failed";
    this.detail = told.detail || "";
    this.slug = (told.type || "").split(":").at(-1);
    this.errors = told.errors || [];
    this.requestId = told.request_id || requestId;
    this.retryAfter = retryAfter;
  }
}

/** The service could not be reached. */
export class Disconnected extends Error {
  constructor() {
    super("The service cannot be reached.");
    this.title = "No connection";
    this.detail = "The service cannot be reached. The page goes on by itself as soon as it can.";
  }
}

/** Nothing can have this name, so nothing was sent. */
export class InvalidName extends Error {
  constructor(name) {
    super(`${JSON.stringify(name)} is no name: it is empty, "." or "..", or has a slash.`);
    this.title = "This is no name";
    this.detail = this.message;
  }
}

// The key, and who it is

function storedKey() {
  try {
    return sessionStorage.getItem(KEY) || "";
  } catch {
    return "";
  }
}

export const key = signal(storedKey());

/** Why a key is asked for: the problem that said so, or null. */
export const keyNeeded = signal(null);

/** Grows whenever what was read may be read again: another key, or the connection is back. */
export const epoch = signal(0);

/** Who the service says that we are. */
export const caller = signal(null);

const LEVELS = { query: 1, enrol: 2, admin: 3 };

/** Whether the key's role covers another. */
export function may(role) {
  return caller.value !== null && LEVELS[caller.value.role] >= LEVELS[role];
}

/** Whether the key may use all maps. */
export const everyMap = computed(() => caller.value !== null && caller.value.maps === null);

/** Take another key; an empty one forgets the present one, in all tabs.
 *
 * known: the service has just made it, so that it need not be tried first.
 *
 * Throws, and leaves the present key in force, if the service does not accept it.
 */
export async function useKey(text, { known = false } = {}) {
  const given = text.trim();
  if (!/^[!-~]*$/.test(given)) {
    throw Object.assign(new Error("A key consists of letters, digits, - and _."), { title: "This key is not known" });
  }
  const told = given && !known ? await get("/key", {}, { headers: bearer(given) }) : null;
  hold(given);
  tabs.told(given);
  keyNeeded.value = null;
  if (told) caller.value = told;
  else await identify();
  epoch.value += 1;
}

function hold(given) {
  key.value = given;
  try {
    if (given) sessionStorage.setItem(KEY, given);
    else sessionStorage.removeItem(KEY);
  } catch {
    // It is kept in memory only.
  }
}

const tabs = new Tabs(ROOT.pathname, {
  present: () => (caller.value?.keys_needed ? key.value : ""),
  forget: () => {
    if (!key.value) return;
    hold("");
    identify().catch(() => {});
  },
});

/** Begin: with the key of this tab or of another one, ask the service who we are. */
export async function begin() {
  if (key.value) tabs.told(key.value);
  else hold(await tabs.ask());
  await identify();
}

/** Ask the service who we are. */
export async function identify() {
  try {
    caller.value = await get("/key");
  } catch (error) {
    caller.value = null;
    if (error.status !== 401) throw error;
  }
}

// The connection

export const online = signal(true);
let probing = null;

function lost() {
  online.value = false;
  probing ??= probe();
}

/** Find out whether the service is there, after something else could not be fetched. */
export async function checkConnection() {
  try {
    await fetch(new URL("livez", ROOT), { cache: "no-store", signal: AbortSignal.timeout(SILENCE) });
    return true;
  } catch {
    lost();
    return false;
  }
}

async function probe() {
  for (let wait = 500; ; wait = Math.min(wait * 1.6, 5000)) {
    await sleep(wait);
    try {
      const answer = await fetch(new URL("livez", ROOT), { cache: "no-store", signal: AbortSignal.timeout(SILENCE) });
      if (answer.ok) break;
    } catch {
      // It is still away.
    }
  }
  probing = null;
  online.value = true;
  if (caller.value === null) await identify().catch(() => {});
  epoch.value += 1;
}

export function sleep(milliseconds) {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}

// Requests: a few at a time, and after a 429 none until the service wants them again

let running = 0;
let heldUntil = 0;
const waiting = [];

async function turn() {
  if (running >= AT_ONCE) await new Promise((resolve) => waiting.push(resolve));
  else running += 1;
  while (Date.now() < heldUntil) await sleep(heldUntil - Date.now());
}

function next() {
  const first = waiting.shift();
  if (first) first();
  else running -= 1;
}

/** Whether a text can be a segment of a path. */
export function isName(text) {
  return !["", ".", ".."].includes(text) && !String(text).includes("/");
}

/** The path of these segments below v1, which are quoted; every path with a name in it is made here.
 *
 * A URL has no segment "." or "..": the browser takes them out, whether they are quoted or not, and ".." with the one
 * before it.  No name has a slash, which servers unquote.  Throws if a segment is one of these, or empty.
 */
export function pathOf(...segments) {
  for (const one of segments) if (!isName(one)) throw new InvalidName(one);
  return `/${segments.map(encodeURIComponent).join("/")}`;
}

function address(path, query = {}) {
  const url = new URL(path.startsWith("/") ? `v1${path}` : path, ROOT);
  for (const [name, value] of Object.entries(query)) {
    if (value !== null && value !== undefined && value !== "") url.searchParams.set(name, value);
  }
  return url;
}

function bearer(text) {
  return { Authorization: `Bearer ${text}` };
}

/** The headers of every request: the key, and that it is the console's own, which the latencies leave out. */
function withKey(headers = {}) {
  const own = { ...headers, "X-Placerec-Console": "1" };
  return key.value ? { ...bearer(key.value), ...own } : own;
}

async function problemOf(answer) {
  const seconds = Number(answer.headers.get("retry-after")) || null;
  const told = await answer.json().catch(() => ({}));
  return new Problem(answer.status, told, answer.headers.get("x-request-id"), seconds);
}

/** Send a request and give its answer, which is a success.
 *
 * Throws a Problem, Disconnected, or an AbortError.
 */
export async function send(method, path, { query, json, body, headers, signal: abort } = {}) {
  const given = withKey(headers);
  let content = body;
  if (json !== undefined) {
    given["Content-Type"] = "application/json";
    content = JSON.stringify(json);
  }
  const options = { method, headers: given, body: content, signal: abort, credentials: "omit" };
  for (let attempt = 1; ; attempt += 1) {
    const problem = await once(address(path, query), options);
    if (!(problem instanceof Problem)) return problem;
    const again = [429, 503].includes(problem.status) && problem.retryAfter && attempt < ATTEMPTS;
    if (problem.status === 401 && given.Authorization === withKey().Authorization) keyNeeded.value = problem;
    if (!again || (method !== "GET" && problem.slug !== "rate-exceeded")) throw problem;
    heldUntil = Math.max(heldUntil, Date.now() + Math.min(problem.retryAfter, 10) * 1000);
  }
}

async function once(url, options) {
  await turn();
  try {
    const answer = await fetch(url, options);
    return answer.ok ? answer : await problemOf(answer);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    lost();
    throw new Disconnected();
  } finally {
    next();
  }
}

export async function get(path, query, options) {
  const answer = await send("GET", path, { query, ...options });
  return answer.json();
}

/** A resource and its ETag, for an edit with If-Match. */
export async function getTagged(path, query, signal) {
  const answer = await send("GET", path, { query, signal });
  return { data: await answer.json(), tag: answer.headers.get("etag") };
}

export async function post(path, json, options) {
  const answer = await send("POST", path, { json, ...options });
  return answer.status === 204 ? null : answer.json();
}

export async function patch(path, json, tag) {
  const headers = tag ? { "If-Match": tag } : {};
  return (await send("PATCH", path, { json, headers })).json();
}

export async function remove(path, headers) {
  await send("DELETE", path, { headers });
}

/** All items of a listing, page after page. */
export async function all(path, query = {}, options) {
  const items = [];
  for (let cursor = null; ; ) {
    const page = await get(path, { limit: 1000, ...query, cursor }, options);
    items.push(...page.items);
    cursor = page.next_cursor;
    if (!cursor) return items;
  }
}

/** Send a file with its progress, which fetch does not tell. */
export function upload(path, file, { query, type, progress, abort } = {}) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", address(path, query));
    request.responseType = "json";
    for (const [name, value] of Object.entries(withKey({ "Content-Type": type }))) request.setRequestHeader(name, value);
    request.upload.onprogress = (event) => progress?.(event.loaded, event.total);
    request.onload = () => {
      const { status, response } = request;
      if (status < 400) resolve(response);
      else reject(new Problem(status, response || {}, request.getResponseHeader("x-request-id"), null));
    };
    request.onerror = () => {
      lost();
      reject(new Disconnected());
    };
    request.onabort = () => reject(new DOMException("It was given up.", "AbortError"));
    abort?.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}

/** Fetch a file with its progress, and let the browser save it. */
export async function download(path, name, { query, progress, signal: abort } = {}) {
  const answer = await send("GET", path, { query, signal: abort });
  const total = Number(answer.headers.get("content-length")) || null;
  let done = 0;
  const counted = new TransformStream({
    transform(chunk, controller) {
      done += chunk.length;
      progress?.(done, total);
      controller.enqueue(chunk);
    },
  });
  save(await new Response(answer.body.pipeThrough(counted)).blob(), name);
}

/** Let the browser save a blob under a name. */
export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** Calls a function unless it is put off, again and again, before so many milliseconds are over. */
class Watch {
  constructor(milliseconds, call) {
    Object.assign(this, { milliseconds, call });
    this.putOff();
  }

  putOff() {
    clearTimeout(this.timer);
    this.timer = setTimeout(this.call, this.milliseconds);
  }

  end() {
    clearTimeout(this.timer);
  }
}

/** Follow server-sent events until the signal is aborted; a lost stream, or a silent one, is taken up where it ended.
 *
 * onEvent gets the event's name and its data; onState gets true while the stream is open.  A problem ends it.
 * heard: its `last` is the id of the last event that was heard, after which a stream that is given it goes on.
 */
export async function follow(path, { query, onEvent, onState = () => {}, signal: abort, endless = true, heard = { last: null } }) {
  for (let wait = 500; !abort.aborted; wait = Math.min(wait * 2, 8000)) {
    const attempt = new AbortController();
    const watch = new Watch(SILENCE, () => attempt.abort());
    try {
      const headers = withKey(heard.last === null ? {} : { "Last-Event-ID": heard.last });
      const options = { headers, signal: AbortSignal.any([abort, attempt.signal]), cache: "no-store", credentials: "omit" };
      const answer = await fetch(address(path, query), options);
      if (answer.status === 204) return;
      if (!answer.ok) throw await problemOf(answer);
      onState(true);
      wait = 500;
      for await (const event of eventsOf(answer.body, () => watch.putOff())) {
        if (abort.aborted) return;
        if (event.id !== null) heard.last = event.id;
        onEvent(event.name, JSON.parse(event.data));
      }
      if (!endless) return;
    } catch (error) {
      if (abort.aborted) return;
      if (error instanceof Problem && ![429, 503].includes(error.status)) throw error;
      if (!(error instanceof Problem)) lost();
    } finally {
      watch.end();
    }
    onState(false);
    await sleep(wait);
  }
}

/** The events of a stream; onBytes is called whenever anything comes, a comment too. */
async function* eventsOf(body, onBytes) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    onBytes();
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const event = { id: null, name: "message", data: "" };
      for (const line of block.split("\n")) {
        const [, field, content] = /^(\w+): ?(.*)$/.exec(line) || [];
        if (field === "id") event.id = content;
        else if (field === "event") event.name = content;
        else if (field === "data") event.data += content;
      }
      if (event.data) yield event;
    }
  }
}
