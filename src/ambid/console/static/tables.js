// What a result says, as it declares itself: verdict, reasons, sections of tables and paragraphs; no figures.
import { el, WORDS } from "./core.js";

const textOf = (cell) => typeof cell === "string" ? cell : cell[0], styleOf = (cell) => typeof cell === "string" ? "" : cell[1];
// A table; what its rows mean (the column `about`) is said where the pointer rests, or below their names where there is none.
function table({ content: [labels, ...rows], right = [], about = null }) {
  const columns = labels.map((_, k) => k).filter((k) => k !== about), side = (k) => right.includes(k) ? "num" : "";
  const name = (row) => {
    const means = about === null ? "" : textOf(row[about]);
    return el("th", { scope: "row", title: means, className: means && "meant" }, textOf(row[0]),
      means ? el("span", { className: "means hint" }, means) : null);
  };
  const look = (cell, k) => `${side(k)} ${styleOf(cell)} ${textOf(cell).length < 30 ? "short" : ""}`;
  const value = (cell, k) => el("td", { className: look(cell, k) }, textOf(cell));
  const head = el("thead", {}, el("tr", {}, ...columns.map((k) => el("th", { scope: "col", className: side(k) }, textOf(labels[k])))));
  const body = el("tbody", {}, ...rows.map((row) => el("tr", {}, ...columns.map((k) => k ? value(row[k], k) : name(row)))));
  return el("div", { className: "table", tabIndex: 0 }, el("table", {}, labels.some(textOf) ? head : null, body));
}
export const parts = (list) => list.map((p) => p.kind === "table" ? table(p) : el("p", {}, p.content));
export const sections = (content) => content.sections.map((s) => {
  const inside = [...parts(s.parts), s.note ? el("p", { className: "hint" }, s.note) : null];
  if (s.folded) return el("details", {}, el("summary", {}, s.title), ...inside);
  return el("section", {}, s.title !== "Result" ? el("h3", {}, s.title) : null, ...inside);
});
// The verdict, what stands against it, and what ± is.
export function verdict(content, { head = WORDS[content.verdict] ?? content.verdict } = {}) {
  const spread = JSON.stringify(content.sections).includes("±") ? el("p", { className: "hint" }, `${content.spread}.`) : null;
  return [el("h2", { className: `${content.verdict} result` }, head),
    el("p", { className: "hint" }, [content.title, content.subtitle].filter(Boolean).join(". ")),
    ...content.reasons.map((r) => el("p", {}, r)), ...content.warnings.map((w) => el("p", { className: "caution" }, w)),
    ...(spread ? [spread] : [])];
}
