// The page of the console: plain JavaScript modules, no build step. All text from files goes in as text, never as HTML.
// Colours: as the machine has them, or as chosen; a cookie, since the port is another one each time.
import { $, feed, show, state } from "./core.js";
import "./fleet.js";
import { refresh } from "./lists.js";
import { recolour } from "./plot.js";
import { watch } from "./start.js";
import { lookOld, stopAll, trouble } from "./stop.js";

const dark = matchMedia("(prefers-color-scheme: dark)");
function colours() {
  document.documentElement.toggleAttribute("data-dark", $("theme").value ? $("theme").value === "dark" : dark.matches);
  recolour();
  feed?.rotor?.draw();
}

$("theme").value = document.cookie.match(/(?:^|; )ambid_colours=(light|dark)/)?.[1] ?? "";
$("theme").onchange = () => {
  document.cookie = `ambid_colours=${$("theme").value}; SameSite=Strict; path=/; max-age=31536000`; colours();
};
dark.addEventListener("change", colours);
colours();
if (["files", "live", "commission", "history", "fleet"].includes(location.hash.slice(1))) show(location.hash.slice(1));
refresh().catch(trouble);
let listing = false;  // one at a time: a browser asks six things of a server at once, and Stop does not queue behind them
setInterval(() => {
  if (document.hidden || listing) return;
  listing = true;
  refresh().catch(() => {}).finally(() => { listing = false; });
}, 2000);
setInterval(lookOld, 250);
// for tests and the curious
window.ambidConsole = { $, refresh, show, stopAll, watch, get feed() { return feed; }, get state() { return state; } };
