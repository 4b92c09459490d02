// A rig: channels and parameters as a form over the text that is checked and written.
import { el } from "./core.js";
import { parts } from "./tables.js";

// A rig that is written, section by section.
export function rigView(text) {
  const shown = [];
  for (const line of text.split("\n")) {
    const head = line.match(/^\s*\[([^\]]+)\]\s*(#.*)?$/), entry = line.match(/^\s*([\w.]+)\s*=\s*([^#"]*(?:"[^"]*"[^#"]*)*)(#.*)?$/);
    if (head || !shown.length) shown.push({ title: head?.[1] ?? "", rows: [] });
    const { rows } = shown.at(-1), more = line.trim();
    if (entry) rows.push([entry[1], entry[2].trim(), entry[3]?.slice(1).trim() ?? ""]);
    else if (!head && more && !more.startsWith("#") && rows.length) rows.at(-1)[1] += ` ${more}`;  // a list goes on
  }
  const tables = shown.filter((s) => s.rows.length).flatMap((s) => [...(s.title ? [el("h3", {}, s.title)] : []),
    ...parts([{ kind: "table", content: [["", "", ""], ...s.rows] }])]);
  const file = el("textarea", { value: text, readOnly: true, spellcheck: false, "aria-label": "rig file" });
  return [...tables, el("details", {}, el("summary", {}, "The file itself"), file)];
}
export function rigForm(m, free) {
  const text = el("textarea", { value: m.draft, spellcheck: false, "aria-label": "rig file" });
  const name = el("input", { value: free, size: 24 });
  const fields = el("div", { className: "fields" });
  const rows = () => {
    const heads = ["", "value", "unit", "role", "sd, of a prior", ""];
    fields.replaceChildren(...heads.map((h, k) => el("span", { className: k < 5 ? "hint" : "about" }, h)));
    for (const [whole, column] of text.value.matchAll(/^\[channels\.(\w+)\]/gm)) {
      const at = new RegExp(`(\\[channels\\.${column}\\]([\\s\\S]*?)^column\\s*=\\s*)"([^"]*)"`, "m"), found = text.value.match(at);
      if (!found) continue;
      const pick = el("select", {}, ...m.channels.map((c) =>
        el("option", { selected: c.name === found[3], value: c.name }, `${c.name} [${c.unit}]`)));
      pick.onchange = () => { text.value = text.value.replace(at, (_, a) => `${a}"${pick.value}"`); };
      fields.append(el("label", { title: whole }, column), el("span", { className: "wide" }, pick), el("span"),
        el("span", { className: "hint about" }, found[2].match(/# (.*)/)?.[1] ?? ""));
    }
    for (const [line, key, body, about] of text.value.matchAll(/^([\w.]+)\s*=\s*\{([^}\n]*)\}[ \t]*(#.*)?/gm)) {
      if (!/unit\s*=/.test(body)) continue;
      const get = (k) => body.match(new RegExp(`\\b${k}\\s*=\\s*"?([^",}]*)"?`))?.[1]?.trim() ?? "";
      const value = el("input", { value: get("value"), inputMode: "decimal" }), unit = el("input", { value: get("unit") });
      const sd = el("input", { value: get("sd"), inputMode: "decimal" }),
        role = el("select", {}, ...["free", "fixed", "prior"].map((r) => el("option", { selected: r === (get("role") || "free") }, r)));
      const write = () => {
        const parts = [value.value && `value = ${value.value}`, `unit = "${unit.value}"`, role.value !== "free" && `role = "${role.value}"`,
          role.value === "prior" && sd.value && `sd = ${sd.value}`].filter(Boolean);
        text.value = text.value.split("\n").map((l) => l.match(/^([\w.]+)\s*=\s*\{/)?.[1] === key
          ? l.replace(/\{[^}]*\}/, `{ ${parts.join(", ")} }`) : l).join("\n");
      };
      for (const x of [value, unit, role, sd]) x.onchange = write;
      const names = [[value, "value"], [unit, "unit"], [role, "role"], [sd, "standard deviation"]];
      for (const [field, what] of names) field.ariaLabel = `${key}, ${what}`;
      fields.append(el("label", { title: line }, key), value, unit, role, sd,
        el("span", { className: "hint about" }, about?.slice(1).trim() ?? ""));
    }
  };
  rows();
  text.onchange = rows;
  const box = el("div", {},
    el("p", { className: "hint" },
    "A draft of the rig: columns and parameters. free: identified; fixed: known; prior: known with a standard deviation."), fields,
    el("label", {}, "Name ", name), el("details", {}, el("summary", {}, "The file itself"), text));
  return { box, text, name };
}
