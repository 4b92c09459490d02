"""The job of a loop's margins: a record, an estimate of its plant, or both in; what the loop can bear out.

Read -> identify, or take an estimate -> controller -> closed loop -> judge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ambid.control.closed import ClosedLoop, Plant
from ambid.control.margins import (
    QUANTITIES,
    Disk,
    Margins,
    Vibration,
    checks_of,
    compliance_by_axis,
    curves_of,
    margins_by_axis,
    role_of,
    room_by_axis,
    sensitivity_by_axis,
    speeds_of,
    synchronous,
)
from ambid.control.zones import zone_of
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import Check, Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.closed_loop import Numbers, loop_of, measure, refuse_unstable, spectra_of
from ambid.job.data import Clock, Reading, RigSource, Source, known_rig, load_bench, origin, rig_entry
from ambid.job.rotor import balance_planes
from ambid.physics.linear_model import model
from ambid.physics.loop import UNLIMITED
from ambid.physics.rotor_model import RotorModel, position_role
from ambid.record import GapPolicy, Record
from ambid.rig import Rig
from ambid.rotor.balance import Machine
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.synchronous import Separated, separate
from ambid.settings.caller import saved, setting
from ambid.settings.calls import of_job
from ambid.simulation.rotor_bench import kind_of


@of_job("margins")
def margins(
    record: Source | Numbers,
    rig: RigSource | None = None,
    *,
    estimate: Numbers | str | Path | None = None,
    reference: str | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> Margins:
    """Say how much margin the loop of a record has: sensitivity by ISO 14839-3, gain, phase, delay, compliance.

    The plant is that of an estimate. The controller is identified from the record where an excitation is logged as
    reference, else it is the rig's ``[loop]``, as for an estimate alone.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays; Estimate, RotorEstimate or its .json file
        Of the levitated rotor. Of an estimate alone nothing is measured.
    rig : Rig, path, dict or TOML text, optional
        What is known of the bench; default: that of the estimate, else as `ambid.identify`.
    estimate : Estimate, RotorEstimate, str or Path, optional
        The plant; default: identified from the record first.
    reference : str, optional
        Of one axis: column of the excitation, in any unit; default: the rig's ``[channels.reference]``, if any.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Margins

    Raises
    ------
    AmbidError
        If record, rig or estimate break a rule.
    EstimationError
        If no loop is closed, or nothing says what its controller is.

    Examples
    --------
    >>> import ambid
    >>> from ambid.rig.draft import rig_of_preset
    >>> rig = rig_of_preset(ambid.preset("rmit-axis"))
    >>> found = ambid.margins(ambid.simulate("rmit-axis", duration=0.5, seed=1), rig)
    >>> found.sensitivity["x"].zone, found.verdict.word
    ('A', 'usable')
    """
    say, clock, source = tick or silent, Clock(), cast(Source, record)
    reading = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    used: Record | None = None
    if isinstance(record, Numbers) or (isinstance(record, str | Path) and Path(record).suffix == ".json"):
        if estimate is not None or reference is not None or any(x is not None for x in reading.values()):
            raise EstimationError(
                f"margins of an estimate alone take nothing but the rig; {setting('estimate')}, "
                f"{setting('reference')}, {setting('from_s')}, {setting('to_s')}, {setting('rate_hz')}, "
                f"{setting('gaps')}, {setting('layout')} and units are of a record. Omit them, or give a record"
            )
        known, bench = given(record, rig)
        bench = replace(bench, open_loop=False)  # so were its records; here its [loop] is closed
    elif estimate is None:
        from ambid.job.identification import identify

        bench = known_rig(rig)
        known = identify(source, bench, tick=say, **reading)
        taken: Any = known.used
        used = taken[0] if isinstance(taken, tuple) else taken
    else:
        known, bench = given(estimate, rig)
        say("read")
        used = load_bench(source, bench, **reading)
    if reference is not None:
        used = _with_reference(load_bench(source, bench, beside=(reference,), **reading), bench, reference)
    clock.lap("identify")
    say("margins")
    with one_thread():
        found, _ = margins_and_loop(known, bench, used)
    clock.lap("margins")
    return replace(found, timing_s=clock.laps, rig=rig_entry(bench))


def margins_beside(estimate: Numbers, used: Any) -> Margins | None:
    """Return the margins of an estimate's loop for its page, None where they cannot be said; `used`: its record, of a
    rotor one or several; None: the margins of the model.
    """
    from ambid.job.results import rig_of

    if not estimate.sensitivity:
        return None
    taken = used if isinstance(used, tuple) else (used,)
    k = 0
    if isinstance(estimate, RotorEstimate) and len(taken) == len(estimate.records):
        k = max(range(len(taken)), key=lambda m: abs(float(str(estimate.records[m]["speed"]))))
    try:
        with one_thread():
            return margins_and_loop(estimate, rig_of(estimate, "the estimate"), taken[k])[0]
    except AmbidError:
        return None


def _with_reference(bench: Record, rig: Rig, column: str) -> Record:
    """Return a record of one axis whose excitation is a column of its own."""
    if rig.rotor is not None:
        raise EstimationError(
            f"{setting('reference')} is of one axis; of a rotor the rig names the reference of each axis. Give "
            "[channels.<axis>_reference] and omit it"
        )
    others = [c for c in bench.channels if c.name not in ("reference", column)]
    return replace(bench, channels=(*others, replace(bench.channel(column), name="reference")))


def given(estimate: Any, rig: RigSource | None) -> tuple[Numbers, Rig]:
    """Return an estimate that is given, and the rig: its own unless another is given."""
    from ambid.job.results import load_result, rig_of

    name = Path(estimate).name if isinstance(estimate, str | Path) else "the estimate"
    known = load_result(estimate) if isinstance(estimate, str | Path) else estimate
    if not isinstance(known, Estimate | RotorEstimate):
        raise EstimationError(
            f"{name} is no linear estimate of a bearing or a rotor, and a loop is judged on a linear plant. Give "
            f"{saved('identify')}, without {setting('identify_nonlinear')}"
        )
    bench = known_rig(rig) if rig is not None else rig_of(known, name)
    if (bench.rotor is None) != isinstance(known, Estimate) or bench.model != known.model:
        raise EstimationError(
            f"{name} is of model {known.model!r}, the rig of model {bench.model!r}. Give the estimate's own rig"
        )
    return known, bench


def margins_and_loop(
    estimate: Numbers, rig: Rig, bench: Record | None, apart: Separated | None = None
) -> tuple[Margins, ClosedLoop]:
    """Return the margins of an estimate's loop as a record shows it, None: as the rig says, and the loop itself;
    `apart`: of a rotor, the record without its synchronous part, where it is there already.
    """
    clean, speed = bench, estimate.speed if isinstance(estimate, RotorEstimate) else 0.0
    if bench is not None and isinstance(estimate, RotorEstimate):
        apart = apart or separate(bench, estimate.plant.at_speed(0.0 if rig.rotor is None else rig.rotor.speed))
        clean, speed = apart.record, apart.speed
    plant = model(estimate.model) if isinstance(estimate, Estimate) else estimate.plant
    spectra = None if clean is None else spectra_of(clean, plant, speed)
    record = estimate.record if bench is None else origin(bench)
    loop = loop_of(estimate, rig, float(str(record["rate_hz"])), spectra, speed)
    refuse_unstable(loop, rig)
    measured = measure(loop, clean, spectra)
    found, of = sensitivity_by_axis(loop, measured), loop.controller
    top = int(np.argmax(loop.singular))
    largest, hz = float(20.0 * np.log10(loop.singular[top])), float(loop.frequency_hz[top])
    band = None if spectra is None else (float(spectra.frequency_hz[0]), float(spectra.frequency_hz[-1]))
    checks = checks_of(loop, found, measured, band)
    checks = of_plant(estimate) | checks
    noise, whose = noise_by_name(estimate, rig, loop.plant)
    room = _room(estimate, rig, loop)
    machine = _machine(estimate, rig)
    result = Margins(
        status=estimate.status, model=estimate.model, of="estimate" if bench is None else "record", record=record,
        speed=speed,
        controller={"source": of.source, "order": list(of.orders), "misfit": of.misfit},
        sensitivity=found,
        largest_singular={"peak_db": largest, "frequency_hz": hz, "zone": zone_of(largest)},
        margins=margins_by_axis(loop), compliance=compliance_by_axis(loop), checks=checks,
        curves=curves_of(loop, measured), disk=Disk.of(loop.sensitivity, loop.frequency_hz),
        room=room_by_axis(loop, noise, room, machine), noise=whose,
        vibration=None if machine is None else _vibration(loop, rig, machine, room),
    )  # fmt: skip
    return result, loop


def of_plant(estimate: Numbers) -> dict[str, Check]:
    """Return the check that an estimate does not pass, for what rests on its plant; nothing where it does."""
    reasons = "; ".join(f"{r.check}: {r.text}" for r in estimate.verdict.reasons)
    return {} if estimate.passed else {"estimate": Check(passed=False, detail=f"of the plant: {reasons}")}


def noise_by_name(
    estimate: Numbers, rig: Rig, plant: Plant
) -> tuple[Mapping[str, float] | None, Literal["rig", "estimate"] | None]:
    """Return the noise of the loop by the names of the model, and whose it is: the rig's, else the estimate's."""
    of = plant.model
    if rig.noise is not None:
        force, voltage = rig.noise.held_rms(plant.rate_hz)
        by_kind = {kind: rig.noise.sensor_rms(kind) for kind in ("position", "current")}
        by_kind |= {"force": force, "voltage": voltage}
        return {n: by_kind[kind_of(n)] for n in (*of.disturbances, *of.outputs)}, "rig"
    if isinstance(estimate, RotorEstimate):
        return estimate.noise, "estimate"
    if estimate.noise.disturbance_sd or estimate.noise.sensor_sd:
        return {**estimate.noise.disturbance_sd, **estimate.noise.sensor_sd}, "estimate"
    return None, None


def _room(estimate: Numbers, rig: Rig, loop: ClosedLoop) -> dict[str, float | None]:
    """Return how far each role stands from its nearer limit; None: it has none."""
    stands = {**(estimate.operating_point if isinstance(estimate, Estimate) else {}), **rig.operating_point}
    found: dict[str, float | None] = {}
    for axis in loop.plant.axes:
        for quantity in QUANTITIES:
            role = role_of(loop, axis, quantity)
            low, high = UNLIMITED if rig.limits is None else getattr(rig.limits, quantity)
            room = min(high - stands.get(role, 0.0), stands.get(role, 0.0) - low)
            found[role] = max(room, 0.0) if math.isfinite(room) else None
    return found


def _machine(estimate: Numbers, rig: Rig) -> Machine | None:
    """Return the rotor with the planes of unbalance of the rig; None of one axis, and without its polar moment."""
    if not isinstance(estimate, RotorEstimate):
        return None
    known = all(p.name in estimate.numbers for p in estimate.plant.at_speed(1.0).parameters)
    return Machine.of(estimate, balance_planes(estimate, rig)) if known else None


def _vibration(loop: ClosedLoop, rig: Rig, machine: Machine, room: Mapping[str, float | None]) -> Vibration | None:
    """Return the vibration by unbalance and run-out of the rig; None where it gives neither."""
    of = loop.plant.model
    assert isinstance(of, RotorModel)
    known = [u for u in rig.unbalance if u.name in machine.beside]
    if not known and not rig.runout:
        return None
    force = sum((u.value * np.exp(1j * u.phase) * machine.shape(u.name) for u in known), np.zeros(2 + of.n_modes))
    runout = np.zeros((len(of.outputs), 1), dtype=complex)
    for r in rig.runout:
        for j, k in of.sensors:
            bearing, plane = of.placed[j]
            if bearing.name == r.name and plane < 2:
                turned = np.exp(1j * (r.phase - plane * np.pi / 2.0))
                runout[of.outputs.index(position_role(of.axes[j], k))] = r.value * turned
    f = speeds_of(loop)
    moved = synchronous(loop, machine, f, force[:, None], runout)[:, len(of.inputs) :, 0]
    return Vibration(
        frequency_hz=f, runout=bool(rig.runout),
        clearance=min((x for role, x in room.items() if role.endswith("position") and x is not None), default=None),
        amplitude={of.outputs[k]: np.abs(moved[:, k]) for group in loop.plant.sensors for k in group},
    )  # fmt: skip
