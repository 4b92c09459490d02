// A file that is chosen: preview, rig, result, the loop of an estimate; and jobs that compute.
import { $, ask, el, proven, put, seconds, show, state, stem, WORDS } from "./core.js";
import { histories } from "./history.js";
import { refresh } from "./lists.js";
import { recordView } from "./records.js";
import { rigForm, rigView } from "./rigform.js";
import { listen } from "./run.js";
import { trouble } from "./stop.js";
import { sections, verdict } from "./tables.js";

export function choose(file) {
  const detail = $("detail");
  detail.replaceChildren(el("h2", {}, file.name));
  detail.scrollIntoView();
  if (file.kind === "report") {
    detail.append(el("p", { className: "hint" }, "The report opens in a tab of its own."), link(file));
    proven(`/reports/${file.number}`).then((address) => window.open(address, "_blank", "noopener"));
  } else if (file.kind === "result") chosenResult(file, detail);
  else if (file.kind === "ledger") {
    detail.append(el("p", { className: "hint" }, "A ledger: what became of bearings is shown under History."));
    $("history-form").elements.ledger.value = file.number;
    put($("history-form").elements.bearing); show("history"); histories();
  } else if (file.kind === "rig") ask(`/api/rigs/${file.number}`).then((r) => detail.append(...rigView(r.text))).catch(trouble);
  else preview(file, detail);
}
function chosenResult(file, detail) {
  const beside = [file.name.replace(/\.json$/, ".html"), file.name.replace(/[^/]*$/, "report.html")], host = el("div");
  const report = state.files.find((f) => beside.includes(f.name));
  host.append(el("p", { className: file.verdict }, WORDS[file.verdict] ?? "no verdict", file.why ? `: ${file.why}` : ""));
  detail.append(report ? link(report) : el("p", { className: "hint" }, "It has no report beside it."), host);
  if (file.schema.startsWith("ambid.estimate")) loopForm(file, detail);
  if (file.schema.startsWith("ambid.commission")) return;  // which its report alone shows
  job({ job: "result", estimate: file.number }, (m) => {
    if (m.kind === "result") put(host, ...verdict(m.content), ...sections(m.content));
  }).catch(wrong(host));
}
// The loop of an estimate: margins as it is, and a better one.
function loopForm(file, detail) {
  const rigs = state.files.filter((f) => f.kind === "rig" && f.loop), host = el("div");
  const rig = el("select", {}, ...rigs.map((f) => el("option", { value: f.number }, f.name)));
  const buttons = [["margins", "Margins"], ["design", "Design a better loop"]].map(([name, label]) => {
    const spec = () => ({ job: name, estimate: file.number, rig: Number(rig.value), out: `${stem(file.name)}-${name}` });
    return el("button", { className: "go", onclick: async () => {
      allow(false); put(host);
      await job(spec(), (m) => { results(m, host); if (m.kind === "result") allow(true); }).catch(wrong(host));
      allow(true);
    } }, label);
  });
  const allow = (on) => { for (const b of buttons) b.disabled = !on || state.read_only || !rigs.length; };
  allow(true);
  detail.append(el("h2", {}, "Its loop"), el("div", { className: "bar" }, el("label", {}, "Rig with [loop] ", rig), ...buttons),
    el("p", { className: "hint" }, rigs.length
    ? "A design writes a rig with the new loop. The controller tries it where Live is started with it as 'Loop to try'."
    : "No rig of this folder has a [loop]: margins and design need one. Write it into the rig of this bench."), host);
}
export const drawn = (p) => el("figure", {}, el("img", { src: p.image, className: "drawn", alt: p.title }),
  el("figcaption", { className: "caption" }, p.caption));
export function link(report) {
  const anchor = el("a", { href: `/reports/${report.number}`, target: "_blank", rel: "noopener" }, `Open ${report.name}`);
  proven(`/reports/${report.number}`).then((address) => { anchor.href = address; });
  return el("span", {}, anchor);
}

// Progress of a whole run in the head of the page, in view wherever that is scrolled to.
export function progressLine(name, cancel = null) {
  const bar = el("progress", { max: 1 }), words = el("span", { role: "status" });
  const line = el("div", { className: "bar" }, bar, words, cancel);
  let now = { stage: "starting", seconds: 0, left: null }, at = performance.now();
  const draw = () => {
    const since = (performance.now() - at) / 1000, past = now.seconds + since, left = now.left === null ? null : now.left - since;
    if (left > 0) bar.value = past / (past + left); else bar.removeAttribute("value");
    const rest = left === null ? "" : left > 0 ? `, about ${seconds(left)} left` : ", longer than the last time";
    words.textContent = `${name}: ${now.stage}, ${seconds(past)}${rest}`;
  };
  $("work").append(line); draw();
  const beat = setInterval(draw, 250);
  return { tell(m) { now = m; at = performance.now(); draw(); }, end() { clearInterval(beat); line.remove(); } };
}
// A job that computes: progress, cancel, and what it found.
export async function job(spec, tell) {
  const of = state.files.find((f) => f.number === (spec.record ?? spec.estimate ?? spec.ledger))?.name ?? spec.out ?? "";
  const cancel = el("button", {}, "Cancel"), line = progressLine(`${spec.job} ${of}`, cancel);
  try {
    const place = state.looks.includes(spec.job) ? "/api/previews" : "/api/runs";
    const { id } = await ask(place, spec);
    cancel.onclick = () => ask(`${place}/${id}/say`, { word: "stop" }).catch(trouble);
    return await new Promise((done, fail) => listen(id, (m) => {
      if (m.kind === "progress") line.tell(m);
      else if (m.kind === "end") m.how === "done" ? done() : fail(new Error(m.why));
      else tell(m);
    }));
  } finally { line.end(); refresh().catch(() => {}); }
}
export function wrong(host) { return (error) => host.append(el("p", { className: "refused", role: "alert" }, error.message)); }

function preview(file, detail, how = {}) {
  const host = el("div"), next = el("div"), plots = el("div"), view = recordView(file, plots, how);
  detail.append(plots, host, next);
  job({ job: "preview", record: file.number, ...how }, (m) => {
    if (m.kind === "note") host.append(el("p", { className: "caution" }, m.text));
    if (m.kind === "look") view.show(m);
    if (m.kind !== "preview") return;
    host.append(...sections(m.content));
    identifyForm(file, { ...m, file: file.name }, next);
  }).catch((error) => { wrong(host)(error); readingForm(file, detail, next); });
}
function readingForm(file, detail, host) {  // what a record does not say by itself, or is to be read in spite of
  const rate = el("input", { type: "number", min: 0, step: "any" });
  const gaps = el("select", {}, ...["error", "interpolate", "cut"].map((g) => el("option", {}, g)));
  const again = () => {
    detail.replaceChildren(el("h2", {}, file.name));
    preview(file, detail, { ...(rate.value && { rate_hz: Number(rate.value) }), gaps: gaps.value });
  };
  put(host, el("div", { className: "bar" }, el("label", {}, "Rate ", rate, " Hz"), el("label", {}, "Gaps ", gaps),
    el("button", { className: "go", onclick: again }, "Read again")));
}
function unused(base, ending) {  // the next name that no file has
  let name = base;
  for (let k = 2; state.files.some((f) => f.name === name + ending); k++) name = `${base}-${k}`;
  return name;
}
function identifyForm(file, m, host) {
  const rigs = state.files.filter((f) => f.kind === "rig"), base = stem(file.name);
  const rig = el("select", { name: "rig" }, el("option", { value: "" }, "draft one from this record"),
    ...rigs.map((f) => el("option", { value: f.number }, f.name)));
  const draft = rigForm(m, unused(`${base}-rig`, ".toml")), result = el("div");
  const out = el("input", { value: unused(`${base}-estimate`, ".json"), size: 24 });
  rig.onchange = () => { draft.box.hidden = rig.value !== ""; };
  const written = async () => {  // the number of the rig, which is written first where it is a draft
    if (rig.value) return Number(rig.value);
    let name = "";
    await job({ job: "rig", text: draft.text.value, out: draft.name.value }, (x) => { if (x.kind === "rig") name = x.name; });
    await refresh();
    const number = state.files.find((f) => f.name === name)?.number;
    rig.append(el("option", { value: number }, name)); rig.value = number; draft.box.hidden = true;
    draft.name.value = unused(`${base}-rig`, ".toml");
    return number;
  };
  const go = el("button", { className: "go", disabled: state.read_only, onclick: async () => {
    put(result);
    go.disabled = true;
    try {
      await job({ job: "identify", record: file.number, rig: await written(), out: out.value }, (x) => {
        results(x, result);
        if (x.kind === "result") go.disabled = state.read_only;
      });
      await refresh();
    } catch (error) { wrong(result)(error); } finally { go.disabled = state.read_only; out.value = unused(`${base}-estimate`, ".json"); }
  } }, "Identify");
  put(host, el("h2", {}, "Identify"), el("div", { className: "bar" }, el("label", {}, "Rig ", rig), el("label", {}, "Result ", out), go),
    draft.box, result);
}
// A result as soon as it is known; its report, with figures, as soon as that is drawn.
export function results(m, host) {
  if (m.kind === "result") {
    const report = el("p", { className: "report hint" }, `${m.name}.json is written; its report is being drawn.`);
    put(host, ...verdict(m.content), report, ...sections(m.content));
    host.firstChild.scrollIntoView();
  }
  const place = host.querySelector(".report");
  if (m.kind !== "report" || !place) return;
  if (m.why) { place.textContent = m.why; place.className = "report caution"; return; }
  place.after(...m.pictures.map(drawn));
  refresh().then(() => {
    const report = state.files.find((f) => f.name === m.name);
    put(place, report ? link(report) : `${m.name} is written.`);
  }).catch(() => {});
}
