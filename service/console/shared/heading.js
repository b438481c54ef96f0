// How a heading is counted, where one is entered.
import { html } from "./view.js";

export const HEADING = "A heading is in degrees: beside x and y counter-clockwise from +x, so that 90 is along +y; beside a latitude clockwise from north, so that 90 is east.";

/** Where a heading points, as an arrow, while it is entered beside x and y or beside a latitude. */
export function HeadingArrow({ heading, geographic }) {
  const degrees = Number(heading);
  const given = heading !== "" && Number.isFinite(degrees);
  const turn = geographic ? degrees : 90 - degrees; // clockwise from up
  return html`
    <p class="hint row">
      ${given && html`<span class="heading" role="img" aria-label=${`Points ${Math.round(((turn % 360) + 360) % 360)} degrees clockwise from ${geographic ? "north" : "+y"}`} style=${{ rotate: `${turn}deg` }}>↑</span>`}
      <span>Heading in degrees: ${geographic ? "clockwise from north; 90 is east." : "counter-clockwise from +x; 90 is along +y."}</span>
    </p>
  `;
}
