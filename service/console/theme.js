// The colours are chosen before the first paint: light or dark as the user said, or else as the system says.
"use strict";
try {
  const chosen = localStorage.getItem("placerec.theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
} catch {
  // Storage may be forbidden; then the system decides.
}
