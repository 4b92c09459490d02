"""The right size of an excitation, found on the bench itself: trials from small to large, each judged before the next.

An excitation may use a part of the way from rest to the trips of position and current, and most of the voltage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ambid.acquire.device import Device, Mode
from ambid.acquire.program import program
from ambid.acquire.session import Course
from ambid.errors import DeviceError
from ambid.job.look import Array, Look, Room, ended, looking
from ambid.rig import Rig

_TRIALS, _FIRST, _GROWTH = 6, 0.08, 4.0  # first: as a part of half the voltage; growth: largest step
_ENOUGH = 0.75  # of what is wished
_NEAR = 0.85  # of the way to a trip, or of the voltage: no room left


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What a trial plays.

    Attributes
    ----------
    name : str
        Excitation, as `ambid.acquire.program` knows it.
    band : (float, float) or None
        In Hz.
    mode : {"drive", "levitate"}
        Of the device.
    settle_s, seconds : float
        Time after the start, and length of the trial, s.
    seed : int
        Of the excitation.
    """

    name: str
    band: tuple[float, float] | None
    mode: Mode
    settle_s: float
    seconds: float
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """What trials found.

    Attributes
    ----------
    amplitude_v : float
        Peak of the excitation, V.
    used : float
        Part of the room that it used, 0 to 1 and beyond.
    findings, reasons : tuple of str
        What each trial showed; why the size is not good.
    """

    amplitude_v: float
    used: float
    findings: tuple[str, ...]
    reasons: tuple[str, ...] = ()


def find_amplitude(
    look: Look,
    room: Room,
    trial: Trial,
    resting: Mapping[str, float],
    *,
    rate_hz: float,
    use: float,
    given: float | None = None,
) -> Size:
    """Find the largest excitation that keeps to its part of the room.

    Parameters
    ----------
    look : callable
        See `ambid.job.look.looking`.
    room : Room
        Limits.
    trial : Trial
        What is played.
    resting : Mapping of str to float
        Position in m and current in A without excitation.
    rate_hz : float
        Of the device, Hz.
    use : float
        Part of the room.
    given : float, optional
        A size that is only tried, V.

    Returns
    -------
    Size
        With reasons where a trial tripped, or too much was used.
    """
    low, high = room.voltage
    if given is None and not math.isfinite(high - low):
        why = "the rig has no loop.limits.voltage to choose an amplitude from: give one"
        return Size(amplitude_v=math.nan, used=math.nan, findings=(), reasons=(why,))
    size = _FIRST * (high - low) / 2.0 if given is None else given
    findings: list[str] = []
    while True:
        wave = program(
            trial.name, amplitude_v=size, band=trial.band, rate_hz=rate_hz, seconds=trial.seconds, seed=trial.seed
        )
        report, seen = look(Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s, program=wave))
        reasons = ended(report, f"excitation of {size:.3g} V")
        if reasons:
            return Size(amplitude_v=size, used=math.nan, findings=tuple(findings), reasons=reasons)
        worst, used = _used(seen, room, resting, use)
        findings.append(f"{size:.3g} V uses {100.0 * used:.0f} % of the room of {worst}")
        if given is not None or used >= _ENOUGH * use or len(findings) == _TRIALS:
            break
        size *= _GROWTH if used <= 0.0 else min(_GROWTH, 0.9 * use / used)
    too_much = (f"an excitation of {size:.3g} V uses {100.0 * used:.0f} % of the room: give a smaller one",)
    return Size(amplitude_v=size, used=used, findings=tuple(findings), reasons=too_much if used > _NEAR else ())


def fitting_amplitude(
    device: Device, rig: Rig, trial: Trial, *, use: float = 0.3, stopped: Callable[[], bool] = lambda: False
) -> float:
    """Find an amplitude for a device that has not run yet.

    Parameters
    ----------
    device : Device
        Opened, idle.
    rig : Rig
        Of the device.
    trial : Trial
        What is played.
    use : float
        Part of the room.
    stopped : callable, optional
        As `session.run`.

    Returns
    -------
    float
        Peak in V.

    Raises
    ------
    DeviceError
        If the bench does not hold still, or no size is good.
    """
    look, room = looking(device, rig, stopped), Room.of(rig)
    report, seen = look(Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s))
    reasons = ended(report, "the look before the excitation")
    if not reasons:
        resting = {role: float(seen[role].mean()) for role in room.trips}
        found = find_amplitude(look, room, trial, resting, rate_hz=device.info.rate_hz, use=use)
        if not found.reasons:
            return found.amplitude_v
        reasons = found.reasons
    raise DeviceError(f"{device.info.port}: no amplitude was found: {'; '.join(reasons)}. Give --amplitude")


def _used(seen: Mapping[str, Array], room: Room, resting: Mapping[str, float], use: float) -> tuple[str, float]:
    """Return which quantity uses most of its room, and how much of it."""
    shares = {role: room.used(role, seen[role], resting[role]) for role in room.trips}
    low, high = room.voltage
    if math.isfinite(high - low):
        reach = float(np.abs(seen["voltage"] - (low + high) / 2.0).max()) / ((high - low) / 2.0)
        # A voltage that is nearly all used counts like a position at the part that is wished.
        shares["voltage"] = reach * use / _NEAR
    worst = max(shares, key=lambda role: shares[role])
    return worst, shares[worst]
