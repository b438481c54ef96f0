// Places deleted together, after they were counted.
import { post } from "./api.js";
import { ByName, complain, Pill } from "./elements.js";
import { integer } from "./formats.js";
import { mapPath } from "./map_path.js";
import { Shown, useResource } from "./resource.js";
import { html } from "./view.js";

/** Delete places: what would go is counted first, and what was counted is what goes. */
export function DeletePlaces({ map, order, close, done }) {
  const report = useResource((signal) => post(`${mapPath(map, "places")}:delete`, { ...order, dry_run: true }, { signal }), [order]);
  const send = async () => {
    await post(`${mapPath(map, "places")}:delete`, { ids: report.data.ids, dry_run: false }).catch((error) => {
      if (error.status === 404) complain(error);
      throw error;
    });
    done();
  };
  if (report.data === undefined) return html`<${Shown} resource=${report} />`;
  const { places, ids } = report.data;
  return html`
    <${ByName} title=${places === 1 ? "Delete a place" : `Delete ${integer(places)} places`} name=${map} action="Delete" close=${close} send=${send}>
      <p>No later query finds ${places === 1 ? "it" : "them"}. This cannot be undone.</p>
      <p class="row">${ids.slice(0, 12).map((id) => html`<${Pill}>${id}<//>`)}${ids.length > 12 && html`<span class="faint">and ${integer(ids.length - 12)} more</span>`}</p>
    <//>
  `;
}
