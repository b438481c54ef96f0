// Curves by uPlot, in the colours of the page.
import uPlot from "../vendor/uplot.js";
import { colour, isDark, onTheme } from "./colours.js";
import { html, useEffect, useRef, useState } from "./view.js";

/** data: [xs, ys, …]; series: [{label, colour (name), ...uPlot's}]; scales: {x, y} as [least, most] or null for auto.
 *
 * marks: [{x, colour, label}], upright lines.  label says for everybody what the chart shows.
 */
export function Chart({ data, series, axes, scales = {}, marks = [], height = 260, label, legend = true }) {
  const place = useRef(null);
  const [theme, setTheme] = useState(isDark());
  const latest = useRef(marks);
  const chart = useRef(null);
  latest.current = marks;
  useEffect(() => onTheme(() => setTheme(isDark())), []);
  useEffect(() => {
    const options = {
      width: Math.max(200, place.current.clientWidth),
      height,
      legend: { show: legend },
      cursor: { drag: { x: false, y: false } },
      scales: { x: scaleOf(scales.x, axes[0].time), y: scaleOf(scales.y) },
      axes: axes.map(axisOf),
      series: [{ label: axes[0].label }, ...series.map(lineOf)],
      hooks: { draw: [(one) => drawMarks(one, latest.current)] },
    };
    chart.current = new uPlot(options, data, place.current);
    const observer = new ResizeObserver(() => {
      const width = place.current?.clientWidth;
      if (width > 0 && width !== chart.current?.width) chart.current?.setSize({ width, height });
    });
    observer.observe(place.current);
    return () => {
      observer.disconnect();
      chart.current.destroy();
      chart.current = null;
    };
  }, [theme, JSON.stringify(axes), JSON.stringify(scales), series.length, height]);
  useEffect(() => chart.current?.setData(data), [data]);
  useEffect(() => chart.current?.redraw(false), [JSON.stringify(marks)]);
  return html`<div class="chart" ref=${place} role="img" aria-label=${label}></div>`;
}

function scaleOf(range, time = false) {
  return range ? { time, range: () => range } : { time };
}

function axisOf({ label, values }) {
  const grid = { stroke: colour("line"), width: 1 };
  return { label, labelSize: 22, stroke: colour("faint"), grid, ticks: grid, values, font: "12px system-ui", labelFont: "12px system-ui", size: 46 };
}

function lineOf({ label, tint = "accent", ...others }) {
  return { label, stroke: colour(tint), width: 2, points: { show: false }, value: (_, value) => (value === null || value === undefined ? "–" : value.toFixed(3)), ...others };
}

function drawMarks(chart, marks) {
  const { ctx: context, bbox } = chart;
  context.save();
  context.font = `${12 * devicePixelRatio}px system-ui`;
  context.textAlign = "left";
  for (const { x, tint, label } of marks) {
    const at = Math.round(chart.valToPos(x, "x", true));
    if (at < bbox.left || at > bbox.left + bbox.width) continue;
    context.strokeStyle = context.fillStyle = colour(tint);
    context.lineWidth = 1.5 * devicePixelRatio;
    context.beginPath();
    context.moveTo(at, bbox.top);
    context.lineTo(at, bbox.top + bbox.height);
    context.stroke();
    context.fillText(label, at + 4, bbox.top + 14 * devicePixelRatio);
  }
  context.restore();
}
