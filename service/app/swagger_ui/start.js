"use strict";
const dark = matchMedia("(prefers-color-scheme: dark)");
const follow = () => document.documentElement.classList.toggle("dark-mode", dark.matches);
dark.addEventListener("change", follow);
follow();

fetch("openapi.json").then((answer) => {
  if (!answer.ok) throw new Error(`status ${answer.status}`);
  return answer.json();
}).then((spec) => {
  // Requests go below the path under which this page was found.
  spec.servers = [{ url: new URL(".", location).href.replace(/\/$/, "") }];
  SwaggerUIBundle({ spec, dom_id: "#page", deepLinking: true, defaultModelsExpandDepth: 0, validatorUrl: null });
}).catch((error) => {
  document.getElementById("page").textContent = `openapi.json cannot be read: ${error.message}`;
});
