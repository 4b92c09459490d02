"""The steps of a commissioning that look at the bench itself: rest, levitation, the right size of excitation."""

from __future__ import annotations

import math

import numpy as np

from ambid.acquire.device import Device
from ambid.acquire.session import Course
from ambid.job.amplitude import Trial, find_amplitude
from ambid.job.commission.step import EXCITATION, Step, Wishes
from ambid.job.look import Look, Room, ended

_SD_AT_REST = 0.02  # of the trips' width: noise of a sensor with the output off
_ZERO, _NEAR_ZERO = 0.10, 0.03  # of the trips' width: current that is shown with the output off
_WANDER = 0.25  # of the trips' width: how far the rotor may stray without excitation
_NEAR = 0.85  # of the voltage: no room left


def self_test(device: Device) -> Step:
    """Let the device look at itself.

    Parameters
    ----------
    device : Device
        Opened, idle.

    Returns
    -------
    Step
        Passed if nothing failed.
    """
    found = device.self_test()
    told = tuple(f"{name} {value:g}" for name, value in found.numbers.items())
    who = ", ".join(f"{k} {v}" for k, v in device.info.identity.items() if k in ("protocol", "major", "minor", "board"))
    return Step(
        name="self-test",
        findings=(f"{device.info.kind} device at {device.info.port}" + (f": {who}" if who else ""), ", ".join(told)),
        reasons=found.failed,
        numbers=found.numbers,
    )


def rest(look: Look, room: Room, wishes: Wishes) -> Step:
    """Look at the sensors with the output off.

    Parameters
    ----------
    look : callable
        See `ambid.job.look.looking`.
    room : Room
        Limits.
    wishes : Wishes
        Lengths.

    Returns
    -------
    Step
        Not passed where a sensor is noisy, or a current is shown that cannot be.
    """
    report, seen = look(Course(mode="sample", seconds=wishes.rest_s))
    reasons = list(ended(report, "the look at rest"))
    findings: list[str] = []
    cautions: list[str] = []
    numbers: dict[str, float] = {}
    for role, unit in (("position", "m"), ("current", "A")):
        if role not in seen or not seen[role].size:
            continue
        mean, sd = float(seen[role].mean()), float(seen[role].std())
        findings.append(f"{role} at rest {mean:.4g} {unit}, noise {sd:.2g} {unit} rms")
        numbers |= {f"{role}_mean": mean, f"{role}_sd": sd}
        low, high = room.trips[role]
        width = high - low
        if math.isfinite(width) and sd > _SD_AT_REST * width:
            reasons.append(
                f"the {role} sensor's noise is {sd:.2g} {unit} rms with the output off, {100 * sd / width:.0f} % of the"
                " way between the trips: look at wiring, ground and the filter at the input"
            )
        if sd == 0.0:
            cautions.append(f"{role} does not move by one count: a quiet sensor, or none")
        if role == "current" and math.isfinite(width) and abs(mean) > _NEAR_ZERO * width:
            (reasons if abs(mean) > _ZERO * width else cautions).append(
                f"{mean:.3g} A are shown with the output off, {100 * abs(mean) / width:.0f} % of the way between the"
                " trips: correct the offset of channels.current, or see that the power stage does switch off"
            )
    return Step(
        name="rest", findings=tuple(findings), reasons=tuple(reasons), cautions=tuple(cautions), numbers=numbers
    )


def levitate(look: Look, room: Room, wishes: Wishes) -> Step:
    """Lift the rotor and let it hover without excitation.

    Parameters
    ----------
    look : callable
        See `ambid.job.look.looking`.
    room : Room
        Limits.
    wishes : Wishes
        Lengths.

    Returns
    -------
    Step
        Not passed where the controller tripped, the rotor strays, or no room is left.
    """
    report, seen = look(Course(mode="levitate", seconds=wishes.hover_s, settle_s=wishes.settle_s))
    reasons = list(ended(report, "levitation"))
    if not seen["position"].size:
        return Step(name="levitate", reasons=tuple(reasons) or ("no sample came after lift-off",))
    findings: list[str] = []
    numbers: dict[str, float] = {}
    for role, unit in (("position", "m"), ("current", "A"), ("voltage", "V")):
        mean, sd = float(seen[role].mean()), float(seen[role].std())
        findings.append(f"{role} {mean:.4g} {unit}, {sd:.2g} {unit} rms")
        numbers |= {f"{role}_mean": mean, f"{role}_sd": sd}
        if role != "voltage" and sd == 0.0:
            reasons.append(
                f"{role} does not move by one count while the rotor hovers: no sensor there? Look at its cable and"
                " supply"
            )
    low, high = room.trips["position"]
    stray = float(np.ptp(seen["position"]))
    if math.isfinite(high - low) and stray > _WANDER * (high - low):
        reasons.append(
            f"the rotor strays by {stray:.3g} m without excitation, {100 * stray / (high - low):.0f} % of the way"
            " between the trips: the loop is badly damped or the sensor disturbed; change the gains of [loop]"
        )
    v_low, v_high = room.voltage
    centre, half = (v_low + v_high) / 2, (v_high - v_low) / 2
    if math.isfinite(half) and abs(numbers["voltage_mean"] - centre) > _NEAR * half:
        reasons.append(
            f"hovering takes {numbers['voltage_mean']:.3g} V of {v_low:g} to {v_high:g} V: nothing is left to excite"
            " with; change bias, set point or supply"
        )
    return Step(name="levitate", findings=tuple(findings), reasons=tuple(reasons), numbers=numbers)


def excite(look: Look, room: Room, wishes: Wishes, rate_hz: float, hover: Step) -> Step:
    """Find the largest excitation that keeps to its part of the room.

    Parameters
    ----------
    look : callable
        See `ambid.job.look.looking`.
    room : Room
        Limits.
    wishes : Wishes
        Band, part of the room, perhaps the amplitude itself.
    rate_hz : float
        Of the device, Hz.
    hover : Step
        Levitation without excitation: where the bench rests.

    Returns
    -------
    Step
        `numbers` hold ``amplitude_v``; not passed where a trial tripped, or too much of the room was used.
    """
    resting = {role: hover.numbers[f"{role}_mean"] for role in room.trips}
    trial = Trial(
        name=EXCITATION, band=wishes.band(rate_hz), mode="levitate", settle_s=wishes.settle_s,
        seconds=wishes.longest_trial_s(rate_hz), seed=wishes.seed,
    )  # fmt: skip
    found = find_amplitude(look, room, trial, resting, rate_hz=rate_hz, use=wishes.use, given=wishes.amplitude_v)
    numbers = {"amplitude_v": found.amplitude_v, "used": found.used}
    return Step(name="excite", findings=found.findings, reasons=found.reasons, numbers=numbers)
