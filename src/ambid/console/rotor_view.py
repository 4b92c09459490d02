"""What a live view shows of a rotor beside its signals: its orbit in each bearing, and the sensitivity of each axis."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.acquisition.device import DeviceInfo
from ambid.acquisition.settings import BenchView
from ambid.arrays import Array, Complex
from ambid.console.envelope import rounded
from ambid.console.feed import FeedWriter
from ambid.control.zones import Zone
from ambid.errors import AmbidError
from ambid.estimation.result import NORMAL_95
from ambid.physics.rotor_model import position_role
from ambid.rig import Rig
from ambid.tracking.blocks import Block

_EVERY_S = 0.2  # of samples, between two orbits
_TURNS = 2.0  # that an orbit shows
_STILL_S = 0.1  # of samples that it shows of a rotor at rest
_POINTS = 160  # of an orbit, at most
_WINDOW_S = 1.0  # of samples from which is told what turns with the rotor


class Orbits:
    """Tells the orbits of the last turns in each radial bearing, of samples that the view has shown; and what turns
    with the rotor, by its angle where that is logged, else at the speed of the rig.
    """

    def __init__(self, feed: FeedWriter, rig: Rig, info: DeviceInfo) -> None:
        rotor = rig.rotor
        assert rotor is not None
        self._feed, self._rate_hz, self._told_s = feed, info.rate_hz, -math.inf
        radial = [b for b in rotor.bearings if len(b.axes) == 2]
        roles = [position_role(axis, 0) for b in radial for axis in b.axes]
        self._angle = ["angle"] if any(c.role == "angle" for c in rig.channels) else []
        self._view = BenchView(info, rig, [*roles, *self._angle])
        self._of = {b.name: slice(2 * k, 2 * k + 2) for k, b in enumerate(radial)}
        self._speed, self._sums = rotor.speed, deque[tuple[int, Complex, complex, Array]]()
        turn_s = 2.0 * math.pi / abs(rotor.speed) if rotor.speed else _STILL_S / _TURNS
        self._n = max(8, round(_TURNS * turn_s * info.rate_hz))
        self._recent = np.empty((0, len(roles)))
        low, high = (-math.inf, math.inf) if rig.limits is None else rig.limits.position
        stop = min(high, -low)
        feed.tell(
            "rotor",
            {"bearings": {b.name: list(b.axes) for b in radial}, "rpm": abs(rotor.speed) * 30.0 / math.pi,
             "turns": _TURNS if rotor.speed else 0, "stop": stop if math.isfinite(stop) else None},
            sticky="rotor",
        )  # fmt: skip

    def take(self, rows: Array, end_s: float) -> None:
        """Take rows of the device, (n_samples, n_columns); `end_s`: time after the last of them."""
        try:
            values = self._view.block(Block(first=0, time_s=0.0, values=rows)).values
        except AmbidError:  # outside a calibration: nothing to be drawn
            return
        n = len(values)
        positions = values[:, : self._recent.shape[1]]
        self._recent = np.vstack([self._recent, positions])[-self._n :]
        if self._speed or self._angle:
            at = values[:, -1] if self._angle else self._speed * (end_s - np.arange(n, 0, -1) / self._rate_hz)
            back = np.exp(-1j * at)
            self._sums.append((n, back @ positions, complex(back.sum()), positions.sum(axis=0)))
            while sum(k for k, *_ in self._sums) > _WINDOW_S * self._rate_hz + n:
                self._sums.popleft()
        if end_s - self._told_s < _EVERY_S or len(self._recent) < self._n:
            return
        self._told_s, step = end_s, -(-self._n // _POINTS)
        of = {name: [rounded(x, 4) for x in self._recent[::step, pair].T] for name, pair in self._of.items()}
        a = self._turning()
        turning = {name: rounded(a[pair].view(np.float64), 4) for name, pair in self._of.items() if a.size}
        self._feed.tell("orbits", {"t": round(end_s, 4), "of": of, "turning": turning})

    def _turning(self) -> Complex:
        """Return what turns with the rotor about the mean, whose part in an odd piece of a turn is none of it."""
        if not self._sums:
            return np.empty(0, dtype=np.complex128)
        n, whole, back, rest = (sum(parts) for parts in zip(*self._sums, strict=True))
        return np.asarray(2.0 / n * (whole - back / n * rest))


def loop_content(t: float, sensitivity: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what is shown of the sensitivity of each axis, as an estimate has it, at a time."""
    axes = {}
    for axis, entry in sensitivity.items():
        zone = Zone.read(entry)
        hz = entry["measured_frequency_hz"] if zone.source == "measured" else entry["frequency_hz"]
        axes[axis] = {
            "db": zone.value, "half": NORMAL_95 * zone.sd if math.isfinite(zone.sd) else None, "hz": hz,
            "zone": zone.words, "worst": zone.worst, "source": zone.source,
        }  # fmt: skip
    return {"t": round(t, 2), "axes": axes}
