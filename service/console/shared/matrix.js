// A matrix of scores as a picture: rows are frames of one traverse, columns those of another.
import { colour, isDark, onTheme } from "./colours.js";
import { decimal, integer } from "./formats.js";
import { html, useEffect, useRef, useState } from "./view.js";

const MOST_HIGH = 0.72;

/** data: a comparison with its bytes; layers: which lines are drawn; chosen: [row, column]; choose: a function. */
export function Matrix({ data, layers, chosen, choose }) {
  const { rows, columns } = data;
  const [cells, lines, box, ramp] = [useRef(null), useRef(null), useRef(null), useRef(null)];
  const [size, setSize] = useState([0, 0]);
  const [theme, setTheme] = useState(isDark());
  useEffect(() => onTheme(() => setTheme(isDark())), []);
  useEffect(() => {
    const fit = () => {
      if (!box.current) return;
      const width = box.current.parentElement.clientWidth;
      const high = Math.min(MOST_HIGH * innerHeight, (width * rows) / columns);
      setSize([Math.round(Math.min(width, (high * columns) / rows)), Math.round(high)]);
    };
    const observer = new ResizeObserver(fit);
    observer.observe(box.current.parentElement);
    fit();
    return () => observer.disconnect();
  }, [rows, columns]);
  useEffect(() => {
    drawCells(cells.current, data);
    drawCells(ramp.current, { bytes: Uint8Array.from({ length: 128 }, (_, one) => 2 * one), rows: 1, columns: 128 });
  }, [data.bytes, theme]);
  useEffect(() => drawLines(lines.current, data, layers, chosen), [data.stretches, data.counterparts, layers.join(), chosen.join(), size.join(), theme]);
  const cellAt = (event) => {
    const row = Math.floor((event.offsetY / lines.current.clientHeight) * rows);
    const column = Math.floor((event.offsetX / lines.current.clientWidth) * columns);
    return [Math.min(Math.max(row, 0), rows - 1), Math.min(Math.max(column, 0), columns - 1)];
  };
  const typed = (event) => {
    const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    if (!steps[event.key]) return;
    event.preventDefault();
    const by = event.shiftKey ? 10 : 1;
    const [row, column] = chosen.map((one, axis) => one + by * steps[event.key][axis]);
    choose([Math.min(Math.max(row, 0), rows - 1), Math.min(Math.max(column, 0), columns - 1)]);
  };
  const text = `Similarity of ${integer(rows)} frames of ${data.query.sequence}, downwards, and ${integer(columns)} of ${data.reference.sequence}, to the right. Arrow keys choose a pair.`;
  const [pointed, setPointed] = useState(null);
  const [row, column] = pointed || chosen;
  const value = data.scale.low + (data.bytes[row * columns + column] / 255) * (data.scale.high - data.scale.low);
  return html`
    <div class="matrix-frame">
      <span class="axis across"><span>1</span><span>frames of ${data.reference.sequence}</span><span>${integer(columns)}</span></span>
      <span class="axis down"><span>1</span><span>frames of ${data.query.sequence}</span><span>${integer(rows)}</span></span>
      <div class="matrix-box">
        <div class="matrix" ref=${box} style=${{ width: `${size[0]}px`, height: `${size[1]}px` }}>
          <canvas ref=${cells} width=${columns} height=${rows} aria-hidden="true"></canvas>
          <canvas ref=${lines} width=${size[0] * devicePixelRatio} height=${size[1] * devicePixelRatio} tabindex="0" role="img" aria-label=${text} onClick=${(event) => choose(cellAt(event))} onKeyDown=${typed} onPointerMove=${(event) => setPointed(cellAt(event))} onPointerLeave=${() => setPointed(null)}></canvas>
        </div>
      </div>
      <div class="matrix-scale spread small">
        <span class="faint">frame ${integer(row + 1)} of ${data.query.sequence} against ${integer(column + 1)} of ${data.reference.sequence}: <strong>${decimal(value)}</strong></span>
        <span class="row"><span class="faint">${decimal(data.scale.low)}</span><canvas ref=${ramp} width="128" height="1" aria-hidden="true"></canvas><span class="faint">${decimal(data.scale.high)}</span></span>
      </div>
    </div>
  `;
}

/** Bytes become shades: on white the alike are dark, on black they are light. */
function drawCells(canvas, { bytes, rows, columns }) {
  const image = new ImageData(columns, rows);
  const pixels = new Uint32Array(image.data.buffer);
  const shades = shadesOf(isDark());
  for (let one = 0; one < bytes.length; one += 1) pixels[one] = shades[bytes[one]];
  canvas.getContext("2d").putImageData(image, 0, 0);
}

const DARK = [[16, 19, 22], [28, 52, 92], [42, 120, 142], [122, 209, 120], [253, 231, 130]];
const LIGHT = [[250, 250, 248], [190, 214, 222], [92, 158, 178], [38, 84, 138], [30, 20, 60]];

function shadesOf(dark) {
  const stops = dark ? DARK : LIGHT;
  return Uint32Array.from({ length: 256 }, (_, value) => {
    const place = (value / 255) * (stops.length - 1);
    const below = Math.min(Math.floor(place), stops.length - 2);
    const [red, green, blue] = stops[below].map((one, channel) => Math.round(one + (stops[below + 1][channel] - one) * (place - below)));
    return (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0;
  });
}

function drawLines(canvas, data, layers, [row, column]) {
  const context = canvas.getContext("2d");
  const [wide, high] = [canvas.width / data.columns, canvas.height / data.rows];
  const at = (one, two) => [(two + 0.5) * wide, (one + 0.5) * high];
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.lineWidth = 2 * devicePixelRatio;
  if (layers.includes("path")) {
    context.strokeStyle = colour("danger");
    for (const { query, reference } of data.stretches) {
      context.beginPath();
      query.forEach((one, place) => context.lineTo(...at(one, reference[place])));
      edged(context, () => context.stroke());
    }
  }
  if (layers.includes("truth") && data.truth) drawColumns(context, data.truth, at, colour("recognized"));
  if (layers.includes("counterparts") && data.counterparts) drawColumns(context, data.counterparts, at, colour("accent"));
  const [x, y] = at(row, column);
  context.strokeStyle = colour("text");
  context.lineWidth = devicePixelRatio;
  context.globalAlpha = 0.5;
  context.beginPath();
  context.moveTo(x, 0);
  context.lineTo(x, canvas.height);
  context.moveTo(0, y);
  context.lineTo(canvas.width, y);
  context.stroke();
  context.globalAlpha = 1;
  context.strokeRect(x - 5 * devicePixelRatio, y - 5 * devicePixelRatio, 10 * devicePixelRatio, 10 * devicePixelRatio);
}

/** Draw a line with an edge, by which it is seen on any shade. */
function edged(context, draw) {
  const { lineWidth, strokeStyle } = context;
  [context.lineWidth, context.strokeStyle] = [2 * lineWidth, colour("surface")];
  draw();
  [context.lineWidth, context.strokeStyle] = [lineWidth, strokeStyle];
  draw();
}

function drawColumns(context, columns, at, tint) {
  const few = columns.length <= 300;
  const half = (few ? 2.5 : 1) * devicePixelRatio;
  const squares = (size) => columns.forEach((column, row) => {
    if (column === null) return;
    const [x, y] = at(row, column);
    context.fillRect(x - size, y - size, 2 * size, 2 * size);
  });
  context.fillStyle = colour("surface");
  if (few) squares(half + devicePixelRatio);
  context.fillStyle = tint;
  squares(half);
}
