import { Head } from "../shared/elements.js";
import { html } from "../shared/view.js";

export default function Review() {
  return html`<${Head} title="Review" />`;
}
