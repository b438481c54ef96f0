// A picture of the floor under the plan, laid by two places whose spots in it are known.  It stays in this browser.
import { Dialog, Field, Trouble, Typed } from "./elements.js";
import { html, useEffect, useRef, useState } from "./view.js";

const STORE = "floors";

/** The browser's own store of pictures, by the address of the service and the map. */
function opened() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open("placerec", 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE);
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

async function stored(mode, work) {
  const database = await opened();
  try {
    return await new Promise((resolve, reject) => {
      const transaction = database.transaction(STORE, mode);
      const request = work(transaction.objectStore(STORE));
      transaction.oncomplete = () => resolve(request.result);
      transaction.onerror = () => reject(transaction.error);
      transaction.onabort = () => reject(transaction.error);
    });
  } finally {
    database.close();
  }
}

/** The floor plan of a map: {image, placed, blob, pairs, keep({blob, pairs}), forget()}.  pairs: [{place, u, v, x, y}] in pixels and metres. */
export function useFloor(map) {
  const name = `${location.pathname} ${map}`;
  const [state, setState] = useState({ image: null, placed: null, blob: null, pairs: [] });
  const take = async (kept) => setState({ ...kept, image: await createImageBitmap(kept.blob), placed: laid(kept.pairs) });
  useEffect(() => {
    let gone = false;
    stored("readonly", (floors) => floors.get(name)).then((kept) => kept && !gone && take(kept), () => {});
    return () => {
      gone = true;
    };
  }, [name]);
  const keep = async (kept) => {
    await take(kept);
    await stored("readwrite", (floors) => floors.put(kept, name)).catch(() => {}); // then it is shown for as long as the page is
  };
  const forget = async () => {
    setState({ image: null, placed: null, blob: null, pairs: [] });
    await stored("readwrite", (floors) => floors.delete(name)).catch(() => {});
  };
  return { ...state, keep, forget };
}

/** The similarity by which two spots of a picture come to lie at two points: see PlanCanvas.drawImage. */
export function laid([one, other]) {
  // With w = u - i v and z = x + i y, z = c w + d for complex c and d.
  const [wu, wv] = [other.u - one.u, -(other.v - one.v)];
  const [zx, zy] = [other.x - one.x, other.y - one.y];
  const length = wu * wu + wv * wv;
  const [a, b] = [(zx * wu + zy * wv) / length, (zy * wu - zx * wv) / length];
  // z = (a + i b)(u - i v) + d: x = a u + b v + dx, y = b u - a v + dy.
  return { a, b, x: one.x - a * one.u - b * one.v, y: one.y - b * one.u + a * one.v };
}

export function FloorPlan({ floor, plan, chosen }) {
  const [open, setOpen] = useState(false);
  return html`
    <div class="row">
      <button type="button" class="small" onClick=${() => setOpen(true)}>${floor.image ? "Lay the floor plan again …" : "Lay a floor plan …"}</button>
      ${floor.image && html`<button type="button" class="small" onClick=${floor.forget}>Remove it</button>`}
    </div>
    ${open && html`<${Lay} floor=${floor} plan=${plan} chosen=${chosen} close=${() => setOpen(false)} />`}
  `;
}

/** Choose a picture, and for two places their spots in it, by click or as shares of its width and height. */
function Lay({ floor, plan, chosen, close }) {
  const posed = plan.ids.filter((_, one) => !Number.isNaN(plan.px[one]));
  const [blob, setBlob] = useState(floor.blob);
  const [url, setUrl] = useState(null);
  const [size, setSize] = useState(null);
  const [pairs, setPairs] = useState(floor.pairs.length ? floor.pairs : [{ place: chosen !== null ? plan.ids[chosen] : posed[0] }, { place: posed.at(-1) }]);
  const [next, setNext] = useState(0);
  const [error, setError] = useState(null);
  const picture = useRef(null);
  useEffect(() => {
    if (!blob) return undefined;
    const made = URL.createObjectURL(blob);
    setUrl(made);
    return () => URL.revokeObjectURL(made);
  }, [blob]);
  const change = (number, changes) => setPairs((old) => old.map((one, at) => (at === number ? { ...one, ...changes } : one)));
  const click = (event) => {
    const { width, height } = picture.current.getBoundingClientRect();
    change(next, { u: (event.offsetX / width) * size[0], v: (event.offsetY / height) * size[1] });
    setNext(1 - next);
  };
  const whole = pairs.map((one) => {
    const number = plan.index.get(one.place);
    return number === undefined || Number.isNaN(plan.px[number]) ? one : { ...one, x: plan.px[number], y: plan.py[number] };
  });
  const ready = size && whole.every((one) => [one.u, one.v, one.x, one.y].every(Number.isFinite)) && Math.hypot(whole[0].u - whole[1].u, whole[0].v - whole[1].v) > 1 && Math.hypot(whole[0].x - whole[1].x, whole[0].y - whole[1].y) > 1e-6;
  const lay = async (event) => {
    event.preventDefault();
    try {
      await floor.keep({ blob, pairs: whole });
      close();
    } catch {
      setError(Object.assign(new Error("The browser cannot read this picture."), { title: "Not a picture" }));
    }
  };
  const share = (value, of) => (Number.isFinite(value) && size ? Math.round((1000 * value) / of) / 10 : "");
  return html`
    <${Dialog} title="Lay a floor plan" wide close=${close}>
      <form onSubmit=${lay}>
        <p class="faint">The picture stays in this browser. Click where each of two places lies in it; the farther apart they are, the better it fits.</p>
        <${Field} label="Picture"><input type="file" accept="image/*" onChange=${(event) => { setSize(null); setBlob(event.target.files[0] || null); }} /><//>
        ${url && html`
          <div class="floor">
            <img ref=${picture} src=${url} alt="The floor plan" onLoad=${(event) => setSize([event.target.naturalWidth, event.target.naturalHeight])} onError=${() => setError(Object.assign(new Error("The browser cannot read this picture."), { title: "Not a picture" }))} onClick=${click} />
            ${size && pairs.map((one, number) => Number.isFinite(one.u) && html`<span class="spot" style=${{ left: `${(100 * one.u) / size[0]}%`, top: `${(100 * one.v) / size[1]}%` }}>${number + 1}</span>`)}
          </div>
        `}
        ${size && pairs.map((one, number) => html`
          <fieldset class="fields narrow">
            <legend class="label">${number === next ? "The next click is for place" : "Place"} ${number + 1}</legend>
            <${Field} label=${`Place ${number + 1}`}><${Typed} list="floor-places" value=${one.place} onFocus=${() => setNext(number)} change=${({ value }) => change(number, { place: value.trim() })} /><//>
            <${Field} label=${`Place ${number + 1}, % from the left`}><${Typed} type="number" min="0" max="100" step="any" value=${share(one.u, size[0])} change=${({ valueAsNumber }) => change(number, { u: (valueAsNumber * size[0]) / 100 })} /><//>
            <${Field} label=${`Place ${number + 1}, % from the top`}><${Typed} type="number" min="0" max="100" step="any" value=${share(one.v, size[1])} change=${({ valueAsNumber }) => change(number, { v: (valueAsNumber * size[1]) / 100 })} /><//>
          </fieldset>
        `)}
        <datalist id="floor-places">${posed.slice(0, 500).map((id) => html`<option value=${id}></option>`)}</datalist>
        ${error && html`<${Trouble} error=${error} />`}
        <footer><button type="button" onClick=${close}>Cancel</button><button type="submit" class="primary" disabled=${!ready}>Lay it</button></footer>
      </form>
    <//>
  `;
}
