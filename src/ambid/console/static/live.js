// The live view.
import { $, el, feed, LATE_S, put, seconds, shown, SLOTS, state, stem } from "./core.js";
import { job, wrong } from "./files.js";
import { refresh } from "./lists.js";
import { BAND, chart, css, ink, line, narrow, pick, upright } from "./plot.js";
import { orderWords, Watched } from "./run.js";
import { banner, pose, question, stop } from "./stop.js";
import { sections, verdict } from "./tables.js";

const COLOURS = ["--accent", "--doubt", "--good", "--bad"];
function decades(u, axis, low, high) {
  const a = Math.ceil(Math.log10(low) - 1e-9), z = Math.floor(Math.log10(high) + 1e-9), step = Math.max(1, Math.ceil((z - a) / 5));
  return Array.from({ length: Math.max(0, Math.floor((z - a) / step) + 1) }, (_, k) => 10 ** (a + k * step));
}
export class Live extends Watched {
  constructor(run) {
    super(run);
    Object.assign(this, { signals: null, header: null, strips: [], parameters: {}, frozen: false, following: false, marked: null,
      record: null, wanted: run.spec.seconds ?? Infinity });
    this.zoom = null; narrow();
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
    const how = { signals: () => this.begin(m), following: () => { this.following = m.on; }, stopping: () => { this.sampled = Infinity; },
      header: () => this.start(m), line: () => this.take(m), spectrum: () => { this.spectrum = m; },
      event: () => { this.heard = true; this.event(m.t, m.what, m.why); }, told: () => this.before(m),
        device: () => this.event(null, m.what, m.text), note: () => this.event(null, "note", m.text),
        order: () => this.event(null, ...orderWords(m)),
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
      const made = chart(name, height, BAND(), m.units[k], { bands: [{ series: [2, 1], fill: ink("--accent", "66") }],
        hooks: { setSelect: [(u) => this.mark(u)], drawClear: [(u) => this.shade(u)] } });
      made.plot.over.addEventListener("dblclick", () => { this.zoom = null; this.redraw(); });
      $("strips").append(made.box);
      return made;
    });
    const made = chart("spectrum", 140, m.names.map((_, k) => line(ink(COLOURS[k % 4]))), "",
      { scale: { distr: 3 }, scales: { y: { distr: 3 } }, hooks: { draw: [turns] },
      x: (u, s) => s.map((v) => v === null ? null : Math.abs(Math.log10(v) % 1) < 1e-6 ? (v >= 1000 ? `${v / 1000} kHz` : `${v} Hz`) : ""),
      yaxis: { splits: decades, values: (u, s) => s.map((v) => v === 1 ? "1" : v?.toExponential(0) ?? "") } });
    put(made.box.querySelector("h3"), "spectrum, peak", el("span", { className: "names" },
      ...m.names.map((n, k) => { const name = el("b", {}, ` ${n} [${m.units[k]}]`); name.style.color = `var(${COLOURS[k % 4]})`;
      return name; })));
    $("spectrum").append(made.box);
    this.lines4 = made;
    const two = m.names.map((n, k) => [n, k]).filter(([n]) => n.endsWith("position"));
    if (two.length > 1) this.orbitOf = two.slice(0, 2).map(([, k]) => k);
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
        line(ink("--dim"), { dash: [4, 4] })], m.units[name], { bands: [{ series: [2, 1], fill: ink("--accent", "33") }] });
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
  event(t, what, why) {
    $("events").prepend(el("li", { className: what === "change" || what === "fault" ? "refused" : "" },
      `${t === null || t === undefined ? "" : `${t.toFixed(2)} s `}${what}: ${why}`));
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
      const low = step === 1 ? this.low[k].slice(a, z) : pick(this.low[k], a, z, step, (x) => Math.min(...x)),
        high = step === 1 ? this.high[k].slice(a, z) : pick(this.high[k], a, z, step, (x) => Math.max(...x));
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
    const [x, y] = this.orbitOf.map((k) => this.low[k].slice(Math.max(a, this.t.length - 400)).map(
      (v, i) => (v + this.high[k][Math.max(a, this.t.length - 400) + i]) / 2));
    const canvas = $("orbit").firstChild ?? $("orbit").appendChild(el("canvas", { width: 240, height: 240 })), g = canvas.getContext("2d");
    const size = Math.max(...x.map(Math.abs), ...y.map(Math.abs), 1e-12);
    g.clearRect(0, 0, 240, 240); g.strokeStyle = css("--accent"); g.beginPath();
    x.forEach((v, k) => g.lineTo(120 + 110 * v / size, 120 - 110 * y[k] / size)); g.stroke();
    g.fillStyle = css("--dim"); g.fillText(`orbit, ±${shown(size, "m")}`, 6, 12);
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
  await job({ job: "export", record: file.number, from_s, to_s, out: `${stem(file.name)}-${from_s.toFixed(2)}-${to_s.toFixed(2)}` },
    (m) => m.kind === "exported" && feed.event(null, "exported", `${m.name}, ${m.samples} samples`)).catch(wrong(host));
};
