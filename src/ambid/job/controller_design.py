"""The job of a controller's design: an estimate and its rig in, a verified loop out.

Read -> plants drawn -> the present loop on them -> design -> as the controller holds it -> other plants -> judge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from ambid.acquisition.settings import held_by
from ambid.control.closed import Plant
from ambid.control.design import (
    GOALS,
    SAME,
    UNSTABLE,
    Design,
    Examined,
    Goals,
    OverSpeed,
    checks_of,
    curves_of,
    examine,
    hardest,
    noise_of,
    refuse_unheld,
    situation_of,
    verify,
    worst_of,
    worst_plant,
)
from ambid.control.drawn import Draws, Spread, draw_plants, laws_of, magnet_check, over_speeds
from ambid.control.gain_sets import FORMS
from ambid.control.verification import checks_of_verifications, verify_all
from ambid.control.zones import zone_of
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, part_of, silent
from ambid.job.closed_loop import Numbers, plant_of
from ambid.job.data import Clock, RigSource, rig_entry
from ambid.job.loop_margins import given, noise_by_name, of_plant
from ambid.physics.loop import Interval, Loop, Noise
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import by_name, check_whole
from ambid.settings.calls import of_job

_JUDGES = 200  # plants that judge a design
_ROUNDS = 3  # in which the limits are met on the plants that judge too
_TURNED = 5  # plants that are turned at speeds, for the curve
_STEP = 1.5  # settling times over which a force step is drawn


@of_job("design controller")
def design_controller(
    estimate: Numbers | str | Path,
    rig: RigSource | None = None,
    *,
    goals: Sequence[str] = GOALS,
    limits: Mapping[str, float] | None = None,
    spread: Mapping[str, Any] | None = None,
    form: str = "axes",
    filters: int = 0,
    speeds_rpm: tuple[float, float] | None = None,
    plants: int = 60,
    seed: int = 0,
    tick: Tick | None = None,
) -> Design:
    """Tune the controller of an identified bearing, and verify it on plants around the estimate.

    The largest over many plants of each goal, over what the present loop has (of the peak, what zone A allows where
    the present one is higher), is minimised; no figure may become worse, unless a limit says otherwise. The plants
    are drawn by the covariance of the estimate and by what a record does not show: a displaced rotor, another load,
    the delay, eddy currents, a warm coil. Other plants judge.

    Parameters
    ----------
    estimate : Estimate, str or Path
        The plant, as `ambid.identify` finds it.
    rig : Rig, path, dict or TOML text, optional
        With the present ``[loop]``; default: that of the estimate.
    goals : sequence of {"peak", "compliance", "noise", "settling"}
        What is to be small: peak of the sensitivity, displacement by a force, noise of the sensors in the command,
        time in which a force step is settled.
    limits : Mapping[str, float], optional
        Largest values by the same names, in dB, m/N, V rms and s; default: what the present loop has.
    spread : Mapping[str, float], optional
        How far plants are drawn, by the names of `ambid.control.drawn.Spread`; 0 switches a source off.
    form : {"axes", "bearings"}
        Gains of a rotor's PID: the same on all axes, or a set a bearing.
    filters : int
        Around so many of a rotor's lowest bending modes the PID has a filter each, a notch or a phase lead.
    speeds_rpm : (float, float), optional
        Of a rotor, between which the plants turn; default: from rest to the speed of rig or estimate.
    plants : int
        How many the design is tuned over; 200 others judge it.
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
        If no loop meets the limits, or the best has a higher peak than they allow on the plants that judge, by default
        that of the present loop; the message says which one to move, and how far.

    Examples
    --------
    >>> import ambid
    >>> from ambid.rig.draft import rig_of_preset
    >>> rig = rig_of_preset(ambid.preset("rmit-axis"))
    >>> found = ambid.identify(ambid.simulate("rmit-axis", duration=0.5, seed=1), rig)
    >>> design = ambid.design_controller(found, plants=8)
    >>> design.after.worst.peak < design.before.worst.peak
    True
    """
    say, clock = tick or silent, Clock()
    say("read")
    known, bench = given(estimate, rig)
    asked, sources = _ratios(limits), _spread(spread)
    Goals.of(goals, asked, UNSTABLE)  # refuses what it does not know, before anything is drawn
    if bench.loop is None or not bench.loop.closed:
        raise EstimationError("the rig has no [loop]; a design begins with the present controller. Give [loop]")
    check_whole({"plants": plants}, 1)
    check_whole({"seed": seed, "filters": filters})
    if str(form) not in FORMS:
        raise EstimationError(
            f"form {form!r} of gains is unknown: {', '.join(FORMS)}.{nearest(form, list(FORMS))} Give one of them"
        )
    speeds = _speeds(known, bench, speeds_rpm)
    with one_thread():
        problem = _problem(known, bench, sources, plants, seed, speeds)
        found = _designed(problem, form, filters, goals, asked, say, clock)
    return replace(found, timing_s=clock.laps)


@dataclass(frozen=True, kw_only=True)
class _Problem:
    """What a design is for."""

    known: Numbers
    bench: Rig  # as it is given
    rig: Rig  # with the present loop as the controller holds it, and the noise that is taken
    plant: Plant  # with its covariance
    noise: tuple[float, float]
    tuning: Draws
    judging: Draws
    seeds: tuple[int, int]
    speeds: Interval | None  # rad/s
    assumed: str  # of the noise

    @property
    def point(self) -> Mapping[str, float] | None:
        """Where the estimate's record was."""
        return self.known.operating_point if isinstance(self.known, Estimate) else None

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations of the estimated numbers."""
        names, covariance = self.plant.names, self.plant.covariance
        return {} if covariance is None else dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))

    @property
    def present(self) -> Loop:
        """The loop as it is."""
        assert self.rig.loop is not None
        return self.rig.loop


def _speeds(known: Numbers, bench: Rig, given: tuple[float, float] | None) -> Interval | None:
    """Return between which speeds in rad/s the plants turn; None where nothing turns."""
    if given is not None:
        if not isinstance(known, RotorEstimate):
            raise EstimationError("speeds are of a rotor on many axes; the estimate is of one axis. Omit them")
        if not (len(given) == 2 and 0.0 <= given[0] <= given[1] and math.isfinite(given[1])):
            raise EstimationError(f"speeds are {given} rpm; they are zero or positive, the lower first. Correct them")
        return given[0] * math.pi / 30.0, given[1] * math.pi / 30.0
    if not isinstance(known, RotorEstimate) or bench.rotor is None:
        return None
    top = max(abs(bench.rotor.speed), abs(known.speed))
    return (0.0, top) if top else None


def _problem(known: Numbers, bench: Rig, spread: Spread, plants: int, seed: int, speeds: Interval | None) -> _Problem:
    """Return the plants around an estimate, and the present loop on it."""
    sd = known.noise.sensor_sd if isinstance(known, Estimate) else known.noise
    position, current, assumed = noise_of(bench.noise, sd)
    white = replace(bench.noise or Noise(), position=position, current=current, position_resolution=0.0,
                    current_resolution=0.0)  # fmt: skip
    rate, speed = float(str(known.record["rate_hz"])), known.speed if isinstance(known, RotorEstimate) else 0.0
    plant = at_rate(plant_of(known, rate, speed), bench.daq.rate_hz if bench.daq else rate)
    assert bench.loop is not None
    rig = replace(bench, loop=held_by(bench, bench.loop), noise=white)
    point = known.operating_point if isinstance(known, Estimate) else None
    seeds = 2 * seed, 2 * seed + 1
    tuning, judging = (
        draw_plants(plant, rig, n, seed=k, spread=spread, point=point)
        for k, n in zip(seeds, (plants, _JUDGES), strict=True)
    )
    if speeds is not None:
        tuning, judging = over_speeds(tuning, speeds), over_speeds(judging, speeds)
    return _Problem(
        known=known, bench=bench, rig=rig, plant=plant, noise=(position, current), tuning=tuning, judging=judging,
        seeds=seeds, speeds=speeds, assumed=assumed,
    )  # fmt: skip


def _designed(
    problem: _Problem, form: str, filters: int, goals: Sequence[str], limits: Mapping[str, float], say: Tick,
    clock: Clock,
) -> Design:  # fmt: skip
    from ambid.control.tuning import tune_pid

    of, plants = problem, [d.plant for d in problem.tuning.plants]
    refuse_unheld(examine(of.plant, of.present, of.noise).figures, "the estimated plant")
    before = verify(of.tuning.plants, of.present, of.noise, part_of(say, 0.0, 0.3) or silent)
    first = verify(of.judging.plants, of.present, of.noise, part_of(say, 0.3, 1.0) or silent)
    clock.lap("draw")
    asked = Goals.of(goals, limits, worst_of([x.figures for x in before]))
    judged = Goals.of(goals, limits, worst_of([x.figures for x in first]))  # the present loop on the same plants
    for k in range(_ROUNDS):
        try:
            made = tune_pid(plants, of.rig, asked, say, form=form, filters=filters)
        except EstimationError:
            if not k:
                raise
            break  # no loop is as much closer: what there is must do
        loop = held_by(of.bench, made)
        seen = verify(of.judging.plants, loop, of.noise, say)
        closer = judged.closer(asked, worst_of([x.figures for x in seen]))
        if closer is None:
            break
        asked = closer
    clock.lap("design")
    _refuse_worse(judged, first, seen)
    found = _result(of, judged, ((of.present, first), (loop, seen)), made, say)
    clock.lap("verify")
    return found


def _refuse_worse(goals: Goals, before: Sequence[Examined], after: Sequence[Examined]) -> None:
    """Refuse a loop that loses more judging plants than the present one, or whose peak passes its limit on those that
    the present loop holds: one held for the first time is none that got worse.
    """
    from ambid.control.tuning import raised, said

    lost = [sum(not x.figures.stable for x in seen) for seen in (before, after)]
    if lost[1] > lost[0]:
        raise EstimationError(
            f"the best loop found does not hold {lost[1]} of the {len(after)} plants that judge, the present one loses "
            f"{lost[0]}; none is offered. Tune over more plants, lower the spread, or give other goals"
        )
    both = [new.figures for old, new in zip(before, after, strict=True) if old.figures.stable]
    peak, most = worst_of(both).peak, goals.limits["peak"]
    zone, limit = (zone_of(20.0 * math.log10(x)) for x in (peak, most))
    if peak > SAME * most or zone > limit:
        raise EstimationError(
            f"the best loop found has {said('peak', peak)} (zone {zone}) on the plants that judge, above the "
            f"limit of {said('peak', most)} (zone {limit}), by default what the present loop has; none is "
            f"offered. Give the goal peak alone, or {raised('peak', peak)}"
        )


def _result(
    of: _Problem, goals: Goals, loops: tuple[tuple[Loop, Sequence[Examined]], ...], made: Loop, say: Tick
) -> Design:
    """Return the result; `made`: the new loop before rounding, which the controller rounds once."""
    noise = _disturbed(of)
    was, now = (situation_of(seen, of.plant, loop, noise) for loop, seen in loops)
    loop, seen = loops[1]
    worst = worst_plant(of.judging.plants, seen)
    bench = replace(of.bench, noise=of.bench.noise or of.rig.noise)  # with its resolutions
    tried = hardest(of.judging.plants, seen)
    both = {name: x for name, (x, _) in zip(("before", "after"), loops, strict=True)}
    trials = {
        name: verify_all(tried, bench, x, tick=part_of(say, a, a + 0.5) or silent)
        for name, (x, _), a in zip(("before", "after"), loops, (0.0, 0.5), strict=True)
    }
    checks = {**checks_of(goals, was, now, worst, len(seen)), **checks_of_verifications(trials["after"])}
    checks = of_plant(of.known) | checks
    agrees = magnet_check(laws_of(of.plant, of.rig, of.point or of.rig.operating_point)[0], of.plant.theta, of.sd)
    checks |= {} if agrees is None else {"magnet_agrees": agrees}
    turns = of.speeds is not None and of.speeds[1] > of.speeds[0]
    say("speeds")
    curve = (
        OverSpeed.of([d.plant for d in of.judging.plants[:_TURNED]], both, of.speeds) if turns and of.speeds else None
    )
    until = _STEP * max(was.figures.settling, now.figures.settling)
    kept = replace(made, delay=of.bench.loop.delay if of.bench.loop else loop.delay)  # the rig's own, as it says it
    return Design(
        status=of.known.status, model=of.known.model, method="pid", record=of.known.record, goals=goals, before=was,
        after=now, worst_plant=worst, checks=checks, rate_hz=of.plant.rate_hz, trials=trials,
        curves={
            name: curves_of(x, of.plant, loop, until)
            for name, (loop, x) in zip(("before", "after"), loops, strict=True)
        },
        over_speed=curve, rig=rig_entry(replace(of.bench, loop=kept)),
        plants={
            "tuning": len(of.tuning.plants), "verification": len(seen),
            "rejected": of.tuning.rejected + of.judging.rejected, "seeds": list(of.seeds),
            "assumed": [*of.judging.assumed, of.assumed],
        },
    )  # fmt: skip


def _disturbed(of: _Problem) -> dict[str, float] | None:
    """Return the noise of disturbances and outputs by name: as estimated, and as the rig says where nothing is."""
    noise, names = noise_by_name(of.known, of.bench, of.plant)[0], of.plant.model.disturbances
    if isinstance(of.known, Estimate) and of.known.noise.disturbance_sd:
        slower = math.sqrt(of.plant.rate_hz / float(str(of.known.record["rate_hz"])))  # held over a sample, white
        found = {**of.known.noise.disturbance_sd, **of.known.noise.sensor_sd}
        noise = {**(noise or {}), **{n: x * (slower if n in names else 1.0) for n, x in found.items()}}
    return None if noise is None else dict(noise)


def at_rate(plant: Plant, rate_hz: float) -> Plant:
    """Return a plant as a controller of another rate sees it: its delay is one in seconds."""
    return replace(plant, rate_hz=rate_hz, delays=plant.delays * (rate_hz / plant.rate_hz))


def _ratios(limits: Mapping[str, float] | None) -> dict[str, float]:
    """Return limits with that of the peak as a ratio."""
    for name, x in by_name(limits, "limits").items():
        if not isinstance(x, Real):
            raise EstimationError(f"limit {name} is {x!r}; it must be a number. Correct it")
    return {name: 10.0 ** (x / 20.0) if name == "peak" else x for name, x in (limits or {}).items()}


def _spread(given: Mapping[str, Any] | None) -> Spread:
    names = [f.name for f in fields(Spread)]
    for name in by_name(given, "spread"):
        if name not in names:
            known = f"{', '.join(names)}.{nearest(name, names)}"
            raise EstimationError(f"source {name!r} of spread is unknown; known: {known} Give one of them")
    return Spread(**(given or {}))
