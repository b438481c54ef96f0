// Pictures of places: fetched with the key when they come into sight, and kept as blobs for a while.
import { key, send } from "./api.js";
import { mapPath } from "./map_path.js";
import { effect, html, useEffect, useRef, useState } from "./view.js";

const MOST = 400;
const kept = new Map();

effect(() => {
  key.value; // Another key may not see the same pictures.
  for (const one of kept.values()) one.then((url) => url && URL.revokeObjectURL(url));
  kept.clear();
});

/** The address of a picture in memory; null if there is none. */
function picture(path, version) {
  const name = `${path} ${version}`;
  const found = kept.get(name);
  if (found) {
    kept.delete(name);
    kept.set(name, found);
    return found;
  }
  const asked = send("GET", path)
    .then((answer) => answer.blob())
    .then((blob) => URL.createObjectURL(blob))
    .catch((error) => {
      kept.delete(name);
      if (error.status === 404) return null;
      throw error;
    });
  kept.set(name, asked);
  if (kept.size > MOST) {
    const [oldest, value] = kept.entries().next().value;
    kept.delete(oldest);
    value.then((url) => url && URL.revokeObjectURL(url)).catch(() => {});
  }
  return asked;
}

/** A picture below the API; version changes when it does. */
export function Picture({ path, version = "", alt, children }) {
  const element = useRef(null);
  const [url, setUrl] = useState(undefined);
  useEffect(() => {
    let gone = false;
    setUrl(undefined);
    const watcher = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      watcher.disconnect();
      picture(path, version).then(
        (found) => gone || setUrl(found),
        () => gone || setUrl(null),
      );
    });
    watcher.observe(element.current);
    return () => {
      gone = true;
      watcher.disconnect();
    };
  }, [path, version]);
  const state = url === undefined ? "waiting" : url === null ? "none" : "";
  return html`
    <span ref=${element} class=${`picture ${state}`}>
      ${url ? html`<img src=${url} alt=${alt} draggable=${false} />` : url === null && html`<span class="faint small">no picture</span>`}
      ${children}
    </span>
  `;
}

export function thumbnailPath(map, place) {
  return mapPath(map, "places", place, "thumbnail");
}

export function Thumbnail({ map, place, version, children }) {
  return html`<${Picture} path=${thumbnailPath(map, place)} version=${version} alt=${`Place ${place}`}>${children}<//>`;
}
