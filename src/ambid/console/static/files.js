// A file that is chosen: preview, rig, result, the loop of an estimate; and jobs that compute.
import { $, ask, el, proven, put, seconds, show, stamp, state, stem, WORDS } from "./core.js";
import { histories } from "./history.js";
import { refresh } from "./lists.js";
import { strip } from "./plot.js";
import { rigForm } from "./rigform.js";
import { listen } from "./run.js";
import { trouble } from "./stop.js";

export function choose(file) {
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
export const drawn = (p) => el("figure", {}, el("img", { src: p.image, className: "drawn", alt: p.title }), el("figcaption", { className: "caption" }, p.caption));
export function link(report) {
  const anchor = el("a", { href: `/reports/${report.number}`, target: "_blank", rel: "noopener" }, `Open ${report.name}`);
  proven(`/reports/${report.number}`).then((address) => { anchor.href = address; });
  return el("p", {}, anchor);
}

// A job that computes: progress, cancel, and what it found.
export async function job(spec, host, told) {
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
export function wrong(host) { return (error) => host.append(el("p", { className: "refused", role: "alert" }, error.message)); }

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
export async function results(m, host) {
  await refresh();
  const report = state.files.find((f) => f.name === m.report);
  const head = el("h2", { className: `${m.verdict} result` }, WORDS[m.verdict] ?? m.verdict);
  put(host, head, report ? link(report) : null, ...m.reasons.map((r) => el("p", {}, r)), ...(m.pictures ?? []).map(drawn), el("pre", {}, m.text));
  head.scrollIntoView();
}
