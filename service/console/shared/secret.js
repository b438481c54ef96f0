// A key that was just made, which is shown once.
import { Copy, Dialog } from "./elements.js";
import { html, signal } from "./view.js";

/** The first key, until it was copied, or null: from then on everybody needs one, so the view that made it may be gone. */
export const firstKey = signal(null);

export function Secret({ made, close }) {
  return html`
    <${Dialog} title=${`The key ${made.name}`} close=${close}>
      <p><strong>Copy it now.</strong> It is shown this once; the service keeps only its hash.</p>
      <pre tabindex="0" class="secret" aria-label="The key">${made.key}</pre>
      <footer class="row"><${Copy} text=${made.key} label="Copy the key" /><button type="button" class="primary" onClick=${close}>Done</button></footer>
    <//>
  `;
}
