// What a result says, as it declares itself: verdict, reasons, sections of tables and paragraphs; no figures.
import { el, WORDS } from "./core.js";

const textOf = (cell) => typeof cell === "string" ? cell : cell[0], styleOf = (cell) => typeof cell === "string" ? "" : cell[1];
function table({ content: [labels, ...rows], right = [], about = null }) {
  const columns = labels.map((_, k) => k).filter((k) => k !== about);  // what a row means is told where the pointer rests, or below its name where there is none
  const side = (k) => right.includes(k) ? "num" : "", close = (text) => text.length < 30 ? "short" : "";
  const name = (row, cell) => { const means = about === null ? "" : textOf(row[about]); return el("th", { scope: "row", title: means, className: means ? "meant" : "" }, textOf(cell), means ? el("span", { className: "means hint" }, means) : null); };
  return el("div", { className: "table", tabIndex: 0 }, el("table", {},
    labels.some(textOf) ? el("thead", {}, el("tr", {}, ...columns.map((k) => el("th", { scope: "col", className: side(k) }, textOf(labels[k]))))) : null,
    el("tbody", {}, ...rows.map((row) => el("tr", {}, ...columns.map((k) => k ? el("td", { className: `${side(k)} ${styleOf(row[k])} ${close(textOf(row[k]))}` }, textOf(row[k])) : name(row, row[k])))))));
}
export const parts = (list) => list.map((p) => p.kind === "table" ? table(p) : el("p", {}, p.content));
export const sections = (content) => content.sections.map((s) => {
  const inside = [...parts(s.parts), s.note ? el("p", { className: "hint" }, s.note) : null];
  return s.folded ? el("details", {}, el("summary", {}, s.title), ...inside) : el("section", {}, s.title !== "Result" ? el("h3", {}, s.title) : null, ...inside);
});
export function verdict(content, { head = WORDS[content.verdict] ?? content.verdict } = {}) {  // and what stands against it
  const spread = JSON.stringify(content.sections).includes("±") ? el("p", { className: "hint" }, `${content.spread}.`) : null;
  return [el("h2", { className: `${content.verdict} result` }, head), el("p", { className: "hint" }, [content.title, content.subtitle].filter(Boolean).join(". ")),
    ...content.reasons.map((r) => el("p", {}, r)), ...content.warnings.map((w) => el("p", { className: "caution" }, w)), spread];
}
