// Feeds: frames of a run, JSON ("J") and envelopes ("E").
import { ask, OLD_S, PAGE, proven, SILENT_S, START_S } from "./core.js";
import { banner, confirmOff, delivered, lookOld, trouble } from "./stop.js";

export function listen(id, told, envelope = () => {}, gone = () => {}) {
  const decoder = new TextDecoder(), path = `/api/runs/${id}/feed`;
  let socket = null, left = false, ended = false, sign = 0;
  const live = () => { if (socket?.readyState === 1 && performance.now() - sign > 500) { sign = performance.now(); socket.send("here"); } };
  const hear = ({ data }) => {
    live();  // also in a tab behind others, whose timers rest
    if (typeof data === "string") { for (const m of JSON.parse(data)) { ended ||= m.kind === "end"; told(m); } return; }
    const view = new DataView(data);
    for (let at = 0; at + 5 <= data.byteLength;) {
      const length = view.getUint32(at, true), kind = view.getUint8(at + 4);
      if (kind === 69) envelope(data, at + 5);
      else { const m = JSON.parse(decoder.decode(new Uint8Array(data, at + 5, length))); ended ||= m.kind === "end"; told(m); }
      at += 5 + length;
    }
  };
  proven(path).then((address) => {
    if (left) return;
    socket = new WebSocket(`ws://${location.host}${address}&page=${PAGE}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = hear;
    socket.onclose = () => {
      if (ended || left) return;
      gone();
      told({ kind: "end", how: "lost", why: "the run ended without a word, or the console is gone" });
    };
  });
  return { live, close() { left = true; if (socket) { socket.onmessage = null; socket.close(); } } };
}

export const attached = new Set();
// A run that is watched: it is silent where its process is frozen, also while it only waits.
export class Watched {
  constructor(run) {
    Object.assign(this, { id: run.id, job: run.spec.job, alive: run.alive, last: performance.now(), began: false, over: false,
      brokeOff: false, sampled: Infinity, beat: null, holder: run.holder ?? "", you: run.you ?? false });
  }
  listen() {
    this.socket = listen(this.id, (m) => {
      this.last = performance.now(); this.began = true;
      if (m.kind === "beat") this.beat = m.n;
      if (m.kind === "lease") return this.leased(m);
      if (m.kind === "stopping" && this.alive) delivered([this.id]);  // not of a run that is over and shown again
      if (m.kind === "off" && this.alive) confirmOff([this.id]);
      if (m.kind === "end") {
        this.over = true; this.brokeOff = this.alive && m.how === "lost";
        if (this.brokeOff) attached.delete(this.id);
      }
      this.tell(m);
      if (m.kind === "end") lookOld();
    }, (data, at) => this.envelope?.(data, at));
  }
  leased(m) {  // who may order
    if (this.you && m.holder && !m.you) banner(`${m.holder} took over: it orders the run now`, "note");
    this.holder = m.holder; this.you = m.you;
    lookOld();
  }
  order(word, more = {}) {  // with the state that this page has seen last
    return ask(`/api/runs/${this.id}/say`, { word, beat: this.beat, ...more }, 1500)
      .catch((error) => trouble(new Error(`${word}: ${error.message}`)));
  }
  old() {
    const now = performance.now(), silent = (now - this.last) / 1000, dry = (now - this.sampled) / 1000;
    if (this.brokeOff) return "the run broke off. What is shown is not now";
    if (!this.over && this.alive && silent > (this.began ? SILENT_S : START_S)) {
      return `the run has been silent for ${silent.toFixed(0)} s, as if its process were frozen. What is shown is not now`;
    }
    return !this.over && this.alive && dry > OLD_S ? `no sample came for ${dry.toFixed(0)} s. What is shown is not now` : "";
  }
}

export const orderWords = (m) => [m.done ? "order" : "refused",
  `${m.word} at ${new Date(1000 * m.at).toTimeString().slice(0, 8)} by ${m.by || "this machine"}${m.done ? "" : `: ${m.why}`}`];
