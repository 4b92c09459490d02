"""The job of a controller's design: an estimate and its rig in, a verified loop out.

Read -> plants drawn -> the present loop on them -> design -> as the controller holds it -> other plants -> judge.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ambid.control.closed import Plant
from ambid.control.design import (
    GOALS,
    UNSTABLE,
    Design,
    Goals,
    Method,
    checks_of,
    curves_of,
    examine,
    noise_of,
    refuse_unheld,
    situation_of,
    verify,
    worst_of,
    worst_plant,
)
from ambid.control.drawn import Spread, draw_plants
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import Check, Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, part_of, silent
from ambid.job.closed_loop import Numbers, plant_of
from ambid.job.data import Clock, rig_entry
from ambid.job.loop_margins import given
from ambid.physics.loop import Loop, Noise
from ambid.rig import Rig

_STEP = 1.5  # settling times over which a force step is drawn


def _pid() -> Method:
    from ambid.control.tuning import tune_pid

    return tune_pid


METHODS: Mapping[str, Callable[[], Method]] = {"pid": _pid}
"""By the name that ``method`` takes: what designs is imported when it is asked for."""


def design_controller(
    estimate: Numbers | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    method: str = "pid",
    goals: Sequence[str] = GOALS,
    limits: Mapping[str, float] | None = None,
    spread: Mapping[str, Any] | None = None,
    plants: int = 60,
    judges: int = 200,
    seed: int = 0,
    tick: Tick | None = None,
) -> Design:
    """Design the controller of an identified bearing, and verify it on plants around the estimate.

    The largest over many plants of each goal, over what the present loop has, is minimised; every figure that is no
    goal must not become worse, unless a limit says otherwise. The plants are drawn by the covariance of the estimate
    and by what a record does not show: a displaced rotor, another load, the delay, eddy currents, a warm coil. Other
    plants judge.

    Parameters
    ----------
    estimate : Estimate, str or Path
        The plant, as `ambid.identify` finds it.
    rig : Rig, str or Path, optional
        With the present ``[loop]``; default: that of the estimate.
    method : {"pid"}
        "pid": the present structure, tuned.
    goals : sequence of {"peak", "compliance", "noise", "settling"}
        What is to be small: peak of the sensitivity, displacement by a force, noise of the sensors in the command,
        time in which a force step is settled.
    limits : Mapping[str, float], optional
        Largest values by the same names, in dB, m/N, V rms and s; default: what the present loop has.
    spread : Mapping[str, float], optional
        How far plants are drawn, by the names of `ambid.control.drawn.Spread`; 0 switches a source off.
    plants, judges : int
        How many plants the design is tuned over, and how many judge it.
    seed : int
        Of the plants.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Design
        Its ``new_rig`` is the rig with the new loop.

    Raises
    ------
    AmbidError
        If estimate, rig, goals or limits break a rule.
    EstimationError
        If no loop meets the limits; the message says which one to move, and how far.

    Examples
    --------
    >>> import ambid
    >>> from ambid.rig.preset_rig import rig_of_preset
    >>> rig = rig_of_preset(ambid.preset("rmit-axis"))
    >>> found = ambid.identify(ambid.simulate("rmit-axis", duration=0.5, seed=1), rig)
    >>> design = ambid.design_controller(found, plants=8, judges=8)
    >>> design.after.worst.peak < design.before.worst.peak
    True
    """
    say, clock = tick or silent, Clock()
    say("read")
    known, bench = given(estimate, rig)
    design, asked, sources = _method(method), _ratios(limits), _spread(spread)
    Goals.of(goals, asked, UNSTABLE)  # refuses what it does not know, before anything is drawn
    if bench.loop is None or not bench.loop.closed:
        raise EstimationError("the rig has no [loop]; a design begins with the present controller. Give [loop]")
    for name, x, least in (("plants", plants, 1), ("judges", judges, 1)):
        if x < least:
            raise EstimationError(f"{name} is {x}; it must be at least {least}. Correct it")
    with one_thread():
        found = _designed(known, bench, design, goals, asked, sources, (plants, judges, seed), say, clock)
    return replace(found, method=method, timing_s=clock.laps)


def _designed(
    known: Numbers, bench: Rig, design: Method, goals: Sequence[str], limits: Mapping[str, float], spread: Spread,
    sizes: tuple[int, int, int], say: Tick, clock: Clock,
) -> Design:  # fmt: skip
    plants, judges, seed = sizes
    sd = known.noise.sensor_sd if isinstance(known, Estimate) else known.noise
    position, current, assumed = noise_of(bench.noise, sd)
    rate = float(str(known.record["rate_hz"]))
    present = held_by(bench, bench.loop)
    rig = replace(bench, loop=present, noise=replace(bench.noise or Noise(), position=position, current=current,
                                                     position_resolution=0.0, current_resolution=0.0))  # fmt: skip
    plant = at_rate(plant_of(known, rate), bench.daq.rate_hz if bench.daq else rate)
    noise = (position, current)
    refuse_unheld(examine(plant, present, noise).figures, "the estimated plant")
    point = known.operating_point if isinstance(known, Estimate) else None
    tuning, judging = (draw_plants(plant, rig, n, seed=2 * seed + k, spread=spread, point=point)
                       for k, n in ((0, plants), (1, judges)))  # fmt: skip
    before = verify(tuning.plants, present, noise, part_of(say, 0.0, 0.1) or silent)
    clock.lap("draw")
    asked = Goals.of(goals, limits, worst_of([x.figures for x in before]))
    loop = held_by(bench, design([d.plant for d in tuning.plants], rig, asked, say))
    clock.lap("design")
    seen = [
        verify(judging.plants, x, noise, part_of(say, a, a + 0.5) or silent) for x, a in ((present, 0.0), (loop, 0.5))
    ]
    was, now = (situation_of(x, plant, of) for x, of in zip(seen, (present, loop), strict=True))
    worst = worst_plant(judging.plants, seen[1])
    judged = Goals.of(goals, limits, was.worst)  # what is compared with the present loop, on the same plants
    checks = checks_of(judged, was, now, worst, judges)
    if not known.passed:
        reasons = "; ".join(f"{r.check}: {r.text}" for r in known.verdict.reasons)
        checks = {"estimate": Check(passed=False, detail=f"of the plant: {reasons}"), **checks}
    until = _STEP * max(was.figures.settling, now.figures.settling)
    curves = {name: curves_of(x, plant, of, until)
              for name, x, of in zip(("before", "after"), seen, (present, loop), strict=True)}  # fmt: skip
    clock.lap("verify")
    return Design(
        status=known.status, model=known.model, method="", record=known.record, goals=judged, before=was, after=now,
        worst_plant=worst, checks=checks, curves=curves,
        rig=rig_entry(replace(bench, loop=_kept(loop, bench.loop))), rate_hz=plant.rate_hz,
        plants={
            "tuning": plants, "verification": judges, "rejected": tuning.rejected + judging.rejected,
            "seeds": [2 * seed, 2 * seed + 1], "assumed": [*judging.assumed, assumed],
        },
    )  # fmt: skip


def _kept(loop: Loop, present: Loop | None) -> Loop:
    """Return the new loop with the delay that the rig says."""
    return loop if present is None else replace(loop, delay=present.delay)


def held_by(rig: Rig, loop: Loop | None) -> Loop:
    """Return a loop as the rig's controller holds it in fixed point; as it is where there is no ``[daq]``."""
    assert loop is not None
    if rig.daq is None or loop.law is not None:
        return loop
    from ambid.acquisition.default_daq import with_default_daq
    from ambid.acquisition.settings import controller_settings, realised

    full = replace(with_default_daq(rig), loop=loop)
    return replace(realised(controller_settings(full), full), delay=loop.delay)


def at_rate(plant: Plant, rate_hz: float) -> Plant:
    """Return a plant as a controller of another rate sees it: its delay is one in seconds."""
    return replace(plant, rate_hz=rate_hz, delays=plant.delays * (rate_hz / plant.rate_hz))


def _method(name: str) -> Method:
    if name not in METHODS:
        known = f"{', '.join(METHODS)}.{nearest(name, list(METHODS))}"
        raise EstimationError(f"method {name!r} of a design is unknown; known: {known} Give one of them")
    return METHODS[name]()


def _ratios(limits: Mapping[str, float] | None) -> dict[str, float]:
    """Return limits with that of the peak as a ratio."""
    return {name: 10.0 ** (x / 20.0) if name == "peak" else x for name, x in (limits or {}).items()}


def _spread(given: Mapping[str, Any] | None) -> Spread:
    names = [f.name for f in fields(Spread)]
    for name in given or {}:
        if name not in names:
            known = f"{', '.join(names)}.{nearest(name, names)}"
            raise EstimationError(f"source {name!r} of spread is unknown; known: {known} Give one of them")
    return Spread(**(given or {}))
