// Paths of the API below one map.
import { pathOf } from "./api.js";

export function mapPath(map, ...parts) {
  return pathOf("maps", map, ...parts);
}
