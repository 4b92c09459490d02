// Commissioning.
import { $, el, put, state, WORDS } from "./core.js";
import { drawn, link, progressLine } from "./files.js";
import { refresh } from "./lists.js";
import { orderWords, Watched } from "./run.js";
import { again, confirmed, question } from "./stop.js";
import { parts } from "./tables.js";

export class Steps extends Watched {
  constructor(run) {
    super(run);
    this.items = {}; this.done = new Set(); this.out = run.spec.out; $("commission-hint").hidden = true;
    $("steps").replaceChildren();
    this.listen();
  }
  item(name) {
    return this.items[name] ??= $("steps").appendChild(el("li", {}, el("strong", {}, name), " ",
      el("span", { className: "hint" }, "waits")));
  }
  note(name, text) { this.item(name).querySelector("span").textContent = text; }
  tell(m) {
    const how = {
      plan: () => m.steps.forEach((s) => this.item(s)), beginning: () => { this.at = m.name; this.note(m.name, "under way"); },
      progress: () => {
        if (!this.at || this.done.has(this.at) || this.over) return;
        this.note(this.at, `${m.stage}${m.done === null ? "" : `, ${Math.round(100 * m.done)} %`}`);
        this.line ??= progressLine(`commission ${this.out}`);
        this.line.tell({ ...m, stage: `${this.at}, step ${this.done.size + 1} of ${Object.keys(this.items).length}` });
      },
      step: () => this.step(m), note: () => this.append(el("p", { className: "hint" }, m.text)),
        order: () => this.append(el("p", { className: m.done ? "hint" : "refused" }, orderWords(m).join(": "))),
        ask: () => this.question(m), stopping: () => this.at && !this.done.has(this.at) && this.note(this.at, "is being stopped"),
      commissioned: () => {
        this.kept = true;
        this.append(el("h2", { className: m.verdict }, `Verdict: ${WORDS[m.verdict].toLowerCase()}`));
        for (const r of [m.passed ? "Commissioned." : `Ended early: ${m.reached}.`, ...m.reasons]) this.append(el("p", {}, r));
        refresh().then(() => {
          const f = state.files.find((x) => x.name === m.report);
          if (f) this.append(link(f));
          $("steps").lastChild.scrollIntoView({ block: "end" });
        }).catch(() => {});
      },
      end: () => {
        this.line?.end();
        this.question({});
        for (const name of Object.keys(this.items)) {
          if (!this.done.has(name)) this.note(name, name === this.at ? "not finished" : "not reached");
        }
        const kept = `Stopped by the operator. The folder ${this.out} and its report keep what was found. `
          + "To go on, start again with another folder: each step is done anew.";
        const why = m.how === "cancelled" && this.kept ? kept : m.why;
        if (why) this.append(el("p", { className: m.how, role: "alert" }, why));
        refresh().catch(() => {});
      },
    }[m.kind];
    how?.();
  }
  append(node, once) { if (!once || !$("steps").querySelector(`.${once}`)) $("steps").append(el("div", { className: once ?? "" }, node)); }
  step(m) {
    this.done.add(m.name);
    const pictures = el("div", { className: "pictures" }, ...m.pictures.map(drawn));
    put(this.item(m.name), el("strong", {}, m.name), " ", el("span", { className: m.passed ? "usable" : "refused" },
      m.passed ? "good enough" : "not good enough"),
      ...m.findings.map((f) => el("div", {}, f)), ...m.cautions.map((f) => el("div", { className: "caution" }, f)),
        ...m.reasons.map((f) => el("div", { className: "refused" }, f)),
      m.parts.length ? el("details", {}, el("summary", {}, "table"), ...parts(m.parts)) : null,
        m.pictures.length ? el("details", { open: !m.passed }, el("summary", {}, `pictures (${m.pictures.length})`), pictures) : null);
  }
  question(m) {  // for who may answer; what was answered elsewhere meanwhile is not answered again
    this.asked = m.what && !this.over ? m : null;
    if (question?.run === this) question.end(null);
    if (this.asked) this.pose(m);
  }
  async pose(m) {
    const yes = await confirmed(`Next step: ${m.what}. The controller will switch its output on; the rotor may move. `
      + "Is the bench clear, and the emergency stop within reach?", "Go", { run: this, focus: false, closes: false });
    if (yes === null || this.asked !== m || this.over) return;
    if (!await this.order(yes ? "go" : "no", { number: m.number })) again();
  }
}
