// Charts: one component for records, live runs and histories. Charts of a group share what is shown of x, and two cursors.
import { date, el, shown, unitOf } from "./core.js";

let palette = {};  // colours are looked up when they are drawn, as the page may turn dark meanwhile
export const css = (name) => palette[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const ink = (name, alpha = "") => () => css(name) + alpha;
export const COLOURS = ["--accent", "--doubt", "--good", "--bad", "--ink", "--dim"];
export const colour = (k) => COLOURS[k % COLOURS.length];
const plots = new Set();
let roomy = 74;  // of all charts, so that their times stand below each other
function room(u, labels) {  // as wide as the longest label: none is cut off
  return roomy = Math.max(roomy, ...(labels ?? []).map((s) => 7 * s.length + 16));
}
export const narrow = () => { roomy = 74; };
export function recolour() {
  palette = {};
  for (const made of plots) made.box.isConnected ? made.plot.redraw() : plots.delete(made);
}
const clip = (x, a, b) => Math.min(Math.max(x, a), b);
const known = (v) => v !== null && v !== undefined;

// What is shown of x, and the cursors A and B, of charts that belong together. `still`: whether it can be zoomed now; `zoomed`: takes
// the range that is asked for, null: all.
export class Group {
  constructor({ still = () => true, zoomed = null, unit = "s", log = false, utc = false, full = null } = {}) {
    Object.assign(this, { still, zoomed, unit, log, utc, range: null, cursors: [null, null], active: 0, charts: new Set() });
    this.full = full ?? (() => { const x = this.all().map((c) => c.plot.data[0]).find((d) => d.length);
      return x ? [x[0], x.at(-1)] : [0, 1]; });
    this.key = `group ${Group.count = (Group.count ?? 0) + 1}`;
  }
  all() { return [...this.charts].filter((c) => c.box.isConnected); }
  shown() { const { min, max } = this.all()[0]?.plot.scales.x ?? {}; return known(min) ? [min, max] : this.full(); }
  show(range) {
    if (!this.still()) return;
    this.range = range;
    for (const made of this.all()) made.fit();
    this.zoomed?.(range);
  }
  to(a, b) {  // a range, kept inside of what there is
    const [first, last] = this.full(), d = this.log ? Math.log10 : (x) => x, e = this.log ? (x) => 10 ** x : (x) => x;
    const width = Math.min(d(b) - d(a), d(last) - d(first)), low = clip(d(a), d(first), d(last) - width);
    if (width > 0) this.show(width >= 0.999 * (d(last) - d(first)) ? null : [e(low), e(low + width)]);
  }
  zoom(factor, at) {
    const [a, b] = this.shown(), m = at ?? (this.log ? Math.sqrt(a * b) : (a + b) / 2);
    this.log ? this.to(m * (a / m) ** factor, m * (b / m) ** factor) : this.to(m - (m - a) * factor, m + (b - m) * factor);
  }
  pan(share) {
    const [a, b] = this.shown();
    this.log ? this.to(a * (b / a) ** share, b * (b / a) ** share) : this.to(a + share * (b - a), b + share * (b - a));
  }
  put(x, which = this.cursors[0] === null ? 0 : this.cursors[1] === null ? 1
    : +(Math.abs(x - this.cursors[1]) < Math.abs(x - this.cursors[0]))) {
    this.active = which; this.cursors[which] = x;
    this.redraw();
  }
  clear() { this.cursors = [null, null]; this.redraw(); }
  redraw() { for (const made of this.all()) { made.plot.redraw(false); made.tell(); } }
  at(x) {
    const [a, b] = this.shown();
    return this.utc ? date(x, true) : this.unit === "s" ? `${x.toFixed(clip(3 - Math.floor(Math.log10(b - a || 1)), 1, 7))} s`
      : shown(x, this.unit);
  }
}

function axes(signals, group, more) {
  const grid = { stroke: ink("--grid"), width: 1 }, units = [...new Set(signals.map((s) => s.unit))];
  const label = (unit) => (u, splits) => {
    const size = Math.max(...splits.map(Math.abs).filter(isFinite), 0), [p, name] = unitOf(unit, size);
    const gap = splits.length > 1 ? Math.abs(splits[1] - splits[0]) : size || 1;
    let digits = 0;  // as many as tell each tick exactly
    while (digits < 9 && splits.some((s) => Math.abs(+(s / p).toFixed(digits) * p - s) > 1e-3 * gap)) digits++;
    return splits.map((s, k) => (s / p).toFixed(digits) + (k === splits.length - 1 && name ? ` ${name}` : ""));
  };
  const x = (u, s) => s.map((v, k) => +v.toPrecision(6) + (k === s.length - 1 && group.unit ? ` ${group.unit}` : ""));
  return [{ stroke: ink("--dim"), grid, ticks: grid, size: 26, values: x, ...(more.xaxis ?? {}) }, ...units.map((unit, k) => {
    const own = signals.filter((s) => s.unit === unit), tint = units.length > 1 && own.length === 1 ? own[0].colour : "--dim";
    return { scale: k ? unit : "y", side: k ? 1 : 3, stroke: ink(tint ?? "--dim"), grid: k ? { show: false } : grid, ticks: grid,
      size: room, space: 15, values: label(unit), ...(more.yaxis ?? {}) };
  })];
}
// `signals`: what is read and written: name, unit, colour, and the numbers of its series, low and high or one alone.
export function chart(title, height, series, unit, more = {}) {
  const group = more.group ?? new Group({ utc: more.utc });
  const signals = more.signals ?? [{ name: title, unit, of: more.main ? [more.main] : more.bands ? [1, 2] : [1] }];
  const units = [...new Set(signals.map((s) => s.unit))], scaleOf = (s) => units.indexOf(s.unit) > 0 ? s.unit : "y";
  for (const s of signals) for (const k of s.of) if (scaleOf(s) !== "y") series[k - 1].scale = scaleOf(s);
  const name = el("span", {}, title), value = el("span", { className: "value" }), read = el("p", { className: "cursors", hidden: true });
  const button = (text, what, act) => el("button", { type: "button", className: "tool", title: what, onclick: act }, text);
  const tools = el("span", { className: "tools" }, ...(more.tools ?? []),
    button("CSV", "What is shown, as a table", () => save(`${name.textContent}.csv`, new Blob([made.table()], { type: "text/csv" }))),
    button("PNG", "The picture", () => picture(made)));
  const names = signals.length > 1 ? el("span", { className: "names" }, ...signals.map((s) => {
    const one = el("b", {}, `${s.name}${s.unit && s.unit !== "1" ? ` [${s.unit}]` : ""}`);
    one.style.color = `var(${s.colour})`;
    return one;
  })) : null;
  const host = el("div", { className: "plot", tabIndex: 0, role: "group",
    ariaLabel: `${title}: plus and minus zoom, arrows move, Home shows all, `
    + "a and b set the cursors, Delete removes them" });
  const box = el("div", { className: "chart" }, el("h3", { title: more.meaning ?? "" }, name, names, value, tools), read, host);
  const opts = { width: 400, height, series: [{}, ...series], bands: more.bands, axes: axes(signals, group, more),
    scales: { x: { time: false, distr: group.log ? 3 : 1, ...(more.scale ?? {}) }, ...(more.scales ?? {}) }, legend: { show: false },
    ...(more.utc ? { padding: [null, 56, null, null], tzDate: (s) => uPlot.tzDate(new Date(1000 * s), "UTC") } : {}),
    cursor: { drag: { x: !more.free, y: false, setScale: false }, y: !!more.free, points: { show: !more.free },
      bind: { dblclick: () => () => { group.cursors = before; group.show(null); group.redraw(); } },
      sync: { key: group.key, filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } } },
    hooks: { ...more.hooks, setSelect: [(u) => {
      if (!u.select.width) return;
      const a = u.posToVal(u.select.left, "x"), b = u.posToVal(u.select.left + u.select.width, "x");
      u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      more.select ? more.select(a, b) : group.to(a, b);
    }], setCursor: [() => made?.tell()], draw: [...(more.hooks?.draw ?? []), (u) => decorate(u, made)] } };
  let before = [null, null], down = 0, made = null;
  const plot = new uPlot(opts, [[], ...series.map(() => [])], host);
  const row = (x) => { const t = plot.data[0]; let k = plot.valToIdx(x); if (t[k] === undefined) k = t.length - 1; return k; };
  const number = (s, k) => {
    const v = s.of.map((j) => plot.data[j][k]);
    return v.every(known) ? v.reduce((a, b) => a + b) / v.length : null;
  };
  const words = (k) => more.read?.(k) ?? signals.map((s) => {
    const v = s.of.map((j) => plot.data[j][k]);
    const text = v.length > 1 && v[0] !== v[1] ? `${shown(v[0], s.unit)} to ${shown(v[1], s.unit)}` : shown(v[0], s.unit);
    return (signals.length > 1 ? `${s.name} ` : "") + text;
  }).join(", ");
  made = { box, plot, value, group, more, signals, title: name, read, scaleOf, latest: "",
    say(text) { made.latest = text; if (!known(plot.cursor.idx) || plot.cursor.left < 0) value.textContent = text; },
    fit() { const [a, b] = group.range ?? group.full(); plot.setScale("x", { min: a, max: b }); },
    tell() {  // at the pointer, and at the cursors
      const { idx, left } = plot.cursor, over = known(idx) && left >= 0 && plot.data[0][idx] !== undefined;
      const near = over ? (more.marks?.() ?? []).find((m) => Math.abs(plot.valToPos(m.at, "x") - left) < 5) : null;
      value.textContent = !over ? made.latest : more.free?.(plot) ?? `${group.at(plot.data[0][idx])}: ${words(idx)}`
        + (near ? `. ${near.words}` : "");
      const set = group.cursors.map((x, k) => x === null || !plot.data[0].length ? null : { x, k: row(x), name: "AB"[k] }).filter(Boolean);
      read.hidden = !set.length || !!more.free;
      if (read.hidden) return;
      const parts = set.map((c) => `${c.name} ${group.at(plot.data[0][c.k])}: ${words(c.k)}`);
      if (set.length > 1) {
        const d = plot.data[0][set[1].k] - plot.data[0][set[0].k],
          turn = group.unit === "s" && !group.utc && d ? ` (1/Δt ${shown(Math.abs(1 / d), "Hz")})` : "";
        const dy = signals.map((s) => {
          const [y, z] = set.map((c) => number(s, c.k));
          return `Δ${signals.length > 1 ? s.name : "y"} ${y === null || z === null ? "unknown" : shown(z - y, s.unit)}`;
        });
        const far = group.utc ? `${(d / 86400).toFixed(2)} days` : shown(d, group.unit);
        parts.push(`Δ${group.unit === "Hz" ? "f" : "t"} ${far}${turn}, ${dy.join(", ")}`);
      }
      read.textContent = parts.join(" · ");
    },
    table() {
      const { min, max } = plot.scales.x, plain = (text) => text.replace(/[,;\t\n[\]"#]/g, " ").trim(), of = (s) => `[${s.unit || "1"}]`;
      const heads = signals.flatMap((s) => s.of.length > 1 ? [`${plain(s.name)} low ${of(s)}`, `${plain(s.name)} high ${of(s)}`]
        : [`${plain(s.name)} ${of(s)}`]);
      const columns = signals.flatMap((s) => s.of.map((j) => plot.data[j]));
      const rows = more.rows?.() ?? [[`${group.unit === "Hz" ? "frequency" : "time"} [${group.utc ? "s" : group.unit}]`, ...heads],
        ...[...plot.data[0].keys()].filter((k) => plot.data[0][k] >= min && plot.data[0][k] <= max)
          .map((k) => [plot.data[0][k], ...columns.map((c) => c[k])])];
      return `# ${name.textContent}${more.kind ? `: ${more.kind}` : ""}\n${rows.map((r) => r.map((v) => v ?? "").join(",")).join("\n")}\n`;
    } };
  group.charts.add(made);
  plot.over.addEventListener("mousedown", (e) => { down = e.clientX; if (e.shiftKey) drag(e, made); }, true);
  plot.over.addEventListener("click", (e) => {
    if (Math.abs(e.clientX - down) > 3 && e.detail === 1 && e.pointerType !== "touch") return;
    if (e.detail < 2) before = [...group.cursors];
    if (!more.free && plot.data[0].length) group.put(plot.data[0][row(plot.posToVal(e.offsetX, "x"))]);
  });
  plot.over.addEventListener("wheel", (e) => {
    if (!(e.ctrlKey || e.shiftKey) || !group.still()) return;
    e.preventDefault();
    e.ctrlKey ? group.zoom(e.deltaY > 0 ? 1.25 : 0.8, plot.posToVal(e.offsetX, "x"))
      : group.pan(((e.deltaY || e.deltaX) > 0 ? 1 : -1) / 10);
  }, { passive: false });
  touches(made);
  host.addEventListener("keydown", (e) => keys(e, made));
  new ResizeObserver(() => host.clientWidth > 50 && Math.abs(host.clientWidth - plot.width) > 1
    && plot.setSize({ width: host.clientWidth, height })).observe(host);
  for (const old of plots) if (!old.box.isConnected) plots.delete(old);
  setTimeout(() => plots.add(made));
  return made;
}
function keys(e, { group, plot }) {
  const x = group.cursors[group.active], right = e.key === "ArrowRight" ? 1 : -1, data = plot.data[0];
  const act = { "+": () => group.zoom(0.5, x), "=": () => group.zoom(0.5, x), "-": () => group.zoom(2, x), Home: () => group.show(null),
    Delete: () => group.clear(), a: () => group.put(middle(), 0), b: () => group.put(middle(), 1), ArrowLeft: move,
      ArrowRight: move }[e.key];
  if (!act || e.ctrlKey || e.altKey || e.metaKey || !data.length) return;
  e.preventDefault();
  act();
  function middle() { const [a, b] = group.shown(); return data[plot.valToIdx(group.log ? Math.sqrt(a * b) : (a + b) / 2)]; }
  function move() {
    if (e.shiftKey || x === null) group.pan(right / 10);
    else group.put(data[clip(plot.valToIdx(x) + right, 0, data.length - 1)], group.active);
  }
}
function drag(e, { group, plot }) {  // moves the picture
  e.stopImmediatePropagation(); e.preventDefault();
  let last = e.clientX;
  const move = (m) => { group.pan((last - m.clientX) / plot.over.clientWidth); last = m.clientX; };
  addEventListener("mousemove", move);
  addEventListener("mouseup", () => removeEventListener("mousemove", move), { once: true });
}
function touches({ group, plot }) {  // one finger moves, two zoom
  const at = new Map(), over = plot.over;
  over.addEventListener("pointerdown", (e) => e.pointerType === "touch" && at.set(e.pointerId, e.clientX));
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) over.addEventListener(end, (e) => at.delete(e.pointerId));
  over.addEventListener("pointermove", (e) => {
    if (!at.has(e.pointerId) || !group.still()) return;
    const before = [...at.values()], was = at.get(e.pointerId);
    at.set(e.pointerId, e.clientX);
    const now = [...at.values()], left = over.getBoundingClientRect().left;
    if (now.length === 1) return group.pan((was - e.clientX) / over.clientWidth);
    const wide = Math.abs(now[0] - now[1]);
    if (wide > 10) group.zoom(Math.abs(before[0] - before[1]) / wide, plot.posToVal((now[0] + now[1]) / 2 - left, "x"));
  });
}
// Limits, events and cursors over the curves.
function decorate(u, made) {
  if (!made) return;
  const g = u.ctx, r = devicePixelRatio, { left, top, width, height } = u.bbox, beyond = { "↑": null, "↓": null };
  g.save(); g.beginPath(); g.rect(left, top, width, height); g.clip(); g.font = `${11 * r}px system-ui, sans-serif`; g.textAlign = "right";
  const say = (l, y, sign) => {
    g.fillStyle = css(l.words === "trip" ? "--bad" : "--doubt");
    g.textBaseline = y > top + 14 * r ? "bottom" : "top";
    inscribed(g, `${sign}${l.words} ${shown(l.at, made.signals[0].unit)}`, left + width - 3 * r, y);
  };
  for (const l of made.more.limits?.() ?? []) {
    const y = u.valToPos(l.at, "y", true), sign = y <= top ? "↑" : "↓";
    if (y <= top || y >= top + height) {  // of those beyond what is shown the next one
      if (!beyond[sign] || Math.abs(l.at) < Math.abs(beyond[sign].at)) beyond[sign] = l;
      continue;
    }
    g.strokeStyle = css(l.words === "trip" ? "--bad" : "--doubt"); g.setLineDash([6 * r, 4 * r]); g.lineWidth = r;
    g.beginPath(); g.moveTo(left, y); g.lineTo(left + width, y); g.stroke(); g.setLineDash([]);
    say(l, y, "");
  }
  if (beyond["↑"]) say(beyond["↑"], top, "↑ ");
  if (beyond["↓"]) say(beyond["↓"], top + height, "↓ ");
  let end = -Infinity;
  for (const m of made.more.marks?.() ?? []) {
    const x = u.valToPos(m.at, "x", true);
    if (x < left || x > left + width) continue;
    upright(u, x, css(m.colour ?? "--doubt"), x > end ? m.words.slice(0, 28) : "", m.dash, made.more.limits ? 14 * r / height : 0);
    if (x > end) end = x + g.measureText(m.words.slice(0, 28)).width + 6 * r;
  }
  if (!made.more.free) made.group.cursors.forEach((x, k) => x !== null
    && upright(u, u.valToPos(x, "x", true), css("--ink"), "AB"[k], [3, 3], 0.85));
  g.restore();
}
export function upright(u, x, tint, text = "", dash = [], low = 0) {
  const g = u.ctx, y = u.bbox.top + low * u.bbox.height;
  g.save(); g.strokeStyle = g.fillStyle = tint; g.lineWidth = devicePixelRatio; g.setLineDash(dash); g.beginPath();
  g.moveTo(x, u.bbox.top); g.lineTo(x, u.bbox.top + u.bbox.height); g.stroke();
  g.textAlign = "left"; g.textBaseline = "top"; g.setLineDash([]); inscribed(g, text, x + 3 * devicePixelRatio, y); g.restore();
}
function inscribed(g, text, x, y) {  // readable over whatever is drawn
  g.save(); g.strokeStyle = css("--card"); g.lineWidth = 4 * devicePixelRatio; g.lineJoin = "round"; g.strokeText(text, x, y); g.restore();
  g.fillText(text, x, y);
}
function save(name, blob) {
  el("a", { href: URL.createObjectURL(blob), download: name.replace(/[^\w.,()+-]+/g, "-") }).click();
}
function picture({ plot, title, value, read }) {
  const source = plot.ctx.canvas, r = devicePixelRatio, top = (read.hidden ? 22 : 40) * r;
  const sheet = el("canvas", { width: source.width, height: source.height + top }), g = sheet.getContext("2d");
  g.fillStyle = css("--card"); g.fillRect(0, 0, sheet.width, sheet.height); g.drawImage(source, 0, top);
  g.fillStyle = css("--ink"); g.font = `${12 * r}px system-ui, sans-serif`;
  g.fillText(`${title.textContent}   ${value.textContent}`, 6 * r, 15 * r, sheet.width - 12 * r);
  if (!read.hidden) g.fillText(read.textContent, 6 * r, 33 * r, sheet.width - 12 * r);
  sheet.toBlob((blob) => save(`${title.textContent}.png`, blob));
}
export const line = (tint, more = {}) => ({ stroke: tint, width: 1.2, points: { show: false }, ...more });
export const band = (name) => [line(ink(name), { width: 1 }), line(ink(name), { width: 1 })];
export const fill = (k, name, alpha = "66") => ({ series: [k + 1, k], fill: ink(name, alpha) });
// Signals as smallest and largest values: one, or several in one picture with an axis for each unit.
export function strip(title, height, signals, more = {}) {
  const each = signals.map((s, k) => ({ colour: colour(k), ...s, of: [2 * k + 1, 2 * k + 2] }));
  return chart(title, height, each.flatMap((s) => band(s.colour)), each[0].unit,
    { bands: each.map((s) => fill(s.of[0], s.colour, each.length > 1 ? "44" : "66")), signals: each, ...more });
}

// Spectra: one chart for each unit; amplitudes are peak or rms values of a sine.
function decades(u, axis, low, high) {
  const a = Math.ceil(Math.log10(low) - 1e-9), z = Math.floor(Math.log10(high) + 1e-9), step = Math.max(1, Math.ceil((z - a) / 6));
  if (high / low < 30) {  // seen closer
    const size = 10 ** Math.floor(Math.log10((high - low) / 3)),
      gap = [1, 2, 5].map((k) => k * size).find((d) => (high - low) / d < 7) ?? 10 * size;
    return Array.from({ length: Math.floor(high / gap) - Math.ceil(low / gap) + 1 },
      (_, k) => +((Math.ceil(low / gap) + k) * gap).toPrecision(9));
  }
  return Array.from({ length: Math.max(0, Math.floor((z - a) / step) + 1) }, (_, k) => 10 ** (a + k * step));
}
const short = (unit) => (v) => { if (v === null) return ""; const [p, name] = unitOf(unit, Math.abs(v) * 1.0001);
  return `${+(v / p).toPrecision(6)}${name ? ` ${name}` : ""}`; };
const ticks = (unit) => ({ splits: decades, filter: (u, s) => s, values: (u, s) => s.map(short(unit)) });
export class Spectra {
  constructor(host, signals, { group, turns, height = 150 }) {
    this.rms = false;
    this.charts = [...new Set(signals.map((s) => s.unit))].map((unit) => {
      const own = signals.map((s, k) => ({ ...s, k })).filter((s) => s.unit === unit).map(
        (s, k) => ({ ...s, colour: colour(k), of: [k + 1] }));
      const kind = el("button", { type: "button", className: "tool", title: "Amplitudes as peak or rms values",
        onclick: () => { this.rms = !this.rms; this.draw(); } });
      const made = chart("", height, own.map((s) => line(ink(s.colour))), unit,
        { group, signals: own, tools: [kind], xaxis: ticks("Hz"), yaxis: ticks(unit),
        scales: { y: { distr: 3, range: (u, a, b) => [Math.max(a, b / 1e6) / 1.5, 1.5 * b] } },
        marks: () => turns().flatMap((hz, j, all) => [1, 2, 3].map(
          (k) => ({ at: k * hz, words: `${k}×${all[1] ? j ? " fastest" : " slowest" : ""}` }))) });
      host.append(made.box);
      return { made, own, kind };
    });
  }
  show(seen) { this.seen = seen; this.draw(); }
  draw() {
    if (!this.seen) return;
    const { hz, amplitudes, words } = this.seen, size = this.rms ? Math.SQRT1_2 : 1;
    for (const { made, own, kind } of this.charts) {
      kind.textContent = this.rms ? "rms" : "peak";
      made.title.textContent = `Spectrum of ${own.length > 1 ? "signals" : own[0].name}, ${kind.textContent}, ${words}`;
      made.plot.setData([hz, ...own.map((s) => amplitudes[s.k].map((v) => v > 0 ? v * size : null))], false);
      made.fit();
      const top = own.map((s) => { const k = amplitudes[s.k].reduce((b, v, j, a) => v > a[b] ? j : b, 0);
        return `${shown(amplitudes[s.k][k] * size, s.unit)} at ${shown(hz[k], "Hz")}`; });
      made.say(own.length > 1 ? "" : `largest ${top[0]}`);
    }
  }
}
// Amplitudes over time, or speed, and frequency.
export function waterfall(title, height, { group, turns, log = false }) {
  let seen = null;
  const tone = (v) => {  // of a share of the colours' range: card, accent, ink
    const of = (name) => [1, 3, 5].map((k) => parseInt(full(css(name)).slice(k, k + 2), 16)),
      [a, b] = v < 0.6 ? [of("--card"), of("--accent")] : [of("--accent"), of("--ink")];
    const w = v < 0.6 ? v / 0.6 : (v - 0.6) / 0.4;
    return `rgb(${a.map((x, k) => Math.round(x + w * (b[k] - x))).join(",")})`;
  };
  const full = (c) => c.length === 4 ? `#${[...c.slice(1)].map((d) => d + d).join("")}` : c;
  const share = (v) => clip(1 + Math.log10(v / seen.most || 1e-9) / 3, 0, 1);
  const cells = (u) => {
    if (!seen?.x.length) return;
    const g = u.ctx, { left, top, width, height: high } = u.bbox, tones = Array.from({ length: 65 }, (_, k) => tone(k / 64)),
      r = devicePixelRatio;
    const ends = (x, key) => { const p = x.map((v) => u.valToPos(v, key, true));
      return p.map((v, k) => [(v + (p[k - 1] ?? 2 * v - (p[k + 1] ?? v))) / 2, (v + (p[k + 1] ?? 2 * v - (p[k - 1] ?? v))) / 2]); };
    const across = ends(seen.x, "x"), up = ends(seen.hz, "y");
    g.save(); g.beginPath(); g.rect(left, top, width, high); g.clip();
    seen.amplitudes.forEach((column, j) => column.forEach((v, k) => {
      const [a, b] = across[j], [y, z] = up[k];
      if (b < left || a > left + width || !(v > 0)) return;
      g.fillStyle = tones[Math.round(64 * share(v))];
      g.fillRect(Math.floor(a), Math.floor(z), Math.ceil(b - a) + 1, Math.ceil(y - z) + 1);
    }));
    g.font = `${11 * r}px system-ui, sans-serif`; g.textAlign = "right"; g.textBaseline = "bottom";
    for (const k of [1, 2, 3]) {  // the speed and its multiples
      const y = seen.x.map((x, j) => u.valToPos(k * (seen.turning?.[j] ?? turns()[0] ?? NaN), "y", true));
      for (const [tint, wide] of [["--card", 4], ["--doubt", 1.5]]) {  // which stands out from every colour
        g.strokeStyle = g.fillStyle = css(tint); g.lineWidth = wide * r; g.beginPath();
        y.forEach((v, j) => isFinite(v) && g.lineTo(u.valToPos(seen.x[j], "x", true), v));
        g.stroke();
      }
      if (isFinite(y.at(-1))) inscribed(g, `${k}×`, left + width - 3 * r, y.at(-1));
    }
    g.restore();
  };
  const read = (u) => {
    if (!seen?.x.length) return "";
    const near = (list, v) => list.reduce((b, x, k) => Math.abs(x - v) < Math.abs(list[b] - v) ? k : b, 0);
    const j = near(seen.x, u.posToVal(u.cursor.left, "x")), k = near(seen.hz, u.posToVal(u.cursor.top, "y"));
    return `${group.at(seen.x[j])}, ${shown(seen.hz[k], "Hz")}: ${shown(seen.amplitudes[j][k], seen.unit)}`;
  };
  const bounds = () => seen ? [seen.hz[0], seen.top] : [1, 2];
  const made = chart(title, height, [{ paths: () => null, points: { show: false } }], "Hz",
    { group, free: read, hooks: { drawClear: [cells] },
    scales: { y: { distr: log ? 3 : 1, range: bounds } }, ...(log ? { yaxis: ticks("Hz") } : {}),
    rows: () => [[`${group.unit === "s" ? "time" : "speed"} [${group.unit}]`, ...seen.hz.map((f) => `${f} Hz [${seen.unit || "1"}]`)],
      ...seen.x.map((x, j) => [x, ...seen.amplitudes[j]]).filter(([x]) => { const [a, b] = group.shown(); return x >= a && x <= b; })] });
  return Object.assign(made, { show(next) {
    seen = { ...next, most: Math.max(...next.amplitudes.flat(), 1e-30) };
    made.plot.setData([seen.x, seen.x.map(() => seen.hz[0])], false);
    made.fit();
    made.title.textContent = `${title} of ${seen.name}, peak, ${seen.words}`;
    made.say(`${shown(seen.most / 1e3, seen.unit)} to ${shown(seen.most, seen.unit)}, logarithmic`);
  } });
}
// Two axes over each other, with equal scales.
export function orbit(title, height = 300) {
  let x = [], y = [], unit = "m";
  const group = new Group({ unit: "", full: () => reach() });
  const reach = () => { const [w, h] = [made.plot.bbox.width, made.plot.bbox.height], size = half() * Math.max(1, w / h);
    return [centre(x) - size, centre(x) + size]; };
  const span = (v) => v.length ? [v.reduce((a, b) => Math.min(a, b)), v.reduce((a, b) => Math.max(a, b))] : [-1, 1];
  const centre = (v) => { const [a, b] = span(v); return (a + b) / 2; };
  const half = () => 0.55 * Math.max(...[x, y].map((v) => span(v)[1] - span(v)[0]), 1e-12);
  const path = (u) => {
    const g = u.ctx;
    g.save(); g.beginPath(); g.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height); g.clip();
    g.strokeStyle = css("--accent"); g.lineWidth = devicePixelRatio; g.beginPath();
    x.forEach((v, k) => g.lineTo(u.valToPos(v, "x", true), u.valToPos(y[k], "y", true)));
    g.stroke(); g.restore();
  };
  const made = chart(title, height, [{ paths: () => null, points: { show: false } }], "m",
    { group, hooks: { draw: [path] }, scales: { x: { auto: false }, y: { auto: false } },
    xaxis: { values: (u, s) => s.map((v, k) => k % 2 ? "" : short(unit)(+v.toPrecision(4))) },
      yaxis: { values: (u, s) => s.map((v) => short(unit)(+v.toPrecision(4))) },
    free: (u) => `${shown(u.posToVal(u.cursor.left, "x"), unit)}, ${shown(u.posToVal(u.cursor.top, "y"), unit)}`,
    rows: () => [made.names.map((n) => `${n} [${unit}]`), ...x.map((v, k) => [v, y[k]])] });
  const fit = () => {
    const { width: w, height: h } = made.plot.bbox, [a, b] = group.range ?? reach(), tall = (b - a) * h / w;
    if (!(w > 0)) return;
    made.plot.batch(() => { made.plot.setScale("x", { min: a, max: b });
      made.plot.setScale("y", { min: centre(y) - tall / 2, max: centre(y) + tall / 2 }); });
  };
  new ResizeObserver(() => setTimeout(fit)).observe(made.box);
  return Object.assign(made, { fit, names: ["x", "y"], show(across, up, more = {}) {
    x = across; y = up; unit = more.unit ?? "m"; made.names = more.names ?? made.names;
    made.plot.setData([span(x), span(y)], false);
    fit();
    made.say(`${made.names.join(" across, ")} up; ${shown(span(x)[1] - span(x)[0], unit)} by ${shown(span(y)[1] - span(y)[0], unit)}`);
  } });
}
