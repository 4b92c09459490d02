"""The job of accepting a machine: records at rest, at speed and of run-ups in, its items by ISO 14839 and API 617 out.

Read -> identify the machine, or take an estimate -> its loop in each record -> items, each beside its limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ambid.control.acceptance import PARTS, Acceptance, Item, Run, Stiffness, dynamic_stiffness, whirl_lines
from ambid.control.closed import ClosedLoop
from ambid.control.margins import Margins
from ambid.errors import AmbidError, EstimationError, counted
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.acceptance_items import Machine, benches_of, items_of
from ambid.job.data import Clock, Reading, RigSource, Source, known_rig, origin, rig_entry, sources_of
from ambid.job.loop_margins import given, margins_and_loop
from ambid.job.rotor import identify_rotor, read_records
from ambid.record import GapPolicy
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.passage import Passage
from ambid.rotor.whirl_points import whirl_points
from ambid.settings.caller import setting
from ambid.settings.calls import of_job

_RPM = 30.0 / math.pi
_FREQUENCIES = 200
_SPEEDS, _BEYOND = 25, 1.1  # of the whirl
_BLOCKS = 400  # of a run-up that are drawn
_ABOVE = 1.05  # of the speed, up to which stiffness is drawn at least


@of_job("accept")
def accept(
    records: Source | Sequence[Source],
    rig: RigSource | None = None,
    *,
    estimate: RotorEstimate | str | Path | None = None,
    speed_rpm: float | Sequence[float] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> Acceptance:
    """Say what a machine on magnetic bearings shows of ISO 14839-2, ISO 14839-3 and API 617, item by item.

    A record is recognised by what it holds: at rest, at a speed, or of a run-up or coast-down by their speed. An item
    that no record shows names the record that would.

    Parameters
    ----------
    records : file, Record, DataFrame, Dataset or dict of arrays, or several of them
        Of one rotor on magnetic bearings; at rest and at speed with periodic excitation, run-ups without.
    rig : Rig, path, dict or TOML text, optional
        What is known of the machine, with ``[operation]``; default: that of the estimate.
    estimate : RotorEstimate, str or Path, optional
        The machine; default: identified from the records at rest and at speed.
    speed_rpm : float or sequence of float, optional
        Speed of each record in rpm; default: as its angle or speed, or the rig, says.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Acceptance

    Raises
    ------
    AmbidError
        If records, rig or estimate break a rule.
    EstimationError
        If it is no rotor on many axes, or the machine cannot be identified.
    """
    say, clock = tick or silent, Clock()
    reading = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    of_machine: Any = None
    if estimate is not None:
        of_machine, bench = given(estimate, rig)
    else:
        bench = known_rig(rig)
    if bench.rotor is None:
        raise EstimationError(
            f"a machine is accepted on many axes; the rig's model is {bench.model!r}, of one axis. Give the rig of a "
            f"rotor, with [bearings.X], or use 'ambid margins'"
        )
    _refuse_wide(bench)
    readings = read_records(sources_of(records), bench, speed_rpm, say, **reading)
    benches = benches_of(readings, bench.rotor)
    clock.lap("read")
    if of_machine is None:
        steady = [b for b in benches if b.kind in ("rest", "speed")]
        chosen = [b for b in steady if b.apart is not None and b.apart.excitation is not None] or steady[:1]
        if not chosen:
            raise EstimationError(
                "the machine is identified from a record at rest or at a speed, with excitation; none of these is one. "
                f"Give one, or {setting('estimate')}"
            )
        speeds = [b.speed * _RPM for b in chosen]
        apart = [b.apart for b in chosen if b.apart is not None]
        of_machine = identify_rotor([b.record for b in chosen], bench, speed_rpm=speeds, tick=say, apart=apart)
    clock.lap("identify")
    say("items")
    with one_thread():
        said = [text for r in readings for text in r.warnings]
        for r, b in zip(readings, benches, strict=True):
            said += b.apart.warnings(b.name, r.speed or 0.0) if b.apart is not None else []
        result = _acceptance(Machine(of_machine, bench, benches), said, clock)
    clock.lap("items")
    return replace(result, timing_s=clock.laps, used=tuple(b.record for b in benches))


def _refuse_wide(rig: Rig) -> None:
    """Refuse a clearance that the air gap of the magnets does not leave."""
    gap = None if rig.magnet is None else rig.magnet.known("s")
    own = None if rig.operation is None else rig.operation.touch_down
    if gap is not None and gap.value and own is not None and own > gap.value:
        raise EstimationError(
            f"operation.touch_down is {1e6 * own:.4g} um, wider than the air gap of the magnets, "
            f"{1e6 * gap.value:.4g} um: the rotor would lie on them. Correct one of the two"
        )


def _acceptance(machine: Machine, warnings: list[str], clock: Clock) -> Acceptance:
    e, loops = machine.estimate, dict[str, tuple[Margins, ClosedLoop]]()
    excited = [b for b in machine.steady if b.apart is not None and b.apart.excitation is not None]
    for b in excited or machine.steady:
        try:
            loops[b.name] = margins_and_loop(e, machine.rig, b.record, b.apart)
        except AmbidError as error:
            warnings.append(f"{b.name}: no sensitivity: {error}")
    clock.lap("margins")
    loop = None
    if loops:
        fastest = max((b for b in machine.steady if b.name in loops), key=lambda b: abs(b.speed))
        loop = loops[fastest.name][1]
    margins = {name: m for name, (m, _) in loops.items()}
    items = items_of(machine, margins, loop)
    warnings += [] if machine.resonances is None else machine.resonances.warnings
    own = {"touch_down": machine.operation.touch_down}
    if any(b.axial for b in e.plant.bearings):
        own["axial_touch_down"] = machine.operation.axial_touch_down
    warnings += [
        f"the {'clearance along the shaft' if 'axial' in key else 'radial clearance'} is that of "
        f"loop.limits.position: give operation.{key} in the rig, as the touch-down bearings have it"
        for key, value in own.items() if value is None and machine.rig.position_limit is not None
    ]  # fmt: skip
    return Acceptance(
        status=e.status, model=e.model, record=origin(machine.benches[0].record),
        records=tuple({**origin(b.record), "file": b.name, "kind": b.kind, "speed": b.speed} for b in machine.benches),
        items=tuple(items), checks=_checks(machine, items, margins), margins=margins,
        stiffness=None if loop is None else _curves(machine, loop), estimate=e, clearance=machine.rig.clearance,
        runs=tuple(_run(name, p) for name, p in machine.passages.items()),
        points=tuple(x for b in machine.steady if b.apart is not None for x in whirl_points(b.apart, e.plant)),
        whirl=None if loop is None else whirl_lines(loop, np.linspace(0.0, _BEYOND * machine.fastest, _SPEEDS)),
        speeds=machine.speeds, calibration=_calibration(machine.rig), warnings=tuple(warnings),
        rig=rig_entry(machine.rig),
    )  # fmt: skip


def _checks(machine: Machine, items: Sequence[Item], margins: Mapping[str, Margins]) -> dict[str, Check]:
    """Judge each part by its items, what cannot be seen, and the estimate of the machine, by itself and by what the
    records show of their loop.
    """
    checks = dict[str, Check]()
    for part, title in PARTS.items():
        own = [x for x in items if x.part == part and x.outcome in ("passed", "doubt", "failed")]
        against = [x for x in own if x.outcome != "passed"]
        worst = max(against, key=lambda x: (x.outcome == "failed", x.confirmed), default=None)
        if worst is not None:
            said = f"{worst.what}{f', {worst.words}' if worst.words else ''}"
            passes = "does not keep its limit" if worst.outcome == "failed" else "may not keep its limit"
            more = f", and {counted(len(against) - 1, 'other item')}" if len(against) > 1 else ""
            source = "" if worst.confirmed else "; the limit is unconfirmed"
            detail = f"{said} {passes}{more}{source}. See '{title}'"
            checks[part] = Check(passed=False, detail=detail, grave=worst.outcome == "failed" and worst.confirmed)
        elif own:
            checks[part] = Check(passed=True, detail=f"{counted(len(own), 'item')} within the limits")
    missing = [x for x in items if x.outcome == "missing"]
    checks["complete"] = Check(
        passed=not missing,
        detail="every item is seen in these records" if not missing else
        f"{counted(len(missing), 'item')} cannot be seen in these records: {'; '.join(x.what for x in missing)}. "
        "Each says which record would show it",
    )  # fmt: skip
    e = machine.estimate
    reasons = "; ".join(f"{r.check}: {r.text}" for r in e.verdict.reasons)
    checks["estimate"] = Check(
        passed=e.passed,
        detail=f"of the machine: {reasons}" if reasons else "the estimate of the machine is usable",
        grave=e.verdict.word == "unusable",
    )
    unlike = [
        f"{name}: {c.detail}" for name, m in margins.items() for c in [m.checks.get("agreement")] if c and not c.passed
    ]
    if unlike:
        checks["agreement"] = Check(passed=False, detail="; ".join(unlike))
    return checks


def _calibration(rig: Rig) -> dict[str, str]:
    """Say what is known of the calibration of the channels; those of which the same is said stand together."""
    alike = dict[str, list[str]]()
    for c in rig.channels:
        words = ["as recorded" if c.calibration is None else str(c.calibration.source or "gain and offset of the rig")]
        words.append("its error is not given" if c.gain_sd is None else f"gain known to {100.0 * c.gain_sd:.2g} %")
        alike.setdefault(", ".join(words), []).append(c.role)
    return {", ".join(roles): said for said, roles in alike.items()}


def _run(name: str, passage: Passage) -> Run:
    """Thin a run-up for its figures."""
    keep = np.unique(np.linspace(0, passage.speed.size - 1, _BLOCKS).round().astype(int))
    amplitude = {role: passage.amplitude[keep, k] for k, role in enumerate(passage.roles)}
    return Run(record=name, speed=passage.speed[keep], amplitude=amplitude)


def _curves(machine: Machine, loop: ClosedLoop) -> Stiffness:
    """Return the dynamic stiffness of the bearings over frequency."""
    rate = loop.plant.rate_hz
    top = max(_ABOVE * machine.speeds[1] / (2.0 * np.pi), 0.1 * rate)
    f = np.geomspace(1e-4 * rate, min(top, 0.49 * rate), _FREQUENCIES)
    D = dynamic_stiffness(loop.at(f))
    axes = loop.plant.axes
    return Stiffness(
        frequency_hz=f, real={a: D[:, j].real for j, a in enumerate(axes)},
        imaginary={a: D[:, j].imag for j, a in enumerate(axes)},
    )  # fmt: skip
