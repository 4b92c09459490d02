// Files and runs of the folder as lists, and what may be chosen from them.
import { $, ask, el, feed, learn, MOVING, put, state, when } from "./core.js";
import { choose } from "./files.js";
import { attached } from "./run.js";
import { watch } from "./start.js";

const NEXT = {
  live: "Choose a rig and a port, then 'Record and track': simulated is a bench of this machine, replay:NAME a record of the folder, "
    + "anything else the controller's serial port. Signals, parameters and events appear here.",
  commission: "Choose a rig with [loop] and [daq], and a port, then 'Commission': self-test, rest, polarity, levitation, excitation, "
    + "record, identification, validation and tracking follow one another; the page asks before the output is switched on.",
};
export async function refresh() {
  learn({ ...await ask("/api/state"), at: performance.now() });
  $("where").textContent = state.folder + (state.read_only ? " (read only)" : "")
    + (state.left_out ? `, ${state.left_out} older files not shown` : "");
  fill($("list").tBodies[0], state.files, (f) => [f.name, f.kind === "result" ? f.schema.replace(/^ambid\.|\/\d+$/g, "") : f.kind,
    f.verdict, when(f.changed)], choose, (f) => [f.number, f.changed, f.verdict, f.why]);
  fill($("runs").tBodies[0], state.runs, (r) => [`${r.spec.job} ${when(r.began)}`,
    r.spec.record ?? r.spec.estimate ?? r.spec.rig ?? r.spec.out ?? "", r.alive ? "runs" : r.end], watch, (r) => [r.id, r.alive, r.end]);
  for (const form of ["live-form", "commission-form"]) {
    const rigs = state.files.filter((f) => f.kind === "rig" && (f.loop || form === "live-form"));
    choices($(form).elements.rig, rigs, !rigs.length && (form === "live-form" ? "no rig yet" : "no rig with [loop] yet"));
    for (const field of $(form).elements) field.disabled = state.read_only;
    if (form === "commission-form") offerRedesign();
  }
  const bare = state.read_only ? "This console is read only: runs that others start are shown here."
    : state.files.some((f) => f.kind === "rig") ? ""
    : "There is no rig in this folder yet. Choose a record under Files: a rig is drafted from it, checked and written there. ";
  for (const [of, next] of Object.entries(NEXT)) $(`${of}-hint`).textContent = state.read_only ? bare : bare + next;
  choices($("history-form").elements.ledger, state.files.filter((f) => f.kind === "ledger"));
  choices($("fleet-form").elements.ledger, state.files.filter((f) => f.kind === "ledger"));
  $("fleet-form").hidden = !$("fleet-form").elements.ledger.value;
  $("fleet-hint").textContent = !$("fleet-form").hidden
    ? "How every bearing of a ledger stands, by its estimates alone. A click shows its history." : "There is no ledger in this folder yet. "
    + "'ambid identify RECORD --ledger works.db', or 'ambid fleet' for many records, keeps each estimate in one.";
  $("history-form").hidden = !$("history-form").elements.ledger.value;
  $("history-hint").textContent = $("history-form").hidden
    ? "There is no ledger in this folder yet. 'ambid identify RECORD --ledger works.db' keeps each estimate in one; "
      + "this page then shows what becomes of a bearing over months." : "";
  choices($("live-form").elements.arm, state.files.filter((f) => f.kind === "rig" && f.loop), "none");
  choices($("live-form").elements.estimate, state.files.filter((f) => f.schema.startsWith("ambid.estimate")), "from the first seconds");
  $("stop").disabled = state.read_only;
  if (state.read_only) $("stop").title = "This console is read only: use the emergency stop";
  const moving = state.runs.find((r) => r.alive && MOVING.includes(r.spec.job));
  if (moving && (feed?.id !== moving.id || feed.brokeOff) && !attached.has(moving.id)) { attached.add(moving.id); watch(moving); }
}
function offerRedesign() {  // which the firmware alone can try
  const { port, redesign } = $("commission-form").elements, simulated = port.value === "simulated";
  redesign.disabled = state.read_only || simulated;
  redesign.parentNode.title = simulated ? "Only the firmware tries another loop: take the port emulated, or a bench" : "";
  if (simulated) redesign.checked = false;
}
$("commission-form").elements.port.addEventListener("input", offerRedesign);
function fill(body, things, cells, chosen, key) {
  const text = JSON.stringify(things.map(key));
  if (body.dataset.key === text) return;
  body.dataset.key = text;
  const held = body.contains(document.activeElement), { empty } = body.parentNode.dataset;
  body.replaceChildren(...things.map((thing) => {
    const pick = () => chosen(thing);
    const row = el("tr", { tabIndex: -1, "data-of": key(thing)[0], onclick: () => { rove(row); pick(); },
      onkeydown: (e) => (e.key === "Enter" || e.key === " ") && (e.preventDefault(), pick()) });
    row.append(...cells(thing).map((c, k) => el("td", { className: k ? (c === thing.verdict ? thing.verdict : "") : "name" }, String(c))));
    if (thing.why) (thing.kind ? row.firstChild : row.lastChild).append(el("div", { className: "hint why", title: thing.why }, thing.why));
    return row;
  }));
  if (!things.length) return put(body, el("tr", {}, el("td", { colSpan: 4, className: "hint" }, empty)));
  const at = [...body.rows].find((r) => r.dataset.of === body.dataset.at) ?? body.rows[0];
  if (at) { at.tabIndex = 0; at.ariaCurrent = at.dataset.of === body.dataset.at ? "true" : null; if (held) at.focus(); }
}
// One row of a list is reached by Tab, the others from it by arrows.
function rove(row) {
  const body = row.parentNode;
  for (const other of body.rows) { other.tabIndex = other === row ? 0 : -1; other.ariaCurrent = other === row ? "true" : null; }
  body.dataset.at = row.dataset.of;
}
for (const body of [$("list").tBodies[0], $("runs").tBodies[0]]) body.addEventListener("keydown", (e) => {
  const rows = [...body.rows], at = rows.indexOf(document.activeElement);
  const to = { ArrowDown: at + 1, ArrowUp: at - 1, PageDown: at + 10, PageUp: at - 10, Home: 0, End: rows.length - 1 }[e.key];
  if (to === undefined || at < 0) return;
  e.preventDefault();
  const row = rows[Math.min(Math.max(to, 0), rows.length - 1)];
  rove(row); row.focus();
});
function choices(select, files, none) {
  const text = JSON.stringify(files.map((f) => f.number));
  if (select.dataset.key === text) return;
  const before = select.value;
  select.dataset.key = text;
  select.replaceChildren(...(none ? [el("option", { value: "" }, none)] : []),
    ...files.map((f) => el("option", { value: f.number }, f.name)));
  if ([...select.options].some((o) => o.value === before)) select.value = before;
}
