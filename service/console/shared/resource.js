// What a view reads: the data, or why there is none; read again when the key changes or the connection comes back.
import { epoch } from "./api.js";
import { html, useCallback, useEffect, useRef, useState } from "./view.js";
import { Loading, Trouble } from "./elements.js";

/** State that belongs to something, such as inputs: as soon as `of` is another, it is `first` again.
 *
 * That holds for the drawing in which `of` changes, and not only from an effect after it, so that nothing that is pressed
 * meanwhile uses what was of other inputs.  What is set for an `of` that has gone is dropped.
 */
export function useStateOf(of, first) {
  const [state, setState] = useState({ of, value: first });
  const present = useRef(of);
  present.current = of;
  const valueIn = (kept) => (kept.of === of ? kept.value : first);
  const set = (next) => {
    if (present.current !== of) return;
    setState((old) => ({ of, value: typeof next === "function" ? next(valueIn(old)) : next }));
  };
  return [valueIn(state), set];
}

const UNREAD = { data: undefined, error: null, loading: true };

/** Read something whenever `inputs` change.
 *
 * load gets an AbortSignal.  Returns {data, error, loading, reload, set}; while the same is read again, the old data stays.
 * every: milliseconds after which it is read again, as long as the page is seen.
 */
export function useResource(load, inputs, { every } = {}) {
  const present = JSON.stringify(inputs);
  const [state, setState] = useStateOf(present, UNREAD);
  const [count, setCount] = useState(0);
  useEffect(() => {
    const controller = new AbortController();
    setState((old) => ({ ...old, error: null, loading: true }));
    load(controller.signal).then(
      (data) => controller.signal.aborted || setState({ data, error: null, loading: false }),
      (error) => controller.signal.aborted || setState((old) => ({ ...old, error, loading: false })),
    );
    return () => controller.abort();
  }, [present, count, epoch.value]);
  const reload = useCallback(() => setCount((one) => one + 1), []);
  useEffect(() => {
    if (!every) return undefined;
    const timer = setInterval(() => document.hidden || reload(), every);
    return () => clearInterval(timer);
  }, [every]);
  const set = (data) => setState({ data, error: null, loading: false });
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
