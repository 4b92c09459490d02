// Charts.
import { el, shown, unitOf } from "./core.js";

let palette = {};  // colours are looked up when they are drawn, as the page may turn dark meanwhile
export const css = (name) => palette[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const ink = (name, alpha = "") => () => css(name) + alpha;
const plots = new Set();
let roomy = 74;  // of all charts, so that their times stand below each other
export function room(u, labels) {  // as wide as the longest label: none is cut off
  return roomy = Math.max(roomy, ...(labels ?? []).map((s) => 7 * s.length + 16));
}
export const narrow = () => { roomy = 74; };
export function recolour() {
  palette = {};
  for (const made of plots) made.box.isConnected ? made.plot.redraw() : plots.delete(made);
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
  return [{ stroke: ink("--dim"), grid, ticks: grid, size: 26,
    values: more.x ?? ((u, s) => s.map((v, k) => +v.toPrecision(6) + (k === s.length - 1 ? " s" : ""))) , ...(more.xaxis ?? {}) },
          { stroke: ink("--dim"), grid, ticks: grid, size: room, space: 15, values: label, ...(more.yaxis ?? {}) }];
}
export function chart(title, height, series, unit, more = {}) {
  const value = el("span"), host = el("div"), box = el("div", { className: "chart" }, el("h3", {}, title, value), host);
  const opts = { width: 400, height, series: [{}, ...series], bands: more.bands, axes: axes(unit, more),
    scales: { x: { time: false, ...(more.scale ?? {}) }, ...(more.scales ?? {}) },
    ...(more.utc ? { padding: [null, 56, null, null], tzDate: (s) => uPlot.tzDate(new Date(1000 * s), "UTC") } : {}),
    cursor: { drag: { x: true, y: false, setScale: more.zoom ?? false }, y: false }, legend: { show: false }, hooks: more.hooks ?? {} };
  const plot = new uPlot(opts, [[], ...series.map(() => [])], host);
  new ResizeObserver(() => host.clientWidth > 50 && Math.abs(host.clientWidth - plot.width) > 1
    && plot.setSize({ width: host.clientWidth, height })).observe(host);
  const made = { box, plot, value };
  for (const old of plots) if (!old.box.isConnected) plots.delete(old);
  setTimeout(() => plots.add(made));
  return made;
}
export const line = (color, more = {}) => ({ stroke: color, width: 1.2, points: { show: false }, ...more });
export const BAND = () => [line(ink("--accent"), { width: 1 }), line(ink("--accent"), { width: 1 })];
export function strip(title, t, low, high, height = 110, unit = title.match(/\[(.*)\]/)?.[1] ?? "") {
  const made = chart(title, height, BAND(), unit, { bands: [{ series: [2, 1], fill: ink("--accent", "66") }], zoom: true });
  made.plot.setData([t, low, high]);
  const known = [...low, ...high].filter((v) => v !== null);
  if (known.length) made.value.textContent = `${shown(known.reduce((a, b) => Math.min(a, b)), unit)} to ${shown(
    known.reduce((a, b) => Math.max(a, b)), unit)}`;
  return made;
}

export function upright(u, x, colour, text = "", dash = []) {
  const g = u.ctx;
  g.save(); g.strokeStyle = g.fillStyle = colour; g.lineWidth = devicePixelRatio; g.setLineDash(dash); g.beginPath();
  g.moveTo(x, u.bbox.top); g.lineTo(x, u.bbox.top + u.bbox.height); g.stroke();
  g.textAlign = "left"; g.textBaseline = "top"; g.fillText(text, x + 3 * devicePixelRatio, u.bbox.top); g.restore();
}
export function pick(values, a, z, step, of) {
  const found = [];
  for (let k = a; k < z; k += step) { const part = values.slice(k, Math.min(z, k + step)).filter((x) => x !== null);
    found.push(part.length ? of(part) : null); }
  return found;
}
