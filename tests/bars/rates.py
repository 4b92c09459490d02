"""How much the controller samples and sends without a loss: everything that anybody counts on the way is added up."""

from dataclasses import dataclass, replace

from ambid.acquisition.protocol import table
from ambid.acquisition.scales import PWM_HZ
from tests.bars.host import Host, Refused

COUNTED = ("overruns", "dropped", "rx_errors", "rx_lost")  # by the controller


@dataclass(frozen=True)
class Run:
    """What was counted: samples that came, gaps in their numbers, frames damaged, and what the controller says."""

    rate_hz: float
    state: str
    samples: int
    lost: int
    damaged: int
    resent: int
    controller: dict
    bytes_per_sample: float
    late: int

    @property
    def kept(self):
        """Whether every sample came, and nobody counted anything."""
        counted = (self.lost, self.damaged, self.resent, *(self.controller[c] for c in COUNTED))
        return not any(counted) and self.state in ("sampling", "levitating")

    @property
    def clean(self):
        """Whether a receiver with a buffer of two bytes would have heard every command at once, too."""
        return self.kept and self.late == 0


def stream_of(*names):
    """Return the mask of what a sample carries."""
    return sum(1 << c.bit for c in table().stream if c.name in names)


def at_rate(rig, period):
    """Return a rig whose ticks come each so many periods of the pulse width."""
    return replace(rig, daq=replace(rig.daq, rate_hz=PWM_HZ / period))


def run(rig, folder, *, seconds, stream, period, mode="levitate", commands=0, seed=1):
    """Sample for a time; ``commands``: that many set points a second on top of the pings.

    None where the controller refuses such a run.
    """
    rate_hz = PWM_HZ / period
    told = at_rate(rig, period) if mode == "levitate" else rig
    with Host(told, folder, seed=seed, third=(0.0, 2.0, 2.5)) as host:
        try:
            host.prepare(stream=stream, period=period)
            host.start(table().value("mode", mode))
        except Refused:
            return None
        _listen(host, round(seconds * rate_hz), rate_hz / commands if commands else 0.0)
        status = host.ask("ask_status")
        samples, state = len(host.heard.ticks), host.state
        host.ask("stop")
        seen = host.decoder.counters
    end = host.bench.events("end")[0]
    return Run(
        rate_hz=rate_hz, state=state, samples=samples, lost=host.heard.lost, damaged=seen.damaged, resent=host.resent,
        controller=dict(status.fields), bytes_per_sample=end["to_host"] / samples, late=end["late"],
    )  # fmt: skip


def _listen(host, n, every):
    """Take n samples; each ``every`` samples the set point is sent anew."""
    told = 0.0
    host.until(lambda: host.heard.ticks)
    while len(host.heard.ticks) < n and host.state != "fault":
        if every and len(host.heard.ticks) >= told:
            host.ask("setpoint", setpoint=host.settings.setpoint)
            told += every
        host.samples(max(1, min(round(every) or 400, n - len(host.heard.ticks))))
