// The frame around every view: where one can go, who one is, whether the service is there, and what is being said.
import { begin as beginWithKey, caller, checkConnection, epoch, everyMap, get, isName, key, keyNeeded, may, online, useKey } from "./shared/api.js";
import { mapNames, remember, remembered } from "./shared/chosen_map.js";
import { Dialog, Field, Loading, messages, Trouble, unsay } from "./shared/elements.js";
import { href, go, route } from "./shared/router.js";
import { Secret } from "./shared/secret.js";
import { html, signal, useEffect, useState } from "./shared/view.js";

const OF_MAPS = {
  plan: ["Plan", () => import("./views/plan.js"), "query"],
  enrol: ["Enrol", () => import("./views/enrol.js"), "enrol"],
  places: ["Places", () => import("./views/places.js"), "query"],
  try: ["Try", () => import("./views/try.js"), "query"],
  live: ["Live", () => import("./views/live.js"), "query"],
  answers: ["Answers", () => import("./views/answers.js"), "query"],
  traverses: ["Traverses", () => import("./views/traverses.js"), "query"],
  calibration: ["Calibration", () => import("./views/calibration.js"), "query"],
  review: ["Review", () => import("./views/review.js"), "enrol"],
  learning: ["Learning", () => import("./views/learning.js"), "query"],
  health: ["Health", () => import("./views/health.js"), "enrol"],
  cameras: ["Cameras", () => import("./views/cameras.js"), "query"],
  upkeep: ["Upkeep", () => import("./views/upkeep.js"), "admin"],
};
const OF_SERVICE = {
  home: ["Home", () => import("./views/home.js"), "query", false],
  robots: ["Robots", () => import("./views/robots.js"), "query", false],
  maps: ["Maps", () => import("./views/maps.js"), "query", false],
  jobs: ["Jobs", () => import("./views/jobs.js"), "query", false],
  backups: ["Backups", () => import("./views/backups.js"), "admin", true],
  keys: ["Keys", () => import("./views/keys.js"), "admin", true],
  audit: ["Audit", () => import("./views/audit.js"), "admin", true],
  service: ["Service", () => import("./views/service.js"), "query", false],
};

/** The views of the service that stand above those of a map. */
const FIRST = ["home", "robots", "maps"];

const menuOpen = signal(false);

// A file that is dropped where nothing takes it must not take the place of the console.
for (const kind of ["dragover", "drop"]) {
  addEventListener(kind, (event) => {
    if (event.dataTransfer?.types.includes("Files") && !event.target.closest?.("input")) event.preventDefault();
  });
}

// The view of the present address is fetched while the service is asked who we are.
viewOf(route.value).entry?.[1]().catch(() => {});

export function Frame() {
  const [refused, setRefused] = useState(null);
  const begin = () => {
    setRefused(null);
    beginWithKey().catch(setRefused);
  };
  useEffect(begin, []);
  return html`
    ${keyNeeded.value === null ? html`<${Inside} refused=${refused} begin=${begin} />` : html`<${KeyPage} problem=${keyNeeded.value} />`}
    <${Secret} />
  `;
}

/** What there is for somebody whose key, or none, is accepted. */
function Inside({ refused, begin }) {
  return html`
    <a class="skip" href="#content" onClick=${skip}>Skip to the content</a>
    <div class=${`frame ${menuOpen.value ? "menu-open" : ""}`}>
      <${Side} />
      <main id="content" tabindex="-1">
        ${!online.value && html`<p class="offline" role="alert">The connection to the service is lost. Trying again …</p>`}
        ${caller.value !== null && html`<${View} />`}
        ${caller.value === null && refused !== null && html`<${Trouble} error=${refused} again=${begin} />`}
        ${caller.value === null && refused === null && html`<${Loading} />`}
      </main>
    </div>
    <${Messages} />
  `;
}

function skip(event) {
  event.preventDefault();
  document.getElementById("content").focus();
}

// The view that the address names

function viewOf({ parts }) {
  if (!parts.every(isName)) return { name: "", entry: null, map: null, rest: [] };
  const [first = "home", map, second = "plan", ...rest] = parts;
  if (first === "maps" && map !== undefined) return { name: second, entry: OF_MAPS[second], map, rest };
  return { name: first, entry: OF_SERVICE[first], map: null, rest: parts.slice(1) };
}

function View() {
  const { name, entry, map, rest } = viewOf(route.value);
  const [loaded, setLoaded] = useState({ name: null });
  useEffect(() => {
    let left = false; // for another view, whose code may have come first
    const load = (found) => left || setLoaded({ name, ...found });
    entry?.[1]().then(
      (module) => load({ component: module.default }),
      async (error) => {
        const there = await checkConnection();
        if (!there) return load({ error, there });
        // Browsers remember by its address that a file could not be fetched while the service was away.
        return import(`./views/${name}.js?again=${epoch.value}`).then(
          (module) => load({ component: module.default }),
          () => load({ error, there }),
        );
      },
    );
    return () => (left = true);
  }, [name, epoch.value]);
  useEffect(() => {
    menuOpen.value = false;
    scrollTo(0, 0);
    if (map) remember(map);
  }, [name, map]);
  const shown = () => {
    if (!entry) return html`<${Missing} />`;
    if (!may(entry[2]) || (entry[3] && !everyMap.value)) return html`<${Forbidden} role=${entry[2]} />`;
    if (loaded.name !== name) return html`<${Loading} />`;
    if (loaded.error) return loaded.there ? html`<${Stale} />` : html`<${Away} />`;
    return html`<${loaded.component} key=${map} map=${map} rest=${rest} query=${route.value.query} />`;
  };
  return html`<div class="view" data-view=${route.value.parts.join("/")}>${shown()}</div>`;
}

function Missing() {
  return html`<div class="nothing"><h1>There is no such view</h1><p><a href=${href("maps")}>All maps</a></p></div>`;
}

function Forbidden({ role }) {
  return html`<div class="nothing"><h1>Not for this key</h1><p>This view needs a key of role ${role}${role === "admin" && " for all maps"}.</p></div>`;
}

function Away() {
  return html`<div class="nothing"><h1>The view is not loaded yet</h1><p>It is shown as soon as the service can be reached.</p></div>`;
}

function Stale() {
  return html`
    <div class="nothing">
      <h1>The view cannot be loaded</h1>
      <p>The service may have another version by now.</p>
      <button type="button" onClick=${() => location.reload()}>Reload the page</button>
    </div>
  `;
}

// The side

function Side() {
  const { name, map } = viewOf(route.value);
  const chosen = map || remembered();
  const link = (entry, id, address, current) =>
    may(entry[2]) && (!entry[3] || everyMap.value) &&
    html`<li><a href=${address} aria-current=${current ? "page" : undefined}>${entry[0]}</a></li>`;
  return html`
    <header class="side">
      <div class="brand">
        <a href=${href("home")}><${Mark} /> placerec</a>
        <button type="button" class="menu" aria-expanded=${menuOpen.value} aria-controls="menu" onClick=${() => (menuOpen.value = !menuOpen.value)}>Menu</button>
      </div>
      <nav id="menu" aria-label="Views">
        <ul>${FIRST.map((id) => link(OF_SERVICE[id], id, href(id), !map && name === id))}</ul>
        ${caller.value && html`<${MapChoice} chosen=${chosen} name=${name} />`}
        ${chosen && caller.value && html`
          <ul class="of-map">
            ${Object.entries(OF_MAPS).map(([id, entry]) => link(entry, id, href("maps", chosen, id), map !== null && name === id))}
          </ul>
        `}
        <h2>Service</h2>
        <ul>
          ${Object.entries(OF_SERVICE).map(([id, entry]) => !FIRST.includes(id) && link(entry, id, href(id), map === null && name === id))}
        </ul>
        <${Identity} />
        <${Theme} />
      </nav>
    </header>
  `;
}

function Mark() {
  return html`
    <svg class="mark" viewBox="0 0 16 16" aria-hidden="true">
      <path d="M8 1a5 5 0 0 0-5 5c0 3.6 5 9 5 9s5-5.4 5-9a5 5 0 0 0-5-5z" /><circle cx="8" cy="6" r="2" />
    </svg>
  `;
}

function MapChoice({ chosen, name }) {
  useEffect(() => {
    get("/maps", { limit: 1000 }).then(
      (page) => (mapNames.value = page.items.map((one) => one.id)),
      () => {},
    );
  }, [epoch.value, route.value.parts.length < 2, chosen]);
  const known = mapNames.value || [];
  const names = chosen && !known.includes(chosen) ? [chosen, ...known] : known;
  if (names.length === 0) return null;
  const view = name in OF_MAPS ? name : "plan";
  return html`
    <label class="map-choice">
      <span class="label">Map</span>
      <select value=${chosen || ""} onChange=${(event) => go("maps", event.target.value, view)}>
        ${!chosen && html`<option value="" disabled>choose …</option>`}
        ${names.map((one) => html`<option value=${one}>${one}</option>`)}
      </select>
    </label>
  `;
}

function Identity() {
  const [open, setOpen] = useState(false);
  const told = caller.value;
  if (!told) return null;
  return html`
    <div class="identity">
      ${told.keys_needed
        ? html`<span title=${told.id}>${told.name}</span> <span class="pill">${told.role}</span>
            ${told.maps && html`<span class="faint small">${told.maps.join(", ")}</span>`}`
        : html`<span class="faint">No keys: open to this machine</span>`}
      ${told.keys_needed && html`<button type="button" class="small" onClick=${() => setOpen(true)}>Change key</button>`}
      ${open && html`<${Dialog} title="Change the key" close=${() => setOpen(false)}><${KeyForm} done=${() => setOpen(false)} /><//>`}
    </div>
  `;
}

// The key

function KeyPage({ problem }) {
  return html`
    <main class="key-page">
      <h1><${Mark} /> placerec</h1>
      <p>The service asks for a key. It is kept by the open tabs of this browser and sent to this service only.</p>
      ${problem.slug !== "key-needed" && html`<${Trouble} error=${problem} />`}
      <${KeyForm} />
    </main>
  `;
}

function KeyForm({ done = () => {} }) {
  const [text, setText] = useState("");
  const [error, setError] = useState(null);
  const enter = async (event) => {
    event.preventDefault();
    setError(null);
    try {
      await useKey(text);
      done();
    } catch (problem) {
      setError(problem);
    }
  };
  return html`
    <form onSubmit=${enter}>
      <${Field} label="Key">
        <input type="password" value=${text} onInput=${(event) => setText(event.target.value)} autocomplete="off" spellcheck=${false} placeholder="placerec_…" autofocus />
      <//>
      ${error && html`<${Trouble} error=${error} />`}
      <footer>
        ${key.value && html`<button type="button" onClick=${() => useKey("").then(done)}>Forget the key</button>`}
        <button type="submit" class="primary" disabled=${!text.trim()}>Use the key</button>
      </footer>
    </form>
  `;
}

// Light and dark

const THEMES = { system: "auto", light: "light", dark: "dark" };
const theme = signal(document.documentElement.dataset.theme || "system");

function choose(name) {
  theme.value = name;
  if (name === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  try {
    localStorage.setItem("placerec.theme", name);
  } catch {
    // Then it holds for this page.
  }
  dispatchEvent(new Event("themechange"));
}

function Theme() {
  return html`
    <fieldset class="theme">
      <legend class="hidden">Colours</legend>
      ${Object.entries(THEMES).map(([name, text]) => html`
        <label><input type="radio" name="theme" checked=${theme.value === name} onChange=${() => choose(name)} /><span>${text}</span></label>
      `)}
    </fieldset>
  `;
}

// Messages

function Messages() {
  return html`
    <div class="messages" role="status" aria-live="polite">
      ${messages.value.map((one) => html`
        <div class="message" key=${one.id}>
          ${one.error ? html`<${Trouble} error=${one.error} />` : html`<span>${one.text}</span>`}
          ${one.undo && html`<button type="button" onClick=${() => undo(one)}>Undo</button>`}
          <button type="button" class="quiet" aria-label="Dismiss" onClick=${() => unsay(one.id)}>✕</button>
        </div>
      `)}
    </div>
  `;
}

function undo(one) {
  unsay(one.id);
  one.undo();
}
