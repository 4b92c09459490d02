"""LQG: python-control as peer, separation, delays of a sample's fraction, and the knobs over drawn plants."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest

import ambid
from ambid.control.closed import Plant
from ambid.control.design import Goals, closed_loop_of, examine, noise_of, worst_of
from ambid.control.drawn import draw_plants
from ambid.control.knobs import Family, design_lqg
from ambid.control.lqg import RESIDUAL, SampledPlant, Weights, lqg
from ambid.errors import EstimationError, ModelError
from ambid.estimation.progress import silent
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.rig.draft import rig_of_preset
from ambid.simulation.plant import closed_loop_poles, excited_loop
from ambid.simulation.rotor_bench import RotorBench


def of_preset(name, delay=None):
    bench = ambid.preset(name)
    if bench.rotor is not None:
        turning = RotorBench.of(rig_of_preset(bench), None, True)
        of, theta = turning.model, turning.plant.parameters
    else:
        of, theta = model("one-axis"), bench.parameters
    late = bench.loop.delay if delay is None else delay
    return bench, Plant(model=of, theta=theta, delays=np.full(len(of.inputs), late), rate_hz=bench.rate_hz)


def weights_of(bench):
    return Weights.of(bench.limits, 1000.0 / bench.rate_hz)


def matched(a, b):
    """Largest distance of poles from their partners, over the unit circle."""
    left, worst = list(b), 0.0
    for x in a:
        k = int(np.argmin([abs(x - y) for y in left]))
        worst = max(worst, abs(x - left.pop(k)))
    return worst


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


@pytest.mark.parametrize("name", ["unstable-bearing", "rmit-axis", "prototype", "thesis", "levitated-ball", "utrc"])
def test_gains_and_poles_are_those_of_python_control(name):
    bench, plant = of_preset(name)
    weights, of = weights_of(bench), SampledPlant.of(plant)
    found = lqg(plant, weights, bench.noise, effort=0.5, disturbance=2.0)
    assert found.residual < 1e-11 < RESIDUAL
    n, T, (position, current) = of.A.shape[0], 1.0 / plant.rate_hz, of.kinds
    axes, p = position.size, of.C[position] / weights.position
    A = np.block([[of.A, np.zeros((n, axes))], [T / weights.integral_s * p, np.eye(axes)]])
    B = np.vstack([of.B, np.zeros((axes, of.B.shape[1]))])
    Q = np.eye(n + axes)
    Q[:n, :n] = p.T @ p + of.C[current].T @ of.C[current] / weights.current**2
    K, _, regulator = control.dlqr(A, B, Q, np.eye(B.shape[1]) * (0.5 / weights.command) ** 2)
    assert matched(np.linalg.eigvals(A - B @ found.regulator), regulator) < 1e-8
    force, voltage = bench.noise.held_rms(plant.rate_hz)
    size = [force if d.endswith("force") else voltage for d in plant.model.disturbances]
    driven = 2.0 * np.hstack([of.E * size, of.B * 1e-3 * weights.command])
    sd = np.maximum(of.sensors(bench.noise), 0.0)
    sd[position] = np.maximum(sd[position], 1e-4 * weights.position)
    sd[current] = np.maximum(sd[current], 1e-4 * weights.current)
    unit = np.max(np.abs(driven), axis=1, initial=0.0, keepdims=True)  # python-control solves in the units it is given
    unit[unit == 0.0] = weights.command
    L, _, estimator = control.dlqe(
        of.A * unit.T / unit, driven / unit, of.C * unit.T / sd[:, None], np.eye(driven.shape[1]), np.eye(sd.size)
    )
    L = unit * L / sd
    assert matched(np.linalg.eigvals(of.A @ (np.eye(n) - found.filter @ of.C)), estimator) < 1e-8
    for gain, peer in ((found.regulator, K), (of.A @ found.filter, L)):
        size = np.max(np.abs(peer), axis=int(gain is not found.regulator), keepdims=True)
        assert np.max(np.abs(gain - peer) / np.where(size == 0.0, 1.0, size)) < 1e-7
    closed = np.linalg.eigvals(of.closed(found.law))  # of the loop: those of both, and nothing else
    assert matched(closed, np.concatenate([regulator, estimator])) < 1e-6
    poles = closed_loop_poles(plant.theta, Loop(law=found.law, delay=plant.delays[0]), plant.rate_hz, of=plant.model)
    assert np.abs(poles[0]) == pytest.approx(found.largest_pole, abs=1e-10)


def test_integral_takes_a_constant_force_away():
    bench, plant = of_preset("rmit-axis")
    of, law = SampledPlant.of(plant), lqg(plant, weights_of(bench), bench.noise).law
    z = of.closed(law)
    held = np.linalg.solve(np.eye(z.shape[0]) - z, np.concatenate([10.0 * of.E[:, 0], np.zeros(law.order)]))
    assert abs(held[0]) < 1e-12  # m, at 10 N


def test_states_of_the_filter_see_a_limited_command_and_the_integral_is_tracked_back():
    bench, plant = of_preset("rmit-axis")
    of, law = SampledPlant.of(plant), lqg(plant, weights_of(bench), bench.noise).law
    n = of.A.shape[0]
    np.testing.assert_allclose((law.A - law.windup @ law.C)[:n, n:], 0.0, atol=1e-9 * np.abs(law.A).max())
    assert np.max(np.abs(np.linalg.eigvals(law.A - law.windup @ law.C))) < 1.0


def test_noise_is_nine_times_lower_and_the_loop_stiffer_than_the_pid_of_the_bench():
    bench, plant = of_preset("rmit-axis")
    noise = (bench.noise.position, bench.noise.current)
    family, of = Family(plants=(plant,), noise=noise), SampledPlant.of(plant)
    law = lqg(plant, weights_of(bench), bench.noise).law
    before, after = (family.figures(x) for x in (bench.loop.as_law(plant.rate_hz), law))
    assert before["noise"] / after["noise"] > 8.5
    assert after["compliance"] < 7e-6 < 10e-6 < before["compliance"]
    rng, z, x, w = np.random.default_rng(1), np.zeros(law.order), np.zeros(of.A.shape[0]), []
    for e in rng.standard_normal((20_000, 2)) * noise:  # the same by simulation
        y = of.C @ x + e
        w.append(law.C @ z + law.D @ y)
        z, x = law.A @ z + law.B @ y, of.A @ x + of.B @ w[-1]
    assert np.std(w) == pytest.approx(after["noise"], rel=0.05)


@pytest.mark.parametrize("name", ["prototype", "rmit"])
def test_figures_of_a_family_are_those_of_the_closed_loop(name):
    bench, plant = of_preset(name)
    noise = (bench.noise.position, bench.noise.current)
    family = Family(plants=(plant, replace(plant, delays=plant.delays + 0.4)), noise=noise)
    law = lqg(plant, weights_of(bench), bench.noise, effort=0.5).law
    found, loop = family.figures(law), Loop(law=law)
    seen = worst_of([examine(p, loop, noise).figures for p in family.plants])
    for name, least in (("peak", 0.99), ("compliance", 0.99), ("noise", 0.99)):
        assert least < found[name] / getattr(seen, name) < 1.01
    assert family.poles(law).max() == pytest.approx(math.exp(-seen.pole / plant.rate_hz), rel=1e-9)
    commands = closed_loop_of(family.plants[1], loop, family.frequency_hz).at_commands
    assert family.peaks(law)[1][1] == pytest.approx(np.abs(commands).max(), rel=1e-6)


def goals_of(plants, rig, loop, **limits):
    """Low noise, all else as a loop has it."""
    worst = worst_of([examine(p, loop, noise_of(rig.noise, {})[:2]).figures for p in plants])
    return Goals.of(("noise",), limits, worst)


@pytest.fixture(scope="module")
def prototypes():
    bench, plant = of_preset("prototype")
    rig = rig_of_preset(bench)
    return rig, plant, tuple(d.plant for d in draw_plants(plant, rig, 8, seed=1).plants)


def test_knobs_keep_the_limits_on_all_drawn_plants(prototypes):
    rig, plant, drawn = prototypes
    goals = goals_of(drawn, rig, rig.loop, peak=3.0)
    loop = design_lqg(drawn, rig, goals, silent)
    found = worst_of([examine(p, loop, noise_of(rig.noise, {})[:2]).figures for p in drawn])
    assert not goals.missed(found)
    assert found.noise < 0.8 * goals.reference["noise"]
    alone = Family(plants=drawn).figures(lqg(plant, weights_of(ambid.preset("prototype")), rig.noise).law)
    assert alone["peak"] > 3.0  # LQG has no margins by itself
    tight = replace(goals, limits={"peak": 1.3, "settling": 9.0})
    with pytest.raises(EstimationError, match=r"no LQG law meets the limits .*is the least. Give limits={'peak': "):
        design_lqg(drawn[:2], rig, tight, silent)
    with pytest.raises(EstimationError, match=r"gives no \[limits\]"):
        design_lqg(drawn, replace(rig, limits=None), goals, silent)


def test_a_law_is_designed_and_verified_as_a_pid_is(tmp_path, monkeypatch):
    monkeypatch.setattr("ambid.job.controller_design._JUDGES", 8)
    rig = rig_of_preset(ambid.preset("rmit-axis"))
    known = ambid.identify(ambid.simulate("rmit-axis", duration=0.3, seed=1), rig)
    found = ambid.design_controller(known, rig, method="lqg", plants=8)
    assert found.after.unstable == 0
    assert found.after.worst.peak < 0.85 * found.before.worst.peak
    assert found.after.worst.compliance < 0.5 * found.before.worst.compliance
    assert found.after.worst.noise < found.before.worst.noise
    assert found.loop.law is not None
    found.save(tmp_path / "design.json")
    assert "state-space" in (tmp_path / "design.json").read_text()
    system = found.to_control()
    f = np.array([10.0, 300.0])
    np.testing.assert_allclose(
        [system(np.exp(2j * np.pi * x / found.rate_hz))[0] for x in f], found.loop.law.response(f)[:, 0], rtol=1e-9
    )


def test_what_cannot_be_designed_is_refused():
    bench, plant = of_preset("prototype")
    with pytest.raises(ModelError, match=r"limits\.position is not given"):
        Weights.of(Limits(voltage=(-1.0, 1.0)), 0.1)
    with pytest.raises(ModelError, match=r"noise\.current is not given"):
        lqg(plant, Weights(position=1e-3, command=10.0), Noise(position=1e-6))
    dead = replace(plant, theta={**plant.theta, "k_i": 0.0})
    with pytest.raises(EstimationError, match="do not reach"):
        lqg(dead, weights_of(bench), bench.noise)
