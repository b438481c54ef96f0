// The plan of a map: where its places lie, coloured by traverse, and where robots are now.  Without poses the traverses
// lie below one another as strips.
import { epoch, follow, get, may } from "../shared/api.js";
import { complain, Facts, Head, Loading, Name, Nothing, Verdict } from "../shared/elements.js";
import { isDark, onTheme, traverseColour } from "../shared/colours.js";
import { counted, exact, integer, metres, poseText, relative } from "../shared/formats.js";
import { Caught } from "../shared/lasso.js";
import { FloorPlan, useFloor } from "../shared/floor_plan.js";
import { mapPath } from "../shared/map_path.js";
import { Thumbnail } from "../shared/pictures.js";
import { PlanCanvas } from "../shared/plan_canvas.js";
import { contentOf, presentTints } from "../shared/plan_content.js";
import { readPlan } from "../shared/plan_data.js";
import { Robots } from "../shared/robots.js";
import { Shown, useResource, useStateOf } from "../shared/resource.js";
import { href, restate } from "../shared/router.js";
import { html, useEffect, useMemo, useRef, useState } from "../shared/view.js";

export default function Plan({ map, query }) {
  const plan = useResource((signal) => readPlan(map, signal), [map], { every: 60_000 });
  return html`
    <${Head} title=${map} note=${plan.data && planNote(plan.data)} />
    <${Shown} resource=${plan}>
      ${(data) => data.count === 0
        ? html`<${Nothing} title="The map is empty">Enrol a traverse, and it is drawn here.<//>`
        : html`
          <${Drawing} map=${map} plan=${data} query=${query} changed=${plan.reload} />
          ${data.posed === 0 && html`<${Strips} map=${map} plan=${data} />`}
        `}
    <//>
  `;
}

function planNote({ places, posed, count, gap_count: gapCount }) {
  const parts = [counted(places, "place")];
  if (count < places) parts.push(`${integer(count)} of them drawn`);
  if (posed === 0) parts.push("no poses: each traverse is a strip");
  else if (posed < count) parts.push(`${integer(count - posed)} without a pose`);
  if (gapCount) parts.push(counted(gapCount, "gap"));
  return parts.join(" · ");
}

function Drawing({ map, plan, query, changed }) {
  const [strips, setStrips] = useState(plan.posed === 0);
  const [off, setOff] = useState(new Set());
  const [showGaps, setShowGaps] = useState(true);
  const [misleading, setMisleading] = useStateOf(plan, null); // numbers of places are those of one plan
  const [live, setLive] = useState(plan.posed > 0);
  const [theme, setTheme] = useState(isDark());
  const [grid, setGrid] = useState(false);
  const [point, setPoint] = useState(null);
  const [catching, setCatching] = useState(false);
  const drawn = useMemo(() => ({ plan, strips }), [plan, strips]);
  const [selected, setSelected] = useStateOf(drawn, []);
  const floor = useFloor(map);
  const [hovered, setHovered] = useStateOf(plan, null);
  const [view, setView] = useState(null);
  const drawing = useRef(null);
  const [ground, places, above] = [useRef(null), useRef(null), useRef(null)];
  const chosen = query.place !== undefined ? plan.index.get(query.place) ?? null : null;
  const choose = (number) => restate({ place: number === null ? "" : plan.ids[number] });
  const latest = useRef({});
  const seen = useRef({}); // as it is drawn: what the pointer meets
  latest.current = { choose, chosen, plan, setHovered, setSelected };

  useEffect(() => onTheme(() => setTheme(isDark())), []);
  useEffect(() => {
    drawing.current = new PlanCanvas(places.current, above.current, {
      onChoose: (number) => seen.current.choose(number),
      onHover: (number) => seen.current.setHovered(number),
      onView: setView,
      onPoint: setPoint,
      onLasso: (numbers) => {
        seen.current.setSelected(numbers);
        setCatching(false);
      },
      ground: ground.current,
      onStep: (step) => stepOn(latest.current, step, drawing.current),
    });
    return () => drawing.current.close();
  }, []);
  const groups = plan.traverses;
  const content = useMemo(() => contentOf(plan, { strips, off, showGaps }), [plan, strips, off, showGaps, theme]);
  const shape = `${strips} ${map}`;
  const fitted = useRef(null);
  useEffect(() => {
    seen.current = latest.current;
    drawing.current.mark({ tints: presentTints() });
    drawing.current.show(content, fitted.current !== shape);
    if (fitted.current !== shape && chosen !== null) drawing.current.centre(chosen);
    fitted.current = shape;
  }, [content]);
  useEffect(() => drawing.current.mark({ chosen, hovered, misleading: misleading || [], selected }), [chosen, hovered, misleading, selected]);
  useEffect(() => {
    drawing.current.catching = catching;
  }, [catching]);
  useEffect(() => drawing.current.lay(strips ? {} : { grid, image: floor.image, placed: floor.placed }), [grid, floor.image, floor.placed, strips, theme]);
  const robots = useRobots(map, plan, live && !strips, drawing);

  const told = hovered ?? null;
  return html`
    <div class="plan">
      <div class="stack">
        <div class="plan-canvas">
          <canvas ref=${ground} class="ground" aria-hidden="true"></canvas>
          <canvas ref=${places} class="places" aria-hidden="true"></canvas>
          <canvas ref=${above} class=${catching ? "catching" : ""} tabindex="0" role="img" aria-label=${`Plan of ${map}: ${integer(plan.count)} places. Arrow keys move, plus and minus zoom, 0 shows all, n and p go along the traverse; a drag with Shift draws a lasso.`}></canvas>
          <div class="plan-tools">
            <button type="button" aria-label="Zoom in" onClick=${() => drawing.current.zoom(1.4)}>+</button>
            <button type="button" aria-label="Zoom out" onClick=${() => drawing.current.zoom(1 / 1.4)}>−</button>
            <button type="button" aria-label="Show all" title="Show all" onClick=${() => drawing.current.fit()}>⤢</button>
          </div>
          <div class="plan-read">
            ${view && html`<${ScaleBar} scale=${view.scale} strips=${strips} />`}
            ${told !== null ? html`<span>${plan.ids[told]}</span>` : point && !strips && html`<span>${poseText(plan.projection.back(point))}</span>`}
          </div>
          ${!strips && html`<${Compass} geographic=${plan.projection.geographic} />`}
          ${told !== null && told !== chosen && html`<${Hovered} key=${told} map=${map} plan=${plan} number=${told} at=${drawing.current.pixel(told)} size=${[drawing.current.width, drawing.current.height]} />`}
        </div>
        <div class="filters">
          ${plan.posed > 0 && html`
            <div class="segments" role="group" aria-label="Drawing">
              <button type="button" aria-pressed=${!strips} onClick=${() => setStrips(false)}>Plan</button>
              <button type="button" aria-pressed=${strips} onClick=${() => setStrips(true)}>Strips</button>
            </div>
          `}
          ${may("enrol") && html`<button type="button" aria-pressed=${catching} onClick=${() => setCatching(!catching)}>Lasso</button>`}
          <${Find} plan=${plan} choose=${(number) => { choose(number); drawing.current?.centre(number); }} />
        </div>
      </div>
      <div class="stack">
        ${selected.length > 0 && html`<${Caught} map=${map} plan=${plan} numbers=${selected} drop=${() => setSelected([])} changed=${changed} />`}
        ${chosen !== null && html`<${Chosen} map=${map} plan=${plan} number=${chosen} close=${() => choose(null)} />`}
        <section class="panel">
          <h2>Traverses</h2>
          <${Legend} groups=${groups} off=${off} setOff=${setOff} />
        </section>
        <section class="panel">
          <h2>Also shown</h2>
          ${plan.posed > 0 && html`<label class="row"><input type="checkbox" checked=${grid} onChange=${() => setGrid(!grid)} /> Grid, in metres</label>`}
          ${plan.posed > 1 && html`<${FloorPlan} floor=${floor} plan=${plan} chosen=${chosen} />`}
          ${plan.gap_count > 0 && html`<label class="row"><input type="checkbox" checked=${showGaps} onChange=${() => setShowGaps(!showGaps)} /> Gaps (${integer(plan.gap_count)})</label>`}
          ${plan.posed > 0 && html`<label class="row"><input type="checkbox" checked=${live} onChange=${() => setLive(!live)} /> Robots and answers, live</label>`}
          ${may("enrol") && html`<${Misleading} map=${map} plan=${plan} found=${misleading} setFound=${setMisleading} />`}
          <${RobotList} robots=${robots} />
        </section>
      </div>
    </div>
  `;
}

/** Where north is; a metric map says only where its axes point. */
function Compass({ geographic }) {
  const text = geographic ? "North is up" : "x to the right, y up";
  return html`<div class="compass" role="img" aria-label=${text} title=${text}><span aria-hidden="true">↑</span><span aria-hidden="true">${geographic ? "N" : "y"}</span></div>`;
}

const CARD = [150, 150];

/** A place under the pointer: its picture beside it, within the plan. */
function Hovered({ map, plan, number, at: [px, py], size: [width, height] }) {
  const left = Math.max(4, px + 16 + CARD[0] > width ? px - 16 - CARD[0] : px + 16);
  const top = Math.max(4, Math.min(py - CARD[1] / 2, height - CARD[1] - 4));
  return html`<div class="hovered" style=${{ left: `${left}px`, top: `${top}px` }}><${Thumbnail} map=${map} place=${plan.ids[number]} /><span class="small"><${Name} text=${plan.ids[number]} /></span></div>`;
}

const MOST_OF_STRIP = 60;

/** Without poses: the traverses as rows of their pictures, evenly chosen. */
function Strips({ map, plan }) {
  return html`
    <section class="stack" aria-label="Traverses as pictures">
      ${plan.traverses.slice(0, 20).map(({ name, places }) => {
        const pace = Math.max(1, Math.ceil(places.length / MOST_OF_STRIP));
        const shown = places.filter((_, one) => one % pace === 0);
        return html`
          <div class="panel" key=${name}>
            <div class="spread"><h2>${name ?? "no traverse"}</h2><span class="faint">${counted(places.length, "place")}${pace > 1 && html`, every ${integer(pace)}th`}</span></div>
            <ul class="strip" tabindex="0" role="group" aria-label=${`Pictures of ${name ?? "places of no traverse"}`}>
              ${shown.map((one) => html`<li key=${one}><a href=${href("maps", map, "places", plan.ids[one])} title=${plan.ids[one]}><${Thumbnail} map=${map} place=${plan.ids[one]} /></a></li>`)}
            </ul>
          </div>
        `;
      })}
    </section>
  `;
}

function stepOn({ chosen, plan, choose }, step, drawing) {
  const { places } = chosen === null ? plan.traverses[0] : plan.traverses.find((one) => one.places.includes(chosen));
  const next = chosen === null ? places[0] : places[places.indexOf(chosen) + step];
  if (next === undefined) return;
  choose(next);
  drawing.centre(next);
}

function ScaleBar({ scale, strips }) {
  const wanted = 120 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map((one) => one * power).find((one) => one <= wanted);
  const text = strips ? counted(Math.max(1, length), "frame") : metres(length).replace(/\.0+ /, " ");
  return html`<span><span>${text}</span><div class="scale-bar" style=${{ width: `${length * scale}px` }}></div></span>`;
}

function Find({ plan, choose }) {
  const [text, setText] = useState("");
  const [missing, setMissing] = useState(false);
  const find = (event) => {
    event.preventDefault();
    const wanted = text.trim();
    const number = plan.index.get(wanted) ?? plan.ids.findIndex((id) => id.startsWith(wanted));
    setMissing(number === -1);
    if (wanted && number !== -1) choose(number);
  };
  return html`
    <form class="row" role="search" onSubmit=${find}>
      <input aria-label="Find a place" placeholder="Find a place" value=${text} onInput=${(event) => setText(event.target.value)} spellcheck=${false} />
      <button type="submit">Find</button>
      <span role="status" class="faint">${missing && "no such place"}</span>
    </form>
  `;
}

function Legend({ groups, off, setOff }) {
  const toggle = (name) => {
    const made = new Set(off);
    if (!made.delete(name)) made.add(name);
    setOff(made);
  };
  return html`
    <div class="legend">
      ${groups.map((one, number) => html`
        <label>
          <input type="checkbox" checked=${!off.has(one.name)} onChange=${() => toggle(one.name)} />
          <span class="swatch" style=${{ background: traverseColour(one.name === null ? -1 : number) }}></span>
          <span class="name">${one.name === null ? html`<em>no traverse</em>` : html`<${Name} text=${one.name} />`}</span>
          <span class="faint">${integer(one.places.length)}</span>
        </label>
      `)}
    </div>
    ${groups.length > 4 && html`
      <div class="row">
        <button type="button" class="small" onClick=${() => setOff(new Set())}>All</button>
        <button type="button" class="small" onClick=${() => setOff(new Set(groups.map((one) => one.name)))}>None</button>
      </div>
    `}
  `;
}

function Chosen({ map, plan, number, close }) {
  const id = plan.ids[number];
  const pose = Object.fromEntries(["x", "y", "z", "latitude", "longitude", "heading"].filter((name) => plan[name] && plan[name][number] !== null).map((name) => [name, plan[name][number]]));
  const taken = plan.timestamp?.[number];
  return html`
    <section class="panel" aria-label="Chosen place">
      <div class="spread"><h2><a href=${href("maps", map, "places", id)}>${id}</a></h2><button type="button" class="quiet" aria-label="Choose none" onClick=${close}>✕</button></div>
      <${Thumbnail} map=${map} place=${id} />
      <${Facts} rows=${[
        ["Traverse", plan.sequence[number] < 0 ? "–" : plan.sequences[plan.sequence[number]]],
        ["Pose", poseText(Object.keys(pose).length > 1 ? pose : null)],
        taken && ["Taken", exact(taken)],
        (plan.flags[number] & 1) > 0 && ["Note", "The pose comes from an alignment."],
      ]} />
    </section>
  `;
}

/** Places that the health report finds misleading; it is a long search, so it is asked for. */
function Misleading({ map, plan, found, setFound }) {
  const [busy, setBusy] = useState(false);
  const look = async () => {
    setBusy(true);
    try {
      const { aliasing } = await get(mapPath(map, "health"));
      const ids = [...aliasing.hubs, ...aliasing.aliases, ...aliasing.unsure].map((one) => one.place);
      setFound([...new Set(ids)].map((id) => plan.index.get(id)).filter((number) => number !== undefined));
    } catch (error) {
      complain(error);
    }
    setBusy(false);
  };
  if (busy) return html`<${Loading} what="Comparing all places" />`;
  if (found === null) return html`<button type="button" onClick=${look}>Find places that mislead</button>`;
  return html`
    <div class="spread">
      <span>${found.length === 0 ? "No place misleads" : `${integer(found.length)} places mislead (ringed)`}</span>
      <button type="button" class="small" onClick=${() => setFound(null)}>Hide</button>
    </div>
  `;
}

/** Robots as the map's events tell of them, drawn as they move. */
function useRobots(map, plan, live, drawing) {
  const [robots, setRobots] = useState([]);
  useEffect(() => {
    if (!live) {
      drawing.current.mark({ robots: [], dots: [] });
      setRobots([]);
      return undefined;
    }
    const controller = new AbortController();
    const fleet = new Robots(plan.projection);
    const draw = () => {
      const told = fleet.now();
      drawing.current?.mark(told);
      setRobots(told.robots);
    };
    fleet.begin(map, controller.signal).then(draw, () => {});
    const onEvent = (name, event) => fleet.take(name, event) && draw();
    follow(mapPath(map, "events"), { query: { kinds: "query,session" }, onEvent, signal: controller.signal }).catch(() => {});
    const timer = setInterval(draw, 2000);
    return () => {
      controller.abort();
      clearInterval(timer);
    };
  }, [map, plan, live, epoch.value]);
  return robots;
}

const MOST_SILENT = 12;

/** Where robots are now, and apart from them those of which nothing was heard for seconds. */
function RobotList({ robots }) {
  const [heard, silent] = [robots.filter((one) => !one.silent), robots.filter((one) => one.silent)];
  return html`
    ${heard.length > 0 && html`
      <ul aria-label="Robots">
        ${heard.map((one) => html`<li class="robot" key=${one.session}><${RobotName} robot=${one} robots=${robots} /><${Verdict} verdict=${one.verdict} /></li>`)}
      </ul>
    `}
    ${silent.length > 0 && html`
      <h3>Silent</h3>
      <ul aria-label="Silent robots" class="faint">
        ${silent.slice(0, MOST_SILENT).map((one) => html`<li class="robot" key=${one.session}><${RobotName} robot=${one} robots=${robots} /><span class="nowrap">seen ${relative(one.seen)}</span></li>`)}
      </ul>
      ${silent.length > MOST_SILENT && html`<p class="faint small">and ${integer(silent.length - MOST_SILENT)} more</p>`}
    `}
  `;
}

/** The name of a robot, with the beginning of its session where another one has the same. */
function RobotName({ robot: { label, session }, robots }) {
  const twice = robots.filter((one) => one.label === label).length > 1;
  return html`<span class="who" title=${session}><${Name} text=${label} />${twice && label !== session && html` <code class="small faint nowrap">${session.slice(0, 6)}</code>`}</span>`;
}
