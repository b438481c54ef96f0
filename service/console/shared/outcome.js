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
  const { outcome, error, recall, frames, detail } = told;
  const text = OUTCOMES[outcome] || outcome;
  const measured = outcome === "stored" || outcome === "proposed";
  const change = ([before, after]) => `${before === null ? "" : `${decimal(before)} → `}${decimal(after)}`;
  return html`
    ${measured ? html`<a href=${href("maps", map, "calibration")}>${text}</a>` : html`<span title=${detail}>${text}</span>`}
    ${error ? html`<span class="faint"> error ${change(error)}${recall ? `, recall ${change(recall)}` : ""}</span>` : frames !== undefined && html`<span class="faint"> (${integer(frames)})</span>`}
  `;
}
