"""Random bytes, mutated frames and sound frames of senseless commands, fed to the running firmware while it levitates.

What it should have counted is known: the host's own decoder reads the same bytes.
"""

from dataclasses import dataclass

import numpy as np

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import FrameDecoder, encode, message
from tests.bars.host import Host, trajectory

CHUNK = 200  # bytes at once: 2 ms of the line
NAMES = tuple(m.name for m in table().messages.values() if m.to == "controller")
SHAPE = ("id", "offset", "kind", "mode", "on")


@dataclass(frozen=True)
class Survived:
    """What became of one attack.

    ``counted``, ``expected``: damaged frames by the controller, and by the host's decoder on the same bytes.
    ``carried_out``: sound frames among them; ``faults``: falls of ENABLE; ``answered``: the next sound command was;
    ``duty``: least and largest real pulse width while ENABLE was high; ``largest_m``: from the middle, between
    lift-off and the first time that ENABLE fell.
    """

    sent: int
    counted: int
    expected: int
    carried_out: int
    rx_lost: int
    faults: tuple
    answered: bool
    state: str
    resets: int
    limits: tuple
    duty: tuple
    largest_m: float

    @property
    def wrong(self):
        """Say what is not as it should be."""
        found = []
        if abs(self.counted - self.expected) > self.rx_lost:  # a byte that was lost may join two runs
            found.append(f"{self.counted} damaged frames counted, {self.expected} sent")
        if not self.answered:
            found.append("the next sound command was not answered")
        if self.resets:
            found.append(f"{self.resets} resets")
        if not self.limits[0] <= self.duty[0] <= self.duty[1] <= self.limits[1]:
            found.append(f"pulse width {self.duty} outside {self.limits}")
        return tuple(found)


class Attacker(Host):
    """A host that also sends damage; all bytes since `begin` go through a decoder of its own."""

    def begin(self):
        """Count from here."""
        self.samples(1000)  # levitates
        self.before = self.ask("ask_status")
        self.twin, self.n_sent, self.sound = FrameDecoder("controller"), 0, 0
        write = self.port.write

        def watched(data):
            self.n_sent += len(data)
            self.sound += len(self.twin.feed(data))
            write(data)

        self.port.write = watched

    def ping(self):
        if hasattr(self, "twin"):
            self.port.write(b"\0")  # whatever came before ends here
        super().ping()

    def drain(self):
        """Wait until the controller has taken all that was sent; a sign of life is answered behind it."""
        self.port.write(b"\0")
        return self.ask("ask_status")

    def lift(self):
        """Levitate again after whatever happened."""
        status = self.drain()
        state = table().name("state", status["state"])
        if state == "levitating":
            return
        self.ask("clear" if state == "fault" else "stop")
        self.ask("configure", **self.settings.fields("configure"))
        self.ask("limits", **self.settings.fields("limits"))
        self.ask("gains", **self.settings.fields("gains"))
        self.start()


def random_bytes(rig, folder, rng, n, *, pings=True):
    """Feed n random bytes; without pings it is silent beside them."""
    with Attacker(rig, folder, seed=int(rng.integers(1 << 30)), trajectory=True) as host:
        host.prepare()
        host.start()
        host.begin()
        host.pings = pings
        for at in range(0, n, CHUNK):
            host.port.write(rng.integers(0, 256, min(CHUNK, n - at), dtype=np.uint8).tobytes())
            host.pump()
        return _survived(host, folder)


def mutated(rig, folder, rng, n):
    """Feed n frames of sound commands, each turned, cut, lengthened or doubled somewhere."""
    with Attacker(rig, folder, seed=int(rng.integers(1 << 30)), trajectory=True) as host:
        host.prepare()
        host.start()
        host.begin()
        tail = b""  # of the last one, after its last 0x00: two halves may make a whole
        for k in range(n):
            body = _mutant(rng, encode(_any_command(rng, 1 + k % 255)), tail)
            host.port.write(body)
            tail = (tail + body).rpartition(b"\0")[2]
            host.pump()  # after each: emulated time goes on for 0.1 s with each byte from the host
        return _survived(host, folder)


def senseless(rig, folder, rng, n):
    """Feed n sound frames of commands whose fields are random; lift the rotor again where one lets it down."""
    with Attacker(rig, folder, seed=int(rng.integers(1 << 30)), trajectory=True) as host:
        host.prepare()
        host.start()
        host.begin()
        for _ in range(n):
            asked = _any_command(rng, 1)
            fields = {k: v for k, v in asked.fields.items() if k != "id"}
            if asked.name == "gains" and rng.random() < 0.7:  # some that are taken, most of which let the rotor down
                fields = {
                    k: max(0, round(v * rng.uniform(-0.2, 1.5))) for k, v in host.settings.fields("gains").items()
                }
            host.ask(asked.name, expect=None, values=asked.values, **fields)
            host.lift()
        return _survived(host, folder)


def _any_command(rng, number):
    kind = table().messages[str(rng.choice(NAMES))]
    fields = {f.name: int(rng.integers(f.span[0], f.span[1], endpoint=True)) for f in kind.fixed}
    if rng.random() < 0.5:  # else most are refused by their first field
        fields |= {k: int(rng.integers(0, 4)) for k in fields if k in SHAPE}
    values = rng.integers(-127, 128, int(rng.integers(1, 48 // kind.tail.width + 1))).tolist() if kind.tail else ()
    return message(kind.name, values=values, **(fields | {"id": number}))


def _mutant(rng, data, tail):
    """Damage a frame; one that is sound all the same, alone or with what came before, is no damage."""
    while True:
        body = _turned(rng, data)
        if not any(FrameDecoder("controller").feed(before + body + b"\0") for before in (b"\0", tail)):
            return body


def _turned(rng, data):
    body, at = bytearray(data), int(rng.integers(len(data)))
    match int(rng.integers(5)):
        case 0:
            body[at] ^= 1 << int(rng.integers(8))
        case 1:
            del body[at]
        case 2:
            body.insert(at, int(rng.integers(256)))
        case 3:
            del body[at:]
        case _:
            body[at:at] = body[: int(rng.integers(len(body)))]
    return bytes(body)


def _survived(host, folder):
    host.pings = True
    status = host.drain()
    again = host.ask("ask_status")
    if table().name("state", again["state"]) != "idle":
        host.samples(20)
    counters, state = host.twin.counters, table().name("state", again["state"])
    told = [m["cause"] for m in host.told if m.name == "fault"]
    expected, sent, sound = counters.damaged, host.n_sent, host.sound
    host.ask("stop")
    host.__exit__()
    rows = trajectory(folder)
    edges = [e["t"] for e in host.bench.events("enable")]
    duty, t = rows[:, 5], rows[:, 0]
    aloft = rows[(t > edges[0] + 0.45) & (t < edges[1])]
    limits = host.settings.fields("limits")
    return Survived(
        sent=sent, counted=status["rx_errors"] - host.before["rx_errors"], expected=expected,
        carried_out=sound, rx_lost=status["rx_lost"] - host.before["rx_lost"],
        faults=tuple(table().name("cause", c) for c in told), answered=again.name == "status", state=state,
        resets=len(host.bench.events("reset")), limits=(limits["duty_low"], limits["duty_high"]),
        duty=(int(duty[duty > 0].min()), int(duty.max())), largest_m=float(np.abs(aloft[:, 1]).max()),
    )  # fmt: skip
