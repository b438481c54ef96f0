// What every view is made of: Preact, its hooks, signals, and markup by htm.
import { createElement, Fragment, render } from "../vendor/preact.js";
import htm from "../vendor/htm.js";

export { render, Fragment };
export { useCallback, useEffect, useId, useLayoutEffect, useMemo, useRef, useState } from "../vendor/preact-hooks.js";
export { batch, computed, effect, signal, useSignal, useComputed } from "../vendor/signals.js";

export const html = htm.bind(createElement);
