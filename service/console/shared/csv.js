// Tables as CSV files: what a spreadsheet would take for a formula stays text.
import { save } from "./api.js";

const FORMULA = /^[\s]*[=+\-@\t\r|%]/;

/** A value as a cell (RFC 4180).  A text that a spreadsheet would compute gets an apostrophe before it. */
export function cell(value) {
  if (value === null || value === undefined) return "";
  if (typeof value === "number" || typeof value === "boolean") return String(value);
  const text = typeof value === "string" ? value : JSON.stringify(value);
  const safe = FORMULA.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

/** Let the browser save rows as a CSV file; columns are [name, function of a row]. */
export function saveCsv(name, columns, rows) {
  const lines = [columns.map(([title]) => cell(title)), ...rows.map((row) => columns.map(([, of]) => cell(of(row))))];
  save(new Blob([lines.map((line) => `${line.join(",")}\r\n`).join("")], { type: "text/csv;charset=utf-8" }), name);
}

/** The rows of a CSV text as lists of cells. */
export function cellsOf(text) {
  const rows = [[]];
  let [value, quoted] = ["", false];
  const end = () => {
    rows.at(-1).push(value.trim());
    value = "";
  };
  for (let at = text.charCodeAt(0) === 0xfeff ? 1 : 0; at < text.length; at += 1) {
    const one = text[at];
    if (quoted && one === '"' && text[at + 1] === '"') {
      value += one;
      at += 1;
    } else if (one === '"' && (quoted || value.trim() === "")) {
      quoted = !quoted;
    } else if (!quoted && one === ",") {
      end();
    } else if (!quoted && one === "\n") {
      end();
      rows.push([]);
    } else if (quoted || one !== "\r") {
      value += one;
    }
  }
  end();
  return rows.filter((row) => row.some(Boolean));
}
