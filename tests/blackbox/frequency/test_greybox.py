"""Physical parameters from a frequency response: exact slope, honest intervals, closed loop, delays, roles, flags."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.frequency import Channels, greybox_frf, response
from ambid.blackbox.frequency import Lines
from ambid.errors import EstimationError
from ambid.physics.linear_model import model
from ambid.physics.presets import preset
from tests.blackbox.frequency.responses import RATE, closed_loop, continuous, extrapolated, free, noisy, plant

F = np.linspace(5.0, 2000.0, 120)
NO_DAMPING = {"c": ("fixed", 0.0, None)}
FREE = ("m", "k_x", "k_i", "R", "L")


def no_lines(held: bool) -> Lines:
    none = np.zeros((F.size, 2, 2), dtype=complex)
    return Lines(omega=2 * np.pi * F, G=none[:, :, :1], root=none, sd=none.real, freedom=np.ones(F.size), together=2,
                 alike=1.0, dt=1 / RATE, held=held)  # fmt: skip


@pytest.mark.parametrize("held", [False, True])
def test_slope_is_exact(held):
    ln, of, truth = no_lines(held), model("one-axis"), preset("unstable-bearing").parameters
    names, v = (*FREE, "c"), np.array([*(truth[k] for k in FREE), 2.0, 1.4])
    both = Channels(outputs=(0, 1), inputs=(0,))

    def flat(x: np.ndarray) -> np.ndarray:
        theta = dict(zip(names, x[:-1].tolist(), strict=True))
        return response(of, theta, (), ln, both, float(x[-1]))[0].ravel()

    theta = dict(zip(names, v[:-1].tolist(), strict=True))
    found = response(of, theta, names, ln, both, 1.4, moving=True)[1].reshape(-1, v.size)
    steps = np.abs(v) * 1e-2
    steps[5] = 10.0  # a damping shows beside sqrt(m k) only
    wanted = extrapolated(flat, v, steps)
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(found / size, wanted / size, atol=2e-9)


@pytest.mark.parametrize(("name", "freedom"), [("unstable-bearing", 8.0), ("thesis", np.inf)])
def test_intervals_are_honest(name, freedom):
    truth, z, cost, runs = preset(name).parameters, [], [], 40
    f = np.linspace(5.0, 1500.0, 50)
    G = plant(name, f, hold="zoh", delay=1)
    for seed in range(runs):
        frf = noisy(f, G, 0.02, seed, freedom=freedom, hold="zoh")
        estimate = greybox_frf(frf, model("one-axis"), free(**NO_DAMPING), delay=1.0)
        assert estimate.status == "converged"
        z.append([(estimate.parameter(k).value - truth[k]) / estimate.parameter(k).sd for k in FREE])
        values = estimate.checks["cost"].values
        cost.append((values["cost"] - values["expected_cost"]) / values["cost_sd"])
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < 3.5 / np.sqrt(runs))
    assert 0.90 <= np.mean(np.abs(z) < 1.96) <= 0.99
    assert np.all(np.sqrt(np.mean(z**2, axis=0)) < 1.35)
    assert abs(np.mean(cost)) < 3.3 / np.sqrt(runs)


@pytest.mark.parametrize(("name", "rms"), [("unstable-bearing", 3.0), ("rmit-axis", 6.0)])
def test_unstable_bearings_in_closed_loop(name, rms):
    truth = preset(name).parameters
    frf = closed_loop(name, 4, period=8000, periods=10, rms=rms)
    estimate = greybox_frf(frf, model("one-axis"), free(**NO_DAMPING))
    assert estimate.passed
    assert estimate.delay.samples + estimate.delay.fraction == pytest.approx(1.0, abs=0.01)
    for k in FREE:
        p = estimate.parameter(k)
        assert abs(p.value - truth[k]) < 3.3 * p.sd, k
        assert p.value == pytest.approx(truth[k], rel=0.03), k
    true = np.linalg.eigvals(model("one-axis").matrices(truth).A)
    np.testing.assert_allclose(np.sort_complex(estimate.continuous.poles), np.sort_complex(true), rtol=0.01)


@pytest.mark.parametrize("hold", ["zoh", "band-limited"])
@pytest.mark.parametrize("delay", [0.0, 0.4, 2.0, 3.7])
def test_delays_whole_and_in_fractions(hold, delay):
    frf = noisy(F, plant("unstable-bearing", F, hold=hold, delay=delay), 0.02, 3, hold=hold)
    found = greybox_frf(frf, model("one-axis"), free(**NO_DAMPING))
    total = found.delay.samples + found.delay.fraction
    assert found.checks["cost"].passed
    if delay % 1:
        assert abs(total - delay) < 3.5 * found.delay.sd
        assert found.delay.sd < 0.02
    else:
        assert total == delay


def test_current_driven_rotor_has_ratios_only_until_the_mass_is_known():
    truth = {"m": 0.5, "k_x": 8.0e4, "k_i": 40.0, "c": 6.0}
    f = np.linspace(2.0, 500.0, 100)
    s = model("rotor").matrices(truth)
    frf = noisy(f, continuous(s.A, s.B, s.C, 2 * np.pi * f), 0.01, 1)
    frf = replace(frf, inputs=("coil",), outputs=("probe",))
    roles = {"coil": "current", "probe": "position"}
    blind = greybox_frf(frf, model("rotor"), free("rotor"), delay=0.0, roles=roles)
    assert not blind.checks["identifiable"].passed
    assert not any(blind.parameter(k).identifiable for k in ("m", "k_x", "k_i"))
    assert blind.values["k_x"] / blind.values["m"] == pytest.approx(1.6e5, rel=0.01)
    known = greybox_frf(frf, model("rotor"), free("rotor", m=("fixed", 0.5, None)), delay=0.0, roles=roles)
    assert known.passed
    assert known.parameter("m").sd == 0.0
    for k in ("k_x", "k_i", "c"):
        assert abs(known.values[k] - truth[k]) < 3.3 * known.parameter(k).sd, k
    prior = greybox_frf(frf, model("rotor"), free("rotor", m=("prior", 0.5, 0.01)), delay=0.0, roles=roles)
    assert prior.parameter("m").sd == pytest.approx(0.01, rel=0.01)
    assert prior.parameter("m").data_share < 0.01
    assert prior.parameter("k_x").sd / prior.values["k_x"] == pytest.approx(0.02, rel=0.05)


def test_model_errors_widen_the_intervals():
    # 40 Hz of an unmodelled flexible mount: 5 % of stiffness
    G = plant("unstable-bearing", F)
    s = 2j * np.pi * F
    mount = ((2 * np.pi * 400) ** 2 / (s**2 + 100 * s + (2 * np.pi * 400) ** 2))[:, None, None]
    frf = noisy(F, G * (1 + 0.05 * mount), 0.005, 1)
    estimate = greybox_frf(frf, model("one-axis"), free(**NO_DAMPING))
    right = greybox_frf(noisy(F, G, 0.005, 1), model("one-axis"), free(**NO_DAMPING))
    assert not estimate.checks["cost"].passed
    assert estimate.covariance_method == "robust"
    assert any("model errors" in w for w in estimate.warnings)
    assert all(estimate.parameter(k).sd > 1.5 * right.parameter(k).sd for k in FREE)
    assert estimate.verdict.word == "caution"
    far = greybox_frf(noisy(F, G * (1 + 5 * mount), 0.005, 1), model("one-axis"), free(**NO_DAMPING))
    assert not far.checks["response_fit"].passed
    assert far.verdict.word == "unusable"


def test_position_alone_wants_start_values():
    frf = noisy(F, plant("unstable-bearing", F), 0.005, 1)
    alone = replace(frf, G=frf.G[:, :1], covariance=frf.covariance[:, :1, :1], outputs=("position",))
    with pytest.raises(EstimationError, match="an output is missing"):
        greybox_frf(alone, model("one-axis"), free(**NO_DAMPING))
    truth = preset("unstable-bearing").parameters
    start = {k: ("free", 1.2 * truth[k], None) for k in FREE} | NO_DAMPING | {"m": ("fixed", truth["m"], None)}
    found = greybox_frf(alone, model("one-axis"), free(**start), delay=0.0)
    assert found.checks["cost"].passed
    for k in ("k_x", "k_i", "R", "L"):
        assert abs(found.values[k] - truth[k]) < 3.5 * found.parameter(k).sd, k


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"outputs": ("position", "speed")}, {}, "no output of model"),
        ({"inputs": ("position2",)}, {}, "no input of model"),
        ({}, {"delay": -1.0}, "delay"),
        ({}, {"parameters": []}, "Give each once"),
        ({}, {"parameters": free(**dict.fromkeys((*FREE, "c"), ("fixed", 1.0, None)))}, "nothing is left"),
    ],
)
def test_what_breaks_a_rule_is_refused(change, options, message):
    frf = replace(noisy(F, plant("unstable-bearing", F), 0.02, 1), **change)
    parameters = options.pop("parameters", free(**NO_DAMPING))
    with pytest.raises(EstimationError, match=message):
        greybox_frf(frf, model("one-axis"), parameters, **options)
