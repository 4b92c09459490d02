"""Short looks at a bench: a course is run and kept in memory, seen through the rig, with the room that it may use."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.acquire.causes import fault_words
from ambid.acquire.default_daq import with_default_daq
from ambid.acquire.device import Device
from ambid.acquire.scales import scale_of
from ambid.acquire.session import Course, RunReport, run
from ambid.acquire.view import BenchView
from ambid.physics.models import model
from ambid.rig import Rig
from ambid.track.stream.block import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Where a bench may work, SI.

    Attributes
    ----------
    trips : Mapping of str to (float, float)
        Of position and current, those of them that the bench has: the controller's limits.
    voltage : (float, float)
        That may be ordered: inside the limits of the loop and ``daq.duty``.
    """

    trips: Mapping[str, tuple[float, float]]
    voltage: tuple[float, float]

    @classmethod
    def of(cls, rig: Rig) -> Room:
        """Take it from a rig.

        Parameters
        ----------
        rig : Rig
            With ``[daq]``.

        Returns
        -------
        Room
            Infinite where the rig knows no limit.
        """
        unlimited = (-math.inf, math.inf)
        roles = [role for role in ("position", "current") if role in model(rig.model).outputs]
        trips: dict[str, tuple[float, float]] = {role: rig.trip(role) or unlimited for role in roles}
        return cls(
            trips=MappingProxyType(trips), voltage=_ordered(rig, rig.limits.voltage if rig.limits else unlimited)
        )

    def used(self, role: str, values: Array, rest: float) -> float:
        """Return which part of the way from rest to the nearer trip is used, 0 to 1 and beyond.

        Parameters
        ----------
        role : str
            ``position`` or ``current``.
        values : ndarray, shape (n_samples,), SI
            Measured.
        rest : float
            Where the bench rests, SI.

        Returns
        -------
        float
            0 where there is no limit.
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

    Parameters
    ----------
    view : BenchView
        Of device and rig.
    """

    def __init__(self, view: BenchView) -> None:
        self._view = view
        self._values: list[Array] = []

    def take(self, frame: Frame) -> None:
        """Take a block.

        Parameters
        ----------
        frame : Frame
            As it came.
        """
        self._values.append(self._view.block(frame.block).values)

    def roles(self) -> dict[str, Array]:
        """Return what came, by role.

        Returns
        -------
        dict of str to ndarray, shape (n_samples,), SI
            Empty arrays where nothing came.
        """
        n = len(self._view.units)
        values = np.concatenate(self._values) if self._values else np.empty((0, n))
        return {role: values[:, k] for k, role in enumerate(self._view.units)}


Look = Callable[[Course], tuple[RunReport, dict[str, Array]]]


def looking(device: Device, rig: Rig, stopped: Callable[[], bool]) -> Look:
    """Return a way of running a course and keeping what it shows.

    Parameters
    ----------
    device : Device
        Opened, idle.
    rig : Rig
        Its bench.
    stopped : callable
        As `session.run`.

    Returns
    -------
    callable
        Takes a course, gives report and values by role.
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

    Parameters
    ----------
    report : RunReport
        Of the run.
    what : str
        What it was for.

    Returns
    -------
    tuple of str
        Empty where it is whole.
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
