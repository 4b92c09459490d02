// A bearing over time: points with their band, marks where no number is known, events.
import { $, date, el, put, shown, WORDS } from "./core.js";
import { job, wrong } from "./files.js";
import { chart, css, fill, Group, ink, line } from "./plot.js";
import { sections, verdict } from "./tables.js";

const MARKS = { hidden: ["not identifiable", "--dim"], unusable: ["do not use", "--bad"] };
function overTime(name, s, events, group) {
  const known = s.value.map((v, k) => k).filter((k) => s.value[k] !== null),
    mid = known.map((k) => s.half[k] ?? 0).sort((a, b) => a - b)[known.length >> 1];
  const reach = (k) => Math.min(s.half[k] ?? 0, 3 * mid), low = Math.min(...known.map((k) => s.value[k] - reach(k))),
    high = Math.max(...known.map((k) => s.value[k] + reach(k)));
  const room = 0.12 * (high - low) || 0.01 * Math.abs(high) || 1;
  const only = (verdict) => s.value.map((v, k) => s.verdict[k] === verdict ? v : null);
  const dots = (colour) => ({ stroke: ink(colour), paths: () => null, points: { show: true, size: 6, fill: ink(colour) } });
  const band = line("transparent"), say = (k) => s.value[k] === null ? MARKS[s.verdict[k]]?.[0] ?? "unknown"
    : shown(s.value[k], s.unit, s.sd[k]) + (s.verdict[k] === "caution" ? ", with caution" : "");
  const marks = events.map((e) => ({ at: e.at, words: e.parameter === name || e.kind === "rig" ? e.kind : "",
    dash: e.kind === "rig" ? [6, 4] : [],
    colour: e.kind === "rig" ? "--good" : e.parameter === "" || e.parameter === name ? "--doubt" : "--line" }));
  const points = (u) => {
    const g = u.ctx, y = u.bbox.top + 0.95 * u.bbox.height, r = 4 * devicePixelRatio;
    g.save(); g.lineWidth = 1.5 * devicePixelRatio;
    s.value.forEach((v, k) => {
      const x = u.valToPos(s.t[k], "x", true);
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
      g.strokeStyle = css(MARKS[s.verdict[k]]?.[1] ?? (v === null ? "--dim" : s.verdict[k] === "caution" ? "--doubt" : "--accent"));
      g.beginPath();
      if (v !== null) {  // the band of a point that stands alone is this bar
        const ends = [v - s.half[k], v + s.half[k]].map((e) =>
          Math.min(Math.max(u.valToPos(e, "y", true), u.bbox.top), u.bbox.top + u.bbox.height));
        if (known.length <= 40 || ((s.value[k - 1] ?? null) === null && (s.value[k + 1] ?? null) === null)) { g.moveTo(x, ends[0]);
          g.lineTo(x, ends[1]); }
      } else if (s.verdict[k] === "unusable") { g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r);
      g.lineTo(x + r, y - r); } else { g.moveTo(x, y - r); g.lineTo(x, y + r); }
      g.stroke();
    });
    g.restore();
  };
  const days = (u, splits, axis, space, step) => splits.map((t) => date(t, step < 86400));
  const made = chart(name, 170, [band, band, line(ink("--accent")), dots("--accent"), dots("--doubt")], s.unit, {
    group, bands: [fill(1, "--accent", "33")], main: 3, utc: true, scale: { time: true }, meaning: s.meaning, marks: () => marks, read: say,
    scales: { y: { range: known.length ? [low - 1.4 * room, high + room] : [0, 1] } }, xaxis: { space: 120, values: days },
    yaxis: known.length ? {} : { values: () => [] }, hooks: { draw: [points] } });
  const at = known.at(-1), latest = at === undefined ? "never identifiable"
    : `${say(at)}, ${date(s.t[at])}${at < s.t.length - 1 ? `; ${say(s.t.length - 1)} since` : ""}`;
  made.say(latest);
  made.plot.setData([s.t, s.value.map((v, k) => v === null ? null : v - (s.half[k] ?? 0)),
    s.value.map((v, k) => v === null ? null : v + (s.half[k] ?? 0)), s.value, only("usable"), only("caution")], false);
  setTimeout(() => group.show(null));
  return made.box;
}
function showHistory(m, host) {
  const first = m.estimates[0].taken_at, last = m.estimates.at(-1).taken_at, edge = 0.02 * (last - first) || 43200;
  const group = new Group({ utc: true, full: () => [first - edge, last + edge] }), shownOnes = m.estimates.slice(-200).reverse();
  put(host, ...verdict(m.content, { head: `${m.bearing}: ${WORDS[m.content.verdict] ?? m.content.verdict}` }),
    m.left_out
      ? el("p", { className: "caution" },
      `The latest ${m.estimates.length} estimates are drawn; 'ambid history' draws the ${m.left_out} before too.`) : null,
    el("p", { className: "hint" },
      "± is one standard deviation (sd), bands are 95 %. A point with caution is coloured; | not identifiable, × do not use: "
      + "there no number is known. "
      + "Drag over a chart to see it closer, a double click shows all; clicks set two cursors. Times are UTC."),
    el("div", { id: "history-charts" }, ...Object.entries(m.series).map(([name, s]) => overTime(name, s, m.events, group))),
    m.events.length ? el("h2", {}, "Events") : null,
    m.events.length ? el("ol", { className: "scroll", tabIndex: 0 },
      ...m.events.slice(-200).reverse().map((e) => el("li", {},
      `${date(e.at, true)} ${e.kind}: ${e.parameter ? `${e.parameter}: ` : ""}${e.text}`))) : null,
    el("h2", {}, m.estimates.length > 200 ? "The latest 200 estimates" : "Estimates"),
    el("div", { className: "scroll", tabIndex: 0 }, el("table", {},
      el("thead", {}, el("tr", {}, ...["taken", "record", "verdict", "because of"].map((h) => el("th", {}, h)))),
      el("tbody", {}, ...shownOnes.map((e) => el("tr", {}, el("td", {}, date(e.taken_at, true)), el("td", { className: "name" }, e.record),
        el("td", { className: e.verdict }, WORDS[e.verdict] ?? e.verdict), el("td", {}, e.failed.replaceAll(",", ", "))))))),
    el("details", {}, el("summary", {}, "Changes and trends"), ...sections(m.content)));
}
export async function histories() {
  const form = $("history-form").elements, host = $("history-view"), asked = form.bearing.value;
  put(host);
  await job({ job: "history", ledger: Number(form.ledger.value), ...(asked && { bearing: asked }) }, (m) => {
    if (m.kind === "bearings") {
      put(form.bearing, ...m.names.map((n) => el("option", { selected: n === asked }, n)));
      if (!m.names.length) host.append(el("p", { className: "hint" }, "The ledger has no bearing yet."));
      if (m.failures) host.append(el("details", {}, el("summary", {},
        `${m.failures} ${m.failures === 1 ? "record" : "records"} without an estimate`),
        ...m.failed.map((f) => el("p", {}, `${f.record || "a record"} (${f.bearing}): ${f.reason}`))));
    }
    if (m.kind === "history") showHistory(m, host.appendChild(el("div")));
  }).catch(wrong(host));
}
$("history-form").addEventListener("submit", (e) => { e.preventDefault(); histories(); });
$("history-form").elements.bearing.onchange = histories;
$("history-form").elements.ledger.onchange = () => { put($("history-form").elements.bearing); histories(); };
