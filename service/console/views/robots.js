// Robots of all maps: which there are, where they are, and for how long they have been lost.
import { Field, Head, Nothing } from "../shared/elements.js";
import { RobotTable, useFleet } from "../shared/fleet.js";
import { counted } from "../shared/formats.js";
import { Shown } from "../shared/resource.js";
import { restate } from "../shared/router.js";
import { html } from "../shared/view.js";

const STATES = {
  heard: ["heard now", (one) => !one.silent],
  lost: ["lost", (one) => one.lost !== null],
  silent: ["silent", (one) => one.silent],
};

export default function Robots({ query }) {
  const fleet = useFleet();
  const { name = "", state = "" } = query;
  const wanted = (one) => {
    const text = name.trim().toLowerCase();
    const found = !text || [one.label, one.camera, one.map, one.place, one.session].some((part) => part?.toLowerCase().includes(text));
    return found && (!STATES[state] || STATES[state][1](one));
  };
  return html`
    <${Head} title="Robots" note=${fleet.data && summary(fleet.data.robots)} />
    <div class="filters" role="search" aria-label="Filters">
      <${Field} label="Name, camera, map, place"><input value=${name} onInput=${(event) => restate({ name: event.target.value })} spellcheck=${false} /><//>
      <${Field} label="State">
        <select value=${state} onChange=${(event) => restate({ state: event.target.value })}>
          <option value="">all</option>${Object.entries(STATES).map(([id, [text]]) => html`<option value=${id}>${text}</option>`)}
        </select>
      <//>
    </div>
    <${Shown} resource=${fleet}>
      ${({ robots }) => {
        const shown = robots.filter(wanted);
        return shown.length === 0
          ? html`<${Nothing} title=${robots.length === 0 ? "No robot has asked" : "No robot fits the filters"}>${robots.length === 0 && "A robot is an open session, or a key that has sent a query since the service was started."}<//>`
          : html`<${RobotTable} robots=${shown} />`;
      }}
    <//>
  `;
}

function summary(robots) {
  const lost = robots.filter((one) => one.lost !== null && !one.silent).length;
  const heard = robots.filter((one) => !one.silent).length;
  return `${counted(robots.length, "robot")}, ${heard} heard in the last ten seconds${lost ? `, ${lost} lost` : ""}`;
}
