// A rotor in the live view: its orbit in each bearing, and the sensitivity of the loop of each axis beside the run.
import { $, el, put, shown } from "./core.js";
import { css } from "./plot.js";

const SIZE = 220, ROOM = 0.86;  // of a picture; of it the largest motion takes
export class RotorView {
  constructor(m) {
    this.said = m;
    this.of = {};
    this.loop = el("div", { id: "loop" });
    put($("orbit"), this.loop, el("div", { className: "orbits" }, ...Object.entries(m.bearings).map(([name, axes]) => {
      const canvas = el("canvas", { role: "img" }), value = el("span"), turning = el("p", { className: "hint" });
      this.of[name] = { axes, canvas, value, turning };
      return el("div", { className: "chart" }, el("h3", {}, `orbit in ${name}`, value), canvas, turning);
    })), el("p", { className: "hint" }, (m.turns ? `Thin: the last ${m.turns} turns at ${m.rpm.toFixed(0)} rpm, the dot is now; ` +
      "thick: what turns with the rotor, of the last second." : "The last 0.1 s; the dot is now.") +
      (m.stop ? ` The rotor touches its stops at ±${shown(m.stop, "m")}.` : "")));
    $("parameters").before($("orbit"));
    $("speed").value = m.rpm ? m.rpm.toFixed(0) : "";
    this.draw();
  }
  take(m) { this.last = m; this.dirty = true; }
  judge(m) {  // the sensitivity of each axis: measured in the run, or what the estimate predicts
    const rows = Object.entries(m.axes).map(([axis, a]) => el("tr", {}, el("td", {}, axis),
      el("td", { className: "num" }, a.half === null ? "unknown" : `${a.db.toFixed(2)} ± ${a.half.toFixed(2)} dB`),
      el("td", { className: "num" }, shown(a.hz, "Hz")),
      el("td", { className: { A: "usable", B: "caution" }[a.worst] ?? "unusable" }, a.zone), el("td", {}, a.source)));
    const predicted = Object.values(m.axes).filter((a) => a.source === "predicted").length;
    put(this.loop, el("h2", {}, "Sensitivity"), rows.length ? el("table", {}, el("thead", {}, el("tr", {},
      ...["axis", "peak", "at", "zone", ""].map((h) => el("th", {}, h)))), el("tbody", {}, ...rows)) : null,
    el("p", { className: "hint" }, rows.length ? `Opened at the position, ISO 14839-3; ± is the 95 % interval; at ${m.t.toFixed(1)} s. ` +
      (predicted === rows.length ? "Predicted: by the estimate, not measured in this run."
        : `Measured at the excited lines of this run${predicted ? "; predicted where the estimate's peak is surely higher" : ""}.`)
      : `No sensitivity can be told at ${m.t.toFixed(1)} s: neither a reference nor the rig says what the controller is, ` +
        "or the loop is not stable with the numbers as they are now."));
  }
  draw() {
    this.dirty = false;
    for (const [name, o] of Object.entries(this.of)) {
      const [x, y] = this.last?.of[name] ?? [[], []], ratio = devicePixelRatio, g = o.canvas.getContext("2d");
      if (o.canvas.width !== SIZE * ratio) o.canvas.width = o.canvas.height = SIZE * ratio;
      g.setTransform(ratio, 0, 0, ratio, 0, 0); g.clearRect(0, 0, SIZE, SIZE);
      const size = x.reduce((a, v, k) => Math.max(a, Math.abs(v), Math.abs(y[k])), 0) || 1e-9;
      const middle = SIZE / 2, at = (v) => ROOM * middle * v / size;
      g.strokeStyle = css("--grid"); g.beginPath();
      g.moveTo(middle, 0); g.lineTo(middle, SIZE); g.moveTo(0, middle); g.lineTo(SIZE, middle); g.stroke();
      if (this.said.stop && at(this.said.stop) < 1.4 * middle) {
        g.strokeStyle = css("--bad"); g.setLineDash([4, 4]); g.beginPath();
        g.arc(middle, middle, at(this.said.stop), 0, 7); g.stroke(); g.setLineDash([]);
      }
      const path = (points, colour, width) => {
        g.strokeStyle = css(colour); g.lineWidth = width; g.beginPath();
        for (const [u, v] of points) g.lineTo(middle + at(u), middle - at(v));
        g.stroke();
      };
      path(x.map((u, k) => [u, y[k]]), "--accent", 1);
      const a = this.last?.turning[name];
      if (a && a.every((v) => v !== null)) {
        const round = Array.from({ length: 73 }, (_, k) => [Math.cos(k * Math.PI / 36), Math.sin(k * Math.PI / 36)]);
        path(round.map(([c, s]) => [a[0] * c - a[1] * s, a[2] * c - a[3] * s]), "--doubt", 2.5);
        const half = Math.hypot(a[0] + a[3], a[1] - a[2]) / 2, back = Math.hypot(a[0] - a[3], a[1] + a[2]) / 2;
        o.turning.textContent = `1×: half axes ${shown(half + back, "m")} and ${shown(Math.abs(half - back), "m")}`;
      }
      g.lineWidth = 1; g.fillStyle = css("--accent");
      if (x.length) { g.beginPath(); g.arc(middle + at(x.at(-1)), middle - at(y.at(-1)), 3, 0, 7); g.fill(); }
      g.fillStyle = css("--dim"); g.font = "11px system-ui";
      g.fillText(`${o.axes[0]} →`, SIZE - 34, middle - 5); g.fillText(`${o.axes[1]} ↑`, middle + 5, 11);
      o.value.textContent = x.length ? `within ±${shown(size, "m")}` : "no samples yet";
      o.canvas.ariaLabel = `orbit in bearing ${name}, ${o.value.textContent} ${o.turning.textContent}`;
    }
  }
}
