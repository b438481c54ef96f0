// Colours of traverses on plans and charts, and the colours of the style sheet for canvases.

const LIGHT = ["#1a5fbf", "#c2410c", "#147243", "#8b2fd6", "#8f5a00", "#0e7490", "#be185d", "#4d6b0f"];
const DARK = ["#74aefc", "#fb923c", "#4fc48c", "#c79bff", "#e8c04a", "#3ccfe0", "#f685bb", "#a9d94a"];

export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

/** The colour of traverse `number`; -1 for places of none. */
export function traverseColour(number) {
  if (number < 0) return isDark() ? "#8b949e" : "#6b7480";
  const palette = isDark() ? DARK : LIGHT;
  if (number < palette.length) return palette[number];
  return `hsl(${Math.round(number * 137.5) % 360} 60% ${isDark() ? 65 : 38}%)`;
}

/** The value of a colour of the style sheet now. */
export function colour(name) {
  const probe = document.createElement("span");
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const value = getComputedStyle(probe).color;
  probe.remove();
  return value;
}

/** Call a function whenever light turns to dark or back; returns a function that ends this. */
export function onTheme(call) {
  const media = matchMedia("(prefers-color-scheme: dark)");
  media.addEventListener("change", call);
  addEventListener("themechange", call);
  return () => {
    media.removeEventListener("change", call);
    removeEventListener("themechange", call);
  };
}
