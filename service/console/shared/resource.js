// What a view reads: the data, or why there is none; read again when the key changes or the connection comes back.
import { epoch } from "./api.js";
import { html, useCallback, useEffect, useRef, useState } from "./view.js";
import { Loading, Trouble } from "./elements.js";

/** Read something whenever `inputs` change.
 *
 * load gets an AbortSignal.  Returns {data, error, loading, reload, set}; while it is read again, the old data stays.
 * every: milliseconds after which it is read again, as long as the page is seen.
 */
export function useResource(load, inputs, { every } = {}) {
  const [state, setState] = useState({ data: undefined, error: null, loading: true });
  const [count, setCount] = useState(0);
  const shown = useRef(null);
  const present = JSON.stringify(inputs);
  useEffect(() => {
    const controller = new AbortController();
    const kept = shown.current === present;
    setState((old) => ({ data: kept ? old.data : undefined, error: null, loading: true }));
    load(controller.signal).then(
      (data) => {
        if (controller.signal.aborted) return;
        shown.current = present;
        setState({ data, error: null, loading: false });
      },
      (error) => {
        if (!controller.signal.aborted) setState((old) => ({ data: old.data, error, loading: false }));
      },
    );
    return () => controller.abort();
  }, [present, count, epoch.value]);
  const reload = useCallback(() => setCount((one) => one + 1), []);
  useEffect(() => {
    if (!every) return undefined;
    const timer = setInterval(() => document.hidden || reload(), every);
    return () => clearInterval(timer);
  }, [every]);
  const set = useCallback((data) => setState({ data, error: null, loading: false }), []);
  return { ...state, reload, set };
}

/** Show a resource: its data by the function `children`, or that it is being read, or what went wrong. */
export function Shown({ resource, children }) {
  const { data, error, reload } = resource;
  if (data === undefined && error === null) return html`<${Loading} />`;
  return html`
    ${error !== null && html`<${Trouble} error=${error} again=${reload} />`}
    ${data !== undefined && children(data)}
  `;
}
