// The key in the tabs of this browser: a new tab gets it from one that has it, and a forgotten one is forgotten in all.
// It goes from tab to tab and is written nowhere; what is stored is only that there may be a tab to ask.

const HINT = "placerec.tabs";
const PATIENCE = 1000;

export class Tabs {
  /** name: of the service; present: a function that gives this tab's key; forget: called when another tab forgets it. */
  constructor(name, { present, forget }) {
    this.channel = new BroadcastChannel(`placerec ${name}`);
    this.waiting = null;
    this.channel.onmessage = ({ data }) => {
      if (data.kind === "ask" && present()) this.channel.postMessage({ kind: "key", key: present() });
      else if (data.kind === "key") this.waiting?.(data.key);
      else if (data.kind === "forget") forget();
    };
  }

  /** The key of another tab; empty if none answers. */
  async ask() {
    if (!hinted()) return "";
    const answer = new Promise((resolve) => {
      this.waiting = resolve;
      setTimeout(() => resolve(""), PATIENCE);
    });
    this.channel.postMessage({ kind: "ask" });
    const key = await answer;
    this.waiting = null;
    if (!key) hint(false);
    return key;
  }

  /** Say that this tab has a key, or that it was forgotten. */
  told(key) {
    hint(key !== "");
    if (!key) this.channel.postMessage({ kind: "forget" });
  }
}

function hinted() {
  try {
    return localStorage.getItem(HINT) !== null;
  } catch {
    return false;
  }
}

function hint(there) {
  try {
    if (there) localStorage.setItem(HINT, "");
    else localStorage.removeItem(HINT);
  } catch {
    // Then every tab asks for the key.
  }
}
