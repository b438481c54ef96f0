// The places of a map as thumbnails, page by page and filtered; one place, where the address names it.
import { all, get, may } from "../shared/api.js";
import { saveCsv } from "../shared/csv.js";
import { DeletePlaces } from "../shared/delete_places.js";
import { complain, Field, Head, Moment, Name, Nothing, Pager, Typed } from "../shared/elements.js";
import { counted, integer, poseText } from "../shared/formats.js";
import { mapPath } from "../shared/map_path.js";
import { Thumbnail } from "../shared/pictures.js";
import { Place } from "../shared/place.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useEffect, useState } from "../shared/view.js";

const PAGE = 60;
const COLUMNS = [
  ...["id", "sequence", "timestamp", "camera"].map((name) => [name, (place) => place[name]]),
  ...["x", "y", "z", "latitude", "longitude", "heading"].map((name) => [name, (place) => place.pose?.[name]]),
  ...["pose_of", "regions", "picture", "created_at", "updated_at"].map((name) => [name, (place) => place[name]]),
  ["metadata", (place) => JSON.stringify(place.metadata)],
];
const FILTERS = ["sequence", "camera", "after", "before", "where"];

export default function Places({ map, rest, query }) {
  if (rest.length > 0) return html`<${Place} key=${rest[0]} map=${map} id=${rest[0]} />`;
  return html`<${List} map=${map} query=${query} />`;
}

function List({ map, query }) {
  const filter = Object.fromEntries(FILTERS.filter((name) => query[name]).map((name) => [name, query[name]]));
  const present = JSON.stringify(filter);
  const [cursors, setCursors] = useStateOf(present, [""]);
  const [chosen, setChosen] = useStateOf(present, new Set());
  const [dialog, setDialog] = useState(null);
  const cursor = cursors.at(-1);
  const page = useResource((signal) => get(mapPath(map, "places"), { ...filter, limit: PAGE, cursor }, { signal }), [map, filter, cursor]);
  const about = useResource((signal) => get(mapPath(map), {}, { signal }), [map]);
  const toggle = (id) => setChosen((old) => toggled(old, id));
  const remove = (order) => {
    const close = () => setDialog(null);
    const done = () => {
      setChosen(new Set());
      setCursors([""]);
      page.reload();
      about.reload();
    };
    setDialog(html`<${DeletePlaces} map=${map} order=${order} close=${close} done=${done} />`);
  };
  const [saving, setSaving] = useState(false);
  const keep = async () => {
    setSaving(true);
    try {
      saveCsv(`${map}-places.csv`, COLUMNS, await all(mapPath(map, "places"), filter));
    } catch (error) {
      complain(error);
    }
    setSaving(false);
  };
  return html`
    <${Head} title="Places" note=${about.data && `${counted(about.data.places, "place")} in ${map}`}>
      ${chosen.size === 0 && html`<button type="button" disabled=${saving} onClick=${keep}>${saving ? "Reading …" : "Save as CSV"}</button>`}
      ${may("enrol") && chosen.size > 0 && html`
        <button type="button" onClick=${() => setChosen(new Set())}>Choose none</button>
        <button type="button" class="danger" onClick=${() => remove({ ids: [...chosen] })}>Delete ${integer(chosen.size)} chosen</button>
      `}
      ${may("enrol") && chosen.size === 0 && present !== "{}" && html`
        <button type="button" class="danger" onClick=${() => remove({ filter: asOrder(filter) })}>Delete all of these</button>
      `}
    <//>
    <${Filters} map=${map} filter=${filter} />
    <${Shown} resource=${page}>
      ${({ items, next_cursor: next }) => html`
        ${items.length === 0 && html`<${Nothing} title="No places">${present === "{}" ? "Nothing was enrolled into this map yet." : "No place fits the filters."}<//>`}
        ${items.length === 0 && asTexts(filter.where) && html`<${AsTexts} where=${filter.where} />`}
        <ul class="thumbs" aria-label="Places">
          ${items.map((place) => html`<${Tile} key=${place.id} map=${map} place=${place} chosen=${chosen.has(place.id)} toggle=${toggle} />`)}
        </ul>
        <${Pager} cursors=${cursors} next=${next} show=${setCursors} back="Before" on="Next" />
      `}
    <//>
    ${dialog}
  `;
}

function toggled(set, id) {
  const made = new Set(set);
  if (!made.delete(id)) made.add(id);
  return made;
}

/** The filters of a listing as the filter of an order to delete. */
function asOrder({ where, ...others }) {
  return where ? { ...others, where: JSON.parse(where) } : others;
}

function Filters({ map, filter }) {
  const sequences = useResource((signal) => get(mapPath(map, "sequences"), { limit: 1000 }, { signal }), [map]);
  const cameras = useResource((signal) => get(mapPath(map, "cameras"), {}, { signal }), [map]);
  const [where, setWhere] = useState(shownWhere(filter.where));
  const [wrong, setWrong] = useState("");
  useEffect(() => setWhere(shownWhere(filter.where)), [filter.where]);
  const given = (name) => ({ value: filter[name] || "", onChange: (event) => restate({ [name]: event.target.value }) });
  const moment = (name) => ({ type: "datetime-local", step: "1", value: filter[name] || "", change: ({ value }) => restate({ [name]: value }) });
  const applyWhere = () => {
    const read = readWhere(where);
    setWrong(read === null ? "Write name = value, several separated by commas." : "");
    if (read !== null) restate({ where: read });
  };
  return html`
    <div class="filters" role="search" aria-label="Filters">
      <${Field} label="Traverse">
        <select ...${given("sequence")}>
          <option value="">all</option>
          ${(sequences.data?.items || []).map((one) => html`<option value=${one.name}>${one.name} (${integer(one.places)})</option>`)}
        </select>
      <//>
      ${cameras.data?.items.length > 0 && html`
        <${Field} label="Camera">
          <select ...${given("camera")}>
            <option value="">all</option>
            ${cameras.data.items.map((one) => html`<option value=${one.name}>${one.name}</option>`)}
          </select>
        <//>
      `}
      <${Field} label="Taken from (UTC)"><${Typed} ...${moment("after")} /><//>
      <${Field} label="to (UTC)"><${Typed} ...${moment("before")} /><//>
      <${Field} label="Metadata" hint=${wrong}>
        <input placeholder="floor = 2, light = day" value=${where} onInput=${(event) => setWhere(event.target.value)} onChange=${applyWhere} spellcheck=${false} />
      <//>
      ${Object.keys(filter).length > 0 && html`<button type="button" onClick=${() => restate(Object.fromEntries(FILTERS.map((name) => [name, ""])))}>Clear</button>`}
    </div>
  `;
}

/** The same conditions with texts for numbers and truth values; null if there are none of these. */
function asTexts(where) {
  const told = Object.entries(where ? JSON.parse(where) : {});
  if (told.every(([, value]) => typeof value === "string")) return null;
  return JSON.stringify(Object.fromEntries(told.map(([name, value]) => [name, String(value)])));
}

/** What was typed without quotation marks is a number, which no text equals: the other reading is offered. */
function AsTexts({ where }) {
  const texts = asTexts(where);
  return html`
    <p class="row">
      <span class="faint">A number equals no text.</span>
      <button type="button" onClick=${() => restate({ where: texts })}>Look for ${shownWhere(texts)}</button>
    </p>
  `;
}

function shownWhere(text) {
  if (!text) return "";
  try {
    return Object.entries(JSON.parse(text)).map(([name, value]) => `${name} = ${typeof value === "string" && String(scalar(value)) === value && typeof scalar(value) === "string" ? value : JSON.stringify(value)}`).join(", ");
  } catch {
    return text;
  }
}

/** What was typed as a JSON object; empty without any, null if it cannot be read. */
function readWhere(text) {
  const entries = [];
  for (const part of text.split(",").filter((one) => one.trim())) {
    const [, name, value] = /^\s*([^=]+?)\s*[=:]\s*(.*?)\s*$/.exec(part) || [];
    if (!name) return null;
    entries.push([name, scalar(value)]);
  }
  return entries.length ? JSON.stringify(Object.fromEntries(entries)) : "";
}

/** A number, true, false, null or a text in quotation marks as JSON has it; any other text as it is. */
function scalar(text) {
  try {
    const value = JSON.parse(text);
    return typeof value === "object" && value !== null ? text : value;
  } catch {
    return text;
  }
}

function Tile({ map, place, chosen, toggle }) {
  return html`
    <li class=${chosen ? "thumb chosen" : "thumb"}>
      ${may("enrol") && html`<input type="checkbox" aria-label=${`Choose ${place.id}`} checked=${chosen} onChange=${() => toggle(place.id)} />`}
      <a href=${href("maps", map, "places", place.id)} title=${poseText(place.pose)}>
        <${Thumbnail} map=${map} place=${place.id} version=${place.updated_at} />
        <span class="name"><${Name} text=${place.id} /></span>
        <span class="under faint small"><span>${place.sequence ? html`<${Name} text=${place.sequence} />` : "no traverse"}</span>${place.timestamp && html`<${Moment} at=${place.timestamp} />`}</span>
      </a>
    </li>
  `;
}
