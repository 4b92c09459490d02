// The live view.
import { Alarms } from "./alarms.js";
import { $, el, feed, LATE_S, put, seconds, shown, SLOTS, state, stem } from "./core.js";
import { job, wrong } from "./files.js";
import { refresh } from "./lists.js";
import { chart, css, fill, Group, ink, line, narrow, orbit, Spectra, strip, waterfall } from "./plot.js";
import { RotorView } from "./rotor.js";
import { orderWords, Watched } from "./run.js";
import { banner, pose, question, stop } from "./stop.js";
import { sections, verdict } from "./tables.js";

function pick(values, a, z, step, of) {
  const found = [];
  for (let k = a; k < z; k += step) {
    const part = values.slice(k, Math.min(z, k + step)).filter((x) => x !== null);
    found.push(part.length ? of(part) : null);
  }
  return found;
}
export class Live extends Watched {
  constructor(run) {
    super(run);
    Object.assign(this, { signals: null, header: null, strips: [], parameters: {}, frozen: false, following: false, marked: null,
      record: null, wanted: run.spec.seconds ?? Infinity });
    this.zoom = null; narrow();
    this.t = []; this.seconds = []; this.low = []; this.high = []; this.lines = []; this.lags = [];
    $("live-view").hidden = false; $("live-hint").hidden = true;
    for (const host of ["strips", "parameters", "error", "spectrum", "orbit", "events"]) $(host).replaceChildren();
    this.alarms = new Alarms(run, $("events"));
    this.group = new Group({ still: () => this.frozen, full: () => [this.t[0] ?? 0, this.t.at(-1) ?? 1],
      zoomed: (range) => { this.zoom = range; this.redraw(); } });
    $("summary").hidden = true;
    for (const host of ["lag", "count", "lost", "tally"]) put($(host));  // nothing of the run before stands as this one's
    freeze(this, false);
    this.unmark();
    this.listen();
    this.draw = this.draw.bind(this);
    requestAnimationFrame(this.draw);
  }
  tell(m) {
    const how = { signals: () => this.begin(m), following: () => { this.following = m.on; }, stopping: () => { this.sampled = Infinity; },
      header: () => this.start(m), line: () => this.take(m), spectrum: () => this.hear(m),
      rotor: () => { this.rotor ??= new RotorView(m); }, orbits: () => this.rotor?.take(m), loop: () => this.rotor?.judge(m),
      event: () => this.event(m.t, m.what, m.why), alarm: () => this.event(m.t, m.what, m.why),
      told: () => m.events.forEach((e) => this.event(e.t, e.what, e.why)), before: () => m.events.forEach((e) => this.tell(e)),
      device: () => this.event(m.sample === null ? null : m.sample / (this.signals?.rate_hz ?? NaN), m.what, m.text),
      note: () => this.event(null, "note", m.text, m.wall), order: () => this.event(null, ...orderWords(m), m.at),
      progress: () => { if (!this.header) { $("state").textContent = m.stage; $("state").className = "badge"; } },
      summary: () => { put($("summary"), ...verdict(m.content), ...sections(m.content)); $("summary").hidden = false; },
      recorded: () => { this.sampled = Infinity; this.record = m.name;
        this.event(null, "record",
        `${m.name}: ${m.samples} samples, ${m.lost} lost${m.fault ? `; the controller tripped: ${m.fault}` : ""}`); },
      end: () => { $("state").textContent = m.how === "done" ? "over" : m.how === "lost" ? "broke off" : m.how;
        $("state").className = `badge ${m.how}`; if (m.why) this.event(null, m.how, m.why); refresh().catch(() => {}); } }[m.kind];
    how?.();
  }
  begin(m) {
    if (this.signals) return;
    this.signals = m;
    this.low = m.names.map(() => []); this.high = m.names.map(() => []);
    const height = innerWidth > 900 ? Math.min(240, Math.max(118, (innerHeight - 140) / m.names.length - 34)) : 118;
    this.strips = m.names.map((name, k) => {
      const made = strip(name, height, [{ name, unit: m.units[k] }], { group: this.group, select: (a, b) => this.mark(a, b),
        limits: () => m.limits?.[name] ?? [], marks: () => this.alarms.marks, hooks: { drawClear: [(u) => this.shade(u)] },
        kind: `smallest and largest of ${seconds(m.group / m.rate_hz)} each` });
      $("strips").append(made.box);
      return made;
    });
    const signals = m.names.map((name, k) => ({ name, unit: m.units[k] })), choice = el("select", { ariaLabel: "signal of the waterfall" },
      ...m.names.map((n, k) => el("option", { value: k, selected: n.endsWith("position") }, n)));
    this.spectra = new Spectra($("spectrum"), signals, { group: new Group({ unit: "Hz", log: true }), turns, height: 130 });
    this.fall = waterfall("Waterfall", 190, { group: new Group(), turns, log: true });
    this.open = el("details", { ontoggle: () => this.drawFall() }, el("summary", {}, "Waterfall of the last two minutes"), choice,
      this.fall.box);
    choice.onchange = () => this.drawFall(); this.fallOf = choice;
    $("spectrum").append(this.open);
    const two = m.names.map((n, k) => [n, k]).filter(([n]) => n.endsWith("position")).slice(0, 2);
    if (two.length > 1 && !this.rotor) {  // a rotor has an orbit in each bearing
      this.ring = orbit(`Orbit, middles of ${seconds(m.group / m.rate_hz)}: what is faster is averaged`, 260);
      this.ringOf = two; $("orbit").append(this.ring.box);
    }
  }
  envelope(data, at) {
    if (!this.signals) return;
    const view = new DataView(data), n = view.getUint32(at + 16, true), channels = view.getUint16(at + 20, true),
      group = view.getUint16(at + 22, true);
    const end = view.getFloat64(at + 24, true), wall = view.getFloat64(at + 32, true), lost = Number(view.getBigUint64(at + 8, true));
    const step = group / this.signals.rate_hz, begin = end - n * step;
    const values = new Float32Array(data.slice(at + 40, at + 40 + 8 * n * channels));
    if (this.t.length && begin - this.t.at(-1) > 1.5 * step) { this.t.push(begin - step / 2);
      for (let c = 0; c < channels; c++) { this.low[c].push(null); this.high[c].push(null); } }
    for (let k = 0; k < n; k++) {
      this.t.push(begin + (k + 0.5) * step);
      for (let c = 0; c < channels; c++) { this.low[c].push(values[2 * (k * channels + c)]);
        this.high[c].push(values[2 * (k * channels + c) + 1]); }
    }
    const most = 130_000;
    if (this.t.length > most) { const cut = this.t.length - 100_000; this.t.splice(0, cut);
      for (const a of [...this.low, ...this.high]) a.splice(0, cut); }
    this.fresh = wall; this.last = performance.now(); this.dirty = true;
    this.sampled = end >= this.wanted - 0.1 ? Infinity : this.last;  // after the last sample none is missed
    this.samples = Number(view.getBigUint64(at, true)) + n * group; this.lost = lost;  // samples that never came
  }
  start(m) {
    if (this.header) return;
    this.header = m;
    for (const [name, v] of Object.entries(m.start)) {
      const made = chart(name, 92, [line("transparent"), line("transparent"), line(ink("--accent"), { width: 1.6 }),
        line(ink("--dim"), { dash: [4, 4] })], m.units[name], { bands: [fill(1, "--accent", "33")], main: 3, group: this.group,
        meaning: m.meanings?.[name] ?? m.meanings?.[name.split(".").at(-1)],  // of a rotor that of every axis
        marks: () => this.alarms.marks, kind: "value; drawn with its 95 % band, dashed the start",
        read: (k) => { const [, low, high, v] = made.plot.data; return shown(v[k], m.units[name], (high[k] - low[k]) / 3.92); } });
      $("parameters").append(made.box);
      this.parameters[name] = { ...made, start: v.value, unit: m.units[name], band: [[], [], []] };
    }
    $("parameters").prepend(el("p", { className: "hint wide" }, SD));
    const error = chart("model error, limit dashed", 92, [line(ink("--accent"), { width: 1.6 }), line(ink("--bad"), { dash: [4, 4] })], "",
      { group: this.group, marks: () => this.alarms.marks, meaning: "How large the errors of the model's predictions are beside what "
        + "it expects: 1 where the model explains the record; above the limit it does not" });
    $("error").append(error.box);
    this.error = error;
    for (const w of m.warnings) this.event(null, "start", w);
  }
  take(m) {
    this.lines.push(m);
    if (this.lines.length > 12_000) this.lines.splice(0, 2000);
    $("state").textContent = m.state; $("state").className = `badge ${m.state}`;
    $("lag").textContent = `lag ${seconds(m.lag_s)}`; $("lag").className = m.lag_s > LATE_S ? "late" : "";
    put($("tally"), `${m.updates} updates, ${m.rejected} samples rejected`,
      m.open ? el("b", { className: "late" }, `, ${m.open} open change${m.open === 1 ? "" : "s"}`) : "");
    this.dirtyLines = true;
    if (question?.run === this) question.draw();
  }
  // What an order would change: old and new values with their intervals, as they are now.
  choice(word) {
    const now = this.lines.at(-1), next = now?.choices[word], half = 1.96,
      value = (name, v) => shown(v?.[0], this.header.units[name], half * v?.[1]);
    question.not = next ? "" : { accept: "A change was found but not its new value: there is nothing to accept.",
      revert: "There are no earlier values to return to." }[word];
    return [el("h2", {}, { accept: "Accept the present estimate?",
      revert: `Go back to the values of ${next ? next.t.toFixed(2) : "?"} s?` }[word]),
      el("p", { className: "hint" }, { accept: "It is in force at once, without waiting for later data. Revert undoes it.",
        revert: "Tracking then holds until you set it to track." }[word], " ± is the 95 % interval."),
      next && el("table", {}, el("thead", {}, el("tr", {}, ...["", "in force", `after ${word}`].map((h) => el("th", {}, h)))),
        el("tbody", {}, ...Object.entries(next.values).map(([name, v]) =>
          el("tr", {}, el("td", {}, name), el("td", { className: "num" }, value(name, now.values[name])),
          el("td", { className: "num" }, value(name, v))))))].filter(Boolean);
  }
  async decide(word) {
    const yes = { accept: "Accept", revert: "Revert" }[word];
    if (await pose(() => this.choice(word), { yes, run: this })) this.order(word,
      word === "revert" ? { goal: this.lines.at(-1).choices.revert?.t } : {});
  }
  event(t, what, why, at) { this.alarms.add(t, what, why, at); }
  mark(a, b) {  // what is dragged over; in a picture that stands still it is shown closer too
    if (!(b - a > 1e-3)) return this.unmark();
    this.marked = [a, b];
    this.frozen ? this.group.to(a, b) : this.redraw();
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
    if (!this.marked || this.zoom?.join() === this.marked.join()) return;
    const [a, b] = this.marked.map((x) => Math.min(Math.max(u.valToPos(x, "x", true), u.bbox.left), u.bbox.left + u.bbox.width));
    u.ctx.fillStyle = css("--doubt") + "44"; u.ctx.fillRect(a, u.bbox.top, b - a, u.bbox.height);
  }
  redraw() { if (this.t.length) { this.drawStrips(...this.window()); if (this.lines.length) this.drawLines(...this.window()); } }
  draw() {
    if (feed !== this) return;
    if (!this.frozen && !stop && !$("live").hidden) {  // nothing is drawn while a stop is on its way
      if (this.dirty) this.drawStrips(...this.window());
      if (this.rotor?.dirty) this.rotor.draw();
      if (this.dirtyLines) this.drawLines(...this.window());
      if (this.spectrum && this.spectra) this.drawSpectrum();
      this.dirty = this.dirtyLines = false;
    }
    requestAnimationFrame(this.draw);
  }
  window() {  // the stretch that is shown: the last one, or further back while the picture is frozen
    if (this.zoom) return this.zoom;
    const span = Number($("span").value), first = this.t[0] ?? 0, last = this.t.at(-1) ?? 0;
    const end = this.frozen ? Math.min(last, first + span + (Number($("back").value) / Number($("back").max)) * Math.max(0,
      last - first - span)) : last;
    return [Math.max(first, end - span), end];
  }
  drawStrips(from, end) {
    let a = this.t.length - 1, z = this.t.length;
    while (a > 0 && this.t[a - 1] >= from) a--;
    while (z > a + 2 && this.t[z - 1] > end) z--;
    const n = z - a, step = Math.max(1, Math.ceil(n / SLOTS));
    const t = step === 1 ? this.t.slice(a, z) : pick(this.t, a, z, step, (x) => x[0]);
    this.strips.forEach((s, k) => {
      if (!this.frozen && !inSight(s.box)) return;
      const low = step === 1 ? this.low[k].slice(a, z) : pick(this.low[k], a, z, step, (x) => Math.min(...x)),
        high = step === 1 ? this.high[k].slice(a, z) : pick(this.high[k], a, z, step, (x) => Math.max(...x));
      s.plot.batch(() => { s.plot.setData([t, low, high], false); s.plot.setScale("x", { min: from, max: Math.max(end, from + 0.1) }); });
      s.say(`${shown(this.low[k].at(-1), this.signals.units[k])} to ${shown(this.high[k].at(-1), this.signals.units[k])}`);
    });
    if (this.ring && this.updates % 4 === 0) this.drawOrbit();
    if (this.frozen) return;
    const left = this.over || this.wanted === Infinity ? "" : `, ${seconds(Math.max(0, this.wanted - end))} left`;
    $("count").textContent = `${end.toFixed(1)} s, ${this.samples} samples${left}`;
    $("lost").textContent = this.lost ? `${this.lost} samples LOST` : "0 lost"; $("lost").className = this.lost ? "late" : "";
    this.lags.push(Date.now() / 1000 - this.fresh); if (this.lags.length > 2000) this.lags.shift();
    this.updates = (this.updates ?? 0) + 1;
  }
  hear(m) {
    this.spectrum = m;
    this.seconds.push({ t: this.t.at(-1) ?? 0, ...m });
    if (this.seconds.length > 120) this.seconds.shift();
  }
  drawSpectrum() {
    const words = `Hann window, resolution ${shown(this.signals.resolution, "Hz")}`;
    this.spectra.show({ ...this.spectrum, words });
    this.spectrum = null;
    this.drawFall();
  }
  drawFall() {
    if (!this.open.open || !this.seconds.length) return;
    const k = Number(this.fallOf.value), { hz } = this.seconds[0], rows = [...hz.keys()].filter((j) => j % 2 === 0 || hz[j] < 100);
    const most = (a, j, n) => rows[n + 1] - j > 1 ? Math.max(a[j], a[j + 1]) : a[j];
    this.fall.group.range = null;
    this.fall.show({ name: this.signals.names[k], unit: this.signals.units[k], hz: rows.map((j) => hz[j]), top: hz.at(-1),
      x: this.seconds.map((s) => s.t), amplitudes: this.seconds.map((s) => rows.map((j, n) => most(s.amplitudes[k], j, n))), turning: null,
      words: `Hann window, resolution ${shown(this.signals.resolution, "Hz")}, over time` });
  }
  drawOrbit() {
    const from = Math.max(0, this.t.length - 400);
    const [x, y] = this.ringOf.map(([, k]) => this.low[k].slice(from).map((v, i) => v === null ? null : (v + this.high[k][from + i]) / 2));
    const whole = x.map((v, i) => i).filter((i) => x[i] !== null && y[i] !== null);
    const unit = this.signals.units[this.ringOf[0][1]];
    this.ring.show(whole.map((i) => x[i]), whole.map((i) => y[i]), { names: this.ringOf.map(([n]) => n), unit });
  }
  drawLines(from, end) {  // over the stretch that the strips show
    const lines = this.lines.filter((l, k) => (this.lines[k + 1] ?? l).t >= from && (this.lines[k - 1] ?? l).t <= end);
    const t = lines.map((l) => l.t), last = lines.at(-1) ?? this.lines.at(-1);
    const set = (plot, data) => plot.batch(() => { plot.setData(data, false);
      plot.setScale("x", { min: from, max: Math.max(end, from + 0.1) }); });
    for (const [name, p] of Object.entries(this.parameters)) {
      const v = lines.map((l) => l.values[name]?.[0] ?? null), s = lines.map((l) => l.values[name]?.[1] ?? null);
      set(p.plot, [t, v.map((x, k) => x === null ? null : x - 1.96 * s[k]), v.map((x, k) => x === null ? null : x + 1.96 * s[k]), v,
        t.map(() => p.start)]);
      const [value, sd, stale] = last.values[name] ?? [];
      p.say(shown(value, p.unit, sd) + (stale ? " (frozen)" : ""));
    }
    if (this.error) set(this.error.plot, [t, lines.map((l) => l.error), t.map(() => this.header.limit)]);
    if (this.error) this.error.say(last.error === null ? "unknown" : last.error.toFixed(2));
  }
}
// A moving strip out of sight is not drawn: of a rotor there are many.
const inSight = (box) => { const at = box.getBoundingClientRect(); return at.bottom > 0 && at.top < innerHeight; };
for (const moved of ["scroll", "resize"]) addEventListener(moved, () => { if (feed?.t?.length) feed.dirty = true; }, { passive: true });
const SD = "± is one standard deviation (sd), bands are 95 %, dashed: the start. A name's meaning shows under the pointer.";
const turns = () => Number($("speed").value) > 0 ? [Number($("speed").value) / 60] : [];  // a second
for (const button of document.querySelectorAll("[data-say]")) {
  const word = button.dataset.say;
  button.onclick = () => ["accept", "revert"].includes(word) ? feed.decide(word) : feed.order(word);
}
function freeze(live, frozen) {
  live.frozen = frozen; live.zoom = null; if (live.group) live.group.range = null;
  $("freeze").setAttribute("aria-pressed", frozen);
  $("freeze").textContent = frozen ? "Go on" : "Freeze";
  $("back").hidden = !frozen;
  $("back").value = $("back").max;
}
$("freeze").onclick = () => freeze(feed, !feed.frozen);
$("speed").value = sessionStorage.speed ?? "";
$("speed").oninput = () => { sessionStorage.speed = $("speed").value; feed?.spectra?.draw(); feed?.drawFall?.(); };
$("back").oninput = $("span").onchange = () => { if (feed?.t) { feed.zoom = feed.group.range = null; feed.redraw(); } };
$("export").onclick = async () => {
  const file = state.files.find((f) => f.name === feed.record);
  if (!file) { banner("The record can be cut when the run is over", "note"); return; }
  const host = el("div");
  $("events").prepend(host);
  const [from_s, to_s] = feed.marked;
  await job({ job: "export", record: file.number, from_s, to_s, out: `${stem(file.name)}-${from_s.toFixed(2)}-${to_s.toFixed(2)}` },
    (m) => m.kind === "exported" && feed.event(null, "exported", `${m.name}, ${m.samples} samples`)).catch(wrong(host));
};
