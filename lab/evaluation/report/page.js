"use strict";
document.documentElement.classList.add("scripted");

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  const value = (row, column) => row.cells[column].dataset.value;
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const before = head.getAttribute("aria-sort");
    const first = column === 0 || head.dataset.first === "ascending" ? "ascending" : "descending";
    const order = before === null ? first : before === "ascending" ? "descending" : "ascending";
    const sign = order === "ascending" ? 1 : -1;
    const rows = [...table.tBodies[0].rows].sort((a, b) => {
      const [x, y] = [value(a, column), value(b, column)];
      if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
      return sign * (column === 0 ? x.localeCompare(y) : Number(x) - Number(y));
    });
    table.tBodies[0].append(...rows);
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", order);
  }));
}

const runs = [...document.querySelectorAll(".run")];
function choose() {
  const chosen = runs.find((run) => "#" + run.id === location.hash) || document.querySelector(".run.chosen") || runs[0];
  for (const run of runs) run.classList.toggle("chosen", run === chosen);
  for (const chip of document.querySelectorAll(".chips a")) {
    if (chip.hash === "#" + chosen.id) chip.setAttribute("aria-current", "true");
    else chip.removeAttribute("aria-current");
  }
  return chosen;
}
if (runs.length) {
  choose();
  addEventListener("hashchange", () => choose().scrollIntoView());
  for (const chip of document.querySelectorAll(".chips a")) {
    chip.addEventListener("click", (event) => {
      event.preventDefault();
      history.replaceState(null, "", chip.hash);
      choose();
    });
  }
}
