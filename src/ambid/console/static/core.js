// What every part of the page uses: elements, numbers with their units, asking the server, tabs.
export const $ = (id) => document.getElementById(id);
const hex = (bytes) => Array.from(new Uint8Array(bytes), (b) => b.toString(16).padStart(2, "0")).join("");
export const PAGE = hex(crypto.getRandomValues(new Uint8Array(9)));  // of this load: a tab that is doubled is another page
// The key of the session comes in the fragment of the first address, which no server is sent, and stays in the storage of this port.
const brought = location.hash.match(/^#key=([\w-]+)$/)?.[1];
if (brought) { localStorage.ambidKey = brought; history.replaceState(null, "", "/"); }
const KEY = localStorage.ambidKey ?? "-", bytesOf = (text) => new TextEncoder().encode(text);
const signer = crypto.subtle.importKey("raw", bytesOf(KEY), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
// an address that the browser opens by itself
export const proven = async (path) => `${path}?proof=${hex(await crypto.subtle.sign("HMAC", await signer, bytesOf(path)))}`;
export const MOVING = ["live", "commission"], LATE_S = 0.2, SILENT_S = 1.5, START_S = 15, OLD_S = 2.0, SLOTS = 2000;
export let state = { files: [], runs: [], looks: [] };
export const learn = (now) => { state = now; dispatchEvent(new Event("state")); };
export let feed = null;  // the run that is watched
export const attend = (run) => { feed = run; };

export function el(tag, props = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((c) => c !== null && c !== undefined));
  return made;
}
export const put = (host, ...nodes) => host.replaceChildren(...nodes.filter((n) => n !== null && n !== undefined));

// Numbers with a prefix and digits that their uncertainty carries.
const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];
function prefix(size) {
  return size > 0 ? PREFIXES.find(([p]) => size >= 0.9995 * p) ?? PREFIXES.at(-1) : [1, ""];
}
export function unitOf(unit, size) {
  if (unit === "kg") { const [p, s] = prefix(size * 1e3); return s === "k" ? [1, "kg"] : [p / 1e3, `${s}g`]; }
  if (!unit || unit === "1" || /[²^]/.test(unit)) return [1, unit === "1" ? "" : unit ?? ""];
  const [p, s] = prefix(size);
  return [p, s + unit.replace("ohm", "Ω")];
}
export function shown(value, unit, sd) {
  if (value === null || value === undefined || !isFinite(value)) return "unknown";
  const [p, u] = unitOf(unit, Math.abs(value));
  const v = value / p, s = sd > 0 ? sd / p : 0;
  const digits = s ? Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(s)))) : Math.max(0, 3 - Math.floor(Math.log10(Math.abs(v) || 1)));
  return (s ? `${v.toFixed(digits)} ± ${s.toFixed(digits)}` : v.toFixed(Math.min(9, digits))) + (u ? ` ${u}` : "");
}
export const seconds = (s) => s < 1 ? `${(1000 * s).toFixed(s < 0.01 ? 1 : 0)} ms` : s < 120 ? `${s.toFixed(1)} s`
  : `${(s / 60).toFixed(1)} min`;

// Asking the server.
export async function ask(path, body, patience) {
  const how = body === undefined ? {} : { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } };
  let answer;
  try {
    answer = await fetch(path, { ...how, signal: patience && AbortSignal.timeout(patience),
      headers: { ...how.headers, "x-ambid": PAGE, "x-ambid-key": KEY } });
    gone = false;
  } catch { gone = true; dispatchEvent(new Event("silent")); throw new Error("the console does not answer"); }
  const found = (answer.headers.get("content-type") ?? "").includes("json") ? await answer.json() : { error: (await answer.text()).trim() };
  if (!answer.ok) throw new Error(found.error ?? answer.statusText);
  return found;
}
export let gone = false;  // whether the console itself is silent

export const when = (s) => {
  const d = new Date(1000 * s);
  return d.toDateString() === new Date().toDateString() ? d.toTimeString().slice(0, 8) : d.toISOString().slice(0, 10);
};
export const date = (s, long) => new Date(1000 * s).toISOString().slice(0, long ? 16 : 10).replace("T", " ");
export const stamp = () => new Date().toISOString().slice(0, 19).replace(/[-:]/g, "").replace("T", "-");
export const stem = (name) => name.split("/").pop().replace(/\.(csv|csv\.gz|h5|hdf5|mat|json|toml|html)$/i, "");

export const WORDS = { usable: "Usable", caution: "Use with caution", unusable: "Do not use" };

// Tabs.
export function show(tab) {
  for (const section of document.querySelectorAll(".tab")) section.hidden = section.id !== tab;
  for (const button of $("tabs").children) {
    button.ariaSelected = button.dataset.tab === tab; button.tabIndex = button.dataset.tab === tab ? 0 : -1;
  }
  location.hash = tab;
  dispatchEvent(new Event("resize"));
}
$("tabs").addEventListener("click", (e) => e.target.dataset.tab && show(e.target.dataset.tab));
$("tabs").addEventListener("keydown", (e) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
  if (!step) return;
  const tabs = [...$("tabs").children], at = tabs.indexOf(document.activeElement);
  tabs.at((at + step) % tabs.length).focus();
});
