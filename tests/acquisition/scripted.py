"""A device that does what a test writes down: blocks, silences, losses and faults at chosen samples."""

from dataclasses import dataclass, field

import numpy as np

from ambid.acquisition.device import Column, Counters, DeviceEvent, DeviceInfo, SelfTest
from ambid.errors import DeviceError
from ambid.tracking.blocks import Block, Frame

RATE_HZ = 1000.0
COLUMNS = (Column(name="n", role="extra", unit="1"), Column(name="excited", role="excitation", unit="1"))


@dataclass
class ScriptedDevice:
    """Values are the number of the sample and whether an excitation plays."""

    blocks: int = 100  # that it has before it ends
    size: int = 10
    gaps: dict = field(default_factory=dict)  # block -> samples that never came before it
    fault_at: int | None = None  # number of a sample
    fault_told_at: int | None = None  # block before whose reading the fault is told; default when it happens
    silent_from: int | None = None  # block from which on nothing comes
    pulled_at: int | None = None  # block at which the line is lost
    excited_late: int = 0  # samples until an excitation that was ordered shows
    after_stop: int = 0  # blocks that are still on their way when it is stopped
    told: list = field(default_factory=list)  # what was asked of it
    state: str = "idle"
    ended: bool = False

    def __post_init__(self):
        self.info = DeviceInfo(kind="simulated", port="script", rate_hz=RATE_HZ, columns=COLUMNS)
        self.next, self.block, self.playing, self.ordered = 0, 0, False, 0
        self.waiting, self.news, self.lost, self.pulled = [], [], 0, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.told.append("closed")

    def self_test(self):
        return SelfTest(failed=(), numbers={})

    def start(self, mode):
        self.told.append(f"start {mode}")
        self.state, self.ended = {"sample": "sampling", "drive": "driving"}.get(mode, "levitating"), False

    def arm(self, trial):
        """No law is tried."""
        raise NotImplementedError

    def confirm(self):
        """No law is tried."""
        raise NotImplementedError

    def excite(self, program):
        self.told.append(f"excite at {self.next}")
        self.playing, self.ordered = program is not None, self.next

    def read(self, timeout_s):
        del timeout_s
        if self.waiting or self.state == "idle":
            return self.waiting.pop(0) if self.waiting else None
        if self.pulled_at is not None and self.block >= self.pulled_at:
            self.pulled = True
            raise DeviceError("script: the line is lost. Check the cable")
        if self.silent_from is not None and self.block >= self.silent_from:
            return None
        if self.block >= self.blocks:
            self.state, self.ended = "idle", True
            return None
        return self.made()

    def made(self):
        missing = self.gaps.get(self.block, 0)
        self.lost += missing
        self.next += missing
        n = self.next + np.arange(self.size)
        plays = (n >= self.ordered + self.excited_late) & self.playing
        values = np.column_stack([n, plays]).astype(float)
        frame = Frame(
            block=Block(first=self.next, time_s=self.next / RATE_HZ, values=values), arrived_s=self.next / RATE_HZ
        )
        self.block, self.next = self.block + 1, self.next + self.size
        told = self.block > self.fault_told_at if self.fault_told_at is not None else self.next > (self.fault_at or 0)
        if self.fault_at is not None and told and self.state != "fault":
            self.state, self.playing = "fault", False
            self.news.append(DeviceEvent(kind="fault", sample=self.fault_at, what="over_current"))
        return frame

    def events(self):
        found, self.news = tuple(self.news), []
        return found

    def counters(self):
        return Counters(samples=self.next - self.lost, lost=self.lost)

    def stop(self):
        self.told.append("stop")
        if self.pulled:
            raise DeviceError("script: no answer to stop")
        if self.state not in ("idle", "fault"):
            self.waiting += [self.made() for _ in range(self.after_stop)]
            self.state, self.ended = "idle", True

    def clear(self):
        self.state = "idle"


class Listener:
    """A tap that keeps what it is given."""

    def __init__(self, at=None):
        self.frames, self.at = [], at

    def take(self, frame):
        self.frames.append(frame)
        if self.at is not None and len(self.frames) == self.at:
            raise RuntimeError("the tap broke")

    @property
    def numbers(self):
        return [int(n) for f in self.frames for n in f.block.values[:, 0]]

    @property
    def firsts(self):
        return [f.block.first for f in self.frames]
