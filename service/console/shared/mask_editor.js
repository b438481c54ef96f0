// Areas drawn over a frame: corners by click or by key, moved by dragging.
import { percent } from "./formats.js";
import { html, useRef, useState } from "./view.js";

const STEP = 0.01;
const NEAR = 0.025;
const MOST = 64;

/** The area of a polygon as a share of the frame. */
export function areaOf(corners) {
  let sum = 0;
  corners.forEach(([x, y], one) => {
    const [u, v] = corners[(one + 1) % corners.length];
    sum += x * v - u * y;
  });
  return Math.abs(sum) / 2;
}

/** polygons: corners as shares of the frame's width and height; children: the frame. */
export function MaskEditor({ polygons, change, children }) {
  const [corners, setCorners] = useState([]);
  const [cursor, setCursor] = useState(null);
  const held = useRef(null);
  const element = useRef(null);
  const at = (event) => {
    const { left, top, width, height } = element.current.getBoundingClientRect();
    return [within((event.clientX - left) / width), within((event.clientY - top) / height)];
  };
  const put = (point) => {
    if (corners.length >= 3 && near(point, corners[0])) finish();
    else if (polygons.length < MOST) setCorners([...corners, point]);
  };
  const finish = () => {
    if (corners.length < 3) return;
    change([...polygons, corners]);
    setCorners([]);
  };
  const down = (event) => {
    const point = at(event);
    setCursor(null);
    for (const [number, polygon] of polygons.entries()) {
      const corner = polygon.findIndex((one) => near(one, point));
      if (corner !== -1 && corners.length === 0) {
        held.current = [number, corner];
        element.current.setPointerCapture(event.pointerId);
        return;
      }
    }
    put(point);
  };
  const move = (event) => {
    if (!held.current) return;
    const [number, corner] = held.current;
    change(polygons.map((one, index) => (index === number ? one.with(corner, at(event)) : one)));
  };
  const typed = (event) => {
    const [x, y] = cursor || [0.5, 0.5];
    const step = event.shiftKey ? 5 * STEP : STEP;
    const keys = {
      ArrowLeft: () => setCursor([within(x - step), y]),
      ArrowRight: () => setCursor([within(x + step), y]),
      ArrowUp: () => setCursor([x, within(y - step)]),
      ArrowDown: () => setCursor([x, within(y + step)]),
      " ": () => put([x, y]),
      Enter: finish,
      Backspace: () => setCorners(corners.slice(0, -1)),
    };
    if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    if (event.key.startsWith("Arrow") || event.key === " ") setCursor([x, y]);
    keys[event.key]();
  };
  const covered = polygons.reduce((sum, one) => sum + areaOf(one), 0);
  return html`
    <div class="stack">
      <div class="mask-frame">
        ${children}
        <svg ref=${element} viewBox="0 0 1 1" preserveAspectRatio="none" class="mask editing" tabindex="0" role="img"
          aria-label=${`${polygons.length} areas are ignored. Click corners around an area, and the first one again to close it; or move by the arrow keys, set a corner with the space bar, and close with Enter.`}
          onPointerDown=${down} onPointerMove=${move} onPointerUp=${() => { held.current = null; }} onPointerCancel=${() => { held.current = null; }} onKeyDown=${typed}>
          ${polygons.map((one) => html`<polygon points=${one.map((corner) => corner.join(",")).join(" ")} />`)}
          ${corners.length > 0 && html`<polyline points=${corners.map((corner) => corner.join(",")).join(" ")} />`}
        </svg>
        ${[...polygons.flat(), ...corners].map(([x, y]) => html`<span class="corner" style=${{ left: `${100 * x}%`, top: `${100 * y}%` }}></span>`)}
        ${cursor && html`<span class="corner cursor" style=${{ left: `${100 * cursor[0]}%`, top: `${100 * cursor[1]}%` }}></span>`}
      </div>
      <div class="spread">
        <span class="faint" role="status">${polygons.length === 0 ? "Nothing is ignored." : `Ignored: ${polygons.length === 1 ? "one area" : `${polygons.length} areas`}, about ${percent(Math.min(1, covered))} of the frame.`}${corners.length > 0 ? ` Corners of the next one: ${corners.length}.` : ""}</span>
        <span class="row">
          <button type="button" class="small" disabled=${corners.length < 3} onClick=${finish}>Close the area</button>
          <button type="button" class="small" disabled=${corners.length === 0} onClick=${() => setCorners([])}>Drop its corners</button>
          <button type="button" class="small" disabled=${polygons.length === 0} onClick=${() => change(polygons.slice(0, -1))}>Remove the last area</button>
        </span>
      </div>
      <p class="faint small">Click corners around what should be ignored, and the first one again to close. Drag a corner to move it.</p>
    </div>
  `;
}

function near([x, y], [u, v]) {
  return Math.hypot(x - u, y - v) < NEAR;
}

function within(share) {
  return Math.round(1e4 * Math.min(1, Math.max(0, share))) / 1e4;
}
