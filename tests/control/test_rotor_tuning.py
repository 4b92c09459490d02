"""Gains of rotors: forms that are the same law, exact slopes, and a tuned loop that holds other plants and speeds."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.control.benches import workbench
from ambid.control.closed import Plant
from ambid.control.controller import controller_of_loop
from ambid.control.design import GOALS, Goals, examine, noise_of, worst_of
from ambid.control.drawn import draw_plants, over_speeds
from ambid.control.gain_sets import FORMS, GainSets, Loops, SampledPlant, form_of
from ambid.control.tuning import tune_pid
from ambid.errors import EstimationError
from ambid.estimation.progress import silent
from ambid.physics.loop import Limits, Loop
from ambid.rig.draft import rig_of_preset
from ambid.simulation.plant import excited_loop
from ambid.simulation.rotor_bench import RotorBench
from tests.control.laws import of_preset


def bench_of(name):
    rig = rig_of_preset(ambid.preset(name))
    of = RotorBench.of(rig, None, True)
    n = len(of.model.inputs)
    return rig, Plant(
        model=of.model, theta=of.plant.parameters, delays=np.full(n, rig.loop.delay), rate_hz=of.rate_hz
    )  # fmt: skip


@pytest.fixture(scope="module")
def turning():
    return bench_of("spindle")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("filters", [0, 1])
def test_equal_gains_are_the_decentralised_loop_in_every_form(turning, form, filters):
    rig, plant = turning
    sets = GainSets.of(rig.loop, plant.model, plant.rate_hz, form_of(plant.model, form), filters)
    law = sets.law(sets.at(rig.loop, (2500.0,) * filters))
    f = np.geomspace(0.5, 0.49 * plant.rate_hz, 40)
    same, found = (controller_of_loop(x, plant.model, plant.rate_hz).response(f)[0] for x in (rig.loop, Loop(law=law)))
    np.testing.assert_allclose(found, same, atol=1e-12 * np.abs(same).max())


def test_slopes_of_rotors_are_exact(turning):
    rig, plant = turning
    plants = [d.plant for d in draw_plants(plant, rig, 2, seed=3).plants]
    sets = GainSets.of(rig.loop, plant.model, plant.rate_hz, form_of(plant.model, "bearings"), 1)
    at = sets.at(rig.loop, (2500.0,))
    loops = Loops(plants=plants, noise=noise_of(rig.noise, {})[:2], sets=sets, around=at)
    at = at + 0.05 * np.sin(np.arange(at.size))
    (figures, slopes), (decays, falls) = loops.figures(at), loops.decays(at, integrates=True)
    for plant_of, found, decay in zip(plants, figures, decays, strict=True):
        alone = examine(plant_of, sets.loop(at, rig.loop), loops.noise).figures
        np.testing.assert_allclose(np.exp(found), [alone.peak, alone.compliance, alone.noise], rtol=0.03)
        assert decay <= alone.pole * 1.001
    for j in range(0, at.size, 3):
        step = 1e-6 * np.eye(at.size)[j]
        (high, fast), (low, slow) = (
            (loops.figures(at + s)[0], loops.decays(at + s, integrates=True)[0]) for s in (step, -step)
        )
        np.testing.assert_allclose(slopes[..., j], (high - low) / 2e-6, atol=1e-6 * np.abs(slopes).max())
        np.testing.assert_allclose(falls[:, j], (fast - slow) / 2e-6, atol=1e-3 * np.abs(falls).max())


def test_a_tuned_rotor_is_better_on_other_plants_and_speeds(turning):
    rig, plant = turning
    noise, speeds = noise_of(rig.noise, {})[:2], (0.0, plant.model.speed)
    tuning, judging = (over_speeds(draw_plants(plant, rig, n, seed=k), speeds) for k, n in ((0, 6), (1, 5)))
    plants = [d.plant for d in tuning.plants]
    assert [p.model.speed for p in plants[:3]] == [speeds[1], speeds[1], 0.0]
    before = worst_of([examine(p, rig.loop, noise).figures for p in plants])
    loop = tune_pid(plants, rig, Goals.of(GOALS, {}, before), silent, form="bearings")
    found = [[examine(d.plant, x, noise).figures for d in judging.plants] for x in (rig.loop, loop)]
    assert all(f.stable for f in found[1])
    was, now = map(worst_of, found)
    assert now.peak < 0.8 * was.peak
    assert now.compliance < was.compliance
    assert now.noise < 1.02 * was.noise


def test_what_an_estimate_does_not_show_is_refused():
    rig, plant = bench_of("rmit")
    draws = draw_plants(plant, rig, 2, seed=0)
    with pytest.raises(EstimationError, match="does not know Ip"):
        over_speeds(draws, (0.0, 500.0))
    with pytest.raises(EstimationError, match="has 0 bending modes"):
        tune_pid([plant], rig, Goals.of(GOALS, {}, examine(plant, rig.loop, (1e-7, 0.0)).figures), silent, filters=1)


def test_a_rotor_without_a_stop_is_tried_on_linear_magnets():
    rig, plant = bench_of("rmit")
    rig = replace(rig, limits=Limits(), magnet=None)
    found = workbench(plant, rig, rig.loop)
    assert "neither a gap nor limits.position" in found.assumed[0]
    load = np.zeros((50, 4))
    load[:, 0] = 1.0
    assert np.isfinite(found.respond(50, load=load).position).all()


def test_a_loop_goes_on_where_it_stopped():
    rig = rig_of_preset(ambid.preset("central-mass"))
    of = RotorBench.of(rig, None, True)
    load = np.zeros((90, len(of.model.axes)))
    load[:, 0] = 1.0
    silence = np.zeros((90, len(of.model.inputs)))
    law = GainSets.of(rig.loop, of.model, of.rate_hz, form_of(of.model, "axes"))
    law = law.law(law.at(rig.loop))
    for loop in (rig.loop, Loop(law=law, delay=rig.loop.delay)):
        bench = replace(of, rig=replace(rig, noise=None), loop=loop)
        whole = bench.simulate(silence, seed=0, columns=False, load=load).states
        running = bench.begun()
        parts = [
            bench.simulate(silence[k : k + 30], seed=0, columns=False, load=load[k : k + 30], start=running).states
            for k in (0, 30, 60)
        ]
        np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("delay", [0.0, 0.35, 1.0, 1.7, 2.0])
def test_sampled_plant_is_that_of_the_simulation(delay):
    _, plant = of_preset("prototype", delay)
    of = SampledPlant.of(plant)
    z, _, excited = excited_loop(plant.theta, Loop(delay=delay), plant.rate_hz, of=plant.model)
    n = of.A.shape[0]
    np.testing.assert_allclose(of.A, z[:n, :n], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(of.B[:, 0], excited[:n], rtol=1e-12)


def test_inputs_may_be_late_by_different_times():
    _, plant = of_preset("rmit")
    plant = replace(plant, delays=np.array([0.0, 0.4, 1.0, 1.6]))
    of, f = SampledPlant.of(plant), np.geomspace(1.0, 9000.0, 30)
    z = np.exp(2j * np.pi * f / plant.rate_hz)[:, None, None] * np.eye(of.A.shape[0])
    found = of.C @ np.linalg.solve(z - of.A, np.broadcast_to(of.B + 0j, (f.size, *of.B.shape)))
    rows = [plant.model.outputs.index(f"{a}_{x}") for a in plant.axes for x in ("position", "current")]
    np.testing.assert_allclose(found, plant.sampled(f).transfer()[:, rows], rtol=1e-7, atol=1e-12)
