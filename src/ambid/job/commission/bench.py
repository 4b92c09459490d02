"""The steps of a commissioning that look at the bench itself: rest, levitation, the right size of excitation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from ambid.acquire.device import Device
from ambid.acquire.session import Course
from ambid.arrays import Array
from ambid.job.amplitude import Trial, find_amplitude
from ambid.job.commission.step import EXCITATION, Step, Wishes
from ambid.job.look import Look, Room, ended
from ambid.report.numbers import sized

_SD_AT_REST = 0.02  # of the trips' width: noise of a sensor with the output off
_ZERO, _NEAR_ZERO = 0.10, 0.03  # of the trips' width: current that is shown with the output off
_WANDER = 0.25  # of the trips' width: how far the rotor may stray without excitation
_NEAR = 0.85  # of the voltage: no room left
_UNITS = MappingProxyType({"position": "m", "current": "A", "voltage": "V"})


def self_test(device: Device) -> Step:
    """Let the device look at itself.

    `device`: opened, idle. Returns passed if nothing failed.
    """
    found = device.self_test()
    who = ", ".join(f"{k} {v}" for k, v in device.info.identity.items() if k in ("protocol", "major", "minor", "board"))
    return Step(
        name="self-test",
        findings=(
            f"{device.info.kind} device at {device.info.port}" + (f": {who}" if who else ""),
            _measured(found.numbers),
        ),
        reasons=found.failed,
        numbers=found.numbers,
    )


def rest(look: Look, room: Room, wishes: Wishes) -> Step:
    """Look at the sensors with the output off.

    `look`: see `ambid.job.look.looking`; `room`: limits; `wishes`: lengths. Returns not passed where a sensor is noisy,
    or a current is shown that cannot be.
    """
    report, seen = look(Course(mode="sample", seconds=wishes.rest_s))
    reasons = list(ended(report, "the look at rest"))
    cautions: list[str] = []
    shown = {role: _mean_sd(x) for role, x in seen.items() if role in ("position", "current") and x.size}
    for role, (mean, sd) in shown.items():
        unit = _UNITS[role]
        low, high = room.trips[role]
        width = high - low
        if math.isfinite(width) and sd > _SD_AT_REST * width:
            reasons.append(
                f"the {role} sensor's noise is {sized(sd, unit)} rms with the output off, {100 * sd / width:.0f} %"
                " of the way between the trips: look at wiring, ground and the filter at the input"
            )
        if sd == 0.0:
            cautions.append(f"{role} does not move by one count: a quiet sensor, or none")
        if role == "current" and math.isfinite(width) and abs(mean) > _NEAR_ZERO * width:
            (reasons if abs(mean) > _ZERO * width else cautions).append(
                f"{sized(mean, unit)} are shown with the output off, {100 * abs(mean) / width:.0f} % of the way between"
                " the trips: correct the offset of channels.current, or see that the power stage does switch off"
            )
    findings = tuple(
        f"{role} at rest {sized(mean, _UNITS[role])}, noise {sized(sd, _UNITS[role])} rms"
        for role, (mean, sd) in shown.items()
    )
    return Step(
        name="rest", findings=findings, reasons=tuple(reasons), cautions=tuple(cautions), numbers=_numbers(shown)
    )


def levitate(look: Look, room: Room, wishes: Wishes) -> Step:
    """Lift the rotor and let it hover without excitation.

    `look`: see `ambid.job.look.looking`; `room`: limits; `wishes`: lengths. Returns not passed where the controller
    tripped, the rotor strays, or no room is left.
    """
    report, seen = look(Course(mode="levitate", seconds=wishes.hover_s, settle_s=wishes.settle_s))
    reasons = list(ended(report, "levitation"))
    if not seen["position"].size:
        return Step(name="levitate", reasons=tuple(reasons) or ("no sample came after lift-off",))
    shown = {role: _mean_sd(seen[role]) for role in _UNITS}
    for role, (_, sd) in shown.items():
        if role != "voltage" and sd == 0.0:
            reasons.append(
                f"{role} does not move by one count while the rotor hovers: no sensor there? Look at its cable and"
                " supply"
            )
    low, high = room.trips["position"]
    stray = float(np.ptp(seen["position"]))
    if math.isfinite(high - low) and stray > _WANDER * (high - low):
        reasons.append(
            f"the rotor strays by {sized(stray, 'm')} without excitation, {100 * stray / (high - low):.0f} % of the way"
            " between the trips: the loop is badly damped or the sensor disturbed; change the gains of [loop]"
        )
    v_low, v_high = room.voltage
    centre, half = (v_low + v_high) / 2, (v_high - v_low) / 2
    if math.isfinite(half) and abs(shown["voltage"][0] - centre) > _NEAR * half:
        reasons.append(
            f"hovering takes {shown['voltage'][0]:.3g} V of {v_low:g} to {v_high:g} V: nothing is left to excite"
            " with; change bias, set point or supply"
        )
    findings = tuple(
        f"{role} {sized(mean, _UNITS[role])}, {sized(sd, _UNITS[role])} rms" for role, (mean, sd) in shown.items()
    )
    return Step(name="levitate", findings=findings, reasons=tuple(reasons), numbers=_numbers(shown))


def excite(look: Look, room: Room, wishes: Wishes, rate_hz: float, hover: Step) -> Step:
    """Find the largest excitation that keeps to its part of the room.

    `look`: see `ambid.job.look.looking`; `room`: limits; `wishes`: band, part of the room, perhaps the amplitude
    itself; `rate_hz`: of the device, Hz; `hover`: levitation without excitation: where the bench rests. Returns
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


def _measured(numbers: Mapping[str, float]) -> str:
    """Say what a self-test measured, in words and units; what is not known here stands at the end as it is named."""
    left = dict(numbers)
    told = []
    if "supply_mv" in left:
        told.append(f"supply {left.pop('supply_mv') / 1e3:.4g} V")
    if "free_bytes" in left:
        told.append(f"{left.pop('free_bytes'):g} bytes of memory never used")
    counts = [f"{role} {left.pop(role):.4g}" for role in ("position", "current") if role in left]
    told += [" and ".join(counts) + " counts"] if counts else []
    return ", ".join(told + [f"{name} {value:g}" for name, value in left.items()])


def _mean_sd(values: Array) -> tuple[float, float]:
    return float(values.mean()), float(values.std())


def _numbers(shown: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    return {f"{role}_{what}": x for role, pair in shown.items() for what, x in zip(("mean", "sd"), pair, strict=True)}
