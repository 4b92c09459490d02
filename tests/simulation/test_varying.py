"""A bench that changes while it runs: against the stationary simulator, brute force, energy and analytic responses."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.linear_model import discretise, model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.presets import preset, preset_names
from ambid.simulation import (
    LinearPlant,
    Schedule,
    Unbalance,
    Variation,
    closed_loop_matrix,
    simulate,
)
from ambid.simulation.bench import VaryingLoop

BEARING = preset("unstable-bearing")
PLANT = LinearPlant(model=model("one-axis"), parameters=BEARING.parameters)
THESIS = LinearPlant(model=model("one-axis"), parameters=preset("thesis").parameters)
ROTOR = LinearPlant(model=model("rotor"), parameters={"m": 1.5, "k_x": 4e4, "k_i": 20.0, "c": 90.0})
RATE = 20_000.0
STANDS = {"rate_hz": RATE, "loop": BEARING.loop, "limits": BEARING.limits, "noise": BEARING.noise}


def excite(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def changed(plant: LinearPlant, **values: float) -> LinearPlant:
    return LinearPlant(model=plant.model, parameters={**plant.parameters, **values})


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.3])
def test_nothing_varying_is_the_stationary_simulation_bit_for_bit(delay: float) -> None:
    noise = replace(BEARING.noise, position_resolution=1e-8, current_resolution=1e-3, voltage_resolution=0.01)
    stands = {**STANDS, "loop": replace(BEARING.loop, delay=delay), "noise": noise}
    u = 20.0 * excite(3000)
    plain = simulate(PLANT, u, seed=7, **stands)
    varying = simulate(PLANT, u, variation=Variation(), seed=7, **stands)
    assert np.array_equal(varying.states, plain.states)
    for name in ("voltage", "current", "position"):
        assert np.array_equal(varying.record[name], plain.record[name])
    for name in ("first_contact", "first_saturated", "n_saturated", "n_over_current", "largest_pole"):
        assert getattr(varying, name) == getattr(plain, name)
    assert varying.n_saturated > 0
    assert varying.truth == plain.truth


@pytest.mark.parametrize(
    ("name", "parameters"), [("coil", {"R": 1.5, "L": 2e-3}), ("rotor", {"m": 2.0, "k_x": 1e4, "k_i": 3.0})]
)
def test_other_models_vary_too(name: str, parameters: dict[str, float]) -> None:
    plant, u = LinearPlant(model=model(name), parameters=parameters), excite(500)
    plain = simulate(plant, u, rate_hz=RATE, seed=1)
    flat = Variation(parameters={k: Schedule.constant(v) for k, v in parameters.items()})
    varying = simulate(plant, u, variation=flat, rate_hz=RATE, seed=1)
    assert np.array_equal(varying.states, plain.states)
    assert set(varying.record.names) == {*plain.record.names, *(f"true_{k}" for k in parameters)}


def test_a_jump_is_two_stationary_simulations_joined() -> None:
    u, k = excite(800), 333
    after = changed(THESIS, k_i=-250.0, m=0.12)
    both = Variation(
        parameters={n: Schedule.step(THESIS.parameters[n], after.parameters[n], k / RATE) for n in ("k_i", "m")}
    )
    joined = simulate(THESIS, u, variation=both, rate_hz=RATE, seed=0, loop=Loop())
    first = simulate(THESIS, u[: k + 1], rate_hz=RATE, seed=0)
    second = simulate(after, u[k:], rate_hz=RATE, seed=0, start=first.states[-1])
    assert np.array_equal(joined.states[: k + 1], first.states)
    assert np.array_equal(joined.states[k:], second.states)
    assert joined.record["true_m"].values.tolist() == [0.1] * k + [0.12] * (800 - k)


@pytest.mark.parametrize("delay", [1.0, 0.4])
def test_a_jump_under_feedback_follows_the_two_loop_matrices(delay: float) -> None:
    loop, k, n = replace(BEARING.loop, delay=delay), 40, 120
    less = {**BEARING.parameters, "k_i": 0.85 * BEARING.parameters["k_i"]}
    jump = Variation(parameters={"k_i": Schedule.step(BEARING.parameters["k_i"], less["k_i"], k / RATE)})
    x0 = np.array([1e-5, 1e-3, 0.02])
    done = simulate(PLANT, np.zeros(n), variation=jump, rate_hz=RATE, seed=0, loop=loop, start=x0)
    before, after = (closed_loop_matrix(p, loop, RATE) for p in (BEARING.parameters, less))
    z = np.zeros(before.shape[0])
    z[:3], z[-1] = x0, x0[0]
    for j in range(n):
        assert done.states[j] == pytest.approx(z[:3], rel=1e-8, abs=1e-13)
        z = (before if j < k else after) @ z


@pytest.mark.parametrize("name", preset_names(rotors=False))
@pytest.mark.parametrize("delay", [1.0, 0.3])
def test_drifting_matrices_are_those_of_the_exact_discretisation(name: str, delay: float) -> None:
    """From sample to sample, so that each stretch is one sample and its middle is known."""
    p = preset(name)
    plant = LinearPlant(model=model(p.model), parameters=p.parameters)
    r, k_i = p.parameters["R"], p.parameters["k_i"]
    drift = {"R": Schedule.ramp(r, 1.2 * r, 0.0, 1.0), "k_i": Schedule.ramp(k_i, 0.9 * k_i, 0.0, 1.0)}
    x0, u = np.array([1e-5, 1e-3, 0.02]), excite(400)
    running = VaryingLoop(
        plant, Variation(parameters=drift), rate_hz=p.rate_hz, seed=0, loop=Loop(delay=delay), start=x0,
        grid_s=1.0 / p.rate_hz,
    )  # fmt: skip
    found = running.advance(u).states
    x, late = x0, np.concatenate([[0.0, 0.0], u])
    whole = int(delay)
    for k in range(400):
        assert found[k] == pytest.approx(x, rel=3e-8, abs=1e-12)
        middle = (k + 0.5) / p.rate_hz
        theta = {**p.parameters, "R": r * (1 + 0.2 * middle), "k_i": k_i * (1 - 0.1 * middle)}
        d, _ = discretise(plant.model.matrices(theta), 1.0 / p.rate_hz, fraction=delay - whole)
        x = d.A @ found[k] + d.B[:, 0] * late[2 + k - whole] + d.B_late[:, 0] * late[1 + k - whole]


def brute_force(u: np.ndarray, theta: dict[str, Schedule], substeps: int) -> np.ndarray:
    """Runge-Kutta with parameters that move in every substep, shape (n_samples, 3)."""
    h = 1.0 / RATE / substeps
    t = np.arange(2 * substeps * u.size + 1) / (2 * substeps)
    p = {k: np.full(t.size, v) for k, v in THESIS.parameters.items()}
    p |= {k: np.interp(t / RATE, s.times_s, s.values) for k, s in theta.items()}
    a = np.zeros((t.size, 3, 3))
    a[:, 0, 1], a[:, 1, 0], a[:, 1, 1] = 1.0, -p["k_x"] / p["m"], -p["c"] / p["m"]
    a[:, 1, 2], a[:, 2, 1], a[:, 2, 2] = p["k_i"] / p["m"], -p["k_i"] / p["L"], -p["R"] / p["L"]
    x, states = np.zeros(3), []
    for k, voltage in enumerate(u):
        states.append(x)
        for s in range(substeps):
            i = 2 * (k * substeps + s)
            drive = np.array([0.0, 0.0, voltage / p["L"][0]])
            k1 = a[i] @ x + drive
            k2 = a[i + 1] @ (x + 0.5 * h * k1) + drive
            k3 = a[i + 1] @ (x + 0.5 * h * k2) + drive
            k4 = a[i + 2] @ (x + h * k3) + drive
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return np.array(states)


def test_a_drift_agrees_with_brute_force_to_second_order_in_the_grid() -> None:
    # Far faster than any warm coil, and as fast as the plant itself swings (640 Hz).
    drift = {"R": Schedule.ramp(1.25, 3.75, 0.002, 0.05), "k_i": Schedule.ramp(-310.08, -280.0, 0.0, 0.03)}
    u = np.sign(np.sin(np.arange(800) / 37.0))
    wanted = brute_force(u, drift, 16)
    size, off = np.abs(wanted).max(axis=0), {}
    for grid in (4e-4, 2e-4):
        running = VaryingLoop(THESIS, Variation(parameters=drift), rate_hz=RATE, seed=0, grid_s=grid)
        found = running.advance(u).states
        off[grid] = float((np.abs(found - wanted).max(axis=0) / size).max())
    assert off[2e-4] < 5e-4
    assert off[2e-4] < off[4e-4] / 3.0
    slow = {"R": Schedule.ramp(1.25, 1.25 * (1 + 0.2 * 0.04 / 60.0), 0.0, 0.04)}
    found = simulate(THESIS, u, variation=Variation(parameters=slow), rate_hz=RATE, seed=0).states
    assert (np.abs(found - brute_force(u, slow, 16)).max(axis=0) / size).max() < 2e-7


def energy(states: np.ndarray, m: float) -> np.ndarray:
    x, v, i = states.T
    p = THESIS.parameters
    return 0.5 * (m * v**2 + p["k_x"] * x**2 + p["L"] * i**2)


def test_k_i_does_the_same_work_in_force_and_in_voltage_before_and_after_a_jump() -> None:
    free = changed(THESIS, R=1e-12)
    jump = Variation(parameters={"k_i": Schedule.step(-310.08, -200.0, 0.01)})
    done = simulate(free, np.zeros(1000), variation=jump, rate_hz=RATE, seed=0, start=[1e-4, 0.05, 0.3])
    e = energy(done.states, 0.1)
    assert e == pytest.approx(np.full(1000, e[0]), rel=1e-9)
    # all of it swings between the two forms, so the balance is no accident of a small coupling
    assert np.ptp(0.05 * done.states[:, 1] ** 2) > 0.5 * e[0]


def test_an_added_mass_moves_with_the_rotor() -> None:
    free = changed(THESIS, R=1e-12)
    jump = Variation(parameters={"m": Schedule.step(0.1, 0.11, 0.01)})
    done = simulate(free, np.zeros(600), variation=jump, rate_hz=RATE, seed=0, start=[1e-4, 0.05, 0.3])
    before, after = energy(done.states[:201], 0.1), energy(done.states[200:], 0.11)
    assert before == pytest.approx(np.full(201, before[0]), rel=1e-9)
    assert after == pytest.approx(np.full(400, before[0] + 0.005 * done.states[200, 1] ** 2), rel=1e-9)


def test_a_sensor_that_loses_gain_misleads_the_controller() -> None:
    fault = Variation(gains={"position": Schedule.step(1.0, 0.8, 0.01), "current": Schedule.constant(1.1)})
    noise = Noise(force=1e-3)
    done = simulate(
        PLANT, excite(600), variation=fault, rate_hz=RATE, seed=0, loop=BEARING.loop, noise=noise, setpoint=2e-5
    )
    x, i = done.states[:, 0], done.states[:, 2]
    gain = np.where(np.arange(600) < 200, 1.0, 0.8)
    assert np.array_equal(done.record["position"], gain * x)
    assert np.array_equal(done.record["current"], 1.1 * i)
    assert np.array_equal(done.record["true_gain_position"], gain)
    long = simulate(
        PLANT, np.zeros(40_000), variation=Variation(gains={"position": Schedule.constant(0.8)}), rate_hz=RATE, seed=0,
        loop=BEARING.loop, setpoint=2e-5,
    )  # fmt: skip
    assert long.states[-1, 0] == pytest.approx(2e-5 / 0.8, rel=1e-3)  # the integral brings the logged value home


@pytest.mark.parametrize("speed", [60.0, 163.0, 400.0, 1500.0])
def test_unbalance_at_constant_speed_has_the_analytic_response(speed: float) -> None:
    moment, phase, n = 3e-6, 0.7, 30_000
    p = ROTOR.parameters
    turning = Variation(unbalance=Unbalance(moment=moment, phase=phase, speed=Schedule.constant(speed)))
    done = simulate(ROTOR, np.zeros(n), variation=turning, rate_hz=RATE, seed=0)
    tail = slice(n // 2, None)
    angle = done.record["angle"][tail]
    assert angle == pytest.approx(speed * done.record.time_s[tail], rel=1e-12)
    assert np.all(done.record["speed"] == speed)
    wave = np.exp(1j * (angle + phase))
    basis = np.column_stack([wave.real, -wave.imag])
    (re, im), *_ = np.linalg.lstsq(basis, done.states[tail, 0], rcond=None)
    wanted = moment * speed**2 / (p["k_x"] - p["m"] * speed**2 + 1j * p["c"] * speed)
    # held over a sample, the force is smaller by sinc(speed T/2) and carries no lag
    assert re + 1j * im == pytest.approx(wanted * np.sinc(speed / RATE / 2 / np.pi), rel=1e-7)
    assert re + 1j * im == pytest.approx(wanted, rel=3e-4)


def test_unbalance_in_the_loop_has_the_loop_s_response() -> None:
    speed, moment, n = 900.0, 1e-6, 40_000
    turning = Variation(unbalance=Unbalance(moment=moment, speed=Schedule.constant(speed)))
    done = simulate(PLANT, np.zeros(n), variation=turning, rate_hz=RATE, seed=0, loop=BEARING.loop)
    m = closed_loop_matrix(BEARING.parameters, BEARING.loop, RATE)
    turn = np.exp(1j * speed / RATE)
    push = np.zeros(m.shape[0], dtype=complex)
    one = simulate(
        PLANT, np.zeros(2), variation=Variation(force=Schedule.constant(1.0)), rate_hz=RATE, seed=0
    )  # what one newton does in one sample
    push[:3] = one.states[1]
    z = np.linalg.solve(turn * np.eye(m.shape[0]) - m, push) * moment * speed**2 * np.exp(0.5j * speed / RATE)
    wave = z[0] * np.exp(1j * done.record["angle"])
    assert done.states[n // 2 :, 0] == pytest.approx(wave.real[n // 2 :], abs=2e-5 * abs(z[0]))


def test_a_load_moves_the_current_that_balances_it() -> None:
    pushed = Variation(force=Schedule.step(0.0, 2.0, 0.1))
    done = simulate(PLANT, np.zeros(40_000), variation=pushed, rate_hz=RATE, seed=0, loop=BEARING.loop)
    assert not done.states[: int(0.1 * RATE) + 1].any()
    assert done.states[-1, 2] == pytest.approx(-2.0 / BEARING.parameters["k_i"], rel=1e-4)
    assert done.record["true_force"][[1999, 2000]].tolist() == [0.0, 2.0]
    assert done.record.channel("true_force").unit == "N"


def test_how_a_run_is_cut_into_calls_changes_no_bit() -> None:
    u = excite(4000)
    all_at_once = Variation(
        parameters={"R": Schedule.ramp(1.6, 1.9, 0.013, 0.11), "k_i": Schedule.step(55.7, 50.0, 0.0777)},
        gains={"position": Schedule.ramp(1.0, 0.9, 0.05, 0.15)},
        force=Schedule.step(0.0, 1.0, 0.09),
        unbalance=Unbalance(moment=1e-6, speed=Schedule.ramp(0.0, 1000.0, 0.01, 0.19)),
    )
    whole = VaryingLoop(PLANT, all_at_once, seed=3, **STANDS).advance(u)
    for cuts in ([1, 2, 3, 1999], list(range(37, 4000, 37))):
        running = VaryingLoop(PLANT, all_at_once, seed=3, **STANDS)
        parts = [running.advance(x) for x in np.split(u, cuts)]
        for name in ("command", "measured", "states", "speed", "angle"):
            assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))
        for name in whole.truth:
            assert np.array_equal(np.concatenate([p.truth[name] for p in parts]), whole.truth[name])


def test_limits_act_and_are_counted_across_calls() -> None:
    limits = Limits(voltage=(-3.0, 3.0), current=(-0.05, 0.05), position=(-2e-6, 2e-6))
    stands = {**STANDS, "limits": limits}
    u = 6.0 * excite(2000)
    plain = simulate(PLANT, u, seed=1, **stands)
    running = VaryingLoop(PLANT, Variation(), seed=1, **stands)
    parts = [running.advance(x) for x in np.split(u, 9 * np.arange(1, 200))]
    assert np.abs(np.concatenate([p.command for p in parts])).max() == 3.0
    assert running.n_done == 2000
    assert running.counts.tolist() == [2000, plain.first_contact, plain.first_saturated, plain.n_saturated]
    assert running.counts.min() >= 0
    assert running.n_over_current == plain.n_over_current > 0


def test_an_unstable_end_is_told_by_its_pole() -> None:
    weak = Variation(parameters={"k_i": Schedule.step(55.7, 20.0, 0.1)})
    done = simulate(PLANT, np.zeros(2100), variation=weak, seed=0, **STANDS)
    assert done.largest_pole > 1.0
    assert any("unstable" in w for w in done.warnings)
    assert done.truth["k_i"] == 55.7


def test_what_cannot_vary_is_refused() -> None:
    def vary(variation: Variation, plant: LinearPlant = PLANT, **more: object) -> None:
        simulate(plant, np.zeros(9), variation=variation, seed=0, **{"rate_hz": RATE, **more})  # type: ignore[arg-type]

    one = Schedule.constant(1.0)
    coil = LinearPlant(model=model("coil"), parameters={"R": 1.5, "L": 2e-3})
    with pytest.raises(ModelError, match=r"no parameter 'Ki'.*'k_i'"):
        vary(Variation(parameters={"Ki": one}))
    with pytest.raises(ModelError, match=r"'m' falls to 0 kg"):
        vary(Variation(parameters={"m": Schedule.ramp(1.0, 0.0, 0.0, 1.0)}))
    with pytest.raises(ModelError, match="no sensor of 'speed'"):
        vary(Variation(gains={"speed": one}))
    with pytest.raises(ModelError, match="no rotor"):
        vary(Variation(force=one), coil)
    with pytest.raises(ModelError, match="nonlinear plant does not vary"):
        simulate(BEARING.plant, np.zeros(9), variation=Variation(), seed=0, rate_hz=RATE)
    with pytest.raises(ModelError, match="must be positive"):
        vary(Variation(), rate_hz=0.0)
    with pytest.raises(ModelError, match="start has shape"):
        vary(Variation(), start=[0.0])
    with pytest.raises(ModelError, match="not finite at sample 0"):
        simulate(PLANT, [np.nan], variation=Variation(), rate_hz=RATE, seed=0)
    with pytest.raises(ModelError, match="the simulation diverges"):
        simulate(PLANT, np.ones(200_000), variation=Variation(), rate_hz=100.0, seed=0)
