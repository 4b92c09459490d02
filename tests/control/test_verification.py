"""A loop on the nonlinear simulator: its small motions are those of the linear model, its large ones have limits."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.control.benches import Answer, workbench
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.drawn import Spread, draw_plants
from ambid.control.verification import Trials, _Trying, checks_of_verifications, verify
from ambid.physics.loop import Limits
from ambid.physics.presets import preset
from ambid.rig.draft import rig_of_preset
from ambid.simulation.rig_bench import Bench
from ambid.simulation.rotor_bench import RotorBench

ONE_AXIS = ("unstable-bearing", "rmit-axis", "levitated-ball", "prototype")


def given(name):
    """Return plant, rig and loop of a preset."""
    rig = rig_of_preset(preset(name))
    if rig.rotor is None:
        bench = Bench.of(rig, None, True)
        of, theta = bench.linear.model, bench.linear.parameters
    else:
        bench = RotorBench.of(rig, None, True)
        of, theta = bench.model, bench.plant.parameters
    delays = np.full(len(of.inputs), bench.loop.delay)
    return Plant(model=of, theta=dict(theta), delays=delays, rate_hz=bench.rate_hz), rig, bench.loop


def kinds(found, kind):
    return [case.passed for case in found.of_kind(kind)]


@pytest.mark.parametrize("name", ONE_AXIS)
@pytest.mark.parametrize("known", [True, False])
def test_the_magnet_linearises_to_the_plants_own_numbers(name, known):
    plant, rig, loop = given(name)
    wrong = {"k_i": 1.07, "k_x": 0.94, "L": 1.12, "R": 0.97, "m": 1.03}
    theta = {n: x * wrong.get(n, 1.0) for n, x in plant.theta.items()}
    rig = rig if known else replace(rig, magnet=None)
    bench = workbench(replace(plant, theta=theta), rig, loop)
    found = bench.body.linearise(bench.rest.position)
    assert found == pytest.approx(theta, rel=1e-9)
    assert "assumed" in bench.assumed[0]
    still = bench.respond(50)
    assert np.abs(still.position).max() < 1e-9 * bench.stops[1]


def test_small_motions_are_those_of_the_linear_model():
    plant, rig, loop = given("unstable-bearing")
    frequency = np.array([40.0])
    closed = ClosedLoop(
        plant=plant, controller=controller_of_loop(loop, plant.model, plant.rate_hz), frequency_hz=frequency
    )
    n, period = 10_000, 500
    bench = workbench(plant, rig, loop)
    turn = 2.0 * np.pi * (np.arange(n) + 0.5) / period  # a force held over a sample is late by half of one
    seen = bench.respond(n, load=1e-4 * np.cos(turn)[:, None]).position[-period:, 0]
    size = 2.0 * abs(np.mean(seen * np.exp(-1j * turn[-period:])))
    assert size / 1e-4 == pytest.approx(abs(closed.compliance[0, 0]), rel=1e-3)
    weak = Trials(force=1e-4, impulse=1e-6)
    of = [verify(plant, rig, loop, trials=weak, nonlinear=x) for x in (True, False)]
    for kind in ("force step", "impact"):
        a, b = (v.of_kind(kind)[0] for v in of)
        assert a.peak == pytest.approx(b.peak, rel=1e-3)


def test_a_steady_force_leaves_no_error_with_an_integrator_and_one_without():
    plant, rig, loop = given("unstable-bearing")
    with_it = verify(plant, rig, loop).of_kind("force step")[0]
    assert with_it.passed
    assert with_it.steady < 0.01 * with_it.peak
    without = verify(plant, rig, replace(loop, ki=0.0), trials=Trials(force=1e-3)).of_kind("force step")[0]
    theta = plant.theta
    stiffness = theta["k_x"] + theta["k_i"] * loop.kp / (theta["R"] + loop.kc)
    assert without.steady == pytest.approx(1e-3 / stiffness, rel=1e-3)
    assert "away" in without.detail


@pytest.mark.parametrize("name", [*ONE_AXIS, "spindle"])
def test_the_presets_lift_off_from_both_stops(name):
    plant, rig, loop = given(name)
    found = verify(plant, rig, loop)
    assert kinds(found, "lift-off") == [True, True]
    assert found.passed
    assert all(case.trace is not None for case in found.cases)


def test_what_fails_is_named_with_its_plant():
    plant, rig, loop = given("rmit")  # its stops are nearer to the pole faces than its current lifts it from
    checks = checks_of_verifications([verify(plant, rig, loop, name="draw 17")])
    assert [name for name, check in checks.items() if not check.passed] == ["lift_off"]
    assert "lift-off from the lower stop on draw 17" in checks["lift_off"].detail
    plant, rig, loop = given("unstable-bearing")
    found = verify(plant, rig, replace(loop, kp=0.5 * loop.kp), name="draw 3")
    assert not found.passed
    assert "on draw 3" in checks_of_verifications([found])["force_step"].detail


def test_limits_act_and_are_counted():
    plant, rig, loop = given("unstable-bearing")
    tight = replace(rig, limits=replace(rig.limits, voltage=(-10.0, 10.0), current=(-0.5, 0.5)))
    cases = verify(plant, tight, loop).of_kind("lift-off")
    assert all(case.saturated > 0.0 and case.over_current > 0.0 and case.peak_command == 10.0 for case in cases)
    assert "the command is limited" in cases[0].detail
    free = verify(plant, replace(rig, limits=Limits(), magnet=None), loop)
    assert not free.of_kind("lift-off")
    assert "nor limits.position is given" in free.assumed[0]


def test_an_unbalance_moves_the_rotor_as_its_compliance_says():
    plant, rig, loop = given("rmit")
    found = verify(plant, rig, loop, trials=Trials(speed=2.0 * np.pi * 50.0, unbalance=2e-6))
    case = next(c for c in found.of_kind("unbalance") if c.name == "static unbalance")
    of = ClosedLoop(
        plant=plant,
        controller=controller_of_loop(loop, plant.model, plant.rate_hz),
        frequency_hz=case.trace.at / (2 * np.pi),
    )
    # each bearing carries half, in phase: the motion is the sum over both of what a force there does
    size = case.trace.position / (1e-6 * case.trace.at**2)
    assert size.size >= 10
    rigid = np.abs(_translation(of))
    assert size == pytest.approx(rigid, rel=0.01)


def _translation(of):
    """Return the displacement of both bearings in plane x by a force of 1 N on each, at each frequency."""
    space, theta = of.plant.space, of.plant.theta
    magnets = of.plant.model.rows(theta)[0]
    n_x = space.A.shape[0]
    s = 2j * np.pi * of.frequency_hz[:, None, None]
    push = space.E[:, [0]] + space.E[:, [2]]
    inside = np.linalg.inv(s * np.eye(n_x) - space.A)
    late = np.exp(-s * (1.5 / of.plant.rate_hz))  # the delay of a sample, and that of holding one
    K = of.K
    whole = np.eye(n_x) + inside @ space.B @ (late * K) @ space.C
    x = np.linalg.solve(whole, inside @ push)
    return (magnets[0] @ x[:, : magnets.shape[1], 0].T).T


def test_fast_eddy_currents_are_a_delay_and_cost_no_time():
    plant, rig, loop = given("unstable-bearing")
    eddies = next(d.plant for d in draw_plants(plant, rig, 20, seed=0, spread=Spread(warm_k=(0, 0))).plants[1:])
    quick, slow = (replace(eddies, theta={**eddies.theta, "a": x * plant.rate_hz}) for x in (2.0, 1.999))
    cases = [verify(x, rig, loop).of_kind("impact")[0] for x in (quick, slow)]
    assert cases[0].peak == pytest.approx(cases[1].peak, rel=5e-3)
    bench = workbench(replace(eddies, theta={**eddies.theta, "a": 1e12}), rig, loop)
    assert bench.loop.delay == pytest.approx(eddies.delays[0], abs=1e-6)
    assert bench.body.eddy_pole == np.inf


def test_what_a_rotor_does_on_its_stop_is_no_contact_and_coming_back_is():
    plant, rig, loop = given("unstable-bearing")
    bench = workbench(plant, rig, loop)
    trying = _Trying(bench=bench, trials=Trials())
    stop, fall = bench.stops[0], np.exp(-np.arange(4000) / 200.0)
    fall[:30] = 1.0
    fall[10:12] = 0.998  # it chatters
    shaken = fall.copy()
    shaken[300] = -1.0  # at the other stop
    for course, passed in ((fall, True), (shaken, False)):
        position = (stop * course)[:, None]
        case = trying.lifted("lift-off", Answer(position, position, position, 0, 0), stop, np.ones(1))
        assert case.passed is passed
        assert case.contact is not passed
