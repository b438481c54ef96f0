// The map that was looked at last, and the names of all maps, by which one that is gone is no longer chosen.
import { signal } from "./view.js";

const LAST = "placerec.map";
const MOST = 1000;

/** All maps by name, or null while that is not known; it grows with the list, and shrinks when a map is gone. */
export const mapNames = signal(null);

/** Whether a map may be there: a list of a thousand names may be cut off. */
export function mayBeThere(map) {
  return mapNames.value === null || mapNames.value.length >= MOST || mapNames.value.includes(map);
}

export function remember(map) {
  try {
    sessionStorage.setItem(LAST, map);
  } catch {
    // Then it is not remembered.
  }
}

/** The map that was looked at last, if it is still there. */
export function remembered() {
  try {
    const last = sessionStorage.getItem(LAST);
    return last !== null && mayBeThere(last) ? last : null;
  } catch {
    return null;
  }
}
