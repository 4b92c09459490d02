// What happened in a run, to be filtered and taken note of: who did is written to the run and shown on all pages.
import { ask, el, feed, put, state, when } from "./core.js";
import { refresh } from "./lists.js";
import { trouble } from "./stop.js";

const ALARMS = ["change", "disturbed", "fault", "trip", "lost", "limit", "failed", "refused"], MOST = 500;
const MARKED = [...ALARMS, "accepted", "reverted", "operator", "order"];
export class Alarms {
  constructor(run, host) {
    Object.assign(this, { id: run.id, host, all: new Map(), marks: [], kinds: "", noted: {} });
    this.filter = el("select", { ariaLabel: "which events", onchange: () => this.draw() });
    this.every = el("button", { type: "button", className: "tool", onclick: () => this.note(this.open()) }, "Acknowledge all");
    host.parentNode.querySelector(".alarms")?.remove();
    host.before(el("p", { className: "bar alarms" }, this.filter, this.count = el("span", { role: "status" }), this.every));
    addEventListener("state", () => this === feed?.alarms && this.look());
    this.draw();
  }
  add(t, what, why, at = null) {
    const key = `${what}|${t ?? at ?? ""}|${why}`.slice(0, 160);
    if (this.all.has(key)) return;  // a page that comes again is told all anew
    this.all.set(key, { key, t: t ?? null, what, why });
    if (this.all.size > MOST) this.all.delete(this.all.keys().next().value);
    if (t !== null && t !== undefined && MARKED.includes(what)) {
      this.marks.push({ at: t, words: `${what}: ${why}`, colour: ALARMS.includes(what) ? "--bad" : "--dim" });
      this.marks.sort((a, b) => a.at - b.at); this.marks.splice(0, this.marks.length - 100);
    }
    this.late ??= setTimeout(() => { this.late = null; this.draw(); });
  }
  look() {
    const noted = state.runs.find((r) => r.id === this.id)?.acknowledged ?? {};
    if (Object.keys(noted).length !== Object.keys(this.noted).length) { this.noted = noted; this.draw(); }
  }
  open() { return [...this.all.values()].filter((e) => ALARMS.includes(e.what) && !this.noted[e.key]); }
  note(events) {
    const keys = events.slice(0, 200).map((e) => e.key);
    ask(`/api/runs/${this.id}/say`, { word: "acknowledge", keys }).then(refresh).then(() => this.look()).catch(trouble);
  }
  draw() {
    const kinds = [...new Set([...this.all.values()].map((e) => e.what))].sort(), open = this.open(), chosen = this.filter.value;
    if (this.kinds !== kinds.join()) {
      this.kinds = kinds.join();
      put(this.filter, ...[["", "all events"], ["alarms", "alarms"], ["open", "not acknowledged"], ...kinds.map((k) => [`is ${k}`, k])]
        .map(([value, text]) => el("option", { value, selected: value === chosen }, text)));
    }
    this.every.hidden = !open.length || state.read_only;
    this.count.textContent = open.length ? `${open.length} not acknowledged` : "no open alarm";
    this.count.className = open.length ? "late" : "hint";
    const { value } = this.filter, seen = [...this.all.values()].filter((e) => !value || (value === "alarms" ? ALARMS.includes(e.what)
      : value === "open" ? open.includes(e) : `is ${e.what}` === value));
    put(this.host, ...seen.reverse().slice(0, 200).map((e) => {
      const alarm = ALARMS.includes(e.what), [by, at] = this.noted[e.key] ?? [];
      return el("li", { className: alarm && !by ? "refused" : "" }, `${e.t === null ? "" : `${e.t.toFixed(2)} s `}${e.what}: ${e.why} `,
        by ? el("span", { className: "hint" }, `acknowledged ${when(at)} by ${by}`) : alarm && !state.read_only
          ? el("button", { type: "button", className: "tool", onclick: () => this.note([e]) }, "Acknowledge") : null);
    }), ...(seen.length ? [] : [el("li", { className: "hint" }, this.all.size ? "none of this kind" : "nothing happened yet")]));
  }
}
