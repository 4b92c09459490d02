"""Errors of sensors: what they move against simulated and refitted plants; gains as parameters."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from ambid.errors import ModelError
from ambid.physics.linear_model import discretise, model, model_names, zero_order_hold
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.physics.sensor_errors import (
    CHANNELS,
    SensorError,
    SensorGains,
    error_moves,
    logged_error,
    position_errors,
    unit_powers,
)

THETA = {"m": 4.0, "k_x": -1.29e5, "k_i": 55.7, "R": 1.6, "L": 0.026, "c": 3.0}


def parts(matrices):
    return [getattr(matrices, name) for name in "ABEC"]


def at(name, **gains):
    plant = SensorGains(model(name))
    return plant, {p.name: THETA.get(p.name, 1.0) for p in plant.base.parameters} | gains


@pytest.mark.parametrize("name", model_names())
def test_a_gain_of_one_changes_nothing(name):
    plant, theta = at(name)
    for seen, base in zip(parts(plant.matrices(theta)), parts(plant.base.matrices(theta)), strict=True):
        np.testing.assert_array_equal(seen, base)


@pytest.mark.parametrize("name", model_names())
def test_derivatives_are_those_of_the_complex_step(name):
    plant, theta = at(name)
    theta |= {gain: 0.7 + 0.2 * k for k, gain in enumerate(plant.gains)}
    for parameter in (p.name for p in plant.parameters):
        h = 1e-30
        moved = plant.matrices({**theta, parameter: theta[parameter] + 1j * h})
        for found, seen in zip(parts(plant.derivative(theta, parameter)), parts(moved), strict=True):
            np.testing.assert_allclose(found, np.imag(seen) / h, rtol=1e-12, atol=1e-9)


def test_a_gain_of_the_position_hides_behind_the_mass():
    """Logged position g x: the same as a bench with m/g^2, c/g^2, k_x/g^2 and k_i/g, its force scaled by 1/g."""
    g = 0.8
    plant, theta = at("one-axis", gain_position=g)
    other = {k: theta[k] / g**2 for k in ("m", "c", "k_x")} | {"k_i": theta["k_i"] / g}
    seen, hidden = plant.matrices(theta), plant.base.matrices({**theta, **other})
    np.testing.assert_allclose(seen.A, hidden.A, rtol=1e-14)
    np.testing.assert_allclose(seen.B, hidden.B, rtol=1e-14)
    force = plant.disturbances.index("force")
    np.testing.assert_allclose(seen.E[:, force], hidden.E[:, force] / g, rtol=1e-14)


def test_outputs_are_those_of_the_bench_times_their_gains():
    plant, theta = at("one-axis", gain_position=1.3, gain_current=0.6)
    responses = []
    for matrices in (plant.matrices(theta), plant.base.matrices(theta)):
        A, B = zero_order_hold(matrices.A, matrices.B, 1e-4)
        x, y = np.zeros(3), []
        for k in range(50):
            y.append(matrices.C @ x)
            x = A @ x + B[:, 0] * np.cos(0.3 * k)
        responses.append(np.array(y))
    np.testing.assert_allclose(responses[0], responses[1] * [1.3, 0.6], rtol=1e-9, atol=1e-15)


def test_an_unknown_parameter_is_refused():
    plant, theta = at("one-axis")
    with pytest.raises(ModelError):
        plant.derivative(theta, "gain_speed")


def logs(name, theta, rate_hz, scale):
    """Outputs to one sequence of inputs, all logged with the gains of the channels, `scale` of the time ignored."""
    plant = model(name)
    at, _ = discretise(plant.matrices(theta), 1.0 / rate_hz)
    x, y, u = np.zeros(len(plant.states)), [], np.random.default_rng(3).standard_normal((60, len(plant.inputs)))
    for now in u / [scale[role] for role in plant.inputs]:
        y.append(at.C @ x * [scale[role] for role in plant.outputs])
        x = at.A @ x + at.B @ now
    return np.array(y)


@pytest.mark.parametrize("name", model_names())
def test_a_gain_of_any_channel_is_a_plant_whose_parameters_have_its_powers(name):
    """A simulated record with voltage, current, position and time read too large is the record of another plant."""
    scale = dict(zip(CHANNELS, (1.3, 0.7, 0.9, 1.1), strict=True))
    powers = unit_powers(model(name))
    theta = {p.name: THETA[p.name] for p in model(name).parameters}
    other = {
        k: v * np.prod([scale[c] ** n for c, n in zip(CHANNELS, powers[k], strict=True)]) for k, v in theta.items()
    }
    one = dict.fromkeys(CHANNELS, 1.0)
    true, hidden = logs(name, theta, 4000.0, scale), logs(name, other, 4000.0 / scale["time"], one)
    np.testing.assert_allclose(hidden, true, rtol=1e-9, atol=1e-12 * abs(true).max())


def rotor(**changes):
    bearings = tuple(
        Bearing(name=b, axes=(f"x{b}", f"y{b}"), z=z, z_sensors=(z + 0.02,)) for b, z in (("A", 0.0), ("B", 0.3))
    )
    plant = replace(RotorModel(bearings=bearings, speed=200.0, polar=True), **changes)
    theta = {"m": 4.0, "Id": 0.06, "Ip": 0.01, "z_cg": 0.13, "A.z": 0.0, "A.z_sensor": 0.02, "B.z": 0.3}
    theta |= {"B.z_sensor": 0.32, "a": 3000.0}
    for j, axis in enumerate(plant.axes):
        own = {"k_i": 50.0 + j, "k_x": -1e5 - 3e3 * j, "R": 2.0, "L": 0.02 + 1e-3 * j, "gain": 1.0, "sensor_pole": 4e4}
        theta |= {f"{axis}.{k}": v for k, v in own.items()}
    return plant, {p.name: theta[p.name] for p in plant.parameters}


def response(plant, theta, omega):
    space = plant.matrices(theta)
    return space.C @ np.linalg.solve(1j * omega[:, None, None] * np.eye(len(space.A)) - space.A, space.B)


def refitted(plant, theta, free, omega, size, logged):
    """ln of parameters that fit a logged response best, less those of `theta`."""

    def residuals(v):
        moved = {**theta, **{k: theta[k] * np.exp(s) for k, s in zip(free, v, strict=True)}}
        e = ((response(plant, moved, omega) - logged) / size).ravel()
        return np.concatenate([e.real, e.imag])

    return least_squares(residuals, np.zeros(len(free)), xtol=1e-15, ftol=1e-15, gtol=1e-15).x


@pytest.mark.parametrize(
    ("error", "held", "what"),
    [
        (SensorError(kind="gain", channel="position"), ("m", "c"), lambda g, jw, e: g * [[1 + e], [1]]),
        (SensorError(kind="gain", channel="current"), ("m", "c"), lambda g, jw, e: g * [[1], [1 + e]]),
        (SensorError(kind="gain", channel="voltage"), ("m", "c"), lambda g, jw, e: g / (1 + e)),
        (SensorError(kind="lag", channel="position"), ("c",), lambda g, jw, e: g * exp_of([-e * jw, 0 * jw])),
        (SensorError(kind="lag", channel="current"), (), lambda g, jw, e: g * exp_of([0 * jw, -e * jw])),
        (SensorError(kind="lag", channel="voltage"), ("m", "c"), lambda g, jw, e: g * exp_of([e * jw, e * jw])),
        (SensorError(kind="cross-talk", channel="position", other="current"), ("c",),
         lambda g, jw, e: np.array([[1, e], [0, 1]]) @ g),
    ],
)  # fmt: skip
def test_first_order_moves_are_those_of_a_refit_of_one_axis(error, held, what):
    plant, omega = model("one-axis"), np.geomspace(20.0, 5000.0, 50)
    true = response(plant, THETA, omega)
    size = np.sqrt(np.mean(abs(true) ** 2, axis=(0, 2)))[:, None]
    free = [k for k in THETA if k not in held]
    e = 1e-4 * (1e-3 if error.kind == "lag" else size[0, 0] / size[1, 0] if error.kind == "cross-talk" else 1.0)
    fit = refitted(plant, THETA, free, omega, size, what(true, 1j * omega, e)) / e
    moves = error_moves(plant, THETA, [error], free=free, omega=omega)[:, 0]
    np.testing.assert_allclose(moves, fit, rtol=0, atol=2e-3 * abs(fit).max())


def exp_of(rows):
    return np.exp(np.array(rows).T)[:, :, None]


def test_a_held_mass_that_is_too_large_moves_what_it_scales():
    """Without a voltage k_i/m and k_x/m are what is seen: they follow the mass."""
    plant, theta = model("rotor"), {k: THETA[k] for k in ("m", "k_x", "k_i", "c")}
    moves = error_moves(plant, theta, [SensorError(kind="fixed", channel="m")], free=("k_x", "k_i", "c"))
    np.testing.assert_allclose(moves[:, 0] * theta["m"], 1.0, rtol=1e-9)


def test_an_offset_moves_no_parameter():
    errors = [SensorError(kind="offset", channel=c) for c in ("voltage", "current", "position")]
    assert not error_moves(model("one-axis"), THETA, errors).any()


@pytest.mark.parametrize("kind", ["gain", "lag", "cross-talk", "plane", "voltage"])
def test_first_order_moves_are_those_of_a_refit_of_a_rotor(kind):
    plant, theta = rotor()
    omega = np.geomspace(30.0, 3000.0, 40)
    true, jw = response(plant, theta, omega), 1j * omega
    size = np.sqrt(np.mean(abs(true) ** 2, axis=(0, 2)))[:, None]
    free = [p.name for p in plant.parameters if p.default is None]
    e, logged, moved = 1e-5, true.copy(), dict(theta)
    match kind:
        case "gain":
            error = SensorError(kind="gain", channel="xA_position")
            logged[:, 0] *= 1 + e
        case "lag":
            error, e = SensorError(kind="lag", channel="yA_position"), 1e-8
            logged[:, 1] *= np.exp(-e * jw)[:, None]
        case "cross-talk":
            error = next(x for x in position_errors(plant) if x.kind == "cross-talk")
            logged[:, 0] += e * true[:, 1]
        case "plane":
            error, moved["B.z_sensor"] = SensorError(kind="fixed", channel="B.z_sensor"), theta["B.z_sensor"] + e
        case _:
            error = SensorError(kind="gain", channel="xA_voltage")
            logged[:, :, 0] /= 1 + e
    fit = refitted(plant, moved, free, omega, size, logged) / e
    found = error_moves(plant, theta, [error], free=free, omega=omega)[:, 0]
    np.testing.assert_allclose(found, fit, rtol=0, atol=2e-3 * abs(fit).max())


def test_all_channels_of_one_kind_have_the_powers_of_one_axis():
    """Of all gains of one kind together the mass, the moments and each axis know those of one axis."""
    plant, theta = rotor()
    names = [p.name for p in plant.parameters if p.default is None]
    powers = unit_powers(model("one-axis"))
    for channel in ("voltage", "current", "position"):
        roles = [r for r in (*plant.inputs, *plant.outputs) if r.endswith(channel)]
        moves = error_moves(plant, theta, [SensorError(kind="gain", channel=r) for r in roles]).sum(axis=1)
        for name, move in zip(names, moves, strict=True):
            own = {"Id": "m", "Ip": "m"}.get(name, name.rpartition(".")[2])
            expected = powers[own][CHANNELS.index(channel)] if own in powers else 0
            assert move == pytest.approx(expected, abs=1e-6), name


def test_errors_of_a_rotor_that_are_parameters_are_not_asked_for_again():
    plant, _ = rotor()
    of = position_errors(plant)
    assert sorted({e.kind for e in of}) == ["cross-talk", "gain", "lag"]
    assert len(of) == 12
    assert {(e.channel, e.other) for e in of if e.kind == "cross-talk"} >= {("xA_position", "yA_position")}
    fewer = position_errors(replace(plant, extras=("xA.gain", "yB.sensor_pole")))
    gone = {(e.kind, e.channel) for e in of} - {(e.kind, e.channel) for e in fewer}
    assert gone == {("gain", "xA_position"), ("lag", "yB_position")}


def test_what_an_error_adds_is_the_derivative_of_the_logged_spectrum():
    s, other, omega, e = np.array([1.0 - 0.4j]), np.array([0.3 + 0.2j]), np.array([50.0]), 1e-7
    for kind, logged in (
        ("gain", lambda e: s * (1 + e)),
        ("lag", lambda e: s * np.exp(-1j * omega * e)),
        ("lag", lambda e: s / (1 + e * 1j * omega)),  # a pole
        ("cross-talk", lambda e: s + e * other),
        ("offset", lambda e: s),
    ):
        central = (logged(e) - logged(-e)) / (2 * e)
        np.testing.assert_allclose(logged_error(kind, s, omega, other), central, rtol=1e-6, atol=1e-9)
