// What a plan's canvas is given: positions, the colours of traverses and of marks, and which traverses are seen.
import { colour, traverseColour } from "./colours.js";
import { stripsOf } from "./plan_data.js";

const TINTS = ["text", "surface", "accent", "danger", "ambiguous", "recognized", "unknown", "faint", "line"];

/** The colours of what is drawn above the places, as the page has them now. */
export function presentTints() {
  return Object.fromEntries(TINTS.map((name) => [name, colour(name)]));
}

/** What the canvas draws: positions, colours by traverse, and which traverses are seen. */
export function contentOf(plan, { strips = false, off = new Set(), showGaps = true } = {}) {
  const { x, y } = strips ? stripsOf(plan) : { x: plan.px, y: plan.py };
  const last = plan.sequences.length;
  const group = Int32Array.from(plan.sequence, (one) => (one < 0 ? last : one));
  const names = [...plan.sequences, null];
  const colours = names.map((_, one) => traverseColour(one < last ? one : -1));
  const lines = names.map((name) => (name === null ? [] : plan.traverses.find((one) => one.name === name)?.places || []));
  const gaps = showGaps && !strips ? plan.gaps : [];
  const visible = names.map((name) => !off.has(name));
  return { x, y, group, colours, numbers: colours.map(pixelOf), visible, lines, gaps, angle: strips ? null : plan.angle };
}

/** A colour as a pixel of a little-endian Uint32Array. */
function pixelOf(text) {
  const context = new OffscreenCanvas(1, 1).getContext("2d");
  context.fillStyle = text;
  context.fillRect(0, 0, 1, 1);
  return new Uint32Array(context.getImageData(0, 0, 1, 1).data.buffer)[0];
}
