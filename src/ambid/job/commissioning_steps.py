"""The steps of a guided commissioning, with findings and, where it is not good enough, the reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np

from ambid.acquisition.device import Device, Program
from ambid.acquisition.session import Acquired, Course
from ambid.acquisition.trials import (
    AIM,
    TOO_MUCH,
    USE,
    Look,
    Polarity,
    Pulse,
    Room,
    Size,
    Trial,
    find_amplitude,
    find_polarity,
    moving_band,
    room_used,
    why_incomplete,
)
from ambid.arrays import Array
from ambid.control.design import FIGURES, Design
from ambid.control.experiment import Experiment
from ambid.control.margins import Margins
from ambid.control.zones import LONG_TERM, Zone
from ambid.estimation.estimate import Estimate
from ambid.job.track_live import LiveTrack
from ambid.report.commission import (
    Picture,
    Step,
    design_picture,
    margins_picture,
    measured_picture,
    pulses_picture,
    rest_picture,
    trace_picture,
    trials_picture,
)
from ambid.report.design import NAMES, figure_text
from ambid.report.device import acquired_sections
from ambid.report.estimate import sensitivity_lines
from ambid.report.numbers import quantity, sized
from ambid.report.text import pure
from ambid.rig import Rig
from ambid.settings.caller import setting
from ambid.simulation.margins import LoopMargins

StepName = Literal[
    "self-test", "rest", "polarity", "levitate", "excite", "record", "identify", "validate", "redesign", "load", "track"
]

REDESIGN: tuple[StepName, ...] = ("redesign", "load")
"""Those that a commissioning does only where a better loop is wished."""
STEPS: tuple[StepName, ...] = tuple(name for name in get_args(StepName) if name not in REDESIGN)
"""The others, in their order."""

_EXCITATION = "multisine"
_PERIODS = 4.0  # of the lowest line in a trial

_SD_AT_REST = 0.02  # of the trips' width: noise of a sensor with the output off
_ZERO, _NEAR_ZERO = 0.10, 0.03  # of the trips' width: current that is shown with the output off
_WANDER = 0.25  # of the trips' width: how far the rotor may stray without excitation
_NEAR = 0.85  # of the voltage: no room left
_UNITS = MappingProxyType({"position": "m", "current": "A", "voltage": "V"})
_SATURATED = 1e-3  # of the samples at the end of a converter's range
_RESIDUAL = ("residuals_white", "residuals_uncorrelated", "uncertainty_consistent", "estimates_agree", "curvature")
"""Checks that a model which does not fully fit the record fails: the standard deviations then allow for it, or the
check says by how much they do not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a commissioning is to reach, and how long it may take for it."""

    # length of the record, of the one for validation, of levitation without excitation, of the look at rest, of each
    # trial of the amplitude, and of tracking, s
    record_s: float = 20.0
    second_s: float = 8.0
    hover_s: float = 2.0
    rest_s: float = 0.5
    trial_s: float = 2.0
    track_s: float = 5.0
    settle_s: float = 1.0  # time that lift-off is given, s
    amplitude_v: float | None = None  # peak of the excitation, V; None: found by trials
    band_hz: tuple[float, float] | None = None  # of the excitation; None: a thousandth to a thirtieth of the rate
    use: float = USE  # part of the way to the trips that the excitation may use
    # largest half width of a 95 % interval, relative to the value, of a parameter that counts as found
    widest: float = 0.10
    seed: int = 0  # of the excitation
    redesign: bool = False  # whether a better loop is designed, loaded and measured

    @property
    def steps(self) -> tuple[StepName, ...]:
        """The steps that are done, in their order."""
        return get_args(StepName) if self.redesign else STEPS

    def band(self, rate_hz: float) -> tuple[float, float]:
        """Return the band of the excitation in Hz, as requested or from the rate in Hz."""
        return self.band_hz or moving_band(rate_hz)

    def longest_trial_s(self, rate_hz: float) -> float:
        """Return a trial's length in s: as requested, or longer, at least four periods of the lowest line."""
        low = self.band(rate_hz)[0]
        return max(self.trial_s, _PERIODS / low * (1 + 1e-9)) if low > 0.0 else self.trial_s

    def trial(self, rate_hz: float, seconds: float, seed: int = 0) -> Trial:
        """Return what is played for so long; each `seed` gives another excitation."""
        return Trial(
            name=_EXCITATION, band=self.band(rate_hz), mode="levitate", settle_s=self.settle_s, seconds=seconds,
            seed=self.seed + seed,
        )  # fmt: skip


def second_s(record_s: float) -> float:
    """Return the length of the record for validation, s: two fifths, but where the first is short as long as that."""
    return max(0.4 * record_s, min(record_s, 4.0))


def self_test(device: Device) -> Step:
    """Let an opened, idle device look at itself; passed if nothing failed."""
    found = device.self_test()
    who = ", ".join(f"{k} {v}" for k, v in device.info.identity.items() if k in ("protocol", "major", "minor", "board"))
    where = f"{device.info.kind} device at {device.info.port}" + (f": {who}" if who else "")
    findings = (where, _measured(found.numbers))
    return Step(name="self-test", findings=findings, reasons=found.failed, numbers=found.numbers)


def rest(look: Look, room: Room, plan: Plan, rate_hz: float) -> Step:
    """Look (see `make_look`) at the sensors with the output off; not passed where one is noisy, or a current is shown
    that cannot be. `room`: limits; `plan`: lengths; rate in Hz.
    """
    report, seen = look(Course(mode="sample", seconds=plan.rest_s))
    reasons = list(why_incomplete(report, "the look at rest"))
    cautions: list[str] = []
    shown = {role: _mean_sd(x) for role, x in seen.items() if role in ("position", "current") and x.size}
    for role, (mean, sd) in shown.items():
        unit = _UNITS[role]
        low, high = room.trips[role]
        width = high - low
        if math.isfinite(width) and sd > _SD_AT_REST * width:
            reasons.append(
                f"the {role} sensor's noise is {sized(sd, unit)} rms with the output off, {100 * sd / width:.0f} %"
                " of the way between the trips: check wiring, ground and the filter at the input"
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
        name="rest", findings=findings, reasons=tuple(reasons), cautions=tuple(cautions), numbers=_numbers(shown),
        pictures=(rest_picture(seen, rate_hz),) if shown else (),
    )  # fmt: skip


def polarity(look: Look, room: Room, rig: Rig, device: Device) -> Step:
    """Find by pulses which way the bench answers, compared with rig and controller; `look`: see `make_look`; `room`:
    limits. Not passed where a sign is reversed, no current flows, or the controller tripped; no motion is a caution.
    """
    found = find_polarity(look, room, rig, device.info.rate_hz, clear=device.clear)
    largest = max(found.pulses, key=lambda p: abs(p.volts) * p.hold_s)
    told = [f"{len(found.pulses)} pulses of {sized(abs(found.pulses[0].volts), 'V')} to {_pulse_words(largest)}"]
    numbers = {"current": float(found.current), "motion": float(found.motion)}
    if found.current:
        told.append(f"the current {_way(found.current)} when the voltage rises")
    if found.motion:
        farthest = max(abs(p.motion) for p in found.pulses)
        told.append(f"the position {_way(found.motion)} when the current rises, by {sized(farthest, 'm')} at most")
    reasons = [*found.troubles, *_reversed(found, rig)]
    if not found.current and not reasons:
        reasons.append(
            f"no current is shown for {_pulse_words(largest)}: check the coil's cable, the current sensor and the"
            " power stage"
        )
    cautions = []
    if found.current and not found.motion and not reasons:
        cautions.append(
            f"the rotor did not move for {_pulse_words(largest)}, {sized(abs(largest.current_change), 'A')}: the sign"
            " of the position could not be checked. If it does not lift, look at that first"
        )
    return Step(
        name="polarity", findings=tuple(told), reasons=tuple(reasons), cautions=tuple(cautions), numbers=numbers,
        pictures=(pulses_picture(found.pulses),),
    )  # fmt: skip


def _pulse_words(pulse: Pulse) -> str:
    return f"{sized(abs(pulse.volts), 'V')} for {sized(pulse.hold_s, 's')}"


def _way(sign: int) -> str:
    return "rises" if sign > 0 else "falls"


def _reversed(found: Polarity, rig: Rig) -> list[str]:
    """Name the sign that is not as the rig says, where the pulses tell it."""
    k_i = next((p.value for p in rig.parameters if p.name == "k_i"), None)
    kp = 0.0 if rig.loop is None else rig.loop.pull
    whose = "loop.kp" if rig.loop is None or rig.loop.law is None else "the answer of the law of [loop]"
    said = int(np.sign(k_i or kp))  # of the motion, by the rig; the loop pushes back where kp has the same sign
    by = f"k_i = {k_i:g} N/A" if k_i else f"{whose} = {kp:g} V/m"
    if found.current < 0:
        falls = "the current falls when the voltage rises"
        if not found.motion or not said:
            return [
                f"{falls}: one of the two is reversed. Exchange the leads of the coil or the sign of channels.voltage,"
                " or turn the current sensor or the sign of channels.current (gain and offset)"
            ]
        if found.motion == said:
            return [
                f"{falls}, and the position moves with the current as the rig says: the voltage is reversed. Exchange"
                " the leads of the coil, or the sign of channels.voltage.gain and offset"
            ]
        return [
            f"{falls}, and the position moves with the voltage as the rig says: the current is reversed. Turn the"
            " current sensor, or the sign of channels.current.gain and offset"
        ]
    if not found.current or not found.motion or not said or (found.motion == said and k_i is None):
        return []
    seen = f"the position {_way(found.motion)} when the current rises"
    if found.motion != said:
        right = kp != 0.0 and k_i and np.sign(kp) == found.motion
        remedy = (
            "The controller's gains assume what was seen: correct the sign of parameters.k_i"
            if right
            else "Exchange the position sensor's sign, or that of channels.position.gain and offset"
        )
        return [f"{seen}: the rig says it {_way(said)} ({by}). {remedy}"]
    if kp != 0.0 and np.sign(kp) != found.motion:
        return [f"{seen}, as the rig says, and {whose} = {kp:g} V/m pushes it away: correct the sign of [loop]"]
    return []


def levitate(look: Look, room: Room, plan: Plan, rate_hz: float) -> Step:
    """Lift the rotor and let it hover without excitation; not passed where the controller tripped, the rotor strays, or
    no room is left. `look`: see `make_look`; `room`: limits; `plan`: lengths; rate in Hz.
    """
    course = Course(mode="levitate", seconds=plan.hover_s, settle_s=plan.settle_s, transient=True)
    report, whole = look(course)
    settled = max(round(plan.settle_s * rate_hz), whole["position"].size - round(plan.hover_s * rate_hz))
    seen = {role: values[settled:] for role, values in whole.items()}
    caption = "From the start on; dashed: the controller's trips. Shaded: lift-off, which is given time to settle."
    pictures = (trace_picture("Lift-off", caption, whole, rate_hz, room.trips, from_s=settled / rate_hz),)
    reasons = list(why_incomplete(report, "levitation"))
    if not seen["position"].size:
        reasons = reasons or ["no sample came after lift-off"]
        return Step(name="levitate", reasons=tuple(reasons), pictures=pictures if whole["position"].size else ())
    shown = {role: _mean_sd(seen[role]) for role in _UNITS}
    for role, (_, sd) in shown.items():
        if role != "voltage" and sd == 0.0:
            reasons.append(
                f"{role} does not move by one count while the rotor hovers: no sensor there? Check its cable and supply"
            )
    low, high = room.trips["position"]
    stray = float(np.ptp(seen["position"]))
    if math.isfinite(high - low) and stray > _WANDER * (high - low):
        reasons.append(
            f"the rotor drifts by {sized(stray, 'm')} without excitation, {100 * stray / (high - low):.0f} % of the way"
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
    return Step(name="levitate", findings=findings, reasons=tuple(reasons), numbers=_numbers(shown), pictures=pictures)


def resting_at(room: Room, hover: Step) -> dict[str, float]:
    """Return where position and current rest, by the step `levitate`."""
    return {role: hover.numbers[f"{role}_mean"] for role in room.trips}


def excite(look: Look, room: Room, plan: Plan, rate_hz: float, hover: Step) -> tuple[Step, Size]:
    """Find the largest excitation, ``amplitude_v``, that keeps to its part of the room; not passed where a trial
    tripped, or too much was used. `look`: see `make_look`; `plan`: band, part, perhaps the amplitude; rate in Hz;
    `hover`: where it rests.
    """
    resting = resting_at(room, hover)
    trial = plan.trial(rate_hz, plan.longest_trial_s(rate_hz))
    found = find_amplitude(look, room, trial, resting, rate_hz=rate_hz, use=plan.use, amplitude_v=plan.amplitude_v)
    numbers = {"amplitude_v": found.amplitude_v, "used": found.used}
    trips = room.trips
    seen = (trials_picture(found.trials, plan.use, found.last, rate_hz, trips),) if found.trials else ()
    step = Step(name="excite", findings=found.findings, reasons=found.reasons, numbers=numbers, pictures=seen)
    return step, found


def designed(look: Look, room: Room, plan: Plan, rate_hz: float, hover: Step, made: Experiment) -> tuple[Step, Program]:
    """Play what was `made` on a small excitation for a trial, again with less if it moves too much: the excitation to
    play; not passed where the controller tripped, or both used too much.
    """
    program, resting = made.program, resting_at(room, hover)
    findings: list[str] = []
    for _ in range(2):
        course = Course(
            mode="levitate", seconds=plan.longest_trial_s(rate_hz), settle_s=plan.settle_s, program=program
        )  # fmt: skip
        report, seen = look(course)
        reasons = why_incomplete(report, f"the designed excitation of {program.amplitude:.3g} V")
        if reasons:
            return Step(name="excite", findings=tuple(findings), reasons=reasons), program
        worst, used = room_used(seen, room, resting, plan.use)
        findings.append(
            f"the designed excitation of {program.amplitude:.3g} V moves {worst} through {100.0 * used:.0f} % of its "
            f"available range, of {100.0 * plan.use:.0f} %"
        )
        if used <= TOO_MUCH * plan.use:
            break
        program = replace(program, amplitude=program.amplitude * AIM * plan.use / used)
    else:
        reasons = (f"{findings[-1]}, although it was reduced: the model of the first record does not hold",)
    caption = "As long as a trial; dashed: the controller's trips."
    picture = trace_picture("The designed excitation", caption, seen, rate_hz, room.trips)
    numbers = {"designed_v": program.amplitude, "used": used}
    return Step(name="excite", findings=tuple(findings), reasons=reasons, numbers=numbers, pictures=(picture,)), program


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


def record(name: str, done: Acquired, pictures: tuple[Picture, ...] = ()) -> Step:
    """Judge a record as it was taken: not passed where samples were lost or not stored, or a sensor saturates or stands
    still; little signal over noise is a caution, decided by intervals of what is identified.
    """
    reasons = list(why_incomplete(done.run, f"the {name}"))
    if done.not_stored:
        reasons += [f"{done.not_stored} samples of the {name} are not stored: {done.troubles[0]}"]
    findings = [
        f"{name}: {done.run.samples} samples at {done.info.rate_hz:g} Hz, {done.run.lost} lost,"
        f" {done.counters.damaged} frames damaged"
    ]
    reasons += [
        f"{column.name} is at the end of its range in {100 * column.saturated:.1f} % of the {name}'s samples"
        for column in done.quality.columns
        if column.role in ("position", "current") and column.saturated > _SATURATED
    ]
    reasons += [
        f"{column.name} does not move by one count in the {name}: no sensor there? Check its cable and supply"
        for column in done.quality.columns
        if column.role in ("position", "current") and column.sd == 0.0
    ]
    cautions = [str(t) for t in done.troubles if not done.not_stored] + [f"{name}: {v}" for v in done.quality.verdict]
    parts = tuple(part for section in acquired_sections(done) for part in section.parts)
    return Step(
        name="record", findings=tuple(findings), reasons=tuple(reasons), cautions=tuple(cautions), parts=parts,
        pictures=pictures,
    )  # fmt: skip


def identification(
    estimate: Estimate,
    plan: Plan,
    loops: Mapping[str, LoopMargins],
    experiment: Experiment | None = None,
    margins: Margins | None = None,
    *,
    simulated: bool = False,
) -> Step:
    """Judge an estimate: found at all, parameters identifiable and known as well as `plan` says, nothing implausible;
    and the loop by its zone. `loops`: controller's margins by name, first on the identified plant, then the expected;
    `experiment`: played, with its promise; `margins`: of the record, drawn; `simulated`: whether no firmware runs,
    which alone tries another loop. Failed residual tests are cautions, as standard deviations allow for them.
    """
    findings: list[str] = []
    reasons: list[str] = []
    cautions: list[str] = []
    numbers: dict[str, float] = {}
    remedy = ""
    if estimate.status != "converged":
        reasons.append(f"the search ended {estimate.status}: check columns, signs and calibrations")
    for p in estimate.parameters:
        if p.role == "fixed":
            continue
        half = (p.ci95[1] - p.ci95[0]) / 2.0
        wide = half / abs(p.value) if p.value else math.inf
        promised = None if experiment is None else experiment.expected.get(p.name)
        told = "" if promised is None else f", expected ± {196.0 * promised.relative_sd:.2g} %"
        findings.append(f"{p.name} = {quantity(p.value, p.sd, p.unit).text} (95 % interval ± {100 * wide:.2g} %{told})")
        numbers |= {p.name: p.value, f"{p.name}_sd": p.sd}
        if not p.identifiable:
            reasons.append(f"{p.name} is not identifiable from this record: excite more, or fix what is known")
        elif wide > plan.widest:
            reasons.append(
                f"{p.name} is known to ± {100 * wide:.2g} % only (limit {100 * plan.widest:g} %, "
                f"{setting('widest')}): record"
                " longer, or excite more"
            )
    for name, check in estimate.checks.items():
        if not check.passed:
            (cautions if name in _RESIDUAL else reasons).append(f"{name}: {check.detail}")
    for loop in list(loops.values())[:1]:
        (findings if loop.stable else cautions).append(f"the loop on this plant: {loop.words()}")
    findings += sensitivity_lines(estimate.sensitivity)
    if not estimate.sensitivity:
        why = "; ".join(w for w in estimate.warnings if "sensitivity" in w) or "[loop] and the estimate do not agree"
        reasons.append(f"the sensitivity at the position is not known, and the loop cannot be judged: {why}")
    for zone in map(Zone.read, estimate.sensitivity.values()):
        numbers |= {"sensitivity_db": zone.value, "sensitivity_upper_db": zone.upper_db}
        against, notes = _by_zone(zone, "" if plan.redesign else _offer(simulated=simulated))
        remedy = "design a better loop, and load that" if against and not reasons else ""
        reasons, cautions = [*reasons, *against], [*cautions, *notes, *_untested(margins)]
    return Step(
        name="identify", findings=tuple(findings), reasons=tuple(reasons), cautions=tuple(cautions), numbers=numbers,
        pictures=(margins_picture(loops, margins),) if loops else (), remedy=remedy,
    )  # fmt: skip


def _offer(*, simulated: bool) -> str:
    again = "" if simulated else f"Commission again with {setting('redesign')}, or d"
    return f". {again or 'D'}esign a better loop on estimate.json"


def _untested(margins: Margins | None) -> list[str]:
    """Say where the predicted peak lies at frequencies that the record does not excite."""
    band = None if margins is None else margins.checks.get("band")
    return [f"band: {band.detail}"] if band is not None and not band.passed else []


def _by_zone(zone: Zone, offer: str) -> tuple[list[str], list[str]]:
    """Return what a loop is refused and warned for by the upper end of its peak's 95 % interval; `offer`: the remedy of
    a warning.
    """
    size = f"{pure(zone.value, zone.sd)} dB, at most {zone.upper_db:.2f} dB (95 %)"
    text = f"the sensitivity at the position, {zone.source} {size}, is in zone {zone.words} of ISO 14839-3"
    if zone.worst in LONG_TERM:
        return [], [] if zone.worst == "A" else [f"{text}: new machines are to be in zone A{offer}"]
    why = "too little margin to run with this loop. Design"
    if zone.letters[0] in LONG_TERM:
        why = (
            f"too little margin to run with this loop is not ruled out. Record longer ({setting('seconds')}), or design"
        )
    return [f"{text}: {why} a better one on estimate.json; the rotor is set down"], []


def redesign(design: Design, estimate: Estimate) -> Step:
    """Judge a designed controller by its verification, always passed; ``better`` 0 leaves the present one. Curvature of
    the `estimate` stops nothing: designs are tried on displaced plants, and on trial.
    """
    curved = all(r.check == "curvature" for r in estimate.verdict.reasons)
    against = [r for r in design.verdict.reasons if not (curved and r.check == "estimate")]
    of = [(name, getattr(design.before.worst, name), getattr(design.after.worst, name)) for name in FIGURES]
    findings = [
        f"{NAMES[name]} {figure_text(name, was)} → {figure_text(name, now)}, predicted worst" for name, was, now in of
    ]
    stays = [f"the present loop stays: {r.check}: {r.text}" for r in against if not design.passed]
    numbers = {"better": float(not stays), "peak": design.after.figures.peak, "peak_before": design.before.figures.peak}
    return Step(
        name="redesign", findings=tuple(findings), cautions=tuple(stays), numbers=numbers,
        pictures=(design_picture(design),),
    )  # fmt: skip


def load(done: Acquired, hover: Step, before: Step, loops: Mapping[str, Margins]) -> Step:
    """Judge the new loop by its record, hovering with it and `before`, and margins by record, the loop before first;
    not passed where the controller did not keep it, or it does not levitate.
    """
    kept = record("record with the new loop", done)
    findings, numbers = list(kept.findings), dict[str, float]()
    for (name, of), when in zip(loops.items(), ("before", "after"), strict=True):
        s = of.sensitivity["x"]
        seen = "" if s.measured is None else f", measured {pure(*s.measured)} dB"
        findings.append(f"{name}: peak of the sensitivity {s.peak_db.value:.2f} dB{seen}, zone {s.rating.words}")
        numbers |= {f"peak_{when}_db": s.peak_db.value}
        numbers |= {} if s.measured_peak_db is None else {f"measured_{when}_db": s.measured_peak_db}
    for role, unit in _UNITS.items() if hover.passed else ():
        was, now = (x.numbers[f"{role}_sd"] for x in (before, hover))
        findings.append(f"{role} while hovering {sized(was, unit)} → {sized(now, unit)} rms")
        numbers |= {f"{role}_sd_before": was, f"{role}_sd_after": now}
    worse = numbers["peak_after_db"] > numbers["peak_before_db"]
    cautions = ("the new loop has a higher peak of the sensitivity than the one before; load rig.toml again",) * worse
    against, notes = _by_zone(loops["after"].sensitivity["x"].rating, "")
    return Step(
        name="load", findings=tuple(findings), reasons=(*kept.reasons, *hover.reasons, *against),
        cautions=(*kept.cautions, *cautions, *notes, *_untested(loops["after"])), numbers=numbers,
        pictures=(measured_picture(loops), *hover.pictures),
    )  # fmt: skip


def validation(estimate: Estimate) -> Step:
    """Judge an `estimate` by its `validation`: not passed where the second record is predicted worse than the first
    allows.
    """
    checks: Mapping[str, Any] = (estimate.validation or {}).get("checks", {})  # type: ignore[assignment]
    findings = tuple(f"{name}: {c['detail']}" for name, c in checks.items() if c["passed"])
    if not checks:
        return Step(name="validate", reasons=("nothing was checked on the second record: it cannot be judged",))
    failed = {name: f"{name}: {c['detail']}" for name, c in checks.items() if not c["passed"]}
    reasons = tuple(text for name, text in failed.items() if name not in _RESIDUAL)
    cautions = tuple(text for name, text in failed.items() if name in _RESIDUAL)
    return Step(name="validate", findings=findings, reasons=reasons, cautions=cautions)


def tracking(done: LiveTrack, limit: float) -> Step:
    """Judge live tracking (`track_live`, with lines): the identified bench runs. Not passed where it ended early, the
    error is beyond the `limit`, or a change was found.
    """
    reasons = list(why_incomplete(done.run, "tracking"))
    summary, lines = done.track.totals, done.track.lines
    if not lines or summary is None:
        return Step(name="track", reasons=tuple(reasons) or ("no line of the track came: track longer",))
    last = lines[-1]
    findings = [
        f"{summary.samples} samples in {summary.seconds_of_record:.3g} s, {summary.rejected_samples} rejected,"
        f" {done.overruns} blocks overrun, model error {last.error:.3g}, state {last.state}"
    ]
    reasons += [f"the tracker saw a change at {change.t:.3g} s: {change.why}" for change in summary.changes]
    if not last.error <= limit:
        reasons.append(
            f"the model error is {last.error:.3g} at the end, beyond {limit:g}: the bench is another one now"
        )
    if done.overruns:
        reasons.append(f"{done.overruns} blocks found the queue full: the machine is too busy to track this rate")
    return Step(
        name="track", findings=tuple(findings), reasons=tuple(reasons), numbers={"error": last.error, "limit": limit}
    )
