// A key that was just made, which is shown once.
import { Copy, Dialog } from "./elements.js";
import { html, signal } from "./view.js";

/** The key, until somebody says that they have it; else null.  The view that made it may be gone: the first key ends it. */
export const newKey = signal(null);

export function Secret() {
  if (newKey.value === null) return null;
  const { name, key } = newKey.value;
  const close = () => {
    newKey.value = null;
  };
  return html`
    <${Dialog} title=${`The key ${name}`} close=${close} stays>
      <p><strong>Copy it now.</strong> It is shown this once; the service keeps only its hash.</p>
      <pre tabindex="0" class="secret" aria-label="The key">${key}</pre>
      <footer class="row"><${Copy} text=${key} label="Copy the key" /><button type="button" class="primary" onClick=${close}>Done</button></footer>
    <//>
  `;
}
