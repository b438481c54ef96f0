// Maps saved as files, one after the other.
import { download } from "./api.js";
import { complain, Dialog, Progress, say } from "./elements.js";
import { bytes, integer } from "./formats.js";
import { mapPath } from "./map_path.js";
import { html, useState } from "./view.js";

export function ExportMap({ map, close }) {
  return html`
    <${Export} maps=${[map]} title=${`Export ${map}`} button="Export" saved=${`${map}.tar was saved.`} close=${close}>
      <p>One file with the map's settings, places, descriptors, pictures and cameras, as they are now. It can be imported here or elsewhere.</p>
    <//>
  `;
}

/** Save every map; the browser may ask once whether the page may save several files. */
export function ExportAll({ maps, close }) {
  return html`
    <${Export} maps=${maps} title="Export all maps" button="Export all" saved=${`${integer(maps.length)} maps were given to the browser. If it asks, let it save several files.`} close=${close}
      about=${(number) => `${maps[number]}, ${integer(number + 1)} of ${integer(maps.length)}: `}>
      <p>One file each of ${integer(maps.length)} maps, one after the other. Keys, settings of the service and the audit trail are not in them.</p>
    <//>
  `;
}

/** The dialog that saves maps; about says which one is under way. */
function Export({ maps, title, button, saved, close, about = () => "", children }) {
  const [state, setState] = useState(null);
  const start = async () => {
    const controller = new AbortController();
    setState({ number: 0, done: 0, total: null, controller });
    try {
      for (const [number, map] of maps.entries()) {
        const progress = (done, total) => setState((old) => ({ ...old, number, done, total }));
        await download(mapPath(map, "export"), `${map}.tar`, { progress, signal: controller.signal });
      }
      say(saved);
      close();
    } catch (error) {
      setState(null);
      complain(error);
    }
  };
  const stop = () => {
    state?.controller.abort();
    close();
  };
  return html`
    <${Dialog} title=${title} close=${stop}>
      ${children}
      ${state && html`
        <${Progress} done=${state.done} total=${state.total} label="Export" />
        <p class="faint small">${about(state.number)}${bytes(state.done)} of ${bytes(state.total)}</p>
      `}
      <footer class="row">
        <button type="button" class="primary" disabled=${state !== null} onClick=${start}>${button}</button>
        <button type="button" onClick=${stop}>${state ? "Stop" : "Cancel"}</button>
      </footer>
    <//>
  `;
}
