// Who may order, what is old, questions beside the view, and Stop.
import { $, ask, el, feed, gone, MOVING, put, seconds, state } from "./core.js";

export function banner(text, kind = "") {
  const host = $("banner");
  if (host.dataset.text === text) return;
  host.dataset.text = text; host.className = kind; host.hidden = !text;
  put(host, text, kind || feed?.over ? el("button", { onclick: () => { if (feed) feed.brokeOff = false; banner(""); } }, "Close") : null);
}
// What is shown is not now: the console, the run's process, or the samples are silent. It outdoes every other banner.
export function lookOld() {
  const why = gone ? "the console does not answer. Runs go on; start 'ambid console' again" : feed?.old() ?? "";
  if (why) banner(`OLD: ${why}`);
  else if ($("banner").dataset.text?.startsWith("OLD: ")) banner("");
  const run = feed && !feed.over && !feed.brokeOff ? feed : null;
  run?.socket?.live();
  const other = run?.holder && !run.you ? run.holder : "";
  const not = state.read_only ? "this console is read only" : other ? `${other} has the right to order this run`
    : why && "what is shown is old";
  const tracked = not || (feed?.job !== "live" ? "no live run is shown" : !run ? "the run is over"
    : !feed.following ? "nothing is tracked now" : "");
  for (const button of document.querySelectorAll("[data-say]")) {
    button.disabled = tracked !== ""; button.title = tracked && `Not now: ${tracked}`;
  }
  if (question?.run) { question.old = question.run !== run ? "The run is over." : not && `Not now: ${not}.`; refuse(); }
  const driver = !run ? "" : other ? `${other} orders the run ` : run.you ? "this page orders the run" : "no page orders the run";
  // a button that is replaced cannot be clicked
  if ($("driver").firstChild?.textContent !== driver) put($("driver"), driver,
    other && !state.read_only ? el("button", { onclick: takeOver }, "Take over") : null);
  for (const job of MOVING) $(`${job}-form`).hidden = !!run && run.job === job && run.alive;  // one run at a time
}
addEventListener("silent", lookOld);
export const trouble = (error) => banner(error.message, "note");

// Questions: a panel beside what is shown. Nothing lies over Stop, and the page goes on.
export let question = null;  // the one that is open
// whether it is agreed to; null: another question came
export function pose(content, { yes = "Yes", run = null, focus = true, closes = true } = {}) {
  question?.end(null);
  return new Promise((resolve) => {
    const own = question = { run, closes, old: "", not: "", draw: () => { put($("question"), ...content()); refuse(); },
      end: (answer) => {
        if (question !== own) return;
        question = null; $("ask").hidden = true; document.body.classList.remove("asking");
        resolve(answer);
      } };
    $("yes").textContent = yes;
    own.draw();
    $("ask").hidden = false; document.body.classList.add("asking");
    if (focus) $("no").focus({ preventScroll: true });
    lookOld();
  });
}
function refuse() {  // what cannot be agreed to now
  const why = question.old || question.not;
  $("yes").disabled = why !== ""; $("no").disabled = why !== "" && !question.closes;  // No to a run is an order too
  $("unasked").hidden = why === ""; $("unasked").textContent = why;
}
$("yes").onclick = () => question?.end(true);
$("no").onclick = () => question?.end(false);
export const again = () => !question && feed?.asked && feed.pose(feed.asked);  // what another question had covered
export const confirmed = (text, yes, more = {}) => pose(() => [el("p", {}, text)], { yes, ...more });

async function takeOver() {
  const run = feed;
  if (await confirmed(`${run.holder} orders the run. Take over? It is told so.`, "Take over")) {
    await ask("/api/drive", { run: run.id }).then((m) => run.leased(m)).catch(trouble);
  }
  again();
}

// Stop: of any page, at any time. It says that the run took it, or within a second that it did not; and then that the device has
// confirmed that its output is off.
const DELIVERY_MS = 850, OFF_MS = 2000;
export let stop = null, presses = 0;  // `stop`: the one that is not delivered yet
let halt = null;  // the one whose output is not off yet
function delivery(text, kind) { $("delivery").textContent = text; $("delivery").className = kind; $("delivery").hidden = !text; }
const since = (press) => seconds((performance.now() - press.began) / 1000);
export function delivered(ids) {
  if (!stop) return;
  const own = halt = { ...stop, ids, words: `Stop delivered after ${since(stop)}` };
  clearTimeout(stop.timer); stop = null;
  delivery(`${own.words}: the run ends, the output goes off.`, "good");
  setTimeout(async function look() {
    if (halt !== own) return;
    const { runs } = await ask("/api/state", undefined, 1000).catch(() => ({ runs: [] }));  // also of one that this page does not show
    if (halt !== own) return;
    const those = runs.filter((r) => ids.includes(r.id)), over = those.length && !those.some((r) => r.alive);
    if (those.length && those.every((r) => r.off)) return confirmOff(ids);
    delivery(`The run ${over ? "is over" : "took Stop"}, and its device has not confirmed that its output is off. `
      + "If the rotor still moves, use the emergency stop.", "bad");
    if (!over) setTimeout(look, 1000);
  }, OFF_MS);
}
export function confirmOff(ids) {
  delivered(ids);  // who is off has taken it
  if (!halt) return;
  delivery(`${halt.words}, output off after ${since(halt)}.`, "good");
  halt = null;
}
export function stopAll() {
  presses++;
  if (question && !question.run) question.end(false);  // what is not begun does not begin
  clearTimeout(stop?.timer); halt = null;
  const own = stop = { began: performance.now() };
  const undelivered = (why) => {
    if (stop === own) delivery(`Stop NOT DELIVERED: use the emergency stop. ${why}; it is tried again.`, "bad");
  };
  delivery("Stop: on its way.", "note");
  own.timer = setTimeout(() => undelivered("There is no answer"), DELIVERY_MS);
  (async () => {
    while (stop === own) {
      try {
        const answer = await ask("/api/stop", {}, DELIVERY_MS - 20);
        if (stop !== own) return;
        if (!answer.runs.length) {
          clearTimeout(own.timer); stop = null;
          return delivery("Nothing to stop: no run of this folder moves anything. If something moves, use the emergency stop.", "note");
        }
        if (answer.delivered) return delivered(answer.runs);
        undelivered("The run does not answer");
      } catch (error) { undelivered(error.message[0].toUpperCase() + error.message.slice(1)); }
      await new Promise((done) => setTimeout(done, 1000));
    }
  })();
}
$("stop").addEventListener("pointerdown", (e) => { if (e.button === 0) stopAll(); });
$("stop").addEventListener("click", (e) => { if (e.detail === 0) stopAll(); });  // by a key
let escaped = -Infinity;
addEventListener("keydown", (e) => {
  if (e.ctrlKey && e.key === ".") stopAll();
  if (e.key !== "Escape" || e.repeat) return;
  if (question?.closes) question.end(false);
  if (performance.now() - escaped < 600) stopAll();
  escaped = performance.now();
});
