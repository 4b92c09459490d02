"""The linear loop: exact against SciPy, exact delay, the controller as documented."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from ambid.errors import ModelError
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.nonlinear import OperatingPoint
from ambid.physics.presets import preset, preset_names
from ambid.simulation import LinearPlant, closed_loop_matrix, closed_loop_poles, simulate, simulate_preset

THESIS = LinearPlant(model=model("one-axis"), parameters=preset("thesis").parameters)
RATE = 10_000.0


def excite(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def test_open_loop_equals_scipy() -> None:
    s = THESIS.model.matrices(THESIS.parameters)
    a, b, c, d, _ = cont2discrete((s.A, s.B, s.C, np.zeros((2, 1))), 1.0 / RATE)
    u = excite(3000)
    _, y, x = dlsim((a, b, c, d, 1.0 / RATE), u)
    done = simulate(THESIS, u, rate_hz=RATE, seed=0)
    scale = np.abs(x).max(axis=0)
    assert np.abs(done.states - x).max(axis=0) == pytest.approx(0.0 * scale, abs=1e-10 * scale.max())
    assert done.record["position"] == pytest.approx(y[:, 0], abs=1e-10 * np.abs(y[:, 0]).max())
    assert done.record["current"] == pytest.approx(y[:, 1], abs=1e-10 * np.abs(y[:, 1]).max())
    assert np.array_equal(done.record["voltage"], u)


@pytest.mark.parametrize("delay", [1, 3])
def test_whole_delay_shifts_the_response_and_not_the_log(delay: int) -> None:
    u = excite(500)
    plain = simulate(THESIS, u, rate_hz=RATE, seed=0)
    late = simulate(THESIS, u, rate_hz=RATE, seed=0, loop=Loop(delay=delay))
    assert np.array_equal(late.record["voltage"], u)
    assert np.array_equal(late.states[delay:], plain.states[:-delay])
    assert not late.states[: delay + 1].any()


def test_fractional_delay_is_a_whole_one_on_a_finer_grid() -> None:
    u = excite(300)
    fine = simulate(THESIS, np.repeat(u, 4), rate_hz=4 * RATE, seed=0, loop=Loop(delay=5))
    coarse = simulate(THESIS, u, rate_hz=RATE, seed=0, loop=Loop(delay=1.25))
    assert coarse.states == pytest.approx(fine.states[::4], abs=1e-12)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0, 0.4, 1.3])
@pytest.mark.parametrize("cutoff", [np.inf, 1500.0])
def test_closed_loop_follows_its_matrix(delay: float, cutoff: float) -> None:
    p = preset("unstable-bearing")
    plant = LinearPlant(model=model("one-axis"), parameters=p.parameters)
    gains = {k: getattr(p.loop, k) for k in ("kp", "ki", "kd", "kc")}
    loop = Loop(**gains, derivative_cutoff_hz=cutoff, delay=delay)
    x0 = np.array([1e-5, 1e-3, 0.02])
    done = simulate(plant, np.zeros(60), rate_hz=20_000.0, seed=0, loop=loop, start=x0)
    m = closed_loop_matrix(p.parameters, loop, 20_000.0)
    z = np.zeros(m.shape[0])
    z[:3], z[-1] = x0, x0[0]
    for k in range(60):
        assert done.states[k] == pytest.approx(z[:3], rel=1e-8, abs=1e-14)
        z = m @ z
    assert done.largest_pole == pytest.approx(np.abs(closed_loop_poles(p.parameters, loop, 20_000.0)).max())


def test_command_is_the_documented_law_of_the_logged_outputs() -> None:
    p = preset("levitated-ball")
    noise = Noise(position=2e-6, current=1e-3, force=1e-4, position_resolution=1e-6, current_resolution=5e-3)
    u, r = 0.1 * excite(400), 0.010 + 1e-4 * np.sign(np.sin(np.arange(400) / 30))
    plant = LinearPlant(model=model("one-axis"), parameters=p.parameters)
    done = simulate(
        plant, u, rate_hz=p.rate_hz, seed=5, loop=p.loop, noise=noise, operating_point=p.operating_point, setpoint=r
    )
    x, i, period = done.record["position"], done.record["current"], 1.0 / p.rate_hz
    tau = 1.0 / (2 * np.pi * p.loop.derivative_cutoff_hz)
    error = r - x
    integral = p.loop.ki * period * np.concatenate(([0.0], np.cumsum(error)[:-1]))
    derivative = np.zeros(400)
    for k in range(1, 400):
        derivative[k] = (tau * derivative[k - 1] - p.loop.kd * (x[k] - x[k - 1])) / (tau + period)
    wanted = (
        p.operating_point.voltage + p.loop.kp * error + integral + derivative
        - p.loop.kc * (i - p.operating_point.current) + u
    )  # fmt: skip
    assert done.record["voltage"] == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("name", preset_names(rotors=False))
@pytest.mark.parametrize("nonlinear", [False, True])
def test_presets_stay_levitated(name: str, nonlinear: bool) -> None:
    p = preset(name)
    if nonlinear and p.plant is None:
        with pytest.raises(ModelError, match="linear only"):
            simulate_preset(p, np.zeros(10), seed=1, nonlinear=True)
        return
    n = int(p.rate_hz)
    done = simulate_preset(p, np.zeros(n), seed=1, nonlinear=nonlinear, closed=True)
    assert done.within_limits
    assert done.warnings == ()
    assert np.abs(done.states[:, 0] - p.operating_point.position).max() < 20e-6 + 10 * p.noise.position_resolution


def test_offsets_of_the_operating_point_are_logged() -> None:
    point = OperatingPoint(position=0.01, current=0.95, voltage=4.0)
    u = excite(50)
    moved = simulate(THESIS, u, rate_hz=RATE, seed=0, operating_point=point)
    plain = simulate(THESIS, u, rate_hz=RATE, seed=0)
    for name, offset in point._asdict().items():
        assert moved.record[name] == pytest.approx(plain.record[name] + offset, abs=1e-14)


def test_other_models_have_their_own_channels() -> None:
    coil = LinearPlant(model=model("coil"), parameters={"R": 1.564, "L": 1.818e-3})
    done = simulate(coil, np.ones(20_000), rate_hz=RATE, seed=0)
    assert done.record.names == ("voltage", "current")
    assert done.record["current"][-1] == pytest.approx(1 / 1.564, rel=1e-9)
    assert done.record["current"][1] == pytest.approx((1 - np.exp(-1.564 / 1.818e-3 / RATE)) / 1.564, rel=1e-12)
    rotor = LinearPlant(model=model("rotor"), parameters={"m": 2.0, "k_x": 0.0, "k_i": 3.0})
    limits = Limits(current=(-0.5, 0.5))
    done = simulate(rotor, np.ones(101), rate_hz=100.0, seed=0, limits=limits)
    assert done.record.names == ("current", "position")
    assert done.record["position"][-1] == pytest.approx(
        0.5 * 3.0 / 2.0 * 0.5, rel=1e-10
    )  # a t^2/2 at the limited 0.5 A
    assert done.n_saturated == 101


def test_record_says_where_it_comes_from() -> None:
    done = simulate(THESIS, excite(10), rate_hz=RATE, seed=42, loop=Loop(delay=1))
    assert done.record.names == ("voltage", "current", "position")
    assert [c.unit for c in done.record.channels] == ["V", "A", "m"]
    assert done.record.provenance["seed"] == "42"
    assert done.record.history[0].name == "simulate"
    assert done.truth == {**preset("thesis").parameters, "delay": 1.0}


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ModelError, match="excitation has shape"):
        simulate(THESIS, np.zeros((5, 2)), rate_hz=RATE, seed=0)
    with pytest.raises(ModelError, match="not finite at sample 3"):
        simulate(THESIS, [0.0, 0.0, 0.0, np.nan], rate_hz=RATE, seed=0)
    with pytest.raises(ModelError, match="must be positive"):
        simulate(THESIS, np.zeros(5), rate_hz=0.0, seed=0)
    with pytest.raises(ModelError, match="'L'"):
        LinearPlant(model=model("coil"), parameters={"R": 1.0})
