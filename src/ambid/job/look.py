"""Short looks at a bench: a course is run and kept in memory, seen through the rig, with the room that it may use."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ambid.acquire.causes import fault_words
from ambid.acquire.default_daq import with_default_daq
from ambid.acquire.device import Device
from ambid.acquire.scales import scale_of
from ambid.acquire.session import Course, RunReport, run
from ambid.acquire.view import BenchView
from ambid.arrays import Array
from ambid.physics.models import model
from ambid.rig import Rig
from ambid.track.blocks import Frame


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Where a bench may work, SI."""

    # of position and current, those of them that the bench has: the controller's limits
    trips: Mapping[str, tuple[float, float]]
    voltage: tuple[float, float]  # that may be ordered: inside the limits of the loop and ``daq.duty``

    @classmethod
    def of(cls, rig: Rig) -> Room:
        """Take it from a rig.

        `rig`: with ``[daq]``. Returns infinite where the rig knows no limit.
        """
        unlimited = (-math.inf, math.inf)
        roles = [role for role in ("position", "current") if role in model(rig.model).outputs]
        trips: dict[str, tuple[float, float]] = {role: rig.trip(role) or unlimited for role in roles}
        return cls(
            trips=MappingProxyType(trips), voltage=_ordered(rig, rig.limits.voltage if rig.limits else unlimited)
        )

    def used(self, role: str, values: Array, rest: float) -> float:
        """Return which part of the way from rest to the nearer trip is used, 0 to 1 and beyond.

        `role`: ``position`` or ``current``; `values`: (n_samples,), SI, measured; `rest`: where the bench rests, SI.
        Returns 0 where there is no limit.
        """
        low, high = self.trips[role]
        up, down = float(values.max()) - rest, rest - float(values.min())
        return max(
            up / (high - rest) if high > rest else math.inf, down / (rest - low) if rest > low else math.inf, 0.0
        )


def _ordered(rig: Rig, limits: tuple[float, float]) -> tuple[float, float]:
    """Return what of the limits of the voltage the pulse widths allowed can order."""
    if rig.daq is None or rig.daq.duty is None:
        return limits
    low, high = sorted(scale_of(with_default_daq(rig), "voltage").to_si(rig.daq.duty).tolist())
    return max(low, limits[0]), min(high, limits[1])


class Kept:
    """Keeps what a run passes on, seen through the rig.

    `view`: of device and rig.
    """

    def __init__(self, view: BenchView) -> None:
        self._view = view
        self._values: list[Array] = []

    def take(self, frame: Frame) -> None:
        """Take a block.

        `frame`: as it came.
        """
        self._values.append(self._view.block(frame.block).values)

    def roles(self) -> dict[str, Array]:
        """Return what came, by role.

        Returns (n_samples,), SI, empty arrays where nothing came.
        """
        n = len(self._view.units)
        values = np.concatenate(self._values) if self._values else np.empty((0, n))
        return {role: values[:, k] for k, role in enumerate(self._view.units)}


Look = Callable[[Course], tuple[RunReport, dict[str, Array]]]


def looking(device: Device, rig: Rig, stopped: Callable[[], bool]) -> Look:
    """Return a way of running a course and keeping what it shows.

    `device`: opened, idle; `rig`: its bench; `stopped`: as `session.run`. Returns takes a course, gives report and
    values by role.
    """
    plant = model(rig.model)
    view = BenchView(device.info, rig, (*plant.inputs, *plant.outputs))

    def look(course: Course) -> tuple[RunReport, dict[str, Array]]:
        kept = Kept(view)
        report = run(device, course, taps=[kept], stopped=stopped)
        return report, kept.roles()

    return look


def ended(report: RunReport, what: str) -> tuple[str, ...]:
    """Say why a run is not whole.

    `report`: of the run; `what`: what it was for. Returns empty where it is whole.
    """
    if report.fault is not None:
        return (f"the controller went to its safe state during {what}: {fault_words(report.fault)}",)
    if report.interrupted:
        return (f"{what} was interrupted after {report.samples} of {report.wanted} samples",)
    if report.lost:
        return (f"{report.lost} of {report.wanted} samples were lost during {what}: look at cable, baud rate and load",)
    if not report.complete:
        return (f"{what} ended after {report.samples} of {report.wanted} samples",)
    return ()
