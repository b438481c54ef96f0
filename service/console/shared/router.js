// The address: everything after # is the view and what it shows, so that a view can be linked to and gone back to.
import { signal } from "./view.js";

function read() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  const parts = path.split("/").filter(Boolean).map(decoded);
  return { parts, query: Object.fromEntries(new URLSearchParams(query)) };
}

function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** The present route: its parts, and its query by name. */
export const route = signal(read());

addEventListener("hashchange", () => {
  route.value = read();
});

/** The address of a view: href("maps", "lab", "places"), with a query as the last argument if that is an object. */
export function href(...parts) {
  const query = typeof parts.at(-1) === "object" ? parts.pop() : {};
  const given = Object.entries(query).filter(([, value]) => value !== "" && value !== null && value !== undefined);
  const text = new URLSearchParams(given).toString();
  return `#/${parts.map(encodeURIComponent).join("/")}${text ? `?${text}` : ""}`;
}

/** Go to a view. */
export function go(...parts) {
  location.hash = href(...parts);
}

/** Change the query of the present address, without a new entry in the history. */
export function restate(changes) {
  const { parts, query } = route.value;
  history.replaceState(null, "", href(...parts, { ...query, ...changes }));
  route.value = read();
}
