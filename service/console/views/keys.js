// Keys: who may do what.  A new one is shown once; one in force can be narrowed or deleted.
import { all, identify, pathOf, send, useKey } from "../shared/api.js";
import { ByName, complain, Field, FormDialog, Head, Moment, Nothing, Pill, say } from "../shared/elements.js";
import { MapsField } from "../shared/maps_field.js";
import { Shown, useResource } from "../shared/resource.js";
import { newKey } from "../shared/secret.js";
import { html, useRef, useState } from "../shared/view.js";

const ROLES = ["query", "enrol", "admin"];
const TONES = { "in force": "good", revoked: "bad", expired: "warn" };

export default function Keys() {
  const keys = useResource((signal) => all("/keys", {}, { signal }), [], { every: 30_000 });
  const [ended, setEnded] = useState(false);
  const [dialog, setDialog] = useState(null);
  const close = () => setDialog(null);
  const tools = { open: setDialog, close, changed: keys.reload };
  const create = () => setDialog(html`<${Create} first=${keys.data.length === 0} ...${tools} />`);
  return html`
    <${Head} title="Keys" note="Each caller has a key of its own, so that one can be deleted alone.">
      <label class="row"><input type="checkbox" checked=${ended} onChange=${() => setEnded(!ended)} /> also ended ones</label>
      <button type="button" class="primary" disabled=${keys.data === undefined} onClick=${create}>Create a key</button>
    <//>
    <${Shown} resource=${keys}>
      ${(items) => {
        const shown = items.filter((one) => ended || one.state === "in force").reverse();
        return shown.length === 0
          ? html`<${Nothing} title=${items.length === 0 ? "There are no keys" : "No key is in force"}>${items.length === 0 && "Everybody on this machine may do everything. The first key ends that."}<//>`
          : html`<${Table} items=${shown} ...${tools} />`;
      }}
    <//>
    ${dialog}
  `;
}

function Table({ items, open, close, changed }) {
  return html`
    <div class="table" tabindex="0" role="region" aria-label="Keys">
      <table>
        <thead><tr><th>Name</th><th>Role</th><th>Maps</th><th>State</th><th>Created</th><th>Last used</th><th>Expires</th><th><span class="hidden">Actions</span></th></tr></thead>
        <tbody>
          ${items.map((key) => html`
            <tr key=${key.id}>
              <td><strong>${key.name}</strong>${key.own && html` <${Pill} tone="on">yours<//>`} <code class="faint small">${key.id}</code></td>
              <td>${key.role}${key.role === "enrol" && key.learn && html` <${Pill} tone="on" title="Maps that learn may learn from its runs">teaches<//>`}</td>
              <td class="long">${key.maps === null ? "all" : key.maps.join(", ")}</td>
              <td><${Pill} tone=${TONES[key.state]}>${key.state}<//></td>
              <td class="nowrap"><${Moment} at=${key.created_at} /></td>
              <td class="nowrap"><${Moment} at=${key.last_used_at} /></td>
              <td class="nowrap">${key.expires_at ? html`<${Moment} at=${key.expires_at} />` : html`<span class="faint">never</span>`}</td>
              <td class="actions-cell">
                ${key.state === "in force" && html`
                  <button type="button" class="small" aria-label=${`Rotate ${key.name}`} onClick=${() => open(html`<${Rotate} key_=${key} close=${close} changed=${changed} />`)}>Rotate</button>
                  <button type="button" class="small" aria-label=${`Narrow ${key.name}`} onClick=${() => open(html`<${Narrow} key_=${key} close=${close} changed=${changed} />`)}>Narrow</button>
                  <button type="button" class="small danger" aria-label=${`Delete ${key.name}`} onClick=${() => open(html`<${Delete} key_=${key} close=${close} changed=${changed} />`)}>Delete</button>
                `}
              </td>
            </tr>
          `)}
        </tbody>
      </table>
    </div>
  `;
}

function Locking({ shown, value, change }) {
  return shown && html`
    <label class="field check"><input type="checkbox" checked=${value} onChange=${() => change(!value)} /><span>Do it although no admin key for all maps is left; only the command line on the machine helps then.</span></label>
  `;
}

/** For changes of keys: where one would lock all admins out, it has to be meant. */
function useLocking() {
  const [asked, setAsked] = useState(false);
  const [value, change] = useState(false);
  const guarded = (call) => async () => {
    try {
      await call(value ? { lock_out: true } : {});
    } catch (error) {
      if (error.slug === "last-admin-key") setAsked(true);
      throw error;
    }
  };
  return { guarded, box: html`<${Locking} shown=${asked} value=${value} change=${change} />` };
}

function Create({ first, close, changed }) {
  const [fields, setFields] = useState({ name: "", role: first ? "admin" : "query", learn: false, maps: null, expires: "" });
  const change = (changes) => setFields((old) => ({ ...old, ...changes }));
  const { guarded, box } = useLocking();
  const create = guarded(async (query) => {
    const { name, role, maps, expires } = fields;
    const body = { name, role, maps, learn: role === "enrol" && fields.learn, expires_at: expires ? new Date(`${expires}Z`).toISOString() : null };
    newKey.value = await (await send("POST", "/keys", { query, json: body })).json();
    if (first) useKey(newKey.value.key, { known: true }).catch(complain); // without it the next request would be refused
    changed();
  });
  return html`
    <${FormDialog} title="Create a key" action="Create" ready=${fields.name !== "" && fields.maps?.length !== 0} close=${close} send=${create}>
      ${first && html`<p class="notice">With the first key everybody needs one, you too. Make it an admin key for all maps; it is used here at once.</p>`}
      <${Field} label="Name"><input required maxlength="64" value=${fields.name} onInput=${(event) => change({ name: event.target.value })} autofocus autocomplete="off" spellcheck=${false} /><//>
      <${RoleField} roles=${ROLES} value=${fields.role} change=${(role) => change({ role })} />
      ${fields.role === "enrol" && html`<${LearnField} value=${fields.learn} change=${(learn) => change({ learn })} />`}
      <${MapsField} value=${fields.maps} change=${(maps) => change({ maps })} />
      <${Field} label="Expires (UTC)" hint="Never, if left out."><input type="datetime-local" value=${fields.expires} onInput=${(event) => change({ expires: event.target.value })} /><//>
      ${box}
    <//>
  `;
}

const MEANING = { query: "asks and reads", enrol: "also changes places", admin: "may do everything" };

function RoleField({ roles, value, change }) {
  return html`
    <${Field} label="Role">
      <select value=${value} onChange=${(event) => change(event.target.value)}>${roles.map((one) => html`<option value=${one}>${one}: ${MEANING[one]}</option>`)}</select>
    <//>
  `;
}

/** An option of the role enrol; admin includes it, and query cannot have it. */
function LearnField({ value, change }) {
  return html`<label class="field check"><input type="checkbox" checked=${value} onChange=${() => change(!value)} /><span>Maps that learn may learn from its runs</span></label>`;
}

function Narrow({ key_: key, close, changed }) {
  const [role, setRole] = useState(key.role);
  const [learn, setLearn] = useState(key.learn);
  const [maps, setMaps] = useState(key.maps);
  const [expires, setExpires] = useState(key.expires_at ? key.expires_at.slice(0, 16) : "");
  const { guarded, box } = useLocking();
  const save = guarded(async (query) => {
    const changes = {};
    if (role !== key.role) changes.role = role;
    if (role === "enrol" && learn !== key.learn) changes.learn = learn;
    if (JSON.stringify(maps) !== JSON.stringify(key.maps)) changes.maps = maps;
    if (expires && expires !== key.expires_at?.slice(0, 16)) changes.expires_at = new Date(`${expires}Z`).toISOString();
    await send("PATCH", pathOf("keys", key.id), { query, json: changes });
    say(`The key ${key.name} was narrowed.`);
    if (key.own) await identify();
    changed();
  });
  return html`
    <${FormDialog} title=${`Narrow ${key.name}`} action="Narrow" ready=${maps?.length !== 0} close=${close} send=${save}>
      <p class="faint">A key can only be narrowed: to a lower role, fewer maps, an earlier end, no more learning from its runs.</p>
      <${RoleField} roles=${ROLES.slice(0, ROLES.indexOf(key.role) + 1)} value=${role} change=${setRole} />
      ${role === "enrol" && key.learn && html`<${LearnField} value=${learn} change=${setLearn} />`}
      <${MapsField} value=${maps} among=${key.maps} change=${setMaps} />
      <${Field} label="Expires (UTC)"><input type="datetime-local" value=${expires} max=${key.expires_at?.slice(0, 16)} onInput=${(event) => setExpires(event.target.value)} /><//>
      ${box}
    <//>
  `;
}

const ENDS = { 0: "at once", 1: "in an hour", 24: "in a day", 168: "in a week" };

/** Another key of the same name that may do the same takes the place of one, which goes on for a while. */
function Rotate({ key_: key, close, changed }) {
  const [hours, setHours] = useState("24");
  const { guarded, box } = useLocking();
  const made = useRef(null);
  const rotate = guarded(async (query) => {
    const { id, name, role, learn, maps, expires_at: expires } = key;
    // If the old one could not be ended, this is tried again with the new one that there is by then.
    made.current ??= await (await send("POST", "/keys", { query, json: { name, role, maps, learn: role === "enrol" && learn, expires_at: expires, replaces: id } })).json();
    if (key.own) await useKey(made.current.key, { known: true });
    const end = new Date(Date.now() + Number(hours) * 3_600_000);
    if (hours === "0") await send("DELETE", pathOf("keys", key.id), { query });
    else if (!expires || end < new Date(expires)) await send("PATCH", pathOf("keys", key.id), { query, json: { expires_at: end.toISOString() } });
    newKey.value = made.current;
    changed();
  });
  const cancel = () => {
    if (made.current) newKey.value = made.current;
    close();
  };
  return html`
    <${FormDialog} title=${`Rotate ${key.name}`} action="Make the new key" close=${cancel} send=${rotate}>
      <p>A new key of the same name, role, maps and end is made, and shown once. Give it to whoever uses the old one before that ends.</p>
      <${Field} label="The old one ends">
        <select value=${hours} onChange=${(event) => setHours(event.target.value)}>${Object.entries(ENDS).map(([value, text]) => html`<option value=${value}>${text}</option>`)}</select>
      <//>
      ${key.own && html`<p class="notice">It is the key that you use now; the console goes on with the new one.</p>`}
      ${box}
    <//>
  `;
}

function Delete({ key_: key, close, changed }) {
  const { guarded, box } = useLocking();
  const remove = guarded(async (query) => {
    await send("DELETE", pathOf("keys", key.id), { query });
    say(`The key ${key.name} was deleted.`);
    changed();
  });
  return html`
    <${ByName} title=${`Delete ${key.name}`} name=${key.name} action="Delete the key" close=${close} send=${remove}>
      <p>Whoever uses it is refused from the next request on. This cannot be undone.${key.own && html` <strong>It is the key that you use now.</strong>`}</p>
      ${box}
    <//>
  `;
}
