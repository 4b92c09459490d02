"""Accidents at random moments while the rotor levitates, and how long the firmware takes to its safe state.

All times are of the emulated bench's own clock: that of the accident and that of the falling edge of ENABLE.
"""

from dataclasses import dataclass

import numpy as np

from ambid.acquisition.law_words import WATCH_MS
from ambid.acquisition.protocol import table
from tests.bars.host import Host, tick_times, trajectory

LASTS_S = 0.5  # how long an accident lasts: the host, which is at most some 0.15 s behind, sees it before its end
FROM_S, TO_S = 0.45, 0.75  # when it happens, after the first ENABLE; lift-off counts to 0.3 s
LEVITATES_M = 0.2e-3  # of 1 mm to each side
SILENT = ("host silent", "cable cut, line idle")
HOST_MS = 250


@dataclass(frozen=True)
class Kind:
    """What happens, what ends it, what the firmware shall call it, and how it refuses `clear` meanwhile."""

    begin: str
    end: str
    cause: str
    refused: str = "done"


KINDS = {
    "over-current": Kind("override current {high}", "override current off", "over_current", "state"),
    "over-current, negative": Kind("override current {low}", "override current off", "over_current", "state"),
    "out of gap": Kind("override position {high}", "override position off", "out_of_gap"),
    "out of gap, other side": Kind("override position {low}", "override position off", "out_of_gap"),
    "interlock": Kind("interlock open", "interlock closed", "interlock", "interlock"),
    "cable cut, line held low": Kind("cable cut low", "cable mend", "line_break"),
    "cable cut, line idle": Kind("cable cut", "cable mend", "host_silent"),
    "host silent": Kind("lockstep 0", "force 0", "host_silent"),
}


@dataclass(frozen=True)
class Trip:
    """What became of one accident.

    ``delay_s``: from the accident to ENABLE low; where the host fell silent, what it takes longer than host_ms since
    its last frame. ``wrong``: whatever else is not as it should be.
    """

    kind: str
    moment_s: float
    delay_s: float
    unclear: bool
    wrong: tuple


def trip(kind, rig, folder, rng):
    """Let one accident happen; where a frame of the host was on its way just then, once more."""
    for again in range(3):
        found = _trip(kind, rig, folder / f"{again}", rng)
        if not found.unclear:
            break
    return found


def _trip(kind, rig, folder, rng):
    what, moment = KINDS[kind], rng.uniform(FROM_S, TO_S)
    volts = {"high": f"{rng.uniform(4.75, 5.2):.3f}", "low": f"{rng.uniform(-0.2, 0.25):.3f}"}
    script = [f"+{moment:.7f} {what.begin.format(**volts)}", f"+{moment + LASTS_S:.7f} {what.end}"]
    if kind == "cable cut, line idle":  # nobody to wait for
        script[1:1] = [f"+{moment:.7f} lockstep 0"]
    wrong = []
    with Host(rig, folder, script="\n".join(script), seed=int(rng.integers(1 << 30)), trajectory=True) as host:
        host.ping_by_clock = kind not in SILENT
        host.prepare()
        host.start()
        if kind == "host silent":
            _fall_silent(host, moment)
        host.until(lambda: host.state == "fault")
        acked = None if host.acked_at is None else host.acked_at - 1
        unanswered = bool(host.unanswered)
        host.pings = host.ping_by_clock = True
        wrong += _refuses_clear(host, what)
        wrong += _stays(host, what)
    wrong += _one_edge(host)
    return _judged(kind, host, folder, acked, unanswered, wrong)


def _fall_silent(host, moment):
    """Stop pinging at a random sample, once the bench waits for nobody."""
    begun = round((moment + 0.02) * host.settings.rate_hz)
    host.until(lambda: len(host.heard.ticks) >= begun or host.state == "fault")
    host.pings = False


def _refuses_clear(host, what):
    """`clear` is refused while the cause lasts."""
    if what.refused == "done" or "cable" in what.begin or "lockstep" in what.begin:
        return []
    answer = host.ask("clear", expect=None)
    if _over(host, what):
        return ["the accident was over before `clear` was asked"]
    code = table().name("code", answer["code"])
    return [] if code == what.refused else [f"clear was answered {code!r} while the cause lasted"]


def _over(host, what):
    return any(e["text"].endswith(what.end) for e in host.bench.events("script"))


def _stays(host, what):
    """Frames flow on, the pulse width is that of no voltage, the state is latched until `clear`."""
    host.until(lambda: _over(host, what))
    host.samples(40)
    states, causes = np.array(host.heard.states), np.array(host.heard.causes)
    fault = table().value("state", "fault")
    first = int(np.flatnonzero(states == fault)[0])
    wrong = []
    if not (states[first:] == fault).all():
        wrong.append("the fault did not stay")
    if set(causes[first:].tolist()) != {table().value("cause", what.cause)}:
        wrong.append(f"causes {[table().name('cause', c) for c in set(causes[first:].tolist())]}")
    # Where an interrupt found the accident, the tick under way had ordered its pulse width already.
    duty = host.column("duty")
    if (duty[first + 1 :] != host.settings.fields("limits")["duty_off"]).any():
        wrong.append("the pulse width is not duty_off")
    host.ask("clear")
    status = host.ask("ask_status")
    if table().name("state", status["state"]) != "idle":
        wrong.append("not idle after `clear`")
    return wrong


def _one_edge(host):
    levels = [e["level"] for e in host.bench.events("enable")]
    return [] if levels == [1, 0] else [f"ENABLE went {levels}"]


def _judged(kind, host, folder, acked, unanswered, wrong):
    edges = {e["level"]: e["t"] for e in host.bench.events("enable")}
    happened = host.bench.events("script")[0]["t"]
    rows = trajectory(folder)
    before = rows[(rows[:, 0] > happened - 0.05) & (rows[:, 0] < happened)]
    if not (np.abs(before[:, 1]) < LEVITATES_M).all():
        wrong.append("it did not levitate")
    delay, unclear = edges[0] - happened, False
    if kind in SILENT:
        # ENABLE rises with the tick after tick 0, or after a law has watched.
        watched = 0 if host.settings.law is None else round(1e-3 * WATCH_MS * host.settings.rate_hz)
        last = tick_times(rows, edges[1])[host.heard.ticks[acked] - watched]
        delay = edges[0] - last - 1e-3 * HOST_MS
        unclear = unanswered and delay > 2e-3
    return Trip(kind=kind, moment_s=happened - edges[1], delay_s=delay, unclear=unclear, wrong=tuple(wrong))
