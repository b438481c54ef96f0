// Paths of the API below one map.
export function mapPath(map, ...parts) {
  return ["/maps", map, ...parts].map((part, index) => (index === 0 ? part : encodeURIComponent(part))).join("/");
}
