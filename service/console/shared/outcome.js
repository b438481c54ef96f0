// What became of a calibration that a map has measured by itself, after a run or an alignment.
import { decimal, integer } from "./formats.js";
import { href } from "./router.js";
import { html } from "./view.js";

const OUTCOMES = {
  stored: "stored",
  proposed: "proposed",
  holds: "the one in force is no worse",
  "too few": "too few frames",
  impossible: "not possible",
};

/** The outcome, and the calibration error before and after. */
export function CalibrationOutcome({ map, told }) {
  const { outcome, error, frames, detail } = told;
  const text = OUTCOMES[outcome] || outcome;
  const measured = outcome === "stored" || outcome === "proposed";
  const before = error?.[0] === null ? "" : `${decimal(error?.[0])} → `;
  return html`
    ${measured ? html`<a href=${href("maps", map, "calibration")}>${text}</a>` : html`<span title=${detail}>${text}</span>`}
    ${error ? html`<span class="faint"> error ${before}${decimal(error[1])}</span>` : frames !== undefined && html`<span class="faint"> (${integer(frames)})</span>`}
  `;
}
