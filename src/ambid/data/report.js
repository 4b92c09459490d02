"use strict";
// The page's own script: values under the pointer in pictures, and signals that can be zoomed down to the samples.

(() => {
  const made = (tag, kind, text = "") => {
    const found = document.createElement(tag);
    found.className = kind;
    found.textContent = text; // never markup: names come from files
    return found;
  };
  const numbers = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const digits = (x, n = 6) => {
    const plain = x === 0 || (Math.abs(x) >= 1e-3 && Math.abs(x) < 1e6);
    return (plain ? String(Number(x.toPrecision(n))) : x.toExponential(n - 1).replace(/\.?0*e\+?/, "e")).replaceAll("-", "−");
  };
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  // --- pictures -----------------------------------------------------------------------------------------------------

  const NEAR = 14; // points of a picture between a mark and the pointer
  const MANY = 20; // points from which a line is read at the pointer's abscissa

  function readable(picture) {
    const svg = picture.querySelector("svg");
    const data = JSON.parse(picture.querySelector("script").textContent);
    const arrays = data.arrays.map(numbers);
    const said = made("div", "read");
    said.hidden = true;
    picture.append(said);
    let panel, at; // where the keyboard stands

    const along = (value, [low, high, log]) =>
      log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    const placed = (p, x, y) => [p.box[0] + p.box[2] * along(x, p.x), p.box[1] + p.box[3] * (1 - along(y, p.y))];

    function nearest(p, line, x, y) {
      const [xs, ys] = [arrays[line.x], arrays[line.y]];
      let best = -1, least = Infinity;
      for (let k = 0; k < xs.length; k++) {
        const [a, b] = placed(p, xs[k], ys[k]);
        const far = xs.length > MANY ? Math.abs(a - x) : Math.hypot(a - x, b - y);
        if (far < least) [best, least] = [k, far];
      }
      return least <= NEAR ? { line, x: xs[best], y: ys[best], far: least } : null;
    }

    function read(p, x, y, left, top) {
      let found = p.points.map((line) => nearest(p, line, x, y)).filter(Boolean);
      const marks = found.filter((f) => arrays[f.line.x].length <= MANY);
      if (marks.length) found = [...found.filter((f) => !marks.includes(f)), marks.reduce((a, b) => (b.far < a.far ? b : a))];
      said.hidden = !found.length;
      if (!found.length) return;
      const told = (k, value) => {
        const [, name, unit] = /^(.*?) *(?:\[(.*)\])?$/.exec(p.names[k] || "xy"[k]);
        return `${name} ${digits(value, 4)}${unit ? ` ${unit}` : ""}`;
      };
      const line = (f) => `${f.line.label ? `${f.line.label}: ` : ""}${told(1, f.y)} at ${told(0, f.x)}`;
      said.replaceChildren(...found.map((f) => made("div", "", line(f))));
      said.style.left = `${Math.max(0, Math.min(left + 14, innerWidth - said.offsetWidth - 4))}px`;
      said.style.top = `${top + 14 + said.offsetHeight > innerHeight ? top - said.offsetHeight - 8 : top + 14}px`;
    }

    const toPage = (x, y) => new DOMPoint(x, y).matrixTransform(svg.getScreenCTM());
    const show = (event) => {
      const here = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
      const inside = ({ box }) => here.x >= box[0] && here.x <= box[0] + box[2] && here.y >= box[1] && here.y <= box[1] + box[3];
      const p = data.panels.find(inside);
      if (p) read(p, here.x, here.y, event.clientX, event.clientY);
      else said.hidden = true;
    };
    svg.addEventListener("pointermove", show);
    svg.addEventListener("pointerdown", show);
    svg.addEventListener("pointerleave", () => (said.hidden = true));
    svg.addEventListener("blur", () => (said.hidden = true));
    svg.addEventListener("keydown", (event) => { // through the points, and with up and down through the panels
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], turn = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      if (!step && !turn) return;
      event.preventDefault();
      const count = data.panels.length;
      if (turn || panel === undefined) [panel, at] = [((panel ?? -(turn ?? 1)) + (turn ?? 1) + count) % count, 0];
      const p = data.panels[panel], all = p.points.flatMap((l) => [...arrays[l.x]].map((x, k) => placed(p, x, arrays[l.y][k])));
      const seen = all.filter(([x, y]) => Number.isFinite(x + y)).sort((a, b) => a[0] - b[0]);
      at = Math.min(Math.max(at + (step ?? 0) * Math.max(1, Math.round(seen.length / 200)), 0), seen.length - 1);
      const [x, y] = seen[at], { x: left, y: top } = toPage(x, y);
      read(p, x, y, left, top);
    });
  }

  // --- signals ------------------------------------------------------------------------------------------------------

  const charts = [];

  function zoomable(place) {
    const data = JSON.parse(place.querySelector("script").textContent);
    const arrays = data.arrays.map(numbers);
    const full = data.every === 1;
    const count = Math.ceil(data.samples / data.every);
    const time = Float64Array.from({ length: count }, (_, k) => data.start_s + k * data.every * data.step_s);
    const ends = [time[0], time[count - 1]];
    const own = []; // the charts of this record, which show one time
    let busy = false;

    const values = (line, scale) => {
      const parts = full ? [arrays[line.values]] : [arrays[line.low], arrays[line.high]];
      const less = full && line.less !== null ? arrays[line.less] : null;
      return parts.map((part) => Array.from(part, (x, k) => {
        const y = (less ? x - less[k] : x) / scale;
        return Number.isFinite(y) ? y : null;
      }));
    };

    const head = made("div", "keys");
    const range = made("span", "dim");
    const clamp = (low, high) => {
      const width = Math.min(Math.max(high - low, 4 * data.step_s), ends[1] - ends[0]);
      const first = Math.min(Math.max((low + high - width) / 2, ends[0]), ends[1] - width);
      show(first, first + width);
    };
    const show = (low, high) => {
      busy = true;
      for (const u of own) u.setScale("x", { min: low, max: high });
      busy = false;
      const what = full ? "every sample" : `extremes of ${data.every} samples each`;
      range.textContent = `${digits(low)} s to ${digits(high)} s, ${what}`;
    };
    const by = (factor, shift) => {
      const { min, max } = own[0].scales.x, middle = (min + max) / 2 + shift * (max - min), half = (max - min) / 2 / factor;
      clamp(middle - half, middle + half);
    };
    const close = () => {
      const [first, last] = data.worst.map((k) => data.start_s + k * data.step_s);
      clamp(first, last);
    };
    const moves = {
      whole: ["whole record", "0", () => show(...ends)], close: ["largest errors", "e", close],
      more: ["+", "+", () => by(2, 0)], less: ["−", "-", () => by(0.5, 0)],
      left: ["◀", "ArrowLeft", () => by(1, -0.25)], right: ["▶", "ArrowRight", () => by(1, 0.25)],
    };
    if (data.worst[0] === data.worst[1]) delete moves.close;
    const titles = { more: "zoom in", less: "zoom out", left: "earlier", right: "later" };
    for (const [name, [text, key, move]] of Object.entries(moves)) {
      const button = made("button", "", text);
      button.type = "button";
      button.title = `${titles[name] ?? text} (key ${key})`;
      button.addEventListener("click", move);
      head.append(button);
    }
    head.append(range);
    if (data.title) place.append(made("h3", "", data.title));
    place.append(head);

    const shade = (u) => { // the stretch with the largest errors
      const [first, last] = data.worst.map((k) => u.valToPos(data.start_s + k * data.step_s, "x", true));
      const { left, top, width, height } = u.bbox, from = Math.max(first, left), to = Math.min(last, left + width);
      u.ctx.fillStyle = `${color("bound")}2e`;
      if (to > from) u.ctx.fillRect(from, top, Math.max(to - from, 2), height);
    };

    data.strips.forEach((strip, number) => {
      const said = made("p", "said"), box = made("div", "strip");
      box.tabIndex = 0;
      box.setAttribute("role", "img");
      box.setAttribute("aria-label", `${strip.title} over time; ${moves.close ? "0, e" : "0"}, +, − and arrows zoom`);
      place.append(said, box);
      const series = [{}], columns = [time], bands = [], keys = [];
      for (const line of strip.lines) {
        const first = columns.length;
        columns.push(...values(line, strip.scale));
        const look = { stroke: () => color(line.color), width: 1, auto: line.scaled, points: { size: 4, width: 1 } };
        series.push(...columns.slice(first).map(() => ({ ...look })));
        if (!full) bands.push({ series: [first + 1, first], fill: () => `${color(line.color)}66` });
        keys.push([line, first]);
      }
      if (strip.bound !== null) {
        for (const side of [-strip.bound, strip.bound]) {
          columns.push(new Array(count).fill(side / strip.scale));
          series.push({ stroke: () => color("bound"), width: 1, dash: [5, 4], points: { show: false } });
        }
      }
      const tell = (u) => {
        const k = u.cursor.idx, parts = [made("b", "", `${strip.title} [${strip.unit}]`)];
        if (k !== null && k !== undefined) parts.push(made("span", "dim", `${digits(time[k], 8)} s`));
        for (const [line, first] of keys) {
          const part = made("span", "", line.label), mark = made("i", "");
          const read = (j) => (columns[j][k] === null || columns[j][k] === undefined ? "–" : digits(columns[j][k]));
          if (k !== null && k !== undefined) part.textContent += full ? ` ${read(first)}` : ` ${read(first)} to ${read(first + 1)}`;
          mark.style.background = color(line.color);
          part.prepend(mark);
          parts.push(part);
        }
        if (strip.bound !== null) parts.push(made("span", "dim", `95 % expected within ±${digits(strip.bound / strip.scale, 3)}`));
        said.replaceChildren(...parts);
      };
      const axis = { stroke: () => color("ink"), grid: { stroke: () => color("grid"), width: 1 }, ticks: { stroke: () => color("grid"), width: 1 } };
      const exact = (u, splits) => splits.map((x) => (x === null ? "" : digits(x, 9)));
      const last = number === data.strips.length - 1;
      const u = new uPlot({
        width: place.clientWidth, height: last ? 170 : 140, series, bands, legend: { show: false },
        scales: { x: { time: false } }, cursor: { sync: { key: `s${charts.length - number}` }, drag: { x: true, y: false } },
        axes: [{ ...axis, values: exact, size: last ? 44 : 24, label: last ? "time [s]" : undefined, labelSize: 18 }, { ...axis, values: exact, size: 64, space: 22 }],
        hooks: {
          drawClear: [shade],
          setCursor: [tell], ready: [tell],
          setScale: [(v, key) => { if (key === "x" && !busy && own.includes(v)) show(v.scales.x.min, v.scales.x.max); }],
        },
      }, columns, box);
      box.addEventListener("keydown", (event) => {
        const move = Object.values(moves).find(([, key]) => key === event.key);
        if (!move) return;
        event.preventDefault();
        move[2]();
      });
      own.push(u);
      charts.push(u);
    });
    show(...ends);
    place.parentElement.classList.add("drawn");
    new ResizeObserver(() => {
      for (const u of own) if (place.clientWidth && u.width !== place.clientWidth) u.setSize({ width: place.clientWidth, height: u.height });
    }).observe(place);
  }

  for (const picture of document.querySelectorAll(".picture")) if (picture.querySelector("script")) readable(picture);
  for (const place of document.querySelectorAll(".strips")) zoomable(place);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach((u) => u.redraw(false)));
  const folded = () => [...document.querySelectorAll("details:not([open])")];
  let opened = [];
  addEventListener("beforeprint", () => (opened = folded()).forEach((d) => (d.open = true)));
  addEventListener("afterprint", () => opened.forEach((d) => (d.open = false)));
})();
