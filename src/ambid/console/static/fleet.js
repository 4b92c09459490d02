// A fleet: how every bearing of a ledger stands.
import { $, el, put, show, WORDS } from "./core.js";
import { job, wrong } from "./files.js";
import { histories } from "./history.js";

const STATES = { alarm: ["alarm", "unusable"], unusable: ["not usable", "unusable"], stale: ["stale", "caution"],
  caution: ["caution", "caution"], good: ["good", "usable"] };  // the gravest first
const GRAVE = Object.keys(STATES), VERDICTS = ["unusable", "caution", "usable"];
const day = (s) => s === null ? "never" : new Date(1000 * s).toISOString().slice(0, 16).replace("T", " ");
const age = (s) => s === null ? "" : s < 7200 ? `${Math.round(s / 60)} min`
  : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} d`;
// head, what a row is sorted by, what it shows
const COLUMNS = [["bearing", (r) => r.bearing, (r) => r.bearing], ["rig", (r) => r.rig, (r) => r.rig],
  ["state", (r) => GRAVE.indexOf(r.state), (r) => STATES[r.state][0]],
  ["verdict", (r) => VERDICTS.indexOf(r.verdict), (r) => WORDS[r.verdict] ?? r.verdict],
  ["age", (r) => -(r.age_s ?? Infinity), (r) => age(r.age_s) + (r.age_s > r.stale_after_s ? ", stale" : "")],
  ["last usable", (r) => r.usable ?? 0, (r) => day(r.usable)], ["last estimate", (r) => r.last, (r) => day(r.last)],
  ["estimates", (r) => r.estimates, (r) => r.estimates],
  ["alarms, failed checks", (r) => -r.alarms.length, (r) => [...r.alarms, r.failed.replaceAll(",", ", "),
    r.without ? `${r.without} ${r.without === 1 ? "record" : "records"} without an estimate` : ""].filter(Boolean).join("; ")]];
let rows = [], said = null, sorted = 2, up = true;
const form = $("fleet-form").elements;

function go(row) {  // to the history of a bearing
  const of = $("history-form").elements;
  of.ledger.value = said.ledger;
  put(of.bearing, el("option", { selected: true }, row.bearing));
  show("history"); histories();
}
function draw() {
  const text = form.find.value.toLowerCase();
  const fits = rows.filter((r) => (!form.state.value || r.state === form.state.value)
    && [r.bearing, r.rig, r.failed, ...r.alarms].some((s) => s.toLowerCase().includes(text)));
  const by = COLUMNS[sorted][1], order = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
  fits.sort((a, b) => (up ? 1 : -1) * order(by(a), by(b)) || order(a.bearing, b.bearing));
  const count = (s) => rows.filter((r) => r.state === s).length;
  const heads = COLUMNS.map(([name], k) => el("th", { "aria-sort": k !== sorted ? "none" : up ? "ascending" : "descending" },
    el("button", { "data-sort": k, onclick: () => {
      up = k !== sorted || !up; sorted = k; draw();
      $("fleet-view").querySelector(`[data-sort="${k}"]`).focus();
    } }, name + (k !== sorted ? "" : up ? " ▲" : " ▼"))));
  const cell = (r, [name, , shown], k) => el("td", { "data-head": name, className: k === 2 ? STATES[r.state][1] : k === 3 ? r.verdict
    : k === 4 && r.age_s > r.stale_after_s ? "caution" : k < 1 ? "name" : "" },
  k ? String(shown(r)) : el("button", { className: "plain", title: `History of ${r.bearing}` }, r.bearing));
  put($("fleet-view"), el("p", { role: "status" }, !rows.length ? "The ledger has no bearing yet."
    : `${fits.length} of ${rows.length} bearings: ${GRAVE.filter(count).map((s) => `${count(s)} ${STATES[s][0]}`).join(", ")}.`),
  rows.length ? el("table", { className: "fleet" }, el("thead", {}, el("tr", {}, ...heads)),
    el("tbody", {}, ...fits.map((r) => el("tr", { onclick: () => go(r) }, ...COLUMNS.map((c, k) => cell(r, c, k)))))) : null,
  rows.length ? el("p", { className: "hint" }, "Age is that of the last usable estimate; it is stale after four and a half times "
    + "the usual time between two estimates of the bearing, later where they come irregularly, at least a day. Alarms are those of the built-in rules, as 'ambid history --alarms' "
    + "tells them. Times are UTC.") : null);
}
async function look() {
  const host = el("div");
  rows = []; said = { ledger: form.ledger.value };
  put($("fleet-view"), host);
  await job({ job: "fleet", ledger: Number(form.ledger.value) }, (m) => { if (m.kind === "bearings") rows.push(...m.rows); })
    .then(draw).catch(wrong(host));
}
form.state.append(...GRAVE.map((s) => el("option", { value: s }, STATES[s][0])));
form.state.onchange = form.find.oninput = () => said && draw();
form.ledger.onchange = look;
$("fleet-form").addEventListener("submit", (e) => { e.preventDefault(); look(); });
