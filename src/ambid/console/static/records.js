// What a record holds, and others beside it: signals, spectra, waterfall, orbit. Seen closer, the samples themselves are asked for.
import { el, put, seconds, shown, state } from "./core.js";
import { job, wrong } from "./files.js";
import { colour, Group, orbit, Spectra, strip, waterfall } from "./plot.js";

const picked = (options) => el("select", {}, ...options.map(([value, text]) => el("option", { value }, text)));
export function recordView(file, host, how = {}) {
  const progress = el("div", { className: "looking" }), bar = el("div", { className: "bar" }), strips = el("div"), rest = el("div");
  const shifts = new Map();
  host.append(bar, progress, strips, rest);
  let looks = [], shape = "", asked = 0, timer = 0, drawn = null;
  const later = () => { clearTimeout(timer); timer = setTimeout(load, 250); };
  const time = new Group({ zoomed: later, full: () => looks.length ? ends() : [0, 1] });
  const hz = new Group({ unit: "Hz", log: true, zoomed: later, full: () => [looks[0].rate_hz / looks[0].samples, looks[0].rate_hz / 2] });
  const several = () => looks.length > 1;
  const begin = (l) => several() ? l.whole[0] - (shifts.get(l.record) ?? 0) : 0;  // several are aligned at their starts
  const ends = () => [0, 1].map((k) => (k ? Math.max : Math.min)(...looks.map((l) => l.whole[k] - begin(l))));
  const named = (kind) => state.files.filter((f) => f.kind === kind && f.number !== file.number).map((f) => [f.number, f.name]);
  const rig = picked([["", "none"], ...named("rig")]), other = picked([["", "another record"], ...named("record")]);
  const weights = picked([["Hann", "Hann"], ["flat top", "flat top"]]), [channel, across, up] = [0, 1, 2].map(() => picked([]));
  const mode = picked([["", "one below the other"], ["one", "in one picture"]]), over = picked([["s", "time"], ["rpm", "rotor speed"]]);
  const speed = el("input", { type: "number", min: 0, step: "any", ariaLabel: "speed of the rotor" });
  const label = (text, field) => el("label", {}, `${text} `, field), added = el("span", { className: "bar" });
  bar.append(label("Signals", mode), label("Limits of", rig), label("Beside it", other), added);
  const beside = [];
  other.onchange = () => {
    const f = state.files.find((x) => x.number === Number(other.value));
    if (!f || beside.includes(f)) return;
    const shift = el("input", { type: "number", step: "any", value: 0, ariaLabel: `${f.name} later by` });
    const away = () => { beside.splice(beside.indexOf(f), 1); own.remove(); load(); };
    const own = el("span", {}, `${f.name} later by `, shift, " s ",
      el("button", { type: "button", className: "tool", onclick: away }, "Remove"));
    shift.onchange = () => { shifts.set(f.number, Number(shift.value)); draw(); later(); };
    beside.push(f); added.append(own);
    other.value = ""; time.range = null; load();
  };
  mode.onchange = over.onchange = () => draw();
  speed.oninput = () => { for (const c of [...hz.all(), drawn.fall]) c.plot.redraw(); };
  rig.onchange = weights.onchange = channel.onchange = across.onchange = up.onchange = load;
  const turns = () => speed.value > 0 ? [speed.value / 60] : looks[0]?.turning ?? [];

  async function load() {
    const own = ++asked, found = [];
    try {
      for (const f of [file, ...beside]) {
        const at = looks.find((l) => l.record === f.number), zero = at ? begin(at) : 0;
        const spec = { job: "look", record: f.number, ...(f === file && how), rig: Number(rig.value) || null,
          weights: weights.value, channel: channel.value,
          ...(time.range && at && { from_s: time.range[0] + zero, to_s: time.range[1] + zero }),
          ...(hz.range && { from_hz: hz.range[0], to_hz: hz.range[1] }),
            ...(across.value && up.value && { across: across.value, up: up.value }) };
        await job(spec, (m) => m.kind === "look" && found.push({ ...m, record: f.number, file: f.name }));
      }
    } catch (error) { if (own === asked) wrong(progress)(error); return; }
    if (own === asked) show(found);
  }
  function show(found) {
    looks = found;
    const names = looks[0].channels.map((c) => [c.name, c.name]), of = (c) => looks[0].channels.find((x) => x.name === c.value)?.unit;
    if (!channel.options.length) {
      const first = [looks[0].waterfall.name, ...looks[0].pair];
      for (const [k, field] of [channel, across, up].entries()) {
        put(field, ...(k ? [["", "choose"], ...names] : names).map(([value, text]) => el("option", { value }, text)));
        field.value = first[k] ?? "";
      }
    }
    const mixed = across.value && up.value && of(across) !== of(up);
    put(progress, mixed ? el("p", { className: "caution" }, "The orbit's two signals have different units.") : null);
    draw();
  }
  function draw() {
    const [first] = looks, w = first.waterfall, fast = over.value === "rpm" && w.turning;
    const key = JSON.stringify([mode.value, over.value, looks.map((l) => [l.file, l.channels.map((c) => [c.name, c.unit])])]);
    if (key !== shape) build(key);
    const { lists, spectra, fall, ring } = drawn;
    const of = (s) => `${weights.value} window, resolution ${shown(s.resolution, "Hz")}`
      + (s.seconds ? `, of the last ${seconds(s.seconds)}` : "");
    for (const { made, parts } of lists) {
      const tables = parts.map(([l, c]) => {
        const { t, channels } = looks[l], zero = begin(looks[l]);
        return [t.map((x) => +(x - zero).toFixed(9)), channels[c].low, channels[c].high];
      });
      made.plot.setData(tables.length > 1 ? uPlot.join(tables) : tables[0], false);
      made.fit();
      const all = tables.flatMap(([, low, high]) => [...low, ...high]).filter((v) => v !== null), unit = made.signals[0].unit;
      const reach = [Math.min, Math.max].map((f) => shown(all.reduce((a, b) => f(a, b), all[0]), unit));
      if (made.signals.length === 1 && all.length) made.say(reach.join(" to "));
      made.more.kind = (first.each > 1 ? `smallest and largest of ${first.each} samples each, ` : "samples, ") + looks.map(
        (l) => l.file).join(", ");
    }
    for (const [k, one] of spectra.entries()) {
      one.show({ ...looks[k].spectrum, words: (several() ? `${looks[k].file}, ` : "") + of(looks[k].spectrum) });
    }
    const order = [...w.t.keys()].sort((a, b) => fast ? w.turning[a] - w.turning[b] : a - b);
    const way = fast ? "over speed" : over.value === "rpm" ? "over time: the record has no speed in rad/s or Hz" : "over time";
    fall.group.range = null;
    fall.show({ name: w.name, unit: w.unit, hz: w.hz, top: w.top_hz, x: order.map((k) => fast ? 60 * w.turning[k] : w.t[k]),
      turning: speed.value > 0 || !w.turning ? null : order.map((k) => w.turning[k]), amplitudes: order.map((k) => w.amplitudes[k]),
      words: `${of(w)}, ${way}` });
    ring.box.hidden = !first.orbit;
    if (first.orbit) ring.show(...first.orbit, { names: first.pair, unit: first.channels.find((c) => c.name === first.pair[0]).unit });
  }
  function build(key) {
    shape = key;
    const [first] = looks, one = mode.value !== "", each = [...first.channels.keys()];
    const parts = (c) => looks.flatMap((l, j) => {
      const k = l.channels.findIndex((x) => x.name === first.channels[c].name && x.unit === first.channels[c].unit);
      return k < 0 ? [] : [[j, k]];
    });
    const make = (title, height, of) => ({ parts: of, made: strip(title, height, of.map(([j, k], n) => {
      const { name, unit } = looks[j].channels[k];
      return { name: several() ? looks[j].file + (one ? ` ${name}` : "") : name, unit, colour: colour(n) };
    }), { group: time, limits: () => looks[0].limits[title] ?? [] }) });
    const lists = one ? [make("signals", 260, each.flatMap(parts))] : each.map((c) => make(first.channels[c].name, 110, parts(c)));
    put(strips, ...lists.map((l) => l.made.box), el("p", { className: "hint" },
      "Drag to see a stretch closer, with Shift to move it; a double "
      + "click, or Home, shows all. Click to set the cursors A and B. Spectra and waterfall are of the stretch that is shown."));
    put(rest, el("div", { className: "bar" }, label("Window", weights), label("Speed", speed), "rpm"));
    const spectra = looks.map((l) => new Spectra(rest, l.channels, { group: hz, turns }));
    const fast = over.value === "rpm" && first.waterfall.turning;
    const still = new Group({ zoomed: (r) => time.show(r && r.map((t) => t - begin(looks[0]))) });
    const fall = waterfall("Waterfall", 240, { group: fast ? new Group({ unit: "rpm" }) : still, turns }), ring = orbit("Orbit");
    rest.append(el("div", { className: "bar" }, label("Waterfall of", channel), label("over", over)), fall.box,
      el("div", { className: "bar" }, label("Orbit across", across), label("up", up),
        el("span", { className: "hint" }, `the last ${seconds(3000 / first.rate_hz)} of what is shown`)), ring.box);
    drawn = { lists, spectra, fall, ring };
  }
  return { show: (m) => show([{ ...m, record: file.number, file: file.name }]) };
}
