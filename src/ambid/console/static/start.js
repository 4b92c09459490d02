// Runs are begun, and watched.
import { Steps } from "./commission.js";
import { $, ask, attend, el, feed, MOVING, put, show, stamp, state } from "./core.js";
import { results } from "./files.js";
import { refresh } from "./lists.js";
import { Live } from "./live.js";
import { attached, listen } from "./run.js";
import { again, banner, confirmed, lookOld, presses, stopAll, trouble } from "./stop.js";

const FILES = ["rig", "estimate", "arm"];
let starting = false;
async function begin(form, spec) {
  if (starting) return;
  starting = true;
  try {
    for (const [name, field] of Object.entries(Object.fromEntries([...form.elements].filter((f) => f.name).map((f) => [f.name, f])))) {
      if (field.type === "checkbox") spec[name] = field.checked;
      else if (field.value !== "") spec[name] = field.type === "number" || FILES.includes(name) ? Number(field.value) : field.value;
    }
    const moves = spec.port !== "simulated" && !spec.port.startsWith("replay:");
    if (moves && !await confirmed(`${spec.port}: the controller will switch its output on and lift the rotor. `
      + "Is the bench clear, and the emergency stop within reach?", "Start")) return;
    if (spec.arm && !await confirmed("The controller will try the loop of the other rig while the rotor levitates, "
      + "and return to its own where the rotor moves too far. Load it?", "Load")) return;
    const before = presses, { id } = await ask("/api/runs", { ...spec, now: state.now + (performance.now() - state.at) / 1000 });
    if (presses !== before) stopAll();  // pressed while the run was about to begin
    banner(""); attached.add(id);
    await refresh();
    watch({ id, spec, alive: true, you: true });
  // another run may have come first: it is shown
  } catch (error) { trouble(error); refresh().catch(() => {}); } finally { starting = false; again(); }
}
$("live-form").addEventListener("submit", (e) => { e.preventDefault(); begin(e.target, { job: "live", pace: "real-time" }); });
$("commission-form").addEventListener("submit", (e) => { e.preventDefault(); begin(e.target, { job: "commission" }); });
$("live-form").elements.out.value = `run-${stamp()}`;
$("commission-form").elements.out.value = `commission-${stamp()}`;

export function watch(run) {
  attached.add(run.id);
  if (!MOVING.includes(run.spec.job)) return past(run);
  feed?.socket?.close(); feed?.line?.end(); attend(null);
  attend(run.spec.job === "live" ? new Live(run) : new Steps(run));
  show(run.spec.job); lookOld();
}
function past(run) {
  const detail = $("detail"), host = el("div");
  detail.replaceChildren(el("h2", {}, `${run.spec.job} of ${run.spec.record ?? run.spec.estimate ?? run.spec.out ?? ""}`), host);
  show("files");
  let found = false;
  const socket = listen(run.id, (m) => {
    if (["result", "report"].includes(m.kind)) { found = true; results(m, host); }
    else if (m.kind === "end") { if (!found || m.why) host.append(el("p", { className: m.how }, m.why || m.how)); socket.close(); }
  });
}
