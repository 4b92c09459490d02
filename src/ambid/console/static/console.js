// The page of the console: plain JavaScript, no build step. All text from files goes in as text, never as HTML.
"use strict";

const $ = (id) => document.getElementById(id);
const hex = (bytes) => Array.from(new Uint8Array(bytes), (b) => b.toString(16).padStart(2, "0")).join("");
const PAGE = hex(crypto.getRandomValues(new Uint8Array(9)));  // of this load: a tab that is doubled is another page
// The key of the session comes in the fragment of the first address, which no server is sent, and stays in the storage of this port.
const brought = location.hash.match(/^#key=([\w-]+)$/)?.[1];
if (brought) { localStorage.ambidKey = brought; history.replaceState(null, "", "/"); }
const KEY = localStorage.ambidKey ?? "-", bytesOf = (text) => new TextEncoder().encode(text);
const signer = crypto.subtle.importKey("raw", bytesOf(KEY), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
const proven = async (path) => `${path}?proof=${hex(await crypto.subtle.sign("HMAC", await signer, bytesOf(path)))}`;  // an address that the browser opens by itself
const MOVING = ["live", "commission"], LATE_S = 0.2, SILENT_S = 1.5, START_S = 15, OLD_S = 2.0, SLOTS = 2000;
let state = { files: [], runs: [] };

function el(tag, props = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((c) => c !== null && c !== undefined));
  return made;
}
const put = (host, ...nodes) => host.replaceChildren(...nodes.filter((n) => n !== null && n !== undefined));

// Numbers with a prefix and digits that their uncertainty carries.
const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];
function prefix(size) {
  return size > 0 ? PREFIXES.find(([p]) => size >= 0.9995 * p) ?? PREFIXES.at(-1) : [1, ""];
}
function unitOf(unit, size) {
  if (unit === "kg") { const [p, s] = prefix(size * 1e3); return s === "k" ? [1, "kg"] : [p / 1e3, `${s}g`]; }
  if (!unit || unit === "1" || /[²^]/.test(unit)) return [1, unit === "1" ? "" : unit ?? ""];
  const [p, s] = prefix(size);
  return [p, s + unit.replace("ohm", "Ω")];
}
function shown(value, unit, sd) {
  if (value === null || value === undefined || !isFinite(value)) return "unknown";
  const [p, u] = unitOf(unit, Math.abs(value));
  const v = value / p, s = sd > 0 ? sd / p : 0;
  const digits = s ? Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(s)))) : Math.max(0, 3 - Math.floor(Math.log10(Math.abs(v) || 1)));
  return (s ? `${v.toFixed(digits)} ± ${s.toFixed(digits)}` : v.toFixed(Math.min(9, digits))) + (u ? ` ${u}` : "");
}
const seconds = (s) => s < 1 ? `${(1000 * s).toFixed(s < 0.01 ? 1 : 0)} ms` : s < 120 ? `${s.toFixed(1)} s` : `${(s / 60).toFixed(1)} min`;

// Asking the server.
async function ask(path, body, patience) {
  const how = body === undefined ? {} : { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } };
  let answer;
  try {
    answer = await fetch(path, { ...how, signal: patience && AbortSignal.timeout(patience), headers: { ...how.headers, "x-ambid": PAGE, "x-ambid-key": KEY } });
    gone = false;
  } catch { gone = true; lookOld(); throw new Error("the console does not answer"); }
  const found = (answer.headers.get("content-type") ?? "").includes("json") ? await answer.json() : { error: (await answer.text()).trim() };
  if (!answer.ok) throw new Error(found.error ?? answer.statusText);
  return found;
}
let gone = false;  // whether the console itself is silent
function banner(text, kind = "") {
  const host = $("banner");
  if (host.dataset.text === text) return;
  host.dataset.text = text; host.className = kind; host.hidden = !text;
  put(host, text, kind || feed?.over ? el("button", { onclick: () => { if (feed) feed.brokeOff = false; banner(""); } }, "Close") : null);
}
// What is shown is not now: the console, the run's process, or the samples are silent. It outdoes every other banner.
function lookOld() {
  const why = gone ? "the console does not answer. Runs go on; start 'ambid console' again" : feed?.old() ?? "";
  if (why) banner(`OLD: ${why}`);
  else if ($("banner").dataset.text?.startsWith("OLD: ")) banner("");
  const run = feed && !feed.over && !feed.brokeOff ? feed : null;
  run?.socket?.live();
  const other = run?.holder && !run.you ? run.holder : "";
  const not = state.read_only ? "this console is read only" : other ? `${other} has the right to order this run` : why && "what is shown is old";
  const tracked = not || (!(feed instanceof Live) ? "no live run is shown" : !run ? "the run is over" : !feed.following ? "nothing is tracked now" : "");
  for (const button of document.querySelectorAll("[data-say]")) { button.disabled = tracked !== ""; button.title = tracked && `Not now: ${tracked}`; }
  if (question?.run) { question.old = question.run !== run ? "The run is over." : not && `Not now: ${not}.`; refuse(); }
  const driver = !run ? "" : other ? `${other} orders the run ` : run.you ? "this page orders the run" : "no page orders the run";
  if ($("driver").firstChild?.textContent !== driver) put($("driver"), driver, other && !state.read_only ? el("button", { onclick: takeOver }, "Take over") : null);  // a button that is replaced cannot be clicked
  for (const job of MOVING) $(`${job}-form`).hidden = !!run && run.job === job && run.alive;  // one run at a time
}
const trouble = (error) => banner(error.message, "note");

// Questions: a panel beside what is shown. Nothing lies over Stop, and the page goes on.
let question = null;  // the one that is open
function pose(content, { yes = "Yes", run = null, focus = true, closes = true } = {}) {  // whether it is agreed to; null: another question came
  question?.end(null);
  return new Promise((resolve) => {
    const own = question = { run, closes, old: "", not: "", draw: () => { put($("question"), ...content()); refuse(); }, end: (answer) => { if (question !== own) return; question = null; $("ask").hidden = true; document.body.classList.remove("asking"); resolve(answer); } };
    $("yes").textContent = yes;
    own.draw();
    $("ask").hidden = false; document.body.classList.add("asking");
    if (focus) $("no").focus({ preventScroll: true });
    lookOld();
  });
}
function refuse() {  // what cannot be agreed to now
  const why = question.old || question.not;
  $("yes").disabled = why !== ""; $("no").disabled = why !== "" && !question.closes;  // No to a run is an order too
  $("unasked").hidden = why === ""; $("unasked").textContent = why;
}
$("yes").onclick = () => question?.end(true);
$("no").onclick = () => question?.end(false);
const again = () => !question && feed?.asked && feed.pose(feed.asked);  // what another question had covered
const confirmed = (text, yes, more = {}) => pose(() => [el("p", {}, text)], { yes, ...more });

// Colours: as the machine has them, or as chosen; a cookie, since the port is another one each time.
const dark = matchMedia("(prefers-color-scheme: dark)");
function colours() {
  document.documentElement.toggleAttribute("data-dark", $("theme").value ? $("theme").value === "dark" : dark.matches);
  palette = {};
  for (const made of plots) made.box.isConnected ? made.plot.redraw() : plots.delete(made);
  if (feed?.orbitOf) feed.drawOrbit();
}

// Tabs.
function show(tab) {
  for (const section of document.querySelectorAll(".tab")) section.hidden = section.id !== tab;
  for (const button of $("tabs").children) { button.ariaSelected = button.dataset.tab === tab; button.tabIndex = button.dataset.tab === tab ? 0 : -1; }
  location.hash = tab;
  dispatchEvent(new Event("resize"));
}
$("tabs").addEventListener("click", (e) => e.target.dataset.tab && show(e.target.dataset.tab));
$("tabs").addEventListener("keydown", (e) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
  if (!step) return;
  const tabs = [...$("tabs").children], at = tabs.indexOf(document.activeElement);
  tabs.at((at + step) % tabs.length).focus();
});

// Files and runs.
async function refresh() {
  state = { ...await ask("/api/state"), at: performance.now() };
  $("where").textContent = state.folder + (state.read_only ? " (read only)" : "") + (state.left_out ? `, ${state.left_out} older files not shown` : "");
  fill($("list").tBodies[0], state.files, (f) => [f.name, f.kind === "result" ? f.schema.replace(/^ambid\.|\/\d+$/g, "") : f.kind, f.verdict, when(f.changed)], choose, (f) => [f.number, f.changed, f.verdict, f.why]);
  fill($("runs").tBodies[0], state.runs, (r) => [`${r.spec.job} ${when(r.began)}`, r.spec.record ?? r.spec.estimate ?? r.spec.rig ?? r.spec.out ?? "", r.alive ? "runs" : r.end], watch, (r) => [r.id, r.alive, r.end]);
  for (const form of ["live-form", "commission-form"]) {
    choices($(form).elements.rig, state.files.filter((f) => f.kind === "rig"));
    for (const field of $(form).elements) field.disabled = state.read_only;
  }
  const bare = state.read_only ? "This console is read only: runs that others start are shown here." : state.files.some((f) => f.kind === "rig") ? "" : "There is no rig in this folder yet. Choose a record under Files: a rig is drafted from it, checked and written there. ";
  for (const [of, next] of [["live", "Choose a rig and a port, then 'Record and track': simulated is a bench of this machine, replay:NAME a record of the folder, anything else the controller's serial port. Signals, parameters and events appear here."], ["commission", "Choose a rig with [loop] and [daq], and a port, then 'Commission': self-test, rest, polarity, levitation, excitation, record, identification, validation and tracking follow one another; the page asks before the output is switched on."]]) $(`${of}-hint`).textContent = state.read_only ? bare : bare + next;
  choices($("history-form").elements.ledger, state.files.filter((f) => f.kind === "ledger"));
  $("history-form").hidden = !$("history-form").elements.ledger.value;
  $("history-hint").textContent = $("history-form").hidden ? "There is no ledger in this folder yet. 'ambid identify RECORD --ledger works.db' keeps each estimate in one; this page then shows what becomes of a bearing over months." : "";
  choices($("live-form").elements.arm, state.files.filter((f) => f.kind === "rig"), "none");
  choices($("live-form").elements.estimate, state.files.filter((f) => f.schema.startsWith("ambid.estimate")), "from the first seconds");
  $("stop").disabled = state.read_only;
  if (state.read_only) $("stop").title = "This console is read only: use the emergency stop";
  const moving = state.runs.find((r) => r.alive && MOVING.includes(r.spec.job));
  if (moving && (feed?.id !== moving.id || feed.brokeOff) && !attached.has(moving.id)) { attached.add(moving.id); watch(moving); }
}
const attached = new Set();
const when = (s) => { const d = new Date(1000 * s); return d.toDateString() === new Date().toDateString() ? d.toTimeString().slice(0, 8) : d.toISOString().slice(0, 10); };
function fill(body, things, cells, chosen, key) {
  const text = JSON.stringify(things.map(key));
  if (body.dataset.key === text) return;
  body.dataset.key = text;
  const held = body.contains(document.activeElement);
  body.replaceChildren(...things.map((thing) => {
    const pick = () => chosen(thing);
    const row = el("tr", { tabIndex: -1, "data-of": key(thing)[0], onclick: () => { rove(row); pick(); }, onkeydown: (e) => (e.key === "Enter" || e.key === " ") && (e.preventDefault(), pick()) });
    row.append(...cells(thing).map((c, k) => el("td", { className: k ? (c === thing.verdict ? thing.verdict : "") : "name" }, String(c))));
    if (thing.why) (thing.kind ? row.firstChild : row.lastChild).append(el("div", { className: "hint why", title: thing.why }, thing.why));
    return row;
  }));
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
  select.replaceChildren(...(none ? [el("option", { value: "" }, none)] : []), ...files.map((f) => el("option", { value: f.number }, f.name)));
  if ([...select.options].some((o) => o.value === before)) select.value = before;
}
async function takeOver() {
  const run = feed;
  if (await confirmed(`${run.holder} orders the run. Take over? It is told so.`, "Take over")) await ask("/api/drive", { run: run.id }).then((m) => run.leased(m)).catch(trouble);
  again();
}
const stamp = () => new Date().toISOString().slice(0, 19).replace(/[-:]/g, "").replace("T", "-");
const stem = (name) => name.split("/").pop().replace(/\.(csv|csv\.gz|h5|hdf5|mat|json|toml|html)$/i, "");

const WORDS = { usable: "Usable", caution: "Use with caution", unusable: "Do not use" };

function choose(file) {
  const detail = $("detail");
  if (file.kind === "report") { proven(`/reports/${file.number}`).then((address) => window.open(address, "_blank", "noopener")); return; }
  detail.replaceChildren(el("h2", {}, file.name));
  detail.scrollIntoView();
  if (file.kind === "result") {
    const report = state.files.find((f) => f.kind === "report" && stem(f.name) === stem(file.name));
    detail.append(el("p", { className: file.verdict }, WORDS[file.verdict] ?? "no verdict", file.why ? `: ${file.why}` : ""), report ? link(report) : el("p", { className: "hint" }, "It has no report beside it."));
    if (file.schema.startsWith("ambid.estimate")) loopForm(file, detail);
  } else if (file.kind === "ledger") {
    detail.append(el("p", { className: "hint" }, "A ledger: what became of bearings is shown under History."));
    $("history-form").elements.ledger.value = file.number;
    put($("history-form").elements.bearing); show("history"); histories();
  } else if (file.kind === "rig") {
    ask(`/api/rigs/${file.number}`).then((r) => detail.append(el("pre", {}, r.text))).catch(trouble);
  } else preview(file, detail);
}
// The loop of an estimate: margins as it is, and a better one.
function loopForm(file, detail) {
  const rigs = state.files.filter((f) => f.kind === "rig"), host = el("div");
  const rig = el("select", {}, ...rigs.map((f) => el("option", { value: f.number }, f.name)));
  const method = el("select", {}, el("option", { value: "pid" }, "PID, tuned"), el("option", { value: "lqg" }, "LQG"));
  let under = false;
  const run = (name) => async () => {
    if (under) return;
    under = true;
    const spec = { job: name, estimate: file.number, rig: Number(rig.value), out: `${stem(file.name)}-${name}-${stamp()}` };
    host.replaceChildren();
    await job(name === "design" ? { ...spec, method: method.value } : spec, host, (m) => m.kind === "result" && results(m, host)).catch(wrong(host));
    under = false;
  };
  detail.append(el("h2", {}, "Its loop"), el("div", { className: "bar" }, el("label", {}, "Rig with [loop] ", rig),
    el("button", { className: "go", disabled: state.read_only || !rigs.length, onclick: run("margins") }, "Margins"),
    el("label", {}, "Method ", method), el("button", { className: "go", disabled: state.read_only || !rigs.length, onclick: run("design") }, "Design a better loop")),
    el("p", { className: "hint" }, "A design writes a rig with the new loop. The controller tries it where Live is started with it as 'Loop to try'."), host);
}
const drawn = (p) => el("figure", {}, el("img", { src: p.image, className: "drawn", alt: p.title }), el("figcaption", { className: "caption" }, p.caption));
function link(report) {
  const anchor = el("a", { href: `/reports/${report.number}`, target: "_blank", rel: "noopener" }, `Open ${report.name}`);
  proven(`/reports/${report.number}`).then((address) => { anchor.href = address; });
  return el("p", {}, anchor);
}

// A job that computes: progress, cancel, and what it found.
async function job(spec, host, told) {
  const bar = el("progress", { max: 1 }), words = el("span", {}, "starting");
  const cancel = el("button", {}, "Cancel");
  const line = el("p", { className: "bar", role: "status" }, bar, words, cancel);
  host.append(line);
  bar.removeAttribute("value");
  try {
    const place = ["preview", "history"].includes(spec.job) ? "/api/previews" : "/api/runs", { id } = await ask(place, spec);
    cancel.onclick = () => ask(`${place}/${id}/say`, { word: "stop" }).catch(trouble);
    return await new Promise((done, fail) => listen(id, (m) => {
      if (m.kind === "progress") {
        if (m.done === null) bar.removeAttribute("value"); else bar.value = m.done;
        const left = m.done > 0.05 ? `, about ${seconds(m.seconds * (1 / m.done - 1))} left` : "";
        words.textContent = `${m.stage}: ${seconds(m.seconds)}${m.done === null ? ", of a length that is not known" : `, ${Math.round(100 * m.done)} %${left}`}`;
      } else if (m.kind === "end") m.how === "done" ? done() : fail(new Error(m.why));
      else told(m);
    }));
  } finally { line.remove(); refresh().catch(() => {}); }
}
function wrong(host) { return (error) => host.append(el("p", { className: "refused", role: "alert" }, error.message)); }

function preview(file, detail) {
  const host = el("div"), next = el("div");
  detail.append(host, next);
  job({ job: "preview", record: file.number }, host, (m) => {
    if (m.kind === "note") host.append(el("p", { className: "caution" }, m.text));
    if (m.kind !== "preview") return;
    for (const c of m.channels) host.append(strip(`${c.name} [${c.unit}]`, m.t, c.low, c.high, 92).box);
    host.append(el("pre", {}, m.text));
    identifyForm(file, { ...m, file: file.name }, next);
  }).catch(wrong(host));
}
function identifyForm(file, m, host) {
  const rigs = state.files.filter((f) => f.kind === "rig");
  const rig = el("select", { name: "rig" }, el("option", { value: "" }, "draft one from this record"), ...rigs.map((f) => el("option", { value: f.number }, f.name)));
  const draft = rigForm(m);
  const out = el("input", { value: `${stem(file.name)}-estimate`, size: 24 });
  const result = el("div");
  rig.onchange = () => { draft.box.hidden = rig.value !== ""; };
  const go = el("button", { className: "go", disabled: state.read_only, onclick: async () => {
    result.replaceChildren();
    go.disabled = true;
    try {
      let number = Number(rig.value);
      if (!number) {
        let name = "";
        await job({ job: "rig", text: draft.text.value, out: draft.name.value }, result, (x) => { if (x.kind === "rig") name = x.name; });
        await refresh();
        number = state.files.find((f) => f.name === name)?.number;
        rig.append(el("option", { value: number }, name)); rig.value = number; draft.box.hidden = true;
      }
      await job({ job: "identify", record: file.number, rig: number, out: out.value }, result, (x) => x.kind === "result" && results(x, result));
    } catch (error) { wrong(result)(error); } finally { go.disabled = state.read_only; }
  } }, "Identify");
  host.replaceChildren(el("h2", {}, "Identify"), el("div", { className: "bar" }, el("label", {}, "Rig ", rig), el("label", {}, "Result ", out), go), draft.box, result);
}
async function results(m, host) {
  await refresh();
  const report = state.files.find((f) => f.name === m.report);
  const head = el("h2", { className: `${m.verdict} result` }, WORDS[m.verdict] ?? m.verdict);
  put(host, head, report ? link(report) : null, ...m.reasons.map((r) => el("p", {}, r)), ...(m.pictures ?? []).map(drawn), el("pre", {}, m.text));
  head.scrollIntoView();
}

// A rig: channels and parameters as a form over the text that is checked and written.
function rigForm(m) {
  const text = el("textarea", { value: m.draft, spellcheck: false, "aria-label": "rig file" });
  const name = el("input", { value: `${stem(m.file)}-rig`, size: 24 });
  const fields = el("div", { className: "fields" });
  const rows = () => {
    fields.replaceChildren(...["", "value", "unit", "role", "sd, of a prior", ""].map((h, k) => el("span", { className: k < 5 ? "hint" : "about" }, h)));
    for (const [whole, column] of text.value.matchAll(/^\[channels\.(\w+)\]/gm)) {
      const at = new RegExp(`(\\[channels\\.${column}\\]([\\s\\S]*?)^column\\s*=\\s*)"([^"]*)"`, "m"), found = text.value.match(at);
      if (!found) continue;
      const pick = el("select", {}, ...m.channels.map((c) => el("option", { selected: c.name === found[3], value: c.name }, `${c.name} [${c.unit}]`)));
      pick.onchange = () => { text.value = text.value.replace(at, (_, a) => `${a}"${pick.value}"`); };
      fields.append(el("label", { title: whole }, column), el("span", { className: "wide" }, pick), el("span"), el("span", { className: "hint about" }, found[2].match(/# (.*)/)?.[1] ?? ""));
    }
    for (const [line, key, body, about] of text.value.matchAll(/^([\w.]+)\s*=\s*\{([^}\n]*)\}[ \t]*(#.*)?/gm)) {
      if (!/unit\s*=/.test(body)) continue;
      const get = (k) => body.match(new RegExp(`\\b${k}\\s*=\\s*"?([^",}]*)"?`))?.[1]?.trim() ?? "";
      const value = el("input", { value: get("value"), inputMode: "decimal" }), unit = el("input", { value: get("unit") });
      const sd = el("input", { value: get("sd"), inputMode: "decimal" }), role = el("select", {}, ...["free", "fixed", "prior"].map((r) => el("option", { selected: r === (get("role") || "free") }, r)));
      const write = () => {
        const parts = [value.value && `value = ${value.value}`, `unit = "${unit.value}"`, role.value !== "free" && `role = "${role.value}"`, role.value === "prior" && sd.value && `sd = ${sd.value}`].filter(Boolean);
        text.value = text.value.split("\n").map((l) => l.match(/^([\w.]+)\s*=\s*\{/)?.[1] === key ? l.replace(/\{[^}]*\}/, `{ ${parts.join(", ")} }`) : l).join("\n");
      };
      for (const x of [value, unit, role, sd]) x.onchange = write;
      for (const [field, what] of [[value, "value"], [unit, "unit"], [role, "role"], [sd, "standard deviation"]]) field.ariaLabel = `${key}, ${what}`;
      fields.append(el("label", { title: line }, key), value, unit, role, sd, el("span", { className: "hint about" }, about?.slice(1).trim() ?? ""));
    }
  };
  rows();
  text.onchange = rows;
  const box = el("div", {}, el("p", { className: "hint" }, "A draft of the rig: columns and parameters. free: identified; fixed: known; prior: known with a standard deviation."), fields, el("label", {}, "Name ", name), el("details", {}, el("summary", {}, "The file itself"), text));
  return { box, text, name };
}

// Feeds: frames of a run, JSON ("J") and envelopes ("E").
function listen(id, told, envelope = () => {}, gone = () => {}) {
  const decoder = new TextDecoder(), path = `/api/runs/${id}/feed`;
  let socket = null, left = false, ended = false, sign = 0;
  const live = () => { if (socket?.readyState === 1 && performance.now() - sign > 500) { sign = performance.now(); socket.send("here"); } };
  const hear = ({ data }) => {
    live();  // also in a tab behind others, whose timers rest
    if (typeof data === "string") { for (const m of JSON.parse(data)) { ended ||= m.kind === "end"; told(m); } return; }
    const view = new DataView(data);
    for (let at = 0; at + 5 <= data.byteLength;) {
      const length = view.getUint32(at, true), kind = view.getUint8(at + 4);
      if (kind === 69) envelope(data, at + 5);
      else { const m = JSON.parse(decoder.decode(new Uint8Array(data, at + 5, length))); ended ||= m.kind === "end"; told(m); }
      at += 5 + length;
    }
  };
  proven(path).then((address) => {
    if (left) return;
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${address}&page=${PAGE}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = hear;
    socket.onclose = () => { if (!ended && !left) { gone(); told({ kind: "end", how: "lost", why: "the run ended without a word, or the console is gone" }); } };
  });
  return { live, close() { left = true; if (socket) { socket.onmessage = null; socket.close(); } } };
}

// Charts.
let palette = {};  // colours are looked up when they are drawn, as the page may turn dark meanwhile
const css = (name) => palette[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const ink = (name, alpha = "") => () => css(name) + alpha;
const plots = new Set();
let roomy = 74;  // of all charts, so that their times stand below each other
function room(u, labels) {  // as wide as the longest label: none is cut off
  return roomy = Math.max(roomy, ...(labels ?? []).map((s) => 7 * s.length + 16));
}
function axes(unit, more = {}) {
  const grid = { stroke: ink("--grid"), width: 1 };
  const label = (u, splits) => {
    const size = Math.max(...splits.map(Math.abs).filter(isFinite), 0), [p, name] = unitOf(unit, size);
    const gap = splits.length > 1 ? Math.abs(splits[1] - splits[0]) : size || 1;
    let digits = 0;  // as many as tell each tick exactly
    while (digits < 9 && splits.some((s) => Math.abs(+(s / p).toFixed(digits) * p - s) > 1e-3 * gap)) digits++;
    return splits.map((s, k) => (s / p).toFixed(digits) + (k === splits.length - 1 && name ? ` ${name}` : ""));
  };
  return [{ stroke: ink("--dim"), grid, ticks: grid, size: 26, values: more.x ?? ((u, s) => s.map((v, k) => +v.toPrecision(6) + (k === s.length - 1 ? " s" : ""))) , ...(more.xaxis ?? {}) },
          { stroke: ink("--dim"), grid, ticks: grid, size: room, space: 15, values: label, ...(more.yaxis ?? {}) }];
}
function chart(title, height, series, unit, more = {}) {
  const value = el("span"), host = el("div"), box = el("div", { className: "chart" }, el("h3", {}, title, value), host);
  const opts = { width: 400, height, series: [{}, ...series], bands: more.bands, axes: axes(unit, more), scales: { x: { time: false, ...(more.scale ?? {}) }, ...(more.scales ?? {}) }, ...(more.utc ? { padding: [null, 56, null, null], tzDate: (s) => uPlot.tzDate(new Date(1000 * s), "UTC") } : {}), cursor: { drag: { x: true, y: false, setScale: more.zoom ?? false }, y: false }, legend: { show: false }, hooks: more.hooks ?? {} };
  const plot = new uPlot(opts, [[], ...series.map(() => [])], host);
  new ResizeObserver(() => host.clientWidth > 50 && Math.abs(host.clientWidth - plot.width) > 1 && plot.setSize({ width: host.clientWidth, height })).observe(host);
  const made = { box, plot, value };
  for (const old of plots) if (!old.box.isConnected) plots.delete(old);
  setTimeout(() => plots.add(made));
  return made;
}
const line = (color, more = {}) => ({ stroke: color, width: 1.2, points: { show: false }, ...more });
const BAND = () => [line(ink("--accent"), { width: 1 }), line(ink("--accent"), { width: 1 })];
function strip(title, t, low, high, height = 110, unit = title.match(/\[(.*)\]/)?.[1] ?? "") {
  const made = chart(title, height, BAND(), unit, { bands: [{ series: [2, 1], fill: ink("--accent", "66") }], zoom: true });
  made.plot.setData([t, low, high]);
  const known = [...low, ...high].filter((v) => v !== null);
  if (known.length) made.value.textContent = `${shown(known.reduce((a, b) => Math.min(a, b)), unit)} to ${shown(known.reduce((a, b) => Math.max(a, b)), unit)}`;
  return made;
}

// A run that is watched: it is silent where its process is frozen, also while it only waits.
class Watched {
  constructor(run) { Object.assign(this, { id: run.id, job: run.spec.job, alive: run.alive, last: performance.now(), began: false, over: false, brokeOff: false, sampled: Infinity, beat: null, holder: run.holder ?? "", you: run.you ?? false }); }
  listen() {
    this.socket = listen(this.id, (m) => {
      this.last = performance.now(); this.began = true;
      if (m.kind === "beat") this.beat = m.n;
      if (m.kind === "lease") return this.leased(m);
      if (m.kind === "stopping" && this.alive) delivered();  // not of a run that is over and shown again
      if (m.kind === "end") { this.over = true; this.brokeOff = this.alive && m.how === "lost"; if (this.brokeOff) attached.delete(this.id); }
      this.tell(m);
      if (m.kind === "end") { lookOld(); if (!this.brokeOff && $("delivery").className === "good") delivery($("delivery").textContent.replace(/:.*/, ": the run is over."), "good"); }
    }, (data, at) => this.envelope?.(data, at));
  }
  leased(m) {  // who may order
    if (this.you && m.holder && !m.you) banner(`${m.holder} took over: it orders the run now`, "note");
    this.holder = m.holder; this.you = m.you;
    lookOld();
  }
  order(word, more = {}) {  // with the state that this page has seen last
    return ask(`/api/runs/${this.id}/say`, { word, beat: this.beat, ...more }, 1500).catch((error) => trouble(new Error(`${word}: ${error.message}`)));
  }
  old() {
    const now = performance.now(), silent = (now - this.last) / 1000, dry = (now - this.sampled) / 1000;
    if (this.brokeOff) return "the run broke off. What is shown is not now";
    if (!this.over && this.alive && silent > (this.began ? SILENT_S : START_S)) return `the run has been silent for ${silent.toFixed(0)} s, as if its process were frozen. What is shown is not now`;
    return !this.over && this.alive && dry > OLD_S ? `no sample came for ${dry.toFixed(0)} s. What is shown is not now` : "";
  }
}

// The live view.
const COLOURS = ["--accent", "--doubt", "--good", "--bad"];
function decades(u, axis, low, high) {
  const a = Math.ceil(Math.log10(low) - 1e-9), z = Math.floor(Math.log10(high) + 1e-9), step = Math.max(1, Math.ceil((z - a) / 5));
  return Array.from({ length: Math.max(0, Math.floor((z - a) / step) + 1) }, (_, k) => 10 ** (a + k * step));
}
let feed = null;
class Live extends Watched {
  constructor(run) {
    super(run);
    Object.assign(this, { signals: null, header: null, strips: [], parameters: {}, frozen: false, following: false, marked: null, record: null, wanted: run.spec.seconds ?? Infinity });
    this.zoom = null; roomy = 74;
    this.t = []; this.low = []; this.high = []; this.lines = []; this.lags = [];
    $("live-view").hidden = false; $("live-hint").hidden = true;
    for (const host of ["strips", "parameters", "error", "spectrum", "orbit", "events"]) $(host).replaceChildren();
    $("summary").hidden = true;
    for (const host of ["lag", "count", "lost", "tally"]) put($(host));  // nothing of the run before stands as this one's
    freeze(this, false);
    this.unmark();
    this.listen();
    this.draw = this.draw.bind(this);
    requestAnimationFrame(this.draw);
  }
  tell(m) {
    const how = { signals: () => this.begin(m), following: () => { this.following = m.on; }, stopping: () => { this.sampled = Infinity; }, header: () => this.start(m), line: () => this.take(m), spectrum: () => { this.spectrum = m; },
      event: () => { this.heard = true; this.event(m.t, m.what, m.why); }, told: () => this.before(m), device: () => this.event(null, m.what, m.text), note: () => this.event(null, "note", m.text), order: () => this.event(null, ...orderWords(m)),
      progress: () => { if (!this.header) { $("state").textContent = m.stage; $("state").className = "badge"; } },
      summary: () => { $("summary").textContent = m.text; $("summary").hidden = false; },
      recorded: () => { this.sampled = Infinity; this.record = m.name; this.event(null, "record", `${m.name}: ${m.samples} samples, ${m.lost} lost${m.fault ? `; the controller tripped: ${m.fault}` : ""}`); },
      end: () => { $("state").textContent = m.how === "done" ? "over" : m.how === "lost" ? "broke off" : m.how; $("state").className = `badge ${m.how}`; if (m.why) this.event(null, m.how, m.why); refresh().catch(() => {}); } }[m.kind];
    how?.();
  }
  begin(m) {
    if (this.signals) return;
    this.signals = m;
    this.low = m.names.map(() => []); this.high = m.names.map(() => []);
    const height = innerWidth > 900 ? Math.min(240, Math.max(118, (innerHeight - 140) / m.names.length - 34)) : 118;
    this.strips = m.names.map((name, k) => {
      const made = chart(name, height, BAND(), m.units[k], { bands: [{ series: [2, 1], fill: ink("--accent", "66") }], hooks: { setSelect: [(u) => this.mark(u)], drawClear: [(u) => this.shade(u)] } });
      made.plot.over.addEventListener("dblclick", () => { this.zoom = null; this.redraw(); });
      $("strips").append(made.box);
      return made;
    });
    const made = chart("spectrum", 140, m.names.map((_, k) => line(ink(COLOURS[k % 4]))), "", { scale: { distr: 3 }, scales: { y: { distr: 3 } }, hooks: { draw: [turns] }, x: (u, s) => s.map((v) => v === null ? null : Math.abs(Math.log10(v) % 1) < 1e-6 ? (v >= 1000 ? `${v / 1000} kHz` : `${v} Hz`) : ""), yaxis: { splits: decades, values: (u, s) => s.map((v) => v === 1 ? "1" : v?.toExponential(0) ?? "") } });
    put(made.box.querySelector("h3"), "spectrum, peak", el("span", { className: "names" }, ...m.names.map((n, k) => { const name = el("b", {}, ` ${n} [${m.units[k]}]`); name.style.color = `var(${COLOURS[k % 4]})`; return name; })));
    $("spectrum").append(made.box);
    this.lines4 = made;
    const two = m.names.map((n, k) => [n, k]).filter(([n]) => n.endsWith("position"));
    if (two.length > 1) this.orbitOf = two.slice(0, 2).map(([, k]) => k);
  }
  envelope(data, at) {
    if (!this.signals) return;
    const view = new DataView(data), n = view.getUint32(at + 16, true), channels = view.getUint16(at + 20, true), group = view.getUint16(at + 22, true);
    const end = view.getFloat64(at + 24, true), wall = view.getFloat64(at + 32, true), lost = Number(view.getBigUint64(at + 8, true));
    const step = group / this.signals.rate_hz, begin = end - n * step;
    const values = new Float32Array(data.slice(at + 40, at + 40 + 8 * n * channels));
    if (this.t.length && begin - this.t.at(-1) > 1.5 * step) { this.t.push(begin - step / 2); for (let c = 0; c < channels; c++) { this.low[c].push(null); this.high[c].push(null); } }
    for (let k = 0; k < n; k++) {
      this.t.push(begin + (k + 0.5) * step);
      for (let c = 0; c < channels; c++) { this.low[c].push(values[2 * (k * channels + c)]); this.high[c].push(values[2 * (k * channels + c) + 1]); }
    }
    const most = 130_000;
    if (this.t.length > most) { const cut = this.t.length - 100_000; this.t.splice(0, cut); for (const a of [...this.low, ...this.high]) a.splice(0, cut); }
    this.fresh = wall; this.last = performance.now(); this.dirty = true;
    this.sampled = end >= this.wanted - 0.1 ? Infinity : this.last;  // after the last sample none is missed
    this.samples = Number(view.getBigUint64(at, true)) + n * group; this.lost = lost;  // samples that never came
  }
  start(m) {
    if (this.header) return;
    this.header = m;
    for (const [name, v] of Object.entries(m.start)) {
      const made = chart(name, 92, [line("transparent"), line("transparent"), line(ink("--accent"), { width: 1.6 }), line(ink("--dim"), { dash: [4, 4] })], m.units[name], { bands: [{ series: [2, 1], fill: ink("--accent", "33") }] });
      $("parameters").append(made.box);
      this.parameters[name] = { ...made, start: v.value, unit: m.units[name], band: [[], [], []] };
    }
    const error = chart("model error, limit dashed", 92, [line(ink("--accent"), { width: 1.6 }), line(ink("--bad"), { dash: [4, 4] })], "");
    $("error").append(error.box);
    this.error = error;
    for (const w of m.warnings) this.event(null, "start", w);
  }
  take(m) {
    this.lines.push(m);
    if (this.lines.length > 12_000) this.lines.splice(0, 2000);
    $("state").textContent = m.state; $("state").className = `badge ${m.state}`;
    $("lag").textContent = `lag ${seconds(m.lag_s)}`; $("lag").className = m.lag_s > LATE_S ? "late" : "";
    put($("tally"), `${m.updates} updates, ${m.rejected} samples rejected`, m.open ? el("b", { className: "late" }, `, ${m.open} open change${m.open === 1 ? "" : "s"}`) : "");
    this.dirtyLines = true;
    if (question?.run === this) question.draw();
  }
  // What an order would change: old and new values with their intervals, as they are now.
  choice(word) {
    const now = this.lines.at(-1), next = now?.choices[word], half = 1.96, value = (name, v) => shown(v?.[0], this.header.units[name], half * v?.[1]);
    question.not = next ? "" : { accept: "A change was found but not its new value: there is nothing to accept.", revert: "There are no earlier values to return to." }[word];
    return [el("h2", {}, { accept: "Accept the present estimate?", revert: `Go back to the values of ${next ? next.t.toFixed(2) : "?"} s?` }[word]),
      el("p", { className: "hint" }, { accept: "It is in force at once, without waiting for later data. Revert undoes it.", revert: "Tracking then holds until you set it to track." }[word], " ± is the 95 % interval."),
      next && el("table", {}, el("thead", {}, el("tr", {}, ...["", "in force", `after ${word}`].map((h) => el("th", {}, h)))),
        el("tbody", {}, ...Object.entries(next.values).map(([name, v]) => el("tr", {}, el("td", {}, name), el("td", { className: "num" }, value(name, now.values[name])), el("td", { className: "num" }, value(name, v))))))].filter(Boolean);
  }
  async decide(word) {
    const yes = { accept: "Accept", revert: "Revert" }[word];
    if (await pose(() => this.choice(word), { yes, run: this })) this.order(word, word === "revert" ? { goal: this.lines.at(-1).choices.revert?.t } : {});
  }
  event(t, what, why) {
    $("events").prepend(el("li", { className: what === "change" || what === "fault" ? "refused" : "" }, `${t === null || t === undefined ? "" : `${t.toFixed(2)} s `}${what}: ${why}`));
    while ($("events").children.length > 200) $("events").lastChild.remove();
  }
  before(m) {  // events that were told before this page came
    if (this.heard || this.lines.length) return;
    this.heard = true;
    for (const e of m.events) this.event(e.t, e.what, e.why);
  }
  mark(u) {  // what is dragged over; in a picture that stands still it is shown closer too
    if (!u.select.width) return;
    const a = u.posToVal(u.select.left, "x"), b = u.posToVal(u.select.left + u.select.width, "x");
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    if (!(b - a > 1e-3)) return this.unmark();
    this.marked = [a, b];
    if (this.frozen) this.zoom = [a, b];
    this.redraw();
    $("export").disabled = false;
    $("export").textContent = `Export ${a.toFixed(2)} to ${b.toFixed(2)} s`;
  }
  unmark() {
    this.marked = null;
    $("export").disabled = true;
    $("export").textContent = "Export marked stretch";
    this.redraw();
  }
  shade(u) {  // the stretch that is marked, which moves with its samples
    if (!this.marked) return;
    const [a, b] = this.marked.map((x) => Math.min(Math.max(u.valToPos(x, "x", true), u.bbox.left), u.bbox.left + u.bbox.width));
    u.ctx.fillStyle = css("--doubt") + "44"; u.ctx.fillRect(a, u.bbox.top, b - a, u.bbox.height);
  }
  redraw() { if (this.t.length) { this.drawStrips(...this.window()); if (this.lines.length) this.drawLines(...this.window()); } }
  draw() {
    if (feed !== this) return;
    if (!this.frozen && !stop && !$("live").hidden) {  // nothing is drawn while a stop is on its way
      if (this.dirty) this.drawStrips(...this.window());
      if (this.dirtyLines) this.drawLines(...this.window());
      if (this.spectrum && this.lines4) this.drawSpectrum();
      this.dirty = this.dirtyLines = false;
    }
    requestAnimationFrame(this.draw);
  }
  window() {  // the stretch that is shown: the last one, or further back while the picture is frozen
    if (this.zoom) return this.zoom;
    const span = Number($("span").value), first = this.t[0] ?? 0, last = this.t.at(-1) ?? 0;
    const end = this.frozen ? Math.min(last, first + span + (Number($("back").value) / Number($("back").max)) * Math.max(0, last - first - span)) : last;
    return [Math.max(first, end - span), end];
  }
  drawStrips(from, end) {
    let a = this.t.length - 1, z = this.t.length;
    while (a > 0 && this.t[a - 1] >= from) a--;
    while (z > a + 2 && this.t[z - 1] > end) z--;
    const n = z - a, step = Math.max(1, Math.ceil(n / SLOTS));
    const t = step === 1 ? this.t.slice(a, z) : pick(this.t, a, z, step, (x) => x[0]);
    this.strips.forEach((s, k) => {
      const low = step === 1 ? this.low[k].slice(a, z) : pick(this.low[k], a, z, step, (x) => Math.min(...x)), high = step === 1 ? this.high[k].slice(a, z) : pick(this.high[k], a, z, step, (x) => Math.max(...x));
      s.plot.batch(() => { s.plot.setData([t, low, high], false); s.plot.setScale("x", { min: from, max: Math.max(end, from + 0.1) }); });
      s.value.textContent = `${shown(this.low[k].at(-1), this.signals.units[k])} to ${shown(this.high[k].at(-1), this.signals.units[k])}`;
    });
    if (this.orbitOf) this.drawOrbit(a);
    if (this.frozen) return;
    $("count").textContent = `${end.toFixed(1)} s, ${this.samples} samples`;
    $("lost").textContent = this.lost ? `${this.lost} samples LOST` : "0 lost"; $("lost").className = this.lost ? "late" : "";
    this.lags.push(Date.now() / 1000 - this.fresh); if (this.lags.length > 2000) this.lags.shift();
    this.updates = (this.updates ?? 0) + 1;
  }
  drawSpectrum() {
    const floor = (a) => a.map((v) => v > 0 ? v : null);
    this.lines4.plot.setData([this.spectrum.hz, ...this.spectrum.amplitudes.map(floor)]); this.spectrum = null;
  }
  drawOrbit(a = this.t.length - 400) {
    const [x, y] = this.orbitOf.map((k) => this.low[k].slice(Math.max(a, this.t.length - 400)).map((v, i) => (v + this.high[k][Math.max(a, this.t.length - 400) + i]) / 2));
    const canvas = $("orbit").firstChild ?? $("orbit").appendChild(el("canvas", { width: 240, height: 240 })), g = canvas.getContext("2d");
    const size = Math.max(...x.map(Math.abs), ...y.map(Math.abs), 1e-12);
    g.clearRect(0, 0, 240, 240); g.strokeStyle = css("--accent"); g.beginPath();
    x.forEach((v, k) => g.lineTo(120 + 110 * v / size, 120 - 110 * y[k] / size)); g.stroke();
    g.fillStyle = css("--dim"); g.fillText(`orbit, ±${shown(size, "m")}`, 6, 12);
  }
  drawLines(from, end) {  // over the stretch that the strips show
    const lines = this.lines.filter((l, k) => (this.lines[k + 1] ?? l).t >= from && (this.lines[k - 1] ?? l).t <= end);
    const t = lines.map((l) => l.t), last = lines.at(-1) ?? this.lines.at(-1);
    const set = (plot, data) => plot.batch(() => { plot.setData(data, false); plot.setScale("x", { min: from, max: Math.max(end, from + 0.1) }); });
    for (const [name, p] of Object.entries(this.parameters)) {
      const v = lines.map((l) => l.values[name]?.[0] ?? null), s = lines.map((l) => l.values[name]?.[1] ?? null);
      set(p.plot, [t, v.map((x, k) => x === null ? null : x - 1.96 * s[k]), v.map((x, k) => x === null ? null : x + 1.96 * s[k]), v, t.map(() => p.start)]);
      const [value, sd, stale] = last.values[name] ?? [];
      p.value.textContent = shown(value, p.unit, sd) + (stale ? " (frozen)" : "");
    }
    if (this.error) set(this.error.plot, [t, lines.map((l) => l.error), t.map(() => this.header.limit)]);
    if (this.error) this.error.value.textContent = last.error === null ? "unknown" : last.error.toFixed(2);
  }
}
// The speed of the rotor and its multiples in a spectrum.
function turns(u) {
  const hz = Number($("speed").value) / 60;
  for (const k of hz > 0 ? [1, 2, 3] : []) {
    const x = u.valToPos(k * hz, "x", true);
    if (x >= u.bbox.left && x <= u.bbox.left + u.bbox.width) upright(u, x, css("--doubt"), `${k}×`);
  }
}
function upright(u, x, colour, text = "", dash = []) {
  const g = u.ctx;
  g.save(); g.strokeStyle = g.fillStyle = colour; g.lineWidth = devicePixelRatio; g.setLineDash(dash); g.beginPath();
  g.moveTo(x, u.bbox.top); g.lineTo(x, u.bbox.top + u.bbox.height); g.stroke();
  g.textAlign = "left"; g.textBaseline = "top"; g.fillText(text, x + 3 * devicePixelRatio, u.bbox.top); g.restore();
}
function pick(values, a, z, step, of) {
  const found = [];
  for (let k = a; k < z; k += step) { const part = values.slice(k, Math.min(z, k + step)).filter((x) => x !== null); found.push(part.length ? of(part) : null); }
  return found;
}

let starting = false;
async function begin(form, spec) {
  if (starting) return;
  starting = true;
  try {
    for (const [name, field] of Object.entries(Object.fromEntries([...form.elements].filter((f) => f.name).map((f) => [f.name, f])))) {
      if (field.type === "checkbox") spec[name] = field.checked;
      else if (field.value !== "") spec[name] = field.type === "number" || ["rig", "estimate", "arm"].includes(name) ? Number(field.value) : field.value;
    }
    const moves = spec.port !== "simulated" && !spec.port.startsWith("replay:");
    if (moves && !await confirmed(`${spec.port}: the controller will switch its output on and lift the rotor. Is the bench clear, and the emergency stop within reach?`, "Start")) return;
    if (spec.arm && !await confirmed("The controller will try the loop of the other rig while the rotor levitates, and return to its own where the rotor moves too far. Load it?", "Load")) return;
    const before = presses, { id } = await ask("/api/runs", { ...spec, now: state.now + (performance.now() - state.at) / 1000 });
    if (presses !== before) stopAll();  // pressed while the run was about to begin
    banner(""); attached.add(id);
    await refresh();
    watch({ id, spec, alive: true, you: true });
  } catch (error) { trouble(error); refresh().catch(() => {}); } finally { starting = false; again(); }  // another run may have come first: it is shown
}
$("live-form").addEventListener("submit", (e) => { e.preventDefault(); begin(e.target, { job: "live", pace: "real-time" }); });
$("commission-form").addEventListener("submit", (e) => { e.preventDefault(); begin(e.target, { job: "commission" }); });
$("live-form").elements.out.value = `run-${stamp()}`;
$("commission-form").elements.out.value = `commission-${stamp()}`;

function watch(run) {
  attached.add(run.id);
  if (!MOVING.includes(run.spec.job)) return past(run);
  feed?.socket?.close(); feed = null;
  feed = run.spec.job === "live" ? new Live(run) : new Steps(run);
  show(run.spec.job); lookOld();
}
function past(run) {
  const detail = $("detail"), host = el("div");
  detail.replaceChildren(el("h2", {}, `${run.spec.job} of ${run.spec.record ?? run.spec.estimate ?? run.spec.out ?? ""}`), host);
  show("files");
  let found = false;
  const socket = listen(run.id, (m) => {
    if (m.kind === "result") { found = true; results(m, host); }
    else if (m.kind === "preview") { found = true; put(host, el("pre", {}, m.text)); }
    else if (m.kind === "end") { if (!found || m.why) host.append(el("p", { className: m.how }, m.why || m.how)); socket.close(); }
  });
}
for (const button of document.querySelectorAll("[data-say]")) {
  const word = button.dataset.say;
  button.onclick = () => ["accept", "revert"].includes(word) ? feed.decide(word) : feed.order(word);
}
function freeze(live, frozen) {
  live.frozen = frozen; live.zoom = null;
  $("freeze").setAttribute("aria-pressed", frozen);
  $("freeze").textContent = frozen ? "Go on" : "Freeze";
  $("back").hidden = !frozen;
  $("back").value = $("back").max;
}
$("freeze").onclick = () => freeze(feed, !feed.frozen);
$("speed").value = sessionStorage.speed ?? "";
$("speed").oninput = () => { sessionStorage.speed = $("speed").value; feed?.lines4?.plot.redraw(); };
$("back").oninput = $("span").onchange = () => { if (feed?.t) { feed.zoom = null; feed.redraw(); } };
$("export").onclick = async () => {
  const file = state.files.find((f) => f.name === feed.record);
  if (!file) { banner("The record can be cut when the run is over", "note"); return; }
  const host = el("div");
  $("events").prepend(host);
  const [from_s, to_s] = feed.marked;
  await job({ job: "export", record: file.number, from_s, to_s, out: `${stem(file.name)}-${from_s.toFixed(2)}-${to_s.toFixed(2)}` }, host, (m) => m.kind === "exported" && feed.event(null, "exported", `${m.name}, ${m.samples} samples`)).catch(wrong(host));
};
// Stop: of any page, at any time. It says that the run took it, or within a second that it did not.
const DELIVERY_MS = 850, ENDS_MS = 5000;
let stop = null, presses = 0;  // `stop`: the one that is not delivered yet
function delivery(text, kind) { $("delivery").textContent = text; $("delivery").className = kind; $("delivery").hidden = !text; }
function delivered() {
  if (!stop) return;
  delivery(`Stop delivered after ${seconds((performance.now() - stop.began) / 1000)}: the run ends, the output goes off.`, "good");
  clearTimeout(stop.timer); stop = null;
  const own = presses;
  setTimeout(() => refresh().then(() => own === presses && state.runs.some((r) => r.alive && MOVING.includes(r.spec.job)) && delivery("The run took Stop, and has not ended yet. If the rotor still moves, use the emergency stop.", "bad")).catch(() => {}), ENDS_MS);
}
function stopAll() {
  presses++;
  if (question && !question.run) question.end(false);  // what is not begun does not begin
  clearTimeout(stop?.timer);
  const own = stop = { began: performance.now() };
  const undelivered = (why) => { if (stop === own) delivery(`Stop NOT DELIVERED: use the emergency stop. ${why}; it is tried again.`, "bad"); };
  delivery("Stop: on its way.", "note");
  own.timer = setTimeout(() => undelivered("There is no answer"), DELIVERY_MS);
  (async () => {
    while (stop === own) {
      try {
        const answer = await ask("/api/stop", {}, DELIVERY_MS - 20);
        if (stop !== own) return;
        if (!answer.runs.length) { clearTimeout(own.timer); stop = null; return delivery("Nothing to stop: no run of this folder moves anything. If something moves, use the emergency stop.", "note"); }
        if (answer.delivered) return delivered();
        undelivered("The run does not answer");
      } catch (error) { undelivered(error.message[0].toUpperCase() + error.message.slice(1)); }
      await new Promise((done) => setTimeout(done, 1000));
    }
  })();
}
$("stop").addEventListener("pointerdown", (e) => { if (e.button === 0) stopAll(); });
$("stop").addEventListener("click", (e) => { if (e.detail === 0) stopAll(); });  // by a key
let escaped = -Infinity;
addEventListener("keydown", (e) => {
  if (e.ctrlKey && e.key === ".") stopAll();
  if (e.key !== "Escape" || e.repeat) return;
  if (question?.closes) question.end(false);
  if (performance.now() - escaped < 600) stopAll();
  escaped = performance.now();
});
const orderWords = (m) => [m.done ? "order" : "refused", `${m.word} at ${new Date(1000 * m.at).toTimeString().slice(0, 8)} by ${m.by || "this machine"}${m.done ? "" : `: ${m.why}`}`];

// Commissioning.
class Steps extends Watched {
  constructor(run) {
    super(run);
    this.items = {}; this.done = new Set(); this.out = run.spec.out; $("commission-hint").hidden = true;
    $("steps").replaceChildren();
    this.listen();
  }
  item(name) {
    return this.items[name] ??= $("steps").appendChild(el("li", {}, el("strong", {}, name), " ", el("span", { className: "hint" }, "waits")));
  }
  note(name, text) { this.item(name).querySelector("span").textContent = text; }
  tell(m) {
    const how = {
      plan: () => m.steps.forEach((s) => this.item(s)), beginning: () => { this.at = m.name; this.note(m.name, "under way"); },
      progress: () => this.at && !this.done.has(this.at) && this.note(this.at, `${m.stage}${m.done === null ? "" : `, ${Math.round(100 * m.done)} %`}`),
      step: () => this.step(m), note: () => this.append(el("p", { className: "hint" }, m.text)), order: () => this.append(el("p", { className: m.done ? "hint" : "refused" }, orderWords(m).join(": "))), ask: () => this.question(m), stopping: () => this.at && !this.done.has(this.at) && this.note(this.at, "is being stopped"),
      commissioned: () => { this.kept = true; const words = m.passed ? "Commissioned." : `Ended early: ${m.reached}.`; this.append(el("h2", { className: m.verdict }, `Verdict: ${WORDS[m.verdict].toLowerCase()}`)); this.append(el("p", {}, words)); for (const r of m.reasons) this.append(el("p", {}, r)); refresh().then(() => { const f = state.files.find((x) => x.name === m.report); if (f) this.append(link(f)); $("steps").lastChild.scrollIntoView({ block: "end" }); }).catch(() => {}); },
      end: () => { this.question({}); for (const name of Object.keys(this.items)) if (!this.done.has(name)) this.note(name, name === this.at ? "not finished" : "not reached"); const why = m.how === "cancelled" && this.kept ? `Stopped by the operator. The folder ${this.out} and its report keep what was found. To go on, start again with another folder: each step is done anew.` : m.why; if (why) this.append(el("p", { className: m.how, role: "alert" }, why)); refresh().catch(() => {}); },
    }[m.kind];
    how?.();
  }
  append(node, once) { if (!once || !$("steps").querySelector(`.${once}`)) $("steps").append(el("div", { className: once ?? "" }, node)); }
  step(m) {
    this.done.add(m.name);
    const pictures = el("div", { className: "pictures" }, ...m.pictures.map(drawn));
    put(this.item(m.name), el("strong", {}, m.name), " ", el("span", { className: m.passed ? "usable" : "refused" }, m.passed ? "good enough" : "not good enough"),
      ...m.findings.map((f) => el("div", {}, f)), ...m.cautions.map((f) => el("div", { className: "caution" }, f)), ...m.reasons.map((f) => el("div", { className: "refused" }, f)),
      m.text ? el("details", {}, el("summary", {}, "table"), el("pre", {}, m.text)) : null, m.pictures.length ? el("details", { open: !m.passed }, el("summary", {}, `pictures (${m.pictures.length})`), pictures) : null);
  }
  question(m) {  // for who may answer; what was answered elsewhere meanwhile is not answered again
    this.asked = m.what && !this.over ? m : null;
    if (question?.run === this) question.end(null);
    if (this.asked) this.pose(m);
  }
  async pose(m) {
    const yes = await confirmed(`Next step: ${m.what}. The controller will switch its output on; the rotor may move. Is the bench clear, and the emergency stop within reach?`, "Go", { run: this, focus: false, closes: false });
    if (yes === null || this.asked !== m || this.over) return;
    if (!await this.order(yes ? "go" : "no", { number: m.number })) again();
  }
}

// A bearing over time: points with their band, marks where no number is known, events.
const date = (s, long) => new Date(1000 * s).toISOString().slice(0, long ? 16 : 10).replace("T", " ");
const MARKS = { hidden: ["not identifiable", "--dim"], unusable: ["do not use", "--bad"] };
function overTime(name, s, events, first, last) {
  const known = s.value.map((v, k) => k).filter((k) => s.value[k] !== null), mid = known.map((k) => s.half[k] ?? 0).sort((a, b) => a - b)[known.length >> 1];
  const reach = (k) => Math.min(s.half[k] ?? 0, 3 * mid), low = Math.min(...known.map((k) => s.value[k] - reach(k))), high = Math.max(...known.map((k) => s.value[k] + reach(k)));
  const room = 0.12 * (high - low) || 0.01 * Math.abs(high) || 1, edge = 0.02 * (last - first) || 43200;
  const only = (verdict) => s.value.map((v, k) => s.verdict[k] === verdict ? v : null);
  const dots = (colour) => ({ stroke: ink(colour), paths: () => null, points: { show: true, size: 6, fill: ink(colour) } });
  const band = line("transparent"), say = (k) => s.value[k] === null ? MARKS[s.verdict[k]]?.[0] ?? "unknown" : shown(s.value[k], s.unit, s.sd[k]) + (s.verdict[k] === "caution" ? ", with caution" : "");
  const marks = (u) => {
    for (const e of events) {
      const own = e.parameter === "" || e.parameter === name, x = u.valToPos(e.at, "x", true);
      if (x >= u.bbox.left && x <= u.bbox.left + u.bbox.width) upright(u, x, e.kind === "rig" ? css("--good") : css("--doubt") + (own ? "" : "55"), e.parameter === name || e.kind === "rig" ? e.kind : "", e.kind === "rig" ? [6, 4] : []);
    }
    const g = u.ctx, y = u.bbox.top + 0.95 * u.bbox.height, r = 4 * devicePixelRatio;
    g.save(); g.lineWidth = 1.5 * devicePixelRatio;
    s.value.forEach((v, k) => {
      const x = u.valToPos(s.t[k], "x", true);
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
      g.strokeStyle = css(MARKS[s.verdict[k]]?.[1] ?? (v === null ? "--dim" : s.verdict[k] === "caution" ? "--doubt" : "--accent")); g.beginPath();
      if (v !== null) {  // the band of a point that stands alone is this bar
        const ends = [v - s.half[k], v + s.half[k]].map((e) => Math.min(Math.max(u.valToPos(e, "y", true), u.bbox.top), u.bbox.top + u.bbox.height));
        if (known.length <= 40 || ((s.value[k - 1] ?? null) === null && (s.value[k + 1] ?? null) === null)) { g.moveTo(x, ends[0]); g.lineTo(x, ends[1]); }
      } else if (s.verdict[k] === "unusable") { g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r); g.lineTo(x + r, y - r); } else { g.moveTo(x, y - r); g.lineTo(x, y + r); }
      g.stroke();
    });
    g.restore();
  };
  const days = (u, splits, axis, space, step) => splits.map((t) => date(t, step < 86400));
  const made = chart(name, 170, [band, band, line(ink("--accent")), dots("--accent"), dots("--doubt")], s.unit, {
    bands: [{ series: [2, 1], fill: ink("--accent", "33") }], zoom: true, utc: true, scale: { time: true, range: (u, a, b) => first === last ? [first - edge, last + edge] : [a, b] },
    scales: { y: { range: known.length ? [low - 1.4 * room, high + room] : [0, 1] } }, x: days, xaxis: { space: 120 }, yaxis: known.length ? {} : { values: () => [] },
    hooks: { draw: [marks], setCursor: [(u) => { const k = u.cursor.idx; made.value.textContent = k === null || k === undefined ? latest : `${date(s.t[k], true)}: ${say(k)}`; }] } });
  const at = known.at(-1), latest = at === undefined ? "never identifiable" : `${say(at)}, ${date(s.t[at])}${at < s.t.length - 1 ? `; ${say(s.t.length - 1)} since` : ""}`;
  made.value.textContent = latest;
  made.plot.setData([s.t, s.value.map((v, k) => v === null ? null : v - (s.half[k] ?? 0)), s.value.map((v, k) => v === null ? null : v + (s.half[k] ?? 0)), s.value, only("usable"), only("caution")]);
  return made.box;
}
function showHistory(m, host) {
  const first = m.estimates[0].taken_at, last = m.estimates.at(-1).taken_at, shownOnes = m.estimates.slice(-200).reverse();
  put(host, el("h2", { className: `${m.verdict} result` }, `${m.bearing}: ${WORDS[m.verdict] ?? m.verdict}`), ...m.reasons.map((r) => el("p", {}, r)),
    m.left_out ? el("p", { className: "caution" }, `The latest ${m.estimates.length} estimates are drawn; 'ambid history' draws the ${m.left_out} before too.`) : null,
    el("p", { className: "hint" }, "Bands are 95 %. A point with caution is coloured; | not identifiable, × do not use: there no number is known. Drag over a chart to see it closer, a double click shows all. Times are UTC."),
    el("div", { id: "history-charts" }, ...Object.entries(m.series).map(([name, s]) => overTime(name, s, m.events, first, last))),
    m.events.length ? el("h2", {}, "Events") : null,
    m.events.length ? el("ol", { className: "scroll", tabIndex: 0 }, ...m.events.slice(-200).reverse().map((e) => el("li", {}, `${date(e.at, true)} ${e.kind}: ${e.parameter ? `${e.parameter}: ` : ""}${e.text}`))) : null,
    el("h2", {}, m.estimates.length > 200 ? "The latest 200 estimates" : "Estimates"),
    el("div", { className: "scroll", tabIndex: 0 }, el("table", {}, el("thead", {}, el("tr", {}, ...["taken", "record", "verdict", "because of"].map((h) => el("th", {}, h)))),
      el("tbody", {}, ...shownOnes.map((e) => el("tr", {}, el("td", {}, date(e.taken_at, true)), el("td", { className: "name" }, e.record), el("td", { className: e.verdict }, WORDS[e.verdict] ?? e.verdict), el("td", {}, e.failed.replaceAll(",", ", "))))))),
    el("details", {}, el("summary", {}, "As 'ambid history' writes it"), el("pre", {}, m.text)));
}
async function histories() {
  const form = $("history-form").elements, host = $("history-view"), asked = form.bearing.value;
  put(host);
  await job({ job: "history", ledger: Number(form.ledger.value), ...(asked && { bearing: asked }) }, host, (m) => {
    if (m.kind === "bearings") {
      put(form.bearing, ...m.names.map((n) => el("option", { selected: n === asked }, n)));
      if (!m.names.length) host.append(el("p", { className: "hint" }, "The ledger has no bearing yet."));
      if (m.failures) host.append(el("details", {}, el("summary", {}, `${m.failures} ${m.failures === 1 ? "record" : "records"} without an estimate`), ...m.failed.map((f) => el("p", {}, `${f.record || "a record"} (${f.bearing}): ${f.reason}`))));
    }
    if (m.kind === "history") showHistory(m, host.appendChild(el("div")));
  }).catch(wrong(host));
}
$("history-form").addEventListener("submit", (e) => { e.preventDefault(); histories(); });
$("history-form").elements.bearing.onchange = histories;
$("history-form").elements.ledger.onchange = () => { put($("history-form").elements.bearing); histories(); };

$("theme").value = document.cookie.match(/(?:^|; )ambid_colours=(light|dark)/)?.[1] ?? "";
$("theme").onchange = () => { document.cookie = `ambid_colours=${$("theme").value}; SameSite=Strict; path=/; max-age=31536000`; colours(); };
dark.addEventListener("change", colours);
colours();
if (["files", "live", "commission", "history"].includes(location.hash.slice(1))) show(location.hash.slice(1));
refresh().catch(trouble);
let listing = false;  // one at a time: a browser asks six things of a server at once, and Stop does not queue behind them
setInterval(() => { if (!document.hidden && !listing) { listing = true; refresh().catch(() => {}).finally(() => { listing = false; }); } }, 2000);
setInterval(lookOld, 250);
window.ambidConsole = { get feed() { return feed; } };  // for tests and the curious
