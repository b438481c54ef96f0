// What every view is made of: Preact, its hooks, signals, and markup by htm.
import { createElement, Fragment, render } from "../vendor/preact.js";
import htm from "../vendor/htm.js";

export { render, Fragment };
export { useCallback, useEffect, useId, useLayoutEffect, useMemo, useRef, useState } from "../vendor/preact-hooks.js";
export { batch, computed, effect, signal, useSignal, useComputed } from "../vendor/signals.js";

const TURNING = /[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/g;
const SHOWN = ["title", "alt", "aria-label", "label", "placeholder"];

/** A text in which the characters that turn the direction of writing are shown as escapes.
 *
 * By them a name could be made to look like another one: what follows U+202E is read from right to left.
 */
export function plain(text) {
  return text.replace(TURNING, (one) => `\\u${one.charCodeAt(0).toString(16).padStart(4, "0")}`);
}

function shown(child) {
  if (typeof child === "string") return plain(child);
  return Array.isArray(child) ? child.map(shown) : child;
}

/** An element whose texts turn nothing around; what is written into a field stays as it is. */
function element(type, props, ...children) {
  if (typeof type !== "string") return createElement(type, props, ...children);
  for (const name of SHOWN) if (typeof props?.[name] === "string") props[name] = plain(props[name]);
  return createElement(type, props, ...children.map(shown));
}

export const html = htm.bind(element);
