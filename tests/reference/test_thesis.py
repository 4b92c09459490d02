"""Published numbers of the source thesis, and what follows from its own formulas (theory.md sec. 6)."""

import numpy as np
import pytest

from ambid.bearing.linear import greybox
from ambid.bearing.uncertainty import uncertainty
from ambid.physics.linear_model import discretise, model
from ambid.physics.presets import preset
from tests.bearing.benches import parameters, run

# thesis eq. 4.10 (simulated plant) and 4.11 (what its network found); states position, velocity, current
A_410 = np.array([[0, 1, 0], [-5872.2, 0, -3100.8], [0, 5202.7, -20.97]])
B_410 = np.array([0, 0, 16.78])
PUBLISHED_411 = {"m": 0.0976, "k_x": 608.1, "k_i": -320.0, "R": 1.138, "L": 60.2e-3}


def test_the_preset_gives_the_published_matrices():
    s = model("one-axis").matrices(preset("thesis").parameters)
    # printed with four or five digits
    np.testing.assert_allclose(s.A, A_410, rtol=2e-4)
    np.testing.assert_allclose(s.B[:, 0], B_410, rtol=2e-4)
    np.testing.assert_array_equal(s.C, [[1, 0, 0], [0, 0, 1]])  # the printed C = [1 0 1]^T has to be two rows


def test_the_five_entries_fix_the_five_numbers():
    a21, a23, a32, a33, b3 = A_410[1, 0], A_410[1, 2], A_410[2, 1], A_410[2, 2], B_410[2]
    ell = 1 / b3
    k_i = -a32 * ell
    found = {"m": k_i / a23, "k_x": -a21 * k_i / a23, "k_i": k_i, "R": -a33 * ell, "L": ell}
    for name, value in found.items():
        assert value == pytest.approx(preset("thesis").parameters[name], rel=3e-4), name


def test_table_4_1_as_printed_contradicts_the_matrices():
    # 5.96e-2 mH and 1.8 ohm are printed; 59.6 mH and 1.25 ohm are needed
    printed = {**preset("thesis").parameters, "L": 5.96e-5, "R": 1.8}
    s = model("one-axis").matrices(printed)
    assert s.B[2, 0] == pytest.approx(1000 * B_410[2], rel=1e-3)
    assert -s.A[2, 2] != pytest.approx(20.97, rel=0.1)
    needed = {**printed, "L": 59.6e-3, "R": 1.25}
    np.testing.assert_allclose(model("one-axis").matrices(needed).A[2], A_410[2], rtol=2e-4)


def test_poles_and_resonance():
    poles = np.linalg.eigvals(model("one-axis").matrices(preset("thesis").parameters).A)
    slow = poles[np.argmin(np.abs(poles))]
    fast = poles[np.argmax(poles.imag)]
    assert slow.imag == 0
    assert slow.real == pytest.approx(-0.00763, rel=2e-3)
    assert fast.real == pytest.approx(-10.48, rel=1e-3)
    assert fast.imag == pytest.approx(4017, rel=1e-3)
    assert fast.imag / (2 * np.pi) == pytest.approx(639, rel=1e-3)


def test_published_estimates_are_up_to_nine_percent_off():
    truth = preset("thesis").parameters
    error = {k: abs(v / truth[k] - 1) for k, v in PUBLISHED_411.items()}
    assert 0.08 < max(error.values()) < 0.10  # R
    assert min(error.values()) < 0.025
    # and they are one plant: the matrix that they make has the printed resonance within 3 %
    poles = np.linalg.eigvals(model("one-axis").matrices({**PUBLISHED_411, "c": 0.0}).A)
    assert poles.imag.max() / 4017 == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_we_recover_table_4_1_far_better(seed):
    # open loop, 10 kHz, 2 s, multisine 1 to 2000 Hz, 40 dB on both outputs, nothing known but c = 0
    clean = run("thesis", 20_000, seed, shape="pink", position=0.0, current=0.0, force=0.0, voltage=0.0)
    noise = clean.signals.y.std(axis=0) * 10 ** (-40 / 20)
    sensors = {"position": noise[0], "current": noise[1]}
    bench = run("thesis", 20_000, seed, shape="pink", force=0.0, voltage=0.0, **sensors)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)))
    theta, known = fit.problem.parameters(fit.vector), uncertainty(fit)
    assert fit.status == "converged"
    assert fit.problem.delay_samples(fit.vector) == 0
    for name, sd in zip(known.names, known.standard_deviations(robust=False), strict=True):
        truth = bench.truth[name]
        assert abs(theta[name] / truth - 1) < (0.03 if name == "k_x" else 0.005), name
        assert abs(theta[name] - truth) < 3.3 * sd, name  # inside the 99.9 % interval


def test_table_5_1_in_its_own_units():
    # eq. 5.4: 653.5/(s + 1204) is L = 1.530 mH and R = 1.842 ohm, not 1.53 H
    s = model("coil").matrices({"L": 1.530e-3, "R": 1.842})
    assert s.B[0, 0] == pytest.approx(653.5, rel=1e-3)
    assert s.A[0, 0] == pytest.approx(-1204, rel=1e-3)


def test_the_plant_of_5_7_cannot_be_the_one_it_is_said_to_be():
    # the matrix of eq. 5.7 has a pole at +0.722 with the numbers that follow from it
    numbers = {"m": 0.186, "k_x": -0.105, "k_i": -0.112, "R": 0.0588, "L": 1.585, "c": 0.0}
    poles = np.linalg.eigvals(model("one-axis").matrices(numbers).A)
    assert poles.real.max() == pytest.approx(0.722, rel=0.02)


def test_unstable_bearing_has_the_numbers_of_its_geometry():
    p = preset("unstable-bearing").parameters
    assert p["k_i"] == pytest.approx(55.7, rel=2e-3)
    assert p["k_x"] == pytest.approx(-1.29e5, rel=2e-3)
    # without the coil's coupling a mass on a negative spring falls with sqrt(k/m)
    rotor = model("rotor").matrices({k: p[k] for k in ("m", "k_x", "k_i", "c")})
    assert np.linalg.eigvals(rotor.A).real.max() == pytest.approx(np.sqrt(-p["k_x"] / p["m"]), rel=1e-12)


def test_rmit_axis():
    p = preset("rmit-axis").parameters
    assert (p["k_i"], p["k_x"]) == (61.0, -150_000.0)
    # printed there as F = k_x x + k_i i; here f = k_i i - k_x x, so the number changes its sign
    s = model("one-axis").matrices(p)
    assert s.A[1, 0] * p["m"] == pytest.approx(150_000)
    assert s.A[1, 2] * p["m"] == pytest.approx(61)


def test_the_resonance_wants_10_khz():
    d, _ = discretise(model("one-axis").matrices(preset("thesis").parameters), 1e-4)
    angle = np.abs(np.angle(np.linalg.eigvals(d.A))).max()
    assert 2 * np.pi / angle == pytest.approx(1e4 / 639.3, rel=1e-3)  # 15.6 samples a period
