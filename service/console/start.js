import { html, render } from "./shared/view.js";
import { Frame } from "./frame.js";

const page = document.getElementById("console");
page.textContent = "";
render(html`<${Frame} />`, page);
